"""Rules for imports between modules: each returns the violations in an import graph as lines."""

import ast
from collections.abc import Iterable, Iterator

from support.package_graph import PACKAGE_LAYERS, ImportEdge, ImportGraph, find_loaded_module

ALLOWED_IMPORTERS = {
    "diffrax": ("hybrid.phase_integration",), "llvmlite": ("simd",), "matplotlib": ("figures",),
    "PIL": ("figures",), "rich": ("cli",), "typer": ("cli",), "zarr": ("scans.store",),
    "anywidget": ("web",),
}  # fmt: skip
"""Modules or packages that may import a library; an `__init__` file may re-export it."""

MODEL_PACKAGES = ("models", "contact", "selection")
"""Packages that define models. Only these may test which model an object is."""


def find_import_cycles(import_graph: ImportGraph) -> list[str]:
    """Return the import cycles of modules; an `__init__` file imports what it exports."""
    graph: dict[str, list[str]] = {module: [] for module in import_graph.paths}
    for edge in import_graph.edges:
        if edge.target in graph:
            graph[edge.source].append(edge.target)
    cycles, visited = [], set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        if module in trail:
            cycle = trail[trail.index(module) :]
            minimum = cycle.index(min(cycle))
            cycle = (*cycle[minimum:], *cycle[: minimum + 1])
            cycles.append(" -> ".join(cycle))
        elif module not in visited:
            for other in graph[module]:
                visit(other, (*trail, module))
            visited.add(module)

    for module in graph:
        visit(module, ())
    return sorted(set(cycles))


def find_upward_imports(import_graph: ImportGraph) -> list[str]:
    """Return the imports against the import order, and the packages outside that order."""
    layer_index = {package: index for index, row in enumerate(PACKAGE_LAYERS) for package in row}
    violations = [
        f"{package} is missing in PACKAGE_LAYERS"
        for package in import_graph.packages
        if package not in layer_index
    ]
    for edge in import_graph.edges:
        source, target = import_graph.package_of(edge.source), import_graph.package_of(edge.target)
        if edge.target not in import_graph.paths or not source or source == target:
            continue
        if layer_index.get(target, len(PACKAGE_LAYERS)) >= layer_index.get(
            source, len(PACKAGE_LAYERS)
        ):
            violations.append(f"{_format_location(edge)} imports {edge.target}")
    return sorted(set(violations))


def find_bypassed_init_files(import_graph: ImportGraph) -> list[str]:
    """Return the imports from another package that bypass its `__init__`."""
    return sorted(
        {
            f"{_format_location(edge)} imports {edge.imported_name.replace(':', '.')}"
            for edge in import_graph.edges
            if _bypasses_init_file(import_graph, edge)
        }
    )


def _bypasses_init_file(import_graph: ImportGraph, edge: ImportEdge) -> bool:
    top, package, first, *_ = [*edge.imported_name.replace(":", ".").split("."), "", ""]
    init_module = f"{top}.{package}"
    if (
        top != import_graph.name
        or package == import_graph.package_of(edge.source)
        or not import_graph.is_init_module(init_module)
    ):
        return False
    exported = (
        first in import_graph.names[init_module]
        or f"{init_module}.{first}" not in import_graph.paths
    )
    return edge.stated_module not in ("", top, init_module) or not exported


def find_misplaced_external_imports(import_graph: ImportGraph) -> list[str]:
    """Return the imports of libraries outside `ALLOWED_IMPORTERS`, or by a computed name."""
    violations = []
    for edge in import_graph.edges:
        places = [
            f"{import_graph.name}.{place}"
            for place in ALLOWED_IMPORTERS.get(edge.target.split(".")[0], ())
        ]
        is_init = import_graph.is_init_module(edge.source)
        is_allowed = any(f"{edge.source}.".startswith(f"{place}.") for place in places)
        if places and not is_init and not is_allowed:
            violations.append(f"{_format_location(edge)} imports {edge.target.split('.')[0]}")
        source_in_simd, target_in_simd = (
            import_graph.package_of(module) == "simd" for module in (edge.source, edge.target)
        )
        if source_in_simd and not target_in_simd and edge.target in import_graph.paths:
            violations.append(
                f"{_format_location(edge)} imports {edge.target}: simd imports no other package"
            )
    for module, tree in import_graph.trees.items():
        if any(
            find_loaded_module(node, import_graph.names[module]) == "" for node in ast.walk(tree)
        ):
            violations.append(f"{module} imports a module by a computed name")
    return sorted(set(violations))


def find_model_type_tests(import_graph: ImportGraph) -> list[str]:
    """Return the tests outside `MODEL_PACKAGES` for the class or name of one model or its step.

    A model is a class of these packages that extends an abstract class. A test for the abstract
    class itself, such as `AbstractWheel`, is allowed.
    """
    model_classes, violations = _find_model_classes(import_graph), []
    for module, tree in import_graph.trees.items():
        if import_graph.package_of(module) in {*MODEL_PACKAGES, ""}:
            continue
        constants = {
            target.id: node.value
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if _tests_class_name(node):
                violations.append(f"{module}:{node.lineno} tests for {ast.unparse(node)}")
            for tested_names in _tested_expressions(node):
                for name in _find_class_names(tested_names, constants):
                    if import_graph.find_definition(module, name) in model_classes:
                        violations.append(f"{module}:{node.lineno} tests for {ast.unparse(name)}")
    return sorted(set(violations))


def _find_model_classes(import_graph: ImportGraph) -> set[str]:
    bases: dict[str, list[str]] = {}
    model_modules = [m for package in MODEL_PACKAGES for m in import_graph.modules_of(package)]
    for module in model_modules:
        for node in ast.walk(import_graph.trees[module]):
            if isinstance(node, ast.ClassDef):
                bases[f"{module}.{node.name}"] = [
                    import_graph.find_definition(module, b) for b in node.bases
                ]
    is_abstract = lambda name: name.split(".")[-1].startswith("Abstract")
    extends = lambda name: any(
        is_abstract(b) or extends(b) for b in bases.get(name, ()) if b in bases
    )
    return {name for name in bases if not is_abstract(name) and extends(name)}


def _tested_expressions(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the parts of a node that are compared with an object's class."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if node.func.id in {"isinstance", "issubclass"} and len(node.args) == 2:
            yield node.args[1]
    elif isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        texts = [ast.unparse(side) for side in sides]
        if any(text.startswith("type(") or text.endswith(".__class__") for text in texts):
            yield from sides
    elif isinstance(node, ast.MatchClass):
        yield node.cls
    elif isinstance(node, ast.Dict):
        yield from (key for key in node.keys if key is not None)


def _tests_class_name(node: ast.AST) -> bool:
    """Return whether a node compares the name of a model with a literal."""
    if not isinstance(node, ast.Compare):
        return False
    sides = [node.left, *node.comparators]
    has_name_attribute = any(isinstance(part, ast.Constant) and isinstance(part.value, str)
                  for side in sides for part in ast.walk(side))  # fmt: skip
    return has_name_attribute and any(
        isinstance(x, ast.Attribute) and x.attr == "model_name" for x in sides
    )


def _find_class_names(
    node: ast.AST, constants: dict[str, ast.expr]
) -> Iterator[ast.Name | ast.Attribute]:
    """Yield the names in an expression; a module's constant is replaced by its value."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name) and inner.id in constants:
            value_node = {name: value for name, value in constants.items() if name != inner.id}
            yield from _find_class_names(constants[inner.id], value_node)
        elif isinstance(inner, ast.Name | ast.Attribute):
            yield inner


def find_unused_exports(
    import_graph: ImportGraph, outside_sources: Iterable[str] = ()
) -> list[str]:
    """Return the exports of `__init__` files that nothing imports, or that are private.

    `outside_sources` use the package: tests and experiments. The top package's own `__init__` is
    for users and is not checked.
    """
    imported_names = {
        name for text in outside_sources for name in import_graph.find_imports_in(text)
    }
    violations = []
    for init in import_graph.paths:
        if not import_graph.is_init_module(init) or init == import_graph.name:
            continue
        outside_edges = (
            edge for edge in import_graph.edges if not f"{edge.source}.".startswith(f"{init}.")
        )
        used_names = imported_names | {edge.imported_name for edge in outside_edges}
        for name in import_graph.names[init]:
            if not any(f"{used_name}.".startswith(f"{init}:{name}.") for used_name in used_names):
                violations.append(f"{init} exports {name}, which nothing imports from there")
            if name.startswith("_"):
                violations.append(f"{init} exports {name}, which is private")
    return violations


def _format_location(edge: ImportEdge) -> str:
    return f"{edge.source}:{edge.line}"


IMPORT_RULES = (
    find_import_cycles,
    find_upward_imports,
    find_bypassed_init_files,
    find_misplaced_external_imports,
    find_model_type_tests,
)

"""Rules for imports between modules: each returns the violations in an import graph as lines."""

import ast
import sys
from collections.abc import Iterable, Iterator

from support.package_graph import (
    PACKAGE_ORDER,
    PUBLIC_MODULES,
    ImportEdge,
    ImportGraph,
    find_loaded_module,
)

SHARED_LIBRARIES = {"equinox", "jax", "jaxtyping", "numpy", "scipy", "xarray"}
"""Libraries that every package may import."""

ALLOWED_IMPORTERS = {
    "PIL": "app", "anywidget": "app", "cycler": "app", "dask": "studies.scan_execution",
    "diffrax": "flow.phase_integration", "distributed": "studies.scan_execution",
    "llvmlite": "lanes", "matplotlib": "app", "optax": "studies",
    "pydantic": "app.config", "pydantic_core": "app.config", "rich": "app", "traitlets": "app",
    "typer": "app", "zarr": "studies",
}  # fmt: skip
"""The one package or module that may import a library."""

MODEL_PACKAGES = ("models",)
"""Packages that define models. Only these may test which model an object is."""

WALKER_PACKAGES = ("wheel", "models")
"""Packages of the wheel, which packages for any walker do not import in the end."""
GENERAL_PACKAGES = ("flow", "gaits", "branches", "studies")
"""Packages for any walker."""


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
    position = {package: index for index, package in enumerate(PACKAGE_ORDER)}
    violations = [
        f"{package} is missing in PACKAGE_ORDER"
        for package in import_graph.packages
        if package not in position
    ]
    last = len(position)
    for edge in import_graph.edges:
        source, target = import_graph.package_of(edge.source), import_graph.package_of(edge.target)
        is_inside = edge.target in import_graph.paths and source != target
        if source and is_inside and position.get(target, last) >= position.get(source, last):
            violations.append(f"{_format_location(edge)} imports {edge.target}")
    return sorted(set(violations))


def find_indirect_imports(import_graph: ImportGraph) -> list[str]:
    """Return the imports of names from a module that does not define the name.

    Attributes of a package or of a public module, as in `lanes.jit`, are allowed.
    """
    violations = []
    for edge in import_graph.edges:
        *modules_on_path, _ = import_graph.resolve_path(edge.imported_name)
        is_package_attribute = not edge.stated_module and (
            import_graph.is_init_module(modules_on_path[0])
            or modules_on_path[0].removeprefix(f"{import_graph.name}.") in PUBLIC_MODULES
        )
        if len(modules_on_path) > 1 and not is_package_attribute:
            violations.append(
                f"{_format_location(edge)} imports {edge.imported_name} instead of "
                f"{modules_on_path[-1]}"
            )
    return sorted(set(violations))


def find_misplaced_external_imports(import_graph: ImportGraph) -> list[str]:
    """Return the imports of libraries outside `ALLOWED_IMPORTERS`, or by a computed name."""
    violations = []
    for edge in import_graph.edges:
        library = edge.target.split(".")[0]
        if library in {import_graph.name, *SHARED_LIBRARIES} | sys.stdlib_module_names:
            continue
        importer = f"{import_graph.name}.{ALLOWED_IMPORTERS.get(library, '')}"
        if not f"{edge.source}.".startswith(f"{importer}."):
            violations.append(f"{_format_location(edge)} imports {library}")
    for module, tree in import_graph.trees.items():
        if any(
            find_loaded_module(node, import_graph.names[module]) == "" for node in ast.walk(tree)
        ):
            violations.append(f"{module} imports a module by a computed name")
    return sorted(set(violations))


def list_walker_imports(import_graph: ImportGraph) -> list[str]:
    """Return each module of a general package with the modules of the wheel that it imports."""
    imported_modules: dict[str, set[str]] = {}
    shorten = lambda module: module.removeprefix(f"{import_graph.name}.")
    for edge in import_graph.edges:
        is_general = import_graph.package_of(edge.source) in GENERAL_PACKAGES
        if is_general and import_graph.package_of(edge.target) in WALKER_PACKAGES:
            imported_modules.setdefault(shorten(edge.source), set()).add(shorten(edge.target))
    return [
        f"{module}: {' '.join(sorted(targets))}"
        for module, targets in sorted(imported_modules.items())
    ]


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

    `outside_sources` use the package: tests, experiments, the website and pages. The top package's
    own `__init__` is for users and is not checked.
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
    find_indirect_imports,
    find_misplaced_external_imports,
    find_model_type_tests,
)

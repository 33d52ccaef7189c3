"""The rules of the house: each takes a package as read and tells, line by line, what breaks it."""

import ast
from collections.abc import Iterable, Iterator

from support.rooms import PACKAGE_LAYERS, ImportEdge, ImportGraph, find_loaded_module

MAX_MODULE_LINES, MAX_FUNCTION_LINES = 500, 60

ALLOWED_IMPORTERS = {
    "diffrax": ("hybrid.phase_integration",), "llvmlite": ("simd",), "matplotlib": ("figures",),
    "PIL": ("figures",), "rich": ("cli",), "typer": ("cli",), "zarr": ("scans.store",),
    "anywidget": ("web",),
}  # fmt: skip
"""Who may know a library: modules or rooms. Faces only hand on."""


def find_import_cycles(import_graph: ImportGraph) -> list[str]:
    """Modules that lead back to themselves; a face leads to what it hands out."""
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
    """Imports against the flow, and rooms that the flow does not know."""
    layer_index = {package: index for index, row in enumerate(PACKAGE_LAYERS) for package in row}
    violations = [
        f"{package} stands nowhere in the flow"
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
            violations.append(f"{_format_location(edge)} knows {edge.target}")
    return sorted(set(violations))


def find_bypassed_init_files(import_graph: ImportGraph) -> list[str]:
    """Imports that enter another room past its face."""
    return sorted(
        {
            f"{_format_location(a)} fetches {a.imported_name.replace(':', '.')}"
            for a in import_graph.edges
            if _bypasses_init_file(import_graph, a)
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
    """Libraries known outside their room, and libraries loaded by names not written out."""
    violations, lazy = [], f"{import_graph.name}.runtime.lazy_import"
    for edge in import_graph.edges:
        places = [
            f"{import_graph.name}.{place}"
            for place in ALLOWED_IMPORTERS.get(edge.target.split(".")[0], ())
        ]
        hands_on = import_graph.is_init_module(edge.source)
        at_home = any(f"{edge.source}.".startswith(f"{place}.") for place in places)
        if places and not hands_on and not at_home:
            violations.append(f"{_format_location(edge)} knows {edge.target.split('.')[0]}")
        inner, outer = (
            import_graph.package_of(module) == "simd" for module in (edge.source, edge.target)
        )
        if inner and not outer and edge.target in import_graph.paths:
            violations.append(
                f"{_format_location(edge)} knows {edge.target}: simd knows nothing of the rest"
            )
    for module, tree in import_graph.trees.items():
        if module != lazy and any(
            find_loaded_module(node, import_graph.names[module]) == "" for node in ast.walk(tree)
        ):
            violations.append(f"{module} loads a module by a name that is not written out")
    return sorted(set(violations))


def find_model_type_tests(import_graph: ImportGraph) -> list[str]:
    """Questions above `models` which rung, or which rung's step, a thing is.

    A rung is a class of `models` that extends an abstract one; `AbstractWheel` itself may be
    asked for: whether a thing is a rung at all.
    """
    model_classes, violations = _find_model_classes(import_graph), []
    for module, tree in import_graph.trees.items():
        if import_graph.package_of(module) in {"models", ""}:
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
                violations.append(f"{module}:{node.lineno} asks for {ast.unparse(node)}")
            for tested_names in _tested_expressions(node):
                for name in _find_class_names(tested_names, constants):
                    if import_graph.find_definition(module, name) in model_classes:
                        violations.append(f"{module}:{node.lineno} asks for {ast.unparse(name)}")
    return sorted(set(violations))


def _find_model_classes(import_graph: ImportGraph) -> set[str]:
    bases: dict[str, list[str]] = {}
    for module in import_graph.modules_of("models"):
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
    """Parts of a node that ask of what class a thing is."""
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
    """Whether it compares the name that a rung bears with one written out."""
    if not isinstance(node, ast.Compare):
        return False
    sides = [node.left, *node.comparators]
    has_name_attribute = any(isinstance(part, ast.Constant) and isinstance(part.value, str)
                  for side in sides for part in ast.walk(side))  # fmt: skip
    return has_name_attribute and any(
        isinstance(x, ast.Attribute) and x.attr == "rung" for x in sides
    )


def _find_class_names(
    node: ast.AST, constants: dict[str, ast.expr]
) -> Iterator[ast.Name | ast.Attribute]:
    """Names in an expression; a module's constant counts as what it holds."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name) and inner.id in constants:
            value_node = {name: value for name, value in constants.items() if name != inner.id}
            yield from _find_class_names(constants[inner.id], value_node)
        elif isinstance(inner, ast.Name | ast.Attribute):
            yield inner


def find_hidden_modules(import_graph: ImportGraph) -> list[str]:
    """Functions and classes that bear the name of their module, or hide a module in a face."""
    violations = []
    for module, tree in import_graph.trees.items():
        last = module.split(".")[-1]
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == last:
                violations.append(f"{module}:{node.lineno} defines its own name")
            defined = isinstance(
                node, ast.FunctionDef | ast.ClassDef
            ) and import_graph.is_init_module(module)
            if defined and f"{module}.{node.name}" in import_graph.paths:
                violations.append(f"{module}:{node.lineno} hides its module {node.name}")
        for name, origin in (
            import_graph.names[module].items() if import_graph.is_init_module(module) else ()
        ):
            inner = f"{module}.{name}"
            if inner in import_graph.paths and import_graph.resolve_path(origin)[-1] != inner:
                violations.append(f"{module} hides its module {name} by {origin}")
    return sorted(set(violations))


def find_long_code(import_graph: ImportGraph) -> list[str]:
    """Modules and functions past their number of lines; a function's docstring is not counted."""
    violations = []
    for module, tree in import_graph.trees.items():
        if (lines := import_graph.count_lines(module)) > MAX_MODULE_LINES:
            violations.append(f"{module} has {lines} lines")
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length_text = ast.get_docstring(node, clean=False) or ""
                lines = (node.end_lineno or 0) - node.lineno + 1 - length_text.count("\n")
                if lines > MAX_FUNCTION_LINES:
                    violations.append(f"{module}:{node.lineno} {node.name} has {lines} lines")
    return violations


def find_unused_exports(
    import_graph: ImportGraph, outside_sources: Iterable[str] = ()
) -> list[str]:
    """Names that a face hands out and nobody fetches there, or that are private.

    `outside` is source that uses the package: tests and experiments. The package's own face is for
    its users, who are not here.
    """
    imported_names = {
        written_text
        for text in outside_sources
        for written_text in import_graph.find_imports_in(text)
    }
    violations = []
    for face in import_graph.paths:
        if not import_graph.is_init_module(face) or face == import_graph.name:
            continue
        strangers = (a for a in import_graph.edges if not f"{a.source}.".startswith(f"{face}."))
        used = imported_names | {arrow.imported_name for arrow in strangers}
        for name in import_graph.names[face]:
            if not any(f"{written_text}.".startswith(f"{face}:{name}.") for written_text in used):
                violations.append(f"{face} hands out {name}, which nobody fetches there")
            if name.startswith("_"):
                violations.append(f"{face} hands out {name}, which is private")
    return violations


def _format_location(edge: ImportEdge) -> str:
    return f"{edge.source}:{edge.line}"


IMPORT_RULES = (
    find_import_cycles,
    find_upward_imports,
    find_bypassed_init_files,
    find_misplaced_external_imports,
    find_model_type_tests,
    find_hidden_modules,
    find_long_code,
)

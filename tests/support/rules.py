"""The rules of the house: each takes a package as read and tells, line by line, what breaks it."""

import ast
from collections.abc import Iterable, Iterator

from support.rooms import FLOW, Arrow, House, loaded

LONGEST_MODULE, LONGEST_FUNCTION = 500, 60

ONLY = {
    "diffrax": ("numerics.events",), "llvmlite": ("simd",), "matplotlib": ("figures",),
    "PIL": ("figures",), "rich": ("app",), "typer": ("app",), "zarr": ("scans.store",),
    "anywidget": ("web",),
}  # fmt: skip
"""Who may know a library: modules or rooms. Faces only hand on."""


def circles(house: House) -> list[str]:
    """Modules that lead back to themselves; a face leads to what it hands out."""
    graph: dict[str, list[str]] = {module: [] for module in house.paths}
    for arrow in house.arrows:
        if arrow.target in graph:
            graph[arrow.source].append(arrow.target)
    found, done = [], set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        if module in trail:
            circle = trail[trail.index(module) :]
            least = circle.index(min(circle))
            circle = (*circle[least:], *circle[: least + 1])
            found.append(" -> ".join(circle))
        elif module not in done:
            for other in graph[module]:
                visit(other, (*trail, module))
            done.add(module)

    for module in graph:
        visit(module, ())
    return sorted(set(found))


def upward(house: House) -> list[str]:
    """Imports against the flow, and rooms that the flow does not know."""
    floor = {room: index for index, row in enumerate(FLOW) for room in row}
    found = [f"{room} stands nowhere in the flow" for room in house.rooms if room not in floor]
    for arrow in house.arrows:
        source, target = house.room(arrow.source), house.room(arrow.target)
        if arrow.target not in house.paths or not source or source == target:
            continue
        if floor.get(target, len(FLOW)) >= floor.get(source, len(FLOW)):
            found.append(f"{_place(arrow)} knows {arrow.target}")
    return sorted(set(found))


def past_faces(house: House) -> list[str]:
    """Imports that enter another room past its face."""
    return sorted(
        {
            f"{_place(a)} fetches {a.written.replace(':', '.')}"
            for a in house.arrows
            if _is_deep(house, a)
        }
    )


def _is_deep(house: House, arrow: Arrow) -> bool:
    top, room, first, *_ = [*arrow.written.replace(":", ".").split("."), "", ""]
    face = f"{top}.{room}"
    if top != house.name or room == house.room(arrow.source) or not house.is_face(face):
        return False
    handed_out = first in house.names[face] or f"{face}.{first}" not in house.paths
    return arrow.stated not in ("", top, face) or not handed_out


def strangers(house: House) -> list[str]:
    """Libraries known outside their room, and libraries loaded by names not written out."""
    found, lazy = [], f"{house.name}.runtime.lazy"
    for arrow in house.arrows:
        places = [f"{house.name}.{place}" for place in ONLY.get(arrow.target.split(".")[0], ())]
        hands_on = house.is_face(arrow.source)
        at_home = any(f"{arrow.source}.".startswith(f"{place}.") for place in places)
        if places and not hands_on and not at_home:
            found.append(f"{_place(arrow)} knows {arrow.target.split('.')[0]}")
        inner, outer = (house.room(module) == "simd" for module in (arrow.source, arrow.target))
        if inner and not outer and arrow.target in house.paths:
            found.append(f"{_place(arrow)} knows {arrow.target}: simd knows nothing of the rest")
    for module, tree in house.trees.items():
        if module != lazy and any(
            loaded(node, house.names[module]) == "" for node in ast.walk(tree)
        ):
            found.append(f"{module} loads a module by a name that is not written out")
    return sorted(set(found))


def asked_rungs(house: House) -> list[str]:
    """Questions above `models` which rung, or which rung's step, a thing is.

    A rung is a class of `models` that extends an abstract one; `AbstractWheel` itself may be
    asked for: whether a thing is a rung at all.
    """
    rungs, found = _rungs(house), []
    for module, tree in house.trees.items():
        if house.room(module) in {"models", ""}:
            continue
        constants = {
            target.id: node.value
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if _asks_by_name(node):
                found.append(f"{module}:{node.lineno} asks for {ast.unparse(node)}")
            for asked in _asked(node):
                for name in _named(asked, constants):
                    if house.defined(module, name) in rungs:
                        found.append(f"{module}:{node.lineno} asks for {ast.unparse(name)}")
    return sorted(set(found))


def _rungs(house: House) -> set[str]:
    bases: dict[str, list[str]] = {}
    for module in house.modules("models"):
        for node in ast.walk(house.trees[module]):
            if isinstance(node, ast.ClassDef):
                bases[f"{module}.{node.name}"] = [house.defined(module, b) for b in node.bases]
    is_abstract = lambda name: name.split(".")[-1].startswith("Abstract")
    extends = lambda name: any(
        is_abstract(b) or extends(b) for b in bases.get(name, ()) if b in bases
    )
    return {name for name in bases if not is_abstract(name) and extends(name)}


def _asked(node: ast.AST) -> Iterator[ast.AST]:
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


def _asks_by_name(node: ast.AST) -> bool:
    """Whether it compares the name that a rung bears with one written out."""
    if not isinstance(node, ast.Compare):
        return False
    sides = [node.left, *node.comparators]
    written = any(isinstance(part, ast.Constant) and isinstance(part.value, str)
                  for side in sides for part in ast.walk(side))  # fmt: skip
    return written and any(isinstance(x, ast.Attribute) and x.attr == "rung" for x in sides)


def _named(node: ast.AST, constants: dict[str, ast.expr]) -> Iterator[ast.Name | ast.Attribute]:
    """Names in an expression; a module's constant counts as what it holds."""
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name) and inner.id in constants:
            held = {name: value for name, value in constants.items() if name != inner.id}
            yield from _named(constants[inner.id], held)
        elif isinstance(inner, ast.Name | ast.Attribute):
            yield inner


def namesakes(house: House) -> list[str]:
    """Functions and classes that bear the name of their module, or hide a module in a face."""
    found = []
    for module, tree in house.trees.items():
        last = module.split(".")[-1]
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == last:
                found.append(f"{module}:{node.lineno} defines its own name")
            defined = isinstance(node, ast.FunctionDef | ast.ClassDef) and house.is_face(module)
            if defined and f"{module}.{node.name}" in house.paths:
                found.append(f"{module}:{node.lineno} hides its module {node.name}")
        for name, origin in house.names[module].items() if house.is_face(module) else ():
            inner = f"{module}.{name}"
            if inner in house.paths and house.way(origin)[-1] != inner:
                found.append(f"{module} hides its module {name} by {origin}")
    return sorted(set(found))


def long_ones(house: House) -> list[str]:
    """Modules and functions past their number of lines; a function's docstring is not counted."""
    found = []
    for module, tree in house.trees.items():
        if (lines := house.n_lines(module)) > LONGEST_MODULE:
            found.append(f"{module} has {lines} lines")
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                told = ast.get_docstring(node, clean=False) or ""
                lines = (node.end_lineno or 0) - node.lineno + 1 - told.count("\n")
                if lines > LONGEST_FUNCTION:
                    found.append(f"{module}:{node.lineno} {node.name} has {lines} lines")
    return found


def idle_names(house: House, outside: Iterable[str] = ()) -> list[str]:
    """Names that a face hands out and nobody fetches there, or that are private.

    `outside` is source that uses the package: tests and experiments. The package's own face is for
    its users, who are not here.
    """
    fetched = {written for text in outside for written in house.fetched_by(text)}
    found = []
    for face in house.paths:
        if not house.is_face(face) or face == house.name:
            continue
        strangers = (a for a in house.arrows if not f"{a.source}.".startswith(f"{face}."))
        used = fetched | {arrow.written for arrow in strangers}
        for name in house.names[face]:
            if not any(f"{written}.".startswith(f"{face}:{name}.") for written in used):
                found.append(f"{face} hands out {name}, which nobody fetches there")
            if name.startswith("_"):
                found.append(f"{face} hands out {name}, which is private")
    return found


def _place(arrow: Arrow) -> str:
    return f"{arrow.source}:{arrow.line}"


RULES = (circles, upward, past_faces, strangers, asked_rungs, namesakes, long_ones)

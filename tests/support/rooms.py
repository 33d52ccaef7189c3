"""The package as its imports show it: modules, rooms, arrows. It is read, never run.

Every import counts: inside functions, for type checkers only, by name (`import_module("a.b")`, a
string that is a module's dotted name), by attribute (`room.module.name`). A name fetched through
a face, or through `runtime.lazy`, is an arrow to where it is defined as well.
"""

import ast
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from textwrap import dedent
from typing import NamedTuple

FLOW = (
    ("simd",), ("wording",), ("runtime",), ("numerics",), ("wheel",), ("results",),
    ("models",), ("walks",), ("batches", "cycles"), ("gaits",), ("answers",),
    ("branches", "tuning", "scans"), ("figures", "web"), ("paper",), ("app",),
)  # fmt: skip
"""Rooms in the order in which they may know each other; those of one row do not."""


class Arrow(NamedTuple):
    """What one import leads to."""

    source: str  # module that imports, dotted
    target: str  # module of the package, or name in a library
    written: str  # what is fetched, `module:name`
    stated: str  # module that an import statement names, dotted; "" for an attribute
    line: int


class House:
    """A package: its modules, what they import, and from where."""

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self.paths: dict[str, Path] = {}
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder.parent).with_suffix("").parts
            self.paths[".".join(parts).removesuffix(".__init__")] = path
        self.trees = {module: ast.parse(path.read_text()) for module, path in self.paths.items()}
        self.names = {module: self._names(module, tree) for module, tree in self.trees.items()}

    def is_face(self, module: str) -> bool:
        """Whether a module is a package's `__init__`."""
        return module in self.paths and self.paths[module].name == "__init__.py"

    def room(self, module: str) -> str:
        """First folder below the package, or file; "" for the package's face and its `__main__`."""
        room = module.split(".")[1] if "." in module else ""
        return "" if room == "__main__" else room

    @cached_property
    def rooms(self) -> tuple[str, ...]:
        """Every room, in the order of the flow; those that it does not know last."""
        known = [room for row in FLOW for room in row]
        here = {self.room(module) for module in self.paths} - {""}
        return (*(room for room in known if room in here), *sorted(here - set(known)))

    def modules(self, room: str) -> list[str]:
        """Modules of a room, its face among them."""
        return [module for module in self.paths if self.room(module) == room]

    def n_lines(self, module: str) -> int:
        """Lines of a module's file."""
        return len(self.paths[module].read_text().splitlines())

    @cached_property
    def arrows(self) -> list[Arrow]:
        """Every import of every module, once for each module it leads through, and libraries."""
        found = {}
        for module in self.paths:
            for fetched, stated, line in self._fetched(self.trees[module], module):
                written = self.entered(fetched)
                *through, last = self.way(written)
                library = [] if last.split(".")[0] == self.name else [last]
                for target in (*through, *library):
                    arrow = Arrow(module, target, written, stated, line)
                    if target != module:
                        found.setdefault(arrow[:4], arrow)
        return list(found.values())

    @cached_property
    def links(self) -> Counter[tuple[str, str]]:
        """How many names the modules of a room fetch from what another room defines."""
        fetched = {
            (arrow.source, arrow.written, self.room(arrow.target))
            for arrow in self.arrows
            if arrow.target in self.paths and not self.is_face(arrow.target)
        }
        rooms = ((self.room(source), target) for source, _, target in fetched)
        return Counter((one, other) for one, other in rooms if one and one != other)

    def way(self, written: str) -> list[str]:
        """Modules that `module:name` leads through, then the name where it is defined, dotted.

        Faces and re-exports are followed; a library's name is its own end.
        """
        module, _, name = written.partition(":")
        if module not in self.paths:
            return [written.replace(":", ".")]
        through, parts = [module], name.split(".") if name else []
        for index, part in enumerate(parts):
            inner, after = f"{module}.{part}", parts[index + 1 :]
            origin = self.names[module].get(part, f"{module}:{part}")
            if origin != f"{module}:{part}":
                return [*through, *self.way(_joined(origin, after))]
            if inner not in self.paths:
                return [*through, ".".join([inner, *after])]
            through[-1] = module = inner  # a module is found without its face
        return [*through, module]

    def defined(self, module: str, node: ast.AST) -> str:
        """Where what a name or attribute in a module stands for is defined, dotted; or ""."""
        first, *rest = _chain(node) or [""]
        origin = self.names[module].get(first, f"{module}:{first}")
        return self.way(_joined(origin, rest))[-1] if first else ""

    def fetched_by(self, text: str) -> set[str]:
        """What source outside of the package fetches, `module:name`; code in strings counts."""
        tree = ast.parse(text)
        found = {self.entered(written) for written, _, _ in self._fetched(tree, "")}
        for node in ast.walk(tree):
            inner = node.value if isinstance(node, ast.Constant) else None
            if isinstance(inner, str) and "import " in inner and self.name in inner:
                with suppress(SyntaxError):
                    found |= self.fetched_by(dedent(inner))
        return found

    def entered(self, written: str) -> str:
        """`package:module.name` as `package.module:name`, unless the face hands the module out."""
        module, _, name = written.partition(":")
        first, _, rest = name.partition(".")
        inner = f"{module}.{first}"
        if inner not in self.paths or first in self.names[module]:
            return written
        return self.entered(f"{inner}:{rest}" if rest else inner)

    def _names(self, module: str, tree: ast.AST) -> dict[str, str]:
        """Names that a module imports, wherever in it, and what each stands for."""
        names: dict[str, str] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    first = alias.name.split(".")[0]
                    names[alias.asname or first] = alias.name if alias.asname else first
            elif isinstance(node, ast.ImportFrom):
                origin = self._origin(module, node)
                names |= {a.asname or a.name: f"{origin}:{a.name}" for a in node.names}
        own = {getattr(node, "name", "") for node in ast.iter_child_nodes(tree)}
        return {name: origin for name, origin in names.items() if name not in own}

    def _origin(self, module: str, node: ast.ImportFrom) -> str:
        """What stands between `from` and `import`, without leading dots."""
        parts = module.split(".")
        base = parts[: len(parts) - node.level + self.is_face(module)] if node.level else []
        return ".".join([*base, node.module] if node.module else base)

    def _fetched(self, tree: ast.AST, module: str) -> Iterator[tuple[str, str, int]]:
        """Dotted names that a module fetches, what each import states, and the line."""
        names = self.names[module] if module else self._names(module, tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                yield from ((alias.name, alias.name, node.lineno) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                origin = self._origin(module, node)
                yield from ((f"{origin}:{a.name}", origin, node.lineno) for a in node.names)
            elif isinstance(node, ast.Constant) and node.value in self.paths and "." in node.value:
                yield node.value, node.value, node.lineno
            elif name := loaded(node, names):
                yield name, name, node.lineno
            elif isinstance(node, ast.Attribute):
                first, *rest = _chain(node) or [""]
                origin = names.get(first, "")
                if origin.partition(":")[0] in self.paths:
                    yield _joined(origin, rest), "", node.lineno


def _joined(origin: str, names: list[str]) -> str:
    """`module:a` and further names as `module:a.b.c`."""
    return f"{origin}{'.' if ':' in origin else ':'}{'.'.join(names)}" if names else origin


def loaded(node: ast.AST, names: dict[str, str]) -> str | None:
    """What a call imports by name; "" where the name is not written out, None for other nodes."""
    if not isinstance(node, ast.Call) or not node.args:
        return None
    first, *rest = _chain(node.func) or [""]
    called = _joined(names.get(first, first), rest).replace(":", ".").split(".")[-1]
    if called not in {"import_module", "__import__", "library"}:
        return None
    name = node.args[0]
    return name.value if isinstance(name, ast.Constant) else ""


def _chain(node: ast.AST) -> list[str] | None:
    """`a.b.c` as ["a", "b", "c"]; None for anything but attributes of a name."""
    if isinstance(node, ast.Name):
        return [node.id]
    inner = _chain(node.value) if isinstance(node, ast.Attribute) else None
    return inner and [*inner, node.attr]

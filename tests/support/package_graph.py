"""Read the import graph of a Python package from its sources: modules, packages and edges.

Every import counts: inside functions, for type checkers, by name (`import_module("a.b")`, or a
string with a module's dotted name) and by attribute (`package.module.name`). A name imported
through an `__init__` file also gives an edge to the module that defines it. The package itself does
not run.
"""

import ast
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from textwrap import dedent
from typing import NamedTuple

PACKAGE_ORDER = (
    "lanes", "base", "wheel", "flow", "models", "gaits", "branches", "studies", "app",
)  # fmt: skip
"""Packages in import order: a package may import those before it only."""

PUBLIC_MODULES = {"hybrid": "flow", "continuation": "branches", "plot": "app", "__main__": "app"}
"""Modules beside the packages, with the last package that each exports names of."""


class ImportEdge(NamedTuple):
    """One import of one name."""

    source: str  # module that imports, dotted
    target: str  # module of the package, or name in a library
    imported_name: str  # `module:name`
    stated_module: str  # module named in the import statement, dotted; "" for an attribute
    line: int


class ImportGraph:
    """The modules of a package and their imports."""

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self.paths: dict[str, Path] = {}
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder.parent).with_suffix("").parts
            self.paths[".".join(parts).removesuffix(".__init__")] = path
        self.trees = {module: ast.parse(path.read_text()) for module, path in self.paths.items()}
        self.names = {
            module: self._collect_names(module, tree) for module, tree in self.trees.items()
        }

    def is_init_module(self, module: str) -> bool:
        """Return whether a module is a package's `__init__`."""
        return module in self.paths and self.paths[module].name == "__init__.py"

    def package_of(self, module: str) -> str:
        """Return a module's package; it is "" for the top package's `__init__`."""
        package = module.split(".")[1] if "." in module else ""
        return PUBLIC_MODULES.get(package, package)

    @cached_property
    def packages(self) -> tuple[str, ...]:
        """All packages in import order; those outside `PACKAGE_ORDER` come last."""
        existing_packages = {self.package_of(module) for module in self.paths} - {""}
        return (
            *(package for package in PACKAGE_ORDER if package in existing_packages),
            *sorted(existing_packages - set(PACKAGE_ORDER)),
        )

    def modules_of(self, package: str) -> list[str]:
        """Return the modules of a package, including its `__init__` and public modules."""
        return [module for module in self.paths if self.package_of(module) == package]

    def count_lines(self, module: str) -> int:
        """Return the number of lines of a module's file."""
        return len(self.paths[module].read_text().splitlines())

    @cached_property
    def edges(self) -> list[ImportEdge]:
        """All imports of all modules: one edge per module on the path, and per library."""
        edges_by_key = {}
        for module in self.paths:
            for imported, stated_module, line in self._iterate_imports(self.trees[module], module):
                entered_name = self.normalize_import(imported)
                *modules_on_path, definition = self.resolve_path(entered_name)
                library_targets = [] if definition.split(".")[0] == self.name else [definition]
                for target in (*modules_on_path, *library_targets):
                    edge = ImportEdge(module, target, entered_name, stated_module, line)
                    if target != module:
                        edges_by_key.setdefault(edge[:4], edge)
        return list(edges_by_key.values())

    @cached_property
    def package_links(self) -> Counter[tuple[str, str]]:
        """Numbers of names that the modules of one package import from another, by pair."""
        imported_names = {
            (edge.source, edge.imported_name, self.package_of(edge.target))
            for edge in self.edges
            if edge.target in self.paths and not self.is_init_module(edge.target)
        }
        package_pairs = ((self.package_of(source), target) for source, _, target in imported_names)
        return Counter(
            (importer, exporter)
            for importer, exporter in package_pairs
            if importer and importer != exporter
        )

    def resolve_path(self, imported_name: str) -> list[str]:
        """Return the modules on the path of `module:name`, then its dotted definition.

        `__init__` files and re-exports are followed; a name of a library ends the path.
        """
        module, _, name = imported_name.partition(":")
        if module not in self.paths:
            return [imported_name.replace(":", ".")]
        modules_on_path, parts = [module], name.split(".") if name else []
        for index, part in enumerate(parts):
            submodule, remaining_parts = f"{module}.{part}", parts[index + 1 :]
            origin = self.names[module].get(part, f"{module}:{part}")
            if origin != f"{module}:{part}":
                return [*modules_on_path, *self.resolve_path(_join_names(origin, remaining_parts))]
            if submodule not in self.paths:
                return [*modules_on_path, ".".join([submodule, *remaining_parts])]
            modules_on_path[-1] = module = submodule  # a module is imported without its `__init__`
        return [*modules_on_path, module]

    def find_definition(self, module: str, node: ast.AST) -> str:
        """Return the dotted definition of a name or attribute in a module, or ""."""
        first_name, *attribute_names = _attribute_chain(node) or [""]
        origin = self.names[module].get(first_name, f"{module}:{first_name}")
        return self.resolve_path(_join_names(origin, attribute_names))[-1] if first_name else ""

    def find_imports_in(self, text: str) -> set[str]:
        """Return the imports, `module:name`, of outside source and of the code in its strings."""
        tree = ast.parse(text)
        imports = {
            self.normalize_import(imported_name)
            for imported_name, _, _ in self._iterate_imports(tree, "")
        }
        for node in ast.walk(tree):
            text_constant = node.value if isinstance(node, ast.Constant) else None
            if (
                isinstance(text_constant, str)
                and "import " in text_constant
                and self.name in text_constant
            ):
                with suppress(SyntaxError):
                    imports |= self.find_imports_in(dedent(text_constant))
        return imports

    def normalize_import(self, imported_name: str) -> str:
        """Return `package:module.name` as `package.module:name`, unless the module is exported."""
        module, _, name = imported_name.partition(":")
        first, _, rest = name.partition(".")
        inner = f"{module}.{first}"
        if inner not in self.paths or first in self.names[module]:
            return imported_name
        return self.normalize_import(f"{inner}:{rest}" if rest else inner)

    def _collect_names(self, module: str, tree: ast.AST) -> dict[str, str]:
        """Return the origin of each name that a module imports at any depth."""
        names: dict[str, str] = {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    first = alias.name.split(".")[0]
                    names[alias.asname or first] = alias.name if alias.asname else first
            elif isinstance(node, ast.ImportFrom):
                origin = self._origin(module, node)
                names |= {a.asname or a.name: f"{origin}:{a.name}" for a in node.names}
        defined_names = {getattr(node, "name", "") for node in ast.iter_child_nodes(tree)}
        return {name: origin for name, origin in names.items() if name not in defined_names}

    def _origin(self, module: str, node: ast.ImportFrom) -> str:
        """Return the absolute name of the module between `from` and `import`."""
        parts = module.split(".")
        base = parts[: len(parts) - node.level + self.is_init_module(module)] if node.level else []
        return ".".join([*base, node.module] if node.module else base)

    def _iterate_imports(self, tree: ast.AST, module: str) -> Iterator[tuple[str, str, int]]:
        """Yield the imported name, the stated module and the line of each import."""
        names = self.names[module] if module else self._collect_names(module, tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                yield from ((alias.name, alias.name, node.lineno) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                origin = self._origin(module, node)
                yield from ((f"{origin}:{a.name}", origin, node.lineno) for a in node.names)
            elif isinstance(node, ast.Constant) and node.value in self.paths and "." in node.value:
                yield node.value, node.value, node.lineno
            elif name := find_loaded_module(node, names):
                yield name, name, node.lineno
            elif isinstance(node, ast.Attribute):
                first, *rest = _attribute_chain(node) or [""]
                origin = names.get(first, "")
                if origin.partition(":")[0] in self.paths:
                    yield _join_names(origin, rest), "", node.lineno


def _join_names(origin: str, names: list[str]) -> str:
    """Return `module:a` with further attribute names as `module:a.b.c`."""
    return f"{origin}{'.' if ':' in origin else ':'}{'.'.join(names)}" if names else origin


def find_loaded_module(node: ast.AST, names: dict[str, str]) -> str | None:
    """Return the module that a call imports; "" for a computed name, None for other nodes."""
    if not isinstance(node, ast.Call) or not node.args:
        return None
    first, *rest = _attribute_chain(node.func) or [""]
    called = _join_names(names.get(first, first), rest).replace(":", ".").split(".")[-1]
    if called not in {"import_module", "__import__"}:
        return None
    name = node.args[0]
    return name.value if isinstance(name, ast.Constant) else ""


def _attribute_chain(node: ast.AST) -> list[str] | None:
    """Return `a.b.c` as ["a", "b", "c"]; None for anything but attributes of a name."""
    if isinstance(node, ast.Name):
        return [node.id]
    inner = _attribute_chain(node.value) if isinstance(node, ast.Attribute) else None
    return inner and [*inner, node.attr]

"""Imports flow one way, nothing happens on import, and diffrax stays in its room."""

import ast
import subprocess
import sys
from pathlib import Path

import vrw_jax

PACKAGE = Path(vrw_jax.__file__).parent


def imports_of(path):
    """Modules of the package that a file imports at its top level."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("vrw_jax"):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {name for name in names if (PACKAGE.parent / to_path(name)).exists()}
            if not (PACKAGE.parent / to_path(node.module)).is_dir():
                found.add(node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith("vrw_jax.")}
    return found


def to_path(module):
    base = PACKAGE.parent / Path(*module.split("."))
    return base if base.is_dir() else base.with_suffix(".py")


def test_imports_have_no_cycle():
    graph = {}
    for path in PACKAGE.rglob("*.py"):
        name = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        if path.name != "__init__.py":
            graph[name] = imports_of(path)
    order, seen = [], {}

    def visit(name, trail):
        if seen.get(name) == "done":
            return
        assert seen.get(name) != "open", " -> ".join([*trail, name])
        seen[name] = "open"
        for other in graph.get(name, ()):
            visit(other, [*trail, name])
        seen[name] = "done"
        order.append(name)

    for name in graph:
        visit(name, [])
    flow = ["params", "geometry", "dynamics", "transitions", "integrate", "return_map"]
    for index, room in enumerate(flow):
        later = {f"vrw_jax.{other}" for other in flow[index + 1 :]}
        assert not later & graph[f"vrw_jax.{room}"], room


def test_only_integrate_knows_diffrax():
    users = {p.name for p in PACKAGE.rglob("*.py") if "import diffrax" in p.read_text()}
    assert users == {"integrate.py", "lazy.py"}


def test_nothing_imports_the_command_line_or_plots_at_the_top():
    for path in PACKAGE.rglob("*.py"):
        if path.name in {"cli.py", "__main__.py"}:
            continue
        assert "vrw_jax.cli" not in imports_of(path), path


HEAVY = {
    "diffrax", "distributed", "matplotlib", "optax", "rich", "scipy.optimize", "scipy.stats",
    "typer", "xarray", "zarr",
}  # fmt: skip


def test_import_loads_nothing_that_only_some_need():
    code = f"import vrw_jax, sys; loaded = {HEAVY} & set(sys.modules); assert not loaded, loaded"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_import_changes_no_global_setting():
    code = (
        "import jax; before = jax.config.values.copy(); import vrw_jax; "
        "assert before == jax.config.values"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_rooms_stay_small():
    # A room past some 500 lines is cut by question; 600 is where it is refused.
    for path in PACKAGE.rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 600, path.name

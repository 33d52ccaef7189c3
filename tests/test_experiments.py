"""Every experiment can be imported without effects, and its help states its command."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path
    for path in sorted((ROOT / "experiments").glob("*/**/*.py"))
    if path.name != "__init__.py"
}
START_SCRIPT = """
import ast, contextlib, importlib, inspect, io, json, os, runpy, sys, types
from jax._src import xla_bridge

def gone(module):
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            other = getattr(module, node.value.id, None)
            if isinstance(other, types.ModuleType) and not hasattr(other, node.attr):
                yield f"{node.value.id}.{node.attr}"

results = {}
environment, cores = dict(os.environ), getattr(os, "sched_getaffinity", lambda _: None)(0)
for name in sys.argv[1:]:
    out, sys.argv, absent = io.StringIO(), [name, "--help"], []
    try:
        absent = list(gone(importlib.import_module(name)))
        with contextlib.redirect_stdout(out):
            runpy.run_module(name, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        out.write(end.code if isinstance(end.code, str) else "")
    touched = [what for what, yes in {
        "arrays": xla_bridge._backends, "environment": environment != dict(os.environ),
        "cores": cores != getattr(os, "sched_getaffinity", lambda _: None)(0),
    }.items() if yes]
    results[name] = out.getvalue(), touched, absent
print(json.dumps(results))
"""
"""Script that imports each module and runs it with `--help`. It prints the output, the global state
that has changed, and the missing names that the module uses of other modules."""


@pytest.fixture(scope="module")
def experiment_outputs():
    """Return the results by module, all from one process."""
    outside = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    command = [sys.executable, "-W", "ignore", "-c", START_SCRIPT, *MODULES]
    out = subprocess.run(command, cwd=ROOT, env=outside, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


@pytest.mark.parametrize("module", MODULES)
def test_an_experiment_starts_and_prints_its_command(module, experiment_outputs):
    text = MODULES[module].read_text()
    result, touched, absent = experiment_outputs[module]
    if result.startswith("This experiment needs"):
        assert 'pip install -e ".[experiments]"' in result
        pytest.skip(result)
    assert not touched, f"by importing {module}"
    assert not absent
    assert ast.get_docstring(ast.parse(text))
    if '__name__ == "__main__"' in text:
        assert result.startswith(f"usage: python -m {module}")
        assert f"python -m {module}" in result.split("\n\n", 1)[1]


def test_folders_of_experiments_have_a_docstring():
    for folder in {path.parent for path in MODULES.values()}:
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text())), folder

"""Every notebook runs from top to bottom and prints the stored text."""

import ast
import os
import re
import types
from pathlib import Path

import jax
import pytest

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MAX_NOTEBOOK_BYTES = 400_000
"""Bytes of a stored notebook, pictures included."""


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} >= {
        "branch", "force_peaks", "ground", "identification", "sensitivities", "tolerances",
        "tuning", "uneven_ground",
    }  # fmt: skip


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_executed_and_small(path):
    assert path.stat().st_size < MAX_NOTEBOOK_BYTES
    cells = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    assert all(cell.execution_count for cell in cells)
    assert not re.search(r"/(home|root|work|tmp)/", path.read_text())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_imports_of_a_notebook_exist(path):
    cells = [c.source for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    lines = [line for cell in cells for line in cell.splitlines()]
    for line in (line for line in lines if re.match(r"(from|import) .*\bvrw_jax\b", line)):
        exec(line, {})


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_names_of_modules_in_a_notebook_exist(path):
    cells = [c.source for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    tree = ast.parse(
        "\n".join(line for cell in cells for line in cell.splitlines() if line[:1] != "%")
    )
    names = {}
    imports = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(ast.Module(imports, []), path.name, "exec"), names)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = names.get(node.value.id)
            if isinstance(module, types.ModuleType):
                assert hasattr(module, node.attr), f"{node.value.id}.{node.attr}"


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_prints_its_stored_output(path, monkeypatch):
    cache = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", os.environ.get("VRW_TEST_CACHE", cache))
    stored = nbformat.read(path, as_version=4)
    run = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(run, timeout=900, kernel_name="python3").execute()
    for before, after in zip(stored.cells, run.cells, strict=True):
        if before.cell_type == "code":
            assert collect_printed_text(after) == collect_printed_text(before)


def collect_printed_text(cell: object) -> str:
    """Return the printed text of a cell, numbers with three digits, without pictures and reprs."""
    text = "".join(o.text for o in cell.outputs if o.output_type == "stream" and o.name == "stdout")
    return re.sub(r"-?\d+\.?\d*(e-?\d+)?", lambda m: f"{float(m[0]):.3g}", text)

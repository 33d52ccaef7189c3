"""`vrw new` writes a skeleton of a walker that passes its own test."""

import os
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from vrw_jax.app.commands import app


def run(*arguments):
    return CliRunner().invoke(app, ["new", *map(str, arguments)])


@pytest.mark.slow
def test_the_skeleton_passes_its_own_test(tmp_path):
    assert run("robot", "--out", tmp_path).exit_code == 0
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_robot.py"]
    environment = os.environ | {"MPLBACKEND": "Agg"}
    result = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert "4 passed" in result.stdout, result.stdout[-2000:]


def test_files_have_the_name_and_are_never_overwritten(tmp_path):
    assert run("robot", "--out", tmp_path / "new").exit_code == 0
    walker, test = (tmp_path / "new" / name for name in ("robot.py", "test_robot.py"))
    assert "my_walker" not in walker.read_text() + test.read_text()
    compile(walker.read_text(), "robot.py", "exec")
    assert "import robot" in test.read_text()
    walker.unlink()
    test.write_text("mine")
    result = run("robot", "--out", tmp_path / "new")
    assert result.exit_code == 2
    assert "is there already" in " ".join(result.stderr.split())
    assert not walker.exists()
    assert test.read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a-b", "letters, digits and underscores"),
        ("class", "letters, digits"),
        ("numpy", "another"),
        ("np", "is a name in the skeleton itself"),
        ("params", "is a name in the skeleton itself"),
        ("__main__", "of an installed module or of Python"),
    ],
)
def test_a_name_that_python_cannot_import_is_refused(name, message, tmp_path):
    result = run(name, "--out", tmp_path)
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())
    assert not list(tmp_path.iterdir())

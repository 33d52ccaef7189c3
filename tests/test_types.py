"""mypy and pyright accept the README as it is written, and refuse what can be seen to be wrong."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

VALID_CODE = """
import numpy as np

tuned = vrw.tune(params, "dls_fraction", ["damping"], {"damping": (100.0, 200.0)})
print(tuned.step.margins.contraction, tuned.cycle.speed)
batch = vrw.WheelParams(damping=np.linspace(1.0, 2.0, 3), slope=0.3)
print(vrw.step_batch(batch, np.ones((3, 3)), engine="lanes").n_stepped)
print(vrw.StepOptions(solver="Tsit5", rtol=1e-8).rtol)
print(vrw.UnilateralWheel(friction=0.7).friction)
"""
"""Lines of other pages."""

INVALID_CODE = """import vrw_jax as vrw

vrw.WheelParams(damping="fast")
vrw.step_batch(vrw.WheelParams(), vrw.paper_start()[None], engine="lane")
vrw.StepOptions(solver="RK4")
vrw.StepOptions(rtol="small")
vrw.CycleOptions(mesh_intervals=(1, 2))
vrw.UnilateralWheel(stoppers="none")
vrw.UnilateralWheel(friction="high")
vrw.step(vrw.WheelParams(), vrw.paper_start(), options=vrw.CycleOptions())
vrw.limit_cycle({"damping": 200.0})
vrw.step(vrw.WheelParams(), vrw.paper_start(), model="rigid")
"""


@pytest.fixture(scope="module")
def checked_folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("typed")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    (place / "good.py").write_text("\n".join(blocks) + VALID_CODE)
    (place / "bad.py").write_text(INVALID_CODE)
    settings = {"typeCheckingMode": "standard", "extraPaths": [str(ROOT)]}
    (place / "pyrightconfig.json").write_text(json.dumps(settings))
    return place


def is_line_refused(checked_folder: Path, command: list[str], line: str) -> dict[str, set[int]]:
    """Lines with an error by file."""
    env = os.environ | {"MYPYPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=checked_folder,
        env=env,
        capture_output=True,
        text=True,
    )
    result: dict[str, set[int]] = {"good.py": set(), "bad.py": set()}
    for name, number in re.findall(line, run.stdout, re.M):
        result[name].add(int(number))
    assert result["bad.py"], run.stdout + run.stderr
    return result


@pytest.mark.parametrize(
    ("command", "line"),
    [
        (
            # With the settings of the library's own check, so that its cache is used again.
            [
                "mypy",
                "--config-file",
                str(ROOT / "pyproject.toml"),
                "--cache-dir",
                str(ROOT / ".mypy_cache"),
                "good.py",
                "bad.py",
            ],
            r"^(\w+\.py):(\d+): error",
        ),
        pytest.param(
            ["basedpyright", "--pythonpath", sys.executable, "--level", "error", "."],
            r"/(\w+\.py):(\d+):\d+ - error",
            marks=pytest.mark.slow,
        ),
    ],
    ids=("mypy", "pyright"),
)
def test_a_checker_accepts_the_readme_and_refuses_each_bad_line(checked_folder, command, line):
    result = is_line_refused(checked_folder, command, line)
    assert not result["good.py"]
    assert result["bad.py"] == set(range(3, 3 + len(INVALID_CODE.splitlines()) - 2))

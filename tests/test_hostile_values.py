"""For invalid values of every argument, a call returns or raises one sentence of this library."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def test_every_argument_of_the_public_functions_takes_or_refuses_hostile_values(tmp_path):
    cache = os.environ.get("VRW_TEST_CACHE", ROOT / ".jax_cache")
    run = subprocess.run(
        [sys.executable, ROOT / "tests/support/hostile.py", str(cache), "10"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr[-2000:]


@pytest.mark.slow
def test_random_calls_by_their_seed_end_without_a_fault(tmp_path):
    run = subprocess.run(
        [sys.executable, "-m", "experiments.hardening.random_calls", tmp_path, "60", "--seed", "7"],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr[-2000:]
    assert len((tmp_path / "random_calls.log").read_text().splitlines()) == 60

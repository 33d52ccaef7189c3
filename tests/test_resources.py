"""Batches of many sizes do not accumulate compiled programs."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent


def test_random_batch_sizes_of_gaits_and_steps_add_no_programs(tmp_path):
    """One program per batch size would add some 240 memory maps at each call of `limit_cycles`."""
    command = [
        sys.executable, "-m", "experiments.hardening.resources", tmp_path, "--calls", "40",
        "--functions", "limit_cycles", "step_batch",
    ]  # fmt: skip
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr[-2000:]
    assert "limit_cycles: plateau" in run.stdout
    assert "step_batch: plateau" in run.stdout

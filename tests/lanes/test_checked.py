"""Signatures of `lanes` hold; other tests do not check signatures of this package."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_all_signatures_are_type_checked_while_code_is_generated():
    """In a process of its own: what is checked is settled when the library is imported."""
    tests = Path(__file__).with_name("test_simd.py")
    selection = ["-k", "float64 or loops or scans or noinline or powers"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", tests,
         *selection],
        env={**os.environ, "VRW_TEST_UNCHECKED": "none"}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-2000:]

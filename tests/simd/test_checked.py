"""Signatures of the room that writes machine code hold: the one room that other tests leave out."""

import os
import subprocess
import sys
from pathlib import Path


def test_code_is_written_with_every_signature_of_the_room_checked():
    """In a process of its own: what is checked is settled when the library is imported."""
    tests = Path(__file__).with_name("test_simd.py")
    some = ["-k", "float64 or loops or scans or set_apart or powers"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", tests, *some],
        env={**os.environ, "VRW_TEST_UNCHECKED": "none"}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-2000:]

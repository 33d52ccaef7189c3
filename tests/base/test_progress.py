"""Long calls print what they compile, once, and show their progress in a terminal."""

import io
import os
import subprocess
import sys
import time

import pytest

import vrw_jax as vrw
from vrw_jax.base import progress

QUICK_FUNCTIONS = {
    "default_margins", "explore", "grid", "measure", "open_scan", "paper_start", "parameter",
    "saltelli", "samples", "sobol", "sobol_indices", "start_jax", "uniform",
}  # fmt: skip
"""Public functions that compile nothing and read or compute for less than a second."""


class Terminal(io.StringIO):
    """Standard error of a terminal."""

    def isatty(self) -> bool:
        return True


@progress.announce_wait("a slow program", "40 s")
def wait_for(seconds: float) -> str:
    progress.report_progress("half of it")
    time.sleep(seconds)
    return wait_for(0.0) if seconds else "done"


@pytest.fixture
def brief_silence(monkeypatch):
    monkeypatch.delenv(progress.PROGRESS_VARIABLE)
    monkeypatch.setattr(progress, "SILENT_SECONDS", 0.1)
    monkeypatch.setattr(progress, "UPDATE_INTERVAL", 0.05)


@pytest.mark.parametrize("stream", [io.StringIO(), Terminal()])
def test_a_long_call_prints_once_what_it_compiles_and_how_long_that_takes(
    stream, brief_silence, monkeypatch
):
    monkeypatch.setattr(sys, "stderr", stream)
    assert wait_for(0.6) == "done"
    lines = stream.getvalue().split("\n")
    assert lines[0].startswith("wait_for: the first call of a process compiles a slow program")
    assert "about 40 s" in lines[0]
    assert stream.getvalue().count("compiles") == 1
    # Only a terminal has a line of progress, which is erased at the end.
    assert ("0 s half of it" in lines[1]) == stream.isatty()
    assert not lines[1].split("\r")[-2:][0].strip()


def test_short_calls_and_calls_with_notices_switched_off_print_nothing(
    brief_silence, monkeypatch, capsys
):
    assert wait_for(0.01) == "done"
    monkeypatch.setenv(progress.PROGRESS_VARIABLE, "0")
    assert wait_for(0.4) == "done"
    assert capsys.readouterr().err == ""


def test_the_call_after_an_error_has_a_notice_of_its_own(brief_silence, capsys):
    with pytest.raises(ValueError, match="sleep length"):
        wait_for(-1.0)
    wait_for(0.4)
    assert capsys.readouterr().err.count("wait_for") == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked on Linux and macOS")
def test_a_child_that_is_forked_while_a_notice_is_printed_can_call():
    program = """
import io, os, sys, time, warnings
from vrw_jax.base import progress

class SlowStream(io.StringIO):
    def write(self, text):
        time.sleep(0.5)
        return len(text)

@progress.announce_wait("a slow program", "40 s")
def wait_and_fork(seconds):
    time.sleep(seconds)
    return os.fork() if seconds else 0

progress.SILENT_SECONDS, progress.UPDATE_INTERVAL = 0.1, 0.05
warnings.simplefilter("ignore")
sys.stderr = SlowStream()
child = wait_and_fork(0.4)
if child == 0:
    wait_and_fork(0.0)
    os._exit(0)
end = time.monotonic() + 10.0
while not (ended := os.waitpid(child, os.WNOHANG)[0]) and time.monotonic() < end:
    time.sleep(0.01)
if not ended:
    os.kill(child, 9)
print("ended" if ended else "hangs")
"""
    environment = {**os.environ, "VRW_PROGRESS": ""}
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    assert result.stdout == "ended\n"


def test_every_public_function_that_may_last_long_announces_this():
    functions = {name for name in vrw.__all__ if type(getattr(vrw, name)).__name__ == "function"}
    announcing = {name for name in functions if hasattr(getattr(vrw, name), "announces_wait")}
    assert functions - announcing == QUICK_FUNCTIONS


@pytest.mark.slow  # compiles without a cache
def test_a_curve_of_a_special_point_is_not_silent_for_five_seconds(tmp_path):
    """The reference is the clock: the time between the first call and the first line."""
    program = """
import sys, time
import vrw_jax as vrw
vrw.start_jax(sys.argv[1])
cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
print("start", file=sys.stderr, flush=True)
vrw.continue_special_point("clearance_sls1", ("damping", "stiffness"), cycle)
"""
    command = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env={**os.environ, "VRW_PROGRESS": ""}
    ) as process:
        start_seconds = None
        for line in process.stderr:
            if line == "start\n":
                start_seconds = time.monotonic()
            elif line.startswith("continue_special_point: the first call"):
                assert time.monotonic() - start_seconds < 5.0
                process.kill()
                return
    raise AssertionError("no line was printed")

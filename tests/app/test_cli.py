"""The command line: it teaches, it says what is wrong in one sentence, and it writes what it says.

Scans here are computed by the stand-in of support.scanning; one gait is walked for real.
"""

import subprocess
import sys
from pathlib import Path

import pytest
from support.scanning import Counted, arithmetic
from typer.testing import CliRunner, Result

from vrw_jax.app.cli import app
from vrw_jax.app.printing import scan_reporter
from vrw_jax.scans.planning import Plan
from vrw_jax.scans.running import Progress
from vrw_jax.scans.store import open_scan

SCAN = """
[grid]
damping = { from = 100.0, to = 200.0, count = 4 }
slope = { from = 0.26, to = 0.32, count = 3 }
stiffness = [450.0, 500.0]
[scan]
measures = ["dls_fraction", "speed", "d dls_fraction / d damping"]
chunk = 6
"""


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(Plan, "engine", lambda _: arithmetic)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))  # leave the suite's own as it is
    path = tmp_path / "small.toml"
    path.write_text(SCAN)
    return path


def vrw(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_help_teaches() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "vrw_jax", "--help"], capture_output=True, text=True, check=True
    )
    for word in ("gait", "reproduce", "scan", "Examples", "configs/quickstart.toml"):
        assert word in done.stdout


@pytest.mark.parametrize("command", ["gait", "reproduce", "scan"])
def test_every_command_has_help(command: str) -> None:
    told = vrw(command, "--help")
    assert told.exit_code == 0
    assert "--help" in told.output


def test_the_version_is_told() -> None:
    told = vrw("--version")
    assert told.exit_code == 0
    assert told.output.startswith("vrw ")


MISTAKES = {
    "missing config": (("scan", "nowhere.toml"), "no config file nowhere.toml"),
    "misspelt config": (("scan", "smal.toml"), "did you mean 'small.toml'"),
    "no design": (("scan", "plain.toml"), "a scan needs a design"),
    "bad config": (("gait", "bad.toml"), "did you mean 'damping'"),
    "no assignment": (("gait", "--set", "damping"), "has no '='"),
    "unknown parameter": (("gait", "--set", "dampin=3"), "did you mean 'damping'"),
    "out of its domain": (("gait", "--set", "damping=-3"), "must lie in"),
    "mass beyond the hub": (("gait", "--set", "leg_com=1.5"), "leg_com < locked_length"),
    "no folder": (("scan", "small.toml", "--out", "plain.toml"), "plain.toml"),
    "no scheduler": (("scan", "small.toml", "--dask", "nowhere://"), "no dask scheduler answers"),
    "no scan there": (("scan", "small.toml", "--out", "occupied"), "no scan's store"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_gets_one_sentence_on_stderr_and_exit_code_2(mistake: str, config: Path) -> None:
    (config.parent / "plain.toml").write_text("[wheel]\nslope = 0.3\n")
    (config.parent / "bad.toml").write_text("[wheel]\ndampin = 3\n")
    (config.parent / "occupied" / "scan.zarr").mkdir(parents=True)
    (config.parent / "occupied" / "scan.zarr" / "letter.txt").write_text("dear reader")
    arguments, expected = MISTAKES[mistake]
    told = vrw(*arguments)
    assert told.exit_code == 2
    assert expected in told.stderr
    assert told.stderr.startswith("vrw: ")
    assert len(told.stderr.strip().splitlines()) == 1
    assert "Traceback" not in told.output


def test_explain_tells_the_size_and_computes_nothing(config: Path) -> None:
    told = vrw("scan", config, "--explain")
    assert told.exit_code == 0
    for word in (
        "24 (4 damping x 3 slope x 2 stiffness)",
        "4 of up to 6 samples",
        "memory",
        "time",
    ):
        assert word in told.stdout
    assert not (config.parent / "results").exists()


def test_progress_tells_rate_failures_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first chunk's time is compiling too, and counts for nothing."""
    clock = iter([0.0, 100.0, 110.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    told: list[dict] = []
    report = scan_reporter(lambda _, **shown: told.append(shown), 0)
    for done, failed in ((0, 0), (1000, 100), (3000, 300)):
        report(Progress(samples=6_000, done=done, failed=failed, kept=0))
    assert [shown["description"] for shown in told] == ["compiling", "scanning", "scanning"]
    assert told[1]["note"] == "10 % without a gait"
    assert told[2]["note"] == "200 per s, 10 % without a gait, 15 s left"
    assert told[2]["completed"] == 3000
    assert told[2]["total"] == 6_000


def test_a_scan_writes_data_and_pictures_where_it_says(config: Path) -> None:
    told = vrw("scan", config)
    assert told.exit_code == 0, told.output
    folder = config.parent / "results" / "small"
    data = open_scan(folder / "scan.zarr")
    assert dict(data.sizes) == {"damping": 4, "slope": 3, "stiffness": 2, "leg": 6}
    assert data.attrs["config"] == SCAN
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert pictures == ["scan_over_stiffness.png"]
    for name in ("scan.zarr", *pictures):
        assert name in told.stdout
    assert "STEPPED" in told.stdout


def test_a_stopped_scan_says_how_to_go_on_and_does(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Plan, "engine", lambda _: Counted(fails_at=3))
    stopped = vrw("scan", config)
    assert stopped.exit_code == 130
    assert "run the same to go on" in " ".join(stopped.stderr.split())
    rest = Counted()
    monkeypatch.setattr(Plan, "engine", lambda _: rest)
    assert vrw("scan", config).exit_code == 0
    assert rest.calls == 2
    again = vrw("scan", config)
    assert again.exit_code == 0
    assert "nothing to compute" in again.stdout
    assert rest.calls == 2


def test_a_scan_with_other_settings_is_refused_in_the_same_place(config: Path) -> None:
    assert vrw("scan", config, "--no-picture").exit_code == 0
    config.write_text(SCAN + "[wheel]\nleg_com = 0.4\n")
    told = vrw("scan", config)
    assert told.exit_code == 2
    assert "wheel.leg_com is 0.3 there and 0.4 here" in told.stderr


@pytest.mark.parametrize(
    "design",
    [
        "[grid]\ndamping = [100.0, 150.0, 200.0]",
        "[grid]\nstiffness = [400.0, 500.0]\nslope = [0.29, 0.3, 0.31]",
        "[sobol]\nn = 16\ndamping = [100.0, 200.0]\nslope = [0.28, 0.3]",
        "[uniform]\nn = 5\nstiffness = [400.0, 500.0]",
        "[samples]\nleg_mass = [0.9, 1.0]\ngravity = [9.8, 9.9]",
    ],
)
def test_every_kind_of_design_gets_a_picture(design: str, config: Path) -> None:
    config.write_text(design)
    measures = '\n[scan]\nmeasures = ["dls_fraction", "speed", "d dls_fraction / d damping"]\n'
    config.write_text(design + measures)
    told = vrw("scan", config, "--out", "here")
    assert told.exit_code == 0, told.output
    assert (config.parent / "here" / "scan.png").stat().st_size > 5000


def test_many_parameters_at_once_are_drawn_in_pairs_with_their_sobol_indices(config: Path) -> None:
    config.write_text(
        "[saltelli]\nn = 256\ndamping = [100.0, 101.0]\nslope = [0.29, 0.3]\n"
        'stiffness = [500.0, 500.5]\n[scan]\nmeasures = ["dls_fraction", "speed"]\n'
    )
    told = vrw("scan", config, "--out", "here")
    assert told.exit_code == 0, told.output
    for name in ("scan_pairs.png", "sobol_indices.png"):
        assert (config.parent / "here" / name).stat().st_size > 5000


def test_a_gait_is_told_with_its_premises(config: Path) -> None:
    told = vrw("gait", "--steps", 2)
    assert told.exit_code == 0, told.output
    for words in ("DLS fraction", "0.53", "stable: multipliers 0.3286", "6 are broken"):
        assert words in told.stdout

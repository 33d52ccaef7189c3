"""The command line: it teaches, it says what is wrong in one sentence, and it writes what it says.

Scans here are computed by the stand-in of support.scanning; one gait is walked for real.
"""

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.scanning import Counted, arithmetic
from typer.testing import CliRunner, Result

from vrw_jax.app import cli, scanning
from vrw_jax.app.cli import app
from vrw_jax.app.config import parse
from vrw_jax.app.printing import scan_reporter
from vrw_jax.branches.branch import Branch
from vrw_jax.scans import forecast
from vrw_jax.scans.planning import Plan
from vrw_jax.scans.running import Progress
from vrw_jax.scans.store import open_scan
from vrw_jax.wheel.outcomes import Outcome

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


def test_explain_measures_some_samples_and_writes_nothing(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 10.0, 12.0])
    monkeypatch.setattr(forecast, "perf_counter", lambda: next(clock))
    told = vrw("scan", config, "--explain")
    assert told.exit_code == 0, told.output
    said = " ".join(told.stdout.split())
    assert "about 7 s: 24 samples at 12 per second" in said
    assert "the code for it took 10 s and is kept" in said
    for word in (
        "24 (4 damping x 3 slope x 2 stiffness)",
        "4 of up to 6 samples",
        "memory",
        "time",
    ):
        assert word in said
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


def test_help_shows_brackets_and_every_command(config: Path) -> None:
    assert "[branch]" in vrw("continue", "--help").output
    for command in ("init", "tune", "continue"):
        assert vrw(command, "--help").exit_code == 0


def test_init_writes_the_example_configs_and_nothing_twice(config: Path) -> None:
    examples = Path(__file__).parents[2] / "configs"
    told = vrw("init", "mine")
    assert told.exit_code == 0, told.output
    for path in examples.glob("*.toml"):
        assert (config.parent / "mine" / path.name).read_text() == path.read_text()
        assert path.name in told.stdout
    again = vrw("init", "mine")
    assert again.exit_code == 0
    assert "nothing to write" in again.stdout


def test_an_installed_wheel_brings_the_example_configs() -> None:
    told = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    built = told["tool"]["hatch"]["build"]["targets"]["wheel"]
    package = Path(cli.__file__).parents[1].name
    assert built["force-include"]["configs"] == f"{package}/configs"
    assert cli._examples().name == "configs"


def test_verify_tells_whether_a_store_is_complete_and_sound(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Plan, "engine", lambda _: Counted(fails_at=3))
    assert vrw("scan", config, "--no-picture").exit_code == 130
    told = vrw("scan", config, "--verify")
    assert told.exit_code == 0
    assert "lacks 2 of 4 chunks" in told.stdout
    monkeypatch.setattr(Plan, "engine", lambda _: arithmetic)
    assert vrw("scan", config, "--no-picture").exit_code == 0
    assert "is complete and sound" in vrw("scan", config, "--verify").stdout
    file = config.parent / "results" / "small" / "scan.zarr" / "speed" / "c" / "1" / "0" / "0"
    file.unlink()
    told = vrw("scan", config, "--verify")
    assert told.exit_code == 1
    assert "1 damaged chunk (number 1): run the same without --verify" in told.stderr
    assert not file.exists()
    rest = Counted()
    monkeypatch.setattr(Plan, "engine", lambda _: rest)
    again = vrw("scan", config, "--no-picture")
    assert again.exit_code == 0
    assert "1 damaged chunk (number 1): computed again" in again.stderr
    assert rest.calls == 1


def test_a_branch_without_a_gait_says_so_and_writes_nothing(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = Branch("damping", xr.Dataset(coords={"damping": ("point", np.zeros(0))}), (),
                  ("", ""), Outcome.NO_CYCLE_FOUND)  # fmt: skip
    monkeypatch.setattr("vrw_jax.branches.continue_branch", lambda *_, **__: none)
    config.write_text('[branch]\nparameter = "damping"\nbounds = [290.0, 300.0]\n')
    told = vrw("continue", config)
    assert told.exit_code == 1
    assert "there is no gait to start from (NO_CYCLE_FOUND" in told.stderr
    assert not (config.parent / "results").exists()


RUNGS = {
    "viscoelastic": ("", 1.0),
    "unilateral": ("friction = 0.6\n", 0.6),
    "rigid": ("held_landing = true\n", 1.0),
    "auto": ("friction = 0.5\n", 0.5),
}


@pytest.mark.parametrize("rung", RUNGS)
def test_a_config_names_any_rung_and_its_ground(rung: str) -> None:
    settings, friction = RUNGS[rung]
    model = parse(f'[model]\nrung = "{rung}"\n{settings}').wheel_model()
    assert model.rung == {"auto": "ladder"}.get(rung, rung)
    assert float(model.friction) == friction


@pytest.mark.parametrize("rung", ["unilateral", "auto"])
def test_friction_is_swept_on_real_ground_and_on_the_ladder(rung: str) -> None:
    told = parse(
        f'[model]\nrung = "{rung}"\n[grid]\nfriction = [0.4, 0.8]\nslope = [0.3]\n'
        '[scan]\nmeasures = ["slip", "d speed / d damping"]'
    )
    planned = scanning.planned_scan(told, None)
    assert planned.design.names == ("friction", "slope")
    assert planned.asked == ("slip", "d speed / d damping")
    assert planned.for_engine.model.rung == {"auto": "ladder"}.get(rung, rung)


def test_a_gait_of_rigid_legs_is_told(config: Path) -> None:
    config.write_text('[wheel]\nslope = 0.1\n[model]\nrung = "rigid"\n[gait]\nsteps = 3\n')
    told = vrw("gait", config)
    assert told.exit_code == 0, told.output
    assert "Walked 3 steps" in told.stdout
    assert "stable: multipliers" in told.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "serves"), [(20.0, "paper's wheel serves"), (0.7, "break")])
def test_a_gait_of_the_lowest_rung_says_which_and_why(
    config: Path, friction: float, serves: str
) -> None:
    config.write_text(
        f'[wheel]\ndamping = 180.0\n[model]\nrung = "auto"\nfriction = {friction}\n'
        "[gait]\nsteps = 2\n"
    )
    told = vrw("gait", config)
    assert told.exit_code == 0, told.output
    assert serves in told.stdout
    assert "slip per step" in told.stdout
    assert "0.0000," not in told.stdout  # of 28 multipliers 24 vanish: they are counted


STOPPED = """
import sys, time
sys.path.insert(0, {tests!r})
from vrw_jax.scans.planning import Plan
def slow(columns):
    while True:
        try:
            print("at work", flush=True)
            time.sleep(60)
        except KeyboardInterrupt:
            print("stopping", flush=True)
            time.sleep(60)
Plan.engine = lambda _: slow
sys.argv = ["vrw", "scan", {config!r}]
from vrw_jax.app import main
main()
"""


def test_a_second_ctrl_c_ends_a_scan_at_once_with_one_sentence(config: Path) -> None:
    code = STOPPED.format(tests=str(Path(__file__).parents[1]), config=str(config))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], text=True, **pipes) as process:  # type: ignore[call-overload]
        for line in ("at work", "stopping"):
            while line not in (told := process.stdout.readline()):
                assert told, process.stderr.read()
            process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
        told = process.stderr.read()
    assert "vrw: stopped at once; run the same to go on." in told
    assert "Traceback" not in told

"""The command line: its help, its errors of one sentence, and its files.

The substitute engine of support.scanning computes the scans here; one gait is walked by the
library.
"""

import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from support.scanning import CountingEngine, evaluate_arithmetically
from support.slow_variants import mark_slow
from typer.testing import CliRunner, Result

import vrw_jax as vrw
from vrw_jax.app import commands as cli
from vrw_jax.app import scanning
from vrw_jax.app.commands import app
from vrw_jax.app.config import parse_config
from vrw_jax.app.output import make_scan_progress_reporter, replace_unencodable_characters
from vrw_jax.studies import ScanPlan, ScanProgress, SpecialPointMap

SCAN_CONFIG = """
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
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: evaluate_arithmetically)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", cache)  # for child processes
    path = tmp_path / "small.toml"
    path.write_text(SCAN_CONFIG)
    return path


def run_command(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_help_lists_commands_and_examples() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "vrw_jax", "--help"], capture_output=True, text=True, check=True
    )
    for word in ("gait", "reproduce", "scan", "Examples", "configs/quickstart.toml"):
        assert word in done.stdout


@pytest.mark.parametrize("command", ["gait", "reproduce", "scan"])
def test_every_command_has_help(command: str) -> None:
    result = run_command(command, "--help")
    assert result.exit_code == 0
    assert "--help" in result.output


def test_the_version_is_printed() -> None:
    result = run_command("--version")
    assert result.exit_code == 0
    assert result.output.startswith("vrw ")


def test_explain_measures_some_samples_and_writes_nothing(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 10.0, 12.0])
    monkeypatch.setattr(scanning, "perf_counter", lambda: next(clock))
    result = run_command("scan", config, "--explain")
    assert result.exit_code == 0, result.output
    message = " ".join(result.stdout.split())
    assert "about 7 s: 24 samples at 12 per second" in message
    assert "the code for it took 10 s and is kept" in message
    for word in (
        "24 (4 damping x 3 slope x 2 stiffness)",
        "4 of up to 6 samples",
        "memory",
        "time",
    ):
        assert word in message
    assert not (config.parent / "results").exists()


def test_progress_shows_rate_failures_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of the first chunk includes compilation and does not count."""
    clock = iter([0.0, 100.0, 110.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    result: list[dict] = []
    report = make_scan_progress_reporter(lambda _, **bar_state: result.append(bar_state), 0)
    for done, failed in ((0, 0), (1000, 100), (3000, 300)):
        report(ScanProgress(n_samples=6_000, n_done=done, n_failed=failed, n_reused=0))
    assert [bar_state["description"] for bar_state in result] == [
        "compiling",
        "scanning",
        "scanning",
    ]
    assert result[1]["note"] == "10 % without a gait"
    assert result[2]["note"] == "200 per s, 10 % without a gait, 15 s left"
    assert result[2]["completed"] == 3000
    assert result[2]["total"] == 6_000


def test_the_bar_of_a_resumed_scan_includes_the_earlier_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of 10,000 samples 4,000 are from an earlier run; rate and time left are those of this run."""
    clock = iter([0.0, 100.0, 110.0])
    monkeypatch.setattr("time.monotonic", lambda: next(clock))
    result: list[dict] = []
    report = make_scan_progress_reporter(lambda _, **bar_state: result.append(bar_state), 0)
    for done in (0, 1000, 3000):
        report(ScanProgress(n_samples=6_000, n_done=done, n_failed=0, n_reused=4_000))
    assert [(bar_state["completed"], bar_state["total"]) for bar_state in result] == [
        (4_000, 10_000), (5_000, 10_000), (7_000, 10_000),
    ]  # fmt: skip
    assert result[0]["note"] == "4,000 from an earlier run"
    assert result[2]["note"] == "200 per s, 0 % without a gait, 15 s left"


@pytest.mark.parametrize(
    ("encoding", "words", "sentence"),
    [
        ("ascii", ["theta'-", "lambda4+", "N.s^2"], "vrw: phi >= 0 ... ?"),
        ("utf-8", ["θ̇⁻", "λ4⁺", "N·s²"], "vrw: φ ≥ 0 … Ω"),
        *mark_slow(("cp1252", ["theta'-", "lambda4+", "N·s²"], "vrw: phi >= 0 … ?")),
    ],
)
def test_characters_that_a_terminal_lacks_are_spelled(
    encoding: str, words: list[str], sentence: str
) -> None:
    code = (
        "from vrw_jax.app import output\n"
        "output.replace_unencodable_output()\n"
        'headings = ("quantity", "symbol", "unit")\n'
        'output.print_text_table("λ", [("θ̇⁻", "λ4⁺", "N·s²")], headings)\n'
        'output.print_error_sentence("φ ≥ 0 … Ω")'
    )
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "COLUMNS": "80"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment)
    assert done.returncode == 0, done.stderr
    heading, row = done.stdout.decode(encoding).splitlines()[-2:]
    assert row.split() == words
    assert done.stderr.decode(encoding).strip() == sentence
    if encoding == "ascii":  # columns are as wide as the spelled text
        assert heading.index("symbol") == row.index("lambda4+")
        assert heading.index("unit") == row.index("N.s^2")


def test_every_printed_symbol_has_a_spelling_in_ascii() -> None:
    for measure in vrw.MEASURES.values():
        for text in (measure.symbol, measure.long_name, measure.display_unit):
            spelled = replace_unencodable_characters(text, "ascii")
            assert "?" not in spelled, (text, spelled)


@pytest.mark.parametrize("encoding", mark_slow("ascii", "cp1252"))
def test_a_gait_is_printed_on_a_terminal_without_greek_letters(encoding: str) -> None:
    cache = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "COLUMNS": "200"}
    environment["JAX_COMPILATION_CACHE_DIR"] = str(cache)
    command = [sys.executable, "-m", "vrw_jax", "gait", "--steps", "2"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert "lambda4+" in done.stdout
    assert "stable: multipliers 0.32862, 0.02231" in done.stdout
    assert done.stderr == ""


def test_a_map_prints_its_stages_after_the_scan(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config.write_text(
        "[grid]\ndamping = [100.0, 150.0]\nslope = [0.28, 0.3]\n"
        '[scan]\nmeasures = ["dls_fraction"]\n'
    )
    evaluate = lambda columns: {
        **evaluate_arithmetically(columns),
        "lambda_4_plus": columns["slope"],
    }
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: evaluate)

    def follow(
        scan: xr.Dataset, base: object, model: object, on_stage: Callable
    ) -> SpecialPointMap:
        on_stage("following special points: fold")
        return SpecialPointMap(scan, (), ())

    monkeypatch.setattr("vrw_jax.app.commands.follow_special_points", follow)
    result = run_command("map", config)
    assert result.exit_code == 0, result.output
    stages = [line for line in result.stderr.splitlines() if line.endswith(" ...")]
    assert stages == ["following special points: fold ...", "drawing the map ..."]
    folder = config.parent / "results" / "small"
    assert (folder / "map.md").read_text().startswith("0 changes of sign")
    # A scan of the same config has other measures and its own store.
    assert run_command("scan", config, "--no-picture").exit_code == 0
    assert run_command("map", config).exit_code == 0


@pytest.mark.slow  # force peaks compile for a minute on a busy machine
def test_a_map_of_force_peaks_has_those_of_each_gait_on_the_mesh_of_the_config(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the default mesh the steps of these gaits do not repeat, so the map would have none."""
    config = tmp_path / "small.toml"
    config.write_text(
        "[wheel]\nnatural_length = 1.0\nslope = 0.075\n"
        "[grid]\nstiffness = [860.0, 900.0]\ndamping = [95.0, 105.0]\n"
        '[scan]\nmeasures = ["n_force_peaks", "peak_force", "second_peak_rate"]\n'
        "mesh_intervals = [40, 32, 16]\n"
    )
    monkeypatch.setattr(
        "vrw_jax.app.commands.follow_special_points", lambda scan, *_: SpecialPointMap(scan, (), ())
    )
    result = run_command("map", config, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    data = vrw.open_scan(tmp_path / "map.zarr")
    assert set(data.n_force_peaks.values.ravel()) == {1.0, 2.0}
    for i, j in ((0, 1), (1, 0)):
        wheel = vrw.WheelParams(
            stiffness=data.stiffness[i].item(), damping=data.damping[j].item(),
            natural_length=1.0, slope=0.075,
        )  # fmt: skip
        gait = vrw.limit_cycle(wheel)
        for name in ("n_force_peaks", "peak_force", "second_peak_rate"):
            # The rate is small beside its terms, so that its relative error is larger.
            np.testing.assert_allclose(data[name][i, j], gait.measure(name), rtol=1e-6)


def test_a_scan_writes_data_and_figures_to_the_printed_paths(config: Path) -> None:
    result = run_command("scan", config)
    assert result.exit_code == 0, result.output
    folder = config.parent / "results" / "small"
    data = vrw.open_scan(folder / "scan.zarr")
    assert dict(data.sizes) == {"damping": 4, "slope": 3, "stiffness": 2, "leg": 6}
    assert data.attrs["config"] == SCAN_CONFIG
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert pictures == ["scan_over_stiffness.png"]
    for name in ("scan.zarr", *pictures):
        assert name in result.stdout
    assert "STEPPED" in result.stdout


def test_figures_are_drawn_again_only_if_results_or_code_have_changed(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = config.parent / "results" / "small"
    # Another test draws the figures of a scan.
    draw = lambda dataset, width: {"scan_over_stiffness": Figure(figsize=(1.0, 1.0))}
    monkeypatch.setattr(vrw.plot, "scan_figures", draw)

    def scan_and_list_drawn_figures() -> list[str]:
        previous_times = {path: path.stat().st_mtime_ns for path in folder.glob("scan_over_*")}
        result = run_command("scan", config)
        assert result.exit_code == 0, result.output
        drawn = [
            p for p in folder.glob("scan_over_*") if p.stat().st_mtime_ns != previous_times.get(p)
        ]
        assert result.stdout.count("written: ") == len(drawn)
        assert result.stdout.count("up to date: ") == 2 - len(drawn)
        return sorted(path.suffix for path in drawn)

    both = [".png", ".svg"]
    assert scan_and_list_drawn_figures() == both
    assert scan_and_list_drawn_figures() == []
    (folder / "scan_over_stiffness.png").unlink()
    assert scan_and_list_drawn_figures() == both
    shutil.rmtree(folder / "scan.zarr")
    config.write_text(SCAN_CONFIG.replace("0.32", "0.33"))
    assert scan_and_list_drawn_figures() == both
    monkeypatch.setattr(scanning, "compute_source_digest", lambda: "other code")
    assert scan_and_list_drawn_figures() == both
    assert scan_and_list_drawn_figures() == []
    for damaged in ('{"files": 5}', '{"files": [5]}', "[]"):
        (folder / "figures.json").write_text(damaged)
        assert scan_and_list_drawn_figures() == both


def test_a_tilde_is_the_home_folder_in_paths_of_configs_and_results(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = config.parent / "home"
    monkeypatch.setenv("HOME", str(home))
    assert run_command("init", "~/mine").exit_code == 0
    (home / "mine" / "small.toml").write_text(SCAN_CONFIG)
    result = run_command("scan", "~/mine/small.toml", "--out", "~/here", "--no-picture")
    assert result.exit_code == 0, result.output
    scanned = vrw.open_scan("~/here/scan.zarr")
    stored = vrw.scan(vrw.grid(damping=[100.0]), ["speed"], store="~/there.zarr")
    assert dict(stored.sizes) == {"damping": 1, "leg": 6}
    assert scanned.sizes["damping"] == 4
    assert sorted(path.name for path in home.iterdir()) == ["here", "mine", "there.zarr"]
    assert not (config.parent / "~").exists()


def test_a_figure_is_written_to_the_given_file_and_the_data_to_the_usual_folder(
    config: Path,
) -> None:
    config.write_text(SCAN_CONFIG + '[figures]\nwidth = "column"\n')
    result = run_command("scan", config, "--out", "paper/fig3.pdf")
    assert result.exit_code == 0, result.output
    assert "paper/fig3.pdf" in result.stdout
    assert [path.name for path in Path("paper").iterdir()] == ["fig3.pdf"]
    assert run_command("scan", config, "--out", "Fig3.PNG").exit_code == 0
    assert Path("Fig3.PNG").read_bytes().startswith(b"\x89PNG")
    assert b"/MediaBox [ 0 0 244.8 " in Path("paper/fig3.pdf").read_bytes()  # 3.4 inches
    stored = sorted(path.name for path in Path("results/small").iterdir())
    assert stored == ["figures.json", "scan.zarr"]
    config.write_text(SCAN_CONFIG + '[figures]\nformats = ["pdf"]\n')
    assert run_command("scan", config).exit_code == 0
    assert Path("results/small/scan_over_stiffness.pdf").exists()
    assert not list(Path("results/small").glob("*.png"))


@pytest.mark.parametrize(
    ("table", "options", "sentence"),
    [
        ("", ("--out", "x.eps"), "figures are written as .pdf, .svg or .png"),
        ("", ("--out", "folder.pdf"), "folder.pdf is a folder, but the figure"),
        ("", ("--out", "x.pdf", "--no-picture"), "drop one of the two"),
        ("width = 30", (), "80 to 500 mm wide"),
        ("width = true", (), "width is True"),
        ('width = "wide"', (), '"column", "page"'),
        ('formats = ["eps"]', (), '"svg", "png" and "pdf"'),
        ("formats = []", (), '"svg", "png" and "pdf"'),
        ("file = 3", (), 'such as "fig3.pdf"'),
        ("font = 9", (), "font"),
    ],
)
def test_wrong_settings_of_figures_are_refused_before_the_scan(
    config: Path, table: str, options: tuple[str, ...], sentence: str
) -> None:
    config.write_text(f"{SCAN_CONFIG}[figures]\n{table}\n")
    (config.parent / "folder.pdf").mkdir()
    result = run_command("scan", config, *options)
    assert result.exit_code == 2
    assert sentence in " ".join(result.stderr.split())
    assert {path.name for path in config.parent.iterdir()} == {config.name, "folder.pdf"}


def test_a_stopped_scan_names_the_command_that_continues_it(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: CountingEngine(failing_call=3))
    stopped = run_command("scan", config)
    assert stopped.exit_code == 130
    assert "run the same to go on" in " ".join(stopped.stderr.split())
    rest = CountingEngine()
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: rest)
    for output in ("", "nothing to compute"):
        done = run_command("scan", config, "--no-picture")
        assert done.exit_code == 0
        assert output in done.stdout
        assert rest.n_calls == 2


def test_a_scan_stopped_before_its_store_exists_has_written_nothing(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(scanning, "open_or_create_store", stop)
    stopped = run_command("scan", config)
    assert stopped.exit_code == 130
    assert "stopped; nothing was written" in stopped.stderr


def test_a_scan_with_other_settings_is_refused_in_the_same_place(config: Path) -> None:
    assert run_command("scan", config, "--no-picture").exit_code == 0
    config.write_text(SCAN_CONFIG + "[wheel]\nleg_com = 0.4\n")
    result = run_command("scan", config)
    assert result.exit_code == 2
    assert "wheel.leg_com is 0.3 there and 0.4 here" in result.stderr


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
def test_every_kind_of_design_is_drawn(design: str, config: Path) -> None:
    config.write_text(design)
    measures = '\n[scan]\nmeasures = ["dls_fraction", "speed", "d dls_fraction / d damping"]\n'
    config.write_text(design + measures)
    result = run_command("scan", config, "--out", "here")
    assert result.exit_code == 0, result.output
    assert (config.parent / "here" / "scan.png").stat().st_size > 5000


def test_a_saltelli_scan_of_few_rows_is_drawn_without_indices(config: Path) -> None:
    ranges = "damping = [100.0, 101.0]\nslope = [0.29, 0.3]\nstiffness = [500.0, 500.5]\n"
    config.write_text(f'[saltelli]\nn = 4\n{ranges}[scan]\nmeasures = ["speed"]\n')
    with pytest.warns(UserWarning, match="no Sobol' indices: only 4 of 4 rows.*need 64"):
        result = run_command("scan", config, "--out", "here")
    assert result.exit_code == 0, result.output
    assert [path.name for path in (config.parent / "here").glob("*.png")] == ["scan_pairs.png"]


@pytest.mark.slow
def test_many_parameters_at_once_are_drawn_in_pairs_with_their_sobol_indices(config: Path) -> None:
    config.write_text(
        "[saltelli]\nn = 256\ndamping = [100.0, 101.0]\nslope = [0.29, 0.3]\n"
        'stiffness = [500.0, 500.5]\n[scan]\nmeasures = ["dls_fraction", "speed"]\n'
    )
    result = run_command("scan", config, "--out", "here")
    assert result.exit_code == 0, result.output
    for name in ("scan_pairs.png", "sobol_indices.png"):
        assert (config.parent / "here" / name).stat().st_size > 5000


def test_a_gait_is_printed_with_its_margins(config: Path) -> None:
    result = run_command("gait", "--steps", 2)
    assert result.exit_code == 0, result.output
    for words in ("DLS fraction", "0.53", "stable: multipliers 0.3286", "6 are broken"):
        assert words in result.stdout
    assert "Force in the gait" in result.stdout
    assert "peak force" in result.stdout


def test_help_shows_brackets_and_every_command(config: Path) -> None:
    assert "[branch]" in run_command("continue", "--help").output
    assert "[scan]" in run_command("robustness", "--help").output
    for command in ("init", "tune", "continue"):
        assert run_command(command, "--help").exit_code == 0


def test_init_writes_the_example_configs_and_nothing_twice(config: Path) -> None:
    examples = Path(__file__).parents[2] / "configs"
    result = run_command("init", "mine")
    assert result.exit_code == 0, result.output
    for path in examples.glob("*.toml"):
        assert (config.parent / "mine" / path.name).read_text() == path.read_text()
        assert path.name in result.stdout
    marked = config.parent / "mine" / "quickstart.toml"  # as an editor may write it
    marked.write_text(marked.read_text(), encoding="utf-8-sig")
    second_run = run_command("init", "mine")
    assert second_run.exit_code == 0
    assert "nothing to write" in second_run.stdout


def test_an_installed_wheel_brings_the_example_configs() -> None:
    parsed = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    built = parsed["tool"]["hatch"]["build"]["targets"]["wheel"]
    package = Path(cli.__file__).parents[1].name
    assert built["force-include"]["configs"] == f"{package}/configs"
    assert cli.find_example_config_folder().name == "configs"


def test_verify_reports_whether_a_store_is_complete_and_intact(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: CountingEngine(failing_call=3))
    assert run_command("scan", config, "--no-picture").exit_code == 130
    result = run_command("scan", config, "--verify")
    assert result.exit_code == 0
    assert "lacks 2 of 4 chunks" in result.stdout
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: evaluate_arithmetically)
    assert run_command("scan", config, "--no-picture").exit_code == 0
    assert "is complete and sound" in run_command("scan", config, "--verify").stdout
    file = config.parent / "results" / "small" / "scan.zarr" / "speed" / "c" / "1" / "0" / "0"
    file.unlink()
    result = run_command("scan", config, "--verify")
    assert result.exit_code == 1
    assert "1 damaged chunk (number 1): run the same without --verify" in result.stderr
    assert not file.exists()
    rest = CountingEngine()
    monkeypatch.setattr(ScanPlan, "build_scan_engine", lambda _: rest)
    second_run = run_command("scan", config, "--no-picture")
    assert second_run.exit_code == 0
    assert "1 damaged chunk (number 1): computed again" in second_run.stderr
    assert rest.n_calls == 1


def test_a_branch_without_a_gait_is_reported_and_writes_nothing(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = vrw.Branch("damping", xr.Dataset(coords={"damping": ("point", np.zeros(0))}), (),
                      ("", ""), vrw.Outcome.NO_CYCLE_FOUND)  # fmt: skip
    received = {}
    follow = lambda *_, **settings: received.update(settings) or none
    monkeypatch.setattr("vrw_jax.app.commands.continue_branch", follow)
    branch = '[branch]\nparameter = "damping"\nbounds = [290.0, 300.0]\n'
    config.write_text(f"{branch}[options]\nrtol = 1e-6\n")
    result = run_command("continue", config)
    assert result.exit_code == 1
    assert "there is no gait to start from (NO_CYCLE_FOUND" in result.stderr
    assert received["step_options"] == replace(vrw.StepOptions.tight(), rtol=1e-6)
    assert not (config.parent / "results").exists()


MODEL_CASES = {
    "viscoelastic": ("", 1.0),
    "unilateral": ("friction = 0.6\n", 0.6),
    "rigid": ("held_landing = true\n", 1.0),
    "auto": ("friction = 0.5\n", 0.5),
}


@pytest.mark.parametrize("model_name", MODEL_CASES)
def test_a_config_names_any_model_and_its_friction(model_name: str) -> None:
    settings, friction = MODEL_CASES[model_name]
    model = parse_config(f'[model]\nname = "{model_name}"\n{settings}').make_model()
    assert model.model_name == {"auto": "ladder"}.get(model_name, model_name)
    assert float(model.friction) == friction


@pytest.mark.parametrize("model_name", ["unilateral", "auto"])
def test_friction_is_swept_for_the_unilateral_and_the_automatic_model(model_name: str) -> None:
    result = parse_config(
        f'[model]\nname = "{model_name}"\n[grid]\nfriction = [0.4, 0.8]\nslope = [0.3]\n'
        '[scan]\nmeasures = ["slip", "d speed / d damping"]'
    )
    planned = scanning.plan_config_scan(result, None)
    assert planned.design.swept_parameters == ("friction", "slope")
    assert planned.requested_measures == ("slip", "d speed / d damping")
    assert planned.evaluation_request.wheel_model.model_name == {"auto": "ladder"}.get(
        model_name, model_name
    )


def test_a_gait_of_rigid_legs_is_printed(config: Path) -> None:
    config.write_text('[wheel]\nslope = 0.1\n[model]\nname = "rigid"\n[gait]\nsteps = 3\n')
    result = run_command("gait", config)
    assert result.exit_code == 0, result.output
    assert "Walked 3 steps" in result.stdout
    assert "stable: multipliers" in result.stdout


@pytest.mark.parametrize("command", ["gait", "robustness"])
def test_a_wheel_without_a_gait_has_the_exit_code_of_no_result(command: str, config: Path) -> None:
    config.write_text('[wheel]\nslope = 0.01\n[model]\nname = "rigid"\n[scan]\nslope_sd = 0.01\n')
    result = run_command(command, config)
    assert result.exit_code == 1, result.output


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "reason"), [(20.0, "model is valid"), (0.7, "not valid")])
def test_a_gait_of_the_simplest_model_names_the_model_and_the_reason(
    config: Path, friction: float, reason: str
) -> None:
    config.write_text(
        f'[wheel]\ndamping = 180.0\n[model]\nname = "auto"\nfriction = {friction}\n'
        "[gait]\nsteps = 2\n"
    )
    result = run_command("gait", config)
    assert result.exit_code == 0, result.output
    assert reason in result.stdout
    assert "slip per step" in result.stdout
    assert "number of force peaks" in result.stdout
    assert "0.0000," not in result.stdout  # of 28 multipliers 24 vanish: they are counted


INTERRUPTED_SCAN_SCRIPT = """
import sys, time
sys.path.insert(0, {tests!r})
from vrw_jax.studies import ScanPlan
def wait_for_signal():
    for _ in range(600):  # Python handles a signal that arrives just before a sleep after it.
        time.sleep(0.1)
def slow(columns):
    while True:
        try:
            print("at work", flush=True)
            wait_for_signal()
        except KeyboardInterrupt:
            print("stopping", flush=True)
            wait_for_signal()
ScanPlan.build_scan_engine = lambda _: slow
sys.argv = ["vrw", "scan", {config!r}]
import vrw_jax.__main__
"""


def test_a_second_ctrl_c_ends_a_scan_at_once_with_one_sentence(config: Path) -> None:
    code = INTERRUPTED_SCAN_SCRIPT.format(tests=str(Path(__file__).parents[1]), config=str(config))
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], text=True, **pipes) as process:  # type: ignore[call-overload]
        for line in ("at work", "stopping"):
            while line not in (result := process.stdout.readline()):
                assert result, process.stderr.read()
            process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
        result = process.stderr.read()
    assert "vrw: stopped at once; run the same to go on." in result
    assert "Traceback" not in result

"""Lives on random slopes as measures of scans, and at the command line."""

from pathlib import Path

import numpy as np
import pytest
from support.slow_variants import mark_slow
from typer.testing import CliRunner

import vrw_jax as vrw
from vrw_jax.app.commands import app

SLOPE_SD = 0.02
MEASURES = ["mean_steps", "mean_steps_error", "failure_probability"]


@pytest.mark.slow
def test_a_scan_contains_the_life_of_each_wheel_with_a_gait() -> None:
    data = vrw.scan(vrw.grid(damping=[200.0, 300.0]), [*MEASURES, "speed"], slope_sd=SLOPE_SD)
    passage = vrw.first_passage(vrw.WheelParams(damping=200.0), SLOPE_SD)
    assert float(data.mean_steps[0]) == float(passage.mean_steps)
    assert float(data.mean_steps_error[0]) == float(passage.error)
    assert float(data.failure_probability[0]) == float(passage.failure_probability)
    assert np.isnan(data.mean_steps[1])
    assert data.mean_steps.attrs["long_name"] == "mean number of steps until failure"


@pytest.mark.slow
def test_an_interrupted_scan_of_lives_continues_with_the_same_numbers(tmp_path: Path) -> None:
    design, store = vrw.grid(damping=[190.0, 200.0]), tmp_path / "lives.zarr"

    def interrupt(progress: object) -> None:
        if progress.n_done:
            raise KeyboardInterrupt

    choices = {"slope_sd": 0.03, "chunk": 1}
    with pytest.raises(KeyboardInterrupt, match="1 of 2 chunks are kept"):
        vrw.scan(design, MEASURES, store=store, on_progress=interrupt, **choices)
    data = vrw.scan(design, MEASURES, store=store, **choices)
    expected = vrw.scan(design, MEASURES, **choices)
    np.testing.assert_array_equal(data.mean_steps, expected.mean_steps)
    with pytest.raises(ValueError, match=r"slope_sd is 0.03 there and 0.02 here"):
        vrw.scan(design, MEASURES, store=store, chunk=1, slope_sd=0.02)


def test_walks_have_the_options_of_the_scan() -> None:
    """Some steps take longer than the largest duration, which ends walks of 781 steps after 40."""
    params, options = vrw.WheelParams(damping=150.0), vrw.StepOptions(max_phase_time=0.45)
    data = vrw.scan(
        vrw.grid(slope=[0.3]), ["mean_steps"], base=params, slope_sd=0.015, options=options
    )
    passage = vrw.first_passage(params, 0.015, options=options)
    assert float(data.mean_steps[0]) == float(passage.mean_steps) < 50.0


@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        ({}, "whose standard deviation is missing: give slope_sd"),
        ({"slope_sd": -0.01}, "slope_sd is -0.01, but it must be positive"),
        ({"slope_sd": 0.01, "tol": 0.01, "model": vrw.UnilateralWheel()}, "drop one of them"),
    ],
)
def test_bad_choices_of_a_scan_are_one_sentence(choices: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        vrw.scan(vrw.grid(damping=[200.0]), ["mean_steps"], **choices)


def run_command(*arguments: object) -> object:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.slow
def test_the_command_prints_one_wheel(tmp_path: Path) -> None:
    config = tmp_path / "one.toml"
    config.write_text(f"[scan]\nslope_sd = {SLOPE_SD}\n")
    result = run_command("robustness", config)
    assert result.exit_code == 0, result.output
    for text in ("FirstPassage", "mean steps", "TOUCHDOWN_BEFORE_STOPPER", "GaitSensitivity"):
        assert text in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["one.toml"]


def test_the_command_needs_the_standard_deviation_of_the_slopes(tmp_path: Path) -> None:
    config = tmp_path / "none.toml"
    config.write_text("[grid]\ndamping = [200.0]\n")
    result = run_command("robustness", config)
    assert result.exit_code == 2
    assert "write slope_sd = 0.01" in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    "measures",
    [
        ["mean_steps"],
        *mark_slow((["mean_steps", "gait_sensitivity_period"],)),
    ],
    ids="-".join,
)
def test_the_command_writes_a_store_of_a_design(tmp_path: Path, measures: list[str]) -> None:
    config = tmp_path / "two.toml"
    config.write_text(
        f"[grid]\ndamping = [190.0, 200.0]\n[scan]\nslope_sd = {SLOPE_SD}\nmeasures = {measures}\n"
    )
    folder = tmp_path / "out"
    result = run_command("robustness", config, "--out", folder)
    assert result.exit_code == 0, result.output
    data = vrw.open_scan(folder / "scan.zarr")
    assert np.all(data.mean_steps > 5.0)
    assert data.mean_steps[0] > data.mean_steps[1]
    assert set(measures) <= set(data)

"""Figures use colors that color-blind readers distinguish, one meaning per color, and one form of
units."""

import dataclasses
import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from PIL import Image

import vrw_jax as vrw
from experiments.shared.color_vision import simulate_color_vision
from vrw_jax import Outcome
from vrw_jax.app import _gait_figures as branch
from vrw_jax.app.config import load_config, parse_config
from vrw_jax.app.output import write_tuning_report
from vrw_jax.plot import basin_figure, indicators, save_animation, style, tuning_figure
from vrw_jax.studies import TrialKind
from vrw_jax.studies.tune_maximization import TuneStatus
from vrw_jax.studies.tuning import ActiveConstraint, WalkValidation

ROOT = Path(__file__).parents[2]
MIN_COLOR_DISTANCE = 0.12
"""Least distance of two colours, of sqrt(3) between black and white."""


def perceive_color(colour: str) -> np.ndarray:
    return simulate_color_vision(np.array(mpl.colors.to_rgb(colour)))


def test_figures_and_animations_are_written_to_paths_given_as_strings(tmp_path):
    figure = mpl.figure.Figure()
    paths = style.save(figure, f"{tmp_path}/figs", "empty")
    assert paths == style.save(figure, tmp_path / "figs", "empty")
    assert all(path.stat().st_size > 0 for path in paths)
    black_and_white = np.repeat(np.array([[0, 255], [255, 0]], np.uint8), 4, axis=1)
    frames = [Image.fromarray(np.tile(row, (8, 1))).convert("RGB") for row in black_and_white]
    written = save_animation(frames, 40, f"{tmp_path}/gifs/blink.gif")
    assert written == tmp_path / "gifs" / "blink.gif"
    with Image.open(written) as animation:
        assert (animation.format, animation.n_frames) == ("GIF", 2)
    with pytest.raises(TypeError, match="give a folder"):
        style.save(figure, 3, "empty")
    with pytest.raises(TypeError, match="give a file"):
        save_animation(frames, 40, 3)


def test_colors_of_okabe_and_ito_stay_distinct_without_green_cones():
    np.testing.assert_allclose(perceive_color("0.5"), 0.5, atol=1e-3)
    colours = [
        getattr(style, f"OKABE_ITO_{name}")
        for name in ["BLUE", "ORANGE", "GREEN", "PINK", "SKY_BLUE", "AMBER", "YELLOW"]
    ]
    for i, one in enumerate(colours):
        for other in colours[:i]:
            assert (
                np.linalg.norm(perceive_color(one) - perceive_color(other)) > MIN_COLOR_DISTANCE
            ), (one, other)


def test_outcome_colors_stay_distinct_with_and_without_green_cones():
    rows = [colour for _, colour in style.OUTCOME_LABELS_AND_COLORS.values()]
    for i, one in enumerate(rows):
        for other in rows[:i]:
            plain = np.array(mpl.colors.to_rgb(one)) - mpl.colors.to_rgb(other)
            assert np.linalg.norm(plain) > MIN_COLOR_DISTANCE, (one, other)
            assert (
                np.linalg.norm(perceive_color(one) - perceive_color(other)) > MIN_COLOR_DISTANCE
            ), (one, other)


NAMED_COLOR_PATTERN = (
    r"""["'](red|green|blue|[bgrcy](?:[.o*s^x]|--?|[.o]--?))["']|color=["'](?:[bgrcmy]["']|tab:)"""
)


@pytest.mark.parametrize("folder", ["experiments", "vrw_jax/app"])
def test_figures_use_only_colors_of_the_palette(folder: str):
    """Okabe and Ito's, greys, black and white; matplotlib's own red, green and blue are others."""
    for path in (ROOT / folder).rglob("*.py"):
        assert not re.search(NAMED_COLOR_PATTERN, path.read_text()), path


def test_shades_of_a_basin_differ_from_the_colors_of_falls():
    over_values = ("dtheta_touchdown", "dL1_touchdown")
    falls = [Outcome.FELL_BACK, Outcome.LEG_1_LIFTED_OFF, Outcome.TOUCHDOWN_BEFORE_STOPPER]
    outcome = np.array([[0, 0, 0], falls])
    result = xr.Dataset(
        {
            "outcome": (over_values, outcome),
            "steps": (over_values, np.array([[0.0, 10.0, 25.0], [1.0, 1.0, 1.0]])),
            "attractor": (over_values, np.where(outcome == 0, 0, -1)),
            "orbit_state": (("n", "state"), np.zeros((1, 3))),
        },
        {over_values[0]: [1.0, 2.0], over_values[1]: [0.0, 0.1, 0.2]},
    )
    figure = basin_figure([result], ["any"])
    mesh = figure.axes[0].collections[0]
    for steps in np.linspace(0.0, 25.0, 11):
        shade = simulate_color_vision(np.array(mesh.cmap(mesh.norm(steps))[:3]))
        for code in falls:
            assert (
                np.linalg.norm(shade - perceive_color(style.OUTCOME_LABELS_AND_COLORS[code][1]))
                > MIN_COLOR_DISTANCE
            ), (steps, code)
    mixed = basin_figure([result.isel({name: [1, 0] for name in over_values})], ["any"])
    ordered = basin_figure([result.isel(dtheta_touchdown=[0, 1], dL1_touchdown=[0, 1])], ["any"])
    for x, y in zip(mixed.axes[0].collections, ordered.axes[0].collections, strict=True):
        np.testing.assert_array_equal(x.get_array(), y.get_array())
    without_gait = result.assign(attractor=0 * result.attractor - 1)
    assert basin_figure([without_gait], ["any"]).axes
    with pytest.raises(ValueError, match=r"results\[0\] has 1 axes of starts"):
        basin_figure([result.isel(dL1_touchdown=0)], ["any"])
    with pytest.raises(ValueError, match="titles has 0 entries"):
        basin_figure([result], [])


def test_special_points_of_a_branch_have_their_own_colors_and_dashes():
    curves = {colour for _, series in branch.PAPER_BRANCH_PANELS for colour in series.values()}
    assert not curves & {branch.BRANCH_END_COLOR, *branch.SPECIAL_POINT_COLORS.values()}
    assert branch.SPECIAL_POINT_LINE_STYLE not in ("-", "--")


def test_the_indicator_figure_shows_its_slope():
    gaits = xr.Dataset(
        {
            name: ("damping", np.array([1.0, 2.0]))
            for name in ("lambda_I4", "lambda_2_plus", "lambda_4_plus")
        }
        | {f"clearance_sls{i}": ("damping", np.array([-0.1, 0.1])) for i in (1, 2)}
        | {"settled": ("damping", np.array([True, True]))},
        {"damping": [4.0, 8.0]},
        {"parameter_slope": 0.3},
    )
    rows = [text.get_text() for text in indicators(gaits).axes[0].texts]
    assert style.format_value_label("slope", 0.3) in rows


@pytest.fixture(scope="module")
def tune_result():
    path = xr.Dataset(
        {
            "damping": ("evaluation", [150.0, 195.0, 200.0], {"units": "N s/m"}),
            "objective": ("evaluation", [0.4, np.nan, 0.5], {"long_name": "dls_fraction"}),
            "constraint_value": (("evaluation", "constraint"), [[1.0], [np.nan], [0.5]]),
            "margin": ("constraint", [0.0]),
            "breach": ("evaluation", [0.0, np.nan, 0.0]),
            "kind": ("evaluation", [TrialKind.START, TrialKind.LOST, TrialKind.ITERATE]),
        },
        {
            "evaluation": range(3),
            "constraint": ["locked_stopper_force[3]"],
            "free_parameter": ["damping"],
        },
        {"lower": [100.0], "upper": [200.0]},
    )
    return vrw.TuneResult(
        params=vrw.WheelParams(damping=200.0),
        status=TuneStatus.CONVERGED,
        objective="dls_fraction",
        value=0.5,
        start_value=0.4,
        cycle=None,
        step=None,
        active=(ActiveConstraint("damping", 200.0, "N s/m", 0.1, (0.1, 0.1)),),
        kkt_residual=0.0,
        violated_margins=(),
        validation=WalkValidation(10, Outcome.STEPPED, 0.0, True),
        path=path,
        n_evaluations=3,
        n_backtracks=1,
        seconds=1.0,
        compile_seconds=0.5,
        model=vrw.ViscoelasticWheel(),
    )


def test_objective_and_parameters_of_a_tuning_run_are_drawn_over_the_evaluations(tune_result):
    objective, slack, parameters = tuning_figure(tune_result).axes
    np.testing.assert_array_equal(objective.lines[0].get_xydata(), [[0.0, 0.4], [2.0, 0.5]])
    np.testing.assert_array_equal(
        parameters.lines[0].get_xydata(), [[0.0, 0.5], [1.0, 0.95], [2.0, 1.0]]
    )
    assert [bar.get_width() for bar in slack.patches] == [1.0, 0.5]


def test_the_config_of_a_tuned_wheel_has_its_model_and_options(tune_result, tmp_path):
    settings = '[model]\nname = "unilateral"\nfriction = 0.8\nhub_torque = 2\n'
    config = parse_config(f"{settings}[options]\nrtol = 1e-9\n[tune.bounds]\nslope = [0.2, 0.4]")
    model = vrw.UnilateralWheel(friction=0.9, hub_torque=3.0)
    result = dataclasses.replace(tune_result, model=model)
    write_tuning_report(result, tmp_path, config, draws_figure=False)
    assert (tmp_path / "tuning.md").read_text().startswith("# Tuned: ")
    written = load_config(tmp_path / "wheel.toml")
    assert float(written.make_wheel().damping) == 200.0
    written_model = written.make_model()
    assert isinstance(written_model, vrw.UnilateralWheel)
    assert (float(written_model.friction), float(written_model.hub_torque.torque)) == (0.9, 3.0)
    assert written.make_options() == config.make_options()
    assert written.tune is None


UNIT = r"(s|ms|µs|m|mm|N|J|%|rad|m/s|rad/s|N s/m|N·s/m)"


@pytest.mark.parametrize("folder", ["experiments", "vrw_jax/app"])
def test_labels_write_units_in_brackets(folder: str):
    """Not after a stroke or a comma."""
    wrong = re.compile(rf'["\n](?:[^"\[]*) / {UNIT}"|label="[^"\[]*, {UNIT}"|\[[^\]"]*N s')
    for path in (ROOT / folder).rglob("*.py"):
        labels = [
            line
            for line in path.read_text().splitlines()
            if re.search(r"label|title|SHOWN|: \(\"", line)
        ]
        found_rows = [line for line in labels if wrong.search(line)]
        assert not found_rows, (path, found_rows)

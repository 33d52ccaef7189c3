"""Figures of scans support every kind of swept parameter."""

import numpy as np
import pytest
import xarray as xr

from vrw_jax import Outcome
from vrw_jax.plot import map_figure, scan_figures, style


@pytest.mark.parametrize("second", ["friction", "gravity"])
def test_a_scan_is_drawn_over_both_its_axes(second):
    values = {"damping": [100.0, 150.0, 200.0], second: [0.4, 0.6, 0.8, 1.0]}
    shape = (3, 4)
    scan = xr.Dataset(
        {
            "outcome": (tuple(values), np.zeros(shape, int)),
            "speed": (tuple(values), np.arange(12.0).reshape(shape)),
        },
        values,
    )
    (figure,) = scan_figures(scan).values()
    speed, outcome, _ = figure.axes
    assert outcome.get_ylabel() == style.format_axis_label(second, "{symbol}")
    assert speed.collections[0].get_array().shape == (4, 3)


@pytest.mark.parametrize("n_parameters", [2, 3])
def test_a_figure_of_a_grid_does_not_depend_on_the_order_of_its_values(n_parameters):
    names = ["damping", "slope", "stiffness"][:n_parameters]
    values = {name: [1.0, 2.0, 4.0] for name in names}
    speed = np.arange(3.0**n_parameters).reshape([3] * n_parameters)
    named = {"outcome": 0 * speed.astype(int), "speed": speed, "friction_fore": speed - 1.5}
    scan = xr.Dataset({name: (names, array) for name, array in named.items()}, values)
    mixed = scan.isel({name: [2, 0, 1] for name in names})

    def list_drawn_values(figure):
        arrays = [x.get_array() for axes in figure.axes for x in axes.collections]
        curves = [path.vertices for x in figure.axes[0].collections for path in x.get_paths()]
        return [x for x in (*arrays, *curves) if x is not None]

    draw = lambda x: [
        *scan_figures(x).values(),
        map_figure(x.sel(dict.fromkeys(names[2:], 1.0)), "speed", []),
    ]
    for figures in zip(draw(scan), draw(mixed), strict=True):
        for ordered, other in zip(*map(list_drawn_values, figures), strict=True):
            np.testing.assert_array_equal(ordered, other)


def make_scan(outcome: np.ndarray, speed: np.ndarray, radius: np.ndarray) -> xr.Dataset:
    over_values = ("damping", "slope")
    values = {"damping": [100.0, 150.0, 200.0], "slope": [0.28, 0.3]}
    named = {"outcome": outcome, "speed": speed, "spectral_radius": radius}
    return xr.Dataset({name: (over_values, array) for name, array in named.items()}, values)


def test_a_few_unstable_gaits_do_not_widen_the_color_range():
    speed, radius = np.linspace(0.8, 0.9, 6).reshape(3, 2), np.full((3, 2), 0.5)
    speed[0, 0], radius[0, 0] = 40.0, 1.5
    (figure,) = scan_figures(make_scan(np.zeros((3, 2), int), speed, radius)).values()
    mesh = figure.axes[0].collections[0]
    assert mesh.get_clim() == (speed[0, 1], speed[2, 1])
    assert mesh.colorbar.extend == "max"
    radius[:] = 1.5
    (figure,) = scan_figures(make_scan(np.zeros((3, 2), int), speed, radius)).values()
    assert figure.axes[0].collections[0].get_clim() == (speed[0, 1], 40.0)


@pytest.mark.parametrize(
    "code",
    [Outcome.NO_CYCLE_FOUND, Outcome.EVENT_ORDER_MISMATCH, Outcome.BRANCH_ENDS_BEFORE_TARGET],
)
def test_colors_show_why_there_is_no_gait(code):
    outcome = np.zeros((3, 2), int)
    outcome[0, 0] = code
    (figure,) = scan_figures(make_scan(outcome, np.ones((3, 2)), np.full((3, 2), 0.5))).values()
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert style.OUTCOME_LABELS_AND_COLORS[code][0] in names


def test_mean_numbers_of_steps_have_a_logarithmic_color_scale():
    scan = make_scan(np.zeros((3, 2), int), np.ones((3, 2)), np.full((3, 2), 0.5))
    mean_steps = np.logspace(1.0, 11.0, 6).reshape(3, 2)
    scan = scan.assign(mean_steps=(("damping", "slope"), mean_steps))
    (figure,) = scan_figures(scan).values()
    mesh = figure.axes[0].collections[0]
    shades = np.linspace(0.0, 1.0, 6).reshape(3, 2).T
    np.testing.assert_allclose(mesh.norm(mean_steps.T), shades, atol=1e-12)


def make_leg_scan(values: dict[str, list[float]], is_grid: bool) -> xr.Dataset:
    """Return a scan of a measure with one value per leg, whose smallest is 1."""
    dims = tuple(values) if is_grid else ("sample",)
    shape = tuple(map(len, values.values()))[: len(dims)]
    force = np.broadcast_to([3.0, 1.0, 2.0, 4.0, 5.0], (*shape, 5))
    columns = {
        "locked_stopper_force": ((*dims, "leg"), force),
        "outcome": (dims, np.zeros(shape, int)),
    }
    coordinates = {name: (name if is_grid else "sample", x) for name, x in values.items()}
    return xr.Dataset(columns, coordinates)


@pytest.mark.parametrize("is_grid", [True, False])
@pytest.mark.parametrize("n_parameters", [1, 2, 3])
def test_the_least_value_over_the_legs_is_drawn(is_grid, n_parameters):
    names = ["damping", "slope", "stiffness"][:n_parameters]
    scan = make_leg_scan({name: [0.1, 0.2, 0.4] for name in names}, is_grid)
    figure, *_ = scan_figures(scan).values()
    drawn = [x for axes in figure.axes for x in (*axes.collections, *axes.lines)]
    arrays = [x.get_ydata() if hasattr(x, "get_ydata") else x.get_array() for x in drawn]
    assert any(x is not None and np.size(x) and np.all(x == 1.0) for x in arrays)
    if is_grid and n_parameters == 2:
        cells, *_ = map_figure(scan, "locked_stopper_force", []).axes[0].collections
        assert np.all(cells.get_array() == 1.0)


@pytest.mark.parametrize("is_grid", [True, False])
@pytest.mark.parametrize("n_parameters", [1, 2, 3])
def test_infinite_friction_is_left_out_with_a_warning(is_grid, n_parameters):
    names = ["friction", "slope", "stiffness"][:n_parameters]
    values = {name: [0.1, 0.2, 0.4] for name in names} | {"friction": [0.5, 0.7, np.inf]}
    with pytest.warns(UserWarning, match="leaves out samples whose friction is infinite"):
        figures = scan_figures(make_leg_scan(values, is_grid))
    for axes in next(iter(figures.values())).axes:
        assert np.isfinite([*axes.get_xlim(), *axes.get_ylim()]).all()


def test_an_axis_with_infinite_friction_alone_is_not_varied(recwarn):
    values = {"friction": [np.inf], "damping": [100.0, 150.0]}
    (figure,) = scan_figures(make_leg_scan(values, is_grid=True)).values()
    assert figure.axes[0].lines[0].get_xdata().tolist() == [100.0, 150.0]
    assert not recwarn

"""Figures of walks of any model: feet are at the walk's positions, in the colors of their modes."""

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.app import _walk_figures as contact
from vrw_jax.plot import tornado_figure
from vrw_jax.wheel import ContactMode


@pytest.fixture(scope="module")
def paper_walk() -> xr.Dataset:
    return vrw.simulate(vrw.WheelParams(), n_steps=2, n_samples=20)


@pytest.fixture(scope="module")
def rigid_walk() -> xr.Dataset:
    params = vrw.WheelParams(slope=0.1)
    return vrw.simulate(params, n_steps=2, n_samples=20, model=vrw.RigidWheel())


@pytest.fixture(scope="module")
def sliding_walk() -> xr.Dataset:
    ground = vrw.UnilateralWheel(friction=0.7)
    return vrw.simulate(vrw.WheelParams(), n_steps=2, n_samples=20, model=ground)


@pytest.fixture(scope="module")
def ladder_walk() -> xr.Dataset:
    return vrw.simulate(vrw.WheelParams(), n_steps=1, n_samples=20, model="auto")


@pytest.mark.parametrize("name", ["paper_walk", "rigid_walk"])
def test_feet_of_a_walk_in_phases_are_at_the_positions_of_its_variables(name, request):
    walk = request.getfixturevalue(name)
    motion = contact.compute_foot_motion(walk)
    for leg in (1, 2):
        for axis, letter in enumerate("xz"):
            known = walk[f"foot_{leg}_{letter}"].values  # round-off of metres
            np.testing.assert_allclose(motion.foot_positions[:, leg - 1, axis], known, atol=1e-12)
            np.testing.assert_array_equal(
                motion.foot_forces[:, leg - 1, axis], walk[f"lambda_{2 * leg - 1 + axis}"]
            )
    lengths = np.linalg.norm(motion.foot_positions - motion.hub_positions[:, None], axis=-1)
    np.testing.assert_allclose(lengths[:, 2:], 1.0, atol=1e-12)
    is_at_rest = motion.contact_modes == ContactMode.STICK
    np.testing.assert_array_equal(is_at_rest[:, 0], True)
    np.testing.assert_array_equal(is_at_rest[:, 1], walk.phase.values == 0)
    assert not is_at_rest[:, 2:].any()


def test_feet_with_unilateral_contact_are_those_of_the_walk(sliding_walk):
    motion = contact.compute_foot_motion(sliding_walk)
    np.testing.assert_array_equal(motion.foot_positions[..., 0], sliding_walk.foot_x)
    np.testing.assert_array_equal(motion.foot_positions[..., 1], sliding_walk.foot_z)
    np.testing.assert_array_equal(motion.contact_modes, sliding_walk.contact)
    # A foot that slides downhill moves downhill between two samples of the same mode.
    slides = sliding_walk.contact.values[:, 1] == ContactMode.SLIP_DOWN
    is_inside = slides[:-1] & slides[1:] & (np.diff(sliding_walk.time.values) > 0.0)
    is_inside &= np.diff(sliding_walk.step.values) == 0
    assert is_inside.any()
    assert np.all(np.diff(sliding_walk.foot_x.values[:, 1])[is_inside] > 0.0)


def test_bars_of_contact_modes_cover_the_time_of_each_mode(sliding_walk):
    bars = vrw.plot.gait_panels(sliding_walk).axes[2].collections
    duration_by_color = dict.fromkeys(contact.CONTACT_MODE_COLORS[1:], 0.0)
    for bar in bars:
        color = mpl.colors.to_hex(bar.get_facecolor()[0]).upper()
        duration_by_color[color] += np.ptp(bar.get_paths()[0].vertices[:, 0])
    modes, intervals = sliding_walk.contact.values, np.diff(sliding_walk.time.values)[:, None]
    for mode, (color, duration) in enumerate(duration_by_color.items(), ContactMode.STICK):
        known = np.sum(intervals * ((modes[:-1] == mode) & (modes[1:] == mode)))
        assert duration == pytest.approx(known, abs=1e-12), color


def test_sticks_have_feet_in_the_colors_of_their_modes(sliding_walk):
    axes = vrw.plot.sticks(sliding_walk, interval=0.1).axes[0]
    colors = {line.get_color() for line in axes.lines if line.get_marker() in ("o", ">", "<")}
    modes = (ContactMode.OFF, ContactMode.STICK, ContactMode.SLIP_DOWN)
    assert {contact.CONTACT_MODE_COLORS[mode] for mode in modes} <= colors
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"at rest", "sliding downhill", "in the air"} <= set(names)


@pytest.mark.parametrize(
    "name", ["paper_walk", "rigid_walk", "sliding_walk", *mark_slow("ladder_walk")]
)
def test_a_walk_of_every_model_is_drawn(name, request):
    walk = request.getfixturevalue(name)
    assert len(vrw.plot.gait_panels(walk).axes) in (5, 6)
    assert vrw.plot.sticks(walk).axes[0].lines
    frames, milliseconds = vrw.plot.walk_frames(walk, n_frames=3, slow=1.0)
    assert len(frames) == 3
    assert milliseconds == round(1e3 * float(walk.time[-1]) / 3)
    color = contact.CONTACT_MODE_COLORS[ContactMode.STICK]
    wanted_pixel = np.round(255 * np.array(mpl.colors.to_rgb(color)))
    pixels = np.asarray(frames[0]).reshape(-1, 3)
    assert np.sum(np.all(pixels == wanted_pixel, axis=1)) > 5  # of the foot at rest


def test_feet_between_two_samples_are_interpolated(sliding_walk):
    motion = contact.compute_foot_motion(sliding_walk)
    middle = 0.5 * (motion.sample_times[7] + motion.sample_times[8])
    hub, feet, sample = motion.interpolate_at_time(middle)
    np.testing.assert_allclose(hub, motion.hub_positions[7:9].mean(0), atol=1e-14)  # round-off
    np.testing.assert_allclose(feet, motion.foot_positions[7:9].mean(0), atol=1e-14)
    assert sample == 8


def test_every_gait_of_a_comparison_has_a_curve(paper_walk):
    gaits = [paper_walk.assign_attrs(parameter_damping=value) for value in (1, 2, 3, 4, 5)]
    for draw in (vrw.plot.rear_force, vrw.plot.foot_height):
        axes = draw(gaits).axes[0]
        labels = [text.get_text() for text in axes.get_legend().get_texts()]
        assert len(set(labels)) == 5
        curves = [line for line in axes.lines if line.get_label() in labels]
        assert len({(line.get_linestyle(), line.get_color()) for line in curves}) == 5


def test_a_walk_that_can_not_be_drawn_is_refused_with_the_remedy(sliding_walk):
    for draw in (vrw.plot.rear_force, vrw.plot.foot_height):
        with pytest.raises(ValueError, match=r"the paper's wheel; vrw\.plot\.gait_panels, sticks"):
            draw([sliding_walk])
    empty_walk = vrw.simulate(vrw.WheelParams(), n_steps=1, model=vrw.RigidWheel())
    assert empty_walk.sizes["time"] == 0
    for draw in (vrw.plot.gait_panels, vrw.plot.sticks, vrw.plot.walk_frames):
        with pytest.raises(ValueError, match="ended at once as LEG_1_LIFTED_OFF"):
            draw(empty_walk)


@pytest.fixture(scope="module")
def sensitivity_table() -> xr.Dataset:
    return vrw.sensitivities(vrw.WheelParams(), measures=["speed", "dls_fraction"])


def read_bars(axes, container: int = 0) -> dict[str, float]:
    """Return the widths of the bars by the symbols of their parameters."""
    symbols = [text.get_text() for text in axes.get_yticklabels()]
    widths = [patch.get_width() for patch in axes.containers[container]]
    return dict(zip(symbols, widths, strict=True))


def format_symbol(name: str) -> str:
    return f"${vrw.MEASURES[name].mathtext}$"


def test_bars_of_a_tornado_are_elasticities_with_the_longest_on_top(sensitivity_table):
    figure = tornado_figure(sensitivity_table)
    for axes, measure in zip(figure.axes, ("speed", "dls_fraction"), strict=True):
        elasticity = sensitivity_table.elasticity.sel(measure=measure)
        known = {
            format_symbol(name): float(elasticity.sel(parameter=name))
            for name in sensitivity_table.parameter.values
        }
        bars = read_bars(axes)
        assert bars == known
        assert list(map(abs, bars.values())) == sorted(map(abs, bars.values()), reverse=True)
        assert axes.get_ylim()[0] > axes.get_ylim()[1]
        assert read_bars(axes, 1) == {name: -width for name, width in bars.items()}


def test_bars_for_spreads_are_derivatives_times_the_spreads(sensitivity_table):
    spreads = {"damping": 10.0, "slope": 0.01}
    figure = tornado_figure(sensitivity_table, "speed", spreads=spreads)
    derivative = sensitivity_table.derivative.sel(measure="speed")
    assert read_bars(figure.axes[0]) == {
        format_symbol(name): float(derivative.sel(parameter=name)) * width
        for name, width in spreads.items()
    }
    for wrong, sentence in (
        ({"c": 1.0}, "c is called damping"),
        ({"damping": -1.0}, "must be positive"),
        ({}, "spreads is empty"),
    ):
        with pytest.raises(ValueError, match=sentence):
            tornado_figure(sensitivity_table, spreads=wrong)

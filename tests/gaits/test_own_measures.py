"""Measures of a user: integrals and means over phases, against closed forms and laws of physics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.walkers import BALL_PARAMS, BALL_SYSTEM, GRAVITY

import vrw_jax as vrw

WHEEL = vrw.WheelParams()


def rear_force(instant, params):
    return instant.rear_force.normal


MEAN_FORCE = vrw.measure("mean_rear_force", unit="N", phase="DLS", reduction="mean")(rear_force)
IMPULSE = vrw.measure("rear_impulse", unit="N s", phase="DLS", reduction="integral")(rear_force)


SPEED = vrw.measure("speed")(lambda step, params: 1.0 / step.duration)


@vrw.measure("cost_of_transport", meaning="energy lost per weight and distance")
def cost_of_transport(step, params):
    lost = step.energy.landing + step.energy.stopper + step.energy.damping
    weight = (params.hub_mass + params.n_legs * params.leg_mass) * params.gravity
    return lost / (weight * step.step_length)


@pytest.fixture(scope="module")
def cycle():
    return vrw.limit_cycle(WHEEL)


def test_integrals_over_a_mode_have_their_closed_forms_and_derivatives():
    """In a flight from v to -v, the mean of the squared velocity is v^2 / 3."""
    square = lambda y, p: y[1] ** 2
    measures = (
        vrw.measure("mean_square", phase="flight", reduction="mean")(square),
        vrw.measure("action", phase="flight", reduction="integral")(square),
    )
    extrema = (
        vrw.measure("apex", phase="flight", reduction="max")(lambda y, p: y[0]),
        vrw.measure("lowest_velocity", phase="flight", reduction="min")(lambda y, p: y[1]),
    )
    walker = dataclasses.replace(BALL_SYSTEM, measures=(*measures, *extrema))
    names = ["mean_square", "action", "apex", "lowest_velocity"]
    table = vrw.sensitivities(BALL_PARAMS, measures=names, model=walker)
    v, dv = 2.0, np.array([4.0, 2.0])
    values = [v**2 / 3, 2 * v**3 / 3 / GRAVITY, v**2 / 2 / GRAVITY, -v]
    np.testing.assert_allclose(table.value, values, rtol=1e-9)
    expected = [2 * v / 3 * dv, 2 * v**2 / GRAVITY * dv, v / GRAVITY * dv, -dv]
    np.testing.assert_allclose(table.derivative, expected, rtol=1e-8)


def test_the_impulse_of_the_ground_over_a_step_carries_the_weight(cycle):
    """Momentum normal to the slope repeats, so that forces and impacts balance the weight."""

    def normal_force(instant, params):
        rear = 0.0 if instant.rear_force is None else instant.rear_force.normal
        return instant.fore_force.normal + rear

    forces = sum(
        cycle.measure(vrw.measure("impulse", phase=phase, reduction="integral")(normal_force))
        for phase in ("DLS", "SLS-I", "SLS-II")
    )
    margins = vrw.step(WHEEL, cycle.section_state).margins
    impacts = cycle.measure("landing_impulse") + cycle.indicators.lambda_I4
    impacts = impacts + margins.hit_planted_impulse
    weight = (WHEEL.hub_mass + WHEEL.n_legs * WHEEL.leg_mass) * WHEEL.gravity
    expected = weight * jnp.cos(WHEEL.slope) * cycle.period
    np.testing.assert_allclose(forces + impacts, expected, rtol=1e-10)


def test_the_mean_force_on_the_rear_foot_is_that_of_samples(cycle):
    """21.07 N by samples of `vrw.simulate` at Table 1; the trapezoidal error is 1e-5."""
    walk = vrw.simulate(WHEEL, cycle.section_state, 1, n_samples=1001)
    is_dls = walk.phase.values == 0
    time, force = walk.time.values[is_dls], walk.lambda_4.values[is_dls]
    mean = np.trapezoid(force, time) / np.ptp(time)
    assert float(cycle.measure(MEAN_FORCE)) == pytest.approx(mean, abs=3e-5)
    assert float(cycle.measure(MEAN_FORCE)) == pytest.approx(21.07, abs=5e-3)
    impulse = cycle.measure(IMPULSE)
    np.testing.assert_allclose(impulse, cycle.measure(MEAN_FORCE) * cycle.durations[0], rtol=1e-13)


def fore_force(instant, params):
    return instant.fore_force.normal


ALL_PHASES = ("DLS", "SLS-I", "SLS-II")
LARGEST_FORCE = vrw.measure("largest", unit="N", phase=ALL_PHASES, reduction="max")(fore_force)


def test_extrema_and_means_over_several_phases_are_those_of_samples(cycle):
    """The largest force is also a measure of the library; the trapezoidal error is 1e-5."""
    np.testing.assert_allclose(
        cycle.measure(LARGEST_FORCE), cycle.measure("peak_force"), rtol=1e-13
    )
    walk = vrw.simulate(WHEEL, cycle.section_state, 1, n_samples=1001)
    force = walk.lambda_2.values
    declare = lambda reduction: vrw.measure("force", phase=ALL_PHASES, reduction=reduction)
    smallest, mean = (cycle.measure(declare(name)(fore_force)) for name in ("min", "mean"))
    np.testing.assert_allclose(smallest, force.min(), rtol=1e-8)
    expected = np.trapezoid(force, walk.time.values) / np.ptp(walk.time.values)
    np.testing.assert_allclose(mean, expected, rtol=1e-6)


@pytest.mark.slow
def test_the_derivative_of_the_largest_force_is_that_of_the_library():
    find = lambda damping: vrw.limit_cycle(vrw.WheelParams(damping=damping))
    by_own, by_library = (
        jax.grad(lambda damping, name=name: find(damping).measure(name))(200.0)
        for name in (LARGEST_FORCE, "peak_force")
    )
    np.testing.assert_allclose(by_own, by_library, rtol=1e-10)


def test_a_measure_of_a_step_loses_what_gravity_supplies(cycle):
    """The energy lost per weight and distance is the sine of the slope."""
    np.testing.assert_allclose(cycle.measure(cost_of_transport), np.sin(0.3), rtol=1e-10)


def test_sensitivities_scans_and_gradients_have_one_derivative():
    mean_force = lambda damping: vrw.limit_cycle(vrw.WheelParams(damping=damping)).measure(
        MEAN_FORCE
    )
    derivative = jax.grad(mean_force)(200.0)
    difference = (mean_force(201.0) - mean_force(199.0)) / 2.0  # its error is 1e-5 relative
    assert float(derivative) == pytest.approx(float(difference), rel=1e-4)
    table = vrw.sensitivities(WHEEL, measures=["speed", MEAN_FORCE])
    assert table.measure_unit.values.tolist() == ["m/s", "N"]
    by_damping = table.derivative.sel(measure="mean_rear_force", parameter="damping")
    np.testing.assert_allclose(by_damping, derivative, rtol=1e-9)
    name = "d mean_rear_force / d damping"
    scan = vrw.scan(vrw.samples(damping=[200.0, 400.0]), [MEAN_FORCE, name])
    np.testing.assert_allclose(scan[name].values, [derivative, np.nan], rtol=1e-9)
    assert scan.mean_rear_force.attrs["units"] == "N"
    assert mean_force(400.0) == 0.0  # no gait


def test_a_store_refuses_a_measure_with_other_code(tmp_path):
    def scan(function):
        mean = vrw.measure("force", phase="DLS", reduction="mean")(function)
        return vrw.scan(vrw.samples(damping=[200.0]), [mean], store=tmp_path / "scan")

    first = scan(rear_force)
    assert scan(rear_force).force.values == first.force.values
    with pytest.raises(ValueError, match="the code of force differs"):
        scan(lambda instant, params: instant.fore_force.normal)


def test_tuning_maximizes_a_measure():
    tuned = vrw.tune(WHEEL, MEAN_FORCE, ["damping"], {"damping": (180.0, 210.0)})
    assert (tuned.objective, float(tuned.params.damping)) == ("mean_rear_force", 180.0)


def test_branches_have_measures_by_name_and_by_themselves():
    """A flight from v to -v has the action 2 v^3 / 3 g, and kicks have v = k / (1 - e)."""
    action = vrw.measure("action", phase="flight", reduction="integral")(lambda y, p: y[1] ** 2)
    gait = vrw.limit_cycle(BALL_PARAMS, model=BALL_SYSTEM)
    branch = vrw.continue_branch(
        BALL_PARAMS, "kick", (0.5, 2.0), model=BALL_SYSTEM, cycle=gait, measures=["height", action]
    ).dataset
    v = branch.kick.values / 0.5
    np.testing.assert_allclose(branch.action, 2 * v**3 / 3 / GRAVITY, rtol=1e-8)
    np.testing.assert_allclose(branch.height, v**2 / 2 / GRAVITY, rtol=1e-8)
    assert branch.height.units == "m"
    assert branch.component.values.tolist() == ["velocity"]


def test_a_branch_of_a_wheel_has_the_measure_of_each_gait():
    wheel = vrw.WheelParams(damping=199.0)
    branch = vrw.continue_branch(wheel, "damping", (198.0, 200.0), measures=[IMPULSE]).dataset
    gaits = vrw.limit_cycles(vrw.WheelParams(damping=branch.damping.values[[0, -1]]))
    # The gaits have errors of the default mesh, about 1e-10.
    np.testing.assert_allclose(branch.rear_impulse[[0, -1]], gaits.measure(IMPULSE), rtol=1e-8)
    assert branch.rear_impulse.units == "N s"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: vrw.measure("force", phase="DLS"), "reduction"),
        (lambda: vrw.measure("force", reduction="mean"), "there is no phase"),
        (
            lambda: vrw.continue_branch(
                BALL_PARAMS,
                "kick",
                (0.5, 2.0),
                model=BALL_SYSTEM,
                cycle=vrw.limit_cycle(BALL_PARAMS, model=BALL_SYSTEM),
                margins={"mean": vrw.measure("mean", phase="flight", reduction="mean")(rear_force)},
            ),
            "a margin is a minimum",
        ),
        (
            lambda: vrw.limit_cycle(WHEEL).measure(
                vrw.measure("force", phase="flight", reduction="mean")(rear_force)
            ),
            "DLS",
        ),
        (
            lambda: vrw.scan(
                vrw.samples(damping=[200.0]), [MEAN_FORCE], model=vrw.UnilateralWheel(friction=0.7)
            ),
            "ViscoelasticWheel",
        ),
        (
            lambda: vrw.continue_branch(
                WHEEL, "damping", (190.0, 210.0), model=vrw.RigidWheel(), measures=[MEAN_FORCE]
            ),
            "ViscoelasticWheel",
        ),
        (
            lambda: vrw.continue_branch(WHEEL, "damping", (190.0, 210.0), measures=["period"]),
            "'period' is no measure",
        ),
        (
            lambda: dataclasses.replace(BALL_SYSTEM, measures=(MEAN_FORCE,)),
            "flight",
        ),
    ],
)
def test_a_wrong_measure_is_refused_in_one_sentence(call, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call()


def test_a_wheel_with_a_motor_has_measures_of_ones_own():
    """The mean force on the rear foot changes by the torque as a difference of gaits says."""
    level = vrw.WheelParams(slope=0.0)
    make_model = lambda torque: vrw.ViscoelasticWheel(hub_torque=torque)
    evaluate = lambda torque: vrw.limit_cycle(level, model=make_model(torque)).measure(MEAN_FORCE)
    table = vrw.sensitivities(level, measures=[MEAN_FORCE], model=make_model(47.23))
    difference = 5.0 * (evaluate(47.33) - evaluate(47.13))  # its error is 1e-5 relative
    derivative = table.derivative.sel(measure="mean_rear_force", parameter="hub.torque")
    assert float(derivative) == pytest.approx(float(difference), rel=1e-4)


@pytest.mark.parametrize(
    "call",
    [
        lambda: vrw.measure("period")(lambda step, params: step.duration),
        lambda: vrw.sensitivities(WHEEL, measures=[SPEED]),
        lambda: vrw.scan(vrw.samples(damping=[150.0]), [SPEED]),
        lambda: vrw.continue_branch(WHEEL, "damping", (140.0, 150.0), measures=[SPEED]),
    ],
)
def test_a_measure_with_the_name_of_another_is_refused(call):
    with pytest.raises(ValueError, match="which the library uses"):
        call()

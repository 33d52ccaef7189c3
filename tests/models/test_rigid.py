"""The rigid wheel agrees with published closed forms, quadrature and the limit of stiff legs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special
from support.batched import compute_full_steps, make_parameter_rows

import vrw_jax as vrw
from vrw_jax.models.rigid import _compute_rolling_time, evaluate_carlson_rf

HALF_ANGLE = np.pi / 8
# Point mass at the hub, l = 1, g = 9.8, slope 0.15: Tedrake, Underactuated Robotics.
POINT_MASS_WHEEL = vrw.WheelParams(hub_mass=1.0, leg_mass=1e-15, gravity=9.8, slope=0.15)


def rigid_walks(**changes):
    """Return a wheel without lift-off, so that only the map matters."""
    return vrw.RigidWheel(stop_at_lift_off=False, **changes)


def test_the_published_fixed_point_and_multiplier():
    model = vrw.RigidWheel()
    x = model.compute_default_start(POINT_MASS_WHEEL)
    result = vrw.step(POINT_MASS_WHEEL, x, model=model)
    assert int(result.outcome) == vrw.Outcome.STEPPED
    assert abs(float(result.post_impact[1]) - 1.497247441300221) < 1e-12
    np.testing.assert_allclose(result.section_state, x, rtol=1e-13)
    slope = jax.jacfwd(lambda x: vrw.return_map(POINT_MASS_WHEEL, x, model=model))(x)
    assert abs(float(slope[1, 1]) - 0.5) < 1e-12


def test_leg_masses_enter_by_their_inertia_about_the_hub():
    p = vrw.WheelParams(slope=0.15)
    mass, inertia = 10.0 + 8.0, 8.0 * 0.7**2
    result = vrw.step(p, [HALF_ANGLE, 2.0, 0.0], model=rigid_walks())
    retained_share = (mass * np.cos(np.pi / 4) + inertia) / (mass + inertia)
    np.testing.assert_allclose(result.post_impact[1], 2.0 * retained_share, rtol=1e-14)
    gained = 4.0 * mass * 9.81 * np.sin(HALF_ANGLE) * np.sin(0.15) / (mass + inertia)
    np.testing.assert_allclose(
        result.section_state[1], np.sqrt((2.0 * retained_share) ** 2 + gained)
    )


@pytest.mark.parametrize("slope", [0.1, 0.3, 0.39, 0.45])
@pytest.mark.parametrize("rate", [1.3, 2.0, 4.0])
def test_the_period_agrees_with_quadrature(slope, rate):
    result = vrw.step(vrw.WheelParams(slope=slope), [HALF_ANGLE, rate, 0.0], model=rigid_walks())
    if int(result.outcome) == vrw.Outcome.FELL_BACK:
        assert rate * float(result.post_impact[1]) / rate < 1.1  # too slow for the apex
        return
    start = float(result.post_impact[1])
    g_over_l = 18.0 * 9.81 / (18.0 + 8.0 * 0.7**2)
    squared = lambda angle: (
        start**2 + 2.0 * g_over_l * (np.cos(slope - HALF_ANGLE) - np.cos(angle + slope))
    )
    reference_period, _ = integrate.quad(
        lambda angle: 1.0 / np.sqrt(squared(angle)),
        -HALF_ANGLE,
        HALF_ANGLE,
        epsabs=1e-13,
        epsrel=1e-13,
    )
    assert abs(float(result.period) - reference_period) < 1e-12


def test_carlsons_integral_agrees_with_scipy():
    rng = np.random.default_rng(3)
    x, y, z = rng.uniform(0.0, 5.0, (3, 50))
    np.testing.assert_allclose(
        jax.vmap(evaluate_carlson_rf)(x, y, z), special.elliprf(x, y, z), rtol=1e-14
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_time_to_an_angle_out_of_reach_has_finite_derivatives(dtype):
    arguments = [jnp.asarray(x, dtype) for x in (0.01, 0.01, -20.0, 5.0)]
    value, gradient = jax.value_and_grad(_compute_rolling_time, argnums=(0, 1, 2, 3))(*arguments)
    assert value == 0.0
    assert np.all(np.isfinite(gradient))


def test_too_slow_a_start_falls_back():
    result = vrw.step(vrw.WheelParams(slope=0.1), [HALF_ANGLE, 0.5, 0.0], model=vrw.RigidWheel())
    assert int(result.outcome) == vrw.Outcome.FELL_BACK


@pytest.mark.parametrize("rate", [3.4, 3.5, 3.6])
def test_a_wheel_that_lands_before_the_vertical_steps(rate):
    """On a slope below -alpha/2 the vertical lies beyond the next landing."""
    params = vrw.WheelParams(slope=-0.6)
    result = vrw.step(params, [HALF_ANGLE, rate, 0.0], model=rigid_walks())
    mass, inertia = 10.0 + 8.0, 8.0 * 0.7**2
    retained_share = (mass * np.cos(np.pi / 4) + inertia) / (mass + inertia)
    gained = 4.0 * mass * 9.81 * np.sin(HALF_ANGLE) * np.sin(-0.6) / (mass + inertia)
    squared_rate = (rate * retained_share) ** 2 + gained
    assert (int(result.outcome) == vrw.Outcome.STEPPED) == (squared_rate > 0.0) == (rate > 3.46)
    np.testing.assert_allclose(result.section_state[1] ** 2, max(squared_rate, 0.0), rtol=1e-12)


@eqx.filter_jit
def finish(model, params, theta, dtheta):
    state = jnp.stack([theta, 1.0, 1.0, dtheta, 0.0, 0.0])
    return model.finish_step(params, 2, 0.7, state, vrw.StepOptions())


@pytest.mark.parametrize("slope", [-0.6, 0.1, 0.3])
def test_the_rest_of_a_step_ends_as_the_whole_step(slope):
    params = vrw.WheelParams(slope=slope)
    for model in vrw.RigidWheel(), rigid_walks():
        outcomes = set()
        for rate in np.linspace(0.3, 5.5, 27):
            step = vrw.step(params, [HALF_ANGLE, rate, 0.0], model=model)
            rest = finish(model, params, *step.post_impact)
            assert int(rest.outcome) == int(step.outcome)
            np.testing.assert_allclose(rest.section_state, step.section_state, rtol=1e-13)
            np.testing.assert_allclose(rest.durations, step.durations, rtol=1e-13)
            outcomes.add(int(step.outcome))
        assert len(outcomes) == 2 + (model.stop_at_lift_off and slope > 0.0)


def test_an_invalid_rest_of_a_step_is_bad_input():
    for state in (np.nan, 1.0), (0.0, np.inf), (2.0, 1.0):
        result = finish(vrw.RigidWheel(), vrw.WheelParams(), *state)
        assert int(result.outcome) == vrw.Outcome.BAD_INPUT
        assert not np.any(result.section_state)
        assert not np.any(result.durations)


def test_too_fast_a_start_lifts_off():
    result = vrw.step(vrw.WheelParams(slope=0.1), [HALF_ANGLE, 6.0, 0.0], model=vrw.RigidWheel())
    assert int(result.outcome) == vrw.Outcome.LEG_1_LIFTED_OFF


def test_derivatives_agree_with_differences():
    def value(slope):
        wheel = vrw.WheelParams(slope=slope)
        step = vrw.step(wheel, [HALF_ANGLE, 2.0, 0.0], model=rigid_walks())
        return jnp.stack([step.section_state[1], step.period, step.margins.fore_foot_force])

    h = 1e-4
    difference = (value(0.15 + h) - value(0.15 - h)) / (2 * h)
    forward, reverse = (transform(value)(0.15) for transform in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, difference, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-13)


@pytest.mark.parametrize("slope", [-HALF_ANGLE, HALF_ANGLE])
def test_a_motion_that_begins_or_ends_at_the_vertical_has_right_derivatives(slope):
    def measure_period(slope):
        params = vrw.WheelParams(slope=slope)
        return vrw.step(params, [HALF_ANGLE, 5.0, 0.0], model=rigid_walks()).period

    difference = (measure_period(slope + 1e-5) - measure_period(slope - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(measure_period)(slope), difference, rtol=1e-8)


def test_a_foothold_behind_the_start_is_touched_at_once():
    walk = vrw.walk(
        vrw.WheelParams(slope=0.15),
        [HALF_ANGLE, 1.5, 0.0],
        1,
        model=vrw.RigidWheel(),
        heights=[0.0, 0.7],
    )
    assert walk.outcome == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER


@pytest.mark.slow
def test_the_rigid_wheel_is_the_second_order_limit_of_the_viscoelastic_wheel():
    """k = k0/e^2, c = c0/e, L* - L0 = d e^2: preload and damping ratio stay, the leg stiffens.

    The limit keeps the paper's landing, whose rear foot is held during the impulse. The classic
    landing, whose rear foot takes none, is not its limit (docs/explanation/rigid_limit.md).
    """
    start = np.array([HALF_ANGLE, 2.0, 0.0])
    sizes = np.array([1 / 16, 1 / 32, 1 / 64])
    parameter_rows = make_parameter_rows(
        slope=0.15,
        stiffness=500.0 / sizes**2,
        damping=200.0 / sizes,
        natural_length=1.0 + 0.02 * sizes**2,
    )
    model = vrw.ViscoelasticWheel(stop_at_lift_off=False)
    soft = compute_full_steps(parameter_rows, np.tile(start, (3, 1)), model=model)
    assert np.all(np.asarray(soft.outcome) == vrw.Outcome.STEPPED)
    p = vrw.WheelParams(slope=0.15)
    step_result = vrw.step(p, start, model=rigid_walks(held_landing=True))
    classic = vrw.step(p, start, model=rigid_walks())
    errors = np.abs(np.asarray(soft.period) - float(step_result.period))
    rates = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(rates, 2.0, atol=0.1)
    assert abs(float(classic.section_state[1]) - float(soft.section_state[-1, 1])) > 0.1


def test_the_rigid_wheel_has_the_interface_of_the_other_models():
    p = vrw.WheelParams(slope=0.15)
    walk = vrw.walk(p, vrw.RigidWheel().compute_default_start(p), 3, model=vrw.RigidWheel())
    assert int(walk.outcome) in list(vrw.Outcome)
    data = vrw.simulate(
        POINT_MASS_WHEEL,
        vrw.RigidWheel().compute_default_start(POINT_MASS_WHEEL),
        2,
        model=vrw.RigidWheel(),
    )
    assert data.sizes["time"] > 10
    total = data["energy"] if "energy" in data else data["total_energy"]
    drops = np.diff(total.values)
    assert drops.max() < 1e-9

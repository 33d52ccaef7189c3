"""Derivatives of a step with unilateral contact through each event, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.wheel import ContactMode

TIGHT_OPTIONS = vrw.StepOptions.tight()
SLIP_MODES = (ContactMode.SLIP_DOWN, ContactMode.SLIP_UP)
STEP_SCENES = {  # friction, damping, dtheta at the start, stoppers; events that happen among others
    "lands sliding": (
        (0.7, 200.0, 1.6, "bilateral"),
        {"lands", "the fore leg leaves its stopper", "lifts off"},
    ),
    "reverses": ((0.5, 100.0, 2.2, "bilateral"), {"reverses", "slips", "sticks"}),
    "flies": (
        (0.5, 100.0, 1.2, "bilateral"),
        {"flies", "lands again", "meets its stopper", "slips", "sticks", "lifts off"},
    ),
    "stoppers only push": (
        (0.7, 200.0, 1.6, "one-sided"),
        {"leaves its stopper in the air", "meets its stopper"},
    ),
}


def classify_events(trace, first_locked):
    """Return the names of the events between the phases."""
    rows = np.flatnonzero(np.asarray(trace.duration) > 0.0)
    contact, locked = np.asarray(trace.contact)[rows], np.asarray(trace.locked)[rows]
    result = {"lands"}  # the opening landing
    if first_locked and not locked[0, 0]:
        result.add("the fore leg leaves its stopper")
    if np.any(np.all(contact == ContactMode.OFF, axis=1)):
        result.add("flies")
    for i in range(len(rows) - 1):
        for before, after, was, is_active in zip(
            *contact[i : i + 2], *locked[i : i + 2], strict=True
        ):
            if before == ContactMode.STICK and after in SLIP_MODES:
                result.add("slips")
            if before in SLIP_MODES and after == ContactMode.STICK:
                result.add("sticks")
            if before in SLIP_MODES and after in SLIP_MODES and before != after:
                result.add("reverses")
            if before != ContactMode.OFF and after == ContactMode.OFF:
                result.add("lifts off")
            if before == ContactMode.OFF and after != ContactMode.OFF:
                result.add("lands again")
            if is_active and not was:
                result.add("meets its stopper")
            if was and not is_active and after == ContactMode.OFF:
                result.add("leaves its stopper in the air")
    return result


def compute_step(mu, c, dtheta, stoppers):
    params = vrw.WheelParams(damping=c)
    wheel = vrw.UnilateralWheel(friction=mu, stoppers=stoppers)
    x = wheel.complete_section_state(
        params, jnp.stack([jnp.asarray(0.1), dtheta, jnp.asarray(-0.1)])
    )
    advance = wheel.advance(params, x, TIGHT_OPTIONS)
    times = advance.durations
    if stoppers == "one-sided":  # rounding says in which mode the least dips are spent
        times = times.sum(keepdims=True)
    return jnp.concatenate([advance.section_state[:20], times])


@pytest.mark.slow
@pytest.mark.parametrize("name", STEP_SCENES)
def test_derivatives_through_the_events_of_a_step_match_differences(name):
    (mu, c, dtheta, stoppers), kinds = STEP_SCENES[name]
    params = vrw.WheelParams(damping=c)
    wheel = vrw.UnilateralWheel(friction=mu, stoppers=stoppers)
    x = wheel.complete_section_state(params, jnp.asarray([0.1, dtheta, -0.1]))
    trace = wheel.sample_step(params, x, vrw.StepOptions(), 2)
    assert kinds <= classify_events(trace, bool(x[3 + 3 * params.n_legs] >= 4))
    argument_values = [jnp.asarray(v) for v in (mu, c, dtheta)]
    jacobian = jax.jacfwd(compute_step, argnums=(0, 1, 2))(*argument_values, stoppers)
    for i, column in enumerate(jacobian):
        size = 1e-5 * max(1.0, float(argument_values[i]))
        ends = [
            compute_step(
                *argument_values[:i], argument_values[i] + d, *argument_values[i + 1 :], stoppers
            )
            for d in (size, -size)
        ]
        difference = (ends[0] - ends[1]) / (2.0 * size)
        np.testing.assert_allclose(column, difference, atol=2e-6, rtol=2e-6)


def test_batched_gradients_equal_difference_quotients():
    """Machine code within `jit`, `vmap` and `grad`; each of these wheels has events of its own."""
    wheels = [STEP_SCENES[name][0] for name in ("lands sliding", "reverses", "flies")]
    argument_values = [jnp.asarray(column) for column in list(zip(*wheels, strict=True))[:3]]

    def evaluate(mu, c, dtheta):
        wheel, params = vrw.UnilateralWheel(friction=mu), vrw.WheelParams(damping=c)
        start = jnp.stack([jnp.asarray(0.1), dtheta, jnp.asarray(-0.1)])
        step = vrw.step(params, start, model=wheel, options=TIGHT_OPTIONS)
        return {"period": step.period, "slip": step.slip, "force": step.margins.stopper_force}

    values = jax.jit(jax.vmap(evaluate))
    slopes = jax.jit(jax.vmap(jax.jacrev(evaluate, argnums=(0, 1, 2))))(*argument_values)
    for i in range(len(argument_values)):
        size = 1e-5 * jnp.maximum(1.0, argument_values[i])
        ends = [
            values(*argument_values[:i], argument_values[i] + d, *argument_values[i + 1 :])
            for d in (size, -size)
        ]
        for name, slope in slopes.items():
            difference = (ends[0][name] - ends[1][name]) / (2.0 * size)
            np.testing.assert_allclose(slope[i], difference, rtol=1e-6, atol=1e-7, err_msg=name)


def test_derivatives_through_every_kind_of_event_are_tested():
    kinds = set.union(*(kinds for _, kinds in STEP_SCENES.values()))
    assert kinds == {
        "lands", "lifts off", "lands again", "flies", "slips", "sticks", "reverses",
        "meets its stopper", "the fore leg leaves its stopper", "leaves its stopper in the air",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["Tsit5", "Bosh3"])
def test_derivatives_are_accurate_if_only_stability_limits_the_solver_step(solver):
    """Compare with far shorter solver steps.

    A swinging leg decays at the rate c / m = 200 to 350 /s. The tolerance 0.02 is a ten-thousandth
    of this rate. Unstable tangents caused errors of 0.65 (Tsit5) and 0.025 (Bosh3).
    """
    damping = np.linspace(200.0, 350.0, 16)
    ground, params = vrw.UnilateralWheel(friction=0.7), vrw.WheelParams(damping=damping)
    batch_result = vrw.step_batch(params, np.tile((0.1, 1.6, -0.1), (16, 1)), 10, model=ground)
    assert not np.any(batch_result.outcome)

    def moved(tolerance):
        options = vrw.StepOptions(
            solver=solver, rtol=tolerance, atol=tolerance, derivative_tightening=1.0
        )
        given = params, batch_result.section_state
        requested = ("section_state", "natural_length")
        solution = vrw.step_batch(*given, model=ground, options=options, derivatives=requested)
        derivatives = [solution.derivatives[name].section_state for name in requested]
        return np.concatenate([derivatives[0], derivatives[1][:, :, None]], 2)

    reference = moved(1e-10 if solver == "Tsit5" else 1e-8)
    for tolerance in (5e-7, 3e-7, 2e-7):
        assert np.max(np.abs(moved(tolerance) - reference)) < 0.02

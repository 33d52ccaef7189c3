"""Derivatives of a step on real ground through each kind of event, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.models.unilateral.contacts import OFF, SLIP_DOWN, SLIP_UP, STICK

TIGHT = vrw.Options.tight()
SLIDES = (SLIP_DOWN, SLIP_UP)
SCENES = {  # friction, damping, dtheta at the start, stoppers; events that happen among others
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


def events_of(trace, first_locked):
    """What happened from phase to phase, in words."""
    rows = np.flatnonzero(np.asarray(trace.duration) > 0.0)
    contact, locked = np.asarray(trace.contact)[rows], np.asarray(trace.locked)[rows]
    told = {"lands"}  # the opening landing
    if first_locked and not locked[0, 0]:
        told.add("the fore leg leaves its stopper")
    if np.any(np.all(contact == OFF, axis=1)):
        told.add("flies")
    for i in range(len(rows) - 1):
        for before, after, was, on in zip(*contact[i : i + 2], *locked[i : i + 2], strict=True):
            if before == STICK and after in SLIDES:
                told.add("slips")
            if before in SLIDES and after == STICK:
                told.add("sticks")
            if before in SLIDES and after in SLIDES and before != after:
                told.add("reverses")
            if before != OFF and after == OFF:
                told.add("lifts off")
            if before == OFF and after != OFF:
                told.add("lands again")
            if on and not was:
                told.add("meets its stopper")
            if was and not on and after == OFF:
                told.add("leaves its stopper in the air")
    return told


def told(mu, c, dtheta, stoppers):
    params = vrw.WheelParams(damping=c)
    wheel = vrw.UnilateralWheel(friction=mu, stoppers=stoppers)
    x = wheel.full_section(params, jnp.stack([jnp.asarray(0.1), dtheta, jnp.asarray(-0.1)]))
    advance = wheel.advance(params, x, TIGHT)
    times = advance.durations
    if stoppers == "one-sided":  # rounding says in which mode the least dips are spent
        times = times.sum(keepdims=True)
    return jnp.concatenate([advance.section_state[:20], times])


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_derivatives_through_the_events_of_a_step_match_differences(name):
    (mu, c, dtheta, stoppers), kinds = SCENES[name]
    params = vrw.WheelParams(damping=c)
    wheel = vrw.UnilateralWheel(friction=mu, stoppers=stoppers)
    x = wheel.full_section(params, jnp.asarray([0.1, dtheta, -0.1]))
    trace = wheel.trace(params, x, vrw.Options(), 2)
    assert kinds <= events_of(trace, bool(x[3 + 3 * params.n_legs] >= 4))
    at = [jnp.asarray(v) for v in (mu, c, dtheta)]
    jacobian = jax.jacfwd(told, argnums=(0, 1, 2))(*at, stoppers)
    for i, column in enumerate(jacobian):
        size = 1e-5 * max(1.0, float(at[i]))
        ends = [told(*at[:i], at[i] + d, *at[i + 1 :], stoppers) for d in (size, -size)]
        difference = (ends[0] - ends[1]) / (2.0 * size)
        np.testing.assert_allclose(column, difference, atol=2e-6, rtol=2e-6)


def test_wheels_side_by_side_have_the_gradients_that_differences_have():
    """Machine code within `jit`, `vmap` and `grad`; each of these wheels has events of its own."""
    wheels = [SCENES[name][0] for name in ("lands sliding", "reverses", "flies")]
    at = [jnp.asarray(column) for column in list(zip(*wheels, strict=True))[:3]]

    def told(mu, c, dtheta):
        wheel, params = vrw.UnilateralWheel(friction=mu), vrw.WheelParams(damping=c)
        start = jnp.stack([jnp.asarray(0.1), dtheta, jnp.asarray(-0.1)])
        step = vrw.step(params, start, model=wheel, options=TIGHT)
        return {"period": step.period, "slip": step.slip, "force": step.monitors.stopper_force}

    values = jax.jit(jax.vmap(told))
    slopes = jax.jit(jax.vmap(jax.jacrev(told, argnums=(0, 1, 2))))(*at)
    for i in range(len(at)):
        size = 1e-5 * jnp.maximum(1.0, at[i])
        ends = [values(*at[:i], at[i] + d, *at[i + 1 :]) for d in (size, -size)]
        for name, slope in slopes.items():
            difference = (ends[0][name] - ends[1][name]) / (2.0 * size)
            np.testing.assert_allclose(slope[i], difference, rtol=1e-6, atol=1e-7, err_msg=name)


def test_every_kind_of_event_is_differentiated_through():
    kinds = set.union(*(kinds for _, kinds in SCENES.values()))
    assert kinds == {
        "lands", "lifts off", "lands again", "flies", "slips", "sticks", "reverses",
        "meets its stopper", "the fore leg leaves its stopper", "leaves its stopper in the air",
    }  # fmt: skip


@pytest.mark.parametrize("solver", ["Tsit5", "Bosh3"])
def test_derivatives_are_right_where_only_stability_limits_the_step(solver):
    """Oracle: the same by far shorter steps. 0.02 is a ten-thousandth of the rate, c / m = 200 to
    350 /s, at which a leg that swings decays (0.006 is found); where directions grew in it instead
    they were wrong by 0.65 (Tsit5) and 0.025."""
    damping = np.linspace(200.0, 350.0, 16)
    ground, params = vrw.UnilateralWheel(friction=0.7), vrw.WheelParams(damping=damping)
    begun = vrw.steps(params, np.tile((0.1, 1.6, -0.1), (16, 1)), 10, model=ground)
    assert not np.any(begun.outcome)

    def moved(tolerance):
        options = vrw.Options(
            solver=solver, rtol=tolerance, atol=tolerance, derivative_tightening=1.0
        )
        given = params, begun.section_state
        asked = ("section_state", "natural_length")
        found = vrw.steps(*given, model=ground, options=options, derivatives=asked)
        whole = [found.derivatives[name].section_state for name in asked]
        return np.concatenate([whole[0], whole[1][:, :, None]], 2)

    truth = moved(1e-10 if solver == "Tsit5" else 1e-8)
    for tolerance in (5e-7, 3e-7, 2e-7):
        assert np.max(np.abs(moved(tolerance) - truth)) < 0.02

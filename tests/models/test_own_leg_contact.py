"""Unilateral contact with laws of the legs and of the hub that a user gives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity
from support.leg_laws import QuadraticDamper
from support.slow_variants import ENGINES

import vrw_jax as vrw

PARAMS = vrw.WheelParams(damping=100.0, stiffness=2000.0)
START_IN_FLIGHT = np.array([0.1, 1.2, -0.1])
"""Section state of a step in which all feet leave the ground, with a friction of 0.5."""
TIGHT_OPTIONS = vrw.StepOptions.tight()


class Brake(eqx.Module):
    """A torque on the hub that falls with the rate."""

    torque: float = 4.0
    slope: float = 3.0

    def __call__(self, dtheta, params):
        return self.torque - self.slope * dtheta


def make_wheel(law, friction=0.5, **laws):
    return vrw.UnilateralWheel(friction=friction, leg_force=law, **laws)


def make_reference(law, friction=0.5, **laws):
    evaluate = lambda L, dL: np.asarray(law(L, dL, PARAMS))
    return complementarity.ComplementarityWheel(friction, leg_force=evaluate, **laws)


def compute_section_state(place):
    q, v = place.q, place.v
    return np.r_[q[2] + complementarity.ALPHA, v[2], v[:2], np.roll(q[3:], -1), np.roll(v[3:], -1)]


@pytest.mark.parametrize("engine", ENGINES)
def test_the_papers_law_as_a_law_gives_the_papers_step_with_flight(engine):
    expected, step = (
        vrw.step(PARAMS, START_IN_FLIGHT, model=model, engine=engine)
        for model in (
            vrw.UnilateralWheel(friction=0.5),
            make_wheel(QuadraticDamper(0.0), hub_torque=Brake(0.0, 0.0)),
        )
    )
    for value, expected_value in zip(jax.tree.leaves(step), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(value, expected_value, rtol=1e-9, atol=1e-9)


def test_a_step_with_flight_agrees_with_another_event_driven_code():
    law = QuadraticDamper(20.0)
    model = make_wheel(law, hub_torque=Brake())
    step = vrw.step(PARAMS, START_IN_FLIGHT, model=model, options=TIGHT_OPTIONS)
    reference_wheel = make_reference(law, hub_torque=lambda rate: 4.0 - 3.0 * rate)
    place = complementarity.paper_start(reference_wheel, *START_IN_FLIGHT)
    reference = complementarity.compute_step(reference_wheel, place)
    assert reference.durations[2] > 0.01  # s, without a foot on the ground
    np.testing.assert_allclose(step.durations, reference.durations, atol=5e-11)
    end = compute_section_state(reference.end)
    np.testing.assert_allclose(step.section_state[:20], end, atol=1e-10)


def test_two_legs_in_turn_agree_with_another_event_driven_code():
    laws = QuadraticDamper(60.0), QuadraticDamper(5.0)
    x, params = vrw.paper_start(), PARAMS
    batch = vrw.step_batch(
        params,
        np.asarray(x)[None],
        2,
        model=make_wheel(vrw.AlternatingLegs(*laws), 0.7),
        options=TIGHT_OPTIONS,
    )
    place = None
    for first, second in (laws, laws[::-1]):
        alternate = lambda L, dL, p, laws=(first, second): np.where(
            np.arange(len(L)) % 2 == 0, *(law(L, dL, p) for law in laws)
        )
        wheel = make_reference(alternate, 0.7)
        place = place or complementarity.paper_start(wheel, *x)
        place = complementarity.compute_step(wheel, place).end
    end = compute_section_state(place)
    np.testing.assert_allclose(batch.section_state[0, :20], end, atol=1e-9)
    walk = vrw.walk(params, x, 2, model=make_wheel(vrw.AlternatingLegs(*laws), 0.7))
    np.testing.assert_allclose(walk.steps.section_state[-1, :20], end, atol=1e-6)


def test_derivatives_by_parameters_of_laws_pass_through_flight():
    """The reference are central differences of steps at tight tolerances."""

    def advance(values):
        model = make_wheel(QuadraticDamper(values[0]), hub_torque=values[1])
        return vrw.step(PARAMS, START_IN_FLIGHT, model=model, options=TIGHT_OPTIONS).section_state

    values, shifts = np.array([20.0, 4.0]), np.diag([1e-2, 1e-3])
    differences = [
        (advance(values + shift) - advance(values - shift)) / (2.0 * shift.sum())
        for shift in shifts
    ]
    jacobian = jax.jacfwd(advance)(jnp.asarray(values))
    np.testing.assert_allclose(jacobian.T, differences, rtol=1e-5, atol=1e-8)
    batch = vrw.step_batch(
        PARAMS,
        START_IN_FLIGHT[None],
        model=make_wheel(QuadraticDamper(20.0), hub_torque=4.0),
        derivatives=("leg.c2", "hub.torque"),
    )
    for name, column in zip(("leg.c2", "hub.torque"), jacobian.T, strict=True):
        np.testing.assert_allclose(
            batch.derivatives[name].section_state[0], column, rtol=1e-6, atol=1e-9
        )

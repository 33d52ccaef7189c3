"""The phases of the paper's step keep their interface, and every engine uses them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.flow import integrate_batch_phase, load_explicit_tableau
from vrw_jax.gaits import PhasePoint
from vrw_jax.gaits import phase_sequence as sequence
from vrw_jax.hybrid import integrate_phase
from vrw_jax.models import viscoelastic as lane_step
from vrw_jax.models.phase_sequence import make_element_phase
from vrw_jax.wheel import (
    PAPER_PHASES,
    Outcome,
    PhaseInstant,
    PhaseMargins,
    compute_landing_foot_height,
    compute_rear_foot_height,
    dynamics,
    make_paper_phases,
    stack_parameters,
    transitions,
)
from vrw_jax.wheel.dynamics import compute_double_support_circle
from vrw_jax.wheel.params import NO_LAWS

PARAMS = vrw.WheelParams()
SYMBOLS = PARAMS.symbols()
GAIT = jnp.asarray([0.1027, 1.611, -0.1093])
STATE_DISTANCE = transitions.resolve_landing(SYMBOLS, *GAIT).foot_distance
PHASE_STATES = (
    ((-0.6,), (1.2,)),
    ((-0.3, 0.97, 0.93), (1.1, -0.2, 0.4)),
    ((-0.1, 0.96), (1.2, 0.1)),
)
"""Coordinates and rates within each phase, none of them at an end."""
NAMES = [phase.phase_name for phase in PAPER_PHASES]
each = pytest.mark.parametrize("index", range(3), ids=NAMES)


def make_state_at(index, distance=STATE_DISTANCE, stop_at_lift_off=True):
    """Return a phase, and coordinates and rates in it."""
    q, v = (tuple(map(jnp.asarray, x)) for x in PHASE_STATES[index])
    return make_paper_phases(SYMBOLS, distance, stop_at_lift_off)[index], q, v


@each
def test_the_residual_vanishes_at_the_acceleration_and_is_linear_in_it(index):
    phase, q, v = make_state_at(index)
    motion = phase.compute_motion(q, v)
    accelerations = phase.solve_acceleration(motion)[: phase.n_dof]
    np.testing.assert_allclose(
        phase.compute_dynamics_residual(motion, accelerations), 0.0, atol=1e-12
    )
    shifted_rows = [
        phase.compute_dynamics_residual(motion, tuple(a + k for a in accelerations))
        for k in (1.0, 2.0)
    ]
    assert np.min(np.abs(shifted_rows[0])) > 0.1
    np.testing.assert_allclose(shifted_rows[1], 2.0 * np.asarray(shifted_rows[0]), rtol=1e-12)


@each
def test_dependent_coordinates_follow_those_of_the_phase(index):
    phase, q, v = make_state_at(index)
    accelerations = phase.solve_acceleration(phase.compute_motion(q, v))[: phase.n_dof]
    evaluate_along = lambda q, v: jnp.stack(phase.compute_motion(q, v))
    motion, rates = jax.jvp(evaluate_along, (q, v), (v, accelerations))
    m = phase.compute_motion(q, v)
    np.testing.assert_allclose(
        rates[:2], [m.cos_theta * m.dtheta, -m.sin_theta * m.dtheta], rtol=1e-14
    )
    np.testing.assert_allclose(rates[2:4], motion[5:], rtol=1e-12, atol=1e-15)
    for complete in (
        phase.complete_wheel_acceleration(m, accelerations),
        phase.solve_acceleration(m),
    ):
        np.testing.assert_allclose(rates[4:], jnp.stack(complete), rtol=1e-12, atol=1e-14)


@each
def test_phase_coordinates_reproduce_the_motion(index):
    phase, q, v = make_state_at(index)
    assert phase.select_phase_coordinates(q[0], phase.compute_motion(q, v)) == (q, v)


def test_forces_agree_with_the_equations_of_motion():
    phase, q, v = make_state_at(0)
    current_value = PhaseInstant(phase, phase.compute_motion(q, v), None)
    M, _, f2, f3 = dynamics.compute_equation_terms(SYMBOLS, current_value.motion)
    needed = M.multiply_vector(current_value.acceleration)
    rear = dynamics.compute_rear_force_from_residual(
        SYMBOLS, current_value.motion, needed[1] - f2, needed[2] - f3
    )
    np.testing.assert_allclose(current_value.rear_force, rear)
    for index in (1, 2):
        phase, q, v = make_state_at(index)
        assert PhaseInstant(phase, phase.compute_motion(q, v), None).rear_force is None


@pytest.mark.parametrize("stop_at_lift_off", [True, False])
@each
def test_guards_have_meanings_and_margins_have_names(index, stop_at_lift_off):
    phase, q, v = make_state_at(index, stop_at_lift_off=stop_at_lift_off)
    current_value = PhaseInstant(phase, phase.compute_motion(q, v), None)
    guards, margins = phase.compute_guards(current_value), phase.compute_margins(current_value)
    assert len(guards) == len(phase.all_guard_outcomes)
    assert phase.all_guard_outcomes[0] == Outcome.STEPPED
    assert guards[0] == phase.compute_end_guard(current_value)
    assert (Outcome.LEG_1_LIFTED_OFF in phase.all_guard_outcomes) == stop_at_lift_off
    assert len(margins) == len(phase.are_margins_counted_at_start)
    named = PhaseMargins.from_margin_values(margins, SYMBOLS.n)
    assert named.fore_foot_force == current_value.fore_force.normal
    assert len(named.locked_stopper_force) == SYMBOLS.n - 2
    assert (named.rear_clearance is None) == (index == 0)
    assert (named.rear_stopper_force is None) == (index < 2)
    if index > 0:
        assert named.rear_clearance == compute_rear_foot_height(SYMBOLS, current_value.motion)


@pytest.mark.parametrize("n_legs", [5, 8])
def test_double_support_is_the_three_equations_restricted_to_its_circle(n_legs):
    """w M w ddtheta = w (f + M (0, L1, L2) dtheta^2) with w = (1, G1, G2), whose second slopes are
    -L1 and -L2; rounding alone lies between."""
    random = np.random.default_rng(0)
    select = lambda low, high: random.uniform(low, high, 1000)
    s = vrw.WheelParams(
        damping=select(5, 400), stiffness=select(200, 1200),
        natural_length=select(1, 1.1), slope=select(0, 0.5),
        leg_mass=select(0.3, 2), leg_com=select(0.1, 0.9), hub_mass=select(1, 20), n_legs=n_legs,
    ).symbols()  # fmt: skip
    distance, theta, dtheta = select(0.3, 1.2), select(-1, 0.5), select(-2, 3)
    motion = PAPER_PHASES[0](s, (distance,), True).compute_motion((theta,), (dtheta,))
    circle = compute_double_support_circle(s, distance, motion.sin_theta, motion.cos_theta)
    mass, *force = dynamics.compute_equation_terms(s, motion)
    w = np.stack([np.ones(1000), circle.dL1_dtheta, circle.dL2_dtheta])
    restricted = np.stack(mass.multiply_vector(tuple(w)))
    inertia = np.sum(w * restricted, 0)
    turning = np.sum(w * np.stack(force), 0)
    turning += dtheta**2 * (circle.L1 * restricted[1] + circle.L2 * restricted[2])
    result = dynamics.compute_double_support_equation(s, distance, motion)
    np.testing.assert_allclose(result.generalized_inertia, inertia, rtol=1e-14)
    size = np.sum(np.abs(w * np.stack(force)), 0)  # of what cancels in the sum
    assert np.max(np.abs(result.generalized_force - turning) / size) < 1e-13


@each
def test_the_outcome_of_a_phase_end_matches_its_guard(index):
    phase, _, _ = make_state_at(index)
    guards = jnp.arange(-1, len(phase.all_guard_outcomes), dtype=jnp.int32)
    expected = [Outcome.SOLVER_FAILED, *phase.all_guard_outcomes]
    np.testing.assert_array_equal(phase.select_guard_outcome(guards, guards > 99), expected)
    outcome_after_timeout = phase.select_guard_outcome(guards, guards == -1)
    np.testing.assert_array_equal(
        outcome_after_timeout, [Outcome.NO_TOUCHDOWN_IN_TIME, *phase.all_guard_outcomes]
    )


def test_guards_are_positive_along_a_gait_until_the_end():
    trajectory = vrw.simulate(PARAMS, GAIT, n_steps=1)
    names = ("theta", "L1", "L2", "dtheta", "dL1", "dL2")
    states = jnp.stack([np.asarray(trajectory[name]) for name in names]).reshape(6, 3, -1)
    for index, phase in enumerate(make_paper_phases(SYMBOLS, STATE_DISTANCE, True)):
        q, v = (tuple(part[: phase.n_dof, index]) for part in (states[:3], states[3:]))
        guards = jnp.stack(
            phase.compute_guards(PhaseInstant(phase, phase.compute_motion(q, v), None))
        )
        assert jnp.all(guards[:, 1:-1] > 0.0)
        assert abs(guards[0, -1]) < 1e-7 * jnp.max(guards[0])


def test_resets_agree_with_the_collisions():
    dls, sls1, _ = make_paper_phases(SYMBOLS, STATE_DISTANCE, True)
    m = dls.compute_motion(*(tuple(map(jnp.asarray, x)) for x in PHASE_STATES[0]))
    assert dls.reset_motion(m) == m
    _, q, v = make_state_at(1)
    before = sls1.compute_motion(q, v)
    hit = transitions.resolve_stopper_collision(SYMBOLS, before).motion_after
    np.testing.assert_array_equal(jnp.stack(sls1.reset_motion(before)), jnp.stack(hit))
    constants = sequence.compute_phase_constants(PARAMS.n_legs, NO_LAWS, *stack_parameters(PARAMS))
    following = (
        sequence.make_post_impact_sequence(PARAMS.n_legs)
        .phases[1]
        .reset_map(constants, PhasePoint((), q, v))
    )
    np.testing.assert_array_equal(following.q, [q[0], hit.L1])
    np.testing.assert_array_equal(following.v, [hit.dtheta, hit.dL1])


# --- Every engine uses the same phase.


def end_by_diffrax():
    phase, q, v = make_state_at(2)
    flow = make_element_phase(phase, records_margins=False)
    start = jnp.stack([*q, *v])
    run = jax.jit(
        lambda y: (
            integrate_phase(flow.vector_field, flow.guards, y, y[0] < 9.0, vrw.StepOptions()).state
        )
    )
    end = run(start)
    return tuple(end[:2]), tuple(end[2:])


def end_by_lane_engine():
    phase, q, v = make_state_at(2)
    lanes = lambda x: tuple(jnp.tile(number, 8) for number in x)
    phase_of = lambda *_: lane_step.make_batch_phase(phase, records_margins=False)
    end = integrate_batch_phase(
        phase_of, (), (), load_explicit_tableau("Bosh3"), lanes(q), lanes(v),
        jnp.ones(8, bool), jnp.full(8, 5e-3), vrw.StepOptions(),
    ).state  # fmt: skip
    return tuple(x[0] for x in end.q), tuple(x[0] for x in end.v)


def end_by_cycle_collocation():
    """Apply Newton's method to the angle of the event."""
    phase = sequence.make_post_impact_sequence(PARAMS.n_legs).phases[2]
    constants = sequence.compute_phase_constants(PARAMS.n_legs, NO_LAWS, *stack_parameters(PARAMS))
    _, q, v = make_state_at(2)
    event = lambda theta: phase.end_event_function(constants, PhasePoint((), (theta, q[1]), v))
    theta = q[0]
    for _ in range(8):
        theta = theta - event(theta) / jax.grad(event)(theta)
    assert phase.guards_function(constants, PhasePoint((), (theta, q[1]), v))[0] == event(theta)
    return (theta, q[1]), v


@pytest.mark.parametrize(
    "engine",
    [end_by_diffrax, end_by_lane_engine, end_by_cycle_collocation],
)
def test_every_engine_ends_the_phase_at_its_guard(engine, monkeypatch):
    def height():
        q, v = engine()
        return float(
            compute_landing_foot_height(
                SYMBOLS, PAPER_PHASES[2](SYMBOLS, (), True).compute_motion(q, v)
            )
        )

    assert abs(height()) < 1e-8
    sooner = lambda self, now: compute_landing_foot_height(self.s, now.motion) - 0.01
    monkeypatch.setattr(PAPER_PHASES[2], "compute_end_guard", sooner)
    assert abs(height() - 0.01) < 1e-8

"""The phases of the paper's step: what they promise to every engine, and that each reads them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.batches import fixed_work
from vrw_jax.cycles import sequence
from vrw_jax.models import lane_step
from vrw_jax.models.viscoelastic import flow_of
from vrw_jax.numerics import Mesh, Point, explicit_tableau, integrate_lanes, integrate_phase
from vrw_jax.wheel import (
    PHASES,
    Instant,
    Outcome,
    Premises,
    dynamics,
    landing_foot_height,
    parameters_of,
    phases_of,
    rear_foot_height,
    transitions,
)
from vrw_jax.wheel.geometry import double_support_circle

PARAMS = vrw.WheelParams()
SYMBOLS = PARAMS.symbols()
GAIT = jnp.asarray([0.1027, 1.611, -0.1093])
DISTANCE = transitions.land(SYMBOLS, *GAIT).distance
STATES = (
    ((-0.6,), (1.2,)),
    ((-0.3, 0.97, 0.93), (1.1, -0.2, 0.4)),
    ((-0.1, 0.96), (1.2, 0.1)),
)
"""Coordinates and rates within each phase, none of them at an end."""
NAMES = [phase.name for phase in PHASES]
each = pytest.mark.parametrize("index", range(3), ids=NAMES)


def at(index, distance=DISTANCE, stop_at_lift_off=True):
    """A phase, and coordinates and rates in it."""
    q, v = (tuple(map(jnp.asarray, x)) for x in STATES[index])
    return phases_of(SYMBOLS, distance, stop_at_lift_off)[index], q, v


@each
def test_the_residual_vanishes_at_the_acceleration_and_is_linear_in_it(index):
    phase, q, v = at(index)
    motion = phase.at(q, v)
    own = phase.acceleration(motion)[: phase.n]
    np.testing.assert_allclose(phase.residual(motion, own), 0.0, atol=1e-12)
    moved = [phase.residual(motion, tuple(a + k for a in own)) for k in (1.0, 2.0)]
    assert np.min(np.abs(moved[0])) > 0.1
    np.testing.assert_allclose(moved[1], 2.0 * np.asarray(moved[0]), rtol=1e-12)


@each
def test_the_other_coordinates_move_as_the_phase_s_own_ones_make_them(index):
    phase, q, v = at(index)
    own = phase.acceleration(phase.at(q, v))[: phase.n]
    along = lambda q, v: jnp.stack(phase.at(q, v))
    motion, rates = jax.jvp(along, (q, v), (v, own))
    m = phase.at(q, v)
    np.testing.assert_allclose(rates[:2], [m.cos * m.dtheta, -m.sin * m.dtheta], rtol=1e-14)
    np.testing.assert_allclose(rates[2:4], motion[5:], rtol=1e-12, atol=1e-15)
    for complete in (phase.complete(m, own), phase.acceleration(m)):
        np.testing.assert_allclose(rates[4:], jnp.stack(complete), rtol=1e-12, atol=1e-14)


@each
def test_own_coordinates_give_the_motion_back(index):
    phase, q, v = at(index)
    assert phase.own(q[0], phase.at(q, v)) == (q, v)


def test_forces_are_those_of_the_equations_of_motion():
    phase, q, v = at(0)
    now = Instant(phase, phase.at(q, v), None)
    M, _, f2, f3 = dynamics.terms(SYMBOLS, now.motion)
    needed = M.times(now.acceleration)
    rear = dynamics.foot_force_from_residual(SYMBOLS, now.motion, needed[1] - f2, needed[2] - f3)
    np.testing.assert_allclose(now.rear, rear)
    for index in (1, 2):
        phase, q, v = at(index)
        assert Instant(phase, phase.at(q, v), None).rear is None


@pytest.mark.parametrize("stop_at_lift_off", [True, False])
@each
def test_guards_have_meanings_and_premises_names(index, stop_at_lift_off):
    phase, q, v = at(index, stop_at_lift_off=stop_at_lift_off)
    now = Instant(phase, phase.at(q, v), None)
    guards, premises = phase.guards(now), phase.premises(now)
    assert len(guards) == len(phase.outcomes)
    assert phase.outcomes[0] == Outcome.STEPPED
    assert guards[0] == phase.end(now)
    assert (Outcome.LEG_1_LIFTED_OFF in phase.outcomes) == stop_at_lift_off
    assert len(premises) == len(phase.counts_at_start)
    named = Premises.named(premises, SYMBOLS.n)
    assert named.fore_foot_force == now.fore.normal
    assert len(named.locked_stopper_force) == SYMBOLS.n - 2
    assert (named.rear_clearance is None) == (index == 0)
    assert (named.rear_stopper_force is None) == (index < 2)
    if index > 0:
        assert named.rear_clearance == rear_foot_height(SYMBOLS, now.motion)


@pytest.mark.parametrize("n_legs", [5, 8])
def test_double_support_is_the_three_equations_restricted_to_its_circle(n_legs):
    """w M w ddtheta = w (f + M (0, L1, L2) dtheta^2) with w = (1, G1, G2), whose second slopes are
    -L1 and -L2; rounding alone lies between."""
    random = np.random.default_rng(0)
    of = lambda low, high: random.uniform(low, high, 1000)
    s = vrw.WheelParams(
        damping=of(5, 400), stiffness=of(200, 1200), natural_length=of(1, 1.1), slope=of(0, 0.5),
        leg_mass=of(0.3, 2), leg_com=of(0.1, 0.9), hub_mass=of(1, 20), n_legs=n_legs,
    ).symbols()  # fmt: skip
    distance, theta, dtheta = of(0.3, 1.2), of(-1, 0.5), of(-2, 3)
    motion = PHASES[0](s, (distance,), True).at((theta,), (dtheta,))
    circle = double_support_circle(s, distance, motion.sin, motion.cos)
    mass, *force = dynamics.terms(s, motion)
    w = np.stack([np.ones(1000), circle.G1, circle.G2])
    restricted = np.stack(mass.times(tuple(w)))
    inertia = np.sum(w * restricted, 0)
    turning = np.sum(w * np.stack(force), 0)
    turning += dtheta**2 * (circle.L1 * restricted[1] + circle.L2 * restricted[2])
    told = dynamics.double_support(s, distance, motion)
    np.testing.assert_allclose(told.inertia, inertia, rtol=1e-14)
    size = np.sum(np.abs(w * np.stack(force)), 0)  # of what cancels in the sum
    assert np.max(np.abs(told.force - turning) / size) < 1e-13


@each
def test_the_code_of_an_end_is_what_its_guard_means(index):
    phase, _, _ = at(index)
    guards = jnp.arange(-1, len(phase.outcomes), dtype=jnp.int32)
    expected = [Outcome.SOLVER_GAVE_UP, *phase.outcomes]
    np.testing.assert_array_equal(phase.outcome(guards, guards > 99), expected)
    late = phase.outcome(guards, guards == -1)
    np.testing.assert_array_equal(late, [Outcome.NO_TOUCHDOWN_IN_TIME, *phase.outcomes])


def test_guards_are_positive_along_a_gait_until_the_end():
    told = vrw.simulate(PARAMS, GAIT, n_steps=1)
    names = ("theta", "L1", "L2", "dtheta", "dL1", "dL2")
    states = jnp.stack([np.asarray(told[name]) for name in names]).reshape(6, 3, -1)
    for index, phase in enumerate(phases_of(SYMBOLS, DISTANCE, True)):
        q, v = (tuple(part[: phase.n, index]) for part in (states[:3], states[3:]))
        guards = jnp.stack(phase.guards(Instant(phase, phase.at(q, v), None)))
        assert jnp.all(guards[:, 1:-1] > 0.0)
        assert abs(guards[0, -1]) < 1e-7 * jnp.max(guards[0])


def test_resets_are_those_of_the_collisions():
    dls, sls1, _ = phases_of(SYMBOLS, DISTANCE, True)
    m = dls.at(*(tuple(map(jnp.asarray, x)) for x in STATES[0]))
    assert dls.after(m) == m
    _, q, v = at(1)
    before = sls1.at(q, v)
    hit = transitions.hit_stopper(SYMBOLS, before).motion
    np.testing.assert_array_equal(jnp.stack(sls1.after(before)), jnp.stack(hit))
    constants = sequence.constants_of(PARAMS.n_legs, *parameters_of(PARAMS))
    following = sequence.held_landing(PARAMS.n_legs).phases[1].reset(constants, Point((), q, v))
    np.testing.assert_array_equal(following.q, [q[0], hit.L1])
    np.testing.assert_array_equal(following.v, [hit.dtheta, hit.dL1])


# --- Every engine reads the very same phase.


def by_diffrax():
    phase, q, v = at(2)
    flow = flow_of(phase, monitored=False)
    start = jnp.stack([*q, *v])
    run = jax.jit(
        lambda y: integrate_phase(flow.field, flow.watched, y, y[0] < 9.0, vrw.Options()).state
    )
    end = run(start)
    return tuple(end[:2]), tuple(end[2:])


def by_lanes():
    phase, q, v = at(2)
    lanes = lambda x: tuple(jnp.tile(number, 8) for number in x)
    phase_of = lambda *_: lane_step.lane_phase(phase, monitored=False)
    end = integrate_lanes(
        phase_of, (), (), explicit_tableau("Bosh3"), lanes(q), lanes(v),
        jnp.ones(8, bool), jnp.full(8, 5e-3), vrw.Options(),
    ).place  # fmt: skip
    return tuple(x[0] for x in end.q), tuple(x[0] for x in end.v)


def by_collocation_of_a_step():
    """Again and again, as the duration is not known beforehand."""
    phase, q, v = at(2)
    run = jax.jit(lambda q, v, T: fixed_work.collocate(phase, q, v, T, Mesh(2, 1.0)))
    duration = jnp.asarray(0.2, float)  # of no weak type, as what comes back
    for _ in range(3):
        end = run(q, v, duration)
        duration = end.duration
    return end.q, end.v


def by_collocation_of_a_cycle():
    """Newton's method on the angle of the event."""
    phase = sequence.held_landing(PARAMS.n_legs).phases[2]
    constants = sequence.constants_of(PARAMS.n_legs, *parameters_of(PARAMS))
    _, q, v = at(2)
    event = lambda theta: phase.event(constants, Point((), (theta, q[1]), v))
    theta = q[0]
    for _ in range(8):
        theta = theta - event(theta) / jax.grad(event)(theta)
    assert phase.guards(constants, Point((), (theta, q[1]), v))[0] == event(theta)
    return (theta, q[1]), v


@pytest.mark.parametrize(
    "engine", [by_diffrax, by_lanes, by_collocation_of_a_step, by_collocation_of_a_cycle]
)
def test_every_engine_ends_the_phase_where_the_phase_says(engine, monkeypatch):
    def height():
        q, v = engine()
        return float(landing_foot_height(SYMBOLS, PHASES[2](SYMBOLS, (), True).at(q, v)))

    assert abs(height()) < 1e-8
    sooner = lambda self, now: landing_foot_height(self.s, now.motion) - 0.01
    monkeypatch.setattr(PHASES[2], "end", sooner)
    assert abs(height() - 0.01) < 1e-8

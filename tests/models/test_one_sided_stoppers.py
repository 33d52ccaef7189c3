"""Stoppers that only push: complementarity in an impact, forces, energy, another code, lanes."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracle import moreau_jean

import vrw_jax as vrw
from vrw_jax.models.unilateral.contacts import OFF
from vrw_jax.models.unilateral.events import Law, event_of, resolve
from vrw_jax.models.unilateral.mechanics import WheelMotion, kinetic_energy, potential_energy
from vrw_jax.models.unilateral.motion import Stance, guards_of
from vrw_jax.models.unilateral.section import opened

START = (0.1, 1.6, -0.1)
SCENES = ((0.7, 200.0), (1.3, 200.0), (0.7, 300.0), (0.5, 100.0))  # friction, damping
TIGHT = vrw.Options.tight()
LANES = vrw.Options(solver="Tsit5", rtol=1e-10, atol=1e-10)
STRUCK = 6  # the leg that meets its stopper, counted from 0


def wheel_of(friction, stoppers="one-sided"):
    return vrw.UnilateralWheel(friction=friction, stoppers=stoppers)


def stepped(friction, damping, x=START, options=TIGHT):
    return vrw.step(vrw.WheelParams(damping=damping), x, model=wheel_of(friction), options=options)


def test_an_unknown_kind_of_stopper_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="one of 'bilateral', 'one-sided'"):
        vrw.UnilateralWheel(stoppers="soft")


@pytest.fixture(scope="module")
def struck():
    """A spinning wheel in the air of which one leg meets its stopper, by the speed of rest."""
    s, zero, none = vrw.WheelParams().symbols(), jnp.zeros(()), jnp.zeros(8, bool)
    motion = WheelMotion(
        zero, zero + 2.0, zero - 0.2, zero + 1.0, zero - 0.5, zero + 1.5, jnp.ones(8), jnp.zeros(8)
    )
    motion = motion._replace(dL=motion.dL.at[STRUCK].set(0.5))
    stance = Stance(jnp.full(8, OFF, jnp.int32), jnp.arange(8) != STRUCK, none, none, none)
    law = lambda one_sided, rest: Law(s, jnp.asarray(0.7), one_sided, True, rest)
    event = event_of(guards_of(8, True), jnp.int32(8 + STRUCK))
    after = jax.jit(lambda rest: resolve(law(True, rest), motion, stance, event))
    bilateral = jax.jit(lambda: resolve(law(False, 0.0), motion, stance, event))
    return motion, after, bilateral


def test_a_leg_at_its_stopper_throws_off_those_that_would_have_to_pull(struck):
    motion, after, _ = struck
    change = after(1e-6)
    # Another code: the dense mass matrix, and all stoppers at once by projected Gauss-Seidel.
    wheel = moreau_jean.Wheel(0.7)
    q = np.concatenate([[0.0, 2.0, -0.2], np.ones(8)])
    v = np.concatenate([[1.0, -0.5, 1.5], np.asarray(motion.dL)])
    mass, _ = moreau_jean._mass_and_force(wheel, q, v)
    J, inverse = -np.eye(11)[3:], np.linalg.inv(mass)
    p = moreau_jean._solve(wheel, J @ inverse @ J.T, J @ v, 0, np.zeros(8))
    expected = v + inverse @ (J.T @ p)
    found = change.motion
    told = jnp.concatenate([jnp.stack([found.vx, found.vz, found.dtheta]), found.dL])
    np.testing.assert_allclose(told, expected, atol=1e-12)
    thrown = np.asarray(found.dL) < -1e-3
    assert thrown.any()
    assert not np.any(thrown & np.asarray(change.stance.locked))
    assert float(change.stopper_impulse) >= -1e-12
    assert float(change.energy_lost) > 0.0


def test_what_would_come_back_unseen_stays(struck):
    _, after, bilateral = struck
    for a, b in zip(jax.tree.leaves(after(100.0)), jax.tree.leaves(bilateral()), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "damping"), SCENES)
def test_no_stopper_pulls_and_energy_is_told_by_its_causes(friction, damping):
    params, wheel = vrw.WheelParams(damping=damping), wheel_of(friction)
    s = params.symbols()
    total = lambda motion: float(kinetic_energy(s, motion) + sum(potential_energy(s, motion)))
    x = wheel.full_section(params, jnp.asarray(START))
    for _ in range(3):
        step = vrw.step(params, x, model=wheel, options=TIGHT)
        assert int(step.outcome) == vrw.Outcome.STEPPED
        assert float(step.monitors.stopper_force) >= -1e-9
        # What stays though it would dip by 1e-10 m: 1 kg times the speed of that dip.
        assert float(step.monitors.stopper_impulse) >= -2e-4
        assert int(step.impacts) >= 10
        assert min(step.energy_impacts, step.energy_damping, step.energy_friction) >= 0.0
        before, after = (opened(s, y)[0] for y in (x, step.section_state))
        # The origin is each step's own landing.
        dropped = s.Mt * s.g * math.sin(0.30) * float(step.step_length)
        lost = step.energy_impacts + step.energy_damping + step.energy_friction
        assert abs(float(lost) - (total(before) - total(after) + float(dropped))) < 1e-7
        x = step.section_state


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.7, 1.3])
def test_time_stepping_with_stoppers_that_only_push_converges_to_the_same_step(friction):
    truth = stepped(friction, 200.0)
    sizes = (4e-4, 2e-4, 1e-4)
    wheel = moreau_jean.Wheel(friction, one_sided=True)
    start = moreau_jean.paper_start(wheel, *START)
    times = np.array([moreau_jean.one_step(wheel, start, h).time for h in sizes])
    errors = times - float(truth.period)
    np.testing.assert_allclose(errors[:-1] / errors[1:], 2.0, atol=0.15)
    assert abs(2.0 * errors[-1] - errors[-2]) < 3e-6  # extrapolated, s
    held = vrw.step(
        vrw.WheelParams(), START, model=wheel_of(friction, "bilateral"), options=TIGHT
    ).period
    assert abs(float(held - truth.period)) > 1e-5  # which stoppers were meant can be told


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "damping"), SCENES)
def test_landings_with_one_sided_stoppers_repeat_but_for_what_the_tolerances_cut(friction, damping):
    loose, tight = (stepped(friction, damping, options=o) for o in (vrw.Options(), TIGHT))
    # Dips below 1e-12 and 1e-13 m stay: speeds of 4e-6 and 1e-6 m/s, in each event of a chain.
    np.testing.assert_allclose(loose.section_state[:4], tight.section_state[:4], atol=2e-6)
    assert abs(float(loose.period - tight.period)) < 3e-7


@pytest.mark.slow
def test_lanes_with_one_sided_stoppers_walk_as_single_wheels_do():
    friction, damping = (np.array(column) for column in zip(*SCENES, strict=True))
    found = vrw.steps(
        vrw.WheelParams(damping=damping),
        np.tile(START, (len(SCENES), 1)),
        1,
        model=wheel_of(friction),
        options=TIGHT,
    )
    for i, scene in enumerate(SCENES):
        single = stepped(*scene, options=TIGHT.by("diffrax"))
        # To what tolerances leave: dips that are cut hand their momentum on.
        np.testing.assert_allclose(found.section_state[i, :4], single.section_state[:4], atol=1e-8)
        np.testing.assert_allclose(found.durations[i].sum(), single.period, atol=1e-9)


def test_what_an_event_has_released_is_not_met_again_by_rounding():
    """Wheels apart by rounding alone: a leg let go from rest reads zero for 1e-8 s and longer."""
    wheels, friction = 64, 0.7
    how = {"model": wheel_of(friction), "options": TIGHT, "engine": "diffrax"}
    period = vrw.walk(vrw.WheelParams(), START, 1, **how).steps.durations.sum()
    for tolerance in (5e-12, 5e-13, 1e-13):  # one cut on dips, its least
        found = vrw.steps(
            vrw.WheelParams(damping=200.0 * (1.0 + 1e-12 * np.arange(wheels))),
            np.tile(START, (wheels, 1)),
            1,
            model=wheel_of(friction),
            options=vrw.Options(rtol=tolerance, atol=tolerance),
        )
        assert np.all(np.asarray(found.outcome) == vrw.Outcome.STEPPED)
        np.testing.assert_allclose(found.durations.sum(1), period, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_high_friction_from_any_start_has_an_admissible_contact_at_every_impact():
    random, n = np.random.default_rng(0), 200
    damping, high = random.uniform(5.0, 400.0, n), random.uniform(2.0, 20.0, n)
    limits = ((0.0, 0.25), (0.3, 2.6), (-0.6, 0.2))
    found = vrw.steps(
        vrw.WheelParams(damping=damping),
        np.stack([random.uniform(*limit, n) for limit in limits], 1),
        1,
        model=wheel_of(np.where(np.arange(n) % 2 == 0, math.inf, high)),
        options=LANES,
    )
    outcome = np.asarray(found.outcome)
    assert not np.any(outcome == vrw.Outcome.NO_ADMISSIBLE_CONTACT)
    lost = np.isin(outcome, [vrw.Outcome.SOLVER_GAVE_UP, vrw.Outcome.TOO_MANY_EVENTS])
    assert lost.sum() <= n // 50
    assert not np.any(np.asarray(found.section_state)[outcome != vrw.Outcome.STEPPED])
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))

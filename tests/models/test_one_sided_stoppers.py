"""One-sided stoppers: complementarity in an impact, forces, energy, a second formulation, lanes."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import moreau_jean

import vrw_jax as vrw
from vrw_jax.models.contact_impacts import ContactLaw, classify_event, resolve_event
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    compute_kinetic_energy,
    compute_potential_energy,
)
from vrw_jax.models.contact_record import unpack_section_state
from vrw_jax.models.contact_state import ContactState, make_guard_layout
from vrw_jax.wheel import ContactMode

START = (0.1, 1.6, -0.1)
SCENES = ((0.7, 200.0), (1.3, 200.0), (0.7, 300.0), (0.5, 100.0))  # friction, damping
TIGHT_OPTIONS = vrw.StepOptions.tight()
BATCH_OPTIONS = vrw.StepOptions(solver="Tsit5", rtol=1e-10, atol=1e-10)
STRUCK_LEG = 6  # the leg that meets its stopper, counted from 0


def make_model(friction, stoppers="one-sided"):
    return vrw.UnilateralWheel(friction=friction, stoppers=stoppers)


def compute_step(friction, damping, x=START, options=TIGHT_OPTIONS):
    return vrw.step(
        vrw.WheelParams(damping=damping), x, model=make_model(friction), options=options
    )


def test_an_unknown_kind_of_stopper_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="one of 'bilateral', 'one-sided'"):
        vrw.UnilateralWheel(stoppers="soft")


@pytest.fixture(scope="module")
def stopper_impact():
    """Return a wheel in the air, one leg of which meets its stopper, by the rest speed."""
    s, zero, none = vrw.WheelParams().symbols(), jnp.zeros(()), jnp.zeros(8, bool)
    motion = WheelMotion(
        zero, zero + 2.0, zero - 0.2, zero + 1.0, zero - 0.5, zero + 1.5, jnp.ones(8), jnp.zeros(8)
    )
    motion = motion._replace(dL=motion.dL.at[STRUCK_LEG].set(0.5))
    stance = ContactState(
        jnp.full(8, ContactMode.OFF, jnp.int32), jnp.arange(8) != STRUCK_LEG, none, none, none
    )
    law = lambda one_sided, rest: ContactLaw(s, jnp.asarray(0.7), one_sided, True, rest)
    event = classify_event(make_guard_layout(8, True), jnp.int32(8 + STRUCK_LEG))
    after = jax.jit(lambda rest: resolve_event(law(True, rest), motion, stance, event))
    bilateral = jax.jit(lambda: resolve_event(law(False, 0.0), motion, stance, event))
    return motion, after, bilateral


def test_a_stopper_impact_releases_legs_whose_stoppers_would_have_to_pull(stopper_impact):
    motion, after, _ = stopper_impact
    change = after(1e-6)
    # Another code: the dense mass matrix, and all stoppers at once by projected Gauss-Seidel.
    wheel = moreau_jean.TimeSteppingWheel(0.7)
    q = np.concatenate([[0.0, 2.0, -0.2], np.ones(8)])
    v = np.concatenate([[1.0, -0.5, 1.5], np.asarray(motion.dL)])
    mass, _ = moreau_jean._mass_and_force(wheel, q, v)
    J, inverse = -np.eye(11)[3:], np.linalg.inv(mass)
    p = moreau_jean._solve(wheel, J @ inverse @ J.T, J @ v, 0, np.zeros(8))
    expected = v + inverse @ (J.T @ p)
    solution = change.motion
    joined_values = jnp.concatenate(
        [jnp.stack([solution.vx, solution.vz, solution.dtheta]), solution.dL]
    )
    np.testing.assert_allclose(joined_values, expected, atol=1e-12)
    thrown_values = np.asarray(solution.dL) < -1e-3
    assert thrown_values.any()
    assert not np.any(thrown_values & np.asarray(change.contact_state.is_leg_locked))
    assert float(change.stopper_impulse) >= -1e-12
    assert float(change.impact_energy_loss) > 0.0


def test_at_a_high_rest_speed_one_sided_stoppers_act_as_two_sided_ones(stopper_impact):
    _, after, bilateral = stopper_impact
    for a, b in zip(jax.tree.leaves(after(100.0)), jax.tree.leaves(bilateral()), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "damping"), SCENES)
def test_no_stopper_pulls_and_energy_losses_are_reported_by_cause(friction, damping):
    params, wheel = vrw.WheelParams(damping=damping), make_model(friction)
    s = params.symbols()
    total = lambda motion: float(
        compute_kinetic_energy(s, motion) + sum(compute_potential_energy(s, motion))
    )
    x = wheel.complete_section_state(params, jnp.asarray(START))
    for _ in range(3):
        step = vrw.step(params, x, model=wheel, options=TIGHT_OPTIONS)
        assert int(step.outcome) == vrw.Outcome.STEPPED
        assert float(step.margins.stopper_force) >= -1e-9
        # What stays though it would dip by 1e-10 m: 1 kg times the speed of that dip.
        assert float(step.margins.stopper_impulse) >= -2e-4
        assert int(step.impacts) >= 10
        assert min(step.energy_impacts, step.energy_damping, step.energy_friction) >= 0.0
        before, after = (unpack_section_state(s, y)[0] for y in (x, step.section_state))
        # The origin is each step's own landing.
        dropped = s.Mt * s.g * math.sin(0.30) * float(step.step_length)
        energy_loss = step.energy_impacts + step.energy_damping + step.energy_friction
        assert abs(float(energy_loss) - (total(before) - total(after) + float(dropped))) < 1e-7
        x = step.section_state


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.7, 1.3])
def test_time_stepping_with_stoppers_that_only_push_converges_to_the_same_step(friction):
    reference = compute_step(friction, 200.0)
    sizes = (4e-4, 2e-4, 1e-4)
    wheel = moreau_jean.TimeSteppingWheel(friction, one_sided=True)
    start = moreau_jean.paper_start(wheel, *START)
    times = np.array([moreau_jean.compute_step(wheel, start, h).time for h in sizes])
    errors = times - float(reference.period)
    np.testing.assert_allclose(errors[:-1] / errors[1:], 2.0, atol=0.15)
    assert abs(2.0 * errors[-1] - errors[-2]) < 3e-6  # extrapolated, s
    held_values = vrw.step(
        vrw.WheelParams(), START, model=make_model(friction, "bilateral"), options=TIGHT_OPTIONS
    ).period
    assert (
        abs(float(held_values - reference.period)) > 1e-5
    )  # which stoppers were meant can be told


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "damping"), SCENES)
def test_landings_with_one_sided_stoppers_repeat_up_to_tolerances(friction, damping):
    loose, tight = (
        compute_step(friction, damping, options=o) for o in (vrw.StepOptions(), TIGHT_OPTIONS)
    )
    # Dips below 1e-12 and 1e-13 m stay: speeds of 4e-6 and 1e-6 m/s, in each event of a chain.
    np.testing.assert_allclose(loose.section_state[:4], tight.section_state[:4], atol=2e-6)
    assert abs(float(loose.period - tight.period)) < 3e-7


@pytest.mark.slow
def test_batches_with_one_sided_stoppers_equal_single_wheels():
    friction, damping = (np.array(column) for column in zip(*SCENES, strict=True))
    batch_result = vrw.step_batch(
        vrw.WheelParams(damping=damping),
        np.tile(START, (len(SCENES), 1)),
        1,
        model=make_model(friction),
        options=TIGHT_OPTIONS,
    )
    for i, scene in enumerate(SCENES):
        single = compute_step(*scene, options=TIGHT_OPTIONS.with_engine("diffrax"))
        # To what tolerances leave: dips that are cut hand their momentum on.
        np.testing.assert_allclose(
            batch_result.section_state[i, :4], single.section_state[:4], atol=1e-8
        )
        np.testing.assert_allclose(batch_result.durations[i].sum(), single.period, atol=1e-9)


def compute_periods_of_nearly_equal_wheels(tolerance):
    """Return the step periods of 64 wheels whose dampings differ by little more than rounding."""
    n_wheels = 64
    batch_result = vrw.step_batch(
        vrw.WheelParams(damping=200.0 * (1.0 + 1e-12 * np.arange(n_wheels))),
        np.tile(START, (n_wheels, 1)),
        1,
        model=make_model(0.7),
        options=vrw.StepOptions(rtol=tolerance, atol=tolerance),
    )
    assert np.all(np.asarray(batch_result.outcome) == vrw.Outcome.STEPPED)
    return batch_result.durations.sum(1)


CLOSE_TOLERANCES = [5e-12, 5e-13, 1e-13]


@pytest.mark.parametrize("tolerance", CLOSE_TOLERANCES)
def test_round_off_does_not_repeat_the_event_of_a_released_contact(tolerance):
    """A contact released from rest keeps a gap that is computed as zero for at least 1e-8 s."""
    assert np.ptp(compute_periods_of_nearly_equal_wheels(tolerance)) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", CLOSE_TOLERANCES)
def test_periods_of_nearly_equal_wheels_are_those_of_diffrax(tolerance):
    options = TIGHT_OPTIONS.with_engine("diffrax")
    period = compute_step(0.7, 200.0, options=options).period
    np.testing.assert_allclose(
        compute_periods_of_nearly_equal_wheels(tolerance), period, rtol=0, atol=1e-10
    )


@pytest.mark.slow
def test_high_friction_from_any_start_has_an_admissible_contact_at_every_impact():
    random, n = np.random.default_rng(0), 200
    damping, high = random.uniform(5.0, 400.0, n), random.uniform(2.0, 20.0, n)
    limits = ((0.0, 0.25), (0.3, 2.6), (-0.6, 0.2))
    batch_result = vrw.step_batch(
        vrw.WheelParams(damping=damping),
        np.stack([random.uniform(*limit, n) for limit in limits], 1),
        1,
        model=make_model(np.where(np.arange(n) % 2 == 0, math.inf, high)),
        options=BATCH_OPTIONS,
    )
    outcome = np.asarray(batch_result.outcome)
    assert not np.any(outcome == vrw.Outcome.NO_ADMISSIBLE_CONTACT)
    has_solver_failed = np.isin(outcome, [vrw.Outcome.SOLVER_FAILED, vrw.Outcome.TOO_MANY_EVENTS])
    assert has_solver_failed.sum() <= n // 50
    assert not np.any(np.asarray(batch_result.section_state)[outcome != vrw.Outcome.STEPPED])
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(batch_result))

"""Feet with restitution: Newton's law in the impact problem, and energy that never grows."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.models.contact_impacts import ContactLaw, classify_event, project_motion, resolve_event
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    compute_kinetic_energy,
    compute_leg_directions,
)
from vrw_jax.models.contact_state import ContactState, make_guard_layout
from vrw_jax.wheel import ContactMode

N_IMPACTS, RNG_SEED = 400, 3
START = (0.1, 1.6, -0.1)


@functools.cache
def make_random_impacts(has_one_sided_stoppers):
    """Foot 0 strikes while foot 1 is at rest or slides, over random postures, rates and frictions
    up to the most, by restitution: normal speeds of foot 0 before and after, energies, and the
    smaller normal impulse."""
    s, none = vrw.WheelParams().symbols(), jnp.zeros(8, bool)
    locked = jnp.arange(8) > 1
    event = classify_event(make_guard_layout(8, has_one_sided_stoppers), jnp.int32(0))

    def strikes(seeds, restitution, maximum, rest_speed, n_late_events):
        mode = jnp.where(seeds[21] < 0.5, ContactMode.STICK, ContactMode.SLIP_DOWN)
        modes = jnp.where(jnp.arange(8) == 1, mode, ContactMode.OFF)
        stance = ContactState(modes, locked, none, none, none)
        theta, friction = -0.7 + 0.5 * seeds[0], maximum * seeds[1] ** 2
        rates, L = 2.0 * seeds[2:13] - 1.0, 0.85 + 0.15 * seeds[13:21]
        z = L[0] * jnp.cos(theta)
        motion = WheelMotion(jnp.zeros(()), z, theta, *rates[:3], L, rates[3:])
        motion = project_motion(s, motion, stance.contact_modes, locked)
        law = ContactLaw(
            s, friction, has_one_sided_stoppers, False, rest_speed, restitution, None, n_late_events
        )
        change = resolve_event(law, motion, stance, event)
        legs = compute_leg_directions(s, theta)
        speed = lambda at: (at.vz - at.dL * legs.cos + at.L * at.dtheta * legs.sin)[0]
        energies = compute_kinetic_energy(s, motion), compute_kinetic_energy(s, change.motion)
        within = jnp.max(motion.L) <= s.L0  # no leg is longer than its stopper lets it be
        is_sound = within & (change.n_solutions > 0)
        return speed(motion), speed(change.motion), *energies, is_sound, change.normal_impulse.min()

    seeds = jnp.asarray(np.random.default_rng(RNG_SEED).random((N_IMPACTS, 22)))
    strike_all = jax.vmap(lanes.jit(strikes), (0, None, None, None, None))
    return lambda *given: strike_all(seeds, *map(jnp.asarray, given))


@pytest.mark.parametrize("has_one_sided_stoppers", [False, True])
def test_contacts_that_come_to_rest_gain_no_energy_and_no_foot_is_pulled(has_one_sided_stoppers):
    """The rest speed is high, so that most impacts bring contacts to rest."""
    for restitution in (0.0, 0.3, 0.7, 1.0):
        for n_late_events in (0, 2):
            before, _, had, has, sound, impulse = map(
                np.asarray,
                make_random_impacts(has_one_sided_stoppers)(restitution, 3.0, 0.1, n_late_events),
            )
            struck = (before < 0.0) & sound
            assert struck.sum() > 40
            assert np.all(has[struck] <= had[struck] + 1e-12)  # round-off of some J
            assert np.all(impulse[struck] >= -1e-14)


@pytest.mark.parametrize("most", [3.0, jnp.inf])
def test_energy_never_grows_and_newtons_law_of_restitution_holds_if_it_can(most):
    retained_rows = []
    for restitution in (0.0, 0.5, 1.0):
        before, after, had, has, sound, _ = map(
            np.asarray, make_random_impacts(False)(restitution, most, 1e-6, 0)
        )
        struck = (before < -1e-3) & sound
        assert struck.sum() > 40
        assert np.all(has[struck] <= had[struck] + 1e-9)
        retained_rows.append(after[struck] + restitution * before[struck])
        assert np.all(after[struck] >= -1e-6)
    np.testing.assert_allclose(retained_rows[0], np.maximum(retained_rows[0], 0.0), atol=1e-6)
    # Coulomb's friction lets Newton's law create energy now and then: only then less comes back.
    exact = [np.mean(np.abs(part) < 1e-9) for part in retained_rows]
    assert min(exact) > 0.5
    assert exact[2] < 1.0


@pytest.mark.slow
def test_a_walk_of_many_bounces_gains_energy_in_no_impact():
    params = vrw.WheelParams(damping=205.05336300384445, slope=0.3485289515705972)
    model = vrw.UnilateralWheel(friction=1.5, stoppers="one-sided", restitution=0.7)
    start = (0.1, 2.8876760848630836, -0.22397291641454237)
    walk = vrw.simulate(params, start, 3, model=model, n_samples=2)
    energy, step = walk.kinetic_energy.values, walk.step.values
    gains = (energy[2::2] - energy[1:-1:2])[step[2::2] == step[1:-1:2]]
    assert len(gains) > 400
    assert gains.max() < 1e-12  # round-off of 60 J


def test_restitution_outside_its_domain_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="0 to 1"):
        vrw.UnilateralWheel(restitution=1.5)
    assert vrw.UnilateralWheel(restitution=0.0).restitution is None
    model = vrw.UnilateralWheel(restitution=[0.5, 0.1])
    with pytest.raises(ValueError, match="one number"):
        vrw.step_batch(vrw.WheelParams(), np.array([START]), model=model)


UNEVEN_SLOPES = np.array([0.3, 0.32, 0.29])
TIGHT_OPTIONS = vrw.StepOptions.tight()


@pytest.mark.slow
def test_batches_with_restitution_on_uneven_ground_equal_walks_by_diffrax():
    """Values at a tight tolerance, and derivatives of a batch by those of single walks."""
    model, damping = vrw.UnilateralWheel(friction=0.7, restitution=0.3), np.array([150.0, 250.0])
    params = vrw.WheelParams(damping=damping, slope=np.tile(UNEVEN_SLOPES, (2, 1)))
    starts = np.tile(START, (2, 1))
    batch = vrw.step_batch(
        params, starts, 2, model=model, options=TIGHT_OPTIONS, derivatives=("damping",)
    )
    assert batch.engine == "lanes"

    def walk_one(damping, engine):
        params = vrw.WheelParams(damping=damping, slope=jnp.asarray(UNEVEN_SLOPES))
        options = TIGHT_OPTIONS.with_engine(engine)
        return vrw.walk(params, START, 2, model=model, options=options).steps.durations[-1]

    for i in range(2):
        expected = walk_one(jnp.asarray(damping[i]), "diffrax")
        np.testing.assert_allclose(batch.durations[i], expected, atol=1e-9)
        jacobian = jax.jacfwd(walk_one)(jnp.asarray(damping[i]), "lanes")
        np.testing.assert_allclose(batch.derivatives["damping"].durations[i], jacobian, atol=1e-9)


@pytest.mark.slow
def test_the_derivative_by_restitution_is_a_difference_quotient():
    def duration(restitution):
        model = vrw.UnilateralWheel(friction=0.7, restitution=restitution)
        step = vrw.step(vrw.WheelParams(), START, model=model, options=TIGHT_OPTIONS)
        return step.period

    h = 1e-5
    difference = (duration(0.3 + h) - duration(0.3 - h)) / (2 * h)
    assert abs(float(jax.grad(duration)(0.3)) - float(difference)) < 1e-6
    assert abs(float(difference)) > 1e-3


@pytest.mark.slow
def test_a_step_with_restitution_agrees_with_another_code():
    model = vrw.UnilateralWheel(friction=0.7, restitution=0.3)
    step = vrw.step(vrw.WheelParams(), START, model=model, options=vrw.StepOptions.tight())
    wheel = complementarity.ComplementarityWheel(0.7, restitution=0.3)
    other = complementarity.compute_step(wheel, complementarity.paper_start(wheel, *START))
    assert int(step.outcome) == vrw.Outcome.STEPPED
    assert abs(float(step.period) - other.durations.sum()) < 1e-8

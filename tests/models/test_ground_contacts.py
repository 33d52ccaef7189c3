"""The choice of feet and stoppers that carry an impact or a motion, against dense matrices."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import moreau_jean

import vrw_jax as vrw
from vrw_jax.models.contact_jvp import solve_combination
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    compute_free_acceleration,
    compute_free_velocity,
    find_contact_slots,
    make_inverse_inertia,
    select_slot_friction,
)
from vrw_jax.models.contact_modes import (
    ALL_MODES_MASK,
    AllowedContactModes,
    ContactSignTolerances,
    choose_combination,
)
from vrw_jax.wheel import ContactMode

N_CASES = 200
RNG_SEED = 6
MODE_RANKS = {
    ContactMode.STICK: 0,
    ContactMode.SLIP_DOWN: 1,
    ContactMode.SLIP_UP: 1,
    ContactMode.OFF: 2,
}
"""Preferred are combinations with most feet at rest."""
SOLUTION_COUNTS = {(0.7, False): {1}, (0.7, True): {1}, (3.0, False): {1, 3}, (3.0, True): {1, 3}}
"""How many are admissible, by friction and level: one where the law is well posed."""


def draw_contact_cases():
    """Return postures with two feet on the slope: coordinates, rates, reached stoppers (slots,
    others)."""
    rng = np.random.default_rng(RNG_SEED)
    for _ in range(N_CASES):
        theta = rng.uniform(-0.7, -0.1)
        at_stopper = rng.random(2) < 0.4
        q, v = np.ones(11), rng.normal(0.0, 1.0, 11)
        q[2], q[3:] = theta, rng.uniform(0.85, 1.0, 8)
        q[1] = rng.uniform(0.85, 1.0) * min(np.cos(theta), np.cos(theta + moreau_jean.ALPHA))
        q[3:5] = q[1] / np.cos(theta + moreau_jean.ALPHA * np.arange(2))
        yield q, v, at_stopper, np.r_[False, False, rng.random(6) < 0.7]


def enumerate_admissible_contacts(wheel, q, v, at_stopper, locked, moving):
    """All admissible combinations: modes, held stoppers, velocities or accelerations they leave.

    `moving`: of forces, by the accelerations; else of impulses, by the velocities after them.
    """
    v = np.where(np.r_[[False] * 3, locked], 0.0, v) if moving else v
    axes = np.r_[0:3, 3 + np.flatnonzero(~locked)]
    mass, force = moreau_jean._mass_and_force(wheel, q, v)
    inverse = np.linalg.inv(mass[np.ix_(axes, axes)])
    free = inverse @ (force if moving else mass @ v)[axes]
    rows_at = lambda q: np.array([moreau_jean._foot_rows(q, i) for i in range(2)])
    feet, room = rows_at(q)[..., axes], -np.eye(11)[3:5][:, axes]
    h = 1e-5  # the feet's rows turn along the motion
    bias = (rows_at(q + h * v) - rows_at(q - h * v)) @ v / (2.0 * h) * moving
    found_rows = []
    stoppers = itertools.product(
        *((False, True) if is_at_stopper else (False,) for is_at_stopper in at_stopper)
    )
    for modes, is_leg_locked in itertools.product(
        itertools.product(MODE_RANKS, repeat=2), stoppers
    ):
        if modes == (ContactMode.STICK, ContactMode.STICK) and all(is_leg_locked):
            continue  # fixes the hub twice over
        closed = []  # row kept at rest, direction of its force, bias
        for i, mode in enumerate(modes):
            tangential_row, off = feet[i]
            drag = {
                ContactMode.SLIP_DOWN: -wheel.friction,
                ContactMode.SLIP_UP: wheel.friction,
            }.get(mode, 0.0)
            closed += (
                [(off, off + drag * tangential_row, bias[i, 1])] if mode != ContactMode.OFF else []
            )
            closed += (
                [(tangential_row, tangential_row, bias[i, 0])] if mode == ContactMode.STICK else []
            )
            closed += [(room[i], room[i], 0.0)] if is_leg_locked[i] else []
        R, C = (np.reshape([c[k] for c in closed], (-1, len(axes))) for k in range(2))
        p = -np.linalg.solve(R @ inverse @ C.T, R @ free + [c[2] for c in closed])
        after, forces, good = free + inverse @ C.T @ p, iter(p), True
        for i, mode in enumerate(modes):
            x, z = feet[i] @ after + bias[i]
            normal = next(forces) if mode != ContactMode.OFF else 0.0
            good &= normal >= 0.0
            good &= mode != ContactMode.OFF or z >= 0.0
            good &= mode != ContactMode.STICK or abs(next(forces)) <= wheel.friction * normal
            good &= mode != ContactMode.SLIP_DOWN or x >= 0.0
            good &= mode != ContactMode.SLIP_UP or x <= 0.0
            good &= (
                next(forces) >= 0.0
                if is_leg_locked[i]
                else not at_stopper[i] or room[i] @ after >= 0.0
            )
        if good:
            found_rows.append((modes, is_leg_locked, dict(zip(axes.tolist(), after, strict=True))))
    return found_rows


@jax.jit
def select_contacts(q, v, at_stopper, locked, friction, moving):
    """Return the library's choice: modes, held stoppers, rates of hub and slots' lengths,
    solutions."""
    s = vrw.WheelParams().symbols()
    slots = find_contact_slots(jnp.arange(8) < 2)
    motion = WheelMotion(*q[:3], *v[:3], q[3:], v[3:])
    resting = motion._replace(dL=jnp.where(locked & moving, 0.0, motion.dL))
    hub = make_inverse_inertia(s, motion, slots, locked)
    levels = (
        compute_free_acceleration(s, resting, slots, hub),
        compute_free_velocity(s, motion, slots, hub),
    )
    free = jax.tree.map(lambda a, b: jnp.where(moving, a, b), *levels)
    friction = select_slot_friction(friction, slots)
    none = jnp.zeros(2, jnp.int32)
    allowed = AllowedContactModes(
        allowed_slot_modes=none + ALL_MODES_MASK,
        can_hold_stopper=at_stopper,
        is_foot_mode_fixed=none > 0,
        untested_slot_modes=none,
        is_open_stopper_untested=~at_stopper,
    )
    small = ContactSignTolerances(
        jnp.asarray(1e-12), jnp.asarray(1e-12)
    )  # no case is near a border
    choice = choose_combination(s, hub, free, allowed, friction, small, True)
    measured = solve_combination(
        s, hub, free, choice.slot_modes, choice.is_stopper_holding, friction
    )
    rates = jnp.stack([*measured.hub_motion, *measured.length_motion])
    return choice.slot_modes, choice.is_stopper_holding, rates, choice.n_solutions


@pytest.mark.parametrize("moving", [False, True], ids=["impulses", "forces"])
@pytest.mark.parametrize("friction", [0.7, 3.0])
def test_the_selected_contact_combination_is_admissible_and_solutions_are_counted(friction, moving):
    wheel = moreau_jean.TimeSteppingWheel(friction)
    numbers = set()
    for q, v, at_stopper, locked in draw_contact_cases():
        expected = enumerate_admissible_contacts(wheel, q, v, at_stopper, locked, moving)
        contact, is_leg_locked, rates, solutions = select_contacts(
            q, v, at_stopper, locked, friction, moving
        )
        assert int(solutions) == len(expected)
        numbers.add(len(expected))
        if not expected:
            continue
        modes = tuple(np.asarray(contact).tolist())
        stoppers = tuple(np.asarray(is_leg_locked).tolist())
        (is_same,) = (x for m, h, x in expected if m == modes and h == stoppers)
        # Differences of the feet's rows: rounding 1e-16 / 1e-5 and error 1e-10, times some 10.
        np.testing.assert_allclose(rates, [is_same[i] for i in range(5)], rtol=1e-8, atol=1e-8)
        rank = lambda modes: sum(MODE_RANKS[mode] for mode in modes)
        assert rank(modes) == min(rank(m) for m, _, _ in expected)
    assert numbers == SOLUTION_COUNTS[friction, moving]


@pytest.mark.parametrize("moving", [False, True], ids=["impulses", "forces"])
def test_infinite_friction_is_the_limit_of_large_friction(moving):
    """Where a foot slides friction alone carries it; what differs falls with the friction."""
    slid = 0
    for q, v, at_stopper, locked in itertools.islice(draw_contact_cases(), 60):
        given = q, v, at_stopper, locked
        contact, is_leg_locked, rates, _ = select_contacts(*given, jnp.inf, moving)
        large = select_contacts(*given, 1e8, moving)
        np.testing.assert_array_equal(contact, large[0])
        np.testing.assert_array_equal(is_leg_locked, large[1])
        np.testing.assert_allclose(rates, large[2], rtol=1e-4, atol=1e-4)
        slid += bool(np.isin(contact, (ContactMode.SLIP_DOWN, ContactMode.SLIP_UP)).any())
    assert slid > 5

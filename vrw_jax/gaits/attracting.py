"""Which gaits of a wheel attract: walks from a stated set of starts, and Newton's method on."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.batches import steps
from vrw_jax.cycles import WalkedCycle, options_towards
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Options
from vrw_jax.wheel import Outcome, WheelParams

N_STEPS = 80
"""Steps of a walk towards a gait."""

STARTS = ((1.0, 0.45), (1.0, 0.7), (1.0, 1.0), (0.5, 1.0), (0.0, 1.0))
"""Where walks start: how much of its static contraction Leg 1 has at touchdown, and the rate of the
hub as a share of the rigid rolling gait's. Of 4,800 random wheels with 5 to 16 legs 1,240 walk from
one of these or of 78 on a grid, 1,175 from these (ranges: experiments/gaits/off_the_box.py)."""

FURTHER = ((0.002, 0.4), (0.002, 0.3), (0.002, 0.5), (0.5, 1.1), (0.2, 0.4), (0.2, 1.1), (0.2, 0.8),
           (0.35, 1.0), (0.35, 1.1))  # fmt: skip
"""Where walks on the paper's rung start if none from STARTS came to a gait: Leg 1's angle to the
slope's normal at touchdown as a share of that between legs, and the rate as above. They reach the
other 65: with many legs gaits roll from double support into double support, the angle near 0."""

NEAR = 0.1
"""Most by which a walk that is a start may miss its own state one period ago, rad, rad/s, m/s."""

APART, SAME = 0.02, 1e-5
"""Distance above which walks have come to different gaits, and below which gaits are one."""


def starts_of(params: WheelParams) -> np.ndarray:
    """STARTS of each wheel, (start, lane, 3)."""
    s = params.symbols()  # whose sine of the slope is no value where a caller differentiates
    Mt, g, L0 = (np.asarray(x) for x in (s.Mt, s.g, s.L0))
    weight = Mt * g * np.cos(np.asarray(params.slope))
    static = np.asarray(params.natural_length - weight / params.stiffness) / L0
    lengths = [np.clip(1.0 + c * (static - 1.0), s.cos_alpha + 0.02, 1.0) for c, _ in STARTS]
    thetas = [np.arctan((length - s.cos_alpha) / s.sin_alpha) for length in lengths]
    return _at(params, thetas, [share for _, share in STARTS])


def further_starts_of(params: WheelParams) -> np.ndarray:
    """FURTHER of each wheel, (start, lane, 3)."""
    thetas = [
        np.full(np.shape(params.slope), a * float(params.symbols().alpha)) for a, _ in FURTHER
    ]
    return _at(params, thetas, [share for _, share in FURTHER])


def _at(params: WheelParams, thetas: list[np.ndarray], shares: list[float]) -> np.ndarray:
    """Section states with these angles and rates, as shares of the rigid rolling gait's."""
    s = params.symbols()
    g, L0 = np.asarray(s.g), np.asarray(s.L0)
    rolling = np.sqrt(4.0 * g / L0 * np.sin(0.5 * s.alpha) * np.sin(params.slope)) / s.sin_alpha
    each = zip(thetas, shares, strict=True)
    return np.stack(
        [np.stack([x, share * rolling, -0.1 * np.sqrt(g * L0) / 3.0], -1) for x, share in each]
    )


def walked(
    params: WheelParams,
    x: Any,
    model: AbstractWheel,
    period_n: int,
    options: Options | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each lane where N_STEPS lead, whether it still walks there, and by how much it misses that
    state a period later; infinite where a walk ended before."""
    there = steps(params, x, N_STEPS, model=model, options=options)
    states, walking = np.array(there.section_state), np.asarray(there.outcome) == Outcome.STEPPED
    missed, (on,) = np.full(len(states), np.inf), np.nonzero(walking)
    if len(on):
        own = jax.tree.map(lambda leaf: leaf[on], params)
        later = steps(own, states[on], period_n, model=model, options=options)
        away = np.abs(np.asarray(later.section_state) - states[on])
        away = away[:, : model.section_numbers(params)].max(-1)
        missed[on] = np.where(np.asarray(later.outcome) == Outcome.STEPPED, away, np.inf)
    return states, walking, missed


def gaits_attracting(finder: Any, params: WheelParams) -> list[WalkedCycle]:
    """Of each wheel of a batch the gaits that attract, slowest first; a leading axis over gaits.

    Where none is found one stands there that says so.
    """
    n = params.damping.shape[0]
    owner, x = _walked_to(finder, params, n)
    found: Any = finder.cycles(jax.tree.map(lambda leaf: leaf[owner], params), x)
    good, speed = np.asarray(found.found), np.asarray(found.speed)
    states = np.asarray(found.steps.section_state)  # of every step
    numbers = finder.model.section_numbers(params)
    told = []
    for wheel in range(n):
        kept: list[int] = []
        for i in sorted(np.flatnonzero((owner == wheel) & good), key=lambda i: speed[i]):
            own = states[i, :, :numbers]
            repeats = np.abs(own[:-1] - own[-1]).max(-1) < SAME  # after fewer steps
            known = (np.abs(states[j, :, :numbers] - own[-1]).max(-1) < SAME for j in kept)
            if not repeats.any() and not any(same.any() for same in known):
                kept.append(int(i))
        shown = np.array(kept or [int(np.flatnonzero(owner == wheel)[0])])
        gaits = jax.tree.map(lambda leaf, shown=shown: leaf[shown], found)
        told.append(gaits if kept else _none_like(gaits))
    return told


def _none_like(cycle: WalkedCycle) -> WalkedCycle:
    """No gait: what repeats does so after fewer steps, or nothing does."""
    none = jax.tree.map(jnp.zeros_like, cycle)
    lost = jnp.where(cycle.found, Outcome.NO_CYCLE_FOUND, cycle.outcome).astype(jnp.int32)
    return eqx.tree_at(lambda cycle: cycle.outcome, none, lost)


def _walked_to(finder: Any, params: WheelParams, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Where walks have come to that differ: whose, and section states; one of each wheel at least.

    The walk that repeats best stands for its like.
    """
    starts = starts_of(params)
    owner = np.tile(np.arange(n), len(starts))
    wheels = jax.tree.map(lambda leaf: leaf[owner], params)
    model, towards, numbers = finder.model, options_towards(), finder.model.section_numbers(params)
    full = jax.vmap(model.full_section)(wheels, jnp.asarray(np.concatenate(starts)))
    states, walking, missed = walked(wheels, full, model, finder.period_n, towards)
    begin, settled = np.where(walking[:, None], states, np.asarray(full)), missed < NEAR
    chosen: list[int] = []
    for wheel in range(n):
        own, other = np.flatnonzero(owner == wheel), list[Any]()
        for i in sorted(own[settled[own]], key=lambda i: missed[i]):
            away = [np.abs(begin[i] - begin[j])[:numbers].max() for j in other]
            if min(away, default=np.inf) > max(APART, 3.0 * missed[i]):
                other.append(i)
        chosen += other or [own[np.argmax(walking[own])]]
    return owner[chosen], begin[chosen]

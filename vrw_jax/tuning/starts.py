"""Exploration of many starts at once: an augmented Lagrangian, maximized by optax's Adam in one
batch.

First-order steps bring every start near a local optimum; one of them is then selected for the
maximization. A start whose trial lost its gait returns and takes half the step from then on.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.cycles import same_branch
from vrw_jax.numerics import taken
from vrw_jax.runtime import library
from vrw_jax.tuning.objective import Evaluated, breach, slack_scales
from vrw_jax.wheel import Outcome

optax = library("optax")

RATE, STIFFNESS = 0.06, 4.0
"""Adam's first step in widths of the bounds, and the penalty on a breach of one width, in
objectives."""

BatchEvaluate = Callable[[np.ndarray, Evaluated | None], Evaluated]
"""Function that returns gaits at u, one row per start, searched for from neighbors' gaits."""


class Lanes(NamedTuple):
    """Results of the exploration, one row per start."""

    start: np.ndarray  # (n_starts, n_free), in widths of the bounds
    u: np.ndarray
    objective: np.ndarray  # NaN if no gait was found
    breach: np.ndarray  # in widths of the bounds
    lost: np.ndarray  # number of trials that lost the gait or its branch
    gaits: int  # number of evaluated gaits

    @property
    def best(self) -> int:
        """Return the index of the start to continue from: the highest objective minus penalties."""
        merit = self.objective - STIFFNESS * np.abs(self.objective) * self.breach
        return int(np.nanargmax(merit))


def explore(
    evaluate: BatchEvaluate,
    starts: np.ndarray,
    change: Callable[[np.ndarray], np.ndarray],
    free: list[int],
    widths: np.ndarray,
    least: np.ndarray,
    n_steps: int,
) -> Lanes:
    """Take `n_steps` first-order steps of every start.

    `parameter_change` converts changes of u to changes of the parameters. Jacobians of a gait are
    with respect to all parameters; `free_indices` select the free ones.
    """
    n_lanes = starts.shape[0]
    gait = evaluate(starts, None)
    good = found(gait)
    slack, slopes = _constraints(gait, free, widths, least)
    scales = slack_scales(slack, slopes)[good]
    scales = np.median(scales, axis=0) if good.any() else np.ones(least.size)
    size = _gradient(gait, free, widths)[good]
    size = np.median(np.linalg.norm(size, axis=1)) if good.any() else 1.0
    rates = np.full((n_lanes, 1), RATE)
    optimiser = optax.scale_by_adam(b1=0.7, b2=0.9)
    memory = optimiser.init(jnp.asarray(starts))
    prices = np.zeros((n_lanes, least.size))
    u, kept, lost = starts.copy(), gait, np.zeros(n_lanes, int)
    for i in range(n_steps):
        slack, slopes = _constraints(kept, free, widths, least)
        weights = np.maximum(0.0, prices - STIFFNESS * slack / scales)
        prices = np.where(good[:, None], weights, prices)
        pull = np.einsum("lc,lcf->lf", weights / scales, slopes)
        uphill = _gradient(kept, free, widths) / size + pull
        uphill = np.where(good[:, None], uphill, 0.0)
        step, memory = optimiser.update(jnp.asarray(uphill), memory)
        shrink = rates * 0.5 * (1.0 + np.cos(np.pi * i / n_steps))
        trial = np.clip(u + shrink * np.asarray(step), 0.0, 1.0)
        gait = evaluate(trial, kept)
        holds = found(gait) & good & _on_branch(kept, gait, change(trial - u))
        lost += good & ~holds
        rates = np.where(holds[:, None], rates, 0.5 * rates)
        u = np.where(holds[:, None], trial, u)
        kept = jax.tree.map(lambda new, old, h=holds: _chosen(h, new, old), gait, kept)
    slack, _ = _constraints(kept, free, widths, least)
    objective = np.where(good, np.asarray(kept.values)[:, 0], np.nan)
    evaluated = n_lanes * (n_steps + 1)
    return Lanes(starts, u, objective, breach(slack, scales), lost, evaluated)


def found(told: Evaluated) -> np.ndarray:
    """Return whether each start has a gait that the event-driven step confirms."""
    return told.gait.outcome == Outcome.STEPPED


def _chosen(holds: np.ndarray, new: jax.Array, old: jax.Array) -> jax.Array:
    return jnp.where(holds.reshape(-1, *(1,) * (jnp.ndim(new) - 1)), new, old)


def _gradient(gait: Evaluated, free: list[int], widths: np.ndarray) -> np.ndarray:
    return np.asarray(gait.columns)[:, free, 0] * widths


def _constraints(
    gait: Evaluated, free: list[int], widths: np.ndarray, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return slack, and its derivatives with respect to u: (start, constraint) and (start,
    constraint, free)."""
    slopes = np.swapaxes(np.asarray(gait.columns)[:, free, 1:], 1, 2) * widths
    return np.asarray(gait.values)[:, 1:] - least, slopes


def _on_branch(here: Evaluated, there: Evaluated, change: np.ndarray) -> np.ndarray:
    first, second = here.gait.on_branch, there.gait.on_branch
    pairs = ((*taken((first, second), i), row) for i, row in enumerate(change))
    return np.array([same_branch(*pair) for pair in pairs])

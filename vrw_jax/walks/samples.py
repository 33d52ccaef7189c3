"""Samples of steps, one after the other, as one trajectory."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from vrw_jax.wheel import Outcome


class Stretches(NamedTuple):
    """One step, sampled between its events."""

    columns: dict[str, np.ndarray]  # (stretch, sample, ...), time in s from the landing
    durations: np.ndarray  # of each stretch, s; 0: it did not happen
    outcome: Outcome
    following: Array  # section state after it
    period: float  # s
    length: float  # from this step's landing to the next, m


class Telling(NamedTuple):
    """How a rung's steps are sampled, and what of them is told."""

    stretches_of: Callable[[Array], Stretches]  # of the step from a section state
    names: tuple[str, ...]  # measures that are told over time
    along: tuple[str, ...]  # of these, places along the slope
    labels: dict[str, Any]  # coordinates beside those among the names
    attrs: dict[str, object]


class Joined(NamedTuple):
    """A walk, sampled."""

    columns: dict[str, np.ndarray]  # (time, ...), with `step`; empty where nothing happened
    n_stepped: int
    outcome: Outcome


FALLING = ("gravitational_energy", "total_energy")
"""Energies that count from the walk's first foot."""


def joined(telling: Telling, x: Array, n_steps: int, weight_along: float) -> Joined:
    """Steps from the section state x, as many as it can.

    Places along the slope, m, count from the first landing; energies that are `FALLING`, J, lose
    `weight_along`, N, times the way.
    """
    parts: list[dict[str, np.ndarray]] = []
    outcome, stepped, time, place = Outcome.STEPPED, 0, 0.0, 0.0
    while outcome == Outcome.STEPPED and stepped < n_steps:
        told = telling.stretches_of(x)
        for stretch in np.flatnonzero(told.durations > 0.0):
            part = {name: values[stretch].copy() for name, values in told.columns.items()}
            for name in telling.along:
                part[name] += place
            for name in part.keys() & FALLING:
                part[name] -= weight_along * place
            part["time"] += time
            part["step"] = np.full(len(part["time"]), stepped)
            parts.append(part)
        outcome = told.outcome
        if outcome == Outcome.STEPPED:
            stepped, time, place = stepped + 1, time + told.period, place + told.length
            x = told.following
    none = {name: values[:0].reshape(0, *values.shape[2:]) for name, values in told.columns.items()}
    columns = {
        name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())
    }
    return Joined(columns or none | {"step": np.zeros(0)}, stepped, outcome)

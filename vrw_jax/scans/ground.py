"""Steady gaits of many wheels with unilateral contact, and with the simplest valid model for each.

With unilateral contact the result is the gait to which a slow start converges, or the slowest gait
of all starts. For the simplest valid model, the paper's model evaluates all samples first. The
samples that violate a margin are then evaluated with unilateral contact.
"""

import dataclasses
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.answers import RIGID, answer
from vrw_jax.cycles import (
    Readings,
    WalkedCycle,
    finder_of,
    read_along_lanes,
    slow_gaits,
)
from vrw_jax.models import (
    UNILATERAL,
    VISCOELASTIC,
    ViscoelasticWheel,
    reason_of,
)
from vrw_jax.numerics import in_batches
from vrw_jax.scans.evaluate import Asked, Engine, masked, n_cores, numbers
from vrw_jax.scans.offer import derivative, error_of
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, Outcome, wheel_of

SHARE, LANES = 512, 64
"""Number of samples per task of a thread, and number of gaits whose measures are read in one call;
fixed, so that the result of a sample does not depend on the other samples."""

Columns = Mapping[str, np.ndarray]
"""Swept parameters by name, with one value per sample."""
Told = dict[str, np.ndarray]
"""Results by variable, with one value per sample."""


class GroundEngine:
    """Engine for unilateral contact and a fixed set of measures."""

    def __init__(self, asked: Asked, threads: int | None = None) -> None:
        measures, base, model, options, *_ = asked  # walks find these gaits
        self._base, self._model = base, model
        self._threads = n_cores() if threads is None else threads
        wanted = tuple(d for name in measures if (d := derivative(name)) is not None)
        plain = (*(n for n in measures if derivative(n) is None), "spectral_radius")

        finder: Any = finder_of(model, base.n_legs, step_options=options)
        self._finder = dataclasses.replace(finder, shapes=(LANES,))
        read = type(finder).read
        self._plain, self._wanted = Readings(read, plain), wanted
        self._moved = Readings(read, tuple(dict.fromkeys(d.measure for d in wanted)))

    def __call__(self, columns: Columns) -> Told:
        """Return the results by variable; `columns` has one value per sample of each parameter."""
        values = numbers(columns, self._model, self._base)
        parts = np.array_split(values, max(self._threads, -(-len(values) // SHARE)))
        alone, *others = (part for part in parts if len(part))
        told = [self._part(alone)]  # the first call compiles for all threads
        with ThreadPoolExecutor(self._threads) as pool:
            told += pool.map(self._part, others)
        return {name: np.concatenate([part[name] for part in told]) for name in told[0]}

    def _part(self, values: np.ndarray) -> Told:
        """Return the results of the gait to which slow starts of each sample converge."""
        # Friction balances the weight along the slope over a period; with less there is no gait.
        friction, slope = values[:, -1], values[:, PARAMETER_NAMES.index("slope")]
        holds = friction >= np.tan(slope)
        told = self._gaits(values[holds] if holds.any() else values[:1])
        place = np.maximum(np.cumsum(holds) - 1, 0)  # any row if there is no gait
        whole = {name: leaf[place] for name, leaf in told.items()}
        outcome = np.where(holds, whole.pop("outcome"), Outcome.NO_CYCLE_FOUND)
        return masked(outcome, whole)

    def _gaits(self, values: np.ndarray) -> Told:
        """Return outcome, measures and derivatives of the gaits of wheels, shape (wheels,)."""
        cycle = slow_gaits(self._finder, values)
        told = in_batches(lambda some: _read_lanes(self._plain, some), (LANES,), cycle)
        if self._wanted:
            found = self._finder.find_many(jnp.asarray(values), cycle.section_state)
            _, slopes = in_batches(
                lambda some: read_along_lanes(self._moved, some), (LANES,), found
            )
            names = self._model.parameter_names
            for d in self._wanted:
                told[d.name] = slopes[d.measure][:, names.index(d.parameter)]
        told["outcome"] = cycle.outcome
        return {name: np.asarray(leaf) for name, leaf in told.items()}


@eqx.filter_jit
def _read_lanes(readings: Readings, cycle: WalkedCycle) -> dict[str, Array]:
    """Return the measures of a batch of gaits."""
    first = jax.tree.map(lambda leaf: leaf[:, 0], cycle.steps)
    return eqx.filter_vmap(readings)(cycle, first)


OF_PAPER: dict[str, tuple[str, ...]] = {
    "duration_single": ("duration_sls1", "duration_sls2"),
    "duration_flight": (),
    "slip": (),
    "energy_lost_impacts": ("energy_lost_landing", "energy_lost_stopper"),
    "energy_lost_friction": (),
}
"""Measures with unilateral contact as sums of measures of the paper's model."""


class LadderEngine:
    """Engine that evaluates each sample with the simplest valid model."""

    def __init__(self, asked: Asked, threads: int | None = None) -> None:
        self._measures, self._base, self._model, *_ = asked
        self._paper = ViscoelasticWheel()
        parts = (part for name in asked.measures for part in OF_PAPER.get(name, (name,)))
        of_paper = asked._replace(measures=tuple(dict.fromkeys(parts)), model=self._paper)
        self._lower = Engine(of_paper, threads)
        self._upper = GroundEngine(asked._replace(model=asked.model.upper), threads)

    def __call__(self, columns: Columns) -> Told:
        """Return the results by variable, with `rung` and `reason` of each sample."""
        n = len(next(iter(columns.values())))
        friction = columns.get(FRICTION, np.full(n, float(self._model.friction)))
        lower = self._lower(
            {"damping": np.full(n, float(self._base.damping))}
            | {name: column for name, column in columns.items() if name != FRICTION}
        )
        reason = self.reasons(lower, friction)
        rung = np.where(reason == 0, VISCOELASTIC, UNILATERAL).astype(np.int8)
        names = (*self._measures, "outcome", "spectral_radius")
        results = {
            name: sum((lower[part] for part in OF_PAPER[name]), start=np.zeros(n))
            if name in OF_PAPER
            else lower[name]
            for name in names
        }
        up = np.flatnonzero(rung == UNILATERAL)
        if up.size:
            upper = self._upper({name: column[up] for name, column in columns.items()})
            for name in names:
                results[name][up] = upper[name]
        return results | {"rung": rung, "reason": reason}

    def reasons(self, lower: Told, friction: np.ndarray) -> np.ndarray:
        """Return `ModelChoice.reason` of each gait of the paper's model, over its repeated step."""
        reason, _ = reason_of(lower, friction - self._paper.friction)
        return np.asarray(reason, np.int8)


class AnswerEngine:
    """Engine of measures to a tolerance; see `vrw.measure_to_tolerance`."""

    def __init__(self, asked: Asked) -> None:
        self._measures, self._base, self._model, *_, tol = asked
        assert tol is not None  # the caller has checked it
        self._tol = tol

    def __call__(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the results by variable; `columns` has one value per sample of each parameter."""
        *own, friction = numbers(columns, self._model, self._base).T
        params = wheel_of(tuple(map(jnp.asarray, own)), self._base.n_legs)
        stoppers = self._model.stoppers
        told = answer(self._measures, params, self._tol, friction=friction, stoppers=stoppers)
        results = {name: told.values[:, i] for i, name in enumerate(self._measures)}
        results |= {error_of(name): told.errors[:, i] for i, name in enumerate(self._measures)}
        rung = np.maximum(told.rungs - RIGID, 0).astype(np.int8)
        return masked(told.outcomes, results | {"rung": rung})


def engine_for(
    asked: Asked, threads: int | None = None
) -> Engine | GroundEngine | LadderEngine | AnswerEngine:
    """Return the engine for the samples of a scan of this model, or to a tolerance."""
    if asked.tol is not None:
        return AnswerEngine(asked)
    make: Any = ENGINES[asked.model.rung]
    return make(asked, threads)


ENGINES = {"viscoelastic": Engine, "unilateral": GroundEngine, "ladder": LadderEngine}
"""Engine classes by model, for the models that a scan supports."""

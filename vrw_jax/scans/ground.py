"""The steady gait of many wheels on real ground, and of many wheels each on its lowest rung.

On real ground a sample walks from the rung's start towards a gait, which Newton's method then
solves for on the full section state. On the ladder the paper's engine goes first, over all samples;
those whose premises break on this ground are gathered and walk on the upper rung, so that no sample
pays for another.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import (
    CycleOptions,
    Gait,
    Readings,
    finder_of,
    options_towards,
    read_along_lanes,
)
from vrw_jax.models import (
    PAPER_START,
    UNILATERAL,
    VISCOELASTIC,
    AbstractWheel,
    LadderWheel,
    UnilateralWheel,
    ViscoelasticWheel,
    as_full_states,
    reason_of,
    walk_lanes,
)
from vrw_jax.numerics import Options
from vrw_jax.scans.evaluate import Engine, filled_up, masked, n_cores, numbers
from vrw_jax.scans.offer import derivative
from vrw_jax.walks import N_TOWARDS
from vrw_jax.wheel import FRICTION, Outcome, WheelParams

LANES = 16
"""Wheels that are searched together: a number of its own, so that a sample has no company."""

Columns = Mapping[str, np.ndarray]
Told = dict[str, np.ndarray]


class GroundEngine:
    """Evaluates samples on real ground for a fixed set of measures."""

    def __init__(
        self,
        measures: tuple[str, ...],
        base: WheelParams,
        model: UnilateralWheel,
        options: Options,
        _cycle_options: CycleOptions | None = None,  # gaits here are walked
        threads: int | None = None,
    ) -> None:
        self._base, self._model = base, model
        self._threads = n_cores() if threads is None else threads
        wanted = tuple(d for name in measures if (d := derivative(name)) is not None)
        plain = (*(n for n in measures if derivative(n) is None), "spectral_radius")

        self._finder: Any = finder_of(model, base.n_legs, step_options=options)
        read = type(self._finder).read
        self._plain, self._wanted = Readings(read, plain), wanted
        self._moved = Readings(read, tuple(dict.fromkeys(d.measure for d in wanted)))

    def __call__(self, columns: Columns) -> Told:
        """Results of the samples in `columns` (one value per sample of each swept parameter)."""
        values = numbers(columns, self._model, self._base)
        n_legs = self._base.n_legs
        paper = np.tile(np.asarray(PAPER_START, values.dtype), (len(values), 1))
        start = as_full_states(values.T, paper, n_legs)
        states, _, outcome, *_ = walk_lanes(
            values.T, start, N_TOWARDS, self._model, options_towards(), n_legs
        )
        batches = [slice(begin, begin + LANES) for begin in range(0, len(values), LANES)]
        told = lambda b: self._batch(values[b], states[b], outcome[b])
        parts = [told(batches[0])]  # alone, lest each thread compile its own
        with ThreadPoolExecutor(self._threads) as pool:
            parts += pool.map(told, batches[1:])
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _batch(self, values: np.ndarray, states: np.ndarray, walked: np.ndarray) -> Told:
        gait = self._finder.find_many(filled_up(values, LANES), filled_up(states, LANES))
        told = dict(_read_lanes(self._plain, gait))
        if self._wanted:
            _, slopes = read_along_lanes(self._moved, gait)
            names = self._model.parameter_names
            for d in self._wanted:
                told[d.name] = slopes[d.measure][:, names.index(d.parameter)]
        walked = filled_up(walked, LANES)
        outcome = np.where(walked == Outcome.STEPPED, np.asarray(gait.cycle.outcome), walked)
        return {name: x[: len(values)] for name, x in masked(outcome, told).items()}


@eqx.filter_jit
def _read_lanes(readings: Readings, gait: Gait) -> dict[str, Array]:
    return eqx.filter_vmap(readings)(gait.cycle, gait.step)


OF_PAPER: dict[str, tuple[str, ...]] = {
    "duration_single": ("duration_sls1", "duration_sls2"),
    "duration_flight": (),
    "slip": (),
    "energy_lost_impacts": ("energy_lost_landing", "energy_lost_stopper"),
    "energy_lost_friction": (),
}
"""Measures of real ground as sums of the paper's."""


class LadderEngine:
    """Evaluates samples on the lowest rung that serves each of them."""

    def __init__(
        self,
        measures: tuple[str, ...],
        base: WheelParams,
        model: LadderWheel,
        options: Options,
        cycle_options: CycleOptions,
        threads: int | None = None,
    ) -> None:
        self._measures, self._base, self._model = measures, base, model
        self._paper = ViscoelasticWheel()
        asked = [part for name in measures for part in OF_PAPER.get(name, (name,))]
        self._lower = Engine(
            tuple(dict.fromkeys(asked)), base, self._paper, options, cycle_options, threads
        )
        self._upper = GroundEngine(measures, base, model.ground, options, None, threads)

    def __call__(self, columns: Columns) -> Told:
        """Results of the samples in `columns`, with `rung` and `reason` of each."""
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
        """`ModelChoice.reason` of each of the paper's gaits, over the step that it repeats."""
        reason, _ = reason_of(lower, friction - self._paper.friction)
        return np.asarray(reason, np.int8)


def engine_for(
    measures: tuple[str, ...],
    base: WheelParams,
    model: AbstractWheel,
    options: Options,
    cycle_options: CycleOptions,
    threads: int | None = None,
) -> Engine | GroundEngine | LadderEngine:
    """What computes the samples of a scan of this rung."""
    make: Any = ENGINES[model.rung]
    return make(measures, base, model, options, cycle_options, threads)


ENGINES = {"viscoelastic": Engine, "unilateral": GroundEngine, "ladder": LadderEngine}
"""By rung: those that a scan has an offer of."""

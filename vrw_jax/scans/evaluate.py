"""The steady gait of many wheels at once: one compiled function over a fixed number of lanes.

A block of samples is cut into batches of LANES wheels, the last filled up, and every batch goes
through the same compiled code: what a lane gives does not depend on where it stands, on its
neighbours, or on how many samples a scan has.

Batches run side by side: a thread for each core, all with one compiled program, or for each GPU.
"""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import AbstractCycle, CycleOptions, confirmed, finder_of
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Options
from vrw_jax.results import MARGINS
from vrw_jax.runtime import compiled
from vrw_jax.scans.offer import OF_CYCLE, derivative
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, wheel_of

LANES = 512
"""Wheels that one call of the compiled function takes."""

Told = tuple[Array, Array, dict[str, Array]]
"""Outcome, section state, and measures by name."""


class Asked(NamedTuple):
    """What samples are computed for, and by which choices."""

    measures: tuple[str, ...]
    base: WheelParams
    model: Any  # the rung
    options: Options
    cycle_options: CycleOptions
    tol: float | None  # of the measures, in their units


class Engine:
    """Evaluates samples of one wheel for a fixed set of measures; compiled at the first call.

    Two functions take turns: the limit cycle with the derivatives asked for, then one event-driven
    step from it, for the margins and as a check. They are compiled side by side.
    """

    def __init__(self, asked: Asked, threads: int | None = None) -> None:
        """`threads`: at work side by side on a CPU; None: one for each core."""
        measures, base, model, options, cycle_options, _ = asked
        self._threads = n_cores() if threads is None else threads
        self._base, self._model, self._options = base, model, options
        wanted = tuple(d for name in measures if (d := derivative(name)) is not None)
        plain = tuple(name for name in measures if derivative(name) is None)
        moved = tuple(dict.fromkeys(d.parameter for d in wanted))
        indices = np.asarray([PARAMETER_NAMES.index(name) for name in moved], int)

        finder = finder_of(model, base.n_legs, cycle_options=cycle_options, step_options=options)

        def gait(values: Array) -> tuple[AbstractCycle, dict[str, Array]]:
            def along(some: Array) -> tuple[dict[str, Array], AbstractCycle]:
                cycle = finder.cycle_of(values.at[indices].set(some))
                return cycle.measures(d.measure for d in wanted), cycle

            if not wanted:
                return along(values[indices])[1], {}
            jacobian, cycle = jax.jacfwd(along, has_aux=True)(values[indices])
            return cycle, {d.name: jacobian[d.measure][moved.index(d.parameter)] for d in wanted}

        def told_by_cycle(values: Array) -> Told:
            cycle, derivatives = gait(values)
            names = (*(name for name in plain if name in OF_CYCLE), "spectral_radius")
            return cycle.outcome, cycle.section_state, cycle.measures(names) | derivatives

        def told_by_step(values: Array, state: Array, options: Options) -> Told:
            result = model.step(wheel_of(values, base.n_legs), state, options)
            measures = result.measures()
            names = (*(name for name in plain if name not in OF_CYCLE), *MARGINS)
            return result.outcome, result.section_state, {name: measures[name] for name in names}

        self._cycle: Callable = jax.vmap(told_by_cycle)
        self._step: Callable = jax.vmap(told_by_step, in_axes=(0, 0, None))
        # A model's own repr leaves out what is its default by identity, which pickling loses.
        told = (type(model).__name__, *vars(model).items())
        self._settings = (measures, base.n_legs, told, cycle_options)
        self._free: SimpleQueue[_Programs] = SimpleQueue()
        self._workers, self._compiling = 0, Lock()

    def __call__(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Results of the samples in `columns` (one value per sample of each swept parameter)."""
        rows = numbers(columns, self._model, self._base)
        with self._compiling:
            if not self._workers:
                self._compile()
        batches = (rows[begin : begin + LANES] for begin in range(0, len(rows), LANES))
        with ThreadPoolExecutor(self._workers) as pool:
            parts = list(pool.map(self._batch, batches))
        return {n: np.concatenate([part[n] for part in parts])[: len(rows)] for n in parts[0]}

    def _batch(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Of LANES wheels: the first stands in for those that are missing."""
        filled = np.concatenate([rows, np.repeat(rows[:1], LANES - len(rows), 0)])
        programs = self._free.get()
        try:
            values = jax.device_put(filled, programs.device)
            outcome, state, by_cycle = programs.cycle(values)
            options = jax.device_put(self._options, programs.device)
            walked, reached, by_step = programs.step(values, state, options)
            checked = confirmed(outcome, state, walked, reached)
            told = by_cycle | by_step
        finally:
            self._free.put(programs)
        return masked(checked, told)

    def _compile(self) -> None:
        """Programs for each device, both kinds side by side; a CPU's serve all of its cores."""
        devices = jax.local_devices()
        values = jax.ShapeDtypeStruct((LANES, len(PARAMETER_NAMES)), self._dtype)
        state = jax.ShapeDtypeStruct((LANES, 3), self._dtype)
        settings = self._settings
        with ThreadPoolExecutor(2) as pool:
            given = (values, state, self._options)
            steps = [
                pool.submit(compiled, self._step, given, ("step", *settings), device)
                for device in devices
            ]
            cycles = [
                pool.submit(compiled, self._cycle, (values,), ("cycle", *settings), device)
                for device in devices
            ]
        for device, cycle, step in zip(devices, cycles, steps, strict=True):
            n = self._threads if device.platform == "cpu" and len(devices) == 1 else 1
            for _ in range(n):
                self._free.put(_Programs(device, cycle.result(), step.result()))
            self._workers += n

    @property
    def _dtype(self) -> np.dtype:
        return np.dtype(self._base.damping.dtype)


class _Programs(NamedTuple):
    """What a thread works with."""

    device: jax.Device
    cycle: Callable
    step: Callable


def n_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def numbers(
    columns: Mapping[str, np.ndarray], model: AbstractWheel, base: WheelParams
) -> np.ndarray:
    """The rung's numbers of each sample, (samples, numbers): swept ones, and those of the base."""
    n = len(next(iter(columns.values())))
    own = np.asarray(model.values(base))
    return np.stack(
        [
            np.asarray(columns.get(name, np.broadcast_to(value, n)), own.dtype)
            for name, value in zip(model.parameter_names, own, strict=True)
        ],
        axis=-1,
    )


def masked(outcome: np.ndarray, told: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Outcome and measures, these without numbers where there is no gait."""
    measures = {name: np.array(value) for name, value in told.items()}
    for value in measures.values():
        absent = np.nan if np.issubdtype(value.dtype, np.floating) else -1
        value[outcome != Outcome.STEPPED] = absent
    return {"outcome": outcome.astype(np.int8)} | measures

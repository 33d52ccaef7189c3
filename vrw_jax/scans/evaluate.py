"""Steady gaits of many wheels: one compiled function over a batch of fixed size.

The samples are divided into batches of `WHEELS_PER_BATCH` wheels, and the last batch is padded. The
same compiled code evaluates every batch, so the result of a sample depends neither on its position
nor on the other samples.

Batches run in parallel: one thread per core, all with one compiled program, or one thread per GPU.
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
"""Number of wheels that one call of the compiled function evaluates."""

Told = tuple[Array, Array, dict[str, Array]]
"""Outcome, section state, and measures by name."""


class Asked(NamedTuple):
    """Measures to compute for each sample, with the wheel, the model and the options."""

    measures: tuple[str, ...]
    base: WheelParams
    model: Any
    options: Options
    cycle_options: CycleOptions
    tol: float | None  # permitted error of the measures, in their units


class Engine:
    """Engine for the paper's model and a fixed set of measures, compiled at the first call.

    It finds the limit cycle with the requested derivatives by collocation. It then takes one
    event-driven step from the cycle, for the margins and as a check. Both functions are compiled in
    parallel.
    """

    def __init__(self, asked: Asked, threads: int | None = None) -> None:
        """Initialize; `threads` is the number of CPU threads, by default one per core."""
        measures, base, model, options, cycle_options, _ = asked
        self._threads = n_cores() if threads is None else threads
        self._base, self._model, self._options = base, model, options
        wanted = tuple(d for name in measures if (d := derivative(name)) is not None)
        plain = tuple(name for name in measures if derivative(name) is None)
        moved = tuple(dict.fromkeys(d.parameter for d in wanted))
        indices = np.asarray([PARAMETER_NAMES.index(name) for name in moved], int)

        finder = finder_of(model, base.n_legs, cycle_options=cycle_options, step_options=options)

        def gait(values: Array) -> tuple[AbstractCycle, dict[str, Array]]:
            """Return the limit cycle of one wheel and the requested derivatives."""

            def along(some: Array) -> tuple[dict[str, Array], AbstractCycle]:
                cycle = finder.cycle_of(values.at[indices].set(some))
                return cycle.measures(d.measure for d in wanted), cycle

            if not wanted:
                return along(values[indices])[1], {}
            jacobian, cycle = jax.jacfwd(along, has_aux=True)(values[indices])
            return cycle, {d.name: jacobian[d.measure][moved.index(d.parameter)] for d in wanted}

        def told_by_cycle(values: Array) -> Told:
            """Return outcome, section state and measures that the limit cycle gives."""
            cycle, derivatives = gait(values)
            names = (*(name for name in plain if name in OF_CYCLE), "spectral_radius")
            return cycle.outcome, cycle.section_state, cycle.measures(names) | derivatives

        def told_by_step(values: Array, state: Array, options: Options) -> Told:
            """Return outcome, section state and measures that a step from the cycle gives."""
            result = model.step(wheel_of(values, base.n_legs), state, options)
            measures = result.measures()
            names = (*(name for name in plain if name not in OF_CYCLE), *MARGINS)
            return result.outcome, result.section_state, {name: measures[name] for name in names}

        self._cycle: Callable = jax.vmap(told_by_cycle)
        self._step: Callable = jax.vmap(told_by_step, in_axes=(0, 0, None))
        # The repr of a model omits defaults by identity, and pickling does not preserve identity.
        told = (type(model).__name__, *vars(model).items())
        self._settings = (measures, base.n_legs, told, cycle_options)
        self._free: SimpleQueue[_Programs] = SimpleQueue()
        self._workers, self._compiling = 0, Lock()

    def __call__(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the results by variable; `columns` has one value per sample of each parameter."""
        rows = numbers(columns, self._model, self._base)
        with self._compiling:
            if not self._workers:
                self._compile()
        batches = (rows[begin : begin + LANES] for begin in range(0, len(rows), LANES))
        with ThreadPoolExecutor(self._workers) as pool:
            parts = list(pool.map(self._batch, batches))
        return {n: np.concatenate([part[n] for part in parts])[: len(rows)] for n in parts[0]}

    def _batch(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the results of a batch, which is padded with copies of its first wheel."""
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
        """Compile both functions in parallel for each device; all cores of a CPU share them."""
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
        """Return the floating-point type of the parameters."""
        return np.dtype(self._base.damping.dtype)


class _Programs(NamedTuple):
    """Compiled functions of one device."""

    device: jax.Device
    cycle: Callable
    step: Callable


def n_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def numbers(
    columns: Mapping[str, np.ndarray], model: AbstractWheel, base: WheelParams
) -> np.ndarray:
    """Return the model's parameters of each sample, shape (samples, parameters)."""
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
    """Return outcome and measures; a sample without a gait gets NaN, or -1 in an integer."""
    measures = {name: np.array(value) for name, value in told.items()}
    for value in measures.values():
        absent = np.nan if np.issubdtype(value.dtype, np.floating) else -1
        value[outcome != Outcome.STEPPED] = absent
    return {"outcome": outcome.astype(np.int8)} | measures

"""Steady gaits of many wheels by collocation: one compiled function over a batch of fixed size.

The samples are divided into batches of one size, and the last batch is padded. The same compiled
code evaluates every batch, so the result of a sample depends neither on its position nor on the
other samples. Batches run in parallel with one compiled program: one thread per core, or one thread
per GPU.
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

from vrw_jax.cycles import AbstractCycle, CycleOptions, confirm_outcome_by_step, make_finder
from vrw_jax.measures import MARGIN_MEASURES
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import StepOptions, batch_sizes
from vrw_jax.runtime import compile_exported, with_default_settings
from vrw_jax.scans.measure_catalog import DIFFERENTIABLE_MEASURES, parse_derivative
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, WheelParams, wheel_from_parameters

GaitOutputs = tuple[Array, Array, dict[str, Array]]
"""Outcome, section state, and measures by name."""


class EvaluationRequest(NamedTuple):
    """Measures to compute for each sample, with the wheel, the model and the options."""

    measures: tuple[str, ...]
    base: WheelParams
    model: Any
    options: StepOptions
    cycle_options: CycleOptions
    # largest permitted error of each measure, in its unit; None for a scan without tolerance
    tol: float | None
    # standard deviation of random slopes, rad; None for a scan without measures of such walks
    slope_sd: float | None = None


class CollocationEngine:
    """Engine that evaluates samples with the paper's model and a fixed set of measures; the first
    call compiles it.

    It finds the limit cycle with the requested derivatives by collocation. It then takes one
    event-driven step from the cycle, for the margins and as a check. Both functions are compiled in
    parallel.
    """

    def __init__(self, request: EvaluationRequest, threads: int | None = None) -> None:
        """Initialize the engine; `threads` is the number of CPU threads, by default one per
        core.
        """
        measures, base, model = request.measures, request.base, request.model
        options, cycle_options = request.options, request.cycle_options
        self._threads = count_cores() if threads is None else threads
        self._base, self._model, self._options = base, model, options
        requested_derivatives = tuple(
            derivative for name in measures if (derivative := parse_derivative(name)) is not None
        )
        measure_names = tuple(name for name in measures if parse_derivative(name) is None)
        parameters = tuple(
            dict.fromkeys(derivative.parameter for derivative in requested_derivatives)
        )
        swept_indices = np.asarray([PARAMETER_NAMES.index(name) for name in parameters], int)

        finder = make_finder(model, base.n_legs, cycle_options=cycle_options, step_options=options)

        def find_cycle_with_derivatives(values: Array) -> tuple[AbstractCycle, dict[str, Array]]:
            """Return the limit cycle of one wheel and the requested derivatives by name."""

            def find_measures_and_cycle(
                swept_values: Array,
            ) -> tuple[dict[str, Array], AbstractCycle]:
                cycle = finder.find_cycle_from_values(values.at[swept_indices].set(swept_values))
                return cycle.measures(
                    derivative.measure for derivative in requested_derivatives
                ), cycle

            if not requested_derivatives:
                return find_measures_and_cycle(values[swept_indices])[1], {}
            jacobian, cycle = jax.jacfwd(find_measures_and_cycle, has_aux=True)(
                values[swept_indices]
            )
            return cycle, {
                derivative.name: jacobian[derivative.measure][
                    parameters.index(derivative.parameter)
                ]
                for derivative in requested_derivatives
            }

        def evaluate_cycle(values: Array) -> GaitOutputs:
            """Return outcome, section state and measures that follow from the limit cycle."""
            cycle, derivative_values = find_cycle_with_derivatives(values)
            names = (
                *(name for name in measure_names if name in DIFFERENTIABLE_MEASURES),
                "spectral_radius",
            )
            return cycle.outcome, cycle.section_state, cycle.measures(names) | derivative_values

        def evaluate_step(values: Array, section_state: Array, options: StepOptions) -> GaitOutputs:
            """Return outcome, section state and measures that follow from a step from the cycle."""
            result = model.take_step(
                wheel_from_parameters(values, base.n_legs), section_state, options
            )
            measures = result.measures()
            names = (
                *(name for name in measure_names if name not in DIFFERENTIABLE_MEASURES),
                *MARGIN_MEASURES,
            )
            return result.outcome, result.section_state, {name: measures[name] for name in names}

        self._evaluate_cycle: Callable = jax.vmap(evaluate_cycle)
        self._evaluate_step: Callable = jax.vmap(evaluate_step, in_axes=(0, 0, None))
        # The repr of a model omits defaults by identity, and pickling does not preserve identity.
        model_identity = (type(model).__name__, *vars(model).items())
        self._cache_key = (measures, base.n_legs, model_identity, cycle_options)
        self._free_programs: SimpleQueue[_CompiledPrograms] = SimpleQueue()
        self._n_workers, self._compilation_lock = 0, Lock()

    def __call__(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the results by variable; `columns` contains the values of each swept parameter,
        one per sample.
        """
        parameter_rows = stack_parameters(columns, self._model, self._base)
        with self._compilation_lock:
            if not self._n_workers:
                self._compile()
        batches = (
            parameter_rows[first_sample : first_sample + batch_sizes.SCAN_BATCH_SIZE]
            for first_sample in range(0, len(parameter_rows), batch_sizes.SCAN_BATCH_SIZE)
        )
        with ThreadPoolExecutor(self._n_workers) as threads:
            batch_results = list(threads.map(self._evaluate_batch, batches))
        return {
            name: np.concatenate([results[name] for results in batch_results])[
                : len(parameter_rows)
            ]
            for name in batch_results[0]
        }

    @with_default_settings  # It runs in a thread of its own.
    def _evaluate_batch(self, parameter_rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the results of a batch, which is padded with copies of its first wheel."""
        padded_parameter_rows = np.concatenate(
            [
                parameter_rows,
                np.repeat(parameter_rows[:1], batch_sizes.SCAN_BATCH_SIZE - len(parameter_rows), 0),
            ]
        )
        programs = self._free_programs.get()
        try:
            values = jax.device_put(padded_parameter_rows, programs.device)
            outcome, section_state, cycle_measures = programs.evaluate_cycle(values)
            options = jax.device_put(self._options, programs.device)
            step_outcome, step_state, step_measures = programs.evaluate_step(
                values, section_state, options
            )
            confirmed_outcome = confirm_outcome_by_step(
                outcome, section_state, step_outcome, step_state
            )
            measures = cycle_measures | step_measures
        finally:
            self._free_programs.put(programs)
        return mask_failures(confirmed_outcome, measures)

    def _compile(self) -> None:
        """Compile both functions in parallel for each device; the cores of a CPU share the
        programs.
        """
        devices = jax.local_devices()
        values = jax.ShapeDtypeStruct(
            (batch_sizes.SCAN_BATCH_SIZE, len(PARAMETER_NAMES)), self._dtype
        )
        section_state = jax.ShapeDtypeStruct((batch_sizes.SCAN_BATCH_SIZE, 3), self._dtype)
        cache_key = self._cache_key
        # Threads have separate settings.
        compile_with_defaults = with_default_settings(compile_exported)
        with ThreadPoolExecutor(2) as threads:
            step_arguments = (values, section_state, self._options)
            step_programs = [
                threads.submit(
                    compile_with_defaults,
                    self._evaluate_step,
                    step_arguments,
                    ("step", *cache_key),
                    device,
                )
                for device in devices
            ]
            cycle_programs = [
                threads.submit(
                    compile_with_defaults,
                    self._evaluate_cycle,
                    (values,),
                    ("cycle", *cache_key),
                    device,
                )
                for device in devices
            ]
        for device, cycle_program, step_program in zip(
            devices, cycle_programs, step_programs, strict=True
        ):
            n_programs = self._threads if device.platform == "cpu" and len(devices) == 1 else 1
            for _ in range(n_programs):
                self._free_programs.put(
                    _CompiledPrograms(device, cycle_program.result(), step_program.result())
                )
            self._n_workers += n_programs

    @property
    def _dtype(self) -> np.dtype:
        """Return the floating-point type of the parameters."""
        return np.dtype(self._base.damping.dtype)


class _CompiledPrograms(NamedTuple):
    """Compiled functions of one device."""

    device: jax.Device
    evaluate_cycle: Callable
    evaluate_step: Callable


def count_cores() -> int:
    """Return the number of cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def stack_parameters(
    columns: Mapping[str, np.ndarray], model: AbstractWheel, base: WheelParams
) -> np.ndarray:
    """Return the model's parameters of each sample, shape (samples, parameters)."""
    n = len(next(iter(columns.values())))
    base_values = np.asarray(model.parameter_values(base))
    return np.stack(
        [
            np.asarray(columns.get(name, np.broadcast_to(value, n)), base_values.dtype)
            for name, value in zip(model.parameter_names, base_values, strict=True)
        ],
        axis=-1,
    )


def mask_failures(outcome: np.ndarray, values_by_name: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return outcome and measures by name; a sample without a gait has NaN, or -1 in an integer
    variable.
    """
    measures = {name: np.array(value) for name, value in values_by_name.items()}
    for value in measures.values():
        missing_value = np.nan if np.issubdtype(value.dtype, np.floating) else -1
        value[outcome != Outcome.STEPPED] = missing_value
    return {"outcome": outcome.astype(np.int8)} | measures

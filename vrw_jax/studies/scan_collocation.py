"""Steady gaits of many wheels by the search of `vrw.limit_cycles`, with measures and derivatives.

The samples are divided into batches of equal size, and the last batch is padded. The same compiled
code evaluates every batch, so the result for a sample depends neither on its position nor on the
other samples. Batches run in parallel with one compiled program: one thread per core, or one thread
per GPU. Samples that need walks or finer meshes are then gathered in smaller batches of one size.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base import batch_sizes
from vrw_jax.base.measures import Measure
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.collocation_search import CollocationState
from vrw_jax.gaits.finder import confirm_outcome_by_step
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.further_search import MeshSearch, replace_rows, search_further
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.lanes.batching import (
    choose_batch_size,
    concatenate_tree_rows,
    map_in_numpy_batches,
    select_tree_rows,
)
from vrw_jax.lanes.saved_traces import compile_exported_function
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.measures import MARGIN_MEASURES
from vrw_jax.studies.measure_catalog import (
    DIFFERENTIABLE_MEASURES,
    MeasureDerivative,
    ValuesByVariable,
    parse_derivative,
)
from vrw_jax.studies.scan_design import ParameterSamples
from vrw_jax.wheel.params import WheelParams

GaitOutputs = tuple[Array, Array, dict[str, Array]]
"""Outcome of a gait step, section state at its end, and measures of the step by name."""


class EvaluationRequest(NamedTuple):
    """Measures that a scan computes for each sample, with the base wheel, the model and the
    options.
    """

    measure_names: tuple[str, ...]
    base_wheel: Any
    wheel_model: Any
    step_options: StepOptions
    cycle_options: CycleOptions
    # largest permitted error of each measure, in its unit; None for a scan without tolerance
    error_tolerance: float | None
    # standard deviation of random slopes, rad; None for a scan without measures of such walks
    slope_standard_deviation: float | None = None
    own_measures: tuple[Measure, ...] = ()  # measures of the user, whose names may be requested

    @property
    def requested_derivatives(self) -> tuple[MeasureDerivative, ...]:
        """Return the measures that are derivatives."""
        return tuple(filter(None, map(parse_derivative, self.measure_names)))

    def stack_parameter_rows(self, samples_by_parameter: ParameterSamples) -> np.ndarray:
        """Return the model's parameters for each sample, shape (samples, parameters).

        Parameters that are not swept are those of `base_wheel` and `wheel_model`.
        """
        n_samples = len(next(iter(samples_by_parameter.values())))
        base_parameter_values = np.asarray(
            self.wheel_model.collect_parameter_values(self.base_wheel)
        )
        parameter_rows = np.tile(base_parameter_values, (n_samples, 1))
        for parameter_name, parameter_samples in samples_by_parameter.items():
            parameter_index = self.wheel_model.parameter_names.index(parameter_name)
            parameter_rows[:, parameter_index] = parameter_samples
        return parameter_rows


class CollocationScanEngine:
    """Scan engine for the paper's model and a fixed set of measures, compiled on the first call.

    The engine computes each limit cycle and the requested derivatives by collocation. It searches
    further for the missing gaits, as `vrw.limit_cycles` does. It then computes one event-driven
    gait step from each cycle, which gives the margins and checks the cycle. The two functions for
    all samples are compiled in parallel.
    """

    def __init__(self, evaluation_request: EvaluationRequest, n_threads: int | None = None) -> None:
        """Initialize the engine for the measures and options of `evaluation_request`.

        - `n_threads`: number of CPU threads, by default one per core.
        """
        measure_names, base_wheel, wheel_model, step_options, cycle_options, *_ = evaluation_request
        self._n_threads = n_threads or lanes.count_available_cores()
        self._evaluation_request = evaluation_request
        requested_derivatives = evaluation_request.requested_derivatives
        own_measures = {measure.name: measure for measure in evaluation_request.own_measures}
        find_measure = lambda name: own_measures.get(name, name)
        differentiation_parameters = list(
            dict.fromkeys(derivative.parameter_name for derivative in requested_derivatives)
        )
        differentiated_parameter_indices = np.asarray(
            list(map(wheel_model.parameter_names.index, differentiation_parameters)), int
        )
        # The values of a law are in the rows, so that its programs do not depend on them.
        wheel_model, n_legs = wheel_model.without_values(), base_wheel.n_legs
        gait_finder: Any = make_finder(
            wheel_model, n_legs, cycle_options=cycle_options, step_options=step_options
        )

        def evaluate_cycle(
            cycle_options: CycleOptions, parameter_values: Array, *search_start: CollocationState
        ) -> tuple:
            """Return the entries of a `MeshSearch` for one vector of parameters.

            Its gaits consist of the section state, the measures and the derivatives of the cycle.

            - `search_start`: the only start of the search; without it, all attempts are made.
            """

            def find_measures_and_cycle(
                differentiated_parameter_values: Array,
            ) -> tuple[dict[str, Array], Any]:
                limit_cycle = mesh_finder.find_cycle_from_values(
                    parameter_values.at[differentiated_parameter_indices].set(
                        differentiated_parameter_values
                    ),
                    *search_start,
                    starts_only_from_guess=bool(search_start),
                )
                return limit_cycle.measures(
                    find_measure(derivative.measure_name) for derivative in requested_derivatives
                ), limit_cycle

            mesh_finder = dataclasses.replace(gait_finder, cycle_options=cycle_options)
            if requested_derivatives:
                find_measures_and_cycle = jax.jacfwd(find_measures_and_cycle, has_aux=True)
            measure_jacobian, limit_cycle = find_measures_and_cycle(
                parameter_values[differentiated_parameter_indices]
            )
            cycle_measure_names = [
                find_measure(measure_name)
                for measure_name in measure_names
                if measure_name in DIFFERENTIABLE_MEASURES or measure_name in own_measures
            ]
            measures = limit_cycle.measures([*cycle_measure_names, "spectral_radius"]) | {
                derivative.variable_name: measure_jacobian[derivative.measure_name][
                    differentiation_parameters.index(derivative.parameter_name)
                ]
                for derivative in requested_derivatives
            }
            return (
                limit_cycle.outcome,
                limit_cycle.mesh_error,
                limit_cycle.collocation_state,
                (limit_cycle.section_state, measures),
            )

        def evaluate_confirming_step(
            parameter_values: Array, section_state: Array, step_options: StepOptions
        ) -> GaitOutputs:
            """Return outcome, end state and measures of one gait step from a limit cycle's section
            state.
            """
            step_model, params = wheel_model.from_parameter_values(parameter_values, n_legs)
            step_result = step_model.take_step(params, section_state, step_options)
            step_measures = {
                measure_name: measure_value
                for measure_name, measure_value in step_result.measures().items()
                if measure_name in MARGIN_MEASURES
                or (measure_name in measure_names and measure_name not in DIFFERENTIABLE_MEASURES)
            }
            return step_result.outcome, step_result.section_state, step_measures

        self._gait_finder = gait_finder
        self._evaluate_cycle = evaluate_cycle
        self._evaluate_cycle_batch = jax.vmap(functools.partial(evaluate_cycle, cycle_options))
        self._evaluate_step_batch: Callable = jax.vmap(
            evaluate_confirming_step, in_axes=(0, 0, None)
        )
        self._batch_size = choose_batch_size(
            batch_sizes.SCAN_BATCH_SIZE, batch_sizes.GPU_SCAN_BATCH_SIZE
        )
        self._free_programs: SimpleQueue[_CompiledDevicePrograms] = SimpleQueue()
        self._n_workers, self._compilation_lock = 0, Lock()
        self._programs_by_mesh: dict[CycleOptions, Callable] = {}

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable.

        - `samples_by_parameter`: value of each swept parameter for each sample.
        """
        parameter_rows = self._evaluation_request.stack_parameter_rows(samples_by_parameter)
        with self._compilation_lock:
            if not self._n_workers:
                self._compile_programs()
        first_search = MeshSearch(
            *self._map_in_threads(self._run_cycle_program, self._batch_size, parameter_rows)
        )
        cycle_outcomes, gaits = np.array(first_search.outcome), first_search.gaits
        default_finder: Any = make_finder(self._gait_finder.model, self._gait_finder.n_legs)
        model, params = self._gait_finder.model.from_parameter_values(
            tuple(jax.device_put(list(parameter_rows.T))), self._gait_finder.n_legs
        )
        for _, sample_indices, mesh_search in search_further(
            self._find_gaits_from_starts,
            self._gait_finder,
            model.attach_laws(params),
            first_search,
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            # A mesh that the user has chosen is fixed.
            can_refine_mesh=self._gait_finder.cycle_options == default_finder.cycle_options,
        ):
            cycle_outcomes[sample_indices] = mesh_search.outcome
            gaits = replace_rows(gaits, sample_indices, mesh_search.gaits)
        section_states, cycle_measures = gaits
        step_outcomes, step_end_states, step_measures = self._map_in_threads(
            self._run_step_program, self._batch_size, parameter_rows, section_states
        )
        confirmed_outcomes = confirm_outcome_by_step(
            cycle_outcomes, section_states, step_outcomes, step_end_states
        )
        return mask_failed_samples(confirmed_outcomes, cycle_measures | step_measures)

    def _map_in_threads(self, function: Callable, batch_size: int, *trees: Any) -> Any:
        """Apply a function of batches of one size to trees of arrays, in all threads."""
        batches = [
            select_tree_rows(trees, slice(first_row, first_row + batch_size))
            for first_row in range(0, len(jax.tree.leaves(trees)[0]), batch_size)
        ]
        evaluate_batch = with_default_jax_settings(  # Threads have separate settings.
            lambda batch: map_in_numpy_batches(function, (batch_size,), *batch)
        )
        with ThreadPoolExecutor(self._n_workers) as scan_thread_pool:
            return concatenate_tree_rows(*scan_thread_pool.map(evaluate_batch, batches))

    def _run_cycle_program(self, parameter_rows: np.ndarray) -> tuple:
        with self._take_programs() as (device, cycle_program, _):
            return cycle_program(jax.device_put(parameter_rows, device))

    def _run_step_program(self, parameter_rows: np.ndarray, section_states: np.ndarray) -> tuple:
        with self._take_programs() as (device, _, step_program):
            return step_program(
                *jax.device_put(
                    (parameter_rows, section_states, self._evaluation_request.step_options), device
                )
            )

    @contextlib.contextmanager
    def _take_programs(self) -> Iterator["_CompiledDevicePrograms"]:
        """Return a context in which one thread uses the programs of a device."""
        device_programs = self._free_programs.get()
        try:
            yield device_programs
        finally:
            self._free_programs.put(device_programs)

    def _find_gaits_from_starts(
        self, gait_finder: Any, params: WheelParams, starts: CollocationState
    ) -> MeshSearch:
        """Search for gaits on the mesh of `gait_finder` from the given starts."""
        parameter_rows = gait_finder.model.collect_batch_parameter_values(params)
        batch_size = batch_sizes.GAIT_READ_BATCH_SIZE
        with self._compilation_lock:
            cycle_program = self._programs_by_mesh.get(gait_finder.cycle_options)
            if cycle_program is None:
                cycle_program = compile_exported_function(
                    jax.vmap(functools.partial(self._evaluate_cycle, gait_finder.cycle_options)),
                    jax.tree.map(
                        lambda x: jax.ShapeDtypeStruct((batch_size, *x.shape[1:]), x.dtype),
                        (parameter_rows, starts),
                    ),
                    jax.local_devices()[0],
                )
                self._programs_by_mesh[gait_finder.cycle_options] = cycle_program
        return MeshSearch(*self._map_in_threads(cycle_program, batch_size, parameter_rows, starts))

    def _compile_programs(self) -> None:
        """Compile the functions for cycles and for gait steps in parallel, once for each device.

        All cores of a CPU use the same programs.
        """
        local_devices = jax.local_devices()
        parameter_count = len(self._evaluation_request.wheel_model.parameter_names)
        parameter_dtype = np.dtype(self._evaluation_request.base_wheel.damping.dtype)
        parameter_rows_shape = jax.ShapeDtypeStruct(
            (self._batch_size, parameter_count), parameter_dtype
        )
        section_states_shape = jax.ShapeDtypeStruct((self._batch_size, 3), parameter_dtype)
        # Threads have separate settings.
        compile_function = with_default_jax_settings(compile_exported_function)
        step_options = self._evaluation_request.step_options
        scan_program_specifications = (
            (self._evaluate_cycle_batch, (parameter_rows_shape,)),
            (
                self._evaluate_step_batch,
                (parameter_rows_shape, section_states_shape, step_options),
            ),
        )
        with ThreadPoolExecutor(2) as scan_thread_pool:
            futures_by_device = {
                device: [
                    scan_thread_pool.submit(compile_function, batch_function, arguments, device)
                    for batch_function, arguments in scan_program_specifications
                ]
                for device in local_devices
            }
        for device, program_futures in futures_by_device.items():
            device_programs = _CompiledDevicePrograms(
                device, *(program_future.result() for program_future in program_futures)
            )
            n_device_programs = (
                self._n_threads if device.platform == "cpu" and len(local_devices) == 1 else 1
            )
            for _ in range(n_device_programs):
                self._free_programs.put(device_programs)
            self._n_workers += n_device_programs


class _CompiledDevicePrograms(NamedTuple):
    """Compiled functions for cycles and for gait steps on one device."""

    device: jax.Device
    cycle_program: Callable
    step_program: Callable


def mask_failed_samples(
    outcome: np.ndarray, measures_by_name: Mapping[str, Any]
) -> ValuesByVariable:
    """Return outcomes and measures by name, where measures of samples without a gait are missing
    values.

    A missing value is NaN, or -1 for a measure that is an integer.
    """
    masked_measures = {
        variable_name: np.array(variable_values)
        for variable_name, variable_values in measures_by_name.items()
    }
    for variable_values in masked_measures.values():
        missing_value = np.nan if np.issubdtype(variable_values.dtype, np.floating) else -1
        variable_values[outcome != Outcome.STEPPED] = missing_value
    return {"outcome": outcome.astype(np.int8)} | masked_measures

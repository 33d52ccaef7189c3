"""Steady gaits of many wheels by the search of `vrw.limit_cycles`, with measures and derivatives.

The samples are divided into batches of equal size, and the last batch is padded. The same compiled
code evaluates every batch, so the result for a sample depends neither on its position nor on the
other samples. Batches run in parallel with one compiled program: one thread per core, or one thread
per GPU. Samples that need walks or finer meshes are then gathered in smaller batches of one size.
"""

import functools
from collections.abc import Callable, Iterable, Mapping
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
    ValuesByVariable,
    parse_derivative,
)
from vrw_jax.studies.scan_design import ParameterSamples
from vrw_jax.wheel.params import WheelParams


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

    def stack_parameter_rows(self, samples_by_parameter: ParameterSamples) -> np.ndarray:
        """Return the model's parameters for each sample, shape (samples, parameters).

        Parameters that are not swept are those of `base_wheel` and `wheel_model`.
        """
        model, n_samples = self.wheel_model, len(next(iter(samples_by_parameter.values())))
        rows = np.tile(np.asarray(model.collect_parameter_values(self.base_wheel)), (n_samples, 1))
        for name, samples in samples_by_parameter.items():
            rows[:, model.parameter_names.index(name)] = samples
        return rows


class CollocationScanEngine:
    """Scan engine for the paper's model and a fixed set of measures, compiled on the first call.

    The engine computes each limit cycle and the requested derivatives by collocation. It searches
    further for the missing gaits, as `vrw.limit_cycles` does. It then computes one event-driven
    gait step from each cycle, which gives the margins and checks the cycle. The two functions for
    all samples are compiled in parallel.
    """

    def __init__(self, request: EvaluationRequest, n_threads: int | None = None) -> None:
        """Initialize the engine for the measures and options of `request`.

        - `n_threads`: number of CPU threads, by default one per core.
        """
        self._request, devices = request, jax.local_devices()
        # The values of a law are in the rows, so that its programs do not depend on them.
        self._finder: Any = make_finder(
            request.wheel_model.without_values(),
            request.base_wheel.n_legs,
            cycle_options=request.cycle_options,
            step_options=request.step_options,
        )
        self.evaluate_cycles = self._make_cycle_function(self._finder)
        self.evaluate_steps: Callable = jax.vmap(
            functools.partial(_evaluate_step, self._finder, request.measure_names),
            in_axes=(0, 0, None),
        )
        if len(devices) == 1 and devices[0].platform == "cpu":
            devices = devices * (n_threads or lanes.count_available_cores())
        self.devices, self._free_devices = devices, SimpleQueue[jax.Device]()
        for device in devices:
            self._free_devices.put(device)
        self.programs: dict[Any, dict[jax.Device, Callable]] = {}
        self._compilation_lock = Lock()

    def _make_cycle_function(self, finder: Any) -> Callable:
        request = self._request
        return jax.vmap(
            functools.partial(_evaluate_cycle, finder, request.measure_names, request.own_measures)
        )

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable.

        - `samples_by_parameter`: value of each swept parameter for each sample.
        """
        finder, step_options = self._finder, self._request.step_options
        rows = self._request.stack_parameter_rows(samples_by_parameter)
        size = choose_batch_size(batch_sizes.SCAN_BATCH_SIZE, batch_sizes.GPU_SCAN_BATCH_SIZE)
        row_shapes, state_shapes = (
            jax.ShapeDtypeStruct((size, n), rows.dtype) for n in (rows.shape[1], 3)
        )
        with self._compilation_lock, ThreadPoolExecutor(2) as pool:
            cycles = pool.submit(self._compile, "cycles", self.evaluate_cycles, row_shapes)
            self._compile("steps", self.evaluate_steps, row_shapes, state_shapes, step_options)
            cycles.result()

        def find_from_starts(
            mesh_finder: Any, params: WheelParams, starts: CollocationState
        ) -> MeshSearch:
            size, key = batch_sizes.GAIT_READ_BATCH_SIZE, mesh_finder.cycle_options
            arguments = (mesh_finder.model.collect_batch_parameter_values(params), starts)
            shapes = jax.tree.map(
                lambda x: jax.ShapeDtypeStruct((size, *x.shape[1:]), x.dtype), arguments
            )
            with self._compilation_lock:
                self._compile(key, self._make_cycle_function(mesh_finder), *shapes)
            return MeshSearch(*self._run(key, size, *arguments))

        first_search = MeshSearch(*self._run("cycles", size, rows))
        outcomes, gaits = np.array(first_search.outcome), first_search.gaits
        model, params = finder.model.from_parameter_values(
            tuple(jax.device_put(list(rows.T))), finder.n_legs
        )
        default_finder: Any = make_finder(finder.model, finder.n_legs)
        for _, indices, mesh_search in search_further(
            find_from_starts,
            finder,
            model.attach_laws(params),
            first_search,
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            # A mesh that the user has chosen is fixed.
            can_refine_mesh=finder.cycle_options == default_finder.cycle_options,
        ):
            outcomes[indices] = mesh_search.outcome
            gaits = replace_rows(gaits, indices, mesh_search.gaits)
        section_states, measures = gaits
        step_outcomes, end_states, step_measures = self._run(
            "steps", size, rows, section_states, shared=(step_options,)
        )
        outcomes = confirm_outcome_by_step(outcomes, section_states, step_outcomes, end_states)
        return mask_failed_samples(outcomes, measures | step_measures)

    def _compile(self, key: Any, function: Callable, *arguments: Any) -> None:
        """Compile a function once for each device. All cores of a CPU use the same program."""
        if key not in self.programs:
            # Threads have separate settings.
            compile_function = with_default_jax_settings(compile_exported_function)
            self.programs[key] = {
                device: compile_function(function, arguments, device) for device in {*self.devices}
            }

    def _run(self, key: Any, size: int, *trees: Any, shared: tuple = ()) -> Any:
        """Run a program on trees of arrays in batches of one size, in all threads."""

        def run_batch(*batch: Any) -> Any:
            device = self._free_devices.get()
            try:
                return self.programs[key][device](*jax.device_put((*batch, *shared), device))
            finally:
                self._free_devices.put(device)

        first_rows = range(0, len(jax.tree.leaves(trees)[0]), size)
        return concatenate_tree_rows(
            *map_in_threads(
                lambda batch: map_in_numpy_batches(run_batch, (size,), *batch),
                [select_tree_rows(trees, slice(i, i + size)) for i in first_rows],
                len(self.devices),
            )
        )


def _evaluate_cycle(
    finder: Any,
    names: tuple[str, ...],
    own_measures: tuple[Measure, ...],
    values: Array,
    *start: CollocationState,
) -> tuple:
    """Return the entries of a `MeshSearch` for one vector of parameters.

    Its gaits consist of the section state, the measures and the derivatives of the cycle.

    - `start`: the only start of the search; without it, all attempts are made.
    """
    derivatives = tuple(filter(None, map(parse_derivative, names)))
    parameters = list(dict.fromkeys(x.parameter_name for x in derivatives))
    indices = np.array(list(map(finder.model.parameter_names.index, parameters)), int)
    own = {measure.name: measure for measure in own_measures}

    def measure_cycle(differentiated_values: Array) -> tuple[dict[str, Array], Any]:
        cycle = finder.find_cycle_from_values(
            values.at[indices].set(differentiated_values),
            *start,
            starts_only_from_guess=bool(start),
        )
        return cycle.measures(own.get(x.measure_name, x.measure_name) for x in derivatives), cycle

    if derivatives:
        measure_cycle = jax.jacfwd(measure_cycle, has_aux=True)
    jacobians, cycle = measure_cycle(values[indices])
    read_names = [name for name in names if name in DIFFERENTIABLE_MEASURES or name in own]
    measures = cycle.measures([own.get(x, x) for x in (*read_names, "spectral_radius")])
    for x in derivatives:
        measures[x.variable_name] = jacobians[x.measure_name][parameters.index(x.parameter_name)]
    state = cycle.collocation_state
    return cycle.outcome, cycle.mesh_error, state, (cycle.section_state, measures)


def _evaluate_step(
    finder: Any, names: tuple[str, ...], values: Array, x: Array, options: StepOptions
) -> tuple:
    """Return outcome, end state and measures of one gait step from a section state."""
    model, params = finder.model.from_parameter_values(values, finder.n_legs)
    step = model.take_step(params, x, options)
    step_names = {*names}.difference(DIFFERENTIABLE_MEASURES)
    measures = {
        name: value
        for name, value in step.measures().items()
        if name in MARGIN_MEASURES or name in step_names
    }
    return step.outcome, step.section_state, measures


def map_in_threads(evaluate: Callable, blocks: Iterable, n_threads: int) -> Iterable:
    """Return the results of a function for blocks of samples, computed in threads."""
    # Threads have separate settings.
    with ThreadPoolExecutor(n_threads) as pool:
        return pool.map(with_default_jax_settings(evaluate), blocks)


def mask_failed_samples(
    outcome: np.ndarray, measures_by_name: Mapping[str, Any]
) -> ValuesByVariable:
    """Return outcomes and measures by name, where measures of samples without a gait are missing
    values.

    A missing value is NaN, or -1 for a measure that is an integer.
    """
    masked = {name: np.array(values) for name, values in measures_by_name.items()}
    for values in masked.values():
        missing_value = np.nan if np.issubdtype(values.dtype, np.floating) else -1
        values[outcome != Outcome.STEPPED] = missing_value
    return {"outcome": outcome.astype(np.int8)} | masked

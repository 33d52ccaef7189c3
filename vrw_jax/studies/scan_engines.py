"""Engines of scans: gaits of many wheels with measures and derivatives, for each kind of model.

For the paper's model, the samples are divided into batches of equal size, and the last batch is
padded. The same compiled code evaluates every batch, so the result for a sample depends neither on
its position nor on the other samples. Batches run in parallel with one compiled program: one thread
per core, or one thread per GPU. Samples that need walks or finer meshes are then gathered in
smaller batches of one size.

All other gaits are found, measured and differentiated by `evaluate_gaits`. With unilateral contact,
the gait is the one to which a walk from a slow start converges. If that walk does not converge, it
is the slowest gait of all starts. For the simplest valid model, all samples are first evaluated
with the paper's model. Samples that violate a margin are then evaluated with unilateral contact.
"""

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.gaits.cycle import CycleOptions
from vrw_jax.gaits.finder import MeasureReader, confirm_outcome_by_step, evaluate_on_gaits
from vrw_jax.gaits.further_search import MAX_UNREFINED_MESH_ERROR, MeshSearch, search_further
from vrw_jax.gaits.gait_search import make_finder
from vrw_jax.gaits.gait_walks import find_slow_gaits
from vrw_jax.gaits.phase_sequence import CollocationState
from vrw_jax.gaits.walker_finder import find_gaits_with_walks, make_walker_finder
from vrw_jax.gaits.wheel_finders import KinkedGaitFinder
from vrw_jax.lanes.batching import (
    choose_batch_size,
    concatenate_tree_rows,
    map_in_numpy_batches,
    replace_rows,
    select_tree_rows,
)
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.lanes.program import compile_exported_function
from vrw_jax.models.ladder import ModelCode, find_selection_reason
from vrw_jax.models.measures import MARGIN_MEASURES, PASSAGE_MEASURES, SELECTION_MARGIN_NAMES
from vrw_jax.studies.fidelity import ModelIndex
from vrw_jax.studies.first_passage import first_passage
from vrw_jax.studies.measure_catalog import (
    DIFFERENTIABLE_MEASURES,
    ERROR_VARIABLE_SUFFIX,
    MeasureDerivative,
    ValuesByVariable,
    parse_derivative,
)
from vrw_jax.studies.scan_design import ParameterSamples
from vrw_jax.studies.tolerances import measure_to_tolerance
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    PARAMETER_NAMES,
    WheelParams,
    make_wheel_from_parameters,
)

SCAN_BATCH_SIZE = 512
"""Number of samples of a scan that one call computes, fixed so that the results for a sample do not
depend on other samples.
"""
GPU_SCAN_BATCH_SIZE = 4096
"""Number of samples of a scan that one call on a GPU computes, chosen because it is the default
size of a chunk.
"""
SCAN_TASK_SIZE = 512
"""Largest number of samples with unilateral contact that one thread task computes."""
GAIT_READ_BATCH_SIZE = 64
"""Number of gaits with unilateral contact that one call measures, fixed for the same reason as
`SCAN_BATCH_SIZE`.
"""

UNSTABLE_GAIT_MESH_ERROR = 1e-11
"""Largest mesh error of a gait that an event-driven step has not confirmed on a coarser mesh.

The value is chosen because the error of a gait with a multiplier of 9 then stays far below
the tolerance of the confirmation.
"""


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

    def are_rows_in_domain(self, rows: np.ndarray) -> np.ndarray:
        """Return for each row of parameters whether all are finite and within their domains.

        The friction of a wheel may be infinite.
        """
        domains = self.wheel_model.parameter_domains.items()
        is_inside = [
            domain.contains_parameter_value(values)
            | (self.wheel_model.is_wheel and name == FRICTION_NAME and np.isposinf(values))
            for (name, domain), values in zip(domains, rows.T, strict=True)
        ]
        return np.all(is_inside, axis=0)

    def make_gait_finder(self) -> Any:
        """Return the finder of gaits, whose programs do not depend on the values of a law.

        These values are in the rows of parameters.
        """
        if not self.wheel_model.is_wheel:
            return make_walker_finder(self.wheel_model.walker, self.base_wheel, self.step_options)
        return make_finder(
            self.wheel_model.without_values(),
            self.base_wheel.n_legs,
            period_n=self.wheel_model.leg_period,
            cycle_options=self.cycle_options,
            step_options=self.step_options,
        )

    def make_reader(self, finder: Any, names: Iterable[str]) -> MeasureReader:
        """Return the function of a cycle and a step that returns the named measures."""
        own = {measure.name: measure for measure in self.own_measures}
        return MeasureReader(
            finder.measure_reader, tuple(own.get(name, name) for name in dict.fromkeys(names))
        )

    @property
    def derivatives(self) -> tuple[MeasureDerivative, ...]:
        """Return the requested derivatives."""
        return tuple(filter(None, map(parse_derivative, self.measure_names)))


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
        self._finder = request.make_gait_finder()
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
        size = choose_batch_size(SCAN_BATCH_SIZE, GPU_SCAN_BATCH_SIZE)
        with self._compilation_lock, ThreadPoolExecutor(2) as pool:
            cycles = pool.submit(self._compile, "cycles", self.evaluate_cycles, size, rows)
            # The dtype and the number of entries of a section state are those of three columns.
            step_arrays = rows, rows[:, :3]
            self._compile("steps", self.evaluate_steps, size, *step_arrays, shared=(step_options,))
            cycles.result()

        def find_from_starts(
            mesh_finder: Any, params: WheelParams, starts: CollocationState
        ) -> MeshSearch:
            size, key = GAIT_READ_BATCH_SIZE, mesh_finder.cycle_options
            arguments = (mesh_finder.model.collect_batch_parameter_values(params), starts)
            with self._compilation_lock:
                self._compile(key, self._make_cycle_function(mesh_finder), size, *arguments)
            return MeshSearch(*self._run(key, size, *arguments))

        search = MeshSearch(*self._run("cycles", size, rows))
        cycle_outcomes, gaits = np.array(search.outcome), search.gaits
        model, params = finder.model.from_parameter_values(
            tuple(jax.device_put(list(rows.T))), finder.n_legs
        )
        default_finder: Any = make_finder(finder.model, finder.n_legs, period_n=finder.period_n)
        # A mesh that the user has chosen is fixed.
        can_refine_mesh = finder.cycle_options == default_finder.cycle_options
        searched, params = np.arange(len(rows)), model.attach_laws(params)
        outcomes, max_mesh_error = cycle_outcomes, MAX_UNREFINED_MESH_ERROR
        steps: Any = ()
        for is_last_round in (not can_refine_mesh, True):
            for _, indices, mesh_search in search_further(
                find_from_starts,
                finder,
                select_tree_rows(params, searched),
                search,
                (GAIT_READ_BATCH_SIZE,),
                can_refine_mesh=can_refine_mesh,
                max_mesh_error=max_mesh_error,
            ):
                cycle_outcomes[searched[indices]] = mesh_search.outcome
                gaits = replace_rows(gaits, searched[indices], mesh_search.gaits)
            section_states, measures = gaits
            starts = select_tree_rows((rows, section_states), searched)
            new_steps = self._run("steps", size, *starts, shared=(step_options,))
            steps = replace_rows(steps, searched, new_steps) if steps else new_steps
            step_outcomes, end_states, step_measures = steps
            outcomes = confirm_outcome_by_step(
                cycle_outcomes, section_states, step_outcomes, end_states
            )
            # The errors of unstable gaits grow in the step, so that they may need a finer mesh.
            is_unconfirmed = (cycle_outcomes == Outcome.STEPPED) & (
                outcomes == Outcome.MESH_TOO_COARSE
            )
            searched = np.flatnonzero(is_unconfirmed)
            if is_last_round or not len(searched):
                break
            search, max_mesh_error = select_tree_rows(search, searched), UNSTABLE_GAIT_MESH_ERROR
        return mask_failed_samples(outcomes, measures | step_measures)

    def _compile(
        self, key: Any, function: Callable, size: int, *trees: Any, shared: tuple = ()
    ) -> None:
        """Compile a function of trees of arrays for batches of one size, once for each device.

        All cores of a CPU use the same program.
        """
        if key not in self.programs:
            get_shape = lambda x: jax.ShapeDtypeStruct((size, *x.shape[1:]), x.dtype)
            arguments = (*jax.tree.map(get_shape, trees), *shared)
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
    step = model.take_step_of_gait(params, x, options)
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


SampleEvaluator = Callable[[ParameterSamples], ValuesByVariable]
"""Function that returns the values of each variable for samples, by the name of the variable."""


def evaluate_gaits(
    request: EvaluationRequest, n_threads: int, samples_by_parameter: ParameterSamples
) -> ValuesByVariable:
    """Return the value of each variable for all samples, by name.

    Blocks of samples are computed in threads. Samples that can have no gait are not searched.
    """
    rows, finder = request.stack_parameter_rows(samples_by_parameter), request.make_gait_finder()
    is_in_domain = is_searched = request.are_rows_in_domain(rows)
    if finder.is_multistable:
        finder = dataclasses.replace(finder, gait_batch_sizes=(GAIT_READ_BATCH_SIZE,))
        # Over a period friction balances the weight along the slope.
        friction, slope = rows[:, -1], rows[:, PARAMETER_NAMES.index("slope")]
        is_searched = is_in_domain & (friction >= np.tan(slope))
    searched_rows = rows[is_searched] if is_searched.any() else rows[:1]
    # Walkers of the user are computed in batches of one size, which are not divided.
    unit = 1 if finder.model.is_wheel else GAIT_READ_BATCH_SIZE
    size = min(SCAN_TASK_SIZE, unit * -(-len(searched_rows) // (unit * n_threads)))
    first_block, *other_blocks = np.split(searched_rows, range(size, len(searched_rows), size))
    evaluate = functools.partial(_evaluate_block, request, finder)
    first_results = evaluate(first_block)  # This call compiles for all threads.
    results = concatenate_tree_rows(
        first_results, *map_in_threads(evaluate, other_blocks, n_threads)
    )
    # Samples that are not searched may have any row.
    results = select_tree_rows(results, np.maximum(np.cumsum(is_searched) - 1, 0))
    failures = np.where(is_in_domain, Outcome.NO_CYCLE_FOUND, Outcome.BAD_INPUT)
    return mask_failed_samples(np.where(is_searched, results.pop("outcome"), failures), results)


def _evaluate_block(request: EvaluationRequest, finder: Any, rows: np.ndarray) -> ValuesByVariable:
    """Return outcomes, measures and derivatives of the gaits of all rows, by name."""
    size, has_kinks = (GAIT_READ_BATCH_SIZE,), isinstance(finder, KinkedGaitFinder)
    cycles, derivatives = _find_gaits(finder, rows), request.derivatives
    names = [name for name in request.measure_names if parse_derivative(name) is None]
    reader = request.make_reader(finder, [*names, *(MARGIN_MEASURES if has_kinks else ())])
    results = map_in_numpy_batches(functools.partial(_read_gaits, finder, reader), size, cycles)
    if derivatives:
        reader = request.make_reader(finder, (x.measure_name for x in derivatives))
        starts = cycles.section_state
        if finder.is_multistable:  # The search needs no batches of one size.
            gaits = finder.find_gaits(jnp.asarray(rows), starts)
            _, jacobians = map_in_numpy_batches(
                functools.partial(evaluate_on_gaits, reader), size, gaits
            )
        else:
            differentiate = functools.partial(_differentiate_gaits, finder, reader)
            jacobians = map_in_numpy_batches(
                differentiate, (1,) if has_kinks else size, rows, starts
            )
        index = finder.model.parameter_names.index
        for x in derivatives:
            results[x.variable_name] = jacobians[x.measure_name][:, index(x.parameter_name)]
    return results


def _find_gaits(finder: Any, rows: np.ndarray) -> Any:
    """Return the gait of each row, with unilateral contact that of a walk from a slow start."""
    if finder.is_multistable:
        return find_slow_gaits(finder, rows)
    if finder.model.is_wheel:
        return jax.tree.map(
            lambda *x: jnp.stack(x), *map(finder.find_cycle_from_values, jnp.asarray(rows))
        )
    size = (GAIT_READ_BATCH_SIZE,)
    return find_gaits_with_walks(
        functools.partial(map_in_numpy_batches, functools.partial(_find_cycles, finder), size),
        finder.model.walker,
        finder.model.from_parameter_values(list(rows.T), 0)[1],
        map_in_numpy_batches(functools.partial(_propose_starts, finder), size, rows),
        finder.step_options,
        finder.period_n,
    )


@eqx.filter_jit
def _propose_starts(finder: Any, rows: Any) -> Array:
    return jax.vmap(finder.make_initial_guess)(rows)


@eqx.filter_jit
def _find_cycles(finder: Any, params: Any, guesses: Any) -> Any:
    # No measure is read from the step.
    return jax.vmap(finder.find_cycle)(params, guesses)._replace(last_step=None)


@eqx.filter_jit
def _read_gaits(finder: Any, reader: MeasureReader, cycles: Any) -> dict[str, Array]:
    def read(cycle: Any) -> dict[str, Array]:
        results = {"outcome": cycle.outcome, "spectral_radius": cycle.spectral_radius}
        return results | reader(cycle, finder.read_step(cycle))

    return eqx.filter_vmap(read)(cycles)


@eqx.filter_jit
def _differentiate_gaits(
    finder: Any, reader: MeasureReader, rows: Any, starts: Any
) -> dict[str, Array]:
    return evaluate_on_gaits(reader, finder.find_gaits(rows, starts))[1]


PAPER_MEASURES_BY_CONTACT_MEASURE: dict[str, tuple[str, ...]] = {
    "duration_single": ("duration_sls1", "duration_sls2"),
    "duration_flight": (),
    "slip": (),
    "energy_lost_impacts": ("energy_lost_landing", "energy_lost_stopper"),
    "energy_lost_friction": (),
}
"""Names of the paper's measures whose sum equals a measure with unilateral contact.

The keys are names of measures with unilateral contact.
"""


_find_selection_reason = jax.jit(find_selection_reason)


def find_selection_reasons(
    wheel_model: Any, paper_results: ValuesByVariable, friction: np.ndarray
) -> np.ndarray:
    """Return `ModelChoice.reason_code` for each sample.

    - `wheel_model`: ladder of models;
    - `paper_results`: margins and outcomes of the gaits computed with the paper's model, by name;
    - `friction`: friction coefficient of the ground for each sample.
    """
    reasons, _ = map_in_numpy_batches(
        _find_selection_reason,
        (GAIT_READ_BATCH_SIZE,),
        {name: paper_results[name] for name in (*SELECTION_MARGIN_NAMES, "outcome")},
        friction - wheel_model.viscoelastic_model.friction,
    )
    return reasons.astype(np.int8)


def evaluate_with_simplest_model(
    request: EvaluationRequest,
    evaluate_with_paper_model: SampleEvaluator,
    evaluate_contact_gaits: SampleEvaluator,
    samples_by_parameter: ParameterSamples,
) -> ValuesByVariable:
    """Return the value of each variable for all samples, by name, each with the simplest model
    that is valid for the sample.

    The variables include `rung`, the code of the model, and `reason`, the code of the reason for
    the choice of this model.
    """
    n_samples = len(next(iter(samples_by_parameter.values())))
    paper_samples = {"damping": np.full(n_samples, float(request.base_wheel.damping))}
    paper_samples |= samples_by_parameter
    friction = paper_samples.pop(
        FRICTION_NAME, np.full(n_samples, float(request.wheel_model.friction))
    )
    results = evaluate_with_paper_model(paper_samples)
    reasons = find_selection_reasons(request.wheel_model, results, friction)
    for contact_measure, paper_measures in PAPER_MEASURES_BY_CONTACT_MEASURE.items():
        if contact_measure in request.measure_names:
            results[contact_measure] = sum(
                map(results.__getitem__, paper_measures), start=np.zeros(n_samples)
            )
    names = (*request.measure_names, "outcome", "spectral_radius")
    results = {name: results[name] for name in names}
    contact_indices = np.flatnonzero(reasons)
    if contact_indices.size:
        contact_samples = select_tree_rows(samples_by_parameter, contact_indices)
        results = replace_rows(results, contact_indices, evaluate_contact_gaits(contact_samples))
    model_codes = np.where(reasons == 0, ModelCode.VISCOELASTIC, ModelCode.UNILATERAL)
    return results | {"rung": model_codes.astype(np.int8), "reason": reasons}


def evaluate_to_tolerance(
    request: EvaluationRequest, samples_by_parameter: ParameterSamples
) -> ValuesByVariable:
    """Return the value of each variable for all samples, computed to a tolerance, by the name of
    the variable.

    See `vrw.measure_to_tolerance`.

    - `samples_by_parameter`: value of each swept parameter for each sample.
    """
    assert request.error_tolerance is not None
    names, rows = request.measure_names, request.stack_parameter_rows(samples_by_parameter)
    result = measure_to_tolerance(
        names,
        make_wheel_from_parameters(tuple(map(jnp.asarray, rows.T[:-1])), request.base_wheel.n_legs),
        request.error_tolerance,
        friction=rows[:, -1],
        stoppers=request.wheel_model.stoppers,
    )
    measures = dict(zip(names, result.values.T, strict=True))
    error_names = (name + ERROR_VARIABLE_SUFFIX for name in names)
    measures |= dict(zip(error_names, result.errors.T, strict=True))
    measures["rung"] = np.maximum(result.models - ModelIndex.RIGID, 0).astype(np.int8)
    outcomes = np.where(request.are_rows_in_domain(rows), result.outcomes, Outcome.BAD_INPUT)
    return mask_failed_samples(outcomes, measures)


def evaluate_passages(
    request: EvaluationRequest,
    evaluate_steady_gaits: SampleEvaluator,
    samples_by_parameter: ParameterSamples,
) -> ValuesByVariable:
    """Return the results of another engine, with measures of walks over random slopes.

    Samples are computed one after another, each with the same random numbers.
    """
    results, slope_sd = (
        evaluate_steady_gaits(samples_by_parameter),
        request.slope_standard_deviation,
    )
    assert slope_sd is not None  # The measures need it.
    outcomes, dtype = results["outcome"], request.base_wheel.damping.dtype
    measures = {
        name: np.full(len(outcomes), np.nan, dtype)
        for name in request.measure_names
        if name in PASSAGE_MEASURES
    }
    # The default options of walks have larger tolerances.
    options = None if request.step_options == StepOptions() else request.step_options
    for index in np.flatnonzero(outcomes == Outcome.STEPPED) if measures else ():
        model, params = request.wheel_model, request.base_wheel
        for name, samples in samples_by_parameter.items():
            model, params = model.with_parameter(params, name, jnp.asarray(float(samples[index])))
        # Hardly any step of the walks succeeds if `first_passage` raises an error.
        with contextlib.suppress(ValueError):
            passage = first_passage(params, slope_sd, model=model, options=options)
            for name, values in measures.items():
                values[index] = getattr(passage, "error" if name == "mean_steps_error" else name)
    return results | measures


def make_scan_engine(request: EvaluationRequest, n_threads: int | None = None) -> SampleEvaluator:
    """Return the engine that computes the measures of an `EvaluationRequest`.

    - `n_threads`: number of CPU threads, by default one per core.
    """
    n_threads, model = n_threads or lanes.count_available_cores(), request.wheel_model
    if request.error_tolerance is not None:
        return functools.partial(evaluate_to_tolerance, request)
    if request.slope_standard_deviation is not None:
        names = request.measure_names
        gait_request = request._replace(
            measure_names=tuple(name for name in names if name not in PASSAGE_MEASURES),
            slope_standard_deviation=None,
        )
        gait_engine = make_scan_engine(gait_request, n_threads)
        return functools.partial(evaluate_passages, request, gait_engine)
    if model.is_wheel and model.fallback_model is not model:
        names = request.measure_names
        paper_names = (PAPER_MEASURES_BY_CONTACT_MEASURE.get(name, (name,)) for name in names)
        paper_request = request._replace(
            measure_names=tuple(dict.fromkeys(itertools.chain(*paper_names))),
            wheel_model=model.viscoelastic_model,
        )
        contact_request = request._replace(wheel_model=model.fallback_model)
        return functools.partial(
            evaluate_with_simplest_model,
            request,
            make_scan_engine(paper_request, n_threads),
            make_scan_engine(contact_request, n_threads),
        )
    if model.is_wheel and model.batch_kernel == "phases" and not model.has_kinks:
        return CollocationScanEngine(request, n_threads)
    return functools.partial(evaluate_gaits, request, n_threads)

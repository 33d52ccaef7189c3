"""Engines of scans: gaits of many wheels with measures and derivatives, for each kind of model.

For the paper's model, the samples are divided into batches of equal size, and the last batch is
padded. The same compiled code evaluates every batch, so the result for a sample depends neither on
its position nor on the other samples. Batches run in parallel with one compiled program: one thread
per core, or one thread per GPU. Samples that need walks or finer meshes are then gathered in
smaller batches of one size.

With unilateral contact, the engine returns the gait to which a walk from a slow start converges. If
that walk does not converge, it returns the slowest gait of all starts. For the simplest valid
model, all samples are first evaluated with the paper's model. Samples that violate a margin are
then evaluated with unilateral contact.
"""

import contextlib
import dataclasses
import functools
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
from vrw_jax.base import batch_sizes
from vrw_jax.base.measures import Measure
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.collocation_search import CollocationState
from vrw_jax.gaits.finder import MeasureReader, confirm_outcome_by_step, evaluate_on_gaits
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.further_search import (
    MAX_UNREFINED_MESH_ERROR,
    MeshSearch,
    search_further,
)
from vrw_jax.gaits.gait_walks import find_slow_gaits
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.return_map_finder import ReturnMapCycle
from vrw_jax.gaits.walker_finder import WalkerFinder, collect_walk_ends, make_walker_finder
from vrw_jax.lanes.batching import (
    choose_batch_size,
    concatenate_tree_rows,
    map_in_batches,
    map_in_numpy_batches,
    replace_rows,
    select_tree_rows,
)
from vrw_jax.lanes.saved_traces import compile_exported_function
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.ladder import ModelCode, find_selection_reason
from vrw_jax.models.measures import MARGIN_MEASURES, PASSAGE_MEASURES, SELECTION_MARGIN_NAMES
from vrw_jax.studies.fidelity import ModelIndex
from vrw_jax.studies.first_passage import first_passage
from vrw_jax.studies.measure_catalog import (
    DIFFERENTIABLE_MEASURES,
    ERROR_VARIABLE_SUFFIX,
    ValuesByVariable,
    parse_derivative,
)
from vrw_jax.studies.scan_design import ParameterSamples
from vrw_jax.studies.tolerance_request import measure_to_tolerance
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    PARAMETER_NAMES,
    WheelParams,
    make_wheel_from_parameters,
)

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
        return make_finder(
            self.wheel_model.without_values(),
            self.base_wheel.n_legs,
            period_n=self.wheel_model.leg_period,
            cycle_options=self.cycle_options,
            step_options=self.step_options,
        )

    @property
    def direct_names(self) -> tuple[str, ...]:
        """Return the names of the measures that are no derivatives, and of the spectral radius."""
        names = (name for name in self.measure_names if parse_derivative(name) is None)
        return tuple(dict.fromkeys((*names, "spectral_radius")))

    def read_derivatives(
        self, differentiate: Callable[..., Mapping[str, Any]], model: Any
    ) -> dict[str, Any]:
        """Return the requested derivatives by the names of their variables.

        - `differentiate`: function of names of measures that returns the derivatives of each
          measure by all parameters of the model, (samples, parameters).
        """
        derivatives = list(filter(None, map(parse_derivative, self.measure_names)))
        if not derivatives:
            return {}
        jacobians = differentiate(tuple(dict.fromkeys(x.measure_name for x in derivatives)))
        index = model.parameter_names.index
        return {
            x.variable_name: jacobians[x.measure_name][:, index(x.parameter_name)]
            for x in derivatives
        }


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
                (batch_sizes.GAIT_READ_BATCH_SIZE,),
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


def _evaluate_blocks(
    evaluate: Callable[[np.ndarray], ValuesByVariable],
    blocks: Iterable[np.ndarray],
    n_threads: int,
) -> ValuesByVariable:
    first_block, *other_blocks = blocks
    first_results = evaluate(first_block)  # This call compiles for all threads.
    return concatenate_tree_rows(first_results, *map_in_threads(evaluate, other_blocks, n_threads))


def evaluate_contact_gaits(
    evaluation_request: EvaluationRequest, n_threads: int, samples_by_parameter: ParameterSamples
) -> ValuesByVariable:
    """Return the value of each variable for all samples, with unilateral contact, by name."""
    rows = evaluation_request.stack_parameter_rows(samples_by_parameter)
    n_blocks = max(n_threads, -(-len(rows) // batch_sizes.SCAN_TASK_SIZE))
    # Of few samples, the last blocks are empty.
    blocks = filter(len, np.array_split(rows, n_blocks))
    return _evaluate_blocks(
        functools.partial(_evaluate_contact_block, evaluation_request), blocks, n_threads
    )


def _evaluate_contact_block(
    evaluation_request: EvaluationRequest, rows: np.ndarray
) -> ValuesByVariable:
    """Return the values of the gaits to which walks from slow starts converge, by name.

    - `rows`: parameters of the wheels, shape (samples, parameters).
    """
    model, batch_size = evaluation_request.wheel_model, (batch_sizes.GAIT_READ_BATCH_SIZE,)
    gait_finder: Any = make_finder(
        model, evaluation_request.base_wheel.n_legs, step_options=evaluation_request.step_options
    )
    gait_finder = dataclasses.replace(gait_finder, gait_batch_sizes=batch_size)
    # Over a period friction balances the weight along the slope. Without enough friction no gait
    # exists.
    friction, slope = rows[:, -1], rows[:, PARAMETER_NAMES.index("slope")]
    is_in_domain = evaluation_request.are_rows_in_domain(rows)
    may_have_gait = is_in_domain & (friction >= np.tan(slope))
    rows = rows[may_have_gait] if may_have_gait.any() else rows[:1]
    slow_gaits = find_slow_gaits(gait_finder, rows)
    make_reader = functools.partial(MeasureReader, gait_finder.measure_reader)
    read_gaits = functools.partial(
        _read_gait_measures, make_reader(evaluation_request.direct_names)
    )
    results = map_in_batches(read_gaits, batch_size, slow_gaits)
    differentiate = lambda names: map_in_batches(
        functools.partial(evaluate_on_gaits, make_reader(names)),
        batch_size,
        gait_finder.find_gaits(jnp.asarray(rows), slow_gaits.section_state),
    )[1]
    results |= evaluation_request.read_derivatives(differentiate, model)
    # Samples without a gait may have any index.
    gait_indices = np.maximum(np.cumsum(may_have_gait) - 1, 0)
    outcomes, results = select_tree_rows((slow_gaits.outcome, results), gait_indices)
    outcomes = np.where(may_have_gait, outcomes, Outcome.NO_CYCLE_FOUND)
    outcomes = np.where(is_in_domain, outcomes, Outcome.BAD_INPUT)
    return mask_failed_samples(outcomes, results)


@eqx.filter_jit
def _read_gait_measures(
    measure_reader: MeasureReader, gait_batch: ReturnMapCycle
) -> dict[str, Array]:
    first_gait_step = jax.tree.map(lambda values_by_step: values_by_step[:, 0], gait_batch.steps)
    return eqx.filter_vmap(measure_reader)(gait_batch, first_gait_step)


def evaluate_gaits_with_kinks(
    evaluation_request: EvaluationRequest, samples_by_parameter: ParameterSamples
) -> ValuesByVariable:
    """Return the value of each variable for all samples of a force with kinks, by name.

    Event-driven steps stop at the kinks. The gaits are found one after another.
    """
    finder = evaluation_request.make_gait_finder()
    rows = jnp.asarray(evaluation_request.stack_parameter_rows(samples_by_parameter))
    cycles = jax.tree.map(lambda *x: jnp.stack(x), *map(finder.find_cycle_from_values, rows))
    names = (*dict.fromkeys((*evaluation_request.direct_names, *MARGIN_MEASURES)),)
    own = {measure.name: measure for measure in evaluation_request.own_measures}
    find_measures = lambda names: tuple(own.get(name, name) for name in names)
    reader = MeasureReader(finder.measure_reader, find_measures(names))
    results = map_in_batches(
        functools.partial(_read_gaits_with_kinks, finder, reader),
        (batch_sizes.GAIT_READ_BATCH_SIZE,),
        rows,
        cycles,
    )

    def differentiate(names: tuple[str, ...]) -> dict[str, np.ndarray]:
        jacobians = [
            finder.measure_gait(row, state, find_measures(names)).parameter_jacobian
            for row, state in zip(rows, cycles.section_state, strict=True)
        ]
        return dict(zip(names, np.stack(jacobians, 1), strict=True))

    results |= evaluation_request.read_derivatives(differentiate, finder.model)
    return mask_failed_samples(np.asarray(cycles.outcome), results)


@eqx.filter_jit
def _read_gaits_with_kinks(
    finder: Any, reader: MeasureReader, rows: Array, cycles: ReturnMapCycle
) -> dict[str, Array]:
    def read(row: Array, cycle: ReturnMapCycle) -> dict[str, Array]:
        model, params = finder.model.from_parameter_values(row, finder.n_legs)
        step = model.take_step_of_gait(params, cycle.section_state, finder.step_options)
        return reader(cycle, step)

    return eqx.filter_vmap(read)(rows, cycles)


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


class ModelSelectionScanEngine:
    """Scan engine that evaluates each sample with the simplest model that is valid for the
    sample.
    """

    def __init__(self, evaluation_request: EvaluationRequest, n_threads: int) -> None:
        self._measure_names, self._base_wheel, self._wheel_model, *_ = evaluation_request
        self._paper_model = self._wheel_model.viscoelastic_model
        paper_measure_names = (
            paper_measure
            for measure_name in self._measure_names
            for paper_measure in PAPER_MEASURES_BY_CONTACT_MEASURE.get(
                measure_name, (measure_name,)
            )
        )
        self._paper_engine = make_scan_engine(
            evaluation_request._replace(
                measure_names=tuple(dict.fromkeys(paper_measure_names)),
                wheel_model=self._paper_model,
            ),
            n_threads,
        )
        self._evaluate_contact_gaits = functools.partial(
            evaluate_contact_gaits,
            evaluation_request._replace(wheel_model=self._wheel_model.fallback_model),
            n_threads,
        )

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable.

        The variables include `rung`, the code of the model, and `reason`, the code of the reason
        for the choice of this model.
        """
        n_samples = len(next(iter(samples_by_parameter.values())))
        paper_samples = {"damping": np.full(n_samples, float(self._base_wheel.damping))}
        paper_samples |= samples_by_parameter
        friction = paper_samples.pop(
            FRICTION_NAME, np.full(n_samples, float(self._wheel_model.friction))
        )
        paper_results = self._paper_engine(paper_samples)
        reasons = self.compute_selection_reasons(paper_results, friction)
        model_codes = np.where(reasons == 0, ModelCode.VISCOELASTIC, ModelCode.UNILATERAL)
        variable_names = (*self._measure_names, "outcome", "spectral_radius")
        for contact_measure, paper_measures in PAPER_MEASURES_BY_CONTACT_MEASURE.items():
            if contact_measure in variable_names:
                paper_results[contact_measure] = sum(
                    map(paper_results.__getitem__, paper_measures), start=np.zeros(n_samples)
                )
        results = {name: paper_results[name] for name in variable_names}
        contact_samples = np.flatnonzero(model_codes == ModelCode.UNILATERAL)
        if contact_samples.size:
            contact_results = self._evaluate_contact_gaits(
                select_tree_rows(samples_by_parameter, contact_samples)
            )
            for name, values in results.items():
                values[contact_samples] = contact_results[name]
        return results | {"rung": model_codes.astype(np.int8), "reason": reasons}

    def compute_selection_reasons(
        self, paper_results: ValuesByVariable, friction: np.ndarray
    ) -> np.ndarray:
        """Return `ModelChoice.reason_code` for each sample.

        - `paper_results`: margins and outcomes of the gaits computed with the paper's model, by
          name;
        - `friction`: friction coefficient of the ground for each sample.
        """
        reasons, _ = map_in_numpy_batches(
            _find_selection_reason,
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            {name: paper_results[name] for name in (*SELECTION_MARGIN_NAMES, "outcome")},
            friction - self._paper_model.friction,
        )
        return reasons.astype(np.int8)


def evaluate_to_tolerance(
    evaluation_request: EvaluationRequest, samples_by_parameter: ParameterSamples
) -> ValuesByVariable:
    """Return the value of each variable for all samples, computed to a tolerance, by the name of
    the variable.

    See `vrw.measure_to_tolerance`.

    - `samples_by_parameter`: value of each swept parameter for each sample.
    """
    assert evaluation_request.error_tolerance is not None
    measure_names = evaluation_request.measure_names
    rows = evaluation_request.stack_parameter_rows(samples_by_parameter)
    *wheel_parameter_columns, sample_friction = rows.T
    params = make_wheel_from_parameters(
        tuple(map(jnp.asarray, wheel_parameter_columns)), evaluation_request.base_wheel.n_legs
    )
    measure_result = measure_to_tolerance(
        measure_names,
        params,
        evaluation_request.error_tolerance,
        friction=sample_friction,
        stoppers=evaluation_request.wheel_model.stoppers,
    )
    error_names = (name + ERROR_VARIABLE_SUFFIX for name in measure_names)
    sample_results = dict(zip(measure_names, measure_result.values.T, strict=True))
    sample_results |= dict(zip(error_names, measure_result.errors.T, strict=True))
    model_codes = np.maximum(measure_result.models - ModelIndex.RIGID, 0).astype(np.int8)
    is_in_domain = evaluation_request.are_rows_in_domain(rows)
    outcomes = np.where(is_in_domain, measure_result.outcomes, Outcome.BAD_INPUT)
    return mask_failed_samples(outcomes, sample_results | {"rung": model_codes})


def evaluate_own_gaits(
    evaluation_request: EvaluationRequest, n_threads: int, samples_by_parameter: ParameterSamples
) -> ValuesByVariable:
    """Return the value of each variable for all samples, for a walker of the user, by name."""
    rows = evaluation_request.stack_parameter_rows(samples_by_parameter)
    finder = make_walker_finder(
        evaluation_request.wheel_model.walker,
        evaluation_request.base_wheel,
        evaluation_request.step_options,
    )
    propose = functools.partial(_propose_starts, finder)
    evaluate = functools.partial(_evaluate_walkers, finder, evaluation_request.measure_names)

    def evaluate_block(block: np.ndarray) -> ValuesByVariable:
        guesses = map_in_numpy_batches(propose, (WALKER_BLOCK_SIZE,), block)
        results = map_in_numpy_batches(evaluate, (WALKER_BLOCK_SIZE,), block, guesses)
        params = finder.model.from_parameter_values(list(block.T), 0)[1]
        failed, starts = collect_walk_ends(
            finder.model.walker, params, guesses, results["outcome"], finder.step_options,
            finder.period_n,
        )  # fmt: skip
        if not len(failed):
            return results
        found = map_in_numpy_batches(evaluate, (WALKER_BLOCK_SIZE,), block[failed], starts)
        is_found = found["outcome"] == Outcome.STEPPED
        return replace_rows(results, failed[is_found], select_tree_rows(found, is_found))

    results = _evaluate_blocks(
        evaluate_block,
        np.split(rows, range(WALKER_BLOCK_SIZE, len(rows), WALKER_BLOCK_SIZE)),
        n_threads,
    )
    is_in_domain = evaluation_request.are_rows_in_domain(rows)
    outcomes = np.where(is_in_domain, results.pop("outcome"), Outcome.BAD_INPUT)
    return mask_failed_samples(outcomes, results)


WALKER_BLOCK_SIZE = 64
"""Number of samples that one call computes, fixed so that the results for a sample do not depend on
other samples. It is small, because a walker whose functions have no machine code is slow.
"""


@eqx.filter_jit
def _propose_starts(finder: WalkerFinder, rows: Any) -> Array:
    return jax.vmap(finder.make_initial_guess)(rows)


@eqx.filter_jit
def _evaluate_walkers(
    finder: WalkerFinder, variable_names: tuple[str, ...], rows: Any, guesses: Any
) -> dict[str, Array]:
    read = finder.measure_reader
    derivatives = {name: parse_derivative(name) for name in variable_names}
    if any(derivatives.values()):
        gaits = finder.find_gaits(rows, guesses)
        cycles, cycle_derivatives = gaits.cycle, gaits.cycle_derivatives
    else:
        cycles = jax.vmap(finder.find_cycle_from_values)(rows, guesses)
    results = {"outcome": cycles.outcome, "spectral_radius": cycles.spectral_radius}
    for name, derivative in derivatives.items():
        if derivative is None:
            results[name] = read(name, cycles)
        else:
            index = finder.model.parameter_names.index(derivative.parameter_name)
            results[name] = read(derivative.measure_name, cycle_derivatives)[:, index]
    return results


def evaluate_passages(
    evaluation_request: EvaluationRequest,
    evaluate_gaits: SampleEvaluator,
    samples_by_parameter: ParameterSamples,
) -> ValuesByVariable:
    """Return the results of another engine, with measures of walks over random slopes.

    Samples are computed one after another, each with the same random numbers.
    """
    results = evaluate_gaits(samples_by_parameter)
    slope_sd = evaluation_request.slope_standard_deviation
    assert slope_sd is not None  # The measures need it.
    outcomes, dtype = results["outcome"], evaluation_request.base_wheel.damping.dtype
    passage_measures = {
        name: np.full(len(outcomes), np.nan, dtype)
        for name in evaluation_request.measure_names
        if name in PASSAGE_MEASURES
    }
    # The default options of walks have larger tolerances.
    given_options = evaluation_request.step_options
    options = None if given_options == StepOptions() else given_options
    for index in np.flatnonzero(outcomes == Outcome.STEPPED) if passage_measures else ():
        model, params = evaluation_request.wheel_model, evaluation_request.base_wheel
        for name, samples in samples_by_parameter.items():
            model, params = model.with_parameter(params, name, jnp.asarray(float(samples[index])))
        # Hardly any step of the walks succeeds if `first_passage` raises an error.
        with contextlib.suppress(ValueError):
            passage = first_passage(params, slope_sd, model=model, options=options)
            for name, values in passage_measures.items():
                values[index] = getattr(passage, "error" if name == "mean_steps_error" else name)
    return results | passage_measures


def make_scan_engine(
    evaluation_request: EvaluationRequest, n_threads: int | None = None
) -> SampleEvaluator:
    """Return the engine that computes the measures of an `EvaluationRequest`.

    - `n_threads`: number of CPU threads, by default one per core.
    """
    n_threads, model = n_threads or lanes.count_available_cores(), evaluation_request.wheel_model
    if evaluation_request.error_tolerance is not None:
        return functools.partial(evaluate_to_tolerance, evaluation_request)
    if evaluation_request.slope_standard_deviation is not None:
        names = evaluation_request.measure_names
        gait_request = evaluation_request._replace(
            measure_names=tuple(name for name in names if name not in PASSAGE_MEASURES),
            slope_standard_deviation=None,
        )
        gait_engine = make_scan_engine(gait_request, n_threads)
        return functools.partial(evaluate_passages, evaluation_request, gait_engine)
    if not model.is_wheel:
        return functools.partial(evaluate_own_gaits, evaluation_request, n_threads)
    if model.fallback_model is not model:
        return ModelSelectionScanEngine(evaluation_request, n_threads)
    if model.batch_kernel == "legs":
        return functools.partial(evaluate_contact_gaits, evaluation_request, n_threads)
    if model.has_kinks:
        return functools.partial(evaluate_gaits_with_kinks, evaluation_request)
    return CollocationScanEngine(evaluation_request, n_threads)

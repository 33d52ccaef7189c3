"""Engines that compute steady gaits with unilateral contact, with the simplest valid model, or to a
tolerance.

With unilateral contact the result is the gait to which a walk from a slow start converges, or the
slowest gait of all starts. For the simplest valid model, the paper's model evaluates all samples
first. The samples that violate a margin are then evaluated with unilateral contact.
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

from vrw_jax.cycles import (
    MeasureReader,
    ReturnMapCycle,
    evaluate_on_gaits,
    find_slow_gaits,
    make_finder,
)
from vrw_jax.measures import PASSAGE_MEASURES
from vrw_jax.models import GaitMethod, ViscoelasticWheel
from vrw_jax.numerics import batch_sizes, map_in_batches, map_in_numpy_batches
from vrw_jax.robustness import first_passage
from vrw_jax.runtime import with_default_settings
from vrw_jax.scans.collocation_engine import (
    CollocationEngine,
    EvaluationRequest,
    count_cores,
    mask_failures,
    stack_parameters,
)
from vrw_jax.scans.measure_catalog import error_variable_name, parse_derivative
from vrw_jax.selection import SELECTION_MARGINS, ModelCode, find_selection_reason
from vrw_jax.tolerance import ModelIndex, measure_to_tolerance
from vrw_jax.wheel import FRICTION_NAME, PARAMETER_NAMES, Outcome, wheel_from_parameters

SampleMapping = Mapping[str, np.ndarray]
"""Swept parameters by name, with one value per sample."""
ResultColumns = dict[str, np.ndarray]
"""Results by variable, with one value per sample."""


class UnilateralEngine:
    """Engine that evaluates samples with unilateral contact and a fixed set of measures."""

    def __init__(self, request: EvaluationRequest, threads: int | None = None) -> None:
        measures, base = request.measures, request.base
        model, options = request.model, request.options
        self._base, self._model = base, model
        self._threads = count_cores() if threads is None else threads
        derivatives = tuple(
            derivative for name in measures if (derivative := parse_derivative(name)) is not None
        )
        measure_names = (
            *(name for name in measures if parse_derivative(name) is None),
            "spectral_radius",
        )

        finder: Any = make_finder(model, base.n_legs, step_options=options)
        self._finder = dataclasses.replace(
            finder, gait_batch_sizes=(batch_sizes.GAIT_READ_BATCH_SIZE,)
        )
        read_measure = type(finder).read_measure
        self._measure_reader, self._derivatives = (
            MeasureReader(read_measure, measure_names),
            derivatives,
        )
        self._derivative_reader = MeasureReader(
            read_measure, tuple(dict.fromkeys(derivative.measure for derivative in derivatives))
        )

    def __call__(self, columns: SampleMapping) -> ResultColumns:
        """Return the results by variable; `columns` contains the values of each swept parameter,
        one per sample.
        """
        values = stack_parameters(columns, self._model, self._base)
        value_parts = np.array_split(
            values, max(self._threads, -(-len(values) // batch_sizes.SCAN_TASK_SIZE))
        )
        first_part, *other_parts = (
            results_of_part for results_of_part in value_parts if len(results_of_part)
        )
        results = [self._evaluate_part(first_part)]  # The first call compiles for all threads.
        with ThreadPoolExecutor(self._threads) as threads:
            results += threads.map(self._evaluate_part, other_parts)
        return {
            name: np.concatenate([results_of_part[name] for results_of_part in results])
            for name in results[0]
        }

    @with_default_settings  # It runs in a thread of its own.
    def _evaluate_part(self, values: np.ndarray) -> ResultColumns:
        """Return the results of the gait to which a walk from a slow start converges, for each
        sample.
        """
        # Over a period friction balances the weight along the slope; with less friction there is no
        # gait.
        friction, slope = values[:, -1], values[:, PARAMETER_NAMES.index("slope")]
        has_enough_friction = friction >= np.tan(slope)
        results = self._evaluate_gaits(
            values[has_enough_friction] if has_enough_friction.any() else values[:1]
        )
        # Samples without a gait may have any index.
        result_index = np.maximum(np.cumsum(has_enough_friction) - 1, 0)
        results_of_all = {name: leaf[result_index] for name, leaf in results.items()}
        outcome = np.where(
            has_enough_friction, results_of_all.pop("outcome"), Outcome.NO_CYCLE_FOUND
        )
        return mask_failures(outcome, results_of_all)

    def _evaluate_gaits(self, values: np.ndarray) -> ResultColumns:
        """Return outcome, measures and derivatives of the gaits of wheels by name, shape
        (wheels,).
        """
        cycle = find_slow_gaits(self._finder, values)
        results = map_in_batches(
            lambda cycles: _read_measures(self._measure_reader, cycles),
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            cycle,
        )
        if self._derivatives:
            differentiable_cycles = self._finder.find_gaits(
                jnp.asarray(values), cycle.section_state
            )
            _, jacobians = map_in_batches(
                lambda cycles: evaluate_on_gaits(self._derivative_reader, cycles),
                (batch_sizes.GAIT_READ_BATCH_SIZE,),
                differentiable_cycles,
            )
            names = self._model.parameter_names
            for derivative in self._derivatives:
                results[derivative.name] = jacobians[derivative.measure][
                    :, names.index(derivative.parameter)
                ]
        results["outcome"] = cycle.outcome
        return {name: np.asarray(leaf) for name, leaf in results.items()}


@eqx.filter_jit
def _read_measures(reader: MeasureReader, cycle: ReturnMapCycle) -> dict[str, Array]:
    """Return the measures of a batch of gaits by name."""
    first_step = jax.tree.map(lambda leaf: leaf[:, 0], cycle.steps)
    return eqx.filter_vmap(reader)(cycle, first_step)


PAPER_MEASURE_SUMS: dict[str, tuple[str, ...]] = {
    "duration_single": ("duration_sls1", "duration_sls2"),
    "duration_flight": (),
    "slip": (),
    "energy_lost_impacts": ("energy_lost_landing", "energy_lost_stopper"),
    "energy_lost_friction": (),
}
"""Measures with unilateral contact as sums of measures of the paper's model."""


class LadderEngine:
    """Engine that evaluates each sample with the simplest valid model."""

    def __init__(self, request: EvaluationRequest, threads: int | None = None) -> None:
        self._measures, self._base, self._model = request.measures, request.base, request.model
        self._paper_model = ViscoelasticWheel()
        paper_measures = (
            measure
            for name in request.measures
            for measure in PAPER_MEASURE_SUMS.get(name, (name,))
        )
        paper_request = request._replace(
            measures=tuple(dict.fromkeys(paper_measures)), model=self._paper_model
        )
        self._paper_engine = CollocationEngine(paper_request, threads)
        self._unilateral_engine = UnilateralEngine(
            request._replace(model=request.model.fallback_model), threads
        )

    def __call__(self, columns: SampleMapping) -> ResultColumns:
        """Return the results by variable, with `rung` (the model's code) and `reason` of each
        sample.
        """
        n_samples = len(next(iter(columns.values())))
        friction = columns.get(FRICTION_NAME, np.full(n_samples, float(self._model.friction)))
        paper_results = self._paper_engine(
            {"damping": np.full(n_samples, float(self._base.damping))}
            | {name: column for name, column in columns.items() if name != FRICTION_NAME}
        )
        reason = self.find_reasons(paper_results, friction)
        rung = np.where(reason == 0, ModelCode.VISCOELASTIC, ModelCode.UNILATERAL).astype(np.int8)
        names = (*self._measures, "outcome", "spectral_radius")
        results = {
            name: sum(
                (paper_results[paper_measure] for paper_measure in PAPER_MEASURE_SUMS[name]),
                start=np.zeros(n_samples),
            )
            if name in PAPER_MEASURE_SUMS
            else paper_results[name]
            for name in names
        }
        unilateral_samples = np.flatnonzero(rung == ModelCode.UNILATERAL)
        if unilateral_samples.size:
            unilateral_results = self._unilateral_engine(
                {name: column[unilateral_samples] for name, column in columns.items()}
            )
            for name in names:
                results[name][unilateral_samples] = unilateral_results[name]
        return results | {"rung": rung, "reason": reason}

    def find_reasons(self, paper_results: ResultColumns, friction: np.ndarray) -> np.ndarray:
        """Return `ModelChoice.reason_code` of each gait of the paper's model, from the margins
        over its step.
        """
        names = (*SELECTION_MARGINS, "outcome")
        reason = map_in_numpy_batches(
            _find_selection_reasons,
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            {name: paper_results[name] for name in names},
            friction - self._paper_model.friction,
        )
        return reason.astype(np.int8)


@jax.jit
def _find_selection_reasons(measures: dict[str, Array], friction_difference: Array) -> Array:
    """Return `ModelChoice.reason_code` of a batch of viscoelastic steps."""
    return find_selection_reason(measures, friction_difference)[0]


class ToleranceEngine:
    """Engine that computes measures to a tolerance; see `vrw.measure_to_tolerance`."""

    def __init__(self, request: EvaluationRequest) -> None:
        assert request.tol is not None
        self._measures, self._base, self._model = request.measures, request.base, request.model
        self._tol = request.tol

    def __call__(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the results by variable; `columns` contains the values of each swept parameter,
        one per sample.
        """
        *wheel_columns, friction = stack_parameters(columns, self._model, self._base).T
        params = wheel_from_parameters(tuple(map(jnp.asarray, wheel_columns)), self._base.n_legs)
        stoppers = self._model.stoppers
        measure_result = measure_to_tolerance(
            self._measures, params, self._tol, friction=friction, stoppers=stoppers
        )
        results = {
            name: measure_result.values[:, measure_index]
            for measure_index, name in enumerate(self._measures)
        }
        results |= {
            error_variable_name(name): measure_result.errors[:, measure_index]
            for measure_index, name in enumerate(self._measures)
        }
        rung = np.maximum(measure_result.models - ModelIndex.RIGID, 0).astype(np.int8)
        return mask_failures(measure_result.outcomes, results | {"rung": rung})


class PassageEngine:
    """Engine that adds walks over random slopes to the gaits of another engine.

    Samples are computed one after another, each with the same random numbers.
    """

    def __init__(self, request: EvaluationRequest, slope_sd: float, gait_engine: Any) -> None:
        self._base, self._model, self._slope_sd = request.base, request.model, slope_sd
        self._names = tuple(name for name in request.measures if name in PASSAGE_MEASURES)
        self._gait_engine = gait_engine

    def __call__(self, columns: SampleMapping) -> ResultColumns:
        """Return the results by variable; `columns` contains the values of each swept parameter,
        one per sample.
        """
        results: ResultColumns = dict(self._gait_engine(columns))
        outcome = results["outcome"]
        passages = np.full((len(self._names), len(outcome)), np.nan, self._base.damping.dtype)
        for sample in np.flatnonzero(outcome == Outcome.STEPPED) if self._names else ():
            values = {name: float(column[sample]) for name, column in columns.items()}
            passages[:, sample] = self._measure_passage(values)
        return results | dict(zip(self._names, passages, strict=True))

    def _measure_passage(self, values: Mapping[str, float]) -> list[float]:
        """Return the measures of one sample; NaN if hardly any step of its walks succeeds."""
        model, params = self._model, self._base
        for name, value in values.items():
            model, params = model.with_parameter(params, name, jnp.asarray(value))
        try:
            # mypy takes the name for the module `robustness.first_passage`.
            passage = first_passage(params, self._slope_sd, model=model)  # type: ignore[operator]
        except ValueError:
            return [np.nan] * len(self._names)
        by_name = {
            "mean_steps": passage.mean_steps,
            "mean_steps_error": passage.error,
            "failure_probability": passage.failure_probability,
        }
        return [float(by_name[name]) for name in self._names]


def make_engine(
    request: EvaluationRequest, threads: int | None = None
) -> CollocationEngine | UnilateralEngine | LadderEngine | ToleranceEngine | PassageEngine:
    """Return the engine for a scan of this model, or for a scan to a tolerance."""
    if request.tol is not None:
        return ToleranceEngine(request)
    engine_class: Any = ENGINE_CLASSES[request.model.capabilities.gait_method]
    if request.slope_sd is None:
        return engine_class(request, threads)
    measures = tuple(name for name in request.measures if name not in PASSAGE_MEASURES)
    gait_engine = engine_class(request._replace(measures=measures), threads)
    return PassageEngine(request, request.slope_sd, gait_engine)


ENGINE_CLASSES = {
    GaitMethod.COLLOCATION: CollocationEngine,
    GaitMethod.CONTACT_WALKS: UnilateralEngine,
    GaitMethod.SELECTION: LadderEngine,
}
"""Engine classes by gait method, for the methods that scans support."""

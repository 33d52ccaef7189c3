"""Scan engines for unilateral contact, for the simplest valid model, and for measures to a
tolerance.

With unilateral contact, the engine returns the gait to which a walk from a slow start converges. If
that walk does not converge, it returns the slowest gait of all starts. For the simplest valid
model, all samples are first evaluated with the paper's model. Samples that violate a margin are
then evaluated with unilateral contact.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base import batch_sizes
from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.attracting_gaits import find_slow_gaits
from vrw_jax.gaits.finder import MeasureReader, evaluate_on_gaits
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.return_map_finder import ReturnMapCycle
from vrw_jax.gaits.walker_finder import WalkerFinder, make_walker_finder
from vrw_jax.lanes.batching import map_in_batches, map_in_numpy_batches
from vrw_jax.lanes.settings import with_default_jax_settings
from vrw_jax.models.ladder import ModelCode, find_selection_reason
from vrw_jax.models.measures import PASSAGE_MEASURES, SELECTION_MARGIN_NAMES
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.studies.first_passage import first_passage
from vrw_jax.studies.lower_fidelity import ModelIndex
from vrw_jax.studies.measure_catalog import (
    ValuesByVariable,
    make_error_variable_name,
    parse_derivative,
)
from vrw_jax.studies.scan_collocation import (
    CollocationScanEngine,
    EvaluationRequest,
    concatenate_results,
    mask_failed_samples,
)
from vrw_jax.studies.scan_design import ParameterSamples
from vrw_jax.studies.tolerance_request import measure_to_tolerance
from vrw_jax.wheel.params import FRICTION_NAME, PARAMETER_NAMES, make_wheel_from_parameters

SampleEvaluator = Callable[[ParameterSamples], ValuesByVariable]
"""Function that returns the values of each variable for samples, by the name of the variable."""


class UnilateralScanEngine:
    """Scan engine for unilateral contact and a fixed set of measures."""

    def __init__(self, evaluation_request: EvaluationRequest, n_threads: int | None) -> None:
        self._evaluation_request = evaluation_request
        variable_names, base_wheel, self._wheel_model, step_options, *_ = evaluation_request
        self._n_threads = n_threads or lanes.count_available_cores()
        self._requested_derivatives = evaluation_request.requested_derivatives
        measure_names = [name for name in variable_names if parse_derivative(name) is None]
        gait_finder: Any = make_finder(
            self._wheel_model, base_wheel.n_legs, step_options=step_options
        )
        self._gait_finder = dataclasses.replace(
            gait_finder, gait_batch_sizes=(batch_sizes.GAIT_READ_BATCH_SIZE,)
        )
        read_measure = type(gait_finder).read_measure
        self._measure_reader = MeasureReader(read_measure, (*measure_names, "spectral_radius"))
        differentiated_measures = dict.fromkeys(
            derivative.measure_name for derivative in self._requested_derivatives
        )
        self._derivative_reader = MeasureReader(read_measure, tuple(differentiated_measures))

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable.

        - `samples_by_parameter`: value of each swept parameter for each sample.
        """
        parameter_rows = self._evaluation_request.stack_parameter_rows(samples_by_parameter)
        parameter_row_subsets = np.array_split(
            parameter_rows,
            max(self._n_threads, -(-len(parameter_rows) // batch_sizes.SCAN_TASK_SIZE)),
        )
        # Of few samples, the last subsets are empty. The first call compiles for all threads.
        first_parameter_rows, *remaining_parameter_rows = filter(len, parameter_row_subsets)
        results_by_subset = [self._evaluate_sample_subset(first_parameter_rows)]
        with ThreadPoolExecutor(self._n_threads) as scan_thread_pool:
            results_by_subset += scan_thread_pool.map(
                self._evaluate_sample_subset, remaining_parameter_rows
            )
        return concatenate_results(results_by_subset)

    @with_default_jax_settings  # It runs in a thread of its own.
    def _evaluate_sample_subset(self, parameter_rows: np.ndarray) -> ValuesByVariable:
        """Return the value of each variable for a subset of the samples, by the name of the
        variable.

        The values are those of the gait to which a walk from a slow start converges.

        - `parameter_rows`: parameters of the wheels, shape (samples, parameters).
        """
        # Over a period friction balances the weight along the slope. Without enough friction no
        # gait exists.
        friction, slope = parameter_rows[:, -1], parameter_rows[:, PARAMETER_NAMES.index("slope")]
        has_enough_friction = friction >= np.tan(slope)
        gait_results = self._evaluate_gaits(
            parameter_rows[has_enough_friction] if has_enough_friction.any() else parameter_rows[:1]
        )
        # Samples without a gait may have any index.
        gait_indices = np.maximum(np.cumsum(has_enough_friction) - 1, 0)
        sample_results = {
            variable_name: variable_values[gait_indices]
            for variable_name, variable_values in gait_results.items()
        }
        outcome_by_sample = np.where(
            has_enough_friction, sample_results.pop("outcome"), Outcome.NO_CYCLE_FOUND
        )
        return mask_failed_samples(outcome_by_sample, sample_results)

    def _evaluate_gaits(self, parameter_rows: np.ndarray) -> ValuesByVariable:
        """Return outcomes, measures and derivatives for the gaits of some wheels, by name.

        Each array has the shape (wheels,).
        """
        slow_gaits = find_slow_gaits(self._gait_finder, parameter_rows)
        gait_results = map_in_batches(
            lambda gait_batch: _read_gait_measures(self._measure_reader, gait_batch),
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            slow_gaits,
        )
        if self._requested_derivatives:
            differentiable_cycles = self._gait_finder.find_gaits(
                jnp.asarray(parameter_rows), slow_gaits.section_state
            )
            _, measure_jacobians = map_in_batches(
                lambda gait_batch: evaluate_on_gaits(self._derivative_reader, gait_batch),
                (batch_sizes.GAIT_READ_BATCH_SIZE,),
                differentiable_cycles,
            )
            parameter_names = self._wheel_model.parameter_names
            for derivative in self._requested_derivatives:
                gait_results[derivative.variable_name] = measure_jacobians[derivative.measure_name][
                    :, parameter_names.index(derivative.parameter_name)
                ]
        gait_results["outcome"] = slow_gaits.outcome
        return {
            variable_name: np.asarray(variable_values)
            for variable_name, variable_values in gait_results.items()
        }


@eqx.filter_jit
def _read_gait_measures(
    measure_reader: MeasureReader, gait_batch: ReturnMapCycle
) -> dict[str, Array]:
    """Return the requested measures of a batch of gaits, by name."""
    first_gait_step = jax.tree.map(lambda values_by_step: values_by_step[:, 0], gait_batch.steps)
    return eqx.filter_vmap(measure_reader)(gait_batch, first_gait_step)


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

    def __init__(self, evaluation_request: EvaluationRequest, n_threads: int | None) -> None:
        self._measure_names, self._base_wheel, self._wheel_model, *_ = evaluation_request
        self._paper_model = ViscoelasticWheel()
        paper_measure_names = (
            paper_measure
            for measure_name in self._measure_names
            for paper_measure in PAPER_MEASURES_BY_CONTACT_MEASURE.get(
                measure_name, (measure_name,)
            )
        )
        paper_evaluation_request = evaluation_request._replace(
            measure_names=tuple(dict.fromkeys(paper_measure_names)), wheel_model=self._paper_model
        )
        self._paper_engine = CollocationScanEngine(paper_evaluation_request, n_threads)
        self._unilateral_engine = UnilateralScanEngine(
            evaluation_request._replace(wheel_model=self._wheel_model.fallback_model), n_threads
        )

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable.

        The variables include `rung`, the code of the model, and `reason`, the code of the reason
        for the choice of this model.
        """
        n_samples = len(next(iter(samples_by_parameter.values())))
        sample_friction = samples_by_parameter.get(
            FRICTION_NAME, np.full(n_samples, float(self._wheel_model.friction))
        )
        paper_results = self._paper_engine(
            {"damping": np.full(n_samples, float(self._base_wheel.damping))}
            | {
                parameter_name: parameter_samples
                for parameter_name, parameter_samples in samples_by_parameter.items()
                if parameter_name != FRICTION_NAME
            }
        )
        selection_reasons = self.compute_selection_reasons(paper_results, sample_friction)
        model_codes = np.where(
            selection_reasons == 0, ModelCode.VISCOELASTIC, ModelCode.UNILATERAL
        ).astype(np.int8)
        variable_names = (*self._measure_names, "outcome", "spectral_radius")
        for contact_measure, paper_measures in PAPER_MEASURES_BY_CONTACT_MEASURE.items():
            if contact_measure in variable_names:
                paper_results[contact_measure] = sum(
                    map(paper_results.__getitem__, paper_measures), start=np.zeros(n_samples)
                )
        sample_results = {
            variable_name: paper_results[variable_name] for variable_name in variable_names
        }
        unilateral_samples = np.flatnonzero(model_codes == ModelCode.UNILATERAL)
        if unilateral_samples.size:
            unilateral_results = self._unilateral_engine(
                {
                    parameter_name: parameter_samples[unilateral_samples]
                    for parameter_name, parameter_samples in samples_by_parameter.items()
                }
            )
            for variable_name in variable_names:
                sample_results[variable_name][unilateral_samples] = unilateral_results[
                    variable_name
                ]
        return sample_results | {"rung": model_codes, "reason": selection_reasons}

    def compute_selection_reasons(
        self, paper_results: ValuesByVariable, sample_friction: np.ndarray
    ) -> np.ndarray:
        """Return `ModelChoice.reason_code` for each sample.

        - `paper_results`: margins and outcomes of the gaits computed with the paper's model, by
          name;
        - `sample_friction`: friction coefficient of the ground for each sample.
        """
        variable_names = (*SELECTION_MARGIN_NAMES, "outcome")
        selection_reasons, _ = map_in_numpy_batches(
            _find_selection_reason,
            (batch_sizes.GAIT_READ_BATCH_SIZE,),
            {variable_name: paper_results[variable_name] for variable_name in variable_names},
            sample_friction - self._paper_model.friction,
        )
        return selection_reasons.astype(np.int8)


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
    *wheel_parameter_columns, sample_friction = evaluation_request.stack_parameter_rows(
        samples_by_parameter
    ).T
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
    error_names = map(make_error_variable_name, measure_names)
    sample_results = dict(zip(measure_names, measure_result.values.T, strict=True))
    sample_results |= dict(zip(error_names, measure_result.errors.T, strict=True))
    model_codes = np.maximum(measure_result.models - ModelIndex.RIGID, 0).astype(np.int8)
    return mask_failed_samples(measure_result.outcomes, sample_results | {"rung": model_codes})


class WalkerScanEngine:
    """Scan engine for a walker of the user and a fixed set of measures."""

    def __init__(self, evaluation_request: EvaluationRequest, n_threads: int | None) -> None:
        self._request = evaluation_request
        self._n_threads = n_threads or lanes.count_available_cores()
        self._finder = make_walker_finder(
            evaluation_request.wheel_model.walker,
            evaluation_request.base_wheel,
            evaluation_request.step_options,
        )

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable."""
        rows = self._request.stack_parameter_rows(samples_by_parameter)
        domains = self._finder.model.parameter_domains.values()
        is_in_domain = np.all(
            [domain.contains_parameter_value(x) for domain, x in zip(domains, rows.T, strict=True)],
            axis=0,
        )
        blocks = np.split(rows, range(WALKER_BLOCK_SIZE, len(rows), WALKER_BLOCK_SIZE))
        results_by_block = [self._evaluate_block(blocks[0])]  # It compiles for all threads.
        with ThreadPoolExecutor(self._n_threads) as thread_pool:
            results_by_block += thread_pool.map(self._evaluate_block, blocks[1:])
        results = concatenate_results(results_by_block)
        outcomes = np.where(is_in_domain, results.pop("outcome"), Outcome.BAD_INPUT)
        return mask_failed_samples(outcomes, results)

    @with_default_jax_settings  # It runs in a thread of its own.
    def _evaluate_block(self, rows: np.ndarray) -> ValuesByVariable:
        padded_rows = np.pad(rows, ((0, WALKER_BLOCK_SIZE - len(rows)), (0, 0)), "edge")
        results = _evaluate_walkers(self._finder, self._request.measure_names, padded_rows)
        return {name: np.asarray(values)[: len(rows)] for name, values in results.items()}


WALKER_BLOCK_SIZE = 64
"""Number of samples that one call computes, fixed so that the results for a sample do not depend on
other samples. It is small, because a walker whose functions have no machine code is slow.
"""


@eqx.filter_jit
def _evaluate_walkers(
    finder: WalkerFinder, variable_names: tuple[str, ...], rows: Any
) -> dict[str, Array]:
    """Return outcomes, measures and derivatives for the gaits of some walkers, by name."""
    read, guesses = finder.measure_reader, jax.vmap(finder.make_initial_guess)(rows)
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


class PassageScanEngine:
    """Scan engine that combines the results of another engine with measures of walks over random
    slopes.

    Samples are computed one after another, each with the same random numbers.
    """

    def __init__(self, evaluation_request: EvaluationRequest, n_threads: int | None) -> None:
        measure_names, self._base_wheel, self._wheel_model, *_ = evaluation_request
        self._slope_standard_deviation = evaluation_request.slope_standard_deviation
        self._passage_measure_names = [name for name in measure_names if name in PASSAGE_MEASURES]
        gait_measure_names = tuple(name for name in measure_names if name not in PASSAGE_MEASURES)
        gait_request = evaluation_request._replace(
            measure_names=gait_measure_names, slope_standard_deviation=None
        )
        self._gait_engine = make_scan_engine(gait_request, n_threads)

    def __call__(self, samples_by_parameter: ParameterSamples) -> ValuesByVariable:
        """Return the value of each variable for all samples, by the name of the variable.

        - `samples_by_parameter`: value of each swept parameter for each sample.
        """
        sample_results = self._gait_engine(samples_by_parameter)
        gait_outcomes = sample_results["outcome"]
        passage_measures = {
            measure_name: np.full(len(gait_outcomes), np.nan, self._base_wheel.damping.dtype)
            for measure_name in self._passage_measure_names
        }
        for sample_index in (
            np.flatnonzero(gait_outcomes == Outcome.STEPPED) if passage_measures else ()
        ):
            wheel_model, params = self._wheel_model, self._base_wheel
            for parameter_name, parameter_samples in samples_by_parameter.items():
                wheel_model, params = wheel_model.with_parameter(
                    params, parameter_name, jnp.asarray(float(parameter_samples[sample_index]))
                )
            # Hardly any step of the walks succeeds if `first_passage` raises an error.
            with contextlib.suppress(ValueError):
                assert self._slope_standard_deviation is not None  # The measures need it.
                passage_result = first_passage(
                    params, self._slope_standard_deviation, model=wheel_model
                )
                measures_by_name = {
                    "mean_steps": passage_result.mean_steps,
                    "mean_steps_error": passage_result.error,
                    "failure_probability": passage_result.failure_probability,
                }
                for measure_name, measure_values in passage_measures.items():
                    measure_values[sample_index] = measures_by_name[measure_name]
        return sample_results | passage_measures


def make_scan_engine(
    evaluation_request: EvaluationRequest, n_threads: int | None = None
) -> SampleEvaluator:
    """Return the engine that computes the measures of an `EvaluationRequest`.

    - `n_threads`: number of CPU threads, by default one per core.
    """
    if evaluation_request.error_tolerance is not None:
        return functools.partial(evaluate_to_tolerance, evaluation_request)
    if evaluation_request.slope_standard_deviation is not None:
        return PassageScanEngine(evaluation_request, n_threads)
    model = evaluation_request.wheel_model
    if not model.is_wheel:
        return WalkerScanEngine(evaluation_request, n_threads)
    if model.fallback_model is not model:
        return ModelSelectionScanEngine(evaluation_request, n_threads)
    if model.batch_kernel == "legs":
        return UnilateralScanEngine(evaluation_request, n_threads)
    return CollocationScanEngine(evaluation_request, n_threads)

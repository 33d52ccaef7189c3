"""Measures to within a tolerance, from the simplest model whose error can be bounded.

The lower model's gait takes one step with unilateral contact. The defect, propagated to the measure
by the lower model's derivatives, is that model's error to second order. This is a dual-weighted
residual (R. Becker and R. Rannacher, Acta Numerica 10, 2001) with the next model in place of the
finer mesh. If the error is within the tolerance, the lower model's value is returned. Otherwise the
same step is the first one of an iteration to the gait with unilateral contact. If the iteration
does not contract, the gait is another one, and a walk leads to it.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from vrw_jax.cycles import GaitChoice, compute_walk_starts, parse_gait_choice
from vrw_jax.numerics import StepOptions, take_rows
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.tolerance.contact_steps import STEP_TOLERANCES, GroundBatch
from vrw_jax.tolerance.lower_fidelity import (
    LowerFidelityGait,
    ModelIndex,
    compute_static_contraction,
    empty_gaits,
    find_paper_gaits,
    find_rigid_gaits,
    replace_gaits,
)
from vrw_jax.tolerance.measure_result import MeasureResult, MeasureStatus
from vrw_jax.tolerance.refinement import (
    BroydenIteration,
    RefinementResult,
    refine,
)
from vrw_jax.tolerance.settling import walk_until_settled
from vrw_jax.tolerance.step_quantities import MEASURE_FUNCTIONS, evaluate_measures
from vrw_jax.validation import (
    check_bool,
    check_choice,
    check_known_name,
    check_names,
    check_not_traced,
    check_positive,
    check_type,
)
from vrw_jax.wheel import FRICTION_NAME, Outcome, WheelParams, convert_friction


@dataclass(frozen=True)
class RequestOptions:
    """Options of the search for a model and a gait that give measures to a tolerance.

    - `error_safety_factor`: factor from the error estimate of one step to its bound, chosen because
      the bound holds as long as corrections contract by 3/4;
    - `very_tight_below`: tolerance of a measure below which steps have the very tight tolerance;
    - `n_exact_steps`: number of steps after a loose walk, before corrections, chosen because looser
      steps may end in other contact modes;
    - `n_stability_steps`: number of steps of a walk that must stay near a gait if the gait is far
      from the end of the previous walk;
    - `n_cold_starts`: number of starts, slow ones first, for wheels without a lower gait. It is
      chosen because the first two starts lead 100 of 232 wheels to a gait, and the other starts
      none of the rest;
    - `max_distance_ratio`: largest distance of the gait with unilateral contact from the lower gait
      that it continues, in first corrections. It is chosen because a contraction by a half moves at
      most so far;
    - `n_steps_before_differences`: number of steps from a lower gait with its own derivatives,
      before finite differences replace them.
    """

    error_safety_factor: float = 4.0
    very_tight_below: float = 1e-7
    n_exact_steps: int = 3
    n_stability_steps: int = 60
    n_cold_starts: int = 2
    max_distance_ratio: float = 2.0
    n_steps_before_differences: int = 3


REQUEST_OPTIONS = RequestOptions()
"""Options of `vrw.measure_to_tolerance`."""


@with_default_jax_settings
def measure_to_tolerance(
    measures: str | Sequence[str],
    params: WheelParams,
    tol: float,
    *,
    friction: Any = 0.7,
    relative: bool = False,
    stoppers: str = "bilateral",
    which: GaitChoice | None = None,
) -> MeasureResult:
    """Return measures of the wheel's gait on ground of this friction, each to within `tol`.

    The reference is `UnilateralWheel(friction, stoppers=stoppers)`. Its gait is the one that
    continues the paper's gait, or else the one that a walk from the paper's gait reaches;
    `MeasureResult.why` names which. Fields of `params` and `friction` may have one batch
    axis; each element is computed independently.

    This function cannot be used inside `jax.jit`, because it depends on values.

    Args:
        measures: one name or several of speed, period, dls_fraction, step_length, duration_dls,
            duration_single, duration_flight, theta_touchdown, dtheta_touchdown, dL1_touchdown.
        params: the wheel, or a batch of wheels.
        tol: allowed error, in the measure's unit or relative to the value.
        friction: friction coefficient of the ground.
        relative: whether `tol` is relative to the value itself.
        stoppers: stoppers of the reference wheel, "bilateral" or "one-sided".
        which: "slowest", "fastest" or an index, slowest first, among the gaits with unilateral
            contact that walks from a stated set of starts reach. It replaces the gait above.

    Returns:
        A `MeasureResult`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> wheel = vrw.WheelParams(damping=150.0)
        >>> result = vrw.measure_to_tolerance("speed", wheel, 1e-3, friction=50.0)
        >>> print(f"{result.value:.2f} m/s", result.error <= 1e-3)
        1.02 m/s True
    """
    start_seconds = time.perf_counter()
    check_not_traced(
        "vrw.measure_to_tolerance", "it on numbers, and give a batch as arrays", params, friction
    )
    names = check_names("measures", measures)
    for name in names:
        check_known_name(name, tuple(MEASURE_FUNCTIONS), "measure that every model has")
    if not names:
        raise ValueError("measures is empty, but at least one is needed: give 'speed', say.")
    tol, relative = check_positive("tol", tol), check_bool("relative", relative)
    check_choice("stoppers", stoppers, ("bilateral", "one-sided"))
    params, friction_by_wheel, shape = check_batch(params, convert_friction(friction))
    rank = None if which is None else parse_gait_choice(which)
    uses_very_tight_steps = tol >= REQUEST_OPTIONS.very_tight_below
    tolerance = (
        STEP_TOLERANCES.tight_tolerance
        if uses_very_tight_steps
        else STEP_TOLERANCES.very_tight_tolerance
    )
    options = StepOptions(rtol=tolerance, atol=tolerance)
    request = _MeasureRequest(
        names,
        tol,
        relative,
        GroundBatch.from_params(params, friction_by_wheel, stoppers, options),
        params,
    )
    if rank is None:
        request.try_rigid_model()
        request.try_paper_model()
        request.walk_to_gaits()
    else:
        request.select_by_rank(rank)
    results = jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), request.results)
    del results["speeds"]
    return MeasureResult(
        **results,
        names=names,
        is_single=isinstance(measures, str),
        seconds=time.perf_counter() - start_seconds,
    )


def check_batch(
    params: WheelParams, friction: Any
) -> tuple[WheelParams, np.ndarray, tuple[int, ...]]:
    """Return wheels and friction broadcast to one batch axis, and their original batch shape."""
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    shapes = {np.shape(argument_array) for argument_array in (*jax.tree.leaves(params), friction)}
    shape = max(shapes, key=len)
    if len(shape) > 1 or shapes - {(), shape}:
        shapes_text = ", ".join(map(str, sorted(shapes - {()})))
        raise ValueError(
            f"parameters and {FRICTION_NAME} have shapes {shapes_text}, but a batch has one "
            "axis, the same for all: give one value for all, or one for each element."
        )
    n_elements = shape[0] if shape else 1
    broadcast_parameters = lambda argument_array: np.broadcast_to(
        np.asarray(argument_array, float), (n_elements,)
    )
    return (
        jax.tree.map(broadcast_parameters, params),
        broadcast_parameters(friction),
        shape,
    )


class _MeasureRequest:
    """Request for measures of a batch of wheels, with the results so far."""

    def __init__(
        self,
        names: tuple[str, ...],
        tol: float,
        relative: bool,
        ground: GroundBatch,
        params: WheelParams,
        options: RequestOptions = REQUEST_OPTIONS,
    ) -> None:
        n_elements, n_measures = len(ground.parameter_columns.T), len(names)
        self.names, self.tol, self.relative, self.options = names, tol, relative, options
        self.ground, self.params, self.lower_gaits = ground, params, empty_gaits(n_elements)
        make_full_array = lambda fill_value: np.full((n_elements, n_measures), fill_value)
        self.results = {
            "values": make_full_array(np.nan),
            "errors": make_full_array(np.inf),
            "model_errors": make_full_array(np.nan),
            "numerical_errors": make_full_array(np.inf),
            "models": np.full(n_elements, ModelIndex.NONE),
            "statuses": np.full(n_elements, int(MeasureStatus.NO_GAIT)),
            "n_steps": np.zeros(n_elements, int),
            "outcomes": np.full(n_elements, int(Outcome.NO_CYCLE_FOUND)),
            "n_gaits": np.zeros(n_elements, int),
            "speeds": np.full(n_elements, np.nan),
            "states": ground.embed_states(np.arange(n_elements), np.zeros((n_elements, 3))),
        }

    def compute_error_goal(self, values: np.ndarray) -> np.ndarray:
        """Return the absolute tolerance of measures with about these values."""
        return self.tol * (np.abs(values) if self.relative else np.ones_like(values))

    @property
    def find_indices_without_result(self) -> np.ndarray:
        """Return the indices of the elements without a result."""
        return np.flatnonzero(self.results["models"] == ModelIndex.NONE)

    def try_rigid_model(self) -> None:
        """Try the rigid gait for wheels whose legs are stiff enough, and record accepted
        results.
        """
        with np.errstate(all="ignore"):
            indices = np.flatnonzero(
                self.options.error_safety_factor * compute_static_contraction(self.params)
                <= self.tol
            )
        if not len(indices):
            return
        replace_gaits(self.lower_gaits, indices, find_rigid_gaits(self._take_wheels(indices)))
        indices = indices[np.isfinite(self.lower_gaits.quantities[indices]).all(1)]
        self._correct_from_gaits(indices, continues_iteration=False)

    def try_paper_model(self) -> None:
        """Try the paper's gaits, or else the gaits with unilateral contact near them, and record
        accepted results.
        """
        indices = self.find_indices_without_result
        if not len(indices):
            return
        replace_gaits(
            self.lower_gaits,
            indices,
            find_paper_gaits(self._take_wheels(indices), self.ground.options),
        )
        self._correct_from_gaits(
            indices[self.lower_gaits.model_index[indices] != ModelIndex.NONE],
            continues_iteration=True,
        )

    def walk_to_gaits(self) -> None:
        """Walk to the gaits with unilateral contact of wheels without a result, and record them."""
        indices = self.find_indices_without_result
        if not len(indices):
            return
        has_lower_gait = self.lower_gaits.model_index[indices] != ModelIndex.NONE
        start_states = self.ground.embed_states(
            indices[has_lower_gait], self.lower_gaits.section_state[indices[has_lower_gait]]
        )
        self._walk_and_correct(
            indices[has_lower_gait], start_states, MeasureStatus.REACHED_FROM_LOWER_GAIT
        )
        indices = indices[~has_lower_gait]
        if not len(indices):
            return
        for start in compute_walk_starts(self._take_wheels(indices))[: self.options.n_cold_starts]:
            has_no_result = self.results["models"][indices] == ModelIndex.NONE
            start_states = self.ground.embed_states(indices[has_no_result], start[has_no_result])
            self._walk_and_correct(
                indices[has_no_result], start_states, MeasureStatus.REACHED_FROM_START
            )

    def select_by_rank(self, rank: int) -> None:
        """Record the gait of this rank, slowest first, among the ends of walks from all starts."""
        indices, empty_results, results_of_starts = (
            self.find_indices_without_result,
            self.results,
            [],
        )
        for start in compute_walk_starts(self.params):
            self.results = {
                name: starts_array.copy() for name, starts_array in empty_results.items()
            }
            self._walk_and_correct(
                indices, self.ground.embed_states(indices, start), MeasureStatus.SELECTED_BY_RANK
            )
            results_of_starts.append(self.results)
        self.results = empty_results
        empty_results["n_steps"][:] = np.sum(
            [results["n_steps"] for results in results_of_starts], axis=0
        )
        for index in indices:
            distinct_gaits = _find_distinct_gaits(
                [
                    {name: starts_array[index] for name, starts_array in results.items()}
                    for results in results_of_starts
                ]
            )
            empty_results["n_gaits"][index] = len(distinct_gaits)
            if -len(distinct_gaits) <= rank < len(distinct_gaits):
                for name in empty_results.keys() - {"n_steps", "n_gaits"}:
                    empty_results[name][index] = distinct_gaits[rank][name]

    def _take_wheels(self, indices: np.ndarray) -> WheelParams:
        """Return the wheels at these indices."""
        return jax.device_put(take_rows(self.params, indices))

    def _correct_from_gaits(self, indices: np.ndarray, continues_iteration: bool) -> None:
        """Take one step with unilateral contact from the lower gaits, and correct further if
        `continues_iteration`.
        """
        if not len(indices):
            return
        lower_gaits = LowerFidelityGait(*(gait_array[indices] for gait_array in self.lower_gaits))
        section_states = self.ground.embed_states(
            indices, lower_gaits.section_state, lower_gaits.model_index == ModelIndex.RIGID
        )
        iteration = BroydenIteration.from_states(self.ground, indices, section_states, lower_gaits)
        all_positions = np.arange(len(indices))
        first_step = iteration.step_elements(all_positions)
        estimate = iteration.update_and_estimate(all_positions, first_step, self.names)
        values = evaluate_measures(self.names, lower_gaits.quantities)
        with np.errstate(all="ignore"):
            correction_effect = (
                np.abs(evaluate_measures(self.names, first_step.quantities) - values)
                + estimate.correction_effect
            )
            error = values - estimate.values
            plane_indices = self.ground.plane_indices()
            sensitivity = np.abs(
                estimate.quantity_jacobian @ iteration.quantity_jacobian[:, :, plane_indices]
            )
            lower_defect_effect = np.einsum("ijk,ik->ij", sensitivity, np.abs(lower_gaits.defect))
            numerical_error = (
                lower_defect_effect + estimate.numerical_error + estimate.missed_contact_error
            )
            error_bound = (
                np.abs(error)
                + (self.options.error_safety_factor - 1.0) * correction_effect
                + numerical_error
            )
            is_accepted = estimate.same_codes & np.all(
                error_bound <= self.compute_error_goal(values), axis=1
            )
        self.results["n_steps"][indices] += 1
        self._record(
            indices[is_accepted],
            lower_gaits.model_index[is_accepted],
            MeasureStatus.CHECKED_BY_ONE_STEP,
            {
                "values": values[is_accepted],
                "errors": error_bound[is_accepted],
                "model_errors": error[is_accepted],
                "numerical_errors": numerical_error[is_accepted],
                "states": section_states[is_accepted],
            },
        )
        rejected_positions = np.flatnonzero(~is_accepted & estimate.same_codes)
        if not continues_iteration or not len(rejected_positions):
            return
        max_distance = self.options.max_distance_ratio * np.linalg.norm(
            iteration.correction[rejected_positions][:, plane_indices], axis=1
        )
        first_step_and_estimate = jax.tree.map(
            lambda gait_array: gait_array[rejected_positions], (first_step, estimate)
        )
        refinement = refine(
            iteration.select(rejected_positions),
            self.names,
            self.compute_error_goal,
            self.options.n_steps_before_differences,
            first_step_and_estimate,
        )
        is_near = (
            np.linalg.norm(
                (refinement.section_states - section_states[rejected_positions])[:, plane_indices],
                axis=1,
            )
            <= max_distance
        )
        self._record_gaits(
            indices[rejected_positions],
            refinement._replace(is_done=refinement.is_done & is_near),
            MeasureStatus.CONTINUES_LOWER_GAIT,
        )

    def _walk_and_correct(
        self, indices: np.ndarray, section_states: np.ndarray, status: MeasureStatus
    ) -> None:
        """Walk from the states, correct the ends of the walks, and record the gaits."""
        walk_end = walk_until_settled(self.ground, indices, section_states)
        self.results["n_steps"][indices] += walk_end.n_steps
        # A step cannot begin if a wheel has turned more than once in flight.
        is_walk_outcome = np.isin(walk_end.outcome, (Outcome.STEPPED, Outcome.BAD_INPUT))
        self.results["outcomes"][indices] = np.where(
            is_walk_outcome, Outcome.NO_CYCLE_FOUND, walk_end.outcome
        )
        section_states = walk_end.section_states[walk_end.is_settled]
        indices = indices[walk_end.is_settled]
        if not len(indices):
            return
        n_exact_steps = self.options.n_exact_steps
        step = self.ground.take_steps(indices, section_states, n_exact_steps)
        self.results["n_steps"][indices] += n_exact_steps
        is_continued = step.outcome == Outcome.STEPPED
        indices, section_states = indices[is_continued], step.section_states[is_continued]
        iteration = BroydenIteration.from_states(self.ground, indices, section_states, None)
        refinement = refine(iteration, self.names, self.compute_error_goal, 0)
        refinement.is_done[refinement.is_done] = iteration.select(
            refinement.is_done
        ).is_attracting()
        max_distance = iteration.options.max_gait_distance
        far_positions = np.flatnonzero(
            refinement.is_done & (iteration.max_distance_to(section_states) > max_distance)
        )
        n_stability_steps = self.options.n_stability_steps
        refinement.is_done[far_positions] = iteration.select(far_positions).walk_stays_near(
            n_stability_steps
        )
        refinement.n_steps[far_positions] += n_stability_steps
        self._record_gaits(indices, refinement, status)

    def _record_gaits(
        self, indices: np.ndarray, refinement: RefinementResult, status: MeasureStatus
    ) -> None:
        """Record the results of gaits with unilateral contact."""
        self.results["n_steps"][indices] += refinement.n_steps
        indices = indices[refinement.is_done]
        refinement = RefinementResult(
            *(result_array[refinement.is_done] for result_array in refinement)
        )
        has_lower_gait = (self.lower_gaits.model_index[indices] != ModelIndex.NONE)[:, None]
        values = evaluate_measures(
            self.names, np.where(has_lower_gait, self.lower_gaits.quantities[indices], np.nan)
        )
        self._record(
            indices,
            np.full(len(indices), ModelIndex.UNILATERAL),
            status,
            {
                "values": refinement.values,
                "errors": refinement.remaining_error + refinement.numerical_error,
                "model_errors": values - refinement.values,
                "numerical_errors": refinement.remaining_error + refinement.numerical_error,
                "speeds": refinement.speed,
                "states": refinement.section_states,
            },
        )

    def _record(
        self,
        indices: np.ndarray,
        model_index: np.ndarray,
        status: MeasureStatus,
        new_results: dict[str, np.ndarray],
    ) -> None:
        """Record results of some elements, with the model and the method."""
        for name, values in new_results.items():
            self.results[name][indices] = values
        self.results["models"][indices], self.results["statuses"][indices] = model_index, status
        self.results["outcomes"][indices] = Outcome.STEPPED


def _find_distinct_gaits(
    results_of_starts: list[dict[str, np.ndarray]],
) -> list[dict[str, np.ndarray]]:
    """Return the gaits of one wheel that differ by more than their errors, slowest first."""
    distinct_gaits: list[dict[str, np.ndarray]] = []
    for candidate in results_of_starts:
        is_distinct = (
            np.any(
                np.abs(candidate["values"] - other_gait["values"])
                > candidate["errors"] + other_gait["errors"]
            )
            for other_gait in distinct_gaits
        )
        if candidate["models"] != ModelIndex.NONE and all(is_distinct):
            distinct_gaits.append(candidate)
    return sorted(distinct_gaits, key=lambda candidate: candidate["speeds"])

"""Measures to within a tolerance, from the simplest model whose error can be bounded.

The lower model's gait takes one step with unilateral contact. The defect, propagated to the measure
by the lower model's derivatives, is that model's error to second order. This is a dual-weighted
residual (R. Becker and R. Rannacher, Acta Numerica 10, 2001) with the next model in place of the
finer mesh. If the error is within the tolerance, the lower model's value is returned. Otherwise
Newton's method leads from the end of that step to the gait with unilateral contact. If that gait is
far from the lower model's, a walk leads to another one.
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
from vrw_jax.tolerance.refinement import RefinedGaits, estimate_measures, refine_gaits
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
    - `n_cold_starts`: number of starts, slow ones first, for wheels without a lower gait. It is
      chosen because the first two starts lead 100 of 232 wheels to a gait, and the other starts
      none of the rest;
    - `max_distance_ratio`: largest distance of the gait with unilateral contact from the lower gait
      that it continues, in first corrections. It is chosen because a contraction by a half moves at
      most so far.
    """

    error_safety_factor: float = 4.0
    very_tight_below: float = 1e-7
    n_cold_starts: int = 2
    max_distance_ratio: float = 2.0


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
    tolerance = (
        STEP_TOLERANCES.tight_tolerance
        if tol >= REQUEST_OPTIONS.very_tight_below
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


RESULT_NAMES = ("values", "errors", "model_errors", "numerical_errors", "states")
"""Names of the results that a gait determines."""


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
        has_lower_gait = self.lower_gaits.model_index[indices] != ModelIndex.NONE
        lower_states = self.lower_gaits.section_state[indices[has_lower_gait]]
        self._walk_and_record(
            indices[has_lower_gait], lower_states, MeasureStatus.REACHED_FROM_LOWER_GAIT
        )
        indices = indices[~has_lower_gait]
        for start in compute_walk_starts(self._take_wheels(indices))[: self.options.n_cold_starts]:
            has_no_result = self.results["models"][indices] == ModelIndex.NONE
            self._walk_and_record(
                indices[has_no_result], start[has_no_result], MeasureStatus.REACHED_FROM_START
            )

    def select_by_rank(self, rank: int) -> None:
        """Record the gait of this rank, slowest first, among the ends of walks from all starts."""
        indices, starts = self.find_indices_without_result, compute_walk_starts(self.params)
        gait_indices, gaits = self._walk_and_refine(
            np.tile(indices, len(starts)), np.concatenate(starts)
        )
        selected_positions: list[int] = []
        for index in indices:
            distinct_gaits = _find_distinct_gaits(gaits, np.flatnonzero(gait_indices == index))
            self.results["n_gaits"][index] = len(distinct_gaits)
            if -len(distinct_gaits) <= rank < len(distinct_gaits):
                selected_positions.append(distinct_gaits[rank])
        self._record_gaits(
            gait_indices, gaits, np.array(selected_positions, int), MeasureStatus.SELECTED_BY_RANK
        )

    def _take_wheels(self, indices: np.ndarray) -> WheelParams:
        """Return the wheels at these indices."""
        return jax.device_put(take_rows(self.params, indices))

    def _correct_from_gaits(self, indices: np.ndarray, continues_iteration: bool) -> None:
        """Take one step with unilateral contact from the lower gaits, and correct further if
        `continues_iteration`.
        """
        lower_gaits = LowerFidelityGait(*(gait_array[indices] for gait_array in self.lower_gaits))
        section_states = self.ground.embed_states(
            indices, lower_gaits.section_state, lower_gaits.model_index == ModelIndex.RIGID
        )
        first_step = self.ground.take_steps(indices, section_states)
        estimate = estimate_measures(
            self.ground,
            indices,
            section_states,
            first_step,
            lower_gaits.newton_matrix,
            lower_gaits.quantity_jacobian,
            self.names,
            self.ground.plane_indices(),
        )
        values = evaluate_measures(self.names, lower_gaits.quantities)
        with np.errstate(all="ignore"):
            correction_effect = (
                np.abs(evaluate_measures(self.names, first_step.quantities) - values)
                + estimate.correction_effect
            )
            error = values - estimate.values
            sensitivity = np.abs(estimate.measure_jacobian @ lower_gaits.quantity_jacobian)
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
            values[is_accepted],
            error_bound[is_accepted],
            error[is_accepted],
            numerical_error[is_accepted],
            section_states[is_accepted],
        )
        rejected_positions = np.flatnonzero(
            continues_iteration & ~is_accepted & estimate.same_codes
        )
        gaits = refine_gaits(
            self.ground,
            indices[rejected_positions],
            first_step.section_states[rejected_positions],
            self.names,
            self.compute_error_goal,
            always_compares=False,
        )
        self.results["n_steps"][indices[rejected_positions]] += gaits.n_steps
        distance = np.linalg.norm(
            (gaits.section_states - section_states[rejected_positions])[
                :, self.ground.plane_indices()
            ],
            axis=1,
        )
        max_distance = self.options.max_distance_ratio * np.linalg.norm(
            estimate.correction[rejected_positions], axis=1
        )
        self._record_gaits(
            indices[rejected_positions],
            gaits,
            gaits.is_found & (distance <= max_distance),
            MeasureStatus.CONTINUES_LOWER_GAIT,
        )

    def _walk_and_record(
        self, indices: np.ndarray, section_states: np.ndarray, status: MeasureStatus
    ) -> None:
        """Walk from the paper's section states, and record the gaits that the walks reach."""
        gait_indices, gaits = self._walk_and_refine(indices, section_states)
        self._record_gaits(gait_indices, gaits, gaits.is_found & gaits.is_attracting, status)

    def _walk_and_refine(
        self, indices: np.ndarray, section_states: np.ndarray
    ) -> tuple[np.ndarray, RefinedGaits]:
        """Walk from the paper's section states, and refine the gaits at the ends of the walks.

        Return the index of the element of each gait, and the gaits.
        """
        walk_end = walk_until_settled(
            self.ground, indices, self.ground.embed_states(indices, section_states)
        )
        np.add.at(self.results["n_steps"], indices, walk_end.n_steps)
        # A step cannot begin if a wheel has turned more than once in flight.
        self.results["outcomes"][indices] = np.where(
            np.isin(walk_end.outcome, (Outcome.STEPPED, Outcome.BAD_INPUT)),
            Outcome.NO_CYCLE_FOUND,
            walk_end.outcome,
        )
        gait_indices = indices[walk_end.is_settled]
        gaits = refine_gaits(
            self.ground,
            gait_indices,
            walk_end.section_states[walk_end.is_settled],
            self.names,
            self.compute_error_goal,
            always_compares=True,
        )
        np.add.at(self.results["n_steps"], gait_indices, gaits.n_steps)
        return gait_indices, gaits

    def _record_gaits(
        self,
        gait_indices: np.ndarray,
        gaits: RefinedGaits,
        selected_positions: np.ndarray,
        status: MeasureStatus,
    ) -> None:
        """Record the selected gaits with unilateral contact. `gait_indices` are the indices of
        their elements.
        """
        indices = gait_indices[selected_positions]
        gaits = RefinedGaits(*(gait_array[selected_positions] for gait_array in gaits))
        self._record(
            indices,
            np.full(len(indices), ModelIndex.UNILATERAL),
            status,
            gaits.values,
            gaits.errors,
            evaluate_measures(self.names, self.lower_gaits.quantities[indices]) - gaits.values,
            gaits.errors,
            gaits.section_states,
        )

    def _record(
        self,
        indices: np.ndarray,
        model_index: np.ndarray,
        status: MeasureStatus,
        *results: np.ndarray,
    ) -> None:
        """Record results of some elements, in the order of RESULT_NAMES, with the model and the
        method.
        """
        for name, values in zip(RESULT_NAMES, results, strict=True):
            self.results[name][indices] = values
        self.results["models"][indices], self.results["statuses"][indices] = model_index, status
        self.results["outcomes"][indices] = Outcome.STEPPED


def _find_distinct_gaits(gaits: RefinedGaits, candidate_positions: np.ndarray) -> list[int]:
    """Return the positions of attracting gaits that differ by more than their errors, slowest
    first.
    """
    distinct_positions: list[int] = []
    is_candidate = (gaits.is_found & gaits.is_attracting)[candidate_positions]
    for candidate in candidate_positions[is_candidate].tolist():
        differences = np.abs(gaits.values[candidate] - gaits.values[distinct_positions])
        errors = gaits.errors[candidate] + gaits.errors[distinct_positions]
        if np.all(np.any(differences > errors, axis=1)):
            distinct_positions.append(candidate)
    return sorted(distinct_positions, key=lambda position: gaits.speed[position])

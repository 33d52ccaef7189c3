"""Limit cycles: options of their search, margins that searches keep, and what every cycle has."""

import abc
import dataclasses
import functools
import operator
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.base import small_matrices
from vrw_jax.base.checks import check_choice, check_int, check_positive, check_type, format_value
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    Measure,
    Outcome,
    format_each_batch_element,
    format_numbers,
    format_outcome_counts,
    name_measures,
)
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.models.measures import FORCE_PEAK_MEASURES, MEASURES
from vrw_jax.wheel.params import WheelParams


@dataclasses.dataclass(frozen=True)
class CycleOptions:
    """Numerical options of `limit_cycle`.

    JAX compiles the search again whenever an option changes. With the defaults, relative errors are
    1e-9 in values and 1e-8 in first derivatives.

    - `mesh_intervals`: number of mesh intervals in each of DLS, SLS-I and SLS-II; the method has
      order 8;
    - `mesh_grading`: ratio of the last to the first mesh interval in SLS-I;
    - `tolerance`: largest norm of Newton's last correction, in units of the wheel;
    - `max_newton_iterations`: largest number of Newton iterations in one attempt;
    - `first_newton_iterations`: number of Newton iterations after which the wheels of a batch that
      need more iterations are gathered;
    - `homotopy_steps`: number of parameter steps in a homotopy from the wheel in Table 1 of the
      paper, which is used if the first attempt fails;
    - `batch_size`: number of wheels that are solved together.

    Examples:
        >>> vrw.CycleOptions(mesh_intervals=(20, 16, 6)).mesh_intervals  # a finer mesh
        (20, 16, 6)
    """

    mesh_intervals: tuple[int, int, int] = (10, 8, 3)
    mesh_grading: float = 2.0
    tolerance: float = 1e-10
    max_newton_iterations: int = 12
    first_newton_iterations: int = 4
    homotopy_steps: int = 12
    batch_size: int = 64

    def __post_init__(self) -> None:
        set_option = functools.partial(object.__setattr__, self)
        for option_name in (
            "max_newton_iterations",
            "first_newton_iterations",
            "homotopy_steps",
            "batch_size",
        ):
            set_option(option_name, check_int(option_name, getattr(self, option_name)))
        for option_name in ("mesh_grading", "tolerance"):
            set_option(option_name, check_positive(option_name, getattr(self, option_name)))
        if not isinstance(self.mesh_intervals, tuple | list) or len(self.mesh_intervals) != 3:
            raise ValueError(
                f"mesh_intervals is {format_value(self.mesh_intervals)}, but it counts the "
                f"intervals in "
                "DLS, SLS-I and SLS-II: "
                "give three whole numbers of at least 1, as (10, 8, 3)."
            )
        mesh_intervals = tuple(
            check_int(f"mesh_intervals[{i}]", interval_count)
            for i, interval_count in enumerate(self.mesh_intervals)
        )
        set_option("mesh_intervals", mesh_intervals)

    def check_tolerances(self, parameter_dtype: np.dtype) -> None:
        """Raise ValueError if the number format cannot resolve the tolerance.

        If `jax_enable_x64` is off, 64-bit parameters of a wheel are treated as 32-bit numbers, as
        in JAX.
        """
        jax_dtype = jax.dtypes.canonicalize_dtype(parameter_dtype)
        if self.tolerance < jnp.finfo(jax_dtype).eps:
            dtype_statement = (
                "the wheel holds"
                if jax_dtype == parameter_dtype
                else "jax_enable_x64 is off: JAX takes"
            )
            raise ValueError(
                f"{dtype_statement} {jax_dtype.name} numbers, in which no limit cycle is "
                f"found to {self.tolerance:g}: call vrw.start_jax() before WheelParams are made."
            )

    def refine_mesh(self) -> "CycleOptions":
        """Return options with about twice as many mesh intervals."""
        n_dls_intervals, n_sls1_intervals, n_sls2_intervals = self.mesh_intervals
        return dataclasses.replace(
            self,
            mesh_intervals=(
                2 * n_dls_intervals,
                2 * n_sls1_intervals,
                max(2 * n_sls2_intervals, n_sls1_intervals),
            ),
        )

    @classmethod
    def tight(cls) -> "CycleOptions":
        """Return options whose errors are about 1e-12 in values and 1e-10 in first derivatives."""
        return cls(mesh_intervals=(16, 20, 4), tolerance=1e-13)


DEFAULT_MARGIN_NAMES: tuple[str, ...] = (
    "fore_foot_force",
    "takeoff_acceleration",
    "clearance_sls1",
    "clearance_sls2",
    "locked_stopper_force",
    "rear_stopper_force",
    "contraction",
    "friction_fore",
    "lambda_I4",
    "lambda_2_plus",
    "lambda_4_plus",
)
"""Names of the margins (forces, clearances and indicators) that a search can keep positive."""

DEFAULT_MARGIN_SHARE = 1e-3
"""Default lower limit of a margin, as a fraction of the wheel's weight, leg length or gravity."""


@with_default_jax_settings
def default_margins(params: WheelParams) -> Mapping[str, float]:
    """Return the default lower limit for each margin in `DEFAULT_MARGIN_NAMES`.

    Each limit is a thousandth of the margin's natural scale for this wheel. The limits are above
    zero, because a search needs a distance from the boundary. At lambda_4_plus = 0, for example,
    the branch of gaits ends.

    Args:
        params: one wheel.

    Returns:
        Lower limits by the name of the margin, each in the unit of the margin.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> round(vrw.default_margins(vrw.WheelParams())["lambda_4_plus"], 3)
        0.177
    """
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    params.require_single_wheel("take one after the other")
    total_mass = float(params.hub_mass + params.n_legs * params.leg_mass)
    leg_length = float(params.locked_length)
    gravity_acceleration = float(params.gravity)
    margin_unit_values = {
        "N": total_mass * gravity_acceleration,
        "m": leg_length,
        "m/s^2": gravity_acceleration,
        "N s": total_mass * (gravity_acceleration * leg_length) ** 0.5,
        "1": 1.0,
    }
    return {
        margin_name: DEFAULT_MARGIN_SHARE * margin_unit_values[MEASURES[margin_name].unit]
        for margin_name in DEFAULT_MARGIN_NAMES
    }


SAME_STATE_RELATIVE_TOLERANCE = 1e-7
"""Relative distance below which two section states of a cycle are treated as equal.

The value is chosen as ten times the allowed difference between two computations of a gait
(`finder.STATE_AGREEMENT_TOLERANCE`).
"""


class AbstractCycle(AbstractPrintable):
    """Gait that repeats after `period_n` gait steps.

    If no gait is found, `outcome` is the reason, and all other fields and their derivatives are
    zero. For `period_n` 1, arrays have no axis over the gait steps. Under `jax.vmap`, the batch
    axis of every field comes first.
    """

    # section state before touchdown, a fixed point of `period_n` return maps
    section_state: eqx.AbstractVar[Array]
    post_impact: eqx.AbstractVar[Float[Array, "2"]]  # (theta, dtheta) after the first landing
    # durations of the phases, s, double support first
    durations: eqx.AbstractVar[Float[Array, "*n 3"]]
    step_length: eqx.AbstractVar[Float[Array, "*n"]]  # distance between the feet at each landing, m
    monodromy_value: eqx.AbstractVar[Array]  # the monodromy matrix without derivatives
    outcome: eqx.AbstractVar[Int[Array, ""]]  # Outcome.STEPPED or a failure

    @property
    def period_n(self) -> int:
        """Return the number of gait steps after which the gait repeats."""
        has_step_axis = self.durations.ndim > self.outcome.ndim + 1
        return self.durations.shape[-2] if has_step_axis else 1

    @property
    def monodromy(self) -> Array:
        """Return the monodromy matrix, which is the differentiable Jacobian of the return map."""
        return self.monodromy_value

    @property
    def warm_start(self) -> Any:
        """Return a start from which the gait of a similar wheel can be searched.

        The start is a section state, or a richer state that the search of the gait returned.
        """
        return self.section_state

    @property
    @abc.abstractmethod
    def step_ends(self) -> Array:
        """Return the section state at the end of each gait step.

        The last two axes are gait steps and section coordinates.
        """

    @property
    def minimal_period(self) -> Int[Array, "..."]:
        """Return the smallest number of gait steps after which the gait repeats.

        The result is 0 if there is no gait. It divides `period_n`: a gait that repeats after one
        step also repeats after two steps.
        """
        step_ends = self.step_ends
        period_n = self.period_n
        largest_state_coordinate = jnp.max(jnp.abs(step_ends), (-2, -1))
        relative_tolerance = jnp.maximum(
            SAME_STATE_RELATIVE_TOLERANCE, 100.0 * jnp.finfo(step_ends.dtype).eps
        )
        minimal_period = jnp.full(self.outcome.shape, period_n, jnp.int32)
        for candidate_period in range(period_n - 1, 0, -1):
            if period_n % candidate_period:
                continue
            state_distance = jnp.max(
                jnp.abs(jnp.roll(step_ends, candidate_period, -2) - step_ends), (-2, -1)
            )
            minimal_period = jnp.where(
                state_distance <= relative_tolerance * largest_state_coordinate,
                candidate_period,
                minimal_period,
            )
        return jnp.where(self.found, minimal_period, 0)

    def replace_missing_gaits_by_nan(self, params: WheelParams) -> Any:
        """Return the cycle with NaN instead of zeros if no gait was found.

        In that case, derivatives with respect to `params` are also NaN.
        """
        names = [name for name in FIELDS_ZERO_WITHOUT_GAIT if name in vars(self)]
        values = replace_by_nan(~self.found, params, [getattr(self, name) for name in names])
        return dataclasses.replace(self, **dict(zip(names, values, strict=True)))

    def _zero_without_gait(self, value_of_gait: Array) -> Array:
        """Return `value_of_gait`, or zero if no gait was found.

        After `replace_missing_gaits_by_nan` the result and its derivatives are NaN instead of zero.
        """
        # The derivative of this value 0 is also 0, unlike that of multipliers, which may be NaN.
        return jnp.where(self.found, value_of_gait, 0.0 * self.section_state[..., 0])

    def reduce_over_steps(
        self, values_by_step: Array, reduce_values: Callable[[Array, int], Array]
    ) -> Array:
        """Reduce the values of the gait steps, on the last axis, to one value per cycle.

        `reduce_values` is a reduction of an array over an axis, such as `jnp.sum`.
        """
        return reduce_values(values_by_step, -1) if self.period_n > 1 else values_by_step

    @property
    def found(self) -> Bool[Array, "..."]:
        """Return whether a gait was found."""
        return self.outcome == Outcome.STEPPED

    @property
    @abc.abstractmethod
    def searched_wheel(self) -> tuple[Any, WheelParams]:
        """Return the model and the wheel whose gait was searched."""

    @property
    def ending(self) -> Any:
        """Return a sentence that describes how the search ended.

        For a batch the result is an array of such sentences.
        """
        return self._describe_each_outcome(lambda outcome_code, _: Outcome(outcome_code).meaning)

    def _describe_each_outcome(
        self, describe_outcome: Callable[[int, float], str], failed_checks: Any = 0.0
    ) -> Any:
        """Return the sentence of each outcome, or why no gait can exist."""
        outcomes = np.asarray(self.outcome)
        searched_wheels = jax.tree.map(np.asarray, self.searched_wheel)

        def describe_element(flat_index: int, failed_check: float) -> str:
            element_index = np.unravel_index(flat_index, outcomes.shape)
            outcome_code = int(outcomes[element_index])
            model, params = jax.tree.map(
                lambda x: x[element_index] if x.ndim else x, searched_wheels
            )
            reason = ""
            if outcome_code == Outcome.BAD_INPUT:
                reason = model.attach_laws(params).describe_error()
            elif outcome_code in RETRY_OUTCOMES:
                reason = model.explain_impossible_gait(params)
            return reason or describe_outcome(outcome_code, failed_check)

        flat_indices = np.arange(outcomes.size).reshape(outcomes.shape)
        return format_each_batch_element(describe_element, flat_indices, failed_checks)

    @property
    @announce_wait("the search for the last gait on the way from Table 1", "30 s")
    def why(self) -> Any:
        """Return the sentence of `ending`, which contains the reason if no gait was found.

        For one wheel without a gait, the text also names the last wheel with a gait on the straight
        line from the wheel in Table 1 of the paper to this wheel.
        """
        if self.outcome.ndim or int(self.outcome) not in RETRY_OUTCOMES:
            return self.ending
        return " ".join(
            filter(None, (self.ending, *(describe(self) for describe in LAST_GAIT_DESCRIBERS)))
        )

    @property
    def period(self) -> Array:
        """Return the duration of the whole cycle, s."""
        return jnp.sum(self.durations, axis=(-2, -1) if self.period_n > 1 else -1)

    @property
    def dls_fraction(self) -> Array:
        """Return the duration of double support divided by the period."""
        return self._divide_by_period(self.reduce_over_steps(self.durations[..., 0], jnp.sum))

    @property
    def speed(self) -> Array:
        """Return the mean speed: the distance per cycle divided by the period, m/s."""
        return self._divide_by_period(self.reduce_over_steps(self.step_length, jnp.sum))

    def _divide_by_period(self, sum_over_cycle: Array) -> Array:
        """Return a sum over the cycle divided by the period, or zero without a gait."""
        return sum_over_cycle / jnp.where(self.period > 0.0, self.period, 1.0)

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Return the Floquet multipliers in the order of decreasing modulus.

        The multipliers are differentiable if the section has at most three coordinates.
        """
        return small_matrices.floquet_multipliers(self.monodromy)

    @property
    def spectral_radius(self) -> Array:
        """Return the largest modulus of the Floquet multipliers, which is below 1 for
        stable gaits.
        """
        return small_matrices.compute_spectral_radius(self.monodromy)

    @property
    def spectral_radius_value(self) -> Array:
        """Return the spectral radius without derivatives."""
        return small_matrices.compute_spectral_radius(lax.stop_gradient(self.monodromy_value))

    @property
    def spectral_margin(self) -> Array:
        """Return 1 minus the spectral radius, which is positive for stable gaits of every model.

        It is zero if no gait was found.
        """
        return self._zero_without_gait(1.0 - self.spectral_radius)

    @property
    def stability_margin(self) -> Array:
        """Return the smooth minimum of the Jury margins, which is positive only for stable gaits.

        See `small_matrices.compute_stability_margin`. The margin is defined for sections of at most
        three coordinates, and therefore not for unilateral contact.
        """
        return self._zero_without_gait(small_matrices.compute_stability_margin(self.monodromy))

    @property
    def condition_number(self) -> Array:
        """Return the condition number of the matrix I - monodromy.

        The cycle amplifies a disturbance by this factor.
        """
        newton_matrix = jnp.eye(self.monodromy_value.shape[-1]) - self.monodromy_value
        return self._zero_without_gait(jnp.linalg.cond(newton_matrix))

    @announce_wait("the measure of a gait", "20 s")
    @with_default_jax_settings
    def measure(self, measure_name: str | Measure) -> Array:
        """Return the measure that `CYCLE_MEASURE_FUNCTIONS` computes for this name.

        A measure of your own, see `vrw.measure`, is a mean over the gait steps of the cycle.

        Durations are sums over the gait steps of the cycle, and indicators are minima over the gait
        steps. Batch axes come first.
        """
        if isinstance(measure_name, Measure):
            return self._zero_without_gait(self._evaluate_own_measure(measure_name))
        return CYCLE_MEASURE_FUNCTIONS[
            check_choice("the measure", measure_name, tuple(CYCLE_MEASURE_FUNCTIONS))
        ](self)

    @announce_wait("measures of a gait", "20 s")
    def measures(self, measure_names: Iterable[str | Measure] | None = None) -> dict[str, Array]:
        """Return the requested measures by name. Only these measures are traced."""
        if measure_names is None:
            raise TypeError(
                "measure_names is None, but a gait has many measures, some of which take long: "
                'give names, such as ["speed"].'
            )
        measure_names = tuple(measure_names)
        force_peaks = (
            {} if FORCE_PEAK_MEASURES.keys().isdisjoint(measure_names) else self.force_peaks
        )
        return {
            name: force_peaks[name] if name in force_peaks else self.measure(measure)
            for measure, name in zip(measure_names, name_measures(measure_names), strict=True)
        }

    @abc.abstractmethod
    def _evaluate_own_measure(self, measure: Measure) -> Array:
        """Return the value of a measure of the user, which is undefined without a gait."""

    @property
    def force_peaks(self) -> dict[str, Array]:
        """Return the `measures.FORCE_PEAK_MEASURES` by name.

        Each measure is the largest value over the gait steps. The measures have first derivatives.
        The derivatives of the number of peaks are zero.
        """
        return {
            measure_name: self._zero_without_gait(peak_value)
            for measure_name, peak_value in self._locate_force_peaks().items()
        }

    @abc.abstractmethod
    def _locate_force_peaks(self) -> dict[str, Array]:
        """Return the measures of `force_peaks`; their values are undefined without a gait."""

    def map_over_batch_axes(self, function_of_cycle: Callable) -> Callable:
        """Return the function of one cycle, mapped over the batch axes of this cycle."""
        for _ in range(self.outcome.ndim):
            function_of_cycle = jax.vmap(function_of_cycle)
        return with_default_jax_settings(function_of_cycle)

    def summary_rows(self) -> list[LabelAndText]:
        """Return the labels and texts that a printed cycle contains.

        For a batch they contain the number of found cycles.
        """
        outcome_codes = np.asarray(self.outcome)
        if outcome_codes.ndim:
            return [("wheels", format_outcome_counts(outcome_codes, Outcome))]
        if outcome_codes != Outcome.STEPPED:
            return [("outcome", f"{Outcome(int(outcome_codes)).name}: {self.why}")]
        spectral_radius, multipliers_text = format_floquet_multipliers(
            np.asarray(self.monodromy_value)
        )
        period_text = f"{self.period_n} steps" if self.period_n > 1 else "one step"
        if (minimal_period := int(self.minimal_period)) < self.period_n:
            period_text += f"; its minimal period is {minimal_period}"
        stability_text = "stable" if spectral_radius < 1.0 else "unstable"
        return [
            ("gait", f"{stability_text}, repeats after {period_text}"),
            ("double support", f"{100 * float(self.dls_fraction):.3f} %"),
            ("period", f"{float(self.period):.6f} s"),
            ("speed", f"{float(self.speed):.6f} m/s"),
            *self.model_summary_rows(),
            ("after landing: angle, rate", f"{format_numbers(self.post_impact)} rad, rad/s"),
            ("multipliers", f"{multipliers_text}; spectral radius {spectral_radius:.6f}"),
        ]

    def model_summary_rows(self) -> list[LabelAndText]:
        """Return the labels and texts that depend on the class of the cycle."""
        return [("durations of each kind of support", f"{format_numbers(self.durations)} s")]


def format_floquet_multipliers(monodromy_matrix: np.ndarray) -> tuple[float, str]:
    """Return the spectral radius, and a text that lists the Floquet multipliers.

    The multipliers are in the order of decreasing modulus. If multipliers are zero to five digits,
    the text contains only their number.
    """
    floquet_multipliers = small_matrices.compute_multipliers(monodromy_matrix)
    multiplier_texts = [
        f"{multiplier:.5f}" if multiplier.imag else f"{multiplier.real:.5f}"
        for multiplier in floquet_multipliers
        if abs(multiplier) >= 5e-6
    ]
    n_unlisted_multipliers = len(floquet_multipliers) - len(multiplier_texts)
    if n_unlisted_multipliers:
        multiplier_texts.append(f"{n_unlisted_multipliers} below 5e-6")
    return float(np.abs(floquet_multipliers[0])), ", ".join(multiplier_texts)


def replace_by_nan(is_missing: Array, params: Any, tree: Any) -> Any:
    """Return a tree with NaN as values and derivatives by `params` where a gait is missing."""
    # The weight contains the parameters, so that derivatives are also NaN.
    weight = 1.0 + jnp.where(is_missing, jnp.nan, 0.0) * sum(jax.tree.leaves(params))
    return jax.tree.map(
        lambda x: x * weight.astype(x.dtype) if eqx.is_inexact_array(x) else x, tree
    )


LAST_GAIT_DESCRIBERS: list[Callable[[Any], str]] = []
"""Function that describes the last gait on the way from Table 1 to the wheel of a cycle. The module
`gait_search` adds the function, because the function searches for gaits.
"""

RETRY_OUTCOMES = (
    Outcome.NO_CYCLE_FOUND,
    Outcome.EVENT_ORDER_MISMATCH,
    Outcome.BRANCH_ENDS_BEFORE_TARGET,
    Outcome.MESH_TOO_COARSE,
)
"""Outcomes after which the search is repeated, because it may have missed an existing gait."""

FIELDS_ZERO_WITHOUT_GAIT = (
    "section_state",
    "post_impact",
    "durations",
    "step_length",
    "indicators",
    "steps",
    "monodromy_value",
)
"""Names of the fields of a cycle that are zero if no gait is found."""


def _make_step_reader(
    read_values: Callable[[Any], Array], reduce_values: Callable
) -> Callable[[Any], Array]:
    """Return a function of a cycle that reduces a value of each gait step over the cycle."""
    return lambda cycle: cycle.reduce_over_steps(read_values(cycle), reduce_values)


CYCLE_MEASURE_FUNCTIONS: dict[str, Callable[[AbstractCycle], Array]] = {
    "dls_fraction": operator.attrgetter("dls_fraction"),
    "period": operator.attrgetter("period"),
    "speed": operator.attrgetter("speed"),
    "step_length": _make_step_reader(operator.attrgetter("step_length"), jnp.sum),
    **{
        name: _make_step_reader(lambda cycle, i=i: cycle.durations[..., i], jnp.sum)  # type: ignore[misc]
        for i, name in enumerate(("duration_dls", "duration_sls1", "duration_sls2"))
    },
    "theta_post_impact": lambda cycle: cycle.post_impact[..., 0],
    "dtheta_post_impact": lambda cycle: cycle.post_impact[..., 1],
    "theta_touchdown": lambda cycle: cycle.section_state[..., 0],
    "dtheta_touchdown": lambda cycle: cycle.section_state[..., 1],
    "dL1_touchdown": lambda cycle: cycle.section_state[..., 2],
    "lambda_I4": _make_step_reader(operator.attrgetter("indicators.lambda_I4"), jnp.min),
    "lambda_2_plus": _make_step_reader(operator.attrgetter("indicators.lambda_2"), jnp.min),
    "lambda_4_plus": _make_step_reader(operator.attrgetter("indicators.lambda_4"), jnp.min),
    "spectral_radius": operator.attrgetter("spectral_radius"),
    "spectral_margin": operator.attrgetter("spectral_margin"),
    "stability_margin": operator.attrgetter("stability_margin"),
    "takeoff_acceleration": operator.attrgetter("takeoff_acceleration"),
    "gait_sensitivity_dls_fraction": operator.methodcaller("gait_sensitivity", "dls_fraction"),
    "gait_sensitivity_period": operator.methodcaller("gait_sensitivity", "period"),
    "gait_sensitivity_speed": operator.methodcaller("gait_sensitivity", "speed"),
    **{
        force_measure_name: lambda cycle, force_measure_name=force_measure_name: cycle.force_peaks[
            force_measure_name
        ]  # type: ignore[misc]
        for force_measure_name in FORCE_PEAK_MEASURES
    },
}
"""Functions that map a cycle to a measure, by the name of the measure.

Derivatives of the stability measures are second derivatives of the motion. Their computation
requires an additional compiled program. It takes twice as long as for other measures.
"""

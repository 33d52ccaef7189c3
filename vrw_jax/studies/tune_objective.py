"""Objective and constraints of a gait, with exact gradients, from a user's specification."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_names,
    check_range,
    check_real,
    check_reals,
    require_known_name,
)
from vrw_jax.gaits.finder import AbstractGaitFinder, GaitFunction, GaitMeasureReader
from vrw_jax.gaits.margin_defaults import default_margins
from vrw_jax.wheel.params import WheelParams

ConstraintSpecification = Mapping[str, float | tuple[float | None, float | None]] | Sequence[str]

UPPER_BOUND_PREFIX = "-"
"""Prefix that marks an upper bound on a measure, which is a lower bound on its negative."""


@dataclass(frozen=True)
class WeightedMeasureSum:
    """Objective that is a weighted sum of measures of the cycle and the step."""

    measure_reader: GaitMeasureReader
    measure_weights: tuple[tuple[str, float], ...]

    def __call__(self, cycle: Any, step: Any) -> Array:
        weighted_measures = [
            measure_weight * self.measure_reader(measure_name, cycle, step)
            for measure_name, measure_weight in self.measure_weights
        ]
        return sum(weighted_measures[1:], start=weighted_measures[0])


@dataclass(frozen=True)
class CycleObjective:
    """Objective that a user's function computes from the cycle alone."""

    cycle_function: Callable[[Any], Array]

    def __call__(self, cycle: Any, step: Any) -> Array:
        return self.cycle_function(cycle)


@dataclass(frozen=True)
class WheelObjective:
    """Objective of `tune` that a function computes from the parameters of the wheel.

    `tune` calls the function with the `WheelParams` of each trial wheel, and does not compile the
    function. The function may therefore sample walks, as `first_passage` does. JAX differentiates
    the function with respect to the free parameters.

    - `wheel_function`: function of `WheelParams` that returns one number.

    Examples:
        >>> life = lambda params: jnp.log(vrw.first_passage(params, 0.01).mean_steps)
        >>> bounds = {"damping": (190.0, 205.0)}
        >>> tuned = vrw.tune(vrw.WheelParams(), vrw.WheelObjective(life), ["damping"], bounds)
        >>> float(tuned.params.damping)
        190.0
    """

    wheel_function: Callable[[WheelParams], Any]

    @property
    def label(self) -> str:
        """Return the name of the function, or "objective" if the function has no name."""
        return getattr(self.wheel_function, "__name__", "objective")

    def evaluate_with_gradient(
        self, params: WheelParams, free_parameters: Sequence[str]
    ) -> tuple[float, np.ndarray]:
        """Return the objective of a wheel, and its derivatives with respect to the free parameters,
        shape (free,).
        """
        select_free_values = lambda wheel_params: [
            getattr(wheel_params, parameter_name) for parameter_name in free_parameters
        ]

        def evaluate_free_values(free_values: list[Array]) -> Array:
            objective_value = self.wheel_function(
                eqx.tree_at(select_free_values, params, free_values)
            )
            _check_objective_value(objective_value)
            return jnp.asarray(objective_value)

        objective_value, free_gradient = jax.value_and_grad(evaluate_free_values)(
            select_free_values(params)
        )
        return float(objective_value), np.array(free_gradient, float)


def _check_objective_value(objective_value: Any) -> None:
    """Raise an error if the value of an objective is not one real number."""
    if jnp.shape(check_reals("objective", objective_value, "return one number")):
        raise ValueError(
            f"objective returns an array of shape {jnp.shape(objective_value)}, but what is "
            "maximised is one number: reduce it, as by jnp.min or jnp.sum."
        )


def zero_objective(cycle: Any, step: Any) -> Array:
    """Return 0 for any gait, in place of an objective that is not compiled."""
    return jnp.zeros(())


@dataclass(frozen=True)
class ObjectiveAndConstraints:
    """Function that returns the objective and the constraints of a gait as one array, objective
    first.

    A constraint is a measure with a lower bound. A constraint whose name has the prefix
    `UPPER_BOUND_PREFIX` is a measure with an upper bound.
    """

    objective_function: GaitFunction
    measure_reader: GaitMeasureReader
    constraint_names: tuple[str, ...]

    def __call__(self, cycle: Any, step: Any) -> Array:
        objective_value = self.objective_function(cycle, step)
        _check_objective_value(objective_value)
        constraint_values = []
        for constraint_name in self.constraint_names:
            measure_name = constraint_name.removeprefix(UPPER_BOUND_PREFIX)
            measure_value = jnp.ravel(self.measure_reader(measure_name, cycle, step))
            constraint_values.append(
                measure_value if measure_name == constraint_name else -measure_value
            )
        return jnp.concatenate([jnp.ravel(objective_value), *constraint_values])


def parse_constraint_margins(
    params: Any,
    constraints: ConstraintSpecification | None,
    gait_finder: AbstractGaitFinder,
) -> dict[str, float]:
    """Return the smallest allowed value of each constrained measure, by name.

    The name of a measure with an upper bound has the prefix `UPPER_BOUND_PREFIX`. Its value is then
    the smallest allowed value of the negative measure.
    """
    if constraints is None:
        model, readable = gait_finder.model, gait_finder.readable_measures
        if not model.is_wheel or model.batch_kernel != "phases":
            return {}
        return {name: x for name, x in default_margins(params).items() if name in readable}
    constraint_margins = {}
    if isinstance(constraints, Mapping):
        for measure_name, bound_or_range in constraints.items():
            if not isinstance(bound_or_range, tuple):
                constraint_margins[measure_name] = check_real(
                    f"the margin of {measure_name}", bound_or_range
                )
                continue
            if bound_or_range == (None, None):
                raise ValueError(
                    f"the range of {measure_name} is (None, None), which bounds nothing: give a "
                    "lower or an upper bound, as in (None, 0.6), or leave the constraint out."
                )
            if len(bound_or_range) != 2 or None not in bound_or_range:
                bound_or_range = check_range(f"the range of {measure_name}", bound_or_range)
            lower_limit, upper_limit = bound_or_range
            if upper_limit is not None:
                upper_bound = check_real(f"the upper end of {measure_name}", upper_limit)
                constraint_margins[UPPER_BOUND_PREFIX + measure_name] = -upper_bound
            if lower_limit is not None:
                constraint_margins[measure_name] = check_real(
                    f"the lower end of {measure_name}", lower_limit
                )
    else:
        constraint_margins = dict.fromkeys(check_names("constraints", constraints), 0.0)
    if "clearance_sls1" in constraint_margins:
        # The take-off acceleration has a nonzero derivative if the clearance has none.
        constraint_margins.setdefault("takeoff_acceleration", 0.0)
    for measure_name in constraint_margins:
        require_known_name(
            measure_name.removeprefix(UPPER_BOUND_PREFIX),
            gait_finder.readable_measures,
            "measure for a constraint",
        )
    return constraint_margins


def restore_sign_of_bound(constraint_name: str, lower_bound: float) -> float:
    """Return the bound on a measure, converted from the smallest allowed value of a constraint.

    The sign changes if the name of the constraint has the prefix of upper bounds.
    """
    return float(-lower_bound if constraint_name.startswith(UPPER_BOUND_PREFIX) else lower_bound)


def compute_slack_scales(constraint_slacks: np.ndarray, slack_jacobian: np.ndarray) -> np.ndarray:
    """Return the scale of each slack.

    The scale is the norm of the slack's gradient with respect to normalized parameters, that is,
    the change of the slack per width between the bounds. A slack that is always 0 has the scale 1.
    """
    slack_scales = np.maximum(
        np.linalg.norm(slack_jacobian, axis=-1), 1e-3 * np.abs(constraint_slacks)
    )
    return np.where(slack_scales == 0.0, 1.0, slack_scales)


def compute_max_violation(constraint_slacks: np.ndarray, slack_scales: np.ndarray) -> Any:
    """Return the largest violation of a constraint, in widths between the bounds, or 0 if there is
    none.

    The result is NaN if the wheel has no gait.
    """
    return np.max(-constraint_slacks / slack_scales, axis=-1, initial=0.0)

"""Objective and constraints of a gait from a user's specification, with exact gradients."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import AbstractCycle, AbstractGaitFinder, Gait, default_margins
from vrw_jax.models import AbstractStep
from vrw_jax.validation import check_known_name, check_names, check_range, check_real, check_reals
from vrw_jax.wheel import WheelParams

MeasureFunction = Callable[[AbstractCycle, AbstractStep], Array]
MarginSpec = Mapping[str, float | tuple[float | None, float | None]] | Sequence[str]
ReadMeasure = Callable[[str, AbstractCycle, AbstractStep], Array]

UPPER_BOUND_PREFIX = "-"
"""Prefix of a measure with an upper bound, which is a lower bound of its negative."""


@dataclass(frozen=True)
class WeightedSum:
    """Weighted sum of measures of cycle and step, as an objective."""

    read: ReadMeasure
    weights: tuple[tuple[str, float], ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> Array:
        terms = [weight * self.read(name, cycle, step) for name, weight in self.weights]
        return sum(terms[1:], start=terms[0])


@dataclass(frozen=True)
class CycleObjective:
    """A user's function of the cycle alone, as an objective of cycle and step."""

    function: Callable[[Any], Array]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> Array:
        return self.function(cycle)


@dataclass(frozen=True)
class ObjectiveAndConstraints:
    """Objective and constraints of a gait as one array, the objective first.

    A constraint is a measure with a lower bound, or with the prefix a measure with an upper bound.
    """

    objective: MeasureFunction
    read: ReadMeasure
    constraints: tuple[str, ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> Array:
        objective_value = self.objective(cycle, step)
        if jnp.shape(check_reals("objective", objective_value, "return one number")):
            raise ValueError(
                f"objective returns an array of shape {jnp.shape(objective_value)}, but what is "
                "maximised is one number: reduce it, as by jnp.min or jnp.sum."
            )
        constraint_values = [
            self._evaluate_constraint(name, cycle, step) for name in self.constraints
        ]
        return jnp.concatenate([jnp.ravel(objective_value), *constraint_values])

    def _evaluate_constraint(self, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        """Return a measure, or its negative if its name has the prefix of an upper bound."""
        measure = name.removeprefix(UPPER_BOUND_PREFIX)
        value = jnp.ravel(self.read(measure, cycle, step))
        return value if measure == name else -value


class GaitEvaluation(NamedTuple):
    """Gait with its objective and constraints; in a batch, the batch axis comes first."""

    gait: Gait
    values: Array  # (1 + n_constraints,): the objective, then the constraints
    jacobian: Array  # (n_parameters, 1 + n_constraints)


def parse_margins(
    params: WheelParams, constraints: MarginSpec | None, finder: AbstractGaitFinder
) -> dict[str, float]:
    """Return the smallest allowed value of each constrained measure by name.

    A measure with an upper bound has the prefix `UPPER_BOUND_PREFIX`, and the smallest value is
    that of its negative.
    """
    if constraints is None:
        defaults = default_margins(params)
        return {name: lower for name, lower in defaults.items() if finder.supports_cold_start}
    margins: dict[str, float] = {}
    if isinstance(constraints, Mapping):
        for name, lower in constraints.items():
            margins |= _parse_margin(name, lower)
    else:
        margins = dict.fromkeys(check_names("constraints", constraints), 0.0)
    if "clearance_sls1" in margins:
        # The take-off acceleration has a nonzero derivative if the clearance has none.
        margins.setdefault("takeoff_acceleration", 0.0)
    for name in margins:
        check_known_name(
            name.removeprefix(UPPER_BOUND_PREFIX),
            finder.readable_measures,
            "measure for a constraint",
        )
    return margins


def _parse_margin(name: str, bound: float | tuple[float | None, float | None]) -> dict[str, float]:
    """Return the smallest allowed values of one measure and of its negative, by name.

    `bound` is a lower bound, or a pair of bounds of which one may be None.
    """
    if not isinstance(bound, tuple):
        return {name: check_real(f"the margin of {name}", bound)}
    if len(bound) != 2 or None not in bound:
        lower_bound, upper_bound = check_range(f"the range of {name}", bound)
        return {UPPER_BOUND_PREFIX + name: -upper_bound, name: lower_bound}
    if bound == (None, None):
        raise ValueError(
            f"the range of {name} is (None, None), which bounds nothing: give a lower or an upper "
            "bound, as in (None, 0.6), or leave the constraint out."
        )
    low_end, high_end = bound
    if low_end is None:
        return {UPPER_BOUND_PREFIX + name: -check_real(f"the upper end of {name}", high_end)}
    return {name: check_real(f"the lower end of {name}", low_end)}


def signed_bound(name: str, lower: float) -> float:
    """Return a bound with the sign of its measure, without that of the upper-bound prefix."""
    return float(-lower if name.startswith(UPPER_BOUND_PREFIX) else lower)


def scale_slacks(slack: np.ndarray, slack_jacobian: np.ndarray) -> np.ndarray:
    """Return the scale of each slack, which is its change over one width of the bounds."""
    return np.maximum(np.linalg.norm(slack_jacobian, axis=-1), 1e-3 * np.abs(slack) + 1e-12)


def max_breach(slack: np.ndarray, scales: np.ndarray) -> Any:
    """Return the largest violation of a constraint in widths of the bounds, 0 if there is none.

    It is NaN if the gait is lost.
    """
    return np.max(-slack / scales, axis=-1, initial=0.0)

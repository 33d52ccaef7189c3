"""Objective and constraints of a gait from a user's specification, with exact gradients."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import (
    AbstractCycle,
    AbstractGaitFinder,
    Gait,
    default_margins,
)
from vrw_jax.models import AbstractStep
from vrw_jax.wheel import WheelParams
from vrw_jax.wording import names_of, range_of, real, reals, require_known

Reader = Callable[[AbstractCycle, AbstractStep], Array]
Margins = Mapping[str, float | tuple[float, float]] | Sequence[str]
Read = Callable[[str, AbstractCycle, AbstractStep], Array]

MOST = "-"
"""Prefix of a measure that is bounded from above: its negative is bounded from below."""


@dataclass(frozen=True)
class Weighted:
    """Weighted sum of measures, as an objective."""

    read: Read
    weights: tuple[tuple[str, float], ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> Array:
        terms = [weight * self.read(name, cycle, step) for name, weight in self.weights]
        return sum(terms[1:], start=terms[0])


@dataclass(frozen=True)
class OfCycle:
    """A user's function of the cycle alone, as an objective."""

    function: Callable[[Any], Array]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> Array:
        return self.function(cycle)


@dataclass(frozen=True)
class Sought:
    """Objective and constraints of a gait as one array.

    A constraint is a measure with a lower bound, or with the prefix a measure with an upper bound.
    """

    objective: Reader
    read: Read
    constraints: tuple[str, ...]

    def __call__(self, cycle: AbstractCycle, step: AbstractStep) -> Array:
        told = self.objective(cycle, step)
        if jnp.shape(reals("objective", told, "return one number")):
            raise ValueError(
                f"objective returns an array of shape {jnp.shape(told)}, but what is maximised is "
                "one number: reduce it, as by jnp.min or jnp.sum."
            )
        kept = [self._kept(name, cycle, step) for name in self.constraints]
        return jnp.concatenate([jnp.ravel(told), *kept])

    def _kept(self, name: str, cycle: AbstractCycle, step: AbstractStep) -> Array:
        measure = name.removeprefix(MOST)
        value = jnp.ravel(self.read(measure, cycle, step))
        return value if measure == name else -value


class Evaluated(NamedTuple):
    """Gait with its objective and constraints. A batch has its axis before all others."""

    gait: Gait
    values: Array  # (1 + n_constraints,): the objective, then the constraints
    columns: Array  # (n_parameters, 1 + n_constraints)


def margins_of(
    params: WheelParams, constraints: Margins | None, finder: AbstractGaitFinder
) -> dict[str, float]:
    """Return least values by name of the measure, or by `UPPER_BOUND_PREFIX` and name for its
    negative."""
    if constraints is None:
        premises = default_margins(params)
        return {name: least for name, least in premises.items() if finder.from_nothing}
    margins: dict[str, float] = {}
    if isinstance(constraints, Mapping):
        for name, least in constraints.items():
            if isinstance(least, tuple):
                least, most = range_of(f"the range of {name}", least)
                margins[MOST + name] = -most
            margins[name] = real(f"the margin of {name}", least)
    else:
        margins = dict.fromkeys(names_of("constraints", constraints), 0.0)
    if "clearance_sls1" in margins:
        # It has a nonzero derivative where the clearance has none.
        margins.setdefault("takeoff_acceleration", 0.0)
    for name in margins:
        require_known(name.removeprefix(MOST), finder.readable, "measure for a constraint")
    return margins


def bound_of(name: str, least: float) -> float:
    return float(-least if name.startswith(MOST) else least)


def slack_scales(slack: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Return the change of slack over one width of the bounds, which makes constraints
    comparable."""
    return np.maximum(np.linalg.norm(slopes, axis=-1), 1e-3 * np.abs(slack) + 1e-12)


def breach(slack: np.ndarray, scales: np.ndarray) -> Any:
    """Return the largest breach of a constraint in widths of the bounds: 0 if none, NaN if the gait
    is lost."""
    return np.max(-slack / scales, axis=-1, initial=0.0)

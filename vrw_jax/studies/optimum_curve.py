"""Curves of optima: an optimum with its constraints and active set along a parameter.

The optimum at each value starts from that at the value before. If the set of active limits differs
at two neighboring values, the values between are bisected.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.printing import format_heading_and_rows
from vrw_jax.base.progress import report_progress
from vrw_jax.studies.tune_maximization import (
    EvaluatedTrial,
    TuneStatus,
    maximize_objective,
)
from vrw_jax.studies.tune_objective import UPPER_BOUND_PREFIX

CHANGE_LOCATION_ACCURACY = 1e-5
"""Accuracy of the location of a change, as a fraction of the range of the parameter. The value is
chosen because an active limit is known to 1e-6 of its change between the bounds.
"""
MAX_STEP_HALVINGS = 5
"""Largest number of halvings of a step after which an optimum is not followed any further."""


class ActiveSetChange(NamedTuple):
    """Change of the active constraints and bounds along a curve of optima, and where it happens.

    - `value`: value of the parameter;
    - `before`, `after`: names of the active constraints and bounds on both sides.

    Examples:
        >>> print(vrw.ActiveSetChange(0.236, ("lambda_4_plus",), ()))
        0.236: lambda_4_plus -> nothing
    """

    value: float
    before: tuple[str, ...]
    after: tuple[str, ...]

    def __str__(self) -> str:
        name = lambda names: ", ".join(names) or "nothing"
        return f"{self.value:.6g}: {name(self.before)} -> {name(self.after)}"


class _Optimum(NamedTuple):
    value: float
    trial: EvaluatedTrial
    active: tuple[str, ...]
    prices: np.ndarray
    parameters: np.ndarray


@dataclasses.dataclass(frozen=True, repr=False)
class OptimumCurve:
    """Optima of `tune` along a parameter.

    - `parameter`: name of the parameter along which the optimum is followed;
    - `dataset`: best free parameters, objective, and price of each limit by its name, over the
      dimension `point`, with the parameter as a coordinate. A price of 0 is that of an inactive
      limit;
    - `changes`: changes of the set of active limits, as `ActiveSetChange`;
    - `ending`: sentence on how the curve ends.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> curve = vrw.tune(
        ...     vrw.WheelParams(), "dls_fraction", ["damping"], bounds,
        ...     along=("slope", (0.30, 0.29)),
        ... )
        >>> curve.dataset.damping.values.round(3).tolist(), curve.changes
        ([215.0, 215.0], ())
    """

    parameter: str
    dataset: xr.Dataset
    changes: tuple[ActiveSetChange, ...]
    ending: str

    def __repr__(self) -> str:
        values = self.dataset[self.parameter].values
        rows = [("from, to", f"{values[0]:.6g}, {values[-1]:.6g}"), ("ending", self.ending)]
        rows += [("active limits change at", str(change)) for change in self.changes]
        return format_heading_and_rows(f"{values.size} optima along {self.parameter}", rows)


def follow_optimum(
    problem: Any,
    name: str,
    values: Sequence[float],
    start_trial: EvaluatedTrial,
    tolerance: float,
    max_evaluations: int,
) -> OptimumCurve:
    """Follow the optimum of a `TuneProblem` through the values of a parameter, in their order."""
    limit_names = [
        *(x.removeprefix(UPPER_BOUND_PREFIX) for x in problem.constraint_names),
        *(f"{x} at its lower bound" for x in problem.free_parameters),
        *(f"{x} at its upper bound" for x in problem.free_parameters),
    ]
    failures: list[str] = []

    def optimize(value: float, neighbor: EvaluatedTrial) -> _Optimum | None:
        """Return the optimum at a value, from that at a neighboring value, or None."""
        report_progress(f"optimum at {name} {value:.4g}")
        model, params = problem.gait_finder.model.with_parameter(problem.params, name, value)
        finder = dataclasses.replace(problem.gait_finder, model=model)
        local = dataclasses.replace(problem, params=params, gait_finder=finder)
        start = local.evaluate_trial(neighbor.normalized_parameters, neighbor)
        # The branch of the neighbor is known at another value, so only its failures count.
        start = start._replace(is_on_branch=np.asarray(True))
        if not start.is_usable_trial:
            failures.append("The wheel has no gait near that of the last optimum.")
            return None
        result = maximize_objective(
            local.evaluate_trial, start, tolerance=tolerance, max_evaluations=max_evaluations
        )
        if result.status != TuneStatus.CONVERGED:
            failures.append(result.status.meaning)
            return None
        prices = problem.compute_conditions_per_unit(result).price_ranges[:, 1]
        active = tuple(x for x, price in zip(limit_names, prices, strict=True) if price > 0.0)
        parameters = local.denormalize_parameters(result.best_trial.normalized_parameters)
        free = parameters[problem.free_parameter_indices]
        return _Optimum(value, result.best_trial, active, prices, free)

    first = optimize(float(values[0]), start_trial)
    if first is None:
        raise ValueError(
            f"no optimum is found at {name} {float(values[0]):g}, where the curve begins: "
            f"{failures[-1]} Give other bounds or constraints, or a better start."
        )
    optima, changes = [first], []
    accuracy = CHANGE_LOCATION_ACCURACY * abs(float(values[-1]) - float(values[0]))

    def locate_changes(left: _Optimum, right: _Optimum) -> list[ActiveSetChange]:
        if left.active == right.active:
            return []
        middle = None
        if abs(right.value - left.value) > accuracy:
            middle = optimize(0.5 * (left.value + right.value), left.trial)
        if middle is None:
            return [ActiveSetChange(0.5 * (left.value + right.value), left.active, right.active)]
        return locate_changes(left, middle) + locate_changes(middle, right)

    ending = "The values of the parameter ended."
    for value in map(float, values[1:]):
        while optima[-1].value != value:
            last, step = optima[-1], value - optima[-1].value
            following = None
            for i in range(MAX_STEP_HALVINGS + 1):
                target = value if i == 0 else last.value + step / 2**i
                following = following or optimize(target, last.trial)
            if following is None:
                ending = f"No optimum is found beyond {last.value:.6g}. {failures[-1]}"
                break
            changes += locate_changes(last, following)
            optima.append(following)
        if optima[-1].value != value:
            break
    ever_active = [x for x in limit_names if any(x in optimum.active for optimum in optima)]
    columns = np.array([optimum.prices for optimum in optima])
    domains = problem.gait_finder.model.parameter_domains
    describe = lambda name: {"units": domains[name].unit, "symbol": domains[name].symbol}
    return OptimumCurve(
        name,
        xr.Dataset(
            {
                **{
                    free: ("point", column, describe(free))
                    for free, column in zip(
                        problem.free_parameters,
                        np.array([x.parameters for x in optima]).T,
                        strict=True,
                    )
                },
                "objective": ("point", np.array([float(x.trial.objective) for x in optima])),
                "price": (
                    ("point", "limit"),
                    columns[:, [limit_names.index(x) for x in ever_active]],
                ),
            },
            {
                name: ("point", np.array([x.value for x in optima]), describe(name)),
                "limit": np.array(ever_active, dtype=str),
            },
            {"title": f"Optima of {problem.objective_label} along {name}"},
        ),
        tuple(changes),
        ending,
    )

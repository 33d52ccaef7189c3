"""Continue special points of any walker as curves in two parameters."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_names,
    check_range,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.parameters import find_tree_parameter, replace_tree_parameter
from vrw_jax.base.walker import AbstractWalker, make_return_map
from vrw_jax.branches.abstract_continuation import AbstractContinuation, QuantitiesByName
from vrw_jax.branches.arclength import ArclengthOptions, ContinuationPoint
from vrw_jax.branches.branch import BIFURCATIONS, Codim2Point, SpecialPointCurve, TestFunction
from vrw_jax.branches.branch_location import continue_and_locate_special_points
from vrw_jax.branches.continuation_problems import MapProblem
from vrw_jax.branches.curve_problems import (
    AbstractCurveProblem,
    TwoParameterStep,
    stack_bifurcation_margins,
)
from vrw_jax.branches.map_branch import (
    HybridContinuation,
    MarginFunctions,
    check_arclength_options,
    continue_hybrid_branch,
    declare_margins,
    make_stability_variables,
)
from vrw_jax.gaits.fixed_points import estimate_state_units
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.lanes.batching import select_tree_rows

RANGE_EDGE = "edge of the box"
"""Name of the distance of the second parameter from its nearer bound, as a fraction of its range.
"""


DEFAULT_CURVE_OPTIONS = ArclengthOptions(initial_ds=5e-4)
"""Default continuation options of curves. The first continuation step is short because some curves
are short.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class WalkerCurveProblem(AbstractCurveProblem):
    """Problem of a curve of special points of the gaits of any walker.

    - `gaits`: continuation of the gaits in the first parameter, which measures them;
    - `map_problem`: problem of the fixed points of the return map, in both parameters;
    - `second_name`, `test_name`: names of the second parameter, and of what vanishes on the curve.
    """

    gaits: HybridContinuation
    map_problem: MapProblem
    second_name: str
    test_name: str

    def linearize_in_two_parameters(
        self, params: Any, z: np.ndarray, p: np.ndarray
    ) -> TwoParameterStep:
        step: Any = self.map_problem.linearize(params, z, p)
        correction, tangents = step.newton_correction, step.branch_tangent
        bounds = np.array([self.gaits.parameter_bounds, self.second_bounds])
        units = np.broadcast_to(np.ptp(bounds, 1), p.shape)
        values, gradient = self.differentiate_quantities(
            params, z + correction, p, correction, tangents, units
        )
        jacobian = step.return_map_jacobian
        return TwoParameterStep(correction, tangents, jacobian, values[:, 0], gradient[:, :, 0])

    def measure_quantities(self, params: Any, z: np.ndarray, p: np.ndarray) -> np.ndarray:
        if self.test_name in BIFURCATIONS:
            jacobians: Any = self.map_problem.linearize(params, z, p).return_map_jacobian
            index = list(BIFURCATIONS).index(self.test_name)
            return stack_bifurcation_margins(jacobians)[:, [index]]
        points = ContinuationPoint(z, p[:, 0], z, p[:, 0], z, p[:, 0])
        quantities = self.measure_gaits(params, points, p[:, 1])
        has_stepped = quantities["outcome"] == Outcome.STEPPED
        return np.where(has_stepped, quantities[self.test_name], np.nan)[:, None]

    def measure_gaits(
        self, params: Any, points: ContinuationPoint, second: np.ndarray
    ) -> QuantitiesByName:
        """Return quantities of the gaits at points of the first parameter, by name."""
        params = replace_tree_parameter(params, self.second_name, second)
        return self.gaits.evaluate_point_quantities(params, points)


@dataclass(frozen=True)
class AbstractCurveContinuation(AbstractContinuation):
    """Base class of continuations of special points as curves in two parameters."""

    continuation_problem: Any

    edge_functions: ClassVar[Mapping[str, TestFunction]] = {
        RANGE_EDGE: TestFunction("lost", "The second parameter's range ends.", True)
    }

    def make_point_reader(self, owner: int, point: ContinuationPoint) -> Any:
        return lambda: point

    def add_second_parameter(
        self, quantities: QuantitiesByName, points: ContinuationPoint
    ) -> QuantitiesByName:
        """Return quantities with the second parameter, and its distance from its range's edge."""
        second = self.continuation_problem.compute_second_parameter(points.z)
        distance = np.minimum(points.z[:, 0], 1.0 - points.z[:, 0])
        return quantities | {"second": second, RANGE_EDGE: distance}


@dataclass(frozen=True)
class WalkerCurveContinuation(AbstractCurveContinuation):
    """Continuation of a special point of a walker as a curve in two parameters."""

    @property
    def test_functions(self) -> Mapping[str, TestFunction]:  # type: ignore[override]
        return {**self.continuation_problem.gaits.test_functions, **self.edge_functions}

    @property
    def parameter_unit(self) -> float:
        return float(np.ptp(self.parameter_bounds))

    def evaluate_point_quantities(self, params: Any, points: ContinuationPoint) -> QuantitiesByName:
        problem = self.continuation_problem
        second = problem.compute_second_parameter(points.z)
        quantities = problem.measure_gaits(params, points._replace(z=points.z[:, 1:]), second)
        return self.add_second_parameter(quantities, points)

    def mask_undefined_quantities(
        self, quantities: QuantitiesByName, owners: np.ndarray
    ) -> QuantitiesByName:
        """Replace the quantity that is zero on the whole curve by NaN."""
        name = self.continuation_problem.test_name
        return quantities | {name: np.full(len(owners), np.nan)}

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        return (quantities["outcome"] == Outcome.STEPPED) & ~(quantities[RANGE_EDGE] <= 0.0)


def continue_walker_special_point(
    walker: AbstractWalker,
    params: Any,
    name: str,
    parameters: Any,
    bounds: Any,
    gait: Any,
    options: ArclengthOptions | None,
    step_options: StepOptions | None,
    margins: MarginFunctions | None,
) -> SpecialPointCurve:
    """Return the curve of `continue_special_point` for a walker of the user."""
    check_type("cycle", gait, HybridGait, "give vrw.limit_cycle(params, model=)")
    require_untraced_arguments(
        "vrw.continue_special_point", "differentiate vrw.limit_cycle", params, gait
    )
    own_margins = declare_margins(walker, margins)
    require_known_name(name, (*BIFURCATIONS, *(margins or {})), "special point or margin")
    if np.any(np.asarray(gait.outcome) != Outcome.STEPPED) or walker.invariants:
        raise ValueError(
            "a curve needs a gait of a walker without invariants, but "
            f"{'the walker has some' if walker.invariants else gait.why}: give another gait."
        )
    find_leaf = functools.partial(find_tree_parameter, params)
    names, limits, options, step_options = check_curve_arguments(
        parameters, bounds, find_leaf, {}, options, step_options
    )
    start_values = [jax.tree.leaves(params)[find_leaf(name)] for name in names]
    for parameter_name, value, (lower, upper) in zip(names, start_values, limits, strict=True):
        if np.ndim(value) or not lower <= value <= upper:
            raise ValueError(
                f"{parameter_name} is {value}, but the curve is traced from a gait with one value "
                f"within the bounds: give one in [{lower:g}, {upper:g}]."
            )
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)
    find_on_branch = lambda i: [
        (point.name, point.value, (i, point))
        for point in continue_hybrid_branch(
            walker, params, names[i], limits[i], gait, 1, step_options, None, margins, None, ()
        ).special_points
    ]
    values = np.array(start_values, float)
    i, start = find_nearest_points((name,), names, values, find_on_branch)[name]
    values[i] = start.value

    def map_section_state(params: Any, x: Array, values: Array) -> Array:
        for i, parameter_name in enumerate(names):
            params = replace_tree_parameter(params, parameter_name, values[i])
        return make_return_map(walker, params, step_options)(x)

    def map_by_first(values: Array, x: Array, first: Array) -> Array:
        return map_section_state(params, x, values.at[0].set(first))

    x = np.asarray(start.point.section_state)
    units = estimate_state_units(map_by_first, jnp.asarray(values), x, values[0], limits[0])
    problem = MapProblem(map_section_state, tuple(units.tolist()))
    params_batch = select_tree_rows(params, None)
    first_bounds = np.array(limits[0])
    gaits = HybridContinuation(
        problem, options, params_batch, first_bounds, units, walker=walker, name=names[0],
        period_n=1, step_options=step_options, margins=own_margins, measures=(),
        component_units=(),
    )  # fmt: skip
    curve_problem = WalkerCurveProblem(
        second_bounds=limits[1], gaits=gaits, map_problem=problem, second_name=names[1],
        test_name=name,
    )  # fmt: skip
    fraction = (values[1] - limits[1][0]) / (limits[1][1] - limits[1][0])
    (data,) = continue_and_locate_special_points(
        WalkerCurveContinuation(curve_problem, options, params_batch, first_bounds),
        np.append(fraction, x / units)[None],
        values[:1],
        np.array([True]),
    )
    if data is None:
        raise ValueError(UNTRACED_CURVE_TEXT.format(name, start.value))
    quantities = data.quantities
    columns = {"period": quantities["period"], **{key: quantities[key] for key in margins or {}}}
    dataset = xr.Dataset(
        {"x": (("point", "component"), quantities["x"])}
        | {key: ("point", column) for key, column in columns.items()}
        | make_stability_variables(data.points.return_map_jacobian[:, 1:, 1:]),
        {names[0]: ("point", np.asarray(data.points.p)), names[1]: ("point", quantities["second"])},
        {"title": f"Curve of {name} over {names[0]} and {names[1]}"},
    )
    codim2_points = tuple(
        Codim2Point(
            point.name,
            (point.value, float(curve_problem.compute_second_parameter(point.cycle.z))),
            point.ends_branch,
        )
        for point in data.special_points
        if point.name != RANGE_EDGE
    )
    return SpecialPointCurve(name, names, dataset, codim2_points, data.end_reasons)


def check_curve_arguments(
    parameters: Any,
    bounds: Any,
    check_name: Callable[[str], object],
    default_bounds: Mapping[str, tuple[float, float]],
    options: ArclengthOptions | None,
    step_options: StepOptions | None,
) -> tuple[tuple[str, str], list[tuple[float, float]], ArclengthOptions, StepOptions]:
    """Return the names of two parameters, their bounds, and the options, or raise an error.

    - `check_name`: function that raises an error for the name of no parameter.
    """
    names = check_names("parameters", parameters)
    if len(set(names)) != 2 or len(names) != 2:
        raise ValueError(
            f"parameters are {names}, but a curve needs two different ones: write ('damping', "
            "'slope'), say."
        )
    check_type("bounds", bounds, (Mapping, type(None)), "write {'damping': (100.0, 200.0)}")
    limits = {**default_bounds, **(bounds or {})}
    for name in (*limits, *names):
        check_name(name)
        if name not in limits:
            raise ValueError(f"bounds has no {name!r}: give (lower, upper) of each parameter.")
        limits[name] = check_range(f"bounds[{name!r}]", limits[name])
    options = check_arclength_options(options, DEFAULT_CURVE_OPTIONS)
    step_options = StepOptions.tight() if step_options is None else step_options
    check_type("step_options", step_options, StepOptions, "give vrw.StepOptions()")
    first, second = names
    return (first, second), [limits[first], limits[second]], options, step_options


UNTRACED_CURVE_TEXT = (
    "special point {} at {:.9g} can't be continued: give a gait nearer to the special point."
)


def find_nearest_points(
    names: Sequence[str],
    parameters: tuple[str, str],
    start_values: Any,
    find_on_branch: Callable[[int], list],
) -> dict[str, Any]:
    """Return the special points nearest to a gait by name, or raise an error.

    They are on a branch in the first parameter, or else on one in the second.

    - `start_values`: values of both parameters at the gait;
    - `find_on_branch`: function of the index of a parameter that returns the name, the value of the
      parameter and data of each special point on the branch.
    """
    nearest: dict[str, Any] = {}
    for i, start_value in enumerate(start_values):
        if not nearest.keys() >= {*names}:
            # The nearest point of each name comes last and replaces the others.
            found = sorted(find_on_branch(i), key=lambda x: -abs(x[1] - start_value))
            nearest = {name: point for name, _, point in found} | nearest
    for name in sorted({*names} - nearest.keys()):
        raise ValueError(
            f"no special point {name!r} on branches along {' and '.join(parameters)} within their "
            f"bounds (found: {', '.join(sorted(nearest)) or 'none'}): give a gait nearer to it, or "
            "wider bounds."
        )
    return nearest

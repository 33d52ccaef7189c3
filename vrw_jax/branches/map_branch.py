"""Continue branches of fixed points of any map, and of gaits of any walker, with all their
bifurcations.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_callable,
    check_int,
    check_range,
    check_real,
    check_reals,
    check_type,
    require_no_masked_entries,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions, find_tree_parameter
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import Measure, Outcome, measure, select_measures
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.small_matrices import compute_multipliers
from vrw_jax.base.walker import (
    AbstractWalker,
    check_one_walker,
    name_coordinates,
    step_batch_of_walker,
)
from vrw_jax.branches.arclength import (
    POINT_BATCH_SIZES,
    ArclengthOptions,
    ContinuationPoint,
    MapProblem,
    QuantitiesByName,
)
from vrw_jax.branches.branch import (
    BIFURCATIONS,
    BRANCH_POINT,
    PERIOD_DOUBLING,
    Branch,
    SpecialPoint,
    TestFunction,
)
from vrw_jax.branches.branch_continuation import (
    ADMISSIBILITY,
    BORDER_COLLISION,
    EVENT_ORDER,
    MODULI,
    Continuation,
)
from vrw_jax.branches.branch_location import BranchData, continue_and_locate_special_points
from vrw_jax.branches.continuation_problems import BranchWheel, ReturnMapProblem, number_rows
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.gaits.fixed_points import (
    UNIT_MULTIPLIER_ADVICE,
    check_state_units,
    check_vector_map,
    count_unit_multipliers,
    estimate_state_units,
)
from vrw_jax.gaits.gait_search import limit_cycle
from vrw_jax.gaits.walker_finder import HybridGait, find_walker_gaits, parameterize_walker
from vrw_jax.lanes.batching import map_in_numpy_batches, select_tree_rows
from vrw_jax.models.measures import make_labeled_variables

DEFAULT_OPTIONS = ArclengthOptions()


def check_arclength_options(
    options: ArclengthOptions | None, default: ArclengthOptions = DEFAULT_OPTIONS
) -> ArclengthOptions:
    """Check the options of a continuation, and return them, or the default if they are None."""
    options = default if options is None else options
    check_type("options", options, ArclengthOptions, "give vrw.ArclengthOptions()")
    return options


def make_stability_variables(return_map_jacobians: np.ndarray) -> dict[str, xr.Variable]:
    """Build labeled variables with the multipliers and the stability measures at each point of a
    branch.
    """
    multipliers = compute_multipliers(return_map_jacobians)
    spectral_radius = np.max(np.abs(multipliers), -1)
    parts = {
        "multiplier_real": (multipliers.real, "real part of a multiplier"),
        "multiplier_imag": (multipliers.imag, "imaginary part"),
    }
    return {
        name: xr.Variable(("point", "multiplier"), part, {"units": "1", "long_name": long_name})
        for name, (part, long_name) in parts.items()
    } | make_labeled_variables(
        {"spectral_radius": spectral_radius, "spectral_margin": 1.0 - spectral_radius}, "point"
    )


def make_branch(
    problem: Any,
    data: BranchData | None,
    name: str,
    params: Any,
    outcome: Outcome,
    failure: str = "",
    dataset_attributes: Mapping | None = None,
) -> Branch:
    """Return the labeled branch of a problem, without points if `data` is None.

    - `failure`: reason for which there are no points, if it is more than the outcome.
    """
    period_n = problem.period_n
    if dataset_attributes is None:
        dataset_attributes = {"title": f"Branch of fixed points along {name}"}
    if data is None:
        empty = xr.Dataset(coords={name: ("point", np.zeros(0))}, attrs=dataset_attributes)
        return Branch(name, empty, (), (failure, failure), outcome, params, period_n)
    variables, coordinates = problem.label(data.quantities)
    dataset = xr.Dataset(
        variables | make_stability_variables(data.points.return_map_jacobian),
        {name: ("point", data.points.p, problem.describe_parameter(name))} | coordinates,
        dataset_attributes,
    )
    ends = data.end_reasons
    points = tuple(dataclasses.replace(x, period_n=period_n) for x in data.special_points)
    return Branch(name, dataset, points, ends, outcome, params, period_n)


@announce_wait("the map and its derivatives", "10 s")
def continue_map(
    function: Callable[[Any, Array, Array], Array],
    x: object,
    p: float,
    bounds: tuple[float, float],
    *,
    constants: Any = (),
    name: str = "parameter",
    units: Any = None,
    options: ArclengthOptions | None = None,
    switch_at: SpecialPoint | None = None,
) -> Branch:
    """Continue the branch of fixed points through (x, p) for a map x -> `function(constants, x,
    p)`.

    The map must be differentiable in forward mode, and return NaN where it is undefined.
    Bifurcations are located as in `continue_branch`, to 1e-9 of the range between the bounds. The
    start may be a fold or a crossing of branches.

    Args:
        function: `function(constants, x, p)`, which returns an array of the shape of `x`.
        x: a fixed point or a state near one, shape (n,).
        p: value of the parameter at `x`.
        bounds: lower and upper bound of the parameter.
        constants: any pytree, passed to the function.
        name: name of the parameter in the result.
        units: units of the components of `x`, a number or shape (n,), in which continuation steps
            are measured. By default, the unit of a component is its size at the start, or the size
            of its change within the bounds if it is larger.
        options: `ArclengthOptions` of the branch.
        switch_at: a branch point or period doubling of the branch through (x, p), or of one that
            was switched to, at which the other branch begins: that which crosses there, to both
            sides, or that of twice the number of iterates.

    Returns:
        A `Branch`: the fixed points, their stability, the special points, and why the branch ends.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> logistic = lambda _, x, r: r * x * (1.0 - x)
        >>> branch = vrw.continue_map(logistic, [0.6], 2.5, (2.0, 3.5))
        >>> [(point.kind, round(point.value, 6)) for point in branch.special_points]
        [('period_doubling', 3.0)]
        >>> doubled = vrw.continue_map(
        ...     logistic, [0.6], 2.5, (2.0, 3.5), switch_at=branch.special_points[0]
        ... )
        >>> print(f"{doubled.special_points[0].value:.6f}")
        3.449490
    """
    check_callable("function", function, "of constants, x and p")
    require_untraced_arguments("vrw.continue_map", "use vrw.solve_fixed_point", x, p, constants)
    require_no_masked_entries("constants", jax.tree.leaves(constants))
    check_branch_names(name)
    constants = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), constants)
    return trace_fixed_points(
        MapProblem((), function), check_reals("x", x), p, bounds, constants, name, options,
        switch_at, units,
    )  # fmt: skip


SWITCHED_KINDS = {BRANCH_POINT: 1, PERIOD_DOUBLING: 2}
"""Numbers of iterates of the map whose fixed points cross the branch, by the kind of the point."""


def parse_switch_point(
    switch_at: SpecialPoint, units: Any, limits: Any
) -> tuple[int, tuple[np.ndarray, bool]]:
    """Return the period of the switched branch, the tangent of the known branch in the coordinates
    of arc length, and whether the known branch has half the period.
    """
    check_type("switch_at", switch_at, SpecialPoint, "give one of branch.special_points")
    if switch_at.kind not in SWITCHED_KINDS:
        raise ValueError(
            f"switch_at is a {switch_at.kind}, at which no other branch begins: give a "
            "branch_point or a period_doubling."
        )
    tangent = switch_at.point.tangent
    scales = np.append(np.broadcast_to(units, len(tangent) - 1), np.ptp(limits))
    n = SWITCHED_KINDS[switch_at.kind]
    return n * switch_at.period_n, (tangent / scales, n > 1)


NO_START_TEXT = (
    "Newton's method found no fixed point from which the branch could begin: start nearer to one, "
    "or give units=, the typical sizes of the entries of the state."
)

RESERVED_NAMES = {
    *BIFURCATIONS, BRANCH_POINT, MODULI, ADMISSIBILITY, EVENT_ORDER, "closure", "x", "period",
    "outcome", "spectral_radius", "spectral_margin", "multiplier_real", "multiplier_imag",
    "multiplier", "point", "component",
}  # fmt: skip
"""Names in the dataset of a branch that no parameter, margin or measure may have."""


def check_branch_names(*names: str) -> None:
    """Raise an error unless parameters, margins and measures of a branch have names of their
    own.
    """
    for name in names:
        check_type("name", name, str, "give a text")
        if name in RESERVED_NAMES or names.count(name) > 1:
            raise ValueError(
                f"{name!r} names a parameter, margin or measure of the branch, but is also the "
                "name of another quantity in its dataset: rename it."
            )


def trace_fixed_points(
    problem: MapProblem | ReturnMapProblem,
    x: Array,
    p: Any,
    bounds: Any,
    args: Any,
    name: str,
    options: ArclengthOptions | None,
    switch_at: SpecialPoint | None,
    units: Any = None,
    params: Any = None,
) -> Branch:
    """Return the branch of the fixed points of a map through (x, p), or of one that crosses it.

    - `problem`: the problem in any units;
    - `args`: the other inputs of the map.
    """
    lower_bound, upper_bound = limits = check_range("bounds", bounds)
    p = float(check_real("p", p))
    if not lower_bound <= p <= upper_bound:
        raise ValueError(
            f"{name} starts at {p:g}, but the branch must start within its bounds: give one in "
            f"[{lower_bound:g}, {upper_bound:g}]."
        )
    options = check_arclength_options(options)
    evaluate = lambda x, p: problem.function(args, x, p)
    check_vector_map(lambda x: evaluate(x, jnp.asarray(p, float)), "x", x)
    if options.tolerance < (eps := float(jnp.finfo(x.dtype).eps)):
        raise ValueError(
            f"the numbers are {x.dtype.name}, in which corrections do not fall to "
            f"{options.tolerance:g}: call vrw.start_jax() before anything else, or give "
            f"options=vrw.ArclengthOptions(tolerance={100.0 * eps:.0e})."
        )
    if units is None:
        units = estimate_state_units(problem.function, args, np.asarray(x), p, limits)
    units = tuple(np.asarray(check_state_units(units, x)).tolist())
    problem = dataclasses.replace(problem, units=units)
    start, start_p = np.asarray(x), p
    crossing: Any = ()
    if switch_at is not None:
        period_n, crossing = parse_switch_point(switch_at, problem.section_units, limits)
        problem = dataclasses.replace(problem, period_n=period_n)
        start, start_p, *_ = switch_at.point
    (data,) = continue_and_locate_special_points(
        Continuation(problem, options, np.array(limits), select_tree_rows(args, None), *crossing),
        (start / problem.section_units)[None],
        np.array([start_p], float),
        np.array([True]),
    )
    failure = ""
    if data is None:
        start_jacobian = jax.jacfwd(evaluate)(x, jnp.asarray(p, float))
        is_singular = count_unit_multipliers(np.asarray(start_jacobian)) > 0
        failure = UNIT_MULTIPLIER_ADVICE if is_singular else NO_START_TEXT
    outcome = Outcome.STEPPED if data else Outcome.NO_CYCLE_FOUND
    return make_branch(problem, data, name, params, outcome, failure)


def continue_walker_branch(
    walker: AbstractWalker,
    params: Any,
    name: str,
    bounds: Any,
    gait: Any,
    period_n: int,
    options: ArclengthOptions | None,
    step_options: StepOptions | None,
    margins: Any,
    measures: Any,
    switch_at: SpecialPoint | None,
) -> Branch:
    """Return the branch of `continue_branch` for a walker of the user."""
    if gait is None:
        gait = limit_cycle(params, model=walker, period_n=period_n, options=step_options)
    check_type("cycle", gait, HybridGait, "give vrw.limit_cycle(params, model=, guess=)")
    period_n = math.lcm(check_int("period_n", period_n), int(gait.period_n))
    problem, wheel = make_walker_problem(
        walker, params, (name,), gait, period_n, step_options, margins, measures
    )
    if not gait.found:
        return make_branch(problem, None, name, params, Outcome(int(gait.outcome)), gait.why)
    value = float(wheel.values[problem.parameter_indices[0]])
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)
    return trace_fixed_points(
        problem, gait.section_state, value, bounds, wheel, name, options, switch_at, params=params
    )


MarginFunctions = Mapping[str, Callable[[Array, Any], Array]]
"""Functions of state and parameters by name, which are positive in admissible gaits."""


MODE_DURATION = "longest_mode_duration"
"""Name of the longest time in one mode in a step."""

PHASE_TIME_TOLERANCE = 1e-3
"""Relative distance from the longest allowed time of a mode below which this time ends a branch.
The value is chosen because the last continuation step is far shorter.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class WalkerProblem(ReturnMapProblem):
    """Continuation problem of the gaits of a walker of the user.

    - `margins`: measures that are minima over the gait and have special points at their zeros.
    """

    margins: tuple[Measure, ...] = ()

    may_start_singular: ClassVar[bool] = True
    location_unit: ClassVar[float | None] = None

    @property
    def test_functions(self) -> dict[str, TestFunction]:  # type: ignore[override]
        return {
            **BIFURCATIONS,
            EVENT_ORDER: TestFunction("order_of_events_changes", is_stepwise=True),
            **{margin.name: TestFunction(BORDER_COLLISION) for margin in self.margins},
        }

    def make_point_reader(self, wheel: BranchWheel, point: ContinuationPoint) -> Callable:
        walker, params = self.split_parameters(self.replace_parameters(wheel, point.p))
        # A partial call can be pickled.
        return functools.partial(
            find_walker_gaits, walker, params, self.section_units * point.z, self.period_n,
            self.step_options,
        )  # fmt: skip

    def measure(self, wheels: BranchWheel, points: ContinuationPoint) -> QuantitiesByName:
        states, options = self.section_units * points.z, self.step_options
        walker, params = self.split_parameters(self.replace_parameters(wheels, points.p))
        quantities = {"x": states, "period": np.zeros(len(states))}
        quantities |= {own.name: np.zeros(len(states)) for own in self.own_measures}
        quantities |= {margin.name: np.full(len(states), np.inf) for margin in self.margins}
        measures = (*self.margins, *self.own_measures)
        codes, outcome = [], np.full(len(states), int(Outcome.STEPPED))
        longest = np.zeros(len(states))
        for _ in range(self.period_n):
            step = step_batch_of_walker(walker, params, states, options)
            quantities["period"] = quantities["period"] + step.duration
            values = {}
            if measures:
                values = map_in_numpy_batches(
                    functools.partial(_measure_steps, walker, measures, options),
                    POINT_BATCH_SIZES, params, states, step,
                )  # fmt: skip
            for own in self.own_measures:
                quantities[own.name] += values[own.name] / self.period_n
            for margin in self.margins:
                has_mode = step.mode_durations[:, walker.find_modes(margin)].sum(1) > 0.0
                minimum = np.where(has_mode, values[margin.name], np.inf)
                quantities[margin.name] = np.minimum(quantities[margin.name], minimum)
            if isinstance(walker, HybridSystem):
                codes.append(np.column_stack([step.n_events, step.events]))
                longest = np.fmax(longest, step.mode_durations.max(1))
            outcome = np.where(outcome == Outcome.STEPPED, step.outcome, outcome)
            states = step.section_state
        for margin in self.margins:
            quantities[margin.name][outcome != Outcome.STEPPED] = np.nan
        return quantities | {
            EVENT_ORDER: number_rows(np.concatenate([np.zeros((len(states), 1)), *codes], 1)),
            "outcome": outcome,
            MODE_DURATION: longest,
        }

    def explain_stalled_end(self, quantities: QuantitiesByName) -> str:
        limit = float(self.step_options.max_phase_time)
        (duration,) = quantities[MODE_DURATION]
        if abs(duration / limit - 1.0) > PHASE_TIME_TOLERANCE:
            return ""
        return (
            f"Beyond it, no guard ends the mode within StepOptions.max_phase_time ({limit:g} s): "
            "give step_options with a longer time."
        )

    def label(self, quantities: QuantitiesByName) -> tuple[dict, dict]:
        x = quantities["x"]
        variables: dict[str, Any] = {"x": (("point", "component"), x)}
        variables["period"] = ("point", quantities["period"], {"units": "s"})
        for own in (*self.margins, *self.own_measures):
            variables[own.name] = ("point", quantities[own.name], own.variable_attributes)
        walker = self.model.walker
        if not walker.coordinates:
            return variables, {}
        units = name_coordinates(walker, x.shape[-1])
        components = {
            "component": list(units),
            "component_unit": ("component", list(units.values())),
        }
        return variables, components


@eqx.filter_jit
def _measure_steps(
    walker: AbstractWalker,
    measures: tuple[Measure, ...],
    options: StepOptions,
    params: Any,
    x: Array,
    steps: Any,
) -> dict[str, Array]:
    evaluate = lambda params, x, step: walker.measure_step(params, x, step, options, measures)
    return jax.vmap(evaluate)(params, x, steps)


def declare_margins(walker: Any, margins: MarginFunctions | None) -> tuple[Measure, ...]:
    """Return margins of a walker as measures, whose minima are taken, or raise an error."""
    check_type("margins", margins, (Mapping, type(None)), "give a dictionary of functions by name")
    if margins and not isinstance(walker, HybridSystem):
        raise ValueError(
            f"margins are minima over the motion, which a {type(walker).__name__} does not define: "
            "give a vrw.HybridSystem, or leave them out."
        )
    declared = []
    for name, margin in (margins or {}).items():
        check_callable(f"margin {name!r}", margin, "of state and parameters")
        if not isinstance(margin, Measure):
            margin = measure(name, phase=tuple(walker.modes), reduction="min")(margin)
        elif margin.reduction != "min":
            raise ValueError(
                f"margin {name!r} is a measure with reduction={margin.reduction!r}, but a margin "
                'is a minimum: declare it with reduction="min".'
            )
        declared.append(dataclasses.replace(margin, name=name))
    return tuple(declared)


def make_walker_problem(
    walker: AbstractWalker,
    params: Any,
    names: tuple[str, ...],
    gait: HybridGait,
    period_n: int,
    step_options: StepOptions | None,
    margins: MarginFunctions | None,
    measures: Any = (),
) -> tuple[WalkerProblem, BranchWheel]:
    """Return the problem of the gaits of a walker in any units, and its parameters, or raise an
    error.
    """
    measures = select_measures(measures, walker.measures)
    own_margins = declare_margins(walker, margins)
    check_branch_names(*names, *(own.name for own in (*own_margins, *measures)))
    if isinstance(walker, HybridSystem):
        for own in (*measures, *own_margins):
            walker.find_modes(own)
    x = gait.section_state
    name_coordinates(walker, np.shape(x)[-1])
    step_options = StepOptions() if step_options is None else step_options
    check_type("step_options", step_options, StepOptions, "give vrw.StepOptions()")
    params = check_one_walker(params)
    model = parameterize_walker(walker, params)
    for name in names:
        find_tree_parameter(params, name)
    conserved = np.ravel(walker.evaluate_invariants(params, x)) if walker.invariants else None
    problem = WalkerProblem(
        (), model=model, step_options=step_options, continued_names=names,
        period_n=check_int("period_n", period_n), conserved_values=conserved, margins=own_margins,
        own_measures=measures,
    )  # fmt: skip
    return problem, BranchWheel(np.asarray(model.collect_parameter_values(params)))

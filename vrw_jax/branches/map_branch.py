"""Continue branches of fixed points of any map, and of gaits of any walker, with all their
bifurcations.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
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
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.measures import Measure, measure, select_measures
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.parameters import (
    find_tree_parameter,
    list_tree_parameters,
    replace_tree_parameter,
)
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import (
    AbstractWalker,
    check_one_walker,
    make_return_map,
    name_coordinates,
    step_batch_of_walker,
)
from vrw_jax.branches.abstract_continuation import (
    BORDER_COLLISION,
    EVENT_ORDER,
    AbstractContinuation,
    QuantitiesByName,
)
from vrw_jax.branches.arclength import (
    ArclengthOptions,
    ContinuationPoint,
    ContinuationStatus,
    NewtonStep,
    Track,
    run_together,
)
from vrw_jax.branches.branch import (
    BIFURCATIONS,
    BRANCH_POINT,
    PERIOD_DOUBLING,
    Branch,
    FixedPoint,
    SpecialPoint,
    TestFunction,
    compute_multipliers,
)
from vrw_jax.branches.branch_location import continue_and_locate_special_points
from vrw_jax.branches.continuation_problems import POINT_BATCH_SIZES, MapProblem, number_rows
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.gaits.fixed_points import (
    UNIT_MULTIPLIER_ADVICE,
    check_state_units,
    check_vector_map,
    count_unit_multipliers,
    estimate_state_units,
)
from vrw_jax.gaits.walker_finder import HybridGait, find_walker_gaits
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


MAX_START_DISTANCE_FACTOR = 10.0
"""Largest distance of a regular start from a singular start, as a multiple of the first
continuation step. The value is chosen because branches may cross at small angles.
"""

MIN_SINGULAR_VALUE = 1e-9
"""Relative singular value of the equations below which a tangent has few accurate digits."""


def are_equations_regular(return_map_jacobian: np.ndarray) -> bool:
    """Return whether the tangent of a branch is determined at a fixed point."""
    if not np.isfinite(return_map_jacobian).all():
        return False
    equations = np.eye(len(return_map_jacobian)) - return_map_jacobian
    singular_values = np.linalg.svd(equations, compute_uv=False)
    return bool(singular_values[-1] > MIN_SINGULAR_VALUE * max(1.0, singular_values[0]))


@dataclass(frozen=True)
class AbstractMapContinuation(AbstractContinuation):
    """Base class of continuations of the fixed points of maps.

    - `state_units`: units of the components of the state in which points are stored;
    - `crossed_tangent`: tangent of a known branch at the start, which the continued branch crosses.
    """

    state_units: Any = 1.0
    crossed_tangent: np.ndarray | None = None

    measure_attributes: ClassVar[Mapping[str, Mapping[str, str]]] = {}
    """Attributes of the quantities that the dataset of the branch contains, by name."""
    component_units: ClassVar[tuple[tuple[str, str], ...]] = ()
    """Names and units of the components of the state, if they have names."""
    parameter_attributes: ClassVar[Mapping[str, str]] = {"units": "1"}
    """Attributes of the continued parameter in the dataset of the branch."""

    @property
    def parameter_unit(self) -> float:
        return float(np.ptp(self.parameter_bounds))

    def make_fixed_point(self, point: ContinuationPoint) -> FixedPoint:
        section_state, p, jacobian, tangent = super().make_fixed_point(point)
        units = np.broadcast_to(self.state_units, section_state.shape)
        tangent = np.append(units, self.parameter_unit) * tangent
        return FixedPoint(units * section_state, p, units[:, None] * jacobian / units, tangent)

    def continue_in_both_directions(
        self, z: np.ndarray, p: np.ndarray, is_requested: np.ndarray
    ) -> dict[int, list[Track]]:
        """Continue the branch of one map in both directions.

        If the equations are singular at the start, the branch starts at a fixed point next to it.
        """
        if self.crossed_tangent is not None:
            start = self._find_crossing_branch(z[0], p[0], self.crossed_tangent)
            if start is None:
                return {}
            tracks = self.continue_branches(
                np.array([0]), start.z[None], np.array([start.p]), np.sign([start.fraction_rate])
            )
            return {0: [Track([], ContinuationStatus.BRANCH_SWITCHED), *tracks]}
        tracks_by_owner = super().continue_in_both_directions(z, p, is_requested)
        points = tracks_by_owner[0][0].points
        if points and are_equations_regular(points[0].return_map_jacobian):
            return tracks_by_owner
        start = self._find_regular_start(z, p)
        if start is None:
            return {}
        return super().continue_in_both_directions(start.z[None], np.array([start.p]), is_requested)

    def _find_crossing_branch(
        self, z: np.ndarray, p: float, tangent: np.ndarray
    ) -> ContinuationPoint | None:
        """Find a fixed point on the branch that crosses that with the given tangent at (z, p).

        At the crossing, the linear equations have two solutions. The search is on planes across the
        one that is perpendicular to the tangent of the known branch.
        """
        tangent = tangent / np.linalg.norm(tangent)
        step = NewtonStep(
            *map(
                np.asarray, self.continuation_problem.linearize(self.wheels, z[None], np.array([p]))
            )
        )
        equations = np.eye(len(z)) - step.return_map_jacobian[0]
        by_fraction = equations @ (self.driver.parameter_range * step.branch_tangent[0])
        extended = np.nan_to_num(np.column_stack([equations, -by_fraction]))
        null_space = np.linalg.svd(extended)[2][-2:]
        direction = null_space.T @ np.array([[0.0, 1.0], [-1.0, 0.0]]) @ (null_space @ tangent)
        distance = self.arclength_options.initial_ds
        normal = distance * direction / np.linalg.norm(direction)
        center = self.driver.coordinates(z, self.driver.compute_fraction(p))
        targets = [
            (center + sign * normal + offset * distance * tangent, sign * normal)
            for sign in (1.0, -1.0)
            for offset in (0.0, 1.0, -1.0)
        ]
        return self._find_near(z, targets)

    def _find_near(
        self, z: np.ndarray, targets: Sequence[tuple[np.ndarray, np.ndarray]]
    ) -> ContinuationPoint | None:
        """Return the first regular fixed point near z on planes with given points and normals."""
        tasks = [
            self.driver.solve_on_plane(self.wheels, point[:-1], point[-1], (point, normal))
            for point, normal in targets
        ]
        lower_bound, upper_bound = self.parameter_bounds
        max_distance = MAX_START_DISTANCE_FACTOR * self.arclength_options.initial_ds
        for point, is_found in run_together(
            self.continuation_problem, self.wheels, [0] * len(tasks), tasks
        ):
            if (
                is_found
                and np.abs(point.z - z).max() <= max_distance
                and lower_bound <= point.p <= upper_bound
                and are_equations_regular(point.return_map_jacobian)
            ):
                return point
        return None

    def _find_regular_start(self, z: np.ndarray, p: np.ndarray) -> ContinuationPoint | None:
        """Find a fixed point next to a start at which the equations are singular.

        Each search is in a plane whose distance from the start is about that of the first
        continuation step. A branch that turns at the start does not cross all planes. Return None
        if no plane contains a fixed point near the start.
        """
        problem, distance = self.continuation_problem, self.arclength_options.initial_ds
        jacobian = np.asarray(problem.linearize(self.wheels, z, p).return_map_jacobian)[0]
        singular_direction = np.linalg.svd(np.eye(z.shape[-1]) - np.nan_to_num(jacobian))[2][-1]
        start = self.driver.coordinates(z[0], self.driver.compute_fraction(p[0]))
        # Along one branch through a crossing, the state may be constant.
        normals = [
            distance * self.driver.coordinates(state_part * singular_direction, parameter_part)
            for state_part, parameter_part in itertools.product((0.0, 0.5, -0.5), (1.0, -1.0))
        ]
        return self._find_near(z[0], [(start + normal, normal) for normal in normals])


@dataclass(frozen=True)
class MapContinuation(AbstractMapContinuation):
    """Continuation of the fixed points of any map. All finite fixed points are admissible."""

    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> QuantitiesByName:
        return {"x": self.state_units * self.continuation_problem.section_state(points.z)}


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
        switch_at: a branch point or period doubling of the branch through (x, p), at which the
            other branch begins: that which crosses there, or that of the second iterate.

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
    return trace_map_branch(
        MapContinuation, function, x, p, bounds, constants, name, units, options, switch_at
    )


SWITCHED_KINDS = {BRANCH_POINT: 1, PERIOD_DOUBLING: 2}
"""Numbers of iterates of the map whose fixed points cross the branch, by the kind of the point."""


def iterate_map(function: Callable, n_iterates: int) -> Callable:
    """Return the iterate of a map x -> `function(constants, x, p)`."""

    def iterate(constants: Any, x: Array, p: Array) -> Array:
        for _ in range(n_iterates):
            x = function(constants, x, p)
        return x

    return function if n_iterates == 1 else iterate


def trace_map_branch(
    make_continuation: Callable[..., AbstractMapContinuation],
    function: Callable,
    x: Any,
    p: Any,
    bounds: Any,
    constants: Any,
    name: str,
    units: Any,
    options: ArclengthOptions | None,
    switch_at: SpecialPoint | None,
) -> Branch:
    """Return the branch of `continue_map`, whose points `make_continuation` measures."""
    lower_bound, upper_bound = check_range("bounds", bounds)
    if not lower_bound <= check_real("p", p) <= upper_bound:
        raise ValueError(
            f"p is {p:g}, but the branch must start within its bounds: give one in "
            f"[{lower_bound:g}, {upper_bound:g}]."
        )
    options, x = check_arclength_options(options), check_reals("x", x)
    require_no_masked_entries("constants", jax.tree.leaves(constants))
    constants = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), constants)
    check_vector_map(lambda x: function(constants, x, jnp.asarray(p, float)), "x", x)
    state_units = (
        estimate_state_units(function, constants, np.asarray(x), p, (lower_bound, upper_bound))
        if units is None
        else np.asarray(check_state_units(units, x))
    )
    state_units = np.broadcast_to(state_units, x.shape)
    start, start_p, tangent, n_iterates = np.asarray(x), p, None, 1
    if switch_at is not None:
        check_type("switch_at", switch_at, SpecialPoint, "give one of branch.special_points")
        if switch_at.kind not in SWITCHED_KINDS:
            raise ValueError(
                f"switch_at is a {switch_at.kind}, at which no other branch begins: give a "
                "branch_point or a period_doubling."
            )
        n_iterates = SWITCHED_KINDS[switch_at.kind]
        start, start_p, _, tangent = switch_at.point
        tangent = tangent / np.append(state_units, upper_bound - lower_bound)
    continuation = make_continuation(
        MapProblem(iterate_map(function, n_iterates), tuple(state_units.tolist())),
        options,
        select_tree_rows(constants, None),
        np.array([lower_bound, upper_bound]),
        state_units,
        tangent,
    )
    (branch_data,) = continue_and_locate_special_points(
        continuation,
        (start / state_units)[None],
        np.array([start_p], float),
        np.array([True]),
    )
    if branch_data is None:
        empty_dataset = xr.Dataset(coords={name: ("point", np.zeros(0))})
        start_jacobian = jax.jacfwd(function, 1)(constants, x, jnp.asarray(p, float))
        is_singular = count_unit_multipliers(np.asarray(start_jacobian)) > 0
        reasons = (UNIT_MULTIPLIER_ADVICE if is_singular else "",) * 2
        return Branch(name, empty_dataset, (), reasons, Outcome.NO_CYCLE_FOUND)
    quantities = branch_data.quantities
    units = dict(continuation.component_units)
    components = {
        "component": list(units),
        "component_unit": ("component", list(units.values())),
    }
    dataset = xr.Dataset(
        {
            "x": (("point", "component"), quantities["x"]),
            **{
                measure: ("point", quantities[measure], attributes)
                for measure, attributes in continuation.measure_attributes.items()
            },
        }
        | make_stability_variables(branch_data.points.return_map_jacobian),
        {name: ("point", branch_data.points.p, continuation.parameter_attributes)}
        | (components if units else {}),
        {"title": f"Branch of fixed points along {name}"},
    )
    return Branch(
        name, dataset, branch_data.special_points, branch_data.end_reasons, Outcome.STEPPED
    )


MarginFunctions = Mapping[str, Callable[[Array, Any], Array]]
"""Functions of state and parameters by name, which are positive in admissible gaits."""


@dataclass(frozen=True)
class HybridContinuation(AbstractMapContinuation):
    """Continuation of the gaits of a walker, with margins and, if known, the order of events."""

    _: KW_ONLY
    walker: Any  # an AbstractWalker
    name: str  # of the continued parameter
    period_n: int
    step_options: StepOptions
    margins: tuple[Measure, ...]
    measures: tuple[Measure, ...]
    component_units: tuple[tuple[str, str], ...]  # type: ignore[misc]

    @property
    def test_functions(self) -> dict[str, TestFunction]:  # type: ignore[override]
        return {
            **BIFURCATIONS,
            EVENT_ORDER: TestFunction(
                "order_of_events_changes", "Events change their order.", is_stepwise=True
            ),
            **{
                margin.name: TestFunction(BORDER_COLLISION, "A margin vanishes.")
                for margin in self.margins
            },
        }

    @property
    def measure_attributes(self) -> dict[str, Mapping[str, str]]:  # type: ignore[override]
        return {
            "period": {"units": "s"},
            **{own.name: own.variable_attributes for own in (*self.margins, *self.measures)},
        }

    @property
    def parameter_attributes(self) -> dict[str, str]:  # type: ignore[override]
        domain = {x.name: x.domain for x in list_tree_parameters(self.wheels)}[self.name]
        return {"units": domain.unit, "symbol": domain.symbol}

    def make_point_reader(self, owner: int, point: ContinuationPoint) -> Callable:
        params = replace_tree_parameter(
            jax.tree.map(lambda leaf: leaf[owner], self.wheels), self.name, float(point.p)
        )
        # A partial call can be pickled.
        return functools.partial(
            find_walker_gaits,
            self.walker,
            params,
            self.state_units * point.z,
            self.period_n,
            self.step_options,
        )

    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> QuantitiesByName:
        states, walker, options = self.state_units * points.z, self.walker, self.step_options
        params = replace_tree_parameter(wheels, self.name, points.p)
        quantities = {"x": states, "period": np.zeros(len(states))}
        quantities |= {own.name: np.zeros(len(states)) for own in self.measures}
        quantities |= {margin.name: np.full(len(states), np.inf) for margin in self.margins}
        own_measures = (*self.margins, *self.measures)
        codes, outcome = [], np.full(len(states), int(Outcome.STEPPED))
        for _ in range(self.period_n):
            step = step_batch_of_walker(walker, params, states, options)
            quantities["period"] = quantities["period"] + step.duration
            values = {}
            if own_measures:
                values = map_in_numpy_batches(
                    functools.partial(_measure_steps, walker, own_measures, options),
                    POINT_BATCH_SIZES, params, states, step,
                )  # fmt: skip
            for own in self.measures:
                quantities[own.name] += values[own.name] / self.period_n
            for margin in self.margins:
                has_mode = step.mode_durations[:, walker.find_modes(margin)].sum(1) > 0.0
                minimum = np.where(has_mode, values[margin.name], np.inf)
                quantities[margin.name] = np.minimum(quantities[margin.name], minimum)
            if isinstance(walker, HybridSystem):
                codes.append(np.column_stack([step.n_events, step.events]))
            outcome = np.where(outcome == Outcome.STEPPED, step.outcome, outcome)
            states = step.section_state
        return quantities | {
            EVENT_ORDER: number_rows(np.concatenate([np.zeros((len(states), 1)), *codes], 1)),
            "outcome": outcome,
        }

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        return quantities["outcome"] == Outcome.STEPPED


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


def continue_hybrid_branch(
    walker: AbstractWalker,
    params: Any,
    name: str,
    bounds: tuple[float, float],
    gait: HybridGait,
    period_n: int,
    step_options: StepOptions | None,
    options: ArclengthOptions | None,
    margins: MarginFunctions | None,
    switch_at: SpecialPoint | None,
    measures: Any,
) -> Branch:
    """Return the branch of `continue_branch` for a walker of the user."""
    measures = select_measures(measures, walker.measures)
    own_margins = declare_margins(walker, margins)
    if isinstance(walker, HybridSystem):
        for own in (*measures, *own_margins):
            walker.find_modes(own)
    coordinates = (
        name_coordinates(walker, np.shape(gait.section_state)[-1]) if walker.coordinates else {}
    )
    check_int("period_n", period_n)
    step_options = StepOptions() if step_options is None else step_options
    check_type("step_options", step_options, StepOptions, "give vrw.StepOptions()")
    n_periods = SWITCHED_KINDS.get(switch_at.kind, 1) if isinstance(switch_at, SpecialPoint) else 1
    params = check_one_walker(params)
    start_value = float(jax.tree.leaves(params)[find_tree_parameter(params, name)])
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)

    def map_section_state(params: Any, x: Array, value: Array) -> Array:
        step_params = replace_tree_parameter(params, name, value)
        take_step = make_return_map(walker, step_params, step_options)
        for _ in range(period_n):
            x = take_step(x)
        return x

    branch = trace_map_branch(
        functools.partial(
            HybridContinuation, walker=walker, name=name, period_n=n_periods * period_n,
            step_options=step_options, margins=own_margins, measures=measures,
            component_units=tuple(coordinates.items()),
        ),
        map_section_state, gait.section_state, start_value, bounds, params, name, None, options,
        switch_at,
    )  # fmt: skip
    return dataclasses.replace(branch, params=params, period_n=n_periods * period_n)

"""Define continuation problems of gaits, and measure the gaits at points of their branches.

`CollocationProblem` is the fastest problem. It solves the collocation equations of the paper's
sequence of phases, with one linearization per Newton iteration. `ContactGaitProblem` uses batches
of gait steps with unilateral contact. `ReturnMapProblem` applies to every walker. It iterates the
gait step of the walker and differentiates it in forward mode.
"""

import functools
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import make_return_map
from vrw_jax.branches.arclength import (
    LOCATION_BATCH_SIZES,
    POINT_BATCH_SIZES,
    AbstractContinuationProblem,
    AbstractStateProblem,
    ContinuationPoint,
    NewtonStep,
    QuantitiesByName,
)
from vrw_jax.branches.branch import BIFURCATIONS, TestFunction
from vrw_jax.branches.branch_continuation import BORDER_COLLISION, EVENT_ORDER, EVENT_ORDER_CHANGE
from vrw_jax.gaits.force_peaks import locate_force_peaks
from vrw_jax.gaits.gait_search import make_finder
from vrw_jax.gaits.gauss import CollocationSolution
from vrw_jax.gaits.limit_cycle_result import evaluate_own_measure, land_foot
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem
from vrw_jax.gaits.unilateral_finder import PeriodMap, solve_linear_systems
from vrw_jax.gaits.wheel_finders import measure_return_map_cycle, measure_return_map_force_peaks
from vrw_jax.lanes.batching import map_in_numpy_batches, select_tree_rows
from vrw_jax.lanes.lane_function import compile_batch_function
from vrw_jax.models.measures import (
    FORCE_PEAK_MEASURES,
    MARGIN_MEASURES,
    MEASURES,
    STEP_MEASURES,
    STOPPER_MARGIN_MEASURES,
    UNILATERAL_STEP_MEASURES,
    describe_parameter,
    make_labeled_variables,
    make_locked_leg_coordinate,
)
from vrw_jax.models.step_results import AbstractStep
from vrw_jax.wheel.params import FRICTION_NAME

FRICTION_SURPLUS = "friction_above_slope"
"""Name of the difference between the friction coefficient and the slope's tangent.

The tangent is the smallest friction coefficient for which a gait exists.
"""

DOUBLE_SUPPORT_INDICATOR_NAMES = ("lambda_I4", "lambda_2_plus", "lambda_4_plus")
PHASE_DURATIONS = ("duration_dls", "duration_sls1", "duration_sls2")
BRANCH_ENDING_QUANTITIES = (*DOUBLE_SUPPORT_INDICATOR_NAMES, *PHASE_DURATIONS)
"""Names of the quantities that end a branch if they vanish, because the order of events changes."""

SECOND_PEAK_RATE_NAME = "second_peak_rate"
"""Name of a measure of the gait's force. If it is zero, a force peak appears inside a phase."""
FORCE_PEAK_COUNT, FORCE_PEAK_COUNT_CHANGE = "n_force_peaks", "number_of_force_peaks_changes"
"""Name of the number of force peaks, and of the special point at which a peak appears or
disappears, at an event or inside a phase.
"""

GAIT_TEST_FUNCTIONS: Mapping[str, TestFunction] = {
    **BIFURCATIONS,
    **dict.fromkeys((*PHASE_DURATIONS, FRICTION_SURPLUS), TestFunction("lost", ends_branch=True)),
    **dict.fromkeys(MARGIN_MEASURES, TestFunction(BORDER_COLLISION)),
    **dict.fromkeys(
        DOUBLE_SUPPORT_INDICATOR_NAMES, TestFunction(BORDER_COLLISION, ends_branch=True)
    ),
    SECOND_PEAK_RATE_NAME: TestFunction(BORDER_COLLISION, explains=FORCE_PEAK_COUNT_CHANGE),
    EVENT_ORDER: TestFunction(EVENT_ORDER_CHANGE, is_stepwise=True),
    FORCE_PEAK_COUNT: TestFunction(FORCE_PEAK_COUNT_CHANGE, is_stepwise=True),
}
"""Test functions of gaits by name."""

LINEAR_MARGIN_SUBSTITUTES: Mapping[str, str] = {"clearance_sls1": "takeoff_acceleration"}
"""Names of margins that vanish as a cube. Each margin is mapped to a quantity that vanishes
linearly at the same point.

A foot that takes off less steeply descends less deeply, until it rises immediately. A solver cannot
resolve the shallowest descents, but the linear quantity changes its sign.
"""


def split_legs(quantities: QuantitiesByName, n_legs: int) -> QuantitiesByName:
    """Return quantities with one for each leg, in addition to margins that have a value per leg."""
    for name, margin in MARGIN_MEASURES.items():
        if margin.leg_dimension and name in quantities:
            quantities |= {
                f"{name}[{leg}]": quantities[name][..., leg - 3] for leg in range(3, n_legs + 1)
            }
    return quantities


MIN_FRICTION_SURPLUS = 1e-9
"""Smallest admissible surplus of friction, as a fraction of the slope's tangent.

The value is chosen to exceed the round-off of friction. If friction equals the tangent, gaits of
every speed repeat.
"""

MEASURES_OUTSIDE_BRANCHES = ("outcome", "solver_steps")
"""Names of measures of the event-driven step that the dataset of a branch does not contain."""


class BranchWheel(NamedTuple):
    """Wheels whose gaits are continued, with a leading axis over wheels.

    The continuation problem replaces the continued parameter in `values`.
    """

    values: np.ndarray  # values of the parameters of the model, in their order
    # 1 if the phase occurs in the cycle, else 0, shape (n, n_phases); () without collocation
    is_phase_active: Any = ()


@dataclass(frozen=True)
class GaitSearch:
    """Picklable search for the gait at a point of a branch, near `guess`."""

    finder: Any
    values: np.ndarray  # values of the parameters of the model
    guess: Any

    def __call__(self) -> Any:
        return self.finder.find_cycle_from_values(*jax.device_put((self.values, self.guess)))


def make_walker(model: Any, values: Any, n_legs: int) -> tuple[Any, Any]:
    """Return a walker, of a user or a wheel, and its parameters with the given values."""
    model, params = model.from_parameter_values(values, n_legs)
    return getattr(model, "walker", model), params


@dataclass(frozen=True, eq=False, kw_only=True)
class AbstractGaitProblem(AbstractContinuationProblem):
    """Continuation problem of gaits in one parameter of the walker, or in several at once.

    Event-driven steps of the model measure the gaits. The unknowns are the section state, unless a
    class defines others.

    - `continued_names`: names of the continued parameters, of which p contains the values.
    """

    model: Any
    step_options: StepOptions
    continued_names: tuple[str, ...]
    period_n: int
    n_legs: int = 0
    measures_force_peaks: bool = False
    own_measures: tuple[Measure, ...] = ()  # of the user

    test_functions: ClassVar[Mapping[str, TestFunction]] = GAIT_TEST_FUNCTIONS
    linear_margin_substitutes: ClassVar[Mapping[str, str]] = LINEAR_MARGIN_SUBSTITUTES
    location_unit: ClassVar[float | None] = 1.0

    @property
    def parameter_indices(self) -> tuple[int, ...]:
        """Return the indices of the continued parameters."""
        return tuple(map(self.model.parameter_names.index, self.continued_names))

    def replace_parameters(self, wheels: BranchWheel, p: Any) -> np.ndarray:
        """Return the parameters of wheels, where the continued ones have the values p."""
        values = np.array(wheels.values)
        values[..., self.parameter_indices] = np.reshape(p, (*values.shape[:-1], -1))
        return values

    def split_parameters(self, values: np.ndarray) -> tuple[Any, Any]:
        """Return the walker and its parameters for rows of values."""
        return make_walker(self.model, tuple(map(jnp.asarray, values.T)), self.n_legs)

    def make_finder(self) -> Any:
        """Return the finder of the gaits of the model."""
        return make_finder(
            self.model, self.n_legs, period_n=self.period_n, step_options=self.step_options
        )

    def make_guess(self, wheel: BranchWheel, z: np.ndarray) -> Any:
        """Return the guess from which a gait is found near the unknowns z."""
        return z

    def make_point_reader(self, wheel: BranchWheel, point: ContinuationPoint) -> Callable:
        return GaitSearch(
            self.make_finder(),
            self.replace_parameters(wheel, point.p),
            self.make_guess(wheel, point.z),
        )

    def linearize_with_quantities(
        self, wheels: BranchWheel, z: np.ndarray, p: np.ndarray, quantity_function: Any
    ) -> tuple[NewtonStep, list]:
        """Return Newton's steps, and the quantities and JVPs of a `GaitQuantityFunction`, if the
        problem can compute them.
        """
        return self.linearize(wheels, z, p), []

    def read_gaits(
        self, wheels: BranchWheel, values: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, QuantitiesByName]:
        """Return section states before the first landing, and the continued quantities by name.

        A continued quantity is defined on both sides of a special point. By default, z is the
        section state, and all quantities are measures of the event-driven step.
        """
        return z, {}

    def take_steps(self, values: np.ndarray, states: np.ndarray) -> Any:
        """Return the event-driven steps of one period, on an axis after that of the gaits."""
        (model, params), steps = self.split_parameters(values), []
        for k in range(self.period_n):
            step_params = model.select_params(params, k)
            steps.append(model.take_steps(step_params, states, self.step_options))
            states = steps[-1].section_state
        return jax.tree.map(lambda *leaves: np.stack(leaves, 1), *steps)

    def measure_steps(
        self, values: np.ndarray, states: np.ndarray, steps: AbstractStep
    ) -> QuantitiesByName:
        """Return further quantities of gaits, which only some models have."""
        return {}

    def measure(self, wheels: BranchWheel, points: ContinuationPoint) -> QuantitiesByName:
        """Return the measures of the gaits at many points by name.

        If a margin has one value per leg, the result contains one quantity for each leg too.
        """
        values = self.replace_parameters(wheels, points.p)
        states, quantities = self.read_gaits(wheels, values, points.z)
        steps = self.take_steps(values, states)
        quantities = {
            **map_in_numpy_batches(_combine_period_measures, POINT_BATCH_SIZES, steps, states),
            **quantities,
            **self.measure_steps(values, states, steps),
            "section_state": states,
        }
        return split_legs(quantities, self.n_legs)

    def describe_parameter(self, name: str) -> dict[str, str]:
        return describe_parameter(name, self.model.parameter_domains[name]).variable_attributes

    def label(self, quantities: QuantitiesByName) -> tuple[dict, dict]:
        measures = STEP_MEASURES | MARGIN_MEASURES | UNILATERAL_STEP_MEASURES | FORCE_PEAK_MEASURES
        variables = make_labeled_variables(
            {
                name: quantities[name]
                for name in measures
                if name in quantities and name not in MEASURES_OUTSIDE_BRANCHES
            },
            "point",
        )
        for own in self.own_measures:
            attributes = own.variable_attributes
            variables[own.name] = xr.Variable("point", quantities[own.name], attributes)
        states, names = quantities["section_state"], ["theta", "dtheta", "dL1"]
        variables["section_state"] = xr.Variable(
            ("point", "component"), states, {"long_name": "section state just before touchdown"}
        )
        variables["closure"] = xr.Variable(
            "point",
            quantities["closure"],
            {"units": "1", "long_name": "miss of the section state after one event-driven period"},
        )
        if states.shape[-1] != len(names):
            legs = range(1, self.n_legs + 1)
            leg_names = [f"{name}{leg}" for name in ("L", "dL", "code") for leg in legs]
            names = ["theta", "dtheta", "vx", "vz", *leg_names]
        return variables, {"component": names, "leg": make_locked_leg_coordinate(self.n_legs)}

    def describe_branch_end(self, end_name: str, parameter_value: float) -> str:
        if end_name != FRICTION_SURPLUS:
            return super().describe_branch_end(end_name, parameter_value)
        return (
            f"At {parameter_value:.9g} the friction coefficient is the tangent of the slope: "
            "with less no contact carries the weight along the slope, and no gait repeats."
        )


SolutionShapes = tuple[tuple[int, ...], ...]
"""Shape of each array of a `CollocationSolution`."""


def unpack_solution(shapes: SolutionShapes, z: Any) -> CollocationSolution:
    """Return the solution of one row of unknowns, or of rows on leading axes."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes]).tolist()
    section_state, durations, *accelerations = (
        z[..., begin:end].reshape(*z.shape[:-1], *shape)
        for begin, end, shape in zip([0, *ends[:-1]], ends, shapes, strict=True)
    )
    return CollocationSolution(section_state, durations, tuple(accelerations))


@dataclass(frozen=True, eq=False, kw_only=True)
class CollocationProblem(AbstractGaitProblem):
    """Continuation problem of limit cycles by collocation. The unknowns z are those of a
    `CollocationSolution` in one row.

    If an indicator changes its sign, the solution still exists, but the event-driven step does not
    confirm it as a gait.

    - `shapes`: shape of each array of the solution;
    - `additional_quantity_function`: function of the wheel's symbols, the phase points of the first
      gait step and the solution, or None.
    """

    collocation_system: CollocationSystem
    shapes: SolutionShapes
    additional_quantity_function: Callable | None = None

    def pack(self, solution: CollocationSolution) -> np.ndarray:
        """Return solutions with a leading axis over wheels as rows of unknowns."""
        leaves = map(np.asarray, jax.tree.leaves(solution))
        return np.concatenate([x.reshape(len(x), -1) for x in leaves], 1)

    def unpack(self, z: np.ndarray) -> CollocationSolution:
        """Return the solution of one row of unknowns, or of rows on leading axes."""
        return unpack_solution(self.shapes, z)

    def linearize(self, wheels: BranchWheel, z: np.ndarray, p: np.ndarray) -> NewtonStep:
        return self.linearize_with_quantities(wheels, z, p, None)[0]

    def linearize_with_quantities(
        self, wheels: BranchWheel, z: np.ndarray, p: np.ndarray, quantity_function: Any
    ) -> tuple[NewtonStep, list]:
        linearize_trials = make_trial_linearizer(
            self.collocation_system, self.parameter_indices, quantity_function
        )
        correction, tangents, monodromy, *quantities = linearize_trials(
            self.replace_parameters(wheels, p), wheels.is_phase_active, self.unpack(z)
        )
        tangents = np.stack(
            [
                self.pack(jax.tree.map(lambda x, i=i: x[:, i], tangents))
                for i in range(len(self.continued_names))
            ],
            1,
        )
        tangents = tangents if p.ndim > 1 else tangents[:, 0]
        return NewtonStep(self.pack(correction), tangents, monodromy), quantities

    def make_finder(self) -> Any:
        options = self.collocation_system.cycle_options
        return make_finder(self.model, self.n_legs, period_n=self.period_n, cycle_options=options)

    def make_guess(self, wheel: BranchWheel, z: np.ndarray) -> Any:
        start = jax.device_put((self.unpack(z), wheel.is_phase_active))
        return jax.tree.map(np.asarray, CollocationState.make_start(*start))

    def displace(
        self, wheel: BranchWheel, z: np.ndarray, p: float, section_state: np.ndarray
    ) -> np.ndarray:
        """Return the motion of event-driven steps from another section state."""
        values = self.replace_parameters(wheel, p)
        (x,), _ = self.read_gaits(*select_tree_rows((wheel, values, z), None))
        params = self.collocation_system.make_wheel(jnp.asarray(values))
        land = functools.partial(land_foot, params.symbols())
        change = np.linalg.pinv(jax.jacfwd(land)(x)) @ (section_state - self.section_state(z))
        guess = self.make_finder().guess_cycle_from_state(params, jnp.asarray(x + change))
        return self.pack(select_tree_rows(guess.solution, None))[0]

    def section_state(self, z: np.ndarray) -> np.ndarray:
        return z[..., : self.shapes[0][0]]

    def correction_norm(self, z: np.ndarray, correction: np.ndarray) -> float:
        """Return the largest component; accelerations count by their effect on positions."""
        durations = np.max(np.abs(self.unpack(z).durations), 0)
        changes = jax.tree.map(lambda x: np.max(np.abs(x)), self.unpack(correction))
        effects = zip(changes.accelerations, durations, strict=True)
        return max(
            changes.section_state, changes.durations, *(x * duration**2 for x, duration in effects)
        )

    def is_admissible(self, wheel: BranchWheel, z: np.ndarray, p: float) -> bool:
        """Return whether all durations are positive.

        The event-driven step checks all other conditions.
        """
        is_positive = self.unpack(z).durations > 0.0
        return bool(np.all(is_positive | (wheel.is_phase_active < 0.5)))

    def read_gaits(
        self, wheels: BranchWheel, values: np.ndarray, z: np.ndarray
    ) -> tuple[np.ndarray, QuantitiesByName]:
        """Return section states before the first landing, and the continued quantities by name.

        The continued quantities are the shortest duration of each phase over the gait steps, s, and
        `takeoff_acceleration`, m/s^2. The latter is the lowest acceleration of the rear foot at
        take-off over the gait steps.
        """
        system, shapes = self.collocation_system, self.shapes
        read = functools.partial(
            _read_collocated_gaits,
            system,
            shapes,
            self.additional_quantity_function,
            self.measures_force_peaks,
        )
        states, quantities = map_in_numpy_batches(
            read, POINT_BATCH_SIZES, values, wheels.is_phase_active, z
        )
        for measure in self.own_measures:
            evaluate = functools.partial(_measure_solutions, measure, system, self.model, shapes)
            quantities[measure.name] = map_in_numpy_batches(
                evaluate, POINT_BATCH_SIZES, values, z, states
            )
        return states, quantities


@eqx.filter_jit
def _measure_solutions(
    measure: Measure,
    system: CollocationSystem,
    model: Any,
    shapes: SolutionShapes,
    parameters: Array,
    z: Array,
    states: Array,
) -> Array:
    """Return a measure of the user of many collocated gaits."""
    evaluate = functools.partial(evaluate_own_measure, measure, system, model)
    return jax.vmap(lambda p, z, x: evaluate(p, unpack_solution(shapes, z), x))(
        parameters, z, states
    )


@functools.partial(jax.jit, static_argnums=range(4))
@functools.partial(jax.vmap, in_axes=(None, None, None, None, 0, 0, 0))
def _read_collocated_gaits(
    system: CollocationSystem,
    shapes: SolutionShapes,
    additional_quantity_function: Callable | None,
    has_force_peaks: bool,
    parameters: Array,
    is_phase_active: Array,
    z: Array,
) -> tuple[Array, dict[str, Array]]:
    """Return the result of `CollocationProblem.read_gaits` for one gait."""
    solution = unpack_solution(shapes, z)
    phase_points_by_step = system.evaluate_phase_points(parameters, solution)
    end_point = phase_points_by_step[-1][-1].phase_end_point
    durations = jnp.min(solution.durations, 0)
    quantities = {
        "duration_dls": jnp.where(is_phase_active[0, 0] > 0.5, durations[0], jnp.nan),
        "duration_sls1": durations[1],
        "duration_sls2": durations[2],
        "takeoff_acceleration": system.measure_takeoff_acceleration(parameters, solution),
        "mesh_error": system.estimate_mesh_error(solution),
    }
    if additional_quantity_function is not None:
        quantities |= additional_quantity_function(
            system.make_wheel(parameters).symbols(), phase_points_by_step[0], solution
        )
    if has_force_peaks:
        quantities |= locate_force_peaks(system, parameters, solution)[0]
    return jnp.stack([end_point.q[0], *end_point.v]), quantities


GaitQuantityFunction = Callable[[CollocationSystem, Array, Array, CollocationSolution], Array]
"""Function that computes quantities of collocated gaits, with the batch elements on the last axis.

Its arguments are the collocation system, the parameters, `is_phase_active` and the solution.
"""


@functools.lru_cache
def make_trial_linearizer(
    collocation_system: CollocationSystem,
    parameter_indices: tuple[int, ...],
    gait_quantity_function: GaitQuantityFunction | None = None,
) -> Callable:
    """Return a function that linearizes the equations of many wheels at trial solutions.

    The arguments of the function are (parameters, is_phase_active, solution) as NumPy arrays with
    the wheels on the first axis, like its results. It returns Newton's correction, the tangents
    with respect to the selected parameters and the monodromy matrix. If `gait_quantity_function` is
    not None, it also returns the computed quantities and their JVPs. The directions of the JVPs are
    the correction and each tangent.
    """

    def linearize_trial(parameters: Array, is_phase_active: Array, z: CollocationSolution) -> tuple:
        cycle = collocation_system.linearize_at(parameters, z, is_phase_active, parameter_indices)
        correction, tangents = cycle.newton_correction, cycle.parameter_tangents
        newton_results = correction, tangents, cycle.monodromy
        if gait_quantity_function is None:
            return newton_results
        # The parameters do not change in the direction of the correction.
        changes = np.zeros((1 + len(parameter_indices), len(parameters), 1))
        changes[range(1, len(changes)), parameter_indices] = 1.0
        directions = (
            jnp.broadcast_to(changes.astype(parameters.dtype), (len(changes), *parameters.shape)),
            jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), correction, tangents),
        )
        evaluate = lambda parameters, z: gait_quantity_function(
            collocation_system, parameters, is_phase_active, z
        )
        differentiate = lambda direction: jax.jvp(evaluate, (parameters, z), direction)[1]
        return *newton_results, evaluate(parameters, z), lax.map(differentiate, directions)

    compiled = compile_batch_function(linearize_trial, collocation_system.cycle_options.batch_size)

    def linearize_trials(*arguments: Any) -> Any:
        to_lanes_last = lambda x: np.ascontiguousarray(np.moveaxis(x, 0, -1))
        results = compiled.run(*jax.tree.map(to_lanes_last, arguments))
        return jax.tree.map(lambda x: np.moveaxis(x, -1, 0), results)

    return linearize_trials


@dataclass(frozen=True, eq=False, kw_only=True)
class ReturnMapProblem(AbstractGaitProblem, AbstractStateProblem):
    """Continuation problem of fixed points of a walker's return map over `period_n` gait steps.

    - `conserved_values`: values of the invariants of the walker, which all gaits have.
    """

    conserved_values: Any = None

    def measure_steps(
        self, values: np.ndarray, states: np.ndarray, steps: AbstractStep
    ) -> QuantitiesByName:
        return _measure_cycles(self, values, states, steps)

    @property
    def function(self) -> Callable[[Any, Array, Array], Array]:
        return jax.tree_util.Partial(
            _advance_period, self.model, self.step_options, self.n_legs, self.period_n,
            self.parameter_indices, self.conserved_values,
        )  # fmt: skip


def _advance_period(
    model: Any,
    options: StepOptions,
    n_legs: int,
    period_n: int,
    parameter_indices: tuple[int, ...],
    conserved_values: Any,
    wheel: BranchWheel,
    x: Array,
    p: Array,
) -> Array:
    values = jnp.asarray(wheel.values).at[np.array(parameter_indices)].set(p)
    walker, params = make_walker(model, values, n_legs)
    for k in range(period_n):
        x = make_return_map(walker, walker.select_params(params, k), options)(x)
    if conserved_values is None:
        return x
    # Each multiplier 1 of a conserved quantity becomes 0, and all others are the same.
    evaluate = lambda x: jnp.ravel(walker.evaluate_invariants(params, x))
    gradients = lax.stop_gradient(jax.jacfwd(evaluate)(x))
    return x - jnp.linalg.pinv(gradients) @ (evaluate(x) - conserved_values)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactGaitProblem(ReturnMapProblem):
    """Continuation problem of gaits with unilateral contact, solved by batches of gait steps."""

    has_kinks: ClassVar[bool] = True

    def _evaluate_period(self, values: np.ndarray, states: np.ndarray, *differentiated: Any) -> Any:
        period_map = PeriodMap(self.model, self.n_legs, self.period_n, values)
        return period_map.evaluate_period(self.step_options, states, *differentiated)

    def linearize(self, wheels: BranchWheel, z: np.ndarray, p: np.ndarray) -> NewtonStep:
        """Return the Newton steps of many wheels at their trial points."""
        n, is_continued = len(self.units), np.arange(wheels.values.shape[1])
        is_continued = is_continued == self.parameter_indices[0]
        period = self._evaluate_period(self.replace_parameters(wheels, p), z, is_continued)
        defects, jacobian = period.defects, period.return_map_jacobian[:, :n, :n]
        defects[~period.is_complete] = np.nan
        right_sides = np.concatenate(
            [defects[:, :n, None], period.parameter_jacobian[:, :n, is_continued]], -1
        )
        solutions = solve_linear_systems(np.eye(n) - jacobian, right_sides)
        code_changes = defects[:, n:]
        return NewtonStep(
            np.concatenate([solutions[..., 0], code_changes], 1),
            np.concatenate([solutions[..., 1], 0.0 * code_changes], 1),
            jacobian,
        )

    def take_steps(self, values: np.ndarray, states: np.ndarray) -> Any:
        evaluate = lambda *rows: self._evaluate_period(*rows, False, False).gait_steps
        return map_in_numpy_batches(evaluate, LOCATION_BATCH_SIZES, values, states)

    def measure_steps(
        self, values: np.ndarray, states: np.ndarray, steps: AbstractStep
    ) -> QuantitiesByName:
        quantities = {
            EVENT_ORDER: compute_contact_order_numbers(steps, self.n_legs),
            FRICTION_SURPLUS: self._compute_friction_surplus(values),
        }
        return quantities | _measure_cycles(self, values, states, steps)

    def _compute_friction_surplus(self, values: np.ndarray) -> np.ndarray:
        """Return the friction coefficient minus the slope's tangent.

        Over a period, the ground's tangential impulse balances the impulse of the weight parallel
        to the slope. The tangential impulse is at most the friction coefficient times the normal
        impulse. Therefore no gait repeats without a surplus.
        """
        names = self.model.parameter_names
        slope, friction = (values[..., names.index(name)] for name in ("slope", FRICTION_NAME))
        return np.asarray(friction - np.tan(slope) * (1.0 + MIN_FRICTION_SURPLUS))

    def is_admissible(self, wheel: BranchWheel, z: np.ndarray, p: float) -> bool:
        """Return whether friction can balance the component of the weight parallel to the slope."""
        surplus = self._compute_friction_surplus(self.replace_parameters(wheel, p))
        return bool(np.isfinite(z).all() and surplus > 0.0)


def _measure_cycles(
    problem: AbstractGaitProblem, values: np.ndarray, states: np.ndarray, steps: AbstractStep
) -> QuantitiesByName:
    """Return force peaks and measures of the user, if requested, from the steps of gaits."""
    if not (problem.measures_force_peaks or problem.own_measures):
        return {}

    @eqx.filter_jit
    @eqx.filter_vmap
    def measure(values: Array, state: Array, steps: AbstractStep) -> dict[str, Array]:
        model, params = problem.model.from_parameter_values(values, problem.n_legs)
        options, quantities = problem.step_options, {}
        if problem.measures_force_peaks:
            step_ends = steps.section_state
            quantities = measure_return_map_force_peaks(model, params, state, step_ends, options)
        return quantities | {
            measure.name: measure_return_map_cycle(measure, options, model, params, state, steps)
            for measure in problem.own_measures
        }

    return map_in_numpy_batches(measure, POINT_BATCH_SIZES, values, states, steps)


def compute_contact_order_numbers(gait_steps_of_period: Any, n_legs: int) -> np.ndarray:
    """Return a number for each period that identifies its order of contacts, shape (periods,).

    The number is a checksum of the contact modes that occur, the event counts and the final contact
    modes.
    """
    steps = jax.tree.map(np.asarray, gait_steps_of_period)
    counts = np.stack([steps.events, steps.impacts], -1)
    arrays = steps.mode_durations > 0.0, steps.section_state[..., -n_legs:], counts
    return number_rows(np.concatenate([x.reshape(len(x), -1).astype(np.int64) for x in arrays], 1))


def number_rows(rows: np.ndarray) -> np.ndarray:
    """Return one number for each row, which is equal for equal rows."""
    return np.array([zlib.crc32(row.tobytes()) for row in rows], float)


@jax.jit
@jax.vmap
def _combine_period_measures(step_results: AbstractStep, section_states: Array) -> dict[str, Array]:
    """Return all measures of each period of gait steps, which start at `section_states`.

    Indicators and margins are minima over the gait steps, required friction coefficients are
    maxima, and durations and energies are sums. The section state is that of the last step, and the
    post-impact state is that of the first step. `outcome` is the first failure of a step, if any.
    `closure` is the largest change of the section state over the period.
    """
    step_measures = jax.vmap(lambda step_result: step_result.measures())(step_results)
    first_failure = jnp.argmax(step_measures["outcome"] != Outcome.STEPPED)

    def combine(name: str, values: Array) -> Array:
        if name in MARGIN_MEASURES | STOPPER_MARGIN_MEASURES or name.startswith("lambda_"):
            return jnp.min(values, 0)
        for suffix, index in (("_touchdown", -1), ("_post_impact", 0), ("outcome", first_failure)):
            if name.endswith(suffix):
                return values[index]
        if MEASURES[name].is_averaged_over_steps:
            return jnp.mean(values, 0)
        return (jnp.max if MEASURES[name].is_largest_over_steps else jnp.sum)(values, 0)

    measures = {name: combine(name, values) for name, values in step_measures.items()}
    period = jnp.where(measures["period"] > 0.0, measures["period"], 1.0)
    return measures | {
        "dls_fraction": measures["duration_dls"] / period,
        "speed": measures["step_length"] / period,
        "closure": jnp.max(jnp.abs(step_results.section_state[-1] - section_states)),
    }

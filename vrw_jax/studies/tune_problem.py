"""Objective, constraints and trials of tuning, from a user's specification.

Gradients are exact. The objective and the constraints are functions of a gait.
"""

from __future__ import annotations

import dataclasses
import inspect
import operator
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
    check_type,
    format_value,
    require_known_name,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, NoGaitError, Outcome
from vrw_jax.base.walker import check_parameters, is_own_walker
from vrw_jax.gaits.cycle import CycleOptions, default_margins
from vrw_jax.gaits.finder import (
    AbstractGaitFinder,
    GaitFunction,
    GaitMeasureReader,
    evaluate_on_gait,
    evaluate_on_gaits,
    is_same_branch,
)
from vrw_jax.gaits.gait_search import make_finder, resolve_model
from vrw_jax.gaits.walker_finder import WalkerFinder, make_walker_finder
from vrw_jax.models.measures import SELECTION_MARGIN_NAMES
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_compliant_model,
    require_legs_in_turn_by_collocation,
    require_single_wheel,
)
from vrw_jax.studies.tune_maximization import (
    EvaluatedTrial,
    ExplorationResult,
    MaximizationResult,
    OptimalityConditions,
    compute_optimality_conditions,
    explore_starts,
)
from vrw_jax.wheel.params import FRICTION_NAME, PARAMETER_NAMES, WheelParams, check_parameter_name

ParameterBounds = Mapping[str, tuple[float, float]]
"""Lower and upper bound of each free parameter, by the parameter's name."""

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


ObjectiveSpecification = str | Measure | Mapping[str, float] | Callable[..., Array] | WheelObjective


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
    params: Any, constraints: ConstraintSpecification | None, gait_finder: AbstractGaitFinder
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


@dataclasses.dataclass(frozen=True)
class TuneProblem:
    """Validated tuning problem with its free parameters, objective and constraints."""

    params: Any
    free_parameters: tuple[str, ...]
    lower_bounds: np.ndarray
    upper_bounds: np.ndarray
    constraint_margins: dict[str, float]
    objective_label: str
    objective_and_constraints: ObjectiveAndConstraints
    gait_finder: AbstractGaitFinder
    wheel_objective: WheelObjective | None = None

    @property
    def bound_widths(self) -> np.ndarray:
        """Return the width between the bounds of each free parameter, shape (free,)."""
        return self.upper_bounds - self.lower_bounds

    @property
    def free_parameter_indices(self) -> list[int]:
        """Return the index of each free parameter among those of the model."""
        return [self.gait_finder.model.parameter_names.index(x) for x in self.free_parameters]

    @property
    def constraint_limits(self) -> dict[str, float]:
        """Return the smallest allowed value of each constrained value, by name.

        A margin that is defined for each leg, such as the force of its stopper, has one name per
        leg.
        """
        constraint_limits: dict[str, float] = {}
        for measure_name, min_value in self.constraint_margins.items():
            names = [measure_name]
            if self.gait_finder.get_measure(measure_name).leg_dimension:
                n_legs = self.gait_finder.n_legs
                names = [f"{measure_name}[leg {leg}]" for leg in range(3, n_legs + 1)]
            constraint_limits |= dict.fromkeys(names, min_value)
        return constraint_limits

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Return the name of each constrained value."""
        return tuple(self.constraint_limits)

    @property
    def min_constraint_values(self) -> np.ndarray:
        """Return the smallest allowed value of each constraint, in the order of
        `constraint_names`.
        """
        return np.array([*self.constraint_limits.values()])

    def denormalize_parameters(self, normalized_parameters: np.ndarray) -> np.ndarray:
        """Return all floating-point parameters of the wheel with these normalized free parameters.

        A normalized parameter is its distance from the lower bound divided by the width between the
        bounds.
        """
        start_values = np.array(self.gait_finder.model.collect_parameter_values(self.params))
        parameter_values = np.tile(start_values, (*normalized_parameters.shape[:-1], 1))
        parameter_values[..., self.free_parameter_indices] = (
            self.lower_bounds + normalized_parameters * self.bound_widths
        )
        return parameter_values

    def make_wheel(self, normalized_parameters: np.ndarray) -> Any:
        """Return the wheel with these normalized free parameters, and with its laws."""
        model, params = self.gait_finder.model.from_parameter_values(
            jnp.asarray(self.denormalize_parameters(normalized_parameters)), self.gait_finder.n_legs
        )
        return model.attach_laws(params)

    @property
    def normalized_start(self) -> np.ndarray:
        """Return the normalized free parameters of the start wheel, shape (free,)."""
        start_parameter_values = np.array(
            [
                float(self.gait_finder.model.get_parameter(self.params, x))
                for x in self.free_parameters
            ]
        )
        return np.clip((start_parameter_values - self.lower_bounds) / self.bound_widths, 0.0, 1.0)

    def evaluate_start_trial(self, normalized_parameters: np.ndarray) -> EvaluatedTrial:
        """Evaluate the trial with the parameters `normalized_parameters`, from which the
        maximization starts.

        Raise a ValueError if the trial is unusable.
        """
        start_trial, finder = self.evaluate_trial(normalized_parameters, None), self.gait_finder
        if not start_trial.has_gait_on_branch and isinstance(finder, WalkerFinder):
            start = finder.find_gait_by_walk(self.make_wheel(normalized_parameters))
            if start is not None:
                start_trial = self.evaluate_trial(normalized_parameters, None, start)
        if not start_trial.has_gait_on_branch:
            start_outcome = Outcome(int(start_trial.outcome))
            raise NoGaitError(
                f"the start has no gait to tune ({start_outcome.name}: "
                f"{start_outcome.meaning[:-1]}"
                "): start from parameters that have one."
            )
        if not start_trial.has_finite_values:
            for constraint_name, value, gradient in zip(
                (self.objective_label, *self.constraint_names),
                (
                    start_trial.objective,
                    *(start_trial.constraint_slacks + self.min_constraint_values),
                ),
                (start_trial.objective_gradient, *start_trial.slack_jacobian),
                strict=True,
            ):
                description = "has a derivative that is not finite"
                if not np.isfinite(value):
                    description = f"is {restore_sign_of_bound(constraint_name, value):g}"
                elif np.isfinite(gradient).all():
                    continue
                raise ValueError(
                    f"{constraint_name.removeprefix(UPPER_BOUND_PREFIX)} {description} at the "
                    "start, but a maximization needs finite numbers: start from another wheel, or "
                    "give an objective and constraints that are finite there."
                )
        return start_trial

    def evaluate_trial(
        self,
        normalized_parameters: np.ndarray,
        neighbor_trial: EvaluatedTrial | None,
        guess: Any = None,
    ) -> EvaluatedTrial:
        """Evaluate one trial, or a batch with one trial for each row of `normalized_parameters`.

        If `neighbor_trial` is given, the search for the gait begins at its gait; else it begins at
        `guess`, or at the finder's own guess.
        """
        gait_finder = self.gait_finder
        make_guess, find_gait, evaluate_measures = (
            (gait_finder.make_initial_guess, gait_finder.find_gait, evaluate_on_gait)
            if normalized_parameters.ndim == 1
            else (gait_finder.make_initial_guesses, gait_finder.find_gaits, evaluate_on_gaits)
        )
        numpy_values = self.denormalize_parameters(normalized_parameters)
        parameter_values = jnp.asarray(numpy_values)
        if neighbor_trial is not None:
            guess = neighbor_trial.gait.cycle.warm_start
        initial_guess = make_guess(parameter_values) if guess is None else guess
        gait = find_gait(parameter_values, initial_guess)
        values, jacobian = map(np.array, evaluate_measures(self.objective_and_constraints, gait))
        free_jacobian = np.swapaxes(jacobian[..., self.free_parameter_indices, :], -1, -2)
        outcome = np.asarray(gait.outcome)
        has_gait = outcome == Outcome.STEPPED
        is_on_branch = np.ones(outcome.shape, bool)
        if neighbor_trial is not None:
            # A trial without a gait has a failure of its own.
            is_on_branch = ~has_gait | is_same_branch(
                neighbor_trial.gait.branch_point,
                gait.branch_point,
                numpy_values - self.denormalize_parameters(neighbor_trial.normalized_parameters),
            )
        if self.wheel_objective is not None and has_gait and is_on_branch:
            values[0], free_jacobian[0] = self.wheel_objective.evaluate_with_gradient(
                self.make_wheel(normalized_parameters), self.free_parameters
            )
        has_gait = has_gait[..., None]
        values = np.where(has_gait, values, np.nan)
        normalized_jacobian = np.where(
            has_gait[..., None], free_jacobian * self.bound_widths, np.nan
        )
        return EvaluatedTrial(
            normalized_parameters,
            outcome,
            is_on_branch,
            values[..., 0][()],  # a number unless it is a batch
            normalized_jacobian[..., 0, :],
            values[..., 1:] - self.min_constraint_values,
            normalized_jacobian[..., 1:, :],
            gait,
        )

    def explore_random_starts(self, n_starts: int, seed: int) -> ExplorationResult:
        """Explore from this wheel and from random wheels in one batch, and return the ends."""
        if self.wheel_objective is not None:
            raise ValueError(
                f"n_starts is {n_starts}, but a WheelObjective cannot be evaluated for a batch of "
                "wheels: give n_starts=1, and call vrw.tune for each start."
            )
        shape = n_starts - 1, len(self.free_parameters)
        random_starts = np.random.default_rng(seed).uniform(size=shape)
        return explore_starts(
            self.evaluate_trial, np.vstack([self.normalized_start, random_starts])
        )

    def compute_conditions_per_unit(self, result: MaximizationResult) -> OptimalityConditions:
        """Return the optimality conditions at the best trial, with prices per unit of each limit:
        of the constraints, of the lower bounds and of the upper bounds.
        """
        conditions = compute_optimality_conditions(
            result.best_trial, [x for x in result.evaluated_trials if x.is_usable_trial]
        )
        limit_widths = np.r_[np.ones(len(self.constraint_names)), np.tile(self.bound_widths, 2)]
        return conditions._replace(price_ranges=conditions.price_ranges / limit_widths[:, None])


def make_tune_problem(
    params: Any,
    objective: ObjectiveSpecification,
    free: Sequence[str],
    bounds: ParameterBounds,
    constraints: ConstraintSpecification | None,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
) -> TuneProblem:
    """Validate the arguments of `tune` and return the problem that it solves.

    The problem can also be used to evaluate single gaits, or with other optimization methods.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.
    """
    own_finder = None
    if is_own_walker(model):
        if isinstance(objective, WheelObjective):
            raise ValueError(
                "objective is a WheelObjective, which is a function of WheelParams, but the model "
                "is a walker of yours: give a measure, or a function of the gait."
            )
        own_finder = make_walker_finder(model, params, convert_step_options(options))
        params = check_parameters(params)
    else:
        require_single_wheel(params, "tune one after the other")
    checked_model: Any = convert_model_argument(model) if own_finder is None else own_finder.model
    free_parameters, lower_bounds, upper_bounds = _check_parameter_bounds(
        params, free, bounds, checked_model
    )
    if isinstance(objective, WheelObjective) and not set(free_parameters) <= set(PARAMETER_NAMES):
        raise ValueError(
            f"free is {free_parameters}, but a WheelObjective is a function of WheelParams, which "
            "do not contain a leg force: give a measure, or a function of the cycle."
        )
    if own_finder is None:
        require_legs_in_turn_by_collocation(checked_model, "vrw.tune")
    gait_finder: AbstractGaitFinder = own_finder or make_finder(
        convert_model_argument(resolve_model(params, checked_model)),
        params.n_legs,
        period_n=checked_model.leg_period if own_finder is None else 1,
        cycle_options=cycle_options,
        step_options=options,
    )
    require_compliant_model(gait_finder.model, "what is tuned has", "tune")
    gait_finder.search_options.check_tolerances(jnp.result_type(*jax.tree.leaves(params)))
    objective_function, objective_label = _parse_objective_function(objective, gait_finder)
    if (
        constraints is None
        and checked_model.fallback_model is not checked_model
        and gait_finder.supports_cold_start
    ):
        constraints = SELECTION_MARGIN_NAMES
    constraint_margins = parse_constraint_margins(params, constraints, gait_finder)
    objective_and_constraints = ObjectiveAndConstraints(
        objective_function, gait_finder.measure_reader, tuple(constraint_margins)
    )
    if callable(objective):  # Errors of the objective are raised here, before compilation.
        cycle_template = jax.eval_shape(gait_finder.find_cycle, params)
        step_result_template = jax.eval_shape(
            gait_finder.take_gait_step, params, cycle_template.section_state
        )
        jax.eval_shape(objective_and_constraints, cycle_template, step_result_template)
    wheel_objective = objective if isinstance(objective, WheelObjective) else None
    return TuneProblem(
        params,
        free_parameters,
        lower_bounds,
        upper_bounds,
        constraint_margins,
        objective_label,
        objective_and_constraints,
        gait_finder,
        wheel_objective,
    )


def _parse_objective_function(
    objective: ObjectiveSpecification, gait_finder: AbstractGaitFinder
) -> tuple[GaitFunction, str]:
    """Return the objective as a function of the cycle and the step, and its label.

    The function returns 0 if the objective is a `WheelObjective`.
    """
    if isinstance(objective, WheelObjective):
        return zero_objective, objective.label
    if isinstance(objective, Measure) and gait_finder.model.is_wheel:
        # For a walker of the user, which has the measure, its name suffices.
        return CycleObjective(operator.methodcaller("measure", objective)), objective.name
    objective = objective.name if isinstance(objective, Measure) else objective
    if callable(objective):
        if gait_finder.model.is_wheel and gait_finder.model.batch_kernel != "phases":
            raise TypeError(
                "objective is a function, but with contact it must be a measure's name or "
                f"weights of several: choose from {', '.join(gait_finder.differentiable_measures)}."
            )
        objective_label = getattr(objective, "__name__", "objective")
        objective_arguments = inspect.signature(objective).parameters
        return (
            objective if len(objective_arguments) >= 2 else CycleObjective(objective)
        ), objective_label
    if not isinstance(objective, str | Mapping):
        raise TypeError(
            f"objective is {format_value(objective)}, but it is a measure's name, weights of "
            'several or a function of the cycle: give "dls_fraction", say.'
        )
    measure_weights = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    if not measure_weights:
        raise ValueError(
            "objective is an empty mapping, but something must be maximised: "
            'give a measure such as "dls_fraction".'
        )
    for measure_name, measure_weight in measure_weights.items():
        require_known_name(measure_name, gait_finder.readable_measures, "measure for objective")
        check_real(f"the weight of {measure_name}", measure_weight)
        if gait_finder.get_measure(measure_name).leg_dimension:
            raise ValueError(
                f"{measure_name} has one value for each locked leg, but an objective is one "
                "number: give a function of the cycle and the step that reduces it."
            )
    objective_label = " + ".join(
        measure_name if measure_weight == 1.0 else f"{measure_weight:g} {measure_name}"
        for measure_name, measure_weight in measure_weights.items()
    )
    return WeightedMeasureSum(
        gait_finder.measure_reader, tuple(measure_weights.items())
    ), objective_label.replace("+ -", "- ")


def _check_parameter_bounds(
    params: Any, free: Sequence[str], bounds: ParameterBounds, model: Any
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return the names of the free parameters, and the arrays of their lower and upper bounds."""
    domain_by_parameter = model.parameter_domains
    domain_by_parameter.pop(FRICTION_NAME, None)
    free_parameters = check_names("free", free)
    check_type("bounds", bounds, Mapping, "write {'damping': (100.0, 200.0)}")
    if len(set(free_parameters)) < len(free_parameters):
        raise ValueError(f"free is {free_parameters}, which names one twice: name each once.")
    if not free_parameters:
        raise ValueError(
            f"free names no parameter, but at least one must move: choose from "
            f"{', '.join(domain_by_parameter)}."
        )
    for parameter_name in (*free_parameters, *bounds):
        check_parameter_name(parameter_name, tuple(domain_by_parameter), "parameter of the wheel")
    for parameter_name in bounds:
        if parameter_name not in free_parameters:
            raise ValueError(
                f"bounds holds {parameter_name!r}, but it is not free: add it to free."
            )
    for parameter_name in free_parameters:
        if parameter_name not in bounds:
            raise ValueError(
                f"{parameter_name} is free but has no bounds: give bounds[{parameter_name!r}]."
            )
        lower_bound, upper_bound = check_range(
            f"the range of {parameter_name}", bounds[parameter_name]
        )
        parameter_domain = domain_by_parameter[parameter_name]
        for bound_value in (lower_bound, upper_bound):
            if not parameter_domain.contains_parameter_value(bound_value):
                raise ValueError(
                    f"the bounds of {parameter_name} reach {bound_value:g}, but "
                    f"{parameter_domain.description or 'it'} must lie "
                    f"in {parameter_domain}: keep them inside."
                )
        start_parameter_value = float(model.get_parameter(params, parameter_name))
        if not lower_bound <= start_parameter_value <= upper_bound:
            raise ValueError(
                f"the start has {parameter_name} {start_parameter_value:g}, outside its bounds "
                f"({lower_bound:g}, {upper_bound:g}): widen the bounds or start inside them."
            )
    bound_pairs = np.array([bounds[parameter_name] for parameter_name in free_parameters], float)
    return free_parameters, *bound_pairs.T


def check_along(problem: TuneProblem, along: Any) -> tuple[str, list[float]]:
    """Return the name and the values of the parameter along which an optimum is followed."""
    check_type("along", along, tuple, 'write along=("slope", (0.30, 0.25, 0.20))')
    if len(along) != 2:
        raise ValueError(
            f"along has {len(along)} entries, but it is a parameter and its values: write "
            'along=("slope", (0.30, 0.25, 0.20)).'
        )
    name, values = along
    check_parameter_name(name, problem.gait_finder.model.parameter_names, "parameter")
    if name in problem.free_parameters:
        raise ValueError(
            f"along is {name!r}, which is free, but the optimum is followed along a parameter that "
            "is not: take it out of free."
        )
    numbers = check_reals("the values in along", values)
    if numbers.ndim != 1 or numbers.size < 2:
        raise ValueError(
            f"the values in along have shape {numbers.shape}, but a curve needs a row of at least "
            "two: write np.linspace(0.30, 0.05, 26)."
        )
    row = np.asarray(numbers).tolist()
    for value in row:
        problem.gait_finder.model.parameter_domains[name].require_value_in_domain(name, value)
    return name, row

"""Tuning of a wheel: maximization of an objective for its gait, with margins as constraints.

Gradients are exact. Without margins as constraints, the maximization would increase double support
until the foot scuffs.
"""

from __future__ import annotations

import dataclasses
import inspect
import operator
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_int,
    check_names,
    check_positive,
    check_range,
    check_real,
    check_reals,
    check_type,
    format_value,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.measures import Measure
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import check_parameters, is_own_walker
from vrw_jax.gaits.finder import (
    AbstractGaitFinder,
    Gait,
    GaitFunction,
    evaluate_on_gait,
    evaluate_on_gaits,
    is_same_branch,
)
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.gait_search import resolve_model
from vrw_jax.gaits.margin_defaults import default_margins
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.walker_finder import WalkerFinder, make_walker_finder
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    SELECTION_MARGIN_NAMES,
    describe_parameter,
    make_flag_attributes,
    make_measure_attributes,
)
from vrw_jax.models.registry import collect_provenance_attributes
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_compliant_model,
    require_legs_in_turn_by_collocation,
    require_single_wheel,
)
from vrw_jax.studies.optimum_curve import follow_optimum
from vrw_jax.studies.tune_maximization import (
    EvaluatedTrial,
    MaximizationResult,
    OptimalityConditions,
    TrialKind,
    compute_optimality_conditions,
    maximize_objective,
)
from vrw_jax.studies.tune_objective import (
    UPPER_BOUND_PREFIX,
    ConstraintSpecification,
    CycleObjective,
    ObjectiveAndConstraints,
    WeightedMeasureSum,
    WheelObjective,
    compute_max_violation,
    compute_slack_scales,
    parse_constraint_margins,
    restore_sign_of_bound,
    zero_objective,
)
from vrw_jax.studies.tune_result import (
    ActiveConstraint,
    ExplorationResult,
    TuneResult,
    WalkValidation,
    explore_starts,
)
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    PARAMETER_NAMES,
    check_parameter_name,
)

ParameterBounds = Mapping[str, tuple[float, float]]
"""Lower and upper bound of each free parameter, by the parameter's name."""

ObjectiveSpecification = str | Measure | Mapping[str, float] | Callable[..., Array] | WheelObjective


N_STEPS_OF_WALK = 10
"""Number of steps of the walk that validates a tuned wheel."""
RELATIVE_START_DISPLACEMENT = 1e-5
"""Relative displacement of the start from the limit cycle."""
CONSTRAINT_VALUE_TOLERANCE = 1e-3
"""Accepted violation of a constraint, as a fraction of its value. This tolerance and the next are
chosen because of two effects. The optimum satisfies a constraint within 1e-6 of its change
between the bounds, and the start is displaced. Each effect is some thousandths of a take-off
margin.
"""
DEFAULT_MARGIN_TOLERANCE = 1e-2
"""Accepted violation, as a fraction of the constraint's default margin."""


@announce_wait("the gait, objective and constraints with derivatives", "25 s")
def tune(
    params: Any,
    objective: ObjectiveSpecification,
    free: Sequence[str],
    bounds: ParameterBounds,
    constraints: ConstraintSpecification | None = None,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
    tolerance: float = 1e-6,
    max_evaluations: int = 200,
    n_starts: int = 1,
    seed: int = 0,
    along: tuple[str, Any] | None = None,
) -> Any:
    """Return the wheel near `params` whose gait maximizes an objective under constraints.

    The default constraints are all margins that gaits of the model can satisfy (`default_margins`).
    An empty mapping {} means no constraints. A constraint may be violated by 1e-6 of its change
    between the bounds. The method is local and ends at an optimum on the branch of `params`. If
    `n_starts` is above 1, the search begins with `params` and random wheels within the bounds. 25
    first-order optimizer steps improve all starts in one batch, and the maximization continues from
    the best.

    With unilateral contact (`UnilateralWheel`) the objective is a measure of a step, a weighted sum
    of measures, or a `WheelObjective`. A walk from the start finds the first gait. There are no
    default constraints, and constraints are on measures of a step, for example
    {"slip": (0.0, 0.05)}. The model "auto" is the model that is selected for the gait of the start.
    If this is the paper's model, its margins are the constraints, so that the model stays valid.

    For a walker of yours, which needs `starts`, the measures are the period, the section
    coordinates and its own `measures`. There are no default constraints.

    Args:
        params: the start, one wheel, or the parameters of a walker of yours.
        objective: quantity to maximize: name of a measure, a measure of your own (`vrw.measure`),
            weights of measures by name, or a function of a LimitCycle. A function of two arguments
            also gets the cycle's StepResult. A `WheelObjective` is a function of the wheel that is
            not compiled.
        free: names of the parameters that may change.
        bounds: lower and upper bound of each free parameter.
        constraints: lower bounds of measures by name, or pairs of lower and upper bounds, of which
            one may be None: (None, 0.6). A sequence of names means lower bounds of 0.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: numerical options of the walking steps.
        cycle_options: options of the gait search.
        tolerance: tolerance of the first-order condition, relative to the objective's gradient.
        max_evaluations: largest number of evaluated gaits.
        n_starts: number of starts; the maximization continues from the best.
        seed: seed of the random starts.
        along: name and values of another parameter, along which the optimum is followed, such as
            ("slope", np.linspace(0.30, 0.05, 26)).

    Returns:
        A `TuneResult`, whose `status` is CONVERGED at an optimum. With `along`, an `OptimumCurve`,
        with the optimum at each value, and the values at which the active limits change.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> result = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> print(result.status.name, f"{result.value:.3f}", [c.name for c in result.active])
        CONVERGED 0.534 ['damping']
    """
    require_untraced_arguments("vrw.tune", "maximize by your own loop over vrw.limit_cycle", params)
    max_evaluations = check_int("max_evaluations", max_evaluations)
    n_starts = check_int("n_starts", n_starts)
    tolerance, seed = check_positive("tolerance", tolerance), check_int("seed", seed, 0)
    if isinstance(objective, WheelObjective) and n_starts > 1:
        raise ValueError(
            f"n_starts is {n_starts}, but a WheelObjective cannot be evaluated for a batch of "
            "wheels: give n_starts=1, and call vrw.tune for each start."
        )
    start_seconds = time.perf_counter()
    tune_problem = make_tune_problem(
        params,
        objective,
        free,
        bounds,
        constraints,
        model=model,
        options=options,
        cycle_options=cycle_options,
    )
    curve_arguments = None if along is None else _check_along(tune_problem, along)
    exploration_result = (
        tune_problem.explore_random_starts(n_starts, seed) if n_starts > 1 else None
    )
    tune_problem.gait_finder.precompile_programs(params)
    start_trial = tune_problem.evaluate_start_trial(
        tune_problem.normalized_start
        if exploration_result is None
        else exploration_result.normalized_parameters[exploration_result.best_start_index]
    )
    if curve_arguments is not None:
        return follow_optimum(
            tune_problem, *curve_arguments, start_trial, tolerance, max_evaluations
        )
    compilation_end_seconds = time.perf_counter()
    maximization_result = maximize_objective(
        tune_problem.evaluate_trial,
        start_trial,
        tolerance=tolerance,
        max_evaluations=max_evaluations,
    )
    return tune_problem.make_tune_result(
        maximization_result, start_seconds, compilation_end_seconds, exploration_result
    )


def _check_along(problem: TuneProblem, along: Any) -> tuple[str, list[float]]:
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
    return name, np.asarray(numbers).tolist()


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
            jnp.asarray(self.denormalize_parameters(normalized_parameters)),
            self.gait_finder.n_legs,
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
            raise ValueError(
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
        random_normalized_starts = np.random.default_rng(seed).uniform(
            size=(n_starts - 1, len(self.free_parameters))
        )
        return explore_starts(
            self.evaluate_trial, np.vstack([self.normalized_start, random_normalized_starts])
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

    def make_tune_result(
        self,
        maximization_result: MaximizationResult,
        start_seconds: float,
        compilation_end_seconds: float,
        exploration_result: ExplorationResult | None,
    ) -> TuneResult:
        """Return the `TuneResult` for a maximization, with active constraints and a validation
        walk.
        """
        best_trial = maximization_result.best_trial
        best_gait = best_trial.gait
        params = self.make_wheel(best_trial.normalized_parameters)
        model: Any = self.gait_finder.model
        laws = getattr(params, "laws", None)
        if laws is not None:
            model = model.with_laws(laws)
        unit_by_parameter = {name: x.unit for name, x in model.parameter_domains.items()}
        conditions = self.compute_conditions_per_unit(maximization_result)
        limited_names = (*self.constraint_names, *self.free_parameters * 2)
        limits = [*self.min_constraint_values, *self.lower_bounds, *self.upper_bounds]
        price_ranges = conditions.price_ranges
        if not conditions.are_satisfied:
            price_ranges[price_ranges[:, 1] > 0.0] = np.nan
        active_constraints = [
            ActiveConstraint(
                limited_name.removeprefix(UPPER_BOUND_PREFIX),
                restore_sign_of_bound(limited_name, limit),
                unit_by_parameter.get(limited_name)
                or self.gait_finder.get_measure(limited_name).unit,
                low if low == high else np.nan,
                (low, high),
            )
            for limited_name, limit, (low, high) in zip(
                limited_names, limits, price_ranges.tolist(), strict=True
            )
            if high != 0.0
        ]
        kink_names = [
            limited_name.removeprefix(UPPER_BOUND_PREFIX)
            for limited_name in (self.objective_label, *self.constraint_names)
        ]
        end_seconds = time.perf_counter()
        walk_validation = self._validate_tuned_wheel_by_walking(params, best_gait)
        step_measures = self.gait_finder.measure_step(params, best_gait.cycle, best_gait.step)
        return TuneResult(
            params=params if laws is None else params.attach_laws(None),
            model=model,
            status=maximization_result.status,
            objective=self.objective_label,
            value=float(best_trial.objective),
            start_value=float(maximization_result.evaluated_trials[0].objective),
            cycle=best_gait.cycle,
            step=best_gait.step,
            active=tuple(active_constraints),
            kkt_residual=conditions.kkt_residual,
            kinks=tuple(np.array(kink_names)[conditions.has_kink].tolist()),
            violated_margins=tuple(
                measure_name
                for measure_name in MARGIN_MEASURES
                if measure_name in step_measures
                and measure_name not in self.constraint_margins
                and np.min(step_measures[measure_name]) < 0.0
            ),
            validation=walk_validation,
            path=self._make_path_dataset(maximization_result),
            n_evaluations=len(maximization_result.evaluated_trials)
            + (0 if exploration_result is None else exploration_result.n_evaluations),
            n_backtracks=sum(
                trial_kind in (TrialKind.LOST, TrialKind.NOT_FINITE)
                for trial_kind in maximization_result.trial_kinds
            ),
            seconds=end_seconds - start_seconds,
            compile_seconds=compilation_end_seconds - start_seconds,
            exploration=exploration_result,
        )

    def _validate_tuned_wheel_by_walking(self, params: Any, gait: Gait) -> WalkValidation:
        """Simulate a walk that starts near the section state of the gait, and return its
        validation.
        """
        cycle_section_state = np.array(gait.cycle.section_state)
        # The state is scaled down, not up, because no leg may be beyond its stopper.
        section_state = cycle_section_state * (1.0 - RELATIVE_START_DISPLACEMENT)
        is_gait_feasible, walk_outcome, n_steps_walked = True, Outcome.STEPPED, 0
        default_margins_by_name = default_margins(params) if self.gait_finder.model.is_wheel else {}
        for _ in range(N_STEPS_OF_WALK):
            step_result = self.gait_finder.take_gait_step(params, jnp.asarray(section_state))
            walk_outcome = Outcome(int(step_result.outcome))
            if walk_outcome != Outcome.STEPPED:
                break
            step_measures = self.gait_finder.measure_step(params, section_state, step_result)
            n_steps_walked, section_state = n_steps_walked + 1, np.array(step_result.section_state)
            for constraint_name, min_constraint_value in self.constraint_margins.items():
                measure_name = constraint_name.removeprefix(UPPER_BOUND_PREFIX)
                if measure_name not in step_measures:
                    continue
                constraint_value = np.asarray(step_measures[measure_name])
                if measure_name != constraint_name:
                    constraint_value = -constraint_value
                default_margin = abs(default_margins_by_name.get(constraint_name, 0.0))
                violation_tolerance = (
                    CONSTRAINT_VALUE_TOLERANCE * np.max(np.abs(constraint_value))
                    + DEFAULT_MARGIN_TOLERANCE * default_margin
                )
                is_gait_feasible &= bool(
                    np.all(constraint_value >= min_constraint_value - violation_tolerance)
                )
        final_state_distance = float(np.max(np.abs(section_state - cycle_section_state)))
        return WalkValidation(
            n_steps_walked,
            walk_outcome,
            final_state_distance,
            is_gait_feasible and walk_outcome == Outcome.STEPPED,
        )

    def _make_path_dataset(self, maximization_result: MaximizationResult) -> xr.Dataset:
        """Return a dataset that lists all trials of a maximization in order."""
        trials = maximization_result.evaluated_trials
        normalized_parameters = np.array([trial.normalized_parameters for trial in trials])
        parameter_values = self.lower_bounds + normalized_parameters * self.bound_widths
        min_constraint_values = self.min_constraint_values
        constraint_slacks = np.array([trial.constraint_slacks for trial in trials])
        slack_scales = compute_slack_scales(trials[0].constraint_slacks, trials[0].slack_jacobian)
        trial_outcomes = [
            trial.outcome if trial.is_on_branch else Outcome.NO_CYCLE_FOUND for trial in trials
        ]
        domains = self.gait_finder.model.parameter_domains
        objective_attributes = {"long_name": self.objective_label}
        if self.objective_label in self.gait_finder.differentiable_measures:
            objective_attributes["units"] = self.gait_finder.get_measure(self.objective_label).unit
        path_dataset_variables: dict[str, Any] = {
            name: (
                "evaluation",
                values,
                describe_parameter(name, domains[name]).variable_attributes,
            )
            for name, values in zip(self.free_parameters, parameter_values.T, strict=True)
        }
        path_dataset_variables |= {
            "objective": (
                "evaluation",
                [trial.objective for trial in trials],
                objective_attributes,
            ),
            "constraint_value": (
                ("evaluation", "constraint"),
                constraint_slacks + min_constraint_values,
            ),
            "margin": ("constraint", min_constraint_values, {"long_name": "least value allowed"}),
            "breach": (
                "evaluation",
                compute_max_violation(constraint_slacks, slack_scales),
                {"long_name": "largest breach of a constraint, in widths of the bounds"},
            ),
            "kind": (
                "evaluation",
                np.array(maximization_result.trial_kinds, int),
                make_flag_attributes(TrialKind.__members__),
            ),
            "outcome": (
                "evaluation",
                np.array(trial_outcomes, int),
                make_measure_attributes("outcome"),
            ),
            "on_branch": ("evaluation", np.array([trial.is_on_branch for trial in trials])),
        }
        constraint_units = [
            self.gait_finder.get_measure(constraint_name).unit
            for constraint_name in self.constraint_names
        ]
        path_dataset_coordinates = {
            "evaluation": np.arange(len(trials)),
            "constraint": list(self.constraint_names),
            "constraint_unit": ("constraint", constraint_units),
            "free_parameter": list(self.free_parameters),
        }
        path_dataset_attributes = {
            "title": f"Path of tuning {self.objective_label} over "
            f"{', '.join(self.free_parameters)}",
            "lower": self.lower_bounds.tolist(),
            "upper": self.upper_bounds.tolist(),
            "ending": maximization_result.status.name,
        }
        provenance_attributes = collect_provenance_attributes(
            self.params, self.gait_finder.model, self.gait_finder.step_options
        )
        return xr.Dataset(
            path_dataset_variables,
            path_dataset_coordinates,
            path_dataset_attributes | provenance_attributes,
        )


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

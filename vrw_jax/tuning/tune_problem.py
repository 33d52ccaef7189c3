"""Tuning of a wheel: maximization of a gait's objective with margins as constraints, with exact
gradients.

Without margins as constraints, the maximization increases double support by letting the foot scuff.
"""

from __future__ import annotations

import dataclasses
import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import (
    AbstractGaitFinder,
    CycleOptions,
    Gait,
    default_margins,
    evaluate_on_gait,
    evaluate_on_gaits,
    is_same_branch,
    make_finder,
    resolve_model,
)
from vrw_jax.measures import (
    MARGIN_MEASURES,
    MEASURES,
    flag_attrs,
    get_measure,
    measure_attrs,
    provenance,
)
from vrw_jax.numerics import StepOptions
from vrw_jax.runtime import with_default_settings
from vrw_jax.runtime import xarray as xr
from vrw_jax.selection import SELECTION_MARGINS, describe_models
from vrw_jax.simulation import ModelLike, check_model, check_single_wheel
from vrw_jax.tuning.exploration import Exploration, explore_starts
from vrw_jax.tuning.maximization import (
    EvaluatedTrial,
    MaximizationResult,
    TrialKind,
    compute_optimality,
    maximize_objective,
)
from vrw_jax.tuning.objective import (
    UPPER_BOUND_PREFIX,
    CycleObjective,
    GaitEvaluation,
    MarginSpec,
    MeasureFunction,
    ObjectiveAndConstraints,
    WeightedSum,
    max_breach,
    parse_margins,
    scale_slacks,
    signed_bound,
)
from vrw_jax.tuning.tune_result import ActiveConstraint, TuneResult, WalkValidation
from vrw_jax.validation import (
    check_int,
    check_known_name,
    check_names,
    check_not_traced,
    check_positive,
    check_range,
    check_real,
    check_type,
    format_value,
)
from vrw_jax.wheel import (
    PARAMETER_DOMAINS,
    PARAMETER_NAMES,
    Outcome,
    WheelParams,
    check_parameter_name,
)

ObjectiveSpec = str | Mapping[str, float] | Callable[..., Array]


@dataclasses.dataclass(frozen=True)
class ValidationOptions:
    """Options of the walk that validates a tuned wheel.

    - `n_steps`: number of steps;
    - `start_displacement`: relative displacement of the start from the limit cycle;
    - `value_tolerance`: accepted violation of a constraint, as a fraction of its value. This and
      the next tolerance are chosen because the optimum satisfies a constraint within 1e-6 of its
      change over the bounds, and because the start is displaced. Each effect is some thousandths of
      a take-off margin;
    - `margin_tolerance`: accepted violation, as a fraction of the constraint's default margin.
    """

    n_steps: int = 10
    start_displacement: float = 1e-5
    value_tolerance: float = 1e-3
    margin_tolerance: float = 1e-2


@with_default_settings
def tune(
    params: WheelParams,
    objective: ObjectiveSpec,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    constraints: MarginSpec | None = None,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
    tolerance: float = 1e-6,
    max_evaluations: int = 200,
    n_starts: int = 1,
    seed: int = 0,
) -> TuneResult:
    """Return the wheel near `params` whose gait maximizes an objective under constraints.

    The default constraints are all margins that gaits of this model can keep (`default_margins`);
    {} is none. A constraint counts as satisfied within 1e-6 of its change over the bounds. The
    method is local: it ends at an optimum of the branch of `params`. With `n_starts` above 1 it
    begins with `params` and random wheels within the bounds. They take 25 first-order steps in one
    batch, and the maximization continues from the best.

    With unilateral contact (`UnilateralWheel`) the objective is a measure of a step or a weighted
    sum of several. A walk from the start finds the first gait. Constraints, none by default, are on
    such measures, for example {"slip": (0.0, 0.05)}. Model "auto" uses the model that is selected
    for the start's gait. If that is the paper's, its margins are the constraints, so that it stays
    valid.

    Args:
        params: the start, one wheel.
        objective: maximized quantity: a measure's name, weights of several, or a function of a
            LimitCycle (and, if it takes two arguments, of the StepResult from it).
        free: names of the parameters that may change.
        bounds: lower and upper bound of each free parameter.
        constraints: lower bounds of measures by name, or pairs of lower and upper bounds, of which
            one may be None: (None, 0.6). Names without bounds have the lower bound zero.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: options of the steps.
        cycle_options: options of the gaits.
        tolerance: tolerance of the first-order condition, relative to the objective's gradient.
        max_evaluations: largest number of evaluated gaits.
        n_starts: number of starts; the maximization continues from the best.
        seed: seed of the random starts.

    Returns:
        A `TuneResult`, whose `status` is CONVERGED at an optimum.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> result = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> print(result.status.name, f"{result.value:.3f}", [c.name for c in result.active])
        CONVERGED 0.534 ['damping']
    """
    check_not_traced("vrw.tune", "maximize by your own loop over vrw.limit_cycle", params)
    max_evaluations = check_int("max_evaluations", max_evaluations)
    n_starts = check_int("n_starts", n_starts)
    tolerance, seed = check_positive("tolerance", tolerance), check_int("seed", seed, 0)
    start_seconds = time.perf_counter()
    problem = make_tune_problem(
        params,
        objective,
        free,
        bounds,
        constraints,
        model=model,
        options=options,
        cycle_options=cycle_options,
    )
    exploration = problem.explore_starts(n_starts, seed) if n_starts > 1 else None
    problem.finder.precompile(params)
    start_trial = problem.evaluate_start(
        problem.normalized_start
        if exploration is None
        else exploration.normalized_parameters[exploration.best_index]
    )
    compiled_seconds = time.perf_counter()
    maximization = maximize_objective(
        problem.evaluate_trial, start_trial, tolerance=tolerance, max_evaluations=max_evaluations
    )
    return problem.make_result(maximization, start_seconds, compiled_seconds, exploration)


@dataclasses.dataclass(frozen=True)
class TuneProblem:
    """Validated tuning problem: free parameters, objective and constraints."""

    params: WheelParams
    free: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    margins: dict[str, float]
    objective_label: str
    objective_and_constraints: ObjectiveAndConstraints
    finder: AbstractGaitFinder
    validation_options: ValidationOptions = ValidationOptions()

    @property
    def widths(self) -> np.ndarray:
        """Return the widths of the bounds, shape (free,)."""
        return self.upper - self.lower

    @property
    def free_indices(self) -> list[int]:
        """Return the indices of the free parameters among all parameters."""
        return [PARAMETER_NAMES.index(name) for name in self.free]

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Return the name of each constrained number; a margin of the locked legs has one per
        leg.
        """
        names: list[str] = []
        for name in self.margins:
            if get_measure(name).dimension:
                names += [f"{name}[leg {leg}]" for leg in range(3, self.params.n_legs + 1)]
            else:
                names.append(name)
        return tuple(names)

    @property
    def min_constraint_values(self) -> np.ndarray:
        """Return the least values of the constraints, in the order of `constraint_names`."""
        return np.array([self.margins[name.partition("[")[0]] for name in self.constraint_names])

    def denormalize(self, normalized_parameters: np.ndarray) -> np.ndarray:
        """Return all float parameters from the free ones in widths above their lower bounds."""
        values = np.array(self.finder.model.parameter_values(self.params))
        values[self.free_indices] = self.lower + normalized_parameters * self.widths
        return values

    def make_wheel(self, normalized_parameters: np.ndarray) -> WheelParams:
        """Return the wheel with these normalized free parameters."""
        return self.finder.model.from_values(
            jnp.asarray(self.denormalize(normalized_parameters)), self.params.n_legs
        )[1]

    @property
    def normalized_start(self) -> np.ndarray:
        """Return the normalized free parameters of the start, shape (free,)."""
        values = np.array([float(getattr(self.params, name)) for name in self.free])
        return np.clip((values - self.lower) / self.widths, 0.0, 1.0)

    def evaluate_start(self, u: np.ndarray) -> EvaluatedTrial:
        """Return the trial at the normalized parameters `u`; raise a ValueError if it is
        unusable.
        """
        trial = self.evaluate_trial(u, None)
        if not trial.is_found:
            raise ValueError(
                f"the start has no gait to tune ({trial.outcome.name}: {trial.outcome.meaning[:-1]}"
                "): start from a wheel that walks, such as WheelParams()."
            )
        if not trial.is_finite:
            description = trial.describe_nonfinite(
                self.objective_label, self.constraint_names, self.min_constraint_values
            )
            raise ValueError(
                f"{description} at the start, but a maximization needs finite numbers: start from "
                "another wheel, or give an objective and constraints that are finite there."
            )
        return trial

    def evaluate_trial(
        self, normalized_parameters: np.ndarray, neighbor: EvaluatedTrial | None
    ) -> EvaluatedTrial:
        """Return the trial at these normalized parameters, searched for from `neighbor` if it
        is given.
        """
        parameters = jnp.asarray(self.denormalize(normalized_parameters))
        neighbor_evaluation = None if neighbor is None else neighbor.evaluation
        guess = (
            self.finder.make_initial_guess(parameters)
            if neighbor_evaluation is None
            else neighbor_evaluation.gait.cycle.warm_start
        )
        gait = self.finder.find_gait(parameters, guess)
        evaluation = GaitEvaluation(gait, *evaluate_on_gait(self.objective_and_constraints, gait))
        outcome, is_on_branch = Outcome(int(evaluation.gait.outcome)), True
        if outcome == Outcome.STEPPED and neighbor is not None and neighbor_evaluation is not None:
            parameter_change = self.denormalize(normalized_parameters) - self.denormalize(
                neighbor.normalized_parameters
            )
            is_on_branch = is_same_branch(
                neighbor_evaluation.gait.branch_point,
                evaluation.gait.branch_point,
                parameter_change,
            )
        return self.make_trial(normalized_parameters, evaluation, outcome, is_on_branch)

    def make_trial(
        self,
        normalized_parameters: np.ndarray,
        evaluation: GaitEvaluation,
        outcome: Outcome,
        is_on_branch: bool,
    ) -> EvaluatedTrial:
        """Return a trial from the objective and constraints of a gait."""
        values = np.array(evaluation.values)
        jacobian = np.array(evaluation.jacobian)[self.free_indices].T * self.widths
        if outcome != Outcome.STEPPED:
            values, jacobian = np.full_like(values, np.nan), np.full_like(jacobian, np.nan)
        return EvaluatedTrial(
            normalized_parameters,
            outcome,
            is_on_branch,
            float(values[0]),
            jacobian[0],
            values[1:] - self.min_constraint_values,
            jacobian[1:],
            evaluation,
        )

    def explore_starts(self, n_starts: int, seed: int) -> Exploration:
        """Take first-order steps from this wheel and random ones in one batch, and return the
        exploration.
        """
        random_starts = np.random.default_rng(seed).uniform(size=(n_starts - 1, len(self.free)))
        exploration = explore_starts(
            self._evaluate_batch,
            np.vstack([self.normalized_start, random_starts]),
            self._parameter_change,
            self.free_indices,
            self.widths,
            self.min_constraint_values,
        )
        if not np.isfinite(exploration.objective).any():
            raise ValueError(
                f"none of {n_starts} starts within the bounds has a gait with a finite objective: "
                "narrow the bounds around wheels that walk, such as WheelParams()."
            )
        return exploration

    def _evaluate_batch(
        self, normalized_parameters: np.ndarray, neighbors: GaitEvaluation | None
    ) -> GaitEvaluation:
        """Return the gaits at rows of normalized parameters, searched for from `neighbors` if
        given.
        """
        parameters = jnp.asarray(
            [self.denormalize(parameter_row) for parameter_row in normalized_parameters]
        )
        guesses = self.finder.make_initial_guesses(parameters)
        guess = guesses if neighbors is None else neighbors.gait.cycle.warm_start
        gait = self.finder.find_gaits(parameters, guess)
        return GaitEvaluation(gait, *evaluate_on_gaits(self.objective_and_constraints, gait))

    def _parameter_change(self, difference: np.ndarray) -> np.ndarray:
        """Return the changes of all parameters, one row per change of the normalized parameters."""
        parameter_change = np.zeros((difference.shape[0], len(self.finder.model.parameter_names)))
        parameter_change[:, self.free_indices] = difference * self.widths
        return parameter_change

    def make_result(
        self,
        maximization: MaximizationResult,
        start_seconds: float,
        compiled_seconds: float,
        exploration: Exploration | None = None,
    ) -> TuneResult:
        """Return the result of a maximization, with active constraints and a validation walk."""
        best_trial = maximization.best
        assert best_trial.evaluation is not None
        gait = best_trial.evaluation.gait
        params = self.make_wheel(best_trial.normalized_parameters)
        conditions = compute_optimality(best_trial)
        active = [
            ActiveConstraint(
                name.removeprefix(UPPER_BOUND_PREFIX),
                signed_bound(name, limit),
                get_measure(name).unit,
                price,
            )
            for name, limit, price in zip(
                self.constraint_names,
                self.min_constraint_values,
                map(float, conditions.prices),
                strict=True,
            )
            if price > 0.0
        ]
        bound_sides = (
            (self.lower, conditions.lower_bound_prices),
            (self.upper, conditions.upper_bound_prices),
        )
        for bound_values, prices in bound_sides:
            for name, limit, price, width in zip(
                self.free, bound_values, prices, self.widths, strict=True
            ):
                if price > 0.0:
                    unit, price_per_unit = get_measure(name).unit, float(price / width)
                    active.append(ActiveConstraint(name, float(limit), unit, price_per_unit))
        end_seconds = time.perf_counter()
        validation = self._validate_by_walking(params, gait)
        measures = gait.step.measures()
        violated_names = [
            name for name in MARGIN_MEASURES if name in measures and np.min(measures[name]) < 0.0
        ]
        return TuneResult(
            params=params,
            status=maximization.status,
            objective=self.objective_label,
            value=best_trial.objective,
            start_value=maximization.trials[0].objective,
            cycle=gait.cycle,
            step=gait.step,
            active=tuple(active),
            kkt_residual=conditions.residual,
            violated_margins=tuple(name for name in violated_names if name not in self.margins),
            validation=validation,
            path=self._make_path(maximization),
            n_evaluations=len(maximization.trials)
            + (0 if exploration is None else exploration.n_evaluations),
            n_backtracks=sum(
                kind in (TrialKind.LOST, TrialKind.NOT_FINITE) for kind in maximization.kinds
            ),
            seconds=end_seconds - start_seconds,
            compile_seconds=compiled_seconds - start_seconds,
            exploration=exploration,
        )

    def _validate_by_walking(self, params: WheelParams, gait: Gait) -> WalkValidation:
        """Return the result of a walk from a state near that of the gait."""
        cycle_state, options = np.array(gait.cycle.section_state), self.validation_options
        # The state is scaled down, not up, because no leg may be beyond its stopper.
        section_state = cycle_state * (1.0 - options.start_displacement)
        is_feasible, outcome, n_walked = True, Outcome.STEPPED, 0
        margins_by_default = default_margins(params)
        for _ in range(options.n_steps):
            step_result = self.finder.take_step(params, jnp.asarray(section_state))
            outcome = Outcome(int(step_result.outcome))
            if outcome != Outcome.STEPPED:
                break
            n_walked, section_state = n_walked + 1, np.array(step_result.section_state)
            measures = {name: np.asarray(value) for name, value in step_result.measures().items()}
            for name, min_value in self.margins.items():
                if (measure := name.removeprefix(UPPER_BOUND_PREFIX)) in measures:
                    value = measures[measure] if measure == name else -measures[measure]
                    default_margin = abs(margins_by_default.get(name, 0.0))
                    tolerance = options.value_tolerance * np.max(np.abs(value))
                    tolerance += options.margin_tolerance * default_margin
                    is_feasible &= bool(np.all(value >= min_value - tolerance - 1e-9))
        distance = float(np.max(np.abs(section_state - cycle_state)))
        return WalkValidation(
            n_walked, outcome, distance, is_feasible and outcome == Outcome.STEPPED
        )

    def _make_path(self, maximization: MaximizationResult) -> xr.Dataset:
        """Return the dataset of all trials in order."""
        dimension = "evaluation"
        normalized_parameters = np.array(
            [trial.normalized_parameters for trial in maximization.trials]
        )
        values = self.lower + normalized_parameters * self.widths
        lower = self.min_constraint_values
        constraints = np.array([trial.slack + lower for trial in maximization.trials])
        start = maximization.trials[0]
        scales = scale_slacks(start.slack, start.slack_jacobian)
        outcomes = [
            trial.outcome if trial.is_on_branch else Outcome.NO_CYCLE_FOUND
            for trial in maximization.trials
        ]
        data: dict[str, Any] = {
            name: (dimension, values[:, parameter_index], measure_attrs(name))
            for parameter_index, name in enumerate(self.free)
        }
        data |= {
            "objective": (
                dimension,
                [trial.objective for trial in maximization.trials],
                {"long_name": self.objective_label},
            ),
            "constraint_value": (
                (dimension, "constraint"),
                constraints.reshape(len(normalized_parameters), lower.size),
            ),
            "margin": ("constraint", lower, {"long_name": "least value allowed"}),
            "breach": (
                dimension,
                np.array([max_breach(trial.slack, scales) for trial in maximization.trials]),
                {"long_name": "largest breach of a constraint, in widths of the bounds"},
            ),
            "kind": (
                dimension,
                np.array(maximization.kinds, int),
                flag_attrs(kind.name for kind in TrialKind),
            ),
            "outcome": (dimension, np.array(outcomes, int), measure_attrs("outcome")),
            "on_branch": (
                dimension,
                np.array([trial.is_on_branch for trial in maximization.trials]),
            ),
        }
        units = [get_measure(name).unit for name in self.constraint_names]
        labels = {
            dimension: np.arange(len(normalized_parameters)),
            "constraint": list(self.constraint_names),
            "constraint_unit": ("constraint", units),
        }
        attrs = {
            "title": f"Path of tuning {self.objective_label} over {', '.join(self.free)}",
            "free": " ".join(self.free),  # It is a text because netCDF has no lists of names.
            "lower": [float(bound) for bound in self.lower],
            "upper": [float(bound) for bound in self.upper],
            "ending": maximization.status.name,
        }
        provenance_attrs = provenance(self.params, self.finder.model, self.finder.step_options)
        return xr.Dataset(data, labels, attrs | provenance_attrs)


def make_tune_problem(
    params: WheelParams,
    objective: ObjectiveSpec,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    constraints: MarginSpec | None = None,
    *,
    model: ModelLike | None = None,
    options: StepOptions | None = None,
    cycle_options: CycleOptions | None = None,
) -> TuneProblem:
    """Return the validated problem that `tune` solves, for single gaits or another method.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.
    """
    check_single_wheel(params, "tune one after the other")
    names, lower, upper = _check_bounds(params, free, bounds)
    checked_model = check_model(model)
    finder = make_finder(
        check_model(resolve_model(params, checked_model)),
        params.n_legs,
        cycle_options=cycle_options,
        step_options=options,
    )
    if not finder.model.is_compliant:
        raise TypeError(
            f"model is {model!r}, but what is tuned has compliant legs: give "
            f"{describe_models('tune')}."
        )
    finder.search_options.check_tolerances(jnp.result_type(*jax.tree.leaves(params)))
    reader, label = _parse_objective(objective, finder)
    if (
        constraints is None
        and checked_model.fallback_model is not checked_model
        and finder.supports_cold_start
    ):
        constraints = tuple(SELECTION_MARGINS)
    margins = parse_margins(params, constraints, finder)
    objective_and_constraints = ObjectiveAndConstraints(
        reader, type(finder).read_measure, tuple(margins)
    )
    if callable(objective):  # Errors of the objective are raised here, before compilation.
        cycle = jax.eval_shape(finder.find_cycle, params)
        x = jax.ShapeDtypeStruct((finder.model.section_size(params),), params.damping.dtype)
        step = jax.eval_shape(finder.model.take_step, params, x, finder.step_options)
        jax.eval_shape(objective_and_constraints, cycle, step)
    return TuneProblem(
        params, names, lower, upper, margins, label, objective_and_constraints, finder
    )


def _parse_objective(
    objective: ObjectiveSpec, finder: AbstractGaitFinder
) -> tuple[MeasureFunction, str]:
    """Return the function of an objective, and its label."""
    if not (callable(objective) or isinstance(objective, str | Mapping)):
        raise TypeError(
            f"objective is {format_value(objective)}, but it is a measure's name, weights of "
            "several or a "
            'function of the cycle: give "dls_fraction", say.'
        )
    if callable(objective):
        if not finder.supports_cold_start:
            raise TypeError(
                "objective is a function, but with contact it must be a measure's name or "
                f"weights of several: choose from {', '.join(finder.differentiable_measures)}."
            )
        label = getattr(objective, "__name__", "objective")
        arguments = inspect.signature(objective).parameters
        return (objective if len(arguments) >= 2 else CycleObjective(objective)), label
    weights = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    if not weights:
        raise ValueError(
            "objective is an empty mapping, but something must be maximised: "
            'give a measure such as "dls_fraction".'
        )
    for name, weight in weights.items():
        check_known_name(name, finder.readable_measures, "measure for objective")
        check_real(f"the weight of {name}", weight)
        if MEASURES[name].dimension:
            raise ValueError(
                f"{name} has one value for each locked leg, but an objective is one number: "
                "give a function of the cycle and the step that reduces it."
            )
    label = " + ".join(
        measure_name if measure_weight == 1.0 else f"{measure_weight:g} {measure_name}"
        for measure_name, measure_weight in weights.items()
    )
    return WeightedSum(type(finder).read_measure, tuple(weights.items())), label.replace(
        "+ -", "- "
    )


def _check_bounds(
    params: WheelParams, free: Sequence[str], bounds: Mapping[str, tuple[float, float]]
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Return the names of the free parameters, their lower and their upper bounds."""
    names = check_names("free", free)
    check_type("bounds", bounds, Mapping, "write {'damping': (100.0, 200.0)}")
    if len(set(names)) < len(names):
        raise ValueError(f"free is {names}, which names one twice: name each once.")
    if not names:
        raise ValueError(
            f"free names no parameter, but at least one must move: choose from "
            f"{', '.join(PARAMETER_NAMES)}."
        )
    for name in (*names, *bounds):
        check_parameter_name(name, PARAMETER_NAMES, "parameter of the wheel")
    for name in bounds:
        if name not in names:
            raise ValueError(f"bounds holds {name!r}, but it is not free: add it to free.")
    for name in names:
        if name not in bounds:
            raise ValueError(f"{name} is free but has no bounds: give bounds[{name!r}].")
        lower_bound, upper_bound = check_range(f"the range of {name}", bounds[name])
        for bound_value in (lower_bound, upper_bound):
            if not PARAMETER_DOMAINS[name].contains(bound_value):
                raise ValueError(
                    f"the bounds of {name} reach {bound_value:g}, but "
                    f"{PARAMETER_DOMAINS[name].description} must lie "
                    f"in {PARAMETER_DOMAINS[name]}: keep them inside."
                )
        value = float(getattr(params, name))
        if not lower_bound <= value <= upper_bound:
            raise ValueError(
                f"the start has {name} {value:g}, outside its bounds "
                f"({lower_bound:g}, {upper_bound:g}): widen the bounds or start inside them."
            )
    bound_pair = np.array([[float(bound) for bound in bounds[name]] for name in names])
    return names, bound_pair[:, 0], bound_pair[:, 1]

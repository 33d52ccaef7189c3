"""Tuning of a wheel: maximization of an objective for its gait, with margins as constraints.

Gradients are exact. Without margins as constraints, the maximization would increase double support
until the foot scuffs. An optimum can be followed along a parameter, with its constraints and active
set. The optimum at each value starts from that at the value before. If the set of active limits
differs at two neighboring values, the values between are bisected.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import check_int, check_positive, require_untraced_arguments
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait, report_progress
from vrw_jax.base.results import (
    Outcome,
    format_heading_and_rows,
    format_html_table,
    format_quantity,
)
from vrw_jax.base.results import xarray as xr
from vrw_jax.gaits.cycle import CycleOptions, default_margins
from vrw_jax.gaits.finder import Gait
from vrw_jax.models.ladder import collect_provenance_attributes
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    describe_parameter,
    make_flag_attributes,
    make_measure_attributes,
)
from vrw_jax.models.stepping import ModelLike
from vrw_jax.studies.tune_maximization import (
    EvaluatedTrial,
    ExplorationResult,
    MaximizationResult,
    TrialKind,
    TuneStatus,
    compute_max_violation,
    compute_slack_scales,
    maximize_objective,
)
from vrw_jax.studies.tune_problem import (
    UPPER_BOUND_PREFIX,
    ConstraintSpecification,
    ObjectiveSpecification,
    ParameterBounds,
    TuneProblem,
    check_along,
    make_tune_problem,
    restore_sign_of_bound,
)

NO_ACTIVE_CONSTRAINT_TEXTS = {
    TuneStatus.CONVERGED: "nothing: a maximum inside all bounds and constraints",
    TuneStatus.BRANCH_ENDED: "the end of the branch, no constraint and no bound",
    TuneStatus.MAX_EVALUATIONS_REACHED: "nothing so far: the maximization has not ended",
    TuneStatus.NO_FEASIBLE_GAIT: "nothing: a constraint is broken here",
    TuneStatus.STALLED: "nothing: the first-order condition is not met",
}
"""Texts that state why no constraint or bound is active, by the status of the maximization."""


class ActiveConstraint(NamedTuple):
    """Active constraint or bound at the optimum.

    - `name`: name of the parameter, or of the constraint with its leg label if it has one;
    - `limit`: bound on the parameter or on the constrained measure;
    - `unit`: unit of the limit;
    - `price`: gain of the objective per unit by which the limit is relaxed, which is the Lagrange
      multiplier. It is NaN if `price_range` contains more than one number;
    - `price_range`: smallest and largest price that satisfy the first-order condition. They differ
      if more limits are active than parameters are free, for example. Both are NaN if the gait does
      not satisfy the condition.
    """

    name: str
    limit: float
    unit: str
    price: float
    price_range: tuple[float, float]

    def describe_price(self) -> str:
        """Return the price, or its range, as text."""
        low, high = self.price_range
        if low == high:
            return f"{self.price:.4g}"
        if low != low:
            return "undefined, because the first-order condition is not met"
        return f"not unique: {low:.4g} to {high:.4g}"


class WalkValidation(NamedTuple):
    """Validation of the tuned wheel by a walk from a slightly displaced start.

    - `n_steps`: number of completed steps;
    - `outcome`: outcome of the last step;
    - `distance`: distance from the limit cycle after the last step, rad, rad/s and m/s;
    - `is_feasible`: whether every step satisfied every constraint on a margin, to within the sum of
      1e-3 of its value and 1e-2 of its default margin.
    """

    n_steps: int
    outcome: Outcome
    distance: float
    is_feasible: bool


@dataclasses.dataclass(frozen=True)
class TuneResult:
    """Result of tuning: the gait, the path of the maximization, and the active constraints.

    - `params`: the tuned wheel;
    - `status`: reason why the maximization ended;
    - `objective`, `value`, `start_value`: name of the objective, and its value at the tuned gait
      and at the start, which is NaN if only other starts have a gait;
    - `active`: constraints and bounds that are active, each with its price;
    - `validation`: validation by a walk of ten steps of the tuned wheel;
    - `cycle`: the gait as a LimitCycle, or as a ReturnMapCycle with unilateral contact;
    - `step`: step of the gait, as a StepResult or a UnilateralStep;
    - `kkt_residual`: residual of the first-order condition, with the slacks of constraints that
      have a price, relative to the largest gradient of the objective on the path;
    - `kinks`: names of the objective and of active constraints that have a kink at the gait. A
      margin has a kink where its minimum occurs at several instants, or on several legs, at once.
      The multiplier of such a constraint is the sum over the instants;
    - `violated_margins`: names of violated margins that are not constraints;
    - `path`: every gait that was evaluated, in order;
    - `n_evaluations`: number of evaluated gaits, each with one walking step;
    - `n_backtracks`: number of trials without a gait on the branch, or with values that are not
      finite;
    - `seconds`: total time, s;
    - `compile_seconds`: time of compilation, and of the exploration if there are many starts, s;
    - `exploration`: results of many starts before the maximization;
    - `model`: the model with the tuned leg force, if it has one.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> result = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> print(f"{result.params.damping:.1f} N s/m, {bool(result.cycle.found)}")
        215.0 N s/m, True
    """

    params: Any
    status: TuneStatus
    objective: str
    value: float
    start_value: float
    cycle: Any
    step: Any
    active: tuple[ActiveConstraint, ...]
    kkt_residual: float
    violated_margins: tuple[str, ...]
    validation: WalkValidation
    path: xr.Dataset
    n_evaluations: int
    n_backtracks: int
    seconds: float
    compile_seconds: float
    exploration: ExplorationResult | None = None
    kinks: tuple[str, ...] = ()
    model: Any = None

    @property
    def converged(self) -> bool:
        """Return whether the maximization ended at an optimum."""
        return self.status == TuneStatus.CONVERGED

    @property
    def ending(self) -> str:
        """Return a sentence with the reason why the maximization ended."""
        return self.status.meaning

    def describe(self) -> dict[str, str]:
        """Return the printed texts that summarize the result, by label."""

        def describe_value(name: str) -> str:
            value = self.model.get_parameter(self.params, name)
            return format_quantity(value, self.path[name].attrs["units"])

        names = self.path.free_parameter.values
        parameter_texts = [f"{name} {describe_value(name)}" for name in names]
        feasibility_text = (
            "every constraint kept" if self.validation.is_feasible else "a constraint broken"
        )
        if not self.path.sizes["constraint"]:
            feasibility_text = "no constraint to keep"
        active_constraint_texts = [
            f"{limit.name} at {format_quantity(limit.limit, limit.unit)}" for limit in self.active
        ]
        kink_texts = {
            "kink": f"{', '.join(self.kinks)}: the minimum occurs at several instants at once"
        }
        return {
            "objective": f"{self.objective}: {self.start_value:.6g} at the start, {self.value:.6g}",
            "wheel": ", ".join(parameter_texts),
            "ending": f"{self.status.name}: {self.status.meaning}",
            "held by": ", ".join(active_constraint_texts)
            or NO_ACTIVE_CONSTRAINT_TEXTS[self.status],
            **(kink_texts if self.kinks else {}),
            "not asked for, and broken": ", ".join(self.violated_margins) or "none",
            "walked": f"{self.validation.n_steps} steps, {self.validation.outcome.name}, "
            f"{self.validation.distance:.1e} from the cycle at last; {feasibility_text}",
            "cost": f"{self.n_evaluations} gaits, {self.n_backtracks} steps shortened, "
            f"{self.seconds - self.compile_seconds:.2f} s and {self.compile_seconds:.1f} s to "
            "compile",
        }

    def __repr__(self) -> str:
        return format_heading_and_rows("TuneResult", self.describe().items())

    def _repr_html_(self) -> str:
        return format_html_table("Tuned gait", self.describe().items())


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


def make_tune_result(
    problem: TuneProblem,
    result: MaximizationResult,
    start_seconds: float,
    compilation_end_seconds: float,
    exploration: ExplorationResult | None,
) -> TuneResult:
    """Return the `TuneResult` for a maximization, with active constraints and a validation walk."""
    trial, finder = result.best_trial, problem.gait_finder
    gait, model = trial.gait, finder.model
    params = problem.make_wheel(trial.normalized_parameters)
    laws = getattr(params, "laws", None)
    if laws is not None:
        model = model.with_laws(laws)
    units = {name: domain.unit for name, domain in model.parameter_domains.items()}
    conditions = problem.compute_conditions_per_unit(result)
    price_ranges = conditions.price_ranges
    if not conditions.are_satisfied:
        price_ranges[price_ranges[:, 1] > 0.0] = np.nan
    active_constraints = [
        ActiveConstraint(
            name.removeprefix(UPPER_BOUND_PREFIX),
            restore_sign_of_bound(name, limit),
            units.get(name) or finder.get_measure(name).unit,
            low if low == high else np.nan,
            (low, high),
        )
        for name, limit, (low, high) in zip(
            (*problem.constraint_names, *problem.free_parameters * 2),
            [*problem.min_constraint_values, *problem.lower_bounds, *problem.upper_bounds],
            price_ranges.tolist(),
            strict=True,
        )
        if high != 0.0
    ]
    kink_names = [
        name.removeprefix(UPPER_BOUND_PREFIX)
        for name in (problem.objective_label, *problem.constraint_names)
    ]
    end_seconds = time.perf_counter()
    measures = finder.measure_step(params, gait.cycle, gait.step)
    return TuneResult(
        params=params if laws is None else params.attach_laws(None),
        model=model,
        status=result.status,
        objective=problem.objective_label,
        value=float(trial.objective),
        start_value=float(
            exploration.start_objective[0] if exploration else result.evaluated_trials[0].objective
        ),
        cycle=gait.cycle,
        step=gait.step,
        active=tuple(active_constraints),
        kkt_residual=conditions.kkt_residual,
        kinks=tuple(np.array(kink_names)[conditions.has_kink].tolist()),
        violated_margins=tuple(
            name
            for name in MARGIN_MEASURES
            if name in measures
            and name not in problem.constraint_margins
            and np.min(measures[name]) < 0.0
        ),
        validation=_validate_by_walking(problem, params, gait),
        path=_make_path_dataset(problem, result),
        n_evaluations=len(result.evaluated_trials)
        + (0 if exploration is None else exploration.n_evaluations),
        n_backtracks=sum(
            kind in (TrialKind.LOST, TrialKind.NOT_FINITE) for kind in result.trial_kinds
        ),
        seconds=end_seconds - start_seconds,
        compile_seconds=compilation_end_seconds - start_seconds,
        exploration=exploration,
    )


def _validate_by_walking(problem: TuneProblem, params: Any, gait: Gait) -> WalkValidation:
    """Simulate a walk that starts near the section state of the gait, and validate its steps."""
    cycle_state, finder = np.array(gait.cycle.section_state), problem.gait_finder
    # The state is scaled down, not up, because no leg may be beyond its stopper.
    state = cycle_state * (1.0 - RELATIVE_START_DISPLACEMENT)
    is_feasible, outcome, n_steps = True, Outcome.STEPPED, 0
    margins = default_margins(params) if finder.model.is_wheel else {}
    for _ in range(N_STEPS_OF_WALK):
        step = finder.take_gait_step(params, jnp.asarray(state))
        outcome = Outcome(int(step.outcome))
        if outcome != Outcome.STEPPED:
            break
        measures = finder.measure_step(params, state, step)
        n_steps, state = n_steps + 1, np.array(step.section_state)
        for constraint_name, min_value in problem.constraint_margins.items():
            name = constraint_name.removeprefix(UPPER_BOUND_PREFIX)
            if name not in measures:
                continue
            value = np.asarray(measures[name])
            if name != constraint_name:
                value = -value
            tolerance = CONSTRAINT_VALUE_TOLERANCE * np.max(
                np.abs(value)
            ) + DEFAULT_MARGIN_TOLERANCE * abs(margins.get(constraint_name, 0.0))
            is_feasible &= bool(np.all(value >= min_value - tolerance))
    distance = float(np.max(np.abs(state - cycle_state)))
    is_feasible &= outcome == Outcome.STEPPED
    return WalkValidation(n_steps, outcome, distance, is_feasible)


def _make_path_dataset(problem: TuneProblem, result: MaximizationResult) -> xr.Dataset:
    """Return a dataset that lists all trials of a maximization in order."""
    trials, finder = result.evaluated_trials, problem.gait_finder
    stack = lambda name: np.array([getattr(trial, name) for trial in trials])
    parameters = problem.lower_bounds + stack("normalized_parameters") * problem.bound_widths
    slacks, least_values = stack("constraint_slacks"), problem.min_constraint_values
    scales = compute_slack_scales(trials[0].constraint_slacks, trials[0].slack_jacobian)
    outcomes = [trial.outcome if trial.is_on_branch else Outcome.NO_CYCLE_FOUND for trial in trials]
    domains, label = finder.model.parameter_domains, problem.objective_label
    objective_attributes = {"long_name": label}
    if label in finder.differentiable_measures:
        objective_attributes["units"] = finder.get_measure(label).unit
    breach_attributes = {"long_name": "largest breach of a constraint, in widths of the bounds"}
    per_trial = lambda values, attributes=None: ("evaluation", values, attributes)
    kinds, members = np.array(result.trial_kinds, int), TrialKind.__members__
    variables: dict[str, Any] = {
        name: per_trial(values, describe_parameter(name, domains[name]).variable_attributes)
        for name, values in zip(problem.free_parameters, parameters.T, strict=True)
    }
    variables |= {
        "objective": per_trial(stack("objective"), objective_attributes),
        "constraint_value": (("evaluation", "constraint"), slacks + least_values),
        "margin": ("constraint", least_values, {"long_name": "least value allowed"}),
        "breach": per_trial(compute_max_violation(slacks, scales), breach_attributes),
        "kind": per_trial(kinds, make_flag_attributes(members)),
        "outcome": per_trial(np.array(outcomes, int), make_measure_attributes("outcome")),
        "on_branch": per_trial(stack("is_on_branch")),
    }
    units = [finder.get_measure(name).unit for name in problem.constraint_names]
    return xr.Dataset(
        variables,
        {
            "evaluation": np.arange(len(trials)),
            "constraint": list(problem.constraint_names),
            "constraint_unit": ("constraint", units),
            "free_parameter": list(problem.free_parameters),
        },
        {
            "title": f"Path of tuning {label} over {', '.join(problem.free_parameters)}",
            "lower": problem.lower_bounds.tolist(),
            "upper": problem.upper_bounds.tolist(),
            "ending": result.status.name,
        }
        | collect_provenance_attributes(problem.params, finder.model, finder.step_options),
    )


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


@dataclasses.dataclass(frozen=True, repr=False)
class OptimumCurve:
    """Optima of `tune` along a parameter.

    - `parameter`: name of the parameter along which the optimum is followed;
    - `dataset`: best free parameters, objective, and price of each limit by its name, over the
      dimension `point`, with the parameter as a coordinate. A price of 0 is that of an inactive
      limit. The two bounds of a measure are two limits;
    - `changes`: changes of the set of active limits, as `ActiveSetChange`. Where the sets at two
      neighboring points are equal, changes between these points are not found;
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
    problem: TuneProblem,
    name: str,
    values: Sequence[float],
    start_trial: EvaluatedTrial,
    tolerance: float,
    max_evaluations: int,
) -> OptimumCurve:
    """Follow the optimum of a problem through the values of a parameter, in their order."""
    measures = [x.removeprefix(UPPER_BOUND_PREFIX) for x in problem.constraint_names]
    limit_names = [
        *(
            measure
            if measures.count(measure) == 1
            else f"{measure} at its {'lower' if measure == constraint else 'upper'} bound"
            for constraint, measure in zip(problem.constraint_names, measures, strict=True)
        ),
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
            failures.append("The search finds no gait near its start.")
            return None
        result = maximize_objective(local.evaluate_trial, start, tolerance, max_evaluations)
        if result.status != TuneStatus.CONVERGED:
            failures.append(result.status.meaning)
            return None
        prices = problem.compute_conditions_per_unit(result).price_ranges[:, 1]
        active = tuple(x for x, price in zip(limit_names, prices, strict=True) if price > 0.0)
        return _Optimum(value, result.best_trial, active, prices)

    first = optimize(float(values[0]), start_trial)
    if first is None:
        raise ValueError(
            f"no optimum is found at {name} {float(values[0]):g}, where the curve begins: "
            f"{failures[-1]} Give other bounds or constraints, or a better start."
        )
    optima, changes = [first], []
    accuracy = CHANGE_LOCATION_ACCURACY * float(np.ptp(values))

    def locate_changes(left: _Optimum, right: _Optimum) -> list[ActiveSetChange]:
        if left.active == right.active:
            return []
        middle, value = None, 0.5 * (left.value + right.value)
        if abs(right.value - left.value) > accuracy:
            middle = optimize(value, left.trial)
        if middle is None:
            return [ActiveSetChange(value, left.active, right.active)]
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
    dataset = _make_optimum_dataset(problem, name, limit_names, optima)
    return OptimumCurve(name, dataset, tuple(changes), ending)


def _make_optimum_dataset(
    problem: TuneProblem, name: str, limit_names: list[str], optima: list[_Optimum]
) -> xr.Dataset:
    """Return best parameters, objectives and prices over the values of a parameter."""
    domains = problem.gait_finder.model.parameter_domains
    describe = lambda name: {"units": domains[name].unit, "symbol": domains[name].symbol}
    normalized = np.array([x.trial.normalized_parameters for x in optima])
    parameters = problem.lower_bounds + normalized * problem.bound_widths
    ever_active = [x for x in limit_names if any(x in optimum.active for optimum in optima)]
    prices = np.array([x.prices for x in optima])[:, [limit_names.index(x) for x in ever_active]]
    return xr.Dataset(
        {
            free: ("point", column, describe(free))
            for free, column in zip(problem.free_parameters, parameters.T, strict=True)
        }
        | {
            "objective": ("point", np.array([float(x.trial.objective) for x in optima])),
            "price": (("point", "limit"), prices),
        },
        {
            name: ("point", np.array([x.value for x in optima]), describe(name)),
            "limit": np.array(ever_active, dtype=str),
        },
        {"title": f"Optima of {problem.objective_label} along {name}"},
    )


@announce_wait("the gait, objective and constraints with derivatives", "15 s")
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
    start_seconds = time.perf_counter()
    problem = make_tune_problem(
        params, objective, free, bounds, constraints,
        model=model, options=options, cycle_options=cycle_options,
    )  # fmt: skip
    name_and_values = None if along is None else check_along(problem, along)
    exploration, start = None, problem.normalized_start
    if n_starts > 1:
        exploration = problem.explore_random_starts(n_starts, seed)
        start = exploration.normalized_parameters[exploration.best_start_index]
    problem.gait_finder.precompile_programs(params)
    start_trial = problem.evaluate_start_trial(start)
    if name_and_values is not None:
        return follow_optimum(problem, *name_and_values, start_trial, tolerance, max_evaluations)
    compilation_end_seconds = time.perf_counter()
    result = maximize_objective(problem.evaluate_trial, start_trial, tolerance, max_evaluations)
    return make_tune_result(problem, result, start_seconds, compilation_end_seconds, exploration)

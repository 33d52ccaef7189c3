"""Fit of a walker's parameters to measurements, and comparison of leg laws by their fits."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import (
    check_choice,
    check_int,
    check_names,
    check_numpy_reals,
    check_real,
    check_type,
    require_known_name,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions, list_parameters, parameter
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.base.walker import is_own_walker, propose_starts
from vrw_jax.gaits.gait_search import limit_cycle, limit_cycles, resolve_finder, resolve_model
from vrw_jax.studies.fit_problem import (
    HEIGHT_COLUMN,
    OFFSET_SUFFIX,
    START_NAMES,
    START_PREFIX,
    TIME_OFFSET,
    FitProblem,
    FitTarget,
    describe_unknowns,
    measure_candidates,
    solve_fits,
)
from vrw_jax.studies.fit_result import (
    DATASET_DIMENSION,
    FitData,
    FitResult,
    make_result,
    read_data,
    summarize,
)

N_STARTS = 8
"""Default number of starts. The first start is the given walker."""
N_CANDIDATES = 64
"""Number of candidates from which the other starts are selected."""
START_RANGE_FACTOR = 2.0
"""Factor by which starts differ from the given walker, where no bounds are given."""
N_FOLDS = 5
DURATION_MARGIN = 1.2
"""Ratio of the predicted duration of a walk at the given parameters to that of a series. The walk
may become so much faster during the search."""
MAX_STEPS = 1000


@announce_wait("predictions with derivatives, and their fit", "30 s")
def fit(
    data: Any,
    params: Any,
    free: Sequence[str] = ("damping", "stiffness"),
    *,
    model: Any = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    start: Any = None,
    extra: Mapping[str, float] | None = None,
    observe: Callable[[Any, dict[str, Any]], Mapping[str, Any]] | None = None,
    covariance: Any = None,
    window: float | None = None,
    n_starts: int = N_STARTS,
    options: StepOptions | None = None,
) -> FitResult:
    """Estimate parameters of a walker from measurements, with their uncertainty.

    The kind of the data follows from their columns:

    - **gaits**: each row is a steady gait, and its columns are measures such as "period";
    - **steps**, with a column "step": each row is a step of a walk that need not be periodic. The
      columns are durations, states at touchdown, or "touchdown_time" and "takeoff_time";
    - **series**, with a column "time": forces, angles and lengths, as in `vrw.simulate`.

    Each measured column has a column of its standard errors, as "period_error". Units are those of
    xarray's attribute `units`, or in the heading, as "period [ms]"; SI units otherwise. Columns
    with names of parameters, as "slope", describe each row. A column "walk" distinguishes walks. A
    dimension "dataset" is a batch of data sets, which are fitted in one call.

    The Levenberg-Marquardt method of optimistix minimizes the sum of squared residuals, with exact
    derivatives of gaits, steps and events. Standard errors follow from the derivatives and from the
    errors of the data. Wheels without a gait are rejected during the search.

    Args:
        data: an xarray Dataset, a pandas DataFrame, a dictionary of columns or a CSV file.
        params: the walker at which the search starts, with the known parameters.
        free: names of the unknown parameters, which all rows share; "slope_offset" is added to the
            slopes of all rows, and "time_offset" to all times.
        model: the model, or your own walker; the paper's, `ViscoelasticWheel()`, by default.
        bounds: lower and upper bound of unknowns by name; by default the domain of the parameter.
        priors: mean and standard deviation of unknowns by name.
        start: section state at the start of a walk, one for each walk, or "gait" for the steady
            gait. By default it is unknown and estimated too. For gaits, the search begins there.
        extra: first values of further unknowns that `observe` uses, by name.
        observe: function of the predicted columns and of `extra`, as dictionaries. It returns what
            the sensors report.
        covariance: covariance of the columns of a row, instead of standard errors.
        window: time before and after a sample of a series over which it is a mean, with weights
            that fall linearly, s; by default the sampling interval, and 0 for instantaneous values.
        n_starts: number of starts of the search, of which the best fit is returned: the given
            walker, and the best of a scan around it or within bounds.
        options: numerical options of the steps.

    Returns:
        A `FitResult`, which prints a summary.

    Raises:
        TypeError, ValueError: if an argument or a number is invalid; the message names the remedy.

    Examples:
        >>> data = {"period": [0.70], "period_error": [0.002], "speed": [0.92]}
        >>> data |= {"speed_error": [0.01], "slope": [0.30]}
        >>> result = vrw.fit(data, vrw.WheelParams(damping=150.0), free=["damping"])
        >>> print(result.names, result.dof, bool(result.converged))
        ('damping',) 1 True
    """
    require_untraced_arguments("vrw.fit", "use result.log_likelihood", params)
    free = check_names("free", free, '"damping", "stiffness"')
    bounds, priors, extra = dict(bounds or {}), dict(priors or {}), dict(extra or {})
    options = StepOptions() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    n_starts = check_int("n_starts", n_starts)
    finder, units, entries = _resolve_walker(params, model, start, options)
    table = _read_table(data, params, finder, covariance, units)
    problem, targets, first = _make_problem(
        table, params, free, finder, entries, bounds, priors, start, extra, observe, window, options
    )
    starts = _choose_starts(problem, targets, first, {*bounds}, {*free}, n_starts)
    return _fit_from_starts(problem, targets, starts, table, units, params, start is None)


def _read_table(
    data: Any, params: Any, finder: Any, covariance: Any, units: dict[str, str]
) -> FitData:
    """Return the checked data, or raise an error if the model has no data of their kind."""
    model = finder.model
    time_unit = math.sqrt(params.locked_length / params.gravity) if model.is_wheel else None
    table = read_data(data, covariance, units, model.parameter_names, time_unit)
    if table.kind == "gaits" and finder.leg_period > 1 and finder.is_multistable:
        raise ValueError(
            f"the legs alternate, but with a {type(model).__name__} the data of gaits are of one "
            "step only: fit steps, or give vrw.ViscoelasticWheel(leg_force=...), or one law for "
            "all legs."
        )
    if table.kind == "series" and not model.is_compliant:
        raise ValueError(
            "data have a column 'time', but series need legs with springs: fit the steps or gaits."
        )
    return table


def _make_problem(
    table: FitData,
    params: Any,
    free: Sequence[str],
    finder: Any,
    entries: tuple[str, ...],
    bounds: Mapping[str, Any],
    priors: Mapping[str, Any],
    start: Any,
    extra: dict[str, float],
    observe: Any,
    window: float | None,
    options: StepOptions,
) -> tuple[FitProblem, FitTarget, np.ndarray]:
    """Return the problem, what its predictions are compared with, and first values of unknowns.

    - `entries`: entries of the start of a walk that may be unknown.
    """
    model, n_rows = finder.model, table.values.shape[1]
    walks, row_walks = np.unique(table.labels.get("walk", np.zeros(n_rows)), return_inverse=True)
    starts_from_gait = isinstance(start, str) and check_choice("start", start, ("gait",)) == "gait"
    first_states: Any = _find_first_states(
        table.kind, params, finder, start, len(walks), table.conditions
    )
    has_unknown_starts = start is None and table.kind != "gaits"
    if has_unknown_starts and model.is_wheel and first_states.shape[1] > 3:
        # Of a full section state, Leg 1 stands on the ground, and the others on their stoppers.
        first_states = first_states[:, [0, 1, 4 + params.n_legs]]
    start_names = [
        f"{START_PREFIX}{entry}{f'[{walk}]' if len(walks) > 1 else ''}"
        for walk in range(len(walks))
        for entry in entries
        if has_unknown_starts
    ]
    row_steps, n_steps, window = _arrange_steps(
        table, finder, params, None if starts_from_gait else first_states, window, options
    )
    unknown_names = (*free, *extra, *start_names)
    _check_unknowns(table, finder, free, unknown_names, (*bounds, *priors), observe)
    base_values = np.asarray(model.collect_parameter_values(params), float)
    known_values = dict(zip(model.parameter_names, base_values, strict=True)) | extra
    first = np.array([float(known_values.get(name, 0.0)) for name in (*free, *extra)])
    if start_names:
        first = np.append(first, first_states[:, : len(entries)])
    n_numbers = table.values[0].size + len(priors)
    lower, upper, scale, prior_means, prior_weights = describe_unknowns(
        unknown_names, first, bounds, priors, model.parameter_domains
    )
    if n_numbers < len(first):
        raise ValueError(
            f"data contain {n_numbers} numbers for {len(first)} unknowns ("
            f"{', '.join(unknown_names)}), which cannot be estimated from fewer: measure more, or "
            "give start= or fewer free parameters."
        )
    arrays = {
        "base_values": tuple(base_values),
        "conditions": _arrange_conditions(table, model, walks, row_walks, row_steps, n_steps),
        "row_walks": row_walks,
        "row_steps": row_steps,
        "times": table.labels.get("time"),
        "window": window,
        "starts": first_states,
        "whitener": table.whitener,
    }
    problem = FitProblem(
        finder=finder,
        **jax.tree.map(jnp.asarray, arrays),
        lower=lower,
        upper=upper,
        scale=scale,
        options=options,
        names=table.names,
        unknown_names=unknown_names,
        extra_names=tuple(extra),
        kind=table.kind,
        n_steps=n_steps,
        n_start_entries=len(entries) if start_names else 0,
        starts_from_gait=starts_from_gait,
        observe=observe,
    )
    ones = np.ones((1, n_rows))
    targets = FitTarget(table.values, ones, prior_means[None], prior_weights[None])
    return problem, targets, first


def _fit_from_starts(
    problem: FitProblem,
    targets: FitTarget,
    starts: np.ndarray,
    table: FitData,
    units: dict[str, str],
    params: Any,
    can_replace_guesses: bool,
) -> FitResult:
    """Return the best fit from all starts, and for a batch the fit of each data set from there.

    - `can_replace_guesses`: whether a fit to gaits may replace the guesses from which they are
      found.
    """
    domains = problem.finder.model.parameter_domains
    units = {**units, **{name: domain.unit for name, domain in domains.items()}, "time": "s"}
    quantities = [
        name.removesuffix(OFFSET_SUFFIX).removeprefix(START_PREFIX)
        for name in problem.unknown_names
    ]
    unknown_units = tuple(units.get(name.partition("[")[0], "1") for name in quantities)
    walker = problem.unpack(problem.base_values)[0]
    arguments = table, unknown_units, params, walker
    mean_targets = targets._replace(values=targets.values.mean(0, keepdims=True))
    fit_mean = lambda problem, starts: make_result(
        problem, mean_targets, starts, *arguments, is_batch=False
    )
    mean_fit = fit_mean(problem, starts)
    if is_own_walker(walker) and table.kind == "gaits" and can_replace_guesses:
        mean_fit = _improve_with_new_guesses(mean_fit, fit_mean)
    if not table.is_batch:
        return mean_fit
    starts = np.tile(mean_fit.values, (len(table.values), 1))
    return make_result(mean_fit.problem, targets, starts, *arguments, is_batch=True)


def _resolve_walker(
    params: Any, model: Any, start: Any, options: StepOptions
) -> tuple[Any, dict[str, str], tuple[str, ...]]:
    """Return the finder of gaits, the units of quantities by name, and the entries of a start that
    may be unknown.
    """
    if is_own_walker(model):
        guess = None if start is None or isinstance(start, str) else np.atleast_2d(start)[0]
        finder: Any = resolve_finder(params, model, options, guess=guess)
        own_units = [(measure.name, measure.unit) for measure in finder.described_measures]
        own_units += [(name, x.unit) for name, x in finder.model.named_domains]
        # Without a declaration, the unit is unknown.
        units = {"period": "s"} | {name: unit for name, unit in own_units if unit != "1"}
        return finder, units, finder.coordinates
    model = resolve_model(params, model)
    finder = resolve_finder(params, model, None, getattr(model, "leg_period", 1))
    # The landing on both feet of the paper's wheel leaves two of the three entries.
    return finder, finder.model.units, START_NAMES[:2]


def _arrange_steps(
    table: Any,
    finder: Any,
    params: Any,
    first_states: np.ndarray | None,
    window: float | None,
    options: StepOptions,
) -> tuple[np.ndarray | None, int, float | None]:
    """Return the index of the step of each row, the number of steps, and the window of a series.

    - `first_states`: section states at which the walks begin, None for the steady gait.
    """
    row_steps, times = table.labels.get("step"), table.labels.get("time")
    n_steps = 1
    if row_steps is not None:
        if (parts := row_steps[row_steps % 1.0 != 0.0]).size:
            raise ValueError(
                f"step is {parts[0]:g}, but the steps of a walk are numbered: give whole numbers."
            )
        row_steps = row_steps.astype(int) - int(row_steps.min())
        n_steps = int(row_steps.max()) + 1
    if times is None:
        return row_steps, n_steps, None
    spacing = float(np.median(np.diff(np.unique(times)))) if len(times) > 1 else 0.0
    window = spacing if window is None else float(check_real("window", window))
    if first_states is None:
        return row_steps, finder.leg_period, window
    if times.min() < window:
        raise ValueError(
            f"the series begins {times.min():g} s after the first touchdown, but its samples are "
            f"means over {window:g} s before and after them: begin later, or give window=."
        )
    last_time = float(times.max()) + window
    n_steps = max(n_steps, _count_steps(finder, params, first_states, last_time, options))
    return row_steps, n_steps, window


def _check_unknowns(
    table: Any,
    finder: Any,
    free: Sequence[str],
    unknown_names: tuple[str, ...],
    described_names: Sequence[str],
    observe: Any,
) -> None:
    """Raise an error unless the names of unknowns and of columns are known.

    - `described_names`: names of unknowns with bounds or a prior.
    """
    parameter_names = finder.model.parameter_names
    offset_names = [f"{name}{OFFSET_SUFFIX}" for name in parameter_names]
    if table.kind == "series":
        offset_names.append(TIME_OFFSET)
    for name in free:
        require_known_name(name, (*parameter_names, *offset_names), "parameter of the walker")
        if name in table.conditions:
            raise ValueError(
                f"{name} is free and a column of data, but a column describes what is known: free "
                f"{name}_offset, or remove one of them."
            )
    if not unknown_names or len(set(unknown_names)) < len(unknown_names):
        raise ValueError(f"the unknowns are {unknown_names}, but each is named once: change free.")
    for name in described_names:
        require_known_name(name, unknown_names, "unknown")
    if table.kind == "gaits" and observe is None:
        for name in table.names:
            require_known_name(name, finder.differentiable_measures, "measure of gaits")


def _find_first_states(
    kind: str,
    params: Any,
    finder: Any,
    start: Any,
    n_walks: int,
    conditions: Mapping[str, np.ndarray],
) -> np.ndarray | None:
    """Return the section state at the start of each walk, or a guess of it or of each gait.

    - `conditions`: known parameters of each row of gaits.
    """
    if start is not None and not isinstance(start, str):
        states = np.atleast_2d(check_numpy_reals("start", start))
        if states.shape[0] not in (1, n_walks):
            raise ValueError(
                f"start has shape {states.shape}, but there are {n_walks} walks: give one "
                "section state, or one for each walk."
            )
    elif finder.model.is_wheel:
        if kind == "gaits" and finder.supports_cold_start:
            return None
        cycle: Any = limit_cycle(params, model=finder.model, period_n=finder.leg_period)
        default_start = finder.model.compute_default_start(params)
        states = np.asarray(cycle.section_state if bool(cycle.found) else default_start)[None]
    else:
        walker, model = finder.model.walker, finder.model
        if kind == "gaits":
            get_value = lambda name: conditions.get(name, model.get_parameter(params, name))
            gaits = _find_row_gaits(finder, list(map(get_value, model.parameter_names)))
            missing = np.flatnonzero(~np.asarray(gaits.found))
            if len(missing):
                raise ValueError(
                    f"the search begins at the given parameters, but gait {missing[0]} of the data "
                    "was not found there: give parameters that have the gaits, or start=, section "
                    "coordinates near them."
                )
            return np.asarray(gaits.section_state)
        gait: Any = limit_cycle(params, model=walker, options=finder.step_options)
        states = np.asarray(gait.section_state)[None]
        if not bool(gait.found):
            states = np.asarray(propose_starts(walker, params))[:1]
    return np.broadcast_to(states, (n_walks, states.shape[1])).astype(float)


def _find_row_gaits(finder: Any, row_values: Sequence[Any]) -> Any:
    """Return the gait of a walker for each row of data, from the values of its parameters."""
    _, params = finder.model.from_parameter_values(
        np.broadcast_arrays(*map(np.atleast_1d, row_values)), 0
    )
    return limit_cycles(params, model=finder.model.walker, options=finder.step_options)


# Largest number of times that the guesses of gaits are replaced by the gaits of the last fit.
MAX_GUESS_UPDATES = 20
# Smallest relative decrease of chi2 after which the guesses are replaced again.
MIN_CHI2_DECREASE = 1e-6


def _improve_with_new_guesses(
    fit: FitResult, repeat: Callable[[FitProblem, Any], FitResult]
) -> FitResult:
    """Return a fit to gaits of a walker whose guesses are the gaits of the fit itself.

    A gait that is far from its guess may not be found, which would hold the search back.

    - `repeat`: function of a problem and starts that returns their fit.
    """
    for _ in range(MAX_GUESS_UPDATES):
        problem = fit.problem
        values, others = problem.place_unknowns(jnp.asarray(fit.values))
        gaits = _find_row_gaits(
            problem.finder, problem.set_conditions(values, problem.conditions, others)
        )
        if not np.all(gaits.found):
            break
        problem = eqx.tree_at(lambda p: p.starts, problem, jnp.asarray(gaits.section_state))
        previous, fit = fit, repeat(problem, fit.values[None])
        if not fit.chi2 < previous.chi2 * (1.0 - MIN_CHI2_DECREASE):
            break
    return fit


def _count_steps(
    finder: Any, params: Any, first_states: np.ndarray, last_time: float, options: StepOptions
) -> int:
    """Return a number of steps that takes longer than a series, also for slightly faster walks."""
    walker = finder.model if finder.model.is_wheel else finder.model.walker
    n_needed = 1
    for x in jnp.asarray(np.unique(first_states, axis=0)):
        x = walker.complete_section_state(params, x) if walker.is_wheel else x
        time, n_steps = 0.0, 0
        while time < DURATION_MARGIN * last_time and n_steps < MAX_STEPS:
            step = walker.advance(params, x, options)
            if int(step.outcome) != Outcome.STEPPED:
                break
            x, time, n_steps = step.section_state, time + float(step.duration), n_steps + 1
        n_needed = max(n_needed, n_steps)
    return n_needed


def _arrange_conditions(
    table: FitData,
    model: Any,
    walks: np.ndarray,
    row_walks: np.ndarray,
    row_steps: np.ndarray | None,
    n_steps: int,
) -> dict[str, Any]:
    """Return the conditions of each row of gaits, or of each walk and its steps.

    - `walks`: label of each walk.
    """
    if table.kind == "gaits":
        return dict(table.conditions)
    n_walks = len(walks)
    arranged = {}
    for name, column in table.conditions.items():
        by_walk = [column[row_walks == walk] for walk in range(n_walks)]
        if name != HEIGHT_COLUMN and all(np.ptp(x) == 0.0 for x in by_walk):
            arranged[name] = np.array([x[0] for x in by_walk])
            continue
        if row_steps is None or (model.is_wheel and name not in ("slope", HEIGHT_COLUMN)):
            raise ValueError(
                f"{name} varies within a walk, but only the ground may, from step to step: give "
                "one value for each walk, or number the steps in a column 'step'."
            )
        values = np.full((n_walks, n_steps), np.nan)
        values[row_walks, row_steps] = column
        if not (is_same := values[row_walks, row_steps] == column).all():
            row = is_same.argmin()
            raise ValueError(
                f"{name} differs between the rows of step {table.labels['step'][row]:g} of walk "
                f"{walks[row_walks[row]]:g}, but a step has one ground: give these rows one value."
            )
        last_steps = [row_steps[row_walks == walk].max() for walk in range(n_walks)]
        for walk, last_step in enumerate(last_steps):
            missing = np.flatnonzero(np.isnan(values[walk, :last_step]))
            if missing.size:
                raise ValueError(
                    f"{name} of step {missing[0] + table.labels['step'].min():g} of walk "
                    f"{walks[walk]:g} is missing, but later steps depend on this ground: give a "
                    "row for each step, with large errors where nothing was measured."
                )
            # The ground goes on with the last value where a walk has fewer steps.
            values[walk, last_step:] = values[walk, last_step]
        if name == HEIGHT_COLUMN:
            values = np.concatenate([np.zeros((n_walks, 1)), values], 1)
        arranged[name] = values
    return arranged


def _choose_starts(
    problem: FitProblem,
    targets: FitTarget,
    first: np.ndarray,
    bounded: Collection[str],
    free: Collection[str],
    n_starts: int,
) -> np.ndarray:
    """Return the starts of searches: the given walker, and the best of random ones around it."""
    n_candidates = 1 if n_starts == 1 else max(n_starts, N_CANDIDATES)
    shares = np.random.default_rng(0).random((n_candidates, len(first)))
    candidates = np.tile(first, (n_candidates, 1))
    for i, name in enumerate(problem.unknown_names):
        if name in bounded:
            width = problem.upper[i] - problem.lower[i]
            candidates[1:, i] = problem.lower[i] + shares[1:, i] * width
        elif name in free and first[i] != 0.0:
            candidates[1:, i] = first[i] * START_RANGE_FACTOR ** (2.0 * shares[1:, i] - 1.0)
    candidates = np.clip(candidates, problem.lower, problem.upper)
    if n_candidates == n_starts:
        return candidates
    chi2 = measure_candidates(problem, targets, candidates)
    best = 1 + np.argsort(np.asarray(chi2)[1:], kind="stable")[: n_starts - 1]
    return candidates[np.append(0, best)]


class QuadraticDamper(eqx.Module):
    """The paper's leg with a quadratic damper in addition."""

    c2: float = parameter(
        0.0, unit="N s^2/m^2", symbol="c_2", domain=(0.0, math.inf), meaning="quadratic damping"
    )

    def __call__(self, L: Any, dL: Any, params: Any) -> Any:
        spring = params.stiffness * (params.natural_length - L)
        return spring - params.damping * dL - self.c2 * jnp.abs(dL) * dL


class ProgressiveSpring(eqx.Module):
    """The paper's leg with a spring that becomes stiffer."""

    k3: float = parameter(
        0.0, unit="N/m^3", symbol="k_3", domain=(0.0, math.inf), meaning="cubic stiffness"
    )

    def __call__(self, L: Any, dL: Any, params: Any) -> Any:
        compression = params.natural_length - L
        return params.stiffness * compression + self.k3 * compression**3 - params.damping * dL


def make_leg_laws(params: Any) -> dict[str, Any]:
    """Return the laws that `compare_laws` always compares, by name. None is the paper's law.

    A search starts at their values, at which the forces change by some per cent. At zero, a bound,
    a search would not move.
    """
    length, speed = params.locked_length, jnp.sqrt(params.gravity * params.locked_length)
    return {
        "linear": None,
        "quadratic damper": QuadraticDamper(float(0.3 * params.damping / speed)),
        "progressive spring": ProgressiveSpring(float(4.0 * params.stiffness / length**2)),
    }


@announce_wait("predictions with derivatives, and their fit for each law", "60 s")
def compare_laws(
    data: Any,
    params: Any,
    free: Sequence[str] = ("damping", "stiffness"),
    *,
    laws: Mapping[str, Any] | None = None,
    model: Any = None,
    n_folds: int = N_FOLDS,
    **fit_options: Any,
) -> xr.Dataset:
    """Fit several laws of the legs to the same data, and compare them.

    Akaike's criterion is chi2 plus twice the number of unknowns; the law with the smallest value
    predicts new data best. A prediction error is that of rows that were left out of the fit, in
    standard errors; it is 1 for a perfect law.

    Args:
        data: as in `fit`.
        params: the wheel at which each search starts.
        free: names of the unknown parameters of all laws.
        laws: further laws by name, as for `ViscoelasticWheel(leg_force=...)`. All parameters of a
            law are unknown. Always compared are "linear", the paper's law, "quadratic damper" and
            "progressive spring", which add one parameter each.
        model: the model whose law is replaced; `ViscoelasticWheel()` by default.
        n_folds: number of parts into which the rows are divided for the prediction; 0 for none.
        fit_options: further arguments of `fit`.

    Returns:
        A dataset over `law` with `chi2`, `n_unknowns`, `aic`, `aic_difference`, `p_value`,
        `prediction_error` and `converged`. Its attribute `best` is the law with the smallest
        criterion, and `fits` contains each `FitResult` by name.

    Raises:
        TypeError, ValueError: as for `fit`.

    Examples:
        >>> slopes = np.linspace(0.28, 0.32, 5)
        >>> cycles = vrw.limit_cycles(vrw.WheelParams(damping=150.0, slope=slopes))
        >>> data = {"slope": slopes, "period": cycles.period, "period_error": [1e-3]}
        >>> data |= {"dls_fraction": cycles.dls_fraction, "dls_fraction_error": [1e-3]}
        >>> table = vrw.compare_laws(data, vrw.WheelParams(damping=160.0), n_folds=0)
        >>> table.attrs["best"]
        'linear'
    """
    free = check_names("free", free, '"damping", "stiffness"')
    n_folds = check_int("n_folds", n_folds, 0)
    base_model: Any = resolve_finder(params, model, None).model
    if not hasattr(base_model, "leg_force"):
        raise TypeError(
            f"model is a {type(base_model).__name__}, which has no law of its own for the legs: "
            "give vrw.ViscoelasticWheel()."
        )
    laws = make_leg_laws(params) | dict(laws or {})
    fits, prediction_errors = {}, []
    for name, law in laws.items():
        law_model = dataclasses.replace(base_model, leg_force=law)
        law_names = [x.name for x in list_parameters(law_model.leg_force, "leg")]
        fits[name] = fit(data, params, (*free, *law_names), model=law_model, **fit_options)
        prediction_errors.append(_predict_left_out(fits[name], n_folds))
    stack = lambda name: np.array([getattr(x, name) for x in fits.values()])
    chi2, n_unknowns = stack("chi2"), np.array([len(x.names) for x in fits.values()])
    dims = ("law", DATASET_DIMENSION)[: chi2.ndim]
    aic = (chi2.T + 2.0 * n_unknowns).T
    columns = {
        "chi2": chi2,
        "n_unknowns": n_unknowns,
        "p_value": stack("p_value"),
        "prediction_error": np.array(prediction_errors),
        "converged": stack("converged"),
        "aic": aic,
        "aic_difference": aic - aic.min(0),
    }
    names = np.array(list(laws))
    return xr.Dataset(
        {name: (dims[: x.ndim], x) for name, x in columns.items()},
        {"law": names},
        {"best": names[aic.argmin(0)] if chi2.ndim > 1 else str(names[aic.argmin()]), "fits": fits},
    )


def _predict_left_out(result: FitResult, n_folds: int) -> Any:
    """Return the root mean square of the residuals of rows that were left out of the fit.

    The rows are divided into parts, of which each is left out in turn. One part would leave out all
    rows, so that the result is NaN.
    """
    n_rows = result.data.values.shape[1]
    targets = result.target
    if result.values.ndim == 1:
        targets = FitTarget(*(x[None] for x in targets))
    squares = np.zeros(result.values.shape[:-1])
    if (n_folds := min(n_folds, n_rows)) < 2:
        return squares + np.nan
    for fold in range(n_folds):
        is_left_out = np.arange(n_rows)[None] % n_folds == fold
        kept = targets._replace(row_weights=1.0 - is_left_out)
        solution = solve_fits(result.problem, kept, np.atleast_2d(result.values))
        left_out = targets._replace(row_weights=1.0 * is_left_out)
        whitened = summarize(result.problem, left_out, solution).whitened
        squares = squares + (whitened**2).sum((-2, -1)).reshape(squares.shape)
    return np.sqrt(squares / result.data.values[0].size)[()]

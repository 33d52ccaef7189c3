"""Fit of a walker's parameters to measurements, and comparison of leg laws by their fits."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.checks import (
    check_callable,
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
from vrw_jax.studies.fit_data import (
    DATASET_DIMENSION,
    STEP_COLUMN,
    TIME_COLUMN,
    FitData,
    read_data,
)
from vrw_jax.studies.fit_problem import (
    HEIGHT_COLUMN,
    OFFSET_SUFFIX,
    START_NAMES,
    START_PREFIX,
    TIME_OFFSET,
    FitProblem,
    FitTarget,
    describe_unknowns,
    evaluate_fits,
    solve_fits,
    whiten,
)
from vrw_jax.studies.fit_result import FitResult, make_result

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


@announce_wait("predictions with derivatives, and their fit", "15 s")
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

    The method of Levenberg and Marquardt minimizes the sum of squared residuals within bounds, with
    exact derivatives of gaits, steps and events. Standard errors follow from the derivatives and
    from the errors of the data. Wheels without a gait are rejected during the search.

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
    bounds, priors = dict(bounds or {}), dict(priors or {})
    extra = {name: check_real(f"extra[{name!r}]", x) for name, x in (extra or {}).items()}
    if observe is not None:
        check_callable("observe", observe, "of the predicted columns and of extra")
    options = StepOptions() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    n_starts = check_int("n_starts", n_starts)
    finder, units, entries = _resolve_walker(params, model, start, options)
    units = {**units, HEIGHT_COLUMN: units.get(HEIGHT_COLUMN, "m"), TIME_COLUMN: "s"}
    table = _read_table(data, params, finder, covariance, units)
    walks, row_walks = np.unique(
        table.labels.get("walk", np.zeros(table.values.shape[1])), return_inverse=True
    )
    starts_from_gait = isinstance(start, str) and check_choice("start", start, ("gait",)) == "gait"
    states: Any = _find_first_states(table, params, finder, start, len(walks))
    start_names: list[str] = []
    if start is None and table.kind != "gaits":
        if finder.model.is_wheel and states.shape[1] > 3:
            # Of a full section state, Leg 1 stands on the ground, and the others on their stoppers.
            states = states[:, [0, 1, 4 + params.n_legs]]
        endings = [f"[{walk}]" for walk in range(len(walks))] if len(walks) > 1 else [""]
        start_names = [START_PREFIX + entry + end for end in endings for entry in entries]
    row_steps, n_steps, window = _arrange_steps(
        table, finder, params, None if starts_from_gait else states, window, options
    )
    base_values = np.asarray(finder.model.collect_parameter_values(params), float)
    known = dict(zip(finder.model.parameter_names, base_values, strict=True)) | extra
    first_starts = states[:, : len(entries)] if start_names else []
    first = np.append([known.get(name, 0.0) for name in (*free, *extra)], first_starts)
    _check_unknowns(table, finder, free, (*free, *extra, *start_names), bounds, priors, observe)
    unknowns, prior_means, prior_weights = describe_unknowns(
        (*free, *extra, *start_names), first, bounds, priors, finder.model.parameter_domains, units
    )
    arrays = {
        "base_values": tuple(base_values),
        "conditions": _arrange_conditions(table, finder, walks, row_walks, row_steps, n_steps),
        "row_walks": row_walks,
        "row_steps": row_steps,
        "times": table.labels.get("time"),
        "window": window,
        "starts": states,
    }
    problem = FitProblem(
        finder=finder,
        **jax.tree.map(jnp.asarray, arrays),
        unknowns=unknowns,
        options=options,
        names=table.names,
        extra_names=tuple(extra),
        kind=table.kind,
        n_steps=n_steps,
        n_start_entries=len(entries) if start_names else 0,
        starts_from_gait=starts_from_gait,
        observe=observe,
    )
    target = FitTarget(table.values, table.whitener[None], prior_means[None], prior_weights[None])
    mean = target._replace(values=target.values.mean(0, keepdims=True))
    starts = _choose_starts(problem, mean, first, [*bounds], free, n_starts)
    result = make_result(problem, mean, starts, table, is_batch=False)
    if is_own_walker(model) and table.kind == "gaits" and start is None:
        result = _improve_with_new_guesses(result)
    if table.is_batch:
        starts = np.tile(result.values, (len(table.values), 1))
        result = make_result(result.problem, target, starts, table, is_batch=True)
    return result


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
        units = {name: unit for name, unit in own_units if unit != "1"}
        return finder, units, finder.coordinates
    model = resolve_model(params, model)
    finder = resolve_finder(params, model, None, getattr(model, "leg_period", 1))
    # The landing on both feet of the paper's wheel leaves two of the three entries.
    return finder, finder.model.units, START_NAMES[:2]


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


def _find_first_states(
    table: FitData, params: Any, finder: Any, start: Any, n_walks: int
) -> np.ndarray | None:
    """Return the section state at the start of each walk, or a guess of it or of each gait."""
    model, is_of_gaits = finder.model, table.kind == "gaits"
    walker = model if model.is_wheel else model.walker
    if start is not None and not isinstance(start, str):
        states = np.atleast_2d(check_numpy_reals("start", start))
        if states.shape[0] not in (1, n_walks):
            raise ValueError(
                f"start has shape {states.shape}, but there are {n_walks} walks: give one "
                "section state, or one for each walk."
            )
        sizes = (
            (3, model.count_section_entries(params))
            if model.is_wheel
            else (len(finder.coordinates),)
        )
        if states.shape[1] not in sizes:
            raise ValueError(
                f"start has {states.shape[1]} entries, but a section state has {sizes[-1]}: give "
                "the section_state of a gait or of a step."
            )
    elif is_of_gaits and finder.supports_cold_start:
        return None
    elif is_of_gaits and not model.is_wheel:
        get_value = lambda name: table.conditions.get(name, model.get_parameter(params, name))
        gaits = _find_row_gaits(finder, list(map(get_value, model.parameter_names)))
        missing = np.flatnonzero(~np.asarray(gaits.found))
        if len(missing):
            raise ValueError(
                f"the search begins at the given parameters, but gait {missing[0]} of the data "
                "was not found there: give parameters that have the gaits, or start=, section "
                "coordinates near them."
            )
        return np.asarray(gaits.section_state)
    else:
        cycle_options = None if model.is_wheel else finder.step_options
        cycle: Any = limit_cycle(
            params, model=walker, period_n=finder.leg_period, options=cycle_options
        )
        state: Any = cycle.section_state
        if not bool(cycle.found) and model.is_wheel:
            state = model.compute_default_start(params)
        elif not bool(cycle.found):
            state = propose_starts(walker, params)[0]
        states = np.asarray(state)[None]
    return np.broadcast_to(states, (n_walks, states.shape[1])).astype(float)


def _find_row_gaits(finder: Any, row_values: Sequence[Any]) -> Any:
    """Return the gait of a walker for each row of data, from the values of its parameters."""
    _, params = finder.model.from_parameter_values(
        np.broadcast_arrays(*map(np.atleast_1d, row_values)), 0
    )
    return limit_cycles(params, model=finder.model.walker, options=finder.step_options)


def _arrange_steps(
    table: FitData,
    finder: Any,
    params: Any,
    first_states: np.ndarray | None,
    window: float | None,
    options: StepOptions,
) -> tuple[np.ndarray | None, int, float | None]:
    """Return the index of the step of each row, the number of steps, and the window of a series.

    - `first_states`: section states at which the walks begin, None for the steady gait.
    """
    row_steps, times = table.labels.get(STEP_COLUMN), table.labels.get(TIME_COLUMN)
    n_steps = 1
    if row_steps is not None:
        if (parts := row_steps[row_steps % 1.0 != 0.0]).size:
            raise ValueError(
                f"step is {parts[0]:g}, but the steps of a walk are numbered: give whole numbers."
            )
        row_steps = (row_steps - row_steps.min()).astype(int)
        n_steps = int(row_steps.max()) + 1
    if times is None:
        return row_steps, n_steps, None
    spacing = float(np.median(np.diff(np.unique(times)))) if len(times) > 1 else 0.0
    window = spacing if window is None else float(check_real("window", window))
    if window < 0.0:
        raise ValueError(
            f"window is {window:g} s, but it is a time before and after a sample: give 0 for "
            "instantaneous values, or more."
        )
    if first_states is None:
        return row_steps, finder.leg_period, window
    if times.min() < window:
        raise ValueError(
            f"the series begins {times.min():g} s after the first touchdown, but its samples are "
            f"means over {window:g} s before and after them: begin later, or give window=."
        )
    walker = finder.model if finder.model.is_wheel else finder.model.walker
    # Walks may become somewhat faster during the search.
    end_time = DURATION_MARGIN * (float(times.max()) + window)
    for x in jnp.asarray(np.unique(first_states, axis=0)):
        x = walker.complete_section_state(params, x) if walker.is_wheel else x
        time, n_taken = 0.0, 0
        while time < end_time and n_taken < MAX_STEPS:
            step = walker.advance(params, x, options)
            if int(step.outcome) != Outcome.STEPPED:
                break
            x, time, n_taken = step.section_state, time + float(step.duration), n_taken + 1
        n_steps = max(n_steps, n_taken)
    return row_steps, n_steps, window


def _arrange_conditions(
    table: FitData,
    finder: Any,
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
    first_rows, arranged = np.unique(row_walks, return_index=True)[1], {}
    for name, column in table.conditions.items():
        of_walks = column[first_rows]
        if name != HEIGHT_COLUMN and (column == of_walks[row_walks]).all():
            arranged[name] = of_walks
            continue
        if row_steps is None or (finder.model.is_wheel and name not in ("slope", HEIGHT_COLUMN)):
            raise ValueError(
                f"{name} varies within a walk, but only the ground may, from step to step: give "
                "one value for each walk, or number the steps in a column 'step'."
            )
        label_step = lambda step: f"step {step + table.labels[STEP_COLUMN].min():g}"
        values = np.full((len(walks), n_steps), np.nan)
        values[row_walks, row_steps] = column
        for row in np.flatnonzero(values[row_walks, row_steps] != column):
            raise ValueError(
                f"{name} differs between the rows of {label_step(row_steps[row])} of walk "
                f"{walks[row_walks[row]]:g}, but a step has one ground: give these rows one value."
            )
        last_steps = np.zeros(len(walks), int)
        np.maximum.at(last_steps, row_walks, row_steps)
        is_walked = np.arange(n_steps) <= last_steps[:, None]
        for walk, step in np.argwhere(is_walked & np.isnan(values)):
            raise ValueError(
                f"{name} of {label_step(step)} of walk {walks[walk]:g} is missing, but later steps "
                "depend on this ground: give a row for each step, with large errors where nothing "
                "was measured."
            )
        # The ground goes on with the last value where a walk has fewer steps.
        values = np.where(is_walked, values, np.take_along_axis(values, last_steps[:, None], 1))
        is_height = name == HEIGHT_COLUMN  # Heights begin with that of the first foothold.
        arranged[name] = np.pad(values, ((0, 0), (int(is_height), 0)))
    return arranged


def _check_unknowns(
    table: FitData,
    finder: Any,
    free: Sequence[str],
    unknown_names: tuple[str, ...],
    bounds: Mapping[str, Any],
    priors: Mapping[str, Any],
    observe: Any,
) -> None:
    """Raise an error unless names are known, and numbers as many as unknowns."""
    parameter_names = finder.model.parameter_names
    offset_names = [f"{name}{OFFSET_SUFFIX}" for name in parameter_names]
    offset_names += [TIME_OFFSET] * (table.kind == "series")
    for name in free:
        require_known_name(name, (*parameter_names, *offset_names), "parameter of the walker")
        if name in table.conditions:
            raise ValueError(
                f"{name} is free and a column of data, but a column describes what is known: free "
                f"{name}_offset, or remove one of them."
            )
    if not unknown_names or len(set(unknown_names)) < len(unknown_names):
        raise ValueError(f"the unknowns are {unknown_names}, but each is named once: change free.")
    for name in (*bounds, *priors):
        require_known_name(name, unknown_names, "unknown")
    if table.kind == "gaits" and observe is None:
        for name in table.names:
            require_known_name(name, finder.differentiable_measures, "measure of gaits")
    n_numbers = table.values[0].size + len(priors)
    if n_numbers < len(unknown_names):
        raise ValueError(
            f"data contain {n_numbers} numbers for {len(unknown_names)} unknowns ("
            f"{', '.join(unknown_names)}), which cannot be estimated from fewer: measure more, or "
            "give start= or fewer free parameters."
        )


def _choose_starts(
    problem: FitProblem,
    target: FitTarget,
    first: np.ndarray,
    bounded: Sequence[str],
    free: Sequence[str],
    n_starts: int,
) -> np.ndarray:
    """Return the starts of searches: the given walker, and the best of random ones around it."""
    unknowns = problem.unknowns
    n_candidates = 1 if n_starts == 1 else max(n_starts, N_CANDIDATES)
    shares = np.random.default_rng(0).random((n_candidates, len(first)))
    is_bounded = np.isin(unknowns.names, bounded)
    widths = np.where(is_bounded, unknowns.upper - unknowns.lower, 0.0)
    candidates = np.select(
        [is_bounded, np.isin(unknowns.names, free)],
        [unknowns.lower + shares * widths, first * START_RANGE_FACTOR ** (2.0 * shares - 1.0)],
        first,
    )
    candidates[0] = first
    candidates = np.clip(candidates, unknowns.lower, unknowns.upper)
    if n_candidates == n_starts:
        return candidates
    chi2 = evaluate_fits(problem, target, candidates).chi2
    chi2[0] = -np.inf
    return candidates[np.argsort(chi2, kind="stable")[:n_starts]]


# Largest number of times that the guesses of gaits are replaced by the gaits of the last fit.
MAX_GUESS_UPDATES = 20
# Smallest relative decrease of chi2 after which the guesses are replaced again.
MIN_CHI2_DECREASE = 1e-6


def _improve_with_new_guesses(result: FitResult) -> FitResult:
    """Return a fit to gaits of a walker whose guesses are the gaits of the fit itself.

    A gait that is far from its guess may not be found, which would hold the search back.
    """
    for _ in range(MAX_GUESS_UPDATES):
        problem = result.problem
        unknowns = problem.name_unknowns(jnp.asarray(result.values))
        gaits = _find_row_gaits(
            problem.finder, problem.collect_values(unknowns, problem.conditions)
        )
        if not np.all(gaits.found):
            break
        problem = eqx.tree_at(lambda p: p.starts, problem, jnp.asarray(gaits.section_state))
        previous = result
        result = make_result(problem, result.target, result.values[None], result.data, False)
        if not result.chi2 < previous.chi2 * (1.0 - MIN_CHI2_DECREASE):
            break
    return result


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


@announce_wait("predictions with derivatives, and their fit for each law", "35 s")
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
    is_batch = any(result.values.ndim > 1 for result in fits.values())
    dims = ("law", DATASET_DIMENSION) if is_batch else ("law",)
    collect = lambda name: [getattr(result, name) for result in fits.values()]
    table = xr.Dataset(
        {
            "chi2": (dims, collect("chi2")),
            "n_unknowns": ("law", [len(names) for names in collect("names")]),
            "p_value": (dims, collect("p_value")),
            "prediction_error": (dims, prediction_errors),
            "converged": (dims, collect("converged")),
        },
        {"law": list(laws)},
    )
    table["aic"] = table.chi2 + 2.0 * table.n_unknowns
    table["aic_difference"] = table.aic - table.aic.min("law")
    best = table.law.values[table.aic.argmin("law").values]
    return table.assign_attrs(best=best if is_batch else str(best), fits=fits)


def _predict_left_out(result: FitResult, n_folds: int) -> Any:
    """Return the root mean square of the residuals of rows that were left out of the fit.

    The rows are divided into parts, of which each is left out in turn. One part would leave out all
    rows, so that the result is NaN.
    """
    target, starts = result.target, np.atleast_2d(result.values)
    n_rows, n_columns = target.values.shape[1:]
    if (n_folds := min(n_folds, n_rows)) < 2:
        return np.full(result.values.shape[:-1], np.nan)[()]
    sum_of_squares: Any = 0.0
    for fold in range(n_folds):
        is_left_out = np.arange(n_rows) % n_folds == fold
        whitener = np.where(is_left_out[:, None, None], 0.0, target.whitener)
        fits = solve_fits(result.problem, target._replace(whitener=whitener), starts)
        residuals = whiten(target, fits.unknowns, fits.prediction[0])[0][:, is_left_out]
        sum_of_squares += np.sum(residuals**2, (-2, -1))
    errors = np.sqrt(sum_of_squares / (n_rows * n_columns))
    return errors if result.values.ndim > 1 else errors[0]

"""Predictions of measured numbers, with exact derivatives, and their least-squares fit in batches.

A vector x contains all unknowns in SI units. Data sets and starts are elements of one batch, so
that one compiled program predicts for thousands of fits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vrw_jax.base.checks import (
    check_range,
    check_real,
    check_type,
    format_value,
    require_known_name,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import compile_step
from vrw_jax.lanes.batching import map_in_numpy_batches, select_tree_rows
from vrw_jax.studies.least_squares import FitPoint, minimize_squares

FIT_BATCH_SIZES = (8, 256)
"""Numbers of fits that one call predicts."""
SAMPLES_PER_PHASE = 24
"""Number of samples of each phase, between which polynomials of degree 5 interpolate. The value is
chosen because errors of forces are then below 1e-5 of the weight."""
STENCIL_SIZE = 6
DIFFERENCE_STEP = 1e-4
"""Relative change of unknowns for derivatives of samples with unilateral contact, which machine
code computes without derivatives. The errors of the motion, 1e-9, are divided by it."""
HEIGHT_COLUMN = "height"
OFFSET_SUFFIX = "_offset"
TIME_OFFSET = "time_offset"
START_PREFIX = "start."
START_NAMES = ("theta_touchdown", "dtheta_touchdown", "dL1_touchdown")
"""Entries of a start of the wheel before its first touchdown, as in the table of measures."""
SERIES_NAMES = (
    "theta", "L1", "L2", "dtheta", "dL1", "dL2", "lambda_1", "lambda_2", "lambda_3", "lambda_4",
)  # fmt: skip
"""Columns of a time series of the wheel, as in `vrw.simulate`."""
PHASE_DURATION_NAMES = ("duration_dls", "duration_sls1", "duration_sls2")
CONTACT_DURATION_NAMES = ("duration_dls", "duration_single", "duration_flight")


ParameterValues = Sequence[Any]
"""Values of all parameters of the walker, each as one number, or as one for each step."""


class Prediction(NamedTuple):
    """Predicted numbers, and whether the walker has the gait or takes the steps."""

    values: Float[Array, "rows columns"]
    is_valid: Bool[Array, ""]


class FitTarget(NamedTuple):
    """What fits compare their predictions with, as arrays with the axis of a batch first.

    - `values`: measured numbers, shape (batch, rows, columns);
    - `whitener`: matrices that turn residuals into independent ones of variance 1, and are zero for
      a row that is left out, shape (batch, rows, columns, columns);
    - `prior_means`, `prior_weights`: means, and inverse widths, of priors, shape (batch, unknowns);
      the weight 0 is no prior.
    """

    values: Any
    whitener: Any
    prior_means: Any
    prior_weights: Any


class _GaitMeasures(dict):
    """Measures of one gait, computed when they are read."""

    def __init__(self, finder: Any, params: Any, guess: Any) -> None:
        super().__init__()
        self.finder, self.params = finder, params
        self.cycle = finder.find_cycle(params, guess)

    @functools.cached_property
    def step(self) -> Any:
        model, start = self.finder.model, self.cycle.section_state
        # Measures of other walkers are known to the gait.
        return (
            model.take_step_of_gait(self.params, start, self.finder.step_options)
            if model.is_wheel
            else None
        )

    def __missing__(self, name: str) -> Any:
        require_known_name(name, self.finder.differentiable_measures, "measure of gaits")
        if name in self.finder.cycle_measures:
            return self.cycle.measure(name)
        return self.finder.measure_reader(name, self.cycle, self.step)


class Unknowns(NamedTuple):
    """Names, units, bounds and typical sizes of all unknowns."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray


def describe_unknowns(
    names: Sequence[str],
    first: np.ndarray,
    bounds: Mapping[str, Any],
    priors: Mapping[str, Any],
    domains: Mapping[str, Any],
    units: Mapping[str, str],
) -> tuple[Unknowns, np.ndarray, np.ndarray]:
    """Return the unknowns, and means and inverse widths of their priors."""
    rows, unknown_units = [], []
    for name, start in zip(names, first, strict=True):
        quantity = name.removesuffix(OFFSET_SUFFIX).removeprefix(START_PREFIX).partition("[")[0]
        unknown_units.append(units.get(quantity, "1"))
        domain, mean, weight = domains.get(name), 0.0, 0.0
        low, high = (domain.lower_bound, domain.upper_bound) if domain else (-np.inf, np.inf)
        size = 10.0 if domain and domain.unit != "1" else 1.0
        if name.endswith(OFFSET_SUFFIX):
            size = 0.01  # s or rad
        if name in bounds:
            low, high = check_range(f"the range of {name}", bounds[name])
            if not low <= start <= high:
                raise ValueError(
                    f"the start has {name} {start:g}, outside its bounds ({low:g}, {high:g}): "
                    "widen the bounds, or start inside them."
                )
        if name in priors:
            if np.shape(priors[name]) != (2,):
                raise TypeError(
                    f"the prior of {name} is {format_value(priors[name])}, but it is a mean and a "
                    "standard deviation: give (mean, standard deviation)."
                )
            mean, size = (check_real(f"the prior of {name}", x) for x in priors[name])
            if size <= 0.0:
                raise ValueError(
                    f"the prior of {name} has the standard deviation {size:g}, but it is "
                    "positive: give (mean, standard deviation)."
                )
            weight = 1.0 / size
        rows.append((low, high, abs(start) or size, mean, weight))
    lower, upper, scale, means, weights = np.array(rows).T
    return Unknowns(tuple(names), tuple(unknown_units), lower, upper, scale), means, weights


class FitProblem(eqx.Module):
    """What is measured, what is unknown, and the walker that predicts it.

    - `finder`: finder of the gaits of the walker, with its model;
    - `base_values`: values of all parameters of the walker;
    - `conditions`: parameters of each row, or of each walk and its steps;
    - `row_walks`, `row_steps`: walk and step of each row, for sequences of steps;
    - `times`: time of each row, s, for time series, and `window`, over which a sample is a mean;
    - `starts`: section state at the start of each walk, or near the gait, shape (walks, n);
    - `n_start_entries`: number of their entries that are unknown.
    """

    finder: Any
    base_values: tuple[Array, ...]
    conditions: dict[str, Array]
    row_walks: Any
    row_steps: Any
    times: Any
    window: Any
    starts: Any
    unknowns: Unknowns
    options: StepOptions
    names: tuple[str, ...]
    extra_names: tuple[str, ...]
    kind: str
    n_steps: int
    n_start_entries: int
    starts_from_gait: bool
    observe: Callable | None

    def name_unknowns(self, x: Array) -> dict[str, Array]:
        return dict(zip(self.unknowns.names, x, strict=True))

    def collect_values(
        self, unknowns: Mapping[str, Array], conditions: Mapping[str, Array]
    ) -> ParameterValues:
        """Return the values of all parameters.

        The values are separate numbers, so that only those of unknowns have derivatives.
        """
        return [
            conditions.get(name, unknowns.get(name, value))
            + unknowns.get(name + OFFSET_SUFFIX, 0.0)
            for name, value in zip(self.finder.model.parameter_names, self.base_values, strict=True)
        ]

    def unpack(self, values: ParameterValues) -> tuple[Any, Any]:
        """Return the walker and its parameters with the given values."""
        model, params = self.finder.model.from_parameter_values(tuple(values), self.finder.n_legs)
        return (model if model.is_wheel else model.walker), params

    def predict(self, x: Float[Array, " unknowns"]) -> Prediction:
        """Return the prediction of all measured numbers for the unknowns `x`, in SI units."""
        model = self.finder.model
        if self.kind == "series" and model.is_wheel and model.reports_contacts:
            return _predict_with_differences(x, self)
        return self.predict_exactly(x)

    def predict_exactly(self, x: Float[Array, " unknowns"]) -> Prediction:
        """Return the prediction with the derivatives of steps, events and gaits."""
        unknowns = self.name_unknowns(x)
        rows = jnp.arange(len(self.row_walks))
        if self.kind == "gaits":

            def predict_row(conditions: dict[str, Array], row: Array) -> tuple[Array, Array]:
                gait = self._find_gait(self.collect_values(unknowns, conditions), row)
                return self._select_measured(gait, unknowns), gait.cycle.found

            numbers, is_found = jax.vmap(predict_row)(self.conditions, rows)
            return Prediction(numbers, jnp.all(is_found))
        starts, n_entries = self.starts, self.n_start_entries
        if n_entries:
            unknown_starts = x[-len(starts) * n_entries :].reshape(-1, n_entries)
            starts = starts.at[:, :n_entries].set(unknown_starts)
        columns, is_valid = jax.vmap(functools.partial(self._walk, unknowns))(
            starts, self.conditions, jnp.arange(len(starts))
        )
        rows = self.row_steps if self.kind == "steps" else rows
        columns = {name: column[self.row_walks, rows] for name, column in columns.items()}
        return Prediction(self._select_measured(columns, unknowns), jnp.all(is_valid))

    def _select_measured(
        self, columns: Mapping[str, Array], unknowns: Mapping[str, Array]
    ) -> Array:
        """Return what the sensors report, the measured columns last."""
        if self.observe is not None:
            columns = self.observe(columns, {name: unknowns[name] for name in self.extra_names})
            check_type("the result of observe", columns, Mapping, "return the columns by name")
        if not isinstance(columns, _GaitMeasures):
            for name in self.names:
                require_known_name(name, tuple(columns), f"measure of {self.kind}")
        return jnp.stack([columns[name] for name in self.names], -1)

    def _find_gait(self, values: ParameterValues, index: Any) -> _GaitMeasures:
        """Return the gait of a row, or that with which a walk begins."""
        model, params = self.finder.model.from_parameter_values(tuple(values), self.finder.n_legs)
        finder = eqx.tree_at(lambda finder: finder.model, self.finder, model)
        # There is one guess for all gaits, or one for each.
        guess = (
            None if self.starts is None else self.starts[jnp.minimum(index, len(self.starts) - 1)]
        )
        return _GaitMeasures(finder, params, guess)

    def _put_on_ground(
        self, values: ParameterValues, conditions: Mapping[str, Array]
    ) -> tuple[Any, Any, Any]:
        """Return the walker, its parameters and what differs from step to step."""
        heights = conditions.get(HEIGHT_COLUMN)
        walker, params = self.unpack(values)
        if walker.is_wheel:
            ground = walker.split_ground_by_step(params, self.n_steps, heights)
            slope = jnp.ravel(params.slope)[0]
            return walker, eqx.tree_at(lambda wheel: wheel.slope, params, slope), ground
        if heights is not None:
            params = walker.put_on_heights(params, heights, self.n_steps)
        ground, params = eqx.partition(params, lambda leaf: jnp.ndim(leaf) > 0)
        return walker, params, ground if jax.tree.leaves(ground) else None

    def _walk(
        self,
        unknowns: Mapping[str, Array],
        start: Array,
        conditions: dict[str, Array],
        walk: Array,
    ) -> tuple[dict[str, Array], Array]:
        """Return what is known of one walk at each step, or at the times of all rows."""
        values = self.collect_values(unknowns, conditions)
        walker, params, ground = self._put_on_ground(values, conditions)
        is_valid, is_series = jnp.array(True), self.kind == "series"
        if self.starts_from_gait:
            cycle = self._find_gait([jnp.ravel(value)[0] for value in values], walk).cycle
            start, is_valid = cycle.section_state, cycle.found
        if walker.is_wheel:
            start = walker.complete_section_state(params, start)
        observe_step = self._sample_step if is_series else self._measure_step

        def advance(walked: tuple, step_ground: Any) -> tuple:
            x, time, has_walked = walked
            step_walker, step_params = (
                walker.with_step_ground(params, step_ground)
                if step_ground is not None
                else (walker, params)
            )
            columns, durations, step = observe_step(step_walker, step_params, x)
            end_time = time + jnp.sum(durations)
            if not is_series:
                columns["touchdown_time"] = end_time
                if "duration_dls" in columns:
                    columns["takeoff_time"] = time + columns["duration_dls"]
            has_walked &= step.outcome == Outcome.STEPPED
            next_x = jnp.where(has_walked, step.section_state, start)
            return (next_x, end_time, has_walked), (columns, durations, end_time, has_walked)

        first = start, jnp.zeros(()), is_valid
        steps: Any = jax.lax.scan(advance, first, ground, length=self.n_steps)[1]
        columns, durations, end_times, has_walked = steps
        is_row = self.row_walks == walk
        if not is_series:
            last_step = jnp.max(jnp.where(is_row, self.row_steps, -1))
            return columns, jnp.all(has_walked | (jnp.arange(self.n_steps) > last_step))
        times = self.times - unknowns.get(TIME_OFFSET, 0.0)
        last_time = jnp.max(jnp.where(is_row, times, 0.0))
        is_used = jnp.append(True, end_times[:-1] < last_time + self.window)
        is_valid = jnp.all(has_walked | ~is_used)
        if not self.starts_from_gait:
            is_valid &= last_time + self.window <= end_times[-1]
        samples = jnp.stack([x.reshape(-1, SAMPLES_PER_PHASE) for x in columns.values()], -1)
        means = _sample_piecewise(
            samples, jnp.ravel(durations), times, self.window, self.starts_from_gait
        )
        return dict(zip(columns, means.T, strict=True)), is_valid

    def _sample_step(
        self, walker: Any, params: Any, x: Array
    ) -> tuple[dict[str, Array], Array, Any]:
        """Return samples of the phases of a step, the durations of the phases, and the step."""
        sampling = params, x, self.options, SAMPLES_PER_PHASE
        if not walker.is_wheel:
            columns, durations = walker.sample_motion(*sampling)
            step = walker.advance(params, x, self.options)
        else:
            step = walker.sample_step(*sampling)
            if walker.reports_contacts:
                n, durations = params.n_legs, step.duration
                state = step.state[..., np.array([2, 6, 7, 5, 6 + n, 7 + n])]
                forces = jnp.stack([step.tangential, step.normal], -1)[..., :2, :]
                forces = forces.reshape(*forces.shape[:-2], 4)
            else:
                state, forces, durations = step.state, step.forces, step.durations
            variables = jnp.moveaxis(jnp.concatenate([state, forces], -1), -1, 0)
            columns = dict(zip(SERIES_NAMES, variables, strict=True))
        # An unknown name is reported later.
        if self.observe is None and columns.keys() >= {*self.names}:
            columns = {name: columns[name] for name in self.names}
        return columns, durations, step

    def _measure_step(
        self, walker: Any, params: Any, x: Array
    ) -> tuple[dict[str, Array], Array, Any]:
        """Return measures of a step, the durations of its phases, and the step."""
        if not walker.is_wheel:
            step = compile_step(walker)(params, x, self.options)
            mode_names = getattr(walker, "modes", range(len(step.durations)))
            columns = {f"duration_{m}": d for m, d in zip(mode_names, step.durations, strict=True)}
            columns |= dict(zip(self.finder.coordinates, step.section_state, strict=True))
            columns |= walker.measure_step(params, x, step, self.options)
            return columns | {"period": step.duration}, step.durations, step
        step = walker.advance(params, x, self.options)
        has_contacts = walker.reports_contacts
        duration_names = CONTACT_DURATION_NAMES if has_contacts else PHASE_DURATION_NAMES
        columns = dict(zip(duration_names, step.durations, strict=True))
        # A full section state begins with the same two entries as that of the paper.
        columns |= dict(zip(START_NAMES[: 3 - has_contacts], step.section_state, strict=False))
        period = columns["period"] = jnp.sum(step.durations)
        columns["dls_fraction"] = step.durations[0] / jnp.where(period > 0.0, period, 1.0)
        columns["step_length"] = walker.compute_foot_distance(params, x)
        return columns, step.durations, step


@functools.cache
def _make_integration_matrix() -> np.ndarray:
    """Return the matrix from samples to their integrals from the first sample to each of them.

    It integrates the interpolants of `_interpolate`, in units of the distance of two samples.
    """
    n, half = SAMPLES_PER_PHASE, STENCIL_SIZE // 2
    matrix = np.zeros((n, n))
    powers = np.arange(STENCIL_SIZE)
    for interval in range(n - 1):
        first = min(max(interval - half + 1, 0), n - STENCIL_SIZE)
        nodes = np.arange(first, first + STENCIL_SIZE) - interval
        moments = 1.0 / (powers + 1)
        weights = np.linalg.solve(np.vander(nodes, increasing=True).T.astype(float), moments)
        matrix[interval + 1] = matrix[interval]
        matrix[interval + 1, first : first + STENCIL_SIZE] += weights
    return matrix


def _interpolate(samples: Array, phase: Array, fraction: Array) -> Array:
    """Return samples of phases, shape (phases, samples, ...), at a fraction of one phase."""
    position = jnp.clip(fraction, 0.0, 1.0) * (SAMPLES_PER_PHASE - 1)
    first = jnp.clip(
        jnp.floor(jax.lax.stop_gradient(position)).astype(int) - STENCIL_SIZE // 2 + 1,
        0,
        SAMPLES_PER_PHASE - STENCIL_SIZE,
    )
    offset = position - first
    total: Any = 0.0
    for i in range(STENCIL_SIZE):
        others = [j for j in range(STENCIL_SIZE) if j != i]
        weight: Any = 1.0
        for j in others:
            weight = weight * (offset - j) / (i - j)
        total = total + weight * samples[phase, first + i]
    return total


def _sample_piecewise(
    samples: Array, durations: Array, times: Array, window: Array, is_periodic: bool
) -> Array:
    """Return variables at times of a walk, each as the mean over times nearer than a window.

    The weights of the mean fall linearly to zero, as those of a filter that removes what is faster
    than the sampling rate. The means have continuous derivatives by the parameters, also where a
    variable jumps at a landing. They are second differences of the second integral.

    - `samples`: equidistant samples of each phase, shape (phases, samples, variables);
    - `is_periodic`: whether the phases repeat.
    """
    phase_ends = jnp.cumsum(durations)
    phase_starts = phase_ends - durations
    total = phase_ends[-1]
    safe_durations = jnp.where(durations > 0.0, durations, 1.0)
    spacing = durations / (SAMPLES_PER_PHASE - 1)

    def integrate(samples: Array) -> Array:
        inside = jnp.einsum("p,ij,pjv->piv", spacing, _make_integration_matrix(), samples)
        return inside + (jnp.cumsum(inside[:, -1], axis=0) - inside[:, -1])[:, None]

    integrals = integrate(samples)
    second_integrals = integrate(integrals)
    first_total, second_total = integrals[-1, -1], second_integrals[-1, -1]

    def read(values: Array, time: Array) -> tuple[Array, Any, Array]:
        n_periods = jnp.floor(jax.lax.stop_gradient(time / total)) if is_periodic else 0.0
        local = time - n_periods * total
        phase = jnp.clip(jnp.sum(local > phase_ends), 0, len(durations) - 1)
        fraction = (local - phase_starts[phase]) / safe_durations[phase]
        return _interpolate(values, phase, fraction), n_periods, local

    def read_second_integral(time: Array) -> Array:
        inside, n, local = read(second_integrals, time)
        earlier_periods = second_total + first_total * (local + 0.5 * (n - 1.0) * total)
        return inside + n * earlier_periods

    compute_mean = lambda time: (
        (
            read_second_integral(time - window)
            - 2.0 * read_second_integral(time)
            + read_second_integral(time + window)
        )
        / (window * window)
    )
    read_value = lambda time: read(samples, time)[0]
    return jax.lax.cond(window > 0.0, jax.vmap(compute_mean), jax.vmap(read_value), times)


@eqx.filter_custom_jvp
def _predict_with_differences(x: Array, problem: FitProblem) -> Prediction:
    """Return a prediction whose derivatives are central differences of fourth order."""
    return problem.predict_exactly(x)


@_predict_with_differences.def_jvp
def _differentiate_by_differences(primals: tuple, tangents: tuple) -> tuple:
    x, problem = primals
    changes = DIFFERENCE_STEP * problem.unknowns.scale
    # The differences stay within the bounds.
    limits = problem.unknowns.lower + 2.0 * changes, problem.unknowns.upper - 2.0 * changes
    points = jnp.clip(x, *limits) + jnp.array([1.0, -1.0, 2.0, -2.0])[:, None, None] * jnp.diag(
        changes
    )
    values = jax.vmap(jax.vmap(lambda x: problem.predict_exactly(x).values))(points)
    weights = jnp.array([8.0, -8.0, -1.0, 1.0]) / 12.0
    jacobian = jnp.einsum("k,kurc,u->rcu", weights, values, 1.0 / changes)
    prediction: Any = problem.predict_exactly(x)
    return prediction, prediction._replace(values=jacobian @ tangents[0], is_valid=None)


def whiten(target: FitTarget, x: Any, predicted: Any) -> tuple[Any, Any]:
    """Return the residuals of numbers and of priors in standard errors, also of a batch of fits."""
    whitened = (target.whitener @ (target.values - predicted)[..., None])[..., 0]
    return whitened, target.prior_weights * (x - target.prior_means)


@eqx.filter_jit
def _predict_with_jacobian(problem: FitProblem, x: Array) -> tuple[Prediction, Array]:
    """Return a batch of predictions, and their derivatives by the unknowns on the last axis."""

    def predict(x: Array) -> tuple[Array, Prediction]:
        prediction = problem.predict(x)
        return prediction.values, prediction

    jacobian, prediction = jax.vmap(jax.jacfwd(predict, has_aux=True))(x)
    return prediction, jacobian


def evaluate_fits(problem: FitProblem, targets: FitTarget, x: np.ndarray) -> FitPoint:
    """Return the residuals of a batch of fits at unknowns `x`, with their derivatives."""
    predict = functools.partial(_predict_with_jacobian, problem)
    prediction, jacobian = map_in_numpy_batches(predict, FIT_BATCH_SIZES, x)
    n, n_unknowns = x.shape
    is_finite = np.isfinite(jacobian).reshape(n, -1).all(-1)
    is_valid = (prediction.is_valid & is_finite)[:, None]
    whitened, of_priors = whiten(targets, x, prediction.values)
    residuals = np.concatenate([whitened.reshape(n, -1), of_priors], -1)
    columns = -(targets.whitener @ jacobian).reshape(n, -1, n_unknowns)
    prior_columns = targets.prior_weights[..., None] * np.eye(n_unknowns)
    prior_columns = np.broadcast_to(prior_columns, (n, n_unknowns, n_unknowns))
    return FitPoint(
        x,
        np.where(is_valid, residuals, np.inf),
        np.where(is_valid[..., None], np.concatenate([columns, prior_columns], 1), 0.0),
        (prediction.values, jacobian),
    )


def solve_fits(
    problem: FitProblem, targets: FitTarget, starts: np.ndarray, is_fixed: Any = False
) -> FitPoint:
    """Return the fits of a batch of targets, each from its start x, as NumPy arrays."""
    n = len(starts)
    targets = FitTarget(*(np.broadcast_to(x, (n, *np.shape(x)[1:])) for x in targets))
    evaluate = lambda rows, x: evaluate_fits(problem, select_tree_rows(targets, rows), x)
    return minimize_squares(
        evaluate, starts, problem.unknowns.lower, problem.unknowns.upper, is_fixed
    )

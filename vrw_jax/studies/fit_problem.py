"""Predictions of measured numbers, with exact derivatives, and their least-squares fit in batches.

A vector x contains all unknowns in SI units. optimistix varies u(x), which has no bounds. Data sets
and starts are elements of one batch, so that thousands of fits run in one compiled program.
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

from vrw_jax.base.checks import check_range, check_real, require_known_name
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import compile_step
from vrw_jax.lanes.batching import map_in_batches, replace_rows, select_tree_rows

FIT_BATCH_SIZES = (8, 256)
"""Numbers of fits that one call computes."""
ITERATIONS_PER_CALL = 8
"""Iterations of a batch, which runs until its slowest fit ends. Most fits need fewer. The others
continue in a smaller batch."""
MAX_CALLS = 8
MISSING_GAIT_RESIDUAL = 1e6
"""Residual of each number if the walker has no gait, or falls. It is larger than that of any useful
wheel, so that the fit rejects this trial and shortens its next change."""
FIT_TOLERANCE = 1e-7
"""Relative and absolute tolerance of the scaled unknowns and residuals: a thousandth of a standard
error for data of 0.01 %, and above the errors of gaits, which are 1e-9."""
NEGLIGIBLE_REDUCTION = 1e-6
"""Predicted decrease of chi2 at which a fit ends: a distance of 1e-3 standard errors."""
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


class FitSolution(NamedTuple):
    """Result of the least-squares method, as arrays with the axis of a batch first.

    - `unknowns`: estimates, shape (batch, unknowns);
    - `predicted`: predicted numbers, shape (batch, rows, columns);
    - `jacobian`: their derivatives, shape (batch, rows, columns, unknowns);
    - `is_valid`: whether the walker has the gait or takes the steps;
    - `has_ended`: whether the method ended before the largest number of iterations.
    """

    unknowns: Any
    predicted: Any
    jacobian: Any
    is_valid: Any
    has_ended: Any


class FitTarget(NamedTuple):
    """What fits compare their predictions with, as arrays with the axis of a batch first.

    - `values`: measured numbers, shape (batch, rows, columns);
    - `row_weights`: 1, or 0 for a row that is left out, shape (batch, rows);
    - `prior_means`, `prior_weights`: means, and inverse widths, of priors, shape (batch, unknowns);
      the weight 0 is no prior.
    """

    values: Any
    row_weights: Any
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
        model = self.finder.model
        start = self.cycle.section_state
        return (
            model.take_step_of_gait(self.params, start, self.finder.step_options)
            if model.is_wheel
            else None  # Measures of other walkers are known to the gait.
        )

    def __missing__(self, name: str) -> Any:
        require_known_name(name, self.finder.differentiable_measures, "measure of gaits")
        if name in self.finder.cycle_measures:
            return self.cycle.measure(name)
        return self.finder.measure_reader(name, self.cycle, self.step)


def describe_unknowns(
    names: Sequence[str],
    first: np.ndarray,
    bounds: Mapping[str, Any],
    priors: Mapping[str, Any],
    domains: Mapping[str, Any],
) -> tuple[np.ndarray, ...]:
    """Return bounds, typical sizes, and means and inverse widths of the priors of unknowns."""
    rows = []
    for name, start in zip(names, first, strict=True):
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
            mean, size = (check_real(f"the prior of {name}", x) for x in priors[name])
            if size <= 0.0:
                raise ValueError(
                    f"the prior of {name} has the standard deviation {size:g}, but it is "
                    "positive: give (mean, standard deviation)."
                )
            weight = 1.0 / size
        rows.append((low, high, abs(start) or size, mean, weight))
    lower, upper, *others = np.array(rows).T
    large = 1e30  # beyond it, a bound is that of floating-point numbers
    lower, upper = np.where(lower < -large, -np.inf, lower), np.where(upper > large, np.inf, upper)
    return lower, upper, *others


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
    whitener: Float[Array, "rows columns columns"]
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
    options: StepOptions
    names: tuple[str, ...] = eqx.field(static=True)
    unknown_names: tuple[str, ...] = eqx.field(static=True)
    extra_names: tuple[str, ...] = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    n_steps: int = eqx.field(static=True)
    n_start_entries: int = eqx.field(static=True)
    starts_from_gait: bool = eqx.field(static=True)
    observe: Callable | None = eqx.field(static=True)

    def place_unknowns(self, x: Array) -> tuple[ParameterValues, dict[str, Array]]:
        """Return the values of all parameters, and the other unknowns by name.

        The values are separate numbers, so that only those of unknowns have derivatives.
        """
        unknowns = dict(zip(self.unknown_names, x, strict=True))
        values = [
            unknowns.pop(name, value)
            for name, value in zip(self.finder.model.parameter_names, self.base_values, strict=True)
        ]
        return values, unknowns

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
        values, others = self.place_unknowns(x)
        extra = {name: others[name] for name in self.extra_names}

        def select(columns: Mapping[str, Array]) -> Array:
            """Return what the sensors report, the measured columns last."""
            if self.observe is not None:
                columns = self.observe(columns, extra)
            if not isinstance(columns, _GaitMeasures):
                for name in self.names:
                    require_known_name(name, tuple(columns), f"measure of {self.kind}")
            return jnp.stack([columns[name] for name in self.names], -1)

        if self.kind == "gaits":

            def predict_row(conditions: dict[str, Array], row: Array) -> tuple[Array, Array]:
                gait = self._find_gait(self.set_conditions(values, conditions, others), row)
                return select(gait), gait.cycle.found

            rows = jnp.arange(len(self.whitener))
            if self.starts is not None:
                rows = jnp.minimum(rows, len(self.starts) - 1)  # one guess for all, or one for each
            numbers, is_found = jax.vmap(predict_row)(self.conditions, rows)
            return Prediction(numbers, jnp.all(is_found))
        starts, n_entries = self.starts, self.n_start_entries
        if n_entries:
            unknown_starts = x[-len(starts) * n_entries :].reshape(-1, n_entries)
            starts = starts.at[:, :n_entries].set(unknown_starts)
        columns, is_valid = jax.vmap(functools.partial(self._walk, values, others))(
            starts, self.conditions, jnp.arange(len(starts))
        )
        rows = self.row_steps if self.kind == "steps" else jnp.arange(len(self.row_walks))
        columns = {name: column[self.row_walks, rows] for name, column in columns.items()}
        return Prediction(select(columns), jnp.all(is_valid))

    def set_conditions(
        self, values: ParameterValues, conditions: Mapping[str, Array], others: Mapping[str, Array]
    ) -> ParameterValues:
        return [
            conditions.get(name, value) + others.get(name + OFFSET_SUFFIX, 0.0)
            for name, value in zip(self.finder.model.parameter_names, values, strict=True)
        ]

    def _find_gait(self, values: ParameterValues, walk: Any) -> _GaitMeasures:
        model, params = self.finder.model.from_parameter_values(tuple(values), self.finder.n_legs)
        finder = eqx.tree_at(lambda finder: finder.model, self.finder, model)
        return _GaitMeasures(finder, params, None if self.starts is None else self.starts[walk])

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
        values: ParameterValues,
        others: dict,
        start: Array,
        conditions: dict[str, Array],
        walk: Array,
    ) -> tuple[dict[str, Array], Array]:
        """Return what is known of one walk at each step, or at the times of all rows."""
        values = self.set_conditions(values, conditions, others)
        walker, params, ground = self._put_on_ground(values, conditions)
        is_valid, is_series = jnp.array(True), self.kind == "series"
        if self.starts_from_gait:
            cycle = self._find_gait([jnp.ravel(value)[0] for value in values], walk).cycle
            start, is_valid = cycle.section_state, cycle.found
        if walker.is_wheel:
            start = walker.complete_section_state(params, start)

        def advance(walked: tuple, step_ground: Any) -> tuple:
            x, time, has_walked = walked
            step_walker, step_params = (
                walker.with_step_ground(params, step_ground)
                if step_ground is not None
                else (walker, params)
            )
            columns, durations, step = self._take_step(step_walker, step_params, x, is_series)
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
        times = self.times - others.get(TIME_OFFSET, 0.0)
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

    def _take_step(
        self, walker: Any, params: Any, x: Array, is_series: bool
    ) -> tuple[dict[str, Array], Array, Any]:
        """Return measures of a step, or samples of its phases, and the durations of the phases."""
        if is_series:
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
        if not walker.is_wheel:
            step = compile_step(walker)(params, x, self.options)
            mode_names = getattr(walker, "modes", range(len(step.durations)))
            columns = {f"duration_{m}": d for m, d in zip(mode_names, step.durations, strict=True)}
            columns |= dict(zip(self.finder.coordinates, step.section_state, strict=True))
            columns |= walker.measure_step(params, x, step, self.options)
            return columns | {"period": step.duration}, step.duration, step
        step = walker.advance(params, x, self.options)
        has_contacts = walker.reports_contacts
        duration_names = CONTACT_DURATION_NAMES if has_contacts else PHASE_DURATION_NAMES
        columns = dict(zip(duration_names, step.durations, strict=True))
        # A full section state begins with the same two entries as that of the paper.
        columns |= dict(zip(START_NAMES[: 3 - has_contacts], step.section_state, strict=False))
        columns["period"] = jnp.sum(step.durations)
        columns["dls_fraction"] = step.durations[0] / jnp.where(
            columns["period"] > 0.0, columns["period"], 1.0
        )
        columns["step_length"] = walker.compute_foot_distance(params, x)
        return columns, step.durations, step

    def transform(self, u: Array) -> Array:
        """Return the unknowns x for the variables u, which have no bounds."""
        lower, upper, scale = self.lower, self.upper, self.scale
        has_lower, has_upper = jnp.isfinite(lower), jnp.isfinite(upper)
        low, high = jnp.where(has_lower, lower, 0.0), jnp.where(has_upper, upper, 0.0)
        half_bounded = jnp.sqrt(1.0 + u * u) - 1.0
        return jnp.select(
            [has_lower & has_upper, has_lower, has_upper],
            [
                low + 0.5 * (high - low) * (1.0 + jnp.sin(u)),
                low + scale * half_bounded,
                high - scale * half_bounded,
            ],
            scale * u,
        )

    def invert(self, x: np.ndarray) -> np.ndarray:
        """Return the variables u of the unknowns x; those on a bound move a little inside."""
        lower, upper, scale = self.lower, self.upper, self.scale
        has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
        low, high = np.where(has_lower, lower, 0.0), np.where(has_upper, upper, 1.0)
        share = np.clip((x - low) / (high - low), 1e-3, 1.0 - 1e-3)
        distance = np.maximum(np.where(has_lower, x - low, high - x) / scale, 1e-3)
        return np.select(
            [has_lower & has_upper, has_lower | has_upper],
            [np.arcsin(2.0 * share - 1.0), np.sqrt((1.0 + distance) ** 2 - 1.0)],
            x / scale,
        )


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

    width = jnp.where(window > 0.0, window, 1.0)
    compute_mean = lambda time: (
        (
            read_second_integral(time - width)
            - 2.0 * read_second_integral(time)
            + read_second_integral(time + width)
        )
        / (width * width)
    )
    read_value = lambda time: read(samples, time)[0]
    return jnp.where(window > 0.0, jax.vmap(compute_mean)(times), jax.vmap(read_value)(times))


@eqx.filter_custom_jvp
def _predict_with_differences(x: Array, problem: FitProblem) -> Prediction:
    """Return a prediction whose derivatives are central differences of fourth order."""
    return problem.predict_exactly(x)


@_predict_with_differences.def_jvp
def _differentiate_by_differences(primals: tuple, tangents: tuple) -> tuple:
    x, problem = primals
    changes = DIFFERENCE_STEP * problem.scale
    factors = jnp.array([1.0, -1.0, 2.0, -2.0])
    points = x + factors[:, None, None] * jnp.diag(changes)
    values = jax.vmap(jax.vmap(lambda x: problem.predict_exactly(x).values))(points)
    weights = jnp.array([8.0, -8.0, -1.0, 1.0]) / 12.0
    jacobian = jnp.einsum("k,kurc,u->rcu", weights, values, 1.0 / changes)
    prediction: Any = problem.predict_exactly(x)
    return prediction, prediction._replace(values=jacobian @ tangents[0], is_valid=None)


def compute_residuals(
    problem: FitProblem, target: FitTarget, x: Array, prediction: Prediction
) -> Float[Array, " residuals"]:
    """Return the residuals of one fit in standard errors, those of the priors last."""
    whitened = jnp.einsum("rij,rj->ri", problem.whitener, target.values - prediction.values)
    whitened = target.row_weights[:, None] * whitened
    whitened = jnp.where(prediction.is_valid, whitened, MISSING_GAIT_RESIDUAL)
    return jnp.append(jnp.ravel(whitened), target.prior_weights * (x - target.prior_means))


def _linearize_residuals(
    u: Array, problem_and_target: tuple[FitProblem, FitTarget]
) -> tuple[Array, tuple[Array, Prediction, Array]]:
    """Return residuals whose derivatives are those of one Jacobian, with that Jacobian."""
    problem, target = problem_and_target
    x = problem.transform(u)
    fixed_x = jax.lax.stop_gradient(x)

    def predict(x: Array) -> tuple[Array, Prediction]:
        prediction = problem.predict(x)
        return prediction.values, prediction

    jacobian, prediction = jax.jacfwd(predict, has_aux=True)(fixed_x)
    linear = prediction._replace(values=prediction.values + jacobian @ (x - fixed_x))
    return compute_residuals(problem, target, x, linear), (fixed_x, prediction, jacobian)


@functools.cache
def _make_solver() -> Any:
    """Return the method of Levenberg and Marquardt, which also ends where round-off hides a
    further decrease.
    """
    import optimistix  # imported here, because its import takes long

    class LevenbergMarquardt(optimistix.AbstractGaussNewton):
        """Optimistix's method with the first step size and the end that fits need."""

        rtol: float = FIT_TOLERANCE
        atol: float = FIT_TOLERANCE
        norm: Callable = optimistix.max_norm
        descent: Any = optimistix.DampedNewtonDescent()
        search: Any = optimistix.ClassicalTrustRegion()
        verbose: Callable = lambda **_: None

        def init(self, fn: Any, y: Any, args: Any, options: Any, *arguments: Any) -> Any:
            state = super().init(fn, y, args, options, *arguments)
            read_size = lambda state: state.search_state.step_size
            return eqx.tree_at(read_size, state, options["step_size"])

        def step(self, fn: Any, y: Any, *arguments: Any) -> tuple[Any, Any, Any]:
            y, state, aux = super().step(fn, y, *arguments)
            reduction = self.search.predict_reduction(state.y_eval - y, state.f_info)
            is_done = state.terminate | (reduction > -NEGLIGIBLE_REDUCTION)
            return y, eqx.tree_at(lambda state: state.terminate, state, is_done), aux

    return LevenbergMarquardt()


@eqx.filter_jit
def _measure_variables(problem: FitProblem, target: FitTarget, variables: Array) -> Array:
    """Return chi2 at each row of variables u. The programs are those of the search."""
    evaluate = lambda u: jnp.sum(_linearize_residuals(u, (problem, target))[0] ** 2)
    return jax.vmap(evaluate)(variables)


def measure_candidates(problem: FitProblem, targets: FitTarget, candidates: np.ndarray) -> Array:
    """Return chi2 of the mean of all data sets at each row of unknowns."""
    target = FitTarget(*(jnp.asarray(np.mean(x, 0)) for x in targets))
    measure = functools.partial(_measure_variables, problem, target)
    return map_in_batches(measure, FIT_BATCH_SIZES[:1], problem.invert(candidates))


@eqx.filter_jit
def _improve_fits(
    problem: FitProblem, targets: FitTarget, searches: tuple[Any, Any]
) -> tuple[tuple[Any, Any], FitSolution]:
    """Return a batch of searches and their solutions after some iterations.

    - `searches`: variables u of each fit, and the step size of its trust region.
    """
    import optimistix

    evaluate: Any = _linearize_residuals

    def improve(target: FitTarget, search: tuple) -> tuple[tuple, FitSolution]:
        variables, step_size = search
        solution: Any = optimistix.least_squares(
            evaluate,
            _make_solver(),
            variables,
            (problem, target),
            {"step_size": step_size},
            has_aux=True,
            max_steps=ITERATIONS_PER_CALL,
            throw=False,
        )
        state = solution.state
        x, prediction, jacobian = state.aux  # of the last accepted iteration
        has_ended = state.terminate | (solution.stats["num_steps"] < ITERATIONS_PER_CALL)
        return (
            (solution.value, state.search_state.step_size),
            FitSolution(x, prediction.values, jacobian, prediction.is_valid, has_ended),
        )

    return jax.vmap(improve)(targets, searches)


def solve_fits(problem: FitProblem, targets: FitTarget, starts: np.ndarray) -> FitSolution:
    """Return the fits of a batch of targets, each from its start x, as NumPy arrays."""
    n = len(starts)
    targets = FitTarget(*(np.broadcast_to(x, (n, *np.shape(x)[1:])) for x in targets))
    running, results = np.arange(n), None
    searches = problem.invert(starts), np.ones(n)
    for _ in range(MAX_CALLS):
        arguments = select_tree_rows((targets, searches), running)
        improve = functools.partial(_improve_fits, problem)
        improved = jax.tree.map(np.array, map_in_batches(improve, FIT_BATCH_SIZES, *arguments))
        results = improved if results is None else replace_rows(results, running, improved)
        searches, solution = results
        running = running[~solution.has_ended[running]]
        if not running.size:
            break
    return solution

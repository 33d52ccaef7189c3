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

from vrw_jax.base.options import StepOptions
from vrw_jax.base.parameters import list_tree_parameters
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.lanes.batching import map_in_batches

FIT_BATCH_SIZES = (8, 64, 512)
"""Numbers of fits that one call computes. A batch runs until its slowest fit ends."""
MISSING_GAIT_RESIDUAL = 1e6
"""Residual of each number if the walker has no gait, or falls. It is larger than that of any useful
wheel, so that the fit rejects this trial and shortens its next change."""
TOLERANCE = 1e-7
"""Relative and absolute tolerance of the scaled unknowns and residuals: a thousandth of a standard
error for data of 0.01 %, and above the errors of gaits, which are 1e-9."""
NEGLIGIBLE_REDUCTION = 1e-6
"""Predicted decrease of chi2 at which a fit ends: a distance of 1e-3 standard errors. Predictions
of time series have kinks, where the method makes smaller and smaller changes."""
MAX_ITERATIONS = 60
SAMPLES_PER_PHASE = 24
"""Number of samples of each phase, between which polynomials of degree 5 interpolate. The value is
chosen because errors of forces are then below 1e-5 of the weight."""
STENCIL_SIZE = 6
SLOPE_NAME, HEIGHT_NAME = "slope", "height"
OFFSET_SUFFIX = "_offset"
TIME_OFFSET = "time_offset"
START_PREFIX = "start."
START_NAMES = ("theta_touchdown", "dtheta_touchdown", "dL1_touchdown")
"""Entries of a start before its first touchdown, as in the table of measures."""
SERIES_NAMES = (
    "theta", "L1", "L2", "dtheta", "dL1", "dL2", "lambda_1", "lambda_2", "lambda_3", "lambda_4",
)  # fmt: skip
"""Columns of a time series, as in `vrw.simulate`."""
PHASE_DURATION_NAMES = ("duration_dls", "duration_sls1", "duration_sls2")
CONTACT_DURATION_NAMES = ("duration_dls", "duration_single", "duration_flight")


ParameterValues = Sequence[Array]
"""Values of all parameters of the walker, each as one number."""


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

    def __init__(self, cycle: Any) -> None:
        super().__init__()
        self.cycle = cycle

    def __missing__(self, name: str) -> Any:
        return self.cycle.measure(name)


class FitProblem(eqx.Module):
    """What is measured, what is unknown, and the walker that predicts it.

    - `walker`: model of the wheel, or a `HybridSystem`;
    - `finder`: finder of gaits, or None if no gait is measured;
    - `base_values`: values of all parameters of the walker;
    - `conditions`: parameters of each row, or of each walk, shape (rows,) or (walks, ...);
    - `row_walks`, `row_steps`: walk and step of each row, for sequences of steps;
    - `times`: time of each row, s, for time series, and `window`, over which a sample is a mean;
    - `starts`: section state at the start of each walk, shape (walks, n).
    """

    walker: Any
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
    system: HybridSystem | None = eqx.field(static=True)
    params_structure: Any = eqx.field(static=True)
    n_steps: int = eqx.field(static=True)
    starts_from_gait: bool = eqx.field(static=True)
    observe: Callable | None = eqx.field(static=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Return the names of all parameters of the walker."""
        return list_parameter_names(self.system or self.walker, self.params_structure)

    def unpack(self, values: ParameterValues) -> tuple[Any, Any]:
        """Return the walker and its parameters with the given values."""
        if self.system is not None:
            return self.system, jax.tree.unflatten(self.params_structure, list(values))
        return self.walker.from_parameter_values(tuple(values), self.params_structure)

    def place_unknowns(self, x: Array) -> tuple[ParameterValues, dict[str, Array]]:
        """Return the values of all parameters, and the other unknowns by name.

        The values are separate numbers, so that only those of unknowns have derivatives.
        """
        unknowns = dict(zip(self.unknown_names, x, strict=True))
        values = [
            unknowns.pop(name, value)
            for name, value in zip(self.parameter_names, self.base_values, strict=True)
        ]
        return values, unknowns

    def predict(self, x: Float[Array, " unknowns"]) -> Prediction:
        """Return the prediction of all measured numbers for the unknowns `x`, in SI units."""
        values, others = self.place_unknowns(x)
        extra = {name: others[name] for name in self.extra_names}
        if self.kind == "gaits":
            predict_row = lambda conditions: self._predict_gait(
                self._set_conditions(values, conditions, others), extra
            )
            numbers, is_found = jax.vmap(predict_row, axis_size=len(self.whitener))(self.conditions)
            return Prediction(numbers, jnp.all(is_found))
        starts = self.starts
        for name, value in others.items():
            if name.startswith(START_PREFIX):
                walk, entry = parse_start_name(name, starts.shape[0], self._start_names)
                starts = starts.at[walk, entry].set(value)
        predict_walk = self._walk_steps if self.kind == "steps" else self._sample_walk
        columns, is_valid = jax.vmap(functools.partial(predict_walk, values, others))(
            starts, self.conditions, jnp.arange(len(starts))
        )
        rows = jnp.arange(len(self.row_walks)) if self.row_steps is None else self.row_steps
        columns = {name: column[self.row_walks, rows] for name, column in columns.items()}
        if self.observe is not None:
            columns = self.observe(columns, extra)
        return Prediction(jnp.stack([columns[name] for name in self.names], -1), jnp.all(is_valid))

    @property
    def _start_names(self) -> tuple[str, ...]:
        return list_start_names(self.system, self.starts.shape[1])

    def _set_conditions(
        self, values: ParameterValues, conditions: Mapping[str, Array], others: Mapping[str, Array]
    ) -> ParameterValues:
        values = list(values)
        for i, name in enumerate(self.parameter_names):
            if name in conditions and jnp.ndim(conditions[name]) == 0:
                values[i] = conditions[name]
            if name + OFFSET_SUFFIX in others:
                values[i] = values[i] + others[name + OFFSET_SUFFIX]
        return values

    def _predict_gait(
        self, values: ParameterValues, extra: dict[str, Array]
    ) -> tuple[Array, Array]:
        guess = None if self.starts is None else self.starts[0]
        cycle = self.finder.find_cycle_from_values(jnp.stack(values), guess)
        measures: Any = _GaitMeasures(cycle)
        if self.observe is not None:
            measures = self.observe(measures, extra)
        return jnp.stack([measures[name] for name in self.names]), cycle.found

    def _walk_steps(
        self,
        values: ParameterValues,
        others: dict,
        start: Array,
        conditions: dict[str, Array],
        walk: Array,
    ) -> tuple[dict[str, Array], Array]:
        """Return the measures of each step of one walk."""
        is_used = jnp.arange(self.n_steps) <= jnp.max(
            jnp.where(self.row_walks == walk, self.row_steps, -1)
        )
        values = self._set_conditions(values, conditions, others)
        walker, params = self.unpack(values)
        ground, heights = None, conditions.get(HEIGHT_NAME)
        if jnp.ndim(conditions.get(SLOPE_NAME, 0.0)) or heights is not None:
            if heights is None:
                slopes = conditions[SLOPE_NAME] + others.get(SLOPE_NAME + OFFSET_SUFFIX, 0.0)
                params = eqx.tree_at(lambda wheel: wheel.slope, params, slopes)
            ground = walker.split_ground_by_step(params, self.n_steps, heights)
            params = eqx.tree_at(lambda wheel: wheel.slope, params, jnp.ravel(params.slope)[0])

        def advance(x_and_time: tuple, step_ground: Any) -> tuple:
            x, time, has_walked = x_and_time
            step_walker, step_params = (
                (walker, params)
                if step_ground is None
                else walker.with_step_ground(params, step_ground)
            )
            columns, x_next, is_complete = self._take_step(step_walker, step_params, x)
            columns["touchdown_time"] = time + columns["period"]
            if "duration_dls" in columns:
                columns["takeoff_time"] = time + columns["duration_dls"]
            has_walked &= is_complete
            next_x = jnp.where(has_walked, x_next, start)
            return (next_x, columns["touchdown_time"], has_walked), (columns, has_walked)

        if self.starts_from_gait:
            cycle = self.finder.find_cycle_from_values(jnp.stack(values), None)
            start = walker.complete_section_state(params, cycle.section_state)
        first = start, jnp.zeros(()), jnp.array(True)
        steps: Any = jax.lax.scan(advance, first, ground, length=self.n_steps)[1]
        columns, has_walked = steps
        return columns, jnp.all(has_walked | ~is_used)

    def _take_step(self, walker: Any, params: Any, x: Array) -> tuple[dict, Array, Array]:
        if self.system is not None:
            step = self.system.step(params, x, self.options)
            columns = {"period": step.duration}
            columns |= {
                f"duration_{mode}": step.mode_durations[i]
                for i, mode in enumerate(self.system.modes)
            }
            return (
                columns | dict(zip(self._start_names, step.section_state, strict=True)),
                step.section_state,
                step.is_complete,
            )
        step = walker.advance(params, x, self.options)
        duration_names = CONTACT_DURATION_NAMES if walker.reports_contacts else PHASE_DURATION_NAMES
        columns = dict(zip(duration_names, step.durations, strict=True))
        columns |= dict(zip(START_NAMES, step.section_state[:3], strict=True))
        columns["period"] = jnp.sum(step.durations)
        columns["dls_fraction"] = step.durations[0] / jnp.where(
            columns["period"] > 0.0, columns["period"], 1.0
        )
        columns["step_length"] = walker.compute_foot_distance(params, x)
        return columns, step.section_state, step.is_complete

    def _sample_walk(
        self,
        values: ParameterValues,
        others: dict,
        start: Array,
        conditions: dict[str, Array],
        walk: Array,
    ) -> tuple[dict[str, Array], Array]:
        """Return each variable of one walk at the times of all rows."""
        values = self._set_conditions(values, conditions, others)
        walker, params = self.unpack(values)
        is_valid = jnp.array(True)
        if self.starts_from_gait:
            cycle = self.finder.find_cycle_from_values(jnp.stack(values), None)
            start, is_valid = cycle.section_state, cycle.found

        read_names = SERIES_NAMES if self.observe is not None else self.names
        variables = np.array([SERIES_NAMES.index(name) for name in read_names])

        def advance(x_and_flag: tuple, _: None) -> tuple:
            x, has_walked = x_and_flag
            step = walker.sample_step(params, x, self.options, SAMPLES_PER_PHASE)
            samples = jnp.concatenate([step.state, step.forces], -1)[..., variables]
            has_walked &= step.is_complete
            next_x = jnp.where(has_walked, step.section_state, start)
            return (next_x, has_walked), (samples, step.durations, has_walked)

        steps: Any = jax.lax.scan(advance, (start, is_valid), length=self.n_steps)[1]
        samples, durations, has_walked = steps
        samples = samples.reshape(-1, *samples.shape[2:])
        durations = jnp.ravel(durations)
        phase_ends = jnp.cumsum(durations)
        times = self.times - others.get(TIME_OFFSET, 0.0)
        is_used = self.row_walks == walk
        is_started = phase_ends.reshape(-1, 3)[:-1, -1] < jnp.max(jnp.where(is_used, times, 0.0))
        is_valid = is_valid & jnp.all(has_walked | ~jnp.append(True, is_started))
        if not self.starts_from_gait:
            is_valid &= jnp.all(~is_used | (times <= phase_ends[-1]))
        read = functools.partial(
            _sample_piecewise, samples, durations, phase_ends, self.starts_from_gait
        )
        columns = read(times, self.window)
        return dict(zip(read_names, columns.T, strict=True)), is_valid

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


def list_parameter_names(walker: Any, params_structure: Any) -> tuple[str, ...]:
    """Return the names of the parameters of a model, or of the tree of a system's parameters."""
    if not isinstance(walker, HybridSystem):
        return walker.parameter_names
    tree = jax.tree.unflatten(params_structure, [0.0] * params_structure.num_leaves)
    return tuple(parameter.name for parameter in list_tree_parameters(tree))


def list_start_names(system: HybridSystem | None, size: int) -> tuple[str, ...]:
    """Return the names of the entries of a section state that may be measured or unknown."""
    return START_NAMES if system is None else tuple(f"section_{i}" for i in range(size))


def parse_start_name(name: str, n_walks: int, entries: tuple[str, ...]) -> tuple[int, int]:
    """Return the walk and the entry of a name such as `start.theta_touchdown[1]`."""
    entry, _, walk = name.removeprefix(START_PREFIX).partition("[")
    return int(walk[:-1]) if walk else 0, entries.index(entry)


def make_start_names(n_walks: int, entries: tuple[str, ...]) -> list[str]:
    """Return the names of all unknown entries of the starts, one walk after the other."""
    return [
        f"{START_PREFIX}{entry}{f'[{walk}]' if n_walks > 1 else ''}"
        for walk in range(n_walks)
        for entry in entries
    ]


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
    samples: Array,
    durations: Array,
    phase_ends: Array,
    is_periodic: bool,
    times: Array,
    window: Array,
) -> Array:
    """Return variables at times of a walk, each as the mean over a window of time around it.

    A sensor whose filter removes what is faster than its sampling rate reports such means. They are
    continuous functions of the parameters, also where a variable jumps at a landing.

    - `samples`: equidistant samples of each phase, shape (phases, samples, variables);
    - `is_periodic`: whether the phases repeat.
    """
    phase_starts = phase_ends - durations
    total = phase_ends[-1]
    has_occurred = durations > 0.0
    safe_durations = jnp.where(has_occurred, durations, 1.0)
    spacing = durations / (SAMPLES_PER_PHASE - 1)
    integrals = spacing[:, None, None] * jnp.einsum(
        "ij,pjv->piv", _make_integration_matrix(), samples
    )
    integral_ends = jnp.cumsum(integrals[:, -1], axis=0)
    integral_starts = integral_ends - integrals[:, -1]

    def locate(time: Array) -> tuple[Array, Array, Any]:
        n_periods = jnp.floor(jax.lax.stop_gradient(time / total)) if is_periodic else 0.0
        local = time - n_periods * total
        phase = jnp.clip(jnp.sum(local > phase_ends), 0, len(durations) - 1)
        return phase, (local - phase_starts[phase]) / safe_durations[phase], n_periods

    def read_value(time: Array) -> Array:
        phase, fraction, _ = locate(time)
        return _interpolate(samples, phase, fraction)

    def read_integral(time: Array) -> Array:
        phase, fraction, n_periods = locate(time)
        inside = integral_starts[phase] + _interpolate(integrals, phase, fraction)
        return inside + n_periods * integral_ends[-1]

    safe_window = jnp.where(window > 0.0, window, 1.0)
    mean_over = lambda time: (
        (read_integral(time + 0.5 * safe_window) - read_integral(time - 0.5 * safe_window))
        / safe_window
    )
    return jnp.where(window > 0.0, jax.vmap(mean_over)(times), jax.vmap(read_value)(times))


def compute_residuals(
    problem: FitProblem, target: FitTarget, x: Array
) -> tuple[Float[Array, " residuals"], Prediction]:
    """Return the residuals of one fit in standard errors, and the prediction."""
    prediction = problem.predict(x)
    whitened = jnp.einsum("rij,rj->ri", problem.whitener, target.values - prediction.values)
    whitened = target.row_weights[:, None] * whitened
    whitened = jnp.where(prediction.is_valid, whitened, MISSING_GAIT_RESIDUAL)
    prior = target.prior_weights * (x - target.prior_means)
    return jnp.append(jnp.ravel(whitened), prior), prediction


@eqx.filter_custom_jvp
def _evaluate_residuals(u: Array, problem: FitProblem, target: FitTarget) -> Array:
    return compute_residuals(problem, target, problem.transform(u))[0]


@_evaluate_residuals.def_jvp
def _differentiate_residuals(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """Return residuals and their JVP, from one Jacobian that all uses of the derivative share."""
    u, problem, target = primals

    def evaluate(u: Array) -> tuple[Array, Array]:
        residuals, _ = compute_residuals(problem, target, problem.transform(u))
        return residuals, residuals

    jacobian, residuals = jax.jacfwd(evaluate, has_aux=True)(u)
    return residuals, jacobian @ tangents[0]


@functools.cache
def _make_solver() -> Any:
    """Return the method of Levenberg and Marquardt, which also ends where round-off hides a
    further decrease.
    """
    import optimistix  # imported here, because its import takes long

    class LevenbergMarquardt(optimistix.AbstractGaussNewton):
        rtol: float = TOLERANCE
        atol: float = TOLERANCE
        norm: Callable = optimistix.max_norm
        descent: Any = optimistix.DampedNewtonDescent()
        search: Any = optimistix.ClassicalTrustRegion()
        verbose: Callable = lambda **_: None

        def step(self, fn: Any, y: Any, *arguments: Any) -> tuple[Any, Any, Any]:
            y, state, aux = super().step(fn, y, *arguments)
            reduction = self.search.predict_reduction(state.y_eval - y, state.f_info)
            is_done = state.terminate | (reduction > -NEGLIGIBLE_REDUCTION)
            return y, eqx.tree_at(lambda state: state.terminate, state, is_done), aux

    return LevenbergMarquardt()


@eqx.filter_jit
def _fit_batch(problem: FitProblem, targets: FitTarget, starts: Array) -> FitSolution:
    import optimistix

    solver = _make_solver()

    def fit_element(target: FitTarget, start: Array) -> FitSolution:
        solution: Any = optimistix.least_squares(
            lambda u, arguments: _evaluate_residuals(u, *arguments),
            solver,
            start,
            (problem, target),
            max_steps=MAX_ITERATIONS,
            throw=False,
        )
        x = problem.transform(solution.value)

        def predict(x: Array) -> tuple[Array, Prediction]:
            prediction = problem.predict(x)
            return prediction.values, prediction

        jacobian, prediction = jax.jacfwd(predict, has_aux=True)(x)
        has_ended = solution.stats["num_steps"] < MAX_ITERATIONS
        return FitSolution(x, prediction.values, jacobian, prediction.is_valid, has_ended)

    return jax.vmap(fit_element)(targets, starts)


def solve_fits(problem: FitProblem, targets: FitTarget, starts: np.ndarray) -> FitSolution:
    """Return the fits of a batch of targets, each from its start x, as NumPy arrays."""
    n = len(starts)
    targets = FitTarget(*(np.broadcast_to(x, (n, *np.shape(x)[1:])) for x in targets))
    solution = map_in_batches(
        functools.partial(_fit_batch, problem), FIT_BATCH_SIZES, targets, problem.invert(starts)
    )
    return jax.tree.map(np.asarray, solution)

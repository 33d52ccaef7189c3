"""Locate peaks of the ground's normal force in a gait of the paper's model, on its collocation.

A peak is a smooth maximum inside a phase. Impacts and changes of phase are no peaks. The largest
force may also occur there.

Let F be a quantity that depends on the state. Let R and S be its first and second time derivatives.
The extrema of R are roots of S. Between two neighboring extrema R is monotone, so that each sign
change of R is one extremum of F.

The roots are first located on a polynomial approximation of F in each mesh interval. The state at a
root is then computed by one explicit solver step of order 8 from the nearest boundary of a mesh
interval. F, R and S are evaluated at that state, and the time of the root is corrected. The extrema
are therefore as accurate as the cycle. Times are in s since the start of the phase.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export, lax
from jaxtyping import Array, Bool, Float

from vrw_jax.base.elementwise import Scalar, select_entry_by_mask
from vrw_jax.base.results import Measure
from vrw_jax.flow.extrema import StepForceExtrema, summarize_forces
from vrw_jax.flow.solver_steps import load_explicit_tableau
from vrw_jax.gaits.derivatives import attach_derivatives, make_tangent_function
from vrw_jax.gaits.gauss import (
    DOUBLE_END_WEIGHTS,
    END_WEIGHTS,
    CollocationSolution,
    PhaseMesh,
    PhasePoint,
    compute_integration_weights,
)
from vrw_jax.gaits.phase_sequence import CollocationState, CollocationSystem
from vrw_jax.lanes.autodiff import make_implicit_jacobian
from vrw_jax.lanes.batching import BatchFunction, unbatch
from vrw_jax.lanes.lane_function import compile_batch_function, with_lane_axis
from vrw_jax.wheel import transitions
from vrw_jax.wheel.phases import PAPER_PHASES, AbstractPhase, PhaseInstant, make_paper_phases

N_SAMPLES_PER_INTERVAL = 8
"""Number of samples of a quantity F per mesh interval. The value is chosen because the polynomial
through the samples is then more accurate than the motion between two nodes.
"""
MAX_RATE_EXTREMA_PER_PHASE = 6
"""Largest number of extrema of the rate of F per phase. The value is chosen because the rate has at
most five extrema if the legs are stiff and lightly damped.
"""
N_BISECTIONS = 24
"""Number of bisections on the polynomials. The value is chosen because the error of a root in a
phase of 20 mesh intervals is then 1e-6 mesh intervals, less than that of the polynomials.
"""
N_TIME_CORRECTIONS = 2
"""Number of corrections of the time of an extremum. The value is chosen because each correction
reduces the initial error, 1e-4 mesh intervals, at least a hundredfold.
"""
SOLVER_NAME = "Dopri8"
"""Solver of the state at an extremum. Its order is that of the collocation, and its steps are at
most half as long.
"""


class LocatedExtrema(NamedTuple):
    """Extrema of quantities F in one phase, and of their rates R, each in the order of time.

    An element that is no extremum has false flags, and its time and value are meaningless.
    """

    times: Float[Array, "quantities extrema"]
    is_maximum: Bool[Array, "quantities extrema"]
    is_minimum: Bool[Array, "quantities extrema"]
    rate_times: Float[Array, "quantities rate_extrema"]
    is_rate_maximum: Bool[Array, "quantities rate_extrema"]


class ExtremumValues(NamedTuple):
    """Values of quantities at their extrema, of their rates R at its extrema, and at both ends."""

    values: Float[Array, "quantities extrema"]
    rates: Float[Array, "quantities rate_extrema"]
    ends: Float[Array, "quantities 2"]  # F at the start and at the end of the phase


# Saved traces contain this named tuple.
export.register_namedtuple_serialization(LocatedExtrema, serialized_name="vrw_jax.LocatedExtrema")

FunctionOfCoordinatesAndRates = Callable[[Array, Array], Array]
"""Function that maps coordinates and rates, each of shape (coordinates,), to an array."""


class PhaseMotion(NamedTuple):
    """States at the boundaries of the mesh intervals of a phase, and the functions of the phase."""

    times: Float[Array, " boundaries"]
    q: Float[Array, "boundaries coordinates"]
    v: Float[Array, "boundaries coordinates"]
    coefficients: Float[Array, "intervals powers quantities"]
    """Coefficients of quantities in powers of the location in an interval, which is in [0, 1]."""
    compute_acceleration: FunctionOfCoordinatesAndRates
    compute_quantities: FunctionOfCoordinatesAndRates

    def find_state(self, time: Scalar) -> tuple[Array, Array]:
        """Return the coordinates and rates at a time.

        Their derivatives are those at a fixed distance from the nearest boundary.
        """
        tableau: Any = load_explicit_tableau(SOLVER_NAME)
        dtype = self.q.dtype
        index = jnp.sum(time >= 0.5 * (self.times[1:] + self.times[:-1]))
        boundary_time, q, v = (select_entry_by_mask(index, x) for x in (self.times, self.q, self.v))
        h = lax.stop_gradient(time - boundary_time)
        rows = [
            jnp.asarray(x, dtype)
            for x in (tableau.stage_nodes, tableau.squared_stage_matrix, tableau.stage_matrix)
        ]

        def find_stage(accelerations: Array, row: Any) -> tuple[Array, Array]:
            node, position_weights, rate_weights = row
            weigh = lambda weights: jnp.sum(weights[:, None] * accelerations, 0)
            return q + h * (node * v + h * weigh(position_weights)), v + h * weigh(rate_weights)

        def add_stage(accelerations: Array, row: Any) -> tuple[Array, None]:
            index, *row = row
            acceleration = self.compute_acceleration(*find_stage(accelerations, row))
            return lax.dynamic_update_index_in_dim(accelerations, acceleration, index, 0), None

        n_stages = len(tableau.stage_nodes) - 1
        accelerations, _ = lax.scan(
            add_stage,
            jnp.zeros((n_stages + 1, *q.shape), dtype),
            (np.arange(n_stages, dtype=np.int32), *(x[:-1] for x in rows)),
        )
        return find_stage(accelerations, [x[-1] for x in rows])

    def evaluate(self, state: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return all quantities F and their rates R in a state (q, v)."""
        rates = state[1], self.compute_acceleration(*state)
        return jax.jvp(self.compute_quantities, state, rates)

    @property
    def end_states(self) -> tuple[Array, Array]:
        """Return the states at the start and at the end of the phase."""
        return jnp.stack([self.q[0], self.q[-1]]), jnp.stack([self.v[0], self.v[-1]])

    def evaluate_polynomial(self, time: Scalar, quantity: Array, order: int) -> Scalar:
        """Return the first or second time derivative of the polynomial of one quantity.

        `quantity` is 1 for this quantity, and 0 for the others.
        """
        index = jnp.sum(time >= self.times[1:-1])
        start, end = (select_entry_by_mask(index, x) for x in (self.times[:-1], self.times[1:]))
        length = jnp.where(end > start, end - start, 1.0)
        coefficients = jnp.sum(select_entry_by_mask(index, self.coefficients) * quantity, 1)
        location, derivative = (time - start) / length, jnp.zeros_like(time)
        for power in range(N_SAMPLES_PER_INTERVAL - 1, order - 1, -1):
            factor = power if order == 1 else power * (power - 1)
            derivative = derivative * location + factor * coefficients[power]
        return derivative / length**order


def reconstruct_motion(
    mesh: PhaseMesh,
    start: tuple[Array, Array],
    duration: Scalar,
    node_accelerations: Float[Array, "intervals nodes coordinates"],
    compute_acceleration: FunctionOfCoordinatesAndRates,
    compute_quantities: FunctionOfCoordinatesAndRates,
    has_polynomials: bool,
) -> PhaseMotion:
    """Return the motion of a phase from its start (q, v), s and SI units.

    - `has_polynomials`: whether quantities are sampled for polynomials, else these are zero.
    """
    angles = np.pi * (np.arange(N_SAMPLES_PER_INTERVAL) + 0.5) / N_SAMPLES_PER_INTERVAL
    locations, dtype = 0.5 - 0.5 * np.cos(angles), duration.dtype
    powers = np.arange(N_SAMPLES_PER_INTERVAL)
    interpolation = np.linalg.inv(locations[:, None] ** powers).astype(dtype)
    rate_weights, position_weights = np.moveaxis(
        np.array([compute_integration_weights(x) for x in locations]), 1, 0
    ).astype(dtype)
    weigh = lambda weights, accelerations: jnp.sum(weights[:, None] * accelerations, 0)

    def advance(state: Any, interval: Any) -> tuple[Any, tuple[Any, Any]]:
        time, q, v = state
        h, accelerations = interval

        def sample(row: tuple) -> Array:
            location, rate_row, position_row = row
            return compute_quantities(
                q + h * (location * v + h * weigh(position_row, accelerations)),
                v + h * weigh(rate_row, accelerations),
            )

        rows = locations.astype(dtype), rate_weights, position_weights
        coefficients = interpolation @ lax.map(sample, rows) if has_polynomials else 0.0
        end_v = v + h * weigh(END_WEIGHTS.astype(dtype), accelerations)
        end_q = q + h * (v + h * weigh(DOUBLE_END_WEIGHTS.astype(dtype), accelerations))
        return (time + h, end_q, end_v), (state, coefficients)

    lengths = jnp.asarray(mesh.interval_length_fractions, dtype) * duration
    end: Any
    end, (states, coefficients) = lax.scan(
        advance, (jnp.zeros_like(duration), *start), (lengths, node_accelerations)
    )
    times, q, v = (jnp.concatenate([x, y[None]]) for x, y in zip(states, end, strict=True))
    return PhaseMotion(times, q, v, coefficients, compute_acceleration, compute_quantities)


def locate_extrema(motion: PhaseMotion) -> tuple[LocatedExtrema, ExtremumValues]:
    """Locate the extrema of the quantities inside a phase."""
    duration = motion.times[-1]

    def evaluate(time: Array, quantity: Array) -> Array:
        """Return F, R and S of one quantity at a time."""
        q, v = motion.find_state(time)
        differentiate = lambda f: (
            lambda q, v: jax.jvp(f, (q, v), (v, motion.compute_acceleration(q, v)))
        )
        (values, rates), (_, second_rates) = differentiate(
            differentiate(motion.compute_quantities)
        )(q, v)
        return jnp.sum(jnp.stack([values, rates, second_rates]) * quantity, 1)

    def locate(quantity: Array) -> tuple[LocatedExtrema, Array, Array]:
        rate_times, slopes = _locate_rate_extrema(motion, quantity)
        is_rate_extremum = slopes != 0.0
        # The start and the end of the phase bound the extrema of R.
        starts = jnp.concatenate([jnp.zeros_like(duration)[None], rate_times, duration[None]])
        inverse_slopes = jnp.where(is_rate_extremum, 1.0 / slopes, 0.0)
        unbounded = jnp.zeros_like(starts[:1])
        inverse_slopes = jnp.concatenate([unbounded, inverse_slopes, unbounded])

        def locate_next(carry: Any, seeks_extrema: Any) -> tuple[Any, tuple]:
            """Locate the extrema of R, or of F between those of R in `carry`."""
            times, rates, _ = carry
            next_rates = jnp.concatenate([rates[1:], unbounded])
            has_extremum = (rates * next_rates < 0.0) & (duration > 0.0)

            def locate_one(candidate: tuple) -> tuple[Array, Array, Array]:
                start, end, start_rate, inverse_slope, has_extremum = candidate
                root = _bisect(
                    lambda t: motion.evaluate_polynomial(t, quantity, 1), start, end, start_rate
                )

                def correct(state: tuple, _: None) -> tuple[tuple, None]:
                    time, (_, rate, second_rate) = state
                    newton_correction = jnp.where(
                        has_extremum, rate / jnp.where(second_rate == 0.0, 1.0, second_rate), 0.0
                    )
                    correction = jnp.where(
                        seeks_extrema, newton_correction, second_rate * inverse_slope
                    )
                    time = jnp.clip(time - correction, 0.0, duration)
                    return (time, evaluate(time, quantity)), None

                state = jnp.where(seeks_extrema, root, start), jnp.zeros(3, start.dtype)
                (time, (value, rate, _)), _ = lax.scan(
                    correct, state, length=1 + N_TIME_CORRECTIONS
                )
                return time, value, rate

            ends = jnp.concatenate([times[1:], duration[None]])
            candidates = times, ends, rates, inverse_slopes, has_extremum
            times, values, rates = lax.map(locate_one, candidates)
            return (times, rates, has_extremum), (times, values, rates)

        no_extremum = jnp.zeros_like(starts) > 0.0
        (_, _, has_extremum), (times, values, rates) = lax.scan(
            locate_next, (starts, jnp.zeros_like(starts), no_extremum), np.array([False, True])
        )
        is_rising, has_extremum = rates[0, :-1] > 0.0, has_extremum[:-1]
        extrema = LocatedExtrema(
            times[1, :-1],
            has_extremum & is_rising,
            has_extremum & ~is_rising,
            times[0, 1:-1],
            is_rate_extremum & (slopes < 0.0) & (duration > 0.0),
        )
        return extrema, values[1, :-1], rates[0, 1:-1]

    n_quantities = motion.coefficients.shape[-1]
    extrema, values, rates = lax.map(locate, np.eye(n_quantities, dtype=duration.dtype))
    # The loop compiles in half of the time of two evaluations.
    ends = lax.map(lambda state: motion.compute_quantities(*state), motion.end_states)
    return extrema, ExtremumValues(values, rates, ends.T)


def _locate_rate_extrema(motion: PhaseMotion, quantity: Array) -> tuple[Array, Array]:
    """Return where the second time derivative of the polynomials is zero, and its slope there.

    Unused elements lie at the end of the phase, and their slope is zero.
    """
    duration = motion.times[-1]
    locations = np.linspace(0.0, 1.0, N_SAMPLES_PER_INTERVAL, endpoint=False)
    evaluate = lambda time: motion.evaluate_polynomial(time, quantity, 2)
    indices = np.arange(MAX_RATE_EXTREMA_PER_PHASE)

    def compare(state: tuple, sample: tuple) -> tuple[tuple, None]:
        """Keep the interval before a sample if S changes its sign there."""
        time, rate, count, brackets = state
        interval_start, interval_end, location = sample
        next_time = interval_start + (interval_end - interval_start) * location
        next_rate = evaluate(next_time)
        is_change = rate * next_rate < 0.0
        found = jnp.stack([time, next_time, rate, next_rate])
        brackets = jnp.where(is_change & (indices[:, None] == count), found, brackets)
        return (next_time, next_rate, count + jnp.where(is_change, 1.0, 0.0), brackets), None

    # Each sample ends the interval that began at the sample before.
    n_intervals = len(motion.times) - 1
    repeat = lambda x: jnp.repeat(x, N_SAMPLES_PER_INTERVAL)
    zero = jnp.zeros_like(duration)
    samples = (
        jnp.append(repeat(motion.times[:-1]), duration),
        jnp.append(repeat(motion.times[1:]), duration),
        np.append(np.tile(locations, n_intervals), 0.0),
    )
    unused = jnp.stack([duration, duration, zero, zero])
    brackets = jnp.broadcast_to(unused, (MAX_RATE_EXTREMA_PER_PHASE, 4))
    (_, _, _, brackets), _ = lax.scan(compare, (zero, zero, zero, brackets), samples)
    start, end, start_rate, end_rate = brackets.T
    is_used = start < end
    roots = lax.map(lambda x: _bisect(evaluate, *x), (start, end, start_rate))
    slopes = (end_rate - start_rate) / jnp.where(is_used, end - start, 1.0)
    return jnp.where(is_used, roots, duration), jnp.where(is_used, slopes, 0.0)


def evaluate_extrema(motion: PhaseMotion, extrema: LocatedExtrema) -> ExtremumValues:
    """Return the values of the quantities at located extrema, with exact first derivatives.

    F and R are stationary in time at their extrema, so that their times need no derivatives.
    """
    times = jnp.concatenate([extrema.times, extrema.rate_times], 1)
    states = lax.map(motion.find_state, times.ravel())
    # One loop over all states compiles in half of the time of separate code for the ends.
    states = jax.tree.map(lambda *x: jnp.concatenate(x), states, motion.end_states)
    values, rates = (x.T for x in lax.map(motion.evaluate, states))
    n_quantities, n_extrema = extrema.times.shape
    at_own_times = lambda x: jnp.stack(
        [x[i, :-2].reshape(n_quantities, -1)[i] for i in range(n_quantities)]
    )
    return ExtremumValues(
        at_own_times(values)[:, :n_extrema], at_own_times(rates)[:, n_extrema:], values[:, -2:]
    )


def _bisect(function: Callable[[Array], Array], start: Array, end: Array, value: Array) -> Array:
    """Return a root of a function between two points.

    `value` is that at the start. Without a change of sign, the result is any point between.
    """

    def halve(bracket: tuple, _: None) -> tuple[tuple, None]:
        start, end = bracket
        middle = 0.5 * (start + end)
        is_root_later = jnp.sign(function(middle)) == jnp.sign(value)
        return (
            jnp.where(is_root_later, middle, start),
            jnp.where(is_root_later, end, middle),
        ), None

    (start, end), _ = lax.scan(halve, (start, end), length=N_BISECTIONS)
    return 0.5 * (start + end)


def _compute_forces(wheel: Any, phase: AbstractPhase, q: Array, v: Array) -> Array:
    """Return the normal force on the fore foot and, in double support, also the total force."""
    instant = PhaseInstant(phase, phase.compute_motion(tuple(q), tuple(v)))
    fore_force = jnp.asarray(instant.fore_force.normal)
    if instant.rear_force is None:
        return fore_force[None]
    return jnp.stack([fore_force, fore_force + instant.rear_force.normal])


def _reconstruct_phases(
    system: CollocationSystem,
    parameters: Array,
    solution: CollocationSolution,
    has_polynomials: bool = False,
    compute_quantities: Callable[..., Array] = _compute_forces,
) -> tuple[list[list[PhaseMotion]], list[Scalar]]:
    """Return the motion of each phase in each gait step, and each landing's impulse.

    - `compute_quantities`: function of wheel, phase, coordinates and rates whose extrema are
      located.
    """
    sequence, constants = system.phase_sequence, system.phase_constants_function(*parameters)
    section_state, motions_by_step, impulses = tuple(solution.section_state), [], []
    for step_index in range(system.period_n):
        step_constants = sequence.select_constants(constants, (step_index % 2,))
        wheel = system.make_wheel(parameters, step_index)
        symbols = wheel.symbols()
        start = sequence.step_start_map(step_constants, section_state)
        paper_phases = make_paper_phases(symbols, start.held_constants[0], stop_at_lift_off=False)
        motions = []
        for i, phase in enumerate(sequence.phases):
            motion = reconstruct_motion(
                system.phase_meshes[i],
                (jnp.stack(start.q), jnp.stack(start.v)),
                solution.durations[step_index, i],
                solution.accelerations[i][step_index],
                functools.partial(_compute_acceleration, paper_phases[i]),
                functools.partial(compute_quantities, wheel, paper_phases[i]),
                has_polynomials,
            )
            motions.append(motion)
            end = PhasePoint(start.held_constants, tuple(motion.q[-1]), tuple(motion.v[-1]))
            start = phase.reset_map(step_constants, end)
        section_state = start.q
        motions_by_step.append(motions)
        impulses.append(transitions.resolve_landing(symbols, end.q[0], *end.v).fore_impulse.normal)
    return motions_by_step, impulses


def _compute_acceleration(phase: AbstractPhase, q: Array, v: Array) -> Array:
    motion = phase.compute_motion(tuple(q), tuple(v))
    return jnp.stack(phase.solve_acceleration(motion)[: phase.n_dof])


ForceExtrema = list[list[LocatedExtrema]]
"""Extrema of the forces of each phase in each gait step."""


def _summarize_steps(
    extrema_by_step: ForceExtrema,
    values_by_step: list[list[ExtremumValues]],
    durations: Array,
    landing_impulses: list[Scalar],
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES`: the largest value of each over the gait steps."""
    peaks_by_step = []
    for extrema, values, step_durations, landing_impulse in zip(
        extrema_by_step, values_by_step, durations, landing_impulses, strict=True
    ):
        forces = (_join_phases(extrema, values, step_durations, index) for index in range(2))
        step_peaks = {**summarize_forces(jnp, *forces), "landing_impulse": landing_impulse}
        peaks_by_step.append(jax.tree.map(lambda x: x.astype(durations.dtype), step_peaks))
    return jax.tree.map(lambda *values: functools.reduce(jnp.fmax, values), *peaks_by_step)


def _locate_force_peaks(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> tuple[dict[str, Scalar], ForceExtrema]:
    """Return the measures of the forces, and the extrema."""
    motions, impulses = _reconstruct_phases(system, parameters, solution, True)
    located = [[locate_extrema(motion) for motion in step_motions] for step_motions in motions]
    extrema = [[x for x, _ in step] for step in located]
    values = [[x for _, x in step] for step in located]
    return _summarize_steps(extrema, values, solution.durations, impulses), extrema


def _compute_peak_derivatives(
    system: CollocationSystem, parameters: Array, gait_and_tangents: tuple
) -> dict[str, Array]:
    """Return the derivatives of the measures by the parameters, on a leading axis.

    - `gait_and_tangents`: the gait and its extrema, and the gait's derivatives by the parameters.
    """
    (state, extrema), (state_tangents, _) = gait_and_tangents

    def evaluate(parameters: Array, solution: CollocationSolution) -> dict[str, Scalar]:
        motions, impulses = _reconstruct_phases(system, parameters, solution)
        values = [list(map(evaluate_extrema, *step)) for step in zip(motions, extrema, strict=True)]
        return _summarize_steps(extrema, values, solution.durations, impulses)

    directions = jnp.eye(len(parameters), dtype=parameters.dtype), state_tangents.solution
    return lax.map(lambda x: jax.jvp(evaluate, (parameters, state.solution), x)[1], directions)


def measure_extremum(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution, measure: Measure
) -> Array:
    """Return the extremum of a measure of the user over its phases, as the mean over the steps."""

    def compute_quantity(wheel: Any, phase: AbstractPhase, q: Array, v: Array) -> Array:
        if phase.phase_name not in measure.phases:
            return jnp.zeros(1, q.dtype)
        instant = PhaseInstant(phase, phase.compute_motion(tuple(q), tuple(v)))
        return jnp.asarray(measure(instant, wheel))[None]

    reconstruct = functools.partial(_reconstruct_phases, system)
    motions_by_step, _ = reconstruct(parameters, solution, False, compute_quantity)
    # Only values at the extrema need derivatives.
    fixed = lax.stop_gradient((parameters, solution))
    fixed_motions_by_step, _ = reconstruct(*fixed, True, compute_quantity)
    sign, of_steps = (1.0 if measure.reduction == "max" else -1.0), []
    for motions, fixed_motions, durations in zip(
        motions_by_step, fixed_motions_by_step, solution.durations, strict=True
    ):
        candidates = []
        for motion, fixed_motion, phase, duration in zip(
            motions, fixed_motions, PAPER_PHASES, durations, strict=True
        ):
            if phase.phase_name in measure.phases:
                extrema, _ = locate_extrema(fixed_motion)
                values = evaluate_extrema(motion, extrema)
                is_extremum = extrema.is_maximum if sign > 0.0 else extrema.is_minimum
                is_candidate = jnp.append(is_extremum[0], jnp.ones(2, bool)) & (duration > 0.0)
                values_and_ends = sign * jnp.append(values.values[0], values.ends[0])
                candidates.append(jnp.where(is_candidate, values_and_ends, -jnp.inf))
        largest = jnp.max(jnp.concatenate(candidates))
        of_steps.append(jnp.where(jnp.isfinite(largest), sign * largest, 0.0))
    return jnp.mean(jnp.stack(of_steps))


def _compile_for_gaits(function: Callable, system: CollocationSystem) -> BatchFunction:
    function_of_gait = with_lane_axis(functools.partial(function, system))
    return compile_batch_function(function_of_gait, system.cycle_options.batch_size)


@functools.partial(jax.jit, static_argnums=0)
def locate_force_peaks(
    system: CollocationSystem, parameters: Array, solution: CollocationSolution
) -> tuple[dict[str, Scalar], ForceExtrema]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a gait by name, and the extrema.

    The results have no derivatives.
    """
    locate = unbatch(_compile_for_gaits(_locate_force_peaks, system))
    return locate(*lax.stop_gradient((parameters, solution)))


@functools.partial(jax.jit, static_argnums=0)
def measure_force_peaks(
    system: CollocationSystem, parameters: Array, state: CollocationState
) -> dict[str, Scalar]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a gait by name, with first derivatives."""
    peaks, extrema = locate_force_peaks(system, parameters, state.solution)
    tangent_function = make_tangent_function(system)

    def compile_derivatives(_: BatchFunction, order: int) -> BatchFunction:
        if order > 1:
            raise NotImplementedError(
                "measures of the force's peaks have first derivatives only: take differences of "
                "their gradients."
            )
        return _compile_for_gaits(_compute_peak_derivatives, system)

    compute_derivatives = make_implicit_jacobian(
        functools.partial(_compute_peak_derivatives, system),
        lambda parameters, gait: (tangent_function(parameters, gait[0]), ()),
        compile_derivatives,
        make_jacobian=functools.partial(_compute_peak_derivatives, system),
    )
    return attach_derivatives(compute_derivatives, peaks, parameters, (state, extrema))


def _join_phases(
    extrema_of_phases: list[LocatedExtrema],
    values_of_phases: list[ExtremumValues],
    phase_durations: Array,
    force_index: int,
) -> StepForceExtrema:
    """Return the extrema of one force over a gait step, from the extrema in each phase.

    - `force_index`: 0 for the force on the fore foot, 1 for the total force.
    """
    extrema_of_phases, values_of_phases = jax.tree.map(
        lambda x: x[min(force_index, len(x) - 1)], (extrema_of_phases, values_of_phases)
    )
    join = lambda name, phases: jnp.concatenate([getattr(phase, name) for phase in phases])
    start_times = jnp.cumsum(phase_durations) - phase_durations
    times, rate_times = (
        jnp.concatenate(
            [
                getattr(extrema, name) + start_time
                for extrema, start_time in zip(extrema_of_phases, start_times, strict=True)
            ]
        )
        for name in ("times", "rate_times")
    )
    has_phase_occurred = jnp.repeat(phase_durations > 0.0, 2)
    return StepForceExtrema(
        times,
        join("values", values_of_phases),
        join("is_maximum", extrema_of_phases),
        join("is_minimum", extrema_of_phases),
        rate_times,
        join("rates", values_of_phases),
        join("is_rate_maximum", extrema_of_phases),
        jnp.where(has_phase_occurred, join("ends", values_of_phases), -jnp.inf),
    )

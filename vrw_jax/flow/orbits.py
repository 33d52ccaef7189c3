"""Return maps and multipliers of periodic orbits of hybrid systems, and errors of event times.

Multipliers are computed from the Jacobians of an orbit's segments, without their product. In a
product of matrices, growing directions stay accurate and decaying directions do not. If one
multiplier is 1 and another 1e-20, the product has no correct digit of the small multiplier. An
orthogonal iteration around the period makes every factor triangular (a periodic Schur form). Each
multiplier is then a product of diagonal entries, all of which are accurate.

The determinant of the flow's Jacobian over modes and events, by Liouville's formula and saltation
matrices, is the product of all multipliers.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from vrw_jax import lanes
from vrw_jax.base.checks import check_reals
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.hybrid_simulation import (
    Guard,
    HybridSolution,
    Mode,
    Termination,
    convert_modes_to_tuple,
    simulate_hybrid,
    simulate_modes,
)
from vrw_jax.flow.phase_integration import (
    StateArray,
    VectorField,
    is_machine_code_better,
    sample_phase,
)
from vrw_jax.lanes.autodiff import forbid_reverse_mode
from vrw_jax.lanes.program import call_compiled_program


class FlowSegments(NamedTuple):
    """Flow of a vector field, divided into segments of equal duration."""

    states: Float[Array, "n_ends dim"]  # states at the segments' ends, the start first
    jacobians: Float[
        Array, "n_segments n n"
    ]  # Jacobian of each segment's end with respect to its start
    divergence: Scalar  # divergence integrated over all segments, the logarithm of the determinant


def segment_maps(
    field: VectorField,
    start: ArrayLike | Sequence,
    duration: ArrayLike,
    n_segments: int,
    options: StepOptions,
    n_directions: int | None = None,
) -> FlowSegments:
    """Return states and Jacobians of the flow of `field`, divided into segments of equal duration.

    The step-size control includes the errors of derivatives. Each tangent is stored as a direction
    of nearly constant length and the logarithm of its growth, so that decaying directions stay
    accurate. A coordinate that measures time comes after all other coordinates and is not a
    direction. The Jacobian of a segment is NaN if the number of its solver steps reaches the limit.

    Args:
        field: vector field.
        start: state at the start, shape (dim,).
        duration: duration of all segments together, s.
        n_segments: number of segments.
        options: options of the integration.
        n_directions: number of leading coordinates with respect to which the Jacobians are
            computed, by default all.
    """
    start = jnp.asarray(start, float)
    field_output_shape = jax.eval_shape(field, start)
    n_tangents = start.size if n_directions is None else n_directions
    if start.ndim != 1 or field_output_shape.shape != start.shape:
        raise ValueError(
            f"the field gives shape {field_output_shape.shape} for a start of shape {start.shape}, "
            "but both must be one row of the same length."
        )
    if not (0 < n_tangents <= start.size and n_segments > 0):
        raise ValueError(
            f"directions is {n_tangents} and n_segments {n_segments}, but the first must be "
            f"from 1 to {start.size} and the other positive."
        )
    static_arguments = (field, n_segments, n_tangents)
    duration = jnp.asarray(duration, start.dtype)
    if is_machine_code_better(field, options, n_segments * start.size * n_tangents):
        flow_segments = _integrate_segments_compiled(
            lambda: static_arguments, start, duration, options
        )
    else:
        flow_segments = call_compiled_program(
            _integrate_flow_segments, static_arguments, start, duration, options
        )
    return forbid_reverse_mode("hybrid.segment_maps", flow_segments)


@lanes.jit
def _integrate_segments_compiled(get_static_arguments: Callable, *arguments: Any) -> FlowSegments:
    return _integrate_flow_segments(get_static_arguments(), *arguments)


def _integrate_flow_segments(
    static_arguments: tuple[VectorField, int, int],
    start: Array,
    duration: Array,
    options: StepOptions,
) -> FlowSegments:
    field, n_segments, n_tangents = static_arguments
    n_coordinates, n_state_and_tangents = start.size, start.size * (1 + n_tangents)
    segment_duration = duration / n_segments

    def evaluate_flow_and_tangents(augmented_state: Array) -> Array:
        state = augmented_state[:n_coordinates]
        tangents = augmented_state[n_coordinates:n_state_and_tangents].reshape(
            n_tangents, n_coordinates
        )
        jvp_of_field = lambda tangent: jax.jvp(field, (state,), (tangent,))[1]
        tangent_rates = jax.vmap(jvp_of_field)(tangents)
        tangent_growth_rates = jnp.sum(tangents * tangent_rates, axis=1) / jnp.sum(
            tangents * tangents, axis=1
        )
        normalized_tangent_rates = tangent_rates - tangent_growth_rates[:, None] * tangents
        unit_direction_rates = jax.vmap(jvp_of_field)(
            jnp.eye(n_tangents, n_coordinates, dtype=augmented_state.dtype)
        )
        clock_rate = jnp.ones_like(state[:1])
        return jnp.concatenate(
            [
                field(state),
                normalized_tangent_rates.ravel(),
                tangent_growth_rates,
                jnp.trace(unit_direction_rates)[None],
                clock_rate,
            ]
        )

    def integrate_segment(state: Array, _: None) -> tuple[Array, tuple]:
        start_state = jnp.concatenate(
            [state, jnp.eye(n_tangents, n_coordinates).ravel(), jnp.zeros(n_tangents + 2)]
        )
        end_state = sample_phase(
            evaluate_flow_and_tangents, start_state, segment_duration, 2, options
        )[-1]
        # Otherwise the solver steps were exhausted.
        is_segment_completed = jnp.abs(end_state[-1] - segment_duration) <= 1e-9 * segment_duration
        tangents = end_state[n_coordinates:n_state_and_tangents].reshape(n_tangents, n_coordinates)
        tangent_growth_factors = jnp.exp(
            end_state[n_state_and_tangents : n_state_and_tangents + n_tangents]
        )
        segment_jacobian = jnp.where(
            is_segment_completed, tangents[:, :n_tangents].T * tangent_growth_factors, jnp.nan
        )
        return end_state[:n_coordinates], (
            end_state[:n_coordinates],
            segment_jacobian,
            end_state[-2],
        )

    _, (end_states, jacobians, divergences) = lax.scan(
        integrate_segment, start, None, length=n_segments
    )
    return FlowSegments(jnp.concatenate([start[None], end_states]), jacobians, jnp.sum(divergences))


class ProductMultipliers(NamedTuple):
    """Eigenvalues of a product of matrices, in order of decreasing modulus."""

    values: np.ndarray  # eigenvalues, complex; NaN if `is_known` is False
    logarithms: np.ndarray  # logarithms of the moduli, finite even if an eigenvalue underflows
    relative_error: np.ndarray  # estimated relative errors
    is_known: np.ndarray  # whether the relative error is within `accuracy`


N_SCHUR_SWEEPS = 60
"""Largest number of orthogonal iterations around the period.

The value is chosen because moduli that differ by a factor of two are then separated to the last
digit. Closer moduli stay together in one block, whose product loses few digits.
"""


def product_multipliers(
    jacobians: ArrayLike | Sequence, accuracy: float = 1e-6, tolerance: float = 1e-15
) -> ProductMultipliers:
    """Return the eigenvalues of jacobians[-1] @ ... @ jacobians[0], with estimated errors.

    Args:
        jacobians: concrete matrices, shape (n_segments, n, n).
        accuracy: largest relative error with which an eigenvalue is returned. An eigenvalue with a
            larger error is NaN.
        tolerance: error of each Jacobian relative to its norm.
    """
    jacobians = np.asarray(jacobians, float)
    if jacobians.ndim != 3 or jacobians.shape[1] != jacobians.shape[2] or not jacobians.size:
        raise ValueError(f"maps has shape {jacobians.shape}, but it must be (n_segments, n, n).")
    if not np.all(np.isfinite(jacobians)):
        raise ValueError(
            "maps contains a number that is not finite: the flow left its domain, or its steps "
            "were exhausted; take more segments, or raise StepOptions.max_solver_steps."
        )
    n_coordinates = jacobians.shape[1]
    orthonormal_basis = np.eye(n_coordinates)
    triangular_factors = np.zeros_like(jacobians)
    for _ in range(N_SCHUR_SWEEPS):
        next_orthonormal_basis = orthonormal_basis
        for factor_index, jacobian in enumerate(jacobians):
            next_orthonormal_basis, triangular_factors[factor_index] = np.linalg.qr(
                jacobian @ next_orthonormal_basis
            )
        closing_matrix = orthonormal_basis.T @ next_orthonormal_basis
        orthonormal_basis = next_orthonormal_basis
        has_subdiagonal_entry = np.abs(np.tril(closing_matrix, -1)) > 1e-14
        if not has_subdiagonal_entry.any():
            break
    block_slices, block_start = [], 0
    for block_end in range(1, n_coordinates + 1):
        if not has_subdiagonal_entry[block_end:, :block_end].any():
            block_slices.append(slice(block_start, block_end))
            block_start = block_end
    jacobian_norms = np.linalg.norm(jacobians, axis=(1, 2))
    block_results = [
        _compute_block_multipliers(
            triangular_factors, closing_matrix, block_slice, jacobian_norms, tolerance
        )
        for block_slice in block_slices
    ]
    block_multipliers, logarithms, relative_error = (
        np.concatenate(x) for x in zip(*block_results, strict=True)
    )
    is_known = relative_error <= accuracy
    descending_order = np.argsort(-logarithms, kind="stable")
    return ProductMultipliers(
        np.where(is_known, block_multipliers, np.nan)[descending_order],
        logarithms[descending_order],
        relative_error[descending_order],
        is_known[descending_order],
    )


def _compute_block_multipliers(
    triangular_factors: np.ndarray,
    closing_matrix: np.ndarray,
    block_slice: slice,
    jacobian_norms: np.ndarray,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the multipliers of one diagonal block, logarithms of moduli, and relative errors."""
    diagonal_blocks = triangular_factors[:, block_slice, block_slice]
    block_size = block_slice.stop - block_slice.start
    diagonal_moduli = np.abs(np.diagonal(diagonal_blocks, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_diagonal = np.log(diagonal_moduli)
        error_amplification = np.where(
            diagonal_moduli > 0.0, jacobian_norms[:, None] / diagonal_moduli, 0.0
        )
        relative_error = tolerance * np.max(np.sum(error_amplification, axis=0))
        scaled_product = np.eye(block_size)
        log_block_scale = 0.0
        log_diagonal_spread = np.ptp(np.sum(log_diagonal, axis=0)) if block_size > 1 else 0.0
        for scaled_block in diagonal_blocks:
            scaled_product = scaled_block @ scaled_product
            largest_block_entry = np.max(np.abs(scaled_product)) or 1.0
            scaled_product = scaled_product / largest_block_entry
            log_block_scale = log_block_scale + np.log(largest_block_entry)
        scaled_eigenvalues = np.linalg.eigvals(
            closing_matrix[block_slice, block_slice] @ scaled_product
        )
        logarithms = np.log(np.abs(scaled_eigenvalues)) + log_block_scale
        if block_size == 1:
            logarithms = np.sum(log_diagonal, axis=0)
        multiplier_phases = np.where(
            scaled_eigenvalues == 0.0, 1.0, scaled_eigenvalues / np.abs(scaled_eigenvalues)
        )
        block_multipliers = multiplier_phases * np.exp(logarithms)
    return (
        block_multipliers,
        logarithms,
        np.full(block_size, relative_error * np.exp(log_diagonal_spread)),
    )


def flow_jacobian_determinant(
    modes: Sequence[Mode] | Mode,
    start: ArrayLike | Sequence,
    solution: HybridSolution,
    options: StepOptions | None = None,
) -> Scalar:
    """Return the determinant of the flow's Jacobian from `start` to the last event.

    The Jacobian is that of the state after the event's reset with respect to `start`.

    Each mode contributes the exponential of the time integral of its field's divergence
    (Liouville). Each event contributes the determinant of its saltation matrix (R. I. Leine and H.
    Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, 2004, section 7). For an
    orbit that is periodic after these events, the result is the product of all multipliers. This
    product includes the multiplier 1 in the direction of the flow.

    The Jacobian of a return map does not yield this product accurately if a guard is grazed. The
    entries of the Jacobian then grow in inverse proportion to the guard's time derivative.

    The result is NaN if the number of solver steps reaches its limit. All transforms of JAX except
    reverse mode are supported.

    Args:
        modes: modes of the system, as in `simulate_hybrid`.
        start: state at which `solution` begins, shape (dim,).
        solution: result of `simulate_hybrid`.
        options: options of the integration.
    """
    options = StepOptions() if options is None else options
    modes, start = convert_modes_to_tuple(modes), check_reals("start", start)
    flow_determinant = call_compiled_program(
        _multiply_event_determinants, modes, start, solution, options
    )
    return forbid_reverse_mode("hybrid.flow_jacobian_determinant", flow_determinant)


def _multiply_event_determinants(
    modes: tuple[Mode, ...], start: Array, solution: HybridSolution, options: StepOptions
) -> Scalar:
    event_determinant_functions = [
        functools.partial(_compute_event_determinant, mode, guard, options)
        for mode in modes
        for guard in mode.guards
    ]
    first_guard_index_by_mode = jnp.cumsum(jnp.asarray([0, *(len(mode.guards) for mode in modes)]))[
        :-1
    ]
    phase_start_states, durations = solution.find_phases(start)
    next_modes = jnp.append(solution.modes[1:], solution.mode)
    event_indices = jnp.arange(len(solution.times))
    next_modes = jnp.where(event_indices == solution.n_events - 1, solution.mode, next_modes)
    vector_fields = [mode.field for mode in modes]

    def compute_event_determinant(event_inputs: tuple) -> Array:
        (
            event_determinant_index,
            next_mode,
            start_state,
            state_before_event,
            state_after_event,
            mode_duration,
        ) = event_inputs
        return lax.switch(
            event_determinant_index,
            event_determinant_functions,
            start_state,
            state_before_event,
            lax.switch(next_mode, vector_fields, state_after_event),
            mode_duration,
        )

    event_inputs_by_event = (
        first_guard_index_by_mode[solution.modes] + solution.guards,
        next_modes,
        phase_start_states, solution.states_before, solution.states_after, durations,
    )  # fmt: skip
    event_determinants = lax.map(compute_event_determinant, event_inputs_by_event)
    return jnp.prod(jnp.where(event_indices < solution.n_events, event_determinants, 1.0))


def _compute_event_determinant(
    mode: Mode,
    guard: Guard,
    options: StepOptions,
    start: Array,
    state_before_event: Array,
    field_after_event: Array,
    mode_duration: Array,
) -> Array:
    """Return one factor of the determinant.

    The factor is that of one phase in `mode` and of the event of `guard` that ends the phase.
    """

    def evaluate_flow_and_divergence(augmented_state: Array) -> Array:
        state = augmented_state[:-2]
        divergence = jnp.trace(jax.jacfwd(mode.field)(state))
        return jnp.concatenate(
            [mode.field(state), jnp.stack([divergence, jnp.ones_like(divergence)])]
        )

    end_state = sample_phase(
        evaluate_flow_and_divergence, jnp.append(start, jnp.zeros(2)), mode_duration, 2, options
    )[-1]
    # Otherwise the solver steps were exhausted.
    has_reached_end = jnp.abs(end_state[-1] - mode_duration) <= 1e-9 * mode_duration
    reset_jacobian = jax.jacfwd(guard.reset)(state_before_event)
    guard_gradient = jax.jacfwd(guard.evaluate)(state_before_event)
    field_before_event = mode.field(state_before_event)
    saltation_matrix = reset_jacobian + jnp.outer(
        field_after_event - reset_jacobian @ field_before_event, guard_gradient
    ) / (guard_gradient @ field_before_event)
    return jnp.where(
        has_reached_end, jnp.exp(end_state[-2]) * jnp.linalg.det(saltation_matrix), jnp.nan
    )


def time_errors(
    modes: Sequence[Mode] | Mode,
    start: ArrayLike | Sequence,
    solution: HybridSolution,
    options: StepOptions | None = None,
) -> Float[Array, " events"]:
    """Return estimated errors of the event times, s, shape (events,).

    The simulation is repeated with tolerances that are ten and a hundred times as large. The change
    of each event's time is divided by the `time_tolerance` of that event. Ratios below 1 are
    replaced by 1. The estimate for an event is twice its `time_tolerance` times the largest ratio
    for this and all earlier events. The estimate is at least the sum of the round-off of all states
    and of the time.

    Unlike `time_tolerance`, the estimate includes the accumulated errors of solver steps and of
    earlier events. It also includes errors that the error estimate of an implicit solver omits in a
    stiff field. The estimate is infinite from the first event that the simulation at ten times the
    tolerance does not reach. The estimate is no proven bound.

    Args:
        modes: modes of the system, as in `simulate_hybrid`.
        start: state at which `solution` begins, shape (dim,).
        solution: result of `simulate_hybrid`.
        options: options with which `solution` was computed.
    """
    options = StepOptions() if options is None else options
    modes = convert_modes_to_tuple(modes)
    start, solution = lax.stop_gradient((check_reals("start", start), solution))
    return call_compiled_program(_estimate_time_errors, modes, start, solution, options)


def _estimate_time_errors(
    modes: tuple[Mode, ...], start: Array, solution: HybridSolution, options: StepOptions
) -> Float[Array, " events"]:
    """Return the result of `time_errors` for a tuple of modes whose guards are tuples."""
    event_indices = jnp.arange(len(solution.times))

    def compute_time_change(tolerance_factor: Array) -> Array:
        looser_options = options.with_tightened_tolerances(tolerance_factor)
        modes_and_max_events = (modes, len(event_indices))
        looser_solution = simulate_modes(
            modes_and_max_events, looser_options, start, solution.modes[0]
        )
        is_same_event = (looser_solution.guards == solution.guards) & (
            looser_solution.modes == solution.modes
        )
        is_same_event = jnp.cumprod(is_same_event & (event_indices < looser_solution.n_events)) > 0
        return jnp.where(is_same_event, jnp.abs(looser_solution.times - solution.times), jnp.inf)

    # Each event adds the round-off of its state, and the time has its own.
    accumulated_roundoff = jnp.cumsum(
        jnp.where(jnp.isfinite(solution.time_roundoff), solution.time_roundoff, 0.0)
    )
    accumulated_roundoff = accumulated_roundoff + jnp.finfo(start.dtype).eps * jnp.abs(
        solution.times
    )
    changes_at_tenfold_tolerance, changes_at_hundredfold_tolerance = lax.stop_gradient(
        lax.map(compute_time_change, jnp.asarray([0.1, 0.01], start.dtype))
    )
    largest_time_change = (
        jnp.maximum(
            changes_at_tenfold_tolerance,
            jnp.where(
                jnp.isinf(changes_at_hundredfold_tolerance), 0.0, changes_at_hundredfold_tolerance
            ),
        )
        / solution.time_tolerance
    )
    largest_time_change = lax.cummax(
        jnp.where(jnp.isnan(largest_time_change), jnp.inf, jnp.maximum(largest_time_change, 1.0))
    )
    time_errors = jnp.maximum(
        2.0 * largest_time_change * solution.time_tolerance, accumulated_roundoff
    )
    return jnp.where(event_indices < solution.n_events, time_errors, 0.0)


@dataclasses.dataclass(frozen=True, eq=False)
class ReturnMap:
    """Map from section coordinates to the section coordinates after `events` events.

    The map returns NaN if the simulation ends early, so that its last state is not taken for a
    return. `solve_fixed_point` reports the termination of the simulation in addition to the fixed
    point.

    - `modes`: modes of the system, as in `simulate_hybrid`;
    - `embed`: function from section coordinates to the state in which the simulation begins;
    - `project`: function from the state after the last event to its section coordinates;
    - `events`: number of events per return;
    - `mode`: index of the mode in which the simulation begins;
    - `options`: options of the simulation.
    """

    modes: Sequence[Mode] | Mode
    embed: Callable[[Float[Array, " n"]], StateArray]
    project: Callable[[StateArray], Float[Array, " n"]]
    events: int = 1
    mode: int = 0
    options: StepOptions | None = None

    def simulate(self, x: Float[Array, " n"]) -> HybridSolution:
        """Return the simulation that begins at section coordinates `x`, shape (n,)."""
        return simulate_hybrid(
            self.modes, self.embed(x), events=self.events, mode=self.mode, options=self.options
        )

    def __call__(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the section coordinates after one return from `x`, shape (n,).

        The result is NaN if the simulation ends early.
        """
        hybrid_solution = self.simulate(x)
        section_coordinates = self.project(hybrid_solution.state)
        return section_coordinates * jnp.where(
            hybrid_solution.termination == Termination.MAX_EVENTS_REACHED, 1.0, jnp.nan
        ).astype(section_coordinates.dtype)

    def find_termination(self, x: Float[Array, " n"], period_n: int = 1) -> Int[Array, ""]:
        """Return the `Termination` of the first of `period_n` returns from `x` that ends early.

        If no return ends early, the result is the termination of the last return.
        """
        x = lax.stop_gradient(x)
        termination = jnp.full((), Termination.MAX_EVENTS_REACHED, jnp.int32)
        for _ in range(period_n):
            solution = self.simulate(x)
            termination = jnp.where(
                termination == Termination.MAX_EVENTS_REACHED, solution.termination, termination
            )
            x = self.project(solution.state)
        return termination

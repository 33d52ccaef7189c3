"""Integrate wheels with unilateral contact to their next events, by the search of `flow`.

An interval between two events is a phase of `flow.integrate`. Its guards are those of the contact
state, which each element of a batch has for itself, and last a guard that detects Painlevé's
singularity. For higher derivatives and implicit solvers, diffrax takes the solver steps of a single
wheel under the same search.

The *initiating guard* of a contact state is the guard that was zero at the event before this state.
An example is the guard for the normal force on a foot that has just lifted off.

Step sizes are determined by the motion and computed once for all tangents. At each stage of a
Runge-Kutta step, the quantities common to all tangents are also computed once. Each tangent then
requires only linear operations.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax import lanes
from vrw_jax.base.elementwise import run_if_any_element_active
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.event_location import GUARD_ROUNDOFF_IN_EPS, has_guard_crossed
from vrw_jax.flow.integrate import PhaseEnd
from vrw_jax.flow.phase_integration import GuardsAndMargins, integrate_phase
from vrw_jax.flow.solver_steps import (
    STEP_LENGTH_SAFETY_FACTOR,
    BatchPhase,
    ButcherTableau,
    StageAccelerations,
    StageState,
    compute_real_stability_limit,
)
from vrw_jax.models.contact_mechanics import (
    WheelMotion,
    make_opaque_one,
    pack_motion,
    prevent_fusion,
    stop_gradients,
    unpack_motion,
)
from vrw_jax.models.contact_state import (
    ContactModeDynamics,
    ContactQuantities,
    EnergyLossAccumulators,
    compute_contact_quantities,
    compute_guard_scales,
    compute_packed_units,
    compute_state_units,
    evaluate_guards,
    evaluate_vector_field,
    pack_state,
    unpack_state,
)
from vrw_jax.wheel.laws import compute_damping_coefficient
from vrw_jax.wheel.params import compute_wheel_units
from vrw_jax.wheel.transitions import ContactMode

# Absolute value below which the determinant is treated as zero at Painlevé's singularity. There,
# forces are a ratio of two vanishing quantities, which neither round-off nor integration resolves.
PAINLEVE_ATOL = 1e-8
# Factor by which the relative tolerance is multiplied before it is added to `PAINLEVE_ATOL`. The
# value is chosen because one singularity was missed with a factor of 18.
PAINLEVE_RTOL_FACTOR = 1e2


class IntervalGuards(NamedTuple):
    """Guards of an interval, with what its start determines about them."""

    painleve_sign: Array  # sign of Painlevé's determinant at the start
    offset: Array  # initial value of an initiating guard, minus round-off; else 0
    is_rising_at_start: Array  # whether a guard is an initiating guard
    is_met_at_start: Array  # whether a guard ends the interval at its start

    def limit_phase(
        self, phase: BatchPhase, contact_mode_dynamics: ContactModeDynamics, options: StepOptions
    ) -> BatchPhase:
        """Return the phase with its guards relative to their offsets, and Painlevé's guard."""

        def evaluate_all_guards(state: StageState) -> Array:
            rows = state.acceleration.acceleration
            quantities = ContactQuantities.unpack_rows(contact_mode_dynamics, rows)
            painleve_guard = self.painleve_sign * quantities.painleve_determinant
            painleve_guard = painleve_guard - compute_painleve_tolerance(options)
            # Machine code stores the guards, so that it computes them once.
            return lax.optimization_barrier(
                jnp.concatenate([phase.evaluate_guards(state) - self.offset, painleve_guard])
            )

        scales = compute_guard_scales(contact_mode_dynamics)
        return phase._replace(
            evaluate_guards=evaluate_all_guards,
            guard_scales=jnp.concatenate([scales, jnp.ones_like(scales[:1])]),
            guards_met_at_start=self.is_met_at_start,
            guards_rising_at_start=self.is_rising_at_start,
        )


def compute_painleve_tolerance(options: StepOptions) -> Array:
    """Return the determinant that is treated as zero at Painlevé's singularity."""
    return PAINLEVE_ATOL + PAINLEVE_RTOL_FACTOR * options.rtol


# Time in which a guard must fall by its own round-off to be treated as falling. The value is in the
# wheel's unit of time, which is 1 s for the wheel in Table 1 of the paper.
MAX_ROUNDOFF_FALL_DURATION = 1e-3


def begin_interval(
    dynamics: ContactModeDynamics, phase: BatchPhase, q: Array, v: Array, options: StepOptions
) -> IntervalGuards:
    """Return the guards of the interval that begins with a motion, without derivatives."""
    dynamics, options = stop_gradients((dynamics, options))
    start = phase.make_state(q, v)
    guard_values, guard_rates = lax.stop_gradient(
        phase.evaluate_with_rates(phase.evaluate_guards, start)
    )
    rows = lax.stop_gradient(start.acceleration.acceleration)
    determinant = ContactQuantities.unpack_rows(dynamics, rows).painleve_determinant
    # The guard of a contact released from rest is within round-off for 1e-8 s and longer. A guard
    # that rises from below zero has no event before it falls. Several events at one time leave
    # several such guards.
    guard_roundoff = compute_guard_scales(dynamics) * (
        GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
    )
    time_unit = compute_wheel_units(dynamics.s).time_unit
    min_initiating_guard_rate = -guard_roundoff / (MAX_ROUNDOFF_FALL_DURATION * time_unit)
    layout, contact_state = dynamics.guard_layout, dynamics.contact_state
    make_false_flags = lambda n: jnp.zeros((n, *guard_values.shape[1:]), bool)
    was_zero_at_event = [
        contact_state.has_just_lifted,
        contact_state.has_just_unlocked,
        make_false_flags(layout.slip_end.start - layout.liftoff.start),
        dynamics.contact_slots.gather_flags_from_legs(contact_state.has_just_slid),
        make_false_flags(layout.force_rates.stop - layout.slip_end.stop),
    ]
    is_initiating = jnp.concatenate(was_zero_at_event) | (
        (guard_values <= guard_roundoff) & (guard_rates > min_initiating_guard_rate)
    )
    is_met = ~is_initiating & has_guard_crossed(guard_values, guard_rates)
    return IntervalGuards(
        jnp.where(determinant < 0.0, -1.0, 1.0),
        jnp.where(is_initiating, guard_values - 2.0 * guard_roundoff, 0.0),
        jnp.concatenate([is_initiating, jnp.zeros_like(is_initiating[:1])]),
        jnp.concatenate([is_met, jnp.abs(determinant) <= compute_painleve_tolerance(options)]),
    )


def compute_stage_coordinates(
    tableau: ButcherTableau, i: Array | int, q: Array, v: Array, stage_rates: Array, h: Array
) -> tuple[Array, Array]:
    """Return coordinates and rates at Runge-Kutta stage `i`.

    - `q`, `v`: coordinates and rates at the start. Integrals of losses follow the rates;
    - `stage_rates`: time derivatives of `v` at the earlier stages, (stages, rows, batch);
    - `h`: length of the solver step, s.
    """
    a, b, stage_node = (
        jnp.asarray(x)[i]
        for x in (tableau.stage_matrix, tableau.squared_stage_matrix, tableau.stage_nodes)
    )
    previous_stages = range(len(tableau.stage_nodes) - 1)
    rate_increment = sum(a[j] * stage_rates[j, : len(v)] for j in previous_stages)
    coordinate_increment = sum(b[j] * stage_rates[j, : len(q)] for j in previous_stages)
    return (
        q + h * (stage_node * v[: len(q)] + h * coordinate_increment),
        v + h * rate_increment,
    )


def make_contact_phase(
    dynamics: ContactModeDynamics,
    tableau: ButcherTableau | None,
    options: StepOptions,
    limits_tangents: bool = False,
    is_differentiated: bool = False,
) -> BatchPhase:
    """Return the phase of `flow` between two events, with all guards except Painlevé's.

    The coordinates `q` are hub x, hub z, theta and the leg lengths. The rates `v` are their rates
    and, if requested, the integrals of losses and slip. The acceleration contains the rows of
    `ContactQuantities`.

    - `tableau`: tableau of the solver step; None if diffrax takes the solver steps;
    - `limits_tangents`: whether solver steps are so short that tangents do not grow;
    - `is_differentiated`: whether only derivatives are computed, so that no function is called.
    """

    def evaluate_acceleration(q: Any, v: Any) -> StageAccelerations:
        rows = compute_contact_quantities(dynamics, unpack_motion(q, v)).pack_rows()
        return StageAccelerations((), (), rows)

    def evaluate_phase_guards(state: StageState) -> Array:
        quantities = ContactQuantities.unpack_rows(dynamics, state.acceleration.acceleration)
        return evaluate_guards(dynamics, unpack_motion(state.q, state.v), quantities)

    def evaluate_stages(evaluate: Any, state: StageState, h: Array) -> list[StageState]:
        assert tableau is not None
        last_stage = len(tableau.stage_nodes) - 1
        start, start_row = (state.q, state.v), state.acceleration.acceleration

        def evaluate_stage(i: Array, stage_rows: Array) -> Array:
            coordinates = compute_stage_coordinates(tableau, i, *start, stage_rows, h)
            row = evaluate(*coordinates).acceleration
            return lax.dynamic_update_index_in_dim(stage_rows, row, i, 0)

        later_rows = jnp.zeros((last_stage, *start_row.shape), start_row.dtype)
        stage_rows = lax.fori_loop(
            1, last_stage + 1, evaluate_stage, jnp.concatenate([start_row[None], later_rows])
        )

        def make_stage(i: int) -> StageState:
            q, v = (), ()  # Of most stages, only the accelerations are used.
            if i in (*tableau.guard_stage_indices, last_stage):
                # Machine code stores the coordinates, so that it computes them once.
                q, v = lax.optimization_barrier(
                    compute_stage_coordinates(tableau, i, *start, stage_rows, h)
                )
            return StageState(q, v, StageAccelerations((), (), stage_rows[i]))

        return [state, *map(make_stage, range(1, last_stage + 1))]

    def take_solver_step(state: StageState, h: Array) -> tuple[list[StageState], Array]:
        assert tableau is not None
        stage_states = evaluate_stages(evaluate_acceleration, state, h)
        squared_error = _compute_squared_error(dynamics, tableau, options, stage_states, h)
        if limits_tangents:
            stable_step_length = compute_stable_step_length(dynamics, tableau, state.q, state.v)
            excess = STEP_LENGTH_SAFETY_FACTOR * h / stable_step_length
            squared_error = jnp.maximum(squared_error, excess ** (2 * tableau.convergence_order))
        return stage_states, squared_error

    if is_differentiated:
        return BatchPhase(
            evaluate_acceleration, evaluate_phase_guards, take_solver_step=take_solver_step
        )
    call_acceleration = lanes.mark_noinline(evaluate_acceleration)
    return BatchPhase(
        call_acceleration,
        evaluate_phase_guards,
        take_solver_step=take_solver_step,
        take_last_step=partial(evaluate_stages, call_acceleration),
        has_exact_events=True,
        max_event_correction=EVENT_CORRECTION_FACTOR * jnp.sqrt(options.rtol),
    )


def _compute_squared_error(
    contact_mode_dynamics: ContactModeDynamics,
    tableau: ButcherTableau,
    options: StepOptions,
    stage_states: list[StageState],
    h: Array,
) -> Array:
    """Return the mean square of the error of a solver step, divided by the tolerance.

    The result is infinite for a solver step whose end is not finite.
    """
    start, *_, end = stage_states
    n = len(start.q)
    sum_weighted_stages = lambda weights: sum(
        float(w) * state.acceleration.acceleration[:n]
        for w, state in zip(weights, stage_states, strict=True)
        if w != 0.0
    )
    squared_error_sum = jnp.zeros_like(h)
    for error, x, y, unit in zip(
        (
            h * h * sum_weighted_stages(tableau.position_error_weights),
            h * sum_weighted_stages(tableau.rate_error_weights),
        ),
        (start.q, start.v[:n]),
        (end.q, end.v[:n]),
        compute_state_units(contact_mode_dynamics.s),
        strict=True,
    ):
        tolerance = options.atol * unit + options.rtol * jnp.maximum(jnp.abs(x), jnp.abs(y))
        squared_error_sum = squared_error_sum + jnp.sum(jnp.square(error / tolerance), axis=0)
    return jnp.where(jnp.isfinite(squared_error_sum), squared_error_sum / (2 * n), jnp.inf)


EVENT_CORRECTION_FACTOR = 0.1
"""Ratio of the last correction of an event's time, in solver steps, to the root of the tolerance.

The value is chosen because the extrapolated state then has a hundredth of the allowed error.
"""
STABILITY_SAFETY_FACTOR = 0.85
"""Ratio of the longest solver step for tangents to the longest stable step."""


def compute_stable_step_length(
    contact_mode_dynamics: ContactModeDynamics, tableau: ButcherTableau, q: Array, v: Array
) -> Array:
    """Return the longest solver step in which the tangents of a leg in the air do not grow, s.

    The damper stops such a leg within a time of order m / c. Step-size control is based on the
    motion alone, in which the leg may be nearly at rest.
    """
    s, contact_state = contact_mode_dynamics.s, contact_mode_dynamics.contact_state
    has_swing_leg = jnp.any(
        ~contact_state.is_leg_locked & (contact_state.contact_modes == ContactMode.OFF), axis=0
    )
    damping = s.c
    if s.leg_force is not None:
        motion = unpack_motion(q, v)
        damping = jnp.max(compute_damping_coefficient(s, motion.L, motion.dL), axis=0)
    stable_step_factor = STABILITY_SAFETY_FACTOR * compute_real_stability_limit(tableau)
    return jnp.where(has_swing_leg, stable_step_factor * s.m / jnp.maximum(damping, 0.0), jnp.inf)


def integrate_by_diffrax(
    contact_mode_dynamics: ContactModeDynamics,
    phase: BatchPhase,
    motion: WheelMotion,
    is_active: Array,
    options: StepOptions,
) -> PhaseEnd:
    """Return the end of an interval of a single wheel; its state is a packed state."""

    def evaluate_packed_guards(packed_state: Array) -> Array:
        motion, _ = unpack_state(packed_state)
        guard_values = phase.evaluate_guards(phase.make_state(*pack_motion(motion)))
        return prevent_fusion(guard_values, make_opaque_one(motion.theta))

    zero, scales = jnp.zeros_like(motion.x), phase.guard_scales
    assert scales is not None
    return integrate_phase(
        lambda packed_state: evaluate_vector_field(contact_mode_dynamics, packed_state),
        GuardsAndMargins(evaluate_packed_guards, len(scales), guard_scales=scales),
        pack_state(motion, EnergyLossAccumulators(zero, zero, zero, zero)),
        is_active,
        options,
        compute_packed_units(contact_mode_dynamics.s),
    )


class TangentBatch(NamedTuple):
    """Tangents of the input columns of all batch elements, and functions of all tangents.

    The first axis of an array contains tangents, and the last axis the batch. An array of *tangent
    rows* contains the tangents of all floating-point arrays of a `LaneState`.
    """

    n_tangents: Array  # number of tangents of each batch element
    n_column_tangents: Array  # number of leading tangents whose columns may vary
    column_tangents: Array  # tangents of the input columns

    def get_input_tangent(self, k: Array) -> Array:
        """Return the tangent of the input columns with index `k`."""
        return lax.dynamic_index_in_dim(self.column_tangents, k, 0, keepdims=False)

    def allocate_tangent_rows(self, n_rows: int) -> Array:
        """Return an uninitialized array for all tangents, (tangents, n_rows, batch)."""
        return lax.empty(
            (len(self.column_tangents), n_rows, *self.n_tangents.shape), self.column_tangents.dtype
        )

    def map_tangents_sequentially(
        self,
        compute_new_rows: Callable[[Array, Array], Any],
        tangent_rows: Array,
        first_replaced_row: Array | int = 0,
    ) -> Array:
        """Return the tangents after a function has been applied to each, (tangents, rows, batch).

        The results of the function replace the rows from `first_replaced_row` onward.

        - `compute_new_rows`: function that takes the index and the rows of a tangent, and returns a
          tree of new rows.
        """
        should_continue = lambda state: jnp.any(state[0] < self.n_tangents)

        def update_tangent_rows(state: tuple[Array, Array]) -> tuple[Array, Array]:
            k, tangent_rows = state
            new_rows = pack_tree_into_rows(
                compute_new_rows(k, lax.dynamic_index_in_dim(tangent_rows, k, 0, False))
            )
            # Stacking row by row keeps the rows in registers.
            new_rows = jnp.stack([new_rows[i] for i in range(len(new_rows))])
            start_indices = k, jnp.int32(first_replaced_row), jnp.int32(0)
            return k + 1, lax.dynamic_update_slice(tangent_rows, new_rows[None], start_indices)

        return lax.while_loop(
            should_continue, update_tangent_rows, (jnp.zeros((), jnp.int32), tangent_rows)
        )[1]


def pack_tree_into_rows(array_tree: Any) -> Array:
    """Return all arrays of a tree, concatenated to one array (rows, batch)."""
    return jnp.concatenate(
        [leaf.reshape(-1, leaf.shape[-1]) for leaf in jax.tree.leaves(array_tree)]
    )


def unpack_tree_from_rows(tangent_rows: Array, tangent_template: Any) -> Any:
    """Return rows as a tree, which inverts `pack_tree_into_rows`."""
    leaves, tree_structure = jax.tree.flatten(tangent_template)
    arrays, row_offset = [], 0
    for leaf in leaves:
        n_leaf_rows = math.prod(leaf.shape[:-1])
        leaf_rows = tangent_rows[..., row_offset : row_offset + n_leaf_rows, :]
        arrays.append(leaf_rows.reshape(*tangent_rows.shape[:-2], *leaf.shape))
        row_offset += n_leaf_rows
    return jax.tree.unflatten(tree_structure, arrays)


class IntervalTangents(NamedTuple):
    """Tangents of an interval between two events, with the methods of `flow.PhaseTangents`."""

    make_phase: Callable[[Any, Array], BatchPhase]  # for constants and rows of quantities
    equation_constants: Any  # floating-point arrays of the dynamics
    push_to_constants: Callable[[Array], Any]  # from tangents of columns to those of the constants
    tangents: TangentBatch
    start_tangents: Array  # tangents of coordinates, rates and losses, (tangents, rows, batch)
    held_constants: tuple = ()

    @property
    def zero_constants_tangent(self) -> Any:
        """Return the tangent of constants that do not vary."""
        return jax.tree.map(jnp.zeros_like, self.equation_constants)

    def linearize(
        self, function: Callable[[BatchPhase, StageState], Array], q: Any, v: Any, rows: Array
    ) -> Any:
        """Return the linear map from tangents of (constants, q, v) to those of a function's value.

        - `rows`: rows of `ContactQuantities` at the state, which are not computed again.
        """

        def evaluate(equation_constants: Any, q: Array, v: Array) -> Array:
            phase = self.make_phase(equation_constants, rows)
            return function(phase, phase.make_state(q, v))

        return jax.linearize(evaluate, self.equation_constants, q, v)[1]

    def propagate_to_step_end(
        self,
        tableau: ButcherTableau,
        stage_states: list[StageState],
        start_tangents: Array,
        h: Array,
        is_accepted: Array | bool = True,
    ) -> Array:
        """Return the tangents at the end of a solver step of length `h`, s, if it is accepted."""
        q, v, _ = stage_states[0]
        n, n_rates, tangents = len(q), len(v), self.tangents
        stage_rows = jnp.stack([state.acceleration.acceleration for state in stage_states[:-1]])
        evaluate_rates = lambda _, state: state.acceleration.acceleration[:n_rates]

        def push_stage(loop_state: tuple[Array, Array]) -> tuple[Array, Array]:
            i, rate_tangents = loop_state
            stage = compute_stage_coordinates(tableau, i, q, v, stage_rows, h)
            rows = lax.dynamic_index_in_dim(stage_rows, i, 0, False)
            push = self.linearize(evaluate_rates, *stage, rows)
            # A second linearization removes the terms of inputs, which most tangents keep constant.
            _, push_coordinates = jax.linearize(
                lambda q, v: push(self.zero_constants_tangent, q, v), *stage
            )

            def push_tangent(k: Array, previous_rates: Array) -> Array:
                coordinate_tangents = _propagate_to_stage(
                    tableau,
                    i,
                    lax.dynamic_index_in_dim(start_tangents, k, 0, False),
                    previous_rates.reshape(-1, *v.shape),
                    n,
                    h,
                )
                has_input_tangent = jnp.any(k < tangents.n_column_tangents)
                rate_tangent = run_if_any_element_active(
                    ~has_input_tangent,
                    lambda _: push_coordinates(*coordinate_tangents),
                    jnp.zeros_like(v),
                )
                return run_if_any_element_active(
                    has_input_tangent,
                    lambda _: push(
                        self.push_to_constants(tangents.get_input_tangent(k)), *coordinate_tangents
                    ),
                    rate_tangent,
                )

            return i + 1, tangents.map_tangents_sequentially(
                push_tangent, rate_tangents, i * n_rates
            )

        n_stages = len(stage_states) - 1
        rate_tangents = lax.while_loop(
            lambda loop_state: loop_state[0] < n_stages,
            push_stage,
            (jnp.zeros((), jnp.int32), tangents.allocate_tangent_rows(n_stages * n_rates)),
        )[1]

        def propagate_to_end(k: Array, start_row: Array) -> Array:
            rates = lax.dynamic_index_in_dim(rate_tangents, k, 0, False).reshape(-1, *v.shape)
            end = compute_stage_coordinates(
                tableau, n_stages, start_row[:n], start_row[n:], rates, h
            )
            return jnp.where(is_accepted, jnp.concatenate(end), start_row)

        return tangents.map_tangents_sequentially(propagate_to_end, start_tangents)

    def evaluate_rate_and_tangents(
        self,
        evaluate_function: Callable[[BatchPhase, StageState], Array],
        state: StageState,
        directions: Array,
    ) -> tuple[Array, Array]:
        """Return time derivative and tangents of a number, for tangents of a state."""
        q, v, (_, _, rows) = state
        push = self.linearize(evaluate_function, q, v, rows)
        rate = push(self.zero_constants_tangent, v[: len(q)], rows[: len(v)])

        def push_direction(k: Array, _: Array) -> Array:
            direction = lax.dynamic_index_in_dim(directions, k, 0, False)
            constants_tangent = self.push_to_constants(self.tangents.get_input_tangent(k))
            return push(constants_tangent, direction[: len(q)], direction[len(q) :])

        tangents = self.tangents.map_tangents_sequentially(
            push_direction, self.tangents.allocate_tangent_rows(1)
        )
        return rate, tangents[:, 0]


def _propagate_to_stage(
    tableau: ButcherTableau, i: Array, start_tangent: Array, rate_tangents: Array, n: int, h: Array
) -> tuple[Array, Array]:
    """Return the tangents of `compute_stage_coordinates`, from the tangents at the earlier stages.

    - `start_tangent`: tangent of `n` coordinates, and of the rates.
    """
    flat_matrices = [
        jnp.asarray(stage_matrix.ravel())
        for stage_matrix in (tableau.stage_matrix, tableau.squared_stage_matrix)
    ]
    n_stages, stage_node = len(tableau.stage_matrix[0]), jnp.asarray(tableau.stage_nodes)[i]

    def add_stage(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        j, rate_increment, coordinate_increment = state
        a, b = (
            lax.dynamic_index_in_dim(flat_matrix, i * n_stages + j, 0, False)
            for flat_matrix in flat_matrices
        )
        rates = lax.dynamic_index_in_dim(rate_tangents, j, 0, False)[:n]
        return j + 1, rate_increment + a * rates, coordinate_increment + b * rates

    q, v, losses = start_tangent[:n], start_tangent[n : 2 * n], start_tangent[2 * n :]
    initial_state = jnp.zeros((), jnp.int32), jnp.zeros_like(q), jnp.zeros_like(q)
    _, rate_increment, coordinate_increment = lax.while_loop(
        lambda state: state[0] < i, add_stage, initial_state
    )
    stage_q = q + h * (stage_node * v + h * coordinate_increment)
    # The losses do not affect the motion.
    return stage_q, jnp.concatenate([v + h * rate_increment, losses])

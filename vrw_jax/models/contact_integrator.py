"""Integrate wheels with unilateral contact to their next events, by the search of `flow`.

An interval between two events is a phase of `flow.integrate`. Its guards are those of the contact
state, which each element of a batch has for itself, and last a guard that detects Painlevé's
singularity. For higher derivatives and implicit solvers, diffrax takes the solver steps of a single
wheel under the same search.

The *initiating guard* of a contact state is the guard that was zero at the event before this state.
An example is the guard for the normal force on a foot that has just lifted off.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax import lanes
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
from vrw_jax.wheel.outcomes import ContactMode
from vrw_jax.wheel.params import compute_wheel_units

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

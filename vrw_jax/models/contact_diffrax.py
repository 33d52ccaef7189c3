"""Integrate a single wheel between two events with diffrax.

diffrax replaces `batch_integrator` in the event loop of `walk_kernel`. Its event search is
independent of that in `batch_integrator`, so its results are a reference for the batch kernel.
diffrax also provides implicit solvers.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.base.elementwise import select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.flow.phase_integration import GuardsAndMargins, integrate_phase, sample_phase
from vrw_jax.models.contact_integrator import (
    N_ACCUMULATOR_ROWS,
    ContactIntervalPoint,
    ContactIntervalState,
    LaneStatus,
    evaluate_dynamics,
    is_at_painleve_singularity,
    pack_coordinates,
    unpack_motion,
)
from vrw_jax.models.contact_mechanics import WheelMotion, stop_gradients
from vrw_jax.models.contact_state import (
    ContactModeDynamics,
    ContactState,
    EnergyLossAccumulators,
    PackedState,
    compute_forces,
    compute_guard_scales,
    compute_guard_values,
    compute_packed_units,
    evaluate_vector_field,
    pack_state,
    unpack_state,
)
from vrw_jax.wheel.params import compute_wheel_units

ROLLING_INDEX = 2
"""Index of the rolling rate dtheta among the rates of (hub x, hub z, theta, leg lengths)."""


def init_diffrax_contact_interval(
    contact_mode_dynamics: ContactModeDynamics, motion: WheelMotion
) -> ContactIntervalState:
    """Return the state of a single wheel at the start of an interval between events.

    The dynamics rows contain only accelerations. They are infinite, because only the accelerations
    at the end of the interval are used. The fields for the event search of the batch integrator are
    None.
    """
    q, v = pack_coordinates(motion)
    int_zero_lanes = jnp.zeros(motion.x.shape, jnp.int32)
    unused_search_field: Any = None
    return ContactIntervalState(
        contact_interval_point=ContactIntervalPoint(q, v, jnp.full_like(q, jnp.inf)),
        contact_state=contact_mode_dynamics.contact_state,
        guard_values=unused_search_field,
        guard_offset=unused_search_field,
        interval_accumulators=jnp.zeros((N_ACCUMULATOR_ROWS, *motion.x.shape), q.dtype),
        h=unused_search_field,
        time_since_event=jnp.zeros_like(motion.x),
        event_bracket=unused_search_field,
        lane_status=int_zero_lanes + LaneStatus.RUNNING,
        triggered_guard_index=int_zero_lanes,
        n_solver_steps=int_zero_lanes,
    )


def integrate_by_diffrax(
    make_lane_contact_dynamics: Callable[[Array, ContactState], ContactModeDynamics],
    input_columns: Array,
    contact_interval_state: ContactIntervalState,
    options: StepOptions,
) -> ContactIntervalState:
    """Return the state of a running wheel at its next event or failure.

    A state that is not running is returned unchanged. All arrays have a last axis of length 1, the
    batch axis.
    """
    input_columns, contact_interval_state, options = jax.tree.map(
        lambda x: x[..., 0], (input_columns, contact_interval_state, options)
    )
    contact_mode_dynamics = make_lane_contact_dynamics(
        input_columns, contact_interval_state.contact_state
    )._replace(has_accumulators=False)
    is_running = contact_interval_state.lane_status == LaneStatus.RUNNING
    assert contact_interval_state.interval_accumulators is not None
    start_accumulators = EnergyLossAccumulators(
        jnp.zeros_like(contact_interval_state.time_since_event),
        *contact_interval_state.interval_accumulators,
    )
    guard_layout = contact_mode_dynamics.guard_layout
    q, v = contact_interval_state.contact_interval_point[:2]
    start_rows = evaluate_dynamics(*stop_gradients((contact_mode_dynamics, q, v)))
    # As in `init_contact_interval`, a wheel that an event leaves rolling backward continues if it
    # accelerates forward. The guard is then the rise of the rate.
    end_rates, end_acceleration = lax.stop_gradient(v[ROLLING_INDEX]), start_rows[ROLLING_INDEX]
    guard_offset = jnp.zeros(guard_layout.n_guards, q.dtype)
    guard_offset = guard_offset.at[guard_layout.rolling_rate_guard].set(
        jnp.where((end_rates < 0.0) & (end_acceleration > 0.0), end_rates, 0.0)
    )
    end_result = integrate_phase(
        partial(evaluate_vector_field, contact_mode_dynamics),
        GuardsAndMargins(
            lambda packed_state: (
                compute_guard_values(contact_mode_dynamics, packed_state) - guard_offset
            ),
            guard_layout.n_guards,
            guard_scales=compute_guard_scales(contact_mode_dynamics),
        ),
        pack_state(
            unpack_motion(contact_interval_state.contact_interval_point), start_accumulators
        ),
        is_running,
        compute_wheel_units(contact_mode_dynamics.s).scale_times_to_seconds(options),
        compute_packed_units(contact_mode_dynamics.s),
    )
    end_motion, end_accumulators = unpack_state(end_result.state)
    q, v = pack_coordinates(end_motion)
    end_rows = evaluate_dynamics(*stop_gradients((contact_mode_dynamics, q, v)))
    # At the singularity, forces change sign without passing through zero.
    is_singular = is_at_painleve_singularity(start_rows[len(q)], end_rows[len(q)], options)
    failure_outcome = jnp.where(
        end_result.is_timed_out, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED
    )
    lane_status = jnp.where(end_result.end_guard_index >= 0, LaneStatus.EVENT, failure_outcome)
    lane_status = jnp.where(is_singular, Outcome.PAINLEVE_PARADOX, lane_status)
    next_interval_state = contact_interval_state._replace(
        contact_interval_point=ContactIntervalPoint(q, v, end_rows[: len(q)]),
        interval_accumulators=jnp.stack(end_accumulators[1:]),
        time_since_event=end_result.duration,
        lane_status=lane_status.astype(jnp.int32),
        triggered_guard_index=end_result.end_guard_index,
        n_solver_steps=end_result.solver_steps,
    )
    contact_interval_state = select_trees_by_condition(
        is_running, next_interval_state, contact_interval_state
    )
    return jax.tree.map(lambda x: x[..., None], contact_interval_state)


def sample_by_diffrax(
    contact_mode_dynamics: ContactModeDynamics,
    start_state: PackedState,
    duration: Array,
    n_samples: int,
    options: StepOptions,
) -> tuple[Float[Array, "n dim"], Float[Array, "n legs"], Float[Array, "n legs"]]:
    """Return packed states at equally spaced times of an interval, and the forces on all feet.

    The result is (packed states, tangential forces in N, normal forces in N), with the samples on
    the first axis.

    - `duration`: length of the interval, s.
    """

    def compute_foot_forces(packed_state: PackedState) -> tuple[Array, Array]:
        force_solution = compute_forces(
            contact_mode_dynamics, unpack_state(packed_state)[0]
        ).force_solution
        scatter_to_legs = contact_mode_dynamics.contact_slots.scatter_to_legs
        return scatter_to_legs(force_solution.tangential_forces), scatter_to_legs(
            force_solution.normal_forces
        )

    packed_states = sample_phase(
        partial(evaluate_vector_field, contact_mode_dynamics),
        start_state,
        duration,
        n_samples,
        compute_wheel_units(contact_mode_dynamics.s).scale_times_to_seconds(options),
        compute_packed_units(contact_mode_dynamics.s),
    )
    return packed_states, *jax.vmap(compute_foot_forces)(packed_states)

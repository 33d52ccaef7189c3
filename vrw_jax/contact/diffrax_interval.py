"""Integration of a single wheel between two events by diffrax.

diffrax replaces `batch_integrator` in the event loop of `walk_kernel`. Its search for events is
independent, so that it is a reference for the batch kernel. It also has implicit solvers.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.contact.batch_integrator import (
    N_ACCUMULATOR_ROWS,
    N_CONTACT_ROWS,
    IntervalPoint,
    IntervalState,
    LaneStatus,
    evaluate_dynamics,
    is_at_singularity,
    motion_from_point,
    pack_coordinates,
)
from vrw_jax.contact.contact_state import (
    Accumulators,
    ContactState,
    ModeDynamics,
    PackedState,
    compute_forces,
    compute_guard_scales,
    compute_guard_values,
    compute_packed_units,
    make_guard_layout,
    pack_state,
    unpack_state,
    vector_field,
)
from vrw_jax.contact.mechanics import WheelMotion, stop_gradients
from vrw_jax.hybrid import MonitoredFunctions, integrate_in_units, sample_in_units
from vrw_jax.numerics import StepOptions
from vrw_jax.wheel import Outcome, compute_wheel_units

ROLLING_INDEX = 2
"""Index of the rolling rate among the rates (hub x, z, theta, lengths)."""


def init_diffrax_interval(dynamics: ModeDynamics, motion: WheelMotion) -> IntervalState:
    """Return the lane at the start of a contact state.

    The accelerations are infinite, because only those at the end of the interval are used. The
    fields of the batch integrator's search for events are None.
    """
    q, v = pack_coordinates(motion)
    n_rows = len(q) + N_CONTACT_ROWS
    int_zeros = jnp.zeros(motion.x.shape, jnp.int32)
    search_field: Any = None
    return IntervalState(
        point=IntervalPoint(q, v, jnp.full((n_rows, *motion.x.shape), jnp.inf, q.dtype)),
        contact_state=dynamics.contact_state,
        guard_values=search_field,
        guard_offset=search_field,
        interval_accumulators=jnp.zeros((N_ACCUMULATOR_ROWS, *motion.x.shape), q.dtype),
        h=search_field,
        time=jnp.zeros_like(motion.x),
        event_bracket=search_field,
        status=int_zeros + LaneStatus.RUNNING,
        triggered_guard=int_zeros,
        n_solver_steps=int_zeros,
    )


def integrate_by_diffrax(
    make_dynamics: Callable[[Array, ContactState], ModeDynamics],
    input_columns: Array,
    interval: IntervalState,
    options: StepOptions,
) -> IntervalState:
    """Return a running lane at its next event or failure; any other lane is unchanged.

    All arrays have one lane on their last axis.
    """
    input_columns, interval, options = jax.tree.map(
        lambda x: x[..., 0], (input_columns, interval, options)
    )
    dynamics = make_dynamics(input_columns, interval.contact_state)._replace(has_accumulators=False)
    is_running = interval.status == LaneStatus.RUNNING
    assert interval.interval_accumulators is not None
    start_accumulators = Accumulators(
        jnp.zeros_like(interval.time), *interval.interval_accumulators
    )
    layout = make_guard_layout(dynamics.s.n, dynamics.is_one_sided)
    q, v = interval.point[:2]
    start_rows = evaluate_dynamics(*stop_gradients((dynamics, q, v)))
    # As in `init_interval`, a wheel that an event leaves rolling backward continues if it
    # accelerates forward. The guard is then the rise of the rate.
    rate, acceleration = lax.stop_gradient(v[ROLLING_INDEX]), start_rows[ROLLING_INDEX]
    guard_offset = jnp.zeros(layout.n_guards, q.dtype)
    guard_offset = guard_offset.at[layout.rolling_rate].set(
        jnp.where((rate < 0.0) & (acceleration > 0.0), rate, 0.0)
    )
    end = integrate_in_units(
        partial(vector_field, dynamics),
        MonitoredFunctions(
            lambda state: compute_guard_values(dynamics, state) - guard_offset,
            layout.n_guards,
            guard_scales=compute_guard_scales(dynamics),
        ),
        pack_state(motion_from_point(interval.point), start_accumulators),
        is_running,
        options,
        compute_packed_units(dynamics.s),
        compute_wheel_units(dynamics.s).time_unit,
    )
    end_motion, end_accumulators = unpack_state(end.state)
    q, v = pack_coordinates(end_motion)
    end_rows = evaluate_dynamics(*stop_gradients((dynamics, q, v)))
    # At the singularity, forces change sign without passing through zero.
    n_rows = len(q) + N_CONTACT_ROWS
    is_singular = is_at_singularity(start_rows[n_rows - 1], end_rows[n_rows - 1], options)
    failure = jnp.where(end.timed_out, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED)
    status = jnp.where(end.guard >= 0, LaneStatus.EVENT, failure)
    status = jnp.where(is_singular, Outcome.PAINLEVE_PARADOX, status)
    dynamics_rows = jnp.where(is_running, end_rows[:n_rows], interval.point.dynamics_rows)
    interval = interval._replace(
        point=IntervalPoint(q, v, dynamics_rows),
        interval_accumulators=jnp.stack(end_accumulators[1:]),
        time=jnp.where(is_running, end.duration, interval.time),
        status=jnp.where(is_running, status, interval.status).astype(jnp.int32),
        triggered_guard=jnp.where(is_running, end.guard, interval.triggered_guard),
        n_solver_steps=jnp.where(is_running, end.solver_steps, interval.n_solver_steps),
    )
    return jax.tree.map(lambda x: x[..., None], interval)


def sample_by_diffrax(
    dynamics: ModeDynamics,
    start: PackedState,
    duration: Array,
    n_samples: int,
    options: StepOptions,
) -> tuple[Float[Array, "n dim"], Float[Array, "n legs"], Float[Array, "n legs"]]:
    """Return the states of an interval at equal times, and tangential and normal forces on all
    feet, N.

    - `duration`: length of the interval, s.
    """

    def compute_foot_forces(state: PackedState) -> tuple[Array, Array]:
        solution = compute_forces(dynamics, unpack_state(state)[0]).solution
        scatter = dynamics.contact_slots.scatter
        return scatter(solution.tangential), scatter(solution.normal)

    units = compute_packed_units(dynamics.s), compute_wheel_units(dynamics.s).time_unit
    states = sample_in_units(
        partial(vector_field, dynamics), start, duration, n_samples, options, *units
    )
    return states, *jax.vmap(compute_foot_forces)(states)

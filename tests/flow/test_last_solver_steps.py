"""Solver steps to the events of a batch, on oscillators x'' = -k x with events in closed form.

A phase with its own solver step takes these steps, and propagates tangents over them, by a second
pass through the loop of solver steps.
"""

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from vrw_jax.flow import integrate_batch_phase, load_explicit_tableau
from vrw_jax.flow.integrate import (
    Interruption,
    compute_phase_end_jvp,
    integrate_to_event,
    make_idle_state,
)
from vrw_jax.flow.solver_steps import (
    BatchPhase,
    ImplicitDynamics,
    StageAccelerations,
    estimate_step_error,
    take_rk_step,
)
from vrw_jax.flow.tangents import PhaseTangents

TIGHT = vrw.StepOptions(rtol=1e-12, atol=1e-12, max_phase_time=2.0)
TABLEAU = load_explicit_tableau("Dopri8")
STIFFNESS = 1.3


def make_oscillators(stiffness, levels):
    """Return oscillators with their own solver step, which end where x falls to a level."""

    def evaluate_acceleration(q, v):
        return StageAccelerations(jnp.sin(q[0]), jnp.cos(q[0]), (-stiffness * q[0],))

    def take_solver_step(state, h, evaluate_acceleration=evaluate_acceleration):
        stages = take_rk_step(TABLEAU, evaluate_acceleration, state, h)
        errors = jnp.stack(estimate_step_error(TABLEAU, stages, h)) / TIGHT.rtol
        return stages, jnp.mean(jnp.square(errors), 0)

    return BatchPhase(
        evaluate_acceleration,
        lambda state: jnp.stack([state.q[0] - levels[0]]),
        implicit_dynamics=ImplicitDynamics(
            lambda state: (state.acceleration.acceleration[0] + stiffness * state.q[0],),
            lambda _, right_side: right_side,
        ),
        take_solver_step=take_solver_step,
        has_exact_events=True,
    )


def solve(stiffness, level):
    """Return duration, position and rate at the end of a phase that begins at rest at x = 1."""
    frequency = jnp.sqrt(stiffness)
    time_to_event = jnp.arccos(jnp.clip(level, -0.999, 1.0)) / frequency
    duration = jnp.where(level < -1.0, TIGHT.max_phase_time, time_to_event)
    angle = frequency * duration
    return jnp.stack([duration, jnp.cos(angle), -frequency * jnp.sin(angle)])


def test_tangents_at_events_are_those_of_the_closed_form():
    # The second element reaches the time limit. The third is inactive, and the last starts at its
    # event.
    levels, is_active = jnp.array([0.4, -2.0, 0.7, 1.0]), jnp.array([True, True, False, True])

    def integrate(stiffness, levels):
        ones = jnp.ones(4)
        end = integrate_batch_phase(
            make_oscillators, stiffness * ones, (levels,), TABLEAU, (ones,), (0.0 * ones,),
            is_active, 0.01 * ones, TIGHT,
        )  # fmt: skip
        return jnp.stack([end.duration, *end.state.q, *end.state.v]), end

    values, end = jax.jit(integrate)(STIFFNESS, levels)
    derivatives, end_with_tangents = jax.jit(jax.jacfwd(integrate, (0, 1), has_aux=True))(
        STIFFNESS, levels
    )
    np.testing.assert_array_equal(end.end_guard_index, [0, -1, -1, 0])
    np.testing.assert_array_equal(end.is_timed_out, [False, True, False, False])
    for with_tangents, without in zip(
        jax.tree.leaves(end_with_tangents), jax.tree.leaves(end), strict=True
    ):
        np.testing.assert_array_equal(with_tangents, without)
    moving = np.array([0, 1])
    expected = [jax.vmap(jax.jacfwd(solve, i), (None, 0))(STIFFNESS, levels) for i in (0, 1)]
    by_level = np.diagonal(derivatives[1], axis1=1, axis2=2)
    # The tolerance is ten times that of the integration.
    np.testing.assert_allclose(
        values[:, moving].T, jax.vmap(solve, (None, 0))(STIFFNESS, levels)[moving], atol=1e-11
    )
    np.testing.assert_allclose(derivatives[0][:, moving].T, expected[0][moving], atol=1e-11)
    np.testing.assert_allclose(by_level[:, moving].T, expected[1][moving], atol=1e-11)
    np.testing.assert_array_equal(derivatives[0][:, 2:], 0.0)


def test_elements_that_wait_for_arrivals_continue_with_their_tangents():
    # Each call ends after two iterations, or later if no element has then reached its event.
    levels, ones = jnp.array([0.99, 0.95, 0.8, 0.4, -0.1, -0.5]), jnp.ones(6)

    @jax.jit
    def integrate(is_active, q, v, tangents, interrupted_state):
        phase_tangents = PhaseTangents(
            make_oscillators, STIFFNESS * ones, (levels,), jnp.ones((1, 6)), tangents
        )
        phase = make_oscillators(STIFFNESS * ones, (levels,))
        end, search = integrate_to_event(
            phase, phase_tangents, TABLEAU, q, v, is_active, 0.01 * ones, TIGHT,
            interruption=Interruption(2, interrupted_state),
        )  # fmt: skip
        motion_tangents, time_tangent, _ = compute_phase_end_jvp(
            TABLEAU, phase_tangents, end, search
        )
        end_tangents = jnp.concatenate([time_tangent[:, None], motion_tangents], 1)
        return end, end_tangents[0], search.integrator_state

    q, v, tangents = (ones,), (0.0 * ones,), jnp.zeros((1, 3, 6))
    start = make_oscillators(STIFFNESS * ones, (levels,)).make_state(q, v)
    state = make_idle_state(start, (start.q[0] - levels)[None], 0.01 * ones)
    is_active, results, n_calls = ones > 0.0, np.zeros((3, 6)), 0
    while np.any(is_active):
        end, end_tangents, state = integrate(is_active, q, v, tangents, state)
        has_ended = is_active & ~end.is_unfinished
        np.testing.assert_array_equal(end.end_guard_index[has_ended], 0)
        results[:, has_ended] = end_tangents[:, has_ended]
        q, v, tangents = end.state.q, end.state.v, state.state_tangents
        is_active, state = end.is_unfinished, state._replace(state_tangents=None)
        n_calls += 1
    assert n_calls > 2
    expected = jax.vmap(jax.jacfwd(solve), (None, 0))(STIFFNESS, levels)
    # The tolerance is ten times that of the integration.
    np.testing.assert_allclose(results.T, expected, atol=1e-11)

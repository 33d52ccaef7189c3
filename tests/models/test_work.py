"""Work and accuracy of the default options are limited by counts and errors, without a clock."""

import jax
import numpy as np
import pytest
from support import reference_values
from support.batched import compute_states_and_work
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.flow import compute_real_stability_limit, load_explicit_tableau

STARTS = reference_values.stack_quantity("step", "start")
VALUES = np.concatenate(
    [
        reference_values.stack_quantity("step", "section_state"),
        reference_values.stack_quantity("step", "durations"),
    ],
    1,
)
WORK_ALLOWANCE = 1.02
"""Counts are whole numbers, but a step more or less may hang on the last bit of another machine."""
ERROR_ALLOWANCE = 1.5
"""Errors are the sum of a few local ones: one of them moved by such a step moves them that much."""


def diffrax_steps():
    values, tried = compute_states_and_work(
        reference_values.REFERENCE_PARAMETERS, STARTS, vrw.StepOptions(engine="diffrax")
    )
    return np.asarray(values), np.asarray(tried)


def lane_engine_steps():
    batch_result = vrw.step_batch(
        reference_values.make_wheels(reference_values.REFERENCE_PARAMETERS), STARTS, engine="lanes"
    )
    return np.concatenate([batch_result.section_state, batch_result.durations], 1), np.asarray(
        batch_result.solver_steps
    )


@pytest.mark.parametrize(
    ("engine", "steps", "error"),
    [*mark_slow((diffrax_steps, 55.5, 8.5e-12)), (lane_engine_steps, 44.44, 1.4e-11)],
    ids=["diffrax", "lanes"],
)
def test_a_step_needs_no_more_solver_steps_and_is_no_less_accurate_than_recorded(
    engine, steps, error
):
    values, tried = engine()
    assert np.mean(tried) <= WORK_ALLOWANCE * steps
    assert reference_values.compute_scaled_error(values, VALUES) <= ERROR_ALLOWANCE * error


def test_a_limit_cycle_needs_no_more_iterations_and_is_no_less_accurate_than_recorded():
    one = lambda vector: vrw.limit_cycle(reference_values.make_wheel(vector))
    solution = jax.jit(jax.vmap(one))(reference_values.REFERENCE_PARAMETERS)
    error = reference_values.compute_scaled_error(
        solution.durations, reference_values.stack_quantity("cycle", "durations")
    )
    assert np.mean(solution.n_newton_iterations) <= WORK_ALLOWANCE * 4.375
    assert error <= ERROR_ALLOWANCE * 9.1e-12


@pytest.mark.parametrize(
    ("engine", "by", "steps"), [("lanes", "Dopri8", 570), ("auto", "Tsit5", 753)]
)
def test_a_stiff_step_needs_little_more_than_the_solver_steps_of_the_stability_limit(
    engine, by, steps
):
    mass = 0.01  # c/m of 10,000 1/s
    wheel = vrw.WheelParams(leg_mass=mass, damping=100.0, hub_mass=18.0 - 8.0 * mass)
    batch_result = vrw.step_batch(wheel, np.array([[0.1, 1.6, -0.1]]), engine=engine)
    solver = batch_result.solver_names[int(batch_result.solver_index[0])]
    assert solver == by
    # 1.03 c/m is the rate of SLS-I's fast mode; DLS, SLS-II and the start of it take the rest.
    limit = compute_real_stability_limit(load_explicit_tableau(solver))
    requested = 1.03 * 100.0 / mass * float(batch_result.durations[0, 1]) / limit
    assert requested < int(batch_result.solver_steps[0]) <= WORK_ALLOWANCE * steps

"""Work and accuracy of the defaults can't get worse unseen: counts and errors, never a clock."""

import jax
import numpy as np
import pytest
from support import truth
from support.batched import lean_steps

import vrw_jax as vrw
from vrw_jax.numerics.tableaus import explicit_tableau, real_stability_limit

STARTS = truth.table("step", "start")
VALUES = np.concatenate([truth.table("step", "section_state"), truth.table("step", "durations")], 1)
MORE = 1.02
"""Counts are whole numbers, but a step more or less may hang on the last bit of another machine."""
WORSE = 1.5
"""Errors are the sum of a few local ones: one of them moved by such a step moves them that much."""


def by_diffrax():
    values, tried = lean_steps(truth.PARAMETERS, STARTS, vrw.Options(engine="diffrax"))
    return np.asarray(values), np.asarray(tried)


def by_lanes():
    found = vrw.steps(truth.wheels(truth.PARAMETERS), STARTS, engine="lanes")
    return np.concatenate([found.section_state, found.durations], 1), np.asarray(found.solver_steps)


@pytest.mark.parametrize(
    ("engine", "steps", "error"),
    [(by_diffrax, 55.5, 8.5e-12), (by_lanes, 44.44, 1.4e-11)],
    ids=["diffrax", "lanes"],
)
def test_a_step_takes_no_more_solver_steps_and_errs_no_more_than_it_did(engine, steps, error):
    values, tried = engine()
    assert np.mean(tried) <= MORE * steps
    assert truth.scaled_error(values, VALUES) <= WORSE * error


def test_a_limit_cycle_takes_no_more_passes_and_errs_no_more_than_it_did():
    one = lambda vector: vrw.limit_cycle(truth.wheel(vector))
    found = jax.jit(jax.vmap(one))(truth.PARAMETERS)
    error = truth.scaled_error(found.durations, truth.table("cycle", "durations"))
    assert np.mean(found.passes) <= MORE * 4.375
    assert error <= WORSE * 9.1e-12


@pytest.mark.parametrize(
    ("engine", "by", "steps"), [("lanes", "Dopri8", 570), ("auto", "Tsit5", 753)]
)
def test_a_stiff_step_takes_what_stability_asks_for_and_little_more(engine, by, steps):
    mass = 0.01  # c/m of 10,000 1/s
    wheel = vrw.WheelParams(leg_mass=mass, damping=100.0, hub_mass=18.0 - 8.0 * mass)
    found = vrw.steps(wheel, np.array([[0.1, 1.6, -0.1]]), engine=engine)
    solver = found.solvers[int(found.solver[0])]
    assert solver == by
    # 1.03 c/m is the rate of SLS-I's fast mode; DLS, SLS-II and the start of it take the rest.
    limit = real_stability_limit(explicit_tableau(solver))
    asked = 1.03 * 100.0 / mass * float(found.durations[0, 1]) / limit
    assert asked < int(found.solver_steps[0]) <= MORE * steps

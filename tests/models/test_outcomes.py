"""Every end of a step has a code and a wheel that causes it, and does not change other lanes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference_values
from support.batched import (
    OUTCOME_CASES,
    TABLE_1_SECTION_STATE,
    TABLE_1_VALUES,
    TIME_LIMIT_CASES,
    compute_full_steps,
    compute_jacobians,
    compute_states_and_work,
    make_parameter_rows,
)
from support.slow_variants import ENGINES, mark_slow

import vrw_jax as vrw
from vrw_jax import Outcome


@pytest.mark.parametrize("by_lanes", [*mark_slow(False), True], ids=["diffrax", "lanes"])
@pytest.mark.parametrize("outcome", OUTCOME_CASES, ids=lambda o: o.name)
def test_each_outcome_occurs(outcome, by_lanes):
    parameter_rows, start = OUTCOME_CASES[outcome]
    result = compute_full_steps(parameter_rows, start, uses_lane_engine=by_lanes)
    assert Outcome(int(result.outcome[0])) is outcome


def test_no_touchdown_in_time_is_a_code():
    longest = float(
        np.max(compute_full_steps(make_parameter_rows(), TABLE_1_SECTION_STATE).durations)
    )
    for share, outcome in TIME_LIMIT_CASES:  # within one solver step of the phase's end
        result = compute_full_steps(
            make_parameter_rows(),
            TABLE_1_SECTION_STATE,
            vrw.StepOptions(max_phase_time=share * longest),
        )
        assert int(result.outcome[0]) == outcome


def test_a_solver_that_runs_out_of_steps_is_a_code():
    stiff = vrw.WheelParams(damping=1e8)  # explicit steps of nanoseconds
    result = vrw.step(stiff, TABLE_1_SECTION_STATE)
    assert int(result.outcome) == Outcome.SOLVER_FAILED
    assert int(result.solver_steps) >= vrw.StepOptions().max_solver_steps


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", [None, vrw.UnilateralWheel()], ids=lambda m: type(m).__name__)
def test_a_step_without_touchdown_ends_at_the_time_limit(model, engine):
    options = vrw.StepOptions(max_phase_time=0.15, engine=engine)
    result = vrw.step(vrw.WheelParams(), vrw.paper_start(), model=model, options=options)
    assert int(result.outcome) == Outcome.NO_TOUCHDOWN_IN_TIME
    assert float(result.durations[0]) == pytest.approx(0.15, abs=1e-15)


N_RESTING = 64
"""Random wheels on gentle slopes, some of which come to rest."""


def draw_wheels_on_gentle_slopes():
    draw = np.random.default_rng(1).uniform
    box = {
        "damping": (400.0, 2000.0), "stiffness": (900.0, 1500.0), "natural_length": (0.95, 1.05),
        "slope": (0.06, 0.11), "leg_mass": (0.2, 2.0),
    }  # fmt: skip
    params = vrw.WheelParams(**{name: draw(*ends, N_RESTING) for name, ends in box.items()})
    limits = (0.0, 0.3), (0.4, 1.2), (-1.0, 0.0)
    return params, np.stack([draw(*ends, N_RESTING) for ends in limits], 1)


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-10])
def test_a_wheel_at_rest_has_the_same_outcome_from_every_engine(tolerance):
    params, starts = draw_wheels_on_gentle_slopes()
    options = vrw.StepOptions(rtol=tolerance, atol=tolerance)
    lanes, diffrax = (
        np.asarray(vrw.step_batch(params, starts, options=options, engine=engine).outcome)
        for engine in ("lanes", "diffrax")
    )
    np.testing.assert_array_equal(lanes, diffrax)
    assert np.sum(lanes == Outcome.CAME_TO_REST) >= 5
    assert not np.any(lanes == Outcome.SOLVER_FAILED)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_wheel_comes_to_rest_where_the_ground_carries_its_weight(engine):
    """Reference: statics, the sum of both feet's forces against gravity in the slope's frame."""
    parameter_rows, start = OUTCOME_CASES[Outcome.CAME_TO_REST]
    params = reference_values.make_wheel(parameter_rows[0])
    options = vrw.StepOptions(engine=engine)
    trace = vrw.ViscoelasticWheel().sample_step(params, jnp.asarray(start), options, 2)
    tangential, normal = np.asarray(trace.forces)[0, -1].reshape(2, 2).sum(0)
    weight = 9.81 * (10.0 + 8.0 * 0.53)
    assert tangential == pytest.approx(-weight * np.sin(0.1), rel=1e-6)
    assert normal == pytest.approx(weight * np.cos(0.1), rel=1e-6)


@pytest.mark.slow
def test_wheels_with_unilateral_contact_come_to_rest_alike_by_both_engines():
    """A foot's slide and the rolling may end together; rounding must not decide the outcome."""
    params, starts = draw_wheels_on_gentle_slopes()
    ground, options = vrw.UnilateralWheel(friction=0.7), vrw.StepOptions(engine="diffrax")
    lanes = np.asarray(vrw.step_batch(params, starts, 8, model=ground).outcome)
    walk_one = lambda p, x: vrw.walk(p, x, 8, model=ground, options=options).outcome
    diffrax = jax.jit(jax.vmap(walk_one, (params.in_axes, 0)))(params, jnp.asarray(starts))
    np.testing.assert_array_equal(lanes, diffrax)
    assert np.sum(lanes == Outcome.CAME_TO_REST) > 5


@pytest.mark.parametrize(
    "start", [[np.nan, 1.6, -0.1], [0.1, np.inf, -0.1], [0.1, -1.0, -0.1], [2.0, 1.0, 0.0]], ids=str
)
def test_a_start_that_is_no_section_state_is_bad_input(start):
    assert int(compute_full_steps(make_parameter_rows(), start).outcome[0]) == Outcome.BAD_INPUT


def test_every_outcome_has_a_name_and_one_sentence():
    for outcome in Outcome:
        assert outcome.meaning.endswith(".")
        assert outcome.meaning.count(".") == 1


def test_failing_batch_elements_do_not_change_the_others():
    bad = [parameter_rows[0] for parameter_rows, _ in OUTCOME_CASES.values()]
    starts = [np.asarray(start) for _, start in OUTCOME_CASES.values()]
    among = compute_full_steps(np.stack(bad), np.stack(starts))
    single_step = compute_full_steps(make_parameter_rows(), TABLE_1_SECTION_STATE)
    for mixed, single in zip(jax.tree.leaves(among), jax.tree.leaves(single_step), strict=True):
        # A vmapped loop may fuse differently: round-off, a few 1e-14 relative.
        np.testing.assert_allclose(mixed[0], single[0], rtol=5e-14, atol=5e-14)


def test_failing_batch_elements_have_finite_values_and_derivatives():
    parameter_rows = jnp.asarray(np.stack([v[0] for v, _ in OUTCOME_CASES.values()]))
    starts = jnp.asarray(np.stack([np.asarray(x) for _, x in OUTCOME_CASES.values()]))
    pad = 16 - len(OUTCOME_CASES)
    parameter_rows = jnp.concatenate([parameter_rows, jnp.tile(TABLE_1_VALUES, (pad, 1))])
    starts = jnp.concatenate([starts, jnp.tile(TABLE_1_SECTION_STATE, (pad, 1))])
    result = compute_full_steps(parameter_rows, starts)
    # The friction that collision II requires is infinite where the ground would have to pull.
    stopper_friction = result.required_friction.stopper
    assert not np.any(np.isnan(stopper_friction))
    others = eqx.tree_at(lambda step: step.required_friction.stopper, result, result.step_length)
    for leaf in jax.tree.leaves(others):
        assert np.all(np.isfinite(leaf))
    by_parameter, by_start = compute_jacobians(parameter_rows, starts, vrw.StepOptions())
    assert np.all(np.isfinite(by_parameter))
    assert np.all(np.isfinite(by_start))
    clean, _ = compute_jacobians(
        jnp.tile(TABLE_1_VALUES, (16, 1)),
        jnp.tile(TABLE_1_SECTION_STATE, (16, 1)),
        vrw.StepOptions(),
    )
    np.testing.assert_allclose(by_parameter[0], clean[0], rtol=1e-12, atol=1e-12)


def test_a_failed_step_returns_zeros_instead_of_a_section_state():
    parameter_rows, start = OUTCOME_CASES[Outcome.FELL_BACK]
    result = compute_full_steps(parameter_rows, start)
    assert np.all(np.asarray(result.section_state) == 0.0)


def test_a_walk_stops_at_its_first_failure():
    walk = vrw.walk(vrw.WheelParams(slope=0.09, damping=100.0), [0.1027, 2.0, -0.109], 12)
    assert int(walk.outcome) == Outcome.FELL_BACK
    step_result = int(walk.n_stepped)
    assert 0 < step_result < 12
    outcomes = np.asarray(walk.steps.outcome)
    assert np.all(outcomes[:step_result] == Outcome.STEPPED)
    assert np.all(outcomes[step_result:] == Outcome.FELL_BACK)


def test_a_batch_element_equals_the_single_run():
    starts = reference_values.stack_quantity("step", "start")
    batch, _ = compute_states_and_work(
        reference_values.REFERENCE_PARAMETERS, starts, vrw.StepOptions()
    )
    for index in (0, 3, 9):
        params = reference_values.make_wheel(reference_values.REFERENCE_PARAMETERS[index])
        single = vrw.return_map(params, starts[index])
        np.testing.assert_allclose(batch[index, :3], single, rtol=5e-14, atol=5e-14)

"""The machine-code and the diffrax engine agree on one step, in values and derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.models import step_batch
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES, make_wheel_from_parameters

N = 40
ALL_INPUT_NAMES = ("section_state", *PARAMETER_NAMES)
START = (0.1, 1.6, -0.1)
MAX_PHASE_TIME_SECONDS = 5.0
"""s of a phase: all lanes of a batch by diffrax wait for the one that falls last."""
TIGHT_OPTIONS = vrw.StepOptions(rtol=1e-13, atol=1e-13, max_phase_time=MAX_PHASE_TIME_SECONDS)


def draw_box(n, seed):
    """Return wheels and starts of a wide box: many step, and some fall in every way."""
    random = np.random.default_rng(seed)
    table = {
        name: np.full(n, float(getattr(vrw.WheelParams(), name))) for name in PARAMETER_DOMAINS
    }
    table["damping"] = random.uniform(5.0, 400.0, n)
    table["stiffness"] = random.uniform(200.0, 1200.0, n)
    table["natural_length"] = random.uniform(1.0, 1.06, n)
    table["slope"] = random.uniform(0.05, 0.45, n)
    table["leg_mass"] = random.uniform(0.3, 2.0, n)
    states = random.uniform((-0.05, 0.8, -0.4), (0.2, 2.4, 0.1), (n, 3))
    return vrw.WheelParams(**table), states


def flatten_derivatives(by_input):
    """Return the derivatives of state and durations by all inputs, (lanes, 6, 12)."""
    columns = [
        np.concatenate([by_input[name].section_state, by_input[name].durations], 1).reshape(
            len(by_input[name].durations), 6, -1
        )
        for name in ALL_INPUT_NAMES
    ]
    return np.concatenate(columns, -1)


@pytest.fixture(scope="module")
def results_of_both_engines():
    params, states = draw_box(N, 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_batch, "DIFFRAX_BATCH_SIZE", N)  # without padding
        lanes, diffrax = (
            vrw.step_batch(
                params, states, options=TIGHT_OPTIONS, engine=engine, derivatives=ALL_INPUT_NAMES
            )
            for engine in ("lanes", "diffrax")
        )
    return lanes, diffrax


def test_a_batch_by_diffrax_without_elements_has_results_of_the_usual_shapes(
    results_of_both_engines, monkeypatch
):
    monkeypatch.setattr(step_batch, "DIFFRAX_BATCH_SIZE", N)
    _, full = results_of_both_engines
    for names, expected in (ALL_INPUT_NAMES, full), ((), dataclasses.replace(full, derivatives={})):
        empty = vrw.step_batch(
            vrw.WheelParams(), np.empty((0, 3)), options=TIGHT_OPTIONS, engine="diffrax",
            derivatives=names,
        )  # fmt: skip
        assert empty.section_state.shape == (0, 3)
        shapes = [[x.shape[1:] for x in jax.tree.leaves(y)] for y in (empty, expected)]
        assert shapes[0] == shapes[1]
        assert len(empty.durations) == 0


def test_model_and_solver_choose_the_engine_and_the_result_names_it(results_of_both_engines):
    assert [result.engine for result in results_of_both_engines] == ["lanes", "diffrax"]
    params, starts = vrw.WheelParams(), np.array([START])
    assert vrw.step_batch(params, starts).engine == "lanes"
    rigid_start = np.array([[0.39, 1.2, 0.0]])
    assert vrw.step_batch(params, rigid_start, model=vrw.RigidWheel()).engine == "diffrax"
    with pytest.raises(ValueError, match="explicit"):
        vrw.step_batch(params, starts, options=vrw.StepOptions(solver="Kvaerno5"), engine="lanes")


def test_engines_agree_on_outcomes_and_values(results_of_both_engines):
    lanes, diffrax = results_of_both_engines
    assert len(set(np.asarray(lanes.outcome))) >= 4  # the box is wide
    # A wheel that comes to rest upright doubles its rounding every 0.2 s: it may fall either way.
    balances = np.asarray(diffrax.durations)[:, 0] >= MAX_PHASE_TIME_SECONDS
    assert np.sum(balances) <= 4
    np.testing.assert_array_equal(lanes.outcome[~balances], diffrax.outcome[~balances])
    # Each errs by some 1e-12 at these tolerances, more where the state grows along the step.
    for name in ("section_state", "durations"):
        by_lanes, by_diffrax = (
            np.asarray(getattr(x, name))[~balances] for x in results_of_both_engines
        )
        np.testing.assert_allclose(by_lanes, by_diffrax, atol=2e-11)


def test_engines_agree_on_derivatives_by_start_and_every_parameter(results_of_both_engines):
    lanes, diffrax = (
        flatten_derivatives(batch_result.derivatives) for batch_result in results_of_both_engines
    )
    scale = 1.0 + np.max(np.abs(diffrax), axis=(1, 2), keepdims=True)
    assert np.max(np.abs(lanes - diffrax) / scale) < 1e-9
    assert np.mean(scale > 2.0) > 0.2  # there is something to compare


def test_a_falling_batch_element_has_an_outcome_and_zero_derivatives(results_of_both_engines):
    lanes, _ = results_of_both_engines
    fell = np.asarray(lanes.outcome) != vrw.Outcome.STEPPED
    assert fell.any()
    assert not fell.all()
    by_input = flatten_derivatives(lanes.derivatives)
    assert np.isfinite(by_input).all()
    assert not by_input[fell].any()


def test_derivatives_of_a_batch_element_do_not_depend_on_the_other_elements(
    results_of_both_engines,
):
    params, states = draw_box(N, 0)
    rows = np.stack([np.asarray(getattr(params, name)) for name in PARAMETER_NAMES])
    selection = np.random.default_rng(2).permutation(N)[:11]
    wheels = make_wheel_from_parameters(jnp.asarray(rows[:, selection]), 8)
    part = vrw.step_batch(
        wheels, states[selection], options=TIGHT_OPTIONS, derivatives=ALL_INPUT_NAMES
    )
    for a, b in zip(
        jax.tree.leaves(part), jax.tree.leaves(results_of_both_engines[0]), strict=True
    ):
        np.testing.assert_array_equal(a, np.asarray(b)[selection])


def test_derivatives_of_several_steps_agree_with_the_walk():
    states = np.array([START])
    batch_result = vrw.step_batch(vrw.WheelParams(), states, 3, derivatives=ALL_INPUT_NAMES)

    def last(params, x):
        walk = vrw.walk(params, x, 3)
        return walk.steps.section_state[-1], walk.steps.durations[-1]

    both = jax.jacfwd(last, argnums=(0, 1))(vrw.WheelParams(), states[0])
    for name in ALL_INPUT_NAMES:
        wanted = [
            by_input[1] if name == "section_state" else getattr(by_input[0], name)
            for by_input in both
        ]
        by_input = batch_result.derivatives[name]
        np.testing.assert_allclose(by_input.section_state[0], wanted[0], atol=1e-9)
        np.testing.assert_allclose(by_input.durations[0], wanted[1], atol=1e-9)


@pytest.mark.slow
def test_the_result_names_its_engine():
    params, x = vrw.WheelParams(), jnp.asarray(START)
    assert vrw.step(params, x).engine == "lanes"
    assert vrw.walk(params, x, 1).steps.engine == "lanes"
    # Told while the program is made, by what makes it: none of these needs to run.
    would = lambda **how: jax.eval_shape(lambda x: vrw.step(params, x, **how), x).engine
    assert would() == "lanes"
    assert would(engine="diffrax") == "diffrax"
    assert would(options=vrw.StepOptions(solver="Kvaerno5")) == "diffrax"


@pytest.mark.skipif(not lanes.is_machine_code_available(), reason="machine code is for CPUs")
def test_a_jacobian_within_jit_compiles_only_its_own_machine_code(monkeypatch):
    class AskedError(Exception):
        pass

    def get_lane_program(function, *rest):
        raise AskedError(function.args[0].__qualname__)

    monkeypatch.setattr("vrw_jax.lanes.lane_function.get_lane_program", get_lane_program)
    unknown = vrw.StepOptions(max_solver_steps=12_345)  # nothing is traced for it yet
    state = lambda x: vrw.step(vrw.WheelParams(), x, options=unknown).section_state
    with pytest.raises(AskedError, match="_make_column_function"):
        jax.jit(jax.jacfwd(state)).lower(jnp.asarray(START))


def test_unsupported_uses_of_the_batch_engine_are_refused_in_one_sentence():
    implicit = vrw.StepOptions(solver="Kvaerno5")
    with pytest.raises(ValueError, match="take engine='diffrax'"):
        vrw.step(vrw.WheelParams(), START, engine="lanes", options=implicit)


@pytest.mark.parametrize("names", [("speed",), "c", ("section_state", "friction")])
def test_derivatives_by_inputs_without_effect_are_refused_in_one_sentence(names):
    with pytest.raises(ValueError, match="a step depends on section_state, hub_mass"):
        vrw.step_batch(vrw.WheelParams(), np.array([START]), derivatives=names)

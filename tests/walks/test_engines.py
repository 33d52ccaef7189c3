"""One step, two engines: machine code and diffrax tell the same, values and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax import simd
from vrw_jax.batches import batch
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES, wheel_of

N = 96
ALL = ("section_state", *PARAMETER_NAMES)
START = (0.1, 1.6, -0.1)
LONGEST = 5.0
"""s of a phase: all lanes of a batch by diffrax wait for the one that falls last."""
TIGHT = vrw.Options(rtol=1e-13, atol=1e-13, max_phase_time=LONGEST)


def box(n, seed):
    """Wheels and starts of a wide box: many step, some fall in every way."""
    random = np.random.default_rng(seed)
    table = {name: np.full(n, float(getattr(vrw.WheelParams(), name))) for name in DOMAINS}
    table["damping"] = random.uniform(5.0, 400.0, n)
    table["stiffness"] = random.uniform(200.0, 1200.0, n)
    table["natural_length"] = random.uniform(1.0, 1.06, n)
    table["slope"] = random.uniform(0.05, 0.45, n)
    table["leg_mass"] = random.uniform(0.3, 2.0, n)
    states = random.uniform((-0.05, 0.8, -0.4), (0.2, 2.4, 0.1), (n, 3))
    return vrw.WheelParams(**table), states


def flat(by):
    """Derivatives of state and durations by everything, (lanes, 6, 12)."""
    columns = [
        np.concatenate([by[name].section_state, by[name].durations], 1).reshape(
            len(by[name].durations), 6, -1
        )
        for name in ALL
    ]
    return np.concatenate(columns, -1)


@pytest.fixture(scope="module")
def both():
    params, states = box(N, 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "MAPPED", N)  # not filled up to more
        lanes, diffrax = (
            vrw.steps(params, states, options=TIGHT, engine=engine, derivatives=ALL)
            for engine in ("lanes", "diffrax")
        )
    return lanes, diffrax


def test_outcomes_and_values_are_the_same(both):
    lanes, diffrax = both
    assert len(set(np.asarray(lanes.outcome))) >= 4  # the box is wide
    # A wheel that comes to rest upright doubles its rounding every 0.2 s: it may fall either way.
    balances = np.asarray(diffrax.durations)[:, 0] >= LONGEST
    assert np.sum(balances) <= 4
    np.testing.assert_array_equal(lanes.outcome[~balances], diffrax.outcome[~balances])
    # Each errs by some 1e-12 at these tolerances, more where the state grows along the step.
    for name in ("section_state", "durations"):
        by_lanes, by_diffrax = (np.asarray(getattr(x, name))[~balances] for x in both)
        np.testing.assert_allclose(by_lanes, by_diffrax, atol=2e-11)


def test_derivatives_by_start_and_every_parameter_are_the_same(both):
    lanes, diffrax = (flat(found.derivatives) for found in both)
    scale = 1.0 + np.max(np.abs(diffrax), axis=(1, 2), keepdims=True)
    assert np.max(np.abs(lanes - diffrax) / scale) < 1e-9
    assert np.mean(scale > 2.0) > 0.2  # there is something to compare


def test_a_lane_that_falls_has_a_code_and_derivatives_that_are_zero(both):
    lanes, _ = both
    fell = np.asarray(lanes.outcome) != vrw.Outcome.STEPPED
    assert fell.any()
    assert not fell.all()
    by = flat(lanes.derivatives)
    assert np.isfinite(by).all()
    assert not by[fell].any()


def test_derivatives_of_a_lane_are_bitwise_its_own_in_any_company(both):
    params, states = box(N, 0)
    rows = np.stack([np.asarray(getattr(params, name)) for name in PARAMETER_NAMES])
    some = np.random.default_rng(2).permutation(N)[:11]
    wheels = wheel_of(jnp.asarray(rows[:, some]), 8)
    part = vrw.steps(wheels, states[some], options=TIGHT, derivatives=ALL)
    for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(both[0]), strict=True):
        np.testing.assert_array_equal(a, np.asarray(b)[some])


def test_derivatives_of_several_steps_are_those_of_the_walk():
    states = np.array([START])
    found = vrw.steps(vrw.WheelParams(), states, 3, derivatives=ALL)

    def last(params, x):
        walked = vrw.walk(params, x, 3)
        return walked.steps.section_state[-1], walked.steps.durations[-1]

    both = jax.jacfwd(last, argnums=(0, 1))(vrw.WheelParams(), states[0])
    for name in ALL:
        wanted = [by[1] if name == "section_state" else getattr(by[0], name) for by in both]
        by = found.derivatives[name]
        np.testing.assert_allclose(by.section_state[0], wanted[0], atol=1e-9)
        np.testing.assert_allclose(by.durations[0], wanted[1], atol=1e-9)


def test_the_result_names_its_engine():
    params, x = vrw.WheelParams(), jnp.asarray(START)
    assert vrw.step(params, x).engine == "lanes"
    assert vrw.walk(params, x, 1).steps.engine == "lanes"
    # Told while the program is made, by what makes it: none of these needs to run.
    would = lambda **how: jax.eval_shape(lambda x: vrw.step(params, x, **how), x).engine
    assert would() == "lanes"
    assert would(engine="diffrax") == "diffrax"
    assert would(options=vrw.Options(solver="Kvaerno5")) == "diffrax"


@pytest.mark.skipif(not simd.serves(), reason="machine code is for CPUs")
def test_a_jacobian_within_jit_asks_for_its_own_machine_code_alone(monkeypatch):
    class AskedError(Exception):
        pass

    def code_of(function, shapes, key, *rest):
        raise AskedError(repr(key))

    monkeypatch.setattr("vrw_jax.simd.program.code_of", code_of)
    unknown = vrw.Options(max_solver_steps=12_345)  # nothing is traced for it yet
    state = lambda x: vrw.step(vrw.WheelParams(), x, options=unknown).section_state
    with pytest.raises(AskedError, match="gait step with derivatives"):
        jax.jit(jax.jacfwd(state)).lower(jnp.asarray(START))


def test_lanes_that_cannot_are_refused_in_one_sentence():
    implicit = vrw.Options(solver="Kvaerno5")
    with pytest.raises(ValueError, match="take engine='diffrax'"):
        vrw.step(vrw.WheelParams(), START, engine="lanes", options=implicit)


@pytest.mark.parametrize("names", [("speed",), "c", ("section_state", "friction")])
def test_derivatives_by_what_does_not_move_a_step_are_one_sentence(names):
    with pytest.raises(ValueError, match="a step moves with one of section_state, hub_mass"):
        vrw.steps(vrw.WheelParams(), np.array([START]), derivatives=names)

"""Steps of a wheel with a motor on its hub, against a five-coordinate code."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import five_coordinates
from support.machine_code import CodeRegistrySpy
from support.slow_variants import mark_slow

import vrw_jax as vrw

PARAMS = vrw.WheelParams(damping=150.0, slope=0.2)
START = np.array([0.1, 1.6, -0.1])
REFERENCE_PARAMS = five_coordinates.TABLE_1 | {"damping": 150.0, "slope": 0.2}


class DirectCurrentMotor(eqx.Module):
    """Torque that falls with the rate."""

    stall: float = vrw.parameter(30.0, unit="N m", symbol="tau_s")
    idle_rate: float = vrw.parameter(6.0, unit="rad/s", domain=(0.1, 1e3))

    def __call__(self, dtheta, params):
        return self.stall * (1.0 - dtheta / self.idle_rate)


def make_wheel(torque):
    return vrw.ViscoelasticWheel(hub_torque=torque)


def advance(torque, params=PARAMS):
    return vrw.return_map(params, START, model=make_wheel(torque))


@pytest.mark.parametrize("engine", ["lanes", *mark_slow("diffrax")])
@pytest.mark.parametrize("torque", [20.0, DirectCurrentMotor()], ids=["constant", "rate"])
def test_a_step_agrees_with_five_coordinates(torque, engine):
    step = vrw.step(
        PARAMS, START, model=make_wheel(torque), options=vrw.StepOptions.tight(), engine=engine
    )
    law = (lambda rate: torque(rate, None)) if callable(torque) else lambda rate: torque
    params = REFERENCE_PARAMS | {"hub_torque": law}
    reference = five_coordinates.step(params, START)
    np.testing.assert_allclose(step.section_state, reference["section_state"], atol=1e-11)
    np.testing.assert_allclose(step.durations, reference["durations"], atol=1e-11)
    margins = five_coordinates.step_margins(params, START)
    assert abs(step.margins.fore_foot_force - min(margins["lambda2"].values())) < 1e-8
    np.testing.assert_allclose(
        step.margins.locked_stopper_force, margins["stopper_force_legs"], atol=1e-8
    )
    if not callable(torque):  # The reference integrates the power of the dampers.
        assert abs(step.energy.damping - reference["energy_lost_damping"]) < 1e-9


def test_a_motor_without_torque_changes_nothing():
    expected, step = (
        vrw.step(PARAMS, START),
        vrw.step(PARAMS, START, model=make_wheel(0.0)),
    )
    for value, expected_value in zip(jax.tree.leaves(step), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(value, expected_value, rtol=1e-11, atol=1e-12)


def test_derivatives_by_the_torque_are_those_of_five_coordinates():
    def advance_reference(torque):
        return five_coordinates.return_map(
            REFERENCE_PARAMS | {"hub_torque": lambda rate: torque[0]}, START
        )

    expected = five_coordinates.jacobian(advance_reference, np.array([20.0]))[:, 0]
    np.testing.assert_allclose(jax.jacfwd(advance)(20.0), expected, rtol=1e-7, atol=1e-11)
    np.testing.assert_allclose(jax.jacrev(advance)(20.0), expected, rtol=1e-7, atol=1e-11)
    batch = vrw.step_batch(PARAMS, START[None], model=make_wheel(20.0), derivatives=["hub.torque"])
    jacobian = batch.derivatives["hub.torque"].section_state[0]
    np.testing.assert_allclose(jacobian, expected, rtol=1e-7, atol=1e-11)


def test_a_batch_has_a_torque_for_each_wheel_and_the_bits_of_each_alone():
    torques = np.array([0.0, 20.0, np.nan, 10.0])
    states = np.tile(START, (4, 1))
    batch = vrw.step_batch(PARAMS, states, 3, model=make_wheel(torques))
    assert batch.engine == "lanes"
    assert [vrw.Outcome(x).name for x in batch.outcome] == ["STEPPED"] * 2 + ["BAD_INPUT"] + [
        "STEPPED"
    ]
    for index in (0, 1, 3):
        alone = vrw.step_batch(PARAMS, states[:1], 3, model=make_wheel(torques[index]))
        np.testing.assert_array_equal(alone.section_state[0], batch.section_state[index])
    walk = vrw.walk(PARAMS, START, 3, model=make_wheel(20.0))
    np.testing.assert_allclose(walk.steps.section_state[-1], batch.section_state[1], atol=1e-10)


def test_another_torque_compiles_nothing(monkeypatch):
    spy = CodeRegistrySpy(monkeypatch)
    advance(20.0)
    n_traces = spy.n_traces
    advance(21.0)
    assert spy.n_traces == n_traces


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        (np.nan, r"hub.torque is nan, but torque on the hub must lie in"),
        ("strong", "hub.torque is 'strong'"),
        (DirectCurrentMotor, "give a function f\\(dtheta, params\\) that returns N m"),
        (lambda dtheta, p: jnp.sum(dtheta), "hub_torque returns .* acts element by element"),
    ],
)
def test_what_is_no_torque_is_refused_in_one_sentence(torque, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make_wheel(torque)


def test_models_without_a_motor_refuse_a_torque():
    with pytest.raises(TypeError, match="a RigidWheel has no law of its own for the hub"):
        vrw.RigidWheel(hub_torque=1.0)

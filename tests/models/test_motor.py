"""Steps of a wheel with a motor on its hub, against a five-coordinate code."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import five_coordinates
from support.machine_code import CodeRegistrySpy
from support.slow_variants import ENGINES

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


class SwingMotor(eqx.Module):
    """Torque that is largest where Leg 1 stands upright, and falls with the rate."""

    peak: float = vrw.parameter(30.0, unit="N m")
    brake: float = 2.0

    def __call__(self, theta, dtheta, params):
        return self.peak * jnp.cos(3.0 * theta) - self.brake * dtheta


def make_wheel(torque):
    return vrw.ViscoelasticWheel(hub_torque=torque)


def advance(torque, params=PARAMS):
    return vrw.return_map(params, START, model=make_wheel(torque))


@pytest.mark.parametrize("engine", ENGINES)
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


def test_a_torque_of_angle_and_rate_agrees_with_five_coordinates():
    def make_params(peak):
        law = lambda theta, rate: peak * np.cos(3.0 * theta) - 2.0 * rate
        return REFERENCE_PARAMS | {"angle_torque": law}

    options = vrw.StepOptions.tight()
    step = vrw.step(PARAMS, START, model=make_wheel(SwingMotor()), options=options)
    reference = five_coordinates.step(make_params(30.0), START)
    np.testing.assert_allclose(step.section_state, reference["section_state"], atol=1e-11)
    np.testing.assert_allclose(step.durations, reference["durations"], atol=1e-11)
    advance_reference = lambda peak: five_coordinates.return_map(make_params(peak[0]), START)
    expected = five_coordinates.jacobian(advance_reference, np.array([30.0]))[:, 0]
    derivative = jax.jacfwd(lambda peak: advance(SwingMotor(peak)))(30.0)
    np.testing.assert_allclose(derivative, expected, rtol=1e-7, atol=1e-11)


def test_the_work_of_a_torque_of_the_angle_is_in_the_energy_of_damping():
    """The reference is the torque, integrated over the angle, and the power of the dampers."""
    torque = SwingMotor(30.0, 0.0)
    step = vrw.step(PARAMS, START, model=make_wheel(torque))
    walk = vrw.simulate(PARAMS, START, 1, model=make_wheel(torque), n_samples=2001)
    integrate = lambda theta: 10.0 * np.sin(3.0 * theta)
    work = integrate(step.section_state[0]) - integrate(step.post_impact[0])
    dissipated = np.trapezoid(walk.damping_power, walk.time)
    assert abs(float(step.energy.damping) - (dissipated - float(work))) < 1e-4


def test_a_torque_with_further_arguments_that_have_defaults_depends_on_the_rate():
    expected = advance(lambda dtheta, params: 10.0 - dtheta)
    for torque in (
        lambda dtheta, params, stall=10.0: stall - dtheta,
        functools.partial(lambda dtheta, params, stall: stall - dtheta, stall=10.0),
    ):
        np.testing.assert_array_equal(advance(torque), expected)


def test_unilateral_contact_refuses_a_torque_of_the_angle():
    with pytest.raises(ValueError, match="hub_torque depends on the angle"):
        vrw.UnilateralWheel(hub_torque=SwingMotor())


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

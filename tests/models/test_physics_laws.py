"""Steps across the box obey the physical laws that every simulation of this wheel must obey."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import reference_values
from support.batched import NAMES, compute_full_steps, compute_states_and_work
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.wheel import Motion, compute_rear_foot_height, dynamics, make_paper_phases, transitions

STARTS = reference_values.stack_quantity("step", "start")


@pytest.fixture(scope="module", params=[*mark_slow(False), True], ids=["diffrax", "lanes"])
def sample_steps(request):
    return compute_full_steps(
        reference_values.REFERENCE_PARAMETERS, STARTS, uses_lane_engine=request.param
    )


def test_impacts_only_lose_energy(sample_steps):
    assert np.all(np.asarray(sample_steps.energy.landing) > 0.0)
    assert np.all(np.asarray(sample_steps.energy.stopper) > 0.0)
    assert np.all(np.asarray(sample_steps.energy.damping) > 0.0)


@pytest.mark.parametrize("name", vrw.parameter_sets)
def test_a_gait_loses_the_energy_of_its_descent(name):
    """The reference is the weight times the descent, M g D sin(phi)."""
    params = vrw.parameter_sets[name].params
    # All sets are found on this mesh, so that one program is compiled.
    cycle = vrw.limit_cycle(params, options=vrw.CycleOptions(mesh_intervals=(40, 32, 16)))
    step = vrw.step(params, cycle.section_state, options=vrw.StepOptions.tight())
    loss = step.energy.landing + step.energy.stopper + step.energy.damping
    assert float(loss) == pytest.approx(compute_descent_energy(params, step), rel=1e-9)


@pytest.mark.parametrize("held_landing", [True, *mark_slow(False)])
def test_a_rigid_gait_loses_the_energy_of_its_descent_in_its_landing(held_landing):
    params, model = vrw.WheelParams(slope=0.1), vrw.RigidWheel(held_landing=held_landing)
    step = vrw.step(params, vrw.limit_cycle(params, model=model).section_state, model=model)
    assert float(step.energy.landing) == pytest.approx(
        compute_descent_energy(params, step), rel=1e-12
    )


def compute_descent_energy(params, step):
    """Return the potential energy that the wheel gives up over one step, J."""
    s = params.symbols()
    return float(s.Mt * s.g * s.sin_phi * step.step_length)


@settings(max_examples=60, deadline=None)
@given(
    theta=st.floats(-0.3, 0.6),
    dtheta=st.floats(0.01, 6.0),
    dL1=st.floats(-2.0, 2.0),
    leg_mass=st.floats(0.05, 5.0),
    leg_com=st.floats(0.0, 0.9),
    hub_mass=st.floats(0.0, 50.0),
)
def test_no_landing_and_no_stopper_gains_energy(theta, dtheta, dL1, leg_mass, leg_com, hub_mass):
    s = vrw.WheelParams(leg_mass=leg_mass, leg_com=leg_com, hub_mass=hub_mass).symbols()
    state = (jnp.asarray(theta), jnp.asarray(dtheta), jnp.asarray(dL1))
    landing = transitions.resolve_landing(s, *state)
    scale = float(
        dynamics.compute_kinetic_energy(s, transitions.compute_motion_before_landing(s, *state))
    )
    assert float(landing.energy_loss) >= -1e-12 * scale
    hit = transitions.resolve_stopper_collision(s, landing.motion_after)
    at_stopper = float(dynamics.compute_kinetic_energy(s, landing.motion_after._replace(L2=s.L0)))
    assert float(hit.energy_loss) >= -1e-12 * at_stopper


@settings(max_examples=40, deadline=None)
@given(theta=st.floats(-0.9, 0.3), dtheta=st.floats(0.0, 5.0), distance=st.floats(0.5, 0.9))
def test_planted_feet_do_not_move_in_double_support(theta, dtheta, distance):
    s = vrw.WheelParams().symbols()

    def rear_foot(angle):
        phase = make_paper_phases(s, jnp.asarray(distance), True)[0]
        m = phase.compute_motion((angle,), (jnp.asarray(dtheta),))
        rear = jnp.stack([jnp.sin(angle + s.alpha), jnp.cos(angle + s.alpha)])
        return m.L1 * jnp.stack([m.sin_theta, m.cos_theta]) - m.L2 * rear

    place, drift = jax.jvp(rear_foot, (jnp.asarray(theta),), (jnp.ones(()),))
    np.testing.assert_allclose(place, [-distance, 0.0], atol=1e-14)
    np.testing.assert_allclose(drift, 0.0, atol=1e-13)


def test_both_feet_are_at_rest_after_a_landing_that_holds_them():
    s = vrw.WheelParams().symbols()
    landing = transitions.resolve_landing(s, *map(jnp.asarray, (0.1027, 1.61, -0.109)))
    m = landing.motion_after

    def height(t):
        theta = landing.theta_after_landing + t * m.dtheta
        shifted = Motion.from_angle(
            theta, m.L1 + t * m.dL1, m.L2 + t * m.dL2, m.dtheta, m.dL1, m.dL2
        )
        return compute_rear_foot_height(s, shifted)

    assert abs(float(height(0.0))) < 1e-15
    assert abs(float(jax.grad(height)(0.0))) < 1e-14


# Dimensions of parameters, section state and durations as exponents of (mass, length, time).
DIMENSIONS = {
    "hub_mass": (1, 0, 0),
    "leg_mass": (1, 0, 0),
    "leg_com": (0, 1, 0),
    "locked_length": (0, 1, 0),
    "natural_length": (0, 1, 0),
    "stiffness": (1, 0, -2),
    "damping": (1, 0, -1),
    "slope": (0, 0, 0),
    "gravity": (0, 1, -2),
}
START_DIMENSIONS = np.array([(0, 0, 0), (0, 0, -1), (0, 1, -1)])
DURATION_DIMENSIONS = np.array([(0, 0, 1)] * 3)


@pytest.mark.parametrize("scale", [(3.0, 1.0, 1.0), (1.0, 2.0, 1.0), (1.0, 1.0, 0.5)], ids=str)
def test_mass_length_and_time_scale_out(scale):
    factor = lambda exponents: np.prod(np.asarray(scale) ** np.asarray(exponents), axis=-1)
    unit_factors = np.array([factor(DIMENSIONS[name]) for name in NAMES])
    options = vrw.StepOptions.tight()
    plain, _ = compute_states_and_work(reference_values.REFERENCE_PARAMETERS, STARTS, options)
    scaled, _ = compute_states_and_work(
        reference_values.REFERENCE_PARAMETERS * unit_factors,
        STARTS * factor(START_DIMENSIONS),
        options,
    )
    expected = plain * factor(np.concatenate([START_DIMENSIONS, DURATION_DIMENSIONS]))
    # Absolute tolerances are not dimensionless, so two integrations differ within the claim.
    assert reference_values.compute_scaled_error(scaled, np.asarray(expected)) < 2e-12


def test_the_stopper_never_pulls_leg_2_and_the_landing_never_pulls_the_foot(sample_steps):
    assert np.all(np.asarray(sample_steps.indicators.lambda_I4) > 0.0)
    assert np.all(np.asarray(sample_steps.margins.fore_foot_force) > 0.0)


def test_forces_equal_the_rate_of_momentum_of_the_point_masses():
    """Compare lambda_1 and lambda_2 with the rate of momentum by Newton's law on every mass."""
    p = vrw.WheelParams()
    s = p.symbols()
    theta, L1, L2, dtheta, dL1, dL2 = -0.3, 0.93, 0.96, 1.2, -0.1, 0.2
    m = Motion.from_angle(*map(jnp.asarray, (theta, L1, L2, dtheta, dL1, dL2)))
    a = dynamics.solve_single_support_1(s, m)

    def masses(t):
        angle = theta + dtheta * t + 0.5 * a.ddtheta * t * t
        l1 = L1 + dL1 * t + 0.5 * a.ddL1 * t * t
        l2 = L2 + dL2 * t + 0.5 * a.ddL2 * t * t
        up = lambda leg: jnp.stack(
            [jnp.sin(angle + (leg - 1) * s.alpha), jnp.cos(angle + (leg - 1) * s.alpha)]
        )
        hub = l1 * up(1)
        legs = [0.3 * up(1), hub - (l2 - 0.3) * up(2)]
        legs += [hub - 0.7 * up(leg) for leg in range(3, 9)]
        return 10.0 * hub + sum(legs)

    rate = jax.jacfwd(jax.jacfwd(masses))(0.0)
    gravity = 9.81 * 18.0 * np.array([np.sin(0.3), -np.cos(0.3)])
    fore = dynamics.compute_fore_foot_force(s, m, a)
    np.testing.assert_allclose(jnp.stack([*fore]), rate - gravity, rtol=1e-12)

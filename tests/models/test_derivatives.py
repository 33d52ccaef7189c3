"""Derivatives of the return map agree: forward, reverse, by differences and by saltation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference_values

import vrw_jax as vrw
from vrw_jax.lanes.autodiff import enable_all_ad_modes
from vrw_jax.models.phase_sequence import make_element_phase
from vrw_jax.wheel import make_paper_phases, transitions

PARAMS = vrw.WheelParams()
START = jnp.asarray(reference_values.stack_quantity("step", "start")[0])
TIGHT_OPTIONS = vrw.StepOptions.tight()


@pytest.fixture(scope="module")
def forward_jacobian():
    return jax.jacfwd(vrw.return_map, argnums=(0, 1))(PARAMS, START, options=TIGHT_OPTIONS)


def test_reverse_mode_equals_forward_mode(forward_jacobian):
    reverse = jax.jacrev(vrw.return_map, argnums=(0, 1))(PARAMS, START, options=TIGHT_OPTIONS)
    for one, other in zip(jax.tree.leaves(forward_jacobian), jax.tree.leaves(reverse), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)


def test_grad_of_a_scalar_is_a_row_of_the_jacobian(forward_jacobian):
    rate = lambda params, x: vrw.return_map(params, x, options=TIGHT_OPTIONS)[1]
    gradient, by_start = jax.grad(rate, argnums=(0, 1))(PARAMS, START)
    np.testing.assert_allclose(gradient.damping, forward_jacobian[0].damping[1], rtol=1e-13)
    np.testing.assert_allclose(gradient.slope, forward_jacobian[0].slope[1], rtol=1e-13)
    np.testing.assert_allclose(by_start, forward_jacobian[1][1], rtol=1e-13)


@pytest.mark.parametrize("name", ["damping", "natural_length", "slope", "leg_mass"])
def test_central_differences_agree(forward_jacobian, name):
    value = float(getattr(PARAMS, name))
    h = 1e-4 * value
    value_at = lambda k: np.asarray(
        vrw.return_map(vrw.WheelParams(**{name: value + k * h}), START, options=TIGHT_OPTIONS)
    )
    difference = (8.0 * (value_at(1) - value_at(-1)) - (value_at(2) - value_at(-2))) / (12.0 * h)
    # Fourth-order differences of values good to 1e-14: rounding 1e-14 / h.
    np.testing.assert_allclose(
        getattr(forward_jacobian[0], name), difference, rtol=1e-8, atol=1e-13 / h
    )


@pytest.mark.slow
def test_the_saltation_formula_agrees(forward_jacobian):
    """Product of flow, saltation and reset Jacobians, with a flow that has nothing to do with ours.

    The flow of each phase over its fixed duration is 2,000 steps of the classic Runge-Kutta method;
    at a guard g the perturbed flow meets it dt = -grad g . dy / (grad g . f) later.
    """
    s = PARAMS.symbols()
    step_result = vrw.step(PARAMS, START, options=TIGHT_OPTIONS)

    def flow(field, y, duration):
        h = duration / 2000

        def rk4(y, _):
            k1 = field(y)
            k2 = field(y + 0.5 * h * k1)
            k3 = field(y + 0.5 * h * k2)
            k4 = field(y + h * k3)
            return y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4), None

        return jax.lax.scan(rk4, y, None, length=2000)[0]

    def through(phase, y, duration):
        ending = lambda y: (flow(phase.vector_field, y, duration),) * 2
        matrix, end = jax.jacfwd(ending, has_aux=True)(y)
        gradient = jax.grad(lambda y: phase.guards.evaluate_guards_and_margins(y)[0])(end)
        f = phase.vector_field(end)
        return end, matrix - jnp.outer(f, gradient @ matrix) / (gradient @ f)

    def landed(x):
        landing = transitions.resolve_landing(s, *x)
        return jnp.stack(
            [landing.theta_after_landing, landing.motion_after.dtheta, landing.foot_distance]
        )

    @jax.jit
    def by_saltation(durations):
        at_landing, by_landing = landed(START), jax.jacfwd(landed)(START)
        # The distance between the feet is a constant of double support: a third coordinate at rest.
        distance = at_landing[2]
        flows = lambda distance: [
            make_element_phase(phase, False) for phase in make_paper_phases(s, distance, True)
        ]
        first, second, third = flows(distance)
        with_distance = first._replace(
            vector_field=lambda y: jnp.append(flows(y[2])[0].vector_field(y[:2]), 0.0),
            guards=first.guards._replace(
                evaluate_guards_and_margins=lambda y: flows(y[2])[
                    0
                ].guards.evaluate_guards_and_margins(y[:2])
            ),
        )

        def lifted(y):
            m = flows(y[2])[0].motion_unpacker(y[:2])
            return jnp.stack([y[0], m.L1, m.L2, m.dtheta, m.dL1, m.dL2])

        def locked(y):
            hit = transitions.resolve_stopper_collision(s, second.motion_unpacker(y))
            return jnp.stack(
                [y[0], hit.motion_after.L1, hit.motion_after.dtheta, hit.motion_after.dL1]
            )

        end, dls = through(with_distance, at_landing, durations[0])
        end2, sls1 = through(second, lifted(end), durations[1])
        end3, sls2 = through(third, locked(end2), durations[2])
        section = jnp.asarray([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
        product = section @ sls2 @ jax.jacfwd(locked)(end2) @ sls1 @ jax.jacfwd(lifted)(end) @ dls
        return section @ end3, product @ by_landing

    end, product = by_saltation(step_result.durations)
    np.testing.assert_allclose(end, step_result.section_state, atol=1e-10)
    np.testing.assert_allclose(product, forward_jacobian[1], atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_agree_with_differences_of_first_ones():
    # The event location must not be frozen for these: a stopped gradient is wrong by far here.
    rate = lambda damping: vrw.return_map(
        vrw.WheelParams(damping=damping), START, options=TIGHT_OPTIONS
    )[1]
    first = jax.jit(jax.grad(rate))
    h = 0.05
    difference = (
        8 * (first(200 + h) - first(200 - h)) - (first(200 + 2 * h) - first(200 - 2 * h))
    ) / (12 * h)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.grad(rate)))(200.0), difference, rtol=1e-8)


def test_margins_and_indicators_are_differentiable():
    def evaluate(params, x):
        result = vrw.step(params, x, options=TIGHT_OPTIONS)
        m = result.margins
        return jnp.stack(
            [
                m.fore_foot_force,
                m.clearance_sls1,
                m.contraction,
                m.friction_fore,
                m.landing_friction_rear,
                m.hit_planted_impulse,
                *m.locked_stopper_force,
                result.indicators.lambda_4,
                result.energy.damping,
            ]
        )

    h = 0.02
    value_at = lambda damping: evaluate(vrw.WheelParams(damping=damping), START)
    difference = (
        8 * (value_at(200 + h) - value_at(200 - h))
        - (value_at(200 + 2 * h) - value_at(200 - 2 * h))
    ) / (12 * h)
    # By all arguments, for which other tests have the machine code.
    solution = jax.jacfwd(evaluate, argnums=(0, 1))(vrw.WheelParams(damping=200.0), START)[
        0
    ].damping
    # Differences of forces of 100 N good to 1e-12: 1e-12 / h.
    np.testing.assert_allclose(solution, difference, rtol=1e-7, atol=2e-10)


def test_only_perturbed_inputs_cost_tangents():
    """With one of two arguments perturbed, the Jacobian is formed over that one alone."""

    def function(a, b):
        return jnp.sum(a) * jnp.sin(b), ()

    many = jnp.ones(50)
    one = jnp.asarray(1.0)
    along_b = lambda b: jax.jvp(lambda b: enable_all_ad_modes(function)(many, b)[0], (b,), (one,))
    assert "f64[50,50]" not in str(jax.make_jaxpr(along_b)(0.3 * one))
    value, slope = along_b(0.3 * one)
    np.testing.assert_allclose((value, slope), (50 * np.sin(0.3), 50 * np.cos(0.3)), rtol=1e-14)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_all_differentiation_modes_nest_to_third_order(mode, outer):
    function = enable_all_ad_modes(lambda a: (jax.lax.fori_loop(0, 3, lambda _, v: v * a, a), ()))
    third = outer(mode(outer(lambda a: function(a)[0])))
    np.testing.assert_allclose(third(1.5), 24.0 * 1.5, rtol=1e-14)

"""Steps with a law of the legs that a user gives, against a five-coordinate code and SciPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import five_coordinates
from support.leg_laws import (
    PaperLeg,
    QuadraticDamper,
    make_progressive_leg,
    make_reference_params,
    make_wheel,
)
from support.machine_code import CodeRegistrySpy
from support.slow_variants import ENGINES

import vrw_jax as vrw
from vrw_jax.wheel import PARAMETER_NAMES

PARAMS = vrw.WheelParams(damping=150.0)
START = np.array([0.1, 1.6, -0.1])
TIGHT_OPTIONS = vrw.StepOptions.tight()


def advance(law, params=PARAMS, **options):
    return vrw.return_map(params, START, model=make_wheel(law), **options)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_papers_law_as_a_law_gives_the_papers_step(engine):
    expected = vrw.step(PARAMS, START, engine=engine)
    step = vrw.step(PARAMS, START, model=make_wheel(PaperLeg()), engine=engine)
    for value, expected_value in zip(jax.tree.leaves(step), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(value, expected_value, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    "law", [QuadraticDamper(), make_progressive_leg()], ids=["damper", "spring"]
)
def test_a_step_agrees_with_five_coordinates(law):
    step = vrw.step(PARAMS, START, model=make_wheel(law), options=TIGHT_OPTIONS)
    reference = five_coordinates.step(make_reference_params(law, damping=150.0), START)
    assert reference["outcome"] == five_coordinates.STEPPED
    np.testing.assert_allclose(step.section_state, reference["section_state"], atol=3e-12)
    np.testing.assert_allclose(step.durations, reference["durations"], atol=3e-12)
    # The potential of the law is a quadrature here, and SciPy's there.
    assert abs(step.energy.damping - reference["energy_lost_damping"]) < 1e-10
    assert abs(step.energy.landing - reference["energy_lost_landing"]) < 1e-12
    margins = five_coordinates.step_margins(make_reference_params(law, damping=150.0), START)
    assert abs(step.margins.fore_foot_force - min(margins["lambda2"].values())) < 1e-8
    np.testing.assert_allclose(
        step.margins.locked_stopper_force, margins["stopper_force_legs"], atol=1e-8
    )


def test_derivatives_by_a_parameter_of_the_law_are_those_of_five_coordinates():
    def advance_reference(values):
        law, damping = QuadraticDamper(values[0]), values[1]
        return five_coordinates.return_map(make_reference_params(law, damping=damping), START)

    def advance_wheel(values):
        return advance(QuadraticDamper(values[0]), vrw.WheelParams(damping=values[1]))

    values = np.array([60.0, 150.0])
    expected = five_coordinates.jacobian(advance_reference, values)
    jacobian = jax.jacfwd(advance_wheel)(jnp.asarray(values))
    np.testing.assert_allclose(jacobian, expected, rtol=1e-7, atol=1e-11)
    np.testing.assert_allclose(jax.jacrev(advance_wheel)(jnp.asarray(values)), jacobian, atol=1e-13)


@pytest.mark.slow
def test_second_derivatives_by_a_parameter_of_the_law_are_differences_of_first_ones():
    differentiate = jax.jacfwd(lambda c2: advance(QuadraticDamper(c2), options=TIGHT_OPTIONS))
    difference = (differentiate(60.1) - differentiate(59.9)) / 0.2
    hessian = jax.hessian(lambda c2: advance(QuadraticDamper(c2), options=TIGHT_OPTIONS))(60.0)
    np.testing.assert_allclose(hessian, difference, rtol=1e-4)


def test_a_batch_of_laws_gives_the_bits_of_each_law_alone_and_a_code_for_a_bad_one():
    c2 = np.array([0.0, 60.0, -1.0, np.nan, 90.0])
    states = np.tile(START, (5, 1))
    batch = vrw.step_batch(PARAMS, states, 2, model=make_wheel(QuadraticDamper(c2)))
    assert batch.engine == "lanes"
    assert [vrw.Outcome(x).name for x in batch.outcome[2:4]] == ["BAD_INPUT"] * 2
    assert np.isfinite(batch.section_state).all()
    for index in (0, 1, 4):
        model = make_wheel(QuadraticDamper(c2[index]))
        alone = vrw.step_batch(PARAMS, states[:1], 2, model=model)
        np.testing.assert_array_equal(alone.section_state[0], batch.section_state[index])


@pytest.mark.parametrize("engine", ENGINES)
def test_derivatives_of_batches_are_those_of_the_return_map(engine):
    model = make_wheel(QuadraticDamper())
    names = ("section_state", "leg.c2", *PARAMETER_NAMES)
    batch = vrw.step_batch(PARAMS, START[None], model=model, engine=engine, derivatives=names)
    params_jacobian, law_jacobian = jax.jacfwd(
        lambda params, c2: advance(QuadraticDamper(c2), params), (0, 1)
    )(PARAMS, 60.0)
    for name in names[2:]:
        np.testing.assert_allclose(
            batch.derivatives[name].section_state[0], getattr(params_jacobian, name), atol=1e-9
        )
    np.testing.assert_allclose(
        batch.derivatives["leg.c2"].section_state[0], law_jacobian, atol=1e-9
    )


def test_another_value_of_a_parameter_compiles_nothing(monkeypatch):
    computations = [
        lambda model: vrw.return_map(PARAMS, START, model=model),
        lambda model: vrw.limit_cycle(PARAMS, model=model).period,
    ]
    spy = CodeRegistrySpy(monkeypatch)
    for compute in computations:
        compute(make_wheel(QuadraticDamper(60.0)))
    n_traces = spy.n_traces
    for compute in computations:
        compute(make_wheel(QuadraticDamper(61.0)))
    assert spy.n_traces == n_traces


def test_a_function_without_parameters_is_a_law():
    stiffening = vrw.return_map(
        PARAMS,
        START,
        model=make_wheel(lambda L, dL, p: PaperLeg(500.0)(L, dL, p)),
    )
    np.testing.assert_allclose(stiffening, vrw.return_map(PARAMS, START), atol=1e-12)


def test_the_dissipated_power_is_the_loss_of_energy_in_each_phase():
    walk = vrw.simulate(PARAMS, START, 1, model=make_wheel(make_progressive_leg()), n_samples=1001)
    for phase in range(3):
        part = walk.isel(time=walk.phase.values == phase)
        lost = float(part.total_energy[0] - part.total_energy[-1])
        # The trapezoidal rule integrates the samples to five digits.
        assert abs(np.trapezoid(part.damping_power, part.time) - lost) < 2e-5 * lost


class KinkedSpring(eqx.Module):
    """A spring with a stop, whose potential is known."""

    def __call__(self, L, dL, params):
        stop = 4000.0 * jnp.maximum(0.87 - L, 0.0)
        return params.stiffness * (params.natural_length - L) + stop - params.damping * dL

    def potential(self, L, params):
        stop = 2000.0 * jnp.maximum(0.87 - L, 0.0) ** 2
        return 0.5 * params.stiffness * (params.natural_length - L) ** 2 + stop


def test_a_potential_of_the_law_makes_energies_of_kinked_springs_exact():
    step = vrw.step(PARAMS, START, model=make_wheel(KinkedSpring()))
    walk = vrw.simulate(PARAMS, START, 1, model=make_wheel(KinkedSpring()), n_samples=2001)
    dissipated = np.trapezoid(walk.damping_power, walk.time)
    assert abs(float(step.energy.damping) - dissipated) < 1e-4


class LawWithText(eqx.Module):
    name: str

    def __call__(self, L, dL, params):
        return params.stiffness * (params.natural_length - L)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (3.0, "leg_force is 3.0, but it is the force along a leg"),
        (QuadraticDamper, "give a function"),
        (lambda L, dL, p: 1.0 if L > 0.9 else 0.0, r"write jnp.where"),
        (lambda L, dL, p: jnp.sum(L), "acts element by element"),
        (lambda L, dL, p: L > 0.9, "return one real number"),
        (LawWithText("stiff"), "leg.name is 'stiff'.*static=True"),
        (QuadraticDamper(np.ones((2, 2))), "give each number its own field"),
    ],
)
def test_what_is_no_law_is_refused_in_one_sentence(law, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make_wheel(law)


def test_the_model_with_rigid_legs_refuses_a_law():
    with pytest.raises(TypeError, match="has no law of its own for the legs"):
        vrw.RigidWheel(leg_force=QuadraticDamper())


def test_a_parameter_outside_its_domain_is_refused():
    with pytest.raises(
        ValueError, match=r"leg.c2 is -1, but it must lie in \[0, inf\) N s\^2/m\^2"
    ):
        make_wheel(QuadraticDamper(-1.0))

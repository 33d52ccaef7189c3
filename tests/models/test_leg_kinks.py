"""Steps with a force along the legs that has kinks or jumps, against SciPy with restarts there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import constrained_wheel, five_coordinates
from support.leg_laws import BumpStop, QuadraticDamper, make_wheel

import vrw_jax as vrw

PARAMS = vrw.WheelParams(damping=150.0)
START = np.array([0.1, 1.6, -0.1])
TIGHT_OPTIONS = vrw.StepOptions.tight()


class KinkedLeg(eqx.Module):
    """A spring, a damper, and what has a kink or a jump where its number is not zero.

    The second spring touches below 0.9 m, and the second damper acts below 0.93 m, so that the
    force jumps. Dry friction may stop the leg. All three laws of the tests are one program.
    """

    k2: float = 0.0
    c2: float = 0.0
    friction: float = 0.0

    def __call__(self, L, dL, params):
        spring = params.stiffness * (params.natural_length - L) + self.k2 * jnp.maximum(
            0.9 - L, 0.0
        )
        damping = params.damping + jnp.where(L < 0.93, self.c2, 0.0)
        return spring - damping * dL - jnp.where(dL > 0.0, self.friction, -self.friction)

    def kinks(self, L, dL, params):
        return (L - 0.9, L - 0.93, dL)


class ReferenceLaw:
    """A law of this module for the reference code, on fixed sides of the kinks of both legs."""

    def __init__(self, law, damping=150.0):
        self.damping, self.sides = damping, None
        self.k2, self.c2, self.friction = law.k2, law.c2, law.friction

    def kink(self, length, rate):
        return rate if self.friction else length - (0.9 if self.k2 else 0.93)

    def __call__(self, length, rate):
        is_positive = self.kink(length, rate) > 0.0 if self.sides is None else self.sides > 0.0
        force = 500.0 * (1.02 - length) - self.damping * rate
        if self.friction:
            return force - self.friction * np.where(is_positive, 1.0, -1.0)
        return force + np.where(is_positive, 0.0, self.k2 * (0.9 - length) - self.c2 * rate)


def run_phase_over_kinks(wheel, mode, q, v, guards, **options):
    """Integrate a phase by SciPy, which stops at each kink and restarts there."""
    law, legs = wheel.params["leg_force"], [0] if mode == "SLS-II" else [0, 1]
    duration, crossed = 0.0, None
    law.sides = np.where(law.kink(q[3:], v[3:]) > 0.0, 1.0, -1.0)
    while True:
        kink_guards = {
            leg: lambda q, v, leg=leg, zero=1e-13 * (leg == crossed): (
                zero + law.sides[leg] * law.kink(q[3 + leg], v[3 + leg])
            )
            for leg in legs
        }
        phase = constrained_wheel.run_phase(wheel, mode, q, v, guards | kink_guards, **options)
        duration, q, v, crossed = duration + phase.duration, phase.q, phase.v, phase.event
        if crossed not in legs:
            law.sides, phase.duration = None, duration
            return phase
        law.sides = law.sides * np.where(np.arange(2) == crossed, -1.0, 1.0)


@pytest.fixture(autouse=True)
def restart_at_kinks(monkeypatch):
    monkeypatch.setattr(five_coordinates, "run_phase", run_phase_over_kinks)
    # The law of this test has no potential, and energies are not compared.
    monkeypatch.setattr(constrained_wheel.Wheel, "elastic", lambda wheel, length: 0.0)


def take_reference_step(law, start=START, damping=150.0):
    law = ReferenceLaw(law, damping)
    params = five_coordinates.TABLE_1 | {"damping": damping, "leg_force": law}
    return five_coordinates.step(params, start)


LAWS = [KinkedLeg(k2=300.0), KinkedLeg(c2=40.0), KinkedLeg(friction=5.0)]
LAW_NAMES = ["kink", "jump", "friction"]
NUMBER_NAMES = ["k2", "c2", "friction"]


@pytest.mark.parametrize("law", LAWS, ids=LAW_NAMES)
def test_a_step_agrees_with_five_coordinates(law):
    reference = take_reference_step(law)
    assert reference["outcome"] == five_coordinates.STEPPED
    for options, atol in ((TIGHT_OPTIONS, 1e-11), (vrw.StepOptions(), 1e-10)):
        step = vrw.step(PARAMS, START, model=make_wheel(law), options=options)
        np.testing.assert_allclose(step.section_state, reference["section_state"], atol=atol)
        np.testing.assert_allclose(step.durations, reference["durations"], atol=atol)


@pytest.mark.parametrize(
    ("law", "number_name"), zip(LAWS, NUMBER_NAMES, strict=True), ids=LAW_NAMES
)
def test_derivatives_are_those_of_five_coordinates(law, number_name):
    def advance_reference(values):
        law = KinkedLeg(**{number_name: values[4]})
        step = take_reference_step(law, values[:3], values[3])
        return np.append(step["section_state"], step["durations"])

    values = np.array([*START, 150.0, getattr(law, number_name)])
    expected = five_coordinates.jacobian(advance_reference, values)
    numbers = [f"leg.{name}" for name in NUMBER_NAMES]
    batch = vrw.step_batch(
        PARAMS,
        START[None],
        model=make_wheel(law),
        derivatives=["section_state", "damping", *numbers],
    )
    assert batch.engine == "lanes"
    columns = [
        np.concatenate(
            [part.section_state[0].T.reshape(-1, 3), part.durations[0].T.reshape(-1, 3)], 1
        )
        for part in (
            batch.derivatives[x] for x in ("section_state", "damping", f"leg.{number_name}")
        )
    ]
    np.testing.assert_allclose(np.vstack(columns).T, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS, ids=LAW_NAMES)
def test_diffrax_computes_the_steps_of_machine_code(law):
    lanes, diffrax = (
        vrw.step(PARAMS, START, model=make_wheel(law), options=TIGHT_OPTIONS, engine=engine)
        for engine in ("lanes", "diffrax")
    )
    np.testing.assert_allclose(diffrax.section_state, lanes.section_state, atol=1e-11)
    np.testing.assert_allclose(diffrax.margins.fore_foot_force, lanes.margins.fore_foot_force)


@pytest.mark.slow
def test_second_derivatives_are_differences_of_first_ones():
    advance = lambda k2: vrw.return_map(
        PARAMS, START, model=make_wheel(KinkedLeg(k2)), options=TIGHT_OPTIONS
    )
    differentiate = jax.jacfwd(advance)
    difference = (differentiate(300.1) - differentiate(299.9)) / 0.2
    np.testing.assert_allclose(jax.jacfwd(differentiate)(300.0), difference, rtol=1e-5)


@pytest.mark.parametrize("law", LAWS, ids=LAW_NAMES)
def test_minima_of_margins_count_both_sides_of_a_kink(law):
    """The reference is a sampled walk, and for derivatives the central difference."""
    measure = lambda damping: (
        vrw.step(vrw.WheelParams(damping=damping), START, model=make_wheel(law)).margins
    )
    margins, derivatives = jax.jvp(measure, (150.0,), (1.0,))
    walk = vrw.simulate(PARAMS, START, 1, model=make_wheel(law), n_samples=2001)
    assert abs(margins.fore_foot_force - float(walk.lambda_2.min())) < 2e-3
    difference = jax.tree.map(lambda a, b: (a - b) / 0.02, measure(150.01), measure(149.99))
    for name in ("fore_foot_force", "rear_stopper_force", "contraction"):
        expected = getattr(difference, name)
        np.testing.assert_allclose(getattr(derivatives, name), expected, rtol=1e-5, atol=1e-7)


def test_a_motion_that_slides_along_a_kink_ends_with_a_code():
    states = np.stack(np.broadcast_arrays(0.1, np.linspace(1.2, 2.2, 12), -0.1), 1)
    batch = vrw.step_batch(PARAMS, states, model=make_wheel(KinkedLeg(friction=60.0)))
    assert vrw.Outcome.TOO_MANY_EVENTS in batch.outcome
    assert np.isfinite(batch.section_state).all()


def test_a_batch_gives_the_bits_of_each_law_alone():
    k2 = np.array([0.0, 100.0, 300.0])
    states = np.tile(START, (3, 1))
    batch = vrw.step_batch(PARAMS, states, 2, model=make_wheel(KinkedLeg(k2)))
    for index, value in enumerate(k2):
        alone = vrw.step_batch(PARAMS, states[:1], 2, model=make_wheel(KinkedLeg(value)))
        np.testing.assert_array_equal(alone.section_state[0], batch.section_state[index])


def test_legs_in_turn_have_kinks_of_their_own():
    legs = vrw.AlternatingLegs(BumpStop(), QuadraticDamper())
    unaware = vrw.AlternatingLegs(BumpStop().__call__, QuadraticDamper())
    for first in (0.0, 1.0):
        section_state, expected = (
            vrw.walk(
                PARAMS,
                START,
                2,
                model=make_wheel(eqx.tree_at(lambda x: x.turn, law, first)),
                options=TIGHT_OPTIONS,
            ).steps.section_state
            for law in (legs, unaware)
        )
        np.testing.assert_allclose(section_state, expected, atol=1e-10)


@pytest.mark.parametrize(
    "kinks",
    [
        lambda law, L, dL, params: (jnp.sum(L),),
        lambda law, L, dL, params: L - 0.9,
        lambda law, L, dL, params: (L > 0.9,),
        lambda law, L, dL, params: (L - 0.9,) if L > 0.5 else (),
    ],
    ids=["sum", "no tuple", "no real number", "branch"],
)
def test_kinks_that_are_no_functions_of_each_leg_are_refused(kinks):
    with pytest.raises(ValueError, match="kinks of leg_force do not act element by element"):
        make_wheel(type("OddBumpStop", (BumpStop,), {"kinks": kinks})())


@pytest.mark.parametrize("model_class", [vrw.UnilateralWheel, vrw.LadderWheel])
def test_unilateral_contact_refuses_kinks(model_class):
    with pytest.raises(ValueError, match="steps with unilateral contact do not stop there"):
        model_class(leg_force=BumpStop())

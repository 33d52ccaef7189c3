"""Steps with a force along the legs that has kinks or jumps, against SciPy with restarts there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity, constrained_wheel, five_coordinates
from support.leg_laws import BumpStop, QuadraticDamper, make_wheel

import vrw_jax as vrw
from vrw_jax.models.contact_state import find_kink_sides, select_kink_sides
from vrw_jax.wheel.laws import evaluate_damping_power

PARAMS = vrw.WheelParams(damping=150.0)
START = np.array([0.1, 1.6, -0.1])
TIGHT_OPTIONS = vrw.StepOptions.tight()


class KinkedLeg(eqx.Module):
    """A spring, a damper, and what has a kink or a jump where its number is not zero.

    Below 0.9 m, a second spring touches, and a second damper acts, so that the force jumps. Dry
    friction may stop the leg. All three laws of the tests are one program.
    """

    k2: float = 0.0
    c2: float = 0.0
    friction: float = 0.0

    def __call__(self, L, dL, params):
        spring = params.stiffness * (params.natural_length - L)
        damping = params.damping + jnp.where(L < 0.9, self.c2, 0.0)
        friction = jnp.where(dL > 0.0, self.friction, 0.0) - jnp.where(dL < 0.0, self.friction, 0.0)
        return spring + self.k2 * jnp.maximum(0.9 - L, 0.0) - damping * dL - friction

    def kinks(self, L, dL, params):
        return (L - 0.9, dL)

    def potential(self, L, params):
        spring = 0.5 * params.stiffness * (params.natural_length - L) ** 2
        return spring + 0.5 * self.k2 * jnp.maximum(0.9 - L, 0.0) ** 2


class ReferenceLaw:
    """A law of this module for the reference code, on fixed sides of the kinks of both legs."""

    def __init__(self, law, damping=150.0, stiffness=500.0):
        self.damping, self.stiffness, self.sides = damping, stiffness, None
        self.k2, self.c2, self.friction = law.k2, law.c2, law.friction

    def kink(self, length, rate):
        return rate if self.friction else length - 0.9

    def __call__(self, length, rate):
        is_positive = self.kink(length, rate) > 0.0 if self.sides is None else self.sides > 0.0
        force = self.stiffness * (1.02 - length) - self.damping * rate
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


def test_equal_legs_in_turn_have_the_energy_of_one_law():
    """The law declares its potential, because Gauss's rule is inaccurate over a kink."""
    law = KinkedLeg(k2=300.0)
    alone, in_turn = (
        vrw.step(PARAMS, START, model=make_wheel(x)) for x in (law, vrw.AlternatingLegs(law, law))
    )
    np.testing.assert_allclose(in_turn.energy.damping, alone.energy.damping, rtol=1e-12)


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


PARAMS_WITH_FLIGHT = vrw.WheelParams(damping=100.0, stiffness=2000.0)
START_OF_FLIGHT = np.array([0.1, 1.2, -0.1])
"""Section state of a step in which feet slide and all leave the ground, with a friction of 0.5."""


def differentiate_contact_step(law, friction, params, start, engine="auto"):
    """Return results of a step with unilateral contact, and their derivatives.

    The derivatives are those by the numbers of the law, friction and damping. The results are the
    section state without contacts, durations, and the energy lost in the dampers.
    """

    def take_step(values):
        *numbers, friction, damping = values
        step = vrw.step(
            eqx.tree_at(lambda params: params.damping, params, damping),
            start,
            model=vrw.UnilateralWheel(
                friction=friction, infinite_friction_rule="paper", leg_force=KinkedLeg(*numbers)
            ),
            options=TIGHT_OPTIONS,
            engine=engine,
        )
        results = [step.section_state[:20], step.durations, step.energy_damping[None]]
        return jnp.concatenate(results), (jnp.concatenate(results), step.outcome)

    values = jnp.array([law.k2, law.c2, law.friction, friction, float(params.damping)])
    jacobian, (results, outcome) = jax.jacfwd(take_step, has_aux=True)(values)
    assert outcome == vrw.Outcome.STEPPED
    return np.asarray(results), np.asarray(jacobian)


@pytest.mark.parametrize("law", LAWS, ids=LAW_NAMES)
def test_a_step_with_contact_is_that_of_the_papers_wheel(law):
    """The reference has the contacts of this step, and the potential of the law."""
    step = vrw.step(PARAMS, START, model=make_wheel(law), options=TIGHT_OPTIONS)
    results, _ = differentiate_contact_step(law, np.inf, PARAMS, START)
    dls, *sls = step.durations
    expected = [*step.section_state, dls, sum(sls), 0.0, step.energy.damping]
    np.testing.assert_allclose(results[[0, 1, 12, *range(20, 24)]], expected, atol=1e-11)


@pytest.mark.parametrize("law", LAWS[:2], ids=LAW_NAMES[:2])
def test_a_step_with_slip_and_flight_agrees_with_another_event_driven_code(law, monkeypatch):
    reference_law, n_crossed = ReferenceLaw(law, 100.0, 2000.0), 0
    make_guards, integrate = complementarity._make_guards, complementarity._integrate_to_event

    def make_guards_with_kinks(wheel, place):
        names, evaluate, armed, leaves = make_guards(wheel, place)
        legs = np.flatnonzero(~np.array(place.is_locked))
        evaluate_all = lambda y: np.append(
            evaluate(y), (reference_law.sides * reference_law.kink(y[3:11], y[14:]))[legs]
        )
        kink_names = [("kink", leg) for leg in legs]
        armed = np.append(armed, np.full(len(legs), 1e-14))
        return names + kink_names, evaluate_all, armed, np.append(leaves, np.zeros(len(legs), bool))

    def integrate_to_event_or_kink(wheel, place):
        nonlocal n_crossed
        time, y, (name, leg) = integrate(wheel, place)
        if name == "kink":
            reference_law.sides[leg] *= -1.0
            n_crossed += 1
        return time, y, (name, leg)

    monkeypatch.setattr(complementarity, "_make_guards", make_guards_with_kinks)
    monkeypatch.setattr(complementarity, "_integrate_to_event", integrate_to_event_or_kink)
    wheel = complementarity.ComplementarityWheel(0.5, leg_force=reference_law)
    start = complementarity.paper_start(wheel, *START_OF_FLIGHT)
    reference_law.sides = np.where(reference_law.kink(start.q[3:], start.v[3:]) > 0.0, 1.0, -1.0)
    reference = complementarity.compute_step(wheel, start)
    assert n_crossed > 0
    assert reference.durations[2] > 0.01  # s, without a foot on the ground
    results, _ = differentiate_contact_step(law, 0.5, PARAMS_WITH_FLIGHT, START_OF_FLIGHT)
    q, v = reference.end.q, reference.end.v
    end = [q[2] + complementarity.ALPHA, v[2], *v[:2], *np.roll(q[3:], -1), *np.roll(v[3:], -1)]
    np.testing.assert_allclose(results[:20], end, atol=1e-11)
    np.testing.assert_allclose(results[20:23], reference.durations, atol=1e-12)


@pytest.mark.parametrize("law", LAWS, ids=LAW_NAMES)
def test_derivatives_of_a_step_with_slip_and_flight_are_central_differences(law):
    arguments = PARAMS_WITH_FLIGHT, START_OF_FLIGHT
    _, jacobian = differentiate_contact_step(law, 0.5, *arguments)
    (number_name,) = (name for name in NUMBER_NAMES if getattr(law, name))

    def compute_results(number_change, friction_change):
        number = getattr(law, number_name) + number_change
        changed_law = KinkedLeg(**{number_name: number})
        return differentiate_contact_step(changed_law, 0.5 + friction_change, *arguments)[0]

    differences = [
        (compute_results(*change) - compute_results(*-change)) / (2.0 * change.sum())
        for change in np.diag([1e-3, 1e-6])
    ]
    columns = jacobian[:, [NUMBER_NAMES.index(number_name), 3]]
    np.testing.assert_allclose(columns.T, differences, rtol=1e-6, atol=1e-7)


# XLA compiles the step of diffrax, with its derivatives, for two minutes.
@pytest.mark.slow
def test_diffrax_computes_contacts_and_derivatives_of_machine_code():
    """One law has all three kinks, because XLA needs minutes and gigabytes for each program."""
    law = KinkedLeg(k2=300.0, c2=40.0, friction=5.0)
    lanes, diffrax = (
        differentiate_contact_step(law, 0.5, PARAMS_WITH_FLIGHT, START_OF_FLIGHT, engine)
        for engine in ("lanes", "diffrax")
    )
    for value, expected in zip(diffrax, lanes, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-11, atol=1e-11)


def test_the_power_of_dampers_is_that_of_the_law_beside_its_kinks():
    """The force at rest, from which the power is computed, has no friction."""
    law = vrw.UnilateralWheel(leg_force=KinkedLeg(300.0, 40.0, 5.0)).laws
    s = PARAMS.attach_laws(law).symbols()
    L, dL = jnp.asarray(np.random.default_rng(0).uniform((0.8, -1.0), (1.0, 1.0), (8, 2)).T)
    sides = find_kink_sides(s, L, dL)
    expected, power = (
        evaluate_damping_power(symbols, L, dL, np.arange(1, 9))
        for symbols in (s, select_kink_sides(s, sides))
    )
    np.testing.assert_allclose(power, expected, rtol=1e-12)

"""Unilateral contact agrees with a second event-driven formulation, in every mode and for both
stoppers."""

import numpy as np
import pytest
from reference_code import complementarity
from support.slow_variants import mark_slow

import vrw_jax as vrw

TIGHT_OPTIONS = vrw.StepOptions.tight()
START = (0.1, 1.6, -0.1)
STEP_CASES = [  # friction, damping, slope, start
    (0.7, 200.0, 0.3, START),  # lands sliding
    (0.5, 100.0, 0.3, (0.1, 1.2, -0.1)),  # flies
    (0.5, 100.0, 0.3, (0.1, 2.2, -0.1)),  # reverses
    (1e4, 100.0, 0.3, START),  # drags the rear foot
]
WIDE_BOX_FRICTIONS = (0.1, 0.3, 0.5, 0.7, 1.0, 1.3, 2.0, 5.0, 30.0, 1e4)
DIP_PERIOD_TOLERANCE_SECONDS = 1e-10
"""s; what stays down below a dip of 1e-13 m, in chains of sixty to ninety events: stoppers only
push. Both codes bring contacts to rest without friction: with it in one, they differ by 6e-9 s."""
EVENT_CHAIN_TOLERANCE_SECONDS = 2e-9
"""s; the same of chains of up to two hundred events, in which the codes bring to rest at different
events. Each lacks the friction of a pull of 1.4e-6 N s."""


def compare_codes(friction, damping, slope, x, stoppers, n_steps=1, max_events=400):
    """Return durations over all steps and the last section state, by the library and by the
    reference."""
    # Friction is finite: what infinite friction would be chooses the program of test_unilateral.
    model = vrw.UnilateralWheel(friction, max_events, stoppers, infinite_friction_rule="paper")
    params = vrw.WheelParams(damping=damping, slope=slope)
    wheel = complementarity.ComplementarityWheel(
        friction, c=damping, slope=slope, one_sided=stoppers == "one-sided"
    )
    place, durations, reference = complementarity.paper_start(wheel, *x), 0.0, 0.0
    for _ in range(n_steps):
        step = vrw.step(params, x, model=model, options=TIGHT_OPTIONS)
        assert int(step.outcome) == vrw.Outcome.STEPPED
        assert int(step.fewest_solutions) == 1
        other = complementarity.compute_step(wheel, place)
        x, place = step.section_state, other.end
        durations, reference = durations + np.asarray(step.durations), reference + other.durations
    q, v = other.end.q, other.end.v
    ends = np.r_[q[2] + complementarity.ALPHA, v[2], v[:2], np.roll(q[3:], -1), np.roll(v[3:], -1)]
    return durations, np.asarray(x[:20]), reference, ends


@pytest.mark.parametrize(("friction", "damping", "slope", "x"), STEP_CASES)
def test_a_step_agrees_with_another_event_driven_code(friction, damping, slope, x):
    durations, state, reference, ends = compare_codes(friction, damping, slope, x, "bilateral")
    assert abs(durations.sum() - reference.sum()) < 1e-12
    # A foot that lands at 2e-4 m/s reads no more than 32 roundings of its height for 3.5e-11 s.
    np.testing.assert_allclose(durations, reference, atol=5e-11)
    np.testing.assert_allclose(state, ends, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "damping", "slope", "x"), STEP_CASES[:3])
def test_a_step_with_one_sided_stoppers_agrees_with_another_code(friction, damping, slope, x):
    durations, state, reference, ends = compare_codes(friction, damping, slope, x, "one-sided")
    assert abs(durations.sum() - reference.sum()) < DIP_PERIOD_TOLERANCE_SECONDS
    np.testing.assert_allclose(state[:4], ends[:4], atol=10.0 * DIP_PERIOD_TOLERANCE_SECONDS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "damping", "stoppers", "error"),
    [
        (0.7, 300.0, "bilateral", 1e-9),
        (1.3, 200.0, "bilateral", 1e-9),
        (1e4, 50.0, "bilateral", 1e-9),
        (0.7, 300.0, "one-sided", 1e-9),  # some five hundred events
        (1.3, 200.0, "one-sided", 1e-8),  # eight hundred, in other chains
    ],
)
def test_ten_steps_agree_with_another_code(friction, damping, stoppers, error):
    durations, state, reference, ends = compare_codes(
        friction, damping, 0.3, START, stoppers, n_steps=10
    )
    assert abs(durations.sum() - reference.sum()) < error
    np.testing.assert_allclose(state[:4], ends[:4], atol=error)


@pytest.mark.slow
@pytest.mark.parametrize("friction", WIDE_BOX_FRICTIONS)
def test_steps_over_a_wide_box_agree_with_another_code(friction):
    draw = np.random.default_rng(round(10 * friction)).uniform
    x = (draw(0.05, 0.15), draw(1.4, 2.2), draw(-0.3, 0.0))
    durations, _, reference, _ = compare_codes(
        friction, draw(20.0, 400.0), draw(0.2, 0.34), x, "bilateral"
    )
    assert abs(durations.sum() - reference.sum()) < 1e-8


@pytest.mark.slow
@pytest.mark.parametrize("friction", WIDE_BOX_FRICTIONS)
def test_steps_over_a_wide_box_with_one_sided_stoppers_agree_with_another_code(friction):
    draw = np.random.default_rng(round(10 * friction)).uniform
    x = (draw(0.05, 0.15), draw(1.4, 2.2), draw(-0.3, 0.0))
    durations, _, reference, _ = compare_codes(
        friction, draw(20.0, 400.0), draw(0.2, 0.34), x, "one-sided"
    )
    assert abs(durations.sum() - reference.sum()) < EVENT_CHAIN_TOLERANCE_SECONDS


@pytest.mark.slow
def test_only_the_event_limit_ends_a_chain_of_five_hundred_events():
    """At 0.2723 s and eight times more three combinations of forces are admissible: both codes take
    the one with most feet at rest."""
    durations, _, reference, _ = compare_codes(1e4, 200.0, 0.3, START, "one-sided", max_events=4000)
    assert abs(durations.sum() - reference.sum()) < DIP_PERIOD_TOLERANCE_SECONDS
    take_step = lambda max_events: vrw.step(
        vrw.WheelParams(damping=200.0, slope=0.3),
        START,
        model=vrw.UnilateralWheel(
            1e4, max_events, stoppers="one-sided", infinite_friction_rule="paper"
        ),
        options=TIGHT_OPTIONS,
    )
    assert int(take_step(400).outcome) == vrw.Outcome.TOO_MANY_EVENTS
    shortened = take_step(500)  # 413 of 557 events are made, as legs come to rest sooner
    assert int(shortened.outcome) == vrw.Outcome.STEPPED
    assert 1e-10 < abs(shortened.period - reference.sum()) < EVENT_CHAIN_TOLERANCE_SECONDS


@pytest.mark.parametrize("x", [START, *mark_slow(((0.1, 4.0, -0.1),))])
def test_a_wheel_without_friction_falls_back_in_both_codes(x):
    wheel = complementarity.ComplementarityWheel(0.0)
    with pytest.raises(complementarity.NoAdmissibleContactError, match="fell back"):
        complementarity.compute_step(wheel, complementarity.paper_start(wheel, *x))
    model = vrw.UnilateralWheel(friction=0.0, infinite_friction_rule="paper")
    step = vrw.step(vrw.WheelParams(), x, model=model, options=TIGHT_OPTIONS)
    assert int(step.outcome) == vrw.Outcome.FELL_BACK


def test_a_wheel_on_two_stiff_legs_slides_like_a_block_in_the_reference_code():
    wheel = complementarity.ComplementarityWheel(0.2, slope=0.3)
    q, v = np.r_[0.0, np.cos(np.pi / 8), -np.pi / 8, np.ones(8)], np.zeros(11)
    v[0] = 0.1
    modes = (complementarity.SLIP_DOWNHILL,) * 2 + (complementarity.CONTACT_OFF,) * 6
    acceleration, on_feet, _ = complementarity._solve_contact_forces(
        wheel, q, v, modes, (True,) * 8
    )
    downhill_acceleration = 9.81 * (np.sin(0.3) - 0.2 * np.cos(0.3))
    np.testing.assert_allclose(acceleration[:3], [downhill_acceleration, 0.0, 0.0], atol=1e-12)
    assert abs(on_feet[:, 1].sum() - 18.0 * 9.81 * np.cos(0.3)) < 1e-10

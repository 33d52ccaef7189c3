"""Uneven ground: independent references in an absolute frame, energy, derivatives, simple calls."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity, uneven_ground
from reference_code.five_coordinates import TABLE_1
from support.slow_variants import ENGINES

import vrw_jax as vrw
from vrw_jax.models.contact_mechanics import find_contact_slots, select_slot_friction
from vrw_jax.models.contact_record import pack_section_state, unpack_section_state
from vrw_jax.wheel import PARAMETER_NAMES, GroundAhead

START = (0.1, 1.6, -0.1)
TIGHT = vrw.StepOptions.tight()
LINES = (0.31225, 0.28467, 0.30251, 0.29659, 0.29728, 0.29896, 0.29158, 0.30482, 0.3043, 0.29, 0.3)
"""Slopes of eleven lines, about 0.30 with a standard deviation of 0.008."""
OTHER = {**TABLE_1, "damping": 150.0}
WHEEL = {"damping": 150.0}


def paper_walk(slopes, n_steps, **given):
    return vrw.walk(vrw.WheelParams(**WHEEL, slope=jnp.asarray(slopes)), START, n_steps, **given)


@pytest.mark.parametrize("engine", ENGINES)
def test_ten_steps_of_the_papers_wheel_are_those_in_an_absolute_frame(engine):
    walk = paper_walk(LINES, 10, options=TIGHT, engine=engine)
    other = uneven_ground.walk(OTHER, START, LINES)
    assert int(walk.n_stepped) == len(other) == 10
    durations, states = (np.stack([getattr(step, name) for step in other]) for name in
                         ("durations", "section_state"))  # fmt: skip
    assert abs(float(jnp.sum(walk.steps.durations)) - durations.sum()) < 1e-12
    np.testing.assert_allclose(walk.steps.durations, durations, atol=1e-12)
    np.testing.assert_allclose(walk.steps.section_state, states, atol=1e-12)


def test_energies_and_margins_of_a_step_are_those_of_an_absolute_frame():
    x, other = START, uneven_ground.walk(OTHER, START, LINES[:4])
    for k, reference in enumerate(other):
        params = vrw.WheelParams(**WHEEL, slope=jnp.asarray(LINES[k : k + 2]))
        step = vrw.step(params, x, options=TIGHT)
        np.testing.assert_allclose(vrw.return_map(params, x, options=TIGHT), step.section_state)
        np.testing.assert_allclose(step.section_state, reference.section_state, atol=1e-12)
        np.testing.assert_allclose(step.post_impact, reference.post_impact, atol=1e-12)
        lost = reference.lost_landing, reference.lost_stopper, reference.lost_damping
        energy = step.energy
        np.testing.assert_allclose(
            [energy.landing, energy.stopper, energy.damping], lost, atol=1e-11
        )
        assert abs(reference.energy_residual) < 1e-11
        assert abs(float(step.margins.clearance_sls1) - reference.clearance) < 1e-10
        x = step.section_state


N_LINES = 4
NAMES = [name for name in PARAMETER_NAMES if name != "slope"]
WALK_ARGUMENTS = np.array([*START, *(OTHER[name] for name in NAMES), *LINES[:N_LINES]])
"""Section state at the start, parameters, and slopes of the ground, for a walk of three steps."""


def end_walk(inputs):
    """Return the last state and the last durations of a walk."""
    params = vrw.WheelParams(
        **dict(zip(NAMES, inputs[3:-N_LINES], strict=True)), slope=inputs[-N_LINES:]
    )
    last = vrw.walk(params, inputs[:3], N_LINES - 1, options=TIGHT).steps
    return jnp.concatenate([last.section_state[-1], last.durations[-1]])


@pytest.mark.slow
def test_reverse_mode_of_a_walk_gives_the_derivatives_of_forward_mode():
    reverse, forward = (
        transform(end_walk)(jnp.asarray(WALK_ARGUMENTS)) for transform in (jax.jacrev, jax.jacfwd)
    )
    np.testing.assert_allclose(reverse, forward, atol=1e-11)


def test_derivatives_of_a_walk_are_differences_of_an_absolute_frame():
    """With respect to the start, every parameter and every slope, over three steps."""

    def other(inputs):
        given = OTHER | dict(zip(NAMES, inputs[3:-N_LINES].tolist(), strict=True))
        last = uneven_ground.walk(given, inputs[:3].tolist(), inputs[-N_LINES:].tolist())[-1]
        return np.concatenate([last.section_state, last.durations])

    point = WALK_ARGUMENTS
    forward = jax.jacfwd(end_walk)(jnp.asarray(point))
    # A wrong derivative with respect to any input changes the derivative along a random direction.
    directions = np.random.default_rng(0).standard_normal((4, len(point)))
    for direction in directions * np.maximum(np.abs(point), 1.0):
        # Values have errors of 1e-13, and differences of these steps errors near 1e-8.
        h = 1e-5
        difference = (other(point + h * direction) - other(point - h * direction)) / (2 * h)
        np.testing.assert_allclose(forward @ direction, difference, rtol=1e-6, atol=1e-7)


def test_as_many_slopes_as_steps_use_the_last_one_twice():
    walk, same = paper_walk(LINES[:3], 3), paper_walk((*LINES[:3], LINES[2]), 3)
    np.testing.assert_array_equal(walk.steps.durations, same.steps.durations)
    model = vrw.UnilateralWheel(friction=jnp.asarray([0.7, 0.5, 0.9]))
    wheel = lambda slopes: vrw.WheelParams(slope=jnp.asarray(slopes))
    walk = model.split_ground_by_step(wheel(LINES[:3]), 3)
    longer = vrw.UnilateralWheel(friction=jnp.asarray([0.7, 0.5, 0.9, 0.1]))
    same = longer.split_ground_by_step(wheel((*LINES[:3], LINES[2])), 3)
    for row, other in zip(walk, same, strict=True):
        np.testing.assert_array_equal(row, other)


def test_equal_slopes_are_flat_ground():
    flat, lines = paper_walk(0.3, 4), paper_walk(np.full(5, 0.3), 4)
    np.testing.assert_allclose(lines.steps.section_state, flat.steps.section_state, atol=1e-13)


def test_a_wall_ahead_that_no_wheel_may_stand_on_is_bad_input():
    walk = paper_walk((0.3, 0.3, 2.0, 0.3), 3)
    assert walk.steps.outcome.tolist() == [0, vrw.Outcome.BAD_INPUT, vrw.Outcome.BAD_INPUT]


def test_a_batch_walks_over_its_lines_as_wheels_do_one_by_one():
    n, draw = 4, np.random.default_rng(1)
    slopes = 0.3 + 0.004 * draw.standard_normal((3, n + 1))
    damping, starts = np.array([130.0, 150.0, 170.0]), np.tile(START, (3, 1))
    asked = "slope", "damping", "section_state"

    def one(damping, slope, x):
        walk = vrw.walk(vrw.WheelParams(damping=damping, slope=slope), x, n)
        return walk.steps.section_state[-1]

    for given in (slopes, slopes[:, :n]):
        params = vrw.WheelParams(damping=damping, slope=given)
        found = vrw.step_batch(params, starts, n, derivatives=asked)
        assert found.n_stepped.tolist() == [n] * 3
        assert found.derivatives["slope"].section_state.shape == (3, 3, given.shape[1])
        for i in range(3):
            args = tuple(map(jnp.asarray, (damping[i], given[i], starts[i])))
            np.testing.assert_allclose(found.section_state[i], one(*args), atol=1e-10)
            by = jax.jacfwd(one, (0, 1, 2))(*args)
            for name, reference in zip(("damping", "slope", "section_state"), by, strict=True):
                own = found.derivatives[name].section_state[i]
                np.testing.assert_allclose(own, reference, atol=1e-11)


def test_a_walk_of_places_keeps_its_footholds_and_loses_what_dampers_and_impacts_take():
    other = uneven_ground.walk(OTHER, START, LINES[:4])
    walk = vrw.simulate(vrw.WheelParams(**WHEEL, slope=LINES[:4]), START, 3, options=TIGHT)
    sin, cos = np.sin(LINES[0]), np.cos(LINES[0])
    assert walk.attrs["slopes"] == list(LINES[:4])
    energies = [walk.total_energy.values[walk.step.values == k] for k in range(3)]
    for k, reference in enumerate(other):
        x, z = (walk[name].values[walk.step.values == k] for name in ("foot_1_x", "foot_1_z"))
        assert max(np.ptp(x), np.ptp(z)) == 0.0
        place = x[0] * cos + z[0] * sin, z[0] * cos - x[0] * sin
        np.testing.assert_allclose(place, reference.foothold - other[0].foothold, atol=1e-12)
        lost = reference.lost_damping + reference.lost_stopper
        assert abs(energies[k][0] - energies[k][-1] - lost) < 1e-10
        if k:
            assert abs(energies[k - 1][-1] - energies[k][0] - reference.lost_landing) < 1e-10


def test_rigid_wheels_step_from_line_to_line_by_the_closed_formula():
    half, slopes = np.pi / 8, (0.16, 0.12, 0.15, 0.1, 0.17)
    params = vrw.WheelParams(leg_mass=1e-9, slope=slopes, gravity=1.0)
    walk = vrw.walk(params, (half, 1.0, 0.0), 4, model=vrw.RigidWheel())
    x, rates = 1.0, []
    for line, ahead in itertools.pairwise(slopes):
        first = x * np.cos(2 * half) ** 2 - 2 * (1 - np.cos(half - line))
        x = first + 2 * (1 - np.cos(half + ahead)) if first > 0 else 0.0
        rates.append(np.sqrt(x))
    np.testing.assert_allclose(walk.steps.section_state[:, 1], rates, atol=1e-8)
    assert 0 < int(walk.n_stepped) <= 4


@pytest.mark.parametrize("model", [None, vrw.RigidWheel(), vrw.UnilateralWheel()])
def test_slopes_that_are_not_over_the_steps_are_one_sentence(model):
    params = vrw.WheelParams(slope=LINES[:5])
    sentence = (
        r"slope has shape \(5,\), but a walk of 3 steps of one wheel takes one number, or an a"
    )
    with pytest.raises(ValueError, match=sentence):
        vrw.walk(params, START, 3, model=model)
    with pytest.raises(ValueError, match=sentence):
        vrw.simulate(params, START, 3, model=model)
    with pytest.raises(ValueError, match=r"slope has shape \(5,\), but a step of one wheel takes"):
        vrw.step(params, START, model=model)


def test_frictions_that_are_not_over_the_steps_are_one_sentence():
    model = vrw.UnilateralWheel(friction=jnp.ones(5))
    with pytest.raises(ValueError, match=r"friction has shape \(5,\), but a walk of 3 steps"):
        vrw.walk(vrw.WheelParams(), START, 3, model=model)


# --- With unilateral contact.

SLOPES, FRICTIONS = (0.3, 0.33, 0.27, 0.31), (0.7, 0.5, 0.9, 0.6)


def make_uneven_ground(slopes=SLOPES, frictions=FRICTIONS):
    model = vrw.UnilateralWheel(friction=jnp.asarray(frictions))
    return vrw.WheelParams(slope=jnp.asarray(slopes)), model


def test_each_foot_keeps_the_friction_of_its_landing():
    params, model = make_uneven_ground()
    slope, friction, others, tilt = model.split_ground_by_step(params, 4)
    np.testing.assert_allclose(slope, SLOPES)
    np.testing.assert_allclose(friction, FRICTIONS)
    np.testing.assert_allclose(others, (0.7, 0.7, 0.5, 0.9))
    np.testing.assert_allclose(tilt, (0.03, -0.06, 0.04, 0.0), atol=1e-15)
    slots_of_two_feet, rear = (
        find_contact_slots(jnp.arange(8) < 2),
        find_contact_slots(jnp.arange(8) == 1),
    )
    assert [float(x) for x in select_slot_friction((0.7, 0.5), slots_of_two_feet)] == [0.7, 0.5]
    assert [float(x) for x in select_slot_friction((0.7, 0.5), rear)] == [0.5, 0.5]


def test_a_landing_on_a_steeper_line_is_the_same_motion_in_another_frame():
    s, model = vrw.WheelParams().symbols(), vrw.UnilateralWheel()
    x = model.complete_section_state(vrw.WheelParams(), jnp.asarray(START))
    motion, stance = unpack_section_state(s, x)
    result, turned = (
        pack_section_state(s, motion, stance),
        pack_section_state(s, motion, stance, GroundAhead(jnp.asarray(0.05))),
    )
    assert abs(float(result[0] - turned[0]) - 0.05) < 1e-15
    np.testing.assert_allclose(turned[4:], result[4:])
    frame = np.array([[np.cos(0.05), -np.sin(0.05)], [np.sin(0.05), np.cos(0.05)]])
    np.testing.assert_allclose(turned[2:4], frame @ np.asarray(result[2:4]), atol=1e-15)


STEEP = 0.45
"""Slope of a line ahead on which Leg 2 meets its stopper after the next foot has passed the
continuation of the line of slope 0.3."""


def test_a_steep_line_ahead_is_not_met_before_the_foot_is_there():
    """At the stopper's impact that foot is already below the line on which the wheel stands."""
    slopes, model = jnp.asarray((0.3, STEEP)), vrw.UnilateralWheel(friction=20.0)
    params = vrw.WheelParams(damping=240.0, slope=slopes)
    walk = vrw.walk(params, START, 1, model=model, options=TIGHT)
    wheel = complementarity.ComplementarityWheel(
        np.full(8, 20.0), c=240.0, slope=0.3, tilt=STEEP - 0.3
    )
    other = complementarity.compute_step(wheel, complementarity.paper_start(wheel, *START))
    np.testing.assert_allclose(walk.steps.durations[0], other.durations, atol=1e-9)


LINE_FRICTIONS = (0.7, 0.5, 0.9, 0.6, 0.8, 0.7, 0.65, 0.75, 0.55, 0.85)
"""Friction of the footholds of ten steps; feet slip on the second and on the third."""


def walk_by_complementarity(start, slopes, frictions, **parameters):
    """Return the steps of the second formulation over these lines and footholds."""
    steps, place = [], None
    for k, (slope, ahead) in enumerate(itertools.pairwise(slopes)):
        friction = np.r_[frictions[k], np.full(7, frictions[max(k - 1, 0)])]
        wheel = complementarity.ComplementarityWheel(
            friction, slope=slope, tilt=ahead - slope, **parameters
        )
        place = place or complementarity.paper_start(wheel, *start)
        steps.append(complementarity.compute_step(wheel, place))
        place = steps[-1].end
    return steps


@pytest.mark.slow
def test_ten_steps_with_unilateral_contact_are_those_of_complementarity():
    params, model = make_uneven_ground(LINES, LINE_FRICTIONS)
    walk = vrw.walk(params, START, 10, model=model, options=TIGHT)
    other = walk_by_complementarity(START, LINES, LINE_FRICTIONS)
    assert int(walk.n_stepped) == 10
    durations = np.stack([step.durations for step in other])
    np.testing.assert_allclose(walk.steps.durations, durations, atol=1e-11)
    theta = other[-1].end.q[2] + complementarity.ALPHA
    assert abs(float(walk.steps.section_state[-1, 0]) - theta) < 1e-11
    level = vrw.walk(vrw.WheelParams(), START, 10, model=vrw.UnilateralWheel())
    assert abs(float(jnp.sum(level.steps.durations - walk.steps.durations))) > 1e-3


@pytest.mark.slow
def test_ten_sampled_steps_with_unilateral_contact_are_those_of_complementarity():
    params, model = make_uneven_ground(LINES, LINE_FRICTIONS)
    sampled = vrw.simulate(params, START, 10, model=model, options=TIGHT)
    other = walk_by_complementarity(START, LINES, LINE_FRICTIONS)
    ends = [float(sampled.time.values[sampled.step.values == k][-1]) for k in range(10)]
    exact = np.cumsum([step.durations.sum() for step in other])
    np.testing.assert_allclose(ends, exact, atol=1e-10)


@pytest.mark.slow
def test_ten_steps_of_a_batch_with_unilateral_contact_are_those_of_complementarity():
    params = vrw.WheelParams(slope=np.tile(LINES, (2, 1)))
    model = vrw.UnilateralWheel(friction=np.tile(LINE_FRICTIONS, (2, 1)))
    found = vrw.step_batch(params, np.tile(START, (2, 1)), 10, model=model, options=TIGHT)
    last = walk_by_complementarity(START, LINES, LINE_FRICTIONS)[-1]
    assert found.n_stepped.tolist() == [10, 10]
    np.testing.assert_allclose(found.durations[1], last.durations, atol=1e-11)
    np.testing.assert_allclose(
        found.section_state[1, :2],
        [last.end.q[2] + complementarity.ALPHA, last.end.v[2]],
        atol=1e-11,
    )


UNEVEN_SLOPES = 0.3 + 0.02 * np.array([[0.0, 1.0, -1.0], [1.0, -1.0, 2.0], [-2.0, 0.5, 0.0]])
UNEVEN_FRICTIONS = np.array([[0.7, 0.5, 0.9], [0.6, 0.8, 0.7], [1.0, 0.6, 0.6]])
START_STATES = np.tile((0.1, 1.6, -0.1), (3, 1))


@pytest.mark.slow
@pytest.mark.parametrize("more", [0, 1])
def test_a_batch_on_uneven_ground_equals_single_wheels(more):
    damping, asked = np.array([250.0, 270.0, 300.0]), ("slope", "friction", "damping")
    floors = np.concatenate([UNEVEN_SLOPES, UNEVEN_SLOPES[:, :1]], 1)[:, : 3 + more]
    grounds = np.concatenate([UNEVEN_FRICTIONS, UNEVEN_FRICTIONS[:, :1]], 1)[:, : 3 + more]
    params, ground = vrw.WheelParams(damping=damping, slope=floors), vrw.UnilateralWheel
    batch_result = vrw.step_batch(params, START_STATES, 3, model=ground(friction=grounds))
    moved = vrw.step_batch(
        params, START_STATES, 3, model=ground(friction=grounds), derivatives=asked
    )
    assert batch_result.n_stepped.tolist() == [3, 3, 3]

    def one(slope, friction, damping, **engine):
        wheel, model = vrw.WheelParams(damping=damping, slope=slope), ground(friction=friction)
        return vrw.walk(wheel, START_STATES[0], 3, model=model, **engine).steps

    for i, given in enumerate(zip(floors, grounds, damping, strict=True)):
        given = tuple(map(jnp.asarray, given))
        np.testing.assert_allclose(batch_result.durations[i], one(*given).durations[-1], atol=1e-11)
        by = jax.jacfwd(lambda *given: one(*given).section_state[-1], (0, 1, 2))(*given)
        for name, reference in zip(asked, by, strict=True):
            np.testing.assert_allclose(
                moved.derivatives[name].section_state[i], reference, atol=1e-9
            )
        last_step = one(*given, engine="diffrax")
        np.testing.assert_allclose(batch_result.durations[i], last_step.durations[-1], atol=1e-9)


@pytest.mark.slow
def test_derivatives_with_unilateral_contact_are_differences_of_complementarity():
    """With respect to the start, parameters, every slope and every friction, over three steps."""
    names = {"c": "damping", "k": "stiffness", "Ls": "natural_length", "m": "leg_mass"}
    point = np.array([*START, 250.0, 500.0, 1.02, 1.0, *SLOPES[:3], 0.3, *FRICTIONS[:3]])

    def other(point):
        parameters = dict(zip(names, point[3:7], strict=True))
        last = walk_by_complementarity(point[:3], point[7:11], point[11:], **parameters)[-1]
        motion = last.end.q[2] + complementarity.ALPHA, last.end.v[2]
        return np.concatenate([motion, last.durations])

    def end(point):
        parameters = dict(zip(names.values(), point[3:7], strict=True))
        params = vrw.WheelParams(**parameters, slope=point[7:11])
        model = vrw.UnilateralWheel(friction=point[11:])
        last = vrw.walk(params, point[:3], 3, model=model, options=TIGHT).steps
        return jnp.concatenate([last.section_state[-1, :2], last.durations[-1]])

    exact = np.asarray(jax.jacfwd(end)(jnp.asarray(point)))
    assert (np.abs(exact).max(0) > 1e-3)[:-3].all()
    assert np.abs(exact[:, -3:]).max() > 1e-3  # friction acts where a foot slips
    for j, unit in enumerate(np.eye(len(point))):
        h = 1e-5 * max(abs(point[j]), 1.0)
        difference = (other(point + h * unit) - other(point - h * unit)) / (2 * h)
        # Values have errors of 1e-13, and differences of these steps errors near 1e-8.
        np.testing.assert_allclose(exact[:, j], difference, rtol=1e-6, atol=1e-7, err_msg=str(j))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"n_steps": 4}, r"slope has shape \(3, 3\), but there are 3 states and 4 steps: give one"),
        ({"n_steps": 1}, r"for each and 1 or 2 of each over its steps"),
        ({"params": vrw.WheelParams(damping=[1.0, 2.0])}, r"damping has shape \(2,\), but there"),
        ({"derivatives": ("slope",), "engine": "diffrax"}, "batches with contact need 'lanes'"),
    ],
)
def test_uneven_ground_unsupported_by_batches_is_refused_in_one_sentence(changes, sentence):
    given = {
        "params": vrw.WheelParams(slope=UNEVEN_SLOPES),
        "n_steps": 3,
        "model": vrw.UnilateralWheel(friction=UNEVEN_FRICTIONS),
    }
    with pytest.raises(ValueError, match=sentence):
        vrw.step_batch(states=START_STATES, **given | changes)

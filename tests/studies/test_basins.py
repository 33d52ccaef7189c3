"""Basins: closed forms of the rigid wheel, five coordinates, plain counts, errors, branches."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import five_coordinates
from reference_code import five_coordinates_equations as equations
from reference_code.constrained_wheel import Wheel, run_phase
from support.slow_variants import mark_slow
from support.walkers import (
    BALL_PARAMS,
    BALL_SYSTEM,
    LOGISTIC_A,
    LOGISTIC_BALL,
    LOGISTIC_CYCLE,
    RIMLESS_WHEEL,
    SPOKE_HALF_ANGLE,
    JuggledBall,
)

import vrw_jax as vrw

TABLE_1 = vrw.WheelParams()
GRAVITY, HALF_ANGLE, SLOPE = 9.81, np.pi / 8, 0.1
RIGID = vrw.RigidWheel(stop_at_lift_off=False)
POINT_MASS = vrw.WheelParams(slope=SLOPE, leg_mass=1e-12)
"""A rigid wheel of this kind has all its mass at the hub."""
BOX = {"theta_touchdown": 0.1, "dtheta_touchdown": (0.8, 2.8), "dL1_touchdown": (-0.6, 0.2)}
RATE_BOX = {"theta_touchdown": HALF_ANGLE, "dtheta_touchdown": (0.5, 2.5), "dL1_touchdown": 0.0}


def critical_rate(theta):
    """Return the rate at which a point mass on a rigid leg just reaches the vertical."""
    return np.sqrt(2.0 * GRAVITY * (1.0 - np.cos(theta + SLOPE)))


@pytest.fixture(scope="module")
def smallest():
    return vrw.smallest_disturbance(TABLE_1)


class SquaredOffset(vrw.AbstractWalker):
    """Walker whose step squares the offset from a gait, so that offsets below one decay."""

    coordinates = {"offset": "m"}  # noqa: RUF012

    def advance(self, params, x, options):
        return vrw.AdvanceResult(params["gait"] + (x - params["gait"]) ** 2, jnp.ones(1))


@pytest.mark.parametrize("gait", [0.0, 5.0])
def test_the_share_of_an_own_walker_is_the_width_of_its_basin(gait):
    params, walker = {"gait": gait}, SquaredOffset()
    cycle = vrw.limit_cycle(params, model=walker, guess=[gait + 0.1])
    box = {"offset": (gait - 2.0, gait + 3.0)}
    result = vrw.basin_share(params, box, model=walker, cycle=cycle, n_starts=1000, max_steps=60)
    assert abs(result.share - 2.0 / 5.0) < 3e-3  # points of a Sobol' sequence
    assert result.walking_share[0] == 1.0


def test_an_own_walker_gets_one_sentence_on_what_is_missing():
    walker, cycle = SquaredOffset(), functools.partial(vrw.limit_cycle, {"gait": 0.0}, guess=[0.1])
    with pytest.raises(ValueError, match="it must contain all of offset: give each"):
        vrw.basin_share({"gait": 0.0}, {"x": (0.0, 1.0)}, model=walker, cycle=cycle(model=walker))
    with pytest.raises(ValueError, match="SquaredOffset cannot begin within a step"):
        vrw.smallest_disturbance({"gait": 0.0}, model=walker, cycle=cycle(model=walker))
    with pytest.raises(ValueError, match="guess"):
        vrw.basin_share({"gait": 0.0}, {"offset": (0.0, 1.0)}, model=walker)


@pytest.mark.slow
def test_the_share_of_the_rigid_wheel_is_that_of_its_closed_form():
    # The landing keeps cos(2 half) of the rate, which must then exceed the critical one.
    lowest = critical_rate(-HALF_ANGLE) / np.cos(2.0 * HALF_ANGLE)
    exact = (2.5 - lowest) / 2.0
    share = functools.partial(vrw.basin_share, POINT_MASS, RATE_BOX, model=RIGID, n_starts=1024)
    by_sobol, drawn = share(), share(sampling="random")
    # In one dimension a Sobol' sequence of n points has one of them in each interval of 1/n.
    assert abs(by_sobol.share - exact) <= 2.0 / 1024
    assert abs(drawn.share - exact) <= 3.0 * drawn.share_error
    assert by_sobol.failure_shares == {"FELL_BACK": 1.0 - by_sobol.share}


@pytest.mark.slow
def test_the_share_of_the_papers_wheel_is_that_of_a_larger_count():
    n, n_steps = 16_384, 60
    result = vrw.basin_share(TABLE_1, BOX, n_starts=2048)
    random = np.random.default_rng(7)
    starts = np.stack(
        [np.full(n, 0.1), random.uniform(0.8, 2.8, n), random.uniform(-0.6, 0.2, n)], 1
    )
    walks = vrw.step_batch(TABLE_1, starts, n_steps)
    distance = np.abs(walks.section_state - vrw.limit_cycle(TABLE_1).section_state).max(1)
    counted = np.mean((walks.outcome == vrw.Outcome.STEPPED) & (distance < 1e-4))
    error = np.hypot(result.share_error, np.sqrt(counted * (1.0 - counted) / n))
    assert 0.4 < counted < 0.6
    assert abs(result.share - counted) < 3.0 * error
    for k in (1, 2, 5):
        walking = np.mean(walks.n_stepped >= k)
        assert abs(result.walking_share[k - 1] - walking) < 3.0 * error, k
    total = result.share + result.elsewhere_share + sum(result.failure_shares.values())
    assert abs(total - 1.0) < 1e-12


def test_a_gait_that_is_not_stable_has_no_basin():
    cycle = vrw.limit_cycle(TABLE_1)
    unstable = eqx.tree_at(lambda x: x.monodromy_value, cycle, 1.01 * jnp.eye(2))
    with pytest.raises(ValueError, match=r"spectral radius 1.01, so that it is not stable"):
        vrw.basin_share(TABLE_1, BOX, cycle=unstable)
    with pytest.raises(ValueError, match=r"spectral radius 1.01, so that it is not stable"):
        vrw.smallest_disturbance(TABLE_1, cycle=unstable)


@pytest.mark.slow
def test_errors_of_shares_are_standard_deviations_over_seeds():
    shares = {
        sampling: [
            vrw.basin_share(TABLE_1, BOX, n_starts=256, seed=seed, sampling=sampling)
            for seed in range(24)
        ]
        for sampling in ("random", "sobol")
    }
    error = shares["random"][0].share_error
    deviations = {name: np.std([x.share for x in xs], ddof=1) for name, xs in shares.items()}
    # The standard deviation of 24 draws has a standard error of 15 %.
    assert 0.6 < deviations["random"] / error < 1.5
    assert deviations["sobol"] < 0.8 * error
    fast_starts = RATE_BOX | {"dtheta_touchdown": (2.0, 2.5)}
    certain = vrw.basin_share(POINT_MASS, fast_starts, model=RIGID, n_starts=64)
    assert certain.share == 1.0
    assert certain.share_error > 0.0


def test_starts_after_landing_and_starts_to_which_no_landing_leads():
    box = {"theta_post_impact": (-0.75, -0.6), "dtheta_post_impact": (0.6, 1.4)}
    result = vrw.basin_share(TABLE_1, box, n_starts=256)
    picture = vrw.basin(TABLE_1, {name: np.linspace(*bounds, 16) for name, bounds in box.items()})
    assert abs(result.share - np.mean(picture.attractor.values == 0)) < 4.0 * result.share_error


def test_the_smallest_disturbance_of_the_rigid_wheel_is_its_closed_form():
    result = vrw.smallest_disturbance(POINT_MASS, model=RIGID)
    cycle = vrw.limit_cycle(POINT_MASS, model=RIGID)
    # The energy that a push must take is the same at every instant before the vertical, so that
    # the fastest instant, just after the landing, needs the smallest change of the rate.
    exact = float(cycle.post_impact[1]) - critical_rate(-HALF_ANGLE)
    assert abs(result.size - exact) < max(result.size_error, 1e-9)
    assert result.size_error < 1e-7
    assert (result.time, result.direction) == (0.0, -1)
    assert result.outcome == vrw.Outcome.FELL_BACK
    # Just before the next landing the rate must be the critical one after it.
    last = float(cycle.section_state[1])
    exact = last - critical_rate(-HALF_ANGLE) / np.cos(2.0 * HALF_ANGLE)
    assert abs(result.backward_sizes[-1] / exact - 1.0) < 1e-5
    assert np.isinf(result.forward_sizes).all()


def test_the_smallest_disturbance_of_an_own_walker_is_its_closed_form():
    params = {"slope": 0.2}
    gait = vrw.limit_cycle(params, model=RIMLESS_WHEEL)
    find = functools.partial(vrw.smallest_disturbance, params, model=RIMLESS_WHEEL, cycle=gait)
    result = find(coordinate="rate")
    # The wheel has to reach the vertical, for which it needs the least energy just after an impact.
    potential = GRAVITY * (1.0 - np.cos(0.2 - SPOKE_HALF_ANGLE))
    exact = float(gait.section_state[0]) - np.sqrt(2.0 * potential)
    assert abs(result.size - exact) < max(result.size_error, 1e-9)
    assert result.size_error < 1e-7
    assert (result.time, result.direction) == (0.0, -1)
    assert f"smallest decrease of rate: {exact:.6g} rad/s" in repr(result)
    with pytest.raises(ValueError, match="name one of angle, rate"):
        find()
    with pytest.raises(ValueError, match="walks need 20 steps to arrive: give max_steps=40"):
        find(coordinate="rate", max_steps=10)
    with pytest.raises(ValueError, match="angle"):
        find(coordinate="speed")


def test_the_smallest_disturbance_of_a_gait_of_two_steps_is_in_its_faster_step():
    """The ball does not fly again after an impact at a speed of 1."""
    gait = vrw.limit_cycle({"a": LOGISTIC_A}, model=LOGISTIC_BALL, guess=[0.5], period_n=2)
    result = vrw.smallest_disturbance(
        {"a": LOGISTIC_A}, model=LOGISTIC_BALL, cycle=gait, coordinate="velocity",
        max_size=0.25, max_steps=80,
    )  # fmt: skip
    slow, fast = LOGISTIC_CYCLE
    assert abs(result.size - (1.0 - fast)) < max(result.size_error, 1e-8)
    ends = 2.0 / GRAVITY * np.array([slow, slow + fast])
    assert np.abs(result.time - ends).min() < 1e-9
    assert result.direction == (1 if result.time < ends.mean() else -1)


def test_a_change_beyond_the_guard_of_a_mode_is_no_disturbance():
    """All heights of a bouncing ball lead to its gait, and a ball below the ground is none."""
    find = functools.partial(vrw.smallest_disturbance, BALL_PARAMS, model=BALL_SYSTEM)
    result = find(coordinate="height", max_size=0.1)
    assert np.isinf(result.size)
    assert np.isinf([*result.backward_sizes, *result.forward_sizes]).all()


def finish_by_five_coordinates(params, phase, state):
    """Return how a step ends from a state within a phase, by the second formulation."""
    wheel, length = Wheel(params), params["locked_length"]
    theta, L1, L2, dtheta, dL1, dL2 = map(float, state)
    q = np.array([0.0, 0.0, theta, L1, L2])
    v = np.array([0.0, 0.0, dtheta, dL1, dL2])
    if phase == 0:  # both feet at rest determine the rates of the legs
        jacobian = np.array(equations.jacobian(q, wheel.pack))
        v[3:] = np.linalg.solve(jacobian[2:, 3:], -jacobian[2:, 2] * dtheta)
    events = (
        {
            "takeoff": lambda q, v: float(wheel.acceleration(q, v, "DLS")[1][3]),
            "stopper in DLS": lambda q, v: length - float(q[4]),
        },
        {"stopper": lambda q, v: length - float(q[4])},
        {},
    )
    names, regular = ("DLS", "SLS-I", "SLS-II"), ("takeoff", "stopper", "touchdown")
    for k in range(phase, 3):
        guards = events[k] | {
            "touchdown": lambda q, v: wheel.clearance(q),
            "fell back": lambda q, v: float(v[2]),
        }
        if k == 2 and phase < 2:
            v, _ = wheel.impact(q, v, "SLS-II")
        end = run_phase(wheel, names[k], q, v, guards, rtol=1e-13, atol=1e-14, max_step=1e-2)
        q, v = end.q, end.v
        if end.event != regular[k]:
            return end.event, None
    return "stepped", np.array([q[2], v[2], v[3]])


@pytest.fixture(scope="module")
def gait_step():
    """Return the section state of Table 1's gait and its step in the second formulation."""
    x = np.asarray(vrw.limit_cycle(TABLE_1).section_state)
    return x, five_coordinates.step(five_coordinates.TABLE_1, x)


def state_at_time(step, time):
    """Return the phase and the state (theta, L1, L2 and rates) at a time of a step."""
    for k, phase in enumerate(step["phases"]):
        if time <= phase.duration or k == 2:
            q, v = phase.sample(time)
            return k, np.concatenate([q[2:], v[2:]])
        time -= phase.duration
    raise AssertionError


@pytest.mark.parametrize(
    ("share_of_step", "engine"),
    [
        (0.2, "auto"), (0.7, "auto"), (0.97, "auto"),
        *mark_slow((0.2, "diffrax"), (0.7, "diffrax"), (0.97, "diffrax")),
    ],
)  # fmt: skip
def test_the_rest_of_a_disturbed_step_is_that_of_five_coordinates(gait_step, share_of_step, engine):
    x, step = gait_step
    phase, state = state_at_time(step, share_of_step * step["durations"].sum())
    options = vrw.StepOptions.tight().with_engine(engine)
    for change in (0.0, -0.1, 0.05):
        state[3] += change
        ending, section = finish_by_five_coordinates(five_coordinates.TABLE_1, phase, state)
        found = vrw.ViscoelasticWheel().finish_step(
            TABLE_1, phase, jnp.asarray(step["step_length"]), jnp.asarray(state), options
        )
        assert ending == "stepped"
        np.testing.assert_allclose(found.section_state, section, atol=1e-10)
        if change == 0.0:
            np.testing.assert_allclose(section, x, atol=1e-8)


@pytest.mark.slow
def test_just_below_the_smallest_disturbance_five_coordinates_walk_on(gait_step, smallest):
    x, step = gait_step
    phase, state = state_at_time(step, smallest.time)
    assert phase == smallest.phase_index
    assert smallest.size_error < 1e-3 * smallest.size

    def walk(factor):
        disturbed = state.copy()
        disturbed[3] += smallest.direction * factor * smallest.size
        wheel = five_coordinates.TABLE_1
        ending, section = finish_by_five_coordinates(wheel, phase, disturbed)
        n_steps = 0
        while ending == "stepped" and n_steps < 4:
            result = five_coordinates.step(wheel, section)
            ending, section, n_steps = result["outcome"], result["section_state"], n_steps + 1
        return ending, section

    ending, section = walk(1.0 - 1e-3)
    assert ending == "stepped"
    assert np.abs(section - x).max() < 0.01
    ending, _ = walk(1.0 + 1e-3)
    assert smallest.outcome == vrw.Outcome.TOUCHDOWN_BEFORE_STOPPER
    assert ending in ("touchdown", five_coordinates.TOUCHDOWN_EARLY)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [100.0, 200.0])
def test_no_smaller_disturbance_at_random_instants_leaves_the_basin(damping):
    # At these dampings the smallest disturbances are in SLS-I and in double support.
    params = vrw.WheelParams(damping=damping)
    size = vrw.smallest_disturbance(params).size
    x = np.asarray(vrw.limit_cycle(params).section_state)
    step = five_coordinates.step(five_coordinates.TABLE_1 | {"damping": damping}, x)
    random, n = np.random.default_rng(3), 200
    starts = []
    for time in random.uniform(0.0, step["durations"].sum(), n):
        phase, state = state_at_time(step, time)
        state[3] += 0.99 * size * random.choice([-1.0, 1.0])
        starts.append((phase, state))
    for phase in range(3):
        states = jnp.asarray([state for k, state in starts if k == phase])
        finish = lambda state, k=phase: vrw.ViscoelasticWheel().finish_step(
            params, k, jnp.asarray(step["step_length"]), state, vrw.StepOptions()
        )
        ends = jax.vmap(finish)(states)
        walks = vrw.step_batch(params, np.asarray(ends.section_state), 30)
        assert (walks.outcome == vrw.Outcome.STEPPED).all(), phase


@pytest.mark.slow  # two searches for each of two gaits
def test_basins_along_a_branch_are_those_of_its_wheels():
    branch = vrw.continue_branch(TABLE_1, "damping", (195.0, 200.0))
    basins = vrw.measure_basins(branch, BOX, n_points=2, n_starts=256)
    assert basins.damping.values.tolist() == branch.values[[0, -1]].tolist()
    for i, damping in enumerate(basins.damping.values):
        params = vrw.WheelParams(damping=damping)
        share = vrw.basin_share(params, BOX, n_starts=256)
        # The section states of the branch and of the search differ by 1e-9.
        assert abs(float(basins.basin_share[i]) - share.share) <= 1.0 / 256
        size = vrw.smallest_disturbance(params).size
        assert abs(float(basins.smallest_disturbance[i]) / size - 1.0) < 1e-5
    with pytest.raises(ValueError, match="give the model of the branch"):
        vrw.measure_basins(branch, model=vrw.RigidWheel())


def test_disturbances_along_a_branch_of_an_own_walker_are_their_closed_forms():
    """The pushed wheel has to reach the vertical."""
    gait = vrw.limit_cycle({"slope": 0.2}, model=RIMLESS_WHEEL)
    branch = vrw.continue_branch(
        {"slope": 0.2}, "slope", (0.18, 0.22), model=RIMLESS_WHEEL, cycle=gait
    )
    basins = vrw.measure_basins(branch, model=RIMLESS_WHEEL, n_points=2, coordinate="rate")
    slope = basins.slope.values
    assert slope.tolist() == [0.18, 0.22]
    lowest = np.sqrt(2.0 * GRAVITY * (1.0 - np.cos(slope - SPOKE_HALF_ANGLE)))
    c = np.cos(2.0 * SPOKE_HALF_ANGLE)
    # In a step, gravity adds to the square of the rate, of which the impact leaves the share c^2.
    gain = 2.0 * GRAVITY * (np.cos(slope - SPOKE_HALF_ANGLE) - np.cos(slope + SPOKE_HALF_ANGLE))
    rate = np.sqrt(c**2 * gain / (1.0 - c**2))
    np.testing.assert_allclose(basins.smallest_disturbance, rate - lowest, atol=1e-7)
    assert basins.smallest_disturbance.attrs["units"] == "rad/s"


def test_shares_along_a_branch_of_an_own_walker_are_their_closed_forms():
    """v' = e v + k is positive from v = -k / e on, and walks need log(1e-6) / log(e) steps."""
    walker, box = JuggledBall(), {"velocity": (-3.0, 5.0)}
    branch = vrw.continue_branch(
        BALL_PARAMS, "ball.restitution", (0.5, 0.94), model=walker,
        cycle=vrw.limit_cycle(BALL_PARAMS, model=walker),
    )  # fmt: skip
    basins = vrw.measure_basins(branch, box, model=walker, n_points=3, n_starts=256)
    restitution = basins["ball.restitution"].values
    assert restitution[[0, -1]].tolist() == [0.5, 0.94]
    expected = (5.0 + 1.0 / restitution[:2]) / 8.0
    # Points of a Sobol' sequence are distributed evenly.
    np.testing.assert_allclose(basins.basin_share[:2], expected, atol=1.0 / 256)
    assert np.isnan(basins.basin_share[2])
    measure = functools.partial(vrw.measure_basins, branch, n_points=1)
    with pytest.raises(ValueError, match="there is nothing to measure: give a box"):
        measure(model=walker)
    with pytest.raises(ValueError, match="JuggledBall cannot begin within a step"):
        measure(model=walker, coordinate="velocity")
    with pytest.raises(ValueError, match=r"a walker of yours, but model is Viscoelastic.*branch"):
        measure(box)

    class OtherBall(JuggledBall):
        def advance(self, params, x, options):
            return super().advance(params | {"kick": 2.0}, x, options)

    with pytest.raises(ValueError, match="does not repeat after 1 step with OtherBall"):
        measure(box, model=OtherBall())


def test_a_cycle_of_other_parameters_is_refused_also_where_walks_arrive_at_once():
    params = {"ball": {"restitution": 0.01}, "kick": 1.0}
    cycle = vrw.limit_cycle(params, model=JuggledBall())
    with pytest.raises(ValueError, match="does not repeat after 1 step with JuggledBall"):
        vrw.basin_share(
            params | {"kick": 2.0}, {"velocity": (0.0, 8.0)}, model=JuggledBall(), cycle=cycle
        )


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: vrw.basin_share(TABLE_1, {"theta_touchdown": 0.1}), "must contain all of"),
        (lambda: vrw.basin_share(TABLE_1, BOX | {"dL1_touchdown": (1, 0)}), "dL1_touchdown"),
        (lambda: vrw.basin_share(TABLE_1, BOX, n_starts=0), "n_starts is 0"),
        (lambda: vrw.basin_share(vrw.WheelParams(damping=300.0), BOX), "no gait that could have"),
        (lambda: vrw.smallest_disturbance(TABLE_1, max_size=0.0), "max_size is 0"),
    ],
)
def test_bad_arguments_are_one_sentence(call, sentence):
    with pytest.raises((ValueError, TypeError), match=sentence):
        call()


@pytest.mark.slow
def test_shares_with_unilateral_contact_are_plain_counts():
    params, model = vrw.WheelParams(damping=250.0), vrw.UnilateralWheel(friction=0.7)
    result = vrw.basin_share(params, BOX, model=model, n_starts=128, max_steps=60)
    unit = np.random.default_rng(5).random((256, 2))
    starts = np.column_stack([np.full(256, 0.1), 0.8 + 2.0 * unit[:, 0], -0.6 + 0.8 * unit[:, 1]])
    walks = vrw.step_batch(params, starts, 60, model=model)
    gait = vrw.limit_cycle(params, model=model).section_state
    distance = np.abs(walks.section_state[:, :2] - np.asarray(gait)[:2]).max(1)
    counted = np.mean((walks.outcome == vrw.Outcome.STEPPED) & (distance < 1e-5))
    error = np.hypot(result.share_error, np.sqrt(counted * (1.0 - counted) / 256))
    assert abs(result.share - counted) < 3.0 * error
    with pytest.raises(ValueError, match="UnilateralWheel cannot begin within a step"):
        vrw.smallest_disturbance(params, model=model)


def test_a_cycle_of_another_wheel_is_one_sentence():
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
    with pytest.raises(ValueError, match="give a cycle of the same parameters and model"):
        vrw.basin_share(TABLE_1, BOX, cycle=cycle)


def test_sizes_are_infinite_if_no_tried_disturbance_leaves_the_basin():
    result = vrw.smallest_disturbance(TABLE_1, max_size=0.05)
    assert np.isinf(result.size)
    assert result.size_error == 0.0
    assert result.ending == "No disturbance of the tried sizes leaves the basin."
    assert "largest tried size: 0.05 rad/s" in repr(result)


def test_a_walk_that_has_not_arrived_does_not_count():
    result = vrw.basin_share(TABLE_1, BOX, n_starts=64, max_steps=2)
    assert result.share == 0.0
    assert result.elsewhere_share == result.walking_share[-1] > 0.3

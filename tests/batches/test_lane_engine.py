"""The lane engine gives what the diffrax engine gives, bitwise the same in any company."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import truth
from support.batched import GAIT, IN_TIME, NAMES, PROVOKED, wheels_like

import vrw_jax as vrw
from vrw_jax import Outcome, simd
from vrw_jax.batches import batch as lane_batch
from vrw_jax.batches import programs
from vrw_jax.batches.stiffness import cheapest_solver
from vrw_jax.numerics.march import LanePhase, integrate_lanes
from vrw_jax.numerics.tableaus import (
    Place,
    Slope,
    explicit_tableau,
    real_stability_limit,
    take_step,
)
from vrw_jax.numerics.trig import sine_cosine

STARTS = truth.table("step", "start")
VALUES = np.concatenate([truth.table("step", "section_state"), truth.table("step", "durations")], 1)

FEW_STEPS = vrw.Options(solver="Bosh3", max_solver_steps=60)
"""Too few for a gait at the default tolerances."""


def told(vectors, states, options=None, **keywords):
    """State and durations of each lane, and its outcome."""
    options = vrw.Options() if options is None else options
    found = vrw.steps(truth.wheels(vectors), states, options=options, **keywords)
    return np.concatenate([found.section_state, found.durations], 1), np.asarray(found.outcome)


def hard_starts(n):
    """Wheels and starts of which most fail, some in every way."""
    draw = np.random.default_rng(5).uniform
    vectors = wheels_like(
        damping=draw(20.0, 400.0, n),
        stiffness=draw(50.0, 3000.0, n),
        natural_length=draw(0.95, 1.15, n),
        slope=draw(0.02, 0.5, n),
    )
    return vectors, np.stack([draw(-0.4, 0.4, n), draw(0.3, 6.0, n), draw(-2.0, 1.0, n)], 1)


@pytest.mark.parametrize(
    ("options", "claimed"),
    [(vrw.Options(), 1e-9), (vrw.Options.tight(), 1e-12)],
    ids=["default", "tight"],
)
def test_state_and_durations_are_right_to_the_claimed_error(options, claimed):
    found, outcome = told(truth.PARAMETERS, STARTS, options)
    assert np.all(outcome == Outcome.STEPPED)
    assert truth.scaled_error(found, VALUES) < claimed


def test_hard_starts_end_as_with_the_diffrax_engine():
    vectors, states = hard_starts(512)
    by_lanes, codes = told(vectors, states)
    by_diffrax, expected = told(vectors, states, engine="diffrax")
    np.testing.assert_array_equal(codes, expected)
    assert set(codes) == {0, 1, 2, 3, 5}
    # Both at 1e-10 for each local step.
    np.testing.assert_allclose(by_lanes, by_diffrax, rtol=1e-8, atol=1e-8)
    stepped = codes == Outcome.STEPPED
    np.testing.assert_allclose(by_lanes[stepped], by_diffrax[stepped], rtol=5e-10, atol=5e-10)


def test_each_outcome_is_provoked_side_by_side_and_stays_finite():
    vectors = np.concatenate([v for v, _ in PROVOKED.values()])
    states = np.stack([np.asarray(x) for _, x in PROVOKED.values()])
    found, outcome = told(vectors, states)
    assert [Outcome(code) for code in outcome] == list(PROVOKED)
    assert np.all(np.isfinite(found))
    assert np.all(found[outcome != Outcome.STEPPED, :3] == 0.0)


def test_time_that_runs_out_is_a_code():
    longest = np.max(told(wheels_like(), GAIT[None])[0][0, 3:])
    for share, expected in IN_TIME:
        options = vrw.Options(max_phase_time=share * longest)
        assert told(wheels_like(), GAIT[None], options)[1][0] == expected


def test_a_solver_that_runs_out_of_steps_is_a_code():
    assert told(wheels_like(), GAIT[None], FEW_STEPS)[1][0] == Outcome.SOLVER_GAVE_UP


@pytest.fixture(scope="module")
def crowd():
    """65,536 lanes, the hard ones among them, and what each gives there."""
    vectors, states = hard_starts(65_536)
    vectors[::3], states[::3] = truth.PARAMETERS[0], GAIT
    return vectors, states, *told(vectors, states)


def test_a_lane_alone_is_bitwise_itself_in_a_crowd(crowd):
    vectors, states, found, codes = crowd
    for i in (0, 1, 4, 40_001, 65_534):
        alone, code = told(vectors[i : i + 1], states[i : i + 1])
        np.testing.assert_array_equal(alone[0], found[i])
        assert code[0] == codes[i]


def test_the_order_of_lanes_changes_no_bit(crowd):
    vectors, states, found, codes = crowd
    some = np.random.default_rng(0).permutation(len(states))[:9_000]
    again, code = told(vectors[some], states[some])
    np.testing.assert_array_equal(again, found[some])
    np.testing.assert_array_equal(code, codes[some])


def test_lanes_stand_beside_those_that_take_about_as_long():
    """Eight wait for the slowest of them: for less than half as much as where any stand together,
    and for less than in order of the airborne leg's fast rate alone."""
    n, draw = 1024, np.random.default_rng(2).uniform
    vectors = wheels_like(
        damping=draw(100.0, 215.0, n),
        stiffness=draw(400.0, 600.0, n),
        natural_length=draw(1.01, 1.04, n),
        slope=draw(0.28, 0.34, n),
    )
    states = GAIT * draw(0.95, 1.05, (n, 3))
    tried = np.asarray(vrw.steps(truth.wheels(vectors), states).solver_steps)
    waits = lambda order: tried[order].reshape(-1, 8).max(1).mean() / tried.mean() - 1.0
    ours = waits(lane_batch.work_order(list(vectors.T), states))
    assert ours < 0.5 * waits(np.arange(n))
    assert ours < 0.8 * waits(np.argsort(vectors[:, NAMES.index("damping")]))


def test_what_no_wheel_can_be_has_its_place_in_that_order_too():
    vectors, states = wheels_like(damping=[200.0, np.nan, -1.0, 0.0, 1e300]), np.tile(GAIT, (5, 1))
    states[:, 1] = [1.6, 1e300, np.inf, -1.0, 0.0]
    order = lane_batch.work_order(list(vectors.T), states)
    np.testing.assert_array_equal(np.sort(order), np.arange(5))


COARSE = vrw.Options(solver="Bosh3", max_solver_steps=60, rtol=1e-4, atol=1e-4)
"""A method of few stages, which XLA on a CPU compiles in bearable time."""


@pytest.mark.slow
def test_blocks_of_xla_as_on_a_gpu_go_as_the_machine_code(monkeypatch):
    vectors, states = hard_starts(300)
    found, codes = told(vectors, states, COARSE)
    monkeypatch.setattr(simd, "serves", lambda: False)
    monkeypatch.setattr(programs, "BLOCK", 64)
    monkeypatch.setattr(programs, "FEW", 10**9)  # waits for all
    patient, code = told(vectors, states, COARSE)
    np.testing.assert_array_equal(code, codes)
    # Their step control takes powers that differ in the sixth digit: both keep their tolerance.
    np.testing.assert_allclose(patient, found, rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(programs, "FEW", 2)  # late lanes run again, and change no bit
    again, code = told(vectors, states, COARSE)
    np.testing.assert_array_equal(again, patient)
    np.testing.assert_array_equal(code, codes)


def test_a_walk_goes_as_the_single_wheel_walks_and_ends_at_its_first_failure():
    vectors = wheels_like(slope=[0.30, 0.09], damping=[200.0, 100.0])
    states = np.asarray([GAIT, [0.1027, 2.0, -0.109]])
    found = vrw.steps(truth.wheels(vectors), states, 12)
    assert found.outcome.tolist() == [Outcome.STEPPED, Outcome.FELL_BACK]
    for i in (0, 1):
        single = vrw.walk(truth.wheel(vectors[i]), states[i], 12)
        assert int(found.n_stepped[i]) == int(single.n_stepped)
    last = vrw.walk(truth.wheel(vectors[0]), states[0], 12).steps.section_state[-1]
    np.testing.assert_allclose(found.section_state[0], last, atol=1e-8)


def test_the_engine_is_chosen_by_model_and_solver_and_named():
    params, states = truth.wheels(wheels_like()), GAIT[None]
    assert vrw.steps(params, states).engine == "lanes"
    assert vrw.steps(params, states, engine="diffrax").engine == "diffrax"
    assert (
        vrw.steps(params, np.asarray([[0.39, 1.2, 0.0]]), model=vrw.RigidWheel()).engine
        == "diffrax"
    )
    with pytest.raises(ValueError, match="explicit"):
        vrw.steps(params, states, options=vrw.Options(solver="Kvaerno5"), engine="lanes")


@pytest.mark.parametrize("engine", ["lanes", "collocation"])
def test_results_are_arrays_of_their_own_and_what_was_given_is_left_as_it_was(engine):
    states, near = STARTS.copy(), VALUES[:, 3:].copy()
    params = truth.wheels(truth.PARAMETERS)
    for n_steps in (1, 3):
        found = vrw.steps(params, states, n_steps, engine=engine, durations=near)
        for array in jax.tree.leaves(found):
            assert type(array) is np.ndarray
            array[:] = 0  # its owner may
        np.testing.assert_array_equal(states, STARTS)
        np.testing.assert_array_equal(near, VALUES[:, 3:])
        np.testing.assert_array_equal(params.damping, truth.wheels(truth.PARAMETERS).damping)


def test_what_can_be_seen_to_be_wrong_is_said_in_one_sentence():
    params = vrw.WheelParams()
    with pytest.raises(ValueError, match=r"shape \(lanes, 3\)"):
        vrw.steps(params, GAIT)
    with pytest.raises(ValueError, match="at least 1"):
        vrw.steps(params, GAIT[None], 0)
    with pytest.raises(TypeError, match="vmap"):
        jax.jit(lambda c: vrw.steps(vrw.WheelParams(damping=c), GAIT[None]).outcome)(200.0)


def test_sine_and_cosine_are_right_to_round_off_wherever_a_leg_stands():
    x = jnp.linspace(-0.5 * np.pi, 0.5 * np.pi, 10_001)
    sine, cosine = sine_cosine(x)
    np.testing.assert_allclose(sine, np.sin(x), atol=4e-16)
    np.testing.assert_allclose(cosine, np.cos(x), atol=4e-16)


@pytest.mark.parametrize(("name", "order"), [("Bosh3", 3), ("Tsit5", 5), ("Dopri5", 5)])
def test_a_step_has_the_order_of_its_tableau(name, order):
    """A pendulum with damping: error over one unit of time against the number of steps."""
    tableau = explicit_tableau(name)
    evaluate = lambda q, v: Slope(q[0], q[0], (-jnp.sin(q[0]) - 0.3 * v[0],))

    def end(n):
        q, v = (jnp.ones(1),), (jnp.full(1, 0.5),)
        place = Place(q, v, evaluate(q, v))
        for _ in range(n):
            place = take_step(tableau, evaluate, place, jnp.full(1, 1.0 / n)).end
        return np.concatenate([*place.q, *place.v])

    exact = end(160)
    errors = [np.max(np.abs(end(n) - exact)) for n in (4, 8, 16)]
    slope = -np.polyfit(np.log([4, 8, 16]), np.log(errors), 1)[0]
    assert abs(slope - order) < 0.4


def flown(start, rate, acceleration=1.0, options=None):
    """Guard and duration of a flight with that acceleration; the guard is the height q."""
    options = vrw.Options() if options is None else options
    zero, one = jnp.zeros(8), jnp.ones(8)
    phase = LanePhase(
        lambda q, v: Slope(q[0], q[0], (acceleration * jnp.ones_like(q[0]),)),
        lambda place: (place.q[0],),
    )
    end = integrate_lanes(
        lambda constants, held: phase,
        (),
        (),
        explicit_tableau("Dopri8"),
        (start * one,),
        (rate * one,),
        one > 0.0,
        zero + 5e-3,
        options,
    )
    return end.guard[0], end.duration[0]


def test_a_guard_that_dips_below_zero_within_one_step_is_found():
    # The method is exact here, so that its steps grow until one jumps over the dip at t = 1.
    guard, duration = flown(0.5 - 1e-3, -1.0)
    assert int(guard) == 0
    assert abs(float(duration) - (1.0 - np.sqrt(2e-3))) < 1e-9


HIDDEN = (
    (148.3013863653391, 2132.2128090558417, 1.0474091131253886, 0.11788726197112741, 10.0, 1.0,
     -0.09667196626254448, 5.218855047024207, -0.2280844804497244),
    (23.033715304348473, 2474.251864816427, 1.015561514545714, 0.09191172115965646, 10.0, 1.0,
     0.37613436891360064, 1.7932541094895393, 0.9205137000924628),
    (134.39206145462754, 2258.0532914678806, 1.0596233895151306, 0.09007963482854395, 10.0, 1.0,
     0.3461248827269049, 3.702368426186512, -1.6963747021942828),
    (80.85795575970268, 103.47198084118189, 1.2064556524474823, 0.36074613577047815,
     27.85337176272722, 1.7925506735384338,
     -0.03626980912271838, 9.206751286736072, -3.721317565247718),
)  # fmt: skip
"""Damping, stiffness, natural length, slope, masses of hub and leg, section state: of some twelve
million random lanes those in which a parabola through the guard saw nothing of the force under Leg
1, which dips below zero within a step; in the last it is still below when another guard falls."""


@pytest.mark.parametrize("engine", ["lanes", pytest.param("diffrax", marks=pytest.mark.slow)])
def test_dips_that_one_solver_step_hides_are_found(engine):
    names = "damping", "stiffness", "natural_length", "slope", "hub_mass", "leg_mass"
    columns = np.array(HIDDEN).T
    params = vrw.WheelParams(**dict(zip(names, columns, strict=False)))
    found = vrw.steps(params, columns[6:].T, engine=engine)
    assert np.all(np.asarray(found.outcome) == vrw.Outcome.LEG_1_LIFTED_OFF)
    fine = vrw.Options(solver="Tsit5", first_step=1e-4)  # whose steps are too short to hide any
    truth = vrw.steps(params, columns[6:].T, options=fine)
    np.testing.assert_allclose(found.durations, truth.durations, atol=2e-7)


def test_a_guard_that_comes_close_and_turns_back_does_not_fire():
    guard, duration = flown(0.5 + 1e-3, -1.0, options=vrw.Options(max_phase_time=3.0))
    assert int(guard) == -1
    assert float(duration) >= 3.0


@pytest.mark.parametrize("height", [1e-1, 1e-3, 1e-6, 1e-10])
def test_a_guard_that_rises_from_zero_and_comes_back_within_the_first_step_fires(height):
    guard, duration = flown(0.0, height, -1.0)  # back after 2 height; the first step is 0.005
    assert int(guard) == 0
    assert abs(float(duration) / (2.0 * height) - 1.0) < 1e-13


def test_collocation_is_right_near_known_durations_and_says_which_lanes_it_took():
    near = VALUES[:, 3:] * np.random.default_rng(3).uniform(0.97, 1.03, (len(VALUES), 3))
    params = truth.wheels(truth.PARAMETERS)
    found = vrw.steps(params, STARTS, engine="collocation", durations=near)
    assert found.engine == "collocation"
    fixed = np.asarray(found.fixed)
    assert np.mean(fixed) > 0.5
    by_lanes = vrw.steps(params, STARTS)
    both = np.concatenate([found.section_state, found.durations], 1)
    adaptive = np.concatenate([by_lanes.section_state, by_lanes.durations], 1)
    assert truth.scaled_error(both[fixed], VALUES[fixed]) < 1e-7
    np.testing.assert_array_equal(both[~fixed], adaptive[~fixed])


def test_collocation_leaves_what_it_cannot_trust_to_the_lane_engine(crowd):
    vectors, states, found, codes = crowd
    some = slice(0, 3000)
    guessed = np.tile([0.4, 0.25, 0.06], (3000, 1))
    params = truth.wheels(vectors[some])
    told_by = vrw.steps(params, states[some], engine="collocation", durations=guessed)
    np.testing.assert_array_equal(told_by.outcome, codes[some])
    both = np.concatenate([told_by.section_state, told_by.durations], 1)
    # Far from every gait that its limits were set by, a trusted lane is still right to 1e-6.
    np.testing.assert_allclose(both, found[some], rtol=1e-6, atol=1e-6)


def test_collocation_trusts_no_lane_that_falls_and_errs_most_far_from_a_gait():
    random, n = np.random.default_rng(5), 8192
    of = lambda low, high: random.uniform(low, high, n)
    params = vrw.WheelParams(
        damping=of(5, 400), stiffness=of(200, 1200), natural_length=of(1, 1.06),
        slope=of(0.05, 0.45), leg_mass=of(0.3, 2),
    )  # fmt: skip
    states = random.uniform((-0.05, 0.8, -0.4), (0.2, 2.4, 0.1), (n, 3))
    exact = vrw.steps(params, states, options=vrw.Options(rtol=1e-11, atol=1e-11))
    stepped = (exact.outcome == Outcome.STEPPED) & np.all(exact.durations > 0.0, 1)
    near = np.where(stepped[:, None], exact.durations * random.uniform(0.97, 1.03, (n, 3)), 0.1)
    found = vrw.steps(params, states, engine="collocation", durations=near)
    assert not np.any(found.fixed & (exact.outcome != Outcome.STEPPED))
    fixed = found.fixed & stepped
    assert np.mean(fixed[stepped]) > 0.3
    off = np.abs(np.concatenate(
        [found.section_state - exact.section_state, found.durations - exact.durations], 1
    )).max(1)[fixed]  # fmt: skip
    # Its checks were set by lanes near gaits. Counted in 9,000 others: 5e-7 and 1.2e-5.
    assert np.quantile(off, 0.99) < 1e-6
    assert off.max() < 2e-5


def test_collocation_alone_is_bitwise_itself_among_others():
    params, near = truth.wheels(truth.PARAMETERS), VALUES[:, 3:]
    among = vrw.steps(params, STARTS, engine="collocation", durations=near)
    for i in (0, 3, 9):
        alone = vrw.steps(
            truth.wheels(truth.PARAMETERS[i : i + 1]), STARTS[i : i + 1], engine="collocation",
            durations=near[i : i + 1],
        )  # fmt: skip
        np.testing.assert_array_equal(alone.section_state[0], among.section_state[i])
        np.testing.assert_array_equal(alone.durations[0], among.durations[i])


def test_collocation_needs_durations():
    with pytest.raises(ValueError, match="durations"):
        vrw.steps(vrw.WheelParams(), GAIT[None], engine="collocation")


@pytest.mark.parametrize(("solver", "published"), [("Dopri5", 3.31), ("Bosh3", 2.51)])
def test_limits_of_stability_are_the_published_ones(solver, published):
    tableau = explicit_tableau(solver)
    assert real_stability_limit(tableau) == pytest.approx(published, abs=0.02)


def stiff_wheels(rates):
    """Wheels with legs so light that c/m is one of `rates`, 1/s; their total mass stays."""
    mass = 100.0 / np.asarray(rates)
    return wheels_like(leg_mass=mass, hub_mass=18.0 - 8.0 * mass, damping=100.0)


def test_the_cheapest_solver_takes_each_wheel():
    wheels = stiff_wheels([200.0, 1e3, 1e4, 1e5, 3e5, 1e6, np.nan]).T
    named, stable, implicit = range(3)
    choice = lambda **options: list(cheapest_solver(wheels, vrw.Options(**options)))
    loose = {"rtol": 1e-6, "atol": 1e-6}
    assert choice(**loose) == [named, stable, stable, stable, implicit, implicit, named]
    # Tighter, IMPLICIT costs more; where STABLE would give up Dopri8 does not yet.
    assert choice() == [named, named, stable, stable, named, implicit, named]
    assert choice(solver="Tsit5", **loose) == [named] * 4 + [implicit] * 2 + [named]
    # Of order 3, and farther still for an evaluation: who names it keeps it.
    assert choice(solver="Bosh3", **loose) == [named] * 4 + [implicit] * 2 + [named]


def test_where_stability_limits_the_steps_the_choice_saves_work_and_costs_no_accuracy():
    vectors = stiff_wheels([200.0, 1e3, 1e4])
    starts = np.tile([0.1, 1.6, -0.1], (3, 1))
    exact, _ = told(vectors, starts, vrw.Options.tight(), engine="lanes")
    options = vrw.Options(rtol=1e-6, atol=1e-6)
    found = vrw.steps(truth.wheels(vectors), starts, options=options)
    named = vrw.steps(truth.wheels(vectors), starts, options=options, engine="lanes")
    assert [found.solvers[i] for i in found.solver] == ["Dopri8", "Tsit5", "Tsit5"]
    evaluations = lambda told: (
        np.asarray(told.solver_steps)
        * [len(explicit_tableau(told.solvers[i]).places) - 1 for i in told.solver]
    )
    # The limits of stability over evaluations promise 0.68; accuracy takes some of it back.
    saved = evaluations(found) / evaluations(named)
    assert saved[0] == 1.0
    assert np.all(saved[1:] < 0.68)
    both = [np.concatenate([told.section_state, told.durations], 1) for told in (found, named)]
    error, by_named = (np.max(np.abs(x - exact), 1) for x in both)
    assert np.all(error <= by_named)


def test_wheels_that_several_solvers_take_are_bitwise_themselves_alone():
    vectors = stiff_wheels(np.tile([200.0, 1e4, 1e3], 5))
    starts = np.tile([0.1, 1.6, -0.1], (15, 1)) * np.linspace(1.0, 1.01, 15)[:, None]
    options = vrw.Options(rtol=1e-6, atol=1e-6)
    among, codes = told(vectors, starts, options, n_steps=2)
    assert np.all(codes == Outcome.STEPPED)
    for i in range(4):
        alone, _ = told(vectors[i : i + 1], starts[i : i + 1], options, n_steps=2)
        np.testing.assert_array_equal(alone[0], among[i])


@pytest.mark.slow
def test_wheels_too_stiff_for_an_explicit_solver_go_to_an_implicit_one():
    mass = np.array([1.0, 0.005])  # c/m of 100 and 20,000 1/s
    vectors = wheels_like(leg_mass=mass, hub_mass=18.0 - 8.0 * mass, damping=100.0)
    options = vrw.Options(solver="Tsit5", rtol=1e-6, atol=1e-6, max_solver_steps=300)
    starts = np.tile([0.1, 1.6, -0.1], (2, 1))
    found = vrw.steps(truth.wheels(vectors), starts, options=options)
    assert [found.solvers[i] for i in found.solver] == ["Tsit5", lane_batch.IMPLICIT_SOLVER]
    assert list(found.outcome) == [Outcome.STEPPED, Outcome.STEPPED]
    _, explicit = told(vectors, starts, options, engine="lanes")
    assert list(explicit) == [Outcome.STEPPED, Outcome.SOLVER_GAVE_UP]
    exact, _ = told(vectors, starts, vrw.Options(), engine="lanes")
    np.testing.assert_allclose(found.section_state[1], exact[1, :3], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_stiff_wheel_whose_phase_lasts_longer_than_expected_goes_to_an_implicit_one():
    vectors = wheels_like(damping=[1e4, 1e3])  # the first falls back after 0.69 s: 2,300 steps
    starts = np.tile([0.1, 1.6, -0.1], (2, 1))
    options = vrw.Options(rtol=1e-6, atol=1e-6, max_solver_steps=1000)
    found = vrw.steps(truth.wheels(vectors), starts, options=options)
    solvers = [found.solvers[i] for i in found.solver]
    assert solvers == [lane_batch.IMPLICIT_SOLVER, lane_batch.STABLE_SOLVER]
    assert list(found.outcome) == [Outcome.FELL_BACK, Outcome.FELL_BACK]
    _, code = told(vectors[1:], starts[1:], options)
    assert code[0] == Outcome.FELL_BACK

"""The lane engine gives what the diffrax engine gives, bitwise the same in any company."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference_values
from support.batched import (
    NAMES,
    OUTCOME_CASES,
    TABLE_1_SECTION_STATE,
    TIME_LIMIT_CASES,
    make_parameter_rows,
)
from support.machine_code import disable_machine_code
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax import Outcome, lanes
from vrw_jax.base import compute_sine_cosine
from vrw_jax.flow import integrate_batch_phase
from vrw_jax.flow.solver_steps import (
    BatchPhase,
    StageAccelerations,
    StageState,
    compute_real_stability_limit,
    load_explicit_tableau,
    take_rk_step,
)
from vrw_jax.lanes import lane_function
from vrw_jax.lanes.batching import choose_batch_size
from vrw_jax.models import step_batch
from vrw_jax.models import step_batch as lane_batch
from vrw_jax.models.step_batch import select_cheapest_solver

STARTS = reference_values.stack_quantity("step", "start")
VALUES = np.concatenate(
    [
        reference_values.stack_quantity("step", "section_state"),
        reference_values.stack_quantity("step", "durations"),
    ],
    1,
)

FEW_STEPS_OPTIONS = vrw.StepOptions(solver="Bosh3", max_solver_steps=60)
"""Too few for a gait at the default tolerances."""


def compute_values(parameter_rows, states, options=None, **keywords):
    """State and durations of each lane, and its outcome."""
    options = vrw.StepOptions() if options is None else options
    batch_result = vrw.step_batch(
        reference_values.make_wheels(parameter_rows), states, options=options, **keywords
    )
    return np.concatenate([batch_result.section_state, batch_result.durations], 1), np.asarray(
        batch_result.outcome
    )


def draw_hard_starts(n):
    """Wheels and starts of which most fail, some in every way."""
    draw = np.random.default_rng(5).uniform
    parameter_rows = make_parameter_rows(
        damping=draw(20.0, 400.0, n),
        stiffness=draw(50.0, 3000.0, n),
        natural_length=draw(0.95, 1.15, n),
        slope=draw(0.02, 0.5, n),
    )
    return parameter_rows, np.stack([draw(-0.4, 0.4, n), draw(0.3, 6.0, n), draw(-2.0, 1.0, n)], 1)


@pytest.mark.parametrize(
    ("options", "claimed"),
    [(vrw.StepOptions(), 1e-9), (vrw.StepOptions.tight(), 1e-12)],
    ids=["default", "tight"],
)
def test_batched_state_and_durations_are_accurate_to_the_claimed_error(options, claimed):
    solution, outcome = compute_values(reference_values.REFERENCE_PARAMETERS, STARTS, options)
    assert np.all(outcome == Outcome.STEPPED)
    assert reference_values.compute_scaled_error(solution, VALUES) < claimed


@pytest.mark.slow
def test_hard_starts_have_the_outcomes_of_the_diffrax_engine():
    parameter_rows, states = draw_hard_starts(512)
    by_lanes, codes = compute_values(parameter_rows, states)
    by_diffrax, expected = compute_values(parameter_rows, states, engine="diffrax")
    np.testing.assert_array_equal(codes, expected)
    assert set(codes) == {0, 1, 2, 3, 5}
    # Both at 1e-10 for each local step.
    np.testing.assert_allclose(by_lanes, by_diffrax, rtol=1e-8, atol=1e-8)
    step_result = codes == Outcome.STEPPED
    np.testing.assert_allclose(
        by_lanes[step_result], by_diffrax[step_result], rtol=5e-10, atol=5e-10
    )


def test_each_outcome_occurs_in_one_batch_with_finite_values():
    parameter_rows = np.concatenate([v for v, _ in OUTCOME_CASES.values()])
    states = np.stack([np.asarray(x) for _, x in OUTCOME_CASES.values()])
    solution, outcome = compute_values(parameter_rows, states)
    assert [Outcome(code) for code in outcome] == list(OUTCOME_CASES)
    assert np.all(np.isfinite(solution))
    assert np.all(solution[outcome != Outcome.STEPPED, :3] == 0.0)


def test_reaching_the_time_limit_is_an_outcome_of_a_batch():
    longest = np.max(compute_values(make_parameter_rows(), TABLE_1_SECTION_STATE[None])[0][0, 3:])
    for share, expected in TIME_LIMIT_CASES:
        options = vrw.StepOptions(max_phase_time=share * longest)
        assert (
            compute_values(make_parameter_rows(), TABLE_1_SECTION_STATE[None], options)[1][0]
            == expected
        )


def test_reaching_the_solver_step_limit_is_an_outcome_of_a_batch():
    assert (
        compute_values(make_parameter_rows(), TABLE_1_SECTION_STATE[None], FEW_STEPS_OPTIONS)[1][0]
        == Outcome.SOLVER_FAILED
    )


@pytest.fixture(scope="module")
def hard_batch():
    """65,536 lanes, the hard ones among them, and what each gives there."""
    parameter_rows, states = draw_hard_starts(65_536)
    parameter_rows[::3], states[::3] = (
        reference_values.REFERENCE_PARAMETERS[0],
        TABLE_1_SECTION_STATE,
    )
    return parameter_rows, states, *compute_values(parameter_rows, states)


def test_a_batch_element_is_bitwise_equal_to_the_single_wheel(hard_batch):
    parameter_rows, states, solution, codes = hard_batch
    for i in (0, 1, 4, 40_001, 65_534):
        single_states, code = compute_values(parameter_rows[i : i + 1], states[i : i + 1])
        np.testing.assert_array_equal(single_states[0], solution[i])
        assert code[0] == codes[i]


def test_the_order_of_batch_elements_changes_no_bit(hard_batch):
    parameter_rows, states, solution, codes = hard_batch
    selection = np.random.default_rng(0).permutation(len(states))[:9_000]
    second_states, code = compute_values(parameter_rows[selection], states[selection])
    np.testing.assert_array_equal(second_states, solution[selection])
    np.testing.assert_array_equal(code, codes[selection])


def test_lanes_of_similar_cost_are_grouped():
    """Eight wait for the slowest of them: for less than half as much as where any stand together,
    and for less than in order of the airborne leg's fast rate alone."""
    n, draw = 1024, np.random.default_rng(2).uniform
    parameter_rows = make_parameter_rows(
        damping=draw(100.0, 215.0, n),
        stiffness=draw(400.0, 600.0, n),
        natural_length=draw(1.01, 1.04, n),
        slope=draw(0.28, 0.34, n),
    )
    states = TABLE_1_SECTION_STATE * draw(0.95, 1.05, (n, 3))
    tried = np.asarray(
        vrw.step_batch(reference_values.make_wheels(parameter_rows), states).solver_steps
    )
    waits = lambda order: tried[order].reshape(-1, 8).max(1).mean() / tried.mean() - 1.0
    ours = waits(lane_batch.order_wheels_by_work(list(parameter_rows.T), states))
    assert ours < 0.5 * waits(np.arange(n))
    assert ours < 0.8 * waits(np.argsort(parameter_rows[:, NAMES.index("damping")]))


def test_invalid_wheels_have_a_position_in_that_order():
    parameter_rows, states = (
        make_parameter_rows(damping=[200.0, np.nan, -1.0, 0.0, 1e300]),
        np.tile(TABLE_1_SECTION_STATE, (5, 1)),
    )
    states[:, 1] = [1.6, 1e300, np.inf, -1.0, 0.0]
    order = lane_batch.order_wheels_by_work(list(parameter_rows.T), states)
    np.testing.assert_array_equal(np.sort(order), np.arange(5))


COARSE_OPTIONS = vrw.StepOptions(solver="Bosh3", max_solver_steps=60, rtol=1e-4, atol=1e-4)
"""A method of few stages, which XLA on a CPU compiles in bearable time."""


@pytest.mark.slow
def test_xla_blocks_agree_with_machine_code(monkeypatch):
    parameter_rows, states = draw_hard_starts(300)
    solution, codes = compute_values(parameter_rows, states, COARSE_OPTIONS)
    disable_machine_code(monkeypatch)
    monkeypatch.setattr(step_batch, "XLA_LANE_BATCH_SIZE", 64)
    monkeypatch.setattr(lane_function, "STRAGGLER_COUNT_DIVISOR", 10**9)  # no block stops early
    patient, code = compute_values(parameter_rows, states, COARSE_OPTIONS)
    np.testing.assert_array_equal(code, codes)
    # Their step control takes powers that differ in the sixth digit: both keep their tolerance.
    np.testing.assert_allclose(patient, solution, rtol=1e-4, atol=1e-4)
    monkeypatch.setattr(lane_function, "STRAGGLER_COUNT_DIVISOR", 2)  # stragglers run again
    second_states, code = compute_values(parameter_rows, states, COARSE_OPTIONS)
    np.testing.assert_array_equal(second_states, patient)
    np.testing.assert_array_equal(code, codes)


def test_an_xla_program_without_lanes_returns_empty_arrays(monkeypatch):
    disable_machine_code(monkeypatch)
    program = lanes.compile_batch_function(lambda x, y: (x + y, x > 0.0), 4)
    total, is_positive = program.run(np.empty(0), np.empty(0))
    assert total.shape == is_positive.shape == (0,)
    assert (total.dtype, is_positive.dtype) == (np.dtype(float), np.dtype(bool))


def test_batches_of_gaits_are_larger_on_a_gpu(monkeypatch):
    assert choose_batch_size(64, 4096) == 64
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_batch_size(64, 4096) == 4096
    assert choose_batch_size(10_000, 4096) == 10_000


def test_a_batched_walk_equals_single_walks_and_ends_at_its_first_failure():
    parameter_rows = make_parameter_rows(slope=[0.30, 0.09], damping=[200.0, 100.0])
    states = np.asarray([TABLE_1_SECTION_STATE, [0.1027, 2.0, -0.109]])
    batch_result = vrw.step_batch(reference_values.make_wheels(parameter_rows), states, 12)
    assert batch_result.outcome.tolist() == [Outcome.STEPPED, Outcome.FELL_BACK]
    for i in (0, 1):
        single = vrw.walk(reference_values.make_wheel(parameter_rows[i]), states[i], 12)
        assert int(batch_result.n_stepped[i]) == int(single.n_stepped)
    last = vrw.walk(
        reference_values.make_wheel(parameter_rows[0]), states[0], 12
    ).steps.section_state[-1]
    np.testing.assert_allclose(batch_result.section_state[0], last, atol=1e-8)


@pytest.mark.parametrize("arguments", [{}, {"model": vrw.UnilateralWheel()}], ids=str)
def test_a_batch_without_elements_has_results_of_the_usual_shapes(arguments):
    results = [
        vrw.step_batch(
            vrw.WheelParams(), np.tile(vrw.paper_start(), (n, 1)), derivatives=names, **arguments
        )
        for n in (0, 2)
        for names in ([], ["damping", "section_state"])
    ]
    for empty, full in zip(results[:2], results[2:], strict=True):
        # Results of contact have more entries in a section state.
        if "model" not in arguments:
            assert empty.section_state.shape == (0, 3)
        shapes = [[x.shape[1:] for x in jax.tree.leaves(y)] for y in (empty, full)]
        assert shapes[0] == shapes[1]
        assert len(empty.durations) == 0


def test_results_are_new_arrays_and_arguments_are_not_modified():
    states = STARTS.copy()
    params = reference_values.make_wheels(reference_values.REFERENCE_PARAMETERS)
    for n_steps in (1, 3):
        batch_result = vrw.step_batch(params, states, n_steps)
        for array in jax.tree.leaves(batch_result):
            assert type(array) is np.ndarray
            array[:] = 0  # its owner may
        np.testing.assert_array_equal(states, STARTS)
        np.testing.assert_array_equal(
            params.damping,
            reference_values.make_wheels(reference_values.REFERENCE_PARAMETERS).damping,
        )


def test_invalid_arguments_of_a_batch_are_refused_in_one_sentence():
    params = vrw.WheelParams()
    with pytest.raises(ValueError, match=r"shape \(elements, 3\)"):
        vrw.step_batch(params, TABLE_1_SECTION_STATE)
    with pytest.raises(ValueError, match="at least 1"):
        vrw.step_batch(params, TABLE_1_SECTION_STATE[None], 0)
    with pytest.raises(TypeError, match="vmap"):
        jax.jit(
            lambda c: (
                vrw.step_batch(vrw.WheelParams(damping=c), TABLE_1_SECTION_STATE[None]).outcome
            )
        )(200.0)


def test_sine_and_cosine_are_accurate_to_round_off_at_every_leg_angle():
    x = jnp.linspace(-0.5 * np.pi, 0.5 * np.pi, 10_001)
    sine, cosine = compute_sine_cosine(x)
    np.testing.assert_allclose(sine, np.sin(x), atol=4e-16)
    np.testing.assert_allclose(cosine, np.cos(x), atol=4e-16)


@pytest.mark.parametrize(("name", "order"), [("Bosh3", 3), ("Tsit5", 5), ("Dopri5", 5)])
def test_a_solver_step_has_the_order_of_its_tableau(name, order):
    """A pendulum with damping: error over one unit of time against the number of steps."""
    tableau = load_explicit_tableau(name)
    evaluate = lambda q, v: StageAccelerations(q[0], q[0], (-jnp.sin(q[0]) - 0.3 * v[0],))

    def end(n):
        q, v = (jnp.ones(1),), (jnp.full(1, 0.5),)
        place = StageState(q, v, evaluate(q, v))
        for _ in range(n):
            place = take_rk_step(tableau, evaluate, place, jnp.full(1, 1.0 / n))[-1]
        return np.concatenate([*place.q, *place.v])

    exact = end(160)
    errors = [np.max(np.abs(end(n) - exact)) for n in (4, 8, 16)]
    slope = -np.polyfit(np.log([4, 8, 16]), np.log(errors), 1)[0]
    assert abs(slope - order) < 0.4


def integrate_free_flight(start, rate, acceleration=1.0, options=None):
    """Guard and duration of a flight with that acceleration; the guard is the height q."""
    options = vrw.StepOptions() if options is None else options
    zero, one = jnp.zeros(8), jnp.ones(8)
    phase = BatchPhase(
        lambda q, v: StageAccelerations(q[0], q[0], (acceleration * jnp.ones_like(q[0]),)),
        lambda place: place.q[0][None],
    )
    end = integrate_batch_phase(
        lambda constants, held: phase,
        (),
        (),
        load_explicit_tableau("Dopri8"),
        (start * one,),
        (rate * one,),
        one > 0.0,
        zero + 5e-3,
        options,
    )
    return end.end_guard_index[0], end.duration[0]


def test_a_guard_that_dips_below_zero_within_one_step_is_found():
    # The method is exact here, so that its steps grow until one jumps over the dip at t = 1.
    guard, duration = integrate_free_flight(0.5 - 1e-3, -1.0)
    assert int(guard) == 0
    assert abs(float(duration) - (1.0 - np.sqrt(2e-3))) < 1e-9


HIDDEN_DIPS = (
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


@pytest.mark.parametrize("engine", ["lanes", *mark_slow("diffrax")])
def test_dips_within_one_solver_step_are_found(engine):
    names = "damping", "stiffness", "natural_length", "slope", "hub_mass", "leg_mass"
    columns = np.array(HIDDEN_DIPS).T
    params = vrw.WheelParams(**dict(zip(names, columns, strict=False)))
    batch_result = vrw.step_batch(params, columns[6:].T, engine=engine)
    assert np.all(np.asarray(batch_result.outcome) == vrw.Outcome.LEG_1_LIFTED_OFF)
    fine = vrw.StepOptions(solver="Tsit5", dt0=1e-4)  # whose steps are too short to hide any
    reference = vrw.step_batch(params, columns[6:].T, options=fine)
    np.testing.assert_allclose(batch_result.durations, reference.durations, atol=2e-7)


def test_a_guard_that_comes_close_and_turns_back_does_not_fire():
    guard, duration = integrate_free_flight(
        0.5 + 1e-3, -1.0, options=vrw.StepOptions(max_phase_time=3.0)
    )
    assert int(guard) == -1
    assert float(duration) >= 3.0


@pytest.mark.parametrize("height", [1e-1, 1e-3, 1e-6, 1e-10])
def test_a_guard_that_rises_from_zero_and_comes_back_within_the_first_step_fires(height):
    guard, duration = integrate_free_flight(
        0.0, height, -1.0
    )  # back after 2 height; the first step is 0.005
    assert int(guard) == 0
    assert abs(float(duration) / (2.0 * height) - 1.0) < 1e-13


@pytest.mark.parametrize(("solver", "published"), [("Dopri5", 3.31), ("Bosh3", 2.51)])
def test_stability_limits_equal_the_published_ones(solver, published):
    tableau = load_explicit_tableau(solver)
    assert compute_real_stability_limit(tableau) == pytest.approx(published, abs=0.02)


def make_stiff_wheels(rates):
    """Wheels with legs so light that c/m is one of `rates`, 1/s; their total mass stays."""
    mass = 100.0 / np.asarray(rates)
    return make_parameter_rows(leg_mass=mass, hub_mass=18.0 - 8.0 * mass, damping=100.0)


def test_each_wheel_uses_the_cheapest_solver():
    wheels = make_stiff_wheels([200.0, 1e3, 1e4, 1e5, 3e5, 1e6, np.nan]).T
    named, stable, implicit = range(3)
    choice = lambda **options: list(select_cheapest_solver(wheels, vrw.StepOptions(**options)))
    loose = {"rtol": 1e-6, "atol": 1e-6}
    assert choice(**loose) == [named, stable, stable, stable, implicit, implicit, named]
    # Tighter, IMPLICIT_SOLVER costs more; where STABLE would give up Dopri8 does not yet.
    assert choice() == [named, named, stable, stable, named, implicit, named]
    assert choice(solver="Tsit5", **loose) == [named] * 4 + [implicit] * 2 + [named]
    # Of order 3, and farther still for an evaluation: who names it keeps it.
    assert choice(solver="Bosh3", **loose) == [named] * 4 + [implicit] * 2 + [named]


def test_for_stiff_wheels_the_solver_choice_saves_work_without_losing_accuracy():
    parameter_rows = make_stiff_wheels([200.0, 1e3, 1e4])
    starts = np.tile([0.1, 1.6, -0.1], (3, 1))
    exact, _ = compute_values(parameter_rows, starts, vrw.StepOptions.tight(), engine="lanes")
    options = vrw.StepOptions(rtol=1e-6, atol=1e-6)
    batch_result = vrw.step_batch(
        reference_values.make_wheels(parameter_rows), starts, options=options
    )
    named = vrw.step_batch(
        reference_values.make_wheels(parameter_rows), starts, options=options, engine="lanes"
    )
    assert [batch_result.solver_names[i] for i in batch_result.solver_index] == [
        "Dopri8",
        "Tsit5",
        "Tsit5",
    ]
    evaluations = lambda result: (
        np.asarray(result.solver_steps)
        * [
            len(load_explicit_tableau(result.solver_names[i]).stage_nodes) - 1
            for i in result.solver_index
        ]
    )
    # The limits of stability over evaluations promise 0.68; accuracy takes some of it back.
    saved = evaluations(batch_result) / evaluations(named)
    assert saved[0] == 1.0
    assert np.all(saved[1:] < 0.68)
    states_of_both_runs = [
        np.concatenate([result.section_state, result.durations], 1)
        for result in (batch_result, named)
    ]
    error, by_named = (np.max(np.abs(x - exact), 1) for x in states_of_both_runs)
    assert np.all(error <= by_named)


def test_elements_of_a_batch_with_several_solvers_are_bitwise_those_of_single_wheels():
    parameter_rows = make_stiff_wheels(np.tile([200.0, 1e4, 1e3], 5))
    starts = np.tile([0.1, 1.6, -0.1], (15, 1)) * np.linspace(1.0, 1.01, 15)[:, None]
    options = vrw.StepOptions(rtol=1e-6, atol=1e-6)
    among, codes = compute_values(parameter_rows, starts, options, n_steps=2)
    assert np.all(codes == Outcome.STEPPED)
    for i in range(4):
        single_states, _ = compute_values(
            parameter_rows[i : i + 1], starts[i : i + 1], options, n_steps=2
        )
        np.testing.assert_array_equal(single_states[0], among[i])


@pytest.mark.slow
def test_wheels_too_stiff_for_an_explicit_solver_use_an_implicit_one():
    mass = np.array([1.0, 0.005])  # c/m of 100 and 20,000 1/s
    parameter_rows = make_parameter_rows(leg_mass=mass, hub_mass=18.0 - 8.0 * mass, damping=100.0)
    options = vrw.StepOptions(solver="Tsit5", rtol=1e-6, atol=1e-6, max_solver_steps=300)
    starts = np.tile([0.1, 1.6, -0.1], (2, 1))
    batch_result = vrw.step_batch(
        reference_values.make_wheels(parameter_rows), starts, options=options
    )
    assert [batch_result.solver_names[i] for i in batch_result.solver_index] == [
        "Tsit5",
        lane_batch.IMPLICIT_SOLVER_NAME,
    ]
    assert list(batch_result.outcome) == [Outcome.STEPPED, Outcome.STEPPED]
    _, explicit = compute_values(parameter_rows, starts, options, engine="lanes")
    assert list(explicit) == [Outcome.STEPPED, Outcome.SOLVER_FAILED]
    exact, _ = compute_values(parameter_rows, starts, vrw.StepOptions(), engine="lanes")
    np.testing.assert_allclose(batch_result.section_state[1], exact[1, :3], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_stiff_wheel_with_an_unexpectedly_long_phase_uses_an_implicit_solver():
    parameter_rows = make_parameter_rows(
        damping=[1e4, 1e3]
    )  # the first falls back after 0.69 s: 2,300 steps
    starts = np.tile([0.1, 1.6, -0.1], (2, 1))
    options = vrw.StepOptions(rtol=1e-6, atol=1e-6, max_solver_steps=1000)
    batch_result = vrw.step_batch(
        reference_values.make_wheels(parameter_rows), starts, options=options
    )
    solvers = [batch_result.solver_names[i] for i in batch_result.solver_index]
    assert solvers == [
        lane_batch.IMPLICIT_SOLVER_NAME,
        lane_batch.STABLE_SOLVER_NAME,
    ]
    assert list(batch_result.outcome) == [Outcome.FELL_BACK, Outcome.FELL_BACK]
    _, code = compute_values(parameter_rows[1:], starts[1:], options)
    assert code[0] == Outcome.FELL_BACK


@pytest.mark.slow
def test_a_wheel_too_stiff_for_derivatives_gets_a_code_and_zeros():
    """Reference: the codes of the values, and the derivatives of the other wheels alone."""
    params = vrw.WheelParams(
        damping=np.array([200.0, 1e5, 180.0]), leg_mass=np.array([1.0, 1e-2, 1.0])
    )
    starts, names = np.tile(vrw.paper_start(), (3, 1)), ("section_state", "damping")
    result = vrw.step_batch(params, starts, derivatives=names)
    np.testing.assert_array_equal(result.outcome, vrw.step_batch(params, starts).outcome)
    assert result.outcome.tolist() == [Outcome.STEPPED, Outcome.FELL_BACK, Outcome.STEPPED]
    alone = jax.tree.map(lambda x: x[::2] if jnp.ndim(x) else x, params)
    expected = vrw.step_batch(alone, starts[::2], derivatives=names)
    for name in names:
        columns = result.derivatives[name].section_state
        np.testing.assert_array_equal(columns[::2], expected.derivatives[name].section_state)
        assert not columns[1].any()

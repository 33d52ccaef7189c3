"""The code in docs/wheel.html is compiled from the library's step, and returns the same numbers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import mark_slow
from support.web_code import PAGE_PATH, PageCode

import vrw_jax as vrw
from experiments.web.build import list_output_rows
from vrw_jax.wheel import PARAMETER_NAMES

pytestmark = pytest.mark.slow
SAME_TOLERANCE = 1e-9
"""Difference of digits over their scale."""
RANGES = {
    "hub_mass": (2.0, 20.0), "leg_mass": (0.5, 2.0), "leg_com": (0.1, 0.6),
    "locked_length": (0.8, 1.2), "natural_length": (0.8, 1.3), "stiffness": (200.0, 1500.0),
    "damping": (20.0, 400.0), "slope": (0.05, 0.6), "gravity": (2.0, 20.0),
}  # fmt: skip
EPS, ROUNDOFF_GROWTH_FACTOR = np.finfo(float).eps, 4.0
"""A last bit; and how much more rounding at each of up to 9000 solver's steps may do than one."""
STARTS = (-0.3, 0.5), (0.3, 4.0), (-1.0, 0.3)


@pytest.fixture(scope="module", autouse=True)
def _started():
    pytest.importorskip("wasmtime", reason="wasmtime runs the page's code here")


@functools.cache
def make_page_code(n_legs):
    return PageCode(n_legs)


def draw_wheels(n):
    """Return wheels and starts of wide ranges; half of the starts are near Table 1's gait."""
    random = np.random.default_rng(7)
    draw = lambda ranges: np.stack([random.uniform(*limits, n) for limits in ranges])
    wheels, starts = draw(RANGES.values()), draw(STARTS)
    default = np.array([float(getattr(vrw.WheelParams(), x)) for x in PARAMETER_NAMES])
    near = np.arange(n) % 2 == 0
    spread = 1.0 + 0.05 * (random.random((9, n)) - 0.5)
    wheels = np.where(near, default[:, None] * spread, wheels)
    gait = np.array([0.096, 1.61, -0.09])[:, None] * (1.0 + 0.2 * (random.random((3, n)) - 0.5))
    return wheels, np.where(near, gait, starts)


def make_wheels(columns, n_legs):
    return vrw.WheelParams(
        **dict(zip(PARAMETER_NAMES, jnp.asarray(columns), strict=True)), n_legs=n_legs
    )


def compute_relative_difference(solution, expected, scale):
    return np.max(np.abs(solution - expected) / (scale + np.abs(expected)))


def assert_same_steps(n, n_legs):
    wheels, starts = draw_wheels(n)
    tolerance = float(vrw.StepOptions().rtol)
    rows = [((6,), np.float64), ((2,), np.int32), ((3, 6), np.float64)]
    given = [tolerance, n_legs], [wheels, starts]
    numbers, codes, _ = make_page_code(n_legs)("linearised", *given, rows)
    steps = vrw.step_batch(make_wheels(wheels, n_legs), starts.T)
    values_array = np.asarray(steps.solver_index == 0)  # stiff legs go to other solvers there
    assert np.mean(values_array) > 0.9
    expected = np.concatenate([steps.section_state.T, steps.durations.T])
    others = np.flatnonzero(values_array & (codes[0] != steps.outcome))
    assert len(others) <= n / 3000  # counted: 2 of 10,000 with six legs, which stand on two feet
    assert np.all(np.minimum(numbers, expected)[3, others] > 5.0)  # until rounding, s, lets them go
    assert len(np.unique(codes[0])) > 4  # of many outcomes
    # When an integrator fails, sees that the time is over, or sees that the wheel is at rest is no
    # property of the wheel.
    limits = [
        vrw.Outcome.SOLVER_FAILED, vrw.Outcome.NO_TOUCHDOWN_IN_TIME, vrw.Outcome.CAME_TO_REST
    ]  # fmt: skip
    values_array = values_array & ~np.isin(codes[0], [int(code) for code in limits])
    values_array[others] = False
    assert (
        compute_relative_difference(numbers[:, values_array], expected[:, values_array], 1.0)
        < SAME_TOLERANCE
    )


@pytest.mark.parametrize(("n", "n_legs"), [(1000, 8), (200, 6), (200, 10)])
def test_steps_and_outcomes_of_the_page_equal_the_librarys(n, n_legs):
    assert_same_steps(n, n_legs)


@pytest.mark.slow
@pytest.mark.parametrize("n_legs", [6, 8, 10])
def test_steps_of_ten_thousand_wheels_equal_the_librarys(n_legs):
    assert_same_steps(10_000, n_legs)


def test_jacobians_of_the_page_equal_the_librarys():
    wheels, starts = draw_wheels(400)
    options = vrw.StepOptions()
    rows = [((6,), np.float64), ((2,), np.int32), ((3, 6), np.float64)]
    tolerance = float(options.with_derivative_tolerances().rtol)
    _, codes, columns = make_page_code(8)("linearised", [tolerance, 8.0], [wheels, starts], rows)
    steps = vrw.step_batch(make_wheels(wheels, 8), starts.T, derivatives="section_state")
    by_input = steps.derivatives["section_state"]
    expected = np.concatenate(
        [by_input.section_state, by_input.durations], 1
    ).T  # by the start, first axis
    values_array = np.asarray((steps.outcome == 0) & (steps.solver_index == 0))
    assert np.array_equal(codes[0] == 0, steps.outcome == 0)
    scale = np.max(np.abs(expected), axis=(0, 1))
    assert (
        compute_relative_difference(
            columns[..., values_array], expected[..., values_array], scale[values_array]
        )
        < SAME_TOLERANCE
    )


def test_all_measures_of_a_step_equal_the_librarys():
    n = 200
    wheels, starts = draw_wheels(n)
    rows, samples = list_output_rows(8), make_page_code(8).facts["samples"]
    assert rows == make_page_code(8).facts["rows"]["8"]
    result_list = [((len(rows),), np.float64), ((2,), np.int32), *[((13, samples), np.float64)] * 3]
    numbers, codes, *motion = make_page_code(8)("told", [1e-10, 0.9], [wheels, starts], result_list)
    step = jax.vmap(functools.partial(vrw.step, model=vrw.ViscoelasticWheel(friction=0.9)))
    expected = step(make_wheels(wheels, 8), jnp.asarray(starts.T))
    assert np.array_equal(codes[0], expected.outcome)
    measures = expected.measures()
    for name, row in zip(rows, numbers, strict=True):
        base, _, leg = name.partition("[")
        values_array = np.asarray(measures[base])
        values_array = values_array[:, int(leg[:-1]) - 3] if leg else values_array
        # As a foot unloads the friction that it needs grows without bound.
        bounded = codes[0] != vrw.Outcome.LEG_1_LIFTED_OFF
        assert (
            compute_relative_difference(row[bounded], values_array[bounded], 1.0) < SAME_TOLERANCE
        ), name
    one = int(np.flatnonzero(codes[0] == 0)[0])
    trajectory = vrw.simulate(
        make_wheels(wheels[:, one], 8), starts[:, one], n_steps=1, n_samples=samples
    )
    names = ("theta", "L1", "L2", "dtheta", "dL1", "dL2", "lambda_1", "lambda_2", "lambda_3",
             "lambda_4", "kinetic_energy", "gravitational_energy", "elastic_energy")  # fmt: skip
    for i, name in enumerate(names):
        joined_values = np.concatenate([phase[i, :, one] for phase in motion])
        assert (
            compute_relative_difference(joined_values, trajectory[name].values, 1.0)
            < SAME_TOLERANCE
        ), name


@pytest.mark.parametrize("n_legs", [8, *mark_slow(6, 10)])
def test_a_step_on_rigid_legs_equals_the_librarys(n_legs):
    """Values, its slope, and all that it tells."""
    n, model = 300, vrw.RigidWheel(friction=0.9)
    wheels, starts = draw_wheels(n)
    starts[0] = np.pi / n_legs
    facts, rows = make_page_code(n_legs).facts, list_output_rows(n_legs)
    result_list = [
        ((len(rows),), np.float64),
        ((2,), np.int32),
        ((14, facts["samples"]), np.float64),
    ]
    numbers, codes, motion = make_page_code(n_legs)(
        "rigid_told", [0.0, 0.9], [wheels, starts], result_list
    )
    step = jax.vmap(functools.partial(vrw.step, model=model))
    expected = step(make_wheels(wheels, n_legs), jnp.asarray(starts.T))
    assert np.array_equal(codes[0], expected.outcome)
    assert len(np.unique(codes[0])) > 2
    measures = expected.measures()
    for name, row in zip(rows, numbers, strict=True):
        base, _, leg = name.partition("[")
        values_array = np.asarray(measures[base])
        values_array = values_array[:, int(leg[:-1]) - 3] if leg else values_array
        assert compute_relative_difference(row, values_array, 1.0) < SAME_TOLERANCE, name
    one = int(np.flatnonzero(codes[0] == 0)[0])
    params = make_wheels(wheels[:, one], n_legs)
    trajectory = vrw.simulate(
        params, starts[:, one], n_steps=1, n_samples=facts["samples"], model=model
    )
    for name, row in (("theta", 0), ("lambda_1", 6), ("kinetic_energy", 10), ("time", 13)):
        solution = motion[row, :, one]
        assert (
            compute_relative_difference(solution, trajectory[name].values[-len(solution) :], 1.0)
            < SAME_TOLERANCE
        ), name
    result_list = [((6,), np.float64), ((2,), np.int32), ((3, 6), np.float64)]
    _, _, columns = make_page_code(n_legs)("rigid_linearised", [0.0], [wheels, starts], result_list)
    by_input = jax.jacfwd(lambda x: vrw.return_map(params, x, model=model))(
        jnp.asarray(starts[:, one])
    )
    assert compute_relative_difference(columns[1, 1, one], by_input[1, 1], 1.0) < SAME_TOLERANCE


def test_the_page_is_one_file_below_a_megabyte_that_fetches_nothing():
    page = PAGE_PATH.read_text(encoding="utf-8")
    assert len(page.encode()) <= 1_000_000
    for module in make_page_code(8).modules:
        assert set(module.imports) <= {"sin", "cos", "exp", "log"}  # what a browser's Math lends
    for word in ("<link", "src=", "@import", "fetch(", "XMLHttpRequest", "import("):
        assert word not in page, word


def test_unilateral_steps_equal_the_librarys():
    assert_same_unilateral_steps(300, 8)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "n_legs"), [(300, 6), (300, 10), (10_000, 8)])
def test_unilateral_steps_of_ten_thousand_wheels_equal_the_librarys(n, n_legs):
    assert_same_unilateral_steps(n, n_legs)


def compute_page_steps(n_legs, friction, wheels, state, stretches=None):
    """Return steps computed as the page does, from event to event until all wheels finish."""
    page, given = make_page_code(n_legs), [float(vrw.StepOptions().rtol), friction]
    form = page.facts["ground"][str(n_legs)]
    rows = [form["lane"], 7 + 4 * n_legs, form["section"] + len(page.facts["groundTold"])]
    result_list = [((n,), np.float64) for n in rows]
    [lane] = page("ground_opened", given, [wheels, state], result_list[:1])
    numbers, outcome = np.zeros((rows[-1], state.shape[1])), np.full(state.shape[1], -1)
    while len(under_way := np.flatnonzero(outcome == -1)):
        lane, stretch, numbers[:, under_way], outcome[under_way] = page(
            "ground_onward", given, [wheels[:, under_way], lane], [*result_list, ((), np.int32)]
        )
        goes_on = outcome[under_way] == -1
        lane = lane[:, goes_on]
        if stretches is not None:
            stretches.append(np.zeros((rows[1], len(outcome))))  # an ended lane has no more
            stretches[-1][:, under_way[goes_on]] = stretch[:, goes_on]
    return numbers, outcome


def is_standing(params, model, x):
    """Whether a wheel comes to rest, by the library alone: at some tolerance it stands on two feet
    for five seconds. The sign of its speed is rounding, and so is whether it then falls back."""
    tolerances = (vrw.StepOptions(rtol=10.0**k, atol=10.0**k) for k in range(-13, -7))
    walks = (vrw.step_batch(params, x, model=model, options=options) for options in tolerances)
    return any(float(walk.durations[0, 0]) > 5.0 for walk in walks)


def assert_same_unilateral_steps(n, n_legs):
    """Two steps from the paper's states, of feet that slide and of feet that hold."""
    wheels, starts = draw_wheels(n)
    starts[0] %= np.pi / n_legs  # else a foot begins below the ground or a leg beyond its stopper
    size, friction = 4 + 3 * n_legs, 0.9
    model = vrw.UnilateralWheel(friction=friction)
    [state] = make_page_code(n_legs)("ground_begun", [], [wheels, starts], [((size,), np.float64)])

    def both(wheels, state):
        """Return numbers and outcomes of the page, then those of the library."""
        numbers, codes = compute_page_steps(n_legs, friction, wheels, state)
        steps = vrw.step_batch(make_wheels(wheels, n_legs), state.T, model=model)
        known_values_2 = np.concatenate([steps.section_state, steps.durations], 1).T
        return numbers[: size + 3], codes, known_values_2, np.asarray(steps.outcome)

    for _ in range(2):
        numbers, outcome, known_values, expected = both(wheels, state)
        is_active = outcome == 0
        assert np.sum(is_active) > n / 20
        assert len(np.unique(outcome)) > 1
        separated_values = np.max(np.abs(numbers - known_values) / (1.0 + np.abs(known_values)), 0)
        others = np.flatnonzero(
            (outcome != expected) | (is_active & (separated_values > SAME_TOLERANCE))
        )
        assert len(others) <= max(4, n / 250)  # counted: 28 of 19,644
        for i in others:  # steps of hundreds of events: a start's last bit moves both about so far
            near = np.repeat(state[:, i : i + 1], 64, 1)
            near[:4] *= 1.0 + EPS * np.random.default_rng(i).integers(-1, 2, (4, 64))
            page_states, ends, library_states, known_ends = both(
                np.repeat(wheels[:, i : i + 1], 64, 1), near
            )
            if outcome[i] not in known_ends:
                assert is_standing(
                    make_wheels(wheels[:, i : i + 1], n_legs), model, state[:, i : i + 1].T
                )
            if is_active[i] and expected[i] == 0:
                spread = np.ptp(page_states[:, ends == 0], 1) + np.ptp(
                    library_states[:, known_ends == 0], 1
                )
                assert np.all(
                    np.abs(numbers - known_values)[:, i]
                    <= ROUNDOFF_GROWTH_FACTOR * spread + SAME_TOLERANCE
                )
        wheels, state = wheels[:, is_active], numbers[:size, is_active]


def test_all_measures_of_a_unilateral_step_equal_the_librarys():
    """Measures, and of one wheel the motion from event to event."""
    n, n_legs, friction = 60, 8, 0.7
    wheels, starts = (
        columns[:, ::2] for columns in draw_wheels(2 * n)
    )  # those near Table 1's gait
    page, model, stretches = make_page_code(n_legs), vrw.UnilateralWheel(friction=friction), []
    size, samples = 4 + 3 * n_legs, page.facts["samples"]
    [state] = page("ground_begun", [], [wheels, starts], [((size,), np.float64)])
    numbers, codes = compute_page_steps(n_legs, friction, wheels, state, stretches)
    step = jax.vmap(functools.partial(vrw.step, model=model))
    expected = step(make_wheels(wheels, n_legs), jnp.asarray(starts.T))
    assert np.array_equal(codes, expected.outcome)
    known_values = expected.measures()
    for name, row in zip(page.facts["groundTold"], numbers[size:], strict=True):
        assert (
            compute_relative_difference(
                row[codes == 0], np.asarray(known_values[name])[codes == 0], 1.0
            )
            < SAME_TOLERANCE
        ), name

    one, shape = int(np.flatnonzero(codes == 0)[0]), (3 + n_legs + 7, samples)
    result, motion = [(shape, np.float64)], []
    for stretch in stretches:
        if stretch[-1, one] > 0.0:
            given = [float(vrw.StepOptions().rtol), friction], [wheels[:, [one]], stretch[:, [one]]]
            motion.append(page("ground_between", *given, result)[0][..., 0])
    params = make_wheels(wheels[:, one], n_legs)
    trajectory = vrw.simulate(params, starts[:, one], n_steps=1, n_samples=samples, model=model)
    rows = np.concatenate(motion, 1)
    assert rows.shape[1] == len(trajectory["time"])
    names = "hub_x", "hub_z", "theta", *["length"] * n_legs
    for i, name in enumerate(names):
        variable_values = trajectory[name].values
        assert (
            compute_relative_difference(
                rows[i],
                variable_values[:, i - 3] if variable_values.ndim == 2 else variable_values,
                1.0,
            )
            < SAME_TOLERANCE
        ), name
    for i, name in enumerate(("normal", "tangential")):  # of the two feet that may be loaded
        solution = rows[3 + n_legs + 2 * i :][:2].sum(0)
        assert (
            compute_relative_difference(solution, trajectory[name].values.sum(1), 1.0)
            < 10 * SAME_TOLERANCE
        ), name
    for i, name in enumerate(("kinetic_energy", "gravitational_energy", "elastic_energy")):
        assert (
            compute_relative_difference(rows[7 + n_legs + i], trajectory[name].values, 1.0)
            < SAME_TOLERANCE
        ), name

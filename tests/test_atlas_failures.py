"""The page of failures lists every case, and the library returns no wrong result without a code."""

import csv
import importlib
import math
from pathlib import Path

import numpy as np
import pytest
from mpmath import mp, mpf

pytest.importorskip("heyoka", exc_type=ImportError)

from experiments.atlas import failures, many_digits
from experiments.atlas.hybrid import METHODS, GuardEdge, Part, last_time, run_library, run_scipy
from experiments.atlas.results import Row

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
FAILURE_TABLE = list(csv.DictReader((ROOT / "docs" / "figures" / "atlas_failures.csv").open()))
ORIGINS = list(csv.reader((ROOT / "docs" / "figures" / "atlas_failure_origins.csv").open()))


def import_atlas_module(name):
    return importlib.import_module(f"experiments.atlas.cases.{name}")


@pytest.mark.parametrize("name", failures.NAMES)
def test_a_case_has_a_reference_rows_a_figure_and_a_section_of_the_page(name):
    case = import_atlas_module(name).CASE
    assert all((case.title, case.breaks, case.reference, case.source))
    assert any(row["case"] == name for row in FAILURE_TABLE)
    assert (ROOT / "docs" / "figures" / f"failure_{name}.png").exists()
    problems = failures.PROBLEMS.read_text()
    assert f"## {case.title}\n" in problems
    assert f"](../figures/failure_{name}.svg)" in problems
    assert [case.title, case.reference, case.source] in ORIGINS
    assert f"](hybrid_problems.md#{failures.anchor(case.title)})" in failures.OVERVIEW.read_text()


def test_there_are_at_least_ten_cases_and_this_library_is_never_silently_wrong():
    assert len(failures.NAMES) >= 10
    assert {row["case"] for row in FAILURE_TABLE} == set(failures.NAMES)
    mine = [row for row in FAILURE_TABLE if row["method"].startswith("ours")]
    assert not [row for row in mine if row["verdict"].startswith("WRONG")]
    assert {"diffrax", "SciPy", "heyoka"} <= {row["method"] for row in FAILURE_TABLE}
    assert all(row["version"] and row["options"] for row in FAILURE_TABLE)


def test_all_methods_ran_together_and_this_library_is_within_1e_12_times_the_condition():
    assert len({(row["case"], row["run"]) for row in FAILURE_TABLE}) == len(failures.NAMES)
    mine = failures.select_exact_rows(FAILURE_TABLE)
    assert len(mine) > 20
    assert max(float(row["error"]) / float(row["condition"]) for row in mine) <= 1e-12


def test_event_times_of_this_library_are_within_their_stated_errors():
    """Include the implicit solver; an error above 1e-12 is stored as "time to", and may be
    infinite."""
    timed = ("time", "dip", "switching", "event", "touch", "period", "first impact", "end of the")
    mine = [row for row in FAILURE_TABLE if row["method"].startswith("ours") and not row["digits"]]
    inexact_rows = [
        row
        for row in mine
        if row["quantity"].startswith(timed) and row["error"] != "-" and float(row["error"]) > 1e-12
    ]
    assert {"grazing", "tangent_guards", "two_states"} <= {row["case"] for row in inexact_rows}
    for row in inexact_rows:
        assert float(row["error"]) <= float(row["says"].split(",")[0].removeprefix("time to "))


def test_event_times_are_within_1e_12_or_within_the_reported_tolerance():
    times = [
        row
        for row in failures.select_exact_rows(FAILURE_TABLE)
        if row["quantity"].startswith(("time", "dip"))
    ]
    inexact_rows = [row for row in times if float(row["error"]) > 1e-12]
    assert {row["case"] for row in inexact_rows} <= {"grazing", "tangent_guards"}
    for row in inexact_rows:
        stated, *rounding = (float(part.split(" ")[-1]) for part in row["says"].split(", "))
        assert float(row["error"]) <= stated
        # Asked for as finely as can be it is within roundings of the start.
        assert "1e-15" not in row["options"] or float(row["error"]) <= rounding[0]


def test_every_multiplier_with_a_closed_form_is_within_1e_12():
    mine = [
        row for row in failures.select_exact_rows(FAILURE_TABLE) if "multiplier" in row["quantity"]
    ]
    assert {"grazing", "resonant_grazing", "few_segments"} <= {row["case"] for row in mine}
    assert max(float(row["error"]) for row in mine) <= 1e-12


def test_a_verdict_requires_an_accurate_result_or_a_reported_failure():
    row = Row("q", "m", 1.0, 2.0, 1.0, "", False, 1, 0.0, "o", "v")
    assert row.verdict == "WRONG, silently"
    assert row._replace(admits=True).verdict == "says so"
    assert row._replace(error=1e-12, admits=True).verdict == "right"
    assert row._replace(error=math.inf).verdict == "WRONG, silently"
    assert row._replace(error=4e-6).verdict == "WRONG, silently"
    assert row._replace(error=4e-6, digits=5).verdict == "right"
    assert row._replace(error=4e-6, condition=1e7).verdict == "right"
    assert row._replace(error=4e-6, options="Radau 1e-7, 3 stages").verdict == "right"
    assert row._replace(error=4e-6, options="Taylor, 2.2e-16").verdict == "WRONG, silently"


@pytest.mark.parametrize("method", METHODS)
def test_every_method_simulates_the_same_definition_of_a_system(method):
    ball = import_atlas_module("bouncing_ball")
    walk_result = method(ball.BALL, (1.0, 0.0), 3, 10.0)
    np.testing.assert_allclose(walk_result.times, ball.times(3), rtol=1e-11)
    assert not walk_result.says


def test_a_method_that_finds_no_event_does_not_report_a_failure():
    never = (Part(lambda y, m: (1.0 + 0.0 * y[0],), (GuardEdge(lambda y, m: 1.0 + y[0]),)),)
    for method in (run_library, run_scipy):
        walk_result = method(never, (0.0,), 1, 2.0)
        assert walk_result.says
        assert not walk_result.admits
        assert math.isnan(last_time(walk_result, 1))


@pytest.mark.parametrize(
    ("name", "system", "start", "reference"),
    [
        ("pinned_pendulum", "SYSTEM", "START", lambda m: m.reference(3)),
        ("singular_field", "QUESTIONS", (1.0,), lambda m: [m.QUESTIONS[0][2]]),
        ("grazing", "make_stopped_oscillator", None, lambda m: [m.compute_touch_time(m.W, 1e-4)]),
        ("tangent_guards", "circle", (1.0, 0.0, 0.0), lambda m: [m.entry(1e-4)]),
    ],
)
def test_event_times_are_within_1e_12_of_their_closed_forms(name, system, start, reference):
    case = import_atlas_module(name)
    created = getattr(case, system)
    if name == "singular_field":
        created = created[0][1]
    if name == "grazing":
        created, start = created(case.W), (-1.0001, 0.0, 0.0, 1.0001)
    if name == "tangent_guards":
        created = created(1e-4)
    start = getattr(case, start) if isinstance(start, str) else start
    times = reference(case)
    walk_result = run_library(created, start, len(times), 10.0)
    np.testing.assert_allclose(walk_result.times, times, rtol=0.0, atol=1e-12)


def test_a_grazing_event_at_tight_tolerance_is_within_two_roundings_of_its_state():
    case = import_atlas_module("tangent_guards")
    walk_result = run_library(case.circle(case.DEPTH), (1.0, 0.0, 0.0), 1, 9.0, tolerance=1e-15)
    rounding = np.finfo(float).eps / 2.0 / math.sqrt(2.0 * case.DEPTH)
    assert abs(walk_result.times[0] - case.entry(case.DEPTH)) < 2.0 * rounding
    assert float(walk_result.resolution[0]) < 2e-11


def test_clutches_lock_and_slip_at_the_times_of_the_modelica_reference():
    case = import_atlas_module("clutches")
    times, rate = case.reference()
    gaps = {event: times[event - 1] - result for event, result in case.PUBLISHED_TIMES.items()}
    # Their solver's tolerance is in the locks; where a lock breaks only the clock counts.
    assert max(abs(gap) for gap in gaps.values()) < 5e-6
    assert max(abs(gaps[event]) for event in (4, 7)) < 1e-9
    assert abs(rate - case.RATE) < 5e-5


def test_siconos_and_drake_ran_in_the_run_that_the_page_reports():
    names_by_method = {
        "Siconos": {"bouncing_ball", "slider_crank", "painleve"},
        "Drake": {"compass_gait", "rimless_wheel"},
    }
    for method, names in names_by_method.items():
        rows = [row for row in FAILURE_TABLE if row["method"] == method]
        assert {row["case"] for row in rows} == names
        assert all(row["version"] != "none" and row["found"] != "nan" for row in rows)


def test_closed_forms_of_the_impact_oscillator_are_periodic():
    case = import_atlas_module("grazing")
    for w, depth in ((2.6, 0.05), (2.2, 0.01), (2.0001, 0.01)):
        result = case.compute_impact_derivative(w, depth)
        x = case.compute_repeating_motion(w, depth)
        walk_result = run_library(result.system, result.begin(x, math), 1, 10.0)
        np.testing.assert_allclose(result.read(walk_result.end), x, atol=1e-9)
    resonant = import_atlas_module("resonant_grazing")
    rate = case.compute_repeating_motion(2.0 + 1e-7, 0.01)[1]
    assert abs(rate / resonant.rate(0.01) - 1.0) < 1e-3


def test_a_guard_that_rises_from_a_rounding_above_zero_does_not_fire_again():
    # Gaps as differences of lengths, at the slider's eighth impact: 3e-18 m and opening.
    case = import_atlas_module("slider_crank")
    flying = lambda q, m: (*q[3:], *case.solve_mass_matrix(q, m, case.forces(q, m)))
    edges = [
        GuardEdge(lambda q, m, x=x: case.gap(q, m, x, case.ABOVE))
        for x in (case.BEHIND, case.AHEAD)
    ]
    start = (
        0.8883344562557088, -0.3949295953577779, 7.986389780903734e-17,
        69.04453234833802, -23.590254395213915, -2.0545409891643685e-16,
    )  # fmt: skip
    walk_result = run_library((Part(flying, tuple(edges)),), start, 1, 0.05)
    assert (
        walk_result.says == "GUARD_VIOLATED_AT_ENTRY"
        or abs(walk_result.times[0] - 1.17795e-5) < 1e-9
    )


def test_successive_corner_impacts_are_reported_and_simultaneous_ones_simulated():
    case = import_atlas_module("slider_crank")
    start = case.make_start_state()
    walk_result = run_library(case.SIMULTANEOUS_IMPACTS, start, case.BOUNCES, case.LIMIT)
    assert walk_result.says == "ZENO"
    assert abs(walk_result.times[-1] - case.REFERENCE["end of the bounces"]) < 1e-14
    single_result = run_library(case.SUCCESSIVE_IMPACTS, start, 20, case.LIMIT)
    assert single_result.says == "ZENO"
    assert abs(single_result.times[-1] - case.REFERENCE["first impact"]) < 1e-14


def test_both_formulations_of_the_slider_crank_keep_the_energy_up_to_the_first_impact():
    case = import_atlas_module("slider_crank")

    def energy(q):
        pairs = ((case.CRANK_SELF, q[3] ** 2), (case.ROD_SELF, q[4] ** 2))
        moving = 0.5 * sum(a * b for a, b in pairs)
        moving += case.COUPLING_INERTIA * math.cos(q[1] - q[0]) * q[3] * q[4]
        crank = (0.5 * case.CRANK_MASS + case.ROD_MASS + case.SLIDER_MASS) * case.CRANK
        rod = (0.5 * case.ROD_MASS + case.SLIDER_MASS) * case.ROD
        return moving + case.GRAVITY * (crank * math.sin(q[0]) + rod * math.sin(q[1]))

    begin = case.make_start_state()
    end = run_library(case.SIMULTANEOUS_IMPACTS, begin, 1, case.LIMIT).states[0]
    first, last = (energy(case.plain(y, math)) for y in (begin, end))
    assert abs(last / first - 1.0) < 1e-13


@pytest.mark.parametrize("name", ["simplest_walker", "compass_gait"])
def test_the_return_map_in_40_digits_reproduces_the_stored_gait_of_a_walker(name):
    place, step = many_digits.CASES[name]
    result, x = getattr(import_atlas_module(name), place), import_atlas_module(name).EXACT_GAIT.x
    with mp.workdps(40):
        end_state, period = many_digits.compute_return_map(result, [mpf(v) for v in x], step)
    np.testing.assert_allclose([float(v) for v in end_state], x, rtol=0.0, atol=2e-16)
    assert (
        abs(float(period) - import_atlas_module(name).EXACT_GAIT.period) < 1e-15
    )  # a rounding of x moves it


@pytest.mark.slow
@pytest.mark.parametrize("name", many_digits.CASES)
def test_gaits_without_a_closed_form_agree_with_forty_digits(name):
    place, step = many_digits.CASES[name]
    with mp.workdps(40):
        result = many_digits.gait(getattr(import_atlas_module(name), place), step)
    stored = import_atlas_module(name).EXACT_GAIT
    assert (result.x, result.period) == (stored.x, stored.period)
    np.testing.assert_allclose(result.multipliers, stored.multipliers, rtol=1e-15, atol=1e-20)


@pytest.mark.slow
def test_the_slider_crank_reference_agrees_with_forty_digits_in_other_coordinates():
    from experiments.atlas.absolute import simulate_bounces

    case = import_atlas_module("slider_crank")
    with mp.workdps(40):
        result = simulate_bounces()
    for name, reference in case.REFERENCE.items():
        assert abs(float(result[name]) / reference - 1.0) < 1e-15, name


@pytest.mark.slow
def test_the_published_torus_point_is_not_itself_the_chenciner_point():
    # Kuznetsov's cubic coefficient of the return map, in coordinates of like size.
    import jax
    import jax.numpy as jnp

    from experiments.atlas.hybrid import modes
    from vrw_jax import StepOptions
    from vrw_jax.continuation import solve_fixed_point
    from vrw_jax.hybrid import simulate_hybrid

    case = import_atlas_module("chenciner")
    parts, options = modes(case.SYSTEM), StepOptions(rtol=1e-12, atol=1e-12, max_phase_time=60.0)
    sizes = jnp.array([1.0, 1e-3, 1e-2])

    def back(x):
        y = jnp.stack(case.CYCLE.begin(x, jnp))
        return jnp.stack(
            case.CYCLE.read(simulate_hybrid(parts, y, events=2, options=options).state)
        )

    x = solve_fixed_point(back, jnp.array(case.PUBLISHED_CYCLE), tolerance=1e-11).x
    scaled = lambda z: (back(x + sizes * z) - x) / sizes
    first = jax.jacfwd(scaled)
    second = jax.jacfwd(first)
    origin = jnp.zeros(3)
    A, B, C = (
        np.asarray(f(origin))
        for f in (jax.jit(first), jax.jit(second), jax.jit(jax.jacfwd(second)))
    )
    values, vectors = np.linalg.eig(A)
    value_at = np.argmax(values.imag)
    turn, q = values[value_at] / abs(values[value_at]), vectors[:, value_at]
    lefts, adjoint = np.linalg.eig(A.T)
    p = adjoint[:, np.argmin(abs(lefts - np.conj(values[value_at])))]
    p = p / np.conj(np.vdot(p, q))
    b = lambda u, v: np.einsum("ijk,j,k->i", B, u, v)
    cubic = np.vdot(p, np.einsum("ijkl,j,k,l->i", C, q, q, q.conj()))
    cubic += 2.0 * np.vdot(p, b(q, np.linalg.solve(np.eye(3) - A, b(q, q.conj()))))
    square = np.linalg.solve(turn**2 * np.eye(3) - A, b(q, q))
    cubic += np.vdot(p, b(q.conj(), square))
    coefficient = 0.5 * np.conj(turn) * cubic
    assert coefficient.real < -0.5 * abs(coefficient)

"""What the page of failures promises: every case told, and ours never wrong without saying so."""

import csv
import importlib
import math
from pathlib import Path

import numpy as np
import pytest
from mpmath import mp, mpf

pytest.importorskip("heyoka", exc_type=ImportError)

from experiments.atlas import failures, many_digits
from experiments.atlas.hybrid import METHODS, Edge, Part, by_scipy, last_time, ours
from experiments.atlas.told import Row

ROOT = Path(__file__).parents[1]
TABLE = list(csv.DictReader((ROOT / "docs" / "figures" / "atlas_failures.csv").open()))


def module(name):
    return importlib.import_module(f"experiments.atlas.cases.{name}")


@pytest.mark.parametrize("name", failures.NAMES)
def test_a_case_has_a_truth_rows_a_picture_and_a_place_on_the_page(name):
    case = module(name).CASE
    assert all((case.title, case.breaks, case.truth, case.source))
    assert any(row["case"] == name for row in TABLE)
    assert (ROOT / "docs" / "figures" / f"failure_{name}.png").exists()
    page = (ROOT / "docs" / "stability_atlas.md").read_text()
    assert f"### {case.title}\n" in page
    assert f"](#{failures.anchor(case.title)})" in page
    assert f"<!-- failure {name} -->" in page


def test_there_are_ten_cases_and_more_and_ours_is_nowhere_silently_wrong():
    assert len(failures.NAMES) >= 10
    assert {row["case"] for row in TABLE} == set(failures.NAMES)
    mine = [row for row in TABLE if row["method"].startswith("ours")]
    assert not [row for row in mine if row["verdict"].startswith("WRONG")]
    assert {"diffrax", "SciPy", "heyoka"} <= {row["method"] for row in TABLE}
    assert all(row["version"] and row["options"] for row in TABLE)


def test_methods_met_in_one_run_and_ours_keeps_1e_12_of_each_closed_form_s_condition():
    assert len({(row["case"], row["run"]) for row in TABLE}) == len(failures.NAMES)
    mine = failures.exact(TABLE)
    assert len(mine) > 20
    assert max(float(row["error"]) / float(row["condition"]) for row in mine) <= 1e-12


def test_no_time_of_ours_is_off_by_more_than_stated():
    """The implicit solver's too: what is above 1e-12 stands as "time to", an infinity included."""
    timed = ("time", "dip", "switching", "event", "touch", "period", "first impact", "end of the")
    mine = [row for row in TABLE if row["method"].startswith("ours") and not row["digits"]]
    late = [
        row
        for row in mine
        if row["quantity"].startswith(timed) and row["error"] != "-" and float(row["error"]) > 1e-12
    ]
    assert {"grazing", "tangent_guards", "two_states"} <= {row["case"] for row in late}
    for row in late:
        assert float(row["error"]) <= float(row["says"].split(",")[0].removeprefix("time to "))


def test_a_closed_form_s_time_is_within_1e_12_or_the_walk_tells_how_far_tolerance_reaches():
    times = [row for row in failures.exact(TABLE) if row["quantity"].startswith(("time", "dip"))]
    late = [row for row in times if float(row["error"]) > 1e-12]
    assert {row["case"] for row in late} <= {"grazing", "tangent_guards"}
    for row in late:
        stated, *rounding = (float(part.split(" ")[-1]) for part in row["says"].split(", "))
        assert float(row["error"]) <= stated
        # Asked for as finely as can be it is within roundings of the start.
        assert "1e-15" not in row["options"] or float(row["error"]) <= rounding[0]


def test_every_multiplier_with_a_closed_form_is_within_1e_12():
    mine = [row for row in failures.exact(TABLE) if "multiplier" in row["quantity"]]
    assert {"grazing", "resonant_grazing", "few_segments"} <= {row["case"] for row in mine}
    assert max(float(row["error"]) for row in mine) <= 1e-12


def test_a_verdict_needs_a_right_answer_or_an_admission():
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
def test_a_system_written_once_is_walked_by_every_method(method):
    ball = module("bouncing_ball")
    walked = method(ball.BALL, (1.0, 0.0), 3, 10.0)
    np.testing.assert_allclose(walked.times, ball.times(3), rtol=1e-11)
    assert not walked.says


def test_a_method_that_meets_no_event_does_not_admit_a_failure():
    never = (Part(lambda y, m: (1.0 + 0.0 * y[0],), (Edge(lambda y, m: 1.0 + y[0]),)),)
    for method in (ours, by_scipy):
        walked = method(never, (0.0,), 1, 2.0)
        assert walked.says
        assert not walked.admits
        assert math.isnan(last_time(walked, 1))


@pytest.mark.parametrize(
    ("name", "system", "start", "truth"),
    [
        ("pinned_pendulum", "SYSTEM", "START", lambda m: m.truth(3)),
        ("singular_field", "QUESTIONS", (1.0,), lambda m: [m.QUESTIONS[0][2]]),
        ("grazing", "stopped", None, lambda m: [m.touches(m.W, 1e-4)]),
        ("tangent_guards", "circle", (1.0, 0.0, 0.0), lambda m: [m.entry(1e-4)]),
    ],
)
def test_event_times_are_within_1e_12_of_their_closed_forms(name, system, start, truth):
    case = module(name)
    made = getattr(case, system)
    if name == "singular_field":
        made = made[0][1]
    if name == "grazing":
        made, start = made(case.W), (-1.0001, 0.0, 0.0, 1.0001)
    if name == "tangent_guards":
        made = made(1e-4)
    start = getattr(case, start) if isinstance(start, str) else start
    times = truth(case)
    walked = ours(made, start, len(times), 10.0)
    np.testing.assert_allclose(walked.times, times, rtol=0.0, atol=1e-12)


def test_a_graze_asked_for_finely_is_within_two_roundings_of_its_state():
    case = module("tangent_guards")
    walked = ours(case.circle(case.DEPTH), (1.0, 0.0, 0.0), 1, 9.0, tolerance=1e-15)
    rounding = np.finfo(float).eps / 2.0 / math.sqrt(2.0 * case.DEPTH)
    assert abs(walked.times[0] - case.entry(case.DEPTH)) < 2.0 * rounding
    assert float(walked.resolution[0]) < 2e-11


def test_clutches_lock_and_break_loose_when_modelica_s_reference_says():
    case = module("clutches")
    times, rate = case.truth()
    gaps = {event: times[event - 1] - told for event, told in case.PUBLISHED.items()}
    # Their solver's tolerance is in the locks; where a lock breaks only the clock counts.
    assert max(abs(gap) for gap in gaps.values()) < 5e-6
    assert max(abs(gaps[event]) for event in (4, 7)) < 1e-9
    assert abs(rate - case.RATE) < 5e-5


def test_siconos_and_drake_answered_in_the_run_that_the_page_tells():
    own = {
        "Siconos": {"bouncing_ball", "slider_crank", "painleve"},
        "Drake": {"compass_gait", "rimless_wheel"},
    }
    for method, names in own.items():
        rows = [row for row in TABLE if row["method"] == method]
        assert {row["case"] for row in rows} == names
        assert all(row["version"] != "none" and row["found"] != "nan" for row in rows)


def test_closed_forms_of_the_impact_oscillator_repeat_themselves():
    case = module("grazing")
    for w, depth in ((2.6, 0.05), (2.2, 0.01), (2.0001, 0.01)):
        told = case.of_impact(w, depth)
        x = case.repeating(w, depth)
        walked = ours(told.system, told.begin(x, math), 1, 10.0)
        np.testing.assert_allclose(told.read(walked.end), x, atol=1e-9)
    resonant = module("resonant_grazing")
    assert abs(case.repeating(2.0 + 1e-7, 0.01)[1] / resonant.rate(0.01) - 1.0) < 1e-3


def test_a_guard_that_rises_from_a_rounding_above_zero_does_not_fire_again():
    # Gaps as differences of lengths, at the slider's eighth impact: 3e-18 m and opening.
    case = module("slider_crank")
    flying = lambda q, m: (*q[3:], *case.moved(q, m, case.forces(q, m)))
    edges = [
        Edge(lambda q, m, x=x: case.gap(q, m, x, case.ABOVE)) for x in (case.BEHIND, case.AHEAD)
    ]
    start = (
        0.8883344562557088, -0.3949295953577779, 7.986389780903734e-17,
        69.04453234833802, -23.590254395213915, -2.0545409891643685e-16,
    )  # fmt: skip
    walked = ours((Part(flying, tuple(edges)),), start, 1, 0.05)
    assert walked.says == "GUARD_PAST" or abs(walked.times[0] - 1.17795e-5) < 1e-9


def test_corners_hit_one_by_one_are_told_and_both_at_once_walked():
    case = module("slider_crank")
    walked = ours(case.TOGETHER, case.begun(), case.BOUNCES, case.LIMIT)
    assert walked.says == "EVENTS_PILE_UP"
    assert abs(walked.times[-1] - case.TRUTH["end of the bounces"]) < 1e-14
    alone = ours(case.ONE_BY_ONE, case.begun(), 20, case.LIMIT)
    assert alone.says == "EVENTS_PILE_UP"
    assert abs(alone.times[-1] - case.TRUTH["first impact"]) < 1e-14


def test_both_formulations_of_the_slider_crank_keep_the_energy_up_to_the_first_impact():
    case = module("slider_crank")

    def energy(q):
        pairs = ((case.CRANK_SELF, q[3] ** 2), (case.ROD_SELF, q[4] ** 2))
        moving = 0.5 * sum(a * b for a, b in pairs)
        moving += case.COUPLED * math.cos(q[1] - q[0]) * q[3] * q[4]
        crank = (0.5 * case.CRANK_MASS + case.ROD_MASS + case.SLIDER_MASS) * case.CRANK
        rod = (0.5 * case.ROD_MASS + case.SLIDER_MASS) * case.ROD
        return moving + case.GRAVITY * (crank * math.sin(q[0]) + rod * math.sin(q[1]))

    begin = case.begun()
    end = ours(case.TOGETHER, begin, 1, case.LIMIT).states[0]
    first, last = (energy(case.plain(y, math)) for y in (begin, end))
    assert abs(last / first - 1.0) < 1e-13


@pytest.mark.parametrize("name", ["simplest_walker", "compass_gait"])
def test_the_map_in_40_digits_takes_a_walker_s_stored_gait_to_itself(name):
    place, step = many_digits.CASES[name]
    told, x = getattr(module(name), place), module(name).EXACT.x
    with mp.workdps(40):
        there, period = many_digits.back(told, [mpf(v) for v in x], step)
    np.testing.assert_allclose([float(v) for v in there], x, rtol=0.0, atol=2e-16)
    assert abs(float(period) - module(name).EXACT.period) < 1e-15  # a rounding of x moves it


@pytest.mark.slow
@pytest.mark.parametrize("name", many_digits.CASES)
def test_gaits_without_a_closed_form_are_those_of_forty_digits(name):
    place, step = many_digits.CASES[name]
    with mp.workdps(40):
        told = many_digits.gait(getattr(module(name), place), step)
    stored = module(name).EXACT
    assert (told.x, told.period) == (stored.x, stored.period)
    np.testing.assert_allclose(told.multipliers, stored.multipliers, rtol=1e-15, atol=1e-20)


@pytest.mark.slow
def test_the_slider_crank_s_truth_is_that_of_forty_digits_in_other_coordinates():
    from experiments.atlas.absolute import march

    case = module("slider_crank")
    with mp.workdps(40):
        told = march()
    for name, truth in case.TRUTH.items():
        assert abs(float(told[name]) / truth - 1.0) < 1e-15, name


@pytest.mark.slow
def test_the_published_torus_point_is_not_itself_the_chenciner_point():
    # Kuznetsov's cubic coefficient of the return map, in coordinates of like size.
    import jax
    import jax.numpy as jnp

    from experiments.atlas.hybrid import modes
    from vrw_jax import Options
    from vrw_jax.numerics import newton_cycle, walk

    case = module("chenciner")
    parts, options = modes(case.SYSTEM), Options(rtol=1e-12, atol=1e-12, max_phase_time=60.0)
    sizes = jnp.array([1.0, 1e-3, 1e-2])

    def back(x):
        y = jnp.stack(case.CYCLE.begin(x, jnp))
        return jnp.stack(case.CYCLE.read(walk(parts, y, events=2, options=options).state))

    x = newton_cycle(back, jnp.array(case.PUBLISHED), tolerance=1e-11).x
    scaled = lambda z: (back(x + sizes * z) - x) / sizes
    first = jax.jacfwd(scaled)
    second = jax.jacfwd(first)
    origin = jnp.zeros(3)
    A, B, C = (
        np.asarray(f(origin))
        for f in (jax.jit(first), jax.jit(second), jax.jit(jax.jacfwd(second)))
    )
    values, vectors = np.linalg.eig(A)
    at = np.argmax(values.imag)
    turn, q = values[at] / abs(values[at]), vectors[:, at]
    lefts, adjoint = np.linalg.eig(A.T)
    p = adjoint[:, np.argmin(abs(lefts - np.conj(values[at])))]
    p = p / np.conj(np.vdot(p, q))
    b = lambda u, v: np.einsum("ijk,j,k->i", B, u, v)
    cubic = np.vdot(p, np.einsum("ijkl,j,k,l->i", C, q, q, q.conj()))
    cubic += 2.0 * np.vdot(p, b(q, np.linalg.solve(np.eye(3) - A, b(q, q.conj()))))
    square = np.linalg.solve(turn**2 * np.eye(3) - A, b(q, q))
    cubic += np.vdot(p, b(q.conj(), square))
    coefficient = 0.5 * np.conj(turn) * cubic
    assert coefficient.real < -0.5 * abs(coefficient)

"""A slider–crank whose slider has play in its guide: two corners hit at once, again and again.

Flores, Leine and Glocker's mechanism: the crank starts along the guide with 150 rad/s, the rod with
-75, the slider parallel to its guide with 1 mm to either face. Both upper corners hit at the same
instant; friction makes their impulses differ, and the slider does not turn. Newton's law with
restitution 0.4 makes infinitely many such impacts; then both corners slide, let go together, and
both lower ones hit. Reference: experiments/atlas/absolute.py, other coordinates and 40 digits.
Siconos' example stores steps of 0.1 ms: both meet above in the 28th and below in the 259th.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from typing import Any

from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

from experiments.atlas.hybrid import (
    METHODS,
    GuardEdge,
    Numbers,
    Part,
    last_time,
    make_row,
    run_library,
)
from experiments.atlas.others import make_rows
from experiments.atlas.results import Case, Row, compute_error, time_second_call
from vrw_jax.hybrid import LCPStatus, enumerate_lcp_solutions

CRANK, ROD, HALF, HEIGHT, PLAY = 0.153, 0.306, 0.05, 0.025, 0.001  # m; of the slider: halves
CRANK_MASS, ROD_MASS, SLIDER_MASS = 0.038, 0.038, 0.076  # kg
CRANK_INERTIA, ROD_INERTIA, SLIDER_INERTIA = 7.4e-5, 5.9e-4, 2.7e-6  # kg m^2, about the middles
GRAVITY, RESTITUTION_COEFFICIENT, FRICTION = 9.81, 0.4, 0.01
RATES = (150.0, -75.0)  # of crank and rod at the start, rad/s

BEHIND, AHEAD = -HALF, HALF
ABOVE, BELOW = 1.0, -1.0
"""Where a corner is: along the slider, and at which face of the guide."""
COUPLING_INERTIA = (0.5 * ROD_MASS + SLIDER_MASS) * CRANK * ROD
ROD_SELF = ROD_INERTIA + (0.25 * ROD_MASS + SLIDER_MASS) * ROD**2
CRANK_SELF = CRANK_INERTIA + (0.25 * CRANK_MASS + ROD_MASS + SLIDER_MASS) * CRANK**2


def gap(y: Numbers, m: Any, transverse_part: float, face: float) -> Any:
    """Between a corner and its face, m."""
    height = CRANK * m.sin(y[0]) + ROD * m.sin(y[1]) + transverse_part * m.sin(y[2])
    return HEIGHT + PLAY - face * height - HEIGHT * m.cos(y[2])


def opening(y: Numbers, m: Any, transverse_part: float, face: float) -> tuple:
    """Return the derivatives of the gap with respect to each angle."""
    return (
        -face * CRANK * m.cos(y[0]),
        -face * ROD * m.cos(y[1]),
        -face * transverse_part * m.cos(y[2]) + HEIGHT * m.sin(y[2]),
    )


def generalized_contact_force(y: Numbers, m: Any, transverse_part: float, face: float) -> tuple:
    """Generalised force of a corner that slides backwards, for each newton of its normal one."""
    ahead = (
        -CRANK * m.sin(y[0]),
        -ROD * m.sin(y[1]),
        -transverse_part * m.sin(y[2]) - face * HEIGHT * m.cos(y[2]),
    )
    return tuple(
        w + FRICTION * h for w, h in zip(opening(y, m, transverse_part, face), ahead, strict=True)
    )


def solve_mass_matrix(y: Numbers, m: Any, force: Numbers) -> tuple:
    """Return accelerations for given forces, or jumps of rates for given impulses."""
    coupling = COUPLING_INERTIA * m.cos(y[1] - y[0])
    scale = 1.0 / (CRANK_SELF * ROD_SELF - coupling * coupling)
    return (
        scale * (ROD_SELF * force[0] - coupling * force[1]),
        scale * (CRANK_SELF * force[1] - coupling * force[0]),
        force[2] / SLIDER_INERTIA,
    )


def dot(a: Numbers, b: Numbers) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def forces(y: Numbers, m: Any) -> tuple:
    """Return generalized forces: gravity, and the velocity terms of crank and rod."""
    turning = COUPLING_INERTIA * m.sin(y[1] - y[0])
    crank = (0.5 * CRANK_MASS + ROD_MASS + SLIDER_MASS) * GRAVITY * CRANK * m.cos(y[0])
    rod = (0.5 * ROD_MASS + SLIDER_MASS) * GRAVITY * ROD * m.cos(y[1])
    return turning * y[4] * y[4] - crank, -turning * y[3] * y[3] - rod, 0.0 * y[0]


def impulses(y: Numbers, m: Any, face: float, free: tuple) -> tuple:
    """Return forces or impulses of two sliding corners that cancel the free accelerations or rates
    `free`.
    """
    openings = [opening(y, m, transverse_part, face) for transverse_part in (BEHIND, AHEAD)]
    jumps = [
        solve_mass_matrix(y, m, generalized_contact_force(y, m, transverse_part, face))
        for transverse_part in (BEHIND, AHEAD)
    ]
    (a, b), (c, d) = [[dot(w, jump) for jump in jumps] for w in openings]
    scale = 1.0 / (a * d - b * c)
    return scale * (b * free[1] - d * free[0]), scale * (c * free[0] - a * free[1])


def total(y: Numbers, m: Any, face: float, sizes: tuple) -> list:
    """Generalised force of both corners of a face."""
    behind, ahead = (
        generalized_contact_force(y, m, transverse_part, face)
        for transverse_part in (BEHIND, AHEAD)
    )
    return [sizes[0] * p + sizes[1] * q for p, q in zip(behind, ahead, strict=True)]


def plain(y: Numbers, m: Any) -> tuple:
    """Return the angles and their rates for a state.

    The state is (three angles, the crank's rate, two rates, two gaps).

    Rates and gaps of the upper corners are components of the state, so that an impact keeps the
    gaps at zero and reverses the rates without round-off.
    """
    slider = (y[4] - y[5]) / (2.0 * HALF * m.cos(y[2]))
    middle = HEIGHT * m.sin(y[2]) * slider - 0.5 * (y[4] + y[5]) - CRANK * m.cos(y[0]) * y[3]
    return (*y[:3], y[3], middle / (ROD * m.cos(y[1])), slider)


def compute_curvature(q: Numbers, m: Any) -> list:
    """Return the velocity terms in the second derivatives of the upper gaps."""
    turns = CRANK * m.sin(q[0]) * q[3] * q[3] + ROD * m.sin(q[1]) * q[4] * q[4]
    return [turns + (x * m.sin(q[2]) + HEIGHT * m.cos(q[2])) * q[5] * q[5] for x in (BEHIND, AHEAD)]


def lift_to_coordinates(q: Numbers, m: Any, changes: tuple) -> list:
    """Return the changes of the rates of the upper gaps for given changes of the angular rates."""
    return [
        dot(opening(q, m, transverse_part, ABOVE), changes) for transverse_part in (BEHIND, AHEAD)
    ]


def flying(y: Numbers, m: Any) -> tuple:
    q = plain(y, m)
    changes = solve_mass_matrix(q, m, forces(q, m))
    pairs = zip(lift_to_coordinates(q, m, changes), compute_curvature(q, m), strict=True)
    return (*q[3:], changes[0], *(rate + bend for rate, bend in pairs), y[4], y[5])


def contact_forces(y: Numbers, m: Any) -> tuple:
    """Return the forces of both upper corners while they slide, N."""
    q = plain(y, m)
    pairs = zip(
        lift_to_coordinates(q, m, solve_mass_matrix(q, m, forces(q, m))),
        compute_curvature(q, m),
        strict=True,
    )
    return impulses(q, m, ABOVE, tuple(rate + bend for rate, bend in pairs))


def sliding(y: Numbers, m: Any) -> tuple:
    q = plain(y, m)
    push = total(q, m, ABOVE, contact_forces(y, m))
    force = [f + p for f, p in zip(forces(q, m), push, strict=True)]
    return (*q[3:], solve_mass_matrix(q, m, force)[0], *(0.0 * x for x in y[4:]))


def make_impact(restitution: float) -> Callable:
    """Both upper corners at once."""

    def reset(y: Numbers, m: Any) -> tuple:
        q = plain(y, m)
        free = ((1.0 + restitution) * y[4], (1.0 + restitution) * y[5])
        jumps = solve_mass_matrix(q, m, total(q, m, ABOVE, impulses(q, m, ABOVE, free)))
        return (
            *y[:3],
            y[3] + jumps[0],
            -restitution * y[4],
            -restitution * y[5],
            0.0 * y[6],
            0.0 * y[7],
        )

    return reset


def make_single_impact(corner: int) -> Callable:
    """Return the impact of one corner, without contact at the other."""
    transverse_part = (BEHIND, AHEAD)[corner]

    def reset(y: Numbers, m: Any) -> tuple:
        q = plain(y, m)
        push = solve_mass_matrix(q, m, generalized_contact_force(q, m, transverse_part, ABOVE))
        size = (
            -(1.0 + RESTITUTION_COEFFICIENT)
            * y[4 + corner]
            / dot(opening(q, m, transverse_part, ABOVE), push)
        )
        jumps = lift_to_coordinates(q, m, tuple(size * p for p in push))
        rates = [y[4] + jumps[0], y[5] + jumps[1]]
        gaps = [y[6], y[7]]
        rates[corner], gaps[corner] = -RESTITUTION_COEFFICIENT * y[4 + corner], 0.0 * y[6]
        return (*y[:3], y[3] + size * push[0], *rates, *gaps)

    return reset


def make_flight_part(resets: Sequence[Callable]) -> tuple[Part, ...]:
    """Return the mode of flight below the upper face."""
    edges = tuple(GuardEdge(lambda y, m, i=i: y[6 + i], resets[i]) for i in (0, 1))
    return (Part(flying, edges),)


def make_start_state(rates: Numbers = RATES) -> tuple:
    """Return the start state, in which all angles are zero."""
    upper = -CRANK * rates[0] - ROD * rates[1]
    return (0.0, 0.0, 0.0, rates[0], upper, upper, PLAY, PLAY)


SIMULTANEOUS_IMPACTS, SUCCESSIVE_IMPACTS = (
    make_flight_part((make_impact(RESTITUTION_COEFFICIENT), make_impact(RESTITUTION_COEFFICIENT))),
    make_flight_part((make_single_impact(0), make_single_impact(1))),
)
CLOSED_GAP_MODE = (
    Part(
        sliding,
        tuple(GuardEdge(lambda y, m, i=i: contact_forces(y, m)[i], target_part=1) for i in (0, 1)),
    ),
    Part(
        flying,
        tuple(GuardEdge(lambda y, m, x=x: gap(plain(y, m), m, x, BELOW)) for x in (BEHIND, AHEAD)),
    ),
)
BOUNCES, LIMIT = 100, 0.05
REFERENCE = {
    "first impact": 0.002692502752021212140189,
    "crank's rate after it": 108.724580001767385642,
    "impulse behind": 0.0557403230737523403097,
    "impulse ahead": 0.05518569299341649612752,
    "second impact": 0.005612363190210417523411,
    "end of the bounces": 0.009145632177375002027828,
    "letting go": 0.01502865174845959176394,
    "touch of the other face": 0.02588956287578905805098,
}
"""As `python -m experiments.atlas.absolute` prints them: s, rad/s, N s."""
SICONOS_EVENT_TIMES = {"first impact": 0.0028, "touch of the other face": 0.0259}
"""Steps at whose end Siconos' example stores them (combined projection), of 0.1 ms, first order."""


def first_impulses() -> Iterator[Row]:
    """Return the number of solutions of the first impact, and the chosen one, by this library's
    solver.
    """
    walk_result = run_library(SIMULTANEOUS_IMPACTS, make_start_state(), 1, LIMIT)
    y = walk_result.states[0]
    q = plain(y, math)
    normals = [opening(q, math, x, ABOVE) for x in (BEHIND, AHEAD)]
    jumps = [
        solve_mass_matrix(q, math, generalized_contact_force(q, math, x, ABOVE))
        for x in (BEHIND, AHEAD)
    ]
    matrix = [[float(dot(w, jump)) for jump in jumps] for w in normals]
    free = [(1.0 + RESTITUTION_COEFFICIENT) * float(rate) for rate in y[4:6]]
    result, seconds = time_second_call(lambda: enumerate_lcp_solutions(matrix, free))
    says = "" if result.status == LCPStatus.UNIQUE_SOLUTION else LCPStatus(int(result.status)).name
    for name, computed_impulse in zip(
        ("impulse behind", "impulse ahead"), result.force, strict=True
    ):
        error = compute_error(float(computed_impulse), REFERENCE[name])
        yield Row(
            name, "ours", float(computed_impulse), REFERENCE[name], error, says,
            bool(says), len(result.is_solution), seconds, "complementary", version("vrw-jax"),
        )  # fmt: skip


def siconos() -> Iterator[Row]:
    """Time stepping of the same mechanism: Moreau's law, both corners at once."""
    numbers = {
        name: globals()[name]
        for name in (
            "CRANK", "ROD", "HALF", "HEIGHT", "PLAY", "CRANK_MASS", "ROD_MASS", "SLIDER_MASS",
            "CRANK_INERTIA", "ROD_INERTIA", "SLIDER_INERTIA", "GRAVITY", "FRICTION",
        )
    }  # fmt: skip
    numbers |= {"BEGINS": RATES[0], "ROD_BEGINS": RATES[1], "RESTITUTION": RESTITUTION_COEFFICIENT}
    references = {
        name: reference for name, reference in REFERENCE.items() if name != "crank's rate after it"
    }
    yield from make_rows("siconos", "slider_crank", references, "--crank", json.dumps(numbers))


def rows() -> Iterator[Row]:
    for method in METHODS:
        walk_result = method(SIMULTANEOUS_IMPACTS, make_start_state(), BOUNCES, LIMIT)
        early = walk_result._replace(says="", admits=False)
        for name, event in (("first impact", 1), ("second impact", 2)):
            yield make_row(early, name, last_time(walk_result, event), REFERENCE[name], event=event)
        once = method(SIMULTANEOUS_IMPACTS, make_start_state(), 1, LIMIT)
        name = "crank's rate after it"
        yield make_row(once, name, float(once.end[3]), REFERENCE[name])
        end = float(walk_result.times[-1]) if len(walk_result.times) else math.nan
        yield make_row(walk_result, "end of the bounces", end, REFERENCE["end of the bounces"])
        last_phase = method(CLOSED_GAP_MODE, make_impact(0.0)(walk_result.end, math), 2, LIMIT)
        for event, name in enumerate(("letting go", "touch of the other face"), 1):
            yield make_row(last_phase, name, end + last_time(last_phase, event), REFERENCE[name])
            if method is run_library and name in SICONOS_EVENT_TIMES:
                solution = end + last_time(last_phase, event)
                yield make_row(
                    last_phase,
                    f"{name}, as Siconos stored",
                    solution,
                    SICONOS_EVENT_TIMES[name],
                    digits=3,
                )
        separated_values = method(SUCCESSIVE_IMPACTS, make_start_state(), 20, LIMIT)
        later_value = [t for t in separated_values.times if t > REFERENCE["first impact"] + 1e-6]
        separated_values = separated_values._replace(
            method=f"{separated_values.method}, corner by corner"
        )
        second = float(later_value[0]) if later_value else math.nan
        yield make_row(separated_values, "second impact", second, REFERENCE["second impact"])
        if method is run_library:
            name = "first impact"
            yield make_row(
                once,
                f"{name}, as Siconos stored",
                last_time(once, 1),
                SICONOS_EVENT_TIMES[name],
                digits=3,
            )
            yield from first_impulses()
    yield from siconos()


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    walk_result = run_library(SIMULTANEOUS_IMPACTS, make_start_state(), BOUNCES, LIMIT)
    closed = make_impact(0.0)(walk_result.end, math)
    last_phase = run_library(CLOSED_GAP_MODE, closed, 2, LIMIT)
    begin, y = 0.0, make_start_state()
    for time, state in zip(walk_result.times[:12], walk_result.states, strict=False):
        result = solve_ivp(
            lambda t, y: flying(y, math), (begin, time), y, rtol=1e-8, atol=1e-10, max_step=1e-4
        )
        axes.plot(1e3 * result.t, 1e3 * result.y[6], color="C0")
        begin, y = time, make_impact(RESTITUTION_COEFFICIENT)(state, math)
    lets_go, end = walk_result.times[-1] + last_phase.times
    axes.plot([1e3 * begin, 1e3 * lets_go], [0.0, 0.0], color="C1", lw=2.0, label="both slide")
    result = solve_ivp(
        lambda t, y: flying(y, math), (lets_go, end), last_phase.states[0], rtol=1e-8, atol=1e-10,
        max_step=1e-4,
    )  # fmt: skip
    axes.plot(1e3 * result.t, 1e3 * result.y[6], color="C0", label="flies")
    axes.plot(1e3 * walk_result.times, 0.0 * walk_result.times, "k.", label="both hit")
    axes.plot(1e3 * end, 2e3 * PLAY, "k.")
    for step in SICONOS_EVENT_TIMES.values():
        axes.axvspan(1e3 * step - 0.1, 1e3 * step, color="0.8")
    axes.plot([], [], color="0.8", lw=4.0, label="as Siconos stored")
    axes.set_xlabel("time [ms]")
    axes.set_ylabel("gap of the upper corners [mm]")
    axes.legend()


CASE = Case(
    "Slider–crank with clearance",
    "two contacts at the same instant, infinitely often",
    "40 digits in other coordinates; Siconos' stored steps",
    "Flores, Leine, Glocker, Multibody Syst. Dyn. 23 (2010), table 1, as in Siconos' example "
    "SliderCrank and in cardillo's",
    rows,
    draw,
)

"""The woodpecker toy: a bird on a sleeve that jams, slips and hits, and so climbs down its pole.

Glocker's model: the sleeve's height y and angle M, the bird's angle S behind a spring. The sleeve's
lower (2) and upper (3) edge touch the pole at M = -+M0 without bouncing, the beak (1) hits it with
restitution 1/2, friction is 0.3 everywhere. One period is ten events: the sliding sleeve jams,
breaks loose, lets go, hits above and leaves at once, the beak hits, the sleeve hits above and
slides up, lets go, hits below and leaves at once, hits below and slides. Where it leaves at once,
a mode begins on its own guard with rate zero. An impact slides in one direction as Moreau's law
says; time stepping by that law, written apart and not kept here, gave the same order of events.
The reference beyond the published digits is found in 40 digits by many_digits.py.
"""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

from experiments.atlas.gaits import ExactGait, ReturnMap, gaits
from experiments.atlas.hybrid import GuardEdge, Part, make_row
from experiments.atlas.results import Case, Row

SLEEVE, BIRD, SLEEVE_INERTIA, BIRD_INERTIA = 3e-4, 4.5e-3, 5e-9, 7e-7  # kg, kg m^2
STIFFNESS, GRAVITY, FRICTION, RESTITUTION_COEFFICIENT = 5.6e-3, 9.81, 0.3, 0.5  # N m/rad, m/s^2
POLE, HOLE, HALF, SPRING_ARM, BEAK_X, BIRD_ARM, BEAK_Y = (  # m
    2.5e-3, 3.1e-3, 5.8e-3, 1e-2, 2e-2, 1.5e-2, 2.01e-2,
)  # fmt: skip
SECTION, PUBLISHED_RATES = -0.2788, (-0.3411, -7.4583)
"""The bird's angle at which Glocker tells the cycle, rad; there rates of sleeve and bird."""

TILT = (HOLE - POLE) / HALF
"""M0, the sleeve's angle where it touches the pole, rad."""
MASS = np.array(
    [
        [SLEEVE + BIRD, BIRD * SPRING_ARM, BIRD * BIRD_ARM],
        [BIRD * SPRING_ARM, SLEEVE_INERTIA + BIRD * SPRING_ARM**2, BIRD * SPRING_ARM * BIRD_ARM],
        [BIRD * BIRD_ARM, BIRD * SPRING_ARM * BIRD_ARM, BIRD_INERTIA + BIRD * BIRD_ARM**2],
    ]
)
INVERSE = np.linalg.inv(MASS).tolist()
NORMAL = {1: (0.0, 0.0, -BEAK_X), 2: (0.0, HALF, 0.0), 3: (0.0, -HALF, 0.0)}
TANGENT = {1: (1.0, SPRING_ARM, BIRD_ARM - BEAK_Y), 2: (1.0, HOLE, 0.0), 3: (1.0, HOLE, 0.0)}


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def solve_mass_matrix(force):
    """Return accelerations for given forces, or jumps of rates for given impulses."""
    return tuple(dot(line, force) for line in INVERSE)


def generalized_contact_force(contact: int, sign: float) -> tuple[float, ...]:
    """Force of a contact that slides, for each newton of its normal one; friction along `sign`."""
    pairs = zip(NORMAL[contact], TANGENT[contact], strict=True)
    return tuple(n + sign * FRICTION * t for n, t in pairs)


def forces(y):
    """Return the forces of gravity and spring; the state is (y', M, M', S, S')."""
    wound = STIFFNESS * (y[1] - y[3])
    return (
        -(SLEEVE + BIRD) * GRAVITY + 0.0 * y[0],
        -wound - BIRD * GRAVITY * SPRING_ARM,
        wound - BIRD * GRAVITY * BIRD_ARM,
    )


def normal_force(y, contact, sign):
    """Return the normal force of a sliding contact."""
    transverse_part = NORMAL[contact]
    return -dot(transverse_part, solve_mass_matrix(forces(y))) / dot(
        transverse_part, solve_mass_matrix(generalized_contact_force(contact, sign))
    )


def flying(y, m):
    hub_acceleration, sleeve, bird = solve_mass_matrix(forces(y))
    return hub_acceleration, y[2], sleeve, y[4], bird


def sliding(contact, sign):
    def field(y, m):
        push = normal_force(y, contact, sign)
        total = [
            f + push * p
            for f, p in zip(forces(y), generalized_contact_force(contact, sign), strict=True)
        ]
        hub_acceleration, _, bird = solve_mass_matrix(total)
        return hub_acceleration, 0.0 * y[1], 0.0 * y[2], y[4], bird

    return field


def jammed_bird(y):
    return forces(y)[2] / MASS[2, 2]


def jammed_field(y, m):
    return 0.0 * y[0], 0.0 * y[1], 0.0 * y[2], y[4], jammed_bird(y)


def grip(y, m):
    """Friction left while jammed, N."""
    turning = jammed_bird(y)
    first, second, _ = forces(y)
    hub_acceleration = MASS[0, 2] * turning - first
    normal = (MASS[1, 2] * turning - second - HOLE * hub_acceleration) / HALF
    return FRICTION * normal - hub_acceleration


def make_impact(contact, sign):
    """Return the reset map of a sliding impact without restitution, which places the sleeve on the
    pole.
    """

    def reset(y, m):
        before, push = (y[0], y[2], y[4]), generalized_contact_force(contact, sign)
        retained = RESTITUTION_COEFFICIENT if contact == 1 else 0.0
        size = -(1.0 + retained) * dot(NORMAL[contact], before)
        size = size / dot(NORMAL[contact], solve_mass_matrix(push))
        hub_acceleration, sleeve, bird = (
            v + size * j for v, j in zip(before, solve_mass_matrix(push), strict=True)
        )
        if contact == 1:
            return hub_acceleration, y[1], sleeve, y[3], bird
        return (
            hub_acceleration,
            (TILT if contact == 3 else -TILT) + 0.0 * y[1],
            0.0 * y[2],
            y[3],
            bird,
        )

    return reset


lower, upper = (lambda y, m: HALF * (TILT + y[1])), (lambda y, m: HALF * (TILT - y[1]))
beak = lambda y, m: SPRING_ARM + BIRD_ARM - BEAK_Y - POLE - BEAK_X * y[3]
stop_first_coordinate = lambda y, m: (0.0 * y[0], *y[1:])
SYSTEM = (
    Part(sliding(2, 1.0), (GuardEdge(lambda y, m: -y[0], stop_first_coordinate, 1),)),
    Part(jammed_field, (GuardEdge(grip, target_part=2),)),
    Part(sliding(2, 1.0), (GuardEdge(lambda y, m: normal_force(y, 2, 1.0), target_part=3),)),
    Part(flying, (GuardEdge(upper, make_impact(3, 1.0), 4),)),
    Part(
        flying, (GuardEdge(beak, make_impact(1, -1.0), 5), GuardEdge(upper, make_impact(3, 1.0), 4))
    ),
    Part(flying, (GuardEdge(upper, make_impact(3, -1.0), 6),)),
    Part(sliding(3, -1.0), (GuardEdge(lambda y, m: normal_force(y, 3, -1.0), target_part=7),)),
    Part(flying, (GuardEdge(lower, make_impact(2, 1.0), 8),)),
    Part(flying, (GuardEdge(lower, make_impact(2, 1.0), 9),)),
    Part(sliding(2, 1.0), (GuardEdge(lambda y, m: y[3] - SECTION, target_part=0),)),
)
CYCLE = ReturnMap(
    SYSTEM,
    lambda x, m: (x[0], -TILT + 0.0 * x[0], 0.0 * x[0], SECTION + 0.0 * x[0], x[1]),
    lambda y: (y[0], y[4]),
    events=len(SYSTEM),
    guess=PUBLISHED_RATES,
    limit=1.0,
)


EXACT_GAIT = ExactGait(
    (-0.3394786223552639, -7.462094642627962), 0.14597606514375208, (-0.8391556530475852, 0.0)
)


def rows() -> Iterator[Row]:
    for gait in gaits(CYCLE):
        for name, computed_value, exact_value, published_value in zip(
            ("rate of the sleeve", "rate of the bird"),
            gait.x,
            EXACT_GAIT.x,
            PUBLISHED_RATES,
            strict=True,
        ):
            yield make_row(gait.simulation, name, float(computed_value), exact_value)
            yield make_row(
                gait.simulation,
                f"{name}, as published",
                float(computed_value),
                published_value,
                digits=2,
            )
        yield make_row(gait.simulation, "period", gait.duration, EXACT_GAIT.period)
        radius = abs(EXACT_GAIT.multipliers[0])
        yield make_row(
            gait.simulation, "spectral radius", float(np.abs(gait.multipliers[0])), radius
        )


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    from experiments.atlas.hybrid import run_library

    axes = figure.subplots()
    start = CYCLE.begin(PUBLISHED_RATES, np)
    walk_result = run_library(SYSTEM, start, 3 * CYCLE.events, CYCLE.limit)
    begins = np.append(0.0, walk_result.times[:-1])
    for k, (begin, end) in enumerate(zip(begins, walk_result.times, strict=True)):
        part = SYSTEM[k % CYCLE.events]
        if k:
            before = SYSTEM[(k - 1) % CYCLE.events].edges[0]
            start = before.reset(walk_result.states[k - 1], np)
        result = solve_ivp(
            lambda t, y, part=part: part.field(y, np), (begin, end), start, rtol=1e-8, atol=1e-10,
            max_step=1e-3,
        )  # fmt: skip
        axes.plot(result.y[3], result.y[4], color="C0", lw=0.8, label="motion" if not k else None)
    axes.plot(walk_result.states[:, 3], walk_result.states[:, 4], "k.", label="events")
    axes.plot(SECTION, PUBLISHED_RATES[1], "*", color="C1", ms=9, label="published")
    axes.set_xlabel("angle of the bird [rad]")
    axes.set_ylabel("angular velocity [rad/s]")
    axes.legend()


CASE = Case(
    "Woodpecker toy",
    "friction, impacts, modes begun on their guards at rate zero",
    "published to 2 digits; beyond in 40 digits, own",
    "Glocker's thesis (1995) and Glocker and Studer's toy; parameters and the cycle's state as in "
    "Siconos' example Woodpecker",
    rows,
    draw,
)

"""The paper's phases as data for the collocation: what moves, what ends it, what jumps.

`held_landing` has the plane section (theta+, dtheta+) just after an impact that ends with both feet
on the ground; its double support may be left out (then the rear foot lifts at once, case B3).
An impact that throws the rear foot off (case A3) leaves that plane: such gaits are not found here.
"""

import functools
import math
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.numerics import (
    Constants,
    Elementwise,
    Passage,
    Phase,
    PhaseSequence,
    Point,
    Vector,
    sine_cosine,
)
from vrw_jax.wheel import (
    Motion,
    Symbols,
    double_support_circle,
    dynamics,
    landing_foot_height,
    rear_direction,
    symbols_of,
    transitions,
)

N_CONSTANTS = 12
"""Fields of `Symbols` that vary from lane to lane; the rest follows from the number of legs."""


def constants_of(n_legs: int, *parameters: Elementwise) -> Constants:
    """The combinations that every formula needs, from the parameters in their order."""
    symbols: tuple[Any, ...] = symbols_of(n_legs, *parameters)
    return symbols[:N_CONSTANTS]


def _symbols(n_legs: int, constants: Constants) -> Symbols:
    alpha = 2.0 * math.pi / n_legs
    fields: tuple[Any, ...] = (*constants, n_legs, math.sin(alpha), math.cos(alpha), alpha)
    return Symbols(*fields)


def _double_support(s: Symbols, point: Point) -> tuple[Elementwise, Motion]:
    """Feet's distance and motion of DLS: held (distance,), coordinate (theta,)."""
    (distance,), (theta,), (dtheta,) = point
    sin, cos = sine_cosine(theta)
    circle = double_support_circle(s, distance, sin, cos)
    rates = (dtheta, circle.G1 * dtheta, circle.G2 * dtheta)
    return distance, Motion(sin, cos, circle.L1, circle.L2, *rates)


def _single_support_1(point: Point) -> Motion:
    """Motion of SLS-I: coordinates (theta, L1, L2)."""
    theta, L1, L2 = point.q
    return Motion(*sine_cosine(theta), L1, L2, *point.v)


def _single_support_2(s: Symbols, point: Point) -> Motion:
    """Motion of SLS-II: coordinates (theta, L1)."""
    theta, L1 = point.q
    dtheta, dL1 = point.v
    zero = 0.0 * L1
    return Motion(*sine_cosine(theta), L1, s.L0 + zero, dtheta, dL1, zero)


def _upright(s: Symbols, m: Motion, fore: dynamics.FootForce) -> Vector:
    """What must be positive in every phase: rolling on, legs not collapsed, Leg 1 pushing."""
    return m.dtheta, m.L1 - s.a, m.L2 - s.a, fore.normal


def _phases(n_legs: int) -> tuple[Phase, Phase]:
    """DLS and SLS-I, which every sequence shares."""
    symbols = functools.partial(_symbols, n_legs)

    def dls_residual(constants: Constants, point: Point, acceleration: Vector) -> Vector:
        s = symbols(constants)
        distance, m = _double_support(s, point)
        circle = double_support_circle(s, distance, m.sin, m.cos)
        M, *forces = dynamics.terms(s, m)
        centripetal = m.dtheta * m.dtheta
        along_circle = (
            acceleration[0],
            circle.G1 * acceleration[0] - circle.L1 * centripetal,
            circle.G2 * acceleration[0] - circle.L2 * centripetal,
        )
        rows = [needed - force for needed, force in zip(M.times(along_circle), forces, strict=True)]
        return (rows[0] + circle.G1 * rows[1] + circle.G2 * rows[2],)

    def rear_force(constants: Constants, point: Point) -> dynamics.FootForce:
        s = symbols(constants)
        distance, m = _double_support(s, point)
        acceleration = dynamics.double_support_acceleration(s, distance, m)
        return dynamics.rear_foot_force(s, m, acceleration)

    def lift_off(constants: Constants, point: Point) -> Elementwise:
        s = symbols(constants)
        return rear_force(constants, point).normal / (s.m * s.g)

    def dls_reset(constants: Constants, point: Point) -> Point:
        _, m = _double_support(symbols(constants), point)
        return Point((), (point.q[0], m.L1, m.L2), (m.dtheta, m.dL1, m.dL2))

    def dls_guards(constants: Constants, point: Point) -> Vector:
        s = symbols(constants)
        distance, m = _double_support(s, point)
        acceleration = dynamics.double_support_acceleration(s, distance, m)
        rear = dynamics.rear_foot_force(s, m, acceleration)
        fore = dynamics.fore_foot_force(s, m, acceleration, rear)
        return (rear.normal, s.L0 - m.L2, landing_foot_height(s, m), *_upright(s, m, fore))

    def sls1_residual(constants: Constants, point: Point, acceleration: Vector) -> Vector:
        a1, a2, a3 = acceleration
        M, *forces = dynamics.terms(symbols(constants), _single_support_1(point))
        return tuple(n - f for n, f in zip(M.times((a1, a2, a3)), forces, strict=True))

    def stopper_gap(constants: Constants, point: Point) -> Elementwise:
        s = symbols(constants)
        return point.q[2] / s.L0 - 1.0

    def sls1_reset(constants: Constants, point: Point) -> Point:
        s = symbols(constants)
        before = _single_support_1(point)
        m = transitions.stopped(s, before._replace(L2=s.L0 + 0.0 * before.L2))
        return Point((), (point.q[0], m.L1), (m.dtheta, m.dL1))

    def sls1_guards(constants: Constants, point: Point) -> Vector:
        s = symbols(constants)
        m = _single_support_1(point)
        acceleration = dynamics.single_support_1_acceleration(s, m)
        fore = dynamics.fore_foot_force(s, m, acceleration)
        return (s.L0 - m.L2, landing_foot_height(s, m), *_upright(s, m, fore))

    return (
        Phase("DLS", 1, dls_residual, lift_off, dls_reset, dls_guards),
        Phase("SLS-I", 3, sls1_residual, stopper_gap, sls1_reset, sls1_guards, smooth=False),
    )


def _last_phase(n_legs: int) -> Phase:
    """SLS-II; its reset leads to the plane section after the impact."""
    symbols = functools.partial(_symbols, n_legs)

    def residual(constants: Constants, point: Point, acceleration: Vector) -> Vector:
        s = symbols(constants)
        M, *forces = dynamics.terms(s, _single_support_2(s, point))
        return M.M11 * acceleration[0] - forces[0], M.M22 * acceleration[1] - forces[1]

    def touchdown(constants: Constants, point: Point) -> Elementwise:
        s = symbols(constants)
        return landing_foot_height(s, _single_support_2(s, point)) / s.L0

    def reset(constants: Constants, point: Point) -> Point:
        s = symbols(constants)
        (theta, _), (dtheta, dL1) = point.q, point.v
        return Point((), transitions.land_on_both(s, theta, dtheta, dL1), ())

    def guards(constants: Constants, point: Point) -> Vector:
        s = symbols(constants)
        m = _single_support_2(s, point)
        found = dynamics.single_support_2_acceleration(s, m)
        fore = dynamics.fore_foot_force(s, m, found)
        return (landing_foot_height(s, m), *_upright(s, m, fore))

    return Phase("SLS-II", 2, residual, touchdown, reset, guards)


@functools.cache
def held_landing(n_legs: int) -> PhaseSequence:
    """DLS, SLS-I, SLS-II on the plane section (theta+, dtheta+) after the impact."""

    def start(constants: Constants, section: Vector) -> Point:
        s = _symbols(n_legs, constants)
        sin, cos = sine_cosine(section[0])
        distance = s.L0 * s.sin_alpha / rear_direction(s, sin, cos).cos
        return Point((distance,), section[:1], section[1:])

    def border_checks(
        constants: Constants, passages: tuple[Passage, ...], happens: Array
    ) -> Vector:
        s = _symbols(n_legs, constants)
        dls, sls1, sls2 = passages
        distance, m = _double_support(s, dls.start)
        acceleration = dynamics.double_support_acceleration(s, distance, m)
        rear = dynamics.rear_foot_force(s, m, acceleration).normal
        (theta, _), (dtheta, dL1) = sls2.end.q, sls2.end.v
        landing = transitions.land(s, theta, dtheta, dL1)
        return jnp.where(happens[0], rear, -rear), landing.rear.normal, sls1.end.v[2]

    phases = (*_phases(n_legs), _last_phase(n_legs))
    return PhaseSequence(2, start, phases, border_checks)

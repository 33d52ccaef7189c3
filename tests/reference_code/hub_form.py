"""Formulation 2: the hub in the plane, by Newton's law on the bodies, in multiprecision.

The hub moves in Cartesian coordinates about the stance foot. Newton's law for the hub, the legs
that may telescope and the body of locked legs is projected on the admissible velocities
(Jourdain's principle); contact forces are balances of single legs. No Lagrangian, no multiplier.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import heyoka as hy
import mpmath as mp
import numpy as np

from .multiprecision import (
    Flow,
    Number,
    StepEnd,
    Vector,
    compile_expressions,
    dot,
    plus,
    solve_positive,
    step_length,
    times,
    to_mpf,
    to_real,
)


@dataclass(frozen=True)
class Bodies:
    """Constants of ``HubForm``: hub, one leg's mass, body of the n - 2 locked legs.

    The unit vectors of all n legs add up to nothing, so the body's centre of mass lies at
    hub + reach (u1 + u2) and its moment of inertia about there follows from Steiner's theorem.
    """

    hub: Number
    leg: Number
    com: Number
    locked_length: Number
    natural: Number
    k: Number
    c: Number
    gravity: Vector
    turn: Vector  # cos alpha, sin alpha
    body: Number
    reach: Number
    inertia: Number

    @staticmethod
    def constants(p: Sequence[Number]) -> Vector:
        """Field values from the parameters."""
        mH, m, a, L0, natural, k, c, phi, g, n = p
        alpha = 2 * mp.pi / n
        arm = L0 - a
        reach = arm / (n - 2)
        body = (n - 2) * m
        inertia = body * (arm**2 - reach**2 * (2 + 2 * mp.cos(alpha)))
        gravity = [g * mp.sin(phi), -g * mp.cos(phi)]
        turn = [mp.cos(alpha), mp.sin(alpha)]
        return [mH, m, a, L0, natural, k, c, *gravity, *turn, body, reach, inertia]

    @staticmethod
    def unpack(values: Sequence[Number]) -> Bodies:
        """From the flat list of ``constants``."""
        v = list(values)
        fields: list[Any] = [*v[:7], v[7:9], v[9:11], *v[11:]]
        return Bodies(*fields)

    def push(self, length: Number, rate: Number) -> Number:
        """Force with which spring and damper drive hub and foot apart, N."""
        return self.k * (self.natural - length) - self.c * rate

    def second(self, u: Vector) -> Vector:
        """Direction of Leg 2 from that of Leg 1."""
        cosine, sine = self.turn
        return [u[0] * cosine + u[1] * sine, u[1] * cosine - u[0] * sine]


def direction_derivative(u: Vector) -> Vector:
    """Derivative of a leg's direction by its angle."""
    return [u[1], -u[0]]


def split_forces(total: Vector, axial: Vector, u1: Vector, u2: Vector) -> Vector:
    """Forces of both feet, normal components, from their sum and their parts along the legs."""
    t1, t2 = direction_derivative(u1), direction_derivative(u2)
    rest = plus(total, times(-1, plus(times(axial[0], u1), times(axial[1], u2))))
    determinant = t1[0] * t2[1] - t2[0] * t1[1]
    s1 = (rest[0] * t2[1] - t2[0] * rest[1]) / determinant
    s2 = (t1[0] * rest[1] - rest[0] * t1[1]) / determinant
    return [axial[0] * u1[1] + s1 * t1[1], axial[1] * u2[1] + s2 * t2[1]]


class HubForm:
    """Single support: (X, Z) of the hub and L2. Double support: the hub's angle psi on its circle.

    With both feet down the legs' angle alpha stands on the chord between the feet, so the hub
    runs on the circle of radius rho = D / (2 sin alpha) and the wheel turns at psi' / 2.
    """

    def __init__(self) -> None:
        """Write the projected laws for each phase and compile them."""
        b = Bodies.unpack([hy.par[i] for i in range(14)])
        chord = hy.par[14]
        psi, rate = hy.make_vars("psi", "rate")
        spin, forces = self._double(b, chord, psi, rate, hy.sin, hy.cos)
        self._forces = compile_expressions(forces, [psi, rate])
        self._dls = Flow([psi, rate], [rate, spin], forces[1], 15)

        X, Z, L2 = hy.make_vars("X", "Z", "L2")
        dX, dZ, dL2 = hy.make_vars("dX", "dZ", "dL2")
        hub, velocity = [X, Z], [dX, dZ]
        matrix, right, _ = self._single(b, hub, velocity, L2, dL2, hy.sqrt)
        (rates,) = solve_positive(matrix, right)
        self._swing = Flow([X, Z, L2, dX, dZ, dL2], [dX, dZ, dL2, *rates], b.locked_length - L2, 14)

        matrix, right, u = self._single(b, hub, velocity, b.locked_length, 0, hy.sqrt)
        (rates,) = solve_positive([row[:2] for row in matrix[:2]], right[:2])
        # Height of the foot of the leg at theta - alpha.
        clearance = Z - b.locked_length * (u[1] * b.turn[0] + u[0] * b.turn[1])
        self._locked = Flow([X, Z, dX, dZ], [dX, dZ, *rates], clearance, 14)

    @staticmethod
    def _single(
        b: Bodies,
        hub: Vector,
        velocity: Vector,
        L2: Number,
        dL2: Number,
        sqrt: Callable[[Number], Number],
    ) -> tuple[list[Vector], Vector, Vector]:
        """Matrix and right side of (X'', Z'', L2'') with Leg 1's foot at the origin, and u1.

        Each body's velocity is affine in w = (X', Z', L2'); Newton's law is projected on its
        coefficients (Jourdain's principle).
        """
        L1 = sqrt(dot(hub, hub))
        u = times(1 / L1, hub)
        t, u2 = direction_derivative(u), b.second(u)
        t2 = direction_derivative(u2)
        dL1, omega = dot(u, velocity), dot(t, velocity) / L1
        turning = [t[0] / L1, t[1] / L1, 0]  # omega by w
        # omega' = turning . w' + drift
        drift = -2 * dL1 * omega / L1
        swing = L2 - b.com

        def field(direct: list[Vector], arm: Vector) -> list[Vector]:
            """Rows d(velocity) / dw, of a part in w and one in omega."""
            return [[direct[i][j] + arm[i] * turning[j] for j in range(3)] for i in range(2)]

        sum_of_directions, sum_of_tangents = plus(u, u2), plus(t, t2)
        zero, one = [0, 0, 0], [[1, 0, 0], [0, 1, 0]]
        square = omega * omega
        # mass, velocity coefficients, acceleration at w' = 0
        points: list[tuple[Number, list[Vector], Vector]] = [
            (b.hub, one, [0, 0]),
            (
                b.leg,
                field([zero, zero], times(b.com, t)),
                plus(times(b.com * drift, t), times(-b.com * square, u)),
            ),
            (
                b.leg,
                field([[1, 0, -u2[0]], [0, 1, -u2[1]]], times(-swing, t2)),
                plus(times(-swing * drift - 2 * dL2 * omega, t2), times(swing * square, u2)),
            ),
            (
                b.body,
                field(one, times(b.reach, sum_of_tangents)),
                plus(
                    times(b.reach * drift, sum_of_tangents),
                    times(-b.reach * square, sum_of_directions),
                ),
            ),
        ]
        matrix: list[Vector] = [
            [b.inertia * turning[i] * turning[j] for j in range(3)] for i in range(3)
        ]
        right = [-b.inertia * turning[i] * drift for i in range(3)]
        for mass, rows, rest in points:
            load = plus(b.gravity, times(-1, rest))
            for i in range(3):
                column = [rows[0][i], rows[1][i]]
                right[i] = right[i] + mass * dot(column, load)
                for j in range(3):
                    matrix[i][j] = matrix[i][j] + mass * dot(column, [rows[0][j], rows[1][j]])
        push = b.push(L1, dL1)
        right = plus(right, [push * u[0], push * u[1], b.push(L2, dL2)])
        return matrix, right, u

    @staticmethod
    def _circle(
        b: Bodies, chord: Number, psi: Number, sin: Callable[[Number], Number], cos: Any
    ) -> tuple[Vector, Vector, Vector, Number]:
        """Hub from either foot, its direction of travel, and the radius of its circle."""
        radius = chord / (2 * b.turn[1])
        out, tangent = [sin(psi), cos(psi)], [cos(psi), -sin(psi)]
        height = radius * (b.turn[0] + out[1])
        from1 = [-chord / 2 + radius * out[0], height]
        from2 = [chord / 2 + radius * out[0], height]
        return from1, from2, tangent, radius

    def _double(
        self, b: Bodies, chord: Number, psi: Number, rate: Number, sin: Any, cos: Any
    ) -> tuple[Number, Vector]:
        """psi'' and the normal forces (lambda2, lambda4) with both feet planted."""
        sqrt = hy.sqrt
        from1, from2, tangent, radius = self._circle(b, chord, psi, sin, cos)
        inward = [-sin(psi), -cos(psi)]
        lengths = [sqrt(dot(from1, from1)), sqrt(dot(from2, from2))]
        u = [times(1 / lengths[0], from1), times(1 / lengths[1], from2)]
        t = [direction_derivative(u[0]), direction_derivative(u[1])]
        velocity = times(radius * rate, tangent)
        pushes = [b.push(lengths[i], dot(u[i], velocity)) for i in range(2)]
        omega = rate / 2
        sum_of_directions, sum_of_tangents = plus(u[0], u[1]), plus(t[0], t[1])
        # velocities per psi', and accelerations at psi'' = 0
        hub_row = times(radius, tangent)
        hub_rest = times(radius * rate * rate, inward)
        body_row = plus(hub_row, times(b.reach / 2, sum_of_tangents))
        body_rest = plus(hub_rest, times(-b.reach * omega * omega, sum_of_directions))
        points = [(b.hub, hub_row, hub_rest), (b.body, body_row, body_rest)]
        for i in range(2):
            points.append((b.leg, times(b.com / 2, t[i]), times(-b.com * omega * omega, u[i])))
        inertia = b.inertia / 4
        power = pushes[0] * dot(u[0], hub_row) + pushes[1] * dot(u[1], hub_row)
        for mass, row, rest in points:
            inertia = inertia + mass * dot(row, row)
            power = power + mass * dot(row, plus(b.gravity, times(-1, rest)))
        spin = power / inertia
        demands = [
            times(mass, plus(plus(times(spin, row), rest), times(-1, b.gravity)))
            for mass, row, rest in points
        ]
        total = plus(plus(demands[0], demands[1]), plus(demands[2], demands[3]))
        axial = [dot(demands[2 + i], u[i]) + pushes[i] for i in range(2)]
        return spin, split_forces(total, axial, u[0], u[1])

    def land(self, x: Sequence[Number], p: Sequence[Number]) -> tuple[Vector, Number]:
        """Momentum along the one admissible motion stays; the legs' balances give lambda_I4."""
        b = Bodies.unpack(Bodies.constants(p))
        alpha = 2 * mp.pi / p[9]
        theta, omega, dL1 = x
        new = theta - alpha
        u2, u1 = [mp.sin(theta), mp.cos(theta)], [mp.sin(new), mp.cos(new)]
        t1, t2 = direction_derivative(u1), direction_derivative(u2)
        L1, L2 = p[3], p[3] * u1[1] / u2[1]
        sum_of_tangents = plus(t1, t2)
        hub = plus(times(dL1, u2), times(L2 * omega, t2))
        before = [
            (b.hub, hub),
            (b.body, plus(hub, times(b.reach * omega, sum_of_tangents))),
            (b.leg, plus(hub, times(-(L1 - b.com) * omega, t1))),
            (b.leg, times(b.com * omega, t2)),
        ]
        # The hub's velocity per unit turning rate: about the point opposite on the circle, where
        # the normals to both legs at the feet meet.
        foot2 = plus(times(L1, u1), times(-L2, u2))
        normal1, normal2 = t1, t2
        determinant = normal1[0] * normal2[1] - normal2[0] * normal1[1]
        reach = (foot2[0] * normal2[1] - normal2[0] * foot2[1]) / determinant
        centre = times(reach, normal1)
        row = direction_derivative(plus(times(L1, u1), times(-1, centre)))
        rows = [row, plus(row, times(b.reach, sum_of_tangents)), times(b.com, t1), times(b.com, t2)]
        retained_momentum = b.inertia * omega + mp.fsum(
            mass * dot(r, v) for (mass, v), r in zip(before, rows, strict=True)
        )
        resist = b.inertia + mp.fsum(
            mass * dot(r, r) for (mass, _), r in zip(before, rows, strict=True)
        )
        after = retained_momentum / resist
        jumps = [
            times(mass, plus(times(after, r), times(-1, v)))
            for (mass, v), r in zip(before, rows, strict=True)
        ]
        total = plus(plus(jumps[0], jumps[1]), plus(jumps[2], jumps[3]))
        axial = [dot(jumps[2], u1), dot(jumps[3], u2)]
        return [new, after], split_forces(total, axial, u1, u2)[1]

    def walk(self, y: Sequence[Number], p: Sequence[Number], about: Sequence[float]) -> StepEnd:
        """Double support on the circle, then the hub's free path, collision II, SLS-II."""
        constants = Bodies.constants(p)
        b = Bodies.unpack(constants)
        alpha = 2 * mp.pi / p[9]
        theta, omega = y
        chord = step_length(y, p)
        # The angle at the circle is half the angle at its centre.
        state = [2 * theta + alpha, 2 * omega]
        packed = np.array([to_real(value) for value in [*constants, chord]])
        forces = self._forces(np.array([to_real(value) for value in state]), packed)
        state, double = self._dls.until_guard(state, [*constants, chord], about[0])

        hub, from2, tangent, radius = self._circle(b, chord, state[0], mp.sin, mp.cos)
        velocity = times(radius * state[1], tangent)
        L2 = mp.sqrt(dot(from2, from2))
        state = [*hub, L2, *velocity, dot(from2, velocity) / L2]
        state, swing = self._swing.until_guard(state, constants, about[1])

        # Collision II: momentum in the two motions that stay free.
        matrix, _, _ = self._single(b, state[:2], state[3:5], state[2], state[5], mp.sqrt)
        retained_rows = [dot(row, state[3:]) for row in matrix[:2]]
        (after,) = solve_positive([row[:2] for row in matrix[:2]], retained_rows)
        state, locked = self._locked.until_guard([*state[:2], *after], constants, about[2])
        hub, velocity = state[:2], state[2:]
        L1 = mp.sqrt(dot(hub, hub))
        u = times(1 / L1, hub)
        section = [
            mp.atan2(u[0], u[1]),
            dot(direction_derivative(u), velocity) / L1,
            dot(u, velocity),
        ]
        return StepEnd(section, [double, swing, locked], [to_mpf(f) for f in forces])

"""Equations of motion of the wheel in q = (x, z, theta, L1, L2).

Written by ``derive_five_coordinates.py`` from the Lagrangian; do not edit by hand. The arguments
are q, v = q', w = q'' (m, rad, s) and p = (mH, m, a, L0, phi, g, alpha, n_locked, C, S), where C
and S are the sums of cos and sin of (j - 1) alpha over the locked legs j = 3..n. Any numbers that
add, multiply and come with a sine and a cosine will do: floats, multiprecision, symbols.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

Numbers = Iterable[Any]


def mass_matrix(
    q: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Mass matrix M(q) of eq. (1)."""
    _, _, theta, L1, L2 = q
    mH, m, a, L0, _, _, alpha, n_locked, C, S = p
    t0 = 2 * m
    t1 = m * n_locked
    t2 = mH + t1
    t3 = t0 + t2
    t4 = cos(theta)
    t5 = L1 * t4
    t6 = a * m
    t7 = sin(theta)
    t8 = L0 - a
    t9 = m * t8
    t10 = alpha + theta
    t11 = cos(t10)
    t12 = -C * t4 * t9 + S * t7 * t9 + m * (-L2 * t11 + a * t11 + t5) + mH * t5 + t1 * t5 + t4 * t6
    t13 = m + t2
    t14 = t13 * t7
    t15 = sin(t10)
    t16 = -m * t15
    t17 = L1 * t7
    t18 = (
        C * m * t7 * t8
        + S * m * t4 * t8
        - m * (-L2 * t15 + a * t15 + t17)
        - mH * t17
        - t1 * t17
        - t6 * t7
    )
    t19 = t13 * t4
    t20 = -m * t11
    t21 = L1**2
    t22 = a**2
    t23 = 2 * a
    t24 = t21 + t22
    t25 = cos(alpha)
    t26 = L1 * t25
    t27 = sin(alpha)
    t28 = m * (L0 * S + L2 * t27 - S * a - a * t27)
    t29 = -L1 * m * t27
    t30 = -m * t25
    return [
        [t3, 0, t12, t14, t16],
        [0, t3, t18, t19, t20],
        [
            t12,
            t18,
            -C * L1 * t0 * t8
            + m * t22
            + m * (L2**2 - L2 * t23 - 2 * L2 * t26 + t23 * t26 + t24)
            + mH * t21
            + t1 * (L0**2 - L0 * t23 + t24),
            t28,
            t29,
        ],
        [t14, t19, t28, t13, t30],
        [t16, t20, t29, t30, m],
    ]


def bias(
    q: Numbers,
    v: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """h(q, q', phi) of eq. (1): Coriolis, centrifugal and gravity terms."""
    _, _, theta, L1, L2 = q
    _, _, dtheta, dL1, dL2 = v
    mH, m, a, L0, phi, g, alpha, n_locked, C, S = p
    t0 = sin(phi)
    t1 = g * mH
    t2 = g * m
    t3 = 2 * t2
    t4 = m * n_locked
    t5 = g * t4
    t6 = alpha + theta
    t7 = cos(t6)
    t8 = dL2 * t7
    t9 = dtheta * m
    t10 = cos(theta)
    t11 = m + mH + t4
    t12 = sin(theta)
    t13 = a * t9
    t14 = t9 * (L0 - a)
    t15 = t12 * t14
    t16 = t10 * t14
    t17 = -dL1 * t10
    t18 = L1 * t12
    t19 = dtheta * t18 + t17
    t20 = sin(t6)
    t21 = cos(phi)
    t22 = dL2 * t20
    t23 = dL1 * t12
    t24 = L1 * t10
    t25 = dtheta * t24 + t23
    t26 = 2 * dL2
    t27 = 2 * dL1
    t28 = t27 * t9
    t29 = phi + theta
    t30 = sin(t29)
    t31 = L1 * t30
    t32 = a * t2 * t30
    t33 = cos(alpha)
    t34 = t26 * t9
    t35 = phi + t6
    t36 = sin(t35)
    t37 = cos(t29)
    t38 = t2 * t37
    t39 = dtheta**2
    t40 = L1 * t39
    t41 = C * m
    t42 = sin(alpha)
    t43 = a * t39
    t44 = L2 * t39
    t45 = m * t33
    return [
        dL1 * dtheta * t10 * t11
        - dtheta
        * (
            -C * t15
            - S * t16
            + m * (dtheta * (-L2 * t20 + a * t20 + t18) + t17 + t8)
            + mH * t19
            + t12 * t13
            + t19 * t4
        )
        - t0 * t1
        - t0 * t3
        - t0 * t5
        - t8 * t9,
        -dtheta * t11 * t23
        - dtheta
        * (
            -C * t16
            + S * t15
            + m * (dtheta * (-L2 * t7 + a * t7 + t24) - t22 + t23)
            + mH * t25
            + t10 * t13
            + t25 * t4
        )
        + t1 * t21
        + t21 * t3
        + t21 * t5
        + t22 * t9,
        C * L0 * g * m * t30
        - C * L0 * t28
        + 2 * C * a * dL1 * dtheta * m
        - C * t32
        + L0 * S * g * m * t37
        + 2 * L1 * dL1 * dtheta * m * n_locked
        + 2 * L1 * dL1 * dtheta * m
        + 2 * L1 * dL1 * dtheta * mH
        - L1 * t33 * t34
        + 2 * L2 * dL2 * dtheta * m
        + L2 * g * m * t36
        - L2 * t28 * t33
        - S * a * t38
        + 2 * a * dL1 * dtheta * m * t33
        - a * t2 * t36
        - t1 * t31
        - t13 * t26
        - t2 * t31
        - t31 * t5
        - t32,
        L0 * t39 * t41
        - m * t40
        - mH * t40
        + t1 * t37
        + t34 * t42
        + t37 * t5
        + t38
        - t4 * t40
        - t41 * t43
        - t43 * t45
        + t44 * t45,
        -m * (dtheta * t27 * t42 + g * cos(t35) - t33 * t40 - t43 + t44),
    ]


def jacobian(
    q: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Contact Jacobian J_DLS(q) of eq. (11), J43 as it must be."""
    _, _, theta, L1, L2 = q
    _, _, _, _, _, _, alpha, _, _, _ = p
    t0 = cos(theta)
    t1 = alpha + theta
    t2 = cos(t1)
    t3 = sin(theta)
    t4 = sin(t1)
    return [
        [1, 0, 0, 0, 0],
        [0, 1, 0, 0, 0],
        [1, 0, L1 * t0 - L2 * t2, t3, -t4],
        [0, 1, -L1 * t3 + L2 * t4, t0, -t2],
    ]


def jacobian_rate(
    q: Numbers,
    v: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """J_DLS'(q, q') q' of eq. (4), m/s^2."""
    _, _, theta, L1, L2 = q
    _, _, dtheta, dL1, dL2 = v
    _, _, _, _, _, _, alpha, _, _, _ = p
    t0 = cos(theta)
    t1 = alpha + theta
    t2 = cos(t1)
    t3 = sin(theta)
    t4 = sin(t1)
    return [
        0,
        0,
        dtheta * (2 * dL1 * t0 - 2 * dL2 * t2 - dtheta * (L1 * t3 - L2 * t4)),
        dtheta * (-2 * dL1 * t3 + 2 * dL2 * t4 - dtheta * (L1 * t0 - L2 * t2)),
    ]


def energies(
    q: Numbers,
    v: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Kinetic energy and potential energy of gravity, J."""
    x, z, theta, L1, L2 = q
    dx, dz, dtheta, dL1, dL2 = v
    mH, m, a, L0, phi, g, alpha, n_locked, C, S = p
    t0 = cos(theta)
    t1 = a * t0
    t2 = sin(theta)
    t3 = a * t2
    t4 = (1 / 2) * m
    t5 = L1 * t0
    t6 = dtheta * t5
    t7 = dL1 * t2
    t8 = dx + t7
    t9 = L1 * t2
    t10 = dtheta * t9
    t11 = dL1 * t0
    t12 = dz + t11
    t13 = L0 * dx
    t14 = L0 * dz
    t15 = t2**2
    t16 = L0 * dL1
    t17 = t0**2
    t18 = a * dL1
    t19 = L1 * dtheta
    t20 = t15 * t19
    t21 = L0 * t17
    t22 = alpha + theta
    t23 = cos(t22)
    t24 = -L2 * t23 + a * t23
    t25 = sin(t22)
    t26 = -L2 * t25 + a * t25
    t27 = 2 * dx
    t28 = 2 * dz
    t29 = dL1**2
    t30 = dtheta**2
    t31 = L0**2 * t30
    t32 = L1**2 * t30
    t33 = a**2 * t30
    t34 = 2 * a * t30
    t35 = sin(phi)
    t36 = cos(phi)
    t37 = t9 + x
    t38 = t5 + z
    t39 = L0 * t2
    t40 = L0 * t0
    return [
        -C
        * dtheta
        * m
        * (L0 * t20 - a * t17 * t19 - a * t20 - dx * t1 + dz * t3 + t0 * t13 - t14 * t2 + t19 * t21)
        + S
        * dtheta
        * m
        * (-dx * t3 - dz * t1 + t0 * t14 + t13 * t2 + t15 * t16 - t15 * t18 + t16 * t17 - t17 * t18)
        + (1 / 2) * mH * ((-t10 + t12) ** 2 + (t6 + t8) ** 2)
        + n_locked
        * t4
        * (
            -L0 * t15 * t34
            + dx**2
            + dz**2
            - t10 * t28
            + t11 * t28
            + t15 * t29
            + t15 * t31
            + t15 * t32
            + t15 * t33
            + t17 * t29
            + t17 * t31
            + t17 * t32
            + t17 * t33
            - t21 * t34
            + t27 * t6
            + t27 * t7
        )
        + t4 * ((dtheta * t1 + dx) ** 2 + (dtheta * t3 - dz) ** 2)
        + t4
        * (
            (-dL2 * t23 - dtheta * (t26 + t9) + t12) ** 2
            + (-dL2 * t25 + dtheta * (t24 + t5) + t8) ** 2
        ),
        g
        * (
            C * m * (t1 * t36 - t3 * t35 + t35 * t39 - t36 * t40)
            + S * m * (-t1 * t35 - t3 * t36 + t35 * t40 + t36 * t39)
            - m * n_locked * (t35 * t9 + t35 * x - t36 * t5 - t36 * z)
            - m * (t35 * (t26 + t37) - t36 * (t24 + t38))
            - m * (t35 * (t3 + x) - t36 * (t1 + z))
            - mH * (t35 * t37 - t36 * t38)
        ),
    ]


def feet(
    q: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Positions x1, z1, x2, z2 of both feet, m."""
    x, z, theta, L1, L2 = q
    _, _, _, _, _, _, alpha, _, _, _ = p
    t0 = alpha + theta
    return [
        x,
        z,
        L1 * sin(theta) - L2 * sin(t0) + x,
        L1 * cos(theta) - L2 * cos(t0) + z,
    ]


def hub(
    q: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Position of the hub, m."""
    x, z, theta, L1, _ = q
    return [
        L1 * sin(theta) + x,
        L1 * cos(theta) + z,
    ]


def hub_velocity(
    q: Numbers,
    v: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Velocity of the hub, m/s."""
    _, _, theta, L1, _ = q
    dx, dz, dtheta, dL1, _ = v
    t0 = sin(theta)
    t1 = cos(theta)
    t2 = L1 * dtheta
    return [
        dL1 * t0 + dx + t1 * t2,
        dL1 * t1 + dz - t0 * t2,
    ]


def hub_acceleration(
    q: Numbers,
    v: Numbers,
    w: Numbers,
    p: Numbers,
    sin: Callable[[Any], Any] = math.sin,
    cos: Callable[[Any], Any] = math.cos,
) -> list[Any]:
    """Acceleration of the hub, m/s^2."""
    _, _, theta, L1, _ = q
    _, _, dtheta, dL1, _ = v
    ddx, ddz, ddtheta, ddL1, _ = w
    t0 = sin(theta)
    t1 = cos(theta)
    t2 = L1 * ddtheta
    t3 = dL1 * t1
    t4 = L1 * dtheta
    t5 = dL1 * t0
    return [
        ddL1 * t0 + ddx + dtheta * t3 - dtheta * (t0 * t4 - t3) + t1 * t2,
        ddL1 * t1 + ddz - dtheta * t5 - dtheta * (t1 * t4 + t5) - t0 * t2,
    ]

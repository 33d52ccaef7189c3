"""Reference of unilateral contact: Moreau-Jean time stepping in eleven coordinates, in NumPy.

There are no events and no modes. Each time step solves the laws of Signorini and Coulomb for the
velocities at its end by projected Gauss-Seidel. The method has first order. It shares no code with
the library. Labels of legs are those of the starting step. A leg in the air that reaches its
stopper stays on it until its foot carries load. A leg on the ground has a one-sided stopper; with
`one_sided`, all legs have.
"""

from typing import NamedTuple

import numpy as np

N = 8
ALPHA = 2.0 * np.pi / N


class TimeSteppingWheel(NamedTuple):
    """Table 1, slope 0.30; SI units."""

    friction: float
    c: float = 200.0
    k: float = 500.0
    m_hub: float = 10.0
    m: float = 1.0
    a: float = 0.3
    L0: float = 1.0
    Ls: float = 1.02
    slope: float = 0.30
    g: float = 9.81
    one_sided: bool = False


class StepStart(NamedTuple):
    """Just before a foot lands, in the labels of the step that begins: that foot is Leg 0's."""

    q: np.ndarray  # hub x, z, theta, lengths
    v: np.ndarray  # their rates
    locked: np.ndarray  # legs on their stoppers
    loaded_feet: np.ndarray  # feet that carried load


class StepEnd(NamedTuple):
    """Where the next foot ahead landed."""

    time: float
    theta: float
    dtheta: float
    loaded_twice: float  # time with two feet loaded, s
    end: StepStart


def _legs(theta):
    psi = theta + ALPHA * np.arange(N)
    return np.stack([np.sin(psi), np.cos(psi)], 1), np.stack([np.cos(psi), -np.sin(psi)], 1)


def _mass_and_force(w, q, v):
    """Mass matrix by the Jacobians of all point masses, and all smooth forces."""
    u, e = _legs(q[2])
    gravity = w.g * np.array([np.sin(w.slope), -np.cos(w.slope)])
    mass = np.zeros((3 + N, 3 + N))
    force = np.zeros(3 + N)
    mass[0, 0] = mass[1, 1] = w.m_hub
    force[:2] = w.m_hub * gravity
    for j in range(N):
        b = q[3 + j] - w.a
        jacobian = np.zeros((2, 3 + N))
        jacobian[:, :2] = np.eye(2)
        jacobian[:, 2] = -b * e[j]
        jacobian[:, 3 + j] = -u[j]
        bias = -2.0 * v[3 + j] * v[2] * e[j] + b * v[2] ** 2 * u[j]
        mass += w.m * jacobian.T @ jacobian
        force += w.m * jacobian.T @ (gravity - bias)
    force[3:] += w.k * (w.Ls - q[3:]) - w.c * v[3:]
    return mass, force


def _foot_rows(q, j):
    """Tangential and normal velocity of foot j over all velocities."""
    u, e = _legs(q[2])
    rows = np.zeros((2, 3 + N))
    rows[:, :2] = np.eye(2)
    rows[:, 2] = -q[3 + j] * e[j]
    rows[:, 3 + j] = -u[j]
    return rows


def _gaps(q):
    u, _ = _legs(q[2])
    return q[1] - q[3:] * u[:, 1]


def _solve(w, W, free, feet, guess):
    """Impulses: pairs (tangential, normal) of the feet, then stoppers, each at least zero."""
    p = guess.copy()
    for _ in range(500):
        before = p.copy()
        for i in range(feet):
            t, n = 2 * i, 2 * i + 1
            p[n] = max(0.0, p[n] - (W[n] @ p + free[n]) / W[n, n])
            p[t] = np.clip(
                p[t] - (W[t] @ p + free[t]) / W[t, t], -w.friction * p[n], w.friction * p[n]
            )
        for i in range(2 * feet, len(p)):
            p[i] = max(0.0, p[i] - (W[i] @ p + free[i]) / W[i, i])
        if np.max(np.abs(p - before)) < 1e-13:
            break
    return p


def paper_start(w: TimeSteppingWheel, theta: float, dtheta: float, dL1: float) -> StepStart:
    """From the paper's section state, in the labels of the step that ends."""
    L1 = w.L0 * np.cos(theta - ALPHA) / np.cos(theta)
    q = np.zeros(3 + N)
    v = np.zeros(3 + N)
    q[2], v[2] = theta - ALPHA, dtheta
    q[3:] = w.L0
    q[4], v[4] = L1, dL1
    q[1] = L1 * np.cos(theta)
    v[0] = dL1 * np.sin(theta) + L1 * dtheta * np.cos(theta)
    v[1] = dL1 * np.cos(theta) - L1 * dtheta * np.sin(theta)
    return StepStart(q, v, np.arange(N) > 1, np.arange(N) == 1)


def _next_start(q: np.ndarray, v: np.ndarray, locked: np.ndarray, carried: np.ndarray) -> StepStart:
    """The same wheel in the labels of the step that begins, the hub above its landing foot."""
    roll = lambda x: np.concatenate([x[:2], [x[2] - ALPHA], np.roll(x[3:], 1)])
    q = roll(q)
    q[0] = q[3] * np.sin(q[2])
    v = np.concatenate([v[:3], np.roll(v[3:], 1)])
    return StepStart(q, v, np.roll(locked, 1), np.roll(carried, 1))


def compute_step(w: TimeSteppingWheel, start: StepStart, h: float) -> StepEnd:
    """From a landing to the next one ahead."""
    q, v = start.q.copy(), start.v.copy()
    locked, carried = start.locked & (not w.one_sided), start.loaded_feet.copy()
    time, twice = 0.0, 0.0
    impulses = {}
    while time < 3.0:
        mass, force = _mass_and_force(w, q + 0.5 * h * v, v)
        middle = q + 0.5 * h * v
        gaps = _gaps(middle)
        feet = [j for j in range(N - 1) if gaps[j] <= 0.0 or carried[j]]
        for j in feet:
            locked[j] = False
        stops = [j for j in (range(N) if w.one_sided else feet) if middle[3 + j] >= w.L0]
        free_axes = np.concatenate([np.arange(3), 3 + np.flatnonzero(~locked)])
        rows = [r for j in feet for r in _foot_rows(middle, j)]
        rows += [-np.eye(3 + N)[3 + j] for j in stops]
        inverse = np.linalg.inv(mass[np.ix_(free_axes, free_axes)])
        following = np.zeros(3 + N)
        momentum = (mass @ v + h * force)[free_axes]
        following[free_axes] = inverse @ momentum
        if rows:
            J = np.array(rows)[:, free_axes]
            W, free = J @ inverse @ J.T, J @ following[free_axes]
            gap_values = _gaps(q)
            for i, j in enumerate(feet):  # the gap counts for feet that carried load before
                if carried[j]:
                    free[2 * i + 1] += gap_values[j] / h
            guess = np.concatenate(
                [impulses.get(j, np.zeros(2)) for j in feet] + [np.zeros(len(stops))]
            )
            p = _solve(w, W, free, len(feet), guess)
            impulses = {j: p[2 * i : 2 * i + 2] for i, j in enumerate(feet)}
            following[free_axes] += inverse @ (J.T @ p)
            carried = np.zeros(N, bool)
            for i, j in enumerate(feet):
                carried[j] = p[2 * i + 1] > 0.0
        else:
            carried[:] = False
        before = _gaps(q)[N - 1]
        q = q + h * following
        v = following
        after = _gaps(q)[N - 1]
        share = before / (before - after) if after <= 0.0 < before else 1.0
        time += share * h
        twice += share * h * (np.sum(carried) >= 2)
        if share < 1.0:
            q = q - (1.0 - share) * h * v
            return StepEnd(time, q[2], v[2], twice, _next_start(q, v, locked, carried))
        hits = ~locked & (q[3:] >= w.L0) & ~carried & (not w.one_sided)
        if np.any(hits):  # inelastic: the leg joins the rigid rest with its momentum
            locked |= hits
            mass, _ = _mass_and_force(w, q, v)
            axes = np.concatenate([np.arange(3), 3 + np.flatnonzero(~locked)])
            planted = [r for j in np.flatnonzero(carried) for r in _foot_rows(q, j)]
            inverse = np.linalg.inv(mass[np.ix_(axes, axes)])
            joined = np.zeros(3 + N)
            joined[axes] = inverse @ (mass @ v)[axes]
            if planted:
                J = np.array(planted)[:, axes]
                p = _solve(
                    w,
                    J @ inverse @ J.T,
                    J @ joined[axes],
                    len(planted) // 2,
                    np.zeros(len(planted)),
                )
                joined[axes] += inverse @ (J.T @ p)
            v = joined
            q[3:][hits] = w.L0
    raise RuntimeError("no landing within 3 s")

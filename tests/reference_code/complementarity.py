"""Reference of unilateral contact: event-driven in eleven coordinates, dense, in NumPy and SciPy.

The coordinates are those of the hub (x, z), theta and all lengths. Contacts and stoppers are
multipliers on the dense mass matrix. At an event all touching feet and legs form one
complementarity problem, of which every mode is solved: with impulses if a foot or leg strikes, then
with forces. If rounding admits several modes, each is followed for a microsecond, and the mode
whose signs hold is right. The module shares no code with the library. Labels of legs are those of
the starting step.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq, minimize_scalar

N = 8
ALPHA = 2.0 * np.pi / N
CONTACT_OFF, CONTACT_STICK, SLIP_DOWNHILL, SLIP_UPHILL = 0, 1, 2, 3
SLIP_DIRECTIONS = {SLIP_DOWNHILL: 1.0, SLIP_UPHILL: -1.0}
REST_SPEED = 1.4e-6  # m/s: what parts or closes more slowly is at rest, a dip of 1e-13 m
BOUNCE_SPEED = 1e-5  # m/s: a foot that would come back more slowly stays, it would rise 1e-13 m
TOUCH_TOLERANCE = 1e-13  # m
ADMISSIBILITY_TOLERANCE = 1e-9  # of weight and gravity, of momentum and speed: a sign is rounding
ARMED_TOLERANCE = {"gap": 1e-14, "room": 1e-14, "speed": 1e-12, "force": 1e-10}
"""A guard that has read more than this is one that may fall: m, m/s, N. So is what an impact has
thrown off, whose flight may rise by less: its speed says that it leaves."""
SHORT_TIME_SECONDS = 1e-6  # s, for which modes are followed that rounding cannot tell apart
RTOL = ATOL = 1e-13


class NoAdmissibleContactError(RuntimeError):
    """The walk ends here: no or several solutions, a third foot, no landing."""


class ComplementarityWheel(NamedTuple):
    """Table 1, slope 0.30; SI units."""

    friction: float | np.ndarray  # of all feet, or of each
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
    restitution: float = 0.0  # of the feet
    tilt: float = 0.0  # by which the ground ahead of the foot that landed is steeper, rad
    leg_force: Any = None  # function of all lengths and rates, instead of spring and damper, N
    hub_torque: Any = None  # function of the rate of theta, N m

    @property
    def mass(self) -> float:
        return self.m_hub + N * self.m

    @property
    def friction_by_foot(self) -> np.ndarray:
        return np.broadcast_to(self.friction, (N,))


class HybridState(NamedTuple):
    """Between two events: coordinates, rates, modes of feet, legs on stoppers."""

    q: np.ndarray  # hub x, z, theta, lengths
    v: np.ndarray
    mode: tuple
    is_locked: tuple


class StepResult(NamedTuple):
    """From a landing to the next one ahead."""

    durations: np.ndarray  # with two feet loaded, one, none, s
    end: HybridState  # just before that landing, in the labels of the step that follows
    events: int
    ambiguous: int  # events at which several modes held


def paper_start(w: ComplementarityWheel, theta: float, dtheta: float, dL1: float) -> HybridState:
    """From the paper's section numbers."""
    L1 = w.L0 * np.cos(theta - ALPHA) / np.cos(theta)
    q, v = np.zeros(3 + N), np.zeros(3 + N)
    q[2], v[2] = theta - ALPHA, dtheta
    q[3:] = w.L0
    q[4], v[4] = L1, dL1
    q[0], q[1] = w.L0 * np.sin(q[2]), L1 * np.cos(theta)
    v[0] = dL1 * np.sin(theta) + L1 * dtheta * np.cos(theta)
    v[1] = dL1 * np.cos(theta) - L1 * dtheta * np.sin(theta)
    return HybridState(
        q,
        v,
        (CONTACT_OFF, CONTACT_STICK, *(CONTACT_OFF,) * (N - 2)),
        tuple(j != 1 for j in range(N)),
    )


def _legs(theta):
    psi = theta + ALPHA * np.arange(N)
    return np.stack([np.sin(psi), np.cos(psi)], 1), np.stack([np.cos(psi), -np.sin(psi)], 1)


def _points(q, v, arm):
    """Velocity of a point on each leg, `arm` from the hub, over all rates; and what it is more."""
    u, e = _legs(q[2])
    rows = np.zeros((N, 2, 3 + N))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, :, 2] = -arm[:, None] * e
    rows[np.arange(N), :, 3 + np.arange(N)] = -u
    extra_values = -2.0 * (v[3:] * v[2])[:, None] * e + (arm * v[2] ** 2)[:, None] * u
    return rows, extra_values


def _mass_and_force(w, q, v):
    rows, extra_values = _points(q, v, q[3:] - w.a)
    gravity = w.g * np.array([np.sin(w.slope), -np.cos(w.slope)])
    flat = rows.reshape(2 * N, -1)
    mass = w.m * flat.T @ flat
    mass[0, 0] += w.m_hub
    mass[1, 1] += w.m_hub
    force = w.m * flat.T @ (gravity - extra_values).ravel()
    force[:2] += w.m_hub * gravity
    if w.leg_force is None:
        force[3:] += w.k * (w.Ls - q[3:]) - w.c * v[3:]
    else:
        force[3:] += w.leg_force(q[3:], v[3:])
    if w.hub_torque is not None:
        force[2] += w.hub_torque(v[2])
    return mass, force


def _gaps(w, q):
    """Heights of the feet; the last one's over its own ground, which begins under Leg 0's foot."""
    u, _ = _legs(q[2])
    places = q[:2] - q[3:, None] * u
    ahead = places[-1] - [places[0, 0], 0.0]
    return np.r_[places[:-1, 1], ahead @ [np.sin(w.tilt), np.cos(w.tilt)]]


def _locked_rows(legs):
    return -np.eye(3 + N)[3 + np.array(legs, int)]


def _contact_rows(w, q, v, mode):
    """Of loaded feet: rows of what is at rest, along what forces act, and which these are."""
    feet, extra_values = _points(q, v, q[3:])
    rows, force_directions, bias, where = [], [], [], []
    for j in range(N):
        if mode[j] == CONTACT_OFF:
            continue
        drag = -SLIP_DIRECTIONS.get(mode[j], 0.0) * w.friction_by_foot[j]
        rows.append(feet[j, 1])
        force_directions.append(feet[j, 1] + drag * feet[j, 0])
        bias.append(extra_values[j, 1])
        where.append((j, drag, 1.0))
        if mode[j] == CONTACT_STICK:
            rows.append(feet[j, 0])
            force_directions.append(feet[j, 0])
            bias.append(extra_values[j, 0])
            where.append((j, 1.0, 0.0))
    return rows, force_directions, bias, where


def is_singular(w, q, v, mode, is_locked):
    """Vanishes where no forces keep a sliding foot on the ground: Painlevé's singularity."""
    mass, _ = _mass_and_force(w, q, v)
    rows, force_directions, *_ = _contact_rows(w, q, v, mode)
    stops = list(_locked_rows(np.flatnonzero(is_locked)))
    return np.linalg.det(
        np.array(rows + stops) @ np.linalg.solve(mass, np.array(force_directions + stops).T)
    )


def _solve_contact_forces(w, q, v, mode, is_locked):
    """Accelerations in these modes; forces (tangential, normal) of feet; stopper forces."""
    mass, force = _mass_and_force(w, q, v)
    rows, force_directions, bias, where = _contact_rows(w, q, v, mode)
    legs = np.flatnonzero(is_locked)
    rows = np.array(rows + list(_locked_rows(legs))).reshape(-1, 3 + N)
    force_directions = np.array(force_directions + list(_locked_rows(legs))).reshape(-1, 3 + N)
    bias = np.r_[bias, np.zeros(len(legs))]
    solved = np.linalg.solve(mass, np.column_stack([force, force_directions.T]))
    p = -np.linalg.solve(rows @ solved[:, 1:], rows @ solved[:, 0] + bias) if len(rows) else bias
    on_feet, on_legs = np.zeros((N, 2)), np.zeros(N)
    for (j, x, z), value in zip(where, p, strict=False):
        on_feet[j] += value * np.array([x, z])
    on_legs[legs] = p[len(where) :]
    return solved[:, 0] + solved[:, 1:] @ p, on_feet, on_legs


class _ContactProblem(NamedTuple):
    """One level: what touches, and what may become of it."""

    inverse: np.ndarray
    free: np.ndarray  # rates or accelerations without contacts
    feet: list  # those that touch
    may: list  # modes of each
    legs: list  # on stoppers that only push
    locked: list  # on stoppers that hold
    rows: np.ndarray  # tangential and normal of each foot, then of legs, then of locked
    bias: np.ndarray
    scales: tuple  # force, motion


def _enumerate_solutions(w, problem, signs):
    """All modes whose signs are wrong by less than `signs`: feet's, legs held, rates after."""
    inverse, free, feet, may, legs, _, rows, bias, (F, A) = problem
    W, w0 = rows @ inverse @ rows.T, rows @ free + bias
    combos = list(itertools.product(*may, *((True, False),) * len(legs)))
    d, f = len(w0), 2 * len(feet)
    lhs, rhs = np.tile(np.eye(d), (len(combos), 1, 1)), np.zeros((len(combos), d))
    modes = np.array([c[: len(feet)] for c in combos], int).reshape(len(combos), -1)
    is_active = np.array([c[len(feet) :] for c in combos], bool).reshape(len(combos), -1)
    active = np.zeros((len(combos), d), bool)
    active[:, 0:f:2], active[:, 1:f:2] = modes == CONTACT_STICK, modes != CONTACT_OFF
    active[:, f : f + len(legs)], active[:, f + len(legs) :] = is_active, True
    lhs[active], rhs[active] = (
        np.broadcast_to(W, lhs.shape)[active],
        -np.tile(w0, (len(rhs), 1))[active],
    )
    for i, j in enumerate(feet):
        sign = np.where(
            modes[:, i] == SLIP_DOWNHILL, 1.0, np.where(modes[:, i] == SLIP_UPHILL, -1.0, 0.0)
        )
        lhs[sign != 0.0, 2 * i, 2 * i + 1] = w.friction_by_foot[j] * sign[sign != 0.0]
    regular = np.abs(np.linalg.det(lhs)) > 1e-12 * np.prod(np.linalg.norm(lhs, axis=2), axis=1)
    lhs[~regular] = np.eye(d)
    p = np.linalg.solve(lhs, rhs[..., None])[..., 0]
    after = p @ W.T + w0
    wrong = np.where(regular, 0.0, np.inf)
    worse = lambda where, value: np.maximum(wrong, np.where(where, value, 0.0))
    for i, j in enumerate(feet):
        m, t, n = modes[:, i], 2 * i, 2 * i + 1
        wrong = worse(m == CONTACT_OFF, -after[:, n] / A)
        wrong = worse(m == CONTACT_STICK, -p[:, n] / F)
        dragged = -max(1.0, w.friction_by_foot[j]) * p[:, n]  # a pull of rounding may drag by more
        wrong = worse((m == SLIP_DOWNHILL) | (m == SLIP_UPHILL), dragged / F)
        wrong = worse(m == CONTACT_STICK, (np.abs(p[:, t]) - w.friction_by_foot[j] * p[:, n]) / F)
        if CONTACT_STICK in may[i]:  # else it slides, and may speed up or slow down
            wrong = worse(m == SLIP_DOWNHILL, -after[:, t] / A)
            wrong = worse(m == SLIP_UPHILL, after[:, t] / A)
    for i in range(len(legs)):
        wrong = worse(is_active[:, i], -p[:, f + i] / F)
        wrong = worse(~is_active[:, i], -after[:, f + i] / A)
    good = np.flatnonzero(wrong < signs)
    turn = inverse @ rows.T
    return [(tuple(modes[g]), tuple(is_active[g]), free + turn @ p[g]) for g in good]


def _select_preferred(solution):
    """Most feet at rest, then most sliding."""
    rank = {CONTACT_STICK: 0, SLIP_DOWNHILL: 1, SLIP_UPHILL: 1, CONTACT_OFF: 2}
    return min(solution, key=lambda one: (sum(rank[m] for m in one[0]), sum(one[1])))


def _solve_acceleration_level(w, q, v, feet, may, at_stopper, moving):
    """The problem of these feet and legs, by accelerations or by rates."""
    mass, force = _mass_and_force(w, q, v)
    inverse = np.linalg.inv(mass)
    of_feet, extra_values = _points(q, v, q[3:])
    unilateral = [j for j in at_stopper if w.one_sided or j in feet]
    locked = [j for j in at_stopper if j not in unilateral]
    rows = np.concatenate(
        [of_feet[feet].reshape(-1, 3 + N), _locked_rows(unilateral), _locked_rows(locked)]
    )
    bias = np.zeros(len(rows))
    if moving:
        bias[: 2 * len(feet)] = extra_values[feet].ravel()
    else:  # Newton's law: what strikes comes back
        back = w.restitution * np.minimum(of_feet[feet, 1] @ v, 0.0)
        bias[1 : 2 * len(feet) : 2] = np.where(back < -BOUNCE_SPEED, back, 0.0)
    scales = (w.mass * w.g, w.g) if moving else (w.mass, 1.0)
    free = inverse @ force if moving else v
    return _ContactProblem(inverse, free, feet, may, unilateral, locked, rows, bias, scales)


def _bring_to_rest(w, q, v, rows):
    """Rates with these rows exactly at rest, by impulses along them: without friction."""
    if not len(rows):
        return v
    mass, _ = _mass_and_force(w, q, v)
    turned = np.linalg.solve(mass, rows.T)
    p, *_ = np.linalg.lstsq(rows @ turned, rows @ v, rcond=1e-11)
    return v - turned @ p


def _process_event(w, place, struck_foot, struck_leg):
    """Through an event: rates, modes and held legs after it, and how many modes would do."""
    q, v, mode, is_locked = place
    gaps, (rows, _) = _gaps(w, q), _points(q, v, q[3:])
    speeds = rows @ v
    near = (gaps <= TOUCH_TOLERANCE) & (speeds[:, 1] <= REST_SPEED)
    feet = [j for j in range(N) if mode[j] != CONTACT_OFF or j == struck_foot or near[j]]
    out = (w.L0 - q[3:] <= TOUCH_TOLERANCE) & (v[3:] >= -REST_SPEED)
    legs = [j for j in range(N) if is_locked[j] or j == struck_leg or out[j]]
    several = 0
    if np.any(speeds[feet, 1] < -REST_SPEED) or np.any(v[3:][legs] > REST_SPEED):
        problem = _solve_acceleration_level(
            w,
            q,
            v,
            feet,
            [(CONTACT_STICK, SLIP_DOWNHILL, SLIP_UPHILL, CONTACT_OFF)] * len(feet),
            legs,
            False,
        )
        solution = _enumerate_solutions(w, problem, ADMISSIBILITY_TOLERANCE)
        if not solution:
            raise NoAdmissibleContactError("no impulses")
        several += max(np.max(np.abs(after - solution[0][2])) for *_, after in solution) > 1e-6
        _, is_active, v = _select_preferred(solution)
        speeds = rows @ v
        feet = [j for j in feet if speeds[j, 1] < REST_SPEED]
        loaded_legs = {*problem.locked, *itertools.compress(problem.legs, is_active)}
        legs = [j for j in legs if j in loaded_legs or v[3 + j] > -REST_SPEED]
    resting_feet = [j for j in feet if abs(speeds[j, 0]) < REST_SPEED]
    at_rest = [rows[feet, 1], rows[resting_feet, 0], _locked_rows(legs)]
    v = _bring_to_rest(w, q, v, np.concatenate(at_rest))
    may = [
        (CONTACT_STICK, SLIP_DOWNHILL, SLIP_UPHILL, CONTACT_OFF)
        if j in resting_feet
        else (SLIP_DOWNHILL if speeds[j, 0] > 0 else SLIP_UPHILL, CONTACT_OFF)
        for j in feet
    ]
    problem = _solve_acceleration_level(w, q, v, feet, may, legs, True)
    solution = _enumerate_solutions(w, problem, ADMISSIBILITY_TOLERANCE)
    if not solution:
        raise NoAdmissibleContactError("no forces")
    options = []
    for modes, is_active, _ in solution:
        after = np.zeros(N, int)
        after[feet] = modes
        stays = np.zeros(N, bool)
        stays[problem.locked] = True
        stays[problem.legs] = is_active
        options.append((tuple(after.tolist()), tuple(stays.tolist())))
    if len(options) > 1:
        holds = [
            _short_time_margin(w, q, v, *one, feet, resting_feet, problem.legs) for one in options
        ]
        good = [one for one, margin in zip(options, holds, strict=True) if margin > 0.0]
        several += len(good) > 1
        rank = {CONTACT_STICK: 0, SLIP_DOWNHILL: 1, SLIP_UPHILL: 1, CONTACT_OFF: 2}
        options = sorted(good, key=lambda one: (sum(rank[m] for m in one[0]), sum(one[1])))
        options = options or [max(zip(holds, options, strict=True))[1]]
    return HybridState(q, v, *options[0]), several


def _short_time_margin(w, q, v, mode, is_locked, feet, resting_feet, legs):
    """Least sign, scaled, of these modes a moment later."""
    h = SHORT_TIME_SECONDS
    a = _solve_contact_forces(w, q, v, mode, is_locked)[0]
    middle = _solve_contact_forces(w, q + 0.5 * h * v, v + 0.5 * h * a, mode, is_locked)[0]
    q, v = q + h * v + 0.5 * h * h * a, v + h * middle
    a, on_feet, on_legs = _solve_contact_forces(w, q, v, mode, is_locked)
    rows, extra_values = _points(q, v, q[3:])
    F, A, minimum = w.mass * w.g, w.g, np.inf
    for j in feet:
        x, z = rows[j] @ a + extra_values[j]
        t, n = on_feet[j]
        minimum = min(minimum, z / A if mode[j] == CONTACT_OFF else n / F)
        if mode[j] == CONTACT_STICK:
            minimum = min(minimum, (w.friction_by_foot[j] * n - abs(t)) / F)
        elif mode[j] != CONTACT_OFF and j in resting_feet:
            minimum = min(minimum, SLIP_DIRECTIONS[mode[j]] * x / A)
    for j in legs:
        minimum = min(minimum, on_legs[j] / F if is_locked[j] else -a[3 + j] / A)
    return minimum


def _make_guards(w, place):
    """Names of what is watched in these modes, their values at a state, the least that arms each,
    and which leave zero at a speed."""
    q, v, mode, is_locked = place
    names = [("gap", j) for j in range(N) if mode[j] == CONTACT_OFF]
    names += [("room", j) for j in range(N) if not is_locked[j]]
    names += [("normal", j) for j in range(N) if mode[j] != CONTACT_OFF]
    names += [
        (name, j) for j in range(N) if mode[j] == CONTACT_STICK for name in ("cone up", "cone down")
    ]
    names += [("speed", j) for j in range(N) if mode[j] in SLIP_DIRECTIONS]
    names += [
        ("stopper", j) for j in range(N) if is_locked[j] and (w.one_sided or mode[j] != CONTACT_OFF)
    ]

    def values(y):
        q, v = y[: 3 + N], y[3 + N :]
        on_feet, on_legs = _solve_contact_forces(w, q, v, mode, is_locked)[1:]
        speeds = _points(q, v, q[3:])[0][:, 0] @ v
        result_by_name = {
            "gap": _gaps(w, q),
            "room": w.L0 - q[3:],
            "normal": on_feet[:, 1],
            "cone up": w.friction_by_foot * on_feet[:, 1] - on_feet[:, 0],
            "cone down": w.friction_by_foot * on_feet[:, 1] + on_feet[:, 0],
            "speed": np.array([SLIP_DIRECTIONS.get(m, 0.0) for m in mode]) * speeds,
            "stopper": on_legs,
        }
        return np.array([result_by_name[name][j] for name, j in names])

    armed = np.array([ARMED_TOLERANCE.get(name, ARMED_TOLERANCE["force"]) for name, _ in names])
    speeds = {"gap": _points(q, v, q[3:])[0][:, 1] @ v, "room": -v[3:]}
    leaves = np.array([name in speeds and speeds[name][j] > REST_SPEED for name, j in names])
    return names, values, armed, leaves


def _find_minimum(reads, low, high):
    return minimize_scalar(
        reads, bounds=(low, high), method="bounded", options={"xatol": 1e-6 * (high - low)}
    )


def _find_first_fall(values, inside, times, result, armed, minimum):
    """When the first of the armed guards falls between these times, and which; arms the others."""
    first, which = np.inf, None
    for i in range(len(armed)):
        g = np.array([row[i] for row in result])
        reads = lambda t, i=i: values(inside(t))[i]
        for k in range(1, len(times)):
            low, high = times[k - 1], times[k]
            if armed[i] and k < len(times) - 1 and 0.0 < g[k] < min(g[k - 1], g[k + 1]):
                dip = _find_minimum(reads, low, times[k + 1])
                high, g[k] = (dip.x, dip.fun) if dip.fun < 0.0 else (high, g[k])
            if armed[i] and g[k] <= 0.0:
                if g[k - 1] <= minimum[i]:  # it has just left
                    low = _find_minimum(lambda t, reads=reads: -reads(t), low, high).x
                root = low if reads(low) <= 0.0 else brentq(reads, low, high, xtol=1e-16)
                first, which = (root, i) if root < first else (first, which)
                break
            armed[i] |= g[k] > minimum[i]
        if not armed[i] and g[-1] < -1e-6:
            raise NoAdmissibleContactError("a guard was wrong from the start")
    return first, which


def _integrate_to_event(w, place):
    """The motion in these modes to the first guard that falls: time, state, what fell."""
    names, values, minimum, leaves = _make_guards(w, place)

    def rates(_, y):
        q, v = y[: 3 + N], y[3 + N :]
        return np.r_[v, _solve_contact_forces(w, q, v, place.mode, place.is_locked)[0]]

    def by(t, y, end, h):
        return DOP853(rates, t, y, end, rtol=RTOL, atol=ATOL, first_step=h, max_step=4e-3)

    y = np.r_[place.q, place.v]
    solver, margins = by(0.0, y, 5.0, 1e-7), values(y)
    armed = (margins > minimum) | leaves
    while solver.status == "running":
        begin, y = solver.t, solver.y.copy()
        solver.step()
        inside, times = solver.dense_output(), np.linspace(begin, solver.t, 5)
        rows = [margins, *(values(inside(t)) for t in times[1:-1]), values(solver.y)]
        first, which = _find_first_fall(values, inside, times, rows, armed, minimum)
        margins = rows[-1]
        if which is None:
            continue
        for _ in range(3):  # the interpolant is coarser than a step that ends there
            length = first - begin
            if length <= 0.0:
                break
            exact = by(begin, y, first, length)
            while exact.status == "running":
                exact.step()
            state_at_event, before = exact.y, exact.y - 1e-2 * length * rates(0.0, exact.y)
            slope = (values(state_at_event)[which] - values(before)[which]) / (1e-2 * length)
            shift = -values(state_at_event)[which] / slope if slope < 0.0 else 0.0
            if abs(shift) < 1e-15 or abs(shift) > 0.1 * length:
                break
            first += shift
        return first, state_at_event if first > begin else y, names[which]
    raise NoAdmissibleContactError("no landing")


def compute_step(
    w: ComplementarityWheel, begin: HybridState, most_events: int = 1000
) -> StepResult:
    """From a landing to the next one ahead."""
    place, struck, durations, ambiguous = begin, ("gap", 0), np.zeros(3), 0
    for event in range(most_events):
        name, j = struck
        foot, leg = (j if name == "gap" else None), (j if name == "room" else None)
        place, several = _process_event(w, place, foot, leg)
        ambiguous += several
        loaded = sum(m != CONTACT_OFF for m in place.mode)
        if loaded > 2:
            raise NoAdmissibleContactError("three feet")
        time, y, struck = _integrate_to_event(w, place)
        durations[2 - loaded] += time
        place = place._replace(q=y[: 3 + N].copy(), v=y[3 + N :].copy())
        if place.v[2] <= 0.0:
            raise NoAdmissibleContactError("fell back")
        if struck == ("gap", N - 1):
            return StepResult(durations, _relabel_legs(w, place), event + 1, ambiguous)
        _project_to_constraints(w, place)
    raise NoAdmissibleContactError("events without end")


def _project_to_constraints(w, place):
    """Loaded feet on the slope, held legs on their stoppers: the integrator's drift."""
    q, _, mode, is_locked = place
    u, _ = _legs(q[2])
    for j in range(N):
        if is_locked[j]:
            q[3 + j] = w.L0
        elif mode[j] != CONTACT_OFF:
            q[3 + j] = q[1] / u[j, 1]


def _relabel_legs(w, place):
    """The same wheel in labels and frame of the step that begins, its origin under that foot."""
    roll = lambda x: np.roll(x, 1)
    q = np.r_[0.0, 0.0, place.q[2] - ALPHA - w.tilt, roll(place.q[3:])]
    q[:2] = q[3] * np.array([np.sin(q[2]), np.cos(q[2])])
    sin, cos = np.sin(w.tilt), np.cos(w.tilt)
    v = np.r_[np.array([[cos, -sin], [sin, cos]]) @ place.v[:2], place.v[2], roll(place.v[3:])]
    mode, is_locked = (tuple(roll(np.array(x)).tolist()) for x in (place.mode, place.is_locked))
    return HybridState(q, v, mode, is_locked)

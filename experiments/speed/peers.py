"""The same gait step by numba, SciPy, heyoka and C++, for comparison with the library's engines.

Each program starts just after the landing and ends at the next touchdown. It watches only the three
events of the paper, which is a little less than the library's engines do. Each returns per lane
(theta-, dtheta-, dL1-), the three durations and the number of evaluations. The equations are those
of docs/explanation/physics.md, written for numbers and for heyoka's expressions alike.
"""

import ctypes
import math
import subprocess
import tempfile
import types
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from experiments.shared.command import require_extra
from vrw_jax.flow import load_explicit_tableau

hy, numba = require_extra("heyoka"), require_extra("numba")

ALPHA = math.pi / 4.0
SA, CA = math.sin(ALPHA), math.cos(ALPHA)


def terms(sin, cos, L1, L2, w, dL1, dL2, P):
    """Return M11, M12, M13 and the applied forces; P is the result of `pack`."""
    m, a, L0, Ls, k, c, g, sf, cf, Mh = P
    c0, b = L0 - a, L2 - a
    coupling = m * (c0 * (1.0 + CA) - b * CA)
    P1, P2 = Mh * L1 + coupling, m * (b - CA * L1)
    sp, cp = sin * cf + cos * sf, cos * cf - sin * sf
    rsp, rcp = sp * CA + cp * SA, cp * CA - sp * SA
    M11 = L1 * (Mh * L1 + 2.0 * coupling) + m * (a * a + b * b + 6.0 * c0 * c0)
    f1 = g * ((Mh * L1 + m * L0) * sp + m * (L0 - L2) * rsp) - 2.0 * (P1 * dL1 + P2 * dL2) * w
    f2 = k * (Ls - L1) - c * dL1 + P1 * w * w - 2.0 * m * SA * w * dL2 - g * Mh * cp
    f3 = k * (Ls - L2) - c * dL2 + P2 * w * w + 2.0 * m * SA * w * dL1 + g * m * rcp
    return M11, m * SA * (L2 - L0), -m * SA * L1, f1, f2, f3


def double_support(sin, cos, w, D, P):
    """Return (ddtheta, lambda_4, L1, L2, dL1, dL2)."""
    m, Mh, scale = P[0], P[9], D / SA
    rs, rc = sin * CA + cos * SA, cos * CA - sin * SA
    L1, L2, G1, G2 = scale * rc, scale * cos, -scale * rs, -scale * sin
    M11, M12, M13, f1, f2, f3 = terms(sin, cos, L1, L2, w, G1 * w, G2 * w, P)
    w1, w2 = M12 + Mh * G1 - m * CA * G2, M13 - m * CA * G1 + m * G2
    inertia = M11 + G1 * (M12 + w1) + G2 * (M13 + w2)
    x1 = (f1 + G1 * f2 + G2 * f3 + w * w * (L1 * w1 + L2 * w2)) / inertia
    x2, x3 = G1 * x1 - L1 * w * w, G2 * x1 - L2 * w * w
    r2 = M12 * x1 + Mh * x2 - m * CA * x3 - f2
    r3 = M13 * x1 - m * CA * x2 + m * x3 - f3
    return x1, (rs * r2 + sin * r3) / SA, L1, L2, G1 * w, G2 * w


def single_support_1(sin, cos, L1, L2, w, dL1, dL2, P):
    """Return the second derivatives of (theta, L1, L2)."""
    m, Mh = P[0], P[9]
    M11, M12, M13, f1, f2, f3 = terms(sin, cos, L1, L2, w, dL1, dL2, P)
    q = SA * L1
    A11, A12, A22 = M11 + M13 * q, M12 + M13 * CA, Mh - m * CA * CA
    F1, F2 = f1 + q * f3, f2 + CA * f3
    r = 1.0 / (A11 * A22 - A12 * A12)
    x1, x2 = (A22 * F1 - A12 * F2) * r, (A11 * F2 - A12 * F1) * r
    return x1, x2, f3 / m + q * x1 + CA * x2


def single_support_2(sin, cos, L1, w, dL1, P):
    """Return the second derivatives of (theta, L1)."""
    M11, _, _, f1, f2, _ = terms(sin, cos, L1, P[2], w, dL1, 0.0, P)
    return f1 / M11, f2 / P[9]


def pack(params):
    """Return the parameters in the order of `terms`, shape (lanes, 10)."""
    get = lambda name: np.asarray(getattr(params, name), float)
    m, slope = get("leg_mass"), get("slope")
    Mh = get("hub_mass") + 7.0 * m
    columns = [m, get("leg_com"), get("locked_length"), get("natural_length"), get("stiffness")]
    columns += [get("damping"), get("gravity"), np.sin(slope), np.cos(slope), Mh]
    return np.stack(np.broadcast_arrays(*columns), 1)


_jit = numba.njit(cache=False)
n_terms = _jit(terms)
_names = {"terms": n_terms, "SA": SA, "CA": CA}


def _compile_with_terms(function):
    """Compile a function together with the `terms` that it calls."""
    return _jit(types.FunctionType(function.__code__, {**globals(), **_names}, function.__name__))


n_dls, n_sls1, n_sls2 = map(
    _compile_with_terms, (double_support, single_support_1, single_support_2)
)


@numba.njit
def state_rates(phase, y, D, P, dy):
    """Write the right-hand side into `dy`; return the phase's guard and its rate (0 if unknown)."""
    sin, cos = math.sin(y[0]), math.cos(y[0])
    if phase == 0:
        x1, force, _, _, _, _ = n_dls(sin, cos, y[1], D, P)
        dy[0], dy[1] = y[1], x1
        return force, 0.0
    if phase == 1:
        x1, x2, x3 = n_sls1(sin, cos, y[1], y[2], y[3], y[4], y[5], P)
        dy[0], dy[1], dy[2], dy[3], dy[4], dy[5] = y[3], y[4], y[5], x1, x2, x3
        return P[2] - y[2], -y[5]
    x1, x2 = n_sls2(sin, cos, y[1], y[2], y[3], P)
    dy[0], dy[1], dy[2], dy[3] = y[2], y[3], x1, x2
    height = y[1] * cos - P[2] * (cos * CA + sin * SA)
    return height, y[3] * cos - y[1] * sin * y[2] - P[2] * y[2] * (cos * SA - sin * CA)


@numba.njit
def dormand_prince(phase, n, y, k, z, error, h, D, P):
    """Take one solver step into z; k[0] holds the rates at y, and k[6] those at z."""
    for i in range(n):
        z[i] = y[i] + h * 0.2 * k[0, i]
    state_rates(phase, z, D, P, k[1])
    for i in range(n):
        z[i] = y[i] + h * (3 / 40 * k[0, i] + 9 / 40 * k[1, i])
    state_rates(phase, z, D, P, k[2])
    for i in range(n):
        z[i] = y[i] + h * (44 / 45 * k[0, i] - 56 / 15 * k[1, i] + 32 / 9 * k[2, i])
    state_rates(phase, z, D, P, k[3])
    for i in range(n):
        z[i] = y[i] + h * (
            19372 / 6561 * k[0, i] - 25360 / 2187 * k[1, i] + 64448 / 6561 * k[2, i]
            - 212 / 729 * k[3, i]
        )  # fmt: skip
    state_rates(phase, z, D, P, k[4])
    for i in range(n):
        z[i] = y[i] + h * (
            9017 / 3168 * k[0, i] - 355 / 33 * k[1, i] + 46732 / 5247 * k[2, i]
            + 49 / 176 * k[3, i] - 5103 / 18656 * k[4, i]
        )  # fmt: skip
    state_rates(phase, z, D, P, k[5])
    for i in range(n):
        z[i] = y[i] + h * (
            35 / 384 * k[0, i] + 500 / 1113 * k[2, i] + 125 / 192 * k[3, i]
            - 2187 / 6784 * k[4, i] + 11 / 84 * k[5, i]
        )  # fmt: skip
    guard = state_rates(phase, z, D, P, k[6])
    for i in range(n):
        error[i] = h * (
            71 / 57600 * k[0, i] - 71 / 16695 * k[2, i] + 71 / 1920 * k[3, i]
            - 17253 / 339200 * k[4, i] + 22 / 525 * k[5, i] - 1 / 40 * k[6, i]
        )  # fmt: skip
    return guard


@numba.njit(error_model="numpy")
def numba_phase(phase, n, y, h, D, P, tol, k, z, error):
    """Integrate to the phase's guard in place; return duration, next solver step and number of
    tries."""
    before, _ = state_rates(phase, y, D, P, k[0])
    time, tried = 0.0, 0
    while True:
        tried += 1
        after, _ = dormand_prince(phase, n, y, k, z, error, h, D, P)
        total = 0.0
        for i in range(n):
            ratio = error[i] / (tol + tol * max(abs(y[i]), abs(z[i])))
            total += ratio * ratio
        total = math.sqrt(total / n)
        if total <= 1.0 and after <= 0.0:
            break
        if total <= 1.0:
            time += h
            before = after
            for i in range(n):
                y[i], k[0, i] = z[i], k[6, i]
        h *= min(5.0, max(0.2, 0.9 * max(total, 1e-10) ** -0.2))
    x0, g0, d = 0.0, before, h * before / (before - after)
    low, high, change = 0.0, h, 0.0
    for _ in range(30):
        tried += 1
        g, rate = dormand_prince(phase, n, y, k, z, error, d, D, P)
        if rate == 0.0:
            rate = (g - g0) / (d - x0)
        change = -g / rate
        if abs(change) < 1e-8 * h:
            break
        if g > 0.0:
            low = d
        else:
            high = d
        x0, g0 = d, g
        d = d + change if low < d + change < high else 0.5 * (low + high)
    for i in range(n):
        y[i] = z[i] + change * k[6, i]
    return time + d + change, h, tried


@numba.njit
def numba_steps(starts, parameters, tol):
    """Return gait steps by Dormand-Prince 5(4) with adaptive solver steps."""
    out = np.empty((len(starts), 7))
    k, z, error, y = np.empty((7, 6)), np.empty(6), np.empty(6), np.empty(6)
    for lane in range(len(starts)):
        P = parameters[lane]
        theta, w = starts[lane]
        P = (P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8], P[9])
        D = P[2] * SA / (math.cos(theta) * CA - math.sin(theta) * SA)
        y[0], y[1] = theta, w
        out[lane, 3], h, tried_1 = numba_phase(0, 2, y, 5e-3, D, P, tol, k, z, error)
        _, _, L1, L2, dL1, dL2 = n_dls(math.sin(y[0]), math.cos(y[0]), y[1], D, P)
        y[3], y[1], y[2], y[4], y[5] = y[1], L1, L2, dL1, dL2
        out[lane, 4], h, tried_2 = numba_phase(1, 6, y, 0.3 * h, D, P, tol, k, z, error)
        hit_numba(y, P)
        out[lane, 5], h, tried_3 = numba_phase(2, 4, y, h, D, P, tol, k, z, error)
        out[lane, 0], out[lane, 1], out[lane, 2] = y[0], y[2], y[3]
        out[lane, 6] = 6.0 * (tried_1 + tried_2 + tried_3) + 3.0
    return out


def hit(y, P):
    """Apply the stopper impact in place: (theta, L1, L2, rates) becomes (theta, L1, rates)."""
    M11 = terms(0.0, 1.0, y[1], P[2], 0.0, 0.0, 0.0, P)[0]
    dtheta, dL1 = y[3] - P[0] * SA * y[1] * y[5] / M11, y[4] - P[0] * CA * y[5] / P[9]
    y[2], y[3] = dtheta, dL1


hit_numba = _compile_with_terms(hit)


def start_of_phase(phase, y, D, P):
    """Return the coordinates and rates with which the next phase starts."""
    if phase == 0:
        _, _, L1, L2, dL1, dL2 = n_dls(math.sin(y[0]), math.cos(y[0]), y[1], D, P)
        return np.array([y[0], L1, L2, y[1], dL1, dL2])
    if phase == 1:
        hit_numba(y, P)
        return y[:4]
    return y


def scipy_steps(starts, parameters, tol, method="DOP853"):
    """Return gait steps by `solve_ivp` with compiled right-hand side; NaN if it failed."""
    out = np.zeros((len(starts), 7))
    for lane, (theta, w) in enumerate(starts):
        P = tuple(parameters[lane])
        D = P[2] * SA / (math.cos(theta) * CA - math.sin(theta) * SA)
        y = np.array([theta, w])
        for phase in range(3):

            def right(t, y, phase=phase, D=D, P=P, lane=lane):
                out[lane, 6] += 1.0
                dy = np.empty_like(y)
                state_rates(phase, y, D, P, dy)
                return dy

            def guard(t, y, phase=phase, D=D, P=P):
                return state_rates(phase, y, D, P, np.empty_like(y))[0]

            guard.terminal, guard.direction = True, -1.0
            solution = solve_ivp(
                right, (0.0, 20.0), y, method=method, rtol=tol, atol=tol, events=guard
            )
            if solution.status != 1:
                out[lane, :6] = np.nan
                break
            y, out[lane, 3 + phase] = solution.y[:, -1].copy(), solution.t[-1]
            if phase == 0:
                _, _, L1, L2, dL1, dL2 = n_dls(math.sin(y[0]), math.cos(y[0]), y[1], D, P)
                y = np.array([y[0], L1, L2, y[1], dL1, dL2])
            elif phase == 1:
                hit(y, P)
                y = y[:4]
            else:
                out[lane, :3] = y[0], y[2], y[3]
    return out


def torch_steps(starts, parameters, tol, method="dopri5"):
    """Return gait steps by `odeint_event` of torchdiffeq in eager PyTorch; both need an
    installation."""
    import torch
    from torchdiffeq import odeint_event

    torch.set_num_threads(1)
    out = np.zeros((len(starts), 7))
    zero = torch.zeros((), dtype=torch.float64)
    for lane, (theta, w) in enumerate(starts):
        P = tuple(map(float, parameters[lane]))
        D = P[2] * SA / (math.cos(theta) * CA - math.sin(theta) * SA)

        def rates(t, y, D=D, P=P, lane=lane):
            out[lane, 6] += 1.0
            sin, cos = torch.sin(y[0]), torch.cos(y[0])
            if len(y) == 2:
                return torch.stack([y[1], double_support(sin, cos, y[1], D, P)[0]])
            if len(y) == 6:
                return torch.cat([y[3:], torch.stack(single_support_1(sin, cos, *y[1:], P))])
            return torch.cat([y[2:], torch.stack(single_support_2(sin, cos, *y[1:], P))])

        def guard(t, y, D=D, P=P):
            sin, cos = torch.sin(y[0]), torch.cos(y[0])
            if len(y) == 2:
                return double_support(sin, cos, y[1], D, P)[1]
            return P[2] - y[2] if len(y) == 6 else y[1] * cos - P[2] * (cos * CA + sin * SA)

        y = np.array([theta, w])
        for phase in range(3):
            with torch.no_grad():
                end, solution = odeint_event(
                    rates, torch.tensor(y), zero, event_fn=guard, rtol=tol, atol=tol, method=method
                )
            y, out[lane, 3 + phase] = solution[-1].numpy().copy(), float(end)
            y = start_of_phase(phase, y, D, P)
        out[lane, :3] = y[0], y[2], y[3]
    return out


class ByHand:
    """Gait steps by `peer.cpp`: eight wheels side by side, with an explicit Runge-Kutta tableau."""

    def __init__(self, solver):
        tableau, created = load_explicit_tableau(solver), Path(tempfile.mkdtemp())
        parts = {
            "PLACES": tableau.stage_nodes, "ONCE": tableau.stage_matrix,
            "TWICE": tableau.squared_stage_matrix,
            "ERROR_ONCE": tableau.rate_error_weights, "ERROR_TWICE": tableau.position_error_weights,
        }  # fmt: skip
        lines = [f"static constexpr int S = {len(tableau.stage_nodes)};"]
        lines.append(f"static constexpr float EXPONENT = {-0.5 / tableau.convergence_order};")
        for name, values in parts.items():
            shape = "".join(f"[{n}]" for n in values.shape)
            numbers = str(values.tolist()).replace("[", "{").replace("]", "}")
            lines.append(f"static constexpr double {name}{shape} = {numbers};")
        (created / "method.h").write_text("\n".join(lines))
        source, library = Path(__file__).with_name("peer.cpp"), created / "peer.so"
        method = f'-DMETHOD="{created}/method.h"'
        flags = ["-O3", "-march=native", "-ffast-math", "-fno-finite-math-only", "-shared", "-fPIC"]
        subprocess.run(["g++", *flags, method, str(source), "-o", str(library)], check=True)
        self.steps = ctypes.CDLL(str(library)).steps
        pointer = ctypes.c_void_p
        self.steps.argtypes = [pointer, pointer, pointer, ctypes.c_long, ctypes.c_double]

    def __call__(self, starts, parameters, tol):
        """Return gait steps; the number of lanes is a multiple of eight."""
        given = [np.ascontiguousarray(x.T) for x in (parameters, starts)]
        result = np.empty((6, len(starts)))
        self.steps(*(x.ctypes.data for x in (*given, result)), len(starts), tol)
        return result.T


class Heyoka:
    """Scalar adaptive Taylor integrators with terminal events, one for each phase."""

    def __init__(self, tol):
        P = [hy.par[i] for i in range(10)]
        th, L1, L2, w, v1, v2 = hy.make_vars("th", "L1", "L2", "w", "v1", "v2")
        sin, cos = hy.sin(th), hy.cos(th)
        ends = lambda g: [hy.t_event(g, direction=hy.event_direction.negative)]
        dls = double_support(sin, cos, w, hy.par[10], P)
        x1, x2, x3 = single_support_1(sin, cos, L1, L2, w, v1, v2, P)
        z1, z2 = single_support_2(sin, cos, L1, w, v1, P)
        height = L1 * cos - P[2] * (cos * CA + sin * SA)
        make = lambda system, g: hy.taylor_adaptive(
            system, [1.0] * len(system), tol=tol, t_events=ends(g)
        )
        self.phases = (
            make([(th, w), (w, dls[0])], dls[1]),
            make([(th, w), (L1, v1), (L2, v2), (w, x1), (v1, x2), (v2, x3)], P[2] - L2),
            make([(th, w), (L1, v1), (w, z1), (v1, z2)], height),
        )

    def __call__(self, starts, parameters):
        out = np.zeros((len(starts), 7))
        for lane, (theta, w) in enumerate(starts):
            P = tuple(parameters[lane])
            D = P[2] * SA / (math.cos(theta) * CA - math.sin(theta) * SA)
            y = np.array([theta, w])
            for phase, ta in enumerate(self.phases):
                ta.reset_cooldowns()
                ta.time, ta.pars[:], ta.state[:] = 0.0, (*P, D)[: len(ta.pars)], y
                n_taylor_steps = ta.propagate_until(20.0)[3]
                out[lane, 6] += n_taylor_steps * (ta.order + 1)  # a Taylor coefficient each
                y, out[lane, 3 + phase] = ta.state.copy(), ta.time
                y = start_of_phase(phase, y, D, P)
            out[lane, :3] = y[0], y[2], y[3]
        return out

"""The wheel under constraints: accelerations, impacts and one phase of motion, eqs (1)-(25).

Coordinates q = (x, z, theta, L1, L2) in m and rad, v = q'. A mode is "DLS" (both feet planted),
"SLS-I" (Leg 1 planted) or "SLS-II" (Leg 1 planted, Leg 2 locked).
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853, quad
from scipy.linalg.lapack import dgesv
from scipy.optimize import brentq

from . import five_coordinates_equations as equations

Array = NDArray[Any]
Params = Mapping[str, Any]

NO_EVENT = "no touchdown in time"
MAX_PHASE_TIME = 20.0  # s


@dataclass(frozen=True)
class Wheel:
    """Constants of one wheel as the generated equations want them."""

    params: Params
    alpha: float = field(init=False)
    pack: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        """Sum cos and sin over the locked legs; order the constants."""
        p = self.params
        n = int(p["n_legs"])
        alpha = 2 * math.pi / n
        locked = [(j - 1) * alpha for j in range(3, n + 1)]
        cosines, sines = math.fsum(map(math.cos, locked)), math.fsum(map(math.sin, locked))
        masses = (p["hub_mass"], p["leg_mass"], p["leg_com"], p["locked_length"])
        pack = (*masses, p["slope"], p["gravity"], alpha, n - 2, cosines, sines)
        object.__setattr__(self, "alpha", alpha)
        object.__setattr__(self, "pack", pack)

    def spring_damper(self, q: Array, v: Array) -> Array:
        """Viscoelastic force tau_ve, eq. (3), or that of another law, and a torque on the hub.

        All parts turn with theta, so that the virtual work of the torque is torque times its
        variation.
        """
        tau = np.zeros(5)
        tau[2] = self.params["hub_torque"](v[2]) if "hub_torque" in self.params else 0.0
        if "angle_torque" in self.params:
            tau[2] += self.params["angle_torque"](q[2], v[2])
        tau[3:] = self.leg_force(q[3:], v[3:])
        return tau

    def leg_force(self, length: Array, rate: Array) -> Array:
        """Force along a leg by eq. (3), or by the function ``leg_force`` of the parameters, N."""
        if "leg_force" in self.params:
            return self.params["leg_force"](length, rate)
        k, c, natural = (self.params[name] for name in ("stiffness", "damping", "natural_length"))
        return -k * (length - natural) - c * rate

    def damping_power(self, length: Array, rate: Array) -> float:
        """Power that the legs dissipate, eq. (29), W."""
        if "leg_force" not in self.params:
            return self.params["damping"] * float(rate @ rate)
        static_force = self.leg_force(length, 0.0 * rate)
        return float(np.sum((static_force - self.leg_force(length, rate)) * rate))

    def elastic(self, length: float) -> float:
        """Elastic energy of a leg of another law, from its locked length, by quadrature, J."""
        return quad(self.leg_force, length, self.params["locked_length"], (0.0,), epsabs=1e-13)[0]

    def acceleration(self, q: Array, v: Array, mode: str) -> tuple[Array, Array]:
        """q'' and the contact multipliers lambda1..lambda4 (zero where there is no contact)."""
        jacobian, curvature = self.constraint(q, v, mode)
        mass = np.array(equations.mass_matrix(q, self.pack))
        force = self.spring_damper(q, v) - np.array(equations.bias(q, v, self.pack))
        solution = _saddle(mass, jacobian, np.concatenate([force, -curvature]))
        multipliers = np.zeros(4)
        contacts = 4 if mode == "DLS" else 2
        multipliers[:contacts] = solution[5 : 5 + contacts]
        return solution[:5], multipliers

    def constraint(self, q: Array, v: Array, mode: str) -> tuple[Array, Array]:
        """Jacobian of the mode, eqs (11), (13), (14), and its rate times q'."""
        jacobian = np.array(equations.jacobian(q, self.pack))
        curvature = np.array(equations.jacobian_rate(q, v, self.pack), dtype=float)
        if mode == "DLS":
            return jacobian, curvature
        if mode == "SLS-I":
            return jacobian[:2], curvature[:2]
        locked = np.array([[0.0, 0.0, 0.0, 0.0, 1.0]])
        return np.vstack([jacobian[:2], locked]), np.append(curvature[:2], 0.0)

    def impact(self, q: Array, v: Array, mode: str) -> tuple[Array, Array]:
        """Velocity after an inelastic impact and its impulses, N s, eqs (18)-(25), (33), (34)."""
        jacobian, _ = self.constraint(q, v, mode)
        mass = np.array(equations.mass_matrix(q, self.pack))
        solution = _saddle(mass, jacobian, np.concatenate([mass @ v, np.zeros(len(jacobian))]))
        return solution[:5], solution[5:]

    def kinetic(self, q: Array, v: Array) -> float:
        """Kinetic energy, J."""
        return float(equations.energies(q, v, self.pack)[0])

    def energy(self, q: Array, v: Array) -> float:
        """Mechanical energy of eqs (26), (27) with n - 2 locked legs, J."""
        if "leg_force" in self.params:
            elastic = sum(map(self.elastic, q[3:]))
            return float(sum(equations.energies(q, v, self.pack))) + elastic
        k, natural = self.params["stiffness"], self.params["natural_length"]
        preload = (self.params["n_legs"] - 2) * (self.params["locked_length"] - natural) ** 2
        elastic = 0.5 * k * (float(np.sum((q[3:] - natural) ** 2)) + preload)
        return float(sum(equations.energies(q, v, self.pack))) + elastic

    def foot2(self, q: Array) -> tuple[float, float]:
        """Position of Leg 2's foot, m."""
        _, _, tangential_position, height = equations.feet(q, self.pack)
        return float(tangential_position), float(height)

    def clearance(self, q: Array) -> float:
        """Height of the foot of the next fore leg, at theta - alpha, m."""
        length = self.params["locked_length"]
        return float(q[1] + q[3] * math.cos(q[2]) - length * math.cos(q[2] - self.alpha))


def _saddle(mass: Array, jacobian: Array, right: Array) -> Array:
    """Solve M a - J' y = r1, J a = r2 for (a, y)."""
    count = len(jacobian)
    matrix = np.zeros((5 + count, 5 + count))
    matrix[:5, :5] = mass
    matrix[:5, 5:] = -jacobian.T
    matrix[5:, :5] = jacobian
    *_, solution, failure = dgesv(matrix, right)  # What np.linalg.solve calls takes thrice as long.
    if failure:
        raise np.linalg.LinAlgError("the accelerations are not determined")
    return solution


# --- One phase: integrate until the first guard, positive inside the phase, has fallen to zero.

Guard = Callable[[Array, Array], float]


@dataclass
class Phase:
    """One phase of a step: mode, duration (s), last state, energy damped (J), ending event."""

    name: str
    duration: float
    q: Array
    v: Array
    dissipated: float
    event: str
    pieces: list[tuple[float, float, Any]]

    def sample(self, t: float) -> tuple[Array, Array]:
        """q and q' at a time within the phase, from the integrator's interpolant."""
        if t >= self.duration:
            return self.q, self.v
        index = bisect.bisect_left(self.pieces, t, key=lambda piece: piece[1])
        y = self.pieces[index][2](t)
        return y[:5], y[5:10]


def _flow(
    rhs: Callable[[float, Array], Array], t: float, y: Array, end: float, rtol: float, atol: float
) -> Array:
    """Integrate from t to end, both near each other."""
    if end == t:
        return y
    solver = DOP853(rhs, t, y, end, rtol=rtol, atol=atol, first_step=abs(end - t))
    while solver.status == "running":
        solver.step()
    end_state: Array = solver.y
    return end_state


def run_phase(
    wheel: Wheel,
    mode: str,
    q: Array,
    v: Array,
    guards: Mapping[str, Guard],
    *,
    rtol: float,
    atol: float,
    max_step: float,
) -> Phase:
    """Integrate one phase from (q, v) until the earliest guard falls through zero."""

    def rhs(_: float, y: Array) -> Array:
        accelerations = wheel.acceleration(y[:5], y[5:10], mode)[0]
        power = wheel.damping_power(y[3:5], y[8:10])
        return np.concatenate([y[5:10], accelerations, [power]])

    def value(name: str, y: Array) -> float:
        return guards[name](y[:5], y[5:10])

    y: Array = np.concatenate([q, v, [0.0]])
    solver = DOP853(
        rhs, 0.0, y, MAX_PHASE_TIME, rtol=rtol, atol=atol, max_step=max_step, first_step=1e-4
    )
    pieces: list[tuple[float, float, Any]] = []
    last = {name: value(name, y) for name in guards}
    for name, guard in last.items():
        if guard < 0:
            return Phase(mode, 0.0, q, v, 0.0, name, [])
    while solver.status == "running":
        t_old, y_old = solver.t, solver.y.copy()
        solver.step()
        interpolant = solver.dense_output()
        hits: list[tuple[float, str]] = []
        # Look between the mesh points as well: a guard may dip and return within a step.
        nodes = np.linspace(t_old, solver.t, 5)
        states = [y_old, *(interpolant(t) for t in nodes[1:-1]), solver.y]
        for name in guards:
            values = [last[name], *(value(name, state) for state in states[1:])]
            if not pieces and values[0] == 0 > values[1]:  # leaves its zero the wrong way
                return Phase(mode, 0.0, q, v, 0.0, name, [])
            for i in range(4):
                if values[i] > 0 >= values[i + 1]:
                    root = brentq(
                        lambda t, name=name, at=interpolant: value(name, at(t)),
                        nodes[i],
                        nodes[i + 1],
                        xtol=1e-15,
                    )
                    hits.append((root, name))
                    break
            last[name] = values[-1]
        if hits:
            time, name = min(hits)
            step = 1e-5 * max(solver.t - t_old, 1e-6)
            rise = value(name, interpolant(time + step)) - value(name, interpolant(time - step))
            slope = rise / (2 * step)
            y = _flow(rhs, t_old, y_old, time, rtol, atol)
            for _ in range(4):
                correction = -value(name, y) / slope
                if not abs(correction) < 1e-3 or abs(correction) < 1e-17:
                    break
                time += correction
                y = _flow(rhs, t_old, y_old, time, rtol, atol)
            pieces.append((t_old, time, interpolant))
            return Phase(mode, time, y[:5], y[5:10], float(y[10]), name, pieces)
        pieces.append((t_old, solver.t, interpolant))
    end = solver.y
    return Phase(mode, solver.t, end[:5], end[5:10], float(end[10]), NO_EVENT, pieces)

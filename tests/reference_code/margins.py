"""Margins of the paper's model, by Newton's law on the point masses.

Nothing here uses a multiplier: forces and impulses are balances of hub and legs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from .constrained_wheel import Array, Phase, Wheel


def _radial(angle: float) -> Array:
    """Unit vector from foot to hub of a leg at this angle."""
    return np.array([math.sin(angle), math.cos(angle)])


def _tangent(angle: float) -> Array:
    """Derivative of ``_radial``."""
    return np.array([math.cos(angle), -math.sin(angle)])


def _leg_motion(rates: tuple[float, ...], length: tuple[float, float, float]) -> Array:
    """Second derivative of length * u(angle); rates = (angle, angle', angle'')."""
    angle, omega, spin = rates
    r, dr, ddr = length
    return (ddr - r * omega**2) * _radial(angle) + (2 * dr * omega + r * spin) * _tangent(angle)


def mass_accelerations(wheel: Wheel, q: Array, v: Array, a: Array) -> list[Array]:
    """Accelerations of the hub and of the masses of legs 1..n, m/s^2."""
    com, length = wheel.params["leg_com"], wheel.params["locked_length"]
    hub = np.array([a[0], a[1]]) + _leg_motion((q[2], v[2], a[2]), (q[3], v[3], a[3]))
    first = np.array([a[0], a[1]]) + _leg_motion((q[2], v[2], a[2]), (com, 0.0, 0.0))
    second = hub - _leg_motion((q[2] + wheel.alpha, v[2], a[2]), (q[4] - com, v[4], a[4]))
    others = [
        hub - _leg_motion((q[2] + (j - 1) * wheel.alpha, v[2], a[2]), (length - com, 0.0, 0.0))
        for j in range(3, int(wheel.params["n_legs"]) + 1)
    ]
    return [hub, first, second, *others]


def mass_velocities(wheel: Wheel, q: Array, v: Array) -> list[Array]:
    """Velocities of the hub and of the masses of legs 1..n, m/s."""
    com, length = wheel.params["leg_com"], wheel.params["locked_length"]
    foot = np.array([v[0], v[1]])
    hub = foot + v[3] * _radial(q[2]) + q[3] * v[2] * _tangent(q[2])
    second = q[2] + wheel.alpha
    return [
        hub,
        foot + com * v[2] * _tangent(q[2]),
        hub - v[4] * _radial(second) - (q[4] - com) * v[2] * _tangent(second),
        *(
            hub - (length - com) * v[2] * _tangent(q[2] + (j - 1) * wheel.alpha)
            for j in range(3, int(wheel.params["n_legs"]) + 1)
        ),
    ]


def _masses(wheel: Wheel) -> list[float]:
    """Masses of the hub and of legs 1..n, kg."""
    return [wheel.params["hub_mass"], *[wheel.params["leg_mass"]] * int(wheel.params["n_legs"])]


def _split(total: Array, axial1: float, axial2: float, angle1: float, angle2: float) -> Array:
    """Contact forces (x1, z1, x2, z2) from their sum and from their parts along each leg."""
    u1, u2, t1, t2 = _radial(angle1), _radial(angle2), _tangent(angle1), _tangent(angle2)
    transverse_part = np.linalg.solve(np.column_stack([t1, t2]), total - axial1 * u1 - axial2 * u2)
    return np.concatenate(
        [axial1 * u1 + transverse_part[0] * t1, axial2 * u2 + transverse_part[1] * t2]
    )


def contact_forces(wheel: Wheel, q: Array, v: Array, a: Array, mode: str) -> Array:
    """Ground forces lambda1..lambda4, N, by Newton's law on the point masses.

    Single support: the sum over all masses. Double support: the sum, and along each planted leg
    the balance of its own mass between ground, gravity and spring and damper.
    """
    params = wheel.params
    gravity = params["gravity"] * np.array([math.sin(params["slope"]), -math.cos(params["slope"])])
    accelerations = mass_accelerations(wheel, q, v, a)
    demands = [
        mass * (acceleration - gravity)
        for mass, acceleration in zip(_masses(wheel), accelerations, strict=True)
    ]
    total = np.sum(demands, axis=0)
    if mode != "DLS":
        return np.array([*total, 0.0, 0.0])
    push = wheel.leg_force(q[3:], v[3:])
    angles = q[2], q[2] + wheel.alpha
    axial_parts = [demands[i + 1] @ _radial(angles[i]) + push[i] for i in range(2)]
    return _split(total, axial_parts[0], axial_parts[1], *angles)


def stopper_forces(wheel: Wheel, q: Array, v: Array, a: Array) -> Array:
    """Stopper forces of legs 2..n as if all of them were locked, N; positive pushes.

    k (L* - L0) + m (a_j - g) . u_j with u_j from foot to hub; the entry of Leg 2 means something
    in SLS-II only.
    """
    params = wheel.params
    gravity = params["gravity"] * np.array([math.sin(params["slope"]), -math.cos(params["slope"])])
    preload = wheel.leg_force(params["locked_length"], 0.0)
    accelerations = mass_accelerations(wheel, q, v, a)
    return np.array(
        [
            preload
            + params["leg_mass"]
            * float((accelerations[j] - gravity) @ _radial(q[2] + (j - 1) * wheel.alpha))
            for j in range(2, int(params["n_legs"]) + 1)
        ]
    )


def _velocity_jumps(wheel: Wheel, q: Array, before: Array, after: Array) -> list[Array]:
    """Jumps of the velocities of the hub and of the masses of legs 1..n, m/s."""
    old, new = mass_velocities(wheel, q, before), mass_velocities(wheel, q, after)
    return [
        late_velocity - early_velocity
        for early_velocity, late_velocity in zip(old, new, strict=True)
    ]


def _landing_impulses(wheel: Wheel, q: Array, before: Array, after: Array) -> Array:
    """Ground impulses (x1, z1, x2, z2) of a landing that plants both feet, N s.

    The spring and damper give no impulse, so along each planted leg the ground alone changes the
    momentum of its mass; Leg 1's stopper may let go but does not push.
    """
    velocities = _velocity_jumps(wheel, q, before, after)
    jumps = [mass * dv for mass, dv in zip(_masses(wheel), velocities, strict=True)]
    angles = q[2], q[2] + wheel.alpha
    axial_parts = [float(jumps[i + 1] @ _radial(angles[i])) for i in range(2)]
    return _split(np.sum(jumps, axis=0), axial_parts[0], axial_parts[1], *angles)


def _lowest(
    function: Callable[[float], float], duration: float, *, skip_start: bool, points: int = 401
) -> float:
    """Minimum of a function over [0, duration].

    With ``skip_start`` the function starts at zero, and only later local minima and the end count.
    """
    if duration == 0:
        return math.nan
    times = np.linspace(0.0, duration, points)
    values = np.array([function(float(t)) for t in times])
    candidates = [float(values[-1])] if skip_start else [float(values[0]), float(values[-1])]
    for i in range(1, points - 1):
        if values[i] <= values[i - 1] and values[i] <= values[i + 1]:
            if skip_start and abs(values[i]) < 1e-12:
                continue
            solution = minimize_scalar(
                function,
                bounds=(float(times[i - 1]), float(times[i + 1])),
                method="bounded",
                options={"xatol": 1e-10},
            )
            candidates.append(min(float(values[i]), float(solution.fun)))
    return min(candidates)


def compute_margins(wheel: Wheel, result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the signed margins of one completed step, as in ``five_coordinates.step_margins``."""
    phases: dict[str, Phase] = {phase.name: phase for phase in result["phases"]}
    length, legs = wheel.params["locked_length"], int(wheel.params["n_legs"])

    @functools.cache  # Many margins are functions of the same forces at the same times.
    def motion(name: str, t: float) -> tuple[Array, Array, Array, Array]:
        q, v = phases[name].sample(t)
        a, multipliers = wheel.acceleration(q, v, name)
        return q, v, a, multipliers

    @functools.cache
    def forces(name: str, t: float) -> Array:
        q, v, a, _ = motion(name, t)
        return contact_forces(wheel, q, v, a, name)

    @functools.cache
    def stoppers(name: str, t: float) -> Array:
        return stopper_forces(wheel, *motion(name, t)[:3])

    def lowest(function: Callable[[str, float], float], name: str, skip: bool = False) -> float:
        duration = phases[name].duration
        return _lowest(lambda t: function(name, t), duration, skip_start=skip)

    def height(name: str, t: float) -> float:
        return wheel.foot2(phases[name].sample(t)[0])[1]

    out: dict[str, Any] = {}
    out["lambda2"] = {x: lowest(lambda name, t: float(forces(name, t)[1]), x) for x in phases}
    out["lambda4"] = {"DLS": lowest(lambda name, t: float(forces(name, t)[3]), "DLS")}
    out["foot2_clearance_sls1"] = lowest(height, "SLS-I", skip=True)
    q, v, a, _ = motion("SLS-I", 0.0)
    foot2 = mass_accelerations(wheel, q, v, a)[0] - _leg_motion(
        (q[2] + wheel.alpha, v[2], a[2]), (q[4], v[4], a[4])
    )
    out["takeoff_acceleration"] = float(foot2[1])
    out["foot2_clearance_sls2"] = lowest(height, "SLS-II")

    def stopper(leg: int, phase_name: str) -> float:
        return lowest(lambda name, t: float(stoppers(name, t)[leg - 2]), phase_name)

    minimum = [np.nanmin([stopper(leg, name) for name in phases]) for leg in range(3, legs + 1)]
    out["stopper_force_legs"] = np.array(minimum)
    out["stopper_force"] = float(np.min(minimum))
    out["stopper_force_leg2"] = stopper(2, "SLS-II")
    # One function over the whole step: only its very start is left out.
    ends = [
        lowest(lambda x, t: length - float(phases[x].sample(t)[0][3]), name, skip=i == 0)
        for i, name in enumerate(name for name in phases if phases[name].duration > 0)
    ]
    out["shortening"] = float(np.nanmin(ends))
    out["friction_leg1"] = -float(
        np.nanmin(
            [
                lowest(lambda name, t: -abs(forces(name, t)[0]) / float(forces(name, t)[1]), x)
                for x in phases
            ]
        )
    )

    q, before, after = result["landing"]
    jumps = _velocity_jumps(wheel, q, before, after)
    out["stopper_impulse_landing"] = _project_jumps(wheel, q, jumps)
    planted = result["lambda_impulse"][3] >= 0
    landing = _landing_impulses(wheel, q, before, after)
    if not planted:
        total = np.sum([m * dv for m, dv in zip(_masses(wheel), jumps, strict=True)], axis=0)
        landing = np.array([*total, 0.0, 0.0])
    out["landing_impulse"] = landing
    out["impulse_friction_leg1"] = abs(landing[0]) / landing[1]
    out["impulse_friction_leg2"] = abs(landing[2]) / landing[3] if planted else math.nan
    out["friction_leg2_landing"] = math.nan
    if phases["DLS"].duration > 0:
        start = forces("DLS", 0.0)
        out["friction_leg2_landing"] = abs(start[2]) / start[3]

    q, before, after = result["stopper"]
    jumps = _velocity_jumps(wheel, q, before, after)
    out["stopper_impulse_stopper"] = _project_jumps(wheel, q, jumps)
    total = np.sum([m * dv for m, dv in zip(_masses(wheel), jumps, strict=True)], axis=0)
    out["normal_impulse_stopper"] = float(total[1])
    out["impulse_friction_stopper"] = abs(total[0]) / total[1]  # negative if the ground must pull

    residual = float(np.max(np.abs(landing - result["lambda_impulse_applied"])))
    residual = max(residual, abs(float(total[1] - result["lambda_stopper"][1])))
    for name, phase in phases.items():
        for t in np.linspace(0.0, phase.duration, 11) if phase.duration > 0 else []:
            gap = forces(name, float(t)) - motion(name, float(t))[3]
            residual = max(residual, float(np.max(np.abs(gap))))
    out["newton_residual"] = residual
    return out


def _project_jumps(wheel: Wheel, q: Array, jumps: list[Array]) -> Array:
    """m dv_j . u_j of legs 3..n, N s."""
    mass = wheel.params["leg_mass"]
    return np.array(
        [
            mass * float(jumps[j] @ _radial(q[2] + (j - 1) * wheel.alpha))
            for j in range(3, int(wheel.params["n_legs"]) + 1)
        ]
    )

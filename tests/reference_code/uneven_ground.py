"""Reference of the paper's wheel on uneven ground, in one absolute frame.

The coordinates are those of ``five_coordinates``, with x horizontal, z upwards and theta from the
vertical. Gravity is vertical, and no slope enters the equations of motion. Straight lines join the
footholds: line k, of slope phi[k], leads from foothold k - 1 to foothold k. Feet stay at their
footholds. Step k starts with the landing on foothold k. Its rear foot leaves when the ground stops
pressing along the normal of line k. The step ends when the next foot meets line k + 1, which starts
at foothold k.

If heights are given, foothold k lies at the height h[k] above a line of the mean slope. Step k ends
when the next foot is at the height h[k + 1], and the line between both feet follows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .constrained_wheel import Array, Params, Phase, Wheel, run_phase
from .five_coordinates import ATOL, RTOL

STEPPED = "touchdown"


class Step(NamedTuple):
    """One step: how it ended; durations of DLS, SLS-I, SLS-II, s; losses, J."""

    outcome: str
    section_state: Array  # (theta-, dtheta-, dL1-) in the frame of line k + 1
    durations: Array
    post_impact: Array  # (theta+, dtheta+) in the frame of line k
    foothold: Array  # on which the step begins, (x, z), m
    lost_landing: float
    lost_stopper: float
    lost_damping: float
    energy_residual: float  # J, over the step without the landing
    clearance: float  # of Leg 2's foot over line k when Leg 2 meets its stopper, m
    fore_force: float  # normal to line k on the fore foot just before the next landing, N


def normal(slope: float) -> Array:
    """Unit vector out of a line, (x, z)."""
    return np.array([math.sin(slope), math.cos(slope)])


def walk(
    params: Params,
    x: Sequence[float],
    slopes: Sequence[float],
    *,
    rtol: float = RTOL,
    atol: float = ATOL,
) -> list[Step]:
    """Steps until one fails, one for each pair of neighbouring slopes."""
    wheel = Wheel({**params, "slope": 0.0})
    length, alpha = params["locked_length"], wheel.alpha
    theta, dtheta, dL1 = (float(value) for value in x)
    reach = length * math.cos(theta - alpha) / math.cos(theta)
    q = np.array([0.0, 0.0, theta + float(slopes[0]), reach, length])
    v = np.array([0.0, 0.0, dtheta, dL1, 0.0])
    steps: list[Step] = []
    for k in range(len(slopes) - 1):
        q, v, step = _step(wheel, q, v, float(slopes[k]), float(slopes[k + 1]), rtol, atol)
        steps.append(step)
        if step.outcome != STEPPED:
            break
    return steps


def walk_over_heights(
    params: Params, x: Sequence[float], mean_slope: float, heights: Sequence[float]
) -> list[Step]:
    """Steps until one fails, over footholds -1, 0, 1, ... at the heights above the mean line."""
    wheel = Wheel({**params, "slope": 0.0})
    theta, dtheta, dL1 = (float(value) for value in x)
    length, out = params["locked_length"], normal(mean_slope)
    reach = length * math.cos(theta - wheel.alpha) / math.cos(theta)
    q = np.array([0.0, 0.0, theta, reach, length])
    # Before the rotation by its slope, line 0 is horizontal.
    distance = math.hypot(*(_landing_foot(wheel, q) - q[:2]))
    slope = mean_slope - math.asin((heights[1] - heights[0]) / distance)
    q[2] += slope
    v, steps = np.array([0.0, 0.0, dtheta, dL1, 0.0]), []
    for before, ahead in itertools.pairwise(heights[1:]):
        rise = ahead - before
        q, v, step = _step(wheel, q, v, slope, mean_slope, RTOL, ATOL, rise)
        displacement = _landing_foot(wheel, q) - q[:2]
        slope = -math.atan2(displacement[1], displacement[0])
        theta_on_line = step.section_state[0] + mean_slope - slope
        steps.append(
            step._replace(section_state=np.array([theta_on_line, *step.section_state[1:]]))
        )
        if step.outcome != STEPPED:
            break
        assert abs(out @ displacement - rise) < 1e-12
    return steps


def _landing_foot(wheel: Wheel, q: Array) -> Array:
    """Position of the foot of the leg that lands next, (x, z)."""
    length, new = wheel.params["locked_length"], q[2] - wheel.alpha
    hub = q[:2] + q[3] * np.array([math.sin(q[2]), math.cos(q[2])])
    return hub - length * np.array([math.sin(new), math.cos(new)])


def _exchanged(wheel: Wheel, q: Array, v: Array) -> tuple[Array, Array]:
    """Labels of the step that begins: the leg at theta - alpha, which has landed, becomes Leg 1."""
    length = wheel.params["locked_length"]
    x, z, theta, reach, _ = q
    new = theta - wheel.alpha
    hub = np.array([x + reach * math.sin(theta), z + reach * math.cos(theta)])
    along, across = (
        np.array([math.sin(theta), math.cos(theta)]),
        np.array([math.cos(theta), -math.sin(theta)]),
    )
    hub_rate = v[:2] + v[3] * along + reach * v[2] * across
    foot = hub - length * np.array([math.sin(new), math.cos(new)])
    rate = hub_rate - length * v[2] * np.array([math.cos(new), -math.sin(new)])
    return np.array([*foot, new, length, reach]), np.array([*rate, v[2], 0.0, v[3]])


def _step(
    wheel: Wheel,
    q: Array,
    v: Array,
    slope: float,
    ahead: float,
    rtol: float,
    atol: float,
    rise: float = 0.0,
) -> tuple[Array, Array, Step]:
    params, out = wheel.params, normal(slope)
    length, above = params["locked_length"], normal(ahead)
    options = {"rtol": rtol, "atol": atol, "max_step": 1e-2}
    q, before = _exchanged(wheel, q, v)
    foothold, rear = q[:2].copy(), np.array(wheel.foot2(q))
    v, impulse = wheel.impact(q, before, "DLS")
    planted = bool(out @ impulse[2:4] >= 0.0)
    if not planted:
        v, _ = wheel.impact(q, before, "SLS-I")
    lost_landing = wheel.kinetic(q, before) - wheel.kinetic(q, v)
    post_impact, begins = np.array([q[2] - slope, v[2]]), wheel.energy(q, v)

    def touchdown(q: Array, v: Array) -> float:
        return float(above @ (_landing_foot(wheel, q) - foothold)) - rise

    def pressed(foot: int, mode: str) -> Any:
        return lambda q, v: float(out @ wheel.acceleration(q, v, mode)[1][foot : foot + 2])

    stopper = lambda q, v: length - float(q[4])
    fell = lambda q, v: float(v[2])
    phases: list[Phase] = []
    modes: dict[str, dict[str, Any]] = {
        "DLS": {"takeoff": pressed(2, "DLS"), "stopper early": stopper, "early": touchdown},
        "SLS-I": {"stopper": stopper, "early": touchdown, "lift": pressed(0, "SLS-I")},
        "SLS-II": {STEPPED: touchdown, "lift": pressed(0, "SLS-II")},
    }
    outcome, lost_stopper, clearance = "", 0.0, 0.0
    for mode, guards in modes.items():
        if mode == "DLS" and not planted:
            phases.append(Phase(mode, 0.0, q, v, 0.0, "takeoff", []))
            continue
        if mode == "SLS-II":
            after, _ = wheel.impact(q, v, mode)
            lost_stopper, v = wheel.kinetic(q, v) - wheel.kinetic(q, after), after
            clearance = float(out @ (np.array(wheel.foot2(q)) - rear))
        phase = run_phase(wheel, mode, q, v, {**guards, "fell back": fell}, **options)
        phases.append(phase)
        q, v, outcome = phase.q, phase.v, phase.event
        if outcome != next(iter(guards)):
            break
    damped = math.fsum(phase.dissipated for phase in phases)
    step = Step(
        outcome=outcome,
        section_state=np.array([q[2] - ahead, v[2], v[3]]),
        durations=np.array([phase.duration for phase in phases]),
        post_impact=post_impact,
        foothold=foothold,
        lost_landing=lost_landing,
        lost_stopper=lost_stopper,
        lost_damping=damped,
        energy_residual=wheel.energy(q, v) - begins + damped + lost_stopper,
        clearance=clearance,
        fore_force=float(out @ wheel.acceleration(q, v, phases[-1].name)[1][:2]),
    )
    return q, v, step

"""The paper's wheel in the paper's five coordinates: a reference without code of the library.

Coordinates q = (x, z, theta, L1, L2) with Lagrange multipliers, eqs (1)-(29) and the procedure
(A1)-(A4), (B1)-(B3) of Section 5, with misprints corrected. The equations of motion follow from the
Lagrangian (``derive_five_coordinates.py``), and SciPy's DOP853 integrates them. An event is located
by Newton's method on integrations that end at the event time, so its state carries the error of
the integrator, not that of the interpolant.

Parameters are a mapping with the keys of ``TABLE_1``. A section state is x = (theta-, dtheta-,
dL1-), in rad, rad/s, m/s, just before touchdown in the labels of the step that ends. All values
are SI: m, s, rad, N, J.

    result = step(TABLE_1, x)              # one step, touchdown to touchdown
    cycle = limit_cycle(TABLE_1, x)        # period-1 gait near x
    margins = step_margins(TABLE_1, x)     # signed margins of the model over one step
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from . import five_coordinates_equations as equations
from .constrained_wheel import NO_EVENT, Array, Guard, Params, Phase, Wheel, run_phase
from .margins import compute_margins

TABLE_1: dict[str, float] = {
    "hub_mass": 10.0,
    "leg_mass": 1.0,
    "leg_com": 0.3,
    "locked_length": 1.0,
    "natural_length": 1.02,
    "stiffness": 500.0,
    "damping": 200.0,
    "slope": 0.30,
    "gravity": 9.81,
    "n_legs": 8,
}
"""Table 1 of the paper, on the slope of Section 4; gravity is not printed there."""

START = (0.10272697, 1.61345343, -0.10903727)
"""Section state of the limit cycle of Table 1, rounded."""

STEPPED = "stepped"
TOUCHDOWN_EARLY = "touchdown before the stopper"
STOPPER_IN_DLS = "stopper met in double support"
FELL_BACK = "fell back"
FELL_FORWARD = "fell forward"
COLLAPSED = "leg collapsed"
LIFTED_OFF = "leg 1 lifted off"
NO_TOUCHDOWN = NO_EVENT
BAD_INPUT = "bad input"

RTOL, ATOL = 1e-13, 1e-14


# --- Impacts and the step.


def pre_impact(params: Params, x: Array) -> tuple[Array, Array]:
    """q-, q'- just before touchdown, Leg 1's foot at the origin and Leg 2 locked."""
    wheel = Wheel(params)
    theta, dtheta, dL1 = (float(value) for value in x)
    length = params["locked_length"]
    L1 = length * math.cos(theta - wheel.alpha) / math.cos(theta)
    return np.array([0.0, 0.0, theta, L1, length]), np.array([0.0, 0.0, dtheta, dL1, 0.0])


def exchange_labels(params: Params, q: Array, v: Array) -> tuple[Array, Array, float]:
    """Eqs (15)-(17): the locked leg at theta - alpha becomes Leg 1, Leg 1 becomes Leg 2.

    Returns q and q' in the new labels, the new Leg 1's foot at the origin, and D, the distance
    from the old to the new stance foot, m.
    """
    wheel = Wheel(params)
    length, theta, dtheta = params["locked_length"], q[2], v[2]
    new = theta - wheel.alpha
    foot_position = q[0] + q[3] * math.sin(theta) - length * math.sin(new)
    dx = v[0] + (q[3] * math.cos(theta) - length * math.cos(new)) * dtheta
    dz = v[1] - (q[3] * math.sin(theta) - length * math.sin(new)) * dtheta
    dx, dz = dx + v[3] * math.sin(theta), dz + v[3] * math.cos(theta)
    return (
        np.array([0.0, 0.0, new, length, q[3]]),
        np.array([dx, dz, dtheta, 0.0, v[3]]),
        foot_position - q[0],
    )


def post_impact_state(params: Params, theta: float, dtheta: float) -> tuple[Array, Array]:
    """q, q' just after a landing with both feet planted, from the two free numbers.

    L1 = L0 and both feet stay: the rates of the legs follow from the constraint, eq. (19).
    """
    wheel = Wheel(params)
    length = params["locked_length"]
    L2 = length * math.cos(theta) / math.cos(theta + wheel.alpha)
    q = np.array([0.0, 0.0, theta, length, L2])
    jacobian = np.array(equations.jacobian(q, wheel.pack))
    rates = np.linalg.solve(jacobian[2:, 3:], -jacobian[2:, 2] * dtheta)
    return q, np.array([0.0, 0.0, dtheta, *rates])


def step(
    params: Params,
    x: Any,
    *,
    trajectory: bool = False,
    rtol: float = RTOL,
    atol: float = ATOL,
    max_step: float = 1e-2,
) -> dict[str, Any]:
    """One step, touchdown to touchdown, from a section state x (3,).

    Keys of the result (those that the step did not reach are absent or hold NaN):

    - ``outcome``: ``STEPPED`` or the reason why the step broke off;
    - ``section_state`` (3,), ``post_impact`` (2,) = (theta, dtheta), ``durations`` (3,) of DLS,
      SLS-I, SLS-II in s, ``step_length`` in m (from the old to the new stance foot at the landing
      that opens the step);
    - ``lambda_impulse`` (4,), N s: impulses of (A1), the fourth negative if the landing frees
      Leg 2; ``lambda_impulse_applied`` (4,): those that acted;
    - ``lambda_plus`` (4,), N: multipliers of (B1) just after landing; of Leg 1 alone after (A3);
    - ``lambda_stopper`` (3,), N s: lambda_s of eq. (22);
    - ``energy_lost_landing``, ``energy_lost_stopper``, ``energy_lost_damping``, J;
    - ``energy_residual``, J: imbalance over the step, a measure of the integration error;
    - ``constraint_residual``, m: drift of the planted feet;
    - ``phases``: the raw phases; with ``trajectory`` also a list of dicts with ``name``, ``t``,
      ``q``, ``v``, ``a`` and ``multipliers`` on 201 points per phase that lasts, t from landing.
    """
    x = np.asarray(x, dtype=float)
    result: dict[str, Any] = {
        "outcome": BAD_INPUT,
        "section_state": np.full(3, np.nan),
        "post_impact": np.full(2, np.nan),
        "durations": np.full(3, np.nan),
    }
    if x.shape != (3,) or not np.all(np.isfinite(x)) or abs(math.cos(x[0])) < 1e-9:
        return result
    q, v = pre_impact(params, x)
    if q[3] <= params["leg_com"] or x[1] <= 0:
        result["outcome"] = COLLAPSED if q[3] <= params["leg_com"] else FELL_BACK
        return result
    if q[3] > params["locked_length"]:
        return result  # Leg 1 beyond its stopper
    wheel = Wheel(params)
    energy_before = wheel.energy(q, v)
    q, v, length = exchange_labels(params, q, v)
    fall = (
        (params["hub_mass"] + params["n_legs"] * params["leg_mass"])
        * params["gravity"]
        * math.sin(params["slope"])
        * length
    )

    # (A1)-(A4)
    after, impulse = wheel.impact(q, v, "DLS")
    result["lambda_impulse"] = impulse
    planted = impulse[3] >= 0
    if not planted:
        after, applied = wheel.impact(q, v, "SLS-I")
        result["lambda_impulse_applied"] = np.array([*applied, 0.0, 0.0])
    else:
        result["lambda_impulse_applied"] = impulse
    result["landing"] = (q, v, after)
    result["energy_lost_landing"] = wheel.kinetic(q, v) - wheel.kinetic(q, after)
    result["step_length"] = length
    result["post_impact"] = np.array([q[2], after[2]])
    options: dict[str, float] = {"rtol": rtol, "atol": atol, "max_step": max_step}
    return _walk(wheel, q, after, planted, result, energy_before + fall, trajectory, options)


def step_after_impact(
    params: Params, y: Any, *, trajectory: bool = False, rtol: float = RTOL, atol: float = ATOL
) -> dict[str, Any]:
    """The rest of a step from y = (theta, dtheta) just after a landing with both feet planted.

    The result is that of ``step`` without what belongs to the landing.
    """
    q, v = post_impact_state(params, float(y[0]), float(y[1]))
    wheel = Wheel(params)
    result: dict[str, Any] = {
        "outcome": BAD_INPUT,
        "section_state": np.full(3, np.nan),
        "post_impact": np.array([q[2], v[2]]),
        "durations": np.full(3, np.nan),
        "step_length": -wheel.foot2(q)[0],
        "energy_lost_landing": 0.0,
    }
    options: dict[str, float] = {"rtol": rtol, "atol": atol, "max_step": 1e-2}
    return _walk(wheel, q, v, True, result, wheel.energy(q, v), trajectory, options)


def _walk(
    wheel: Wheel,
    q: Array,
    v: Array,
    planted: bool,
    result: dict[str, Any],
    energy_before: float,
    trajectory: bool,
    options: Mapping[str, float],
) -> dict[str, Any]:
    """From just after the landing to the next touchdown: (B1)-(B3) and the three phases.

    ``energy_before`` is the energy before the landing, J, its origin the new stance foot.
    """
    params = wheel.params
    phases: list[Phase] = []
    result["phases"] = phases

    def finish(outcome: str) -> dict[str, Any]:
        result["outcome"] = outcome
        if trajectory:
            result["trajectory"] = _trajectory(wheel, phases)
        return result

    def normal_force(index: int, mode: str) -> Guard:
        return lambda q, v: float(wheel.acceleration(q, v, mode)[1][index])

    common: dict[str, Guard] = {
        FELL_BACK: lambda q, v: float(v[2]),
        FELL_FORWARD: lambda q, v: math.pi / 2 - float(q[2]),
        COLLAPSED: lambda q, v: float(min(q[3], q[4])) - params["leg_com"],
        "touchdown": lambda q, v: wheel.clearance(q),
    }

    # (B1)-(B3)
    _, multipliers = wheel.acceleration(q, v, "DLS" if planted else "SLS-I")
    result["lambda_plus"] = multipliers
    if multipliers[1] < 0:
        return finish(LIFTED_OFF)
    planted = planted and bool(multipliers[3] >= 0)
    if v[2] <= 0:
        return finish(FELL_BACK)

    if planted:
        guards = {
            "takeoff": normal_force(3, "DLS"),
            LIFTED_OFF: normal_force(1, "DLS"),
            STOPPER_IN_DLS: lambda q, v: params["locked_length"] - float(q[4]),
            **common,
        }
        dls = run_phase(wheel, "DLS", q, v, guards, **options)
    else:
        dls = Phase("DLS", 0.0, q, v, 0.0, "takeoff", [])
    phases.append(dls)
    if dls.event != "takeoff":
        return finish(TOUCHDOWN_EARLY if dls.event == "touchdown" else dls.event)

    guards = {
        "stopper": lambda q, v: params["locked_length"] - float(q[4]),
        LIFTED_OFF: normal_force(1, "SLS-I"),
        **common,
    }
    first = run_phase(wheel, "SLS-I", dls.q, dls.v, guards, **options)
    phases.append(first)
    if first.event != "stopper":
        return finish(TOUCHDOWN_EARLY if first.event == "touchdown" else first.event)

    # Collision II, eqs (22)-(25)
    after, result["lambda_stopper"] = wheel.impact(first.q, first.v, "SLS-II")
    result["energy_lost_stopper"] = wheel.kinetic(first.q, first.v) - wheel.kinetic(first.q, after)
    result["stopper"] = (first.q, first.v, after)
    guards = {LIFTED_OFF: normal_force(1, "SLS-II"), **common}
    second = run_phase(wheel, "SLS-II", first.q, after, guards, **options)
    phases.append(second)
    if second.event != "touchdown":
        return finish(second.event)

    q, v = second.q, second.v
    result["section_state"] = np.array([q[2], v[2], v[3]])
    result["durations"] = np.array([phase.duration for phase in phases])
    result["energy_lost_damping"] = math.fsum(phase.dissipated for phase in phases)
    result["energy_residual"] = (
        wheel.energy(q, v)
        - energy_before
        + result["energy_lost_landing"]
        + result["energy_lost_stopper"]
        + result["energy_lost_damping"]
    )
    result["constraint_residual"] = max(abs(q[0]), abs(q[1]))
    return finish(STEPPED)


def _trajectory(wheel: Wheel, phases: list[Phase], points: int = 201) -> list[dict[str, Any]]:
    """Samples of each phase, t in s counted from the landing."""
    blocks = []
    start = 0.0
    for phase in phases:
        if phase.duration == 0:
            continue
        t = np.linspace(0.0, phase.duration, points)
        states = [phase.sample(float(time)) for time in t]
        forces = [wheel.acceleration(q, v, phase.name) for q, v in states]
        blocks.append(
            {
                "name": phase.name,
                "t": start + t,
                "q": np.array([q for q, _ in states]),
                "v": np.array([v for _, v in states]),
                "a": np.array([a for a, _ in forces]),
                "multipliers": np.array([multipliers for _, multipliers in forces]),
            }
        )
        start += phase.duration
    return blocks


# --- Limit cycles.


def return_map(params: Params, x: Any) -> Array:
    """The next section state (3,); ArithmeticError if the wheel does not step."""
    result = step(params, x)
    if result["outcome"] != STEPPED:
        raise ArithmeticError(result["outcome"])
    section: Array = result["section_state"]
    return section


def jacobian(function: Callable[[Array], Array], x: Array, size: float = 1e-4) -> Array:
    """Central differences of order four, columns along x."""
    columns = []
    for i in range(len(x)):
        h = np.zeros_like(x)
        h[i] = size * max(1.0, abs(x[i]))
        near = function(x + h) - function(x - h)
        far = function(x + 2 * h) - function(x - 2 * h)
        columns.append((8 * near - far) / (12 * h[i]))
    return np.stack(columns, axis=1)


def limit_cycle(
    params: Params, guess: Any, *, tolerance: float = 1e-13, maximum: int = 12
) -> dict[str, Any]:
    """Period-1 gait near a section state, by Newton's method on the return map.

    The result is that of ``step`` on the cycle, and ``period`` (s), ``dls_fraction``, ``speed``
    (m/s), ``jacobian`` (3, 3) of the return map by central differences, ``multipliers`` (3,),
    ``spectral_radius`` and ``residual``. ArithmeticError if there is none to be found.
    """
    x = np.asarray(guess, dtype=float)
    slope = jacobian(lambda s: return_map(params, s), x)
    for _ in range(maximum):
        change = np.linalg.solve(slope - np.eye(3), x - return_map(params, x))
        if np.max(np.abs(change)) > 0.3:
            raise ArithmeticError("Newton's method left the neighbourhood of the guess")
        x = x + change
        if np.max(np.abs(change)) < tolerance:
            break
        if np.max(np.abs(change)) > 1e-6:
            slope = jacobian(lambda s: return_map(params, s), x)
    else:
        raise ArithmeticError("Newton's method did not settle")
    result = step(params, x)
    slope = jacobian(lambda s: return_map(params, s), x)
    multipliers = np.linalg.eigvals(slope)
    multipliers = multipliers[np.argsort(-np.abs(multipliers))]
    period = math.fsum(result["durations"])
    result["period"] = period
    result["dls_fraction"] = result["durations"][0] / period
    result["speed"] = result["step_length"] / period
    result["jacobian"] = slope
    result["multipliers"] = multipliers
    result["spectral_radius"] = float(np.max(np.abs(multipliers)))
    result["residual"] = float(np.max(np.abs(result["section_state"] - x)))
    return result


def step_margins(params: Params, x: Any) -> dict[str, Any]:
    """Return the signed margins of one step from section state x; negative means violated.

    Forces come from the accelerations of the point masses by Newton's law, not from multipliers.

    - ``lambda2``, ``lambda4``: least normal force over each phase, N, by phase name;
    - ``foot2_clearance_sls1``, ``foot2_clearance_sls2``: height of Leg 2's foot, m. It is zero at
      takeoff: over SLS-I the lowest later local minimum or the end counts;
    - ``takeoff_acceleration``: of Leg 2's foot normal to the slope at the start of SLS-I, m/s^2;
    - ``stopper_force_legs``: least stopper force of legs 3..n, N (n - 2,), over the whole step;
      ``stopper_force``: the least of them; ``stopper_force_leg2`` over SLS-II;
    - ``shortening``: lowest L0 - L1 after landing, m, without its start at zero;
    - ``friction_leg1``: greatest |lambda1| / lambda2 over the step; ``friction_leg2_landing``:
      |lambda3| / lambda4 just after landing;
    - ``stopper_impulse_landing``, ``stopper_impulse_stopper``: m dv_j . u_j of legs 3..n at the
      landing and at collision II, N s (n - 2,);
    - ``normal_impulse_stopper``: normal impulse of the planted foot at collision II, N s;
    - ``impulse_friction_leg1``, ``impulse_friction_leg2``: tangential over normal impulse of each
      foot at the landing; ``landing_impulse`` (4,), N s, if both feet stay;
    - ``newton_residual``: greatest difference of these forces and impulses from the multipliers.
    """
    result = step(params, x, max_step=2e-3)
    if result["outcome"] != STEPPED:
        raise ArithmeticError(result["outcome"])
    return compute_margins(Wheel(params), result)

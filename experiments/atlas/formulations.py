"""Other formulations of the same wheel: five coordinates, penalty contact.

The paper's five coordinates with multipliers drift off their constraints; a fixed-step penalty
contact, as general physics engines have it, needs no events and pays with accuracy. Equations are
those of `tests/reference_code`.
"""

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.reference_code import five_coordinates as reference
from tests.reference_code import five_coordinates_equations as equations
from tests.reference_code.constrained_wheel import Wheel

REFERENCE = json.loads(Path(reference.__file__).with_name("reference_values.json").read_text())[
    "cases"
][0]
PARAMS = {name: float(value) for name, value in REFERENCE["params"].items()}
START = np.array([float(v) for v in REFERENCE["step"]["start"]])
EXACT_SECTION_STATE = np.array([float(v) for v in REFERENCE["step"]["section_state"]])
PERIOD = sum(float(v) for v in REFERENCE["step"]["durations"])

DRIFT_STEP = 5e-3  # s: the fast mode's rate times it is 1
DRIFT_AT = (100, 1000, 10_000, 100_000)  # steps
BAUMGARTE = 50.0  # 1/s: both roots of the constraint's error


class ConstrainedWheel:
    """The reference's wheel, and what its phases are followed with."""

    def __init__(self, stabilised: str) -> None:
        self.wheel, self.stabilised = Wheel(PARAMS), stabilised

    def acceleration(self, q, v, mode, anchor):
        """q'' in a mode; with "Baumgarte" the constraint's error is fed back."""
        w = self.wheel
        jacobian, curvature = w.constraint(q, v, mode)
        if self.stabilised == "Baumgarte":
            gap = self.gaps(q, mode, anchor)
            curvature = curvature + 2.0 * BAUMGARTE * jacobian @ v + BAUMGARTE**2 * gap
        mass = np.array(equations.mass_matrix(q, w.pack))
        force = w.spring_damper(q, v) - np.array(equations.bias(q, v, w.pack))
        n = len(jacobian)
        matrix = np.block([[mass, -jacobian.T], [jacobian, np.zeros((n, n))]])
        return np.linalg.solve(matrix, np.concatenate([force, -curvature]))

    def gaps(self, q, mode, anchor):
        """Error of the constraints' positions."""
        feet = np.array(equations.feet(q, self.wheel.pack)) - anchor
        if mode == "DLS":
            return feet
        return feet[:2] if mode == "SLS-I" else np.append(feet[:2], q[4] - PARAMS["locked_length"])

    def step(self, q, v, h, mode, anchor):
        """Runge-Kutta of fourth order, then projection if wanted."""
        a1 = self.acceleration(q, v, mode, anchor)[:5]
        q2, v2 = q + 0.5 * h * v, v + 0.5 * h * a1
        a2 = self.acceleration(q2, v2, mode, anchor)[:5]
        q3, v3 = q + 0.5 * h * v2, v + 0.5 * h * a2
        a3 = self.acceleration(q3, v3, mode, anchor)[:5]
        q4, v4 = q + h * v3, v + h * a3
        a4 = self.acceleration(q4, v4, mode, anchor)[:5]
        q = q + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
        v = v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        if self.stabilised == "projection":
            for _ in range(2):
                jacobian, _ = self.wheel.constraint(q, v, mode)
                q = q - np.linalg.pinv(jacobian) @ self.gaps(q, mode, anchor)
            jacobian, _ = self.wheel.constraint(q, v, mode)
            v = v - np.linalg.pinv(jacobian) @ (jacobian @ v)
        return q, v

    def guard(self, q, v, mode, anchor):
        """Positive inside the phase."""
        if mode == "DLS":
            return self.acceleration(q, v, mode, anchor)[8]
        if mode == "SLS-I":
            return PARAMS["locked_length"] - q[4]
        return self.wheel.clearance(q)

    def phase(self, q, v, mode, anchor):
        """To the guard's zero, by secant re-steps; yields every step's state."""
        before = self.guard(q, v, mode, anchor)
        while True:
            q_next, v_next = self.step(q, v, DRIFT_STEP, mode, anchor)
            after = self.guard(q_next, v_next, mode, anchor)
            if after <= 0.0:
                break
            q, v, before = q_next, v_next, after
            yield q, v
        h0, g0, h1, g1 = 0.0, before, DRIFT_STEP, after
        for _ in range(8):
            h = h1 - g1 * (h1 - h0) / (g1 - g0)
            q_next, v_next = self.step(q, v, h, mode, anchor)
            h0, g0, h1, g1 = h1, g1, h, self.guard(q_next, v_next, mode, anchor)
            if abs(g1) < 1e-13 or g1 == g0:
                break
        yield q_next, v_next


def exchange(q, v):
    """Exchange the legs without a motion of the hub, so that the drift of the feet remains."""
    new = q[2] - 2.0 * math.pi / PARAMS["n_legs"]
    length = PARAMS["locked_length"]
    x = q[0] + q[3] * math.sin(q[2]) - length * math.sin(new)
    z = q[1] + q[3] * math.cos(q[2]) - length * math.cos(new)
    _, rates, _ = reference.exchange_labels(PARAMS, q, v)
    return np.array([x, z, new, length, q[3]]), rates


def drift() -> Iterator[dict[str, object]]:
    """Measure the drift of the feet over integrator steps, for three treatments of constraints."""
    for stabilised in ("none", "Baumgarte", "projection"):
        body = ConstrainedWheel(stabilised)
        q, v = reference.pre_impact(PARAMS, START)
        count, is_finished, height, begin = 0, False, 0.0, time.process_time()
        while not is_finished:
            q, v = exchange(q, v)
            v, _ = body.wheel.impact(q, v, "DLS")
            # Feet are held where they landed, at the ground's own height.
            anchor = np.array(equations.feet(q, body.wheel.pack))
            anchor[[1, 3]] = 0.0
            for mode in ("DLS", "SLS-I", "SLS-II"):
                if mode == "SLS-II":
                    v, _ = body.wheel.impact(q, v, mode)
                for state in body.phase(q, v, mode, anchor):
                    q, v = state
                    count += 1
                    height = max(height, abs(body.gaps(q, mode, anchor)).max())
                    is_finished = not np.all(np.isfinite(q)) or count >= DRIFT_AT[-1]
                    if count in DRIFT_AT:
                        yield {
                            "stabilised": stabilised,
                            "steps": count,
                            "gap_m": f"{height:.2e}",
                            "dtheta": f"{v[2]:.6g}",
                            "us_per_step": f"{(time.process_time() - begin) / count * 1e6:.3g}",
                        }
                    if is_finished:
                        break
                if is_finished:
                    break


RATIO = 0.3
"""Natural frequency of a contact times the step: what semi-implicit Euler bears with damping."""
LIFT_OFF_HEIGHT = 1e-3
"""Height at which the rear foot has left for good, m."""


FIT_START_SECONDS = 0.3  # s, of the 0.43 s of double support
"""The shock's transient lasts long: the wheel is heavier than the leg that the springs fit."""


def penalty() -> Iterator[dict[str, object]]:
    """Measure error and cost of a penalty model of the ground over the length of the solver step.

    The variant "unilateral" never pulls. The variant "held" may pull for the time HELD, as in the
    landing of the paper, whose impulse keeps both feet on the ground.
    """
    for ground in ("unilateral", "held"):
        for h in (5e-4, 2e-4, 1e-4, 5e-5, 2e-5):
            yield {"ground": ground, "step_s": h} | penalty_step(
                h, FIT_START_SECONDS / h if ground == "held" else 0.0
            )


def penalty_step(h: float, min_count: float) -> dict[str, object]:
    """Semi-implicit Euler with springs and dampers at feet and stopper; `held` counts steps."""
    wheel, mass = Wheel(PARAMS), PARAMS["leg_mass"]
    k = mass * (RATIO / h) ** 2
    c = 2.0 * math.sqrt(k * mass)
    q, v = reference.pre_impact(PARAMS, START)
    q, v, _ = reference.exchange_labels(PARAMS, q, v)
    anchor = np.array(equations.feet(q, wheel.pack))
    lifted, swung, locked, count = False, False, False, 0
    begin = time.process_time()
    while count * h < 2.0:
        jacobian = np.array(equations.jacobian(q, wheel.pack))
        gap = np.array(equations.feet(q, wheel.pack)) - anchor
        force = -k * gap - c * jacobian @ v
        lifted = lifted or (gap[3] > LIFT_OFF_HEIGHT and count >= min_count)
        if lifted or (force[3] <= 0.0 and count >= min_count):
            force[2:] = 0.0
        total = wheel.spring_damper(q, v) - np.array(equations.bias(q, v, wheel.pack))
        total = total + jacobian.T @ force
        past = q[4] - PARAMS["locked_length"]
        locked = locked or (lifted and past > 0.0)
        if locked:
            total[4] += -k * past - c * v[4]
        v = v + h * np.linalg.solve(np.array(equations.mass_matrix(q, wheel.pack)), total)
        before, q = wheel.clearance(q), q + h * v
        count += 1
        after = wheel.clearance(q)
        swung = swung or after > 1e-2
        if swung and after <= 0.0:
            break
    share = after / (after - before)  # of the last step, past the touchdown
    good = swung and after <= 0.0
    return {
        "stiffness": f"{k:.3g}",
        "evaluations": count,
        "us_per_gait": f"{(time.process_time() - begin) * 1e6:.4g}",
        "dtheta_error": f"{abs(v[2] - EXACT_SECTION_STATE[1]):.2e}",
        "period_error": f"{abs((count - share) * h - PERIOD):.2e}",
        "outcome": "STEPPED" if good else "NO_TOUCHDOWN",
    }

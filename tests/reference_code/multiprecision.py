"""One step of the wheel in multiprecision arithmetic: what the two formulations share.

``multiplier_form.MultiplierForm`` and ``hub_form.HubForm`` are the formulations; they share no
equation. Both run on heyoka's Taylor integrator. A phase ends by Newton's method on its guard,
from an approximate duration (double precision is plenty), so there is no event to miss.

Numbers travel as mpmath's ``mpf`` at ``DIGITS`` digits; all values are SI.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import heyoka as hy
import mpmath as mp

DIGITS = 58
BITS = 195
mp.mp.prec = BITS

NAMES = (
    "hub_mass",
    "leg_mass",
    "leg_com",
    "locked_length",
    "natural_length",
    "stiffness",
    "damping",
    "slope",
    "gravity",
)
"""The nine float parameters, in the order of every derivative; n_legs is fixed."""

Number = Any  # an mpf, or a heyoka expression
Vector = list[Number]


@dataclass(frozen=True)
class StepReference:
    """What one step yields; SI units, see ``five_coordinates.step`` for the meanings."""

    section_state: Vector
    post_impact: Vector
    durations: Vector
    step_length: Number
    indicators: Vector  # lambda_I4 (N s), lambda2+, lambda4+ (N)


class Formulation(Protocol):
    """A way to compute one step."""

    def walk(self, y: Sequence[Number], p: Sequence[Number], about: Sequence[float]) -> StepEnd:
        """From just after a landing to just before the next; ``about`` guesses the durations."""

    def land(self, x: Sequence[Number], p: Sequence[Number]) -> tuple[Vector, Number]:
        """Landing with both feet planted: (theta+, dtheta+) and lambda_I4."""


@dataclass(frozen=True)
class StepEnd:
    """Result of ``walk``: the section state, the durations, and lambda2+, lambda4+."""

    section_state: Vector
    durations: Vector
    multipliers: Vector


def step(
    model: Formulation, x: Sequence[Number], p: Sequence[Number], about: Sequence[float]
) -> StepReference:
    """One step from a section state; p in the order of ``NAMES`` followed by n_legs."""
    y, impulse = model.land(x, p)
    landed = model.walk(y, p, about)
    length = step_length(y, p)
    indicators = [impulse, *landed.multipliers]
    return StepReference(landed.section_state, y, landed.durations, length, indicators)


def step_length(y: Sequence[Number], p: Sequence[Number]) -> Number:
    """Distance between the feet just after landing, by the law of sines, m."""
    alpha = 2 * mp.pi / p[9]
    return p[3] * mp.sin(alpha) / mp.cos(y[0] + alpha)


def parameters(values: Mapping[str, float | str]) -> Vector:
    """Parameters as exact multiprecision numbers, in the order of ``NAMES``, then n_legs."""
    return [mp.mpf(str(values[name])) for name in NAMES] + [mp.mpf(int(values["n_legs"]))]


# --- Linear algebra that also works on heyoka expressions (no pivoting: matrices are positive).


def solve_positive(matrix: list[Vector], *right: Vector) -> list[Vector]:
    """Solutions of matrix @ s = r for each r, by elimination without pivoting."""
    size = len(matrix)
    rows = [list(matrix[i]) + [r[i] for r in right] for i in range(size)]
    for i in range(size):
        for k in range(i + 1, size):
            factor = rows[k][i] / rows[i][i]
            for j in range(i, size + len(right)):
                rows[k][j] = rows[k][j] - factor * rows[i][j]
    out = []
    for column in range(size, size + len(right)):
        s: Vector = [0] * size
        for i in reversed(range(size)):
            total = rows[i][column]
            for j in range(i + 1, size):
                total = total - rows[i][j] * s[j]
            s[i] = total / rows[i][i]
        out.append(s)
    return out


def dot(a: Sequence[Number], b: Sequence[Number]) -> Number:
    """Scalar product."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = total + left * right
    return total


def plus(a: Sequence[Number], b: Sequence[Number]) -> Vector:
    """Sum of two vectors."""
    return [left + right for left, right in zip(a, b, strict=True)]


def times(scale: Number, a: Sequence[Number]) -> Vector:
    """Multiple of a vector."""
    return [scale * entry for entry in a]


# --- heyoka: a flow whose end is located by Newton's method.


def to_real(value: Number) -> Any:
    """Number as heyoka takes it."""
    return hy.real(mp.nstr(value, DIGITS + 4), BITS)


def to_mpf(value: Any) -> Number:
    """Number as heyoka gives it."""
    return mp.mpf(str(value))


def compile_expressions(
    expressions: list[Any], variables: Sequence[Any]
) -> Callable[[Any, Any], Any]:
    """Function of (values of the variables, constants) for these expressions."""
    function = hy.cfunc(expressions, list(variables), fp_type=hy.real, prec=BITS)
    return lambda values, constants: function(values, pars=constants[: function.nparams])


class Flow:
    """Autonomous flow y' = f(y, c) in multiprecision, with an optional guard g(y, c)."""

    def __init__(self, variables: list[Any], rates: list[Any], guard: Any, constants: int) -> None:
        """Compile flow and guard; ``constants`` counts the parameters c."""
        zero = hy.real(0, BITS)
        one = [hy.real(1, BITS)] * len(variables)
        self._flow = hy.taylor_adaptive(
            list(zip(variables, rates, strict=True)),
            one,
            pars=[hy.real(1, BITS)] * constants,
            time=zero,
            fp_type=hy.real,
            compact_mode=True,
        )
        speed: Any = 0
        for variable, rate in zip(variables, rates, strict=True):
            speed = speed + hy.diff(guard, variable) * rate
        self._guard = compile_expressions([guard, speed], variables)

    def until_guard(self, y: Vector, c: Vector, about: float) -> tuple[Vector, Number]:
        """State at the zero of the guard nearest to the time ``about``, and that time, s."""
        flow = self._flow
        flow.time = hy.real(0, BITS)
        flow.state[:] = [to_real(value) for value in y]
        flow.pars[:] = [to_real(value) for value in c]
        time = mp.mpf(about)
        for _ in range(4):
            outcome = flow.propagate_until(to_real(time), write_tc=True)[0]
            if outcome != hy.taylor_outcome.time_limit:
                raise ArithmeticError(str(outcome))
            # Near the end the last Taylor series is as good as a new step, and much cheaper.
            for _ in range(6):
                flow.update_d_output(to_real(time))
                value, speed = (to_mpf(v) for v in self._guard(flow.d_output, flow.pars))
                correction = -value / speed
                if abs(correction) < mp.mpf(10) ** (-DIGITS + 4):
                    return [to_mpf(v) for v in flow.d_output], time
                time += correction
                if abs(correction) > 1e-9:
                    break
        raise ArithmeticError("the guard's zero was not located")

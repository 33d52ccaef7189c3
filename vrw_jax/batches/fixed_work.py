"""Gait steps of many wheels in a fixed amount of work, near gaits whose durations are known.

The method is Gauss collocation of order 8 on a few graded steps. The unknowns are the accelerations
at the four nodes of a step. The airborne leg's fast mode, near c/m, which forces an explicit method
to small steps, needs no extra work here. The node equations are solved by a fixed number of Newton
sweeps with one Jacobian. In the eigenvectors of the rule they are two complex systems of the
phase's size. In the last step the duration is corrected too, towards the event.

All lanes do the same work. A fixed amount of work does not detect its own errors, so each phase
returns indicators of its accuracy. They are the last corrections, the mismatch with the equations
of motion at each step's start, and the minimum of all guards. The start of a step is not a node. A
lane that fails these checks is stepped again by the adaptive engine.
"""

import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from vrw_jax.models import PAPER_START, replaced_where_bad, usable
from vrw_jax.numerics import (
    ENDS_ONCE,
    ENDS_TWICE,
    N_NODES,
    NODES,
    ONCE,
    TWICE,
    Mesh,
    Vector,
    differentiation,
    integrated,
    lagrange,
    partials_of,
)
from vrw_jax.wheel import AbstractPhase, Instant, WheelParams, phases_of, transitions


def _eigenvectors() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return one eigenvalue of each conjugate pair of the rule, with its rows and columns."""
    values, vectors = np.linalg.eig(ONCE)
    upper = np.flatnonzero(values.imag > 0.0)
    return values[upper], np.linalg.inv(vectors)[upper], vectors[:, upper]


VALUES, TO_PAIRS, FROM_PAIRS = _eigenvectors()
AT_START, AT_MIDDLE, AT_END = lagrange(0.0), lagrange(0.5), lagrange(1.0)
"""Weights that interpolate node values to both ends and to the middle of a step."""
TO_MIDDLE = integrated(0.5)
_SLOPE = differentiation()
SLOPES, BENDS = NODES[:, None] * _SLOPE, 0.5 * (NODES * NODES)[:, None] * (_SLOPE @ _SLOPE)
"""Weights of the first and second derivative of the node values as the step, with its nodes, is
stretched."""


SWEEPS = 3
"""Number of sweeps in each step but a phase's last."""
ROUNDS, SWEEPS_OF_A_ROUND = 2, 2
"""Number of corrections of the duration in the last step, and of sweeps after each."""


class Collocated(NamedTuple):
    """End of a phase, with indicators of its accuracy."""

    q: Vector
    v: Vector
    duration: Array  # s
    correction: Array  # estimated change of a rate by one more sweep, rad/s and m/s
    shift: Array  # last correction of the duration, s
    mismatch: Array  # largest error of the polynomial's rate at the start of a step
    least: Array  # over all guards but the event, at ends and middles; positive if valid


Nodes = tuple[Vector, ...]
"""Accelerations at the nodes of a step."""


class _Step(NamedTuple):
    h: Array
    nodes: Nodes
    correction: Array
    before: Array  # correction of the previous sweep


class _Solved(NamedTuple):
    step: _Step
    end: tuple[Vector, Vector]
    shift: Array  # s
    mismatch: Array
    bent: Nodes  # part that the equations linearized about its middle omit


def collocate(
    phase: AbstractPhase, q: Vector, v: Vector, expected: Array, mesh: Mesh
) -> Collocated:
    """Integrate from (q, v) to the phase's own end, its first guard, near the expected duration."""
    fractions, zero = mesh.fractions, jnp.zeros_like(expected)
    # Squared ratio of successive step lengths: the growth of the nonlinear part.
    wider = float(fractions[-1] / fractions[0]) ** (2.0 / max(mesh.n_steps - 1, 1))

    def march(carry: tuple, fraction: Array) -> tuple[tuple, None]:
        q, v, correction, mismatch, least, guards, bent = carry
        solved = _solve(phase, q, v, fraction * expected, bent)
        low, guards = _least(phase, q, v, solved, guards, 0)
        carry = (
            *solved.end,
            jnp.maximum(correction, _remaining(solved.step)),
            jnp.maximum(mismatch, solved.mismatch),
            jnp.minimum(least, low),
            guards,
            tuple(tuple(wider * x for x in node) for node in solved.bent),
        )
        return carry, None

    guards = phase.guards(Instant(phase, phase.at(q, v), None))
    carry = (q, v, zero, zero, zero + jnp.inf, guards, ((zero,) * len(q),) * N_NODES)
    if len(fractions) > 1:
        carry, _ = lax.scan(march, carry, jnp.asarray(fractions[:-1], expected.dtype))
    q, v, correction, mismatch, least, guards, bent = carry
    last = _solve(phase, q, v, float(fractions[-1]) * expected, bent, lands=True)
    low, _ = _least(phase, q, v, last, guards, 1)
    return Collocated(
        *last.end,
        duration=float(1.0 - fractions[-1]) * expected + last.step.h + last.shift,
        correction=jnp.maximum(correction, _remaining(last.step)),
        shift=jnp.abs(last.shift),
        mismatch=jnp.maximum(mismatch, last.mismatch),
        least=jnp.minimum(jnp.minimum(least, low), last.step.h),
    )


def _remaining(step: _Step) -> Array:
    """Estimate the correction of a further sweep from the last two."""
    ratio = step.correction / jnp.maximum(step.before, 1e-300)
    return step.correction * jnp.minimum(ratio, 1.0)


def _weigh(weights: np.ndarray, nodes: Nodes, d: int) -> Any:
    return sum(float(w) * a[d] for w, a in zip(weights, nodes, strict=True))


def _end(q: Vector, v: Vector, h: Array, nodes: Nodes) -> tuple[Vector, Vector]:
    n = range(len(q))
    return (
        tuple(q[d] + h * (v[d] + h * _weigh(ENDS_TWICE, nodes, d)) for d in n),
        tuple(v[d] + h * _weigh(ENDS_ONCE, nodes, d) for d in n),
    )


def _node(j: int, q: Vector, v: Vector, h: Array, nodes: Nodes) -> tuple:
    n, place = range(len(q)), float(NODES[j])
    return (
        tuple(q[d] + h * (place * v[d] + h * _weigh(TWICE[j], nodes, d)) for d in n),
        tuple(v[d] + h * _weigh(ONCE[j], nodes, d) for d in n),
    )


def _solve(
    phase: AbstractPhase, q: Vector, v: Vector, h: Array, bent: Nodes, lands: bool = False
) -> _Solved:
    """Solve for the node accelerations of one step by sweeps, and for its length if it ends at an
    event.

    The Jacobian is taken at the step's middle; a sweep then gains some two digits. The sweeps start
    from the solution of the equations linearized there, plus `nonlinear_part`, the omitted part of
    the previous step. If the length changes, the nodes move along the polynomial through them.
    """
    n = len(q)
    a0 = phase.acceleration(phase.at(q, v))[:n]
    left, by_q, by_v, by_a = _linear(phase, *_middle(q, v, a0, h), a0)
    inverses = [_factor(complex(value), h, by_q, by_v, by_a) for value in VALUES]

    def corrected(nodes: Nodes, h: Array, pairs: list) -> tuple[Nodes, Array]:
        solved = [_apply(inverse, pair) for inverse, pair in zip(inverses, pairs, strict=True)]
        return _corrected(nodes, tuple(solved), h)

    def sweep(step: _Step, _: None) -> tuple[_Step, None]:
        left = []
        for j in range(N_NODES):
            Q, V = _node(j, q, v, step.h, step.nodes)
            left.append(phase.residual(phase.at(Q, V), step.nodes[j]))
        pairs = [_to_pair(weights, tuple(left)) for weights in TO_PAIRS]
        nodes, largest = corrected(step.nodes, step.h, pairs)
        return _Step(step.h, nodes, largest, step.correction), None

    def to_event(step: _Step) -> Array:
        shift = _to_event(phase, *_end(q, v, step.h, step.nodes))
        return jnp.clip(shift, -0.5 * step.h, 0.5 * step.h)

    def turn(now: tuple[_Step, Array], _: None) -> tuple[tuple[_Step, Array], None]:
        step, shift = now
        step = step._replace(h=step.h + shift, nodes=_moved(step.nodes, shift / step.h))
        step, _ = lax.scan(sweep, step, None, length=SWEEPS_OF_A_ROUND)
        return (step, to_event(step)), None

    linear, largest = corrected((a0,) * N_NODES, h, _pairs_about_middle(left, by_q, by_v, v, a0, h))
    step, shift = _Step(h, _sum(linear, bent, 1.0), largest, largest), jnp.zeros_like(h)
    if lands:
        (step, shift), _ = lax.scan(turn, (step, to_event(step)), None, length=ROUNDS)
    else:
        step, _ = lax.scan(sweep, step, None, length=SWEEPS)
    missed = [jnp.abs(_weigh(AT_START, step.nodes, d) - a0[d]) for d in range(n)]
    mismatch = step.h * functools.reduce(jnp.maximum, missed)
    end = _end_shifted(q, v, step.h, step.nodes, shift)
    return _Solved(step, end, shift, mismatch, _sum(step.nodes, linear, -1.0))


def _sum(nodes: Nodes, others: Nodes, factor: float) -> Nodes:
    pairs = zip(nodes, others, strict=True)
    return tuple(tuple(x + factor * y for x, y in zip(*pair, strict=True)) for pair in pairs)


def _moved(nodes: Nodes, by: Array) -> Nodes:
    """Return the accelerations at the nodes of a step that is longer by a small fraction of its
    length."""
    n = range(len(nodes[0]))
    return tuple(
        tuple(
            nodes[j][d] + by * (_weigh(SLOPES[j], nodes, d) + by * _weigh(BENDS[j], nodes, d))
            for d in n
        )
        for j in range(N_NODES)
    )


def _middle(q: Vector, v: Vector, a: Vector, h: Array) -> tuple[Vector, Vector]:
    n = range(len(q))
    return (
        tuple(q[d] + 0.5 * h * (v[d] + 0.25 * h * a[d]) for d in n),
        tuple(v[d] + 0.5 * h * a[d] for d in n),
    )


def _end_shifted(
    q: Vector, v: Vector, h: Array, nodes: Nodes, shift: Array
) -> tuple[Vector, Vector]:
    """Return the step's end, extrapolated by a time whose square is negligible."""
    Q, V = _end(q, v, h, nodes)
    n = range(len(q))
    return (
        tuple(Q[d] + shift * V[d] for d in n),
        tuple(V[d] + shift * _weigh(AT_END, nodes, d) for d in n),
    )


def _linear(phase: AbstractPhase, q: Vector, v: Vector, a: Vector) -> tuple:
    """Return the residual, and the columns of its derivatives with respect to q, v and a."""
    n = len(q)

    def left_over(*arguments: Array) -> Vector:
        q, v, a = (arguments[i * n : (i + 1) * n] for i in range(3))
        return phase.residual(phase.at(q, v), a)

    left, rows = partials_of(left_over, (*q, *v, *a))
    columns = list(zip(*rows, strict=True))
    return left, *(columns[i * n : (i + 1) * n] for i in range(3))


Complex = tuple[Array, Array]


def _times(x: Complex, y: Complex) -> Complex:
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _minus(x: Complex, y: Complex) -> Complex:
    return x[0] - y[0], x[1] - y[1]


def _plus(terms: Sequence[Complex]) -> Complex:
    first, *others = terms
    real, imaginary = first
    for term in others:
        real, imaginary = real + term[0], imaginary + term[1]
    return real, imaginary


def _factor(value: complex, h: Array, by_q: Any, by_v: Any, by_a: Any) -> Any:
    """Return the inverse of by_a + h value by_v + (h value)^2 by_q."""
    n, square = len(by_q), value * value
    once, twice = (h * value.real, h * value.imag), (h * h * square.real, h * h * square.imag)
    matrix: list[list[Complex]] = [
        [
            (
                by_a[j][i] + once[0] * by_v[j][i] + twice[0] * by_q[j][i],
                once[1] * by_v[j][i] + twice[1] * by_q[j][i],
            )
            for j in range(n)
        ]
        for i in range(n)
    ]
    adjugate, determinant = _adjugate(matrix)

    size = determinant[0] * determinant[0] + determinant[1] * determinant[1]
    over = (determinant[0] / size, -determinant[1] / size)
    return [[_times(over, entry) for entry in row] for row in adjugate]


def _adjugate(m: list[list[Complex]]) -> tuple[Any, Complex]:
    """Return adjugate and determinant of a matrix of one to three rows."""
    n = len(m)
    if n == 1:
        one = (jnp.ones_like(m[0][0][0]), jnp.zeros_like(m[0][0][0]))
        return [[one]], m[0][0]
    if n == 2:
        negative = lambda x: (-x[0], -x[1])
        rows = [[m[1][1], negative(m[0][1])], [negative(m[1][0]), m[0][0]]]
        return rows, _minus(_times(m[0][0], m[1][1]), _times(m[0][1], m[1][0]))

    def cofactor(i: int, j: int) -> Complex:
        (a, b), (c, d) = ((i + 1) % 3, (i + 2) % 3), ((j + 1) % 3, (j + 2) % 3)
        return _minus(_times(m[a][c], m[b][d]), _times(m[a][d], m[b][c]))

    rows = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    parts = [_times(m[0][k], rows[k][0]) for k in range(3)]
    return rows, _plus(parts)


def _to_pair(weights: np.ndarray, left: Nodes) -> list[Complex]:
    """Project the residuals of the nodes onto one pair of eigenvectors, with the sign of a
    correction."""
    return [
        (_weigh(-weights.real, left, d), _weigh(-weights.imag, left, d))
        for d in range(len(left[0]))
    ]


def _pairs_about_middle(
    left: Vector, by_q: Any, by_v: Any, v: Vector, a: Vector, h: Array
) -> list[list[Complex]]:
    """Return `_project_residuals` for accelerations `a` and the equations linearized about the
    middle."""
    n = range(len(v))
    times = lambda columns, x: tuple(sum(columns[j][i] * x[j] for j in n) for i in n)
    by_v_a, once, twice = times(by_v, a), times(by_q, v), times(by_q, a)
    pairs = []
    for weights in TO_PAIRS:
        flat, first, second = (
            -complex(np.sum(weights * power))
            for power in (np.ones(N_NODES), NODES - 0.5, 0.5 * NODES * NODES - 0.125)
        )
        pairs.append(
            [
                tuple(
                    part(flat) * left[i]
                    + h * (part(first) * (once[i] + by_v_a[i]) + part(second) * h * twice[i])
                    for part in (lambda x: x.real, lambda x: x.imag)
                )
                for i in n
            ]
        )
    return pairs


def _apply(inverse: Any, right: list[Complex]) -> list[Complex]:
    products = [[_times(entry, x) for entry, x in zip(row, right, strict=True)] for row in inverse]
    return [_plus(row) for row in products]


def _corrected(nodes: Nodes, pairs: tuple[list[Complex], ...], h: Array) -> tuple[Nodes, Array]:
    """Return the accelerations after the correction, and the largest rate that it changed."""
    corrected, largest = [], jnp.zeros_like(h)
    for j in range(N_NODES):
        row = []
        for d in range(len(nodes[0])):
            change = sum(
                float(2.0 * FROM_PAIRS[j, p].real) * pair[d][0]
                - float(2.0 * FROM_PAIRS[j, p].imag) * pair[d][1]
                for p, pair in enumerate(pairs)
            )
            row.append(nodes[j][d] + change)
            largest = jnp.maximum(largest, jnp.abs(change))
        corrected.append(tuple(row))
    return tuple(corrected), h * largest


def _to_event(phase: AbstractPhase, q: Vector, v: Vector) -> Array:
    """Return the time from (q, v) to the phase's own end, by Newton's method."""

    def event(q: Vector, v: Vector) -> tuple[Array, Vector]:
        at = Instant(phase, phase.at(q, v), None)
        return phase.end(at), at.acceleration[: phase.n]

    _, slope = event(q, v)
    (value, _), (rate, _) = jax.jvp(event, (q, v), (v, slope))
    return -value / jnp.where(rate < 0.0, rate, -jnp.inf)


def _least(
    phase: AbstractPhase, q: Vector, v: Vector, solved: _Solved, first: Vector, skipped: int
) -> tuple[Array, Vector]:
    """Return the smallest guard at the step's middle and end, and all guards at the end.

    The smallest guard is -1 if a guard may be negative in between. Between the three points a guard
    may dip by a quarter of its second difference. `start_guards` are those at the start.
    `n_skipped` is 1 in the last step, whose first guard is the event itself and zero at the end.
    """
    step, d = solved.step, range(len(q))
    in_middle = tuple(_weigh(AT_MIDDLE, step.nodes, i) for i in d)
    at_end = tuple(_weigh(AT_END, step.nodes, i) for i in d)
    once, twice = (tuple(_weigh(w, step.nodes, i) for i in d) for w in TO_MIDDLE)
    half = (
        tuple(q[i] + step.h * (0.5 * v[i] + step.h * twice[i]) for i in d),
        tuple(v[i] + step.h * once[i] for i in d),
    )
    guards = lambda q, v, a: phase.guards(Instant(phase, phase.at(q, v), a))
    middle, last = guards(*half, in_middle), guards(*solved.end, at_end)

    least = jnp.full_like(step.h, jnp.inf)
    for i, (begin, between, end) in enumerate(zip(first, middle, last, strict=True)):
        low = jnp.minimum(begin, between)
        if i >= skipped:
            low, hidden = jnp.minimum(low, end), 0.25 * jnp.abs(begin - 2.0 * between + end)
            low = jnp.where(low > hidden, low, -1.0)
        least = jnp.minimum(least, low)
    return least, last


MESHES = Mesh(4, 1.0), Mesh(5, 4.0), Mesh(2, 1.0)
"""Meshes of DLS, SLS-I and SLS-II, chosen because they are the cheapest of those tried with errors
below 1e-8. The errors are the 99th percentile over lanes near their gaits. The cost includes that
of the lanes left to the adaptive engine (experiments/speed/engine_benchmark.py)."""

MOST_CORRECTION = 5e-8
MOST_SHIFT = 1e-5
MOST_MISMATCH = (2e-3, 1.2e-1, 8e-5)
"""Limits of the indicators of a trusted lane, see `CollocatedPhase`. Errors are at most the square
of a mismatch. The end is extrapolated by the last shift, which leaves half of its square times a
rate. One in a hundred lanes exceeds the limits near its gait."""


class FixedStep(NamedTuple):
    """One gait step of a block of lanes, with the lanes that pass the checks."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    trusted: Bool[Array, " lanes"]


def fixed_gait_step(
    params: WheelParams,
    x: Vector,
    expected: Vector,
    stop_at_lift_off: bool,
) -> FixedStep:
    """Take one gait step of every lane, near the expected durations of DLS, SLS-I and SLS-II."""
    known = [(duration > 0.0) & (duration < 10.0) for duration in expected]
    good = functools.reduce(operator.and_, known, usable(params, x))
    params, x = replaced_where_bad(good, params, x, PAPER_START)
    expected = tuple(jnp.where(good, duration, 0.1) for duration in expected)
    s = params.symbols()
    landing = transitions.land(s, *x)
    trusted = good & landing.stays
    theta, motion = landing.theta, landing.motion
    phases = phases_of(s, landing.distance, stop_at_lift_off)
    durations = []
    for phase, duration, mesh, most in zip(phases, expected, MESHES, MOST_MISMATCH, strict=True):
        end = collocate(phase, *phase.own(theta, motion), duration, mesh)
        trusted = trusted & (end.correction <= MOST_CORRECTION) & (end.shift <= MOST_SHIFT)
        trusted = trusted & (end.mismatch <= most) & (end.least > 0.0)
        theta, motion = end.q[0], phase.after(phase.at(end.q, end.v))
        durations.append(end.duration)
    kept = lambda values: tuple(jnp.where(trusted, value, 0.0) for value in values)
    return FixedStep(kept((theta, motion.dtheta, motion.dL1)), kept(durations), trusted)

"""Gait steps of many wheels in a fixed amount of work, near gaits whose durations are known.

Gauss collocation of order 8 on a few graded steps: unknown are the accelerations at four nodes of a
step. The airborne leg's fast mode, near c/m, which an explicit method must follow by small steps,
costs nothing extra here. The node equations are solved by a fixed number of sweeps of Newton's
method with the Jacobian at the step's start, in the eigenvectors of the rule: two complex systems
of the phase's size. In the last step each sweep corrects the duration too, towards the event.

No lane waits for another. A fixed amount of work notices nothing by itself, so each phase says how
far it can be trusted: the last corrections, the mismatch of the collocation polynomial with the
equations of motion at each step's start, where it was not asked to hold, and the least of all
guards. A lane that can't be trusted is stepped anew by the adaptive engine.
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
    lagrange,
)
from vrw_jax.wheel import AbstractPhase, Instant, WheelParams, phases_of, transitions


def _eigenvectors() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One eigenvalue of each conjugate pair of the rule, with its rows and columns."""
    values, vectors = np.linalg.eig(ONCE)
    upper = np.flatnonzero(values.imag > 0.0)
    return values[upper], np.linalg.inv(vectors)[upper], vectors[:, upper]


VALUES, TO_PAIRS, FROM_PAIRS = _eigenvectors()
AT_START, AT_END = lagrange(0.0), lagrange(1.0)
"""Weights that extrapolate node values to both ends of a step."""


class Scheme(NamedTuple):
    """Steps of one phase, sweeps in each but the last, and rounds of two sweeps in the last, each
    followed by a correction of the duration."""

    mesh: Mesh
    sweeps: int
    rounds: int


class Collocated(NamedTuple):
    """A phase's end, and how far it can be trusted."""

    q: Vector
    v: Vector
    duration: Array  # s
    correction: Array  # rate that one more sweep would still change, about; rad/s and m/s
    shift: Array  # the last correction of the duration, s
    mismatch: Array  # rate that the polynomial misses at the start of a step, at most
    least: Array  # of all guards at nodes and ends but the event itself; not positive: broken


class _Step(NamedTuple):
    h: Array
    nodes: tuple[Vector, ...]  # accelerations
    correction: Array
    before: Array  # the correction of the sweep before


class _Solved(NamedTuple):
    step: _Step
    end: tuple[Vector, Vector]
    shift: Array  # s
    mismatch: Array


def collocate(
    phase: AbstractPhase, q: Vector, v: Vector, expected: Array, scheme: Scheme
) -> Collocated:
    """From (q, v) to the phase's own end, which is its first guard, near the expected duration."""
    fractions = scheme.mesh.fractions
    zero = jnp.zeros_like(expected)

    def march(carry: tuple, fraction: Array) -> tuple[tuple, None]:
        q, v, correction, mismatch, least = carry
        solved = _solve(phase, q, v, fraction * expected, (1, scheme.sweeps))
        low = _least(phase, q, v, solved, 0)
        carry = (
            *solved.end,
            jnp.maximum(correction, _remaining(solved.step)),
            jnp.maximum(mismatch, solved.mismatch),
            jnp.minimum(least, low),
        )
        return carry, None

    carry = (q, v, zero, zero, zero + jnp.inf)
    if len(fractions) > 1:
        carry, _ = lax.scan(march, carry, jnp.asarray(fractions[:-1], expected.dtype))
    q, v, correction, mismatch, least = carry
    h = float(fractions[-1]) * expected
    last = _solve(phase, q, v, h, (scheme.rounds, 2), lands=True)
    low = jnp.minimum(_least(phase, q, v, last, 1), last.step.h)
    return Collocated(
        *last.end,
        duration=float(1.0 - fractions[-1]) * expected + last.step.h + last.shift,
        correction=jnp.maximum(correction, _remaining(last.step)),
        shift=jnp.abs(last.shift),
        mismatch=jnp.maximum(mismatch, last.mismatch),
        least=jnp.minimum(least, low),
    )


def _remaining(step: _Step) -> Array:
    """What a further sweep would correct, from the last two."""
    ratio = step.correction / jnp.maximum(step.before, 1e-300)
    return step.correction * jnp.minimum(ratio, 1.0)


def _weigh(weights: np.ndarray, nodes: tuple[Vector, ...], d: int) -> Any:
    return sum(float(w) * a[d] for w, a in zip(weights, nodes, strict=True))


def _end(q: Vector, v: Vector, h: Array, nodes: tuple[Vector, ...]) -> tuple[Vector, Vector]:
    n = range(len(q))
    return (
        tuple(q[d] + h * (v[d] + h * _weigh(ENDS_TWICE, nodes, d)) for d in n),
        tuple(v[d] + h * _weigh(ENDS_ONCE, nodes, d) for d in n),
    )


def _node(j: int, q: Vector, v: Vector, h: Array, nodes: tuple[Vector, ...]) -> tuple:
    n, place = range(len(q)), float(NODES[j])
    return (
        tuple(q[d] + h * (place * v[d] + h * _weigh(TWICE[j], nodes, d)) for d in n),
        tuple(v[d] + h * _weigh(ONCE[j], nodes, d) for d in n),
    )


def _solve(
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    h: Array,
    rounds_of_sweeps: tuple[int, int],
    lands: bool = False,
) -> _Solved:
    """The node accelerations of one step, by sweeps; where it lands, its length as well.

    The Jacobian is taken about the step's middle: a sweep then gains some two digits.
    """
    n = len(q)
    rounds, sweeps = rounds_of_sweeps
    a0 = phase.acceleration(phase.at(q, v))[:n]
    by_q, by_v, by_a = _partials(phase, *_middle(q, v, a0, h), a0)
    inverses = [_factor(complex(value), h, by_q, by_v, by_a) for value in VALUES]

    def sweep(step: _Step, _: None) -> tuple[_Step, None]:
        left = []
        for j in range(N_NODES):
            Q, V = _node(j, q, v, step.h, step.nodes)
            left.append(phase.residual(phase.at(Q, V), step.nodes[j]))
        pairs = [
            _apply(inverse, _to_pair(weights, tuple(left)))
            for inverse, weights in zip(inverses, TO_PAIRS, strict=True)
        ]
        nodes, largest = _corrected(step.nodes, tuple(pairs), step.h)
        return _Step(step.h, nodes, largest, step.correction), None

    def turn(carry: tuple[_Step, Array], _: None) -> tuple[tuple[_Step, Array], None]:
        step, shift = carry
        step = step._replace(h=step.h + shift)
        step, _ = lax.scan(sweep, step, None, length=sweeps)
        if lands:
            shift = _to_event(phase, *_end(q, v, step.h, step.nodes))
            shift = jnp.clip(shift, -0.5 * step.h, 0.5 * step.h)
        return (step, shift), None

    unknown = jnp.full_like(h, jnp.inf)
    start = _Step(h, (a0,) * N_NODES, unknown, unknown)
    (step, shift), _ = lax.scan(turn, (start, jnp.zeros_like(h)), None, length=rounds)
    missed = [jnp.abs(_weigh(AT_START, step.nodes, d) - a0[d]) for d in range(n)]
    mismatch = step.h * functools.reduce(jnp.maximum, missed)
    end = _end_shifted(q, v, step.h, step.nodes, shift)
    return _Solved(step, end, shift, mismatch)


def _middle(q: Vector, v: Vector, a: Vector, h: Array) -> tuple[Vector, Vector]:
    n = range(len(q))
    return (
        tuple(q[d] + 0.5 * h * (v[d] + 0.25 * h * a[d]) for d in n),
        tuple(v[d] + 0.5 * h * a[d] for d in n),
    )


def _end_shifted(
    q: Vector, v: Vector, h: Array, nodes: tuple[Vector, ...], shift: Array
) -> tuple[Vector, Vector]:
    """The step's end, moved on along its slope by a time so short that its square is nothing."""
    Q, V = _end(q, v, h, nodes)
    n = range(len(q))
    return (
        tuple(Q[d] + shift * V[d] for d in n),
        tuple(V[d] + shift * _weigh(AT_END, nodes, d) for d in n),
    )


def _partials(phase: AbstractPhase, q: Vector, v: Vector, a: Vector) -> tuple:
    """Columns of the residual's derivatives by q, v and a."""
    whole = lambda q, v, a: phase.residual(phase.at(q, v), a)
    arguments = (q, v, a)

    def column(which: int, d: int) -> Vector:
        def along(x: Array) -> Vector:
            moved = list(arguments)
            moved[which] = (*moved[which][:d], x, *moved[which][d + 1 :])
            return whole(*moved)

        x = arguments[which][d]
        return jax.jvp(along, (x,), (jnp.ones_like(x),))[1]

    full = lambda x: jnp.broadcast_to(x, q[0].shape)
    return tuple(
        tuple(tuple(full(x) for x in column(which, d)) for d in range(len(q))) for which in range(3)
    )


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
    """Inverse of by_a + h value by_v + (h value)^2 by_q."""
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
    """Adjugate and determinant of a matrix of one to three rows."""
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


def _to_pair(weights: np.ndarray, left: tuple[Vector, ...]) -> list[Complex]:
    """What the nodes leave over, in one pair of eigenvectors, with the sign of a correction."""
    return [
        (_weigh(-weights.real, left, d), _weigh(-weights.imag, left, d))
        for d in range(len(left[0]))
    ]


def _apply(inverse: Any, right: list[Complex]) -> list[Complex]:
    products = [[_times(entry, x) for entry, x in zip(row, right, strict=True)] for row in inverse]
    return [_plus(row) for row in products]


def _corrected(
    nodes: tuple[Vector, ...], pairs: tuple[list[Complex], ...], h: Array
) -> tuple[tuple[Vector, ...], Array]:
    """Accelerations after the correction, and the largest rate that it changed."""
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
    """Time from (q, v) to the phase's own end, by Newton's method."""

    def event(q: Vector, v: Vector) -> tuple[Array, Vector]:
        at = Instant(phase, phase.at(q, v), None)
        return phase.end(at), at.acceleration[: phase.n]

    _, slope = event(q, v)
    (value, _), (rate, _) = jax.jvp(event, (q, v), (v, slope))
    return -value / jnp.where(rate < 0.0, rate, -jnp.inf)


def _least(phase: AbstractPhase, q: Vector, v: Vector, solved: _Solved, skipped: int) -> Array:
    """Least guard at two nodes and the step's end, -1 where one may be broken in between.

    Between them a guard may dip by a quarter of its second difference. `skipped` is 1 in the last
    step, whose first guard is the event itself and zero at the end.
    """
    step = solved.step
    at_end = tuple(_weigh(AT_END, step.nodes, d) for d in range(len(q)))
    places = [(*_node(j, q, v, step.h, step.nodes), step.nodes[j]) for j in (0, 2)]
    values = [
        phase.guards(Instant(phase, phase.at(q, v), a))
        for q, v, a in (*places, (*solved.end, at_end))
    ]

    least = jnp.full_like(step.h, jnp.inf)
    for i, (first, middle, last) in enumerate(zip(*values, strict=True)):
        low = jnp.minimum(first, middle)
        if i >= skipped:
            low = jnp.minimum(low, last)
            hidden = 0.25 * jnp.abs(first - 2.0 * middle + last)
            low = jnp.where(low > hidden, low, -1.0)
        least = jnp.minimum(least, low)
    return least


SCHEMES = (
    Scheme(Mesh(4, 1.0), sweeps=4, rounds=4),
    Scheme(Mesh(5, 3.0), sweeps=4, rounds=4),
    Scheme(Mesh(1, 1.0), sweeps=0, rounds=3),
)
"""Of DLS, SLS-I and SLS-II: the cheapest of those tried whose 99th percentile of errors over lanes
near their gaits is about 1e-8 (experiments/speed/engine_benchmark.py)."""

MOST_CORRECTION = 5e-8
MOST_SHIFT = 1e-6
MOST_MISMATCH = (2e-3, 1.2e-1, 8e-5)
"""What a trusted lane may show at most, see `Collocated`; errors are the square of a mismatch and
less. Some three in a hundred lanes show more near their gaits."""


class FixedStep(NamedTuple):
    """One gait step of a block of lanes, and which of them to trust."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    trusted: Bool[Array, " lanes"]


def fixed_gait_step(
    params: WheelParams,
    x: Vector,
    expected: Vector,
    stop_at_lift_off: bool,
) -> FixedStep:
    """One gait step of every lane, near the expected durations of DLS, SLS-I, SLS-II."""
    known = [(duration > 0.0) & (duration < 10.0) for duration in expected]
    good = functools.reduce(operator.and_, known, usable(params, x))
    params, x = replaced_where_bad(good, params, x, PAPER_START)
    expected = tuple(jnp.where(good, duration, 0.1) for duration in expected)
    s = params.symbols()
    landing = transitions.land(s, *x)
    trusted = good & landing.stays
    theta, motion = landing.theta, landing.motion
    phases = phases_of(s, landing.distance, stop_at_lift_off)
    for value in phases[0].guards(Instant(phases[0], motion, None)):
        trusted = trusted & (value > 0.0)
    durations = []
    for phase, duration, scheme, most in zip(phases, expected, SCHEMES, MOST_MISMATCH, strict=True):
        end = collocate(phase, *phase.own(theta, motion), duration, scheme)
        trusted = trusted & (end.correction <= MOST_CORRECTION) & (end.shift <= MOST_SHIFT)
        trusted = trusted & (end.mismatch <= most) & (end.least > 0.0)
        theta, motion = end.q[0], phase.after(phase.at(end.q, end.v))
        durations.append(end.duration)
    kept = lambda values: tuple(jnp.where(trusted, value, 0.0) for value in values)
    return FixedStep(kept((theta, motion.dtheta, motion.dL1)), kept(durations), trusted)

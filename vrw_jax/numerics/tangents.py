"""How the ends of a lane's phase move with its start and with what its equations hold constant.

Beside each Runge-Kutta step the same step is made of the linearised equations, for as many
directions as are asked for: what all directions share, the slopes' derivatives at the stages, is
computed once, and each direction then costs some hundred products. Step sizes and what an event's
search tried take no part: the derivative is that of the discrete flow at the lengths that were
taken, and of the time at which its guard vanishes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array

from vrw_jax.numerics.tableaus import Place, Slope, Tableau, stage_at
from vrw_jax.numerics.types import Vector


class Balance(NamedTuple):
    """The equations of motion near a place, whose slope is known."""

    residual: Callable[[Place], Vector]
    """What they leave over there: their left side at the place's accelerations less the right."""
    solve: Callable[[Place, Vector], Vector]
    """Accelerations that the left side turns into these rows."""


BalanceOf = Callable[[Any], Balance]
"""By what the equations hold constant, a tree of arrays."""


class Slopes(NamedTuple):
    """Derivatives of the accelerations at the stages of a step."""

    by_state: Array  # (stages, n, 2 n, lanes): by positions, then rates
    by_constants: Array  # (stages, n, lanes): along their direction


def slopes_of(of: BalanceOf, constants: Any, moved: Any, stages: list[Place]) -> Slopes:
    """At each stage, and along `moved`, a direction of `constants`."""

    def at(row: Array) -> tuple[Array, Array]:
        place = _unpacked(row)
        by_state = [_moved(of(constants), place, *unit) for unit in _units(place)]
        rows = jax.jvp(lambda held: of(held).residual(place), (constants,), (moved,))[1]
        by_constants = _accelerated(of(constants), place, rows)
        return jnp.stack([jnp.stack(x) for x in zip(*by_state, strict=True)]), by_constants

    return Slopes(*lax.map(at, jnp.stack([_packed(place) for place in stages])))


def _packed(place: Place) -> Array:
    n = len(place.q)
    sin, cos, acceleration = place.slope
    return jnp.stack([*place.q, *place.v, sin, cos, *acceleration[:n]])


def _unpacked(row: Array) -> Place:
    n = (len(row) - 2) // 3
    numbers = tuple(row)
    slope = Slope(numbers[2 * n], numbers[2 * n + 1], numbers[2 * n + 2 :])
    return Place(numbers[:n], numbers[n : 2 * n], slope)


def _units(place: Place) -> list[tuple[Vector, Vector]]:
    """Each position and each rate by itself."""
    n, like = len(place.q), place.q[0]
    row = lambda i: tuple(jnp.full_like(like, float(i == j)) for j in range(n))
    return [(row(i), row(-1)) for i in range(n)] + [(row(-1), row(i)) for i in range(n)]


def _moved(balance: Balance, place: Place, dq: Vector, dv: Vector) -> Vector:
    """Change of the accelerations along a direction of positions and rates."""
    sin, cos, acceleration = place.slope
    still = tuple(jnp.zeros_like(x) for x in acceleration)
    change = Place(dq, dv, Slope(cos * dq[0], -sin * dq[0], still))
    return tuple(_accelerated(balance, place, jax.jvp(balance.residual, (place,), (change,))[1]))


def _accelerated(balance: Balance, place: Place, rows: Vector) -> Array:
    return -jnp.stack(balance.solve(place, rows))


def carried(tableau: Tableau, slopes: Slopes, start: Array, h: Array) -> Array:
    """A direction (positions, then rates) at a step's start, carried to its end.

    Under `jax.vmap` over directions a few are taken at a time: they live in registers, and while
    one waits for its last sum the others go on.
    """

    def step(by_state: Array, by_constants: Array, start: Array, h: Array) -> Array:
        n = len(start) // 2
        q0, v0 = tuple(start[:n]), tuple(start[n:])
        known: list[Vector] = []
        for i in range(len(tableau.places) - 1):
            q, v = stage_at(tableau, i, q0, v0, known, h) if i else (q0, v0)
            rows = [[by_state[i, d, e] * x for e, x in enumerate((*q, *v))] for d in range(n)]
            known.append(tuple(sum(row, start=by_constants[i, d]) for d, row in enumerate(rows)))
        q, v = stage_at(tableau, len(tableau.places) - 1, q0, v0, known, h)
        return jnp.stack([*q, *v])

    over_directions = custom_vmap(step)

    @over_directions.def_vmap
    def few_at_a_time(n: int, batched: list, by_state: Array, *others: Array) -> tuple:
        assert not batched[0] and not batched[3]  # all directions leave from one place
        by_constants, start = (
            x if its_own else jnp.broadcast_to(x, (n, *x.shape))
            for x, its_own in zip(others[:2], batched[1:3], strict=True)
        )
        h = others[2]
        size = min(TOGETHER, key=lambda size: (-n % size, -size))
        cut = lambda x: jnp.concatenate([x, x[: -n % size]]).reshape(-1, size, *x.shape[1:])
        some = jax.vmap(step, in_axes=(None, 0, 0, None))
        told = lax.map(lambda given: some(by_state, *given, h), (cut(by_constants), cut(start)))
        return told.reshape(-1, *start.shape[1:])[:n], True

    return over_directions(slopes.by_state, slopes.by_constants, start, h)


TOGETHER = (1,)
"""Directions that are carried at a time: what leaves none over."""


class Moving(NamedTuple):
    """A direction in which a phase's start and constants move."""

    of: BalanceOf
    constants: Any
    moved: Any  # like the constants
    start: Array  # positions, then rates, (2 n, lanes)

    def along(self, tableau: Tableau, stages: list[Place], start: Array, h: Array) -> Array:
        """The direction at a step's start, carried to its end."""
        return carried(tableau, slopes_of(self.of, self.constants, self.moved, stages), start, h)

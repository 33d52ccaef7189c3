"""How the ends of a lane's phase move with its start and with what its equations hold constant.

Beside each Runge-Kutta step the same step is made of the linearised equations, for as many
directions as are asked for: what all directions share, the slopes' derivatives at the stages, is
computed once, and each direction then costs some hundred products. Step sizes and what an event's
search tried take no part: the derivative is that of the discrete flow at the lengths that were
taken, and of the time at which its guard vanishes.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap
from jaxtyping import Array

from vrw_jax.numerics.derivatives import without_derivative
from vrw_jax.numerics.tableaus import Place, Slope, Tableau, stage_at
from vrw_jax.numerics.types import Vector


class Balance(NamedTuple):
    """The equations of motion near a place, whose slope is known."""

    residual: Callable[[Place], Vector]
    """What they leave over there: their left side at the place's accelerations less the right."""
    solve: Callable[[Place, Vector], Vector]
    """Accelerations that the left side turns into these rows."""


BalanceOf = Callable[[Any, Vector], Balance]
"""By what the equations hold constant: a tree of arrays that moves in few directions, and numbers
that move in any, as a phase's start does."""


class Slopes(NamedTuple):
    """Derivatives of the accelerations at the stages of a step."""

    by_state: Array  # (stages, n, ., lanes): by positions, rates, then what is held
    by_constants: Array  # (stages, n, lanes): along their direction


@functools.partial(jax.jit, static_argnums=0)
def _slopes_of(
    of: BalanceOf, constants: Any, moved: Any, held: Vector, stages: list[Place]
) -> Slopes:
    def at(row: Array) -> tuple[Array, Array]:
        place, balance = _unpacked(row), _traced_once(of(constants, held))
        residual = lambda constants, held: of(constants, held).residual(place)
        along = lambda *way: _accelerated(balance, place, jax.jvp(residual, *way)[1])
        still = jax.tree.map(jnp.zeros_like, constants)
        by_state = [jnp.stack(_moved(balance, place, *unit)) for unit in _units(place)]
        by_state += [along((constants, held), (still, unit)) for unit in _unit_rows(held)]
        unmoved = tuple(jnp.zeros_like(x) for x in held)
        by_constants = along((constants, held), (moved, unmoved))
        return jnp.stack(by_state, 1), by_constants

    return Slopes(*lax.map(at, jnp.stack([_packed(place) for place in stages[:-1]])))


def _traced_once(balance: Balance) -> Balance:
    return Balance(jax.jit(balance.residual), jax.jit(balance.solve))


def _packed(place: Place) -> Array:
    n = len(place.q)
    sin, cos, acceleration = place.slope
    return jnp.stack([*place.q, *place.v, sin, cos, *acceleration[:n]])


def _unpacked(row: Array) -> Place:
    n = (len(row) - 2) // 3
    numbers = tuple(row)
    slope = Slope(numbers[2 * n], numbers[2 * n + 1], numbers[2 * n + 2 :])
    return Place(numbers[:n], numbers[n : 2 * n], slope)


def _unit_rows(like: Vector) -> list[Vector]:
    n = len(like)
    return [tuple(jnp.full_like(like[j], float(i == j)) for j in range(n)) for i in range(n)]


def _units(place: Place) -> list[tuple[Vector, Vector]]:
    rows, n = _unit_rows((*place.q, *place.v)), len(place.q)
    return [(row[:n], row[n:]) for row in rows]


def _moved(balance: Balance, place: Place, dq: Vector, dv: Vector) -> Vector:
    """Change of the accelerations along a direction of positions and rates."""
    sin, cos, acceleration = place.slope
    still = tuple(jnp.zeros_like(x) for x in acceleration)
    change = Place(dq, dv, Slope(cos * dq[0], -sin * dq[0], still))
    return tuple(_accelerated(balance, place, jax.jvp(balance.residual, (place,), (change,))[1]))


def _accelerated(balance: Balance, place: Place, rows: Vector) -> Array:
    return -jnp.stack(balance.solve(place, rows))


@functools.cache
def _carried(tableau: Tableau) -> Callable[..., Array]:
    """A direction (positions, rates, what is held) at a step's start, carried to its end.

    Under `jax.vmap` over directions one is taken after the other: each lives in registers.
    """

    @jax.jit  # traced once, wherever it is called
    def step(by_state: Array, by_constants: Array, start: Array, h: Array) -> Array:
        n = by_state.shape[1]
        q0, v0, held = tuple(start[:n]), tuple(start[n : 2 * n]), tuple(start[2 * n :])
        known: list[Vector] = []
        for i in range(len(tableau.places) - 1):
            q, v = stage_at(tableau, i, q0, v0, known, h) if i else (q0, v0)
            rows = [
                [by_state[i, d, e] * x for e, x in enumerate((*q, *v, *held))] for d in range(n)
            ]
            known.append(tuple(sum(row, start=by_constants[i, d]) for d, row in enumerate(rows)))
        q, v = stage_at(tableau, len(tableau.places) - 1, q0, v0, known, h)
        return jnp.stack([*q, *v, *held])

    return sequential_vmap(step)


def pushed(function: Callable[..., Any], at: tuple, direction: tuple) -> Any:
    """`jax.jvp` without the value; under `jax.vmap` one direction after the other.

    The code is short then however many there are. `function` may close over no traced arrays.
    """
    return sequential_vmap(lambda at, way: jax.jvp(function, at, way)[1])(at, direction)


def by_directions(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of trees, whose derivative by their floats is `pushed`."""

    def call(*arguments: Any) -> Any:
        floats, others = eqx.partition(arguments, eqx.is_inexact_array)
        whole = lambda *floats: function(*eqx.combine(floats, others))
        only_floats = lambda *floats: eqx.filter(whole(*floats), eqx.is_inexact_array)
        called = jax.custom_jvp(whole)

        @called.defjvp
        def rule(at: tuple, direction: tuple) -> tuple:
            out = whole(*at)
            moved = pushed(only_floats, at, direction)
            return out, eqx.combine(moved, without_derivative(out))

        return called(*floats)

    return call


class Moving(NamedTuple):
    """A direction in which a phase moves: its constants, its start and what it holds since then."""

    of: BalanceOf
    constants: Any
    held: Vector
    moved: Any  # like the constants
    start: Array  # positions, rates, what is held, (., lanes)

    def along(self, tableau: Tableau, stages: list[Place], start: Array, h: Array) -> Array:
        """The direction at a step's start, carried to its end."""
        slopes = _slopes_of(self.of, self.constants, self.moved, self.held, stages)
        return _carried(tableau)(*slopes, start, h)

    def of_values(self, values: Callable[..., Any], place: Place, direction: Array) -> Any:
        """How `values(constants, held, q, v)` move with the direction there."""
        n, numbers = len(place.q), tuple(direction)
        at = self.constants, self.held, place.q, place.v
        return pushed(values, at, (self.moved, numbers[2 * n :], numbers[:n], numbers[n : 2 * n]))

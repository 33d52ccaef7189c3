"""How the ends of a lane's phase move with its start and with what its equations hold constant.

Beside each Runge-Kutta step the same step is made of the linearised equations, for as many
directions as are asked for: what all directions share, the slopes' derivatives at the stages, is
computed once, and each direction then costs some hundred products. Step sizes and what an event's
search tried take no part: the derivative is that of the discrete flow at the lengths that were
taken, and of the time at which its guard vanishes.

`jax.vmap` around a derivative gives its directions. Here they are an axis of arrays instead, the
first: loops are traced as they are, not once more for the vmap.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.extend.core import Primitive
from jax.interpreters import batching
from jaxtyping import Array

from vrw_jax.numerics.derivatives import without_derivative
from vrw_jax.numerics.lanes import if_any
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


def in_directions(
    function: Callable[[Any, Any], tuple[Any, Any]], at: Any, way: Any
) -> tuple[Any, Any]:
    """(values, tangents) as a rule tells them, from a `function` that takes all directions at once.

    `at`, `way`: primals and tangents as the rule is given them. `function` takes the second with
    the axis of directions first, of length 1 where all have the same, and tells tangents so.
    """
    leaves, structure = jax.tree.flatten((at, way))
    n_at, size = len(jax.tree.leaves(at)), len(_around(way))
    if size == 0:
        values, tangents = function(at, jax.tree.map(lambda x: x[None], way))
        return values, jax.tree.map(lambda x: x[0], tangents)
    told: Any = None

    def mapped(leaves: Any, axes: Any) -> tuple[list, list]:
        nonlocal told
        if any(axis is not None for axis in axes[:n_at]):
            raise NotImplementedError(
                "jax.vmap around a derivative of lanes is for its directions: what has many values "
                "has them on the lanes' axis, the last."
            )
        pairs = zip(leaves[n_at:], axes[n_at:], strict=True)
        ways = [x[None] if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in pairs]
        values, tangents = function(*jax.tree.unflatten(structure, [*leaves[:n_at], *ways]))
        tangents = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape[1:])), tangents)
        found, told = jax.tree.flatten((values, tangents))
        n = len(jax.tree.leaves(values))
        return found, [None] * n + [0] * (len(found) - n)

    found = _BEYOND.bind(*leaves, mapped=mapped)
    return jax.tree.unflatten(told, found)


@custom_vmap
def _around(_: Any) -> Array:
    """As many zeros as there are directions of a `jax.vmap` around; none without one."""
    return jnp.zeros(0)


@_around.def_vmap
def _around_mapped(size: int, _: list, _way: Any) -> tuple[Array, bool]:
    return jnp.zeros(size), False


_BEYOND = Primitive("beyond")
"""What is traced outside of the `jax.vmap` around: within, its loops would be traced again."""
_BEYOND.multiple_results = True
batching.primitive_batchers[_BEYOND] = lambda values, axes, mapped: mapped(values, axes)


def _one_by_one(function: Callable[[Any], Any], ways: Any) -> Any:
    """`function` of each direction, in a loop: each lives in registers."""
    leaves, structure = jax.tree.flatten(ways)
    several = [len(x) > 1 for x in leaves]

    def of_one(some: list[Array]) -> Any:
        own = iter(some)
        pairs = zip(leaves, several, strict=True)
        return function(jax.tree.unflatten(structure, [next(own) if n else x[0] for x, n in pairs]))

    if not any(several):
        return jax.tree.map(lambda x: x[None], of_one([]))
    return lax.map(of_one, [x for x, n in zip(leaves, several, strict=True) if n])


def stacked(ways: Vector) -> Array:
    """Directions of several numbers, (directions, numbers, lanes)."""
    return jnp.stack(jnp.broadcast_arrays(*ways), 1)


class Slopes(NamedTuple):
    """Derivatives of the accelerations at the stages of a step."""

    by_state: Array  # (stages, n, ., lanes): by positions, rates, then what is held
    by_constants: Array  # (stages, directions, n, lanes)


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
        by_constants = lambda moved: along((constants, held), (moved, unmoved))
        return jnp.stack(by_state, 1), _side_by_side(by_constants, moved)

    return Slopes(*lax.map(at, jnp.stack([_packed(place) for place in stages[:-1]])))


def _side_by_side(function: Callable[[Any], Array], ways: Any) -> Array:
    """`function` of each direction, none in a loop: what is known of each is left out."""
    leaves, structure = jax.tree.flatten(ways)
    if all(len(x) == 1 for x in leaves):
        return function(jax.tree.unflatten(structure, [x[0] for x in leaves]))[None]
    axes = [0 if len(x) > 1 else None for x in leaves]
    given = [x if len(x) > 1 else x[0] for x in leaves]
    return jax.vmap(lambda *x: function(jax.tree.unflatten(structure, x)), axes)(*given)


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


@functools.partial(jax.jit, static_argnums=0)  # traced once, wherever it is called
def _carried(tableau: Tableau, slopes: Slopes, starts: Array, h: Array) -> Array:
    """Directions (positions, rates, what is held) at a step's start, carried to its end."""
    by_state, n = slopes.by_state, slopes.by_state.shape[1]

    def carried(way: tuple[Array, Array]) -> Array:
        by_constants, start = way
        q0, v0, held = tuple(start[:n]), tuple(start[n : 2 * n]), tuple(start[2 * n :])
        known: list[Vector] = []
        for i in range(len(tableau.places) - 1):
            q, v = stage_at(tableau, i, q0, v0, known, h) if i else (q0, v0)
            moved = (*q, *v, *held)
            rows = [[by_constants[i, d], *map(lax.mul, by_state[i, d], moved)] for d in range(n)]
            known.append(tuple(functools.reduce(lax.add, row) for row in rows))
        q, v = stage_at(tableau, len(tableau.places) - 1, q0, v0, known, h)
        return jnp.stack([*q, *v, *held])

    return _one_by_one(carried, (jnp.moveaxis(slopes.by_constants, 1, 0), starts))


def pushed(function: Callable[..., Any], at: tuple, directions: tuple) -> Any:
    """`jax.jvp` along each of the directions, without the value.

    The code is as short as for one.
    """
    return _one_by_one(lambda way: jax.jvp(function, at, way)[1], directions)


def by_directions(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of trees, whose derivative by their floats is `pushed`."""

    def call(*arguments: Any) -> Any:
        floats, others = eqx.partition(arguments, eqx.is_inexact_array)
        whole = lambda *floats: function(*eqx.combine(floats, others))
        only_floats = lambda *floats: eqx.filter(whole(*floats), eqx.is_inexact_array)
        called = jax.custom_jvp(whole)

        @called.defjvp
        def rule(at: tuple, direction: tuple) -> tuple:
            both = lambda at, ways: (whole(*at), pushed(only_floats, at, ways))
            out, moved = in_directions(both, at, direction)
            return out, eqx.combine(moved, without_derivative(out))

        return called(*floats)

    return call


class Moving(NamedTuple):
    """Directions in which a phase moves: its constants, its start and what it holds since then."""

    of: BalanceOf
    constants: Any
    held: Vector
    moved: Any  # like the constants, directions first
    start: Array  # positions, rates, what is held, (directions, ., lanes)

    def along(self, tableau: Tableau, stages: list[Place], starts: Array, h: Array) -> Array:
        """The directions at a step's start, carried to its end."""
        slopes = _slopes_of(self.of, self.constants, self.moved, self.held, stages)
        return _carried(tableau, slopes, starts, h)

    def onward(
        self, tableau: Tableau, stages: list[Place], starts: Array, h: Array, accepted: Array
    ) -> Array:
        """The same where the step is accepted; a group of which no lane goes on skips it."""

        def carried(starts: Array) -> Array:
            return jnp.where(accepted, self.along(tableau, stages, starts, h), starts)

        return if_any(jnp.any(accepted), carried, starts)

    def of_values(self, values: Callable[..., Any], place: Place, directions: Array) -> Any:
        """How `values(constants, held, q, v)` move with the directions there."""
        n, numbers = len(place.q), tuple(jnp.moveaxis(directions, 1, 0))
        at = self.constants, self.held, place.q, place.v
        return pushed(values, at, (self.moved, numbers[2 * n :], numbers[:n], numbers[n : 2 * n]))

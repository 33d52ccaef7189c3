"""Tangents of a phase's end with respect to its start and the constants of its equations, per
batch.

Each Runge-Kutta step is repeated for the linearized equations, for all requested directions. The
part shared by all directions, the Jacobians at the stages, is computed once, and each direction
then costs some hundred products. Step sizes and the tries of an event's search take no part. The
derivative is that of the discrete flow at the lengths that were taken, and of the time at which its
guard vanishes.

`jax.vmap` around a derivative supplies its directions. Here they are the first axis of arrays
instead: loops are traced once, not again for the vmap.
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
    """The equations of motion near a state whose accelerations are known."""

    residual: Callable[[Place], Vector]
    """Residual of the equations of motion: left side at the state's accelerations less the right
    side."""
    solve: Callable[[Place, Vector], Vector]
    """Accelerations for which the left side equals these rows."""


BalanceOf = Callable[[Any, Vector], Balance]
"""A function of the constants of the equations: a tree of arrays with few tangent directions, and
numbers with any tangent, like the start of a phase."""


def in_directions(
    function: Callable[[Any, Any], tuple[Any, Any]], at: Any, way: Any
) -> tuple[Any, Any]:
    """Return (values, tangents) of a JVP rule from a `function` that takes all directions together.

    `primals` and `tangents` are the arguments of the rule. `function` takes tangents with the axis
    of directions first, of length 1 where all directions agree, and returns tangents in the same
    form.
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
    """Return as many zeros as an enclosing `jax.vmap` has directions, none without one."""
    return jnp.zeros(0)


@_around.def_vmap
def _around_mapped(size: int, _: list, _way: Any) -> tuple[Array, bool]:
    return jnp.zeros(size), False


_BEYOND = Primitive("beyond")
"""What is traced outside of the `jax.vmap` around: within, its loops would be traced again."""
_BEYOND.multiple_results = True
batching.primitive_batchers[_BEYOND] = lambda values, axes, mapped: mapped(values, axes)
"""Primitive whose function is traced outside of the enclosing `jax.vmap`, which would trace its
loops again."""


def _one_by_one(function: Callable[[Any], Any], ways: Any) -> Any:
    """Return `function` of each direction, in a loop, so that each direction stays in registers."""
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
    """Return tangents of several numbers stacked as (directions, numbers, batch)."""
    return jnp.stack(jnp.broadcast_arrays(*ways), 1)


class Slopes(NamedTuple):
    """Jacobians of the accelerations at the stages of a step."""

    by_state: Array  # (stages, n, ., batch): by positions, rates, then held constants
    by_constants: Array  # (stages, directions, n, batch)


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
    """Return `function` of each direction without a loop, so that known zeros are dropped."""
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
    """Return the tangent of the accelerations along a direction of positions and rates."""
    sin, cos, acceleration = place.slope
    still = tuple(jnp.zeros_like(x) for x in acceleration)
    change = Place(dq, dv, Slope(cos * dq[0], -sin * dq[0], still))
    return tuple(_accelerated(balance, place, jax.jvp(balance.residual, (place,), (change,))[1]))


def _accelerated(balance: Balance, place: Place, rows: Vector) -> Array:
    return -jnp.stack(balance.solve(place, rows))


@functools.partial(jax.jit, static_argnums=0)  # traced once, wherever it is called
def _carried(tableau: Tableau, slopes: Slopes, starts: Array, h: Array) -> Array:
    """Propagate tangents (positions, rates, held constants) from a step's start to its end."""
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
    """Return `jax.jvp` along each of the directions, without the value.

    The code is as short as for one direction.
    """
    return _one_by_one(lambda way: jax.jvp(function, at, way)[1], directions)


def by_directions(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return `function` of trees, whose derivative with respect to their floats is `jvp_each`."""

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
    """Tangent directions of a phase: of its constants, its start and the constants held
    since then.
    """

    of: BalanceOf
    constants: Any
    held: Vector
    moved: Any  # structure of the constants, directions first
    start: Array  # of positions, rates, held constants, (directions, ., batch)

    def along(self, tableau: Tableau, stages: list[Place], starts: Array, h: Array) -> Array:
        """Return the tangents at a step's start, propagated to its end."""
        slopes = _slopes_of(self.of, self.constants, self.moved, self.held, stages)
        return _carried(tableau, slopes, starts, h)

    def onward(
        self, tableau: Tableau, stages: list[Place], starts: Array, h: Array, accepted: Array
    ) -> Array:
        """Return the tangents propagated where the step is accepted; otherwise they are unchanged.

        A group without accepted steps skips the computation.
        """

        def carried(starts: Array) -> Array:
            return jnp.where(accepted, self.along(tableau, stages, starts, h), starts)

        return if_any(jnp.any(accepted), carried, starts)

    def of_values(self, values: Callable[..., Any], place: Place, directions: Array) -> Any:
        """Return the tangents of `evaluate(constants, held_constants, q, v)` for the directions at
        a state.
        """
        n, numbers = len(place.q), tuple(jnp.moveaxis(directions, 1, 0))
        at = self.constants, self.held, place.q, place.v
        return pushed(values, at, (self.moved, numbers[2 * n :], numbers[:n], numbers[n : 2 * n]))

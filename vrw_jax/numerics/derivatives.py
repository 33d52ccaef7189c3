"""Derivatives of any order and in any mode of a function that only differentiates forwards.

Loops of unknown length (adaptive steps until an event) have no reverse mode. The rule here forms
the Jacobian forwards, over the inputs that are really perturbed, and returns Jacobian times
tangent: linear in the tangent, so `jax.grad` transposes a small matrix instead of a loop. The
Jacobian itself is wrapped again, so that Hessians work in every combination of modes.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from vrw_jax.numerics.lanes import LaneFunction, one_wheel

Forward = Callable[..., tuple[PyTree[Array], PyTree[Array]]]
"""Maps float arrays to (float outputs, other outputs that carry no derivative)."""


def any_mode(
    function: Forward,
    to_differentiate: Forward | None = None,
    jacobian_of: Callable[[tuple[int, ...]], Forward] | None = None,
) -> Forward:
    """`function` with derivatives in forward and reverse mode, to any order.

    `function(*arrays)` must take floating-point arrays only and be differentiable by `jax.jvp` to
    the order wanted. It must not close over values that are themselves differentiated. Where
    derivatives are asked for, `to_differentiate` (the same function computed more tightly, say)
    takes its place; `jacobian_of` may give (Jacobian by each of these arguments, value) and the
    other outputs in another way. Function and Jacobians are compiled once each: outside of `jit`,
    forward mode, reverse mode and single directions all call the same compiled Jacobian.
    """
    tighter = function if to_differentiate is None else to_differentiate
    compiled = jax.jit(function)
    wrapped = jax.custom_jvp(compiled)

    @functools.cache
    def differentiated(moved: tuple[int, ...]) -> Forward:
        forwards = _jacobian(tighter, moved)
        return any_mode(forwards) if jacobian_of is None else any_mode(jacobian_of(moved), forwards)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero))
        if not moved:
            told = wrapped(*primals)
            return told, without_derivative(told)
        (jacobian, out), other = differentiated(moved)(*primals)
        tangent = _pushed(out, jacobian, tuple(tangents[i] for i in moved))
        return (out, other), (tangent, without_derivative(other))

    wrapped.defjvp(rule, symbolic_zeros=True)

    def call(*arrays: Any) -> tuple:
        traced = any(isinstance(x, jax.core.Tracer) for x in arrays)
        return wrapped(*arrays) if traced else compiled(*arrays)  # a rule costs as much as a step

    return call


def _jacobian(function: Forward, moved: tuple[int, ...]) -> Forward:
    """Float outputs (Jacobian by moved argument, value) of `function`, in one evaluation."""

    def both(*arrays: Any) -> tuple[PyTree, PyTree]:
        out, other = function(*arrays)
        return out, (out, other)

    def jacobian(*arrays: Any) -> tuple[PyTree, PyTree]:
        parts, (out, other) = jax.jacfwd(both, argnums=moved, has_aux=True)(*arrays)
        by_argument = tuple(
            jax.tree.map(lambda _, part, k=k: part[k], out, parts) for k in range(len(moved))
        )
        return (by_argument, out), other

    return jacobian


@jax.jit
def _pushed(out: PyTree, by_argument: PyTree, tangents: tuple) -> PyTree:
    """Jacobians times tangents, leaf by leaf: as sums, since products of small arrays are calls."""

    def push(_: Array, *parts: Array) -> Array:
        pushed = [
            jnp.sum(part * tangent, axis=tuple(range(-jnp.ndim(tangent), 0)))
            for part, tangent in zip(parts, tangents, strict=True)
        ]
        return sum(pushed[1:], start=pushed[0])

    return jax.tree.map(push, out, *by_argument)


InForm = Callable[[LaneFunction, int], LaneFunction]
"""The form in which a function over lanes is computed, which is a derivative of this order."""


def on_branch(
    function: LaneFunction, tangents_of: Callable, in_form: InForm, order: int = 0
) -> Callable:
    """`function(p, z)` of one wheel, differentiable along z = z(p) to any order and in any mode.

    `function(p, z)` is over lanes; `tangents_of(p, z)` is dz/dp of one wheel with a leading axis
    over p, right wherever z = z(p), and made by this function too. The rule ignores the tangent of
    z, which can only be dz/dp times that of p, and returns the total derivative times that of p.
    """
    of_one_wheel = one_wheel(in_form(function, order))
    wrapped = jax.custom_jvp(lambda p, z: of_one_wheel(p, z))

    @wrapped.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple:
        slopes = slopes_on_branch(function, tangents_of, in_form, order + 1)(*primals)
        return wrapped(*primals), push(slopes, tangents[0])

    return wrapped


def slopes_on_branch(
    function: LaneFunction,
    tangents_of: Callable,
    in_form: InForm,
    order: int = 1,
    along: LaneFunction | None = None,
) -> Callable:
    """d function(p, z(p)) / dp with a leading axis over p, itself as `on_branch`.

    `along(p, (z, dz/dp))` may be a quicker way to it.
    """

    def in_turns(p: Array, known: tuple[PyTree, PyTree]) -> PyTree:
        """Over lanes, one direction after another: the code is as short as for one."""
        n, (z, dz) = p.shape[0], known
        units = jnp.broadcast_to(jnp.eye(n, dtype=p.dtype)[:, :, None], (n, *p.shape))
        return lax.map(lambda way: jax.jvp(function, (p, z), way)[1], (units, dz))

    def known_moves(p: Array, known: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        z, dz = known
        by_p = jax.jacfwd(tangents_of)(p, z)
        return dz, jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), by_p)

    slopes = on_branch(along or in_turns, known_moves, in_form, order)
    return lambda p, z: slopes(p, lax.stop_gradient((z, tangents_of(p, z))))


def with_jacobian(function: Callable, *arguments: Array) -> tuple[Any, Any]:
    """What `function` tells, and the derivatives of its floats on last axes, in one program.

    A leaf's derivatives are a tuple, one for each argument, where there are several.
    """

    def floats_of(*arguments: Array) -> tuple:
        floats, rest = eqx.partition(function(*arguments), eqx.is_inexact_array)
        return floats, (floats, rest)

    moved = tuple(range(len(arguments))) if len(arguments) > 1 else 0
    jacobian, (floats, rest) = jax.jacfwd(floats_of, moved, has_aux=True)(*arguments)
    return eqx.combine(floats, rest), jacobian


def push(jacobian: PyTree, tangent: Array) -> PyTree:
    """Jacobian (leading axis: inputs) times tangent, leaf by leaf."""
    return jax.tree.map(lambda part: jnp.tensordot(tangent, part, 1), jacobian)


def without_derivative(tree: PyTree) -> PyTree:
    """The zero tangent of any outputs."""
    zero = lambda x: (
        jnp.zeros_like(x)
        if jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        else np.zeros(jnp.shape(x), jax.dtypes.float0)
    )
    return jax.tree.map(zero, tree)

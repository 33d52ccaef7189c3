"""Derivatives of any order and mode of a function that supports only forward-mode AD.

Loops of unknown length (adaptive steps until an event) have no reverse mode. The rule here forms
the Jacobian in forward mode, over the inputs that are perturbed, and returns Jacobian times
tangent. This is linear in the tangent, so `jax.grad` transposes a small matrix instead of a loop.
The Jacobian itself is wrapped again, so Hessians work in every combination of modes.
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
"""A map from float arrays to (float outputs, other outputs without derivative)."""


def any_mode(
    function: Forward,
    to_differentiate: Forward | None = None,
    jacobian_of: Callable[[tuple[int, ...]], Forward] | None = None,
) -> Forward:
    """Return `function` with derivatives in forward and reverse mode, to any order.

    `function(*arrays)` must take only floating-point arrays, be differentiable by `jax.jvp` to the
    requested order, and not close over values that are themselves differentiated. For derivatives,
    `function_to_differentiate` replaces it, for example the same function with tighter tolerances.
    `make_jacobian` may return (Jacobian with respect to these arguments, value) and the other
    outputs in another way. Function and Jacobians are compiled once each: outside of `jit`, forward
    mode, reverse mode and single directions all call the same compiled Jacobian.
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
        return (
            wrapped(*arrays) if traced else compiled(*arrays)
        )  # the custom rule costs as much as a solver step

    return call


def _jacobian(function: Forward, moved: tuple[int, ...]) -> Forward:
    """Return a function with the float outputs (Jacobian by argument, value) in one evaluation."""

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
    """Return Jacobians times tangents, leaf by leaf.

    The products are sums, because products of small arrays are library calls.
    """

    def push(_: Array, *parts: Array) -> Array:
        pushed = [
            jnp.sum(part * tangent, axis=tuple(range(-jnp.ndim(tangent), 0)))
            for part, tangent in zip(parts, tangents, strict=True)
        ]
        return sum(pushed[1:], start=pushed[0])

    return jax.tree.map(push, out, *by_argument)


InForm = Callable[[LaneFunction, int], LaneFunction]
"""A wrapper that selects the execution of a batch function, given the order of the derivative it
is."""


def on_branch(
    function: LaneFunction, tangents_of: Callable, in_form: InForm, order: int = 0
) -> Callable:
    """Return `function(p, z)` of one wheel, differentiable along z = z(p) to any order and in any
    mode.

    `function(p, z)` acts on a batch. `tangents_of(p, z)` is dz/dp of one wheel with a leading axis
    over p, correct wherever z = z(p), and itself made by this function. The rule ignores the
    tangent of z, which can only be dz/dp times that of p, and returns the total derivative times
    the tangent of p.
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
    """Return d function(p, z(p)) / dp with a leading axis over p, differentiable as in
    `with_implicit_derivative`.

    `make_jacobian(p, (z, dz/dp))` may be a faster evaluation of it.
    """

    def in_turns(p: Array, known: tuple[PyTree, PyTree]) -> PyTree:
        """Return the derivatives over a batch, one direction after another, which keeps the code
        short.
        """
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
    """Return the outputs of `function`, and the derivatives of its floats on last axes, in one
    program.

    With several arguments, a leaf's derivatives are a tuple with one entry for each argument.
    """

    def floats_of(*arguments: Array) -> tuple:
        floats, rest = eqx.partition(function(*arguments), eqx.is_inexact_array)
        return floats, (floats, rest)

    moved = tuple(range(len(arguments))) if len(arguments) > 1 else 0
    jacobian, (floats, rest) = jax.jacfwd(floats_of, moved, has_aux=True)(*arguments)
    return eqx.combine(floats, rest), jacobian


def push(jacobian: PyTree, tangent: Array) -> PyTree:
    """Return the Jacobian (leading axis: inputs) times the tangent, leaf by leaf."""
    return jax.tree.map(lambda part: jnp.tensordot(tangent, part, 1), jacobian)


def without_derivative(tree: PyTree) -> PyTree:
    """Return the zero tangent of any outputs."""
    zero = lambda x: (
        jnp.zeros_like(x)
        if jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        else np.zeros(jnp.shape(x), jax.dtypes.float0)
    )
    return jax.tree.map(zero, tree)

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
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from vrw_jax.numerics.lanes import LaneFunction, in_blocks, one_wheel

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
    wrapped = jax.custom_jvp(jax.jit(function))

    @functools.cache
    def differentiated(moved: tuple[int, ...]) -> Forward:
        forwards = _jacobian(tighter, moved)
        return any_mode(forwards) if jacobian_of is None else any_mode(jacobian_of(moved), forwards)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero))
        if not moved:
            out, other = wrapped(*primals)
            return (out, other), (jax.tree.map(jnp.zeros_like, out), _no_tangent(other))
        (jacobian, out), other = differentiated(moved)(*primals)
        pushed = [_push(out, part, tangents[i]) for part, i in zip(jacobian, moved, strict=True)]
        tangent = jax.tree.map(lambda *parts: sum(parts[1:], start=parts[0]), *pushed)
        return (out, other), (tangent, _no_tangent(other))

    wrapped.defjvp(rule, symbolic_zeros=True)
    return wrapped


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


def _push(out: PyTree, jacobian: PyTree, tangent: Array) -> PyTree:
    """Jacobian times tangent, leaf by leaf: as sums, since products of small arrays are calls."""
    axes = tuple(range(-jnp.ndim(tangent), 0))
    return jax.tree.map(lambda _, part: jnp.sum(part * tangent, axis=axes), out, jacobian)


def _no_tangent(tree: PyTree) -> PyTree:
    """The tangent of integers and booleans."""
    return jax.tree.map(lambda x: np.zeros(jnp.shape(x), jax.dtypes.float0), tree)


def on_branch(function: LaneFunction, tangent_space: Callable, block: int) -> Callable:
    """`function(p, z)` of one wheel, differentiable along z = z(p) to any order and in any mode.

    `function(p, z)` and `tangent_space(p, z)` are over lanes; the latter is dz/dp with a leading
    axis over p, right wherever z = z(p). The rule ignores the tangent of z, which can only be
    dz/dp times that of p, and returns the total derivative times the tangent of p.
    """
    of_one_wheel = one_wheel(in_blocks(function, block))

    @jax.custom_jvp
    def wrapped(p: Array, z: PyTree) -> PyTree:
        return of_one_wheel(p, z)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        derivative = on_branch(total_derivative(function, tangent_space), tangent_space, block)
        return wrapped(*primals), push(derivative(*primals), tangents[0])

    wrapped.defjvp(rule)
    return wrapped


def total_derivative(function: LaneFunction, tangent_space: Callable) -> Callable:
    """d function(p, z(p)) / dp over lanes, with a leading axis over p."""

    def derivative(p: Array, z: PyTree) -> PyTree:
        n = p.shape[0]
        units = jnp.broadcast_to(jnp.eye(n, dtype=p.dtype)[:, :, None], (n, *p.shape))
        along = lambda dp, dz: jax.jvp(function, (p, z), (dp, dz))[1]
        return jax.vmap(along)(units, tangent_space(p, z))

    return derivative


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

"""Derivatives of any order and in any mode of a function that only differentiates forwards.

Loops of unknown length (adaptive steps until an event) have no reverse mode. The rule here forms
the Jacobian forwards, over the inputs that are really perturbed, and returns Jacobian times
tangent: linear in the tangent, so `jax.grad` transposes a small matrix instead of a loop. The
Jacobian itself is wrapped again, so that Hessians work in every combination of modes.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

Forward = Callable[..., tuple[PyTree[Array], PyTree[Array]]]
"""Maps float arrays to (float outputs, other outputs that carry no derivative)."""


def any_mode(function: Forward) -> Forward:
    """`function` with derivatives in forward and reverse mode, to any order.

    `function(*arrays)` must take floating-point arrays only and be differentiable by `jax.jvp` to
    the order wanted. It must not close over values that are themselves differentiated.
    """
    wrapped = jax.custom_jvp(function)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero))
        if not moved:
            out, other = wrapped(*primals)
            return (out, other), (jax.tree.map(jnp.zeros_like, out), _no_tangent(other))
        (jacobian, out), other = any_mode(_jacobian(function, moved))(*primals)
        pushed = [_push(out, part, tangents[i]) for part, i in zip(jacobian, moved, strict=True)]
        tangent = jax.tree.map(lambda *parts: sum(parts[1:], start=parts[0]), *pushed)
        return (out, other), (tangent, _no_tangent(other))

    wrapped.defjvp(rule, symbolic_zeros=True)
    return wrapped


def _jacobian(function: Forward, moved: tuple[int, ...]) -> Forward:
    """Float outputs (Jacobian by moved argument, value) of `function`, in one evaluation."""

    def both(*arrays: Array) -> tuple[PyTree, PyTree]:
        out, other = function(*arrays)
        return out, (out, other)

    def jacobian(*arrays: Array) -> tuple[PyTree, PyTree]:
        parts, (out, other) = jax.jacfwd(both, argnums=moved, has_aux=True)(*arrays)
        by_argument = tuple(
            jax.tree.map(lambda _, part, k=k: part[k], out, parts) for k in range(len(moved))
        )
        return (by_argument, out), other

    return jacobian


def _push(out: PyTree, jacobian: PyTree, tangent: Array) -> PyTree:
    """Jacobian times tangent, leaf by leaf."""
    return jax.tree.map(
        lambda _, part: jnp.tensordot(part, tangent, jnp.ndim(tangent)), out, jacobian
    )


def _no_tangent(tree: PyTree) -> PyTree:
    """The tangent of integers and booleans."""
    return jax.tree.map(lambda x: np.zeros(jnp.shape(x), jax.dtypes.float0), tree)

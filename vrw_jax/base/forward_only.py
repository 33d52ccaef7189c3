"""Error message for reverse-mode differentiation of a loop of unknown length."""

from typing import Any

import equinox as eqx
import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from vrw_jax.lanes.code_cache import targets_machine_code

_FORWARD_ONLY_PRIMITIVE = Primitive("forward_only")
"""Identity operation whose transpose raises an error."""


def _raise_reverse_mode_error(_cotangent: Any, _value: Any, *, function_name: str) -> None:
    """Raise a ValueError that explains why reverse mode is not available."""
    raise ValueError(
        f"hybrid.{function_name} has no derivative in reverse mode, since the number of its solver "
        "steps is not known beforehand: use forward mode, jax.jacfwd or jax.jvp, instead of "
        "jax.grad, jax.jacrev or jax.vjp."
    )


_FORWARD_ONLY_PRIMITIVE.def_impl(lambda x, *, function_name: x)
_FORWARD_ONLY_PRIMITIVE.def_abstract_eval(lambda x, *, function_name: x)
ad.deflinear2(_FORWARD_ONLY_PRIMITIVE, _raise_reverse_mode_error)
batching.defvectorized(_FORWARD_ONLY_PRIMITIVE)
mlir.register_lowering(_FORWARD_ONLY_PRIMITIVE, lambda _context, x, *, function_name: [x])


def forbid_reverse_mode(function_name: str, function_result: PyTree) -> PyTree:
    """Return `function_result` unchanged, marked so that reverse-mode differentiation raises an
    error.

    `function_name` is the function in `flow` that computed the result. Inside `lanes.jit` there is
    no mark, because reverse mode transposes the derivatives that machine code computes.
    """
    if targets_machine_code():
        return function_result

    def mark_leaf_as_forward_only(leaf: Any) -> Any:
        if isinstance(leaf, jax.core.Tracer) and eqx.is_inexact_array(leaf):
            return _FORWARD_ONLY_PRIMITIVE.bind(leaf, function_name=function_name)
        return leaf

    return jax.tree.map(mark_leaf_as_forward_only, function_result)

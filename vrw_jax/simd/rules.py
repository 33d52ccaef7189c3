"""The table PRIMITIVE_RULES, which lowers traces; a new primitive is one more row."""

import math
from collections.abc import Callable
from typing import Any

from vrw_jax.simd import loops, movement, sums
from vrw_jax.simd.arithmetic import ELEMENTWISE
from vrw_jax.simd.arrays import Asked, has_lanes, moved, number_of, taken_for_lanes
from vrw_jax.simd.fields import Entries, Field
from vrw_jax.simd.trace import CALLS, Rule, Traces, called


def _single(write: Callable[..., Entries]) -> Rule:
    """Return a rule with one result: `emit(emitter, call, *values)`."""

    def rule(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
        name, out = equation.primitive.name, equation.outvars[0].aval
        given = [atom.aval for atom in equation.invars]
        lanes, before = has_lanes(out), any(map(has_lanes, given))
        if before and not lanes and name not in ("reduce_and", "reduce_or"):
            raise moved(name)
        if lanes and not before and name not in ("broadcast_in_dim", "empty"):
            raise taken_for_lanes(f"The result of {name}", out)
        number_of(out)  # raises an error for unsupported number types
        result = write(traces.arrays, Asked(name, equation.params, given, out), *values)
        if isinstance(result, Field) and math.prod(result.shape) <= traces.arrays.small:
            result = traces.arrays.entries(result)
        return [result]

    rule.__doc__ = write.__doc__
    return rule


def _mapped(arrays: Any, asked: Asked, *values: Entries) -> Entries:
    """Apply the primitive to each number separately."""
    return arrays.mapped(asked, values)


def _stored(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
    """Compute large arrays here, into memory."""
    return [traces.arrays.in_memory(x) if isinstance(x, Field) else x for x in values]


RULES: dict[str, Rule] = {
    **{name: _single(_mapped) for name in ELEMENTWISE},
    "broadcast_in_dim": _single(movement.broadcast_in_dim),
    "concatenate": _single(movement.concatenate),
    "dynamic_slice": _single(movement.dynamic_slice),
    "dynamic_update_slice": _single(movement.dynamic_update_slice),
    "empty": _single(movement.empty),
    "expand_dims": _single(movement.reshape),
    "iota": _single(movement.iota),
    "pad": _single(movement.pad),
    "reshape": _single(movement.reshape),
    "slice": _single(movement.slice_),
    "squeeze": _single(movement.reshape),
    "stack": _single(movement.stack),
    "unstack": movement.unstack,
    "transpose": _single(movement.transpose),
    "cumsum": _single(sums.cumsum),
    "dot_general": _single(sums.dot_general),
    "reduce_and": _single(sums.reduction("and")),
    "reduce_max": _single(sums.reduction("max")),
    "reduce_min": _single(sums.reduction("min")),
    "reduce_or": _single(sums.reduction("or")),
    "reduce_sum": _single(sums.reduction("add")),
    **{name: called(parameter) for name, parameter in CALLS.items()},
    "optimization_barrier": _stored,
    "scan": loops.scan,
    "while": loops.while_,
}


def primitives() -> dict[str, str]:
    """Return the JAX primitives that have machine code, and descriptions of their rules."""
    return {name: rule.__doc__ or "" for name, rule in RULES.items()}

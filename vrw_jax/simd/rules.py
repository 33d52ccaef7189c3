"""The table `PRIMITIVE_RULES`, which contains the lowering rule of each JAX primitive. A new
primitive needs one more entry.
"""

import math
from collections.abc import Callable
from typing import Any

from vrw_jax.simd import data_movement as movement
from vrw_jax.simd import loops
from vrw_jax.simd import reductions as sums
from vrw_jax.simd.arithmetic import ELEMENTWISE_RULES
from vrw_jax.simd.array_emitter import (
    PrimitiveCall,
    has_lanes,
    lane_axis_error,
    lane_mixing_error,
    number_type,
)
from vrw_jax.simd.lazy_arrays import ArrayValue, LazyArray
from vrw_jax.simd.lowering import JAXPR_PARAMETERS, JaxprLowering, PrimitiveRule, call_rule


def _single_result_rule(emit: Callable[..., ArrayValue]) -> PrimitiveRule:
    """Return a rule of a primitive with one result from a function `emit(emitter, call,
    *values)`.
    """

    def emit_result(
        lowering: JaxprLowering, equation: Any, values: list[ArrayValue]
    ) -> list[ArrayValue]:
        name, out_aval = equation.primitive.name, equation.outvars[0].aval
        in_avals = [atom.aval for atom in equation.invars]
        result_has_lanes, operand_has_lanes = has_lanes(out_aval), any(map(has_lanes, in_avals))
        if operand_has_lanes and not result_has_lanes and name not in ("reduce_and", "reduce_or"):
            raise lane_mixing_error(name)
        if result_has_lanes and not operand_has_lanes and name not in ("broadcast_in_dim", "empty"):
            raise lane_axis_error(f"The result of {name}", out_aval)
        number_type(out_aval)  # This call raises an error for unsupported number types.
        result = emit(
            lowering.emitter, PrimitiveCall(name, equation.params, in_avals, out_aval), *values
        )
        if (
            isinstance(result, LazyArray)
            and math.prod(result.shape) <= lowering.emitter.limits.max_unrolled
        ):
            result = lowering.emitter.get_entries(result)
        return [result]

    emit_result.__doc__ = emit.__doc__
    return emit_result


def _emit_elementwise_call(emitter: Any, call: PrimitiveCall, *values: ArrayValue) -> ArrayValue:
    """Return the primitive applied to each entry."""
    return emitter.emit_elementwise(call, values)


def _emit_barrier(
    lowering: JaxprLowering, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Return the arrays, of which large lazy ones are computed and stored in memory at this
    point.
    """
    return [lowering.emitter.materialize(x) if isinstance(x, LazyArray) else x for x in values]


PRIMITIVE_RULES: dict[str, PrimitiveRule] = {
    **{name: _single_result_rule(_emit_elementwise_call) for name in ELEMENTWISE_RULES},
    "broadcast_in_dim": _single_result_rule(movement.emit_broadcast),
    "concatenate": _single_result_rule(movement.emit_concatenate),
    "dynamic_slice": _single_result_rule(movement.emit_dynamic_slice),
    "dynamic_update_slice": _single_result_rule(movement.emit_dynamic_update),
    "empty": _single_result_rule(movement.emit_empty),
    "expand_dims": _single_result_rule(movement.emit_reshape),
    "iota": _single_result_rule(movement.emit_iota),
    "pad": _single_result_rule(movement.emit_pad),
    "reshape": _single_result_rule(movement.emit_reshape),
    "slice": _single_result_rule(movement.emit_slice),
    "squeeze": _single_result_rule(movement.emit_reshape),
    "stack": _single_result_rule(movement.emit_stack),
    "unstack": movement.emit_unstack,
    "transpose": _single_result_rule(movement.emit_transpose),
    "cumsum": _single_result_rule(sums.emit_cumsum),
    "dot_general": _single_result_rule(sums.emit_dot_general),
    "reduce_and": _single_result_rule(sums.reduction_rule("and")),
    "reduce_max": _single_result_rule(sums.reduction_rule("max")),
    "reduce_min": _single_result_rule(sums.reduction_rule("min")),
    "reduce_or": _single_result_rule(sums.reduction_rule("or")),
    "reduce_sum": _single_result_rule(sums.reduction_rule("add")),
    **{name: call_rule(parameter) for name, parameter in JAXPR_PARAMETERS.items()},
    "optimization_barrier": _emit_barrier,
    "scan": loops.emit_scan,
    "while": loops.emit_while,
}


def list_primitives() -> dict[str, str]:
    """Return, for each JAX primitive that has machine code, the first paragraph of its rule's
    docstring.
    """
    first_paragraph = lambda text: " ".join(text.partition("\n\n")[0].split())
    return {name: first_paragraph(rule.__doc__ or "") for name, rule in PRIMITIVE_RULES.items()}

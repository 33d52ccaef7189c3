"""Table `PRIMITIVE_RULES` of the rules that lower JAX primitives. A new primitive needs one more
entry.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from vrw_jax.lanes import data_movement, loops, reductions
from vrw_jax.lanes.arithmetic import ELEMENTWISE_RULES
from vrw_jax.lanes.array_emitter import (
    ArrayEmitter,
    PrimitiveCall,
    get_llvm_number_type,
    has_lane_axis,
    make_lane_axis_error,
    make_lane_mixing_error,
)
from vrw_jax.lanes.lazy_arrays import LazyArray, LlvmArray
from vrw_jax.lanes.lowering import (
    CALLED_JAXPR_PARAMETERS,
    JaxprLowering,
    PrimitiveRule,
    emit_called_jaxpr,
)


def _emit_single_result(
    single_result_rule: Callable[..., LlvmArray],
    jaxpr_lowering: JaxprLowering,
    equation: Any,
    operands: list[LlvmArray],
) -> list[LlvmArray]:
    """Return the result of a primitive with one result, after checks of the lane axes.

    - `single_result_rule`: function of an `ArrayEmitter`, a `PrimitiveCall` and the operands that
      returns the result.
    """
    primitive_name, result_aval = equation.primitive.name, equation.outvars[0].aval
    operand_avals = [input_atom.aval for input_atom in equation.invars]
    result_has_lanes = has_lane_axis(result_aval)
    operand_has_lanes = any(map(has_lane_axis, operand_avals))
    if (
        operand_has_lanes
        and not result_has_lanes
        and primitive_name not in ("reduce_and", "reduce_or")
    ):
        raise make_lane_mixing_error(primitive_name)
    if (
        result_has_lanes
        and not operand_has_lanes
        and primitive_name not in ("broadcast_in_dim", "empty")
    ):
        raise make_lane_axis_error(f"The result of {primitive_name}", result_aval)
    get_llvm_number_type(result_aval)  # This call raises an error for unsupported number types.
    array_emitter = jaxpr_lowering.array_emitter
    result_array = single_result_rule(
        array_emitter,
        PrimitiveCall(primitive_name, equation.params, operand_avals, result_aval),
        *operands,
    )
    if (
        isinstance(result_array, LazyArray)
        and math.prod(result_array.shape) <= array_emitter.max_unrolled_entries
    ):
        result_array = array_emitter.get_array_entries(result_array)
    return [result_array]


SINGLE_RESULT_RULES: dict[str, Callable[..., LlvmArray]] = {
    **dict.fromkeys(ELEMENTWISE_RULES, ArrayEmitter.emit_elementwise_array),
    "broadcast_in_dim": data_movement.emit_broadcast_array,
    "concatenate": data_movement.emit_concatenated_array,
    "dynamic_slice": data_movement.emit_dynamic_slice,
    "dynamic_update_slice": data_movement.emit_dynamic_slice_update,
    "empty": data_movement.emit_uninitialized_array,
    "expand_dims": data_movement.emit_reshaped_array,
    "iota": data_movement.emit_index_array,
    "pad": data_movement.emit_padded_array,
    "reshape": data_movement.emit_reshaped_array,
    "slice": data_movement.emit_static_slice,
    "squeeze": data_movement.emit_reshaped_array,
    "stack": data_movement.emit_stacked_array,
    "transpose": data_movement.emit_transposed_array,
    "cumsum": reductions.emit_cumulative_sum,
    "dot_general": reductions.emit_array_product,
    **dict.fromkeys(reductions.COMBINING_PRIMITIVE_BY_REDUCTION, reductions.emit_reduced_array),
}
"""Rules of primitives with one result, by the name of the primitive."""

PRIMITIVE_RULES: dict[str, PrimitiveRule] = {
    **{name: partial(_emit_single_result, rule) for name, rule in SINGLE_RESULT_RULES.items()},
    **dict.fromkeys(CALLED_JAXPR_PARAMETERS, emit_called_jaxpr),
    "optimization_barrier": data_movement.emit_optimization_barrier,
    "scan": loops.emit_scan_loop,
    "split": data_movement.emit_split_arrays,
    "unstack": data_movement.emit_unstacked_arrays,
    "while": loops.emit_while_loop,
}


def describe_supported_primitives() -> dict[str, str]:
    """Return descriptions of the rules by the name of the JAX primitive, for all supported
    primitives.

    A description is the first paragraph of the rule's docstring.
    """
    get_first_paragraph = lambda docstring: " ".join(docstring.partition("\n\n")[0].split())
    return {
        primitive_name: get_first_paragraph(primitive_rule.__doc__ or "")
        for primitive_name, primitive_rule in (PRIMITIVE_RULES | SINGLE_RESULT_RULES).items()
    }

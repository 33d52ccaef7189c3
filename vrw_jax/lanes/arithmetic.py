"""Rules that emit LLVM instructions for elementwise JAX primitives, in the table
`ELEMENTWISE_RULES`.

A rule takes an `ElementwiseOperation` and the LLVM values of its operands. It returns the LLVM
value of the result.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.value_emitter import (
    LLVM_COMPARISONS,
    LLVM_NUMBER_TYPES,
    LlvmValue,
    TextBuilder,
    ValueEmitter,
)

FUSED_MULTIPLY_ADD_FLAGS = ("contract",)
"""LLVM's fast-math flag that lets the processor round a product and a following sum once instead of
twice.

The flag allows no reordering of operations.
"""
RECIPROCAL_DIVISION_FLAGS = (*FUSED_MULTIPLY_ADD_FLAGS, "arcp")
"""LLVM's fast-math flags that let the inverse of a repeated divisor be computed once.

The flags apply only to float64, because processors approximate the inverse in float32.
"""

ElementwiseRule = Callable[..., LlvmValue]


class ElementwiseOperation(NamedTuple):
    """JAX primitive that acts on each number, and the emitter of its LLVM instructions."""

    value_emitter: ValueEmitter
    primitive_params: Any
    operand_dtype: Any  # dtype of the first operand
    result_dtype: Any

    @property
    def llvm_builder(self) -> TextBuilder:
        """Return the builder that appends LLVM instructions."""
        return self.value_emitter.llvm_builder


def emit_llvm_elementwise_primitive(
    value_emitter: ValueEmitter,
    primitive_name: str,
    primitive_params: Any,
    operand_dtype: Any,
    result_dtype: Any,
    operands: Sequence[LlvmValue],
) -> LlvmValue:
    """Emit the JAX primitive `primitive_name` for LLVM operands of type `operand_dtype`.

    Return the LLVM value of the result, which has the type `result_dtype`. A repeated call with
    equal operands returns the first value and emits no instructions.
    """
    instruction_key = (
        primitive_name,
        result_dtype.num,
        primitive_params.get("y"),
        *map(id, operands),
    )
    emit_primitive = ELEMENTWISE_RULES[primitive_name]
    return value_emitter.emit_value_once(
        instruction_key,
        lambda: emit_primitive(
            ElementwiseOperation(value_emitter, primitive_params, operand_dtype, result_dtype),
            *operands,
        ),
    )


# The rules of sums and products drop terms known to be zero and factors known to be one.


def emit_sum(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the sum x + y and return its LLVM value. A constant operand 0 needs no instruction."""
    if _equals_llvm_constant(y, 0):
        return x
    if _equals_llvm_constant(x, 0):
        return y
    return _emit_binary_instruction("add", operation, x, y)


def emit_difference(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the difference x - y and return its LLVM value. A constant y = 0 needs no
    instruction.
    """
    if _equals_llvm_constant(y, 0):
        return x
    return _emit_binary_instruction("sub", operation, x, y)


def emit_product(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the product x * y and return its LLVM value. A constant factor 0 or 1 needs no
    instruction.
    """
    if _equals_llvm_constant(y, 1) or _equals_llvm_constant(x, 0):
        return x
    if _equals_llvm_constant(x, 1) or _equals_llvm_constant(y, 0):
        return y
    return _emit_binary_instruction("mul", operation, x, y)


def emit_quotient(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the quotient x / y of two floats and return its LLVM value."""
    # An integer division by zero would stop the process.
    _require_float_dtype("div", operation)
    if _equals_llvm_constant(y, 1):
        return x
    has_float64 = operation.operand_dtype == np.float64
    flags = RECIPROCAL_DIVISION_FLAGS if has_float64 else FUSED_MULTIPLY_ADD_FLAGS
    operands = operation.value_emitter.to_scalars_or_vectors(x, y)
    return operation.llvm_builder.emit_binary(f"fdiv {' '.join(flags)}", *operands)


def emit_integer_power(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the power of `x` with a constant integer exponent by repeated squaring, and return its
    LLVM value.
    """
    exponent = operation.primitive_params["y"]
    one_constant = operation.value_emitter.make_llvm_constant(x.type, 1)
    partial_power, repeated_square = one_constant, x
    for i, exponent_bit in enumerate(reversed(f"{abs(exponent):b}")):
        if i:
            repeated_square = emit_product(operation, repeated_square, repeated_square)
        if exponent_bit == "1":
            partial_power = emit_product(operation, partial_power, repeated_square)
    if exponent >= 0:
        return partial_power
    return operation.llvm_builder.fdiv(one_constant, partial_power, flags=FUSED_MULTIPLY_ADD_FLAGS)


def emit_negative(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit -x and return its LLVM value."""
    llvm_builder = operation.llvm_builder
    return (llvm_builder.fneg if operation.operand_dtype.kind == "f" else llvm_builder.neg)(x)


def emit_absolute_value(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the absolute value of `x` and return its LLVM value."""
    if operation.operand_dtype.kind == "f":
        return _emit_intrinsic_call(operation, "fabs", x)
    zero_constant = operation.value_emitter.make_llvm_constant(x.type, 0)
    is_negative_value = emit_comparison("<", operation, x, zero_constant)
    return operation.llvm_builder.select(is_negative_value, operation.llvm_builder.neg(x), x)


def _return_operand(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Return the operand unchanged."""
    return x


def emit_bitwise_operation(
    opcode: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit a bitwise instruction with two operands, and return its LLVM value."""
    return operation.llvm_builder.emit_binary(
        opcode, *operation.value_emitter.to_scalars_or_vectors(x, y)
    )


def emit_comparison(
    comparison_operator: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the comparison of two operands, and return the LLVM truth value.

    `comparison_operator` is an operator such as "<".
    """
    number_kind, relation = operation.operand_dtype.kind, LLVM_COMPARISONS[comparison_operator]
    if number_kind == "f":  # NaN differs from every number.
        opcode = f"fcmp {'u' if relation == 'ne' else 'o'}{relation}"
    elif relation in ("eq", "ne"):
        opcode = f"icmp {relation}"
    else:  # The signed value of true would be -1.
        opcode = f"icmp {'u' if number_kind == 'b' else 's'}{relation}"
    operands = operation.value_emitter.to_scalars_or_vectors(x, y)
    return operation.llvm_builder.emit_comparison(opcode, *operands)


def emit_extremum(
    comparison_operator: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the maximum (operator ">") or the minimum ("<") of two operands, and return its LLVM
    value.
    """
    x, y = operation.value_emitter.to_scalars_or_vectors(x, y)
    llvm_builder = operation.llvm_builder
    extremum = llvm_builder.select(emit_comparison(comparison_operator, operation, x, y), x, y)
    if operation.operand_dtype.kind != "f":
        return extremum
    # The result is NaN if either operand is NaN.
    return llvm_builder.select(llvm_builder.emit_comparison("fcmp uno", x, x), x, extremum)


def emit_select(
    operation: ElementwiseOperation, lane_condition: LlvmValue, *case_values: LlvmValue
) -> LlvmValue:
    """Emit the selection of the first case where the condition is false, and of the second where it
    is true.

    Return the LLVM value that contains the selected case of each lane.
    """
    if (
        all(_equals_llvm_constant(case_value, 0) for case_value in case_values)
        or case_values[0] is case_values[1]
    ):
        return case_values[0]
    value_emitter = operation.value_emitter
    if isinstance(lane_condition.type, ir.VectorType):
        case_values = tuple(map(value_emitter.to_lane_vector, case_values))
    false_case, true_case = value_emitter.to_scalars_or_vectors(*case_values)
    return operation.llvm_builder.select(lane_condition, true_case, false_case)


def emit_finiteness_test(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the test whether |x| < infinity, and return its LLVM truth value."""
    infinity = operation.value_emitter.make_llvm_constant(x.type, np.inf)
    return emit_comparison("<", operation, _emit_intrinsic_call(operation, "fabs", x), infinity)


def emit_float_function(
    intrinsic_function_name: str, operation: ElementwiseOperation, x: LlvmValue
) -> LlvmValue:
    """Emit a function of a float, such as "sqrt", and return its LLVM value.

    The function is one of LLVM's intrinsic functions.
    """
    _require_float_dtype(intrinsic_function_name, operation)
    return _emit_intrinsic_call(operation, intrinsic_function_name, x)


def _require_float_dtype(primitive_name: str, operation: ElementwiseOperation) -> None:
    """Raise a NotImplementedError unless the operand's type is a float type."""
    if operation.operand_dtype.kind != "f":
        raise NotImplementedError(
            f"{primitive_name} of {operation.operand_dtype} has no machine code: convert to floats."
        )


def _emit_binary_instruction(
    integer_opcode: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit an instruction with two operands and return its LLVM value.

    The opcode for integers is `integer_opcode`, such as "add". The opcode for floats is "fadd".
    """
    is_float = operation.operand_dtype.kind == "f"
    llvm_opcode = (
        f"f{integer_opcode} {' '.join(FUSED_MULTIPLY_ADD_FLAGS)}" if is_float else integer_opcode
    )
    return operation.llvm_builder.emit_binary(
        llvm_opcode, *operation.value_emitter.to_scalars_or_vectors(x, y)
    )


def emit_bits(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the number of the result's type that has the same bits, and return its LLVM value."""
    if operation.operand_dtype.itemsize != operation.result_dtype.itemsize:
        raise NotImplementedError(
            f"the bits of {operation.operand_dtype} as {operation.result_dtype} have no machine "
            "code: take types of the same size."
        )
    llvm_type = LLVM_NUMBER_TYPES[operation.result_dtype.name]
    if isinstance(x.type, ir.VectorType):
        llvm_type = operation.value_emitter.make_vector_type(llvm_type)
    return operation.llvm_builder.bitcast(x, llvm_type)


def emit_conversion(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the conversion of `x` to the type of the result, and return its LLVM value."""
    value_emitter, operand_dtype, result_dtype = (
        operation.value_emitter,
        operation.operand_dtype,
        operation.result_dtype,
    )
    if operand_dtype == result_dtype:
        return x
    if result_dtype.kind == "b":
        return emit_comparison("!=", operation, x, value_emitter.make_llvm_constant(x.type, 0))
    is_result_smaller = result_dtype.itemsize < operand_dtype.itemsize
    builder_method_name = {
        "ff": "fptrunc" if is_result_smaller else "fpext",
        "bf": "uitofp",
        "if": "sitofp",
        "fi": "fptosi",
        "bi": "zext",
        "ii": "trunc" if is_result_smaller else "sext",
    }[operand_dtype.kind + result_dtype.kind]
    result_llvm_type = LLVM_NUMBER_TYPES[result_dtype.name]
    if isinstance(x.type, ir.VectorType):
        result_llvm_type = value_emitter.make_vector_type(result_llvm_type)
    return getattr(operation.llvm_builder, builder_method_name)(x, result_llvm_type)


def _emit_intrinsic_call(
    operation: ElementwiseOperation, intrinsic_function_name: str, operand: LlvmValue
) -> LlvmValue:
    """Emit a call of an LLVM intrinsic function, such as "sqrt", and return its LLVM value.

    The called variant of the function is the one for the operand's type.
    """
    llvm_type = operand.type
    is_vector = isinstance(llvm_type, ir.VectorType)
    llvm_element_type = llvm_type.element if is_vector else llvm_type
    n_type_bits = 64 if llvm_element_type == LLVM_NUMBER_TYPES["float64"] else 32
    intrinsic_name = (
        f"llvm.{intrinsic_function_name}.{f'v{llvm_type.count}' if is_vector else ''}f{n_type_bits}"
    )
    llvm_module = operation.llvm_builder.module
    if intrinsic_name not in llvm_module.globals:
        ir.Function(llvm_module, ir.FunctionType(llvm_type, [llvm_type]), intrinsic_name)
    text = f"call {llvm_type} @{intrinsic_name}({llvm_type} {operand.get_reference()})"
    return operation.llvm_builder.emit(llvm_type, text)


def _equals_llvm_constant(llvm_value: LlvmValue, expected_number: int) -> bool:
    """Return whether an LLVM value is a constant that equals `expected_number` in every lane."""
    if not isinstance(llvm_value, ir.Constant):
        return False
    constant_content = llvm_value.constant
    if isinstance(constant_content, (list, tuple)):
        return all(_equals_llvm_constant(entry, expected_number) for entry in constant_content)
    return isinstance(constant_content, (int, float)) and constant_content == expected_number


ELEMENTWISE_RULES: dict[str, ElementwiseRule] = {
    "abs": emit_absolute_value,
    "add": emit_sum,
    "add_any": emit_sum,
    "and": partial(emit_bitwise_operation, "and"),
    "bitcast_convert_type": emit_bits,
    "convert_element_type": emit_conversion,
    "copy": _return_operand,
    "div": emit_quotient,
    "eq": partial(emit_comparison, "=="),
    "ge": partial(emit_comparison, ">="),
    "gt": partial(emit_comparison, ">"),
    "integer_pow": emit_integer_power,
    "is_finite": emit_finiteness_test,
    "le": partial(emit_comparison, "<="),
    "lt": partial(emit_comparison, "<"),
    "max": partial(emit_extremum, ">"),
    "min": partial(emit_extremum, "<"),
    "mul": emit_product,
    "ne": partial(emit_comparison, "!="),
    "neg": emit_negative,
    "not": lambda operation, x: operation.llvm_builder.not_(x),
    "or": partial(emit_bitwise_operation, "or"),
    "select_n": emit_select,
    "shift_left": partial(emit_bitwise_operation, "shl"),
    "shift_right_arithmetic": partial(emit_bitwise_operation, "ashr"),
    "shift_right_logical": partial(emit_bitwise_operation, "lshr"),
    "square": lambda operation, x: _emit_binary_instruction("mul", operation, x, x),
    "stop_gradient": _return_operand,
    "sub": emit_difference,
    "xor": partial(emit_bitwise_operation, "xor"),
    **{
        name: partial(emit_float_function, name)
        for name in ("cos", "exp", "floor", "log", "sin", "sqrt")
    },
}

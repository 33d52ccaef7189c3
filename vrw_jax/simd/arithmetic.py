"""Rules that emit LLVM instructions for elementwise JAX primitives, in the table
`ELEMENTWISE_RULES`.

A rule takes an `ElementwiseOperation` and the LLVM values of its operands. It returns the LLVM
value of the result.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import I32, LLVM_NUMBER_TYPES, LlvmValue, ValueEmitter

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


def _emit_llvm_sum(
    elementwise_operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the sum x + y and return its LLVM value. A constant operand 0 needs no instruction."""
    if _equals_llvm_constant(y, 0):
        return x
    return (
        y
        if _equals_llvm_constant(x, 0)
        else _emit_binary_instruction(elementwise_operation, ("fadd", "add"), x, y)
    )


def _emit_llvm_product(
    elementwise_operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the product x * y and return its LLVM value. A constant factor 0 or 1 needs no
    instruction.
    """
    if _equals_llvm_constant(y, 1) or _equals_llvm_constant(x, 0):
        return x
    return (
        y
        if _equals_llvm_constant(x, 1) or _equals_llvm_constant(y, 0)
        else _emit_binary_instruction(elementwise_operation, ("fmul", "mul"), x, y)
    )


def _emit_llvm_quotient(
    elementwise_operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the quotient x / y of two floats and return its LLVM value."""
    # An integer division by zero would stop the process.
    _require_float_dtype("div", elementwise_operation.operand_dtype)
    if _equals_llvm_constant(y, 1):
        return x
    x, y = elementwise_operation.value_emitter.to_scalars_or_vectors(x, y)
    return elementwise_operation.value_emitter.llvm_builder.fdiv(
        x,
        y,
        flags=RECIPROCAL_DIVISION_FLAGS
        if elementwise_operation.operand_dtype == np.float64
        else FUSED_MULTIPLY_ADD_FLAGS,
    )


def _emit_llvm_integer_power(
    elementwise_operation: ElementwiseOperation, x: LlvmValue
) -> LlvmValue:
    """Emit the power of `x` with a constant integer exponent by repeated squaring, and return its
    LLVM value.
    """
    emit_product = lambda x, y: _emit_binary_instruction(
        elementwise_operation, ("fmul", "mul"), x, y
    )
    partial_power, repeated_square, remaining_exponent = (
        None,
        x,
        abs(elementwise_operation.primitive_params["y"]),
    )
    while remaining_exponent:
        if remaining_exponent & 1:
            partial_power = (
                repeated_square
                if partial_power is None
                else emit_product(partial_power, repeated_square)
            )
        remaining_exponent >>= 1
        repeated_square = (
            emit_product(repeated_square, repeated_square)
            if remaining_exponent
            else repeated_square
        )
    one_constant = elementwise_operation.value_emitter.make_llvm_constant(x.type, 1)
    partial_power = one_constant if partial_power is None else partial_power
    return (
        elementwise_operation.value_emitter.llvm_builder.fdiv(
            one_constant, partial_power, flags=FUSED_MULTIPLY_ADD_FLAGS
        )
        if elementwise_operation.primitive_params["y"] < 0
        else partial_power
    )


def _emit_llvm_absolute_value(
    elementwise_operation: ElementwiseOperation, x: LlvmValue
) -> LlvmValue:
    """Emit the absolute value of `x` and return its LLVM value."""
    if elementwise_operation.operand_dtype.kind == "f":
        return _emit_llvm_intrinsic_call(elementwise_operation.value_emitter, "fabs", x)
    is_negative_value = _emit_llvm_comparison(
        elementwise_operation.value_emitter,
        "<",
        elementwise_operation.operand_dtype,
        x,
        elementwise_operation.value_emitter.make_llvm_constant(x.type, 0),
    )
    return elementwise_operation.value_emitter.llvm_builder.select(
        is_negative_value, elementwise_operation.value_emitter.llvm_builder.neg(x), x
    )


def _return_operand(elementwise_operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Return the operand unchanged."""
    return x


def _make_bitwise_rule(builder_method_name: str) -> ElementwiseRule:
    """Return an elementwise rule that emits a bitwise instruction.

    - `builder_method_name`: name of the method of llvmlite's `IRBuilder` that emits the
      instruction.
    """

    def emit_llvm_bitwise_operation(
        elementwise_operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
    ) -> LlvmValue:
        return getattr(elementwise_operation.value_emitter.llvm_builder, builder_method_name)(
            *elementwise_operation.value_emitter.to_scalars_or_vectors(x, y)
        )

    return emit_llvm_bitwise_operation


def _make_comparison_rule(comparison_operator: str) -> ElementwiseRule:
    """Return an elementwise rule that compares two numbers by an operator such as "<"."""

    def emit_llvm_comparison(
        elementwise_operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
    ) -> LlvmValue:
        return _emit_llvm_comparison(
            elementwise_operation.value_emitter,
            comparison_operator,
            elementwise_operation.operand_dtype,
            *elementwise_operation.value_emitter.to_scalars_or_vectors(x, y),
        )

    return emit_llvm_comparison


def _make_extremum_rule(comparison_operator: str) -> ElementwiseRule:
    """Return an elementwise rule that emits the maximum (operator ">") or the minimum ("<") of two
    operands.
    """

    def emit_llvm_extremum(
        elementwise_operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
    ) -> LlvmValue:
        x, y = elementwise_operation.value_emitter.to_scalars_or_vectors(x, y)
        selected_value = elementwise_operation.value_emitter.llvm_builder.select(
            _emit_llvm_comparison(
                elementwise_operation.value_emitter,
                comparison_operator,
                elementwise_operation.operand_dtype,
                x,
                y,
            ),
            x,
            y,
        )
        if elementwise_operation.operand_dtype.kind != "f":
            return selected_value
        # The result is NaN if either operand is NaN.
        return elementwise_operation.value_emitter.llvm_builder.select(
            elementwise_operation.value_emitter.llvm_builder.fcmp_unordered("uno", x, x),
            x,
            selected_value,
        )

    return emit_llvm_extremum


def _emit_llvm_select(
    elementwise_operation: ElementwiseOperation, *condition_and_cases: LlvmValue
) -> LlvmValue:
    """Emit the selection of the first case where the condition is false, and of the second where it
    is true.

    Return the LLVM value that contains the selected case of each lane.
    """
    lane_condition, *case_values = condition_and_cases
    if (
        all(_equals_llvm_constant(case_value, 0) for case_value in case_values)
        or case_values[0] is case_values[1]
    ):
        return case_values[0]
    if isinstance(lane_condition.type, ir.VectorType):
        case_values = [
            elementwise_operation.value_emitter.to_lane_vector(case_value)
            for case_value in case_values
        ]
    false_case, true_case = elementwise_operation.value_emitter.to_scalars_or_vectors(*case_values)
    return elementwise_operation.value_emitter.llvm_builder.select(
        lane_condition, true_case, false_case
    )


def _make_intrinsic_rule(
    intrinsic_function_name: str,
    emit_float32_value: Callable[[ValueEmitter, LlvmValue], LlvmValue] | None = None,
) -> ElementwiseRule:
    """Return an elementwise rule that emits a call of an LLVM intrinsic function, such as "sqrt".

    For float32 operands, `emit_float32_value` emits the instructions instead, if it is given.
    """

    def emit_llvm_intrinsic(elementwise_operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
        _require_float_dtype(intrinsic_function_name, elementwise_operation.operand_dtype)
        return (
            emit_float32_value(elementwise_operation.value_emitter, x)
            if emit_float32_value and elementwise_operation.operand_dtype == np.float32
            else _emit_llvm_intrinsic_call(
                elementwise_operation.value_emitter, intrinsic_function_name, x
            )
        )

    return emit_llvm_intrinsic


def _require_float_dtype(primitive_name: str, operand_dtype: Any) -> None:
    """Raise a NotImplementedError unless `operand_dtype` is a float type."""
    if operand_dtype.kind != "f":
        raise NotImplementedError(
            f"{primitive_name} of {operand_dtype} has no machine code: convert to floats."
        )


def _emit_binary_instruction(
    elementwise_operation: ElementwiseOperation,
    float_and_integer_opcodes: tuple[str, str],
    x: LlvmValue,
    y: LlvmValue,
) -> LlvmValue:
    """Emit an instruction with two operands and return its LLVM value.

    The opcode is the first of `float_and_integer_opcodes` if the operands are floats, else
    the second.
    """
    x, y = elementwise_operation.value_emitter.to_scalars_or_vectors(x, y)
    return elementwise_operation.value_emitter.emit_binary_instruction(
        f"{float_and_integer_opcodes[0]} {' '.join(FUSED_MULTIPLY_ADD_FLAGS)}"
        if elementwise_operation.operand_dtype.kind == "f"
        else float_and_integer_opcodes[1],
        x,
        y,
    )


def _emit_llvm_comparison(
    value_emitter: ValueEmitter,
    comparison_operator: str,
    operand_dtype: Any,
    x: LlvmValue,
    y: LlvmValue,
) -> LlvmValue:
    """Emit the comparison of two numbers of type `operand_dtype`, and return the LLVM truth value.

    `comparison_operator` is an operator such as "<".
    """
    if operand_dtype.kind == "b":  # The signed value of true would be -1.
        return value_emitter.llvm_builder.icmp_unsigned(comparison_operator, x, y)
    if operand_dtype.kind != "f":
        return value_emitter.llvm_builder.icmp_signed(comparison_operator, x, y)
    compare_floats = (
        value_emitter.llvm_builder.fcmp_unordered
        if comparison_operator == "!="
        else value_emitter.llvm_builder.fcmp_ordered
    )
    return compare_floats(comparison_operator, x, y)


def convert_llvm_value(
    value_emitter: ValueEmitter, llvm_value: LlvmValue, operand_dtype: Any, result_dtype: Any
) -> LlvmValue:
    """Emit the conversion of an LLVM value from `operand_dtype` to `result_dtype`, and return the
    converted value.
    """
    llvm_builder, result_llvm_type = (
        value_emitter.llvm_builder,
        LLVM_NUMBER_TYPES[result_dtype.name],
    )
    result_llvm_type = (
        value_emitter.make_vector_type(result_llvm_type)
        if isinstance(llvm_value.type, ir.VectorType)
        else result_llvm_type
    )
    if operand_dtype == result_dtype:
        return llvm_value
    if result_dtype.kind == "b":
        return _emit_llvm_comparison(
            value_emitter,
            "!=",
            operand_dtype,
            llvm_value,
            value_emitter.make_llvm_constant(llvm_value.type, 0),
        )
    if operand_dtype.kind == result_dtype.kind == "f":
        return (
            llvm_builder.fptrunc
            if result_dtype.itemsize < operand_dtype.itemsize
            else llvm_builder.fpext
        )(llvm_value, result_llvm_type)
    if result_dtype.kind == "f":
        return (llvm_builder.uitofp if operand_dtype.kind == "b" else llvm_builder.sitofp)(
            llvm_value, result_llvm_type
        )
    if operand_dtype.kind == "f":
        return llvm_builder.fptosi(llvm_value, result_llvm_type)
    if operand_dtype.kind == "b":
        return llvm_builder.zext(llvm_value, result_llvm_type)
    return (
        llvm_builder.trunc if result_dtype.itemsize < operand_dtype.itemsize else llvm_builder.sext
    )(llvm_value, result_llvm_type)


def _emit_llvm_intrinsic_call(
    value_emitter: ValueEmitter, intrinsic_function_name: str, operand: LlvmValue
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
    llvm_module = value_emitter.llvm_builder.module
    if intrinsic_name not in llvm_module.globals:
        ir.Function(llvm_module, ir.FunctionType(llvm_type, [llvm_type]), intrinsic_name)
    return value_emitter.llvm_builder.call(llvm_module.globals[intrinsic_name], [operand])


def _emit_llvm_polynomial(
    value_emitter: ValueEmitter, x: LlvmValue, polynomial_coefficients: Sequence[float]
) -> LlvmValue:
    """Emit a polynomial in `x` by Horner's scheme and return its LLVM value. The coefficients begin
    with the lowest power.
    """
    llvm_builder, horner_sum = (
        value_emitter.llvm_builder,
        value_emitter.make_llvm_constant(x.type, polynomial_coefficients[-1]),
    )
    for polynomial_coefficient in polynomial_coefficients[-2::-1]:
        horner_product = llvm_builder.fmul(horner_sum, x, flags=FUSED_MULTIPLY_ADD_FLAGS)
        horner_sum = llvm_builder.fadd(
            horner_product,
            value_emitter.make_llvm_constant(x.type, polynomial_coefficient),
            flags=FUSED_MULTIPLY_ADD_FLAGS,
        )
    return horner_sum


def _emit_float32_logarithm(value_emitter: ValueEmitter, operand: LlvmValue) -> LlvmValue:
    """Emit the natural logarithm of a positive normal float32 number, accurate to 1e-5, and return
    its LLVM value.

    LLVM's own logarithm would call the C library once per lane.
    """
    llvm_builder, llvm_type = value_emitter.llvm_builder, operand.type
    llvm_integer_type = (
        ir.VectorType(I32, llvm_type.count) if isinstance(llvm_type, ir.VectorType) else I32
    )
    float_bits = llvm_builder.bitcast(operand, llvm_integer_type)
    make_integer_constant = lambda x: value_emitter.make_llvm_constant(llvm_integer_type, x)
    binary_exponent = llvm_builder.sub(
        llvm_builder.ashr(float_bits, make_integer_constant(23)), make_integer_constant(127)
    )
    mantissa_bits = llvm_builder.or_(
        llvm_builder.and_(float_bits, make_integer_constant(0x7FFFFF)),
        make_integer_constant(0x3F800000),
    )
    mantissa_minus_one = llvm_builder.fsub(
        llvm_builder.bitcast(mantissa_bits, llvm_type),
        value_emitter.make_llvm_constant(llvm_type, 1.0),
    )
    return llvm_builder.fadd(
        llvm_builder.fmul(
            llvm_builder.sitofp(binary_exponent, llvm_type),
            value_emitter.make_llvm_constant(llvm_type, np.log(2.0)),
        ),
        _emit_llvm_polynomial(value_emitter, mantissa_minus_one, LOGARITHM_COEFFICIENTS),
    )


def _emit_float32_exponential(value_emitter: ValueEmitter, operand: LlvmValue) -> LlvmValue:
    """Emit the exponential of a float32 number between -87 and 88, and return its LLVM value.

    The relative error is at most 1e-6.
    """
    llvm_builder, llvm_type = value_emitter.llvm_builder, operand.type
    llvm_integer_type = (
        ir.VectorType(I32, llvm_type.count) if isinstance(llvm_type, ir.VectorType) else I32
    )
    exponent_of_two = llvm_builder.fmul(
        operand, value_emitter.make_llvm_constant(llvm_type, 1.0 / np.log(2.0))
    )
    integer_exponent = _emit_llvm_intrinsic_call(value_emitter, "floor", exponent_of_two)
    fractional_power_of_two = _emit_llvm_polynomial(
        value_emitter,
        llvm_builder.fsub(exponent_of_two, integer_exponent),
        POWER_OF_TWO_COEFFICIENTS,
    )
    make_integer_constant = lambda x: value_emitter.make_llvm_constant(llvm_integer_type, x)
    integer_power_of_two_bits = llvm_builder.shl(
        llvm_builder.add(
            llvm_builder.fptosi(integer_exponent, llvm_integer_type), make_integer_constant(127)
        ),
        make_integer_constant(23),
    )
    return llvm_builder.fmul(
        fractional_power_of_two, llvm_builder.bitcast(integer_power_of_two_bits, llvm_type)
    )


def _equals_llvm_constant(llvm_value: LlvmValue, expected_number: int) -> bool:
    """Return whether an LLVM value is a constant that equals `expected_number` in every lane."""
    return isinstance(llvm_value, ir.Constant) and _has_equal_constant_entries(
        llvm_value.constant, expected_number
    )


def _has_equal_constant_entries(llvm_constant_content: Any, expected_number: int) -> bool:
    """Return whether all entries of a constant, nested to any depth, equal `expected_number`."""
    if isinstance(llvm_constant_content, (list, tuple)):
        return all(
            _has_equal_constant_entries(constant_entry.constant, expected_number)
            for constant_entry in llvm_constant_content
        )
    return (
        isinstance(llvm_constant_content, (int, float)) and llvm_constant_content == expected_number
    )


def _fit_polynomial(
    fitted_function: Callable[[np.ndarray], np.ndarray], polynomial_degree: int
) -> list[float]:
    """Return the coefficients, lowest power first, of a polynomial that interpolates
    `fitted_function`.

    The interpolation points are Chebyshev's points on [0, 1].
    """
    x = 0.5 - 0.5 * np.cos(
        np.pi * (np.arange(polynomial_degree + 1) + 0.5) / (polynomial_degree + 1)
    )
    return list(
        map(float, np.polynomial.polynomial.polyfit(x, fitted_function(x), polynomial_degree))
    )


LOGARITHM_COEFFICIENTS = _fit_polynomial(np.log1p, 5)
POWER_OF_TWO_COEFFICIENTS = _fit_polynomial(np.exp2, 5)

ELEMENTWISE_RULES: dict[str, ElementwiseRule] = {
    "abs": _emit_llvm_absolute_value,
    "add": _emit_llvm_sum,
    "add_any": _emit_llvm_sum,
    "and": _make_bitwise_rule("and_"),
    "convert_element_type": lambda elementwise_operation, x: convert_llvm_value(
        elementwise_operation.value_emitter,
        x,
        elementwise_operation.operand_dtype,
        elementwise_operation.result_dtype,
    ),
    "copy": _return_operand,
    "cos": _make_intrinsic_rule("cos"),
    "div": _emit_llvm_quotient,
    "eq": _make_comparison_rule("=="),
    "exp": _make_intrinsic_rule("exp", _emit_float32_exponential),
    "floor": _make_intrinsic_rule("floor"),
    "ge": _make_comparison_rule(">="),
    "gt": _make_comparison_rule(">"),
    "integer_pow": _emit_llvm_integer_power,
    "is_finite": lambda elementwise_operation, x: (
        elementwise_operation.value_emitter.llvm_builder.fcmp_ordered(
            "<",
            _emit_llvm_intrinsic_call(elementwise_operation.value_emitter, "fabs", x),
            elementwise_operation.value_emitter.make_llvm_constant(x.type, np.inf),
        )
    ),
    "le": _make_comparison_rule("<="),
    "log": _make_intrinsic_rule("log", _emit_float32_logarithm),
    "lt": _make_comparison_rule("<"),
    "max": _make_extremum_rule(">"),
    "min": _make_extremum_rule("<"),
    "mul": _emit_llvm_product,
    "ne": _make_comparison_rule("!="),
    "neg": lambda elementwise_operation, x: (
        elementwise_operation.value_emitter.llvm_builder.fneg(x)
        if elementwise_operation.operand_dtype.kind == "f"
        else elementwise_operation.value_emitter.llvm_builder.neg(x)
    ),
    "not": lambda elementwise_operation, x: elementwise_operation.value_emitter.llvm_builder.not_(
        x
    ),
    "or": _make_bitwise_rule("or_"),
    "select_n": _emit_llvm_select,
    "shift_left": _make_bitwise_rule("shl"),
    "shift_right_arithmetic": _make_bitwise_rule("ashr"),
    "shift_right_logical": _make_bitwise_rule("lshr"),
    "sin": _make_intrinsic_rule("sin"),
    "sqrt": _make_intrinsic_rule("sqrt"),
    "square": lambda elementwise_operation, x: _emit_binary_instruction(
        elementwise_operation, ("fmul", "mul"), x, x
    ),
    "stop_gradient": _return_operand,
    # A constant operand y = 0 needs no instruction.
    "sub": lambda elementwise_operation, x, y: (
        x
        if _equals_llvm_constant(y, 0)
        else _emit_binary_instruction(elementwise_operation, ("fsub", "sub"), x, y)
    ),
    "xor": _make_bitwise_rule("xor"),
}

"""Rules that emit LLVM instructions for elementwise JAX primitives: the table `ELEMENTWISE_RULES`.

The arguments of a rule are the value emitter, the primitive's parameters, the dtypes of its first
operand and of its result, and the LLVM values of its operands. The rule returns the LLVM value of
the result.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import I32, NUMBER_TYPES, Value, ValueEmitter

FUSED_FLAGS = ("contract",)
"""LLVM's fast-math flags with which products and sums may be rounded once instead of twice. No
other reordering is allowed.
"""
RECIPROCAL_FLAGS = (*FUSED_FLAGS, "arcp")
"""LLVM's fast-math flags with which a repeated divisor may be inverted once. They are used only in
float64, because processors approximate the inverse in float32.
"""

ElementwiseRule = Callable[..., Value]


def emit_elementwise(
    emitter: ValueEmitter,
    name: str,
    params: Any,
    in_dtype: Any,
    out_dtype: Any,
    values: Sequence[Value],
) -> Value:
    """Emit the JAX primitive `name` for operands of type `in_dtype`, and return its value of type
    `out_dtype`.

    The instructions are emitted once for equal operands.
    """
    key = (name, out_dtype.num, params.get("y"), *map(id, values))
    rule = ELEMENTWISE_RULES[name]
    return emitter.emit_once(key, lambda: rule(emitter, params, in_dtype, out_dtype, *values))


# Sums and products are simplified: terms known to be zero and factors known to be one are dropped.


def _add(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit x + y and return its value; a known zero is dropped."""
    if _is_constant(y, 0):
        return x
    return y if _is_constant(x, 0) else _emit_binary(emitter, in_dtype, ("fadd", "add"), x, y)


def _sub(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit x - y and return its value; a known zero y is dropped."""
    return x if _is_constant(y, 0) else _emit_binary(emitter, in_dtype, ("fsub", "sub"), x, y)


def _mul(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit x * y and return its value; a factor known to be zero or one needs no instruction."""
    if _is_constant(y, 1) or _is_constant(x, 0):
        return x
    return (
        y
        if _is_constant(x, 1) or _is_constant(y, 0)
        else _emit_binary(emitter, in_dtype, ("fmul", "mul"), x, y)
    )


def _div(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit the quotient x / y of floats and return its value."""
    _require_float("div", in_dtype)  # An integer division by zero would stop the process.
    if _is_constant(y, 1):
        return x
    x, y = emitter.to_same_shape(x, y)
    return emitter.builder.fdiv(
        x, y, flags=RECIPROCAL_FLAGS if in_dtype == np.float64 else FUSED_FLAGS
    )


def _square(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit x * x and return its value."""
    return _emit_binary(emitter, in_dtype, ("fmul", "mul"), x, x)


def _integer_pow(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value
) -> Value:
    """Emit the power of `x` with a constant integer exponent by repeated squaring, and return its
    value.
    """
    multiply = lambda x, y: _emit_binary(emitter, in_dtype, ("fmul", "mul"), x, y)
    result, squared_value, remaining_exponent = None, x, abs(params["y"])
    while remaining_exponent:
        if remaining_exponent & 1:
            result = squared_value if result is None else multiply(result, squared_value)
        remaining_exponent >>= 1
        squared_value = (
            multiply(squared_value, squared_value) if remaining_exponent else squared_value
        )
    unit_value = emitter.constant(x.type, 1)
    result = unit_value if result is None else result
    return (
        emitter.builder.fdiv(unit_value, result, flags=FUSED_FLAGS) if params["y"] < 0 else result
    )


def _neg(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit -x and return its value."""
    return emitter.builder.fneg(x) if in_dtype.kind == "f" else emitter.builder.neg(x)


def _abs(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit the absolute value of `x` and return it."""
    if in_dtype.kind == "f":
        return _emit_intrinsic(emitter, "fabs", x)
    is_negative = _emit_comparison(emitter, "<", in_dtype, x, emitter.constant(x.type, 0))
    return emitter.builder.select(is_negative, emitter.builder.neg(x), x)


def _not(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit the logical or bitwise negation of `x` and return its value."""
    return emitter.builder.not_(x)


def _identity(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Return the operand unchanged."""
    return x


def _bitwise_rule(instruction_method: str) -> ElementwiseRule:
    """Return the rule that emits the bitwise instruction of this method of llvmlite's builder."""

    def emit_instruction(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
    ) -> Value:
        return getattr(emitter.builder, instruction_method)(*emitter.to_same_shape(x, y))

    return emit_instruction


def _comparison_rule(operator: str) -> ElementwiseRule:
    """Return the rule that emits a comparison by this operator, such as "<"."""

    def emit_comparison(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
    ) -> Value:
        return _emit_comparison(emitter, operator, in_dtype, *emitter.to_same_shape(x, y))

    return emit_comparison


def _extremum_rule(operator: str) -> ElementwiseRule:
    """Return the rule that emits the maximum (operator ">") or the minimum ("<") of two
    operands.
    """

    def emit_extremum(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
    ) -> Value:
        x, y = emitter.to_same_shape(x, y)
        selected_value = emitter.builder.select(
            _emit_comparison(emitter, operator, in_dtype, x, y), x, y
        )
        if in_dtype.kind != "f":
            return selected_value
        # The result is NaN if either operand is NaN.
        return emitter.builder.select(
            emitter.builder.fcmp_unordered("uno", x, x), x, selected_value
        )

    return emit_extremum


def _select_n(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, *values: Value
) -> Value:
    """Emit the selection of one of two cases by a condition for each lane, and return its value."""
    condition, *cases = values
    if all(_is_constant(case, 0) for case in cases) or cases[0] is cases[1]:
        return cases[0]
    if isinstance(condition.type, ir.VectorType):
        cases = [emitter.splat(case) for case in cases]
    false_case, true_case = emitter.to_same_shape(*cases)
    return emitter.builder.select(condition, true_case, false_case)


def _convert(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit the conversion of `x` to the type of the result, and return its value."""
    return convert_value(emitter, x, in_dtype, out_dtype)


def _is_finite(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value
) -> Value:
    """Emit the test whether the float `x` is finite, and return its truth value."""
    magnitude = _emit_intrinsic(emitter, "fabs", x)
    return emitter.builder.fcmp_ordered("<", magnitude, emitter.constant(magnitude.type, np.inf))


def _intrinsic_rule(
    name: str, emit_float32: Callable[[ValueEmitter, Value], Value] | None = None
) -> ElementwiseRule:
    """Return the rule that calls an LLVM intrinsic function; in float32 `emit_float32` replaces the
    call, if given.
    """

    def emit_intrinsic(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value
    ) -> Value:
        _require_float(name, in_dtype)
        return (
            emit_float32(emitter, x)
            if emit_float32 and in_dtype == np.float32
            else _emit_intrinsic(emitter, name, x)
        )

    return emit_intrinsic


def _require_float(name: str, dtype: Any) -> None:
    """Raise a NotImplementedError unless `dtype` is a float type; `name` is the primitive."""
    if dtype.kind != "f":
        raise NotImplementedError(f"{name} of {dtype} has no machine code: convert to floats.")


def _emit_binary(
    emitter: ValueEmitter, dtype: Any, opcodes: tuple[str, str], x: Value, y: Value
) -> Value:
    """Emit the first of two instructions for floats and the second for integers, and return its
    value.
    """
    x, y = emitter.to_same_shape(x, y)
    return emitter.emit_binary(
        f"{opcodes[0]} {' '.join(FUSED_FLAGS)}" if dtype.kind == "f" else opcodes[1], x, y
    )


def _emit_comparison(emitter: ValueEmitter, operator: str, dtype: Any, x: Value, y: Value) -> Value:
    """Emit the comparison of two numbers of type `dtype`, and return its truth value."""
    if dtype.kind == "b":  # The signed value of true would be -1.
        return emitter.builder.icmp_unsigned(operator, x, y)
    if dtype.kind != "f":
        return emitter.builder.icmp_signed(operator, x, y)
    compare_floats = (
        emitter.builder.fcmp_unordered if operator == "!=" else emitter.builder.fcmp_ordered
    )
    return compare_floats(operator, x, y)


def convert_value(emitter: ValueEmitter, value: Value, in_dtype: Any, out_dtype: Any) -> Value:
    """Emit the conversion of `value` from `in_dtype` to `out_dtype`, and return the new value."""
    builder, target_type = emitter.builder, NUMBER_TYPES[out_dtype.name]
    target_type = (
        emitter.vector_type(target_type) if isinstance(value.type, ir.VectorType) else target_type
    )
    if in_dtype == out_dtype:
        return value
    if out_dtype.kind == "b":
        return _emit_comparison(emitter, "!=", in_dtype, value, emitter.constant(value.type, 0))
    if in_dtype.kind == out_dtype.kind == "f":
        return (builder.fptrunc if out_dtype.itemsize < in_dtype.itemsize else builder.fpext)(
            value, target_type
        )
    if out_dtype.kind == "f":
        return (builder.uitofp if in_dtype.kind == "b" else builder.sitofp)(value, target_type)
    if in_dtype.kind == "f":
        return builder.fptosi(value, target_type)
    if in_dtype.kind == "b":
        return builder.zext(value, target_type)
    return (builder.trunc if out_dtype.itemsize < in_dtype.itemsize else builder.sext)(
        value, target_type
    )


def _emit_intrinsic(emitter: ValueEmitter, name: str, value: Value) -> Value:
    """Emit a call of the LLVM intrinsic function `name` for the value's type, and return its
    result.
    """
    llvm_type = value.type
    is_vector = isinstance(llvm_type, ir.VectorType)
    element_type = llvm_type.element if is_vector else llvm_type
    n_bits = 64 if element_type == NUMBER_TYPES["float64"] else 32
    intrinsic_name = f"llvm.{name}.{f'v{llvm_type.count}' if is_vector else ''}f{n_bits}"
    module = emitter.builder.module
    if intrinsic_name not in module.globals:
        ir.Function(module, ir.FunctionType(llvm_type, [llvm_type]), intrinsic_name)
    return emitter.builder.call(module.globals[intrinsic_name], [value])


def _emit_polynomial(emitter: ValueEmitter, x: Value, coefficients: Sequence[float]) -> Value:
    """Emit a polynomial in `x` by Horner's scheme and return its value; coefficients begin with the
    lowest power.
    """
    builder, partial_value = emitter.builder, emitter.constant(x.type, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        product = builder.fmul(partial_value, x, flags=FUSED_FLAGS)
        partial_value = builder.fadd(
            product, emitter.constant(x.type, coefficient), flags=FUSED_FLAGS
        )
    return partial_value


def _emit_logarithm(emitter: ValueEmitter, value: Value) -> Value:
    """Emit the natural logarithm of positive normal float32 numbers, and return it, accurate to
    1e-5.

    It replaces the library's logarithm, which takes one call per lane.
    """
    builder, llvm_type = emitter.builder, value.type
    integer_type = (
        ir.VectorType(I32, llvm_type.count) if isinstance(llvm_type, ir.VectorType) else I32
    )
    bits = builder.bitcast(value, integer_type)
    integer_constant = lambda x: emitter.constant(integer_type, x)
    exponent = builder.sub(builder.ashr(bits, integer_constant(23)), integer_constant(127))
    mantissa = builder.or_(
        builder.and_(bits, integer_constant(0x7FFFFF)), integer_constant(0x3F800000)
    )
    fractional_part = builder.fsub(
        builder.bitcast(mantissa, llvm_type), emitter.constant(llvm_type, 1.0)
    )
    return builder.fadd(
        builder.fmul(builder.sitofp(exponent, llvm_type), emitter.constant(llvm_type, np.log(2.0))),
        _emit_polynomial(emitter, fractional_part, LOGARITHM_COEFFICIENTS),
    )


def _emit_exponential(emitter: ValueEmitter, value: Value) -> Value:
    """Emit the exponential of float32 numbers between -87 and 88, and return it, accurate to a
    relative error of 1e-6.
    """
    builder, llvm_type = emitter.builder, value.type
    integer_type = (
        ir.VectorType(I32, llvm_type.count) if isinstance(llvm_type, ir.VectorType) else I32
    )
    exponent_of_two = builder.fmul(value, emitter.constant(llvm_type, 1.0 / np.log(2.0)))
    integer_part = _emit_intrinsic(emitter, "floor", exponent_of_two)
    fractional_power = _emit_polynomial(
        emitter, builder.fsub(exponent_of_two, integer_part), POWER_OF_TWO_COEFFICIENTS
    )
    integer_constant = lambda x: emitter.constant(integer_type, x)
    power_of_two = builder.shl(
        builder.add(builder.fptosi(integer_part, integer_type), integer_constant(127)),
        integer_constant(23),
    )
    return builder.fmul(fractional_power, builder.bitcast(power_of_two, llvm_type))


def _is_constant(value: Value, number: int) -> bool:
    """Return whether an LLVM value is a constant that equals `number` in every lane."""
    return isinstance(value, ir.Constant) and _is_constant_everywhere(value.constant, number)


def _is_constant_everywhere(constant: Any, number: int) -> bool:
    """Return whether all entries of an LLVM constant equal `number`."""
    if isinstance(constant, (list, tuple)):
        return all(_is_constant_everywhere(entry.constant, number) for entry in constant)
    return isinstance(constant, (int, float)) and constant == number


def _fit_polynomial(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[float]:
    """Return the coefficients, lowest power first, of a polynomial fitted to `function` at
    Chebyshev's points on [0, 1].
    """
    x = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return list(map(float, np.polynomial.polynomial.polyfit(x, function(x), degree)))


LOGARITHM_COEFFICIENTS = _fit_polynomial(np.log1p, 5)
POWER_OF_TWO_COEFFICIENTS = _fit_polynomial(np.exp2, 5)

ELEMENTWISE_RULES: dict[str, ElementwiseRule] = {
    "abs": _abs,
    "add": _add,
    "add_any": _add,
    "and": _bitwise_rule("and_"),
    "convert_element_type": _convert,
    "copy": _identity,
    "cos": _intrinsic_rule("cos"),
    "div": _div,
    "eq": _comparison_rule("=="),
    "exp": _intrinsic_rule("exp", _emit_exponential),
    "floor": _intrinsic_rule("floor"),
    "ge": _comparison_rule(">="),
    "gt": _comparison_rule(">"),
    "integer_pow": _integer_pow,
    "is_finite": _is_finite,
    "le": _comparison_rule("<="),
    "log": _intrinsic_rule("log", _emit_logarithm),
    "lt": _comparison_rule("<"),
    "max": _extremum_rule(">"),
    "min": _extremum_rule("<"),
    "mul": _mul,
    "ne": _comparison_rule("!="),
    "neg": _neg,
    "not": _not,
    "or": _bitwise_rule("or_"),
    "select_n": _select_n,
    "shift_left": _bitwise_rule("shl"),
    "shift_right_arithmetic": _bitwise_rule("ashr"),
    "shift_right_logical": _bitwise_rule("lshr"),
    "sin": _intrinsic_rule("sin"),
    "sqrt": _intrinsic_rule("sqrt"),
    "square": _square,
    "stop_gradient": _identity,
    "sub": _sub,
    "xor": _bitwise_rule("xor"),
}

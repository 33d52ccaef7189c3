"""Elementwise primitives: the table ELEMENTWISE_RULES.

A rule takes the value emitter, the primitive's parameters, the types of its first operand and of
its result, and the operands' values; it returns the result's value.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import I32, NUMBER_TYPES, Value, ValueEmitter

FUSED_FLAGS = ("contract",)
"""Flags that let products and sums be rounded once instead of twice; nothing else may be
reordered."""
RECIPROCAL_FLAGS = (*FUSED_FLAGS, "arcp")
"""Flags that let repeated divisors be inverted once, only in float64: in float32 processors
approximate the inverse."""

ElementwiseRule = Callable[..., Value]


def emit_elementwise(
    emitter: ValueEmitter,
    name: str,
    params: Any,
    in_dtype: Any,
    out_dtype: Any,
    values: Sequence[Value],
) -> Value:
    """Emit a JAX primitive on numbers of `in_dtype` with a result of `out_dtype`, once per
    operands.
    """
    key = (name, out_dtype.num, params.get("y"), *map(id, values))
    rule = ELEMENTWISE_RULES[name]
    return emitter.emit_once(key, lambda: rule(emitter, params, in_dtype, out_dtype, *values))


# Sums and products are simplified: terms known as zero and factors known as one are dropped.


def _add(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit a sum, or the other operand if one is zero."""
    if _is_constant(y, 0):
        return x
    return y if _is_constant(x, 0) else _emit_binary(emitter, in_dtype, ("fadd", "add"), x, y)


def _sub(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit a difference, or the first operand if the second is zero."""
    return x if _is_constant(y, 0) else _emit_binary(emitter, in_dtype, ("fsub", "sub"), x, y)


def _mul(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
) -> Value:
    """Emit a product, or an operand if the product is known."""
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
    """Emit a quotient of floats."""
    _require_float("div", in_dtype)  # an integer division by zero would stop the process
    if _is_constant(y, 1):
        return x
    x, y = emitter.to_same_shape(x, y)
    return emitter.builder.fdiv(
        x, y, flags=RECIPROCAL_FLAGS if in_dtype == np.float64 else FUSED_FLAGS
    )


def _square(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit a square."""
    return _emit_binary(emitter, in_dtype, ("fmul", "mul"), x, x)


def _integer_pow(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value
) -> Value:
    """Emit a power by repeated squares."""
    multiply = lambda x, y: _emit_binary(emitter, in_dtype, ("fmul", "mul"), x, y)
    result, square, remaining_exponent = None, x, abs(params["y"])
    while remaining_exponent:
        if remaining_exponent & 1:
            result = square if result is None else multiply(result, square)
        remaining_exponent >>= 1
        square = multiply(square, square) if remaining_exponent else square
    unit_value = emitter.constant(x.type, 1)
    result = unit_value if result is None else result
    return (
        emitter.builder.fdiv(unit_value, result, flags=FUSED_FLAGS) if params["y"] < 0 else result
    )


def _neg(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit a change of sign."""
    return emitter.builder.fneg(x) if in_dtype.kind == "f" else emitter.builder.neg(x)


def _abs(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit an absolute value."""
    if in_dtype.kind == "f":
        return _emit_intrinsic(emitter, "fabs", x)
    negative = _emit_comparison(emitter, "<", in_dtype, x, emitter.constant(x.type, 0))
    return emitter.builder.select(negative, emitter.builder.neg(x), x)


def _not(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit a logical or bitwise negation."""
    return emitter.builder.not_(x)


def _identity(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Return the operand."""
    return x


def _bitwise_rule(method: str) -> ElementwiseRule:
    """Return the rule of a bitwise instruction, a method of the builder."""

    def write(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
    ) -> Value:
        return getattr(emitter.builder, method)(*emitter.to_same_shape(x, y))

    return write


def _comparison_rule(operator: str) -> ElementwiseRule:
    """Return the rule of a comparison."""

    def write(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
    ) -> Value:
        return _emit_comparison(emitter, operator, in_dtype, *emitter.to_same_shape(x, y))

    return write


def _extremum_rule(operator: str) -> ElementwiseRule:
    """Return the rule of the maximum (">") or the minimum ("<") of two operands."""

    def write(
        emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value, y: Value
    ) -> Value:
        x, y = emitter.to_same_shape(x, y)
        selected_value = emitter.builder.select(
            _emit_comparison(emitter, operator, in_dtype, x, y), x, y
        )
        if in_dtype.kind != "f":
            return selected_value
        # A NaN on either side is the result.
        return emitter.builder.select(
            emitter.builder.fcmp_unordered("uno", x, x), x, selected_value
        )

    return write


def _select_n(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, *values: Value
) -> Value:
    """Emit a selection between two cases by a condition."""
    condition, *cases = values
    if all(_is_constant(case, 0) for case in cases) or cases[0] is cases[1]:
        return cases[0]
    if isinstance(condition.type, ir.VectorType):
        cases = [emitter.splat(case) for case in cases]
    false_case, true_case = emitter.to_same_shape(*cases)
    return emitter.builder.select(condition, true_case, false_case)


def _convert(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
    """Emit a conversion to the type of the result."""
    return convert_value(emitter, x, in_dtype, out_dtype)


def _is_finite(
    emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value
) -> Value:
    """Emit the test whether a float is finite."""
    size = _emit_intrinsic(emitter, "fabs", x)
    return emitter.builder.fcmp_ordered("<", size, emitter.constant(size.type, np.inf))


def _intrinsic_rule(
    name: str, emit_single: Callable[[ValueEmitter, Value], Value] | None = None
) -> ElementwiseRule:
    """Return the rule of an LLVM intrinsic; in float32 `emit_single` replaces it, if given."""

    def write(emitter: ValueEmitter, params: Any, in_dtype: Any, out_dtype: Any, x: Value) -> Value:
        _require_float(name, in_dtype)
        return (
            emit_single(emitter, x)
            if emit_single and in_dtype == np.float32
            else _emit_intrinsic(emitter, name, x)
        )

    return write


def _require_float(name: str, dtype: Any) -> None:
    """Raise an error unless the numbers are floats."""
    if dtype.kind != "f":
        raise NotImplementedError(f"{name} of {dtype} has no machine code: convert to floats.")


def _emit_binary(
    emitter: ValueEmitter, dtype: Any, opcodes: tuple[str, str], x: Value, y: Value
) -> Value:
    """Emit an instruction for floats, or the one for integers."""
    x, y = emitter.to_same_shape(x, y)
    return emitter.emit_binary(
        f"{opcodes[0]} {' '.join(FUSED_FLAGS)}" if dtype.kind == "f" else opcodes[1], x, y
    )


def _emit_comparison(emitter: ValueEmitter, operator: str, dtype: Any, x: Value, y: Value) -> Value:
    """Emit a comparison of numbers of one type."""
    if dtype.kind == "b":  # as a signed number, true is -1
        return emitter.builder.icmp_unsigned(operator, x, y)
    if dtype.kind != "f":
        return emitter.builder.icmp_signed(operator, x, y)
    compare_floats = (
        emitter.builder.fcmp_unordered if operator == "!=" else emitter.builder.fcmp_ordered
    )
    return compare_floats(operator, x, y)


def convert_value(emitter: ValueEmitter, value: Value, in_dtype: Any, out_dtype: Any) -> Value:
    """Convert a number of `in_dtype` to `out_dtype`."""
    build, target_type = emitter.builder, NUMBER_TYPES[out_dtype.name]
    target_type = (
        emitter.vector_type(target_type) if isinstance(value.type, ir.VectorType) else target_type
    )
    if in_dtype == out_dtype:
        return value
    if out_dtype.kind == "b":
        return _emit_comparison(emitter, "!=", in_dtype, value, emitter.constant(value.type, 0))
    if in_dtype.kind == out_dtype.kind == "f":
        return (build.fptrunc if out_dtype.itemsize < in_dtype.itemsize else build.fpext)(
            value, target_type
        )
    if out_dtype.kind == "f":
        return (build.uitofp if in_dtype.kind == "b" else build.sitofp)(value, target_type)
    if in_dtype.kind == "f":
        return build.fptosi(value, target_type)
    if in_dtype.kind == "b":
        return build.zext(value, target_type)
    return (build.trunc if out_dtype.itemsize < in_dtype.itemsize else build.sext)(
        value, target_type
    )


def _emit_intrinsic(emitter: ValueEmitter, name: str, value: Value) -> Value:
    """Emit a call of an intrinsic function of LLVM."""
    kind = value.type
    vector = isinstance(kind, ir.VectorType)
    number = kind.element if vector else kind
    bits = 64 if number == NUMBER_TYPES["float64"] else 32
    intrinsic_name = f"llvm.{name}.{f'v{kind.count}' if vector else ''}f{bits}"
    module = emitter.builder.module
    if intrinsic_name not in module.globals:
        ir.Function(module, ir.FunctionType(kind, [kind]), intrinsic_name)
    return emitter.builder.call(module.globals[intrinsic_name], [value])


def _emit_polynomial(emitter: ValueEmitter, x: Value, coefficients: Sequence[float]) -> Value:
    """Emit a polynomial, lowest coefficient first."""
    build, value = emitter.builder, emitter.constant(x.type, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        product = build.fmul(value, x, flags=FUSED_FLAGS)
        value = build.fadd(product, emitter.constant(x.type, coefficient), flags=FUSED_FLAGS)
    return value


def _emit_logarithm(emitter: ValueEmitter, value: Value) -> Value:
    """Emit the logarithm of positive normal float32 numbers, accurate to 1e-5.

    The library's logarithm is one call per lane.
    """
    build, kind = emitter.builder, value.type
    integer_type = ir.VectorType(I32, kind.count) if isinstance(kind, ir.VectorType) else I32
    bits = build.bitcast(value, integer_type)
    integer_constant = lambda x: emitter.constant(integer_type, x)
    exponent = build.sub(build.ashr(bits, integer_constant(23)), integer_constant(127))
    mantissa = build.or_(build.and_(bits, integer_constant(0x7FFFFF)), integer_constant(0x3F800000))
    fractional_part = build.fsub(build.bitcast(mantissa, kind), emitter.constant(kind, 1.0))
    return build.fadd(
        build.fmul(build.sitofp(exponent, kind), emitter.constant(kind, np.log(2.0))),
        _emit_polynomial(emitter, fractional_part, LOGARITHM_COEFFICIENTS),
    )


def _emit_exponential(emitter: ValueEmitter, value: Value) -> Value:
    """Emit the exponential of float32 numbers between -87 and 88, accurate to 1e-6 of
    the result.
    """
    build, kind = emitter.builder, value.type
    integer_type = ir.VectorType(I32, kind.count) if isinstance(kind, ir.VectorType) else I32
    doublings = build.fmul(value, emitter.constant(kind, 1.0 / np.log(2.0)))
    whole_part = _emit_intrinsic(emitter, "floor", doublings)
    fractional_power = _emit_polynomial(
        emitter, build.fsub(doublings, whole_part), POWER_OF_TWO_COEFFICIENTS
    )
    integer_constant = lambda x: emitter.constant(integer_type, x)
    scale = build.shl(
        build.add(build.fptosi(whole_part, integer_type), integer_constant(127)),
        integer_constant(23),
    )
    return build.fmul(fractional_power, build.bitcast(scale, kind))


def _is_constant(value: Value, number: int) -> bool:
    """Return whether a value is that constant in every lane."""
    return isinstance(value, ir.Constant) and _is_constant_everywhere(value.constant, number)


def _is_constant_everywhere(constant: Any, number: int) -> bool:
    """Return whether all entries of a constant equal the number."""
    if isinstance(constant, (list, tuple)):
        return all(_is_constant_everywhere(entry.constant, number) for entry in constant)
    return isinstance(constant, (int, float)) and constant == number


def _fit_polynomial(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[float]:
    """Fit a polynomial on [0, 1] through Chebyshev's points, exact at neither end."""
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

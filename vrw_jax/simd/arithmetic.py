"""Elementwise primitives: the table ELEMENTWISE_RULES.

A rule takes the value emitter, the primitive's parameters, the types of its first operand and of
its result, and the operands' values; it returns the result's value.
"""

from collections.abc import Callable, Sequence
from typing import Any

import llvmlite.ir as ir
import numpy as np

from vrw_jax.simd.numbers import INT, NUMBERS, Numbers, Value

FUSED = ("contract",)
"""Flags that let products and sums be rounded once instead of twice; nothing else may be
reordered."""
RECIPROCAL = (*FUSED, "arcp")
"""Flags that let repeated divisors be inverted once, only in float64: in float32 processors
approximate the inverse."""

Rule = Callable[..., Value]


def elementwise(
    numbers: Numbers, name: str, params: Any, before: Any, after: Any, values: Sequence[Value]
) -> Value:
    """Emit a JAX primitive on numbers of `in_dtype` with a result of `out_dtype`, once per
    operands.
    """
    key = (name, after.num, params.get("y"), *map(id, values))
    rule = ELEMENTWISE[name]
    return numbers.once(key, lambda: rule(numbers, params, before, after, *values))


# Sums and products are simplified: terms known as zero and factors known as one are dropped.


def _add(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
    if _is(y, 0):
        return x
    return y if _is(x, 0) else _both(n, before, ("fadd", "add"), x, y)


def _sub(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
    return x if _is(y, 0) else _both(n, before, ("fsub", "sub"), x, y)


def _mul(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
    if _is(y, 1) or _is(x, 0):
        return x
    return y if _is(x, 1) or _is(y, 0) else _both(n, before, ("fmul", "mul"), x, y)


def _div(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
    _floats("div", before)  # an integer division by zero would stop the process
    if _is(y, 1):
        return x
    x, y = n.alike(x, y)
    return n.builder.fdiv(x, y, flags=RECIPROCAL if before == np.float64 else FUSED)


def _square(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    return _both(n, before, ("fmul", "mul"), x, x)


def _integer_pow(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    """Emit a power by repeated squares."""
    times = lambda x, y: _both(n, before, ("fmul", "mul"), x, y)
    result, square, left = None, x, abs(params["y"])
    while left:
        if left & 1:
            result = square if result is None else times(result, square)
        left >>= 1
        square = times(square, square) if left else square
    one = n.constant(x.type, 1)
    result = one if result is None else result
    return n.builder.fdiv(one, result, flags=FUSED) if params["y"] < 0 else result


def _neg(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    return n.builder.fneg(x) if before.kind == "f" else n.builder.neg(x)


def _abs(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    if before.kind == "f":
        return _intrinsic(n, "fabs", x)
    negative = _compare(n, "<", before, x, n.constant(x.type, 0))
    return n.builder.select(negative, n.builder.neg(x), x)


def _not(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    return n.builder.not_(x)


def _same(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    return x


def _bits(method: str) -> Rule:
    def write(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
        return getattr(n.builder, method)(*n.alike(x, y))

    return write


def _comparison(how: str) -> Rule:
    def write(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
        return _compare(n, how, before, *n.alike(x, y))

    return write


def _extreme(how: str) -> Rule:
    def write(n: Numbers, params: Any, before: Any, after: Any, x: Value, y: Value) -> Value:
        x, y = n.alike(x, y)
        chosen = n.builder.select(_compare(n, how, before, x, y), x, y)
        if before.kind != "f":
            return chosen
        # A NaN on either side is the result.
        return n.builder.select(n.builder.fcmp_unordered("uno", x, x), x, chosen)

    return write


def _select_n(n: Numbers, params: Any, before: Any, after: Any, *values: Value) -> Value:
    where, *cases = values
    if all(_is(case, 0) for case in cases) or cases[0] is cases[1]:
        return cases[0]
    if isinstance(where.type, ir.VectorType):
        cases = [n.spread(case) for case in cases]
    no, yes = n.alike(*cases)
    return n.builder.select(where, yes, no)


def _convert(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    return converted(n, x, before, after)


def _is_finite(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
    size = _intrinsic(n, "fabs", x)
    return n.builder.fcmp_ordered("<", size, n.constant(size.type, np.inf))


def _function(name: str, single: Callable[[Numbers, Value], Value] | None = None) -> Rule:
    """Return the rule of an LLVM intrinsic; in float32 `emit_single` replaces it, if given."""

    def write(n: Numbers, params: Any, before: Any, after: Any, x: Value) -> Value:
        _floats(name, before)
        return single(n, x) if single and before == np.float32 else _intrinsic(n, name, x)

    return write


def _floats(name: str, dtype: Any) -> None:
    if dtype.kind != "f":
        raise NotImplementedError(f"{name} of {dtype} has no machine code: convert to floats.")


def _both(n: Numbers, dtype: Any, methods: tuple[str, str], x: Value, y: Value) -> Value:
    """Emit an instruction for floats, or the one for integers."""
    x, y = n.alike(x, y)
    return n.operation(f"{methods[0]} {' '.join(FUSED)}" if dtype.kind == "f" else methods[1], x, y)


def _compare(n: Numbers, how: str, dtype: Any, x: Value, y: Value) -> Value:
    if dtype.kind == "b":  # as a signed number, true is -1
        return n.builder.icmp_unsigned(how, x, y)
    if dtype.kind != "f":
        return n.builder.icmp_signed(how, x, y)
    ordered = n.builder.fcmp_unordered if how == "!=" else n.builder.fcmp_ordered
    return ordered(how, x, y)


def converted(n: Numbers, value: Value, before: Any, after: Any) -> Value:
    """Convert a number of `in_dtype` to `out_dtype`."""
    build, kind = n.builder, NUMBERS[after.name]
    kind = n.vector(kind) if isinstance(value.type, ir.VectorType) else kind
    if before == after:
        return value
    if after.kind == "b":
        return _compare(n, "!=", before, value, n.constant(value.type, 0))
    if before.kind == after.kind == "f":
        return (build.fptrunc if after.itemsize < before.itemsize else build.fpext)(value, kind)
    if after.kind == "f":
        return (build.uitofp if before.kind == "b" else build.sitofp)(value, kind)
    if before.kind == "f":
        return build.fptosi(value, kind)
    if before.kind == "b":
        return build.zext(value, kind)
    return (build.trunc if after.itemsize < before.itemsize else build.sext)(value, kind)


def _intrinsic(n: Numbers, name: str, value: Value) -> Value:
    kind = value.type
    vector = isinstance(kind, ir.VectorType)
    number = kind.element if vector else kind
    bits = 64 if number == NUMBERS["float64"] else 32
    whole = f"llvm.{name}.{f'v{kind.count}' if vector else ''}f{bits}"
    module = n.builder.module
    if whole not in module.globals:
        ir.Function(module, ir.FunctionType(kind, [kind]), whole)
    return n.builder.call(module.globals[whole], [value])


def _series(n: Numbers, x: Value, coefficients: Sequence[float]) -> Value:
    """Emit a polynomial, lowest coefficient first."""
    build, value = n.builder, n.constant(x.type, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        product = build.fmul(value, x, flags=FUSED)
        value = build.fadd(product, n.constant(x.type, coefficient), flags=FUSED)
    return value


def _logarithm(n: Numbers, value: Value) -> Value:
    """Emit the logarithm of positive normal float32 numbers, accurate to 1e-5.

    The library's logarithm is one call per lane.
    """
    build, kind = n.builder, value.type
    whole = ir.VectorType(INT, kind.count) if isinstance(kind, ir.VectorType) else INT
    bits = build.bitcast(value, whole)
    number = lambda x: n.constant(whole, x)
    exponent = build.sub(build.ashr(bits, number(23)), number(127))
    mantissa = build.or_(build.and_(bits, number(0x7FFFFF)), number(0x3F800000))
    beyond = build.fsub(build.bitcast(mantissa, kind), n.constant(kind, 1.0))
    return build.fadd(
        build.fmul(build.sitofp(exponent, kind), n.constant(kind, np.log(2.0))),
        _series(n, beyond, LOGARITHM),
    )


def _exponential(n: Numbers, value: Value) -> Value:
    """Emit the exponential of float32 numbers between -87 and 88, accurate to 1e-6 of
    the result.
    """
    build, kind = n.builder, value.type
    whole = ir.VectorType(INT, kind.count) if isinstance(kind, ir.VectorType) else INT
    doublings = build.fmul(value, n.constant(kind, 1.0 / np.log(2.0)))
    floor = _intrinsic(n, "floor", doublings)
    part = _series(n, build.fsub(doublings, floor), POWER_OF_TWO)
    number = lambda x: n.constant(whole, x)
    scale = build.shl(build.add(build.fptosi(floor, whole), number(127)), number(23))
    return build.fmul(part, build.bitcast(scale, kind))


def _is(value: Value, number: int) -> bool:
    """Return whether a value is that constant in every lane."""
    return isinstance(value, ir.Constant) and _all(value.constant, number)


def _all(constant: Any, number: int) -> bool:
    if isinstance(constant, (list, tuple)):
        return all(_all(entry.constant, number) for entry in constant)
    return isinstance(constant, (int, float)) and constant == number


def _fitted(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[float]:
    """Fit a polynomial on [0, 1] through Chebyshev's points, exact at neither end."""
    x = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return list(map(float, np.polynomial.polynomial.polyfit(x, function(x), degree)))


LOGARITHM = _fitted(np.log1p, 5)
POWER_OF_TWO = _fitted(np.exp2, 5)

ELEMENTWISE: dict[str, Rule] = {
    "abs": _abs,
    "add": _add,
    "add_any": _add,
    "and": _bits("and_"),
    "convert_element_type": _convert,
    "copy": _same,
    "cos": _function("cos"),
    "div": _div,
    "eq": _comparison("=="),
    "exp": _function("exp", _exponential),
    "floor": _function("floor"),
    "ge": _comparison(">="),
    "gt": _comparison(">"),
    "integer_pow": _integer_pow,
    "is_finite": _is_finite,
    "le": _comparison("<="),
    "log": _function("log", _logarithm),
    "lt": _comparison("<"),
    "max": _extreme(">"),
    "min": _extreme("<"),
    "mul": _mul,
    "ne": _comparison("!="),
    "neg": _neg,
    "not": _not,
    "or": _bits("or_"),
    "select_n": _select_n,
    "shift_left": _bits("shl"),
    "shift_right_arithmetic": _bits("ashr"),
    "shift_right_logical": _bits("lshr"),
    "sin": _function("sin"),
    "sqrt": _function("sqrt"),
    "square": _square,
    "stop_gradient": _same,
    "sub": _sub,
    "xor": _bits("xor"),
}

"""Arithmetic of JAX's primitives as LLVM's: one number, or one for each of a few lanes.

Whatever repeats itself is computed once. Knows the primitives that elementwise code is made of, and
says so where it meets another.
"""

import contextlib
from collections import ChainMap
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import llvmlite.ir as ir
import numpy as np

Value = Any
"""An LLVM value: a number or a vector of them."""

TRUTH, BYTE, INT, LONG = (ir.IntType(bits) for bits in (1, 8, 32, 64))
NUMBERS = {
    "bool": TRUTH,
    "int32": INT,
    "int64": LONG,
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
}
FUSED = ("contract",)
"""Products and sums may be rounded once instead of twice; nothing else may be reordered."""
RECIPROCAL = (*FUSED, "arcp")
"""Divisors that stay the same may be inverted once: in float64, in float32 processors guess."""

ARITHMETIC = {  # primitive: builder's method for floats and for integers
    "add": ("fadd", "add"),
    "add_any": ("fadd", "add"),
    "sub": ("fsub", "sub"),
    "mul": ("fmul", "mul"),
    "div": ("fdiv", "sdiv"),
}
BITS = {
    "and": "and_",
    "or": "or_",
    "xor": "xor",
    "shift_left": "shl",
    "shift_right_arithmetic": "ashr",
    "shift_right_logical": "lshr",
}
COMPARISONS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
INTRINSICS = {
    "abs": "fabs", "sqrt": "sqrt", "sin": "sin", "cos": "cos", "floor": "floor", "exp": "exp",
    "log": "log",
}  # fmt: skip
SAME = ("stop_gradient", "copy")


class Numbers:
    """Writes arithmetic into a function of `builder`'s module."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        # What was computed before, by operation and operands: traces repeat themselves a lot.
        self.known: ChainMap[tuple, Any] = ChainMap()
        self.constants: dict[tuple[str, str], ir.Constant] = {}

    def vector(self, number: ir.Type) -> ir.VectorType:
        """A number of that type for each lane."""
        return ir.VectorType(number, self.width)

    def constant(self, kind: ir.Type, value: Any) -> ir.Constant:
        """`value` as a constant of that type, the same for all lanes."""
        if isinstance(kind, ir.VectorType):
            return self.spread(self.constant(kind.element, value))
        number = int(value) if isinstance(kind, ir.IntType) else float(value)
        return self.constants.setdefault((str(kind), repr(number)), ir.Constant(kind, number))

    def spread(self, value: Value) -> Value:
        """A number as a vector."""
        if isinstance(value.type, ir.VectorType):
            return value
        kind = self.vector(value.type)
        if isinstance(value, ir.Constant):
            key = (str(kind), str(value))
            if key not in self.constants:
                self.constants[key] = ir.Constant(kind, [value] * kind.count)
            return self.constants[key]
        return self.once(("spread", id(value)), lambda: self._spread(value, kind))

    def _spread(self, value: Value, kind: ir.VectorType) -> Value:
        empty = ir.Constant(kind, ir.Undefined)
        first = self.builder.insert_element(empty, value, ir.Constant(INT, 0))
        order = ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
        return self.builder.shuffle_vector(first, empty, order)

    def once(self, key: tuple, make: Callable[[], Any]) -> Any:
        """Made where it is asked for first. What a key names by `id` must live as long as this."""
        if key not in self.known:
            self.known[key] = make()
        return self.known[key]

    def elementwise(
        self, name: str, params: Any, before: Any, after: Any, values: Sequence[Value]
    ) -> Value:
        """One of JAX's primitives on numbers of type `before`, giving one of `after`."""
        key = (name, after.num, params.get("y"), *map(id, values))
        return self.once(key, lambda: self._elementwise(name, params, before, after, values))

    def _alike(self, *values: Value) -> list[Value]:
        """Vectors where one of them is."""
        if any(isinstance(value.type, ir.VectorType) for value in values):
            return [self.spread(value) for value in values]
        return list(values)

    def _elementwise(
        self, name: str, params: Any, before: Any, after: Any, values: Sequence[Value]
    ) -> Value:
        build, floats = self.builder, before.kind == "f"
        if name in ARITHMETIC:
            return self._arithmetic(name, before, *values)
        if name in BITS or name in COMPARISONS or name in ("max", "min"):
            x, y = self._alike(*values)
            if name in BITS:
                return getattr(build, BITS[name])(x, y)
            if name in COMPARISONS:
                return self._compare(COMPARISONS[name], floats, x, y)
            chosen = build.select(self._compare(">" if name == "max" else "<", floats, x, y), x, y)
            # A NaN on either side is the answer.
            return build.select(build.fcmp_unordered("uno", x, x), x, chosen) if floats else chosen
        if name == "select_n":
            where, *cases = values
            if isinstance(where.type, ir.VectorType):
                cases = [self.spread(case) for case in cases]
            no, yes = self._alike(*cases)
            return build.select(where, yes, no)
        if name in SAME:
            return values[0]
        if name == "convert_element_type":
            return self._converted(values[0], before, after)
        if name == "neg":
            return build.fneg(values[0]) if floats else build.neg(values[0])
        if name == "not":
            return build.not_(values[0])
        if name == "integer_pow":
            return self._power(values[0], params["y"])
        if name == "square":
            return build.fmul(values[0], values[0], flags=FUSED)
        if name in ("exp", "log") and before == np.float32:
            return (self._exponential if name == "exp" else self._logarithm)(values[0])
        if name in INTRINSICS and floats:
            return self._intrinsic(INTRINSICS[name], values[0])
        if name == "is_finite":
            size = self._intrinsic("fabs", values[0])
            return build.fcmp_ordered("<", size, self.constant(size.type, np.inf))
        raise NotImplementedError(f"{name} is not elementwise over lanes.")

    def _arithmetic(self, name: str, dtype: Any, x: Value, y: Value) -> Value:
        """Sums and products, without the terms that are known to be zero and factors one."""
        floats = dtype.kind == "f"
        zero, one = (lambda v, n=n: isinstance(v, ir.Constant) and _is(v, n) for n in (0, 1))
        if name in ("add", "add_any", "sub") and zero(y):
            return x
        if name in ("add", "add_any") and zero(x):
            return y
        if name in ("mul", "div") and one(y):
            return x
        if name == "mul" and one(x):
            return y
        if name == "mul" and (zero(x) or zero(y)):
            return x if zero(x) else y
        flags = RECIPROCAL if name == "div" and dtype == np.float64 else FUSED
        x, y = self._alike(x, y)
        method = ARITHMETIC[name][0 if floats else 1]
        return getattr(self.builder, method)(x, y, **({"flags": flags} if floats else {}))

    def _compare(self, how: str, floats: bool, x: Value, y: Value) -> Value:
        if not floats:
            return self.builder.icmp_signed(how, x, y)
        ordered = self.builder.fcmp_unordered if how == "!=" else self.builder.fcmp_ordered
        return ordered(how, x, y)

    def _converted(self, value: Value, before: Any, after: Any) -> Value:
        build, kind = self.builder, NUMBERS[after.name]
        kind = self.vector(kind) if isinstance(value.type, ir.VectorType) else kind
        if before == after:
            return value
        if after.kind == "b":
            return self._compare("!=", before.kind == "f", value, self.constant(value.type, 0))
        if before.kind == after.kind == "f":
            return (build.fptrunc if after.itemsize < before.itemsize else build.fpext)(value, kind)
        if after.kind == "f":
            return (build.uitofp if before.kind == "b" else build.sitofp)(value, kind)
        if before.kind == "f":
            return build.fptosi(value, kind)
        if before.kind == "b":
            return build.zext(value, kind)
        return (build.trunc if after.itemsize < before.itemsize else build.sext)(value, kind)

    def _power(self, value: Value, exponent: int) -> Value:
        """By repeated squares."""
        times = lambda x, y: self.builder.fmul(x, y, flags=FUSED)
        result, square, left = None, value, abs(exponent)
        while left:
            if left & 1:
                result = square if result is None else times(result, square)
            left >>= 1
            square = times(square, square) if left else square
        one = self.constant(value.type, 1.0)
        result = one if result is None else result
        return self.builder.fdiv(one, result, flags=FUSED) if exponent < 0 else result

    def _intrinsic(self, name: str, value: Value) -> Value:
        kind = value.type
        vector = isinstance(kind, ir.VectorType)
        number = kind.element if vector else kind
        bits = 64 if number == NUMBERS["float64"] else 32
        whole = f"llvm.{name}.{f'v{kind.count}' if vector else ''}f{bits}"
        module = self.builder.module
        if whole not in module.globals:
            ir.Function(module, ir.FunctionType(kind, [kind]), whole)
        return self.builder.call(module.globals[whole], [value])

    def _series(self, x: Value, coefficients: Sequence[float]) -> Value:
        """A polynomial, lowest coefficient first."""
        build, value = self.builder, self.constant(x.type, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            product = build.fmul(value, x, flags=FUSED)
            value = build.fadd(product, self.constant(x.type, coefficient), flags=FUSED)
        return value

    def _logarithm(self, value: Value) -> Value:
        """Of positive normal float32 numbers, right to 1e-5: the library's is a call per lane."""
        build, kind = self.builder, value.type
        whole = ir.VectorType(INT, kind.count) if isinstance(kind, ir.VectorType) else INT
        bits = build.bitcast(value, whole)
        number = lambda x: self.constant(whole, x)
        exponent = build.sub(build.ashr(bits, number(23)), number(127))
        mantissa = build.or_(build.and_(bits, number(0x7FFFFF)), number(0x3F800000))
        beyond = build.fsub(build.bitcast(mantissa, kind), self.constant(kind, 1.0))
        return build.fadd(
            build.fmul(build.sitofp(exponent, kind), self.constant(kind, np.log(2.0))),
            self._series(beyond, LOGARITHM),
        )

    def _exponential(self, value: Value) -> Value:
        """Of float32 numbers between -87 and 88, right to 1e-6 of the result."""
        build, kind = self.builder, value.type
        whole = ir.VectorType(INT, kind.count) if isinstance(kind, ir.VectorType) else INT
        doublings = build.fmul(value, self.constant(kind, 1.0 / np.log(2.0)))
        floor = self._intrinsic("floor", doublings)
        part = self._series(build.fsub(doublings, floor), POWER_OF_TWO)
        number = lambda x: self.constant(whole, x)
        scale = build.shl(build.add(build.fptosi(floor, whole), number(127)), number(23))
        return build.fmul(part, build.bitcast(scale, kind))

    @contextlib.contextmanager
    def inner(self) -> Iterator[None]:
        """What is computed within is not known after."""
        self.known = self.known.new_child()
        yield
        self.known = self.known.parents

    def loop(
        self,
        carried: Sequence[Value],
        goes_on: Callable[[list[Value]], Value],
        body: Callable[[list[Value]], Sequence[Value]],
    ) -> list[Value]:
        """`while goes_on(carried): carried = body(carried)`."""
        build, before = self.builder, self.builder.block
        head, within, after = (build.append_basic_block(name) for name in ("head", "body", "after"))
        build.branch(head)
        build.position_at_end(head)
        values: list[Value] = []
        for value in carried:
            phi = build.phi(value.type)
            phi.add_incoming(value, before)
            values.append(phi)
        with self.inner():
            build.cbranch(goes_on(values), within, after)
            build.position_at_end(within)
            following = body(values)
            for phi, value in zip(values, following, strict=True):
                alike = self.spread(value) if isinstance(phi.type, ir.VectorType) else value
                phi.add_incoming(alike, build.block)
            build.branch(head)
        build.position_at_end(after)
        return values


def _is(constant: ir.Constant, number: int) -> bool:
    """Whether a constant is that number, in every lane."""
    value = constant.constant
    if isinstance(value, (list, tuple)):
        return all(_is(entry, number) for entry in value)
    return isinstance(value, (int, float)) and value == number


def _fitted(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[float]:
    """A polynomial on [0, 1] through Chebyshev's points, exact at neither end."""
    x = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return list(map(float, np.polynomial.polynomial.polyfit(x, function(x), degree)))


LOGARITHM = _fitted(np.log1p, 5)
POWER_OF_TWO = _fitted(np.exp2, 5)

"""From JAX's trace of a function over lanes to LLVM's intermediate language, value by value.

Every array of the function is either one number, the same for all lanes, or one number for each of
`width` lanes, which becomes one LLVM vector. Loops become loops; nothing is ever in memory but what
the compiler can't hold in registers. Knows the primitives that elementwise code is made of, says so
where it meets another.
"""

import contextlib
from collections import ChainMap
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import llvmlite.ir as ir
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

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
CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
SAME = ("stop_gradient", "copy")


class Emitter:
    """Writes what traces say into a function of `builder`'s module."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        # What was computed before, by operation and operands: traces repeat themselves a lot.
        self.known: ChainMap[tuple, list[Value]] = ChainMap()
        self.constants: dict[tuple[str, str], ir.Constant] = {}

    def type_of(self, aval: Any) -> ir.Type:
        """The LLVM type of one of the trace's arrays."""
        if aval.dtype.name not in NUMBERS or aval.shape not in ((), (self.width,)):
            raise NotImplementedError(
                f"{aval.str_short()} is neither a number nor one for each of {self.width} lanes."
            )
        number = NUMBERS[aval.dtype.name]
        return ir.VectorType(number, self.width) if aval.shape else number

    def closed(self, closed: ClosedJaxpr, values: Sequence[Value]) -> list[Value]:
        """The results of a trace for these values."""
        jaxpr = closed.jaxpr
        places: dict[Any, Value] = dict(zip(jaxpr.invars, values, strict=True))
        for variable, value in zip(jaxpr.constvars, closed.consts, strict=True):
            array = np.asarray(value)
            places[variable] = array if array.ndim else self._constant_of(variable.aval, array)

        def read(atom: Any) -> Value:
            if isinstance(atom, Literal):
                return self._constant_of(atom.aval, atom.val)
            return places[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            places.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def constant(self, kind: ir.Type, value: Any) -> ir.Constant:
        """`value` as a constant of that type, the same for all lanes."""
        if isinstance(kind, ir.VectorType):
            return self.spread(self.constant(kind.element, value), kind)
        number = int(value) if isinstance(kind, ir.IntType) else float(value)
        return self.constants.setdefault((str(kind), str(number)), ir.Constant(kind, number))

    def _constant_of(self, aval: Any, value: Any) -> ir.Constant:
        return self.constant(self.type_of(aval), value)

    def spread(self, value: Value, kind: ir.Type) -> Value:
        """A number as a vector, where `kind` is one."""
        if value.type == kind or not isinstance(kind, ir.VectorType):
            return value
        if isinstance(value, ir.Constant):
            key = (str(kind), str(value))
            if key not in self.constants:
                self.constants[key] = ir.Constant(kind, [value] * kind.count)
            return self.constants[key]
        empty = ir.Constant(kind, ir.Undefined)
        first = self.builder.insert_element(empty, value, ir.Constant(INT, 0))
        order = ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
        return self.builder.shuffle_vector(first, empty, order)

    def _equation(self, equation: Any, values: list[Value]) -> list[Value]:
        name, params = equation.primitive.name, equation.params
        if name in CALLS:
            return self.closed(params[CALLS[name]], values)
        if name == "while":
            return self._while(params, values)
        if name == "scan":
            return self._scan(params, values)
        told = {key: str(params[key]) for key in ("new_dtype", "y") if key in params}
        out = equation.outvars[0].aval
        key = (name, *map(id, values), *told.items(), out.shape, out.dtype.name)
        if key in self.known:  # values live as long as their function: no id is given twice
            return self.known[key]
        self.known[key] = [self._elementwise(name, params, equation, values)]
        return self.known[key]

    def _elementwise(self, name: str, params: Any, equation: Any, values: list[Value]) -> Value:
        """One primitive with one result."""
        build, before = self.builder, equation.invars[0].aval.dtype
        floats = before.kind == "f"
        kind = self.type_of(equation.outvars[0].aval)
        if name in ARITHMETIC or name in BITS or name in COMPARISONS or name in ("max", "min"):
            vectors = [x.type for x in values if isinstance(x.type, ir.VectorType)]
            x, y = (self.spread(value, (*vectors, values[0].type)[0]) for value in values)
            if name in ARITHMETIC:
                flags = RECIPROCAL if name == "div" and before == np.float64 else FUSED
                method = ARITHMETIC[name][0 if floats else 1]
                return getattr(build, method)(x, y, **({"flags": flags} if floats else {}))
            if name in BITS:
                return getattr(build, BITS[name])(x, y)
            if name in COMPARISONS:
                return self._compare(COMPARISONS[name], floats, x, y)
            chosen = build.select(self._compare(">" if name == "max" else "<", floats, x, y), x, y)
            # A NaN on either side is the answer.
            return build.select(build.fcmp_unordered("uno", x, x), x, chosen) if floats else chosen
        if name == "select_n":
            where, *cases = values
            no, yes = (self.spread(value, kind) for value in cases)
            return build.select(where, yes, no)
        if name == "broadcast_in_dim":
            return self.spread(values[0], kind)
        if name in SAME:
            return values[0]
        if name == "convert_element_type":
            return self._converted(values[0], before, equation.outvars[0].aval.dtype, kind)
        if name == "neg":
            return build.fneg(values[0]) if floats else build.neg(values[0])
        if name == "not":
            return build.not_(values[0])
        if name == "integer_pow":
            return self._power(values[0], params["y"])
        if name in ("exp", "log") and before == np.float32:
            return (self._exponential if name == "exp" else self._logarithm)(values[0])
        if name in INTRINSICS and floats:
            return self._intrinsic(INTRINSICS[name], values[0])
        if name == "is_finite":
            size = self._intrinsic("fabs", values[0])
            return build.fcmp_ordered("<", size, self.constant(size.type, np.inf))
        if name in ("reduce_or", "reduce_and"):
            bits = build.bitcast(values[0], ir.IntType(self.width))
            if name == "reduce_or":
                return build.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))
            return build.icmp_unsigned("==", bits, ir.Constant(bits.type, -1))
        raise NotImplementedError(f"{name} is not elementwise: {equation}")

    def _compare(self, how: str, floats: bool, x: Value, y: Value) -> Value:
        if not floats:
            return self.builder.icmp_signed(how, x, y)
        ordered = self.builder.fcmp_unordered if how == "!=" else self.builder.fcmp_ordered
        return ordered(how, x, y)

    def _converted(self, value: Value, before: Any, after: Any, kind: ir.Type) -> Value:
        build = self.builder
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
    def _inner(self) -> Iterator[None]:
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
        with self._inner():
            build.cbranch(goes_on(values), within, after)
            build.position_at_end(within)
            following = body(values)
            for phi, value in zip(values, following, strict=True):
                phi.add_incoming(self.spread(value, phi.type), build.block)
            build.branch(head)
        build.position_at_end(after)
        return values

    def _while(self, params: Any, values: list[Value]) -> list[Value]:
        n_goes, n_body = params["cond_nconsts"], params["body_nconsts"]
        fixed, own = values[:n_goes], values[n_goes : n_goes + n_body]
        return self.loop(
            values[n_goes + n_body :],
            lambda carried: self.closed(params["cond_jaxpr"], [*fixed, *carried])[0],
            lambda carried: self.closed(params["body_jaxpr"], [*own, *carried]),
        )

    def _scan(self, params: Any, values: list[Value]) -> list[Value]:
        """A loop of known length over constants, one number for each turn; nothing is stacked."""
        n_fixed, n_carried = params["num_consts"], params["num_carry"]
        fixed, carried = values[:n_fixed], values[n_fixed : n_fixed + n_carried]
        tables = [self._table(np.asarray(x)) for x in values[n_fixed + n_carried :]]
        end = ir.Constant(LONG, params["length"])

        def turn(state: list[Value]) -> list[Value]:
            count, *rest = state
            given = [self._entry(table, count) for table in tables]
            following = self.closed(params["jaxpr"], [*fixed, *rest, *given])
            return [self.builder.add(count, ir.Constant(LONG, 1)), *following]

        goes_on = lambda state: self.builder.icmp_signed("<", state[0], end)
        return self.loop([ir.Constant(LONG, 0), *carried], goes_on, turn)[1:]

    def _table(self, array: np.ndarray) -> ir.GlobalVariable:
        kind = ir.ArrayType(NUMBERS[array.dtype.name], len(array))
        module = self.builder.module
        table = ir.GlobalVariable(module, kind, module.get_unique_name("table"))
        table.initializer = ir.Constant(kind, [self.constant(kind.element, x) for x in array])
        table.global_constant, table.linkage = True, "internal"
        return table

    def _entry(self, table: ir.GlobalVariable, index: Value) -> Value:
        kind = table.value_type
        place = self.builder.gep(table, [ir.Constant(LONG, 0), index], source_etype=kind)
        return self.builder.load(place, typ=kind.element)


def _fitted(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[float]:
    """A polynomial on [0, 1] through Chebyshev's points, exact at neither end."""
    x = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return list(map(float, np.polynomial.polynomial.polyfit(x, function(x), degree)))


LOGARITHM = _fitted(np.log1p, 5)
POWER_OF_TWO = _fitted(np.exp2, 5)

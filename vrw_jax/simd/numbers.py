"""Emission of LLVM values: scalars or vectors with one entry per lane, known values, and loops.

Repeated computations are emitted once.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import llvmlite.ir as ir

Value = Any
"""An LLVM value: a scalar or a vector of lanes."""

TRUTH, BYTE, INT, LONG = (ir.IntType(bits) for bits in (1, 8, 32, 64))
NUMBERS = {
    "bool": TRUTH,
    "int32": INT,
    "int64": LONG,
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
}


class Operation:
    """An instruction on two values of one type.

    Most of a program consists of these; llvmlite's own instructions, which can be changed later,
    take six times as long to create and to write.
    """

    __slots__ = ("name", "text", "type")

    def __init__(self, name: str, kind: ir.Type, text: str) -> None:
        self.name, self.type, self.text = name, kind, text

    def get_reference(self) -> str:
        """Return the name by which other instructions refer to it."""
        return self.name

    def __str__(self) -> str:
        return self.text


class _Repeated(ir.Constant):
    """A constant that is the same for all lanes, written once."""

    def _get_reference(self) -> str:
        return f"splat ({self.constant[0]})"


class Numbers:
    """Emitter of values into a function of `builder`'s module."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        # Values computed so far, by operation and operands: traces contain many repetitions.
        self.known: dict[tuple, Any] = {}
        self.lately: list[tuple] = []  # keys of the values emitted within the present inner context
        self.operations = 0
        self.constants: dict[tuple[str, str], ir.Constant] = {}

    def vector(self, number: ir.Type) -> ir.VectorType:
        """Return the type of a vector with a number of that type for each lane."""
        return ir.VectorType(number, self.width)

    def constant(self, kind: ir.Type, value: Any) -> ir.Constant:
        """Return `value` as a constant of that type, the same for all lanes."""
        if isinstance(kind, ir.VectorType):
            return self.spread(self.constant(kind.element, value))
        number = int(value) if isinstance(kind, ir.IntType) else float(value)
        return self.constants.setdefault((str(kind), repr(number)), ir.Constant(kind, number))

    def spread(self, value: Value) -> Value:
        """Return a scalar as a vector with equal entries."""
        if isinstance(value.type, ir.VectorType):
            return value
        kind = self.vector(value.type)
        if isinstance(value, ir.Constant):
            key = (str(kind), str(value))
            if key not in self.constants:
                self.constants[key] = _Repeated(kind, [value] * kind.count)
            return self.constants[key]
        return self.once(("spread", id(value)), lambda: self._spread(value, kind))

    def _spread(self, value: Value, kind: ir.VectorType) -> Value:
        empty = ir.Constant(kind, ir.Undefined)
        first = self.builder.insert_element(empty, value, ir.Constant(INT, 0))
        order = ir.Constant(ir.VectorType(INT, kind.count), [0] * kind.count)
        return self.builder.shuffle_vector(first, empty, order)

    def once(self, key: tuple, make: Callable[[], Any]) -> Any:
        """Return the value under this key, which `make` creates on the first call.

        An object that a key identifies by `id` must live as long as this emitter.
        """
        if key not in self.known:
            self.known[key] = make()
            self.lately.append(key)
        return self.known[key]

    def operation(self, what: str, x: Value, y: Value) -> Operation:
        """Emit an instruction on two values of the same type, with a result of that type."""
        self.operations += 1
        name, kind = f"%o{self.operations}", x.type
        text = f"{name} = {what} {kind} {x.get_reference()}, {y.get_reference()}"
        made = Operation(name, kind, text)
        self.builder._insert(made)
        return made

    def alike(self, *values: Value) -> list[Value]:
        """Return the values as vectors if one of them is a vector."""
        if any(isinstance(value.type, ir.VectorType) for value in values):
            return [self.spread(value) for value in values]
        return list(values)

    @contextlib.contextmanager
    def inner(self) -> Iterator[None]:
        """Discard the values computed within the context, at its end."""
        before, self.lately = self.lately, []
        yield
        for key in self.lately:
            del self.known[key]
        self.lately = before

    def loop(
        self,
        carried: Sequence[Value],
        goes_on: Callable[[list[Value]], Value],
        body: Callable[[list[Value]], Sequence[Value]],
    ) -> list[Value]:
        """Emit a loop, `while emit_condition(values): values = emit_body(values)`."""
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

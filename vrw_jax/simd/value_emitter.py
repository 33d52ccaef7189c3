"""Emission of LLVM values: scalars or vectors with one entry per lane, known values, and loops.

Repeated computations are emitted once.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from vrw_jax.simd.llvm_library import ir

Value = Any
"""An LLVM value: a scalar or a vector of lanes."""

I1, I8, I32, I64 = (ir.IntType(bits) for bits in (1, 8, 32, 64))
NUMBER_TYPES = {
    "bool": I1,
    "int32": I32,
    "int64": I64,
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
}


class BinaryInstruction:
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


class _SplatConstant(ir.Constant):
    """A constant that is the same for all lanes, written once."""

    def _get_reference(self) -> str:
        return f"splat ({self.constant[0]})"


class ValueEmitter:
    """Emitter of values into a function of `builder`'s module."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        # Values computed so far, by operation and operands: traces contain many repetitions.
        self.known_values: dict[tuple, Any] = {}
        self.recent_keys: list[
            tuple
        ] = []  # keys of the values emitted within the present inner context
        self.n_operations = 0
        self.constants: dict[tuple[str, str], ir.Constant] = {}

    def vector_type(self, number: ir.Type) -> ir.VectorType:
        """Return the type of a vector with a number of that type for each lane."""
        return ir.VectorType(number, self.width)

    def constant(self, kind: ir.Type, value: Any) -> ir.Constant:
        """Return `value` as a constant of that type, the same for all lanes."""
        if isinstance(kind, ir.VectorType):
            return self.splat(self.constant(kind.element, value))
        number = int(value) if isinstance(kind, ir.IntType) else float(value)
        return self.constants.setdefault((str(kind), repr(number)), ir.Constant(kind, number))

    def splat(self, value: Value) -> Value:
        """Return a scalar as a vector with equal entries."""
        if isinstance(value.type, ir.VectorType):
            return value
        kind = self.vector_type(value.type)
        if isinstance(value, ir.Constant):
            key = (str(kind), str(value))
            if key not in self.constants:
                self.constants[key] = _SplatConstant(kind, [value] * kind.count)
            return self.constants[key]
        return self.emit_once(("spread", id(value)), lambda: self._emit_splat(value, kind))

    def _emit_splat(self, value: Value, kind: ir.VectorType) -> Value:
        """Emit a vector whose entries equal a scalar."""
        empty = ir.Constant(kind, ir.Undefined)
        first_lane_set = self.builder.insert_element(empty, value, ir.Constant(I32, 0))
        order = ir.Constant(ir.VectorType(I32, kind.count), [0] * kind.count)
        return self.builder.shuffle_vector(first_lane_set, empty, order)

    def emit_once(self, key: tuple, make: Callable[[], Any]) -> Any:
        """Return the value under this key, which `make` creates on the first call.

        An object that a key identifies by `id` must live as long as this emitter.
        """
        if key not in self.known_values:
            self.known_values[key] = make()
            self.recent_keys.append(key)
        return self.known_values[key]

    def emit_binary(self, opcode: str, x: Value, y: Value) -> BinaryInstruction:
        """Emit an instruction on two values of the same type, with a result of that type."""
        self.n_operations += 1
        name, kind = f"%o{self.n_operations}", x.type
        text = f"{name} = {opcode} {kind} {x.get_reference()}, {y.get_reference()}"
        instruction = BinaryInstruction(name, kind, text)
        self.builder._insert(instruction)
        return instruction

    def to_same_shape(self, *values: Value) -> list[Value]:
        """Return the values as vectors if one of them is a vector."""
        if any(isinstance(value.type, ir.VectorType) for value in values):
            return [self.splat(value) for value in values]
        return list(values)

    @contextlib.contextmanager
    def discard_inner_values(self) -> Iterator[None]:
        """Discard the values computed within the context, at its end."""
        outer_keys, self.recent_keys = self.recent_keys, []
        yield
        for key in self.recent_keys:
            del self.known_values[key]
        self.recent_keys = outer_keys

    def emit_loop(
        self,
        initial_values: Sequence[Value],
        emit_condition: Callable[[list[Value]], Value],
        emit_body: Callable[[list[Value]], Sequence[Value]],
    ) -> list[Value]:
        """Emit a loop, `while emit_condition(values): values = emit_body(values)`."""
        build, entry_block = self.builder, self.builder.block
        head_block, body_block, exit_block = (
            build.append_basic_block(name) for name in ("head", "body", "after")
        )
        build.branch(head_block)
        build.position_at_end(head_block)
        values: list[Value] = []
        for value in initial_values:
            phi = build.phi(value.type)
            phi.add_incoming(value, entry_block)
            values.append(phi)
        with self.discard_inner_values():
            build.cbranch(emit_condition(values), body_block, exit_block)
            build.position_at_end(body_block)
            next_values = emit_body(values)
            for phi, value in zip(values, next_values, strict=True):
                next_value = self.splat(value) if isinstance(phi.type, ir.VectorType) else value
                phi.add_incoming(next_value, build.block)
            build.branch(head_block)
        build.position_at_end(exit_block)
        return values

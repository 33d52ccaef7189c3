"""Emission of LLVM values: scalars, vectors with one entry per lane, constants, and loops.

Instructions that repeat an earlier computation are not emitted again.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from vrw_jax.simd.llvm_library import ir

Value = Any
"""An LLVM value: a scalar, or a vector with one entry per lane."""

I1, I8, I32, I64 = (ir.IntType(bits) for bits in (1, 8, 32, 64))
NUMBER_TYPES = {
    "bool": I1,
    "int32": I32,
    "int64": I64,
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
}


class BinaryInstruction:
    """An LLVM instruction on two values of one type.

    Most of a program consists of these. llvmlite's own instructions take six times as long to
    create and to write, because they can be changed later.
    """

    __slots__ = ("name", "text", "type")

    def __init__(self, name: str, llvm_type: ir.Type, text: str) -> None:
        self.name, self.type, self.text = name, llvm_type, text

    def get_reference(self) -> str:
        """Return the name by which other instructions refer to the result."""
        return self.name

    def __str__(self) -> str:
        return self.text


class _SplatConstant(ir.Constant):
    """An LLVM constant that is the same for all lanes, written once in LLVM's text."""

    def _get_reference(self) -> str:
        return f"splat ({self.constant[0]})"


class ValueEmitter:
    """Emitter of LLVM values into the function of `builder`; a vector has `width` lanes."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        # Values computed so far, by operation and operands, because traces contain many
        # repetitions.
        self.known_values: dict[tuple, Any] = {}
        self.recent_keys: list[
            tuple
        ] = []  # Keys of the values emitted within the present inner context.
        self.n_operations = 0
        self.constants: dict[tuple[str, str], ir.Constant] = {}

    def vector_type(self, number: ir.Type) -> ir.VectorType:
        """Return the LLVM type of a vector with one number of type `number` per lane."""
        return ir.VectorType(number, self.width)

    def constant(self, llvm_type: ir.Type, value: Any) -> ir.Constant:
        """Return the LLVM constant `value` of this type, the same for all lanes."""
        if isinstance(llvm_type, ir.VectorType):
            return self.splat(self.constant(llvm_type.element, value))
        number = int(value) if isinstance(llvm_type, ir.IntType) else float(value)
        return self.constants.setdefault(
            (str(llvm_type), repr(number)), ir.Constant(llvm_type, number)
        )

    def splat(self, value: Value) -> Value:
        """Return a scalar as a vector whose entries all equal it; a vector is returned
        unchanged.
        """
        if isinstance(value.type, ir.VectorType):
            return value
        scalar_type = self.vector_type(value.type)
        if isinstance(value, ir.Constant):
            key = (str(scalar_type), str(value))
            if key not in self.constants:
                self.constants[key] = _SplatConstant(scalar_type, [value] * scalar_type.count)
            return self.constants[key]
        return self.emit_once(("spread", id(value)), lambda: self._emit_splat(value, scalar_type))

    def _emit_splat(self, value: Value, scalar_type: ir.VectorType) -> Value:
        """Emit a vector whose entries equal a scalar, and return it."""
        undefined_vector = ir.Constant(scalar_type, ir.Undefined)
        first_lane_set = self.builder.insert_element(undefined_vector, value, ir.Constant(I32, 0))
        lane_order = ir.Constant(ir.VectorType(I32, scalar_type.count), [0] * scalar_type.count)
        return self.builder.shuffle_vector(first_lane_set, undefined_vector, lane_order)

    def emit_once(self, key: tuple, create_value: Callable[[], Any]) -> Any:
        """Return the value stored under this key; on the first call `create_value` creates it.

        An object that a key identifies by `id` must live as long as this emitter.
        """
        if key not in self.known_values:
            self.known_values[key] = create_value()
            self.recent_keys.append(key)
        return self.known_values[key]

    def emit_binary(self, opcode: str, x: Value, y: Value) -> BinaryInstruction:
        """Emit an instruction on two values of the same type, and return its result, which has that
        type.
        """
        self.n_operations += 1
        name, llvm_type = f"%o{self.n_operations}", x.type
        text = f"{name} = {opcode} {llvm_type} {x.get_reference()}, {y.get_reference()}"
        instruction = BinaryInstruction(name, llvm_type, text)
        self.builder._insert(instruction)
        return instruction

    def to_same_shape(self, *values: Value) -> list[Value]:
        """Return the values as vectors if one of them is a vector, else unchanged."""
        if any(isinstance(value.type, ir.VectorType) for value in values):
            return [self.splat(value) for value in values]
        return list(values)

    @contextlib.contextmanager
    def discard_inner_values(self) -> Iterator[None]:
        """Return a context at whose end the values computed within it are discarded."""
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
        """Emit a loop, `while emit_condition(values): values = emit_body(values)`, and return the
        last values.
        """
        builder, entry_block = self.builder, self.builder.block
        head_block, body_block, exit_block = (
            builder.append_basic_block(name) for name in ("head", "body", "after")
        )
        builder.branch(head_block)
        builder.position_at_end(head_block)
        values: list[Value] = []
        for value in initial_values:
            phi = builder.phi(value.type)
            phi.add_incoming(value, entry_block)
            values.append(phi)
        with self.discard_inner_values():
            builder.cbranch(emit_condition(values), body_block, exit_block)
            builder.position_at_end(body_block)
            new_values = emit_body(values)
            for phi, value in zip(values, new_values, strict=True):
                new_value = self.splat(value) if isinstance(phi.type, ir.VectorType) else value
                phi.add_incoming(new_value, builder.block)
            builder.branch(head_block)
        builder.position_at_end(exit_block)
        return values

"""Emission of LLVM values: scalars, vectors with one entry per lane, constants, and loops.

Instructions that repeat an earlier computation are not emitted again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vrw_jax.lanes.llvm_library import ir

LlvmValue = Any
"""An LLVM value: a scalar, or a vector with one entry per lane."""

I1, I8, I32, I64 = (ir.IntType(n_bits) for n_bits in (1, 8, 32, 64))
LLVM_NUMBER_TYPES = {
    "bool": I1,
    "int32": I32,
    "int64": I64,
    "float32": ir.FloatType(),
    "float64": ir.DoubleType(),
}
LLVM_COMPARISONS = {"<": "lt", "<=": "le", ">": "gt", ">=": "ge", "==": "eq", "!=": "ne"}


@dataclass(slots=True, eq=False)
class LlvmInstruction:
    """LLVM instruction as text.

    Most instructions of a program are of this class. llvmlite's own instructions can be changed
    later, so they take six times as long to create and to write.
    """

    name: str  # name of the result
    type: ir.Type
    text: str

    def get_reference(self) -> str:
        """Return the name by which other instructions refer to the result of this instruction."""
        return self.name

    def __str__(self) -> str:
        return self.text


class TextBuilder(ir.IRBuilder):
    """Builder of LLVM instructions that writes the frequent ones as text at once."""

    n_results = 0

    def emit(self, result_type: ir.Type, text: str) -> LlvmInstruction:
        """Append an instruction, given without the name of its result, and return it."""
        self.n_results += 1
        name = f"%o{self.n_results}"
        instruction = LlvmInstruction(name, result_type, f"{name} = {text}")
        self._insert(instruction)
        return instruction

    def emit_binary(
        self, opcode: str, x: LlvmValue, y: LlvmValue, result_type: ir.Type = None
    ) -> LlvmInstruction:
        """Append an instruction with operands of one type, which its result has by default."""
        text = f"{opcode} {x.type} {x.get_reference()}, {y.get_reference()}"
        return self.emit(result_type or x.type, text)

    def emit_comparison(self, opcode: str, x: LlvmValue, y: LlvmValue) -> LlvmInstruction:
        """Append a comparison of operands of one type, whose results are truth values."""
        is_vector = isinstance(x.type, ir.VectorType)
        return self.emit_binary(opcode, x, y, ir.VectorType(I1, x.type.count) if is_vector else I1)

    def select(self, condition: LlvmValue, x: LlvmValue, y: LlvmValue) -> LlvmInstruction:
        operands = [f"{value.type} {value.get_reference()}" for value in (condition, x, y)]
        return self.emit(x.type, f"select {', '.join(operands)}")

    def gep(
        self, pointer: LlvmValue, indices: Sequence[LlvmValue], source_etype: ir.Type
    ) -> LlvmInstruction:
        (index,) = indices
        text = f"ptr {pointer.get_reference()}, {index.type} {index.get_reference()}"
        return self.emit(ir.PointerType(), f"getelementptr {source_etype}, {text}")

    def load(self, pointer: LlvmValue, typ: ir.Type, align: int | None = None) -> LlvmInstruction:
        suffix = f", align {align}" if align else ""
        return self.emit(typ, f"load {typ}, ptr {pointer.get_reference()}{suffix}")


class _LlvmSplatConstant(ir.Constant):
    """LLVM vector constant with one number for all lanes, which the LLVM text contains once."""

    def _get_reference(self) -> str:
        return f"splat ({self.constant[0]})"


class ValueEmitter:
    """Emitter of LLVM values into the function of `llvm_builder`.

    An LLVM vector has `n_vector_lanes` lanes.
    """

    def __init__(self, llvm_builder: ir.IRBuilder, n_vector_lanes: int) -> None:
        self.llvm_builder, self.n_vector_lanes = llvm_builder, n_vector_lanes
        # Values computed so far, by operation and operands, because traces contain many
        # repetitions.
        self.emitted_values: dict[tuple, Any] = {}
        # Keys of the values emitted within the innermost loop.
        self.recent_value_keys: list[tuple] = []
        self.llvm_constants: dict[tuple[str, str], ir.Constant] = {}

    def make_vector_type(self, llvm_number_type: ir.Type) -> ir.VectorType:
        """Return the LLVM type of a vector with one number of type `llvm_number_type` per lane."""
        return ir.VectorType(llvm_number_type, self.n_vector_lanes)

    def make_llvm_constant(self, llvm_type: ir.Type, constant_value: Any) -> ir.Constant:
        """Return an LLVM constant of type `llvm_type` that equals `constant_value` in all lanes."""
        if isinstance(llvm_type, ir.VectorType):
            return self.to_lane_vector(self.make_llvm_constant(llvm_type.element, constant_value))
        python_number = (
            int(constant_value) if isinstance(llvm_type, ir.IntType) else float(constant_value)
        )
        constant_key = (str(llvm_type), repr(python_number))
        if constant_key not in self.llvm_constants:
            self.llvm_constants[constant_key] = ir.Constant(llvm_type, python_number)
        return self.llvm_constants[constant_key]

    def to_lane_vector(self, scalar_value: LlvmValue) -> LlvmValue:
        """Return a vector whose entries all equal the LLVM value `scalar_value`.

        A vector is returned unchanged.
        """
        if isinstance(scalar_value.type, ir.VectorType):
            return scalar_value
        llvm_vector_type = self.make_vector_type(scalar_value.type)
        if isinstance(scalar_value, ir.Constant):
            constant_key = (str(llvm_vector_type), str(scalar_value))
            if constant_key not in self.llvm_constants:
                self.llvm_constants[constant_key] = _LlvmSplatConstant(
                    llvm_vector_type, [scalar_value] * llvm_vector_type.count
                )
            return self.llvm_constants[constant_key]

        def emit_splat_vector() -> LlvmValue:
            undefined_vector = ir.Constant(llvm_vector_type, ir.Undefined)
            vector_with_first_lane = self.llvm_builder.insert_element(
                undefined_vector, scalar_value, ir.Constant(I32, 0)
            )
            zero_shuffle_mask = ir.Constant(
                ir.VectorType(I32, llvm_vector_type.count), [0] * llvm_vector_type.count
            )
            return self.llvm_builder.shuffle_vector(
                vector_with_first_lane, undefined_vector, zero_shuffle_mask
            )

        return self.emit_value_once(("spread", id(scalar_value)), emit_splat_vector)

    def emit_value_once(self, value_key: tuple, create_llvm_value: Callable[[], Any]) -> Any:
        """Return the value stored under `value_key`; on the first call, `create_llvm_value` creates
        it.

        An object that a key identifies by `id` must live as long as this emitter.
        """
        if value_key not in self.emitted_values:
            self.emitted_values[value_key] = create_llvm_value()
            self.recent_value_keys.append(value_key)
        return self.emitted_values[value_key]

    def to_scalars_or_vectors(self, *llvm_values: LlvmValue) -> list[LlvmValue]:
        """Return all LLVM values as vectors if one of them is a vector, else unchanged."""
        if any(isinstance(llvm_value.type, ir.VectorType) for llvm_value in llvm_values):
            return [self.to_lane_vector(llvm_value) for llvm_value in llvm_values]
        return list(llvm_values)

    def emit_llvm_loop(
        self,
        initial_loop_values: Sequence[LlvmValue],
        emit_loop_condition: Callable[[list[LlvmValue]], LlvmValue],
        emit_loop_body: Callable[[list[LlvmValue]], Sequence[LlvmValue]],
    ) -> list[LlvmValue]:
        """Emit a loop that carries LLVM values, and return these values after the last iteration.

        The loop is `while emit_loop_condition(values): values = emit_loop_body(values)`.
        """
        llvm_builder, entry_basic_block = self.llvm_builder, self.llvm_builder.block
        head_basic_block, body_basic_block, exit_basic_block = (
            llvm_builder.append_basic_block(basic_block_name)
            for basic_block_name in ("head", "body", "after")
        )
        llvm_builder.branch(head_basic_block)
        llvm_builder.position_at_end(head_basic_block)
        loop_carried_values: list[LlvmValue] = []
        for initial_loop_value in initial_loop_values:
            phi_instruction = llvm_builder.phi(initial_loop_value.type)
            phi_instruction.add_incoming(initial_loop_value, entry_basic_block)
            loop_carried_values.append(phi_instruction)
        outer_value_keys, self.recent_value_keys = self.recent_value_keys, []
        llvm_builder.cbranch(
            emit_loop_condition(loop_carried_values), body_basic_block, exit_basic_block
        )
        llvm_builder.position_at_end(body_basic_block)
        next_loop_values = emit_loop_body(loop_carried_values)
        for phi_instruction, next_loop_value in zip(
            loop_carried_values, next_loop_values, strict=True
        ):
            phi_instruction.add_incoming(
                self.to_lane_vector(next_loop_value)
                if isinstance(phi_instruction.type, ir.VectorType)
                else next_loop_value,
                llvm_builder.block,
            )
        llvm_builder.branch(head_basic_block)
        # Code after the loop cannot use values that were emitted inside it.
        for recent_value_key in self.recent_value_keys:
            del self.emitted_values[recent_value_key]
        self.recent_value_keys = outer_value_keys
        llvm_builder.position_at_end(exit_basic_block)
        return loop_carried_values

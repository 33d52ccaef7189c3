"""Emission of LLVM values: scalars, vectors with one entry per lane, constants, loops, and rules of
elementwise JAX primitives, in the table `ELEMENTWISE_RULES`.

Instructions that repeat an earlier computation are not emitted again. A rule takes an
`ElementwiseOperation` and the LLVM values of its operands. It returns the LLVM value of the result.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.lanes.llvm import LlvmValue, ir

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

    @property
    def llvm_builder(self) -> TextBuilder:
        """Return the builder that appends LLVM instructions."""
        return self.value_emitter.llvm_builder


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


def emit_sum(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the sum x + y and return its LLVM value. A constant operand 0 needs no instruction."""
    if _equals_llvm_constant(y, 0):
        return x
    if _equals_llvm_constant(x, 0):
        return y
    return _emit_number_instruction("add", operation, x, y)


def emit_difference(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the difference x - y and return its LLVM value. A constant y = 0 needs no
    instruction.
    """
    if _equals_llvm_constant(y, 0):
        return x
    return _emit_number_instruction("sub", operation, x, y)


def emit_product(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the product x * y and return its LLVM value. A constant factor 0 or 1 needs no
    instruction.
    """
    if _equals_llvm_constant(y, 1) or _equals_llvm_constant(x, 0):
        return x
    if _equals_llvm_constant(x, 1) or _equals_llvm_constant(y, 0):
        return y
    return _emit_number_instruction("mul", operation, x, y)


def emit_quotient(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the quotient x / y of two floats and return its LLVM value."""
    # An integer division by zero would stop the process.
    _require_float_dtype("div", operation)
    if _equals_llvm_constant(y, 1):
        return x
    has_float64 = operation.operand_dtype == np.float64
    flags = RECIPROCAL_DIVISION_FLAGS if has_float64 else FUSED_MULTIPLY_ADD_FLAGS
    return emit_binary_instruction(f"fdiv {' '.join(flags)}", operation, x, y)


def emit_remainder(operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue) -> LlvmValue:
    """Emit the remainder of x / y, which has the sign of x, and return its LLVM value."""
    if operation.operand_dtype.kind == "f":
        return emit_binary_instruction("frem", operation, x, y)
    # A division by zero, or of the least integer by -1, would stop the process.
    x, y = operation.value_emitter.to_scalars_or_vectors(x, y)
    builder, emit_constant = operation.llvm_builder, operation.value_emitter.make_llvm_constant
    zero, one, minus_one = (emit_constant(y.type, number) for number in (0, 1, -1))
    is_zero = builder.emit_comparison("icmp eq", y, zero)
    is_minus_one = builder.emit_comparison("icmp eq", y, minus_one)
    divisor = builder.select(is_zero, one, builder.select(is_minus_one, one, y))
    return builder.select(is_zero, x, builder.emit_binary("srem", x, divisor))


def emit_integer_power(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the power of `x` with a constant integer exponent by repeated squaring, and return its
    LLVM value.
    """
    exponent = operation.primitive_params["y"]
    one_constant = operation.value_emitter.make_llvm_constant(x.type, 1)
    partial_power, repeated_square = one_constant, x
    for i, exponent_bit in enumerate(reversed(f"{abs(exponent):b}")):
        if i:
            repeated_square = emit_product(operation, repeated_square, repeated_square)
        if exponent_bit == "1":
            partial_power = emit_product(operation, partial_power, repeated_square)
    if exponent >= 0:
        return partial_power
    return operation.llvm_builder.fdiv(one_constant, partial_power, flags=FUSED_MULTIPLY_ADD_FLAGS)


def emit_negative(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit -x and return its LLVM value."""
    llvm_builder = operation.llvm_builder
    return (llvm_builder.fneg if operation.operand_dtype.kind == "f" else llvm_builder.neg)(x)


def emit_absolute_value(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the absolute value of `x` and return its LLVM value."""
    if operation.operand_dtype.kind == "f":
        return _emit_intrinsic_call(operation, "fabs", x)
    zero_constant = operation.value_emitter.make_llvm_constant(x.type, 0)
    is_negative_value = emit_comparison("<", operation, x, zero_constant)
    return operation.llvm_builder.select(is_negative_value, operation.llvm_builder.neg(x), x)


def emit_binary_instruction(
    opcode: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit an instruction with two operands, and return its LLVM value."""
    return operation.llvm_builder.emit_binary(
        opcode, *operation.value_emitter.to_scalars_or_vectors(x, y)
    )


def emit_comparison(
    comparison_operator: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the comparison of two operands, and return the LLVM truth value.

    `comparison_operator` is an operator such as "<".
    """
    number_kind, relation = operation.operand_dtype.kind, LLVM_COMPARISONS[comparison_operator]
    if number_kind == "f":  # NaN differs from every number.
        opcode = f"fcmp {'u' if relation == 'ne' else 'o'}{relation}"
    elif relation in ("eq", "ne"):
        opcode = f"icmp {relation}"
    else:  # The signed value of true would be -1.
        opcode = f"icmp {'u' if number_kind == 'b' else 's'}{relation}"
    operands = operation.value_emitter.to_scalars_or_vectors(x, y)
    return operation.llvm_builder.emit_comparison(opcode, *operands)


def emit_extremum(
    comparison_operator: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit the maximum (operator ">") or the minimum ("<") of two operands, and return its LLVM
    value.
    """
    x, y = operation.value_emitter.to_scalars_or_vectors(x, y)
    llvm_builder = operation.llvm_builder
    extremum = llvm_builder.select(emit_comparison(comparison_operator, operation, x, y), x, y)
    if operation.operand_dtype.kind != "f":
        return extremum
    # The result is NaN if either operand is NaN.
    return llvm_builder.select(llvm_builder.emit_comparison("fcmp uno", x, x), x, extremum)


def emit_select(
    operation: ElementwiseOperation, lane_condition: LlvmValue, *case_values: LlvmValue
) -> LlvmValue:
    """Emit the selection of the first case where the condition is false, and of the second where it
    is true.

    Return the LLVM value that contains the selected case of each lane.
    """
    if (
        all(_equals_llvm_constant(case_value, 0) for case_value in case_values)
        or case_values[0] is case_values[1]
    ):
        return case_values[0]
    value_emitter = operation.value_emitter
    if isinstance(lane_condition.type, ir.VectorType):
        case_values = tuple(map(value_emitter.to_lane_vector, case_values))
    false_case, true_case = value_emitter.to_scalars_or_vectors(*case_values)
    return operation.llvm_builder.select(lane_condition, true_case, false_case)


def emit_finiteness_test(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the test whether |x| < infinity, and return its LLVM truth value."""
    infinity = operation.value_emitter.make_llvm_constant(x.type, np.inf)
    return emit_comparison("<", operation, _emit_intrinsic_call(operation, "fabs", x), infinity)


def emit_float_function(
    intrinsic_function_name: str, operation: ElementwiseOperation, x: LlvmValue
) -> LlvmValue:
    """Emit a function of a float, such as "sqrt", and return its LLVM value.

    The function is one of LLVM's intrinsic functions.
    """
    _require_float_dtype(intrinsic_function_name, operation)
    return _emit_intrinsic_call(operation, intrinsic_function_name, x)


def _require_float_dtype(primitive_name: str, operation: ElementwiseOperation) -> None:
    """Raise a NotImplementedError unless the operand's type is a float type."""
    if operation.operand_dtype.kind != "f":
        raise NotImplementedError(
            f"{primitive_name} of {operation.operand_dtype} has no machine code: convert to floats."
        )


def _emit_number_instruction(
    integer_opcode: str, operation: ElementwiseOperation, x: LlvmValue, y: LlvmValue
) -> LlvmValue:
    """Emit an instruction with two operands and return its LLVM value.

    The opcode for integers is `integer_opcode`, such as "add". The opcode for floats is "fadd".
    """
    is_float = operation.operand_dtype.kind == "f"
    llvm_opcode = (
        f"f{integer_opcode} {' '.join(FUSED_MULTIPLY_ADD_FLAGS)}" if is_float else integer_opcode
    )
    return emit_binary_instruction(llvm_opcode, operation, x, y)


def emit_bits(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the number of the result's type that has the same bits, and return its LLVM value."""
    if operation.operand_dtype.itemsize != operation.result_dtype.itemsize:
        raise NotImplementedError(
            f"the bits of {operation.operand_dtype} as {operation.result_dtype} have no machine "
            "code: take types of the same size."
        )
    llvm_type = LLVM_NUMBER_TYPES[operation.result_dtype.name]
    if isinstance(x.type, ir.VectorType):
        llvm_type = operation.value_emitter.make_vector_type(llvm_type)
    return operation.llvm_builder.bitcast(x, llvm_type)


def emit_conversion(operation: ElementwiseOperation, x: LlvmValue) -> LlvmValue:
    """Emit the conversion of `x` to the type of the result, and return its LLVM value."""
    value_emitter, operand_dtype, result_dtype = (
        operation.value_emitter,
        operation.operand_dtype,
        operation.result_dtype,
    )
    if operand_dtype == result_dtype:
        return x
    if result_dtype.kind == "b":
        return emit_comparison("!=", operation, x, value_emitter.make_llvm_constant(x.type, 0))
    is_result_smaller = result_dtype.itemsize < operand_dtype.itemsize
    builder_method_name = {
        "ff": "fptrunc" if is_result_smaller else "fpext",
        "bf": "uitofp",
        "if": "sitofp",
        "fi": "fptosi",
        "bi": "zext",
        "ii": "trunc" if is_result_smaller else "sext",
    }[operand_dtype.kind + result_dtype.kind]
    result_llvm_type = LLVM_NUMBER_TYPES[result_dtype.name]
    if isinstance(x.type, ir.VectorType):
        result_llvm_type = value_emitter.make_vector_type(result_llvm_type)
    return getattr(operation.llvm_builder, builder_method_name)(x, result_llvm_type)


def _emit_intrinsic_call(
    operation: ElementwiseOperation, intrinsic_function_name: str, operand: LlvmValue
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
    llvm_module = operation.llvm_builder.module
    if intrinsic_name not in llvm_module.globals:
        ir.Function(llvm_module, ir.FunctionType(llvm_type, [llvm_type]), intrinsic_name)
    text = f"call {llvm_type} @{intrinsic_name}({llvm_type} {operand.get_reference()})"
    return operation.llvm_builder.emit(llvm_type, text)


def _equals_llvm_constant(llvm_value: LlvmValue, expected_number: int) -> bool:
    """Return whether an LLVM value is a constant that equals `expected_number` in every lane."""
    if not isinstance(llvm_value, ir.Constant):
        return False
    constant_content = llvm_value.constant
    if isinstance(constant_content, (list, tuple)):
        return all(_equals_llvm_constant(entry, expected_number) for entry in constant_content)
    return isinstance(constant_content, (int, float)) and constant_content == expected_number


ELEMENTWISE_RULES: dict[str, ElementwiseRule] = {
    "abs": emit_absolute_value,
    "add": emit_sum,
    "add_any": emit_sum,
    "and": partial(emit_binary_instruction, "and"),
    "bitcast_convert_type": emit_bits,
    "convert_element_type": emit_conversion,
    "copy": lambda _, x: x,
    "div": emit_quotient,
    "eq": partial(emit_comparison, "=="),
    "ge": partial(emit_comparison, ">="),
    "gt": partial(emit_comparison, ">"),
    "integer_pow": emit_integer_power,
    "is_finite": emit_finiteness_test,
    "le": partial(emit_comparison, "<="),
    "lt": partial(emit_comparison, "<"),
    "max": partial(emit_extremum, ">"),
    "min": partial(emit_extremum, "<"),
    "mul": emit_product,
    "ne": partial(emit_comparison, "!="),
    "neg": emit_negative,
    "not": lambda operation, x: operation.llvm_builder.not_(x),
    "or": partial(emit_binary_instruction, "or"),
    "rem": emit_remainder,
    "select_n": emit_select,
    "shift_left": partial(emit_binary_instruction, "shl"),
    "shift_right_arithmetic": partial(emit_binary_instruction, "ashr"),
    "shift_right_logical": partial(emit_binary_instruction, "lshr"),
    "square": lambda operation, x: _emit_number_instruction("mul", operation, x, x),
    "stop_gradient": lambda _, x: x,
    "sub": emit_difference,
    "xor": partial(emit_binary_instruction, "xor"),
    **{
        name: partial(emit_float_function, name)
        for name in ("cos", "exp", "floor", "log", "sin", "sqrt")
    },
}

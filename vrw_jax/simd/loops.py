"""Lowering of JAX loops to LLVM: carried arrays are kept in registers or, if large, in memory."""

import math
from collections.abc import Sequence
from typing import Any

from vrw_jax.simd.array_emitter import (
    LANE_AXIS_SENTINEL,
    ArrayEmitter,
    shape_without_lanes,
    split_arrays,
)
from vrw_jax.simd.lazy_arrays import (
    ArrayValue,
    MemoryArray,
    PendingUpdate,
    TransposedView,
    as_shared,
)
from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.lowering import JAXPR_PARAMETERS, JaxprLowering
from vrw_jax.simd.value_emitter import I64, Value


def emit_while(
    lowering: JaxprLowering, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Emit a `while` loop, and return the arrays it carries after the last iteration.

    Each group of lanes evaluates the condition separately, so a group ends with its own slowest
    lane.
    """
    emitter, params = lowering.emitter, equation.params
    n_condition_constants, n_body_constants = params["cond_nconsts"], params["body_nconsts"]
    # The constants are shared, because each iteration reads them again.
    constants = list(map(as_shared, values[: n_condition_constants + n_body_constants]))
    condition_constants = constants[:n_condition_constants]
    body_constants = constants[n_condition_constants:]
    initial_values = values[n_condition_constants + n_body_constants :]
    loop_carry = _LoopCarry(
        emitter, params["body_jaxpr"].out_avals, emitter.limits.max_registers, initial_values
    )

    def emit_condition(register_values: list[Value]) -> Value:
        results = lowering.lower_jaxpr(
            params["cond_jaxpr"],
            [*condition_constants, *map(as_shared, loop_carry.to_arrays(register_values))],
        )
        return emitter.get_entries(results[0]).item()

    def emit_body(register_values: list[Value]) -> list[Value]:
        results = lowering.lower_jaxpr(
            params["body_jaxpr"], [*body_constants, *loop_carry.to_arrays(register_values)]
        )
        return loop_carry.get_next_registers(results)

    initial_registers = loop_carry.store_initial(initial_values)
    return loop_carry.to_arrays(
        emitter.emitter.emit_loop(initial_registers, emit_condition, emit_body)
    )


def emit_scan(lowering: JaxprLowering, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
    """Emit a loop of known length, and return the last carried arrays and the stacked outputs.

    Scanned inputs and stacked outputs are in memory.
    """
    emitter, params = lowering.emitter, equation.params
    if "ft_in" in params:  # JAX has this parameter from release 0.11 or 0.12 on.
        constants, loop_carry, _ = params["ft_in"].unpack()
        n_constants, n_carry = len(constants), len(loop_carry)
    else:
        n_constants, n_carry = params["num_consts"], params["num_carry"]
    body_jaxpr, n_iterations = params["jaxpr"], params["length"]
    stacked_avals = [variable.aval for variable in equation.outvars[n_carry:]]
    if n_iterations == LANE_AXIS_SENTINEL and (
        stacked_avals or len(values) > n_constants + n_carry
    ):
        raise NotImplementedError(
            f"scan reads or writes along an axis of {LANE_AXIS_SENTINEL}, which is the lanes': "
            "do the same to each lane, and give other axes another length."
        )
    scanned_values = values[n_constants + n_carry :]
    scanned_arrays = [
        x if isinstance(x, TransposedView) else emitter.materialize(x) for x in scanned_values
    ]
    stacked_arrays = [
        emitter.allocate(shape_without_lanes(aval), emitter.entry_type_of(aval))
        for aval in stacked_avals
    ]
    was_in_innermost_loop, emitter.is_in_innermost_loop = (
        emitter.is_in_innermost_loop,
        not _contains_loop(body_jaxpr.jaxpr),
    )
    constants = list(map(as_shared, values[:n_constants]))
    initial_values = values[n_constants : n_constants + n_carry]
    limits = emitter.limits
    max_registers = (
        limits.max_registers_inner if emitter.is_in_innermost_loop else limits.max_registers
    )
    loop_carry = _LoopCarry(emitter, body_jaxpr.out_avals[:n_carry], max_registers, initial_values)

    def get_slice(memory: MemoryArray | TransposedView, iteration: Value) -> ArrayValue:
        slice_array = memory.get_row(iteration)
        fits_registers = (
            emitter.is_in_innermost_loop or math.prod(slice_array.shape) <= limits.max_registers
        )
        return emitter.get_entries(slice_array) if fits_registers else slice_array

    def emit_body(iteration: Value, register_values: list[Value]) -> list[Value]:
        if params["reverse"]:
            iteration = emitter.builder.sub(ir.Constant(I64, n_iterations - 1), iteration)
        slices = [get_slice(memory, iteration) for memory in scanned_arrays]
        results = lowering.lower_jaxpr(
            body_jaxpr, [*constants, *loop_carry.to_arrays(register_values), *slices]
        )
        for memory, value in zip(stacked_arrays, results[n_carry:], strict=True):
            emitter.fill_memory(memory.get_row(iteration), value)
        return loop_carry.get_next_registers(results[:n_carry])

    initial_registers = loop_carry.store_initial(initial_values)
    final_values = loop_carry.to_arrays(
        emitter.loop_n_times(n_iterations, emit_body, initial_registers)
    )
    emitter.is_in_innermost_loop = was_in_innermost_loop
    return [*final_values, *stacked_arrays]


class _LoopCarry:
    """Arrays that a loop carries from one iteration to the next.

    An array of at most `max_registers` entries is kept in registers, a larger one in memory. The
    memory is that of the initial value if no other array uses it; otherwise it is allocated for the
    loop.
    """

    def __init__(
        self,
        emitter: ArrayEmitter,
        avals: Sequence[Any],
        max_registers: int | float,
        initial_values: Sequence[ArrayValue],
    ) -> None:
        self.emitter, self.avals = emitter, avals
        self.memory_by_position = [
            self.choose_memory(aval, initial_value)
            if math.prod(shape_without_lanes(aval)) > max_registers
            else None
            for aval, initial_value in zip(avals, initial_values, strict=True)
        ]

    def choose_memory(self, aval: Any, initial_value: ArrayValue) -> MemoryArray:
        """Return the memory of the initial value if it may be overwritten and has the same type,
        else new memory.
        """
        entry_type = self.emitter.entry_type_of(aval)
        initial_value = (
            initial_value.base_array if isinstance(initial_value, PendingUpdate) else initial_value
        )
        if (
            isinstance(initial_value, MemoryArray)
            and initial_value.is_overwritable
            and initial_value.entry_type == entry_type
        ):
            return initial_value
        return self.emitter.allocate(shape_without_lanes(aval), entry_type)

    def to_arrays(self, register_values: Sequence[Value]) -> list[ArrayValue]:
        """Return the carried arrays, in an iteration or after the last one, from the values in
        registers.
        """
        register_avals = [
            aval
            for aval, memory in zip(self.avals, self.memory_by_position, strict=True)
            if memory is None
        ]
        register_arrays = iter(split_arrays(register_values, register_avals))
        # Each call creates new objects, because values cached for the old ones are outdated.
        return [
            next(register_arrays)
            if memory is None
            else MemoryArray(
                self.emitter,
                memory.shape,
                memory.entry_type,
                memory.base_pointer,
                is_overwritable=True,
            )
            for memory in self.memory_by_position
        ]

    def store_initial(self, arrays: Sequence[ArrayValue]) -> list[Value]:
        """Return the initial values of all registers, and emit stores of the arrays kept in
        memory.
        """
        for array, memory in zip(arrays, self.memory_by_position, strict=True):
            if memory is None or array is memory:
                continue
            if isinstance(array, PendingUpdate) and array.base_array is memory:
                array.materialize_update().store_into(memory)
            else:
                self.emitter.fill_memory(memory, array)
        return self._flatten_registers(arrays)

    def get_next_registers(self, arrays: Sequence[ArrayValue]) -> list[Value]:
        """Return the values of all registers in the next iteration, and emit stores of the arrays
        in memory.

        New values may depend on any of the old ones, so all are computed before any is stored.
        """
        register_values = self._flatten_registers(arrays)
        pending_copies: list[tuple[MemoryArray, MemoryArray | PendingUpdate]] = []
        for array, memory in zip(arrays, self.memory_by_position, strict=True):
            if memory is None or (
                isinstance(array, MemoryArray) and array.base_pointer is memory.base_pointer
            ):
                continue
            if (
                isinstance(array, PendingUpdate)
                and getattr(array.base_array, "base_pointer", None) is memory.base_pointer
            ):
                pending_copies.append((memory, array.materialize_update()))
            elif isinstance(array, MemoryArray) and self._has_separate_memory(array):
                pending_copies.append((memory, array))
            else:
                copied_array = self.emitter.allocate(memory.shape, memory.entry_type)
                self.emitter.fill_memory(copied_array, array)
                pending_copies.append((memory, copied_array))
        for memory, new_value in pending_copies:
            if isinstance(new_value, PendingUpdate):
                new_value.store_into(memory)
            else:
                self.emitter.fill_memory(memory, new_value)
        return register_values

    def _has_separate_memory(self, array: MemoryArray) -> bool:
        """Return whether the array has memory of its own, which no carried array uses."""
        memory_bases = [
            memory.base_pointer for memory in self.memory_by_position if memory is not None
        ]
        return (
            isinstance(array.base_pointer, ir.AllocaInstr)
            and array.base_pointer not in memory_bases
        )

    def _flatten_registers(self, arrays: Sequence[ArrayValue]) -> list[Value]:
        """Return the entries of all carried arrays that are kept in registers, in one list."""
        array_aval_memory = zip(arrays, self.avals, self.memory_by_position, strict=True)
        register_arrays = [
            (array, aval) for array, aval, memory in array_aval_memory if memory is None
        ]
        return self.emitter.flatten_entries(
            [array for array, _ in register_arrays], [aval for _, aval in register_arrays]
        )


def _contains_loop(jaxpr: Any) -> bool:
    """Return whether a jaxpr contains a loop at any level."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("while", "scan"):
            return True
        inner_jaxpr = equation.params.get(JAXPR_PARAMETERS.get(equation.primitive.name, ""))
        if inner_jaxpr is not None and _contains_loop(inner_jaxpr.jaxpr):
            return True
    return False

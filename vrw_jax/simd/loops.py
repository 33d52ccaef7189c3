"""Lowering of loops: carried arrays are kept in registers or, if large, in memory."""

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


def emit_while(traces: JaxprLowering, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
    """Emit a loop with a condition, of which each group of lanes has its own."""
    arrays, params = traces.emitter, equation.params
    n_condition_constants, n_body_constants = params["cond_nconsts"], params["body_nconsts"]
    # Each iteration reads the constants again.
    constants = list(map(as_shared, values[: n_condition_constants + n_body_constants]))
    condition_constants = constants[:n_condition_constants]
    body_constants = constants[n_condition_constants:]
    initial_values = values[n_condition_constants + n_body_constants :]
    carry = _LoopCarry(
        arrays, params["body_jaxpr"].out_avals, arrays.limits.max_registers, initial_values
    )

    def emit_condition(flat: list[Value]) -> Value:
        results = traces.lower_jaxpr(
            params["cond_jaxpr"], [*condition_constants, *map(as_shared, carry.to_arrays(flat))]
        )
        return arrays.get_entries(results[0]).item()

    def body(flat: list[Value]) -> list[Value]:
        results = traces.lower_jaxpr(
            params["body_jaxpr"], [*body_constants, *carry.to_arrays(flat)]
        )
        return carry.get_next_registers(results)

    initial_registers = carry.store_initial(initial_values)
    return carry.to_arrays(arrays.emitter.emit_loop(initial_registers, emit_condition, body))


def emit_scan(traces: JaxprLowering, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
    """Emit a loop of known length, whose scanned inputs and stacked outputs are in memory."""
    arrays, params = traces.emitter, equation.params
    if "ft_in" in params:  # JAX from 0.11 or 0.12 on
        constants, carry, _ = params["ft_in"].unpack()
        n_constants, n_carry = len(constants), len(carry)
    else:
        n_constants, n_carry = params["num_consts"], params["num_carry"]
    body_jaxpr, length = params["jaxpr"], params["length"]
    stacked_avals = [variable.aval for variable in equation.outvars[n_carry:]]
    if length == LANE_AXIS_SENTINEL and (stacked_avals or len(values) > n_constants + n_carry):
        raise NotImplementedError(
            f"scan reads or writes along an axis of {LANE_AXIS_SENTINEL}, which is the lanes': "
            "do the same to each lane, and give other axes another length."
        )
    scanned = values[n_constants + n_carry :]
    scanned_arrays = [
        x if isinstance(x, TransposedView) else arrays.materialize(x) for x in scanned
    ]
    stacked_arrays = [
        arrays.allocate(shape_without_lanes(aval), arrays.entry_type_of(aval))
        for aval in stacked_avals
    ]
    was_unrolled, arrays.is_unrolled = arrays.is_unrolled, not _contains_loop(body_jaxpr.jaxpr)
    constants = list(map(as_shared, values[:n_constants]))
    initial_values = values[n_constants : n_constants + n_carry]
    limits = arrays.limits
    max_registers = limits.max_registers_inner if arrays.is_unrolled else limits.max_registers
    carry = _LoopCarry(arrays, body_jaxpr.out_avals[:n_carry], max_registers, initial_values)

    def get_slice(memory: MemoryArray | TransposedView, iteration: Value) -> ArrayValue:
        row = memory.get_row(iteration)
        fits_registers = arrays.is_unrolled or math.prod(row.shape) <= limits.max_registers
        return arrays.get_entries(row) if fits_registers else row

    def body(iteration: Value, flat: list[Value]) -> list[Value]:
        if params["reverse"]:
            iteration = arrays.builder.sub(ir.Constant(I64, length - 1), iteration)
        slices = [get_slice(memory, iteration) for memory in scanned_arrays]
        results = traces.lower_jaxpr(body_jaxpr, [*constants, *carry.to_arrays(flat), *slices])
        for memory, value in zip(stacked_arrays, results[n_carry:], strict=True):
            arrays.fill_memory(memory.get_row(iteration), value)
        return carry.get_next_registers(results[:n_carry])

    initial_registers = carry.store_initial(initial_values)
    final_values = carry.to_arrays(arrays.loop_n_times(length, body, initial_registers))
    arrays.is_unrolled = was_unrolled
    return [*final_values, *stacked_arrays]


class _LoopCarry:
    """Arrays carried from one iteration of a loop to the next.

    They are in registers up to `max_registers` entries, otherwise in memory. The memory is
    allocated for the loop, or is that of the initial value if no other array uses it.
    """

    def __init__(
        self,
        emitter: ArrayEmitter,
        avals: Sequence[Any],
        max_registers: int | float,
        initial_values: Sequence[ArrayValue],
    ) -> None:
        self.emitter, self.avals = emitter, avals
        self.memory_slots = [
            self.choose_memory(aval, initial_value)
            if math.prod(shape_without_lanes(aval)) > max_registers
            else None
            for aval, initial_value in zip(avals, initial_values, strict=True)
        ]

    def choose_memory(self, aval: Any, initial_value: ArrayValue) -> MemoryArray:
        """Return the memory of the initial value if no other array uses it, else new memory."""
        kind = self.emitter.entry_type_of(aval)
        initial_value = (
            initial_value.base_array if isinstance(initial_value, PendingUpdate) else initial_value
        )
        if (
            isinstance(initial_value, MemoryArray)
            and initial_value.is_overwritable
            and initial_value.entry_type == kind
        ):
            return initial_value
        return self.emitter.allocate(shape_without_lanes(aval), kind)

    def to_arrays(self, flat: Sequence[Value]) -> list[ArrayValue]:
        """Return the carried arrays, in an iteration or after the last one."""
        register_avals = [
            aval for aval, slot in zip(self.avals, self.memory_slots, strict=True) if slot is None
        ]
        register_arrays = iter(split_arrays(flat, register_avals))
        # A new object each time, because values cached for the old one are outdated.
        return [
            next(register_arrays)
            if slot is None
            else MemoryArray(
                self.emitter, slot.shape, slot.entry_type, slot.base, is_overwritable=True
            )
            for slot in self.memory_slots
        ]

    def store_initial(self, arrays: Sequence[ArrayValue]) -> list[Value]:
        """Return the initial values of registers, and store the others."""
        for array, slot in zip(arrays, self.memory_slots, strict=True):
            if slot is None or array is slot:
                continue
            if isinstance(array, PendingUpdate) and array.base_array is slot:
                array.materialize_update().store_into(slot)
            else:
                self.emitter.fill_memory(slot, array)
        return self._flatten_registers(arrays)

    def get_next_registers(self, arrays: Sequence[ArrayValue]) -> list[Value]:
        """Return the registers of the next iteration, and store the others.

        New values may depend on any of the old ones.
        """
        flat = self._flatten_registers(arrays)
        moves: list[tuple[MemoryArray, MemoryArray | PendingUpdate]] = []
        for array, slot in zip(arrays, self.memory_slots, strict=True):
            if slot is None or (isinstance(array, MemoryArray) and array.base is slot.base):
                continue
            if (
                isinstance(array, PendingUpdate)
                and getattr(array.base_array, "base", None) is slot.base
            ):
                moves.append((slot, array.materialize_update()))
            elif isinstance(array, MemoryArray) and self._has_own_memory(array):
                moves.append((slot, array))
            else:
                copy = self.emitter.allocate(slot.shape, slot.entry_type)
                self.emitter.fill_memory(copy, array)
                moves.append((slot, copy))
        for slot, new_value in moves:
            if isinstance(new_value, PendingUpdate):
                new_value.store_into(slot)
            else:
                self.emitter.fill_memory(slot, new_value)
        return flat

    def _has_own_memory(self, array: MemoryArray) -> bool:
        """Return whether the array has memory that no carried array uses."""
        memory_bases = [slot.base for slot in self.memory_slots if slot is not None]
        return isinstance(array.base, ir.AllocaInstr) and array.base not in memory_bases

    def _flatten_registers(self, arrays: Sequence[ArrayValue]) -> list[Value]:
        """Return the entries of the arrays that are carried in registers."""
        triples = zip(arrays, self.avals, self.memory_slots, strict=True)
        register_pairs = [(array, aval) for array, aval, slot in triples if slot is None]
        return self.emitter.flatten_entries(
            [array for array, _ in register_pairs], [aval for _, aval in register_pairs]
        )


def _contains_loop(jaxpr: Any) -> bool:
    """Return whether a trace contains a loop at any level."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("while", "scan"):
            return True
        inner_jaxpr = equation.params.get(JAXPR_PARAMETERS.get(equation.primitive.name, ""))
        if inner_jaxpr is not None and _contains_loop(inner_jaxpr.jaxpr):
            return True
    return False

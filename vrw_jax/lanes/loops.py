"""Lowering of JAX loops to LLVM. Small carried arrays are in registers, large ones in memory."""

import math
from collections.abc import Sequence
from itertools import compress
from typing import Any

from vrw_jax.lanes.array_emitter import (
    LANE_AXIS_SENTINEL,
    ArrayEmitter,
    LaneAxisError,
    get_shape_without_lanes,
    make_entry_array,
    split_into_entry_arrays,
)
from vrw_jax.lanes.lazy_arrays import (
    LlvmArray,
    MemoryArray,
    PendingArrayUpdate,
    TransposedMemoryView,
    mark_memory_as_shared,
)
from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.lowering import CALLED_JAXPR_PARAMETERS, JaxprLowering
from vrw_jax.lanes.value_emitter import I64, LlvmValue


def emit_while_loop(
    jaxpr_lowering: JaxprLowering, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Emit a `while` loop, and return the arrays that it carries after the last iteration.

    Each group of lanes evaluates the condition separately, so a group ends with its own slowest
    lane.
    """
    array_emitter, equation_params = jaxpr_lowering.array_emitter, equation.params
    n_condition_constants = equation_params["cond_nconsts"]
    n_loop_constants = n_condition_constants + equation_params["body_nconsts"]
    # The constants are shared, because each iteration reads them again.
    loop_constants = list(map(mark_memory_as_shared, operands[:n_loop_constants]))
    loop_carry = _LoopCarry(
        array_emitter,
        equation_params["body_jaxpr"].out_avals,
        operands[n_loop_constants:],
    )

    def emit_while_condition(register_values: list[LlvmValue]) -> LlvmValue:
        condition_results = jaxpr_lowering.lower_jaxpr(
            equation_params["cond_jaxpr"],
            [
                *loop_constants[:n_condition_constants],
                *map(mark_memory_as_shared, loop_carry.make_loop_carry_arrays(register_values)),
            ],
        )
        return array_emitter.get_array_entries(condition_results[0]).item()

    def emit_while_body(register_values: list[LlvmValue]) -> list[LlvmValue]:
        body_results = jaxpr_lowering.lower_jaxpr(
            equation_params["body_jaxpr"],
            [
                *loop_constants[n_condition_constants:],
                *loop_carry.make_loop_carry_arrays(register_values),
            ],
        )
        return loop_carry.get_next_register_values(body_results)

    return loop_carry.make_loop_carry_arrays(
        array_emitter.value_emitter.emit_llvm_loop(
            loop_carry.initial_register_values, emit_while_condition, emit_while_body
        )
    )


def count_scan_arguments(params: Any) -> tuple[int, int]:
    """Return the numbers of constants and of carried arrays of a `scan` loop."""
    if "ft_in" in params:  # JAX has this parameter from release 0.11 or 0.12 on.
        constants, carry, _ = params["ft_in"].unpack()
        return len(constants), len(carry)
    return params["num_consts"], params["num_carry"]


def emit_scan_loop(
    jaxpr_lowering: JaxprLowering, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Emit a `scan` loop, and return the arrays that it carries after the last iteration and the
    stacked outputs.

    Scanned inputs and stacked outputs are in memory.
    """
    array_emitter, equation_params = jaxpr_lowering.array_emitter, equation.params
    n_loop_constants, n_carried_arrays = count_scan_arguments(equation_params)
    body_jaxpr, n_iterations = equation_params["jaxpr"], equation_params["length"]
    stacked_output_avals = [x.aval for x in equation.outvars[n_carried_arrays:]]
    scanned_operands = operands[n_loop_constants + n_carried_arrays :]
    if n_iterations == LANE_AXIS_SENTINEL and (stacked_output_avals or scanned_operands):
        raise LaneAxisError(
            f"scan reads or writes along an axis of {LANE_AXIS_SENTINEL}, which is the lanes': "
            "do the same to each lane, and give other axes another length."
        )
    scanned_arrays = [
        x
        if isinstance(x, TransposedMemoryView) or 0 in x.shape
        else array_emitter.store_array_in_memory(x)
        for x in scanned_operands
    ]
    stacked_arrays = [
        array_emitter.allocate_memory_array(
            get_shape_without_lanes(aval), array_emitter.get_entry_type(aval)
        )
        for aval in stacked_output_avals
    ]
    was_in_innermost_loop, array_emitter.is_in_innermost_loop = (
        array_emitter.is_in_innermost_loop,
        not _contains_loop(body_jaxpr.jaxpr),
    )
    loop_constants = list(map(mark_memory_as_shared, operands[:n_loop_constants]))
    loop_carry = _LoopCarry(
        array_emitter,
        body_jaxpr.out_avals[:n_carried_arrays],
        operands[n_loop_constants : n_loop_constants + n_carried_arrays],
    )

    def get_scanned_slice(scanned_array: LlvmArray, iteration_index: LlvmValue) -> LlvmArray:
        if not isinstance(scanned_array, MemoryArray | TransposedMemoryView):
            return make_entry_array(scanned_array.shape[1:], [])  # It has no entries.
        scanned_slice = scanned_array.get_subarray(iteration_index)
        fits_registers = (
            array_emitter.is_in_innermost_loop
            or math.prod(scanned_slice.shape) <= array_emitter.MAX_REGISTER_ENTRIES
        )
        return array_emitter.get_array_entries(scanned_slice) if fits_registers else scanned_slice

    def emit_scan_body(
        iteration_index: LlvmValue, register_values: list[LlvmValue]
    ) -> list[LlvmValue]:
        if equation_params["reverse"]:
            iteration_index = array_emitter.llvm_builder.sub(
                ir.Constant(I64, n_iterations - 1), iteration_index
            )
        scanned_slices = [
            get_scanned_slice(scanned_array, iteration_index) for scanned_array in scanned_arrays
        ]
        body_results = jaxpr_lowering.lower_jaxpr(
            body_jaxpr,
            [*loop_constants, *loop_carry.make_loop_carry_arrays(register_values), *scanned_slices],
        )
        for stacked_array, stacked_output in zip(
            stacked_arrays, body_results[n_carried_arrays:], strict=True
        ):
            if 0 not in stacked_array.shape:
                array_emitter.emit_array_stores(
                    stacked_array.get_subarray(iteration_index), stacked_output
                )
        return loop_carry.get_next_register_values(body_results[:n_carried_arrays])

    final_loop_carry_arrays = loop_carry.make_loop_carry_arrays(
        array_emitter.emit_range_loop(
            0, n_iterations, emit_scan_body, loop_carry.initial_register_values
        )
    )
    array_emitter.is_in_innermost_loop = was_in_innermost_loop
    return [*final_loop_carry_arrays, *stacked_arrays]


class _LoopCarry:
    """Arrays that a loop carries from one iteration to the next.

    Small arrays are in registers, and larger arrays in memory. A larger array is stored in the
    memory of its initial value, unless another array uses this memory. In that case, new memory is
    allocated. The constructor emits stores of the initial arrays that are carried in memory.
    """

    def __init__(
        self,
        array_emitter: ArrayEmitter,
        loop_carry_avals: Sequence[Any],
        initial_loop_carry_arrays: Sequence[LlvmArray],
    ) -> None:
        self.array_emitter, self.loop_carry_avals = array_emitter, loop_carry_avals
        max_register_entries = (
            array_emitter.MAX_INNERMOST_REGISTER_ENTRIES
            if array_emitter.is_in_innermost_loop
            else array_emitter.MAX_REGISTER_ENTRIES
        )
        self.loop_carry_memory = [
            self.choose_loop_carry_memory(aval, initial_loop_carry_array)
            if math.prod(get_shape_without_lanes(aval)) > max_register_entries
            else None
            for aval, initial_loop_carry_array in zip(
                loop_carry_avals, initial_loop_carry_arrays, strict=True
            )
        ]
        self.is_in_registers = [memory_array is None for memory_array in self.loop_carry_memory]
        for initial_loop_carry_array, memory_array in zip(
            initial_loop_carry_arrays, self.loop_carry_memory, strict=True
        ):
            if memory_array is not None:
                array_emitter.emit_array_stores(memory_array, initial_loop_carry_array)
        self.initial_register_values = self._flatten_register_entries(initial_loop_carry_arrays)

    def choose_loop_carry_memory(
        self, loop_carry_aval: Any, initial_loop_carry_array: LlvmArray
    ) -> MemoryArray:
        """Return the memory in which the loop carries an array.

        It is the memory of the initial array if the loop may overwrite it and its entry type fits,
        else new memory.
        """
        entry_type = self.array_emitter.get_entry_type(loop_carry_aval)
        if isinstance(initial_loop_carry_array, PendingArrayUpdate):
            initial_loop_carry_array = initial_loop_carry_array.base_array
        if (
            isinstance(initial_loop_carry_array, MemoryArray)
            and initial_loop_carry_array.is_overwritable
            and initial_loop_carry_array.entry_type == entry_type
        ):
            return initial_loop_carry_array
        return self.array_emitter.allocate_memory_array(
            get_shape_without_lanes(loop_carry_aval), entry_type
        )

    def make_loop_carry_arrays(self, register_values: Sequence[LlvmValue]) -> list[LlvmArray]:
        """Return the carried arrays at the start of an iteration, or after the last one.

        - `register_values`: entries of the arrays that are carried in registers.
        """
        register_avals = list(compress(self.loop_carry_avals, self.is_in_registers))
        register_arrays = iter(split_into_entry_arrays(register_values, register_avals))
        # Each call creates new objects, because values cached for the old ones are outdated.
        return [
            next(register_arrays)
            if memory_array is None
            else MemoryArray(
                self.array_emitter,
                memory_array.shape,
                memory_array.entry_type,
                memory_array.base_pointer,
                is_overwritable=True,
            )
            for memory_array in self.loop_carry_memory
        ]

    def get_next_register_values(
        self, next_loop_carry_arrays: Sequence[LlvmArray]
    ) -> list[LlvmValue]:
        """Emit stores of the next arrays that are carried in memory, and return the next values of
        all registers.

        A next array may depend on every present array, so all next arrays are computed before any
        is stored.
        """
        register_values = self._flatten_register_entries(next_loop_carry_arrays)
        carried_pointers = [m.base_pointer for m in self.loop_carry_memory if m is not None]
        next_memory_contents: list[tuple[MemoryArray, LlvmArray]] = []
        for next_array, memory_array in zip(
            next_loop_carry_arrays, self.loop_carry_memory, strict=True
        ):
            if memory_array is None:
                continue
            has_separate_memory = (
                isinstance(next_array, MemoryArray)
                and isinstance(next_array.base_pointer, ir.AllocaInstr)
                and next_array.base_pointer not in carried_pointers
            )
            if isinstance(next_array, PendingArrayUpdate) and memory_array.contains_array(
                next_array.base_array
            ):
                next_array = next_array.store_update_in_memory()
            elif not (has_separate_memory or memory_array.contains_array(next_array)):
                copied_array = self.array_emitter.allocate_memory_array(
                    memory_array.shape, memory_array.entry_type
                )
                self.array_emitter.emit_array_stores(copied_array, next_array)
                next_array = copied_array
            next_memory_contents.append((memory_array, next_array))
        for memory_array, next_array in next_memory_contents:
            self.array_emitter.emit_array_stores(memory_array, next_array)
        return register_values

    def _flatten_register_entries(self, loop_carry_arrays: Sequence[LlvmArray]) -> list[LlvmValue]:
        """Return a list of the entries of all carried arrays that are in registers."""
        return self.array_emitter.flatten_array_entries(
            list(compress(loop_carry_arrays, self.is_in_registers)),
            list(compress(self.loop_carry_avals, self.is_in_registers)),
        )


def _contains_loop(jaxpr: Any) -> bool:
    """Return whether a jaxpr, or any jaxpr that it calls, contains a loop."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("while", "scan"):
            return True
        inner_jaxpr = equation.params.get(CALLED_JAXPR_PARAMETERS.get(equation.primitive.name, ""))
        if inner_jaxpr is not None and _contains_loop(inner_jaxpr.jaxpr):
            return True
    return False

"""Lowering of jaxprs to LLVM: one equation after another, loops, and calls of other jaxprs.

The table `PRIMITIVE_RULES` contains the rules of all primitives. A new primitive needs one more
entry.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import compress
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from vrw_jax.lanes import array_rules
from vrw_jax.lanes.array_emitter import (
    LANE_AXIS_SENTINEL,
    ArrayEmitter,
    LaneAxisError,
    PrimitiveCall,
    get_llvm_number_type,
    get_shape_without_lanes,
    has_lane_axis,
    make_entry_array,
    make_lane_axis_error,
    make_lane_mixing_error,
    split_into_entry_arrays,
)
from vrw_jax.lanes.decompositions import DECOMPOSITIONS
from vrw_jax.lanes.llvm import (
    LazyArray,
    LlvmArray,
    LlvmValue,
    MemoryArray,
    PendingArrayUpdate,
    TransposedMemoryView,
    ir,
    mark_memory_as_shared,
)
from vrw_jax.lanes.value_emitter import ELEMENTWISE_RULES, I64, TextBuilder, ValueEmitter

PrimitiveRule = Callable[["JaxprLowering", Any, list[LlvmArray]], list[LlvmArray]]
"""Function that lowers one primitive. It takes the lowering, an equation and the operands, emits
instructions, and returns the results.
"""

NOINLINE_FUNCTION_NAME = "noinline"

CALLED_JAXPR_PARAMETERS = {  # primitive, and the parameter that contains the jaxpr it calls
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "custom_vjp_call": "call_jaxpr",
}


LOOP_PRIMITIVE_NAMES = "while", "scan"


def mark_noinline(function: Callable) -> Callable:
    """Return a wrapper of `function` that machine code calls as a separate function instead of
    inlining it.
    """

    def noinline(*arguments: Any) -> Any:
        return function(*arguments)

    return jax.jit(noinline)


@dataclass
class JaxprLowering:
    """Lowering of jaxprs into the LLVM function of `array_emitter`, by `PRIMITIVE_RULES`."""

    array_emitter: ArrayEmitter
    llvm_function_by_jaxpr_id: dict[int, Any] = field(default_factory=dict)
    """Separate functions by the `id` of their trace, with the trace, whose reference keeps the `id`
    valid.
    """

    def lower_jaxpr(
        self, closed_jaxpr: ClosedJaxpr, argument_arrays: Sequence[LlvmArray]
    ) -> list[LlvmArray]:
        """Emit all equations of a jaxpr for the arguments `argument_arrays`, and return the result
        arrays.
        """
        jaxpr, emit_constant_array = closed_jaxpr.jaxpr, self.array_emitter.emit_constant_array
        overwriting_equation_by_variable = _find_overwriting_equations(jaxpr)
        array_by_variable: dict[Any, LlvmArray] = {}

        def assign_jaxpr_variables(
            jaxpr_variables: Sequence[Any], assigned_arrays: Sequence[LlvmArray]
        ) -> None:
            for jaxpr_variable, assigned_array in zip(
                jaxpr_variables, assigned_arrays, strict=True
            ):
                array_by_variable[jaxpr_variable] = (
                    mark_memory_as_shared(assigned_array)
                    if overwriting_equation_by_variable.get(jaxpr_variable) is None
                    else assigned_array
                )

        assign_jaxpr_variables(jaxpr.invars, argument_arrays)
        for jaxpr_variable, constant_value in zip(
            jaxpr.constvars, closed_jaxpr.consts, strict=True
        ):
            array_by_variable[jaxpr_variable] = emit_constant_array(
                np.asarray(constant_value), jaxpr_variable.aval
            )

        def read_jaxpr_atom(jaxpr_atom: Any, equation_index: int) -> LlvmArray:
            if isinstance(jaxpr_atom, Literal):
                return emit_constant_array(np.asarray(jaxpr_atom.val), jaxpr_atom.aval)
            return (
                array_by_variable[jaxpr_atom]
                if overwriting_equation_by_variable[jaxpr_atom] == equation_index
                else mark_memory_as_shared(array_by_variable[jaxpr_atom])
            )

        for equation_index, equation in enumerate(jaxpr.eqns):
            if all(variable.aval.dtype == jax.dtypes.float0 for variable in equation.outvars):
                continue  # The derivative of an integer has no value, and no equation reads it.
            primitive_name = equation.primitive.name
            if primitive_name not in PRIMITIVE_RULES:
                raise NotImplementedError(
                    f"{primitive_name} has no machine code: write it by primitives that "
                    "`lanes.describe_supported_primitives()` lists, or give it a rule in "
                    "`lanes/lowering.PRIMITIVE_RULES`."
                )
            for variable in equation.outvars:
                if LANE_AXIS_SENTINEL in variable.aval.shape[:-1]:
                    raise make_lane_axis_error(f"The result of {primitive_name}", variable.aval)
            operands = [read_jaxpr_atom(x, equation_index) for x in equation.invars]
            equation_results = PRIMITIVE_RULES[primitive_name](self, equation, operands)
            assign_jaxpr_variables(equation.outvars, equation_results)
        return [read_jaxpr_atom(jaxpr_atom, len(jaxpr.eqns)) for jaxpr_atom in jaxpr.outvars]

    def emit_separate_function_call(
        self, closed_jaxpr: ClosedJaxpr, argument_arrays: Sequence[LlvmArray]
    ) -> list[LlvmArray]:
        """Emit a call of a separate LLVM function that computes a jaxpr, and return the result
        arrays.

        The first call for a jaxpr defines the function.
        """
        llvm_builder = self.array_emitter.llvm_builder
        if id(closed_jaxpr) not in self.llvm_function_by_jaxpr_id:
            self.llvm_function_by_jaxpr_id[id(closed_jaxpr)] = (
                self._define_separate_function(closed_jaxpr),
                closed_jaxpr,
            )
        llvm_function, _ = self.llvm_function_by_jaxpr_id[id(closed_jaxpr)]
        argument_entries = self.array_emitter.flatten_array_entries(
            list(map(self._store_large_array, argument_arrays)), closed_jaxpr.in_avals
        )
        returned_struct = llvm_builder.call(llvm_function, argument_entries)
        result_entries = [
            llvm_builder.extract_value(returned_struct, i)
            for i in range(len(returned_struct.type.elements))
        ]
        results = split_into_entry_arrays(result_entries, closed_jaxpr.out_avals)
        return list(map(self._store_large_array, results))

    def _store_large_array(self, array: LlvmArray) -> LlvmArray:
        """Return a large array in memory, so that loops compute its entries, or those from it."""
        is_large = math.prod(array.shape) > self.array_emitter.MAX_REGISTER_ENTRIES
        return self.array_emitter.store_array_in_memory(array) if is_large else array

    def _define_separate_function(self, closed_jaxpr: ClosedJaxpr) -> ir.Function:
        """Return a new LLVM function that computes a jaxpr.

        The function takes the entries of all arguments, and returns a struct of the entries of all
        results.
        """
        list_entry_types = lambda array_avals: [
            self.array_emitter.get_entry_type(x)
            for x in array_avals
            for _ in range(math.prod(get_shape_without_lanes(x)))
        ]
        llvm_struct_type = ir.LiteralStructType(list_entry_types(closed_jaxpr.out_avals))
        llvm_module = self.array_emitter.llvm_builder.module
        llvm_function_type = ir.FunctionType(
            llvm_struct_type, list_entry_types(closed_jaxpr.in_avals)
        )
        llvm_function = ir.Function(
            llvm_module, llvm_function_type, llvm_module.get_unique_name(NOINLINE_FUNCTION_NAME)
        )
        llvm_function.linkage = "internal"
        for llvm_attribute in ("noinline", "nounwind"):
            llvm_function.attributes.add(llvm_attribute)
        llvm_builder = TextBuilder(llvm_function.append_basic_block("entry"))
        array_emitter_of_caller = self.array_emitter
        array_emitter_of_function = ArrayEmitter(
            ValueEmitter(llvm_builder, array_emitter_of_caller.value_emitter.n_vector_lanes),
            array_emitter_of_caller.max_unrolled_entries,
            array_emitter_of_caller.is_in_innermost_loop,
        )
        result_arrays = JaxprLowering(
            array_emitter_of_function, self.llvm_function_by_jaxpr_id
        ).lower_jaxpr(
            closed_jaxpr, split_into_entry_arrays(llvm_function.args, closed_jaxpr.in_avals)
        )
        result_struct: LlvmValue = ir.Constant(llvm_struct_type, ir.Undefined)
        for i, result_entry in enumerate(
            array_emitter_of_function.flatten_array_entries(result_arrays, closed_jaxpr.out_avals)
        ):
            result_struct = llvm_builder.insert_value(result_struct, result_entry, i)
        llvm_builder.ret(result_struct)
        return llvm_function


def _find_overwriting_equations(jaxpr: Any) -> dict[Any, int | None]:
    """Return, for each variable, the index of the equation that may overwrite its memory, or None.

    This equation is the last one that reads the variable, if all earlier readers are loops. A loop
    reads no operand after its end.
    """
    overwriting_equation_by_variable: dict[Any, int | None] = {}
    is_loop_equation = [equation.primitive.name in LOOP_PRIMITIVE_NAMES for equation in jaxpr.eqns]
    for equation_index, atoms_of_equation in enumerate(
        [*(equation.invars for equation in jaxpr.eqns), jaxpr.outvars]
    ):
        for jaxpr_atom in atoms_of_equation:
            if not isinstance(jaxpr_atom, Literal):
                previous_equation_index = overwriting_equation_by_variable.get(jaxpr_atom, -1)
                may_equation_overwrite = previous_equation_index == -1 or (
                    previous_equation_index not in (None, equation_index)
                    and is_loop_equation[previous_equation_index]
                )
                overwriting_equation_by_variable[jaxpr_atom] = (
                    equation_index if may_equation_overwrite else None
                )
    return overwriting_equation_by_variable


def emit_called_jaxpr(
    jaxpr_lowering: JaxprLowering, equation: Any, operands: list[LlvmArray]
) -> list[LlvmArray]:
    """Emit the called jaxpr and return its results. The code is inline, or a separate function if
    `mark_noinline` marks it.
    """
    closed_jaxpr = equation.params[CALLED_JAXPR_PARAMETERS[equation.primitive.name]]
    if equation.params.get("name") == NOINLINE_FUNCTION_NAME:
        return jaxpr_lowering.emit_separate_function_call(closed_jaxpr, operands)
    return jaxpr_lowering.lower_jaxpr(closed_jaxpr, operands)


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


def _emit_single_result(
    single_result_rule: Callable[..., LlvmArray],
    jaxpr_lowering: JaxprLowering,
    equation: Any,
    operands: list[LlvmArray],
) -> list[LlvmArray]:
    """Return the result of a primitive with one result, after checks of the lane axes.

    - `single_result_rule`: function of an `ArrayEmitter`, a `PrimitiveCall` and the operands that
      returns the result.
    """
    primitive_name, result_aval = equation.primitive.name, equation.outvars[0].aval
    operand_avals = [input_atom.aval for input_atom in equation.invars]
    result_has_lanes = has_lane_axis(result_aval)
    operand_has_lanes = any(map(has_lane_axis, operand_avals))
    if (
        operand_has_lanes
        and not result_has_lanes
        and primitive_name not in ("reduce_and", "reduce_or")
    ):
        raise make_lane_mixing_error(primitive_name)
    if (
        result_has_lanes
        and not operand_has_lanes
        and primitive_name not in ("broadcast_in_dim", "empty")
    ):
        raise make_lane_axis_error(f"The result of {primitive_name}", result_aval)
    get_llvm_number_type(result_aval)  # This call raises an error for unsupported number types.
    array_emitter = jaxpr_lowering.array_emitter
    result_array = single_result_rule(
        array_emitter,
        PrimitiveCall(primitive_name, equation.params, operand_avals, result_aval),
        *operands,
    )
    if (
        isinstance(result_array, LazyArray)
        and math.prod(result_array.shape) <= array_emitter.max_unrolled_entries
    ):
        result_array = array_emitter.get_array_entries(result_array)
    return [result_array]


def _emit_array_product(
    array_emitter: ArrayEmitter, primitive_call: PrimitiveCall, *operands: LlvmArray
) -> LlvmArray:
    """Return the product of two arrays, summed over axes of each array."""
    multiply = partial(DECOMPOSITIONS["dot_general"], **primitive_call.primitive_params)
    closed_jaxpr = jax.make_jaxpr(multiply)(*primitive_call.operand_avals)
    return JaxprLowering(array_emitter).lower_jaxpr(closed_jaxpr, operands)[0]


SINGLE_RESULT_RULES: dict[str, Callable[..., LlvmArray]] = {
    **dict.fromkeys(ELEMENTWISE_RULES, ArrayEmitter.emit_elementwise_array),
    "broadcast_in_dim": array_rules.emit_broadcast_array,
    "concatenate": array_rules.emit_concatenated_array,
    "dynamic_slice": array_rules.emit_dynamic_slice,
    "dynamic_update_slice": array_rules.emit_dynamic_slice_update,
    "empty": array_rules.emit_uninitialized_array,
    "expand_dims": array_rules.emit_reshaped_array,
    "iota": array_rules.emit_index_array,
    "pad": array_rules.emit_padded_array,
    "reshape": array_rules.emit_reshaped_array,
    "slice": array_rules.emit_static_slice,
    "squeeze": array_rules.emit_reshaped_array,
    "stack": array_rules.emit_stacked_array,
    "transpose": array_rules.emit_transposed_array,
    "cumsum": array_rules.emit_cumulative_sum,
    "dot_general": _emit_array_product,
    **dict.fromkeys(array_rules.COMBINING_PRIMITIVE_BY_REDUCTION, array_rules.emit_reduced_array),
}
"""Rules of primitives with one result, by the name of the primitive."""

PRIMITIVE_RULES: dict[str, PrimitiveRule] = {
    **{name: partial(_emit_single_result, rule) for name, rule in SINGLE_RESULT_RULES.items()},
    **dict.fromkeys(CALLED_JAXPR_PARAMETERS, emit_called_jaxpr),
    "optimization_barrier": array_rules.emit_optimization_barrier,
    "scan": emit_scan_loop,
    "split": array_rules.emit_split_arrays,
    "unstack": array_rules.emit_unstacked_arrays,
    "while": emit_while_loop,
}


def describe_supported_primitives() -> dict[str, str]:
    """Return descriptions of the rules by the name of the JAX primitive, for all supported
    primitives.

    A description is the first paragraph of the rule's docstring.
    """
    get_first_paragraph = lambda docstring: " ".join(docstring.partition("\n\n")[0].split())
    return {
        primitive_name: get_first_paragraph(primitive_rule.__doc__ or "")
        for primitive_name, primitive_rule in (PRIMITIVE_RULES | SINGLE_RESULT_RULES).items()
    }

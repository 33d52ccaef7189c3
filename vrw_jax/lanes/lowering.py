"""Lowering of jaxprs to LLVM: one equation after another, and calls of other jaxprs."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from vrw_jax.lanes.array_emitter import (
    LANE_AXIS_SENTINEL,
    ArrayEmitter,
    get_shape_without_lanes,
    make_lane_axis_error,
    split_into_entry_arrays,
)
from vrw_jax.lanes.lazy_arrays import LlvmArray, mark_memory_as_shared
from vrw_jax.lanes.llvm_library import ir
from vrw_jax.lanes.value_emitter import LlvmValue, TextBuilder, ValueEmitter

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
    """Lowering of jaxprs into the LLVM function of `array_emitter`, by the rules in
    `primitive_rules`.
    """

    array_emitter: ArrayEmitter
    primitive_rules: Mapping[str, PrimitiveRule]
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
            if primitive_name not in self.primitive_rules:
                raise NotImplementedError(
                    f"{primitive_name} has no machine code: write it by primitives that "
                    "`lanes.describe_supported_primitives()` lists, or give it a rule in "
                    "`lanes/rules.PRIMITIVE_RULES`."
                )
            for variable in equation.outvars:
                if LANE_AXIS_SENTINEL in variable.aval.shape[:-1]:
                    raise make_lane_axis_error(f"The result of {primitive_name}", variable.aval)
            operands = [read_jaxpr_atom(x, equation_index) for x in equation.invars]
            equation_results = self.primitive_rules[primitive_name](self, equation, operands)
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
            array_emitter_of_function, self.primitive_rules, self.llvm_function_by_jaxpr_id
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

"""Lowering of JAX traces to LLVM: equations of a trace one by one, and calls of other traces."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from vrw_jax.simd.array_emitter import (
    LANE_AXIS_SENTINEL,
    ArrayEmitter,
    lane_axis_error,
    shape_without_lanes,
    split_arrays,
)
from vrw_jax.simd.lazy_arrays import ArrayValue, as_shared
from vrw_jax.simd.llvm_library import ir
from vrw_jax.simd.value_emitter import Value, ValueEmitter

PrimitiveRule = Callable[["JaxprLowering", Any, list[ArrayValue]], list[ArrayValue]]
"""Rule of a primitive: a function of the lowering, an equation and its operands that emits
instructions and returns the results.
"""

NOINLINE_NAME = "noinline"

JAXPR_PARAMETERS = {  # primitive, and the parameter that contains the jaxpr it calls
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "custom_vjp_call": "call_jaxpr",
}


LOOP_PRIMITIVES = "while", "scan"


def noinline(function: Callable) -> Callable:
    """Return `function` marked so that machine code calls it as a separate function instead of
    inlining it.
    """

    def noinline(*arguments: Any) -> Any:
        return function(*arguments)

    return jax.jit(noinline)


class JaxprLowering:
    """Lowering of traces into the LLVM function of `emitter`, by a table of rules of primitives."""

    def __init__(
        self,
        emitter: ArrayEmitter,
        rules: Mapping[str, PrimitiveRule],
        functions: dict[int, Any] | None = None,
    ) -> None:
        self.emitter, self.rules = emitter, rules
        # Separate functions by the `id` of their trace, with the trace, whose reference keeps the
        # `id` valid.
        self.functions = {} if functions is None else functions

    def lower_jaxpr(
        self, closed_jaxpr: ClosedJaxpr, values: Sequence[ArrayValue]
    ) -> list[ArrayValue]:
        """Emit all equations of a trace for these arguments, and return its results."""
        jaxpr, emit_constants = closed_jaxpr.jaxpr, self.emitter.emit_constant_array
        last_uses, value_by_variable = _last_uses(jaxpr), dict[Any, ArrayValue]()

        def assign_variables(variables: Sequence[Any], values: Sequence[ArrayValue]) -> None:
            for variable, value in zip(variables, values, strict=True):
                value_by_variable[variable] = (
                    as_shared(value) if last_uses.get(variable) is None else value
                )

        assign_variables(jaxpr.invars, values)
        for variable, value in zip(jaxpr.constvars, closed_jaxpr.consts, strict=True):
            value_by_variable[variable] = emit_constants(np.asarray(value), variable.aval)

        def read_atom(atom: Any, equation_index: int) -> ArrayValue:
            if isinstance(atom, Literal):
                return emit_constants(np.asarray(atom.val), atom.aval)
            return (
                value_by_variable[atom]
                if last_uses[atom] == equation_index
                else as_shared(value_by_variable[atom])
            )

        for equation_index, equation in enumerate(jaxpr.eqns):
            if all(variable.aval.dtype == jax.dtypes.float0 for variable in equation.outvars):
                continue  # The derivative of an integer has no value, and no equation reads it.
            results = self._lower_equation(
                equation, [read_atom(x, equation_index) for x in equation.invars]
            )
            assign_variables(equation.outvars, results)
        return [read_atom(atom, len(jaxpr.eqns)) for atom in jaxpr.outvars]

    def _lower_equation(self, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
        """Emit one equation of a trace, and return its results."""
        name = equation.primitive.name
        if name not in self.rules:
            raise NotImplementedError(
                f"{name} has no machine code: write it by primitives that `simd.list_primitives()` "
                "lists, or give it a rule in `simd/rules.PRIMITIVE_RULES`."
            )
        for variable in equation.outvars:
            if LANE_AXIS_SENTINEL in variable.aval.shape[:-1]:
                raise lane_axis_error(f"The result of {name}", variable.aval)
        return self.rules[name](self, equation, values)

    def call_function(
        self, closed_jaxpr: ClosedJaxpr, values: Sequence[ArrayValue]
    ) -> list[ArrayValue]:
        """Emit a call of a trace as a separate function, which is defined on the first call, and
        return its results.
        """
        builder = self.emitter.builder
        if id(closed_jaxpr) not in self.functions:
            self.functions[id(closed_jaxpr)] = (self._define_function(closed_jaxpr), closed_jaxpr)
        function, _ = self.functions[id(closed_jaxpr)]
        returned_struct = builder.call(
            function, self.emitter.flatten_entries(values, closed_jaxpr.in_avals)
        )
        results = [
            builder.extract_value(returned_struct, i)
            for i in range(len(returned_struct.type.elements))
        ]
        return split_arrays(results, closed_jaxpr.out_avals)

    def _define_function(self, closed_jaxpr: ClosedJaxpr) -> ir.Function:
        """Return a new LLVM function that computes a trace.

        Its arguments are the entries of all arguments of the trace, and its result is a struct of
        the entries of all results.
        """
        entry_types = lambda avals: [
            self.emitter.entry_type_of(x)
            for x in avals
            for _ in range(math.prod(shape_without_lanes(x)))
        ]
        result_type = ir.LiteralStructType(entry_types(closed_jaxpr.out_avals))
        module = self.emitter.builder.module
        argument_type = ir.FunctionType(result_type, entry_types(closed_jaxpr.in_avals))
        function = ir.Function(module, argument_type, module.get_unique_name(NOINLINE_NAME))
        function.linkage = "internal"
        for attribute in ("noinline", "nounwind"):
            function.attributes.add(attribute)
        builder = ir.IRBuilder(function.append_basic_block("entry"))
        caller_emitter = self.emitter
        emitter = ArrayEmitter(
            ValueEmitter(builder, caller_emitter.emitter.width),
            caller_emitter.limits,
            caller_emitter.is_in_innermost_loop,
        )
        results = JaxprLowering(emitter, self.rules, self.functions).lower_jaxpr(
            closed_jaxpr, split_arrays(function.args, closed_jaxpr.in_avals)
        )
        result_struct: Value = ir.Constant(result_type, ir.Undefined)
        for i, value in enumerate(emitter.flatten_entries(results, closed_jaxpr.out_avals)):
            result_struct = builder.insert_value(result_struct, value, i)
        builder.ret(result_struct)
        return function


def _last_uses(jaxpr: Any) -> dict[Any, int | None]:
    """Return, for each variable, the index of the equation that may overwrite its memory, or None.

    That is the last equation that reads the variable, if all earlier ones are loops, which read
    nothing after they end.
    """
    last_uses: dict[Any, int | None] = {}
    is_loop = [equation.primitive.name in LOOP_PRIMITIVES for equation in jaxpr.eqns]
    for equation_index, atoms in enumerate(
        [*(equation.invars for equation in jaxpr.eqns), jaxpr.outvars]
    ):
        for atom in atoms:
            if not isinstance(atom, Literal):
                previous_equation_index = last_uses.get(atom, -1)
                is_last_use = previous_equation_index == -1 or (
                    previous_equation_index not in (None, equation_index)
                    and is_loop[previous_equation_index]
                )
                last_uses[atom] = equation_index if is_last_use else None
    return last_uses


def call_rule(jaxpr_parameter: str) -> PrimitiveRule:
    """Return the rule of a primitive that calls the jaxpr in the parameter `jaxpr_parameter`."""

    def emit_call(
        lowering: JaxprLowering, equation: Any, values: list[ArrayValue]
    ) -> list[ArrayValue]:
        """Emit the called trace, inline or, if it is marked by `noinline`, as a function; return
        its results.
        """
        closed_jaxpr = equation.params[jaxpr_parameter]
        if equation.params.get("name") == NOINLINE_NAME:
            return lowering.call_function(closed_jaxpr, values)
        return lowering.lower_jaxpr(closed_jaxpr, values)

    return emit_call

"""Lowering of JAX traces, equation by equation: results of a trace, and calls of other traces."""

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
"""A function that emits an equation with these operands, and returns its results."""

NOINLINE_NAME = "noinline"

JAXPR_PARAMETERS = {  # primitive: the parameter that is the trace it calls
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "custom_vjp_call": "call_jaxpr",
}


LOOP_PRIMITIVES = "while", "scan"


def noinline(function: Callable) -> Callable:
    """Return `function` compiled as a separate function of the machine code, which is called, not
    inlined.
    """

    def noinline(*arguments: Any) -> Any:
        return function(*arguments)

    return jax.jit(noinline)


class JaxprLowering:
    """Lowering of traces, by `rules` of their primitives, into the function of `emitter`."""

    def __init__(
        self,
        emitter: ArrayEmitter,
        rules: Mapping[str, PrimitiveRule],
        functions: dict[int, Any] | None = None,
    ) -> None:
        self.emitter, self.rules = emitter, rules
        # Separate functions by the trace's `id`, with the trace, which must stay alive.
        self.functions = {} if functions is None else functions

    def lower_jaxpr(
        self, closed_jaxpr: ClosedJaxpr, values: Sequence[ArrayValue]
    ) -> list[ArrayValue]:
        """Return the results of a trace for these values."""
        jaxpr, emit_constants = closed_jaxpr.jaxpr, self.emitter.emit_constants
        last_uses, value_by_variable = _last_uses(jaxpr), dict[Any, ArrayValue]()

        def bind(variables: Sequence[Any], values: Sequence[ArrayValue]) -> None:
            for variable, value in zip(variables, values, strict=True):
                value_by_variable[variable] = (
                    as_shared(value) if last_uses.get(variable) is None else value
                )

        bind(jaxpr.invars, values)
        for variable, value in zip(jaxpr.constvars, closed_jaxpr.consts, strict=True):
            value_by_variable[variable] = emit_constants(np.asarray(value), variable.aval)

        def read_atom(atom: Any, position: int) -> ArrayValue:
            if isinstance(atom, Literal):
                return emit_constants(np.asarray(atom.val), atom.aval)
            return (
                value_by_variable[atom]
                if last_uses[atom] == position
                else as_shared(value_by_variable[atom])
            )

        for position, equation in enumerate(jaxpr.eqns):
            if all(variable.aval.dtype == jax.dtypes.float0 for variable in equation.outvars):
                continue  # the derivative of an integer, which no equation reads
            results = self._lower_equation(
                equation, [read_atom(x, position) for x in equation.invars]
            )
            bind(equation.outvars, results)
        return [read_atom(atom, len(jaxpr.eqns)) for atom in jaxpr.outvars]

    def _lower_equation(self, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
        """Return the results of one equation of a trace."""
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
        """Emit a call of a separate function, which is defined once, and return its results."""
        build = self.emitter.builder
        if id(closed_jaxpr) not in self.functions:
            self.functions[id(closed_jaxpr)] = (self._define_function(closed_jaxpr), closed_jaxpr)
        function, _ = self.functions[id(closed_jaxpr)]
        returned_struct = build.call(
            function, self.emitter.flatten_entries(values, closed_jaxpr.in_avals)
        )
        results = [
            build.extract_value(returned_struct, i)
            for i in range(len(returned_struct.type.elements))
        ]
        return split_arrays(results, closed_jaxpr.out_avals)

    def _define_function(self, closed_jaxpr: ClosedJaxpr) -> ir.Function:
        """Define a function from the entries of all arguments to those of all results."""
        entry_types = lambda avals: [
            self.emitter.entry_type_of(x)
            for x in avals
            for _ in range(math.prod(shape_without_lanes(x)))
        ]
        result_type = ir.LiteralStructType(entry_types(closed_jaxpr.out_avals))
        module = self.emitter.builder.module
        kind = ir.FunctionType(result_type, entry_types(closed_jaxpr.in_avals))
        function = ir.Function(module, kind, module.get_unique_name(NOINLINE_NAME))
        function.linkage = "internal"
        for attribute in ("noinline", "nounwind"):
            function.attributes.add(attribute)
        build = ir.IRBuilder(function.append_basic_block("entry"))
        caller = self.emitter
        emitter = ArrayEmitter(
            ValueEmitter(build, caller.emitter.width), caller.limits, caller.is_unrolled
        )
        results = JaxprLowering(emitter, self.rules, self.functions).lower_jaxpr(
            closed_jaxpr, split_arrays(function.args, closed_jaxpr.in_avals)
        )
        result_struct: Value = ir.Constant(result_type, ir.Undefined)
        for i, value in enumerate(emitter.flatten_entries(results, closed_jaxpr.out_avals)):
            result_struct = build.insert_value(result_struct, value, i)
        build.ret(result_struct)
        return function


def _last_uses(jaxpr: Any) -> dict[Any, int | None]:
    """Return, for each variable, the position of the equation that may overwrite it.

    It is the last equation that reads the variable, if all earlier ones are loops, which read
    nothing after they end.
    """
    last_uses: dict[Any, int | None] = {}
    is_loop = [equation.primitive.name in LOOP_PRIMITIVES for equation in jaxpr.eqns]
    for position, atoms in enumerate(
        [*(equation.invars for equation in jaxpr.eqns), jaxpr.outvars]
    ):
        for atom in atoms:
            if not isinstance(atom, Literal):
                previous = last_uses.get(atom, -1)
                is_last_use = previous == -1 or (
                    previous not in (None, position) and is_loop[previous]
                )
                last_uses[atom] = position if is_last_use else None
    return last_uses


def call_rule(parameter: str) -> PrimitiveRule:
    """Return the rule of a primitive that calls the trace in this parameter."""

    def emit_call(
        lowering: JaxprLowering, equation: Any, values: list[ArrayValue]
    ) -> list[ArrayValue]:
        """Lower another trace: inline or, if marked by `noinline`, as a function."""
        closed_jaxpr = equation.params[parameter]
        if equation.params.get("name") == NOINLINE_NAME:
            return lowering.call_function(closed_jaxpr, values)
        return lowering.lower_jaxpr(closed_jaxpr, values)

    return emit_call

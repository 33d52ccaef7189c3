"""Lowering of JAX traces, equation by equation: results of a trace, and calls of other traces."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import llvmlite.ir as ir
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from vrw_jax.simd.arrays import LANES, Arrays, arrays_of, shape_of, taken_for_lanes
from vrw_jax.simd.fields import Entries, shared
from vrw_jax.simd.numbers import Numbers, Value

Rule = Callable[["Traces", Any, list[Entries]], list[Entries]]
"""A function that emits an equation with these operands, and returns its results."""

APART = "apart"

CALLS = {  # primitive: the parameter that is the trace it calls
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "custom_vjp_call": "call_jaxpr",
}


LOOPS = "while", "scan"


def apart(function: Callable) -> Callable:
    """Return `function` compiled as a separate function of the machine code, which is called, not
    inlined.
    """

    def apart(*arguments: Any) -> Any:
        return function(*arguments)

    return jax.jit(apart)


class Traces:
    """Lowering of traces, by `rules` of their primitives, into the function of `emitter`."""

    def __init__(
        self, arrays: Arrays, rules: Mapping[str, Rule], functions: dict[int, Any] | None = None
    ) -> None:
        self.arrays, self.rules = arrays, rules
        # Separate functions by the trace's `id`, with the trace, which must stay alive.
        self.functions = {} if functions is None else functions

    def closed(self, closed: ClosedJaxpr, values: Sequence[Entries]) -> list[Entries]:
        """Return the results of a trace for these values."""
        jaxpr, constants_of = closed.jaxpr, self.arrays.constants_of
        takers, places = _takers(jaxpr), dict[Any, Entries]()

        def put(variables: Sequence[Any], values: Sequence[Entries]) -> None:
            for variable, value in zip(variables, values, strict=True):
                places[variable] = shared(value) if takers.get(variable) is None else value

        put(jaxpr.invars, values)
        for variable, value in zip(jaxpr.constvars, closed.consts, strict=True):
            places[variable] = constants_of(np.asarray(value), variable.aval)

        def read(atom: Any, place: int) -> Entries:
            if isinstance(atom, Literal):
                return constants_of(np.asarray(atom.val), atom.aval)
            return places[atom] if takers[atom] == place else shared(places[atom])

        for place, equation in enumerate(jaxpr.eqns):
            if all(variable.aval.dtype == jax.dtypes.float0 for variable in equation.outvars):
                continue  # the derivative of an integer, which no equation reads
            results = self._results(equation, [read(x, place) for x in equation.invars])
            put(equation.outvars, results)
        return [read(atom, len(jaxpr.eqns)) for atom in jaxpr.outvars]

    def _results(self, equation: Any, values: list[Entries]) -> list[Entries]:
        name = equation.primitive.name
        if name not in self.rules:
            raise NotImplementedError(
                f"{name} has no machine code: write it by primitives that `simd.primitives()` "
                "lists, or give it a rule in RULES."
            )
        for variable in equation.outvars:
            if LANES in variable.aval.shape[:-1]:
                raise taken_for_lanes(f"The result of {name}", variable.aval)
        return self.rules[name](self, equation, values)

    def call(self, closed: ClosedJaxpr, values: Sequence[Entries]) -> list[Entries]:
        """Emit a call of a separate function, which is defined once."""
        build = self.arrays.builder
        if id(closed) not in self.functions:
            self.functions[id(closed)] = (self._function(closed), closed)
        function, _ = self.functions[id(closed)]
        told = build.call(function, self.arrays.flat(values, closed.in_avals))
        results = [build.extract_value(told, i) for i in range(len(told.type.elements))]
        return arrays_of(results, closed.out_avals)

    def _function(self, closed: ClosedJaxpr) -> ir.Function:
        """Define a function from the entries of all arguments to those of all results."""
        kinds = lambda avals: [
            self.arrays.kind_of(x) for x in avals for _ in range(math.prod(shape_of(x)))
        ]
        told = ir.LiteralStructType(kinds(closed.out_avals))
        module = self.arrays.builder.module
        kind = ir.FunctionType(told, kinds(closed.in_avals))
        function = ir.Function(module, kind, module.get_unique_name(APART))
        function.linkage = "internal"
        for attribute in ("noinline", "nounwind"):
            function.attributes.add(attribute)
        build = ir.IRBuilder(function.append_basic_block("entry"))
        outer = self.arrays
        arrays = Arrays(Numbers(build, outer.numbers.width), outer.written_out, outer.small)
        results = Traces(arrays, self.rules, self.functions).closed(
            closed, arrays_of(function.args, closed.in_avals)
        )
        whole: Value = ir.Constant(told, ir.Undefined)
        for i, value in enumerate(arrays.flat(results, closed.out_avals)):
            whole = build.insert_value(whole, value, i)
        build.ret(whole)
        return function


def _takers(jaxpr: Any) -> dict[Any, int | None]:
    """Return, for each variable, the position of the equation that may overwrite it.

    It is the last equation that reads the variable, if all earlier ones are loops, which read
    nothing after they end.
    """
    takers: dict[Any, int | None] = {}
    loops = [equation.primitive.name in LOOPS for equation in jaxpr.eqns]
    for place, atoms in enumerate([*(equation.invars for equation in jaxpr.eqns), jaxpr.outvars]):
        for atom in atoms:
            if not isinstance(atom, Literal):
                before = takers.get(atom, -1)
                ends = before == -1 or (before not in (None, place) and loops[before])
                takers[atom] = place if ends else None
    return takers


def called(parameter: str) -> Rule:
    """Return the rule of a primitive that calls the trace in this parameter."""

    def write(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
        """Lower another trace: inline or, if marked by `noinline`, as a function."""
        closed = equation.params[parameter]
        if equation.params.get("name") == APART:
            return traces.call(closed, values)
        return traces.closed(closed, values)

    return write

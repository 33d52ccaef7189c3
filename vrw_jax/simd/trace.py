"""What a trace of JAX says, equation by equation: the results of a trace, calls of other traces."""

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
"""Writes an equation with these operands, and tells its results."""

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
    """`function`, that machine code is to call rather than to contain wherever it is called."""

    def apart(*arguments: Any) -> Any:
        return function(*arguments)

    return jax.jit(apart)


class Traces:
    """Writes what traces say, by `rules` of their primitives, into the function of `arrays`."""

    def __init__(
        self, arrays: Arrays, rules: Mapping[str, Rule], functions: dict[int, Any] | None = None
    ) -> None:
        self.arrays, self.rules = arrays, rules
        # Functions of their own by the trace's `id`, with the trace: it must live on.
        self.functions = {} if functions is None else functions

    def closed(self, closed: ClosedJaxpr, values: Sequence[Entries]) -> list[Entries]:
        """The results of a trace for these values."""
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
                continue  # the derivative of a whole number, which nothing reads
            results = self._results(equation, [read(x, place) for x in equation.invars])
            put(equation.outvars, results)
        return [read(atom, len(jaxpr.eqns)) for atom in jaxpr.outvars]

    def _results(self, equation: Any, values: list[Entries]) -> list[Entries]:
        name = equation.primitive.name
        if name not in self.rules:
            raise NotImplementedError(
                f"{name} has no machine code: write it by primitives that `simd.primitives()` "
                "tells, or give it a rule in RULES."
            )
        for variable in equation.outvars:
            if LANES in variable.aval.shape[:-1]:
                raise taken_for_lanes(f"The result of {name}", variable.aval)
        return self.rules[name](self, equation, values)

    def call(self, closed: ClosedJaxpr, values: Sequence[Entries]) -> list[Entries]:
        """A call of a function of its own, which is written once."""
        build = self.arrays.builder
        if id(closed) not in self.functions:
            self.functions[id(closed)] = (self._function(closed), closed)
        function, _ = self.functions[id(closed)]
        told = build.call(function, self.arrays.flat(values, closed.in_avals))
        results = [build.extract_value(told, i) for i in range(len(told.type.elements))]
        return arrays_of(results, closed.out_avals)

    def _function(self, closed: ClosedJaxpr) -> ir.Function:
        """From the entries of all arguments to those of all results."""
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
    """By variable the place of the equation that may overwrite it: the last one that reads it,
    where those before are loops, after which nothing is left to be read."""
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
    """The rule of a primitive that calls the trace which is this parameter."""

    def write(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
        """Another trace: within this one or, set `apart`, as a function."""
        closed = equation.params[parameter]
        if equation.params.get("name") == APART:
            return traces.call(closed, values)
        return traces.closed(closed, values)

    return write

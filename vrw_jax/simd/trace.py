"""From JAX's trace of a function over lanes to LLVM's intermediate language: calls and loops."""

import math
from collections import ChainMap
from collections.abc import Callable, Sequence
from typing import Any

import jax
import llvmlite.ir as ir
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from vrw_jax.simd.arrays import HELD, HELD_INSIDE, Arrays, array_of, has_lanes, shape_of
from vrw_jax.simd.fields import Entries, Field, Memory, Updated
from vrw_jax.simd.numbers import LONG, Value

APART = "apart"

CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}


def apart(function: Callable) -> Callable:
    """`function`, that machine code is to call rather than to contain wherever it is called."""

    def apart(*arguments: Any) -> Any:
        return function(*arguments)

    return jax.jit(apart)


class Traces(Arrays):
    """Writes what traces say into a function of `builder`'s module."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        super().__init__(builder, width)
        self._functions: dict[int, ir.Function] = {}

    def closed(self, closed: ClosedJaxpr, values: Sequence[Entries]) -> list[Entries]:
        """The results of a trace for these values."""
        jaxpr = closed.jaxpr
        places: dict[Any, Entries] = dict(zip(jaxpr.invars, values, strict=True))
        for variable, value in zip(jaxpr.constvars, closed.consts, strict=True):
            places[variable] = self.constants_of(np.asarray(value), variable.aval)

        def read(atom: Any) -> Entries:
            if isinstance(atom, Literal):
                return self.constants_of(np.asarray(atom.val), atom.aval)
            return places[atom]

        for equation in jaxpr.eqns:
            results = self._equation(equation, [read(atom) for atom in equation.invars])
            places.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _equation(self, equation: Any, values: list[Entries]) -> list[Entries]:
        name, params = equation.primitive.name, equation.params
        if name in CALLS and params.get("name") == APART:
            return self._apart(params[CALLS[name]], values)
        if name in CALLS:
            return self.closed(params[CALLS[name]], values)
        if name == "while":
            return self._while(params, values)
        if name == "scan":
            given = [atom.aval for atom in equation.invars]
            return self._scan(params, values, given, [x.aval for x in equation.outvars])
        if name == "optimization_barrier":
            return [self.in_memory(x) if isinstance(x, Field) else x for x in values]
        return [self.primitive(equation, values)]

    def _apart(self, closed: ClosedJaxpr, values: Sequence[Entries]) -> list[Entries]:
        """A call of a function of its own, which is written once."""
        key = id(closed)
        if key not in self._functions:
            self.alive.append(closed)
            self._functions[key] = self._function(closed)
        flat = self.flat(values, closed.in_avals)
        told = self.builder.call(self._functions[key], flat)
        results = [self.builder.extract_value(told, i) for i in range(len(told.type.elements))]
        return _arrays_of(results, closed.out_avals)

    def _function(self, closed: ClosedJaxpr) -> ir.Function:
        """From the entries of all arguments to those of all results."""
        kinds = lambda avals: [
            self.kind_of(x) for x in avals for _ in range(math.prod(shape_of(x)))
        ]
        told = ir.LiteralStructType(kinds(closed.out_avals))
        module, outside = self.builder.module, (self.builder, self.known)
        kind = ir.FunctionType(told, kinds(closed.in_avals))
        function = ir.Function(module, kind, module.get_unique_name(APART))
        function.linkage = "internal"
        function.attributes.add("noinline")
        self.builder, self.known = ir.IRBuilder(function.append_basic_block("entry")), ChainMap()
        results = self.closed(closed, _arrays_of(function.args, closed.in_avals))
        whole: Value = ir.Constant(told, ir.Undefined)
        for i, value in enumerate(self.flat(results, closed.out_avals)):
            whole = self.builder.insert_value(whole, value, i)
        self.builder.ret(whole)
        self.builder, self.known = outside
        return function

    def flat(self, arrays: Sequence[Entries], avals: Sequence[Any]) -> list[Value]:
        """All entries in a row, those of lanes as vectors."""
        flat: list[Value] = []
        for array, aval in zip(arrays, avals, strict=True):
            full = np.broadcast_to(self.entries(array), shape_of(aval)).ravel()
            flat += [self.spread(x) if has_lanes(aval) else x for x in full]
        return flat

    def _while(self, params: Any, values: list[Entries]) -> list[Entries]:
        n_goes, n_body = params["cond_nconsts"], params["body_nconsts"]
        fixed, own = values[:n_goes], values[n_goes : n_goes + n_body]
        carry = _Carry(self, params["body_jaxpr"].out_avals, HELD)

        def goes_on(flat: list[Value]) -> Value:
            told = self.closed(params["cond_jaxpr"], [*fixed, *carry.arrays(flat)])
            return self.entries(told[0]).item()

        def body(flat: list[Value]) -> list[Value]:
            told = self.closed(params["body_jaxpr"], [*own, *carry.arrays(flat)])
            return carry.on(told)

        start = carry.start(values[n_goes + n_body :])
        return carry.arrays(self.loop(start, goes_on, body))

    def _scan(
        self, params: Any, values: list[Entries], given: Sequence[Any], told: Sequence[Any]
    ) -> list[Entries]:
        """A loop of known length; what it reads and writes turn by turn lies in memory."""
        n_fixed, n_carried = params["num_consts"], params["num_carry"]
        inner, length = params["jaxpr"], params["length"]
        read = [self.in_memory(x) for x in values[n_fixed + n_carried :]]
        written = [self.room(shape_of(aval), self.kind_of(aval)) for aval in told[n_carried:]]
        outside, self.written_out = self.written_out, not _has_loops(inner.jaxpr)
        fixed = values[:n_fixed]
        limit = HELD_INSIDE if self.written_out else HELD
        carry = _Carry(self, inner.out_avals[:n_carried], limit)

        def part(memory: Memory, turn: Value) -> Entries:
            some = memory.part(turn)
            inside = self.written_out or math.prod(some.shape) <= HELD
            return self.entries(some) if inside else some

        def body(turn: Value, flat: list[Value]) -> list[Value]:
            if params["reverse"]:
                turn = self.builder.sub(ir.Constant(LONG, length - 1), turn)
            some = [part(memory, turn) for memory in read]
            results = self.closed(inner, [*fixed, *carry.arrays(flat), *some])
            for memory, value in zip(written, results[n_carried:], strict=True):
                self.fill(memory.part(turn), value)
            return carry.on(results[:n_carried])

        start = carry.start(values[n_fixed : n_fixed + n_carried])
        last = carry.arrays(self.counted(length, body, start))
        self.written_out = outside
        return [*last, *written]


class _Carry:
    """Arrays between the turns of a loop: in registers up to `limit` entries, else in memory."""

    def __init__(self, arrays: Traces, avals: Sequence[Any], limit: int | float) -> None:
        self.owner, self.avals = arrays, avals
        self.places = [
            arrays.room(shape_of(aval), arrays.kind_of(aval))
            if math.prod(shape_of(aval)) > limit
            else None
            for aval in avals
        ]

    def arrays(self, flat: Sequence[Value]) -> list[Entries]:
        """What is carried, in a turn or after the last one."""
        held = [aval for aval, place in zip(self.avals, self.places, strict=True) if place is None]
        left = iter(_arrays_of(flat, held))
        # A field of its own each time: what was known of it is past.
        return [
            next(left) if place is None else Memory(self.owner, place.shape, place.kind, place.base)
            for place in self.places
        ]

    def start(self, arrays: Sequence[Entries]) -> list[Value]:
        """Values for registers are returned, the others stored."""
        for array, place in zip(arrays, self.places, strict=True):
            if place is not None:
                self.owner.fill(place, array)
        return self._in_registers(arrays)

    def on(self, arrays: Sequence[Entries]) -> list[Value]:
        """From one turn to the next: new values may depend on any of the old."""
        flat = self._in_registers(arrays)
        moves: list[tuple[Memory, Memory | Updated]] = []
        for array, place in zip(arrays, self.places, strict=True):
            if place is None or (isinstance(array, Memory) and array.base is place.base):
                continue
            if isinstance(array, Updated) and array.whole.base is place.base:
                moves.append((place, array.ready()))
            else:
                copy = self.owner.room(place.shape, place.kind)
                self.owner.fill(copy, array)
                moves.append((place, copy))
        for place, fresh in moves:
            if isinstance(fresh, Updated):
                fresh.store_into(place)
            else:
                self.owner.fill(place, fresh)
        return flat

    def _in_registers(self, arrays: Sequence[Entries]) -> list[Value]:
        triples = zip(arrays, self.avals, self.places, strict=True)
        held = [(array, aval) for array, aval, place in triples if place is None]
        return self.owner.flat([array for array, _ in held], [aval for _, aval in held])


def _has_loops(jaxpr: Any) -> bool:
    """Whether a trace has a loop anywhere."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("while", "scan"):
            return True
        inner = equation.params.get(CALLS.get(equation.primitive.name, ""))
        if inner is not None and _has_loops(inner.jaxpr):
            return True
    return False


def _arrays_of(flat: Sequence[Value], avals: Sequence[Any]) -> list[Entries]:
    """The inverse of `Traces.flat`."""
    found: list[Entries] = []
    begin = 0
    for aval in avals:
        shape = shape_of(aval)
        end = begin + math.prod(shape)
        found.append(array_of(shape, flat[begin:end]))
        begin = end
    return found

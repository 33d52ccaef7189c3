"""Lowering of loops: carried arrays are kept in registers or, if large, in memory."""

import math
from collections.abc import Sequence
from typing import Any

import llvmlite.ir as ir

from vrw_jax.simd.arrays import HELD, HELD_INSIDE, LANES, Arrays, arrays_of, shape_of
from vrw_jax.simd.fields import Entries, Memory, Turned, Updated, shared
from vrw_jax.simd.numbers import LONG, Value
from vrw_jax.simd.trace import CALLS, Traces


def while_(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
    """Emit a loop with a condition, of which each group of lanes has its own."""
    arrays, params = traces.arrays, equation.params
    n_goes, n_body = params["cond_nconsts"], params["body_nconsts"]
    read = list(map(shared, values[: n_goes + n_body]))  # in each iteration
    fixed, own = read[:n_goes], read[n_goes:]
    begin = values[n_goes + n_body :]
    carry = _Carry(arrays, params["body_jaxpr"].out_avals, HELD, begin)

    def goes_on(flat: list[Value]) -> Value:
        told = traces.closed(params["cond_jaxpr"], [*fixed, *map(shared, carry.arrays(flat))])
        return arrays.entries(told[0]).item()

    def body(flat: list[Value]) -> list[Value]:
        told = traces.closed(params["body_jaxpr"], [*own, *carry.arrays(flat)])
        return carry.on(told)

    start = carry.start(begin)
    return carry.arrays(arrays.numbers.loop(start, goes_on, body))


def scan(traces: Traces, equation: Any, values: list[Entries]) -> list[Entries]:
    """Emit a loop of known length, whose scanned inputs and stacked outputs are in memory."""
    arrays, params = traces.arrays, equation.params
    n_fixed, n_carried = _fixed_and_carried(params)
    inner, length = params["jaxpr"], params["length"]
    told = [variable.aval for variable in equation.outvars[n_carried:]]
    if length == LANES and (told or len(values) > n_fixed + n_carried):
        raise NotImplementedError(
            f"scan reads or writes along an axis of {LANES}, which is the lanes': do the same to "
            "each by itself, and give other axes another length."
        )
    given = values[n_fixed + n_carried :]
    read = [x if isinstance(x, Turned) else arrays.in_memory(x) for x in given]
    written = [arrays.room(shape_of(aval), arrays.kind_of(aval)) for aval in told]
    outside, arrays.written_out = arrays.written_out, not _has_loops(inner.jaxpr)
    fixed, begin = list(map(shared, values[:n_fixed])), values[n_fixed : n_fixed + n_carried]
    limit = HELD_INSIDE if arrays.written_out else HELD
    carry = _Carry(arrays, inner.out_avals[:n_carried], limit, begin)

    def part(memory: Memory | Turned, turn: Value) -> Entries:
        some = memory.part(turn)
        inside = arrays.written_out or math.prod(some.shape) <= HELD
        return arrays.entries(some) if inside else some

    def body(turn: Value, flat: list[Value]) -> list[Value]:
        if params["reverse"]:
            turn = arrays.builder.sub(ir.Constant(LONG, length - 1), turn)
        some = [part(memory, turn) for memory in read]
        results = traces.closed(inner, [*fixed, *carry.arrays(flat), *some])
        for memory, value in zip(written, results[n_carried:], strict=True):
            arrays.fill(memory.part(turn), value)
        return carry.on(results[:n_carried])

    start = carry.start(begin)
    last = carry.arrays(arrays.counted(length, body, start))
    arrays.written_out = outside
    return [*last, *written]


def _fixed_and_carried(params: dict[str, Any]) -> tuple[int, int]:
    """Return the number of constants of a scan, and the number of values that it carries."""
    if "ft_in" in params:  # JAX from 0.11 or 0.12 on
        fixed, carried, _ = params["ft_in"].unpack()
        return len(fixed), len(carried)
    return params["num_consts"], params["num_carry"]


class _Carry:
    """Arrays carried from one iteration of a loop to the next.

    They are in registers up to `max_registers` entries, otherwise in memory. The memory is
    allocated for the loop, or is that of the initial value if no other array uses it.
    """

    def __init__(
        self, arrays: Arrays, avals: Sequence[Any], limit: int | float, begin: Sequence[Entries]
    ) -> None:
        self.owner, self.avals = arrays, avals
        self.places = [
            self._place(aval, array) if math.prod(shape_of(aval)) > limit else None
            for aval, array in zip(avals, begin, strict=True)
        ]

    def _place(self, aval: Any, begin: Entries) -> Memory:
        kind = self.owner.kind_of(aval)
        begin = begin.whole if isinstance(begin, Updated) else begin
        if isinstance(begin, Memory) and begin.free and begin.kind == kind:
            return begin
        return self.owner.room(shape_of(aval), kind)

    def arrays(self, flat: Sequence[Value]) -> list[Entries]:
        """Return the carried arrays, in an iteration or after the last one."""
        held = [aval for aval, place in zip(self.avals, self.places, strict=True) if place is None]
        left = iter(arrays_of(flat, held))
        # A new object each time, because values cached for the old one are outdated.
        return [
            next(left)
            if place is None
            else Memory(self.owner, place.shape, place.kind, place.base, free=True)
            for place in self.places
        ]

    def start(self, arrays: Sequence[Entries]) -> list[Value]:
        """Return the initial values of registers, and store the others."""
        for array, place in zip(arrays, self.places, strict=True):
            if place is None or array is place:
                continue
            if isinstance(array, Updated) and array.whole is place:
                array.ready().store_into(place)
            else:
                self.owner.fill(place, array)
        return self._in_registers(arrays)

    def on(self, arrays: Sequence[Entries]) -> list[Value]:
        """Return the registers of the next iteration, and store the others.

        New values may depend on any of the old ones.
        """
        flat = self._in_registers(arrays)
        moves: list[tuple[Memory, Memory | Updated]] = []
        for array, place in zip(arrays, self.places, strict=True):
            if place is None or (isinstance(array, Memory) and array.base is place.base):
                continue
            if isinstance(array, Updated) and getattr(array.whole, "base", None) is place.base:
                moves.append((place, array.ready()))
            elif isinstance(array, Memory) and self._apart(array):
                moves.append((place, array))
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

    def _apart(self, array: Memory) -> bool:
        """Return whether the array has memory that no carried array uses."""
        rooms = [place.base for place in self.places if place is not None]
        return isinstance(array.base, ir.AllocaInstr) and array.base not in rooms

    def _in_registers(self, arrays: Sequence[Entries]) -> list[Value]:
        triples = zip(arrays, self.avals, self.places, strict=True)
        held = [(array, aval) for array, aval, place in triples if place is None]
        return self.owner.flat([array for array, _ in held], [aval for _, aval in held])


def _has_loops(jaxpr: Any) -> bool:
    """Return whether a trace contains a loop at any level."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("while", "scan"):
            return True
        inner = equation.params.get(CALLS.get(equation.primitive.name, ""))
        if inner is not None and _has_loops(inner.jaxpr):
            return True
    return False

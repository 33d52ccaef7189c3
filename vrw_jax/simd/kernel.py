"""An LLVM module for a trace: a loop over groups of lanes with its inputs and outputs."""

import math
from typing import Any

import llvmlite.ir as ir
from jax.extend.core import ClosedJaxpr

from vrw_jax.simd.arrays import HELD, LANES, SMALL, Arrays, has_lanes, taken_for_lanes
from vrw_jax.simd.fields import Entries, Field, Index
from vrw_jax.simd.handler import add_handler
from vrw_jax.simd.numbers import BYTE, LONG, NUMBERS, TRUTH, Numbers, Value
from vrw_jax.simd.rules import RULES
from vrw_jax.simd.trace import Traces

NAME = "lanes"


def module_text(closed: ClosedJaxpr, width: int, small: int = SMALL) -> str:
    """Return the LLVM text of the kernel, which computes a range of groups of lanes.

    Its signature is `void lanes(const void **inputs, void **outputs, int64 lanes, int64 begin,
    int64 end)`. The function loops over groups of `width` lanes. A single lane is computed twice,
    as a vector, because LLVM's code for scalars differs in the last digits.
    """
    _check(closed)
    module = ir.Module(NAME)
    pointer = ir.PointerType()
    kernel = ir.Function(
        module, ir.FunctionType(ir.VoidType(), [pointer, pointer, LONG, LONG, LONG]), NAME
    )
    kernel.attributes.add("nounwind")
    build = ir.IRBuilder(kernel.append_basic_block("entry"))
    arrays = Arrays(Numbers(build, max(width, 2)), small=small)
    given, told, n_lanes, begin, end = kernel.args
    inputs, outputs = closed.in_avals, closed.out_avals

    def entry(base: Value, index: int) -> Value:
        place = build.gep(base, [ir.Constant(LONG, index)], source_etype=pointer)
        return build.load(place, typ=pointer)

    sources = [entry(given, i) for i in range(len(inputs))]
    targets = [entry(told, i) for i in range(len(outputs))]

    def group(first: Value, _: Any) -> list[Value]:
        rows = _Rows(arrays, width == 1, n_lanes, build.mul(first, ir.Constant(LONG, width)))
        values = [rows.read(*pair) for pair in zip(sources, inputs, strict=True)]
        results = Traces(arrays, RULES).closed(closed, values)
        for target, aval, value in zip(targets, outputs, results, strict=True):
            rows.write(target, aval, value)
        return []

    arrays.range(begin, end, group)
    build.ret_void()
    add_handler(module, kernel, len(inputs), len(outputs), width)
    return str(module)


def _check(closed: ClosedJaxpr) -> None:
    """Raise an error unless the lanes are the last axis of every argument and result, and
    no other.
    """
    for what, avals in (("An argument", closed.in_avals), ("A result", closed.out_avals)):
        for aval in avals:
            if LANES in aval.shape[:-1]:
                raise taken_for_lanes(what, aval)
    for aval in closed.out_avals:
        if not has_lanes(aval):
            raise NotImplementedError(
                f"A result has the shape {aval.str_short()}, the same for all lanes: compute it "
                "outside, or add zeros of the lanes."
            )


class _Rows:
    """Access to arrays outside for a group of lanes: they are stored row after row, lanes last."""

    def __init__(self, arrays: Arrays, alone: bool, n_lanes: Value, lane: Value) -> None:
        self.arrays, self.alone, self.n_lanes, self.lane = arrays, alone, n_lanes, lane

    def read(self, base: Value, aval: Any) -> Entries:
        """Return an argument; a number without axes is the same for all lanes."""
        build = self.arrays.builder

        def at(index: Index) -> Value:
            where, kind = self._place(base, aval, index)
            value = build.load(where, typ=kind, align=aval.dtype.itemsize)
            if aval.dtype.kind == "b":
                value = build.icmp_signed("!=", value, self.arrays.numbers.constant(kind, 0))
            return self.arrays.numbers.spread(value) if self.alone and aval.shape else value

        field = Field(aval.shape[:-1], self.arrays.kind_of(aval), at)
        return self.arrays.entries(field) if math.prod(field.shape) <= HELD else field

    def write(self, base: Value, aval: Any, value: Entries) -> None:
        """Store a result."""
        build = self.arrays.builder

        def store(index: Index, _: Any) -> list[Value]:
            where, kind = self._place(base, aval, index)
            whole = self.arrays.numbers.spread(self.arrays.entry(value, index))
            whole = build.extract_element(whole, ir.Constant(LONG, 0)) if self.alone else whole
            whole = build.zext(whole, kind) if aval.dtype.kind == "b" else whole
            build.store(whole, where, align=aval.dtype.itemsize)
            return []

        self.arrays.each(aval.shape[:-1], store)

    def _place(self, base: Value, aval: Any, index: Index) -> tuple[Value, ir.Type]:
        """Return the address of a row's lanes, and the type in which they are stored."""
        build, number = self.arrays.builder, NUMBERS[aval.dtype.name]
        number = BYTE if number == TRUTH else number
        if aval.shape == ():
            return base, number
        row = self.arrays.linear(index, aval.shape[:-1])
        where = build.add(build.mul(row, self.n_lanes), self.lane)
        kind = number if self.alone else self.arrays.numbers.vector(number)
        return build.gep(base, [where], source_etype=number), kind

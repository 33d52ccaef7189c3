"""A trace as a module of LLVM: a loop over groups of lanes, what it reads, and what it writes."""

import math
from typing import Any

import llvmlite.ir as ir
from jax.extend.core import ClosedJaxpr

from vrw_jax.simd.arrays import HELD
from vrw_jax.simd.ffi import add_handler
from vrw_jax.simd.fields import Entries, Field, Index
from vrw_jax.simd.numbers import BYTE, LONG, NUMBERS, TRUTH
from vrw_jax.simd.trace import Traces

NAME = "lanes"


def module_text(closed: ClosedJaxpr, width: int) -> str:
    """`void lanes(const void **given, void **told, int64 lanes, int64 begin, int64 end)`.

    Over groups of lanes; arrays lie there row after row, lanes last.
    """
    module = ir.Module(NAME)
    pointer = ir.PointerType()
    kernel = ir.Function(
        module, ir.FunctionType(ir.VoidType(), [pointer, pointer, LONG, LONG, LONG]), NAME
    )
    build = ir.IRBuilder(kernel.append_basic_block("entry"))
    arrays = Traces(build, width)
    given, told, n_lanes, begin, end = kernel.args
    inputs, outputs = closed.in_avals, closed.out_avals

    def entry(base: Any, index: int) -> Any:
        place = build.gep(base, [ir.Constant(LONG, index)], source_etype=pointer)
        return build.load(place, typ=pointer)

    sources = [entry(given, i) for i in range(len(inputs))]
    targets = [entry(told, i) for i in range(len(outputs))]

    def group(first: Any, _: Any) -> list[Any]:
        lane = build.mul(first, ir.Constant(LONG, width))

        def place(base: Any, aval: Any, index: Index) -> tuple[Any, ir.Type]:
            """Where a row's lanes are, and as what they lie there."""
            number = NUMBERS[aval.dtype.name]
            number = BYTE if number == TRUTH else number
            if aval.shape == ():
                return base, number
            row = arrays.linear(index, aval.shape[:-1])
            where = build.add(build.mul(row, n_lanes), lane)
            return build.gep(base, [where], source_etype=number), arrays.vector(number)

        def input_of(base: Any, aval: Any) -> Entries:
            def at(index: Index) -> Any:
                where, kind = place(base, aval, index)
                value = build.load(where, typ=kind, align=aval.dtype.itemsize)
                truth = aval.dtype == bool
                return build.icmp_signed("!=", value, arrays.constant(kind, 0)) if truth else value

            field = Field(aval.shape[:-1], arrays.kind_of(aval), at)
            return arrays.entries(field) if math.prod(field.shape) <= HELD else field

        def write(base: Any, aval: Any, value: Entries) -> None:
            def store(index: Index, _: Any) -> list[Any]:
                where, kind = place(base, aval, index)
                whole = arrays.spread(arrays.entry(value, index))
                whole = build.zext(whole, kind) if kind.element == BYTE else whole
                build.store(whole, where, align=aval.dtype.itemsize)
                return []

            arrays.each(aval.shape[:-1], store)

        values = [input_of(*pair) for pair in zip(sources, inputs, strict=True)]
        results = arrays.closed(closed, values)
        for target, aval, value in zip(targets, outputs, results, strict=True):
            write(target, aval, value)
        return []

    arrays.range(begin, end, group)
    build.ret_void()
    add_handler(module, kernel, len(inputs), len(outputs), width)
    return str(module)

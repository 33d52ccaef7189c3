"""Functions over lanes as machine code for CPUs: eight lanes side by side, from first to last line.

XLA on CPU makes a loop over all lanes of every few operations, with results in memory between them,
and a `while` waits for the slowest of hundreds. Here the trace of the whole function becomes one
loop over groups of a few lanes, compiled by LLVM: a group's numbers stay in registers, and it waits
for none but its own. Kept on disk beside JAX's compiled code, so that a later process neither
traces nor compiles.
"""

import ctypes
import functools
import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import llvmlite.binding as llvm
import llvmlite.ir as ir
import numpy as np
from jax.extend.core import ClosedJaxpr

from vrw_jax.simd_emit import BYTE, LONG, NUMBERS, TRUTH, Emitter
from vrw_jax.traces import code_digest, keep, kept

WIDTH = {np.dtype(np.float64): 8, np.dtype(np.float32): 16}
"""Lanes of a group: two vectors of 256 bits, so that one computes while the other waits."""
TOGETHER = 64
"""Groups that a thread takes at a time."""
NAME = "lanes"


def lane_program(
    function: Callable[..., tuple],
    uniform: Sequence[np.dtype],
    n_lanes_in: int,
    dtype: np.dtype,
    settings: object,
) -> Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]:
    """`function(uniform, lanes)` compiled: `uniform` numbers, `lanes` arrays of the float `dtype`.

    It must be elementwise over lanes, but for loops that end where no lane goes on, and return a
    flat tuple of arrays of the lanes' length. `settings` says by `repr` what it closes over. The
    result takes numpy arrays of any equal length and gives bitwise the same for a lane in any
    company; it uses all cores that the process may.
    """
    width = WIDTH[dtype]
    shapes = (
        tuple(jax.ShapeDtypeStruct((), kind) for kind in uniform),
        (jax.ShapeDtypeStruct((width,), dtype),) * n_lanes_in,
    )
    told = (
        "lanes", settings, shapes, jax.__version__, llvm.llvm_version_info, _processor(),
        code_digest(),
    )  # fmt: skip
    key = hashlib.sha256(repr(told).encode()).hexdigest()
    content = kept(f"vrw_lanes_{key}")
    if content is None:
        closed = jax.make_jaxpr(function)(*shapes)
        told_kinds = ",".join(aval.dtype.name for aval in closed.out_avals)
        content = told_kinds.encode() + b"\n" + _compiled(_module(closed, width))
        keep(f"vrw_lanes_{key}", content)
    kinds, _, code = content.partition(b"\n")
    return _Program(code, list(map(np.dtype, kinds.decode().split(","))), width)


class _Program:
    """Loaded machine code."""

    def __init__(self, code: bytes, out: list[np.dtype], width: int) -> None:
        self.out, self.width = out, width
        machine = _machine()
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        pointer, count = ctypes.c_void_p, ctypes.c_int64
        signature = ctypes.CFUNCTYPE(None, pointer, pointer, count, count)
        self._run = signature(self._engine.get_function_address(NAME))

    def __call__(self, uniform: Sequence[Any], lanes: Sequence[np.ndarray]) -> list[np.ndarray]:
        n = len(lanes[0])
        groups = -(-n // self.width)
        filled = [_filled(x, groups * self.width) for x in lanes]
        numbers = [np.asarray(x) for x in uniform]
        out = [np.empty(groups * self.width, kind) for kind in self.out]
        given, told = _pointers([*numbers, *filled]), _pointers(out)
        run = lambda begin: self._run(given, told, begin, min(begin + TOGETHER, groups))
        pieces = range(0, groups, TOGETHER)
        if len(pieces) > 1 and _cores() > 1:
            with ThreadPoolExecutor(_cores()) as pool:
                list(pool.map(run, pieces))
        else:
            for begin in pieces:
                run(begin)
        return [x[:n] for x in out]


def _filled(x: np.ndarray, length: int) -> np.ndarray:
    """Contiguous, filled up by its last number."""
    if len(x) == length:
        return np.ascontiguousarray(x)
    filled = np.full(length, x[-1])
    filled[: len(x)] = x
    return filled


def _pointers(arrays: Sequence[np.ndarray]) -> Any:
    return (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _module(closed: ClosedJaxpr, width: int) -> str:
    """`void lanes(const void **given, void **told, int64 begin, int64 end)`, over groups."""
    module = ir.Module(NAME)
    pointer = ir.PointerType()
    kernel = ir.Function(
        module, ir.FunctionType(ir.VoidType(), [pointer, pointer, LONG, LONG]), NAME
    )
    build = ir.IRBuilder(kernel.append_basic_block("entry"))
    emitter = Emitter(build, width)
    given, told, begin, end = kernel.args

    def entry(base: Any, index: int) -> Any:
        place = build.gep(base, [ir.Constant(LONG, index)], source_etype=pointer)
        return build.load(place, typ=pointer)

    def in_memory(aval: Any) -> ir.Type:
        number = NUMBERS[aval.dtype.name]
        return BYTE if number == TRUTH else number

    inputs, outputs = closed.in_avals, closed.out_avals
    sources = [entry(given, i) for i in range(len(inputs))]
    targets = [entry(told, i) for i in range(len(outputs))]

    def group(state: list[Any]) -> list[Any]:
        lane = build.mul(state[0], ir.Constant(LONG, width))
        values = []
        for source, aval in zip(sources, inputs, strict=True):
            number = in_memory(aval)
            if aval.shape == ():
                values.append(build.load(source, typ=number))
                continue
            place = build.gep(source, [lane], source_etype=number)
            vector = ir.VectorType(number, width)
            values.append(build.load(place, typ=vector, align=aval.dtype.itemsize))
        results = emitter.closed(closed, values)
        for target, aval, value in zip(targets, outputs, results, strict=True):
            number, kind = in_memory(aval), ir.VectorType(NUMBERS[aval.dtype.name], width)
            whole = emitter.spread(value, kind)
            if number == BYTE:
                whole = build.zext(whole, ir.VectorType(BYTE, width))
            place = build.gep(target, [lane], source_etype=number)
            build.store(whole, place, align=aval.dtype.itemsize)
        return [build.add(state[0], ir.Constant(LONG, 1))]

    emitter.loop([begin], lambda state: build.icmp_signed("<", state[0], end), group)
    build.ret_void()
    return str(module)


def _compiled(text: str) -> bytes:
    """Object code for this processor."""
    machine = _machine()
    module = llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    choices = llvm.create_pipeline_tuning_options(speed_level=2)
    choices.loop_vectorization = choices.slp_vectorization = False  # the vectors are there
    builder = llvm.create_pass_builder(machine, choices)
    builder.getModulePassManager().run(module, builder)
    return machine.emit_object(module)


@functools.cache
def _processor() -> tuple[str, str, str]:
    features = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), features


def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    triple, name, features = _processor()
    target = llvm.Target.from_triple(triple)
    return target.create_target_machine(cpu=name, features=features, opt=2, jit=True)

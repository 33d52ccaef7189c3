"""Functions over lanes as machine code for CPUs: a few lanes side by side, from first to last line.

XLA on CPU makes a loop over all lanes of every few operations, with results in memory between them,
and a `while` waits for the slowest of hundreds. Here the trace of the whole function becomes one
loop over groups of a few lanes, compiled by LLVM: a group's numbers stay in registers, and it waits
for none but its own. Kept on disk beside JAX's compiled code, so that a later process neither
traces nor compiles.
"""

import contextlib
import ctypes
import functools
import gc
import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from threading import Lock, RLock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import llvmlite.ir as ir
import numpy as np
from jax.extend.core import ClosedJaxpr

from vrw_jax.runtime import code_digest, keep, kept
from vrw_jax.simd.arrays import HELD, LANES
from vrw_jax.simd.fields import Entries, Field, Index
from vrw_jax.simd.numbers import BYTE, INT, LONG, NUMBERS, TRUTH
from vrw_jax.simd.trace import Traces

VECTOR = {np.dtype(np.float64): 4, np.dtype(np.float32): 8}
"""Lanes of 256 bits: a vector, or half of one where a processor has 512."""
TOGETHER = 64
"""Groups that a thread takes at a time."""
NAME, HANDLER = "lanes", "handler"


def serves() -> bool:
    """Whether there is machine code for where JAX computes: on CPUs."""
    return jax.default_backend() == "cpu"


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
    width = 2 * VECTOR[dtype]  # of 256 bits one vector computes while the other waits
    shapes = (
        tuple(jax.ShapeDtypeStruct((), kind) for kind in uniform),
        (jax.ShapeDtypeStruct((LANES,), dtype),) * n_lanes_in,
    )
    return _Program(_code(function, shapes, settings, width), width)


def lane_function(
    function: Callable[..., Any], like: Callable[..., Any], settings: object
) -> Callable[..., Any]:
    """`function` of trees of arrays, lanes on their last axis, as one call within JAX's programs.

    The first array has lanes; numbers without an axis are the same for all.
    As with `lane_program`; but results form a tree, that of `like`, which is quick to trace.
    Without derivatives, on CPUs only, and on the one core that runs the program.
    """

    def call(*arrays: Any) -> Any:
        leaves, structure = jax.tree.flatten(arrays)
        n_lanes = leaves[0].shape[-1]
        width = VECTOR[np.dtype(leaves[0].dtype)] * (2 if _wide() else 1)
        missing = -n_lanes % width
        shapes = [
            jax.ShapeDtypeStruct((*x.shape[:-1], LANES) if jnp.ndim(x) else (), jnp.result_type(x))
            for x in leaves
        ]
        flat = lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves)))
        code = _code(flat, shapes, (settings, str(structure)), width)
        _register(code)
        if missing:
            fill = lambda x: jnp.concatenate([x, jnp.repeat(x[..., -1:], missing, -1)], -1)
            leaves = [fill(x) if jnp.ndim(x) else x for x in leaves]
        out = [jax.ShapeDtypeStruct((*n, n_lanes + missing), kind) for n, kind in code.out]
        results = jax.ffi.ffi_call(code.name, out)(*leaves)
        told = jax.tree.structure(jax.eval_shape(like, *arrays))
        return jax.tree.unflatten(told, [x[..., :n_lanes] for x in results])

    return call


def at_hand(names: Sequence[str]) -> bool:
    """Whether a kept program that calls machine code of these names can run, once this is said."""
    for name in names:
        content = None if name in _registered else kept(name)
        if content is not None:
            _register(_told(name, content))
    return all(name in _registered for name in names)


_registered: dict[str, "_Loaded"] = {}
"""Machine code that JAX's programs may call, by name; XLA never lets go of it."""
_registering = Lock()


def _register(code: "_Code") -> None:
    with _registering:
        if code.name not in _registered:
            loaded = _Loaded(code.code)
            jax.ffi.register_ffi_target(code.name, loaded.capsule(HANDLER), platform="cpu")
            _registered[code.name] = loaded


class _Loaded:
    """Machine code at its place in memory."""

    def __init__(self, code: bytes) -> None:
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()

    def address(self, name: str) -> int:
        """Where a function begins."""
        return self._engine.get_function_address(name)

    def capsule(self, name: str) -> Any:
        """A function for hands that know what it takes."""
        make = ctypes.pythonapi.PyCapsule_New
        make.restype, make.argtypes = (
            ctypes.py_object,
            [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p],
        )
        return make(self.address(name), None, None)


class _Code(NamedTuple):
    """A function of lanes as machine code."""

    name: str  # says everything that it depends on
    out: tuple[tuple[tuple[int, ...], np.dtype], ...]  # of each result: axes before lanes, numbers
    code: bytes


def _code(function: Callable, shapes: Any, settings: object, width: int) -> _Code:
    """Compiled, or found where it is kept."""
    told = (
        "lanes", settings, shapes, width, jax.__version__, llvm.llvm_version_info, processor(),
        code_digest(),
    )  # fmt: skip
    name = f"vrw_lanes_{hashlib.sha256(repr(told).encode()).hexdigest()}"
    if name in _made:
        return _made[name]
    content = kept(name)
    if content is None:
        with _python, _uncollected():
            closed = traced(function, *shapes)
            module = _module(closed, width)
        out = [(aval.shape[:-1], aval.dtype.name) for aval in closed.out_avals]
        content = json.dumps(out).encode() + b"\n" + _compiled(module)
        keep(name, content)
    _made[name] = _told(name, content)
    return _made[name]


_made: dict[str, _Code] = {}
"""This process's, by name: whatever traces a program again, for another batch, finds it here."""


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Garbage waits: a program is many small objects that live on, and looking for dead ones among
    them takes a sixth of the time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


_python = RLock()
"""Threads write their programs in turn: the first is soon with LLVM, which needs no lock."""


def _told(name: str, content: bytes) -> _Code:
    """What is kept under a name."""
    out, _, code = content.partition(b"\n")
    return _Code(name, tuple((tuple(n), np.dtype(kind)) for n, kind in json.loads(out)), code)


def traced(function: Callable, *shapes: Any) -> ClosedJaxpr:
    """The trace of a function that is to be machine code."""
    outside = _tracing.set(True)
    try:
        return jax.make_jaxpr(function)(*shapes)
    finally:
        _tracing.reset(outside)


_tracing: ContextVar[bool] = ContextVar("_tracing", default=False)


def tracing() -> bool:
    """Whether what is traced now is to be machine code."""
    return _tracing.get()


class _Program:
    """Machine code for numpy's arrays."""

    def __init__(self, code: _Code, width: int) -> None:
        self.out, self.width = [kind for _, kind in code.out], width
        self._loaded = _Loaded(code.code)
        pointer, count = ctypes.c_void_p, ctypes.c_int64
        signature = ctypes.CFUNCTYPE(None, pointer, pointer, count, count, count)
        self._run = signature(self._loaded.address(NAME))

    def __call__(self, uniform: Sequence[Any], lanes: Sequence[np.ndarray]) -> list[np.ndarray]:
        n = len(lanes[0])
        groups = -(-n // self.width)
        filled = [_filled(x, groups * self.width) for x in lanes]
        numbers = [np.asarray(x) for x in uniform]
        out = [np.empty(groups * self.width, kind) for kind in self.out]
        given, told = _pointers([*numbers, *filled]), _pointers(out)
        length = groups * self.width
        run = lambda begin: self._run(given, told, length, begin, min(begin + TOGETHER, groups))
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
    _add_handler(module, kernel, len(inputs), len(outputs), width)
    return str(module)


def _add_handler(module: ir.Module, kernel: ir.Function, n_in: int, n_out: int, width: int) -> None:
    """`XLA_FFI_Error *handler(XLA_FFI_CallFrame *)`: the kernel as XLA calls functions from afar.

    Offsets in bytes from its xla/ffi/api/c_api.h, whose structs only ever grow at their ends.
    """
    pointer = ir.PointerType()
    handler = ir.Function(module, ir.FunctionType(pointer, [pointer]), HANDLER)
    build = ir.IRBuilder(handler.append_basic_block("entry"))
    asked, called = (handler.append_basic_block(name) for name in ("asked", "called"))
    frame, none = handler.args[0], ir.Constant(pointer, None)

    def at(base: Any, offset: int) -> Any:
        return build.gep(base, [ir.Constant(LONG, offset)], source_etype=BYTE)

    def read(base: Any, offset: int, kind: ir.Type = pointer) -> Any:
        return build.load(at(base, offset), typ=kind)

    extension = read(frame, 8)
    build.cbranch(build.icmp_unsigned("==", extension, none), called, asked)
    build.position_at_end(asked)  # for the version of the interface: it is the caller's own
    metadata, version = read(extension, 24), at(read(frame, 16), 16)
    for field in (16, 20):
        build.store(read(version, field, INT), at(metadata, 8 + field))
    build.ret(none)
    build.position_at_end(called)

    def buffers(offset: int, count: int) -> tuple[Any, Any]:
        """Pointers to the data of a list of buffers, and the last of them."""
        listed, buffer = read(frame, offset), None
        pointers = build.alloca(pointer, ir.Constant(LONG, count))
        for i in range(count):
            buffer = read(listed, 8 * i)
            build.store(
                read(buffer, 24), build.gep(pointers, [ir.Constant(LONG, i)], source_etype=pointer)
            )
        return pointers, buffer

    given, _ = buffers(72, n_in)
    told, first = buffers(112, n_out)
    rank = read(first, 32, LONG)
    last = build.sub(rank, ir.Constant(LONG, 1))
    n_lanes = build.load(build.gep(read(first, 40), [last], source_etype=LONG), typ=LONG)
    groups = build.sdiv(n_lanes, ir.Constant(LONG, width))
    build.call(kernel, [given, told, n_lanes, ir.Constant(LONG, 0), groups])
    build.ret(none)


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
def processor() -> tuple[str, str, str]:
    """What machine code is made for: the kind of machine, its processor, and what that can do."""
    features = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), features


def _wide() -> bool:
    """Whether vectors have 512 bits."""
    return "+avx512f" in processor()[2]


def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    triple, name, features = processor()
    target = llvm.Target.from_triple(triple)
    return target.create_target_machine(cpu=name, features=features, opt=2, jit=True)

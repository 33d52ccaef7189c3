"""Functions over lanes as machine code for CPUs, a few lanes at a time from start to end.

XLA on CPU generates a loop over all lanes for every few operations, with results in memory between
them. A `while` runs until the slowest of hundreds ends. Here the trace of the whole function
becomes one loop over groups of a few lanes, compiled by LLVM: a group's numbers stay in registers,
and a group ends with its own slowest lane. A later process neither traces nor compiles code that a
store contains.
"""

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.simd.arrays import LANES, SMALL
from vrw_jax.simd.code import Code, Store, code_of, kept_code, traced
from vrw_jax.simd.ffi import CALLED, register, registered
from vrw_jax.simd.kernel import NAME, module_text
from vrw_jax.simd.machine import Loaded, compiled_for_web, wide

VECTOR = {np.dtype(np.float64): 4, np.dtype(np.float32): 8}
"""Number of lanes in 256 bits, which is a vector, or half of one on processors with 512 bits."""
TOGETHER = 64
"""Number of groups in one task of a thread."""


def serves() -> bool:
    """Return whether machine code is available for JAX's backend, which must be the CPU."""
    return jax.default_backend() == "cpu"


def lane_program(
    function: Callable[..., tuple],
    uniform: Sequence[np.dtype],
    n_lanes_in: int,
    dtype: np.dtype,
    key: object,
    store: Store | None,
    small: int = SMALL,
) -> Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]:
    """Compile `function(scalars, lanes)`: scalars of `scalar_dtypes`, and arrays of the float
    `dtype`.

    The function must be elementwise over lanes, except for loops that end when no lane continues.
    It returns a flat tuple of arrays whose last axis are lanes. The `repr` of `key` identifies
    everything that its trace depends on except shapes: the values in its closure, and its source.
    Code is saved in `store`, if given; parts of large arrays with up to `max_unrolled` entries are
    kept in registers. The result takes numpy arrays of any equal length and gives bitwise the same
    for a lane whatever the other lanes are; it uses all cores available to the process.
    """
    width = (
        2 * VECTOR[dtype]
    )  # of two vectors of 256 bits, one computes during the latency of the other
    shapes = (
        tuple(jax.ShapeDtypeStruct((), kind) for kind in uniform),
        (jax.ShapeDtypeStruct((LANES,), dtype),) * n_lanes_in,
    )
    return _Program(code_of(function, shapes, key, width, store, small), width)


def web_object(
    function: Callable[..., Any], numbers: int, rows: Sequence[int], name: str, small: int = SMALL
) -> bytes:
    """Return `function(*scalars, *arrays)` as object code for WebAssembly, two lanes at a time.

    The arguments are float64: the given number of scalars, and arrays with the given numbers of
    rows, lanes last. The code's function `name` takes (inputs, outputs, lanes, begin, end): tables
    of pointers to arguments and results, the number of lanes, and the range of pairs of lanes to
    compute. The caller provides `sin` and `cos` if the trace uses them.
    """
    lanes = [jax.ShapeDtypeStruct((n, LANES), np.float64) for n in rows]
    shapes = [jax.ShapeDtypeStruct((), np.float64)] * numbers + lanes
    return compiled_for_web(module_text(traced(function, *shapes), 2, small), NAME, name)


def lane_function(
    function: Callable[..., Any],
    like: Callable[..., Any],
    key: object,
    store: Store | None,
    small: int = SMALL,
) -> Callable[..., Any]:
    """Return `function` of trees of arrays, lanes on their last axis, as one call within JAX
    programs.

    The first array has lanes; numbers without an axis are the same for all lanes. It works like
    `compile_lane_program`, with two differences. The results form a tree, that of `shape_function`,
    which is fast to trace. A single lane has separate code, which computes no other lanes and gives
    the same bits. The call has no derivatives, works on CPUs only, and uses the one core that runs
    the program.
    """

    def call(*arrays: Any) -> Any:
        leaves, structure = jax.tree.flatten(arrays)
        n_lanes = leaves[0].shape[-1]
        for shape in (jnp.shape(x) for x in leaves):
            if shape and shape[-1] != n_lanes:
                raise ValueError(
                    f"An argument has the shape {shape}, but the first one {n_lanes} lanes: they "
                    "are the last axis of every array; what has no axis is the same for all."
                )
        several = VECTOR[np.dtype(leaves[0].dtype)] * (2 if wide() else 1)
        width = (
            1 if n_lanes == 1 else several
        )  # a full group would compute lanes that are not needed
        missing = -n_lanes % width
        shapes = [
            jax.ShapeDtypeStruct((*x.shape[:-1], LANES) if jnp.ndim(x) else (), jnp.result_type(x))
            for x in leaves
        ]
        flat = lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(structure, leaves)))
        code = code_of(flat, shapes, (key, str(structure)), width, store, small)
        if missing:
            fill = lambda x: jnp.concatenate([x, jnp.repeat(x[..., -1:], missing, -1)], -1)
            leaves = [fill(x) if jnp.ndim(x) else x for x in leaves]
        out = [jax.ShapeDtypeStruct((*n, n_lanes + missing), kind) for n, kind in code.out]
        results = CALLED.bind(*leaves, code=code, out=tuple(out))
        told = jax.tree.structure(jax.eval_shape(like, *arrays))
        return jax.tree.unflatten(told, [x[..., :n_lanes] for x in results])

    return call


def at_hand(names: Sequence[str], store: Store | None) -> bool:
    """Register saved machine code of these names, and return whether all of it is available."""
    for name in names:
        code = None if name in registered else kept_code(name, store)
        if code is not None:
            register(code)
    return all(name in registered for name in names)


class _Program:
    """Machine code for numpy arrays."""

    def __init__(self, code: Code, width: int) -> None:
        self.out, self.width = code.out, width
        self._loaded = Loaded(code.ready())
        pointer, count = ctypes.c_void_p, ctypes.c_int64
        signature = ctypes.CFUNCTYPE(None, pointer, pointer, count, count, count)
        self._run = signature(self._loaded.address(NAME))

    def __call__(self, uniform: Sequence[Any], lanes: Sequence[np.ndarray]) -> list[np.ndarray]:
        n = len(lanes[0])
        groups = -(-n // self.width)
        filled = [_filled(x, groups * self.width) for x in lanes]
        numbers = [np.asarray(x) for x in uniform]
        out = [np.empty((*shape, groups * self.width), kind) for shape, kind in self.out]
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
        return [x[..., :n] for x in out]


def _filled(x: np.ndarray, length: int) -> np.ndarray:
    """Return a contiguous array, padded with its last number."""
    if len(x) == length:
        return np.ascontiguousarray(x)
    filled = np.full(length, x[-1])
    filled[: len(x)] = x
    return filled


def _pointers(arrays: Sequence[np.ndarray]) -> Any:
    """Return a table of pointers to the arrays' data."""
    return (ctypes.c_void_p * len(arrays))(*(x.ctypes.data for x in arrays))


def _cores() -> int:
    """Return the number of cores available to the process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

"""Functions over lanes as machine code for CPUs: a few lanes side by side, from first to last line.

XLA on CPU makes a loop over all lanes of every few operations, with results in memory between them,
and a `while` waits for the slowest of hundreds. Here the trace of the whole function becomes one
loop over groups of a few lanes, compiled by LLVM: a group's numbers stay in registers, and it waits
for none but its own. What a store keeps, a later process neither traces nor compiles.
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
"""Lanes of 256 bits: a vector, or half of one where a processor has 512."""
TOGETHER = 64
"""Groups that a thread takes at a time."""


def serves() -> bool:
    """Whether there is machine code for where JAX computes: on CPUs."""
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
    """`function(uniform, lanes)` compiled: `uniform` numbers, `lanes` arrays of the float `dtype`.

    It must be elementwise over lanes, but for loops that end where no lane goes on, and return a
    flat tuple of arrays whose last axis are lanes. `key` says by `repr` what its trace depends on
    but shapes: what it closes over, and its text. Code is kept in `store`, if there is one; parts
    of large arrays with up to `small` entries are registers. The result
    takes numpy arrays of any equal length and gives bitwise the same for a lane in any
    company; it uses all cores that the process may.
    """
    width = 2 * VECTOR[dtype]  # of 256 bits one vector computes while the other waits
    shapes = (
        tuple(jax.ShapeDtypeStruct((), kind) for kind in uniform),
        (jax.ShapeDtypeStruct((LANES,), dtype),) * n_lanes_in,
    )
    return _Program(code_of(function, shapes, key, width, store, small), width)


def web_object(
    function: Callable[..., Any], numbers: int, rows: Sequence[int], name: str, small: int = SMALL
) -> bytes:
    """`function(*numbers, *arrays)` as object code for WebAssembly, two lanes at a time.

    Float64: so many numbers, and arrays of so many rows, lanes last. The code's function `name`
    takes (given, told, lanes, begin, end): tables of pointers to arguments and results, the number
    of lanes, and which pairs of them to compute. `sin` and `cos`, where a trace leaves some over,
    are the caller's.
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
    """`function` of trees of arrays, lanes on their last axis, as one call within JAX's programs.

    The first array has lanes; numbers without an axis are the same for all.
    As with `lane_program`; but results form a tree, that of `like`, which is quick to trace, and a
    lone lane has code of its own, which waits for no others and gives the same bits.
    Without derivatives, on CPUs only, and on the one core that runs the program.
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
        width = 1 if n_lanes == 1 else several  # alone it would wait for the others
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
    """Whether a kept program that calls machine code of these names can run, once this is said."""
    for name in names:
        code = None if name in registered else kept_code(name, store)
        if code is not None:
            register(code)
    return all(name in registered for name in names)


class _Program:
    """Machine code for numpy's arrays."""

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

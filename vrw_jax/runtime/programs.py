"""Traced functions kept on disk beside JAX's compiled code, which saves Python's share of a start.

JAX's persistent cache spares the compiler but not the tracing, which for a limit cycle with
derivatives takes longer than a scan of thousands. Where that cache is on, its folder also keeps
traces, by a key of everything that they depend on, the library's source included.
"""

import hashlib
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.sharding import SingleDeviceSharding

from vrw_jax import simd
from vrw_jax.runtime import store
from vrw_jax.runtime.start import fusion_emitters


def compiled(
    function: Callable, arguments: tuple, settings: object, device: jax.Device
) -> Callable:
    """`function` compiled for arguments like these, on `device`.

    `settings` says by `repr` what the function closes over.

    The way leads through the exported trace whether or not it is kept, so that all runs compile the
    same program.
    """
    exported = _exported(function, arguments, settings)
    there = SingleDeviceSharding(device)
    placed = [jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=there) for x in exported.in_avals]
    program = jax.jit(exported.call).lower(*placed).compile(fusion_emitters(False))
    return lambda *arguments: program(*jax.tree.leaves(arguments))


def remembered(function: Callable, settings: object) -> Callable:
    """`function`, not traced where its trace is kept; to be called while a program is traced.

    For functions that are neither mapped nor differentiated from outside. As with `compiled`,
    first and later runs lead through the exported trace.
    """

    def call(*arguments: Any) -> Any:
        if _exporting.get() or not store.folder():
            return function(*arguments)
        return _exported(function, arguments, settings).call(*jax.tree.leaves(arguments))

    return call


def lane_program(
    function: Callable,
    uniform: Sequence[np.dtype],
    n_lanes_in: int,
    dtype: np.dtype,
    settings: Any,
    small: int = simd.SMALL,
) -> Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]:
    """`simd.lane_program` of this library's functions, kept here; `settings` as for `compiled`."""
    key = (settings, store.code_digest())
    return simd.lane_program(function, uniform, n_lanes_in, dtype, key, store, small)


def lane_function(
    function: Callable, like: Callable, settings: object, small: int = simd.SMALL
) -> Callable:
    """`simd.lane_function` of this library's functions, likewise."""
    return simd.lane_function(function, like, (settings, store.code_digest()), store, small)


def _exported(function: Callable, arguments: tuple, settings: object) -> export.Exported:
    """The trace of `function` for arguments like these, as one of their leaves."""
    leaves, structure = jax.tree.flatten(arguments)
    shapes = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves]
    # A trace calls the machine code of one processor: others may share the folder.
    where = (jax.default_backend(), simd.processor() if simd.serves() else None)
    told = (settings, str(structure), shapes, jax.__version__, where, store.code_digest())
    name = f"vrw_trace_{hashlib.sha256(repr(told).encode()).hexdigest()}"
    content = store.kept(name)
    if content is not None:
        names, _, trace = content.partition(b"\n")
        if simd.at_hand(names.decode().split(), store):
            return export.deserialize(bytearray(trace))
    flat = jax.jit(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)))
    outside = _exporting.set(True)  # what is remembered within is part of this trace
    try:
        called = sorted(_calls(flat.trace(*shapes).jaxpr))  # once: what follows finds the trace
        allowed = [export.DisabledSafetyCheck.custom_call(name) for name in called]
        exported = export.export(flat, disabled_checks=allowed)(*shapes)
    finally:
        _exporting.reset(outside)
    store.keep(name, " ".join(called).encode() + b"\n" + bytes(exported.serialize()))
    return exported


def _calls(trace: Any) -> set[str]:
    """Names of the machine code that a trace calls."""
    trace = getattr(trace, "jaxpr", trace)
    names = {e.params["code"].name for e in trace.eqns if e.primitive is simd.CALLED}
    for equation in trace.eqns:
        for leaf in jax.tree.leaves(list(equation.params.values())):
            if hasattr(getattr(leaf, "jaxpr", leaf), "eqns"):
                names |= _calls(leaf)
    return names


_exporting: ContextVar[bool] = ContextVar("_exporting", default=False)

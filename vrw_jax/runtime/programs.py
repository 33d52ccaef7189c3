"""Traced functions saved beside JAX's compilation cache, to avoid tracing at the next start.

JAX's persistent cache avoids compilation but not tracing, which for a limit cycle with derivatives
takes longer than a scan of thousands. If that cache is on, its folder also contains traces, under a
key of everything that they depend on, including the library's source.
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
    """Return `function` compiled for arguments like these, on `device`.

    The `repr` of `settings` identifies the values in the function's closure.

    The program is always compiled from the exported trace, saved or not, so that all runs compile
    the same program.
    """
    exported = _exported(function, arguments, settings)
    there = SingleDeviceSharding(device)
    placed = [jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=there) for x in exported.in_avals]
    program = jax.jit(exported.call).lower(*placed).compile(fusion_emitters(False))
    return lambda *arguments: program(*jax.tree.leaves(arguments))


def remembered(function: Callable, settings: object) -> Callable:
    """Return `function` without tracing it if its trace is saved; it is called while a program is
    traced.

    It is for functions that are neither mapped nor differentiated from outside. As with
    `compile_exported`, first and later runs use the exported trace.
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
    """Return `simd.compile_lane_program` of this library's functions, saved in the cache folder.

    `settings` are those of `compile_exported`.
    """
    key = (settings, store.code_digest())
    return simd.lane_program(function, uniform, n_lanes_in, dtype, key, store, small)


def lane_function(
    function: Callable, like: Callable, settings: object, small: int = simd.SMALL
) -> Callable:
    """Return `simd.compile_lane_function` of this library's functions, saved in the
    cache folder.
    """
    return simd.lane_function(function, like, (settings, store.code_digest()), store, small)


def _exported(function: Callable, arguments: tuple, settings: object) -> export.Exported:
    """Return the exported trace of `function` for arguments like these, with flat arguments."""
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
    outside = _exporting.set(True)  # cached traces called within are part of this trace
    try:
        called = sorted(
            _calls(flat.trace(*shapes).jaxpr)
        )  # traced once: the export below finds it in JAX's cache
        allowed = [export.DisabledSafetyCheck.custom_call(name) for name in called]
        exported = export.export(flat, disabled_checks=allowed)(*shapes)
    finally:
        _exporting.reset(outside)
    store.keep(name, " ".join(called).encode() + b"\n" + bytes(exported.serialize()))
    return exported


def _calls(trace: Any) -> set[str]:
    """Return the names of the machine code that a trace calls."""
    trace = getattr(trace, "jaxpr", trace)
    names = {e.params["code"].name for e in trace.eqns if e.primitive is simd.CALLED}
    for equation in trace.eqns:
        for leaf in jax.tree.leaves(list(equation.params.values())):
            if hasattr(getattr(leaf, "jaxpr", leaf), "eqns"):
                names |= _calls(leaf)
    return names


_exporting: ContextVar[bool] = ContextVar("_exporting", default=False)

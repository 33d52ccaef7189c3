"""Traced functions saved beside JAX's compilation cache, so that the next start need not trace
them.

JAX's persistent cache avoids compilation but not tracing, which for a limit cycle with derivatives
takes longer than a scan of thousands of samples. If that cache is on, its folder also contains
traces. The key of a trace contains everything on which the trace depends, including the library's
source.
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
from vrw_jax.runtime import disk_cache as store
from vrw_jax.runtime.start import fusion_emitter_options


def compile_exported(
    function: Callable, arguments: tuple, settings: object, device: jax.Device
) -> Callable:
    """Return `function` compiled for arguments like these, on `device`.

    The `repr` of `settings` identifies the values in the function's closure. The program is always
    compiled from the exported trace, saved or not, so that all runs compile the same program.
    """
    exported_trace = _export_trace(function, arguments, settings)
    sharding = SingleDeviceSharding(device)
    argument_specs = [
        jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding) for x in exported_trace.in_avals
    ]
    program = (
        jax.jit(exported_trace.call).lower(*argument_specs).compile(fusion_emitter_options(False))
    )
    return lambda *arguments: program(*jax.tree.leaves(arguments))


def cached_trace(function: Callable, settings: object) -> Callable:
    """Return a function that calls `function` through its saved trace if there is one.

    The result is called while a program is traced. `function` must not be mapped or differentiated
    from outside. As with `compile_exported`, first and later runs use the exported trace.
    """

    def call_cached(*arguments: Any) -> Any:
        if _is_exporting.get() or not store.cache_folder():
            return function(*arguments)
        return _export_trace(function, arguments, settings).call(*jax.tree.leaves(arguments))

    return call_cached


def cached_lane_program(
    function: Callable,
    scalar_dtypes: Sequence[np.dtype],
    n_lanes_in: int,
    dtype: np.dtype,
    settings: Any,
    limits: simd.RegisterLimits = simd.DEFAULT_LIMITS,
) -> Callable[[Sequence[Any], Sequence[np.ndarray]], list[np.ndarray]]:
    """Return `simd.compile_lane_program` of a function of this library, with a record on disk.

    `settings` is as for `compile_exported`.
    """
    key = (settings, store.describe_process())
    return simd.compile_lane_program(function, scalar_dtypes, n_lanes_in, dtype, key, store, limits)


def cached_lane_function(
    function: Callable,
    shape_function: Callable,
    settings: object,
    limits: simd.RegisterLimits = simd.DEFAULT_LIMITS,
) -> Callable:
    """Return `simd.compile_lane_function` of a function of this library, with a record on disk."""
    return simd.compile_lane_function(
        function, shape_function, (settings, store.describe_process()), store, limits
    )


def _export_trace(function: Callable, arguments: tuple, settings: object) -> export.Exported:
    """Return the exported trace of `function` for arguments like these, as a function of the
    flat arguments.
    """
    leaves, structure = jax.tree.flatten(arguments)
    shapes = [jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in leaves]
    # A trace calls the machine code of one processor, but several may share the folder.
    device_platform = (
        jax.default_backend(),
        simd.describe_processor() if simd.is_available() else None,
    )
    key_parts = (settings, str(structure), shapes, device_platform, store.describe_process())
    record_name = f"vrw_trace_{hashlib.sha256(repr(key_parts).encode()).hexdigest()}"
    trace_bytes = store.load_bytes(record_name)
    if trace_bytes is not None:
        code_names_bytes, _, trace = trace_bytes.partition(b"\n")
        try:
            if simd.ensure_loaded(code_names_bytes.decode().split(), store):
                return export.deserialize(bytearray(trace))
        except Exception:  # JAX documents no type of error for bytes that are no trace.
            store.warn_unusable(f"{record_name} is no trace")
    flat_function = jax.jit(lambda *leaves: function(*jax.tree.unflatten(structure, leaves)))
    # Cached traces that are called inside become part of this trace.
    context_token = _is_exporting.set(True)
    try:
        # The export below finds this trace in JAX's cache.
        code_names = sorted(_machine_code_names(flat_function.trace(*shapes).jaxpr))
        allowed_checks = [
            export.DisabledSafetyCheck.custom_call(record_name) for record_name in code_names
        ]
        exported_trace = export.export(flat_function, disabled_checks=allowed_checks)(*shapes)
    finally:
        _is_exporting.reset(context_token)
    store.save_bytes(
        record_name, " ".join(code_names).encode() + b"\n" + bytes(exported_trace.serialize())
    )
    return exported_trace


def _machine_code_names(trace: Any) -> set[str]:
    """Return the names of the machine code that a trace calls."""
    trace = getattr(trace, "jaxpr", trace)
    code_names = {
        inner_equation.params["code"].name
        for inner_equation in trace.eqns
        if inner_equation.primitive is simd.MACHINE_CODE_PRIMITIVE
    }
    for equation in trace.eqns:
        for leaf in jax.tree.leaves(list(equation.params.values())):
            if hasattr(getattr(leaf, "jaxpr", leaf), "eqns"):
                code_names |= _machine_code_names(leaf)
    return code_names


_is_exporting: ContextVar[bool] = ContextVar("_exporting", default=False)

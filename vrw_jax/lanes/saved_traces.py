"""Traced functions saved next to JAX's compilation cache, so that later processes need not trace
them.

JAX's persistent cache avoids compilation but not tracing. To trace a limit cycle with derivatives
takes longer than a scan of thousands of samples. If the persistent cache is on, its folder also
contains traces. The key of a trace contains everything on which the trace depends, including the
library's source code.

Within a process, functions with equal keys (see `keys`) share a compiled program, even if they are
different objects, such as fields and guards of users. Outside of `jax.jit`, JAX compiles a loop
again at each call if its body closes over functions.
"""

import contextlib
import functools
import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
from jax import export
from jax.sharding import SingleDeviceSharding

from vrw_jax.lanes import disk_cache as store
from vrw_jax.lanes.batching import is_inside_jit
from vrw_jax.lanes.keys import UnresolvableFunctionError, make_key
from vrw_jax.lanes.machine import describe_processor
from vrw_jax.lanes.program import (
    MACHINE_CODE_PRIMITIVE,
    is_machine_code_available,
    load_saved_machine_code,
)
from vrw_jax.lanes.settings import make_fusion_emitter_options


def compile_exported_function(
    traced_function: Callable,
    example_arguments: tuple,
    target_device: jax.Device,
) -> Callable:
    """Compile `traced_function` on `target_device` for the shapes of `example_arguments`.

    The program is always compiled from the exported trace, whether it was loaded from disk or not.
    All runs therefore compile the same program.
    """
    exported_trace = _load_or_export_trace(traced_function, example_arguments)
    assert exported_trace is not None
    device_sharding = SingleDeviceSharding(target_device)
    argument_shapes = [
        jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device_sharding)
        for x in exported_trace.in_avals
    ]
    compiled_program = (
        jax.jit(exported_trace.call)
        .lower(*argument_shapes)
        .compile(make_fusion_emitter_options(False))
    )
    return lambda *arguments: compiled_program(*jax.tree.leaves(arguments))


def wrap_with_saved_trace(
    traced_function: Callable, find_key: Callable[..., str | None] | None = None
) -> Callable:
    """Return a function that calls `traced_function` through its saved trace.

    If no trace exists yet, it is exported and saved. `traced_function` is called directly without a
    cache folder, or if JAX cannot export its trace. The returned function is called while a program
    is traced, and it must not be mapped or differentiated. As with `compile_exported_function`,
    first and later runs use the exported trace. `find_key` returns the key of the function and of
    further values.
    """

    def evaluate_saved_trace(*arguments: Any) -> Any:
        if _is_exporting_trace.get() or not store.find_cache_folder():
            return traced_function(*arguments)
        trace = _load_or_export_trace(traced_function, arguments, find_key)
        if trace is None:
            return traced_function(*arguments)
        return trace.call(*jax.tree.leaves(arguments))

    return evaluate_saved_trace


def _load_or_export_trace(
    traced_function: Callable,
    example_arguments: tuple,
    find_key: Callable[..., str | None] | None = None,
) -> export.Exported | None:
    """Return the exported trace of a function, as a function of the flattened arguments.

    The trace is loaded from disk if a record exists. Otherwise the function is traced for the
    shapes of `example_arguments`. The result is None if JAX cannot export the trace.
    """
    argument_leaves, argument_structure = jax.tree.flatten(example_arguments)
    argument_shapes = [
        jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in argument_leaves
    ]
    # A trace calls the machine code of one processor, but several may share the folder.
    platform_and_processor = (
        jax.default_backend(),
        describe_processor() if is_machine_code_available() else None,
    )
    try:
        find_key = find_key or functools.partial(make_key, traced_function)
        function_key = find_key(argument_structure)
    except UnresolvableFunctionError:
        function_key = None
    trace_key_parts = (
        function_key,
        [(x.shape, x.dtype.name) for x in argument_shapes],
        platform_and_processor,
        store.describe_trace_environment(),
    )
    cache_record_name = f"vrw_trace_{hashlib.sha256(repr(trace_key_parts).encode()).hexdigest()}"
    cache_record_content = store.load_cache_record(cache_record_name) if function_key else None
    if cache_record_content is not None:
        encoded_ffi_target_names, _, serialized_trace = cache_record_content.partition(b"\n")
        try:
            if load_saved_machine_code(encoded_ffi_target_names.decode().split()):
                return export.deserialize(bytearray(serialized_trace))
        except Exception:  # JAX documents no type of error for bytes that are no trace.
            store.warn_of_unusable_cache_record(f"{cache_record_name} is no trace")
    flattened_function = jax.jit(
        lambda *argument_leaves: traced_function(
            *jax.tree.unflatten(argument_structure, argument_leaves)
        )
    )
    # Cached traces that are called inside become part of this trace.
    export_flag_token = _is_exporting_trace.set(True)
    try:
        # The export below finds this trace in JAX's cache.
        ffi_target_names = sorted(
            _find_ffi_target_names(flattened_function.trace(*argument_shapes).jaxpr)
        )
        disabled_checks = list(map(export.DisabledSafetyCheck.custom_call, ffi_target_names))
        exporter = export.export(flattened_function, disabled_checks=disabled_checks)
        try:
            exported_trace = exporter(*argument_shapes)
        except NotImplementedError:  # The function calls back into Python.
            return None
    finally:
        _is_exporting_trace.reset(export_flag_token)
    if function_key:
        # A result of a user's own class cannot be saved.
        with contextlib.suppress(ValueError):
            serialized_trace = bytes(exported_trace.serialize())
            store.save_cache_record(
                cache_record_name,
                " ".join(ffi_target_names).encode() + b"\n" + serialized_trace,
            )
    return exported_trace


def _find_ffi_target_names(jaxpr: Any) -> set[str]:
    """Return the names of all machine-code functions that a traced program calls."""
    ffi_target_names: set[str] = set()
    for jaxpr_equation in getattr(jaxpr, "jaxpr", jaxpr).eqns:
        if jaxpr_equation.primitive is MACHINE_CODE_PRIMITIVE:
            with contextlib.suppress(Exception):  # The lowering replaces the code, or raises.
                lane_program = jaxpr_equation.params["lane_call"].lane_program
                ffi_target_names.add(lane_program.machine_code.ffi_target_name)
        for equation_parameter in jax.tree.leaves(list(jaxpr_equation.params.values())):
            if hasattr(getattr(equation_parameter, "jaxpr", equation_parameter), "eqns"):
                ffi_target_names |= _find_ffi_target_names(equation_parameter)
    return ffi_target_names


_is_exporting_trace: ContextVar[bool] = ContextVar("_exporting", default=False)


MAX_CACHED_PROGRAMS = 32
"""Largest number of programs in the cache, chosen because a program occupies about 14 MB."""

_program_by_key: OrderedDict[Hashable, Callable] = OrderedDict()


def call_compiled_program(function: Callable, static_arguments: Any, *arguments: Any) -> Any:
    """Return `function(static_arguments, *arguments)`, computed by a compiled program.

    `static_arguments` is a tree of functions and values. Calls with equal `static_arguments` share
    one program. A function without a key is compiled for this call alone. Inside `jax.jit` the
    function becomes part of the caller's program.
    """
    if is_inside_jit():
        return function(static_arguments, *arguments)
    compiled_program = get_compiled_program(function, static_arguments, *arguments)
    return (compiled_program or jax.jit(functools.partial(function, static_arguments)))(*arguments)


def get_compiled_program(
    function: Callable, static_arguments: Any, *arguments: Any
) -> Callable | None:
    """Return the compiled program for equal `static_arguments`, or None if they have no key.

    There is no key inside `jax.jit` either. The key contains the types of the arguments. Each
    program is therefore traced once, when `static_arguments` has the values of the key.
    """
    if is_inside_jit():
        return None
    argument_leaves, tree_structure = jax.tree.flatten(arguments)
    try:
        function_key = make_key(function, static_arguments)
    except UnresolvableFunctionError:
        return None
    program_key = (function_key, tree_structure, *map(jax.typeof, argument_leaves))
    if program_key not in _program_by_key:
        _program_by_key[program_key] = jax.jit(functools.partial(function, static_arguments))
    _program_by_key.move_to_end(program_key)
    if len(_program_by_key) > MAX_CACHED_PROGRAMS:
        _program_by_key.popitem(last=False)
    return _program_by_key[program_key]

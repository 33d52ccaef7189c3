"""Cache of machine code by content: traces that give the same LLVM text share one compilation.

Each program is one record of the store. The name of the record is a digest of the processor and of
the text that LLVM compiles. A second record, the index, contains the name of the program. The name
of the index is a digest of everything on which the function's trace depends. An edit of the source
that changes no trace therefore costs a trace, but no compilation. JAX programs then call the code
by the same name as before the edit.
"""

import contextlib
import functools
import gc
import hashlib
import pickle
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field
from threading import RLock
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from vrw_jax.lanes import disk_cache
from vrw_jax.lanes.kernel import LANE_KERNEL_NAME, write_llvm_kernel
from vrw_jax.lanes.machine import (
    compile_llvm_for_processor,
    describe_compiler_settings,
    require_object_file,
)
from vrw_jax.lanes.settings import with_default_jax_settings

ResultShapesAndDtypes = tuple[tuple[tuple[int, ...], np.dtype], ...]
"""For each result of machine code, the lengths of all axes before the lanes, and the dtype."""


class MachineCode(NamedTuple):
    """Machine code of a function over lanes, which may still be compiled in the background."""

    ffi_target_name: str  # digest of the text that LLVM compiles; JAX programs call the code by it
    object_code_future: Future[bytes]


@dataclass(unsafe_hash=True)
class LaneProgram:
    """Results of a function over lanes, and its machine code, which is compiled when it is needed.

    A program that JAX traces without its batch, and then maps over the batch, needs no code.
    """

    name: str  # Programs with equal names are equal.
    lanes_per_group: int = field(compare=False)
    result_shapes_and_dtypes: ResultShapesAndDtypes = field(compare=False)
    result_structure: Any = field(compare=False)
    compile_code: Callable[[], MachineCode] = field(compare=False)

    @functools.cached_property
    def machine_code(self) -> MachineCode:
        """Return the machine code of the function, or raise an error if it can have none."""
        with _jax_tracing_lock, _pause_garbage_collection():
            machine_code = self.compile_code()
        self.compile_code = lambda: machine_code  # releases the trace
        return machine_code


def get_lane_program(
    lane_function: Callable,
    argument_shapes: Any,
    function_key: str | None,
    numbers_of_lanes: Sequence[int],
    max_unrolled_entries: int,
) -> LaneProgram:
    """Return the program of a function of arrays with lanes on the last axis.

    Its results have known types. Its code comes from this process or the disk cache, or is compiled
    in the background when it is first needed.

    - `argument_shapes`: shapes and dtypes of the arguments;
    - `function_key`: key of the function, see `keys.make_key`; None if it has none, so that it is
      traced at each call and never saved;
    - `numbers_of_lanes`: possible numbers of lanes that the code computes at a time. The first
      number is taken for which this process, or else the disk cache, has a program. If there is
      none, it is the first of all.
    """
    trace_program = lambda trace_name, index_name, n: _trace_lane_program(
        lane_function, argument_shapes, trace_name, index_name, n, max_unrolled_entries
    )
    n = numbers_of_lanes[0]
    if function_key is None:
        return trace_program(None, None, n)
    trace_key = (
        function_key,
        [(x.shape, x.dtype.name, bool(getattr(x, "weak_type", False))) for x in argument_shapes],
        max_unrolled_entries,
        disk_cache.describe_trace_environment(),
        describe_compiler_settings(),
    )
    digest = lambda key: hashlib.sha256(repr(key).encode()).hexdigest()
    index_names = {m: f"lanes_index_{digest((trace_key, m))}" for m in numbers_of_lanes}
    if len(numbers_of_lanes) > 1:
        is_saved = lambda name: disk_cache.load_cache_record(name) is not None
        are_known = (_lane_program_by_index_name.__contains__, is_saved)
        n = next((m for f in are_known for m in numbers_of_lanes if f(index_names[m])), n)
    index_name = index_names[n]
    if index_name not in _lane_program_by_index_name:
        trace = functools.partial(trace_program, digest(trace_key), index_name, n)
        _lane_program_by_index_name[index_name] = (
            _load_lane_program(index_name, n, trace) or trace()
        )
    return _lane_program_by_index_name[index_name]


def _load_lane_program(
    index_name: str, lanes_per_group: int, trace_program: Callable[[], LaneProgram]
) -> LaneProgram | None:
    """Return the program that an index record describes, or None.

    - `trace_program`: function that traces the program, if it has been traced but never compiled.
    """
    record = disk_cache.load_cache_record(index_name)
    if record is None:
        return None
    try:
        code_name, result_types, skeleton = pickle.loads(record)
        structure = jax.tree.structure(skeleton)
        machine_code = load_machine_code(code_name) if code_name else None
    except Exception:  # Damaged bytes may raise any exception.
        disk_cache.warn_of_unusable_cache_record(f"{index_name} is no index of code")
        return None
    if code_name and machine_code is None:
        return None
    compile_code = lambda: machine_code or trace_program().machine_code
    return LaneProgram(index_name, lanes_per_group, result_types, structure, compile_code)


@with_default_jax_settings  # The trace has calls also where the caller has disabled `jax.jit`.
def _trace_lane_program(
    lane_function: Callable,
    argument_shapes: Any,
    trace_name: str | None,
    index_name: str | None,
    lanes_per_group: int,
    max_unrolled_entries: int,
) -> LaneProgram:
    """Return a program that is compiled in the background when its code is needed.

    The trace is that of the last program named `trace_name` for another number of lanes, if any.
    """
    with _jax_tracing_lock, _pause_garbage_collection():
        trace = _recent_traces.get(trace_name) or trace_for_machine_code(
            lane_function, *argument_shapes
        )
        if trace_name is not None:
            _recent_traces[trace_name] = trace
            if len(_recent_traces) > MAX_RECENT_TRACES:
                _recent_traces.popitem(last=False)
    closed_jaxpr, result_structure = trace
    result_types = tuple((aval.shape[:-1], aval.dtype) for aval in closed_jaxpr.out_avals)

    def save_index(code_name: str = "") -> None:
        """Save the name of the code, which is empty before it is compiled."""
        skeleton = jax.tree.unflatten(result_structure, range(result_structure.num_leaves))
        # A class inside a function cannot be pickled.
        with contextlib.suppress(pickle.PicklingError, AttributeError, TypeError):
            record = pickle.dumps((code_name, result_types, skeleton))
            disk_cache.save_cache_record(str(index_name), record)

    def compile_code() -> MachineCode:
        """Compile the trace in the background, unless its LLVM text is known."""
        llvm_text = write_llvm_kernel(closed_jaxpr, lanes_per_group, max_unrolled_entries)
        digested_text = f"{describe_compiler_settings()}{llvm_text}"
        code_name = f"lanes_code_{hashlib.sha256(digested_text.encode()).hexdigest()}"

        def compile_and_save_code() -> bytes:
            object_code = compile_llvm_for_processor(llvm_text)
            if trace_name:
                disk_cache.save_cache_record(code_name, object_code)
                save_index(code_name)
            return object_code

        # Another trace may have given the same LLVM text.
        find_code = load_machine_code if trace_name else _machine_code_by_name.get
        machine_code = find_code(code_name)
        if machine_code is None:
            machine_code = _machine_code_by_name[code_name] = MachineCode(
                code_name, _llvm_compiler_pool.submit(compile_and_save_code)
            )
        elif trace_name:
            save_index(code_name)
        return machine_code

    get_code = compile_code
    if index_name:
        save_index()
    else:
        machine_code = compile_code()
        index_name, get_code = machine_code.ffi_target_name, lambda: machine_code
    return LaneProgram(index_name, lanes_per_group, result_types, result_structure, get_code)


def load_machine_code(code_name: str) -> MachineCode | None:
    """Return the machine code named `code_name` from this process or from the disk cache.

    Return None if neither contains the code.
    """
    if code_name not in _machine_code_by_name:
        object_code = disk_cache.load_cache_record(code_name)
        if object_code is None:
            return None
        try:
            require_object_file(object_code, LANE_KERNEL_NAME)
        except ValueError as damage_error:  # LLVM would end the process on such a file.
            warnings.warn(
                f"{code_name} holds no machine code ({damage_error}): compiled again.",
                stacklevel=2,
            )
            return None
        object_code_future: Future[bytes] = Future()
        object_code_future.set_result(object_code)
        _machine_code_by_name[code_name] = MachineCode(code_name, object_code_future)
    return _machine_code_by_name[code_name]


_machine_code_by_name: dict[str, MachineCode] = {}
"""Machine code of this process by its name. Programs with the same LLVM text share the code."""
_lane_program_by_index_name: dict[str, LaneProgram] = {}
"""Programs of this process by the name of their index record."""
MAX_RECENT_TRACES = 4
"""Largest number of traces in memory. A trace of one lane is soon compiled for a batch as well."""
_recent_traces: OrderedDict[str | None, tuple[ClosedJaxpr, Any]] = OrderedDict()


@contextlib.contextmanager
def _pause_garbage_collection() -> Iterator[None]:
    """Return a context in which Python collects no garbage.

    Collections take a sixth of the tracing time, because a trace creates many objects that persist.
    """
    was_collection_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_collection_enabled:
            gc.enable()


_jax_tracing_lock = RLock()
"""Lock that lets only one thread trace at a time. The later compilation by LLVM needs no lock."""


_llvm_compiler_pool = ThreadPoolExecutor(1, "llvm")
"""Thread that compiles in the background while Python traces.

One thread suffices, because LLVM's lock lets only one thread compile.
"""


def trace_for_machine_code(
    lane_function: Callable, *argument_shapes: Any
) -> tuple[ClosedJaxpr, Any]:
    """Return the jaxpr of a function for arguments with the shapes and dtypes `argument_shapes`,
    and the tree structure of its results.

    During the trace, `targets_machine_code` returns True.
    """
    tracing_flag_token = _is_tracing_for_machine_code.set(True)
    try:  # The loops are traced in this mesh, so that JAX's trace cache finds them again.
        with jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ())):
            closed_jaxpr, result_shapes = jax.make_jaxpr(lane_function, return_shape=True)(
                *argument_shapes
            )
            return closed_jaxpr, jax.tree.structure(result_shapes)
    finally:
        _is_tracing_for_machine_code.reset(tracing_flag_token)


_is_tracing_for_machine_code: ContextVar[bool] = ContextVar("_tracing", default=False)


def targets_machine_code() -> bool:
    """Return whether the function that is being traced will become machine code."""
    return _is_tracing_for_machine_code.get()

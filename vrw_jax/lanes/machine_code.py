"""Machine code of a function over lanes: its LLVM module, compilation, and a cache by content.

The module is written for a jaxpr. It contains a loop over groups of lanes, and the function by
which XLA calls the loop, through its foreign function interface (FFI).

Traces that give the same LLVM text share one compilation. Each program is one record of the store.
The name of the record is a digest of the processor and of the text that LLVM compiles. A second
record, the index, contains the name of the program. The name of the index is a digest of everything
on which the function's trace depends. An edit of the source that changes no trace therefore costs a
trace, but no compilation. JAX programs then call the code by the same name as before the edit.
"""

import contextlib
import functools
import gc
import hashlib
import math
import pickle
import re
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from vrw_jax.lanes import environment
from vrw_jax.lanes.array_emitter import (
    LANE_AXIS_SENTINEL,
    MAX_UNROLLED_ENTRIES,
    ArrayEmitter,
    LaneAxisError,
    has_lane_axis,
    make_lane_axis_error,
)
from vrw_jax.lanes.environment import with_default_jax_settings
from vrw_jax.lanes.llvm import (
    EntryIndex,
    LazyArray,
    LlvmArray,
    LlvmValue,
    MemoryArray,
    compile_llvm_for_processor,
    describe_compiler_settings,
    ir,
    require_object_file,
)
from vrw_jax.lanes.lowering import JaxprLowering
from vrw_jax.lanes.value_emitter import I8, I32, I64, LLVM_NUMBER_TYPES, TextBuilder, ValueEmitter

FFI_HANDLER_NAME = "handler"

FFI_METADATA_EXTENSION_TYPE = 1
"""Number of the extension type by which XLA requests the metadata of a handler.

The number is from XLA's xla/ffi/api/c_api.h.
"""


@functools.cache
def read_ffi_api_version() -> tuple[int, int]:
    """Return the version (major, minor) of XLA's call interface, read from the installed header.

    Return (0, 0), which XLA rejects, if the header is missing or has another form.
    """
    header_path = Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h"
    try:
        header_text = header_path.read_text(encoding="utf-8")
    except OSError:
        return 0, 0
    version_numbers = dict(re.findall(r"#define XLA_FFI_API_(MAJOR|MINOR) (\d+)", header_text))
    return int(version_numbers.get("MAJOR", 0)), int(version_numbers.get("MINOR", 0))


def add_ffi_handler(
    llvm_module: ir.Module,
    llvm_kernel: ir.Function,
    n_inputs: int,
    n_outputs: int,
    lanes_per_group: int,
) -> None:
    """Add the function `XLA_FFI_Error *handler(XLA_FFI_CallFrame *)` to the LLVM module.

    The function calls `llvm_kernel` with pointers to `n_inputs` arguments and `n_outputs` results,
    which it reads from the call frame. Offsets in the frame are in bytes, from XLA's
    xla/ffi/api/c_api.h, whose structs only grow at their ends. If XLA requests the metadata, the
    handler reports the version of the interface for which it is compiled.
    """
    llvm_pointer_type = ir.PointerType()
    llvm_handler = ir.Function(
        llvm_module, ir.FunctionType(llvm_pointer_type, [llvm_pointer_type]), FFI_HANDLER_NAME
    )
    llvm_handler.attributes.add("nounwind")
    llvm_builder = ir.IRBuilder(llvm_handler.append_basic_block("entry"))
    extension_basic_block, metadata_basic_block, execute_basic_block = (
        llvm_handler.append_basic_block(block_name)
        for block_name in ("extension", "metadata", "execute")
    )
    ffi_call_frame, llvm_null_pointer = llvm_handler.args[0], ir.Constant(llvm_pointer_type, None)

    def emit_struct_field_address(base_pointer: Any, byte_offset: int) -> Any:
        return llvm_builder.gep(base_pointer, [ir.Constant(I64, byte_offset)], source_etype=I8)

    def emit_struct_field_load(
        base_pointer: Any, byte_offset: int, llvm_field_type: ir.Type = llvm_pointer_type
    ) -> Any:
        return llvm_builder.load(
            emit_struct_field_address(base_pointer, byte_offset), typ=llvm_field_type
        )

    extension_pointer = emit_struct_field_load(ffi_call_frame, 8)
    has_extension = llvm_builder.icmp_unsigned("!=", extension_pointer, llvm_null_pointer)
    llvm_builder.cbranch(has_extension, extension_basic_block, execute_basic_block)
    llvm_builder.position_at_end(extension_basic_block)
    is_metadata_request = llvm_builder.icmp_unsigned(
        "==",
        emit_struct_field_load(extension_pointer, 8, I32),
        ir.Constant(I32, FFI_METADATA_EXTENSION_TYPE),
    )
    llvm_builder.cbranch(is_metadata_request, metadata_basic_block, execute_basic_block)
    llvm_builder.position_at_end(metadata_basic_block)
    metadata_pointer = emit_struct_field_load(extension_pointer, 24)
    for version_field_offset, version_number in zip((24, 28), read_ffi_api_version(), strict=True):
        llvm_builder.store(
            ir.Constant(I32, version_number),
            emit_struct_field_address(metadata_pointer, version_field_offset),
        )
    llvm_builder.ret(llvm_null_pointer)
    llvm_builder.position_at_end(execute_basic_block)

    def emit_buffer_pointer_table(buffer_list_offset: int, n_buffers: int) -> tuple[Any, Any]:
        """Return LLVM values: a table of pointers to the data of `n_buffers` buffers, and the last
        buffer.

        - `buffer_list_offset`: offset of the list of buffers in the call frame, bytes.
        """
        buffer_list, ffi_buffer = emit_struct_field_load(ffi_call_frame, buffer_list_offset), None
        data_pointer_table = llvm_builder.alloca(llvm_pointer_type, ir.Constant(I64, n_buffers))
        for i in range(n_buffers):
            ffi_buffer = emit_struct_field_load(buffer_list, 8 * i)
            llvm_builder.store(
                emit_struct_field_load(ffi_buffer, 24),
                llvm_builder.gep(
                    data_pointer_table, [ir.Constant(I64, i)], source_etype=llvm_pointer_type
                ),
            )
        return data_pointer_table, ffi_buffer

    input_pointer_table, _ = emit_buffer_pointer_table(72, n_inputs)
    output_pointer_table, last_output_buffer = emit_buffer_pointer_table(112, n_outputs)
    output_rank = emit_struct_field_load(last_output_buffer, 32, I64)
    last_axis_index = llvm_builder.sub(output_rank, ir.Constant(I64, 1))
    n_lanes = llvm_builder.load(
        llvm_builder.gep(
            emit_struct_field_load(last_output_buffer, 40), [last_axis_index], source_etype=I64
        ),
        typ=I64,
    )
    n_lane_groups = llvm_builder.sdiv(n_lanes, ir.Constant(I64, lanes_per_group))
    llvm_builder.call(
        llvm_kernel,
        [input_pointer_table, output_pointer_table, n_lanes, ir.Constant(I64, 0), n_lane_groups],
    )
    llvm_builder.ret(llvm_null_pointer)


LANE_KERNEL_NAME = "lanes"


def write_llvm_kernel(
    closed_jaxpr: ClosedJaxpr,
    lanes_per_group: int,
    max_unrolled_entries: int = MAX_UNROLLED_ENTRIES,
) -> str:
    """Return the LLVM text of a function that computes the jaxpr for a range of groups of lanes.

    The signature is
    `void lanes(const void **inputs, void **outputs, int64 lanes, int64 begin, int64 end)`. The
    function loops over the groups from `begin` to `end`, each of `lanes_per_group` lanes. If
    `lanes_per_group` is 1, the lane is computed twice, in a vector, because LLVM's code for scalars
    differs in the last digits.
    """
    llvm_module = ir.Module(LANE_KERNEL_NAME)
    llvm_pointer_type = ir.PointerType()
    llvm_kernel = ir.Function(
        llvm_module,
        ir.FunctionType(ir.VoidType(), [llvm_pointer_type, llvm_pointer_type, I64, I64, I64]),
        LANE_KERNEL_NAME,
    )
    llvm_kernel.attributes.add("nounwind")
    llvm_builder = TextBuilder(llvm_kernel.append_basic_block("entry"))
    value_emitter = ValueEmitter(llvm_builder, max(lanes_per_group, 2))
    array_emitter = ArrayEmitter(value_emitter, max_unrolled_entries)
    inputs, outputs, n_lanes, first_lane_group, end_lane_group = llvm_kernel.args
    argument_avals, result_avals = closed_jaxpr.in_avals, closed_jaxpr.out_avals

    def load_pointers(pointer_table: LlvmValue, n_pointers: int) -> list[LlvmValue]:
        table = MemoryArray(array_emitter, (n_pointers,), llvm_pointer_type, pointer_table)
        return [table.emit_entry_load((i,)) for i in range(n_pointers)]

    input_pointers = load_pointers(inputs, len(argument_avals))
    output_pointers = load_pointers(outputs, len(result_avals))

    def emit_lane_group(lane_group_index: LlvmValue, _: Any) -> list[LlvmValue]:
        first_lane = llvm_builder.mul(lane_group_index, ir.Constant(I64, lanes_per_group))
        read_argument, write_result = _make_lane_access(
            array_emitter, lanes_per_group, n_lanes, first_lane
        )
        arguments = list(map(read_argument, input_pointers, argument_avals))
        lowering = JaxprLowering(array_emitter)
        results = lowering.lower_jaxpr(closed_jaxpr, arguments)
        for pointer, aval, result in zip(output_pointers, result_avals, results, strict=True):
            write_result(pointer, aval, result)
        return []

    array_emitter.emit_range_loop(first_lane_group, end_lane_group, emit_lane_group)
    llvm_builder.ret_void()
    n_arguments, n_results = len(argument_avals), len(result_avals)
    add_ffi_handler(llvm_module, llvm_kernel, n_arguments, n_results, lanes_per_group)
    return str(llvm_module)


def _make_lane_access(
    array_emitter: ArrayEmitter, lanes_per_group: int, n_lanes: LlvmValue, first_lane: LlvmValue
) -> tuple[Callable[..., LlvmArray], Callable[..., None]]:
    """Return functions that read an argument and write a result of the lanes from `first_lane`."""
    value_emitter, llvm_builder = array_emitter.value_emitter, array_emitter.llvm_builder
    has_single_lane = lanes_per_group == 1

    def emit_address(base: LlvmValue, aval: Any, entry_index: EntryIndex) -> tuple:
        """Return the address of an entry for the first lane of the group, and its type there.

        The last axis of the caller's arrays is the lane axis.
        """
        number_type = I8 if aval.dtype.kind == "b" else LLVM_NUMBER_TYPES[aval.dtype.name]
        if aval.shape == ():
            return base, number_type
        entry_offset = array_emitter.emit_memory_offset(entry_index, aval.shape[:-1])
        lane_offset = llvm_builder.add(llvm_builder.mul(entry_offset, n_lanes), first_lane)
        address = llvm_builder.gep(base, [lane_offset], source_etype=number_type)
        if has_single_lane:
            return address, number_type
        return address, value_emitter.make_vector_type(number_type)

    def read_argument(base: LlvmValue, aval: Any) -> LlvmArray:
        """Return an argument; one without axes is one number for all lanes."""
        if LANE_AXIS_SENTINEL in aval.shape[:-1]:
            raise make_lane_axis_error("An argument", aval)

        def load_entry(entry_index: EntryIndex) -> LlvmValue:
            address, stored_type = emit_address(base, aval, entry_index)
            value = llvm_builder.load(address, typ=stored_type, align=aval.dtype.itemsize)
            if aval.dtype.kind == "b":
                zero = value_emitter.make_llvm_constant(stored_type, 0)
                value = llvm_builder.icmp_signed("!=", value, zero)
            if not (has_single_lane and aval.shape):
                return value
            vector = value_emitter.to_lane_vector(value)
            if aval.dtype.kind != "f":
                return vector
            # The vector is read from memory. LLVM would else compute only one of two equal
            # entries, and then might not fuse the same products and sums.
            memory = array_emitter.allocate_memory_array((2,), value.type)
            for i in range(2):
                memory.emit_entry_store((i,), value)
            return llvm_builder.load(memory.base_pointer, typ=vector.type, align=8)

        array = LazyArray(aval.shape[:-1], array_emitter.get_entry_type(aval), load_entry)
        fits_registers = math.prod(array.shape) <= array_emitter.MAX_REGISTER_ENTRIES
        return array_emitter.get_array_entries(array) if fits_registers else array

    def write_result(base: LlvmValue, aval: Any, result: LlvmArray) -> None:
        if not has_lane_axis(aval):
            raise LaneAxisError(
                f"A result has the shape {aval.str_short()}, the same for all lanes: compute "
                "it outside, or add zeros of the lanes."
            )

        if 0 in aval.shape:
            return

        def store_entry(entry_index: EntryIndex, _: Any) -> list[LlvmValue]:
            address, stored_type = emit_address(base, aval, entry_index)
            value = value_emitter.to_lane_vector(array_emitter.get_array_entry(result, entry_index))
            if aval.dtype.kind == "b":
                value = llvm_builder.zext(value, value_emitter.make_vector_type(I8))
            if has_single_lane:
                # The lane is read from memory, because LLVM would reduce an extracted entry,
                # and all operations before it, to scalars.
                memory = array_emitter.allocate_memory_array((), value.type)
                llvm_builder.store(value, memory.base_pointer)
                value = llvm_builder.load(memory.base_pointer, typ=stored_type)
            llvm_builder.store(value, address, align=aval.dtype.itemsize)
            return []

        array_emitter.emit_index_loops(aval.shape[:-1], store_entry)

    return read_argument, write_result


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
        environment.describe_trace_environment(),
        describe_compiler_settings(),
    )
    digest = lambda key: hashlib.sha256(repr(key).encode()).hexdigest()
    index_names = {m: f"lanes_index_{digest((trace_key, m))}" for m in numbers_of_lanes}
    if len(numbers_of_lanes) > 1:
        is_saved = lambda name: environment.load_cache_record(name) is not None
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
    record = environment.load_cache_record(index_name)
    if record is None:
        return None
    try:
        code_name, result_types, skeleton = pickle.loads(record)
        structure = jax.tree.structure(skeleton)
        machine_code = load_machine_code(code_name) if code_name else None
    except Exception:  # Damaged bytes may raise any exception.
        environment.warn_of_unusable_cache_record(f"{index_name} is no index of code")
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
            environment.save_cache_record(str(index_name), record)

    def compile_code() -> MachineCode:
        """Compile the trace in the background, unless its LLVM text is known."""
        llvm_text = write_llvm_kernel(closed_jaxpr, lanes_per_group, max_unrolled_entries)
        digested_text = f"{describe_compiler_settings()}{llvm_text}"
        code_name = f"lanes_code_{hashlib.sha256(digested_text.encode()).hexdigest()}"

        def compile_and_save_code() -> bytes:
            object_code = compile_llvm_for_processor(llvm_text)
            if trace_name:
                environment.save_cache_record(code_name, object_code)
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
        object_code = environment.load_cache_record(code_name)
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

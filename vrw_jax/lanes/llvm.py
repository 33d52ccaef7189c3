"""Interface to LLVM: llvmlite or stand-ins for it, arrays of its values, the target processor,
object code for it, and loading of code into memory.

Large arrays of LLVM values have entries that are computed on access or stored in memory. Arrays
that emit instructions have a reference to their `ArrayEmitter`.
"""

import functools
import platform
import re
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

try:
    import llvmlite.binding as llvm
    import llvmlite.ir as ir

    is_llvmlite_installed = True
except ImportError:
    is_llvmlite_installed = False


class _MissingLlvmType:
    """Stand-in for a type of llvmlite that other modules create or subclass.

    Any other use of it raises an ImportError.
    """

    def __init__(self, *_: Any) -> None: ...

    def __getattr__(self, attribute_name: str) -> Any:
        raise ImportError("machine code needs llvmlite, which is not installed: pip install it.")


class _MissingLlvmTypes:
    """Stand-in for the module `llvmlite.ir`, in which every name is a type."""

    def __getattr__(self, type_name: str) -> Any:
        return type(type_name, (_MissingLlvmType,), {})


if not is_llvmlite_installed:
    llvm, ir = _MissingLlvmType(), _MissingLlvmTypes()


LLVM_OPTIMIZATION_LEVEL = 1
"""LLVM's optimization level (0 to 3) for register allocation and instruction scheduling.

Level 2 would only order the same instructions again after registers are allocated. The code would
not be faster, and would take a fifth longer to compile.
"""
LLVM_PASS_NAMES = (
    "global_dead_code_eliminate",
    "simplify_cfg",
    "aggressive_dce",
    "sinking",
)
"""Names of the LLVM passes that simplify the module.

They are chosen because the emitter repeats no computation and already uses vectors. LLVM's usual
passes would take as long as the whole remaining compilation, for code at most a twentieth faster.
"""

ELF_FILE_SIGNATURE = b"\x7fELF\x02\x01"
"""First bytes of the object files that LLVM writes on 64-bit Linux."""
ELF_HEADER_LAYOUT = struct.Struct("<16sHHIQQQIHHHHHH")
"""Layout of the header of an ELF file, in the format of Python's `struct`."""
ELF_SECTION_LAYOUT = struct.Struct("<IIQQQQIIQQ")
"""Layout of one entry of the section table of an ELF file, in the format of Python's `struct`."""


ELF_STRING_TABLE_TYPE = 3
"""Type of the ELF section that contains the names of all sections."""
ELF_ZERO_FILLED_TYPE = 8
"""Type of an ELF section for which the file contains no bytes."""


@functools.cache
def describe_processor() -> tuple[str, str, str]:
    """Return the target of machine code: the target triple, the processor's name, and the list of
    the processor's features.

    Without llvmlite, return the kind of machine and two empty strings.
    """
    if not is_llvmlite_installed:
        return platform.machine(), "", ""
    processor_features = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), processor_features


def describe_compiler_settings() -> str:
    """Return a string that identifies everything on which object code depends, except the LLVM
    text.
    """
    return repr(
        (llvm.llvm_version_info, describe_processor(), LLVM_OPTIMIZATION_LEVEL, LLVM_PASS_NAMES)
    )


def has_512_bit_vectors() -> bool:
    """Return whether the processor has vector registers of 512 bits."""
    return "+avx512f" in describe_processor()[2]


def compile_llvm_for_processor(llvm_text: str) -> bytes:
    """Return the object code, for this processor, that LLVM compiles from LLVM text."""
    return _emit_object_code(llvm.parse_assembly(llvm_text), _make_llvm_target_machine())


def compile_llvm_for_webassembly(
    llvm_text: str, entry_function_name: str, exported_function_name: str
) -> bytes:
    """Return the object code, for WebAssembly with vectors of 128 bits, that LLVM compiles from
    LLVM text.

    The object file must still be linked. The only exported function is `entry_function_name`, under
    the name `exported_function_name`.
    """
    llvm_module = llvm.parse_assembly(llvm_text)
    for llvm_symbol in (*llvm_module.functions, *llvm_module.global_variables):
        if not llvm_symbol.is_declaration and llvm_symbol.name != entry_function_name:
            llvm_symbol.linkage = "internal"
    llvm_module.get_function(entry_function_name).name = exported_function_name
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    llvm_target_machine = llvm.Target.from_triple("wasm32-unknown-unknown").create_target_machine(
        cpu="generic",
        features="+simd128",
        opt=LLVM_OPTIMIZATION_LEVEL,
        reloc="static",
        codemodel="default",
    )
    return _emit_object_code(llvm_module, llvm_target_machine)


def _emit_object_code(
    llvm_module: "llvm.ModuleRef", llvm_target_machine: "llvm.TargetMachine"
) -> bytes:
    """Run the passes in `LLVM_PASS_NAMES` on an LLVM module, and return its object code."""
    llvm_module.triple = llvm_target_machine.triple
    llvm_module.data_layout = str(llvm_target_machine.target_data)
    llvm_pass_manager = llvm.create_new_module_pass_manager()
    for llvm_pass_name in LLVM_PASS_NAMES:
        getattr(llvm_pass_manager, f"add_{llvm_pass_name}_pass")()
    llvm_pass_manager.run(
        llvm_module,
        llvm.create_pass_builder(llvm_target_machine, llvm.create_pipeline_tuning_options()),
    )
    return llvm_target_machine.emit_object(llvm_module)


def require_object_file(object_code: bytes, function_name: str) -> None:
    """Raise a ValueError unless `object_code` is a complete object file that contains the function
    `function_name`.

    LLVM ends the process if a file is damaged, so this function checks the file's tables first.
    Only files in the ELF format are checked completely. In other formats the check only looks for
    the name.
    """
    if not re.search(f"\0_?{function_name}\0".encode(), object_code):
        raise ValueError(f"it has no function {function_name}")
    if llvm.get_object_format() != "ELF" or sys.byteorder != "little":
        return
    if len(object_code) < ELF_HEADER_LAYOUT.size or not object_code.startswith(ELF_FILE_SIGNATURE):
        raise ValueError("it is no object file")
    *_, section_table_offset, _, _, _, _, section_entry_size, n_sections, name_section_index = (
        ELF_HEADER_LAYOUT.unpack_from(object_code)
    )
    if (
        section_entry_size != ELF_SECTION_LAYOUT.size
        or section_table_offset + n_sections * section_entry_size > len(object_code)
        or name_section_index >= n_sections
    ):
        raise ValueError("its table of sections is cut off")
    elf_sections = [
        ELF_SECTION_LAYOUT.unpack_from(object_code, section_table_offset + i * section_entry_size)
        for i in range(n_sections)
    ]
    for _, section_type, _, _, section_offset, section_length, *_ in elf_sections:
        if section_type != ELF_ZERO_FILLED_TYPE and section_offset + section_length > len(
            object_code
        ):
            raise ValueError("a section is cut off")
    if elf_sections[name_section_index][1] != ELF_STRING_TABLE_TYPE:
        raise ValueError("it has no table of names")


class LoadedMachineCode:
    """Machine code loaded into the memory of this process."""

    def __init__(self, object_code: bytes) -> None:
        self._llvm_engine = llvm.create_mcjit_compiler(
            llvm.parse_assembly(""), _make_llvm_target_machine()
        )
        self._llvm_engine.add_object_file(llvm.ObjectFileRef.from_data(object_code))
        self._llvm_engine.finalize_object()

    def find_function_address(self, function_name: str) -> int:
        """Return the memory address of a loaded function."""
        return self._llvm_engine.get_function_address(function_name)


def _make_llvm_target_machine() -> "llvm.TargetMachine":
    """Return LLVM's target machine for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target_triple, processor_name, processor_features = describe_processor()
    return llvm.Target.from_triple(target_triple).create_target_machine(
        cpu=processor_name, features=processor_features, opt=LLVM_OPTIMIZATION_LEVEL, jit=True
    )


LlvmValue = Any
"""An LLVM value: a scalar, or a vector with one entry per lane."""

EntryIndex = tuple[Any, ...]
"""Index of an array entry. For each axis it contains an integer, or an LLVM value of type I64."""


@dataclass(eq=False)
class LazyArray:
    """Large array of type `entry_type`, whose entries are computed or loaded by
    `get_entry_at_index(index)`.

    If `entry_type` is a vector, an entry may also be a scalar, which is the same for all lanes.
    """

    shape: tuple[int, ...]
    entry_type: ir.Type
    get_entry_at_index: Callable[[EntryIndex], LlvmValue]


class UninitializedArray(LazyArray):
    """Large array whose entries are overwritten before they are read."""


@dataclass(eq=False)
class JoinedArray(LazyArray):
    """Arrays that are joined along one axis, and can be stored one after another."""

    parts: Sequence["LlvmArray"]
    start_indices: Sequence[EntryIndex]  # index at which each part begins


class PendingArrayUpdate(LazyArray):
    """Array in memory, or array of one repeated number, of which one part is replaced."""

    def __init__(
        self,
        array_emitter: Any,
        base_array: "LlvmArray",
        update_array: "LlvmArray",
        start_index: EntryIndex,
    ) -> None:
        entry_type = (
            update_array.entry_type
            if isinstance(update_array, LazyArray)
            else update_array.ravel()[0].type
        )
        super().__init__(base_array.shape, entry_type, self.emit_entry_load)
        self.array_emitter, self.base_array = array_emitter, base_array
        self.update_array, self.start_index = update_array, start_index

    def emit_entry_load(self, entry_index: EntryIndex) -> LlvmValue:
        """Return the LLVM value of the entry at `entry_index`.

        The entry is that of the update inside the replaced part, and that of the base array
        elsewhere.
        """
        return self.array_emitter.get_array_entry(
            self.array_emitter.store_array_in_memory(self), entry_index
        )

    def store_update_in_memory(self) -> "PendingArrayUpdate":
        """Return the same update with its new entries computed and stored in memory.

        New entries may depend on the entries that they replace, so they are computed first.
        """
        if isinstance(self.update_array, np.ndarray):
            return self
        return PendingArrayUpdate(
            self.array_emitter,
            self.base_array,
            self.array_emitter.store_array_in_memory(self.update_array),
            self.start_index,
        )


class MemoryArray(LazyArray):
    """Large array whose entries are stored one after another in memory, from `base_pointer` on.

    `is_overwritable` is True if no other array uses the memory, so that a consumer may overwrite
    it.
    """

    def __init__(
        self,
        array_emitter: Any,
        array_shape: tuple[int, ...],
        entry_type: ir.Type,
        base_pointer: LlvmValue,
        is_overwritable: bool = False,
    ) -> None:
        super().__init__(array_shape, entry_type, self.emit_entry_load)
        self.array_emitter, self.base_pointer = array_emitter, base_pointer
        self.is_overwritable = is_overwritable

    def contains_array(self, array: "LlvmArray") -> bool:
        """Return whether `array` is stored in the memory of this array."""
        return isinstance(array, MemoryArray) and array.base_pointer is self.base_pointer

    def emit_entry_address(self, entry_index: EntryIndex) -> LlvmValue:
        """Return the LLVM value of the address of the entry at `entry_index`."""
        memory_offset = self.array_emitter.emit_memory_offset(entry_index, self.shape)
        return self.array_emitter.llvm_builder.gep(
            self.base_pointer, [memory_offset], source_etype=self.entry_type
        )

    def emit_entry_load(self, entry_index: EntryIndex) -> LlvmValue:
        """Emit a load of the entry at `entry_index`, and return its LLVM value."""
        return self.array_emitter.llvm_builder.load(
            self.emit_entry_address(entry_index), typ=self.entry_type
        )

    def emit_entry_store(self, entry_index: EntryIndex, stored_value: LlvmValue) -> None:
        """Emit a store of `stored_value` into the entry at `entry_index`."""
        if isinstance(self.entry_type, ir.VectorType):
            stored_value = self.array_emitter.value_emitter.to_lane_vector(stored_value)
        self.array_emitter.llvm_builder.store(stored_value, self.emit_entry_address(entry_index))

    def get_subarray(self, first_axis_index: LlvmValue) -> "MemoryArray":
        """Return the subarray at one index of the first axis, in the memory of this array."""
        zero_indices = (0,) * (len(self.shape) - 1)
        return MemoryArray(
            self.array_emitter,
            self.shape[1:],
            self.entry_type,
            self.emit_entry_address((first_axis_index, *zero_indices)),
        )


class TransposedMemoryView(LazyArray):
    """View of an array in memory, with the axes in another order."""

    def get_subarray(self, first_axis_index: LlvmValue) -> LazyArray:
        """Return the subarray at one index of the first axis."""
        return LazyArray(
            self.shape[1:],
            self.entry_type,
            lambda entry_index: self.get_entry_at_index((first_axis_index, *entry_index)),
        )


LlvmArray = np.ndarray | LazyArray
"""Array of LLVM values without the lane axis: a NumPy array of values in registers, or a lazy
array.
"""


def mark_memory_as_shared(array: LlvmArray) -> LlvmArray:
    """Return the array with a mark that other consumers still read it, so that no consumer
    overwrites its memory.
    """
    if isinstance(array, PendingArrayUpdate):
        return PendingArrayUpdate(
            array.array_emitter,
            mark_memory_as_shared(array.base_array),
            array.update_array,
            array.start_index,
        )
    if isinstance(array, MemoryArray) and array.is_overwritable:
        return MemoryArray(array.array_emitter, array.shape, array.entry_type, array.base_pointer)
    return array

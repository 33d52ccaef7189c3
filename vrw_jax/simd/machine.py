"""Interface to LLVM: the target processor, object code for it, and code loaded into memory."""

import ctypes
import functools
import platform
import struct
import sys
from enum import IntEnum
from typing import Any

from vrw_jax.simd.llvm_library import has_llvm, llvm

OPTIMIZATION_LEVEL = 2
"""LLVM's optimization level (0 to 3) for register allocation and instruction scheduling."""
LLVM_PASSES = (
    "global_dead_code_eliminate",
    "instruction_combine",
    "simplify_cfg",
    "aggressive_dce",
    "sinking",
)
"""LLVM passes that simplify the module.

They are chosen because the emitter repeats no computation and already uses vectors. LLVM's usual
list would take as long as the whole remaining compilation, for code at most a twentieth faster.
"""

ELF_64_BIT_LITTLE_ENDIAN = b"\x7fELF\x02\x01"
"""First bytes of the object files that LLVM writes on 64-bit Linux."""
ELF_HEADER = struct.Struct("<16sHHIQQQIHHHHHH")
"""Layout of the header of an ELF file, as a format of `struct`."""
ELF_SECTION = struct.Struct("<IIQQQQIIQQ")
"""Layout of an entry of the section table of an ELF file, as a format of `struct`."""


class ElfSectionKind(IntEnum):
    """Types of ELF sections that the check of an object file distinguishes."""

    STRING_TABLE = 3
    SECTION_WITHOUT_DATA = 8  # memory for which the file contains no bytes


@functools.cache
def describe_processor() -> tuple[str, str, str]:
    """Return the target of machine code: target triple, processor, and the list of its features.

    Without llvmlite only the kind of machine is known.
    """
    if not has_llvm:
        return platform.machine(), "", ""
    features = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), features


def compilation_key() -> str:
    """Return a text of everything, except LLVM's input, on which object code depends."""
    return repr((llvm.llvm_version_info, describe_processor(), OPTIMIZATION_LEVEL, LLVM_PASSES))


def has_512_bit_vectors() -> bool:
    """Return whether the processor has vector registers of 512 bits."""
    return "+avx512f" in describe_processor()[2]


def compile_native(llvm_text: str) -> bytes:
    """Return object code for this processor from LLVM text."""
    return _emit_object(llvm.parse_assembly(llvm_text), _make_target_machine())


def compile_wasm(llvm_text: str, entry_point: str, exported_name: str) -> bytes:
    """Return object code for WebAssembly from LLVM text, for vectors of 128 bits.

    The object is to be linked with others. Its one exported function is `entry_point`, which is
    renamed to `exported_name`.
    """
    module = llvm.parse_assembly(llvm_text)
    for symbol in (*module.functions, *module.global_variables):
        if not symbol.is_declaration and symbol.name != entry_point:
            symbol.linkage = "internal"
    module.get_function(entry_point).name = exported_name
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple("wasm32-unknown-unknown")
    machine = target.create_target_machine(
        cpu="generic",
        features="+simd128",
        opt=OPTIMIZATION_LEVEL,
        reloc="static",
        codemodel="default",
    )
    return _emit_object(module, machine)


def _emit_object(module: "llvm.ModuleRef", machine: "llvm.TargetMachine") -> bytes:
    """Return object code of a module after the passes in `LLVM_PASSES`."""
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    passes = llvm.create_new_module_pass_manager()
    for name in LLVM_PASSES:
        getattr(passes, f"add_{name}_pass")()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options()))
    return machine.emit_object(module)


def require_object(code: bytes, name: str) -> None:
    """Raise a ValueError unless `code` is a complete object file with a function called `name`.

    LLVM ends the process if a file is damaged, so its tables are checked here. Only files in the
    ELF format are checked completely. In other formats the check only looks for the name.
    """
    if f"\0{name}\0".encode() not in code and f"\0_{name}\0".encode() not in code:
        raise ValueError(f"it has no function {name}")
    if llvm.get_object_format() != "ELF" or sys.byteorder != "little":
        return
    if len(code) < ELF_HEADER.size or not code.startswith(ELF_64_BIT_LITTLE_ENDIAN):
        raise ValueError("it is no object file")
    *_, table_offset, _, _, _, _, entry_size, n_sections, name_table_index = ELF_HEADER.unpack_from(
        code
    )
    if (
        entry_size != ELF_SECTION.size
        or table_offset + n_sections * entry_size > len(code)
        or name_table_index >= n_sections
    ):
        raise ValueError("its table of sections is cut off")
    sections = [
        ELF_SECTION.unpack_from(code, table_offset + i * entry_size) for i in range(n_sections)
    ]
    for _, section_type, _, _, offset, length, *_ in sections:
        if section_type != ElfSectionKind.SECTION_WITHOUT_DATA and offset + length > len(code):
            raise ValueError("a section is cut off")
    if sections[name_table_index][1] != ElfSectionKind.STRING_TABLE:
        raise ValueError("it has no table of names")


class LoadedCode:
    """Machine code loaded into the memory of this process."""

    def __init__(self, code: bytes) -> None:
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _make_target_machine())
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()

    def find_address(self, name: str) -> int:
        """Return the address of a function in memory."""
        return self._engine.get_function_address(name)

    def make_capsule(self, name: str) -> Any:
        """Return a function as a PyCapsule, by which XLA can call it."""
        make_capsule = ctypes.pythonapi.PyCapsule_New
        make_capsule.restype = ctypes.py_object
        make_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
        return make_capsule(self.find_address(name), None, None)


def _make_target_machine() -> "llvm.TargetMachine":
    """Return LLVM's target machine for this processor."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    triple, name, features = describe_processor()
    target = llvm.Target.from_triple(triple)
    return target.create_target_machine(
        cpu=name, features=features, opt=OPTIMIZATION_LEVEL, jit=True
    )

"""Run machine code for arm64 in an emulator: load an object file, and call its function."""

import struct
from typing import NamedTuple

import numpy as np

CODE_ADDRESS, DATA_ADDRESS, STACK_ADDRESS, END_ADDRESS = 0x100000, 0x800000, 0xF00000, 0x10000
MEMORY_SIZE_BYTES = 0x1000000
PAGE_MASK = ~0xFFF


class Section(NamedTuple):
    """A section of an ELF file."""

    kind: int
    flags: int
    offset: int
    size: int
    link: int
    info: int


def load_object(code: bytes) -> tuple[bytes, dict[str, int]]:
    """Return the memory from `CODE_ADDRESS` on, with filled-in addresses, and the address of each
    symbol."""
    start, entry, count = *struct.unpack_from("<Q", code, 40), *struct.unpack_from("<HH", code, 58)
    sections = [
        Section(f[1], f[2], f[4], f[5], f[6], f[7])
        for f in (struct.unpack_from("<IIQQQQIIQQ", code, start + entry * i) for i in range(count))
    ]
    memory, places = bytearray(), {}
    for index, section in enumerate(sections):
        if (
            section.kind == 1 and section.flags & 2
        ):  # sections of code and data that exist at run time
            memory += bytes(-len(memory) % 64)
            places[index] = len(memory)
            memory += code[section.offset : section.offset + section.size]
    symbols = next(section for section in sections if section.kind == 2)
    names = sections[symbols.link].offset
    where, section_names = [], {}
    for address in range(symbols.offset, symbols.offset + symbols.size, 24):
        name, _, _, home, value, _ = struct.unpack_from("<IBBHQQ", code, address)
        where.append(CODE_ADDRESS + places.get(home, 0) + value if home in places else None)
        text = code[names + name : code.index(b"\0", names + name)].decode()
        section_names[text] = where[-1]
    for section in sections:
        if section.kind == 4 and section.info in places:
            for address in range(section.offset, section.offset + section.size, 24):
                offset, kind, addend = struct.unpack_from("<QQq", code, address)
                target = where[kind >> 32]
                assert target is not None, "the code calls a library"
                relocate(memory, places[section.info] + offset, kind & 0xFFFFFFFF, target + addend)
    return bytes(memory), section_names


OFFSET_SHIFTS = {277: 0, 278: 0, 284: 1, 285: 2, 286: 3, 299: 4}
"""Twelve low bits of an address, in units of what is loaded: its logarithm."""


def relocate(memory: bytearray, address: int, kind: int, target: int) -> None:
    """Write an address into an instruction or number of the code."""
    instruction = struct.unpack_from("<I", memory, address)[0]
    instruction_address = CODE_ADDRESS + address
    if kind == 275:  # adrp
        pages = ((target & PAGE_MASK) - (instruction_address & PAGE_MASK)) >> 12
        instruction |= (pages & 3) << 29 | (pages >> 2 & 0x7FFFF) << 5
    elif kind in OFFSET_SHIFTS:
        instruction |= (target & 0xFFF) >> OFFSET_SHIFTS[kind] << 10
    elif kind in (282, 283):  # b, bl
        instruction |= (target - instruction_address) >> 2 & 0x3FFFFFF
    elif kind == 261:
        instruction = (target - instruction_address) & 0xFFFFFFFF
    else:
        raise NotImplementedError(f"relocation {kind}")
    struct.pack_into("<I", memory, address, instruction)


def run_compiled_lanes(
    code: bytes, inputs: list[np.ndarray], output_shapes: list[np.ndarray], width: int
) -> None:
    """Run a kernel of `lanes.machine_code` on `inputs`; write its results into `output_shapes`."""
    from unicorn import UC_ARCH_ARM64, UC_MODE_ARM, Uc
    from unicorn import arm64_const as arm

    memory, named = load_object(code)
    emulator = Uc(UC_ARCH_ARM64, UC_MODE_ARM)
    emulator.mem_map(0, MEMORY_SIZE_BYTES)
    emulator.mem_write(CODE_ADDRESS, memory)
    free, lists = DATA_ADDRESS, []
    for arrays in (inputs, output_shapes):
        pointers = []
        for array in arrays:
            emulator.mem_write(free, array.tobytes())
            pointers.append(free)
            free += array.nbytes + 64
        lists.append(free)
        emulator.mem_write(free, struct.pack(f"<{len(pointers)}Q", *pointers))
        free += 8 * len(pointers) + 64
        last = pointers
    n = output_shapes[0].shape[-1]
    for register, value in zip(range(5), (*lists, n, 0, n // width), strict=True):
        emulator.reg_write(arm.UC_ARM64_REG_X0 + register, value)
    emulator.reg_write(arm.UC_ARM64_REG_CPACR_EL1, 3 << 20)  # enable vector instructions
    emulator.reg_write(arm.UC_ARM64_REG_SP, STACK_ADDRESS)
    emulator.reg_write(arm.UC_ARM64_REG_LR, END_ADDRESS)
    emulator.emu_start(named["lanes"], END_ADDRESS)
    for array, pointer in zip(output_shapes, last, strict=True):
        read = np.frombuffer(emulator.mem_read(pointer, array.nbytes), array.dtype)
        array[...] = read.reshape(array.shape)

"""Run the code inside docs/wheel.html with wasmtime, as a browser runs it."""

import ctypes
import gzip
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.web.build import CODE, FACTS, SHARED_MODULE_NAME, read_page_content, unpack_bytes

PAGE_PATH = Path(__file__).parents[2] / "docs" / "wheel.html"


class PageCode:
    """Functions of the page for wheels with one number of legs; lanes are the last axis."""

    def __init__(self, n_legs: int) -> None:
        self.modules = WasmModule(str(n_legs)), WasmModule(SHARED_MODULE_NAME)
        self.facts = self.modules[0].facts

    def __call__(self, name: str, *given: Any) -> list[np.ndarray]:
        """Call a function; see `WasmModule`."""
        [owner] = [module for module in self.modules if name in module]
        return owner(name, *given)


class WasmModule:
    """One WebAssembly module of the page."""

    def __init__(self, name: str) -> None:
        wasmtime = pytest.importorskip("wasmtime", reason="wasmtime runs the page's code here")
        page = PAGE_PATH.read_text(encoding="utf-8")
        self.facts = read_page_content(page, FACTS)
        code = gzip.decompress(unpack_bytes(read_page_content(page, CODE)[name]))
        self._store, self._kept = (
            wasmtime.Store(),
            [],
        )  # The functions that the module calls must outlive it.
        module = wasmtime.Module(self._store.engine, code)
        float_type = wasmtime.FuncType([wasmtime.ValType.f64()], [wasmtime.ValType.f64()])
        self.imports = [needed.name for needed in module.imports]
        imports = [
            self._make_callback(float_type, getattr(math, import_item))
            for import_item in self.imports
        ]
        self._exports = wasmtime.Instance(self._store, module, imports).exports(self._store)
        self._memory = self._exports["memory"]
        self._free = self._exports["__heap_base"].value(self._store)

    def __contains__(self, name: str) -> bool:
        return name in self._exports

    def _make_callback(self, kind: Any, function: Callable[[float], float]) -> Any:
        """Return a callback of one number without the checks of `wasmtime.Func`.

        The checks take thirty times as long, and a run needs a million sines.
        """
        from wasmtime import Func, _bindings

        def call(_env: Any, _caller: Any, values: Any, _n: int) -> int:
            values[0].f64 = function(values[0].f64)
            return 0

        callback = _bindings.wasmtime_func_unchecked_callback_t(call)
        self._kept.append(callback)
        callback_type, never = (
            _bindings.wasmtime_func_t(),
            ctypes.CFUNCTYPE(None, ctypes.c_void_p)(0),
        )
        context = self._store._context()
        _bindings.wasmtime_func_new_unchecked(
            context, kind.ptr(), callback, None, never, ctypes.byref(callback_type)
        )
        return Func._from_raw(callback_type)

    def __call__(
        self, name: str, numbers: list[float], arrays: list[np.ndarray], output_sizes: list[Any]
    ) -> list[np.ndarray]:
        """Return the results; `output_sizes` holds the rows and number type of each."""
        n = arrays[0].shape[-1]
        lanes = n + n % 2
        padded = [np.concatenate([x, x[..., -1:]], -1)[..., :lanes] for x in arrays]
        inputs = [struct.pack("<d", x) for x in numbers]
        inputs += [np.ascontiguousarray(x, np.float64).tobytes() for x in padded]
        sizes = [math.prod(rows) * lanes * np.dtype(kind).itemsize for rows, kind in output_sizes]
        addresses, end = [], -(-self._free // 16) * 16
        for size in [*map(len, inputs), *sizes, 4 * len(inputs), 4 * len(output_sizes)]:
            addresses.append(end)
            end += -(-size // 16) * 16
        missing = end - self._memory.data_len(self._store)
        if missing > 0:
            self._memory.grow(self._store, -(-missing // 65536))
        for address, content in zip(addresses, inputs, strict=False):
            self._memory.write(self._store, content, address)
        input_pointers, output_pointers = addresses[: len(inputs)], addresses[len(inputs) : -2]
        for table, table_address in (
            (input_pointers, addresses[-2]),
            (output_pointers, addresses[-1]),
        ):
            self._memory.write(self._store, struct.pack(f"<{len(table)}i", *table), table_address)
        self._exports[name](self._store, addresses[-2], addresses[-1], lanes, 0, lanes // 2)
        read_memory = lambda address, size: bytes(
            self._memory.read(self._store, address, address + size)
        )
        return [
            np.frombuffer(read_memory(address, size), kind).reshape(*rows, lanes)[..., :n]
            for address, size, (rows, kind) in zip(
                output_pointers, sizes, output_sizes, strict=True
            )
        ]

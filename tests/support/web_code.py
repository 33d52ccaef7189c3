"""The code inside docs/wheel.html, run here by wasmtime as a browser runs it."""

import ctypes
import gzip
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.web.build import CODE, FACTS, SHARED, told_in, unpacked

PAGE = Path(__file__).parents[2] / "docs" / "wheel.html"


class WebCode:
    """The page's functions for wheels with so many legs; lanes are the last axis."""

    def __init__(self, n_legs: int) -> None:
        self.modules = Module(str(n_legs)), Module(SHARED)
        self.facts = self.modules[0].facts

    def __call__(self, name: str, *given: Any) -> list[np.ndarray]:
        """See `Module`."""
        [owner] = [module for module in self.modules if name in module]
        return owner(name, *given)


class Module:
    """One of the page's codes."""

    def __init__(self, name: str) -> None:
        wasmtime = pytest.importorskip("wasmtime", reason="wasmtime runs the page's code here")
        page = PAGE.read_text(encoding="utf-8")
        self.facts = told_in(page, FACTS)
        code = gzip.decompress(unpacked(told_in(page, CODE)[name]))
        self._store, self._kept = wasmtime.Store(), []  # what it calls must outlive it
        module = wasmtime.Module(self._store.engine, code)
        real = wasmtime.FuncType([wasmtime.ValType.f64()], [wasmtime.ValType.f64()])
        self.imports = [needed.name for needed in module.imports]
        given = [self._lent(real, getattr(math, one)) for one in self.imports]
        self._exports = wasmtime.Instance(self._store, module, given).exports(self._store)
        self._memory = self._exports["memory"]
        self._free = self._exports["__heap_base"].value(self._store)

    def __contains__(self, name: str) -> bool:
        return name in self._exports

    def _lent(self, kind: Any, function: Callable[[float], float]) -> Any:
        """A function of a number, called without the checks of `wasmtime.Func`: these take thirty
        times as long, and a sine is needed a million times."""
        from wasmtime import Func, _bindings

        def call(_env: Any, _caller: Any, values: Any, _n: int) -> int:
            values[0].f64 = function(values[0].f64)
            return 0

        callback = _bindings.wasmtime_func_unchecked_callback_t(call)
        self._kept.append(callback)
        made, never = _bindings.wasmtime_func_t(), ctypes.CFUNCTYPE(None, ctypes.c_void_p)(0)
        context = self._store._context()
        _bindings.wasmtime_func_new_unchecked(
            context, kind.ptr(), callback, None, never, ctypes.byref(made)
        )
        return Func._from_raw(made)

    def __call__(
        self, name: str, numbers: list[float], arrays: list[np.ndarray], told: list[Any]
    ) -> list[np.ndarray]:
        """`told`: the results' rows and kinds."""
        n = arrays[0].shape[-1]
        lanes = n + n % 2
        filled = [np.concatenate([x, x[..., -1:]], -1)[..., :lanes] for x in arrays]
        inputs = [struct.pack("<d", x) for x in numbers]
        inputs += [np.ascontiguousarray(x, np.float64).tobytes() for x in filled]
        sizes = [math.prod(rows) * lanes * np.dtype(kind).itemsize for rows, kind in told]
        places, end = [], -(-self._free // 16) * 16
        for size in [*map(len, inputs), *sizes, 4 * len(inputs), 4 * len(told)]:
            places.append(end)
            end += -(-size // 16) * 16
        missing = end - self._memory.data_len(self._store)
        if missing > 0:
            self._memory.grow(self._store, -(-missing // 65536))
        for place, content in zip(places, inputs, strict=False):
            self._memory.write(self._store, content, place)
        given, out = places[: len(inputs)], places[len(inputs) : -2]
        for table, where in ((given, places[-2]), (out, places[-1])):
            self._memory.write(self._store, struct.pack(f"<{len(table)}i", *table), where)
        self._exports[name](self._store, places[-2], places[-1], lanes, 0, lanes // 2)
        read = lambda place, size: bytes(self._memory.read(self._store, place, place + size))
        return [
            np.frombuffer(read(place, size), kind).reshape(*rows, lanes)[..., :n]
            for place, size, (rows, kind) in zip(out, sizes, told, strict=True)
        ]

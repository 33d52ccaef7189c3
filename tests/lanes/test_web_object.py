"""WebAssembly code of lane functions, linked and run here as in a browser."""

import shutil
import struct
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from experiments.web.build import link_module
from vrw_jax import lanes


def halve_until(minimum, x):
    """Halve each lane until it is below the minimum; the lanes need different numbers of turns."""
    goes_on = lambda now: jnp.any(now > minimum)
    return (lax.while_loop(goes_on, lambda now: jnp.where(now > minimum, 0.5 * now, now), x),)


def test_two_functions_in_one_module_agree_with_jax():
    wasmtime = pytest.importorskip("wasmtime", reason="wasmtime runs the code here")
    if shutil.which("wasm-ld") is None and find_spec("ziglang") is None:
        pytest.skip("there is no wasm-ld, of Debian's lld or ziglang")
    by_input = {
        "halved": halve_until,
        "turned": lambda minimum, x: (jnp.stack([minimum - x[1], x[0]]),),
    }
    code = link_module(
        {
            name: lanes.compile_wasm_object(function, 1, [2], name)
            for name, function in by_input.items()
        }
    )
    store = wasmtime.Store()
    exports = wasmtime.Instance(store, wasmtime.Module(store.engine, code), []).exports(store)
    memory, place = exports["memory"], exports["__heap_base"].value(store)
    memory.grow(store, 1)
    x = np.random.default_rng(3).uniform(0.1, 50.0, (2, 6))
    minimum, array, result, pointers = (place + step for step in (0, 8, 128, 256))
    memory.write(store, struct.pack("<d", 0.3), minimum)
    memory.write(store, x.tobytes(), array)
    memory.write(store, struct.pack("<3i", minimum, array, result), pointers)
    for name, function in by_input.items():
        exports[name](store, pointers, pointers + 8, 6, 0, 3)
        solution = np.frombuffer(bytes(memory.read(store, result, result + 96))).reshape(2, 6)
        assert np.array_equal(solution, function(0.3, jnp.asarray(x))[0])

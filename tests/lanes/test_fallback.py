"""With an untested release of JAX the library warns once, and XLA computes the same."""

import ctypes
import json
import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax import lanes
from vrw_jax.lanes import machine_code, program

PROGRAM = """
import json, sys, warnings
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from vrw_jax.lanes import program, machine_code, lowering
program.LATEST_TESTED_JAX_RELEASE = (0, 1)
{change}
import vrw_jax as vrw
from vrw_jax import lanes
vrw.start_jax(sys.argv[1])
def double_until_large(x):
    return lax.while_loop(lambda y: jnp.any(y < 9.0), lambda y: jnp.where(y < 9.0, 2.0 * y, y), x)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    is_available = lanes.is_machine_code_available()
    run = lanes.compile_batch_function(double_until_large, xla_block_size=4)
    x = jnp.linspace(1.0, 10.0, 9)
    in_jit = (jax.jit(run) if is_available else jax.jit(double_until_large))(x).tolist()
    of_arrays = run.run(np.asarray(x)).tolist()
texts = ("machine code does not work", "XLA computes double_until_large, more slowly")
messages = [str(w.message) for w in caught if any(text in str(w.message) for text in texts)]
print(json.dumps([in_jit, of_arrays, messages, lanes.is_machine_code_available()]))
"""

CHANGES = {
    "a primitive is new": 'del lowering.PRIMITIVE_RULES["while"]',
    "the call interface differs": "machine_code.read_ffi_api_version = lambda: (7, 0)",
    "nothing differs": "",
}


def run_program(source, folder):
    """Return the JSON that a program prints in a process of its own."""
    process = subprocess.run(
        [sys.executable, "-c", source, str(folder)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-2000:]
    return json.loads(process.stdout)


@pytest.mark.parametrize("change", CHANGES)
def test_xla_computes_where_an_untested_jax_differs(change, tmp_path):
    results = run_program(PROGRAM.format(change=CHANGES[change]), tmp_path)
    in_jit, of_arrays, messages, is_available = results
    x = np.linspace(1.0, 10.0, 9)
    doubled = x * 2.0 ** np.ceil(np.log2(np.maximum(9.0 / x, 1.0)))
    np.testing.assert_array_equal(in_jit, doubled)
    np.testing.assert_array_equal(of_arrays, doubled)
    assert len(messages) == (change != "nothing differs")
    # A primitive concerns one function, the interface concerns all.
    assert is_available == (change != "the call interface differs")


WHEEL_PROGRAM = """
import json, sys, warnings
import numpy as np
from vrw_jax.lanes import program, machine_code
program.LATEST_TESTED_JAX_RELEASE = (0, 1)
machine_code.read_ffi_api_version = lambda: (7, 0)
import vrw_jax as vrw
vrw.start_jax(sys.argv[1])
warnings.simplefilter("ignore")
wheels = vrw.WheelParams(damping=np.array([150.0, 200.0]))
result = vrw.step_batch(wheels, np.tile(vrw.paper_start(), (2, 1)))
print(json.dumps(result.section_state.tolist()))
"""


@pytest.mark.slow
def test_the_library_computes_where_machine_code_cannot_be_called(tmp_path):
    section_states = run_program(WHEEL_PROGRAM, tmp_path)
    wheels = vrw.WheelParams(damping=np.array([150.0, 200.0]))
    starts = np.tile(vrw.paper_start(), (2, 1))
    # Both agree to the tolerance of a step.
    reference = np.asarray(vrw.step_batch(wheels, starts).section_state)
    np.testing.assert_allclose(section_states, reference, rtol=1e-8, atol=1e-10)


def test_the_handler_reports_its_version_to_a_request_for_metadata_only():
    """Structs of xla/ffi/api/c_api.h: a call frame, its extension, and the metadata."""
    run = lanes.compile_batch_function(lambda x: x + 1.0)
    np.testing.assert_array_equal(run(jnp.arange(8.0)), np.arange(8.0) + 1.0)
    code = list(program.LOADED_CODE_BY_FFI_TARGET.values())[-1]
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(
        code.find_function_address(machine_code.FFI_HANDLER_NAME)
    )
    metadata = (ctypes.c_int64 * 8)()
    extension = (ctypes.c_int64 * 4)(32, machine_code.FFI_METADATA_EXTENSION_TYPE, 0)
    extension[3] = ctypes.addressof(metadata)
    frame = (ctypes.c_int64 * 32)(0, ctypes.addressof(extension))
    assert not handler(ctypes.addressof(frame))
    version = machine_code.read_ffi_api_version()
    assert tuple((ctypes.c_int32 * 2).from_buffer(metadata, 24)) == version
    assert version != (0, 0)

"""LLVM makes arm64 code from the same text, and an emulator computes the same digits."""

import jax.numpy as jnp
import llvmlite.binding
import numpy as np
import pytest
from support.arm import run_compiled_lanes

from vrw_jax.lanes import llvm, machine_code

ARM_TARGET = ("aarch64-unknown-linux-gnu", "generic", "+neon")
LANES_PER_REGISTER = 2


@pytest.fixture
def arm_machine(monkeypatch):
    """Make machine code for arm64 in the test."""
    llvmlite.binding.initialize_all_targets()
    llvmlite.binding.initialize_all_asmprinters()
    monkeypatch.setattr(llvm, "describe_processor", lambda: ARM_TARGET)


def compute_roots(a, b):
    return jnp.sqrt(a * a + b), jnp.where(a > b, a / b, 3.25 - b)


def compute_waves(a, b):
    """Return waves; the code has constants at other addresses, and loops over rows."""
    return a * 0.1234567 + b, jnp.cumsum(jnp.stack([a, b, a * b, a - b]), axis=0) * 1.7


def compile_for_arm(function, *lanes):
    return llvm.compile_llvm_for_processor(
        machine_code.write_llvm_kernel(
            machine_code.trace_for_machine_code(function, *lanes)[0], LANES_PER_REGISTER
        )
    )


@pytest.mark.parametrize("function", [compute_roots, compute_waves])
def test_code_for_arm64_agrees_with_jax(arm_machine, function):
    pytest.importorskip("unicorn")
    a, b = np.random.default_rng(0).uniform(0.5, 2.0, (2, 6))
    lanes = [np.zeros(1021)] * 2
    reference = [np.asarray(x) for x in function(a, b)]
    rows = [np.zeros_like(x) for x in reference]
    run_compiled_lanes(compile_for_arm(function, *lanes), [a, b], rows, LANES_PER_REGISTER)
    for got, right in zip(rows, reference, strict=True):
        np.testing.assert_allclose(got, right, rtol=1e-15)


def test_the_object_file_is_for_arm64(arm_machine):
    assert compile_for_arm(compute_roots, *[np.zeros(1021)] * 2)[18:20] == b"\xb7\x00"

"""arm64: LLVM makes code of the same text, and an emulator gets the same digits by it."""

import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
import pytest
from support.arm import run_lanes

from vrw_jax.simd import code, kernel, machine

ARM = ("aarch64-unknown-linux-gnu", "generic", "+neon")
WIDTH = 2


@pytest.fixture
def arm(monkeypatch):
    """Machine code is for arm64 from here on."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    monkeypatch.setattr(machine, "processor", lambda: ARM)


def roots(a, b):
    return jnp.sqrt(a * a + b), jnp.where(a > b, a / b, 3.25 - b)


def waves(a, b):
    """With constants that lie apart from the code, and loops over rows."""
    return a * 0.1234567 + b, jnp.cumsum(jnp.stack([a, b, a * b, a - b]), axis=0) * 1.7


def made(function, *lanes):
    return machine.compiled(kernel.module_text(code.traced(function, *lanes), WIDTH))


@pytest.mark.parametrize("function", [roots, waves])
def test_code_for_arm64_gets_the_digits_of_jax(arm, function):
    pytest.importorskip("unicorn")
    a, b = np.random.default_rng(0).uniform(0.5, 2.0, (2, 6))
    lanes = [np.zeros(1021)] * 2
    truth = [np.asarray(x) for x in function(a, b)]
    told = [np.zeros_like(x) for x in truth]
    run_lanes(made(function, *lanes), [a, b], told, WIDTH)
    for got, right in zip(told, truth, strict=True):
        np.testing.assert_allclose(got, right, rtol=1e-15)


def test_the_object_is_one_for_arm64(arm):
    assert made(roots, *[np.zeros(1021)] * 2)[18:20] == b"\xb7\x00"

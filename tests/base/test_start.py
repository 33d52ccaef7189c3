"""Start of a process: number format, cached traces and XLA's quick compilation."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.lanes import program
from vrw_jax.lanes.environment import make_fusion_emitter_options


def read_output_lines(code, **environment):
    outside = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_ENABLE_X64")}
    out = subprocess.run(
        [sys.executable, "-c", code], env=outside | environment, capture_output=True, text=True
    )
    assert out.returncode == 0, out.stderr
    return out.stdout.split()


@pytest.fixture
def cache_folder(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.fixture
def exports(monkeypatch):
    """Return a list to which each export of a trace appends."""
    exported, original_export = [], program.export.export
    spy = lambda *a, **k: exported.append(1) or original_export(*a, **k)
    monkeypatch.setattr(program.export, "export", spy)
    return exported


def add_sine(shift, x, y):
    return {"sum": jnp.sin(x) + shift * y}


def test_started_processes_compute_in_64_bits_with_the_fast_compiler(tmp_path):
    code = (
        "import os, jax, vrw_jax as vrw; vrw.start_jax(); x = jax.numpy.sin(1.0); "
        "print(x.dtype, jax.config.jax_compilation_cache_dir, os.environ['XLA_FLAGS'])"
    )
    result = read_output_lines(
        code, JAX_COMPILATION_CACHE_DIR=str(tmp_path), XLA_FLAGS="--xla_cpu_enable_fast_math=false"
    )
    assert result[:2] == ["float64", str(tmp_path)]
    quick = [
        f"--{name}=false" for name in make_fusion_emitter_options(True)
    ]  # none where XLA lacks the flag
    assert result[2:] == ["--xla_cpu_enable_fast_math=false", *quick]


def test_the_cache_folder_may_be_relative_to_the_home_folder(tmp_path):
    code = (
        "import jax, vrw_jax as vrw; vrw.start_jax('~/code'); "
        "print(jax.config.jax_compilation_cache_dir)"
    )
    assert read_output_lines(code, HOME=str(tmp_path)) == [str(tmp_path / "code")]


def test_a_later_call_without_a_folder_keeps_the_folder(tmp_path):
    """Workers of a scan start JAX, too, and a worker may be a thread of the calling process."""
    code = (
        "import jax, vrw_jax as vrw; vrw.start_jax('~/code'); vrw.start_jax(); "
        "print(jax.config.jax_compilation_cache_dir)"
    )
    assert read_output_lines(code, HOME=str(tmp_path)) == [str(tmp_path / "code")]


def test_a_flag_set_by_the_user_is_kept():
    flag = "--xla_cpu_use_fusion_emitters=true"
    code = "import os, vrw_jax as vrw; vrw.start_jax(); print(os.environ['XLA_FLAGS'])"
    assert read_output_lines(code, XLA_FLAGS=flag) == [flag]


def evaluate_by_saved_trace(shift, x, y):
    """Evaluate as another process would: nothing is remembered but on disk."""
    function = functools.partial(add_sine, shift)
    return jax.jit(lambda x, y: program.wrap_with_saved_trace(function)(x, y)["sum"])(x, y)


def test_a_cached_trace_is_reused_and_gives_the_same_values(cache_folder, exports):
    x, y = jnp.arange(3.0), jnp.ones(3)
    for _ in range(2):
        np.testing.assert_array_equal(evaluate_by_saved_trace(1.0, x, y), jnp.sin(x) + y)
    assert len(exports) == 1
    np.testing.assert_array_equal(evaluate_by_saved_trace(2.0, x, y), jnp.sin(x) + 2.0)
    np.testing.assert_array_equal(evaluate_by_saved_trace(1.0, x[:2], y[:2]), jnp.sin(x[:2]) + 1.0)
    assert len(exports) == 3


def test_a_damaged_trace_is_traced_again(cache_folder, exports):
    expected = evaluate_by_saved_trace(1.0, jnp.ones(2), jnp.ones(2))
    (place,) = cache_folder.glob("vrw_trace_*")
    place.write_bytes(place.read_bytes()[:-1] + b"?")
    again = evaluate_by_saved_trace(1.0, jnp.ones(2), jnp.ones(2))
    np.testing.assert_array_equal(again, expected)
    assert len(exports) == 2


@pytest.mark.skipif(
    not make_fusion_emitter_options(True), reason="this XLA has one way of compiling"
)
def test_both_compilers_give_the_same_gait():
    params = vrw.WheelParams()
    measured = lambda p: (lambda c: (c.section_state, c.multipliers.real))(vrw.limit_cycle(p))
    lowered = jax.jit(measured).lower(params)
    assert "use_fusion_emitters=false" in os.environ["XLA_FLAGS"]
    usual, quick = lowered.compile({"xla_cpu_use_fusion_emitters": True})(params), measured(params)
    # Another order of roundings, and Newton's last correction below 1e-11.
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12), quick, usual
    )

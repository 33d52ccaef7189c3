"""Machine code is stored beside JAX's; an edit that changes no trace compiles nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.machine_code import CodeRegistrySpy, use_cache_folder

from vrw_jax import lanes
from vrw_jax.lanes import environment as store
from vrw_jax.lanes import machine_code as code
from vrw_jax.lanes import program

X = jnp.asarray(np.random.default_rng(0).normal(size=(2, 9)))


@pytest.fixture
def cache_folder(tmp_path):
    """Return a cache folder of the test, in which JAX also stores all its programs."""
    with use_cache_folder(tmp_path):
        yield tmp_path


@pytest.fixture
def fresh_process(monkeypatch):
    return CodeRegistrySpy(monkeypatch)


def run_saved_program():
    """Return the results of a saved JAX program that calls machine code."""
    double = lanes.compile_batch_function(lambda x: 2.0 * x)
    run = lambda x: double(x) + 1.0
    return lanes.compile_exported_function(run, (X,), jax.devices()[0])(X)


def test_a_cached_program_finds_the_machine_code_that_it_calls(cache_folder, fresh_process):
    expected = 2.0 * np.asarray(X) + 1.0
    np.testing.assert_array_equal(run_saved_program(), expected)
    fresh_process.reset_registry()
    np.testing.assert_array_equal(run_saved_program(), expected)
    assert (len(fresh_process.names), fresh_process.n_traces) == (2, 1)
    for place in cache_folder.glob("lanes_code_*"):
        place.unlink()
    fresh_process.reset_registry()
    np.testing.assert_array_equal(run_saved_program(), expected)  # traced and compiled anew
    assert (len(set(fresh_process.names)), fresh_process.n_traces) == (1, 2)


def test_an_edit_that_changes_no_trace_compiles_nothing(cache_folder, fresh_process, monkeypatch):
    """Neither the machine code, whose name stays, nor JAX's program that calls it by that name."""
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        first = run_saved_program()
        by_jax = set(cache_folder.glob("*-cache"))
        fresh_process.reset_registry()
        monkeypatch.setattr(
            store, "compute_source_digest", lambda: "of the library with another docstring"
        )
        monkeypatch.setattr(code, "compile_llvm_for_processor", None)  # would fail
        np.testing.assert_array_equal(run_saved_program(), first)
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)
    assert fresh_process.n_traces == 2
    assert len(set(fresh_process.names)) == 1
    assert by_jax == set(cache_folder.glob("*-cache")) != set()


def test_a_program_cached_by_another_processor_is_traced_again(cache_folder, monkeypatch):
    """It calls machine code that may not run here."""
    exports = []
    original_export = program.export.export
    spy = lambda *a, **k: exports.append(1) or original_export(*a, **k)
    monkeypatch.setattr(program.export, "export", spy)
    run = lambda: lanes.compile_exported_function(lambda x: 2.0 * x, (X,), jax.devices()[0])(X)
    run(), run()
    assert len(exports) == 1
    monkeypatch.setattr(program, "describe_processor", lambda: ("x86_64", "another", ""))
    run()
    assert len(exports) == 2


def test_damaged_files_are_compiled_again(cache_folder, fresh_process):
    run = lambda: lanes.compile_batch_function(lambda x: 2.0 * x).run(np.arange(4.0))
    assert run()[3] == 6.0
    for place in cache_folder.glob("lanes_*"):
        content = bytearray(place.read_bytes())
        content[-10] ^= 1
        place.write_bytes(content)
    fresh_process.reset_registry()
    assert run()[3] == 6.0
    assert fresh_process.n_traces == 2

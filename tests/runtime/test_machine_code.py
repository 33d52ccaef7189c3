"""Machine code is stored beside JAX's; an edit that changes no trace compiles nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache
from support.machine_code import CodeRegistrySpy

from vrw_jax import simd
from vrw_jax.numerics import (
    compile_batch_function,
    compile_cached_lane_program,
    compile_exported_function,
)
from vrw_jax.runtime import disk_cache as store
from vrw_jax.simd import code_cache as code

X = jnp.asarray(np.random.default_rng(0).normal(size=(2, 9)))


@pytest.fixture
def cache_folder(tmp_path):
    """Return a cache folder of the test, in which JAX also stores all its programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compilation_cache.reset_cache()  # it may have opened another folder
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


@pytest.fixture
def fresh_process(monkeypatch):
    return CodeRegistrySpy(monkeypatch)


def make_function(traced):
    """Return a JAX program that calls machine code, and appends to a list when it is traced."""
    double = compile_batch_function(lambda x: 2.0 * x, lambda x: x, "double")

    def run(x):
        traced.append(1)
        return double(x) + 1.0

    return compile_exported_function(run, (X,), "kept", jax.devices()[0])(X)


def test_a_cached_program_finds_the_machine_code_that_it_calls(cache_folder, fresh_process):
    traced, expected = [], 2.0 * np.asarray(X) + 1.0
    np.testing.assert_array_equal(make_function(traced), expected)
    fresh_process.reset_registry()
    np.testing.assert_array_equal(make_function(traced), expected)
    assert (len(fresh_process.names), len(traced)) == (2, 1)
    for place in cache_folder.glob("lanes_code_*"):
        place.unlink()
    fresh_process.reset_registry()
    np.testing.assert_array_equal(make_function(traced), expected)  # traced and compiled anew
    assert (len(set(fresh_process.names)), len(traced)) == (1, 2)


def test_an_edit_that_changes_no_trace_compiles_nothing(cache_folder, fresh_process, monkeypatch):
    """Neither the machine code, whose name stays, nor JAX's program that calls it by that name."""
    traced = []
    before = jax.config.jax_persistent_cache_min_compile_time_secs
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    try:
        first = make_function(traced)
        by_jax = set(cache_folder.glob("*-cache"))
        fresh_process.reset_registry()
        monkeypatch.setattr(
            store, "compute_source_digest", lambda: "of the library with another docstring"
        )
        monkeypatch.setattr(code, "compile_llvm_for_processor", None)  # would fail
        np.testing.assert_array_equal(make_function(traced), first)
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before)
    assert len(traced) == 2
    assert len(set(fresh_process.names)) == 1
    assert by_jax == set(cache_folder.glob("*-cache")) != set()


def test_a_program_cached_by_another_processor_is_traced_again(cache_folder, monkeypatch):
    """It calls machine code that may not run here."""
    traced = []

    def double(x):
        traced.append(1)
        return 2.0 * x

    run = lambda: compile_exported_function(double, (jnp.ones(2),), "kept", jax.devices()[0])(
        jnp.ones(2)
    )
    run(), run()
    assert len(traced) == 1
    monkeypatch.setattr(simd, "describe_processor", lambda: ("x86_64", "another", ""))
    run()
    assert len(traced) == 2


def test_damaged_files_are_compiled_again(cache_folder, fresh_process):
    lanes, traced = [np.arange(4.0)], []

    def run():
        def double(_, x):
            traced.append(1)
            return (2.0 * x[0],)

        return compile_cached_lane_program(double, [], 1, lanes[0].dtype, "double")([], lanes)[0]

    assert run()[3] == 6.0
    for place in cache_folder.glob("lanes_*"):
        content = bytearray(place.read_bytes())
        content[-10] ^= 1
        place.write_bytes(content)
    fresh_process.reset_registry()
    assert run()[3] == 6.0
    assert len(traced) == 2

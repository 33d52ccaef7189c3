"""Machine code is stored by its content; a later start or another program finds it."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support.machine_code import CodeRegistrySpy

from vrw_jax import simd
from vrw_jax.simd import code_cache as code
from vrw_jax.simd import kernel

LANES, X = [np.arange(4.0)], np.arange(4.0)


class MemoryStore(dict):
    """A store in memory."""

    load_cache_record = dict.get
    save_cache_record = dict.__setitem__


@pytest.fixture(autouse=True)
def fresh_process(monkeypatch):
    return CodeRegistrySpy(monkeypatch)


def make_counted_function(factor=2.0):
    """Return a function of lanes, and the list to which each of its traces appends."""
    traces = []

    def times(_, lanes):
        traces.append(factor)
        return (factor * lanes[0],)

    return times, traces


def run_program(function, key, store):
    compute_again = lambda *arguments: function(
        *arguments
    )  # JAX knows the trace of the function itself
    return list(
        simd.compile_lane_program(compute_again, [], 1, LANES[0].dtype, key, store)([], LANES)[0]
    )


def test_a_later_start_neither_traces_nor_compiles(monkeypatch, fresh_process):
    double, traces = make_counted_function()
    store = MemoryStore()
    assert run_program(double, "double", store) == [0.0, 2.0, 4.0, 6.0]
    monkeypatch.setattr(code, "compile_llvm_for_processor", None)  # would fail
    assert run_program(double, "double", store) == [0.0, 2.0, 4.0, 6.0]
    fresh_process.reset_registry()
    assert run_program(double, "double", store) == [0.0, 2.0, 4.0, 6.0]
    assert len(traces) == 1


@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_same_trace_under_another_key_is_not_compiled(monkeypatch, fresh_process, elsewhere):
    double, traces = make_counted_function()
    store = MemoryStore()
    run_program(double, "double", store)
    if elsewhere:
        fresh_process.reset_registry()
    else:
        store = None
    monkeypatch.setattr(code, "compile_llvm_for_processor", None)  # would fail
    assert run_program(double, ("double", "after an edit of its docstring"), store) == [
        0.0,
        2.0,
        4.0,
        6.0,
    ]
    assert len(traces) == 2


def run_two_programs(x, key, *functions):
    calls = [simd.compile_lane_function(f, f, (key, i), None) for i, f in enumerate(functions)]
    return sum(call(x) for call in calls)


def test_other_traces_and_compiler_settings_have_separate_code(monkeypatch):
    store = MemoryStore()
    assert run_program(make_counted_function(2.0)[0], 2, store)[3] == 6.0
    assert run_program(make_counted_function(3.0)[0], 3, store)[3] == 9.0
    monkeypatch.setattr(code, "describe_compiler_settings", lambda: "by another processor")
    double, traces = make_counted_function()
    assert run_program(double, 2, store)[3] == 6.0
    assert len(traces) == 1
    names = [name.split("_")[1] for name in store]
    assert (names.count("code"), names.count("index")) == (3, 3)


def test_tracing_continues_during_compilation_and_receives_its_errors(monkeypatch):
    may, compiled = threading.Event(), code.compile_llvm_for_processor
    monkeypatch.setattr(
        code, "compile_llvm_for_processor", lambda text: may.wait(60) and compiled(text)
    )
    evaluate_both = lambda x: run_two_programs(x, "at work", lambda x: 2.5 * x, lambda x: 3.5 * x)
    traced = jax.jit(evaluate_both).trace(X)
    may.set()
    np.testing.assert_array_equal(traced.lower().compile()(X), 6.0 * X)

    def refuse(text):
        raise RuntimeError("no such instruction")

    monkeypatch.setattr(code, "compile_llvm_for_processor", refuse)
    traced = jax.jit(
        lambda x: run_two_programs(x, "refused", lambda x: 4.5 * x, lambda x: x / 7.0)
    ).trace(X)
    with pytest.raises(RuntimeError, match="no such instruction"):
        traced.lower()


def test_an_index_without_its_code_is_compiled_again(fresh_process):
    double, traces = make_counted_function()
    store = MemoryStore()
    run_program(double, "double", store)
    del store[next(name for name in store if name.startswith("lanes_code_"))]
    fresh_process.reset_registry()
    assert run_program(double, "double", store)[3] == 6.0
    fresh_process.reset_registry()
    assert run_program(double, "double", store)[3] == 6.0
    assert len(traces) == 2


def test_another_batch_is_neither_traced_nor_compiled_again_without_a_store():
    traced = []

    def double(x):
        traced.append(1)
        return 2.0 * x

    call = simd.compile_lane_function(double, lambda x: x, "batches", None)
    for n in (5, 8, 11):
        np.testing.assert_array_equal(jax.jit(call)(jnp.arange(n) + 1.0), 2.0 * (np.arange(n) + 1))
    assert len(traced) == 1
    jax.jit(call)(jnp.ones(1))
    assert len(traced) == 2  # a lone lane has code of its own


def test_code_is_loaded_by_its_name(fresh_process):
    store = MemoryStore()
    double = simd.compile_lane_function(lambda x: 2.0 * x, lambda x: x, "at hand", store)
    jax.jit(double)(jnp.ones(3))
    (name,) = fresh_process.names
    assert not simd.load_saved_machine_code([name, "lanes_code_of_none"], store)
    fresh_process.reset_registry()
    assert not simd.load_saved_machine_code([name], None)
    assert simd.load_saved_machine_code([name], store)
    assert fresh_process.names == [name, name]


def test_the_text_that_llvm_compiles_is_the_same_in_every_process():
    result = """
        import jax, jax.numpy as jnp
        from vrw_jax.simd import code_cache, kernel
        def step(x, table):
            f = lambda k: {name: jnp.sin(k * x[0]) for name in ("beta", "alpha", "gamma")}
            sums = jax.tree.map(lambda y: y + jnp.sum(x * table[:, None], 0), f(2.0) | f(0.5))
            turn = lambda i, z: z + table[i] * sums["beta"]
            return {"loop": jax.lax.fori_loop(0, 9, turn, x[1]), **sums}
        table = jnp.arange(9.0, dtype=jnp.float32)
        shape = jax.ShapeDtypeStruct((9, 1021), jnp.float32)
        closed = code_cache.trace_for_machine_code(lambda x: step(x, table), shape)
        print(kernel.write_llvm_kernel(closed, 8))
    """
    lines = "\n".join(line[8:] for line in result.splitlines())
    method_names = [os.environ | {"PYTHONHASHSEED": seed} for seed in ("1", "2")]
    first, second = (
        subprocess.run(
            [sys.executable, "-c", lines], env=method_name, capture_output=True, check=True
        )
        for method_name in method_names
    )
    assert first.stdout == second.stdout != b""


def test_repeated_operations_along_an_axis_are_emitted_once():
    def sampled(n, x):
        is_alike = jnp.broadcast_to(jnp.sqrt(x), (n, *x.shape))
        turns = lax.scan(lambda y, _: (0.5 * y, y), x, None, length=n)[1]
        return jnp.stack([2.0 * is_alike + 1.0, turns])

    def length(n):
        shape = jax.ShapeDtypeStruct((1021,), jnp.float64)
        closed = code.trace_for_machine_code(lambda x: sampled(n, x), shape)
        return len(kernel.write_llvm_kernel(closed, 8))

    assert length(900) < 1.1 * length(100)

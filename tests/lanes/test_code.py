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
from support.machine_code import CodeRegistrySpy, use_cache_folder

from vrw_jax import lanes
from vrw_jax.lanes import machine_code

X = np.arange(4.0)


@pytest.fixture(autouse=True)
def process(monkeypatch):
    return CodeRegistrySpy(monkeypatch)


@pytest.fixture(autouse=True)
def folder(tmp_path):
    with use_cache_folder(tmp_path):
        yield tmp_path


def multiply(factor):
    """Return multiples of X by machine code of a function that is defined anew."""
    scope = {}
    exec(f"def times(x):\n    return {factor} * x", scope)  # its number is part of the code
    return lanes.compile_batch_function(scope["times"]).run(X).tolist()


def test_a_later_start_neither_traces_nor_compiles(monkeypatch, process):
    assert multiply(2.0) == [0.0, 2.0, 4.0, 6.0]
    monkeypatch.setattr(machine_code, "compile_llvm_for_processor", None)  # would fail
    assert multiply(2.0) == [0.0, 2.0, 4.0, 6.0]
    process.reset_registry()
    assert multiply(2.0) == [0.0, 2.0, 4.0, 6.0]
    assert process.n_traces == 1


@pytest.mark.parametrize("elsewhere", [False, True])
def test_the_same_trace_of_another_function_is_not_compiled(monkeypatch, process, elsewhere):
    multiply("2.0")
    if elsewhere:
        process.reset_registry()
    monkeypatch.setattr(machine_code, "compile_llvm_for_processor", None)  # would fail
    assert multiply("abs(-2.0)") == multiply("float(2)") == [0.0, 2.0, 4.0, 6.0]
    assert process.n_traces == 3


def add_two_programs(x, *functions):
    return sum(lanes.compile_batch_function(function)(x) for function in functions)


def test_other_traces_and_compiler_settings_have_separate_code(monkeypatch, process, folder):
    assert multiply(2.0)[3] == 6.0
    assert multiply(3.0)[3] == 9.0
    monkeypatch.setattr(machine_code, "describe_compiler_settings", lambda: "by another processor")
    assert multiply(2.0)[3] == 6.0
    assert process.n_traces == 3
    for kind in ("code", "index"):
        assert len(list(folder.glob(f"lanes_{kind}_*"))) == 3


def test_tracing_continues_during_compilation_and_receives_its_errors(monkeypatch):
    may, compiled = threading.Event(), machine_code.compile_llvm_for_processor
    monkeypatch.setattr(
        machine_code, "compile_llvm_for_processor", lambda text: may.wait(60) and compiled(text)
    )
    evaluate_both = lambda x: add_two_programs(x, lambda x: 2.5 * x, lambda x: 3.5 * x)
    traced = jax.jit(evaluate_both).trace(X)
    may.set()
    np.testing.assert_array_equal(traced.lower().compile()(X), 6.0 * X)

    def refuse(text):
        raise RuntimeError("no such instruction")

    monkeypatch.setattr(machine_code, "compile_llvm_for_processor", refuse)
    traced = jax.jit(lambda x: add_two_programs(x, lambda x: 4.5 * x, lambda x: x / 7.0)).trace(X)
    with pytest.raises(RuntimeError, match="no such instruction"):
        traced.lower()


def test_an_index_without_its_code_is_compiled_again(process, folder):
    multiply(2.0)
    next(folder.glob("lanes_code_*")).unlink()
    process.reset_registry()
    assert multiply(2.0)[3] == 6.0
    process.reset_registry()
    assert multiply(2.0)[3] == 6.0
    assert process.n_traces == 2


def test_another_batch_is_neither_traced_nor_compiled_again_without_a_store(process):
    with use_cache_folder(None):
        call = lanes.compile_batch_function(lambda x: 2.0 * x)
        for n in (5, 8, 11):
            x = jnp.arange(n) + 1.0
            np.testing.assert_array_equal(jax.jit(call)(x), 2.0 * x)
        assert len(set(process.names)) == 1
        jax.jit(call)(jnp.ones(1))
        assert len(set(process.names)) == 2  # a lone lane has code of its own
        assert process.n_traces == 1


def test_a_function_that_is_mapped_compiles_no_code_for_one_lane(process):
    double = lanes.jit_batch(lambda x: 2.0 * x)
    np.testing.assert_array_equal(jax.vmap(jax.jit(double))(X), 2.0 * X)
    assert (len(process.names), process.n_traces) == (1, 1)
    process.reset_registry()
    np.testing.assert_array_equal(jax.jit(jax.vmap(double))(X), 2.0 * X)
    assert process.n_traces == 1  # the trace of one lane was saved without code
    assert jax.jit(double)(X[1]) == 2.0
    assert len(set(process.names)) == 2


def test_code_is_loaded_by_its_name(process):
    jax.jit(lanes.compile_batch_function(lambda x: 2.0 * x))(jnp.ones(3))
    (name,) = process.names
    assert not lanes.load_saved_machine_code([name, "lanes_code_of_none"])
    process.reset_registry()
    with use_cache_folder(None):
        assert not lanes.load_saved_machine_code([name])
    assert lanes.load_saved_machine_code([name])
    assert process.names == [name, name]


def test_the_text_that_llvm_compiles_is_the_same_in_every_process():
    result = """
        import jax, jax.numpy as jnp
        from vrw_jax.lanes import machine_code
        def step(x, table):
            f = lambda k: {name: jnp.sin(k * x[0]) for name in ("beta", "alpha", "gamma")}
            sums = jax.tree.map(lambda y: y + jnp.sum(x * table[:, None], 0), f(2.0) | f(0.5))
            turn = lambda i, z: z + table[i] * sums["beta"]
            return {"loop": jax.lax.fori_loop(0, 9, turn, x[1]), **sums}
        table = jnp.arange(9.0, dtype=jnp.float32)
        shape = jax.ShapeDtypeStruct((9, 1021), jnp.float32)
        closed, _ = machine_code.trace_for_machine_code(lambda x: step(x, table), shape)
        print(machine_code.write_llvm_kernel(closed, 8))
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
        closed, _ = machine_code.trace_for_machine_code(lambda x: sampled(n, x), shape)
        return len(machine_code.write_llvm_kernel(closed, 8))

    assert length(900) < 1.1 * length(100)

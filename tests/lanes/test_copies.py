"""Loops that reuse memory in place compute what loops with copies compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from vrw_jax.lanes import lowering
from vrw_jax.lanes.array_emitter import LANE_AXIS_SENTINEL, ArrayEmitter
from vrw_jax.lanes.lane_function import CompiledBatchFunction
from vrw_jax.lanes.machine_code import trace_for_machine_code, write_llvm_kernel

N_ARRAYS = 3
N_ROWS = 5

# An operation of a loop's body: kind, arrays it reads, array it replaces, a row.
OPERATIONS = st.tuples(
    st.sampled_from(("update", "swap", "add", "copy", "row", "inner loop")),
    st.integers(0, N_ARRAYS - 1),
    st.integers(0, N_ARRAYS - 1),
    st.integers(0, N_ROWS - 1),
)


def apply_operation(arrays, operation, index):
    """Return the arrays after one operation; `index` is the iteration."""
    kind, source, target, row = operation
    arrays = list(arrays)
    if kind == "update":
        position = jnp.minimum(index + row, N_ROWS - 1)
        arrays[target] = lax.dynamic_update_index_in_dim(
            arrays[target], arrays[source][row] * 0.5, position, 0
        )
    elif kind == "swap":
        arrays[source], arrays[target] = arrays[target], arrays[source]
    elif kind == "add":
        arrays[target] = arrays[target] + 0.25 * arrays[source]
    elif kind == "copy":
        arrays[target] = arrays[source]
    elif kind == "row":
        read = lax.dynamic_index_in_dim(
            arrays[source], jnp.minimum(2 * index + row, N_ROWS - 1), 0, False
        )
        arrays[target] = lax.dynamic_update_index_in_dim(arrays[target], read, row, 0)
    else:
        body = lambda i, x: lax.dynamic_update_index_in_dim(x, x[row] + arrays[source][0], i, 0)
        arrays[target] = lax.fori_loop(0, 2, body, arrays[target])
    return tuple(arrays)


def make_program(operations, reads_again):
    """Return a function of one array: two loops over the operations, the second from the results
    of the first, which are read again after it if `reads_again`.
    """

    def body(carry, index):
        for operation in operations:
            carry = apply_operation(carry, operation, index)
        return carry, carry[0][0]

    def program(x):
        start = tuple(x * (i + 1) for i in range(N_ARRAYS))
        first, first_rows = lax.scan(body, start, jnp.arange(4))
        second, second_rows = lax.scan(body, first, jnp.arange(3))
        results = jnp.concatenate([*second, first_rows, second_rows])
        return results + (first[0][0] + first[1][1] if reads_again else 0.0)

    return program


def keep_arrays_in_memory(patch):
    """Leave almost no room in registers."""
    patch.setattr(ArrayEmitter, "MAX_UNROLLED_REDUCTION_TERMS", 1)
    for limit in ("MAX_REGISTER_ENTRIES", "MAX_INNERMOST_REGISTER_ENTRIES"):
        patch.setattr(ArrayEmitter, limit, 2)


def run_as_machine_code(program, x, forces_copies):
    """Return the results; without room in registers, so that arrays are in memory."""
    with pytest.MonkeyPatch.context() as patch:
        if forces_copies:
            find_last_uses = lowering._find_overwriting_equations
            patch.setattr(
                lowering,
                "_find_overwriting_equations",
                lambda jaxpr: dict.fromkeys(find_last_uses(jaxpr)),
            )
        keep_arrays_in_memory(patch)
        # Without a key, both programs are compiled.
        run = CompiledBatchFunction(program, 1, max_unrolled_entries=1, key=None)
        return np.asarray(jax.jit(run)(x))


@settings(max_examples=12, deadline=None)
@given(st.lists(OPERATIONS, min_size=1, max_size=4), st.booleans())
def test_loops_in_place_compute_what_loops_with_copies_compute(operations, reads_again):
    program = make_program(operations, reads_again)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(N_ROWS, 8)))
    in_place = run_as_machine_code(program, x, forces_copies=False)
    np.testing.assert_array_equal(in_place, run_as_machine_code(program, x, forces_copies=True))
    # Reference: XLA, to the rounding of fused products.
    np.testing.assert_allclose(in_place, jax.jit(program)(x), rtol=1e-12, atol=1e-12)


def test_a_loop_that_updates_an_array_allocates_it_once(monkeypatch):
    double_row = lambda i, y: lax.dynamic_update_index_in_dim(y, 2.0 * y[i], i, 0)
    program = lambda x: lax.fori_loop(0, N_ROWS, double_row, 3.0 * x)
    shape = jax.ShapeDtypeStruct((N_ROWS, LANE_AXIS_SENTINEL), np.float64)
    keep_arrays_in_memory(monkeypatch)
    text = write_llvm_kernel(trace_for_machine_code(program, shape)[0], 4, max_unrolled_entries=1)
    assert text.count(f"alloca <4 x double>, i64 {N_ROWS}") == 1

"""Unsupported operations raise one sentence that names them, and are never compiled wrongly."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vrw_jax import lanes
from vrw_jax.lanes.array_emitter import LANE_AXIS_SENTINEL

X = np.random.default_rng(0).normal(size=(2, 9))


def call_program(function, *arrays):
    """Return the results of a function as machine code."""
    run = lanes.compile_batch_function(function)
    return jax.jit(run)(*map(jnp.asarray, arrays))


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (lambda x: jnp.cumsum(x, 1), "cumsum moves, joins or selects lanes"),
        (lambda x: x[:, :1] + x, "slice moves, joins or selects lanes"),
        (lambda x: lax.pad(x, 0.0, [(0, 0, 0), (1, 1, 0)])[:, 1:-1], "pad moves, joins or selects"),
        (lambda x: x - jnp.max(x, 1)[:, None], "reduce_max moves, joins or selects lanes"),
        (lambda x: jnp.sum(x.astype(int)) | x.astype(int), "reduce_sum moves, joins or selects"),
        (lambda x: lax.reduce_or(x.astype(int), (1,))[0] | x.astype(int), "reduce_or moves"),
        (lambda x: lax.dynamic_update_slice(x, jnp.ones((2, 3)), (0, 3)), "dynamic_update_slice m"),
        (
            lambda x: lax.concatenate([jnp.ones((2, 0)), x], 1),
            "concatenate moves, joins or selects",
        ),
        (lambda x: x + (x[0] @ x[1]), "dot_general moves, joins or selects lanes"),
        (lambda x: jnp.ones(3), "A result has the shape float64.3., the same for all lanes"),
    ],
)
def test_operations_across_lanes_are_refused(function, sentence):
    with pytest.raises(NotImplementedError, match=sentence):
        call_program(function, X)


def test_xla_computes_functions_whose_arrays_exceed_the_stack():
    halve = lambda x: lax.scan(lambda c, _: (0.5 * c, c), x, None, length=300_000)[1]
    function = lanes.jit(halve)
    with pytest.warns(UserWarning, match="do not fit on the stack: return fewer numbers"):
        batch = function.batch(np.array([1.0, 2.0]))
    np.testing.assert_array_equal(batch[:, 3], [0.125, 0.25])
    np.testing.assert_array_equal(function(1.0)[:4], [1.0, 0.5, 0.25, 0.125])


@pytest.mark.parametrize(
    ("function", "sentence"),
    [
        (lambda x: jnp.sort(x, 0), "sort has no machine code: write it by primitives that"),
        (lambda x: lax.pad(x, 0.0, [(-1, 0, 0), (0, 0, 0)]), "pad takes entries away"),
        (lambda x: (x + 1j).real, "complex128.* convert them to one of bool, int32"),
        (lambda x: x.astype(int) // 3 + lax.div(x.astype(int), 2), "div of int64 has no machine"),
    ],
)
def test_xla_computes_operations_without_machine_code_and_one_warning_names_them(
    function, sentence, recwarn
):
    for _ in range(2):
        np.testing.assert_array_equal(call_program(function, X), function(X))
        np.testing.assert_array_equal(lanes.compile_batch_function(function).run(X), function(X))
    assert len(recwarn) == 1
    assert re.search(sentence, str(recwarn[0].message))


@pytest.mark.parametrize(
    ("function", "what"),
    [
        (lambda x: x + jnp.asarray(np.zeros(LANE_AXIS_SENTINEL))[0], "A constant"),
        (lambda x: x + jnp.sum(jnp.asarray(np.zeros((LANE_AXIS_SENTINEL, 3)))), "A constant"),
        (lambda x: x + jnp.sum(lax.iota(float, LANE_AXIS_SENTINEL)), "The result of iota"),
        (lambda x: x + jnp.sum(lax.broadcasted_iota(float, (LANE_AXIS_SENTINEL, 2), 1)),
         "The result of iota"),
        (lambda x: x + jnp.sum(lax.iota(float, LANE_AXIS_SENTINEL + 1)[1:]), "The result of slice"),
        (lambda x: x + lax.iota(float, 2 * LANE_AXIS_SENTINEL).reshape(2, -1),
         "The result of reshape"),
        (lambda x: x + lax.iota(float, 2 * LANE_AXIS_SENTINEL).reshape(-1, 2)[0, 0],
         "The result of reshape"),
        (lambda x: x + jnp.pad(lax.iota(float, LANE_AXIS_SENTINEL - 1), (0, 1))[0],
         "The result of pad"),
        (lambda x: x + jnp.concatenate([lax.iota(float, 1000), lax.iota(float, 21)]),
         "The result of concatenate"),
        (lambda x: jnp.concatenate([jnp.repeat(x[:1], 1000, 0), jnp.repeat(x[:1], 21, 0)])[:2],
         "The result of .*"),
        (lambda x: jnp.broadcast_to(x[:, None], (2, LANE_AXIS_SENTINEL, x.shape[-1])).sum(1),
         "The result of broadcast_in_dim"),
        (lambda x: jnp.stack([x, x], -1)[..., 0], "The result of .*"),
        (lambda x: x.T.reshape(x.shape), "The result of transpose"),
    ],
)  # fmt: skip
def test_an_axis_as_long_as_the_lane_axis_is_refused_at_its_origin(function, what):
    with pytest.raises(NotImplementedError, match=rf"{what} has the shape .*{LANE_AXIS_SENTINEL}"):
        call_program(function, X)


def test_arguments_have_one_axis_of_lanes():
    with pytest.raises(NotImplementedError, match=r"An argument has .* float64\[1021,1021\]"):
        call_program(lambda x: x[0] + x[1], np.zeros((LANE_AXIS_SENTINEL, 9)))
    with pytest.raises(ValueError, match=r"shape \(3,\), but the first one has 9 lanes"):
        call_program(lambda x, table: x * table[0], X, np.zeros(3))


def test_loops_over_lanes_are_refused_but_may_run_as_often():
    evaluate_along = lambda x: x + lax.scan(lambda total, y: (total + y, None), 0.0, x[0])[0]
    with pytest.raises(NotImplementedError, match="scan reads or writes along an axis of 1021"):
        call_program(evaluate_along, X)
    compute_written = lambda x: (
        x + lax.scan(lambda k, _: (k + 1.0, k), 0.0, None, length=LANE_AXIS_SENTINEL)[1][0]
    )
    with pytest.raises(NotImplementedError, match="scan reads or writes along an axis of 1021"):
        call_program(compute_written, X)
    often = lambda x: lax.fori_loop(0, LANE_AXIS_SENTINEL, lambda i, y: y + 1.0, x)
    np.testing.assert_allclose(call_program(often, X), X + LANE_AXIS_SENTINEL, rtol=1e-12)


def test_a_uniform_number_is_broadcast_to_all_lanes():
    """As many as lanes, and nothing to tell them from: what is broadcast is no misreading."""
    result = call_program(lambda x: jnp.full(x.shape[-1], 2.0) * x + jnp.ones_like(x), X)
    np.testing.assert_array_equal(result, 2.0 * X + 1.0)


def test_vmap_and_derivatives_of_calls_are_refused():
    double = lanes.compile_batch_function(lambda x: 2.0 * x)
    with pytest.raises(NotImplementedError, match="vmap"):
        jax.vmap(double)(jnp.asarray(X))
    with pytest.raises(NotImplementedError, match="nor differentiated"):
        jax.grad(lambda x: double(x).sum())(jnp.asarray(X[0]))

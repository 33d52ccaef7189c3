"""`lanes.jit` of a function of one lane computes what `jax.vmap` computes, in every transform."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support.machine_code import CodeRegistrySpy, disable_machine_code, use_cache_folder

from vrw_jax import lanes
from vrw_jax.lanes import machine_code

N = 21  # no multiple of the lanes in a group
GENERATOR = np.random.default_rng(0)
X, K = GENERATOR.normal(size=(N, 3)), GENERATOR.integers(0, 3, N)
A = GENERATOR.normal(size=(N, 3, 4))


def halve_until_small(x, k):
    """A loop that each lane ends for itself, with a counter that all lanes share until then."""
    state = lax.while_loop(
        lambda s: jnp.any(jnp.abs(s[1]) > 0.1), lambda s: (s[0] + 1, 0.5 * s[1]), (0, x)
    )
    return {"count": state[0] + k, "x": state[1]}


def sum_by_scan(x, k):
    weights = jnp.arange(5.0)

    def add(carry, weight):
        total, i = carry
        return (total + weight * x[i % 3], i + 1), total

    (total, i), partial_sums = lax.scan(add, (0.0 * x[0], 0), weights)
    return total, i, partial_sums[::-1]


def add_tangents_of_which_lanes_share_one(x, k):
    return jax.jvp(lambda y, c: y * c, (x[0], 2.0), (1.0, x[1]))


def choose(x, k):
    branches = [lambda y: y, lambda y: -2.0 * y, lambda y: jnp.cumsum(y)]
    return lax.switch(k, branches, x), lax.cond(x[0] > x[1], lambda: x[2], lambda: 0.0)


def index_by_lane(x, k):
    row = lax.dynamic_index_in_dim(x, k, keepdims=False)
    part = lax.dynamic_slice(jnp.concatenate([x, x]), (k,), (2,))
    changed = lax.dynamic_update_slice(jnp.zeros(6), part, (k + 1,))
    return row, part, changed.at[2].set(1.0), jnp.zeros(4).at[3].add(row)


def move_entries(x, k):
    table = jnp.outer(x, x)[None]
    return (
        table.transpose(2, 0, 1)[:2, 0].reshape(-1),
        jnp.pad(x, (1, 2)),
        jnp.stack(jnp.split(jnp.concatenate([x, 2.0 * x]), 2)),
        jnp.where(k > 1, x.max(), x.min()) + table.sum((0, 2)),
        jnp.broadcast_to(x, (2, 3)) @ table[0],
    )


def loop_uniformly(x, k):
    """A loop whose length all lanes share reads an array by its counter."""
    return lax.fori_loop(0, 3, lambda i, y: y + x[i] * jnp.sin(y), 0.1 * x[0])


def loop_within_loops(x, k):
    inner = lambda i, y: lax.while_loop(lambda z: z > i, lambda z: 0.7 * z - 0.01, y + 3.0)
    return lax.fori_loop(0, k, inner, x[0])


def return_constants(x, k):
    return jnp.float64(2.0), jnp.arange(3), x > 0.0, None


def call_elementary_functions(x, k):
    y = jnp.stack([x, 1e-9 * x, -x]) + 1e-12 * k
    positive = jnp.abs(y) + 1e-3
    return (
        [f(y) for f in (jnp.tan, jnp.tanh, jnp.sinh, jnp.cosh, jnp.expm1, jnp.cbrt)],
        [f(y) for f in (jnp.sign, jnp.ceil, jax.nn.sigmoid)],
        [jnp.log1p(positive), lax.rsqrt(positive), positive**x, y**2.0, y**-3.0, 0.0 * y**0.0],
        jnp.clip(y, -0.3, 0.2 * x),
    )


def index_by_arrays(x, k):
    y = jnp.concatenate([x, 2.0 * x])
    table = y.reshape(2, 3)
    return (
        (y[jnp.array([4, 0])], table[:, jnp.array([2, 1, 1])], y[k], table[k % 1]),
        (y.at[1].set(7.0), y.at[jnp.array([0, 0, 5])].add(x), table.at[1, :2].multiply(3.0)),
        (jnp.argmax(y), jnp.argmin(table, axis=1), y[::-1]),
        jnp.select([k == 0, k == 1, k == 2], [x[0], x[1], x[2]], -1.0),
    )


def divide_with_remainder(x, k):
    divisors = jnp.stack([k - 1, -k, 3 + k])  # 0 and -1 among them
    floats = jnp.stack([x, 1e6 * x, x - x]) % jnp.stack([0.3 * x, -0.7 * x, x])
    return lax.rem(7 * k - 9, divisors), k % divisors, floats, jnp.fmod(x, 0.2)


FUNCTIONS = (
    call_elementary_functions,
    divide_with_remainder,
    index_by_arrays,
    halve_until_small,
    sum_by_scan,
    add_tangents_of_which_lanes_share_one,
    choose,
    index_by_lane,
    move_entries,
    loop_uniformly,
    loop_within_loops,
    return_constants,
)


def assert_equal_trees(actual, expected, tolerance=1e-13):
    """Compare trees; sums of a few numbers of size one are rounded in another order."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_batches_agree_with_vmap(function):
    compiled, expected = lanes.jit(function), jax.vmap(function)(X, K)
    batch = compiled.batch(X, K)
    assert_equal_trees(batch, expected)
    assert_equal_trees(jax.jit(jax.vmap(compiled))(X, K), expected)
    # The results of a lane are bitwise the same in any batch.
    assert_equal_trees(jax.tree.map(lambda x: x[5], batch), compiled(X[5], K[5]), 0.0)
    assert_equal_trees(compiled.batch(X[3:8], K[3:8]), jax.tree.map(lambda x: x[3:8], batch), 0.0)


def energy(x, law):
    """A number whose derivatives go through a loop of unknown length."""
    y, _ = lax.while_loop(
        lambda s: s[1] < 4, lambda s: (s[0] + law["k"] * jnp.sin(s[0]), s[1] + 1), (x, 0)
    )
    return jnp.sum(y**2) + law["c"] * x[0] * x[1]


LAW = {"k": jnp.asarray(0.3), "c": jnp.asarray(2.0)}


def unroll(x, law):
    """Return `energy` without a loop, so that JAX differentiates it in every mode."""
    y = x
    for _ in range(4):
        y = y + law["k"] * jnp.sin(y)
    return jnp.sum(y**2) + law["c"] * x[0] * x[1]


@pytest.mark.parametrize(
    "transform",
    [
        jax.grad,
        jax.jacfwd,
        jax.jacrev,
        jax.hessian,
        lambda f: jax.jit(jax.grad(f, (0, 1))),
        lambda f: jax.jacrev(jax.jacfwd(f), argnums=1),
        lambda f: lambda x, law: jax.jvp(lambda s: f(s * x, law), (1.0,), (2.0,)),
        lambda f: lambda x, law: jax.vmap(jax.grad(f), (0, None))(jnp.stack([x, 2.0 * x]), law),
    ],
)
def test_derivatives_of_every_mode_agree_with_an_unrolled_loop(transform):
    actual = transform(lanes.jit(energy))(jnp.asarray(X[0]), LAW)
    assert_equal_trees(actual, transform(unroll)(jnp.asarray(X[0]), LAW))


def test_a_separate_function_is_compiled_once_for_all_calls_and_columns(monkeypatch, tmp_path):
    matrix, texts, write = GENERATOR.normal(size=(9, 9)), [], machine_code.write_llvm_kernel
    monkeypatch.setattr(
        machine_code, "write_llvm_kernel", lambda *a: texts.append(write(*a)) or texts[-1]
    )
    multiply = lanes.mark_noinline(lambda x: matrix @ x)
    multiply_thrice = lanes.jit(lambda x: multiply(multiply(multiply(x))))
    x = GENERATOR.normal(size=(N, 9))
    # Nine columns, and thus an incomplete last round; three sums of nine products each.
    with use_cache_folder(tmp_path):
        columns = jax.vmap(jax.jacfwd(multiply_thrice))(jnp.asarray(x))
        images = multiply_thrice.batch(x)
    cube = np.linalg.matrix_power(matrix, 3)
    np.testing.assert_allclose(columns, np.broadcast_to(cube, (N, 9, 9)), atol=1e-12)
    np.testing.assert_allclose(images, x @ cube.T, atol=1e-12)
    # The first call has columns of unit vectors, which are the same for all lanes.
    assert [text.count("define internal") for text in texts] == [2, 1]


def test_other_numbers_in_closures_trace_nothing_anew(monkeypatch, tmp_path):
    class Law(eqx.Module):
        stiffness: float
        table: np.ndarray

        def force(self, x):
            return self.stiffness * x + self.table[1]

    def make(stiffness, shift):
        law = Law(stiffness, np.array([0.0, shift]))
        inner = lambda x: law.force(x) + shift
        return lambda x: inner(x) * stiffness

    with use_cache_folder(tmp_path):
        spy = CodeRegistrySpy(monkeypatch)
        for stiffness, shift in ((2.0, 1.0), (3.0, -1.0), (4.0, 0.5)):
            compiled = lanes.jit(make(stiffness, shift))
            expected = stiffness * (stiffness * X + 2.0 * shift)
            np.testing.assert_allclose(compiled.batch(X), expected, rtol=1e-14, atol=1e-14)
        assert spy.n_traces == 1
    # Derivatives with respect to a number of the closure.
    slope = jax.grad(lambda k: lanes.jit(make(k, 1.0))(0.5))(2.0)
    assert slope == pytest.approx(2.0 * 2.0 * 0.5 + 2.0, rel=1e-14)


@pytest.mark.parametrize(
    "make",
    [
        lambda power: lambda x: x**2 if power > 1.5 else x * float(power),
        lambda power: lambda x: {2.0: x**2}.get(power, x * power),
        lambda power: lambda x: x**2 if power.as_integer_ratio() == (2, 1) else x * power,
    ],
    ids=["value", "hash", "method"],
)
def test_a_number_that_python_needs_is_part_of_the_code(make):
    for power in (2.0, 1.0, 0.5):
        np.testing.assert_array_equal(
            lanes.jit(make(power)).batch(X), X**2 if power > 1.5 else X * power
        )


def test_static_and_shared_arguments():
    def evaluate(x, table, kind, scale):
        return scale * (x @ table if kind == "product" else x[0] + table.sum())

    table, compiled = np.arange(12.0).reshape(3, 4), lanes.jit(evaluate)
    np.testing.assert_allclose(
        compiled.batch(X, table, "product", 2.0, in_axes=(0, None, None, None)), 2.0 * X @ table
    )
    np.testing.assert_allclose(
        compiled.batch(X, A, "product", 1.0, in_axes=(0, 0, None, None)),
        np.einsum("ni,nij->nj", X, A),
        rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    np.testing.assert_allclose(compiled(X[1], table, "sum", 1.0), X[1, 0] + 66.0)


@pytest.mark.parametrize("n", [8, 13])
def test_arrays_in_any_memory_order_are_read_alike(n):
    x = GENERATOR.normal(size=(n, 5))
    compiled = lanes.compile_batch_function(lambda x: x[1:] - 2.0 * x[:-1])
    expected = x.T[1:] - 2.0 * x.T[:-1]
    for ordered in (x.T, np.ascontiguousarray(x.T), np.repeat(x, 2, 0)[::2].T):
        np.testing.assert_array_equal(compiled.run(ordered), expected)


def test_results_without_entries_are_returned_beside_others():
    function = lanes.jit(lambda x: (x[:0], 2.0 * x))
    for empty, double in (function(np.ones(3)), function.batch(np.ones((5, 3)))):
        assert empty.shape == (*double.shape[:-1], 0)
        assert (double == 2.0).all()


def test_loops_read_and_write_arrays_without_entries():
    def double_rows(x):
        rows = jnp.broadcast_to(x, (3, 2)), jnp.broadcast_to(x, (3, 0))
        return lax.map(lambda row: (2.0 * row[0], 2.0 * row[1]), rows)

    full, empty = lanes.jit(double_rows).batch(np.arange(5.0))
    np.testing.assert_array_equal(full, np.broadcast_to(2.0 * np.arange(5.0), (2, 3, 5)).T)
    assert empty.shape == (5, 3, 0)


def test_batches_of_different_lengths_are_refused_in_one_sentence():
    compiled = lanes.jit(lambda x, y: x + y)
    with pytest.raises(ValueError, match=r"lengths \[3, 4\]: give 0 or None for each argument"):
        compiled.batch(np.ones(3), np.ones(4))
    assert compiled.batch(np.ones((0, 2)), np.ones((0, 2))).shape == (0, 2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_number_format_is_that_of_the_arguments(dtype):
    result = lanes.jit(lambda x: jnp.sin(2.0 * x) + 1).batch(X.astype(dtype))
    assert result.dtype == dtype
    np.testing.assert_allclose(result, np.sin(2.0 * X) + 1.0, atol=4.0 * np.finfo(dtype).eps)


def test_xla_computes_where_a_primitive_has_no_machine_code():
    """A sort is missing; one warning names it."""
    compiled = lanes.jit(lambda x: jnp.sort(x) * 2.0)
    with pytest.warns(UserWarning, match=r"XLA computes .*<lambda>.*: sort has no rule") as caught:
        first = compiled.batch(X)
    for _ in range(2):
        np.testing.assert_array_equal(first, compiled.batch(X))
    np.testing.assert_array_equal(first, 2.0 * np.sort(X))
    assert len(caught) == 1


def test_xla_computes_without_machine_code(monkeypatch):
    expected = lanes.jit(halve_until_small).batch(X, K)
    disable_machine_code(monkeypatch)
    compiled = lanes.jit(halve_until_small, xla_block_size=8)
    assert_equal_trees(compiled.batch(X, K), expected)
    assert_equal_trees(compiled(X[0], K[0]), jax.tree.map(lambda x: x[0], expected))


def test_indices_out_of_range_and_powers_of_special_values_agree_with_jax():
    indices = np.array([-7, 0, 2, 5])
    fill_integer = lanes.jit(lambda i: jnp.arange(3).at[i].get(mode="fill"))
    expected = jnp.arange(3).at[indices].get(mode="fill")
    np.testing.assert_array_equal(fill_integer.batch(indices), expected)
    bases, exponents = map(
        np.ravel, np.meshgrid([0.0, 1.0, 2.0, -2.0, np.nan], [0.0, 2.0, -1.0, np.nan])
    )
    powers = lanes.jit(lambda x, y: jnp.power(x, y)).batch(bases, exponents)
    np.testing.assert_allclose(powers, jnp.power(bases, exponents), rtol=1e-15)  # one rounding


def test_inverse_functions_agree_with_those_of_numpy_to_round_off():
    large = np.array([0.0, 1e-300, 1e-9, 0.3, 0.9, 1.0, 1.7, 40.0, 1e200, np.inf])
    small = np.concatenate([-large[large <= 1.0], large[large <= 1.0], [0.99999999, np.nan]])
    y, x = map(
        np.ravel, np.meshgrid(np.concatenate([-large[1:], large]), [-np.inf, -2.0, 0.0, 3.0])
    )
    cases = [(jnp.arctan2, (y, x)), (jnp.arctan, (y,)), (jnp.arcsinh, (y,))]
    cases += [(f, (small,)) for f in (jnp.arcsin, jnp.arccos, jnp.arctanh)]
    cases += [(jnp.arccosh, (1.0 + large,))]
    for function, arguments in cases:
        values = lanes.jit(lambda *x, f=function: f(*x)).batch(*arguments)
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = getattr(np, function.__name__)(*arguments)
        # a few rounding errors
        np.testing.assert_allclose(values, expected, rtol=2e-15, atol=1e-300, err_msg=str(function))
    np.testing.assert_allclose(
        jax.vmap(jax.grad(lanes.jit(jnp.arctan)))(np.array([0.3, -2.0])),
        1.0 / (1.0 + np.array([0.09, 4.0])),
        rtol=1e-15,
    )


EDGES = [0.0, 1e-30, 1e-8, 1e-3, 0.3, 0.5, 1.0, 1.5, 2.0, 80.0, 87.5, 100.0, 1e5, 1e30, np.inf]
EDGE_FUNCTIONS = (
    np.exp, np.log, np.expm1, np.log1p, np.tanh, np.sinh, np.cosh, np.arcsin, np.arccos,
    np.arctan, np.arcsinh, np.arccosh, np.arctanh, np.cbrt, np.sign,
)  # fmt: skip


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_functions_are_those_of_numpy_at_edges_of_their_domain(dtype):
    x = np.array([*EDGES, *(-x for x in EDGES), np.nan], dtype)
    y, z = map(np.ravel, np.meshgrid(x, np.array([-np.inf, -1.0, -0.0, 0.0, 1.0, np.nan], dtype)))
    cases = [(function, (x,)) for function in EDGE_FUNCTIONS]
    power = lambda x: x ** dtype(1.5)
    cases += [(power, (x,)), (np.arctan2, (y, z))]
    for function, arguments in cases:
        compute = getattr(jnp, getattr(function, "__name__", ""), function)
        values = lanes.jit(lambda *x, f=compute: f(*x)).batch(*arguments)
        assert values.dtype == dtype
        with np.errstate(all="ignore"):
            expected = function(*(np.asarray(x, float) for x in arguments)).astype(dtype)
        # A few rounding errors; of a power, those of its logarithm, which is at most 104 here.
        # Results below the smallest normal number may be zero.
        rtol = (104 if function is power else 8) * np.finfo(dtype).eps
        tiny = np.finfo(dtype).tiny
        np.testing.assert_allclose(values, expected, rtol=rtol, atol=tiny, err_msg=str(function))


def test_nan_is_an_extreme_entry_and_no_entries_have_a_sum():
    y = jnp.array([1.0, np.nan, 3.0, np.nan])
    assert lanes.jit(lambda y: (jnp.argmax(y), jnp.argmin(y)))(y) == (1, 1)
    reduce = lambda y: (jnp.sum(y[:0]), jnp.max(y[:0], initial=-1.0), jnp.all(y[:0] > 0.0))
    assert lanes.jit(reduce)(y) == (0.0, -1.0, True)


@pytest.mark.parametrize("has_machine_code", [True, False])
def test_an_empty_batch_traces_a_function_once(has_machine_code, capsys, monkeypatch, tmp_path):
    if not has_machine_code:
        disable_machine_code(monkeypatch)

    def double(x):
        print("traced")
        return 2.0 * x

    with use_cache_folder(tmp_path):
        for _ in range(3):
            compiled = lanes.compile_batch_function(double)
            assert compiled.run(np.ones((2, 0), np.float32)).dtype == np.float32
    assert capsys.readouterr().out.count("traced") == 1


def test_arguments_may_contain_none():
    add = lanes.jit(lambda tree, y: tree["a"] + y.sum())
    np.testing.assert_allclose(add.batch({"a": X[:, 0], "b": None}, X), X[:, 0] + X.sum(1))


@pytest.mark.parametrize(
    ("subscripts", "first", "second"),
    [
        ("ij,jk->ik", (9, 11), (11, 7)),  # more entries than are unrolled
        ("ijk,jkl->il", (3, 4, 5), (4, 5, 2)),
        ("bij,bjk->bik", (3, 2, 4), (3, 4, 2)),
        ("ij,jk->ik", (2, 0), (0, 3)),
    ],
)
def test_products_of_arrays_agree_with_numpy(subscripts, first, second):
    random = np.random.default_rng(0)
    a, b = random.normal(size=(5, *first)), random.normal(size=(5, *second))
    products = lanes.jit(lambda a, b: jnp.einsum(subscripts, a, b)).batch(a, b)
    expected = [np.einsum(subscripts, *pair) for pair in zip(a, b, strict=True)]
    # Sums of at most 20 products of numbers of size 1, in another order.
    np.testing.assert_allclose(products, expected, rtol=1e-12, atol=1e-14)

"""Machine code for lanes computes what JAX computes with the same function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from support.machine_code import CodeRegistrySpy, use_cache_folder
from support.slow_variants import mark_slow

from vrw_jax.lanes import compile_batch_function, machine_code, mark_noinline, program
from vrw_jax.lanes.lowering import PRIMITIVE_RULES
from vrw_jax.lanes.value_emitter import ELEMENTWISE_RULES

RANDOM_GENERATOR = np.random.default_rng(0)


def make_program(function, lanes, uniform=()):
    """Return `function(uniform, lanes)` as machine code."""
    return compile_batch_function(function).run


def run_both_backends(function, lanes, uniform=()):
    """Return the results as machine code and by JAX, for each array."""
    uniform = [np.asarray(x, lanes[0].dtype) for x in uniform]
    compiled = make_program(function, lanes, uniform)(uniform, lanes)
    expected = function(uniform, [jnp.asarray(x) for x in lanes])
    return list(zip(compiled, map(np.asarray, expected), strict=True))


def evaluate_arithmetic(uniform, lanes):
    (a,), (x, y) = uniform, lanes
    count = jnp.where(x > y, 3, 1).astype(jnp.int32)
    return (
        a * x + y / (1.0 + x * x) - x**3 + y**-2,
        jnp.maximum(x, y) - jnp.minimum(x, 0.5) + jnp.abs(y) + jnp.sqrt(jnp.abs(x)),
        jnp.sin(x) * jnp.cos(y) - jnp.floor(x) + jnp.clip(y, -0.3, 0.2),
        jnp.where((x < y) & ~(y >= 0.5) | jnp.isfinite(x) & (x != y), x, -y),
        (count << 2) | 1,
        (count >> 1) & 1 == 1,
        x.astype(jnp.float32) * 2.0 + count,
        x >= y,
    )


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_elementwise_code_agrees_with_jax(dtype):
    lanes = [RANDOM_GENERATOR.normal(size=1003).astype(dtype) for _ in range(2)]
    # Products and sums are rounded once where JAX may round twice; y^-2 magnifies that.
    close = 40.0 * np.finfo(dtype).eps
    for solution, expected in run_both_backends(evaluate_arithmetic, lanes, (0.7,)):
        assert solution.dtype == expected.dtype
        if solution.dtype.kind == "f":
            np.testing.assert_allclose(solution, expected, rtol=close, atol=close)
        else:
            np.testing.assert_array_equal(solution, expected)


def test_nan_propagates_and_compares_as_in_jax():
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0])
    x, y = (grid.ravel() for grid in np.meshgrid(odd, odd))

    def compare(_, lanes):
        x, y = lanes
        return (
            jnp.maximum(x, y), jnp.minimum(x, y), x < y, x >= y, x == y, x != y, jnp.isfinite(x),
            jnp.where(x > y, 1.0, 2.0),
        )  # fmt: skip

    for solution, expected in run_both_backends(compare, [x, y]):
        np.testing.assert_array_equal(solution, expected)


def test_powers_of_step_size_control_have_the_stated_accuracy():
    x = np.geomspace(1e-20, 1e20, 10_001).astype(np.float32)
    powers = lambda _, lanes: (jnp.log(lanes[0]), jnp.exp(0.9 * jnp.log(lanes[0]) / 10.0))
    (log, exact), (power, _) = run_both_backends(powers, [x])
    np.testing.assert_allclose(log, exact, atol=1e-5 + 1e-6 * 46)
    np.testing.assert_allclose(power, np.exp(0.09 * np.log(x.astype(float))), rtol=1e-5)


def count_collatz_steps(_, lanes):
    """Return the number of steps to 1, which differs between lanes."""
    start = lanes[0].astype(jnp.int32)

    def turn(state):
        number, count = state
        halved = jnp.where(number & 1 == 1, 3 * number + 1, number >> 1)
        is_active = number != 1
        return jnp.where(is_active, halved, number), count + is_active

    return lax.while_loop(lambda s: jnp.any(s[0] != 1), turn, (start, jnp.zeros_like(start)))[1:]


def test_loops_end_per_lane_and_groups_are_independent():
    start = np.arange(1.0, 1001.0)
    ((solution, expected),) = run_both_backends(count_collatz_steps, [start])
    np.testing.assert_array_equal(solution, expected)
    assert solution[26] == 111  # of 27, the known one


def test_scans_run_over_their_constants():
    def horner(_, lanes):
        coefficients = jnp.asarray([1.0, -2.0, 0.5, 3.0])
        start = jnp.zeros_like(lanes[0])
        return (lax.scan(lambda p, c: (p * lanes[0] + c, None), start, coefficients)[0],)

    ((solution, expected),) = run_both_backends(horner, [RANDOM_GENERATOR.normal(size=17)])
    np.testing.assert_allclose(solution, expected, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 5_003])
def test_a_lane_gives_the_same_bits_in_any_batch_and_on_any_number_of_cores(monkeypatch, n):
    lanes = [RANDOM_GENERATOR.normal(size=5_003) for _ in range(2)]
    run = make_program(evaluate_arithmetic, lanes, [np.float64(0.7)])
    monkeypatch.setattr(program, "count_available_cores", lambda: 1)
    results_of_all_lanes = run([np.float64(0.7)], lanes)
    monkeypatch.setattr(program, "count_available_cores", lambda: 3)
    selection = RANDOM_GENERATOR.permutation(5_003)[:n]
    for part, all_ in zip(
        run([np.float64(0.7)], [x[selection] for x in lanes]), results_of_all_lanes, strict=True
    ):
        np.testing.assert_array_equal(part, all_[selection])


@pytest.mark.parametrize("few_first", [True, False])
def test_few_lanes_have_smaller_code_with_the_same_bits_unless_more_ran_before(
    monkeypatch, few_first
):
    CodeRegistrySpy(monkeypatch)
    with use_cache_folder(None):
        lanes = [RANDOM_GENERATOR.normal(size=20) for _ in range(2)]
        run = make_program(evaluate_arithmetic, lanes)
        counts = (3, 20, 4) if few_first else (20, 3, 4)
        results = [run([np.float64(0.7)], [x[:n] for x in lanes]) for n in counts]
        assert len(machine_code._lane_program_by_index_name) == 1 + few_first
    for others in results[1:]:
        for first, other in zip(results[0], others, strict=True):
            n = min(len(first), len(other))
            np.testing.assert_array_equal(first[..., :n], other[..., :n])


def use_arrays_in_loops(x):
    """Use small and large arrays, change axes, slice, join, sum, and carry and stack in loops."""
    table = np.sin(np.arange(240.0)).reshape(12, 20)
    large = jnp.tensordot(jnp.asarray(table, x.dtype), x, 1)  # (12, 3, lanes)
    shifted = jnp.concatenate([large[1::2], large[:6] * 2.0, x[:7]]).swapaxes(
        0, 1
    )  # (3, 19, lanes)
    flat = lax.optimization_barrier(shifted).reshape(57, -1)[2:50]
    first, *_, last = jnp.unstack(shifted[:, :4], axis=1)

    def turn(carry, given):
        total, observed_values_2 = carry
        row, weight = given
        total = total + weight * row.reshape(4, 3, -1)[:, 1]
        return (total, observed_values_2 * 0.5 + jnp.sum(row, 0)), jnp.stack(
            [total, total * row[:4]]
        )

    start = (jnp.zeros((4, x.shape[-1]), x.dtype), x[0, 0])
    rows = flat.reshape(4, 12, -1)
    (total, last_rows), stacked = lax.scan(turn, start, (rows, jnp.arange(4.0)), reverse=True)

    def halve(state):
        field, count = state
        is_active = jnp.max(jnp.abs(field), (0, 1)) > 4.0
        smaller = jnp.where(is_active, field / 2.0, field)
        return jnp.pad(
            jnp.where(is_active, field[:3], 0.0), ((0, 9), (0, 0), (0, 0))
        ) + smaller, count + 1

    going = lambda state: jnp.any(jnp.abs(state[0]) > 4.0) & (state[1] < 9)
    halved, _ = lax.while_loop(going, halve, (large, jnp.int32(0)))
    return {
        "stacked": stacked,
        "apart": first * last + sum(jnp.unstack(x[:3])),
        "rest": (last_rows, jnp.min(flat, 0), jnp.min(stacked, (0, 2)), total),
        "halved": halved - jnp.max(large, 0),
        "found": jnp.any(large > 1.5, (0, 1)),
        "summed": (jnp.cumsum(flat[:5], 0), lax.cumsum(flat[:5], 0, reverse=True)),
        "picked": pick_rows(x, large),
        "exchanged": exchange_in_scan(x),
        "turned": large.reshape(4, 9, -1).transpose(1, 0, 2)[:, :, None],
    }


def overwrite_in_loops(x):
    """Continue large arrays in nested loops, while other code reads their previous values."""
    zero = jnp.zeros((), jnp.int32)

    def each(rows, function):
        """Rows one after the other, each by what it was."""

        def turn(state):
            k, rows = state
            row = lax.dynamic_index_in_dim(rows, k, 0, False)
            result = function(jnp.concatenate([row[6:], row[:6]]), k)
            result = jnp.stack([result[i] for i in range(len(result))])
            return k + 1, lax.dynamic_update_slice(rows, result[None], (k, zero, zero))

        return lax.while_loop(lambda s: jnp.any(s[0] < len(rows)), turn, (zero, rows))[1]

    def turn(state):
        count, first_array_in_turn, values_there_2, total = state
        early_read = first_array_in_turn[1]  # read after `here` is overwritten
        shifted = each(
            each(first_array_in_turn, lambda row, k: 0.5 * row + 0.1 * k),
            lambda row, _: row[:5] + 1.0,
        )
        fresh = each(is_unfinished, lambda row, k: row - 0.2 * count)  # the same begin at each turn
        part = lax.dynamic_update_index_in_dim(values_there_2, shifted[0] + fresh[3], count & 1, 0)
        late_read = part[1]  # likewise
        missing_values = each(part, lambda row, k: 0.5 * row + count)
        total = total + early_read + shifted[2] - fresh[1] + late_read
        return count + 1, missing_values, shifted, total

    full_values = each(jnp.concatenate([x, 2.0 * x, x * x]), lambda row, _: row + 1.0)
    is_unfinished = each(full_values, lambda row, _: row + 2.0)
    begin = zero, each(full_values, lambda row, _: row + 1.0), full_values, 0.0 * x[0]
    _, first_array, second_array, total = lax.while_loop(lambda s: s[0] < 5, turn, begin)
    return first_array + full_values, second_array, total


def test_in_place_updates_of_loops_do_not_change_other_readers():
    x = RANDOM_GENERATOR.uniform(0.0, 6.0, (2, 12, 37))
    call = compile_batch_function(overwrite_in_loops)
    for solution, expected in zip(jax.jit(call)(x), overwrite_in_loops(x), strict=True):
        np.testing.assert_allclose(solution, expected, rtol=1e-12, atol=1e-12)


def exchange_in_scan(x):
    """Read in a loop, with exchanged axes, arrays of another loop and the carry of an outer one."""
    write = lambda c, row: (c + row[0], jnp.stack([row * c, row + 1.0, row - c, row * row]))
    written_text = lax.scan(write, x[0, 0], x)[1]  # (20, 4, 3, lanes)
    sums = lax.scan(lambda c, part: (c - part[1, 2], part), x[1, 1], written_text.swapaxes(0, 1))

    def turn(_, held_values):
        field, other = held_values
        rows = lax.scan(lambda c, row: (c + row[0], row * 0.5 + c), x[0, 0], field.swapaxes(0, 1))
        return jnp.sin(other) + rows[1].swapaxes(0, 1), field.swapaxes(0, 1)

    square = written_text.reshape(20, 12, -1)[:7, :7]
    return sums, lax.fori_loop(0, 3, turn, (square, 2.0 * square))


def pick_rows(x, large):
    """Look up a table in each turn, and overwrite rows of a large array with its own values."""
    table = jnp.asarray(np.cos(np.arange(144.0)).reshape(12, 12))

    def turn(i, rows):
        weighed = sum(table[i, j] * rows[j] for j in range(12))
        return lax.dynamic_update_index_in_dim(rows, jnp.sin(weighed) + x[0], i, 0)

    return lax.fori_loop(2, 12, turn, large)


@pytest.mark.parametrize("n", [*mark_slow(1, 4), 1001])
def test_array_functions_are_called_from_jax_programs(n):
    x = jnp.asarray(RANDOM_GENERATOR.normal(size=(20, 3, n)))
    call = compile_batch_function(use_arrays_in_loops)
    # One lane after the other: no lane may see another.
    expected = jax.vmap(
        lambda one: jax.tree.map(lambda y: y[..., 0], use_arrays_in_loops(one[..., None])), -1, -1
    )(x)
    solution = jax.jit(call)(x)
    assert jax.tree.structure(solution) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(solution), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        # Sums of terms of size some hundred in another order.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def test_noinline_functions_are_called_and_give_the_same():
    def cubes(options_used):
        def run(_, lanes):
            power = options_used(lambda x, y: (x * y * y, x + lanes[0]))
            a, b = power(*power(*lanes))
            tangential_part = jax.jvp(power, (a, b), (b, a))[1]
            return (a, b, *tangential_part)

        return run

    lanes = [RANDOM_GENERATOR.normal(size=11) for _ in range(2)]
    called = make_program(cubes(mark_noinline), lanes)([], lanes)
    for called_result, expected in zip(called, cubes(jax.jit)((), lanes), strict=True):
        np.testing.assert_allclose(called_result, expected, rtol=1e-13, atol=1e-13)


def test_integers_and_booleans_compare_and_multiply_as_in_jax():
    def compare(_, lanes):
        x, y = (lane.astype(jnp.int32) for lane in lanes)
        a, b = x > 0, y > 0
        return (
            x**3 * 2 - jnp.square(y), jnp.abs(x), jnp.minimum(x, y), -y,
            a < b, a >= b, jnp.maximum(a, b), a ^ b, jnp.where(a, x, y), x.astype(bool), x != y,
        )  # fmt: skip

    for solution, expected in run_both_backends(
        compare, [10.0 * RANDOM_GENERATOR.normal(size=99) for _ in range(2)]
    ):
        np.testing.assert_array_equal(solution, expected)


def test_a_new_primitive_needs_one_row_of_the_table(monkeypatch):
    lanes = [RANDOM_GENERATOR.normal(size=9)]
    with pytest.warns(UserWarning, match="tan has no machine code"):
        make_program(lambda _, lanes: (jnp.tan(lanes[0]), lanes[0]), lanes)([], lanes)
    tangent = lambda _, lanes: (jnp.tan(lanes[0]),)
    monkeypatch.setitem(
        ELEMENTWISE_RULES, "tan",
        lambda operation, x: operation.value_emitter.llvm_builder.fdiv(
            *(ELEMENTWISE_RULES[name](operation, x) for name in ("sin", "cos"))
        ),
    )  # fmt: skip
    monkeypatch.setitem(PRIMITIVE_RULES, "tan", PRIMITIVE_RULES["sin"])
    ((solution, expected),) = run_both_backends(tangent, lanes)
    np.testing.assert_allclose(solution, expected, rtol=1e-14)

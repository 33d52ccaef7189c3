"""Machine code for lanes does what JAX does with the same function; a later start finds it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from vrw_jax import simd

DRAW = np.random.default_rng(0)


def program(function, lanes, uniform=(), settings="test"):
    """`function(uniform, lanes)` compiled for inputs like these."""
    kinds = [np.asarray(x).dtype for x in uniform]
    return simd.lane_program(function, kinds, len(lanes), lanes[0].dtype, settings)


def both_ways(function, lanes, uniform=()):
    """Its results as machine code and by JAX, array by array."""
    uniform = [np.asarray(x, lanes[0].dtype) for x in uniform]
    compiled = program(function, lanes, uniform)(uniform, lanes)
    expected = function(uniform, [jnp.asarray(x) for x in lanes])
    return list(zip(compiled, map(np.asarray, expected), strict=True))


@pytest.fixture(autouse=True)
def folder(tmp_path):
    """A cache of the test's own."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def arithmetic(uniform, lanes):
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
def test_elementwise_code_gives_what_jax_gives(dtype):
    lanes = [DRAW.normal(size=1003).astype(dtype) for _ in range(2)]
    # Products and sums are rounded once where JAX may round twice; y^-2 magnifies that.
    close = 40.0 * np.finfo(dtype).eps
    for found, expected in both_ways(arithmetic, lanes, (0.7,)):
        assert found.dtype == expected.dtype
        if found.dtype.kind == "f":
            np.testing.assert_allclose(found, expected, rtol=close, atol=close)
        else:
            np.testing.assert_array_equal(found, expected)


def test_what_is_no_number_stays_none_and_is_compared_as_jax_does():
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0])
    x, y = (grid.ravel() for grid in np.meshgrid(odd, odd))

    def compare(_, lanes):
        x, y = lanes
        return (
            jnp.maximum(x, y), jnp.minimum(x, y), x < y, x >= y, x == y, x != y, jnp.isfinite(x),
            jnp.where(x > y, 1.0, 2.0),
        )  # fmt: skip

    for found, expected in both_ways(compare, [x, y]):
        np.testing.assert_array_equal(found, expected)


def test_powers_of_step_control_are_as_right_as_said():
    x = np.geomspace(1e-20, 1e20, 10_001).astype(np.float32)
    powers = lambda _, lanes: (jnp.log(lanes[0]), jnp.exp(0.9 * jnp.log(lanes[0]) / 10.0))
    (log, exact), (power, _) = both_ways(powers, [x])
    np.testing.assert_allclose(log, exact, atol=1e-5 + 1e-6 * 46)
    np.testing.assert_allclose(power, np.exp(0.09 * np.log(x.astype(float))), rtol=1e-5)


def collatz(_, lanes):
    """Steps to 1: every lane ends when it likes."""
    start = lanes[0].astype(jnp.int32)

    def turn(state):
        number, count = state
        halved = jnp.where(number & 1 == 1, 3 * number + 1, number >> 1)
        on = number != 1
        return jnp.where(on, halved, number), count + on

    return lax.while_loop(lambda s: jnp.any(s[0] != 1), turn, (start, jnp.zeros_like(start)))[1:]


def test_loops_end_lane_by_lane_and_groups_wait_for_none():
    start = np.arange(1.0, 1001.0)
    ((found, expected),) = both_ways(collatz, [start])
    np.testing.assert_array_equal(found, expected)
    assert found[26] == 111  # of 27, the known one


def test_scans_run_over_their_constants():
    def horner(_, lanes):
        coefficients = jnp.asarray([1.0, -2.0, 0.5, 3.0])
        start = jnp.zeros_like(lanes[0])
        return (lax.scan(lambda p, c: (p * lanes[0] + c, None), start, coefficients)[0],)

    ((found, expected),) = both_ways(horner, [DRAW.normal(size=17)])
    np.testing.assert_allclose(found, expected, rtol=1e-15, atol=1e-15)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 5_003])
def test_a_lane_gives_the_same_bits_in_any_company_on_any_number_of_cores(monkeypatch, n):
    lanes = [DRAW.normal(size=5_003) for _ in range(2)]
    run = program(arithmetic, lanes, [np.float64(0.7)])
    monkeypatch.setattr(simd, "_cores", lambda: 1)
    whole = run([np.float64(0.7)], lanes)
    monkeypatch.setattr(simd, "_cores", lambda: 3)
    some = DRAW.permutation(5_003)[:n]
    for part, all_ in zip(run([np.float64(0.7)], [x[some] for x in lanes]), whole, strict=True):
        np.testing.assert_array_equal(part, all_[some])


def test_a_later_start_neither_traces_nor_compiles(folder, monkeypatch):
    lanes = [np.arange(4.0)]
    traced = []

    def double(_, lanes):
        traced.append(1)
        return (2.0 * lanes[0],)

    assert list(program(double, lanes)([], lanes)[0]) == [0.0, 2.0, 4.0, 6.0]
    monkeypatch.setattr(simd, "_compiled", None)  # would fail
    assert list(program(double, lanes)([], lanes)[0]) == [0.0, 2.0, 4.0, 6.0]
    assert len(traced) == 1


def test_other_settings_and_damaged_files_are_compiled_anew(folder):
    lanes = [np.arange(4.0)]
    twice, thrice = (lambda _, x, n=n: (n * x[0],) for n in (2.0, 3.0))
    assert program(twice, lanes, settings=2)([], lanes)[0][3] == 6.0
    assert program(thrice, lanes, settings=3)([], lanes)[0][3] == 9.0
    for place in folder.glob("vrw_lanes_*"):
        content = bytearray(place.read_bytes())
        content[-100] ^= 1
        place.write_bytes(content)
    assert program(twice, lanes, settings=2)([], lanes)[0][3] == 6.0


def test_code_that_is_not_elementwise_is_refused_in_a_sentence():
    lanes = [np.arange(4.0)]
    with pytest.raises(NotImplementedError, match="cumsum is not elementwise"):
        program(lambda _, x: (jnp.cumsum(x[0]),), lanes)
    with pytest.raises(NotImplementedError, match="neither a number nor one for each"):
        program(lambda _, x: (jnp.stack([x[0], x[0]])[0],), lanes)

"""Programs are compiled once where they may be shared; JAX logs its compilations."""

import functools
import logging
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import (
    Guard,
    Mode,
    ReturnMap,
    flow_jacobian_determinant,
    segment_maps,
    simulate_hybrid,
    time_errors,
)
from vrw_jax.lanes.program import (
    MAX_CACHED_PROGRAMS,
    _program_by_key,
    call_compiled_program,
    get_compiled_program,
)

GRAVITY = 9.81

moon = types.ModuleType("moon")


def fall(y):
    return jnp.stack([y[1], -GRAVITY + 0.0 * y[1]])


def make_ball(restitution=0.8):
    """Return modes that are made again at each call."""
    bounce = lambda y: jnp.stack([0.0 * y[0], -restitution * y[1]])
    return [Mode(fall, (Guard(lambda y: y[0], bounce),))]


def drop_ball(height, modes=None, **options):
    start = jnp.stack([jnp.asarray(height), jnp.zeros((), jnp.asarray(height).dtype)])
    modes = make_ball() if modes is None else modes
    return simulate_hybrid(modes, start, events=3, options=vrw.StepOptions(**options))


def third_impact(gravity, restitution):
    """Return the time of the third impact of a ball dropped from 1 m, s, in closed form."""
    return np.sqrt(2.0 / gravity) * (1.0 + 2.0 * (restitution + restitution**2))


@pytest.fixture
def count_compilations(caplog):
    """Call a function twice; return how many programs JAX compiles in the second call."""

    def count(function):
        jax.block_until_ready(function())
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="jax"), jax.log_compiles():
            jax.block_until_ready(function())
        return sum("Finished XLA compilation" in x.getMessage() for x in caplog.records)

    return count


def test_a_simulation_outside_jit_is_compiled_once_for_equal_modes(count_compilations):
    modes, solution = make_ball(), drop_ball(1.0)
    tolerances, heights = iter((1e-9, 1e-8)), iter((1.0, 2.0))
    return_map = ReturnMap(
        make_ball(0.5), lambda x: jnp.stack([1.0 + 0.0 * x[0], x[0]]), lambda y: y[1:]
    )
    calls = {
        "the same modes": lambda: drop_ball(1.0, modes),
        "modes made again": lambda: drop_ball(1.0),
        "another tolerance": lambda: drop_ball(1.0, rtol=next(tolerances)),
        "another start": lambda: drop_ball(next(heights)),
        "forward mode": lambda: jax.jacfwd(lambda x: drop_ball(x).times)(1.0),
        "a batch": lambda: jax.vmap(lambda x: drop_ball(x).times)(jnp.ones(3)),
        "estimated errors": lambda: time_errors(make_ball(), [1.0, 0.0], solution),
        "determinant": lambda: flow_jacobian_determinant(make_ball(), [1.0, 0.0], solution),
        "segments": lambda: segment_maps(fall, [1.0, 0.0], 0.3, 2, vrw.StepOptions()),
        "a fixed point": lambda: solve_fixed_point(return_map, jnp.array([1.0])),
    }
    for name, call in calls.items():
        assert count_compilations(call) == 0, name


def assert_third_impact(modes, gravity, restitution):
    assert float(drop_ball(1.0, modes).time) == pytest.approx(
        third_impact(gravity, restitution), abs=1e-12
    )


def test_a_changed_constant_of_a_mode_changes_the_result(monkeypatch):
    """Changed by a global name, a closure, an argument's default, and inside an array."""
    modes = make_ball()
    assert_third_impact(modes, 9.81, 0.8)
    monkeypatch.setitem(globals(), "GRAVITY", 1.62)
    assert_third_impact(modes, 1.62, 0.8)
    assert_third_impact(make_ball(0.5), 1.62, 0.5)
    table = np.array([0.8])
    guard = lambda y: y[0]

    def bounce(y, r=table):
        return jnp.stack([0.0 * y[0], -r[0] * y[1]])

    modes = [Mode(fall, Guard(guard, bounce))]
    assert_third_impact(modes, 1.62, 0.8)
    table[0] = 0.5
    assert_third_impact(modes, 1.62, 0.5)
    for r in (0.8, 0.6):
        reset = functools.partial(bounce, r=np.array([r]))
        assert_third_impact([Mode(fall, Guard(guard, reset))], 1.62, r)


def test_a_changed_attribute_of_an_object_class_or_module_changes_the_result():
    class Ground:
        restitution = 0.8

        def bounce(self, y):
            return jnp.stack([0.0 * y[0], -self.restitution * y[1]])

    ground, moon.gravity, guard = Ground(), 9.81, lambda y: y[0]
    by_class = lambda y: jnp.stack([0.0 * y[0], -Ground.restitution * y[1]])
    fall_by_module = lambda y: jnp.stack([y[1], -moon.gravity + 0.0 * y[1]])
    modes = [
        [Mode(fall_by_module, Guard(guard, ground.bounce))],
        [Mode(fall_by_module, Guard(guard, by_class))],
    ]
    for gravity, restitution in ((9.81, 0.8), (1.62, 0.8), (1.62, 0.5)):
        moon.gravity, Ground.restitution = gravity, restitution
        for mode in modes:
            assert_third_impact(mode, gravity, restitution)
    ground.restitution = 0.6
    assert_third_impact(modes[0], 1.62, 0.6)


def test_a_constant_of_a_class_that_a_library_seems_to_define_is_read_again():
    """Reference: the fall from 1 m takes sqrt(2 / g)."""
    for module_name in ("jaxmodel", "numpy_model"):
        planet = type("Planet", (), {"__module__": module_name})()
        fall_on_planet = lambda y, planet=planet: jnp.stack([y[1], -planet.g + 0.0 * y[1]])
        for planet.g in (9.81, 1.62):
            solution = drop_ball(1.0, [Mode(fall_on_planet, Guard(lambda y: y[0], jnp.negative))])
            assert solution.times[0] == pytest.approx(np.sqrt(2.0 / planet.g), abs=1e-12)


def test_a_constant_that_is_read_by_a_computed_name_is_read_again():
    fall_by_name = lambda y: jnp.stack([y[1], -getattr(moon, "gra" + "vity") + 0.0 * y[1]])
    for moon.gravity in (9.81, 1.62):
        solution = drop_ball(1.0, [Mode(fall_by_name, Guard(lambda y: y[0], jnp.negative))])
        assert solution.times[0] == pytest.approx(np.sqrt(2.0 / moon.gravity), abs=1e-12)


def test_a_program_for_another_shape_has_the_constants_of_its_own_functions():
    """The first function has another constant by then, and an equal one is traced for a vector."""
    scale, table = lambda static, x: static() * x, np.array([2.0])
    make_function = lambda own_table: lambda: own_table[0]
    assert call_compiled_program(scale, make_function(table), 1.0) == 2.0
    table[0] = 3.0
    scaled = call_compiled_program(scale, make_function(np.array([2.0])), jnp.ones(2))
    assert scaled.tolist() == [2.0, 2.0]


def test_a_closure_over_a_differentiated_or_mapped_value_shares_no_program():
    time = lambda r: drop_ball(1.0, make_ball(r)).time
    derivative = np.sqrt(2.0 / 9.81) * 2.0 * (1.0 + 2.0 * 0.8)
    for _ in range(2):
        np.testing.assert_allclose(jax.jacfwd(time)(0.8), derivative, rtol=1e-10)
        times = jax.vmap(time)(jnp.array([0.5, 0.8]))
        expected = [third_impact(9.81, 0.5), third_impact(9.81, 0.8)]
        np.testing.assert_allclose(times, expected, rtol=1e-12)


def test_at_most_the_stated_number_of_programs_is_kept():
    scale = lambda static, x: static * x
    for factor in range(2 * MAX_CACHED_PROGRAMS):
        program = get_compiled_program(scale, float(factor), 2.0)
        assert float(program(2.0)) == 2.0 * factor
        assert len(_program_by_key) <= MAX_CACHED_PROGRAMS

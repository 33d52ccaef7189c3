"""JAX settings of the user's code change no number and raise no error."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.slow_variants import make_params_with_slow_marks

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, Mode, simulate_hybrid
from vrw_jax.lanes import count_available_cores, with_default_jax_settings
from vrw_jax.lanes.environment import call_python, can_programs_call_jax

STRICT_SETTINGS = (
    ("jax_disable_jit", True),
    ("jax_numpy_rank_promotion", "raise"),
    ("jax_numpy_dtype_promotion", "strict"),
)
GROUND = vrw.UnilateralWheel(friction=0.7)


def compute_speed(damping):
    return vrw.limit_cycle(vrw.WheelParams(damping=damping)).speed


def simulate_ball():
    fall = lambda y: jnp.stack([y[1], -9.81 + 0.0 * y[1]])
    bounce = lambda y: jnp.stack([0.0 * y[0], -0.8 * y[1]])
    ball = Mode(fall, Guard(lambda y: y[0], bounce))
    return simulate_hybrid(ball, jnp.array([1.0, 0.0]), events=2).state


CALLS = {
    "step": lambda: vrw.step(vrw.WheelParams(), vrw.paper_start()),
    "jacobian": lambda: jax.jacfwd(vrw.return_map, argnums=1)(vrw.WheelParams(), vrw.paper_start()),
    "walk": lambda: vrw.walk(vrw.WheelParams(), vrw.paper_start(), 2),
    "step_batch": lambda: (
        vrw.step_batch(vrw.WheelParams(), np.asarray(vrw.paper_start())[None]).durations
    ),
    "limit_cycle": lambda: vrw.limit_cycle(vrw.WheelParams()),
    "measures": lambda: vrw.limit_cycle(vrw.WheelParams()).measures(
        ("speed", "stability_margin", "spectral_margin", "takeoff_acceleration", "lambda_4_plus")
    ),
    "properties": lambda: [
        (cycle.mesh_error, cycle.takeoff_acceleration, cycle.margins, cycle.jury_margins)
        for cycle in [vrw.limit_cycle(vrw.WheelParams())]
    ],
    "gait_sensitivity": lambda: vrw.gait_sensitivity(vrw.WheelParams(), "speed").norm,
    "grad": lambda: jax.grad(jax.jit(compute_speed))(150.0),  # its rule runs outside of any call
    "vmap": lambda: jax.vmap(jax.jit(compute_speed))(jnp.array([150.0, 160.0])),
    "continue_branch": lambda: (
        vrw.continue_branch(vrw.WheelParams(), "damping", (195.0, 205.0)).values
    ),
    "tune": lambda: (
        vrw.tune(
            vrw.WheelParams(), "speed", ("damping",), {"damping": (199.0, 201.0)}, max_evaluations=2
        ).value
    ),
    "simulate": lambda: vrw.simulate(vrw.WheelParams(), vrw.paper_start(), n_steps=1).hub_x,
    "unilateral contact": lambda: vrw.return_map(
        vrw.WheelParams(damping=250.0), vrw.paper_start(), model=GROUND
    ),
    "scan": lambda: vrw.scan(vrw.grid(damping=[150.0, 200.0]), ["speed"]).speed,  # in threads
    "solve_fixed_point": lambda: vrw.solve_fixed_point(jnp.cos, jnp.array([0.7])).x,
    "simulate_hybrid": simulate_ball,
}

SLOW_CALLS = ("grad", "continue_branch", "tune", "unilateral contact")
"""Calls whose tracing or compilation takes seconds."""


@pytest.mark.parametrize("name", make_params_with_slow_marks(CALLS, SLOW_CALLS))
def test_strict_settings_of_the_process_change_no_bit(name):
    results = [np.asarray(leaf) for leaf in jax.tree.leaves(CALLS[name]())]
    for setting, value in STRICT_SETTINGS:
        default = getattr(jax.config, setting)
        jax.config.update(setting, value)
        try:
            strict_results = [np.asarray(leaf) for leaf in jax.tree.leaves(CALLS[name]())]
            assert getattr(jax.config, setting) == value
        finally:
            jax.config.update(setting, default)
        # The caller's own jit is off, too: operations that it would fuse are rounded one by one.
        is_caller_jit_off = setting == "jax_disable_jit" and name in ("grad", "vmap")
        tolerance = 4e-16 if is_caller_jit_off else 0.0
        for result, strict_result in zip(results, strict_results, strict=True):
            np.testing.assert_allclose(
                strict_result, result, rtol=tolerance, atol=tolerance, err_msg=setting
            )


def test_machine_code_outside_jit_is_called_by_a_program():
    with jax.disable_jit():
        result = vrw.ViscoelasticWheel().advance(
            vrw.WheelParams(), vrw.paper_start(), vrw.StepOptions()
        )
    np.testing.assert_array_equal(
        result.section_state, vrw.return_map(vrw.WheelParams(), vrw.paper_start())
    )


def test_default_settings_hold_inside_a_function_and_in_each_thread():
    seen_settings = []

    def record_settings():
        seen_settings.append((jax.config.jax_disable_jit, jax.config.jax_numpy_rank_promotion))

    jax.config.update("jax_numpy_rank_promotion", "raise")
    try:
        thread = threading.Thread(target=with_default_jax_settings(record_settings))
        thread.start()
        thread.join()
        with_default_jax_settings(record_settings)()
        record_settings()
    finally:
        jax.config.update("jax_numpy_rank_promotion", "allow")
    assert seen_settings == [(False, "allow"), (False, "allow"), (False, "raise")]


@pytest.mark.skipif(not can_programs_call_jax(), reason="XLA has one thread")
def test_python_functions_that_would_hold_all_threads_are_refused():
    """Each of these functions runs a program that calls the next function."""

    def nest(x, depth):
        run_next = lambda y: np.asarray(jax.jit(nest, static_argnums=1)(y, depth - 1))
        return call_python(run_next, jax.typeof(x), x) if depth else x + 1.0

    run = jax.jit(nest, static_argnums=1)
    assert run(1.0, 1) == 2.0
    with pytest.raises(jax.errors.JaxRuntimeError, match="run these programs one after another"):
        run(1.0, count_available_cores())
    assert run(1.0, 1) == 2.0

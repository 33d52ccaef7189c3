"""Results print numbers with symbols and units, as text and tables; help describes the fields."""

import dataclasses
import pydoc
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw

TABLE_1, START = vrw.WheelParams(), vrw.paper_start()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TABLE_1, ("damping c: 200 N s/m", "slope phi: 0.3 rad", "n_legs: 8")),
        (
            lambda: vrw.WheelParams(damping=np.array([1.0, 2.0])),
            ("2 values from 1 to 2 N s/m",),
        ),
        (
            lambda: jax.tree.map(jnp.negative, TABLE_1),
            ("a gradient or a difference", "by damping c, N s/m: -200"),
        ),
        (vrw.StepOptions, ("solver: Dopri8", "rtol: 1e-10", "dt0: 0.005 s")),
        (lambda: vrw.step(TABLE_1, START), ("DLS fraction T_DLS/T: 0.53", "N s, broken")),
        (lambda: vrw.step(TABLE_1, START).margins, ("min λ2: 103.", " N")),
        (lambda: vrw.step(TABLE_1, START).indicators, ("λ_I4: 1.96", "N s")),
        (lambda: vrw.step(TABLE_1, START).energy, ("ΔE_c: 29.5", " J")),
        (lambda: vrw.walk(TABLE_1, START, 3), ("steps: 3 of 3", "rad, rad/s, m/s")),
        (
            lambda: vrw.step_batch(TABLE_1, np.stack([START, 0.0 * START])),
            ("1 STEPPED, 1 BAD_INPUT",),
        ),
        (lambda: vrw.limit_cycle(TABLE_1).indicators, ("N s",)),
        (
            lambda: vrw.limit_cycle(vrw.WheelParams(slope=0.1), model=vrw.RigidWheel()),
            ("period", "m/s"),
        ),
    ],
)
def test_a_result_prints_numbers_and_units(make, words):
    result = make()
    text, table = repr(result), result._repr_html_()
    for word in words:
        assert word in text
    assert len(text.splitlines()) < 50
    assert table.startswith("<table>")


def test_a_batch_of_fixed_points_has_the_ending_of_each():
    """cos has a fixed point; x + 1 has none."""
    points = jax.vmap(
        lambda a: vrw.solve_fixed_point(
            lambda x: a * jnp.cos(x) + (1.0 - a) * (x + 1.0), jnp.array([0.7])
        )
    )(jnp.array([1.0, 0.0]))
    assert points.ending[0].startswith("Newton's method converged after")
    assert points.ending[1].startswith("Newton's method did not converge after")


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda: vrw.UnilateralWheel(friction=0.55), "UnilateralWheel(friction=0.55, max_events="),
        (lambda: vrw.RigidWheel(), "RigidWheel(friction=1.0, stop_at_lift_off=True"),
        (lambda: vrw.grid(damping=np.linspace(1, 2, 1000)), "grid of 1,000: damping 1000 values"),
        (lambda: vrw.sobol({"slope": (0.2, 0.3)}, 64), "sobol of 64: slope 64 values from 0.2"),
        (lambda: vrw.solve_fixed_point(lambda x: 0.5 * x + 1.0, jnp.zeros(1)), "multipliers: 0.5"),
    ],
)
def test_parts_of_a_result_print_numbers_in_few_lines(make, line):
    text = repr(make())
    assert line in text
    assert len(text) < 200
    assert "Array" not in text


def test_a_missing_cycle_is_ignored_as_a_guess():
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=300.0), on_failure="nan")
    solution = jax.jit(lambda p: vrw.limit_cycle(p, guess=cycle).speed)(TABLE_1)
    np.testing.assert_allclose(solution, vrw.limit_cycle(TABLE_1).speed, rtol=1e-12)


def test_traced_results_print_their_shapes():
    assert "float64" in repr(jax.eval_shape(lambda p: vrw.step(p, START), TABLE_1))
    assert "None" in repr(vrw.WheelParams(damping=np.ones(3)).in_axes)


@pytest.mark.parametrize(
    ("thing", "field"),
    [
        (vrw.WheelParams, "damping"),
        (vrw.StepOptions, "dt0"),
        (vrw.CycleOptions, "homotopy_steps"),
        (vrw.StepResult, "step_length"),
        (vrw.Margins, "contraction"),
        (vrw.StepBatchResult, "solver_steps"),
        (vrw.LimitCycle, "n_newton_iterations"),
        (vrw.TuneResult, "n_evaluations"),
        (vrw.UnilateralStep, "slip"),
    ],
)
def test_help_describes_the_fields(thing, field):
    """By at least three words, since the name alone describes no quantity and unit."""
    assert re.search(rf"`{field}`:(\s+\S+){{3}}", pydoc.plain(pydoc.render_doc(thing)))


def test_partly_batched_wheels_are_mapped_by_their_own_axes():
    wheels = vrw.WheelParams(damping=np.array([150.0, 200.0]))
    cycles = jax.vmap(vrw.limit_cycle, in_axes=(wheels.in_axes,))(wheels)
    one = vrw.limit_cycle(dataclasses.replace(TABLE_1, damping=150.0))
    np.testing.assert_allclose(cycles.period[0], one.period, rtol=1e-12)


def test_dir_lists_public_names_and_imports_figures_only_on_use():
    code = (
        "import sys, vrw_jax as vrw\n"
        "assert 'matplotlib' not in sys.modules\n"
        "assert set(dir(vrw)) == {*vrw.__all__, '__version__'}\n"
        "assert all(hasattr(vrw, name) for name in vrw.__all__)\n"
        "assert vrw.__version__.split('.')[0].isdigit()\n"
        "assert callable(vrw.plot.save_animation) and 'matplotlib' in sys.modules\n"
        "assert vrw.MEASURES['period'].unit == 's'\n"
        "assert vrw.default_margins(vrw.WheelParams())['contraction'] > 0.0\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_walk_has_a_default_start():
    trajectory = vrw.simulate(TABLE_1, n_steps=2)
    np.testing.assert_array_equal(trajectory.attrs["start"], np.asarray(START))

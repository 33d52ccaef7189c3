"""Limit cycles agree with a reference of 27 digits and with walks; derivatives and failures."""

import functools
import math
import os
import re
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import reference_values
from support.files import assert_netcdf_round_trip
from support.machine_code import disable_machine_code
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax import Outcome, lanes
from vrw_jax.base import small_matrices
from vrw_jax.wheel import PARAMETER_NAMES, make_wheel_from_parameters

TIGHT_OPTIONS = vrw.CycleOptions.tight()
MASS_NAMES = [PARAMETER_NAMES.index(name) for name in ("hub_mass", "leg_mass")]
VALUES = ("section_state", "post_impact", "durations", "period", "dls_fraction", "speed")
DIFFERENTIATED_MEASURES = (
    "post_impact",
    "durations",
    "period",
    "dls_fraction",
    "speed",
    "step_length",
)


def collect_measures(cycle, names):
    return {name: getattr(cycle, name) for name in names}


@functools.cache
def compile_cycle_measures(options, names, transform):
    """Return a compiled function: cycles of a batch with derivatives of some measures."""

    def one(vector):
        cycle = vrw.limit_cycle(reference_values.make_wheel(vector), options=options)
        values = collect_measures(cycle, names)
        return (values[names[0]] if transform is jax.grad else values), cycle

    return jax.jit(jax.vmap(transform(one, has_aux=True)))


def differentiate_measures(rows, options=None, names=DIFFERENTIATED_MEASURES, transform=jax.jacfwd):
    """Return derivatives and cycles of rows of parameters, in a batch of fixed size."""
    rows = np.atleast_2d(np.asarray(rows, float))
    full = np.concatenate(
        [rows, np.tile(rows[-1], (len(reference_values.REFERENCE_CASES) - len(rows), 1))]
    )
    solution = compile_cycle_measures(options, names, transform)(jnp.asarray(full))
    return jax.tree.map(lambda x: x[: len(rows)], solution)


@functools.cache
def stack_reference_measures(options=None, names=DIFFERENTIATED_MEASURES):
    return differentiate_measures(reference_values.REFERENCE_PARAMETERS, options, names)


def find_reference_cycles(options=None):
    return stack_reference_measures(options)[1]


def table_1(**changes):
    row = reference_values.REFERENCE_PARAMETERS[0].copy()
    for name, value in changes.items():
        row[PARAMETER_NAMES.index(name)] = value
    return row


def compute_relative_error(solution, expected):
    scale = np.max(np.abs(expected), axis=tuple(range(1, expected.ndim)), keepdims=True)
    return np.max(np.abs(np.asarray(solution) - expected) / scale)


@pytest.mark.parametrize(("options", "allowed"), [(None, 1e-9), *mark_slow((TIGHT_OPTIONS, 1e-12))])
def test_cycles_agree_with_the_reference(options, allowed):
    solution = find_reference_cycles(options)
    assert np.all(np.asarray(solution.outcome) == Outcome.STEPPED)
    for name in VALUES:
        assert (
            compute_relative_error(
                getattr(solution, name), reference_values.stack_quantity("cycle", name)
            )
            < allowed
        ), name
    for indicator_name, name in (("lambda_I4", "lambda_impulse_4"), ("lambda_2", "lambda2_plus")):
        indicator = getattr(solution.indicators, indicator_name)
        assert (
            reference_values.compute_scaled_error(
                indicator, reference_values.stack_quantity("cycle", name)
            )
            < 10 * allowed
        )


@pytest.mark.parametrize(("options", "allowed"), [(None, 1e-8), (TIGHT_OPTIONS, 1e-11)])
def test_multipliers_agree_with_the_reference(options, allowed):
    expected = reference_values.stack_quantity("cycle", "multipliers")
    multipliers = np.asarray(find_reference_cycles(options).multipliers)
    expected = expected[..., 0] + 1j * expected[..., 1]
    gap = np.abs(multipliers[:, :, None] - expected[:, None, :])
    assert gap.min(1).max() < allowed


@pytest.mark.parametrize(("options", "allowed"), [(None, 1e-8), (TIGHT_OPTIONS, 1e-10)])
def test_first_derivatives_agree_with_the_reference(options, allowed):
    solution, _ = stack_reference_measures(options)
    for name in DIFFERENTIATED_MEASURES:
        expected = np.stack(
            [
                reference_values.to_floats(case["cycle"]["d_params"][name])
                for case in reference_values.REFERENCE_CASES
            ]
        )
        derivative = np.asarray(solution[name]).reshape(expected.shape)
        assert compute_relative_error(derivative, expected) < allowed, name


@pytest.mark.slow
@pytest.mark.skipif(not lanes.is_machine_code_available(), reason="machine code is for CPUs")
def test_gradients_of_multipliers_use_machine_code_throughout():
    radius = lambda vector: vrw.limit_cycle(reference_values.make_wheel(vector)).spectral_radius
    program = (
        jax.jit(jax.vmap(jax.grad(radius))).lower(reference_values.REFERENCE_PARAMETERS).as_text()
    )
    called = set(re.findall(r"lanes_code_\w+", program))
    # The search, and on two meshes the columns and the derivatives of the monodromy along them.
    assert len(called) == 5
    assert "while" not in program


def test_derivatives_of_the_spectral_radius_agree_with_the_reference():
    solution = stack_reference_measures(None, ("spectral_radius",))[0]["spectral_radius"]
    rows = [table_1(), table_1(slope=0.02), table_1(damping=np.nan)]
    failed = differentiate_measures(rows, None, ("spectral_radius",))[0]["spectral_radius"]
    assert np.all(np.asarray(failed)[1:] == 0.0)
    expected = np.stack(
        [
            reference_values.to_floats(case["cycle"]["d_params"]["spectral_radius"])
            for case in reference_values.REFERENCE_CASES
        ]
    )
    assert compute_relative_error(solution, expected) < 1e-8


def test_derivatives_by_both_masses_are_accurate_for_a_hub_lighter_than_a_leg():
    """Of the two, units tell that by which both grow: neither may be divided by alone."""
    row, step = table_1(hub_mass=1.8, leg_mass=2.025), 1e-5
    method_names = [step * np.eye(len(PARAMETER_NAMES))[i] for i in MASS_NAMES]
    rows = [
        row,
        *(row + sign * method_name for method_name in method_names for sign in (1.0, -1.0)),
    ]
    slopes, solution = differentiate_measures(rows, None, ("spectral_radius",))
    radius = np.abs(np.linalg.eigvals(solution.monodromy_value)).max(-1)
    differences = (radius[1::2] - radius[2::2]) / (2.0 * step)
    # Errors of differences: the step squared, and the search's 1e-13 over the step.
    mass_derivatives = np.asarray(slopes["spectral_radius"])[0, MASS_NAMES]
    np.testing.assert_allclose(
        mass_derivatives, differences, rtol=0, atol=1e-7 * np.abs(mass_derivatives).max()
    )
    assert np.all(np.abs(mass_derivatives) > 1e-3)


@pytest.mark.slow
def test_second_derivatives_agree_with_differences_and_vanish_without_a_cycle():
    rows = jnp.asarray(np.stack([table_1(), table_1(slope=0.02), table_1(damping=np.nan)]))
    slope = PARAMETER_NAMES.index("slope")

    def fraction(vector):
        return vrw.limit_cycle(reference_values.make_wheel(vector)).dls_fraction

    gradients = jax.jit(jax.vmap(jax.grad(fraction)))
    solution = jax.jit(jax.vmap(jax.jacfwd(jax.grad(fraction))))(rows)
    assert np.all(np.asarray(solution)[1:] == 0.0)
    np.testing.assert_allclose(solution[0], solution[0].T, rtol=1e-9, atol=1e-12)
    step = 1e-5 * np.eye(len(PARAMETER_NAMES))[slope]  # errors: 1e-10 of the step, 1e-15 over it
    ahead, behind = gradients(rows[:1] + step)[0], gradients(rows[:1] - step)[0]
    np.testing.assert_allclose(solution[0][slope], (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_reverse_mode_agrees_with_forward_mode():
    reverse, _ = differentiate_measures(
        reference_values.REFERENCE_PARAMETERS, None, ("dls_fraction",), jax.grad
    )
    np.testing.assert_allclose(
        reverse, stack_reference_measures()[0]["dls_fraction"], rtol=1e-10, atol=1e-13
    )


def test_cycle_is_a_fixed_point_of_the_event_driven_map():
    wheels = reference_values.make_wheels(reference_values.REFERENCE_PARAMETERS[:6])
    state = find_reference_cycles().section_state[:6]
    options = vrw.StepOptions.tight()
    walk = jax.jit(jax.vmap(lambda p, x: vrw.return_map(p, x, options=options)))
    np.testing.assert_allclose(walk(wheels, state), state, rtol=0, atol=3e-9)


def test_a_gait_that_the_mesh_does_not_resolve_is_not_reported_as_found():
    # Towards the slope where walking stops, 0.0969184, double support lasts longer and longer.
    rows = np.stack([table_1(slope=slope) for slope in (0.3, 0.2, 0.15, 0.12, 0.105, 0.098)])
    expected, solution = (
        differentiate_measures(rows, TIGHT_OPTIONS)[1],
        differentiate_measures(rows, vrw.CycleOptions())[1],
    )
    is_gait_found = np.asarray(solution.found)
    assert list(is_gait_found) == [True, True, True, False, False, False]
    assert np.asarray(expected.found)[3]
    np.testing.assert_allclose(
        solution.period[is_gait_found], expected.period[is_gait_found], rtol=1e-8
    )
    error = np.abs(np.asarray(solution.period / expected.period)[is_gait_found] - 1.0)
    assert np.all(error <= solution.mesh_error[is_gait_found])


def test_every_measure_of_a_cycle_can_be_differentiated():
    def measures(params):
        cycle = vrw.limit_cycle(params)
        names = ("stability_margin", "jury_margins", "condition_number", "mesh_error", "indicators")
        return [getattr(cycle, name) for name in names]

    jax.eval_shape(jax.jacrev(measures), vrw.WheelParams())  # traced, which is what can fail


def test_a_wheel_in_float32_stays_in_float32_beside_64_bits():
    params = jax.tree.map(lambda x: x.astype(jnp.float32), vrw.WheelParams())
    loose = vrw.CycleOptions(tolerance=1e-3)
    cycle = jax.eval_shape(lambda p: vrw.limit_cycle(p, options=loose), params)
    floats = [x for x in jax.tree.leaves(cycle) if jnp.issubdtype(x.dtype, jnp.inexact)]
    assert {x.dtype for x in floats} == {jnp.dtype(jnp.float32)}


def test_vmap_agrees_with_single_wheels():
    batch = find_reference_cycles()
    for index in (0, 3):
        single = vrw.limit_cycle(
            reference_values.make_wheel(reference_values.REFERENCE_PARAMETERS[index])
        )
        np.testing.assert_allclose(
            single.section_state, batch.section_state[index], rtol=1e-12, atol=1e-13
        )


def test_a_gait_that_only_walks_reach_is_found_inside_jit_and_vmap_too():
    """The first wheel has a gait on a gentle slope, and the second wheel has none."""
    wheels = vrw.WheelParams(
        damping=np.array([120.0, 400.0]), stiffness=np.array([1800.0, 1e3]), slope=0.08
    )
    expected = vrw.limit_cycles(wheels)
    assert expected.found.tolist() == [True, False]
    find = lambda damping, stiffness: vrw.limit_cycle(
        vrw.WheelParams(damping=damping, stiffness=stiffness, slope=0.08)
    )
    gaits = jax.jit(jax.vmap(find))(wheels.damping, wheels.stiffness)
    assert gaits.outcome.tolist() == expected.outcome.tolist()
    # The meshes differ. The relative errors of both are 1e-9 in values and 1e-8 in derivatives.
    np.testing.assert_allclose(gaits.section_state, expected.section_state, rtol=2e-9)
    for measure in ("period", "spectral_radius"):
        evaluate = lambda damping, measure=measure: find(damping, 1800.0).measure(measure)
        derivative = jax.jit(jax.grad(evaluate))(120.0)
        np.testing.assert_allclose(derivative, jax.grad(evaluate)(120.0), rtol=2e-8)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="sets the number of cores")
def test_a_search_inside_jit_does_not_wait_for_its_own_threads():
    """On one core, where a walk would wait for ever, there is none."""
    code = """
    import os, sys
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:int(sys.argv[1])])
    import jax, numpy as np, vrw_jax as vrw
    vrw.start_jax()
    draw = np.random.default_rng(7).uniform
    wheels = [draw(*ends, 60) for ends in ((20, 300), (800, 3000), (0.05, 0.3))]
    options = vrw.CycleOptions(mesh_intervals=(40, 32, 16))
    wheel = lambda c, k, slope: vrw.WheelParams(damping=c, stiffness=k, slope=slope)
    find = lambda *values: vrw.limit_cycle(wheel(*values), options=options).found
    print(jax.jit(jax.vmap(find))(*wheels).sum())
    """
    counts = [
        int(
            subprocess.run(
                [sys.executable, "-c", textwrap.dedent(code), n_cores],
                capture_output=True, text=True, timeout=400, check=True,
            ).stdout
        )
        for n_cores in "12"
    ]  # fmt: skip
    assert 0 < counts[0] < counts[1]


def test_a_missing_cycle_is_an_outcome_with_zeros_and_leaves_the_batch_unchanged():
    rows = np.stack([table_1(), table_1(slope=0.02), table_1(damping=np.nan)])
    for transform in (jax.jacfwd, jax.grad):
        names = DIFFERENTIATED_MEASURES if transform is jax.jacfwd else ("dls_fraction",)
        derivatives, cycle = differentiate_measures(rows, None, names, transform)
        expected = [Outcome.STEPPED, Outcome.NO_CYCLE_FOUND, Outcome.BAD_INPUT]
        assert list(np.asarray(cycle.outcome)) == expected
        assert np.all(np.asarray(cycle.section_state)[1:] == 0.0)
        assert all(np.all(np.asarray(leaf)[1:] == 0.0) for leaf in jax.tree.leaves(derivatives))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(cycle))
        np.testing.assert_allclose(
            cycle.durations[0], find_reference_cycles().durations[0], rtol=1e-12
        )


@pytest.mark.parametrize(
    ("changes", "outcome", "words"),
    [
        (
            {"damping": 240.0},
            Outcome.EVENT_ORDER_MISMATCH,
            "in double support, the ground would have to pull on the rear foot",
        ),
        (
            {"damping": 15.0, "stiffness": 1117.9, "natural_length": 1.0302, "slope": 0.08},
            Outcome.EVENT_ORDER_MISMATCH,
            "in double support, the ground would have to pull on the fore foot",
        ),
        (
            {"damping": 40.0, "stiffness": 600.0, "natural_length": 1.04, "slope": 0.33},
            Outcome.BRANCH_ENDS_BEFORE_TARGET,
            "just after the landing, the force on the rear foot would contradict the presence",
        ),
        (
            {"slope": 0.5},
            Outcome.BRANCH_ENDS_BEFORE_TARGET,
            "in double support, the ground would have to pull on the rear foot",
        ),
        ({"slope": 0.02}, Outcome.NO_CYCLE_FOUND, "did not converge"),
    ],
)
def test_causes_of_a_missing_gait_have_different_outcomes(changes, outcome, words):
    cycle = vrw.limit_cycle(vrw.WheelParams(**changes))
    assert int(cycle.outcome) == outcome
    assert words in cycle.ending
    assert cycle.why.startswith(cycle.ending)
    assert cycle.why in repr(cycle)


@pytest.mark.parametrize(
    ("name", "value", "borders", "words"),
    [
        # The paper finds gaits at 219 and at 5 N s/m, and none at 220 and at 4 N s/m.
        (
            "damping",
            300.0,
            (219.0, 220.0),
            ("pull on the rear foot", "λ4", "just after the landing"),
        ),
        ("damping", 3.0, (4.0, 5.0), ("pull on the fore foot", "λ2", "just after the landing")),
        # Near rest a period has no upper bound.
        *mark_slow(("slope", 0.05, (0.1, 0.11), ("the wheel would stop", "θ̇", "of this phase"))),
    ],
)
def test_a_missing_gait_is_explained_by_the_last_wheel_with_a_gait(name, value, borders, words):
    """The reference are the borders of the paper, and the library's search on both sides."""
    why = vrw.limit_cycle(vrw.WheelParams(**{name: value})).why
    assert all(word in why for word in words)
    last_value = float(re.search(rf"last gait found has {name} ([0-9.]+)", why)[1])
    assert borders[0] < last_value < borders[1]
    assert bool(vrw.limit_cycle(vrw.WheelParams(**{name: last_value})).found)


def test_no_gait_can_exist_on_ground_that_does_not_descend():
    """In a gait, impacts take energy in each step, and only descent supplies energy."""
    for model in (vrw.ViscoelasticWheel(), vrw.RigidWheel()):
        for slope in (0.0, -0.1):
            cycle = vrw.limit_cycle(vrw.WheelParams(slope=slope), model=model)
            assert "No steady gait can exist: the slope is" in cycle.why


@pytest.mark.parametrize(
    ("slope", "words"), [(0.05, "doesn't pass the vertical"), (0.6, "pull on the foot")]
)
def test_the_rigid_wheel_states_why_its_only_rolling_motion_fails(slope, words):
    params, wheel = vrw.WheelParams(slope=slope), vrw.RigidWheel()
    assert words in vrw.limit_cycle(params, model=wheel).why
    # The reference is a walk: it ends in the way that the sentence states.
    walk = vrw.walk(params, wheel.compute_default_start(params), 5, model=wheel)
    outcomes = {0.05: Outcome.FELL_BACK, 0.6: Outcome.LEG_1_LIFTED_OFF}
    assert outcomes[slope] in np.asarray(walk.steps.outcome)


def test_a_batch_has_the_ending_of_each_wheel_alone():
    slopes = [0.30, 0.5, 0.02]
    batch = vrw.limit_cycles(vrw.WheelParams(slope=np.array(slopes)))
    endings = [vrw.limit_cycle(vrw.WheelParams(slope=slope)).ending for slope in slopes]
    assert batch.ending.tolist() == batch.why.tolist() == endings
    assert len(set(endings)) == 3


def test_a_missing_gait_is_nan_in_value_and_derivative_on_request():
    fraction = lambda c, **how: vrw.limit_cycle(vrw.WheelParams(damping=c), **how).dls_fraction
    value_and_gradient = jax.value_and_grad(lambda c: fraction(c, on_failure="nan"))
    assert all(map(np.isnan, value_and_gradient(240.0)))
    np.testing.assert_array_equal(value_and_gradient(150.0), jax.value_and_grad(fraction)(150.0))
    assert [float(x) for x in jax.value_and_grad(fraction)(240.0)] == [0.0, 0.0]
    margin = lambda c: vrw.limit_cycle(vrw.WheelParams(damping=c), on_failure="nan").spectral_margin
    assert all(map(np.isnan, jax.value_and_grad(margin)(240.0)))
    cycle = vrw.limit_cycle(vrw.WheelParams(damping=240.0), on_failure="nan")
    result = cycle.measures(
        ("spectral_margin", "stability_margin", "takeoff_acceleration", "speed")
    )
    assert all(np.isnan(value) for value in result.values())


@pytest.mark.slow  # compiles reverse derivatives of a cycle twice
def test_step_and_cycle_agree_on_the_smooth_margin():
    of_cycle = lambda params: vrw.limit_cycle(params).takeoff_acceleration

    def of_step(params):
        cycle = vrw.limit_cycle(params)
        return vrw.step(params, cycle.section_state).margins.takeoff_acceleration

    wheel = vrw.WheelParams(damping=150.0)
    ours, theirs = (jax.value_and_grad(of_values)(wheel) for of_values in (of_step, of_cycle))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7)
    assert ours[0] > 0.0 > of_step(vrw.WheelParams(damping=100.0))  # where foot 2 scuffs


def test_too_coarse_a_mesh_is_reported_and_a_finer_one_finds_the_gait():
    row = table_1(slope=0.12)
    coarse, fine = (
        jax.tree.map(lambda x: x[0], differentiate_measures(row, options)[1])
        for options in (vrw.CycleOptions(), TIGHT_OPTIONS)
    )
    assert int(coarse.outcome) == Outcome.MESH_TOO_COARSE
    assert "more intervals" in coarse.why
    assert int(fine.outcome) == Outcome.STEPPED


def test_gait_without_double_support_is_found_though_unstable():
    row = table_1(
        natural_length=1.03163159, stiffness=529.980645, damping=179.091443, slope=0.314288553
    )
    _, cycle = differentiate_measures(row)
    assert int(cycle.outcome[0]) == Outcome.STEPPED
    assert float(cycle.durations[0, 0]) == 0.0
    assert float(cycle.indicators.lambda_4[0]) < 0.0
    assert float(small_matrices.compute_spectral_radius(cycle.monodromy_value[0])) > 1.6
    options = vrw.StepOptions.tight()
    back = vrw.return_map(reference_values.make_wheel(row), cycle.section_state[0], options=options)
    np.testing.assert_allclose(back, cycle.section_state[0], atol=1e-8)


def test_a_wheel_twice_as_large_has_a_period_longer_by_root_two():
    length = 2.0
    large = table_1(
        leg_com=0.3 * length,
        locked_length=length,
        natural_length=1.02 * length,
        stiffness=500.0 / length,
        damping=200.0 / np.sqrt(length),
    )
    _, cycle = differentiate_measures(np.stack([table_1(), large]))
    expected = np.sqrt(length) * cycle.durations[0]
    np.testing.assert_allclose(cycle.durations[1], expected, rtol=1e-9)


def test_a_neighboring_cycle_is_a_faster_initial_guess():
    first = vrw.limit_cycle(vrw.WheelParams())
    second = vrw.limit_cycle(vrw.WheelParams(damping=202.0), guess=first)
    assert int(second.outcome) == Outcome.STEPPED
    assert int(second.n_newton_iterations) <= 4
    cold = vrw.limit_cycle(vrw.WheelParams(damping=202.0))
    np.testing.assert_allclose(second.section_state, cold.section_state, rtol=1e-11)


@pytest.mark.slow
def test_long_double_support_is_found_if_round_off_exceeds_the_tolerance():
    draw, n = np.random.default_rng(5).uniform, 64
    wheel = vrw.WheelParams(damping=draw(50.0, 130.0, n), stiffness=draw(203.0, 215.0, n))
    params = jax.tree.map(lambda x: jnp.broadcast_to(x, n), wheel)
    first_cycles = vrw.limit_cycles(params)
    assert np.max(first_cycles.durations[:, 0]) > 3.0
    fine = vrw.CycleOptions.tight().refine_mesh().refine_mesh()
    find_again = jax.vmap(lambda p, x: vrw.limit_cycle(p, guess=x, options=fine))
    solution = find_again(params, first_cycles.section_state).found
    np.testing.assert_array_equal(solution, first_cycles.found)


def test_a_cycle_walked_twice_has_the_multipliers_squared():
    once = vrw.limit_cycle(vrw.WheelParams())
    twice = vrw.limit_cycle(vrw.WheelParams(), guess=once, period_n=2)
    assert int(twice.outcome) == Outcome.STEPPED
    np.testing.assert_allclose(twice.multipliers, once.multipliers**2, rtol=1e-10)
    np.testing.assert_allclose(twice.durations, np.tile(once.durations, (2, 1)), rtol=1e-9)
    np.testing.assert_allclose(twice.dls_fraction, once.dls_fraction, rtol=1e-9)
    assert (int(once.minimal_period), int(twice.minimal_period)) == (1, 1)
    assert "repeats after 2 steps; its minimal period is 1" in str(twice)


@pytest.mark.slow
def test_beyond_the_discontinuity_a_cycle_of_five_steps_is_found_from_a_walk():
    # At c = 221 one step in five has no double support: found next to where a walk ends up.
    params = vrw.WheelParams(damping=221.0)
    walk = vrw.walk(params, vrw.paper_start(), 60)
    end = walk.steps.section_state[-1]
    five = vrw.limit_cycle(params, guess=end, period_n=5)
    assert int(five.outcome) == Outcome.STEPPED
    assert int(five.minimal_period) == 5
    np.testing.assert_allclose(five.section_state, end, atol=1e-8)
    assert np.sum(np.asarray(five.durations)[:, 0] == 0.0) == 1
    x = five.section_state
    for _ in range(5):
        x = vrw.return_map(params, x, options=vrw.StepOptions.tight())
    np.testing.assert_allclose(x, five.section_state, atol=1e-9)
    assert float(five.spectral_radius) < 1.0


def test_another_model_is_solved_on_its_own_return_map():
    params, model = vrw.WheelParams(slope=0.1), vrw.RigidWheel()
    cycle = vrw.limit_cycle(params, model=model)
    assert int(cycle.outcome) == Outcome.STEPPED
    back = vrw.return_map(params, cycle.section_state, model=model)
    np.testing.assert_allclose(back, cycle.section_state, rtol=1e-12)
    # Energy gained over a step is what the landing takes: the kept rate squared is the multiplier.
    rate_ratio = cycle.post_impact[1] / cycle.section_state[1]
    np.testing.assert_allclose(cycle.spectral_radius, rate_ratio**2, rtol=1e-10)
    assert float(cycle.dls_fraction) == 0.0
    cycle_without_gait = vrw.limit_cycle(vrw.WheelParams(slope=0.02), model=model)
    assert int(cycle_without_gait.outcome) == Outcome.NO_CYCLE_FOUND
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(cycle_without_gait))


@pytest.mark.slow
def test_sensitivities_of_another_model_are_central_differences():
    params, model = vrw.WheelParams(slope=0.1), vrw.RigidWheel()
    table = vrw.sensitivities(params, model=model, measures=("period", "speed"))
    above, below = (
        vrw.limit_cycle(vrw.WheelParams(slope=0.1 + h), model=model) for h in (1e-5, -1e-5)
    )
    for name in ("period", "speed"):
        difference = (getattr(above, name) - getattr(below, name)) / 2e-5
        solution = table.derivative.sel(measure=name, parameter="slope")
        np.testing.assert_allclose(
            solution, difference, rtol=1e-7
        )  # error of differences: h squared


def test_options_of_the_wrong_type_are_refused_in_one_sentence():
    with pytest.raises(TypeError, match="CycleOptions"):
        vrw.limit_cycle(vrw.WheelParams(), options=vrw.StepOptions())
    with pytest.raises(TypeError, match="return map"):
        vrw.limit_cycle(vrw.WheelParams(), model=vrw.RigidWheel(), options=TIGHT_OPTIONS)
    with pytest.raises(ValueError, match="at least 1"):
        vrw.limit_cycle(vrw.WheelParams(), period_n=0)


def make_simplest_walker(slope):
    """Return the map of Garcia et al. 1998 just after heel strike, of stance angle and rate."""

    def field(y):
        theta, phi, dtheta, dphi = y
        ddtheta = jnp.sin(theta - slope)
        ddphi = ddtheta + dtheta * dtheta * jnp.sin(phi) - jnp.cos(theta - slope) * jnp.sin(phi)
        return jnp.stack([dtheta, dphi, ddtheta, ddphi])

    def runge_kutta(y, h):
        k1 = field(y)
        k2 = field(y + 0.5 * h * k1)
        k3 = field(y + 0.5 * h * k2)
        k4 = field(y + h * k3)
        return y + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)

    def flow(y, time, n_steps=1200):
        march = lambda y, _: (runge_kutta(y, time / n_steps), None)
        return jax.lax.scan(march, y, None, length=n_steps)[0]

    def step(x, time):
        theta, dtheta = x
        y = jnp.stack([theta, 2.0 * theta, dtheta, (1.0 - jnp.cos(2.0 * theta)) * dtheta])
        for _ in range(6):  # heel strike: phi = 2 theta
            end = flow(y, time)
            gap, rate = end[1] - 2.0 * end[0], field(end)[1] - 2.0 * field(end)[0]
            time = time - gap / rate
        end = flow(y, time)
        return jnp.stack([-end[0], jnp.cos(2.0 * end[0]) * end[2]])

    return step


@pytest.mark.parametrize(
    ("x", "time", "multipliers"),
    [
        (
            (0.200310900544, -0.199832473005),
            3.88246375285,
            (-0.19009984107 + 0.55759877668j, -0.19009984107 - 0.55759877668j),
        ),
        ((0.193937369810, -0.203866927442), 3.09610586808, (4.00386435893, 0.45958958980)),
    ],
)
def test_section_newton_finds_the_simplest_walkers_published_cycles(x, time, multipliers):
    step = make_simplest_walker(0.009)
    start = jnp.asarray(x) * 1.002
    cycle = jax.jit(lambda start: vrw.solve_fixed_point(lambda y: step(y, time), start))(start)
    assert bool(cycle.converged)
    np.testing.assert_allclose(cycle.x, x, atol=1e-9)
    solution = np.sort_complex(np.asarray(small_matrices.floquet_multipliers(cycle.jacobian)))
    np.testing.assert_allclose(solution, np.sort_complex(np.asarray(multipliers)), atol=3e-9)


def test_section_newton_differentiates_fixed_point_and_multiplier():
    """x -> a - x^2 repeats x = (sqrt(1 + 4 a) - 1) / 2, with the multiplier -2 x."""

    def evaluate(a, start=0.5):
        fixed_point = vrw.solve_fixed_point(lambda x: a - x**2, jnp.asarray([start]))
        return jnp.stack([fixed_point.x[0], fixed_point.jacobian[0, 0]])

    a = 0.7
    root = math.sqrt(1.0 + 4.0 * a)
    expected = np.array([(root - 1.0) / 2.0, 1.0 / root, -2.0 / root**3, 12.0 / root**5])
    first, second = jax.jacfwd(evaluate), jax.jit(jax.jacfwd(jax.jacrev(evaluate)))
    for function, value in zip((evaluate, first), expected, strict=False):
        np.testing.assert_allclose(function(a), [value, -2.0 * value], rtol=1e-13)
    further = [second(a)[0], jax.jit(jax.jacfwd(second))(a)[0]]  # of the point alone
    np.testing.assert_allclose(further, expected[2:], rtol=1e-12)
    np.testing.assert_allclose(
        jax.jit(jax.grad(lambda a: evaluate(a)[0]))(a), expected[1], rtol=1e-13
    )
    many = jax.vmap(first)(jnp.asarray([0.1, a, 2.0]))
    np.testing.assert_allclose(many[1], [expected[1], -2.0 * expected[1]], rtol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_multipliers_of_a_fixed_point_are_the_eigenvalues_of_its_jacobian(n):
    matrix = np.random.default_rng(n).uniform(-0.5, 0.5, (n, n))
    result = vrw.solve_fixed_point(lambda x: matrix @ x + 1.0, jnp.zeros(n))
    known = np.linalg.eigvals(matrix)
    moduli = np.abs(result.multipliers)
    assert np.all(np.diff(moduli) <= 1e-12)  # round-off of conjugate pairs
    np.testing.assert_allclose(
        np.sort_complex(result.multipliers),
        np.sort_complex(known),
        atol=1e-12,  # round-off
    )
    lost = result._replace(jacobian=jnp.full((n, n), jnp.nan))
    assert np.isnan(lost.multipliers).all()


def test_a_fixed_point_moves_without_second_derivatives_of_its_map():
    """Its point has derivatives to third order; that of its multiplier is NaN."""
    compute_found = lambda a: vrw.solve_fixed_point(
        lambda x: a - x**2, jnp.asarray([0.5]), differentiates_jacobian=False
    )
    point, a = lambda a: compute_found(a).x[0], 0.7
    root = math.sqrt(1.0 + 4.0 * a)
    expected = [(root - 1.0) / 2.0, 1.0 / root, -2.0 / root**3, 12.0 / root**5]
    for value in expected:
        np.testing.assert_allclose(point(a), value, rtol=1e-12)
        point = jax.jacrev(point) if value > 0.7 else jax.jacfwd(point)
    assert np.isnan(jax.jacfwd(lambda a: compute_found(a).jacobian)(a)).all()
    np.testing.assert_allclose(compute_found(a).jacobian, [[1.0 - root]], rtol=1e-13)


def test_section_newton_returns_a_start_from_which_it_does_not_converge():
    def evaluate(a):
        fixed_point = vrw.solve_fixed_point(
            lambda x: x + jnp.exp(-a * x), jnp.asarray([2.0])
        )  # repeats none
        return fixed_point.x[0], fixed_point.converged

    value, slope = jax.jvp(evaluate, (1.0,), (1.0,))
    for x, converged in (evaluate(1.0), value):
        assert (float(x), bool(converged)) == (2.0, False)
    assert float(slope[0]) == 0.0


@pytest.mark.parametrize("u", [1e-13, 1.0, 1e6])
def test_section_newton_is_accurate_in_all_units(u):
    """x/u = cos(x/u) is solved by Dottie's number, from a start 35 % off it."""
    cycle = vrw.solve_fixed_point(lambda x: u * jnp.cos(x / u), jnp.array([u]))
    assert cycle.converged
    np.testing.assert_allclose(cycle.x / u, 0.7390851332151607, rtol=1e-15)
    far = vrw.solve_fixed_point(lambda x: u * jnp.cos(x / u), jnp.zeros(1), max_iterations=2)
    assert not far.converged


def test_section_newton_measures_each_component_in_its_own_unit():
    units = jnp.array([1e-13, 1e6])
    step = lambda x: units * jnp.stack([jnp.cos(x[1] / 1e6), 0.5 * jnp.sin(x[0] / 1e-13)])
    cycle = vrw.solve_fixed_point(step, 0.5 * units)
    assert cycle.converged
    np.testing.assert_allclose(step(cycle.x), cycle.x, rtol=1e-15)


def test_section_newton_accepts_a_component_that_is_only_round_off():
    step = lambda x: jnp.stack(
        [jnp.cos(x[0]), 0.5 * x[1] + jnp.cos(x[0]) ** 2 + jnp.sin(x[0]) ** 2 - 1.0]
    )
    cycle = vrw.solve_fixed_point(step, jnp.array([0.7, 1e-17]))
    assert cycle.converged
    assert abs(cycle.x[1]) < 1e-15


@pytest.mark.parametrize(
    ("function", "start"),
    [
        (lambda x: jnp.stack([x[0], 0.5 * x[1]]), [0.7, 0.0]),  # x[0] is conserved
        (lambda x: jnp.stack([x[0], 0.5 * x[1]]), [0.7, 0.1]),
        (lambda x: x + x**2, [0.0]),  # a fold
    ],
)
def test_section_newton_names_a_multiplier_of_1(function, start):
    cycle = vrw.solve_fixed_point(function, jnp.array(start))
    assert "multiplier is 1, which a conserved quantity or a fold causes" in cycle.ending
    assert "start nearer" not in cycle.ending


@pytest.mark.slow
def test_section_newton_agrees_with_the_collocation():
    params = vrw.WheelParams()
    exact = vrw.limit_cycle(params, options=TIGHT_OPTIONS)
    options = vrw.StepOptions.tight()
    step = lambda x: vrw.return_map(params, x, options=options)
    start = exact.section_state * 1.01
    cycle = jax.jit(lambda start: vrw.solve_fixed_point(step, start))(start)
    np.testing.assert_allclose(cycle.x, exact.section_state, rtol=3e-12)
    solution = small_matrices.floquet_multipliers(cycle.jacobian)
    np.testing.assert_allclose(np.abs(solution[:2]), np.abs(exact.multipliers), rtol=1e-9)
    assert abs(solution[2]) < 1e-9  # the section before touchdown adds a multiplier of zero


def test_sensitivities_are_labeled_and_agree_with_the_reference(tmp_path):
    table = vrw.sensitivities(vrw.WheelParams(), measures=("dls_fraction", "period"))
    assert_netcdf_round_trip(table, tmp_path)
    expected = reference_values.to_floats(
        reference_values.REFERENCE_CASES[0]["cycle"]["d_params"]["dls_fraction"]
    )
    order = [list(PARAMETER_NAMES).index(str(name)) for name in table.parameter.values]
    np.testing.assert_allclose(
        table.derivative.sel(measure="dls_fraction"), expected[order], rtol=1e-8, atol=1e-10
    )
    share = float(table.value.sel(measure="dls_fraction"))
    elasticity = table.elasticity.sel(measure="dls_fraction", parameter="damping")
    np.testing.assert_allclose(elasticity, 1.14691014e-4 * 200.0 / share, rtol=1e-6)


def test_unknown_measure_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="choose among these"):
        vrw.sensitivities(vrw.WheelParams(), measures=("dls_fractoin",))


def test_wheels_and_parameter_vectors_convert_into_each_other():
    wheel = make_wheel_from_parameters(jnp.asarray(reference_values.REFERENCE_PARAMETERS[1]), 8)
    assert float(wheel.damping) == 100.0


@pytest.mark.slow
def test_a_search_by_xla_agrees_with_machine_code(monkeypatch):
    """Easy wheels, one that needs the homotopy, one without double support, one without a gait."""
    rows = np.tile(reference_values.REFERENCE_PARAMETERS[0], (70, 1))  # more than a block
    column = PARAMETER_NAMES.index
    rows[:, column("damping")] = np.linspace(120.0, 215.0, 70)
    rows[3, [column("damping"), column("slope")]] = 40.0, 0.33
    rows[5, column("slope")] = 0.05

    def evaluate(parameter_rows):
        one = lambda vector: vrw.limit_cycle(reference_values.make_wheel(vector))
        period = lambda vector: one(vector).period
        margin = lambda vector: one(vector).stability_margin
        cycle = jax.vmap(one)(parameter_rows)
        slopes, second = (jax.vmap(jax.grad(f))(parameter_rows) for f in (period, margin))
        return (
            cycle.durations,
            cycle.monodromy_value,
            slopes,
            second,
            cycle.outcome,
            cycle.n_newton_iterations,
        )

    *solution, outcome, passes = jax.jit(evaluate)(rows)
    disable_machine_code(monkeypatch)
    *by_xla, code, n = jax.jit(lambda parameter_rows: evaluate(parameter_rows))(rows)
    np.testing.assert_array_equal(code, outcome)
    np.testing.assert_array_equal(n, passes)
    for a, b in zip(by_xla, solution, strict=True):
        # Newton's last correction is some 1e-14; what derivatives make of rounding.
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)

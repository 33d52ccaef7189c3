"""Gaits with unilateral contact: sensitivities, branches, scans and tuning."""

import math
import re
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.machine_code import disable_machine_code
from support.slow_variants import ENGINES, mark_slow

import vrw_jax as vrw
from vrw_jax.base.small_matrices import compute_jury_margins
from vrw_jax.branches.branch import evaluate_bifurcations
from vrw_jax.continuation import floquet_multipliers
from vrw_jax.gaits import unilateral_finder as on_ground
from vrw_jax.models import contact_walks as ground_lanes
from vrw_jax.models import embed_section_states, step_batch_with_jacobian
from vrw_jax.wheel import PARAMETER_NAMES

START = (0.1, 1.6, -0.1)
SLOW_WHEEL = vrw.WheelParams(damping=300.0)
GROUND_MODEL = vrw.UnilateralWheel(friction=0.7)
TIGHT_OPTIONS = vrw.StepOptions(rtol=1e-11, atol=1e-11)


@pytest.fixture(scope="module")
def gait_near_slow_start():
    """Return a section state next to the slow gait at c = 300, μ = 0.7."""
    return vrw.walk(
        SLOW_WHEEL, START, 40, model=GROUND_MODEL, options=TIGHT_OPTIONS
    ).steps.section_state[-1]


@pytest.mark.slow
def test_unilateral_sensitivities_equal_difference_quotients_including_friction(
    gait_near_slow_start,
):
    names = ("dls_fraction", "period", "speed", "slip", "energy_lost_friction")
    evaluate = lambda params, model: vrw.sensitivities(
        params, measures=names, guess=gait_near_slow_start, model=model, options=TIGHT_OPTIONS
    )
    table = evaluate(SLOW_WHEEL, GROUND_MODEL)
    assert "friction" in table.parameter
    step = 1e-4
    for name, ends in {
        "damping": [
            evaluate(vrw.WheelParams(damping=300.0 + d), GROUND_MODEL) for d in (step, -step)
        ],
        "friction": [
            evaluate(SLOW_WHEEL, vrw.UnilateralWheel(friction=0.7 + d)) for d in (step, -step)
        ],
    }.items():
        difference = (ends[0].value - ends[1].value) / (2.0 * step)
        solution = table.derivative.sel(parameter=name)
        np.testing.assert_allclose(solution, difference, rtol=2e-5, atol=1e-7)


@pytest.mark.slow
def test_a_gait_within_a_compiled_program_has_the_derivatives_of_sensitivities(
    gait_near_slow_start,
):
    """By Newton's method within JAX's programs; sensitivities have it beside them."""

    def speed(params, friction):
        model = vrw.UnilateralWheel(friction=friction)
        return vrw.limit_cycle(
            params, guess=gait_near_slow_start, model=model, options=TIGHT_OPTIONS
        ).speed

    slopes = jax.jit(jax.value_and_grad(speed, argnums=(0, 1)))
    value, (by_params, by_friction) = slopes(SLOW_WHEEL, 0.7)
    table = vrw.sensitivities(
        SLOW_WHEEL,
        measures=("speed",),
        guess=gait_near_slow_start,
        model=GROUND_MODEL,
        options=TIGHT_OPTIONS,
    ).sel(measure="speed")
    assert float(value) == pytest.approx(float(table.value), abs=1e-11)
    result = jax.tree.leaves(by_params), by_friction
    np.testing.assert_allclose(jnp.stack([*result[0], result[1]]), table.derivative, rtol=1e-8)
    matrix = lambda c: (
        vrw.limit_cycle(
            vrw.WheelParams(damping=c),
            guess=gait_near_slow_start,
            model=GROUND_MODEL,
            options=TIGHT_OPTIONS,
        ).monodromy_value
    )
    unknown = jax.jacfwd(matrix)(300.0)
    assert np.isnan(unknown).all()  # told, and not by a zero


def test_measures_that_unilateral_contact_lacks_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match="choose among these"):
        vrw.sensitivities(SLOW_WHEEL, measures=("lambda_4",), model=GROUND_MODEL)
    with pytest.raises(ValueError, match="does not affect"):
        vrw.scan(vrw.grid(friction=[0.5, 0.7]))
    with pytest.raises(ValueError, match="is no parameter"):
        vrw.continue_branch(vrw.WheelParams(), "friction", (0.5, 1.0))
    with pytest.raises(TypeError, match="compliant legs"):
        vrw.tune(
            SLOW_WHEEL, "speed", ["damping"], {"damping": (250.0, 350.0)}, model=vrw.RigidWheel()
        )


def test_bifurcations_of_larger_maps_are_those_of_the_small_map_inside():
    small = np.array([[0.4, 0.9, 0.1], [-0.7, 0.3, 0.2], [0.1, 0.0, -0.6]])
    large = np.zeros((7, 7))
    large[2:5, 2:5] = small
    solution = np.ravel(list(evaluate_bifurcations(large[None]).values()))
    np.testing.assert_allclose(solution, compute_jury_margins(jnp.asarray(small))[:3], atol=1e-12)
    three = np.asarray(floquet_multipliers(jnp.asarray(large)))[:3]
    exact = np.asarray(floquet_multipliers(jnp.asarray(small)))
    np.testing.assert_allclose(np.sort_complex(three), np.sort_complex(exact), atol=1e-12)


@pytest.mark.slow
def test_a_scan_gives_each_sample_its_simplest_valid_model():
    design = vrw.grid(damping=[150.0, 300.0], friction=[0.7, math.inf])
    measures = ("dls_fraction", "period", "slip")
    scan = vrw.scan(design, measures, model="auto")
    model_names = np.array(scan.rung.attrs["flag_meanings"].split())
    assert model_names[scan.rung].tolist() == [
        ["UnilateralWheel", "ViscoelasticWheel"],
        ["UnilateralWheel", "UnilateralWheel"],
    ]
    paper = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
    np.testing.assert_allclose(scan.period[0, 1], paper.period, atol=1e-9)
    assert float(scan.slip[0, 1]) == 0.0
    ground = vrw.scan(design, (*measures, "d period / d friction"), model=vrw.UnilateralWheel())
    for name in measures:
        np.testing.assert_allclose(scan[name][1], ground[name][1], atol=1e-9)
    # Feet that can't slide give the paper's gait on the upper rung too, but for the microseconds by
    # which a stopper pulls a planted foot.
    np.testing.assert_allclose(scan.period[0, 1], ground.period[0, 1], atol=1e-5)
    assert float(scan.slip[1, 0]) > 0.0
    assert np.isfinite(ground["d period / d friction"][1, 0])


@pytest.mark.slow
@pytest.mark.parametrize(("damping", "friction"), [(182.5, 1.2), (204.2, 0.6), (193.3, 2.4)])
def test_limit_cycle_scan_and_sensitivities_find_the_same_gait(damping, friction):
    """Walks from the rung's own start settle late here, or Newton's method goes elsewhere."""
    params, model = vrw.WheelParams(damping=damping), vrw.UnilateralWheel(friction=friction)
    slowest = vrw.limit_cycle(params, model=model)
    assert bool(slowest.found)
    every = np.atleast_1d(vrw.limit_cycles(params, model=model).spectral_radius)
    assert np.all(every < 1.0)
    design = vrw.grid(damping=[damping], friction=[friction])
    scan = vrw.scan(design, ("period",), model=vrw.UnilateralWheel())
    sensitivity_result = vrw.sensitivities(params, model=model, measures=("period",))
    for period in (scan.period.values[0, 0], sensitivity_result.value.values[0]):
        assert period == pytest.approx(float(slowest.period), abs=1e-8)


@pytest.mark.slow
def test_a_unilateral_branch_consists_of_gaits_that_repeat(gait_near_slow_start):
    cycle = vrw.limit_cycle(
        SLOW_WHEEL, guess=gait_near_slow_start, model=GROUND_MODEL, options=TIGHT_OPTIONS
    )
    branch = vrw.continue_branch(
        SLOW_WHEEL, "friction", (0.65, 0.75), cycle=cycle, model=GROUND_MODEL,
        step_options=TIGHT_OPTIONS,
        options=vrw.ArclengthOptions(initial_ds=0.1, max_ds=0.1),
    )  # fmt: skip
    assert branch.outcome == vrw.Outcome.STEPPED
    assert branch.values.min() == pytest.approx(0.65)
    assert branch.values.max() == pytest.approx(0.75)
    assert float(branch.dataset.closure.max()) < 1e-8
    assert branch.stable.all()
    place = int(np.argmin(np.abs(branch.values - 0.7)))
    slope = (branch.dataset.period[place + 1] - branch.dataset.period[place - 1]) / (
        branch.values[place + 1] - branch.values[place - 1]
    )
    table = vrw.sensitivities(
        SLOW_WHEEL,
        measures=("period",),
        guess=gait_near_slow_start,
        model=GROUND_MODEL,
        options=TIGHT_OPTIONS,
    )
    exact = table.derivative.sel(parameter="friction", measure="period")
    np.testing.assert_allclose(slope, exact, rtol=0.05)


@pytest.mark.slow
def test_a_unilateral_branch_turns_at_its_fold_and_returns_unstable():
    """At Table 1 the slow gait needs friction: two gaits above that, one repelling, none below."""
    params, high = vrw.WheelParams(), vrw.UnilateralWheel(friction=1.0)
    state = vrw.walk(params, START, 300, model=high, options=TIGHT_OPTIONS).steps.section_state[-1]
    cycle = vrw.limit_cycle(params, guess=state, model=high, options=TIGHT_OPTIONS)
    branch = vrw.continue_branch(
        params, "friction", (0.95, 1.0), cycle=cycle, model=high, step_options=TIGHT_OPTIONS,
        options=vrw.ArclengthOptions(initial_ds=0.1, max_ds=0.2),
    )  # fmt: skip
    assert float(branch.dataset.closure.max()) < 1e-8
    (fold,) = (border.value for border in branch.special_points if border.kind == "fold")
    # Continuation by batched steps and central differences in large steps gives this value: a
    # quartic through the seven gaits next to the fold.
    assert fold == pytest.approx(0.98186, abs=1e-4)
    turn = int(np.argmin(branch.values))
    assert 0 < turn < branch.values.size - 1
    assert branch.values[[0, -1]] == pytest.approx([1.0, 1.0])
    before, after = branch.stable[:turn], branch.stable[turn + 1 :]
    assert sorted([before.all(), after.all()]) == [False, True]
    assert not (before if after.all() else after).any()
    # Just below the fold no walk stays: the slow gait is a ghost there.
    low = vrw.UnilateralWheel(friction=fold - 0.1)
    walk = vrw.walk(params, START, 120, model=low, options=TIGHT_OPTIONS).steps
    slow = branch.dataset.period.values.min()
    assert float(jnp.sum(walk.durations[-1])) < 0.9 * slow


@pytest.mark.slow
def test_without_slip_the_multipliers_equal_those_of_the_paper():
    paper = vrw.limit_cycle(vrw.WheelParams())
    model_without_slip = vrw.UnilateralWheel(friction=math.inf, infinite_friction_rule="paper")
    ground = vrw.limit_cycle(
        vrw.WheelParams(), guess=START, model=model_without_slip, options=TIGHT_OPTIONS
    )
    assert int(ground.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(ground.period, paper.period, atol=1e-9)
    largest = lambda cycle: np.sort(np.abs(np.asarray(cycle.multipliers)))[::-1]
    np.testing.assert_allclose(largest(ground)[:2], largest(paper)[:2], atol=1e-7)
    # Legs settle in the air at c / m = 200 per second, so hardly anything else is left of a step.
    np.testing.assert_allclose(largest(ground)[2:], 0.0, atol=1e-6)


@pytest.mark.slow
def test_unilateral_tuning_increases_the_objective_along_the_gradient():
    # Up to here one order of events: next to a border (c = 311.2, slope 0.2944) climbing is slow.
    bounds = {"damping": (280.0, 310.0), "slope": (0.295, 0.31)}
    tuned = vrw.tune(
        SLOW_WHEEL,
        "dls_fraction",
        list(bounds),
        bounds,
        model=GROUND_MODEL,
        options=TIGHT_OPTIONS,
        tolerance=1e-4,
    )
    assert tuned.value > tuned.start_value
    assert tuned.validation.outcome == vrw.Outcome.STEPPED
    for name, sign in (("damping", 1.0), ("slope", -1.0)):
        shifted = vrw.WheelParams(
            **({"damping": 300.0} | {name: getattr(SLOW_WHEEL, name) * 1.001})
        )
        walk = vrw.walk(shifted, START, 60, model=GROUND_MODEL, options=TIGHT_OPTIONS).steps
        share = walk.durations[-1, 0] / jnp.sum(walk.durations[-1])
        assert sign * float(share - tuned.start_value) > 0.0
    assert float(tuned.params.damping) == pytest.approx(310.0)
    assert float(tuned.params.slope) == pytest.approx(0.295)


BATCH_OPTIONS = vrw.StepOptions(solver="Tsit5", rtol=1e-8, atol=1e-8)


@pytest.fixture(scope="module")
def unilateral_batch():
    """Return three steps of several wheels: damping, friction, start and results."""
    damping = np.array([200.0, 300.0, 250.0, 160.0, 60.0, 150.0, 200.0])
    friction = np.array([0.7, 0.7, 1.2, math.inf, math.inf, math.nan, 0.3])
    states = np.tile(START, (len(damping), 1))
    states[0, 1] = 2.0

    def walked(selection):
        return vrw.step_batch(
            vrw.WheelParams(damping=damping[selection]),
            states[selection],
            3,
            model=vrw.UnilateralWheel(friction=friction[selection]),
            options=BATCH_OPTIONS,
        )

    return damping, friction, states, walked


@pytest.mark.parametrize("engine", ENGINES)
def test_unilateral_batches_equal_single_wheels(unilateral_batch, engine):
    damping, friction, states, walk_result = unilateral_batch
    solution = walk_result(slice(None))
    assert solution.engine == "lanes"
    for i in range(len(damping)):
        if math.isnan(friction[i]):
            continue  # a lone wheel of that friction is refused
        ground = vrw.UnilateralWheel(friction=friction[i])
        params, x, count = vrw.WheelParams(damping=damping[i]), states[i], 0
        while True:  # step by step: other tests have the program
            step = vrw.step(params, x, model=ground, options=TIGHT_OPTIONS, engine=engine)
            x, count = step.section_state, count + int(step.outcome == vrw.Outcome.STEPPED)
            if step.outcome != vrw.Outcome.STEPPED or count == 3:
                break
        assert int(solution.outcome[i]) == int(step.outcome)
        assert int(solution.n_stepped[i]) == count
        np.testing.assert_allclose(solution.section_state[i], x, atol=2e-7)
        np.testing.assert_allclose(solution.durations[i], step.durations, atol=5e-8)
    assert int(solution.outcome[5]) == vrw.Outcome.BAD_INPUT
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(solution))


@pytest.mark.slow
def test_unilateral_batches_at_tight_tolerances_equal_single_wheels():
    params, ground = vrw.WheelParams(damping=100.0), vrw.UnilateralWheel(friction=1.0)
    given = {"model": ground, "options": vrw.StepOptions.tight()}
    batch_result = vrw.step_batch(params, np.asarray([START]), 10, **given)
    walk = vrw.walk(params, START, 10, engine="diffrax", **given)
    assert int(batch_result.n_stepped[0]) == int(walk.n_stepped) == 10
    np.testing.assert_allclose(batch_result.durations[0], walk.steps.durations[-1], atol=1e-9)
    np.testing.assert_allclose(
        batch_result.section_state[0], walk.steps.section_state[-1], atol=1e-8
    )


def test_an_impossible_start_has_the_outcome_bad_input():
    """By geometry: Leg 1 at an angle below 0 leaves the next foot in the ground, above half of that
    between legs Leg 1 would be longer than its stopper lets it be."""
    starts = [(0.1, 1.6, -0.1), (-0.05, 1.6, -0.1), (0.4, 1.6, -0.1)]
    full = np.array(
        [GROUND_MODEL.complete_section_state(SLOW_WHEEL, jnp.asarray(x)) for x in starts]
    )
    free, state_on_stopper, near = (full[0].copy() for _ in range(3))
    free[4 + 2 * 8 + 2], free[4 + 2] = 0.0, 1.01  # a leg in the air off its stopper, too long
    state_on_stopper[4 + 2 * 8] = 5.0  # the loaded leg on its stopper: its foot is in the ground
    near[4 + 2 * 8 + 2], near[4 + 2] = 0.0, 1.0005  # by no more than Newton's method may be wrong
    batch_result = vrw.step_batch(
        SLOW_WHEEL,
        np.stack([*full, free, state_on_stopper, near]),
        1,
        model=GROUND_MODEL,
        options=TIGHT_OPTIONS,
    )
    refused = [False, True, True, True, True, False]
    assert np.array_equal(batch_result.outcome == vrw.Outcome.BAD_INPUT, refused)
    assert np.array_equal(batch_result.outcome == vrw.Outcome.STEPPED, np.logical_not(refused))


def test_the_result_of_a_batch_element_does_not_depend_on_the_others(unilateral_batch):
    *_, walk_result = unilateral_batch
    joint_result, single_result = walk_result(slice(None)), walk_result(slice(1, 2))
    for a, b in zip(jax.tree.leaves(joint_result), jax.tree.leaves(single_result), strict=True):
        np.testing.assert_array_equal(a[1], b[0])


def test_independent_rates_and_their_shares_do_not_depend_on_other_batch_elements():
    """Of projections, which feet leave of other ranks: their columns are sums of the kept ones."""
    method_names = np.random.default_rng(0).normal(size=(12, 11, 11))
    bases = [
        np.linalg.qr(method_name[:, : 4 + k % 6])[0] for k, method_name in enumerate(method_names)
    ]
    settled, requested = np.stack([b @ b.T for b in bases]), np.ones((12, 11), bool)
    find_rates = ground_lanes._IndependentStartRates.from_rate_projection
    joint_result = find_rates(settled, requested, np.ones((12, 11)))
    for k, basis in enumerate(bases):
        single_result = find_rates(settled[[k]], requested[[k]], np.ones((1, 11)))
        n = basis.shape[1]
        weights = single_result.combination_weights[0]
        np.testing.assert_array_equal(joint_result.combination_weights[k], weights)
        assert not weights[n:].any()
        independent_tangents = settled[k][:, joint_result.independent_rate_indices[k, :n]]
        # Largest in thirty such sets: 4e-16.
        np.testing.assert_allclose(
            independent_tangents @ weights[:n], settled[k], rtol=0, atol=1e-14
        )


@pytest.mark.slow
def test_derivatives_of_a_batch_element_do_not_depend_on_the_others(unilateral_batch):
    """Beside wheels with other events, and with more directions than one lane carries."""
    damping, friction, states, _ = unilateral_batch
    selection = [0, 1, 2, 4, 6]

    values = np.tile(
        np.asarray(GROUND_MODEL.collect_parameter_values(SLOW_WHEEL))[:, None], len(damping)
    )
    values[PARAMETER_NAMES.index("damping")], values[-1] = damping, friction
    x = embed_section_states(values, states, 8)
    x[:, 4 + 16 + 3 : 4 + 16 + 6] = 0.0  # legs off their stoppers
    shift = lambda places: step_batch_with_jacobian(
        values[:, places], x[places], GROUND_MODEL, BATCH_OPTIONS, 8
    )
    joint_result, single_result = shift(selection), shift([2])
    assert (np.abs(joint_result[1].section_state).sum(1) > 0.0).sum(
        1
    ).max() > ground_lanes.MAX_TANGENTS_PER_LANE
    for a, b in zip(jax.tree.leaves(joint_result), jax.tree.leaves(single_result), strict=True):
        np.testing.assert_array_equal(a[2], b[0])


@pytest.mark.slow
def test_integration_by_xla_agrees_with_machine_code(unilateral_batch, monkeypatch):
    *_, walk_result = unilateral_batch
    solution = walk_result(slice(None))
    disable_machine_code(monkeypatch)
    by_xla = walk_result(slice(None))
    np.testing.assert_array_equal(by_xla.outcome, solution.outcome)
    # Rounding alone tells them apart, grown by the events of three steps.
    np.testing.assert_allclose(by_xla.section_state, solution.section_state, rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_xla.durations, solution.durations, rtol=0, atol=1e-9)


def test_an_event_of_a_batch_element_counts_only_within_the_time_limit(unilateral_batch):
    damping, friction, states, _ = unilateral_batch
    within = lambda seconds: vrw.step_batch(
        vrw.WheelParams(damping=damping[1:2]),
        states[1:2],
        model=vrw.UnilateralWheel(friction=friction[1:2]),
        options=eqx.tree_at(lambda o: o.max_phase_time, BATCH_OPTIONS, jnp.asarray(seconds)),
    )
    longest = np.max(within(20.0).durations)
    assert int(within(1.001 * longest).outcome[0]) == vrw.Outcome.STEPPED
    assert int(within(0.999 * longest).outcome[0]) == vrw.Outcome.NO_TOUCHDOWN_IN_TIME


def test_an_implicit_solver_for_a_unilateral_batch_is_refused_in_one_sentence():
    with pytest.raises(ValueError, match="map vrw"):
        vrw.step_batch(
            SLOW_WHEEL,
            np.asarray([START]),
            model=GROUND_MODEL,
            options=vrw.StepOptions(solver="Kvaerno5"),
        )


@pytest.mark.slow
def test_walks_with_infinite_friction_equal_those_with_large_friction():
    """Where the rear foot scuffs, where the gait is the paper's, and where that has none."""
    damping, friction = np.array([50.0, 200.0, 300.0, 2.0]), np.array([math.inf, 1e6])
    wheels = vrw.WheelParams(damping=np.repeat(damping, 2))
    ground = vrw.UnilateralWheel(friction=np.tile(friction, 4))
    batch_result = vrw.step_batch(
        wheels, np.tile(START, (8, 1)), 100, model=ground, options=BATCH_OPTIONS
    )
    assert np.all(np.asarray(batch_result.outcome) == vrw.Outcome.STEPPED)
    period = np.asarray(batch_result.durations).sum(-1).reshape(4, 2)
    np.testing.assert_allclose(period[:, 0], period[:, 1], rtol=2e-6)
    share = np.asarray(batch_result.durations)[0, 0] / period[0, 0]
    # Of an independent simulator at frictions of 10,000 and a million.
    assert period[0, 0] == pytest.approx(0.52296, abs=2e-5)
    assert float(share) == pytest.approx(0.717, abs=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("stoppers", ["bilateral", "one-sided"])
def test_results_approach_infinite_friction_as_the_inverse_of_the_friction(stoppers):
    """Ten steps, over all of which one combination of contacts is admissible.

    Events of one-sided stoppers follow each other ever faster, up to five hundred in a step, and in
    some of them round-off decides whether a stopper opens again, which shifts the end by up to
    3e-6 s. The median over five neighboring starts excludes these steps.
    """
    damping, friction = np.array([20.0, 50.0, 100.0, 150.0, 400.0]), 10.0 ** np.arange(3, 6)
    wheels = vrw.WheelParams(damping=np.repeat(damping, 20))
    ground = vrw.UnilateralWheel(np.tile(np.repeat([*friction, math.inf], 5), 5), 4000, stoppers)
    starts = np.tile(START, (100, 1)) + 1e-10 * np.tile(np.arange(5.0), 20)[:, None]
    options = vrw.StepOptions.tight()
    batch_result = vrw.step_batch(wheels, starts, 10, model=ground, options=options)
    assert np.all(np.asarray(batch_result.outcome) == vrw.Outcome.STEPPED)
    period = np.median(np.asarray(batch_result.durations).sum(-1).reshape(5, 4, 5), axis=-1)
    shares = friction * (period[:, :3] - period[:, 3:])  # s, of the first order in 1 / friction
    np.testing.assert_allclose(shares[:, 1:], shares[:, :2], rtol=0.03)


@pytest.mark.parametrize("friction", [28.0, *mark_slow(29.0, 31.0, 32.0, 34.0)])
def test_a_gait_is_found_if_the_slow_starts_end_in_a_paradox(friction):
    """From the gait of a neighboring friction it is found at once; its spectral radius is 0.13."""
    params = vrw.WheelParams(damping=300.0)
    neighbor = vrw.limit_cycle(params, model=vrw.UnilateralWheel(friction=27.0))
    model = vrw.UnilateralWheel(friction=friction)
    known = vrw.limit_cycle(params, model=model, guess=neighbor)
    cycle = vrw.limit_cycle(params, model=model)
    assert int(cycle.outcome) == vrw.Outcome.STEPPED
    np.testing.assert_allclose(cycle.section_state, known.section_state, atol=1e-10)
    assert float(cycle.spectral_radius) == pytest.approx(0.13, abs=5e-3)


@pytest.mark.slow
def test_slow_and_fast_unilateral_gaits_are_found_without_a_guess(gait_near_slow_start):
    cycles = vrw.limit_cycles(SLOW_WHEEL, model=GROUND_MODEL)
    assert np.asarray(cycles.found).tolist() == [True, True]
    assert np.all(np.asarray(cycles.spectral_radius) < 1.0)
    slow, fast = (
        vrw.limit_cycle(SLOW_WHEEL, model=GROUND_MODEL, which=end) for end in ("slowest", "fastest")
    )
    np.testing.assert_allclose(cycles.period, [slow.period, fast.period], atol=1e-12)
    assert float(fast.speed) > 2.0 * float(slow.speed)
    with pytest.raises(ValueError, match="2 gaits of this wheel attract"):
        vrw.limit_cycle(SLOW_WHEEL, model=GROUND_MODEL, which=2)
    # A gait of one step is none of two.
    assert not bool(vrw.limit_cycle(SLOW_WHEEL, model=GROUND_MODEL, period_n=2).found)
    cycle = vrw.limit_cycle(SLOW_WHEEL, model=GROUND_MODEL, guess=gait_near_slow_start)
    np.testing.assert_allclose(slow.section_state, cycle.section_state, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("stoppers", ["bilateral", "one-sided"])
@pytest.mark.parametrize("scene", [(0.7, 200.0, 1.6), (0.5, 100.0, 1.2), (0.5, 100.0, 2.2)])
def test_a_batched_step_has_measures_and_derivatives_of_a_single_wheel(scene, stoppers):
    friction, damping, rate = scene
    params = vrw.WheelParams(damping=damping)
    ground = vrw.UnilateralWheel(friction=friction, stoppers=stoppers)
    x = np.asarray(ground.complete_section_state(params, jnp.asarray([0.1, rate, -0.1])))
    values = np.asarray(ground.collect_parameter_values(params))
    step, shifted = step_batch_with_jacobian(values[:, None], x[None], ground, TIGHT_OPTIONS, 8)
    is_same, only_value = step_batch_with_jacobian(
        values[:, None], x[None], ground, TIGHT_OPTIONS, 8, [0]
    )  # by damping
    np.testing.assert_array_equal(is_same.section_state, step.section_state)
    np.testing.assert_array_equal(only_value.slip[:, 0], shifted.slip[:, 0])
    assert not only_value.slip[:, 1:].any()
    definition = vrw.StepOptions.tight().with_engine("diffrax")
    shared = stoppers == "one-sided"
    times = lambda durations: durations.sum(keepdims=True) if shared else durations

    def result(c, mu, rate):
        wheel, model = vrw.WheelParams(damping=c), eqx.tree_at(lambda m: m.friction, ground, mu)
        single_result = model.take_step(wheel, jnp.asarray(x).at[1].set(rate), definition)
        return jnp.concatenate(
            [single_result.section_state[:20], times(single_result.durations)]
        ), single_result

    argument_values = [jnp.asarray(v) for v in (damping, friction, x[1])]
    exact, step_result = jax.jacfwd(result, argnums=(0, 1, 2), has_aux=True)(*argument_values)
    for name in ("section_state", "durations", "post_impact", "slip", "energy_impacts",
                 "energy_damping", "energy_friction", "step_length", "mode_durations"):  # fmt: skip
        result = getattr(step, name)[0]
        # One-sided, shares of modes and losses: the least dip lasts 3e-7 s, and rounding says in
        # which mode. Where the step leads, and when, does not affect it.
        share = shared and name.startswith(("durations", "mode", "energy", "slip"))
        near = 5e-7 if share else 1e-8
        np.testing.assert_allclose(
            result, getattr(step_result, name), rtol=near, atol=near, err_msg=name
        )
    assert abs(float(step.durations[0].sum()) - float(step_result.period)) < 1e-10
    assert int(step.events[0]) == int(step_result.events)
    names = (*ground.parameter_names, "theta", "dtheta")
    for name, column in zip(("damping", "friction", "dtheta"), exact, strict=True):
        place = names.index(name)
        solution = shifted.section_state[0, :20, place], times(shifted.durations[0, :, place])
        solution = np.concatenate(solution)
        np.testing.assert_allclose(solution, column, rtol=1e-6, atol=1e-8, err_msg=name)


def test_batched_newton_steps_back_from_states_without_a_complete_step(monkeypatch):
    """A map of one number, x to x^2 / 4 + 1 - a, that is none beyond 3: without wheels."""
    calls = []

    def step(columns, states, *_):
        (a,), x = columns, states[:, 0]
        calls.append(x.copy())
        image, good = 0.25 * x**2 + 1.0 - a, np.abs(x) < 3.0
        state = lambda value: np.stack([value, 0.0 * value], 1)
        by_input = np.zeros((len(x), 2, 3))
        by_input[:, 0, 0], by_input[:, 0, 1] = -1.0, 0.5 * x
        outcome = np.where(good, int(vrw.Outcome.STEPPED), int(vrw.Outcome.FELL_BACK))
        return _StepOutput(np.where(good[:, None], state(image), 0.0), outcome), _StepOutput(
            by_input, None
        )

    monkeypatch.setattr(on_ground, "step_batch_with_jacobian", step)
    monkeypatch.setattr(
        on_ground, "stack_section_units", lambda _, values, __: np.ones((len(values), 2))
    )
    a, begin = np.array([[0.25], [0.75], [-9.0]]), np.array([[1.9, 0.0], [1.5, 0.0], [0.0, 0.0]])
    solution, _ = on_ground.find_contact_fixed_points(
        on_ground.PeriodMap(None, 1, 1, a), vrw.StepOptions(), begin, True
    )
    assert solution.converged.tolist() == [True, True, False]  # the last has no fixed point
    exact = 2.0 - 2.0 * np.sqrt(a[:2, 0])
    np.testing.assert_allclose(solution.x[:2, 0], exact, atol=1e-12)
    np.testing.assert_allclose(solution.residual[:2], 0.0, atol=1e-12)
    assert max(np.abs(x).max() for x in calls) > 3.0  # where it was sent back from


def test_batched_newton_finds_a_repeating_state_next_to_a_jump_of_the_map(monkeypatch):
    """A map of one number, x to x / 2, but below a jump to x / 2 - 1, whose one point is -2. What
    corrections come down to lies behind the jump and repeats nothing: without wheels."""
    jump, begin = 4e-11, 3.6e-9

    def step(columns, states, *_):
        x = states[:, 0]
        behind = x < jump
        by_input = np.zeros((len(x), 2, 3))
        # Before it a wrong slope, by which each correction leaves a sixth: 1e-10 is left of two.
        by_input[:, 0, 1] = np.where(behind, 0.5, 0.4)
        outcome = np.full(len(x), int(vrw.Outcome.STEPPED))
        return _StepOutput(np.stack([0.5 * x - behind, 0.0 * x], 1), outcome), _StepOutput(
            by_input, None
        )

    monkeypatch.setattr(on_ground, "step_batch_with_jacobian", step)
    monkeypatch.setattr(
        on_ground, "stack_section_units", lambda _, values, __: np.ones((len(values), 2))
    )
    solution, _ = on_ground.find_contact_fixed_points(
        on_ground.PeriodMap(None, 1, 1, np.zeros((1, 1))),
        vrw.StepOptions(rtol=1e-10, atol=1e-10),
        np.array([[begin, 0.0]]),
        True,
    )
    assert solution.converged[0]
    assert solution.residual[0] < 1e-10
    assert abs(solution.x[0, 0] + 2.0) < 1e-10


def test_a_singular_linear_system_does_not_affect_the_others():
    matrix = np.stack([np.eye(2), np.zeros((2, 2)), 2.0 * np.eye(2)])
    solution = on_ground.solve_linear_systems(matrix, np.ones((3, 2, 1)))[..., 0]
    np.testing.assert_array_equal(solution, [[1.0, 1.0], [np.nan, np.nan], [0.5, 0.5]])


class _StepOutput(NamedTuple):
    """The fields of a step that Newton's method reads."""

    section_state: np.ndarray
    outcome: np.ndarray | None


def test_the_forces_of_a_gait_balance_gravity_so_that_friction_is_at_least_tan_slope():
    """Over a gait, the impulses of the ground are M g T sin(slope) along it and M g T cos(slope).

    The trapezoidal rule integrates forces between events, and the impulses of the landing are
    added. The other impulse of this gait, at the stopper, is below 1e-4 of the sum.
    """
    section_state = vrw.limit_cycle(SLOW_WHEEL, model=GROUND_MODEL).section_state
    step = GROUND_MODEL.sample_step(SLOW_WHEEL, section_state, vrw.StepOptions(), 401)
    landing = vrw.step(SLOW_WHEEL, section_state, model=GROUND_MODEL)
    integrate = lambda forces: np.trapezoid(np.sum(forces, -1), step.time, axis=-1).sum()
    weight_impulse = (
        (SLOW_WHEEL.hub_mass + 8 * SLOW_WHEEL.leg_mass) * SLOW_WHEEL.gravity * np.sum(step.duration)
    )
    for forces, impulses, direction in (
        (step.tangential, landing.landing_tangential, -math.sin(SLOW_WHEEL.slope)),
        (step.normal, landing.landing_normal, math.cos(SLOW_WHEEL.slope)),
    ):
        ground_impulse = integrate(forces) + np.sum(impulses)
        np.testing.assert_allclose(ground_impulse, weight_impulse * direction, rtol=1e-4)


def test_friction_below_tan_slope_allows_no_gait_alone_and_in_batches():
    slopes = np.array([0.31, 0.15])  # tan(0.31) is 0.3203
    cycles = vrw.limit_cycles(
        vrw.WheelParams(slope=slopes), model=vrw.UnilateralWheel(friction=0.32)
    )
    assert cycles.found.tolist() == [False, True]
    reason = "No steady gait can exist: friction is 0.32, below tan(slope) = 0.3203"
    assert cycles.why[0].startswith(reason)
    alone = vrw.limit_cycle(vrw.WheelParams(slope=0.31), model=vrw.UnilateralWheel(friction=0.32))
    assert alone.why == cycles.why[0]
    assert alone.why in repr(alone)


@pytest.mark.slow
def test_a_missing_gait_with_contact_names_the_last_wheel_with_a_gait():
    why = vrw.limit_cycle(vrw.WheelParams(slope=0.05), model=GROUND_MODEL).why
    last_slope = float(re.search(r"last gait found has slope ([0-9.]+)", why)[1])
    slopes = np.array([last_slope, last_slope - 0.001])
    cycles = vrw.limit_cycles(vrw.WheelParams(slope=slopes), model=GROUND_MODEL)
    assert cycles.found.tolist() == [True, False]
    assert "step 1 from this gait fails: No touchdown" in why

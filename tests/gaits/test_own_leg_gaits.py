"""Gaits of wheels with a law of the legs that a user gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import five_coordinates
from support.leg_laws import (
    BumpStop,
    PaperLeg,
    QuadraticDamper,
    make_progressive_leg,
    make_reference_params,
    make_wheel,
)

import vrw_jax as vrw

PARAMS = vrw.WheelParams(damping=150.0)
SPRING = make_progressive_leg(1000.0, 300.0)
DAMPER_PERIOD_S = 0.764078073
DAMPER_DLS_FRACTION = 0.541628603
DAMPER_SPEED_M_PER_S = 0.929798465
DAMPER_MULTIPLIERS = (0.329805884, 0.023678)
"""Values of two independent codes, for a quadratic damper of 60 N s^2/m^2."""


def find_gait(law, params=PARAMS, **options):
    return vrw.limit_cycle(params, model=make_wheel(law), **options)


def measure_period(c2, damping=150.0):
    return find_gait(QuadraticDamper(c2), vrw.WheelParams(damping=damping)).period


def test_the_gait_with_a_quadratic_damper_is_that_of_two_other_codes():
    cycle = find_gait(QuadraticDamper())
    assert abs(cycle.period - DAMPER_PERIOD_S) < 1e-9
    assert abs(cycle.dls_fraction - DAMPER_DLS_FRACTION) < 1e-9
    assert abs(cycle.speed - DAMPER_SPEED_M_PER_S) < 2e-9  # The other codes agree to this digit.
    np.testing.assert_allclose(cycle.multipliers.real, DAMPER_MULTIPLIERS, atol=1e-6)


def test_the_papers_law_as_a_law_gives_the_papers_gait():
    options = vrw.CycleOptions()
    expected, cycle = (
        vrw.limit_cycle(PARAMS, options=options),
        find_gait(PaperLeg(), options=options),
    )
    for name in ("section_state", "durations", "multipliers"):
        np.testing.assert_allclose(getattr(cycle, name), getattr(expected, name), atol=1e-13)


@pytest.mark.parametrize(
    ("law", "damping"), [(QuadraticDamper(), 150.0), (SPRING, 120.0)], ids=["damper", "spring"]
)
def test_a_gait_is_a_fixed_point_of_five_coordinates(law, damping):
    cycle = find_gait(law, vrw.WheelParams(damping=damping))
    reference_params = make_reference_params(law, damping=damping)
    reference = five_coordinates.step(reference_params, np.asarray(cycle.section_state))
    np.testing.assert_allclose(reference["section_state"], cycle.section_state, atol=1e-11)
    np.testing.assert_allclose(reference["durations"], cycle.durations, atol=1e-10)


def test_a_gait_with_a_kink_is_more_accurate_than_the_mesh():
    """The reference is 200 steps with tight tolerances, in which the gait attracts the wheel."""
    model = make_wheel(BumpStop(100.0))
    cycle = vrw.limit_cycle(PARAMS, model=model)
    start, options = np.array([[0.11, 1.85, -0.1]]), vrw.StepOptions.tight()
    walk = vrw.step_batch(PARAMS, start, 200, model=model, options=options)
    np.testing.assert_allclose(cycle.section_state, walk.section_state[0], atol=1e-10)


@pytest.mark.slow
def test_derivatives_of_a_gait_with_a_kink_are_differences_of_gaits():
    def measure_kinked_period(k2):
        return find_gait(BumpStop(k2)).period

    difference = (measure_kinked_period(101.0) - measure_kinked_period(99.0)) / 2.0
    np.testing.assert_allclose(jax.grad(measure_kinked_period)(100.0), difference, rtol=1e-5)


def read_fore_force(instant, params):
    return instant.fore_force.normal


def declare_force(reduction, function=read_fore_force):
    phases = ("DLS", "SLS-I", "SLS-II")
    return vrw.measure(f"force_{reduction}", phase=phases, reduction=reduction)(function)


def test_smooth_parts_have_the_peaks_and_measures_of_collocation():
    """A smooth law has one part in each phase."""
    wheel, options = vrw.parameter_sets["two_peaks"].params, vrw.StepOptions()
    cycle, model = vrw.limit_cycle(wheel), vrw.ViscoelasticWheel()
    peaks = model.measure_force_peaks(wheel, cycle.section_state, options)
    assert (peaks.keys(), peaks["n_force_peaks"]) == (cycle.force_peaks.keys(), 2.0)
    measures = [declare_force("min"), declare_force("mean"), declare_force("integral")]
    step = vrw.step(wheel, cycle.section_state)
    values = model.measure_step(wheel, cycle.section_state, step, options, measures)
    for name, value in cycle.force_peaks.items():
        np.testing.assert_allclose(peaks[name], value, rtol=3e-9, err_msg=name)
    for measure in measures:
        np.testing.assert_allclose(values[measure.name], cycle.measure(measure), rtol=1e-9)


@pytest.mark.slow
def test_forces_with_a_kink_carry_the_weight_and_have_the_peaks_of_samples():
    """Momentum normal to the slope repeats. Samples of a walk have errors of 1e-8."""
    cycle, model = find_gait(BumpStop(100.0)), make_wheel(BumpStop(100.0))
    parts = model._sample_parts(model.attach_laws(PARAMS), cycle.section_state, vrw.StepOptions())
    assert [int(phase.n_kinks) for phase in parts] == [1, 1, 0]

    def read_total_force(instant, params):
        rear = 0.0 if instant.rear_force is None else instant.rear_force.normal
        return instant.fore_force.normal + rear

    impacts = cycle.measure("landing_impulse") + cycle.indicators.lambda_I4
    impulse = cycle.measure(declare_force("integral", read_total_force)) + impacts
    impulse = impulse + cycle.margins.hit_planted_impulse
    weight = (PARAMS.hub_mass + PARAMS.n_legs * PARAMS.leg_mass) * PARAMS.gravity
    expected = weight * jnp.cos(PARAMS.slope) * cycle.period
    np.testing.assert_allclose(impulse, expected, rtol=1e-11)
    walk = vrw.simulate(PARAMS, cycle.section_state, 1, model=model, n_samples=1001)
    for name, values in vrw.force_peaks(walk).items():
        if name in cycle.force_peaks:
            np.testing.assert_allclose(cycle.force_peaks[name], values[0], rtol=1e-7, err_msg=name)
    np.testing.assert_allclose(
        cycle.measure(declare_force("min")), walk.lambda_2.values.min(), rtol=1e-7
    )
    steps_per_period = vrw.measure("steps")(lambda step, params: cycle.period / step.period)
    np.testing.assert_allclose(cycle.measure(steps_per_period), 1.0, rtol=1e-14)
    with pytest.raises(ValueError, match="phase"):
        cycle.measure(vrw.measure("f", phase="flight", reduction="mean")(read_fore_force))


@pytest.mark.slow
def test_measures_of_gaits_with_a_kink_have_the_derivatives_of_differences():
    """The error of the differences is 4e-6 relative."""
    measures = ["peak_force", declare_force("mean"), declare_force("min")]
    table = vrw.sensitivities(PARAMS, measures=measures, model=make_wheel(BumpStop(100.0)))
    before, after = (find_gait(BumpStop(k2)) for k2 in (99.5, 100.5))
    differences = [float(after.measure(x) - before.measure(x)) for x in measures]
    derivatives = table.derivative.sel(parameter="leg.k2")
    np.testing.assert_allclose(derivatives, differences, rtol=2e-5)
    measure_peak = lambda k2: find_gait(BumpStop(k2)).measure("peak_force")
    np.testing.assert_allclose(jax.grad(measure_peak)(100.0), derivatives[0], rtol=1e-9)


@pytest.mark.slow
def test_a_kink_that_is_never_reached_changes_no_peak():
    """The mesh of collocation has an error of 1e-9."""
    smooth, unreached = find_gait(PaperLeg()), find_gait(BumpStop(100.0, 0.5))
    for name, value in smooth.force_peaks.items():
        np.testing.assert_allclose(unreached.force_peaks[name], value, rtol=1e-8, err_msg=name)
    for reduction in ("min", "mean", "integral"):
        measure = declare_force(reduction)
        np.testing.assert_allclose(unreached.measure(measure), smooth.measure(measure), rtol=1e-8)


@pytest.mark.slow
def test_studies_of_gaits_with_a_kink_take_peaks_and_measures():
    """Scans and branches have the values of single gaits, also of two legs in turn."""
    mean, model = declare_force("mean"), make_wheel(BumpStop(100.0))
    names = ["peak_force", mean, "d force_mean / d leg.k2"]
    scan = vrw.scan(vrw.grid({"leg.k2": [100.0, 101.0]}), names, base=PARAMS, model=model)
    cycles = [find_gait(BumpStop(k2)) for k2 in (100.0, 101.0)]
    for name, measure in {"peak_force": "peak_force", "force_mean": mean}.items():
        expected = [cycle.measure(measure) for cycle in cycles]
        np.testing.assert_allclose(scan[name], expected, rtol=1e-9)
    np.testing.assert_allclose(
        scan["d force_mean / d leg.k2"].mean(), np.diff(scan.force_mean)[0], rtol=1e-5
    )
    branch = vrw.continue_branch(
        PARAMS, "leg.k2", (100.0, 101.0), model=model, force_peaks=True, measures=[mean]
    ).dataset
    np.testing.assert_allclose(branch.force_mean[[0, -1]], scan.force_mean, rtol=1e-8)
    np.testing.assert_allclose(branch.peak_force[[0, -1]], scan.peak_force, rtol=1e-8)
    legs = vrw.AlternatingLegs(BumpStop(100.0), BumpStop(100.0))
    both = find_gait(legs, period_n=2)
    np.testing.assert_allclose(both.measure(mean), cycles[0].measure(mean), rtol=1e-9)
    np.testing.assert_allclose(both.measure("peak_force"), scan.peak_force[0], rtol=1e-9)


def test_a_wheel_of_a_batch_outside_its_domain_is_named():
    wheels = vrw.WheelParams(damping=np.array([200.0, -5.0]))
    assert vrw.limit_cycles(wheels).why[1].startswith("damping is -5, but ")


@pytest.mark.slow
def test_gaits_with_a_kink_and_contact_are_those_of_the_papers_wheel():
    """With a friction of 50, the rear foot slides before it leaves the ground."""
    expected, law = find_gait(BumpStop(100.0)), BumpStop(100.0)
    wheel = vrw.UnilateralWheel(friction=np.inf, infinite_friction_rule="paper", leg_force=law)
    cycle = vrw.limit_cycle(PARAMS, model=wheel)
    assert abs(cycle.period - expected.period) < 1e-10
    np.testing.assert_allclose(cycle.multipliers[:2], expected.multipliers[:2], atol=1e-7)
    smooth_law = vrw.UnilateralWheel(friction=50.0, leg_force=law.__call__)
    peaks, expected_peaks = (
        vrw.limit_cycle(PARAMS, model=model).force_peaks
        for model in (vrw.UnilateralWheel(friction=50.0, leg_force=law), smooth_law)
    )
    # Without the declaration, forces are less accurate.
    for name, value in peaks.items():
        np.testing.assert_allclose(value, expected_peaks[name], rtol=1e-8)
    ladder = vrw.LadderWheel(friction=50.0, leg_force=law)
    assert vrw.limit_cycle(PARAMS, model=ladder).period == expected.period


@pytest.mark.slow
def test_derivatives_of_a_gait_with_a_kink_and_slip_are_differences_of_gaits():
    make_contact_wheel = lambda k2: vrw.UnilateralWheel(friction=0.7, leg_force=BumpStop(k2))
    find = lambda k2: vrw.limit_cycle(PARAMS, model=make_contact_wheel(k2))
    assert find(100.0).steps.slip[0] > 0.01  # m
    difference = float(find(100.5).period - find(99.5).period)  # of 1 N/m
    table = vrw.sensitivities(PARAMS, measures=["period"], model=make_contact_wheel(100.0))
    assert float(table.derivative.sel(parameter="leg.k2")[0]) == pytest.approx(difference, rel=1e-5)
    np.testing.assert_allclose(jax.grad(lambda k2: find(k2).period)(100.0), difference, rtol=1e-5)


def test_derivatives_by_parameters_of_law_and_wheel_are_differences_of_gaits():
    gradient = jax.grad(measure_period, (0, 1))(60.0, 150.0)
    differences = (
        (measure_period(60.1) - measure_period(59.9)) / 0.2,
        (measure_period(60.0, 150.1) - measure_period(60.0, 149.9)) / 0.2,
    )
    np.testing.assert_allclose(gradient, differences, rtol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(measure_period)(60.0), gradient[0], rtol=1e-12)
    values = jax.vmap(measure_period)(jnp.array([60.0, 90.0]))
    np.testing.assert_allclose(values[0], DAMPER_PERIOD_S, atol=1e-9)


@pytest.mark.slow
def test_second_derivatives_of_gaits_and_multipliers_are_differences_of_first_ones():
    differentiate = jax.grad(measure_period)
    difference = (differentiate(60.1) - differentiate(59.9)) / 0.2
    np.testing.assert_allclose(jax.hessian(measure_period)(60.0), difference, rtol=1e-5)

    def measure_radius(c2):
        return find_gait(QuadraticDamper(c2)).spectral_radius

    difference = (measure_radius(60.1) - measure_radius(59.9)) / 0.2
    np.testing.assert_allclose(jax.grad(measure_radius)(60.0), difference, rtol=1e-6)


def test_similar_wheels_with_similar_laws_have_similar_gaits():
    mass, length = 0.05, 0.1  # a wheel for a desk
    small = PARAMS.scaled(mass=mass, length=length, time=length**0.5)
    cycle = find_gait(QuadraticDamper(60.0 * mass / length), small)
    assert abs(cycle.period / length**0.5 - DAMPER_PERIOD_S) < 1e-9
    np.testing.assert_allclose(cycle.multipliers.real, DAMPER_MULTIPLIERS, atol=1e-6)


def test_a_batch_has_a_law_for_each_wheel():
    damping, c2 = np.array([100.0, 150.0, 150.0]), np.array([0.0, 60.0, 2000.0])
    cycles = vrw.limit_cycles(
        vrw.WheelParams(damping=damping), model=make_wheel(QuadraticDamper(c2))
    )
    assert cycles.found.tolist() == [True, True, False]
    paper_period = vrw.limit_cycle(vrw.WheelParams(damping=100.0)).period
    np.testing.assert_allclose(cycles.period[:2], [paper_period, DAMPER_PERIOD_S], atol=1e-9)
    assert "pull on the rear foot" in cycles.ending[2]


def test_a_gait_far_from_the_papers_law_is_found_by_homotopy():
    # Without its own spring, the wheel would collapse: the predicted gait is no start.
    params = vrw.WheelParams(stiffness=1.0, damping=1.0)

    def leg(L, dL, p):
        return 500.0 * (p.natural_length - L) - 149.0 * dL

    cycle = vrw.limit_cycle(params, model=make_wheel(lambda L, dL, p: leg(L, dL, p) - 1.0 * dL))
    np.testing.assert_allclose(cycle.period, vrw.limit_cycle(PARAMS).period, atol=1e-9)


@pytest.mark.slow
def test_force_peaks_and_margins_are_those_of_a_sampled_walk():
    cycle = find_gait(SPRING, vrw.WheelParams(damping=120.0))
    walk = vrw.simulate(
        vrw.WheelParams(damping=120.0), cycle.section_state, 1, model=make_wheel(SPRING)
    )
    peaks = vrw.force_peaks(walk)
    measures = cycle.measures(["peak_force", "n_force_peaks"])
    assert abs(measures["peak_force"] - float(peaks.peak_force[0])) < 1e-6
    assert int(measures["n_force_peaks"]) == int(peaks.n_force_peaks[0])
    assert abs(cycle.margins.fore_foot_force - float(walk.lambda_2.min())) < 0.01


def test_sensitivities_name_the_parameters_of_the_law():
    table = vrw.sensitivities(PARAMS, measures=["period"], model=make_wheel(QuadraticDamper()))
    derivative = table.derivative.sel(measure="period", parameter="leg.c2")
    np.testing.assert_allclose(derivative, jax.grad(measure_period)(60.0), rtol=1e-9)
    assert str(table.parameter_unit.sel(parameter="leg.c2").values) == "N s^2/m^2"


@pytest.fixture(scope="module")
def unilateral_gait():
    # A motor, if only of no torque, lets all gaits with contact share the programs of a search.
    model = vrw.UnilateralWheel(friction=np.inf, leg_force=QuadraticDamper(), hub_torque=0.0)
    return vrw.limit_cycle(PARAMS, model=model)


def test_the_unilateral_gait_is_that_of_the_papers_model_where_no_foot_leaves_early(
    unilateral_gait,
):
    assert abs(unilateral_gait.period - DAMPER_PERIOD_S) < 1e-9
    assert abs(unilateral_gait.dls_fraction - DAMPER_DLS_FRACTION) < 1e-9
    expected = find_gait(QuadraticDamper())
    assert abs(unilateral_gait.speed - expected.speed) < 1e-11
    np.testing.assert_allclose(
        vrw.sensitivities(PARAMS, measures=["period"], model=unilateral_gait.model).derivative.sel(
            parameter="leg.c2"
        ),
        jax.grad(measure_period)(60.0),
        rtol=1e-6,
    )


def test_a_gait_with_unilateral_contact_loses_the_energy_of_descent_and_motor():
    """The reference is the work of the weight and of the torque."""
    torque = -3.0  # N m; the rear foot slides, so that friction takes energy too
    model = vrw.UnilateralWheel(friction=5.0, leg_force=QuadraticDamper(), hub_torque=torque)
    cycle = vrw.limit_cycle(PARAMS, model=model)
    step = vrw.step(PARAMS, cycle.section_state, model=model, options=vrw.StepOptions.tight())
    s = PARAMS.symbols()
    descent = s.Mt * s.g * s.sin_phi * step.step_length
    lost = step.energy_impacts + step.energy_damping + step.energy_friction
    assert abs(lost - descent - torque * PARAMS.leg_angle) < 1e-8 * lost


def find_gaits_of_two_laws(second_damping):
    """Return the gait of the paper's wheel with two laws in turn, and that with contact."""
    laws = vrw.AlternatingLegs(
        vrw.SpringDamper(damping=150.0), vrw.SpringDamper(damping=second_damping)
    )
    return (
        vrw.limit_cycle(vrw.WheelParams(), model=model, period_n=2)
        for model in (
            vrw.ViscoelasticWheel(leg_force=laws),
            vrw.UnilateralWheel(friction=np.inf, leg_force=laws),
        )
    )


def test_two_laws_in_turn_give_a_gait_of_two_steps_with_unilateral_contact():
    expected, cycle = find_gaits_of_two_laws(170.0)
    durations = np.sort(cycle.durations.sum(axis=1))
    np.testing.assert_allclose(durations, np.sort(expected.durations.sum(axis=1)), atol=1e-9)


@pytest.mark.slow
def test_force_peaks_with_unilateral_contact_see_both_laws():
    expected, cycle = find_gaits_of_two_laws(190.0)
    value = cycle.force_peaks["peak_force"]
    assert value == pytest.approx(float(expected.measure("peak_force")), rel=1e-6)


@pytest.mark.parametrize(("friction", "torque"), [(50.0, None), (0.7, 0.0)])
def test_the_ladder_gives_the_law_to_both_models(friction, torque):
    laws = {"leg_force": QuadraticDamper(), "hub_torque": torque}
    ladder = vrw.LadderWheel(friction=friction, **laws)
    cycle = vrw.limit_cycle(PARAMS, model=ladder)
    expected_model = (
        vrw.ViscoelasticWheel(**laws)
        if friction == 50.0
        else vrw.UnilateralWheel(friction=friction, **laws)
    )
    assert type(cycle.model) is type(expected_model)
    assert cycle.period == vrw.limit_cycle(PARAMS, model=expected_model).period

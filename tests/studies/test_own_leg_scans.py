"""Scans of gaits over parameters of a law of the legs that a user gives."""

import equinox as eqx
import numpy as np
import pytest
from support.leg_laws import BumpStop, PaperLeg, QuadraticDamper, make_wheel

import vrw_jax as vrw

PARAMS = vrw.WheelParams(damping=150.0)
MODEL = make_wheel(QuadraticDamper())
DESIGN = vrw.grid({"leg.c2": [0.0, 60.0], "damping": [140.0, 150.0]})


class CubicDamper(eqx.Module):
    """Another law with parameters of the same names."""

    c2: float = 60.0
    k3: float = 0.0
    c1: float = 0.0

    def __call__(self, L, dL, params):
        spring = params.stiffness * (params.natural_length - L)
        return spring - params.damping * dL - self.c2 * dL**3


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return tmp_path_factory.mktemp("laws") / "scan.zarr"


@pytest.fixture(scope="module")
def scan(store):
    return vrw.scan(DESIGN, ["period"], base=PARAMS, model=MODEL, store=store)


def test_samples_are_gaits_of_their_laws(scan):
    for c2 in (0.0, 60.0):
        cycle = vrw.limit_cycle(PARAMS, model=make_wheel(QuadraticDamper(c2)))
        sample = scan.period.sel({"leg.c2": c2, "damping": 150.0})
        assert abs(float(sample) - cycle.period) < 1e-12
    assert scan["leg.c2"].attrs["units"] == "N s^2/m^2"


@pytest.mark.parametrize(
    "model",
    [
        vrw.UnilateralWheel(np.inf, leg_force=QuadraticDamper(), hub_torque=0.0),
        vrw.LadderWheel(50.0, leg_force=QuadraticDamper()),
    ],
    ids=["UnilateralWheel", "LadderWheel"],
)
def test_samples_with_unilateral_contact_are_those_of_the_papers_model(model, scan):
    """No foot leaves the ground early in these gaits, and none slides."""
    contact_scan = vrw.scan(DESIGN, ["period"], base=PARAMS, model=model)
    np.testing.assert_allclose(contact_scan.period, scan.period, atol=1e-9)


def test_a_scan_to_a_tolerance_refuses_a_law():
    model = vrw.UnilateralWheel(leg_force=QuadraticDamper())
    with pytest.raises(ValueError, match="a tolerance refers to unilateral contact with no"):
        vrw.scan(DESIGN, ["period"], base=PARAMS, model=model, tol=1e-3)


def test_a_scan_resumes_with_the_same_code_only(scan, store):
    resumed = vrw.scan(DESIGN, ["period"], base=PARAMS, model=MODEL, store=store)
    np.testing.assert_array_equal(resumed.period, scan.period)
    with pytest.raises(ValueError, match="the code of leg_force differs"):
        vrw.scan(DESIGN, ["period"], base=PARAMS, model=make_wheel(CubicDamper()), store=store)


def test_another_value_of_a_parameter_that_is_not_swept_is_another_scan(tmp_path):
    design = vrw.grid(damping=[150.0])
    measure = lambda model: vrw.scan(
        design, ["period"], base=PARAMS, model=model, store=tmp_path / "scan.zarr"
    )
    measure(MODEL)
    with pytest.raises(ValueError, match=r"wheel.leg.c2 is 60.0 there and 61.0 here"):
        measure(make_wheel(QuadraticDamper(61.0)))


def test_a_parameter_that_the_law_does_not_have_is_refused():
    with pytest.raises(ValueError, match=r"'leg.c2' is no parameter of this model.*leg.k"):
        vrw.scan(DESIGN, ["period"], base=PARAMS, model=make_wheel(PaperLeg()))


@pytest.mark.slow
def test_derivatives_of_a_scan_by_a_parameter_of_the_law_are_differences():
    design = vrw.samples({"leg.c2": np.array([59.9, 60.0, 60.1])})
    names = ["period", "d period / d leg.c2"]
    scan = vrw.scan(design, names, base=PARAMS, model=MODEL)
    difference = float(scan.period[2] - scan.period[0]) / 0.2
    np.testing.assert_allclose(scan["d period / d leg.c2"][1], difference, rtol=1e-6)


@pytest.mark.slow
def test_tuning_moves_a_parameter_of_the_law_to_its_bound():
    bounds = {"leg.c2": (50.0, 70.0)}
    tuned = vrw.tune(PARAMS, "dls_fraction", ["leg.c2"], bounds, {}, model=MODEL)
    assert float(tuned.model.leg_force.c2) == 70.0
    cycle = vrw.limit_cycle(PARAMS, model=tuned.model)
    assert abs(tuned.value - cycle.dls_fraction) < 1e-10
    assert "leg.c2 70 N s^2/m^2" in str(tuned)
    assert tuned.params.laws is None


@pytest.mark.slow
def test_studies_of_robustness_with_the_papers_law_as_a_law_are_those_of_the_paper():
    starts = {
        "theta_post_impact": np.linspace(-0.75, -0.6, 3),
        "dtheta_post_impact": np.linspace(0.9, 1.6, 3),
    }
    box = {name: (values[0], values[-1]) for name, values in starts.items()}
    studies = [
        lambda model: vrw.first_passage(PARAMS, 0.03, model=model, n_walkers=256).mean_steps,
        lambda model: vrw.basin(PARAMS, starts, model=model).outcome.values,
        lambda model: vrw.gait_sensitivity(PARAMS, ["period"], model=model).norm,
        lambda model: vrw.smallest_disturbance(PARAMS, model=model).size,
        lambda model: vrw.basin_share(PARAMS, box, model=model, n_starts=64).share,
    ]
    for study in studies:  # A law evaluates the force in another order of operations.
        expected, value = study(vrw.ViscoelasticWheel()), study(make_wheel(PaperLeg()))
        np.testing.assert_allclose(value, expected, rtol=1e-6)


@pytest.mark.slow
def test_a_law_changes_lives_basins_and_disturbances():
    """The heavier damper has a gait, which ends near 101 N s^2/m^2, where the rear foot pulls."""
    light, heavy = make_wheel(QuadraticDamper(0.0)), make_wheel(QuadraticDamper(90.0))
    box = {"theta_post_impact": (-0.75, -0.6), "dtheta_post_impact": (0.9, 1.6)}
    for study in (
        lambda model: vrw.first_passage(PARAMS, 0.03, model=model, n_walkers=256).mean_steps,
        lambda model: vrw.gait_sensitivity(PARAMS, ["period"], model=model).norm[0],
        lambda model: vrw.basin_share(PARAMS, box, model=model, n_starts=64).share,
        lambda model: vrw.smallest_disturbance(PARAMS, model=model).size,
    ):
        assert abs(study(light) - study(heavy)) > 1e-3 * study(light)


@pytest.mark.slow
def test_samples_of_a_law_with_kinks_are_the_gaits_of_walks():
    """The reference is 200 steps with tight tolerances, in which the gait attracts the wheel."""
    design = vrw.grid({"leg.k2": [99.0, 100.0, 101.0], "damping": [150.0, 900.0]})
    names, model = ["period", "d period / d leg.k2"], make_wheel(BumpStop(100.0))
    scan = vrw.scan(design, names, model=model)
    start, options = np.array([[0.11, 1.85, -0.1]]), vrw.StepOptions.tight()
    walk = vrw.step_batch(PARAMS, start, 200, model=model, options=options)
    period = scan.period.sel(damping=150.0)
    assert float(period[1]) == pytest.approx(float(walk.durations.sum()), abs=1e-9)
    rate = scan["d period / d leg.k2"].sel(damping=150.0)[1]
    assert float(rate) == pytest.approx(float(period[2] - period[0]) / 2.0, rel=1e-5)
    assert scan.friction_rear.sel(damping=150.0).notnull().all()
    assert scan.period.sel(damping=900.0).isnull().all()


@pytest.mark.slow
@pytest.mark.parametrize("friction", [50.0, 0.7])
def test_samples_with_kinks_and_contact_are_gaits_of_the_selected_model(friction):
    design = vrw.grid({"leg.k2": [99.0, 101.0]})
    ladder = vrw.LadderWheel(friction=friction, leg_force=BumpStop(100.0))
    scan = vrw.scan(design, ["period", "slip"], base=PARAMS, model=ladder)
    model = ladder.viscoelastic_model if friction == 50.0 else ladder.unilateral_model
    expected = vrw.scan(design, ["period"], base=PARAMS, model=model)
    np.testing.assert_allclose(scan.period, expected.period, rtol=1e-12)
    assert (scan.slip > 0.0).all() == (friction == 0.7)


@pytest.mark.slow
def test_measures_of_legs_in_turn_with_kinks_are_those_of_both_steps():
    """In sensitivities as in scans, with derivatives equal to central differences of the scan."""
    model = make_wheel(vrw.AlternatingLegs(BumpStop(100.0), BumpStop(80.0)))
    names = ["energy_lost_damping", "fore_foot_force"]
    scan = vrw.scan(vrw.samples(damping=[149.5, 150.0, 150.5]), names, model=model)
    table = vrw.sensitivities(PARAMS, measures=names, model=model).sel(parameter="damping")
    for name in names:
        before, value, after = scan[name].values
        row = table.sel(measure=name)
        assert row.value == pytest.approx(value, rel=1e-9)
        assert row.derivative == pytest.approx(after - before, rel=1e-4)

"""Force peaks of gaits with unilateral contact are those of the second formulation."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from reference_code import complementarity
from reference_code.contact_force_extrema import find_step_extrema, make_start
from support.slow_variants import mark_slow

import vrw_jax as vrw
from vrw_jax.models import FORCE_PEAK_MEASURES

TWO_PEAKS = vrw.WheelParams(stiffness=2500.0, damping=100.0, natural_length=1.0, slope=0.075)
TABLE_1 = vrw.WheelParams()
MODEL = vrw.UnilateralWheel(friction=0.8)
WHEELS = {"two peaks": TWO_PEAKS, "Table 1": TABLE_1}
SMOOTH_MEASURES = tuple(name for name in FORCE_PEAK_MEASURES if not name.startswith("n_"))


@pytest.fixture(scope="module")
def gaits():
    return {name: vrw.limit_cycle(params, model=MODEL) for name, params in WHEELS.items()}


def read_peaks(gait, names=FORCE_PEAK_MEASURES):
    return {name: float(value) for name, value in gait.measures(names).items()}


@pytest.mark.parametrize("wheel_name", ["two peaks", *mark_slow("Table 1")])
def test_peaks_of_a_gait_are_those_of_the_second_formulation(gaits, wheel_name):
    """The relative error is that of the step, 1e-10 per solver step, after some hundred steps.

    The wheel in Table 1 has a fast gait on this ground, whose force falls from its landing on.
    """
    gait, params = gaits[wheel_name], WHEELS[wheel_name]
    peaks = read_peaks(gait)
    wheel = complementarity.ComplementarityWheel(
        0.8, c=float(params.damping), k=float(params.stiffness), Ls=float(params.natural_length),
        slope=float(params.slope),
    )  # fmt: skip
    fore, total, landing_impulse = find_step_extrema(
        wheel, make_start(np.asarray(gait.section_state))
    )
    expected = {
        "n_force_peaks": np.sum(fore.is_maximum),
        "peak_force": fore.largest_force,
        "smooth_peak_force": max(fore.forces[fore.is_maximum], default=np.nan),
        "force_trough_depth": fore.compute_trough_depth(),
        "second_peak_rate": max(fore.rate_maxima_after_peak, default=np.nan),
        "n_total_force_peaks": np.sum(total.is_maximum),
        "peak_total_force": total.largest_force,
        "smooth_peak_total_force": max(total.forces[total.is_maximum], default=np.nan),
        "landing_impulse": landing_impulse,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(peaks[name], value, rtol=1e-7, atol=1e-7, err_msg=name)


def test_a_gait_with_unilateral_contact_has_the_published_peak_and_trough(gaits):
    """214.9, 127.6 and 142.3 N on ground of friction 0.8.

    The third peak is a small one soon after the landing, which the second formulation has too.
    """
    peaks = read_peaks(gaits["two peaks"])
    assert peaks["n_force_peaks"] == 3.0
    assert abs(peaks["smooth_peak_force"] - 214.9) < 0.05
    assert abs(peaks["force_trough_depth"] - (142.3 - 127.6)) < 0.1


@pytest.mark.slow  # the derivatives of a step with peaks compile for more than a minute
def test_derivatives_of_peaks_are_central_differences_along_the_gait(gaits):
    """Differences have an error of 1e-8, and the third-order term of Richardson's formula 1e-7."""
    gait = gaits["two peaks"]
    table = vrw.sensitivities(
        TWO_PEAKS, measures=(*SMOOTH_MEASURES, "n_force_peaks"), model=MODEL, guess=gait
    )
    np.testing.assert_allclose(table.value[-1], 3.0)
    np.testing.assert_array_equal(table.derivative[-1], 0.0)
    for parameter, h in (("stiffness", 5.0), ("slope", 1e-4), ("friction", 1e-3)):

        def measure(shift, parameter=parameter):
            model, wheel = MODEL, TWO_PEAKS
            if parameter == "friction":
                model = vrw.UnilateralWheel(friction=0.8 + shift)
            else:
                value = jnp.asarray(float(getattr(TWO_PEAKS, parameter)) + shift)
                wheel = dataclasses.replace(TWO_PEAKS, **{parameter: value})
            shifted = vrw.limit_cycle(wheel, model=model, guess=gait.section_state)
            return np.array(list(read_peaks(shifted, SMOOTH_MEASURES).values()))

        outer, inner = ((measure(k * h) - measure(-k * h)) / (2.0 * k * h) for k in (2.0, 1.0))
        exact = table.derivative.sel(measure=list(SMOOTH_MEASURES), parameter=parameter)
        np.testing.assert_allclose(
            exact, (4.0 * inner - outer) / 3.0, rtol=1e-5, atol=1e-6, err_msg=parameter
        )


@pytest.mark.slow  # the derivatives of a step with peaks compile for more than a minute
def test_a_scan_with_unilateral_contact_has_the_peaks_of_each_gait():
    names = ["n_force_peaks", "peak_force", "landing_impulse", "d peak_force / d damping"]
    scan = vrw.scan(vrw.grid(damping=[99.9, 100.0, 100.1]), names, base=TWO_PEAKS, model=MODEL)
    for i, damping in enumerate(scan.damping.values):
        wheel = dataclasses.replace(TWO_PEAKS, damping=jnp.asarray(damping))
        peaks = read_peaks(vrw.limit_cycle(wheel, model=MODEL), names[:3])
        for name, value in peaks.items():
            np.testing.assert_allclose(scan[name].values[i], value, rtol=1e-8, err_msg=name)
    difference = (scan.peak_force[2] - scan.peak_force[0]) / 0.2  # an error of 1.4 % at +-5 N s/m
    np.testing.assert_allclose(scan[names[3]][1], difference, rtol=2e-5)
    assert scan.peak_force.attrs["units"] == "N"


@pytest.mark.slow  # a branch compiles for more than a minute on a busy machine
def test_a_branch_with_unilateral_contact_has_the_peaks_of_each_gait(gaits):
    branch = vrw.continue_branch(
        TWO_PEAKS, "slope", (0.075, 0.0752), cycle=gaits["two peaks"], model=MODEL,
        force_peaks=True,
    )  # fmt: skip
    for i in (0, -1):
        wheel = dataclasses.replace(TWO_PEAKS, slope=jnp.asarray(branch.values[i]))
        guess = branch.dataset.section_state.values[i]
        for name, value in read_peaks(vrw.limit_cycle(wheel, model=MODEL, guess=guess)).items():
            np.testing.assert_allclose(branch.dataset[name][i], value, rtol=1e-8, err_msg=name)
    assert branch.values[-1] == 0.0752


def test_force_peaks_by_diffrax_raise_one_sentence(gaits):
    options = vrw.StepOptions(engine="diffrax")
    with pytest.raises(ValueError, match="only machine code locates them"):
        MODEL.measure_force_peaks(TWO_PEAKS, gaits["two peaks"].section_state, options)


def test_a_model_without_force_peaks_raises_one_sentence():
    wheel = vrw.WheelParams(slope=0.1)
    model = vrw.RigidWheel(held_landing=True)
    cycle = vrw.limit_cycle(wheel, model=model, guess=[0.39, 1.5, 0.0])
    with pytest.raises(ValueError, match="its steps have no such measures"):
        cycle.measure("peak_force")


@pytest.mark.slow  # scans with both models compile for more than a minute
def test_a_scan_with_model_auto_has_the_peaks_of_each_samples_model():
    names = ["n_force_peaks", "n_total_force_peaks", "peak_force", "peak_total_force"]
    wheels = (dataclasses.replace(TABLE_1, damping=jnp.asarray(150.0)), TWO_PEAKS)
    design = vrw.samples({
        name: [float(getattr(wheel, name)) for wheel in wheels]
        for name in ("damping", "stiffness", "natural_length", "slope")
    } | {"friction": [math.inf, 0.8]})  # fmt: skip
    scan = vrw.scan(design, names, model="auto")
    model_names = scan.rung.attrs["flag_meanings"].split()
    for i, model in enumerate((vrw.ViscoelasticWheel(), MODEL)):
        assert model_names[int(scan.rung[i])] == type(model).__name__
        peaks = read_peaks(vrw.limit_cycle(wheels[i], model=model), names)
        assert peaks["n_total_force_peaks"] > 0.0
        for name, value in peaks.items():
            np.testing.assert_allclose(scan[name].values[i], value, rtol=1e-8, err_msg=name)


def test_model_auto_has_the_peaks_of_the_selected_model(gaits):
    gait = vrw.limit_cycle(TWO_PEAKS, model=vrw.LadderWheel(friction=0.8))
    assert read_peaks(gait) == read_peaks(gaits["two peaks"])

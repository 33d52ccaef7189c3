"""Force peaks of sampled walks are those of gaits, and with unilateral contact of a second code."""

import numpy as np
import pytest
from reference_code import complementarity
from reference_code.contact_force_extrema import find_step_extrema

import vrw_jax as vrw
from vrw_jax.models import SAMPLED_FORCE_PEAK_MEASURES

TWO_PEAKS = vrw.WheelParams(stiffness=2500.0, damping=100.0, natural_length=1.0, slope=0.075)
TIGHT = vrw.StepOptions.tight()


def test_peaks_of_a_sampled_step_are_those_of_its_gait():
    cycle = vrw.limit_cycle(TWO_PEAKS)
    peaks = vrw.force_peaks(vrw.simulate(TWO_PEAKS, cycle.section_state, 2, options=TIGHT))
    assert peaks.sizes["step"] == 2
    for name, value in cycle.measures(SAMPLED_FORCE_PEAK_MEASURES).items():
        np.testing.assert_allclose(peaks[name], value, rtol=1e-7, err_msg=name)
    assert peaks.n_force_peaks.attrs["units"] == "1"
    np.testing.assert_array_equal(peaks.is_maximum, [True, False, True] * 2)
    np.testing.assert_array_equal(peaks.force_step, [0, 0, 0, 1, 1, 1])


@pytest.mark.slow
def test_peaks_with_unilateral_contact_are_those_of_another_code():
    x = np.asarray(vrw.limit_cycle(TWO_PEAKS).section_state)
    model = vrw.UnilateralWheel(friction=0.8)
    peaks = vrw.force_peaks(vrw.simulate(TWO_PEAKS, x, 1, model=model, options=TIGHT))
    wheel = complementarity.ComplementarityWheel(0.8, c=100.0, k=2500.0, Ls=1.0, slope=0.075)
    fore, *_ = find_step_extrema(wheel, complementarity.paper_start(wheel, *x))
    np.testing.assert_array_equal(peaks.is_maximum, fore.is_maximum)
    np.testing.assert_allclose(peaks.force, fore.forces, rtol=1e-7)
    assert peaks.n_force_peaks.values == np.sum(fore.is_maximum)
    assert peaks.n_force_peaks.values >= 2


def test_a_gait_with_unilateral_contact_has_the_published_peaks():
    """215, 128 and 142 N on ground of friction 0.8, of the gait that a walk reaches."""
    model = vrw.UnilateralWheel(friction=0.8)
    gait = vrw.limit_cycle(TWO_PEAKS, model=model)
    peaks = vrw.force_peaks(vrw.simulate(TWO_PEAKS, gait.section_state, 1, model=model))
    np.testing.assert_allclose(peaks.force[-3:], [214.9, 127.6, 142.3], atol=0.05)


def test_too_few_samples_and_no_forces_raise_one_sentence():
    walk = vrw.simulate(vrw.WheelParams(), n_steps=1, n_samples=5)
    with pytest.raises(ValueError, match="have 5 samples, but its peaks need at least 9"):
        vrw.force_peaks(walk)
    with pytest.raises(ValueError, match="no normal force"):
        vrw.force_peaks(walk[["hub_x"]])
    with pytest.raises(ValueError, match="no samples, because its outcome is STEPPED"):
        vrw.force_peaks(walk.isel(time=slice(0)))

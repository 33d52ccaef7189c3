"""Named parameter sets walk as their source states, and can be selected by name."""

import pytest

import vrw_jax as vrw
from vrw_jax.app.config import parse_config

# Period, s, and share of double support by an independent code of five constrained coordinates;
# it printed seven and five digits.
REFERENCE_GAITS = {
    "table_1": (0.8170316, 0.53153),
    "two_peaks": (0.7520229, 0.09970),
    "two_peaks_light_damping": (0.9301872, 0.17583),
    "two_peaks_soft": (1.2326173, 0.21626),
}


@pytest.mark.parametrize("name", vrw.parameter_sets)
def test_the_gait_of_a_set_is_that_of_an_independent_code(name):
    cycle = vrw.limit_cycle(vrw.parameter_sets[name].params)
    period, dls_fraction = REFERENCE_GAITS[name]
    assert float(cycle.period) == pytest.approx(period, abs=5e-8)  # half of the last digit
    assert float(cycle.dls_fraction) == pytest.approx(dls_fraction, abs=5.1e-6)
    assert float(cycle.spectral_radius) < 1.0


def test_a_config_begins_with_a_set_and_replaces_some_of_its_values():
    config = parse_config('[wheel]\nparameter_set = "two_peaks"\ndamping = 90.0\n')
    wheel = config.make_wheel()
    assert (float(wheel.stiffness), float(wheel.damping)) == (2500.0, 90.0)


def test_a_design_may_sweep_a_parameter_of_the_set():
    text = '[wheel]\nparameter_set = "two_peaks"\n[grid]\nslope = [0.07, 0.075]\n'
    design = parse_config(text).design
    assert design is not None
    assert design.swept_parameters == ("slope",)


def test_an_unknown_set_is_refused_with_the_names_of_all():
    with pytest.raises(ValueError, match=r"'two_peeks' is no parameter set.*table_1"):
        parse_config('[wheel]\nparameter_set = "two_peeks"\n')

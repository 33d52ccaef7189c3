"""Pictures of scans are drawn over whatever was swept."""

import numpy as np
import pytest
import xarray as xr

from vrw_jax.figures import scan_figures
from vrw_jax.figures.style import axis_label


@pytest.mark.parametrize("second", ["friction", "gravity"])
def test_a_scan_is_drawn_over_both_its_axes(second):
    values = {"damping": [100.0, 150.0, 200.0], second: [0.4, 0.6, 0.8, 1.0]}
    shape = (3, 4)
    scan = xr.Dataset(
        {
            "outcome": (tuple(values), np.zeros(shape, int)),
            "speed": (tuple(values), np.arange(12.0).reshape(shape)),
        },
        values,
    )
    (figure,) = scan_figures(scan).values()
    speed, outcome, _ = figure.axes
    assert outcome.get_ylabel() == axis_label(second, "{symbol}")
    assert speed.collections[0].get_array().shape == (4, 3)

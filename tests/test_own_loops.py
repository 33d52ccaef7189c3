"""The programs of the page on custom loops run as they are written."""

import re
from pathlib import Path

import numpy as np
import pytest

import vrw_jax as vrw

PAGE = Path(__file__).parent.parent / "docs" / "own_loops.md"


@pytest.fixture
def page_names(request, monkeypatch, tmp_path) -> dict:
    """Return the variables that a program of the page defines."""
    programs = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    monkeypatch.setattr(vrw, "start_jax", lambda: None)  # it has started
    monkeypatch.chdir(tmp_path)
    left_part: dict = {}
    exec(programs[request.param], left_part)
    return left_part


@pytest.mark.slow
@pytest.mark.parametrize("page_names", [0], indirect=True)
def test_the_loop_increases_its_objective_and_satisfies_its_margins(page_names):
    before, after = (vrw.limit_cycle(page_names["wheel"](u)) for u in ([1.8, 3.0], page_names["u"]))
    assert bool(after.found)
    assert float(after.dls_fraction) > float(before.dls_fraction) + 0.01
    assert float(after.takeoff_acceleration) > 0.0


@pytest.mark.parametrize("page_names", [1], indirect=True)
def test_the_map_shows_the_requested_derivatives(page_names):
    result = page_names["map_"]
    assert tuple(result)[:3] == page_names["names"]
    assert list(Path("figures").glob("*.png"))
    slope = result["d dls_fraction / d damping"].sel(damping=160.0, slope=0.3).item()
    above, below = (vrw.limit_cycle(vrw.WheelParams(damping=160.0 + h)) for h in (0.1, -0.1))
    np.testing.assert_allclose(slope, (above.dls_fraction - below.dls_fraction) / 0.2, rtol=1e-5)

"""The page on own programs does what it says, as it is written."""

import re
from pathlib import Path

import numpy as np
import pytest

import vrw_jax as vrw

PAGE = Path(__file__).parent.parent / "docs" / "own_loops.md"


@pytest.fixture
def names(request, monkeypatch, tmp_path) -> dict:
    """What a program of the page leaves behind."""
    programs = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    monkeypatch.setattr(vrw, "start_jax", lambda: None)  # it has started
    monkeypatch.chdir(tmp_path)
    left: dict = {}
    exec(programs[request.param], left)
    return left


@pytest.mark.parametrize("names", [0], indirect=True)
def test_the_loop_climbs_and_keeps_its_premises(names):
    before, after = (vrw.limit_cycle(names["wheel"](u)) for u in ([1.8, 3.0], names["u"]))
    assert bool(after.found)
    assert float(after.dls_fraction) > float(before.dls_fraction) + 0.01
    assert float(after.takeoff_acceleration) > 0.0


@pytest.mark.parametrize("names", [1], indirect=True)
def test_the_map_is_of_the_derivatives_asked_for(names):
    told = names["map_"]
    assert tuple(told)[:3] == names["names"]
    assert list(Path().glob("*.png"))
    slope = told["d dls_fraction / d damping"].sel(damping=160.0, slope=0.3).item()
    above, below = (vrw.limit_cycle(vrw.WheelParams(damping=160.0 + h)) for h in (0.1, -0.1))
    np.testing.assert_allclose(slope, (above.dls_fraction - below.dls_fraction) / 0.2, rtol=1e-5)


@pytest.mark.parametrize("names", [2], indirect=True)
def test_damping_and_stiffness_are_found_within_what_the_noise_allows(names):
    found, truth = np.exp(names["u"]), np.exp(names["truth"])
    assert np.all(np.abs(found - truth) < 3.0 * names["spread"])
    assert np.all(names["spread"] < 0.1 * truth)

"""Scans to within a tolerance tell what `vrw.answer` does, sample by sample."""

from pathlib import Path

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.app import config

MEANT = vrw.UnilateralWheel(friction=20.0)
DESIGN = vrw.grid(damping=[150.0, 300.0], friction=[4.0, 60.0])


def test_a_scan_to_a_tolerance_tells_value_error_and_rung(tmp_path: Path) -> None:
    given = {"model": MEANT, "tol": 1e-2}
    found = vrw.scan(DESIGN, ["speed", "period"], **given, store=tmp_path / "a", chunk=1)
    whole = vrw.scan(DESIGN, ["speed", "period"], **given)
    for name in ("speed", "speed_error", "period_error", "rung", "outcome"):
        assert np.array_equal(found[name].values, whole[name].values, equal_nan=True)
    damping, friction = (x.ravel() for x in np.meshgrid([150.0, 300.0], [4.0, 60.0], indexing="ij"))
    told = vrw.answer(
        ["speed", "period"], vrw.WheelParams(damping=damping), 1e-2, friction=friction
    )
    assert np.array_equal(whole.speed.values.ravel(), told.value["speed"], equal_nan=True)
    assert np.array_equal(whole.period.values.ravel(), told.value["period"], equal_nan=True)
    here = told.found.reshape(2, 2)
    assert np.array_equal(whole.speed_error.values[here], told.error["speed"][told.found])
    meanings = whole.rung.attrs["flag_meanings"].split()
    names = {"RigidWheel": "rigid", "ViscoelasticWheel": "viscoelastic"}
    own = [names.get(meanings[i], "unilateral") for i in whole.rung.values[here]]
    assert own == list(told.rung[told.found])
    assert np.all(whole.rung.values[~here] == -1)
    assert {"viscoelastic"} < {*own, "none"}


def test_a_tolerance_is_kept_towards_real_ground_alone() -> None:
    with pytest.raises(ValueError, match="kept towards real ground"):
        vrw.scan(DESIGN, ["speed"], model="auto", tol=1e-2)
    with pytest.raises(ValueError, match="kept towards real ground"):
        vrw.scan(DESIGN, ["speed"], model=vrw.UnilateralWheel(restitution=0.1), tol=1e-2)
    with pytest.raises(ValueError, match="scan without tol"):
        vrw.scan(DESIGN, ["d speed / d damping"], model=MEANT, tol=1e-2)
    with pytest.raises(ValueError, match="tol is 0, but it must be positive"):
        vrw.scan(DESIGN, ["speed"], model=MEANT, tol=0.0)


def test_a_config_names_the_tolerance(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    text = '[model]\nrung = "unilateral"\n[scan]\nmeasures = ["speed"]\ntol = 1e-3\n'
    path.write_text(text + "[grid]\ndamping = [150.0]\n")
    assert config.load(path).scan.tol == 1e-3
    path.write_text(text.replace("1e-3", "-1.0"))
    with pytest.raises(ValueError, match="tol is -1, but it must be positive"):
        config.load(path)

"""Scans to a tolerance return what `vrw.measure_to_tolerance` returns for each sample."""

from pathlib import Path

import numpy as np
import pytest

import vrw_jax as vrw
from vrw_jax.app import config

REFERENCE_MODEL = vrw.UnilateralWheel(friction=20.0)
TOLERANCE_DESIGN = vrw.grid(damping=[150.0, 300.0], friction=[4.0, 60.0])


def test_a_scan_to_a_tolerance_has_value_error_and_model(tmp_path: Path) -> None:
    given = {"model": REFERENCE_MODEL, "tol": 1e-2}
    scan_result = vrw.scan(
        TOLERANCE_DESIGN, ["speed", "period"], **given, store=tmp_path / "a", chunk=1
    )
    names = ["speed", "period", "rung", "outcome"]  # The last two are exact.
    scan_with_tolerance = vrw.scan(TOLERANCE_DESIGN, names, **given)
    for name in ("speed", "speed_error", "period_error", "rung", "outcome"):
        assert np.array_equal(
            scan_result[name].values, scan_with_tolerance[name].values, equal_nan=True
        )
    damping, friction = (x.ravel() for x in np.meshgrid([150.0, 300.0], [4.0, 60.0], indexing="ij"))
    measured = vrw.measure_to_tolerance(
        ["speed", "period"], vrw.WheelParams(damping=damping), 1e-2, friction=friction
    )
    assert np.array_equal(
        scan_with_tolerance.speed.values.ravel(), measured.value["speed"], equal_nan=True
    )
    assert np.array_equal(
        scan_with_tolerance.period.values.ravel(), measured.value["period"], equal_nan=True
    )
    has_measure = measured.found.reshape(2, 2)
    assert np.array_equal(
        scan_with_tolerance.speed_error.values[has_measure], measured.error["speed"][measured.found]
    )
    meanings = scan_with_tolerance.rung.attrs["flag_meanings"].split()
    names = {"RigidWheel": "rigid", "ViscoelasticWheel": "viscoelastic"}
    model_names = [
        names.get(meanings[i], "unilateral") for i in scan_with_tolerance.rung.values[has_measure]
    ]
    assert model_names == list(measured.model[measured.found])
    assert np.all(scan_with_tolerance.rung.values[~has_measure] == -1)
    assert {"viscoelastic"} < {*model_names, "none"}


def test_a_tolerance_requires_the_unilateral_model() -> None:
    with pytest.raises(ValueError, match="refers to unilateral contact"):
        vrw.scan(TOLERANCE_DESIGN, ["speed"], model="auto", tol=1e-2)
    with pytest.raises(ValueError, match="refers to unilateral contact"):
        vrw.scan(TOLERANCE_DESIGN, ["speed"], model=vrw.UnilateralWheel(restitution=0.1), tol=1e-2)
    with pytest.raises(ValueError, match="scan without tol"):
        vrw.scan(TOLERANCE_DESIGN, ["d speed / d damping"], model=REFERENCE_MODEL, tol=1e-2)
    options = vrw.StepOptions(max_phase_time=0.01)
    with pytest.raises(ValueError, match="tol and options are both given, but a tolerance"):
        vrw.scan(TOLERANCE_DESIGN, ["speed"], model=REFERENCE_MODEL, tol=1e-2, options=options)
    with pytest.raises(ValueError, match="tol is 0, but it must be positive"):
        vrw.scan(TOLERANCE_DESIGN, ["speed"], model=REFERENCE_MODEL, tol=0.0)


def test_a_config_names_the_tolerance(tmp_path: Path) -> None:
    path = tmp_path / "one.toml"
    text = '[model]\nname = "unilateral"\n[scan]\nmeasures = ["speed"]\ntol = 1e-3\n'
    path.write_text(text + "[grid]\ndamping = [150.0]\n")
    assert config.load_config(path).scan.tol == 1e-3
    path.write_text(text.replace("1e-3", "-1.0"))
    with pytest.raises(ValueError, match="tol is -1, but it must be positive"):
        config.load_config(path)

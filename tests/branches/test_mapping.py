"""What a scan tells of borders: changes of sign between neighbours, and the curves beside them."""

import numpy as np
import pytest
import xarray as xr

import vrw_jax as vrw
from vrw_jax.branches.mapping import SCANNED, border_map, changes_of, unexplained
from vrw_jax.results import MARGINS

OVER = ("damping", "stiffness")
C, K = np.linspace(50.0, 150.0, 11), np.linspace(400.0, 600.0, 9)
LEGS = np.arange(3, 9)


def scan_of(signs, outcome=None):
    """A scan all of whose quantities are 1, but for those given."""
    ones = {name: np.ones((len(C), len(K))) for name in ("lambda_4_plus", *MARGINS)}
    data = {name: (OVER, signs.get(name, values)) for name, values in ones.items()}
    for name in (name for name in MARGINS if MARGINS[name].axis):
        data[name] = ((*OVER, "leg"), np.ones((len(C), len(K), len(LEGS))))
    data["spectral_radius"] = (OVER, np.full((len(C), len(K)), 0.5))
    steps = np.full((len(C), len(K)), vrw.Outcome.STEPPED)
    data["outcome"] = (OVER, steps if outcome is None else outcome)
    return xr.Dataset(data, {"damping": C, "stiffness": K, "leg": LEGS})


def line(name, c, k):
    data = {"spectral_radius": ("point", np.full(len(c), 0.5))}
    at = {"damping": ("point", c), "stiffness": ("point", k)}
    return vrw.BorderCurve(name, OVER, xr.Dataset(data, at), (), ("", ""))


def test_a_change_of_sign_is_told_where_its_zero_lies_and_only_its_own_curve_explains_it():
    zero = 50.0 + (K - 400.0) / 3.0
    scan = scan_of({"friction_rear": C[:, None] - zero})
    changes = changes_of(scan, OVER)
    assert {change.name for change in changes} == {"friction_rear"}
    for change in changes:  # linear: interpolation between two samples is exact
        i, j = change.at
        assert 50.0 + 10.0 * i == pytest.approx(50.0 + 25.0 * j / 3.0, abs=1e-9)
    assert unexplained(changes, [line("friction_rear", zero, K)], scan) == []
    assert unexplained(changes, [line("friction_fore", zero, K)], scan) == changes
    half = unexplained(changes, [line("friction_rear", zero[:4], K[:4])], scan)
    assert 0 < len(half) < len(changes)
    assert all(change.at[1] > 3.0 for change in half)


def test_where_a_mesh_was_too_coarse_nothing_is_said_of_gaits():
    outcome = np.full((len(C), len(K)), vrw.Outcome.STEPPED)
    outcome[6:] = vrw.Outcome.NO_CYCLE_FOUND
    outcome[8:, 4:] = vrw.Outcome.MESH_TOO_COARSE
    outcome[6:8, 4:] = vrw.Outcome.STEPPED
    scan = scan_of({}, outcome)
    told = {name: [] for name in ("gait", "mesh_too_coarse")}
    for change in changes_of(scan, OVER):
        told[change.name].append(change.sample)
    assert set(told["gait"]) == {(5, j) for j in range(4)} | {(6, 4), (7, 4)}
    assert set(told["mesh_too_coarse"]) == {(7, j) for j in range(4, len(K))}
    fold = line("fold", np.full(2, 105.0), np.array([400.0, 500.0]))
    left = unexplained(changes_of(scan, OVER), [fold], scan)
    assert {change.name for change in left} == {"gait", "mesh_too_coarse"}
    assert {change.sample for change in left if change.name == "gait"} == {(7, 4)}


@pytest.mark.slow
def test_beside_each_change_of_sign_of_a_scan_runs_a_curve():
    grid = vrw.grid(damping=np.linspace(4.0, 240.0, 60), stiffness=np.linspace(350.0, 700.0, 36))
    scan = vrw.scan(grid, ["dls_fraction", *SCANNED])
    curves, left = border_map(scan, vrw.WheelParams(), vrw.ViscoelasticWheel())
    assert not left
    (doubling,) = [curve.values for curve in curves if curve.name == "period_doubling"]
    # A branch along the stiffness meets it there.
    assert np.interp(141.66, *doubling[np.argsort(doubling[:, 0])].T) == pytest.approx(
        571.4737, abs=1e-3
    )

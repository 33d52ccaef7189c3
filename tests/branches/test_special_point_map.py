"""Maps of special points: sign changes between neighboring samples, and the curves near them."""

import numpy as np
import pytest
import xarray as xr

import vrw_jax as vrw
from vrw_jax.branches.special_point_curves import (
    SPECIAL_POINT_MEASURES,
    find_sign_changes_in_scan,
    find_unexplained_sign_changes,
)
from vrw_jax.models import MARGIN_MEASURES
from vrw_jax.studies import follow_special_points

MAP_PARAMETERS = ("damping", "stiffness")
C, K = np.linspace(50.0, 150.0, 11), np.linspace(400.0, 600.0, 9)
LEG_NUMBERS = np.arange(3, 9)


def make_scan(signs, outcome=None):
    """Return a scan of which all quantities are 1, except the given ones."""
    ones = {name: np.ones((len(C), len(K))) for name in ("lambda_4_plus", *MARGIN_MEASURES)}
    data = {name: (MAP_PARAMETERS, signs.get(name, values)) for name, values in ones.items()}
    for name in (name for name in MARGIN_MEASURES if MARGIN_MEASURES[name].leg_dimension):
        data[name] = ((*MAP_PARAMETERS, "leg"), np.ones((len(C), len(K), len(LEG_NUMBERS))))
    data["spectral_radius"] = (MAP_PARAMETERS, np.full((len(C), len(K)), 0.5))
    steps = np.full((len(C), len(K)), vrw.Outcome.STEPPED)
    data["outcome"] = (MAP_PARAMETERS, steps if outcome is None else outcome)
    return xr.Dataset(data, {"damping": C, "stiffness": K, "leg": LEG_NUMBERS})


def make_line(name, c, k):
    data = {"spectral_radius": ("point", np.full(len(c), 0.5))}
    coordinates = {"damping": ("point", c), "stiffness": ("point", k)}
    return vrw.SpecialPointCurve(name, MAP_PARAMETERS, xr.Dataset(data, coordinates), (), ("", ""))


def test_only_the_curve_of_the_same_quantity_explains_a_sign_change():
    zero = 50.0 + (K - 400.0) / 3.0
    scan = make_scan({"friction_rear": C[:, None] - zero})
    changes = find_sign_changes_in_scan(scan, MAP_PARAMETERS)
    assert {sign_change.quantity_name for sign_change in changes} == {"friction_rear"}
    for sign_change in changes:  # linear: interpolation between two samples is exact
        i, j = sign_change.scan_position_in_cells
        assert 50.0 + 10.0 * i == pytest.approx(50.0 + 25.0 * j / 3.0, abs=1e-9)
    assert find_unexplained_sign_changes(changes, [make_line("friction_rear", zero, K)], scan) == []
    assert (
        find_unexplained_sign_changes(changes, [make_line("friction_fore", zero, K)], scan)
        == changes
    )
    half = find_unexplained_sign_changes(
        changes, [make_line("friction_rear", zero[:4], K[:4])], scan
    )
    assert 0 < len(half) < len(changes)
    assert all(sign_change.scan_position_in_cells[1] > 3.0 for sign_change in half)


def test_samples_with_too_coarse_a_mesh_do_not_count_as_missing_gaits():
    outcome = np.full((len(C), len(K)), vrw.Outcome.STEPPED)
    outcome[6:] = vrw.Outcome.NO_CYCLE_FOUND
    outcome[8:, 4:] = vrw.Outcome.MESH_TOO_COARSE
    outcome[6:8, 4:] = vrw.Outcome.STEPPED
    scan = make_scan({}, outcome)
    result_by_name = {name: [] for name in ("gait", "mesh_too_coarse")}
    for sign_change in find_sign_changes_in_scan(scan, MAP_PARAMETERS):
        result_by_name[sign_change.quantity_name].append(sign_change.sample_indices)
    assert set(result_by_name["gait"]) == {(5, j) for j in range(4)} | {(6, 4), (7, 4)}
    assert set(result_by_name["mesh_too_coarse"]) == {(7, j) for j in range(4, len(K))}
    fold = make_line("fold", np.full(2, 105.0), np.array([400.0, 500.0]))
    unexplained_changes = find_unexplained_sign_changes(
        find_sign_changes_in_scan(scan, MAP_PARAMETERS), [fold], scan
    )
    assert {sign_change.quantity_name for sign_change in unexplained_changes} == {
        "gait",
        "mesh_too_coarse",
    }
    assert {
        sign_change.sample_indices
        for sign_change in unexplained_changes
        if sign_change.quantity_name == "gait"
    } == {(7, 4)}


@pytest.mark.slow
@pytest.mark.filterwarnings("error:Polyfit")  # no singular fit at a stalled end
def test_each_sign_change_of_a_scan_is_near_a_curve():
    grid = vrw.grid(damping=np.linspace(4.0, 240.0, 60), stiffness=np.linspace(350.0, 700.0, 36))
    scan = vrw.scan(grid, ["dls_fraction", *SPECIAL_POINT_MEASURES])
    stages = []
    _, curves, unexplained_changes = follow_special_points(
        scan, vrw.WheelParams(), vrw.ViscoelasticWheel(), stages.append
    )
    assert not unexplained_changes
    assert stages[0] == "following 5 branches along damping"
    assert any(stage.startswith("following special points: ") for stage in stages)
    (doubling,) = [curve.values for curve in curves if curve.name == "period_doubling"]
    # A branch along the stiffness meets it there.
    assert np.interp(141.66, *doubling[np.argsort(doubling[:, 0])].T) == pytest.approx(
        571.4737, abs=1e-3
    )


def test_a_map_needs_a_grid_over_two_ascending_parameters_and_the_papers_model():
    wrong_grids = (
        vrw.grid(damping=[150.0]),
        vrw.grid(damping=[150.0, 160.0], slope=[0.3]),
        vrw.grid(damping=[160.0, 150.0], slope=[0.28, 0.3]),
    )
    for grid, sentence in zip(
        wrong_grids, ("grid over two", "slope has", "damping has"), strict=True
    ):
        with pytest.raises(ValueError, match=sentence):
            vrw.map_special_points(grid)
    grid = vrw.grid(damping=[150.0, 160.0], slope=[0.28, 0.3])
    with pytest.raises(ValueError, match=r"mapped for vrw\.ViscoelasticWheel"):
        vrw.map_special_points(grid, model=vrw.RigidWheel())


def test_a_map_scans_what_the_curves_need_and_follows_them(monkeypatch):
    """Curves are stand-ins: the slow test above follows real ones."""
    curve = make_line("fold", np.array([150.0, 160.0]), np.array([495.0, 505.0]))
    followed = {}

    def trace(scan, base, model, on_stage):
        on_stage("following special points: fold")
        followed.update(scan=scan, base=base, model=model)
        return (curve,), ()

    monkeypatch.setattr("vrw_jax.studies.scan_execution.trace_special_points", trace)
    stages, base = [], vrw.WheelParams(slope=0.29)
    grid = vrw.grid(damping=[150.0, 160.0], stiffness=[495.0, 505.0])
    special_points = vrw.map_special_points(grid, "speed", base=base, on_stage=stages.append)
    assert {"speed", *SPECIAL_POINT_MEASURES, *MARGIN_MEASURES} <= set(special_points.scan)
    alone = vrw.scan(grid, ["speed"], base=base).speed  # another program: rounded differently
    np.testing.assert_allclose(special_points.scan.speed, alone, rtol=1e-14)
    assert followed["base"] is base
    assert stages == ["following special points: fold"]
    assert special_points.ending.startswith("0 changes")
    assert str(curve) in str(special_points)
    assert vrw.plot.map_figure(special_points.scan, "speed", special_points.curves).axes

"""Sobol' indices agree with those of functions with a closed form."""

import numpy as np
import pytest
import xarray as xr
from support.walkers import BALL_PARAMS, JuggledBall

import vrw_jax as vrw

ISHIGAMI_RANGES = {"damping": (100.0, 200.0), "slope": (0.2, 0.3), "stiffness": (400.0, 500.0)}


def make_ishigami_scan(n: int = 4096) -> tuple[xr.Dataset, np.ndarray]:
    """Return a scan that computes Ishigami's function, and its unit coordinates."""
    design = vrw.saltelli(ISHIGAMI_RANGES, n)
    low, high = np.array(list(ISHIGAMI_RANGES.values())).T
    unit = (np.stack(list(design.values_by_parameter.values()), 1) - low) / (high - low)
    x, y, z = np.pi * (2.0 * unit.T - 1.0)
    value = np.sin(x) + 7.0 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x)
    result_by_name = {
        "speed": ("sample", value),
        "period": ("sample", 2.0 * unit[:, 0] + unit[:, 1]),
    }
    outcome = np.full(design.size, int(vrw.Outcome.STEPPED))
    attrs = {"scan": {"design": design.describe_design()}}
    return xr.Dataset(
        result_by_name | {"outcome": ("sample", outcome)}, design.make_result_coordinates(), attrs
    ), unit


def test_indices_of_the_ishigami_function_equal_the_published_ones() -> None:
    """First order 0.3139, 0.4424, 0; total 0.5576, 0.4424, 0.2437 (Ishigami and Homma 1990)."""
    result = vrw.sobol_indices(make_ishigami_scan()[0], ["speed"]).sel(measure="speed")
    for name, published_values in (
        ("first_order", [0.3139, 0.4424, 0.0]),
        ("total", [0.5576, 0.4424, 0.2437]),
    ):
        # 4,096 rows of a Sobol' sequence: three times what other seeds were off by
        np.testing.assert_allclose(result[name], published_values, atol=0.02)
        assert np.all(result[f"{name}_lower"] <= published_values)
        assert np.all(published_values <= result[f"{name}_upper"])


def test_shares_of_a_sum_are_the_variances_of_its_terms() -> None:
    result = vrw.sobol_indices(make_ishigami_scan()[0], ["speed", "period"]).sel(measure="period")
    for name in ("first_order", "total"):
        np.testing.assert_allclose(result[name], [0.8, 0.2, 0.0], atol=0.01)


@pytest.mark.parametrize("value", [0.7, -1e-9, 1e300, 0.0])
def test_a_measure_that_varies_by_round_off_has_indices_of_zero(value: float) -> None:
    """A constant's variance is 0, and so is each parameter's part of it."""
    scan, unit = make_ishigami_scan(256)
    ulps = np.random.default_rng(0).integers(-2, 3, len(unit))
    scan["step_length"] = ("sample", value + ulps * np.spacing(value) * (value != 0.0))
    with pytest.warns(UserWarning, match=r"step_length: constant .* round-off"):
        indices = vrw.sobol_indices(scan, ["period", "step_length"])
    assert indices.is_constant_measure.values.tolist() == [False, True]
    for name in ("first_order", "total"):
        for part in ("", "_lower", "_upper"):
            assert np.all(indices[name + part].sel(measure="step_length") == 0.0)
        np.testing.assert_allclose(indices[name].sel(measure="period"), [0.8, 0.2, 0.0], atol=0.05)


def test_a_spread_of_a_ten_thousand_millionth_is_no_round_off() -> None:
    scan, unit = make_ishigami_scan()
    scan["period"] = ("sample", 0.7 * (1.0 + 1e-10 * (2.0 * unit[:, 0] + unit[:, 1])))
    indices = vrw.sobol_indices(scan, ["period"]).sel(measure="period")
    np.testing.assert_allclose(indices.total, [0.8, 0.2, 0.0], atol=0.01)


def test_rows_without_a_gait_are_omitted_and_counted() -> None:
    scan, unit = make_ishigami_scan()
    fails = unit[:, 2] > 0.9
    scan.outcome.values[fails] = vrw.Outcome.NO_CYCLE_FOUND
    for name in ("speed", "period"):
        scan[name].values[fails] = np.nan
    result = vrw.sobol_indices(scan, ["period"])
    assert result.attrs["left_out"] == pytest.approx(1.0 - 0.9**2, abs=0.01)  # z of A or of B
    assert result.attrs["rows"] == 2048
    np.testing.assert_allclose(result.total[0], [0.8, 0.2, 0.0], atol=0.02)


CHANGES_OF_ORDER = {
    "sorted": lambda scan: scan.sortby("damping"),
    "reversed": lambda scan: scan.isel(sample=slice(None, None, -1)),
    "shuffled": lambda scan: scan.isel(sample=np.random.default_rng(0).permutation(20480)),
    "sorted, without parameters": lambda scan: scan.sortby("slope").drop_vars(ISHIGAMI_RANGES),
    "without labels": lambda scan: scan.drop_vars("sample"),
    "without coordinates": lambda scan: scan.reset_coords(drop=True).drop_vars("sample"),
}


@pytest.mark.parametrize("change", CHANGES_OF_ORDER)
def test_the_order_of_the_samples_does_not_matter(change: str) -> None:
    """Reference: the same samples in the order of the design, whose indices are published ones."""
    scan, _ = make_ishigami_scan()
    changed_scan = CHANGES_OF_ORDER[change](scan)
    xr.testing.assert_identical(
        vrw.sobol_indices(changed_scan, ["speed"]), vrw.sobol_indices(scan, ["speed"])
    )


def test_a_part_of_the_samples_gives_the_indices_of_its_complete_rows() -> None:
    """On three quarters of every range, the variances of 2x and y have the same ratio 4 to 1."""
    scan, _ = make_ishigami_scan(16384)
    is_selected = (scan.damping < 175.0) & (scan.slope < 0.275) & (scan.stiffness < 475.0)
    with pytest.warns(UserWarning, match=r"absent: their rows are omitted, .* of 16,384 rows"):
        part = vrw.sobol_indices(scan.where(is_selected, drop=True), ["period"])
    np.testing.assert_allclose(part.total[0], [0.8, 0.2, 0.0], atol=0.02)
    # x, y and z of A and of B
    assert part.attrs["left_out"] == pytest.approx(1.0 - 0.75**6, abs=0.01)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_sample_without_a_finite_value_costs_its_row_alone(value: float) -> None:
    scan, _ = make_ishigami_scan()
    scan.speed.values[[7, 4096 + 9]] = value  # a point A of row 7, and a point B of row 9
    with pytest.warns(UserWarning, match=r"of 20,480 samples, 2 NaN or infinite in speed: .*2,048"):
        result = vrw.sobol_indices(scan, ["speed", "period"])
    assert result.attrs["left_out"] == pytest.approx(2 / 4096)
    # 2,048 rows of a Sobol' sequence: twice the tolerance of 4,096 rows
    np.testing.assert_allclose(result.first_order[0], [0.3139, 0.4424, 0.0], atol=0.04)
    np.testing.assert_allclose(result.total[1], [0.8, 0.2, 0.0], atol=0.02)


REFUSED_SELECTIONS = {
    "samples of another order without labels": (
        lambda scan: scan.drop_vars("sample").sortby("slope"), "another order"),
    "new labels": (
        lambda scan: scan.sortby("slope").assign_coords(sample=np.arange(320)), "another order"),
    "a part without labels": (
        lambda scan: scan.drop_vars("sample").isel(sample=slice(64)), "64 of the 320 samples"),
    "no samples": (lambda scan: scan.isel(sample=slice(0)), "contains 0 of the 320 samples"),
    "samples twice": (
        lambda scan: xr.concat([scan, scan], "sample"), "one whole number from 0 to 319"),
    "labels of something else": (
        lambda scan: scan.assign_coords(sample=np.arange(320) + 1), "one whole number"),
    "half of the samples": (
        lambda scan: scan.isel(sample=slice(160)), r"only 0 of 64 .* \(samples: 160 absent\)"),
    "no outcomes": (lambda scan: scan[["speed"]], "'outcome' is no measure"),
    "a measure that is nowhere finite": (
        lambda scan: scan.assign(speed=np.nan * scan.speed), "320 NaN or infinite in speed"),
}  # fmt: skip


@pytest.mark.parametrize("selection", REFUSED_SELECTIONS)
def test_samples_that_cannot_be_assigned_to_rows_are_refused(selection: str) -> None:
    select, message = REFUSED_SELECTIONS[selection]
    scan, _ = make_ishigami_scan(64)
    with pytest.raises(ValueError, match=message):
        vrw.sobol_indices(select(scan), ["speed"])


def test_the_same_scan_gives_the_same_intervals() -> None:
    first, second = (vrw.sobol_indices(make_ishigami_scan(256)[0], ["speed"]) for _ in range(2))
    xr.testing.assert_identical(first, second)


def test_invalid_requests_for_indices_are_refused_in_one_sentence() -> None:
    scan, _ = make_ishigami_scan(64)
    with pytest.raises(ValueError, match="powers of two: give n = 128"):
        vrw.saltelli(ISHIGAMI_RANGES, 100)
    with pytest.raises(ValueError, match="did you mean 'speed'"):
        vrw.sobol_indices(scan, ["sped"])
    with pytest.raises(ValueError, match="there are no measures"):
        vrw.sobol_indices(scan, [])
    of_legs = scan.assign(force=scan.speed.expand_dims(leg=2, axis=1))
    with pytest.raises(ValueError, match="'force' has the axes sample, leg, but"):
        vrw.sobol_indices(of_legs, ["force"])
    attrs = {"scan": {"design": vrw.saltelli(damping=(100.0, 200.0), n=64).describe_design()}}
    with pytest.raises(ValueError, match="varies only damping"):
        vrw.sobol_indices(scan.assign_attrs(attrs), ["speed"])
    with pytest.raises(ValueError, match=r"kind None.*saltelli"):
        vrw.sobol_indices(scan.drop_attrs(), ["speed"])
    scan.outcome.values[0] = vrw.Outcome.NO_CYCLE_FOUND
    with pytest.raises(ValueError, match="only 63 of 64 rows walk throughout"):
        vrw.sobol_indices(scan, ["speed"])


def test_indices_are_by_default_those_of_the_measures_that_were_asked_for() -> None:
    """The period 2 k / g / (1 - e) is a product of e and k, whose variances are integrals."""
    design = vrw.saltelli({"ball.restitution": (0.2, 0.8), "kick": (0.5, 1.5)}, 1024)
    scan = vrw.scan(design, ["period", "velocity"], base=BALL_PARAMS, model=JuggledBall())
    indices = vrw.sobol_indices(scan)
    assert indices.measure.values.tolist() == ["period", "velocity"]
    # k has the mean 1. Squared means of 1 / (1 - e) and k, and their variances over the ranges:
    squares = np.array([(np.log(4.0) / 0.6) ** 2, 1.0])
    variances = np.array([(1.0 / 0.2 - 1.0 / 0.8) / 0.6 - squares[0], 1.0 / 12.0])
    exact = variances * squares[::-1] / ((squares + variances).prod() - squares.prod())
    # The error of indices from 1,024 rows is a few thousandths.
    np.testing.assert_allclose(indices.first_order, [exact, exact], atol=5e-3)

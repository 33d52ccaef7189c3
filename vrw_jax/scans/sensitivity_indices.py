"""Global sensitivity: the shares of a measure's variance by parameter, as Sobol' indices.

`design.saltelli` generates the samples and `scan` computes them like any others. `sobol_indices`
computes the indices from the result with `scipy.stats.sobol_indices` (Saltelli et al. 2010).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.design import SALTELLI_KIND
from vrw_jax.scans.integrity import read_manifest
from vrw_jax.validation import check_names, check_type, suggest_name
from vrw_jax.wheel import Outcome

MIN_SOBOL_ROWS = 64
"""Least number of rows, chosen because indices of fewer rows are noise."""

N_RESAMPLES, INTERVAL_QUANTILES = 200, (0.025, 0.975)
"""Number of bootstrap resamples of the rows, and quantiles that bound the interval."""


def sobol_indices(
    scan: xr.Dataset, measures: Iterable[str] = ("dls_fraction", "speed")
) -> xr.Dataset:
    """Return first-order and total Sobol' indices, shape (measure, parameter), dimensionless.

    The first-order index is the share of a measure's variance that one parameter causes by itself.
    The total index is the share that vanishes if the parameter is fixed. Each has the bounds
    `lower` and `upper` of a 95 % bootstrap interval.

    Rows with a sample that has no gait are omitted, and then as many more as leave a power of two.
    The attribute `rows` is the number of rows used, and `left_out` is the share without a gait. If
    that share is not small, the indices refer to gaits only, whose parameters are not independent.

    Args:
        scan: dataset of a scan over a `saltelli` design.
        measures: names of variables of the scan.

    Returns:
        A dataset of `first_order`, `total` and their intervals.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> design = vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 64)
        >>> indices = vrw.sobol_indices(vrw.scan(design), ["speed"])
        >>> indices.sel(measure="speed").first_order.values.round(1).tolist()
        [0.8, 0.2]
    """
    from scipy.stats import sobol_indices as indices_of

    check_type("scan", scan, xr.Dataset, "give what vrw.scan or vrw.open_scan returned")
    design = read_manifest(scan.attrs).get("design", {})
    if design.get("kind") != SALTELLI_KIND:
        raise ValueError(
            f"the scan's samples are of kind {design.get('kind')!r}, but Sobol' indices need those "
            "of vrw.saltelli({...}, n), or of a table [saltelli]: scan these."
        )
    parameters, measure_names = list(design["swept"]), list(check_names("measures", measures))
    for name in measure_names:
        if name not in scan or scan[name].dims != ("sample",):
            raise ValueError(
                f"{name!r} is no measure of this scan{suggest_name(name, map(str, scan))}: "
                "ask for one that was scanned."
            )
    n_blocks = 2 + len(parameters)
    has_gaits = (scan.outcome.values == Outcome.STEPPED).reshape(n_blocks, -1).all(axis=0)
    rows_with_gaits = np.flatnonzero(has_gaits)
    n = 1 << (len(rows_with_gaits).bit_length() - 1) if len(rows_with_gaits) else 0
    if n < MIN_SOBOL_ROWS:
        raise ValueError(
            f"only {len(rows_with_gaits)} of {len(has_gaits)} rows walk throughout, but indices "
            f"need {MIN_SOBOL_ROWS}: narrow the ranges to where there are gaits, or take more rows."
        )
    rows = rows_with_gaits[:n]
    measure_values = np.stack(
        [scan[name].values.reshape(n_blocks, -1)[:, rows] for name in measure_names], axis=1
    )

    def compute_indices(row_indices: np.ndarray) -> np.ndarray:
        """Return both indices from some rows, shape (2, measures, parameters)."""
        drawn_values = measure_values[..., row_indices]
        scipy_indices = indices_of(
            func={"f_A": drawn_values[0], "f_B": drawn_values[1], "f_AB": drawn_values[2:]}, n=n
        )
        index_kinds, shape = (
            (scipy_indices.first_order, scipy_indices.total_order),
            (len(measure_names), len(parameters)),
        )
        return np.stack([np.reshape(row_indices, shape) for row_indices in index_kinds])

    generator = np.random.default_rng(0)  # seeded, so that the same scan gives the same intervals
    estimates = compute_indices(np.arange(n))
    resampled_estimates = [compute_indices(generator.integers(0, n, n)) for _ in range(N_RESAMPLES)]
    lower, upper = np.quantile(resampled_estimates, INTERVAL_QUANTILES, axis=0)
    data = {}
    for i, (name, label) in enumerate((("first_order", "first-order"), ("total", "total"))):
        attrs = {"units": "1", "long_name": f"{label} Sobol' index"}
        for suffix, bounds in (("", estimates), ("_lower", lower), ("_upper", upper)):
            data[name + suffix] = (("measure", "parameter"), bounds[i], attrs)
    return xr.Dataset(
        data,
        coords={"measure": measure_names, "parameter": parameters},
        attrs={"rows": n, "left_out": 1.0 - len(rows_with_gaits) / len(has_gaits)},
    )

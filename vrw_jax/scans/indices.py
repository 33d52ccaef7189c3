"""Global sensitivity: the shares of a measure's variance by parameter, as Sobol' indices.

`design.saltelli` generates the samples and `scan` computes them like any others. `sobol_indices`
computes the indices from the result with `scipy.stats.sobol_indices` (Saltelli et al. 2010).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.design import SALTELLI
from vrw_jax.scans.soundness import manifest_of
from vrw_jax.wheel import Outcome
from vrw_jax.wording import instance, names_of, nearest

FEWEST = 64
"""Least number of rows, chosen because indices of fewer rows are noise."""

RESAMPLES, QUANTILES = 200, (0.025, 0.975)
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

    instance("scan", scan, xr.Dataset, "give what vrw.scan or vrw.open_scan returned")
    design = manifest_of(scan.attrs).get("design", {})
    if design.get("kind") != SALTELLI:
        raise ValueError(
            f"the scan's samples are of kind {design.get('kind')!r}, but Sobol' indices need those "
            "of vrw.saltelli({...}, n), or of a table [saltelli]: scan these."
        )
    parameters, wanted = list(design["swept"]), list(names_of("measures", measures))
    for name in wanted:
        if name not in scan or scan[name].dims != ("sample",):
            raise ValueError(
                f"{name!r} is no measure of this scan{nearest(name, map(str, scan))}: "
                "ask for one that was scanned."
            )
    blocks = 2 + len(parameters)
    walks = (scan.outcome.values == Outcome.STEPPED).reshape(blocks, -1).all(axis=0)
    kept = np.flatnonzero(walks)
    n = 1 << (len(kept).bit_length() - 1) if len(kept) else 0
    if n < FEWEST:
        raise ValueError(
            f"only {len(kept)} of {len(walks)} rows walk throughout, but indices need {FEWEST}: "
            "narrow the ranges to where there are gaits, or take more rows."
        )
    rows = kept[:n]
    told = np.stack([scan[name].values.reshape(blocks, -1)[:, rows] for name in wanted], axis=1)

    def indices(some: np.ndarray) -> np.ndarray:
        """Return both indices from some rows, shape (2, measures, parameters)."""
        drawn = told[..., some]
        found = indices_of(func={"f_A": drawn[0], "f_B": drawn[1], "f_AB": drawn[2:]}, n=n)
        both, shape = (found.first_order, found.total_order), (len(wanted), len(parameters))
        return np.stack([np.reshape(some, shape) for some in both])

    generator = np.random.default_rng(0)  # seeded, so that the same scan gives the same intervals
    found = indices(np.arange(n))
    spread = [indices(generator.integers(0, n, n)) for _ in range(RESAMPLES)]
    lower, upper = np.quantile(spread, QUANTILES, axis=0)
    named = {}
    for i, (name, label) in enumerate((("first_order", "first-order"), ("total", "total"))):
        attrs = {"units": "1", "long_name": f"{label} Sobol' index"}
        for part, values in (("", found), ("_lower", lower), ("_upper", upper)):
            named[name + part] = (("measure", "parameter"), values[i], attrs)
    return xr.Dataset(
        named,
        coords={"measure": wanted, "parameter": parameters},
        attrs={"rows": n, "left_out": 1.0 - len(kept) / len(walks)},
    )

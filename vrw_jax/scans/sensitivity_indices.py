"""Global sensitivity: the fraction of a measure's variance due to each parameter, as Sobol'
indices.

`design.saltelli` generates the samples and `scan` computes them like any others. `sobol_indices`
computes the indices from the result with `scipy.stats.sobol_indices` (Saltelli et al. 2010).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vrw_jax.runtime import xarray as xr
from vrw_jax.scans.design import SALTELLI_KIND
from vrw_jax.scans.integrity import read_manifest
from vrw_jax.validation import check_names, check_type, suggest_name
from vrw_jax.wheel import Outcome


@dataclass(frozen=True)
class SobolOptions:
    """Options of the estimate of Sobol' indices.

    - `min_rows`: smallest number of rows, chosen because indices of fewer rows are noise;
    - `n_resamples`: number of bootstrap resamples of the rows;
    - `interval_quantiles`: quantiles that bound the interval, chosen for a 95 % interval;
    - `max_roundoff_spread`: largest spread of a measure, as a fraction of its largest magnitude,
      that counts as round-off. It is chosen because that spread is 4e-14 for measures, and 5e-12
      for margins, if parameters differ in their last digit alone.
    """

    min_rows: int = 64
    n_resamples: int = 200
    interval_quantiles: tuple[float, float] = (0.025, 0.975)
    max_roundoff_spread: float = 1e-11


def sobol_indices(
    scan: xr.Dataset, measures: Iterable[str] = ("dls_fraction", "speed")
) -> xr.Dataset:
    """Return first-order and total Sobol' indices, shape (measure, parameter), dimensionless.

    The first-order index is the share of a measure's variance that one parameter causes by itself.
    The total index is the share that would vanish if the parameter were known. Each has the bounds
    `lower` and `upper` of a 95 % bootstrap interval.

    Rows with a sample without a gait are omitted, and then more rows, so that their number `rows`
    is a power of two. `left_out` is the share of rows without a gait. If it is not small, the
    indices are biased: wheels near those without a gait lose more of their rows than other wheels.
    The indices are then not those of the region with gaits.

    A measure that varies by no more than round-off has no variance: its indices are 0, it is marked
    in `is_constant`, and a warning names it.

    Args:
        scan: dataset of a scan over a `saltelli` design.
        measures: names of variables of the scan.

    Returns:
        A dataset of `first_order`, `total`, their intervals and `is_constant`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> design = vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 64)
        >>> indices = vrw.sobol_indices(vrw.scan(design), ["speed"])
        >>> indices.sel(measure="speed").first_order.values.round(1).tolist()
        [0.8, 0.2]
    """
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
    options = SobolOptions()
    n_blocks = 2 + len(parameters)
    has_gaits = (scan.outcome.values == Outcome.STEPPED).reshape(n_blocks, -1).all(axis=0)
    rows_with_gaits = np.flatnonzero(has_gaits)
    n_rows = 1 << (len(rows_with_gaits).bit_length() - 1) if len(rows_with_gaits) else 0
    if n_rows < options.min_rows:
        raise ValueError(
            f"only {len(rows_with_gaits)} of {len(has_gaits)} rows walk throughout, but indices "
            f"need {options.min_rows}: narrow the ranges to where there are gaits, or take more "
            "rows."
        )
    selected_rows = rows_with_gaits[:n_rows]
    measure_values = np.stack(
        [scan[name].values.reshape(n_blocks, -1)[:, selected_rows] for name in measure_names],
        axis=1,
    )

    random_generator = np.random.default_rng(0)  # The same scan gives the same intervals.
    compute_indices = _SobolIndices(measure_values, options.max_roundoff_spread)
    estimates = compute_indices(np.arange(n_rows))
    resampled_estimates = [
        compute_indices(random_generator.integers(0, n_rows, n_rows))
        for _ in range(options.n_resamples)
    ]
    lower, upper = np.quantile(resampled_estimates, options.interval_quantiles, axis=0)
    has_no_variance = compute_indices.is_constant(measure_values)
    if has_no_variance.any():
        warnings.warn(
            f"{', '.join(np.array(measure_names)[has_no_variance])}: constant over these samples "
            "but for round-off, so that there is no variance to share, and the indices are 0.",
            stacklevel=2,
        )
    data: dict[str, tuple] = {}
    for i, (name, label) in enumerate((("first_order", "first-order"), ("total", "total"))):
        attrs = {"units": "1", "long_name": f"{label} Sobol' index"}
        for index_suffix, interval_bounds in (
            ("", estimates),
            ("_lower", lower),
            ("_upper", upper),
        ):
            data[name + index_suffix] = (("measure", "parameter"), interval_bounds[i], attrs)
    data["is_constant"] = (
        "measure",
        has_no_variance,
        {"long_name": "varies by round-off alone"},
    )
    return xr.Dataset(
        data,
        coords={"measure": measure_names, "parameter": parameters},
        attrs={"rows": n_rows, "left_out": 1.0 - len(rows_with_gaits) / len(has_gaits)},
    )


class _SobolIndices:
    """Estimator of first-order and total indices from rows of a design.

    - `values`: measures of the samples, shape (2 + parameters, measures, rows);
    - `roundoff`: spread of each measure that counts as round-off.
    """

    def __init__(self, values: np.ndarray, max_roundoff_spread: float) -> None:
        self.values = values
        self.roundoff = max_roundoff_spread * np.abs(values).max(axis=(0, 2))

    def is_constant(self, values: np.ndarray) -> np.ndarray:
        """Return whether each measure varies only by round-off between these samples."""
        has_small_spread: np.ndarray = np.ptp(values[:2], axis=(0, 2)) <= self.roundoff
        return has_small_spread

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return the indices from these rows, shape (2, measures, parameters); 0 for constant
        measures.
        """
        from scipy.stats import sobol_indices as compute_sobol_indices

        drawn_values = self.values[..., rows]
        is_varying = np.flatnonzero(~self.is_constant(drawn_values))
        n_blocks, n_measures, _ = drawn_values.shape
        indices = np.zeros((2, n_measures, n_blocks - 2))
        if len(is_varying):
            drawn_values = drawn_values[:, is_varying]
            measure_functions = {
                "f_A": drawn_values[0],
                "f_B": drawn_values[1],
                "f_AB": drawn_values[2:],
            }
            estimate = compute_sobol_indices(func=measure_functions, n=len(rows))
            indices[0, is_varying] = np.reshape(estimate.first_order, (len(is_varying), -1))
            indices[1, is_varying] = np.reshape(estimate.total_order, (len(is_varying), -1))
        return indices

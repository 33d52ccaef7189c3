"""Global sensitivity: the fraction of a measure's variance that is due to each parameter, as Sobol'
indices.

`design.saltelli` generates the samples, which `scan` computes as for any other design.
`sobol_indices` computes the indices from the result with `scipy.stats.sobol_indices` (Saltelli et
al. 2010).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import numpy as np

from vrw_jax.base.checks import check_names, check_type, format_name_suggestion
from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.outcomes import Outcome
from vrw_jax.studies.scan_design import SALTELLI_DESIGN_KIND
from vrw_jax.studies.store_integrity import read_scan_manifest

MIN_SALTELLI_ROWS = 64
"""Smallest number of rows of a `saltelli` design, chosen because indices from fewer rows are noise.
"""
N_BOOTSTRAP_RESAMPLES = 200
"""Number of bootstrap resamples of the rows."""
CONFIDENCE_INTERVAL_QUANTILES = (0.025, 0.975)
"""Quantiles that bound the confidence interval, chosen for 95 %."""
MAX_ROUNDOFF_SPREAD = 1e-11
"""Largest spread of a measure that counts as round-off, as a fraction of its largest magnitude. The
value is chosen because round-off in the parameters causes spreads of 4e-14 in measures and 5e-12
in margins.
"""


def sobol_indices(
    scan: xr.Dataset, measures: Iterable[str] = ("dls_fraction", "speed")
) -> xr.Dataset:
    """Return first-order and total Sobol' indices, shape (measure, parameter), dimensionless.

    The first-order index is the fraction of a measure's variance that one parameter causes by
    itself. The total index is the fraction of the variance that remains on average if the values of
    all other parameters are fixed. The suffixes `_lower` and `_upper` name the bounds of a 95 %
    bootstrap interval, such as `total_lower`.

    A row is a group of samples in a `saltelli` design. The coordinate `sample` of the scan states
    which sample belongs to which row, so the samples may be sorted, shuffled or selected. Rows with
    a sample that is absent, has no gait, or has a measure that is NaN or infinite are omitted. A
    warning states how many samples are absent, NaN or infinite. The attribute `left_out` is the
    fraction of omitted rows. Further rows are omitted until their number, the attribute `rows`, is
    a power of two.

    If `left_out` is not small, the indices are biased: wheels near those without a gait lose more
    of their rows than other wheels. The indices are then not those of the region with gaits.

    If a measure varies only by round-off, its indices are 0. The variable `is_constant_measure`
    marks such a measure, and a warning names it.

    Args:
        scan: dataset of a scan over a `saltelli` design.
        measures: names of variables of the scan.

    Returns:
        A dataset that contains `first_order`, `total`, the bounds of their intervals and
        `is_constant_measure`.

    Raises:
        TypeError, ValueError: if an argument is invalid, if too few rows remain, or if the samples
            cannot be assigned to rows; the message names the remedy.

    Examples:
        >>> design = vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 64)
        >>> indices = vrw.sobol_indices(vrw.scan(design), ["speed"])
        >>> indices.sel(measure="speed").first_order.values.round(1).tolist()
        [0.8, 0.2]
    """
    check_type("scan", scan, xr.Dataset, "give what vrw.scan or vrw.open_scan returned")
    design_settings = read_scan_manifest(scan.attrs).get("design", {})
    if design_settings.get("kind") != SALTELLI_DESIGN_KIND:
        raise ValueError(
            f"the scan's samples are of kind {design_settings.get('kind')!r}, but Sobol' indices "
            "need those of vrw.saltelli({...}, n), or of a table [saltelli]: scan these."
        )
    swept_parameters = list(design_settings["swept"])
    measure_names = list(check_names("measures", measures))
    for measure_name in ("outcome", *measure_names):
        if measure_name not in scan or scan[measure_name].dims != ("sample",):
            raise ValueError(
                f"{measure_name!r} is no measure of this "
                f"scan{format_name_suggestion(measure_name, map(str, scan))}: ask for one that was "
                "scanned."
            )
    sample_positions = _locate_design_samples(scan, swept_parameters, design_settings["shape"][0])
    is_present = sample_positions >= 0
    has_gait = is_present & (scan.outcome.values[sample_positions] == Outcome.STEPPED)
    measure_values = np.stack(
        [scan[measure_name].values[sample_positions] for measure_name in measure_names], axis=1
    )
    is_missing = has_gait[:, None] & ~np.isfinite(measure_values)
    is_complete_row = has_gait.all(axis=0) & ~is_missing.any(axis=(0, 1))
    complete_rows = np.flatnonzero(is_complete_row)
    n_saltelli_rows = (1 << len(complete_rows).bit_length()) >> 1  # largest power of 2, or 0
    missing_sample_counts = {"absent": is_present.size - is_present.sum()} | {
        f"NaN or infinite in {measure_name}": n_missing
        for measure_name, n_missing in zip(measure_names, is_missing.sum(axis=(0, 2)), strict=True)
    }
    missing_samples_text = ", ".join(
        f"{n_missing:,} {reason}"
        for reason, n_missing in missing_sample_counts.items()
        if n_missing
    )
    if n_saltelli_rows < MIN_SALTELLI_ROWS:
        samples_note = f" (samples: {missing_samples_text})" if missing_samples_text else ""
        raise ValueError(
            f"only {len(complete_rows)} of {len(is_complete_row)} rows walk "
            f"throughout{samples_note}, but indices need {MIN_SALTELLI_ROWS}: narrow "
            "the ranges to where there are gaits, or take more rows."
        )
    if missing_samples_text:
        warnings.warn(
            f"of {is_present.size:,} samples, {missing_samples_text}: their rows are omitted, and "
            f"the indices are those of {n_saltelli_rows:,} of {len(is_complete_row):,} rows.",
            stacklevel=2,
        )
    measure_values = measure_values[..., complete_rows[:n_saltelli_rows]]

    random_generator = np.random.default_rng(0)  # The same scan gives the same intervals.
    roundoff_spreads = MAX_ROUNDOFF_SPREAD * np.abs(measure_values).max(axis=(0, 2))
    sobol_index_estimates = _estimate_sobol_indices(measure_values, roundoff_spreads)
    resampled_index_estimates = [
        _estimate_sobol_indices(
            measure_values[..., random_generator.integers(0, n_saltelli_rows, n_saltelli_rows)],
            roundoff_spreads,
        )
        for _ in range(N_BOOTSTRAP_RESAMPLES)
    ]
    lower_bounds, upper_bounds = np.quantile(
        resampled_index_estimates, CONFIDENCE_INTERVAL_QUANTILES, axis=0
    )
    is_constant_measure = _detect_constant_measures(measure_values, roundoff_spreads)
    if is_constant_measure.any():
        warnings.warn(
            f"{', '.join(np.array(measure_names)[is_constant_measure])}: constant over these "
            "samples but for round-off, so that there is no variance to share, and the indices are "
            "0.",
            stacklevel=2,
        )
    sobol_index_variables: dict[str, tuple] = {}
    for index_position, index_name in enumerate(("first_order", "total")):
        index_label = index_name.replace("_", "-")
        sobol_index_attributes = {"units": "1", "long_name": f"{index_label} Sobol' index"}
        for name_suffix, index_values in (
            ("", sobol_index_estimates),
            ("_lower", lower_bounds),
            ("_upper", upper_bounds),
        ):
            sobol_index_variables[index_name + name_suffix] = (
                ("measure", "parameter"),
                index_values[index_position],
                sobol_index_attributes,
            )
    sobol_index_variables["is_constant_measure"] = (
        "measure",
        is_constant_measure,
        {"long_name": "varies by round-off alone"},
    )
    return xr.Dataset(
        sobol_index_variables,
        coords={"measure": measure_names, "parameter": swept_parameters},
        attrs={
            "rows": n_saltelli_rows,
            "left_out": 1.0 - len(complete_rows) / len(is_complete_row),
        },
    )


def _locate_design_samples(
    scan: xr.Dataset, swept_parameters: list[str], n_design_samples: int
) -> np.ndarray:
    """Return the position in a scan of each sample of its `saltelli` design, or -1 if the scan does
    not contain the sample, shape (2 + parameters, rows).

    Raise a ValueError if the samples are not identified by labels, or differ from their design.
    """
    n_samples = scan.sizes["sample"]
    has_labels = "sample" in scan.coords
    if not n_samples or (not has_labels and n_samples != n_design_samples):
        raise ValueError(
            f"the scan contains {n_samples:,} of the {n_design_samples:,} samples of its design, "
            "and no coordinate 'sample' identifies them: give the whole scan, with this coordinate."
        )
    sample_labels = scan["sample"].values if has_labels else np.arange(n_samples)
    is_known = np.isin(sample_labels, np.arange(n_design_samples))
    if not is_known.all() or len(np.unique(sample_labels)) < n_samples:
        raise ValueError(
            f"the coordinate 'sample' does not have one whole number from 0 to "
            f"{n_design_samples - 1:,} for each sample: keep this coordinate of vrw.scan."
        )
    n_samples_per_row = 2 + len(swept_parameters)
    sample_positions = np.full((n_samples_per_row, n_design_samples // n_samples_per_row), -1)
    sample_positions.flat[sample_labels.astype(int)] = np.arange(n_samples)
    if all(parameter_name in scan for parameter_name in swept_parameters):
        points_a, points_b, *points_ab = np.stack(
            [scan[parameter_name].values[sample_positions] for parameter_name in swept_parameters],
            axis=1,
        )
        is_swapped = np.eye(len(swept_parameters), dtype=bool)[..., None]
        has_other_values = (points_ab != np.where(is_swapped, points_b, points_a)).any(axis=(0, 1))
        if (has_other_values & (sample_positions >= 0).all(axis=0)).any():
            raise ValueError(
                "the values of the swept parameters are not those of a row of vrw.saltelli, so the "
                "samples have another order or other labels than in their design: keep the "
                "coordinate 'sample' and the parameters of vrw.scan."
            )
    return sample_positions


def _detect_constant_measures(
    measure_values: np.ndarray, roundoff_spreads: np.ndarray
) -> np.ndarray:
    """Return whether each measure varies at most by `roundoff_spreads` between the samples, shape
    (measures,).
    """
    return np.asarray(np.ptp(measure_values[:2], axis=(0, 2)) <= roundoff_spreads)


def _estimate_sobol_indices(measure_values: np.ndarray, roundoff_spreads: np.ndarray) -> np.ndarray:
    """Return first-order and total Sobol' indices, shape (2, measures, parameters).

    Indices of constant measures are 0.

    - `measure_values`: measures of the samples of a `saltelli` design, shape (2 + parameters,
      measures, rows);
    - `roundoff_spreads`: largest spread of each measure that counts as round-off.
    """
    from scipy.stats import sobol_indices as compute_sobol_indices

    n_samples_per_row, n_measures, n_rows = measure_values.shape
    varying_measures = np.flatnonzero(~_detect_constant_measures(measure_values, roundoff_spreads))
    sobol_index_estimates = np.zeros((2, n_measures, n_samples_per_row - 2))
    if len(varying_measures):
        values_a, values_b, *values_ab = measure_values[:, varying_measures]
        scipy_result = compute_sobol_indices(
            func={"f_A": values_a, "f_B": values_b, "f_AB": np.array(values_ab)}, n=n_rows
        )
        # SciPy omits the axis of a single measure.
        sobol_index_estimates[:, varying_measures] = np.reshape(
            [scipy_result.first_order, scipy_result.total_order], (2, len(varying_measures), -1)
        )
    return sobol_index_estimates

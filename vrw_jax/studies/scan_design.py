"""Designs of scans: samples of the wheel's parameters, and the Sobol' indices of their results.

A Sobol' index is the fraction of a measure's variance that is due to a parameter. `saltelli`
generates the samples, which `scan` computes as for any other design. `sobol_indices` computes the
indices from the result with `scipy.stats.sobol_indices` (Saltelli et al. 2010).
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vrw_jax.base.checks import (
    check_int,
    check_names,
    check_range,
    check_type,
    format_name_suggestion,
    format_value,
    require_no_masked_entries,
    require_untraced_arguments,
)
from vrw_jax.base.results import Outcome, format_quantity
from vrw_jax.base.results import xarray as xr
from vrw_jax.wheel.params import FRICTION_NAME, PARAMETER_NAMES

JsonObject = dict[str, Any]
"""Object of JSON: settings, attributes or metadata by name."""

MANIFEST_ATTRIBUTE = "scan"
"""Name of the attribute of a store that contains the settings of the scan."""

REQUESTED_MEASURES_ATTRIBUTE = "asked"
"""Name of the attribute of a store that lists the requested measures."""

ParameterSamples = dict[str, np.ndarray]
"""Swept parameters by name, with one value per sample."""

SWEEPABLE_PARAMETERS = (*PARAMETER_NAMES, FRICTION_NAME)
"""Names of the parameters that a design may sweep: those of the wheel, and the friction of the
ground.
"""

ParameterValues = Sequence[float] | np.ndarray
"""Values of a parameter, in its unit."""

ParameterRange = tuple[float, float]
"""Lower and upper bound of a parameter, in its unit."""

ParameterRanges = Mapping[str, ParameterRange]
"""Range of each parameter, by the parameter's name."""

MAX_LISTED_SAMPLES = 10_000_000
"""Largest number of values of one axis, or of samples in a list.

The value is chosen because such a list fits into memory.
"""

SALTELLI_DESIGN_KIND = "saltelli"
"""Kind of the designs from which Sobol' indices are computed."""


@dataclass(frozen=True, repr=False)
class SampleDesign:
    """Samples of the wheel's parameters, arranged on one or more sample axes.

    A grid contains every combination of the parameters' values and has one axis per parameter. In
    any other design, all parameters may vary together along the axis `sample`.
    """

    values_by_parameter: Mapping[str, np.ndarray]
    design_kind: str

    def __repr__(self) -> str:
        printed_columns = (
            f"{parameter_name} {format_quantity(parameter_values, '')}"
            for parameter_name, parameter_values in self.values_by_parameter.items()
        )
        return f"{self.design_kind} of {self.size:,}: {', '.join(printed_columns)}"

    @property
    def is_grid(self) -> bool:
        """Return whether each parameter has its own axis."""
        return self.design_kind == "grid"

    @property
    def swept_parameters(self) -> tuple[str, ...]:
        """Return the names of the swept parameters."""
        return tuple(self.values_by_parameter)

    @property
    def size(self) -> int:
        """Return the number of samples in the design."""
        return math.prod(self.shape)

    @property
    def dims(self) -> tuple[str, ...]:
        """Return the names of the sample axes of the labeled result."""
        return self.swept_parameters if self.is_grid else ("sample",)

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the lengths of the sample axes of the labeled result."""
        return tuple(map(len, self.values_by_parameter.values()))[: len(self.dims)]

    def select_samples(self, region_of_samples: tuple[slice, ...]) -> ParameterSamples:
        """Return the values of each swept parameter in a rectangular region of samples, by
        parameter.

        Each array of values is flattened, with the last axis varying fastest.

        - `region_of_samples`: one slice for each axis of the design.
        """
        columns: Any = self.values_by_parameter.values()
        if self.is_grid:
            axes = (x[region] for x, region in zip(columns, region_of_samples, strict=True))
            columns = map(np.ravel, np.meshgrid(*axes, indexing="ij"))
        else:
            columns = (x[region_of_samples[0]] for x in columns)
        return dict(zip(self.swept_parameters, columns, strict=True))

    def make_result_coordinates(self) -> dict[str, xr.Variable]:
        """Return the coordinates of the labeled result by their names."""
        coordinates = {
            name: xr.Variable((name,) if self.is_grid else self.dims, values)
            for name, values in self.values_by_parameter.items()
        }
        if self.is_grid:
            return coordinates
        return {"sample": xr.Variable(self.dims, np.arange(self.size))} | coordinates

    def describe_design(self) -> dict[str, object]:
        """Return the settings that identify the design.

        The settings are the kind of the design, the parameter names, the shape, and a SHA-256
        digest of the kind, the names and all samples.
        """
        sample_digest = hashlib.sha256(
            json.dumps([self.design_kind, *self.values_by_parameter]).encode()
        )
        for parameter_values in self.values_by_parameter.values():
            sample_digest.update(np.ascontiguousarray(parameter_values, dtype="<f8").tobytes())
        return {
            "kind": self.design_kind,
            "swept": list(self.swept_parameters),
            "shape": list(self.shape),
            "digest": sample_digest.hexdigest(),
        }


def _merge_mapping_and_keywords(
    function_name: str, parameter_mapping: Mapping | None, parameter_keywords: Mapping
) -> Mapping:
    """Return the parameters of a design as one mapping, given as a mapping or as keywords.

    Raise a TypeError if both `parameter_mapping` and `parameter_keywords` are given, and a
    ValueError if a parameter is unknown or none is given.
    """
    if parameter_mapping is not None and parameter_keywords:
        raise TypeError(
            f"{function_name} has a mapping and the keywords {', '.join(parameter_keywords)}: "
            "give either one mapping or keywords."
        )
    parameter_mapping = parameter_keywords if parameter_mapping is None else parameter_mapping
    check_type("the design", parameter_mapping, Mapping, "write {'damping': (100.0, 200.0)}")
    if not parameter_mapping:
        raise ValueError(
            "the design sweeps no parameter, but a scan needs at least one: "
            f"choose from {', '.join(SWEEPABLE_PARAMETERS)}."
        )
    check_names("the design", parameter_mapping, '"damping"')
    return parameter_mapping


def _parse_value_columns(
    function_name: str, parameter_mapping: Mapping | None, parameter_keywords: Mapping
) -> ParameterSamples:
    """Return the values of each parameter as a vector of floats, by parameter.

    Raise an error if that is impossible.
    """
    value_columns = {}
    given = _merge_mapping_and_keywords(function_name, parameter_mapping, parameter_keywords)
    for name, values in given.items():
        require_untraced_arguments("a design", "use jax.vmap", values)
        require_no_masked_entries(name, values)
        try:
            column = np.atleast_1d(np.asarray(values))
        # Lists may differ in length, and the conversion of a foreign object may raise any error.
        except Exception:
            column = np.array([None])
        if column.dtype.kind not in "fiu" and column.size:
            raise TypeError(
                f"{name} is {format_value(values)}, but it must be a list of numbers: write "
                "[100.0]."
            )
        if column.ndim != 1:
            raise ValueError(
                f"{name} has shape {column.shape}, but it must be a list of numbers: give one axis."
            )
        if not len(column):
            raise ValueError(f"{name} has no values, but a scan needs at least one: add some.")
        value_columns[name] = column.astype(float)
    return value_columns


def grid(
    values: Mapping[str, ParameterValues] | None = None, /, **parameters: ParameterValues
) -> SampleDesign:
    """Return the design that contains every combination of parameter values.

    Args:
        values: values of each parameter, by the parameter's name, as any sequence of numbers.
        **parameters: the same values as keywords, such as `grid(damping=..., slope=...)`, if no
            mapping is given.

    Returns:
        A design whose axes are the parameters.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.grid(damping=[100.0, 150.0], slope=np.linspace(0.28, 0.32, 5)).shape
        (2, 5)
    """
    values_by_swept_parameter = _parse_value_columns("grid", values, parameters)
    for parameter_name, value_column in values_by_swept_parameter.items():
        if len(np.unique(value_column)) != len(value_column):
            raise ValueError(
                f"{parameter_name} holds a value twice, but each value of a grid's axis names "
                "one place: give every value once."
            )
    return SampleDesign(values_by_swept_parameter, "grid")


def samples(
    values: Mapping[str, ParameterValues] | None = None, /, **parameters: ParameterValues
) -> SampleDesign:
    """Return the design that contains a list of samples, such as `samples({"damping": [100],
    "slope": [0.29]})`.

    A sample that is not finite, or outside the domain of a parameter, has the outcome BAD_INPUT.

    Args:
        values: values of each parameter, by the parameter's name, all of one length.
        **parameters: the same values as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.samples({"damping": [100.0, 150.0], "slope": [0.29, 0.30]}).shape
        (2,)
    """
    values_by_swept_parameter = _parse_value_columns("samples", values, parameters)
    column_lengths = {
        parameter_name: len(value_column)
        for parameter_name, value_column in values_by_swept_parameter.items()
    }
    if len(set(column_lengths.values())) > 1:
        raise ValueError(
            f"the columns have lengths {column_lengths}, but a sample takes one value from each: "
            "give columns of one length."
        )
    return SampleDesign(values_by_swept_parameter, "samples")


def sobol(
    ranges: ParameterRanges | None = None,
    n: int | None = None,
    seed: int = 0,
    **parameters: ParameterRange,
) -> SampleDesign:
    """Return a design of `n` samples from a scrambled Sobol' sequence.

    The samples cover the box between the bounds most evenly if `n` is a power of 2.

    Args:
        ranges: lower and upper bound of each parameter, by the parameter's name.
        n: number of samples.
        seed: seed of the scrambling.
        **parameters: the same ranges as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.sobol({"damping": (100.0, 200.0), "slope": (0.28, 0.32)}, 8).shape
        (8,)
    """
    return _draw_box_samples("sobol", ranges, parameters, n, seed)


def uniform(
    ranges: ParameterRanges | None = None,
    n: int | None = None,
    seed: int = 0,
    **parameters: ParameterRange,
) -> SampleDesign:
    """Return a design of `n` independent samples, uniformly distributed between the bounds.

    Args:
        ranges: lower and upper bound of each parameter, by the parameter's name.
        n: number of samples.
        seed: seed of the random numbers.
        **parameters: the same ranges as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.uniform({"damping": (100.0, 200.0), "slope": (0.28, 0.32)}, 8).shape
        (8,)
    """
    return _draw_box_samples("uniform", ranges, parameters, n, seed)


def saltelli(
    ranges: ParameterRanges | None = None,
    n: int | None = None,
    seed: int = 0,
    **parameters: ParameterRange,
) -> SampleDesign:
    """Return the design that `sobol_indices` requires: `n` groups ("rows") of 2 + d samples for d
    parameters.

    A row contains two independent points of the box between the bounds, A and B. It also contains d
    copies of A, in each of which one coordinate is that of B. Samples are ordered A, B, then by
    parameter.

    Args:
        ranges: lower and upper bound of each parameter, by the parameter's name.
        n: number of rows, a power of two.
        seed: seed of the sequence.
        **parameters: the same ranges as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 8).shape
        (32,)
    """
    return _draw_box_samples(SALTELLI_DESIGN_KIND, ranges, parameters, n, seed)


def draw_unit_points(kind: str, n: int, n_dimensions: int, seed: int) -> np.ndarray:
    """Return `n` points of the unit cube, of a scrambled Sobol' sequence or else independent."""
    random = np.random.default_rng(check_int("seed", seed, 0))
    if kind != "sobol":
        return random.random((n, n_dimensions))
    from scipy.stats import qmc  # This import is slow.

    return qmc.Sobol(n_dimensions, rng=random).random_base2((n - 1).bit_length())[:n]


def _draw_box_samples(
    kind: str, ranges: ParameterRanges | None, keywords: ParameterRanges, n: int | None, seed: int
) -> SampleDesign:
    """Return the design of a kind, whose `n` samples or rows are points between the bounds.

    The number of samples has no default. The ranges are a mapping or keywords.
    """
    if n is None:
        raise TypeError(f"n is None, but {kind} needs a number of samples: give n=1024, say.")
    ranges = _merge_mapping_and_keywords(kind, ranges, keywords)
    n = check_int("n", n)
    if n > MAX_LISTED_SAMPLES:
        raise ValueError(
            f"n is {n:,}, but a list takes {MAX_LISTED_SAMPLES:,} samples at most: give fewer, or "
            "a grid."
        )
    bounds = [check_range(f"the range of {name}", pair) for name, pair in ranges.items()]
    if kind == SALTELLI_DESIGN_KIND:
        if n & (n - 1):
            raise ValueError(
                f"n is {n}, but the rows of a Sobol' sequence are balanced for powers of two: "
                f"give n = {1 << n.bit_length()}, say."
            )
        points_a, points_b = np.hsplit(draw_unit_points("sobol", n, 2 * len(bounds), seed), 2)
        swapped = [np.where(is_b, points_b, points_a) for is_b in np.eye(len(bounds), dtype=bool)]
        points = np.concatenate([points_a, points_b, *swapped])
    else:
        points = draw_unit_points(kind, n, len(bounds), seed)
    lower, upper = np.transpose(bounds)
    columns = np.ascontiguousarray((lower + (upper - lower) * points).T)
    return SampleDesign(dict(zip(ranges, columns, strict=True)), kind)


def read_scan_manifest(
    store_attributes: Any, attribute_name: str = MANIFEST_ATTRIBUTE
) -> JsonObject:
    """Return the settings of the scan from the attributes of a store or a labeled result.

    - `attribute_name`: attribute that contains the table; by default that of the settings.
    """
    stored_table = store_attributes.get(attribute_name, {})
    return dict(json.loads(stored_table) if isinstance(stored_table, str) else stored_table)


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


def sobol_indices(scan: xr.Dataset, measures: Iterable[str] | None = None) -> xr.Dataset:
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
        measures: names of variables of the scan; by default the measures that it was asked for
            and that have one value per sample.

    Returns:
        A dataset of `first_order`, `total`, the bounds of their intervals, `is_constant_measure`.

    Raises:
        TypeError, ValueError: if an argument is invalid, if too few rows remain, or if the samples
            cannot be assigned to rows; the message names the remedy.

    Examples:
        >>> design = vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 64)
        >>> indices = vrw.sobol_indices(vrw.scan(design), ["speed"])
        >>> indices.sel(measure="speed").first_order.values.round(1).tolist()
        [0.8, 0.2]
    """
    design, measure_names = _check_index_arguments(scan, measures)
    positions = _locate_design_samples(scan, design["swept"], design["shape"][0])
    is_present = positions >= 0
    has_gait = is_present & (scan.outcome.values[positions] == Outcome.STEPPED)
    values = np.stack([scan[name].values[positions] for name in measure_names], axis=1)
    is_missing = has_gait[:, None] & ~np.isfinite(values)
    is_complete = has_gait.all(axis=0) & ~is_missing.any(axis=(0, 1))
    complete_rows = np.flatnonzero(is_complete)
    n_rows = (1 << len(complete_rows).bit_length()) >> 1  # largest power of 2, or 0
    reasons = "absent", *(f"NaN or infinite in {name}" for name in measure_names)
    counts = np.sum(~is_present), *is_missing.sum(axis=(0, 2))
    missing_text = ", ".join(f"{n:,} {x}" for n, x in zip(counts, reasons, strict=True) if n)
    if n_rows < MIN_SALTELLI_ROWS:
        raise ValueError(
            f"only {len(complete_rows)} of {len(is_complete)} rows walk throughout"
            f"{f' (samples: {missing_text})' if missing_text else ''}, but indices need "
            f"{MIN_SALTELLI_ROWS}: narrow the ranges to where there are gaits, or take more rows."
        )
    if missing_text:
        warnings.warn(
            f"of {is_present.size:,} samples, {missing_text}: their rows are omitted, and "
            f"the indices are those of {n_rows:,} of {len(is_complete):,} rows.",
            stacklevel=2,
        )
    variables = _compute_index_variables(values[..., complete_rows[:n_rows]])
    is_constant = variables["is_constant_measure"][1]
    if is_constant.any():
        warnings.warn(
            f"{', '.join(np.array(measure_names)[is_constant])}: constant over these samples but "
            "for round-off, so that there is no variance to share, and the indices are 0.",
            stacklevel=2,
        )
    return xr.Dataset(
        variables,
        {"measure": measure_names, "parameter": design["swept"]},
        {"rows": n_rows, "left_out": 1.0 - len(complete_rows) / len(is_complete)},
    )


def _check_index_arguments(
    scan: xr.Dataset, measures: Iterable[str] | None
) -> tuple[JsonObject, list[str]]:
    """Return the design of a scan and the names of measures of which it has Sobol' indices."""
    check_type("scan", scan, xr.Dataset, "give what vrw.scan or vrw.open_scan returned")
    design = read_scan_manifest(scan.attrs).get("design", {})
    if design.get("kind") != SALTELLI_DESIGN_KIND:
        raise ValueError(
            f"the scan's samples are of kind {design.get('kind')!r}, but Sobol' indices "
            "need those of vrw.saltelli({...}, n), or of a table [saltelli]: scan these."
        )
    if len(design["swept"]) < 2:
        raise ValueError(
            f"the scan varies only {design['swept'][0]}, which causes all variance of a measure: "
            "give vrw.saltelli the ranges of two parameters or more."
        )
    if measures is None:
        requested_names = str(scan.attrs.get(REQUESTED_MEASURES_ATTRIBUTE, "")).split(", ")
        measures = [
            name
            for name in requested_names
            if name in scan and name != "outcome" and scan[name].dims == ("sample",)
        ]
    measure_names = list(check_names("measures", measures))
    if not measure_names:
        raise ValueError(
            'there are no measures, but indices are of a measure: give measures=["speed"], say.'
        )
    for name in ("outcome", *measure_names):
        if name not in scan:
            raise ValueError(
                f"{name!r} is no measure of this scan{format_name_suggestion(name, map(str, scan))}"
                ": ask for one that was scanned."
            )
        if scan[name].dims != ("sample",):
            raise ValueError(
                f"{name!r} has the axes {', '.join(map(str, scan[name].dims))}, but indices need "
                'one value per sample: reduce it, as by scan.min("leg", keep_attrs=True).'
            )
    return design, measure_names


def _compute_index_variables(values: np.ndarray) -> dict[str, tuple]:
    """Return the variables of `sobol_indices` for the measures of complete rows.

    - `values`: measures of the samples, shape (2 + parameters, measures, rows).
    """
    random, n_rows = np.random.default_rng(0), values.shape[-1]  # equal intervals for equal scans
    roundoff_spreads = MAX_ROUNDOFF_SPREAD * np.abs(values).max(axis=(0, 2))
    resampled = [
        _estimate_sobol_indices(values[..., random.integers(0, n_rows, n_rows)], roundoff_spreads)
        for _ in range(N_BOOTSTRAP_RESAMPLES)
    ]
    lower, upper = np.quantile(resampled, CONFIDENCE_INTERVAL_QUANTILES, axis=0)
    estimates = _estimate_sobol_indices(values, roundoff_spreads)
    tables = {"": estimates, "_lower": lower, "_upper": upper}
    variables: dict[str, tuple] = {
        f"{name}{suffix}": (
            ("measure", "parameter"),
            table[i],
            {"units": "1", "long_name": f"{name.replace('_', '-')} Sobol' index"},
        )
        for i, name in enumerate(("first_order", "total"))
        for suffix, table in tables.items()
    }
    is_constant = _detect_constant_measures(values, roundoff_spreads)
    description = {"long_name": "varies by round-off alone"}
    return variables | {"is_constant_measure": ("measure", is_constant, description)}


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


def require_map_grid(design: SampleDesign) -> None:
    """Raise a ValueError if the design is not a grid over two parameters with ascending values."""
    if len(design.shape) != 2:
        raise ValueError(
            f"the design sweeps {', '.join(design.swept_parameters)}, but a map is a grid over two "
            "parameters: sweep two below [grid], or in vrw.grid."
        )
    for parameter_name in design.swept_parameters:
        parameter_values = design.values_by_parameter[parameter_name]
        if len(parameter_values) < 2 or not np.all(np.diff(parameter_values) > 0.0):
            raise ValueError(
                f"{parameter_name} has the values {parameter_values.tolist()}, but each side of "
                "a map has at least two ascending ones: sort them, or give more."
            )

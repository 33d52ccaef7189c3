"""Data of a fit: tables of measured numbers, with units, errors and conditions of each row."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vrw_jax.base.checks import check_numpy_reals, format_name_suggestion, format_value
from vrw_jax.base.results import xarray as xr
from vrw_jax.studies.fit_problem import HEIGHT_COLUMN

UNIT_FACTORS = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "kg": {"kg": 1.0, "g": 1e-3},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180.0, "°": np.pi / 180.0},
    "1": {"1": 1.0, "": 1.0, "%": 1e-2},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180.0, "°/s": np.pi / 180.0, "rpm": np.pi / 30.0},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
}
"""Factors from accepted units to the SI unit of a quantity."""

ALL_FACTORS = {unit: factor for table in UNIT_FACTORS.values() for unit, factor in table.items()}
"""The same for a quantity of which only a user's function knows the SI unit."""

ERROR_SUFFIX = "_error"
DATASET_DIMENSION = "dataset"
"""Dimension over the data sets of a batch."""
WALK_COLUMN, STEP_COLUMN, TIME_COLUMN = "walk", "step", "time"
COVARIANCE_NAME = "covariance"
SLOWEST_PERIOD = 100.0
"""Largest accepted duration, in units of the square root of leg length over gravity. The periods of
gaits are 1 to 10 of these units, so that a period in ms without its unit is noticed."""

NOISE_RANGE = 5.0
"""Standard errors by which the noise of a short phase may make its measured duration negative."""


class FitData(NamedTuple):
    """Measured numbers in SI units.

    - `kind`: "gaits", "steps" or "series";
    - `names`: names of the measured columns;
    - `values`: measured numbers, shape (data sets, rows, columns);
    - `whitener`: matrices that turn residuals into independent ones of variance 1, shape (rows,
      columns, columns);
    - `errors`: standard errors, shape (rows, columns);
    - `conditions`: columns that describe the walker or its ground, by name;
    - `labels`: columns "walk" and "step" or "time", by name;
    - `is_batch`: whether the data have a dimension over data sets.
    """

    kind: str
    names: tuple[str, ...]
    values: np.ndarray
    whitener: np.ndarray
    errors: np.ndarray
    conditions: dict[str, np.ndarray]
    labels: dict[str, np.ndarray]
    is_batch: bool


def read_data(
    data: Any,
    covariance: Any,
    units: Mapping[str, str],
    conditions: Sequence[str],
    time_unit: float | None,
) -> FitData:
    """Return the numbers of a table, or raise an error with one sentence.

    Durations and fractions that no gait can have are errors too.

    - `units`: SI units of the columns that the walker knows;
    - `conditions`: names of its parameters, which a table may contain for each row;
    - `time_unit`: square root of leg length over gravity, s; None if the walker has no leg.
    """
    table, given_units = _read_table(data)
    covariance = table.pop(COVARIANCE_NAME, covariance)
    lengths = {x.shape[-1] for x in table.values()}
    if not table or 0 in lengths or len(lengths - {1}) > 1:
        raise ValueError(
            f"the columns of data have the lengths {sorted(lengths)}, but each row is one "
            "measurement: give columns of one length, or one number for all rows."
        )
    factors = {name: _find_factor(name, x, given_units, units) for name, x in table.items()}
    n_rows = max(lengths)
    for name, x in table.items():
        table[name] = np.broadcast_to(x * factors[name], (*x.shape[:-1], n_rows))
    kind = "series" if TIME_COLUMN in table else "steps" if STEP_COLUMN in table else "gaits"
    # A height with an error is measured, and one without is that of a foothold.
    ground = () if HEIGHT_COLUMN + ERROR_SUFFIX in table else (HEIGHT_COLUMN,)
    pop = lambda names: {name: table.pop(name) for name in names if name in table}
    labels = pop((WALK_COLUMN, STEP_COLUMN, TIME_COLUMN))
    row_conditions = pop((*conditions, *ground))
    named_errors = pop([name for name in table if name.endswith(ERROR_SUFFIX)])
    names = tuple(table)
    if not names:
        raise ValueError(
            "data contain no measured column, but something must be fitted: give "
            f"{', '.join(list(units)[:4])}, say."
        )
    for error_name in named_errors:
        value_name = error_name.removesuffix(ERROR_SUFFIX)
        if value_name not in names or covariance is not None:
            reason = (
                "covariance= contains the errors"
                if value_name in names
                else (f"data contain no {value_name}{format_name_suggestion(value_name, names)}")
            )
            raise ValueError(
                f"{error_name} is a column of errors, but {reason}: remove or rename that column."
            )
    for name, column in (labels | row_conditions | named_errors).items():
        if column.ndim > 1:
            raise ValueError(
                f"{name} has shape {column.shape}, but all data sets of a batch share their errors "
                "and conditions: give one number for each row, or fit one data set after the other."
            )
    values = np.stack(np.broadcast_arrays(*table.values()), -1)
    scales = np.array([factors[name] for name in names])
    errors, whitener = _read_errors(named_errors, names, covariance, scales, n_rows)
    is_batch = values.ndim == 3
    for i, name in enumerate(names):
        is_duration = name == "period" or name.startswith("duration")
        low, high = float(values[..., i].min()), float(values[..., i].max())
        is_negative = is_duration and low < -NOISE_RANGE * errors[:, i].max()
        if is_negative or (name == "period" and low <= 0.0):
            raise ValueError(f"{name} is {low:g} s, but time passes in a step: check the sign.")
        if name.endswith("_fraction") and not 0.0 <= low <= high <= 1.0:
            raise ValueError(
                f"{name} is {high if high > 1.0 else low:g}, but a fraction lies between 0 and 1: "
                "state the unit % if it is a percentage."
            )
        if is_duration and time_unit and high > SLOWEST_PERIOD * time_unit:
            raise ValueError(
                f"{name} is {high:g} s, but a step of these legs takes less than "
                f"{SLOWEST_PERIOD * time_unit:.3g} s: state the unit, as ms."
            )
    return FitData(
        kind,
        names,
        values if is_batch else values[None],
        whitener,
        errors,
        row_conditions,
        labels,
        is_batch,
    )


def _find_factor(
    name: str, column: np.ndarray, given_units: Mapping[str, str], units: Mapping[str, str]
) -> float:
    """Return the factor from the given unit of a column to the SI unit; 1 without a given unit."""
    if not np.isfinite(column).all():
        raise ValueError(
            f"{name} contains NaN or an infinite number in row "
            f"{np.argwhere(~np.isfinite(column))[0, -1]}, but every measurement is a number: "
            "remove that row, or give it any number with a large error."
        )
    value_name = name.removesuffix(ERROR_SUFFIX)
    unit, si_unit = given_units.get(name) or given_units.get(value_name), units.get(value_name)
    factors = {si_unit: 1.0} | UNIT_FACTORS.get(si_unit, {}) if si_unit else ALL_FACTORS
    if unit is not None and unit not in factors:
        raise ValueError(
            f"{name} has the unit {unit!r}, but it is a quantity in {si_unit or 'SI units'}: "
            f"give one of {', '.join(filter(None, factors))}."
        )
    return 1.0 if unit is None else factors[unit]


def _read_table(data: Any) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the columns of any form of data by name, and their stated units."""
    units: dict[str, str] = {}
    if isinstance(data, str | os.PathLike):
        # Some programs put a byte-order mark before the text.
        with open(data, newline="", encoding="utf-8-sig") as file:
            lines = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
        n_cells = sorted({len(row) for row in lines})
        if len(lines) < 2 or len(n_cells) > 1:
            raise ValueError(
                f"{data} has {len(lines)} lines, with {n_cells} cells, but a table has a heading "
                "and at least one row with as many cells: complete its lines."
            )
        columns: Any = dict(zip(lines[0], zip(*lines[1:], strict=True), strict=True))
    elif isinstance(data, xr.Dataset):
        variables = {str(name): x for name, x in data.variables.items()}
        units = {name: x.attrs["units"] for name, x in variables.items() if "units" in x.attrs}
        columns = {}
        for name, x in variables.items():
            if name == COVARIANCE_NAME:
                columns[name] = x.values
                continue
            if len({*x.dims} - {DATASET_DIMENSION}) > 1:
                raise ValueError(
                    f"{name} has the dimensions {x.dims}, but a column has one, and perhaps "
                    f"{DATASET_DIMENSION!r}: stack the others, as in data.stack(row=(...))."
                )
            columns[name] = x.values
            if x.dims[-1:] == (DATASET_DIMENSION,):  # The data sets are first, and the rows last.
                columns[name] = np.atleast_2d(x.values).T
        columns.pop(DATASET_DIMENSION, None)
    elif isinstance(data, Mapping) or hasattr(data, "columns"):
        units = dict(getattr(data, "attrs", {}).get("units", {}))
        columns = {name: data[name] for name in data}
    else:
        raise TypeError(
            f"data are {format_value(data)}, but they are a table: give an xarray Dataset, a "
            "pandas DataFrame, a dictionary of columns or the name of a CSV file."
        )
    table = {}
    for heading, column in columns.items():
        match = re.fullmatch(r"(.*?)\s*[\[(](.*)[\])]\s*", str(heading))
        name = match[1].strip() if match else str(heading).strip()
        if match:
            units[name] = match[2].strip()
        try:
            numbers = np.asarray(column, float)
        except (TypeError, ValueError):
            raise TypeError(
                f"{name} contains {format_value(next(iter(column)))}, but a column contains "
                "numbers: remove text and empty cells."
            ) from None
        table[name] = np.atleast_1d(check_numpy_reals(name, numbers))
    return table, units


def _read_errors(
    named_errors: Mapping[str, np.ndarray],
    names: tuple[str, ...],
    covariance: Any,
    scales: np.ndarray,
    n_rows: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return standard errors, and the matrices that whiten residuals, in SI units.

    - `scales`: factors from the units of the measured columns, in which `covariance` is.
    """
    n_columns = len(names)
    if covariance is not None:
        matrices = check_numpy_reals("covariance", covariance)
        if matrices.shape not in ((n_columns, n_columns), (n_rows, n_columns, n_columns)):
            raise ValueError(
                f"covariance has shape {matrices.shape}, but the measured columns are "
                f"{', '.join(names)}: give shape ({n_columns}, {n_columns}), or one for each row."
            )
        matrices = np.broadcast_to(
            matrices * np.outer(scales, scales), (n_rows, n_columns, n_columns)
        )
        try:
            factors = np.linalg.cholesky(matrices)
        except np.linalg.LinAlgError:
            raise ValueError(
                "covariance is not positive definite, but no combination of measurements is "
                "exact: check its entries."
            ) from None
        return np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1)), np.linalg.inv(factors)
    for error_name in (name + ERROR_SUFFIX for name in names):
        if error_name not in named_errors:
            raise ValueError(
                f"{error_name.removesuffix(ERROR_SUFFIX)} has no column "
                f"{error_name}{format_name_suggestion(error_name, named_errors)}, "
                "but a fit weighs each number by its standard error: give that column."
            )
        if not (named_errors[error_name] > 0.0).all():
            raise ValueError(
                f"{error_name} is {named_errors[error_name].min():g}, but a standard error is "
                "positive: give the error of each number."
            )
    errors = np.stack([named_errors[name + ERROR_SUFFIX] for name in names], -1)
    return errors, np.eye(n_columns) / errors[:, :, None]

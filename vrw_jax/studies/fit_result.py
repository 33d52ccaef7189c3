"""Data and result of a fit.

The data are tables of measured numbers, with units, errors and conditions of each row. The result
contains estimates with their uncertainty, residuals, and tests of the model.
"""

from __future__ import annotations

import csv
import dataclasses
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_int,
    check_numpy_reals,
    check_real,
    format_name_suggestion,
    format_value,
    require_known_name,
)
from vrw_jax.base.results import format_heading_and_rows, format_html_table
from vrw_jax.base.results import xarray as xr
from vrw_jax.studies.fit_problem import (
    HEIGHT_COLUMN,
    FitProblem,
    FitSolution,
    FitTarget,
    compute_residuals,
    solve_fits,
)

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
    table = {name: np.atleast_1d(column) for name, column in table.items()}
    lengths = {x.shape[-1] for name, x in table.items() if name != COVARIANCE_NAME}
    if not table or 0 in lengths or len(lengths - {1}) > 1:
        raise ValueError(
            f"the columns of data have the lengths {sorted(lengths)}, but each row is one "
            "measurement: give columns of one length, or one number for all rows."
        )
    n_rows = max(lengths)
    kind = "series" if TIME_COLUMN in table else "steps" if STEP_COLUMN in table else "gaits"
    units = {TIME_COLUMN: "s", HEIGHT_COLUMN: "m", **units}
    covariance = table.pop(COVARIANCE_NAME, covariance)
    factors = {name: _find_factor(name, x, given_units, units) for name, x in table.items()}
    table = {name: x * factors[name] for name, x in table.items()}
    label_names = (WALK_COLUMN, STEP_COLUMN, TIME_COLUMN)
    repeat = lambda column: np.broadcast_to(column, (*column.shape[:-1], n_rows))
    labels = {name: repeat(table.pop(name)) for name in label_names if name in table}
    # A height with an error is measured, and one without is that of a foothold.
    is_ground = HEIGHT_COLUMN + ERROR_SUFFIX not in table
    condition_names = (*conditions, *(HEIGHT_COLUMN,) * is_ground)
    row_conditions = {name: repeat(table.pop(name)) for name in condition_names if name in table}
    names = tuple(name for name in table if not name.endswith(ERROR_SUFFIX))
    if not names:
        raise ValueError(
            "data contain no measured column, but something must be fitted: give "
            f"{', '.join(list(units)[:4])}, say."
        )
    errors_by_name = {name: x for name, x in table.items() if name not in names}
    for name, column in (labels | row_conditions | errors_by_name).items():
        if column.ndim > 1:
            raise ValueError(
                f"{name} has shape {column.shape}, but all data sets of a batch share their errors "
                "and conditions: give one number for each row, or fit one data set after the other."
            )
    values = np.stack(np.broadcast_arrays(*(repeat(table[name]) for name in names)), -1)
    scales = np.array([factors[name] for name in names])
    errors, whitener = _read_errors(table, names, covariance, scales, values.shape[-2:])
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
            "remove that row."
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
            if len({*x.dims} - {DATASET_DIMENSION}) > 1 and name != COVARIANCE_NAME:
                raise ValueError(
                    f"{name} has the dimensions {x.dims}, but a column has one, and perhaps "
                    f"{DATASET_DIMENSION!r}: stack the others, as in data.stack(row=(...))."
                )
            columns[name] = x.values
            if x.dims[-1:] == (DATASET_DIMENSION,):  # The data sets are first, and the rows last.
                columns[name] = np.atleast_2d(x.values).T
        columns.pop(DATASET_DIMENSION, None)
        if COVARIANCE_NAME in columns:
            columns[COVARIANCE_NAME] = data[COVARIANCE_NAME].values
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
        table[name] = check_numpy_reals(name, numbers)
    return table, units


def _read_errors(
    table: Mapping[str, np.ndarray],
    names: tuple[str, ...],
    covariance: Any,
    scales: np.ndarray,
    shape: tuple,
) -> tuple[np.ndarray, np.ndarray]:
    """Return standard errors, and the matrices that whiten residuals, in SI units.

    - `scales`: factors from the units of the measured columns, in which `covariance` is.
    """
    n_rows, n_columns = shape
    if covariance is not None:
        matrices = check_numpy_reals("covariance", covariance)
        if matrices.shape not in ((n_columns, n_columns), (n_rows, n_columns, n_columns)):
            raise ValueError(
                f"covariance has shape {matrices.shape}, but the measured columns are "
                f"{', '.join(names)}: give shape ({n_columns}, {n_columns}), or one for each row."
            )
        matrices = matrices * np.outer(scales, scales)
        try:
            factors = np.linalg.cholesky(np.broadcast_to(matrices, (n_rows, n_columns, n_columns)))
        except np.linalg.LinAlgError:
            raise ValueError(
                "covariance is not positive definite, but no combination of measurements is "
                "exact: check its entries."
            ) from None
        errors = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
        return np.broadcast_to(errors, shape).copy(), np.linalg.inv(factors)
    for name in names:
        error_name = name + ERROR_SUFFIX
        if error_name not in table:
            given = [x for x in table if x.endswith(ERROR_SUFFIX)]
            raise ValueError(
                f"{name} has no column {error_name}{format_name_suggestion(error_name, given)}, "
                "but a fit weighs each number by its standard error: give that column."
            )
        if not (table[error_name] > 0.0).all():
            raise ValueError(
                f"{error_name} is {table[error_name].min():g}, but a standard error is positive: "
                "give the error of each number."
            )
    errors = np.stack([np.broadcast_to(table[name + ERROR_SUFFIX], n_rows) for name in names], -1)
    return errors, np.eye(n_columns) / errors[:, :, None]


RELATIVE_RANK_TOLERANCE = 1e-6
"""Smallest singular value of an identifiable direction, relative to the largest one. The value is
chosen because relative errors of derivatives are 1e-8."""
CONVERGED_DISTANCE = 0.01
"""Largest distance to the minimum of a converged fit, in standard errors."""
N_PROFILE_ITERATIONS = 12
PROFILE_TOLERANCE = 1e-3
"""Tolerance of the ends of a profile interval, in standard errors."""
NARROW_WEIGHT = 1e4
"""Weight that fixes an unknown within 1e-4 standard errors."""
PRINTED_COMPONENT = 0.1
"""Smallest printed component of a direction, relative to the largest one."""


@dataclasses.dataclass(frozen=True, repr=False)
class FitResult:
    """Estimates of parameters from measurements, with their uncertainty.

    With a batch of data sets, arrays have a leading axis over these.

    - `names`, `units`: names and SI units of the unknowns;
    - `values`, `standard_errors`: estimates and their standard errors, shape (n,); the error of a
      parameter that the data do not identify is infinite;
    - `covariance`: covariance of the estimates, shape (n, n);
    - `chi2`, `dof`, `p_value`: sum of squared residuals in standard errors, the number of its
      degrees of freedom, and the probability of a larger sum if the model is right;
    - `converged`: whether the search has ended at a minimum;
    - `unidentifiable`: directions in which no prediction changes, each as the relative changes of
      the unknowns by name;
    - `at_bound`: names of unknowns on their bounds;
    - `residuals`: dataset of measured and predicted numbers, and of residuals in standard errors;
    - `params`, `model`: the fitted wheel or parameters, and the fitted model. For a batch, those of
      the start;
    - `data`, `problem`, `target`: the checked data, the predictions, and the compared numbers;
    - `jacobian`: derivatives of the predicted numbers, shape (rows, columns, n).

    Examples:
        >>> data = {"period": [0.700], "period_error": [0.002]}
        >>> data |= {"dls_fraction": [0.50], "dls_fraction_error": [0.01]}
        >>> result = vrw.fit(data, vrw.WheelParams(damping=150.0))
        >>> print(f"{result['damping']:.0f} +- {result.error('damping'):.0f} N s/m")
        162 +- 4 N s/m
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    covariance: np.ndarray
    chi2: Any
    dof: int
    p_value: Any
    converged: Any
    unidentifiable: tuple[dict[str, float], ...]
    at_bound: tuple[str, ...]
    residuals: xr.Dataset
    params: Any
    model: Any
    data: FitData
    problem: FitProblem
    target: FitTarget
    jacobian: np.ndarray

    def __getitem__(self, name: str) -> Any:
        """Return the estimate of one unknown."""
        return self.values[..., self._find(name)][()]

    def error(self, name: str) -> Any:
        """Return the standard error of one unknown."""
        return self.standard_errors[..., self._find(name)][()]

    def _find(self, name: str) -> int:
        require_known_name(name, self.names, "unknown")
        return self.names.index(name)

    @property
    def correlation(self) -> xr.DataArray:
        """Return the correlations of the estimates, NaN where the data identify no value."""
        errors = np.where(np.isfinite(self.standard_errors), self.standard_errors, np.nan)
        values = self.covariance / (errors[..., :, None] * errors[..., None, :])
        return xr.DataArray(
            values,
            dims=(*(DATASET_DIMENSION,) * (values.ndim - 2), "unknown", "other"),
            coords={"unknown": list(self.names), "other": list(self.names)},
        )

    def interval(self, name: str, level: float = 0.95) -> tuple[Any, Any]:
        """Return the interval of one unknown from its standard error.

        Args:
            name: name of the unknown.
            level: probability with which such intervals contain the true value.

        Returns:
            The lower and the upper end.
        """
        half_width = _find_quantile(level) * self.error(name)
        return self[name] - half_width, self[name] + half_width

    def profile_interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Return the interval of one unknown from the profile of chi2.

        At its ends, the smallest chi2 over all other unknowns exceeds the minimum by the square of
        the quantile of the normal distribution. Such an interval needs no linearization.

        Args:
            name: name of the unknown.
            level: probability with which such intervals contain the true value.

        Returns:
            The lower and the upper end, infinite where chi2 does not rise enough.

        Raises:
            ValueError: if the result is a batch, or if the name is unknown.
        """
        self._require_single("profile intervals")
        quantile, index = _find_quantile(level), self._find(name)
        error = self.standard_errors[index]
        if not np.isfinite(error):
            return -np.inf, np.inf
        # A very narrow prior fixes the unknown. Secants find both ends in one batch.
        sides, last_widths, last_roots = np.array([-1.0, 1.0]), np.zeros(2), np.zeros(2)
        widths, starts = np.full(2, error * quantile), np.tile(self.values, (2, 1))
        targets = FitTarget(*(np.stack([x, x]) for x in self.target))
        own_mean, own_weight = self.target.prior_means[index], self.target.prior_weights[index]
        targets.prior_weights[:, index] = NARROW_WEIGHT / error
        for _ in range(N_PROFILE_ITERATIONS):
            positions = self.values[index] + sides * widths
            targets.prior_means[:, index] = starts[:, index] = positions
            solution = solve_fits(self.problem, targets, starts)
            chi2 = summarize(self.problem, targets, solution).chi2
            chi2 = chi2 + (own_weight * (positions - own_mean)) ** 2
            roots = np.sqrt(np.maximum(chi2 - self.chi2, 0.0))
            if np.all(np.abs(roots - quantile) < PROFILE_TOLERANCE):
                break
            changes = np.where(widths != last_widths, widths - last_widths, 1.0)
            rates = (roots - last_roots) / changes
            rates = np.where(rates > 0.0, rates, 1.0 / error)
            last_widths, last_roots = widths, roots
            # An end without a gait has an infinite chi2, so its width is halved.
            widths = widths + np.clip((quantile - roots) / rates, -0.5 * widths, 2.0 * widths)
        is_found = np.abs(roots - quantile) < 0.1
        ends = np.where(is_found, positions, sides * np.inf)
        return float(ends[0]), float(ends[1])

    def log_likelihood(self, values: Array) -> Array:
        """Return the logarithm of the likelihood of the data, plus those of the priors.

        Samplers such as NUTS use this function, which has gradients and works inside `jax.jit` and
        `jax.vmap`. It is minus infinity for a walker without the measured gait or steps. Priors
        count up to a constant.

        Args:
            values: values of all unknowns in the order of `names`, in SI units.

        Returns:
            One number.
        """
        self._require_single("a likelihood")
        values = jnp.asarray(values)
        prediction = self.problem.predict(values)
        target = jax.tree.map(jnp.asarray, self.target)
        residuals = compute_residuals(self.problem, target, values, prediction)
        log_determinant = jnp.sum(jnp.log(jnp.diagonal(self.problem.whitener, axis1=-2, axis2=-1)))
        constant = log_determinant - 0.5 * jnp.log(2.0 * jnp.pi) * self.target.values.size
        return jnp.where(prediction.is_valid, constant - 0.5 * jnp.sum(residuals**2), -jnp.inf)

    def simulate(self, n: int, *, seed: int = 0) -> np.ndarray:
        """Return synthetic data sets: the fitted predictions with new noise.

        Args:
            n: number of data sets.
            seed: seed of the noise.

        Returns:
            Numbers of shape (n, rows, columns), in the order of the measured columns.
        """
        self._require_single("synthetic data")
        random = np.random.default_rng(seed)
        noise = random.standard_normal((check_int("n", n), *self.target.values.shape))
        predicted = [self.residuals[f"{name}_predicted"].values for name in self.data.names]
        factors = np.linalg.inv(self.problem.whitener)
        return np.stack(predicted, -1) + np.einsum("rij,nrj->nri", factors, noise)

    def bootstrap(self, n: int = 200, *, seed: int = 0) -> FitResult:
        """Fit synthetic data sets, whose estimates show the distribution of the estimators.

        Args:
            n: number of data sets.
            seed: seed of the noise.

        Returns:
            A `FitResult` with a leading axis over the data sets.
        """
        values = self.simulate(n, seed=seed)
        prior_noise = np.random.default_rng([seed, 1]).standard_normal((n, len(self.names)))
        weights = self.target.prior_weights
        means = self.values + prior_noise / np.where(weights > 0.0, weights, np.inf)
        targets = FitTarget(values, self.target.row_weights[None], means, weights[None])
        return make_result(
            self.problem, targets, np.tile(self.values, (n, 1)), self.data, self.units,
            self.params, self.model, is_batch=True,
        )  # fmt: skip

    def _require_single(self, purpose: str) -> None:
        if self.values.ndim > 1:
            raise ValueError(
                f"the result has {len(self.values)} data sets, but {purpose} belong to one: fit "
                "one data set."
            )

    def describe(self) -> list[tuple[str, str]]:
        """Return pairs of label and text that summarize the result."""
        units = ["" if unit == "1" else f" {unit}" for unit in self.units]
        if self.values.ndim > 1:
            converged = self.values[np.asarray(self.converged)]
            spreads = [""] * len(self.names)
            if len(converged) > 1:
                spreads = [f", spread {sd:.3g}" for sd in converged.std(0, ddof=1)]
            return [
                ("data sets", f"{len(self.values):,}"),
                ("converged", f"{int(np.sum(self.converged)):,}"),
                *(
                    (name, f"mean {mean:.6g}{spread}{unit}")
                    for name, mean, spread, unit in zip(
                        self.names, self.values.mean(0), spreads, units, strict=True
                    )
                ),
            ]
        rows = [
            (name, f"{value:.6g} +- {error:.3g}{unit}")
            for name, value, error, unit in zip(
                self.names, self.values, self.standard_errors, units, strict=True
            )
        ]
        correlation = np.abs(np.nan_to_num(self.correlation.values)) - np.eye(len(self.names))
        if correlation.max() > 0.0:
            i, j = np.unravel_index(np.argmax(correlation), correlation.shape)
            pair = self.correlation.values[i, j]
            rows.append(
                ("largest correlation", f"{pair:.2f} of {self.names[i]} and {self.names[j]}")
            )
        test = f"{self.chi2:.3g} with {self.dof} degrees of freedom"
        if self.dof > 0:
            test += f", p = {self.p_value:.2g}"
        rows.append(("chi2", test))
        if not self.converged:
            rows.append(("search", "no minimum was found: give other parameters or bounds"))
        rows += [("at a bound", name) for name in self.at_bound]
        rows += [("not identifiable", format_direction(x)) for x in self.unidentifiable]
        return rows

    def __repr__(self) -> str:
        return format_heading_and_rows("FitResult", self.describe())

    def _repr_html_(self) -> str:
        return format_html_table("FitResult", self.describe())


def format_direction(direction: dict[str, float]) -> str:
    """Return a direction as text, such as `+1.00 stiffness +1.00 damping`, in relative changes."""
    largest = max(map(abs, direction.values()))
    return " ".join(
        f"{component / largest:+.2f} {name}"
        for name, component in direction.items()
        if abs(component) > PRINTED_COMPONENT * largest
    )


def _find_quantile(level: float) -> float:
    """Return the half width of a normal interval with a probability, in standard errors."""
    from scipy.special import ndtri

    level = check_real("level", level)
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level:g}, but it is a probability: give 0.95, say.")
    return float(ndtri(0.5 + 0.5 * level))


class FitSummary(NamedTuple):
    """Statistics of a batch of fits, as arrays with the axis of the batch first."""

    chi2: Any
    covariance: Any
    standard_errors: Any
    distance: Any
    is_at_bound: Any
    directions: Any
    whitened: Any


def summarize(problem: FitProblem, targets: FitTarget, solution: FitSolution) -> FitSummary:
    """Return chi2, covariance and distance to the minimum of each fit."""
    x, n = solution.unknowns, solution.unknowns.shape[-1]
    whitener = np.asarray(problem.whitener)
    weights = np.broadcast_to(targets.row_weights, (len(x), len(whitener)))[..., None]
    raw = np.asarray(targets.values) - solution.predicted
    whitened = weights * np.einsum("rij,brj->bri", whitener, raw)
    slopes = -weights[..., None] * np.einsum("rij,brju->briu", whitener, solution.jacobian)
    prior_weights = np.broadcast_to(targets.prior_weights, x.shape)
    residuals = np.concatenate(
        [whitened.reshape(len(x), -1), prior_weights * (x - targets.prior_means)], -1
    )
    residuals[~solution.is_valid] = np.inf
    scale = np.asarray(problem.scale)
    jacobian = (
        np.concatenate([slopes.reshape(len(x), -1, n), prior_weights[:, :, None] * np.eye(n)], 1)
        * scale
    )
    jacobian[~solution.is_valid] = 0.0
    margin = 1e-6 * scale
    lower, upper = np.asarray(problem.lower), np.asarray(problem.upper)
    is_at_bound = (x <= lower + margin) | (x >= upper - margin)
    _, singular, right = np.linalg.svd(jacobian, full_matrices=False)
    # The sign of a direction is arbitrary: its largest entry is positive.
    largest = np.take_along_axis(right, np.abs(right).argmax(-1)[..., None], -1)
    right = np.where(largest < 0.0, -right, right)
    is_known = singular > RELATIVE_RANK_TOLERANCE * singular[:, :1]
    inverse = np.where(is_known, 1.0 / np.where(is_known, singular, 1.0), 0.0)
    half = scale[:, None] * np.swapaxes(right, -1, -2) * inverse[:, None, :]
    covariance = half @ np.swapaxes(half, -1, -2)
    unknown_share = np.where(is_known[..., None], 0.0, right**2).sum(1)
    errors = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    errors = np.where(unknown_share > RELATIVE_RANK_TOLERANCE, np.inf, errors)
    # Unknowns on their bounds do not move.
    free_jacobian = np.where(is_at_bound[:, None, :], 0.0, jacobian)
    finite_residuals = np.where(np.isfinite(residuals), residuals, 0.0)
    gradient = np.einsum("bmn,bm->bn", free_jacobian, finite_residuals)
    hessian = np.einsum("bmn,bmk->bnk", free_jacobian, free_jacobian)
    step = np.einsum("bnk,bk->bn", np.linalg.pinv(hessian, rcond=1e-12, hermitian=True), gradient)
    distance = np.linalg.norm(np.einsum("bmn,bn->bm", free_jacobian, step), axis=-1)
    distance = np.where(solution.is_valid, distance, np.inf)
    directions = [right[i][~is_known[i]] for i in range(len(x))] if not is_known.all() else []
    return FitSummary(
        np.sum(residuals**2, -1), covariance, errors, distance, is_at_bound, directions, whitened
    )


def make_result(
    problem: FitProblem,
    targets: FitTarget,
    starts: np.ndarray,
    data: FitData,
    units: tuple[str, ...],
    params: Any,
    model: Any,
    *,
    is_batch: bool,
) -> FitResult:
    """Fit each target from its start. Unless the data are a batch, return the best of the fits."""
    from scipy.special import gammaincc

    solution = solve_fits(problem, targets, starts)
    summary = summarize(problem, targets, solution)
    n_numbers = int(np.sum(targets.row_weights[0])) * len(data.names)
    dof = n_numbers + int(np.sum(targets.prior_weights[0] > 0.0)) - len(units)
    best = int(np.argmin(summary.chi2))
    pick = (lambda x: x) if is_batch else (lambda x: x[best])
    dims = (*(DATASET_DIMENSION,) * is_batch, "row")
    variables: dict[str, Any] = {}
    measured = np.broadcast_to(targets.values, solution.predicted.shape)
    for i, name in enumerate(data.names):
        variables[name] = dims, pick(measured)[..., i]
        variables[f"{name}_predicted"] = dims, pick(solution.predicted)[..., i]
        variables[f"{name}_error"] = "row", data.errors[:, i]
        variables[f"{name}_residual"] = dims, pick(summary.whitened)[..., i]
    described = (data.labels | data.conditions).items()
    index = {name: ("row", x) for name, x in described if x.shape == data.errors.shape[:1]}
    if not is_batch and bool(solution.is_valid[best]):
        values, _ = problem.place_unknowns(jnp.asarray(solution.unknowns[best]))
        model, params = problem.unpack(values)
    directions = () if is_batch or not summary.directions else summary.directions[best]
    chi2 = pick(summary.chi2)
    return FitResult(
        names=problem.unknown_names,
        units=units,
        values=pick(solution.unknowns),
        standard_errors=pick(summary.standard_errors),
        covariance=pick(summary.covariance),
        chi2=chi2 if is_batch else float(chi2),
        dof=dof,
        p_value=gammaincc(0.5 * dof, 0.5 * chi2) if dof > 0 else np.full_like(chi2, np.nan)[()],
        converged=pick(
            solution.is_valid & (solution.has_ended | (summary.distance < CONVERGED_DISTANCE))
        )[()],
        unidentifiable=tuple(
            dict(zip(problem.unknown_names, map(float, direction), strict=True))
            for direction in directions
        ),
        at_bound=()
        if is_batch
        else tuple(np.array(problem.unknown_names)[summary.is_at_bound[best]].tolist()),
        residuals=xr.Dataset(variables, index),
        params=params,
        model=model,
        data=data,
        problem=problem,
        target=targets
        if is_batch
        else FitTarget(*(np.asarray(x)[min(best, len(x) - 1)] for x in targets)),
        jacobian=pick(solution.jacobian),
    )

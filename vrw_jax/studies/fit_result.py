"""Result of a fit: estimates with their uncertainty, residuals, and tests of the model."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import check_int, check_real, require_known_name
from vrw_jax.base.results import format_heading_and_rows, format_html_table
from vrw_jax.base.results import xarray as xr
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.studies.fit_data import DATASET_DIMENSION, ERROR_SUFFIX, FitData
from vrw_jax.studies.fit_problem import FitProblem, FitTarget, solve_fits, whiten
from vrw_jax.studies.least_squares import FitPoint, propose_unknowns

RELATIVE_RANK_TOLERANCE = 1e-6
"""Smallest singular value of an identifiable direction, relative to the largest one. The value is
chosen because relative errors of derivatives are 1e-8."""
CONVERGED_DISTANCE = 0.01
"""Largest distance to the minimum of a converged fit, in standard errors."""
CONVERGED_CHANGE = 1e-7
"""Largest distance to the minimum relative to the typical sizes of unknowns, which suffices too: it
is near the errors of predictions, which may exceed very small errors of the data."""
AT_BOUND_MARGIN = 1e-6
"""Largest distance of an unknown on its bound, relative to the typical size."""
N_PROFILE_ITERATIONS = 12
PROFILE_TOLERANCE = 1e-3
"""Tolerance of the ends of a profile interval, in standard errors."""
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
    - `data`, `problem`, `target`: the checked data, the predictions, and the compared numbers with
      an axis over data sets;
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
        names = list(self.names)
        return xr.DataArray(
            self.covariance / (errors[..., :, None] * errors[..., None, :]),
            {"unknown": names, "other": names},
            (DATASET_DIMENSION, "unknown", "other")[-self.covariance.ndim :],
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
        unknowns = self.problem.unknowns
        # Newton's method finds both ends in one batch.
        sides, widths = np.array([-1.0, 1.0]), np.full(2, error * quantile)
        points, is_fixed = np.tile(self.values, (2, 1)), np.arange(len(self.names)) == index
        for _ in range(N_PROFILE_ITERATIONS):
            position = self.values[index] + sides * widths
            points[:, index] = np.clip(position, unknowns.lower[index], unknowns.upper[index])
            solution = solve_fits(self.problem, self.target, points, is_fixed)
            roots = np.sqrt(np.maximum(solution.chi2 - self.chi2, 0.0))
            if np.all(np.abs(roots - quantile) < PROFILE_TOLERANCE):
                break
            # All other derivatives of chi2 are zero at the minimum over the other unknowns.
            residuals = np.where(np.isfinite(solution.residuals), solution.residuals, 0.0)
            slopes = sides * np.sum(residuals * solution.jacobian[..., index], -1)
            is_usable = (slopes > 0.0) & (roots > 0.0)
            rates = np.where(is_usable, slopes, 1.0) / np.where(is_usable, roots, error)
            # An end without a gait has an infinite chi2, so its width is halved.
            widths = widths + np.clip((quantile - roots) / rates, -0.5 * widths, 2.0 * widths)
            points = np.array(solution.unknowns)
        is_found = np.abs(roots - quantile) < 0.1
        low, high = np.where(is_found, solution.unknowns[:, index], sides * np.inf)
        return float(low), float(high)

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
        target = FitTarget(*(jnp.asarray(x[0]) for x in self.target))
        residuals = jnp.concatenate(
            [jnp.ravel(x) for x in whiten(target, values, prediction.values)]
        )
        log_determinant = jnp.sum(jnp.log(jnp.diagonal(target.whitener, axis1=-2, axis2=-1)))
        constant = log_determinant - 0.5 * jnp.log(2.0 * jnp.pi) * target.values.size
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
        noise = random.standard_normal((check_int("n", n), *self.target.values.shape[1:], 1))
        predicted = [self.residuals[f"{name}_predicted"].values for name in self.data.names]
        factors = np.linalg.inv(self.target.whitener)
        return np.stack(predicted, -1) + (factors @ noise)[..., 0]

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
        target = self.target._replace(values=values, prior_means=means)
        starts = np.tile(self.values, (n, 1))
        return make_result(self.problem, target, starts, self.data, is_batch=True)

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
            spreads = converged.std(0, ddof=1) if len(converged) > 1 else [None] * len(units)
            rows = [
                ("data sets", f"{len(self.values):,}"),
                ("converged", f"{len(converged):,}"),
            ]
            for name, mean, sd, unit in zip(
                self.names, self.values.mean(0), spreads, units, strict=True
            ):
                spread = "" if sd is None else f", spread {sd:.3g}"
                rows.append((name, f"mean {mean:.6g}{spread}{unit}"))
            return rows
        rows = [
            (name, f"{value:.6g} +- {error:.3g}{unit}")
            for name, value, error, unit in zip(
                self.names, self.values, self.standard_errors, units, strict=True
            )
        ]
        pairs = np.nan_to_num(np.tril(self.correlation.values, -1))
        i, j = np.unravel_index(np.argmax(np.abs(pairs)), pairs.shape)
        if pairs[i, j]:
            names = f"{self.names[j]} and {self.names[i]}"
            rows.append(("largest correlation", f"{pairs[i, j]:.2f} of {names}"))
        test = f"{self.chi2:.3g} with {self.dof} degrees of freedom"
        rows.append(("chi2", test + (f", p = {self.p_value:.2g}" if self.dof > 0 else "")))
        if not np.isfinite(self.chi2):
            rows.append(
                ("search", "no walker with all measured gaits or steps was found: check units")
            )
        elif not self.converged:
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


def make_result(
    problem: FitProblem, target: FitTarget, starts: np.ndarray, data: FitData, is_batch: bool
) -> FitResult:
    """Fit each target from its start. Unless the data are a batch, return the best of the fits."""
    from scipy.special import gammaincc

    fits = solve_fits(problem, target, starts)
    names, units, lower, upper, scale = problem.unknowns
    if not is_batch:
        fits = select_tree_rows(fits, [np.argmin(fits.chi2)])
    drop_axis = lambda x: x if is_batch else x[0]
    chi2, (predicted, jacobian) = fits.chi2, fits.prediction
    has_estimates = not is_batch and np.isfinite(chi2[0])
    estimates = problem.name_unknowns(jnp.asarray(fits.unknowns[0])) if has_estimates else {}
    model, params = problem.unpack(problem.collect_values(estimates, {}))
    dof = data.values[0].size + int(np.sum(target.prior_weights[0] > 0.0)) - len(names)
    covariance, errors, directions = estimate_covariance(fits, scale)
    best, decrease = propose_unknowns(fits, lower, upper, False, 0.0)
    change = np.max(np.abs(best - fits.unknowns) / scale, -1)
    is_minimum = (decrease < CONVERGED_DISTANCE**2) | (change < CONVERGED_CHANGE)
    margin = AT_BOUND_MARGIN * scale
    is_at_bound = (fits.unknowns <= lower + margin) | (fits.unknowns >= upper - margin)
    columns = {
        "": np.broadcast_to(target.values, predicted.shape),
        "_predicted": predicted,
        "_residual": whiten(target, fits.unknowns, predicted)[0],
    }
    dims = (DATASET_DIMENSION, "row")[not is_batch :]
    variables: dict[str, Any] = {}
    for i, name in enumerate(data.names):
        variables |= {name + end: (dims, drop_axis(x)[..., i]) for end, x in columns.items()}
        variables[name + ERROR_SUFFIX] = "row", data.errors[:, i]
    described = data.labels | data.conditions
    return FitResult(
        names=names,
        units=units,
        values=drop_axis(fits.unknowns),
        standard_errors=drop_axis(errors),
        covariance=drop_axis(covariance),
        chi2=drop_axis(chi2),
        dof=dof,
        p_value=drop_axis(gammaincc(0.5 * dof, 0.5 * chi2) if dof > 0 else chi2 * np.nan),
        converged=drop_axis(np.isfinite(chi2) & is_minimum),
        unidentifiable=()
        if is_batch
        else tuple(dict(zip(names, x.tolist(), strict=True)) for x in directions[0]),
        at_bound=() if is_batch else tuple(itertools.compress(names, is_at_bound[0])),
        residuals=xr.Dataset(variables, {name: ("row", x) for name, x in described.items()}),
        params=params,
        model=model,
        data=data,
        problem=problem,
        target=target,
        jacobian=drop_axis(jacobian),
    )


def estimate_covariance(
    fits: FitPoint, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return covariance and standard errors of the unknowns, and directions without information."""
    _, singular, right = np.linalg.svd(fits.jacobian * scale, full_matrices=False)
    # The sign of a direction is arbitrary: its largest entry is positive.
    largest = np.take_along_axis(right, np.abs(right).argmax(-1)[..., None], -1)
    right = np.where(largest < 0.0, -right, right)
    is_known = singular > RELATIVE_RANK_TOLERANCE * singular[:, :1]
    inverse = np.divide(1.0, singular, out=np.zeros_like(singular), where=is_known)
    factors = scale[:, None] * np.swapaxes(right * inverse[..., None], -1, -2)
    covariance = factors @ np.swapaxes(factors, -1, -2)
    unknown_share = np.sum(np.where(is_known[..., None], 0.0, right**2), 1)
    errors = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    errors = np.where(unknown_share > RELATIVE_RANK_TOLERANCE, np.inf, errors)
    # Without a prediction, no direction is known to be without information.
    is_missing = ~is_known & np.isfinite(fits.chi2)[:, None]
    return covariance, errors, [x[missing] for x, missing in zip(right, is_missing, strict=True)]

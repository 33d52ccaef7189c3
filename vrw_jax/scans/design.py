"""Designs of a scan: samples of the wheel's parameters, as a grid or as a list."""

import abc
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vrw_jax.printing import format_quantity
from vrw_jax.validation import (
    check_int,
    check_not_traced,
    check_range,
    check_type,
    format_value,
)
from vrw_jax.wheel import FRICTION_NAME, PARAMETER_NAMES, check_parameter_name

SampleColumns = dict[str, np.ndarray]
"""Swept parameters by name, with one value per sample."""

SWEEPABLE_PARAMETERS = (*PARAMETER_NAMES, FRICTION_NAME)
"""Parameters that a design may sweep: those of the wheel, and the ground's friction."""

ParameterRange = tuple[float, float]
"""Lower and upper bound of a parameter, in its unit."""

MAX_LISTED_SAMPLES = 10_000_000
"""Largest number of values of an axis or of samples in a list, chosen because they fit into
memory.
"""

SALTELLI_KIND = "saltelli"
"""Kind of the designs from which Sobol' indices are computed."""


class AbstractDesign(abc.ABC):
    """Samples of the wheel's parameters, arranged in an array of shape `shape`."""

    kind: str
    values: Mapping[str, np.ndarray]

    def __repr__(self) -> str:
        columns = (f"{name} {format_quantity(values, '')}" for name, values in self.values.items())
        return f"{self.kind} of {self.size:,}: {', '.join(columns)}"

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the swept parameters."""
        return tuple(self.values)

    @property
    def size(self) -> int:
        """Return the number of samples."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    @abc.abstractmethod
    def dims(self) -> tuple[str, ...]:
        """Return the names of the axes of a labeled result."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Return the lengths of the axes."""

    @abc.abstractmethod
    def sample_block(self, region: tuple[slice, ...]) -> SampleColumns:
        """Return the samples of a rectangular region by parameter, flattened with the last axis
        fastest.
        """

    @abc.abstractmethod
    def result_coordinates(self) -> dict[str, tuple[str, np.ndarray]]:
        """Return the coordinates of a labeled result: for each name the axis and the values."""

    def describe_identity(self) -> dict[str, object]:
        """Return the identity of the design: kind, names, shape and a digest of all numbers."""
        return {
            "kind": self.kind,
            "swept": list(self.names),
            "shape": list(self.shape),
            "digest": digest_columns(self.kind, self.values),
        }


def digest_columns(kind: str, values: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 digest of a kind, and of the names and values of the columns."""
    digest = hashlib.sha256(json.dumps([kind, *values]).encode())
    for column in values.values():
        digest.update(np.ascontiguousarray(column, dtype="<f8").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, repr=False)
class Grid(AbstractDesign):
    """Design of every combination of the parameters' values, with one axis per parameter."""

    values: Mapping[str, np.ndarray]
    kind: str = "grid"

    @property
    def dims(self) -> tuple[str, ...]:
        return self.names

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(column) for column in self.values.values())

    def sample_block(self, region: tuple[slice, ...]) -> SampleColumns:
        axis_columns = [
            column[axis_region]
            for column, axis_region in zip(self.values.values(), region, strict=True)
        ]
        mesh_columns = np.meshgrid(*axis_columns, indexing="ij")
        return {name: axis.ravel() for name, axis in zip(self.names, mesh_columns, strict=True)}

    def result_coordinates(self) -> dict[str, tuple[str, np.ndarray]]:
        return {name: (name, column) for name, column in self.values.items()}


@dataclass(frozen=True, repr=False)
class Samples(AbstractDesign):
    """Design of single samples along the axis `sample`; all parameters may vary together."""

    values: Mapping[str, np.ndarray]
    kind: str = "samples"

    @property
    def dims(self) -> tuple[str, ...]:
        return ("sample",)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(next(iter(self.values.values()))),)

    def sample_block(self, region: tuple[slice, ...]) -> SampleColumns:
        return {name: column[region[0]] for name, column in self.values.items()}

    def result_coordinates(self) -> dict[str, tuple[str, np.ndarray]]:
        index = {"sample": ("sample", np.arange(self.size))}
        return index | {name: ("sample", column) for name, column in self.values.items()}


def _require_one_form(name: str, mapping: Mapping | None, keyword_values: Mapping) -> Mapping:
    """Return the parameters of a design, given either as one mapping or as keywords."""
    if mapping is not None and keyword_values:
        raise TypeError(
            f"{name} has a mapping and the keywords {', '.join(keyword_values)}: give either "
            "one mapping or keywords."
        )
    return keyword_values if mapping is None else mapping


def _require_count(name: str, n: int | None) -> int:
    """Return the number of samples, which has no default; raise a TypeError if it is None."""
    if n is None:
        raise TypeError(f"n is None, but {name} needs a number of samples: give n=1024, say.")
    return n


def grid(
    values: Mapping[str, Sequence[float] | np.ndarray] | None = None,
    /,
    **parameters: Sequence[float] | np.ndarray,
) -> Grid:
    """Return the design of every combination of the values, e.g. `grid(damping=..., slope=...)`.

    Args:
        values: the values of each parameter, as any sequence of numbers.
        **parameters: the same as keywords, if no mapping is given.

    Returns:
        A design whose axes are the parameters.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.grid(damping=[100.0, 150.0], slope=np.linspace(0.28, 0.32, 5)).shape
        (2, 5)
    """
    values = _require_one_form("grid", values, parameters)
    columns = {name: _to_column(name, value) for name, value in _require_sweepable(values).items()}
    for name, column in columns.items():
        if len(np.unique(column)) != len(column):
            raise ValueError(
                f"{name} holds a value twice, but each value of a grid's axis names one place: "
                "give every value once."
            )
    return Grid(columns)


def samples(
    values: Mapping[str, Sequence[float] | np.ndarray] | None = None,
    /,
    **parameters: Sequence[float] | np.ndarray,
) -> Samples:
    """Return the design of given samples, e.g. `samples({"damping": [100], "slope": [0.29]})`.

    A sample outside a parameter's domain, or not finite, gets the outcome BAD_INPUT.

    Args:
        values: the values of each parameter, all of one length.
        **parameters: the same as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.samples({"damping": [100.0, 150.0], "slope": [0.29, 0.30]}).shape
        (2,)
    """
    values = _require_one_form("samples", values, parameters)
    columns = {name: _to_column(name, value) for name, value in _require_sweepable(values).items()}
    column_lengths = {name: len(column) for name, column in columns.items()}
    if len(set(column_lengths.values())) > 1:
        raise ValueError(
            f"the columns have lengths {column_lengths}, but a sample takes one value from each: "
            "give columns of one length."
        )
    return Samples(columns)


def sobol(
    ranges: Mapping[str, ParameterRange] | None = None,
    n: int | None = None,
    seed: int = 0,
    **parameters: ParameterRange,
) -> Samples:
    """Return `n` samples of a scrambled Sobol' sequence.

    The samples are spread most evenly if n is a power of 2.

    Args:
        ranges: lower and upper bound of each parameter.
        n: number of samples.
        seed: seed of the scrambling.
        **parameters: the ranges as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.sobol({"damping": (100.0, 200.0), "slope": (0.28, 0.32)}, 8).shape
        (8,)
    """
    from scipy.stats import qmc  # This import is slow.

    n, ranges = _require_count("sobol", n), _require_one_form("sobol", ranges, parameters)
    names, lower, upper, n = _parse_box(ranges, n)
    exponent = max(int(n - 1).bit_length(), 0)
    unit_points = qmc.Sobol(len(names), rng=_make_generator(seed)).random_base2(exponent)[:n]
    return _scale_to_box(names, lower, upper, unit_points, "sobol")


def uniform(
    ranges: Mapping[str, ParameterRange] | None = None,
    n: int | None = None,
    seed: int = 0,
    **parameters: ParameterRange,
) -> Samples:
    """Return `n` independent samples, uniformly distributed over the box.

    Args:
        ranges: lower and upper bound of each parameter.
        n: number of samples.
        seed: seed of the random numbers.
        **parameters: the ranges as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.uniform({"damping": (100.0, 200.0), "slope": (0.28, 0.32)}, 8).shape
        (8,)
    """
    n, ranges = _require_count("uniform", n), _require_one_form("uniform", ranges, parameters)
    names, lower, upper, n = _parse_box(ranges, n)
    unit_points = _make_generator(seed).random((n, len(names)))
    return _scale_to_box(names, lower, upper, unit_points, "uniform")


def saltelli(
    ranges: Mapping[str, ParameterRange] | None = None,
    n: int | None = None,
    seed: int = 0,
    **parameters: ParameterRange,
) -> Samples:
    """Return samples for `sobol_indices`: `n` rows of 2 + d samples for d parameters.

    A row holds two independent points of the box, A and B, and copies of A in which one coordinate
    is taken from B. Samples are ordered A, B, then by parameter.

    Args:
        ranges: lower and upper bound of each parameter.
        n: number of rows, a power of two.
        seed: seed of the sequence.
        **parameters: the ranges as keywords, if no mapping is given.

    Returns:
        A design over the axis `sample`.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 8).shape
        (32,)
    """
    from scipy.stats import qmc  # This import is slow.

    n, ranges = _require_count("saltelli", n), _require_one_form("saltelli", ranges, parameters)
    names, lower, upper, n = _parse_box(ranges, n)
    if n & (n - 1):
        raise ValueError(
            f"n is {n}, but the rows of a Sobol' sequence are balanced for powers of two: "
            f"give n = {1 << n.bit_length()}, say."
        )
    n_parameters = len(names)
    unit_points = qmc.Sobol(2 * n_parameters, rng=_make_generator(seed)).random_base2(
        n.bit_length() - 1
    )
    first_points, second_points = unit_points[:, :n_parameters], unit_points[:, n_parameters:]
    mixed_points = [
        np.where(np.arange(n_parameters) == parameter_index, second_points, first_points)
        for parameter_index in range(n_parameters)
    ]
    return _scale_to_box(
        names,
        lower,
        upper,
        np.concatenate([first_points, second_points, *mixed_points]),
        SALTELLI_KIND,
    )


def _scale_to_box(
    names: list[str], lower: np.ndarray, upper: np.ndarray, unit_points: np.ndarray, kind: str
) -> Samples:
    """Return the design of points of the unit cube, shape (samples, parameters), scaled to the
    box.
    """
    values = lower + (upper - lower) * unit_points
    return Samples(dict(zip(names, np.ascontiguousarray(values.T), strict=True)), kind)


def _make_generator(seed: int) -> np.random.Generator:
    """Return a generator of random numbers; raise an error if the seed is not a whole number."""
    return np.random.default_rng(check_int("seed", seed, 0))


def _parse_box(
    ranges: Mapping[str, ParameterRange], n: int
) -> tuple[list[str], np.ndarray, np.ndarray, int]:
    """Return names, lower and upper bounds of the parameters, and the number of samples."""
    n = check_int("n", n)
    if n > MAX_LISTED_SAMPLES:
        raise ValueError(
            f"n is {n:,}, but a list takes {MAX_LISTED_SAMPLES:,} samples at most: give fewer, or "
            "a grid."
        )
    bound_pairs = [
        check_range(f"the range of {name}", bound_pair)
        for name, bound_pair in _require_sweepable(ranges).items()
    ]
    bounds = np.asarray(bound_pairs)
    return list(ranges), bounds[:, 0], bounds[:, 1], n


def _require_sweepable(values: Mapping[str, object]) -> Mapping:
    """Return `values`; raise a ValueError if a name is not a sweepable parameter or there is
    none.
    """
    check_type("the design", values, Mapping, "write {'damping': (100.0, 200.0)}")
    if not values:
        raise ValueError(
            "the design sweeps no parameter, but a scan needs at least one: "
            f"choose from {', '.join(SWEEPABLE_PARAMETERS)}."
        )
    for name in values:
        check_parameter_name(name, SWEEPABLE_PARAMETERS, "parameter that can be swept")
    return values


def _to_column(name: str, value: object) -> np.ndarray:
    """Return the values of one parameter as a vector; raise an error if they are not numbers."""
    check_not_traced("a design", "use jax.vmap", value)
    try:
        column = np.atleast_1d(np.asarray(value))
    # Lists may have different lengths, and the conversion of a foreign object may raise any error.
    except Exception:
        column = np.array([None])
    if column.dtype.kind not in "fiu" and column.size:
        raise TypeError(
            f"{name} is {format_value(value)}, but it must be a list of numbers: write [100.0]."
        )
    column = column.astype(float)
    if column.ndim != 1:
        raise ValueError(
            f"{name} has shape {column.shape}, but it must be a list of numbers: give one axis."
        )
    if not len(column):
        raise ValueError(f"{name} has no values, but a scan needs at least one: add some.")
    return column

"""What a scan looks at: samples of the wheel's parameters, as a grid or as a list."""

import abc
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vrw_jax.wheel import FRICTION, PARAMETER_NAMES
from vrw_jax.wording import instance, range_of, require_known, shown, told, untraced, whole

Columns = dict[str, np.ndarray]
"""One value per sample of each parameter that is swept."""
SWEPT = (*PARAMETER_NAMES, FRICTION)
"""What may be swept: the wheel's parameters, and the friction of a ground that has one."""
Range = tuple[float, float]
LONGEST = 10_000_000
"""Values of an axis, or samples of a list, at most: they are held in memory."""
SALTELLI = "saltelli"
"""Kind of the samples that Sobol' indices are read off."""


class AbstractDesign(abc.ABC):
    """Samples laid out over `shape`; a block of that shape is one unit of work."""

    kind: str
    values: Mapping[str, np.ndarray]

    def __repr__(self) -> str:
        columns = (f"{name} {told(values, '')}" for name, values in self.values.items())
        return f"{self.kind} of {self.size:,}: {', '.join(columns)}"

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters that are swept."""
        return tuple(self.values)

    @property
    def size(self) -> int:
        """Number of samples."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    @abc.abstractmethod
    def dims(self) -> tuple[str, ...]:
        """Names of the axes of a labelled result."""

    @property
    @abc.abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Lengths of those axes."""

    @abc.abstractmethod
    def block(self, region: tuple[slice, ...]) -> Columns:
        """The samples of a rectangular region, flat, the last axis fastest."""

    @abc.abstractmethod
    def coordinates(self) -> dict[str, tuple[str, np.ndarray]]:
        """Coordinates of a labelled result: name -> (axis, values)."""

    def description(self) -> dict[str, object]:
        """What makes this design this one: kind, names, axes and a digest of every number."""
        return {
            "kind": self.kind,
            "swept": list(self.names),
            "shape": list(self.shape),
            "digest": digest_of(self.kind, self.values),
        }


def digest_of(kind: str, values: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256(json.dumps([kind, *values]).encode())
    for column in values.values():
        digest.update(np.ascontiguousarray(column, dtype="<f8").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, repr=False)
class Grid(AbstractDesign):
    """Every combination of the values given for each parameter; one axis per parameter."""

    values: Mapping[str, np.ndarray]
    kind: str = "grid"

    @property
    def dims(self) -> tuple[str, ...]:
        return self.names

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(column) for column in self.values.values())

    def block(self, region: tuple[slice, ...]) -> Columns:
        pieces = [column[part] for column, part in zip(self.values.values(), region, strict=True)]
        mesh = np.meshgrid(*pieces, indexing="ij")
        return {name: axis.ravel() for name, axis in zip(self.names, mesh, strict=True)}

    def coordinates(self) -> dict[str, tuple[str, np.ndarray]]:
        return {name: (name, column) for name, column in self.values.items()}


@dataclass(frozen=True, repr=False)
class Samples(AbstractDesign):
    """Samples one by one, along the axis `sample`; all parameters may vary at once."""

    values: Mapping[str, np.ndarray]
    kind: str = "samples"

    @property
    def dims(self) -> tuple[str, ...]:
        return ("sample",)

    @property
    def shape(self) -> tuple[int, ...]:
        return (len(next(iter(self.values.values()))),)

    def block(self, region: tuple[slice, ...]) -> Columns:
        return {name: column[region[0]] for name, column in self.values.items()}

    def coordinates(self) -> dict[str, tuple[str, np.ndarray]]:
        index = {"sample": ("sample", np.arange(self.size))}
        return index | {name: ("sample", column) for name, column in self.values.items()}


def grid(**values: Sequence[float] | np.ndarray) -> Grid:
    """Every combination of the values of each parameter, e.g. `grid(damping=..., slope=...)`.

    Args:
        **values: of each parameter, any sequence of numbers.

    Returns:
        A design whose axes are the parameters.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> vrw.grid(damping=[100.0, 150.0], slope=np.linspace(0.28, 0.32, 5)).shape
        (2, 5)
    """
    columns = {name: _column(name, value) for name, value in _known(values).items()}
    for name, column in columns.items():
        if len(np.unique(column)) != len(column):
            raise ValueError(
                f"{name} holds a value twice, but each value of a grid's axis names one place: "
                "give every value once."
            )
    return Grid(columns)


def samples(values: Mapping[str, Sequence[float] | np.ndarray]) -> Samples:
    """The samples given, e.g. `samples({"damping": [100, 150], "slope": [0.29, 0.30]})`.

    A sample out of a parameter's domain, or not finite, gets the outcome BAD_INPUT.

    Args:
        values: of each parameter, all of one length.

    Returns:
        A design over `sample`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> vrw.samples({"damping": [100.0, 150.0], "slope": [0.29, 0.30]}).shape
        (2,)
    """
    columns = {name: _column(name, value) for name, value in _known(values).items()}
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(
            f"the columns have lengths {lengths}, but a sample takes one value from each: "
            "give columns of one length."
        )
    return Samples(columns)


def sobol(ranges: Mapping[str, Range], n: int, seed: int = 0) -> Samples:
    """`n` samples of a scrambled Sobol' sequence; even spread is best where n is a power of 2.

    Args:
        ranges: lower and upper, of each parameter.
        n: number of samples.
        seed: of the sequence.

    Returns:
        A design over `sample`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> vrw.sobol({"damping": (100.0, 200.0), "slope": (0.28, 0.32)}, 8).shape
        (8,)
    """
    from scipy.stats import qmc  # only drawing needs it, and its import is slow

    names, lower, upper = _box(ranges, n)
    exponent = max(int(n - 1).bit_length(), 0)
    points = qmc.Sobol(len(names), rng=_generator(seed)).random_base2(exponent)[:n]
    return _spread(names, lower, upper, points, "sobol")


def uniform(ranges: Mapping[str, Range], n: int, seed: int = 0) -> Samples:
    """`n` independent samples, uniform over the box.

    Args:
        ranges: lower and upper, of each parameter.
        n: number of samples.
        seed: of the sequence.

    Returns:
        A design over `sample`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> vrw.uniform({"damping": (100.0, 200.0), "slope": (0.28, 0.32)}, 8).shape
        (8,)
    """
    names, lower, upper = _box(ranges, n)
    points = _generator(seed).random((n, len(names)))
    return _spread(names, lower, upper, points, "uniform")


def saltelli(ranges: Mapping[str, Range], n: int, seed: int = 0) -> Samples:
    """Samples for `indices.sobol_indices`: for d parameters, `n` rows of 2 + d, n a power of two.

    A row holds two independent points of the box, A and B, and A with each coordinate in turn taken
    from B. Samples are ordered A, B, then by parameter.

    Args:
        ranges: lower and upper, of each parameter.
        n: number of rows, a power of two.
        seed: of the sequence.

    Returns:
        A design over `sample`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> vrw.saltelli({"damping": (100.0, 180.0), "slope": (0.27, 0.29)}, 8).shape
        (32,)
    """
    from scipy.stats import qmc  # only drawing needs it, and its import is slow

    names, lower, upper = _box(ranges, n)
    if n & (n - 1):
        raise ValueError(
            f"n is {n}, but the rows of a Sobol' sequence are balanced for powers of two: "
            f"give n = {1 << n.bit_length()}, say."
        )
    d = len(names)
    points = qmc.Sobol(2 * d, rng=_generator(seed)).random_base2(n.bit_length() - 1)
    a, b = points[:, :d], points[:, d:]
    mixed = [np.where(np.arange(d) == i, b, a) for i in range(d)]
    return _spread(names, lower, upper, np.concatenate([a, b, *mixed]), SALTELLI)


def _spread(
    names: list[str], lower: np.ndarray, upper: np.ndarray, points: np.ndarray, kind: str
) -> Samples:
    values = lower + (upper - lower) * points
    return Samples(dict(zip(names, np.ascontiguousarray(values.T), strict=True)), kind)


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(whole("seed", seed, 0))


def _box(ranges: Mapping[str, Range], n: int) -> tuple[list[str], np.ndarray, np.ndarray]:
    if whole("n", n) > LONGEST:
        raise ValueError(
            f"n is {n:,}, but a list takes {LONGEST:,} samples at most: give fewer, or a grid."
        )
    pairs = [range_of(f"the range of {name}", pair) for name, pair in _known(ranges).items()]
    bounds = np.asarray(pairs)
    return list(ranges), bounds[:, 0], bounds[:, 1]


def _known(values: Mapping[str, object]) -> Mapping:
    """`values`, if they name parameters that can be swept."""
    instance("the design", values, Mapping, "write {'damping': (100.0, 200.0)}")
    if not values:
        raise ValueError(
            "the design sweeps no parameter, but a scan needs at least one: "
            f"choose from {', '.join(SWEPT)}."
        )
    for name in values:
        require_known(name, SWEPT, "parameter that can be swept")
    return values


def _column(name: str, value: object) -> np.ndarray:
    untraced("a design", "use jax.vmap", value)
    column = np.atleast_1d(np.asarray(value))
    if column.dtype.kind not in "fiu" and column.size:
        raise TypeError(
            f"{name} is {shown(value)}, but it must be a list of numbers: write [100.0]."
        )
    column = column.astype(float)
    if column.ndim != 1:
        raise ValueError(
            f"{name} has shape {column.shape}, but it must be a list of numbers: give one axis."
        )
    if not len(column):
        raise ValueError(f"{name} has no values, but a scan needs at least one: add some.")
    return column

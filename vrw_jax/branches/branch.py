"""What a continuation hands back: a labelled branch with its borders, and a border as a curve."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.numerics import floquet
from vrw_jax.results import MEASURES
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import Outcome
from vrw_jax.wording import as_html

MOST_SHOWN = 20
"""Borders that a branch prints of itself."""


class FixedPoint(NamedTuple):
    """A fixed point of a return map at one value of the parameter.

    - `section`: the numbers that the map moves;
    - `jacobian`: of the map.
    """

    section: np.ndarray
    parameter: float
    jacobian: np.ndarray

    @property
    def multipliers(self) -> np.ndarray:
        """Eigenvalues of the Jacobian, the one of largest modulus first."""
        return np.asarray(floquet.multipliers(jnp.asarray(self.jacobian)))

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of a multiplier."""
        return float(np.max(np.abs(self.multipliers)))


@dataclass(frozen=True, repr=False)
class Border:
    """Where a branch changes its nature.

    `kind` is "fold", "period_doubling", "neimark_sacker", "border_collision" (the indicator or
    monitor `name` is zero) or "lost" (the order of events changes: `name` says which).

    - `value`: of the parameter;
    - `point`: beside it, on the side that belongs to the branch;
    - `ends_branch`: whether the branch goes no further;
    - `find_cycle`: finds the gait there, as the property `cycle`.

    Examples:
        >>> branch = vrw.continue_map(lambda _, x, r: r * x * (1.0 - x), [0.6], 2.5, (2.0, 3.5))
        >>> print(branch.borders[0].kind, branch.borders[0].ends_branch)
        period_doubling False
    """

    kind: str
    name: str
    value: float
    point: FixedPoint
    ends_branch: bool
    find_cycle: Callable[[], Any] | None = field(default=None, repr=False, compare=False)

    @functools.cached_property
    def cycle(self) -> Any:
        """The `LimitCycle` there; for models without one, the `FixedPoint`."""
        return self.point if self.find_cycle is None else self.find_cycle()

    def __str__(self) -> str:
        name = "" if self.name == self.kind else f" {self.name}"
        ends = ", ends the branch" if self.ends_branch else ""
        return f"{self.value:.9g}: {self.kind.replace('_', ' ')}{name}{ends}"

    def __repr__(self) -> str:
        return f"Border at {self}"


@dataclass(frozen=True, repr=False)
class Branch:
    """Gaits along one parameter, in the order of the branch, and its borders in the same order.

    `dataset` has the dimension `point`; the parameter is a coordinate on it, which turns back at
    folds. `ends` says for the branch's first and last point why it was followed no further.

    - `parameter`: its name;
    - `borders`: each a `Border`;
    - `outcome`: NO_CYCLE_FOUND or BAD_INPUT if there was none to start from.

    Examples:
        >>> branch = vrw.continue_map(lambda _, x, r: r * x * (1.0 - x), [0.6], 2.5, (2.0, 3.5))
        >>> branch.parameter, branch.ends
        ('parameter', ("The parameter's range ended.", "The parameter's range ended."))
    """

    parameter: str
    dataset: xr.Dataset
    borders: tuple[Border, ...]
    ends: tuple[str, str]
    outcome: Outcome

    @property
    def values(self) -> np.ndarray:
        """The parameter at each point."""
        return self.dataset[self.parameter].values

    @property
    def multipliers(self) -> np.ndarray:
        """Complex multipliers, shape (point, n), the one of largest modulus first."""
        return self.dataset.multiplier_real.values + 1j * self.dataset.multiplier_imag.values

    @property
    def stable(self) -> np.ndarray:
        """Whether the gait at each point attracts its neighbours."""
        return self.dataset.spectral_radius.values < 1.0

    def __str__(self) -> str:
        if not self.values.size:
            return f"Branch along {self.parameter}: none. {self.outcome.meaning}"
        known = self.parameter in MEASURES
        unit = f" {MEASURES[self.parameter].plain_unit}".rstrip() if known else ""
        stable = self.stable
        lines = [
            f"Branch along {self.parameter}: {self.values.size} gaits from {self.values[0]:.6g} to "
            f"{self.values[-1]:.6g}{unit}, {int(stable.sum())} stable, {int((~stable).sum())} not.",
            f"  at {self.values[0]:.6g}: {self.ends[0]}",
            f"  at {self.values[-1]:.6g}: {self.ends[1]}",
            f"  {len(self.borders)} borders" + (":" if self.borders else "."),
            *(f"    {border}" for border in self.borders[:MOST_SHOWN]),
        ]
        if len(self.borders) > MOST_SHOWN:
            lines.append(f"    and {len(self.borders) - MOST_SHOWN} more, in .borders")
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        ends = ("", "ends the branch")
        return as_html(
            str(self).split("\n  ")[0],
            ((f"{b.value:.9g}", b.kind.replace("_", " "), b.name, ends[b.ends_branch])
             for b in self.borders),
            (self.parameter, "kind", "name", ""),
        )  # fmt: skip


@dataclass(frozen=True)
class Meeting:
    """A point of codimension two: a border's curve meets another border there."""

    name: str  # of the other border
    values: tuple[float, float]  # of the two parameters
    ends_curve: bool  # whether gaits end there

    def __str__(self) -> str:
        ends = ", ends the curve" if self.ends_curve else ""
        return f"({self.values[0]:.9g}, {self.values[1]:.9g}): meets {self.name}{ends}"


@dataclass(frozen=True, repr=False)
class BorderCurve:
    """A border in two parameters, its points in order along the dimension `point`.

    - `name`: of the border;
    - `parameters`: names of the two;
    - `dataset`: durations, spectral radius and section state along the curve;
    - `meetings`: where it meets other borders, points of codimension two;
    - `ends`: for either end why it was followed no further; both alike where it is closed.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.border_curve("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> curve.values.shape[1], curve.parameters
        (2, ('damping', 'stiffness'))
    """

    name: str
    parameters: tuple[str, str]
    dataset: xr.Dataset
    meetings: tuple[Meeting, ...]
    ends: tuple[str, str]

    @property
    def values(self) -> np.ndarray:
        """The two parameters at each point, (point, 2)."""
        return np.stack([self.dataset[name].values for name in self.parameters], -1)

    def __str__(self) -> str:
        first, second = self.parameters
        lines = [f"Border {self.name} over {first} and {second}: {len(self.values)} points."]
        for end, text in zip((0, -1), self.ends, strict=True):
            lines.append(f"  at ({self.values[end][0]:.6g}, {self.values[end][1]:.6g}): {text}")
        return "\n".join([*lines, *(f"    {meeting}" for meeting in self.meetings)])

    __repr__ = __str__

"""Rows of the table of facts, the evidence for them, and the comparison of claims with numbers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

from vrw_jax.results import PHASES
from vrw_jax.wheel import WheelParams


@dataclass(frozen=True)
class Fact:
    """Row of the table: claim, source, published and computed value, and whether they agree."""

    group: str
    claim: str
    where: str
    published: str
    found: str
    holds: bool
    reason: str  # reason for the tolerance, or what makes the fact fail

    @property
    def by_code(self) -> bool:
        """Return whether an independent code gives the reference number, not the paper."""
        return CODE in self.where or CODE in self.published

    @property
    def verdict(self) -> str:
        """Return whether the fact holds, as text."""
        return "holds" if self.holds else "does not hold"


@dataclass(frozen=True)
class Evidence:
    """Labelled results from which all facts are computed."""

    params: WheelParams  # of Table 1
    settling: xr.Dataset  # `gaits.walk_into_gait` from the start for Table 1
    gait: xr.Dataset  # three steps of the gait of Table 1, `simulate`
    by_damping: Sequence[xr.Dataset]  # one step at c = 50, 100, 200
    branch: xr.Dataset  # `gaits.measure_gaits_along` damping 1, 2, ..., 224 at slope 0.30
    gentler: xr.Dataset  # `gaits.measure_gaits_along` slope down to 0.10 at c = 100
    gentle: xr.Dataset  # `gaits.measure_gaits_along` damping up to 220 at slope 0.10
    gentle_low: xr.Dataset  # `gaits.measure_gaits_along` damping down to 4 at slope 0.10
    too_fast: xr.Dataset  # `gaits.walk_into_gait` from a start with 2 rad/s at Table 1

    @property
    def table_1(self) -> xr.Dataset:
        """Return the gait of Table 1."""
        return self.branch.sel(damping=200.0)


CODE = "independent code"
"""Source of a number that the paper does not print."""
DIGIT = "half a unit of the last digit published"
"""Reason for the usual tolerance."""
SIGN = "a sign: no tolerance"
"""Reason for a comparison without a tolerance."""
ROUND_OFF = 1e-9
"""Tolerance of numbers that differ by the error of a step, in SI units."""

Numbers = Mapping[str, Any]
"""Numbers of a group of claims by name, computed from the evidence."""


@dataclass(frozen=True)
class Claim:
    """Published statement, text of the computed value, and condition of their agreement."""

    claim: str
    where: str
    published: str
    found: str  # format string of the numbers of the group
    holds: Callable[[Any], bool]  # takes the numbers of the group as attributes
    reason: str = DIGIT


@dataclass(frozen=True)
class Group:
    """Claims under one heading that use the same numbers."""

    title: str
    numbers: Callable[[Evidence], Numbers]
    claims: tuple[Claim, ...]

    def facts(self, evidence: Evidence) -> list[Fact]:
        """Return the facts of the claims."""
        numbers = self.numbers(evidence)
        told = SimpleNamespace(**numbers)
        return [
            Fact(
                group=self.title,
                claim=c.claim,
                where=c.where,
                published=c.published,
                found=c.found.format(**numbers),
                holds=bool(c.holds(told)),
                reason=c.reason,
            )
            for c in self.claims
        ]


def near(**published: tuple[float | tuple[float, ...], float]) -> Callable[[Any], bool]:
    """Return the condition that each named number is within a tolerance of its published value."""
    return lambda n: all(
        bool(np.all(np.abs(np.asarray(getattr(n, name)) - value) <= tolerance))
        for name, (value, tolerance) in published.items()
    )


def first_step(gait: xr.Dataset) -> xr.Dataset:
    """Return the first step of a trajectory."""
    return gait.isel(time=gait.step.values == 0)


def by_phase(gait: xr.Dataset) -> list[xr.Dataset]:
    """Return the DLS, SLS-I and SLS-II of a trajectory."""
    return [gait.isel(time=gait.phase.values == phase) for phase in range(len(PHASES))]

"""One row of the table, the evidence it is read off, and how claims are held against numbers."""

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
    """One row: what is claimed, where, what was published, what was found, whether it holds."""

    group: str
    claim: str
    where: str
    published: str
    found: str
    holds: bool
    reason: str  # for the tolerance, or what would make it fail

    @property
    def by_code(self) -> bool:
        """Whether the number to meet is not printed, but an independent code's."""
        return CODE in self.where or CODE in self.published

    @property
    def verdict(self) -> str:
        return "holds" if self.holds else "does not hold"


@dataclass(frozen=True)
class Evidence:
    """Labelled results that the facts are read off; nothing else goes into the table."""

    params: WheelParams  # of Table 1
    settling: xr.Dataset  # `gaits.approach` from the start for Table 1
    gait: xr.Dataset  # three steps of the gait of Table 1, `simulate`
    by_damping: Sequence[xr.Dataset]  # one step at c = 50, 100, 200
    branch: xr.Dataset  # `gaits.along` damping 1, 2, ..., 224 at slope 0.30
    gentler: xr.Dataset  # `gaits.along` slope down to 0.10 at c = 100
    gentle: xr.Dataset  # `gaits.along` damping up to 220 at slope 0.10
    gentle_low: xr.Dataset  # `gaits.along` damping down to 4 at slope 0.10
    too_fast: xr.Dataset  # `gaits.approach` from a start with 2 rad/s at Table 1

    @property
    def table_1(self) -> xr.Dataset:
        return self.branch.sel(damping=200.0)


CODE = "independent code"
DIGIT = "half a unit of the last digit published"
SIGN = "a sign: no tolerance"
ROUND_OFF = 1e-9

Numbers = Mapping[str, Any]
"""What a group of claims speaks of, read off the evidence."""


@dataclass(frozen=True)
class Claim:
    """What is published, how the numbers tell what was found, and when the two agree."""

    claim: str
    where: str
    published: str
    found: str  # a format of the group's numbers
    holds: Callable[[Any], bool]  # asked with the group's numbers as attributes
    reason: str = DIGIT


@dataclass(frozen=True)
class Group:
    """Claims under one heading that speak of the same numbers."""

    title: str
    numbers: Callable[[Evidence], Numbers]
    claims: tuple[Claim, ...]

    def facts(self, evidence: Evidence) -> list[Fact]:
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
    """Holds where every number named lies at its published value, within the tolerance."""
    return lambda n: all(
        bool(np.all(np.abs(np.asarray(getattr(n, name)) - value) <= tolerance))
        for name, (value, tolerance) in published.items()
    )


def first_step(gait: xr.Dataset) -> xr.Dataset:
    return gait.isel(time=gait.step.values == 0)


def by_phase(gait: xr.Dataset) -> list[xr.Dataset]:
    """Its DLS, SLS-I and SLS-II."""
    return [gait.isel(time=gait.phase.values == phase) for phase in range(len(PHASES))]

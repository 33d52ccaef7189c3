"""One row of the table, the evidence it is read off, and how numbers are compared."""

from collections.abc import Sequence
from dataclasses import dataclass

import xarray as xr

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
    def verdict(self) -> str:
        """Holds, or does not hold."""
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
        """Measures of the gait of Table 1."""
        return self.branch.sel(damping=200.0)


DIGIT = "half a unit of the last digit published"
SIGN = "a sign: no tolerance"
ROUND_OFF = 1e-9


def near(value: float, published: float, tolerance: float) -> bool:
    return bool(abs(value - published) <= tolerance)


def first_step(gait: xr.Dataset) -> xr.Dataset:
    return gait.isel(time=gait.step.values == 0)


def in_phase(gait: xr.Dataset, phase: int) -> xr.Dataset:
    return gait.isel(time=gait.phase.values == phase)

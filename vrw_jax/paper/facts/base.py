"""Facts of the table, their evidence, and the comparison of claims with computed numbers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

from vrw_jax.measures import PHASE_NAMES
from vrw_jax.wheel import WheelParams


@dataclass(frozen=True)
class Fact:
    """Row of the table: claim, source, published and computed value, and whether they agree."""

    group: str
    claim: str
    source: str
    published_value: str
    computed: str
    holds: bool
    tolerance_reason: str  # reason for the tolerance, or condition of failure

    @property
    def is_from_reference_code(self) -> bool:
        """Return whether an independent code gives the reference number, not the paper."""
        return REFERENCE_CODE_LABEL in self.source or REFERENCE_CODE_LABEL in self.published_value

    @property
    def verdict(self) -> str:
        """Return whether the fact holds, as text."""
        return "holds" if self.holds else "does not hold"


@dataclass(frozen=True)
class Evidence:
    """Labeled results from which all facts are computed."""

    params: WheelParams  # of Table 1
    settling_walk: xr.Dataset  # `gaits.walk_into_gait` from the start for Table 1
    table_1_trajectory: xr.Dataset  # three steps of the gait of Table 1, `simulate`
    gaits_by_damping: Sequence[xr.Dataset]  # one step at c = 50, 100, 200
    damping_branch: xr.Dataset  # `gaits.measure_gaits_along` damping 1, 2, ..., 224 at slope 0.30
    slope_branch: xr.Dataset  # `gaits.measure_gaits_along` slope down to 0.10 at c = 100
    gentle_slope_branch: xr.Dataset  # `gaits.measure_gaits_along` damping up to 220 at slope 0.10
    # `gaits.measure_gaits_along` damping down to 4 at slope 0.10
    gentle_slope_low_damping_branch: xr.Dataset
    fast_start_walk: xr.Dataset  # `gaits.walk_into_gait` from a start with 2 rad/s at Table 1

    @property
    def table_1_gait(self) -> xr.Dataset:
        """Return the gait of Table 1."""
        return self.damping_branch.sel(damping=200.0)


REFERENCE_CODE_LABEL = "independent code"
"""Source of a number that the paper does not print."""

LAST_DIGIT_REASON = "half a unit of the last digit published"
"""Text of the reason for the usual tolerance."""

SIGN_REASON = "a sign: no tolerance"
"""Text of the reason for a comparison without a tolerance."""

STEP_ERROR_TOLERANCE = 1e-9
"""Tolerance of a number in SI units, chosen as the error of a step at the default options."""

NumbersByName = Mapping[str, Any]
"""Numbers of a group of claims by name, computed from the evidence."""


@dataclass(frozen=True)
class Claim:
    """Published statement, text of the computed value, and condition of their agreement."""

    claim: str
    source: str
    published_value: str
    computed: str  # format string of the numbers of the group
    holds: Callable[[Any], bool]  # takes the numbers of the group as attributes
    tolerance_reason: str = LAST_DIGIT_REASON


@dataclass(frozen=True)
class ClaimGroup:
    """Claims under one heading that use the same numbers."""

    title: str
    compute_numbers: Callable[[Evidence], NumbersByName]
    claims: tuple[Claim, ...]

    def make_facts(self, evidence: Evidence) -> list[Fact]:
        """Return the facts of the claims, computed from the evidence."""
        numbers_by_name = self.compute_numbers(evidence)
        namespace = SimpleNamespace(**numbers_by_name)
        return [
            Fact(
                group=self.title,
                claim=c.claim,
                source=c.source,
                published_value=c.published_value,
                computed=c.computed.format(**numbers_by_name),
                holds=bool(c.holds(namespace)),
                tolerance_reason=c.tolerance_reason,
            )
            for c in self.claims
        ]


def agrees_within(
    **published_numbers: tuple[float | tuple[float, ...], float],
) -> Callable[[Any], bool]:
    """Return a function that tests whether each named number is near its published value.

    - `published_numbers`: published value and tolerance of each number, by name.
    """
    return lambda n: all(
        bool(np.all(np.abs(np.asarray(getattr(n, number_name)) - value) <= tolerance))
        for number_name, (value, tolerance) in published_numbers.items()
    )


def select_first_step(gait: xr.Dataset) -> xr.Dataset:
    """Return the first step of a trajectory."""
    return gait.isel(time=gait.step.values == 0)


def split_by_phase(gait: xr.Dataset) -> list[xr.Dataset]:
    """Return the parts of a trajectory in DLS, SLS-I and SLS-II."""
    return [gait.isel(time=gait.phase.values == phase) for phase in range(len(PHASE_NAMES))]

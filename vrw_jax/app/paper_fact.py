"""Facts of the table, the evidence for them, and the comparison of claims with computed values."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

from vrw_jax.models.measures import PHASE_NAMES
from vrw_jax.wheel.params import WheelParams


@dataclass(frozen=True)
class PaperFact:
    """One fact of the table: claim, source, published value, computed value, and whether they
    agree.
    """

    group: str
    claim: str
    source: str
    published_value: str
    computed: str
    holds: bool
    tolerance_reason: str  # reason for the tolerance, or condition of failure

    @property
    def is_from_reference_code(self) -> bool:
        """Return whether the published value comes from independent code instead of the paper."""
        return (
            INDEPENDENT_CODE_LABEL in self.source or INDEPENDENT_CODE_LABEL in self.published_value
        )

    @property
    def verdict(self) -> str:
        """Return a text that states whether the fact holds."""
        return "holds" if self.holds else "does not hold"


@dataclass(frozen=True)
class PaperEvidence:
    """Labeled simulation results from which all facts are computed."""

    params: WheelParams  # wheel of Table 1 of the paper
    settling_walk: xr.Dataset  # `gaits.walk_into_gait` from the start for Table 1
    table_1_trajectory: xr.Dataset  # three steps of the gait of Table 1, `simulate`
    gaits_by_damping: Sequence[xr.Dataset]  # one step at c = 50, 100, 200
    # The branches are results of `gaits.measure_gaits_along_parameter`.
    damping_branch: xr.Dataset  # damping 1, 2, ..., 224 at slope 0.30
    slope_branch: xr.Dataset  # slope down to 0.10 at c = 100
    gentle_slope_branch: xr.Dataset  # damping up to 220 at slope 0.10
    gentle_slope_low_damping_branch: xr.Dataset  # damping down to 4 at slope 0.10
    fast_start_walk: xr.Dataset  # `gaits.walk_into_gait` from a start with 2 rad/s at Table 1

    @property
    def table_1_gait(self) -> xr.Dataset:
        """Return the measures of the gait for Table 1 of the paper, whose damping is 200 N s/m."""
        return self.damping_branch.sel(damping=200.0)

    @property
    def first_step_trajectory(self) -> xr.Dataset:
        """Return the part of the trajectory for Table 1 of the paper in its first step."""
        return self.table_1_trajectory.isel(time=self.table_1_trajectory.step.values == 0)


INDEPENDENT_CODE_LABEL = "independent code"
"""Label for the source of a value that the paper does not print."""

LAST_DIGIT_TOLERANCE_REASON = "half a unit of the last digit published"
"""Text that states the reason for the usual tolerance."""

SIGN_TOLERANCE_REASON = "a sign: no tolerance"
"""Text that states why a comparison has no tolerance."""

STEP_ERROR_TOLERANCE = 1e-9
"""Tolerance for a value in SI units. It is chosen because it is the error of a walking step with
the default options.
"""

ClaimValues = Mapping[str, Any]
"""Values that the claims of a group need, by name, computed from the evidence.

Single values of a dataset become numbers before the claims are tested.
"""


@dataclass(frozen=True)
class PaperClaim:
    """Published statement, text of the computed value, and test of whether the two agree."""

    claim: str
    source: str
    published_value: str
    computed_value_format: str  # format string of the numbers of the group
    agreement_test: Callable[[Any], bool]  # takes the numbers of the group as attributes
    tolerance_reason: str = LAST_DIGIT_TOLERANCE_REASON


@dataclass(frozen=True)
class PaperClaimGroup:
    """Claims under one heading that are computed from the same values."""

    group_title: str
    claim_value_function: Callable[[PaperEvidence], ClaimValues]
    claims: tuple[PaperClaim, ...]

    def make_facts(self, paper_evidence: PaperEvidence) -> list[PaperFact]:
        """Return the facts for the group's claims, computed from the evidence."""
        claim_values_by_name = {
            value_name: claim_value.item() if isinstance(claim_value, xr.DataArray) else claim_value
            for value_name, claim_value in self.claim_value_function(paper_evidence).items()
        }
        claim_value_namespace = SimpleNamespace(**claim_values_by_name)
        return [
            PaperFact(
                group=self.group_title,
                claim=paper_claim.claim,
                source=paper_claim.source,
                published_value=paper_claim.published_value,
                computed=paper_claim.computed_value_format.format(**claim_values_by_name),
                holds=bool(paper_claim.agreement_test(claim_value_namespace)),
                tolerance_reason=paper_claim.tolerance_reason,
            )
            for paper_claim in self.claims
        ]


def make_agreement_test(
    **published_values_and_tolerances: tuple[float | tuple[float, ...], float],
) -> Callable[[Any], bool]:
    """Return a function that tests whether each named value agrees with its published value.

    - `published_values_and_tolerances`: pairs of published value and tolerance, by name.
    """
    return lambda n: all(
        np.all(np.abs(np.subtract(getattr(n, value_name), published_value)) <= tolerance)
        for value_name, (published_value, tolerance) in published_values_and_tolerances.items()
    )


def split_trajectory_by_phase(walk_trajectory: xr.Dataset) -> list[xr.Dataset]:
    """Return the parts of a trajectory in DLS, SLS-I and SLS-II."""
    return [
        walk_trajectory.isel(time=walk_trajectory.phase.values == phase_code)
        for phase_code in range(len(PHASE_NAMES))
    ]

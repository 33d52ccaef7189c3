"""Claims of the paper, and gaits that simulated walks approach, as evidence for them.

Every gait is the limit of a walk, without Newton's method for a fixed point. The gaits are
therefore stable, and they test the Newton search independently. If the ground would have to pull on
Leg 1, or if a foot scuffs, the motion continues formally. Gaits can therefore be continued past the
damping at which λ2⁺ vanishes. Formal continuation does not change other gaits.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from vrw_jax.base.lazy_xarray import xarray as xr
from vrw_jax.base.outcomes import Outcome
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    PHASE_NAMES,
    STEP_MEASURES,
    make_labeled_variables,
    make_locked_leg_coordinate,
    make_measure_attributes,
)
from vrw_jax.models.provenance import collect_provenance_attributes
from vrw_jax.models.step_results import SectionState
from vrw_jax.models.stepping import step, walk
from vrw_jax.models.viscoelastic import ViscoelasticWheel
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


def make_formally_continued_model() -> ViscoelasticWheel:
    """Return the paper's model with motion that continues formally after Leg 1 lifts off."""
    return ViscoelasticWheel(stop_at_lift_off=False)


def replace_wheel_parameter(
    params: WheelParams, parameter_name: str, parameter_value: float
) -> WheelParams:
    """Return the wheel with a new value of one parameter."""
    value_by_parameter: dict[str, Any] = {parameter_name: parameter_value}
    return dataclasses.replace(params, **value_by_parameter)


# Number of steps of a walk, chosen because the gait with the slowest convergence (c = 70 N s/m)
# converges to round-off in 30 steps.
N_SETTLING_STEPS = 30
# Largest change of the section state per step after a walk has settled. The value is ten times the
# error of a step with the default options.
MAX_SETTLED_STATE_CHANGE = 1e-8
# Number of last steps whose change must be below that limit. It is above 1 because two states of a
# gait with a longer period may agree by chance.
N_SETTLED_STEPS = 5


def walk_into_gait(params: WheelParams, x: SectionState) -> xr.Dataset:
    """Simulate a walk into a gait, and return its section states and their change per step.

    The variable `change` of the dataset is the Euclidean distance to the previous section state in
    (rad, rad/s, m/s). `settled` states whether the walk reached a period-1 gait, that is, whether
    each of the last changes is small enough.
    """
    gait_walk = walk(params, x, N_SETTLING_STEPS, model=make_formally_continued_model())
    n_stepped = int(gait_walk.n_stepped)
    section_states = np.concatenate(
        [gait_walk.start[None], gait_walk.steps.section_state[:n_stepped]]
    )
    section_state_changes = np.linalg.norm(np.diff(section_states, axis=0), axis=1)
    walk_outcome = Outcome(int(gait_walk.outcome))
    last_state_change = (
        float(section_state_changes[-N_SETTLED_STEPS:].max())
        if n_stepped >= N_SETTLED_STEPS
        else math.inf
    )
    is_settled = walk_outcome == Outcome.STEPPED and last_state_change < MAX_SETTLED_STATE_CHANGE
    return xr.Dataset(
        {
            "section_state": (("step", "component"), section_states),
            "change": (
                "step",
                np.append(np.nan, section_state_changes),
                {"units": "1", "long_name": "change since the step before"},
            ),
        },
        {"component": ["theta", "dtheta", "dL1"]},
        {
            "outcome": walk_outcome.name,
            "outcome_meaning": walk_outcome.meaning,
            "last_change": last_state_change,
            "settled": int(is_settled),
        }
        | collect_provenance_attributes(params, make_formally_continued_model()),
    )


def walk_along_parameter(
    params: WheelParams, parameter_name: str, parameter_values: Sequence[float], x: SectionState
) -> Iterator[xr.Dataset]:
    """Yield the dataset that `walk_into_gait` returns for each value of a parameter.

    The start of each walk is extrapolated from the last two settled gaits. Walks that fail or do
    not settle are not used for the extrapolation.
    """
    settled_gaits: list[tuple[float, np.ndarray]] = []
    for parameter_value in parameter_values:
        start_state = jnp.asarray(settled_gaits[-1][1]) if settled_gaits else x
        if len(settled_gaits) > 1:
            (previous_value, previous_state), (last_value, last_state) = settled_gaits[-2:]
            extrapolation_factor = (parameter_value - last_value) / (last_value - previous_value)
            start_state = jnp.asarray(
                last_state + extrapolation_factor * (last_state - previous_state)
            )
        gait_walk = walk_into_gait(
            replace_wheel_parameter(params, parameter_name, parameter_value), start_state
        )
        if gait_walk.settled:
            settled_gaits.append((parameter_value, gait_walk.section_state.values[-1]))
        yield gait_walk


def measure_gaits_along_parameter(
    params: WheelParams,
    parameter_name: str,
    parameter_values: Sequence[float],
    x: SectionState,
    on_progress: Callable[[float], None] | None = None,
) -> xr.Dataset:
    """Return all measures of the gaits that `walk_along_parameter` reaches, over the parameter.

    The measures are those of one further step. The variable `settled` states whether the walk
    reached a period-1 gait, and `change` is the largest change in its last steps.

    - `on_progress`: function that is called with the completed fraction of the work.
    """
    measures_by_gait = []
    for parameter_value, gait_walk in zip(
        parameter_values,
        walk_along_parameter(params, parameter_name, parameter_values, x),
        strict=True,
    ):
        last_section_state = gait_walk.section_state.values[-1]
        step_result = step(
            replace_wheel_parameter(params, parameter_name, parameter_value),
            jnp.asarray(last_section_state),
            model=make_formally_continued_model(),
        )
        gait_measures: dict[str, Any] = dict(step_result.measures())
        if gait_walk.outcome != Outcome.STEPPED.name:
            gait_measures["outcome"] = int(Outcome[gait_walk.outcome])
        gait_measures |= {
            "section_state": last_section_state,
            "change": gait_walk.attrs["last_change"],
            "settled": bool(gait_walk.settled),
        }
        measures_by_gait.append(gait_measures)
        if on_progress is not None:
            on_progress(len(measures_by_gait) / len(parameter_values))
    stack_measure = lambda measure_name: np.stack(
        [gait_measures[measure_name] for gait_measures in measures_by_gait]
    )
    dataset_variables = make_labeled_variables(
        {
            measure_name: stack_measure(measure_name)
            for measure_name in STEP_MEASURES | MARGIN_MEASURES
        },
        parameter_name,
    )
    dataset_variables |= {
        "section_state": xr.Variable(
            (parameter_name, "component"),
            stack_measure("section_state"),
            {"long_name": "section state"},
        ),
        "change": xr.Variable(
            parameter_name,
            stack_measure("change"),
            {"units": "1", "long_name": "largest change of the last five steps"},
        ),
        "settled": xr.Variable(
            parameter_name,
            stack_measure("settled"),
            {"long_name": "whether the walk settled into a period-1 gait"},
        ),
    }
    dataset_coordinates = {
        parameter_name: xr.Variable(
            parameter_name,
            np.asarray(parameter_values, float),
            make_measure_attributes(parameter_name),
        ),
        "component": ["theta", "dtheta", "dL1"],
        "leg": make_locked_leg_coordinate(params.n_legs),
    }
    provenance_attributes = collect_provenance_attributes(params, make_formally_continued_model())
    provenance_attributes.pop(f"parameter_{parameter_name}")
    dataset_title = {"title": f"Gaits walked to along {parameter_name}"}
    return xr.Dataset(
        dataset_variables, dataset_coordinates, dataset_title | provenance_attributes
    ).sortby(parameter_name)

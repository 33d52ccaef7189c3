"""Evidence for claims of the paper: gaits that walks approach, and equations as printed.

Every gait is the limit of a walk, without Newton's method for a fixed point. The gaits are
therefore stable, and they test the Newton search independently. If the ground would have to pull on
Leg 1, or if a foot scuffs, the motion continues formally. Gaits can therefore be continued past the
damping at which λ2⁺ vanishes. Formal continuation does not change other gaits.

Equations are computed in printed and in corrected form, if computed values can distinguish them.
They use the paper's five coordinates q = (x, z, theta, L1, L2). The simulator provides only the
mass matrix and the momentum.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.results import Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.models.ladder import collect_provenance_attributes
from vrw_jax.models.measures import (
    MARGIN_MEASURES,
    PHASE_NAMES,
    STEP_MEASURES,
    make_labeled_variables,
    make_locked_leg_coordinate,
    make_measure_attributes,
)
from vrw_jax.models.step_results import SectionState
from vrw_jax.models.stepping import step, walk
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.dynamics import (
    Motion,
    compute_length_at_touchdown,
    compute_mass_matrix,
    compute_momentum,
)
from vrw_jax.wheel.params import Symbols, WheelParams


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
                self.group_title,
                paper_claim.claim,
                paper_claim.source,
                paper_claim.published_value,
                paper_claim.computed_value_format.format(**claim_values_by_name),
                bool(paper_claim.agreement_test(claim_value_namespace)),
                paper_claim.tolerance_reason,
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


_compute_length_at_touchdown = jax.jit(compute_length_at_touchdown)


def _compute_symbols_and_touchdown_length(params: WheelParams, theta: float) -> tuple[Any, float]:
    """Return the parameters by their symbols in the paper, and the length of Leg 1 at touchdown, m,
    as Python floats.
    """
    s = params.symbols()
    return jax.tree.map(float, s), float(_compute_length_at_touchdown(s, jnp.asarray(theta)))


def compute_double_support_jacobian(
    theta: np.ndarray, L1: np.ndarray, L2: np.ndarray, alpha: float, is_as_printed: bool
) -> np.ndarray:
    """Return the Jacobian J_DLS of eq. (11) of the paper, shape (..., 4, 5).

    The sign of its entry J43 is misprinted.

    - `is_as_printed`: whether the entry J43 has the printed sign.
    """
    fore_sine, fore_cosine = np.sin(theta), np.cos(theta)
    rear_sine, rear_cosine = np.sin(theta + alpha), np.cos(theta + alpha)
    printed_entry_sign = -1.0 if is_as_printed else 1.0
    J43 = -L1 * fore_sine + printed_entry_sign * L2 * rear_sine
    jacobian = np.zeros((*np.shape(theta), 4, 5))
    jacobian[..., :2, :2] = jacobian[..., 2:, :2] = np.eye(2)
    jacobian[..., 2, 2:] = np.stack(
        [L1 * fore_cosine - L2 * rear_cosine, fore_sine, -rear_sine], axis=-1
    )
    jacobian[..., 3, 2:] = np.stack([J43, fore_cosine, -rear_cosine], axis=-1)
    return jacobian


def compute_constraint_violation(walk_trajectory: xr.Dataset, is_as_printed: bool) -> float:
    """Return the largest speed of a foot in double support, m/s.

    The speed is J q' of eq. (2) of the paper, evaluated for all samples of a walk.
    """
    double_support = walk_trajectory.isel(time=walk_trajectory.phase.values == 0)
    theta, L1, L2 = (double_support[name].values for name in ("theta", "L1", "L2"))
    alpha = 2.0 * np.pi / walk_trajectory.attrs["parameter_n_legs"]
    J = compute_double_support_jacobian(theta, L1, L2, alpha, is_as_printed)
    rate_names = ("dx", "dz", "dtheta", "dL1", "dL2")
    coordinate_rates = np.stack([double_support[name].values for name in rate_names], axis=-1)
    return float(np.abs(np.einsum("tij,tj->ti", J, coordinate_rates)).max())


class PrintedLandingResult(NamedTuple):
    """Result of collision I by eqs (15)-(21) and (33)-(35) of the paper, corrected and as
    printed.
    """

    coordinate_rates_after: np.ndarray  # q'+ of eq. (20)
    corrected_impulse: np.ndarray  # lambda_I = -X^-1 J q'
    impulse_as_printed: np.ndarray  # eq. (35) as printed: five numbers
    momentum_residual: float  # largest |M (q'+ - q') - J^T lambda_I|, N s


def compute_printed_landing(params: WheelParams, section_state: np.ndarray) -> PrintedLandingResult:
    """Compute collision I in five coordinates from the section state (theta-, dtheta-, dL1-)."""
    touchdown_angle, touchdown_rate, dL1 = section_state
    s, touchdown_length = _compute_symbols_and_touchdown_length(params, touchdown_angle)
    foot_velocity = compute_landing_foot_velocity(params, section_state, leg_1_rate=dL1)
    coordinate_rates_before = np.array([*foot_velocity, touchdown_rate, 0.0, dL1])
    theta, L1, L2 = map(np.asarray, (touchdown_angle - s.alpha, s.L0, touchdown_length))
    J = compute_double_support_jacobian(theta, L1, L2, s.alpha, is_as_printed=False)
    M = np.asarray(compute_five_coordinate_mass_matrix(s, *map(jnp.asarray, (theta, L1, L2))))
    inverse_mass_matrix = np.linalg.inv(M)
    X = J @ inverse_mass_matrix @ J.T
    velocity_projector = np.eye(5) - inverse_mass_matrix @ J.T @ np.linalg.solve(X, J)
    coordinate_rates_after = velocity_projector @ coordinate_rates_before
    landing_impulse = -np.linalg.solve(X, J @ coordinate_rates_before)
    momentum_error = M @ (coordinate_rates_after - coordinate_rates_before) - J.T @ landing_impulse
    return PrintedLandingResult(
        coordinate_rates_after,
        landing_impulse,
        velocity_projector @ coordinate_rates_before,
        float(np.abs(momentum_error).max()),
    )


@jax.jit
def compute_five_coordinate_mass_matrix(s: Symbols, theta: Array, L1: Array, L2: Array) -> Array:
    """Return the mass matrix M(q) of eq. (1) of the paper, shape (5, 5).

    It consists of the mass matrix for a planted foot, and of the momentum due to a moving foot.
    """
    planted_mass_matrix = compute_mass_matrix(s, L1, L2)
    unit_vectors = jnp.eye(3)
    internal_mass_block = jnp.array(
        [planted_mass_matrix.multiply_vector(tuple(unit_vector)) for unit_vector in unit_vectors]
    )
    foot_momentum = jnp.array(
        [
            compute_momentum(s, Motion.from_angle(theta, L1, L2, *unit_vector))
            for unit_vector in unit_vectors
        ]
    )
    return jnp.block([[s.Mt * jnp.eye(2), foot_momentum.T], [foot_momentum, internal_mass_block]])


def compute_landing_foot_velocity(
    params: WheelParams, section_state: np.ndarray, leg_1_rate: float
) -> np.ndarray:
    """Return the velocity (x, z) of the landing foot by eqs (16) and (17) of the paper, m/s.

    - `leg_1_rate`: time derivative of L1 in these equations, m/s.
    """
    touchdown_angle, touchdown_rate, _ = section_state
    s, touchdown_length = _compute_symbols_and_touchdown_length(params, touchdown_angle)
    L0, alpha = s.L0, s.alpha
    x = (
        touchdown_length * np.cos(touchdown_angle) - L0 * np.cos(alpha - touchdown_angle)
    ) * touchdown_rate + leg_1_rate * np.sin(touchdown_angle)
    z = -(
        touchdown_length * np.sin(touchdown_angle) + L0 * np.sin(alpha - touchdown_angle)
    ) * touchdown_rate + leg_1_rate * np.cos(touchdown_angle)
    return np.array([x, z])


def differentiate_landing_foot_position(
    params: WheelParams, section_state: np.ndarray
) -> np.ndarray:
    """Return the velocity (x, z) of the landing foot, m/s, computed by central differences.

    The result is accurate to 1e-11 m/s.
    """
    h = 1e-6  # The step is in s; the error is proportional to its square.
    touchdown_angle, touchdown_rate, dL1 = section_state
    s, touchdown_length = _compute_symbols_and_touchdown_length(params, touchdown_angle)

    def compute_foot_position(t: float) -> np.ndarray:
        wheel_angle, leg_length = touchdown_angle + touchdown_rate * t, touchdown_length + dL1 * t
        hub_position = leg_length * np.array([np.sin(wheel_angle), np.cos(wheel_angle)])
        landing_angle = wheel_angle - s.alpha
        return hub_position - s.L0 * np.array([np.sin(landing_angle), np.cos(landing_angle)])

    return (compute_foot_position(h) - compute_foot_position(-h)) / (2.0 * h)


def _compute_misprint_values(paper_evidence: PaperEvidence) -> ClaimValues:
    """Compute the values that the claims on misprints need, by name.

    The values follow from equations as printed in the paper and from corrected equations.
    """
    section_state = paper_evidence.table_1_gait.section_state.values
    library_landing_impulse = float(paper_evidence.table_1_gait.lambda_I4)
    printed_landing = compute_printed_landing(paper_evidence.params, section_state)
    reference_foot_velocity = differentiate_landing_foot_position(
        paper_evidence.params, section_state
    )
    foot_velocity_error_function = lambda rate: np.abs(
        compute_landing_foot_velocity(paper_evidence.params, section_state, rate)
        - reference_foot_velocity
    ).max()
    gentle_slope_gait = paper_evidence.slope_branch.sel(slope=0.10, method="nearest")
    gentle_slope_branch = paper_evidence.gentle_slope_branch
    low_damping_gait = paper_evidence.gentle_slope_low_damping_branch.sel(damping=4.0)
    return {
        "wrong": compute_constraint_violation(
            paper_evidence.table_1_trajectory, is_as_printed=True
        ),
        "right": compute_constraint_violation(
            paper_evidence.table_1_trajectory, is_as_printed=False
        ),
        "residual": printed_landing.momentum_residual,
        "velocities": np.array_equal(
            printed_landing.impulse_as_printed, printed_landing.coordinate_rates_after
        ),
        "impulse": printed_landing.corrected_impulse[3],
        "here": library_landing_impulse,
        "off": abs(printed_landing.corrected_impulse[3] - library_landing_impulse),
        "off_new": foot_velocity_error_function(0.0),
        "off_old": foot_velocity_error_function(section_state[2]),
        "slow_settled": gentle_slope_gait.settled,
        "share": 100.0 * gentle_slope_gait.dls_fraction,
        "period": gentle_slope_gait.period,
        "rear": gentle_slope_branch.lambda_4_plus.where(gentle_slope_branch.settled).min(),
        "last": gentle_slope_branch.damping.where(gentle_slope_branch.settled).max(),
        "end": gentle_slope_branch.damping.max(),
        "end_walks": gentle_slope_branch.settled[-1],
        "end_outcome": Outcome(int(gentle_slope_branch.outcome[-1])).name.lower().replace("_", " "),
        "low": low_damping_gait.lambda_2_plus,
        "low_settled": low_damping_gait.settled,
    }


# fmt: off
MISPRINT_CLAIMS = PaperClaimGroup(
    "Misprints of the paper, with the evidence", _compute_misprint_values, (
    PaperClaim("eq. (11): J43 must be −L1 sin θ + L2 sin(θ+α)", "eq. (11)",
          "−L1 sin θ − L2 sin(θ+α)",
          "J q̇ reaches {wrong:.2f} m/s as printed, {right:.0e} corrected (must be 0)",
          lambda n: n.wrong > 0.1 and n.right < 1e-12,
          "1e-12 m/s: rounding; as printed far from it"),
    PaperClaim("eq. (35): the impulse is −X⁻¹ J q̇†", "eq. (35)", "the projector of eq. (20)",
          "as printed five numbers, eq. (20)'s velocities; corrected M Δq̇ = Jᵀ λ_I to "
          "{residual:.0e} N·s, λ_I4 = {impulse:.4f}, here {here:.4f} N·s",
          lambda n: n.velocities and n.residual < 1e-10 and n.off <= STEP_ERROR_TOLERANCE,
          "1e-10 N·s: rounding; λ_I4 to the error of a step"),
    PaperClaim("eqs (16), (17): L̇1 without a superscript is L̇1⁻", "eqs (16), (17)", "L̇1",
          "landing foot's velocity off by {off_old:.0e} m/s with L̇1⁻, "
          "by {off_new:.2f} with the new L̇1 = 0",
          lambda n: n.off_old < 1e-8 and n.off_new > 1e-2,
          "1e-8 m/s: error of the difference quotient"),
    PaperClaim("§5.2 prints φ = 0.10 for Fig. 10, where gaits are nearly at rest", "§5.2",
          "c = 100: 96 % DLS, T ≈ 4.5 s (independent code)",
          "{share:.1f} % DLS, T = {period:.2f} s",
          lambda n: n.slow_settled and make_agreement_test(share=(96.0, 0.5), period=(4.5,
          0.05))(n)),
    PaperClaim("λ4⁺ does not vanish at c = 220 at φ = 0.10", "§5.2",
          "0 at 220 (at φ = 0.30 it is)",
          "λ4⁺ ≥ {rear:.0f} N up to c = {last:.0f}; at c = {end:.0f}: {end_outcome}",
          lambda n: n.rear > 10.0 and not n.end_walks,
          "10 N: far from zero; no gait left at 220 for λ4⁺ to vanish on"),
    PaperClaim("λ2⁺ does not vanish at c = 4 at φ = 0.10", "§5.2", "0 at 4 (at φ = 0.30 it is)",
          "λ2⁺ = {low:.1f} N at c = 4", lambda n: n.low > 1.0 and n.low_settled,
          "1 N: far from zero"),
))
# fmt: on

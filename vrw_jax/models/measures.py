"""Table of the measures of steps, cycles and trajectories, and measures of the motion in phases.

Every labeled result takes its units and long names from this table, so that scans, trajectories and
figures use the same names. The axis x points downhill along the slope, and z is normal to the
slope.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import require_known_name
from vrw_jax.base.options import ParameterDomain
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.base.results import xarray as xr
from vrw_jax.flow.extrema import (
    SmoothParts,
    StepForceExtrema,
    find_extrema,
    integrate_over_parts,
    mask_ends,
    mask_incomplete,
    summarize_forces,
)
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import PARAMETER_DOMAINS, WheelParams
from vrw_jax.wheel.phases import PAPER_PHASES, AbstractPhase, PhaseInstant, make_paper_phases

_make_leg_measure = functools.partial(Measure, leg_dimension="leg")
_make_friction_measure = functools.partial(Measure, is_largest_over_steps=True)


def _index_measures_by_name(*measures: Measure) -> dict[str, Measure]:
    """Return a dictionary that maps names to measures.

    Raise a `ValueError` if two measures have the same name.
    """
    measure_by_name = {measure.name: measure for measure in measures}
    if len(measure_by_name) != len(measures):
        raise ValueError("Two measures share one name: give each its own.")
    return measure_by_name


# fmt: off
STEP_MEASURES = _index_measures_by_name(
    Measure("dls_fraction", "1", "T_DLS/T", "DLS fraction",
            "Share of the step spent in double-limb support.", is_shared=True,
            is_averaged_over_steps=True),
    Measure("period", "s", "T", "step period", "Duration of the step from touchdown to touchdown.",
            is_shared=True),
    Measure("speed", "m/s", "v", "walking speed", "Step length divided by the period.",
            is_shared=True, is_averaged_over_steps=True),
    Measure("step_length", "m", "D", "step length",
            "Distance between the feet at the landing at the start of the step.", is_shared=True),
    Measure("duration_dls", "s", "T_DLS", "duration of DLS",
            "Time with both feet on the ground.", "Section 3.3.1", is_shared=True),
    Measure("duration_sls1", "s", "T_SLS-I", "duration of SLS-I",
            "Time from the take-off of Leg 2 until Leg 2 reaches its stopper.", "Section 3.3.2"),
    Measure("duration_sls2", "s", "T_SLS-II", "duration of SLS-II",
            "Time from collision II to the next touchdown.", "Section 3.3.3"),
    Measure("theta_post_impact", "rad", "θ⁺", "angle just after landing",
            "Angle of Leg 1 from the slope's normal just after landing.", "(15)",
            is_shared=True),
    Measure("dtheta_post_impact", "rad/s", "θ̇⁺", "angular rate just after landing",
            "Rate of the angle of Leg 1 just after landing.", "(20)", is_shared=True),
    Measure("theta_touchdown", "rad", "θ⁻", "angle just before touchdown",
            "Angle of Leg 1 just before the next touchdown, first component of the section state.",
            is_shared=True),
    Measure("dtheta_touchdown", "rad/s", "θ̇⁻", "angular rate just before touchdown",
            "Rate of the angle of Leg 1 at that time, second component of the section state.",
            is_shared=True),
    Measure("dL1_touchdown", "m/s", "L̇1⁻", "rate of Leg 1 just before touchdown",
            "Rate of the length of Leg 1 at that time, third component of the section state."),
    Measure("lambda_I4", "N s", "λ_I4", "DLS indicator λ_I4",
            "Normal impulse on the rear foot if the landing stops both feet.", "(35)",
            violation_text="landing frees the rear foot"),
    Measure("lambda_2_plus", "N", "λ2⁺", "DLS indicator λ2⁺",
            "Normal force on the fore foot just after landing if both feet are at rest.", "(38)",
            violation_text="fore foot pulls at once"),
    Measure("lambda_4_plus", "N", "λ4⁺", "DLS indicator λ4⁺",
            "Normal force on the rear foot just after landing if both feet are at rest.", "(38)",
            violation_text="rear foot lifts at once"),
    Measure("energy_lost_landing", "J", "ΔE_I", "energy lost in the landing",
            "Mechanical energy lost in collision I.", "(18)"),
    Measure("energy_lost_stopper", "J", "ΔE_II", "energy lost at the stopper",
            "Mechanical energy lost in collision II.", "(22)"),
    Measure("energy_lost_damping", "J", "ΔE_c", "energy lost in the dampers",
            "Mechanical energy lost in the dampers of the legs during the step.", "(29)",
            is_shared=True),
    _make_friction_measure("required_friction", "1", "μ_req", "required friction",
            "Largest ratio of tangential to normal force on either foot, landing impulses "
            "included: the largest of the next four coefficients."),
    _make_friction_measure("required_friction_fore", "1", "max |λ1|/λ2",
            "friction required by the fore foot", "Largest ratio of its forces in the step."),
    _make_friction_measure("required_friction_rear", "1", "|λ3⁺|/λ4⁺",
            "friction required by the rear foot after landing",
            "Ratio of its forces just after landing. Later the ratio grows without bound, because "
            "only λ4 vanishes at take-off."),
    _make_friction_measure("required_friction_landing_fore", "1", "|λ_I1|/λ_I2",
            "friction required by the fore foot in the landing", "Ratio of its impulses."),
    _make_friction_measure("required_friction_landing_rear", "1", "|λ_I3|/λ_I4",
            "friction required by the rear foot in the landing",
            "Ratio of its impulses; 0 if the landing frees the foot."),
    _make_friction_measure("required_friction_stopper", "1", "|λ_s1|/λ_s2",
            "friction required in collision II",
            "Ratio of the small impulses on the planted foot; infinite if the ground would have to "
            "pull. The required friction excludes it."),
    Measure("outcome", "1", "outcome", "outcome", "Code of the end of the step.",
            is_shared=True, is_integer_code=True),
    Measure("solver_steps", "1", "N", "solver steps",
            "Number of solver steps that the integrator tries.",
            is_shared=True, is_integer_code=True),
)
"""Measures of one step."""

MARGIN_MEASURES = _index_measures_by_name(
    Measure("fore_foot_force", "N", "min λ2", "least normal force on the fore foot",
            "Negative if the ground would have to pull on Leg 1.",
            violation_text="fore foot pulls"),
    Measure("takeoff_acceleration", "m/s^2", "z̈2⁺", "normal acceleration of foot 2 at take-off",
            "Acceleration of the rear foot just after take-off; negative if the foot scuffs "
            "immediately.", violation_text="rear foot scuffs at take-off"),
    Measure("clearance_sls1", "m", "min z2, SLS-I", "foot clearance in SLS-I",
            "Least height of foot 2 in SLS-I; negative if the foot scuffs.",
            violation_text="rear foot scuffs in SLS-I"),
    Measure("clearance_sls2", "m", "min z2, SLS-II", "foot clearance in SLS-II",
            "Least height of foot 2 in SLS-II; negative if the foot scuffs.",
            violation_text="rear foot scuffs in SLS-II"),
    _make_leg_measure("locked_stopper_force", "N", "min F_stop", "stopper force of the locked legs",
            "Least force of the stopper on each of Legs 3 to n; negative if a stopper has to pull.",
            violation_text="locked leg leaves its stopper"),
    Measure("rear_stopper_force", "N", "min F_stop,2", "stopper force of Leg 2 in SLS-II",
            "Least force of the stopper on Leg 2 in SLS-II; negative if the stopper has to pull.",
            violation_text="Leg 2 leaves its stopper"),
    Measure("contraction", "m", "min(L0 - L1)", "contraction of Leg 1",
            "Least contraction after the landing; negative if Leg 1 passes its stopper.",
            violation_text="Leg 1 passes its stopper"),
    Measure("friction_fore", "1", "μ - |λ1|/λ2", "friction left at the fore foot",
            "Friction coefficient of the model minus the coefficient that the fore foot needs.",
            violation_text="fore foot slides"),
    Measure("friction_rear", "1", "μ - |λ3⁺|/λ4⁺", "friction left at the rear foot after landing",
            "Friction coefficient minus the one that the rear foot needs just after landing.",
            violation_text="rear foot slides just after landing"),
    _make_leg_measure("landing_stopper_impulse", "N s", "I_stop, I",
            "stopper impulse at the landing",
            "Impulse on each of Legs 3 to n; negative if a stopper has to pull in the landing.",
            violation_text="landing throws a locked leg off"),
    _make_leg_measure("hit_stopper_impulse", "N s", "I_stop, II", "stopper impulse at collision II",
            "Impulse on each of Legs 3 to n; negative if a stopper has to pull in the collision.",
            violation_text="collision II throws a locked leg off"),
    Measure("hit_planted_impulse", "N s", "λ_s2", "normal impulse of the planted foot",
            "Impulse of collision II; negative if the ground would have to pull.", "(22)",
            violation_text="foot pulls in collision II"),
    Measure("landing_friction_fore", "1", "μ - |λ_I1|/λ_I2",
            "friction left at the fore foot in the landing",
            "Friction coefficient minus the one that the fore foot needs in the landing impulse.",
            violation_text="fore foot slides in the landing"),
    Measure("landing_friction_rear", "1", "μ - |λ_I3|/λ_I4",
            "friction left at the rear foot in the landing",
            "Friction coefficient minus the one that the rear foot needs in the landing impulse.",
            violation_text="rear foot slides in the landing"),
)
"""Margins of the model in one step, as in `Margins`. A negative margin is a violation."""

UNILATERAL_STEP_MEASURES = _index_measures_by_name(
    Measure("duration_single", "s", "t₁", "time on one foot", "Time with one loaded foot."),
    Measure("duration_flight", "s", "t₀", "time of flight", "Time with no loaded foot."),
    Measure("slip", "m", "s", "slip per step", "Sum of the sliding distances of all feet."),
    Measure("energy_lost_impacts", "J", "ΔE_I", "energy lost in impacts",
            "Mechanical energy lost in landings and at stoppers."),
    Measure("energy_lost_friction", "J", "ΔE_μ", "energy lost by sliding",
            "Mechanical energy lost by sliding feet between impacts."),
    Measure("friction", "1", "μ", "friction coefficient",
            "Coulomb's coefficient of friction of the ground."),
)
"""Measures that steps with unilateral contact have in addition to shared `STEP_MEASURES`."""

SELECTION_MARGIN_NAMES = (
    "fore_foot_force",
    "clearance_sls1",
    "clearance_sls2",
    "contraction",
    "friction_fore",
    "friction_rear",
    "landing_friction_fore",
    "landing_friction_rear",
)
"""Names of the margins of the assumptions that only the viscoelastic model makes."""

STOPPER_MARGIN_MEASURES = _index_measures_by_name(
    Measure("stopper_force", "N", "min F_stop", "least force of a stopper on a leg in the air",
            "Negative if a stopper has to pull on a leg.",
            violation_text="a leg in the air leaves its stopper"),
    Measure("stopper_impulse", "N s", "min I_stop",
            "least impulse of a stopper on a leg in the air",
            "Negative if a stopper has to pull on a leg in an impact.",
            violation_text="an impact throws a leg off its stopper"),
)
"""Margins of a step in which contact is unilateral but stoppers hold the legs in the air. A
negative margin is a violation.
"""

PRE_TOUCHDOWN_COMPONENT_NAMES = ("theta_touchdown", "dtheta_touchdown", "dL1_touchdown")
"""Names of the components of a section state just before touchdown, in rad, rad/s, m/s."""

POST_LANDING_COMPONENT_NAMES = ("theta_post_impact", "dtheta_post_impact")
"""Names of the components of a state just after a landing on both feet, in rad, rad/s."""

SHARED_STEP_MEASURE_NAMES = tuple(name for name,
    measure in STEP_MEASURES.items() if measure.is_shared)
"""Names of the `STEP_MEASURES` that the steps of every model have."""

DIFFERENTIABLE_STEP_NAMES = tuple(
    name for name, measure in STEP_MEASURES.items() if not measure.is_integer_code
)
"""Names of the `STEP_MEASURES` that have derivatives with respect to the parameter of a branch."""

UNILATERAL_DIFFERENTIABLE_NAMES = tuple(
    name
    for name, measure in (STEP_MEASURES | UNILATERAL_STEP_MEASURES).items()
    if (measure.is_shared or name in UNILATERAL_STEP_MEASURES) and not measure.is_integer_code
        and name != "friction"
)
"""Names of the measures of a step with unilateral contact that have derivatives."""

LIMIT_CYCLE_MEASURES = _index_measures_by_name(
    Measure("spectral_radius", "1", "ρ", "spectral radius",
            "Largest magnitude of a multiplier of the limit cycle; the gait is stable below 1."),
    Measure("spectral_margin", "1", "1 - ρ", "spectral margin",
            "One minus the spectral radius; negative if the gait is unstable."),
    Measure("stability_margin", "1", "σ", "stability margin",
            "Smooth minimum of Jury's margins to a fold, a period doubling and a pair on the unit "
            "circle; negative if the gait is unstable."),
)
"""Measures of a limit cycle."""

GAIT_SENSITIVITY_MEASURES = _index_measures_by_name(
    Measure("gait_sensitivity_dls_fraction", "1/rad", "G_DLS", "gait sensitivity of DLS fraction",
            "Standard deviation of the DLS fraction on uneven ground divided by that of the "
            "slopes."),
    Measure("gait_sensitivity_period", "s/rad", "G_T", "gait sensitivity of the period",
            "Standard deviation of the period on uneven ground divided by that of the slopes."),
    Measure("gait_sensitivity_speed", "m/(s rad)", "G_v", "gait sensitivity of the speed",
            "Standard deviation of the speed on uneven ground divided by that of the slopes."),
)
"""Gait sensitivity norms of a limit cycle, for independent slopes with a small standard
deviation.
"""

FORCE_PEAK_MEASURES = _index_measures_by_name(
    Measure("n_force_peaks", "1", "n_F", "number of force peaks",
            "Smooth maxima of the fore foot's normal force inside the phases of a step."),
    Measure("peak_force", "N", "F_max", "peak force",
            "Largest normal force on the fore foot during the step, at a maximum or at an event. "
            "Impulses are not forces."),
    Measure("smooth_peak_force", "N", "F_peak", "highest force peak",
            "Largest smooth maximum of the fore foot's normal force; NaN if there is none."),
    Measure("force_trough_depth", "N", "ΔF", "depth of the force's trough",
            "Lower of two force peaks less the smooth minimum between them, largest over the step; "
            "0 if there is none."),
    Measure("second_peak_rate", "N/s", "Ḟ_2", "rate of the force at a second rise",
            "Largest maximum of the fore foot's force rate after its first peak. It is zero where "
            "a second peak appears, and NaN if there is no maximum."),
    Measure("n_total_force_peaks", "1", "n_F,tot", "number of peaks of the total force",
            "As the number of force peaks, for the sum of both feet's normal forces."),
    Measure("peak_total_force", "N", "F_tot,max", "peak of the total force",
            "As the peak force, for the sum of both feet's normal forces."),
    Measure("smooth_peak_total_force", "N", "F_tot,peak", "highest peak of the total force",
            "As the highest force peak, for the sum of both feet's normal forces."),
    Measure("landing_impulse", "N s", "λ_I2", "impulse of the landing",
            "Normal impulse of the ground on the fore foot in the landing.", "(18)"),
)
"""Measures of the ground's normal force in a step of a gait. Peaks lie inside the phases; impacts
and changes of phase are not peaks, although the largest force may occur there. For a gait of
several steps, each measure is the largest of its values in these steps.
"""

PASSAGE_MEASURES = _index_measures_by_name(
    Measure("mean_steps", "1", "M", "mean number of steps until failure",
            "On random slopes, from their quasi-stationary distribution; infinite if no failure "
            "was found."),
    Measure("mean_steps_error", "1", "ΔM", "error of the mean number of steps until failure",
            "Half the width of its 99 % confidence interval."),
    Measure("failure_probability", "1", "1 - κ_1", "failure probability of a step",
            "On random slopes, from their quasi-stationary distribution."),
)
"""Measures of walks on random slopes with a given standard deviation."""

TRAJECTORY_MEASURES = _index_measures_by_name(
    Measure("time", "s", "t", "time", "Time since the landing at the start of the first step."),
    Measure("step", "1", "step", "step", "Number of the step, starting from 0."),
    Measure("phase", "1", "phase", "phase", "Phase of the step."),
    Measure("x", "m", "x", "foot of Leg 1 along the slope",
            "Downhill position of the foot of Leg 1, which increases by a step length per "
            "landing."),
    Measure("z", "m", "z", "foot of Leg 1 above the slope",
            "Height of the foot of Leg 1, which is zero."),
    Measure("theta", "rad", "θ", "angle of Leg 1",
            "Angle from the slope's normal, positive downhill."),
    Measure("L1", "m", "L1", "length of Leg 1", "Length of the fore leg."),
    Measure("L2", "m", "L2", "length of Leg 2",
            "Length of the rear leg, which has the angle θ + α."),
    Measure("dx", "m/s", "ẋ", "rate of x", "Zero, because the foot of Leg 1 is at rest.", "(2)"),
    Measure("dz", "m/s", "ż", "rate of z", "Zero, because the foot of Leg 1 is at rest.", "(2)"),
    Measure("dtheta", "rad/s", "θ̇", "angular rate", "Rate of the angle of Leg 1."),
    Measure("dL1", "m/s", "L̇1", "rate of Leg 1", "Rate of the length of Leg 1."),
    Measure("dL2", "m/s", "L̇2", "rate of Leg 2", "Rate of the length of Leg 2."),
    Measure("lambda_1", "N", "λ1", "tangential force on foot 1", "Positive downhill.", "(12)"),
    Measure("lambda_2", "N", "λ2", "normal force on foot 1", "Positive if the ground pushes.",
            "(12)"),
    Measure("lambda_3", "N", "λ3", "tangential force on foot 2", "Zero in single support.", "(12)"),
    Measure("lambda_4", "N", "λ4", "normal force on foot 2", "Zero in single support.", "(12)"),
    Measure("kinetic_energy", "J", "K", "kinetic energy", "One half of q̇ᵀ M q̇.", "(26)"),
    Measure("gravitational_energy", "J", "P_g", "gravitational energy",
            "Zero at the first foothold of the walk, with the descent along the slope.", "(26)"),
    Measure("elastic_energy", "J", "P_k", "elastic energy", "Energy of the springs of all legs.",
            "(27)"),
    Measure("total_energy", "J", "E", "total mechanical energy",
            "Sum of the kinetic, gravitational and elastic energies.", "(26), (29)"),
    Measure("damping_power", "W", "c(L̇1² + L̇2²)", "power lost in the dampers",
            "Negative rate of the total energy between collisions, without a torque on the hub.",
            "(29)"),
    Measure("foot_1_x", "m", "x1", "foot of Leg 1 along the slope", "Downhill position."),
    Measure("foot_1_z", "m", "z1", "foot of Leg 1 above the slope", "Height, which is zero."),
    Measure("foot_2_x", "m", "x2", "foot of Leg 2 along the slope", "Downhill position."),
    Measure("foot_2_z", "m", "z2", "foot of Leg 2 above the slope",
            "Height; negative if the foot scuffs."),
    Measure("hub_x", "m", "x_H", "hub along the slope", "Downhill position."),
    Measure("hub_z", "m", "z_H", "hub above the slope", "Height."),
)
"""Measures that are coordinates or variables of a trajectory."""

CONTACT_MEASURES = _index_measures_by_name(
    _make_leg_measure("length", "m", "L", "length of the leg",
            "Distance from the hub to the foot."),
    _make_leg_measure("length_rate", "m/s", "L̇", "rate of the leg's length",
            "Rate of the distance."),
    _make_leg_measure("foot_x", "m", "x", "foot along the slope", "Downhill position."),
    _make_leg_measure("foot_z", "m", "z", "foot above the slope", "Height."),
    _make_leg_measure("tangential", "N", "λ_t", "tangential force on the foot",
            "Positive downhill."),
    _make_leg_measure("normal", "N", "λ_n", "normal force on the foot",
            "Positive if the ground pushes."),
    _make_leg_measure("contact", "1", "contact", "contact mode of the foot", "Code of the mode."),
    _make_leg_measure("on_stopper", "1", "on stopper", "whether the leg is on its stopper",
            "1 or 0."),
)
"""Variables of a trajectory with unilateral contact, one value for each of the legs 1 to n."""

# fmt: on
PARAMETER_MEASURES = _index_measures_by_name(
    *(
        Measure(
            name,
            parameter_domain.unit or "1",
            parameter_domain.symbol,
            name.replace("_", " "),
            parameter_domain.description,
        )
        for name, parameter_domain in PARAMETER_DOMAINS.items()
    )
)
"""Parameters of the wheel as measures, for the axes of a scan."""


LAW_PREFIXES = ("leg.", "hub.")
"""Beginnings of the names of the parameters of laws."""


class _MeasureTable(dict[str, Measure]):
    """Table that also describes quantities of laws and of walkers of yours, without their units."""

    def __missing__(self, name: str) -> Measure:
        return Measure(name, "1", name.rpartition(".")[2], name, "Quantity of a law or a walker.")


MEASURES: dict[str, Measure] = _MeasureTable(
    STEP_MEASURES
    | MARGIN_MEASURES
    | UNILATERAL_STEP_MEASURES
    | STOPPER_MARGIN_MEASURES
    | LIMIT_CYCLE_MEASURES
    | GAIT_SENSITIVITY_MEASURES
    | FORCE_PEAK_MEASURES
    | PASSAGE_MEASURES
    | TRAJECTORY_MEASURES
    | CONTACT_MEASURES
    | PARAMETER_MEASURES
)
"""All measures by name."""

PHASE_NAMES = tuple(phase.phase_name for phase in PAPER_PHASES)
"""Names of the phases of a step, in order: values 0, 1, 2 of `phase`."""

CONTACT_MODE_NAMES = ("in the air", "at rest", "sliding downhill", "sliding uphill")
"""Names of the contact modes of a foot, in order: values 0, 1, 2, 3 of `contact`."""


def make_flag_attributes(flag_names: Iterable[str]) -> dict[str, object]:
    """Return the CF attributes of an integer variable whose values 0, 1, ... mean `flag_names`."""
    flag_names = [flag_name.replace(" ", "_") for flag_name in flag_names]
    return {"flag_values": list(range(len(flag_names))), "flag_meanings": " ".join(flag_names)}


def get_measure(measure_name: str) -> Measure:
    """Return the measure with the name `measure_name`.

    The name may end with a leg label, as "[5]", and may begin with "-", which marks an upper bound.
    """
    return MEASURES[measure_name.removeprefix("-").partition("[")[0]]


def make_labeled_variables(
    column_by_variable_name: Mapping[str, np.ndarray], row_dimension: str
) -> dict[str, xr.Variable]:
    """Return dataset variables for columns of values over the dimension `row_dimension`.

    Measures with one value per leg also have the dimension `leg`.
    """
    return {
        variable_name: xr.Variable(
            (row_dimension, "leg") if MEASURES[variable_name].leg_dimension else row_dimension,
            column_values,
            make_measure_attributes(variable_name),
        )
        for variable_name, column_values in column_by_variable_name.items()
    }


def make_locked_leg_coordinate(n_legs: int) -> xr.Variable:
    """Return the dataset coordinate `leg` for margins of the locked legs 3 to n."""
    leg_attributes = {"long_name": "locked leg", "units": "1"}
    return xr.Variable("leg", np.arange(3, n_legs + 1), leg_attributes)


def describe_violation(margin_name: str) -> str:
    """Return a clause that describes the event at which a margin or indicator crosses 0.

    The name of the margin may end with a leg label, such as "[5]".
    """
    name_without_leg, _, leg_suffix = margin_name.partition("[")
    measure, is_step_measure = MEASURES.get(name_without_leg), name_without_leg in STEP_MEASURES
    if measure is None or not measure.violation_text:
        return (
            f"{measure.long_name} is zero"
            if measure is not None and is_step_measure
            else margin_name.replace("_", " ")
        )
    symbol_text = f"{measure.symbol} = 0: " if is_step_measure else ""
    leg_text = f", leg {leg_suffix[:-1]}" if leg_suffix else ""
    return symbol_text + measure.violation_text + leg_text


def describe_parameter(name: str, domain: ParameterDomain) -> Measure:
    """Return the parameter of a wheel, its ground or its leg force as a measure."""
    if domain.description and name in MEASURES:
        return MEASURES[name]
    kind = "a law" if name.startswith(LAW_PREFIXES) else "the walker"
    description = domain.description or f"Parameter of {kind}."
    return Measure(name, domain.unit, domain.symbol, name, description)


def make_measure_attributes(variable_name: str) -> dict[str, object]:
    """Return the attributes of the dataset variable `variable_name`.

    For integer codes, they include the names of the codes.
    """
    measure_attributes: dict[str, object] = dict(MEASURES[variable_name].variable_attributes)
    if variable_name == "phase":
        measure_attributes |= make_flag_attributes(PHASE_NAMES)
    if variable_name == "contact":
        measure_attributes |= make_flag_attributes(CONTACT_MODE_NAMES)
    if variable_name == "outcome":
        measure_attributes |= make_flag_attributes(Outcome.__members__)
    return measure_attributes


def _evaluate_at_nodes(
    phase: AbstractPhase,
    parts: SmoothParts,
    compute_quantities: Callable[[PhaseInstant], Array],
    n_rates: int = 1,
) -> Any:
    """Return quantities at all nodes and their rates, nested as by `n_rates` calls of `jax.jvp`."""

    def evaluate(sides: Array, state: Array) -> Any:
        smooth_phase = phase.on_sides(tuple(sides)) if phase.n_kinks else phase
        evaluate_quantities: Any = lambda y: compute_quantities(
            PhaseInstant(smooth_phase, smooth_phase.unpack_motion(y))
        )

        def compute_rates(y: Array) -> Array:
            acceleration = smooth_phase.solve_acceleration(smooth_phase.unpack_motion(y))
            return jnp.concatenate([y[phase.n_dof :], jnp.stack(acceleration[: phase.n_dof])])

        for _ in range(n_rates):
            evaluate_quantities = lambda y, function=evaluate_quantities: jax.jvp(
                function, (y,), (compute_rates(y),)
            )
        return evaluate_quantities(state)

    return jax.vmap(lambda sides, states: jax.vmap(lambda y: evaluate(sides, y))(states))(
        parts.sides, parts.states
    )


def _make_phases(params: WheelParams, foot_distance: Array) -> tuple[AbstractPhase, ...]:
    return make_paper_phases(params.symbols(), foot_distance, stop_at_lift_off=False)


@jax.jit
def measure_forces(
    params: WheelParams, x: Array, parts_by_phase: Sequence[SmoothParts]
) -> dict[str, Array]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a step from the section state `x`.

    They are NaN if a phase has more kinks than parts are listed.
    """
    landing = transitions.resolve_landing(params.symbols(), *x)

    def compute_forces(instant: PhaseInstant) -> Array:
        fore = jnp.asarray(instant.fore_force.normal)
        rear = 0.0 if instant.rear_force is None else instant.rear_force.normal
        return jnp.stack([fore, fore + rear])

    extrema_by_phase, phase_start = [], jnp.zeros_like(x[0])
    for phase, parts in zip(
        _make_phases(params, landing.foot_distance), parts_by_phase, strict=True
    ):
        (forces, rates), (_, second_rates) = _evaluate_at_nodes(phase, parts, compute_forces, 2)
        rate_extrema = find_extrema(rates[..., 0], second_rates[..., 0], parts.durations)
        extrema = []
        for i in range(2):
            found = find_extrema(forces[..., i], rates[..., i], parts.durations)
            extrema.append(
                StepForceExtrema(
                    found.times + phase_start,
                    *found[1:],
                    rate_extrema.times + phase_start,
                    rate_extrema.values,
                    rate_extrema.is_maximum,
                    mask_ends(forces[..., i], parts.durations),
                )
            )
        extrema_by_phase.append(extrema)
        phase_start = phase_start + jnp.sum(parts.durations)
    joined = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *extrema_by_phase)
    measures = summarize_forces(jnp, *joined) | {"landing_impulse": landing.fore_impulse.normal}
    return {
        name: mask_incomplete(jnp.asarray(value, x.dtype), parts_by_phase)
        for name, value in measures.items()
    }


@eqx.filter_jit
def evaluate_own_measure(
    measure: Measure,
    params: WheelParams,
    params_with_laws: WheelParams,
    x: Array,
    parts_by_phase: Sequence[SmoothParts],
) -> Array:
    """Return a measure of the user over phases of a step from the section state `x`.

    It is NaN if a phase has more kinks than parts are listed.
    """
    phase_names = [phase.phase_name for phase in PAPER_PHASES]
    for name in measure.phases:
        require_known_name(name, phase_names, "phase")
    landing = transitions.resolve_landing(params_with_laws.symbols(), *x)
    phases = _make_phases(params_with_laws, landing.foot_distance)
    measured = [
        (phase, parts)
        for phase, parts in zip(phases, parts_by_phase, strict=True)
        if phase.phase_name in measure.phases
    ]
    evaluate = lambda instant: jnp.asarray(measure(instant, params))
    if measure.reduction in ("min", "max"):
        sign, candidates = (1.0 if measure.reduction == "max" else -1.0), []
        for phase, parts in measured:
            values, rates = _evaluate_at_nodes(phase, parts, evaluate)
            extrema = find_extrema(sign * values, sign * rates, parts.durations)
            candidates.append(jnp.where(extrema.is_maximum, extrema.values, -jnp.inf))
            candidates.append(mask_ends(sign * values, parts.durations))
        largest = jnp.max(jnp.concatenate(candidates))
        result = jnp.where(jnp.isfinite(largest), sign * largest, 0.0)
    else:
        integral: Any = sum(
            integrate_over_parts(_evaluate_at_nodes(phase, parts, evaluate, 0), parts.durations)
            for phase, parts in measured
        )
        duration: Any = sum(jnp.sum(parts.durations) for _, parts in measured)
        divisor = jnp.where(duration > 0.0, duration, 1.0)
        result = integral / divisor if measure.reduction == "mean" else integral
    return mask_incomplete(result, parts_by_phase)

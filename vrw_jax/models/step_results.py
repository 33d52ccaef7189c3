"""Results of one step: measures, margins and energies. All models share a common part."""

import abc
import functools
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base.results import (
    AbstractPrintable,
    LabelAndText,
    Outcome,
    describe_step_ending,
    format_outcome_counts,
    format_quantity,
)
from vrw_jax.models.measures import MARGIN_MEASURES, MEASURES

SectionState = Float[Array, "3"]
"""State (theta-, dtheta-, dL1-) just before touchdown, in rad, rad/s and m/s. The leg labels are
those of the step that ends. The touchdown condition determines the length of Leg 1. Leg 2 is on its
stopper.
"""
AnySectionState = Float[Array, "section ..."]
"""Section state of any model: a `SectionState` or a longer vector. A batch has its elements on the
last axis.
"""
PAPER_START_STATE = (0.1, 1.6, -0.1)
"""Start near the gait of Table 1 of the paper, inside the gait's basin of attraction: rad, rad/s,
m/s.
"""


SectionStateEntries = Float[Array, "section ..."] | tuple[Array, ...]
"""Section state as one array, or as separate entries. Each entry may be an array with one value per
batch element.
"""


MeasureValue = Float[Array, "..."]
"""Value of a measure for a step; a batch has one value per element."""


class AbstractMeasureGroup(AbstractPrintable):
    """Group of measures. Each field is one of the measures in `measures.MEASURES`."""

    measure_name_by_field: eqx.AbstractClassVar[Mapping[str, str]]
    """Names of the measures in `measures.MEASURES`, by field, for the fields whose names differ."""

    def measures(self) -> dict[str, Array]:
        """Return the value of each field, by the name of its measure in `measures.MEASURES`."""
        return {
            self.measure_name_by_field.get(field_name, field_name): field_value
            for field_name, field_value in vars(self).items()
        }

    def summary_rows(self) -> list[LabelAndText]:
        """Return the label and the printed value for each measure."""
        measure_items = self.measures().items()
        return [
            (
                MEASURES[measure_name].label_with_symbol,
                format_quantity(measure_value, MEASURES[measure_name].unit),
            )
            for measure_name, measure_value in measure_items
        ]


class DoubleSupportIndicators(AbstractMeasureGroup):
    """Indicators of double-limb support (Section 5.1 of the paper), for the landing that opens the
    step.

    - `lambda_I4`: normal impulse on the rear foot in the landing, if both feet stay fixed to the
      ground, N s;
    - `lambda_2`: normal force on the fore foot just after the landing, N;
    - `lambda_4`: normal force on the rear foot just after the landing, N.

    Examples:
        >>> indicators = vrw.limit_cycle(vrw.WheelParams()).indicators
        >>> print(f"{indicators.lambda_4:.2f} N")
        9.47 N
    """

    measure_name_by_field: ClassVar = {"lambda_2": "lambda_2_plus", "lambda_4": "lambda_4_plus"}

    lambda_I4: MeasureValue
    lambda_2: MeasureValue
    lambda_4: MeasureValue


class EnergyLoss(AbstractMeasureGroup):
    """Mechanical energy that the wheel loses in the step, J. Each part is positive for a loss.

    - `landing`, `stopper`: loss in the landing and in the collision of Leg 2 with its stopper;
    - `damping`: loss in the dampers of the legs. A hub torque that varies with the rate counts as
      a damper, so that its work reduces this loss.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.energy.landing:.1f} J, {step.energy.damping:.1f} J")
        7.4 J, 26.2 J
    """

    measure_name_by_field: ClassVar = {
        name: f"energy_lost_{name}" for name in ("landing", "stopper", "damping")
    }

    landing: MeasureValue
    stopper: MeasureValue
    damping: MeasureValue


class RequiredFriction(AbstractMeasureGroup):
    """Friction coefficients that the feet need to stay at rest in one step.

    A coefficient is the ratio of tangential to normal force, or of tangential to normal impulse. A
    foot slides if the ground's friction coefficient is below this ratio. Phases and impacts that
    did not occur need no friction. All fields of a step that did not begin are 0.

    - `largest`: largest of the next four coefficients, the smallest friction coefficient for which
      all friction margins are positive or 0;
    - `fore`: largest ratio of forces on the fore foot between the impacts;
    - `rear`: ratio of forces on the rear foot just after the landing. The rest of double support
      does not count, because the ratio grows without bound until take-off: the normal force
      vanishes there, and the tangential force does not. At any finite friction coefficient the
      rear foot therefore slides shortly before it lifts;
    - `landing_fore`, `landing_rear`: ratios of impulses in the landing;
    - `stopper`: ratio of impulses on the planted foot in the collision of Leg 2 with its stopper,
      infinite if the ground would have to pull. It is not part of `largest`, because this impulse
      is small: for the gait of Table 1 a thousandth of that of the landing.

    Apart from `stopper`, a foot that the ground would have to pull needs no friction. The margin
    `fore_foot_force` is negative instead.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> need = vrw.step(vrw.WheelParams(), x).required_friction
        >>> f"{need.largest:.1f} {need.fore:.2f} {need.landing_fore:.2f} {need.landing_rear:.1f}"
        '14.2 0.61 1.10 9.7'
    """

    measure_name_by_field: ClassVar = {
        "largest": "required_friction",
        **{
            part: f"required_friction_{part}"
            for part in ("fore", "rear", "landing_fore", "landing_rear", "stopper")
        },
    }

    largest: MeasureValue
    fore: MeasureValue
    rear: MeasureValue
    landing_fore: MeasureValue
    landing_rear: MeasureValue
    stopper: MeasureValue

    @classmethod
    def from_parts(
        cls, fore: Array, rear: Array, landing_fore: Array, landing_rear: Array, stopper: Array
    ) -> "RequiredFriction":
        """Return the coefficients together with their largest."""
        largest = jnp.maximum(jnp.maximum(fore, rear), jnp.maximum(landing_fore, landing_rear))
        return cls(largest, fore, rear, landing_fore, landing_rear, stopper)


class Margins(AbstractMeasureGroup):
    """Margins of the viscoelastic model's assumptions in one step. A negative margin is a
    violation.

    Margins do not affect the motion. Forces and lengths are minima over the step, accurate to the
    integrator's tolerance. A quantity may be 0 by construction at the start of a phase, for example
    the height of a foot that leaves the ground. Its margin then ignores that start and begins at
    the first later minimum. Friction margins are the model's `friction` minus the required
    coefficient. The friction margin of the rear foot is evaluated just after landing, because the
    required coefficient grows without bound as the foot unloads. Phases that did not occur are
    ignored. A step that did not begin has margins of 0.

    - `fore_foot_force`: lambda_2, N;
    - `takeoff_acceleration`: acceleration of foot 2 normal to the slope at the start of SLS-I,
      m/s^2. The sign determines whether the foot rises or scuffs. At the boundary of scuffing this
      margin is smooth, whereas `clearance_sls1` is not;
    - `clearance_sls1`: height of foot 2 in SLS-I, m;
    - `clearance_sls2`: height of foot 2 in SLS-II, m;
    - `locked_stopper_force`: stopper force of legs 3..n, N;
    - `rear_stopper_force`: stopper force of Leg 2 in SLS-II, N;
    - `contraction`: L0 - L1 after landing, m;
    - `friction_fore`: friction margin of the fore foot;
    - `friction_rear`: friction margin of the rear foot just after landing;
    - `landing_stopper_impulse`: stopper impulse of legs 3..n at the landing, N s;
    - `hit_stopper_impulse`: stopper impulse of legs 3..n at the collision of Leg 2 with its
      stopper, N s;
    - `hit_planted_impulse`: normal impulse of the planted foot in the same collision, N s;
    - `landing_friction_fore`: friction margin of the fore foot in the landing impulse;
    - `landing_friction_rear`: friction margin of the rear foot in the landing impulse.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> print(f"{vrw.step(vrw.WheelParams(), x).margins.friction_rear:.2f}")
        -13.22
    """

    measure_name_by_field: ClassVar = {}

    fore_foot_force: MeasureValue
    takeoff_acceleration: MeasureValue
    clearance_sls1: MeasureValue
    clearance_sls2: MeasureValue
    locked_stopper_force: Float[Array, "n_locked ..."]
    rear_stopper_force: MeasureValue
    contraction: MeasureValue
    friction_fore: MeasureValue
    friction_rear: MeasureValue
    landing_stopper_impulse: Float[Array, "n_locked ..."]
    hit_stopper_impulse: Float[Array, "n_locked ..."]
    hit_planted_impulse: MeasureValue
    landing_friction_fore: MeasureValue
    landing_friction_rear: MeasureValue


class AbstractStep(AbstractPrintable):
    """Results of a walking step that every model reports. Under `vmap`, each field gains a batch
    axis.
    """

    section_state: AnySectionState  # just before the next touchdown
    post_impact: Float[Array, "2 ..."]  # (theta, dtheta), rad, rad/s
    durations: Float[Array, "3 ..."]  # double support first, s
    step_length: MeasureValue  # m
    outcome: Int[Array, "..."]  # an Outcome
    solver_steps: Int[Array, "..."]  # attempted solver steps

    @property
    def ending(self) -> Any:
        """Return a sentence that describes how the step ended; a batch has an array of
        sentences.
        """
        return describe_step_ending(self.outcome, Outcome)

    @property
    def period(self) -> Array:
        """Return the duration of the step, s."""
        return jnp.sum(self.durations, axis=-1)

    @property
    def dls_fraction(self) -> Array:
        """Return the duration of double support divided by that of the step; 0 for a step of
        duration 0.
        """
        period = self.period
        return self.durations[..., 0] / jnp.where(period > 0.0, period, 1.0)

    @property
    def speed(self) -> Array:
        """Return the step length divided by the duration, m/s; 0 for a step of duration 0."""
        period = self.period
        return jnp.where(period > 0.0, self.step_length / jnp.where(period > 0.0, period, 1.0), 0.0)

    def measures(self) -> dict[str, Array]:
        """Return the value of each measure of the step, by its name in `measures.MEASURES`.

        Batch axes come first, and the axis of legs comes last.
        """
        shared_measures = {
            "dls_fraction": self.dls_fraction,
            "period": self.period,
            "speed": self.speed,
            "step_length": self.step_length,
            "duration_dls": self.durations[..., 0],
            "theta_post_impact": self.post_impact[..., 0],
            "dtheta_post_impact": self.post_impact[..., 1],
            "theta_touchdown": self.section_state[..., 0],
            "dtheta_touchdown": self.section_state[..., 1],
            "outcome": self.outcome,
            "solver_steps": self.solver_steps,
        }
        return shared_measures | self.collect_model_measures()

    def summary_rows(self) -> list[LabelAndText]:
        """Return labels and printed values: first the measures, then the margins.

        The text for a margin states whether the margin holds.
        """
        step_outcome, measure_values = np.asarray(self.outcome), self.measures()
        if step_outcome.ndim:
            return [("steps", format_outcome_counts(step_outcome, Outcome))]
        outcome_code = Outcome(int(step_outcome))
        text_rows = [("outcome", f"{outcome_code.name}: {outcome_code.meaning}")]
        for measure_name, measure_value in measure_values.items():
            if measure_name == "outcome":
                continue
            measure_description = MEASURES[measure_name]
            lowest_value = float(np.min(np.asarray(measure_value)))
            label = measure_description.label_with_symbol
            value_text = measure_description.format_with_unit(lowest_value)
            if measure_name in MARGIN_MEASURES:
                label = f"margin: {label}"
                value_text += ", holds" if lowest_value >= 0.0 else ", broken"
            text_rows.append((label, value_text))
        return text_rows

    @abc.abstractmethod
    def collect_model_measures(self) -> dict[str, Array]:
        """Return the values of the measures that only some models have, by name."""


class AbstractContactStep(AbstractStep):
    """Results of a step in which contacts may occur in any order.

    The `durations` are the times with two, one and no loaded feet, s.
    """

    energy_impacts: MeasureValue  # lost in impacts, J
    energy_damping: MeasureValue  # lost in the dampers, J
    energy_friction: MeasureValue  # lost by sliding between impacts, J
    slip: MeasureValue  # path length of sliding feet, m

    def collect_model_measures(self) -> dict[str, Array]:
        """Return the values of the measures that only contact steps have, by name."""
        return {
            "energy_lost_damping": self.energy_damping,
            "duration_single": self.durations[..., 1],
            "duration_flight": self.durations[..., 2],
            "slip": self.slip,
            "energy_lost_impacts": self.energy_impacts,
            "energy_lost_friction": self.energy_friction,
        }


class StepResult(AbstractStep):
    """Results of one step from touchdown to touchdown. Under `vmap`, each field gains a batch axis.

    If the outcome is not STEPPED, the fields are finite and describe the partial motion. All
    entries of `section_state` are then 0, which is not a valid section state.

    - `section_state`: section state just before the next touchdown;
    - `post_impact`: (theta, dtheta) just after the opening landing, rad, rad/s;
    - `durations`: durations of DLS, SLS-I and SLS-II, s;
    - `step_length`: distance between the feet at the opening landing, m;
    - `indicators`, `margins`, `required_friction`, `energy`: `DoubleSupportIndicators`, `Margins`,
      `RequiredFriction` and `EnergyLoss`;
    - `outcome`: code of the `Outcome`;
    - `solver_steps`: number of attempted solver steps;
    - `engine`: name of the engine, see `StepOptions`.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.dls_fraction:.3f} {step.margins.clearance_sls1:.3f} m")
        0.548 0.060 m
    """

    indicators: DoubleSupportIndicators
    margins: Margins
    required_friction: RequiredFriction
    energy: EnergyLoss
    engine: str = eqx.field(static=True, default="")

    def collect_model_measures(self) -> dict[str, Array]:
        """Return the values of the measures that only models with the paper's phases have, by
        name.
        """
        return {
            "duration_sls1": self.durations[..., 1],
            "duration_sls2": self.durations[..., 2],
            "dL1_touchdown": self.section_state[..., 2],
            **self.indicators.measures(),
            **self.energy.measures(),
            **self.required_friction.measures(),
            **self.margins.measures(),
        }


def combine_steps(first: StepResult, second: StepResult) -> StepResult:
    """Return two successive steps as one, for gaits in which two different legs land in turn.

    Durations, lengths and energies are sums. Indicators and margins are the lower, and required
    friction coefficients the higher of both. If the first step has failed, it is the result.
    """

    def merge(function: Callable, field_name: str) -> Any:
        return jax.tree.map(function, getattr(first, field_name), getattr(second, field_name))

    both = StepResult(
        section_state=second.section_state,
        post_impact=first.post_impact,
        durations=merge(jnp.add, "durations"),
        step_length=merge(jnp.add, "step_length"),
        indicators=merge(jnp.minimum, "indicators"),
        margins=merge(jnp.minimum, "margins"),
        required_friction=merge(jnp.maximum, "required_friction"),
        energy=merge(jnp.add, "energy"),
        outcome=second.outcome,
        solver_steps=merge(jnp.add, "solver_steps"),
        engine=first.engine,
    )
    has_stepped = first.outcome == Outcome.STEPPED
    return jax.tree.map(functools.partial(jnp.where, has_stepped), both, first)


class Trajectory(eqx.Module):
    """States, forces and energies at samples of each phase of one step; both ends are included.

    The first axis runs over the phases (DLS, SLS-I, SLS-II), the second over the samples. A phase
    that did not occur has duration 0, and all its samples equal its start. Coordinates use the leg
    labels of this step, and the foot of Leg 1 is the origin. The last three fields are those of the
    `AdvanceResult`.
    """

    time: Float[Array, "3 n ..."]  # time since the landing, s
    state: Float[Array, "3 n 6 ..."]  # theta, L1, L2 and their rates
    forces: Float[Array, "3 n 4 ..."]  # lambda_1 ... lambda_4, N
    energy: Float[Array, "3 n 3 ..."]  # kinetic, gravitational, elastic, J
    section_state: AnySectionState
    durations: Float[Array, "3 ..."]  # s
    outcome: Int[Array, "..."]  # an Outcome

    @property
    def is_complete(self) -> Any:
        """Return whether the step ended at the next touchdown."""
        return self.outcome == Outcome.STEPPED

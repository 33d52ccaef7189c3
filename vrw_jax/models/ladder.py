"""Ladder of models, which takes the simplest valid model for each step, and table of all models.

The step is first computed with the viscoelastic model, together with its margins. If a margin is
violated, the step is computed again with the unilateral model. Under `vmap`, a model is selected
for each batch element. The unilateral model computes nothing for elements for which the
viscoelastic model is valid. The rigid model is never selected, because its assumption of rigid legs
is violated for every finite stiffness.

To add a model, only the table `MODEL_CLASSES` has to be extended.
"""

import dataclasses
import enum
import platform
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base.elementwise import RealInput, Scalar
from vrw_jax.base.options import StepOptions, list_tree_parameters
from vrw_jax.base.results import AbstractPrintable, LabelAndText, Outcome, format_each_batch_element
from vrw_jax.base.walker import AdvanceResult
from vrw_jax.lanes.environment import find_library_version
from vrw_jax.models.contact_record import LOCKED_CODE_OFFSET, FullState, embed_section_state
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.measures import MARGIN_MEASURES, SELECTION_MARGIN_NAMES, make_flag_attributes
from vrw_jax.models.phase_sequence import replace_invalid_inputs
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_results import (
    PAPER_START_STATE,
    AbstractContactStep,
    StepResult,
)
from vrw_jax.models.unilateral_wheel import (
    AbstractContactWheel,
    UnilateralTrajectory,
    UnilateralWheel,
    convert_torque_of_rate,
)
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.laws import convert_leg_force
from vrw_jax.wheel.params import WheelParams, convert_friction
from vrw_jax.wheel.transitions import ContactMode


class ModelCode(enum.IntEnum):
    """Integer code of the model with which a step is computed. Stores contain these codes."""

    RIGID = 0
    VISCOELASTIC = 1
    UNILATERAL = 2


START_NOT_EMBEDDABLE_REASON_CODE = 1 + len(SELECTION_MARGIN_NAMES)
"""Reason code for a start that is not a section state of the viscoelastic model."""


SELECTION_VARIABLE_ATTRIBUTES: dict[str, dict[str, object]] = {
    "rung": {
        "long_name": "model that was used",
        **make_flag_attributes(
            model_class.__name__ for model_class in (RigidWheel, ViscoelasticWheel, UnilateralWheel)
        ),
    },
    "reason": {
        "long_name": "why that model was used",
        "units": "1",
        "description": "0: all margins of the paper's wheel hold; above: the first that breaks, "
        f"of {', '.join(SELECTION_MARGIN_NAMES)}; below: minus that wheel's outcome.",
    },
}
"""Attributes of the dataset variables for the codes of the model and of the reason."""


class ModelChoice(AbstractPrintable):
    """Model that is selected for a step, and the reason. Under `vmap`, each field has a batch axis.

    - `model_code`: code of the model, `ModelCode.VISCOELASTIC` or `ModelCode.UNILATERAL`;
    - `reason_code`: 0 if the viscoelastic model is valid. If a margin is violated, the code is 1 +
      the index of the first such margin in `SELECTION_MARGIN_NAMES`. If a leg other
      than Leg 1 is loaded or off its stopper at the start, the code is
      `START_NOT_EMBEDDABLE_REASON_CODE`. If the step computed with the viscoelastic model does not
      reach a touchdown, the code is the negative of the outcome code;
    - `margins`: values of the margins in `SELECTION_MARGIN_NAMES`, negative for a
      violation;
    - `friction`: friction coefficient of the ground.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> vrw.choose_model(vrw.WheelParams(), x, friction=50.0).margins.shape
        (8,)
    """

    model_code: Int[Array, ""]
    reason_code: Int[Array, ""]
    margins: Float[Array, " n_margins"]
    friction: Scalar

    def summary_rows(self) -> list[LabelAndText]:
        """Return labels and printed texts for the model, the reason and the margins."""
        reason_codes = np.asarray(self.reason_code)
        if reason_codes.ndim:
            n_viscoelastic_choices = int(np.sum(reason_codes == 0))
            return [
                (
                    "wheels",
                    f"{reason_codes.size} in shape {reason_codes.shape}, "
                    f"{n_viscoelastic_choices} served by the paper's",
                )
            ]
        margin_text_rows = [
            (
                MARGIN_MEASURES[margin_name].label_with_symbol,
                MARGIN_MEASURES[margin_name].format_with_unit(margin_value),
            )
            for margin_name, margin_value in zip(
                SELECTION_MARGIN_NAMES, np.asarray(self.margins), strict=True
            )
        ]
        return [("model", type(self.model).__name__), ("reason", self.why), *margin_text_rows]

    @property
    def model(self) -> AbstractWheel:
        """Return the selected model, with the paper's laws. The choice must be for one wheel."""
        if int(self.model_code) == ModelCode.VISCOELASTIC:
            return ViscoelasticWheel(friction=float(self.friction))
        return UnilateralWheel(friction=self.friction)

    @property
    def why(self) -> Any:
        """Return a sentence that states why the model was selected; a batch has an array of
        sentences.
        """
        return format_each_batch_element(describe_selection_reason, self.reason_code)


def describe_selection_reason(reason_code: int) -> str:
    """Return a sentence that explains a reason code of `ModelChoice`."""
    if reason_code == 0:
        return "The paper's model is valid: all its margins are positive in this step."
    if reason_code < 0:
        return f"The step of the paper's model fails: {Outcome(-reason_code).meaning}"
    if reason_code == START_NOT_EMBEDDABLE_REASON_CODE:
        return "The start is not the paper's: another leg is loaded or off its stopper."
    violation_text = MARGIN_MEASURES[SELECTION_MARGIN_NAMES[reason_code - 1]].violation_text
    return f"The paper's model is not valid: {violation_text}."


def find_selection_reason(
    step_measures: Mapping[str, Any], friction_coefficient_change: Any
) -> tuple[Array, Array]:
    """Return the reason for the choice of a model for each step, and the margins of each step.

    The reasons are codes of `ModelChoice.reason_code`. The margins are those of the step computed
    with the viscoelastic model, on the last axis, corrected by `friction_coefficient_change`.

    - `step_measures`: measures and outcome codes of the steps, by name;
    - `friction_coefficient_change`: friction coefficient of the ground minus that in
      `step_measures`.
    """
    selection_margins = jnp.stack(
        [
            step_measures[margin_name]
            + (friction_coefficient_change if "friction" in margin_name else 0.0)
            for margin_name in SELECTION_MARGIN_NAMES
        ],
        -1,
    )
    is_margin_violated = ~(selection_margins >= 0.0)
    violated_margin_code = jnp.where(
        jnp.any(is_margin_violated, -1), 1 + jnp.argmax(is_margin_violated, -1), 0
    )
    step_outcome = jnp.asarray(step_measures["outcome"], violated_margin_code.dtype)
    reason_code = jnp.where(step_outcome == Outcome.STEPPED, violated_margin_code, -step_outcome)
    return reason_code, selection_margins


class LadderStep(AbstractContactStep):
    """One step, computed with the simplest valid model. Under `vmap`, each field has a batch axis.

    - `choice`: selected model and reason, a `ModelChoice`;
    - `section_state`: section state just before the next landing; zeros if there was no landing;
    - `post_impact`: (theta, dtheta) just after the opening landing, rad, rad/s;
    - `durations`: times with two, one and no loaded feet, s;
    - `step_length`: distance between the places of the two landings, m;
    - `energy_impacts`: energy lost in impacts, J;
    - `energy_damping`: energy lost in the dampers, J;
    - `energy_friction`: energy lost by sliding between impacts, J;
    - `slip`: path length of sliding feet, m;
    - `outcome`: code of the `Outcome`;
    - `solver_steps`: number of attempted solver steps, summed over the two models.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> step = vrw.step(vrw.WheelParams(), x, model=vrw.LadderWheel(friction=50.0))
        >>> print(f"{step.dls_fraction:.3f}")
        0.532
    """

    choice: ModelChoice


class LadderWheel(AbstractContactWheel):
    """Ladder of models: the viscoelastic model where it is valid, and else the unilateral model.

    A step is computed with the viscoelastic model if that model is valid for the step. Otherwise it
    is computed with the unilateral model and the coefficient `friction`. Section states are those
    of `UnilateralWheel`; section states of the paper, which have three entries, are also accepted.

    - `friction`: friction coefficient of the ground, `inf` for feet that never slide;
    - `leg_force`, `hub_torque`: laws of the legs and of the hub in both models, as in
      `ViscoelasticWheel`.

    Examples:
        >>> wheel = vrw.LadderWheel(friction=50.0)
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> step = vrw.step(vrw.WheelParams(), x, model=wheel)
        >>> step.choice.why
        "The paper's model is valid: all its margins are positive in this step."
    """

    model_name: ClassVar[str] = "ladder"
    commands = frozenset({"scan"})
    can_walk_on_uneven_ground = False

    friction: Scalar = eqx.field(converter=convert_friction, default=0.7)
    leg_force: Any = eqx.field(converter=convert_leg_force, default=None)
    hub_torque: Any = eqx.field(converter=convert_torque_of_rate, default=None)

    if TYPE_CHECKING:

        def __init__(
            self, friction: RealInput = 0.7, leg_force: Any = None, hub_torque: Any = None
        ) -> None: ...

    @property
    def viscoelastic_model(self) -> ViscoelasticWheel:
        """Return the viscoelastic model, which is used where it is valid."""
        return ViscoelasticWheel().with_laws(self.laws)

    @property
    def unilateral_model(self) -> UnilateralWheel:
        """Return the unilateral model, which is used if the viscoelastic model is not valid for a
        step.
        """
        return UnilateralWheel(friction=self.friction).with_laws(self.laws)

    @property
    def fallback_model(self) -> UnilateralWheel:
        return self.unilateral_model

    def choose_model(
        self, params: WheelParams, x: FullState, options: StepOptions
    ) -> tuple[ModelChoice, StepResult]:
        """Return the selected model, and the step computed with the viscoelastic model."""
        viscoelastic_model = self.viscoelastic_model
        ground_friction = self.friction.astype(x.dtype)
        # Leg 1 alone must be loaded and at rest, with all other legs on their stoppers.
        is_leg_1 = jnp.arange(params.n_legs) == 0
        locked_leg_code = float(LOCKED_CODE_OFFSET + ContactMode.OFF)
        expected_contact_codes = jnp.where(is_leg_1, float(ContactMode.STICK), locked_leg_code)
        is_start_embeddable = jnp.all(
            jnp.round(x[4 + 2 * params.n_legs :]) == expected_contact_codes
        )
        viscoelastic_section_state = jnp.stack([x[0], x[1], x[4 + params.n_legs]])
        viscoelastic_result = viscoelastic_model.take_step(
            params, jnp.where(is_start_embeddable, viscoelastic_section_state, jnp.nan), options
        )
        reason_code, margins = find_selection_reason(
            viscoelastic_result.measures(), ground_friction - viscoelastic_model.friction
        )
        reason_code = jnp.where(
            is_start_embeddable, reason_code, START_NOT_EMBEDDABLE_REASON_CODE
        ).astype(jnp.int32)
        model_code = jnp.where(
            reason_code == 0, ModelCode.VISCOELASTIC, ModelCode.UNILATERAL
        ).astype(jnp.int32)
        return ModelChoice(model_code, reason_code, margins, ground_friction), viscoelastic_result

    def advance(self, params: WheelParams, x: FullState, options: StepOptions) -> AdvanceResult:
        model_choice, step_values = self._compute_step_values(
            params, x, options, self.unilateral_model.advance
        )
        return AdvanceResult(
            **step_values,
            model_code=model_choice.model_code,
            reason_code=model_choice.reason_code,
        )

    def take_step(self, params: WheelParams, x: FullState, options: StepOptions) -> LadderStep:
        model_choice, step_values = self._compute_step_values(
            params, x, options, self.unilateral_model.take_step
        )
        return LadderStep(choice=model_choice, **step_values)

    def _compute_step_values(
        self,
        params: WheelParams,
        x: FullState,
        options: StepOptions,
        compute_unilateral_step: Callable,
    ) -> tuple[ModelChoice, dict[str, Any]]:
        """Return the selected model, and the values of a step by their names in `LadderStep`.

        The values are those that the result of `compute_unilateral_step` has.
        """
        model_choice, viscoelastic_result = self.choose_model(params, x, options)
        is_viscoelastic_valid = model_choice.model_code == ModelCode.VISCOELASTIC
        unilateral_result = compute_unilateral_step(
            params, jnp.where(is_viscoelastic_valid, jnp.nan, x), options
        )
        dls_duration, sls1_duration, sls2_duration = viscoelastic_result.durations
        durations_by_loaded_feet = [
            dls_duration,
            sls1_duration + sls2_duration,
            jnp.zeros_like(dls_duration),
        ]
        # If the viscoelastic model is not valid, the paper's start state is embedded.
        section_state = viscoelastic_result.section_state
        valid_params, valid_section_state = replace_invalid_inputs(
            is_viscoelastic_valid,
            params,
            section_state,
            jnp.asarray(PAPER_START_STATE, section_state.dtype),
        )
        energy_loss = viscoelastic_result.energy
        viscoelastic_values: dict[str, Any] = {
            "section_state": embed_section_state(valid_params.symbols(), valid_section_state),
            "post_impact": viscoelastic_result.post_impact,
            "durations": jnp.stack(durations_by_loaded_feet),
            "step_length": viscoelastic_result.step_length,
            "energy_impacts": energy_loss.landing + energy_loss.stopper,
            "energy_damping": energy_loss.damping,
            "energy_friction": 0.0,
            "slip": 0.0,
            "outcome": viscoelastic_result.outcome,
        }
        step_values = {
            value_name: jnp.where(
                is_viscoelastic_valid, viscoelastic_value, getattr(unilateral_result, value_name)
            )
            for value_name, viscoelastic_value in viscoelastic_values.items()
            if hasattr(unilateral_result, value_name)
        }
        step_values["solver_steps"] = (
            viscoelastic_result.solver_steps + unilateral_result.solver_steps
        )
        return model_choice, step_values

    def sample_step(
        self, params: WheelParams, x: FullState, options: StepOptions, n_samples: int
    ) -> UnilateralTrajectory:
        """Return the motion during a step, in the form that the unilateral model returns.

        If the viscoelastic model is selected, no foot slips, and the motion is that of the
        viscoelastic model.
        """
        model_choice, _ = self.choose_model(params, x, options)
        friction = jnp.where(
            model_choice.model_code == ModelCode.VISCOELASTIC, jnp.inf, self.friction
        )
        unilateral_wheel = UnilateralWheel(friction=friction, infinite_friction_rule="paper")
        unilateral_wheel = unilateral_wheel.with_laws(self.laws)
        trajectory = unilateral_wheel.sample_step(params, x, options, n_samples)
        selection = {"rung": model_choice.model_code, "reason": model_choice.reason_code}
        return dataclasses.replace(trajectory, model_selection=selection)


MODEL_CLASSES: dict[str, type[AbstractWheel]] = {
    "viscoelastic": ViscoelasticWheel,
    "rigid": RigidWheel,
    "unilateral": UnilateralWheel,
    "auto": LadderWheel,
}
"""Classes of all models by their names in a configuration, in the order in which error messages
list them. The first class is the default model.
"""


def list_model_config_names(
    command_name: str | None = None, parameter_name: str | None = None
) -> tuple[str, ...]:
    """Return the configuration names of all models that satisfy two optional conditions.

    - `command_name`: command that must accept the model;
    - `parameter_name`: parameter on which the model's motion must depend.
    """
    return tuple(
        config_name
        for config_name, model_class in MODEL_CLASSES.items()
        if (command_name is None or command_name in model_class.commands)
        and (parameter_name is None or parameter_name in model_class().parameter_names)
    )


def describe_accepted_models(
    command_name: str | None = None, parameter_name: str | None = None
) -> str:
    """Return the models from `list_model_config_names` as expressions that users can write.

    An example is `vrw.RigidWheel() or "auto"`.
    """
    *first_expressions, last_expression = (
        f'"{name}"' if name == "auto" else f"vrw.{MODEL_CLASSES[name].__name__}()"
        for name in list_model_config_names(command_name, parameter_name)
    )
    return " or ".join(filter(None, (", ".join(first_expressions), last_expression)))


def collect_provenance_attributes(
    params: Any, model: object, options: StepOptions | None = None
) -> dict[str, str | float | int]:
    """Return dataset attributes that describe how a result was computed.

    They state versions, device, floating-point type, tolerances and parameters. The default of
    `options` is `StepOptions()`.
    """
    options = StepOptions() if options is None else options
    parameter_attributes: dict[str, str | float | int] = {
        f"parameter_{parameter.name}": float(parameter.value)
        for parameter in list_tree_parameters(params)
        if jnp.ndim(parameter.value) == 0
    }
    if isinstance(params, WheelParams):
        parameter_attributes["parameter_n_legs"] = params.n_legs
    return parameter_attributes | {
        "model": repr(model),
        "versions": ", ".join(
            f"{library_name} {find_library_version(library_name)}"
            for library_name in ("vrw-jax", "jax", "diffrax", "numpy")
        )
        + f", python {platform.python_version()}",
        "device": jax.devices()[0].device_kind,
        "dtype": str(jnp.result_type(*jax.tree.leaves(params), float)),
        "solver": options.solver,
        "rtol": float(options.rtol),
        "atol": float(options.atol),
    }

"""The ladder: a wheel that takes each step by the lowest model whose assumptions hold over the
step.

The viscoelastic model takes the step and measures its margins. If one is violated, the unilateral
model takes the step again. Under `vmap` the choice is made per batch element, and an element for
which the viscoelastic model holds costs no work in the unilateral model. The rigid model is never
chosen, because its assumption of rigid legs fails for every finite stiffness.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.models.base import (
    AbstractGroundStep,
    AbstractWheel,
    Advance,
    StepResult,
    replaced_where_bad,
)
from vrw_jax.models.paper_step import PAPER_START
from vrw_jax.models.unilateral.contacts import OFF, STICK
from vrw_jax.models.unilateral.ledger import UnilateralStep
from vrw_jax.models.unilateral.section import LOCKED, FullState, embedded
from vrw_jax.models.unilateral.wheel import UnilateralTrajectory, UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.numerics import Number, Options, Scalar
from vrw_jax.results import MARGINS
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, Outcome, WheelParams, friction_of
from vrw_jax.wording import AbstractTold, Row

RIGID, VISCOELASTIC, UNILATERAL = 0, 1, 2
"""Codes of the models; 0 is the rigid one."""

PREMISES: dict[str, str] = {
    name: MARGINS[name].breaks
    for name in (
        "fore_foot_force",
        "clearance_sls1",
        "clearance_sls2",
        "contraction",
        "friction_fore",
        "friction_rear",
        "landing_friction_fore",
        "landing_friction_rear",
    )
}
"""Margins of the assumptions that only the viscoelastic model makes, with the text of a
violation."""

OFF_THE_PLANE = 1 + len(PREMISES)
"""Reason code of a start that is not a section state of the viscoelastic model."""


SERVED: dict[str, dict[str, object]] = {
    "rung": {
        "long_name": "rung that served",
        "flag_values": [RIGID, VISCOELASTIC, UNILATERAL],
        "flag_meanings": "RigidWheel ViscoelasticWheel UnilateralWheel",
    },
    "reason": {
        "long_name": "why that rung served",
        "units": "1",
        "description": "0: all premises of the paper's wheel hold; above: the first that breaks, "
        f"of {', '.join(PREMISES)}; below: minus that wheel's outcome.",
    },
}
"""Attributes of the variables `model_selection` in data sets."""


class ModelChoice(AbstractTold):
    """Choice of the model, and its reason. Batched under vmap: every field gains the axis.

    `reason_code` is 0 if the viscoelastic model holds. If a margin is violated, it is 1 + the index
    of the first one in `SELECTION_MARGINS`. It is `REASON_START_NOT_EMBEDDABLE` if a leg other than
    Leg 1 is loaded or off its stopper at the start. If the viscoelastic step does not reach a
    touchdown, it is minus the outcome.

    - `model_code`: VISCOELASTIC_MODEL or UNILATERAL_MODEL;
    - `margins`: of `SELECTION_MARGINS`, negative where violated;
    - `friction`: coefficient of the ground.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> vrw.choose_model(vrw.WheelParams(), x, friction=50.0).margins.shape
        (8,)
    """

    rung: Int[Array, ""]
    reason: Int[Array, ""]
    margins: Float[Array, " n_premises"]
    friction: Scalar

    def rows(self) -> list[Row]:
        """Return the printable rows: model, explanation and margins."""
        reason = np.asarray(self.reason)
        if reason.ndim:
            served = int(np.sum(reason == 0))
            return [
                ("wheels", f"{reason.size} in shape {reason.shape}, {served} served by the paper's")
            ]
        told_margins = zip(PREMISES, np.asarray(self.margins), strict=True)
        margins = [(MARGINS[n].label, MARGINS[n].text(value)) for n, value in told_margins]
        return [("rung", type(self.model).__name__), ("why", self.why), *margins]

    def served(self) -> dict[str, Array]:
        """Return model and reason codes, see `AbstractStep.model_selection`."""
        return {"rung": self.rung, "reason": self.reason}

    @property
    def model(self) -> AbstractWheel:
        """The chosen model itself, for one wheel."""
        if int(self.rung) == VISCOELASTIC:
            return ViscoelasticWheel(friction=float(self.friction))
        return UnilateralWheel(friction=self.friction)

    @property
    def why(self) -> str:
        """Reason of the choice as one sentence, for one wheel."""
        return told_why(int(self.reason))


def told_why(reason: int) -> str:
    """Return a reason code of `ModelChoice` as a sentence."""
    if reason == 0:
        return "The paper's wheel serves: all its premises hold over this step."
    if reason < 0:
        return f"The paper's wheel can't step: {Outcome(-reason).meaning}"
    if reason == OFF_THE_PLANE:
        return "The start is not the paper's: another leg is loaded or off its stopper."
    return f"The paper's premises break: {list(PREMISES.values())[reason - 1]}."


def reason_of(told: Mapping[str, Any], more_friction: Any) -> tuple[Array, Array]:
    """Return `ModelChoice.reason_code` of viscoelastic steps, and their margins on the last axis.

    - `measures`: measures and outcome of these steps;
    - `friction_difference`: friction of the ground minus the friction behind `measures`.
    """
    margins = [told[name] + (more_friction if "friction" in name else 0.0) for name in PREMISES]
    broken = ~(jnp.stack(margins, -1) >= 0.0)
    first = jnp.where(jnp.any(broken, -1), 1 + jnp.argmax(broken, -1), 0)
    outcome = jnp.asarray(told["outcome"], first.dtype)
    return jnp.where(outcome == Outcome.STEPPED, first, -outcome), jnp.stack(margins, -1)


class LadderStep(AbstractGroundStep):
    """One step by the lowest valid model, in the same form for both. Batched under vmap.

    - `choice`: the chosen model, and the reason;
    - `section_state`: just before the next landing; zeros if there was none;
    - `post_impact`: (theta, dtheta) just after the opening landing, rad, rad/s;
    - `durations`: with two feet loaded, with one, with none, s;
    - `step_length`: m;
    - `energy_impacts`: lost in impacts, J;
    - `energy_damping`: lost in the dampers, J;
    - `energy_friction`: lost by sliding between impacts, J;
    - `slip`: path length of sliding feet, m;
    - `outcome`: an Outcome;
    - `solver_steps`: attempted solver steps, of both models.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> step = vrw.step(vrw.WheelParams(), x, model=vrw.LadderWheel(friction=50.0))
        >>> print(f"{step.dls_fraction:.3f}")
        0.532
    """

    choice: ModelChoice
    section_state: FullState
    post_impact: Float[Array, "2"]
    durations: Float[Array, "3"]
    step_length: Scalar
    energy_impacts: Scalar
    energy_damping: Scalar
    energy_friction: Scalar
    slip: Scalar
    outcome: Int[Array, ""]
    solver_steps: Int[Array, ""]

    def served(self) -> dict[str, Array]:
        return self.choice.served()


class LadderWheel(AbstractWheel):
    """The viscoelastic model where it is valid, and the unilateral model with this `friction`
    elsewhere.

    Section states are those of `UnilateralWheel`; three-number states of the paper are accepted.

    - `friction`: coefficient of the ground, `inf` for feet that never slide.

    Examples:
        >>> wheel = vrw.LadderWheel(friction=50.0)
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> step = vrw.step(vrw.WheelParams(), x, model=wheel)
        >>> step.choice.explanation
        "The paper's wheel serves: all its premises hold over this step."
    """

    rung: ClassVar[str] = "ladder"
    parameter_names: ClassVar[tuple[str, ...]] = (*PARAMETER_NAMES, FRICTION)
    tells_contacts: ClassVar[bool] = True

    friction: Scalar = eqx.field(converter=friction_of, default=0.7)

    if TYPE_CHECKING:

        def __init__(self, friction: Number = 0.7) -> None: ...

    @property
    def ground(self) -> UnilateralWheel:
        """The upper model."""
        return UnilateralWheel(friction=self.friction)

    @property
    def upper(self) -> UnilateralWheel:
        return self.ground

    def start(self, params: WheelParams) -> FullState:
        return self.ground.start(params)

    def section_size(self, params: WheelParams) -> int:
        return self.ground.section_size(params)

    def section_numbers(self, params: WheelParams) -> int:
        return self.ground.section_numbers(params)

    def full_section(self, params: WheelParams, x: Array) -> FullState:
        return self.ground.full_section(params, x)

    def choose(
        self, params: WheelParams, x: FullState, options: Options
    ) -> tuple[ModelChoice, StepResult]:
        """Return the chosen model, and the step of the viscoelastic model."""
        paper, ground = ViscoelasticWheel(), self.friction.astype(x.dtype)
        on_plane = _on_the_papers_plane(x, params.n_legs)
        result = paper.step(
            params, jnp.where(on_plane, _of_plane(x, params.n_legs), jnp.nan), options
        )
        reason, margins = reason_of(result.measures(), ground - paper.friction)
        reason = jnp.where(on_plane, reason, OFF_THE_PLANE).astype(jnp.int32)
        rung = jnp.where(reason == 0, VISCOELASTIC, UNILATERAL).astype(jnp.int32)
        return ModelChoice(rung, reason, margins, ground), result

    def advance(self, params: WheelParams, x: FullState, options: Options) -> Advance:
        choice, paper = self.choose(params, x, options)
        serves = choice.rung == VISCOELASTIC
        ground = self.ground.advance(params, jnp.where(serves, jnp.nan, x), options)
        return Advance(
            section_state=jnp.where(serves, _embedded(serves, params, paper), ground.section_state),
            durations=jnp.where(serves, _by_feet(paper), ground.durations),
            outcome=jnp.where(serves, paper.outcome, ground.outcome),
            solver_steps=paper.solver_steps + ground.solver_steps,
            rung=choice.rung,
            reason=choice.reason,
        )

    def step(self, params: WheelParams, x: FullState, options: Options) -> LadderStep:
        choice, paper = self.choose(params, x, options)
        serves = choice.rung == VISCOELASTIC
        ground: UnilateralStep = self.ground.step(params, jnp.where(serves, jnp.nan, x), options)
        either = lambda lower, upper: jnp.where(serves, lower, upper)
        return LadderStep(
            choice=choice,
            section_state=either(_embedded(serves, params, paper), ground.section_state),
            post_impact=either(paper.post_impact, ground.post_impact),
            durations=either(_by_feet(paper), ground.durations),
            step_length=either(paper.step_length, ground.step_length),
            energy_impacts=either(
                paper.energy.landing + paper.energy.stopper, ground.energy_impacts
            ),
            energy_damping=either(paper.energy.damping, ground.energy_damping),
            energy_friction=either(0.0, ground.energy_friction),
            slip=either(0.0, ground.slip),
            outcome=either(paper.outcome, ground.outcome),
            solver_steps=paper.solver_steps + ground.solver_steps,
        )

    def trace(
        self, params: WheelParams, x: FullState, options: Options, n_samples: int
    ) -> UnilateralTrajectory:
        """Return the motion in the form of the upper model: without slip it equals the paper's
        motion.
        """
        choice, _ = self.choose(params, x, options)
        friction = jnp.where(choice.rung == VISCOELASTIC, jnp.inf, self.friction)
        wheel = UnilateralWheel(friction=friction, infinite="paper")
        trace = wheel.trace(params, x, options, n_samples)
        return dataclasses.replace(trace, served=choice.served())


def _of_plane(x: FullState, n: int) -> Float[Array, "3"]:
    """Return (theta-, dtheta-, dL1-) of a full section state."""
    return jnp.stack([x[0], x[1], x[4 + n]])


def _on_the_papers_plane(x: FullState, n: int) -> Bool[Array, ""]:
    """Return whether Leg 1 alone is loaded and at rest, with all other legs on their stoppers."""
    papers = jnp.where(jnp.arange(n) == 0, float(STICK), float(LOCKED + OFF))
    return jnp.all(jnp.round(x[4 + 2 * n :]) == papers)


def _embedded(serves: Array, params: WheelParams, paper: StepResult) -> FullState:
    """Return the full section state of a viscoelastic step.

    Where the viscoelastic model is not used, it is the state of Table 1's start.
    """
    safe = jnp.asarray(PAPER_START, paper.section_state.dtype)
    params, x = replaced_where_bad(serves, params, paper.section_state, safe)
    return embedded(params.symbols(), x)


def _by_feet(paper: StepResult) -> Float[Array, "3"]:
    """Return the durations with two loaded feet, with one and with none, s."""
    both, *single = paper.durations
    return jnp.stack([both, single[0] + single[1], jnp.zeros_like(both)])


def refuse_ladder(model: object, what: str) -> None:
    """Raise `TypeError` for a ladder where a model with smoothly varying gaits is required."""
    if isinstance(model, LadderWheel | str):
        raise TypeError(
            f"the ladder can't be {what}, since its gaits jump where the rung changes: give "
            "vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )

"""The one face of every rung: what a step takes, and what it tells."""

import abc
import functools
import operator
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.numerics import Elementwise, Options
from vrw_jax.results import MARGINS, MEASURES
from vrw_jax.wheel import FRICTION, LARGEST, PARAMETER_NAMES, Outcome, WheelParams, wheel_of
from vrw_jax.wording import AbstractTold, Row, counted, told, traced

SectionState = Float[Array, "3"]
"""(theta-, dtheta-, dL1-) just before touchdown, in the labels of the step that ends: rad, rad/s,
m/s. The length of Leg 1 follows from touchdown itself, Leg 2 is on its stopper."""
RungState = Float[Array, "section ..."]
"""A `SectionState`, or the rung's own longer one; of lanes, which have the last axis, too."""
Measured = Float[Array, "..."]
"""A number that a step tells; of lanes, one for each."""


GroundOfStep = tuple[Array, Array, Array, Array]
"""Slope and friction of a landing, friction of the feet before, and by how much the ground ahead is
steeper; or all that over steps."""


class AbstractMeasured(AbstractTold):
    """Several measures, each field told as one of `results.MEASURES`."""

    named: eqx.AbstractClassVar[Mapping[str, str]]
    """Names there, where they are not the fields' own."""

    def measures(self) -> dict[str, Array]:
        """Its fields by the names of `results.MEASURES`."""
        return {self.named.get(name, name): value for name, value in vars(self).items()}

    def rows(self) -> list[Row]:
        measures = self.measures().items()
        return [(MEASURES[name].label, told(x, MEASURES[name].unit)) for name, x in measures]


class Indicators(AbstractMeasured):
    """The double-limb-support indicators of Section 5.1, of the landing that opens the step.

    - `lambda_I4`: normal impulse of the rear foot in the landing, both feet held, N s;
    - `lambda_2`: normal force of the fore foot just after it, N;
    - `lambda_4`: normal force of the rear foot just after it, N.

    Examples:
        >>> indicators = vrw.limit_cycle(vrw.WheelParams()).indicators
        >>> print(f"{indicators.lambda_4:.2f} N")
        9.47 N
    """

    named: ClassVar = {"lambda_2": "lambda_2_plus", "lambda_4": "lambda_4_plus"}

    lambda_I4: Measured
    lambda_2: Measured
    lambda_4: Measured


class EnergyLoss(AbstractMeasured):
    """Mechanical energy lost in the step, J, each positive when lost.

    - `landing`, `stopper`: in the two collisions;
    - `damping`: in the legs' dampers.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.energy.landing:.1f} J, {step.energy.damping:.1f} J")
        7.4 J, 26.2 J
    """

    named: ClassVar = {name: f"energy_lost_{name}" for name in ("landing", "stopper", "damping")}

    landing: Measured
    stopper: Measured
    damping: Measured


class Margins(AbstractMeasured):
    """Premises of the paper's rung as signed margins over one step: negative means broken.

    The model does not act on them. Forces and lengths are minima over the step, found to the
    integrator's accuracy. What is zero by construction at a phase's start (a foot that leaves the
    ground, Leg 1 that lands on its stopper) counts from its first later minimum on. Friction
    margins are the model's `friction` less the coefficient needed; the rear foot's is taken just
    after landing, since it grows without bound as the foot unloads. A phase that did not happen
    does not count; a step that did not begin has margins zero.

    - `fore_foot_force`: lambda_2, N;
    - `takeoff_acceleration`: of foot 2 normal to the slope at the start of SLS-I, m/s^2: what
      decides on `clearance_sls1`, and smooth at the border to scuffing, where that is not;
    - `clearance_sls1`: height of foot 2 in SLS-I, m;
    - `clearance_sls2`: height of foot 2 in SLS-II, m;
    - `locked_stopper_force`: of legs 3..n on their stoppers, N;
    - `rear_stopper_force`: of Leg 2 on its stopper in SLS-II, N;
    - `contraction`: L0 - L1 after landing, m;
    - `friction_fore`: friction left at the fore foot;
    - `friction_rear`: friction left at the rear foot just after landing;
    - `landing_stopper_impulse`: on legs 3..n at the landing, N s;
    - `hit_stopper_impulse`: on legs 3..n when Leg 2 hits its stopper, N s;
    - `hit_planted_impulse`: normal impulse of the planted foot then, N s;
    - `landing_friction_fore`: friction left at the fore foot in the landing impulse;
    - `landing_friction_rear`: friction left at the rear foot in the landing impulse.

    Examples:
        >>> x = vrw.limit_cycle(vrw.WheelParams()).section_state
        >>> print(f"{vrw.step(vrw.WheelParams(), x).monitors.friction_rear:.2f}")
        -13.22
    """

    named: ClassVar = {}

    fore_foot_force: Measured
    takeoff_acceleration: Measured
    clearance_sls1: Measured
    clearance_sls2: Measured
    locked_stopper_force: Float[Array, "n_locked ..."]
    rear_stopper_force: Measured
    contraction: Measured
    friction_fore: Measured
    friction_rear: Measured
    landing_stopper_impulse: Float[Array, "n_locked ..."]
    hit_stopper_impulse: Float[Array, "n_locked ..."]
    hit_planted_impulse: Measured
    landing_friction_fore: Measured
    landing_friction_rear: Measured


class AbstractStep(AbstractTold):
    """What every rung's step tells alike. Batched under vmap."""

    section_state: eqx.AbstractVar[Array]  # just before the next touchdown
    post_impact: eqx.AbstractVar[Float[Array, "2 ..."]]  # (theta, dtheta), rad, rad/s
    durations: eqx.AbstractVar[Float[Array, "3 ..."]]  # of double support first, s
    step_length: eqx.AbstractVar[Measured]  # m
    outcome: eqx.AbstractVar[Int[Array, "..."]]  # an Outcome
    solver_steps: eqx.AbstractVar[Int[Array, "..."]]  # tried by the integrator

    @property
    def period(self) -> Array:
        """Duration of the step, s."""
        return jnp.sum(self.durations, axis=-1)

    @property
    def dls_fraction(self) -> Array:
        """Share of the step with two loaded feet; 0 for a step without duration."""
        period = self.period
        return self.durations[..., 0] / jnp.where(period > 0.0, period, 1.0)

    @property
    def speed(self) -> Array:
        """Step length over period, m/s; 0 for a step without duration."""
        period = self.period
        return jnp.where(period > 0.0, self.step_length / jnp.where(period > 0.0, period, 1.0), 0.0)

    def measures(self) -> dict[str, Array]:
        """Everything that the step tells, by the names of `results.MEASURES`.

        Batch axes lead, legs come last.
        """
        shared = {
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
        return shared | self.own_measures()

    def rows(self) -> list[Row]:
        """What the step says of itself: measures, then premises and whether they hold."""
        outcome, values = np.asarray(self.outcome), self.measures()
        if outcome.ndim:
            return [("steps", counted(outcome, Outcome))]
        code = Outcome(int(outcome))
        rows = [("outcome", f"{code.name}: {code.meaning}")]
        for name, value in values.items():
            if name == "outcome":
                continue
            measure, least = MEASURES[name], float(np.min(np.asarray(value)))
            verdict = ", holds" if least >= 0.0 else ", broken"
            text = measure.text(least)
            if name in MARGINS:
                rows.append((f"premise: {measure.label}", text + verdict))
            else:
                rows.append((measure.label, text))
        return rows

    def served(self) -> dict[str, Array]:
        """Of a model that chooses: which rung took the step and why, by the names of `SERVED`."""
        return {}

    @abc.abstractmethod
    def own_measures(self) -> dict[str, Array]:
        """Those of `measures` that not every rung tells."""


class AbstractGroundStep(AbstractStep):
    """A step over contacts of any order; `durations` are with two feet loaded, with one, none."""

    energy_impacts: eqx.AbstractVar[Measured]  # lost in impacts, J
    energy_damping: eqx.AbstractVar[Measured]  # lost in the dampers, J
    energy_friction: eqx.AbstractVar[Measured]  # lost by sliding between impacts, J
    slip: eqx.AbstractVar[Measured]  # path of sliding feet, m

    def own_measures(self) -> dict[str, Array]:
        return {
            "energy_lost_damping": self.energy_damping,
            "duration_single": self.durations[..., 1],
            "duration_flight": self.durations[..., 2],
            "slip": self.slip,
            "energy_lost_impacts": self.energy_impacts,
            "energy_lost_friction": self.energy_friction,
        }


class StepResult(AbstractStep):
    """One step from touchdown to touchdown. Batched under vmap: every field gains the axis.

    Fields of a step whose outcome is not STEPPED are finite and describe how far it came; its
    `section_state` is all zeros, which is no section state.

    - `section_state`: just before the next touchdown;
    - `post_impact`: (theta, dtheta) just after the opening landing, rad, rad/s;
    - `durations`: of DLS, SLS-I, SLS-II, s;
    - `step_length`: distance between the feet at the opening landing, m;
    - `indicators`, `monitors`, `energy`: `Indicators`, `Margins` and `EnergyLoss` of the step;
    - `outcome`: an Outcome;
    - `solver_steps`: tried by the integrator;
    - `engine`: that took the step, see `Options`.

    Examples:
        >>> step = vrw.step(vrw.WheelParams(damping=150.0), vrw.paper_start())
        >>> print(f"{step.dls_fraction:.3f} {step.monitors.clearance_sls1:.3f} m")
        0.548 0.060 m
    """

    section_state: Float[Array, "3 ..."]
    post_impact: Float[Array, "2 ..."]
    durations: Float[Array, "3 ..."]
    step_length: Measured
    indicators: Indicators
    monitors: Margins
    energy: EnergyLoss
    outcome: Int[Array, "..."]
    solver_steps: Int[Array, "..."]
    engine: str = eqx.field(static=True, default="")

    def own_measures(self) -> dict[str, Array]:
        return {
            "duration_sls1": self.durations[..., 1],
            "duration_sls2": self.durations[..., 2],
            "dL1_touchdown": self.section_state[..., 2],
            **self.indicators.measures(),
            **self.energy.measures(),
            **self.monitors.measures(),
        }


class Advance(eqx.Module):
    """The lean result of a step: what repeats."""

    section_state: RungState
    durations: Float[Array, "3 ..."]  # of DLS, SLS-I, SLS-II, s
    outcome: Int[Array, "..."]  # an Outcome
    solver_steps: Int[Array, "..."]  # tried by the integrator
    rung: Int[Array, "..."] | None = None  # that took the step, of a model that chooses: see ladder
    reason: Int[Array, "..."] | None = None  # why that one
    engine: str = eqx.field(static=True, default="")  # that took it, see `Options`


class Trajectory(eqx.Module):
    """States of one step at samples of each phase, both ends included, with the forces there.

    And what its `Advance` tells, from the same integration.

    Axes: phase (DLS, SLS-I, SLS-II), sample. A phase that did not happen has duration 0 and repeats
    its start. Coordinates are in the labels of this step; the origin is Leg 1's foot.
    """

    time: Float[Array, "3 n ..."]  # from the landing, s
    state: Float[Array, "3 n 6 ..."]  # theta, L1, L2 and their rates
    forces: Float[Array, "3 n 4 ..."]  # lambda_1 ... lambda_4, N
    energy: Float[Array, "3 n 3 ..."]  # kinetic, gravitational, elastic, J
    section_state: RungState
    durations: Float[Array, "3 ..."]  # s
    outcome: Int[Array, "..."]  # an Outcome


class AbstractWheel(eqx.Module):
    """A rung of the model ladder. Rungs are final; the code above knows this face alone.

    `advance` and `step` compile themselves, once for each structure of their arguments.

    Examples:
        >>> isinstance(vrw.RigidWheel(), vrw.AbstractWheel)
        True
    """

    rung: eqx.AbstractClassVar[str]
    """Name of the rung, by which the rooms above find what is its own."""
    parameter_names: eqx.AbstractClassVar[tuple[str, ...]]
    """What its motion depends on: the wheel's parameters, and where it feels it, friction."""
    tells_contacts: eqx.AbstractClassVar[bool]
    """Whether trajectories tell every leg's contact instead of the paper's phases."""
    lanes: ClassVar[str] = ""
    """What machine code walks in batches: the paper's "phases", "legs", or nothing."""
    legs_yield: ClassVar[bool] = True
    """Whether springs and dampers play a part: what is tuned and scanned."""

    def __repr__(self) -> str:
        if traced(self):
            return eqx.tree_pformat(self)
        number = lambda x: repr(float(x)) if x.ndim == 0 else told(x, "")
        shown = lambda x: number(x) if eqx.is_array(x) else repr(x)
        fields = ", ".join(f"{name}={shown(value)}" for name, value in vars(self).items())
        return f"{type(self).__name__}({fields})"

    @property
    def upper(self) -> "AbstractWheel":
        """What serves wherever a step may start: itself, or a ladder's upper rung."""
        return self

    def values(self, params: WheelParams) -> Float[Array, " n_values"]:
        """Numbers of `parameter_names`, of one wheel on this ground."""
        held = [
            getattr(self if name == FRICTION else params, name) for name in self.parameter_names
        ]
        return jnp.stack([jnp.asarray(value, params.damping.dtype) for value in held])

    def at(
        self, values: Array | tuple[Array, ...], n_legs: int
    ) -> tuple["AbstractWheel", WheelParams]:
        """Rung and wheel of other numbers: the inverse of `values`; works on tracers."""
        n = len(PARAMETER_NAMES)
        model = self
        if FRICTION in self.parameter_names:
            model = eqx.tree_at(lambda ground: ground.friction, self, values[n])
        return model, wheel_of(values[:n], n_legs)

    def moved(
        self, params: WheelParams, name: str, value: Elementwise
    ) -> tuple["AbstractWheel", WheelParams]:
        """Rung and wheel with another value of one of `parameter_names`; works on tracers."""
        if name == FRICTION:
            return eqx.tree_at(lambda ground: ground.friction, self, value), params
        return self, eqx.tree_at(lambda wheel: getattr(wheel, name), params, value)

    @abc.abstractmethod
    def advance(self, params: WheelParams, x: SectionState, options: Options) -> Advance:
        """One step, told as leanly as possible. Differentiable in any mode, to any order."""

    @abc.abstractmethod
    def step(self, params: WheelParams, x: SectionState, options: Options) -> Any:
        """One step with all indicators, monitors and energies. Differentiable in any mode.

        A StepResult, or what the rung has in its place.
        """

    @abc.abstractmethod
    def trace(self, params: WheelParams, x: SectionState, options: Options, n_samples: int) -> Any:
        """The step's motion at `n_samples` times of each phase: a Trajectory, or in its place."""

    @abc.abstractmethod
    def start(self, params: WheelParams) -> SectionState:
        """A section state from which a walk may begin."""

    def over_steps(self, params: WheelParams, n_steps: int) -> GroundOfStep | None:
        """The ground of each of so many steps, if slope or friction are arrays over steps."""
        return None

    def on_ground(
        self, params: WheelParams, ground: GroundOfStep
    ) -> tuple["AbstractWheel", WheelParams]:
        """Rung and wheel on the ground of one step."""
        raise NotImplementedError

    def section_size(self, params: WheelParams) -> int:
        """Length of a section state."""
        return 3

    def section_numbers(self, params: WheelParams) -> int:
        """How many of them, the first ones, move continuously; the others are codes."""
        return self.section_size(params)

    def full_section(self, params: WheelParams, x: Array) -> Array:
        """The rung's section state of a paper's one; others are left as they are."""
        return x


Numbers = Float[Array, "section ..."] | tuple[Array, ...]
"""A section state, or its numbers one by one: then each may be an array of lanes."""


def usable(params: WheelParams, x: Numbers) -> Array:
    """Whether parameters and start are finite, in their domains and rolling forward."""
    theta, dtheta = x[0], x[1]
    upright = (jnp.abs(theta) < 0.5 * jnp.pi) & (jnp.abs(theta - params.leg_angle) < 0.5 * jnp.pi)
    in_reach = functools.reduce(operator.and_, [jnp.abs(value) < LARGEST for value in x])
    return params.in_domain() & in_reach & upright & (dtheta > 0.0)  # False for NaN


def replaced_where_bad(
    good: Array,
    params: WheelParams,
    x: Numbers,
    safe_x: Any,
) -> tuple[WheelParams, Any]:
    """Table 1 and a safe start in place of unusable input, so that no NaN is ever computed."""
    return jax.tree.map(
        lambda value, default: jnp.where(good, value, jnp.asarray(default, value.dtype)),
        (params, x),
        (type(params)(n_legs=params.n_legs), safe_x),
    )

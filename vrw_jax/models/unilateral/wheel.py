"""Unilateral model: one-sided contacts with Coulomb friction, in any order of events."""

import dataclasses
import functools
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.models.base import AbstractWheel, Advance, GroundOfStep
from vrw_jax.models.lane_step import lanes_can
from vrw_jax.models.paper_step import PAPER_START
from vrw_jax.models.unilateral.contacts import Roughness
from vrw_jax.models.unilateral.events import Law
from vrw_jax.models.unilateral.lanes import Lean
from vrw_jax.models.unilateral.ledger import (
    Details,
    Ledger,
    UnilateralStep,
    as_ruled,
    blank,
    event_noted,
    law_of,
    no_details,
    outcome_at,
    passed,
    past,
    section_reached,
    step_told,
    stretch_noted,
)
from vrw_jax.models.unilateral.march import at_singularity
from vrw_jax.models.unilateral.mechanics import place_of_landing
from vrw_jax.models.unilateral.motion import (
    Guards,
    Stance,
    State,
    Tally,
    field,
    flow_of,
    forces,
    guard_sizes,
    guards,
    guards_of,
    least_stopper_force,
    pack,
    unpack,
)
from vrw_jax.models.unilateral.section import (
    FullState,
    embedded,
    made_sound,
    opened,
    section_size,
)
from vrw_jax.models.unilateral.single import (
    Log,
    Sampled,
    moved_by_lanes,
    sampled_by_lanes,
    told_by_lanes,
)
from vrw_jax.numerics import (
    Elementwise,
    Forward,
    Number,
    Options,
    Scalar,
    Watched,
    any_mode,
    integrate_phase,
    sample_phase,
    two_fold,
)
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, Outcome, WheelParams, friction_of
from vrw_jax.wording import chosen, reals, whole

BILATERAL, ONE_SIDED = "bilateral", "one-sided"
"""Effect of stoppers on legs in the air: they hold with any force, or only push."""
LIMIT, PAPER = "limit", "paper"
"""Meaning of infinite friction: the limit of large friction, or the paper's rule (A1)-(A4)."""


class UnilateralTrajectory(eqx.Module):
    """The motion of one step between its events. Axes: phase, sample.

    A phase that did not happen has duration 0. The origin is the position of the opening landing.
    """

    time: Float[Array, "phases n"]  # from the landing, s
    state: Float[Array, "phases n dim"]  # see `motion.unpack_state`
    contact: Int[Array, "phases legs"]  # mode of every foot
    locked: Bool[Array, "phases legs"]  # on the stopper
    tangential: Float[Array, "phases n legs"]  # force on every foot, N
    normal: Float[Array, "phases n legs"]
    duration: Float[Array, " phases"]  # s
    section_state: FullState  # after the step
    step_length: Scalar
    outcome: Int[Array, ""]
    served: dict[str, Array] = eqx.field(default_factory=dict)  # see `AbstractStep`


class _Walked(NamedTuple):
    """State of the event loop between two events of a step."""

    state: State
    stance: Stance
    guard: Int[Array, ""]  # of the last event
    outcome: Int[Array, ""]
    running: Bool[Array, ""]
    ledger: Ledger
    details: Details | None
    log: Log | None


class Uneven(NamedTuple):
    """Uneven ground: quantities of a step besides the ground of its own landing."""

    friction: Scalar  # of the feet that landed before
    tilt: Scalar  # by which the ground ahead is steeper, rad


def _restitution_of(value: Any) -> Array | None:
    """Return Newton's coefficient of restitution; None means 0.

    Raises `ValueError` for a number outside [0, 1].
    """
    if value is None or (isinstance(value, float | int) and value == 0):
        return None
    restitution = reals("restitution", value)
    if not isinstance(restitution, jax.core.Tracer) and not jnp.all(
        (restitution >= 0.0) & (restitution <= 1.0)
    ):
        raise ValueError(f"restitution is {value}, but feet come back at 0 to 1 of their speed.")
    return restitution


class UnilateralWheel(AbstractWheel):
    """Feet push on the ground and slide by Coulomb's law; no leg has a fixed role.

    - `friction`: coefficient of the ground, `inf` for feet that never slide;
    - `max_events`: largest number of events of one step; after a quarter of them (at least 100),
      the rest speed grows with each event;
    - `stoppers`: with "bilateral", a leg in the air that has met its stopper stays on it until its
      foot is loaded; with "one-sided", it leaves as soon as the stopper would have to pull;
    - `restitution`: ratio of a striking foot's speed after to its speed before, as far as energy
      allows; None has the effect of 0 and compiles to a smaller program;
    - `infinite_friction_rule`: meaning of infinite friction: the limit of large friction, or with
      "paper" the rule of the paper, (A1) to (A4), continued to where it stops;
    - `uneven_ground`: what differs between footholds; `vrw.walk` sets it from slopes and friction
      over steps.

    Examples:
        >>> wheel = vrw.UnilateralWheel(friction=0.7)
        >>> step = vrw.step(vrw.WheelParams(damping=300.0), vrw.paper_start(), model=wheel)
        >>> print(f"{step.slip:.2f} m of slip, {vrw.Outcome(int(step.outcome)).name}")
        0.04 m of slip, STEPPED
    """

    rung: ClassVar[str] = "unilateral"
    parameter_names: ClassVar[tuple[str, ...]] = (*PARAMETER_NAMES, FRICTION)
    tells_contacts: ClassVar[bool] = True
    lanes: ClassVar[str] = "legs"

    friction: Scalar = eqx.field(converter=friction_of, default=0.7)
    max_events: int = eqx.field(static=True, converter=partial(whole, "max_events"), default=400)
    stoppers: str = eqx.field(static=True, default=BILATERAL)
    restitution: Scalar | None = eqx.field(converter=_restitution_of, default=None)
    infinite: str = eqx.field(static=True, default=LIMIT)
    uneven: Uneven | None = None

    if TYPE_CHECKING:

        def __init__(
            self,
            friction: Number = 0.7,
            max_events: int = 400,
            stoppers: Literal["bilateral", "one-sided"] = "bilateral",
            restitution: Number | None = None,
            infinite: Literal["limit", "paper"] = "limit",
            uneven: Uneven | None = None,
        ) -> None: ...

    def __check_init__(self) -> None:
        chosen("stoppers", self.stoppers, (BILATERAL, ONE_SIDED))
        chosen("infinite", self.infinite, (LIMIT, PAPER))

    @property
    def one_sided(self) -> bool:
        """Whether stoppers of legs in the air may release them."""
        return self.stoppers == ONE_SIDED

    @property
    def by_paper(self) -> bool:
        """Whether infinite friction means the paper's rule."""
        return self.infinite == PAPER

    def start(self, params: WheelParams) -> FullState:
        """Return a start close to the paper's gait of Table 1."""
        return embedded(params.symbols(), jnp.asarray(PAPER_START, params.damping.dtype))

    def section_size(self, params: WheelParams) -> int:
        return section_size(params.n_legs)

    def section_numbers(self, params: WheelParams) -> int:
        return section_size(params.n_legs) - params.n_legs

    def full_section(self, params: WheelParams, x: Array) -> FullState:
        """Return the full section state of the paper's (theta-, dtheta-, dL1-): Leg 1 planted."""
        return _embedded(params, x) if x.shape == (3,) else x

    def over_steps(self, params: WheelParams, n_steps: int) -> GroundOfStep | None:
        over, given = (n_steps,), (params.slope, self.friction)
        if not any(value.shape == over for value in given):
            return None
        slope, friction = (jnp.broadcast_to(value, over) for value in given)
        ahead = jnp.append(slope[1:], slope[-1:])
        behind = jnp.append(friction[:1], friction[:-1])
        return slope, friction, behind, ahead - slope

    def on_ground(
        self, params: WheelParams, ground: GroundOfStep
    ) -> tuple["UnilateralWheel", WheelParams]:
        slope, friction, behind, tilt = ground
        model = dataclasses.replace(self, friction=friction, uneven=Uneven(behind, tilt))
        return model, eqx.tree_at(lambda wheel: wheel.slope, params, slope)

    def advance(self, params: WheelParams, x: FullState, options: Options) -> Advance:
        told, engine = self._taken(params, x, options, detailed=False)
        section_state, durations, outcome, tried = told
        return Advance(section_state, durations, outcome, tried, engine=engine)

    def step(self, params: WheelParams, x: FullState, options: Options) -> UnilateralStep:
        return self._taken(params, x, options, detailed=True)[0]

    def _taken(
        self, params: WheelParams, x: FullState, options: Options, detailed: bool
    ) -> tuple[Any, str]:
        """Return the outputs of a step, and the engine that took it."""
        (leaves, structure), engine = self._leaves(params, x, options), self._engine(options)
        return eqx.combine(*_compiled(structure, detailed, engine)(*leaves)), engine

    def _leaves(self, params: WheelParams, x: FullState, options: Options) -> tuple[list, Any]:
        """Return the leaves and the tree structure of (wheel, params, x, options)."""
        # Not by `replace`: friction is already validated and may be traced.
        model = eqx.tree_at(lambda wheel: wheel.friction, self, self.friction.astype(x.dtype))
        return jax.tree.flatten((model, params, x, options))

    def _engine(self, options: Options) -> str:
        """Return the name of the engine for these options."""
        return "lanes" if self._like_lanes(options) and lanes_can(options) else "diffrax"

    def _like_lanes(self, options: Options) -> bool:
        """Return whether the batch kernel supports this ground.

        Raises `ValueError` if the options require that engine and it does not.
        """
        plain = self.restitution is None and self.uneven is None
        if options.engine == "lanes" and not plain:
            raise ValueError(
                "engine is 'lanes', but lanes know neither feet that come back nor ground that "
                "varies from step to step: take engine='auto' or 'diffrax'."
            )
        return plain

    def trace(
        self, params: WheelParams, x: FullState, options: Options, n_samples: int
    ) -> UnilateralTrajectory:
        if self._engine(options) == "lanes":
            leaves, structure = self._leaves(params, x, options)
            found = sampled_by_lanes(structure, n_samples)(*leaves)
        else:
            found = self._sampled_by_diffrax(params, x, options, n_samples)
        log, ends = found.log, found.ends
        begins = jnp.concatenate([jnp.zeros((1,)), jnp.cumsum(log.duration)[:-1]])
        return UnilateralTrajectory(
            time=begins[:, None] + jnp.linspace(0.0, 1.0, n_samples) * log.duration[:, None],
            state=found.state,
            contact=log.contact,
            locked=log.locked,
            tangential=found.tangential,
            normal=found.normal,
            duration=log.duration,
            section_state=ends.section_state,
            step_length=ends.step_length,
            outcome=found.outcome,
        )

    def _sampled_by_diffrax(
        self, params: WheelParams, x: FullState, options: Options, n_samples: int
    ) -> Sampled:
        """Return the sampled step, integrated by diffrax."""
        walked = _walk(self, params, x, options, detailed=False, logged=True)
        log, outcome = walked.log, walked.outcome
        assert log is not None
        tilt = None if self.uneven is None else self.uneven.tilt
        s, friction = params.symbols(), _rough(self, self.friction)

        def phase(log: Log) -> tuple:
            none = jnp.zeros((s.n,), bool)
            flow = flow_of(s, friction, False, Stance(log.contact, log.locked, none, none, none))
            given = partial(field, flow), log.state, log.duration, n_samples, options

            def feet(y: State) -> tuple:
                found = forces(flow, unpack(y)[0]).answer
                return flow.slots.spread(found.tangential), flow.slots.spread(found.normal)

            states = sample_phase(*given)
            return states, *jax.vmap(feet)(states)

        section_state, durations, *_ = _lean(walked, tilt)
        landing = place_of_landing(s.n, unpack(walked.state)[0])
        landed = jnp.where(outcome == Outcome.STEPPED, landing, 0.0)
        ends = Lean(section_state, durations, landed)
        return Sampled(log, ends, outcome, *lax.map(phase, log))


def _rough(wheel: UnilateralWheel, friction: Elementwise) -> Roughness:
    """Return the friction of all feet, or that of the foot that landed last and of the others."""
    friction = as_ruled(friction, wheel.by_paper)
    if wheel.uneven is None:
        return friction
    return friction, as_ruled(wheel.uneven.friction, wheel.by_paper)


def _walk(
    wheel: UnilateralWheel,
    params: WheelParams,
    x: FullState,
    options: Options,
    detailed: bool,
    logged: bool = False,
) -> _Walked:
    """Return the event loop's state at the end of a step, integrated by diffrax."""
    even = wheel.uneven is None
    good, params, friction, x = made_sound(params, wheel.friction, x, even)
    s, n = params.symbols(), params.n_legs
    tilt = None if wheel.uneven is None else wheel.uneven.tilt
    given = s, _rough(wheel, friction), options, wheel.one_sided
    law = law_of(*given, True, wheel.restitution, tilt)
    place = guards_of(n, wheel.one_sided)
    motion, stance = opened(s, x)
    zero = jnp.zeros_like(motion.theta)
    state = pack(motion, Tally(zero, zero, zero, zero))
    rows = lambda leaf: jnp.broadcast_to(leaf, (wheel.max_events, *leaf.shape))
    first = Log(state, jnp.zeros((n,), jnp.int32), jnp.zeros((n,), bool), jnp.zeros_like(x[0]))
    begin = _Walked(
        state=state,
        stance=stance,
        guard=jnp.int32(place.foot),
        outcome=jnp.where(good, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        running=good,
        ledger=blank(x[0]),
        details=no_details(x.dtype) if detailed else None,
        log=jax.tree.map(rows, first) if logged else None,
    )
    go_on = partial(_go_on, law, place, wheel.max_events, options)
    return lax.while_loop(lambda now: two_fold(now.running, now.ledger.events), go_on, begin)


def _go_on(law: Law, place: Guards, max_events: int, options: Options, now: _Walked) -> _Walked:
    """Return the state at the next event."""
    motion, tally = unpack(now.state)
    at = now.guard, now.ledger.events, max_events
    change, event, outcome = past(law, place, motion, now.stance, *at)
    flow = flow_of(law.s, law.friction, law.one_sided, change.stance, tilt=law.tilt)
    sound = outcome == Outcome.STEPPED
    start = pack(change.motion, tally._replace(clock=jnp.zeros_like(tally.clock)))
    start = jnp.where(sound, start, now.state)
    guarded = Watched(partial(guards, flow), place.total, sizes=guard_sizes(flow))
    end = integrate_phase(partial(field, flow), guarded, start, sound, options)

    ledger = now.ledger._replace(events=now.ledger.events + 1)
    ledger = passed(ledger, change.stance, end.duration, end.solver_steps)
    at_ends = forces(flow, change.motion), forces(flow, unpack(end.state)[0])
    before, after = (lax.stop_gradient(at.answer.regular) for at in at_ends)
    # Forces change sign at the singularity without passing through zero.
    drawn = at_singularity(before, after, options)
    lost = jnp.where(end.timed_out, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_GAVE_UP)
    lost = jnp.where(sound, jnp.where(drawn, Outcome.FRICTION_PARADOX, lost), outcome)
    found = sound & (end.guard >= 0) & ~drawn
    lands = found & (end.guard == place.foremost)
    outcome = outcome_at(ledger, place, found, end.guard, lands, lost, max_events)
    details, log = now.details, now.log
    if details is not None:
        details = event_noted(details, now.ledger.events == 0, change, event)
        force = [least_stopper_force(flow, at) for at in at_ends]
        details = stretch_noted(details, flow.contact, end.duration, jnp.minimum(*force))
    if log is not None:
        row = Log(start, change.stance.contact, change.stance.locked, end.duration)
        log = jax.tree.map(lambda old, new: old.at[now.ledger.events].set(new), log, row)
    return _Walked(
        state=end.state,
        stance=change.stance,
        guard=end.guard,
        outcome=outcome.astype(jnp.int32),
        running=(outcome == Outcome.STEPPED) & ~lands,
        ledger=ledger,
        details=details,
        log=log,
    )


_embedded = jax.jit(lambda params, x: embedded(params.symbols(), x))


@functools.cache
def _compiled(structure: Any, detailed: bool, engine: str) -> Forward:
    """Return the step over the leaves of (wheel, params, x, options), differentiable in any
    mode.
    """

    def walk(tighten: bool, *leaves: Array) -> tuple:
        wheel, params, x, options = jax.tree.unflatten(structure, leaves)
        options = options.for_derivatives() if tighten else options
        walked = _walk(wheel, params, x, options, detailed)
        tilt = None if wheel.uneven is None else wheel.uneven.tilt
        told = _full(walked, engine, tilt) if detailed else _lean(walked, tilt)
        return eqx.partition(told, eqx.is_inexact_array)

    values, tighter = partial(walk, False), partial(walk, True)
    if engine == "diffrax":
        return any_mode(values, tighter)
    given = structure, detailed
    return any_mode(told_by_lanes(*given), tighter, partial(moved_by_lanes, *given))


def _lean(walked: _Walked, tilt: Elementwise | None) -> tuple:
    """Return the minimal result: section state, durations, outcome, solver steps."""
    ledger = walked.ledger
    stands = unpack(walked.state)[0], walked.stance
    section = section_reached(*stands, walked.outcome, tilt)
    return section, ledger.durations, walked.outcome, ledger.tried


def _full(walked: _Walked, engine: str, tilt: Elementwise | None) -> UnilateralStep:
    """Return the full result."""
    motion, tally = unpack(walked.state)
    assert walked.details is not None
    told = walked.ledger, walked.details, walked.outcome
    return step_told(motion, walked.stance, tally, *told, engine, tilt)

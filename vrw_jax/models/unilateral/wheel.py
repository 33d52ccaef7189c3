"""The wheel on real ground: one-sided contacts with Coulomb friction, any order of events."""

import functools
import math
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.models.base import (
    AbstractGroundStep,
    AbstractWheel,
    Advance,
    replaced_where_bad,
    usable,
)
from vrw_jax.models.paper_step import PAPER_START
from vrw_jax.models.unilateral.contacts import OFF
from vrw_jax.models.unilateral.events import Change, Event, Law, event_of, resolve, settled
from vrw_jax.models.unilateral.motion import (
    Flow,
    Guards,
    Stance,
    State,
    airborne_stopper_force,
    field,
    flow_of,
    forces,
    guards,
    guards_of,
    pack,
    unpack,
)
from vrw_jax.models.unilateral.section import FullState, closed, embedded, opened, section_size
from vrw_jax.numerics import (
    Forward,
    Options,
    PhaseEnd,
    Scalar,
    Watched,
    any_mode,
    as_float_array,
    integrate_phase,
    sample_phase,
)
from vrw_jax.wheel import FRICTION, PARAMETER_NAMES, Outcome, Symbols, WheelParams

BILATERAL, ONE_SIDED = "bilateral", "one-sided"
"""What stoppers do to legs in the air: hold whatever it takes, or push alone."""


class UnilateralMargins(eqx.Module):
    """How far the motion stayed from what bilateral stoppers do not ask, over one step.

    Negative where a one-sided stopper would have let a leg in the air go.
    """

    stopper_force: Scalar  # least stopper force of a locked leg in the air, N
    stopper_impulse: Scalar  # least stopper impulse of a locked leg in the air, N s


class UnilateralStep(AbstractGroundStep):
    """One step, from the landing of the foremost foot to the next. Batched under vmap.

    Fields of a step whose outcome is not STEPPED are finite and describe how far it came; its
    `section_state` is all zeros, which is no section state.
    """

    section_state: FullState  # just before the next landing
    post_impact: Float[Array, "2"]  # (theta, dtheta) just after the opening landing, rad, rad/s
    durations: Float[Array, "3"]  # with two feet loaded, with one, with none, s
    mode_durations: Float[Array, "4 4"]  # by mode of the first and second loaded foot, s
    step_length: Scalar  # between the places of the two landings, m
    landing_normal: Float[Array, "2"]  # normal impulses of the opening landing, N s
    landing_tangential: Float[Array, "2"]  # tangential ones; fore and rear foot
    energy_impacts: Scalar  # lost in impacts, J
    energy_damping: Scalar  # lost in the dampers, J
    energy_friction: Scalar  # lost by sliding between impacts, J
    slip: Scalar  # path of sliding feet, m
    monitors: UnilateralMargins
    events: Int[Array, ""]  # contacts and stoppers that changed
    impacts: Int[Array, ""]  # events in which velocities jumped
    fewest_solutions: Int[Array, ""]  # admissible combinations at an event: 1 where well posed
    most_solutions: Int[Array, ""]
    outcome: Int[Array, ""]  # an Outcome
    solver_steps: Int[Array, ""]  # tried by the integrator


class UnilateralTrajectory(eqx.Module):
    """The motion of one step between its events. Axes: phase, sample.

    A phase that did not happen has duration 0. The origin is the place of the opening landing.
    """

    time: Float[Array, "phases n"]  # from the landing, s
    state: Float[Array, "phases n dim"]  # see unilateral_motion.unpack
    contact: Int[Array, "phases legs"]  # mode of every foot
    locked: Bool[Array, "phases legs"]  # on the stopper
    tangential: Float[Array, "phases n legs"]  # force on every foot, N
    normal: Float[Array, "phases n legs"]
    duration: Float[Array, " phases"]  # s


SEEN = 4e5
"""Roundings of a leg's length in the least dip that is followed, 1e-10 m in float64: a dip takes
the time 4 depth / speed, and its end is known to rounding / speed, here a millionth of that."""


def least_dip(s: Symbols, options: Options, one_sided: bool) -> Scalar:
    """Least excursion, from the ground or a one-sided stopper, that follows an impact, m.

    Legs leave such stoppers so often that it grows with the tolerance; feet alone do not, and the
    shares of a step in double and single support would show it.
    """
    resolved = SEEN * jnp.finfo(s.L0.dtype).eps * s.L0
    return jnp.maximum(options.atol, resolved) if one_sided else resolved


class _Log(NamedTuple):
    """Starts of all phases, kept where a trajectory is wanted."""

    state: Float[Array, "phases dim"]
    contact: Int[Array, "phases legs"]
    locked: Array
    duration: Float[Array, " phases"]


class _Sums(NamedTuple):
    """What a step adds up and keeps."""

    durations: Float[Array, "3"]
    mode_durations: Float[Array, "4 4"]
    post_impact: Float[Array, "2"]
    landing_normal: Float[Array, "2"]
    landing_tangential: Float[Array, "2"]
    energy_impacts: Scalar
    stopper_force: Scalar
    stopper_impulse: Scalar
    impacts: Int[Array, ""]
    fewest: Int[Array, ""]
    most: Int[Array, ""]
    tried: Int[Array, ""]


class _Walked(NamedTuple):
    """Where a step stands between two of its events."""

    state: State
    stance: Stance
    guard: Int[Array, ""]  # that ended the last phase
    events: Int[Array, ""]
    outcome: Int[Array, ""]
    running: Array
    sums: _Sums
    log: _Log | None


class UnilateralWheel(AbstractWheel):
    """Feet on the ground push and slide by Coulomb's law; nothing has a fixed role.

    `friction` is the coefficient of the ground, `math.inf` for feet that never slide. A leg in the
    air that has met its stopper stays on it until its foot is loaded; with `stoppers="one-sided"`
    it leaves as soon as the stopper would have to pull. `max_events` bounds the events of one step.
    """

    rung: ClassVar[str] = "unilateral"
    parameter_names: ClassVar[tuple[str, ...]] = (*PARAMETER_NAMES, FRICTION)
    tells_contacts: ClassVar[bool] = True

    friction: Scalar = eqx.field(converter=as_float_array, default=0.7)
    max_events: int = eqx.field(static=True, default=100)
    stoppers: str = eqx.field(static=True, default=BILATERAL)

    def __check_init__(self) -> None:
        if self.stoppers not in (BILATERAL, ONE_SIDED):
            raise ValueError(
                f"stoppers is {self.stoppers!r}, but it must be {BILATERAL!r} or {ONE_SIDED!r}."
            )

    @property
    def one_sided(self) -> bool:
        """Whether stoppers of legs in the air may let go."""
        return self.stoppers == ONE_SIDED

    def start(self, params: WheelParams) -> FullState:
        """Close to the paper's gait of Table 1."""
        return embedded(params.symbols(), jnp.asarray(PAPER_START, params.damping.dtype))

    def section_size(self, params: WheelParams) -> int:
        """4 + 3 n, see `FullState`."""
        return section_size(params.n_legs)

    def section_numbers(self, params: WheelParams) -> int:
        """All but the legs' codes."""
        return section_size(params.n_legs) - params.n_legs

    def full_section(self, params: WheelParams, x: Array) -> FullState:
        """The full section state of the paper's (theta-, dtheta-, dL1-): Leg 1 planted."""
        return embedded(params.symbols(), x) if x.shape == (3,) else x

    def advance(self, params: WheelParams, x: FullState, options: Options) -> Advance:
        leaves, structure = jax.tree.flatten((self, params, x, options))
        return eqx.combine(*_compiled(structure, False)(*leaves))

    def step(self, params: WheelParams, x: FullState, options: Options) -> UnilateralStep:
        leaves, structure = jax.tree.flatten((self, params, x, options))
        return eqx.combine(*_compiled(structure, True)(*leaves))

    def trace(
        self, params: WheelParams, x: FullState, options: Options, n_samples: int
    ) -> UnilateralTrajectory:
        walked = _walk(self, params, x, options, monitored=False, logged=True)
        log = walked.log
        assert log is not None
        begins = jnp.concatenate([jnp.zeros((1,)), jnp.cumsum(log.duration)[:-1]])
        s = params.symbols()

        def phase(inputs: tuple) -> tuple:
            state, contact, locked, duration, begin = inputs
            none = jnp.zeros((s.n,), bool)
            flow = flow_of(s, self.friction, False, Stance(contact, locked, none, none, none))
            states = sample_phase(partial(field, flow), state, duration, n_samples, options)

            def feet(y: State) -> tuple:
                found = forces(flow, unpack(y)[0]).answer
                return flow.slots.spread(found.tangential), flow.slots.spread(found.normal)

            tangential, normal = jax.vmap(feet)(states)
            return begin + jnp.linspace(0.0, 1.0, n_samples) * duration, states, tangential, normal

        time, states, tangential, normal = lax.map(phase, (*log, begins))
        return UnilateralTrajectory(
            time, states, log.contact, log.locked, tangential, normal, log.duration
        )


def _walk(
    wheel: UnilateralWheel,
    params: WheelParams,
    x: FullState,
    options: Options,
    monitored: bool,
    logged: bool = False,
) -> _Walked:
    """Follow one step from event to event."""
    n = params.n_legs
    safe_x = embedded(WheelParams(n_legs=n).symbols(), jnp.asarray(PAPER_START, x.dtype))
    good = usable(params, x)
    params, x = replaced_where_bad(good, params, x, safe_x)
    s, friction = params.symbols(), wheel.friction.astype(x.dtype)
    good = good & (friction >= 0.0)
    friction = jnp.where(good, friction, 1.0)
    one_sided = wheel.one_sided
    place = guards_of(n, one_sided)
    law, unseen = Law(one_sided, counted=True), least_dip(s, options, one_sided)
    state, stance = opened(s, x)

    def go_on(now: _Walked) -> _Walked:
        motion, tally = unpack(now.state)
        # The integrator lets feet drift by its error; one that lifts would land again at once.
        motion = settled(s, motion, now.stance.contact, now.stance.locked)
        event = event_of(place, n, now.guard)
        change = resolve(s, friction, motion, now.stance, event, law, unseen)
        tally_now = tally._replace(clock=jnp.zeros_like(tally.clock))
        start = pack(change.motion, tally_now)
        flow = flow_of(s, friction, one_sided, change.stance)
        outcome = jnp.where(change.solutions > 0, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT)
        outcome = jnp.where(change.third_foot, Outcome.THREE_FEET_LOADED, outcome)
        sound = outcome == Outcome.STEPPED
        start = jnp.where(sound, start, now.state)
        end = integrate_phase(
            partial(field, flow), Watched(partial(guards, flow), place.total), start, sound, options
        )
        watched = guards(flow, end.state)[jnp.maximum(end.guard, 0)] != 1.0
        outcome = jnp.where(sound, _outcome(place, end, watched), outcome)
        ended = outcome != Outcome.STEPPED
        done = sound & (end.guard == place.foot + n - 1)
        events = now.events + 1
        chained = (events >= wheel.max_events) & ~done & ~ended
        outcome = jnp.where(chained, Outcome.TOO_MANY_EVENTS, outcome)
        log = now.log
        if log is not None:
            row = (start, change.stance.contact, change.stance.locked, end.duration)
            log = _Log(*(old.at[now.events].set(new) for old, new in zip(log, row, strict=True)))
        return _Walked(
            state=end.state,
            stance=change.stance,
            guard=end.guard,
            events=events,
            outcome=outcome.astype(jnp.int32),
            running=~(done | ended | chained),
            sums=_added(now, flow, change, event, end, monitored),
            log=log,
        )

    zero, none = jnp.zeros_like(x[0]), jnp.zeros((), jnp.int32)
    two = jnp.zeros((2,), x.dtype)
    big = jnp.int32(jnp.iinfo(jnp.int32).max)
    log = None
    if logged:
        shape = (wheel.max_events,)
        log = _Log(
            jnp.broadcast_to(state, (*shape, *state.shape)),
            jnp.zeros((*shape, n), jnp.int32),
            jnp.zeros((*shape, n), bool),
            jnp.zeros(shape, x.dtype),
        )
    sums = _Sums(
        jnp.zeros((3,), x.dtype),
        jnp.zeros((4, 4), x.dtype),
        two,
        two,
        two,
        zero,
        zero + jnp.inf,
        zero + jnp.inf,
        none,
        big,
        none,
        none,
    )
    begin = _Walked(
        state,
        stance,
        jnp.int32(place.foot),
        none,
        jnp.where(good, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        good,
        sums,
        log,
    )
    return lax.while_loop(lambda now: now.running, go_on, begin)


def _outcome(place: Guards, end: PhaseEnd, watched: Array) -> Int[Array, ""]:
    """STEPPED where the motion may go on with an event.

    At a Painlevé singularity forces change sign without passing zero: no guard is found there.
    """
    located = (end.guard >= 0) & watched
    code = jnp.where(located, Outcome.STEPPED, Outcome.SOLVER_GAVE_UP)
    code = jnp.where(end.timed_out, Outcome.NO_TOUCHDOWN_IN_TIME, code)
    code = jnp.where(end.guard == place.rate, Outcome.FELL_BACK, code)
    return jnp.where(end.guard == place.length, Outcome.COLLAPSED, code)


def _added(
    now: _Walked, flow: Flow, change: Change, event: Event, end: PhaseEnd, monitored: bool
) -> _Sums:
    """The sums after one more event and the phase that followed it."""
    sums, dtype = now.sums, end.duration.dtype
    loaded = jnp.sum(flow.contact != OFF)
    one_hot = lambda index, size: (jnp.arange(size) == index).astype(dtype)
    modes = one_hot(flow.contact[0], 4)[:, None] * one_hot(flow.contact[1], 4)[None, :]
    first = now.events == 0
    motion = change.motion
    force, impulse = sums.stopper_force, sums.stopper_impulse
    if monitored:
        for y in (pack(motion, unpack(now.state)[1]), end.state):
            at = unpack(y)[0]
            found = airborne_stopper_force(flow, forces(flow, at))
            force = jnp.minimum(force, jnp.min(jnp.where(flow.airborne, found, jnp.inf)))
        impulse = jnp.minimum(impulse, change.stopper_impulse)
    return _Sums(
        durations=sums.durations + one_hot(2 - loaded, 3) * end.duration,
        mode_durations=sums.mode_durations + modes * end.duration,
        post_impact=jnp.where(first, jnp.stack([motion.theta, motion.dtheta]), sums.post_impact),
        landing_normal=jnp.where(first, jnp.stack(change.normal_impulse), sums.landing_normal),
        landing_tangential=jnp.where(
            first, jnp.stack(change.tangential_impulse), sums.landing_tangential
        ),
        energy_impacts=sums.energy_impacts + change.energy_lost,
        stopper_force=force,
        stopper_impulse=impulse,
        impacts=sums.impacts + event.impact,
        fewest=jnp.minimum(sums.fewest, change.solutions),
        most=jnp.maximum(sums.most, change.most_solutions),
        tried=sums.tried + end.solver_steps,
    )


@functools.cache
def _compiled(structure: Any, full: bool) -> Forward:
    """A step over the leaves of (wheel, params, x, options), differentiable in any mode."""

    def walk(tighten: bool, *leaves: Array) -> tuple:
        wheel, params, x, options = jax.tree.unflatten(structure, leaves)
        options = options.for_derivatives() if tighten else options
        walked = _walk(wheel, params, x, options, monitored=full)
        result = _result(walked, params.n_legs) if full else _lean(walked)
        return eqx.partition(result, eqx.is_inexact_array)

    return any_mode(partial(walk, False), partial(walk, True))


def _section_state(walked: _Walked) -> FullState:
    motion, _ = unpack(walked.state)
    x = closed(motion, walked.stance)
    return jnp.where(walked.outcome == Outcome.STEPPED, x, jnp.zeros_like(x))


def _lean(walked: _Walked) -> Advance:
    return Advance(_section_state(walked), walked.sums.durations, walked.outcome, walked.sums.tried)


def _result(walked: _Walked, n: int) -> UnilateralStep:
    sums = walked.sums
    motion, tally = unpack(walked.state)
    began = walked.events > 0
    stepped = walked.outcome == Outcome.STEPPED
    theta = motion.theta
    landing = motion.x - motion.L[n - 1] * jnp.sin(theta + (n - 1) * 2.0 * math.pi / n)
    finite = lambda value: jnp.where(jnp.isfinite(value), value, 0.0)
    return UnilateralStep(
        section_state=_section_state(walked),
        post_impact=sums.post_impact,
        durations=sums.durations,
        mode_durations=sums.mode_durations,
        step_length=jnp.where(stepped, landing, 0.0),
        landing_normal=sums.landing_normal,
        landing_tangential=sums.landing_tangential,
        energy_impacts=sums.energy_impacts,
        energy_damping=tally.damping,
        energy_friction=tally.friction,
        slip=tally.slip,
        monitors=UnilateralMargins(finite(sums.stopper_force), finite(sums.stopper_impulse)),
        events=walked.events,
        impacts=sums.impacts,
        fewest_solutions=jnp.where(began, sums.fewest, 0),
        most_solutions=sums.most,
        outcome=walked.outcome,
        solver_steps=sums.tried,
    )

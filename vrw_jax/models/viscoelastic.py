"""The paper's wheel: landing, double support, single support I, stopper, single support II."""

import functools
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.models.base import (
    AbstractWheel,
    Advance,
    EnergyLoss,
    Indicators,
    Margins,
    SectionState,
    StepResult,
    Trajectory,
    replaced_where_bad,
    usable,
)
from vrw_jax.numerics import (
    Elementwise,
    Field,
    Forward,
    Options,
    PhaseEnd,
    Scalar,
    State,
    Watch,
    Watched,
    any_mode,
    integrate_phase,
    sample_phase,
)
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    double_support_motion,
    dynamics,
    landing_foot_height,
    rear_foot_height,
    transitions,
)

PAPER_START = (0.1, 1.6, -0.1)
"""A start near the gait of Table 1, inside its basin: rad, rad/s, m/s."""


class Phase(NamedTuple):
    """A phase as data: coordinates, flow, what to watch, and what each guard means."""

    motion: Callable[[State], Motion]
    acceleration: Callable[[Motion], dynamics.Acceleration]
    field: Field
    watched: Watched
    guard_outcomes: tuple[Outcome, ...]  # STEPPED: the paper's own end of the phase

    def outcome(self, end: PhaseEnd) -> Int[Array, ""]:
        """STEPPED where the phase ended as in the paper."""
        code = jnp.asarray(self.guard_outcomes, jnp.int32)[jnp.maximum(end.guard, 0)]
        code = jnp.where(end.timed_out, jnp.int32(Outcome.NO_TOUCHDOWN_IN_TIME), code)
        stopped = (end.guard >= 0) | end.timed_out
        return jnp.where(stopped, code, jnp.int32(Outcome.SOLVER_GAVE_UP))


FALLS = (Outcome.FELL_BACK, Outcome.COLLAPSED, Outcome.LEG_1_LIFTED_OFF)
"""Ways to leave the paper's sequence that every phase shares, in the order of `_falls`."""


class PhaseBuilder(NamedTuple):
    """What all phases share: which guards and monitors are watched."""

    s: Symbols
    stop_at_lift_off: bool
    monitored: bool

    @property
    def locked(self) -> range:
        """The legs that stay on their stoppers."""
        return range(3, self.s.n + 1)

    def falls(self, m: Motion, fore: dynamics.FootForce) -> list[Array]:
        """Guards of FALLS."""
        values = [m.dtheta, jnp.minimum(m.L1, m.L2) - self.s.a, fore.normal]
        return values if self.stop_at_lift_off else values[:-1]

    def outcomes(self, *own: Outcome) -> tuple[Outcome, ...]:
        """What the guards mean: the phase's own first."""
        return own + (FALLS if self.stop_at_lift_off else FALLS[:-1])

    def premises(
        self, m: Motion, a: dynamics.Acceleration, fore: dynamics.FootForce
    ) -> list[Array]:
        """Monitors of every phase: fore force, contraction, minus friction, locked stoppers."""
        if not self.monitored:
            return []
        stoppers = dynamics.stopper_force(self.s, m, a, self.locked)
        return [fore.normal, self.s.L0 - m.L1, -dynamics.friction_needed(fore), *stoppers]

    def watch(
        self, values: Watch, n_own: int, contraction_at_start: bool, own: tuple[bool, ...] = ()
    ) -> Watched:
        """Guards and, if monitored, the premises and the phase's own monitors."""
        n_guards = len(self.outcomes()) + n_own
        if not self.monitored:
            return Watched(values, n_guards)
        counts = (True, contraction_at_start, True, *(True for _ in self.locked), *own)
        return Watched(values, n_guards, counts)


def double_support(build: PhaseBuilder, distance: Elementwise) -> Phase:
    """DLS over y = (theta, dtheta); ends when lambda_4 falls through zero. Section 3.3.1."""
    s = build.s

    def motion(y: State) -> Motion:
        return double_support_motion(s, distance, y[0], y[1])

    def acceleration(m: Motion) -> dynamics.Acceleration:
        return dynamics.double_support_acceleration(s, distance, m)

    def values(y: State) -> Array:
        m = motion(y)
        a = acceleration(m)
        rear = dynamics.rear_foot_force(s, m, a)
        fore = dynamics.fore_foot_force(s, m, a, rear)
        own = [rear.normal, s.L0 - m.L2, landing_foot_height(s, m)]
        return jnp.stack(own + build.falls(m, fore) + build.premises(m, a, fore))

    return Phase(
        motion,
        acceleration,
        lambda y: jnp.stack([y[1], acceleration(motion(y)).ddtheta]),
        build.watch(values, n_own=3, contraction_at_start=False),
        build.outcomes(
            Outcome.STEPPED, Outcome.STOPPER_IN_DOUBLE_SUPPORT, Outcome.TOUCHDOWN_BEFORE_STOPPER
        ),
    )


def single_support_1(build: PhaseBuilder) -> Phase:
    """SLS-I over y = (theta, L1, L2 and rates); ends when Leg 2 is at L0. Section 3.3.2."""
    s = build.s

    def motion(y: State) -> Motion:
        return Motion.of(*y)

    def acceleration(m: Motion) -> dynamics.Acceleration:
        return dynamics.single_support_1_acceleration(s, m)

    def values(y: State) -> Array:
        m = motion(y)
        a = acceleration(m)
        fore = dynamics.fore_foot_force(s, m, a)
        own = [s.L0 - m.L2, landing_foot_height(s, m)]
        premises = build.premises(m, a, fore)
        clearance = [rear_foot_height(s, m)] if build.monitored else []
        return jnp.stack(own + build.falls(m, fore) + premises + clearance)

    return Phase(
        motion,
        acceleration,
        lambda y: jnp.stack([*y[3:], *acceleration(motion(y))]),
        build.watch(values, n_own=2, contraction_at_start=False, own=(False,)),
        build.outcomes(Outcome.STEPPED, Outcome.TOUCHDOWN_BEFORE_STOPPER),
    )


def single_support_2(build: PhaseBuilder) -> Phase:
    """SLS-II over y = (theta, L1 and rates); ends at touchdown. Section 3.3.3."""
    s = build.s

    def motion(y: State) -> Motion:
        return Motion.of(y[0], y[1], s.L0 + 0.0 * y[1], y[2], y[3], 0.0 * y[3])

    def acceleration(m: Motion) -> dynamics.Acceleration:
        return dynamics.single_support_2_acceleration(s, m)

    def values(y: State) -> Array:
        m = motion(y)
        a = acceleration(m)
        fore = dynamics.fore_foot_force(s, m, a)
        premises = build.premises(m, a, fore)
        if build.monitored:
            rear_stopper = dynamics.stopper_force(s, m, a, range(2, 3))
            premises = [*premises, rear_foot_height(s, m), *rear_stopper]
        return jnp.stack([landing_foot_height(s, m), *build.falls(m, fore), *premises])

    def field(y: State) -> State:
        a = acceleration(motion(y))
        return jnp.stack([y[2], y[3], a.ddtheta, a.ddL1])

    return Phase(
        motion,
        acceleration,
        field,
        build.watch(values, n_own=1, contraction_at_start=True, own=(True, True)),
        build.outcomes(Outcome.STEPPED),
    )


class Walked(NamedTuple):
    """Everything a step went through; results are read off it."""

    s: Symbols
    landing: transitions.Landing
    phases: tuple[Phase, Phase, Phase]
    ends: tuple[PhaseEnd, PhaseEnd, PhaseEnd]
    happened: tuple[Bool[Array, ""], Bool[Array, ""], Bool[Array, ""]]
    hit: transitions.StopperHit
    outcome: Int[Array, ""]
    starts: tuple[State, ...] = ()  # where a trajectory is wanted


def phases_of(build: PhaseBuilder, distance: Elementwise) -> tuple[Phase, Phase, Phase]:
    """The phases of a step that begins with the feet that far apart."""
    return double_support(build, distance), single_support_1(build), single_support_2(build)


def _state_of(theta: Scalar, m: Motion) -> Float[Array, "6"]:
    return jnp.stack([theta, m.L1, m.L2, m.dtheta, m.dL1, m.dL2])


class ViscoelasticWheel(AbstractWheel):
    """The paper's rung: roles fixed, no slip, no scuffing; its premises are measured, not enforced.

    `stop_at_lift_off`: end a step where the ground would have to pull on Leg 1 (bouncing, which the
    rung can't model). False continues formally, as the paper does for scuffing, and leaves it to
    the monitors. `friction` is the coefficient of the ground that friction margins refer to; the
    motion does not use it.
    """

    rung: ClassVar[str] = "viscoelastic"
    parameter_names: ClassVar[tuple[str, ...]] = PARAMETER_NAMES
    tells_contacts: ClassVar[bool] = False

    friction: float = eqx.field(static=True, default=1.0)
    stop_at_lift_off: bool = eqx.field(static=True, default=True)

    def start(self, params: WheelParams) -> SectionState:
        """Close to the gait of Table 1, inside its basin."""
        return jnp.asarray(PAPER_START, params.damping.dtype)

    def advance(self, params: WheelParams, x: SectionState, options: Options) -> Advance:
        leaves, structure = jax.tree.flatten((params, x, options))
        return eqx.combine(*_compiled(self, structure, False)(*leaves))

    def step(self, params: WheelParams, x: SectionState, options: Options) -> StepResult:
        leaves, structure = jax.tree.flatten((params, x, options))
        return eqx.combine(*_compiled(self, structure, True)(*leaves))

    def trace(
        self, params: WheelParams, x: SectionState, options: Options, n_samples: int
    ) -> Trajectory:
        walked = self._walk(params, x, options, monitored=False)
        s = walked.s
        times, states, forces, energies = [], [], [], []
        begin = jnp.zeros_like(x[0])
        for index, (phase, start, end) in enumerate(
            zip(walked.phases, walked.starts, walked.ends, strict=True)
        ):
            samples = sample_phase(phase.field, start, end.duration, n_samples, options)
            times.append(begin + jnp.linspace(0.0, 1.0, n_samples) * end.duration)
            begin = begin + end.duration

            def describe(y: State, phase: Phase = phase, index: int = index) -> tuple:
                m = phase.motion(y)
                a = phase.acceleration(m)
                zero = 0.0 * m.L1
                rear = (
                    dynamics.rear_foot_force(s, m, a)
                    if index == 0
                    else dynamics.FootForce(zero, zero)
                )
                fore = dynamics.fore_foot_force(s, m, a, rear)
                return (
                    _state_of(y[0], m),
                    jnp.stack([*fore, *rear]),
                    jnp.stack(dynamics.energy(s, m)),
                )

            state, force, energy = jax.vmap(describe)(samples)
            states.append(state)
            forces.append(force)
            energies.append(energy)
        return Trajectory(*map(jnp.stack, (times, states, forces, energies)))

    def _walk(
        self, params: WheelParams, x: SectionState, options: Options, monitored: bool
    ) -> Walked:
        good = usable(params, x)
        params, x = replaced_where_bad(good, params, x, jnp.asarray(PAPER_START))
        s = params.symbols()
        landing = transitions.land(s, *x)
        build = PhaseBuilder(s, self.stop_at_lift_off, monitored)
        dls, sls1, sls2 = phases_of(build, landing.distance)
        stepped = jnp.int32(Outcome.STEPPED)

        def run(phase: Phase, start: State, active: Array) -> PhaseEnd:
            return integrate_phase(phase.field, phase.watched, start, active, options)

        start1 = jnp.stack([landing.theta, landing.motion.dtheta])
        active1 = good & landing.stays
        end1 = run(dls, start1, active1)
        code1 = jnp.where(active1, dls.outcome(end1), stepped)

        safe = jnp.asarray(SAFE_SINGLE_SUPPORT, x.dtype)
        active2 = good & (code1 == stepped)
        start2 = jnp.where(
            landing.stays,
            _state_of(end1.state[0], dls.motion(end1.state)),
            _state_of(landing.theta, landing.motion),
        )
        start2 = jnp.where(active2, start2, safe)
        end2 = run(sls1, start2, active2)
        code2 = jnp.where(active2, sls1.outcome(end2), code1)

        active3 = active2 & (code2 == stepped)
        state = jnp.where(active3, end2.state, safe)
        hit = transitions.hit_stopper(s, sls1.motion(state))
        start3 = jnp.stack([state[0], hit.motion.L1, hit.motion.dtheta, hit.motion.dL1])
        end3 = run(sls2, start3, active3)
        code3 = jnp.where(active3, sls2.outcome(end3), code2)
        return Walked(
            s=s,
            landing=landing,
            phases=(dls, sls1, sls2),
            ends=(end1, end2, end3),
            happened=(active1 & (end1.duration > 0.0), active2 & (end2.duration > 0.0), active3),
            hit=hit,
            outcome=jnp.where(good, code3, jnp.int32(Outcome.BAD_INPUT)),
            starts=(start1, start2, start3),
        )


SAFE_SINGLE_SUPPORT = (-0.3, 0.9, 0.95, 1.0, 0.0, 0.0)
"""A harmless posture that stands in where a lane has already failed; it is never integrated."""


@functools.cache
def _compiled(model: ViscoelasticWheel, structure: Any, full: bool) -> Forward:
    """A step over the leaves of (params, x, options): compiled, and differentiable in any mode."""

    def walk(tighten: bool, *leaves: Array) -> tuple:
        params, x, options = jax.tree.unflatten(structure, leaves)
        options = options.for_derivatives() if tighten else options
        walked = model._walk(params, x, options, monitored=full)
        result = result_of(walked, model.friction) if full else _lean_result(walked)
        return eqx.partition(result, eqx.is_inexact_array)

    return any_mode(partial(walk, False), partial(walk, True))


def _lean_result(walked: Walked) -> Advance:
    durations = jnp.stack([end.duration for end in walked.ends])
    return Advance(_section_state(walked), durations, walked.outcome, _tried(walked))


def _tried(walked: Walked) -> Int[Array, ""]:
    """Solver steps of the whole step, accepted or not."""
    return jnp.sum(jnp.stack([end.solver_steps for end in walked.ends]))


def _section_state(walked: Walked) -> SectionState:
    theta, _, dtheta, dL1 = walked.ends[2].state
    state = jnp.stack([theta, dtheta, dL1])
    return jnp.where(walked.outcome == Outcome.STEPPED, state, jnp.zeros_like(state))


def result_of(walked: Walked, friction: float) -> StepResult:
    s, landing, hit = walked.s, walked.landing, walked.hit
    began = walked.outcome != Outcome.BAD_INPUT
    hits = walked.happened[2]
    n = s.n - 2
    locked = range(3, s.n + 1)

    def lowest(*minima: tuple[Array, Array]) -> Array:
        """Over the phases that happened; 0 if none did."""
        value = jnp.full_like(minima[0][1], jnp.inf)
        for happened, minimum in minima:
            value = jnp.minimum(value, jnp.where(happened, minimum, jnp.inf))
        return jnp.where(jnp.isfinite(value), value, 0.0)

    def over_step(index: int | slice) -> Array:
        return lowest(
            *((h, end.minima[index]) for h, end in zip(walked.happened, walked.ends, strict=True))
        )

    fore_after, rear_after = transitions.landing_forces(s, landing)
    m = landing.motion
    held = began & landing.stays
    monitors = Margins(
        fore_foot_force=over_step(0),
        clearance_sls1=lowest((walked.happened[1], walked.ends[1].minima[3 + n])),
        clearance_sls2=lowest((walked.happened[2], walked.ends[2].minima[3 + n])),
        locked_stopper_force=over_step(slice(3, 3 + n)),
        rear_stopper_force=lowest((walked.happened[2], walked.ends[2].minima[4 + n])),
        contraction=over_step(1),
        friction_fore=jnp.where(began, friction + over_step(2), 0.0),
        friction_rear=jnp.where(
            began,
            friction - jnp.where(walked.happened[0], dynamics.friction_needed(rear_after), 0.0),
            0.0,
        ),
        landing_stopper_impulse=jnp.where(
            began, transitions.locked_leg_impulses(s, m, landing.hub_jump, locked), 0.0
        ),
        hit_stopper_impulse=jnp.where(
            hits, transitions.locked_leg_impulses(s, hit.motion, hit.hub_jump, locked), 0.0
        ),
        hit_planted_impulse=jnp.where(hits, hit.planted.normal, 0.0),
        landing_friction_fore=jnp.where(
            began, friction - dynamics.friction_needed(landing.fore), 0.0
        ),
        landing_friction_rear=jnp.where(
            began, friction - jnp.where(held, dynamics.friction_needed(landing.rear), 0.0), 0.0
        ),
    )
    end = walked.phases[2].motion(walked.ends[2].state)
    begins, finishes = dynamics.energy(s, m).total, dynamics.energy(s, end).total
    stepped = walked.outcome == Outcome.STEPPED
    theta = landing.theta
    return StepResult(
        section_state=_section_state(walked),
        post_impact=jnp.where(began, jnp.stack([theta, m.dtheta]), 0.0),
        durations=jnp.stack([end.duration for end in walked.ends]),
        step_length=jnp.where(began, landing.distance, 0.0),
        indicators=Indicators(
            lambda_I4=jnp.where(began, landing.rear.normal, 0.0),
            lambda_2=jnp.where(began, fore_after.normal, 0.0),
            lambda_4=jnp.where(began, rear_after.normal, 0.0),
        ),
        monitors=monitors,
        energy=EnergyLoss(
            landing=jnp.where(began, landing.energy_lost, 0.0),
            stopper=jnp.where(hits, hit.energy_lost, 0.0),
            damping=jnp.where(stepped, begins - finishes - hit.energy_lost, 0.0),
        ),
        outcome=walked.outcome,
        solver_steps=_tried(walked),
    )

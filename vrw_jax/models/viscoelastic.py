"""Viscoelastic model of the paper: landing, double support, single support I, stopper, support
II.
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.models.base import (
    AbstractWheel,
    Advance,
    SectionState,
    StepResult,
    Trajectory,
)
from vrw_jax.models.lane_step import lanes_can, moved_by_lanes, sampled_by_lanes, told_by_lanes
from vrw_jax.models.paper_step import (
    PAPER_START,
    End,
    Walked,
    advance_of,
    result_of,
    through_phases,
    trajectory_of,
)
from vrw_jax.numerics import (
    Field,
    Forward,
    Options,
    State,
    Vector,
    Watched,
    any_mode,
    integrate_phase,
    sample_phase,
)
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    AbstractPhase,
    Instant,
    Motion,
    WheelParams,
    known_friction,
)
from vrw_jax.wording import flag


class Flow(NamedTuple):
    """A phase for the diffrax integrator, over the state y = (q, v) as one vector."""

    motion: Callable[[State], Motion]
    field: Field
    watched: Watched


def flow_of(phase: AbstractPhase, monitored: bool) -> Flow:
    """Return the phase for the diffrax integrator.

    - `records_margins`: evaluate the phase's margins in addition to its guards.
    """

    def motion(y: State) -> Motion:
        numbers = tuple(y)
        return phase.at(numbers[: phase.n], numbers[phase.n :])

    def field(y: State) -> State:
        return jnp.stack([*y[phase.n :], *phase.acceleration(motion(y))[: phase.n]])

    def values(y: State) -> Array:
        at = Instant(phase, motion(y), None)
        return jnp.stack([*phase.guards(at), *(phase.premises(at) if monitored else ())])

    counts = phase.counts_at_start if monitored else ()
    return Flow(motion, field, Watched(values, len(phase.outcomes), counts))


def _run(
    options: Options,
    monitored: bool,
    phase: AbstractPhase,
    q: Vector,
    v: Vector,
    active: Array,
    _before: End | None,
) -> End:
    """Return the end of one phase, integrated by diffrax."""
    flow = flow_of(phase, monitored)
    end = integrate_phase(flow.field, flow.watched, jnp.stack([*q, *v]), active, options)
    state = tuple(end.state)
    return End(
        state[: phase.n], state[phase.n :], end.duration, end.guard, end.timed_out,
        end.solver_steps, end.minima if monitored else None,
    )  # fmt: skip


class ViscoelasticWheel(AbstractWheel):
    """The paper's model: fixed leg roles, no slip, no scuffing; margins are measured, not enforced.

    - `friction`: coefficient of the ground, which enters the friction margins but not the motion;
    - `stop_at_lift_off`: end a step where the ground would have to pull on Leg 1 (bouncing, which
      the model does not describe). Without it the step continues formally, as in the paper for
      scuffing, and the margins report the violation.

    Examples:
        >>> wheel = vrw.ViscoelasticWheel(friction=20.0)
        >>> step = vrw.step(vrw.WheelParams(), vrw.paper_start(), model=wheel)
        >>> print(f"{step.margins.friction_fore:.1f}")
        19.4
    """

    rung: ClassVar[str] = "viscoelastic"
    parameter_names: ClassVar[tuple[str, ...]] = PARAMETER_NAMES
    tells_contacts: ClassVar[bool] = False
    lanes: ClassVar[str] = "phases"

    friction: float = eqx.field(static=True, converter=known_friction, default=1.0)
    stop_at_lift_off: bool = eqx.field(
        static=True, converter=functools.partial(flag, "stop_at_lift_off"), default=True
    )

    def start(self, params: WheelParams) -> SectionState:
        """Return a start close to the gait of Table 1, inside its basin."""
        return jnp.asarray(PAPER_START, params.damping.dtype)

    def advance(self, params: WheelParams, x: SectionState, options: Options) -> Advance:
        return self._told(params, x, options, detailed=False)

    def step(self, params: WheelParams, x: SectionState, options: Options) -> StepResult:
        return self._told(params, x, options, detailed=True)

    def _told(self, params: WheelParams, x: SectionState, options: Options, detailed: bool) -> Any:
        """Return the outputs of the compiled step."""
        leaves, structure = jax.tree.flatten((params, x, options))
        return eqx.combine(*_compiled(self, structure, detailed)(*leaves))

    def trace(
        self, params: WheelParams, x: SectionState, options: Options, n_samples: int
    ) -> Trajectory:
        leaves, structure = jax.tree.flatten((params, x, options))
        if lanes_can(options):
            sampled = sampled_by_lanes(structure, self.stop_at_lift_off, n_samples)
        else:
            sampled = functools.partial(self._sampled_by_diffrax, structure, n_samples)
        return sampled(*leaves)

    def _sampled_by_diffrax(self, structure: Any, n_samples: int, *leaves: Array) -> Trajectory:
        """Return the sampled step, integrated by diffrax."""
        params, x, options = jax.tree.unflatten(structure, leaves)
        walked, samples = self._walk(params, x, options, monitored=False), []
        for phase, start, end in zip(walked.phases, walked.starts, walked.ends, strict=True):
            field, y = flow_of(phase, monitored=False).field, jnp.stack([*start[0], *start[1]])
            samples.append(sample_phase(field, y, end.duration, n_samples, options))
        return trajectory_of(walked, samples)

    def _walk(
        self, params: WheelParams, x: SectionState, options: Options, monitored: bool
    ) -> Walked:
        """Return all phases of the step, integrated by diffrax."""
        run = functools.partial(_run, options, monitored)
        return through_phases(run, params, tuple(x), self.stop_at_lift_off)


@functools.cache
def _compiled(model: ViscoelasticWheel, structure: Any, detailed: bool) -> Forward:
    """Return the step over the leaves of (params, x, options), differentiable in any mode."""

    static = jax.tree.unflatten(structure, [0.0] * structure.num_leaves)[2]
    engine = "lanes" if lanes_can(static) else "diffrax"

    def by_diffrax(tighten: bool, *leaves: Array) -> tuple:
        """Return the outputs of the step by diffrax.

        With the batch kernel as engine, it serves only derivatives of derivatives, under that
        engine's name.
        """
        params, x, options = jax.tree.unflatten(structure, leaves)
        options = options.for_derivatives() if tighten else options
        walked = model._walk(params, x, options, monitored=detailed)
        told: Advance | StepResult = (
            result_of(walked, model.friction, engine) if detailed else advance_of(walked, engine)
        )
        return eqx.partition(told, eqx.is_inexact_array)

    values, tighter = (functools.partial(by_diffrax, tighten) for tighten in (False, True))
    if engine == "diffrax":
        return any_mode(values, tighter)
    given = structure, model.stop_at_lift_off, model.friction if detailed else None
    return any_mode(told_by_lanes(*given), tighter, functools.partial(moved_by_lanes, *given))

"""Record of a step with unilateral contact, for one wheel or elementwise for a batch.

A step is a sequence of events, each followed by an interval in which no contact changes. The first
event is the opening landing. The step is complete when the foremost foot lands.
"""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.contact.contact_modes import PAPER_RULE_SENTINEL, ContactMode, Friction
from vrw_jax.contact.contact_state import Accumulators, ContactState, GuardLayout
from vrw_jax.contact.impacts import (
    ContactLaw,
    Event,
    EventResult,
    classify_event,
    project_motion,
    resolve_event,
)
from vrw_jax.contact.mechanics import WheelMotion, landing_position
from vrw_jax.contact.section import FullState, pack_section_state
from vrw_jax.models import AbstractContactStep
from vrw_jax.numerics import Elementwise, StepOptions, select_tree_leaves
from vrw_jax.wheel import Outcome, Symbols, replace_rest_outcome


@dataclass(frozen=True)
class RestOptions:
    """Options that decide when a foot that bounces ever less comes to rest."""

    bounce_height_per_atol: float = 1e-2
    """Smallest height of a bounce that a step resolves, as a fraction of the absolute tolerance."""
    bounce_height_eps: float = 4e2
    """Smallest height of a resolved bounce in units of round-off of a leg's length: 1e-13 m in
    float64."""
    n_events_before_ramp: int = 100
    """Number of events of a step after which each event raises the rest speed by its initial value.

    A quarter of the allowed events replaces this number if that is more. It is chosen because walks
    have 4 to 60 events, and chains of ever smaller bounces have hundreds. After 400 events, the
    last bounce is as large as a tolerance of 1e-6 leaves from the first."""


REST_OPTIONS = RestOptions()


def min_bounce_height(
    L0: Elementwise, options: StepOptions, rest_options: RestOptions = REST_OPTIONS
) -> Array:
    """Return the smallest height of a foot's bounce that a step resolves, m.

    - `L0`: leg length, m;
    - `options`: options whose absolute tolerance determines the height.
    """
    roundoff_height = rest_options.bounce_height_eps * jnp.finfo(L0.dtype).eps
    return jnp.maximum(rest_options.bounce_height_per_atol * options.atol, roundoff_height) * L0


def apply_friction_rule(friction: Elementwise, uses_paper_rule: bool) -> Elementwise:
    """Return friction with `PAPER_RULE_SENTINEL` for infinity if the paper's rule applies."""
    return (
        jnp.where(friction == jnp.inf, PAPER_RULE_SENTINEL, friction)
        if uses_paper_rule
        else friction
    )


def make_contact_law(
    s: Symbols,
    friction: Friction,
    options: StepOptions,
    is_one_sided: bool,
    counts_solutions: bool,
    restitution: Elementwise | None = None,
    tilt: Elementwise | None = None,
) -> ContactLaw:
    """Return the contact law of a walk.

    The rest speed is the landing speed after the smallest resolved bounce.

    - `counts_solutions`: whether all admissible solutions of an event are counted;
    - `tilt`: angle by which the next line is steeper, rad.
    """
    rest_speed = jnp.sqrt(2.0 * s.g * min_bounce_height(s.L0, options))
    return ContactLaw(s, friction, is_one_sided, counts_solutions, rest_speed, restitution, tilt)


def process_event(
    contact_law: ContactLaw,
    guard_layout: GuardLayout,
    motion: WheelMotion,
    contact_state: ContactState,
    guard: Int[Array, "..."],
    n_events: Int[Array, "..."],
    max_events: int,
    rest_options: RestOptions = REST_OPTIONS,
) -> tuple[EventResult, Event, Int[Array, "..."]]:
    """Return the result of a guard's event, the event, and the outcome (STEPPED if the event was
    resolved).

    - `n_events`: number of earlier events in this step, of at most `max_events`.

    The motion is projected onto its contacts first, because the integrator's error moves feet off
    them. A foot that lifts off rises from the slope like the third power of time. Without the
    projection, the foot would land again immediately.
    """
    ramp_start = max(rest_options.n_events_before_ramp, max_events // 4)
    contact_law = contact_law._replace(
        rest_speed=contact_law.rest_speed * (1 + jnp.maximum(n_events - ramp_start, 0))
    )
    motion = project_motion(
        contact_law.s, motion, contact_state.contact_modes, contact_state.locked
    )
    event = classify_event(guard_layout, guard)
    result = resolve_event(contact_law, motion, contact_state, event)
    outcome = jnp.where(result.n_solutions > 0, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT)
    outcome = jnp.where(result.is_paradox, Outcome.PAINLEVE_PARADOX, outcome)
    outcome = jnp.where(result.has_third_foot, Outcome.THREE_FEET_LOADED, outcome)
    return result, event, outcome.astype(jnp.int32)


class UnilateralMargins(eqx.Module):
    """Margins of bilateral stoppers over one step.

    A margin is negative if a one-sided stopper would have released a leg in the air.
    """

    stopper_force: Elementwise  # minimum over locked legs in the air, N
    stopper_impulse: Elementwise  # minimum over locked legs in the air, N s


class StepCounters(NamedTuple):
    """Numbers of events and solver steps of a step, and durations by the number of loaded feet."""

    n_events: Int[Array, "..."]  # number of changes of contacts and stoppers
    durations: Float[Array, "3 ..."]  # with two loaded feet, with one, with none, s
    n_solver_steps: Int[Array, "..."]  # number of attempted solver steps


def init_counters(template: Array) -> StepCounters:
    """Return the counters at the start of a step, zeros in the shape and dtype of `template`."""
    int_zeros = jnp.zeros(template.shape, jnp.int32)
    return StepCounters(int_zeros, jnp.zeros((3, *template.shape), template.dtype), int_zeros)


def add_interval(
    counters: StepCounters,
    contact_state: ContactState,
    duration: Elementwise,
    n_solver_steps: Array,
) -> StepCounters:
    """Return the counters after one more interval in this contact state.

    - `duration`: length of the interval, s.
    """
    n_loaded = jnp.sum(contact_state.contact_modes != ContactMode.OFF, axis=0)
    is_foot_count = jnp.stack([n_loaded == n_feet for n_feet in (2, 1, 0)])
    durations = counters.durations + jnp.where(is_foot_count, duration, 0.0)
    return counters._replace(
        durations=durations, n_solver_steps=counters.n_solver_steps + n_solver_steps
    )


def determine_interval_outcome(
    counters: StepCounters,
    guard_layout: GuardLayout,
    has_reached_event: Array,
    guard: Array,
    has_landed: Array,
    failure_outcome: Array,
    is_resting: Array,
    max_events: int,
) -> Int[Array, "..."]:
    """Return the outcome after an interval, STEPPED if the walk continues or the foremost foot
    `has_landed`.

    If the interval did not end at an event, the result is `failure_outcome`. If the wheel
    `is_resting`, CAME_TO_REST replaces either.
    """
    outcome = jnp.where(counters.n_events >= max_events, Outcome.TOO_MANY_EVENTS, Outcome.STEPPED)
    outcome = jnp.where(guard == guard_layout.rolling_rate, Outcome.FELL_BACK, outcome)
    outcome = jnp.where(guard == guard_layout.collapse, Outcome.COLLAPSED, outcome)
    outcome = jnp.where(
        has_reached_event, jnp.where(has_landed, Outcome.STEPPED, outcome), failure_outcome
    )
    return replace_rest_outcome(outcome, is_resting)


class StepDetails(NamedTuple):
    """Detailed results of a step, named as in `UnilateralStep`."""

    post_impact: Float[Array, "2 ..."]
    mode_durations: Float[Array, "4 4 ..."]
    landing_normal: Float[Array, "2 ..."]
    landing_tangential: Float[Array, "2 ..."]
    energy_impacts: Elementwise
    margins: UnilateralMargins
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]


def init_details(dtype: jnp.dtype) -> StepDetails:
    """Return the details of one wheel at the start of a step."""
    float_zero, int_zero = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    zero_pair = jnp.zeros((2,), dtype)
    return StepDetails(
        post_impact=zero_pair,
        mode_durations=jnp.zeros((4, 4), dtype),
        landing_normal=zero_pair,
        landing_tangential=zero_pair,
        energy_impacts=float_zero,
        margins=UnilateralMargins(float_zero + jnp.inf, float_zero + jnp.inf),
        impacts=int_zero,
        fewest_solutions=int_zero + jnp.iinfo(jnp.int32).max,
        most_solutions=int_zero,
    )


def record_event(
    details: StepDetails, is_first: Array, result: EventResult, event: Event
) -> StepDetails:
    """Return the details after one more event.

    - `is_first`: whether the event is the first of the step.
    """
    opening_values = (
        jnp.stack([result.motion.theta, result.motion.dtheta]),
        jnp.stack(result.normal_impulse),
        jnp.stack(result.tangential_impulse),
    )
    previous_values = details.post_impact, details.landing_normal, details.landing_tangential
    post_impact, normal, tangential = select_tree_leaves(is_first, opening_values, previous_values)
    stopper_impulse = jnp.minimum(details.margins.stopper_impulse, result.stopper_impulse)
    return details._replace(
        post_impact=post_impact,
        landing_normal=normal,
        landing_tangential=tangential,
        energy_impacts=details.energy_impacts + result.energy_lost,
        margins=UnilateralMargins(details.margins.stopper_force, stopper_impulse),
        impacts=details.impacts + event.is_impact,
        fewest_solutions=jnp.minimum(details.fewest_solutions, result.n_solutions),
        most_solutions=jnp.maximum(details.most_solutions, result.most_solutions),
    )


def record_interval(
    details: StepDetails,
    slot_modes: Int[Array, "2 ..."],
    duration: Elementwise,
    stopper_force: Elementwise,
) -> StepDetails:
    """Return the details after one more interval.

    The interval adds to the durations of the slots' contact modes. The stopper force of legs in the
    air is the minimum over the ends of all intervals.

    - `slot_modes`: contact mode of each slot's foot;
    - `duration`: length of the interval, s;
    - `stopper_force`: minimum at the ends of this interval, N.
    """
    mode_codes = np.arange(4).reshape(-1, *(1,) * jnp.ndim(stopper_force))
    first_mode_indicator, second_mode_indicator = (
        (mode_codes == slot_modes[i]).astype(jnp.result_type(stopper_force)) for i in range(2)
    )
    stopper_force = jnp.minimum(details.margins.stopper_force, stopper_force)
    return details._replace(
        mode_durations=details.mode_durations
        + first_mode_indicator[:, None] * second_mode_indicator[None, :] * duration,
        margins=UnilateralMargins(stopper_force, details.margins.stopper_impulse),
    )


class UnilateralStep(AbstractContactStep):
    """One step, from the landing of the foremost foot to the next. Batched under vmap.

    Fields of a step whose outcome is not STEPPED are finite and describe the partial motion; its
    `section_state` is all zeros, which is not a valid section state.

    - `section_state`: just before the next landing;
    - `post_impact`: (theta, dtheta) just after the opening landing, rad, rad/s;
    - `durations`: with two feet loaded, with one, with none, s;
    - `mode_durations`: by mode of the first and second loaded foot, s;
    - `step_length`: between the places of the two landings, m;
    - `landing_normal`: normal impulses of the opening landing, N s;
    - `landing_tangential`: tangential ones; fore and rear foot;
    - `energy_impacts`: lost in impacts, J;
    - `energy_damping`: lost in the dampers, J;
    - `energy_friction`: lost by sliding between impacts, J;
    - `slip`: path length of sliding feet, m;
    - `events`: number of changes of contacts and stoppers;
    - `impacts`: number of events in which velocities jumped;
    - `fewest_solutions`, `most_solutions`: numbers of admissible combinations at an event: 1 if
      well posed;
    - `margins`: of the assumptions of this model;
    - `outcome`: an Outcome;
    - `solver_steps`: attempted solver steps;
    - `engine`: name of the engine, see `StepOptions`.

    Examples:
        >>> wheel = vrw.UnilateralWheel(friction=0.7)
        >>> step = vrw.step(vrw.WheelParams(damping=300.0), vrw.paper_start(), model=wheel)
        >>> print(f"{step.energy_friction:.1f} J lost by sliding")
        1.3 J lost by sliding
    """

    section_state: FullState
    post_impact: Float[Array, "2 ..."]
    durations: Float[Array, "3 ..."]
    mode_durations: Float[Array, "4 4 ..."]
    step_length: Elementwise
    landing_normal: Float[Array, "2 ..."]
    landing_tangential: Float[Array, "2 ..."]
    energy_impacts: Elementwise
    energy_damping: Elementwise
    energy_friction: Elementwise
    slip: Elementwise
    margins: UnilateralMargins
    events: Int[Array, "..."]
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]
    outcome: Int[Array, "..."]
    solver_steps: Int[Array, "..."]
    engine: str = eqx.field(static=True, default="")

    def model_measures(self) -> dict[str, Array]:
        """Return the measures of contact steps and the stopper margins, by name."""
        return AbstractContactStep.model_measures(self) | {
            field.name: getattr(self.margins, field.name)
            for field in dataclasses.fields(self.margins)
        }


def final_section_state(
    motion: WheelMotion,
    contact_state: ContactState,
    outcome: Array,
    tilt: Elementwise | None = None,
) -> FullState:
    """Return the section state at the end of a step, or zeros if the step failed."""
    x = pack_section_state(motion, contact_state, tilt)
    return jnp.where(outcome == Outcome.STEPPED, x, jnp.zeros_like(x))


def make_unilateral_step(
    motion: WheelMotion,
    contact_state: ContactState,
    accumulators: Accumulators,
    counters: StepCounters,
    details: StepDetails,
    outcome: Array,
    engine: str,
    tilt: Elementwise | None = None,
) -> UnilateralStep:
    """Return the results of a step from its final state and its records.

    - `engine`: name of the engine that took the step;
    - `tilt`: angle by which the next line is steeper, rad.
    """
    landing_place = landing_position(motion.L.shape[0], motion)
    replace_nonfinite = lambda record_value: jnp.where(
        jnp.isfinite(record_value), record_value, 0.0
    )
    details = details._replace(
        margins=jax.tree.map(replace_nonfinite, details.margins),
        fewest_solutions=jnp.where(counters.n_events > 0, details.fewest_solutions, 0),
    )
    return UnilateralStep(
        section_state=final_section_state(motion, contact_state, outcome, tilt),
        durations=counters.durations,
        step_length=jnp.where(outcome == Outcome.STEPPED, landing_place, 0.0),
        energy_damping=accumulators.damping_loss,
        energy_friction=accumulators.friction_loss,
        slip=accumulators.slip_length,
        events=counters.n_events,
        outcome=outcome,
        solver_steps=counters.n_solver_steps,
        engine=engine,
        **details._asdict(),
    )

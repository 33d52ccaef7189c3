"""Record of a step with unilateral contact, for one wheel or, elementwise, for a batch.

A step is a sequence of events, each followed by an interval in which no contact changes. Its first
event is the opening landing; the step is complete when the foremost foot lands.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.models.base import AbstractGroundStep
from vrw_jax.models.unilateral.contacts import OFF, THE_PAPERS, Roughness
from vrw_jax.models.unilateral.events import Change, Event, Law, event_of, resolve, settled
from vrw_jax.models.unilateral.mechanics import WheelMotion, place_of_landing
from vrw_jax.models.unilateral.motion import Guards, Stance, Tally
from vrw_jax.models.unilateral.section import FullState, closed
from vrw_jax.numerics import Elementwise, Options, select
from vrw_jax.results import STOPPERS
from vrw_jax.wheel import Outcome, Symbols

SHARE, SEEN = 1e-2, 4e2
"""Smallest depth of a followed dip: the first as a fraction of the tolerance, the second in
rounding units of a leg's length, 1e-13 m in float64."""
PATIENCE = 100
"""Number of events of a step after which each further event raises the rest speed by its initial
value; a quarter of the allowed events if that is more. Walks make 4 to 60 events, and chains of
ever smaller dips make hundreds, which this ends where a tolerance would continue them. Of 400
events, the last dip is as large as a tolerance of 1e-6 leaves from the first."""


def least_dip(L0: Elementwise, options: Options) -> Array:
    """Return the smallest depth of a dip that a step follows, m."""
    return jnp.maximum(SHARE * options.atol, SEEN * jnp.finfo(L0.dtype).eps * L0)


def as_ruled(friction: Elementwise, by_paper: bool) -> Elementwise:
    """Return friction with `PAPER_RULE_SENTINEL` in place of infinity under the paper's rule."""
    return jnp.where(friction == jnp.inf, THE_PAPERS, friction) if by_paper else friction


def law_of(
    s: Symbols,
    friction: Roughness,
    options: Options,
    one_sided: bool,
    counted: bool,
    restitution: Elementwise | None = None,
    tilt: Elementwise | None = None,
) -> Law:
    """Return the contact law of a walk; the rest speed is that of the smallest dip under
    gravity.
    """
    rest = jnp.sqrt(2.0 * s.g * least_dip(s.L0, options))
    return Law(s, friction, one_sided, counted, rest, restitution, tilt)


def past(
    law: Law,
    place: Guards,
    motion: WheelMotion,
    stance: Stance,
    guard: Int[Array, "..."],
    events: Int[Array, "..."],
    max_events: int,
) -> tuple[Change, Event, Int[Array, "..."]]:
    """Return the result of a guard's event, the event, and STEPPED if it was resolved.

    - `n_events`: number of earlier events in this step, of at most `max_events`.

    The integrator lets feet drift by its error, so the motion is projected onto its contacts first.
    A foot that lifts off rises like the third power of time, from the slope and from rest; without
    the projection it would land again at once.
    """
    patience = max(PATIENCE, max_events // 4)
    law = law._replace(rest=law.rest * (1 + jnp.maximum(events - patience, 0)))
    motion, event = settled(law.s, motion, stance.contact, stance.locked), event_of(place, guard)
    change = resolve(law, motion, stance, event)
    outcome = jnp.where(change.solutions > 0, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT)
    outcome = jnp.where(change.paradox, Outcome.FRICTION_PARADOX, outcome)
    outcome = jnp.where(change.third_foot, Outcome.THREE_FEET_LOADED, outcome)
    return change, event, outcome.astype(jnp.int32)


class UnilateralMargins(eqx.Module):
    """Margins of bilateral stoppers over one step.

    Negative where a one-sided stopper would have released a leg in the air.
    """

    stopper_force: Elementwise  # minimum over locked legs in the air, N
    stopper_impulse: Elementwise  # minimum over locked legs in the air, N s


class Ledger(NamedTuple):
    """Counters and durations of a step."""

    events: Int[Array, "..."]  # contacts and stoppers that changed
    durations: Float[Array, "3 ..."]  # with two loaded feet, one, none, s
    tried: Int[Array, "..."]  # attempted


def blank(like: Array) -> Ledger:
    """Return the counters at the start of a step, for wheels of the shape and dtype of the
    argument.
    """
    none = jnp.zeros(like.shape, jnp.int32)
    return Ledger(none, jnp.zeros((3, *like.shape), like.dtype), none)


def passed(ledger: Ledger, stance: Stance, duration: Elementwise, tried: Array) -> Ledger:
    """Return the counters after one more interval in this contact state."""
    loaded = jnp.sum(stance.contact != OFF, axis=0)
    share = jnp.stack([loaded == feet for feet in (2, 1, 0)])
    durations = ledger.durations + jnp.where(share, duration, 0.0)
    return ledger._replace(durations=durations, tried=ledger.tried + tried)


def outcome_at(
    ledger: Ledger,
    place: Guards,
    at_event: Array,
    guard: Array,
    landed: Array,
    lost: Array,
    max_events: int,
) -> Int[Array, "..."]:
    """Return STEPPED if the walk continues from the guard or the foremost foot `has_landed`.

    If the interval ended at no event, the result is `failure`.
    """
    code = jnp.where(ledger.events >= max_events, Outcome.TOO_MANY_EVENTS, Outcome.STEPPED)
    code = jnp.where(guard == place.rate, Outcome.FELL_BACK, code)
    code = jnp.where(guard == place.length, Outcome.COLLAPSED, code)
    return jnp.where(at_event, jnp.where(landed, Outcome.STEPPED, code), lost)


class Details(NamedTuple):
    """Further results of a step, named as in `UnilateralStep`."""

    post_impact: Float[Array, "2 ..."]
    mode_durations: Float[Array, "4 4 ..."]
    landing_normal: Float[Array, "2 ..."]
    landing_tangential: Float[Array, "2 ..."]
    energy_impacts: Elementwise
    monitors: UnilateralMargins
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]


def no_details(dtype: jnp.dtype) -> Details:
    """Return the details of one wheel at the start of a step."""
    zero, none = jnp.zeros((), dtype), jnp.zeros((), jnp.int32)
    two = jnp.zeros((2,), dtype)
    return Details(
        post_impact=two,
        mode_durations=jnp.zeros((4, 4), dtype),
        landing_normal=two,
        landing_tangential=two,
        energy_impacts=zero,
        monitors=UnilateralMargins(zero + jnp.inf, zero + jnp.inf),
        impacts=none,
        fewest_solutions=none + jnp.iinfo(jnp.int32).max,
        most_solutions=none,
    )


def event_noted(details: Details, first: Array, change: Change, event: Event) -> Details:
    """Return the details after one more event.

    - `is_first`: whether the event is the first of the step.
    """
    opening = (
        jnp.stack([change.motion.theta, change.motion.dtheta]),
        jnp.stack(change.normal_impulse),
        jnp.stack(change.tangential_impulse),
    )
    known = details.post_impact, details.landing_normal, details.landing_tangential
    post_impact, normal, tangential = select(first, opening, known)
    impulse = jnp.minimum(details.monitors.stopper_impulse, change.stopper_impulse)
    return details._replace(
        post_impact=post_impact,
        landing_normal=normal,
        landing_tangential=tangential,
        energy_impacts=details.energy_impacts + change.energy_lost,
        monitors=UnilateralMargins(details.monitors.stopper_force, impulse),
        impacts=details.impacts + event.impact,
        fewest_solutions=jnp.minimum(details.fewest_solutions, change.solutions),
        most_solutions=jnp.maximum(details.most_solutions, change.most_solutions),
    )


def stretch_noted(
    details: Details, contact: Int[Array, "2 ..."], duration: Elementwise, force: Elementwise
) -> Details:
    """Return the details after one more interval.

    They gain the durations of the slots' modes, and the minimum stopper force of legs in the air at
    the ends of the interval.
    """
    places = np.arange(4).reshape(-1, *(1,) * jnp.ndim(force))
    first, second = ((places == contact[i]).astype(jnp.result_type(force)) for i in range(2))
    force = jnp.minimum(details.monitors.stopper_force, force)
    return details._replace(
        mode_durations=details.mode_durations + first[:, None] * second[None, :] * duration,
        monitors=UnilateralMargins(force, details.monitors.stopper_impulse),
    )


class UnilateralStep(AbstractGroundStep):
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
    monitors: UnilateralMargins
    events: Int[Array, "..."]
    impacts: Int[Array, "..."]
    fewest_solutions: Int[Array, "..."]
    most_solutions: Int[Array, "..."]
    outcome: Int[Array, "..."]
    solver_steps: Int[Array, "..."]
    engine: str = eqx.field(static=True, default="")

    def own_measures(self) -> dict[str, Array]:
        return AbstractGroundStep.own_measures(self) | {
            name: getattr(self.monitors, name) for name in STOPPERS
        }


def section_reached(
    motion: WheelMotion, stance: Stance, outcome: Array, tilt: Elementwise | None = None
) -> FullState:
    """Return the section state at the end of a step; zeros if it failed."""
    x = closed(motion, stance, tilt)
    return jnp.where(outcome == Outcome.STEPPED, x, jnp.zeros_like(x))


def step_told(
    motion: WheelMotion,
    stance: Stance,
    tally: Tally,
    ledger: Ledger,
    details: Details,
    outcome: Array,
    engine: str,
    tilt: Elementwise | None = None,
) -> UnilateralStep:
    """Return the step of this final state and these records."""
    landing = place_of_landing(motion.L.shape[0], motion)
    finite = lambda value: jnp.where(jnp.isfinite(value), value, 0.0)
    details = details._replace(
        monitors=jax.tree.map(finite, details.monitors),
        fewest_solutions=jnp.where(ledger.events > 0, details.fewest_solutions, 0),
    )
    return UnilateralStep(
        section_state=section_reached(motion, stance, outcome, tilt),
        durations=ledger.durations,
        step_length=jnp.where(outcome == Outcome.STEPPED, landing, 0.0),
        energy_damping=tally.damping,
        energy_friction=tally.friction,
        slip=tally.slip,
        events=ledger.events,
        outcome=outcome,
        solver_steps=ledger.tried,
        engine=engine,
        **details._asdict(),
    )

"""Gait steps of many wheels on real ground at once: values only, no derivatives.

The equations are those of `models.unilateral`, element by element over lanes; the march and the
search for events are the lane engine's (`lane_phase`). Each round, every lane whose last phase has
ended is taken through its event, then all march on. A landing of the foremost foot is an event like
others: lanes go from step to step without waiting, and one that marches long goes on in the next
round where it stands.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from vrw_jax.lane_phase import LanePhase, LanePhaseEnd, Patience, integrate_lanes
from vrw_jax.models.base import replaced_where_bad, usable
from vrw_jax.models.unilateral import UnilateralWheel
from vrw_jax.models.unilateral_contacts import OFF
from vrw_jax.models.unilateral_events import event_of, resolve
from vrw_jax.models.unilateral_mechanics import Legwise, WheelMotion, directions, kept
from vrw_jax.models.unilateral_motion import (
    Felt,
    Flow,
    Stance,
    felt,
    flow_of,
    forces,
    guards_of,
    leg_acceleration,
    stance_guards,
    unpack,
)
from vrw_jax.models.unilateral_section import closed, embedded, opened
from vrw_jax.models.viscoelastic import PAPER_START
from vrw_jax.options import Options
from vrw_jax.outcomes import Outcome
from vrw_jax.params import PARAMETER_NAMES, Symbols, WheelParams
from vrw_jax.runge_kutta import Place, Slope, Tableau, Vector, cut_where, explicit_tableau

BLOCK = 256
"""Lanes that march side by side: they stay in cache, and few wait for the slowest."""
FEW = 3
"""A round waits no longer than usual once less than one in `FEW` of its lanes is marching."""
MOST_LEGS = 9
"""The guards that crossed are bits of one integer."""


class GroundSteps(eqx.Module):
    """Lean results of walks of some steps, leading axis: lanes; each tells of its last step."""

    section_state: Float[Array, "lanes n_full"]  # just before the next landing; zeros if it failed
    durations: Float[Array, "lanes 3"]  # with two feet loaded, with one, with none, s
    outcome: Int[Array, " lanes"]  # an Outcome; the walk ends at the first that is not STEPPED
    n_stepped: Int[Array, " lanes"]  # steps that ended in a landing
    solver_steps: Int[Array, " lanes"]  # tried by the integrator, over all steps


class _Lanes(NamedTuple):
    """Where every lane stands, lanes on the last axis."""

    motion: WheelMotion
    stance: Stance
    guard: Array  # that ended its last phase; -1: none did, it marches on
    next_step: Array  # s
    clock: Array  # in this phase, s
    events: Array  # in this step
    durations: Array  # (3, lanes), of this step
    told: Array  # (3, lanes), of the last whole step
    section: Array  # (n_full, lanes), after it
    outcome: Array
    n_stepped: Array
    tried: Array
    running: Array


def ground_steps(
    params: WheelParams,
    states: Array | np.ndarray,
    n_steps: int = 1,
    *,
    model: UnilateralWheel | None = None,
    options: Options | None = None,
) -> GroundSteps:
    """`n_steps` steps of many wheels on real ground, or as many as each can.

    `states` are full section states, shape (lanes, 4 + 3 n), or the paper's, shape (lanes, 3);
    fields of `params` and the model's friction are scalars or have the lanes' axis. Errors as of
    `model.advance` at the same options, for explicit solvers and up to MOST_LEGS legs. Not for use
    inside `jax.jit`: it compiles itself, once for each number of steps.
    """
    model = UnilateralWheel() if model is None else model
    options = Options() if options is None else options
    if explicit_tableau(options.solver, options) is None:
        raise ValueError(f"solver is {options.solver}, but lanes need an explicit Runge-Kutta one.")
    if model.one_sided:
        raise ValueError("model has one-sided stoppers, which lanes don't: map vrw.return_map.")
    if params.n_legs > MOST_LEGS:
        raise ValueError(
            f"the wheel has {params.n_legs} legs, but lanes take {MOST_LEGS} at most: map "
            "vrw.return_map over the wheels."
        )
    states = np.asarray(states)
    n = len(states)
    dtype = np.dtype(jnp.result_type(params.damping, states.dtype))
    options.require_reachable(dtype)
    names = (*(getattr(params, name) for name in PARAMETER_NAMES), model.friction)
    columns = np.stack([np.broadcast_to(np.asarray(x, dtype), (n,)) for x in names])
    if states.shape[1] == 3:
        embed = lambda values, x: embedded(_wheel(values, params.n_legs).symbols(), x)
        states = np.asarray(jax.vmap(embed, (1, 0))(columns[:-1], jnp.asarray(states, dtype)))
    dynamic, static = eqx.partition(options, eqx.is_array)
    dynamic = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), dynamic)
    program = _program(static, params.n_legs, model.max_events, n_steps)
    parts = []
    order = np.argsort(columns[PARAMETER_NAMES.index("damping")], kind="stable")
    for begin in range(0, n, BLOCK):
        some = order[begin : begin + BLOCK]
        filled = np.concatenate([some, np.repeat(some[-1:], BLOCK - len(some))])
        wanted = np.arange(BLOCK) < len(some)
        out = program(columns[:, filled], states[filled].T.copy(), wanted, dynamic)
        parts.append([np.asarray(x)[..., : len(some)] for x in out])
    back = np.argsort(order, kind="stable")
    joined = [np.moveaxis(np.concatenate(x, -1), -1, 0)[back] for x in zip(*parts, strict=True)]
    return GroundSteps(*map(jnp.asarray, joined))


def _wheel(values: Array, n_legs: int) -> WheelParams:
    return WheelParams(**dict(zip(PARAMETER_NAMES, values, strict=True)), n_legs=n_legs)


@functools.cache
def _program(static: Options, n_legs: int, max_events: int, n_steps: int) -> Callable[..., tuple]:
    """The compiled walk of one block of lanes."""

    def block(columns: Array, x: Array, wanted: Array, dynamic: Options) -> tuple:
        options = eqx.combine(dynamic, static)
        tableau = explicit_tableau(options.solver, options)
        assert tableau is not None  # `ground_steps` looked
        return _walk_lanes(columns, x, wanted, n_legs, max_events, n_steps, options, tableau)

    return jax.jit(block)


def _walk_lanes(
    columns: Array,
    x: Array,
    wanted: Array,
    n: int,
    max_events: int,
    n_steps: int,
    options: Options,
    tableau: Tableau,
) -> tuple:
    """Every wanted lane through `n_steps` landings of its foremost foot."""
    place = guards_of(n, False)
    over = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    zero = jnp.zeros_like(x[0])

    def made_safe(values: Array, x: Array) -> tuple[Array, Array, Array]:
        params = _wheel(values[:-1], n)
        safe_x = embedded(WheelParams(n_legs=n).symbols(), jnp.asarray(PAPER_START, x.dtype))
        good = usable(params, x) & (values[-1] >= 0.0)
        params, x = replaced_where_bad(good, params, x, safe_x)
        numbers = [getattr(params, name) for name in PARAMETER_NAMES]
        return jnp.stack([*numbers, jnp.where(good, values[-1], 1.0)]), x, good

    columns, x, good = over(made_safe)(columns, x)
    s, friction = _wheel(columns[:-1], n).symbols(), columns[-1]

    def began(values: Array, x: Array) -> tuple[WheelMotion, Stance]:
        state, stance = opened(_wheel(values[:-1], n).symbols(), x)
        return unpack(state)[0], stance

    def through(values: Array, motion: WheelMotion, stance: Stance, guard: Array) -> tuple:
        """Past an event: motion, stance and outcome.

        A foot that lifts rises like the third power of time: it starts from the slope itself, from
        which the integrator's error has moved it.
        """
        symbols, mu = _wheel(values[:-1], n).symbols(), values[-1]
        change = resolve(symbols, mu, motion, stance, event_of(place, n, guard))
        outcome = jnp.where(change.solutions > 0, Outcome.STEPPED, Outcome.NO_ADMISSIBLE_CONTACT)
        outcome = jnp.where(change.third_foot, Outcome.THREE_FEET_LOADED, outcome)
        after = change.motion
        on_slope = after.z / directions(symbols, after.theta).cos
        after = after._replace(L=jnp.where(change.stance.new_foot, on_slope, after.L))
        return after, change.stance, outcome.astype(jnp.int32)

    def round_(now: _Lanes) -> _Lanes:
        pending = now.running & (now.guard >= 0)
        motion, stance, outcome = over(through)(columns, now.motion, now.stance, now.guard)
        sound = outcome == Outcome.STEPPED
        goes = pending & sound
        motion, stance = _select(goes, (motion, stance), (now.motion, now.stance))
        clock = jnp.where(goes, 0.0, now.clock)
        active = now.running & (goes | ~pending)
        motion, end = _marched(
            s, friction, motion, stance, goes, active, now.next_step, options, tableau
        )
        events = now.events + goes
        guard = jnp.where(active, end.guard, now.guard)
        clock = clock + jnp.where(active, end.duration, 0.0)
        loaded = jnp.sum(stance.contact != OFF, axis=0)
        share = jnp.arange(3)[:, None] == 2 - loaded
        durations = now.durations + jnp.where(share & active, end.duration, 0.0)

        landed = active & (guard == place.foot + n - 1)
        lost = active & (guard < 0) & ~end.unfinished
        code = jnp.where(pending & ~sound, outcome, Outcome.STEPPED)
        code = jnp.where(lost, Outcome.SOLVER_GAVE_UP, code)
        late = active & (end.timed_out | (clock >= options.max_phase_time))
        code = jnp.where(late, Outcome.NO_TOUCHDOWN_IN_TIME, code)
        code = jnp.where(active & (guard == place.rate), Outcome.FELL_BACK, code)
        code = jnp.where(active & (guard == place.length), Outcome.COLLAPSED, code)
        chained = active & (events >= max_events) & ~landed & (code == Outcome.STEPPED)
        code = jnp.where(chained, Outcome.TOO_MANY_EVENTS, code).astype(jnp.int32)

        reached = over(closed)(motion, stance)
        begins = over(began)(columns, jnp.where(landed, reached, x))
        motion, stance = _select(landed, begins, (motion, stance))
        counted = now.n_stepped + landed
        done = landed & (counted >= n_steps)
        failed = now.running & (code != Outcome.STEPPED)
        return _Lanes(
            motion=motion,
            stance=stance,
            guard=jnp.where(landed, place.foot, guard),
            next_step=jnp.where(end.unfinished, end.next_step, options.first_step),
            clock=clock,
            events=jnp.where(landed, 0, events),
            durations=jnp.where(landed, 0.0, durations),
            told=jnp.where(landed, durations, jnp.where(failed, durations, now.told)),
            section=jnp.where(landed, reached, jnp.where(failed, 0.0, now.section)),
            outcome=jnp.where(failed, code, now.outcome),
            n_stepped=counted,
            tried=now.tried + jnp.where(active, end.tried, 0),
            running=now.running & ~done & ~failed,
        )

    none = jnp.zeros(zero.shape, jnp.int32)
    motion, stance = over(began)(columns, x)
    begin = _Lanes(
        motion=motion,
        stance=stance,
        guard=none + place.foot,
        next_step=zero + options.first_step,
        clock=zero,
        events=none,
        durations=jnp.zeros((3, *zero.shape), x.dtype),
        told=jnp.zeros((3, *zero.shape), x.dtype),
        section=jnp.zeros_like(x),
        outcome=jnp.where(good, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        n_stepped=none,
        tried=none,
        running=good & wanted,
    )
    end = lax.while_loop(lambda now: jnp.any(now.running), round_, begin)
    return end.section, end.told, end.outcome, end.n_stepped, end.tried


def _marched(
    s: Symbols,
    friction: Array,
    motion: WheelMotion,
    stance: Stance,
    begins: Array,
    active: Array,
    first_step: Array,
    options: Options,
    tableau: Tableau,
) -> tuple[WheelMotion, LanePhaseEnd]:
    """All active lanes up to their next events, or as far as their like go."""
    cut = cut_where(first_step[0] > 0.0)  # always
    flow = flow_of(s, friction, False, stance)

    def sensed(q: Vector, v: Vector) -> tuple[Vector, Legwise]:
        now = forces(flow, _motion(q, v))
        legs, normal, tangential, stopper, speed = felt(now)
        ddL = kept(leg_acceleration(flow, now), first_step / first_step)
        feet = (*normal, *tangential, *stopper, *speed)
        return (*now.answer.hub, *(ddL[i] for i in range(s.n)), *feet), legs

    def evaluate(q: Vector, v: Vector) -> Slope:
        acceleration, legs = cut(sensed, q, v)
        return Slope(legs.sin, legs.cos, acceleration)

    def watched(place: Place) -> Vector:
        n1, n2, t1, t2, s1, s2, x1, x2 = place.slope.acceleration[3 + s.n :]
        legs = Legwise(place.slope.sin, place.slope.cos)
        now = Felt(legs, (n1, n2), (t1, t2), (s1, s2), (x1, x2))
        begun = jnp.ones(first_step.shape, bool)
        parts = stance_guards(flow, _motion(place.q, place.v), now, begun)
        return tuple(value for part in parts for value in part)

    def guards(place: Place) -> Vector:
        return cut(watched, place)

    q = (motion.x, motion.z, motion.theta, *motion.L)
    v = (motion.vx, motion.vz, motion.dtheta, *motion.dL)
    phase = LanePhase(evaluate, guards, ())
    patience = Patience(first_step.shape[0] // FEW, 1)
    end = integrate_lanes(
        phase, tableau, q, v, active, first_step, options, cut, patience, _begun(flow, begins)
    )
    return _motion(end.place.q, end.place.v), end


def _motion(q: Vector, v: Vector) -> WheelMotion:
    x, z, theta, *lengths = q
    vx, vz, dtheta, *rates = v
    return WheelMotion(x, z, theta, vx, vz, dtheta, jnp.stack(lengths), jnp.stack(rates))


def _begun(flow: Flow, begins: Array) -> Vector:
    """Guards that stand on the event which has just begun the stance, in the order of `Guards`."""
    stance = flow.stance
    slid = jnp.stack(flow.slots.of(stance.new_slip.astype(jnp.int32))) > 0
    no = jnp.zeros((2, *begins.shape), bool)
    feet, legs = stance.new_foot, stance.new_leg
    return tuple(jnp.concatenate([feet, legs, no, no, no, slid, no, no]) & begins)


def _select(condition: Array, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)

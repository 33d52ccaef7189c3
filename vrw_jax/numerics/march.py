"""Integration of one phase for a batch, each element with its own step size, to the earliest event.

The elements are integrated together until each has ended or holds a step that crosses a guard. Then
they locate their events together: that step is repeated with its length corrected by Newton's
method. The result of an element never depends on the other elements, because an element that has
ended does not change.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.numerics.crossing import Crossing, locate
from vrw_jax.numerics.derivatives import without_derivative
from vrw_jax.numerics.lane_minima import (
    Lowest,
    Monitors,
    Passed,
    Settled,
    at_start,
    lowered,
    settled,
    with_rates,
)
from vrw_jax.numerics.lane_minima import moved as moved_minima
from vrw_jax.numerics.lanes import select
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.tableaus import (
    Evaluate,
    Place,
    Tableau,
    Take,
    Taken,
    change_of_length,
    take_step,
    to_earliest_dip,
)
from vrw_jax.numerics.tangents import Balance, Moving, in_directions, stacked
from vrw_jax.numerics.types import Vector
from vrw_jax.simd import apart


class LanePhase(NamedTuple):
    """A phase as data, whose functions are elementwise over the batch.

    `guards` are positive inside the phase, and an event is a zero from above. The earliest event
    counts; of two at the same time, the first in the list.
    """

    evaluate: Evaluate
    guards: Callable[[Place], Vector]
    monitors: Monitors | None = None  # margins whose minima are searched
    balance: Balance | None = None  # for derivatives
    called: bool = False
    """Whether machine code calls the phase's functions instead of inlining them at each use; it
    then compiles in half of the time and runs a sixth slower."""


class LanePhaseEnd(NamedTuple):
    """End of a phase for each batch element."""

    place: Place
    duration: Array  # s
    guard: Array  # index of the guard that ended it; -1 if none did
    timed_out: Array
    unfinished: Array  # cut off as a straggler, see `integrate_batch_phase`
    tried: Array  # steps, accepted or not
    next_step: Array  # next length of the controller, s
    minima: Array | None  # of the margins, (margins, batch)


class _March(NamedTuple):
    """State of the integrator."""

    here: Place
    values: Vector  # guards at the state
    h: Array
    time: Array
    verdict: Array  # after the last tried step
    crossing: Array  # bits of the guards that crossed in that step
    inside: Vector  # guards within the crossing step
    beyond: Vector
    tried: Array
    half: Array  # iterations after which half of the batch had finished
    iterations: Array
    lowest: Lowest | None
    direction: Array | None  # of the state, (directions, ., batch), see `tangents`


MARCHING, TIMED_OUT, GAVE_UP, CROSSED, IDLE = range(5)
"""Status codes of a batch element in the integration."""

LATE = 2
"""Ratio of iterations at which stragglers are cut off to the iterations after which half of the
batch had finished."""


PhaseOf = Callable[[Any, Vector], LanePhase]
"""A function that returns a phase for its constants, see `tangents.ImplicitDynamicsFn`."""


def integrate_lanes(
    phase_of: PhaseOf,
    constants: Any,
    held: Vector,
    tableau: Tableau,
    q: Vector,
    v: Vector,
    active: Array,
    first_step: Array,
    options: Options,
    few: Array | None = None,
) -> LanePhaseEnd:
    """Integrate every active element from (q, v) to the earliest of its guards.

    Errors are those of `integrate_phase`. In a large batch, as on a GPU, the last `straggler_count`
    elements are cut off if they take `STRAGGLER_FACTOR` times as long as half of the batch. They
    are marked unfinished, to be run again from their start together with other stragglers.
    Derivatives: with respect to `constants`, `held_constants`, `q` and `v`, see `tangents`.
    """
    run = jax.custom_jvp(lambda *given: _ended(phase_of, tableau, None, *given).end)

    @run.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[LanePhaseEnd, LanePhaseEnd]:
        def balance_of(*constants: Any) -> Balance:
            balance = phase_of(*constants).balance
            assert balance is not None
            return balance

        def both(primals: tuple, ways: tuple) -> tuple[LanePhaseEnd, tuple]:
            moved, held, q, v = ways
            start = stacked((*q, *v, *held))
            moving = Moving(balance_of, primals[0], primals[1], moved, start)
            ended = _ended(phase_of, tableau, moving, *primals)
            return ended.end, _end_moved(phase_of, tableau, moving, ended)

        end, (q, v, later, minima) = in_directions(both, primals, tangents[:4])
        nothing = without_derivative(end)
        place = nothing.place._replace(q=q, v=v)
        return end, nothing._replace(place=place, duration=later, minima=minima)

    return run(constants, held, q, v, active, first_step, options, few)


class _Ended(NamedTuple):
    """Steps and end of a phase, and the intermediate results."""

    take: Take
    start: Place
    end: LanePhaseEnd
    march: _March
    lowest: Lowest | None
    least: Settled | None


def _end_moved(
    phase_of: PhaseOf, tableau: Tableau, moving: Moving, ended: _Ended
) -> tuple[Vector, Vector, Array, Array | None]:
    """Return the tangents of a phase's end for tangents of its start and constants.

    They are those of the positions, the rates, the duration, and the minima of the margins.
    """
    take, start, end, march, lowest, least = ended
    n, h = len(start.q), jnp.where(march.verdict == CROSSED, end.duration - march.time, 0.0)
    taken = take(march.here, h)
    assert march.direction is not None
    direction = moving.along(tableau, taken.stages, march.direction, h)

    place, numbers = taken.end, tuple(jnp.moveaxis(direction, 1, 0))
    later = _event_moved(phase_of, moving, place, direction, march, end.guard)
    motion = (*place.v, *place.slope.acceleration[:n])
    told = tuple(x + later * y for x, y in zip(numbers[: 2 * n], motion, strict=True))
    minima = None
    if lowest is not None and least is not None:

        def monitors_of(*constants: Any) -> tuple[Monitors, Evaluate]:
            phase = phase_of(*constants)
            assert phase.monitors is not None
            return phase.monitors, phase.evaluate

        ends, way = (start, end.place), jnp.stack([*told, *numbers[2 * n :]], 1)
        minima = moved_minima(monitors_of, take, tableau, moving, lowest, least, ends, way)
    return told[:n], told[n:], later, minima


def _event_moved(
    phase_of: PhaseOf, moving: Moving, place: Place, direction: Array, march: _March, guard: Array
) -> Array:
    """Return the tangent of the event's time, s: the guard vanishes along the perturbed motion."""

    def guards(constants: Any, held: Vector, q: Vector, v: Vector) -> Vector:
        phase = phase_of(constants, held)
        return phase.guards(Place(q, v, phase.evaluate(q, v)))

    phase = phase_of(moving.constants, moving.held)
    _, rates = with_rates(phase.guards, phase.evaluate, place)
    moves = moving.of_values(guards, place, direction)
    crossed, later = march.verdict == CROSSED, jnp.zeros_like(march.h)
    for index, (rate, move) in enumerate(zip(rates, moves, strict=True)):
        own = crossed & (guard == index) & (rate < 0.0)
        later = jnp.where(own, -move / jnp.where(own, rate, -1.0), later)
    return later


def _ended(
    phase_of: PhaseOf,
    tableau: Tableau,
    moving: Moving | None,
    constants: Any,
    held: Vector,
    q: Vector,
    v: Vector,
    active: Array,
    first_step: Array,
    options: Options,
    few: Array | None,
) -> _Ended:
    """Integrate a phase and locate its event and the minima of its margins."""
    phase = phase_of(constants, held)
    phase = _traced_once(phase, apart if phase.called else jax.jit)
    take = _steps_of(phase, tableau)
    start = Place(q, v, phase.evaluate(q, v))
    values, rates = with_rates(phase.guards, phase.evaluate, start)
    past = tuple((g < 0.0) | ((g == 0.0) & (r <= 0.0)) for g, r in zip(values, rates, strict=True))
    at_once = _first(past)
    begins = active & (at_once < 0)

    march = _march(phase, take, tableau, start, values, begins, first_step, options, few, moving)
    crossed = march.verdict == CROSSED
    if phase.monitors is not None or moving is not None:
        phase = _traced_once(
            phase, apart
        )  # a long program, which the search for minima makes longer
        take = _steps_of(phase, tableau)
    step = Crossing(*march[:2], march.inside, march.beyond, march.h, march.crossing, crossed)
    found = locate(phase.guards, phase.evaluate, take, tableau, step, options)
    lost = crossed & found.open
    duration = march.time + jnp.where(crossed, found.length, 0.0)
    place = select(crossed, found.end, march.here)
    lowest, least = march.lowest, None
    if phase.monitors is not None and lowest is not None:
        given = phase.monitors, phase.evaluate
        taken = Passed(march.here, place, found.length, crossed, march.direction)
        lowest = lowered(*given, lowest, taken)
        first_values = jnp.stack(phase.monitors.values(start))
        least = settled(phase.monitors, take, phase.evaluate, lowest, first_values, options)
    late = crossed & ~found.open & (duration > options.max_phase_time)
    guard = jnp.where(active & (at_once >= 0), at_once, jnp.where(crossed, found.guard, -1))
    end = LanePhaseEnd(
        place=place,
        duration=duration,
        guard=jnp.where(lost | late, -1, guard),
        timed_out=(march.verdict == TIMED_OUT) | late,
        unfinished=march.verdict == MARCHING,
        tried=march.tried + jnp.where(crossed, found.tried, 0),
        next_step=march.h,
        minima=None if least is None else least.lowest,
    )
    return _Ended(take, start, end, march, lowest, least)


def _steps_of(phase: LanePhase, tableau: Tableau) -> Take:
    """Return the phase's step function, which is traced once for all its calls."""
    return jax.jit(lambda here, h: take_step(tableau, phase.evaluate, here, h))


def _traced_once(phase: LanePhase, how: Callable) -> LanePhase:
    """Return the phase with wrapped functions, each of which is traced once for all its calls."""
    monitors = phase.monitors
    if monitors is not None:
        monitors = monitors._replace(values=how(monitors.values))
    return phase._replace(evaluate=how(phase.evaluate), guards=how(phase.guards), monitors=monitors)


def _march(
    phase: LanePhase,
    take: Take,
    tableau: Tableau,
    start: Place,
    values: Vector,
    begins: Array,
    first_step: Array,
    options: Options,
    few: Array | None,
    moving: Moving | None,
) -> _March:
    """Take adaptive steps until each element has crossed a guard, run out of time or failed."""

    def judge(march: _March, taken: Taken, inside: list[Vector], end: Vector) -> tuple:
        """Return the length to try next, in units of this one, and the decision on the step."""
        squared = _squared_error(taken, march.here, end, options.rtol, options.atol)
        to_dip = to_earliest_dip(tableau, [march.values, *inside, end])
        return _change(tableau, squared, to_dip)

    def advance(march: _March) -> _March:
        taken = take(march.here, march.h)
        stages = [phase.guards(taken.stages[i]) for i in tableau.inside]
        end = phase.guards(taken.end)
        change, kept = judge(march, taken, stages, end)
        verdict, crossing, accepted, time, length = _verdict(options, march, change, kept, end)
        here, values = select(accepted, (taken.end, end), (march.here, march.values))
        tried = march.verdict == MARCHING
        inside = stages[tableau.inside.index(tableau.middle)] if stages else march.values
        within, beyond = select(tried, (inside, end), (march.inside, march.beyond))
        lowest, half, direction = march.lowest, march.half, march.direction
        if phase.monitors is not None and lowest is not None:
            given = phase.monitors, phase.evaluate
            step = Passed(march.here, taken.end, march.h, accepted, march.direction)
            lowest = lowered(*given, lowest, step)
        if moving is not None and direction is not None:
            direction = moving.onward(tableau, taken.stages, direction, march.h, accepted)
        if few is not None:
            left = jnp.sum(verdict == MARCHING, dtype=jnp.int32)
            half = jnp.where(2 * left > verdict.size, march.iterations + 1, half)
        return _March(
            here=here,
            values=values,
            h=length,
            time=time,
            verdict=verdict,
            crossing=crossing,
            inside=within,
            beyond=beyond,
            tried=march.tried + tried,
            half=half,
            iterations=march.iterations + 1,
            lowest=lowest,
            direction=direction,
        )

    lowest = phase.monitors and at_start(phase.monitors, phase.evaluate, start, moving)
    begin = _at_start(start, values, begins, first_step, lowest, moving)
    return lax.while_loop(lambda march: _waits(march, few), advance, begin)


def _at_start(
    start: Place,
    values: Vector,
    begins: Array,
    first_step: Array,
    lowest: Lowest | None,
    moving: Moving | None,
) -> _March:
    """Return the state of the integrator before the first step."""
    none, count = jnp.zeros(first_step.shape, jnp.int32), jnp.zeros((), jnp.int32)
    return _March(
        here=start,
        values=values,
        h=first_step,
        time=jnp.zeros_like(first_step),
        verdict=jnp.where(begins, MARCHING, IDLE).astype(jnp.int32),
        crossing=none,
        inside=values,
        beyond=values,
        tried=none,
        half=count,
        iterations=count,
        lowest=lowest,
        direction=None if moving is None else moving.start,
    )


def _waits(march: _March, few: Array | None) -> Array:
    """Return whether enough elements still run to continue the loop."""
    marching = march.verdict == MARCHING
    if few is None:
        return jnp.any(marching)
    left = jnp.sum(marching, dtype=jnp.int32)
    late = march.iterations > LATE * march.half + 8
    return (left > 0) & ~((left <= few) & late)


def _change(tableau: Tableau, squared: Array, to_dip: Array) -> tuple[Array, Array]:
    """Return the length of the next try over this one's, and the decision: keep (1) or
    retry (2).
    """
    keep = squared <= 1.0
    retry = keep & (to_dip < 1.0)
    kept = jnp.where(retry, 2, jnp.where(keep, 1, 0)).astype(jnp.int32)
    return jnp.where(retry, to_dip, change_of_length(tableau, squared, to_dip.dtype)), kept


def _verdict(
    options: Options, march: _March, change: Array, kept: Array, end: Vector
) -> tuple[Array, Array, Array, Array, Array]:
    """Return status, crossing guards, acceptance, time and next length of each element.

    A dip that would not advance the time does not delay the element.
    """
    running = march.verdict == MARCHING
    keep = running & (kept == 1)
    crossing = jnp.zeros_like(march.crossing)
    for index, value in enumerate(end):
        crossing = crossing | jnp.where(value <= 0.0, 1 << index, 0)
    crossed = keep & (crossing > 0)
    accepted = keep & ~crossed
    time = jnp.where(accepted, march.time + march.h, march.time)
    following = march.h * change
    timed_out = accepted & (time >= options.max_phase_time)
    stuck = (march.tried + 1 >= options.max_solver_steps) | (time + following == time)
    verdict = jnp.where(stuck, GAVE_UP, MARCHING)
    verdict = jnp.where(timed_out, TIMED_OUT, jnp.where(crossed, CROSSED, verdict))
    return (
        jnp.where(running, verdict, march.verdict).astype(jnp.int32),
        jnp.where(running, crossing, march.crossing),
        accepted,
        time,
        jnp.where(running & ~crossed, following, march.h),
    )


def _squared_error(taken: Taken, start: Place, guards: Vector, rtol: Array, atol: Array) -> Array:
    """Return the mean square of the error over its tolerance, infinite where the step is not
    finite.

    float32 is precise enough for an error estimate.
    """
    before, after = (*start.q, *start.v), (*taken.end.q, *taken.end.v)
    single = lambda x: x.astype(jnp.float32)
    total: Any = 0.0
    for error, a, b in zip(taken.error, before, after, strict=True):
        allowed = atol + rtol * jnp.maximum(jnp.abs(a), jnp.abs(b))
        ratio = single(error) / single(allowed)
        total = total + ratio * ratio
    for value in guards:
        total = total + single(0.0 * value)
    return jnp.where(jnp.isfinite(total), total / len(before), jnp.inf)


def _first(conditions: tuple[Array, ...]) -> Array:
    """Return the index of the first condition that holds, -1 if none does."""
    index = jnp.full(conditions[0].shape, -1, jnp.int32)
    for i in range(len(conditions) - 1, -1, -1):
        index = jnp.where(conditions[i], i, index)
    return index


def sample_lanes(
    phase: LanePhase,
    tableau: Tableau,
    q: Vector,
    v: Vector,
    duration: Array,
    n_samples: int,
    options: Options,
) -> Array:
    """Return positions, then rates, at equal times of a phase, ends included: (samples,
    ., batch).
    """

    def take(place: Place, length: Array) -> tuple[Place, Array]:
        taken = take_step(tableau, phase.evaluate, place, length)
        return taken.end, _squared_error(taken, place, (), options.rtol, options.atol)

    told = lambda place: jnp.stack([*place.q, *place.v])
    start = Place(q, v, phase.evaluate(q, v))
    return sampled(take, told, start, tableau, duration, n_samples, options)


def sampled(
    take: Callable[[Any, Array], tuple[Any, Array]],
    told: Callable[[Any], Array],
    start: Any,
    tableau: Tableau,
    duration: Array,
    n_samples: int,
    options: Options,
) -> Array:
    """Return `sample_of` the states at equal times, ends included, samples first.

    `step_function(state, length)` returns the end of a step of the tableau, and the square of its
    error over its tolerance.
    """
    none = jnp.zeros((), jnp.int32)

    def advance(now: tuple) -> tuple:
        place, h, left, tried = now
        length = jnp.minimum(h, left)
        end, squared = take(place, length)
        change = change_of_length(tableau, squared, length.dtype)
        keep = squared <= 1.0
        # A step shortened to end at a sample is no reason to reduce the previous length.
        h = jnp.where(keep & (length < h), jnp.maximum(h, length * change), length * change)
        going = left > 0.0
        return (
            select(going & keep, end, place),
            jnp.where(going, h, now[1]),
            jnp.where(going & keep, jnp.where(length == left, 0.0, left - length), left),
            tried + 1,
        )

    def to_next(now: tuple, _: None) -> tuple[tuple, Array]:
        unsettled = lambda now: jnp.any(now[2] > 0.0) & (now[3] < options.max_solver_steps)
        begin = (*now, duration / (n_samples - 1), none)
        place, h, _, _ = lax.while_loop(unsettled, advance, begin)
        return (place, h), told(place)

    first = start, options.first_step + jnp.zeros_like(duration)
    later = lax.scan(to_next, first, None, length=n_samples - 1)[1]
    return jnp.concatenate([told(start)[None], later])

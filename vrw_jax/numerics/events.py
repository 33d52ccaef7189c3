"""Integration of one phase from its start to its earliest event; the only module that uses diffrax.

diffrax's solvers and step-size controller are called step by step, so that an event's state has the
accuracy of the integrator and not of an interpolant. An accepted step that brackets an event is
repeated with a length that Newton's method shortens until it ends on the event. These last steps
are differentiated, so first and second derivatives of the event's state and time are accurate as
well.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.lanes import select, two_fold
from vrw_jax.numerics.minima import (
    Minimum,
    Settling,
    State,
    Step,
    Watched,
    at_rounding,
    cubic,
    cubic_minimum,
    lower,
    no_minimum,
    row_of,
    settle,
)
from vrw_jax.numerics.options import Options
from vrw_jax.numerics.types import Scalar
from vrw_jax.runtime import library

if TYPE_CHECKING:
    import diffrax
else:
    diffrax = library("diffrax")

Field = Callable[[State], State]
"""Autonomous vector field of a phase."""


class PhaseEnd(NamedTuple):
    """End of a phase: state, duration, the guard that ended it and failure flags."""

    state: State
    duration: Scalar  # s
    guard: Int[Array, ""]  # index of the guard that ended it; -1 if none did
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    solver_steps: Int[Array, ""]  # tried, accepted or not
    minima: Float[Array, " n_monitors"]  # of the margins, empty if there are none


STARTING, MARCHING, SEARCHING, SETTLING, DONE = range(5)
"""Purposes of the next solver step, in order: to evaluate the start; to integrate; to locate a
bracketed event; to find the minimum of a margin; none."""


class _Search(NamedTuple):
    """State of Newton's search for the earliest event inside a step that brackets one."""

    crossing: Bool[Array, " n_guards"]
    low: Scalar  # bracket of the event, s from the step's start
    high: Scalar
    accuracy: Scalar  # of the event's time, s
    tries: Int[Array, ""]
    settled: Int[Array, ""]  # consecutive tries that left the event unchanged


class _Loop(NamedTuple):
    """State of the integration of a phase."""

    mode: Int[Array, ""]
    step: Step  # the last accepted step
    length: Scalar  # of the next step to try, s
    controller_state: Any
    search: _Search
    minimum: Minimum
    settling: Settling
    guard: Int[Array, ""]
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    tried: Int[Array, ""]


class _Stepper(NamedTuple):
    """A diffrax solver with its controller, as a function from state and length to state."""

    field: Field
    solver: diffrax.AbstractAdaptiveSolver
    controller: diffrax.PIDController
    term: diffrax.ODETerm

    def start(self, state: State, options: Options) -> tuple[Any, Any]:
        """Return the solver state and the controller state at the start of a phase."""
        zero = jnp.zeros((), state.dtype)
        _, controller_state = self.controller.init(
            self.term,
            zero,
            options.first_step,
            lax.stop_gradient(state),
            options.first_step,
            None,
            lambda terms, t, y, args: terms.vf(t, y, args),
            self.solver.error_order(self.term),
        )
        return self.solver_state(state, options), controller_state

    def solver_state(self, state: State, options: Options) -> Any:
        """Return the solver's internal state at a state of the system."""
        zero = jnp.zeros((), state.dtype)
        return self.solver.init(self.term, zero, options.first_step, state, None)

    def step(self, state: State, solver_state: Any, length: Scalar) -> tuple[State, State, Any]:
        """Return the state after `length`, its error estimate and the solver state there."""
        zero = jnp.zeros_like(length)
        end, error, _, solver_state, result = self.solver.step(
            self.term, zero, length, state, None, solver_state, jnp.asarray(False)
        )
        if error is None:
            raise ValueError(f"{type(self.solver).__name__} gives no error estimate.")
        error = jnp.where(result == diffrax.RESULTS.successful, error, jnp.inf)
        return end, error, solver_state

    def judge(
        self, start: State, end: State, error: State, length: Scalar, controller_state: Any
    ) -> tuple[Bool[Array, ""], Scalar, Any]:
        """Return whether the step is kept, the length of the next step, and the controller's state.

        Nothing here is differentiated: derivatives are those of the steps taken.
        """
        start, end, error = lax.stop_gradient((start, end, error))
        finite = jnp.all(jnp.isfinite(end))
        keep, next_start, next_end, _, controller_state, _ = self.controller.adapt_step_size(
            jnp.zeros_like(length),
            length,
            start,
            jnp.where(finite, end, start),
            None,
            jnp.where(finite, error, jnp.inf),
            self.solver.error_order(self.term),  # type: ignore[arg-type]
            controller_state,
        )
        return jnp.asarray(keep), jnp.asarray(next_end - next_start), controller_state


def solver_named(name: str, options: Options) -> diffrax.AbstractAdaptiveSolver:
    """Return the diffrax solver with this name, configured for forward-mode derivatives."""
    solver_class = getattr(diffrax, name, None)
    if not (
        isinstance(solver_class, type) and issubclass(solver_class, diffrax.AbstractAdaptiveSolver)
    ):
        raise ValueError(
            f"solver is {name!r}, but it must name a diffrax solver with an error estimate: "
            "take 'Dopri8', 'Tsit5', 'Dopri5', 'Kvaerno3' or 'Kvaerno5'."
        )
    fields = getattr(solver_class, "__dataclass_fields__", {})
    keywords: dict[str, Any] = {}
    if "scan_kind" in fields:
        keywords["scan_kind"] = "lax"
    if "root_finder" in fields:
        tolerances: dict[str, Any] = {"rtol": options.rtol, "atol": options.atol}
        keywords["root_finder"] = diffrax.VeryChord(**tolerances)
    return solver_class(**keywords)


def _stepper(field: Field, options: Options) -> _Stepper:
    return _Stepper(
        field=field,
        solver=solver_named(options.solver, options),
        controller=diffrax.PIDController(
            rtol=options.rtol, atol=options.atol, factormax=STEP_GROWTH
        ),
        term=diffrax.ODETerm(lambda t, y, args: field(y)),
    )


def integrate_phase(
    field: Field,
    watched: Watched,
    start: State,
    active: Bool[Array, ""],
    options: Options,
) -> PhaseEnd:
    """Integrate `field` from `start` until the earliest guard reaches zero from above.

    A guard that is negative at the start, or zero and not rising, ends the phase immediately with
    duration 0; a guard that is zero and rising does not fire. A guard that dips below zero and
    returns within one step is detected: where the step's cubic through values and rates dips, the
    step is repeated up to the dip. With `active` False nothing is integrated. If two guards vanish
    together, the first in the list counts. Errors are those of the solver at the tolerances in
    `options`.
    """
    task = _Task(_stepper(field, options), watched, options)
    loop = lax.while_loop(
        lambda loop: two_fold(loop.mode != DONE, loop.tried),
        functools.partial(_advance, task),
        _begin(task, start, active),
    )
    minima = jnp.minimum(loop.settling.lowest, loop.step.values[watched.n_guards :])
    return PhaseEnd(
        state=loop.step.state,
        duration=loop.step.time,
        guard=loop.guard,
        timed_out=loop.timed_out,
        gave_up=loop.gave_up,
        solver_steps=loop.tried,
        minima=minima,
    )


class _Task(NamedTuple):
    """Constants of a phase's loop."""

    stepper: _Stepper
    watched: Watched
    options: Options


def _begin(task: _Task, start: State, active: Bool[Array, ""]) -> _Loop:
    """Return the state of the loop before the first step.

    Every number of the loop's state is batched, and perturbed where it will be, from the start.
    Otherwise JAX would trace the loop again for each round in which these properties spread.
    """
    stepper, watched, options = task
    zero = 0.0 * start[0]
    none = jnp.where(active, 0, 0).astype(jnp.int32)
    nothing = jnp.zeros(jax.eval_shape(watched.values, start).shape, start.dtype) + zero
    no = active & False
    fixed = lax.stop_gradient(zero)
    solver_state, controller_state = stepper.start(start, options)
    crossing = jnp.zeros((watched.n_guards,), bool) | no
    return _Loop(
        mode=jnp.where(active, STARTING, DONE).astype(jnp.int32),
        step=Step(zero, start, solver_state, nothing, nothing),
        length=zero,  # the first step has length zero: it evaluates the start
        controller_state=jax.tree.map(lambda x: x + fixed, controller_state),
        search=_Search(crossing, fixed, fixed, fixed, none, none),
        minimum=no_minimum(watched, start),
        settling=Settling(none, none, fixed, fixed, nothing[watched.n_guards :] + jnp.inf),
        guard=none - 1,
        timed_out=no,
        gave_up=no,
        tried=none,
    )


def _advance(task: _Task, loop: _Loop) -> _Loop:
    """Take one solver step, and update the search for the event and for minima."""
    _, watched, options = task
    n, here, length, search = watched.n_guards, loop.step, loop.length, loop.search
    starting, searching = loop.mode == STARTING, loop.mode == SEARCHING
    step, error = _taken(task, loop)
    guards, rates = step.values[:n], step.rates[:n]
    past = (guards < 0.0) | ((guards == 0.0) & (rates <= 0.0))
    ends_at_once = starting & jnp.any(past)
    marched = _marched(task, loop, step, error)
    found = _searched(search, guards, rates, length)
    close = jnp.abs(found.length - length) <= search.accuracy
    there, beside = at_rounding(watched, search.crossing, guards)
    found = found._replace(guard=jnp.where(there, beside, found.guard))
    settled = search.settled + (searching & (close | there))
    arrived = searching & (settled >= SETTLED)

    timed_out = marched.accepted & (step.time >= options.max_phase_time)
    timed_out = timed_out | (arrived & (step.time > options.max_phase_time))
    stuck = marched.stuck | (searching & ~arrived & (search.tries >= options.event_steps))
    ends = ends_at_once | arrived | timed_out | stuck
    mode = jnp.where(starting, MARCHING, loop.mode)
    mode = jnp.where(ends, DONE, jnp.where(marched.crossed, SEARCHING, mode)).astype(jnp.int32)
    following = jnp.where(searching, found.length, lax.stop_gradient(marched.following))
    counts = (marched.accepted & ~starting) | arrived
    minimum = lower(watched, loop.minimum, here, step, length, counts)
    settling = loop.settling
    if watched.count_start:
        was_on = loop.mode == SETTLING
        settling, on, to_minimum = settle(
            settling, watched, minimum, step, length, was_on, starting, ends, options.monitor_steps
        )
        mode = jnp.where(on, SETTLING, jnp.where(was_on, DONE, mode))
        following = jnp.where(on, to_minimum, following)
    return _Loop(
        mode=mode,
        step=select(marched.accepted | arrived, step, here),
        length=following,
        controller_state=marched.controller_state,
        search=_Search(
            crossing=jnp.where(marched.crossed, marched.crossing, search.crossing),
            low=jnp.where(marched.crossed, 0.0, found.low),
            high=jnp.where(marched.crossed, lax.stop_gradient(length), found.high),
            accuracy=jnp.where(marched.crossed, marched.accuracy, search.accuracy),
            tries=search.tries + searching,
            settled=settled,
        ),
        minimum=minimum,
        settling=settling,
        guard=jnp.where(
            ends_at_once,
            jnp.argmax(past).astype(jnp.int32),
            jnp.where(arrived & ~timed_out, found.guard, loop.guard),
        ),
        timed_out=timed_out | loop.timed_out,
        gave_up=stuck | loop.gave_up,
        tried=marched.tried,
    )


def _taken(task: _Task, loop: _Loop) -> tuple[Step, Array]:
    """Return the step to try, with the monitored functions at its end, and its error.

    One call of the solver and of the monitored functions serves every mode, so that the code is
    compiled once.
    """
    stepper, watched, options = task
    left = loop.step.state, loop.step.solver_state
    if watched.count_start:
        place = row_of(loop.settling.monitor, loop.minimum.left)
        again = place, stepper.solver_state(place, options)
        left = select(loop.mode == SETTLING, again, left)
    end, error, solver_state = stepper.step(*left, loop.length)
    values, rates = jax.jvp(watched.values, (end,), (stepper.field(end),))
    error = jnp.where(jnp.all(jnp.isfinite(values)), error, jnp.inf)
    return Step(loop.step.time + loop.length, end, solver_state, values, rates), error


class _Marched(NamedTuple):
    """Assessment of a tried solver step."""

    accepted: Bool[Array, ""]  # the start counts as accepted
    crossed: Bool[Array, ""]  # it brackets an event
    crossing: Bool[Array, " n_guards"]  # of which guards
    stuck: Bool[Array, ""]
    following: Scalar  # length of the next step, s
    accuracy: Scalar  # of the event's time, s
    controller_state: Any
    tried: Int[Array, ""]


def _marched(task: _Task, loop: _Loop, step: Step, error: Array) -> _Marched:
    """Accept or reject the step, and detect crossings and dips within it."""
    stepper, watched, options = task
    n, here, length = watched.n_guards, loop.step, loop.length
    starting, marching = loop.mode == STARTING, loop.mode == MARCHING
    nominal = jnp.where(starting, options.first_step, length)
    keep, next_length, controller_state = stepper.judge(
        here.state, step.state, error, nominal, loop.controller_state
    )
    keep = keep & marching
    crossing = step.values[:n] <= 0.0
    places, dips = _dips(here, step.values, step.rates, length, n)
    to_dip = length * jnp.min(jnp.where(dips & ~crossing, places, 1.0))
    retry = keep & (to_dip < length)
    crossed = keep & jnp.any(crossing) & ~retry
    tried = loop.tried + (loop.mode != SETTLING)
    no_way = (tried >= options.max_solver_steps) | (here.time + next_length == here.time)
    following = jnp.where(starting, options.first_step, next_length)
    following = jnp.where(retry, to_dip, following)
    guess = _first_guess(here, step.values, step.rates, length, n, crossing)
    resolution = 1e3 * jnp.finfo(length.dtype).eps * step.time
    return _Marched(
        accepted=starting | (keep & ~crossed & ~retry),
        crossed=crossed,
        crossing=crossing,
        stuck=marching & ~crossed & no_way,
        following=jnp.where(crossed, guess, following),
        accuracy=lax.stop_gradient(jnp.maximum(options.rtol * length, resolution)),
        controller_state=select(marching & ~retry, controller_state, loop.controller_state),
        tried=tried,
    )


STEP_GROWTH = 2.0
"""Largest factor by which a step may exceed the one before it.

It is chosen because the error estimate of a step far shorter than needed is round-off, and so would
be a length grown from it without bound. A batch element would then differ from the same element
alone by 1e-12, more than a hundred times its round-off.
"""
SETTLED = 3
"""Number of tries at the located event before it counts.

It is chosen because the first try makes the event's time accurate to first order in its derivatives
and the second to third order; the last evaluates the state there.
"""


def _dips(
    here: Step, values: Array, rates: Array, length: Scalar, n_guards: int
) -> tuple[Array, Array]:
    """Return fractions in (0, 1) to step to first for guards that may dip, and whether they may
    dip.

    The cubic through values and rates does not fall below the least of its Bernstein coefficients,
    so a guard with positive coefficients does not dip. Otherwise the step is repeated up to the
    cubic's minimum, at most nine tenths of it. Shorter steps have coefficients closer to the guard,
    until these are positive or a step ends in the dip.
    """
    v0, r0, v1, r1 = lax.stop_gradient((here.values, here.rates, values, rates))
    v0, r0, v1, r1 = v0[:n_guards], r0[:n_guards], v1[:n_guards], r1[:n_guards]
    length = lax.stop_gradient(length)
    first, second = v0 + r0 * length / 3.0, v1 - r1 * length / 3.0
    places = jnp.clip(cubic_minimum(v0, r0 * length, v1, r1 * length)[0], 0.1, 0.9)
    new = here.time + places * length > here.time
    return places, (jnp.minimum(first, second) <= 0.0) & (r1 >= 0.0) & new


def _first_guess(
    here: Step, values: Array, rates: Array, length: Scalar, n_guards: int, crossing: Array
) -> Scalar:
    """Return the length to the earliest crossing of the guards' cubics: secant, then Newton's
    method.
    """
    v0, r0, v1, r1 = lax.stop_gradient((here.values, here.rates * length, values, rates * length))
    v0, r0, v1, r1 = v0[:n_guards], r0[:n_guards], v1[:n_guards], r1[:n_guards]
    fall = jnp.where(crossing & (v0 > v1), v0 - v1, 1.0)
    at = jnp.where(crossing, jnp.clip(v0 / fall, 0.0, 1.0), 1.0)
    # A guard that rises from zero, or from round-off above it: the cubic over x has the root.
    linear, square = 3.0 * v1 - 2.0 * r0 - r1, r0 - 2.0 * v1 + r1
    root = jnp.sqrt(jnp.maximum(linear * linear - 4.0 * r0 * square, 0.0)) - linear
    other = jnp.clip(2.0 * r0 / jnp.where(root > 0.0, root, 1.0), 0.0, 1.0)
    slope = lambda at: (
        6.0 * at * (at - 1.0) * (v0 - v1)
        + (1.0 - at) * (1.0 - 3.0 * at) * r0
        + at * (3.0 * at - 2.0) * r1
    )
    climbs = crossing & (r0 > 0.0) & ((v0 == 0.0) | (slope(at) >= 0.0))
    at = jnp.where(climbs, other, at)
    for _ in range(3):
        falls = (steep := slope(at)) < 0.0
        change = cubic(at, v0, r0, v1, r1) / jnp.where(falls, steep, 1.0)
        at = jnp.where(crossing & falls, jnp.clip(at - change, 0.0, 1.0), at)
    return lax.stop_gradient(length) * jnp.min(jnp.where(crossing, at, 1.0))


class _Found(NamedTuple):
    """Newton's next proposal for an event's time, and the remaining bracket."""

    length: Scalar
    guard: Int[Array, ""]
    low: Scalar
    high: Scalar


def _searched(search: _Search, guards: Array, rates: Array, length: Scalar) -> _Found:
    """Return the earliest of the times that the crossing guards propose.

    Bisection keeps the proposal inside the shrinking bracket. The proposal carries derivatives:
    after k proposals in the quadratic regime, derivatives are accurate to order 2^k - 1.
    """
    falling = search.crossing & (rates < 0.0)
    change = -guards / jnp.where(falling, rates, -1.0)
    # A guard that rises below zero has crossed at an unknown earlier time.
    unknown = jnp.where(search.crossing & (guards < 0.0), -jnp.inf, jnp.inf)
    proposals = jnp.where(falling, length + change, unknown)
    guard = jnp.argmin(proposals).astype(jnp.int32)
    rising = (guards == 0.0) & (rates > 0.0)  # at the start of the step
    before = jnp.all(jnp.where(search.crossing, (guards > 0.0) | rising, True))
    low = jnp.where(before, lax.stop_gradient(length), search.low)
    high = jnp.where(before, search.high, lax.stop_gradient(length))
    proposal = proposals[guard]
    # A proposal within round-off of a collapsed bracket counts as inside.
    inside = (proposal >= low - search.accuracy) & (proposal <= high + search.accuracy)
    # If round-off moves Newton's proposal out of the bracket, its derivative is still valid.
    known = jnp.where(jnp.isfinite(proposal), proposal, 0.0)
    halved = 0.5 * (low + high) + (known - lax.stop_gradient(known))
    following = jnp.where(inside, known, halved)
    return _Found(following, guard, low, high)


def sample_phase(
    field: Field, start: State, duration: Scalar, n_samples: int, options: Options
) -> Float[Array, "n_samples dim"]:
    """Return the states at `n_samples` equal times of a phase, both ends included, at solver
    accuracy.
    """
    stepper = _stepper(field, options)
    interval = duration / (n_samples - 1)

    def to_next(state: State, _sample: None) -> tuple[State, State]:
        following = _march(stepper, state, interval, options)
        return following, following

    _, states = lax.scan(to_next, start, None, length=n_samples - 1)
    return jnp.concatenate([start[None], states])


def _march(stepper: _Stepper, state: State, interval: Scalar, options: Options) -> State:
    """Return the state after `interval`, by adaptive steps of which the last ends exactly there."""

    def advance(carry: tuple) -> tuple:
        time, state, solver_state, length, controller_state, tried = carry
        step_length = jnp.minimum(length, interval - time)
        end, error, end_solver_state = stepper.step(state, solver_state, step_length)
        keep, next_length, controller_state = stepper.judge(
            state, end, error, step_length, controller_state
        )
        last = keep & (step_length >= interval - time)
        time = jnp.where(last, interval, jnp.where(keep, time + step_length, time))
        state, solver_state = select(keep, (end, end_solver_state), (state, solver_state))
        return time, state, solver_state, next_length, controller_state, tried + 1

    unfinished = lambda c: (c[0] < interval) & (c[-1] < options.max_solver_steps)
    none = jnp.zeros((), jnp.int32)
    solver_state, controller_state = stepper.start(state, options)
    zero = jnp.zeros_like(interval)
    carry = (zero, state, solver_state, zero + options.first_step, controller_state, none)
    return lax.while_loop(unfinished, advance, carry)[1]

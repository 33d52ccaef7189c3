"""One phase from its start to the earliest of its events: the only room that knows diffrax.

diffrax's solvers and step-size controller are stepped by hand, so that an event's state has the
accuracy of the integrator and not of an interpolant: an accepted step that brackets an event is
taken again, shortened by Newton's method until it ends on the event. Those last re-steps are
differentiated, hence first and second derivatives of event state and time hold as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.lazy import diffrax
from vrw_jax.options import Options
from vrw_jax.params import Scalar

State = Float[Array, " dim"]
Field = Callable[[State], State]
"""Autonomous vector field of a phase."""
Watch = Callable[[State], Float[Array, " n_watched"]]
"""Guards and monitors as functions of the state."""


class Watched(NamedTuple):
    """What to watch along a phase: guards that end it, then monitors whose minimum is wanted.

    `values` returns the `n_guards` guards followed by the monitors. A monitor's minimum is sought
    at every interior local minimum and at the phase's end; at its start too (`count_start`), unless
    the quantity is zero there by construction, like the height of a foot that leaves the ground.
    """

    values: Watch
    n_guards: int
    count_start: tuple[bool, ...] = ()


class PhaseEnd(NamedTuple):
    """Where and how a phase ended."""

    state: State
    duration: Scalar  # s
    guard: Int[Array, ""]  # index of the guard that ended it; -1 if none did
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    solver_steps: Int[Array, ""]  # tried, accepted or not
    minima: Float[Array, " n_monitors"]  # of the monitors, empty without


class _Step(NamedTuple):
    """The end of the last accepted step: what a rejected step leaves as it is."""

    time: Scalar
    state: State
    solver_state: Any
    values: Float[Array, " n_watched"]
    rates: Float[Array, " n_watched"]


class _Search(NamedTuple):
    """Newton's search for the earliest event inside a step that brackets one."""

    on: Bool[Array, ""]
    crossing: Bool[Array, " n_guards"]
    low: Scalar  # bracket of the event, s from the step's start
    high: Scalar
    accuracy: Scalar  # of the event's time, s
    tries: Int[Array, ""]
    settled: Int[Array, ""]  # tries that no longer moved the event


class _Minimum(NamedTuple):
    """Lowest interior minimum so far of each monitor, and the step that holds it."""

    value: Float[Array, " n"]
    left: Float[Array, "n dim"]
    length: Float[Array, " n"]  # of the step from `left`, s
    offset: Float[Array, " n"]  # of the minimum from `left`, s
    rate_left: Float[Array, " n"]


class _Loop(NamedTuple):
    step: _Step
    length: Scalar  # of the next step to try, s
    controller_state: Any
    search: _Search
    minimum: _Minimum
    running: Bool[Array, ""]
    guard: Int[Array, ""]
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    tried: Int[Array, ""]


class _Stepper(NamedTuple):
    """A diffrax solver with its controller, seen as a function from state and length to state."""

    field: Field
    solver: diffrax.AbstractAdaptiveSolver
    controller: diffrax.PIDController
    term: diffrax.ODETerm

    def start(self, state: State, options: Options) -> tuple[Any, Any]:
        """Solver state and controller state at the start of a phase."""
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
        return self.solver.init(self.term, zero, options.first_step, state, None), controller_state

    def step(self, state: State, solver_state: Any, length: Scalar) -> tuple[State, State, Any]:
        """State after `length`, its error estimate and the solver state there."""
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
        """Whether to keep the step, the length of the next, and the controller's state.

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
    """The diffrax solver of that name, ready for forward-mode derivatives."""
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


def _cubic(x: Array, v0: Array, r0: Array, v1: Array, r1: Array) -> Array:
    """Cubic Hermite interpolant on [0, 1]; the rates are already times the length."""
    return (
        (1 + 2 * x) * (1 - x) ** 2 * v0
        + x * (1 - x) ** 2 * r0
        + x * x * (3 - 2 * x) * v1
        + x * x * (x - 1) * r1
    )


def _cubic_minimum(v0: Array, r0: Array, v1: Array, r1: Array) -> tuple[Array, Array]:
    """Place in (0, 1) and value of the cubic's interior minimum; value inf where there is none."""
    a = 3.0 * (2.0 * v0 + r0 - 2.0 * v1 + r1)
    b = 2.0 * (-3.0 * v0 - 2.0 * r0 + 3.0 * v1 - r1)
    discriminant = b * b - 4.0 * a * r0
    root = jnp.sqrt(jnp.where(discriminant > 0.0, discriminant, 1.0))
    # The minimum is the root with positive curvature, written without cancellation.
    denominator = jnp.where(b >= 0.0, -(b + root), 2.0 * a)
    numerator = jnp.where(b >= 0.0, 2.0 * r0, root - b)
    safe = jnp.where(denominator == 0.0, 1.0, denominator)
    x = jnp.where(denominator == 0.0, -1.0, numerator / safe)
    exists = (discriminant > 0.0) & (x > 0.0) & (x < 1.0)
    x = jnp.where(exists, x, 0.5)
    return x, jnp.where(exists, _cubic(x, v0, r0, v1, r1), jnp.inf)


def integrate_phase(
    field: Field,
    watched: Watched,
    start: State,
    active: Bool[Array, ""],
    options: Options,
) -> PhaseEnd:
    """Follow `field` from `start` until the earliest guard reaches zero from above.

    A guard that is negative at the start, or zero and not rising, ends the phase at once with
    duration 0; one that is zero and rising does not fire. A guard that dips below zero and comes
    back within one step is found: where the step's cubic through values and rates dips, the step
    is retried up to the dip. With `active` False nothing is integrated. Two guards at once: the
    first in the list wins. Errors are those of the solver at `options`' tolerances.
    """
    stepper = _stepper(field, options)
    n_guards = watched.n_guards
    # Every number that the loop carries is batched, and perturbed where it will be, from the start:
    # JAX would otherwise trace the loop again for each round in which that spreads.
    zero = 0.0 * start[0]
    none = jnp.where(active, 0, 0).astype(jnp.int32)
    nothing = jnp.zeros(jax.eval_shape(watched.values, start).shape, start.dtype) + zero
    no = active & False
    fixed = lax.stop_gradient(zero)
    solver_state, controller_state = stepper.start(start, options)
    controller_state = jax.tree.map(lambda x: x + fixed, controller_state)
    loop = _Loop(
        step=_Step(zero, start, solver_state, nothing, nothing),
        length=zero,  # the first step has no length: it evaluates the start
        controller_state=controller_state,
        search=_Search(no, jnp.zeros((n_guards,), bool) | no, fixed, fixed, fixed, none, none),
        minimum=_no_minimum(watched, start),
        running=active,
        guard=none - 1,
        timed_out=no,
        gave_up=no,
        tried=none,
    )

    def advance(loop: _Loop) -> _Loop:
        """Take one step and judge it: march on, begin or go on searching an event, or end.

        One call of solver and watch serves the evaluation of the start, marching and searching:
        code compiled once.
        """
        here, length, search = loop.step, loop.length, loop.search
        end, error, solver_state = stepper.step(here.state, here.solver_state, length)
        values, rates = jax.jvp(watched.values, (end,), (stepper.field(end),))
        guards, guard_rates = values[:n_guards], rates[:n_guards]
        starting, marching = loop.tried == 0, (loop.tried > 0) & ~search.on

        # At the start: a guard that is past, or on its way, ends the phase at once.
        past = (guards < 0.0) | ((guards == 0.0) & (guard_rates <= 0.0))
        ends_at_once = starting & jnp.any(past)

        # Marching: keep the step, or try another; look for crossings, and for dips within.
        error = jnp.where(jnp.all(jnp.isfinite(values)), error, jnp.inf)
        keep, next_length, next_controller_state = stepper.judge(
            here.state,
            end,
            error,
            jnp.where(starting, options.first_step, length),
            loop.controller_state,
        )
        keep = keep & marching
        crossing = guards <= 0.0
        places, dips = _dips(here, values, rates, length, n_guards)
        to_dip = length * jnp.min(jnp.where(dips & ~crossing, places, 1.0))
        retry = keep & (to_dip < length)
        crossed = keep & jnp.any(crossing) & ~retry
        accepted = starting | (keep & ~crossed & ~retry)

        # Searching: Newton's next proposal from this one.
        found = _searched(search, guards, guard_rates, length, crossed, crossing)
        settles = search.on & (jnp.abs(found.length - length) <= search.accuracy)
        settled = search.settled + settles
        arrived = search.on & (settled >= SETTLED)

        time = here.time + length
        step = _Step(time, end, solver_state, values, rates)
        timed_out = accepted & (time >= options.max_phase_time)
        tried = loop.tried + 1
        stuck = (search.on & ~arrived & (search.tries >= options.event_steps)) | (
            marching
            & ~crossed
            & ((tried >= options.max_solver_steps) | (here.time + next_length == here.time))
        )
        guess = _first_guess(here, values, rates, length, n_guards, crossing)
        following = jnp.where(starting, options.first_step, next_length)
        following = jnp.where(retry, to_dip, following)
        following = jnp.where(crossed, guess, following)
        resolution = 1e3 * jnp.finfo(length.dtype).eps * time
        return _Loop(
            step=_select(accepted | arrived, step, here),
            length=jnp.where(search.on, found.length, lax.stop_gradient(following)),
            controller_state=_select(
                marching & ~retry, next_controller_state, loop.controller_state
            ),
            search=_Search(
                on=search.on | crossed,
                crossing=jnp.where(crossed, crossing, search.crossing),
                low=jnp.where(crossed, 0.0, found.low),
                high=jnp.where(crossed, lax.stop_gradient(length), found.high),
                accuracy=jnp.where(
                    crossed,
                    lax.stop_gradient(jnp.maximum(options.rtol * length, resolution)),
                    search.accuracy,
                ),
                tries=search.tries + search.on,
                settled=settled,
            ),
            minimum=_lower(
                watched, loop.minimum, here, step, length, (accepted & marching) | arrived
            ),
            running=~(ends_at_once | arrived | timed_out | stuck),
            guard=jnp.where(
                ends_at_once,
                jnp.argmax(past).astype(jnp.int32),
                jnp.where(arrived, found.guard, loop.guard),
            ),
            timed_out=timed_out,
            gave_up=stuck,
            tried=tried,
        )

    loop = lax.while_loop(lambda loop: loop.running, advance, loop)
    minima = jnp.zeros((0,), start.dtype)
    if watched.count_start:
        minima = _settle(stepper, watched, loop.minimum, start, loop.step, options)
    return PhaseEnd(
        state=loop.step.state,
        duration=loop.step.time,
        guard=loop.guard,
        timed_out=loop.timed_out,
        gave_up=loop.gave_up,
        solver_steps=loop.tried,
        minima=minima,
    )


STEP_GROWTH = 2.0
"""Most that a step may outgrow the one before it. The error estimate of a step far shorter than
needed is rounding, and so would be a length grown from it without bound: a lane would then differ
from itself alone by 1e-12, more than a hundred times its round-off."""
SETTLED = 3
"""Tries at the located event before it counts: the first makes the event's time right to first
order in its derivatives, the second to third order, the last evaluates the state there."""


def _select(condition: Any, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _dips(
    here: _Step, values: Array, rates: Array, length: Scalar, n_guards: int
) -> tuple[Array, Array]:
    """Places in (0, 1) where a guard that falls and rises again is lowest, and whether to look.

    Where the lowest point of the cubic through values and rates is near or below zero, compared
    with the guard's change over the step (the cubic's own error is a small part of that), the step
    is taken again up to that point: either the guard has crossed there, or the march goes on from
    its lowest point. A point no lower than the step's start by 1 % of what is left is not new.
    """
    v0, r0, v1, r1 = lax.stop_gradient((here.values, here.rates, values, rates))
    v0, r0, v1, r1 = v0[:n_guards], r0[:n_guards], v1[:n_guards], r1[:n_guards]
    length = lax.stop_gradient(length)
    places, lows = _cubic_minimum(v0, r0 * length, v1, r1 * length)
    near = lows <= 0.25 * (jnp.maximum(v0, v1) - lows)
    new = (v0 - lows > 0.01 * lows) & (here.time + places * length > here.time)
    return places, (r0 < 0.0) & (r1 >= 0.0) & near & new


def _first_guess(
    here: _Step, values: Array, rates: Array, length: Scalar, n_guards: int, crossing: Array
) -> Scalar:
    """Length to the earliest crossing by the guards' cubics: secant, then Newton's method."""
    v0, r0, v1, r1 = lax.stop_gradient((here.values, here.rates * length, values, rates * length))
    v0, r0, v1, r1 = v0[:n_guards], r0[:n_guards], v1[:n_guards], r1[:n_guards]
    fall = jnp.where(crossing & (v0 > v1), v0 - v1, 1.0)
    at = jnp.where(crossing, jnp.clip(v0 / fall, 0.0, 1.0), 1.0)
    for _ in range(3):
        slope = (
            6.0 * at * (at - 1.0) * (v0 - v1)
            + (1.0 - at) * (1.0 - 3.0 * at) * r0
            + at * (3.0 * at - 2.0) * r1
        )
        falls = slope < 0.0
        change = _cubic(at, v0, r0, v1, r1) / jnp.where(falls, slope, 1.0)
        at = jnp.where(crossing & falls, jnp.clip(at - change, 0.0, 1.0), at)
    return lax.stop_gradient(length) * jnp.min(jnp.where(crossing, at, 1.0))


class _Found(NamedTuple):
    """Newton's next proposal for an event's time, and the bracket that is left."""

    length: Scalar
    guard: Int[Array, ""]
    low: Scalar
    high: Scalar


def _searched(
    search: _Search,
    guards: Array,
    rates: Array,
    length: Scalar,
    crossed: Bool[Array, ""],
    crossing: Bool[Array, " n_guards"],
) -> _Found:
    """Every guard that crosses proposes its own time and the earliest is taken.

    Kept inside the shrinking bracket by bisection. The proposal carries derivatives: after k of
    them in the quadratic regime, derivatives are right to order 2^k - 1.
    """
    falling = search.crossing & (rates < 0.0)
    change = -guards / jnp.where(falling, rates, -1.0)
    proposals = jnp.where(falling, length + change, jnp.inf)
    guard = jnp.argmin(proposals).astype(jnp.int32)
    before = jnp.all(jnp.where(search.crossing, guards > 0.0, True))
    low = jnp.where(before, lax.stop_gradient(length), search.low)
    high = jnp.where(before, search.high, lax.stop_gradient(length))
    proposal = proposals[guard]
    # Within rounding of a collapsed bracket counts as inside: bisection has no derivative.
    inside = (proposal >= low - search.accuracy) & (proposal <= high + search.accuracy)
    following = jnp.where(inside, jnp.where(inside, proposal, 0.0), 0.5 * (low + high))
    return _Found(following, guard, low, high)


def _no_minimum(watched: Watched, start: State) -> _Minimum:
    n = len(watched.count_start)
    zeros = jnp.zeros((n,), start.dtype)
    return _Minimum(zeros + jnp.inf, jnp.tile(start, (n, 1)), zeros, zeros, zeros)


def _lower(
    watched: Watched,
    minimum: _Minimum,
    left: _Step,
    right: _Step,
    length: Scalar,
    counts: Bool[Array, ""],
) -> _Minimum:
    """Keep the step in which a monitor turns from falling to rising, if it is the lowest yet.

    A monitor that is zero at the phase's start is at rest there: rounding must not make it fall.
    """
    if not watched.count_start:
        return minimum
    v0, r0, v1, r1 = (
        lax.stop_gradient(v)[watched.n_guards :]
        for v in (left.values, left.rates, right.values, right.rates)
    )
    at_rest = (left.time == 0.0) & ~jnp.asarray(watched.count_start)
    r0 = jnp.where(at_rest, jnp.maximum(r0, 0.0), r0)
    length = lax.stop_gradient(length)
    x, value = _cubic_minimum(v0, r0 * length, v1, r1 * length)
    value = jnp.where(jnp.isfinite(value), value, jnp.minimum(v0, v1))
    better = counts & (r0 < 0.0) & (r1 >= 0.0) & (value < minimum.value)
    return _Minimum(
        jnp.where(better, value, minimum.value),
        jnp.where(better[:, None], left.state, minimum.left),
        jnp.where(better, length, minimum.length),
        jnp.where(better, x * length, minimum.offset),
        jnp.where(better, r0, minimum.rate_left),
    )


def _settle(
    stepper: _Stepper,
    watched: Watched,
    minimum: _Minimum,
    start: State,
    end: _Step,
    options: Options,
) -> Float[Array, " n_monitors"]:
    """Each monitor's minimum over the phase, to the integrator's accuracy.

    Secant steps on the rate, each a re-step from the left end of the step that holds the minimum.
    """
    found = jnp.isfinite(minimum.value)

    def refine(
        index: Array, left: State, length: Scalar, offset: Scalar, rate_left: Scalar
    ) -> Scalar:
        zero = jnp.zeros_like(length)
        solver_state = stepper.solver.init(stepper.term, zero, length, left, None)

        def secant(carry: tuple, _iteration: None) -> tuple:
            offset, at, rate_at, _ = carry
            state, _, _ = stepper.step(left, solver_state, offset)
            values, rates = jax.jvp(watched.values, (state,), (stepper.field(state),))
            value, rate = values[index], rates[index]
            fixed_rate, fixed_offset = lax.stop_gradient((rate, offset))
            gap = fixed_offset - at
            slope = (fixed_rate - rate_at) / jnp.where(gap == 0.0, 1.0, gap)
            usable = (gap != 0.0) & (slope > 0.0)
            following = offset - jnp.where(usable, rate / jnp.where(usable, slope, 1.0), 0.0)
            following = jnp.clip(following, 0.0, length)
            nearer = jnp.abs(fixed_rate) < jnp.abs(rate_at)
            at, rate_at = _select(nearer, (fixed_offset, fixed_rate), (at, rate_at))
            return (following, at, rate_at, value), None

        carry = (offset, zero, rate_left, zero)
        carry, _ = lax.scan(secant, carry, None, length=options.monitor_steps)
        return carry[-1]

    length, offset, rate_left = lax.stop_gradient(
        (minimum.length, minimum.offset, minimum.rate_left)
    )
    indices = watched.n_guards + jnp.arange(len(watched.count_start))
    values = jax.vmap(refine)(
        indices,
        minimum.left,
        jnp.where(found, length, 0.0),
        jnp.where(found, offset, 0.0),
        rate_left,
    )
    at_start = watched.values(start)[watched.n_guards :]
    at_start = jnp.where(jnp.asarray(watched.count_start), at_start, jnp.inf)
    edges = jnp.minimum(at_start, end.values[watched.n_guards :])
    return jnp.minimum(jnp.where(found, values, jnp.inf), edges)


def sample_phase(
    field: Field, start: State, duration: Scalar, n_samples: int, options: Options
) -> Float[Array, "n_samples dim"]:
    """States at `n_samples` equal times of a phase, both ends included, at solver accuracy."""
    stepper = _stepper(field, options)
    interval = duration / (n_samples - 1)

    def to_next(state: State, _sample: None) -> tuple[State, State]:
        following = _march(stepper, state, interval, options)
        return following, following

    _, states = lax.scan(to_next, start, None, length=n_samples - 1)
    return jnp.concatenate([start[None], states])


def _march(stepper: _Stepper, state: State, interval: Scalar, options: Options) -> State:
    """State after `interval`, by adaptive steps of which the last ends exactly there."""

    def advance(carry: tuple) -> tuple:
        time, state, solver_state, length, controller_state, tried = carry
        step_length = jnp.minimum(length, interval - time)
        end, error, end_solver_state = stepper.step(state, solver_state, step_length)
        keep, next_length, controller_state = stepper.judge(
            state, end, error, step_length, controller_state
        )
        last = keep & (step_length >= interval - time)
        time = jnp.where(last, interval, jnp.where(keep, time + step_length, time))
        state, solver_state = _select(keep, (end, end_solver_state), (state, solver_state))
        return time, state, solver_state, next_length, controller_state, tried + 1

    unfinished = lambda c: (c[0] < interval) & (c[-1] < options.max_solver_steps)
    none = jnp.zeros((), jnp.int32)
    solver_state, controller_state = stepper.start(state, options)
    zero = jnp.zeros_like(interval)
    carry = (zero, state, solver_state, zero + options.first_step, controller_state, none)
    return lax.while_loop(unfinished, advance, carry)[1]

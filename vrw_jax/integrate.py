"""One phase from its start to the earliest of its events: the only room that knows diffrax.

diffrax's solvers and step-size controller are stepped by hand, so that an event's state has the
accuracy of the integrator and not of an interpolant: an accepted step that brackets an event is
taken again, shortened by Newton's method until it ends on the event. Those last re-steps are
differentiated, hence first and second derivatives of event state and time hold as well.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

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
    """The part of the loop's state that a rejected step leaves as it is."""

    time: Scalar
    state: State
    solver_state: Any
    values: Float[Array, " n_watched"]
    rates: Float[Array, " n_watched"]


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
    minimum: _Minimum
    running: Bool[Array, ""]
    bracketed: Bool[Array, ""]
    timed_out: Bool[Array, ""]
    gave_up: Bool[Array, ""]
    crossing: Bool[Array, " n_guards"]
    end_values: Float[Array, " n_watched"]
    end_rates: Float[Array, " n_watched"]
    tried: Int[Array, ""]


class _Stepper(NamedTuple):
    """A diffrax solver with its controller, seen as a function from state and length to state."""

    field: Field
    solver: diffrax.AbstractAdaptiveSolver
    controller: diffrax.PIDController
    term: diffrax.ODETerm

    def start(self, state: State, options: Options) -> tuple[Any, Scalar, Any]:
        """Solver state, length of the first step and controller state."""
        zero = jnp.zeros((), state.dtype)
        length, controller_state = self.controller.init(
            self.term,
            zero,
            options.max_phase_time.astype(state.dtype),
            lax.stop_gradient(state),
            None,
            None,
            lambda terms, t, y, args: terms.vf(t, y, args),
            self.solver.error_order(self.term),
        )
        solver_state = self.solver.init(self.term, zero, length, state, None)
        return solver_state, lax.stop_gradient(jnp.asarray(length)), controller_state

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
        controller=diffrax.PIDController(rtol=options.rtol, atol=options.atol),
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

    def watch(state: State) -> tuple[Array, Array]:
        return jax.jvp(watched.values, (state,), (field(state),))

    values, rates = watch(start)
    past = (values < 0.0) | ((values == 0.0) & (rates <= 0.0))
    past = past[:n_guards]
    ended_at_once = active & jnp.any(past)
    solver_state, length, controller_state = stepper.start(start, options)
    loop = _Loop(
        step=_Step(jnp.zeros((), start.dtype), start, solver_state, values, rates),
        length=length,
        controller_state=controller_state,
        minimum=_no_minimum(watched, start),
        running=active & ~ended_at_once,
        bracketed=jnp.asarray(False),
        timed_out=jnp.asarray(False),
        gave_up=jnp.asarray(False),
        crossing=jnp.zeros((n_guards,), bool),
        end_values=values,
        end_rates=rates,
        tried=jnp.zeros((), jnp.int32),
    )

    def advance(loop: _Loop) -> _Loop:
        here, length = loop.step, loop.length
        end, error, solver_state = stepper.step(here.state, here.solver_state, length)
        values, rates = watch(end)
        error = jnp.where(jnp.all(jnp.isfinite(values)), error, jnp.inf)
        keep, next_length, controller_state = stepper.judge(
            here.state, end, error, length, loop.controller_state
        )
        crossing = values[:n_guards] <= 0.0
        crossed = keep & jnp.any(crossing)
        places, lows = _cubic_minimum(
            *map(
                lax.stop_gradient,
                (here.values, here.rates * length, values, rates * length),
            )
        )
        # A dip: falling, then rising, and the cubic negative between. Step to the dip and look.
        turning = (lax.stop_gradient(here.rates) < 0.0) & (lax.stop_gradient(rates) >= 0.0)
        dips = (turning & (lows <= 0.0))[:n_guards] & ~crossing
        to_dip = length * jnp.min(jnp.where(dips, places[:n_guards], 1.0))
        retry = keep & (to_dip < length)
        crossed = crossed & ~retry
        accepted = keep & ~crossed & ~retry
        time = here.time + length
        timed_out = accepted & (time >= options.max_phase_time)
        tried = loop.tried + 1
        stuck = (
            ~crossed
            & ~timed_out
            & ((tried >= options.max_solver_steps) | (here.time + next_length == here.time))
        )
        end_step = _Step(time, end, solver_state, values, rates)
        return _Loop(
            step=_select(accepted, end_step, here),
            length=jnp.where(crossed, length, jnp.where(retry, to_dip, next_length)),
            controller_state=_select(retry, loop.controller_state, controller_state),
            minimum=_lower(watched, loop.minimum, here, values, rates, length, accepted),
            running=~(crossed | timed_out | stuck),
            bracketed=crossed,
            timed_out=timed_out,
            gave_up=stuck,
            crossing=crossing & crossed,
            end_values=values,
            end_rates=rates,
            tried=tried,
        )

    loop = lax.while_loop(lambda loop: loop.running, advance, loop)
    left, bracketed = loop.step, loop.bracketed
    event = _locate(stepper, watch, loop, n_guards, options)
    end_state = jnp.where(bracketed, event.state, left.state)
    end_values = jnp.where(bracketed, event.values, left.values)
    minima = jnp.zeros((0,), start.dtype)
    if watched.count_start:
        last = lax.stop_gradient(jnp.where(bracketed, event.offset, 0.0))
        minimum = _lower(
            watched, loop.minimum, left, event.values, event.rates, last, bracketed & (last > 0.0)
        )
        edges = jnp.minimum(
            jnp.where(jnp.asarray(watched.count_start), values[n_guards:], jnp.inf),
            end_values[n_guards:],
        )
        minima = jnp.minimum(_settle(stepper, watched, minimum, options), edges)
    located = bracketed & event.converged
    return PhaseEnd(
        state=end_state,
        duration=left.time + jnp.where(bracketed, event.offset, 0.0),
        guard=jnp.where(
            ended_at_once,
            jnp.argmax(past).astype(jnp.int32),
            jnp.where(located, event.guard, -1),
        ),
        timed_out=loop.timed_out,
        gave_up=loop.gave_up | (bracketed & ~event.converged),
        solver_steps=loop.tried,
        minima=minima,
    )


def _select(condition: Any, yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


class _Event(NamedTuple):
    """The earliest event inside the bracketing step."""

    state: State
    offset: Scalar  # from the bracket's left end, s
    guard: Int[Array, ""]
    values: Float[Array, " n_watched"]
    rates: Float[Array, " n_watched"]
    converged: Bool[Array, ""]


def _locate(
    stepper: _Stepper, watch: Callable, loop: _Loop, n_guards: int, options: Options
) -> _Event:
    """The earliest event in the bracketing step, by Newton's method on the step's length.

    Each iterate is a re-step from the bracket's left end, kept inside the shrinking bracket by
    bisection. Every guard that crosses proposes its own time and the earliest is taken. The
    iterates carry derivatives: after k of them in the quadratic regime, derivatives are right to
    order 2^k - 1.
    """
    left = loop.step
    length = lax.stop_gradient(loop.length)
    crossing = loop.bracketed & loop.crossing
    v0, r0, v1, r1 = (
        lax.stop_gradient(v)[:n_guards]
        for v in (left.values, left.rates * length, loop.end_values, loop.end_rates * length)
    )

    # First guess: where the cubic of each crossing guard passes zero.
    def halve(_: object, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        positive = _cubic(middle, v0, r0, v1, r1) > 0.0
        return jnp.where(positive, middle, low), jnp.where(positive, high, middle)

    low, high = lax.fori_loop(0, 20, halve, (jnp.zeros_like(v0), jnp.ones_like(v0)))
    guess = length * jnp.min(jnp.where(crossing, 0.5 * (low + high), 1.0))

    def newton(carry: tuple, _iteration: None) -> tuple:
        offset, low, high, _ = carry
        state, _, _ = stepper.step(left.state, left.solver_state, offset)
        values, rates = watch(state)
        guards, guard_rates = values[:n_guards], rates[:n_guards]
        falling = crossing & (guard_rates < 0.0)
        change = -guards / jnp.where(falling, guard_rates, -1.0)
        proposals = jnp.where(falling, offset + change, jnp.inf)
        guard = jnp.argmin(proposals).astype(jnp.int32)
        before = jnp.all(jnp.where(crossing, guards > 0.0, True))
        low = jnp.where(before, lax.stop_gradient(offset), low)
        high = jnp.where(before, high, lax.stop_gradient(offset))
        proposal = proposals[guard]
        # Within rounding of a collapsed bracket counts as inside: bisection has no derivative.
        inside = (proposal >= low - accuracy) & (proposal <= high + accuracy)
        following = jnp.where(inside, jnp.where(inside, proposal, 0.0), 0.5 * (low + high))
        event = _Event(state, offset, guard, values, rates, jnp.abs(following - offset) <= accuracy)
        return (following, low, high, event), None

    resolution = 1e3 * jnp.finfo(length.dtype).eps * (left.time + length)
    accuracy = lax.stop_gradient(jnp.maximum(options.rtol * length, resolution))
    zero = jnp.zeros_like(guess)
    nothing = _Event(
        left.state, zero, jnp.zeros((), jnp.int32), left.values, left.rates, jnp.asarray(False)
    )
    carry = (guess, zero, length, nothing)
    (_, _, _, event), _ = lax.scan(newton, carry, None, length=options.event_steps)
    return event


def _no_minimum(watched: Watched, start: State) -> _Minimum:
    n = len(watched.count_start)
    zeros = jnp.zeros((n,), start.dtype)
    return _Minimum(zeros + jnp.inf, jnp.tile(start, (n, 1)), zeros, zeros, zeros)


def _lower(
    watched: Watched,
    minimum: _Minimum,
    left: _Step,
    end_values: Array,
    end_rates: Array,
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
        for v in (left.values, left.rates, end_values, end_rates)
    )
    at_rest = (left.time == 0.0) & ~jnp.asarray(watched.count_start)
    r0 = jnp.where(at_rest, jnp.maximum(r0, 0.0), r0)
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
    stepper: _Stepper, watched: Watched, minimum: _Minimum, options: Options
) -> Float[Array, " n_monitors"]:
    """Each monitor's lowest interior minimum to the integrator's accuracy; inf without one.

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
    return jnp.where(found, values, jnp.inf)


def sample_phase(
    field: Field, start: State, duration: Scalar, n_samples: int, options: Options
) -> Float[Array, "n_samples dim"]:
    """States at `n_samples` equal times of a phase, both ends included, at solver accuracy."""
    stepper = _stepper(field, options)
    interval = duration / (n_samples - 1)

    def to_next(state: State, _sample: None) -> tuple[State, State]:
        solver_state, length, controller_state = stepper.start(state, options)
        following = _march(
            stepper, state, solver_state, length, controller_state, interval, options
        )
        return following, following

    _, states = lax.scan(to_next, start, None, length=n_samples - 1)
    return jnp.concatenate([start[None], states])


def _march(
    stepper: _Stepper,
    state: State,
    solver_state: Any,
    length: Scalar,
    controller_state: Any,
    interval: Scalar,
    options: Options,
) -> State:
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
    zero = jnp.zeros_like(length)
    carry = (zero, state, solver_state, length, controller_state, jnp.zeros((), jnp.int32))
    return lax.while_loop(unfinished, advance, carry)[1]

"""Integrate a phase whose equations have kinks, from one kink to the next, and find the extrema and
integrals of quantities in the smooth parts between kinks.

Between two kinks, the equations are those of `BatchPhase.on_sides`. They are smooth beyond the kink
too, so that a solver step may cross it, and the search for events locates it. The integration then
goes on from there on the other side. Tangents pass the kink by a saltation matrix, which is the
identity if the accelerations do not jump.

Each smooth part is sampled at the nodes of Lobatto's rule in several intervals. In an interval, a
quantity is the polynomial through its values and rates at the five nodes, and its integral is that
of Lobatto's rule. Both are more accurate than the motion.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.elementwise import run_if_any_element_active, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Vector
from vrw_jax.flow.event_location import (
    EventSearch,
    IntegrationStatus,
    IntegratorState,
    evaluate_motion_rates,
    find_first_guard,
    has_guard_crossed,
)
from vrw_jax.flow.minima import EnterSides, pass_kink_of_margins, update_margin_minima_state
from vrw_jax.flow.solver_steps import BatchPhase, ButcherTableau, SolverStepFunction, StageState
from vrw_jax.flow.tangents import propagate_to_event


def find_sides(phase: BatchPhase, state: StageState) -> Vector:
    """Return the sides of the kinks on which the motion goes on from a state."""
    assert phase.evaluate_kinks is not None
    values, rates = lax.stop_gradient(phase.evaluate_with_rates(phase.evaluate_kinks, state))
    return tuple(
        jnp.where(has_guard_crossed(*kink), -jnp.ones_like(kink[0]), 1.0)
        for kink in zip(values, rates, strict=True)
    )


class KinkLog(NamedTuple):
    """Kinks that a phase has passed, on the first axis of each array."""

    n_kinks: Array  # number of passed kinks, of which only the first ones are listed
    times: Array  # since the start of the phase, s
    states: Array  # positions and rates at each kink
    sides: Array  # sides of all kinks on which the motion goes on from each kink
    tangents: Array | None  # of time, positions and rates, with the directions on the first axis

    @classmethod
    def begin(cls, n_logged: int, sides: Vector, state: IntegratorState) -> "KinkLog":
        repeat = lambda x: jnp.zeros((n_logged, *x.shape), x.dtype)
        time, motion = state.elapsed_time, jnp.stack([*state.state.q, *state.state.v])
        tangents: Any = state.state_tangents
        if tangents is not None:
            n_directions, n_rows = len(tangents), 1 + len(motion)
            tangents = jnp.zeros((n_directions, n_logged, n_rows, *time.shape), tangents.dtype)
        n_kinks = jnp.zeros_like(state.n_tried_steps)
        return cls(n_kinks, repeat(time), repeat(motion), repeat(jnp.stack(sides)), tangents)

    def append(
        self, is_passed: Array, time: Array, motion: Array, sides: Vector, tangents: Any
    ) -> "KinkLog":
        """Return the log after a kink, which only some batch elements have passed."""
        indices = jnp.arange(len(self.times)).reshape(-1, *(1,) * jnp.ndim(time))
        is_entry = is_passed & (indices == self.n_kinks)
        write = lambda entry, log: jnp.where(is_entry[:, None], entry, log)
        return KinkLog(
            self.n_kinks + is_passed,
            jnp.where(is_entry, time, self.times),
            write(motion, self.states),
            write(jnp.stack(sides), self.sides),
            None if self.tangents is None else write(tangents[:, None], self.tangents),
        )


class KinkPassage(NamedTuple):
    """State of the integration over kinks."""

    sides: Vector
    integrator_state: IntegratorState
    search: EventSearch  # search for the event that ended the last segment
    end_guard_index: Array
    """Index of the guard that ends the phase; -1 if the guard that the search found does.

    They differ if a jump of the force makes a guard negative. A kink ends the phase if the motion
    would slide along it, because the force drives the motion back from both sides.
    """
    is_passed: Array  # whether the last segment ended at a kink, and the phase goes on
    log: KinkLog | None


def integrate_over_kinks(
    integrate_segment: Callable[..., tuple[IntegratorState, EventSearch]],
    enter_sides: EnterSides,
    sides: Vector,
    n_guards: int,
    tableau: ButcherTableau,
    integrator_state: IntegratorState,
    options: StepOptions,
    attach_derivatives: Callable | None = None,
    n_logged_kinks: int = 0,
) -> KinkPassage:
    """Integrate each batch element to the first guard that ends the phase.

    - `integrate_segment`: function of phase, solver, tangents and state that integrates to the next
      crossing of a guard, and locates it;
    - `sides`: sides of the kinks at the start;
    - `n_guards`: number of guards that end the phase, which precede those of the kinks;
    - `attach_derivatives`: function that returns the time and the rates at a kink with derivatives;
    - `n_logged_kinks`: see `BatchPhase`.
    """

    def integrate_to_next_kink(passage: KinkPassage) -> KinkPassage:
        phase, solver, tangents = enter_sides(passage.sides)
        state, search = integrate_segment(phase, solver, tangents, passage.integrator_state)
        is_at_kink = (
            state.has_guard_crossed & ~search.is_event_unresolved & (search.guard_index >= n_guards)
        )
        q, v = search.end_state.q, search.end_state.v
        elapsed_time = state.elapsed_time + search.event_step_length
        if attach_derivatives is not None:
            elapsed_time, v = attach_derivatives(
                phase,
                solver,
                state,
                elapsed_time,
                search.end_state,
                search.guard_index,
                is_at_kink,
            )
        next_sides, next_phase, kink_state, guard_values, end_guard_index = _cross_kinks(
            phase, enter_sides, passage.sides, n_guards, q, v, search.guard_index, is_at_kink
        )
        is_passed = is_at_kink & (end_guard_index < 0)
        next_state = state._replace(
            state=kink_state,
            guard_values=guard_values,
            next_step_length=jnp.minimum(
                state.next_step_length, options.max_phase_time - lax.stop_gradient(elapsed_time)
            ),
            elapsed_time=elapsed_time,
            integration_status=jnp.full_like(state.integration_status, IntegrationStatus.RUNNING),
            n_tried_steps=state.n_tried_steps + search.n_tried_steps,
        )
        next_state, kink_tangents = _select_passed_state(
            tableau,
            solver,
            tangents,
            (phase, next_phase),
            (state, next_state),
            search,
            is_passed,
        )
        log = passage.log
        if log is not None:
            motion = jnp.stack([*q, *v])
            log = log.append(is_passed, elapsed_time, motion, next_sides, kink_tangents)
        return KinkPassage(
            select_trees_by_condition(is_passed, next_sides, passage.sides),
            next_state,
            search,
            end_guard_index,
            is_passed,
            log,
        )

    no_search = EventSearch.begin(
        integrator_state,
        jnp.zeros_like(integrator_state.elapsed_time),
        enter_sides(sides)[0].has_exact_events,
    )
    start = KinkPassage(
        sides,
        integrator_state,
        no_search,
        jnp.full_like(no_search.guard_index, -1),
        jnp.ones_like(no_search.is_event_unresolved),
        KinkLog.begin(n_logged_kinks, sides, integrator_state) if n_logged_kinks else None,
    )
    return lax.while_loop(lambda passage: jnp.any(passage.is_passed), integrate_to_next_kink, start)


def _cross_kinks(
    phase: BatchPhase,
    enter_sides: EnterSides,
    sides: Vector,
    n_guards: int,
    q: Vector,
    v: Vector,
    located_guard_index: Array,
    is_at_kink: Array,
) -> tuple[Vector, BatchPhase, StageState, Array, Array]:
    """Return sides, phase, state and guards after a kink, and the index of `KinkPassage`."""
    kink_values = lax.stop_gradient(phase.evaluate_guards(phase.make_state(q, v))[n_guards:])
    # Functions that are zero at the same point change their signs together.
    is_located = jnp.stack([located_guard_index == n_guards + i for i in range(len(kink_values))])
    is_crossed = is_at_kink & (is_located | (kink_values <= 0.0))
    next_sides = tuple(map(lambda x, side: jnp.where(x, -side, side), is_crossed, sides))
    next_phase, *_ = enter_sides(next_sides)
    kink_state = next_phase.make_state(q, v)
    guard_values, guard_rates = lax.stop_gradient(
        next_phase.evaluate_with_rates(next_phase.evaluate_guards, kink_state)
    )
    is_sliding = jnp.any(is_crossed & (guard_rates[n_guards:] <= 0.0), axis=0)
    end_guard_index = find_first_guard(
        has_guard_crossed(guard_values[:n_guards], guard_rates[:n_guards]), -1
    )
    end_guard_index = jnp.where(
        is_sliding & (end_guard_index < 0), located_guard_index, end_guard_index
    )
    end_guard_index = jnp.where(is_at_kink, end_guard_index, -1)
    # The function of a kink is zero there, up to round-off.
    guard_values = jnp.concatenate(
        [guard_values[:n_guards], jnp.where(is_crossed, 0.0, guard_values[n_guards:])]
    )
    return next_sides, next_phase, kink_state, guard_values, end_guard_index


def _select_passed_state(
    tableau: ButcherTableau,
    solver_step_function: SolverStepFunction,
    phase_tangents: Any,
    phases: tuple[BatchPhase, BatchPhase],
    states: tuple[IntegratorState, IntegratorState],
    search: EventSearch,
    is_passed: Array,
) -> tuple[IntegratorState, Array | None]:
    """Return the state of the integration, with tangents and minima, in which kinks are passed.

    The second result contains the tangents of time, positions and rates at the kinks.

    - `phases`: phase before and after a kink;
    - `states`: state before the solver step to the kink, and after the kink.
    """
    (phase, next_phase), (state, next_state) = phases, states
    unbatched: dict[str, Any] = {
        name: getattr(state, name) for name in ("n_iterations_until_half_ended", "n_iterations")
    }
    kink_tangents = logged_tangents = None
    if phase_tangents is not None:

        def pass_kink(tangents: tuple[Array, Array, Array]) -> Any:
            """Return tangents after a kink at a fixed time, and of the state and the time at it."""
            end_tangents, time_tangent, kink_tangents = propagate_to_event(
                tableau,
                solver_step_function,
                phase_tangents,
                state,
                jnp.where(is_passed, search.event_step_length, 0.0),
                search.guard_index,
            )
            tangents_after = kink_tangents - time_tangent[:, None] * evaluate_motion_rates(
                next_state.state
            )
            held_tangents = end_tangents[:, kink_tangents.shape[1] :]
            return (
                *(
                    jnp.where(is_passed, jnp.concatenate([x, held_tangents], 1), y)
                    for x, y in zip((tangents_after, kink_tangents), tangents[:2], strict=True)
                ),
                jnp.where(is_passed, time_tangent, tangents[2]),
            )

        tangents: Any = state.state_tangents
        unchanged_tangents = tangents, tangents, tangents[:, 0]
        tangents, kink_tangents, time_tangent = run_if_any_element_active(
            jnp.any(is_passed), pass_kink, unchanged_tangents
        )
        unbatched["state_tangents"] = tangents
        n_rows = len(state.state.q) + len(state.state.v)
        logged_tangents = jnp.concatenate([time_tangent[:, None], kink_tangents[:, :n_rows]], 1)
    if state.margin_minima_state is not None:
        minima = update_margin_minima_state(
            phase, state.margin_minima_state, state.state, search.end_state,
            search.event_step_length, is_passed, state.state_tangents,
        )  # fmt: skip
        unbatched["margin_minima_state"] = pass_kink_of_margins(
            phase, next_phase, minima, next_state.state, is_passed, kink_tangents
        )
    drop: dict[str, Any] = dict.fromkeys(unbatched)
    selected_state = select_trees_by_condition(
        is_passed, next_state._replace(**drop), state._replace(**drop)
    )
    return selected_state._replace(**unbatched), logged_tangents


N_INTERVALS = 8
"""Number of intervals in each part. The value is chosen because a relative error of the force is
then below 1e-9.
"""
INTERVAL_GRADING = 4.0
"""Ratio of the last interval's length to the first. The value is chosen because fast modes of light
legs decay after the start of a part.
"""
NODES = np.array([-1.0, -np.sqrt(3.0 / 7.0), 0.0, np.sqrt(3.0 / 7.0), 1.0])
"""Nodes of Lobatto's rule in an interval from -1 to 1."""
NODE_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180.0
"""Weights of the nodes in the mean over an interval."""
_BOUNDARIES = np.expm1(np.linspace(0.0, np.log(INTERVAL_GRADING), N_INTERVALS + 1)) / (
    INTERVAL_GRADING - 1.0
)
_INTERVAL_FRACTIONS = np.diff(_BOUNDARIES)
NODE_FRACTIONS = np.append(
    (_BOUNDARIES[:-1, None] + _INTERVAL_FRACTIONS[:, None] * (NODES[:-1] + 1.0) / 2.0).ravel(), 1.0
)
"""Time of each node as a fraction of the duration of a part. Neighboring intervals share a node."""
_NODE_INDICES = (len(NODES) - 1) * np.arange(N_INTERVALS)[:, None] + np.arange(len(NODES))
_POWERS = np.arange(2 * len(NODES))
N_BRACKETS = 8
"""Number of brackets in an interval, each of which may contain one inflection and two extrema."""
_BRACKET_ENDS = np.linspace(-1.0, 1.0, N_BRACKETS + 1)
N_BISECTIONS = 12
"""Number of bisections of a bracket. The value is chosen because Newton's method then converges."""
N_NEWTON_STEPS = 3
"""Number of Newton's steps after them. The value is chosen because they reach round-off."""


def _evaluate_powers(location: Any, order: int = 0) -> Any:
    """Return the derivatives of all powers of a location, on the last axis."""
    factors = np.prod([_POWERS - i for i in range(order)], axis=0) * np.ones(len(_POWERS))
    return factors * location[..., None] ** np.maximum(_POWERS - order, 0)


_COEFFICIENTS_FROM_NODES = np.linalg.inv(
    np.concatenate([_evaluate_powers(NODES), _evaluate_powers(NODES, 1)])
)


class SmoothParts(NamedTuple):
    """Parts of a phase between its kinks. Their first axis contains the parts, in order of time."""

    n_kinks: Array  # number of kinks, which may exceed the number of listed parts
    sides: Array  # sides of the kinks in each part
    durations: Array  # s, zero for absent parts
    states: Array  # coordinates and rates at the `NODE_FRACTIONS` of each part

    @property
    def is_complete(self) -> Array:
        return self.n_kinks < len(self.durations)


class PartExtrema(NamedTuple):
    """Extrema of a quantity in the parts of a phase, in order of time; most flags are false."""

    times: Array  # since the start of the phase, s
    values: Array
    is_maximum: Array
    is_minimum: Array


def find_extrema(values: Array, rates: Array, durations: Array) -> PartExtrema:
    """Return the smooth extrema of a quantity, with its values and rates at the nodes of parts.

    Their values have exact first derivatives, because the quantity is stationary there.
    """
    lengths = durations[:, None] * _INTERVAL_FRACTIONS.astype(values.dtype)
    slopes = rates[:, _NODE_INDICES] * (0.5 * lengths[..., None])
    samples = jnp.concatenate([values[:, _NODE_INDICES], slopes], -1)
    coefficients = samples @ _COEFFICIENTS_FROM_NODES.T.astype(values.dtype)
    fixed = lax.stop_gradient(coefficients)
    evaluate = lambda location, order: jnp.sum(
        fixed[..., None, :] * _evaluate_powers(location, order), -1
    )

    def find_roots(order: int, start: Array, end: Array, is_positive: Array) -> Array:
        """Return a root of a derivative in each bracket, or any location if there is none.

        - `is_positive`: whether the derivative is positive at the start of the bracket.
        """

        def halve(_: Any, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (bracket[0] + bracket[1])
            is_later = (evaluate(middle, order) > 0.0) == is_positive
            return jnp.where(is_later, middle, bracket[0]), jnp.where(is_later, bracket[1], middle)

        def correct(_: Any, location: Array) -> Array:
            rate = evaluate(location, order + 1)
            change = evaluate(location, order) / jnp.where(rate == 0.0, 1.0, rate)
            return jnp.clip(location - change, start, end)

        low, high = lax.fori_loop(0, N_BISECTIONS, halve, (start, end))
        return lax.fori_loop(0, N_NEWTON_STEPS, correct, 0.5 * (low + high))

    shape = (*fixed.shape[:-1], N_BRACKETS)
    start, end = (
        jnp.broadcast_to(x.astype(values.dtype), shape)
        for x in (_BRACKET_ENDS[:-1], _BRACKET_ENDS[1:])
    )
    # Two extrema in one bracket are separated by an inflection.
    inflections = find_roots(2, start, end, evaluate(start, 2) > 0.0)
    interleave = lambda *x: jnp.stack(x, -1).reshape(*shape[:-1], -1)
    start, end = interleave(start, inflections), interleave(inflections, end)
    # Neighboring intervals have the same slope at their common node.
    end_slopes = lax.stop_gradient(jnp.concatenate([slopes[..., :1], slopes[..., -1:]], -1))
    inner_slopes = evaluate(start[..., 1:], 1)
    all_slopes = jnp.concatenate([end_slopes[..., :1], inner_slopes, end_slopes[..., 1:]], -1)
    is_rising = all_slopes > 0.0
    locations = find_roots(1, start, end, is_rising[..., :-1])
    extremum_values = jnp.sum(coefficients[..., None, :] * _evaluate_powers(locations), -1)
    starts = (jnp.cumsum(durations) - durations)[:, None] + durations[:, None] * _BOUNDARIES[:-1]
    times = starts[..., None] + 0.5 * (locations + 1.0) * lengths[..., None]
    has_occurred = (durations > 0.0)[:, None, None]
    is_maximum = has_occurred & is_rising[..., :-1] & ~is_rising[..., 1:]
    is_minimum = has_occurred & ~is_rising[..., :-1] & is_rising[..., 1:]
    return PartExtrema(*map(jnp.ravel, (times, extremum_values, is_maximum, is_minimum)))


def mask_ends(values: Array, durations: Array) -> Array:
    """Return the values at both ends of each part, and -inf for absent parts."""
    return jnp.ravel(jnp.where((durations > 0.0)[:, None], values[:, np.array([0, -1])], -jnp.inf))


def mask_incomplete(value: Array, parts_by_phase: Sequence[SmoothParts]) -> Array:
    """Return a value, or NaN if a phase has more kinks than parts are listed."""
    is_complete = functools.reduce(jnp.logical_and, [x.is_complete for x in parts_by_phase])
    return jnp.where(is_complete, value, jnp.nan)


def integrate_over_parts(values: Array, durations: Array) -> Array:
    """Return the integral of a quantity over all parts, with its values at their nodes."""
    weights = _INTERVAL_FRACTIONS[:, None] * NODE_WEIGHTS
    return jnp.sum(durations[:, None, None] * weights * values[:, _NODE_INDICES])


class StepForceExtrema(NamedTuple):
    """Extrema of a force in one gait step, in chronological order."""

    times: Any  # s
    forces: Any  # N
    is_peak: Any
    is_trough: Any
    rate_times: Any  # of extrema of the rate, s
    rates: Any  # N/s
    is_rate_maximum: Any
    other_forces: Any  # at the ends of phases, or at all samples, N


def summarize_forces(xp: Any, fore: StepForceExtrema, total: StepForceExtrema) -> dict[str, Any]:
    """Return the measures of a step from extrema of the force on the fore foot and of their sum.

    - `xp`: `jax.numpy`, or `numpy` for numbers of extrema that differ from step to step.
    """
    fore_peaks, total_peaks = (_summarize_force(extrema, xp) for extrema in (fore, total))
    names = {"n_force_peaks": "n_total_force_peaks", "peak_force": "peak_total_force"}
    names["smooth_peak_force"] = "smooth_peak_total_force"
    return fore_peaks | {names[name]: total_peaks[name] for name in names}


def _summarize_force(extrema: StepForceExtrema, xp: Any) -> dict[str, Any]:
    """Return the measures of the fore foot in `measures.FORCE_PEAK_MEASURES`, by name."""
    find_largest = lambda values: xp.max(values, initial=-xp.inf)
    peak_forces = xp.where(extrema.is_peak, extrema.forces, -xp.inf)
    lower_neighbor_peak = xp.minimum(
        _find_highest_before(peak_forces, xp), _find_highest_before(peak_forces, xp, True)
    )
    is_trough = extrema.is_trough & xp.isfinite(lower_neighbor_peak)
    trough_depths = xp.where(
        is_trough, xp.where(is_trough, lower_neighbor_peak, 0.0) - extrema.forces, 0.0
    )
    first_peak_time = xp.min(xp.where(extrema.is_peak, extrema.times, xp.inf), initial=xp.inf)
    is_later_rate_maximum = extrema.is_rate_maximum & (extrema.rate_times > first_peak_time)
    largest_rate = find_largest(xp.where(is_later_rate_maximum, extrema.rates, -xp.inf))
    candidate_forces = xp.append(peak_forces, extrema.other_forces)
    return {
        "n_force_peaks": xp.sum(extrema.is_peak),
        # The maximum of tied forces has one-sided derivatives. Selection returns one of them.
        "peak_force": candidate_forces[xp.argmax(candidate_forces)],
        "smooth_peak_force": xp.where(xp.any(extrema.is_peak), find_largest(peak_forces), xp.nan),
        "force_trough_depth": xp.max(trough_depths, initial=0.0),
        "second_peak_rate": xp.where(xp.any(is_later_rate_maximum), largest_rate, xp.nan),
    }


def _find_highest_before(forces: Any, xp: Any, is_reversed: bool = False) -> Any:
    """Return the largest force before each one, or after it, and -inf if there is none.

    JAX computes it in a loop, because comparisons of all pairs would double the compiled code.
    """
    if xp is np:
        order = slice(None, None, -1 if is_reversed else 1)
        return np.maximum.accumulate(np.append(-np.inf, forces[order])[:-1])[order]
    start = jnp.asarray(-jnp.inf, forces.dtype)
    keep_highest = lambda highest, force: (jnp.maximum(highest, force), highest)
    return lax.scan(keep_highest, start, forces, reverse=is_reversed)[1]

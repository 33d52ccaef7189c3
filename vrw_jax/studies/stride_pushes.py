"""Pushes of a gait within its stride: the response to small ones, and the smallest that ends it.

A small push changes the time until the next section and the section state there. Both changes are
exact across events. The later steps follow from the return map, so that the asymptotic change of
the phase is the product of an adjoint vector with the changes at the section. The smallest
disturbance that takes a walker out of the basin of its gait is found by search.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base.checks import check_int, check_positive, check_type, require_known_name
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import AbstractPrintable, LabelAndText, Outcome, format_quantity
from vrw_jax.base.walker import AdvanceResult, compile_step
from vrw_jax.flow.hybrid_simulation import HybridStep
from vrw_jax.flow.hybrid_system import HybridSystem, compile_finish
from vrw_jax.flow.phase_integration import sample_phase
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import map_in_batches, select_tree_rows
from vrw_jax.models.stepping import ModelLike
from vrw_jax.studies.basins import (
    MAX_ARRIVAL_DISTANCE,
    StableGait,
    require_can_start_within_step,
    walk_until_on_gait,
)

DISTURBANCE_BATCH_SIZES = (64, 1024)
"""Numbers of disturbed steps that one call computes: one disturbance size at each instant, or
many.
"""

DISTURBANCE_SIGNS = np.array([-1.0, 1.0])
"""Signs of the change in backward and forward disturbances, in this order."""
WHEEL_PHASE_NAMES = ("DLS", "SLS-I", "SLS-II")
WHEEL_COORDINATES = ("theta", "L1", "L2", "dtheta", "dL1", "dL2")


class SmallestDisturbance(AbstractPrintable):
    """Smallest change of a coordinate within a step that takes the state out of the basin.

    For the wheel, the coordinate is the angular velocity, and sizes are in rad/s.

    - `size`: smallest change; infinite if no change up to `max_size` suffices;
    - `size_error`: error estimate of `size`;
    - `direction`: 1 if the change increases the coordinate, -1 if it decreases it;
    - `time`: instant of the disturbance after the start of the gait, s;
    - `phase_index`: index of the phase or mode of that instant in `phase_names`;
    - `outcome`: Outcome that ends the walk after a slightly larger disturbance; STEPPED if the walk
      has not reached this gait after `max_steps` steps;
    - `profile_times`: instants of the profile of sizes, s, shape (instants,);
    - `profile_phase_indices`: index of the phase at each instant of the profile, shape (instants,);
    - `backward_sizes`, `forward_sizes`: smallest sufficient change in each direction at each
      instant of the profile, shape (instants,);
    - `max_size`: largest change that the search tried;
    - `coordinate`, `unit`: name and unit of the coordinate.

    Examples:
        >>> result = vrw.smallest_disturbance(vrw.WheelParams())
        >>> print(result.ending)
        The next foot met the ground before Leg 2 was back at its stopper.
    """

    size: float
    size_error: float
    direction: int = eqx.field(static=True)
    time: float
    phase_index: int = eqx.field(static=True)
    outcome: Int[np.ndarray, ""]
    profile_times: Float[np.ndarray, " instants"]
    profile_phase_indices: Int[np.ndarray, " instants"]
    backward_sizes: Float[np.ndarray, " instants"]
    forward_sizes: Float[np.ndarray, " instants"]
    max_size: float
    phase_names: tuple[str, ...] = eqx.field(static=True, default=WHEEL_PHASE_NAMES)
    coordinate: str = eqx.field(static=True, default="dtheta")
    unit: str = eqx.field(static=True, default="rad/s")

    @property
    def ending(self) -> str:
        """Return a sentence on how the walk ends after a slightly larger disturbance."""
        if not np.isfinite(self.size):
            return "No disturbance of the tried sizes leaves the basin."
        if self.outcome == Outcome.STEPPED:
            return (
                "After max_steps steps, the walker has not reached this gait: it has another one, "
                "or a larger max_steps gives a larger size."
            )
        return Outcome(int(self.outcome)).meaning

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for size, direction, instant and outcome."""
        if not np.isfinite(self.size):
            max_size = format_quantity(self.max_size, self.unit)
            return [("largest tried size", max_size), ("ending", self.ending)]
        change = "increase" if self.direction > 0 else "decrease"
        size_text = f"{format_quantity(self.size, self.unit)} (error {self.size_error:.1g})"
        phase_name = self.phase_names[self.phase_index]
        return [
            (f"smallest {change} of {self.coordinate}", size_text),
            ("instant", f"{self.time:.6g} s after the start of the gait, {phase_name}"),
            ("ending", self.ending),
        ]


@announce_wait("gaits, walks and derivatives", "15 s")
def smallest_disturbance(
    params: Any,
    *,
    model: ModelLike | None = None,
    cycle: Any = None,
    options: StepOptions | None = None,
    max_size: float | None = None,
    max_steps: int = 200,
    coordinate: str | None = None,
) -> SmallestDisturbance:
    """Return the smallest disturbance within a step that takes a walker out of its gait's basin.

    A disturbance of the wheel is a sudden change of the angular velocity dtheta at one instant in
    a step of the gait. The instant lies between a landing and the next landing. The size of the
    disturbance is the modulus of the change, rad/s. Positions do not change. In double support the
    two feet stay on the ground, so that dtheta determines the rates of the legs. In single support
    the rates of the legs do not change. For a `HybridSystem`, name the `coordinate` of its state
    that changes. No other coordinate changes. Changes that make a guard of the mode negative are
    skipped.

    The disturbed state is outside the basin if the walk from it does not arrive at the gait (see
    `basin_share`). With the paper's model, a departure from the sequence of phases, which need not
    be a fall, ends the walk.

    The search considers 17 instants of each phase, and changes in both directions. A grid of
    sizes brackets the smallest sufficient size, and bisection in batches refines the bracket. Later
    passes refine the instants around the smallest size of each phase and direction. `size_error` is
    the sum of the width of the last bracket and the difference between sizes at neighboring
    instants of the last pass.

    Args:
        params: parameters of the wheel, or of a `HybridSystem`.
        model: `ViscoelasticWheel()`, the paper's wheel and the default, `RigidWheel()`, or a
            `HybridSystem`.
        cycle: a gait; by default the result of `limit_cycle`.
        options: numerical options of the gait steps.
        max_size: largest change that the search tries; by default twice the largest modulus of the
            coordinate in the gait.
        max_steps: largest number of gait steps of a walk after the disturbance.
        coordinate: for a `HybridSystem`, name of the coordinate that changes.

    Returns:
        A `SmallestDisturbance`: its size, its instant, and the outcome that it causes.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if there is no stable gait.

    Examples:
        >>> result = vrw.smallest_disturbance(vrw.WheelParams(damping=150.0))
        >>> print(f"{result.size:.3f} rad/s at {result.time:.2f} s")
        0.275 rad/s at 0.25 s
    """
    max_steps = check_int("max_steps", max_steps)
    stable_gait = StableGait.from_cycle(
        "vrw.smallest_disturbance", params, model, cycle, options, "disturbances"
    )
    max_size = None if max_size is None else check_positive("max_size", max_size)
    spectral_radius = float(stable_gait.spectral_radius)
    period_n = len(stable_gait.section_states)
    if spectral_radius ** (max_steps / period_n) > MAX_ARRIVAL_DISTANCE:
        n_steps = math.ceil(period_n * math.log(MAX_ARRIVAL_DISTANCE) / math.log(spectral_radius))
        raise ValueError(
            f"max_steps is {max_steps}, but the gait has spectral radius {spectral_radius:.6g}, so "
            f"that walks need {n_steps} steps to arrive: give max_steps={2 * n_steps}."
        )
    coordinate = check_disturbed_coordinate(stable_gait.model, coordinate)
    return compute_smallest_disturbance(stable_gait, max_size, max_steps, coordinate)


def check_disturbed_coordinate(model: Any, coordinate: str | None) -> str:
    """Return the name of the coordinate that disturbances change, or raise an error."""
    require_can_start_within_step(model, "disturbances")
    names = tuple(model.state) if isinstance(model, HybridSystem) else ("dtheta",)
    if coordinate is None and len(names) > 1:
        raise ValueError(
            f"coordinate is None, but the disturbance changes one coordinate of the state: name "
            f"one of {', '.join(names)}."
        )
    coordinate = names[0] if coordinate is None else coordinate
    require_known_name(coordinate, names, "coordinate")
    return coordinate


def find_coordinate_unit(model: Any, coordinate: str) -> str:
    """Return the unit of a coordinate that disturbances change, "" if it is not declared."""
    return model.state_units.get(coordinate, "") if isinstance(model, HybridSystem) else "rad/s"


def _is_system(gait: StableGait) -> bool:
    return isinstance(gait.model, HybridSystem)


class _SampledGait(NamedTuple):
    """States of a gait at instants of the phases of its steps."""

    step_indices: np.ndarray  # step of each interval between events, (intervals,)
    phase_indices: np.ndarray  # phase or mode of each interval, (intervals,)
    times: np.ndarray  # after the start of the gait, s, (intervals, samples)
    states: np.ndarray  # (intervals, samples, dim)
    # of a wheel, between the feet in double support of each step, m
    foot_distances: tuple[Array | None, ...]


class _DirectedInstants(NamedTuple):
    """Instants of a gait, each with the direction of a disturbance, as arrays of shape
    (instants,).
    """

    interval_indices: np.ndarray
    sample_indices: np.ndarray
    disturbance_signs: np.ndarray


# Distances between neighboring instants, in samples of a phase, one for each pass of the search.
# The values are chosen because each pass then covers two intervals of the previous pass. The last
# pass resolves a ten-thousandth of a phase.
SAMPLE_STRIDES = (512, 64, 8, 1)
# Fraction of the duration of a phase at its last sample, so that a push there is one before the
# event. The value is chosen because the guard that ends the phase is positive there, up to an error
# of the state of 1e-10.
LAST_SAMPLE_FRACTION = 1.0 - 1e-9
# Number of intervals between the instants that one pass considers in a phase.
N_INTERVALS_PER_PASS = 16
# Width of a bracket of sizes in the last pass, relative to the size. The value is chosen as the
# relative error of a gait step.
FINAL_DISTURBANCE_TOLERANCE = 1e-8
# Width of a bracket of sizes in all earlier passes, relative to the size. The value is chosen
# because sizes at neighboring instants differ by more than this width.
EARLY_DISTURBANCE_TOLERANCE = 1e-5


def compute_smallest_disturbance(
    stable_gait: StableGait, max_size: float | None, max_steps: int, coordinate: str = "dtheta"
) -> SmallestDisturbance:
    """Return the `SmallestDisturbance` for a gait and for checked arguments.

    Each pass of the search considers instants that are closer to each other than in the pass
    before.
    """
    system = stable_gait.model if _is_system(stable_gait) else None
    n_phase_samples = N_INTERVALS_PER_PASS * SAMPLE_STRIDES[0] + 1  # both ends included
    stride = _sample_gait(stable_gait, n_phase_samples)
    coordinates = tuple(system.state) if system else WHEEL_COORDINATES
    index = coordinates.index(coordinate)
    if max_size is None:
        max_size = 2.0 * float(np.abs(stride.states[..., index]).max())
        if not max_size > 0.0:
            raise ValueError(
                f"{coordinate} is zero during the whole gait, so that its size gives no unit for "
                "changes: give max_size, the largest change that is tried."
            )
    walk = functools.partial(_walk_after_disturbance, stable_gait, stride, index, max_steps)
    # Each pass considers a window of samples for each phase and direction.
    intervals = np.arange(len(stride.times))
    n_windows = len(intervals) * len(DISTURBANCE_SIGNS)
    window_centers = np.full(n_windows, n_phase_samples // 2)
    half_intervals = N_INTERVALS_PER_PASS // 2
    first_pass_result = None
    for sample_stride in SAMPLE_STRIDES:
        sample_offsets = sample_stride * np.arange(-half_intervals, half_intervals + 1)
        n_instants = len(sample_offsets)
        window_samples = np.clip(window_centers[:, None] + sample_offsets, 0, n_phase_samples - 1)
        instants = _DirectedInstants(
            np.repeat(intervals, len(DISTURBANCE_SIGNS) * n_instants),
            window_samples.ravel(),
            np.tile(np.repeat(DISTURBANCE_SIGNS, n_instants), len(intervals)),
        )
        is_last_pass = sample_stride == SAMPLE_STRIDES[-1]
        tolerance = FINAL_DISTURBANCE_TOLERANCE if is_last_pass else EARLY_DISTURBANCE_TOLERANCE
        sizes, widths, outcomes = _bracket_exit_sizes(walk, instants, max_size, tolerance)
        exit_sizes = sizes.reshape(n_windows, n_instants)
        window_centers = window_samples[np.arange(n_windows), exit_sizes.argmin(1)]
        first_pass_result = first_pass_result or (instants, sizes)
    assert first_pass_result is not None
    best_instant = int(exit_sizes.argmin())
    window_index, instant_index = divmod(best_instant, n_instants)
    size = float(exit_sizes[window_index, instant_index])
    best_interval = instants.interval_indices[best_instant]
    sample_index = instants.sample_indices[best_instant]
    size_error = 0.0
    if np.isfinite(size):
        size_error = float(widths[best_instant])
        if sample_index not in (0, n_phase_samples - 1):
            # Sizes at the neighboring instants of the last pass bound the change between two
            # instants.
            neighbor_sizes = exit_sizes[window_index, max(instant_index - 1, 0) : instant_index + 2]
            size_error += float(np.max(neighbor_sizes[np.isfinite(neighbor_sizes)]) - size)
    profile_instants, profile_sizes = first_pass_result
    is_backward = profile_instants.disturbance_signs < 0.0
    profile_intervals = profile_instants.interval_indices[is_backward]
    return SmallestDisturbance(
        size=size,
        size_error=size_error,
        direction=int(instants.disturbance_signs[best_instant]),
        time=float(stride.times[best_interval, sample_index]),
        phase_index=int(stride.phase_indices[best_interval]),
        outcome=np.asarray(outcomes[best_instant]),
        profile_times=stride.times[profile_intervals, profile_instants.sample_indices[is_backward]],
        profile_phase_indices=stride.phase_indices[profile_intervals],
        backward_sizes=profile_sizes[is_backward],
        forward_sizes=profile_sizes[~is_backward],
        max_size=max_size,
        phase_names=tuple(system.modes) if system else WHEEL_PHASE_NAMES,
        coordinate=coordinate,
        unit=find_coordinate_unit(stable_gait.model, coordinate),
    )


# Number of disturbance sizes in the first grid. An interval of sufficient sizes may be missed if
# the grid spacing exceeds its width.
N_DISTURBANCE_GRID_SIZES = 24
# Number of sizes that divide a bracket, chosen because each batch then gains one digit.
N_SIZES_PER_BISECTION = 8


def _bracket_exit_sizes(
    walk: Callable, instants: _DirectedInstants, max_size: float, size_tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for each instant and direction, the smallest disturbance size that takes the state
    out of the basin, infinite if no tried size does, the width of its bracket, and the `Outcome`
    after a slightly larger disturbance.

    - `walk`: `_walk_after_disturbance` of instants and sizes;
    - `size_tolerance`: width of the final brackets, relative to the size.
    """
    n_instants = len(instants.disturbance_signs)
    lower_sizes, upper_sizes = np.zeros(n_instants), np.full(n_instants, np.inf)
    exit_outcomes = np.full(n_instants, int(Outcome.STEPPED))
    unresolved = np.arange(n_instants)
    grid_fractions = np.arange(1, N_DISTURBANCE_GRID_SIZES + 1) / N_DISTURBANCE_GRID_SIZES
    bisection_fractions = np.arange(1, N_SIZES_PER_BISECTION + 1) / (N_SIZES_PER_BISECTION + 1.0)
    tried_sizes = np.tile(max_size * grid_fractions, (n_instants, 1))
    while len(unresolved):
        leaves_basin, walk_outcomes = walk(select_tree_rows(instants, unresolved), tried_sizes)
        has_exit, first_exit = leaves_basin.any(1), leaves_basin.argmax(1)
        n_sizes_inside = np.where(has_exit, first_exit, tried_sizes.shape[1])
        sizes_from_lower = np.column_stack([lower_sizes[unresolved], tried_sizes])
        lower_sizes[unresolved] = sizes_from_lower[np.arange(len(unresolved)), n_sizes_inside]
        upper_sizes[unresolved[has_exit]] = tried_sizes[has_exit, first_exit[has_exit]]
        exit_outcomes[unresolved[has_exit]] = walk_outcomes[has_exit, first_exit[has_exit]]
        bracket_widths = np.where(np.isfinite(upper_sizes), upper_sizes - lower_sizes, 0.0)
        unresolved = np.flatnonzero(bracket_widths > size_tolerance * upper_sizes)
        tried_sizes = (
            lower_sizes[unresolved, None] + bracket_widths[unresolved, None] * bisection_fractions
        )
    return 0.5 * (lower_sizes + upper_sizes), bracket_widths, exit_outcomes


def _walk_after_disturbance(
    stable_gait: StableGait,
    stride: _SampledGait,
    coordinate_index: int,
    max_steps: int,
    instants: _DirectedInstants,
    disturbance_sizes: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each walk after a disturbance misses the gait, and the `Outcome` of the walk.

    The two arrays have the shape of `disturbance_sizes`, (instants, sizes).
    """
    n_sizes = disturbance_sizes.shape[1]
    step_indices, phase_indices = (
        np.repeat(indices[instants.interval_indices], n_sizes)
        for indices in (stride.step_indices, stride.phase_indices)
    )
    disturbed_states = np.repeat(
        stride.states[instants.interval_indices, instants.sample_indices], n_sizes, 0
    )
    disturbed_states[:, coordinate_index] += (
        instants.disturbance_signs[:, None] * disturbance_sizes
    ).ravel()
    walk_outcomes = np.empty(len(phase_indices), int)
    section_states = np.empty((len(phase_indices), stable_gait.section_states.shape[1]))
    for k, phase_index in sorted({*zip(step_indices, phase_indices, strict=True)}):
        is_in_phase = (step_indices == k) & (phase_indices == phase_index)
        finish_disturbed_batch = functools.partial(
            _finish_steps,
            stable_gait.start_at_step(k),
            _convert_phase_index(stable_gait, phase_index),
            stride.foot_distances[k],
        )
        section_states[is_in_phase], walk_outcomes[is_in_phase] = map_in_batches(
            finish_disturbed_batch,
            DISTURBANCE_BATCH_SIZES,
            disturbed_states[is_in_phase],
        )
    # A change that crosses a guard of the mode, such as that of a speed at an apex, is skipped.
    leaves_basin = walk_outcomes != NOT_IN_PHASE
    for k in range(len(stable_gait.section_states)):
        has_stepped = np.flatnonzero((walk_outcomes == Outcome.STEPPED) & (step_indices == k))
        if len(has_stepped):
            has_arrived, walk_outcomes[has_stepped], _ = walk_until_on_gait(
                stable_gait.start_at_step(k + 1), section_states[has_stepped], max_steps
            )
            leaves_basin[has_stepped] = ~has_arrived
    shape = disturbance_sizes.shape
    return leaves_basin.reshape(shape), walk_outcomes.reshape(shape)


def _convert_phase_index(gait: StableGait, phase_index: Any) -> Any:
    """Return the index of a phase: an array if one program serves all phases."""
    return jnp.asarray(phase_index, jnp.int32) if _is_system(gait) else int(phase_index)


def _finish_step(
    gait: StableGait, phase_index: Any, foot_distance: Array | None, y: Array
) -> AdvanceResult | HybridStep:
    """Return the rest of a step from a state within the phase or mode `phase_index`."""
    params, model, options, *_ = gait
    if _is_system(gait):
        return compile_finish(model)(params, y, phase_index, options)
    return model.finish_step(params, phase_index, foot_distance, y, options)


NOT_IN_PHASE = -1
"""Outcome of a step from a state at which a guard of its mode is negative."""


@eqx.filter_jit
def _finish_steps(
    gait: StableGait, phase_index: Any, foot_distance: Array | None, states: Array
) -> tuple[Array, Array]:
    """Return the section states at the ends of steps, and their outcomes."""

    def finish_within_phase(y: Array) -> tuple[Array, Array]:
        step = _finish_step(gait, phase_index, foot_distance, y)
        outcome = jnp.asarray(step.outcome)
        if _is_system(gait):
            is_inside = gait.model.is_inside_mode(gait.params, y, phase_index)
            outcome = jnp.where(is_inside, outcome, NOT_IN_PHASE)
        return step.section_state, outcome

    return jax.vmap(finish_within_phase)(states)


@eqx.filter_jit
def _differentiate_step_rest(
    gait: StableGait, phase_index: Any, foot_distance: Array | None, states: Array
) -> Array:
    """Return the derivatives of (section state, remaining duration) by each state."""

    def finish(y: Array) -> Array:
        rest = _finish_step(gait, phase_index, foot_distance, y)
        return jnp.append(rest.section_state, rest.duration)

    return jax.vmap(lambda y: evaluate_with_jacobian(finish, y)[1])(states)


class PhaseResponse(AbstractPrintable):
    """Response of a gait to small changes of its state, at instants of its steps.

    All changes are per unit of the pushed coordinate, to first order.

    - `times`: instants after the start of the gait, s, shape (instants,). An event has two
      instants, before and after it;
    - `step_indices`: step of the gait at each instant;
    - `phase_indices`: phase or mode of the walker at each instant;
    - `states`: state at each instant, whose coordinates are pushed, shape (instants, dim). For the
      wheel, the state is (theta, L1, L2) with their rates. A push does not move a planted foot, so
      that responses to coordinates that the phase determines are zero;
    - `phase_advance`: asymptotic advance of the phase, as a fraction of the period, shape
      (instants, dim). After many steps, a pushed walker is ahead of an unpushed one by it;
    - `period`: period of the gait, s;
    - `section_states`: change of the section state at the end of this step and of the next ones,
      shape (steps, instants, dim, n);
    - `measures`: changes of the measures of the next complete steps by name, each of shape (steps,
      instants, dim): the period, and for wheels also speed, step length and durations of phases;
    - `coordinates`: names of the coordinates of the state.

    Examples:
        >>> response = vrw.phase_response(vrw.WheelParams(), n_samples=5)
        >>> print(f"{response.phase_advance[0, 3]:.3f} per rad/s just after the landing")
        0.832 per rad/s just after the landing
    """

    times: Float[np.ndarray, " instants"]
    step_indices: Int[np.ndarray, " instants"]
    phase_indices: Int[np.ndarray, " instants"]
    states: Float[np.ndarray, "instants dim"]
    phase_advance: Float[np.ndarray, "instants dim"]
    period: float
    section_states: Float[np.ndarray, "steps instants dim n"]
    measures: dict[str, Float[np.ndarray, "steps instants dim"]]
    coordinates: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def delay(self) -> Float[np.ndarray, "instants dim"]:
        """Return the asymptotic delay of all later events, s per unit, shape (instants, dim)."""
        return -self.period * self.phase_advance

    def summary_rows(self) -> list[LabelAndText]:
        """Return labels and texts: the period and the largest advance for each coordinate."""
        rows = [("period", f"{self.period:.6g} s")]
        for name, advance in zip(self.coordinates, self.phase_advance.T, strict=True):
            instant = int(np.argmax(np.abs(advance)))
            text = f"{advance[instant]:.4g} periods per unit at {self.times[instant]:.4g} s"
            rows.append((f"largest advance by {name}", text))
        return rows


@announce_wait("steps and their derivatives", "15 s")
def phase_response(
    params: Any,
    *,
    cycle: Any = None,
    model: Any = None,
    n_samples: int = 17,
    n_steps: int = 3,
    options: StepOptions | None = None,
) -> PhaseResponse:
    """Return the response of a gait to small pushes at each instant of its steps.

    A push changes the state at one instant. After many steps, the walker is on its gait again, and
    ahead of or behind the unpushed walker by a constant fraction of the period: the asymptotic
    phase. The result contains this fraction, and the changes of the next steps and of their
    measures. Derivatives are exact across events, as are those of steps.

    Args:
        params: one wheel, or the parameters of a `HybridSystem`.
        cycle: a stable gait, by default the result of `limit_cycle`.
        model: model of the wheel, the paper's by default, or a `HybridSystem`.
        n_samples: number of instants in each phase or mode, both ends included.
        n_steps: number of steps whose changes are returned.
        options: numerical options of the steps, by default tight.

    Returns:
        A `PhaseResponse` for all coordinates of the state.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the gait is unstable; the message
            names the remedy.

    Examples:
        >>> response = vrw.phase_response(vrw.WheelParams(), n_samples=5)
        >>> print(f"{response.measures['period'][0, 0, 3]:.4f} s per rad/s in the next step")
        -0.1607 s per rad/s in the next step
    """
    n_samples, n_steps = check_int("n_samples", n_samples, 2), check_int("n_steps", n_steps)
    options = StepOptions.tight() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    gait = StableGait.from_cycle("vrw.phase_response", params, model, cycle, options, "pushes")
    coordinates = tuple(gait.model.state) if _is_system(gait) else WHEEL_COORDINATES
    stride = _sample_gait(gait, n_samples)
    n = len(gait.section_states)
    period, jacobians, gradients = _differentiate_gait(gait)
    # The adjoint vector at each section is the derivative of the sum of all later durations.
    monodromy, delay_gradient = np.eye(len(jacobians[0])), np.zeros(len(jacobians[0]))
    for jacobian, gradient in zip(jacobians[::-1], gradients["period"][::-1], strict=True):
        monodromy = monodromy @ jacobian
        delay_gradient = gradient + jacobian.T @ delay_gradient
    adjoints = [np.linalg.solve((np.eye(len(monodromy)) - monodromy).T, delay_gradient)]
    for k in range(n - 1, 0, -1):
        adjoints.insert(0, gradients["period"][k] + jacobians[k].T @ adjoints[0])
    delays: list[np.ndarray] = []
    changes: list[np.ndarray] = []
    measures: dict[str, list[np.ndarray]] = {name: [] for name in gradients}
    for k, index, states in zip(
        stride.step_indices, stride.phase_indices, stride.states, strict=True
    ):
        remaining = _differentiate_step_rest(
            gait.start_at_step(k),
            _convert_phase_index(gait, index),
            stride.foot_distances[k],
            jnp.asarray(states),
        )
        by_section, by_time = np.split(np.asarray(remaining), [len(monodromy)], 1)
        # The adjoint vectors begin at the second section and end at the first one.
        delays.append(by_time[:, 0] + np.einsum("j,ijd->id", adjoints[k], by_section))
        section_changes = [by_section]
        for m in range(k + 1, k + n_steps):
            section_changes.append(jacobians[m % n] @ section_changes[-1])
        changes.append(np.stack(section_changes))
        for name, step_gradients in gradients.items():
            next_steps = range(k + 1, k + 1 + n_steps)
            next_gradients = np.stack([step_gradients[m % n] for m in next_steps])
            measures[name].append(np.einsum("kj,kijd->kid", next_gradients, changes[-1]))
    return PhaseResponse(
        stride.times.ravel(),
        np.repeat(stride.step_indices, n_samples),
        np.repeat(stride.phase_indices, n_samples),
        np.concatenate(stride.states),
        -np.concatenate(delays) / period,
        period,
        np.swapaxes(np.concatenate(changes, 1), 2, 3),
        {name: np.concatenate(values, 1) for name, values in measures.items()},
        coordinates,
    )


def _differentiate_gait(
    gait: StableGait,
) -> tuple[float, list[np.ndarray], dict[str, list[np.ndarray]]]:
    """Return the period, and the derivatives of the section state after each step, and of the
    measures of each step, by the section state at its start.
    """
    params, _, options, section_states, _ = gait

    def measure(model: Any, x: Array) -> tuple[Array, dict[str, Array]]:
        if _is_system(gait):
            step = compile_step(model)(params, x, options)
            return step.section_state, {"period": step.duration}
        result = model.advance(params, x, options)
        length, period = model.compute_foot_distance(params, x), jnp.sum(result.durations)
        names = ("duration_dls", "duration_sls1", "duration_sls2")
        measures = {"period": period, "step_length": length, "speed": length / period}
        return result.section_state, measures | dict(zip(names, result.durations, strict=True))

    period, jacobians, gradients = 0.0, [], []
    for k, x in enumerate(section_states):
        evaluate = functools.partial(measure, gait.start_at_step(k).model)
        (_, values), derivatives = evaluate_with_jacobian(evaluate, jnp.asarray(x))
        period += float(values["period"])
        jacobian, gradient = jax.tree.map(np.asarray, derivatives)
        jacobians.append(jacobian)
        gradients.append(gradient)
    return period, jacobians, {name: [row[name] for row in gradients] for name in gradients[0]}


def _sample_gait(gait: StableGait, n_samples: int) -> _SampledGait:
    """Return samples of each phase that takes time in the steps of a gait, both ends included."""
    intervals, foot_distances, start_time = [], [], 0.0
    for k in range(len(gait.section_states)):
        phase_indices, times, states, foot_distance = _sample_first_step(
            gait.start_at_step(k), n_samples
        )
        intervals.append((np.full(len(times), k), phase_indices, start_time + times, states))
        foot_distances.append(foot_distance)
        start_time += times[-1, -1]
    steps, phases, times, states = map(np.concatenate, zip(*intervals, strict=True))
    return _SampledGait(steps, phases, times, states, tuple(foot_distances))


def _sample_first_step(
    gait: StableGait, n_samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Array | None]:
    """Return phases, times, states and foot distance of `_SampledGait` in the first step."""
    params, model, options, section_states, _ = gait
    x = jnp.asarray(section_states[0])
    if not _is_system(gait):
        trajectory = model.sample_step(params, x, options, n_samples)
        durations = np.asarray(trajectory.durations)
        phase_indices = np.flatnonzero(durations > 0.0)
        states = np.array(trajectory.state)[phase_indices]
        # Guards of positions end the phases in which positions can be pushed. The last sample is
        # therefore shortly before the event, where a small push does not skip it.
        time_left = (1.0 - LAST_SAMPLE_FRACTION) * durations[phase_indices, None]
        states[:, -1, :3] -= time_left * states[:, -1, 3:]
        times = np.asarray(trajectory.time)[phase_indices]
        return phase_indices, times, states, model.compute_foot_distance(params, x)
    start, n_events = model.embed(x, params), int(model.step(params, x, options).n_events)
    simulation = model.simulate(params, start, events=n_events, options=options)
    starts, durations = simulation.find_phases(start)
    times = np.concatenate([[0.0], np.asarray(simulation.times)])
    intervals = np.flatnonzero(np.asarray(durations) > 0.0)
    modes, samples = tuple(model.modes.values()), []
    for i in intervals:
        field: Any = modes[int(simulation.modes[i])].field
        rates = functools.partial(lambda field, y: field(y, params), field)
        duration = LAST_SAMPLE_FRACTION * durations[i]
        samples.append(sample_phase(rates, starts[i], duration, n_samples, options))
    return (
        np.asarray(simulation.modes)[intervals],
        np.stack([np.linspace(times[i], times[i + 1], n_samples) for i in intervals]),
        np.stack(samples),
        None,
    )

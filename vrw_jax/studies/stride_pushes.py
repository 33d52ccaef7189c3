"""Pushes of a gait within its stride: the response to small ones, and the smallest that ends it.

A small push changes the time until the next section and the section state there. Both changes are
exact across events. The later steps follow from the return map, so that the asymptotic change of
the phase is the product of an adjoint vector with the changes at the section. The smallest
disturbance that takes a wheel out of the basin of its gait is found by search.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base import batch_sizes
from vrw_jax.base.checks import check_int, check_positive, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.printing import AbstractPrintable, LabelAndText
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.walker import AdvanceResult
from vrw_jax.flow.hybrid_system import HybridSystem, compile_finish
from vrw_jax.flow.phase_integration import sample_phase
from vrw_jax.gaits.gait_search import limit_cycle
from vrw_jax.gaits.walker_finder import HybridGait
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import concatenate_tree_rows, map_in_batches, select_tree_rows
from vrw_jax.models.stepping import ModelLike
from vrw_jax.studies.basins import StableGait, walk_until_on_gait

DISTURBANCE_SIGNS = np.array([-1.0, 1.0])
"""Signs of the change of the angular velocity in backward and forward disturbances, in this order.
"""
DISTURBED_PHASE_NAMES = ("DLS", "SLS-I", "SLS-II")
ANGULAR_VELOCITY_INDEX = 3
"""Index of the angular velocity dtheta in a state (theta, L1, L2, dtheta, dL1, dL2)."""


class SmallestDisturbance(AbstractPrintable):
    """Smallest change of the angular velocity within a step that takes the state out of the basin.

    - `size`: smallest change, rad/s; infinite if no change up to `max_size` suffices;
    - `size_error`: error estimate of `size`, rad/s;
    - `direction`: 1 if the change makes the wheel faster, -1 if slower;
    - `time`: instant of the disturbance after the landing, s;
    - `phase_index`: phase of that instant, 0, 1, 2 for DLS, SLS-I, SLS-II;
    - `outcome`: Outcome that ends the walk after a slightly larger disturbance; STEPPED if the walk
      continues, but not on this gait;
    - `profile_times`: instants of the profile of sizes, after the landing, s, shape (instants,);
    - `profile_phase_indices`: index of the phase at each instant of the profile, shape (instants,);
    - `backward_sizes`, `forward_sizes`: smallest sufficient change in each direction at each
      instant of the profile, rad/s, shape (instants,);
    - `max_size`: largest change that the search tried, rad/s.

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

    @property
    def ending(self) -> str:
        """Return a sentence on how the walk ends after a slightly larger disturbance."""
        if not np.isfinite(self.size):
            return "No disturbance of the tried sizes leaves the basin."
        if self.outcome == Outcome.STEPPED:
            return "The wheel walks on, but not on this gait."
        return Outcome(int(self.outcome)).meaning

    def summary_rows(self) -> list[LabelAndText]:
        """Return pairs of label and text for size, direction, instant and outcome."""
        if not np.isfinite(self.size):
            return [("largest tried size", f"{self.max_size:.6g} rad/s"), ("ending", self.ending)]
        direction_text = "faster" if self.direction > 0 else "slower"
        return [
            ("size", f"{self.size:.6g} rad/s {direction_text} (error {self.size_error:.1g})"),
            (
                "instant",
                f"{self.time:.6g} s after the landing, {DISTURBED_PHASE_NAMES[self.phase_index]}",
            ),
            ("ending", self.ending),
        ]


@announce_wait("gaits, walks and derivatives", "20 s")
def smallest_disturbance(
    params: Any,
    *,
    model: ModelLike | None = None,
    cycle: Any = None,
    options: StepOptions | None = None,
    max_size: float | None = None,
    max_steps: int = 200,
) -> SmallestDisturbance:
    """Return the smallest disturbance within a step that takes the wheel out of its gait's basin.

    A disturbance is a sudden change of the angular velocity dtheta at one instant of the gait's
    step. The instant lies between a landing and the next landing. The size of the disturbance is
    the modulus of the change, rad/s. Positions do not change. In double support the two feet stay
    on the ground, so that dtheta determines the rates of the legs. In single support the rates of
    the legs do not change. The disturbed state is outside the basin if the walk from it does not
    arrive at the gait (see `basin_share`). With the paper's model, a departure from the sequence of
    phases, which need not be a fall, ends the walk.

    The search considers 17 instants of each phase, and forward and backward disturbances. A grid of
    sizes brackets the smallest sufficient size, and bisection in batches refines the bracket. Later
    passes refine the instants around the smallest size of each phase and direction. `size_error` is
    the sum of the width of the last bracket and the difference between sizes at neighboring
    instants of the last pass.

    Args:
        params: parameters of the wheel.
        model: model of the wheel: `ViscoelasticWheel()`, the paper's and the default, or
            `RigidWheel()`.
        cycle: a gait of one step; by default the result of `limit_cycle`.
        options: numerical options of the gait steps.
        max_size: largest change that the search tries, rad/s; by default twice the largest angular
            velocity of the gait.
        max_steps: largest number of gait steps of a walk after the disturbance.

    Returns:
        A `SmallestDisturbance`: its size, its instant, and the outcome that it causes.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the wheel has no stable gait.

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
    return compute_smallest_disturbance(stable_gait, max_size, max_steps)


class _DisturbedGait(NamedTuple):
    """Gait of one step, sampled within the step, and the limits of the search."""

    stable_gait: StableGait
    sample_times: np.ndarray  # after the landing, s, (phase, sample)
    sampled_states: np.ndarray  # (theta, L1, L2) and their rates, (phase, sample, 6)
    foot_distance: Array  # between the feet in double support, m
    max_size: float  # largest tried change, rad/s
    max_steps: int  # largest number of gait steps after the disturbance


class _DirectedInstants(NamedTuple):
    """Instants of a gait step, each with the direction of a disturbance, as arrays of shape
    (instants,).
    """

    phase_indices: np.ndarray
    sample_indices: np.ndarray
    disturbance_signs: np.ndarray


class _ExitSizeBrackets(NamedTuple):
    """Brackets of the smallest disturbance size that takes the state out of the basin.

    Each array has the shape (instants,).
    """

    lower_disturbance_sizes: np.ndarray  # rad/s
    upper_disturbance_sizes: np.ndarray  # rad/s, infinite if no tried size leaves the basin
    exit_outcomes: np.ndarray  # `Outcome` after a disturbance of the upper size

    @property
    def middle_disturbance_sizes(self) -> np.ndarray:
        """Return the middle of each bracket, rad/s, shape (instants,)."""
        return 0.5 * (self.lower_disturbance_sizes + self.upper_disturbance_sizes)


# Distances between neighboring instants, in samples of a phase, one for each pass of the search.
# The values are chosen because each pass then covers two intervals of the previous pass. The last
# pass resolves a ten-thousandth of a phase.
SAMPLE_STRIDES = (512, 64, 8, 1)
# Number of intervals between the instants that one pass considers in a phase.
N_INTERVALS_PER_PASS = 16
# Width of a bracket of sizes in the last pass, relative to the size. The value is chosen as the
# relative error of a gait step.
FINAL_DISTURBANCE_TOLERANCE = 1e-8
# Width of a bracket of sizes in all earlier passes, relative to the size. The value is chosen
# because sizes at neighboring instants differ by more than this width.
EARLY_DISTURBANCE_TOLERANCE = 1e-5


def compute_smallest_disturbance(
    stable_gait: StableGait, max_size: float | None, max_steps: int
) -> SmallestDisturbance:
    """Return the `SmallestDisturbance` for a gait of one step and for checked arguments.

    Each pass of the search considers instants that are closer to each other than in the pass
    before.
    """
    params, model, step_options, section_states = stable_gait
    n_phase_samples = N_INTERVALS_PER_PASS * SAMPLE_STRIDES[0] + 1  # both ends included
    start_state = jnp.asarray(section_states[0])
    trajectory = model.sample_step(params, start_state, step_options, n_phase_samples)
    sampled_states = np.asarray(trajectory.state)
    if max_size is None:
        max_size = 2.0 * float(sampled_states[..., ANGULAR_VELOCITY_INDEX].max())
    gait = _DisturbedGait(
        stable_gait,
        np.asarray(trajectory.time),
        sampled_states,
        jnp.asarray(model.take_step(params, start_state, step_options).step_length),
        max_size,
        max_steps,
    )
    occurring_phases = np.flatnonzero(np.asarray(trajectory.durations) > 0.0)
    # Each pass considers a window of samples for each phase and direction.
    n_windows = len(occurring_phases) * len(DISTURBANCE_SIGNS)
    window_centers = np.full(n_windows, n_phase_samples // 2)
    half_intervals = N_INTERVALS_PER_PASS // 2
    first_pass_result = None
    for sample_stride in SAMPLE_STRIDES:
        sample_offsets = sample_stride * np.arange(-half_intervals, half_intervals + 1)
        n_instants = len(sample_offsets)
        window_samples = np.clip(window_centers[:, None] + sample_offsets, 0, n_phase_samples - 1)
        instants = _DirectedInstants(
            np.repeat(occurring_phases, len(DISTURBANCE_SIGNS) * n_instants),
            window_samples.ravel(),
            np.tile(np.repeat(DISTURBANCE_SIGNS, n_instants), len(occurring_phases)),
        )
        is_last_pass = sample_stride == SAMPLE_STRIDES[-1]
        brackets = _bracket_exit_sizes(
            gait,
            instants,
            FINAL_DISTURBANCE_TOLERANCE if is_last_pass else EARLY_DISTURBANCE_TOLERANCE,
        )
        exit_sizes = brackets.middle_disturbance_sizes.reshape(n_windows, n_instants)
        window_centers = window_samples[np.arange(n_windows), exit_sizes.argmin(1)]
        first_pass_result = first_pass_result or (instants, brackets)
    assert first_pass_result is not None
    best_instant = int(exit_sizes.argmin())
    window_index, instant_index = divmod(best_instant, n_instants)
    size = float(exit_sizes[window_index, instant_index])
    phase_index = int(instants.phase_indices[best_instant])
    sample_index = instants.sample_indices[best_instant]
    size_error = 0.0
    if np.isfinite(size):
        size_error = float(
            brackets.upper_disturbance_sizes[best_instant]
            - brackets.lower_disturbance_sizes[best_instant]
        )
        if sample_index not in (0, n_phase_samples - 1):
            # Sizes at the neighboring instants of the last pass bound the change between two
            # instants.
            neighbor_sizes = exit_sizes[window_index, max(instant_index - 1, 0) : instant_index + 2]
            size_error += float(np.max(neighbor_sizes[np.isfinite(neighbor_sizes)]) - size)
    profile_instants, profile_brackets = first_pass_result
    is_backward = profile_instants.disturbance_signs < 0.0
    profile_phase_indices = profile_instants.phase_indices[is_backward]
    profile_sizes = profile_brackets.middle_disturbance_sizes
    return SmallestDisturbance(
        size=size,
        size_error=size_error,
        direction=int(instants.disturbance_signs[best_instant]),
        time=float(gait.sample_times[phase_index, sample_index]),
        phase_index=phase_index,
        outcome=np.asarray(brackets.exit_outcomes[best_instant]),
        profile_times=gait.sample_times[
            profile_phase_indices, profile_instants.sample_indices[is_backward]
        ],
        profile_phase_indices=profile_phase_indices,
        backward_sizes=profile_sizes[is_backward],
        forward_sizes=profile_sizes[~is_backward],
        max_size=max_size,
    )


# Number of disturbance sizes in the first grid. An interval of sufficient sizes may be missed if
# the grid spacing exceeds its width.
N_DISTURBANCE_GRID_SIZES = 24
# Number of sizes that divide a bracket, chosen because each batch then gains one digit.
N_SIZES_PER_BISECTION = 8


def _bracket_exit_sizes(
    gait: _DisturbedGait, instants: _DirectedInstants, size_tolerance: float
) -> _ExitSizeBrackets:
    """Return, for each instant and direction, a bracket of the smallest disturbance size that takes
    the state out of the basin.

    - `size_tolerance`: width of the final brackets, relative to the size.
    """
    n_instants = len(instants.disturbance_signs)
    lower_sizes, upper_sizes = np.zeros(n_instants), np.full(n_instants, np.inf)
    exit_outcomes = np.full(n_instants, int(Outcome.STEPPED))
    unresolved = np.arange(n_instants)
    grid_fractions = np.arange(1, N_DISTURBANCE_GRID_SIZES + 1) / N_DISTURBANCE_GRID_SIZES
    bisection_fractions = np.arange(1, N_SIZES_PER_BISECTION + 1) / (N_SIZES_PER_BISECTION + 1.0)
    tried_sizes = np.tile(gait.max_size * grid_fractions, (n_instants, 1))
    while len(unresolved):
        leaves_basin, walk_outcomes = _walk_after_disturbance(
            gait, select_tree_rows(instants, unresolved), tried_sizes
        )
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
    return _ExitSizeBrackets(
        np.where(np.isfinite(upper_sizes), lower_sizes, np.inf), upper_sizes, exit_outcomes
    )


def _walk_after_disturbance(
    gait: _DisturbedGait, instants: _DirectedInstants, disturbance_sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each walk after a disturbance misses the gait, and the `Outcome` of the walk.

    The two arrays have the shape of `disturbance_sizes`, (instants, sizes). The unit of the sizes
    is rad/s.
    """
    stable_gait, n_sizes = gait.stable_gait, disturbance_sizes.shape[1]
    phase_indices = np.repeat(instants.phase_indices, n_sizes)
    disturbed_states = np.repeat(
        gait.sampled_states[instants.phase_indices, instants.sample_indices], n_sizes, 0
    )
    disturbed_states[:, ANGULAR_VELOCITY_INDEX] += (
        instants.disturbance_signs[:, None] * disturbance_sizes
    ).ravel()
    walk_outcomes = np.empty(len(phase_indices), int)
    section_states = np.empty((len(phase_indices), stable_gait.section_states.shape[1]))
    for phase_index in np.unique(phase_indices):
        is_in_phase = phase_indices == phase_index
        finish_disturbed_batch = functools.partial(
            _finish_disturbed_steps, stable_gait, int(phase_index), gait.foot_distance
        )
        step_results: Any = map_in_batches(
            finish_disturbed_batch,
            batch_sizes.DISTURBANCE_BATCH_SIZES,
            disturbed_states[is_in_phase],
        )
        section_states[is_in_phase] = step_results.section_state
        walk_outcomes[is_in_phase] = step_results.outcome
    leaves_basin = np.ones(len(phase_indices), bool)
    has_stepped = np.flatnonzero(walk_outcomes == Outcome.STEPPED)
    if len(has_stepped):
        has_arrived, walk_outcomes[has_stepped], _ = walk_until_on_gait(
            stable_gait, section_states[has_stepped], gait.max_steps
        )
        leaves_basin[has_stepped] = ~has_arrived
    shape = disturbance_sizes.shape
    return leaves_basin.reshape(shape), walk_outcomes.reshape(shape)


@eqx.filter_jit
def _finish_disturbed_steps(
    stable_gait: StableGait, phase_index: int, foot_distance: Array, phase_states: Array
) -> AdvanceResult:
    """Return the results of gait steps that begin at `phase_states`, within the phase
    `phase_index`.

    - `phase_states`: states (theta, L1, L2) and their rates after the disturbance, shape (states,
      6).
    """
    params, model, options, _ = stable_gait
    finish_step = lambda phase_state: model.finish_step(
        params, phase_index, foot_distance, phase_state, options
    )
    return jax.vmap(finish_step)(phase_states)


class PhaseResponse(AbstractPrintable):
    """Response of a gait of one step to small changes of its state, at instants of the stride.

    All changes are per unit of the pushed coordinate, to first order.

    - `times`: instants after the start of the step, s, shape (instants,). An event has two
      instants, before and after it;
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


class _Phase(NamedTuple):
    """Samples of one phase of a stride, and the map from each instant to the section."""

    times: np.ndarray
    phase_indices: np.ndarray
    states: np.ndarray
    # Jacobian of (section state, remaining duration) by the state, (instants, n + 1, dim)
    remaining_jacobians: np.ndarray


class _Stride(NamedTuple):
    """Sampled stride of a gait, and its return map."""

    phases: list[_Phase]
    return_map_jacobian: np.ndarray
    measure_jacobians: dict[str, np.ndarray]  # derivatives of measures by the section state
    period: float


@announce_wait("steps and their derivatives", "30 s")
def phase_response(
    params: Any,
    *,
    cycle: Any = None,
    model: Any = None,
    n_samples: int = 17,
    n_steps: int = 3,
    options: StepOptions | None = None,
) -> PhaseResponse:
    """Return the response of a gait to small pushes at each instant of the stride.

    A push changes the state at one instant. After many steps, the walker is on its gait again, and
    ahead of or behind the unpushed walker by a constant fraction of the period: the asymptotic
    phase. The result contains this fraction, and the changes of the next steps and of their
    measures. Derivatives are exact across events, as are those of steps.

    Args:
        params: one wheel, or the parameters of a `HybridSystem`.
        cycle: a stable gait of one step, by default the result of `limit_cycle`.
        model: model of the wheel, the paper's by default, or a `HybridSystem`.
        n_samples: number of instants in each phase or mode, both ends included.
        n_steps: number of steps whose changes are returned.
        options: numerical options of the steps, by default tight.

    Returns:
        A `PhaseResponse` for all coordinates of the state.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the gait is unstable or has several
            steps; the message names the remedy.

    Examples:
        >>> response = vrw.phase_response(vrw.WheelParams(), n_samples=5)
        >>> print(f"{response.measures['period'][0, 0, 3]:.4f} s per rad/s in the next step")
        -0.1607 s per rad/s in the next step
    """
    n_samples, n_steps = check_int("n_samples", n_samples, 2), check_int("n_steps", n_steps)
    options = StepOptions.tight() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    if isinstance(model, HybridSystem):
        cycle = limit_cycle(params, model=model) if cycle is None else cycle
        check_type("cycle", cycle, HybridGait, "give vrw.limit_cycle(params, model=, guess=)")
        coordinates = tuple(model.state)
        stride = _sample_hybrid_stride(model, params, cycle.section_state, n_samples, options)
    else:
        gait = StableGait.from_cycle("vrw.phase_response", params, model, cycle, options, "pushes")
        coordinates = ("theta", "L1", "L2", "dtheta", "dL1", "dL2")
        stride = _sample_wheel_stride(gait, n_samples)
    jacobian, samples = stride.return_map_jacobian, concatenate_tree_rows(*stride.phases)
    if not np.max(np.abs(np.linalg.eigvals(jacobian))) < 1.0:
        raise ValueError(
            "the gait is unstable, so that a pushed walker does not return to it: give a stable "
            "gait of one step."
        )
    # The adjoint vector: derivative of the sum of all later durations by the section state.
    adjoint = np.linalg.solve(
        (np.eye(len(jacobian)) - jacobian).T, stride.measure_jacobians["period"]
    )
    by_section, by_time = np.split(samples.remaining_jacobians, [len(jacobian)], 1)
    delay = by_time[:, 0] + np.einsum("j,ijd->id", adjoint, by_section)
    section_changes = [by_section]
    for _ in range(n_steps - 1):
        section_changes.append(jacobian @ section_changes[-1])
    changes = np.stack(section_changes)
    return PhaseResponse(
        samples.times,
        samples.phase_indices,
        samples.states,
        -delay / stride.period,
        stride.period,
        np.swapaxes(changes, 2, 3),
        {
            name: np.einsum("j,kijd->kid", gradient, changes)
            for name, gradient in stride.measure_jacobians.items()
        },
        coordinates,
    )


def _sample_wheel_stride(gait: StableGait, n_samples: int) -> _Stride:
    params, model, options, section_states = gait
    x = jnp.asarray(section_states[0])
    trajectory = model.sample_step(params, x, options, n_samples)

    def measure(x: Array) -> tuple[Array, dict[str, Array]]:
        result = model.advance(params, x, options)
        length, period = model.compute_foot_distance(params, x), jnp.sum(result.durations)
        names = ("duration_dls", "duration_sls1", "duration_sls2")
        measures = {"period": period, "step_length": length, "speed": length / period}
        return result.section_state, measures | dict(zip(names, result.durations, strict=True))

    (_, measures), (return_map_jacobian, measure_jacobians) = evaluate_with_jacobian(measure, x)
    foot_distance = measures["step_length"]
    phases: list[_Phase] = []
    durations = np.asarray(trajectory.durations)
    for index in np.flatnonzero(durations > 0.0).tolist():

        def finish(index: int, y: Array) -> Array:
            result = model.finish_step(params, index, foot_distance, y, options)
            return jnp.append(result.section_state, jnp.sum(result.durations))

        states = jnp.asarray(trajectory.state[index])
        phases.append(
            _Phase(
                np.asarray(trajectory.time[index]),
                np.full(n_samples, index),
                np.asarray(states),
                np.asarray(_differentiate_each(functools.partial(finish, index), states)),
            )
        )
    return _Stride(
        phases,
        np.asarray(return_map_jacobian),
        jax.tree.map(np.asarray, measure_jacobians),
        float(measures["period"]),
    )


def _differentiate_by_states(finish: Callable[[Array], Array], states: Array) -> Array:
    return jax.vmap(lambda y: evaluate_with_jacobian(finish, y)[1])(states)


_differentiate_each = eqx.filter_jit(_differentiate_by_states)


@eqx.filter_jit
def _differentiate_rest(
    system: HybridSystem, params: Any, states: Array, mode: Array, options: StepOptions
) -> Array:
    """Return the derivatives of the end of a step by states in a mode, the same code for each."""

    def finish(y: Array) -> Array:
        rest = compile_finish(system)(params, y, mode, options)
        return jnp.append(rest.section_state, rest.duration)

    return _differentiate_by_states(finish, states)


def _sample_hybrid_stride(
    system: HybridSystem, params: Any, x: Array, n_samples: int, options: StepOptions
) -> _Stride:

    def advance(x: Array) -> tuple[Array, Array]:
        step = system.step(params, x, options)
        return step.section_state, step.duration

    step = system.step(params, x, options)
    jacobian, period_gradient = evaluate_with_jacobian(advance, x)[1]
    start, n_events = system.embed(x, params), int(step.n_events)
    simulation = system.simulate(params, start, events=n_events, options=options)
    starts, durations = simulation.find_phases(start)
    times = np.concatenate([[0.0], np.asarray(simulation.times)])
    phases: list[_Phase] = []
    mode_names = tuple(system.modes)
    for event in range(n_events):
        mode = simulation.modes[event]
        if not durations[event] > 0.0:
            continue
        vector_field: Any = system.modes[mode_names[int(mode)]].field
        field = functools.partial(lambda field, y: field(y, params), vector_field)
        states = sample_phase(field, starts[event], durations[event], n_samples, options)

        phases.append(
            _Phase(
                np.linspace(times[event], times[event + 1], n_samples),
                np.full(n_samples, int(mode)),
                np.asarray(states),
                np.asarray(_differentiate_rest(system, params, states, mode, options)),
            )
        )
    return _Stride(
        phases,
        np.asarray(jacobian),
        {"period": np.asarray(period_gradient)},
        float(step.duration),
    )

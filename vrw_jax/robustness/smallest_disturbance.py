"""Smallest disturbance within a step that takes a wheel out of the basin of its gait."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.cycles import AbstractCycle
from vrw_jax.models import AbstractWheel, AdvanceResult
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches
from vrw_jax.printing import AbstractPrintable, TextRow
from vrw_jax.robustness.gait_arrival import StableGait, walk_to_gait
from vrw_jax.runtime import with_default_settings
from vrw_jax.simulation import ModelLike
from vrw_jax.validation import check_int, check_positive
from vrw_jax.wheel import Outcome, WheelParams

DISTURBANCE_SIGNS = np.array([-1.0, 1.0])
"""Signs of the change of the angular velocity: backward, forward."""
DISTURBED_PHASE_NAMES = ("DLS", "SLS-I", "SLS-II")
ANGULAR_RATE_INDEX = 3
"""Index of the angular velocity in a state (theta, L1, L2 and their rates)."""


@dataclass(frozen=True)
class DisturbanceSearchOptions:
    """Options of the search for the smallest disturbance, over instants of a step and sizes."""

    sample_strides: tuple[int, ...] = (512, 64, 8, 1)
    """Distances of the instants of each pass, in samples of a phase, coarse to fine.

    The values are chosen because each pass then covers two intervals of the previous pass, and the
    last pass resolves a ten-thousandth of a phase."""
    n_intervals: int = 16
    """Number of intervals between the instants of a pass."""
    n_first_sizes: int = 24
    """Number of sizes in the first grid. A set of sizes that leaves the basin may be missed if it
    is narrower than the distance of these sizes."""
    n_bisection_sizes: int = 8
    """Number of sizes that divide a bracket, chosen because one batch then gains a digit."""
    size_tolerance: float = 1e-8
    """Width of a bracket in the last pass, relative to the size, chosen because this is the error
    of steps."""
    profile_tolerance: float = 1e-5
    """Relative width of a bracket in earlier passes, chosen because sizes at neighboring instants
    differ by more."""

    @property
    def n_samples(self) -> int:
        """Return the number of samples of a phase, both ends included."""
        return self.n_intervals * self.sample_strides[0] + 1


SEARCH_OPTIONS = DisturbanceSearchOptions()


class SmallestDisturbance(AbstractPrintable):
    """Smallest change of the angular velocity within a step that leaves the basin of the gait.

    - `size`: the smallest change, rad/s; infinite if none up to `max_size` leaves the basin;
    - `size_error`: estimate of its error, rad/s;
    - `direction`: 1 if the wheel becomes faster, -1 if it becomes slower;
    - `time`: instant of the disturbance after the landing, s;
    - `phase_index`: phase of that instant, 0, 1, 2 for DLS, SLS-I, SLS-II;
    - `outcome`: Outcome that ends the walk after a slightly larger disturbance; STEPPED if the
      wheel walks on, but not on this gait;
    - `times`: instants of the profile, s, shape (instants,);
    - `phase_indices`: their phases, shape (instants,);
    - `backward_sizes`, `forward_sizes`: smallest change that leaves the basin at each instant,
      rad/s, shape (instants,);
    - `max_size`: largest change tried, rad/s.

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
    times: Float[np.ndarray, " instants"]
    phase_indices: Int[np.ndarray, " instants"]
    backward_sizes: Float[np.ndarray, " instants"]
    forward_sizes: Float[np.ndarray, " instants"]
    max_size: float

    @property
    def ending(self) -> str:
        """Return how a walk ends after a slightly larger disturbance, as a sentence."""
        if not np.isfinite(self.size):
            return "No disturbance of the tried sizes leaves the basin."
        if self.outcome == Outcome.STEPPED:
            return "The wheel walks on, but not on this gait."
        return Outcome(int(self.outcome)).meaning

    def summary_rows(self) -> list[TextRow]:
        """Return labels and texts of size, direction, instant and outcome."""
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


@with_default_settings
def smallest_disturbance(
    params: WheelParams,
    *,
    model: ModelLike | None = None,
    cycle: AbstractCycle | None = None,
    options: StepOptions | None = None,
    max_size: float | None = None,
    max_steps: int = 200,
) -> SmallestDisturbance:
    """Return the smallest disturbance within a step that takes the wheel out of its gait's basin.

    A disturbance is a sudden change of the angular velocity dtheta at one instant of the step of
    the gait, from just after the landing to just before the next. Its size is the modulus of the
    change, rad/s. Positions do not change. In double support both feet stay on the ground, so that
    the rates of both legs follow from dtheta. In single support these rates do not change. A
    disturbance leaves the basin if the walk after it does not arrive at the gait (see
    `basin_share`). With the paper's model a walk that leaves the paper's sequence of phases ends,
    which need not be a fall.

    At each of 17 instants of each phase, for both directions, the first size that leaves the basin
    is bracketed by a grid of sizes and bisected, in batches. The smallest of each phase and
    direction is then refined over the instants. `size_error` adds the width of the last bracket and
    the difference between neighboring instants of the last pass.

    Args:
        params: the wheel.
        model: the paper's model, `ViscoelasticWheel()`, by default, or `RigidWheel()`.
        cycle: the gait, of one step; by default that of `limit_cycle`.
        options: numerical options of the steps.
        max_size: largest change that is tried, rad/s; by default twice the largest angular velocity
            of the gait.
        max_steps: largest number of steps of a walk after the disturbance.

    Returns:
        A `SmallestDisturbance`.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the wheel has no stable gait.

    Examples:
        >>> result = vrw.smallest_disturbance(vrw.WheelParams(damping=150.0))
        >>> print(f"{result.size:.3f} rad/s at {result.time:.2f} s")
        0.275 rad/s at 0.25 s
    """
    max_steps = check_int("max_steps", max_steps)
    gait = StableGait.find("vrw.smallest_disturbance", params, model, cycle, options)
    if not gait.model.capabilities.begins_within_step:
        raise ValueError(
            f"{type(gait.model).__name__} cannot begin within a step, so that disturbances within "
            "a step are not available: take ViscoelasticWheel() or RigidWheel(), or disturb starts "
            "by vrw.basin_share."
        )
    if len(gait.section_states) > 1:
        raise ValueError(
            f"cycle repeats after {len(gait.section_states)} steps, but disturbances are those of "
            "gaits of one step: give a cycle with period_n=1."
        )
    max_size = None if max_size is None else check_positive("max_size", max_size)
    return compute_smallest_disturbance(gait, max_size, max_steps)


def compute_smallest_disturbance(
    gait: StableGait,
    max_size: float | None,
    max_steps: int,
    search_options: DisturbanceSearchOptions = SEARCH_OPTIONS,
) -> SmallestDisturbance:
    """Return the result of `smallest_disturbance` for a gait of one step and checked arguments."""
    gait_step = _sample_step(gait, search_options.n_samples)
    if max_size is None:
        max_size = 2.0 * float(gait_step.states[..., ANGULAR_RATE_INDEX].max())
    return _search_instants(gait, gait_step, max_size, max_steps, search_options)


class _GaitStep(NamedTuple):
    """Samples of the step of a gait, over phases and samples."""

    times: np.ndarray  # after the landing, (phase, sample), s
    states: np.ndarray  # (theta, L1, L2) and their rates, (phase, sample, 6)
    phase_indices: tuple[int, ...]  # of the phases that take place
    distance: Array  # of both feet in double support, m


def _sample_step(gait: StableGait, n_samples: int) -> _GaitStep:
    """Return the samples of the gait's step at equal intervals of each phase."""
    x = jnp.asarray(gait.section_states[0])
    trajectory = gait.model.sample_step(gait.params, x, gait.options, n_samples)
    distance = jnp.asarray(gait.model.take_step(gait.params, x, gait.options).step_length)
    occurred_phases = tuple(int(i) for i in np.flatnonzero(np.asarray(trajectory.durations) > 0.0))
    return _GaitStep(
        np.asarray(trajectory.time), np.asarray(trajectory.state), occurred_phases, distance
    )


class _DirectedInstants(NamedTuple):
    """Instants of a step with a direction of the disturbance, on the leading axis."""

    phase_index: np.ndarray
    sample_index: np.ndarray
    direction: np.ndarray


class _ExitBrackets(NamedTuple):
    """Bracket of the smallest size that leaves the basin, for each instant and direction."""

    lower: np.ndarray  # rad/s
    upper: np.ndarray  # rad/s, infinite if no tried size leaves the basin
    outcome: np.ndarray  # at the upper size

    @property
    def size(self) -> np.ndarray:
        """Return the middle of the bracket, rad/s."""
        return 0.5 * (self.lower + self.upper)


def _search_instants(
    gait: StableGait,
    gait_step: _GaitStep,
    max_size: float,
    max_steps: int,
    search_options: DisturbanceSearchOptions,
) -> SmallestDisturbance:
    """Return the smallest disturbance over all instants, by passes with ever finer instants."""
    phase_directions = [
        (phase, direction) for phase in gait_step.phase_indices for direction in DISTURBANCE_SIGNS
    ]
    middle_samples = dict.fromkeys(phase_directions, search_options.n_samples // 2)
    half_intervals = search_options.n_intervals // 2
    first_pass = best_index = None
    for stride in search_options.sample_strides:
        sample_offsets = stride * np.arange(-half_intervals, half_intervals + 1)
        sample_windows = [
            np.clip(middle_samples[c] + sample_offsets, 0, search_options.n_samples - 1)
            for c in phase_directions
        ]
        n_instants = len(sample_offsets)
        directed_instants = _DirectedInstants(
            np.repeat([phase for phase, _ in phase_directions], n_instants),
            np.concatenate(sample_windows),
            np.repeat([direction for _, direction in phase_directions], n_instants),
        )
        is_last = stride == search_options.sample_strides[-1]
        tolerance = search_options.size_tolerance if is_last else search_options.profile_tolerance
        exit_brackets = _bracket_exits(
            gait, gait_step, directed_instants, max_size, max_steps, tolerance, search_options
        )
        sizes = exit_brackets.size.reshape(len(phase_directions), n_instants)
        lowest_indices = sizes.argmin(1)
        middle_samples = {
            c: sample_windows[i][lowest_indices[i]] for i, c in enumerate(phase_directions)
        }
        first_pass = first_pass or (directed_instants, exit_brackets)
        best_index = int(exit_brackets.size.argmin())
    assert first_pass is not None
    assert best_index is not None
    size, phase = (
        float(exit_brackets.size[best_index]),
        int(directed_instants.phase_index[best_index]),
    )
    size_error = 0.0
    if np.isfinite(size):
        size_error = float(exit_brackets.upper[best_index] - exit_brackets.lower[best_index])
        if directed_instants.sample_index[best_index] not in (0, search_options.n_samples - 1):
            # Neighbors of the last pass bound the change between two instants.
            curve_index, k = divmod(best_index, n_instants)
            neighbors = sizes[curve_index, max(k - 1, 0) : k + 2]
            size_error += float(np.max(neighbors[np.isfinite(neighbors)]) - size)
    is_backward = first_pass[0].direction < 0.0
    profile_phase, profile_sample = (
        index[is_backward] for index in (first_pass[0].phase_index, first_pass[0].sample_index)
    )
    return SmallestDisturbance(
        size=size,
        size_error=size_error,
        direction=int(directed_instants.direction[best_index]),
        time=float(gait_step.times[phase, directed_instants.sample_index[best_index]]),
        phase_index=phase,
        outcome=np.asarray(exit_brackets.outcome[best_index]),
        times=gait_step.times[profile_phase, profile_sample],
        phase_indices=profile_phase,
        backward_sizes=first_pass[1].size[is_backward],
        forward_sizes=first_pass[1].size[~is_backward],
        max_size=max_size,
    )


def _bracket_exits(
    gait: StableGait,
    gait_step: _GaitStep,
    directed_instants: _DirectedInstants,
    max_size: float,
    max_steps: int,
    size_tolerance: float,
    search_options: DisturbanceSearchOptions,
) -> _ExitBrackets:
    """Return the bracket of the smallest size that leaves the basin, for each instant and
    direction.
    """
    n_rays = len(directed_instants.direction)
    lower, upper = np.zeros(n_rays), np.full(n_rays, np.inf)
    outcome = np.full(n_rays, int(Outcome.STEPPED))
    size_fractions = np.arange(1, search_options.n_first_sizes + 1) / search_options.n_first_sizes
    selected_indices, tried_sizes = (
        np.arange(n_rays),
        np.tile(max_size * size_fractions, (n_rays, 1)),
    )
    while len(selected_indices):
        selected_instants = _DirectedInstants(
            *(values[selected_indices] for values in directed_instants)
        )
        leaves_basin, outcomes = _walk_after_disturbance(
            gait, gait_step, selected_instants, tried_sizes, max_steps
        )
        has_exit, first_exit = leaves_basin.any(1), leaves_basin.argmax(1)
        row_indices = np.arange(len(selected_indices))
        last_inside = np.where(has_exit, first_exit, tried_sizes.shape[1]) - 1
        largest_inside_size = np.where(
            last_inside >= 0, tried_sizes[row_indices, last_inside], lower[selected_indices]
        )
        upper[selected_indices] = np.where(
            has_exit, tried_sizes[row_indices, first_exit], upper[selected_indices]
        )
        outcome[selected_indices] = np.where(
            has_exit, outcomes[row_indices, first_exit], outcome[selected_indices]
        )
        lower[selected_indices] = np.where(
            np.isfinite(upper[selected_indices]), largest_inside_size, max_size
        )
        bracket_width = np.where(np.isfinite(upper), upper - lower, 0.0)
        selected_indices = np.flatnonzero(bracket_width > size_tolerance * upper)
        bracket_fractions = np.arange(1, search_options.n_bisection_sizes + 1) / (
            search_options.n_bisection_sizes + 1.0
        )
        tried_sizes = (
            lower[selected_indices, None]
            + bracket_width[selected_indices, None] * bracket_fractions
        )
    return _ExitBrackets(np.where(np.isfinite(upper), lower, np.inf), upper, outcome)


def _walk_after_disturbance(
    gait: StableGait,
    gait_step: _GaitStep,
    directed_instants: _DirectedInstants,
    sizes: np.ndarray,
    max_steps: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each disturbed walk leaves the basin, and its outcome, (instants, sizes)."""
    n_sizes = sizes.shape[1]
    states = np.repeat(
        gait_step.states[directed_instants.phase_index, directed_instants.sample_index], n_sizes, 0
    )
    states[:, ANGULAR_RATE_INDEX] += (directed_instants.direction[:, None] * sizes).ravel()
    phases = np.repeat(directed_instants.phase_index, n_sizes)
    outcome = np.empty(len(phases), int)
    section_states = np.empty((len(phases), gait.section_states.shape[1]))
    for phase in np.unique(phases):
        is_in_phase = phases == phase
        finish_block = functools.partial(
            _finish_steps, gait.model, gait.options, gait.params, int(phase), gait_step.distance
        )
        step_ends: Any = map_in_batches(
            finish_block, batch_sizes.DISTURBANCE_BATCH_SIZES, states[is_in_phase]
        )
        section_states[is_in_phase] = step_ends.section_state
        outcome[is_in_phase] = step_ends.outcome
    leaves_basin = np.ones(len(phases), bool)
    has_stepped = np.flatnonzero(outcome == Outcome.STEPPED)
    if len(has_stepped):
        walks = walk_to_gait(gait, section_states[has_stepped], max_steps)
        outcome[has_stepped], leaves_basin[has_stepped] = walks.outcome, ~walks.is_on_gait
    return leaves_basin.reshape(sizes.shape), outcome.reshape(sizes.shape)


@eqx.filter_jit
def _finish_steps(
    model: AbstractWheel,
    options: StepOptions,
    params: WheelParams,
    phase_index: int,
    distance: Array,
    states: Array,
) -> AdvanceResult:
    """Return the results of the rest of the step from each state within a phase."""
    finish_from = lambda state: model.finish_step(params, phase_index, distance, state, options)
    return jax.vmap(finish_from)(states)

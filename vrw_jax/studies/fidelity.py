"""Steps, gaits and walks of the models between which a measure to a tolerance chooses.

Steps with unilateral contact are computed in batches, with their Jacobians. The Jacobians of gaits
of the rigid model and of the paper's model propagate a defect of the return map to the measures.

In a fast walk, the states of the legs decay within a few steps. The remaining motion then drifts
slowly on one curve for hundreds of steps. A few steps determine the drift per step and its decay. A
leap in the direction of the drift replaces the remaining steps (projective integration: C. W. Gear
and I. G. Kevrekidis, SIAM J. Sci. Comput. 24, 2003). A leap ends at the latest at the predicted
limit of the drift. The state at the end of a walk is the initial guess for the refinement.
"""

import dataclasses
import enum
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.gaits.finder import GAIT_BATCH_SIZES
from vrw_jax.gaits.further_search import find_cycles_from_starts, search_further, summarize_search
from vrw_jax.gaits.gait_search import make_finder
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import (
    map_in_batches,
    replace_rows,
    select_rows_on_device,
    select_tree_rows,
)
from vrw_jax.models.contact_record import compute_min_bounce_height
from vrw_jax.models.contact_walks import embed_section_states, step_batch_with_jacobian, walk_batch
from vrw_jax.models.rigid import RigidWheel
from vrw_jax.models.step_batch import step_batch
from vrw_jax.models.unilateral_wheel import UnilateralWheel
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel.params import PARAMETER_NAMES, WheelParams

QUANTITY_NAMES = (
    "duration_dls", "duration_single", "duration_flight", "step_length", "theta_touchdown",
    "dtheta_touchdown", "dL1_touchdown",
)  # fmt: skip
"""Names of the quantities of one step that every model provides.

The first three are durations with two feet, one foot and no foot on the ground, s. The others are
the step length, m, and the section state (theta-, dtheta-, dL1-) of the paper after the step.
"""


def _compute_period(quantities: np.ndarray) -> np.ndarray:
    return quantities[..., 0] + quantities[..., 1] + quantities[..., 2]


MEASURE_FUNCTIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "speed": lambda quantities: quantities[..., 3] / _compute_period(quantities),
    "period": _compute_period,
    "dls_fraction": lambda quantities: quantities[..., 0] / _compute_period(quantities),
} | {name: itemgetter((..., index)) for index, name in enumerate(QUANTITY_NAMES)}
"""Functions that compute the measures of every model from the step quantities.

The keys are names in `measures.MEASURES`.
"""

COMPLEX_STEP = 1e-30
"""Imaginary increment of complex-step derivatives, chosen so that its square has no effect."""


def evaluate_measures(
    names: Sequence[str], quantities: np.ndarray, measure_axis: int = -1
) -> np.ndarray:
    """Return the measures, (wheels, measures), computed from step quantities, (wheels, 7).

    The measures of a failed walking step are NaN.
    """
    with np.errstate(invalid="ignore"):
        return np.stack([MEASURE_FUNCTIONS[name](quantities) for name in names], measure_axis)


def compute_measure_derivatives(names: Sequence[str], quantities: np.ndarray) -> np.ndarray:
    """Return the complex-step derivatives of measures by step quantities, (wheels, measures, 7)."""
    increments = 1j * COMPLEX_STEP * np.eye(len(QUANTITY_NAMES))
    return evaluate_measures(names, quantities[:, None, :] + increments, 1).imag / COMPLEX_STEP


class StepQuantities(NamedTuple):
    """Section states, step quantities and outcomes of walking steps, one for each wheel."""

    # (wheels, 4 + 3 n): section states after the step; zeros if the step failed
    section_states: np.ndarray
    step_quantities: np.ndarray  # (wheels, 7), in the order of `QUANTITY_NAMES`
    step_outcomes: np.ndarray


# Tolerance for most steps, chosen because steps at a looser tolerance save a seventh of the time
# but miss events.
TIGHT_TOLERANCE = 1e-10
# Tolerance for measures with a small allowed error. A step at this tolerance costs a third more
# than a step at `TIGHT_TOLERANCE`.
VERY_TIGHT_TOLERANCE = 1e-12
# Tolerance for walks with the solver Tsit5. A step at this tolerance costs a quarter of a step at
# `TIGHT_TOLERANCE`. The value is chosen because walks at 1e-5 miss three of 118 gaits.
WALK_TOLERANCE = 3e-6
# Further tolerances at which steps are repeated if feet may graze the ground. The numerical error
# is estimated from the differences between these steps.
TIGHT_COMPARISON_TOLERANCES = (1e-12, 1e-11, 3e-11)
# Such tolerances for steps at `VERY_TIGHT_TOLERANCE`.
VERY_TIGHT_COMPARISON_TOLERANCES = (1e-13, 3e-12, 1e-11)


@dataclasses.dataclass(frozen=True)
class ContactWheelBatch:
    """Batch of wheels with unilateral contact, each with its own friction coefficient."""

    parameter_matrix: np.ndarray  # (10, wheels): parameters and friction
    n_legs: int  # number of legs of each wheel
    contact_model: UnilateralWheel
    step_options: StepOptions

    @classmethod
    def from_params(
        cls, params: WheelParams, friction: np.ndarray, stoppers: str, options: StepOptions
    ) -> "ContactWheelBatch":
        """Return the batch of wheels whose `params` and `friction` have one batch axis."""
        parameters = [np.asarray(getattr(params, name)) for name in PARAMETER_NAMES]
        contact_model = UnilateralWheel(stoppers=stoppers)  # type: ignore[arg-type]
        return cls(np.stack([*parameters, friction]), params.n_legs, contact_model, options)

    def embed_paper_states(
        self, wheel_indices: np.ndarray, section_states: np.ndarray
    ) -> np.ndarray:
        """Return full section states, (wheels, 4 + 3 n), for states of the paper, (wheels, 3).

        `wheel_indices` selects the wheels.
        """
        parameters = self.parameter_matrix[:, wheel_indices]
        return np.array(embed_section_states(parameters, section_states, self.n_legs))

    def take_steps(
        self, wheel_indices: np.ndarray, section_states: np.ndarray, n_steps: int = 1
    ) -> StepQuantities:
        """Return the result of `n_steps` walking steps that begin at `section_states`.

        The section states are full, (wheels, 4 + 3 n). `wheel_indices` selects the wheels.
        """
        end_states, durations, step_outcomes, *_, step_length = walk_batch(
            self.parameter_matrix[:, wheel_indices],
            section_states,
            n_steps,
            self.contact_model,
            self.step_options,
            self.n_legs,
        )
        quantities = self._stack_step_quantities(durations, step_length, end_states)
        return StepQuantities(end_states, quantities, step_outcomes)

    def linearize_steps(
        self, wheel_indices: np.ndarray, section_states: np.ndarray
    ) -> tuple[StepQuantities, np.ndarray, np.ndarray]:
        """Return the result of one walking step from full section states, and two Jacobians.

        The first Jacobian is that of the next section state, (wheels, 4 + 3 n, 4 + 3 n). The second
        is that of the step quantities, (wheels, 7, 4 + 3 n). The derivatives are with respect to
        the full section state at the start.
        """
        parameters = self.parameter_matrix[:, wheel_indices]
        first_input = len(parameters)
        step, jacobian = jax.tree.map(
            np.asarray,
            step_batch_with_jacobian(
                parameters,
                section_states,
                self.contact_model,
                self.step_options,
                self.n_legs,
                range(first_input, first_input + section_states.shape[1]),
            ),
        )
        quantities, quantity_jacobian = (
            self._stack_step_quantities(x.durations, x.step_length, x.section_state)
            for x in (step, jacobian)
        )
        return (
            StepQuantities(step.section_state, quantities, step.outcome),
            jacobian.section_state[:, :, first_input:],
            quantity_jacobian[:, :, first_input:],
        )

    def _stack_step_quantities(
        self, durations: Any, step_length: Any, end_states: Any
    ) -> np.ndarray:
        """Return the step quantities or their derivatives as one array, (wheels, 7, ...)."""
        paper_states = end_states[:, self.list_paper_state_indices()]
        return np.concatenate([durations, step_length[:, None], paper_states], 1)

    def replace_tolerance(self, tolerance: float, **settings: Any) -> "ContactWheelBatch":
        """Return a copy of the batch with another solver tolerance and further settings."""
        options = StepOptions(rtol=tolerance, atol=tolerance, **settings)
        return dataclasses.replace(self, step_options=options)

    def make_walk_batch(self) -> "ContactWheelBatch":
        """Return a copy of the batch with the looser solver tolerance for walks."""
        return self.replace_tolerance(WALK_TOLERANCE, solver="Tsit5")

    def make_comparison_batches(self) -> list["ContactWheelBatch"]:
        """Return a copy of the batch for each solver tolerance at which steps are compared."""
        is_very_tight = float(self.step_options.rtol) < 0.5 * TIGHT_TOLERANCE
        tolerances = (
            VERY_TIGHT_COMPARISON_TOLERANCES if is_very_tight else TIGHT_COMPARISON_TOLERANCES
        )
        return list(map(self.replace_tolerance, tolerances))

    def compute_min_contact_duration(self, wheel_indices: np.ndarray) -> np.ndarray:
        """Return the shortest contact duration that the solver resolves for each selected wheel, s.

        It is the flight time of the smallest bounce that the solver resolves.
        """
        # A scalar is used because JAX would compile a program for each batch size.
        relative_height = float(compute_min_bounce_height(jnp.ones(()), self.step_options))
        length, gravity = (
            self.parameter_matrix[PARAMETER_NAMES.index(name)]
            for name in ("locked_length", "gravity")
        )
        return np.sqrt(8.0 * (relative_height * length) / gravity)[wheel_indices]

    def list_paper_state_indices(self) -> np.ndarray:
        """Return the indices of theta-, dtheta- and dL1- in a full section state."""
        return np.array([0, 1, 4 + self.n_legs])


class ModelIndex(enum.IntEnum):
    """Index of a wheel model, in order of increasing fidelity."""

    NONE = 0
    RIGID = 1
    VISCOELASTIC = 2
    UNILATERAL = 3


MODEL_NAMES = (
    "none",
    *(model_class.model_name for model_class in (RigidWheel, ViscoelasticWheel, UnilateralWheel)),
)
"""Names of the models, in the order of `ModelIndex`."""


def multiply_rows(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the product of a matrix and a vector in each row of a batch.

    Its bits do not depend on the batch, which `numpy.einsum` does not promise.
    """
    return np.matmul(matrices, vectors[..., None])[..., 0]


class LowerFidelityGaits(NamedTuple):
    """Gait of each wheel, computed with a model whose section state is (theta-, dtheta-, dL1-).

    The first axis of each field contains the wheels.
    """

    model_index: np.ndarray  # a ModelIndex, NONE if there is no gait
    section_states: np.ndarray  # (wheels, 3)
    step_quantities: np.ndarray  # (wheels, 7): step quantities from the section state
    inverse_newton_matrix: np.ndarray  # (wheels, 3, 3): (I - DP)^-1, where P is the return map
    # (wheels, 7, 3): derivatives of the step quantities with respect to the section state
    step_quantity_jacobian: np.ndarray
    # (wheels, 3): `inverse_newton_matrix` times the defect of the return map
    section_state_error: np.ndarray

    @classmethod
    def without_gait(cls, n_wheels: int) -> "LowerFidelityGaits":
        """Return the value in which none of `n_wheels` wheels has a gait."""
        n_quantities = len(QUANTITY_NAMES)
        return cls.from_steps(
            ModelIndex.NONE,
            np.zeros((n_wheels, 3)),
            np.full((n_wheels, n_quantities), np.nan),
            np.zeros((n_wheels, n_quantities, 3)),
        )

    @classmethod
    def from_steps(
        cls, model: ModelIndex, section_states: Any, quantities: Any, jacobian: Any
    ) -> "LowerFidelityGaits":
        """Return the gaits of one model from the starts, quantities and Jacobians of their steps.

        The last step quantities are the section state after the step.
        """
        with np.errstate(all="ignore"):
            inverse = np.linalg.inv(np.eye(3) - jacobian[:, -3:])
        error = multiply_rows(inverse, quantities[:, -3:] - section_states)
        models = np.full(len(section_states), model)
        return cls(models, section_states, quantities, inverse, jacobian, error)


def find_paper_gaits(params: WheelParams, step_options: StepOptions) -> LowerFidelityGaits:
    """Return the gaits of the paper's model for a batch of wheels, computed by collocation.

    The Jacobians are those of one walking step from each gait's section state.
    """
    finder: Any = make_finder(None, params.n_legs)
    cycles = map_in_batches(finder.find_cycles, GAIT_BATCH_SIZES, params)
    section_states, outcomes = np.array(cycles.section_state), np.array(cycles.outcome)
    # Each element has its own mesh, so that its digits do not depend on the batch.
    for _, wheel_indices, mesh_search in search_further(
        find_cycles_from_starts,
        finder,
        params,
        summarize_search(cycles),
        GAIT_BATCH_SIZES,
    ):
        section_states[wheel_indices] = mesh_search.gaits.section_state
        outcomes[wheel_indices] = mesh_search.outcome
    gaits = LowerFidelityGaits.without_gait(len(section_states))
    (found,) = np.nonzero(outcomes == Outcome.STEPPED)
    if not len(found):
        return gaits
    wheels, section_states = select_rows_on_device(params, found), section_states[found]
    step = step_batch(wheels, section_states, options=step_options, derivatives=["section_state"])
    jacobian = jax.tree.map(np.asarray, step.derivatives["section_state"])
    end_states = np.asarray(step.section_state)
    # The feet's distance at touchdown is L0 sin(alpha) / cos(theta-), m.
    leg_span = np.asarray(wheels.locked_length) * np.sin(wheels.leg_angle)
    distance = leg_span / np.cos(end_states[:, 0])
    distance_rate = distance * np.tan(end_states[:, 0])
    quantities, quantity_jacobian = (
        np.concatenate(
            [
                durations[:, :1],
                durations[:, 1:2] + durations[:, 2:],
                0.0 * durations[:, :1],
                distances[:, None],
                states,
            ],
            1,
        )
        for durations, distances, states in (
            (np.asarray(step.durations), distance, end_states),
            (
                jacobian.durations,
                distance_rate[:, None] * jacobian.section_state[:, 0],
                jacobian.section_state,
            ),
        )
    )
    has_stepped = np.asarray(step.outcome) == Outcome.STEPPED
    stepped_gaits = LowerFidelityGaits.from_steps(
        ModelIndex.VISCOELASTIC, section_states, quantities, quantity_jacobian
    )
    return replace_rows(gaits, found[has_stepped], select_tree_rows(stepped_gaits, has_stepped))


def find_rigid_gaits(params: WheelParams) -> LowerFidelityGaits:
    """Return the gaits of rigid wheels with the classic impact, in closed form.

    In the classic impact, the rear foot leaves the ground at landing. If legs are stiff, gaits with
    unilateral contact approach this gait. If the rear foot stays on the ground at landing, as in
    the paper, the gait is half as fast again.
    """
    gaits = map_in_batches(_compute_rigid_gaits, GAIT_BATCH_SIZES, params)
    return LowerFidelityGaits.from_steps(ModelIndex.RIGID, *map(np.asarray, gaits))


@jax.jit
@jax.vmap
def _compute_rigid_gaits(params: WheelParams) -> tuple:
    model = RigidWheel(stop_at_lift_off=False)

    def compute_quantities(x: jax.Array) -> jax.Array:
        step = model.take_step(params, x, StepOptions())
        no_time = jnp.zeros_like(step.step_length)
        period = jnp.sum(step.durations)
        return jnp.stack([no_time, period, no_time, step.step_length, *step.section_state])

    section_state = model.compute_default_start(params)
    return section_state, *evaluate_with_jacobian(compute_quantities, section_state)


def compute_static_leg_contraction(params: WheelParams) -> np.ndarray:
    """Return the static contraction of one leg under the wheel's weight, divided by the leg length.

    The relative error of the rigid model has this order of magnitude.
    """
    s = jax.tree.map(np.asarray, params.symbols())
    return s.Mt * s.g / (np.asarray(params.stiffness) * s.L0)


class WalkEnds(NamedTuple):
    """Full section state and outcome at the end of each walk."""

    has_settled: np.ndarray  # whether the walk has settled, probably near a gait
    section_states: np.ndarray  # (walks, 4 + 3 n)
    walk_outcomes: np.ndarray  # STEPPED, or the failure that ended the walk
    n_steps: np.ndarray  # number of walking steps


# Number of walking steps before the first leap.
N_WARMUP_STEPS = 20
# Largest number of leaps.
MAX_LEAPS = 10
# Number of walking steps after a leap. The value is chosen because five steps miss three of 118
# gaits, among 451 wheels for which the paper's model has no gait.
N_STEPS_PER_LEAP = 7
# Largest length of a leap, in rad, rad/s, m and m/s, chosen because longer leaps skip pairs of
# close gaits.
MAX_LEAP_DISTANCE = 0.15
# Largest ratio of the fade distance to the length of all remaining leaps together. A walk with a
# larger ratio ends. The fade distance is the distance to the predicted limit of the drift.
MAX_FADE_DISTANCE_RATIO = 2.0
# Largest number of remaining leaps at which `MAX_FADE_DISTANCE_RATIO` is tested, chosen because a
# drift may first grow and then decay.
MAX_LEAPS_LEFT_TO_GIVE_UP = 3


def walk_until_settled(
    wheel_batch: ContactWheelBatch, wheel_indices: np.ndarray, section_states: np.ndarray
) -> WalkEnds:
    """Return the ends of walks that start at full section states, (walks, 4 + 3 n).

    Each walk settles, fails, or ends without settling after the last leap.
    """
    n_walks, n_continuous_entries = len(wheel_indices), section_states.shape[1] - wheel_batch.n_legs
    loose_step_batch = wheel_batch.make_walk_batch()
    walk_ends = WalkEnds(
        np.zeros(n_walks, bool),
        section_states.copy(),
        np.full(n_walks, int(Outcome.STEPPED)),
        np.zeros(n_walks, int),
    )
    active_walk_indices, start_states = np.arange(n_walks), section_states
    n_steps_before_leaps = (N_WARMUP_STEPS, *MAX_LEAPS * (N_STEPS_PER_LEAP,))
    for leap_index, n_steps_before_leap in enumerate(n_steps_before_leaps):
        if not len(active_walk_indices):
            break
        walk_ends.n_steps[active_walk_indices] += n_steps_before_leap
        active_wheel_indices = wheel_indices[active_walk_indices]
        third_last_step = loose_step_batch.take_steps(
            active_wheel_indices, start_states, n_steps_before_leap - 2
        )
        failed_walk_indices = np.flatnonzero(third_last_step.step_outcomes != Outcome.STEPPED)
        if len(failed_walk_indices):
            # A leap failed, or the tolerance of the first steps is too loose.
            retried_step = (loose_step_batch if leap_index else wheel_batch).take_steps(
                active_wheel_indices[failed_walk_indices],
                walk_ends.section_states[active_walk_indices[failed_walk_indices]],
                n_steps_before_leap - 2,
            )
            third_last_step = replace_rows(third_last_step, failed_walk_indices, retried_step)
        last_steps = [third_last_step]
        for _ in range(2):
            last_steps.append(
                loose_step_batch.take_steps(active_wheel_indices, last_steps[-1].section_states)
            )
        step_outcomes = np.stack([step.step_outcomes for step in last_steps])
        has_stepped = np.all(step_outcomes == Outcome.STEPPED, axis=0)
        first_failed_step_index = np.argmax(step_outcomes != Outcome.STEPPED, axis=0)
        walk_ends.walk_outcomes[active_walk_indices] = step_outcomes[
            first_failed_step_index, np.arange(len(active_walk_indices))
        ]
        active_walk_indices = active_walk_indices[has_stepped]
        last_states = np.stack([step.section_states[has_stepped] for step in last_steps])
        walk_ends.section_states[active_walk_indices] = last_states[-1]
        walk_ends.has_settled[active_walk_indices], leap_vectors, fade_distance = (
            _extrapolate_drift(last_states, n_continuous_entries)
        )
        n_remaining_leaps = MAX_LEAPS - leap_index
        is_walk_continued = ~walk_ends.has_settled[active_walk_indices] & (
            (n_remaining_leaps > MAX_LEAPS_LEFT_TO_GIVE_UP)
            | (fade_distance <= MAX_FADE_DISTANCE_RATIO * MAX_LEAP_DISTANCE * n_remaining_leaps)
        )
        active_walk_indices = active_walk_indices[is_walk_continued]
        start_states = walk_ends.section_states[active_walk_indices]
        # Each walking step first places loaded feet on the slope, so a leap ends at a valid start.
        start_states[:, :n_continuous_entries] += leap_vectors[is_walk_continued]
    return walk_ends


# Largest drift per walking step, and largest fade distance, in a settled walk.
MAX_SETTLED_DRIFT = 5e-4
# Drift per walking step below which errors of the steps dominate.
DRIFT_NOISE_LEVEL = 1e-5


def _extrapolate_drift(
    last_states: np.ndarray, n_continuous_entries: int
) -> tuple[np.ndarray, ...]:
    """Return whether each walk has settled, the leap of each walk, and the fade distance.

    The first `n_continuous_entries` entries of a section state are continuous. A leap starts at the
    last state. The fade distance is the distance from this state to the predicted limit of the
    drift. The leap and the fade distance are zero if the contact codes of the legs change.

    - `last_states`: last three section states of each walk, (3, walks, 4 + 3 n).
    """
    leg_codes = last_states[:, :, n_continuous_entries:]
    has_same_leg_codes = np.all(leg_codes == leg_codes[-1], axis=(0, 2))
    earlier_state_change, last_state_change = np.diff(
        last_states[:, :, :n_continuous_entries], axis=0
    )
    drift_per_step = np.abs(last_state_change).max(1)
    with np.errstate(all="ignore"):
        decay_rate = np.nan_to_num(
            np.sum(earlier_state_change * last_state_change, axis=1)
            / np.sum(earlier_state_change * earlier_state_change, axis=1)
        )
        n_steps_to_fade = np.where(decay_rate < 1.0, decay_rate / (1.0 - decay_rate), np.inf)
        fade_distance = np.where(
            drift_per_step < DRIFT_NOISE_LEVEL, 0.0, np.abs(n_steps_to_fade) * drift_per_step
        )
        n_leap_steps = np.where(
            drift_per_step > 0.0,
            np.minimum(n_steps_to_fade, MAX_LEAP_DISTANCE / drift_per_step),
            0.0,
        )
    # A drift that changes sign at each step leads to a gait of two steps.
    has_settled = (
        has_same_leg_codes
        & (fade_distance < MAX_SETTLED_DRIFT)
        & (drift_per_step < MAX_SETTLED_DRIFT)
    )
    has_leap_vector = has_same_leg_codes & ~has_settled & (decay_rate > 0.0)
    return (
        has_settled,
        np.where(has_leap_vector, n_leap_steps, 0.0)[:, None] * last_state_change,
        np.where(has_same_leg_codes, fade_distance, 0.0),
    )

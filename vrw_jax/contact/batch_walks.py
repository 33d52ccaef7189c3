"""Batch entry points for unilateral contact: walks of many steps, and one step with its
Jacobian.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.contact.batch_integrator import pack_coordinates
from vrw_jax.contact.contact_modes import ContactMode
from vrw_jax.contact.impacts import project_motion
from vrw_jax.contact.mechanics import WheelMotion
from vrw_jax.contact.section import (
    LOCKED_CODE_OFFSET,
    compute_section_units,
    embed_section_state,
    full_section_size,
    unpack_section_state,
)
from vrw_jax.contact.step_record import UnilateralStep
from vrw_jax.contact.unilateral_wheel import UnilateralWheel
from vrw_jax.contact.walk_kernel import (
    N_PARAMETERS,
    N_UNEVEN_COLUMNS,
    BatchWalkSettings,
    make_result_template,
    run_walks,
)
from vrw_jax.contact.walk_tangents import walk_with_tangents
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches
from vrw_jax.runtime import compile_cached_lane_program
from vrw_jax.wheel import PARAMETER_NAMES, Symbols, compute_symbols, compute_wheel_units_of_rows


def walk_batch(
    input_columns: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: StepOptions,
    n: int,
) -> tuple[np.ndarray, ...]:
    """Return the results of `n_steps` steps of many wheels with `n` legs, with wheels on the
    leading axis.

    The results are section states, durations (s), outcomes, numbers of completed steps and of
    solver steps, and lengths (m) of the last step.

    - `input_columns`: parameters in their order and friction, shape (10, wheels). On uneven ground,
      with one step at a time, two more columns follow: see `N_UNEVEN_COLUMNS`;
    - `states`: full section states, shape (wheels, 4 + 3 n).
    """
    config = _WalkConfig.from_model(model, options, n, False, len(input_columns))
    walk_arguments = [_append_restitution(input_columns, model), states.T]
    walk_result = _run_walk(config, walk_arguments, n_steps, options)
    summary = walk_result.step_result
    result_counts = walk_result.outcome, walk_result.n_stepped, walk_result.n_solver_steps
    return summary.section_state, summary.durations, *result_counts, summary.step_length


def step_batch_with_jacobian(
    input_columns: np.ndarray,
    states: np.ndarray,
    model: UnilateralWheel,
    options: StepOptions,
    n: int,
    input_indices: Sequence[int] | None = None,
) -> tuple[UnilateralStep, UnilateralStep]:
    """Return one step of many wheels, with input as in `walk_batch`, and the Jacobian of its
    results.

    The leading axis is over wheels. Derivatives have a last axis over the input columns, then the
    section state. Entries that are not in `input_indices` or cannot vary have zero derivatives.
    Lengths of legs on their stoppers or with loaded feet, and codes, cannot vary. The number of
    rate tangents is the number that loaded feet leave independent (see `_IndependentRates`).
    """
    config = _WalkConfig.from_model(model, options, n, True, len(input_columns))
    if len(states):  # The longest compilation starts first.
        _compile_walk(
            config,
            input_columns.dtype,
            jax.tree.structure(eqx.filter(options, eqx.is_array)),
        )
    contact_codes = np.round(states[:, 4 + 2 * n :]).astype(int)
    step_inputs = np.concatenate([input_columns.T, states], 1)
    has_tangent = np.ones(step_inputs.shape, bool)
    is_off_stopper = contact_codes < LOCKED_CODE_OFFSET
    is_variable_entry = [
        is_off_stopper & ((contact_codes & (LOCKED_CODE_OFFSET - 1)) == ContactMode.OFF),
        is_off_stopper,
        np.zeros(contact_codes.shape, bool),
    ]
    has_tangent[:, len(input_columns) + 4 :] = np.concatenate(is_variable_entry, 1)
    if input_indices is not None:
        has_tangent &= np.isin(np.arange(step_inputs.shape[1]), input_indices)
    rate_indices = len(input_columns) + np.array([1, 2, 3, *range(4 + n, 4 + 2 * n)])
    section_units = compute_section_units(compute_wheel_units_of_rows(input_columns.T, n), n)
    rate_units = np.stack(section_units, -1)[:, rate_indices - len(input_columns)]
    projected_units = rate_units[:, [1, 2, 0, *range(3, 3 + n)]]  # as in `pack_coordinates`
    projection = _project_rates(input_columns, states, n) * (
        rate_units[:, None] / projected_units[:, :, None]
    )
    independent_rates = _IndependentRates.from_projection(
        projection, has_tangent[:, rate_indices]
    ).convert_to_si(rate_units)
    has_tangent[:, rate_indices] = independent_rates.is_independent()
    wheel_index, input_index = np.nonzero(has_tangent)
    lane_index, tangent_position, lane_wheels = _pack_tangents(has_tangent.sum(1))
    tangent_input_indices = np.full((MAX_TANGENTS_PER_LANE, len(lane_wheels)), -1.0)
    tangent_input_indices[tangent_position, lane_index] = input_index
    walk_arguments = [
        _append_restitution(input_columns[:, lane_wheels], model),
        states[lane_wheels].T,
        tangent_input_indices,
    ]
    walk_result, tangents = _run_walk(
        config, walk_arguments, 1, options.with_derivative_tolerances()
    )
    first_lane = np.searchsorted(lane_wheels, np.arange(len(states)))

    def gather_tangents(leaf: np.ndarray) -> np.ndarray:
        jacobian_rows = np.zeros((*step_inputs.shape, *leaf.shape[2:]), leaf.dtype)
        jacobian_rows[wheel_index, input_index] = leaf[lane_index, tangent_position]
        jacobian_rows[:, rate_indices] = independent_rates.expand_to_all_rates(
            jacobian_rows[:, rate_indices]
        )
        return np.moveaxis(jacobian_rows, 1, -1)

    return jax.tree.map(lambda x: x[first_lane], walk_result.step_result), jax.tree.map(
        gather_tangents, tangents
    )


def _append_restitution(input_columns: np.ndarray, model: UnilateralWheel) -> np.ndarray:
    """Return the input columns with the model's restitution, if given, as the last one."""
    if model.restitution is None:
        return input_columns
    restitution_row = np.full_like(input_columns[:1], np.asarray(model.restitution))
    return np.concatenate([input_columns, restitution_row])


MAX_TANGENTS_PER_LANE = 16
"""Largest number of tangents in one lane. More tangents are distributed over several lanes."""


def _pack_tangents(n_tangents_by_wheel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lane and the position in the lane of each tangent, and the wheel of each lane.

    Tangents are ordered by wheel.
    """
    n_lanes_by_wheel = np.maximum(-(-n_tangents_by_wheel // MAX_TANGENTS_PER_LANE), 1)
    first_lane = np.cumsum(n_lanes_by_wheel) - n_lanes_by_wheel
    tangent_position = np.concatenate([np.arange(n) for n in n_tangents_by_wheel])
    lane_index = (
        np.repeat(first_lane, n_tangents_by_wheel) + tangent_position // MAX_TANGENTS_PER_LANE
    )
    return (
        lane_index,
        tangent_position % MAX_TANGENTS_PER_LANE,
        np.repeat(np.arange(len(n_tangents_by_wheel)), n_lanes_by_wheel),
    )


RANK_TOLERANCE = 1e-10
"""Remainder of a dependent rate that counts as round-off, as a fraction of the largest. An
independent rate has a remainder of order one, like the projection."""


class _IndependentRates(NamedTuple):
    """Independent rates of section states, and the other rates as combinations of these.

    A loaded foot constrains the wheel: a resting foot leaves two of the four rates of hub and leg
    independent.
    """

    indices: np.ndarray  # index of each independent rate, (wheels, independent)
    is_used: np.ndarray  # whether each of these exists
    combination_weights: np.ndarray  # of each in all rates, (wheels, independent, rates)

    @classmethod
    def from_projection(
        cls, projection: np.ndarray, is_requested: np.ndarray
    ) -> "_IndependentRates":
        """Return the independent rates of a start's projection, (wheels, projected rates, rates).

        Of the rates `is_requested`, the one with the largest remainder is selected repeatedly.
        """
        requested_projection = np.nan_to_num(projection) * is_requested[:, None]
        remainder, wheel_indices = requested_projection.copy(), np.arange(len(is_requested))
        max_norm = np.sqrt(np.sum(remainder**2, 1)).max(-1)
        indices: list[np.ndarray] = []
        is_used: list[np.ndarray] = []
        unit_directions: list[np.ndarray] = []
        for _ in range(int(is_requested.sum(1).max(initial=0))):
            remainder_norm = np.sqrt(np.sum(remainder**2, 1))
            largest_index = remainder_norm.argmax(-1)
            is_significant = (
                remainder_norm[wheel_indices, largest_index] > RANK_TOLERANCE * max_norm
            )
            if not is_significant.any():
                break
            unit_direction = (
                remainder[wheel_indices, :, largest_index]
                / np.where(is_significant, remainder_norm[wheel_indices, largest_index], np.inf)[
                    :, None
                ]
            )
            remainder = (
                remainder
                - unit_direction[:, :, None]
                * np.sum(unit_direction[:, :, None] * remainder, 1)[:, None]
            )
            indices = [*indices, largest_index]
            is_used = [*is_used, is_significant]
            unit_directions = [*unit_directions, unit_direction]
        if not indices:
            empty_indices = np.zeros((len(is_requested), 0), int)
            return cls(
                empty_indices,
                empty_indices > 0,
                np.zeros((len(is_requested), 0, is_requested.shape[1])),
            )
        index_array, is_significant = np.stack(indices, 1), np.stack(is_used, 1)
        components = np.stack(
            [
                np.sum(unit_direction[:, :, None] * requested_projection, 1)
                for unit_direction in unit_directions
            ],
            1,
        )
        combination_weights = np.zeros_like(components)
        for i in reversed(range(len(indices))):  # Each direction is the remainder of one rate.
            remaining_component = components[:, i].copy()
            for j in range(i + 1, len(indices)):
                remaining_component -= (
                    components[wheel_indices, i, index_array[:, j]][:, None]
                    * combination_weights[:, j]
                )
            remainder_norm = components[wheel_indices, i, index_array[:, i]]
            combination_weights[:, i] = (
                remaining_component
                / np.where(is_significant[:, i], remainder_norm, np.inf)[:, None]
            )
        return cls(index_array, is_significant, combination_weights)

    def convert_to_si(self, units: np.ndarray) -> "_IndependentRates":
        """Return the independent rates in SI units, given rates in `units`, (wheels, rates)."""
        independent_rate_units = np.take_along_axis(units, self.indices, 1)
        return self._replace(
            combination_weights=self.combination_weights
            * independent_rate_units[:, :, None]
            / units[:, None]
        )

    def is_independent(self) -> np.ndarray:
        """Return whether each rate is independent, (wheels, rates)."""
        independence_flags = np.zeros((len(self.indices), self.combination_weights.shape[2]), bool)
        wheel_index, rate_position = np.nonzero(self.is_used)
        independence_flags[wheel_index, self.indices[wheel_index, rate_position]] = True
        return independence_flags

    def expand_to_all_rates(self, tangents: np.ndarray) -> np.ndarray:
        """Return the tangents of all rates, (wheels, rates, ...), from those of the independent
        rates.
        """
        wheel_indices, trailing_axes = np.arange(len(tangents)), (1,) * (tangents.ndim - 2)
        all_tangents = np.zeros_like(tangents)
        for rate_position in range(self.indices.shape[1]):
            weights = self.combination_weights[:, rate_position].reshape(
                *self.combination_weights[:, rate_position].shape, *trailing_axes
            )
            all_tangents += (
                weights * tangents[wheel_indices, self.indices[:, rate_position]][:, None]
            )
        return all_tangents


def _project_rates(input_columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """Return the effect of each rate of the section state on the projected start of a step.

    The effect is linear. The axes are (wheels, rates after, rates).
    """
    unit_rates = np.eye(3 + n)
    repeated_states = np.repeat(states, 3 + n, 0)
    tiled_rates = np.tile(unit_rates, (len(states), 1))
    repeated_states[:, 1:4], repeated_states[:, 4 + n : 4 + 2 * n] = (
        tiled_rates[:, :3],
        tiled_rates[:, 3:],
    )
    lane_rows = [*np.repeat(input_columns[:N_PARAMETERS], 3 + n, 1), *repeated_states.T]
    rates = _apply_to_rows(n, "rates at a start", lane_rows).T
    return np.swapaxes(rates.reshape(len(states), 3 + n, 3 + n), 1, 2)


def _project_landing(s: Symbols, x: Array) -> WheelMotion:
    """Return the motion of a section state, projected onto its contacts."""
    motion, contact_state = unpack_section_state(s, x)
    return project_motion(s, motion, contact_state.contact_modes, contact_state.locked)


SECTION_STATE_FUNCTIONS: dict[str, Callable[[Symbols, Array], Array]] = {
    "full states": embed_section_state,
    "rates at a start": lambda s, x: pack_coordinates(_project_landing(s, x))[1],
}
"""Functions of symbols and section states, with lanes on the last axis."""


def _apply_to_rows(n: int, function_name: str, lane_rows: list[np.ndarray]) -> np.ndarray:
    """Return one of `SECTION_STATE_FUNCTIONS`, evaluated at rows of parameters and section states.

    One program is compiled for any number of wheels. JAX alone would compile a new program for each
    number.
    """
    program = _compile_for_rows(n, function_name, len(lane_rows), lane_rows[0].dtype)
    return np.stack(program([], [np.ascontiguousarray(lane_row) for lane_row in lane_rows]))


@functools.cache
def _compile_for_rows(
    n: int, function_name: str, n_rows: int, dtype: np.dtype
) -> Callable[..., Any]:
    """Return the compiled function of rows with this name."""

    def evaluate_section_function(_: tuple, lane_rows: tuple) -> tuple:
        parameter_values, x = (
            lane_rows[: len(PARAMETER_NAMES)],
            jnp.stack(lane_rows[len(PARAMETER_NAMES) :]),
        )
        return tuple(
            SECTION_STATE_FUNCTIONS[function_name](compute_symbols(n, *parameter_values), x)
        )

    if simd.is_machine_code_available():
        return compile_cached_lane_program(
            evaluate_section_function,
            [],
            n_rows,
            dtype,
            ("with unilateral contact", function_name, n),
        )
    return _compile_with_xla(evaluate_section_function)


def _compile_with_xla(lane_function: Callable[[tuple, tuple], tuple]) -> Callable[..., Any]:
    """Return a function of lane-independent numbers and rows, compiled by XLA in blocks of lanes.

    This function is used on platforms without machine code.
    """
    move_axis = lambda result_arrays, source, destination: tuple(
        jnp.moveaxis(x, source, destination) for x in result_arrays
    )
    compiled_function = jax.jit(
        lambda lane_independent, lane_rows: move_axis(
            lane_function(lane_independent, lane_rows), -1, 0
        )
    )

    def run_in_blocks(lane_independent: list, lane_rows: list) -> tuple:
        run_block = lambda *block_rows: compiled_function(tuple(lane_independent), block_rows)
        return move_axis(
            map_in_batches(run_block, (batch_sizes.CONTACT_XLA_BATCH_SIZE,), *lane_rows), 0, -1
        )

    return run_in_blocks


class _WalkConfig(NamedTuple):
    """Static configuration of a batch walk."""

    static_options: StepOptions
    n_legs: int
    max_events: int
    is_one_sided: bool
    uses_paper_rule: bool
    has_tangents: bool  # whether the detailed step and its tangents are computed
    is_uneven: bool
    has_restitution: bool

    @classmethod
    def from_model(
        cls,
        model: UnilateralWheel,
        options: StepOptions,
        n: int,
        has_tangents: bool,
        n_columns: int,
    ) -> "_WalkConfig":
        """Return the configuration for a model and these options."""
        static_options = eqx.filter(options, eqx.is_array, inverse=True)
        is_uneven = n_columns > N_PARAMETERS + 1
        return cls(
            static_options,
            n,
            model.max_events,
            model.has_one_sided_stoppers,
            model.uses_paper_rule,
            has_tangents,
            is_uneven,
            model.restitution is not None,
        )

    def make_walk(self, traced_options: StepOptions, n_steps: Array) -> BatchWalkSettings:
        """Return the walk settings with traced options and a traced number of steps."""
        options = eqx.combine(traced_options, self.static_options)
        tableau = load_explicit_tableau(options.solver)
        assert tableau is not None  # The caller has checked the solver.
        contact_rules = (
            self.is_one_sided,
            self.uses_paper_rule,
            self.has_tangents,
            options,
            tableau,
            self.is_uneven,
            self.has_restitution,
        )
        return BatchWalkSettings(self.n_legs, n_steps, self.max_events, *contact_rules)

    def input_row_counts(self) -> tuple[int, ...]:
        """Return the number of rows of each input: columns, states and, if requested, tangent
        inputs.
        """
        n_columns = N_PARAMETERS + 1 + N_UNEVEN_COLUMNS * self.is_uneven + self.has_restitution
        row_counts = n_columns, full_section_size(self.n_legs)
        return (*row_counts, MAX_TANGENTS_PER_LANE) if self.has_tangents else row_counts

    def result_structure(self, dtype: Any) -> Any:
        """Return shapes and dtypes of the results of one lane."""
        result_shapes = _result_shapes(self.n_legs, dtype, self.has_tangents)
        if not self.has_tangents:
            return result_shapes
        float_leaves = eqx.filter(
            result_shapes.step_result, lambda leaf: jnp.issubdtype(leaf.dtype, jnp.inexact)
        )
        add_tangent_axis = lambda leaf: jax.ShapeDtypeStruct(
            (MAX_TANGENTS_PER_LANE, *leaf.shape), leaf.dtype
        )
        return result_shapes, jax.tree.map(add_tangent_axis, float_leaves)


@functools.cache
def _result_shapes(n_legs: int, dtype: Any, has_tangents: bool) -> Any:
    """Return shapes and dtypes of one lane's results, without tangents."""
    return jax.eval_shape(lambda: make_result_template(n_legs, dtype, has_tangents))


def _run_walk(
    config: _WalkConfig, input_arrays: list[np.ndarray], n_steps: int, options: StepOptions
) -> Any:
    """Return the results of lanes, with the lanes on the leading axis.

    The input arrays have the lanes on their last axis.
    """
    dtype = input_arrays[0].dtype
    # Neighboring lanes run as long as the slowest of them. Lanes are sorted by damping, because
    # high damping limits the step size by stability.
    lane_order = np.argsort(-input_arrays[0][PARAMETER_NAMES.index("damping")], kind="stable")
    traced_options, options_structure = jax.tree.flatten(eqx.filter(options, eqx.is_array))
    lane_independent = [np.int32(n_steps), *(np.asarray(leaf, dtype) for leaf in traced_options)]
    lane_rows = [input_row[lane_order] for input_array in input_arrays for input_row in input_array]
    result_rows = (
        _compile_walk(config, dtype, options_structure)(lane_independent, lane_rows)
        if len(lane_order)
        else None
    )
    inverse_lane_order = np.argsort(lane_order, kind="stable")
    result_leaves, result_structure = _result_structure(config, dtype)
    if result_rows is None:
        result_rows = [np.zeros((*leaf.shape, 0), leaf.dtype) for leaf in result_leaves]
    return jax.tree.unflatten(
        result_structure,
        [
            np.moveaxis(np.asarray(input_array), -1, 0)[inverse_lane_order]
            for input_array in result_rows
        ],
    )


@functools.cache
def _result_structure(config: _WalkConfig, dtype: np.dtype) -> tuple[list[Any], Any]:
    """Return the leaves and the tree structure of the results of one lane."""
    return jax.tree.flatten(config.result_structure(dtype))


def embed_section_states(input_columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """Return the full section states of states with three entries; others are returned
    unchanged.
    """
    if states.shape[1] != 3:
        return states
    return _apply_to_rows(n, "full states", [*input_columns[:N_PARAMETERS], *states.T]).T


@functools.cache
def _compile_walk(
    config: _WalkConfig, dtype: np.dtype, options_structure: Any
) -> Callable[..., Any]:
    """Return the compiled walk over lane-independent numbers and rows of lanes, for any number of
    steps.
    """

    def run_compiled_walk(lane_independent: tuple, lane_rows: tuple) -> tuple:
        n_steps, *traced_options = lane_independent
        walk_settings = config.make_walk(
            jax.tree.unflatten(options_structure, traced_options), n_steps
        )
        row_iterator = iter(lane_rows)
        walk_inputs = [
            jnp.stack([next(row_iterator) for _ in range(n_rows)])
            for n_rows in config.input_row_counts()
        ]
        if not config.has_tangents:
            return tuple(jax.tree.leaves(run_walks(walk_settings, *walk_inputs)))
        input_columns, x, tangent_input_indices = walk_inputs
        # Batches have no tangent of restitution, which is the last column.
        n_columns = len(input_columns) - config.has_restitution
        column_index = [*range(n_columns), *[-2] * config.has_restitution]
        input_index = np.array([*column_index, *n_columns + np.arange(len(x))], np.int32)[:, None]
        unit_tangents = (tangent_input_indices[:, None] == input_index).astype(x.dtype)
        unit_tangents = lax.optimization_barrier(unit_tangents)
        tangents = unit_tangents[:, : len(input_columns)], unit_tangents[:, len(input_columns) :]
        n_tangents = jnp.sum(tangent_input_indices >= 0, axis=0, dtype=jnp.int32)
        return tuple(
            jax.tree.leaves(
                walk_with_tangents(walk_settings, input_columns, x, *tangents, n_tangents)
            )
        )

    if simd.is_machine_code_available():
        scalar_dtypes = [np.dtype(np.int32), *[dtype] * options_structure.num_leaves]
        return compile_cached_lane_program(
            run_compiled_walk,
            scalar_dtypes,
            sum(config.input_row_counts()),
            dtype,
            ("walk with unilateral contact", config),
        )
    return _compile_with_xla(run_compiled_walk)

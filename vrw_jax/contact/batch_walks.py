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
    BatchWalk,
    make_result_template,
    run_walks,
)
from vrw_jax.contact.walk_tangents import walk_with_tangents
from vrw_jax.integrator import load_explicit_tableau
from vrw_jax.numerics import StepOptions, batch_sizes, map_in_batches
from vrw_jax.runtime import cached_lane_program
from vrw_jax.wheel import PARAMETER_NAMES, Symbols, compute_own_units_of_rows, compute_symbols


def walk_batch(
    columns: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: StepOptions,
    n: int,
) -> tuple[np.ndarray, ...]:
    """Return the results of `n_steps` steps of many wheels with `n` legs.

    `columns` are the parameters in their order and friction, shape (10, wheels); `states` full
    section states, shape (wheels, 4 + 3 n). On uneven ground, one step at a time, two columns
    more: see `N_UNEVEN_COLUMNS`.
    """
    config = _WalkConfig.from_model(model, options, n, False, len(columns))
    walk = _run_walk(config, [columns, states.T], n_steps, options)
    summary = walk.step_result
    counts = walk.outcome, walk.n_stepped, walk.n_solver_steps
    return summary.section_state, summary.durations, *counts, summary.step_length


def step_batch_with_jacobian(
    columns: np.ndarray,
    states: np.ndarray,
    model: UnilateralWheel,
    options: StepOptions,
    n: int,
    input_indices: Sequence[int] | None = None,
) -> tuple[UnilateralStep, UnilateralStep]:
    """Return one step of many wheels, as `walk_batch` takes them, and the Jacobian of its results.

    The leading axis is over wheels. Derivatives have a last axis over the columns, then the section
    state. Tangents are integrated beside the wheel's motion. Entries that are not in
    `input_indices` or cannot vary (lengths of legs on their stoppers or with loaded feet, and
    codes) have zero derivatives. The number of rate tangents is the number that loaded feet leave
    independent (see `_IndependentRates`).
    """
    config = _WalkConfig.from_model(model, options, n, True, len(columns))
    if len(states):  # before others are asked for: it is long in coming
        _compile_walk(config, columns.dtype, jax.tree.structure(eqx.filter(options, eqx.is_array)))
    code = np.round(states[:, 4 + 2 * n :]).astype(int)
    numbers = np.concatenate([columns.T, states], 1)
    has_tangent = np.ones(numbers.shape, bool)
    is_free_leg = code < LOCKED_CODE_OFFSET
    is_free_entry = [
        is_free_leg & ((code & (LOCKED_CODE_OFFSET - 1)) == ContactMode.OFF),
        is_free_leg,
        np.zeros(code.shape, bool),
    ]
    has_tangent[:, len(columns) + 4 :] = np.concatenate(is_free_entry, 1)
    if input_indices is not None:
        has_tangent &= np.isin(np.arange(numbers.shape[1]), input_indices)
    rate_indices = len(columns) + np.array([1, 2, 3, *range(4 + n, 4 + 2 * n)])
    section_units = compute_section_units(compute_own_units_of_rows(columns.T, n), n)
    rate_units = np.stack(section_units, -1)[:, rate_indices - len(columns)]
    projected_units = rate_units[:, [1, 2, 0, *range(3, 3 + n)]]  # in the order of `coordinates`
    projection = _project_rates(columns, states, n) * (
        rate_units[:, None] / projected_units[:, :, None]
    )
    independent_rates = _IndependentRates.from_projection(
        projection, has_tangent[:, rate_indices]
    ).convert_to_si(rate_units)
    has_tangent[:, rate_indices] = independent_rates.is_independent()
    wheel, input_index = np.nonzero(has_tangent)
    lane, slot, owner = _pack_tangents(has_tangent.sum(1))
    tangent_inputs = np.full((MAX_TANGENTS_PER_LANE, len(owner)), -1.0)
    tangent_inputs[slot, lane] = input_index
    arguments = [columns[:, owner], states[owner].T, tangent_inputs]
    walk_result, tangents = _run_walk(config, arguments, 1, options.with_derivative_tolerances())
    first_lane = np.searchsorted(owner, np.arange(len(states)))

    def gather_tangents(leaf: np.ndarray) -> np.ndarray:
        jacobian_rows = np.zeros((*numbers.shape, *leaf.shape[2:]), leaf.dtype)
        jacobian_rows[wheel, input_index] = leaf[lane, slot]
        jacobian_rows[:, rate_indices] = independent_rates.expand(jacobian_rows[:, rate_indices])
        return np.moveaxis(jacobian_rows, 1, -1)

    return jax.tree.map(lambda x: x[first_lane], walk_result.step_result), jax.tree.map(
        gather_tangents, tangents
    )


MAX_TANGENTS_PER_LANE = 16
"""Largest number of tangents in one lane: more tangents are distributed over several lanes."""


def _pack_tangents(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lane and position of each wheel's tangents, one after another, and the lanes'
    owners.
    """
    lane_rows = np.maximum(-(-counts // MAX_TANGENTS_PER_LANE), 1)
    first_lane = np.cumsum(lane_rows) - lane_rows
    position = np.concatenate([np.arange(n) for n in counts])
    lane = np.repeat(first_lane, counts) + position // MAX_TANGENTS_PER_LANE
    return lane, position % MAX_TANGENTS_PER_LANE, np.repeat(np.arange(len(counts)), lane_rows)


RANK_TOLERANCE = 1e-10
"""Remainder of a dependent rate that counts as rounding, as a fraction of the largest: an
independent rate has a remainder of order one, like the projection."""


class _IndependentRates(NamedTuple):
    """Independent rates of section states, and the other rates as combinations of these.

    A loaded foot constrains the wheel: a resting foot leaves two of the four rates of hub and leg.
    """

    indices: np.ndarray  # of the independent rates, (wheels, independent)
    is_used: np.ndarray  # which of these exist
    combination: np.ndarray  # of all rates by these, (wheels, independent, rates)

    @classmethod
    def from_projection(
        cls, projection: np.ndarray, is_requested: np.ndarray
    ) -> "_IndependentRates":
        """Return the independent rates of a start's projection, (wheels, projected rates, rates).

        Of the rates `is_requested`, the one with the largest remainder is selected repeatedly.
        """
        requested = np.nan_to_num(projection) * is_requested[:, None]
        remainder, wheels = requested.copy(), np.arange(len(is_requested))
        max_norm = np.sqrt(np.sum(remainder**2, 1)).max(-1)
        indices: list[np.ndarray] = []
        is_used: list[np.ndarray] = []
        directions: list[np.ndarray] = []
        for _ in range(int(is_requested.sum(1).max(initial=0))):
            norm = np.sqrt(np.sum(remainder**2, 1))
            largest_index = norm.argmax(-1)
            is_significant = norm[wheels, largest_index] > RANK_TOLERANCE * max_norm
            if not is_significant.any():
                break
            direction = (
                remainder[wheels, :, largest_index]
                / np.where(is_significant, norm[wheels, largest_index], np.inf)[:, None]
            )
            remainder = (
                remainder
                - direction[:, :, None] * np.sum(direction[:, :, None] * remainder, 1)[:, None]
            )
            indices = [*indices, largest_index]
            is_used = [*is_used, is_significant]
            directions = [*directions, direction]
        if not indices:
            empty = np.zeros((len(is_requested), 0), int)
            return cls(empty, empty > 0, np.zeros((len(is_requested), 0, is_requested.shape[1])))
        index_array, is_significant = np.stack(indices, 1), np.stack(is_used, 1)
        components = np.stack(
            [np.sum(direction[:, :, None] * requested, 1) for direction in directions], 1
        )
        combination = np.zeros_like(components)
        for i in reversed(range(len(indices))):  # each direction is the remainder of one rate
            component = components[:, i].copy()
            for j in range(i + 1, len(indices)):
                component -= components[wheels, i, index_array[:, j]][:, None] * combination[:, j]
            norm = components[wheels, i, index_array[:, i]]
            combination[:, i] = component / np.where(is_significant[:, i], norm, np.inf)[:, None]
        return cls(index_array, is_significant, combination)

    def convert_to_si(self, units: np.ndarray) -> "_IndependentRates":
        """Return the same for rates in SI, given rates in `units`, (wheels, rates)."""
        own_units = np.take_along_axis(units, self.indices, 1)
        return self._replace(combination=self.combination * own_units[:, :, None] / units[:, None])

    def is_independent(self) -> np.ndarray:
        """Return whether each rate is independent, (wheels, rates)."""
        flags = np.zeros((len(self.indices), self.combination.shape[2]), bool)
        wheel, column = np.nonzero(self.is_used)
        flags[wheel, self.indices[wheel, column]] = True
        return flags

    def expand(self, tangents: np.ndarray) -> np.ndarray:
        """Return the tangents of all rates, (wheels, rates, ...), from those of the independent
        ones.
        """
        wheels, shape = np.arange(len(tangents)), (1,) * (tangents.ndim - 2)
        total = np.zeros_like(tangents)
        for column in range(self.indices.shape[1]):
            weights = self.combination[:, column].reshape(
                *self.combination[:, column].shape, *shape
            )
            total += weights * tangents[wheels, self.indices[:, column]][:, None]
        return total


def _project_rates(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """Return the effect of each rate of the section state on the start of a step, which is linear.

    The axes are (wheels, rates after, rates).
    """
    units = np.eye(3 + n)
    lane_rows = np.repeat(states, 3 + n, 0)
    unit_rates = np.tile(units, (len(states), 1))
    lane_rows[:, 1:4], lane_rows[:, 4 + n : 4 + 2 * n] = unit_rates[:, :3], unit_rates[:, 3:]
    rows = [*np.repeat(columns[:N_PARAMETERS], 3 + n, 1), *lane_rows.T]
    rates = _apply_to_rows(n, "rates at a start", rows).T
    return np.swapaxes(rates.reshape(len(states), 3 + n, 3 + n), 1, 2)


def _project_landing(s: Symbols, x: Array) -> WheelMotion:
    """Return the motion of a section state, projected onto its contacts."""
    motion, contact_state = unpack_section_state(s, x)
    return project_motion(s, motion, contact_state.contact, contact_state.locked)


SECTION_STATE_FUNCTIONS: dict[str, Callable[[Symbols, Array], Array]] = {
    "full states": embed_section_state,
    "rates at a start": lambda s, x: pack_coordinates(_project_landing(s, x))[1],
}
"""Functions of section states alone, with lanes on the last axis."""


def _apply_to_rows(n: int, function_name: str, rows: list[np.ndarray]) -> np.ndarray:
    """Return one of `SECTION_STATE_FUNCTIONS` of rows of parameters and section states.

    One program serves any number of wheels; JAX alone would compile a new one for each number.
    """
    program = _compile_for_rows(n, function_name, len(rows), rows[0].dtype)
    return np.stack(program([], [np.ascontiguousarray(row) for row in rows]))


@functools.cache
def _compile_for_rows(n: int, function_name: str, size: int, dtype: np.dtype) -> Callable[..., Any]:
    """Return the compiled function of rows."""

    def evaluate(_: tuple, lane_rows: tuple) -> tuple:
        values, x = lane_rows[: len(PARAMETER_NAMES)], jnp.stack(lane_rows[len(PARAMETER_NAMES) :])
        return tuple(SECTION_STATE_FUNCTIONS[function_name](compute_symbols(n, *values), x))

    if simd.is_available():
        return cached_lane_program(evaluate, [], size, dtype, ("on real ground", function_name, n))
    return _compile_with_xla(evaluate)


def _compile_with_xla(function: Callable[[tuple, tuple], tuple]) -> Callable[..., Any]:
    """Return the function of numbers and rows, compiled by XLA in blocks of lanes.

    It is used without machine code.
    """
    move_axis = lambda results, source, destination: tuple(
        jnp.moveaxis(x, source, destination) for x in results
    )
    compiled = jax.jit(lambda uniform, lane_rows: move_axis(function(uniform, lane_rows), -1, 0))

    def in_blocks(uniform: list, lane_rows: list) -> tuple:
        run_block = lambda *rows: compiled(tuple(uniform), rows)
        return move_axis(
            map_in_batches(run_block, (batch_sizes.CONTACT_XLA_BATCH_SIZE,), *lane_rows), 0, -1
        )

    return in_blocks


class _WalkConfig(NamedTuple):
    """Static configuration of a batch walk."""

    static: StepOptions
    n_legs: int
    max_events: int
    is_one_sided: bool
    uses_paper_rule: bool
    has_tangents: bool  # whether the detailed step and its tangents are computed
    uneven: bool

    @classmethod
    def from_model(
        cls,
        model: UnilateralWheel,
        options: StepOptions,
        n: int,
        has_tangents: bool,
        n_columns: int,
    ) -> "_WalkConfig":
        """Return the configuration of a model and these options."""
        if model.restitution is not None:
            raise ValueError(
                "restitution is given, but batches do not support it: walk wheels one by one with "
                "vrw.walk, or map vrw.return_map over them."
            )
        static_options = eqx.filter(options, eqx.is_array, inverse=True)
        uneven = n_columns > N_PARAMETERS + 1
        return cls(
            static_options,
            n,
            model.max_events,
            model.has_one_sided_stoppers,
            model.uses_paper_rule,
            has_tangents,
            uneven,
        )

    def make_walk(self, dynamic: StepOptions, n_steps: Array) -> BatchWalk:
        """Return the walk settings with traced options and number of steps."""
        options = eqx.combine(dynamic, self.static)
        tableau = load_explicit_tableau(options.solver)
        assert tableau is not None  # the caller looked
        rules = (
            self.is_one_sided,
            self.uses_paper_rule,
            self.has_tangents,
            options,
            tableau,
            self.uneven,
        )
        return BatchWalk(self.n_legs, n_steps, self.max_events, *rules)

    def row_counts(self) -> tuple[int, ...]:
        """Of the arrays that are given: columns, states, and which of these directions are."""
        sizes = N_PARAMETERS + 1 + N_UNEVEN_COLUMNS * self.uneven, full_section_size(self.n_legs)
        return (*sizes, MAX_TANGENTS_PER_LANE) if self.has_tangents else sizes

    def result_structure(self, dtype: Any) -> Any:
        """Return shapes and dtypes of the results."""
        result = _result_shapes(self.n_legs, dtype, self.has_tangents)
        if not self.has_tangents:
            return result
        floats = eqx.filter(
            result.step_result, lambda leaf: jnp.issubdtype(leaf.dtype, jnp.inexact)
        )
        add_tangent_axis = lambda leaf: jax.ShapeDtypeStruct(
            (MAX_TANGENTS_PER_LANE, *leaf.shape), leaf.dtype
        )
        return result, jax.tree.map(add_tangent_axis, floats)


@functools.cache
def _result_shapes(n_legs: int, dtype: Any, has_tangents: bool) -> Any:
    """Return shapes and dtypes of one lane's results."""
    return jax.eval_shape(lambda: make_result_template(n_legs, dtype, has_tangents))


def _run_walk(
    config: _WalkConfig, arguments: list[np.ndarray], n_steps: int, options: StepOptions
) -> Any:
    """Return the results of lanes with the lane axis, last in the input arrays, as the leading
    one.
    """
    dtype = arguments[0].dtype
    # Neighboring lanes run as long as the slowest; high damping bounds the step by stability.
    order = np.argsort(-arguments[0][PARAMETER_NAMES.index("damping")], kind="stable")
    dynamic, options_structure = jax.tree.flatten(eqx.filter(options, eqx.is_array))
    uniform = [np.int32(n_steps), *(np.asarray(leaf, dtype) for leaf in dynamic)]
    lane_rows = [row[order] for array in arguments for row in array]
    rows = (
        _compile_walk(config, dtype, options_structure)(uniform, lane_rows) if len(order) else None
    )
    inverse_order = np.argsort(order, kind="stable")
    leaves, structure = _result_structure(config, dtype)
    if rows is None:
        rows = [np.zeros((*leaf.shape, 0), leaf.dtype) for leaf in leaves]
    return jax.tree.unflatten(
        structure, [np.moveaxis(np.asarray(array), -1, 0)[inverse_order] for array in rows]
    )


@functools.cache
def _result_structure(config: _WalkConfig, dtype: np.dtype) -> tuple[list[Any], Any]:
    """Return the leaves and the tree structure of the results."""
    return jax.tree.flatten(config.result_structure(dtype))


def embed_section_states(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """Return the full section states of three-number ones; others are returned unchanged."""
    if states.shape[1] != 3:
        return states
    return _apply_to_rows(n, "full states", [*columns[:N_PARAMETERS], *states.T]).T


@functools.cache
def _compile_walk(config: _WalkConfig, dtype: np.dtype, structure: Any) -> Callable[..., Any]:
    """Return the compiled walk over numbers and rows of lanes, for any number of steps."""

    def walk(uniform: tuple, lane_rows: tuple) -> tuple:
        n_steps, *dynamic = uniform
        batch_walk = config.make_walk(jax.tree.unflatten(structure, dynamic), n_steps)
        rows = iter(lane_rows)
        arguments = [jnp.stack([next(rows) for _ in range(size)]) for size in config.row_counts()]
        if not config.has_tangents:
            return tuple(jax.tree.leaves(run_walks(batch_walk, *arguments)))
        columns, x, tangent_inputs = arguments
        input_index = np.arange(len(columns) + len(x), dtype=np.int32)[:, None]
        units = (tangent_inputs[:, None] == input_index).astype(x.dtype)
        units = lax.optimization_barrier(units)
        tangents = units[:, : len(columns)], units[:, len(columns) :]
        n_tangents = jnp.sum(tangent_inputs >= 0, axis=0, dtype=jnp.int32)
        return tuple(
            jax.tree.leaves(walk_with_tangents(batch_walk, columns, x, *tangents, n_tangents))
        )

    if simd.is_available():
        kinds = [np.dtype(np.int32), *[dtype] * structure.num_leaves]
        return cached_lane_program(
            walk, kinds, sum(config.row_counts()), dtype, ("walk on real ground", config)
        )
    return _compile_with_xla(walk)

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
from vrw_jax.models.unilateral.along import walked_along
from vrw_jax.models.unilateral.contacts import OFF
from vrw_jax.models.unilateral.events import settled
from vrw_jax.models.unilateral.lanes import Walk, told_like, walked
from vrw_jax.models.unilateral.ledger import UnilateralStep
from vrw_jax.models.unilateral.march import coordinates
from vrw_jax.models.unilateral.mechanics import WheelMotion
from vrw_jax.models.unilateral.section import LOCKED, embedded, opened, section_size
from vrw_jax.models.unilateral.wheel import UnilateralWheel
from vrw_jax.numerics import Options, explicit_tableau, in_batches
from vrw_jax.runtime import lane_program
from vrw_jax.wheel import PARAMETER_NAMES, Symbols, symbols_of

BLOCK = 2048
"""Number of lanes in one block if XLA compiles the walk."""


def walk_lanes(
    columns: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: Options,
    n: int,
) -> tuple[np.ndarray, ...]:
    """Return the results of `n_steps` steps of many wheels with `n` legs.

    They are section states, durations, outcomes, completed steps, solver steps and the length of
    the last step, m. Static fields of the model apply to all wheels.

    - `columns`: the parameters in their order and friction, shape (10, wheels);
    - `states`: full section states, shape (wheels, 4 + 3 n).
    """
    run = _Run.of(model, options, n, False)
    walk = _walked(run, [columns, states.T], n_steps, options)
    lean = walk.told
    rest = walk.outcome, walk.n_stepped, walk.tried
    return lean.section_state, lean.durations, *rest, lean.step_length


def step_lanes(
    columns: np.ndarray,
    states: np.ndarray,
    model: UnilateralWheel,
    options: Options,
    n: int,
    wanted: Sequence[int] | None = None,
) -> tuple[UnilateralStep, UnilateralStep]:
    """Return one step of many wheels, as `walk_batch` takes them, and the Jacobian of its results.

    The leading axis is over wheels. Derivatives have a last axis over the columns, then the section
    state. Tangents are integrated beside the wheel's motion. Entries that are not in
    `input_indices` or cannot vary (lengths of legs on their stoppers or with loaded feet, and
    codes) have zero derivatives. The number of rate tangents is the number that loaded feet leave
    independent (see `_IndependentRates`).
    """
    run = _Run.of(model, options, n, True)
    if len(states):  # first, because its compilation takes longest
        _program(run, columns.dtype, jax.tree.structure(eqx.filter(options, eqx.is_array)))
    code = np.round(states[:, 4 + 2 * n :]).astype(int)
    numbers = np.concatenate([columns.T, states], 1)
    moves = np.ones(numbers.shape, bool)
    free = code < LOCKED
    places = [free & ((code & (LOCKED - 1)) == OFF), free, np.zeros(code.shape, bool)]
    moves[:, len(columns) + 4 :] = np.concatenate(places, 1)
    if wanted is not None:
        moves &= np.isin(np.arange(numbers.shape[1]), wanted)
    rates = len(columns) + np.array([1, 2, 3, *range(4 + n, 4 + 2 * n)])
    left = _Rates.of(_settled_rates(columns, states, n), moves[:, rates])
    moves[:, rates] = left.kept()
    wheel, place = np.nonzero(moves)
    lane, slot, owner = _shared_out(moves.sum(1))
    ways = np.full((DIRECTIONS, len(owner)), -1.0)
    ways[slot, lane] = place
    given = [columns[:, owner], states[owner].T, ways]
    walk, moved = _walked(run, given, 1, options.for_derivatives())
    first = np.searchsorted(owner, np.arange(len(states)))

    def jacobian(leaf: np.ndarray) -> np.ndarray:
        full = np.zeros((*numbers.shape, *leaf.shape[2:]), leaf.dtype)
        full[wheel, place] = leaf[lane, slot]
        full[:, rates] = left.all_of(full[:, rates])
        return np.moveaxis(full, 1, -1)

    return jax.tree.map(lambda x: x[first], walk.told), jax.tree.map(jacobian, moved)


DIRECTIONS = 16
"""Largest number of tangents in one lane: more tangents are distributed over several lanes."""


def _shared_out(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lane and position of each wheel's tangents, one after another, and the lanes'
    owners.
    """
    lanes = np.maximum(-(-counts // DIRECTIONS), 1)
    first, own = np.cumsum(lanes) - lanes, np.concatenate([np.arange(n) for n in counts])
    lane = np.repeat(first, counts) + own // DIRECTIONS
    return lane, own % DIRECTIONS, np.repeat(np.arange(len(counts)), lanes)


SAME = 1e-10
"""Remainder of a dependent rate that counts as rounding, as a fraction of the largest: an
independent rate has a remainder of order one, like the projection."""


class _Rates(NamedTuple):
    """Independent rates of section states, and the other rates as combinations of these.

    A loaded foot constrains the wheel: a resting foot leaves two of the four rates of hub and leg.
    """

    places: np.ndarray  # of the independent rates, (wheels, independent)
    counts: np.ndarray  # which of these exist
    shares: np.ndarray  # of all rates by these, (wheels, independent, rates)

    @classmethod
    def of(cls, settled: np.ndarray, asked: np.ndarray) -> "_Rates":
        """Return the independent rates of a start's projection, (wheels, projected rates, rates).

        Of the rates `is_requested`, the one with the largest remainder is selected repeatedly.
        """
        asked_for = np.nan_to_num(settled) * asked[:, None]
        left, wheels = asked_for.copy(), np.arange(len(asked))
        largest = np.sqrt(np.sum(left**2, 1)).max(-1)
        places: list[np.ndarray] = []
        counts: list[np.ndarray] = []
        along: list[np.ndarray] = []
        for _ in range(int(asked.sum(1).max(initial=0))):
            size = np.sqrt(np.sum(left**2, 1))
            most = size.argmax(-1)
            there = size[wheels, most] > SAME * largest
            if not there.any():
                break
            way = left[wheels, :, most] / np.where(there, size[wheels, most], np.inf)[:, None]
            left = left - way[:, :, None] * np.sum(way[:, :, None] * left, 1)[:, None]
            places, counts, along = [*places, most], [*counts, there], [*along, way]
        if not places:
            none = np.zeros((len(asked), 0), int)
            return cls(none, none > 0, np.zeros((len(asked), 0, asked.shape[1])))
        picked, there = np.stack(places, 1), np.stack(counts, 1)
        by_way = np.stack([np.sum(way[:, :, None] * asked_for, 1) for way in along], 1)
        shares = np.zeros_like(by_way)
        for i in reversed(range(len(places))):  # each direction is the remainder of one rate
            rest = by_way[:, i].copy()
            for j in range(i + 1, len(places)):
                rest -= by_way[wheels, i, picked[:, j]][:, None] * shares[:, j]
            size = by_way[wheels, i, picked[:, i]]
            shares[:, i] = rest / np.where(there[:, i], size, np.inf)[:, None]
        return cls(picked, there, shares)

    def kept(self) -> np.ndarray:
        """Return whether each rate is independent, (wheels, rates)."""
        flags = np.zeros((len(self.places), self.shares.shape[2]), bool)
        wheel, which = np.nonzero(self.counts)
        flags[wheel, self.places[wheel, which]] = True
        return flags

    def all_of(self, moved: np.ndarray) -> np.ndarray:
        """Return the tangents of all rates, (wheels, rates, ...), from those of the independent
        ones.
        """
        wheels, shape = np.arange(len(moved)), (1,) * (moved.ndim - 2)
        total = np.zeros_like(moved)
        for k in range(self.places.shape[1]):
            share = self.shares[:, k].reshape(*self.shares[:, k].shape, *shape)
            total += share * moved[wheels, self.places[:, k]][:, None]
        return total


def _settled_rates(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """Return the effect of each rate of the section state on the start of a step, which is linear.

    The axes are (wheels, rates after, rates).
    """
    units = np.eye(3 + n)
    lanes = np.repeat(states, 3 + n, 0)
    every = np.tile(units, (len(states), 1))
    lanes[:, 1:4], lanes[:, 4 + n : 4 + 2 * n] = every[:, :3], every[:, 3:]
    rows = [*np.repeat(columns[:-1], 3 + n, 1), *lanes.T]
    told = _of_rows(n, "rates at a start", rows).T
    return np.swapaxes(told.reshape(len(states), 3 + n, 3 + n), 1, 2)


def _landing(s: Symbols, x: Array) -> WheelMotion:
    """Return the motion of a section state, projected onto its contacts."""
    motion, stance = opened(s, x)
    return settled(s, motion, stance.contact, stance.locked)


OF_ROWS: dict[str, Callable[[Symbols, Array], Array]] = {
    "full states": embedded,
    "rates at a start": lambda s, x: coordinates(_landing(s, x))[1],
}
"""Functions of section states alone, with lanes on the last axis."""


def _of_rows(n: int, asked: str, rows: list[np.ndarray]) -> np.ndarray:
    """Return one of `SECTION_STATE_FUNCTIONS` of rows of parameters and section states.

    One program serves any number of wheels; JAX alone would compile a new one for each number.
    """
    program = _program_of_rows(n, asked, len(rows), rows[0].dtype)
    return np.stack(program([], [np.ascontiguousarray(row) for row in rows]))


@functools.cache
def _program_of_rows(n: int, asked: str, size: int, dtype: np.dtype) -> Callable[..., Any]:
    """Return the compiled function of rows."""

    def told(_: tuple, lanes: tuple) -> tuple:
        values, x = lanes[: len(PARAMETER_NAMES)], jnp.stack(lanes[len(PARAMETER_NAMES) :])
        return tuple(OF_ROWS[asked](symbols_of(n, *values), x))

    if simd.serves():
        return lane_program(told, [], size, dtype, ("on real ground", asked, n))
    return _by_xla(told)


def _by_xla(function: Callable[[tuple, tuple], tuple]) -> Callable[..., Any]:
    """Return the function of numbers and rows, compiled by XLA in blocks of `XLA_BLOCK_SIZE` lanes.

    It is used without machine code.
    """
    moved = lambda told, here, there: tuple(jnp.moveaxis(x, here, there) for x in told)
    compiled = jax.jit(lambda uniform, lanes: moved(function(uniform, lanes), -1, 0))

    def in_blocks(uniform: list, lanes: list) -> tuple:
        own = lambda *rows: compiled(tuple(uniform), rows)
        return moved(in_batches(own, (BLOCK,), *lanes), 0, -1)

    return in_blocks


class _Run(NamedTuple):
    """Static configuration of a batch walk."""

    static: Options
    n_legs: int
    max_events: int
    one_sided: bool
    by_paper: bool
    moved: bool  # full step results with the tangents of each lane

    @classmethod
    def of(cls, model: UnilateralWheel, options: Options, n: int, moved: bool) -> "_Run":
        """Return the configuration of this model and these options.

        Raises `ValueError` for a model with restitution.
        """
        if model.restitution is not None:
            raise ValueError(
                "restitution is given, but in lanes feet don't come back: walk wheels one by one, "
                "by vrw.walk, or map vrw.return_map over them."
            )
        static = eqx.filter(options, eqx.is_array, inverse=True)
        return cls(static, n, model.max_events, model.one_sided, model.by_paper, moved)

    def on(self, dynamic: Options, n_steps: Array) -> Walk:
        """Return the walk settings with traced options and number of steps."""
        options = eqx.combine(dynamic, self.static)
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # the caller looked
        rules = self.one_sided, self.by_paper, self.moved
        return Walk(self.n_legs, n_steps, self.max_events, *rules, options, tableau)

    def rows(self) -> tuple[int, ...]:
        """Return the numbers of input rows: columns, states and, with tangents, the input of each
        tangent.
        """
        sizes = len(PARAMETER_NAMES) + 1, section_size(self.n_legs)
        return (*sizes, DIRECTIONS) if self.moved else sizes

    def told(self, dtype: Any) -> Any:
        """Return shapes and dtypes of the results."""
        walk = _shapes(self.n_legs, dtype, self.moved)
        if not self.moved:
            return walk
        floats = eqx.filter(walk.told, lambda x: jnp.issubdtype(x.dtype, jnp.inexact))
        several = lambda x: jax.ShapeDtypeStruct((DIRECTIONS, *x.shape), x.dtype)
        return walk, jax.tree.map(several, floats)


@functools.cache
def _shapes(n_legs: int, dtype: Any, moved: bool) -> Any:
    """Return shapes and dtypes of one lane's results."""
    return jax.eval_shape(lambda: told_like(n_legs, dtype, moved))


def _walked(run: _Run, given: list[np.ndarray], n_steps: int, options: Options) -> Any:
    """Return the results of lanes with the lane axis, last in the input arrays, as the leading
    one.
    """
    dtype = given[0].dtype
    # Neighboring lanes run as long as the slowest; high damping bounds the step by stability.
    order = np.argsort(-given[0][PARAMETER_NAMES.index("damping")], kind="stable")
    dynamic, form = jax.tree.flatten(eqx.filter(options, eqx.is_array))
    uniform = [np.int32(n_steps), *(np.asarray(leaf, dtype) for leaf in dynamic)]
    lanes = [row[order] for x in given for row in x]
    rows = _program(run, dtype, form)(uniform, lanes) if len(order) else None
    back = np.argsort(order, kind="stable")
    leaves, structure = _form(run, dtype)
    if rows is None:
        rows = [np.zeros((*leaf.shape, 0), leaf.dtype) for leaf in leaves]
    return jax.tree.unflatten(structure, [np.moveaxis(np.asarray(x), -1, 0)[back] for x in rows])


@functools.cache
def _form(run: _Run, dtype: np.dtype) -> tuple[list[Any], Any]:
    """Return the leaves and the tree structure of the results."""
    return jax.tree.flatten(run.told(dtype))


def as_full_states(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """Return the full section states of three-number ones; others are returned unchanged."""
    if states.shape[1] != 3:
        return states
    return _of_rows(n, "full states", [*columns[:-1], *states.T]).T


@functools.cache
def _program(run: _Run, dtype: np.dtype, form: Any) -> Callable[..., Any]:
    """Return the compiled walk over numbers and rows of lanes, for any number of steps."""

    def walk(uniform: tuple, lanes: tuple) -> tuple:
        n_steps, *dynamic = uniform
        on = run.on(jax.tree.unflatten(form, dynamic), n_steps)
        rows = iter(lanes)
        given = [jnp.stack([next(rows) for _ in range(size)]) for size in run.rows()]
        if not run.moved:
            return tuple(jax.tree.leaves(walked(on, *given)))
        columns, x, ways = given
        place = np.arange(len(columns) + len(x), dtype=np.int32)[:, None]
        units = (ways[:, None] == place).astype(x.dtype)
        units = lax.optimization_barrier(units)
        by = units[:, : len(columns)], units[:, len(columns) :]
        count = jnp.sum(ways >= 0, axis=0, dtype=jnp.int32)
        return tuple(jax.tree.leaves(walked_along(on, columns, x, *by, count)))

    if simd.serves():
        kinds = [np.dtype(np.int32), *[dtype] * form.num_leaves]
        return lane_program(walk, kinds, sum(run.rows()), dtype, ("walk on real ground", run))
    return _by_xla(walk)

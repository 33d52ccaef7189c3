"""What is asked of lanes on real ground: walks of many steps, one step with all that moves it."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax import simd
from vrw_jax.models.unilateral.lanes import Walk, told_like, walked, walked_along
from vrw_jax.models.unilateral.ledger import UnilateralStep
from vrw_jax.models.unilateral.section import LOCKED, embedded, section_size
from vrw_jax.models.unilateral.wheel import UnilateralWheel
from vrw_jax.numerics import Options, explicit_tableau, in_batches
from vrw_jax.runtime import lane_program
from vrw_jax.wheel import PARAMETER_NAMES, symbols_of

BLOCK = 2048
"""Lanes that walk side by side where XLA compiles the walk."""


def walk_lanes(
    columns: np.ndarray,
    states: np.ndarray,
    n_steps: int,
    model: UnilateralWheel,
    options: Options,
    n: int,
) -> tuple[np.ndarray, ...]:
    """`n_steps` steps of many wheels with `n` legs: section states, durations, outcomes, steps
    made, steps tried and the last one's length, m. What is static of the model holds for all.

    `columns` are the parameters in their order and friction, shape (10, wheels); `states` full
    section states, shape (wheels, 4 + 3 n).
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
    """One step of many wheels, as `walk_lanes` takes them, and how what it tells moves.

    Leading axis: wheels; derivatives have a last one over the columns, then the section state.
    Each direction is a lane of its own beside the wheel's motion. What is not `wanted` and what
    cannot move, lengths of legs on their stoppers and codes, has zeros.
    """
    run = _Run.of(model, options, n, True)
    code = np.round(states[:, 4 + 2 * n :])
    numbers = np.concatenate([columns.T, states], 1)
    moves = np.ones(numbers.shape, bool)
    free = np.concatenate([code < LOCKED, code < LOCKED, np.zeros(code.shape, bool)], 1)
    moves[:, len(columns) + 4 :] = free
    if wanted is not None:
        moves &= np.isin(np.arange(numbers.shape[1]), wanted)
        moves[~moves.any(1), 0] = True  # the step itself is told beside a direction
    owner, place = np.nonzero(moves)
    ways = np.zeros((len(owner), numbers.shape[1]))
    ways[np.arange(len(owner)), place] = 1.0
    given = [numbers[owner].T, ways.T]
    split = [part for x in given for part in (x[: len(columns)], x[len(columns) :])]
    walk, moved = _walked(run, split, 1, options.for_derivatives())
    first = np.searchsorted(owner, np.arange(len(columns.T)))

    def jacobian(leaf: np.ndarray) -> np.ndarray:
        full = np.zeros((*numbers.shape, *leaf.shape[1:]), leaf.dtype)
        full[owner, place] = leaf
        return np.moveaxis(full, 1, -1)

    return jax.tree.map(lambda x: x[first], walk.told), jax.tree.map(jacobian, moved)


class _Run(NamedTuple):
    """What a compiled walk depends on besides its arrays."""

    static: Options
    n_legs: int
    max_events: int
    one_sided: bool
    by_paper: bool
    moved: bool  # all that a step tells, and along a direction of each lane

    @classmethod
    def of(cls, model: UnilateralWheel, options: Options, n: int, moved: bool) -> "_Run":
        """Of these options."""
        if model.restitution is not None:
            raise ValueError(
                "restitution is given, but in lanes feet don't come back: walk wheels one by one, "
                "by vrw.walk, or map vrw.return_map over them."
            )
        static = eqx.filter(options, eqx.is_array, inverse=True)
        return cls(static, n, model.max_events, model.one_sided, model.by_paper, moved)

    def on(self, dynamic: Options, n_steps: Array) -> Walk:
        """The walk of lanes."""
        options = eqx.combine(dynamic, self.static)
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # the caller looked
        rules = self.one_sided, self.by_paper, self.moved
        return Walk(self.n_legs, n_steps, self.max_events, *rules, options, tableau)

    def rows(self) -> tuple[int, ...]:
        """Of the arrays that are given: columns and states, then a direction of both."""
        sizes = len(PARAMETER_NAMES) + 1, section_size(self.n_legs)
        return sizes * 2 if self.moved else sizes

    def told(self, dtype: Any) -> Any:
        """Shapes and types of what is told of one wheel."""
        walk = jax.eval_shape(lambda: told_like(self.n_legs, dtype, self.moved))
        if not self.moved:
            return walk
        return walk, eqx.filter(walk.told, lambda x: jnp.issubdtype(x.dtype, jnp.inexact))


def _walked(run: _Run, given: list[np.ndarray], n_steps: int, options: Options) -> Any:
    """What is told of lanes, which these arrays have on their last axis, now leading."""
    dtype = given[0].dtype
    # Those beside each other wait for each other: stability bounds the step where damping is high.
    order = np.argsort(-given[0][PARAMETER_NAMES.index("damping")], kind="stable")
    dynamic, form = jax.tree.flatten(eqx.filter(options, eqx.is_array))
    uniform = [np.int32(n_steps), *(np.asarray(leaf, dtype) for leaf in dynamic)]
    lanes = [row[order] for x in given for row in x]
    rows = _program(run, dtype, form)(uniform, lanes) if len(order) else None
    back = np.argsort(order, kind="stable")
    leaves, structure = jax.tree.flatten(run.told(dtype))
    found, taken = [], 0
    for leaf in leaves:
        size = math.prod(leaf.shape)
        if rows is None:
            found.append(np.zeros((0, *leaf.shape), leaf.dtype))
        else:
            own = np.stack(rows[taken : taken + size], 1)[back]
            found.append(own.reshape(-1, *leaf.shape))
        taken += size
    return jax.tree.unflatten(structure, found)


def as_full_states(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """The full section states of the paper's, wheel by wheel; others are left as they are."""
    if states.shape[1] != 3:
        return states
    embed = lambda values, x: embedded(symbols_of(n, *values), x)
    return np.asarray(jax.vmap(embed, (1, 0))(columns[:-1], jnp.asarray(states)))


@functools.cache
def _program(run: _Run, dtype: np.dtype, form: Any) -> Callable[..., Any]:
    """The compiled walk, of numbers and of rows with lanes: one for any number of steps."""

    def walk(uniform: tuple, lanes: tuple) -> tuple:
        n_steps, *dynamic = uniform
        on = run.on(jax.tree.unflatten(form, dynamic), n_steps)
        rows = iter(lanes)
        given = [jnp.stack([next(rows) for _ in range(size)]) for size in run.rows()]
        told = walked_along(on, *given) if run.moved else walked(on, *given)
        flat = lambda leaf: leaf.reshape(-1, leaf.shape[-1])
        return tuple(row for leaf in jax.tree.leaves(told) for row in flat(leaf))

    if simd.serves():
        kinds = [np.dtype(np.int32), *[dtype] * form.num_leaves]
        return lane_program(walk, kinds, sum(run.rows()), dtype, ("walk on real ground", run))
    by_xla = jax.jit(walk)

    def in_blocks(uniform: list, lanes: list) -> tuple:
        return in_batches(lambda *rows: by_xla(tuple(uniform), rows), (BLOCK,), *lanes)

    return in_blocks

"""What is asked of lanes on real ground: walks of many steps, and one step with all that moves it.

Wheels wait in queues of one length, for which the walk (`lanes`) is compiled.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.models.unilateral.lanes import QUEUE, Walk, queue_of, walked_through
from vrw_jax.models.unilateral.section import LOCKED, embedded
from vrw_jax.models.unilateral.wheel import UnilateralStep, UnilateralWheel
from vrw_jax.numerics import Options, explicit_tableau
from vrw_jax.runtime import fusion_emitters
from vrw_jax.wheel import PARAMETER_NAMES, symbols_of


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
    program = _Run.of(model, options, n, columns.dtype, False)
    given = [columns, states.T]
    lean, outcome, n_stepped, tried = _in_queues(program, given, n_steps)
    return lean.section_state, lean.durations, outcome, n_stepped, tried, lean.step_length


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
    program = _Run.of(model, options.for_derivatives(), n, columns.dtype, True)
    code = np.round(states[:, 4 + 2 * n :])
    numbers = np.concatenate([columns.T, states], 1)
    moves = np.ones(numbers.shape, bool)
    free = np.concatenate([code < LOCKED, code < LOCKED, np.zeros(code.shape, bool)], 1)
    moves[:, len(columns) + 4 :] = free
    if wanted is not None:
        moves &= np.isin(np.arange(numbers.shape[1]), wanted)
    owner, place = np.nonzero(moves)
    ways = np.zeros((len(owner), numbers.shape[1]))
    ways[np.arange(len(owner)), place] = 1.0
    given = [numbers[owner].T, ways.T]
    split = [part for x in given for part in (x[: len(columns)], x[len(columns) :])]
    (step, moved), *_ = _in_queues(program, split, 1)
    first = np.searchsorted(owner, np.arange(len(columns.T)))

    def jacobian(leaf: np.ndarray) -> np.ndarray:
        full = np.zeros((*numbers.shape, *leaf.shape[1:]), leaf.dtype)
        full[owner, place] = leaf
        return np.moveaxis(full, 1, -1)

    return jax.tree.map(lambda x: x[first], step), jax.tree.map(jacobian, moved)


def _in_queues(program: Callable[..., Any], given: list[np.ndarray], n_steps: int) -> Any:
    """What the program tells of lanes, which these arrays have on their last axis, now leading."""
    parts = []
    # Most work first, so that no lane is left alone with much of it at the end: stability bounds
    # the step where damping is high.
    order = np.argsort(-given[0][PARAMETER_NAMES.index("damping")], kind="stable")
    for begin in range(0, max(len(order), 1), QUEUE):
        some = order[begin : begin + QUEUE]
        filled = np.resize(some, QUEUE) if len(some) else np.zeros(QUEUE, int)
        filled[len(some) :] = filled[len(some) - 1]
        lanes = [np.ascontiguousarray(x[:, filled]) for x in given]
        out = program(*lanes, np.int32(len(some)), np.int32(n_steps))
        n = len(some)
        parts.append(jax.tree.map(lambda x, n=n: np.asarray(x)[..., :n], out))
    back = np.argsort(order, kind="stable")
    together = lambda *x: np.moveaxis(np.concatenate(x, -1), -1, 0)[back]
    return jax.tree.map(together, *parts)


class _Run(NamedTuple):
    """What a compiled walk depends on besides its arrays."""

    static: Options
    n_legs: int
    max_events: int
    one_sided: bool
    by_paper: bool
    moved: bool  # all that a step tells, and along a direction of each lane

    @classmethod
    def of(
        cls, model: UnilateralWheel, options: Options, n: int, dtype: Any, moved: bool
    ) -> Callable[..., Any]:
        """The program with these options."""
        if model.restitution is not None:
            raise ValueError(
                "restitution is given, but in lanes feet don't come back: walk wheels one by one, "
                "by vrw.walk, or map vrw.return_map over them."
            )
        dynamic, static = eqx.partition(options, eqx.is_array)
        dynamic = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), dynamic)
        run = _program(cls(static, n, model.max_events, model.one_sided, model.by_paper, moved))
        return lambda *given: run(*given, dynamic)


def as_full_states(columns: np.ndarray, states: np.ndarray, n: int) -> np.ndarray:
    """The full section states of the paper's, wheel by wheel; others are left as they are."""
    if states.shape[1] != 3:
        return states
    embed = lambda values, x: embedded(symbols_of(n, *values), x)
    return np.asarray(jax.vmap(embed, (1, 0))(columns[:-1], jnp.asarray(states)))


@functools.cache
def _program(run: _Run) -> Callable[..., tuple]:
    """The compiled walk of one queue: one program for every batch and number of steps."""

    def walk(columns: Array, x: Array, wanted: Array, n_steps: Array, dynamic: Options) -> tuple:
        options = eqx.combine(dynamic, run.static)
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # the caller looked
        legs, events = run.n_legs, run.max_events
        rules = run.one_sided, run.by_paper, run.moved
        on = Walk(legs, n_steps, events, *rules, options, tableau)
        return walked_through(queue_of(columns, x, on), wanted, on)

    def along(
        columns: Array, x: Array, d_columns: Array, d_x: Array, *others: Any
    ) -> tuple[Any, ...]:
        def told(columns: Array, x: Array) -> tuple:
            step, *rest = walk(columns, x, *others)
            floats, fixed = eqx.partition(step, eqx.is_inexact_array)
            return floats, (fixed, *rest)

        at, way = (columns, x), (d_columns, d_x)
        floats, moved, (fixed, *rest) = jax.jvp(told, at, way, has_aux=True)
        return (eqx.combine(floats, fixed), moved), *rest

    return jax.jit(along if run.moved else walk, compiler_options=fusion_emitters(False))

"""Gaits with unilateral contact, found by Newton's method on batched steps and their derivatives.

All tangents of a step are computed beside its motion in the same machine code. Many wheels are
therefore searched side by side, and no large program is compiled for the derivatives.
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles.attracting import slow_gaits
from vrw_jax.cycles.by_walking import (
    AbstractWalkingFinder,
    SectionFinder,
    WalkedCycle,
    cycle_from,
    finest,
    gait_of,
    of_steps,
    walked_cycle,
    where_walks_begin,
)
from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.finder import Gait, Measured, Values, leading, measured_of
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.models import (
    AbstractStep,
    AbstractWheel,
    UnilateralWheel,
    step_lanes,
)
from vrw_jax.numerics import Options, SectionCycle, in_batches, taken
from vrw_jax.results import ON_GROUND
from vrw_jax.walks import checked
from vrw_jax.wheel import Outcome, WheelParams
from vrw_jax.wording import traced

ITERATIONS, HALVINGS = 15, 6
"""Largest number of Newton iterations, and of halvings of a correction after which no step ends."""

LOOSE, ROUGH = 1e-6, 1e-4
"""Tolerance of the steps far from a gait, and the correction below which a state is near a gait."""

CLEAR = 0.01
"""Factor below the tolerance at which a correction is accepted without a second one."""

SHAPES = (1, 8, 64, 512)
"""Numbers of gaits that are read together. Each number is compiled once."""


class GroundFinder(AbstractWalkingFinder):
    """Finder with unilateral contact, with first derivatives, including those with respect to
    friction."""

    model: UnilateralWheel
    shapes: tuple[int, ...] = eqx.field(static=True, default=SHAPES)

    of_cycle: ClassVar[tuple[str, ...]] = ("spectral_radius", "spectral_margin")
    differentiable: ClassVar[tuple[str, ...]] = ON_GROUND
    usual: ClassVar[tuple[str, ...]] = ON_GROUND
    readable: ClassVar[tuple[str, ...]] = ON_GROUND
    coexisting: ClassVar[bool] = True

    @classmethod
    def of(
        cls, model: Any, n_legs: int, step: Options, period_n: int, cycle: CycleOptions
    ) -> AbstractWalkingFinder:
        if model.restitution is not None:  # the batched engine has no restitution
            return SectionFinder(model, n_legs, step, period_n)
        return cls(model, n_legs, step, period_n)

    def cycle(self, params: WheelParams, guess: Any = None) -> WalkedCycle:
        """Return the cycle from the batched engine if all inputs are concrete, else from the step's
        own derivatives."""
        params, x, model, options = where_walks_begin(self, params, guess)
        if traced(params, x, model):
            return walked_cycle(params, x, model, options, self.period_n, dear=True)
        return jax.tree.map(lambda x: x[0], self.near(model.values(params)[None], x[None]))

    def cycles(self, params: WheelParams, guess: Any = None) -> Any:
        if traced(params, guess):
            return eqx.filter_vmap(self.cycle)(params, guess)
        values = jax.vmap(self.model.values)(params)
        return self.near(values, _states(self.model, params, guess))

    def near(self, values: Any, states: Any) -> WalkedCycle:
        """Return the gaits near section states, one per wheel, without derivatives."""
        return self._told(_cycle, values, states, by_values=False)

    def prepare(self, values: np.ndarray, states: np.ndarray) -> None:
        """Compile the programs of Newton's method while another thread walks towards its start."""
        maps = Periods(self.model, self.n_legs, self.period_n, values)
        maps.around(self.step_options, states, False)

    def first_guess(self, values: Values) -> Array:
        return _first(self.first_guesses(_alone(values)))

    def first_guesses(self, values: Array) -> Array:
        """Return a slow attracting gait's section state for each wheel, NaN if there is none."""
        gaits = slow_gaits(self, values)
        found = np.asarray(gaits.outcome) == Outcome.STEPPED
        return jax.device_put(np.where(found[:, None], gaits.section_state, np.nan))

    def find(self, values: Values, guess: Array) -> Gait:
        return _first(self.find_many(_alone(values), _alone(guess)))

    def find_many(self, values: Array, guess: Any) -> Gait:
        return self._told(_gait, values, getattr(guess, "section_state", guess), by_values=True)

    def _told(self, one: Callable, values: Any, states: Any, by_values: bool) -> Any:
        given = np.asarray(values), np.asarray(states), by_values
        found = _newton(self.model, self.n_legs, self.step_options, self.period_n, *given)
        told = functools.partial(_many, one, self.model, self.n_legs)
        return in_batches(told, self.shapes, given[0], found)

    def step(self, params: WheelParams, x: Array) -> AbstractStep:
        columns, model = np.asarray(self.model.values(params))[:, None], self.model
        given = columns, np.asarray(x)[None], model, self.step_options, self.n_legs
        return _first(step_lanes(*given, ())[0])

    def measured(self, values: Values, guess: Any, names: tuple[str, ...]) -> Measured:
        """Return measures and derivatives, as in the base class, from one Jacobian of the step."""
        model, params = self.model.at(tuple(jax.device_put(list(np.asarray(values)))), self.n_legs)
        start = guess.section_state if isinstance(guess, AbstractCycle) else guess
        start = self.first_guess(values) if start is None else start
        _, x, _, _ = checked(params, start, model, self.step_options)
        return measured_of(self.find(values, x), type(self).read, names)


def _alone(x: Array) -> Array:
    """Add a batch axis of length one, by numpy because JAX compiles a program for each shape."""
    return jax.device_put(np.asarray(x)[None])


def _first(tree: Any) -> Any:
    """Return the first row of every leaf: the inverse of `_add_batch_axis`."""
    return jax.device_put(taken(tree, 0))


def _states(model: AbstractWheel, params: WheelParams, guess: Any) -> Array:
    """Return full section states of each wheel from a user's guess."""
    x = getattr(guess, "section_state", guess)
    if x is None:
        return jax.vmap(model.start)(params)
    return jax.vmap(model.full_section)(params, jnp.asarray(x))


class _Found(NamedTuple):
    """Result of Newton's method; with a leading axis for many wheels."""

    x: Any  # section state
    steps: Any  # from that state, (period_n, ...)
    moves: Any  # derivatives with respect to values and section state
    residual: Any
    converged: Any
    iterations: Any


class Periods(NamedTuple):
    """Map over one period of each wheel for Newton's method, evaluated by the batched engine
    outside jit."""

    model: Any
    n_legs: int
    period_n: int
    values: np.ndarray  # (wheels, n_values)

    def of(self, some: np.ndarray) -> "Periods":
        return self._replace(values=self.values[some])

    def around(
        self, options: Options, x: np.ndarray, by_values: Any = True, by_start: bool = True
    ) -> "Period":
        """Evaluate the period from `x`, with derivatives with respect to the masked values and the
        section state."""
        told, (n, m) = [], (self.values.shape[1], x.shape[1])
        along, good = np.concatenate([np.zeros((m, n)), np.eye(m)], 1)[None], np.ones(len(x), bool)
        asked = np.concatenate([np.broadcast_to(by_values, n), np.broadcast_to(by_start, m)])
        wanted = np.flatnonzero(asked).tolist()
        for _ in range(self.period_n):
            given = self.values.T, x, self.model, options, self.n_legs, wanted
            told.append(step_lanes(*given))
            step, moves = told[-1]
            good &= np.asarray(step.outcome) == Outcome.STEPPED
            x = np.asarray(step.section_state)
            by = np.asarray(moves.section_state)
            along = by[:, :, n:] @ along
            along[:, :, :n] += by[:, :, :n]
        steps, moved = (
            jax.tree.map(lambda *leaves: np.stack(leaves, 1), *each)
            for each in zip(*told, strict=True)
        )
        return Period(steps, moved, x, along[:, :, :n], along[:, :, n:], good)


class Period(NamedTuple):
    """Steps of one period, their Jacobians, the end state, its Jacobians, and which periods end."""

    steps: Any
    moves: Any
    image: np.ndarray
    by_values: np.ndarray
    by_start: np.ndarray
    good: np.ndarray

    def change(self, x: np.ndarray, by_start: np.ndarray) -> np.ndarray:
        """Return Newton's correction of x; zeros where no period ends."""
        change, good = np.zeros_like(x), self.good
        matrix = np.eye(x.shape[1]) - by_start[good]
        change[good] = solved(matrix, (self.image - x)[good][..., None])[..., 0]
        return change


def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return `numpy.linalg.solve` of many systems. A singular one gives NaN instead of an error for
    all."""
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        regular = np.abs(np.linalg.det(matrix)) > 0.0
        one = np.where(regular[:, None, None], matrix, np.eye(matrix.shape[-1]))
        return np.where(regular[:, None, None], np.linalg.solve(one, right), np.nan)


def _newton(
    model: Any,
    n_legs: int,
    options: Options,
    period_n: int,
    values: np.ndarray,
    start: np.ndarray,
    by_values: bool,
) -> _Found:
    """Return fixed points near `start`. Codes at the end of a section state are those of the image.

    The iteration uses loose steps until corrections are small. Then a step at the tolerance of
    `options` is taken with the same Jacobian. One more step, with all derivatives, yields the gait.
    If loose steps move away from a state that an exact one hardly changes, all steps are exact.
    """
    maps = Periods(model, n_legs, period_n, values)
    looser = [np.maximum(tolerance, LOOSE) for tolerance in (options.rtol, options.atol)]
    loose = eqx.tree_at(lambda o: (o.rtol, o.atol), options, jax.device_put(looser))
    tolerance, every = float(finest(options)), np.ones(len(values), bool)
    rough, by_start = _corrected(maps, loose, start, False, ROUGH, every)
    x, near = np.where(rough.converged[:, None], rough.x, start), rough.converged
    exact = maps.around(options, x, False, False)
    change = exact.change(x, by_start)
    x[near] += change[near] * (np.abs(change[near]).max(-1, keepdims=True) < ROUGH)
    near = near | (exact.good & (np.abs(exact.image - x).max(-1) < ROUGH))
    told, _ = _corrected(maps, options, x, by_values, tolerance, near, ends=False)
    return told._replace(iterations=rough.iterations + 1 + told.iterations)


def _corrected(
    maps: Periods,
    options: Options,
    start: np.ndarray,
    by_values: bool,
    tolerance: float,
    wanted: np.ndarray,
    ends: bool = True,
) -> tuple[_Found, np.ndarray]:
    """Run Newton's method on the `is_wanted` wheels until corrections are small; return the last
    Jacobians too.

    A correction after which no period ends is halved. A small correction ends the iteration if
    `stops_at_small_correction` is set. Otherwise another evaluation follows, which gives the gait
    at the corrected state. It also requires a period that repeats, because the map may jump between
    the two states where feet dip.
    """
    wheels, n_legs = len(start), maps.n_legs
    x, last = start.copy(), start.copy()
    residual, count = np.full(wheels, np.inf), np.zeros(wheels, np.int32)
    small, found, halved = (np.zeros(wheels, kind) for kind in (bool, bool, int))
    by_start = np.zeros((wheels, start.shape[1], start.shape[1]))
    open_, kept = np.arange(wheels), None
    for _ in range(ITERATIONS + HALVINGS):
        now = maps.of(open_).around(options, x[open_], by_values)
        if kept is None:
            kept = jax.tree.map(np.array, (now.steps, now.moves))
        for old, new in zip(jax.tree.leaves(kept), jax.tree.leaves(now[:2]), strict=True):
            old[open_] = new
        change = now.change(x[open_], now.by_start)
        size, good = np.abs(change).max(-1), now.good & np.isfinite(change).all(-1)
        residual[open_] = np.abs(now.image - x[open_]).max(-1)
        by_start[open_] = now.by_start
        count[open_] += 1
        fits = good & (size <= tolerance)
        done = fits & (small[open_] | (size <= CLEAR * tolerance)) & (not ends)
        small[open_] = fits
        moving = open_[good & ~done]
        last[moving], halved[moving] = x[moving], 0
        x[moving] += change[good & ~done]
        bad = open_[~good]
        x[bad], halved[bad] = 0.5 * (x[bad] + last[bad]), halved[bad] + 1
        x[bad, -n_legs:] = last[bad, -n_legs:]
        found[open_] = wanted[open_] & (small[open_] if ends else done)
        lost = (halved > HALVINGS) | (count > ITERATIONS) | ~wanted
        open_ = open_[~found[open_] & ~lost[open_]]
        if not len(open_):
            break
    assert kept is not None
    return _Found(x, kept[0], kept[1], residual, found, count), by_start


@eqx.filter_jit
def _many(one: Callable, model: AbstractWheel, n_legs: int, values: Array, found: _Found) -> Any:
    return eqx.filter_vmap(lambda values, found: one(model, n_legs, values, found))(values, found)


def _by_section(found: _Found, n: int) -> Array:
    by_section = jnp.eye(found.x.shape[0], dtype=found.x.dtype)
    for jacobian in found.moves.section_state:
        by_section = jacobian[:, n:] @ by_section
    return by_section


def _cycle(model: AbstractWheel, n_legs: int, values: Array, found: _Found) -> WalkedCycle:
    told = found.residual, found.converged, found.iterations
    params = model.at(values, n_legs)[1]
    located = SectionCycle(found.x, _by_section(found, len(values)), *told)
    return cycle_from(params, located, found.steps)


def _gait(model: AbstractWheel, n_legs: int, values: Array, found: _Found) -> Gait:
    n, one = values.shape[0], jnp.eye(found.x.shape[0], dtype=found.x.dtype)
    by_values, by_section = jnp.zeros((len(one), n), one.dtype), _by_section(found, n)
    for jacobian in found.moves.section_state:
        by_values = jacobian[:, :n] + jacobian[:, n:] @ by_values
    regular = jnp.where(found.converged, one - by_section, one)
    moved = jnp.linalg.solve(regular, by_values)

    here, d_steps = moved, []
    for k in range(len(found.moves.section_state)):
        follow = jnp.concatenate([jnp.eye(n, dtype=one.dtype), here])
        along = jax.tree.map(lambda leaf, k=k, follow=follow: leaf[k] @ follow, found.moves)
        d_steps.append(leading(along))
        here = along.section_state
    d_step = jax.tree.map(lambda *leaves: jnp.stack(leaves, 1), *d_steps)

    cycle = _cycle(model, n_legs, values, found)
    # The derivative of the Jacobian is unknown: measures of it are not in `differentiable`.
    floating = eqx.filter(cycle, eqx.is_inexact_array)
    still = jax.tree.map(lambda x: jnp.zeros((n, *x.shape), x.dtype), floating)
    d_cycle = eqx.tree_at(
        lambda c: (c.section_state, c.steps, c.post_impact, c.durations, c.step_length),
        still,
        (moved.T, d_step, *jax.vmap(of_steps)(d_step)),
    )
    first = jax.tree.map(lambda leaf: leaf[0], found.steps)
    d_first = jax.tree.map(lambda leaf: leaf[:, 0], d_step)
    return gait_of(model, n_legs, cycle, first, d_cycle, d_first)

"""Gaits on real ground, by Newton's method on steps of lanes and their derivatives.

Every direction in which a step moves is a lane of the same machine code, so that many wheels are
searched side by side and nothing large is compiled for the derivatives.
"""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles.by_walking import (
    AbstractWalkingFinder,
    SectionFinder,
    gait_of,
    where_walks_begin,
)
from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.finder import Gait, Measured, Values, leading, measured_of
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.section_cycle import WalkedCycle, cycle_from, finest, of_steps, walked_cycle
from vrw_jax.models import (
    AbstractStep,
    AbstractWheel,
    UnilateralWheel,
    step_lanes,
    walk_lanes,
)
from vrw_jax.numerics import Options, SectionCycle, SolverName, as_float_array
from vrw_jax.results import ON_GROUND
from vrw_jax.walks import N_TOWARDS, checked
from vrw_jax.wheel import Outcome, WheelParams

ITERATIONS, HALVINGS = 30, 6
"""Of Newton's method, and of a correction that leads where no step ends, at most."""

SHAPES = (1, 8, 64, 512)
"""Numbers of gaits that are told together: each is compiled for once."""

SOLVER_TOWARDS: SolverName = "Tsit5"
TOLERANCE_TOWARDS = 1e-8
"""Of the steps towards a gait, whatever those of the gait itself."""


def options_towards() -> Options:
    """Of walks towards a gait."""
    tolerance = as_float_array(TOLERANCE_TOWARDS)
    return Options(solver=SOLVER_TOWARDS, rtol=tolerance, atol=tolerance)


class GroundFinder(AbstractWalkingFinder):
    """On real ground, with first derivatives, friction's included."""

    model: UnilateralWheel

    of_cycle: ClassVar[tuple[str, ...]] = ("spectral_radius", "spectral_margin")
    differentiable: ClassVar[tuple[str, ...]] = ON_GROUND
    usual: ClassVar[tuple[str, ...]] = ON_GROUND
    readable: ClassVar[tuple[str, ...]] = ON_GROUND
    coexisting: ClassVar[bool] = True

    @classmethod
    def of(
        cls, model: Any, n_legs: int, step: Options, period_n: int, cycle: CycleOptions
    ) -> AbstractWalkingFinder:
        if model.restitution is not None:  # lanes know no feet that come back
            return SectionFinder(model, n_legs, step, period_n)
        return cls(model, n_legs, step, period_n)

    def cycle(self, params: WheelParams, guess: Any = None) -> WalkedCycle:
        """By lanes where everything has a value, else by the step's own derivatives."""
        params, x, model, options = where_walks_begin(self, params, guess)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((params, x, model))):
            return walked_cycle(params, x, model, options, self.period_n)
        return self.find(model.values(params), x).cycle  # type: ignore[return-value]

    def cycles(self, params: WheelParams, guess: Any = None) -> Any:
        """Side by side."""
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((params, guess))):
            return eqx.filter_vmap(self.cycle)(params, guess)
        values = jax.vmap(self.model.values)(params)
        return self.find_many(values, _states(self.model, params, guess)).cycle

    def first_guess(self, values: Values) -> Array:
        return self.first_guesses(values[None])[0]

    def first_guesses(self, values: Array) -> Array:
        """Where walks from the rung's start end, wheel by wheel."""
        starts = np.asarray(jax.vmap(self._start)(values))
        columns = np.asarray(values).T
        model: Any = self.model
        given = columns, starts, N_TOWARDS, model, options_towards(), self.n_legs
        reached, _, outcome, *_ = walk_lanes(*given)
        return jnp.asarray(np.where(outcome[:, None] == Outcome.STEPPED, reached, starts))

    def _start(self, values: Values) -> Array:
        model, params = self.model.at(values, self.n_legs)
        return model.start(params)

    def find(self, values: Values, guess: Array) -> Gait:
        return jax.tree.map(lambda x: x[0], self.find_many(values[None], guess[None]))

    def find_many(self, values: Array, guess: Any) -> Gait:
        x = getattr(guess, "section_state", guess)
        given = np.asarray(values), np.asarray(x)
        found = _newton(self.model, self.n_legs, self.step_options, self.period_n, *given)
        return _told_in_shapes(self.model, self.n_legs, jnp.asarray(given[0]), found)

    def step(self, params: WheelParams, x: Array) -> AbstractStep:
        columns, model = np.asarray(self.model.values(params))[:, None], self.model
        told, _ = step_lanes(columns, np.asarray(x)[None], model, self.step_options, self.n_legs)
        return jax.tree.map(lambda leaf: leaf[0], told)

    def measured(self, values: Values, guess: Any, names: tuple[str, ...]) -> Measured:
        """As everywhere; of one Jacobian of the step."""
        model, params = self.model.at(values, self.n_legs)
        start = guess.section_state if isinstance(guess, AbstractCycle) else guess
        start = model.start(params) if start is None else start
        _, x, _, _ = checked(params, start, model, self.step_options)
        return measured_of(self.find(values, x), type(self).read, names)


def _states(model: AbstractWheel, params: WheelParams, guess: Any) -> Array:
    """Full section states, wheel by wheel, of what a caller gives."""
    x = getattr(guess, "section_state", guess)
    if x is None:
        return jax.vmap(model.start)(params)
    return jax.vmap(model.full_section)(params, jnp.asarray(x))


class _Found(NamedTuple):
    """Where Newton's method has come to; of many wheels with a leading axis."""

    x: Any  # section state
    steps: Any  # from there, (period_n, ...)
    moves: Any  # and their derivatives by values and section state
    residual: Any
    converged: Any
    iterations: Any


def _around(
    model: Any, n_legs: int, options: Options, period_n: int, values: np.ndarray, x: np.ndarray
) -> tuple[Any, Any, np.ndarray, np.ndarray, np.ndarray]:
    """Steps of one period, their derivatives, where they lead, by what of x, and which arrive."""
    told, n = [], values.shape[1]
    by_start, good = np.eye(x.shape[1])[None], np.ones(len(x), bool)
    for _ in range(period_n):
        told.append(step_lanes(values.T, x, model, options, n_legs))
        step, moves = told[-1]
        good &= np.asarray(step.outcome) == Outcome.STEPPED
        x = np.asarray(step.section_state)
        by_start = np.asarray(moves.section_state)[:, :, n:] @ by_start
    steps, moved = (
        jax.tree.map(lambda *leaves: np.stack(leaves, 1), *each) for each in zip(*told, strict=True)
    )
    return steps, moved, x, by_start, good


def _newton(
    model: Any, n_legs: int, options: Options, period_n: int, values: np.ndarray, start: np.ndarray
) -> _Found:
    """Fixed points near `start`; codes at the end of a section state are those of the image.

    A correction that leads where no step ends is halved. Once one is small enough another
    evaluation tells the gait there.
    """
    wheels, one = len(values), np.eye(start.shape[1])
    x, last, tolerance = start.copy(), start.copy(), float(finest(options))
    residual, count = np.full(wheels, np.inf), np.zeros(wheels, np.int32)
    small, halved = np.zeros(wheels, bool), np.zeros(wheels, int)
    open_, kept = np.arange(wheels), None
    for _ in range(ITERATIONS + HALVINGS):
        given = model, n_legs, options, period_n, values[open_], x[open_]
        steps, moves, image, by_start, good = _around(*given)
        if kept is None:
            kept = jax.tree.map(np.array, (steps, moves))
        for old, new in zip(jax.tree.leaves(kept), jax.tree.leaves((steps, moves)), strict=True):
            old[open_] = new
        miss = image - x[open_]
        change = np.zeros_like(miss)
        change[good] = np.linalg.solve(one - by_start[good], miss[good][..., None])[..., 0]
        good &= np.isfinite(change).all(-1)
        residual[open_] = np.abs(miss).max(-1)
        lanes, done = open_[good], small[open_] & good
        tight = np.abs(change).max(-1) <= tolerance
        count[lanes] += 1
        small[open_] = (small[open_] | tight) & good
        moving = good & ~done
        last[open_[moving]] = x[open_[moving]]
        x[open_[moving]] += change[moving]
        halved[open_[moving]] = 0
        bad = open_[~good]
        x[bad], halved[bad] = 0.5 * (x[bad] + last[bad]), halved[bad] + 1
        x[bad, -n_legs:] = last[bad, -n_legs:]
        lost = (halved > HALVINGS) | (count > ITERATIONS)
        open_ = open_[~done & ~lost[open_]]
        if not len(open_):
            break
    assert kept is not None
    converged = small & ~np.isin(np.arange(wheels), open_)
    steps, moves = kept
    return _Found(x, steps, moves, residual, converged, count)


def _told_in_shapes(model: AbstractWheel, n_legs: int, values: Array, found: _Found) -> Gait:
    """Gaits of any number of wheels by programs of few shapes."""
    parts, n = [], len(values)
    for begin in range(0, n, SHAPES[-1]):
        size = min(n - begin, SHAPES[-1])
        wide = next(shape for shape in SHAPES if shape >= size)
        some = np.minimum(np.arange(begin, begin + wide), begin + size - 1)
        given = jax.tree.map(lambda x, some=some: jnp.asarray(x)[some], (values, found))
        told = _told_many(model, n_legs, *given)
        parts.append(jax.tree.map(lambda x, size=size: x[:size], told))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


@eqx.filter_jit
def _told_many(model: AbstractWheel, n_legs: int, values: Array, found: _Found) -> Gait:
    return eqx.filter_vmap(lambda values, found: _told(model, n_legs, values, found))(values, found)


def _told(model: AbstractWheel, n_legs: int, values: Array, found: _Found) -> Gait:
    """The gait through a fixed point, and its derivatives along the branch."""
    n, one = values.shape[0], jnp.eye(found.x.shape[0], dtype=found.x.dtype)
    by_values, by_section = jnp.zeros((len(one), n), one.dtype), one
    for jacobian in found.moves.section_state:
        by_values = jacobian[:, :n] + jacobian[:, n:] @ by_values
        by_section = jacobian[:, n:] @ by_section
    regular = jnp.where(found.converged, one - by_section, one)
    moved = jnp.linalg.solve(regular, by_values)

    here, d_steps = moved, []
    for k in range(len(found.moves.section_state)):
        follow = jnp.concatenate([jnp.eye(n, dtype=one.dtype), here])
        along = jax.tree.map(lambda leaf, k=k, follow=follow: leaf[k] @ follow, found.moves)
        d_steps.append(leading(along))
        here = along.section_state
    d_step = jax.tree.map(lambda *leaves: jnp.stack(leaves, 1), *d_steps)

    params = model.at(values, n_legs)[1]
    told = found.residual, found.converged, found.iterations
    cycle = cycle_from(params, SectionCycle(found.x, by_section, *told), found.steps)
    # Nothing here tells how the Jacobian itself moves: what depends on it is not `differentiable`.
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

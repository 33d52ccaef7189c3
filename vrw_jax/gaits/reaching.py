"""Limit cycles wherever a gait can be reached: by a search, on finer meshes, or from walks.

The search (`cycles`) starts from predicted gaits of the paper's parameter ranges, on a mesh that
suits them. If it fails, batches of walks (`batches`) begin at starts that scale with the wheel. A
walk that continues is the start of another search. If the mesh is too coarse, it is refined. These
fallbacks depend on concrete values; under a `jit` or `vmap` of the caller only the search runs.
"""

import functools
from typing import Any, Literal, NamedTuple, get_args, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vrw_jax import cycles
from vrw_jax.batches import steps
from vrw_jax.cycles import (
    NEAR,
    AbstractGaitFinder,
    CollocationFinder,
    CycleOptions,
    Guess,
    LimitCycle,
    Located,
    WalkedCycle,
    further_starts_of,
    gaits_attracting,
    slowest,
    starts_of,
)
from vrw_jax.numerics import Options, in_batches, taken
from vrw_jax.walks import ModelLike
from vrw_jax.wheel import Outcome, WheelParams, parameters_of
from vrw_jax.wording import chosen, traced, untraced, whole

LOST = (
    Outcome.NO_CYCLE_FOUND,
    Outcome.ORDER_DIFFERS,
    Outcome.BORDER_ON_THE_WAY,
    Outcome.MESH_TOO_COARSE,
)
"""Outcomes of a search that may have missed a gait."""

MESH_ERROR = 1e-7
"""Estimate of the mesh's error above which a finer mesh is used. The errors themselves are a
hundredth of it, as the options promise."""

N_STEPS = 80
"""Number of steps of a walk towards a gait of the paper's model."""

REFINEMENTS = 3
"""Largest number of times that a mesh is made twice as fine."""

SHAPES = (8, 64, 512, 4096)
"""Batch sizes that programs are compiled for. A single wheel takes the time of eight."""


Lost = Literal["zeros", "nan"]
ZEROS_OR_NAN: tuple[str, ...] = get_args(Lost)

Which = Literal["slowest", "fastest"] | int
"""Choice among the attracting gaits of a wheel, by speed: the slowest, the fastest, or an index,
slowest first."""


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: None = None,
    options: CycleOptions | Options | None = None,
    lost: Lost = "zeros",
    which: Which = "slowest",
) -> LimitCycle: ...


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: ModelLike,
    options: CycleOptions | Options | None = None,
    lost: Lost = "zeros",
    which: Which = "slowest",
) -> LimitCycle | WalkedCycle: ...


def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: CycleOptions | Options | None = None,
    lost: Lost = "zeros",
    which: Which = "slowest",
) -> LimitCycle | WalkedCycle:
    """Return the limit cycle of this wheel: the gait that repeats after `period_n` steps.

    For `period_n` 1 no start is needed. With a `guess`, a neighbor's cycle or a section state
    (theta-, dtheta-, dL1-) near the gait, the search is faster and selects that branch. Found
    cycles satisfy the paper's sequence of phases at all nodes, stable or not. Errors are 1e-9
    relative in values and 1e-8 in first derivatives. Without `options` the mesh is made as fine as
    these errors require. With `options` the mesh is fixed, and `mesh_error` estimates its error.
    The cycle is differentiable in every mode and order.

    If the search fails, walks and finer meshes are tried. Under `jax.jit` and `jax.vmap` neither is
    possible; the search then runs alone, on the mesh of the options. See `limit_cycles`.

    If no gait is found, `outcome` and `explanation` give the reason, and numbers and derivatives
    are zero. With `on_failure="nan"` they are NaN, so that an optimization loop does not stop
    unnoticed.

    For any other model, the fixed point of its return map is computed, with the `StepOptions` of
    its step. The result is a `ReturnMapCycle` with the errors of the step. With unilateral contact
    several gaits may attract. Without a `guess`, walks from a stated set of starts distinguish them
    (`cycles.attracting_gaits`). `which` selects the "slowest", the "fastest" or an index in their
    list, slowest first. `limit_cycles` returns all. Model "auto" selects the lowest model whose
    margins the gait meets on its ground. A `LimitCycle` then belongs to the paper's model, a
    `ReturnMapCycle` to unilateral contact.

    Args:
        params: the wheel.
        guess: a neighbor's cycle, or a section state near the gait; a cycle that was not found
            counts as no guess.
        period_n: number of steps after which the gait repeats.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `CycleOptions`; for other models `StepOptions`.
        on_failure: values where there is no gait, "zeros" or "nan".
        which: with unilateral contact "slowest", "fastest", or an index in the list, slowest first.

    Returns:
        A `LimitCycle`; a `ReturnMapCycle` for other models.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams())
        >>> print(f"{cycle.dls_fraction:.4f} {cycle.speed:.4f} m/s")
        0.5315 0.8700 m/s
        >>> gradient = jax.grad(lambda p: vrw.limit_cycle(p).dls_fraction)(vrw.WheelParams())
        >>> print(f"{gradient.damping:.6f} per N s/m")
        0.000115 per N s/m
    """
    place_in_list(which)
    model = cycles.serving(params, model)
    finder = cycles.finder_for(params, model, options, whole("period_n", period_n))
    or_nan = chosen("lost", lost, ZEROS_OR_NAN) == "nan"
    if guess is None and period_n > 1 and not finder.coexisting:
        raise ValueError(
            f"period_n is {period_n} and there is no guess, but a gait of several steps is one of "
            "many beside the gait of one step: give guess=, a section state near it."
        )
    cycle: Any = _wherever(finder, params, cycles.near(guess), options is None, which)
    return cycle.or_nan(params) if or_nan else cycle


def limit_cycles(
    params: WheelParams,
    *,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: CycleOptions | Options | None = None,
    which: Which = "slowest",
) -> LimitCycle | WalkedCycle:
    """Return `limit_cycle` of a batch of wheels. Fields of `params` and of the result have one
    leading axis.

    All cycles are computed on one mesh, as fine as any of them needs. For a single wheel with
    unilateral contact, return all attracting gaits, slowest first.

    Args:
        params: the wheels; fields are scalars or of shape (wheels,).
        period_n: number of steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: as in `limit_cycle`.
        which: as in `limit_cycle`, for batches.

    Returns:
        A `LimitCycle` or `ReturnMapCycle` whose fields have a leading axis over wheels.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> cycles = vrw.limit_cycles(vrw.WheelParams(damping=np.array([100.0, 150.0, 300.0])))
        >>> cycles.found.tolist(), cycles.period.round(3).tolist()
        ([True, True, False], [0.595, 0.6980000000000001, 0.0])
    """
    place_in_list(which)
    shape = np.broadcast_shapes(*(np.shape(x) for x in jax.tree.leaves(params)))
    if not shape:
        model = cycles.serving(params, model)
        finder = cycles.finder_for(params, model, options, whole("period_n", period_n))
        if finder.coexisting:
            untraced("vrw.limit_cycles", "give vrw.limit_cycle a guess", params)
            return gaits_attracting(finder, finder.model.values(params)[None])[1]
    if len(shape) != 1:
        raise ValueError(f"the wheels' batch has shape {shape}, but it must have one axis.")
    params = jax.tree.map(lambda x: jnp.broadcast_to(x, shape), params)
    one = jax.tree.map(lambda x: x[0], params)
    finder = cycles.finder_for(one, model, options, whole("period_n", period_n))
    cycle: Any = _wherever(finder, params, None, options is None, which)
    return cycle


def place_in_list(which: Which) -> int:
    """Return the index of a gait in a list sorted by speed, slowest first.

    Raises: ValueError: the choice is neither a name nor an integer.
    """
    if which in ("slowest", "fastest"):
        return 0 if which == "slowest" else -1
    if isinstance(which, str) or int(which) != which:
        raise ValueError(
            f"which is {which!r}, but it names one of a wheel's gaits: give 'slowest', 'fastest' "
            "or its place in vrw.limit_cycles(params, model=...)."
        )
    return int(which)


def _chosen(finder: Any, params: WheelParams, which: Which) -> Any:
    wheels, place = params.damping.shape[0], place_in_list(which)
    owner, gaits = gaits_attracting(finder, jax.vmap(finder.model.values)(params))
    counts = np.bincount(owner, minlength=wheels)
    few = counts[(place >= counts) | (place < -counts)]
    if len(few):
        n = int(few[0])
        raise ValueError(
            f"which is {which}, but {n} gait{'s' * (n > 1)} of this wheel attract"
            f"{'s' * (n == 1)}: vrw.limit_cycles(params, model=...) returns them."
        )
    return _taken(gaits, slowest(owner, wheels) + place % counts)


def _wherever(finder: Any, params: WheelParams, guess: Any, adaptive: bool, which: Which) -> Any:
    """Return the cycle of one wheel or of a batch, by the search and all fallbacks."""
    many = params.damping.ndim > 0
    still = lax.stop_gradient(params)
    hidden, plain = traced(still), not traced(params)
    if finder.coexisting and guess is None and not hidden:
        cycle = _chosen(finder, still if many else _taken(still, None), which)
        cycle = cycle if many else _taken(cycle, 0)
        return cycle if plain else _searched(finder, params, cycle.section_state)
    cycle = _searched(finder, params, guess)
    known = lax.stop_gradient((params, cycle))  # differentiated arrays have values, too
    if not finder.from_nothing or traced(known):
        return cycle
    if not many:
        known = _taken(known, None)
    reached = _reached(finder, *known, adaptive)
    if finder.period_n > 1 and guess is not None:
        x = np.asarray(_state(guess))[None]
        if reached is None:
            reached = _from_another_step(finder, *known, x)
        reached = _counted_as(finder, *known, x, reached)
    if reached is None:
        return cycle
    finder, located = reached
    if plain:
        cycle = in_batches(finder.cycles, SHAPES, known[0], located)  # a compiled program
        return cycle if many else _taken(cycle, 0)
    return _searched(finder, params, jax.device_put(located) if many else _taken(located, 0))


def _searched(finder: AbstractGaitFinder, params: WheelParams, guess: Any) -> Any:
    return (finder.cycles if params.damping.ndim else finder.cycle)(params, guess)


def _taken(tree: Any, places: Any) -> Any:
    """Return rows of a tree by numpy, because JAX would compile a program for each shape."""
    return jax.device_put(taken(tree, places))


def _put(tree: Any, places: np.ndarray, values: Any) -> Any:
    def put(x: Any, v: Any) -> np.ndarray:
        x = np.array(x)
        x[places] = v
        return x

    return jax.tree.map(put, tree, values)


def _walked_from(
    finder: CollocationFinder, params: WheelParams, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Walk N_GAIT_WALK_STEPS from each state and measure the defect of one more period.

    The defect is infinite where a walk ended early.
    """
    there = steps(params, x, N_STEPS, model=finder.model)
    states, on = np.array(there.section_state), np.asarray(there.outcome) == Outcome.STEPPED
    missed = np.full(len(states), np.inf)
    if on.any():
        later = steps(_taken(params, on), states[on], finder.period_n, model=finder.model)
        away = np.abs(np.asarray(later.section_state) - states[on]).max(-1)
        missed[on] = np.where(np.asarray(later.outcome) == Outcome.STEPPED, away, np.inf)
    return states, missed


class _Walks(NamedTuple):
    """State of a batch of wheels after walks of N_GAIT_WALK_STEPS."""

    reached: np.ndarray  # whether a walk continues, and repeats to START_DISTANCE
    x: np.ndarray  # (wheels, 3): section state of the walk that repeats best


def _walked(finder: CollocationFinder, params: WheelParams, wanted: np.ndarray) -> _Walks:
    n, places = len(wanted), np.flatnonzero(wanted)
    best, x = np.full(n, np.inf), np.zeros((n, 3))
    for begin in (starts_of, further_starts_of):
        own = _taken(params, places)
        for start in begin(own) if len(places) else ():
            states, missed = _walked_from(finder, own, start)
            nearer = missed < best[places]
            lanes = places[nearer]
            best[lanes], x[lanes] = missed[nearer], states[nearer]
        places = np.flatnonzero(wanted & (best >= NEAR))
    return _Walks(best < NEAR, x)


def _begun(
    finder: CollocationFinder, params: WheelParams, located: Located, has: np.ndarray, walks: _Walks
) -> Located:
    """Return the starts of searches: the known states, else states from walks, else the surface of
    gaits."""
    start = in_batches(lambda own: finder.first_guesses(parameters_of(own).T), SHAPES, params)
    along = np.flatnonzero(walks.reached & ~has)
    if len(along):
        walk = jax.vmap(finder.after)
        start = _put(start, along, in_batches(walk, SHAPES, _taken(params, along), walks.x[along]))
    return _put(start, has, _taken(located, has))


def _reached(
    finder: CollocationFinder, params: WheelParams, cycle: LimitCycle, adaptive: bool
) -> tuple[CollocationFinder, Located] | None:
    """Return a finder, and starts from which it finds more of a batch's gaits; None if there are
    none.

    `refines_mesh` allows a finer mesh.
    """
    outcome = np.asarray(cycle.outcome)
    rough = adaptive & (np.asarray(cycle.mesh_error) > MESH_ERROR)
    lost = np.isin(outcome, LOST)
    open_ = lost | rough
    if not open_.any():
        return None
    walks = _walked(finder, params, lost)
    # Best start of each wheel so far, found by a search, on the mesh of `finder`.
    located, has = cycle.located, rough.copy()
    coarse = outcome == Outcome.MESH_TOO_COARSE
    best = None
    for refinement in range(1 + REFINEMENTS * adaptive):
        if refinement:
            before, finder = finder, finder.finer()
            moved = jax.vmap(functools.partial(finder.on_mesh, before.problem))
            located = in_batches(moved, SHAPES, located)
        # The search without walks has used this mesh already. One finer mesh is always tried.
        promising = walks.reached | has | (coarse & (refinement > 0)) | (refinement == 1)
        places = np.flatnonzero(open_ & promising)
        if not len(places):
            continue
        some, own = _taken(params, places), _Walks(*(part[places] for part in walks))
        begin = _begun(finder, some, _taken(located, places), has[places], own)
        again = in_batches(finder.cycles, SHAPES, some, begin)
        gait, error = np.asarray(again.found), np.asarray(again.mesh_error)
        located = _put(located, places[gait], _taken(again.located, gait))
        if gait.any():
            best = finder, located
        has[places[gait]] = True
        coarse[places] = np.asarray(again.outcome) == Outcome.MESH_TOO_COARSE
        open_[places[gait & ((error <= MESH_ERROR) | (not adaptive))]] = False
    return best


def reached(finder: Any, params: WheelParams, searched: LimitCycle) -> LimitCycle:
    """Return the search's result, with cycles from walks where the search found none, on the same
    mesh."""
    found = _reached(finder, params, searched, adaptive=False)
    if found is None:
        return searched
    cycle: LimitCycle = in_batches(finder.cycles, SHAPES, params, found[1])
    return cycle


def _state(guess: Any) -> Any:
    """Return the section state of a guess, which is a cycle, a `CollocationState` or a section
    state."""
    if isinstance(guess, Located):
        return guess.ends[-1][jnp.array([0, 2, 3])]
    return getattr(guess, "section_state", guess)


def _from_another_step(
    finder: CollocationFinder, params: WheelParams, cycle: LimitCycle, x: np.ndarray
) -> tuple[CollocationFinder, Located] | None:
    """Search for the same orbit with another of its steps as the first one.

    A guess contains the accelerations of all steps, whose errors accumulate. A step without double
    support is the most sensitive. As the first or last step it may make the guess fail.
    """
    lost = np.flatnonzero(np.isin(np.asarray(cycle.outcome), LOST))
    if not len(lost):
        return None
    some, x, best = _taken(params, lost), np.array(x[lost]), None
    located = cycle.located
    for _ in range(1, finder.period_n):
        x = np.asarray(steps(some, x, model=finder.model).section_state)
        found = in_batches(finder.cycles, SHAPES, some, x)
        gait = np.flatnonzero(np.asarray(found.found) & (np.asarray(located.found)[lost] < 0.5))
        if len(gait):
            located = _put(located, lost[gait], _taken(found.located, gait))
            best = finder, located
    return best


def _counted_as(
    finder: CollocationFinder,
    params: WheelParams,
    cycle: LimitCycle,
    x: np.ndarray,
    reached: tuple[CollocationFinder, Located] | None,
) -> tuple[CollocationFinder, Located] | None:
    """Return the same orbits with the step nearest to `first_states` as the first one."""
    finder, located = reached or (finder, cycle.located)
    ends = np.asarray(located.ends)[:, :, [0, 2, 3]]
    missed = np.abs(np.roll(ends, 1, axis=1) - x[:, None]).max(-1)
    missed = np.where(np.asarray(located.found)[:, None] > 0.5, missed, 0.0)
    for step in range(1, finder.period_n):
        lanes = np.flatnonzero(np.argmin(missed, 1) == step)
        if len(lanes):
            again = jax.vmap(functools.partial(finder.counted_from, step))
            located = _put(located, lanes, again(_taken(params, lanes), _taken(located, lanes)))
            reached = finder, located
    return reached

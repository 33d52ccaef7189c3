"""Starts of branches by model: gaits to continue, and their wheels."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.branches.followed import (
    AbstractFollowedWheel,
    CycleFollowed,
    GroundFollowed,
    RungFollowed,
    Wheel,
)
from vrw_jax.branches.run import MakeCycle
from vrw_jax.cycles import CycleOptions, LimitCycle, finder_of, on_mesh
from vrw_jax.gaits import limit_cycles
from vrw_jax.models import AbstractWheel
from vrw_jax.numerics import Options, PathPoint
from vrw_jax.walks import walk_towards
from vrw_jax.wheel import WheelParams


class Wanted(NamedTuple):
    """Request for branches of a batch of wheels."""

    params: WheelParams  # one leading axis
    model: AbstractWheel
    name: str  # of the parameter
    p: Array  # at the starts of the branches
    period_n: int
    cycle_options: CycleOptions | None
    step_options: Options


class Start(NamedTuple):
    """Data that a continuation needs to start."""

    followed: AbstractFollowedWheel
    wheels: Wheel
    z: Any
    outcomes: np.ndarray  # of the first gaits
    make_cycle: MakeCycle
    cycle: Any = None  # the gaits themselves
    finer: CycleOptions | None = None  # options with a finer mesh, None without a mesh


def start_by_collocation(wanted: Wanted, cycle: Any) -> Start:
    """Return starts from limit cycles by collocation, given or found."""
    params, name, period_n = wanted.params, wanted.name, wanted.period_n
    options = CycleOptions.tight() if wanted.cycle_options is None else wanted.cycle_options
    # The start does not need the mesh or the accuracy of the branch.
    start = cycle
    if start is None:
        start = limit_cycles(params, period_n=period_n, model=wanted.model)
    if not isinstance(start, LimitCycle):
        raise TypeError(
            f"cycle is a {type(start).__name__}, but the paper's branch starts from a "
            "LimitCycle: give vrw.limit_cycle(params)."
        )
    finder: Any = finder_of(wanted.model, params.n_legs, period_n=period_n, cycle_options=options)
    problem = finder.problem

    def make_cycle(owner: int, point: PathPoint) -> Callable[[], LimitCycle]:
        def find() -> LimitCycle:
            guess = jax.tree.map(lambda x: x[owner], start)
            located = guess.located._replace(solution=jax.tree.map(jnp.asarray, point.z))
            guess = dataclasses.replace(guess, located=located, problem=problem)
            wheel = jax.tree.map(lambda x: x[owner], params)
            _, wheel = wanted.model.moved(wheel, name, jnp.asarray(point.p))
            return finder.cycle(wheel, guess)

        return find

    return Start(
        CycleFollowed(problem=problem, name=name, more=None),
        Wheel(params, start.located.happens),
        jax.vmap(lambda found: on_mesh(start.problem, problem, found))(start.located.solution),
        np.asarray(start.outcome),
        make_cycle,
        start,
        options.finer(),
    )


def start_by_walking(wanted: Wanted, cycle: Any) -> Start:
    """Return starts from fixed points of the model's step, given or at the ends of walks."""
    params, model, options = wanted.params, wanted.model, wanted.step_options

    def towards(params: WheelParams, p: Array) -> tuple[Array, Array]:
        ground, wheel = model.moved(params, wanted.name, p)
        walked = walk_towards(ground, wheel, options)
        return walked.outcome, walked.steps.section_state[-1]

    if cycle is None:
        outcomes, z = jax.vmap(towards)(params, wanted.p)
    else:
        outcomes, z = cycle.outcome, cycle.section_state
    followed = RungFollowed(
        model=model,
        options=options,
        name=wanted.name,
        period_n=wanted.period_n,
        numbers=model.section_numbers(params),
    )
    happens = jnp.ones((*wanted.p.shape, 1, 1), wanted.p.dtype)
    return Start(
        followed, Wheel(params, happens), z, np.asarray(outcomes), lambda owner, point: None
    )


def start_by_lanes(wanted: Wanted, cycle: Any) -> Start:
    """Return starts from gaits with unilateral contact, given or the slowest attracting one."""
    params, options = wanted.params, wanted.step_options
    model: Any = wanted.model
    finder: Any = finder_of(model, params.n_legs, step_options=options, period_n=wanted.period_n)
    if not finder.coexisting:  # no batched engine: use the step
        return start_by_walking(wanted, cycle)
    wheels = Wheel(params, jnp.ones((*wanted.p.shape, 1, 1), wanted.p.dtype))
    followed = GroundFollowed(
        model=model,
        options=options,
        name=wanted.name,
        period_n=wanted.period_n,
        n_legs=params.n_legs,
    )
    values = followed.values(wheels, wanted.p)
    if cycle is None:
        cycle = finder.near(values, finder.first_guesses(values))

    outcomes = np.asarray(cycle.outcome)
    return Start(followed, wheels, cycle.section_state, outcomes, lambda owner, point: None)


STARTS: dict[str, Callable[[Wanted, Any], Start]] = {
    "viscoelastic": start_by_collocation,
    "unilateral": start_by_lanes,
}
"""Start functions by name of the model; all other models use `start_from_walks`."""

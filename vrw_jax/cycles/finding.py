"""Selection of the finder for a model, and checks of the arguments for a search."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles.by_collocation import CollocationFinder
from vrw_jax.cycles.by_walking import SectionFinder, WalkedCycle
from vrw_jax.cycles.collocated import LimitCycle
from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.finder import AbstractGaitFinder
from vrw_jax.cycles.on_ground import GroundFinder
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.search import Located
from vrw_jax.numerics import Options
from vrw_jax.walks import ModelLike, one_wheel, options_of, rung_of, state_of
from vrw_jax.wheel import WheelParams
from vrw_jax.wording import instance, listed, traced

Guess = LimitCycle | WalkedCycle | Array | np.ndarray | Sequence[float]
"""A neighbor's cycle, or a section state near the wanted gait."""

FINDERS: dict[str, type[AbstractGaitFinder]] = {
    "viscoelastic": CollocationFinder, "unilateral": GroundFinder
}  # fmt: skip
"""Finder class by name of the model; all other models use `ReturnMapFinder`."""


def finder_of(
    model: ModelLike | None,
    n_legs: int,
    *,
    period_n: int = 1,
    cycle_options: CycleOptions | None = None,
    step_options: Options | None = None,
) -> AbstractGaitFinder:
    """Return the finder that finds, checks and differentiates gaits of this model."""
    if cycle_options is not None:
        instance("cycle_options", cycle_options, CycleOptions, "give vrw.CycleOptions()")
    rung = rung_of(model)
    make = FINDERS.get(rung.rung, SectionFinder).of
    return make(rung, n_legs, options_of(step_options), period_n,
                CycleOptions() if cycle_options is None else cycle_options)  # fmt: skip


def serving(params: WheelParams, model: ModelLike | None) -> ModelLike | None:
    """Return the model of this wheel's gait: for the ladder, the lowest model whose margins are
    met.

    The paper's gait is tried first. If it is not found or violates a margin on this ground, the
    upper model is returned. Any other model is returned unchanged. The ladder is returned unchanged
    if the parameters have no values.
    """
    return serving_and_why(params, model)[0]


def serving_and_why(
    params: WheelParams, model: ModelLike | None
) -> tuple[ModelLike | None, str | None]:
    """Return `resolve_model` and, for the ladder, the reason in one sentence."""
    ladder: Any = rung_of(model)
    if ladder.upper is ladder or not isinstance(params, WheelParams):
        return model, None
    if traced(params, model) or params.damping.ndim:
        return model, None
    cycle: Any = finder_of(None, params.n_legs).cycle(params)
    if not bool(cycle.found):
        return ladder.upper, f"The paper's wheel has no gait: {cycle.why}"
    x = ladder.full_section(params, cycle.section_state)
    choice = ladder.choose(params, x, Options())[0]
    return choice.model, choice.why


def near(guess: Any) -> Any:
    """Return a user's guess: a cycle, a `CollocationState` or a finite section state.

    Raises: ValueError: the section state is not finite.
    """
    if guess is None or isinstance(guess, AbstractCycle | Located):
        return guess
    state = state_of(guess, "guess")
    if not traced(state) and not np.isfinite(state).all():
        raise ValueError(
            f"guess is {listed(state)}, but a search can begin at finite numbers only: give a "
            "neighbour's cycle, or a section state near the gait."
        )
    return state


def finder_for(
    params: WheelParams,
    model: ModelLike | None,
    options: CycleOptions | Options | None,
    period_n: int = 1,
) -> AbstractGaitFinder:
    """Return the finder for these options, after checks of the arguments.

    Raises: TypeError, ValueError: the arguments do not fit the model.
    """
    one_wheel(params, "map over batches with jax.vmap, in_axes=(params.in_axes,), or use vrw.scan")
    if options is not None:
        instance("options", options, (CycleOptions, Options), "give vrw.CycleOptions()")
    of_cycle = isinstance(options, CycleOptions)
    finder = finder_of(
        model,
        params.n_legs,
        period_n=period_n,
        cycle_options=options if of_cycle else None,  # type: ignore[arg-type]
        step_options=None if of_cycle else options,  # type: ignore[arg-type]
    )
    if options is not None and not isinstance(options, finder.options_type):
        if of_cycle:
            raise TypeError(
                f"options is a CycleOptions, but {type(finder.model).__name__} is solved on its "
                "return map: give the vrw.Options of its step."
            )
        raise TypeError(
            "options is an Options, but the paper's wheel is solved by collocation: "
            "give vrw.CycleOptions(), or CycleOptions.tight()."
        )
    finder.options_used.require_reachable(jnp.result_type(*jax.tree.leaves(params)))
    return finder

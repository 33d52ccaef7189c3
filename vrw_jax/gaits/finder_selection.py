"""Select the gait finder for a model, and check the arguments of a search."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import check_int, check_type, has_traced_leaf
from vrw_jax.base.options import StepOptions
from vrw_jax.base.printing import format_numbers
from vrw_jax.base.walker import is_own_walker
from vrw_jax.gaits.collocation_finder import CollocationFinder, KinkedGaitFinder
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.finder import AbstractGaitFinder
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.phase_sequence import CollocationState
from vrw_jax.gaits.return_map_finder import ReturnMapCycle, ReturnMapFinder
from vrw_jax.gaits.unilateral_finder import UnilateralFinder
from vrw_jax.gaits.walker_finder import (
    convert_gait_guess,
    is_known_missing,
    make_walker_finder,
)
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_section_state,
    convert_step_options,
    require_single_wheel,
)

UserCycleGuess = LimitCycle | ReturnMapCycle | Array | np.ndarray | Sequence[float]
"""Guess that a user provides: a similar wheel's cycle, or a section state near the gait."""


def make_finder(
    model: ModelLike | None,
    n_legs: int,
    *,
    period_n: int = 1,
    cycle_options: CycleOptions | None = None,
    step_options: StepOptions | None = None,
) -> AbstractGaitFinder:
    """Return the gait finder for a model."""
    if cycle_options is not None:
        check_type("cycle_options", cycle_options, CycleOptions, "give vrw.CycleOptions()")
    resolved_model = convert_model_argument(model)
    if period_n % resolved_model.leg_period:
        raise ValueError(
            f"period_n is {period_n}, but the legs alternate, so that a gait repeats after an even "
            "number of steps: give period_n=2 where there is such an argument, or one law for all "
            "legs."
        )
    kernel = resolved_model.batch_kernel
    finder_class: Any = UnilateralFinder if kernel == "legs" else ReturnMapFinder
    search_options = {}
    if kernel == "phases":
        finder_class = CollocationFinder
        default_options = CycleOptions()
        if resolved_model.own_parameters is not None:
            # With a user's law, the fast mode of the airborne leg may decay at a varying rate. The
            # default mesh then has errors of 3e-9.
            default_options = default_options.refine_mesh()
        search_options = {"cycle_options": cycle_options or default_options}
        if resolved_model.has_kinks:
            finder_class = KinkedGaitFinder
    return finder_class(
        model=resolved_model,
        n_legs=n_legs,
        step_options=convert_step_options(step_options),
        period_n=period_n,
        **search_options,
    )


def check_cycle_guess(cycle_guess: Any) -> Any:
    """Convert a user's guess to a cycle, a `CollocationState` or a finite section state.

    A cycle that was not found is no guess.
    Raise ValueError if the section state is not finite.
    """
    cycle_guess = convert_gait_guess(cycle_guess)
    if isinstance(cycle_guess, AbstractCycle):
        return None if is_known_missing(cycle_guess.outcome) else cycle_guess
    if cycle_guess is None or isinstance(cycle_guess, CollocationState):
        return cycle_guess
    section_state = convert_section_state(cycle_guess, "guess")
    if not has_traced_leaf(section_state) and not np.isfinite(section_state).all():
        raise ValueError(
            f"guess is {format_numbers(section_state)}, but a search can begin at finite numbers "
            "only: give a neighbour's cycle, or a section state near the gait."
        )
    return section_state


def resolve_finder(
    params: Any,
    model: ModelLike | None,
    options: CycleOptions | StepOptions | None,
    period_n: int = 1,
    guess: Any = None,
) -> AbstractGaitFinder:
    """Check the arguments of a search, and return the gait finder for a model and options.

    Raise TypeError or ValueError if the arguments do not fit the model.
    """
    if is_own_walker(model):
        step_options: Any = options
        return make_walker_finder(
            model, params, convert_step_options(step_options), guess, period_n
        )
    require_single_wheel(
        params, "map over batches with jax.vmap, in_axes=(params.in_axes,), or use vrw.scan"
    )
    if options is not None:
        check_type("options", options, (CycleOptions, StepOptions), "give vrw.CycleOptions()")
    has_cycle_options = isinstance(options, CycleOptions)
    gait_finder = make_finder(
        model,
        params.n_legs,
        period_n=check_int("period_n", period_n),
        cycle_options=options if has_cycle_options else None,  # type: ignore[arg-type]
        step_options=None if has_cycle_options else options,  # type: ignore[arg-type]
    )
    if options is not None and not isinstance(options, gait_finder.options_type):
        if has_cycle_options:
            raise TypeError(
                f"options is a CycleOptions, but {type(gait_finder.model).__name__} is solved on "
                "its return map: give the vrw.StepOptions of its step."
            )
        raise TypeError(
            "options is a StepOptions, but the paper's wheel is solved by collocation: "
            "give vrw.CycleOptions(), or CycleOptions.tight()."
        )
    gait_finder.search_options.check_tolerances(jnp.result_type(*jax.tree.leaves(params)))
    return gait_finder

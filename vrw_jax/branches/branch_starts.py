"""Starts of branches for each model: the gaits from which branches are continued, and their
wheels.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.branches.branch_location import CycleFactory
from vrw_jax.branches.continuation_problems import (
    AbstractGaitProblem,
    BranchWheel,
    CollocationProblem,
    GroundProblem,
    ReturnMapProblem,
)
from vrw_jax.collocation import CollocationSolution
from vrw_jax.continuation import ContinuationPoint
from vrw_jax.cycles import (
    CycleOptions,
    LimitCycle,
    limit_cycles,
    make_finder,
    transfer_solution_to_mesh,
)
from vrw_jax.models import AbstractWheel, GaitMethod
from vrw_jax.numerics import StepOptions, take_rows
from vrw_jax.simulation import walk_toward_gait
from vrw_jax.wheel import WheelParams


class BranchRequest(NamedTuple):
    """Request for branches of a batch of wheels."""

    params: WheelParams  # parameters with one leading axis over wheels
    model: AbstractWheel
    parameter_name: str  # name of the continued parameter
    parameter_values: Array  # values of this parameter at the starts of the branches
    period_n: int
    cycle_options: CycleOptions | None
    step_options: StepOptions
    reads_force_peaks: bool = False  # whether its points have the measures of the gait's force


class BranchStart(NamedTuple):
    """Data from which a continuation starts."""

    problem: AbstractGaitProblem
    wheels: BranchWheel
    unknowns: Any
    outcomes: np.ndarray  # outcomes of the first gaits
    make_cycle: CycleFactory
    cycle: Any = None  # the first gaits
    # options with a finer mesh; None for a problem without a mesh
    finer_options: CycleOptions | None = None


@dataclasses.dataclass(frozen=True)
class FindLimitCycle:
    """Function without arguments that finds the gait at a special point; it can be pickled.

    - `finder`, `model`: finder and model of the branch;
    - `name`: name of the continued parameter;
    - `wheel`, `guess`: the wheel, and its gait at the start of the branch;
    - `z`, `p`: solution and value of the parameter beside the special point.
    """

    finder: Any
    model: AbstractWheel
    name: str
    wheel: WheelParams
    guess: LimitCycle
    z: CollocationSolution
    p: Any

    def __call__(self) -> LimitCycle:
        """Return the gait at the special point."""
        wheel, guess = jax.device_put((self.wheel, self.guess))
        collocation_state = guess.collocation_state._replace(
            solution=jax.tree.map(jnp.asarray, self.z)
        )
        guess = dataclasses.replace(
            guess, collocation_state=collocation_state, system=self.finder.system
        )
        _, wheel = self.model.with_parameter(wheel, self.name, jnp.asarray(self.p))
        cycle: LimitCycle = self.finder.find_cycle(wheel, guess)
        return cycle


def start_from_collocation(request: BranchRequest, cycle: Any) -> BranchStart:
    """Return the starts of branches from limit cycles by collocation, given or found."""
    params, name, period_n = request.params, request.parameter_name, request.period_n
    options = CycleOptions.tight() if request.cycle_options is None else request.cycle_options
    # The start does not need the mesh or the accuracy of the branch.
    start_cycle = cycle
    if start_cycle is None:
        start_cycle = limit_cycles(params, period_n=period_n, model=request.model)
    if not isinstance(start_cycle, LimitCycle):
        raise TypeError(
            f"cycle is a {type(start_cycle).__name__}, but the paper's branch starts from a "
            "LimitCycle: give vrw.limit_cycle(params)."
        )
    finder: Any = make_finder(
        request.model, params.n_legs, period_n=period_n, cycle_options=options
    )
    system = finder.system

    def make_cycle(wheel_index: int, point: ContinuationPoint) -> FindLimitCycle:
        guess, wheel = take_rows((start_cycle, params), wheel_index)
        return FindLimitCycle(finder, request.model, name, wheel, guess, point.z, point.p)

    return BranchStart(
        CollocationProblem(
            system=system,
            parameter_name=name,
            additional_quantities=None,
            reads_force_peaks=request.reads_force_peaks,
        ),
        BranchWheel(params, start_cycle.collocation_state.is_phase_active),
        jax.vmap(lambda solution: transfer_solution_to_mesh(start_cycle.system, system, solution))(
            start_cycle.collocation_state.solution
        ),
        np.asarray(start_cycle.outcome),
        make_cycle,
        start_cycle,
        options.refine_mesh(),
    )


def start_from_walks(request: BranchRequest, cycle: Any) -> BranchStart:
    """Return the starts of branches from fixed points of the model's step, given or at the ends
    of walks.
    """
    params, model, options = request.params, request.model, request.step_options

    def walk_to_gait(params: WheelParams, p: Array) -> tuple[Array, Array]:
        model_at_p, wheel = model.with_parameter(params, request.parameter_name, p)
        walk = walk_toward_gait(model_at_p, wheel, options)
        return walk.outcome, walk.steps.section_state[-1]

    if cycle is None:
        outcomes, section_states = jax.vmap(walk_to_gait)(params, request.parameter_values)
    else:
        outcomes, section_states = cycle.outcome, cycle.section_state
    problem = ReturnMapProblem(
        model=model,
        options=options,
        parameter_name=request.parameter_name,
        period_n=request.period_n,
        n_coordinates=model.n_continuous(params),
    )
    phase_active = jnp.ones((*request.parameter_values.shape, 1, 1), request.parameter_values.dtype)
    return BranchStart(
        problem,
        BranchWheel(params, phase_active),
        section_states,
        np.asarray(outcomes),
        lambda wheel_index, point: None,
    )


def start_from_unilateral_gaits(request: BranchRequest, cycle: Any) -> BranchStart:
    """Return the starts of branches from gaits with unilateral contact, given or the slowest
    attracting gait.
    """
    params, options = request.params, request.step_options
    model: Any = request.model
    finder: Any = make_finder(model, params.n_legs, step_options=options, period_n=request.period_n)
    if not finder.is_multistable:  # This model has no batched engine.
        return start_from_walks(request, cycle)
    wheels = BranchWheel(
        params, jnp.ones((*request.parameter_values.shape, 1, 1), request.parameter_values.dtype)
    )
    problem = GroundProblem(
        model=model,
        options=options,
        parameter_name=request.parameter_name,
        period_n=request.period_n,
        n_coordinates=model.n_continuous(params),
        n_legs=params.n_legs,
    )
    values = problem.parameter_values(wheels, request.parameter_values)
    if cycle is None:
        cycle = finder.find_cycles_near(values, finder.make_initial_guesses(values))

    outcomes = np.asarray(cycle.outcome)
    return BranchStart(
        problem, wheels, cycle.section_state, outcomes, lambda wheel_index, point: None
    )


START_FUNCTIONS: dict[GaitMethod, Callable[[BranchRequest, Any], BranchStart]] = {
    GaitMethod.COLLOCATION: start_from_collocation,
    GaitMethod.CONTACT_WALKS: start_from_unilateral_gaits,
    GaitMethod.RETURN_MAP: start_from_walks,
    GaitMethod.SELECTION: start_from_walks,
}
"""Functions that return the starts of branches, by gait method."""

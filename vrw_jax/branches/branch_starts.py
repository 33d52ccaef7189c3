"""Find the first gaits of branches, and define the equations of their continuation, for
each model.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.options import StepOptions
from vrw_jax.branches.arclength import ContinuationPoint
from vrw_jax.branches.branch_location import CycleFinderFactory
from vrw_jax.branches.continuation_problems import (
    AbstractGaitProblem,
    BranchWheel,
    CollocationProblem,
    ContactGaitProblem,
    ReturnMapProblem,
)
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.gait_search import limit_cycles
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.options import CycleOptions
from vrw_jax.gaits.phase_collocation import CollocationSolution
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.stepping import start_walk_toward_gait
from vrw_jax.wheel.params import WheelParams


class BranchRequest(NamedTuple):
    """Arguments for the continuation of the gaits of several wheels in one parameter."""

    params: WheelParams  # with one leading axis over wheels
    model: AbstractWheel
    parameter_name: str  # name of the continued parameter
    parameter_values: Array  # values of the continued parameter at the starts
    period_n: int
    cycle_options: CycleOptions | None
    step_options: StepOptions
    measures_force_peaks: bool = False  # whether points have the measures of the gait's force

    def describe_problem(self) -> dict[str, Any]:
        """Return the fields of an `AbstractGaitProblem`."""
        return {
            "model": self.model,
            "step_options": self.step_options,
            "n_legs": self.params.n_legs,
            "parameter_name": self.parameter_name,
            "period_n": self.period_n,
            "measures_force_peaks": self.measures_force_peaks,
        }

    def make_wheels(self, is_phase_active: Any = ()) -> BranchWheel:
        """Return the wheels with the parameters as rows of numbers."""
        values = self.model.collect_batch_parameter_values(self.params)
        return BranchWheel(values, is_phase_active)


class BranchStart(NamedTuple):
    """First gaits of branches, and the wheels and equations of the continuation."""

    continuation_problem: AbstractGaitProblem
    wheels: BranchWheel
    start_unknowns: Any
    start_outcomes: np.ndarray  # outcomes of the first gaits
    make_cycle_finder: CycleFinderFactory | None = None  # None if no finder is known
    start_cycles: Any = None  # the first gaits
    # None for a problem without a mesh
    finer_cycle_options: CycleOptions | None = None


def find_special_cycle(
    gait_finder: Any,
    parameter_name: str,
    start_params: WheelParams,
    start_cycle: LimitCycle,
    solution: CollocationSolution,
    p: float,
) -> LimitCycle:
    """Find the limit cycle at a special point, from the collocation solution at the point next to
    it.

    - `gait_finder`: finder of the branch's gaits;
    - `parameter_name`: name of the continued parameter;
    - `start_params`, `start_cycle`: wheel and gait at the start of the branch.
    """
    params, guess_cycle, solution, p = jax.device_put((start_params, start_cycle, solution, p))
    guess_cycle = dataclasses.replace(
        guess_cycle,
        collocation_state=guess_cycle.collocation_state._replace(solution=solution),
        system=gait_finder.collocation_system,
    )
    _, params = gait_finder.model.with_parameter(params, parameter_name, p)
    return gait_finder.find_cycle(params, guess_cycle)


def find_collocation_starts(branch_request: BranchRequest, known_start_cycle: Any) -> BranchStart:
    """Return the starts of branches that are continued by collocation.

    If `known_start_cycle` is None, the limit cycles at the starts are searched for. Without cycle
    options, the mesh of the branch is not coarser than that of the limit cycles.
    """
    params, parameter_name, period_n = (
        branch_request.params,
        branch_request.parameter_name,
        branch_request.period_n,
    )
    # The start may have a coarser mesh and larger errors than the branch.
    start_cycle = known_start_cycle
    if start_cycle is None:
        start_cycle = limit_cycles(params, period_n=period_n, model=branch_request.model)
    if not isinstance(start_cycle, LimitCycle):
        raise TypeError(
            f"cycle is a {type(start_cycle).__name__}, but the paper's branch starts from a "
            "LimitCycle: give vrw.limit_cycle(params)."
        )
    cycle_options = branch_request.cycle_options
    if cycle_options is None:
        cycle_options = CycleOptions.tight()
        n_dls_intervals, n_sls1_intervals, n_sls2_intervals = map(
            max, cycle_options.mesh_intervals, start_cycle.system.cycle_options.mesh_intervals
        )
        cycle_options = dataclasses.replace(
            cycle_options, mesh_intervals=(n_dls_intervals, n_sls1_intervals, n_sls2_intervals)
        )
    gait_finder: Any = make_finder(
        branch_request.model, params.n_legs, period_n=period_n, cycle_options=cycle_options
    )
    system = gait_finder.collocation_system
    transfer_to_mesh = lambda x: transfer_solution_to_mesh(start_cycle.system, system, x)
    solution = jax.vmap(transfer_to_mesh)(start_cycle.collocation_state.solution)
    problem = CollocationProblem(
        **branch_request.describe_problem(),
        collocation_system=system,
        shapes=tuple(x.shape[1:] for x in jax.tree.leaves(solution)),
    )

    def make_cycle_finder(
        wheel_index: int, branch_point: ContinuationPoint
    ) -> Callable[[], LimitCycle]:
        wheel, cycle = select_tree_rows((params, start_cycle), wheel_index)
        # A partial call can be pickled.
        return functools.partial(
            find_special_cycle,
            gait_finder,
            parameter_name,
            wheel,
            cycle,
            problem.unpack(branch_point.z),
            float(branch_point.p),
        )

    return BranchStart(
        problem,
        branch_request.make_wheels(np.asarray(start_cycle.collocation_state.is_phase_active)),
        problem.pack(solution),
        np.asarray(start_cycle.outcome),
        make_cycle_finder,
        start_cycle,
        cycle_options.refine_mesh(),
    )


def find_return_map_starts(branch_request: BranchRequest, known_start_cycle: Any) -> BranchStart:
    """Return the starts of branches that are continued as fixed points of a model's return map.

    If `known_start_cycle` is None, the fixed points are searched for, starting from the last states
    of walks.
    """
    params, model, step_options = (
        branch_request.params,
        branch_request.model,
        branch_request.step_options,
    )

    def walk_to_gait(params: WheelParams, p: Array) -> tuple[Array, Array]:
        model_at_p, params_at_p = model.with_parameter(params, branch_request.parameter_name, p)
        walk_result = start_walk_toward_gait(model_at_p, params_at_p, step_options)
        return walk_result.outcome, walk_result.steps.section_state[-1]

    if known_start_cycle is None:
        outcomes, section_states = jax.vmap(walk_to_gait)(params, branch_request.parameter_values)
    else:
        outcomes, section_states = known_start_cycle.outcome, known_start_cycle.section_state
    problem = ReturnMapProblem(
        **branch_request.describe_problem(),
        n_coordinates=model.count_continuous_section_entries(params),
    )
    return BranchStart(
        problem, branch_request.make_wheels(), np.asarray(section_states), np.asarray(outcomes)
    )


def find_branch_starts(branch_request: BranchRequest, start_cycle: Any) -> BranchStart:
    """Return the starts of branches of any model.

    If no start gaits are given, each branch with unilateral contact starts from the slowest
    attracting gait.
    """
    params, step_options = branch_request.params, branch_request.step_options
    model: Any = branch_request.model
    gait_finder: Any = make_finder(
        model, params.n_legs, step_options=step_options, period_n=branch_request.period_n
    )
    if gait_finder.supports_cold_start:
        return find_collocation_starts(branch_request, start_cycle)
    if not gait_finder.is_multistable:  # The model has no batched engine.
        return find_return_map_starts(branch_request, start_cycle)
    wheels = branch_request.make_wheels()
    problem = ContactGaitProblem(
        **branch_request.describe_problem(),
        n_coordinates=model.count_continuous_section_entries(params),
    )
    if start_cycle is None:
        values = problem.replace_parameter(wheels, branch_request.parameter_values)
        start_cycle = gait_finder.find_cycles_near(
            values, gait_finder.make_initial_guesses(jnp.asarray(values))
        )
    return BranchStart(
        problem, wheels, np.asarray(start_cycle.section_state), np.asarray(start_cycle.outcome)
    )

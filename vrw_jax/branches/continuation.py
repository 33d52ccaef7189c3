"""Continue branches of stable and unstable gaits in one parameter, with all their special points.

A special point is a bifurcation or a border collision. At a border collision an indicator or a
margin vanishes. During the search for a special point, the gait is computed anew at every trial.
Special points are therefore as accurate as the gaits.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.base.checks import (
    check_bool,
    check_int,
    check_range,
    check_type,
    require_untraced_arguments,
)
from vrw_jax.base.options import StepOptions
from vrw_jax.base.progress import announce_wait
from vrw_jax.base.results import Measure, Outcome, find_own_measures, select_measures
from vrw_jax.base.walker import is_own_walker
from vrw_jax.branches.arclength import ArclengthOptions
from vrw_jax.branches.branch import Branch, SpecialPoint
from vrw_jax.branches.branch_continuation import Continuation
from vrw_jax.branches.branch_location import BranchData, continue_and_locate_special_points
from vrw_jax.branches.continuation_problems import (
    AbstractGaitProblem,
    BranchWheel,
    CollocationProblem,
    ContactGaitProblem,
    ReturnMapProblem,
)
from vrw_jax.branches.map_branch import (
    check_arclength_options,
    continue_walker_branch,
    make_branch,
    parse_switch_point,
)
from vrw_jax.gaits.cycle import AbstractCycle, CycleOptions
from vrw_jax.gaits.gait_search import limit_cycles, make_finder, resolve_model
from vrw_jax.gaits.gauss import CollocationSolution
from vrw_jax.gaits.limit_cycle_result import LimitCycle, transfer_solution_to_mesh
from vrw_jax.gaits.wheel_finders import ReturnMapCycle
from vrw_jax.lanes.batching import select_rows_on_device
from vrw_jax.models.ladder import collect_provenance_attributes
from vrw_jax.models.measures import FORCE_PEAK_MEASURES, MEASURES
from vrw_jax.models.stepping import (
    ModelLike,
    convert_model_argument,
    convert_step_options,
    require_single_wheel,
    start_walk_toward_gait,
)
from vrw_jax.wheel.params import FRICTION_NAME, WheelParams, check_parameter_name


class BranchStart(NamedTuple):
    """First gaits of branches, and the wheels and equations of the continuation."""

    problem: AbstractGaitProblem
    wheels: BranchWheel
    z: np.ndarray
    outcomes: np.ndarray  # outcomes of the first gaits
    cycles: Any = None  # the first gaits
    # None for a problem without a mesh
    finer_cycle_options: CycleOptions | None = None


def find_branch_starts(
    params: WheelParams,
    parameter_values: Array,
    cycle: Any,
    cycle_options: CycleOptions | None,
    problem_fields: Mapping[str, Any],
) -> BranchStart:
    """Return the starts of branches of any model.

    If no start gaits are given, each branch with unilateral contact starts from the slowest
    attracting gait, and that of another return map from the last state of a walk.

    - `params`: wheels with one leading axis;
    - `parameter_values`: values of the continued parameter at the starts;
    - `problem_fields`: fields of an `AbstractGaitProblem`.
    """
    model, n_legs, step_options = (
        problem_fields[name] for name in ("model", "n_legs", "step_options")
    )
    gait_finder: Any = make_finder(
        model, n_legs, step_options=step_options, period_n=problem_fields["period_n"]
    )
    if gait_finder.supports_cold_start:
        return _find_collocation_starts(params, cycle, cycle_options, problem_fields)
    wheels = BranchWheel(model.collect_batch_parameter_values(params))
    problem_class = ContactGaitProblem if gait_finder.is_multistable else ReturnMapProblem
    units = (1.0,) * model.count_continuous_section_entries(params)
    problem = problem_class(units, **problem_fields)
    (name,) = problem.continued_names

    def walk_to_gait(params: WheelParams, p: Array) -> tuple[Array, Array]:
        model_at_p, params = model.with_parameter(params, name, p)
        walk = start_walk_toward_gait(model_at_p, params, step_options)
        return walk.steps.section_state[-1], walk.outcome

    if cycle is None and gait_finder.is_multistable:
        values = problem.replace_parameters(wheels, parameter_values)
        cycle = gait_finder.find_cycles_near(
            values, gait_finder.make_initial_guesses(jnp.asarray(values))
        )
    if cycle is None:
        z, outcomes = jax.vmap(walk_to_gait)(params, parameter_values)
    else:
        z, outcomes = cycle.section_state, cycle.outcome
    return BranchStart(problem, wheels, np.asarray(z), np.asarray(outcomes))


def _find_collocation_starts(
    params: WheelParams,
    cycle: Any,
    cycle_options: CycleOptions | None,
    problem_fields: Mapping[str, Any],
) -> BranchStart:
    """Return the starts of branches that are continued by collocation.

    If `cycle` is None, the limit cycles at the starts are searched for. Without cycle options, the
    mesh of the branch is not coarser than that of the limit cycles.
    """
    model, period_n = problem_fields["model"], problem_fields["period_n"]
    if cycle is None:
        cycle = limit_cycles(params, period_n=period_n, model=model)
    if not isinstance(cycle, LimitCycle):
        raise TypeError(
            f"cycle is a {type(cycle).__name__}, but the paper's branch starts from a "
            "LimitCycle: give vrw.limit_cycle(params)."
        )
    if cycle_options is None:
        # The start may have a coarser mesh and larger errors than the branch.
        tight = CycleOptions.tight()
        meshes = tight.mesh_intervals, cycle.system.cycle_options.mesh_intervals
        n_dls_intervals, n_sls1_intervals, n_sls2_intervals = map(max, *meshes)
        cycle_options = dataclasses.replace(
            tight, mesh_intervals=(n_dls_intervals, n_sls1_intervals, n_sls2_intervals)
        )
    gait_finder: Any = make_finder(
        model, params.n_legs, period_n=period_n, cycle_options=cycle_options
    )
    system = gait_finder.collocation_system
    transfer_to_mesh = functools.partial(transfer_solution_to_mesh, cycle.system, system)
    solution = jax.vmap(transfer_to_mesh)(cycle.collocation_state.solution)
    # A gait of fewer steps is repeated.
    repeat = lambda x: jnp.concatenate([x] * (period_n // x.shape[1]), 1)
    states, *by_step = solution
    solution = CollocationSolution(states, *jax.tree.map(repeat, by_step))
    problem = CollocationProblem(
        **problem_fields,
        collocation_system=system,
        shapes=tuple(x.shape[1:] for x in jax.tree.leaves(solution)),
    )
    return BranchStart(
        problem,
        BranchWheel(
            model.collect_batch_parameter_values(params),
            np.asarray(repeat(cycle.collocation_state.is_phase_active)),
        ),
        problem.pack(solution),
        np.asarray(cycle.outcome),
        cycle,
        cycle_options.refine_mesh(),
    )


DIFFERENTIATION_ADVICE = "differentiate vrw.limit_cycle"
"""Advice in the error message for a caller who differentiates a branch."""

# Largest number of mesh refinements of a gait on a branch or a curve.
MAX_BRANCH_MESH_REFINEMENTS = 3


@announce_wait("gaits, their derivatives and special points", "15 s")
def continue_branch(
    params: Any,
    name: str,
    bounds: tuple[float, float],
    *,
    cycle: Any = None,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: ArclengthOptions | None = None,
    cycle_options: CycleOptions | None = None,
    step_options: StepOptions | None = None,
    force_peaks: bool = False,
    margins: Mapping[str, Callable[[Array, Any], Array]] | None = None,
    measures: Sequence[str | Measure] = (),
    switch_at: SpecialPoint | None = None,
) -> Branch:
    """Continue the branch of limit cycles through `params` in one parameter, within `bounds`.

    The continuation starts from the limit cycle at `params`, or from `cycle`, which belongs to the
    same parameters. The branch is continued in both directions, through folds, over stable and
    unstable gaits, to the bounds or to its end. `Branch.ends` contains the reasons for both ends. A
    branch ends if the events change their order, or if the mesh is too coarse (`mesh_too_coarse`).
    Without `cycle_options` the mesh is first refined, up to eight times.

    Each special point is located to 1e-9 in the parameter. Two sign changes within one continuation
    step (`options.max_ds`) cancel and are not found. The gaits use `cycle_options`, by default at
    least `CycleOptions.tight()`. One event-driven gait step checks each gait, and determines its
    indicators and margins.

    For models other than the paper's, the gaits are fixed points of the return map, as accurate as
    `step_options`. With unilateral contact `name` may also be "friction". The start is then a
    `ReturnMapCycle` in `cycle`, or the end of a walk. If the order of contacts changes, the branch
    continues with a kink or a jump, which is a special point. The branch ends if friction equals
    tan(slope).

    Model "auto" is replaced by the model that is selected for the start. If a margin of the paper's
    model is violated, the branch has a special point with the name of the margin. Beyond this point
    unilateral contact would be selected.

    For a `HybridSystem` or another walker of yours, `params` are its parameters, `name` is that of
    one of their entries, and `cycle` is the `HybridGait` at `params`. Special points are its
    bifurcations, the changes of its sequence of events ("order_of_events_changes"), and the zeros
    of `margins`. A branch that ends where an orbit touches a guard has the zero of a margin there.

    Args:
        params: one wheel; its gait is on the branch.
        name: name of the continued parameter.
        bounds: lower and upper bound of the parameter.
        cycle: the gait at `params`, if it is known.
        period_n: number of gait steps after which the gaits repeat; with `switch_at`, that of the
            point determines it.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `ArclengthOptions` of the branch.
        cycle_options: options of the gaits.
        step_options: options of the event-driven steps that check gaits, and of the gaits of other
            models.
        force_peaks: for the paper's model and for unilateral contact, add the measures of the
            gait's force. The branch then has the special point "second_peak_rate", at which a
            second peak appears. There the first and the second time derivative of the force are
            zero at the same time. The special point "number_of_force_peaks_changes" is any other
            change of the number of peaks, such as at a landing or at the start of slip.
        margins: for a `HybridSystem`, functions of state and parameters by name, such as the
            distance to a guard. Their minima over the gait are measures of the branch.
        measures: measures of your own, see `vrw.measure`, for the dataset of the branch. For a
            walker of yours, also names of its measures.
        switch_at: a branch point or period doubling of the branch through `params`, or of one that
            was switched to. The branch that crosses there is continued to both sides, or that of
            gaits of twice its period.

    Returns:
        A `Branch`. If there is no gait from which to start, `outcome` is the reason.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0))
        >>> point = branch.special_points[-1]
        >>> print(point.name, f"{point.value:.6f}", branch.ends[1])
        lambda_4_plus 219.847688 lambda 4 plus at 219.847688 ends it.
    """
    if is_own_walker(model):
        if cycle_options is not None or force_peaks:
            raise ValueError(
                "cycle_options or force_peaks is given for a wheel, but the model is a walker of "
                "yours: give step_options=vrw.StepOptions(...), and measures= for peaks."
            )
        return continue_walker_branch(
            model, params, name, bounds, cycle, period_n, options, step_options, margins, measures,
            switch_at,
        )  # fmt: skip
    if margins:
        raise ValueError(
            "margins are for a walker of yours, but a wheel has its own margins: leave them out."
        )
    require_single_wheel(params, "use vrw.continue_branches for a batch")
    if cycle is not None:
        check_type("cycle", cycle, AbstractCycle, "give vrw.limit_cycle(params)")
    require_untraced_arguments("vrw.continue_branch", DIFFERENTIATION_ADVICE, params, cycle)
    params_batch, cycle = select_rows_on_device((params, cycle), None)
    (branch,) = continue_branches(
        params_batch, name, bounds, cycle=cycle, period_n=period_n, options=options,
        model=convert_model_argument(resolve_model(params, model)),
        cycle_options=cycle_options, step_options=step_options, force_peaks=force_peaks,
        measures=measures, switch_at=switch_at,
    )  # fmt: skip
    return branch


@announce_wait("gaits, their derivatives and special points", "15 s")
def continue_branches(
    params: WheelParams,
    name: str,
    bounds: tuple[float, float],
    *,
    cycle: LimitCycle | ReturnMapCycle | None = None,
    period_n: int = 1,
    model: Any = None,
    options: ArclengthOptions | None = None,
    cycle_options: CycleOptions | None = None,
    step_options: StepOptions | None = None,
    force_peaks: bool = False,
    measures: Sequence[str | Measure] = (),
    switch_at: SpecialPoint | None = None,
) -> tuple[Branch, ...]:
    """Continue the branches of a batch of wheels, as `continue_branch` does for one wheel.

    Every parameter has one leading axis. If a wheel has no limit cycle from which to start, its
    branch has no points, and its outcome is the reason.

    Args:
        params: the wheels; every field has the shape (wheels,).
        name: name of the continued parameter.
        bounds: lower and upper bound of the parameter.
        cycle: the gaits at `params`, if they are known.
        period_n: number of gait steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `ArclengthOptions` of the branches.
        cycle_options: options of the gaits.
        step_options: as in `continue_branch`.
        force_peaks: as in `continue_branch`.
        measures: as in `continue_branch`.
        switch_at: as in `continue_branch`, for a batch of one wheel.

    Returns:
        One `Branch` per wheel.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.

    Examples:
        >>> wheel = vrw.WheelParams(damping=np.array([205.0, 210.0]))
        >>> wheels = jax.tree.map(lambda v: jnp.broadcast_to(v, (2,)), wheel)
        >>> branches = vrw.continue_branches(wheels, "damping", (200.0, 230.0))
        >>> [round(branch.special_points[-1].value, 4) for branch in branches]
        [219.8477, 219.8477]
    """
    require_untraced_arguments("vrw.continue_branches", DIFFERENTIATION_ADVICE, params, cycle)
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    model = convert_model_argument(model)
    step_options = convert_step_options(step_options or StepOptions.tight())
    params = model.attach_laws(params)
    problem_fields = {
        "model": model,
        "step_options": step_options,
        "n_legs": params.n_legs,
        "continued_names": (name,),
        "period_n": period_n,
        "measures_force_peaks": force_peaks,
        "own_measures": select_measures(measures, ()),
    }
    given_start = cycle if switch_at is None else switch_at
    n_wheels = _check_branches(params, given_start, cycle_options, **problem_fields)
    limits, options = np.array(check_range("bounds", bounds)), check_arclength_options(options)
    if n_wheels == 0:
        return ()
    crossing: Any = ()
    if switch_at is not None:
        problem_fields["period_n"], crossing = parse_switch_point(switch_at, 1.0, limits)
        if n_wheels > 1:
            raise ValueError("switch_at is for one wheel, but the batch has more: give one wheel.")
        cycle = select_rows_on_device(switch_at.cycle, None)
    value = model.get_parameter(params, name) if switch_at is None else switch_at.value
    return _continue_gait_branches(
        params, value, cycle, cycle_options, problem_fields, options, limits, n_wheels, crossing
    )


def _check_branches(
    params: WheelParams,
    cycle: Any,
    cycle_options: CycleOptions | None,
    *,
    model: Any,
    continued_names: tuple[str],
    period_n: int,
    step_options: StepOptions,
    measures_force_peaks: bool,
    own_measures: tuple[Measure, ...],
    n_legs: int,
) -> int:
    """Return the number of wheels, or raise an error if an argument is invalid."""
    if model.fallback_model is not model:
        raise TypeError(
            "the ladder can't be followed, since its gaits jump where the model changes: give "
            "vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )
    check_parameter_name(*continued_names, model.parameter_names, "parameter")
    if check_int("period_n", period_n) > model.leg_period and cycle is None:
        raise ValueError(
            f"period_n is {period_n} and there is no cycle, but a gait of several steps is one of "
            "many beside the gait of one step: give cycle=vrw.limit_cycle(..., guess=...)."
        )
    gait_finder = make_finder(
        model, n_legs, period_n=period_n, cycle_options=cycle_options, step_options=step_options
    )
    find_own_measures(own_measures, tuple(MEASURES))
    has_force_peaks = FORCE_PEAK_MEASURES.keys() <= set(gait_finder.differentiable_measures)
    if check_bool("force_peaks", measures_force_peaks) and not has_force_peaks:
        raise ValueError(
            f"force_peaks is True, but the branch of a {type(model).__name__} has no measures of "
            "the force: take vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )
    if own_measures and not gait_finder.has_own_measures:
        raise ValueError(
            f"{own_measures[0].name} is a measure of your own, but it is known for gaits of the "
            "paper's model and of your own walkers only: take vrw.ViscoelasticWheel()."
        )
    gait_finder.search_options.check_tolerances(jnp.result_type(*jax.tree.leaves(params)))
    batch_shape = np.broadcast_shapes(*(leaf.shape for leaf in jax.tree.leaves(params)))
    if len(batch_shape) != 1:
        raise ValueError(f"the wheels' batch has shape {batch_shape}, but it must have one axis.")
    return batch_shape[0]


def _continue_gait_branches(
    params: WheelParams,
    value: Any,
    cycle: Any,
    cycle_options: CycleOptions | None,
    problem_fields: Mapping[str, Any],
    options: ArclengthOptions,
    bounds: np.ndarray,
    n_wheels: int,
    crossing: tuple[np.ndarray, bool] | tuple[()],
) -> tuple[Branch, ...]:
    """Return the branches of wheels from their start gaits, see `find_branch_starts`.

    - `value`: value of the continued parameter at the start of each branch;
    - `crossing`: tangent of the known branch that is crossed at the start, and whether it has half
      the period.
    """
    model, (name,) = problem_fields["model"], problem_fields["continued_names"]
    # The batch is padded to a power of two, because each size compiles programs.
    indices = np.minimum(np.arange(1 << (n_wheels - 1).bit_length()), n_wheels - 1)
    pad = lambda x: np.broadcast_to(np.asarray(x), (n_wheels,))[indices]
    parameter_values = np.clip(pad(value), *bounds)
    params, parameter_values = jax.device_put((jax.tree.map(pad, params), parameter_values))
    if isinstance(cycle, AbstractCycle) and len(indices) > n_wheels:
        cycle = select_rows_on_device(cycle, indices)
    if name != FRICTION_NAME:
        _, params = model.with_parameter(params, name, parameter_values)
    can_refine_mesh = cycle_options is None
    # Without cycle options, the mesh is refined until it limits no branch.
    for n_refinements_left in range(MAX_BRANCH_MESH_REFINEMENTS, -1, -1):
        start = find_branch_starts(params, parameter_values, cycle, cycle_options, problem_fields)
        is_finest_mesh = (
            not can_refine_mesh or start.finer_cycle_options is None or not n_refinements_left
        )
        has_start = start.outcomes == Outcome.STEPPED
        has_start &= np.arange(len(has_start)) < n_wheels
        branch_data = continue_and_locate_special_points(
            Continuation(start.problem, options, bounds, start.wheels, *crossing),
            start.z,
            np.asarray(parameter_values),
            has_start,
            is_finest_mesh,
        )
        # If a gait exists but no branch starts from it, its step does not repeat on this mesh.
        needs_finer_mesh = (
            gait_exists if data is None else data.is_mesh_limited
            for gait_exists, data in zip(has_start, branch_data, strict=True)
        )
        if is_finest_mesh or not any(needs_finer_mesh):
            break
        cycle_options, cycle = start.finer_cycle_options, start.cycles
    return tuple(
        _make_gait_branch(start, i, data, select_rows_on_device(params, i))
        for i, data in enumerate(branch_data[:n_wheels])
    )


def _make_gait_branch(
    start: BranchStart, index: int, data: BranchData | None, params: WheelParams
) -> Branch:
    problem = start.problem
    (name,) = problem.continued_names
    provenance = collect_provenance_attributes(params, problem.model, problem.step_options)
    provenance.pop(f"parameter_{name}", None)
    attributes = {"title": f"Branch of limit cycles along {name}"} | provenance
    outcome = Outcome(int(start.outcomes[index]))
    if data is None and outcome == Outcome.STEPPED:
        outcome = Outcome.NO_CYCLE_FOUND
    start_params = None if data is None else params.attach_laws(None)
    return make_branch(problem, data, name, start_params, outcome, dataset_attributes=attributes)

"""Describe the last gait on the way from the wheel in Table 1 of the paper to a wheel without one.

The wheels on the way have parameters on the straight line between the two wheels. The ground is
that of the wheel without a gait.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.base.outcomes import Outcome
from vrw_jax.gaits.collocation_finder import CollocationFinder
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.finder_selection import make_finder
from vrw_jax.gaits.floquet import compute_multipliers
from vrw_jax.gaits.further_search import MESH_DOUBLINGS
from vrw_jax.gaits.limit_cycle_result import LimitCycle
from vrw_jax.gaits.phase_sequence import ADMISSIBILITY_CHECKS
from vrw_jax.lanes.batching import select_tree_rows
from vrw_jax.models.measures import MEASURES
from vrw_jax.models.step_batch import step_batch
from vrw_jax.wheel.params import WheelParams
from vrw_jax.wheel.phases import PAPER_PHASES, TRANSITION_ASSUMPTIONS

N_SEGMENTS = 8
"""Number of segments into which a part of the way is divided."""
N_DIVISIONS = 3
"""Number of divisions, each of the segment in which the gait ends.

The way is then known to 1/512, three digits of the parameters that differ.
"""
MAX_WALK_STEPS = 30
"""Largest number of steps of the walk that shows what happens beyond the last gait."""
SMALL_QUANTITY_RATIO = 0.1
"""Ratio to the value in Table 1 below which a quantity is treated as the reason for the end."""


def describe_last_gait(find_gaits: Callable[..., Any], cycle: AbstractCycle) -> str:
    """Return sentences about the last gait on the way to the wheel of `cycle`, which has none.

    The text is empty if no gait of the wheel can exist, or if the gait has several steps.

    - `find_gaits`: function that searches for the gaits of a batch of wheels.
    """
    model, params = cycle.searched_wheel
    if cycle.period_n > 1 or model.explain_impossible_gait(params):
        return ""
    start = np.asarray(model.collect_parameter_values(WheelParams(n_legs=params.n_legs)))
    change = np.asarray(model.collect_parameter_values(params)) - start

    def make_wheel(fraction: float) -> WheelParams:
        values = jnp.asarray(start + fraction * change)
        return model.from_parameter_values(values, params.n_legs)[1]

    finder: Any = make_finder(model, params.n_legs)
    if isinstance(finder, CollocationFinder):  # One mesh is compiled, fine enough for most gaits.
        finder = finder.with_finer_mesh(MESH_DOUBLINGS[0])

    def search_on_way(fractions: Any) -> Iterator[Any]:
        """Yield the cycle at each fraction of the way."""
        wheels = list(map(make_wheel, fractions))
        if finder.is_multistable:
            # All wheels walk together.
            cycles = find_gaits(jax.tree.map(lambda *x: np.stack(x), *wheels), model=model)
            yield from (select_tree_rows(cycles, index) for index in range(len(wheels)))
        else:
            yield from map(finder.find_cycle, wheels)

    (first_gait,) = search_on_way([0.0])
    if first_gait.outcome != Outcome.STEPPED:
        return "The wheel in Table 1 of the paper has no gait of this model on this ground either."
    last_fraction, segment_size = 0.0, 1.0
    last_gait, missing_gait = first_gait, cycle
    for _ in range(N_DIVISIONS):
        segment_size /= N_SEGMENTS
        fractions = last_fraction + segment_size * np.arange(1, N_SEGMENTS)
        for fraction, gait in zip(fractions, search_on_way(fractions), strict=False):
            if gait.outcome != Outcome.STEPPED:
                missing_gait = gait
                break
            last_fraction, last_gait = fraction, gait
    wheel_text = ", ".join(
        f"{name.replace('_', ' ')} {MEASURES[name].format_with_unit(value)}"
        for name, value in zip(model.parameter_names, start + last_fraction * change, strict=True)
        if value != start[model.parameter_names.index(name)]
    )
    return (
        "On the straight line from the wheel in Table 1 of the paper to this wheel, the last gait "
        f"found has {wheel_text or 'the parameters of Table 1'}. "
        + (
            _describe_failing_quantity(first_gait, last_gait, missing_gait)
            if isinstance(last_gait, LimitCycle)
            else _describe_walk(model, make_wheel(last_fraction + segment_size), last_gait)
        )
    )


def _describe_walk(model: Any, params: WheelParams, last_gait: Any) -> str:
    """Return a sentence about the walk of the next wheel, which begins at the last gait."""
    batch = jax.tree.map(lambda x: np.asarray(x)[None], params)
    section_states = np.asarray(last_gait.section_state)[None]
    for step_index in range(MAX_WALK_STEPS):
        steps = step_batch(batch, section_states, model=model)
        outcome = Outcome(int(steps.outcome[0]))
        if outcome != Outcome.STEPPED:
            return f"Beyond it, step {step_index + 1} from this gait fails: {outcome.meaning}"
        section_states = np.asarray(steps.section_state)
    return f"Beyond it, the wheel makes {MAX_WALK_STEPS} steps from this gait, but none repeats."


def _describe_failing_quantity(
    first_gait: LimitCycle, last_gait: LimitCycle, missing_gait: Any
) -> str:
    """Return a sentence about the quantity that reaches zero where the gaits end.

    If no quantity does so, the sentence states the largest multiplier. Gaits merge and vanish where
    a multiplier is 1.
    """
    multiplier = compute_multipliers(np.asarray(last_gait.monodromy_value))[0]
    multiplier_text = f"The largest multiplier of this gait is {multiplier:.4g}."
    check_index = int(missing_gait.collocation_state.failed_check) - 1
    quantities, first_quantities = map(_collect_lowest_quantities, (last_gait, first_gait))
    if check_index >= 0:
        check_index %= len(ADMISSIBILITY_CHECKS)
    else:
        ratios = [
            value / first_value
            for (value, _), (first_value, _) in zip(quantities, first_quantities, strict=True)
        ]
        check_index = int(np.argmin(ratios))
        if ratios[check_index] > SMALL_QUANTITY_RATIO:
            return multiplier_text
    if check_index >= len(quantities):  # The mesh is no quantity.
        return multiplier_text
    if quantities[check_index][0] == 0.0:  # The last gait has no double support.
        check_index = len(quantities) - len(TRANSITION_ASSUMPTIONS)
    assumption, (value, instant) = ADMISSIBILITY_CHECKS[check_index], quantities[check_index]
    return (
        f"Beyond this wheel, {assumption.failure}: {assumption.quantity}, {assumption.symbol}, has "
        f"fallen to {value:.3g} {assumption.unit}{instant}."
    )


def _collect_lowest_quantities(gait: LimitCycle) -> list[tuple[float, str]]:
    """Return the lowest value of the quantity of each check, and the instant of this value."""
    state = gait.collocation_state
    values_by_check = iter(
        gait.system.trace_checks(gait.parameters, state.solution, state.is_phase_active)
    )
    lowest_quantities = []
    for phase_class, mesh in zip(PAPER_PHASES, gait.system.phase_meshes, strict=True):
        lowest_quantities.append((float(next(values_by_check)), ""))
        for guard_index in range(len(phase_class.list_assumptions())):
            values = np.asarray(next(values_by_check))
            if guard_index == 0:  # The guard of the regular end is lowest at the end.
                values = values[: len(values) // 2]
            index = int(np.argmin(values))
            instant = f" {phase_class.start_title}"
            if index:
                percentage = 100.0 * np.append(mesh.node_time_fractions, 1.0)[index - 1]
                instant = f" at {percentage:.0f} % of this phase"
            lowest_quantities.append((float(values[index]), instant))
    lowest_quantities += [(abs(float(value)), "") for value in values_by_check]
    return lowest_quantities

"""Branches of a user's walkers along one of their parameters."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from vrw_jax.base.checks import check_callable, check_int, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.outcomes import Outcome
from vrw_jax.base.parameters import find_tree_parameter, replace_tree_parameter
from vrw_jax.base.walker import AbstractWalker, make_return_map, step_batch_of_walker
from vrw_jax.branches.arclength import ArclengthOptions, ContinuationPoint
from vrw_jax.branches.branch import Branch, SpecialPoint
from vrw_jax.branches.branch_location import (
    ADMISSIBILITY,
    BORDER_COLLISION,
    EVENT_ORDER,
    PointTable,
    QuantitiesByName,
)
from vrw_jax.branches.map_branch import SWITCHED_KINDS, AbstractMapContinuation, trace_map_branch
from vrw_jax.branches.test_functions import BIFURCATIONS, TestFunction
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.flow.phase_integration import GuardsAndMargins, integrate_phase
from vrw_jax.gaits.hybrid_gait import HybridGait, find_hybrid_gait

MarginFunctions = Mapping[str, Callable[[Array, Any], Array]]
"""Functions of state and parameters by name, which are positive in admissible gaits."""

MAX_PERIOD_CHANGE_AT_JUMP = 0.01
"""Largest relative change of the period at a jump within one branch, as for wheels."""


@dataclass(frozen=True)
class HybridGaitFinder:
    """Gaits of a walker along the parameter `name`. The search can be pickled."""

    walker: AbstractWalker
    params: Any
    name: str
    period_n: int
    options: StepOptions

    def find(self, section_state: np.ndarray, p: float) -> HybridGait:
        """Return the gait near a section state at the value p of the parameter."""
        params = replace_tree_parameter(self.params, self.name, p)
        return find_hybrid_gait(self.walker, params, section_state, self.period_n, self.options)


@dataclass(frozen=True)
class HybridContinuation(AbstractMapContinuation):
    """Continuation of the gaits of a walker, with margins and, if known, the order of events."""

    _: KW_ONLY
    gait_finder: HybridGaitFinder
    margins: tuple[tuple[str, Callable[[Array, Any], Array]], ...]

    @property
    def test_functions(self) -> dict[str, TestFunction]:  # type: ignore[override]
        return {
            **BIFURCATIONS,
            EVENT_ORDER: TestFunction(
                "order_of_events_changes", "Events change their order.", is_stepwise=True
            ),
            **{
                name: TestFunction(BORDER_COLLISION, "A margin vanishes.")
                for name, _ in self.margins
            },
        }

    @property
    def measure_names(self) -> tuple[str, ...]:  # type: ignore[override]
        return ("period", *(name for name, _ in self.margins))

    def make_cycle_finder(self, wheel_index: int, point: ContinuationPoint) -> Callable:  # type: ignore[override]
        return functools.partial(self.gait_finder.find, self.state_units * point.z, float(point.p))

    def evaluate_point_quantities(self, wheels: Any, points: ContinuationPoint) -> QuantitiesByName:
        finder, states = self.gait_finder, self.state_units * points.z
        params = replace_tree_parameter(wheels, finder.name, points.p)
        quantities = {"x": states, "period": np.zeros(len(states))}
        codes, outcome = [], np.full(len(states), int(Outcome.STEPPED))
        minima = np.full((len(states), len(self.margins)), np.inf)
        for _ in range(finder.period_n):
            step = step_batch_of_walker(finder.walker, params, states, finder.options)
            if self.margins:
                functions = tuple(function for _, function in self.margins)
                step_minima = _measure_margins(
                    finder.walker, functions, params, states, step.n_events, finder.options
                )
                minima = np.minimum(minima, step_minima)
            quantities["period"] = quantities["period"] + step.duration
            if isinstance(finder.walker, HybridSystem):
                codes.append(np.column_stack([step.n_events, step.events]))
            outcome = np.where(outcome == Outcome.STEPPED, step.outcome, outcome)
            states = step.section_state
        return quantities | {
            EVENT_ORDER: np.array(
                [
                    zlib.crc32(row.tobytes())
                    for row in np.concatenate([np.zeros((len(states), 1)), *codes], 1)
                ],
                float,
            ),
            "outcome": outcome,
            **{name: minima[:, i] for i, (name, _) in enumerate(self.margins)},
        }

    def are_points_admissible(self, quantities: QuantitiesByName) -> np.ndarray:
        return quantities["outcome"] == Outcome.STEPPED

    def name_branch_end(self, quantities: QuantitiesByName, point_index: int) -> str:
        outcome = Outcome(int(quantities["outcome"][point_index]))
        return ADMISSIBILITY if outcome == Outcome.STEPPED else outcome.name.lower()

    def is_same_gait(self, before: PointTable, after: PointTable) -> np.ndarray:
        periods, new_periods = (table.quantities["period"] for table in (before, after))
        is_similar = np.abs(new_periods - periods) <= MAX_PERIOD_CHANGE_AT_JUMP * periods
        return super().is_same_gait(before, after) & is_similar


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(None, None, 0, 0, 0, None))
def _measure_margins(
    system: HybridSystem,
    margins: tuple[Callable, ...],
    params: Any,
    x: Array,
    n_events: Array,
    options: StepOptions,
) -> Array:
    """Return the minimum of each margin over one step of `n_events` events."""
    start = system.embed(x, params)
    simulation = system.simulate(params, start, events=system.max_events, options=options)
    starts, durations = simulation.find_phases(start)

    def measure_mode(field: Callable, start: Array, duration: Array, is_active: Array) -> Array:
        evaluate = lambda y: jnp.stack(
            [duration - y[-1], *(margin(y[:-1], params) for margin in margins)]
        )
        return integrate_phase(
            lambda y: jnp.append(field(y[:-1], params), 1.0),
            GuardsAndMargins(evaluate, 1, (True,) * len(margins)),
            jnp.append(start, 0.0),
            is_active,
            options,
        ).margin_minima

    fields = [mode.field for mode in system.modes.values()]
    measure_by_mode = [functools.partial(measure_mode, field) for field in fields]

    def measure_phase(phase: tuple) -> Array:
        index, mode, start, duration = phase
        is_active = (index < n_events) & (duration > 0.0)
        minima = lax.switch(mode, measure_by_mode, start, duration, is_active)
        return jnp.where(is_active, minima, jnp.inf)

    phases = jnp.arange(system.max_events), simulation.modes, starts, durations
    return jnp.min(lax.map(measure_phase, phases), 0)


def continue_hybrid_branch(
    walker: AbstractWalker,
    params: Any,
    name: str,
    bounds: tuple[float, float],
    gait: HybridGait,
    period_n: int,
    step_options: StepOptions | None,
    options: ArclengthOptions | None,
    margins: MarginFunctions | None,
    switch_at: SpecialPoint | None,
) -> Branch:
    """Return the branch of `continue_branch` for a walker of the user."""
    check_int("period_n", period_n)
    step_options = StepOptions() if step_options is None else step_options
    check_type("step_options", step_options, StepOptions, "give vrw.StepOptions()")
    check_type("margins", margins, (Mapping, type(None)), "give a dictionary of functions by name")
    margins = dict(margins or {})
    if margins and not isinstance(walker, HybridSystem):
        raise ValueError(
            f"margins are minima over the motion, which a {type(walker).__name__} does not define: "
            "give a vrw.HybridSystem, or leave them out."
        )
    for margin_name, margin in margins.items():
        check_callable(f"margin {margin_name!r}", margin, "of state and parameters")
    n_periods = SWITCHED_KINDS.get(switch_at.kind, 1) if isinstance(switch_at, SpecialPoint) else 1
    start_value = float(jax.tree.leaves(params)[find_tree_parameter(params, name)])
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), params)
    finder = HybridGaitFinder(walker, params, name, n_periods * period_n, step_options)

    def map_section_state(params: Any, x: Array, value: Array) -> Array:
        step_params = replace_tree_parameter(params, name, value)
        take_step = make_return_map(walker, step_params, step_options)
        for _ in range(period_n):
            x = take_step(x)
        return x

    return trace_map_branch(
        functools.partial(HybridContinuation, gait_finder=finder, margins=tuple(margins.items())),
        map_section_state, gait.section_state, start_value, bounds, params, name, None, options,
        switch_at,
    )  # fmt: skip

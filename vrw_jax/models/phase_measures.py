"""Measures of the motion in the phases of a step: extrema of forces, and measures of a user."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.base.checks import require_known_name
from vrw_jax.base.measures import Measure
from vrw_jax.flow.kinks import (
    SmoothParts,
    StepForceExtrema,
    find_extrema,
    integrate_over_parts,
    mask_ends,
    mask_incomplete,
    summarize_forces,
)
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import WheelParams
from vrw_jax.wheel.phases import PAPER_PHASES, AbstractPhase, PhaseInstant, make_paper_phases


def _evaluate_at_nodes(
    phase: AbstractPhase,
    parts: SmoothParts,
    compute_quantities: Callable[[PhaseInstant], Array],
    n_rates: int = 1,
) -> Any:
    """Return quantities at all nodes and their rates, nested as by `n_rates` calls of `jax.jvp`."""

    def evaluate(sides: Array, state: Array) -> Any:
        smooth_phase = phase.on_sides(tuple(sides)) if phase.n_kinks else phase
        evaluate_quantities: Any = lambda y: compute_quantities(
            PhaseInstant(smooth_phase, smooth_phase.unpack_motion(y))
        )

        def compute_rates(y: Array) -> Array:
            acceleration = smooth_phase.solve_acceleration(smooth_phase.unpack_motion(y))
            return jnp.concatenate([y[phase.n_dof :], jnp.stack(acceleration[: phase.n_dof])])

        for _ in range(n_rates):
            evaluate_quantities = lambda y, function=evaluate_quantities: jax.jvp(
                function, (y,), (compute_rates(y),)
            )
        return evaluate_quantities(state)

    return jax.vmap(lambda sides, states: jax.vmap(lambda y: evaluate(sides, y))(states))(
        parts.sides, parts.states
    )


def _make_phases(params: WheelParams, foot_distance: Array) -> tuple[AbstractPhase, ...]:
    return make_paper_phases(params.symbols(), foot_distance, stop_at_lift_off=False)


@jax.jit
def measure_forces(
    params: WheelParams, x: Array, parts_by_phase: Sequence[SmoothParts]
) -> dict[str, Array]:
    """Return the `measures.FORCE_PEAK_MEASURES` of a step from the section state `x`.

    They are NaN if a phase has more kinks than parts are listed.
    """
    landing = transitions.resolve_landing(params.symbols(), *x)

    def compute_forces(instant: PhaseInstant) -> Array:
        fore = jnp.asarray(instant.fore_force.normal)
        rear = 0.0 if instant.rear_force is None else instant.rear_force.normal
        return jnp.stack([fore, fore + rear])

    extrema_by_phase, phase_start = [], jnp.zeros_like(x[0])
    for phase, parts in zip(
        _make_phases(params, landing.foot_distance), parts_by_phase, strict=True
    ):
        (forces, rates), (_, second_rates) = _evaluate_at_nodes(phase, parts, compute_forces, 2)
        rate_extrema = find_extrema(rates[..., 0], second_rates[..., 0], parts.durations)
        extrema = []
        for i in range(2):
            found = find_extrema(forces[..., i], rates[..., i], parts.durations)
            extrema.append(
                StepForceExtrema(
                    found.times + phase_start,
                    *found[1:],
                    rate_extrema.times + phase_start,
                    rate_extrema.values,
                    rate_extrema.is_maximum,
                    mask_ends(forces[..., i], parts.durations),
                )
            )
        extrema_by_phase.append(extrema)
        phase_start = phase_start + jnp.sum(parts.durations)
    joined = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *extrema_by_phase)
    measures = summarize_forces(jnp, *joined) | {"landing_impulse": landing.fore_impulse.normal}
    return {
        name: mask_incomplete(jnp.asarray(value, x.dtype), parts_by_phase)
        for name, value in measures.items()
    }


@eqx.filter_jit
def evaluate_own_measure(
    measure: Measure,
    params: WheelParams,
    params_with_laws: WheelParams,
    x: Array,
    parts_by_phase: Sequence[SmoothParts],
) -> Array:
    """Return a measure of the user over phases of a step from the section state `x`.

    It is NaN if a phase has more kinks than parts are listed.
    """
    phase_names = [phase.phase_name for phase in PAPER_PHASES]
    for name in measure.phases:
        require_known_name(name, phase_names, "phase")
    landing = transitions.resolve_landing(params_with_laws.symbols(), *x)
    phases = _make_phases(params_with_laws, landing.foot_distance)
    measured = [
        (phase, parts)
        for phase, parts in zip(phases, parts_by_phase, strict=True)
        if phase.phase_name in measure.phases
    ]
    evaluate = lambda instant: jnp.asarray(measure(instant, params))
    if measure.reduction in ("min", "max"):
        sign, candidates = (1.0 if measure.reduction == "max" else -1.0), []
        for phase, parts in measured:
            values, rates = _evaluate_at_nodes(phase, parts, evaluate)
            extrema = find_extrema(sign * values, sign * rates, parts.durations)
            candidates.append(jnp.where(extrema.is_maximum, extrema.values, -jnp.inf))
            candidates.append(mask_ends(sign * values, parts.durations))
        largest = jnp.max(jnp.concatenate(candidates))
        result = jnp.where(jnp.isfinite(largest), sign * largest, 0.0)
    else:
        integral: Any = sum(
            integrate_over_parts(_evaluate_at_nodes(phase, parts, evaluate, 0), parts.durations)
            for phase, parts in measured
        )
        duration: Any = sum(jnp.sum(parts.durations) for _, parts in measured)
        divisor = jnp.where(duration > 0.0, duration, 1.0)
        result = integral / divisor if measure.reduction == "mean" else integral
    return mask_incomplete(result, parts_by_phase)

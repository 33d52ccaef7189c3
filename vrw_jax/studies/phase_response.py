"""Response of a gait to small pushes at each instant of its stride.

A push changes the time until the next section and the section state there. Both changes are exact
across events. The later steps follow from the return map, so that the asymptotic change of the
phase is the product of an adjoint vector with the changes at the section.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vrw_jax.base.checks import check_int, check_type
from vrw_jax.base.options import StepOptions
from vrw_jax.base.printing import AbstractPrintable, LabelAndText
from vrw_jax.base.progress import announce_wait
from vrw_jax.flow.hybrid_system import HybridSystem
from vrw_jax.flow.phase_integration import sample_phase
from vrw_jax.gaits.hybrid_gait import HybridGait
from vrw_jax.lanes.autodiff import evaluate_with_jacobian
from vrw_jax.lanes.batching import concatenate_tree_rows
from vrw_jax.studies.basins import StableGait


class PhaseResponse(AbstractPrintable):
    """Response of a gait of one step to small changes of its state, at instants of the stride.

    All changes are per unit of the pushed coordinate, to first order.

    - `times`: instants after the start of the step, s, shape (instants,). An event has two
      instants, before and after it;
    - `phase_indices`: phase or mode of the walker at each instant;
    - `states`: state at each instant, whose coordinates are pushed, shape (instants, dim). For the
      wheel, the state is (theta, L1, L2) with their rates. A push does not move a planted foot, so
      that responses to coordinates that the phase determines are zero;
    - `phase_advance`: asymptotic advance of the phase, as a fraction of the period, shape
      (instants, dim). After many steps, a pushed walker is ahead of an unpushed one by it;
    - `period`: period of the gait, s;
    - `section_states`: change of the section state at the end of this step and of the next ones,
      shape (steps, instants, dim, n);
    - `measures`: changes of the measures of the next complete steps by name, each of shape (steps,
      instants, dim): the period, and for wheels also speed, step length and durations of phases.

    Examples:
        >>> response = vrw.phase_response(vrw.WheelParams(), n_samples=5)
        >>> print(f"{response.phase_advance[0, 3]:.3f} per rad/s just after the landing")
        0.832 per rad/s just after the landing
    """

    times: Float[np.ndarray, " instants"]
    phase_indices: Int[np.ndarray, " instants"]
    states: Float[np.ndarray, "instants dim"]
    phase_advance: Float[np.ndarray, "instants dim"]
    period: float
    section_states: Float[np.ndarray, "steps instants dim n"]
    measures: dict[str, Float[np.ndarray, "steps instants dim"]]

    @property
    def delay(self) -> Float[np.ndarray, "instants dim"]:
        """Return the asymptotic delay of all later events, s per unit, shape (instants, dim)."""
        return -self.period * self.phase_advance

    def summary_rows(self) -> list[LabelAndText]:
        """Return labels and texts: the period and the largest advance for each coordinate."""
        rows = [("period", f"{self.period:.6g} s")]
        for i, advance in enumerate(self.phase_advance.T):
            instant = int(np.argmax(np.abs(advance)))
            text = f"{advance[instant]:.4g} periods per unit at {self.times[instant]:.4g} s"
            rows.append((f"largest advance by coordinate {i}", text))
        return rows


class _Phase(NamedTuple):
    """Samples of one phase of a stride, and the map from each instant to the section."""

    times: np.ndarray
    phase_indices: np.ndarray
    states: np.ndarray
    # Jacobian of (section state, remaining duration) by the state, (instants, n + 1, dim)
    remaining_jacobians: np.ndarray


class _Stride(NamedTuple):
    """Sampled stride of a gait, and its return map."""

    phases: list[_Phase]
    return_map_jacobian: np.ndarray
    measure_jacobians: dict[str, np.ndarray]  # derivatives of measures by the section state
    period: float


@announce_wait("steps and their derivatives", "30 s")
def phase_response(
    params: Any,
    *,
    cycle: Any = None,
    model: Any = None,
    n_samples: int = 17,
    n_steps: int = 3,
    options: StepOptions | None = None,
) -> PhaseResponse:
    """Return the response of a gait to small pushes at each instant of the stride.

    A push changes the state at one instant. After many steps, the walker is on its gait again, and
    ahead of or behind the unpushed walker by a constant fraction of the period: the asymptotic
    phase. The result contains this fraction, and the changes of the next steps and of their
    measures. Derivatives are exact across events, as are those of steps.

    Args:
        params: one wheel, or the parameters of a `HybridSystem`.
        cycle: a stable gait of one step; for a wheel by default the result of `limit_cycle`, for a
            `HybridSystem` the `HybridGait` at `params`.
        model: model of the wheel, the paper's by default, or a `HybridSystem`.
        n_samples: number of instants in each phase or mode, both ends included.
        n_steps: number of steps whose changes are returned.
        options: numerical options of the steps, by default tight.

    Returns:
        A `PhaseResponse` for all coordinates of the state.

    Raises:
        TypeError, ValueError: if an argument is invalid, or if the gait is unstable or has several
            steps; the message names the remedy.

    Examples:
        >>> response = vrw.phase_response(vrw.WheelParams(), n_samples=5)
        >>> print(f"{response.measures['period'][0, 0, 3]:.4f} s per rad/s in the next step")
        -0.1607 s per rad/s in the next step
    """
    n_samples, n_steps = check_int("n_samples", n_samples, 2), check_int("n_steps", n_steps)
    options = StepOptions.tight() if options is None else options
    check_type("options", options, StepOptions, "give vrw.StepOptions()")
    if isinstance(model, HybridSystem):
        check_type("cycle", cycle, HybridGait, "give vrw.limit_cycle(params, model=, guess=)")
        stride = _sample_hybrid_stride(model, params, cycle.section_state, n_samples, options)
    else:
        gait = StableGait.from_cycle("vrw.phase_response", params, model, cycle, options)
        gait.require_start_within_step("pushes")
        stride = _sample_wheel_stride(gait, n_samples)
    jacobian, samples = stride.return_map_jacobian, concatenate_tree_rows(*stride.phases)
    if not np.max(np.abs(np.linalg.eigvals(jacobian))) < 1.0:
        raise ValueError(
            "the gait is unstable, so that a pushed walker does not return to it: give a stable "
            "gait of one step."
        )
    # The adjoint vector: derivative of the sum of all later durations by the section state.
    adjoint = np.linalg.solve(
        (np.eye(len(jacobian)) - jacobian).T, stride.measure_jacobians["period"]
    )
    by_section, by_time = np.split(samples.remaining_jacobians, [len(jacobian)], 1)
    delay = by_time[:, 0] + np.einsum("j,ijd->id", adjoint, by_section)
    section_changes = [by_section]
    for _ in range(n_steps - 1):
        section_changes.append(jacobian @ section_changes[-1])
    changes = np.stack(section_changes)
    return PhaseResponse(
        samples.times,
        samples.phase_indices,
        samples.states,
        -delay / stride.period,
        stride.period,
        np.swapaxes(changes, 2, 3),
        {
            name: np.einsum("j,kijd->kid", gradient, changes)
            for name, gradient in stride.measure_jacobians.items()
        },
    )


def _sample_wheel_stride(gait: StableGait, n_samples: int) -> _Stride:
    params, model, options, section_states = gait
    x = jnp.asarray(section_states[0])
    trajectory = model.sample_step(params, x, options, n_samples)

    def measure(x: Array) -> tuple[Array, dict[str, Array]]:
        result = model.advance(params, x, options)
        length, period = model.compute_foot_distance(params, x), jnp.sum(result.durations)
        names = ("duration_dls", "duration_sls1", "duration_sls2")
        measures = {"period": period, "step_length": length, "speed": length / period}
        return result.section_state, measures | dict(zip(names, result.durations, strict=True))

    (_, measures), (return_map_jacobian, measure_jacobians) = evaluate_with_jacobian(measure, x)
    foot_distance = measures["step_length"]
    phases: list[_Phase] = []
    durations = np.asarray(trajectory.durations)
    for index in np.flatnonzero(durations > 0.0).tolist():

        def finish(index: int, y: Array) -> Array:
            result = model.finish_step(params, index, foot_distance, y, options)
            return jnp.append(result.section_state, jnp.sum(result.durations))

        states = jnp.asarray(trajectory.state[index])
        phases.append(
            _Phase(
                np.asarray(trajectory.time[index]),
                np.full(n_samples, index),
                np.asarray(states),
                np.asarray(_differentiate_each(functools.partial(finish, index), states)),
            )
        )
    return _Stride(
        phases,
        np.asarray(return_map_jacobian),
        jax.tree.map(np.asarray, measure_jacobians),
        float(measures["period"]),
    )


@eqx.filter_jit
def _differentiate_each(finish: Callable[[Array], Array], states: Array) -> Array:
    return jax.vmap(lambda y: evaluate_with_jacobian(finish, y)[1])(states)


def _sample_hybrid_stride(
    system: HybridSystem, params: Any, x: Array, n_samples: int, options: StepOptions
) -> _Stride:

    def advance(x: Array) -> tuple[Array, Array]:
        step = system.step(params, x, options)
        return step.section_state, step.duration

    step = system.step(params, x, options)
    jacobian, period_gradient = evaluate_with_jacobian(advance, x)[1]
    start, n_events = system.embed(x, params), int(step.n_events)
    simulation = system.simulate(params, start, events=n_events, options=options)
    starts, durations = simulation.find_phases(start)
    times = np.concatenate([[0.0], np.asarray(simulation.times)])
    phases: list[_Phase] = []
    mode_names = tuple(system.modes)
    for event in range(n_events):
        mode = int(simulation.modes[event])
        if not durations[event] > 0.0:
            continue
        vector_field: Any = system.modes[mode_names[mode]].field
        field = functools.partial(lambda field, y: field(y, params), vector_field)
        states = sample_phase(field, starts[event], durations[event], n_samples, options)

        def finish(mode: str, n_left: int, y: Array) -> Array:
            rest = system.simulate(params, y, events=n_left, mode=mode, options=options)
            return jnp.append(system.project(rest.states_after[-1], params), rest.times[-1])

        phases.append(
            _Phase(
                np.linspace(times[event], times[event + 1], n_samples),
                np.full(n_samples, mode),
                np.asarray(states),
                np.asarray(
                    _differentiate_each(
                        functools.partial(finish, mode_names[mode], n_events - event), states
                    )
                ),
            )
        )
    return _Stride(
        phases,
        np.asarray(jacobian),
        {"period": np.asarray(period_gradient)},
        float(step.duration),
    )

"""Integrate one phase of any vector field from its start to its earliest event, for one element.

The solver loop is that of `flow/integrate`, the search for events that of `flow/event_location`.
The equations are of first order, so a state has no positions `q`, and its only rate `v[0]` is the
whole state. Solver steps are those of an explicit method, for JAX and for machine code, or of any
method of diffrax. Events are located to round-off. Derivatives of the event's state and time follow
from the implicit function theorem, so they are accurate to the order of the solver.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from vrw_jax import lanes
from vrw_jax.base.elementwise import Scalar, Vector, select_entry_by_mask
from vrw_jax.base.options import StepOptions
from vrw_jax.flow.event_location import (
    GUARD_ROUNDOFF_IN_EPS,
    IntegratorState,
    has_guard_crossed,
)
from vrw_jax.flow.integrate import PhaseEnd, integrate_to_event
from vrw_jax.flow.solver_steps import (
    STEP_LENGTH_SAFETY_FACTOR,
    BatchPhase,
    ButcherTableau,
    SolverStepFunction,
    StageAccelerations,
    StageState,
    divide_equally,
    estimate_step_error,
    load_explicit_tableau,
    sample_batch_phase,
    take_rk_step,
)
from vrw_jax.lanes.autodiff import find_maximum_over_directions
from vrw_jax.lanes.batching import is_inside_jit
from vrw_jax.lanes.keys import UnresolvableFunctionError, make_key

StateArray = Float[Array, " dim"]
VectorField = Callable[[StateArray], StateArray]
"""Autonomous vector field of a phase: function that returns the time derivative of the state."""
EvaluateGuardsAndMargins = Callable[[StateArray], Float[Array, " n_guards_and_margins"]]
"""Function that returns the values of all guards, followed by all margins, at a state."""


class GuardsAndMargins(NamedTuple):
    """Guards and margins that the integration evaluates during a phase.

    A guard ends the phase when it falls to zero. The integration computes the minimum of each
    margin over the phase.

    - `evaluate_guards_and_margins`: function that returns the guards, followed by the margins, at a
      state;
    - `n_guards`: number of guards;
    - `includes_phase_start`: whether the minimum of each margin includes its value at the start of
      the phase. The value is False for a margin that is zero there by construction, such as the
      height of a foot that leaves the ground. Interior minima and the value at the end are always
      included;
    - `guard_scales`: magnitude of the terms whose difference is the guard. A guard within some
      round-offs of this magnitude is treated as zero, because a guard that is negative only for
      microseconds has no better root;
    - `is_zero_at_start`: whether each guard is treated as zero at the start in spite of round-off.
      If the field is None, a guard is treated as zero if its value is 0 or within round-off of its
      scale;
    - `evaluate_armed_guards`: see `solver_steps.BatchPhase`.
    """

    evaluate_guards_and_margins: EvaluateGuardsAndMargins
    n_guards: int
    includes_phase_start: tuple[bool, ...] = ()
    guard_scales: Array | None = None
    is_zero_at_start: Bool[Array, " n_guards"] | None = None
    evaluate_armed_guards: Callable[[StateArray], tuple[Array, Array]] | None = None

    def find_guards_met_at_start(
        self, guard_values: Float[Array, " n_guards"], guard_rates: Float[Array, " n_guards"]
    ) -> tuple[Bool[Array, " n_guards"], Bool[Array, " n_guards"]]:
        """Return whether each guard ends the phase at the start, and whether it falls there.

        A guard ends the phase at the start if it is negative, or if it is zero and its time
        derivative is not positive. The second flag is True if such a guard is zero with a negative
        time derivative. Only then does the event time depend on the start state.
        """
        is_guard_zero = guard_values == 0.0
        is_guard_met = has_guard_crossed(guard_values, guard_rates)
        if self.guard_scales is not None:
            guard_roundoff = GUARD_ROUNDOFF_IN_EPS * jnp.finfo(guard_values.dtype).eps
            is_guard_zero = guard_values >= -guard_roundoff * self.guard_scales
        if self.is_zero_at_start is not None:
            is_guard_zero = self.is_zero_at_start
            is_guard_met = jnp.where(is_guard_zero, guard_rates <= 0.0, is_guard_met)
        return is_guard_met, is_guard_met & is_guard_zero & (guard_rates < 0.0)

    def require_flag_of_each_margin(self, n_margins: int) -> None:
        """Raise a ValueError if `includes_phase_start` does not have one flag for each margin."""
        if len(self.includes_phase_start) != n_margins:
            raise ValueError(
                f"includes_phase_start has {len(self.includes_phase_start)} flags, but there are "
                f"{n_margins} margins: give one flag for each."
            )

    def compute_margin_minima(
        self, start_margins: Array, interior_minima: Array, end_margins: Array
    ) -> Array:
        """Return the minimum of each margin over a phase: inside it, and at its ends."""
        margin_minima = jnp.where(jnp.asarray(self.includes_phase_start), start_margins, jnp.inf)
        return jnp.minimum(jnp.minimum(interior_minima, margin_minima), end_margins)


PROBE_TIME_RATIO = 1e-2
"""Time after which a guard at rest is evaluated again, as a fraction of the first solver step.

The value is chosen because the cube of the time, with which the height of a foot begins to grow, is
then above round-off.
"""

MAX_SHARE_AT_REST = 1e-3
"""Largest change of a guard by its initial rate, as a fraction of its growth over the probe, for
which the guard begins at rest. A guard that falls so slowly would be negative by round-off only.
"""

MAX_SHARE_OF_ROUNDOFF = 1e-6
"""Largest negative value of a guard, as a fraction of its growth, that is treated as zero."""


def evaluate_rise_from_rest(
    vector_field: VectorField,
    evaluate_guards: Callable[[StateArray], Array],
    guard_values: Array,
    guard_rates: Array,
    state: StateArray,
    dt0: Array,
) -> Float[Array, " n_guards"]:
    """Return the value after the probe of each guard that starts at zero and at rest, else 0.

    A guard that grows does not end the mode. A foot that lifts off smoothly has no height, no rate
    and no acceleration at first. Only the values after a short time, by Heun's method of third
    order, determine its direction.
    """
    h = PROBE_TIME_RATIO * dt0
    start_rates = vector_field(state)
    middle_rates = vector_field(state + (h / 3.0) * start_rates)
    last_rates = vector_field(state + (2.0 * h / 3.0) * middle_rates)
    growth = lax.stop_gradient(
        evaluate_guards(state + (0.25 * h) * (start_rates + 3.0 * last_rates))
    )
    is_at_rest = h * jnp.abs(guard_rates) <= MAX_SHARE_AT_REST * growth
    is_zero = (guard_values <= 0.0) & (-guard_values <= MAX_SHARE_OF_ROUNDOFF * growth)
    return jnp.where(is_zero & is_at_rest & (growth > 0.0), growth, 0.0)


class PhaseKinks(NamedTuple):
    """Kinks of a vector field, see `solver_steps.BatchPhase`."""

    evaluate_kinks: Callable[[StateArray], Vector]
    on_sides: Callable[[Vector], tuple[VectorField, EvaluateGuardsAndMargins]]
    """Function that returns vector field, guards and margins on the given sides of the kinks."""


def integrate_phase(
    vector_field: VectorField,
    guards_and_margins: GuardsAndMargins,
    start_state: StateArray,
    is_active: Bool[Array, ""],
    options: StepOptions,
    state_units: StateArray | None = None,
    kinks: PhaseKinks | None = None,
    controls_tangents: bool = False,
) -> PhaseEnd:
    """Return the end of the phase that begins at `start_state`, where a guard first falls to zero.

    A guard that is negative at the start, or zero and not rising, ends the phase immediately with
    duration 0. A guard that is zero and rising does not end the phase. If a guard falls through
    zero at the start, the event time has a derivative. This derivative is minus the guard's
    derivative with respect to the start, divided by the guard's time derivative.

    The integration also detects a guard that is negative only inside a solver step. If two guards
    are zero at the same time, the first in the list ends the phase. If `is_active` is False,
    nothing is integrated. Errors are those of the solver for the tolerances of `options`. The
    absolute tolerance is multiplied by `state_units`, whose default is 1. With `controls_tangents`,
    the steps of an explicit solver in a Jacobian also limit the errors of its tangents.
    """
    options = lax.stop_gradient(options)
    evaluate, n_guards = guards_and_margins.evaluate_guards_and_margins, guards_and_margins.n_guards
    start_values, start_rates = jax.jvp(evaluate, (start_state,), (vector_field(start_state),))
    is_guard_met, is_guard_falling = guards_and_margins.find_guards_met_at_start(
        *lax.stop_gradient((start_values[:n_guards], start_rates[:n_guards]))
    )
    evaluate_armed_guards = guards_and_margins.evaluate_armed_guards
    guards_and_margins.require_flag_of_each_margin(len(start_values) - n_guards)

    def make_phase(
        field: VectorField, evaluate: EvaluateGuardsAndMargins, sides: tuple = ()
    ) -> tuple[BatchPhase, ButcherTableau]:
        phase, tableau = _make_phase(field, options, state_units, controls_tangents)
        n_all_guards = n_guards + len(sides)
        phase = phase._replace(
            evaluate_guards=lambda state: evaluate(state.v[0])[:n_all_guards],
            evaluate_margins=lambda state: tuple(evaluate(state.v[0])[n_all_guards:]),
            margins_include_start=guards_and_margins.includes_phase_start,
            guard_scales=guards_and_margins.guard_scales,
            guards_met_at_start=is_guard_met,
            sides=sides,
        )
        if evaluate_armed_guards is not None:
            phase = phase._replace(
                evaluate_armed_guards=lambda state: evaluate_armed_guards(state.v[0])
            )
        if kinks is not None:
            phase = phase._replace(
                evaluate_kinks=lambda state: kinks.evaluate_kinks(state.v[0]),
                on_sides=lambda sides: make_phase(*kinks.on_sides(sides), sides)[0],
            )
        return phase, tableau

    phase, tableau = make_phase(vector_field, evaluate)
    phase_end, search_end = integrate_to_event(
        phase,
        None,
        tableau,
        (),
        (start_state,),
        is_active,
        lax.stop_gradient(0.0 * start_state[0]) + jnp.minimum(options.dt0, options.max_phase_time),
        options,
        attach_derivatives=_attach_event_derivatives,
    )
    was_located = search_end.integrator_state.has_guard_crossed | jnp.any(
        is_guard_falling & (jnp.arange(n_guards) == phase_end.end_guard_index)
    )
    if search_end.enter_sides is not None:
        phase, *_ = search_end.enter_sides(search_end.sides)
    end_time, (end_state,) = _attach_event_derivatives(
        phase,
        search_end.solver_step_function,
        search_end.integrator_state,
        phase_end.duration,
        phase_end.state,
        search_end.located_guard_index,
        was_located & (phase_end.end_guard_index >= 0),
    )
    margin_minima = start_values[n_guards:]
    if search_end.margin_minima_result is not None:
        margin_minima = guards_and_margins.compute_margin_minima(
            margin_minima,
            search_end.margin_minima_result.interior_margin_minima,
            evaluate(end_state)[n_guards:],
        )
    return phase_end._replace(state=end_state, duration=end_time, margin_minima=margin_minima)


def _attach_event_derivatives(
    phase: BatchPhase,
    solver_step_function: SolverStepFunction,
    step_start: IntegratorState,
    last_time: Scalar,
    last_stage: StageState,
    guard_index: Array,
    was_located: Bool[Array, ""],
) -> tuple[Scalar, tuple[StateArray]]:
    """Return time and rates at an event, with derivatives that the event's time affects.

    Time and state of the event solve two equations: the guard is zero, and the last solver step
    reaches the state. All derivatives follow from them by the implicit function theorem.
    """
    (last_state,) = last_stage.v

    def evaluate_event_equations(event: tuple[Scalar, StateArray]) -> tuple[Scalar, StateArray]:
        end_time, state = event
        guard_values = phase.evaluate_guards(last_stage._replace(v=(state,)))
        guard_value = select_entry_by_mask(guard_index, guard_values)
        stage_states, _ = solver_step_function(step_start.state, end_time - step_start.elapsed_time)
        return (
            jnp.where(was_located, guard_value, last_time - end_time),
            state - jnp.where(was_located, stage_states[-1].v[0], last_state),
        )

    def solve_tangent_equations(linear_function: Callable, values: tuple) -> tuple:
        guard_value, state_change = values
        field = -linear_function((jnp.ones_like(guard_value), jnp.zeros_like(state_change)))[1]
        guard_change = linear_function((jnp.zeros_like(guard_value), state_change))[0]
        guard_rate = linear_function((jnp.ones_like(guard_value), field))[0]
        is_guard_falling = guard_rate < 0.0
        time_change = jnp.where(
            is_guard_falling,
            (guard_value - guard_change) / jnp.where(is_guard_falling, guard_rate, -1.0),
            0.0,
        )
        return time_change, state_change + field * time_change

    end_time, end_state = lax.custom_root(
        evaluate_event_equations,
        (last_time, last_state),
        lambda _, located_event: located_event,
        solve_tangent_equations,
    )
    return end_time, (end_state,)


MAX_STEP_GROWTH = 2.0
"""Largest ratio of the lengths of successive solver steps.

The error estimate for a solver step far shorter than needed is round-off. A length derived from
that estimate would grow without bound. The result for a batch element would then differ by
1e-12 from the result for the same system alone. The value is chosen to avoid this difference,
which is more than a hundred times the round-off.
"""


MAX_MACHINE_CODE_NUMBERS = 2_000
"""Largest number of recorded numbers of a simulation by machine code, which has them on the stack.

The value is chosen because the records and their copies for 16 lanes then need about 2 MB.
"""


def has_explicit_steps(options: StepOptions) -> bool:
    """Return whether this package takes the solver steps; diffrax takes those of all others."""
    return options.engine != "diffrax" and load_explicit_tableau(options.solver) is not None


def is_machine_code_better(system: Any, options: StepOptions, n_recorded_numbers: int) -> bool:
    """Return whether to simulate by machine code, which compiles faster than XLA's programs.

    Inside `jax.jit`, a simulation becomes part of the caller's program. Functions of `system` whose
    closures contain traced values have no key, and only XLA can differentiate with respect to them.
    """
    if (
        is_inside_jit()
        or not has_explicit_steps(options)
        or n_recorded_numbers > MAX_MACHINE_CODE_NUMBERS
    ):
        return False
    with contextlib.suppress(UnresolvableFunctionError):
        return bool(make_key(system))
    return False


def _make_phase(
    field: VectorField,
    options: StepOptions,
    state_units: StateArray | None,
    controls_tangents: bool,
) -> tuple[BatchPhase, ButcherTableau]:
    """Return the phase of a vector field without guards, and the tableau of its solver.

    diffrax takes the steps of implicit solvers, and of all solvers with `engine="diffrax"`.
    """
    atol: Any = options.atol * (1.0 if state_units is None else lax.stop_gradient(state_units))
    evaluate_field = lanes.mark_noinline(field)
    evaluate_rates = lambda _, v: StageAccelerations((), (), (evaluate_field(v[0]),))
    tableau: Any = load_explicit_tableau(options.solver)
    # Implicit methods are stable at any length, and would resolve tangents that decay at once.
    controls_tangents = controls_tangents and tableau is not None
    if has_explicit_steps(options):

        def take_step(state: StageState, h: Scalar) -> tuple[list[StageState], Array]:
            stage_states = take_rk_step(tableau, evaluate_rates, state, h)
            return stage_states, estimate_step_error(tableau, stage_states, h)[0]

    else:
        take_step, tableau = _make_diffrax_step(field, options, atol)
    # An error below the limit of growth is round-off.
    min_squared_error = (STEP_LENGTH_SAFETY_FACTOR / MAX_STEP_GROWTH) ** (
        2 * tableau.convergence_order
    )

    def take_solver_step(state: StageState, h: Scalar) -> tuple[list[StageState], Array]:
        tangent_error: Any = 0.0
        if controls_tangents:
            stage_states, error, tangent_error = _take_step_with_tangent_error(
                take_step, (atol, options.rtol), state, h
            )
        else:
            stage_states, error = take_step(state, h)
        tolerance = _compute_tolerance(stage_states, atol, options.rtol)
        squared_error = jnp.maximum(jnp.mean(jnp.square(error / tolerance)), min_squared_error)
        squared_error = jnp.maximum(squared_error, tangent_error)
        return stage_states, lax.stop_gradient(
            jnp.where(jnp.isfinite(squared_error), squared_error, jnp.inf)
        )

    phase = BatchPhase(
        evaluate_rates,
        lambda _: jnp.zeros((0,)),
        take_solver_step=take_solver_step,
        take_last_step=(lambda state, h: take_step(state, h)[0]) if controls_tangents else None,
        has_exact_events=True,
    )
    return phase, tableau


def _compute_tolerance(stage_states: list[StageState], atol: Any, rtol: Scalar) -> StateArray:
    """Return the largest allowed error of each component in a solver step."""
    start, end = jnp.abs(stage_states[0].v[0]), jnp.abs(stage_states[-1].v[0])
    return atol + rtol * jnp.maximum(start, end)


MAX_TANGENT_ERROR = 100.0
"""Largest error of a tangent in a solver step, relative to the largest tangent of all directions,
as a multiple of the relative tolerance.

The value is chosen because errors are smaller where the motion excites all its frequencies, so that
a Jacobian then has the solver steps of the motion.
"""


def _take_step_with_tangent_error(
    take_step: Callable, tolerances: tuple, state: StageState, h: Scalar
) -> tuple[list[StageState], Array, Scalar]:
    """Return stages and error of a solver step, and the error of the tangents in a Jacobian.

    The tangent error is the mean square of the errors of a tangent, divided by their limit, in the
    direction where it is largest, see `MAX_TANGENT_ERROR`. If a part of the state rests, only
    tangents show how fast its equations are.

    - `take_step`: function of `state` and `h` that returns stages and errors;
    - `tolerances`: absolute and relative tolerance.
    """
    constants, step_code = eqx.partition(
        eqx.filter_closure_convert(take_step, state, h), eqx.is_array
    )
    step = lambda constants, *arguments: eqx.combine(constants, step_code)(*arguments)
    step_with_rule = jax.custom_jvp(
        lambda _tolerances, *arguments: (*step(*arguments), jnp.zeros_like(arguments[-1]))
    )

    @step_with_rule.defjvp
    def compute_step_jvp(primals: tuple, tangents: tuple) -> tuple:
        (stage_states, error), (stage_tangents, error_tangent) = jax.jvp(
            step, primals[1:], tangents[1:]
        )
        atol, rtol = primals[0]
        weights = 1.0 / _compute_tolerance(stage_states, atol, rtol)
        start_size, end_size, error_size = (
            find_maximum_over_directions(lax.stop_gradient(jnp.mean(jnp.square(x * weights))))
            for x in (stage_tangents[0].v[0], stage_tangents[-1].v[0], error_tangent)
        )
        size_limit = jnp.maximum(start_size, end_size) * (MAX_TANGENT_ERROR * rtol) ** 2
        tangent_error = error_size / size_limit
        # The result is NaN without tangents or with one that is not finite.
        tangent_error = jnp.where(jnp.isnan(tangent_error), 0.0, tangent_error)
        return (
            (stage_states, error, tangent_error),
            (stage_tangents, error_tangent, jnp.zeros_like(tangent_error)),
        )

    return step_with_rule(tolerances, constants, state, h)


def _make_diffrax_step(
    field: VectorField, options: StepOptions, atol: Any
) -> tuple[Callable, ButcherTableau]:
    """Return a function that takes one step by diffrax, and a tableau for its inner states.

    Inner states at which guards are evaluated are those of the solver's interpolant.
    """
    import diffrax  # This import is slow.

    solver_class = getattr(diffrax, options.solver)
    field_names = solver_class.__dataclass_fields__
    settings: dict[str, Any] = {}
    tolerances: dict[str, Any] = {"rtol": options.rtol, "atol": atol}
    if "scan_kind" in field_names:
        settings["scan_kind"] = "lax"  # for forward-mode derivatives
    if "root_finder" in field_names:
        settings["root_finder"] = diffrax.VeryChord(**tolerances)
    solver, term = solver_class(**settings), diffrax.ODETerm(lambda t, y, args: field(y))
    tableau = _make_interpolant_tableau(solver.error_order(term))

    def take_step(state: StageState, h: Scalar) -> tuple[list[StageState], Array]:
        (start,), start_time = state.v, jnp.zeros_like(h)
        memory = solver.init(term, start_time, h, start, None)
        end, error, interpolant_data, _, result = solver.step(
            term, start_time, h, start, None, memory, jnp.asarray(False)
        )
        if error is None:
            raise ValueError(
                f"{type(solver).__name__} gives no error estimate, but the step size "
                "is controlled by one: take 'Dopri8', 'Tsit5' or 'Kvaerno5'."
            )
        interpolant = solver.interpolation_cls(t0=start_time, t1=h, **interpolant_data)
        make_state = lambda y, *rates: StageState((), (y,), StageAccelerations((), (), rates))
        inner_states = [
            make_state(interpolant.evaluate(float(tableau.stage_nodes[i]) * h))
            for i in tableau.guard_stage_indices
        ]
        error = jnp.where(result == diffrax.RESULTS.successful, error, jnp.inf)
        return [state, *inner_states, make_state(end, field(end))], error

    return take_step, tableau


@functools.cache
def _make_interpolant_tableau(convergence_order: int) -> ButcherTableau:
    """Return a tableau whose inner stages are those at which guards are evaluated."""
    tableau = load_explicit_tableau("Dopri8")
    assert tableau is not None
    inner_nodes = tableau.stage_nodes[list(tableau.guard_stage_indices)]
    return tableau._replace(
        convergence_order=convergence_order,
        stage_nodes=np.array([0.0, *inner_nodes, 1.0]),
        guard_stage_indices=tuple(range(1, len(inner_nodes) + 1)),
    )


def sample_phase(
    vector_field: VectorField,
    start_state: StateArray,
    duration: Scalar,
    n_samples: int,
    options: StepOptions,
    state_units: StateArray | None = None,
    controls_tangents: bool = False,
) -> Float[Array, "n_samples dim"]:
    """Return the states at `n_samples` equally spaced times of a phase, as accurate as the solver.

    The first sample is `start_state` and the last is the state after `duration`, s. The absolute
    tolerance is multiplied by `state_units`. For `controls_tangents`, see `integrate_phase`.
    """
    phase, tableau = _make_phase(vector_field, options, state_units, controls_tangents)
    lengths = divide_equally(duration, n_samples)
    return sample_batch_phase(phase, tableau, (), (start_state,), lengths, options)[:, 0]

"""The paper's viscoelastic model.

Its step consists of a landing, double support, single support I, a stopper collision and single
support II. Machine code computes the step for batches, and on other devices the same source runs by
XLA. In this source, each array holds one quantity for all wheels. For second and higher
derivatives, for implicit solvers, and with `engine="diffrax"`, functions named after an element
integrate equations of first order for one wheel instead.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from vrw_jax import lanes
from vrw_jax.base.checks import check_bool
from vrw_jax.base.elementwise import Elementwise, Vector, approximate_power, compute_sine_cosine
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Measure, Outcome
from vrw_jax.base.walker import AdvanceResult
from vrw_jax.flow.extrema import NODE_FRACTIONS, SmoothParts
from vrw_jax.flow.integrate import PhaseEnd, integrate_batch_phase
from vrw_jax.flow.phase_integration import (
    sample_phase,
)
from vrw_jax.flow.solver_steps import (
    BatchPhase,
    ButcherTableau,
    ImplicitDynamics,
    StageAccelerations,
    StageState,
    divide_equally,
    load_explicit_tableau,
    sample_batch_phase,
)
from vrw_jax.flow.tangents import find_sides
from vrw_jax.lanes.autodiff import with_batched_jvp
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.measures import evaluate_own_measure, measure_forces
from vrw_jax.models.phase_sequence import (
    PhaseRunner,
    PhaseSequenceResult,
    finish_gait_step,
    make_advance_result,
    make_element_phase,
    make_element_phase_runner,
    make_step_result,
    make_trajectory,
    run_step_phases,
)
from vrw_jax.models.step_results import (
    PAPER_START_STATE,
    SectionState,
    StepResult,
    Trajectory,
)
from vrw_jax.wheel import transitions
from vrw_jax.wheel.dynamics import Motion
from vrw_jax.wheel.laws import convert_hub_torque, convert_leg_force
from vrw_jax.wheel.params import (
    PARAMETER_NAMES,
    WheelParams,
    compute_wheel_units,
    require_known_friction,
)
from vrw_jax.wheel.phases import AbstractPhase, PhaseInstant

N_STEP_INPUTS = len(PARAMETER_NAMES) + 3
"""Number of inputs of a step on flat ground: the parameters and the section state.

Uneven ground adds the slope of the next line of the ground. Machine code keeps one number per
derivative in registers.
"""


class ViscoelasticWheel(AbstractWheel):
    """The paper's model: legs have fixed roles, and feet neither slip nor scuff. Margins are
    computed, not enforced.

    - `friction`: friction coefficient of the ground. It affects the friction margins, but not the
      motion;
    - `leg_force`: force along a leg in N, as a function `f(L, dL, params)` of its length in m, its
      rate in m/s and the parameters of the wheel. A positive force pushes the hub away from the
      foot. A method `kinks(L, dL, params)` declares where the force has kinks or jumps. None means
      the paper's force, k (L* - L) - c dL. See docs/howto/own_leg.md;
    - `hub_torque`: torque of a motor on the hub in N m, as a number, a function `f(dtheta, params)`
      of the rate of the wheel in rad/s, or a function `f(theta, dtheta, params)` of the angle of
      Leg 1 in rad too. A positive torque drives the wheel forward. The torque is external, or acts
      against a body that slides along with the hub. See docs/howto/own_leg.md;
    - `stop_at_lift_off`: whether a step fails if the ground would have to pull on Leg 1, because
      the model does not describe bouncing. If False, the step continues formally, as the paper's
      steps do after scuffing, and the margins report the violation.

    Examples:
        >>> wheel = vrw.ViscoelasticWheel(friction=20.0)
        >>> step = vrw.step(vrw.WheelParams(), vrw.paper_start(), model=wheel)
        >>> print(f"{step.margins.friction_fore:.1f}")
        19.4
    """

    model_name: ClassVar[str] = "viscoelastic"
    commands = frozenset({"scan", "map", "tune", "branch", "explore"})
    can_start_within_gait_step = True
    reports_contacts: ClassVar[bool] = False
    batch_kernel: ClassVar[str] = "phases"

    friction: float = eqx.field(static=True, converter=require_known_friction, default=1.0)
    stop_at_lift_off: bool = eqx.field(
        static=True, converter=functools.partial(check_bool, "stop_at_lift_off"), default=True
    )
    leg_force: Any = eqx.field(converter=convert_leg_force, default=None)
    hub_torque: Any = eqx.field(converter=convert_hub_torque, default=None)

    def compute_default_start(self, params: WheelParams) -> SectionState:
        """Return a section state near the gait of Table 1 of the paper, inside its basin of
        attraction.
        """
        return jnp.asarray(PAPER_START_STATE, params.damping.dtype)

    def advance(self, params: WheelParams, x: SectionState, options: StepOptions) -> AdvanceResult:
        return _compute_step(self, params, x, options, False)

    def take_step(self, params: WheelParams, x: SectionState, options: StepOptions) -> StepResult:
        return _compute_step(self, params, x, options, True)

    def take_steps(self, params: WheelParams, x: np.ndarray, options: StepOptions) -> Any:
        if not can_use_batch_kernel(options):
            return super().take_steps(params, x, options)
        params = self.attach_laws(params)
        run_steps = _compile_lane_steps(self.stop_at_lift_off, self.friction).run
        to_lanes_last = lambda leaf: np.ascontiguousarray(np.moveaxis(np.asarray(leaf), 0, -1))
        steps = run_steps(*jax.tree.map(to_lanes_last, (params, x)), options)
        return jax.tree.map(lambda leaf: np.moveaxis(leaf, -1, 0), steps)

    def sample_step(
        self, params: WheelParams, x: SectionState, options: StepOptions, n_samples: int
    ) -> Trajectory:
        params = self.attach_laws(params)
        if can_use_batch_kernel(options):
            return _compile_sampling(self.stop_at_lift_off, n_samples)(params, x, options)
        return self._sample_element(params, x, options, n_samples)

    def measure_force_peaks(
        self, params: WheelParams, x: SectionState, options: StepOptions
    ) -> dict[str, Array]:
        params = self.attach_laws(params)
        return measure_forces(params, x, self._sample_parts(params, x, options))

    def measure_step(
        self,
        params: WheelParams,
        x: SectionState,
        step: StepResult | None,
        options: StepOptions,
        measures: Sequence[Measure] | None = None,
    ) -> dict[str, Array]:
        measures = self.measures if measures is None else measures
        of_phases = [measure for measure in measures if measure.phases]
        of_step = [measure for measure in measures if not measure.phases]
        values = super().measure_step(params, x, step, options, of_step)
        if of_phases:
            with_laws = self.attach_laws(params)
            parts = self._sample_parts(with_laws, x, options)
            for measure in of_phases:
                values[measure.name] = evaluate_own_measure(measure, params, with_laws, x, parts)
        return values

    def _sample_parts(
        self, params: WheelParams, x: SectionState, options: StepOptions
    ) -> tuple[SmoothParts, ...]:
        """Return the smooth parts of each phase in a step, whose laws `params` contains."""
        if load_explicit_tableau(options.solver) is None:
            raise ValueError(
                f"solver is {options.solver}, but force peaks and measures of phases need an "
                "explicit one: take 'Dopri8'."
            )
        return _compile_part_sampling(self.stop_at_lift_off)(params, x, options)

    def _sample_element(
        self, params: WheelParams, x: SectionState, options: StepOptions, n_samples: int
    ) -> Trajectory:
        phase_sequence = self._run_phases(params, x, options, records_margins=False)
        sample = lambda phase, q, v, duration, options: sample_phase(
            make_element_phase(phase, records_margins=False).vector_field,
            jnp.stack([*q, *v]),
            duration,
            n_samples,
            options,
            jnp.stack(phase.coordinate_units),
        )
        return make_trajectory(phase_sequence, sample, options)

    def _run_phases(
        self, params: WheelParams, x: SectionState, options: StepOptions, records_margins: bool
    ) -> PhaseSequenceResult:
        """Integrate all phases of a step of one wheel and return their starts and ends."""
        phase_runner = make_element_phase_runner(options, records_margins)
        return run_step_phases(phase_runner, params, tuple(x), options, self.stop_at_lift_off)

    def finish_step(
        self,
        params: WheelParams,
        phase_index: int,
        foot_distance: Elementwise,
        phase_state: Float[Array, " 6"],
        options: StepOptions,
    ) -> AdvanceResult:
        finish = functools.partial(_finish_steps, self.stop_at_lift_off, phase_index)
        inputs = self.attach_laws(params), jnp.asarray(foot_distance), phase_state, options
        if not can_use_batch_kernel(options):
            return finish(False, *inputs)
        return _compile_lanes(functools.partial(finish, True), functools.partial(finish, False))(
            *inputs
        )


def _compute_step(
    model: ViscoelasticWheel,
    params: WheelParams,
    x: SectionState,
    options: StepOptions,
    records_margins: bool,
) -> Any:
    if model.laws is not None:
        # Programs take the numbers of the laws as part of the parameters.
        params = model.attach_laws(params)
        model = model.with_laws(None)
    return _compile_step(model, select_engine(options), records_margins)(params, x, options)


def select_engine(options: StepOptions) -> str:
    """Return the name of the engine that computes a step."""
    return "lanes" if can_use_batch_kernel(options) else "diffrax"


@functools.cache
def _compile_step(model: ViscoelasticWheel, engine: str, records_margins: bool) -> Callable:
    """Return a compiled function of (params, x, options), differentiable in any mode.

    - `records_margins`: whether the results include indicators, margins and energies.
    """

    def take_element_step(params: WheelParams, x: SectionState, options: StepOptions) -> Any:
        """Compute a step of one wheel by the engine "diffrax", or higher derivatives of any engine.

        The results report the name of the requested engine.
        """
        phase_sequence = model._run_phases(params, x, options, records_margins)
        return (
            make_step_result(phase_sequence, model.friction, engine)
            if records_margins
            else make_advance_result(phase_sequence, engine)
        )

    take_tight_step = lambda params, x, options: take_element_step(
        params, x, options.with_derivative_tolerances()
    )
    if engine == "diffrax":
        return lanes.differentiate(take_element_step, take_tight_step)
    take_lane_steps = functools.partial(
        take_steps_of_lanes, model.stop_at_lift_off, model.friction if records_margins else None
    )
    return _compile_lanes(take_lane_steps, take_tight_step)


@functools.cache
def _compile_sampling(stop_at_lift_off: bool, n_samples: int) -> Callable:
    """Return a compiled function of (params, x, options) that samples a step, with derivatives."""
    model = ViscoelasticWheel(stop_at_lift_off=stop_at_lift_off)
    return _compile_lanes(
        functools.partial(_sample_lane_steps, stop_at_lift_off, n_samples),
        lambda params, x, options: model._sample_element(
            params, x, options.with_derivative_tolerances(), n_samples
        ),
    )


@functools.cache
def _compile_part_sampling(stop_at_lift_off: bool) -> Callable:
    """Return a compiled function of (params, x, options) that samples the smooth parts of a step.

    It has first derivatives.
    """

    def refuse(*_: Any) -> Any:
        raise NotImplementedError(
            "force peaks, and own measures of a step that are not those of a collocated gait, have "
            "first derivatives only: take differences of their gradients."
        )

    return _compile_lanes(functools.partial(_sample_lane_parts, stop_at_lift_off), refuse)


def take_steps_of_lanes(
    stop_at_lift_off: bool,
    friction: float | None,
    params: WheelParams,
    x: Array,
    options: StepOptions,
) -> AdvanceResult | StepResult:
    """Return the results of a batch of walking steps.

    - `friction`: friction coefficient of the margins; None for the minimal results.
    """
    phase_sequence = run_batch_phases(
        params, x, options, stop_at_lift_off, friction is not None, is_compiled_separately=True
    )
    if friction is None:
        return make_advance_result(phase_sequence, "lanes")
    phase_end_results = tuple(
        phase_end._replace(state=phase_end.state[:2], next_solver_dt=None)  # type: ignore[arg-type]
        for phase_end in phase_sequence.phase_end_results
    )
    float_phase_sequence = phase_sequence._replace(
        phases=(), phase_start_states=(), phase_end_results=phase_end_results
    )  # only floats: `make_step_result` makes the phases anew
    return with_batched_jvp(
        lambda phase_sequence: make_step_result(phase_sequence, friction, "lanes")
    )(float_phase_sequence)


@functools.cache
def _compile_lane_steps(stop_at_lift_off: bool, friction: float) -> Any:
    """Return steps with margins for NumPy arrays with lanes on the last axis."""
    return lanes.compile_batch_function(
        functools.partial(take_steps_of_lanes, stop_at_lift_off, friction)
    )


def _compile_lanes(take_lane_steps: Callable, take_element_step: Callable) -> Callable:
    """Return a function of one wheel from that of a batch, differentiable in any mode.

    - `take_element_step`: the same function without machine code, for higher derivatives.
    """
    return lanes.differentiate(
        lanes.jit_batch(take_lane_steps),
        take_element_step,
        functools.partial(_make_column_function, take_lane_steps),
    )


def _make_column_function(
    take_lane_steps: Callable, structure: Any, argnums: tuple[int, ...]
) -> Callable:
    """Return a function of the leaves of (params, ..., options) that computes Jacobian columns.

    Its results are those of `compute_jacobian_columns`, with the tolerances for derivatives.
    """

    def compute_lane_columns(*leaves: Array) -> tuple:
        return lanes.compute_jacobian_columns(
            lanes.make_leaf_function(take_lane_steps, structure), leaves, argnums
        )

    def compute_columns(*leaves: Array) -> tuple:
        *inputs, options = jax.tree.unflatten(structure, leaves)
        n_columns = sum(math.prod(jnp.shape(leaves[i])) for i in argnums)
        compute_compiled_columns = lanes.jit_batch(
            compute_lane_columns, N_STEP_INPUTS + (n_columns > N_STEP_INPUTS)
        )
        return compute_compiled_columns(
            *jax.tree.leaves((*inputs, options.with_derivative_tolerances()))
        )

    return compute_columns


def _finish_steps(
    stop_at_lift_off: bool,
    phase_index: int,
    runs_lanes: bool,
    params: WheelParams,
    foot_distance: Array,
    phase_state: Array,
    options: StepOptions,
) -> AdvanceResult:
    """Return the results of `finish_gait_step` for a batch, or for one wheel without lanes."""
    return finish_gait_step(
        _make_phase_runner(options, False, is_compiled_separately=True)
        if runs_lanes
        else make_element_phase_runner(options, False),
        params,
        phase_index,
        foot_distance,
        tuple(phase_state),
        options,
        stop_at_lift_off,
        select_engine(options),
    )


def _sample_lane_steps(
    stop_at_lift_off: bool, n_samples: int, params: WheelParams, x: Array, options: StepOptions
) -> Trajectory:
    """Return samples of a batch of walking steps at equidistant times of each phase."""
    phase_sequence = run_batch_phases(
        params, x, options, stop_at_lift_off, False, is_compiled_separately=True
    )
    tableau = load_batch_tableau(options)
    sample = lambda phase, q, v, duration, options: sample_batch_phase(
        make_batch_phase(phase, False), tableau, q, v, divide_equally(duration, n_samples), options
    )
    return make_trajectory(phase_sequence, sample, options)


MAX_LOGGED_KINKS = 7
"""Largest number of kinks in a phase whose smooth parts are measured.

The value is chosen because a leg passes a kink once or twice in a phase.
"""


def _sample_lane_parts(
    stop_at_lift_off: bool, params: WheelParams, x: Array, options: StepOptions
) -> tuple[SmoothParts, ...]:
    """Return the smooth parts of each phase, between its kinks, for a batch of steps."""
    sequence = run_batch_phases(
        params,
        x,
        options,
        stop_at_lift_off,
        False,
        is_compiled_separately=True,
        n_logged_kinks=MAX_LOGGED_KINKS,
    )
    parts_by_phase = (
        _sample_parts_of_phase(options, *phase_and_ends)
        for phase_and_ends in zip(
            sequence.phases, sequence.phase_start_states, sequence.phase_end_results, strict=True
        )
    )
    # A step that the solver does not finish has no measures, as if it had too many kinks.
    has_solver_failed = sequence.outcome == Outcome.SOLVER_FAILED
    return tuple(
        parts._replace(n_kinks=jnp.where(has_solver_failed, 1 + MAX_LOGGED_KINKS, parts.n_kinks))
        for parts in parts_by_phase
    )


def _sample_parts_of_phase(
    options: StepOptions, phase: AbstractPhase, start: tuple[Vector, Vector], phase_end: PhaseEnd
) -> SmoothParts:
    tableau = load_batch_tableau(options)
    options = compute_wheel_units(phase.s).scale_times_to_seconds(options)
    duration, n_dof, log = phase_end.duration, phase.n_dof, phase_end.kink_log
    first_state = jnp.stack([*start[0], *start[1]])
    if log is None:
        n_kinks = jnp.zeros_like(phase_end.end_guard_index)
        sides, states, durations = (x[None] for x in (first_state, first_state, duration))
    else:
        batch_phase = make_batch_phase(phase, False)
        first_sides = jnp.stack(find_sides(batch_phase, batch_phase.make_state(*start)))
        n_kinks = log.n_kinks
        is_passed = jnp.arange(len(log.times))[:, None] < n_kinks
        times = jnp.where(is_passed, log.times, duration)
        durations = jnp.diff(jnp.concatenate([0.0 * times[:1], times, duration[None]]), axis=0)
        # Absent parts begin where the phase does, since their states must be regular.
        append = lambda first, later: jnp.concatenate(
            [first[None], jnp.where(is_passed[:, None], later, first)]
        )
        sides, states = append(first_sides, log.sides), append(first_state, log.states)

    def sample(part: tuple[Array, Array, Array]) -> Array:
        sides, state, duration = part
        smooth_phase = phase.on_sides(tuple(sides)) if log is not None else phase
        return sample_batch_phase(
            make_batch_phase(smooth_phase, False),
            tableau,
            tuple(state[:n_dof]),
            tuple(state[n_dof:]),
            jnp.asarray(np.diff(NODE_FRACTIONS)[:, None], duration.dtype) * duration,
            options,
        )

    samples = lax.map(sample, (sides, states, durations))
    return SmoothParts(n_kinks, sides, durations, samples)


def make_batch_phase(
    phase: AbstractPhase, records_margins: bool, is_compiled_separately: bool = False
) -> BatchPhase:
    """Return the functions that the batched integrator needs to integrate a phase.

    - `records_margins`: whether the integrator also evaluates margins;
    - `is_compiled_separately`: whether machine code calls the phase's functions instead of inlining
      them.
    """

    def evaluate_acceleration(q: Vector, v: Vector) -> StageAccelerations:
        sin_theta, cos_theta = compute_sine_cosine(q[0])
        return StageAccelerations(
            sin_theta,
            cos_theta,
            phase.solve_acceleration(phase.complete_wheel_motion(sin_theta, cos_theta, q, v))[
                : phase.n_dof
            ],
        )

    def complete_motion_at_stage(stage_state: StageState) -> Motion:
        return phase.complete_wheel_motion(
            stage_state.acceleration.sin, stage_state.acceleration.cos, stage_state.q, stage_state.v
        )

    def make_phase_instant(stage_state: StageState) -> PhaseInstant:
        return PhaseInstant(
            phase, complete_motion_at_stage(stage_state), stage_state.acceleration.acceleration
        )

    implicit_dynamics = ImplicitDynamics(
        lambda stage: phase.compute_dynamics_residual(
            complete_motion_at_stage(stage), stage.acceleration.acceleration
        ),
        lambda stage, right_hand_side: phase.solve_dynamics(
            complete_motion_at_stage(stage), right_hand_side
        ),
    )
    return BatchPhase(
        evaluate_acceleration,
        lambda stage: jnp.stack(phase.compute_guards(make_phase_instant(stage))),
        lambda stage: phase.compute_margins(make_phase_instant(stage)),
        phase.are_margins_counted_at_start if records_margins else (),
        implicit_dynamics,
        is_compiled_separately,
        phase.coordinate_units,
        evaluate_kinks=None
        if phase.n_kinks == 0
        else lambda stage: phase.compute_kinks(complete_motion_at_stage(stage)),
        on_sides=lambda sides: make_batch_phase(
            phase.on_sides(sides), records_margins, is_compiled_separately
        ),
        sides=phase.sides,
    )


def advance_gait_step(
    params: WheelParams,
    x: Vector,
    options: StepOptions,
    stop_at_lift_off: bool,
    straggler_count: Array | None = None,
) -> tuple[AdvanceResult, Array]:
    """Compute one walking step per batch element, without indicators, margins and energies.

    Return the results, and flags of the elements that were stopped as stragglers. No result of
    these elements is valid.

    - `x`: section state of each batch element just before touchdown;
    - `stop_at_lift_off`: see `ViscoelasticWheel`;
    - `straggler_count`: largest number of batch elements that may remain unfinished, see
      `integrate_batch_phase`.
    """
    phase_sequence = run_batch_phases(
        params, x, options, stop_at_lift_off, False, straggler_count=straggler_count
    )
    return make_advance_result(phase_sequence, "lanes"), functools.reduce(
        operator.or_, (phase_end.is_unfinished for phase_end in phase_sequence.phase_end_results)
    )


def run_batch_phases(
    params: WheelParams,
    x: Array | Vector,
    options: StepOptions,
    stop_at_lift_off: bool,
    records_margins: bool,
    **engine_settings: Any,
) -> PhaseSequenceResult:
    """Integrate all phases of one walking step per batch element and return their starts and ends.

    - `stop_at_lift_off`: see `ViscoelasticWheel`;
    - `records_margins`: whether the minima of the margins are computed;
    - `engine_settings`: `straggler_count`, the largest number of batch elements that may remain
      unfinished, see `integrate_batch_phase`; `is_compiled_separately`, `n_logged_kinks`, see
      `BatchPhase`.
    """
    phase_runner = _make_phase_runner(options, records_margins, **engine_settings)
    landing_function = with_batched_jvp(transitions.resolve_landing)
    return run_step_phases(
        phase_runner, params, tuple(x), options, stop_at_lift_off, landing_function
    )


# Upper bound on the first solver step in SLS-I, as a fraction of the step size that the controller
# proposes at the end of DLS. At lift-off the rear foot loses its force. This excites the fast mode
# of the airborne leg, which decays within 0.05 s. A first solver step above this bound and the next
# would be rejected and repeated.
MAX_FIRST_STEP_RATIO = 0.3
# Upper bound on that step as a multiple of (m/c) rtol^(1/p), where p is the order of the solver.
# The value is chosen because the step-size controller settles at 7.2 to 9.5. This holds for solvers
# of orders 5 to 8 and tolerances of 1e-4 to 1e-10.
MAX_FIRST_STEP_IN_TRANSIENT_TIMES = 7.0


def _make_phase_runner(
    options: StepOptions,
    records_margins: bool,
    straggler_count: Array | None = None,
    is_compiled_separately: bool = False,
    n_logged_kinks: int = 0,
) -> PhaseRunner:
    """Return a function that integrates one phase to its end, for all batch elements.

    The arguments are those of `run_batch_phases`.
    """
    tableau = load_batch_tableau(options)

    def run_phase(
        phase: AbstractPhase,
        q: Vector,
        v: Vector,
        is_active_lane: Array,
        previous_end: tuple[PhaseEnd, Array] | None,
    ) -> PhaseEnd:
        scaled_options = compute_wheel_units(phase.s).scale_times_to_seconds(options)
        dt0 = scaled_options.dt0 + jnp.zeros_like(q[0])
        if previous_end is not None:
            phase_end, has_occurred = previous_end
            dt0 = phase_end.next_solver_dt
            if phase.has_stiff_start:
                tolerance_root = approximate_power(
                    options.rtol.astype(jnp.float32), 1.0 / tableau.convergence_order
                ).astype(dt0.dtype)
                max_transient_dt = (
                    MAX_FIRST_STEP_IN_TRANSIENT_TIMES * tolerance_root * phase.s.m / phase.s.c
                )
                stiff_dt0 = jnp.minimum(MAX_FIRST_STEP_RATIO * dt0, max_transient_dt)
                dt0 = jnp.where(has_occurred, stiff_dt0, dt0)
        # Rules for derivatives must get all arrays as arguments, and not by closures.
        equation_constants, other_constants = eqx.partition(
            (phase.s, phase.ground_ahead), eqx.is_array
        )

        def make_phase(equation_constants: Any, held_constants: Vector) -> BatchPhase:
            s, ground_ahead = eqx.combine(equation_constants, other_constants)
            phase_of_arguments = dataclasses.replace(
                phase, s=s, phase_constants=held_constants, ground_ahead=ground_ahead
            )
            return make_batch_phase(
                phase_of_arguments, records_margins, is_compiled_separately
            )._replace(n_logged_kinks=n_logged_kinks)

        return integrate_batch_phase(
            make_phase,
            equation_constants,
            phase.phase_constants,
            tableau,
            q,
            v,
            is_active_lane,
            dt0,
            scaled_options,
            straggler_count,
        )

    return run_phase


def can_use_batch_kernel(options: StepOptions) -> bool:
    """Return whether the batch kernel can compute the step.

    The kernel requires machine code and an explicit solver. Raise a `ValueError` if the options
    require the batch kernel and it is not available.
    """
    is_solver_explicit = load_explicit_tableau(options.solver) is not None
    if options.engine == "lanes" and not (is_solver_explicit and lanes.is_machine_code_available()):
        raise ValueError(
            "engine is 'lanes', which needs a CPU, llvmlite and an explicit solver, but the solver "
            f"is {options.solver} on a {jax.default_backend()}: take engine='diffrax'."
        )
    return is_solver_explicit and lanes.is_machine_code_available() and options.engine != "diffrax"


def load_batch_tableau(options: StepOptions) -> ButcherTableau:
    """Return the tableau of an explicit solver, after the caller has checked the solver."""
    tableau = load_explicit_tableau(options.solver)
    assert tableau is not None
    return tableau

"""Unilateral model: one-sided contacts with Coulomb friction, in any order of events."""

import dataclasses
import functools
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.contact.batch_integrator import is_at_singularity, pack_coordinates
from vrw_jax.contact.contact_modes import Friction
from vrw_jax.contact.contact_state import (
    Accumulators,
    ContactState,
    GuardLayout,
    PackedState,
    choose_stopping_guard,
    compute_forces,
    compute_guard_scales,
    compute_guard_values,
    compute_packed_units,
    is_wheel_at_rest,
    make_guard_layout,
    make_mode_dynamics,
    min_stopper_force,
    pack_state,
    unpack_state,
    vector_field,
)
from vrw_jax.contact.impacts import ContactLaw
from vrw_jax.contact.mechanics import landing_position
from vrw_jax.contact.section import (
    FullState,
    compute_section_units,
    embed_section_state,
    full_section_size,
    replace_invalid_start,
    unpack_section_state,
)
from vrw_jax.contact.single_step import (
    IntervalLog,
    SampledIntervals,
    build_contact_step_function,
    build_contact_step_jacobian,
    build_contact_step_sampler,
)
from vrw_jax.contact.step_record import (
    StepCounters,
    StepDetails,
    UnilateralStep,
    add_interval,
    apply_friction_rule,
    determine_interval_outcome,
    final_section_state,
    init_counters,
    init_details,
    make_contact_law,
    make_unilateral_step,
    process_event,
    record_event,
    record_interval,
)
from vrw_jax.contact.walk_kernel import StepSummary
from vrw_jax.hybrid import MonitoredFunctions, integrate_in_units, sample_in_units
from vrw_jax.models import (
    PAPER_START_STATE,
    AbstractWheel,
    AdvanceResult,
    GaitMethod,
    ModelCapabilities,
    StepGroundValues,
    can_use_batch_kernel,
    check_stepwise_shape,
    complete_line_slopes,
)
from vrw_jax.numerics import (
    Elementwise,
    ForwardFunction,
    RealInput,
    Scalar,
    StepOptions,
    enable_all_ad_modes,
    opaque_condition,
)
from vrw_jax.validation import (
    check_choice,
    check_int,
    check_reals,
    check_type,
    raise_for_renamed_arguments,
)
from vrw_jax.wheel import (
    FRICTION_NAME,
    PARAMETER_NAMES,
    Outcome,
    WheelParams,
    WheelUnits,
    compute_wheel_units,
    convert_friction,
)

STOPPERS_BILATERAL, STOPPERS_ONE_SIDED = "bilateral", "one-sided"
"""Effect of stoppers on legs in the air: they hold with any force, or they only push."""
FRICTION_LIMIT, FRICTION_PAPER_RULE = "limit", "paper"
"""Meaning of infinite friction: the limit of large friction, or the paper's rule (A1)-(A4)."""


class UnilateralTrajectory(eqx.Module):
    """Motion of one step between its events, with axes (phase, sample).

    A phase that did not happen has duration 0. The origin is the position of the opening landing.
    """

    time: Float[Array, "phases n"]  # time since the landing, s
    state: Float[Array, "phases n dim"]  # see `contact_state.PackedState`
    contact: Int[Array, "phases legs"]  # `ContactMode` of every foot
    locked: Bool[Array, "phases legs"]  # whether each leg is on its stopper
    tangential: Float[Array, "phases n legs"]  # force on every foot, N
    normal: Float[Array, "phases n legs"]
    duration: Float[Array, " phases"]  # s
    section_state: FullState  # full section state after the step
    step_length: Scalar
    outcome: Int[Array, ""]
    model_selection: dict[str, Array] = eqx.field(default_factory=dict)  # see `AbstractStep`


class _EventLoopState(NamedTuple):
    """State of the event loop between two events of a step."""

    state: PackedState
    contact_state: ContactState
    guard: Int[Array, ""]  # index of the guard of the last event
    outcome: Int[Array, ""]
    is_running: Bool[Array, ""]
    counters: StepCounters
    details: StepDetails | None
    log: IntervalLog | None


class UnevenGround(NamedTuple):
    """Quantities of a step on uneven ground, besides the slope and friction of its landing."""

    friction: Scalar  # friction coefficient of the feet that landed earlier
    tilt: Scalar  # angle by which the next line is steeper, rad


def _convert_restitution(value: Any) -> Array | None:
    """Return Newton's coefficient of restitution as an array; None means 0.

    Raises `ValueError` for a number outside [0, 1].
    """
    if value is None or (isinstance(value, float | int) and value == 0):
        return None
    restitution = check_reals("restitution", value)
    if not isinstance(restitution, jax.core.Tracer) and not jnp.all(
        (restitution >= 0.0) & (restitution <= 1.0)
    ):
        raise ValueError(
            f"restitution is {value}, but it is a ratio of speeds: give a number from 0 to 1."
        )
    return restitution


@raise_for_renamed_arguments(infinite="infinite_friction_rule")
class UnilateralWheel(AbstractWheel):
    """Model of the wheel whose feet push on the ground and slide by Coulomb's law; no leg has a
    fixed role.

    - `friction`: coefficient of the ground, `inf` for feet that never slide;
    - `max_events`: largest number of events of one step. After a quarter of them (at least 100),
      the rest speed grows with each event;
    - `stoppers`: with "bilateral", a leg in the air that has met its stopper stays there until its
      foot is loaded. With "one-sided", the leg leaves as soon as the stopper would have to pull;
    - `restitution`: ratio of a striking foot's speeds after and before the impact, as far as energy
      allows. None has the effect of 0 and compiles to a smaller program;
    - `infinite_friction_rule`: meaning of infinite friction. With "limit" it is the limit of large
      friction, with "paper" the rule of the paper, (A1) to (A4), continued to where that rule
      stops;
    - `uneven`: differences between footholds, which `vrw.walk` sets from slopes and friction over
      steps.

    Examples:
        >>> wheel = vrw.UnilateralWheel(friction=0.7)
        >>> step = vrw.step(vrw.WheelParams(damping=300.0), vrw.paper_start(), model=wheel)
        >>> print(f"{step.slip:.2f} m of slip, {vrw.Outcome(int(step.outcome)).name}")
        0.04 m of slip, STEPPED
    """

    model_name: ClassVar[str] = "unilateral"
    capabilities: ClassVar[ModelCapabilities] = ModelCapabilities(
        config_name="unilateral",
        gait_method=GaitMethod.CONTACT_WALKS,
        commands=frozenset({"scan", "tune", "branch", "explore"}),
        fixed_by_tolerance=("restitution", "infinite_friction_rule", "uneven", "max_events"),
    )
    parameter_names: ClassVar[tuple[str, ...]] = (*PARAMETER_NAMES, FRICTION_NAME)
    reports_contacts: ClassVar[bool] = True
    batch_kernel: ClassVar[str] = "legs"

    friction: Scalar = eqx.field(converter=convert_friction, default=0.7)
    max_events: int = eqx.field(
        static=True, converter=partial(check_int, "max_events"), default=400
    )
    stoppers: str = eqx.field(static=True, default=STOPPERS_BILATERAL)
    restitution: Scalar | None = eqx.field(converter=_convert_restitution, default=None)
    infinite_friction_rule: str = eqx.field(static=True, default=FRICTION_LIMIT)
    uneven: UnevenGround | None = None

    if TYPE_CHECKING:

        def __init__(
            self,
            friction: RealInput = 0.7,
            max_events: int = 400,
            stoppers: Literal["bilateral", "one-sided"] = "bilateral",
            restitution: RealInput | None = None,
            infinite_friction_rule: Literal["limit", "paper"] = "limit",
            uneven: UnevenGround | None = None,
        ) -> None: ...

    def __check_init__(self) -> None:
        check_choice("stoppers", self.stoppers, (STOPPERS_BILATERAL, STOPPERS_ONE_SIDED))
        check_choice(
            "infinite_friction_rule",
            self.infinite_friction_rule,
            (FRICTION_LIMIT, FRICTION_PAPER_RULE),
        )
        if self.uneven is not None:
            check_type("uneven", self.uneven, UnevenGround, "leave it out, vrw.walk sets it")

    @property
    def has_one_sided_stoppers(self) -> bool:
        """Return whether stoppers of legs in the air only push, so that a leg can leave its
        stopper.
        """
        return self.stoppers == STOPPERS_ONE_SIDED

    @property
    def uses_paper_rule(self) -> bool:
        """Return whether infinite friction means the paper's rule."""
        return self.infinite_friction_rule == FRICTION_PAPER_RULE

    def default_start(self, params: WheelParams) -> FullState:
        """Return a full section state close to the paper's gait of Table 1."""
        return embed_section_state(
            params.symbols(), jnp.asarray(PAPER_START_STATE, params.damping.dtype)
        )

    def section_size(self, params: WheelParams) -> int:
        return full_section_size(params.n_legs)

    def n_continuous(self, params: WheelParams) -> int:
        return full_section_size(params.n_legs) - params.n_legs

    def section_units(self, units: WheelUnits, n_legs: int) -> list[Elementwise]:
        return compute_section_units(units, n_legs)

    def embed_section(self, params: WheelParams, x: Array) -> FullState:
        """Return the full section state of `x`, which may be the paper's (theta-, dtheta-,
        dL1-).
        """
        return _embed_compiled(params, x) if x.shape == (3,) else x

    def split_ground(self, params: WheelParams, n_steps: int) -> StepGroundValues | None:
        """Return the ground of each step, or None on flat ground of one friction.

        The ground is (slope, friction, friction of the earlier feet, tilt of the next line), each
        of shape (n_steps,).
        """
        slope, friction = params.slope, self.friction
        if slope.ndim == friction.ndim == 0:
            return None
        is_flat = slope.ndim == 0
        line_slopes = (
            jnp.full(n_steps + 1, slope) if is_flat else complete_line_slopes(slope, n_steps)
        )
        if friction.ndim:
            check_stepwise_shape(FRICTION_NAME, friction, n_steps)
        friction = jnp.broadcast_to(friction[:n_steps] if friction.ndim else friction, n_steps)
        previous_friction = jnp.append(friction[:1], friction[:-1])
        return line_slopes[:-1], friction, previous_friction, line_slopes[1:] - line_slopes[:-1]

    def with_ground(
        self, params: WheelParams, step_ground: StepGroundValues
    ) -> tuple["UnilateralWheel", WheelParams]:
        slope, friction, previous_friction, tilt = step_ground
        model = dataclasses.replace(
            self, friction=friction, uneven=UnevenGround(previous_friction, tilt)
        )
        return model, eqx.tree_at(lambda wheel: wheel.slope, params, slope)

    def advance(self, params: WheelParams, x: FullState, options: StepOptions) -> AdvanceResult:
        outputs, engine = self._compute_step(params, x, options, is_detailed=False)
        section_state, durations, outcome, solver_steps = outputs
        return AdvanceResult(section_state, durations, outcome, solver_steps, engine=engine)

    def take_step(self, params: WheelParams, x: FullState, options: StepOptions) -> UnilateralStep:
        return self._compute_step(params, x, options, is_detailed=True)[0]

    def _compute_step(
        self, params: WheelParams, x: FullState, options: StepOptions, is_detailed: bool
    ) -> tuple[Any, str]:
        """Return the outputs of a step, and the name of the engine that computed them."""
        leaves, argument_structure = self._flatten_arguments(params, x, options)
        engine = "lanes" if can_use_batch_kernel(options) else "diffrax"
        return eqx.combine(*_compile_step(argument_structure, is_detailed, engine)(*leaves)), engine

    def _flatten_arguments(
        self, params: WheelParams, x: FullState, options: StepOptions
    ) -> tuple[list, Any]:
        """Return the leaves and the tree structure of (wheel, params, x, options)."""
        # `dataclasses.replace` would validate friction again, which may be traced.
        model = eqx.tree_at(lambda wheel: wheel.friction, self, self.friction.astype(x.dtype))
        return jax.tree.flatten((model, params, x, options))

    def sample_step(
        self, params: WheelParams, x: FullState, options: StepOptions, n_samples: int
    ) -> UnilateralTrajectory:
        if can_use_batch_kernel(options):
            leaves, argument_structure = self._flatten_arguments(params, x, options)
            samples = build_contact_step_sampler(argument_structure, n_samples)(*leaves)
        else:
            samples = self._sample_with_diffrax(params, x, options, n_samples)
        interval_log, step_summary = samples.log, samples.summary
        start_times = jnp.concatenate([jnp.zeros((1,)), jnp.cumsum(interval_log.duration)[:-1]])
        return UnilateralTrajectory(
            time=start_times[:, None]
            + jnp.linspace(0.0, 1.0, n_samples) * interval_log.duration[:, None],
            state=samples.state,
            contact=interval_log.contact,
            locked=interval_log.locked,
            tangential=samples.tangential,
            normal=samples.normal,
            duration=interval_log.duration,
            section_state=step_summary.section_state,
            step_length=step_summary.step_length,
            outcome=samples.outcome,
        )

    def _sample_with_diffrax(
        self, params: WheelParams, x: FullState, options: StepOptions, n_samples: int
    ) -> SampledIntervals:
        """Return the samples of a step, integrated by diffrax."""
        event_loop_state = _run_event_loop(
            self, params, x, options, is_detailed=False, has_log=True
        )
        log, outcome = event_loop_state.log, event_loop_state.outcome
        assert log is not None
        tilt = None if self.uneven is None else self.uneven.tilt
        s, friction = params.symbols(), _foot_friction(self, self.friction)

        def sample_logged_interval(log: IntervalLog) -> tuple:
            no_leg_flags = jnp.zeros((s.n,), bool)
            dynamics = make_mode_dynamics(
                s,
                friction,
                False,
                ContactState(log.contact, log.locked, no_leg_flags, no_leg_flags, no_leg_flags),
            )
            state_and_time_units = compute_packed_units(s), compute_wheel_units(s).time
            sampling_arguments = (
                partial(vector_field, dynamics),
                log.state,
                log.duration,
                n_samples,
                options,
                *state_and_time_units,
            )

            def compute_foot_forces(state: PackedState) -> tuple:
                solution = compute_forces(dynamics, unpack_state(state)[0]).solution
                return dynamics.contact_slots.scatter(
                    solution.tangential
                ), dynamics.contact_slots.scatter(solution.normal)

            states = sample_in_units(*sampling_arguments)
            return states, *jax.vmap(compute_foot_forces)(states)

        section_state, durations, *_ = _make_minimal_result(event_loop_state, tilt)
        landing_place = landing_position(s.n, unpack_state(event_loop_state.state)[0])
        step_length = jnp.where(outcome == Outcome.STEPPED, landing_place, 0.0)
        step_summary = StepSummary(section_state, durations, step_length)
        return SampledIntervals(log, step_summary, outcome, *lax.map(sample_logged_interval, log))


def _foot_friction(wheel: UnilateralWheel, friction: Elementwise) -> Friction:
    """Return the coefficient of friction of all feet, or a pair: of the foot that landed last and
    of the others.
    """
    friction = apply_friction_rule(friction, wheel.uses_paper_rule)
    if wheel.uneven is None:
        return friction
    return friction, apply_friction_rule(wheel.uneven.friction, wheel.uses_paper_rule)


def _run_event_loop(
    wheel: UnilateralWheel,
    params: WheelParams,
    x: FullState,
    options: StepOptions,
    is_detailed: bool,
    has_log: bool = False,
) -> _EventLoopState:
    """Return the state of the event loop at the end of the step."""
    tilt = None if wheel.uneven is None else wheel.uneven.tilt
    is_valid, params, friction, x = replace_invalid_start(params, wheel.friction, x, tilt)
    s, n = params.symbols(), params.n_legs
    law_arguments = s, _foot_friction(wheel, friction), options, wheel.has_one_sided_stoppers
    contact_law = make_contact_law(*law_arguments, True, wheel.restitution, tilt)
    guard_layout = make_guard_layout(n, wheel.has_one_sided_stoppers)
    motion, contact_state = unpack_section_state(s, x)
    float_zero = jnp.zeros_like(motion.theta)
    state = pack_state(motion, Accumulators(float_zero, float_zero, float_zero, float_zero))
    allocate = lambda leaf: jnp.broadcast_to(leaf, (wheel.max_events, *leaf.shape))
    log_template = IntervalLog(
        state, jnp.zeros((n,), jnp.int32), jnp.zeros((n,), bool), jnp.zeros_like(x[0])
    )
    initial_state = _EventLoopState(
        state=state,
        contact_state=contact_state,
        guard=jnp.int32(guard_layout.landing),
        outcome=jnp.where(is_valid, Outcome.STEPPED, Outcome.BAD_INPUT).astype(jnp.int32),
        is_running=is_valid,
        counters=init_counters(x[0]),
        details=init_details(x.dtype) if is_detailed else None,
        log=jax.tree.map(allocate, log_template) if has_log else None,
    )
    advance = partial(_advance_to_event, contact_law, guard_layout, wheel.max_events, options)
    return lax.while_loop(
        lambda event_loop_state: opaque_condition(
            event_loop_state.is_running, event_loop_state.counters.n_events
        ),
        advance,
        initial_state,
    )


def _advance_to_event(
    contact_law: ContactLaw,
    guard_layout: GuardLayout,
    max_events: int,
    options: StepOptions,
    event_loop_state: _EventLoopState,
) -> _EventLoopState:
    """Return the state of the event loop at the next event."""
    motion, accumulators = unpack_state(event_loop_state.state)
    event_arguments = event_loop_state.guard, event_loop_state.counters.n_events, max_events
    event_result, event, outcome = process_event(
        contact_law, guard_layout, motion, event_loop_state.contact_state, *event_arguments
    )
    dynamics = make_mode_dynamics(
        contact_law.s,
        contact_law.friction,
        contact_law.is_one_sided,
        event_result.contact_state,
        tilt=contact_law.tilt,
    )
    is_valid = outcome == Outcome.STEPPED
    start_state = pack_state(
        event_result.motion,
        accumulators._replace(time_since_event=jnp.zeros_like(accumulators.time_since_event)),
    )
    start_state = jnp.where(is_valid, start_state, event_loop_state.state)
    guard_spec = MonitoredFunctions(
        partial(compute_guard_values, dynamics),
        guard_layout.n_guards,
        guard_scales=compute_guard_scales(dynamics),
    )
    units = compute_packed_units(dynamics.s), compute_wheel_units(dynamics.s).time
    interval_end = integrate_in_units(
        partial(vector_field, dynamics), guard_spec, start_state, is_valid, options, *units
    )

    counters = event_loop_state.counters._replace(n_events=event_loop_state.counters.n_events + 1)
    counters = add_interval(
        counters, event_result.contact_state, interval_end.duration, interval_end.solver_steps
    )
    end_forces = (
        compute_forces(dynamics, event_result.motion),
        compute_forces(dynamics, unpack_state(interval_end.state)[0]),
    )
    determinant_before, determinant_after = (
        lax.stop_gradient(event_arguments.solution.painleve_determinant)
        for event_arguments in end_forces
    )
    # At the singularity, forces change sign without passing through zero.
    is_singular = is_at_singularity(determinant_before, determinant_after, options)
    failure_outcome = jnp.where(
        interval_end.timed_out, Outcome.NO_TOUCHDOWN_IN_TIME, Outcome.SOLVER_FAILED
    )
    failure_outcome = jnp.where(
        is_valid, jnp.where(is_singular, Outcome.PAINLEVE_PARADOX, failure_outcome), outcome
    )
    end_motion, end_solution = unpack_state(interval_end.state)[0], end_forces[1].solution
    rates = lax.stop_gradient(pack_coordinates(end_motion)[1])
    accelerations = lax.stop_gradient([*end_solution.hub_vector, *end_solution.length_motion])
    guard = choose_stopping_guard(guard_layout, dynamics, rates, interval_end.guard, options.atol)
    is_resting = is_wheel_at_rest(dynamics.s, rates, accelerations, options.atol)
    has_event = is_valid & (guard >= 0) & ~is_singular
    has_landed = has_event & (guard == guard_layout.foremost_landing)
    outcome_arguments = counters, guard_layout, has_event, guard, has_landed, failure_outcome
    outcome = determine_interval_outcome(*outcome_arguments, is_resting, max_events)
    details, log = event_loop_state.details, event_loop_state.log
    if details is not None:
        details = record_event(
            details, event_loop_state.counters.n_events == 0, event_result, event
        )
        stopper_forces = [
            min_stopper_force(dynamics, event_arguments) for event_arguments in end_forces
        ]
        details = record_interval(
            details, dynamics.slot_modes, interval_end.duration, jnp.minimum(*stopper_forces)
        )
    if log is not None:
        log_entry = IntervalLog(
            start_state,
            event_result.contact_state.contact_modes,
            event_result.contact_state.locked,
            interval_end.duration,
        )
        log = jax.tree.map(
            lambda log_leaf, entry_leaf: log_leaf.at[event_loop_state.counters.n_events].set(
                entry_leaf
            ),
            log,
            log_entry,
        )
    return _EventLoopState(
        state=interval_end.state,
        contact_state=event_result.contact_state,
        guard=guard,
        outcome=outcome.astype(jnp.int32),
        is_running=(outcome == Outcome.STEPPED) & ~has_landed,
        counters=counters,
        details=details,
        log=log,
    )


_embed_compiled = jax.jit(lambda params, x: embed_section_state(params.symbols(), x))


@functools.cache
def _compile_step(argument_structure: Any, is_detailed: bool, engine: str) -> ForwardFunction:
    """Return the step over the leaves of (wheel, params, x, options), differentiable in any
    mode.
    """

    def compute_step(tightens_tolerances: bool, *leaves: Array) -> tuple:
        wheel, params, x, options = jax.tree.unflatten(argument_structure, leaves)
        options = options.with_derivative_tolerances() if tightens_tolerances else options
        event_loop_state = _run_event_loop(wheel, params, x, options, is_detailed)
        tilt = None if wheel.uneven is None else wheel.uneven.tilt
        outputs = (
            _make_full_result(event_loop_state, engine, tilt)
            if is_detailed
            else _make_minimal_result(event_loop_state, tilt)
        )
        return eqx.partition(outputs, eqx.is_inexact_array)

    step_fn, tight_step_fn = partial(compute_step, False), partial(compute_step, True)
    if engine == "diffrax":
        return enable_all_ad_modes(step_fn, tight_step_fn)
    static_config = argument_structure, is_detailed
    return enable_all_ad_modes(
        build_contact_step_function(*static_config),
        tight_step_fn,
        partial(build_contact_step_jacobian, *static_config),
    )


def _make_minimal_result(event_loop_state: _EventLoopState, tilt: Elementwise | None) -> tuple:
    """Return section state, durations, outcome and number of solver steps of a step."""
    counters = event_loop_state.counters
    final_state = unpack_state(event_loop_state.state)[0], event_loop_state.contact_state
    section_state = final_section_state(*final_state, event_loop_state.outcome, tilt)
    return section_state, counters.durations, event_loop_state.outcome, counters.n_solver_steps


def _make_full_result(
    event_loop_state: _EventLoopState, engine: str, tilt: Elementwise | None
) -> UnilateralStep:
    """Return all results of a step."""
    motion, accumulators = unpack_state(event_loop_state.state)
    assert event_loop_state.details is not None
    records = event_loop_state.counters, event_loop_state.details, event_loop_state.outcome
    return make_unilateral_step(
        motion, event_loop_state.contact_state, accumulators, *records, engine, tilt
    )

"""Model of the wheel with unilateral contact and Coulomb friction, for any order of events.

To sample a step, a JAX program advances from event to event and records the start of each interval.
Every interval is then integrated again, from sample to sample.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax import lanes
from vrw_jax.base.checks import check_choice, check_int, check_reals, check_type
from vrw_jax.base.elementwise import Elementwise, RealInput, Scalar, make_opaque_loop_condition
from vrw_jax.base.options import ParameterDomain, StepOptions
from vrw_jax.base.walker import AdvanceResult
from vrw_jax.flow.phase_integration import sample_phase
from vrw_jax.flow.solver_steps import (
    ButcherTableau,
    StageState,
    divide_equally,
    sample_between_intervals,
)
from vrw_jax.models.contact_integrator import make_contact_phase
from vrw_jax.models.contact_kernel import (
    advance_to_events,
    init_lane_states,
)
from vrw_jax.models.contact_mechanics import (
    find_contact_slots,
    pack_motion,
    unpack_motion,
)
from vrw_jax.models.contact_record import (
    FullState,
    UnilateralStep,
    compute_full_section_size,
    compute_section_foot_distance,
    compute_section_units,
    embed_section_state,
)
from vrw_jax.models.contact_state import (
    N_LOSSES,
    ContactModeDynamics,
    ContactQuantities,
    ContactState,
    EnergyLossAccumulators,
    compute_contact_quantities,
    compute_packed_units,
    evaluate_vector_field,
    pack_state,
    unpack_state,
)
from vrw_jax.models.contact_walks import (
    call_with_one_lane,
    make_column_function,
    prepare_walk,
    take_contact_steps,
)
from vrw_jax.models.interface import (
    AbstractWheel,
    StepGroundValues,
    complete_ground_line_slopes,
    compute_rises,
    require_stepwise_shape,
)
from vrw_jax.models.step_results import PAPER_START_STATE
from vrw_jax.models.viscoelastic import can_use_batch_kernel, select_engine
from vrw_jax.wheel.laws import (
    convert_hub_torque,
    convert_leg_force,
    takes_angle,
)
from vrw_jax.wheel.params import (
    FRICTION_DOMAIN,
    FRICTION_NAME,
    WheelParams,
    WheelUnits,
    compute_wheel_units,
    convert_friction,
)
from vrw_jax.wheel.transitions import ContactMode

STOPPERS_BILATERAL, STOPPERS_ONE_SIDED = "bilateral", "one-sided"
"""Kinds of stoppers for legs in the air: they hold the leg with any force, or they only push."""
FRICTION_LIMIT, FRICTION_PAPER_RULE = "limit", "paper"
"""Meaning of infinite friction: limit of large friction, or rule (A1)-(A4) of the paper."""


def convert_torque_of_rate(hub_torque: Any) -> Any:
    """Return a law of the hub, or raise an error if it depends on the angle."""
    hub_torque = convert_hub_torque(hub_torque)
    if takes_angle(hub_torque):
        raise ValueError(
            "hub_torque depends on the angle, but with unilateral contact any leg may stand: give "
            "a torque f(dtheta, params) of the rate, or take vrw.ViscoelasticWheel."
        )
    return hub_torque


class UnilateralTrajectory(eqx.Module):
    """Motion during one step with unilateral contact, sampled between events.

    The axes are (phase, sample). A phase that did not happen has duration 0. The origin is the
    position of the landing at which the step starts.
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
    model_selection: dict[str, Array] = eqx.field(default_factory=dict)  # see `ModelChoice`


class UnevenGround(NamedTuple):
    """Uneven ground of one step: friction under earlier feet, and the ground ahead."""

    friction: Scalar  # friction coefficient of the feet that landed earlier
    # angle by which the next line is steeper, rad, or two rises (`models.select_stance_line`), m
    ground_values: tuple[Scalar, ...]


def _convert_restitution(restitution_coefficient: Any) -> Array | None:
    """Return Newton's coefficient of restitution as an array; None if it is None or 0.

    A value outside [0, 1] raises a ValueError.
    """
    if restitution_coefficient is None or (
        isinstance(restitution_coefficient, float | int) and restitution_coefficient == 0
    ):
        return None
    restitution = check_reals("restitution", restitution_coefficient)
    if not isinstance(restitution, jax.core.Tracer) and not jnp.all(
        (restitution >= 0.0) & (restitution <= 1.0)
    ):
        raise ValueError(
            f"restitution is {restitution_coefficient}, but it is a ratio of speeds: give a number "
            "from 0 to 1."
        )
    return restitution


class AbstractContactWheel(AbstractWheel):
    """Model whose section state is the full section state, with a contact mode for each leg."""

    friction: eqx.AbstractVar[Scalar]
    reports_contacts: ClassVar[bool] = True

    @property
    def own_parameters(self) -> Any:
        return self.laws, self.friction

    @property
    def own_parameter_domains(self) -> dict[str, ParameterDomain]:
        return super().own_parameter_domains | {FRICTION_NAME: FRICTION_DOMAIN}

    def _replace_own_parameters(self, values: Any) -> "AbstractContactWheel":
        *law_values, friction = values
        model = super()._replace_own_parameters(law_values)
        return eqx.tree_at(lambda model: model.friction, model, friction)

    def explain_impossible_gait(self, params: WheelParams) -> str:
        """Return a sentence that states why one wheel can't have a gait, or "" if it may have one.

        During a period T of a gait of total mass M, the momentum along the slope changes by
        M g sin(slope) T plus the sum of the tangential impulses on the feet. The normal impulses
        sum to M g cos(slope) T. Coulomb's law limits every tangential force and impulse to friction
        times the normal one. The momentum is the same after a period only if friction is at least
        tan(slope).
        """
        friction, required_friction = float(self.friction), math.tan(float(params.slope))
        if friction >= required_friction:
            return super().explain_impossible_gait(params)
        return (
            f"No steady gait can exist: friction is {friction:g}, below tan(slope) = "
            f"{required_friction:.4g}, so the wheel slides down faster with each step."
        )

    def compute_default_start(self, params: WheelParams) -> FullState:
        """Return a full section state near the gait of the wheel in Table 1 of the paper."""
        return embed_section_state(
            params.symbols(), jnp.asarray(PAPER_START_STATE, params.damping.dtype)
        )

    def count_section_entries(self, params: WheelParams) -> int:
        return compute_full_section_size(params.n_legs)

    def count_continuous_section_entries(self, params: WheelParams) -> int:
        return compute_full_section_size(params.n_legs) - params.n_legs

    def collect_section_units(self, wheel_units: WheelUnits, n_legs: int) -> list[Elementwise]:
        return compute_section_units(wheel_units, n_legs)

    def compute_foot_distance(self, params: WheelParams, x: Array) -> Elementwise:
        return compute_section_foot_distance(params.symbols(), x)

    def complete_section_state(self, params: WheelParams, x: Array) -> FullState:
        """Return the full section state for `x`, shape (4 + 3 n,).

        `x` may be a full section state or (theta-, dtheta-, dL1-), the section state of the paper.
        """
        return _embed_section_compiled(params, x) if x.shape == (3,) else x


class UnilateralWheel(AbstractContactWheel):
    """Model of the wheel with unilateral contact and Coulomb friction.

    Feet push on the ground and slide by Coulomb's law. The events may have any order, and every
    foot may land, slide or lift off.

    - `friction`: friction coefficient of the ground, `inf` for infinite friction (see
      `infinite_friction_rule`);
    - `max_events`: largest number of events in one step. A contact slower than the rest speed comes
      to rest. The rest speed of legs and of landing feet grows with each event after a quarter of
      this number, or after 100 events if that is more;
    - `stoppers`: if "bilateral", a leg in the air that has reached its stopper stays there until
      its foot is loaded. If "one-sided", the leg leaves the stopper as soon as the stopper would
      have to pull;
    - `restitution`: ratio of a striking foot's normal speeds after and before the impact. The ratio
      is reduced if it would increase the energy. None has the effect of 0 and compiles to a smaller
      program;
    - `infinite_friction_rule`: meaning of infinite friction. "limit" is the limit of large
      friction. "paper" is the rule (A1) to (A4) of the paper, extended to cases that the rule does
      not cover;
    - `leg_force`, `hub_torque`: laws of the legs and of the hub, as in `ViscoelasticWheel`;
    - `uneven`: differences between footholds on uneven ground. `vrw.walk` sets this field from the
      slopes or heights and the friction coefficients of the steps.

    Examples:
        >>> wheel = vrw.UnilateralWheel(friction=0.7)
        >>> step = vrw.step(vrw.WheelParams(damping=300.0), vrw.paper_start(), model=wheel)
        >>> print(f"{step.slip:.2f} m of slip, {vrw.Outcome(int(step.outcome)).name}")
        0.04 m of slip, STEPPED
    """

    model_name: ClassVar[str] = "unilateral"
    commands = frozenset({"scan", "tune", "branch", "explore"})
    fixed_fields_of_tolerance = (  # type: ignore[assignment]
        "restitution",
        "infinite_friction_rule",
        "uneven",
        "max_events",
        "leg_force",
        "hub_torque",
    )
    batch_kernel: ClassVar[str] = "legs"

    friction: Scalar = eqx.field(converter=convert_friction, default=0.7)
    max_events: int = eqx.field(
        static=True, converter=partial(check_int, "max_events"), default=400
    )
    stoppers: str = eqx.field(static=True, default=STOPPERS_BILATERAL)
    restitution: Scalar | None = eqx.field(converter=_convert_restitution, default=None)
    infinite_friction_rule: str = eqx.field(static=True, default=FRICTION_LIMIT)
    leg_force: Any = eqx.field(converter=convert_leg_force, default=None)
    hub_torque: Any = eqx.field(converter=convert_torque_of_rate, default=None)
    uneven: UnevenGround | None = None

    if TYPE_CHECKING:

        def __init__(
            self,
            friction: RealInput = 0.7,
            max_events: int = 400,
            stoppers: Literal["bilateral", "one-sided"] = "bilateral",
            restitution: RealInput | None = None,
            infinite_friction_rule: Literal["limit", "paper"] = "limit",
            leg_force: Any = None,
            hub_torque: Any = None,
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
        """Return whether stoppers of legs in the air only push, so that legs can leave them."""
        return self.stoppers == STOPPERS_ONE_SIDED

    @property
    def uses_paper_rule(self) -> bool:
        """Return whether infinite friction means the rule (A1)-(A4) of the paper."""
        return self.infinite_friction_rule == FRICTION_PAPER_RULE

    def _split_uneven_ground(
        self, params: WheelParams, n_steps: int, heights: Array | None
    ) -> StepGroundValues | None:
        """Return the ground under each step, or None on flat ground with one friction coefficient.

        The result is (slope in rad, friction coefficient, friction coefficient of the feet that
        landed earlier, tilt of the next line in rad), each of shape (n_steps,). If heights are
        given, the slope is the mean slope, and the two rises in m replace the tilt.
        """
        slope, friction = params.slope, self.friction
        if slope.ndim == friction.ndim == 0 and heights is None:
            return None
        is_flat_ground = slope.ndim == 0
        line_slopes = (
            jnp.full(n_steps + 1, slope)
            if is_flat_ground
            else complete_ground_line_slopes(slope, n_steps)
        )
        if friction.ndim:
            require_stepwise_shape(FRICTION_NAME, friction, n_steps)
        friction = jnp.broadcast_to(friction[:n_steps] if friction.ndim else friction, n_steps)
        previous_friction = jnp.append(friction[:1], friction[:-1])
        if heights is not None:
            rises = compute_rises(heights, n_steps)
            return line_slopes[:-1], friction, previous_friction, rises[:-1], rises[1:]
        return line_slopes[:-1], friction, previous_friction, line_slopes[1:] - line_slopes[:-1]

    def _put_on_ground(
        self, params: WheelParams, step_ground: StepGroundValues
    ) -> tuple["UnilateralWheel", WheelParams]:
        slope, friction, previous_friction, *ground = step_ground
        uneven = UnevenGround(previous_friction, tuple(ground))
        model = dataclasses.replace(self, friction=friction, uneven=uneven)
        return model, eqx.tree_at(lambda wheel: wheel.slope, params, slope)

    def advance(self, params: WheelParams, x: FullState, options: StepOptions) -> AdvanceResult:
        step_outputs, engine = self._compute_step(params, x, options, is_detailed=False)
        section_state, durations, outcome, solver_steps = step_outputs
        return AdvanceResult(section_state, durations, outcome, solver_steps, engine=engine)

    def take_step(self, params: WheelParams, x: FullState, options: StepOptions) -> UnilateralStep:
        return self._compute_step(params, x, options, is_detailed=True)[0]

    def measure_force_peaks(
        self, params: WheelParams, x: FullState, options: StepOptions
    ) -> dict[str, Array]:
        step_result, _ = self._compute_step(
            params, x, options, is_detailed=True, measures_force_peaks=True
        )
        return step_result.force_peaks.compute_force_measures() | {
            "landing_impulse": step_result.landing_normal[..., 0]
        }

    def _compute_step(
        self,
        params: WheelParams,
        x: FullState,
        options: StepOptions,
        is_detailed: bool,
        measures_force_peaks: bool = False,
    ) -> tuple[Any, str]:
        """Return the results of one step, and the name of the engine that computed them."""
        engine = select_engine(options)
        take_step = _compile_step(is_detailed, engine, measures_force_peaks)
        return take_step(self._without_laws(x), self.attach_laws(params), x, options), engine

    def _without_laws(self, x: FullState) -> "UnilateralWheel":
        """Return the model for a program, which takes the laws as part of the parameters."""
        # `dataclasses.replace` would validate friction again, which may be traced.
        friction = self.friction.astype(x.dtype)
        return eqx.tree_at(lambda wheel: wheel.friction, self.with_laws(None), friction)

    def sample_step(
        self, params: WheelParams, x: FullState, options: StepOptions, n_samples: int
    ) -> UnilateralTrajectory:
        sample_step = build_contact_step_sampler(not can_use_batch_kernel(options), n_samples)
        contact_interval_log, step_summary, outcome, states, tangential_forces, normal_forces = (
            sample_step(self._without_laws(x), self.attach_laws(params), x, options)
        )
        durations = contact_interval_log.durations
        start_times = jnp.concatenate([jnp.zeros((1,)), jnp.cumsum(durations)[:-1]])
        sample_times = jnp.linspace(0.0, 1.0, n_samples) * durations[:, None]
        return UnilateralTrajectory(
            time=start_times[:, None] + sample_times,
            state=states,
            contact=contact_interval_log.contact_state.contact_modes,
            locked=contact_interval_log.contact_state.is_leg_locked,
            tangential=tangential_forces,
            normal=normal_forces,
            duration=durations,
            section_state=step_summary.section_state,
            step_length=step_summary.step_length,
            outcome=outcome,
        )


_embed_section_compiled = jax.jit(lambda params, x: embed_section_state(params.symbols(), x))


@functools.cache
def _compile_step(is_detailed: bool, engine: str, measures_force_peaks: bool) -> Callable:
    """Return a compiled function of (wheel, params, x, options), differentiable in any mode."""
    settings = is_detailed, engine, measures_force_peaks
    take_element_step = call_with_one_lane(
        partial(take_contact_steps, partial(prepare_walk, *settings, True))
    )
    take_tight_step = lambda *arguments: take_element_step(
        *arguments[:-1], arguments[-1].with_derivative_tolerances()
    )
    if engine == "diffrax":
        return lanes.differentiate(take_element_step, take_tight_step)
    prepare = partial(prepare_walk, *settings, False)
    return lanes.differentiate(
        lanes.jit_batch(partial(take_contact_steps, prepare)),
        take_tight_step,
        partial(make_column_function, prepare),
    )


class ContactIntervalLog(NamedTuple):
    """Start and duration of each interval of a step; an interval is between two events."""

    q: Array  # coordinates at the start of each interval, (intervals, 3 + n)
    v: Array  # rates and losses in the step so far, (intervals, 3 + n + N_LOSSES)
    contact_state: ContactState
    durations: Array  # s


def sample_contact_interval(
    contact_mode_dynamics: ContactModeDynamics,
    q: Array,
    v: Array,
    duration: Array,
    n_samples: int,
    options: StepOptions,
    tableau: ButcherTableau,
) -> Array:
    """Return samples of one interval at equally spaced times, (samples, entries, batch).

    The first and the last sample are at the ends of the interval. The entries are coordinates,
    rates, losses, normal forces and tangential forces in the contact slots.

    - `q`, `v`: coordinates, and rates followed by losses at the start;
    - `duration`: length of the interval, s.
    """
    phase = make_contact_phase(contact_mode_dynamics, tableau, options)
    take_solver_step: Any = phase.take_solver_step

    def take_sample_step(state: StageState, h: Array) -> tuple[StageState, Array]:
        stage_states, squared_error = take_solver_step(state, h)
        return stage_states[-1], squared_error

    def pack_sample(state: StageState) -> Array:
        contact_quantities = ContactQuantities.unpack_rows(
            contact_mode_dynamics, state.acceleration.acceleration
        )
        slot_forces = contact_quantities.normal_forces, contact_quantities.tangential_forces
        return jnp.concatenate([state.q, state.v, *slot_forces])

    return sample_between_intervals(
        take_sample_step,
        pack_sample,
        phase.make_state(q, v),
        tableau,
        divide_equally(duration, n_samples),
        options,
    )


def sample_by_diffrax(
    contact_mode_dynamics: ContactModeDynamics,
    q: Array,
    v: Array,
    duration: Array,
    n_samples: int,
    options: StepOptions,
) -> Array:
    """Return the samples of `sample_contact_interval` for a single wheel, (samples, entries)."""
    losses = EnergyLossAccumulators(jnp.zeros_like(duration), *v[len(q) :])

    def pack_sample(packed_state: Array) -> Array:
        motion, (_, *losses) = unpack_state(packed_state)
        contact_quantities = compute_contact_quantities(contact_mode_dynamics, motion)
        slot_forces = contact_quantities.normal_forces, contact_quantities.tangential_forces
        return jnp.concatenate([*pack_motion(motion), jnp.stack(losses), *slot_forces])

    packed_states = sample_phase(
        functools.partial(evaluate_vector_field, contact_mode_dynamics),
        pack_state(unpack_motion(q, v), losses),
        duration,
        n_samples,
        compute_wheel_units(contact_mode_dynamics.s).scale_times_to_seconds(options),
        compute_packed_units(contact_mode_dynamics.s),
    )
    return jax.vmap(pack_sample)(packed_states)


@functools.cache
def build_contact_step_sampler(uses_diffrax: bool, n_samples: int) -> Callable[..., tuple]:
    """Return a function that samples a step from (wheel, params, x, options).

    The function returns (log, summary and outcome of the step, states, tangential forces, normal
    forces). The states are packed, (intervals, samples, entries), and the forces on all feet are in
    N, (intervals, samples, legs). The samples are at equally spaced times from the start to the end
    of each interval. The function has no derivatives.
    """

    prepare = functools.partial(prepare_walk, True, "lanes", False, uses_diffrax)

    def prepare_resolved(arguments: tuple) -> tuple:
        walk_settings, input_columns, x = prepare(*arguments)
        return walk_settings, walk_settings.resolve_heights(input_columns, x), x

    init_lane_state = lambda *arguments: init_lane_states(*prepare_resolved(arguments))[1]

    def advance_to_event(arguments: tuple, lane_state: Any) -> tuple[Any, ContactIntervalLog]:
        walk_settings, input_columns, x = prepare_resolved(arguments)
        start, lane_state = advance_to_events(
            walk_settings, walk_settings.replace_invalid_lanes(input_columns, x)[0], lane_state
        )
        n = len(start.q)
        return lane_state, ContactIntervalLog(
            start.q,
            jnp.concatenate([start.v[:n], start.step_record.losses]),
            start.contact_state,
            lane_state.interval_duration,
        )

    def sample_logged_interval(arguments: tuple, interval_log: ContactIntervalLog) -> Array:
        walk_settings, input_columns, x = prepare_resolved(arguments)
        q, v, contact_state, durations = interval_log
        dynamics = walk_settings.make_lane_contact_dynamics(
            walk_settings.replace_invalid_lanes(input_columns, x)[0], contact_state
        )
        arguments = dynamics, q, v, durations, n_samples, walk_settings.step_options
        if walk_settings.tableau is None:
            return sample_by_diffrax(*arguments)
        return sample_contact_interval(*arguments, walk_settings.tableau)

    def sample_whole_step(*arguments: Any) -> tuple:
        walk_settings, input_columns, _ = prepare_resolved(arguments)
        max_events = walk_settings.max_events
        initial_state = begin_compiled_walk(*arguments)
        log_template = jax.eval_shape(advance_compiled_walk, arguments, initial_state)[1]
        allocate_log_array = lambda leaf: jnp.zeros((max_events, *leaf.shape), leaf.dtype)

        def record_interval_end(loop_state: tuple) -> tuple:
            previous_state, contact_interval_log = loop_state
            lane_state, interval_entry = advance_compiled_walk(arguments, previous_state)
            entry_index = previous_state.step_record.events
            entry_index = jnp.where(
                lane_state.step_record.events > entry_index, entry_index, max_events
            )
            write_log_entry = lambda log_leaf, entry_leaf: log_leaf.at[entry_index].set(
                entry_leaf, mode="drop"
            )
            return lane_state, jax.tree.map(write_log_entry, contact_interval_log, interval_entry)

        should_continue = lambda state: make_opaque_loop_condition(
            state[0].is_unfinished, state[0].step_record.events
        )
        lane_state, contact_interval_log = lax.while_loop(
            should_continue,
            record_interval_end,
            (initial_state, jax.tree.map(allocate_log_array, log_template)),
        )
        step_summary = walk_settings.summarize_step(lane_state, input_columns)
        map_intervals = lax.map if uses_diffrax else lambda f, log: jax.vmap(f)(log)
        sample_rows = map_intervals(
            functools.partial(sample_compiled_intervals, arguments), contact_interval_log
        )
        interval_samples = _unpack_sample_rows(
            walk_settings.n_legs, contact_interval_log, sample_rows
        )
        return contact_interval_log, step_summary, lane_state.walk_outcome, *interval_samples

    compile_lanes = call_with_one_lane if uses_diffrax else lanes.jit_batch
    begin_compiled_walk = compile_lanes(init_lane_state)
    advance_compiled_walk = compile_lanes(advance_to_event)
    sample_compiled_intervals = (
        sample_logged_interval if uses_diffrax else lanes.jit_batch(sample_logged_interval)
    )
    return jax.jit(sample_whole_step)


def _unpack_sample_rows(
    n_legs: int, contact_interval_log: ContactIntervalLog, sample_rows: Array
) -> tuple[Array, Array, Array]:
    """Return packed states, tangential forces (N) and normal forces (N) of all legs, from samples.

    The axes are (intervals, samples, entries). `sample_rows` contains results of
    `sample_contact_interval`.
    """
    n, n_samples = 3 + n_legs, sample_rows.shape[1]
    q, v, losses, normal_forces, tangential_forces = jnp.split(
        jnp.moveaxis(sample_rows, -1, 0), (n, 2 * n, 2 * n + N_LOSSES, 2 * n + N_LOSSES + 2)
    )
    time_since_event = jnp.linspace(0.0, 1.0, n_samples) * contact_interval_log.durations[:, None]
    packed_states = pack_state(
        unpack_motion(q, v), EnergyLossAccumulators(time_since_event, *losses)
    )
    contact_modes = contact_interval_log.contact_state.contact_modes.T[..., None]
    scatter_to_legs = find_contact_slots(contact_modes != ContactMode.OFF).scatter_to_legs
    legs_first = packed_states, scatter_to_legs(tangential_forces), scatter_to_legs(normal_forces)
    return tuple(jnp.moveaxis(x, 0, -1) for x in legs_first)  # type: ignore[return-value]

"""The paper's step in batches: one source for machine code and GPUs, values and derivatives.

The phases are those of the diffrax engine; arrays hold one quantity of all wheels instead of the
quantities of one wheel. `build_step_function` returns a function of one wheel that `jax.vmap` maps
onto lanes, for use in JAX programs.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from vrw_jax import simd
from vrw_jax.integrator import (
    BatchPhase,
    ButcherTableau,
    ImplicitDynamics,
    MarginFunctions,
    StageAcceleration,
    StageState,
    integrate_batch_phase,
    load_explicit_tableau,
    sample_batch_phase,
    with_batched_jvp,
)
from vrw_jax.models.phase_sequence import (
    PAPER_START,
    PhaseResult,
    PhaseSequenceResult,
    make_advance_result,
    make_step_result,
    make_trajectory,
    next_section,
    run_phases,
)
from vrw_jax.models.step_results import (
    AdvanceResult,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    StepResult,
    Trajectory,
)
from vrw_jax.numerics import (
    BatchFunction,
    ForwardFunction,
    StepOptions,
    Vector,
    sine_cosine,
    unbatch,
)
from vrw_jax.runtime import cached_lane_function
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    AbstractPhase,
    Motion,
    Outcome,
    PhaseInstant,
    SingleSupport1,
    Symbols,
    WheelParams,
    transitions,
)

MAX_FIRST_STEP_RATIO = 0.3
"""Upper bound of the first solver step of SLS-I, as a fraction of the last solver step of DLS."""
FAST_MODE_STEP_FACTOR = 7.0
"""Upper bound of the same step, in units of m/c times the tolerance's root of the solver's order.
Dropping the rear foot's force excites the airborne leg's fast mode, which decays within 0.05 s.
The value was chosen because the controller settles at 7.2 to 9.5. This holds for solvers of
orders 5 to 8, at tolerances of 1e-4 to 1e-10. A longer step is repeated."""


class BatchAdvanceResult(NamedTuple):
    """Minimal results of one gait step of every lane."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    outcome: Int[Array, " lanes"]  # an Outcome
    solver_steps: Int[Array, " lanes"]
    is_unfinished: Bool[Array, " lanes"]  # stragglers not completed: their other fields are void


class _PhaseCarry(NamedTuple):
    """Data passed from one phase to the next."""

    next_dt: Array  # step size that the controller proposes next, s
    has_run: Bool[Array, " lanes"]  # where the phase took place
    is_unfinished: Bool[Array, " lanes"]


def make_lane_phase(
    phase: AbstractPhase, records_margins: bool, is_noinline: bool = False
) -> BatchPhase:
    """Return a phase in the form of the batched integrator.

    - `records_margins`: evaluate its margins in addition to its guards.
    """

    def evaluate(q: Vector, v: Vector) -> StageAcceleration:
        sin, cos = sine_cosine(q[0])
        return StageAcceleration(
            sin, cos, phase.acceleration(phase.complete_motion(sin, cos, q, v))[: phase.n_dof]
        )

    def motion(stage: StageState) -> Motion:
        return phase.complete_motion(
            stage.acceleration.sin, stage.acceleration.cos, stage.q, stage.v
        )

    def instant(stage: StageState) -> PhaseInstant:
        return PhaseInstant(phase, motion(stage), stage.acceleration.acceleration)

    implicit_dynamics = ImplicitDynamics(
        lambda stage: phase.dynamics_residual(motion(stage), stage.acceleration.acceleration),
        lambda stage, rows: phase.solve_dynamics(motion(stage), rows),
    )
    margins = lambda stage: phase.margins(instant(stage))
    monitored_margins = (
        MarginFunctions(margins, phase.margins_counted_at_start) if records_margins else None
    )
    guards = lambda stage: phase.guards(instant(stage))
    return BatchPhase(evaluate, guards, monitored_margins, implicit_dynamics, is_noinline)


def gait_step(
    params: WheelParams,
    x: Vector,
    options: StepOptions,
    tableau: ButcherTableau,
    stop_at_lift_off: bool,
    straggler_count: Array | None = None,
) -> BatchAdvanceResult:
    """Return one gait step of every lane, from touchdown to touchdown.

    - `straggler_count`: see `integrate_batch_phase`.
    """
    sequence = run_batch_phases(
        params,
        x,
        options,
        tableau,
        stop_at_lift_off,
        records_margins=False,
        straggler_count=straggler_count,
    )
    ends, has_stepped = sequence.ends, sequence.outcome == Outcome.STEPPED
    section = next_section(sequence)
    return BatchAdvanceResult(
        section_state=tuple(jnp.where(has_stepped, value, 0.0) for value in section),
        durations=tuple(end.duration for end in ends),
        outcome=sequence.outcome,
        solver_steps=ends[0].n_solver_steps + ends[1].n_solver_steps + ends[2].n_solver_steps,
        is_unfinished=ends[0].engine_carry.is_unfinished
        | ends[1].engine_carry.is_unfinished
        | ends[2].engine_carry.is_unfinished,
    )


class LandingStep(NamedTuple):
    """A step of every lane from just after a landing with both feet on the ground, and the next
    landing."""

    numbers: Array
    """(theta+, dtheta+) just after the next landing, rad, rad/s; normal impulse of the rear foot in
    it, both feet held, N s; `stopper_margin`, m^2/s: rows of lanes, zeros where not STEPPED but for
    the last."""
    outcome: Int[Array, " lanes"]
    durations: Vector
    solver_steps: Int[Array, " lanes"]
    unfinished: Bool[Array, " lanes"]


def step_after_landing(
    params: WheelParams,
    y: Vector,
    options: StepOptions,
    tableau: ButcherTableau,
    stop_at_lift_off: bool,
    few: Array | None = None,
) -> LandingStep:
    """One step of every lane from y = (theta+, dtheta+), in the frame of the line under both feet,
    to just after the next landing, in the frame of the line ahead (see `split_slopes`)."""
    theta, dtheta = y
    x = theta + params.leg_angle, dtheta, 0.0 * dtheta
    given = options, tableau, stop_at_lift_off, False, few
    walked = run_batch_phases(params, x, *given, land=transitions.stand_on_both)
    ends, stepped = walked.ends, walked.outcome == Outcome.STEPPED
    at_landing = tuple(
        jnp.where(stepped, own, jnp.asarray(safe, own.dtype))
        for own, safe in zip(next_section(walked), PAPER_START, strict=True)
    )
    next_ = with_batched_jvp(transitions.land)(walked.s, *at_landing)
    rows = next_.theta, next_.motion.dtheta, next_.rear_impulse.normal
    told = [jnp.where(stepped, row, 0.0) for row in rows]
    sls1 = walked.phases[1]
    margin = with_batched_jvp(_stopper_margin)(walked.s, sls1.turn, ends[1].q, ends[1].v)
    margin = jnp.where(walked.phases_happened[1], margin, 0.0)
    return LandingStep(
        numbers=jnp.stack([*told, margin]),
        outcome=walked.outcome,
        durations=tuple(end.duration for end in ends),
        solver_steps=ends[0].n_solver_steps + ends[1].n_solver_steps + ends[2].n_solver_steps,
        unfinished=ends[0].engine_carry.is_unfinished
        | ends[1].engine_carry.is_unfinished
        | ends[2].engine_carry.is_unfinished,
    )


def _stopper_margin(s: Symbols, turn: Vector, q: Vector, v: Vector) -> Array:
    """How far SLS-I ended from meeting stopper and ground at once, m^2/s.

    Where Leg 2 met its stopper, its rate times the landing foot's height; where that foot landed
    before, minus its rate times the room that Leg 2 had left. Both vanish together, with equal
    derivatives.
    """
    phase = SingleSupport1(s, (), False, turn)
    motion = phase.motion_at(q, v)
    height, falls = phase.landing_height(motion), -phase.landing_rate(motion)
    return height * motion.dL2 - (s.L0 - motion.L2) * falls


def run_batch_phases(
    params: WheelParams,
    x: Vector,
    options: StepOptions,
    tableau: ButcherTableau,
    stop_at_lift_off: bool,
    records_margins: bool,
    straggler_count: Array | None = None,
    is_noinline: bool = False,
    land: Callable[..., transitions.Landing] = transitions.land,
) -> PhaseSequenceResult:
    """Return all phases of every lane's step.

    - `is_noinline`: see `BatchPhase`.
    """

    def run(
        phase: AbstractPhase, q: Vector, v: Vector, active: Array, previous_end: PhaseResult | None
    ) -> PhaseResult:
        dt0 = options.dt0 + jnp.zeros_like(q[0])
        if previous_end is not None:
            carry: _PhaseCarry = previous_end.engine_carry
            dt0 = carry.next_dt
            if phase.has_stiff_start:
                tolerance_root = jnp.exp(jnp.log(options.rtol.astype(jnp.float32)) / tableau.order)
                max_transient_dt = (
                    FAST_MODE_STEP_FACTOR * tolerance_root.astype(dt0.dtype) * phase.s.m / phase.s.c
                )
                dt0 = jnp.minimum(MAX_FIRST_STEP_RATIO * dt0, max_transient_dt)
                dt0 = jnp.where(carry.has_run, dt0, carry.next_dt)
        floats, static = eqx.partition((phase.s, phase.turn), eqx.is_array)

        def make_phase(floats: Any, constants: Vector) -> BatchPhase:
            s, turn = eqx.combine(floats, static)
            known = dataclasses.replace(phase, s=s, constants=constants, turn=turn)
            return make_lane_phase(known, records_margins, is_noinline)

        end = integrate_batch_phase(
            make_phase,
            floats,
            phase.constants,
            tableau,
            q,
            v,
            active,
            dt0,
            options,
            straggler_count,
        )
        return PhaseResult(
            *end.state[:2],
            duration=end.duration,
            guard=end.guard,
            is_timed_out=end.timed_out,
            n_solver_steps=end.n_tried_steps,
            margin_minima=end.minima,
            engine_carry=_PhaseCarry(end.next_dt, active, end.is_unfinished),
        )

    return run_phases(run, params, x, stop_at_lift_off, with_batched_jvp(land))


def can_use_lanes(options: StepOptions) -> bool:
    """Return whether the batch kernel can take the step: machine code and an explicit solver.

    Raises `ValueError` if the options require that engine and it is not available.
    """
    is_explicit = load_explicit_tableau(options.solver) is not None
    if options.engine == "lanes" and not (is_explicit and simd.is_available()):
        raise ValueError(
            f"engine is 'lanes', which needs a CPU and an explicit solver, but the solver is "
            f"{options.solver} on a {jax.default_backend()}: take engine='diffrax'."
        )
    return is_explicit and simd.is_available() and options.engine != "diffrax"


class _StaticConfig(NamedTuple):
    """Static configuration of a batched step: what it depends on besides its arrays."""

    structure: Any  # of (params, x, options), whose leaves are the arrays
    stop_at_lift_off: bool
    friction: float | None  # for margins; None for the minimal result

    @property
    def cache_key(self) -> tuple:
        """Cache key of the trace, by `repr`."""
        return str(self.structure), self.stop_at_lift_off, self.friction

    def run(self, *leaves: Array) -> tuple[PhaseSequenceResult, ButcherTableau, StepOptions]:
        """Return the step over lanes, which the leaves have on their last axis, with tableau and
        options.
        """
        params, x, options = jax.tree.unflatten(self.structure, leaves)
        tableau = load_explicit_tableau(options.solver)
        assert tableau is not None  # checked by `can_use_lanes`
        records_margins = self.friction is not None
        arguments = params, tuple(x), options, tableau, self.stop_at_lift_off, records_margins
        return run_batch_phases(*arguments, is_noinline=True), tableau, options

    def compute_outputs(self, *leaves: Array) -> tuple:
        """Return the outputs of the step, floats first."""
        sequence, friction = self.run(*leaves)[0], self.friction
        if friction is None:
            return eqx.partition(make_advance_result(sequence, "lanes"), eqx.is_inexact_array)
        ends = tuple(end._replace(engine_carry=None) for end in sequence.ends)
        moving_sequence = sequence._replace(phases=(), starts=(), ends=ends)  # only floats
        result = with_batched_jvp(lambda sequence: make_step_result(sequence, friction, "lanes"))(
            moving_sequence
        )
        return eqx.partition(result, eqx.is_inexact_array)

    def make_template(self, *leaves: Array) -> tuple:
        """Return arrays in the structure of `compute_outputs`."""
        x = leaves[0]
        codes = jnp.zeros_like(x, jnp.int32)
        pair, triple = (jnp.broadcast_to(x, (n, *x.shape)) for n in (2, 3))
        result: Any = AdvanceResult(triple, triple, codes, codes, engine="lanes")
        if self.friction is not None:
            result = StepResult(
                section_state=triple,
                post_impact=pair,
                durations=triple,
                step_length=x,
                indicators=_fill_fields(DoubleSupportIndicators, x),
                margins=_fill_fields(Margins, x),
                energy=_fill_fields(EnergyLoss, x),
                outcome=codes,
                solver_steps=codes,
                engine="lanes",
            )
        return eqx.partition(result, eqx.is_inexact_array)


def _fill_fields(record_type: Any, x: Array) -> Any:
    """Return the record with `x` in all fields."""
    return record_type(*(x for _ in dataclasses.fields(record_type)))


def build_step_function(
    structure: Any, stop_at_lift_off: bool, friction: float | None
) -> ForwardFunction:
    """Return the step over the leaves of (params, x, options), as a forward rule for any AD
    mode.
    """
    config = _StaticConfig(structure, stop_at_lift_off, friction)
    cache_key = ("gait step", *config.cache_key)
    return unbatch(cached_lane_function(config.compute_outputs, config.make_template, cache_key))


def build_step_sampler(structure: Any, stop_at_lift_off: bool, n_samples: int) -> BatchFunction:
    """Return the step sampled at equal times of each phase, over the same leaves."""
    config = _StaticConfig(structure, stop_at_lift_off, None)

    def sample_lanes_of_step(*leaves: Array) -> Trajectory:
        sequence, tableau, options = config.run(*leaves)
        samples = [
            sample_batch_phase(
                make_lane_phase(phase, False), tableau, *start, end.duration, n_samples, options
            )
            for phase, start, end in zip(
                sequence.phases, sequence.starts, sequence.ends, strict=True
            )
        ]
        return make_trajectory(sequence, samples)

    def make_template(x: Array, *_: Array) -> Trajectory:
        rows = lambda *n: jnp.broadcast_to(x, (3, *n, *x.shape))
        n = n_samples
        sample_arrays = rows(n), rows(n, 6), rows(n, 4), rows(n, 3)
        return Trajectory(*sample_arrays, rows(), rows(), jnp.zeros_like(x, jnp.int32))

    return unbatch(
        cached_lane_function(
            sample_lanes_of_step, make_template, ("samples", *config.cache_key, n_samples)
        )
    )


def build_step_jacobian(
    structure: Any, stop_at_lift_off: bool, friction: float | None, input_indices: tuple[int, ...]
) -> ForwardFunction:
    """Return the Jacobian of `build_step_function`.

    It gives (Jacobian with respect to the leaves at `input_indices`, floats) and the other outputs.
    """
    config = _StaticConfig(structure, stop_at_lift_off, friction)

    def tighten_tolerances(*leaves: Array) -> list[Array]:
        params, x, options = jax.tree.unflatten(structure, leaves)
        return jax.tree.leaves((params, x, options.with_derivative_tolerances()))

    def make_template(*leaves: Array) -> tuple:
        value, other = config.make_template(*leaves)
        return value, value, other

    evaluate_lanes = lambda *leaves: jacobian_columns(config.compute_outputs, leaves, input_indices)
    cache_key = ("gait step with derivatives", *config.cache_key, input_indices)
    calls = {
        n: unbatch(cached_lane_function(evaluate_lanes, make_template, cache_key, n))
        for n in (N_STEP_INPUTS, N_DIRECTIONS_UNEVEN)
    }

    def jacobian(*leaves: Array) -> tuple:
        n = sum(int(np.prod(jnp.shape(leaves[i]))) for i in input_indices)
        columns, value, other = calls[N_STEP_INPUTS if n <= N_STEP_INPUTS else N_DIRECTIONS_UNEVEN](
            *tighten_tolerances(*leaves)
        )
        return (split_jacobian(columns, leaves, input_indices), value), other

    return jacobian


def split_jacobian(columns: Any, leaves: Sequence[Array], input_indices: Sequence[int]) -> tuple:
    """Return a Jacobian leaf by leaf; its leading axis runs over all entries of the selected
    leaves.
    """
    jacobians, offset = [], 0
    for i in input_indices:
        shape = jnp.shape(leaves[i])
        index_range = slice(offset, offset + int(np.prod(shape)))
        select_columns = lambda x, index_range=index_range, shape=shape: jnp.moveaxis(
            x[index_range], 0, -1
        ).reshape(*x.shape[1:], *shape)
        jacobians.append(jax.tree.map(select_columns, columns))
        offset = index_range.stop
    return tuple(jacobians)


N_STEP_INPUTS = len(PARAMETER_NAMES) + 3
"""All numbers that a step moves with: machine code keeps one of each direction in registers."""
N_DIRECTIONS_UNEVEN = N_STEP_INPUTS + 1
"""The same on uneven ground: the slope of the line ahead, too."""


def jacobian_columns(
    function: BatchFunction, leaves: Sequence[Array], input_indices: Sequence[int]
) -> tuple:
    """Return the columns of the Jacobian of `function(*leaves)`, and its results.

    The columns are those of the leaves at `input_indices`, on the leading axis. The function
    returns floats over lanes and auxiliary outputs.
    """

    def evaluate_at(*values: Array) -> tuple:
        inputs = list(leaves)
        for i, leaf in zip(input_indices, values, strict=True):
            inputs[i] = leaf
        return function(*inputs)

    primals = [leaves[i] for i in input_indices]
    jvp_along = lambda tangents: jax.jvp(evaluate_at, primals, tangents, has_aux=True)
    value, columns, aux = jax.vmap(jvp_along, out_axes=(None, 0, None))(_unit_tangents(primals))
    return columns, value, aux


def _unit_tangents(leaves: Sequence[Array]) -> list[Array]:
    """Return, for each leaf, its part of the unit vectors of all leaves, on the leading axis.

    Each number has its own ones and zeros, so that machine code omits products with them.
    """
    sizes = [int(np.prod(leaf.shape[:-1])) for leaf in leaves]
    units, tangents, offset = np.eye(sum(sizes)), [], 0
    for leaf, size in zip(leaves, sizes, strict=True):
        rows = [jnp.asarray(units[:, i], leaf.dtype)[:, None] for i in range(offset, offset + size)]
        broadcast_rows = [jnp.broadcast_to(row, (len(units), leaf.shape[-1])) for row in rows]
        tangents.append(broadcast_rows[0] if leaf.ndim == 1 else jnp.stack(broadcast_rows, 1))
        offset += size
    return tangents

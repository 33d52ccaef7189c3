"""The paper's step in batches: one source for machine code and GPUs, values and derivatives.

The phases are those of the diffrax engine; arrays hold one quantity of all wheels instead of the
quantities of one wheel. `build_step_function` returns a function of one wheel that `jax.vmap` maps
onto lanes, for use in JAX programs.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from vrw_jax import simd
from vrw_jax.models.base import Advance, EnergyLoss, Indicators, Margins, StepResult, Trajectory
from vrw_jax.models.paper_step import (
    End,
    Walked,
    advance_of,
    result_of,
    through_phases,
    trajectory_of,
)
from vrw_jax.numerics import (
    Balance,
    Forward,
    LaneFunction,
    LanePhase,
    Monitors,
    Options,
    Place,
    Slope,
    Tableau,
    Vector,
    by_directions,
    explicit_tableau,
    integrate_lanes,
    one_wheel,
    sample_lanes,
    sine_cosine,
)
from vrw_jax.runtime import lane_function
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    AbstractPhase,
    Instant,
    Motion,
    Outcome,
    WheelParams,
    transitions,
)

INTO_SINGLE_SUPPORT = 0.3
"""Upper bound of the first solver step of SLS-I, as a fraction of the last solver step of DLS."""
TRANSIENT = 7.0
"""Upper bound of the same step, in units of m/c times the tolerance's root of the solver's order.
Dropping the rear foot's force excites the airborne leg's fast mode, which decays within 0.05 s.
The value was chosen because the controller settles at 7.2 to 9.5. This holds for solvers of
orders 5 to 8, at tolerances of 1e-4 to 1e-10. A longer step is repeated."""


class LaneStep(NamedTuple):
    """Minimal results of one gait step of every lane."""

    section_state: Vector  # three arrays
    durations: Vector  # of DLS, SLS-I, SLS-II, s
    outcome: Int[Array, " lanes"]  # an Outcome
    solver_steps: Int[Array, " lanes"]
    unfinished: Bool[Array, " lanes"]  # stragglers not completed: their other fields are void


class _Handed(NamedTuple):
    """Data passed from one phase to the next."""

    next_step: Array  # step size that the controller proposes next, s
    ran: Bool[Array, " lanes"]  # where the phase took place
    unfinished: Bool[Array, " lanes"]


def lane_phase(phase: AbstractPhase, monitored: bool, called: bool = False) -> LanePhase:
    """Return a phase in the form of the batched integrator.

    - `records_margins`: evaluate its margins in addition to its guards.
    """

    def evaluate(q: Vector, v: Vector) -> Slope:
        sin, cos = sine_cosine(q[0])
        return Slope(sin, cos, phase.acceleration(phase.motion(sin, cos, q, v))[: phase.n])

    def motion(place: Place) -> Motion:
        return phase.motion(place.slope.sin, place.slope.cos, place.q, place.v)

    def instant(place: Place) -> Instant:
        return Instant(phase, motion(place), place.slope.acceleration)

    balance = Balance(
        lambda place: phase.residual(motion(place), place.slope.acceleration),
        lambda place, rows: phase.solve(motion(place), rows),
    )
    premises = lambda place: phase.premises(instant(place))
    watched = Monitors(premises, phase.counts_at_start) if monitored else None
    guards = lambda place: phase.guards(instant(place))
    return LanePhase(evaluate, guards, watched, balance, called)


def gait_step(
    params: WheelParams,
    x: Vector,
    options: Options,
    tableau: Tableau,
    stop_at_lift_off: bool,
    few: Array | None = None,
) -> LaneStep:
    """Return one gait step of every lane, from touchdown to touchdown.

    - `straggler_count`: see `integrate_batch_phase`.
    """
    walked = walk(params, x, options, tableau, stop_at_lift_off, monitored=False, few=few)
    ends, stepped = walked.ends, walked.outcome == Outcome.STEPPED
    section = (ends[2].q[0], *ends[2].v)
    return LaneStep(
        section_state=tuple(jnp.where(stepped, value, 0.0) for value in section),
        durations=tuple(end.duration for end in ends),
        outcome=walked.outcome,
        solver_steps=ends[0].tried + ends[1].tried + ends[2].tried,
        unfinished=ends[0].own.unfinished | ends[1].own.unfinished | ends[2].own.unfinished,
    )


def walk(
    params: WheelParams,
    x: Vector,
    options: Options,
    tableau: Tableau,
    stop_at_lift_off: bool,
    monitored: bool,
    few: Array | None = None,
    called: bool = False,
) -> Walked:
    """Return all phases of every lane's step.

    - `is_noinline`: see `BatchPhase`.
    """

    def run(phase: AbstractPhase, q: Vector, v: Vector, active: Array, before: End | None) -> End:
        first = options.first_step + jnp.zeros_like(q[0])
        if before is not None:
            known: _Handed = before.own
            first = known.next_step
            if phase.stiff_start:
                root = jnp.exp(jnp.log(options.rtol.astype(jnp.float32)) / tableau.order)
                transient = TRANSIENT * root.astype(first.dtype) * phase.s.m / phase.s.c
                first = jnp.minimum(INTO_SINGLE_SUPPORT * first, transient)
                first = jnp.where(known.ran, first, known.next_step)
        floats, fixed = eqx.partition(phase.s, eqx.is_array)

        def phase_of(floats: Any, held: Vector) -> LanePhase:
            s = eqx.combine(floats, fixed)
            return lane_phase(dataclasses.replace(phase, s=s, held=held), monitored, called)

        end = integrate_lanes(
            phase_of, floats, phase.held, tableau, q, v, active, first, options, few
        )
        return End(
            *end.place[:2],
            duration=end.duration,
            guard=end.guard,
            timed_out=end.timed_out,
            tried=end.tried,
            minima=end.minima,
            own=_Handed(end.next_step, active, end.unfinished),
        )

    land = by_directions(transitions.land)
    return through_phases(run, params, x, stop_at_lift_off, land)


def lanes_can(options: Options) -> bool:
    """Return whether the batch kernel can take the step: machine code and an explicit solver.

    Raises `ValueError` if the options require that engine and it is not available.
    """
    fits = explicit_tableau(options.solver) is not None
    if options.engine == "lanes" and not (fits and simd.serves()):
        raise ValueError(
            f"engine is 'lanes', which needs a CPU and an explicit solver, but the solver is "
            f"{options.solver} on a {jax.default_backend()}: take engine='diffrax'."
        )
    return fits and simd.serves() and options.engine != "diffrax"


class _Setting(NamedTuple):
    """Static configuration of a batched step: what it depends on besides its arrays."""

    structure: Any  # of (params, x, options), whose leaves are the arrays
    stop_at_lift_off: bool
    friction: float | None  # for margins; None for the minimal result

    @property
    def key(self) -> tuple:
        """Cache key of the trace, by `repr`."""
        return str(self.structure), self.stop_at_lift_off, self.friction

    def walked(self, *leaves: Array) -> tuple[Walked, Tableau, Options]:
        """Return the step over lanes, which the leaves have on their last axis, with tableau and
        options.
        """
        params, x, options = jax.tree.unflatten(self.structure, leaves)
        tableau = explicit_tableau(options.solver)
        assert tableau is not None  # checked by `can_use_lanes`
        monitored = self.friction is not None
        given = params, tuple(x), options, tableau, self.stop_at_lift_off, monitored
        return walk(*given, called=True), tableau, options

    def told(self, *leaves: Array) -> tuple:
        """Return the outputs of the step, floats first."""
        walked, friction = self.walked(*leaves)[0], self.friction
        if friction is None:
            return eqx.partition(advance_of(walked, "lanes"), eqx.is_inexact_array)
        ends = tuple(end._replace(own=None) for end in walked.ends)
        alone = walked._replace(phases=(), starts=(), ends=ends)  # only floats
        told = by_directions(lambda walked: result_of(walked, friction, "lanes"))(alone)
        return eqx.partition(told, eqx.is_inexact_array)

    def like(self, *leaves: Array) -> tuple:
        """Return arrays in the structure of `compute_outputs`."""
        x = leaves[0]
        i = jnp.zeros_like(x, jnp.int32)
        two, three = (jnp.broadcast_to(x, (n, *x.shape)) for n in (2, 3))
        told: Any = Advance(three, three, i, i, engine="lanes")
        if self.friction is not None:
            told = StepResult(
                section_state=three,
                post_impact=two,
                durations=three,
                step_length=x,
                indicators=_every(Indicators, x),
                monitors=_every(Margins, x),
                energy=_every(EnergyLoss, x),
                outcome=i,
                solver_steps=i,
                engine="lanes",
            )
        return eqx.partition(told, eqx.is_inexact_array)


def _every(kind: Any, x: Array) -> Any:
    """Return the record with `x` in all fields."""
    return kind(*(x for _ in dataclasses.fields(kind)))


def told_by_lanes(structure: Any, stop_at_lift_off: bool, friction: float | None) -> Forward:
    """Return the step over the leaves of (params, x, options), as a forward rule for any AD
    mode.
    """
    setting = _Setting(structure, stop_at_lift_off, friction)
    settings = ("gait step", *setting.key)
    return one_wheel(lane_function(setting.told, setting.like, settings))


def sampled_by_lanes(structure: Any, stop_at_lift_off: bool, n_samples: int) -> LaneFunction:
    """Return the step sampled at equal times of each phase, over the same leaves."""
    setting = _Setting(structure, stop_at_lift_off, None)

    def over_lanes(*leaves: Array) -> Trajectory:
        walked, tableau, options = setting.walked(*leaves)
        samples = [
            sample_lanes(
                lane_phase(phase, False), tableau, *start, end.duration, n_samples, options
            )
            for phase, start, end in zip(walked.phases, walked.starts, walked.ends, strict=True)
        ]
        return trajectory_of(walked, samples)

    def like(x: Array, *_: Array) -> Trajectory:
        rows = lambda *n: jnp.broadcast_to(x, (3, *n, *x.shape))
        n = n_samples
        along = rows(n), rows(n, 6), rows(n, 4), rows(n, 3)
        return Trajectory(*along, rows(), rows(), jnp.zeros_like(x, jnp.int32))

    return one_wheel(lane_function(over_lanes, like, ("samples", *setting.key, n_samples)))


def moved_by_lanes(
    structure: Any, stop_at_lift_off: bool, friction: float | None, moved: tuple[int, ...]
) -> Forward:
    """Return the Jacobian of `build_step_function`.

    It gives (Jacobian with respect to the leaves at `input_indices`, floats) and the other outputs.
    """
    setting = _Setting(structure, stop_at_lift_off, friction)

    def tightened(*leaves: Array) -> list[Array]:
        params, x, options = jax.tree.unflatten(structure, leaves)
        return jax.tree.leaves((params, x, options.for_derivatives()))

    def like(*leaves: Array) -> tuple:
        value, other = setting.like(*leaves)
        return value, value, other

    over_lanes = lambda *leaves: along_units(setting.told, leaves, moved)
    settings = ("gait step with derivatives", *setting.key, moved)
    call = one_wheel(lane_function(over_lanes, like, settings, DIRECTIONS))

    def jacobian(*leaves: Array) -> tuple:
        columns, value, other = call(*tightened(*leaves))
        return (by_argument(columns, leaves, moved), value), other

    return jacobian


def by_argument(columns: Any, leaves: Sequence[Array], moved: Sequence[int]) -> tuple:
    """Return a Jacobian leaf by leaf; its leading axis runs over all entries of the selected
    leaves.
    """
    parts, begin = [], 0
    for i in moved:
        shape = jnp.shape(leaves[i])
        some = slice(begin, begin + int(np.prod(shape)))
        take = lambda x, some=some, shape=shape: jnp.moveaxis(x[some], 0, -1).reshape(
            *x.shape[1:], *shape
        )
        parts.append(jax.tree.map(take, columns))
        begin = some.stop
    return tuple(parts)


DIRECTIONS = len(PARAMETER_NAMES) + 3
"""Number of all inputs of a step: machine code keeps one tangent per input in registers."""


def along_units(function: LaneFunction, leaves: Sequence[Array], moved: Sequence[int]) -> tuple:
    """Return the columns of the Jacobian of `function(*leaves)`, and its results.

    The columns are those of the leaves at `input_indices`, on the leading axis. The function
    returns floats over lanes and auxiliary outputs.
    """

    def only(*some: Array) -> tuple:
        given = list(leaves)
        for i, leaf in zip(moved, some, strict=True):
            given[i] = leaf
        return function(*given)

    at = [leaves[i] for i in moved]
    along = lambda ways: jax.jvp(only, at, ways, has_aux=True)
    value, columns, other = jax.vmap(along, out_axes=(None, 0, None))(_directions(at))
    return columns, value, other


def _directions(leaves: Sequence[Array]) -> list[Array]:
    """Return, for each leaf, its part of the unit vectors of all leaves, on the leading axis.

    Each number has its own ones and zeros, so that machine code omits products with them.
    """
    sizes = [int(np.prod(leaf.shape[:-1])) for leaf in leaves]
    units, told, begin = np.eye(sum(sizes)), [], 0
    for leaf, size in zip(leaves, sizes, strict=True):
        rows = [jnp.asarray(units[:, i], leaf.dtype)[:, None] for i in range(begin, begin + size)]
        wide = [jnp.broadcast_to(row, (len(units), leaf.shape[-1])) for row in rows]
        told.append(wide[0] if leaf.ndim == 1 else jnp.stack(wide, 1))
        begin += size
    return told

"""Pseudo-arclength continuation of fixed points in one parameter, through folds.

A problem is an `AbstractContinuationProblem`, which defines how Newton's method corrects the
unknowns z at a parameter p and how z changes with p. Many branches run concurrently, each with
buffers of fixed size for its points.

Lengths are measured in the section state and in the parameter as a fraction of its range.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.numerics.codes import Code
from vrw_jax.numerics.derivatives import with_jacobian
from vrw_jax.numerics.lanes import select
from vrw_jax.numerics.types import Scalar
from vrw_jax.wording import positive, whole

Unknown = Any
"""A pytree of float arrays with everything that Newton's method corrects."""
Section = Float[Array, " n"]


@dataclasses.dataclass(frozen=True)
class ArclengthOptions:
    """Numerical options of a continuation; each change compiles again.

    - `initial_ds`, `max_ds`, `min_ds`: continuation step along the branch, in the section state and
      in the parameter as a fraction of its range;
    - `max_points`: limit of points in each direction;
    - `max_newton_iterations`: limit of Newton's iterations for one point;
    - `tolerance`: limit of the norm of Newton's last correction;
    - `max_turn_angle`: largest turn of the branch in one continuation step, rad.

    Examples:
        >>> vrw.ArclengthOptions(max_ds=0.05).max_points
        400
    """

    first_step: float = 0.005
    largest_step: float = 0.02
    smallest_step: float = 1e-6
    max_points: int = 400
    iterations: int = 10
    tolerance: float = 1e-10
    turn: float = 0.2

    def __post_init__(self) -> None:
        for name in ("max_points", "iterations"):
            whole(name, getattr(self, name))
        for name in ("first_step", "largest_step", "smallest_step", "tolerance", "turn"):
            positive(name, getattr(self, name))
        if not self.smallest_step <= self.first_step <= self.largest_step:
            raise ValueError(
                f"the steps are {self.smallest_step:g} (smallest), {self.first_step:g} (first) and "
                f"{self.largest_step:g} (largest), but they must not fall in this order: "
                "give smallest_step <= first_step <= largest_step."
            )


class Linear(NamedTuple):
    """Correction and tangent of Newton's method at a trial point (z, p)."""

    correction: Unknown  # of z at fixed p
    column: Unknown  # dz/dp, the tangent of the branch
    jacobian: Float[Array, "n n"]  # of the return map over the section's numbers


class AbstractFollowed(eqx.Module):
    """Base class of continuation problems; `args` is a pytree with all other inputs of the
    equations.
    """

    traced: ClassVar[bool] = True
    """Whether `linearize` can be compiled into a loop; otherwise it is called for many points at
    once from outside of compiled code."""

    @abc.abstractmethod
    def linearise(self, wheel: Any, z: Unknown, p: Scalar) -> Linear:
        """Return correction, tangent and Jacobian; they are not finite where the map
        is undefined.
        """

    @abc.abstractmethod
    def section(self, z: Unknown) -> Section:
        """Return the section state, a part of z."""

    def between(self, left: Unknown, right: Unknown, place: Scalar) -> Unknown:
        """Return the initial guess of Newton's method at a fraction in [0, 1] between
        two points.
        """
        return jax.tree.map(lambda a, b: a + place * (b - a), left, right)

    def size(self, z: Unknown, correction: Unknown) -> Scalar:
        """Return the norm of a correction, its largest entry, which is compared with
        the tolerance.
        """
        return jnp.max(jnp.abs(correction))

    def valid(self, wheel: Any, z: Unknown, p: Scalar) -> Bool[Array, ""]:
        """Return whether a converged z satisfies the conditions of its branch."""
        return jnp.all(jnp.isfinite(z))


def at_fixed_point(
    image: Callable[[Array, Scalar], Array], z: Array, p: Scalar, numbers: int
) -> Linear:
    """Return the Newton step of `return_map(z, p)` = z, whose first `n_continuous` entries are
    continuous.

    The other entries are codes, which are copied from the image.
    """
    beside = lambda x, p: image(jnp.concatenate([x, z[numbers:]]), p)
    reached, slopes = with_jacobian(beside, z[:numbers], p)
    by_x, by_p = (slope[:numbers] for slope in slopes)
    miss = reached - z
    right = jnp.stack([miss[:numbers], by_p], -1)
    solved = jnp.linalg.solve(jnp.eye(numbers, dtype=z.dtype) - by_x, right)
    codes = miss[numbers:]
    column = jnp.concatenate([solved[:, 1], jnp.zeros_like(codes)])
    return Linear(jnp.concatenate([solved[:, 0], codes]), column, by_x)


class MapFollowed(AbstractFollowed):
    """Fixed points of a map x -> `function(args, x, p)` that JAX differentiates in forward mode.

    The map returns NaN where it is not defined.
    """

    function: Callable[[Any, Section, Scalar], Section] = eqx.field(static=True)

    def linearise(self, wheel: Any, z: Unknown, p: Scalar) -> Linear:
        return at_fixed_point(lambda x, p: self.function(wheel, x, p), z, p, z.shape[0])

    def section(self, z: Unknown) -> Section:
        return z


class Ending(Code):
    """Reason why the continuation of a branch ended in one direction."""

    GOING = 0, "It was still being followed."
    RANGE_ENDED = 1, "The parameter's range ended."
    LEFT_SEQUENCE = 2, "Its points no longer are what they stand for."
    STALLED = 3, "Newton's method found no next point, however short the step."
    BUFFER_FULL = 4, "It has as many points as were allowed: raise max_points."
    NO_START = 5, "No point was found to start from."
    CLOSED = 6, "It came back to where it began."


class PathPoint(NamedTuple):
    """A point of a branch with the unit tangent to the branch."""

    z: Unknown
    p: Scalar
    slope: Unknown  # dz per length along the branch; () for stored points
    share_slope: Scalar  # rate of the parameter, as a fraction of its range, per length
    jacobian: Float[Array, "n n"]
    valid: Bool[Array, ""]


class Track(NamedTuple):
    """Points of one or more branches in buffers of `max_points`, of which the first `n_points` are
    set.
    """

    points: PathPoint
    n_points: Int[Array, " branches"]
    ending: Int[Array, " branches"]  # a ContinuationStatus
    passes: Int[Array, " branches"]  # calls of `linearize`


class Plane(NamedTuple):
    """The condition that selects a point: the projection on the normal equals that of the given
    point.
    """

    x: Section
    share: Scalar
    row_x: Section
    row_share: Scalar


class Corrected(NamedTuple):
    """State of the corrector after one Newton iteration."""

    z: Unknown
    share: Scalar
    size: Scalar
    column: Unknown  # dz per fraction of the parameter's range
    jacobian: Float[Array, "n n"]


def linear_at(
    followed: AbstractFollowed, wheel: Any, bounds: Array, z: Unknown, share: Scalar
) -> Linear:
    """Return the Newton step at a fraction of the parameter's range."""
    return followed.linearise(wheel, z, bounds[0] + (bounds[1] - bounds[0]) * share)


def corrected(
    followed: AbstractFollowed,
    linear: Linear,
    bounds: Array,
    plane: Plane,
    z: Unknown,
    share: Scalar,
) -> Corrected:
    """Apply one Newton iteration to the branch's equations and the constraint plane together."""
    scale = bounds[1] - bounds[0]
    column = jax.tree.map(lambda x: scale * x, linear.column)
    x = followed.section(z) + followed.section(linear.correction)
    ahead = plane.row_x @ (x - plane.x) + plane.row_share * (share - plane.share)
    d_share = -ahead / (plane.row_x @ followed.section(column) + plane.row_share)
    dz = jax.tree.map(lambda a, b: a + d_share * b, linear.correction, column)
    size = jnp.maximum(followed.size(z, dz), jnp.abs(d_share))
    return Corrected(jax.tree.map(jnp.add, z, dz), share + d_share, size, column, linear.jacobian)


def _share_of(p: Array, bounds: Array) -> Array:
    return (p - bounds[0]) / (bounds[1] - bounds[0])


def parameter_at(share: Array, bounds: Array) -> Array:
    """Return the parameter at a fraction of its range; it is exact at both ends."""
    p = bounds[0] + (bounds[1] - bounds[0]) * share
    return jnp.where(share == 1.0, bounds[1], p)


class _Trial(NamedTuple):
    plane: Plane
    z: Unknown
    share: Scalar
    length: Scalar  # predicted arc length from the last point
    final: Bool[Array, ""]  # whether it lies on the end of the range


def _predicted(
    followed: AbstractFollowed,
    before: PathPoint,
    base: PathPoint,
    two: Bool[Array, ""],
    step: Scalar,
    bounds: Array,
) -> _Trial:
    """Return the predicted point one step along the tangent, or on the end of the range if it is
    nearer.

    With `has_two_points`, Newton's method starts on the cubic through the last two points and along
    their tangents. The cubic is nearer to the branch by two orders and saves one iteration of
    three.
    """
    share, ahead = _share_of(base.p, bounds), base.share_slope
    edge = jnp.where(ahead > 0.0, 1.0, 0.0)
    still = ahead == 0.0
    reach = jnp.where(still, jnp.inf, (edge - share) / jnp.where(still, 1.0, ahead))
    final = reach <= step
    length = jnp.where(final, reach, step)
    along_x, here = followed.section(base.slope), followed.section(base.z)
    at = jnp.where(final, edge, share + length * ahead)
    plane = Plane(
        here + length * along_x,
        at,
        jnp.where(final, 0.0, along_x),
        jnp.where(final, 1.0, ahead),
    )
    passed = _share_of(before.p, bounds)
    apart = jnp.append(here - followed.section(before.z), share - passed)
    chord = jnp.where(two, jnp.sqrt(apart @ apart), 1.0)

    def curved(a: Array, da: Array, b: Array, db: Array) -> Array:
        mean = (b - a) / chord
        bend = (db - mean) / chord + (length + chord) * (da + db - 2.0 * mean) / chord**2
        return b + length * db + jnp.where(two, length**2 * bend, 0.0)

    z = jax.tree.map(curved, before.z, before.slope, base.z, base.slope)
    share = jnp.where(final, edge, curved(passed, before.share_slope, share, ahead))
    return _Trial(plane, z, share, length, final)


class State(NamedTuple):
    """State of the continuation of one branch."""

    before: PathPoint
    base: PathPoint
    first: PathPoint  # of the branch, if it exists
    step: Scalar
    trial: _Trial
    iteration: Int[Array, ""]
    n_points: Int[Array, ""]
    ending: Int[Array, ""]
    passes: Int[Array, ""]


class _Judged(NamedTuple):
    """Assessment of a trial after one Newton iteration; if neither flag is set, the iteration goes
    on.
    """

    accepted: Bool[Array, ""]
    failed: Bool[Array, ""]
    share_slope: Scalar  # along the branch, in the direction of the continuation


def _judged(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    state: State,
    now: Corrected,
    direction: Scalar,
) -> _Judged:
    """Return whether a trial is accepted or has failed, and the parameter's rate along
    the branch.
    """
    base, trial, starting = state.base, state.trial, state.n_points == 0
    off = jnp.maximum(
        jnp.max(jnp.abs(followed.section(now.z) - trial.plane.x)),
        jnp.abs(now.share - trial.plane.share),
    )
    sound = jnp.isfinite(now.size) & (starting | (off <= state.step))
    converged = sound & (now.size < options.tolerance)
    by_share = followed.section(now.column)
    facing = followed.section(base.slope) @ by_share + base.share_slope
    facing = jnp.where(starting, direction, facing)
    norm = jnp.sqrt(1.0 + by_share @ by_share)
    straight = starting | (jnp.abs(facing) >= norm * jnp.cos(options.turn))
    accepted = converged & straight
    failed = ~accepted & (~sound | converged | (state.iteration + 1 >= options.iterations))
    return _Judged(accepted, failed, jnp.where(facing >= 0.0, 1.0, -1.0) / norm)


def _next_step(options: ArclengthOptions, state: State, judged: _Judged) -> Scalar:
    """Return the next continuation step.

    The step grows after few Newton iterations, shrinks after many, and halves after a failure.
    """
    quick, slow = state.iteration < 4, state.iteration >= 6
    growth = jnp.where(quick, 1.4, jnp.where(slow, 0.6, 1.0))
    longer = jnp.minimum(state.step * growth, options.largest_step)
    shorter = jnp.where(judged.failed, 0.5 * state.step, state.step)
    step = jnp.where(judged.accepted, longer, shorter)
    return jnp.where(state.n_points == 0, options.first_step, step)


def _closes(
    followed: AbstractFollowed, start: PathPoint, base: PathPoint, to: PathPoint, bounds: Array
) -> Bool[Array, ""]:
    """Return whether the segment from one point to the next passes over the branch's start."""
    place = lambda at: jnp.append(followed.section(at.z), _share_of(at.p, bounds))
    chord, there = place(to) - place(base), place(start) - place(base)
    squared = chord @ chord
    share = there @ chord / jnp.where(squared > 0.0, squared, 1.0)
    off = there - share * chord
    return (share >= 0.0) & (share <= 1.0) & (off @ off < 0.01 * squared)


def _ending(
    options: ArclengthOptions,
    state: State,
    judged: _Judged,
    reached: PathPoint,
    step: Scalar,
    ahead: Scalar,
    closes: Bool[Array, ""],
) -> Int[Array, ""]:
    """Return whether and why the branch ends at this trial; `next_length` is the next step's
    length.
    """
    accepted, failed, _ = judged
    count, ending = state.n_points + accepted, state.ending
    for happened, code in (
        (step < options.smallest_step, Ending.STALLED),
        (failed & (state.n_points == 0), Ending.NO_START),
        (accepted & (count >= options.max_points), Ending.BUFFER_FULL),
        (accepted & (state.trial.final | (ahead <= 1e-12)), Ending.RANGE_ENDED),
        (accepted & ~reached.valid, Ending.LEFT_SEQUENCE),
        (accepted & closes & (state.n_points > 2), Ending.CLOSED),
    ):
        ending = jnp.where(happened, int(code), ending)
    return ending.astype(jnp.int32)


def _started(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    bounds: Array,
    z: Unknown,
    p: Scalar,
    direction: Scalar,
) -> State:
    x = followed.section(z)
    n, dtype = x.shape[0], x.dtype
    zero, none, no = jnp.zeros((), dtype), jnp.zeros((), jnp.int32), jnp.asarray(False)
    flat, share = jax.tree.map(jnp.zeros_like, z), _share_of(p, bounds)
    here = PathPoint(z, p, flat, zero + direction, jnp.zeros((n, n), dtype), no)
    trial = _Trial(Plane(x, share, jnp.zeros_like(x), zero + 1.0), z, share, zero, no)
    going = none + int(Ending.GOING)
    return State(here, here, here, zero + options.first_step, trial, none, none, going, none)


SIDE_BY_SIDE = 8
"""Branches that are continued concurrently, chosen because they fill one group of lanes of machine
code."""

Followed = tuple[State, PathPoint]
"""States of concurrent branches, and the buffers of points that they have reached."""


def begun(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    z: Unknown,
    p: Array,
    bounds: Array,
    directions: Array,
    wanted: Array,
) -> Followed:
    """Return the initial states of the branches and their empty buffers of points."""
    states = jax.vmap(functools.partial(_started, followed, options, bounds))(z, p, directions)
    ending = jnp.where(wanted, states.ending, int(Ending.NO_START))
    states = states._replace(ending=ending.astype(jnp.int32))
    room = lambda x: jnp.zeros((x.shape[0], options.max_points, *x.shape[1:]), x.dtype)
    return states, jax.tree.map(room, states.base._replace(slope=()))


def going(on: Followed) -> Array:
    """Return which branches still run."""
    return on[0].ending == int(Ending.GOING)


def turned(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    wheels: Any,
    bounds: Array,
    directions: Array,
    rows: Array,
    on: Followed,
    linears: Linear,
) -> Followed:
    """Advance each branch by one linearization of its trial, and store the accepted points.

    The branches own the rows `buffer_rows` of the buffers.
    """

    def iterate(
        wheel: Any, direction: Scalar, state: State, linear: Linear
    ) -> tuple[State, PathPoint, Bool[Array, ""]]:
        trial = state.trial
        now = corrected(followed, linear, bounds, trial.plane, trial.z, trial.share)
        judged = _judged(followed, options, state, now, direction)
        p = parameter_at(jnp.where(trial.final, trial.plane.share, now.share), bounds)
        valid = followed.valid(wheel, now.z, p)
        slope = jax.tree.map(lambda x: judged.share_slope * x, now.column)
        reached = PathPoint(now.z, p, slope, judged.share_slope, now.jacobian, valid)
        base = select(judged.accepted, reached, state.base)
        first = select(judged.accepted & (state.n_points == 0), reached, state.first)
        before = select(judged.accepted, state.base, state.before)
        count = state.n_points + judged.accepted
        step = _next_step(options, state, judged)
        following = _predicted(followed, before, base, count > 1, step, bounds)
        done = judged.accepted | judged.failed
        following = select(done, following, trial._replace(z=now.z, share=now.share))
        closes = _closes(followed, first, state.base, reached, bounds)
        ending = _ending(options, state, judged, reached, step, following.length, closes)
        iteration = jnp.where(done, 0, state.iteration + 1)
        counts = count, ending, state.passes + 1
        later = State(before, base, first, step, following, iteration, *counts)
        return later, reached, judged.accepted

    # Buffers are updated outside of `tree_where`, which would copy them at every iteration.
    state, points = on
    after, reached, accepted = jax.vmap(iterate)(wheels, directions, state, linears)
    place = jnp.where(going(on) & accepted, state.n_points, options.max_points)
    put = lambda buffer, reached: buffer.at[rows, place].set(reached, mode="drop")
    points = jax.tree.map(put, points, reached._replace(slope=()))
    return jax.vmap(select)(going(on), after, state), points


def track_of(on: Followed) -> Track:
    """Return the result of a continuation from the states of its branches."""
    last, points = on
    return Track(points, last.n_points, last.ending, last.passes)


@eqx.filter_jit
def follow(
    followed: AbstractFollowed,
    options: ArclengthOptions,
    wheels: Any,
    z: Unknown,
    p: Float[Array, "*branches"],
    bounds: Float[Array, "2"],
    directions: Float[Array, "*branches"],
    wanted: Bool[Array, "*branches"] | None = None,
) -> Track:
    """Continue the branches from the points near (z, p) in the given directions.

    The parameter grows if the direction is 1 and shrinks if it is -1. The input is one branch, or
    several with a leading axis, of which only those that are requested run. Each branch ends at the
    end of the range, or with its first point that is not admissible, which is kept. Groups of
    branches run concurrently with one linearization of each per iteration; when a branch ends, the
    next one starts.
    """
    if p.ndim == 0:
        one = lambda tree: jax.tree.map(lambda x: x[None], tree)
        track = follow(followed, options, one(wheels), one(z), p[None], bounds, directions[None])
        return jax.tree.map(lambda x: x[0], track)
    wanted = jnp.ones(p.shape, bool) if wanted is None else wanted

    def some_further(on: Followed) -> Followed:
        rows = jnp.argsort(~going(on), stable=True)[:SIDE_BY_SIDE]
        own, along, state = jax.tree.map(lambda x: x[rows], (wheels, directions, on[0]))
        waiting = jnp.sum(going(on)) > len(rows)

        def turn(on: Followed) -> Followed:
            one = lambda wheel, trial: linear_at(followed, wheel, bounds, trial.z, trial.share)
            linears = jax.vmap(one)(own, on[0].trial)
            return turned(followed, options, own, bounds, along, rows, on, linears)

        more = lambda on: jnp.where(waiting, jnp.all(going(on)), jnp.any(going(on)))
        state, points = lax.while_loop(more, turn, (state, on[1]))
        return jax.tree.map(lambda x, new: x.at[rows].set(new), on[0], state), points

    on = begun(followed, options, z, p, bounds, directions, wanted)
    return track_of(lax.while_loop(lambda on: jnp.any(going(on)), some_further, on))

"""Search for limit cycles of many wheels at once: starts, Newton's method, sign checks, retries.

Newton's method on the collocation system also converges to formal solutions that are no gaits. A
cycle therefore counts as found only if every sign that its sequence of phases assumes holds at all
nodes. Wheels still without a cycle after an attempt are packed together for the next one.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import export, lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax import simd
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.sequence import SIGNS, constants_of, held_landing
from vrw_jax.cycles.surface import gait_on_surface
from vrw_jax.numerics import (
    N_NODES,
    Constants,
    LaneArray,
    LaneFunction,
    Linearised,
    Mesh,
    Passage,
    Phase,
    PhaseSequence,
    Point,
    Solution,
    Vector,
    linearised_pass,
    mesh_error,
    walk_through,
)
from vrw_jax.wheel import WheelParams, parameters_of, wheel_of

Parameters = Float[Array, "n_parameters lanes"]
"""The float parameters in the order of PARAMETER_NAMES."""


class Problem(NamedTuple):
    """Static data of a search: the phases, the number of steps and the meshes."""

    n_legs: int
    period_n: int
    options: CycleOptions
    stop_at_lift_off: bool = True  # whether a pulling ground rules a gait out

    @property
    def sequence(self) -> PhaseSequence:
        return held_landing(self.n_legs, self.stop_at_lift_off)

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        dls, sls1, sls2 = self.options.steps
        return Mesh(dls, 1.0), Mesh(sls1, self.options.growth), Mesh(sls2, 1.0)

    @property
    def constants_of(self) -> Callable:
        return functools.partial(constants_of, self.n_legs)

    def pass_at(
        self, parameters: Parameters, located: "Located", wanted: tuple[int, ...] = ()
    ) -> Linearised:
        return linearised_pass(
            self.sequence,
            self.meshes,
            self.constants_of,
            parameters,
            located.solution,
            located.happens > 0.5,
            wanted,
        )

    def passages(
        self, parameters: Array, solution: Solution
    ) -> tuple[Vector, list[tuple[Passage, ...]]]:
        """Return the section after the last step and the passages of each step, of one wheel or of
        lanes."""
        constants, section = self.constants_of(*parameters), tuple(solution.section)
        told = []
        for k in range(self.period_n):
            durations, accelerations = jax.tree.map(
                lambda x, k=k: x[k], (solution.durations, solution.accelerations)
            )
            section, passages = walk_through(
                self.sequence, self.meshes, constants, section, durations, accelerations
            )
            told.append(passages)
        return section, told


class Located(NamedTuple):
    """Solution of the collocation system, with the data that select it. Floats only, lanes last."""

    solution: Solution
    happens: LaneArray  # (n, n_phases, lanes): 1 if the phase takes place, else 0
    found: LaneArray  # (lanes,): 1 for a limit cycle, 0 if there is none and values are substitutes
    broken: LaneArray  # (lanes,): 1 + index in ADMISSIBILITY_CHECKS of the check that a root fails;
    # plus HOMOTOPY_OFFSET for a root of a wheel on the homotopy; NEWTON_FAILED; else 0
    ends: LaneArray  # (n, 4, lanes): theta, L1 and their rates at the end of each step


class Finding(NamedTuple):
    """Result of a search, lanes last."""

    located: Located
    monodromy: LaneArray  # (row, column, lanes)
    residual: LaneArray  # norm of Newton's last correction
    passes: Int[Array, " lanes"]  # number of linearized passes


@functools.cache
def name_for_export() -> None:
    """Register the names of these types for exported traces on disk, once in a process."""
    for kind in (Solution, Located, Finding):
        export.register_namedtuple_serialization(kind, serialized_name=f"vrw_jax.{kind.__name__}")


def surface_start(problem: Problem, parameters: Parameters, with_dls: Array) -> Located:
    """Return the gait that the stored surface predicts. Without DLS its duration is added to
    SLS-I."""
    predicted = gait_on_surface(wheel_of(parameters, problem.n_legs), problem.meshes)
    first, second, third = predicted.durations[0]
    durations = jnp.stack(
        [jnp.where(with_dls, first, 0.0), jnp.where(with_dls, second, first + second), third]
    )
    start = start_from(problem, predicted.section, durations, with_dls)
    accelerations = tuple(
        jnp.broadcast_to(jnp.where(with_dls, a, 0.0), like.shape)
        for a, like in zip(predicted.accelerations, start.solution.accelerations, strict=True)
    )
    return start._replace(solution=start.solution._replace(accelerations=accelerations))


def start_from(problem: Problem, section: Array, durations: Array, with_dls: Array) -> Located:
    """Return a start with section and durations of one step, repeated, and zero accelerations."""
    n, n_phases = problem.period_n, len(problem.sequence.phases)
    lanes = section.shape[-1]
    accelerations = tuple(
        jnp.zeros((n, mesh.n_steps, N_NODES, phase.dim, lanes), section.dtype)
        for phase, mesh in zip(problem.sequence.phases, problem.meshes, strict=True)
    )
    first = jnp.where(with_dls, 1.0, 0.0).astype(section.dtype)
    others = jnp.ones((n, n_phases - 1, lanes), section.dtype)
    happens = jnp.concatenate([jnp.broadcast_to(first, (n, 1, lanes)), others], 1)
    durations = jnp.broadcast_to(durations, (n, n_phases, lanes))
    solution = Solution(section, durations, accelerations)
    return Located(solution, happens, *nothing_known(problem, section))


def nothing_known(problem: Problem, section: Array) -> tuple[Array, Array, Array]:
    """Return `found`, `failed_check` and `ends` of a start."""
    lanes, n_ends = section.shape[1:], 2 * problem.sequence.phases[-1].dim
    zeros = lambda *shape: jnp.zeros((*shape, *lanes), section.dtype)
    return zeros(), zeros(), zeros(problem.period_n, n_ends)


def over_rows(combine: Callable[[Array, Array], Array], x: Array) -> LaneArray:
    """Reduce over all axes but the lanes, by halves, because XLA's reduction runs along the wrong
    axis."""
    if simd.tracing():
        whole = jnp.max if combine is jnp.maximum else jnp.min
        return whole(x, axis=tuple(range(x.ndim - 1)))
    rows = x.reshape(-1, x.shape[-1])
    while rows.shape[0] > 1:
        half = rows.shape[0] // 2
        rest = rows[2 * half :]
        rows = jnp.concatenate([combine(rows[:half], rows[half : 2 * half]), rest])
    return rows[0]


def correction_size(solution: Solution, correction: Solution) -> LaneArray:
    """Return the largest entry of a correction. Accelerations are weighted by their effect on
    positions."""
    largest = functools.partial(over_rows, jnp.maximum)
    size = jnp.maximum(largest(jnp.abs(correction.section)), largest(jnp.abs(correction.durations)))
    for i, change in enumerate(correction.accelerations):
        duration = largest(jnp.abs(solution.durations[:, i]))
        size = jnp.maximum(size, largest(jnp.abs(change)) * duration**2)
    return size


def _limited(solution: Solution, correction: Solution) -> LaneArray:
    """Return the fraction of a correction that keeps all changes of section and durations within
    limits."""
    step_time = jnp.sum(solution.durations, 1, keepdims=True)
    room = jnp.concatenate(
        [
            0.15 * jnp.abs(solution.section) + 0.05,
            (0.25 * jnp.abs(solution.durations) + 0.02 * jnp.abs(step_time)).reshape(
                -1, solution.section.shape[-1]
            ),
        ]
    )
    change = jnp.concatenate(
        [correction.section, correction.durations.reshape(-1, solution.section.shape[-1])]
    )
    tiny = jnp.finfo(change.dtype).tiny
    share = over_rows(jnp.minimum, room / jnp.maximum(jnp.abs(change), tiny))
    return jnp.minimum(1.0, share)


def columns_of(passed: Linearised, located: Located) -> Located:
    """Return the tangents of a pass. The data that select a solution have zero tangents."""
    flat = lambda x: jnp.zeros((passed.d_ends.shape[0], *x.shape), x.dtype)
    found, broken = flat(located.found), flat(located.broken)
    return Located(passed.columns, flat(located.happens), found, broken, passed.d_ends)


class _Iterate(NamedTuple):
    iteration: Int[Array, ""]
    located: Located
    monodromy: LaneArray
    residual: LaneArray
    converged: Bool[Array, " lanes"]
    running: Bool[Array, " lanes"]
    passes: Int[Array, " lanes"]


def _first_iterate(problem: Problem, start: Located, pending: Bool[Array, " lanes"]) -> _Iterate:
    size, dtype = problem.sequence.section_size, start.found.dtype
    lanes = pending.shape[-1]
    return _Iterate(
        iteration=jnp.zeros((), jnp.int32),
        located=start,
        monodromy=jnp.zeros((size, size, lanes), dtype),
        residual=jnp.ones((lanes,), dtype),
        converged=jnp.zeros((lanes,), bool),
        running=pending,
        passes=jnp.zeros((lanes,), jnp.int32),
    )


def newton(
    problem: Problem,
    parameters: Parameters,
    start: Located,
    origin: Parameters,
    stages: Array,
    iterations: Array | int,
    pending: Bool[Array, " lanes"],
) -> Finding:
    """Run Newton's method with limited steps on the `pending` lanes.

    During the first `homotopy_steps` iterations the parameters move from `origin` to their final
    values. A lane stops when it converges or when rounding keeps its corrections from decreasing.
    Its result therefore does not depend on its neighbors.
    """
    options = problem.options
    eps = float(jnp.finfo(parameters.dtype).eps)
    tight, loose = max(options.tolerance, 1e3 * eps), CycleOptions.tolerance

    def iterate(now: _Iterate) -> _Iterate:
        share = jnp.minimum(1.0, (now.iteration + 1) / jnp.maximum(stages, 1)).astype(
            parameters.dtype
        )
        arrived = share >= 1.0
        here = jnp.where(arrived, parameters, origin + share * (parameters - origin))
        solution = now.located.solution
        passed = problem.pass_at(here, now.located)
        correction = passed.correction
        step_size = correction_size(solution, correction)
        sound = jnp.isfinite(step_size)
        share_of_step = _limited(solution, correction)
        moves = now.running & sound
        take = lambda new, old: jnp.where(moves, new, old)

        def moved(x: Array, change: Array) -> Array:
            return jnp.where(moves, x + share_of_step * jnp.where(moves, change, 0.0), x)

        enough = jnp.where(2.0 * step_size > now.residual, loose, tight) if tight < loose else tight
        converged = moves & arrived & (step_size < enough)
        located = now.located._replace(
            solution=jax.tree.map(moved, solution, correction),
            ends=take(passed.ends, now.located.ends),
        )
        return _Iterate(
            iteration=now.iteration + 1,
            located=located,
            monodromy=take(passed.monodromy, now.monodromy),
            residual=take(step_size, now.residual),
            converged=now.converged | converged,
            running=moves & ~converged,
            passes=now.passes + now.running,
        )

    going = lambda now: jnp.any(now.running) & (now.iteration < iterations + stages)
    last = lax.while_loop(going, iterate, _first_iterate(problem, start, pending))
    broken = first_broken(problem, parameters, last.located)
    found = (last.converged & (broken == 0.0)).astype(parameters.dtype)
    broken = jnp.where(last.converged, broken, 0.0)
    located = last.located._replace(found=found, broken=broken)
    return Finding(located, last.monodromy, last.residual, last.passes)


def _least_guards(phase: Phase, constants: Constants, passage: Passage) -> Vector:
    """Return each guard's minimum over the phase's start and nodes, all guards in one loop."""

    def lower(least: Vector, node: tuple[Array, Array]) -> tuple[Vector, None]:
        q, v = node
        guards = phase.guards(constants, Point(passage.nodes.held, tuple(q), tuple(v)))
        return tuple(map(jnp.minimum, least, guards)), None

    at_start = phase.guards(constants, passage.start)
    nodes = jnp.stack(passage.nodes.q, 1), jnp.stack(passage.nodes.v, 1)
    return lax.scan(lower, at_start, nodes)[0]


def first_broken(problem: Problem, parameters: Parameters, located: Located) -> LaneArray:
    """Return 1 + the index in ADMISSIBILITY_CHECKS of the first failed check, 0 if all hold.

    Durations, guards at all nodes and the checks at all transitions must be positive.
    """
    sequence = problem.sequence
    constants = problem.constants_of(*parameters)
    solution = located.solution

    def step(carry: tuple, inputs: tuple) -> tuple:
        section, broken = carry
        durations, accelerations, happens = inputs
        happens = happens > 0.5
        following, passages = walk_through(
            sequence, problem.meshes, constants, tuple(section), durations, accelerations
        )
        holds: list[Array] = []
        for i, (phase, passage) in enumerate(zip(sequence.phases, passages, strict=True)):
            holds.append(~happens[i] | (durations[i] > 0.0))
            ends = phase.guards(constants, passage.end)
            for least, end in zip(_least_guards(phase, constants, passage), ends, strict=True):
                holds.append(~happens[i] | ((least > 0.0) & (end > -ZERO_AT_EVENT)))
        holds += [check > 0.0 for check in sequence.border_checks(constants, passages, happens)]
        for place, good in enumerate(holds):
            broken = jnp.where((broken == 0.0) & ~good, 1.0 + place, broken)
        return (jnp.stack(following), broken), None

    inputs = (solution.durations, solution.accelerations, located.happens)
    carry = (solution.section, jnp.zeros(parameters.shape[-1:], parameters.dtype))
    (_, broken), _ = lax.scan(step, carry, inputs)
    resolved = mesh_error(sequence, problem.meshes, solution) < LARGEST_MESH_ERROR
    return jnp.where((broken == 0.0) & ~resolved, float(MESH), broken)


def _is(attempt: Array, *names: str) -> Array:
    return functools.reduce(operator.or_, [attempt == ATTEMPTS.index(name) for name in names])


def _attempted(
    problem: Problem, attempt: Array, parameters: Parameters, now: Finding, guess: Located | None
) -> Finding:
    options = problem.options
    table_1 = parameters_of(WheelParams(n_legs=problem.n_legs)).astype(parameters.dtype)
    iterations = dict.fromkeys(ATTEMPTS, options.iterations) | {
        "guess": options.first_iterations, "surface": options.first_iterations
    }  # fmt: skip
    limits = [iterations[name] for name in ATTEMPTS] + [options.iterations] * (2 * PIECES)
    pieces = [0] * len(ATTEMPTS) + [1 + i // 2 for i in range(2 * PIECES)]
    of_now = lambda table: jnp.asarray(table, jnp.int32)[attempt]
    origin = jnp.broadcast_to(table_1[:, None], parameters.shape)
    # Each segment is tried twice: from the previous wheel, then without double support.
    piece, again = of_now(pieces), of_now([0] * len(ATTEMPTS) + [0, 1] * PIECES) == 1
    in_pieces = piece > 0
    arrived = ~in_pieces | (piece == PIECES)
    share = piece.astype(parameters.dtype) / PIECES
    here = jnp.where(arrived, parameters, origin + share * (parameters - origin))
    is_homotopy = _is(attempt, "homotopy")
    place = jnp.where(is_homotopy, origin, here)
    with_dls = jnp.broadcast_to(~_is(attempt, "without DLS") & ~again, parameters.shape[-1:])
    stages = jnp.where(is_homotopy, options.stages, 0)
    start = surface_start(problem, place, with_dls)
    goes_on = _is(attempt, "guess, on", "surface, on") | ((piece > 1) & ~again)
    start = jax.tree.map(lambda s, n: jnp.where(goes_on, n, s), start, now.located)
    if guess is not None:
        is_guess = _is(attempt, "guess")
        start = jax.tree.map(lambda s, g: jnp.where(is_guess, g, s), start, guess)
    pending = now.located.found < 0.5
    pending &= ~in_pieces | (now.located.broken == jnp.where(again, LOST_ONCE, 0.0))
    tried = newton(problem, here, start, origin, stages, of_now(limits), pending)
    if problem.period_n == 1:
        on_the_way = _on_the_way(tried.located, arrived, jnp.where(again, LOST, LOST_ONCE))
        located = jax.tree.map(lambda a, b: jnp.where(in_pieces, a, b), on_the_way, tried.located)
        tried = tried._replace(located=located)
    chosen = jax.tree.map(lambda a, b: jnp.where(pending, a, b), tried, now)
    # The first inadmissible root is reported, unless a later one fails only the mesh check.
    before, after = now.located.broken, chosen.located.broken
    broken = jnp.where((before <= 0.0) | (after == MESH), after, before)
    broken = jnp.where(chosen.located.found > 0.5, 0.0, broken)
    located = chosen.located._replace(broken=broken)
    return chosen._replace(located=located, passes=now.passes + tried.passes)


def _on_the_way(tried: Located, arrived: Array, lost: Array) -> Located:
    """Return what a wheel on the homotopy implies for the wheel at its end, `failure_code` if
    nothing."""
    found, broken = tried.found, tried.broken
    goes_on = ~arrived & ((found > 0.5) | (broken == MESH))
    ends = jnp.where(arrived, broken, broken + ON_THE_WAY)
    told = jnp.where((found > 0.5) | (broken > 0.0), ends, lost)
    told = jnp.where(goes_on, 0.0, told)
    return tried._replace(found=jnp.where(arrived, found, 0.0), broken=told)


def search_lanes(
    problem: Problem,
    parameters: Parameters,
    now: Finding,
    attempt: Int[Array, ""],
    end: Int[Array, ""],
    guess: Located | None = None,
) -> Finding:
    """Run the attempts from `attempt_index` to before `end_index`, in turn, on the lanes without a
    cycle.

    The parameters must be in their domains.
    """

    def more(carry: tuple[Array, Finding]) -> Array:
        attempt, now = carry
        return (attempt < end) & jnp.any(_open(attempt, now))

    def go_on(carry: tuple[Array, Finding]) -> tuple[Array, Finding]:
        attempt, now = carry
        return attempt + 1, _attempted(problem, attempt, parameters, now, guess)

    return lax.while_loop(more, go_on, (attempt, now))[1]


def in_stages(problem: Problem, search: LaneFunction, *given: Any) -> Finding:
    """Return a limit cycle for each lane of (parameters, guess if any), by all attempts of
    `search`.

    Blocks of lanes are searched side by side, and a block takes as long as its slowest lane. Before
    each stage, the lanes that are still without a cycle are therefore gathered.
    """
    parameters, n_lanes = given[0], given[0].shape[-1]
    # With several steps, a repeated gait of one step would be followed, which decides nothing.
    n_attempts = len(ATTEMPTS) + 2 * PIECES * (problem.period_n == 1)
    first = jnp.asarray(ATTEMPTS.index("surface" if len(given) == 1 else "guess"), jnp.int32)
    now = not_searched(problem, parameters)
    if n_lanes <= FEW:
        return search(parameters, now, first, jnp.asarray(n_attempts, jnp.int32), *given[1:])

    def more(carry: tuple) -> Array:
        attempt, _, now, _ = carry
        return (attempt < n_attempts) & jnp.any(_open(attempt, now))

    def stage(carry: tuple) -> tuple:
        attempt, places, *lanes = carry
        order = jnp.argsort(~_open(attempt, lanes[0]), stable=True)
        places, now, given = jax.tree.map(lambda x: x[..., order], (places, *lanes))
        end = jnp.where(attempt < len(ATTEMPTS), attempt + 1, n_attempts)
        return end, places, search(given[0], now, attempt, end, *given[1:]), given

    begin = first, jnp.arange(n_lanes), now, given
    _, places, found, _ = lax.while_loop(more, stage, begin)
    back = jnp.argsort(places)
    return jax.tree.map(lambda x: x[..., back], found)


def _open(attempt: Int[Array, ""], now: Finding) -> Bool[Array, " lanes"]:
    """Return whether this attempt can still change the result of a lane."""
    known = (now.located.broken > 0.0) | (now.located.broken == LOST)
    return (now.located.found < 0.5) & ((attempt < len(ATTEMPTS)) | ~known)


def not_searched(problem: Problem, parameters: Parameters) -> Finding:
    size, n_phases = problem.sequence.section_size, len(problem.sequence.phases)
    zeros = lambda *shape: jnp.zeros((*shape, parameters.shape[-1]), parameters.dtype)
    return Finding(
        start_from(problem, zeros(size), zeros(n_phases), zeros() > 0.0),
        zeros(size, size),
        zeros() + jnp.inf,
        zeros().astype(jnp.int32),
    )


MESH = len(SIGNS)
"""`CollocationState.failed_check` of a root that the mesh does not resolve."""

ON_THE_WAY, LOST_ONCE, LOST = float(len(SIGNS)), -1.0, -2.0
"""Codes in `CollocationState.failed_check`. The first is the offset of a check that fails before
the wheel is reached. The others are failures of Newton's method at the first try and at both."""

ZERO_AT_EVENT = 1e-6
"""Tolerance below zero of a guard at the end of the phase that it ends, N, m or rad/s."""

LARGEST_MESH_ERROR = 1e-5
"""Estimate of the mesh error above which a solution does not count as found. In all of some hundred
random wheels the errors themselves are below it, and mostly by far."""

ATTEMPTS = ("guess", "guess, on", "surface", "surface, on", "homotopy", "without DLS")
"""Attempts in their order. They start from the guess, if any, and from the gait that the stored
surface predicts. A homotopy from Table 1 follows, then a cycle without double support. The first
two begin with a few iterations, so that a batch can gather the lanes that need more in separate
blocks."""

FEW = 16
"""Largest number of lanes that are searched without gathering."""

PIECES = 16
"""Number of segments of the homotopy. If no root is found, the gait of Table 1 is followed from
wheel to wheel on the line to this wheel. Either it arrives, or the segment where it ends gives the
reason."""

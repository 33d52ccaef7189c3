"""Limit cycles of the paper's model as differentiable functions of its parameters.

The search (see `collocation_search`) carries no derivative. Derivatives come from the implicit
function theorem: they are the tangents of the linearized pass at the cycle. They are valid on
unstable cycles, in forward and reverse mode, and to any order.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.derivatives import attach_monodromy, solve_cycle
from vrw_jax.cycles.premises import takeoff_acceleration
from vrw_jax.cycles.search import MESH, Located, Problem, nothing_known
from vrw_jax.cycles.sequence import SIGNS
from vrw_jax.models import Indicators, Margins, SectionState, ViscoelasticWheel
from vrw_jax.numerics import (
    N_NODES,
    Options,
    Scalar,
    Solution,
    compiled_by_caller,
    floquet,
    mesh_error,
    transfer_matrix,
)
from vrw_jax.walks import step
from vrw_jax.wheel import (
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    parameters_of,
    phases_of,
    transitions,
    wheel_of,
)
from vrw_jax.wording import Row, listed


class LimitCycle(AbstractCycle):
    """Gait of the paper's model, found by collocation. Batched under vmap.

    See `AbstractCycle`. It is differentiable in the parameters, in every mode and to any order.

    - `section_state`: (theta-, dtheta-, dL1-) before touchdown, fixed under return_map;
    - `post_impact`: (theta, dtheta) after the first landing, rad, rad/s;
    - `durations`: of DLS, SLS-I, SLS-II, s; (n, 3) for period_n = n > 1;
    - `step_length`: distance between the feet at the landing, m; (n,) for n > 1;
    - `indicators`: of the landing; (n,) each for n > 1;
    - `outcome`: Outcome.STEPPED, or the reason of the failure;
    - `residual`: last correction of Newton's method, rad, rad/s, s or m;
    - `n_newton_iterations`: number of linearized passes of the search;
    - `parameters`: in the order of params.PARAMETER_NAMES;
    - `collocation_state`: the solution with its phases, a start for neighbors;
    - `monodromy_value`: monodromy matrix, without derivative;
    - `system`, `model`: the collocation system and the model.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams())
        >>> bool(cycle.found), cycle.multipliers.round(3).tolist()
        (True, [(0.329+0j), (0.022-0j)])
    """

    section_state: SectionState
    post_impact: Float[Array, "2"]
    durations: Float[Array, "*n 3"]
    step_length: Float[Array, "*n"]
    indicators: Indicators
    outcome: Int[Array, ""]
    residual: Scalar
    passes: Int[Array, ""]
    parameters: Float[Array, " n_parameters"]
    located: Located
    matrix: Float[Array, "2 2"]
    problem: Problem = eqx.field(static=True)
    model: ViscoelasticWheel = eqx.field(
        default_factory=ViscoelasticWheel
    )  # whose ground `margins` uses

    @property
    def period_n(self) -> int:
        return self.problem.period_n

    @property
    def near(self) -> Located:
        return self.located

    def _mapped(self, of_one: Callable) -> Callable:
        """Map a function of one cycle over the axes of this batch."""
        for _ in range(self.outcome.ndim):
            of_one = jax.vmap(of_one)
        return of_one

    @property
    def monodromy(self) -> Float[Array, "... 2 2"]:
        """Return the Jacobian of the return map on the section after the impact, over (theta+,
        dtheta+).

        A third multiplier, on the section before the impact, is zero.
        """
        attach_one = attach_monodromy if compiled_by_caller() else _compiled_attach
        attach = self._mapped(functools.partial(attach_one, self.problem))
        return attach(self.matrix, self.parameters, self.located)

    @property
    def jury_margins(self) -> Array:
        """Return the margins to fold, period doubling and Neimark-Sacker: see
        floquet.jury_margins."""
        return floquet.jury_margins(self.monodromy)

    @property
    def at_double_multiplier(self) -> Bool[Array, "..."]:
        """Return whether the spectral radius has a kink because two multipliers are equal."""
        return floquet.at_double_multiplier(self.matrix) & self.found

    @property
    def mesh_error(self) -> Array:
        """Return an estimate of the mesh's error, mostly too large: see
        collocation.estimate_mesh_error.

        Above 1e-5 a gait does not count as found. More mesh intervals in `CycleOptions` reduce it.
        """
        of_one = functools.partial(_mesh_error, self.problem)
        return self._mapped(of_one)(self.found, self.located.solution)

    @property
    def takeoff_acceleration(self) -> Array:
        """Return the rear foot's acceleration at take-off, m/s^2, least over the steps: see
        `margin_defaults`."""
        of_one = functools.partial(_takeoff, self.problem)
        return self._if_found(self._mapped(of_one)(self.parameters, self.located))

    @property
    def monitors(self) -> Margins:
        """Return the margins over the (first) step, computed by one event-driven step."""

        def walk(parameters: Array, section_state: Array) -> Margins:
            wheel = wheel_of(parameters, self.problem.n_legs)
            return step(wheel, section_state, model=self.model).monitors

        return self._mapped(walk)(self.parameters, self.section_state)

    @property
    def why(self) -> str:
        if self.outcome not in (Outcome.ORDER_DIFFERS, Outcome.BORDER_ON_THE_WAY):
            return super().why
        sign = SIGNS[int(self.located.broken - 1) % len(SIGNS)]
        return f"{super().why} Broken: {sign}."

    def own_rows(self) -> list[Row]:
        forces = self.indicators
        told = f"{listed(forces.lambda_I4)} N s, {listed(forces.lambda_2)} N"
        return [
            ("durations of DLS, SLS-I, SLS-II", f"{listed(self.durations)} s"),
            ("indicators λ_I4, λ2⁺, λ4⁺", f"{told}, {listed(forces.lambda_4)} N"),
        ]


@functools.partial(jax.jit, static_argnums=0)
def _mesh_error(problem: Problem, found: Array, solution: Solution) -> Array:
    lanes = jax.tree.map(lambda x: x[..., None], solution)
    return jnp.where(found, mesh_error(problem.sequence, problem.meshes, lanes)[0], 0.0)


@functools.partial(jax.jit, static_argnums=0)
def _takeoff(problem: Problem, parameters: Array, located: Located) -> Array:
    s = wheel_of(parameters, problem.n_legs).symbols()
    _, steps = problem.passages(parameters, located.solution)
    return jnp.min(jnp.stack([takeoff_acceleration(s, sls1) for _, sls1, _ in steps]))


_compiled_attach = jax.jit(attach_monodromy, static_argnums=0)


def solved(params: WheelParams, problem: Problem, guess: Located | None) -> LimitCycle:
    find = _find_cycle if compiled_by_caller() else _compiled_find_cycle
    return find(params, problem, guess)


def _find_cycle(params: WheelParams, problem: Problem, guess: Located | None) -> LimitCycle:
    usable = params.in_domain()
    table_1 = WheelParams(n_legs=problem.n_legs)
    safe = jax.tree.map(lambda x, d: jnp.where(usable, x, d.astype(x.dtype)), params, table_1)
    parameters = parameters_of(safe)
    located, (matrix, residual, passes) = solve_cycle(problem, parameters, guess)
    found = usable & (located.found > 0.5)
    # Mask inputs and outputs: measures and derivatives are zero where there is no cycle.
    masked = lambda x: jnp.where(found, x, 0.0)
    stand_in = lambda x, d: jnp.where(found, x, d)
    parameters = jax.tree.map(stand_in, parameters, parameters_of(table_1).astype(parameters.dtype))

    s = wheel_of(parameters, problem.n_legs).symbols()
    n = problem.period_n
    # theta, its rate and the rate of L1: L1 itself follows from theta at touchdown.
    states = jnp.concatenate([located.ends[:, :1], located.ends[:, 2:]], 1)
    # The landing at the start of a step follows the state at the end of the previous step.
    landings = jax.vmap(lambda x: transitions.land(s, *x))(jnp.roll(states, 1, 0))
    fore, rear = jax.vmap(lambda landing: transitions.landing_forces(s, landing))(landings)

    def over_steps(values: Array) -> Array:
        return masked(values[0] if n == 1 else values)

    durations = located.solution.durations
    code = jnp.where(located.broken > 0.0, Outcome.ORDER_DIFFERS, Outcome.NO_CYCLE_FOUND)
    code = jnp.where(located.broken == MESH, Outcome.MESH_TOO_COARSE, code)
    code = jnp.where(located.broken > MESH, Outcome.BORDER_ON_THE_WAY, code)
    code = jnp.where(found, Outcome.STEPPED, code)
    return LimitCycle(
        section_state=masked(states[-1]),
        post_impact=masked(located.solution.section),
        durations=over_steps(durations),
        step_length=over_steps(landings.distance),
        indicators=Indicators(
            lambda_I4=over_steps(landings.rear.normal),
            lambda_2=over_steps(fore.normal),
            lambda_4=over_steps(rear.normal),
        ),
        outcome=jnp.where(usable, code, Outcome.BAD_INPUT).astype(jnp.int32),
        residual=jnp.where(jnp.isfinite(residual), residual, 1.0),
        passes=passes,
        parameters=parameters,
        located=located,
        matrix=masked(matrix),
        problem=problem,
    )


_compiled_find_cycle = eqx.filter_jit(_find_cycle)

N_SAMPLES = 1025
"""Number of points of each phase between which a walked guess is interpolated. With too few (33 at
c = 221), the fast start of a step without double support is lost and Newton's method fails."""


class SampledWalk(NamedTuple):
    """Event-driven walk, sampled as a start on any mesh."""

    post_impact: Float[Array, "2"]  # (theta, dtheta) after the first landing
    distances: Float[Array, " n"]  # between the feet at each landing, m
    durations: Float[Array, "n 3"]
    states: Float[Array, "n 3 n_samples 6"]  # theta, L1, L2 and their rates in each phase


@eqx.filter_jit
def sampled_walk(
    model: ViscoelasticWheel, params: WheelParams, x: SectionState, n_steps: int
) -> SampledWalk:
    """Return `n_steps` event-driven steps from a section state, sampled in time."""
    options, s = Options(), params.symbols()
    landing = transitions.land(s, *x)
    section = jnp.stack([landing.theta, landing.motion.dtheta])

    def one(x: Array, _: None) -> tuple[Array, tuple]:
        walked = model.trace(params, x, options, N_SAMPLES)
        told = transitions.land(s, *x).distance, walked.durations, walked.state
        return walked.section_state, told

    _, told = lax.scan(one, x, None, length=n_steps)
    return SampledWalk(section, *told)


@eqx.filter_jit
def guess_along(problem: Problem, params: WheelParams, walked: SampledWalk) -> Located:
    """Return the cycle's unknowns from a walk of `period_n` steps."""
    accelerations = functools.partial(_accelerations_along, problem, params.symbols())
    happens = (walked.durations > 0.0).astype(walked.durations.dtype)
    by_phase = jax.vmap(accelerations)(walked.distances, walked.states)
    solution = Solution(walked.post_impact, walked.durations, by_phase)
    nothing = nothing_known(problem, walked.post_impact)
    return lax.stop_gradient(Located(solution, happens, *nothing))


@functools.partial(jax.jit, static_argnums=(0, 1))
def on_mesh(known: Problem, wanted: Problem, found: Solution) -> Solution:
    """Return a solution transferred to another mesh. The accelerations in each mesh interval are a
    polynomial."""
    accelerations = []
    for old, new, rows in zip(known.meshes, wanted.meshes, found.accelerations, strict=True):
        matrix = jnp.asarray(transfer_matrix(old, new), found.section.dtype)
        n, _, _, dim = rows.shape
        moved = jnp.einsum("ij,njd->nid", matrix, rows.reshape(n, -1, dim))
        accelerations.append(moved.reshape(n, new.n_steps, N_NODES, dim))
    return Solution(found.section, found.durations, tuple(accelerations))


def _accelerations_along(
    problem: Problem, s: Symbols, distance: Scalar, states: Float[Array, "3 n_samples 6"]
) -> tuple[Array, ...]:
    """Return accelerations at the nodes of each phase, (step, node, coordinate), of a sampled
    step."""
    told, phases = [], phases_of(s, distance, stop_at_lift_off=False)
    known = jnp.linspace(0.0, 1.0, states.shape[1])
    for phase, mesh, sampled in zip(phases, problem.meshes, states, strict=True):
        rows = [jnp.interp(jnp.asarray(mesh.node_times), known, row) for row in sampled.T]
        nodes = jnp.stack(phase.acceleration(Motion.of(*rows))[: phase.n], axis=-1)
        told.append(nodes.reshape(mesh.n_steps, N_NODES, phase.n))
    return tuple(told)

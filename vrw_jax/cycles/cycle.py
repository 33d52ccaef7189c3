"""Limit cycles as differentiable functions of the parameters.

The search (see `search`) carries no derivative. Derivatives come from the implicit function
theorem: the columns of the linearised pass at the cycle. They hold on unstable cycles, in forward
and reverse mode, and to any order.
"""

import functools
from collections.abc import Callable, Sequence
from typing import overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from vrw_jax.cycles.derivatives import attach_monodromy, solve_cycle
from vrw_jax.cycles.options import CycleOptions
from vrw_jax.cycles.search import Located, Problem, nothing_known
from vrw_jax.cycles.section_cycle import WalkedCycle, walked_cycle
from vrw_jax.models import AbstractWheel, Indicators, Margins, SectionState, ViscoelasticWheel
from vrw_jax.numerics import (
    N_NODES,
    Options,
    Scalar,
    Solution,
    compiled_by_caller,
    floquet,
    mesh_error,
)
from vrw_jax.results import Row, as_html, as_text, is_concrete, listed
from vrw_jax.walks import checked, step
from vrw_jax.wheel import (
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    dynamics,
    parameters_of,
    transitions,
    wheel_of,
)


class LimitCycle(eqx.Module):
    """A gait that repeats after `period_n` steps. Batched under vmap: every field gains the axis.

    Where none was found, `outcome` says so and every other number is zero, as are its derivatives.
    Fields with an axis over steps lack it for `period_n` = 1.
    """

    section_state: SectionState  # (theta-, dtheta-, dL1-) before touchdown, fixed under return_map
    post_impact: Float[Array, "2"]  # (theta, dtheta) after the first landing, rad, rad/s
    durations: Float[Array, "*n 3"]  # of DLS, SLS-I, SLS-II, s; (n, 3) for period_n = n > 1
    step_length: Float[Array, "*n"]  # distance between the feet at the landing, m; (n,) for n > 1
    indicators: Indicators  # of the landing; (n,) each for n > 1
    outcome: Int[Array, ""]  # Outcome.STEPPED, NO_CYCLE_FOUND or BAD_INPUT
    residual: Scalar  # last correction of Newton's method, rad, rad/s, s or m
    passes: Int[Array, ""]  # linearised passes that the search took
    parameters: Float[Array, " n_parameters"]  # in the order of params.PARAMETER_NAMES
    located: Located  # the solution itself: a start for neighbours
    matrix: Float[Array, "2 2"]  # value of the monodromy matrix, without derivative
    problem: Problem = eqx.field(static=True)

    @property
    def _many(self) -> bool:
        return self.problem.period_n > 1

    def _mapped(self, of_one: Callable) -> Callable:
        """A function of one cycle, over the axes of this batch."""
        for _ in range(self.outcome.ndim):
            of_one = jax.vmap(of_one)
        return of_one

    @property
    def period(self) -> Array:
        """Duration of the whole cycle, s."""
        return jnp.sum(self.durations, axis=(-2, -1) if self._many else -1)

    @property
    def dls_fraction(self) -> Array:
        """Share of the period spent in double support."""
        dls = self.durations[..., 0]
        period = self.period
        return (jnp.sum(dls, -1) if self._many else dls) / jnp.where(period > 0.0, period, 1.0)

    @property
    def speed(self) -> Array:
        """Distance over period, m/s."""
        period = self.period
        distance = jnp.sum(self.step_length, -1) if self._many else self.step_length
        return distance / jnp.where(period > 0.0, period, 1.0)

    @property
    def monodromy(self) -> Float[Array, "... 2 2"]:
        """Derivative of the return to the section after the impact, over (theta+, dtheta+)."""
        attach_one = attach_monodromy if compiled_by_caller() else _compiled_attach
        attach = self._mapped(functools.partial(attach_one, self.problem))
        return attach(self.matrix, self.parameters, self.located)

    @property
    def multipliers(self) -> Complex[Array, "... n"]:
        """Floquet multipliers, largest first; a third one, in the section before, is zero."""
        return floquet.multipliers(self.monodromy)

    @property
    def spectral_radius(self) -> Array:
        """Largest modulus of a multiplier: below 1 the gait is stable."""
        return floquet.spectral_radius(self.monodromy)

    @property
    def stability_margin(self) -> Array:
        """Smooth measure of stability, positive where stable: see multipliers.stability_margin."""
        return jnp.where(self.found, floquet.stability_margin(self.monodromy), 0.0)

    @property
    def jury_margins(self) -> Array:
        """Margins to fold, period doubling, Neimark-Sacker: see multipliers.jury_margins."""
        return floquet.jury_margins(self.monodromy)

    @property
    def at_double_multiplier(self) -> Bool[Array, "..."]:
        """Whether the spectral radius is at a kink, because two multipliers tie."""
        return floquet.at_double_multiplier(self.matrix) & self.found

    @property
    def condition(self) -> Array:
        """Condition number of I - monodromy: how much the cycle magnifies a disturbance."""
        matrix = jnp.eye(self.matrix.shape[-1]) - self.matrix
        return jnp.where(self.found, jnp.linalg.cond(matrix), 0.0)

    @property
    def mesh_error(self) -> Array:
        """Estimate, mostly too large, of the mesh's error: see collocation.mesh_error.

        Above 1e-5 a gait does not count as found: give `CycleOptions` more steps.
        """

        def of_one(solution: Solution) -> Array:
            lanes = jax.tree.map(lambda x: x[..., None], solution)
            return mesh_error(self.problem.sequence, self.problem.meshes, lanes)[0]

        return jnp.where(self.found, self._mapped(of_one)(self.located.solution), 0.0)

    @property
    def monitors(self) -> Margins:
        """The premises' margins over the (first) step, by walking it once event by event."""

        def walk(parameters: Array, section_state: Array) -> Margins:
            wheel = wheel_of(parameters, self.problem.n_legs)
            return step(wheel, section_state).monitors

        return self._mapped(walk)(self.parameters, self.section_state)

    @property
    def found(self) -> Bool[Array, "..."]:
        """Whether there is a cycle."""
        return self.outcome == Outcome.STEPPED

    def rows(self) -> list[Row]:
        """What the cycle says of itself; of many, how many were found."""
        outcome = np.asarray(self.outcome)
        if outcome.ndim:
            found = int(np.sum(outcome == Outcome.STEPPED))
            return [("wheels", f"{outcome.size} in shape {outcome.shape}, {found} with a gait")]
        if outcome != Outcome.STEPPED:
            code = Outcome(int(outcome))
            return [("outcome", f"{code.name}: {code.meaning}")]
        multipliers = sorted(np.linalg.eigvals(np.asarray(self.matrix)), key=abs, reverse=True)
        radius = float(np.max(np.abs(multipliers)))
        told = ", ".join(f"{z:.5f}" if z.imag else f"{z.real:.5f}" for z in multipliers)
        forces = self.indicators
        many = self.problem.period_n > 1
        return [
            ("gait", f"{'stable' if radius < 1.0 else 'unstable'}, repeats after "
             f"{f'{self.problem.period_n} steps' if many else 'one step'}"),
            ("double support", f"{100 * float(self.dls_fraction):.3f} %"),
            ("period", f"{float(self.period):.6f} s"),
            ("speed", f"{float(self.speed):.6f} m/s"),
            ("durations of DLS, SLS-I, SLS-II", f"{listed(self.durations)} s"),
            ("after landing: angle, rate", f"{listed(self.post_impact)} rad, rad/s"),
            ("indicators λ_I4, λ2⁺, λ4⁺", f"{listed(forces.lambda_I4)} N s, "
             f"{listed(forces.lambda_2)} N, {listed(forces.lambda_4)} N"),
            ("multipliers", f"{told}; spectral radius {radius:.6f}"),
        ]  # fmt: skip

    def __repr__(self) -> str:
        return as_text("LimitCycle", self.rows()) if is_concrete(self) else eqx.tree_pformat(self)

    def _repr_html_(self) -> str:
        return as_html("Limit cycle", self.rows())


_compiled_attach = jax.jit(attach_monodromy, static_argnums=0)


def _limit_cycle(params: WheelParams, problem: Problem, guess: Located | None) -> LimitCycle:
    find = _find_cycle if compiled_by_caller() else _compiled_find_cycle
    return find(params, problem, guess)


def _find_cycle(params: WheelParams, problem: Problem, guess: Located | None) -> LimitCycle:
    usable = params.in_domain()
    table_1 = WheelParams(n_legs=problem.n_legs)
    safe = jax.tree.map(lambda x, d: jnp.where(usable, x, d.astype(x.dtype)), params, table_1)
    parameters = parameters_of(safe)
    located, (matrix, residual, passes) = solve_cycle(problem, parameters, guess)
    found = usable & (located.found > 0.5)
    # Zero measures and zero derivatives where there is no cycle: mask what goes in and comes out.
    masked = lambda x: jnp.where(found, x, 0.0)
    stand_in = lambda x, d: jnp.where(found, x, d)
    parameters = jax.tree.map(stand_in, parameters, parameters_of(table_1).astype(parameters.dtype))

    s = wheel_of(parameters, problem.n_legs).symbols()
    n = problem.period_n
    # theta, its rate and that of L1: L1 itself follows from theta at touchdown.
    states = [jnp.stack([end[0], *end[2:]]) for end in located.ends]
    # The landing that opens step k follows the state at the end of the step before.
    landings = [transitions.land(s, *states[k - 1]) for k in range(n)]
    forces = [transitions.landing_forces(s, landing) for landing in landings]

    def over_steps(values: list[Array]) -> Array:
        return masked(values[0] if n == 1 else jnp.stack(values))

    durations = located.solution.durations
    code = jnp.where(found, Outcome.STEPPED, Outcome.NO_CYCLE_FOUND)
    return LimitCycle(
        section_state=masked(states[-1]),
        post_impact=masked(located.solution.section),
        durations=masked(durations[0] if n == 1 else durations),
        step_length=over_steps([landing.distance for landing in landings]),
        indicators=Indicators(
            lambda_I4=over_steps([landing.rear.normal for landing in landings]),
            lambda_2=over_steps([fore.normal for fore, _ in forces]),
            lambda_4=over_steps([rear.normal for _, rear in forces]),
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
"""Points of each phase between which a walked guess is interpolated. With too few, 33 at c = 221,
the fast start of a step without double support is lost, and Newton with it."""


@eqx.filter_jit
def _walked_guess(params: WheelParams, problem: Problem, x: SectionState) -> Located:
    """The cycle's unknowns as `period_n` event-driven steps from a section state tell them."""
    model, options, s = ViscoelasticWheel(), Options(), params.symbols()
    landing = transitions.land(s, *x)
    section = jnp.stack([landing.theta, landing.motion.dtheta])
    durations, accelerations = [], []
    for _ in range(problem.period_n):
        distance = transitions.land(s, *x).distance
        states = model.trace(params, x, options, N_SAMPLES).state
        walked = model.advance(params, x, options)
        x = walked.section_state
        durations.append(walked.durations)
        accelerations.append(_accelerations_along(problem, s, distance, states))
    together = jnp.stack(durations)
    by_phase = tuple(jnp.stack(steps) for steps in zip(*accelerations, strict=True))
    happens = (together > 0.0).astype(section.dtype)
    solution = Solution(section, together, by_phase)
    return lax.stop_gradient(Located(solution, happens, *nothing_known(problem, section)))


def _accelerations_along(
    problem: Problem, s: Symbols, distance: Scalar, states: Float[Array, "3 n_samples 6"]
) -> tuple[Array, ...]:
    """Accelerations at the nodes of each phase, (step, node, coordinate), of a sampled step."""
    told = []
    for i, (phase, mesh) in enumerate(zip(problem.sequence.phases, problem.meshes, strict=True)):
        known, wanted = jnp.linspace(0.0, 1.0, states.shape[1]), jnp.asarray(mesh.node_times)
        rows = [jnp.interp(wanted, known, states[i, :, j]) for j in range(states.shape[2])]
        motion = Motion.of(*rows)
        acceleration = (
            dynamics.double_support_acceleration(s, distance, motion),
            dynamics.single_support_1_acceleration(s, motion),
            dynamics.single_support_2_acceleration(s, motion),
        )[i]
        nodes = jnp.stack(acceleration[: phase.dim], axis=-1)
        told.append(nodes.reshape(mesh.n_steps, N_NODES, phase.dim))
    return tuple(told)


Guess = LimitCycle | WalkedCycle | Array | np.ndarray | Sequence[float]
"""A neighbour's cycle, or a section state near the one that is wanted."""


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: None = None,
    options: CycleOptions | Options | None = None,
) -> LimitCycle: ...


@overload
def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: AbstractWheel,
    options: CycleOptions | Options | None = None,
) -> LimitCycle | WalkedCycle: ...


def limit_cycle(
    params: WheelParams,
    *,
    guess: Guess | None = None,
    period_n: int = 1,
    model: AbstractWheel | None = None,
    options: CycleOptions | Options | None = None,
) -> LimitCycle | WalkedCycle:
    """The limit cycle of this wheel: the gait that repeats after `period_n` steps.

    Needs no start for `period_n` 1. `guess`, a neighbour's cycle or a section state (theta-,
    dtheta-, dL1-) near the gait, makes it quicker and picks the branch. Found cycles satisfy the
    paper's sequence of phases at all nodes, stable or not. Errors at the default options: 1e-9
    relative in values, 1e-8 in first derivatives, while steps last some 1.5 s at most; longer ones
    are told by `mesh_error`, and not found above 1e-5. Differentiable in every mode and order;
    `jax.vmap` runs the wheels side by side.

    Any other rung as `model` is solved on its own return map, with `Options` of its step: a
    `WalkedCycle`, to the step's errors.
    """
    if period_n < 1:
        raise ValueError(f"period_n is {period_n}, but a gait repeats after 1 step or more.")
    if model is not None and not isinstance(model, ViscoelasticWheel):
        if isinstance(options, CycleOptions):
            raise TypeError(
                f"options is a CycleOptions, but {type(model).__name__} is solved on its return "
                "map: give the vrw.Options of its step."
            )
        start = guess.section_state if isinstance(guess, LimitCycle | WalkedCycle) else guess
        return walked_cycle(params, model, start, period_n, options)
    if isinstance(options, Options):
        raise TypeError(
            "options is an Options, but the paper's wheel is solved by collocation: "
            "give vrw.CycleOptions(), or CycleOptions.tight()."
        )
    options = CycleOptions() if options is None else options
    problem = Problem(params.n_legs, period_n, options)
    if guess is None:
        located = None
    elif isinstance(guess, LimitCycle) and guess.problem == problem:
        located = guess.located
    else:
        known = isinstance(guess, LimitCycle | WalkedCycle)
        x = guess.section_state if known else guess  # type: ignore[union-attr]
        params, state, _, _ = checked(params, x, None, None)
        located = _walked_guess(params, problem, state)
    return _limit_cycle(params, problem, located)

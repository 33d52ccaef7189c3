"""Limit cycles of the paper's model as differentiable functions of its parameters.

The search (see `collocation_search`) carries no derivatives. They come from the implicit function
theorem as the tangents of the linearized pass at the cycle. They are valid on unstable cycles, in
forward and reverse mode, and to any order.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.collocation import (
    N_GAUSS_NODES,
    CollocationSolution,
    estimate_mesh_error,
    mesh_transfer_matrix,
)
from vrw_jax.continuation import floquet
from vrw_jax.cycles.collocation_search import (
    MESH_CHECK_CODE,
    CollocationState,
    CollocationSystem,
    init_search_flags,
)
from vrw_jax.cycles.cycle import AbstractCycle
from vrw_jax.cycles.derivatives import attach_monodromy_derivatives, solve_cycle_with_derivatives
from vrw_jax.cycles.force_peaks import compute_force_peaks
from vrw_jax.cycles.margin_defaults import compute_takeoff_acceleration
from vrw_jax.cycles.phase_sequence import ADMISSIBILITY_CHECKS
from vrw_jax.cycles.slope_response import (
    COLLOCATION_RESPONSE_MEASURES,
    SlopeResponse,
    compute_collocation_slope_response,
    compute_sensitivity_norms,
)
from vrw_jax.measures import FORCE_PEAK_MEASURES
from vrw_jax.models import DoubleSupportIndicators, Margins, SectionState, ViscoelasticWheel
from vrw_jax.numerics import Scalar, StepOptions, is_inside_jit
from vrw_jax.printing import LabelAndText, format_numbers, map_text_of_elements
from vrw_jax.runtime import with_default_jax_settings
from vrw_jax.simulation import step
from vrw_jax.wheel import (
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    make_phases,
    make_wheel_from_parameters,
    stack_parameters,
    transitions,
)


class LimitCycle(AbstractCycle):
    """Gait of the paper's model, found by collocation; batched under vmap.

    See `AbstractCycle`. It is differentiable in the parameters, in every mode and to any order.

    - `section_state`: (theta-, dtheta-, dL1-) before touchdown, fixed under return_map;
    - `post_impact`: (theta, dtheta) after the first landing, rad, rad/s;
    - `durations`: durations of DLS, SLS-I, SLS-II, s; (n, 3) for period_n = n > 1;
    - `step_length`: distance between the feet at the landing, m; (n,) for n > 1;
    - `indicators`: indicators of double support at the landing; (n,) each for n > 1;
    - `outcome`: Outcome.STEPPED, or the reason of the failure;
    - `residual`: last correction of Newton's method, in the wheel's own units;
    - `n_newton_iterations`: number of linearized passes of the search;
    - `parameters`: float parameters in the order of params.PARAMETER_NAMES;
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
    indicators: DoubleSupportIndicators
    outcome: Int[Array, ""]
    residual: Scalar
    n_newton_iterations: Int[Array, ""]
    parameters: Float[Array, " n_parameters"]
    collocation_state: CollocationState
    monodromy_value: Float[Array, "2 2"]
    system: CollocationSystem = eqx.field(static=True)
    model: ViscoelasticWheel = eqx.field(
        default_factory=ViscoelasticWheel
    )  # `margins` uses its ground.

    @property
    def period_n(self) -> int:
        return self.system.period_n

    @property
    def step_ends(self) -> Array:
        return jnp.asarray(self.collocation_state.step_end_states)

    @property
    def warm_start(self) -> CollocationState:
        return self.collocation_state

    def _vmap_over_batch_axes(self, function: Callable) -> Callable:
        """Return `function` of one cycle, mapped over the batch axes of this cycle."""
        for _ in range(self.outcome.ndim):
            function = jax.vmap(function)
        return with_default_jax_settings(function)

    @property
    def monodromy(self) -> Float[Array, "... 2 2"]:
        """Return the Jacobian of the return map after the impact, in the coordinates (theta+,
        dtheta+).

        On the section before the impact there is a third multiplier, which is zero.
        """
        attach_derivatives = (
            attach_monodromy_derivatives if is_inside_jit() else _attach_monodromy_compiled
        )
        attach_derivatives_to_batch = self._vmap_over_batch_axes(
            functools.partial(attach_derivatives, self.system)
        )
        return attach_derivatives_to_batch(
            self.monodromy_value, self.parameters, self.collocation_state
        )

    @property
    def jury_margins(self) -> Array:
        """Return the margins to fold, period doubling and Neimark-Sacker bifurcation.

        See `floquet.jury_margins`.
        """
        return floquet.jury_margins(self.monodromy)

    @property
    def has_double_multiplier(self) -> Bool[Array, "..."]:
        """Return whether the spectral radius has a kink because two multipliers are equal."""
        return floquet.has_double_multiplier(self.monodromy_value) & self.found

    @property
    def mesh_error(self) -> Array:
        """Return an estimate of the mesh's error, which in most cases exceeds the error.

        See `collocation.estimate_mesh_error`. Above 1e-5 a gait does not count as found. More mesh
        intervals in `CycleOptions` reduce the error.
        """
        estimate_error = functools.partial(_estimate_found_mesh_error, self.system)
        return self._vmap_over_batch_axes(estimate_error)(
            self.found, self.collocation_state.solution
        )

    @property
    def takeoff_acceleration(self) -> Array:
        """Return the rear foot's acceleration at take-off, m/s^2, the least over the steps.

        See `margin_defaults`.
        """
        compute_least_takeoff_acceleration = functools.partial(
            _compute_takeoff_acceleration, self.system
        )
        return self._zero_without_gait(
            self._vmap_over_batch_axes(compute_least_takeoff_acceleration)(
                self.parameters, self.collocation_state
            )
        )

    @property
    def slope_response(self) -> SlopeResponse:
        """Return the linear response of the step to the slopes of its two lines.

        Its measures are `slope_response.COLLOCATION_RESPONSE_MEASURES`.
        """
        if self.period_n > 1:
            raise ValueError(
                f"the cycle has {self.period_n} steps, but a gait sensitivity norm is defined here "
                "for gaits that repeat after one: give a cycle of period_n = 1."
            )
        compute_response = functools.partial(compute_collocation_slope_response, self.system)
        return self._vmap_over_batch_axes(compute_response)(self.parameters, self.collocation_state)

    def gait_sensitivity(self, name: str) -> Array:
        """Return the gait sensitivity norm of a measure, in the measure's unit per rad of slope.

        See `gait_sensitivity`.
        """
        response_index = COLLOCATION_RESPONSE_MEASURES.index(name)

        def compute_norm(response: SlopeResponse) -> Array:
            return compute_sensitivity_norms(response.select_measures([response_index])).norms[0]

        return self._zero_without_gait(
            self._vmap_over_batch_axes(compute_norm)(self.slope_response)
        )

    @property
    def force_peaks(self) -> dict[str, Array]:
        """Return the `measures.FORCE_PEAK_MEASURES` by name, each the largest over the steps.

        The measures have first derivatives, which are zero for numbers of peaks.
        """
        compute_peaks = functools.partial(compute_force_peaks, self.system)
        solution = self.collocation_state.solution
        force_peaks = self._vmap_over_batch_axes(compute_peaks)(self.parameters, solution)
        return {
            name: self._zero_without_gait(peak_value) for name, peak_value in force_peaks.items()
        }

    def measures(self, names: Iterable[str]) -> dict[str, Array]:
        names = tuple(names)
        force_peaks = {} if FORCE_PEAK_MEASURES.keys().isdisjoint(names) else self.force_peaks
        return {
            name: force_peaks[name] if name in force_peaks else self.measure(name) for name in names
        }

    @property
    def margins(self) -> Margins:
        """Return the margins over the first step, computed by one event-driven step."""

        def compute_step_margins(parameters: Array, section_state: Array) -> Margins:
            wheel = make_wheel_from_parameters(parameters, self.system.n_legs)
            return step(wheel, section_state, model=self.model).margins

        return self._vmap_over_batch_axes(compute_step_margins)(self.parameters, self.section_state)

    @property
    def ending(self) -> Any:
        def describe_outcome(outcome_code: int, failed_check: float) -> str:
            sentence = Outcome(int(outcome_code)).meaning
            if outcome_code not in (
                Outcome.EVENT_ORDER_MISMATCH,
                Outcome.BRANCH_ENDS_BEFORE_TARGET,
            ):
                return sentence
            check_index = int(failed_check - 1) % len(ADMISSIBILITY_CHECKS)
            return f"{sentence} Broken: {ADMISSIBILITY_CHECKS[check_index]}."

        return map_text_of_elements(
            describe_outcome, self.outcome, self.collocation_state.failed_check
        )

    def model_summary_rows(self) -> list[LabelAndText]:
        landing_indicators = self.indicators
        indicator_text = (
            f"{format_numbers(landing_indicators.lambda_I4)} N s, "
            f"{format_numbers(landing_indicators.lambda_2)} N"
        )
        return [
            ("durations of DLS, SLS-I, SLS-II", f"{format_numbers(self.durations)} s"),
            (
                "indicators λ_I4, λ2⁺, λ4⁺",
                f"{indicator_text}, {format_numbers(landing_indicators.lambda_4)} N",
            ),
        ]


@functools.partial(jax.jit, static_argnums=0)
def _estimate_found_mesh_error(
    system: CollocationSystem, is_found: Array, solution: CollocationSolution
) -> Array:
    """Return the estimated mesh error of a cycle; 0 if no cycle was found."""
    solution_with_lane = jax.tree.map(lambda x: x[..., None], solution)
    return jnp.where(
        is_found,
        estimate_mesh_error(system.phase_sequence, system.phase_meshes, solution_with_lane)[0],
        0.0,
    )


@functools.partial(jax.jit, static_argnums=0)
def _compute_takeoff_acceleration(
    system: CollocationSystem, parameters: Array, collocation_state: CollocationState
) -> Array:
    """Return the least take-off acceleration over the steps of a cycle, m/s^2."""
    s = make_wheel_from_parameters(parameters, system.n_legs).symbols()
    _, steps = system.evaluate_phase_points(parameters, collocation_state.solution)
    return jnp.min(jnp.stack([compute_takeoff_acceleration(s, sls1) for _, sls1, _ in steps]))


_attach_monodromy_compiled = jax.jit(attach_monodromy_derivatives, static_argnums=0)


def solve_limit_cycle(
    params: WheelParams, system: CollocationSystem, guess: CollocationState | None
) -> LimitCycle:
    """Return the cycle of one wheel by the search, without fallbacks."""
    find_cycle = _solve_limit_cycle if is_inside_jit() else _solve_limit_cycle_compiled
    return find_cycle(params, system, guess)


def _solve_limit_cycle(
    params: WheelParams, system: CollocationSystem, guess: CollocationState | None
) -> LimitCycle:
    """Return the cycle as `solve_limit_cycle` does, without compilation."""
    is_in_domain = params.is_in_domain()
    table_1 = WheelParams(n_legs=system.n_legs)
    safe_params = jax.tree.map(
        lambda given_value, default_value: jnp.where(
            is_in_domain, given_value, default_value.astype(given_value.dtype)
        ),
        params,
        table_1,
    )
    parameters = stack_parameters(safe_params)
    collocation_state, (monodromy_value, residual, n_newton_iterations) = (
        solve_cycle_with_derivatives(system, parameters, guess)
    )
    has_cycle = is_in_domain & (collocation_state.has_cycle > 0.5)
    # Inputs and outputs are masked, so that measures and derivatives are zero without a cycle.
    zero_without_gait = lambda given_value: jnp.where(has_cycle, given_value, 0.0)
    replace_if_missing = lambda given_value, default_value: jnp.where(
        has_cycle, given_value, default_value
    )
    parameters = jax.tree.map(
        replace_if_missing, parameters, stack_parameters(table_1).astype(parameters.dtype)
    )

    symbols = make_wheel_from_parameters(parameters, system.n_legs).symbols()
    period_n = system.period_n
    # The states are theta, its rate and the rate of L1. At touchdown, L1 follows from theta.
    touchdown_states = jnp.concatenate(
        [collocation_state.step_end_states[:, :1], collocation_state.step_end_states[:, 2:]], 1
    )
    # The landing at the start of a step follows the state at the end of the previous step.
    landings = jax.vmap(lambda given_value: transitions.resolve_landing(symbols, *given_value))(
        jnp.roll(touchdown_states, 1, 0)
    )
    fore_force, rear_force = jax.vmap(
        lambda landing: transitions.compute_landing_forces(symbols, landing)
    )(landings)

    def select_step_values(step_values: Array) -> Array:
        return zero_without_gait(step_values[0] if period_n == 1 else step_values)

    durations = collocation_state.solution.durations
    outcome_code = jnp.where(
        collocation_state.failed_check > 0.0, Outcome.EVENT_ORDER_MISMATCH, Outcome.NO_CYCLE_FOUND
    )
    outcome_code = jnp.where(
        collocation_state.failed_check == MESH_CHECK_CODE, Outcome.MESH_TOO_COARSE, outcome_code
    )
    outcome_code = jnp.where(
        collocation_state.failed_check > MESH_CHECK_CODE,
        Outcome.BRANCH_ENDS_BEFORE_TARGET,
        outcome_code,
    )
    outcome_code = jnp.where(has_cycle, Outcome.STEPPED, outcome_code)
    return LimitCycle(
        section_state=zero_without_gait(touchdown_states[-1]),
        post_impact=zero_without_gait(collocation_state.solution.section_state),
        durations=select_step_values(durations),
        step_length=select_step_values(landings.foot_distance),
        indicators=DoubleSupportIndicators(
            lambda_I4=select_step_values(landings.rear_impulse.normal),
            lambda_2=select_step_values(fore_force.normal),
            lambda_4=select_step_values(rear_force.normal),
        ),
        outcome=jnp.where(is_in_domain, outcome_code, Outcome.BAD_INPUT).astype(jnp.int32),
        residual=jnp.where(jnp.isfinite(residual), residual, 1.0),
        n_newton_iterations=n_newton_iterations,
        parameters=parameters,
        collocation_state=collocation_state,
        monodromy_value=zero_without_gait(monodromy_value),
        system=system,
    )


_solve_limit_cycle_compiled = eqx.filter_jit(_solve_limit_cycle)


class WalkSamples(NamedTuple):
    """Event-driven walk, sampled in time as a start on any mesh."""

    post_impact: Float[Array, "2"]  # (theta, dtheta) after the first landing
    landing_distances: Float[Array, " n"]  # distances between the feet at each landing, m
    phase_durations: Float[Array, "n 3"]
    sample_states: Float[Array, "n 3 n_samples 6"]  # theta, L1, L2 and their rates in each phase


@eqx.filter_jit
def sample_walk(
    model: ViscoelasticWheel,
    params: WheelParams,
    section_state: SectionState,
    n_steps: int,
    n_samples: int = 1025,
) -> WalkSamples:
    """Return `n_steps` event-driven steps from a section state, sampled in time.

    - `n_samples`: number of points of each phase. The value is chosen because too few points miss
      the fast start of a step without double support, and Newton's method fails (33 at c = 221).
    """
    step_options, wheel_symbols = StepOptions(), params.symbols()
    landing = transitions.resolve_landing(wheel_symbols, *section_state)
    post_impact_state = jnp.stack([landing.theta_after, landing.motion_after.dtheta])

    def sample_next_step(section_state: Array, _: None) -> tuple[Array, tuple]:
        trajectory = model.sample_step(params, section_state, step_options, n_samples)
        step_samples = (
            transitions.resolve_landing(wheel_symbols, *section_state).foot_distance,
            trajectory.durations,
            trajectory.state,
        )
        return trajectory.section_state, step_samples

    _, step_samples = lax.scan(sample_next_step, section_state, None, length=n_steps)
    return WalkSamples(post_impact_state, *step_samples)


@eqx.filter_jit
def guess_from_walk(
    system: CollocationSystem, params: WheelParams, walk_samples: WalkSamples
) -> CollocationState:
    """Return the unknowns of a cycle from a walk of `period_n` steps."""
    sample_accelerations = functools.partial(_sample_node_accelerations, system, params.symbols())
    is_phase_active = (walk_samples.phase_durations > 0.0).astype(
        walk_samples.phase_durations.dtype
    )
    phase_accelerations = jax.vmap(sample_accelerations)(
        walk_samples.landing_distances, walk_samples.sample_states
    )
    solution = CollocationSolution(
        walk_samples.post_impact, walk_samples.phase_durations, phase_accelerations
    )
    search_flags = init_search_flags(system, walk_samples.post_impact)
    return lax.stop_gradient(CollocationState(solution, is_phase_active, *search_flags))


@functools.partial(jax.jit, static_argnums=(0, 1))
def transfer_solution_to_mesh(
    source_system: CollocationSystem,
    target_system: CollocationSystem,
    solution: CollocationSolution,
) -> CollocationSolution:
    """Return a solution transferred to another mesh.

    The accelerations in each mesh interval are a polynomial of time.
    """
    accelerations = []
    for source_mesh, target_mesh, phase_accelerations in zip(
        source_system.phase_meshes, target_system.phase_meshes, solution.accelerations, strict=True
    ):
        transfer_matrix = jnp.asarray(
            mesh_transfer_matrix(source_mesh, target_mesh), solution.section_state.dtype
        )
        n_steps, _, _, n_coordinates = phase_accelerations.shape
        target_accelerations = jnp.einsum(
            "ij,njd->nid", transfer_matrix, phase_accelerations.reshape(n_steps, -1, n_coordinates)
        )
        accelerations.append(
            target_accelerations.reshape(
                n_steps, target_mesh.n_intervals, N_GAUSS_NODES, n_coordinates
            )
        )
    return CollocationSolution(solution.section_state, solution.durations, tuple(accelerations))


def _sample_node_accelerations(
    system: CollocationSystem,
    s: Symbols,
    foot_distance: Scalar,
    sample_states: Float[Array, "3 n_samples 6"],
) -> tuple[Array, ...]:
    """Return accelerations at the nodes of each phase of a sampled step.

    Their axes are (interval, node, coordinate).
    """
    accelerations, phases = [], make_phases(s, foot_distance, stop_at_lift_off=False)
    sample_times = jnp.linspace(0.0, 1.0, sample_states.shape[1])
    for phase, mesh, phase_samples in zip(phases, system.phase_meshes, sample_states, strict=True):
        node_states = [
            jnp.interp(jnp.asarray(mesh.node_fractions), sample_times, coordinate_samples)
            for coordinate_samples in phase_samples.T
        ]
        node_accelerations = jnp.stack(
            phase.solve_acceleration(Motion.from_angle(*node_states))[: phase.n_dof], axis=-1
        )
        accelerations.append(
            node_accelerations.reshape(mesh.n_intervals, N_GAUSS_NODES, phase.n_dof)
        )
    return tuple(accelerations)

"""Represent limit cycles of the paper's model as differentiable functions of its parameters.

The search (see `collocation_search`) has no derivatives. The derivatives are the tangents of the
linearization at the cycle, by the implicit function theorem. They are also valid for unstable
cycles, in forward and reverse mode, and to any order.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from vrw_jax.base import small_matrices
from vrw_jax.base.checks import require_known_name
from vrw_jax.base.elementwise import Scalar
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import LabelAndText, Measure, Outcome, format_numbers
from vrw_jax.gaits.collocation_search import FAILED_MESH_CHECK_CODE
from vrw_jax.gaits.cycle import AbstractCycle
from vrw_jax.gaits.derivatives import (
    COLLOCATION_RESPONSE_MEASURES,
    SearchMissingCycles,
    SlopeResponse,
    attach_monodromy_derivatives,
    compute_sensitivity_norms,
    make_slope_response_function,
    solve_cycle_with_derivatives,
)
from vrw_jax.gaits.force_peaks import measure_extremum, measure_force_peaks
from vrw_jax.gaits.gauss import (
    END_WEIGHTS,
    N_GAUSS_NODES,
    CollocationSolution,
    transfer_accelerations,
)
from vrw_jax.gaits.phase_sequence import ADMISSIBILITY_CHECKS, CollocationState, CollocationSystem
from vrw_jax.lanes.batching import is_inside_jit
from vrw_jax.models.step_results import DoubleSupportIndicators, Margins, SectionState
from vrw_jax.models.stepping import step
from vrw_jax.models.viscoelastic import ViscoelasticWheel
from vrw_jax.wheel import transitions
from vrw_jax.wheel.dynamics import Motion
from vrw_jax.wheel.params import WheelParams, stack_parameters
from vrw_jax.wheel.phases import PAPER_PHASES, PhaseInstant, make_paper_phases


class LimitCycle(AbstractCycle):
    """Gait of the paper's model, found by collocation.

    See `AbstractCycle`. The cycle is differentiable with respect to the parameters, in every mode
    and to any order. Under `jax.vmap`, the batch axis of every field comes first.

    - `section_state`: (theta-, dtheta-, dL1-) before touchdown, a fixed point of the return map;
    - `post_impact`: (theta, dtheta) after the first landing, rad, rad/s;
    - `durations`: durations of DLS, SLS-I and SLS-II, s; (n, 3) for period_n = n > 1;
    - `step_length`: distance between the feet at the landing, m; (n,) for n > 1;
    - `indicators`: indicators of double support at the landing, each (n,) for n > 1;
    - `outcome`: Outcome.STEPPED, or the reason of the failure;
    - `residual`: norm of Newton's last correction, in units of the wheel;
    - `n_newton_iterations`: number of linearizations in the search;
    - `parameters`: parameters as floats, in the order of the model's `parameter_names`;
    - `collocation_state`: solution and its active phases, a start of the search for similar wheels;
    - `monodromy_value`: monodromy matrix, without derivatives;
    - `searched_parameters`: parameters of the wheel, also if it has no gait, without derivatives;
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
    searched_parameters: Float[Array, " n_parameters"]
    system: CollocationSystem = eqx.field(static=True)
    model: ViscoelasticWheel = eqx.field(
        default_factory=ViscoelasticWheel
    )  # `margins` uses its ground.

    @property
    def step_ends(self) -> Array:
        return jnp.asarray(self.collocation_state.gait_step_end_states)

    @property
    def warm_start(self) -> CollocationState:
        return self.collocation_state

    @property
    def monodromy(self) -> Float[Array, "... 2 2"]:
        """Return the Jacobian of the return map after the impact, in the coordinates (theta+,
        dtheta+).

        The return map before the impact has one additional multiplier, which is zero.
        """
        attach_derivatives = (
            attach_monodromy_derivatives if is_inside_jit() else _attach_monodromy_compiled
        )
        attach_derivatives_to_batch = self.map_over_batch_axes(
            functools.partial(attach_derivatives, self.system)
        )
        return attach_derivatives_to_batch(
            self.monodromy_value, self.parameters, self.collocation_state
        )

    def _evaluate_on_mesh(self, make_function: Callable, *arguments: Any) -> Any:
        """Return the value of a function of a gait, see `CollocationSystem.on_each_mesh`."""
        evaluate = self.map_over_batch_axes(self.system.on_each_mesh(make_function))
        return evaluate(self.parameters, self.collocation_state, *arguments)

    @property
    def jury_margins(self) -> Array:
        """Return the margins to a fold, a period doubling and a Neimark-Sacker bifurcation.

        See `small_matrices.compute_jury_margins`.
        """
        return small_matrices.compute_jury_margins(self.monodromy)

    @property
    def has_double_multiplier(self) -> Bool[Array, "..."]:
        """Return whether two equal multipliers cause a kink of the spectral radius."""
        return small_matrices.has_double_multiplier(self.monodromy_value) & self.found

    @property
    def mesh_error(self) -> Array:
        """Return an estimate of the discretization error, which in most cases exceeds the actual
        error.

        See `gauss.estimate_mesh_error`. A gait whose estimate is above 1e-5 is rejected. More
        mesh intervals in `CycleOptions` reduce the error.
        """
        mesh_error = self._evaluate_on_mesh(
            lambda system: lambda _, state: system.estimate_mesh_error(state.solution)
        )
        return jnp.where(self.found, mesh_error, 0.0)

    @property
    def takeoff_acceleration(self) -> Array:
        """Return the lowest acceleration of the rear foot at take-off over the gait steps, m/s^2.

        See `dynamics.compute_takeoff_acceleration`.
        """
        return self._zero_without_gait(
            self._evaluate_on_mesh(
                lambda system: (
                    lambda parameters, state: system.measure_takeoff_acceleration(
                        parameters, state.solution
                    )
                )
            )
        )

    @property
    def slope_response(self) -> SlopeResponse:
        """Return the linear response of the gait step to the slopes of uneven ground.

        The gait step depends on the slopes of two successive lines of the ground. The measures are
        `derivatives.COLLOCATION_RESPONSE_MEASURES`.
        """
        if self.period_n > 1:
            raise ValueError(
                f"the cycle has {self.period_n} steps, but a gait sensitivity norm is defined here "
                "for gaits that repeat after one: give a cycle of period_n = 1."
            )
        return self._evaluate_on_mesh(make_slope_response_function)

    def gait_sensitivity(self, measure_name: str) -> Array:
        """Return the gait sensitivity norm of a measure, in the measure's unit per rad of slope.

        See `derivatives.compute_sensitivity_norms`.
        """
        response_index = COLLOCATION_RESPONSE_MEASURES.index(measure_name)

        def compute_sensitivity_norm(slope_response: SlopeResponse) -> Array:
            return compute_sensitivity_norms(
                slope_response.select_measures([response_index])
            ).sensitivity_norms[0]

        return self._zero_without_gait(
            self.map_over_batch_axes(compute_sensitivity_norm)(self.slope_response)
        )

    def _evaluate_own_measure(self, measure: Measure) -> Array:
        def make_evaluate(system: CollocationSystem) -> Callable:
            return lambda parameters, state, section_state: evaluate_own_measure(
                measure, system, self.model, parameters, state.solution, section_state
            )

        return self._evaluate_on_mesh(make_evaluate, self.section_state)

    def _locate_force_peaks(self) -> dict[str, Array]:
        return self._evaluate_on_mesh(lambda system: functools.partial(measure_force_peaks, system))

    @property
    def margins(self) -> Margins:
        """Return the margins of the first gait step, computed by an event-driven step."""

        def compute_step_margins(parameters: Array, section_state: Array) -> Margins:
            wheel_params = self.system.make_wheel(parameters)
            return step(wheel_params, section_state, model=self.model).margins

        return self.map_over_batch_axes(compute_step_margins)(self.parameters, self.section_state)

    @property
    def searched_wheel(self) -> tuple[ViscoelasticWheel, WheelParams]:
        # A single wheel outside its domain would raise an error, and a batch of one does not.
        parameters = jnp.moveaxis(self.searched_parameters, -1, 0)[..., None]
        wheels = self.system.make_wheel(parameters)
        return self.model, jax.tree.map(lambda x: x[..., 0], wheels)

    @property
    def ending(self) -> Any:
        def describe_outcome(outcome_code: int, failed_check: float) -> str:
            outcome_sentence = Outcome(outcome_code).meaning
            if outcome_code not in (
                Outcome.EVENT_ORDER_MISMATCH,
                Outcome.BRANCH_ENDS_BEFORE_TARGET,
            ):
                return outcome_sentence
            check_index = int(failed_check - 1) % len(ADMISSIBILITY_CHECKS)
            return f"{outcome_sentence[:-1]}: {ADMISSIBILITY_CHECKS[check_index].failure}."

        return self._describe_each_outcome(describe_outcome, self.collocation_state.failed_check)

    def model_summary_rows(self) -> list[LabelAndText]:
        indicator_text = (
            f"{format_numbers(self.indicators.lambda_I4)} N s, "
            f"{format_numbers(self.indicators.lambda_2)} N, "
            f"{format_numbers(self.indicators.lambda_4)} N"
        )
        return [
            ("durations of DLS, SLS-I, SLS-II", f"{format_numbers(self.durations)} s"),
            ("indicators λ_I4, λ2⁺, λ4⁺", indicator_text),
        ]


@eqx.filter_jit
def evaluate_own_measure(
    measure: Measure,
    system: CollocationSystem,
    model: ViscoelasticWheel,
    parameters: Array,
    solution: CollocationSolution,
    section_state: Array,
) -> Array:
    """Return a measure of the user, as the mean over the gait steps.

    The Gauss nodes of a phase integrate a function of its motion as accurately as the collocation
    integrates the motion: both have order 8.
    """
    params = system.make_wheel(parameters)
    if not measure.phases:
        if system.period_n > 1:
            raise ValueError(
                f"{measure.name} is a function of a step, but the cycle has {system.period_n}: "
                "give it a phase, or compute the steps by vrw.walk."
            )
        return jnp.asarray(measure(step(params, section_state, model=model), params))
    phase_names = [phase.phase_name for phase in PAPER_PHASES]
    for name in measure.phases:
        require_known_name(name, phase_names, "phase")
    if measure.reduction in ("min", "max"):
        return measure_extremum(system, parameters, solution, measure)
    indices, values = [phase_names.index(name) for name in measure.phases], []
    for k, points in enumerate(system.evaluate_phase_points(parameters, solution)):
        params = system.make_wheel(parameters, k)
        phases = make_paper_phases(
            params.symbols(), points[0].phase_start_point.held_constants[0], stop_at_lift_off=False
        )
        integral = jnp.zeros((), parameters.dtype)
        for index in indices:
            mesh, nodes = system.phase_meshes[index], points[index].node_points
            weights = jnp.ravel(mesh.interval_length_fractions[:, None] * END_WEIGHTS)
            evaluate = lambda q, v, phase=phases[index], params=params: jnp.asarray(
                measure(PhaseInstant(phase, phase.compute_motion(q, v)), params)
            )
            mean = weights @ jax.vmap(evaluate)(nodes.q, nodes.v)
            integral = integral + solution.durations[k, index] * mean
        duration = sum(solution.durations[k, index] for index in indices)
        is_mean = measure.reduction == "mean"
        values.append(integral / jnp.where(duration > 0.0, duration, 1.0) if is_mean else integral)
    return sum(values[1:], start=values[0]) / len(values)


_attach_monodromy_compiled = jax.jit(attach_monodromy_derivatives, static_argnums=0)


def solve_limit_cycle(*arguments: Any) -> LimitCycle:
    """Return the result of `_solve_limit_cycle`, which is compiled if no `jit` traces the call."""
    return (_solve_limit_cycle if is_inside_jit() else _solve_limit_cycle_compiled)(*arguments)


def _solve_limit_cycle(
    params: WheelParams,
    collocation_system: CollocationSystem,
    cycle_guess: CollocationState | None,
    starts_only_from_guess: bool = False,
    search_missing_cycles: SearchMissingCycles | None = None,
) -> LimitCycle:
    """Find the cycle of one wheel on the mesh of the collocation system."""
    is_in_domain = params.is_in_domain()
    parameters = stack_parameters(params)
    table_1_parameters = stack_parameters(params.make_table_1_wheel()).astype(parameters.dtype)
    is_finite = jnp.isfinite(parameters)
    searched_parameters = lax.stop_gradient(jnp.where(is_finite, parameters, table_1_parameters))
    parameters = jnp.where(is_in_domain, parameters, table_1_parameters)
    collocation_state, (monodromy_value, newton_residual, n_newton_iterations) = (
        solve_cycle_with_derivatives(
            collocation_system,
            parameters,
            cycle_guess,
            starts_only_from_guess,
            search_missing_cycles,
        )
    )
    has_cycle = is_in_domain & (collocation_state.has_cycle > 0.5)
    # Inputs and outputs are masked, so that measures and derivatives are zero if there is no cycle.
    zero_without_gait = lambda value_of_gait: jnp.where(has_cycle, value_of_gait, 0.0)
    parameters = jnp.where(has_cycle, parameters, table_1_parameters)

    period_n = collocation_system.period_n
    get_symbols = lambda k: collocation_system.make_wheel(parameters, k).symbols()
    # The states are theta, its rate and the rate of L1. At touchdown, L1 follows from theta.
    step_end_states = collocation_state.gait_step_end_states
    touchdown_states = jnp.concatenate([step_end_states[:, :1], step_end_states[:, 2:]], 1)
    # The landing at the start of a step follows the state at the end of the previous step.
    landing_results = jax.vmap(
        lambda touchdown_state: transitions.resolve_landing(get_symbols(0), *touchdown_state)
    )(jnp.roll(touchdown_states, 1, 0))
    fore_force, rear_force = jax.vmap(
        lambda k, landing: transitions.compute_landing_forces(get_symbols(k), landing)
    )(jnp.arange(period_n), landing_results)

    select_step_values = lambda values_by_step: zero_without_gait(
        values_by_step[0] if period_n == 1 else values_by_step
    )
    failed_check = collocation_state.failed_check
    outcome_code = jnp.select(
        [
            ~is_in_domain,
            has_cycle,
            failed_check > FAILED_MESH_CHECK_CODE,
            failed_check == FAILED_MESH_CHECK_CODE,
            failed_check > 0.0,
        ],
        [
            Outcome.BAD_INPUT,
            Outcome.STEPPED,
            Outcome.BRANCH_ENDS_BEFORE_TARGET,
            Outcome.MESH_TOO_COARSE,
            Outcome.EVENT_ORDER_MISMATCH,
        ],
        Outcome.NO_CYCLE_FOUND,
    )
    return LimitCycle(
        section_state=zero_without_gait(touchdown_states[-1]),
        post_impact=zero_without_gait(collocation_state.solution.section_state),
        durations=select_step_values(collocation_state.solution.durations),
        step_length=select_step_values(landing_results.foot_distance),
        indicators=DoubleSupportIndicators(
            lambda_I4=select_step_values(landing_results.rear_impulse.normal),
            lambda_2=select_step_values(fore_force.normal),
            lambda_4=select_step_values(rear_force.normal),
        ),
        outcome=outcome_code.astype(jnp.int32),
        residual=jnp.where(jnp.isfinite(newton_residual), newton_residual, 1.0),
        n_newton_iterations=n_newton_iterations,
        parameters=parameters,
        collocation_state=collocation_state,
        monodromy_value=zero_without_gait(monodromy_value),
        searched_parameters=searched_parameters,
        system=collocation_system,
    )


_solve_limit_cycle_compiled = eqx.filter_jit(_solve_limit_cycle)


def land_foot(wheel_symbols: Any, section_state: SectionState) -> Array:
    """Return (theta, dtheta) after the landing that follows a section state."""
    landing_result = transitions.resolve_landing(wheel_symbols, *section_state)
    return jnp.stack([landing_result.theta_after_landing, landing_result.motion_after.dtheta])


@eqx.filter_jit
def sample_walk_in_time(
    model: ViscoelasticWheel,
    params: WheelParams,
    section_state: SectionState,
    n_steps: int,
    n_samples: int = 1025,
) -> tuple[Array, Array, Array, Array]:
    """Sample `n_steps` event-driven gait steps in time, starting from a section state.

    Return (theta, dtheta) after the first landing, the distance between the feet at each landing,
    the durations of phases (n, 3), and theta, L1, L2 and their rates in each phase, shape
    (n, 3, n_samples, 6). A guess of a cycle on any mesh follows from them.

    - `n_samples`: number of samples per phase. The value is chosen because few samples miss the
      fast start of a gait step without double support. Newton's method then fails, for example with
      33 samples at c = 221 N s/m.
    """
    step_options = StepOptions()
    wheel_symbols = params.symbols()
    post_impact_state = land_foot(wheel_symbols, section_state)

    def sample_next_step(section_state: Array, k: Array) -> tuple[Array, tuple]:
        step_params = model.select_params(params, k)
        step_trajectory = model.sample_step(step_params, section_state, step_options, n_samples)
        step_samples = (
            transitions.resolve_landing(wheel_symbols, *section_state).foot_distance,
            step_trajectory.durations,
            step_trajectory.state,
        )
        return step_trajectory.section_state, step_samples

    _, step_samples = lax.scan(sample_next_step, section_state, jnp.arange(n_steps))
    return post_impact_state, *step_samples


@eqx.filter_jit
def guess_cycle_from_walk(
    collocation_system: CollocationSystem, params: WheelParams, walk_samples: tuple[Array, ...]
) -> CollocationState:
    """Compute the guess of a cycle from the samples of a walk with `period_n` gait steps."""

    def sample_node_accelerations(
        foot_distance: Scalar, sampled_states: Array, step_index: Array
    ) -> tuple[Array, ...]:
        wheel_symbols = collocation_system.make_wheel(
            stack_parameters(params), step_index
        ).symbols()
        wheel_phases = make_paper_phases(wheel_symbols, foot_distance, stop_at_lift_off=False)
        accelerations_by_phase = []
        sample_times = jnp.linspace(0.0, 1.0, sampled_states.shape[1])
        for wheel_phase, phase_mesh, phase_samples in zip(
            wheel_phases, collocation_system.phase_meshes, sampled_states, strict=True
        ):
            node_states = [
                jnp.interp(
                    jnp.asarray(phase_mesh.node_time_fractions), sample_times, coordinate_samples
                )
                for coordinate_samples in phase_samples.T
            ]
            node_motion = Motion.from_angle(*node_states)
            node_accelerations = jnp.stack(
                wheel_phase.solve_acceleration(node_motion)[: wheel_phase.n_dof], axis=-1
            )
            accelerations_by_phase.append(
                node_accelerations.reshape(phase_mesh.n_intervals, N_GAUSS_NODES, wheel_phase.n_dof)
            )
        return tuple(accelerations_by_phase)

    post_impact, landing_distances, durations, sampled_states = walk_samples
    is_phase_active = (durations > 0.0).astype(durations.dtype)
    phase_accelerations = jax.vmap(sample_node_accelerations)(
        landing_distances, sampled_states, jnp.arange(collocation_system.period_n)
    )
    guessed_solution = CollocationSolution(post_impact, durations, phase_accelerations)
    return lax.stop_gradient(CollocationState.make_start(guessed_solution, is_phase_active))


@functools.partial(jax.jit, static_argnums=(0, 1))
def transfer_solution_to_mesh(
    source_system: CollocationSystem,
    target_system: CollocationSystem,
    source_solution: CollocationSolution,
) -> CollocationSolution:
    """Transfer a collocation solution from the mesh of one system to the mesh of another system.

    The accelerations in each mesh interval are a polynomial of time.
    """
    accelerations_by_phase = [
        jax.vmap(functools.partial(transfer_accelerations, source_mesh, target_mesh))(accelerations)
        for source_mesh, target_mesh, accelerations in zip(
            source_system.phase_meshes,
            target_system.phase_meshes,
            source_solution.accelerations,
            strict=True,
        )
    ]
    return source_solution._replace(accelerations=tuple(accelerations_by_phase))

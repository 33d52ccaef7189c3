"""The paper's viscoelastic model.

Its step consists of a landing, double support, single support I, a stopper collision and single
support II.
"""

import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vrw_jax.base.checks import check_bool
from vrw_jax.base.options import StepOptions
from vrw_jax.base.types import Elementwise, Vector
from vrw_jax.flow.diffrax_minima import GuardsAndMargins, StateArray
from vrw_jax.flow.scaled_integration import (
    integrate_phase_in_scaled_units,
    sample_phase_in_scaled_units,
)
from vrw_jax.flow.solver_steps import VectorField
from vrw_jax.lanes.autodiff import ForwardFunction, enable_all_ad_modes
from vrw_jax.models.batch_step import (
    build_step_finisher,
    build_step_function,
    build_step_jacobian,
    build_step_sampler,
    can_use_batch_kernel,
)
from vrw_jax.models.capabilities import GaitMethod, ModelCapabilities
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.phase_sequence import (
    PhaseResult,
    PhaseRunner,
    PhaseSequenceResult,
    finish_gait_step,
    make_advance_result,
    make_step_result,
    make_trajectory,
    run_step_phases,
)
from vrw_jax.models.step_results import (
    PAPER_START_STATE,
    AdvanceResult,
    SectionState,
    StepResult,
    Trajectory,
)
from vrw_jax.wheel.geometry import Motion
from vrw_jax.wheel.params import (
    PARAMETER_NAMES,
    WheelParams,
    compute_wheel_units,
    require_known_friction,
)
from vrw_jax.wheel.phases import AbstractPhase, PhaseInstant


class DiffraxPhaseFunctions(NamedTuple):
    """Functions that the diffrax integrator calls for a phase. The state y = (q, v) is one
    vector.
    """

    motion_unpacker: Callable[[StateArray], Motion]
    vector_field: VectorField
    guards: GuardsAndMargins


def make_diffrax_phase(phase: AbstractPhase, records_margins: bool) -> DiffraxPhaseFunctions:
    """Return the functions of a phase that the diffrax integrator calls.

    - `records_margins`: whether the integrator also evaluates margins.
    """

    def evaluate_vector_field(y: StateArray) -> StateArray:
        accelerations = phase.solve_acceleration(phase.unpack_motion(y))
        return jnp.stack([*y[phase.n_dof :], *accelerations[: phase.n_dof]])

    def evaluate_guards_and_margins(y: StateArray) -> Array:
        phase_instant = PhaseInstant(phase, phase.unpack_motion(y), None)
        margins = phase.compute_margins(phase_instant) if records_margins else ()
        return jnp.stack([*phase.compute_guards(phase_instant), *margins])

    guards_and_margins = GuardsAndMargins(
        evaluate_guards_and_margins,
        len(phase.all_guard_outcomes),
        phase.are_margins_counted_at_start if records_margins else (),
    )
    return DiffraxPhaseFunctions(phase.unpack_motion, evaluate_vector_field, guards_and_margins)


class ViscoelasticWheel(AbstractWheel):
    """The paper's model: legs have fixed roles, and feet neither slip nor scuff. Margins are
    computed, not enforced.

    - `friction`: friction coefficient of the ground. It affects the friction margins, but not the
      motion;
    - `stop_at_lift_off`: whether a step fails if the ground would have to pull on Leg 1, because
      the model does not describe bouncing. If False, the step continues formally, as the paper's
      steps do after scuffing, and the margins report the violation.

    Examples:
        >>> wheel = vrw.ViscoelasticWheel(friction=20.0)
        >>> step = vrw.step(vrw.WheelParams(), vrw.paper_start(), model=wheel)
        >>> print(f"{step.margins.friction_fore:.1f}")
        19.4
    """

    model_name: ClassVar[str] = "viscoelastic"
    capabilities: ClassVar[ModelCapabilities] = ModelCapabilities(
        config_name="viscoelastic",
        gait_method=GaitMethod.COLLOCATION,
        accepted_cli_commands=frozenset({"scan", "map", "tune", "branch", "explore"}),
        can_start_within_gait_step=True,
    )
    parameter_names: ClassVar[tuple[str, ...]] = PARAMETER_NAMES
    reports_contacts: ClassVar[bool] = False
    batch_kernel: ClassVar[str] = "phases"

    friction: float = eqx.field(static=True, converter=require_known_friction, default=1.0)
    stop_at_lift_off: bool = eqx.field(
        static=True, converter=functools.partial(check_bool, "stop_at_lift_off"), default=True
    )

    def compute_default_start(self, params: WheelParams) -> SectionState:
        """Return a section state near the gait of Table 1 of the paper, inside its basin of
        attraction.
        """
        return jnp.asarray(PAPER_START_STATE, params.damping.dtype)

    def advance(self, params: WheelParams, x: SectionState, options: StepOptions) -> AdvanceResult:
        return self._compute_step(params, x, options, records_margins=False)

    def take_step(self, params: WheelParams, x: SectionState, options: StepOptions) -> StepResult:
        return self._compute_step(params, x, options, records_margins=True)

    def _compute_step(
        self, params: WheelParams, x: SectionState, options: StepOptions, records_margins: bool
    ) -> Any:
        """Return the results of a step, computed with the compiled function.

        - `records_margins`: whether the results include indicators, margins and energies.
        """
        argument_leaves, argument_structure = jax.tree.flatten((params, x, options))
        return eqx.combine(
            *_compile_step_function(self, argument_structure, records_margins)(*argument_leaves)
        )

    def sample_step(
        self, params: WheelParams, x: SectionState, options: StepOptions, n_samples: int
    ) -> Trajectory:
        if can_use_batch_kernel(options):
            argument_leaves, argument_structure = jax.tree.flatten((params, x, options))
            sample_step = build_step_sampler(argument_structure, self.stop_at_lift_off, n_samples)
            return sample_step(*argument_leaves)
        phase_sequence = self._run_phases(params, x, options, records_margins=False)
        phase_samples = []
        for phase, phase_start, phase_end in zip(
            phase_sequence.phases,
            phase_sequence.phase_start_states,
            phase_sequence.phase_end_results,
            strict=True,
        ):
            phase_samples.append(
                sample_phase_in_scaled_units(
                    make_diffrax_phase(phase, records_margins=False).vector_field,
                    jnp.stack([*phase_start[0], *phase_start[1]]),
                    phase_end.duration,
                    n_samples,
                    options,
                    jnp.stack(phase.coordinate_units),
                    compute_wheel_units(phase.s).time_unit,
                )
            )
        return make_trajectory(phase_sequence, phase_samples)

    def _run_phases(
        self, params: WheelParams, x: SectionState, options: StepOptions, records_margins: bool
    ) -> PhaseSequenceResult:
        """Integrate all phases of a step with diffrax and return their starts and ends."""
        phase_runner = _make_diffrax_phase_runner(options, records_margins)
        return run_step_phases(phase_runner, params, tuple(x), options, self.stop_at_lift_off)

    def finish_step(
        self,
        params: WheelParams,
        phase_index: int,
        foot_distance: Elementwise,
        phase_state: Float[Array, " 6"],
        options: StepOptions,
    ) -> AdvanceResult:
        if can_use_batch_kernel(options):
            argument_leaves, argument_structure = jax.tree.flatten(
                (params, jnp.asarray(foot_distance), phase_state, options)
            )
            step_finisher = build_step_finisher(
                argument_structure, self.stop_at_lift_off, phase_index
            )
            return eqx.combine(*step_finisher(*argument_leaves))
        return finish_gait_step(
            _make_diffrax_phase_runner(options, records_margins=False),
            params,
            phase_index,
            foot_distance,
            tuple(phase_state),
            options,
            self.stop_at_lift_off,
            "diffrax",
        )


def _make_diffrax_phase_runner(options: StepOptions, records_margins: bool) -> PhaseRunner:
    """Return a function that integrates one phase to its end with diffrax."""

    def run_phase(
        phase: AbstractPhase, q: Vector, v: Vector, is_phase_active: Array, _: PhaseResult | None
    ) -> PhaseResult:
        diffrax_phase = make_diffrax_phase(phase, records_margins)
        phase_end = integrate_phase_in_scaled_units(
            diffrax_phase.vector_field,
            diffrax_phase.guards,
            jnp.stack([*q, *v]),
            is_phase_active,
            options,
            jnp.stack(phase.coordinate_units),
            compute_wheel_units(phase.s).time_unit,
        )
        end_state = tuple(phase_end.state)
        return PhaseResult(
            end_state[: phase.n_dof],
            end_state[phase.n_dof :],
            phase_end.duration,
            phase_end.end_guard_index,
            phase_end.is_timed_out,
            phase_end.solver_steps,
            phase_end.margin_minima if records_margins else None,
        )

    return run_phase


@functools.cache
def _compile_step_function(
    model: ViscoelasticWheel, argument_structure: Any, records_margins: bool
) -> ForwardFunction:
    """Return a function that computes a step from the leaves of (params, x, options).

    The function is differentiable in any mode. The pytree structure of (params, x, options) is
    `argument_structure`.
    """

    options_without_numbers = jax.tree.unflatten(
        argument_structure, [0.0] * argument_structure.num_leaves
    )[2]
    engine_name = "lanes" if can_use_batch_kernel(options_without_numbers) else "diffrax"

    def compute_step_with_diffrax(has_tight_tolerances: bool, *argument_leaves: Array) -> tuple:
        """Compute a step with diffrax and return its results, split into float arrays and other
        arrays.

        If the batch kernel is the engine, this function is used only for second and higher
        derivatives. The results still report the name of the batch kernel's engine.
        """
        params, x, options = jax.tree.unflatten(argument_structure, argument_leaves)
        options = options.with_derivative_tolerances() if has_tight_tolerances else options
        phase_sequence = model._run_phases(params, x, options, records_margins=records_margins)
        step_result: AdvanceResult | StepResult = (
            make_step_result(phase_sequence, model.friction, engine_name)
            if records_margins
            else make_advance_result(phase_sequence, engine_name)
        )
        return eqx.partition(step_result, eqx.is_inexact_array)

    diffrax_step_function, tight_diffrax_step_function = (
        functools.partial(compute_step_with_diffrax, has_tight_tolerances)
        for has_tight_tolerances in (False, True)
    )
    if engine_name == "diffrax":
        return enable_all_ad_modes(diffrax_step_function, tight_diffrax_step_function)
    settings = (
        argument_structure,
        model.stop_at_lift_off,
        model.friction if records_margins else None,
    )
    return enable_all_ad_modes(
        build_step_function(*settings),
        tight_diffrax_step_function,
        functools.partial(build_step_jacobian, *settings),
    )

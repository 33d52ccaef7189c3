"""Rigid model: all legs are rigid, so a step has a closed form and needs no integration."""

import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.base.checks import check_bool
from vrw_jax.base.elementwise import Elementwise, select_trees_by_condition
from vrw_jax.base.options import StepOptions
from vrw_jax.base.results import Outcome
from vrw_jax.base.walker import AdvanceResult
from vrw_jax.lanes.autodiff import compute_square_root
from vrw_jax.models.interface import AbstractWheel
from vrw_jax.models.phase_sequence import (
    FALLBACK_SINGLE_SUPPORT_STATE,
    is_valid_phase_state,
    replace_invalid_inputs,
    select_stance_line,
)
from vrw_jax.models.step_results import (
    AnySectionState,
    DoubleSupportIndicators,
    EnergyLoss,
    Margins,
    RequiredFriction,
    SectionState,
    SectionStateEntries,
    StepResult,
    Trajectory,
)
from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import Motion, compute_rear_foot_height
from vrw_jax.wheel.params import Symbols, WheelParams, require_known_friction
from vrw_jax.wheel.transitions import compute_foot_distance

# Number of angles that each round of the search for minima of margins samples. The value is chosen
# because forces are smooth over the 45 degrees of a step.
N_ANGLES_PER_ZOOM_ROUND = 33


class RigidWheel(AbstractWheel):
    """Rimless wheel with rigid legs and leg masses; springs, dampers and L* have no effect.

    The section state is (alpha/2, dtheta-, 0). Only dtheta- can vary, and the other entries of a
    start are ignored. The duration of the whole step is reported as that of SLS-II.

    - `friction`: friction coefficient of the ground. It affects the friction margins, but not the
      motion;
    - `stop_at_lift_off`: whether a step fails if the normal force of the ground would become
      negative;
    - `held_landing`: whether the rear foot stays fixed to the ground during the landing impulse.
      False means the classic landing: the rear foot leaves without an impulse, so the landing
      conserves angular momentum about the new foot. True means the stiff limit of the paper's
      landing (A4), which is the limit of `ViscoelasticWheel`; docs/explanation/physics.md derives
      this limit.

    Examples:
        >>> params = vrw.WheelParams(slope=0.15)
        >>> step = vrw.step(params, [np.pi / 8, 1.5, 0.0], model=vrw.RigidWheel())
        >>> print(f"{step.period:.3f} s")
        0.705 s
    """

    model_name: ClassVar[str] = "rigid"
    commands = frozenset({"branch", "explore"})
    can_start_within_gait_step = True
    reports_contacts: ClassVar[bool] = False
    is_compliant: ClassVar[bool] = False

    friction: float = eqx.field(static=True, converter=require_known_friction, default=1.0)
    stop_at_lift_off: bool = eqx.field(
        static=True, converter=functools.partial(check_bool, "stop_at_lift_off"), default=True
    )
    held_landing: bool = eqx.field(
        static=True, converter=functools.partial(check_bool, "held_landing"), default=False
    )

    def explain_impossible_gait(self, params: WheelParams) -> str:
        impossibility_text = super().explain_impossible_gait(params)
        # The default start is the only rolling motion that may repeat.
        outcome = self.take_step(params, self.compute_default_start(params), StepOptions()).outcome
        if impossibility_text or outcome == Outcome.STEPPED:
            return impossibility_text
        if outcome == Outcome.FELL_BACK:
            return (
                "No steady gait can exist: each landing takes more energy than the wheel gains on "
                "this slope, so its leg doesn't pass the vertical."
            )
        return (
            "No steady gait can exist: in the only rolling motion that repeats, the ground would "
            "have to pull on the foot."
        )

    def compute_default_start(self, params: WheelParams) -> SectionState:
        """Return the section state at the rolling fixed point, or a fast start if there is no fixed
        point.
        """
        s = params.symbols()
        landing_rate_ratio = self._compute_landing_rate_ratio(s)
        squared_rate_gain = 4.0 * _compute_gravity_stiffness(s) * jnp.sin(0.5 * s.alpha) * s.sin_phi
        rolling_rate = jnp.sqrt(
            jnp.maximum(squared_rate_gain, 0.1) / (1.0 - landing_rate_ratio * landing_rate_ratio)
        )
        return jnp.stack([0.5 * s.alpha + 0.0 * rolling_rate, rolling_rate, 0.0 * rolling_rate])

    def advance(self, params: WheelParams, x: SectionState, options: StepOptions) -> AdvanceResult:
        step = self.take_step(params, x, options)
        return AdvanceResult(step.section_state, step.durations, step.outcome, step.solver_steps)

    def _compute_landing_rate_ratio(self, s: Symbols) -> Elementwise:
        """Return the angular rate just after a landing divided by that just before it."""
        foot_inertia = _compute_foot_inertia(s)
        if not self.held_landing:
            return (s.Mt * s.L0**2 * s.cos_alpha + _compute_hub_inertia(s)) / foot_inertia
        half_angle = jnp.asarray(0.5 * s.alpha, s.L0.dtype)
        motion_after_landing = transitions.resolve_landing(
            s, half_angle, jnp.ones_like(half_angle), jnp.zeros_like(half_angle)
        ).motion_after
        M = dynamics.compute_mass_matrix(s, motion_after_landing.L1, motion_after_landing.L2)
        rates = motion_after_landing.dtheta, motion_after_landing.dL1, motion_after_landing.dL2
        return M.multiply_vector(rates)[0] / foot_inertia

    def compute_foot_distance(self, params: WheelParams, x: AnySectionState) -> Elementwise:
        half_angle = jnp.full_like(x[0], 0.5 * params.leg_angle)
        return compute_foot_distance(params.symbols(), half_angle)

    def make_vertical_rate_map(self, params: WheelParams) -> "VerticalRateMap":
        """Return the map of the squared angular rate from one vertical passage to the next.

        At a vertical passage, the stance leg is vertical.
        """
        s = params.symbols()
        half_angle, doubled_gravity_stiffness = 0.5 * s.alpha, 2.0 * _compute_gravity_stiffness(s)
        return VerticalRateMap(
            self._compute_landing_rate_ratio(s) ** 2, doubled_gravity_stiffness, half_angle
        )

    @eqx.filter_jit
    def take_step(self, params: WheelParams, x: SectionState, options: StepOptions) -> StepResult:
        return self.compute_step_elementwise(params, tuple(x), jnp.asarray(self.friction, x.dtype))

    def compute_step_elementwise(
        self, params: WheelParams, x: SectionStateEntries, friction: Elementwise
    ) -> StepResult:
        """Return the results of a step, computed elementwise for one wheel or for a batch."""
        half_angle = jnp.asarray(0.5 * params.leg_angle, x[1].dtype)
        x = (half_angle + 0.0 * x[0], x[1], 0.0 * x[2])
        params, is_valid_step, ground_ahead = select_stance_line(params, x)
        end_angle = half_angle
        if ground_ahead is not None:
            foot_distance = compute_foot_distance(params.symbols(), half_angle)
            if ground_ahead.rise is not None:
                is_valid_step = is_valid_step & (jnp.abs(ground_ahead.rise) < foot_distance)
            end_angle = half_angle + ground_ahead.compute_next_line_tilt(foot_distance)
        params, x = replace_invalid_inputs(is_valid_step, params, x, (half_angle, 1.0, 0.0))
        s = params.symbols()
        rate_before, rate_after = x[1], self._compute_landing_rate_ratio(s) * x[1]
        rolling_motion = RollingMotion(s, params.slope, rate_after, -0.5 * s.alpha, end_angle)
        end, margin_minima = self._finish_rolling(rolling_motion, half_angle, is_valid_step)

        zero_like_rate = jnp.zeros_like(rate_before)
        zero_invalid_steps: Any = functools.partial(_zero_unless, is_valid_step)
        zero_unless_stepped: Any = functools.partial(_zero_unless, end.is_complete)
        rear_impulse, impact_friction, stopper_impulse = zero_invalid_steps(
            self._compute_landing_impulses(s, x, rolling_motion)
        )
        margin_minima = zero_unless_stepped(margin_minima)
        friction = zero_invalid_steps(friction + zero_like_rate)
        return StepResult(
            section_state=end.section_state,
            post_impact=zero_invalid_steps(jnp.stack([-half_angle + zero_like_rate, rate_after])),
            durations=end.durations,
            step_length=zero_invalid_steps(2.0 * s.L0 * jnp.sin(half_angle)),
            indicators=DoubleSupportIndicators(
                lambda_I4=rear_impulse.normal,
                lambda_2=zero_invalid_steps(
                    rolling_motion.compute_foot_force_at_angle(-half_angle + zero_like_rate).normal
                ),
                lambda_4=zero_like_rate,
            ),
            margins=Margins(
                fore_foot_force=margin_minima[0],
                takeoff_acceleration=zero_like_rate,
                clearance_sls1=zero_like_rate,
                clearance_sls2=zero_unless_stepped(
                    compute_rear_foot_height(
                        s, rolling_motion.compute_motion_at_angle(end_angle + zero_like_rate)
                    )
                ),
                locked_stopper_force=margin_minima[3:],
                rear_stopper_force=margin_minima[2],
                contraction=zero_like_rate,
                friction_fore=zero_unless_stepped(friction) + margin_minima[1],
                friction_rear=friction,
                landing_stopper_impulse=stopper_impulse,
                hit_stopper_impulse=jnp.zeros_like(stopper_impulse),
                hit_planted_impulse=zero_like_rate,
                landing_friction_fore=friction - impact_friction[0],
                landing_friction_rear=friction - impact_friction[1],
            ),
            required_friction=RequiredFriction.from_parts(
                0.0 - margin_minima[1],
                zero_like_rate,
                impact_friction[0],
                impact_friction[1],
                zero_like_rate,
            ),
            energy=EnergyLoss(
                landing=zero_invalid_steps(
                    0.5
                    * _compute_foot_inertia(s)
                    * (rate_before * rate_before - rate_after * rate_after)
                ),
                stopper=zero_like_rate,
                damping=zero_like_rate,
            ),
            outcome=end.outcome,
            solver_steps=end.solver_steps,
        )

    def finish_step(
        self,
        params: WheelParams,
        phase_index: int,
        foot_distance: Elementwise,
        phase_state: Float[Array, " 6"],
        options: StepOptions,
    ) -> AdvanceResult:
        """Compute the rest of the step from theta and its rate. The other arguments have no
        effect, but must be finite.
        """
        is_valid_state = is_valid_phase_state(params, tuple(phase_state), foot_distance)
        params, (theta, _, _, dtheta, _, _) = replace_invalid_inputs(
            is_valid_state, params, tuple(phase_state), FALLBACK_SINGLE_SUPPORT_STATE
        )
        half_angle = jnp.asarray(0.5 * params.leg_angle, theta.dtype)
        rolling_motion = RollingMotion(params.symbols(), params.slope, dtheta, theta, half_angle)
        return self._finish_rolling(rolling_motion, half_angle, is_valid_state)[0]

    def _finish_rolling(
        self, rolling_motion: "RollingMotion", half_angle: Array, is_valid: Array
    ) -> tuple[AdvanceResult, Array]:
        """Return the end of a rolling motion, and the minima of its margins.

        The step fails if the wheel falls back or lifts off, or if the end lies behind the start.
        """
        margin_minima = rolling_motion.find_margin_minima()
        reaches_end = rolling_motion.reaches_end()
        lifts_off = (margin_minima[0] <= 0.0) & self.stop_at_lift_off
        outcome = jnp.where(reaches_end, jnp.int32(Outcome.STEPPED), jnp.int32(Outcome.FELL_BACK))
        outcome = jnp.where(reaches_end & lifts_off, jnp.int32(Outcome.LEG_1_LIFTED_OFF), outcome)
        lands_at_once = rolling_motion.end_angle < rolling_motion.first_angle
        outcome = jnp.where(lands_at_once, jnp.int32(Outcome.TOUCHDOWN_BEFORE_STOPPER), outcome)
        outcome = jnp.where(is_valid, outcome, jnp.int32(Outcome.BAD_INPUT))
        # A fast wheel keeps the masked results finite.
        fast_motion = dataclasses.replace(
            rolling_motion, initial_rate=jnp.where(reaches_end, rolling_motion.initial_rate, 10.0)
        )
        rate = jnp.sqrt(fast_motion.compute_squared_rate(fast_motion.end_angle))
        duration = fast_motion.compute_time_to_angle(fast_motion.end_angle)
        zero = jnp.zeros_like(rolling_motion.initial_rate)
        section_state, durations = _zero_unless(
            outcome == Outcome.STEPPED,
            (jnp.stack([half_angle + zero, rate, zero]), jnp.stack([zero, zero, duration])),
        )
        return AdvanceResult(
            section_state, durations, outcome, jnp.zeros_like(outcome)
        ), margin_minima

    def _compute_landing_impulses(
        self,
        s: Symbols,
        x: SectionStateEntries,
        rolling_motion: "RollingMotion",
    ) -> tuple:
        """Return the impulse on the rear foot, the friction required in the landing, and the
        stopper impulses.

        The impulses are in N s. The required friction coefficients are those of the fore foot and
        of the rear foot. The stopper impulses are those of legs 3 to n.
        """
        zero_like_rate = jnp.zeros_like(x[1])
        motion_after = rolling_motion.compute_motion_at_angle(
            -jnp.asarray(0.5 * s.alpha, zero_like_rate.dtype) + zero_like_rate
        )
        hub_velocity_jump = transitions.compute_hub_velocity_jump(
            transitions.compute_motion_before_landing(s, *x), motion_after
        )
        rear_impulse = (
            transitions.resolve_landing(s, *x).rear_impulse
            if self.held_landing
            else dynamics.FootForce(zero_like_rate, zero_like_rate)
        )
        # The impulse at the fore foot is the jump of total momentum, Mt v_hub (the mass centre),
        # minus that at the rear foot.
        fore_impulse = dynamics.FootForce(
            s.Mt * hub_velocity_jump[0] - rear_impulse.tangential,
            s.Mt * hub_velocity_jump[1] - rear_impulse.normal,
        )
        required_friction = tuple(
            dynamics.compute_required_friction(foot_impulse)
            for foot_impulse in (fore_impulse, rear_impulse)
        )
        stopper_impulses = transitions.compute_locked_leg_impulses(
            s, motion_after, hub_velocity_jump
        )
        return rear_impulse, required_friction, stopper_impulses

    def sample_step(
        self, params: WheelParams, x: SectionState, options: StepOptions, n_samples: int
    ) -> Trajectory:
        """Return the motion during a step at equidistant angles, not at equidistant times."""
        step_result = self.take_step(params, x, options)
        half_angle = 0.5 * params.leg_angle
        params, _, ground_ahead = select_stance_line(params, jnp.asarray(x).at[0].set(half_angle))
        end_angle = jnp.asarray(half_angle)
        if ground_ahead is not None:
            end_angle = half_angle + ground_ahead.compute_next_line_tilt(
                compute_foot_distance(params.symbols(), end_angle)
            )
        rolling_motion = RollingMotion(
            params.symbols(), params.slope, step_result.post_impact[1], -half_angle, end_angle
        )
        start_angles = jnp.full((n_samples,), -half_angle)
        rolling_angles = jnp.where(
            step_result.outcome == Outcome.STEPPED,
            jnp.linspace(-half_angle, end_angle, n_samples),
            start_angles,
        )
        sampled_angles = jnp.stack([start_angles, start_angles, rolling_angles])

        sampled_states, foot_forces, sampled_energies = (
            jnp.moveaxis(sampled_quantity, 0, -1)
            for sampled_quantity in rolling_motion.evaluate_states_at_angles(sampled_angles)
        )
        return Trajectory(
            rolling_motion.compute_time_to_angle(sampled_angles),
            sampled_states,
            foot_forces,
            sampled_energies,
            step_result.section_state,
            step_result.durations,
            step_result.outcome,
        )


class VerticalRateMap(NamedTuple):
    """Map of the squared angular rate from one vertical passage to the next on uneven ground.

    The map is x' = r (x + G (1 - cos(h + slope))) - G (1 - cos(h - slope)). The slope is that of
    the next line of the ground, and x is the squared rate with the stance leg vertical, 1/s^2. The
    wheel falls back if x' < 0, for a slope below h. As a function of the slope, x' = offset(x) +
    amplitude cos(slope - slope_of_largest_squared_rate).
    """

    retained_squared_rate_fraction: (
        Elementwise  # r, retained fraction of the squared rate in a landing
    )
    doubled_gravity_stiffness: Elementwise  # G, twice the gravity stiffness, 1/s^2
    half_angle: float  # h, half of the angle between two legs, rad

    @property
    def _cosine_and_sine_coefficients(self) -> tuple[Elementwise, Elementwise]:
        """Return the coefficients of cos(slope) and sin(slope) in the expression for x', divided by
        G.
        """
        r, h = self.retained_squared_rate_fraction, self.half_angle
        return (1.0 - r) * jnp.cos(h), (1.0 + r) * jnp.sin(h)

    @property
    def slope_of_largest_squared_rate(self) -> Elementwise:
        """Return the slope at which x' is largest, rad. At smaller slopes, x' increases with the
        slope.
        """
        cosine_coefficient, sine_coefficient = self._cosine_and_sine_coefficients
        return jnp.arctan2(sine_coefficient, cosine_coefficient)

    @property
    def squared_rate_amplitude(self) -> Elementwise:
        """Return the amplitude of x' as a function of the slope, 1/s^2."""
        cosine_coefficient, sine_coefficient = self._cosine_and_sine_coefficients
        return self.doubled_gravity_stiffness * jnp.sqrt(
            cosine_coefficient**2 + sine_coefficient**2
        )

    def compute_flattest_slope(self, x: Elementwise) -> Elementwise:
        """Return the slope below which the wheel falls back, rad."""
        slope_cosine = -self.compute_slope_independent_squared_rate(x) / self.squared_rate_amplitude
        # At the limits, the derivative of the arccosine is finite.
        slope_cosine = jnp.clip(slope_cosine, -1.0 + 1e-15, 1.0 - 1e-15)
        return self.slope_of_largest_squared_rate - jnp.arccos(slope_cosine)

    def compute_slope_independent_squared_rate(self, x: Elementwise) -> Elementwise:
        """Return the part of x' that does not depend on the slope, 1/s^2."""
        return self.retained_squared_rate_fraction * x - self.doubled_gravity_stiffness * (
            1.0 - self.retained_squared_rate_fraction
        )

    def compute_next_squared_rate(self, x: Elementwise, slope: Elementwise) -> Elementwise:
        """Return x', 1/s^2, for the slope of the next line, rad."""
        return self.compute_slope_independent_squared_rate(
            x
        ) + self.squared_rate_amplitude * jnp.cos(slope - self.slope_of_largest_squared_rate)

    def compute_rate_after_landing(self, x: Elementwise, slope: Elementwise) -> Elementwise:
        """Return the squared rate after the landing on a line with this slope (rad), 1/s^2."""
        drop = self.doubled_gravity_stiffness * (1.0 - jnp.cos(self.half_angle + slope))
        return self.retained_squared_rate_fraction * (x + drop)

    def compute_climb(self, slope: Elementwise) -> Elementwise:
        """Return the squared rate that a wheel loses between the landing on a line with this slope
        (rad) and the vertical, 1/s^2.
        """
        return self.doubled_gravity_stiffness * (1.0 - jnp.cos(self.half_angle - slope))

    def find_flattest_landing_slope(self, rate_after_landing: Elementwise) -> Elementwise:
        """Return the slope below which a wheel with this squared rate falls back, rad."""
        climb_cosine = 1.0 - rate_after_landing / self.doubled_gravity_stiffness
        return self.half_angle - jnp.arccos(jnp.maximum(climb_cosine, -1.0 + 1e-15))

    def compute_fixed_point(self, slope: Elementwise) -> Elementwise:
        """Return the squared angular rate that repeats after a step on even ground, in 1/s^2.

        - `slope`: slope of the ground, rad.
        """
        rate = self.squared_rate_amplitude * jnp.cos(slope - self.slope_of_largest_squared_rate)
        lost_fraction = 1.0 - self.retained_squared_rate_fraction
        return rate / lost_fraction - self.doubled_gravity_stiffness


# Number of rounds, each of which narrows the bracket of angles around the lowest sample. The value
# is chosen because the angle is then accurate to 1e-6 rad. The error of a minimum is the square of
# the error of its angle.
N_ZOOM_ROUNDS = 5


class RollingMotion(eqx.Module):
    """Rolling motion about one foot, computed from the rate at the first angle by energy
    conservation.
    """

    s: Symbols
    phi: Elementwise  # slope, rad
    initial_rate: Elementwise  # at the first angle, rad/s
    first_angle: Elementwise | float  # first angle theta, rad; -alpha/2 just after a landing
    end_angle: Elementwise  # angle theta at the next landing, rad; alpha/2 on flat ground

    def compute_squared_rate(self, theta: Elementwise) -> Elementwise:
        """Return the square of dtheta at the angle theta, rad^2/s^2.

        The value is negative if the wheel does not reach theta.
        """
        s = self.s
        height_drop = (
            _rotate_to_vertical(s, self.first_angle).cos - _rotate_to_vertical(s, theta).cos
        )
        return self.initial_rate**2 + 2.0 * _compute_gravity_stiffness(s) * height_drop

    def reaches_end(self) -> Array:
        """Return whether the wheel rolls forward to the end angle, past the highest position of the
        hub on its way.
        """
        apex_angle = jnp.clip(-self.phi, self.first_angle, self.end_angle)
        return (self.initial_rate > 0.0) & (self.compute_squared_rate(apex_angle) > 0.0)

    def compute_time_to_angle(self, theta: Elementwise) -> Elementwise:
        """Return the time between the first angle and theta, s, computed with Carlson's R_F.

        Let t be sin^2 of half the angle from the vertical. The rate is the square root of a linear
        function of t. Therefore the time is the complete cubic form of the elliptic integral.
        """
        kappa = 2.0 * _compute_gravity_stiffness(self.s)
        first_half_angle, last_half_angle = (
            0.5 * (self.phi + self.first_angle),
            0.5 * (self.phi + theta),
        )
        # This is the squared rate at the vertical.
        min_rate_squared = self.initial_rate**2 + kappa * (jnp.cos(2.0 * first_half_angle) - 1.0)
        has_passed_vertical = first_half_angle * last_half_angle < 0.0
        # The sign selects the side, because squares would have roots without a derivative at the
        # vertical.
        side = jnp.where(first_half_angle < 0.0, -1.0, 1.0)
        first_distance, last_distance = side * first_half_angle, side * last_half_angle
        zero_angle = jnp.zeros_like(last_half_angle)
        time_to_end = _compute_rolling_time(
            jnp.where(has_passed_vertical, zero_angle, jnp.minimum(first_distance, last_distance)),
            jnp.where(
                has_passed_vertical, last_half_angle, jnp.maximum(first_distance, last_distance)
            ),
            min_rate_squared,
            kappa,
        )
        time_to_vertical = _compute_rolling_time(
            zero_angle,
            jnp.where(has_passed_vertical, first_distance, 0.0),
            min_rate_squared,
            kappa,
        )
        return time_to_end + time_to_vertical

    def compute_motion_at_angle(self, theta: Elementwise) -> Motion:
        """Return the motion at the angle theta. Its angular rate is 0 if the wheel does not reach
        theta.
        """
        zero_like_theta = 0.0 * theta
        angular_rate = compute_square_root(self.compute_squared_rate(theta))
        leg_length = self.s.L0 + zero_like_theta
        return Motion.from_angle(
            theta, leg_length, leg_length, angular_rate, zero_like_theta, zero_like_theta
        )

    def compute_acceleration_at_angle(self, theta: Elementwise) -> dynamics.Acceleration:
        """Return the accelerations at the angle theta, for legs of constant length.

        Only the angular acceleration (rad/s^2) due to gravity differs from 0.
        """
        zero_like_theta = 0.0 * theta
        return dynamics.Acceleration(
            _compute_gravity_stiffness(self.s) * _rotate_to_vertical(self.s, theta).sin,
            zero_like_theta,
            zero_like_theta,
        )

    def compute_foot_force_at_angle(self, theta: Elementwise) -> dynamics.FootForce:
        """Return the force that the ground exerts on the stance foot at the angle theta, N."""
        return dynamics.compute_fore_foot_force(
            self.s, self.compute_motion_at_angle(theta), self.compute_acceleration_at_angle(theta)
        )

    def evaluate_states_at_angles(self, theta: Elementwise) -> tuple[Array, Array, Array]:
        """Return coordinates and rates, the forces on both feet (N), and the energies (J) at the
        angles theta.

        The first axis of each result holds its components.
        """
        wheel_motion, zero_force = self.compute_motion_at_angle(theta), 0.0 * theta
        return (
            jnp.stack([theta, *wheel_motion.lengths_and_rates]),
            jnp.stack([*self.compute_foot_force_at_angle(theta), zero_force, zero_force]),
            jnp.stack(dynamics.compute_mechanical_energy(self.s, wheel_motion)),
        )

    def evaluate_margins_at_angles(self, theta: Array) -> Array:
        """Return margin i at the angle `theta[i]`, for each margin.

        The margins are the normal force (N), the negative of the required friction, and the stopper
        forces of legs 2 to n (N).
        """
        stopper_forces = [
            dynamics.compute_stopper_force(
                self.s,
                self.compute_motion_at_angle(theta[leg_number]),
                self.compute_acceleration_at_angle(theta[leg_number]),
                range(leg_number, leg_number + 1),
            )[0]
            for leg_number in range(2, self.s.n + 1)
        ]
        required_friction = dynamics.compute_required_friction(
            self.compute_foot_force_at_angle(theta[1])
        )
        return jnp.stack(
            [self.compute_foot_force_at_angle(theta[0]).normal, -required_friction, *stopper_forces]
        )

    def find_margin_minima(self) -> Array:
        """Return the minima of the margins between two landings, accurate to round-off.

        The margins are those of `evaluate_margins_at_angles`. Each minimum is found by repeated
        zooming. Its error is the square of the remaining error of its angle.
        """
        middle_angle = 0.5 * (self.first_angle + self.end_angle) + 0.0 * self.initial_rate

        def zoom_to_minima(
            zoom_round_index: Array, bracket_centers_and_half_width: tuple[Array, Array]
        ) -> tuple[Array, Array]:
            bracket_centers, half_bracket_width = bracket_centers_and_half_width

            def update_lowest_margins(
                i: Array, lowest_angles_and_margins: tuple[Array, Array]
            ) -> tuple[Array, Array]:
                angle_offset = half_bracket_width * (
                    i * (2.0 / (N_ANGLES_PER_ZOOM_ROUND - 1)) - 1.0
                )
                candidate_angles = jnp.clip(
                    bracket_centers + angle_offset, self.first_angle, self.end_angle
                )
                candidate_margins = self.evaluate_margins_at_angles(candidate_angles)
                return select_trees_by_condition(
                    candidate_margins < lowest_angles_and_margins[1],
                    (candidate_angles, candidate_margins),
                    lowest_angles_and_margins,
                )

            initial_margins = jnp.full_like(bracket_centers, jnp.inf)
            minimum_angles, _ = lax.fori_loop(
                0,
                N_ANGLES_PER_ZOOM_ROUND,
                update_lowest_margins,
                (bracket_centers, initial_margins),
            )
            return minimum_angles, half_bracket_width * (2.5 / N_ANGLES_PER_ZOOM_ROUND)

        bracket_centers = jnp.stack([middle_angle] * (1 + self.s.n))
        half_bracket_width = 0.5 * (self.end_angle - self.first_angle)
        minimum_angles, _ = lax.fori_loop(
            0, N_ZOOM_ROUNDS, zoom_to_minima, (bracket_centers, half_bracket_width)
        )
        return self.evaluate_margins_at_angles(lax.stop_gradient(minimum_angles))


def _zero_unless(condition: Array, tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.where(condition, x, 0.0), tree)


def _compute_hub_inertia(s: Symbols) -> Elementwise:
    """Return the moment of inertia of all leg masses about the hub, n m (L0 - a)^2, kg m^2."""
    return s.n * s.m * s.c0**2


def _compute_foot_inertia(s: Symbols) -> Elementwise:
    """Return the moment of inertia of the wheel about the stance foot, kg m^2."""
    return s.Mt * s.L0**2 + _compute_hub_inertia(s)


def _compute_gravity_stiffness(s: Symbols) -> Elementwise:
    """Return Mt g L0 divided by the moment of inertia about the foot, 1/s^2.

    For a rimless wheel without leg masses, this is g/l.
    """
    return s.Mt * s.g * s.L0 / _compute_foot_inertia(s)


def _rotate_to_vertical(s: Symbols, theta: Elementwise | float) -> dynamics.SineCosine:
    """Return the sine and cosine of theta + phi, the angle of the stance leg from the vertical."""
    return dynamics.rotate_to_vertical(s, jnp.sin(theta), jnp.cos(theta))


def _compute_rolling_time(
    smaller_half_angle: Elementwise,
    larger_half_angle: Elementwise,
    min_rate_squared: Elementwise,
    kappa: Elementwise,
) -> Elementwise:
    """Return the time between two half-angles on one side of the vertical, s.

    The half-angles are not negative. With t = sin^2 of the half-angle, the time is the integral of
    dt / sqrt(t (1 - t) (min_rate_squared + 2 kappa t)). Its closed form is 2 R_F (DLMF 19.29.4).
    The result is 0 if the two half-angles are equal.
    """
    has_nonzero_range = larger_half_angle > smaller_half_angle
    smaller_half_angle = jnp.where(has_nonzero_range, smaller_half_angle, 0.0)
    larger_half_angle = jnp.where(has_nonzero_range, larger_half_angle, 1.0)
    y1, y2 = jnp.sin(smaller_half_angle), jnp.cos(smaller_half_angle)
    x1, x2 = jnp.sin(larger_half_angle), jnp.cos(larger_half_angle)
    # Where the wheel does not get, any rate keeps the masked derivatives finite.
    y3, x3 = (
        jnp.sqrt(jnp.where(squared_rate > 0.0, squared_rate, 1.0))
        for squared_rate in (min_rate_squared + 2.0 * kappa * sine**2 for sine in (y1, x1))
    )
    squared_sine_difference = x1**2 - y1**2
    u12 = (x1 * x2 * y3 + y1 * y2 * x3) / squared_sine_difference
    u13 = (x1 * x3 * y2 + y1 * y3 * x2) / squared_sine_difference
    u23 = (x2 * x3 * y1 + y2 * y3 * x1) / squared_sine_difference
    return jnp.where(has_nonzero_range, 2.0 * evaluate_carlson_rf(u12**2, u13**2, u23**2), 0.0)


def evaluate_carlson_rf(x: Elementwise, y: Elementwise, z: Elementwise) -> Elementwise:
    """Return Carlson's symmetric elliptic integral R_F, accurate to round-off (DLMF 19.36.1).

    The method is duplication: each duplication divides the differences between the arguments by
    four. After 12 duplications, the fifth-order series is exact in float64 if the arguments lie
    within ten decades of each other.
    """

    def apply_duplication_step(
        _: object, xyz: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        sqrt_x, sqrt_y, sqrt_z = map(jnp.sqrt, xyz)
        duplication_shift = sqrt_x * sqrt_y + sqrt_y * sqrt_z + sqrt_z * sqrt_x
        x, y, z = (0.25 * (argument + duplication_shift) for argument in xyz)
        return x, y, z

    x, y, z = lax.fori_loop(0, 12, apply_duplication_step, (x, y, z))
    mean_argument = (x + y + z) / 3.0
    dx, dy = 1.0 - x / mean_argument, 1.0 - y / mean_argument
    dz = -dx - dy
    e2, e3 = dx * dy - dz * dz, dx * dy * dz
    return (1.0 - e2 / 10.0 + e3 / 14.0 + e2 * e2 / 24.0 - 3.0 * e2 * e3 / 44.0) / jnp.sqrt(
        mean_argument
    )

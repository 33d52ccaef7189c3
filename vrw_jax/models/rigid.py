"""Rigid model: all legs are rigid. A step has a closed form; nothing is integrated."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vrw_jax.models.base import (
    AbstractWheel,
    Advance,
    EnergyLoss,
    Indicators,
    Margins,
    Numbers,
    SectionState,
    StepResult,
    Trajectory,
    replaced_where_bad,
    usable,
)
from vrw_jax.numerics import Elementwise, Options, select
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Motion,
    Outcome,
    Symbols,
    WheelParams,
    dynamics,
    known_friction,
    rear_foot_height,
    transitions,
)
from vrw_jax.wording import flag

GRID = 33
"""Number of angles in each zoom on the minimum of a force, chosen because forces are smooth over
the 45 degrees of a step."""


class RigidWheel(AbstractWheel):
    """Rimless wheel with rigid legs and leg masses; springs, dampers and L* have no effect.

    The section state is (alpha/2, dtheta-, 0). Only the rate is free, and the other entries of a
    start are ignored. The whole step counts as SLS-II.

    - `friction`: coefficient of the ground, which enters the friction margins but not the motion;
    - `stop_at_lift_off`: end a step where the normal force of the ground would become negative;
    - `holds_rear_foot`: False is the classic landing, whose rear foot leaves without an impulse
      (angular momentum about the new foot is kept). True is the stiff limit of the paper's own
      landing (A4), whose rear foot is held during the impulse: the limit of `ViscoelasticWheel`, as
      docs/physics.md derives it.

    Examples:
        >>> params = vrw.WheelParams(slope=0.15)
        >>> step = vrw.step(params, [np.pi / 8, 1.5, 0.0], model=vrw.RigidWheel())
        >>> print(f"{step.period:.3f} s")
        0.705 s
    """

    rung: ClassVar[str] = "rigid"
    parameter_names: ClassVar[tuple[str, ...]] = PARAMETER_NAMES
    tells_contacts: ClassVar[bool] = False
    legs_yield: ClassVar[bool] = False

    friction: float = eqx.field(static=True, converter=known_friction, default=1.0)
    stop_at_lift_off: bool = eqx.field(
        static=True, converter=partial(flag, "stop_at_lift_off"), default=True
    )
    held_landing: bool = eqx.field(
        static=True, converter=partial(flag, "held_landing"), default=False
    )

    def start(self, params: WheelParams) -> SectionState:
        """Return the rate of the rolling fixed point, or a fast start where no fixed point
        exists.
        """
        s = params.symbols()
        keep = self._kept(s)
        gained = 4.0 * _stiffness_of_gravity(s) * jnp.sin(0.5 * s.alpha) * s.sin_phi
        rate = jnp.sqrt(jnp.maximum(gained, 0.1) / (1.0 - keep * keep))
        return jnp.stack([0.5 * s.alpha + 0.0 * rate, rate, 0.0 * rate])

    def advance(self, params: WheelParams, x: SectionState, options: Options) -> Advance:
        result = self.step(params, x, options)
        return Advance(result.section_state, result.durations, result.outcome, result.solver_steps)

    def _kept(self, s: Symbols) -> Elementwise:
        """Return the ratio of the rate after to the rate before the landing."""
        foot_inertia = _foot_inertia(s)
        if not self.held_landing:
            return (s.Mt * s.L0**2 * s.cos_alpha + _hub_inertia(s)) / foot_inertia
        half = jnp.asarray(0.5 * s.alpha, s.L0.dtype)
        m = transitions.land(s, half, jnp.ones_like(half), jnp.zeros_like(half)).motion
        M = dynamics.mass_matrix(s, m.L1, m.L2)
        return M.times((m.dtheta, m.dL1, m.dL2))[0] / foot_inertia

    @eqx.filter_jit
    def step(self, params: WheelParams, x: SectionState, options: Options) -> StepResult:
        return self.rolled(params, tuple(x), jnp.asarray(self.friction, x.dtype))

    def rolled(self, params: WheelParams, x: Numbers, friction: Elementwise) -> StepResult:
        """Return the step elementwise: for one wheel or for a batch."""
        half = jnp.asarray(0.5 * params.leg_angle, x[1].dtype)
        x = (half + 0.0 * x[0], x[1], 0.0 * x[2])
        good = usable(params, x)
        params, x = replaced_where_bad(good, params, x, (half, 1.0, 0.0))
        s = params.symbols()
        before, rate = x[1], self._kept(s) * x[1]
        roll = Roll(s, params.slope, rate)

        apex = jnp.where(s.sin_phi < jnp.sin(half), -params.slope, -half)
        passes = roll.rate_squared(apex) > 0.0
        lowest = roll.lowest_premises()
        lifts = (lowest[0] <= 0.0) & passes & self.stop_at_lift_off
        outcome = jnp.where(passes, Outcome.STEPPED, Outcome.FELL_BACK).astype(jnp.int32)
        outcome = jnp.where(lifts, jnp.int32(Outcome.LEG_1_LIFTED_OFF), outcome)
        outcome = jnp.where(good, outcome, jnp.int32(Outcome.BAD_INPUT))
        stepped = outcome == Outcome.STEPPED
        reach = Roll(s, params.slope, jnp.where(passes, rate, 10.0))
        after, duration = jnp.sqrt(reach.rate_squared(half)), reach.time(half)

        zero = jnp.zeros_like(before)
        tell = lambda value: jnp.where(good, value, jnp.zeros_like(value))
        walked = lambda value: jnp.where(stepped, value, jnp.zeros_like(value))
        rear, friction_left, stopper_impulse = self._landing(s, x, roll, friction)
        return StepResult(
            section_state=walked(jnp.stack([half + zero, after, zero])),
            post_impact=tell(jnp.stack([-half + zero, rate])),
            durations=walked(jnp.stack([zero, zero, duration])),
            step_length=tell(2.0 * s.L0 * jnp.sin(half)),
            indicators=Indicators(
                lambda_I4=tell(rear.normal),
                lambda_2=tell(roll.foot_force(-half + zero).normal),
                lambda_4=zero,
            ),
            monitors=Margins(
                fore_foot_force=walked(lowest[0]),
                takeoff_acceleration=zero,
                clearance_sls1=zero,
                clearance_sls2=walked(rear_foot_height(s, roll.motion(half + zero))),
                locked_stopper_force=walked(lowest[3:]),
                rear_stopper_force=walked(lowest[2]),
                contraction=zero,
                friction_fore=walked(friction + lowest[1]),
                friction_rear=tell(friction + zero),
                landing_stopper_impulse=tell(stopper_impulse),
                hit_stopper_impulse=jnp.zeros_like(stopper_impulse),
                hit_planted_impulse=zero,
                landing_friction_fore=tell(friction_left[0]),
                landing_friction_rear=tell(friction_left[1]),
            ),
            energy=EnergyLoss(
                landing=tell(0.5 * _foot_inertia(s) * (before * before - rate * rate)),
                stopper=zero,
                damping=zero,
            ),
            outcome=outcome,
            solver_steps=jnp.zeros_like(outcome),
        )

    def _landing(self, s: Symbols, x: Numbers, roll: "Roll", friction: Elementwise) -> tuple:
        """Return the landing impulses and friction margins.

        These are the impulse at the rear foot, the friction margins of both feet (fore, rear), and
        the impulses of the stoppers of legs 3..n.
        """
        zero = jnp.zeros_like(x[1])
        first = roll.motion(-jnp.asarray(0.5 * s.alpha, zero.dtype) + zero)
        jump = transitions.jump_of_hub(transitions.motion_before_landing(s, *x), first)
        held = self.held_landing
        rear = transitions.land(s, *x).rear if held else dynamics.FootForce(zero, zero)
        # Impulse at the fore foot: the jump of total momentum Mt v_hub (the mass centre).
        fore = dynamics.FootForce(s.Mt * jump[0] - rear.tangential, s.Mt * jump[1] - rear.normal)
        left = tuple(friction - dynamics.friction_needed(foot) for foot in (fore, rear))
        impulse = transitions.locked_leg_impulses(s, first, jump, range(3, s.n + 1))
        return rear, left, impulse

    def trace(
        self, params: WheelParams, x: SectionState, options: Options, n_samples: int
    ) -> Trajectory:
        """Return the motion at equal angles instead of equal times."""
        result = self.step(params, x, options)
        s = params.symbols()
        roll = Roll(s, params.slope, result.post_impact[1])
        stands = jnp.full((n_samples,), -0.5 * s.alpha)
        rolls = jnp.where(
            result.outcome == Outcome.STEPPED,
            jnp.linspace(-0.5 * s.alpha, 0.5 * s.alpha, n_samples),
            stands,
        )
        angles = jnp.stack([stands, stands, rolls])

        state, forces, energy = (jnp.moveaxis(rows, 0, -1) for rows in roll.described(angles))
        ends = result.section_state, result.durations, result.outcome
        return Trajectory(roll.time(angles), state, forces, energy, *ends)


class Roll(eqx.Module):
    """Rolling over one foot from theta = -alpha/2 at the given rate, by conservation of energy."""

    s: Symbols
    phi: Elementwise  # slope, rad
    rate: Elementwise  # at theta = -alpha/2, rad/s

    def rate_squared(self, theta: Elementwise) -> Elementwise:
        """Return the square of dtheta at theta; negative where the wheel does not arrive."""
        s = self.s
        fallen = _cos_sum(s, -0.5 * s.alpha) - _cos_sum(s, theta)
        return self.rate**2 + 2.0 * _stiffness_of_gravity(s) * fallen

    def time(self, theta: Elementwise) -> Elementwise:
        """Return the time from theta = -alpha/2, s, by Carlson's R_F.

        With t = sin^2 of half the angle from the vertical, the rate is the square root of a linear
        function of t. Time is then the complete cubic form of the elliptic integral.
        """
        s = self.s
        kappa = 2.0 * _stiffness_of_gravity(s)
        begin, end = 0.5 * (self.phi - 0.5 * s.alpha), 0.5 * (self.phi + theta)
        # Squared rate at the vertical.
        least = self.rate**2 + kappa * (jnp.cos(2.0 * begin) - 1.0)
        apart = begin * end < 0.0
        from_vertical = jnp.zeros_like(end)
        direct = _cubic_time(
            jnp.where(apart, from_vertical, jnp.minimum(begin**2, end**2)),
            jnp.where(apart, end**2, jnp.maximum(begin**2, end**2)),
            least,
            kappa,
        )
        first = _cubic_time(from_vertical, jnp.where(apart, begin**2, 0.0), least, kappa)
        return direct + first

    def motion(self, theta: Elementwise) -> Motion:
        """Return the motion at theta; its rate is zero where the wheel does not arrive."""
        zero = 0.0 * theta
        speed_squared = self.rate_squared(theta)
        moving = speed_squared > 0.0
        rate = jnp.where(moving, jnp.sqrt(jnp.where(moving, speed_squared, 1.0)), 0.0)
        length = self.s.L0 + zero
        return Motion.of(theta, length, length, rate, zero, zero)

    def acceleration(self, theta: Elementwise) -> dynamics.Acceleration:
        """Return the angular acceleration under gravity; the legs do not move."""
        zero = 0.0 * theta
        sin_p = jnp.sin(theta) * self.s.cos_phi + jnp.cos(theta) * self.s.sin_phi
        return dynamics.Acceleration(_stiffness_of_gravity(self.s) * sin_p, zero, zero)

    def foot_force(self, theta: Elementwise) -> dynamics.FootForce:
        """Return the force of the ground on the stance foot, N."""
        return dynamics.fore_foot_force(self.s, self.motion(theta), self.acceleration(theta))

    def stopper_force(self, theta: Elementwise, legs: range) -> Float[Array, "n ..."]:
        """Return the force of the stoppers of `legs`, N."""
        return dynamics.stopper_force(self.s, self.motion(theta), self.acceleration(theta), legs)

    def described(self, theta: Elementwise) -> tuple[Array, Array, Array]:
        """Return coordinates with rates, forces of both feet and energies at theta, as rows."""
        m, force, zero = self.motion(theta), self.foot_force(theta), 0.0 * theta
        state = jnp.stack([theta, m.L1, m.L2, m.dtheta, m.dL1, m.dL2])
        forces = jnp.stack([force.tangential, force.normal, zero, zero])
        return state, forces, jnp.stack(dynamics.energy(self.s, m))

    def premises(self, theta: Array) -> Array:
        """Return the margins, each at its own angle.

        They are the normal force, minus the required friction, and the stopper forces of legs 2..n.
        """
        stoppers = [
            self.stopper_force(theta[leg], range(leg, leg + 1))[0] for leg in range(2, self.s.n + 1)
        ]
        needed = dynamics.friction_needed(self.foot_force(theta[1]))
        return jnp.stack([self.foot_force(theta[0]).normal, -needed, *stoppers])

    def lowest_premises(self) -> Array:
        """Return the minima of `margins` from landing to landing, to round-off.

        Each minimum is found by repeated zooming; the remaining error of the angle enters squared.
        """
        half = jnp.asarray(0.5 * self.s.alpha, self.rate.dtype)

        def zoom(_round: Array, around: tuple[Array, Array]) -> tuple[Array, Array]:
            center, width = around

            def look(i: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
                theta = jnp.clip(center + width * (i * (2.0 / (GRID - 1)) - 1.0), -half, half)
                value = self.premises(theta)
                return select(value < best[1], (theta, value), best)

            nothing = center, jnp.full_like(center, jnp.inf)
            return lax.fori_loop(0, GRID, look, nothing)[0], width * (2.5 / GRID)

        begin = jnp.stack([0.0 * self.rate] * (1 + self.s.n))
        theta, _ = lax.fori_loop(0, 5, zoom, (begin, half))
        return self.premises(lax.stop_gradient(theta))


def _hub_inertia(s: Symbols) -> Elementwise:
    """Return the moment of inertia of all leg masses about the hub, n m (L0 - a)^2, kg m^2."""
    return s.n * s.m * s.c0**2


def _foot_inertia(s: Symbols) -> Elementwise:
    """Return the moment of inertia of the wheel about a foot, kg m^2."""
    return s.Mt * s.L0**2 + _hub_inertia(s)


def _stiffness_of_gravity(s: Symbols) -> Elementwise:
    """Return Mt g L0 over the inertia about the foot, 1/s^2.

    It equals g/l for a rimless wheel without leg masses.
    """
    return s.Mt * s.g * s.L0 / _foot_inertia(s)


def _cos_sum(s: Symbols, theta: Elementwise | float) -> Elementwise:
    """Return cos(theta + phi)."""
    return jnp.cos(theta) * s.cos_phi - jnp.sin(theta) * s.sin_phi


def _cubic_time(
    begin_squared: Elementwise, end_squared: Elementwise, least: Elementwise, kappa: Elementwise
) -> Elementwise:
    """Return the time between two half-angles on one side of the vertical, given by their squares,
    s.

    It is the integral of dt / sqrt(t (1 - t) (min_rate_squared + 2 kappa t)) over t = sin^2, as 2
    R_F (DLMF 19.29.4); zero if both ends coincide.
    """
    apart = end_squared > begin_squared
    low = jnp.where(apart, begin_squared, 0.0)
    high = jnp.where(apart, end_squared, 1.0)
    at_foot = low > 0.0  # sqrt has no derivative at the vertical, where Y1 = 0
    angle_low = jnp.where(at_foot, jnp.sqrt(jnp.where(at_foot, low, 1.0)), 0.0)
    angle_high = jnp.sqrt(high)
    y1, y2 = jnp.sin(angle_low), jnp.cos(angle_low)
    x1, x2 = jnp.sin(angle_high), jnp.cos(angle_high)
    y3 = jnp.sqrt(jnp.maximum(least + 2.0 * kappa * y1**2, 1e-300))
    x3 = jnp.sqrt(jnp.maximum(least + 2.0 * kappa * x1**2, 1e-300))
    gap = x1**2 - y1**2
    u12 = (x1 * x2 * y3 + y1 * y2 * x3) / gap
    u13 = (x1 * x3 * y2 + y1 * y3 * x2) / gap
    u23 = (x2 * x3 * y1 + y2 * y3 * x1) / gap
    return jnp.where(apart, 2.0 * carlson_rf(u12**2, u13**2, u23**2), 0.0)


def carlson_rf(x: Elementwise, y: Elementwise, z: Elementwise) -> Elementwise:
    """Return Carlson's symmetric elliptic integral R_F to round-off, by duplication (DLMF 19.36.1).

    Each duplication brings the arguments four times closer together. After 12 duplications the
    fifth-order series is exact in float64 for arguments within ten decades of each other.
    """

    def double(_: object, xyz: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, y, z = xyz
        root_x, root_y, root_z = jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z)
        shift = root_x * root_y + root_y * root_z + root_z * root_x
        return 0.25 * (x + shift), 0.25 * (y + shift), 0.25 * (z + shift)

    x, y, z = lax.fori_loop(0, 12, double, (x, y, z))
    mean = (x + y + z) / 3.0
    dx, dy = 1.0 - x / mean, 1.0 - y / mean
    dz = -dx - dy
    e2, e3 = dx * dy - dz * dz, dx * dy * dz
    return (1.0 - e2 / 10.0 + e3 / 14.0 + e2 * e2 / 24.0 - 3.0 * e2 * e3 / 44.0) / jnp.sqrt(mean)

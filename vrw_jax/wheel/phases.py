"""The three phases of the paper's step (Section 3.3), shared by every engine.

A phase integrates the first `n_dof` of the coordinates (theta, L1, L2); the others follow from
these. All functions work elementwise, for one wheel, a batch, or the nodes of a collocation. Guards
are positive inside the phase and trigger when they fall through zero. The first guard is the
regular end of the phase. `reset_map` maps the motion at that end to the initial motion of the next
of `PAPER_PHASES`.
"""

import abc
import dataclasses
import functools
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax.numerics import Elementwise, Vector, sine_cosine
from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import Acceleration, FootForce
from vrw_jax.wheel.geometry import (
    DoubleSupportCircle,
    Motion,
    double_support_circle,
    landing_direction,
    landing_foot_height,
    rear_foot_height,
)
from vrw_jax.wheel.outcomes import Outcome
from vrw_jax.wheel.params import Symbols
from vrw_jax.wheel.rest import is_at_rest
from vrw_jax.wheel.units import compute_wheel_units

SHARED_FAILURE_OUTCOMES = (Outcome.FELL_BACK, Outcome.COLLAPSED, Outcome.LEG_1_LIFTED_OFF)
"""Outcomes by which every phase can leave the paper's sequence."""


class PhaseMargins(NamedTuple):
    """Margins of a phase, which do not affect its motion. A margin is negative if its assumption is
    violated.
    """

    fore_foot_force: Elementwise  # N
    contraction: Elementwise  # L0 - L1, m
    friction: Elementwise  # minus the required coefficient at the fore foot
    locked_stopper_force: Vector  # of legs 3..n, N
    rear_clearance: Elementwise | None = None  # height of foot 2 in single support, m
    rear_stopper_force: Elementwise | None = None  # of Leg 2 in single support II, N

    @classmethod
    def from_values(cls, values: Vector, n_legs: int) -> "PhaseMargins":
        """Return the margins from one sequence of all values."""
        n_locked = n_legs - 2
        fore_foot_force, contraction, friction, *remaining_values = values
        locked_stopper_force, optional_values = (
            tuple(remaining_values[:n_locked]),
            remaining_values[n_locked:],
        )
        return cls(fore_foot_force, contraction, friction, locked_stopper_force, *optional_values)


@dataclasses.dataclass(frozen=True)
class AbstractPhase(abc.ABC):
    """Phase of a step of the wheel `s`: its equations of motion, guards, margins and reset."""

    s: Symbols
    constants: Vector  # constants of the phase: in double support the distance of the feet, m
    stop_at_lift_off: bool  # whether the phase ends when the ground would pull
    tilt_sin_cos: Vector = ()
    """Sine and cosine of the angle by which the next line is steeper; empty on flat ground."""

    name: ClassVar[str]
    n_dof: ClassVar[int]
    """Number of degrees of freedom of the phase."""
    guard_outcomes: ClassVar[tuple[Outcome, ...]]
    """Outcomes of `end_guard` (STEPPED) and of `specific_guards`."""
    counts_contraction_at_start: ClassVar[bool] = False
    counts_specific_margins_at_start: ClassVar[tuple[bool, ...]] = ()
    """Whether Leg 1's contraction and the specific margins of this phase count at its start. A
    margin that is zero at the start by construction does not count."""
    can_come_to_rest: ClassVar[bool] = False
    """Whether the phase contains a stable equilibrium of the wheel."""
    has_stiff_start: ClassVar[bool] = False
    """Whether the phase starts with the fast mode of the airborne leg, near c/m, which decays
    quickly."""

    @abc.abstractmethod
    def complete_motion(self, sin: Elementwise, cos: Elementwise, q: Vector, v: Vector) -> Motion:
        """Return the full motion from the phase's coordinates q and rates v, and theta's sine and
        cosine.
        """

    @abc.abstractmethod
    def acceleration(self, motion: Motion) -> Acceleration:
        """Return all accelerations by the equations of motion."""

    @abc.abstractmethod
    def dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        """Return the residual of the equations of motion at `phase_acceleration`.

        The residual is linear in the accelerations. The derivative of the residual is far cheaper
        than that of the solution.
        """

    @abc.abstractmethod
    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        """Return the accelerations for which the linear part of the residual equals
        `right_hand_side`.
        """

    @abc.abstractmethod
    def complete_acceleration(self, motion: Motion, phase_acceleration: Vector) -> Acceleration:
        """Return all three accelerations from those of the phase's coordinates."""

    @abc.abstractmethod
    def end_guard(self, instant: "PhaseInstant") -> Elementwise:
        """Return the guard whose zero is the regular end of the phase, m or N.

        The guard is positive before the end.
        """

    @abc.abstractmethod
    def specific_guards(self, instant: "PhaseInstant") -> Vector:
        """Return the guards of this phase that other phases do not have."""

    @abc.abstractmethod
    def specific_margins(self, instant: "PhaseInstant") -> Vector:
        """Return the margins of this phase that other phases do not have."""

    @abc.abstractmethod
    def reset_map(self, motion: Motion) -> Motion:
        """Return the motion just after the regular end of the phase."""

    def landing_height(self, motion: Motion) -> Elementwise:
        """Return the height of the next leg's foot above the line on which the foot lands, m.

        That line begins at the foot of Leg 1. In its frame the height has the form of flat ground.
        """
        return landing_foot_height(self.s, self._rotate_to_next_line(motion))

    def landing_rate(self, motion: Motion) -> Elementwise:
        """Return the time derivative of `landing_height`, m/s."""
        rotated_motion = self._rotate_to_next_line(motion)
        landing_leg = landing_direction(self.s, rotated_motion.sin, rotated_motion.cos)
        lever_arm = self.s.L0 * landing_leg.sin - rotated_motion.L1 * rotated_motion.sin
        return rotated_motion.dL1 * rotated_motion.cos + lever_arm * rotated_motion.dtheta

    def _rotate_to_next_line(self, motion: Motion) -> Motion:
        """Return the motion in the frame of the next line."""
        if not self.tilt_sin_cos:
            return motion
        tilt_sin, tilt_cos = self.tilt_sin_cos
        sin = motion.sin * tilt_cos - motion.cos * tilt_sin
        cos = motion.cos * tilt_cos + motion.sin * tilt_sin
        return motion._replace(sin=sin, cos=cos)

    @property
    def coordinate_units(self) -> Vector:
        """Return the wheel's units of the phase's coordinates, then of their rates."""
        units = compute_wheel_units(self.s)
        position_units = jnp.ones_like(units.length), units.length, units.length
        rate_units = units.rate, units.velocity, units.velocity
        return *position_units[: self.n_dof], *rate_units[: self.n_dof]

    def motion_at(self, q: Vector, v: Vector) -> Motion:
        """Return the full motion at the phase's coordinates q and rates v."""
        return self.complete_motion(*sine_cosine(q[0]), q, v)

    def rear_force(self, motion: Motion, acceleration: Acceleration) -> FootForce | None:
        """Return the force of the ground on the rear foot, N; None if the foot is in the air."""
        return None

    def guards(self, instant: "PhaseInstant") -> Vector:
        """Return all guards: those of the phase, then those of `SHARED_FAILURE_OUTCOMES`."""
        m = instant.motion
        values = (
            self.end_guard(instant),
            *self.specific_guards(instant),
            m.dtheta,
            jnp.minimum(m.L1, m.L2) - self.s.a,
        )
        return (*values, instant.fore_force.normal) if self.stop_at_lift_off else values

    @property
    def all_guard_outcomes(self) -> tuple[Outcome, ...]:
        """Return the outcomes of all guards, in the order of `guards`."""
        return self.guard_outcomes + (
            SHARED_FAILURE_OUTCOMES if self.stop_at_lift_off else SHARED_FAILURE_OUTCOMES[:-1]
        )

    def evaluate_margins(self, instant: "PhaseInstant") -> Vector:
        """Return all margins, in the order of `PhaseMargins`."""
        s, m = self.s, instant.motion
        locked_stopper_force = dynamics.stopper_force(s, m, instant.acceleration, range(3, s.n + 1))
        shared_margins = (
            instant.fore_force.normal,
            s.L0 - m.L1,
            -dynamics.required_friction(instant.fore_force),
        )
        return (*shared_margins, *locked_stopper_force, *self.specific_margins(instant))

    @property
    def margins_counted_at_start(self) -> tuple[bool, ...]:
        """Return whether each margin counts at the start of the phase."""
        locked_flags = (True,) * (self.s.n - 2)
        return (
            True,
            self.counts_contraction_at_start,
            True,
            *locked_flags,
            *self.counts_specific_margins_at_start,
        )

    def outcome_of_guard(self, guard: Int[Array, "..."], is_timed_out: Bool[Array, "..."]) -> Array:
        """Return the `Outcome` of a phase that ended at the guard of an index; STEPPED for its
        regular end.

        An index of -1 means that no guard ended the phase.
        """
        outcome = jnp.full_like(guard, Outcome.SOLVER_FAILED)
        for index, guard_outcome in enumerate(self.all_guard_outcomes):
            outcome = jnp.where(guard == index, jnp.int32(guard_outcome), outcome)
        return jnp.where(is_timed_out, jnp.int32(Outcome.NO_TOUCHDOWN_IN_TIME), outcome)

    def is_at_rest(self, q: Vector, v: Vector, atol: Elementwise) -> Bool[Array, "..."]:
        """Return whether the wheel is at rest at these coordinates and rates.

        - `atol`: absolute tolerance in the wheel's units.
        """
        q, v = lax.stop_gradient((q, v))
        acceleration = self.acceleration(self.motion_at(q, v))[: self.n_dof]
        time_unit = compute_wheel_units(self.s).time
        return is_at_rest(v, acceleration, self.coordinate_units[self.n_dof :], time_unit, atol)

    @classmethod
    def select_coordinates(cls, theta: Elementwise, motion: Motion) -> tuple[Vector, Vector]:
        """Return the phase's coordinates and rates of a motion at the angle theta."""
        q, v = (theta, motion.L1, motion.L2), (motion.dtheta, motion.dL1, motion.dL2)
        return q[: cls.n_dof], v[: cls.n_dof]


class PhaseInstant:
    """State of a phase at one time, with forces that are computed when they are read.

    - `phase_acceleration`: accelerations of the phase's coordinates; None means those of the
      equations of motion.
    """

    def __init__(
        self, phase: AbstractPhase, motion: Motion, phase_acceleration: Vector | None
    ) -> None:
        self.phase, self.motion, self._phase_acceleration = phase, motion, phase_acceleration

    @functools.cached_property
    def acceleration(self) -> Acceleration:
        """Return the accelerations of all three coordinates."""
        if self._phase_acceleration is None:
            return self.phase.acceleration(self.motion)
        return self.phase.complete_acceleration(self.motion, self._phase_acceleration)

    @functools.cached_property
    def rear_force(self) -> FootForce | None:
        """Return the force of the ground on the rear foot, N; None if the foot is in the air."""
        return self.phase.rear_force(self.motion, self.acceleration)

    @functools.cached_property
    def fore_force(self) -> FootForce:
        """Return the force of the ground on the fore foot, N."""
        return dynamics.fore_foot_force(
            self.phase.s, self.motion, self.acceleration, self.rear_force
        )


class DoubleSupport(AbstractPhase):
    """DLS, in theta: the hub moves on a circle until the rear foot lifts off (Section 3.3.1)."""

    name, n_dof = "DLS", 1
    can_come_to_rest = True
    guard_outcomes = (
        Outcome.STEPPED, Outcome.STOPPER_IN_DOUBLE_SUPPORT, Outcome.TOUCHDOWN_BEFORE_STOPPER
    )  # fmt: skip

    def _compute_circle(self, sin: Elementwise, cos: Elementwise) -> DoubleSupportCircle:
        """Return leg lengths and derivatives on the hub's circle at an angle of Leg 1."""
        return double_support_circle(self.s, self.constants[0], sin, cos)

    def _make_equation(self, motion: Motion) -> dynamics.SingleDofEquation:
        """Return the equation of motion on the hub's circle."""
        return dynamics.double_support_equation(self.s, self.constants[0], motion)

    def complete_motion(self, sin: Elementwise, cos: Elementwise, q: Vector, v: Vector) -> Motion:
        circle, (dtheta,) = self._compute_circle(sin, cos), v
        rates = (dtheta, circle.G1 * dtheta, circle.G2 * dtheta)
        return Motion(sin, cos, circle.L1, circle.L2, *rates)

    def acceleration(self, motion: Motion) -> Acceleration:
        return dynamics.double_support_acceleration(self.s, self.constants[0], motion)

    def complete_acceleration(self, motion: Motion, phase_acceleration: Vector) -> Acceleration:
        return dynamics.accelerations_on_circle(
            self._compute_circle(motion.sin, motion.cos), motion.dtheta, phase_acceleration[0]
        )

    def dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        inertia, force = self._make_equation(motion)
        return (inertia * phase_acceleration[0] - force,)

    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        return (right_hand_side[0] / self._make_equation(motion).inertia,)

    def rear_force(self, motion: Motion, acceleration: Acceleration) -> FootForce:
        return dynamics.rear_foot_force(self.s, motion, acceleration)

    def end_guard(self, instant: PhaseInstant) -> Elementwise:
        assert instant.rear_force is not None
        return instant.rear_force.normal

    def specific_guards(self, instant: PhaseInstant) -> Vector:
        return self.s.L0 - instant.motion.L2, self.landing_height(instant.motion)

    def specific_margins(self, instant: PhaseInstant) -> Vector:
        return ()

    def reset_map(self, motion: Motion) -> Motion:
        """Return the motion unchanged: the rear foot is released at rest."""
        return motion


class SingleSupport1(AbstractPhase):
    """SLS-I, in (theta, L1, L2): Leg 2 moves freely until its stopper (Section 3.3.2)."""

    name, n_dof = "SLS-I", 3
    guard_outcomes = Outcome.STEPPED, Outcome.TOUCHDOWN_BEFORE_STOPPER
    counts_specific_margins_at_start = (False,)
    has_stiff_start = True

    def complete_motion(self, sin: Elementwise, cos: Elementwise, q: Vector, v: Vector) -> Motion:
        return Motion(sin, cos, q[1], q[2], *v)

    def acceleration(self, motion: Motion) -> Acceleration:
        return dynamics.single_support_1_acceleration(self.s, motion)

    def complete_acceleration(self, motion: Motion, phase_acceleration: Vector) -> Acceleration:
        return Acceleration(*phase_acceleration)

    def dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        M, *forces = dynamics.equation_terms(self.s, motion)
        inertial_forces = M.multiply(Acceleration(*phase_acceleration))
        return tuple(n - f for n, f in zip(inertial_forces, forces, strict=True))

    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        M = dynamics.mass_matrix(self.s, motion.L1, motion.L2)
        return dynamics.free_acceleration(
            self.s, motion.L1, dynamics.EquationTerms(M, *right_hand_side)
        )

    def end_guard(self, instant: PhaseInstant) -> Elementwise:
        return self.s.L0 - instant.motion.L2

    def specific_guards(self, instant: PhaseInstant) -> Vector:
        return (self.landing_height(instant.motion),)

    def specific_margins(self, instant: PhaseInstant) -> Vector:
        return (rear_foot_height(self.s, instant.motion),)

    def reset_map(self, motion: Motion) -> Motion:
        """Return the motion after the collision of Leg 2 with its stopper, with L2 = L0 exactly."""
        return transitions.stop_leg_2(self.s, motion._replace(L2=self.s.L0 + 0.0 * motion.L2))


class SingleSupport2(AbstractPhase):
    """SLS-II, in (theta, L1): Leg 2 is on its stopper until touchdown (Section 3.3.3)."""

    name, n_dof = "SLS-II", 2
    guard_outcomes = (Outcome.STEPPED,)
    counts_contraction_at_start, counts_specific_margins_at_start = True, (True, True)

    def complete_motion(self, sin: Elementwise, cos: Elementwise, q: Vector, v: Vector) -> Motion:
        zero_rate = jnp.zeros_like(q[1])
        return Motion(sin, cos, q[1], self.s.L0 + zero_rate, v[0], v[1], zero_rate)

    def acceleration(self, motion: Motion) -> Acceleration:
        return dynamics.single_support_2_acceleration(self.s, motion)

    def complete_acceleration(self, motion: Motion, phase_acceleration: Vector) -> Acceleration:
        return Acceleration(phase_acceleration[0], phase_acceleration[1], motion.dL2)

    def dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        M, f1, f2, _ = dynamics.equation_terms(self.s, motion)
        ddtheta, ddL1 = phase_acceleration
        return M.M11 * ddtheta - f1, M.M22 * ddL1 - f2  # M12 is zero at L2 = L0.

    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        M = dynamics.mass_matrix(self.s, motion.L1, motion.L2)
        return (1.0 / M.M11) * right_hand_side[0], (1.0 / M.M22) * right_hand_side[1]

    def end_guard(self, instant: PhaseInstant) -> Elementwise:
        return self.landing_height(instant.motion)

    def specific_guards(self, instant: PhaseInstant) -> Vector:
        return ()

    def specific_margins(self, instant: PhaseInstant) -> Vector:
        s, m = self.s, instant.motion
        rear_stopper_force = dynamics.stopper_force(s, m, instant.acceleration, range(2, 3))
        return rear_foot_height(s, m), *rear_stopper_force

    def reset_map(self, motion: Motion) -> Motion:
        """Return the motion unchanged.

        `transitions.land` of the next step resolves the touchdown.
        """
        return motion


PAPER_PHASES: tuple[type[AbstractPhase], ...] = (DoubleSupport, SingleSupport1, SingleSupport2)
"""Phases of the paper's step, in order."""


def make_phases(
    s: Symbols, distance: Elementwise, stop_at_lift_off: bool, tilt_sin_cos: Vector = ()
) -> tuple[AbstractPhase, ...]:
    """Return the three phases of a step in which both feet are `distance` m apart at first.

    - `tilt_sin_cos`: see `AbstractPhase.tilt_sin_cos`.
    """
    phase_constants = ((distance,), (), ())
    return tuple(
        phase(s, constants, stop_at_lift_off, tilt_sin_cos)
        for phase, constants in zip(PAPER_PHASES, phase_constants, strict=True)
    )

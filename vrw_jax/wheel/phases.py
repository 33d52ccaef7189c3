"""The three phases of the paper's step (Section 3.3 of the paper), which every engine uses.

A phase integrates the first `n_dof` of the coordinates (theta, L1, L2). The other coordinates
follow from these. All functions work elementwise, for one wheel, a batch, or the nodes of a
collocation method. Guards are positive inside the phase and trigger when they fall through 0. The
first guard marks the regular end of the phase. `reset_motion` maps the motion at that end to the
initial motion of the next phase in `PAPER_PHASES`.
"""

import abc
import dataclasses
import functools
import operator
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from vrw_jax.base.elementwise import Elementwise, Vector, compute_sine_cosine
from vrw_jax.base.results import Outcome
from vrw_jax.wheel import dynamics, transitions
from vrw_jax.wheel.dynamics import (
    Acceleration,
    DoubleSupportCircle,
    FootForce,
    Motion,
    compute_double_support_circle,
    compute_landing_foot_height,
    compute_rear_foot_height,
)
from vrw_jax.wheel.laws import OneSidedLegForce, count_kinks, evaluate_leg_kinks
from vrw_jax.wheel.params import Symbols, compute_wheel_units
from vrw_jax.wheel.transitions import are_coordinates_at_rest

SHARED_FAILURE_OUTCOMES = (Outcome.FELL_BACK, Outcome.COLLAPSED, Outcome.LEG_1_LIFTED_OFF)
"""Outcomes with which any phase can end instead of the regular end."""


class Assumption(NamedTuple):
    """Assumption of the paper's step about a quantity that must be positive, as text."""

    failure: str  # clause that describes what happens if the quantity is negative
    quantity: str
    symbol: str
    unit: str


SHARED_ASSUMPTIONS = (
    Assumption("the wheel would stop and roll back", "the rate", "θ̇", "rad/s"),
    Assumption("a loaded leg would contract to its mass", "the length left", "L - a", "m"),
    Assumption(
        "the ground would have to pull on the fore foot", "the force on this foot", "λ2", "N"
    ),
)
"""Assumptions of every phase, in the order of `SHARED_FAILURE_OUTCOMES`."""

TRANSITION_ASSUMPTIONS = (
    Assumption(
        "just after the landing, the force on the rear foot would contradict the presence or "
        "absence of double support",
        "this force", "λ4⁺", "N",
    ),
    Assumption(
        "in the landing, the ground would have to pull on the rear foot",
        "the impulse on this foot", "λ_I4", "N s",
    ),
    Assumption(
        "Leg 2 would meet its stopper without extending", "the rate of Leg 2", "dL2/dt", "m/s"
    ),
)  # fmt: skip
"""Assumptions about landing, take-off and the collision of Leg 2 with its stopper."""


class PhaseMargins(NamedTuple):
    """Margins of the model's assumptions in a phase. Margins do not affect the motion.

    A margin is negative if its assumption is violated.
    """

    fore_foot_force: Elementwise  # N
    contraction: Elementwise  # L0 - L1, m
    friction: Elementwise  # minus the required coefficient at the fore foot
    locked_stopper_force: Vector  # stopper force on legs 3 to n, N
    rear_clearance: Elementwise | None = None  # height of foot 2 in single support, m
    rear_stopper_force: Elementwise | None = None  # stopper force on Leg 2 in SLS-II, N

    @classmethod
    def from_margin_values(cls, margin_values: Vector, n_legs: int) -> "PhaseMargins":
        """Return the margins, taken from the sequence of all margin values."""
        fore_foot_force, contraction, friction, *other_values = margin_values
        locked_stopper_force = tuple(other_values[: n_legs - 2])
        optional_margins = other_values[n_legs - 2 :]
        return cls(fore_foot_force, contraction, friction, locked_stopper_force, *optional_margins)


@dataclasses.dataclass(frozen=True)
class AbstractPhase(abc.ABC):
    """Phase of a step for the wheel `s`: its equations of motion, guards, margins and reset."""

    s: Symbols
    phase_constants: Vector  # constants of the phase: in double support the distance of the feet, m
    stop_at_lift_off: bool  # whether the phase ends when the ground would pull
    ground_ahead: Vector = ()
    """Sine and cosine of the tilt of `GroundAhead` and, if heights are given, its rise; empty on
    flat ground.
    """
    sides: Vector = ()
    """Sides of the kinks of the legs' forces on which the equations hold, see `on_sides`."""

    phase_name: ClassVar[str]
    phase_title: ClassVar[str]
    """Name of the phase in sentences."""
    start_title: ClassVar[str]
    """Instant at which the phase begins, in sentences."""
    n_dof: ClassVar[int]
    """Number of degrees of freedom of the phase."""
    specific_assumptions: ClassVar[tuple[Assumption, ...]]
    """Assumptions behind the guards from `compute_end_guard` and `compute_specific_guards`."""
    legs_with_force: ClassVar[tuple[int, ...]] = (1, 2)
    """Numbers of the legs whose forces affect the motion."""
    guard_outcomes: ClassVar[tuple[Outcome, ...]]
    """Outcomes of the guards from `compute_end_guard` and `compute_specific_guards`, in this
    order.
    """
    counts_contraction_at_start: ClassVar[bool] = False
    counts_specific_margins_at_start: ClassVar[tuple[bool, ...]] = ()
    """Whether Leg 1's contraction and the specific margins of this phase are evaluated at its
    start. A margin that is 0 at the start by construction is not evaluated there.
    """
    can_come_to_rest: ClassVar[bool] = False
    """Whether the phase contains a stable equilibrium of the wheel."""
    has_stiff_start: ClassVar[bool] = False
    """Whether the start of the phase excites the fast mode of the airborne leg. This mode decays at
    a rate near c/m.
    """

    @abc.abstractmethod
    def complete_wheel_motion(
        self, sin_theta: Elementwise, cos_theta: Elementwise, q: Vector, v: Vector
    ) -> Motion:
        """Return the full motion.

        It is computed from the phase's coordinates q, their rates v, sin(theta) and cos(theta).
        """

    @abc.abstractmethod
    def solve_acceleration(self, motion: Motion) -> Acceleration:
        """Return the accelerations of (theta, L1, L2) that solve the equations of motion."""

    @abc.abstractmethod
    def compute_dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        """Return the residual of the equations of motion for the accelerations
        `phase_acceleration`.

        The residual is linear in the accelerations. Its derivative costs far less than that of the
        accelerations that satisfy the equations.
        """

    @abc.abstractmethod
    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        """Return the accelerations for which the linear part of the residual is
        `right_hand_side`.
        """

    @abc.abstractmethod
    def complete_wheel_acceleration(
        self, motion: Motion, phase_acceleration: Vector
    ) -> Acceleration:
        """Return the accelerations of (theta, L1, L2), computed from those of the phase's
        coordinates.
        """

    @abc.abstractmethod
    def compute_end_guard(self, phase_instant: "PhaseInstant") -> Elementwise:
        """Return the guard whose root is the regular end of the phase, m or N.

        The guard is positive before the end.
        """

    def compute_specific_guards(self, phase_instant: "PhaseInstant") -> Vector:
        """Return the guards that only this phase has, except that of its regular end."""
        return ()

    def compute_specific_margins(self, phase_instant: "PhaseInstant") -> Vector:
        """Return the values of the margins that only this phase has."""
        return ()

    def reset_motion(self, motion: Motion) -> Motion:
        """Return the motion just after the regular end of the phase.

        The motion is unchanged at lift-off, because the rear foot is at rest, and at touchdown,
        which `transitions.resolve_landing` computes.
        """
        return motion

    def compute_landing_height(self, motion: Motion) -> Elementwise:
        """Return the height of the next foot above the place where it lands, m.

        In the frame of the reference line (see `GroundAhead`), the height has the same form as on
        flat ground.
        """
        rise: Vector = ()
        if self.ground_ahead:
            (tilt_sin, tilt_cos), rise = self.ground_ahead[:2], self.ground_ahead[2:]
            motion = motion._replace(
                sin_theta=motion.sin_theta * tilt_cos - motion.cos_theta * tilt_sin,
                cos_theta=motion.cos_theta * tilt_cos + motion.sin_theta * tilt_sin,
            )
        height = compute_landing_foot_height(self.s, motion)
        return height - rise[0] if rise else height

    @property
    def coordinate_units(self) -> Vector:
        """Return the wheel's own units of the phase's coordinates, and then those of their
        rates.
        """
        wheel_units = compute_wheel_units(self.s)
        length_unit, velocity_unit = wheel_units.length_unit, wheel_units.velocity_unit
        position_units = jnp.ones_like(length_unit), length_unit, length_unit
        rate_units = wheel_units.rate_unit, velocity_unit, velocity_unit
        return *position_units[: self.n_dof], *rate_units[: self.n_dof]

    def compute_motion(self, q: Vector, v: Vector) -> Motion:
        """Return the full motion for the phase's coordinates q and their rates v."""
        return self.complete_wheel_motion(*compute_sine_cosine(q[0]), q, v)

    def unpack_motion(self, phase_state: Array) -> Motion:
        """Return the full motion for a state with the phase's coordinates and then their rates."""
        state_components = tuple(phase_state)
        return self.compute_motion(state_components[: self.n_dof], state_components[self.n_dof :])

    def compute_rear_force(self, motion: Motion, acceleration: Acceleration) -> FootForce | None:
        """Return the force of the ground on the rear foot, N, or None if the foot is in the air."""
        return None

    def compute_guards(self, phase_instant: "PhaseInstant") -> Vector:
        """Return the values of all guards.

        The guards of this phase come first, those of `SHARED_FAILURE_OUTCOMES` last.
        """
        m = phase_instant.motion
        return (
            self.compute_end_guard(phase_instant),
            *self.compute_specific_guards(phase_instant),
            m.dtheta,
            jnp.minimum(m.L1, m.L2) - self.s.a,
            *((phase_instant.fore_force.normal,) if self.stop_at_lift_off else ()),
            *map(operator.mul, self.sides, self.compute_kinks(m) if self.sides else ()),
        )

    def compute_kinks(self, motion: Motion) -> Vector:
        """Return the values of the functions that change sign at the kinks of the legs' forces."""
        kinks = evaluate_leg_kinks(self.s, motion.L1, motion.dL1, 1)
        if 2 in self.legs_with_force:
            kinks += evaluate_leg_kinks(self.s, motion.L2, motion.dL2, 2)
        return kinks

    def on_sides(self, sides: Vector) -> "AbstractPhase":
        """Return the phase with forces that are smooth, as on the given sides of all kinks.

        Each kink has a guard, which triggers when the motion leaves its side.

        - `sides`: signs of the values of `compute_kinks`.
        """
        n_kinks, law = len(sides) // len(self.legs_with_force), self.s.leg_force
        law = law.law if isinstance(law, OneSidedLegForce) else law
        leg_force = OneSidedLegForce(law, sides[:n_kinks], sides[n_kinks:])
        return dataclasses.replace(self, s=self.s._replace(leg_force=leg_force), sides=sides)

    @classmethod
    def list_assumptions(cls) -> tuple[Assumption, ...]:
        """Return the assumptions about the guards, in the order of `compute_guards`."""
        return tuple(
            assumption._replace(failure=f"in {cls.phase_title}, {assumption.failure}")
            for assumption in cls.specific_assumptions + SHARED_ASSUMPTIONS
        )

    @property
    def all_guard_outcomes(self) -> tuple[Outcome, ...]:
        """Return the outcomes of all guards, in the order of `compute_guards`."""
        return (
            self.guard_outcomes
            + (SHARED_FAILURE_OUTCOMES if self.stop_at_lift_off else SHARED_FAILURE_OUTCOMES[:-1])
            + (Outcome.TOO_MANY_EVENTS,) * self.n_kinks
        )

    @property
    def n_kinks(self) -> int:
        """Return the number of kinks of the forces of all legs; 0 for the law of the paper."""
        return len(self.legs_with_force) * count_kinks(self.s.leg_force)

    def compute_margins(self, phase_instant: "PhaseInstant") -> Vector:
        """Return the values of all margins, in the order of `PhaseMargins`."""
        s, m = self.s, phase_instant.motion
        return (
            phase_instant.fore_force.normal,
            s.L0 - m.L1,
            -dynamics.compute_required_friction(phase_instant.fore_force),
            *dynamics.compute_stopper_force(s, m, phase_instant.acceleration, range(3, s.n + 1)),
            *self.compute_specific_margins(phase_instant),
        )

    @property
    def are_margins_counted_at_start(self) -> tuple[bool, ...]:
        """Return one flag per margin: whether the margin is evaluated at the start of the phase."""
        return (
            True,
            self.counts_contraction_at_start,
            *(True,) * (self.s.n - 1),  # friction, and the stoppers of legs 3 to n
            *self.counts_specific_margins_at_start,
        )

    def select_guard_outcome(
        self, guard_index: Int[Array, "..."], is_timed_out: Bool[Array, "..."]
    ) -> Array:
        """Return the `Outcome` of a phase that ended at the guard with index `guard_index`.

        The regular end has the outcome STEPPED. An index of -1 means that no guard ended the phase.
        """
        outcome = jnp.full_like(guard_index, Outcome.SOLVER_FAILED)
        for known_guard_index, guard_outcome in enumerate(self.all_guard_outcomes):
            outcome = jnp.where(guard_index == known_guard_index, jnp.int32(guard_outcome), outcome)
        return jnp.where(is_timed_out, jnp.int32(Outcome.NO_TOUCHDOWN_IN_TIME), outcome)

    def is_at_rest(self, q: Vector, v: Vector, atol: Elementwise) -> Bool[Array, "..."]:
        """Return whether the wheel is at rest in the state (q, v).

        - `atol`: absolute tolerance in the wheel's own units.
        """
        q, v = lax.stop_gradient((q, v))
        acceleration = self.solve_acceleration(self.compute_motion(q, v))[: self.n_dof]
        time_unit = compute_wheel_units(self.s).time_unit
        return are_coordinates_at_rest(
            v, acceleration, self.coordinate_units[self.n_dof :], time_unit, atol
        )

    @classmethod
    def select_phase_coordinates(cls, theta: Elementwise, motion: Motion) -> tuple[Vector, Vector]:
        """Return the phase's coordinates and their rates for a motion at the angle `theta`."""
        q, v = (theta, motion.L1, motion.L2), (motion.dtheta, motion.dL1, motion.dL2)
        return q[: cls.n_dof], v[: cls.n_dof]


class PhaseInstant:
    """State of a phase at one instant. Forces are computed on first access.

    - `phase_acceleration`: accelerations of the phase's coordinates. None means the accelerations
      that satisfy the equations of motion.
    """

    def __init__(
        self, phase: AbstractPhase, motion: Motion, phase_acceleration: Vector | None = None
    ) -> None:
        self.phase, self.motion, self._phase_acceleration = phase, motion, phase_acceleration

    @functools.cached_property
    def acceleration(self) -> Acceleration:
        """Return the accelerations of (theta, L1, L2)."""
        if self._phase_acceleration is None:
            return self.phase.solve_acceleration(self.motion)
        return self.phase.complete_wheel_acceleration(self.motion, self._phase_acceleration)

    @functools.cached_property
    def rear_force(self) -> FootForce | None:
        """Return the force of the ground on the rear foot, N, or None if the foot is in the air."""
        return self.phase.compute_rear_force(self.motion, self.acceleration)

    @functools.cached_property
    def fore_force(self) -> FootForce:
        """Return the force of the ground on the fore foot, N."""
        return dynamics.compute_fore_foot_force(
            self.phase.s, self.motion, self.acceleration, self.rear_force
        )


class DoubleSupport(AbstractPhase):
    """DLS, with the coordinate theta: the hub moves on a circle until the rear foot lifts off.

    Section 3.3.1 of the paper describes this phase.
    """

    phase_name, n_dof = "DLS", 1
    phase_title, start_title = "double support", "just after the landing"
    specific_assumptions = (
        Assumption(
            "the ground would have to pull on the rear foot", "the force on this foot", "λ4", "N"
        ),
        Assumption(
            "Leg 2 would reach its stopper before its foot lifts off",
            "the distance to the stopper", "L0 - L2", "m",
        ),
        Assumption(
            "the next foot would meet the ground before the rear foot lifts off",
            "the height of the next foot", "h", "m",
        ),
    )  # fmt: skip
    can_come_to_rest = True
    guard_outcomes = (
        Outcome.STEPPED, Outcome.STOPPER_IN_DOUBLE_SUPPORT, Outcome.TOUCHDOWN_BEFORE_STOPPER
    )  # fmt: skip

    def _compute_hub_circle(
        self, sin_theta: Elementwise, cos_theta: Elementwise
    ) -> DoubleSupportCircle:
        """Return the leg lengths and their derivatives on the hub's circle, for an angle of Leg
        1.
        """
        return compute_double_support_circle(self.s, self.phase_constants[0], sin_theta, cos_theta)

    def _compute_equation(self, motion: Motion) -> dynamics.SingleDofEquation:
        """Return the equation of motion for a hub on its circle."""
        return dynamics.compute_double_support_equation(self.s, self.phase_constants[0], motion)

    def complete_wheel_motion(
        self, sin_theta: Elementwise, cos_theta: Elementwise, q: Vector, v: Vector
    ) -> Motion:
        hub_circle, (dtheta,) = self._compute_hub_circle(sin_theta, cos_theta), v
        coordinate_rates = (dtheta, hub_circle.dL1_dtheta * dtheta, hub_circle.dL2_dtheta * dtheta)
        return Motion(sin_theta, cos_theta, hub_circle.L1, hub_circle.L2, *coordinate_rates)

    def solve_acceleration(self, motion: Motion) -> Acceleration:
        return dynamics.solve_double_support(self.s, self.phase_constants[0], motion)

    def complete_wheel_acceleration(
        self, motion: Motion, phase_acceleration: Vector
    ) -> Acceleration:
        return dynamics.complete_accelerations_on_hub_circle(
            self._compute_hub_circle(motion.sin_theta, motion.cos_theta),
            motion.dtheta,
            phase_acceleration[0],
        )

    def compute_dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        generalized_inertia, generalized_force = self._compute_equation(motion)
        return (generalized_inertia * phase_acceleration[0] - generalized_force,)

    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        return (right_hand_side[0] / self._compute_equation(motion).generalized_inertia,)

    def compute_rear_force(self, motion: Motion, acceleration: Acceleration) -> FootForce:
        return dynamics.compute_rear_foot_force(self.s, motion, acceleration)

    def compute_end_guard(self, phase_instant: PhaseInstant) -> Elementwise:
        assert phase_instant.rear_force is not None
        return phase_instant.rear_force.normal

    def compute_specific_guards(self, phase_instant: PhaseInstant) -> Vector:
        return self.s.L0 - phase_instant.motion.L2, self.compute_landing_height(
            phase_instant.motion
        )


class SingleSupport1(AbstractPhase):
    """SLS-I, with the coordinates (theta, L1, L2): Leg 2 moves freely until it meets its stopper.

    Section 3.3.2 of the paper describes this phase.
    """

    phase_name, n_dof = "SLS-I", 3
    phase_title = "single support before Leg 2 is at its stopper"
    start_title = "at take-off of the rear foot"
    specific_assumptions = (
        Assumption(
            "Leg 2 would reach its stopper twice", "the distance to the stopper", "L0 - L2", "m"
        ),
        Assumption(
            "the next foot would meet the ground too early",
            "the height of the next foot", "h", "m",
        ),
    )  # fmt: skip
    guard_outcomes = Outcome.STEPPED, Outcome.TOUCHDOWN_BEFORE_STOPPER
    counts_specific_margins_at_start = (False,)
    has_stiff_start = True

    def complete_wheel_motion(
        self, sin_theta: Elementwise, cos_theta: Elementwise, q: Vector, v: Vector
    ) -> Motion:
        return Motion(sin_theta, cos_theta, q[1], q[2], *v)

    def solve_acceleration(self, motion: Motion) -> Acceleration:
        return dynamics.solve_single_support_1(self.s, motion)

    def complete_wheel_acceleration(
        self, motion: Motion, phase_acceleration: Vector
    ) -> Acceleration:
        return Acceleration(*phase_acceleration)

    def compute_dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        M, *applied_forces = dynamics.compute_equation_terms(self.s, motion)
        inertial_forces = M.multiply_vector(Acceleration(*phase_acceleration))
        return tuple(n - f for n, f in zip(inertial_forces, applied_forces, strict=True))

    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        M = dynamics.compute_mass_matrix(self.s, motion.L1, motion.L2)
        return dynamics.solve_unconstrained_dynamics(
            self.s, motion.L1, dynamics.EquationTerms(M, *right_hand_side)
        )

    def compute_end_guard(self, phase_instant: PhaseInstant) -> Elementwise:
        return self.s.L0 - phase_instant.motion.L2

    def compute_specific_guards(self, phase_instant: PhaseInstant) -> Vector:
        return (self.compute_landing_height(phase_instant.motion),)

    def compute_specific_margins(self, phase_instant: PhaseInstant) -> Vector:
        return (compute_rear_foot_height(self.s, phase_instant.motion),)

    def reset_motion(self, motion: Motion) -> Motion:
        """Return the motion after the collision of Leg 2 with its stopper, with L2 = L0 exactly."""
        return transitions.lock_leg_2(self.s, motion._replace(L2=self.s.L0 + 0.0 * motion.L2))


class SingleSupport2(AbstractPhase):
    """SLS-II, with the coordinates (theta, L1): Leg 2 is on its stopper until touchdown.

    Section 3.3.3 of the paper describes this phase.
    """

    phase_name, n_dof = "SLS-II", 2
    phase_title = "single support with Leg 2 at its stopper"
    start_title = "at the collision of Leg 2 with its stopper"
    specific_assumptions = (
        Assumption(
            "the next foot would meet the ground twice", "the height of the next foot", "h", "m"
        ),
    )
    legs_with_force = (1,)
    guard_outcomes = (Outcome.STEPPED,)
    counts_contraction_at_start, counts_specific_margins_at_start = True, (True, True)

    def complete_wheel_motion(
        self, sin_theta: Elementwise, cos_theta: Elementwise, q: Vector, v: Vector
    ) -> Motion:
        zero_rate = jnp.zeros_like(q[1])
        return Motion(sin_theta, cos_theta, q[1], self.s.L0 + zero_rate, v[0], v[1], zero_rate)

    def solve_acceleration(self, motion: Motion) -> Acceleration:
        return dynamics.solve_single_support_2(self.s, motion)

    def complete_wheel_acceleration(
        self, motion: Motion, phase_acceleration: Vector
    ) -> Acceleration:
        return Acceleration(phase_acceleration[0], phase_acceleration[1], motion.dL2)

    def compute_dynamics_residual(self, motion: Motion, phase_acceleration: Vector) -> Vector:
        M, f1, f2, _ = dynamics.compute_equation_terms(self.s, motion)
        ddtheta, ddL1 = phase_acceleration
        return M.M11 * ddtheta - f1, M.M22 * ddL1 - f2  # M12 is zero at L2 = L0.

    def solve_dynamics(self, motion: Motion, right_hand_side: Vector) -> Vector:
        M = dynamics.compute_mass_matrix(self.s, motion.L1, motion.L2)
        return (1.0 / M.M11) * right_hand_side[0], (1.0 / M.M22) * right_hand_side[1]

    def compute_end_guard(self, phase_instant: PhaseInstant) -> Elementwise:
        return self.compute_landing_height(phase_instant.motion)

    def compute_specific_margins(self, phase_instant: PhaseInstant) -> Vector:
        s, m = self.s, phase_instant.motion
        rear_stopper_force = dynamics.compute_stopper_force(
            s, m, phase_instant.acceleration, range(2, 3)
        )
        return compute_rear_foot_height(s, m), *rear_stopper_force


PAPER_PHASES: tuple[type[AbstractPhase], ...] = (DoubleSupport, SingleSupport1, SingleSupport2)
"""Phases of the paper's step, in order."""


def make_paper_phases(
    s: Symbols, foot_distance: Elementwise, stop_at_lift_off: bool, ground_ahead: Vector = ()
) -> tuple[AbstractPhase, ...]:
    """Return the three phases of a step that begins with feet `foot_distance` m apart.

    - `ground_ahead`: see `AbstractPhase.ground_ahead`.
    """
    phase_constants = ((foot_distance,), (), ())
    return tuple(
        phase(s, constants_of_phase, stop_at_lift_off, ground_ahead)
        for phase, constants_of_phase in zip(PAPER_PHASES, phase_constants, strict=True)
    )

"""Premises of the paper's rung as smooth functions of a gait, for whoever searches along them.

The margins of a step are minima over time. Two of them are no use to a search near their border:
foot 2 always starts single support I at height zero, so its clearance is its lowest *later* height,
which vanishes with the cube of the distance to the border on one side and jumps on the other. What
decides is whether the foot leaves the ground upwards: `takeoff_acceleration`, smooth throughout.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array

from vrw_jax.cycles.cycle import LimitCycle
from vrw_jax.numerics import walk_through
from vrw_jax.results import MEASURES, Measure
from vrw_jax.wheel import Motion, WheelParams, dynamics, rear_foot_height, wheel_of

TAKE_OFF = Measure(
    "takeoff_acceleration",
    "m/s^2",
    "z̈2⁺",
    "normal acceleration of foot 2 at take-off",
    "Just after the rear foot is let go, at rest on the ground; negative where it scuffs at once.",
)


def takeoff_acceleration(cycle: LimitCycle) -> Array:
    """Normal acceleration of foot 2 at the start of SLS-I of the first step, m/s^2.

    The foot is at rest on the ground there, so its sign says whether it rises or scuffs; the jump
    from zero is the tangential force that the ground no longer gives.
    """
    problem, solution = cycle.problem, cycle.located.solution
    s = wheel_of(cycle.parameters, problem.n_legs).symbols()
    _, passages = walk_through(
        problem.sequence,
        problem.meshes,
        problem.constants_of(*cycle.parameters),
        tuple(solution.section),
        solution.durations[0],
        tuple(accelerations[0] for accelerations in solution.accelerations),
    )
    start = passages[1].start
    q, v = jnp.stack(start.q), jnp.stack(start.v)
    a = jnp.stack(dynamics.single_support_1_acceleration(s, Motion.of(*q, *v)))

    def height(time: Array) -> Array:
        return rear_foot_height(s, Motion.of(*(q + time * (v + 0.5 * time * a)), *v))

    return jax.jacfwd(jax.jacfwd(height))(jnp.zeros_like(q[0]))


PREMISES: tuple[str, ...] = (
    "fore_foot_force",
    "takeoff_acceleration",
    "clearance_sls1",
    "clearance_sls2",
    "locked_stopper_force",
    "rear_stopper_force",
    "contraction",
    "friction_fore",
    "lambda_I4",
    "lambda_2_plus",
    "lambda_4_plus",
)
"""Premises on forces, clearances and indicators that gaits of this rung can keep."""

SHARE = 1e-3
"""Default margin of a premise, as a share of the wheel's weight, leg length or gravity."""


def default_margins(params: WheelParams) -> Mapping[str, float]:
    """Least values of `PREMISES`: a thousandth of what their unit measures on this wheel.

    Not zero: at lambda_4_plus = 0, for one, the gait itself ends, and a search needs room.
    """
    mass = float(params.hub_mass + params.n_legs * params.leg_mass)
    length, gravity = float(params.locked_length), float(params.gravity)
    natural = {
        "N": mass * gravity,
        "m": length,
        "m/s^2": gravity,
        "N s": mass * (gravity * length) ** 0.5,
        "1": 1.0,
    }
    return {name: SHARE * natural[measure(name).unit] for name in PREMISES}


def measure(name: str) -> Measure:
    """Unit, symbol and long name of anything that a constraint may name."""
    return TAKE_OFF if name == TAKE_OFF.name else MEASURES[name]

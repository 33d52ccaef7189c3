"""The full section state of the unilateral rung as one vector, and the paper's inside it."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vrw_jax.models.base import replaced_where_bad, usable
from vrw_jax.models.paper_step import PAPER_START
from vrw_jax.models.unilateral.contacts import OFF, STICK
from vrw_jax.models.unilateral.mechanics import WheelMotion, directions
from vrw_jax.models.unilateral.motion import Stance
from vrw_jax.numerics import Elementwise
from vrw_jax.wheel import Symbols, WheelParams, length_at_touchdown

FullState = Float[Array, "n_full ..."]
"""(theta-, dtheta-, vx-, vz-, L_1 ... L_n, dL_1 ... dL_n, code_1 ... code_n) just before the foot
ahead of all others lands, in the labels of the step that ends: rad, rad/s, hub m/s, m, m/s.

A leg's code is its foot's mode (0 in the air, 1 at rest, 2 sliding downhill, 3 uphill), plus 4 on
its stopper. The hub's height follows from the landing foot's."""

LOCKED = 4
"""What a leg's code gains on its stopper."""


def section_size(n: int) -> int:
    return 4 + 3 * n


def embedded(s: Symbols, x: Float[Array, "3 ..."]) -> FullState:
    """The paper's section state: Leg 1 planted, all other legs on their stoppers."""
    theta, dtheta, dL1 = x
    sin, cos, L1 = jnp.sin(theta), jnp.cos(theta), length_at_touchdown(s, theta)
    first = (jnp.arange(s.n) == 0).reshape(-1, *(1,) * theta.ndim)
    vx, vz = dL1 * sin + L1 * dtheta * cos, dL1 * cos - L1 * dtheta * sin
    return jnp.concatenate(
        [
            jnp.stack([theta, dtheta, vx, vz]),
            jnp.where(first, L1, s.L0),
            jnp.where(first, dL1, 0.0),
            jnp.where(first, float(STICK), LOCKED + OFF + 0.0 * theta),
        ]
    )


def made_sound(
    params: WheelParams, friction: Elementwise, x: FullState, even: bool = True
) -> tuple[Bool[Array, "..."], WheelParams, Elementwise, FullState]:
    """Whether a step may begin there, and the same, or what one always may begin with.

    Where the ground is not `even` feet may be below the line that the next foothold continues.
    """
    safe = embedded(WheelParams(n_legs=params.n_legs).symbols(), jnp.asarray(PAPER_START, x.dtype))
    safe_x = safe.reshape(-1, *(1,) * (x.ndim - 1))
    good = usable(params, x) & (friction >= 0.0)
    good = good & _possible(params.symbols(), x) if even else good
    params, x = replaced_where_bad(good, params, x, safe_x)
    return good, params, jnp.where(good, friction, 1.0), x


NEAR = 1e-3
"""Share of a leg's length by which a start may be wrong: more than integration and Newton's method
leave, and little enough for the first events to put it right."""


def _posture(s: Symbols, x: FullState) -> tuple[Elementwise, tuple, Array, Array, Array, Array]:
    """Angle, the hub's place and lengths in the labels of the step that begins, the legs' rates,
    modes and stoppers: loaded feet are on the slope, and the landing foot is the origin."""
    n = s.n
    theta = x[0] - s.alpha
    of_legs = (x[4 + i * n : 4 + (i + 1) * n] for i in range(3))
    L, dL, code = (jnp.concatenate([own[-1:], own[:-1]]) for own in of_legs)
    code = jnp.floor(code + 0.5).astype(jnp.int32)
    contact, locked = code & (LOCKED - 1), code >= LOCKED
    L = jnp.where(locked, s.L0, L)
    legs = directions(s, theta)
    hub = L[0] * legs.sin[0], L[0] * legs.cos[0]
    L = jnp.where((contact != OFF) & ~locked, hub[1] / legs.cos, L)
    return theta, hub, L, dL, contact, locked


def _possible(s: Symbols, x: FullState) -> Bool[Array, "..."]:
    """Whether no foot is below the ground, loaded ones are on it, and no leg is too long."""
    theta, (_, z), L, _, contact, _ = _posture(s, x)
    height, near = z - L * directions(s, theta).cos, NEAR * s.L0
    apart = (contact == OFF) | (height <= near)
    return jnp.all((height >= -near) & apart & (near >= L - s.L0), axis=0)


def opened(s: Symbols, x: FullState) -> tuple[WheelMotion, Stance]:
    """Motion and stance just before the landing, in the labels of the step that begins.

    The landing foot is the origin; loaded feet are put on the slope, so that every vector near a
    section state is one. The landing brings sticking ones to rest.
    """
    theta, (hub_x, hub_z), L, dL, contact, locked = _posture(s, x)
    dtheta, vx, vz = x[1], x[2], x[3]
    motion = WheelMotion(hub_x, hub_z, theta, vx, vz, dtheta, L, dL)
    none = locked & False
    return motion, Stance(contact, locked, none, none, none)


def closed(motion: WheelMotion, stance: Stance, tilt: Elementwise | None = None) -> FullState:
    """The section state of a motion just before the next landing, in the frame of the slope there:
    of the ground that lies ahead, where that is steeper by `tilt`."""
    code = stance.contact + LOCKED * stance.locked
    theta, vx, vz = motion.theta, motion.vx, motion.vz
    if tilt is not None:
        sin, cos = jnp.sin(tilt), jnp.cos(tilt)
        theta, vx, vz = theta - tilt, vx * cos - vz * sin, vz * cos + vx * sin
    return jnp.concatenate(
        [
            jnp.stack([theta, motion.dtheta, vx, vz]),
            motion.L,
            motion.dL,
            code.astype(motion.L.dtype),
        ]
    )

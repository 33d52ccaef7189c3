"""Full section state of the unilateral model as one vector, and the embedding of the paper's
state.
"""

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
"""(theta-, dtheta-, vx-, vz-, L_1 ... L_n, dL_1 ... dL_n, code_1 ... code_n) just before the
foremost foot lands, in the leg labels of the ending step: rad, rad/s, hub m/s, m, m/s.

A leg's code is its foot's mode (0 in the air, 1 at rest, 2 sliding downhill, 3 uphill), plus 4 on
its stopper. The hub's height follows from the landing foot's.
"""

LOCKED = 4
"""Offset of a leg's code on its stopper."""


def section_size(n: int) -> int:
    """Return the length of a full section state of a wheel with `n` legs."""
    return 4 + 3 * n


def embedded(s: Symbols, x: Float[Array, "3 ..."]) -> FullState:
    """Return the full section state of the paper's one: Leg 1 planted, all other legs on their
    stoppers.
    """
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
    """Return whether a step may begin at this input, and the input or, if not, a valid substitute.

    If the ground is uneven, feet may be below the extended line of the next foothold's slope.
    """
    safe = embedded(WheelParams(n_legs=params.n_legs).symbols(), jnp.asarray(PAPER_START, x.dtype))
    safe_x = safe.reshape(-1, *(1,) * (x.ndim - 1))
    good = usable(params, x) & (friction >= 0.0)
    good = good & _possible(params.symbols(), x) if even else good
    params, x = replaced_where_bad(good, params, x, safe_x)
    return good, params, jnp.where(good, friction, 1.0), x


NEAR = 1e-3
"""Largest accepted error of a start, as a fraction of the leg length: larger than the errors of
integration and Newton's method, and small enough for the first events to correct it."""


def _posture(s: Symbols, x: FullState) -> tuple[Elementwise, tuple, Array, Array, Array, Array]:
    """Return angle, hub position, lengths, length rates, contact modes and stoppers of a section
    state.

    Leg labels are those of the starting step. Loaded feet are on the slope, and the landing foot is
    the origin.
    """
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
    """Return whether no foot is below the ground, loaded feet are on it, and no leg is too long."""
    theta, (_, z), L, _, contact, _ = _posture(s, x)
    height, near = z - L * directions(s, theta).cos, NEAR * s.L0
    apart = (contact == OFF) | (height <= near)
    return jnp.all((height >= -near) & apart & (near >= L - s.L0), axis=0)


def opened(s: Symbols, x: FullState) -> tuple[WheelMotion, Stance]:
    """Return motion and contact state just before the landing, in the leg labels of the starting
    step.

    The landing foot is the origin. Loaded feet are placed on the slope, so that every vector near a
    section state is one. The landing brings sticking feet to rest.
    """
    theta, (hub_x, hub_z), L, dL, contact, locked = _posture(s, x)
    dtheta, vx, vz = x[1], x[2], x[3]
    motion = WheelMotion(hub_x, hub_z, theta, vx, vz, dtheta, L, dL)
    none = locked & False
    return motion, Stance(contact, locked, none, none, none)


def closed(motion: WheelMotion, stance: Stance, tilt: Elementwise | None = None) -> FullState:
    """Return the section state of a motion just before the next landing, in the slope's frame
    there.

    - `tilt`: by which the ground ahead is steeper, if it is.
    """
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

"""Walkers as users write them, for tests of several packages."""

import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, HybridSystem, Mode


def swing(y, p):
    theta, dtheta, phi, _ = y
    pull = jnp.sin(theta - p["slope"])
    return jnp.stack(
        [
            dtheta,
            pull,
            y[3],
            pull + dtheta**2 * jnp.sin(phi) - jnp.cos(theta - p["slope"]) * jnp.sin(phi),
        ]
    )


def strike(y, p):
    c = jnp.cos(2.0 * y[0])
    return jnp.stack([-y[0], c * y[1], -2.0 * y[0], c * (1.0 - c) * y[1]])


SIMPLEST_WALKER = HybridSystem(
    modes={
        "swing": Mode(
            swing,
            # The foot of a straight leg scuffs at mid-stance, which the model ignores. In the
            # unstable gait it rises through the ground at an angle of -0.0499.
            {
                "heel_strike": Guard(
                    lambda y, p: 2.0 * y[0] - y[2], strike, armed=lambda y, p: -0.1 - y[0]
                )
            },
        )
    },
    section="heel_strike",
    state=("theta", "dtheta", "phi", "dphi"),
    project=lambda y, p: y[:2],
    embed=lambda x, p: jnp.stack([x[0], x[1], 2.0 * x[0], (1.0 - jnp.cos(2.0 * x[0])) * x[1]]),
)
"""Simplest walking model of Garcia, Chatterjee, Ruina and Coleman (1998)."""

GRAVITY = 9.81
SPOKE_HALF_ANGLE = np.pi / 8
RIMLESS_WHEEL = HybridSystem(
    modes={
        "stance": Mode(
            lambda y, p: jnp.stack([y[1], GRAVITY * jnp.sin(y[0])]),
            {
                "touchdown": Guard(
                    lambda y, p: p["slope"] + SPOKE_HALF_ANGLE - y[0],
                    lambda y, p: jnp.stack(
                        [p["slope"] - SPOKE_HALF_ANGLE, y[1] * np.cos(2.0 * SPOKE_HALF_ANGLE)]
                    ),
                )
            },
        )
    },
    section="touchdown",
    state={"angle": "rad", "rate": "rad/s"},
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([p["slope"] - SPOKE_HALF_ANGLE, x[0]]),
    starts=lambda p: jnp.array([1.5]),
)
"""Point mass on rigid spokes of 1 m, whose speed follows from its energy."""

BALL_PARAMS = {"ball": {"restitution": 0.5}, "kick": 1.0}


@vrw.measure("height", unit="m", meaning="height of the flight")
def flight_height(step, params):
    return GRAVITY / 8.0 * step.duration**2


class JuggledBall(vrw.AbstractWalker):
    coordinates = {"velocity": "m/s"}  # noqa: RUF012
    measures = (flight_height,)

    def advance(self, params, x, options):
        v = params["ball"]["restitution"] * x + params["kick"]
        return vrw.AdvanceResult(v, 2.0 * v / GRAVITY, jnp.where(v[0] > 0.0, 0, 3))

    def starts(self, params):
        return jnp.array([1.0])


def bounce(y, p):
    return jnp.stack([0.0 * y[0], -p["ball"]["restitution"] * y[1] + p["kick"]])


BALL_SYSTEM = HybridSystem(
    modes={
        "flight": Mode(
            lambda y, p: jnp.stack([y[1], -GRAVITY + 0.0 * y[1]]),
            {"bounce": Guard(lambda y, p: y[0], bounce)},
        )
    },
    section="bounce",
    state={"height": "m", "velocity": "m/s"},
    coordinates={"velocity": "m/s"},
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([0.0 * x[0], x[0]]),
    starts=lambda p: jnp.array([1.0]),
    measures=(flight_height,),
)
"""Ball that a racket kicks: v' = e v + k, so that a gait has v = k / (1 - e)."""


def return_by_logistic_map(y, p):
    speed = -y[1]
    return jnp.stack([0.0 * y[0], p["a"] * speed * (1.0 - speed)])


LOGISTIC_BALL = HybridSystem(
    modes={
        "flight": Mode(
            BALL_SYSTEM.modes["flight"].field,
            {"bounce": Guard(lambda y, p: y[0], return_by_logistic_map)},
        )
    },
    section="bounce",
    state={"height": "m", "velocity": "m/s"},
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([jnp.where(x[0] > 0.0, 0.0, -1.0), x[0]]),  # or below the ground
)
"""Ball with the return map v' = a v (1 - v), whose gait of two steps is stable for a = 3.25."""
LOGISTIC_A = 3.25
LOGISTIC_CYCLE = (LOGISTIC_A + 1.0 + np.array([-1.0, 1.0]) * np.sqrt(
    (LOGISTIC_A - 3.0) * (LOGISTIC_A + 1.0))) / (2.0 * LOGISTIC_A)  # fmt: skip


class Henon(vrw.AbstractWalker):
    """x -> 1 - a x^2 + y, y -> b x."""

    def advance(self, params, x, options):
        x, y = x
        end = jnp.stack([1.0 - params["a"] * x**2 + y, params["b"] * x])
        return vrw.AdvanceResult(end, jnp.ones(1))


class SlowReturn(vrw.AbstractWalker):
    """Walker that returns to c at a bounded rate, so that Newton's method diverges from afar."""

    coordinates = {"offset": "m"}  # noqa: RUF012

    def advance(self, params, x, options):
        return vrw.AdvanceResult(x - 0.9 * jnp.arctan(x - params["c"]), jnp.ones(1))

    def starts(self, params):
        return jnp.array([20.0])

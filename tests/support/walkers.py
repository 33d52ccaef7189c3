"""Walkers as users write them, for tests of several packages."""

import jax.numpy as jnp

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
            # The foot of a straight leg scuffs at mid-stance, which the model ignores.
            {
                "heel_strike": Guard(
                    lambda y, p: 2.0 * y[0] - y[2], strike, armed=lambda y, p: -0.05 - y[0]
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

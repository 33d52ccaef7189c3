"""A leg that hops on the spot, as a skeleton of a walker: replace its physics by your own.

The mass m bounces on a leg with a spring and a damper. While the leg extends, a motor adds a
constant thrust. The comments mark what a walker needs.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from vrw_jax.hybrid import Guard, Mode


class Params(eqx.Module):
    """1. Parameters with their units. Another value compiles nothing anew."""

    mass: float = vrw.parameter(80.0, unit="kg", domain=(1.0, 1e3))
    stiffness: float = vrw.parameter(2e4, unit="N/m", domain=(0.0, 1e6))
    damping: float = vrw.parameter(300.0, unit="N s/m", domain=(0.0, 1e5))
    length: float = vrw.parameter(1.0, unit="m", domain=(0.1, 10.0))
    thrust: float = vrw.parameter(400.0, unit="N", domain=(0.0, 1e5))
    gravity: float = vrw.parameter(9.81, unit="m/s^2", domain=(0.1, 100.0))


# 2. Modes: the time derivative of the state y = (height, velocity), for one element.


def flight(y, p):
    return jnp.stack([y[1], -p.gravity + 0.0 * y[1]])


def compression(y, p):
    leg_force = p.stiffness * (p.length - y[0]) - p.damping * y[1]
    return jnp.stack([y[1], -p.gravity + leg_force / p.mass])


def extension(y, p):
    return compression(y, p) + jnp.stack([0.0 * y[0], p.thrust / p.mass + 0.0 * y[1]])


# 3. Guards end a mode when they fall to zero. `reset` (none here) changes the state at the event.

walker = vrw.HybridSystem(
    modes={
        "flight": Mode(
            flight, {"touchdown": Guard(lambda y, p: y[0] - p.length, target_mode="compression")}
        ),
        "compression": Mode(
            compression, {"lowest point": Guard(lambda y, p: -y[1], target_mode="extension")}
        ),
        "extension": Mode(
            extension, {"take-off": Guard(lambda y, p: p.length - y[0], target_mode="flight")}
        ),
    },
    # 4. The section: the event that ends a step, and the coordinates there.
    section="touchdown",
    state=("height", "velocity"),
    project=lambda y, p: y[1:],
    embed=lambda x, p: jnp.stack([p.length + 0.0 * x[0], x[0]]),
)
guess = [-1.0]  # section coordinates near a gait: the velocity at touchdown, m/s


# 5. Measures of a gait, as functions of its section coordinates and of its last step.


def measure_height(params, gait):
    """Return the height of the jump, m."""
    return gait.section_state[0] ** 2 / (2.0 * params.gravity)


def measure_contact_share(params, gait):
    """Return the share of the period in which the foot is on the ground."""
    return 1.0 - gait.last_step.mode_durations[0] / gait.period


def find_gait(params):
    return vrw.limit_cycle(params, model=walker, guess=guess)


def draw(path):
    """6. A figure: height and multiplier of the gaits along the thrust."""
    import matplotlib.pyplot as plt

    thrusts = np.linspace(300.0, 800.0, 11)
    gaits = [find_gait(Params(thrust=thrust)) for thrust in thrusts]
    heights = [measure_height(Params(thrust=t), g) for t, g in zip(thrusts, gaits, strict=True)]
    multipliers = [gait.multipliers[0].real for gait in gaits]
    figure, panels = plt.subplots(2, sharex=True, figsize=(4.0, 4.0), layout="constrained")
    panels[0].plot(thrusts, heights)
    panels[0].set_ylabel("height of the jump [m]")
    panels[1].plot(thrusts, multipliers)
    panels[1].set(xlabel="thrust [N]", ylabel="multiplier")
    figure.savefig(path)
    plt.close(figure)


if __name__ == "__main__":
    vrw.start_jax()
    gait = find_gait(Params())
    print(gait)
    print(f"height {measure_height(Params(), gait):.4f} m")
    slope = jax.grad(lambda p: measure_height(p, find_gait(p)))(Params()).thrust
    print(f"height by thrust {slope:.6f} m/N")
    draw("my_walker.png")

"""What really happens where the paper stops: scuffing, bouncing, the lost gait, early touchdown."""

import csv
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import lax

import vrw_jax as vrw
from vrw_jax.models.unilateral_mechanics import directions, foot_heights
from vrw_jax.models.unilateral_motion import unpack

NO_SLIP, REAL = math.inf, 0.7
GAIT_RANGE = (8.0, 215.0)  # dampings at which the paper's gait gives the start
FAST = (0.1, 2.0, -0.1)
SCENES = [  # label, friction, damping, start (None: from the paper's gait at the nearest damping)
    *((f"bouncing, c = {c:g}", NO_SLIP, c, None) for c in (1.0, 2.0, 3.0, 4.0)),
    *((f"scuffing, c = {c:g}", NO_SLIP, c, None) for c in (50.0, 100.0)),
    *((f"lost gait, c = {c:g}", NO_SLIP, c, None) for c in (220.0, 225.0, 250.0, 280.0, 300.0)),
    ("early touchdown, c = 200", NO_SLIP, 200.0, FAST),
    *((f"real ground, c = {c:g}", REAL, c, None) for c in (4.0, 50.0, 100.0, 200.0, 250.0, 300.0)),
]
SHOWN = ("bouncing, c = 4", "scuffing, c = 50", "lost gait, c = 225", "real ground, c = 250")
N_STEPS, N_SAMPLES = 60, 40
MODES = ("air", "rest", "down", "up")
TARGET = Path(__file__).parents[1] / "docs" / "figures"


def start_of(damping: float, start: tuple | None) -> jax.Array:
    """The scene's own start, or the paper's gait at the nearest damping that has one."""
    if start is not None:
        return jnp.asarray(start)
    nearest = float(np.clip(damping, *GAIT_RANGE))
    return vrw.limit_cycle(vrw.WheelParams(damping=nearest)).section_state


@jax.jit
@jax.vmap
def walked(friction: jax.Array, damping: jax.Array, start: jax.Array) -> tuple:
    """The start of the last good step, that step, how many steps, and their periods."""
    params, wheel = vrw.WheelParams(damping=damping), vrw.UnilateralWheel(friction=friction)
    options = vrw.Options(rtol=1e-9, atol=1e-9)

    def one(carry: tuple, _: None) -> tuple:
        x, outcome, last, kept = carry
        result = wheel.step(params, jnp.where(outcome == 0, x, jnp.nan), options)
        good = (outcome == 0) & (result.outcome == 0)
        last, kept = jax.tree.map(lambda a, b: jnp.where(good, a, b), (x, result), (last, kept))
        outcome = jnp.where(outcome == 0, result.outcome, outcome)
        return (result.section_state, outcome, last, kept), (result.period, outcome)

    x = wheel.full_section(params, start)
    first = wheel.step(params, x, options)
    carry, (periods, outcomes) = lax.scan(one, (x, jnp.int32(0), x, first), None, length=N_STEPS)
    return carry[1], carry[2], carry[3], periods, jnp.sum(outcomes == 0)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    labels, friction, damping, starts = zip(*SCENES, strict=True)
    x = jnp.stack([start_of(c, s) for c, s in zip(damping, starts, strict=True)])
    outcome, last, step, periods, count = walked(jnp.asarray(friction), jnp.asarray(damping), x)
    TARGET.mkdir(parents=True, exist_ok=True)
    with (TARGET / "unilateral_scenes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        header = ("scene", "friction", "damping", "steps", "outcome", "period_s", "period_spread_s")
        pairs = [f"share_{a}_{b}" for a in MODES for b in MODES]
        more = ("dls_fraction", "flight_fraction", "speed_m_s", "slip_m", "events", "solutions")
        writer.writerow([*header, *more, *pairs])
        for i, label in enumerate(labels):
            n, period = int(count[i]), float(step.period[i])
            spread = float(np.ptp(np.asarray(periods[i, max(n - 5, 0) : n]))) if n else 0.0
            name = vrw.Outcome(int(outcome[i])).name
            numbers = [
                step.dls_fraction[i],
                step.durations[i, 2] / max(period, 1e-9),
                step.speed[i],
                step.slip[i],
                int(step.events[i]),
                int(step.most_solutions[i]),
                *(np.asarray(step.mode_durations[i]).ravel() / max(period, 1e-9)),
            ]
            row = [label, friction[i], damping[i], n, name, f"{period:.6f}", f"{spread:.1e}"]
            writer.writerow([*row, *(f"{float(v):.5g}" for v in numbers)])
    draw([labels.index(name) for name in SHOWN], labels, friction, damping, last)


def draw(chosen: list[int], labels: tuple, friction: tuple, damping: tuple, x: jax.Array) -> None:
    """Ground forces and foot heights of the last step of some scenes."""
    figure, axes = plt.subplots(
        2, len(chosen), figsize=(3.3 * len(chosen), 5.0), sharey="row", layout="constrained"
    )
    for column, i in enumerate(chosen):
        params = vrw.WheelParams(damping=damping[i])
        wheel = vrw.UnilateralWheel(friction=friction[i])
        trace = wheel.trace(params, x[i], vrw.Options(), N_SAMPLES)
        s, top, low = params.symbols(), axes[0, column], axes[1, column]
        heights = jax.vmap(
            jax.vmap(lambda y, s=s: foot_heights(unpack(y)[0], directions(s, unpack(y)[0].theta)))
        )(trace.state)
        happened = np.flatnonzero(np.asarray(trace.duration) > 0.0)
        time = np.concatenate([np.asarray(trace.time[k]) for k in happened])
        for leg, (name, color) in enumerate((("fore foot", "C0"), ("rear foot", "C1"))):
            joined = lambda values, leg=leg, happened=happened: np.concatenate(
                [np.asarray(values[k])[:, leg] for k in happened]
            )
            top.plot(time, joined(trace.normal), color, label=f"{name}, normal")
            top.plot(time, joined(trace.tangential), color + "--", label=f"{name}, tangential")
            low.plot(time, 1e3 * joined(heights), color, label=name)
        top.set_title(labels[i], fontsize=10)
        low.set(xlabel="time since landing / s", ylim=(-5.0, 60.0))
    axes[0, 0].set_ylabel("ground force / N")
    axes[1, 0].set_ylabel("foot height / mm")
    axes[0, 0].legend(fontsize=7)
    axes[1, 0].legend(fontsize=7)
    for ending in ("png", "svg"):
        figure.savefig(TARGET / f"unilateral_scenes.{ending}", dpi=110)


if __name__ == "__main__":
    main()

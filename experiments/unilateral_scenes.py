"""What really happens where the paper stops: scuffing, bouncing, the lost gait, early touchdown.

    python experiments/unilateral_scenes.py

Each scene is walked from the paper's gait at the nearest damping that has one; below the least of
these the damping is led down in small steps. Drawn: ground forces and foot heights of the last step
with the paper's step from the same start beside them, and the time that each scene spends in each
pair of contact modes.
"""

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
LED_BY, N_LED = 0.25, 30  # N s/m and steps of each stage on the way down
LEAST_SHARE = 0.5  # per cent: less in every scene is not drawn
MODES = ("air", "rest", "down", "up")
TARGET = Path(__file__).parents[1] / "docs" / "figures"


def start_of(friction: float, damping: float, start: tuple | None) -> jax.Array:
    """The scene's own start, or from the paper's gait at the nearest damping that has one."""
    wheel, params = vrw.UnilateralWheel(friction=friction), vrw.WheelParams()
    if start is not None:
        return wheel.full_section(params, jnp.asarray(start))
    nearest = float(np.clip(damping, *GAIT_RANGE))
    x = vrw.limit_cycle(vrw.WheelParams(damping=nearest)).section_state
    x = wheel.full_section(params, x)
    for led in np.arange(nearest - LED_BY, damping, -LED_BY):
        walk = vrw.walk(vrw.WheelParams(damping=led), x, N_LED, model=wheel)
        if int(walk.outcome) != vrw.Outcome.STEPPED:
            print(f"led from c = {nearest:g} to {damping:g}, lost at {led:g}: {walk.outcome}")
            break
        x = walk.steps.section_state[-1]
    return x


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

    first = wheel.step(params, start, options)
    begin = (start, jnp.int32(0), start, first)
    carry, (periods, outcomes) = lax.scan(one, begin, None, length=N_STEPS)
    return carry[1], carry[2], carry[3], periods, jnp.sum(outcomes == 0)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    labels, friction, damping, starts = zip(*SCENES, strict=True)
    x = jnp.stack([start_of(*scene) for scene in zip(friction, damping, starts, strict=True)])
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
    shares = np.asarray(step.mode_durations / np.maximum(step.period, 1e-9)[:, None, None])
    draw_modes(labels, shares)


def save(figure: plt.Figure, name: str) -> None:
    for ending in ("png", "svg"):
        figure.savefig(TARGET / f"{name}.{ending}", dpi=110)


def draw(chosen: list[int], labels: tuple, friction: tuple, damping: tuple, x: jax.Array) -> None:
    """Ground forces and foot heights of the last step of some scenes, and the paper's step."""
    figure, axes = plt.subplots(
        2, len(chosen), figsize=(3.3 * len(chosen), 5.0), sharey="row", layout="constrained"
    )
    paper = vrw.ViscoelasticWheel(stop_at_lift_off=False)
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
        on_paper = jnp.stack([x[i, 0], x[i, 1], x[i, 4 + params.n_legs]])
        formal = vrw.simulate(params, on_paper, 1, model=paper, n_samples=N_SAMPLES)
        for leg, (name, color) in enumerate((("fore foot", "C0"), ("rear foot", "C1"))):
            joined = lambda values, leg=leg, happened=happened: np.concatenate(
                [np.asarray(values[k])[:, leg] for k in happened]
            )
            top.plot(time, joined(trace.normal), color, label=f"{name}, normal")
            top.plot(time, joined(trace.tangential), color + "--", label=f"{name}, tangential")
            low.plot(time, 1e3 * joined(heights), color, label=name)
            grey = {"color": "0.6", "lw": 1.0, "zorder": 0, "ls": "-" if leg == 0 else "-."}
            shown = f"{name}, paper's model"
            top.plot(formal.time, formal[f"lambda_{2 * leg + 2}"], **grey, label=shown)
            if leg == 1:
                low.plot(formal.time, 1e3 * formal.foot_2_z, **grey, label=shown)
        top.set_title(labels[i], fontsize=10)
        low.set(xlabel="time since landing / s", ylim=(-25.0, 60.0))
    axes[0, 0].set_ylabel("ground force / N")
    axes[1, 0].set_ylabel("foot height / mm")
    axes[0, 0].legend(fontsize=6)
    axes[1, 0].legend(fontsize=6)
    save(figure, "unilateral_scenes")


def draw_modes(labels: tuple, shares: np.ndarray) -> None:
    """Time in each pair of contact modes, fore foot first, scene by scene."""
    figure, axis = plt.subplots(figsize=(9, 5.2), layout="constrained")
    words = {"air": "air", "rest": "rest", "down": "slides down", "up": "slides up"}
    colours, left, count = plt.get_cmap("tab20"), np.zeros(len(labels)), 0
    for a, first in enumerate(MODES):
        for b, second in enumerate(MODES):
            share = 100.0 * shares[:, a, b]
            if share.max() < LEAST_SHARE:
                continue
            name = f"{words[first]}, {words[second]}"
            axis.barh(labels, share, left=left, color=colours(count), label=name)
            left, count = left + share, count + 1
    axis.invert_yaxis()
    axis.set(xlabel="share of the step / %", xlim=(0.0, 100.0), title="fore foot, rear foot")
    axis.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    save(figure, "unilateral_modes")


if __name__ == "__main__":
    main()

"""Double support on real ground: gaits over friction 0.3 to 3, damping 20 to 400, two starts.

python -m experiments.ground.friction_map [--redraw]
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Patch

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, read, write
from vrw_jax import figures as plots

FRICTION = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0)
DAMPING = tuple(float(c) for c in range(20, 401, 20))
STARTS = {"slow": (0.1, 1.6, -0.1), "fast": (0.12, 2.4, -0.2)}
N_STEPS, N_LAST = 150, 10
LEAST_SLIP = 1e-3  # m: less is drawn alike
TOWARDS = {"solver": "Tsit5", "rtol": 1e-8, "atol": 1e-8}  # a gait; its last step is exact
FIELDS = ("period", "dls_fraction", "flight", "speed", "slip", "energy", "events", "solutions")
CHUNK = 100
HOLDS = 0.4  # friction from which a wheel does not slide without end; colours are of these
GREY = "0.8"
TABLE = FIGURES / "friction_map.csv"


@jax.jit
@jax.vmap
def _told(friction: jax.Array, damping: jax.Array, x: jax.Array) -> jax.Array:
    """FIELDS of the step from a section state."""
    wheel = vrw.UnilateralWheel(friction=friction)
    result = wheel.step(vrw.WheelParams(damping=damping), x, vrw.Options())
    energy = result.energy_impacts + result.energy_damping + result.energy_friction
    period = result.period
    flight = result.durations[2] / jnp.where(period > 0.0, period, 1.0)
    row = (period, result.dls_fraction, flight, result.speed, result.slip, energy)
    counts = (result.events, result.most_solutions)
    return jnp.stack([*row, *(jnp.asarray(c, period.dtype) for c in counts)])


def told(friction: np.ndarray, damping: np.ndarray, x: np.ndarray) -> np.ndarray:
    """FIELDS of the steps from many section states, by one program for any number of them."""
    columns, rows = (np.asarray(friction), np.asarray(damping), np.asarray(x)), []
    for begin in range(0, len(x), CHUNK):
        some = [column[begin : begin + CHUNK] for column in columns]
        fill = lambda c: np.concatenate([c, np.repeat(c[-1:], CHUNK - len(c), 0)])
        rows.append(np.asarray(_told(*map(fill, some)))[: len(some[0])])
    return np.concatenate(rows)


def compute() -> None:
    """Walk all wheels and keep their last step."""
    names, mu, c = (x.ravel() for x in np.meshgrid(list(STARTS), FRICTION, DAMPING, indexing="ij"))
    params, model = vrw.WheelParams(damping=c), vrw.UnilateralWheel(friction=mu)
    x = np.array([STARTS[name] for name in names])
    outcome, made, periods = np.zeros(len(c), int), np.zeros(len(c), int), []
    for n_steps in (N_STEPS - N_LAST, *(1,) * N_LAST):
        walked = vrw.steps(params, x, n_steps, model=model, options=vrw.Options(**TOWARDS))
        outcome = np.where(outcome == 0, np.asarray(walked.outcome), outcome)
        made += np.where(outcome == 0, n_steps, np.asarray(walked.n_stepped))
        before, x = x, np.asarray(walked.section_state)
        periods.append(np.asarray(walked.durations).sum(-1))
    spread = np.ptp(periods[1:], axis=0)
    rows = told(mu, c, before)
    lines = []
    for i, name in enumerate(names):
        good = outcome[i] == 0
        label = vrw.Outcome(int(outcome[i])).name
        where = [name, mu[i], c[i], made[i], label, f"{spread[i] if good else 0.0:.1e}"]
        lines.append([*where, *(f"{v:.6g}" for v in (rows[i] if good else 0.0 * rows[i]))])
    write(TABLE, ("start", "friction", "damping", "steps", "outcome", "spread", *FIELDS), lines)


def draw() -> None:
    """Maps of five measures from the table, a row of panels for each start; failed walks grey."""
    shown = {  # label and whether the colours are logarithmic
        "dls_fraction": ("DLS fraction", False),
        "period": ("period [s]", False),
        "speed": ("speed [m/s]", False),
        "slip": ("slip per step [m]", True),
        "energy": ("energy lost per step [J]", False),
    }
    rows = read(TABLE)
    shape = (len(STARTS), len(FRICTION), len(DAMPING))
    figure, axes = plt.subplots(
        len(STARTS), len(shown), figsize=(1.5 * plots.PAGE, 4.6), sharex=True, sharey=True
    )
    for column, (field, (label, logarithmic)) in enumerate(shown.items()):
        good = [r["outcome"] == "STEPPED" and float(r["speed"]) > 0.0 for r in rows]
        values = [float(r[field]) if ok else np.nan for ok, r in zip(good, rows, strict=True)]
        maps = np.array(values).reshape(shape)
        gaits = maps[:, np.array(FRICTION) >= HOLDS]
        least, most = max(float(np.nanmin(gaits)), LEAST_SLIP), float(np.nanmax(gaits))
        start = least if field == "energy" else 0.0
        norm = LogNorm(least, most, clip=True) if logarithmic else Normalize(start, most)
        for row, name in enumerate(STARTS):
            axis = axes[row, column]
            axis.set_facecolor(GREY)
            image = axis.imshow(maps[row].T, origin="lower", aspect="auto", norm=norm)
            axis.set_xticks(range(len(FRICTION)), [f"{m:g}" for m in FRICTION], rotation=90)
            shown_c = range(0, len(DAMPING), 3)
            axis.set_yticks(shown_c, [f"{DAMPING[i]:g}" for i in shown_c])
            if column == 0:
                axis.set_ylabel(f"{name} start\ndamping $c$ [N·s/m]")
        axes[0, column].set_title(label)
        axes[-1, column].set_xlabel("friction coefficient $\\mu$")
        figure.colorbar(image, ax=axes[:, column], location="bottom", extend="max")
    figure.legend(
        handles=[
            Patch(color=GREY, label="no steady gait told: the walk ended, or has no exact step"),
            Patch(color=image.cmap(1.0), label=f"beyond the scale, which is that of friction from "
                  f"{HOLDS:g} up: with less, wheels slide on without end"),
        ],
        loc="outside lower center",
        ncols=2,
    )  # fmt: skip
    plots.save(figure, FIGURES, "friction_map")


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    if not started(parser).redraw:
        compute()
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()

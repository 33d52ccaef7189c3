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
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import FIGURES, read_table, write_table
from vrw_jax import figures as plots

FRICTION = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0)
DAMPING = tuple(float(c) for c in range(20, 401, 20))
STARTS = {"slow": (0.1, 1.6, -0.1), "fast": (0.12, 2.4, -0.2)}
N_STEPS, N_LAST = 150, 10
LEAST_SLIP = 1e-3  # m: less is drawn alike
SETTLING_OPTIONS = {"solver": "Tsit5", "rtol": 1e-8, "atol": 1e-8}  # a gait; its last step is exact
FIELDS = ("period", "dls_fraction", "flight", "speed", "slip", "energy", "events", "solutions")
CHUNK = 100
HOLDS = 0.4  # friction from which a wheel does not slide without end; colours are of these
GREY = "0.8"
TABLE = FIGURES / "friction_map.csv"


@jax.jit
@jax.vmap
def _compute_fields(friction: jax.Array, damping: jax.Array, x: jax.Array) -> jax.Array:
    """FIELDS of the step from a section state."""
    wheel = vrw.UnilateralWheel(friction=friction)
    result = wheel.take_step(vrw.WheelParams(damping=damping), x, vrw.StepOptions())
    energy = result.energy_impacts + result.energy_damping + result.energy_friction
    period = result.period
    flight = result.durations[2] / jnp.where(period > 0.0, period, 1.0)
    row = (period, result.dls_fraction, flight, result.speed, result.slip, energy)
    counts = (result.events, result.most_solutions)
    return jnp.stack([*row, *(jnp.asarray(c, period.dtype) for c in counts)])


def compute_fields(friction: np.ndarray, damping: np.ndarray, x: np.ndarray) -> np.ndarray:
    """FIELDS of the steps from many section states, by one program for any number of them."""
    columns, rows = (np.asarray(friction), np.asarray(damping), np.asarray(x)), []
    for begin in range(0, len(x), CHUNK):
        selection = [column[begin : begin + CHUNK] for column in columns]
        fill = lambda c: np.concatenate([c, np.repeat(c[-1:], CHUNK - len(c), 0)])
        rows.append(np.asarray(_compute_fields(*map(fill, selection)))[: len(selection[0])])
    return np.concatenate(rows)


def compute() -> None:
    """Walk all wheels and keep their last step."""
    names, mu, c = (x.ravel() for x in np.meshgrid(list(STARTS), FRICTION, DAMPING, indexing="ij"))
    params, model = vrw.WheelParams(damping=c), vrw.UnilateralWheel(friction=mu)
    x = np.array([STARTS[name] for name in names])
    outcome, created, periods = np.zeros(len(c), int), np.zeros(len(c), int), []
    for n_steps in (N_STEPS - N_LAST, *(1,) * N_LAST):
        batch_result = vrw.step_batch(
            params, x, n_steps, model=model, options=vrw.StepOptions(**SETTLING_OPTIONS)
        )
        outcome = np.where(outcome == 0, np.asarray(batch_result.outcome), outcome)
        created += np.where(outcome == 0, n_steps, np.asarray(batch_result.n_stepped))
        before, x = x, np.asarray(batch_result.section_state)
        periods.append(np.asarray(batch_result.durations).sum(-1))
    spread = np.ptp(periods[1:], axis=0)
    rows = compute_fields(mu, c, before)
    lines = []
    for i, name in enumerate(names):
        good = outcome[i] == 0
        label = vrw.Outcome(int(outcome[i])).name
        where = [name, mu[i], c[i], created[i], label, f"{spread[i] if good else 0.0:.1e}"]
        lines.append([*where, *(f"{v:.6g}" for v in (rows[i] if good else 0.0 * rows[i]))])
    write_table(
        TABLE, ("start", "friction", "damping", "steps", "outcome", "spread", *FIELDS), lines
    )


def draw() -> None:
    """Maps of five measures from the table, a row of panels for each start; failed walks grey."""
    shown_by_name = {  # label and whether the colours are logarithmic
        "dls_fraction": ("DLS fraction", False),
        "period": ("period [s]", False),
        "speed": ("speed [m/s]", False),
        "slip": ("slip per step [m]", True),
        "energy": ("energy lost per step [J]", False),
    }
    rows = read_table(TABLE)
    shape = (len(STARTS), len(FRICTION), len(DAMPING))
    figure, axes = plt.subplots(
        len(STARTS),
        len(shown_by_name),
        figsize=(1.5 * plots.PAGE_WIDTH_INCHES, 4.6),
        sharex=True,
        sharey=True,
    )
    for column, (field, (label, logarithmic)) in enumerate(shown_by_name.items()):
        good = [r["outcome"] == "STEPPED" and float(r["speed"]) > 0.0 for r in rows]
        values = [float(r[field]) if ok else np.nan for ok, r in zip(good, rows, strict=True)]
        maps = np.array(values).reshape(shape)
        gaits = maps[:, np.array(FRICTION) >= HOLDS]
        minimum, maximum = max(float(np.nanmin(gaits)), LEAST_SLIP), float(np.nanmax(gaits))
        start = minimum if field == "energy" else 0.0
        norm = LogNorm(minimum, maximum, clip=True) if logarithmic else Normalize(start, maximum)
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
    parser = make_parser(__doc__)
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()

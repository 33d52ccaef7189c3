"""Map the gaits with unilateral contact over friction 0.3 to 3 and damping 20 to 400 N s/m.

    python -m experiments.ground.friction_map [--redraw]

Each wheel walks from a slow and a fast start. The table contains the last step of each walk.
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
from vrw_jax import plot as plots

FRICTION = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0)
DAMPING = tuple(float(c) for c in range(20, 401, 20))
STARTS = {"slow": (0.1, 1.6, -0.1), "fast": (0.12, 2.4, -0.2)}
N_STEPS, N_LAST = 150, 10
MIN_SHOWN_SLIP = 1e-3
"""Slip, m, at the lower end of the color scale."""
SETTLING_OPTIONS = {"solver": "Tsit5", "rtol": 1e-8, "atol": 1e-8}
"""Options of the walk to a gait. The last step uses the default options."""
FIELDS = ("period", "dls_fraction", "flight", "speed", "slip", "energy", "events", "solutions")
CHUNK_SIZE = 100
MIN_HOLDING_FRICTION = 0.4
"""Friction coefficient from which no wheel slides on forever. Color scales cover these wheels."""
FAILED_COLOR = "0.8"
MAP_TABLE = FIGURES / "friction_map.csv"


@jax.jit
@jax.vmap
def _compute_fields(friction: jax.Array, damping: jax.Array, x: jax.Array) -> jax.Array:
    """Return the `FIELDS` of one step."""
    wheel = vrw.UnilateralWheel(friction=friction)
    result = wheel.take_step(vrw.WheelParams(damping=damping), x, vrw.StepOptions())
    energy = result.energy_impacts + result.energy_damping + result.energy_friction
    period = result.period
    flight = result.durations[2] / jnp.where(period > 0.0, period, 1.0)
    row = (period, result.dls_fraction, flight, result.speed, result.slip, energy)
    counts = (result.events, result.most_solutions)
    return jnp.stack([*row, *(jnp.asarray(c, period.dtype) for c in counts)])


def compute_fields(friction: np.ndarray, damping: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the `FIELDS` of steps from many section states, computed in chunks of one size."""
    columns, rows = (np.asarray(friction), np.asarray(damping), np.asarray(x)), []
    for begin in range(0, len(x), CHUNK_SIZE):
        selection = [column[begin : begin + CHUNK_SIZE] for column in columns]
        fill = lambda c: np.concatenate([c, np.repeat(c[-1:], CHUNK_SIZE - len(c), 0)])
        rows.append(np.asarray(_compute_fields(*map(fill, selection)))[: len(selection[0])])
    return np.concatenate(rows)


def compute() -> None:
    """Walk all wheels, and write the fields of their last steps."""
    names, mu, c = (x.ravel() for x in np.meshgrid(list(STARTS), FRICTION, DAMPING, indexing="ij"))
    params, model = vrw.WheelParams(damping=c), vrw.UnilateralWheel(friction=mu)
    x = np.array([STARTS[name] for name in names])
    outcome, n_stepped, periods = np.zeros(len(c), int), np.zeros(len(c), int), []
    for n_steps in (N_STEPS - N_LAST, *(1,) * N_LAST):
        batch_result = vrw.step_batch(
            params, x, n_steps, model=model, options=vrw.StepOptions(**SETTLING_OPTIONS)
        )
        outcome = np.where(outcome == 0, np.asarray(batch_result.outcome), outcome)
        n_stepped += np.where(outcome == 0, n_steps, np.asarray(batch_result.n_stepped))
        last_start, x = x, np.asarray(batch_result.section_state)
        periods.append(np.asarray(batch_result.durations).sum(-1))
    spread = np.ptp(periods[1:], axis=0)
    rows = compute_fields(mu, c, last_start)
    lines = []
    for i, name in enumerate(names):
        has_stepped = outcome[i] == 0
        label = vrw.Outcome(int(outcome[i])).name
        cells = [name, mu[i], c[i], n_stepped[i], label, f"{spread[i] if has_stepped else 0.0:.1e}"]
        lines.append([*cells, *(f"{v:.6g}" for v in (rows[i] if has_stepped else 0.0 * rows[i]))])
    write_table(
        MAP_TABLE, ("start", "friction", "damping", "steps", "outcome", "spread", *FIELDS), lines
    )


def draw() -> None:
    """Draw maps of five measures, with one line of panels per start; failed walks are gray."""
    shown_by_name = {  # label, and whether the color scale is logarithmic
        "dls_fraction": ("DLS fraction", False),
        "period": ("period [s]", False),
        "speed": ("speed [m/s]", False),
        "slip": ("slip per step [m]", True),
        "energy": ("energy lost per step [J]", False),
    }
    rows = read_table(MAP_TABLE)
    shape = (len(STARTS), len(FRICTION), len(DAMPING))
    figure, axes = plt.subplots(
        len(STARTS),
        len(shown_by_name),
        figsize=(1.5 * plots.PAGE_FIGURE_WIDTH_INCHES, 4.6),
        sharex=True,
        sharey=True,
    )
    for column, (field, (label, logarithmic)) in enumerate(shown_by_name.items()):
        good = [r["outcome"] == "STEPPED" and float(r["speed"]) > 0.0 for r in rows]
        values = [float(r[field]) if ok else np.nan for ok, r in zip(good, rows, strict=True)]
        maps = np.array(values).reshape(shape)
        gaits = maps[:, np.array(FRICTION) >= MIN_HOLDING_FRICTION]
        minimum, maximum = max(float(np.nanmin(gaits)), MIN_SHOWN_SLIP), float(np.nanmax(gaits))
        start = minimum if field == "energy" else 0.0
        norm = LogNorm(minimum, maximum, clip=True) if logarithmic else Normalize(start, maximum)
        for row, name in enumerate(STARTS):
            axis = axes[row, column]
            axis.set_facecolor(FAILED_COLOR)
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
            Patch(color=FAILED_COLOR, label="no gait: the walk ended, or its last step failed"),
            Patch(color=image.cmap(1.0), label=f"beyond the scale, which covers friction above "
                  f"{MIN_HOLDING_FRICTION:g}; with less friction, wheels slide on forever"),
        ],
        loc="outside lower center",
        ncols=2,
    )  # fmt: skip
    plots.save(figure, FIGURES, "friction_map")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--redraw", action="store_true", help="draw the stored table without computing"
    )
    if not parse_and_start_jax(parser).redraw:
        compute()
    with plots.figure_style():
        draw()


if __name__ == "__main__":
    main()

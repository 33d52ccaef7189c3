"""Double support on real ground: gaits over friction 0.3 to 3, damping 20 to 400, two starts."""

import csv
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import lax
from matplotlib.colors import LogNorm, Normalize

import vrw_jax as vrw

FRICTION = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.3, 1.6, 2.0, 3.0)
DAMPING = (20.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 400.0)
STARTS = {"slow": (0.1, 1.6, -0.1), "fast": (0.12, 2.4, -0.2)}
N_STEPS, N_LAST = 150, 10
LEAST_SLIP = 1e-3  # m: less is drawn alike
OPTIONS = vrw.Options(rtol=1e-8, atol=1e-8)
FIELDS = ("period", "dls_fraction", "flight", "speed", "slip", "energy", "events", "solutions")
TARGET = Path(__file__).parents[1] / "docs" / "figures"
TABLE = TARGET / "friction_map.csv"


def told(result: vrw.UnilateralStep) -> jax.Array:
    """One row of FIELDS."""
    energy = result.energy_impacts + result.energy_damping + result.energy_friction
    period = result.period
    flight = result.durations[2] / jnp.where(period > 0.0, period, 1.0)
    row = (period, result.dls_fraction, flight, result.speed, result.slip, energy)
    counts = (result.events, result.most_solutions)
    return jnp.stack([*row, *(jnp.asarray(c, period.dtype) for c in counts)])


@jax.jit
@jax.vmap
def walked(friction: jax.Array, damping: jax.Array, start: jax.Array) -> tuple:
    """Rows of the last steps, the outcome and how many steps were made."""
    params = vrw.WheelParams(damping=damping)
    wheel = vrw.UnilateralWheel(friction=friction)

    def one(carry: tuple, _: None) -> tuple:
        x, outcome = carry
        result = wheel.step(params, jnp.where(outcome == 0, x, jnp.nan), OPTIONS)
        outcome = jnp.where(outcome == 0, result.outcome, outcome)
        return (result.section_state, outcome), (told(result), outcome)

    begin = (wheel.full_section(params, start), jnp.int32(0))
    (_, outcome), (rows, outcomes) = lax.scan(one, begin, None, length=N_STEPS)
    return rows[-N_LAST:], outcome, jnp.sum(outcomes == 0)


def compute() -> None:
    """Walk all lanes and keep their last step."""
    names, mu, c = np.meshgrid(list(STARTS), FRICTION, DAMPING, indexing="ij")
    starts = np.array([STARTS[name] for name in names.ravel()])
    rows, outcome, steps = map(
        np.asarray, walked(jnp.asarray(mu.ravel()), jnp.asarray(c.ravel()), jnp.asarray(starts))
    )
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["start", "friction", "damping", "steps", "outcome", "spread", *FIELDS])
        for i, name in enumerate(names.ravel()):
            spread = float(np.ptp(rows[i, :, 0])) if outcome[i] == 0 else 0.0
            row = rows[i, -1] if outcome[i] == 0 else np.zeros(len(FIELDS))
            label = vrw.Outcome(int(outcome[i])).name
            where = [name, mu.ravel()[i], c.ravel()[i], int(steps[i]), label, f"{spread:.1e}"]
            writer.writerow([*where, *(f"{v:.6g}" for v in row)])


def draw() -> None:
    """Maps of five measures from the table, a row of panels for each start; failed walks grey."""
    shown = {  # label and whether the colours are logarithmic
        "dls_fraction": ("DLS fraction", False),
        "period": ("period / s", False),
        "speed": ("speed / m/s", True),
        "slip": ("slip per step / m", True),
        "energy": ("energy lost per step / J", True),
    }
    with TABLE.open() as file:
        rows = list(csv.DictReader(file))
    shape = (len(STARTS), len(FRICTION), len(DAMPING))
    figure, axes = plt.subplots(
        len(STARTS), len(shown), figsize=(14, 5.4), sharex=True, sharey=True, layout="constrained"
    )
    for column, (field, (label, logarithmic)) in enumerate(shown.items()):
        values = [float(r[field]) if r["outcome"] == "STEPPED" else np.nan for r in rows]
        maps = np.array(values).reshape(shape)
        least = max(float(np.nanmin(maps)), LEAST_SLIP)
        norm = LogNorm(least, np.nanmax(maps), clip=True) if logarithmic else Normalize(0.0)
        norm.autoscale_None(maps[np.isfinite(maps)])
        for row, name in enumerate(STARTS):
            axis = axes[row, column]
            axis.set_facecolor("0.8")
            image = axis.imshow(maps[row].T, origin="lower", aspect="auto", norm=norm)
            axis.set_xticks(range(len(FRICTION)), [f"{m:g}" for m in FRICTION], rotation=90)
            axis.set_yticks(range(len(DAMPING)), [f"{d:g}" for d in DAMPING])
            if column == 0:
                axis.set_ylabel(f"{name} start\ndamping / N s/m")
        axes[0, column].set_title(label, fontsize=10)
        axes[-1, column].set_xlabel("friction coefficient")
        figure.colorbar(image, ax=axes[:, column], location="bottom")
    for ending in ("png", "svg"):
        figure.savefig(TARGET / f"friction_map.{ending}", dpi=110)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    TARGET.mkdir(parents=True, exist_ok=True)
    if "--redraw" not in sys.argv:
        compute()
    draw()


if __name__ == "__main__":
    main()

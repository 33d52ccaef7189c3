"""Every gait that walks reach is found cold, with 5 to 16 legs and parameters far off the box.

    python -m experiments.gaits.off_the_box [folder]

Random wheels walk from several starts until they repeat; `vrw.limit_cycles` then gets the wheels
alone. Writes `off_the_box.csv` to `results/` or the folder given: by number of legs how many walk,
how many of these are found, by the search alone and by `limit_cycles`, and the time it took.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

import vrw_jax as vrw
from experiments.shared.command import started_with_folder

LEGS = (5, 6, 8, 16)
WHEELS = 40
"""For each number of legs; of all 160 some 27 walk, and it takes three minutes of one core."""
RANGES = {"damping": (5, 250), "stiffness": (200, 1200), "natural_length": (1.005, 1.06),
          "slope": (0.05, 0.5)}  # fmt: skip
STEPS, SAME = 150, 1e-7


def wheels(n_legs: int) -> vrw.WheelParams:
    """Random ones; the same at every run."""
    draw = np.random.default_rng(n_legs).uniform
    table_1 = vrw.WheelParams(n_legs=n_legs)
    drawn = {name: jnp.asarray(draw(*ends, WHEELS)) for name, ends in RANGES.items()}
    return jax.tree.map(lambda x: jnp.broadcast_to(x, WHEELS), vrw.WheelParams(
        n_legs=n_legs, hub_mass=table_1.hub_mass, **drawn
    ))  # fmt: skip


def walked(params: vrw.WheelParams) -> np.ndarray:
    """Section states that each wheel's walks repeat, (lanes, 3), NaN where none does."""
    s, random = params.symbols(), np.random.default_rng(0)
    states = np.full((WHEELS, 3), np.nan)
    for _ in range(9):
        theta = random.uniform(0.0, 0.5 * float(s.alpha), WHEELS)
        rolling = np.sqrt(4.0 * 9.81 * np.sin(0.5 * s.alpha) * np.sin(params.slope)) / s.sin_alpha
        rate = random.uniform(0.3, 1.1, WHEELS) * rolling
        x = np.stack([theta, rate, np.full(WHEELS, -0.1)], 1)
        before = vrw.steps(params, x, STEPS)
        after = vrw.steps(params, np.asarray(before.section_state), 1)
        moved = np.abs(np.asarray(after.section_state - before.section_state)).max(1)
        settled = (np.asarray(before.outcome) == 0) & (np.asarray(after.outcome) == 0)
        settled &= (moved < SAME) & np.isnan(states[:, 0])
        states[settled] = np.asarray(after.section_state)[settled]
    return states


def main() -> None:
    folder, rows = started_with_folder(__doc__), []
    for n_legs in LEGS:
        params = wheels(n_legs)
        states = walked(params)
        reached = np.isfinite(states[:, 0])
        alone = np.asarray(jax.vmap(vrw.limit_cycle)(params).found)
        begin = time.perf_counter()
        cycles = vrw.limit_cycles(params)
        seconds = time.perf_counter() - begin
        found = np.asarray(cycles.found)
        there = np.abs(np.asarray(cycles.section_state) - states).max(1) < 1e-3
        rows.append(
            {
                "legs": n_legs,
                "wheels": WHEELS,
                "walk": int(reached.sum()),
                "found by the search alone": int((reached & alone).sum()),
                "found": int((reached & found).sum()),
                "found where the walk is": int((reached & found & there).sum()),
                "found beside": int((found & ~reached).sum()),
                "seconds, compiling included": round(seconds, 1),
            }
        )
        print(rows[-1], flush=True)
    pd.DataFrame(rows).to_csv(folder / "off_the_box.csv", index=False)


if __name__ == "__main__":
    main()

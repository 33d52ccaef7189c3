"""Every gait that walks reach is found cold, with 5 to 16 legs and parameters far off the box.

    python -m experiments.gaits.off_the_box [folder] [--legs 5 6 8 16] [--wheels 40] [--seed 0]

Random wheels walk from several starts until they repeat; `vrw.limit_cycles` then gets those that
do, their parameters alone. Writes `off_the_box.csv` to `results/` or the folder given: by number of
legs how many walk, how many of these are found, by the search alone and by `limit_cycles`, and the
time it took; and `off_the_box_missed.csv`, those that are not.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import make_parser, parse_and_start_jax

RANGES = {"damping": (5, 250), "stiffness": (200, 1200), "natural_length": (1.005, 1.06),
          "slope": (0.05, 0.5)}  # fmt: skip
STEPS, REPEAT_TOLERANCE = 150, 1e-7


def wheels(n_legs: int, count: int, seed: int) -> vrw.WheelParams:
    """Random ones; the same at every run."""
    draw = np.random.default_rng(n_legs + seed).uniform
    table_1 = vrw.WheelParams(n_legs=n_legs)
    drawn_by_name = {name: jnp.asarray(draw(*ends, count)) for name, ends in RANGES.items()}
    return jax.tree.map(lambda x: jnp.broadcast_to(x, count), vrw.WheelParams(
        n_legs=n_legs, hub_mass=table_1.hub_mass, **drawn_by_name
    ))  # fmt: skip


def walk_to_gaits(params: vrw.WheelParams) -> np.ndarray:
    """Section states that each wheel's walks repeat, (lanes, 3), NaN where none does."""
    s, random, count = params.symbols(), np.random.default_rng(0), len(params.damping)
    states = np.full((count, 3), np.nan)
    for _ in range(9):
        theta = random.uniform(0.0, 0.5 * float(s.alpha), count)
        rolling = np.sqrt(4.0 * 9.81 * np.sin(0.5 * s.alpha) * np.sin(params.slope)) / s.sin_alpha
        rate = random.uniform(0.3, 1.1, count) * rolling
        x = np.stack([theta, rate, np.full(count, -0.1)], 1)
        before = vrw.step_batch(params, x, STEPS)
        after = vrw.step_batch(params, np.asarray(before.section_state), 1)
        shifted = np.abs(np.asarray(after.section_state - before.section_state)).max(1)
        settled = (np.asarray(before.outcome) == 0) & (np.asarray(after.outcome) == 0)
        settled &= (shifted < REPEAT_TOLERANCE) & np.isnan(states[:, 0])
        states[settled] = np.asarray(after.section_state)[settled]
    return states


def survey_gaits(n_legs: int, count: int, seed: int) -> tuple[tables.Row, list[tables.Row]]:
    """A row of counts, and the wheels that walk and were not found."""
    every = wheels(n_legs, count, seed)
    states = walk_to_gaits(every)
    (walking,) = np.nonzero(np.isfinite(states[:, 0]))
    params = jax.tree.map(lambda x: x[walking], every)
    values_array = np.asarray(jax.vmap(vrw.limit_cycle)(params).found)
    begin = time.perf_counter()
    cycles = vrw.limit_cycles(params)
    solution = np.asarray(cycles.found)
    seconds = time.perf_counter() - begin
    values_there = np.abs(np.asarray(cycles.section_state) - states[walking]).max(1) < 1e-3
    row = {
        "legs": n_legs, "wheels": count, "walk": len(walking),
        "found by the search alone": values_array.sum(), "found": solution.sum(),
        "found where the walk is": (solution & values_there).sum(),
        "seconds, compiling included": f"{seconds:.1f}",
    }  # fmt: skip
    missed = [
        {"legs": n_legs, "why": vrw.Outcome(int(cycles.outcome[i])).name}
        | {name: float(getattr(params, name)[i]) for name in RANGES}
        | dict(zip(("theta", "dtheta", "dL1"), states[walking[i]], strict=True))
        for i in np.flatnonzero(~solution)
    ]
    return {name: str(value) for name, value in row.items()}, missed


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    parser.add_argument("--legs", type=int, nargs="+", default=(5, 6, 8, 16))
    parser.add_argument("--wheels", type=int, default=40, help="for each number of legs")
    parser.add_argument("--seed", type=int, default=0, help="of the wheels")
    chosen: argparse.Namespace = parse_and_start_jax(parser)
    rows: list[tables.Row] = []
    lost_values: list[tables.Row] = []
    for n_legs in chosen.legs:
        row, missed = survey_gaits(n_legs, chosen.wheels, chosen.seed)
        rows.append(row)
        lost_values += missed
        print(row, *missed, sep="\n", flush=True)
        tables.write_named_rows(chosen.folder / "off_the_box.csv", rows)
        tables.write_named_rows(chosen.folder / "off_the_box_missed.csv", lost_values)
        jax.clear_caches()  # of programs for this number of legs


if __name__ == "__main__":
    main()

"""Compare gaits reached by walks with gaits found by a cold search, far from the usual parameters.

    python -m experiments.gaits.off_the_box [folder] [--legs 5 6 8 16] [--wheels 40] [--seed 0]

Random wheels walk from several starts until their steps repeat. `vrw.limit_cycles` then searches
the gaits of these wheels from the parameters alone. The command writes two tables to `results/` or
the given folder. `off_the_box.csv` counts per number of legs the wheels that walk, the wheels found
by the search alone and by `limit_cycles`, and the seconds. `off_the_box_missed.csv` lists the
wheels that are not found.
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

PARAMETER_RANGES = {"damping": (5, 250), "stiffness": (200, 1200), "natural_length": (1.005, 1.06),
          "slope": (0.05, 0.5)}  # fmt: skip
N_STEPS, REPEAT_TOLERANCE = 150, 1e-7


def draw_wheels(n_legs: int, count: int, seed: int) -> vrw.WheelParams:
    """Return random wheels, the same in every run with one seed."""
    draw = np.random.default_rng(n_legs + seed).uniform
    table_1 = vrw.WheelParams(n_legs=n_legs)
    parameters = {name: jnp.asarray(draw(*ends, count)) for name, ends in PARAMETER_RANGES.items()}
    return jax.tree.map(lambda x: jnp.broadcast_to(x, count), vrw.WheelParams(
        n_legs=n_legs, hub_mass=table_1.hub_mass, **parameters
    ))  # fmt: skip


def walk_to_gaits(params: vrw.WheelParams) -> np.ndarray:
    """Return the section states that the walks repeat, shape (wheels, 3), with NaN if no walk
    repeats."""
    s, random, count = params.symbols(), np.random.default_rng(0), len(params.damping)
    states = np.full((count, 3), np.nan)
    for _ in range(9):
        theta = random.uniform(0.0, 0.5 * float(s.alpha), count)
        rolling = np.sqrt(4.0 * 9.81 * np.sin(0.5 * s.alpha) * np.sin(params.slope)) / s.sin_alpha
        rate = random.uniform(0.3, 1.1, count) * rolling
        x = np.stack([theta, rate, np.full(count, -0.1)], 1)
        penultimate = vrw.step_batch(params, x, N_STEPS)
        last = vrw.step_batch(params, np.asarray(penultimate.section_state), 1)
        change = np.abs(np.asarray(last.section_state - penultimate.section_state)).max(1)
        is_periodic = (np.asarray(penultimate.outcome) == 0) & (np.asarray(last.outcome) == 0)
        is_periodic &= (change < REPEAT_TOLERANCE) & np.isnan(states[:, 0])
        states[is_periodic] = np.asarray(last.section_state)[is_periodic]
    return states


def survey_gaits(n_legs: int, count: int, seed: int) -> tuple[tables.Row, list[tables.Row]]:
    """Return a row of counts, and the rows of wheels that walk and are not found."""
    wheels = draw_wheels(n_legs, count, seed)
    states = walk_to_gaits(wheels)
    (walking,) = np.nonzero(np.isfinite(states[:, 0]))
    params = jax.tree.map(lambda x: x[walking], wheels)
    is_found_by_search = np.asarray(jax.vmap(vrw.limit_cycle)(params).found)
    start_time = time.perf_counter()
    cycles = vrw.limit_cycles(params)
    is_found = np.asarray(cycles.found)
    seconds = time.perf_counter() - start_time
    is_same_gait = np.abs(np.asarray(cycles.section_state) - states[walking]).max(1) < 1e-3
    row = {
        "legs": n_legs, "wheels": count, "walk": len(walking),
        "found by the search alone": is_found_by_search.sum(), "found": is_found.sum(),
        "found where the walk is": (is_found & is_same_gait).sum(),
        "seconds, compiling included": f"{seconds:.1f}",
    }  # fmt: skip
    missed = [
        {"legs": n_legs, "why": vrw.Outcome(int(cycles.outcome[i])).name}
        | {name: float(getattr(params, name)[i]) for name in PARAMETER_RANGES}
        | dict(zip(("theta", "dtheta", "dL1"), states[walking[i]], strict=True))
        for i in np.flatnonzero(~is_found)
    ]
    return {name: str(value) for name, value in row.items()}, missed


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    parser.add_argument("--legs", type=int, nargs="+", default=(5, 6, 8, 16))
    parser.add_argument("--wheels", type=int, default=40, help="for each number of legs")
    parser.add_argument("--seed", type=int, default=0, help="of the wheels")
    arguments: argparse.Namespace = parse_and_start_jax(parser)
    rows: list[tables.Row] = []
    missed_rows: list[tables.Row] = []
    for n_legs in arguments.legs:
        row, missed = survey_gaits(n_legs, arguments.wheels, arguments.seed)
        rows.append(row)
        missed_rows += missed
        print(row, *missed, sep="\n", flush=True)
        tables.write_named_rows(arguments.folder / "off_the_box.csv", rows)
        tables.write_named_rows(arguments.folder / "off_the_box_missed.csv", missed_rows)
        jax.clear_caches()  # The programs for this number of legs are not needed again.


if __name__ == "__main__":
    main()

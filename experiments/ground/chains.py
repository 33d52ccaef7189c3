"""Measure the error of a step's time due to `max_events`, with one-sided stoppers.

    python -m experiments.ground.chains [--wheels 256]

After a quarter of `max_events` the engine sets contacts to rest at growing speeds, so that chains
of shrinking bounces end. The reference is the same step at the tightest tolerance, with enough
events for every chain. Wheels differ in damping, friction, slope and start. The table is
docs/figures/ground_chains.csv.
"""

import itertools
import math

import jax
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import (
    FIGURES,
    write_table,
)

SEED = 5
DAMPING, SLOPE = (20.0, 400.0), (0.1, 0.34)
STARTS = (0.05, 0.15), (0.8, 2.2), (-0.3, 0.0)
FRICTION = {"0.3 … 1": (0.3, 1.0), "1 … 3": (1.0, 3.0), "3 … 10,000": (3.0, 1e4)}
REFERENCE_TOLERANCE, TOLERANCES = 1e-13, (1e-13, 1e-10)
REFERENCE_MAX_EVENTS, EVENT_LIMITS = 40_000, (400, 1_000, 4_000)
TABLE = FIGURES / "ground_chains.csv"
HEADER = ("friction", "tolerance", "max_events", "steps", "events_median", "events_most")
HEADER += ("p90_s", "p99_s", "largest_s", "above_1e-9_s", "above_1e-6_s", "ends_otherwise")


def compute_steps(tolerance: float, max_events: int, *wheels: np.ndarray) -> list[np.ndarray]:
    """Return times, numbers of events and outcomes of one step of each wheel."""
    options = vrw.StepOptions(rtol=tolerance, atol=tolerance)

    def take_step(damping: jax.Array, slope: jax.Array, x: jax.Array, friction: jax.Array) -> tuple:
        params = vrw.WheelParams(damping=damping, slope=slope)
        model = vrw.UnilateralWheel(friction, max_events, "one-sided")
        step = vrw.step(params, x, model=model, options=options)
        return step.period, step.events, step.outcome

    return [np.asarray(leaf) for leaf in jax.jit(jax.vmap(take_step))(*wheels)]


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--wheels", type=int, default=256)
    n, draw, rows = parse_and_start_jax(parser).wheels, np.random.default_rng(SEED).uniform, []
    starts = np.stack([draw(*limits, n) for limits in STARTS], 1)
    wheels = draw(*DAMPING, n), draw(*SLOPE, n), starts
    bands = {name: np.exp(draw(*np.log(limits), n)) for name, limits in FRICTION.items()}
    for name, friction in {**bands, "infinite": np.full(n, math.inf)}.items():
        reference, _, reference_outcome = compute_steps(
            REFERENCE_TOLERANCE, REFERENCE_MAX_EVENTS, *wheels, friction
        )
        for tolerance, max_events in itertools.product(TOLERANCES, EVENT_LIMITS):
            period, events, outcome = compute_steps(tolerance, max_events, *wheels, friction)
            is_comparable = (outcome == vrw.Outcome.STEPPED) & (reference_outcome == outcome)
            errors, events = np.abs(period - reference)[is_comparable], events[is_comparable]
            row = [is_comparable.sum(), np.median(events), events.max()]
            row += [*np.percentile(errors, (90, 99, 100))]
            row += [
                *(np.sum(errors > e) for e in (1e-9, 1e-6)),
                np.sum(outcome != reference_outcome),
            ]
            rows.append(
                [name, tolerance, max_events, *(f"{x:.3g}" if x < 1.0 else round(x) for x in row)]
            )
            print(rows[-1], flush=True)
    write_table(TABLE, HEADER, rows)


if __name__ == "__main__":
    main()

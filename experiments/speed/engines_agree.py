"""Compare the two engines of a step over random wheels, and state a reason for each difference.

    python -m experiments.speed.engines_agree [--lanes 1000000] [--seed 0]

Wheels and starts come from a wide box: many step, and others fall in every way. Both engines use
the default options. If the outcomes of a lane differ, or its state or durations differ by more than
1e-8, the lane is computed again: by both engines at 1e-13, at 1e-12 to see whether it comes to
rest, and by the lane engine from starts 1e-10 and 1e-8 away. The command writes a table into
`docs/verification/accuracy.md`, and prints the lanes without a reason.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import DOCS, describe_run, format_markdown, replace_block
from vrw_jax.wheel import PARAMETER_NAMES, make_wheel_from_parameters

BOX = {
    "damping": (5.0, 400.0),
    "stiffness": (200.0, 1200.0),
    "natural_length": (1.0, 1.06),
    "slope": (0.05, 0.45),
    "leg_mass": (0.3, 2.0),
}
STARTS = (-0.05, 0.8, -0.4), (0.2, 2.4, 0.1)
BATCH = 4096
AGREE, TIGHTLY = 1e-8, 1e-10
"""Largest difference of states and durations, rad, rad/s, m/s and s, over 1 + their size."""
LESS = 1e-12
"""Tolerance for lanes on whose way tighter ones are below the rounding."""
AWAY = (1e-10, 1e-8)
"""Of starts, times their size: what an error of the landing's rounding, or its tolerance, moves."""

RESTS = 4.0
"""Duration of double support, s, from which a wheel that balances on two legs ends as its rounding
will: that doubles every 0.2 s, twenty times by then."""

StepValues = tuple[np.ndarray, np.ndarray]  # outcome; state and durations, (lanes, 6)


def draw_wheels(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters, shape (lanes, 9), and section states."""
    random = np.random.default_rng(seed)
    rows = np.tile([float(getattr(vrw.WheelParams(), name)) for name in PARAMETER_NAMES], (n, 1))
    for name, limits in BOX.items():
        rows[:, PARAMETER_NAMES.index(name)] = random.uniform(*limits, n)
    return rows, random.uniform(*STARTS, (n, 3))


def compute_steps(
    rows: np.ndarray, states: np.ndarray, engine: str, options: vrw.StepOptions
) -> tuple[StepValues, np.ndarray]:
    """Return one step of each wheel, and the number of tried solver steps."""
    params = make_wheel_from_parameters(jnp.asarray(rows.T), 8)
    batch_result = vrw.step_batch(params, states, options=options, engine=engine)  # type: ignore[arg-type]
    values = np.concatenate([batch_result.section_state, batch_result.durations], 1)
    return (np.asarray(batch_result.outcome), values), np.asarray(batch_result.solver_steps)


def by_diffrax(
    rows: np.ndarray, states: np.ndarray, like: np.ndarray, options: vrw.StepOptions
) -> StepValues:
    """Return the same by diffrax, in batches of lanes that take similar times; `like` contains the
    times."""
    n, order = len(rows), np.argsort(like)
    outcome, values = np.empty(n, int), np.empty((n, 6))
    for begin in range(0, n, BATCH):
        selection = order[np.minimum(np.arange(begin, begin + BATCH), n - 1)]
        (outcome[selection], values[selection]), _ = compute_steps(
            rows[selection], states[selection], "diffrax", options
        )
        print(f"{min(begin + BATCH, n):,} of {n:,} lanes by diffrax", flush=True)
    return outcome, values


def compute_difference(one: StepValues, other: StepValues) -> np.ndarray:
    """Return the largest difference of two results; infinite if the outcomes differ."""
    away = np.max(np.abs(one[1] - other[1]) / (1.0 + np.abs(other[1])), axis=1)
    return np.where(one[0] == other[0], away, np.inf)


def moved_by(by_lanes: Callable, rows: np.ndarray, states: np.ndarray, away: float) -> np.ndarray:
    """Return the change of each lane's result if its start moves by a distance."""
    undisplaced_states = by_lanes(rows, states)
    signs = np.concatenate([np.eye(3), -np.eye(3)])
    return np.max(
        [
            compute_difference(by_lanes(rows, states * (1.0 + away * s)), undisplaced_states)
            for s in signs
        ],
        axis=0,
    )


def reasons(n: int, seed: int) -> tuple[list[tuple[str, int, str]], np.ndarray, str]:
    """Return reason, lanes and largest difference, lanes without a reason, and all other
    differences."""
    rows, states = draw_wheels(n, seed)
    default, tight = vrw.StepOptions(), vrw.StepOptions.tight()
    lanes, tried = compute_steps(rows, states, "lanes", default)
    difference = compute_difference(lanes, by_diffrax(rows, states, tried, default))
    agree = difference <= AGREE
    quantiles = np.quantile(difference[agree], (0.5, 0.99, 1.0))
    reason_rows = [
        (f"the same outcome, and within {AGREE:g}", int(agree.sum()), f"{quantiles[2]:.1e}")
    ]

    unexplained_lanes = np.flatnonzero(~agree)

    def explained(reason: str, by_input: np.ndarray) -> np.ndarray:
        maximum = np.max(difference[unexplained_lanes[by_input]], initial=0.0)
        size = f"{maximum:.1e}" if np.isfinite(maximum) else "outcomes"
        reason_rows.append((reason, int(by_input.sum()), size if by_input.any() else ""))
        return unexplained_lanes[~by_input]

    by_lanes = lambda rows, states: compute_steps(rows, states, "lanes", tight)[0]
    tight_result, tried = compute_steps(
        rows[unexplained_lanes], states[unexplained_lanes], "lanes", tight
    )
    tightly = by_diffrax(rows[unexplained_lanes], states[unexplained_lanes], tried, tight)
    closer = compute_difference(tight_result, tightly)
    rests = np.minimum(tight_result[1][:, 3], tightly[1][:, 3]) > RESTS
    others = (closer > TIGHTLY) & ~rests
    at_rest = f"both come to rest upright: double support of more than {RESTS:g} s"
    unexplained_lanes, rests = (
        explained(f"within {TIGHTLY:g} at tolerances of 1e-13", closer <= TIGHTLY),
        rests[closer > TIGHTLY],
    )
    unexplained_lanes, closer = explained(at_rest, rests), closer[others]
    less = vrw.StepOptions(rtol=LESS, atol=LESS)
    tight_result, tried = compute_steps(
        rows[unexplained_lanes], states[unexplained_lanes], "lanes", less
    )
    near = (
        compute_difference(
            tight_result,
            by_diffrax(rows[unexplained_lanes], states[unexplained_lanes], tried, less),
        )
        <= AGREE
    )
    reason = f"within {AGREE:g} at tolerances of {LESS:g}; at 1e-13 an engine gives up"
    unexplained_lanes, closer = explained(reason, near), closer[~near]
    for away in AWAY:
        if not len(unexplained_lanes):
            break
        moves = moved_by(by_lanes, rows[unexplained_lanes], states[unexplained_lanes], away)
        which = moves >= closer
        unexplained_lanes = explained(
            f"a start {away:g} away differs as much, or ends otherwise", which
        )
        closer = closer[~which]
    reason_rows.append(("no reason found", len(unexplained_lanes), ""))
    spread = "median {:.1e}, 99th percentile {:.1e}, largest {:.1e}".format(*quantiles)
    return (
        reason_rows,
        unexplained_lanes,
        f"Differences of equal outcomes: {spread}.",
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--lanes", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parse_and_start_jax(parser)
    result, unexplained_lanes, spread = reasons(chosen.lanes, chosen.seed)
    header = f"of {chosen.lanes:,} random lanes, seed {chosen.seed}", "lanes", "largest difference"
    table = format_markdown(header, [(reason, f"{n:,}", size) for reason, n, size in result])
    unexplained = (
        f"\n\nNo reason was found for lanes {unexplained_lanes.tolist()}."
        if len(unexplained_lanes)
        else ""
    )
    replace_block(
        DOCS / "verification" / "accuracy.md",
        "agreement",
        f"{table}\n\n{spread}{unexplained}",
        describe_run("experiments.speed.engines_agree"),
    )
    print(table, spread, unexplained)


if __name__ == "__main__":
    main()

"""What the two engines of a step tell apart over random wheels, each difference with its reason.

    python -m experiments.speed.engines_agree [--lanes 1000000] [--seed 0]

Wheels and starts of a wide box: many step, others fall in every way. Both engines at the default
options; lanes whose outcome differs, or whose state or durations do by more than 1e-8, are looked
at again: at tolerances of 1e-13 by both, whether they come to rest, at 1e-12, then at starts 1e-10
and 1e-8 away by the lanes alone. Writes a table into `docs/engine.md`, and names the lanes for
which no reason was found.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import DOCS, markdown, replace
from vrw_jax.wheel import PARAMETER_NAMES, Outcome, wheel_of

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

Told = tuple[np.ndarray, np.ndarray]  # outcome; state and durations, (lanes, 6)


def drawn(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Parameters, (lanes, 9), and section states."""
    random = np.random.default_rng(seed)
    rows = np.tile([float(getattr(vrw.WheelParams(), name)) for name in PARAMETER_NAMES], (n, 1))
    for name, limits in BOX.items():
        rows[:, PARAMETER_NAMES.index(name)] = random.uniform(*limits, n)
    return rows, random.uniform(*STARTS, (n, 3))


def stepped(
    rows: np.ndarray, states: np.ndarray, engine: str, options: vrw.Options
) -> tuple[Told, np.ndarray]:
    """One step of each, and how many steps the solver tried."""
    params = wheel_of(jnp.asarray(rows.T), 8)
    found = vrw.steps(params, states, options=options, engine=engine)  # type: ignore[arg-type]
    values = np.concatenate([found.section_state, found.durations], 1)
    return (np.asarray(found.outcome), values), np.asarray(found.solver_steps)


def by_diffrax(
    rows: np.ndarray, states: np.ndarray, like: np.ndarray, options: vrw.Options
) -> Told:
    """In batches of one size, each of lanes that take about as long: `like` tells how long."""
    n, order = len(rows), np.argsort(like)
    outcome, values = np.empty(n, int), np.empty((n, 6))
    for begin in range(0, n, BATCH):
        some = order[np.minimum(np.arange(begin, begin + BATCH), n - 1)]
        (outcome[some], values[some]), _ = stepped(rows[some], states[some], "diffrax", options)
        print(f"{min(begin + BATCH, n):,} of {n:,} lanes by diffrax", flush=True)
    return outcome, values


def apart(one: Told, other: Told) -> np.ndarray:
    """How far two engines' results differ; infinite where outcomes do."""
    away = np.max(np.abs(one[1] - other[1]) / (1.0 + np.abs(other[1])), axis=1)
    return np.where(one[0] == other[0], away, np.inf)


def moved_by(by_lanes: Callable, rows: np.ndarray, states: np.ndarray, away: float) -> np.ndarray:
    """How far the lanes' own results move with a start that much away."""
    here = by_lanes(rows, states)
    signs = np.concatenate([np.eye(3), -np.eye(3)])
    return np.max([apart(by_lanes(rows, states * (1.0 + away * s)), here) for s in signs], axis=0)


def reasons(n: int, seed: int) -> tuple[list[tuple[str, int, str]], np.ndarray, str]:
    """(reason, lanes, their largest difference), lanes without one, and how the rest differs."""
    rows, states = drawn(n, seed)
    default, tight = vrw.Options(), vrw.Options.tight()
    lanes, tried = stepped(rows, states, "lanes", default)
    difference = apart(lanes, by_diffrax(rows, states, tried, default))
    agree = difference <= AGREE
    quantiles = np.quantile(difference[agree], (0.5, 0.99, 1.0))
    told = [(f"the same outcome, and within {AGREE:g}", int(agree.sum()), f"{quantiles[2]:.1e}")]

    left = np.flatnonzero(~agree)

    def explained(reason: str, by: np.ndarray) -> np.ndarray:
        most = np.max(difference[left[by]], initial=0.0)
        size = f"{most:.1e}" if np.isfinite(most) else "outcomes"
        told.append((reason, int(by.sum()), size if by.any() else ""))
        return left[~by]

    by_lanes = lambda rows, states: stepped(rows, states, "lanes", tight)[0]
    again, tried = stepped(rows[left], states[left], "lanes", tight)
    tightly = by_diffrax(rows[left], states[left], tried, tight)
    closer = apart(again, tightly)
    rests = np.minimum(again[1][:, 3], tightly[1][:, 3]) > RESTS
    others = (closer > TIGHTLY) & ~rests
    at_rest = f"both come to rest upright: double support of more than {RESTS:g} s"
    left, rests = (
        explained(f"within {TIGHTLY:g} at tolerances of 1e-13", closer <= TIGHTLY),
        rests[closer > TIGHTLY],
    )
    left, closer = explained(at_rest, rests), closer[others]
    less = vrw.Options(rtol=LESS, atol=LESS)
    again, tried = stepped(rows[left], states[left], "lanes", less)
    near = apart(again, by_diffrax(rows[left], states[left], tried, less)) <= AGREE
    reason = f"within {AGREE:g} at tolerances of {LESS:g}; at 1e-13 an engine gives up"
    left, closer = explained(reason, near), closer[~near]
    for away in AWAY:
        if not len(left):
            break
        moves = moved_by(by_lanes, rows[left], states[left], away)
        which = moves >= closer
        left = explained(f"a start {away:g} away differs as much, or ends otherwise", which)
        closer = closer[~which]
    told.append(("no reason found", len(left), ""))
    spread = "median {:.1e}, 99th percentile {:.1e}, largest {:.1e}".format(*quantiles)
    codes = np.unique(lanes[0], return_counts=True)
    each = zip(*codes, strict=True)
    names = ", ".join(f"{count:,} {Outcome(int(code)).name}" for code, count in each)
    return told, left, f"Outcomes: {names}. Where they agree: {spread}."


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--lanes", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    chosen = started(parser)
    told, left, spread = reasons(chosen.lanes, chosen.seed)
    header = f"of {chosen.lanes:,} random lanes, seed {chosen.seed}", "lanes", "largest difference"
    table = markdown(header, [(reason, f"{n:,}", size) for reason, n, size in told])
    unexplained = f"\n\nNo reason was found for lanes {left.tolist()}." if len(left) else ""
    replace(DOCS / "engine.md", "agreement", f"{table}\n\n{spread}{unexplained}")
    print(table, spread, unexplained)


if __name__ == "__main__":
    main()

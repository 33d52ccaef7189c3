"""Gaits without a closed form in 40 digits: the reference of walkers and of the woodpecker.

    python -m experiments.atlas.many_digits

A case's own field, guards and resets on numbers of 40 digits, by extrapolated steps of the midpoint
rule that keep 26; Newton's method on the map, with central differences of fourth order. Prints what
`EXACT_GAIT` in each case holds; minutes.
"""

from collections.abc import Sequence
from importlib import import_module

import mpmath
from mpmath import mp, mpf

from experiments.atlas.absolute import integrate_until
from experiments.atlas.gaits import ExactGait, ReturnMap
from experiments.shared.command import make_parser, parse_and_start_jax

CASES = {
    "simplest_walker": ("WALKER", mpf("0.02")),
    "compass_gait": ("COMPASS", mpf("0.01")),
    "woodpecker": ("CYCLE", mpf("2e-4")),
}
"""What each case calls its map, and a step in which no guard falls and rises again, s."""
DIFFERENCE, NEWTON_TOLERANCE = mpf("1e-8"), mpf("1e-21")


def compute_return_map(result: ReturnMap, x: Sequence[mpf], step: mpf) -> tuple[mpmath.matrix, mpf]:
    """Return the value of the map and the duration."""
    y, mode, time = list(result.begin(x, mpmath)), 0, mpf(0)
    for _ in range(result.events):
        part = result.system[mode]
        field = lambda y, part=part: part.field(y, mpmath)
        event_rows = [
            integrate_until(field, lambda y, e=e: e.value(y, mpmath), y, step)
            for e in part.edges[:1]
        ]
        time += event_rows[0].time
        for other in part.edges[1:]:
            assert other.value(event_rows[0].state, mpmath) > 0
        y, mode = list(part.edges[0].reset(event_rows[0].state, mpmath)), part.edges[0].target_part
    return mpmath.matrix(result.read(y)), time


def compute_jacobian(result: ReturnMap, x: mpmath.matrix, step: mpf) -> mpmath.matrix:
    columns = []
    for k in range(len(x)):
        shift = mpmath.matrix([DIFFERENCE if i == k else 0 for i in range(len(x))])
        displaced_end = lambda n, shift=shift: compute_return_map(
            result, list(x + n * shift), step
        )[0]
        columns.append(
            (8 * (displaced_end(1) - displaced_end(-1)) - displaced_end(2) + displaced_end(-2))
            / (12 * DIFFERENCE)
        )
    return mpmath.matrix([[column[i] for column in columns] for i in range(len(x))])


def gait(result: ReturnMap, step: mpf) -> ExactGait:
    x = mpmath.matrix([mpf(v) for v in result.guess])
    identity = mpmath.eye(len(x))
    while True:
        jacobian = compute_jacobian(result, x, step)
        end_state, period = compute_return_map(result, list(x), step)
        change = mpmath.lu_solve(jacobian - identity, x - end_state)
        if mpmath.norm(change) < NEWTON_TOLERANCE:
            break
        x = x + change
    values = sorted(mpmath.eig(jacobian)[0], key=lambda v: (-abs(v), -v.imag))
    return ExactGait(tuple(map(float, x)), float(period), tuple(map(complex, values)))


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--only", choices=CASES, nargs="*", default=list(CASES))
    chosen = parse_and_start_jax(parser)
    mp.dps = 40
    for name in chosen.only:
        place, step = CASES[name]
        case = import_module(f"experiments.atlas.cases.{name}")
        print(f"{name}: {gait(getattr(case, place), step)}", flush=True)


if __name__ == "__main__":
    main()

"""Truth of 256 steps and 256 limit cycles to 20 digits.

    python -m experiments.work_precision.truth [--at-most 256]

Wheels and starts are those of `engine_benchmark`. One step from each start, the limit cycle of
each wheel, its monodromy matrix and its derivatives by four parameters come from the oracle of
`tests/oracle` (formulation `HubForm`, 30 digits); derivatives are central differences of relative
step 1e-10. Every 16th lane is computed again by `MultiplierForm`, which shares no equation with it.
The file keeps what is done: a run that was stopped goes on.
"""

from pathlib import Path

import jax
import mpmath as mp
import numpy as np
from rich.progress import track

import vrw_jax as vrw
from experiments.shared.command import command, extra, started
from experiments.shared.wheels import BOX, near_gaits, wheels

extra("heyoka")
from tests.oracle import multiprecision  # noqa: E402  the oracle needs heyoka
from tests.oracle.differences import minus_identity, solve_two  # noqa: E402
from tests.oracle.hub_form import HubForm  # noqa: E402
from tests.oracle.multiplier_form import MultiplierForm  # noqa: E402

TARGET = Path(__file__).with_name("truth.npz")
LANES, CHECKED_EVERY = 256, 16
BITS, DIGITS = 100, 29
SIZE = mp.mpf("1e-10")
SETTLED = mp.mpf("1e-22")  # the last change leaves an error far below it
VARIED = tuple(BOX)
SHAPES = {
    "step": (6,),  # section state and durations after one step from `start`
    "post_impact": (2,),  # after the landing that follows
    "cycle": (5,),  # (theta+, dtheta+) and durations of the limit cycle
    "matrix": (2, 2),  # monodromy after the landing
    "d_cycle": (5, len(VARIED)),  # derivatives of `cycle` by VARIED
    "gap": (),  # largest disagreement of the two formulations; NaN where not computed
}


def drawn() -> dict[str, np.ndarray]:
    """Wheels, starts, and double-precision guesses of what is sought."""
    rows, states, steps = near_gaits(2 * LANES)
    find = lambda row: vrw.limit_cycle(wheels(row), options=vrw.CycleOptions.tight())
    cycle = jax.jit(jax.vmap(find))(rows)
    guess = np.concatenate([cycle.post_impact, cycle.durations], 1)
    told = {"rows": rows, "start": states, "guess_step": steps[:, 3:], "guess_cycle": guess}
    walks = np.flatnonzero(cycle.found & (guess[:, 2] > 0.0))[:LANES]  # with double support
    told = {name: values[walks] for name, values in told.items()}
    return told | {name: np.full((LANES, *shape), np.nan) for name, shape in SHAPES.items()}


def parameters(row):
    """All nine parameters and the number of legs as exact numbers."""
    wheel = wheels(row)
    names = multiprecision.NAMES
    return [mp.mpf(float(getattr(wheel, name))) for name in names] + [mp.mpf(8)]


def plane_map(model, y, p, about):
    """(theta+, dtheta+) one step later, then durations."""
    landed = model.walk(y, p, about)
    return [*model.land(landed.section_state, p)[0], *landed.durations]


def differences(function, point, sizes):
    """Central differences of a vector function, one list for each argument."""
    columns = []
    for i, size in enumerate(sizes):
        ends = []
        for sign in (1, -1):
            moved = list(point)
            moved[i] = moved[i] + sign * size
            ends.append(function(moved))
        columns.append([(a - b) / (2 * size) for a, b in zip(*ends, strict=True)])
    return columns


def one_lane(models, row, start, guess_step, guess_cycle, check):
    """What SHAPES names, for one lane."""
    hub, other = models
    p = parameters(row)
    x = [mp.mpf(float(v)) for v in start]
    about = [float(d) for d in guess_step]
    y, _ = hub.land(x, p)
    landed = hub.walk(y, p, about)
    step = [*landed.section_state, *landed.durations]
    after, _ = hub.land(landed.section_state, p)

    about = [float(d) for d in guess_cycle[2:]]
    around = lambda point: plane_map(hub, point, p, about)
    y = [mp.mpf(float(v)) for v in guess_cycle[:2]]
    for _ in range(5):  # quadratic from double precision
        image = around(y)
        columns = differences(around, y, [SIZE, SIZE])
        matrix = [[columns[j][i] for j in range(2)] for i in range(2)]
        slope = minus_identity(matrix)
        change = solve_two(slope, [a - b for a, b in zip(image, y, strict=False)])
        y = [a + b for a, b in zip(y, change, strict=True)]
        if max(map(abs, change)) < SETTLED:
            break
    else:
        raise ArithmeticError("Newton's method did not settle")
    at = [multiprecision.NAMES.index(name) for name in VARIED]

    def by_parameters(values):
        moved = list(p)
        for i, value in zip(at, values, strict=True):
            moved[i] = value
        return plane_map(hub, y, moved, about)

    varied = [p[i] for i in at]
    by_p = differences(by_parameters, varied, [SIZE * v for v in varied])
    d_cycle = []
    for column in by_p:
        dy = solve_two(slope, column[:2])
        along = [column[2 + k] + sum(columns[j][2 + k] * dy[j] for j in range(2)) for k in range(3)]
        d_cycle.append([*dy, *along])
    gap = mp.mpf("nan")
    if check:
        again = plane_map(other, y, p, about)
        gap = max(abs(a - b) for a, b in zip(again, [*y, *image[2:]], strict=True))
        landed = other.walk(other.land(x, p)[0], p, [float(d) for d in guess_step])
        found = [*landed.section_state, *landed.durations]
        gap = max([gap, *(abs(a - b) for a, b in zip(found, step, strict=True))])
    floats = lambda values: np.array(values, dtype=object).astype(float)
    return {
        "step": floats(step),
        "post_impact": floats(after),
        "cycle": floats([*y, *image[2:]]),
        "matrix": floats(matrix),
        "d_cycle": floats(d_cycle).T,
        "gap": float(gap),
    }


def load() -> dict[str, np.ndarray]:
    """The truth by name; see SHAPES."""
    with np.load(TARGET) as file:
        return dict(file)


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--at-most", type=int, default=LANES, help="lanes computed in this run")
    chosen = started(parser)
    multiprecision.BITS, multiprecision.DIGITS, mp.mp.prec = BITS, DIGITS, BITS
    told = load() if TARGET.exists() else drawn()
    np.savez_compressed(TARGET, **told)
    models = HubForm(), MultiplierForm()
    todo = np.flatnonzero(np.isnan(told["step"][:, 0]))[: chosen.at_most]
    for lane in track(todo, "lanes"):
        given = (told[name][lane] for name in ("rows", "start", "guess_step", "guess_cycle"))
        found = one_lane(models, *given, check=lane % CHECKED_EVERY == 0)
        for name, value in found.items():
            told[name][lane] = value
        if lane % 8 == 7:
            np.savez_compressed(TARGET, **told)
    np.savez_compressed(TARGET, **told)
    print(f"largest disagreement of the two formulations: {np.nanmax(told['gap']):.1e}")


if __name__ == "__main__":
    main()

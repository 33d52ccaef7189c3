"""Compute references of 256 steps and 256 limit cycles to 20 digits.

    python -m experiments.work_precision.reference_values [--at-most 256]

Wheels and starts are those of `engine_benchmark`. For each start there is one step, and for each
wheel the limit cycle, its monodromy matrix and its derivatives with respect to four parameters.
`HubForm` of `tests/reference_code` computes them with 30 digits. Derivatives are central
differences with relative steps of 1e-10. `MultiplierForm`, which shares no equation with it,
computes every 16th lane again. The file stores finished lanes, and a stopped run continues.
"""

from pathlib import Path

import jax
import mpmath as mp
import numpy as np
from rich.progress import track

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax, require_extra
from experiments.shared.wheels import PARAMETER_BOX, draw_wheels_near_gaits, make_wheels

require_extra("heyoka")
from tests.reference_code import multiprecision  # noqa: E402  the reference needs heyoka
from tests.reference_code.differences import solve_two, subtract_identity  # noqa: E402
from tests.reference_code.hub_form import HubForm  # noqa: E402
from tests.reference_code.multiplier_form import MultiplierForm  # noqa: E402

TARGET = Path(__file__).with_name("reference_values.npz")
LANES, CHECKED_EVERY = 256, 16
BITS, DIGITS = 100, 29
SIZE = mp.mpf("1e-10")
NEWTON_TOLERANCE = mp.mpf("1e-22")  # the last change leaves an error far below it
VARIED_PARAMETERS = tuple(PARAMETER_BOX)
SHAPES = {
    "step": (6,),  # section state and durations after one step from `start`
    "post_impact": (2,),  # after the landing that follows
    "cycle": (5,),  # (theta+, dtheta+) and durations of the limit cycle
    "matrix": (2, 2),  # monodromy after the landing
    "d_cycle": (5, len(VARIED_PARAMETERS)),  # derivatives of `cycle` by VARIED
    "gap": (),  # largest disagreement of the two formulations; NaN where not computed
}


def draw_wheels() -> dict[str, np.ndarray]:
    """Wheels, starts, and double-precision guesses of what is sought."""
    rows, states, steps = draw_wheels_near_gaits(2 * LANES)
    find = lambda row: vrw.limit_cycle(make_wheels(row), options=vrw.CycleOptions.tight())
    cycle = jax.jit(jax.vmap(find))(rows)
    guess = np.concatenate([cycle.post_impact, cycle.durations], 1)
    result_by_name = {
        "rows": rows,
        "start": states,
        "guess_step": steps[:, 3:],
        "guess_cycle": guess,
    }
    walks = np.flatnonzero(cycle.found & (guess[:, 2] > 0.0))[:LANES]  # with double support
    result_by_name = {name: values[walks] for name, values in result_by_name.items()}
    return result_by_name | {
        name: np.full((LANES, *shape), np.nan) for name, shape in SHAPES.items()
    }


def parameters(row):
    """Return all nine parameters and the number of legs as exact numbers."""
    wheel = make_wheels(row)
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
            shifted = list(point)
            shifted[i] = shifted[i] + sign * size
            ends.append(function(shifted))
        columns.append([(a - b) / (2 * size) for a, b in zip(*ends, strict=True)])
    return columns


def one_lane(models, row, start, guess_step, guess_cycle, check):
    """Compute the quantities of SHAPES for one lane."""
    hub, other = models
    p = parameters(row)
    x = [mp.mpf(float(v)) for v in start]
    about = [float(d) for d in guess_step]
    y, _ = hub.land(x, p)
    landed = hub.walk(y, p, about)
    step = [*landed.section_state, *landed.durations]
    after, _ = hub.land(landed.section_state, p)

    about = [float(d) for d in guess_cycle[2:]]
    compute_around = lambda point: plane_map(hub, point, p, about)
    y = [mp.mpf(float(v)) for v in guess_cycle[:2]]
    for _ in range(5):  # quadratic from double precision
        image = compute_around(y)
        columns = differences(compute_around, y, [SIZE, SIZE])
        matrix = [[columns[j][i] for j in range(2)] for i in range(2)]
        slope = subtract_identity(matrix)
        change = solve_two(slope, [a - b for a, b in zip(image, y, strict=False)])
        y = [a + b for a, b in zip(y, change, strict=True)]
        if max(map(abs, change)) < NEWTON_TOLERANCE:
            break
    else:
        raise ArithmeticError("Newton's method did not settle")
    parameter_indices = [multiprecision.NAMES.index(name) for name in VARIED_PARAMETERS]

    def by_parameters(values):
        shifted = list(p)
        for i, value in zip(parameter_indices, values, strict=True):
            shifted[i] = value
        return plane_map(hub, y, shifted, about)

    varied = [p[i] for i in parameter_indices]
    by_p = differences(by_parameters, varied, [SIZE * v for v in varied])
    d_cycle = []
    for column in by_p:
        dy = solve_two(slope, column[:2])
        parameter_derivatives = [
            column[2 + k] + sum(columns[j][2 + k] * dy[j] for j in range(2)) for k in range(3)
        ]
        d_cycle.append([*dy, *parameter_derivatives])
    gap = mp.mpf("nan")
    if check:
        other_image = plane_map(other, y, p, about)
        gap = max(abs(a - b) for a, b in zip(other_image, [*y, *image[2:]], strict=True))
        landed = other.walk(other.land(x, p)[0], p, [float(d) for d in guess_step])
        found_rows = [*landed.section_state, *landed.durations]
        gap = max([gap, *(abs(a - b) for a, b in zip(found_rows, step, strict=True))])
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
    """Return the references by name; see SHAPES."""
    with np.load(TARGET) as file:
        return dict(file)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--at-most", type=int, default=LANES, help="lanes computed in this run")
    chosen = parse_and_start_jax(parser)
    multiprecision.BITS, multiprecision.DIGITS, mp.mp.prec = BITS, DIGITS, BITS
    result = load() if TARGET.exists() else draw_wheels()
    np.savez_compressed(TARGET, **result)
    models = HubForm(), MultiplierForm()
    todo = np.flatnonzero(np.isnan(result["step"][:, 0]))[: chosen.at_most]
    for lane in track(todo, "lanes"):
        given = (result[name][lane] for name in ("rows", "start", "guess_step", "guess_cycle"))
        solution = one_lane(models, *given, check=lane % CHECKED_EVERY == 0)
        for name, value in solution.items():
            result[name][lane] = value
        if lane % 8 == 7:
            np.savez_compressed(TARGET, **result)
    np.savez_compressed(TARGET, **result)
    print(f"largest disagreement of the two formulations: {np.nanmax(result['gap']):.1e}")


if __name__ == "__main__":
    main()

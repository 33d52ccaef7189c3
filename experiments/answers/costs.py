"""What answers cost beside the top rung alone: scans of wheels, and means over them.

    python -m experiments.answers.costs [--wheels 256] [--repeats 3]

Scans of real ground are timed against scans to a tolerance of 1e-3 of the same wheels at friction
15 to 100, in turns, the best of each, and once more of those wheels that begin at a gait of the
paper's and end near it. Means are taken of wheels around a design and over a box, and
their steps set beside those that the top rung alone would need for the same error; what they are
wrong by is told by all wheels at 1e-6.
"""

import time

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, markdown, write
from experiments.shared.wheels import BOX
from vrw_jax.answers.result import How

TOL, FRICTION = 1e-3, (15.0, 100.0)
TABLE = FIGURES / "answers_means.csv"
N_MEAN, MEAN_TOL = 1000, 2e-3
AROUND = {"damping": (140.0, 160.0), "stiffness": (480.0, 520.0), "slope": (0.29, 0.31)}
DESIGNS = {"around Table 1": AROUND, "box": BOX}


def drawn(box: dict[str, tuple[float, float]], n: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(1)
    return {name: random.uniform(*ends, n) for name, ends in box.items()}


def against_the_top_rung(n: int, repeats: int) -> None:
    """Of all wheels, and of those that begin at a gait of the paper's and end near it."""
    columns = drawn(BOX, n)
    columns["friction"] = np.exp(np.random.default_rng(2).uniform(*np.log(FRICTION), n))
    design = vrw.samples(columns)
    found = vrw.scan(design, ["speed"], model=vrw.UnilateralWheel(), tol=TOL)
    friction = columns.pop("friction")
    told = vrw.answer("speed", vrw.WheelParams(**columns), TOL, friction=friction)
    near = np.isin(told.hows, (How.CHECKED, How.CORRECTED))
    print(f"{n} wheels: {int((found.outcome.values == 0).sum())} with an answer, {near.sum()} near")
    some = {name: x[near] for name, x in (*columns.items(), ("friction", friction))}
    for name, wheels in (("all", design), ("near the paper's gait", vrw.samples(some))):
        best = {None: np.inf, TOL: np.inf}
        for _ in range(1 + repeats):  # the first compiles
            for tol in best:
                began = time.perf_counter()
                vrw.scan(wheels, ["speed"], model=vrw.UnilateralWheel(), tol=tol)
                best[tol] = min(best[tol], time.perf_counter() - began)
        share = best[TOL] / best[None]
        print(f"{name}: {best[TOL]:.3f} s, top rung {best[None]:.3f} s, {share:.3f}", flush=True)


def means() -> None:
    rows = []
    for name, box in DESIGNS.items():
        wheels = vrw.WheelParams(**drawn(box, N_MEAN))
        for friction in (5.0, 15.0, 50.0):
            every = vrw.answer(("speed", "dls_fraction"), wheels, 1e-6, friction=friction)
            for i, measure in enumerate(every.names):
                mean = vrw.average(measure, wheels, MEAN_TOL, friction=friction)
                wrong = mean.value - np.mean(every.values[every.found, i])
                ratio = mean.steps / mean.steps_alone
                rows.append([
                    name, friction, measure, int(mean.n_top), mean.control, f"{mean.error:.2g}",
                    f"{wrong:.2g}", int(mean.steps), int(mean.steps_alone), f"{ratio:.3f}",
                ])  # fmt: skip
                print(*rows[-1], flush=True)
    header = (
        "design", "friction", "measure", "asked", "control", "stated", "wrong by", "steps",
        "alone", "ratio",
    )  # fmt: skip
    write(TABLE, header, rows)
    print(markdown(header, rows))


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--wheels", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=3)
    asked = started(parser)
    against_the_top_rung(asked.wheels, asked.repeats)
    means()


if __name__ == "__main__":
    main()

"""What answers cost beside the top rung alone: scans of wheels, and means over them.

    python -m experiments.answers.costs [--wheels 1024] [--repeats 2]

Scans of real ground are timed against scans to a tolerance of 1e-3 of the same wheels at friction
15 to 100, CPU time, the best of each, and once more of those wheels that begin at a gait of the
paper's and end near it. Means are taken of wheels around a design and over a box, and
their CPU time set beside that of a scan on real ground of as many wheels as a mean of them would
need for the same error; what they are wrong by is told by all wheels at 1e-6.
"""

import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import FIGURES, markdown, write
from experiments.shared.wheels import BOX
from vrw_jax.answers.averages import DEVIATIONS
from vrw_jax.answers.result import How

TOL, FRICTION = 1e-3, (15.0, 100.0)
TABLE = FIGURES / "answers_means.csv"
N_MEAN, N_SCAN = 1000, 128
AROUND = {"damping": (140.0, 160.0), "stiffness": (480.0, 520.0), "slope": (0.29, 0.31)}
DESIGNS = {"around Table 1": (AROUND, (2e-3, 2e-4)), "box": (BOX, (1e-2,))}
"""With tolerances of means."""


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
        scan = functools.partial(vrw.scan, wheels, ["speed"], model=vrw.UnilateralWheel())
        best = {tol: _cpu(functools.partial(scan, tol=tol), repeats)[0] for tol in (None, TOL)}
        share = best[TOL] / best[None]
        print(f"{name}: {best[TOL]:.3f} s, top rung {best[None]:.3f} s, {share:.3f}", flush=True)


def means() -> None:
    """What a mean costs, beside a scan on real ground of as many wheels as its error takes."""
    rows = []
    for name, (box, tolerances) in DESIGNS.items():
        columns = drawn(box, N_MEAN)
        wheels = vrw.WheelParams(**columns)
        for friction in (5.0, 15.0, 50.0):
            every = vrw.answer(("speed", "dls_fraction"), wheels, 1e-6, friction=friction)
            some = {key: x[:N_SCAN] for key, x in columns.items()}
            design = vrw.samples(some | {"friction": np.full(N_SCAN, friction)})
            scan = functools.partial(vrw.scan, design, ["speed"], model=vrw.UnilateralWheel())
            one, found = _cpu(scan, 2)[0] / N_SCAN, np.mean(every.found)
            for i, measure in enumerate(every.names):
                values = every.values[every.found, i]
                for tol in tolerances:
                    take = functools.partial(vrw.average, measure, wheels, tol, friction=friction)
                    cpu, mean = _cpu(take, 3)
                    many = (DEVIATIONS * np.std(values) / mean.error) ** 2 / found
                    alone = many / (1.0 + many / N_MEAN)
                    rows.append([
                        name, friction, measure, tol, int(mean.n_top), mean.control,
                        f"{mean.error:.2g}", f"{mean.value - np.mean(values):.2g}", f"{cpu:.3f}",
                        f"{alone:.0f}", f"{one * 1e3:.2f}", f"{cpu / (alone * one):.3f}",
                    ])  # fmt: skip
                    print(*rows[-1], flush=True)
    header = (
        "design", "friction", "measure", "tol", "asked", "control", "stated", "wrong by",
        "CPU time, s", "wheels alone", "ms each", "ratio",
    )  # fmt: skip
    write(TABLE, header, rows)
    print(markdown(header, rows))


def _cpu(take: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Least CPU time of all threads, s, after a first call that compiles; and the last result."""
    told, best = take(), np.inf
    for _ in range(repeats):
        began = time.process_time()
        told = take()
        best = min(best, time.process_time() - began)
    return best, told


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--wheels", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=2)
    asked = started(parser)
    against_the_top_rung(asked.wheels, asked.repeats)
    means()


if __name__ == "__main__":
    main()

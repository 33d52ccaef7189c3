"""Call each batch function with random batch sizes, and record what the process holds.

After each tenth of the calls, resident memory, memory maps, file descriptors and threads are
counted. The counts of a function must reach a plateau: the last half of its calls may add at most
the limits of `MAX_GROWTH`. The counts are written as a table and drawn. A later run of further
functions keeps the counts of the others, so that each function may run in a new process.

    python -m experiments.hardening.resources results --calls 2000
    python -m experiments.hardening.resources results --functions scan limit_cycles
"""

import itertools
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, require_extra
from experiments.shared.tables import Row, group_rows, read_column, read_table, write_named_rows

MAX_BATCH_SIZE = 300
"""Largest number of wheels of a call, chosen because several padded batch sizes occur below it."""
MAX_SLOW_BATCH_SIZE = 24
"""Largest number of wheels of a call of `SLOW_FUNCTIONS`, chosen because 2,000 calls of each then
take a quarter of an hour at most."""
N_COUNTS = 10
"""Number of counts over the calls of a function."""


class ProcessResources(NamedTuple):
    """What a process holds."""

    resident_mib: int
    memory_maps: int
    file_descriptors: int
    threads: int

    @classmethod
    def count(cls) -> "ProcessResources":
        """Return the counts of this process, from Linux's /proc."""
        folder = Path("/proc/self")
        pages = int((folder / "statm").read_text().split()[1])
        return cls(
            pages * os.sysconf("SC_PAGE_SIZE") // 2**20,
            len((folder / "maps").read_text().splitlines()),
            len(os.listdir(folder / "fd")),
            len(os.listdir(folder / "task")),
        )


MAX_GROWTH = ProcessResources(100, 100, 4, 4)
"""Largest growth over the last half of the calls. It is chosen because a fault adds 18 MiB and 240
maps at each new batch size, while an allocator keeps some tens of MiB."""


def draw_wheels(rng: np.random.Generator, max_batch_size: int) -> vrw.WheelParams:
    """Return a batch of wheels of random size from the paper's box."""
    n = int(rng.integers(1, max_batch_size + 1))
    draw = lambda low, high: rng.uniform(low, high, n)
    return vrw.WheelParams(
        damping=draw(100.0, 215.0), stiffness=draw(450.0, 540.0), slope=draw(0.28, 0.32)
    )


def repeat_start(params: vrw.WheelParams) -> np.ndarray:
    """Return the paper's start for each wheel, shape (wheels, 3)."""
    return np.tile(np.asarray(vrw.paper_start()), (len(params.damping), 1))


def make_contact_model() -> vrw.UnilateralWheel:
    """Return the model with unilateral contact; a constant would create arrays at import."""
    return vrw.UnilateralWheel(friction=0.8)


def make_design(params: vrw.WheelParams) -> Any:
    """Return a design with as many samples as there are wheels."""
    return vrw.uniform(damping=(100.0, 215.0), n=len(params.damping))


def make_starts(n: int) -> dict[str, Any]:
    """Return a grid of `n` starts before touchdown."""
    return {
        "theta_touchdown": 0.1,
        "dtheta_touchdown": np.linspace(1.0, 2.5, n + 1)[:n],
        "dL1_touchdown": -0.1,
    }


STARTS_BOX: dict[str, Any] = {
    "theta_touchdown": 0.1,
    "dtheta_touchdown": (1.0, 2.5),
    "dL1_touchdown": -0.1,
}
"""Box of starts before touchdown, rad, rad/s, m/s."""

BATCH_FUNCTIONS: dict[str, Callable[[vrw.WheelParams], object]] = {
    "step_batch": lambda p: vrw.step_batch(p, repeat_start(p)),
    "step_batch, 3 steps": lambda p: vrw.step_batch(p, repeat_start(p), 3),
    "step_batch, derivatives": lambda p: vrw.step_batch(
        p, repeat_start(p), derivatives=["damping"]
    ),
    "step_batch, diffrax": lambda p: vrw.step_batch(p, repeat_start(p), engine="diffrax"),
    "step_batch, rigid": lambda p: vrw.step_batch(p, repeat_start(p), model=vrw.RigidWheel()),
    "step_batch, unilateral contact": lambda p: vrw.step_batch(
        p, repeat_start(p), model=make_contact_model()
    ),
    "step_batch, unilateral contact, derivatives": lambda p: vrw.step_batch(
        p, repeat_start(p), model=make_contact_model(), derivatives=["damping"]
    ),
    "limit_cycles": vrw.limit_cycles,
    "limit_cycles, rigid": lambda p: vrw.limit_cycles(p, model=vrw.RigidWheel()),
    "limit_cycles, unilateral contact": lambda p: vrw.limit_cycles(p, model=make_contact_model()),
    "scan": lambda p: vrw.scan(make_design(p), ["period"]),
    "scan, derivatives": lambda p: vrw.scan(make_design(p), ["d period / d damping"]),
    "scan, unilateral contact": lambda p: vrw.scan(
        make_design(p), ["period"], model=make_contact_model()
    ),
    "scan, auto": lambda p: vrw.scan(make_design(p), ["period"], model="auto"),
    "measure_to_tolerance": lambda p: vrw.measure_to_tolerance("speed", p, 1e-4),
    "basin": lambda p: vrw.basin(vrw.WheelParams(), make_starts(len(p.damping)), max_steps=30),
    "basin_share": lambda p: vrw.basin_share(
        vrw.WheelParams(), STARTS_BOX, n_starts=len(p.damping), max_steps=30
    ),
    "continue_branches": lambda p: vrw.continue_branches(p, "slope", (0.27, 0.33)),
}
"""Public functions of a batch of wheels, starts or samples."""
SLOW_FUNCTIONS = (
    "limit_cycles, unilateral contact", "scan, unilateral contact", "scan, auto",
    "measure_to_tolerance", "continue_branches",
)  # fmt: skip
"""Functions that are called with smaller batches, because they search a gait of each wheel by many
steps, or a branch of gaits."""


def count_over_calls(
    name: str, n_calls: int, seed: int, max_batch_size: int
) -> list[ProcessResources]:
    """Return the counts after each tenth of the calls of a function.

    - `max_batch_size`: largest batch, also of fast functions.
    """
    rng, function = np.random.default_rng(seed), BATCH_FUNCTIONS[name]
    if name in SLOW_FUNCTIONS:
        max_batch_size = min(max_batch_size, MAX_SLOW_BATCH_SIZE)
    counts = []
    for i in range(n_calls):
        function(draw_wheels(rng, max_batch_size))
        if (i + 1) * N_COUNTS // n_calls > i * N_COUNTS // n_calls:
            counts.append(ProcessResources.count())
    return counts


def find_growth(counts: list[ProcessResources]) -> list[str]:
    """Return the resources that grew by more than `MAX_GROWTH` over the last half of the calls."""
    first, last = counts[len(counts) // 2 - 1], counts[-1]
    return [
        f"{resource} grew from {before} to {after}"
        for resource, before, after, limit in zip(
            ProcessResources._fields, first, last, MAX_GROWTH, strict=True
        )
        if after - before > limit
    ]


def draw_counts(rows: list[Row], path: Path) -> None:
    """Draw each resource against the number of calls, one line for each function."""
    plt = require_extra("matplotlib.pyplot")
    figure, axes = plt.subplots(2, 2, figsize=(9, 8), sharex=True, layout="constrained")
    labels = ("resident memory, MiB", "memory maps", "file descriptors", "threads")
    styles = itertools.cycle(["-", "--", ":"])
    for (name, function_rows), style in zip(
        group_rows(rows, "function").items(), styles, strict=False
    ):
        calls = read_column(function_rows, "calls")
        for axis, resource in zip(axes.flat, ProcessResources._fields, strict=True):
            axis.plot(calls, read_column(function_rows, resource), style, label=name)
    for axis, label in zip(axes.flat, labels, strict=True):
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
    for axis in axes[1]:
        axis.set_xlabel("calls with random batch sizes")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    """Count the resources of each function, write the table and the figure."""
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default="results")
    parser.add_argument("--calls", type=int, default=2000, help="calls of each function")
    parser.add_argument(
        "--functions", nargs="*", choices=BATCH_FUNCTIONS, default=list(BATCH_FUNCTIONS)
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--max-batch-size", type=int, default=MAX_BATCH_SIZE)
    chosen = parser.parse_args()
    if chosen.calls < N_COUNTS:
        parser.error(f"--calls is {chosen.calls}, but {N_COUNTS} counts need as many calls.")
    vrw.start_jax()
    table = chosen.folder / "resources.csv"
    stored_rows = read_table(table) if table.exists() else []
    rows = [row for row in stored_rows if row["function"] not in chosen.functions]
    has_growth = False
    for name in chosen.functions:
        counts = count_over_calls(name, chosen.calls, chosen.seed, chosen.max_batch_size)
        growth = find_growth(counts)
        has_growth |= bool(growth)
        print(
            f"{name}: {'; '.join(growth) or 'plateau'} ({counts[-1].memory_maps} maps)", flush=True
        )
        for i, count in enumerate(counts):
            calls = str((i + 1) * chosen.calls // N_COUNTS)
            numbers = {resource: str(number) for resource, number in count._asdict().items()}
            rows.append({"function": name, "calls": calls} | numbers)
        write_named_rows(table, rows)
    draw_counts(rows, chosen.folder / "resources.png")
    if has_growth:
        sys.exit("Some function has no plateau.")


if __name__ == "__main__":
    main()

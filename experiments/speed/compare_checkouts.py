"""Compare the speed of two checkouts in turns within one run; none should fall below 0.97.

    python -m experiments.speed.compare_checkouts A B [--turns 5] [--csv FILE]

Measures gait steps by lanes, limit cycles from a cold guess, samples of a scan, and the import
time, of the libraries in the folders A (before) and B (after). Each turn is a process with its own
cache, and the first one, which fills the cache, does not count. Figures are medians over turns of
the CPU time of one core, also as ratios B over A. Run it on an idle machine.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

from experiments.shared.command import make_parser
from experiments.shared.tables import format_markdown, write_table
from experiments.shared.timing import use_one_core

WORKER = Path(__file__).with_name("checkout_worker.py")
TURN = f"import runpy; runpy.run_path({str(WORKER)!r})['turn']()"
IMPORT = "CPU ms of import vrw_jax"
HEADER = ("figure", "A", "B", "B / A", "lowest", "highest")


def environment(checkout: Path, cache: Path) -> dict[str, str]:
    """Return the environment of a process: the path of its library and the folder of its cache."""
    extra_values = {
        "PYTHONPATH": str(checkout),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    }
    return dict(os.environ) | extra_values


def run_worker(code: str, given: dict[str, str]) -> tuple[str, float]:
    """Return the output of a process and its CPU seconds; its first folder is not on its path."""
    began = os.times()
    out = subprocess.run(
        [sys.executable, "-P", "-c", code], env=given, stdout=subprocess.PIPE, text=True, check=True
    )
    ended = os.times()
    spent_seconds = ended.children_user - began.children_user
    return out.stdout, spent_seconds + ended.children_system - began.children_system


def turn(checkout: Path, cache: Path) -> tuple[dict[str, float], dict[str, int]]:
    """Return the figures of one turn, and the number of lanes of each kind without a failure."""
    given = environment(checkout, cache)
    lines, _ = run_worker(TURN, given)
    parsed = json.loads(lines.splitlines()[-1])
    if not Path(parsed["where"]).is_relative_to(checkout):
        raise SystemExit(f"{checkout} holds no vrw_jax: Python found {parsed['where']}.")
    imports = [run_worker("import vrw_jax", given)[1] for _ in range(3)]
    return parsed["told"] | {IMPORT: 1e3 * statistics.median(imports)}, parsed["ended"]


def compare_versions(checkouts: tuple[Path, Path], caches: Path, turns: int) -> list[tuple]:
    """Return a row of `HEADER` for each figure."""
    places = [(folder, caches / name) for folder, name in zip(checkouts, "ab", strict=True)]
    ended = [turn(*place)[1] for place in places]
    if ended[0] != ended[1]:
        print(f"A and B do not end alike: {ended[0]}, {ended[1]}", flush=True)
    result: tuple[list, list] = ([], [])
    for count in range(turns):
        began = time.time()
        for side in (0, 1) if count % 2 == 0 else (1, 0):
            result[side].append(turn(*places[side])[0])
        print(f"turn {count + 1} of {turns}: {time.time() - began:.0f} s", flush=True)
    rows = []
    for name in result[0][0]:
        a, b = ([one[name] for one in side] for side in result)
        ratios = [y / x for x, y in zip(a, b, strict=True)]
        median_and_range = statistics.median(ratios), min(ratios), max(ratios)
        sizes = (f"{statistics.median(side):.4g}" for side in (a, b))
        rows.append((name, *sizes, *(f"{statistic:.3f}" for statistic in median_and_range)))
    return rows


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("a", type=Path, help="folder of the checkout before")
    parser.add_argument("b", type=Path, help="folder of the checkout after")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--csv", type=Path, help="keep the table there")
    parser.add_argument("--caches", type=Path, default="results/compare_checkouts")
    chosen = parser.parse_args()
    with use_one_core():
        checkouts = chosen.a.resolve(), chosen.b.resolve()
        rows = compare_versions(checkouts, chosen.caches.resolve(), chosen.turns)
    print(format_markdown(HEADER, rows))
    if chosen.csv:
        write_table(chosen.csv, HEADER, rows)


if __name__ == "__main__":
    main()

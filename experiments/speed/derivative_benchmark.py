"""What a step's derivatives cost: in batches over its values, of one wheel, to a first answer.

    python -m experiments.speed.derivative_benchmark [--lanes 2048] [--repeats 9]

Wheels near their own cycles (1 % off), as in `engine_benchmark`; values and Jacobians of states
and durations in one run. Errors: 99th percentile over lanes of the largest entry, against the
diffrax engine at `Options.tight()`. Times in batches are CPU time of one core, the least of the
repeats; alone and to a first answer they are wall time. Writes two tables into `docs/engine.md`.
"""

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

import jax
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.tables import DOCS, markdown, replace
from experiments.shared.timing import on_one_core, processor, seconds
from experiments.shared.wheels import near_gaits, wheels
from vrw_jax.wheel import PARAMETER_NAMES

COLUMNS = {
    "state": ("section_state",),
    "state, c, k, L\\*, φ": ("section_state", "damping", "stiffness", "natural_length", "slope"),
    "all twelve": ("section_state", *PARAMETER_NAMES),
}
FIRST = """
import time; began = time.perf_counter()
import jax, vrw_jax as vrw
vrw.start_jax()
params, x = vrw.WheelParams(), vrw.paper_start()
jax.block_until_ready({call}(params, x))
print(time.perf_counter() - began)
"""
ALONE = {
    "return_map": "jax.jit(vrw.return_map)",
    "its Jacobian by the state": "jax.jit(jax.jacfwd(vrw.return_map, 1))",
    "its Jacobian by all twelve": "jax.jit(jax.jacfwd(vrw.return_map, (0, 1)))",
    "step": "jax.jit(vrw.step)",
    "simulate of three steps": "(lambda params, x: vrw.simulate(params, x, 3).time.values)",
}


def flat(by: dict, names: Sequence[str]) -> np.ndarray:
    """(lanes, 6, columns): of section state, then durations."""
    whole = [np.concatenate([by[name].section_state, by[name].durations], 1) for name in names]
    return np.concatenate([x.reshape(*x.shape[:2], -1) for x in whole], 2)


def in_batches(n: int, repeats: int) -> list[tuple]:
    """(tolerance, columns, microseconds a lane, of the values', errors of values and columns)."""
    rows, states, truth = near_gaits(n)
    params, some, every = wheels(rows), slice(min(n, 512)), COLUMNS["all twelve"]
    tight = vrw.Options.tight()
    exact = vrw.steps(
        wheels(rows[some]), states[some], options=tight, engine="diffrax", derivatives=every
    )
    table = []

    def timed(options: vrw.Options, asked: Sequence[str]) -> tuple[vrw.Steps, float]:
        run = lambda: vrw.steps(params, states, options=options, derivatives=asked)
        told = run()
        with on_one_core():
            return told, 1e6 * seconds(run, repeats, told=min) / n

    for tolerance in (1e-6, 1e-8, 1e-10):
        choose = lambda factor, at=tolerance: vrw.Options(
            rtol=at, atol=at, derivative_tightening=factor
        )
        told, of_values = timed(choose(1.0), ())
        values = np.concatenate([told.section_state, told.durations], 1)
        error = np.quantile(np.max(np.abs(values - truth), 1), 0.99)
        row = (f"{tolerance:.0e}", "", "none", f"{of_values:.2f}", "1", f"{error:.1e}")
        table.append((*row, ""))
        for factor, (name, asked) in itertools.product((1.0, 20.0), COLUMNS.items()):
            told, taken = timed(choose(factor), asked)
            away = np.abs(flat(told.derivatives, asked)[some] - flat(exact.derivatives, asked))
            row = (f"{tolerance:.0e}", f"{factor:g}", name, f"{taken:.2f}")
            off = np.quantile(np.max(away, (1, 2)), 0.99)
            table.append((*row, f"{taken / of_values:.1f}", "", f"{off:.1e}"))
    return table


def alone() -> list[tuple]:
    """(call, microseconds, seconds to a first answer with an empty cache, the same cached)."""
    params, x, table = vrw.WheelParams(), vrw.paper_start(), []
    for name, call in ALONE.items():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-c", FIRST.format(call=call)]
            where = os.environ | {"JAX_COMPILATION_CACHE_DIR": folder}
            told = lambda command=command, where=where: (
                subprocess.run(
                    command, env=where, check=True, capture_output=True, text=True
                ).stdout
            )
            cold, warm = float(told()), float(told())
        function = eval(call, {"jax": jax, "vrw": vrw})  # this file's own text
        jax.block_until_ready(function(params, x))
        times = []
        for _ in range(30):
            began = time.perf_counter()
            jax.block_until_ready(function(params, x))
            times.append(time.perf_counter() - began)
        table.append((name, f"{1e6 * np.median(times):.0f}", f"{cold:.1f}", f"{warm:.1f}"))
    return table


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--lanes", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=9)
    chosen = started(parser)
    header = (
        "tolerance", "tightened by", "columns", "µs a lane", "of the values'",
        "p99 error of values", "of derivatives",
    )  # fmt: skip
    batches = markdown(header, in_batches(chosen.lanes, chosen.repeats))
    one = markdown(("one wheel", "µs", "first answer, s", "the same, cached, s"), alone())
    told = f"{processor()}; load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."
    replace(DOCS / "engine.md", "derivatives", f"{batches}\n\n{one}\n\n{told}")


if __name__ == "__main__":
    main()

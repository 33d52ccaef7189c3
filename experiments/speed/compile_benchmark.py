"""What XLA's two ways of making CPU code cost, program by program: to compile and to run.

    python -m experiments.speed.compile_benchmark

Compiles programs of this package with and without XLA's fusion emitters, which `vrw.start_jax`
switches off, and writes `docs/figures/compile_benchmark.csv` and the table of `docs/numerics.md`.
CPU seconds of one core, no cache; each pair of a program's times is taken in turn. Limit cycles
are found by machine code that does not come from XLA: making it counts as tracing.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

import vrw_jax as vrw
from experiments.shared.command import command
from experiments.shared.tables import DOCS, FIGURES, markdown, replace, write_named
from experiments.shared.timing import on_one_core, start_cold
from vrw_jax.runtime.start import fusion_emitters

LANES, REPEATS = 256, 10
Program = tuple[Callable, tuple]


def programs() -> dict[str, Program]:
    params, x, options = vrw.WheelParams(), jnp.array([0.1, 1.6, -0.1]), vrw.Options()
    many = jax.tree.map(lambda value: jnp.full((LANES,), value), params)
    starts = jnp.tile(x, (LANES, 1))

    def measures(params: vrw.WheelParams) -> tuple:
        cycle = vrw.limit_cycle(params)
        return cycle.period, cycle.dls_fraction, cycle.durations

    def monitors(params: vrw.WheelParams, x: jax.Array) -> vrw.Margins:
        return vrw.step(params, x, options=options).monitors

    return {
        "a step": (lambda p, x: vrw.step(p, x, options=options), (params, x)),
        "its monitors' derivatives": (jax.jacfwd(monitors, argnums=(0, 1)), (params, x)),
        f"{LANES} steps (diffrax)": (jax.vmap(vrw.return_map), (many, starts)),
        "a limit cycle's derivatives": (jax.jacfwd(measures), (params,)),
        "gradient of the spectral radius": (
            jax.grad(lambda p: vrw.limit_cycle(p).spectral_radius), (params,),
        ),
        f"{LANES} limit cycles": (jax.vmap(measures), (many,)),
    }  # fmt: skip


def measured(function: Callable, arguments: tuple) -> dict[str, float]:
    """Seconds to trace, machine code included, and to compile, milliseconds to run, each way."""
    began = time.process_time()
    lowered = jax.jit(function).lower(*arguments)
    row, compiled = {"trace_s": time.process_time() - began}, {}
    for way, on in (("with", True), ("without", False)):
        began = time.process_time()
        compiled[way] = lowered.compile(fusion_emitters(on))
        row[f"compile_{way}_s"] = time.process_time() - began
        jax.block_until_ready(compiled[way](*arguments))
        row[f"run_{way}_ms"] = float("inf")
    for _ in range(REPEATS):
        for way, program in compiled.items():
            began = time.process_time()
            jax.block_until_ready(program(*arguments))
            row[f"run_{way}_ms"] = min(row[f"run_{way}_ms"], 1e3 * (time.process_time() - began))
    return row


SHOWN = {
    "program": "program",
    "trace_s": "trace, s",
    "compile_with_s": "compile with, s",
    "compile_without_s": "without",
    "run_with_ms": "run with, ms",
    "run_without_ms": "without",
}


def main() -> None:
    command(__doc__).parse_args()
    rows = []
    with on_one_core():
        start_cold()
        for name, program in programs().items():
            rows.append({"program": name} | {k: f"{v:.3g}" for k, v in measured(*program).items()})
            print(rows[-1], flush=True)
    write_named(FIGURES / "compile_benchmark.csv", rows)
    table = markdown(SHOWN.values(), [[row[name] for name in SHOWN] for row in rows])
    replace(DOCS / "numerics.md", "compile times", table)


if __name__ == "__main__":
    main()

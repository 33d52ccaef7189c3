"""Measure what XLA's two ways of compiling for the CPU cost per program, in compile and run time.

    python -m experiments.speed.compile_benchmark

The command compiles programs of this package with and without XLA's fusion emitters, which
`vrw.start_jax` switches off. It writes `docs/figures/compile_benchmark.csv`. Times are CPU
seconds of one core without a cache. The two ways take turns for each program. Limit cycles use
machine code that XLA does not make; making this code counts as tracing.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

import vrw_jax as vrw
from experiments.shared.command import make_parser
from experiments.shared.tables import (
    FIGURES,
    write_named_rows,
)
from experiments.shared.timing import start_without_cache, use_one_core
from vrw_jax.lanes.environment import make_fusion_emitter_options

LANES, REPEATS = 256, 10
Program = tuple[Callable, tuple]


def programs() -> dict[str, Program]:
    params, x, options = vrw.WheelParams(), jnp.array([0.1, 1.6, -0.1]), vrw.StepOptions()
    many = jax.tree.map(lambda value: jnp.full((LANES,), value), params)
    starts = jnp.tile(x, (LANES, 1))

    def measures(params: vrw.WheelParams) -> tuple:
        cycle = vrw.limit_cycle(params)
        return cycle.period, cycle.dls_fraction, cycle.durations

    def compute_margins(params: vrw.WheelParams, x: jax.Array) -> vrw.Margins:
        return vrw.step(params, x, options=options).margins

    return {
        "a step": (lambda p, x: vrw.step(p, x, options=options), (params, x)),
        "its margins' derivatives": (jax.jacfwd(compute_margins, argnums=(0, 1)), (params, x)),
        f"{LANES} steps (diffrax)": (jax.vmap(vrw.return_map), (many, starts)),
        "a limit cycle's derivatives": (jax.jacfwd(measures), (params,)),
        "gradient of the spectral radius": (
            jax.grad(lambda p: vrw.limit_cycle(p).spectral_radius), (params,),
        ),
        f"{LANES} limit cycles": (jax.vmap(measures), (many,)),
    }  # fmt: skip


def measure_program(function: Callable, arguments: tuple) -> dict[str, float]:
    """Return seconds to trace, with machine code, seconds to compile and milliseconds to run, each
    way."""
    began = time.process_time()
    lowered = jax.jit(function).lower(*arguments)
    row, compiled = {"trace_s": time.process_time() - began}, {}
    for method_name, is_active in (("with", True), ("without", False)):
        began = time.process_time()
        compiled[method_name] = lowered.compile(make_fusion_emitter_options(is_active))
        row[f"compile_{method_name}_s"] = time.process_time() - began
        jax.block_until_ready(compiled[method_name](*arguments))
        row[f"run_{method_name}_ms"] = float("inf")
    for _ in range(REPEATS):
        for method_name, program in compiled.items():
            began = time.process_time()
            jax.block_until_ready(program(*arguments))
            row[f"run_{method_name}_ms"] = min(
                row[f"run_{method_name}_ms"], 1e3 * (time.process_time() - began)
            )
    return row


def main() -> None:
    make_parser(__doc__).parse_args()
    rows = []
    with use_one_core():
        start_without_cache()
        for name, program in programs().items():
            rows.append(
                {"program": name} | {k: f"{v:.3g}" for k, v in measure_program(*program).items()}
            )
            print(rows[-1], flush=True)
    write_named_rows(FIGURES / "compile_benchmark.csv", rows)


if __name__ == "__main__":
    main()

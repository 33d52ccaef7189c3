"""Time running and compiling separately, in a form that `pytest-benchmark` compares between
commits.

    python -m experiments.speed.wall_time       # stores the times in .benchmarks
    pytest-benchmark compare --group-by=name    # compares commits

The running time is the CPU time of a compiled call. The first time is the wall time of a process
that starts, compiles without a cache and computes. All use one core. No test of the library
measures time, and these files are separate. Run both commits one after the other on an idle
machine. Further arguments go to pytest.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vrw_jax as vrw
from experiments.shared.command import make_parser, require_extra
from experiments.shared.timing import start_without_cache, use_one_core
from experiments.shared.wheels import PARAMETER_BOX, draw_parameter_rows, make_wheels

START = (0.1, 1.6, -0.1)
RUNNING = {
    "one step": lambda: vrw.return_map(vrw.WheelParams(), START),
    "4,096 steps": lambda: vrw.step_batch(
        make_wheels(draw_parameters(4096)), np.tile(START, (4096, 1))
    ),
    "one limit cycle": lambda: vrw.limit_cycle(vrw.WheelParams()),
    "1,024 limit cycles": lambda: many_cycles(draw_parameters(1024)),
    "a gradient": lambda: gradient(vrw.WheelParams()),
    "256 steps with unilateral contact": lambda: vrw.step_batch(
        make_wheels(draw_parameters(256)), np.tile(START, (256, 1)), model=vrw.UnilateralWheel()
    ),
}
FIRST_CALLS = {
    "step": "vrw.step(vrw.WheelParams(), (0.1, 1.6, -0.1))",
    "gradient": "jax.grad(lambda p: vrw.limit_cycle(p).dls_fraction)(vrw.WheelParams())",
    "scan": "vrw.scan(vrw.grid(damping=[100.0, 150.0], slope=[0.28, 0.3]), ['dls_fraction'])",
}


def draw_parameters(n: int) -> np.ndarray:
    """Return the parameters of random wheels, the same each time."""
    return draw_parameter_rows(PARAMETER_BOX, n, np.random.default_rng(0))


many_cycles = jax.jit(jax.vmap(lambda row: vrw.limit_cycle(make_wheels(row)).period))
gradient = jax.jit(jax.grad(lambda p: vrw.limit_cycle(p).dls_fraction))


@pytest.mark.benchmark(timer=time.process_time, min_time=0.02, max_time=2.0)
@pytest.mark.parametrize("name", RUNNING)
def test_running(name: str, benchmark: Callable) -> None:
    call = lambda: jax.block_until_ready(jax.tree.leaves(RUNNING[name]()))
    call()
    result = benchmark(call)
    assert all(np.all(np.isfinite(jnp.asarray(leaf))) for leaf in result)


@pytest.mark.parametrize("name", FIRST_CALLS)
def test_first_answer(name: str, benchmark: Callable, tmp_path: object) -> None:
    code = f"import jax, vrw_jax as vrw; vrw.start_jax({str(tmp_path)!r}); {FIRST_CALLS[name]}"
    start = [sys.executable, "-c", code]
    run = lambda: subprocess.run(start, check=True, env=dict(os.environ))
    benchmark.pedantic(run, rounds=1, iterations=1)


def main() -> None:
    _, extra_values = make_parser(__doc__).parse_known_args()
    require_extra("pytest_benchmark")
    with use_one_core():
        start_without_cache()
        raise SystemExit(pytest.main([__file__, "-n", "0", "--benchmark-autosave", *extra_values]))


if __name__ == "__main__":
    main()

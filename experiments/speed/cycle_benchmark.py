"""Measure the cost of limit cycles and their gradients, the time of a first gait, and the hit rate.

    python -m experiments.speed.cycle_benchmark

The command writes the block of `docs/benchmarks/cycles.md`. Times are the least CPU seconds of some
calls on one core, unless they are called wall times. Run it on an idle machine.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import DOCS, describe_run, format_markdown, replace_block
from experiments.shared.timing import measure_cpu_seconds, use_one_core
from experiments.shared.wheels import WIDE_BOX, draw_parameter_rows
from experiments.shared.wheels import make_wheels as wheels_of_rows
from vrw_jax.gaits import CYCLE_MEASURE_FUNCTIONS
from vrw_jax.wheel import make_wheel_from_parameters, stack_parameters

N_SETS, N_STAGES, LANES = 2048, 48, 1024
ON_STABILITY = ("spectral_radius", "spectral_margin", "stability_margin")
"""Derivatives of these are second derivatives of the motion."""
FIRST_GAIT_SCRIPT = """
import time; began = time.time(), time.process_time()
import jax
import vrw_jax as vrw
vrw.start_jax()
gradient = jax.jit(jax.grad(lambda p: vrw.limit_cycle(p).{measure}))(vrw.WheelParams())
jax.block_until_ready(gradient)
print(time.time() - began[0], time.process_time() - began[1])
"""


def make_random_wheels(generator: np.random.Generator, n: int) -> vrw.WheelParams:
    """Return random wheels, in which every parameter has an entry per lane."""
    random_wheels = wheels_of_rows(draw_parameter_rows(WIDE_BOX, n, generator))
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n,)), random_wheels)


def measure_least_seconds(function: Callable, *arguments: object) -> float:
    """Return the least CPU time of a call on one core, s."""
    jax.block_until_ready(function(*arguments))
    with use_one_core():
        return measure_cpu_seconds(lambda: function(*arguments), reduction=min)


STARTS = ("cold", "warm cache")
"""States of the cache that two processes share."""


def measure_first_gait(measure: str) -> list[tuple[float, float]]:
    """Return wall and CPU seconds of a process that computes one gradient, for each of `STARTS`."""
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
        for _ in STARTS:
            command = [sys.executable, "-c", FIRST_GAIT_SCRIPT.format(measure=measure)]
            out = subprocess.run(
                command, env=environment, capture_output=True, text=True, check=True
            )
            wall, cpu = map(float, out.stdout.split()[-2:])
            rows.append((wall, cpu))
    return rows


def find_reachable_wheels(params: vrw.WheelParams) -> np.ndarray:
    """Return which wheels natural continuation from Table 1 reaches in small steps.

    A wheel is not reached if its gait is lost or jumps.
    """
    ends = stack_parameters(params)
    starts = jnp.broadcast_to(stack_parameters(vrw.WheelParams())[:, None], ends.shape)
    find = jax.jit(
        jax.vmap(lambda p, guess: vrw.limit_cycle(make_wheel_from_parameters(p, 8), guess=guess))
    )
    cycles = jax.jit(jax.vmap(lambda p: vrw.limit_cycle(make_wheel_from_parameters(p, 8))))(
        starts.T
    )
    reached = np.ones(ends.shape[1], bool)
    for share in np.linspace(0.0, 1.0, N_STAGES + 1)[1:]:
        next_cycles = find((starts + share * (ends - starts)).T, cycles)
        shifted = np.max(np.abs(np.asarray(next_cycles.durations - cycles.durations)), axis=-1)
        with_dls = np.asarray(next_cycles.durations)[:, 0] > 0.0
        reached &= np.asarray(next_cycles.found) & (shifted < 0.1) & with_dls
        cycles = next_cycles
    return reached


def measure_hit_rate() -> dict[str, int]:
    """Return the shares of wheels for which a gait is found."""
    params = make_random_wheels(np.random.default_rng(7), N_SETS)
    reached = find_reachable_wheels(params)
    cold = jax.jit(jax.vmap(vrw.limit_cycle))(params)
    is_found_cold = np.asarray(cold.found)
    options = vrw.StepOptions.tight()
    walk = jax.jit(jax.vmap(lambda p, x: vrw.return_map(p, x, options=options)))
    x = np.asarray(cold.section_state)
    away = np.max(np.abs(np.asarray(walk(params, cold.section_state)) - x), axis=-1)
    return {
        "random wheels": N_SETS,
        "gait reached by continuation": int(reached.sum()),
        "gait also found without a guess": int((reached & is_found_cold).sum()),
        "gait found without a guess only": int((is_found_cold & ~reached).sum()),
        "gait found, but not confirmed by the event-driven step to 1e-7": int(
            (is_found_cold & ~(away < 1e-7)).sum()
        ),
    }


def measure_batch_time() -> dict[str, float]:
    """Return microseconds of one core per cycle, in batches."""
    params = make_random_wheels(np.random.default_rng(3), 8 * LANES)
    every = jax.jit(jax.vmap(vrw.limit_cycle))
    found_indices = np.flatnonzero(np.asarray(every(params).found))[:LANES]
    params = jax.tree.map(lambda x: x[found_indices], params)
    parameter_rows = stack_parameters(params).T
    cold = jax.jit(jax.vmap(vrw.limit_cycle))
    near = cold(jax.tree.map(lambda x: x * (1.0 + 1e-3), params))

    def residuals(p: vrw.WheelParams) -> tuple:
        cycle = vrw.limit_cycle(p)
        return cycle.section_state, cycle.residual, cycle.multipliers

    def from_neighbor(p: vrw.WheelParams, guess: vrw.LimitCycle) -> tuple:
        cycle = vrw.limit_cycle(p, guess=guess)
        return cycle.section_state, cycle.residual, cycle.multipliers

    def differentiated(v: jax.Array) -> tuple:
        def evaluate(v: jax.Array) -> tuple:
            cycle = vrw.limit_cycle(make_wheel_from_parameters(v, 8))
            values = jnp.concatenate([cycle.post_impact, cycle.durations, cycle.dls_fraction[None]])
            return values, cycle.residual

        return jax.jacfwd(evaluate, has_aux=True)(v)

    measured = lambda name: (
        lambda v: vrw.limit_cycle(make_wheel_from_parameters(v, 8)).measure(name)
    )
    derived = {
        "gradient of `dls_fraction`": jax.grad(measured("dls_fraction")),
        "gradient of `spectral_radius`": jax.grad(measured("spectral_radius")),
        "gradient of `stability_margin`": jax.grad(measured("stability_margin")),
        "Hessian of `dls_fraction`": jax.hessian(measured("dls_fraction")),
    }
    table = {
        "from the default guess, with multipliers": (jax.jit(jax.vmap(residuals)), params),
        "from a neighbor 0.1 % away, with multipliers": (
            jax.jit(jax.vmap(from_neighbor)), params, near,
        ),
        "with nine first derivatives of everything": (
            jax.jit(jax.vmap(differentiated)), parameter_rows,
        ),
        **{
            name: (jax.jit(jax.vmap(function)), parameter_rows)
            for name, function in derived.items()
        },
    }  # fmt: skip
    return {name: 1e6 * measure_least_seconds(*call) / LANES for name, call in table.items()}


def measure_single_time() -> dict[str, float]:
    """Return milliseconds of one wheel: a return map, a cycle, and all its derivatives."""
    params, x = vrw.WheelParams(), vrw.limit_cycle(vrw.WheelParams()).section_state
    names = [name for name in CYCLE_MEASURE_FUNCTIONS if name not in ON_STABILITY]

    def evaluate(v: jax.Array) -> jax.Array:
        cycle = vrw.limit_cycle(make_wheel_from_parameters(v, 8))
        return jnp.stack([cycle.measure(name) for name in names])

    v = stack_parameters(params)
    return {
        "return map at the default options": 1e3
        * measure_least_seconds(jax.jit(vrw.return_map), params, x),
        "limit cycle from the default guess": 1e3 * measure_least_seconds(jax.jit(evaluate), v),
        f"limit cycle with {len(names)} measures x 9 derivatives": 1e3
        * measure_least_seconds(jax.jit(jax.jacfwd(evaluate)), v),
    }


def measure_first_times() -> str:
    """Return seconds of processes that compute one gradient."""
    answers = [
        (f"gradient of `{measure}`, {state}", f"{wall:.1f}", f"{cpu:.1f}")
        for measure in ("dls_fraction", "spectral_radius")
        for state, (wall, cpu) in zip(STARTS, measure_first_gait(measure), strict=True)
    ]
    return format_markdown(("first result of a process", "wall, s", "CPU, s"), answers)


def measure_batches() -> str:
    """Return the lines of the page about cycles in batches."""
    header = (f"batches of {LANES}", "µs per cycle", "per second and core")
    costs = measure_batch_time().items()
    return format_markdown(header, [(name, f"{us:.0f}", f"{1e6 / us:,.0f}") for name, us in costs])


def measure_single_gait() -> str:
    """Return the lines of the page about one gait."""
    costs = measure_single_time()
    unit = next(iter(costs.values()))
    cells = [(name, f"{ms:.2f}", f"{ms / unit:.2f}") for name, ms in costs.items()]
    return format_markdown(("one gait alone", "ms", "return maps"), cells)


def measure_hit_rates() -> str:
    """Return the lines of the page about hit rates."""
    box = ", ".join(f"{n} {low:g}…{high:g}" for n, (low, high) in WIDE_BOX.items())
    table = format_markdown(
        ("", "wheels"), [(name, f"{n:,}") for name, n in measure_hit_rate().items()]
    )
    return (
        f"The table counts random wheels from the box {box}. The reference is continuation from "
        f"Table 1 in {N_STAGES} steps.\n\n{table}"
    )


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    parts = []
    for section in (measure_first_times, measure_batches, measure_single_gait, measure_hit_rates):
        parts.append(section())
        print(parts[-1], flush=True)
    source = describe_run("experiments.speed.cycle_benchmark")
    replace_block(DOCS / "benchmarks" / "cycles.md", "cycles", "\n\n".join(parts), source)


if __name__ == "__main__":
    main()

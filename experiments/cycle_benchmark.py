"""What limit cycles cost: per cycle and core, per gradient, to the first answer; and the hit rate.

Writes `docs/cycles.md`, or the file given: `python experiments/cycle_benchmark.py [file]`. Times
are CPU seconds of one core unless called wall; take them on an idle machine.
"""

import contextlib
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from vrw_jax.cycles.sensitivity import MEASURES
from vrw_jax.wheel import PARAMETER_NAMES
from vrw_jax.wheel.params import parameters_of, wheel_of

BOX = {
    "damping": (20.0, 215.0), "stiffness": (400.0, 600.0), "natural_length": (1.01, 1.04),
    "slope": (0.26, 0.34),
}  # fmt: skip
N_SETS, N_STAGES, LANES, REPEATS = 2048, 48, 1024, 5
FIRST = """
import time; began = time.time(), time.process_time()
import jax
import vrw_jax as vrw
{start}
gradient = jax.jit(jax.grad(lambda p: vrw.limit_cycle(p).{measure}))(vrw.WheelParams())
jax.block_until_ready(gradient)
print(time.time() - began[0], time.process_time() - began[1])
"""


def wheels(generator: np.random.Generator, n: int) -> vrw.WheelParams:
    drawn = {name: generator.uniform(*bounds, n) for name, bounds in BOX.items()}
    table_1 = vrw.WheelParams()
    filled = {
        name: drawn.get(name, np.full(n, float(getattr(table_1, name)))) for name in PARAMETER_NAMES
    }
    return vrw.WheelParams(**filled)


@contextlib.contextmanager
def on_one_core() -> Iterator[None]:
    """Two threads that wait for each other would both be counted."""
    if not hasattr(os, "sched_setaffinity"):  # Linux alone has it
        yield
        return
    cores = os.sched_getaffinity(0)
    threads = [int(name) for name in os.listdir("/proc/self/task")]
    for thread in threads:
        os.sched_setaffinity(thread, {max(cores)})
    yield
    for thread in threads:
        os.sched_setaffinity(thread, cores)


def seconds(function: Callable, *arguments: object) -> float:
    """CPU time of one call, the least of some."""
    jax.block_until_ready(function(*arguments))
    times = []
    with on_one_core():
        for _ in range(REPEATS):
            began = time.process_time()
            jax.block_until_ready(function(*arguments))
            times.append(time.process_time() - began)
    return min(times)


STARTS = {
    "cold": "vrw.start_jax()",
    "warm cache": "vrw.start_jax()",
    "cold, without `start_jax`": 'jax.config.update("jax_enable_x64", True)',
}
"""How a process begins; the first two share a cache."""


def first_answer(measure: str) -> list[tuple[float, float]]:
    """(wall, CPU) seconds of a process that asks for one gradient, for each of STARTS."""
    told = []
    with tempfile.TemporaryDirectory() as cache:
        for start in STARTS.values():
            environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
            if "start_jax" in start:
                environment["JAX_COMPILATION_CACHE_DIR"] = cache
            command = [sys.executable, "-c", FIRST.format(measure=measure, start=start)]
            out = subprocess.run(
                command, env=environment, capture_output=True, text=True, check=True
            )
            wall, cpu = map(float, out.stdout.split()[-2:])
            told.append((wall, cpu))
    return told


def reference(params: vrw.WheelParams) -> np.ndarray:
    """Which wheels natural continuation from Table 1 reaches, in small steps, each from the last.

    A lane whose gait is lost, or jumps, on the way is not reached.
    """
    ends = parameters_of(params)
    starts = jnp.broadcast_to(parameters_of(vrw.WheelParams())[:, None], ends.shape)
    find = jax.jit(jax.vmap(lambda p, guess: vrw.limit_cycle(wheel_of(p, 8), guess=guess)))
    here = jax.jit(jax.vmap(lambda p: vrw.limit_cycle(wheel_of(p, 8))))(starts.T)
    reached = np.ones(ends.shape[1], bool)
    for share in np.linspace(0.0, 1.0, N_STAGES + 1)[1:]:
        there = find((starts + share * (ends - starts)).T, here)
        moved = np.max(np.abs(np.asarray(there.durations - here.durations)), axis=-1)
        with_dls = np.asarray(there.durations)[:, 0] > 0.0
        reached &= np.asarray(there.found) & (moved < 0.1) & with_dls
        here = there
    return reached


def hit_rate() -> dict[str, int]:
    params = wheels(np.random.default_rng(7), N_SETS)
    reached = reference(params)
    cold = jax.jit(jax.vmap(vrw.limit_cycle))(params)
    found = np.asarray(cold.found)
    options = vrw.Options.tight()
    walk = jax.jit(jax.vmap(lambda p, x: vrw.return_map(p, x, options=options)))
    x = np.asarray(cold.section_state)
    away = np.max(np.abs(np.asarray(walk(params, cold.section_state)) - x), axis=-1)
    return {
        "sets": N_SETS,
        "reached by continuation": int(reached.sum()),
        "of those found from a cold start": int((reached & found).sum()),
        "found besides": int((found & ~reached).sum()),
        "found, but not confirmed by the event-driven step to 1e-7": int(
            (found & ~(away < 1e-7)).sum()
        ),
    }


def throughput() -> dict[str, float]:
    """Microseconds of one core per cycle, in batches."""
    params = wheels(np.random.default_rng(3), 8 * LANES)
    every = jax.jit(jax.vmap(vrw.limit_cycle))
    kept = np.flatnonzero(np.asarray(every(params).found))[:LANES]
    params = jax.tree.map(lambda x: x[kept], params)
    vectors = parameters_of(params).T
    cold = jax.jit(jax.vmap(vrw.limit_cycle))
    near = cold(jax.tree.map(lambda x: x * (1.0 + 1e-3), params))

    def residuals(p: vrw.WheelParams) -> tuple:
        cycle = vrw.limit_cycle(p)
        return cycle.section_state, cycle.residual, cycle.multipliers

    def from_neighbour(p: vrw.WheelParams, guess: vrw.LimitCycle) -> tuple:
        cycle = vrw.limit_cycle(p, guess=guess)
        return cycle.section_state, cycle.residual, cycle.multipliers

    def differentiated(v: jax.Array) -> tuple:
        def told(v: jax.Array) -> tuple:
            cycle = vrw.limit_cycle(wheel_of(v, 8))
            values = jnp.concatenate([cycle.post_impact, cycle.durations, cycle.dls_fraction[None]])
            return values, cycle.residual

        return jax.jacfwd(told, has_aux=True)(v)

    table = {
        "from the default guess, with multipliers": (jax.jit(jax.vmap(residuals)), params),
        "from a neighbour 0.1 % away, with multipliers": (
            jax.jit(jax.vmap(from_neighbour)), params, near,
        ),
        "with nine first derivatives of everything": (jax.jit(jax.vmap(differentiated)), vectors),
    }  # fmt: skip
    return {name: 1e6 * seconds(*call) / LANES for name, call in table.items()}


def sensitivity_ratio() -> dict[str, float]:
    """Milliseconds of one gait alone: a return map, a cycle, and a full sensitivity."""
    params, x = vrw.WheelParams(), vrw.limit_cycle(vrw.WheelParams()).section_state
    names = [name for name in MEASURES if name not in ("spectral_radius", "stability_margin")]

    def told(v: jax.Array) -> jax.Array:
        cycle = vrw.limit_cycle(wheel_of(v, 8))
        return jnp.stack([MEASURES[name][1](cycle) for name in names])

    v = parameters_of(params)
    return {
        "return map at the default options": 1e3 * seconds(jax.jit(vrw.return_map), params, x),
        "limit cycle from the default guess": 1e3 * seconds(jax.jit(told), v),
        f"limit cycle with {len(names)} measures x 9 derivatives": 1e3
        * seconds(jax.jit(jax.jacfwd(told)), v),
    }


def compiling() -> list[str]:
    told = ["| to the first answer of a process | wall, s | CPU, s |", "|---|---|---|"]
    for measure in ("dls_fraction", "spectral_radius"):
        for state, (wall, cpu) in zip(STARTS, first_answer(measure), strict=True):
            told.append(f"| gradient of `{measure}`, {state} | {wall:.1f} | {cpu:.1f} |")
    return told


def batches() -> list[str]:
    told = [f"| batches of {LANES} | µs per cycle | per second and core |", "|---|---|---|"]
    return told + [
        f"| {name} | {cost:.0f} | {1e6 / cost:,.0f} |" for name, cost in throughput().items()
    ]


def alone() -> list[str]:
    costs = sensitivity_ratio()
    unit = next(iter(costs.values()))
    told = ["| one gait alone | ms | return maps |", "|---|---|---|"]
    return told + [f"| {name} | {cost:.2f} | {cost / unit:.2f} |" for name, cost in costs.items()]


def finding() -> list[str]:
    box = ", ".join(f"{n} {low:g}…{high:g}" for n, (low, high) in BOX.items())
    told = [
        f"Random wheels of the box {box}. Reference: continuation from Table 1 in {N_STAGES} "
        "steps.", "", "| | wheels |", "|---|---|",
    ]  # fmt: skip
    return told + [f"| {name} | {count:,} |" for name, count in hit_rate().items()]


def main(file: Path) -> None:
    vrw.start_jax()
    processor = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
         if line.startswith("model name")), platform.processor(),
    )  # fmt: skip
    lines = [
        "# What limit cycles cost, and how often they are found", "",
        f"`python experiments/cycle_benchmark.py`; {processor}, jax {jax.__version__}. CPU "
        "seconds, one core; wall times on two. On a shared machine the same code has taken up to "
        "1.5 times more or less.",
    ]  # fmt: skip
    for section in (compiling, batches, alone, finding):
        lines += ["", *section()]
        print("\n".join(lines[-8:]), flush=True)
        file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/cycles.md"))

"""Measure the speed of the library that is first on the path, for one turn of `compare_checkouts`.

It uses only the public interface, and no other experiment.
"""

import json
import time
from collections.abc import Callable

import jax
import numpy as np

import vrw_jax as vrw

N_DRAWN_WHEELS, N_LANES, N_CYCLES, N_SAMPLES = 12288, 4096, 1024, (2048, 6144)
N_REPEATS, MAX_SECONDS = 25, 1.0
MEASURES = ("dls_fraction", "speed", "period", "lambda_I4", "lambda_4_plus")


def seconds(call: Callable[[], object]) -> float:
    """Return the least CPU time of several calls, s; the first call, which compiles, does not
    count."""
    jax.block_until_ready(call())
    durations: list[float] = []
    while not durations or (len(durations) < N_REPEATS and sum(durations) < MAX_SECONDS):
        began = time.process_time()
        jax.block_until_ready(call())
        durations.append(time.process_time() - began)
    return min(durations)


def draw_wheels() -> dict[str, np.ndarray]:
    """Return random wheels, of which about six in ten have a gait."""
    draw = np.random.default_rng(1).uniform
    return {
        "damping": draw(100.0, 215.0, N_DRAWN_WHEELS),
        "stiffness": draw(400.0, 600.0, N_DRAWN_WHEELS),
        "natural_length": draw(1.01, 1.04, N_DRAWN_WHEELS),
        "slope": draw(0.28, 0.34, N_DRAWN_WHEELS),
    }


def turn() -> None:
    """Print the path of the library, its figures by name, and the number of lanes without a
    failure."""
    vrw.start_jax()
    find = jax.jit(jax.vmap(lambda rows: vrw.limit_cycle(vrw.WheelParams(**rows))))
    wheels = draw_wheels()
    every = find(wheels)
    with_gait = np.asarray(every.found) & (np.asarray(every.durations)[:, 0] > 0.0)
    wheels = {name: values[with_gait] for name, values in wheels.items()}
    first = lambda n: {name: values[:n] for name, values in wheels.items()}
    gaits = jax.tree.map(lambda leaf: leaf[with_gait][:N_LANES], every)
    draw = np.random.default_rng(3).uniform
    params, selection = vrw.WheelParams(**first(N_LANES)), first(N_CYCLES)
    states = np.asarray(gaits.section_state) * draw(0.99, 1.01, (N_LANES, 3))
    by_lanes = lambda: vrw.step_batch(params, states)
    cycles = lambda: find(selection)
    scan = lambda n: vrw.scan(vrw.samples(first(n)), MEASURES)
    short_time, long_time = (seconds(lambda n=n: scan(n)) for n in N_SAMPLES)
    result_by_name = {
        "gait steps per s, lanes": N_LANES / seconds(by_lanes),
        "cycles per s, cold guess": N_CYCLES / seconds(cycles),
        "samples per s, scan": (N_SAMPLES[1] - N_SAMPLES[0]) / (long_time - short_time),
    }
    ended = {
        "lanes": int(np.sum(np.asarray(by_lanes().outcome) == 0)),
        "cycles": int(np.sum(np.asarray(cycles().found))),
    }
    print(json.dumps({"where": vrw.__file__, "told": result_by_name, "ended": ended}))

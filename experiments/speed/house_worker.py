"""One turn of `house_benchmark`: how fast the library is that stands first on the path, old or new.

It knows the public face alone, and nothing of the experiments beside it.
"""

import json
import time
from collections.abc import Callable

import jax
import numpy as np

import vrw_jax as vrw

DRAWN, LANES, CYCLES, SAMPLES = 12288, 4096, 1024, (2048, 6144)
REPEATS, ENOUGH = 25, 1.0  # at most so many calls, s
MEASURES = ("dls_fraction", "speed", "period", "lambda_I4", "lambda_4_plus")


def seconds(call: Callable[[], object]) -> float:
    """CPU time of a call: the least of some, after one that compiles; others share the machine."""
    jax.block_until_ready(call())
    taken: list[float] = []
    while not taken or (len(taken) < REPEATS and sum(taken) < ENOUGH):
        began = time.process_time()
        jax.block_until_ready(call())
        taken.append(time.process_time() - began)
    return min(taken)


def drawn() -> dict[str, np.ndarray]:
    """Random wheels; of these some six in ten have a gait."""
    draw = np.random.default_rng(1).uniform
    return {
        "damping": draw(100.0, 215.0, DRAWN),
        "stiffness": draw(400.0, 600.0, DRAWN),
        "natural_length": draw(1.01, 1.04, DRAWN),
        "slope": draw(0.28, 0.34, DRAWN),
    }


def turn() -> None:
    """Prints where the library lies, figures by name, and how many lanes came to an end."""
    vrw.start_jax()
    find = jax.jit(jax.vmap(lambda rows: vrw.limit_cycle(vrw.WheelParams(**rows))))
    wheels = drawn()
    every = find(wheels)
    with_gait = np.asarray(every.found) & (np.asarray(every.durations)[:, 0] > 0.0)
    wheels = {name: values[with_gait] for name, values in wheels.items()}
    first = lambda n: {name: values[:n] for name, values in wheels.items()}
    gaits = jax.tree.map(lambda leaf: leaf[with_gait][:LANES], every)
    draw = np.random.default_rng(3).uniform
    params, some = vrw.WheelParams(**first(LANES)), first(CYCLES)
    states = np.asarray(gaits.section_state) * draw(0.99, 1.01, (LANES, 3))
    expected = np.asarray(gaits.durations) * draw(0.99, 1.01, (LANES, 3))
    by_lanes = lambda: vrw.steps(params, states)
    known = {"engine": "collocation", "durations": expected}
    by_collocation = lambda: vrw.steps(params, states, **known)
    cycles = lambda: find(some)
    scan = lambda n: vrw.scan(vrw.samples(first(n)), MEASURES)
    few, many = (seconds(lambda n=n: scan(n)) for n in SAMPLES)
    told = {
        "gait steps per s, lanes": LANES / seconds(by_lanes),
        "gait steps per s, collocation": LANES / seconds(by_collocation),
        "cycles per s, cold guess": CYCLES / seconds(cycles),
        "samples per s, scan": (SAMPLES[1] - SAMPLES[0]) / (many - few),
    }
    ended = {
        "lanes": int(np.sum(np.asarray(by_lanes().outcome) == 0)),
        "collocation": int(np.sum(np.asarray(by_collocation().fixed))),
        "cycles": int(np.sum(np.asarray(cycles().found))),
    }
    print(json.dumps({"where": vrw.__file__, "told": told, "ended": ended}))

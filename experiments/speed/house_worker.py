"""One turn of `house_benchmark`: how fast the library is that stands first on the path, old or new.

It knows the public face alone, and nothing of the experiments beside it.
"""

import json
import statistics
import time
from collections.abc import Callable

import jax
import numpy as np

import vrw_jax as vrw

LANES, CYCLES, SAMPLES = 4096, 1024, (2048, 6144)
REPEATS, ENOUGH = 15, 0.6  # at most so many calls, s
MEASURES = ("dls_fraction", "speed", "period", "lambda_I4", "lambda_4_plus")


def seconds(call: Callable[[], object]) -> float:
    """CPU time of a call: the median of some, after one that compiles."""
    jax.block_until_ready(call())
    taken: list[float] = []
    while not taken or (len(taken) < REPEATS and sum(taken) < ENOUGH):
        began = time.process_time()
        jax.block_until_ready(call())
        taken.append(time.process_time() - began)
    return statistics.median(taken)


def drawn(n: int, seed: int) -> dict[str, np.ndarray]:
    """Wheels that walk with double support, nearly all."""
    draw = np.random.default_rng(seed).uniform
    return {
        "damping": draw(100.0, 215.0, n),
        "stiffness": draw(400.0, 600.0, n),
        "natural_length": draw(1.01, 1.04, n),
        "slope": draw(0.28, 0.34, n),
    }


def scanned(n: int) -> object:
    """A scan of so many wheels, in memory."""
    return vrw.scan(vrw.samples(drawn(n, 5)), MEASURES)


def turn() -> None:
    """Prints where the library lies, figures by name, and how many lanes came to an end."""
    vrw.start_jax()
    find = jax.jit(jax.vmap(lambda rows: vrw.limit_cycle(vrw.WheelParams(**rows))))
    wheels, some = drawn(LANES, 1), drawn(CYCLES, 2)
    gaits = find(wheels)
    draw = np.random.default_rng(3).uniform
    params = vrw.WheelParams(**wheels)
    states = np.asarray(gaits.section_state) * draw(0.99, 1.01, (LANES, 3))
    expected = np.asarray(gaits.durations) * draw(0.99, 1.01, (LANES, 3))
    by_lanes = lambda: vrw.steps(params, states)
    known = {"engine": "collocation", "durations": expected}
    by_collocation = lambda: vrw.steps(params, states, **known)
    cycles = lambda: find(some)
    few, many = (seconds(lambda n=n: scanned(n)) for n in SAMPLES)
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

"""Compare three ways to integrate 4,096 double pendulums: `lanes.jit`, `jax.vmap` and numba.

    python -m experiments.speed.pendulum_benchmark

Each pendulum takes its own number of adaptive Dormand-Prince 5(4) steps from a random start. The
three programs use one algorithm and one tolerance, so they have equal errors, which the command
measures against SciPy's DOP853 at a tolerance of 1e-13. Times are CPU seconds of one core without a
cache, and the three programs take turns. The command writes the table of `docs/developer/lanes.md`.
"""

import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.integrate import solve_ivp

from experiments.shared.command import make_parser, require_extra
from experiments.shared.tables import DOCS, describe_run, format_markdown, replace_block
from experiments.shared.timing import start_without_cache, use_one_core
from vrw_jax import lanes

N_PENDULUMS, DURATION, TOLERANCE, REPEATS = 4096, 3.0, 1e-9, 5
FIRST_STEP, SAFETY, MIN_FACTOR, MAX_FACTOR = 0.01, 0.9, 0.2, 5.0
GRAVITY = 9.81
"""Acceleration in m/s²; both rods have a length of 1 m and both masses 1 kg."""

TABLEAU = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
"""Coefficients of Dormand and Prince (1980); the last row gives the solution of fifth order."""
ERROR_WEIGHTS = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
"""Weights of the stages in the difference between the solutions of fifth and fourth order."""


def compute_rates(angle_1, angle_2, rate_1, rate_2, sin, cos):
    """Return the time derivatives of the angles and rates of a double pendulum."""
    s, c = sin(angle_1 - angle_2), cos(angle_1 - angle_2)
    force_1 = -s * rate_2 * rate_2 - 2.0 * GRAVITY * sin(angle_1)
    force_2 = s * rate_1 * rate_1 - GRAVITY * sin(angle_2)
    determinant = 2.0 - c * c
    return (
        rate_1,
        rate_2,
        (force_1 - c * force_2) / determinant,
        (2.0 * force_2 - c * force_1) / determinant,
    )


def integrate_pendulum(start: jax.Array) -> jax.Array:
    """Return the angles and rates of one pendulum after `DURATION`."""
    evaluate = lambda y: jnp.stack(compute_rates(*y, jnp.sin, jnp.cos))

    def take_step(carry: tuple) -> tuple:
        time_left, step, state, first_rate = carry
        step = jnp.minimum(step, time_left)
        rates = [first_rate]
        for row in TABLEAU:
            new_state = state + step * sum(a * k for a, k in zip(row, rates, strict=True))
            rates.append(evaluate(new_state))
        error = step * sum(e * k for e, k in zip(ERROR_WEIGHTS, rates, strict=True))
        scale = TOLERANCE * (1.0 + jnp.maximum(jnp.abs(state), jnp.abs(new_state)))
        ratio = jnp.sqrt(jnp.sum((error / scale) ** 2) / 4.0)
        root = jnp.exp(-0.2 * jnp.log(jnp.maximum(ratio, 1e-10).astype(jnp.float32)))
        factor = jnp.clip(SAFETY * root.astype(step.dtype), MIN_FACTOR, MAX_FACTOR)
        is_accepted = ratio <= 1.0
        return (
            jnp.where(is_accepted, time_left - step, time_left),
            step * factor,
            jnp.where(is_accepted, new_state, state),
            jnp.where(is_accepted, rates[-1], first_rate),
        )

    has_time_left = lambda carry: carry[0] > 0.0
    initial = (jnp.asarray(DURATION), jnp.asarray(FIRST_STEP), start, evaluate(start))
    return lax.while_loop(has_time_left, take_step, initial)[2]


def make_numba_program() -> Callable[[np.ndarray], np.ndarray]:
    """Return the same algorithm in numba, with one pendulum for each iteration of `prange`."""
    numba = require_extra("numba")
    numba.set_num_threads(1)
    evaluate = numba.njit(compute_rates)
    sin, cos = numba.njit(lambda x: math.sin(x)), numba.njit(lambda x: math.cos(x))
    tableau = np.zeros((7, 6))
    for row_index, row in enumerate(TABLEAU):
        tableau[row_index + 1, : len(row)] = row
    weights = np.array(ERROR_WEIGHTS)

    @numba.njit(parallel=True)
    def integrate(starts):
        results = np.empty_like(starts)
        for lane in numba.prange(len(starts)):
            rates, state, new_state = np.zeros((7, 4)), starts[lane].copy(), np.zeros(4)
            time_left, step = DURATION, FIRST_STEP
            rates[0] = evaluate(state[0], state[1], state[2], state[3], sin, cos)
            while time_left > 0.0:
                step = min(step, time_left)
                for stage in range(1, 7):
                    for i in range(4):
                        change = 0.0
                        for j in range(stage):
                            change += tableau[stage, j] * rates[j, i]
                        new_state[i] = state[i] + step * change
                    rates[stage] = evaluate(
                        new_state[0], new_state[1], new_state[2], new_state[3], sin, cos
                    )
                ratio = 0.0
                for i in range(4):
                    error = 0.0
                    for j in range(7):
                        error += weights[j] * rates[j, i]
                    scale = TOLERANCE * (1.0 + max(abs(state[i]), abs(new_state[i])))
                    ratio += (step * error / scale) ** 2 / 4.0
                ratio = math.sqrt(ratio)
                factor = SAFETY * max(ratio, 1e-10) ** -0.2
                if ratio <= 1.0:
                    time_left -= step
                    state[:] = new_state
                    rates[0] = rates[6]
                step *= min(max(factor, MIN_FACTOR), MAX_FACTOR)
            results[lane] = state
        return results

    return integrate


def compute_reference(starts: np.ndarray) -> np.ndarray:
    """Return the final states by SciPy's DOP853, one pendulum after another."""
    evaluate = lambda _, y: compute_rates(*y.tolist(), math.sin, math.cos)
    solve = lambda start: solve_ivp(
        evaluate, (0.0, DURATION), start, method="DOP853", rtol=1e-13, atol=1e-13
    )
    return np.array([solve(start).y[:, -1] for start in starts])


def main() -> None:
    make_parser(__doc__).parse_args()
    with use_one_core():
        start_without_cache()
        random = np.random.default_rng(0)
        starts = random.uniform((-2.0, -2.0, -1.0, -1.0), (2.0, 2.0, 1.0, 1.0), (N_PENDULUMS, 4))
        programs = {
            "`lanes.jit(f).batch`": lanes.jit(integrate_pendulum).batch,
            "`jax.jit(jax.vmap(f))`": jax.jit(jax.vmap(integrate_pendulum)),
            "numba, `prange` over pendulums": make_numba_program(),
        }
        seconds: dict[str, list[float]] = {name: [] for name in programs}
        results = {}
        for _ in range(1 + REPEATS):  # The first round compiles.
            for name, program in programs.items():
                began = time.process_time()
                results[name] = np.asarray(program(starts))
                seconds[name].append(time.process_time() - began)
        reference = compute_reference(starts)
    rows = []
    for name, (first, *later) in seconds.items():
        run = float(np.median(later))
        errors = np.max(np.abs(results[name] - reference), axis=1)
        rows.append(
            (name, f"{first - run:.1f}", f"{1e6 * run / N_PENDULUMS:.1f}",
             f"{np.percentile(errors, 99):.1e}", f"{errors.max():.1e}")
        )  # fmt: skip
        print(*rows[-1], flush=True)
    header = ("program", "compile, s", "run, µs a pendulum", "p99 error", "largest error")
    source = describe_run("experiments.speed.pendulum_benchmark")
    page = DOCS / "developer" / "lanes.md"
    replace_block(page, "double pendulums", format_markdown(header, rows), source)


if __name__ == "__main__":
    main()

"""Gaits of walkers, and what repeats in general: return maps of hybrid systems by four methods.

This library solves its map by Newton's method and differentiates it; a peer's map is solved by
SciPy's `fsolve` and differentiated by central differences, as its users do.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import fsolve

import vrw_jax as vrw
from experiments.atlas.hybrid import METHODS, MethodRun, Part, modes
from experiments.atlas.results import time_second_call
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import flow_jacobian_determinant, simulate_hybrid

DIFFERENCE = 1e-5
"""Of a peer's central differences, of fourth order: those of second are off in the sixth digit
where a foot grazes."""


class ReturnMap(NamedTuple):
    """A system seen from event to event."""

    system: Sequence[Part]
    begin: Callable[[Sequence[Any], Any], Sequence[Any]]  # section's numbers to state
    read: Callable[[Sequence[Any]], Sequence[Any]]  # state to section's numbers
    events: int  # until it is back
    guess: Sequence[float]
    limit: float = 20.0


class ExactGait(NamedTuple):
    """A gait as many_digits.py finds it: section, time until it is back, multipliers by size."""

    x: tuple[float, ...]
    period: float
    multipliers: tuple[complex, ...]


class Gait(NamedTuple):
    """What a method found; `walked` is its last step."""

    simulation: MethodRun
    x: np.ndarray
    jacobian: np.ndarray
    product: float  # of its multipliers: ours by Liouville's formula, a peer's the determinant
    duration: float

    @property
    def multipliers(self) -> np.ndarray:
        values = np.linalg.eigvals(self.jacobian)
        return values[np.argsort(-np.abs(values), kind="stable")]


def find_by_newton(result: ReturnMap) -> Gait:
    """Find the gait by this library's Newton method."""
    parts = modes(result.system)
    options = vrw.StepOptions(rtol=1e-13, atol=1e-13, max_phase_time=result.limit)

    begin = lambda x: jnp.stack([jnp.asarray(v, float) for v in result.begin(x, jnp)])
    once = functools.partial(simulate_hybrid, parts, events=result.events, options=options)

    def back(x: jax.Array) -> jax.Array:
        return jnp.stack(result.read(once(begin(x)).state))

    def product(x: jax.Array) -> jax.Array:
        return flow_jacobian_determinant(parts, begin(x), once(begin(x)), options)

    solution, seconds = time_second_call(
        lambda: jax.block_until_ready(
            jax.jit(lambda x: solve_fixed_point(back, x, tolerance=1e-11))(jnp.array(result.guess))
        )
    )
    x = np.asarray(solution.x)
    walk_result = METHODS[0](result.system, result.begin(x, math), result.events, result.limit)
    says = walk_result.says if solution.converged else "Newton did not converge"
    walk_result = walk_result._replace(
        says=says, admits=bool(~solution.converged) or walk_result.admits, seconds=seconds,
        work=int(solution.n_iterations), options=f"{walk_result.options}; Newton 1e-11",
    )  # fmt: skip
    jacobian, around_values = np.asarray(solution.jacobian), float(jax.jit(product)(solution.x))
    return Gait(walk_result, x, jacobian, around_values, _duration(walk_result, result))


def find_by_differences(method: Callable[..., MethodRun], result: ReturnMap) -> Gait:
    """Find the gait by `fsolve` with the map of another library."""

    def walked(x: np.ndarray) -> MethodRun:
        return method(result.system, result.begin(x, math), result.events, result.limit)

    def back(x: np.ndarray) -> np.ndarray:
        return np.array(result.read(walked(x).end), float)

    def solve() -> tuple:
        return fsolve(lambda x: back(x) - x, result.guess, xtol=1e-12, full_output=True)

    (x, info, flag, message), seconds = time_second_call(solve)
    shifts = DIFFERENCE * np.eye(len(x))
    near = [back(x + shift) - back(x - shift) for shift in shifts]
    far = [back(x + 2.0 * shift) - back(x - 2.0 * shift) for shift in shifts]
    columns = [(8.0 * a - b) / (12.0 * DIFFERENCE) for a, b in zip(near, far, strict=True)]
    last = walked(x)
    says = last.says or ("" if flag == 1 else f"fsolve: {' '.join(message.split())[:70]}")
    last = last._replace(
        says=says, admits=last.admits or flag != 1, seconds=seconds, work=int(info["nfev"]),
        options=f"{last.options}; fsolve 1e-12, differences over {DIFFERENCE:g}",
    )  # fmt: skip
    jacobian = np.stack(columns, 1)
    return Gait(last, x, jacobian, float(np.linalg.det(jacobian)), _duration(last, result))


def _duration(walk_result: MethodRun, result: ReturnMap) -> float:
    return (
        float(walk_result.times[result.events - 1])
        if len(walk_result.times) >= result.events
        else math.nan
    )


def gaits(result: ReturnMap) -> list[Gait]:
    """Yield the gait by each method, with this library first."""
    return [
        find_by_newton(result),
        *(find_by_differences(method, result) for method in METHODS[1:]),
    ]

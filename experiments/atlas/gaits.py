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
from experiments.atlas.hybrid import METHODS, Part, Walked, modes
from experiments.atlas.told import timed
from vrw_jax.numerics import newton_cycle, volume_change, walk

DIFFERENCE = 1e-5
"""Of a peer's central differences, of fourth order: those of second are off in the sixth digit
where a foot grazes."""


class Return(NamedTuple):
    """A system seen from event to event."""

    system: Sequence[Part]
    begin: Callable[[Sequence[Any], Any], Sequence[Any]]  # section's numbers to state
    read: Callable[[Sequence[Any]], Sequence[Any]]  # state to section's numbers
    events: int  # until it is back
    guess: Sequence[float]
    limit: float = 20.0


class Exact(NamedTuple):
    """A gait as many_digits.py finds it: section, time until it is back, multipliers by size."""

    x: tuple[float, ...]
    period: float
    multipliers: tuple[complex, ...]


class Gait(NamedTuple):
    """What a method found; `walked` is its last step."""

    walked: Walked
    x: np.ndarray
    jacobian: np.ndarray
    product: float  # of its multipliers: ours by Liouville's formula, a peer's the determinant
    duration: float

    @property
    def multipliers(self) -> np.ndarray:
        values = np.linalg.eigvals(self.jacobian)
        return values[np.argsort(-np.abs(values), kind="stable")]


def by_newton(told: Return) -> Gait:
    """This library's own."""
    parts = modes(told.system)
    options = vrw.Options(rtol=1e-13, atol=1e-13, max_phase_time=told.limit)

    begin = lambda x: jnp.stack([jnp.asarray(v, float) for v in told.begin(x, jnp)])
    once = functools.partial(walk, parts, events=told.events, options=options)

    def back(x: jax.Array) -> jax.Array:
        return jnp.stack(told.read(once(begin(x)).state))

    def product(x: jax.Array) -> jax.Array:
        return volume_change(parts, begin(x), once(begin(x)), options)

    found, seconds = timed(
        lambda: jax.block_until_ready(
            jax.jit(lambda x: newton_cycle(back, x, tolerance=1e-11))(jnp.array(told.guess))
        )
    )
    x = np.asarray(found.x)
    walked = METHODS[0](told.system, told.begin(x, math), told.events, told.limit)
    says = walked.says if found.converged else "Newton did not converge"
    walked = walked._replace(
        says=says, admits=bool(~found.converged) or walked.admits, seconds=seconds,
        work=int(found.iterations), options=f"{walked.options}; Newton 1e-11",
    )  # fmt: skip
    jacobian, around = np.asarray(found.jacobian), float(jax.jit(product)(found.x))
    return Gait(walked, x, jacobian, around, _duration(walked, told))


def by_differences(method: Callable[..., Walked], told: Return) -> Gait:
    """A peer's map under `fsolve`."""

    def walked(x: np.ndarray) -> Walked:
        return method(told.system, told.begin(x, math), told.events, told.limit)

    def back(x: np.ndarray) -> np.ndarray:
        return np.array(told.read(walked(x).end), float)

    def solve() -> tuple:
        return fsolve(lambda x: back(x) - x, told.guess, xtol=1e-12, full_output=True)

    (x, info, flag, message), seconds = timed(solve)
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
    return Gait(last, x, jacobian, float(np.linalg.det(jacobian)), _duration(last, told))


def _duration(walked: Walked, told: Return) -> float:
    return float(walked.times[told.events - 1]) if len(walked.times) >= told.events else math.nan


def gaits(told: Return) -> list[Gait]:
    """By all methods, this library first."""
    return [by_newton(told), *(by_differences(method, told) for method in METHODS[1:])]

"""Derivatives of a gait step by other programs, for comparison with the library's machine code.

The derivatives are those of section state and durations with respect to the section state, c, k, L*
and phi. heyoka integrates variational equations, and this module adds the parts of events and
resets (saltation). numba's steps give central differences. As in `peers`, a step starts just after
the landing, and the derivatives of the landing are given.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from experiments.shared.command import require_extra
from experiments.shared.wheels import make_wheels
from experiments.speed import peers
from vrw_jax.wheel import transitions

hy = require_extra("heyoka")

COLUMNS = 7
"""Section state, then c, k, L*, phi: the order of `experiments.shared.wheels.PARAMETER_BOX`."""


def compute_landing(rows: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return theta, its rate and the distance of the feet after the landing, for each lane."""
    landing = transitions.resolve_landing(make_wheels(rows).symbols(), *np.asarray(states).T)
    return np.stack(
        [landing.theta_after_landing, landing.motion_after.dtheta, landing.foot_distance], 1
    )


def compute_landing_with_tangents(
    rows: np.ndarray, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the result of `compute_landing` and its derivatives, shape (lanes, 3, COLUMNS)."""

    def one(given: jax.Array) -> jax.Array:
        landing = transitions.resolve_landing(make_wheels(given[3:]).symbols(), *given[:3])
        return jax.numpy.stack(
            [landing.theta_after_landing, landing.motion_after.dtheta, landing.foot_distance]
        )

    columns = jax.jit(jax.vmap(jax.jacfwd(one)))(np.concatenate([states, rows], 1))
    return compute_landing(rows, states), np.asarray(columns)


def numba_differences(
    rows: np.ndarray, states: np.ndarray, tolerance: float, share: float
) -> Callable[[], np.ndarray]:
    """Return central differences, with each number changed by a `share` of its size in Table 1's
    gait."""
    size = share * np.array([0.3, 1.0, 1.0, 100.0, 500.0, 1.0, 0.3])
    shifted_rows = []
    for column, sign in np.ndindex(COLUMNS, 2):
        change = np.zeros(COLUMNS)
        change[column] = size[column] * (1 - 2 * sign)
        x, wheel = states + change[:3], rows + change[3:]
        shifted_rows.append((compute_landing(wheel, x)[:, :2], peers.pack(make_wheels(wheel))))

    def run() -> np.ndarray:
        displaced_results = [peers.numba_steps(*each, tolerance)[:, :6] for each in shifted_rows]
        return np.stack(
            [(a - b) for a, b in zip(displaced_results[::2], displaced_results[1::2], strict=True)],
            2,
        ) / (2.0 * size)

    return run


class _Phase:
    """Flow of one phase with its variational equations, up to its event and through its reset."""

    def __init__(
        self,
        system: list[tuple[Any, Any]],
        guard: Any,
        after: list,
        moving: list,
        tolerance: float,
    ) -> None:
        self.state, slopes = map(list, zip(*system, strict=True))
        self.n, self.moving = len(system), moving
        events = [hy.t_event(guard, direction=hy.event_direction.negative)]
        equations = hy.var_ode_sys(system, [*self.state, *moving], order=1)
        start = [1.0] * self.n
        self.flow = hy.taylor_adaptive(equations, start, tol=tolerance, t_events=events)
        self.identity = self.flow.state[self.n :].copy()
        by_input = [*self.state, *moving]
        rows = [*slopes, *(hy.diff(guard, x) for x in by_input), *after]
        rows += [hy.diff(y, x) for y in after for x in by_input]
        self.evaluate_end, self.n_after = hy.cfunc(rows, self.state), len(after)

    def __call__(
        self, x: np.ndarray, dx: np.ndarray, numbers: np.ndarray, dnumbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        """Return the state after the phase with its derivatives, and the duration with its
        derivatives."""
        flow, n, m = self.flow, self.n, len(self.moving)
        flow.reset_cooldowns()
        flow.time, flow.pars[:] = 0.0, numbers[: len(flow.pars)]
        flow.state[:n], flow.state[n:] = x, self.identity
        flow.propagate_until(20.0)
        shifted = flow.state[n:].reshape(n, n + m) @ np.concatenate([dx, dnumbers])
        result = self.evaluate_end(flow.state[:n], pars=numbers[: self.evaluate_end.nparams])
        slopes, by_guard = result[:n], result[n : 2 * n + m]
        after = result[2 * n + m : 2 * n + m + self.n_after]
        by_after = result[2 * n + m + self.n_after :].reshape(self.n_after, n + m)
        later_value = -(by_guard @ np.concatenate([shifted, dnumbers])) / (by_guard[:n] @ slopes)
        shifted = shifted + np.outer(slopes, later_value)
        return after, by_after @ np.concatenate([shifted, dnumbers]), flow.time, later_value


class HeyokaVariations:
    """Taylor integrators with variational equations, one for each phase."""

    def __init__(self, tolerance: float) -> None:
        p = [hy.par[i] for i in range(10)]
        slope, distance = hy.par[7], hy.par[10]
        p[7], p[8] = hy.sin(slope), hy.cos(slope)
        th, L1, L2, w, v1, v2 = hy.make_vars("th", "L1", "L2", "w", "v1", "v2")
        sin, cos = hy.sin(th), hy.cos(th)
        dls = peers.double_support(sin, cos, w, distance, p)
        x1, x2, x3 = peers.single_support_1(sin, cos, L1, L2, w, v1, v2, p)
        z1, z2 = peers.single_support_2(sin, cos, L1, w, v1, p)
        height = L1 * cos - p[2] * (cos * peers.CA + sin * peers.SA)
        mass = peers.terms(0.0, 1.0, L1, p[2], 0.0, 0.0, 0.0, p)[0]
        hit = [w - p[0] * peers.SA * L1 * v2 / mass, v1 - p[0] * peers.CA * v2 / p[9]]
        moving = [hy.par[5], hy.par[4], hy.par[3], slope]  # c, k, L*, phi
        make = lambda *parts: _Phase(*parts, tolerance)
        self.phases = (
            make([(th, w), (w, dls[0])], dls[1], [th, dls[2], dls[3], w, dls[4], dls[5]],
                 [*moving, distance]),
            make([(th, w), (L1, v1), (L2, v2), (w, x1), (v1, x2), (v2, x3)], p[2] - L2,
                 [th, L1, *hit], moving),
            make([(th, w), (L1, v1), (w, z1), (v1, z2)], height, [th, w, v1], moving),
        )  # fmt: skip

    def make_run(self, rows: np.ndarray, states: np.ndarray) -> Callable[[], np.ndarray]:
        """Return a function that computes the derivatives of these lanes, shape (lanes, 6,
        COLUMNS)."""
        x, dx = compute_landing_with_tangents(rows, states)
        numbers = np.concatenate([peers.pack(make_wheels(rows)), x[:, 2:]], 1)
        numbers[:, 7] = rows[:, 3]
        unit = np.eye(COLUMNS)[3:]

        def run() -> np.ndarray:
            out = np.empty((len(rows), 6, COLUMNS))
            for lane in range(len(rows)):
                y, dy = x[lane, :2], dx[lane, :2]
                for place, phase in enumerate(self.phases):
                    moving = np.concatenate([unit, dx[lane, 2:]]) if place == 0 else unit
                    y, dy, _, out[lane, 3 + place] = phase(y, dy, numbers[lane], moving)
                out[lane, :3] = dy
            return out

        return run

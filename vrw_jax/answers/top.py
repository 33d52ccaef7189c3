"""Steps of the highest model, unilateral contact, in batches and without derivatives."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.models import LOCKED, STICK, UnilateralWheel, as_full_states, least_dip, walk_lanes
from vrw_jax.numerics import Options
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams

TIGHT, TIGHTER = 1e-10, 1e-12
"""Tolerances of steps. Looser ones save a seventh of the time but miss events; the tighter one
costs a third more."""
LOOSE = 3e-6
"""Tolerance of walks by Tsit5, whose steps cost a quarter. At 1e-5, three gaits in 118 are
missed."""
OPINIONS = {TIGHT: (TIGHTER, 1e-11, 3e-11), TIGHTER: (1e-13, 3e-12, 1e-11)}
"""Other tolerances for comparison if feet may dip."""


class Stepped(NamedTuple):
    """Result of a step of some elements."""

    x: np.ndarray  # (elements, 4 + 3 n): section state after it; zeros if it failed
    told: np.ndarray  # (elements, 7)
    outcome: np.ndarray


@dataclasses.dataclass(frozen=True)
class Ground:
    """Batch of wheels with unilateral contact, each with its own friction."""

    columns: np.ndarray  # (10, elements): parameters and friction
    n: int  # number of legs
    model: UnilateralWheel
    options: Options

    @classmethod
    def of(
        cls, params: WheelParams, friction: np.ndarray, stoppers: str, options: Options
    ) -> "Ground":
        columns = [*(np.asarray(getattr(params, name)) for name in PARAMETER_NAMES), friction]
        model = UnilateralWheel(stoppers=stoppers)  # type: ignore[arg-type]
        return cls(np.stack(columns), params.n_legs, model, options)

    def embedded(self, lanes: np.ndarray, x: np.ndarray, rigid: Any = False) -> np.ndarray:
        """Return full section states from the paper's, (elements, 3), with Leg 1 on its stopper
        where `is_rigid`."""
        full = np.array(as_full_states(self.columns[:, lanes], x, self.n))
        full[:, 4 + 2 * self.n] += np.where(rigid, LOCKED, 0)
        return full

    def step(self, lanes: np.ndarray, x: np.ndarray, n_steps: int = 1) -> Stepped:
        """Take steps from full section states."""
        columns = self.columns[:, lanes]
        y, durations, outcome, *_, length = walk_lanes(
            columns, x, n_steps, self.model, self.options, self.n
        )
        told = np.column_stack([durations, length, y[:, self.plane()]])
        return Stepped(y, told, outcome)

    def loosely(self) -> "Ground":
        """Return the batch with steps for walks."""
        return dataclasses.replace(self, options=Options(solver="Tsit5", rtol=LOOSE, atol=LOOSE))

    def otherwise(self) -> list["Ground"]:
        """Return the batch with steps at other tolerances."""
        own = TIGHTER if float(self.options.rtol) < 0.5 * TIGHT else TIGHT
        options = [Options(rtol=tolerance, atol=tolerance) for tolerance in OPINIONS[own]]
        return [dataclasses.replace(self, options=each) for each in options]

    def shortest(self, lanes: np.ndarray) -> np.ndarray:
        """Return the time that a foot is off the ground in the smallest resolved dip, s."""
        value = lambda name: self.columns[PARAMETER_NAMES.index(name)]
        dip = np.asarray(least_dip(jnp.asarray(value("locked_length")), self.options))
        return np.sqrt(8.0 * dip / value("gravity"))[lanes]

    def free(self, x: np.ndarray) -> np.ndarray:
        """Return which numbers of section states are free for the given legs' codes, (elements, 4 +
        2 n).

        The other numbers are determined by them. The hub's rates follow from a sticking foot, Leg
        1's length from touchdown, and the lengths of legs on their stoppers from the stoppers.
        """
        n = self.n
        code = np.round(x[:, 4 + 2 * n :]).astype(int)
        free = np.zeros((len(x), 4 + 2 * n), bool)
        free[:, :2] = free[:, 4 + n] = True
        free[:, 2] = code[:, 0] != STICK
        free[:, 3] = free[:, 4] = code[:, 0] % LOCKED == 0
        off = code[:, 1:] < LOCKED
        free[:, 5 : 4 + n], free[:, 5 + n :] = off, off
        return free

    def consistent(self, x: np.ndarray) -> np.ndarray:
        """Return section states with the numbers that follow from the free ones: see
        `free_coordinates`."""
        n, x = self.n, x.copy()
        theta, code = x[:, 0], np.round(x[:, 4 + 2 * n]).astype(int)
        foot = code % LOCKED
        height = x[:, 3 + n] * np.cos(theta - 2.0 * np.pi / n)  # of the hub, from the landing leg
        sin, cos, rate, along = np.sin(theta), np.cos(theta), x[:, 1], x[:, 4 + n]
        x[:, 4] = np.where((foot != 0) & (code < LOCKED), height / cos, x[:, 4])
        length = x[:, 4]
        x[:, 2] = np.where(foot == STICK, along * sin + length * rate * cos, x[:, 2])
        x[:, 3] = np.where(foot != 0, along * cos - length * rate * sin, x[:, 3])
        return x

    def plane(self) -> np.ndarray:
        """Return the indices of the paper's section state in a full one."""
        return np.array([0, 1, 4 + self.n])

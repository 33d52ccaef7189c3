"""Real ground, the top rung, as values of one step in lanes; nothing here is differentiated."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from vrw_jax.models import LOCKED, STICK, UnilateralWheel, as_full_states, least_dip, walk_lanes
from vrw_jax.numerics import Options
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams

TIGHT, TIGHTER = 1e-10, 1e-12
"""Tolerances of steps. Looser ones save a seventh of the time and miss events; the tighter one
costs a third more."""
LOOSE = 3e-6
"""Of walks, by Tsit5, whose steps cost a quarter. Three gaits in 118 are missed at 1e-5."""
OPINIONS = {TIGHT: (TIGHTER, 1e-11, 3e-11), TIGHTER: (1e-13, 3e-12, 1e-11)}
"""Tolerances of others, where feet may dip."""


class Stepped(NamedTuple):
    """A step of some lanes."""

    x: np.ndarray  # (lanes, 4 + 3 n): section state after it; zeros where it failed
    told: np.ndarray  # (lanes, 7): its quantities
    outcome: np.ndarray


@dataclasses.dataclass(frozen=True)
class Ground:
    """Wheels on ground of their own friction, lane by lane."""

    columns: np.ndarray  # (10, lanes): parameters and friction
    n: int  # legs
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
        """Full section states of the paper's, (lanes, 3), where `rigid` with Leg 1 on its stopper,
        too."""
        full = np.array(as_full_states(self.columns[:, lanes], x, self.n))
        full[:, 4 + 2 * self.n] += np.where(rigid, LOCKED, 0)
        return full

    def step(self, lanes: np.ndarray, x: np.ndarray, n_steps: int = 1) -> Stepped:
        """From full section states."""
        columns = self.columns[:, lanes]
        y, durations, outcome, *_, length = walk_lanes(
            columns, x, n_steps, self.model, self.options, self.n
        )
        told = np.column_stack([durations, length, y[:, self.plane()]])
        return Stepped(y, told, outcome)

    def loosely(self) -> "Ground":
        """With steps for walks."""
        return dataclasses.replace(self, options=Options(solver="Tsit5", rtol=LOOSE, atol=LOOSE))

    def otherwise(self) -> list["Ground"]:
        """With steps at other tolerances."""
        own = TIGHTER if float(self.options.rtol) < 0.5 * TIGHT else TIGHT
        options = [Options(rtol=tolerance, atol=tolerance) for tolerance in OPINIONS[own]]
        return [dataclasses.replace(self, options=each) for each in options]

    def shortest(self, lanes: np.ndarray) -> np.ndarray:
        """Of each lane the time that a foot is off the ground in the least dip that is followed."""
        value = lambda name: self.columns[PARAMETER_NAMES.index(name)]
        dip = np.asarray(least_dip(jnp.asarray(value("locked_length")), self.options))
        return np.sqrt(8.0 * dip / value("gravity"))[lanes]

    def free(self, x: np.ndarray) -> np.ndarray:
        """Numbers of section states that are free where their legs' codes hold, (lanes, 4 + 2 n).

        The others follow from them: the hub's rates from a foot that sticks, Leg 1's length from
        touchdown, those of legs on their stoppers from these.
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
        """Section states with what follows from the free numbers: see `free`."""
        n, x = self.n, x.copy()
        theta, code = x[:, 0], np.round(x[:, 4 + 2 * n]).astype(int)
        foot = code % LOCKED
        height = x[:, 3 + n] * np.cos(theta - 2.0 * np.pi / n)  # of the hub, by the landing leg
        sin, cos, rate, along = np.sin(theta), np.cos(theta), x[:, 1], x[:, 4 + n]
        x[:, 4] = np.where((foot != 0) & (code < LOCKED), height / cos, x[:, 4])
        length = x[:, 4]
        x[:, 2] = np.where(foot == STICK, along * sin + length * rate * cos, x[:, 2])
        x[:, 3] = np.where(foot != 0, along * cos - length * rate * sin, x[:, 3])
        return x

    def plane(self) -> np.ndarray:
        """Places of the paper's section state among the numbers of a full one."""
        return np.array([0, 1, 4 + self.n])

"""Continuation problems of the wheel's gaits, and the measures of their points.

`CollocationProblem` is the fast one: the collocation system of the paper's sequence of phases, with
one linearized pass per Newton iteration. `GroundProblem` uses batched steps with unilateral
contact. `ReturnMapProblem` works for every model: it iterates the model's step and differentiates
it in forward mode.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from vrw_jax.cycles import (
    Located,
    Periods,
    Problem,
    correction_size,
    nothing_known,
    over_lanes,
    solved,
    takeoff_acceleration,
)
from vrw_jax.models import AbstractStep, AbstractWheel, RungState, UnilateralWheel
from vrw_jax.numerics import (
    AbstractFollowed,
    Linear,
    Options,
    PathPoint,
    Scalar,
    Section,
    Solution,
    Unknown,
    arclength,
    mesh_error,
    one_wheel,
)
from vrw_jax.results import MARGINS, STOPPERS
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Outcome,
    WheelParams,
    parameters_of,
    wheel_of,
)


class Wheel(NamedTuple):
    """Wheel whose gaits are continued, at any value of the continued parameter."""

    params: WheelParams
    happens: Float[Array, "n n_phases"]  # 1 if a phase of the cycle takes place, else 0


class AbstractFollowedWheel(AbstractFollowed):
    """Continuation problem of gaits of `n_steps` steps along the float parameter `name`."""

    name: eqx.AbstractVar[str]

    @property
    @abc.abstractmethod
    def n_steps(self) -> int:
        """Return the number of steps after which the gait repeats."""

    @abc.abstractmethod
    def read(self, wheel: Wheel, z: Unknown, p: Scalar) -> tuple[RungState, dict[str, Array]]:
        """Return the section state before the first landing, and quantities that are defined beyond
        a special point."""

    def told(
        self, model: AbstractWheel, options: Options, wheels: Wheel, points: PathPoint
    ) -> dict[str, Array]:
        """Return all measures of the gaits at many points from event-driven steps, with those of
        `read_state`."""
        return _told(self, model, options, wheels, points)


@eqx.filter_jit
def _told(
    followed: AbstractFollowedWheel,
    model: AbstractWheel,
    options: Options,
    wheels: Wheel,
    points: PathPoint,
) -> dict[str, Array]:
    def one(wheel: Wheel, z: Any, p: Array) -> dict[str, Array]:
        x, beyond = followed.read(wheel, z, p)
        rung, params = model.moved(wheel.params, followed.name, p)
        measures = gait_measures(rung, params, x, options, followed.n_steps)
        return measures | beyond | {"section_state": x}

    return jax.vmap(one)(wheels, points.z, points.p)


class CycleFollowed(AbstractFollowedWheel):
    """Continuation problem of limit cycles by collocation. z is a `CollocationSolution` without the
    axis over lanes.

    Beyond an indicator's zero the formal solution continues; the event-driven step rejects it as a
    gait.
    """

    problem: Problem = eqx.field(static=True)
    name: str = eqx.field(static=True)
    more: Callable | None = eqx.field(static=True)  # of the first step's passages and z

    @property
    def n_steps(self) -> int:
        return self.problem.period_n

    def _moved(self, wheel: Wheel, p: Scalar) -> Array:
        return parameters_of(eqx.tree_at(lambda w: getattr(w, self.name), wheel.params, p))

    def linearise(self, wheel: Wheel, z: Unknown, p: Scalar) -> Linear:
        linearised = linearised_along(self.problem, (PARAMETER_NAMES.index(self.name),))
        correction, column, monodromy, *_ = linearised(self._moved(wheel, p), wheel.happens, z)
        return Linear(correction, jax.tree.map(lambda x: x[0], column), monodromy)

    def _mesh_error(self, z: Solution) -> Array:
        lanes = jax.tree.map(lambda x: x[..., None], z)
        return mesh_error(self.problem.sequence, self.problem.meshes, lanes)[0]

    def section(self, z: Unknown) -> Section:
        return z.section

    def size(self, z: Unknown, correction: Unknown) -> Scalar:
        return one_wheel(correction_size)(z, correction)

    def valid(self, wheel: Wheel, z: Unknown, p: Scalar) -> Bool[Array, ""]:
        """Return whether the durations are positive. The event-driven step checks everything
        else."""
        return jnp.all((z.durations > 0.0) | (wheel.happens < 0.5))

    def read(self, wheel: Wheel, z: Unknown, p: Scalar) -> tuple[RungState, dict[str, Array]]:
        """Return the section state, and quantities that continue beyond a special point.

        These are the shortest durations over the steps, and `takeoff_acceleration`, the rear foot's
        acceleration at take-off, m/s^2, least over the steps.
        """
        parameters = self._moved(wheel, p)
        s = wheel_of(parameters, self.problem.n_legs).symbols()
        _, steps = self.problem.passages(parameters, z)
        takeoffs = [takeoff_acceleration(s, sls1) for _, sls1, _ in steps]
        end, shortest = steps[-1][-1].end, jnp.min(z.durations, 0)
        formal = {
            "duration_dls": jnp.where(wheel.happens[0, 0] > 0.5, shortest[0], jnp.nan),
            "duration_sls1": shortest[1],
            "duration_sls2": shortest[2],
            "takeoff_acceleration": jnp.min(jnp.stack(takeoffs)),
            "mesh_error": self._mesh_error(z),
        }
        if self.more is not None:
            formal |= self.more(s, steps[0], z)
        return jnp.stack([end.q[0], *end.v]), formal


Told = Callable[[Problem, Array, Array, Solution], Array]
"""Function of the system, parameters, `phase_active` and solution that returns quantities of
collocated gaits over lanes."""


def linearised_along(problem: Problem, wanted: tuple[int, ...], told: Told | None = None) -> Any:
    """Return a function for correction, tangents of the parameters and monodromy of one wheel's
    trial.

    With `quantities_of` it also returns those quantities at the trial, and their derivatives along
    the correction and along each tangent. Its arguments are (parameters, phase_active, solution);
    `jax.vmap` maps it over lanes.
    """

    def linearised(parameters: Array, happens: Array, z: Solution) -> tuple:
        located = Located(z, happens, *nothing_known(problem, z.section))
        passed = problem.pass_at(parameters, located, wanted)
        found = passed.correction, passed.columns, passed.monodromy
        if told is None:
            return found
        rows = np.eye(parameters.shape[0], dtype=parameters.dtype)[list(wanted)]
        units = np.concatenate([np.zeros_like(rows[:1]), rows])[:, :, None]
        lead = lambda a, b: jnp.concatenate([a[None], b])
        columns = jax.tree.map(lead, passed.correction, passed.columns)
        ways = jnp.broadcast_to(units, (len(units), *parameters.shape)), columns
        at = lambda parameters, z: told(problem, parameters, happens, z)
        along = lambda way: jax.jvp(at, (parameters, z), way)[1]
        return *found, at(parameters, z), lax.map(along, ways)

    like = lambda parameters, happens, z: (z, z, *(parameters,) * (1 if told is None else 3))
    settings = "followed", problem, wanted, told.__name__ if told else ""
    return one_wheel(over_lanes(linearised, like, settings, block=0))


class RungFollowed(AbstractFollowedWheel):
    """Continuation problem of fixed points of `period_n` steps of any model; z is the section
    state.

    The codes at its end (`AbstractWheel.n_continuous`) are those of the image of the last
    iteration. Newton's method ends only if they agree.
    """

    model: AbstractWheel
    options: Options
    name: str = eqx.field(static=True)
    period_n: int = eqx.field(static=True)
    numbers: int = eqx.field(static=True)

    @property
    def n_steps(self) -> int:
        return self.period_n

    def _image(self, wheel: Wheel, z: Array, p: Scalar) -> Array:
        model, params = self.model.moved(wheel.params, self.name, p)
        for _ in range(self.period_n):
            advance = model.advance(params, z, self.options)
            z = jnp.where(advance.outcome == Outcome.STEPPED, advance.section_state, jnp.nan)
        return z

    def linearise(self, wheel: Wheel, z: Unknown, p: Scalar) -> Linear:
        image = lambda z, p: self._image(wheel, z, p)
        return arclength.at_fixed_point(image, z, p, self.numbers)

    def section(self, z: Unknown) -> Section:
        return z[: self.numbers]

    def between(self, left: Unknown, right: Unknown, place: Scalar) -> Unknown:
        return between_states(left, right, place, self.numbers)

    def read(self, wheel: Wheel, z: Unknown, p: Scalar) -> tuple[RungState, dict[str, Array]]:
        """Return the section state. The step's measures contain all other quantities."""
        return z, {}


class GroundFollowed(AbstractFollowedWheel):
    """Continuation problem with unilateral contact, by batched steps; z as in
    `ReturnMapProblem`."""

    model: UnilateralWheel
    options: Options
    name: str = eqx.field(static=True)
    period_n: int = eqx.field(static=True)
    n_legs: int = eqx.field(static=True)

    traced: ClassVar[bool] = False

    @property
    def n_steps(self) -> int:
        return self.period_n

    @property
    def numbers(self) -> int:
        return self.model.section_numbers(WheelParams(n_legs=self.n_legs))

    def values(self, wheels: Wheel, p: Array) -> Array:
        """Return the model's parameter values of many wheels with the continued parameter at p."""

        def one(wheel: Wheel, p: Array) -> Array:
            model, params = self.model.moved(wheel.params, self.name, p)
            return model.values(params)

        return jax.vmap(one)(wheels, p)

    def _periods(self, wheels: Wheel, p: Array) -> Periods:
        values = np.asarray(self.values(wheels, p))
        return Periods(self.model, self.n_legs, self.period_n, values)

    def linearise(self, wheel: Wheel, z: Unknown, p: Array) -> Linear:
        """Return the Newton steps of many wheels."""
        x, n = np.asarray(z), self.numbers
        own = np.asarray(self.model.parameter_names) == self.name
        now = self._periods(wheel, p).around(self.options, x, own)
        bad = np.where(now.good, 0.0, np.nan)[:, None]
        miss, by_x = now.image - x + bad, now.by_start[:, :n, :n]
        right = np.concatenate([miss[:, :n, None], now.by_values[:, :n, own]], -1)
        found, codes = solved(np.eye(n) - by_x, right), miss[:, n:]
        correction = np.concatenate([found[..., 0], codes], 1)
        column = np.concatenate([found[..., 1], 0.0 * codes], 1)
        return Linear(correction, column, jnp.asarray(by_x))

    def section(self, z: Unknown) -> Section:
        return z[: self.numbers]

    def between(self, left: Unknown, right: Unknown, place: Scalar) -> Unknown:
        return between_states(left, right, place, self.numbers)

    def read(self, wheel: Wheel, z: Unknown, p: Scalar) -> tuple[RungState, dict[str, Array]]:
        return z, {}

    def told(
        self, model: AbstractWheel, options: Options, wheels: Wheel, points: PathPoint
    ) -> dict[str, Array]:
        now = self._periods(wheels, points.p).around(options, np.asarray(points.z), False, False)
        return _of_period(now.steps, points.z) | {"section_state": jnp.asarray(points.z)}


@jax.jit
@jax.vmap
def _of_period(steps: AbstractStep, x: RungState) -> dict[str, Array]:
    return period_measures(steps.section_state[-1], jax.vmap(lambda s: s.measures())(steps), x)


def between_states(left: Array, right: Array, place: Scalar, numbers: int) -> Array:
    """Interpolate section states. The codes are those of the nearer one."""
    codes = jnp.where(place < 0.5, left, right)[numbers:]
    return jnp.concatenate([(left + place * (right - left))[:numbers], codes])


def gait_measures(
    model: AbstractWheel, params: WheelParams, x: RungState, options: Options, period_n: int
) -> dict[str, Array]:
    """Return all measures of one period of a gait that passes the section at x, with `closure`.

    Indicators and margins are minima over the steps, durations and energies are sums. Section and
    post-impact state are those of the last and first step. `outcome` is that of the first step that
    failed. `closure` is the distance of the section state from x after the period.
    """

    def one(x: RungState, _: None) -> tuple[RungState, dict[str, Array]]:
        result = model.step(params, x, options)
        return result.section_state, result.measures()

    end, steps = lax.scan(one, x, None, length=period_n)
    return period_measures(end, steps, x)


def period_measures(end: RungState, steps: dict[str, Array], x: RungState) -> dict[str, Array]:
    """Return `measure_gait` from the measures of each step and the final section state."""
    told = {}
    for name, values in steps.items():
        if name in MARGINS | STOPPERS or name.startswith("lambda_"):
            told[name] = jnp.min(values, 0)
        elif name.endswith("_touchdown"):
            told[name] = values[-1]
        elif name.endswith("_post_impact"):
            told[name] = values[0]
        elif name == "outcome":
            told[name] = values[jnp.argmax(values != Outcome.STEPPED)]
        else:
            told[name] = jnp.sum(values, 0)
    period = jnp.where(told["period"] > 0.0, told["period"], 1.0)
    told["dls_fraction"] = told["duration_dls"] / period
    told["speed"] = told["step_length"] / period
    return told | {"closure": jnp.max(jnp.abs(end - x))}

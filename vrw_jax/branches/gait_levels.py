"""Quantities of collocated gaits over two parameters, each of whose zeros is a border.

Trial, columns, quantities and their slopes come from one call of machine code; margins that only an
event-driven step tells come from steps.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from vrw_jax.branches.continuation import INDICATORS, GaitRun
from vrw_jax.branches.followed import CycleFollowed, Wheel, gait_measures, linearised_along
from vrw_jax.cycles import (
    Located,
    Problem,
    correction_size,
    nothing_known,
    takeoff_acceleration,
)
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import (
    BIFURCATIONS,
    AbstractLevel,
    LevelLinear,
    Options,
    Passage,
    Scalar,
    Section,
    Solution,
    margins_beside_fold,
    one_wheel,
)
from vrw_jax.results import MARGINS
from vrw_jax.wheel import (
    PARAMETER_NAMES,
    Instant,
    Symbols,
    parameters_of,
    phases_of,
    transitions,
    wheel_of,
)

EXACT: Mapping[str, str] = GaitRun.exact
VOID = (*INDICATORS, "duration_sls1", "duration_sls2")
"""Where one of these vanishes the step itself goes one way or the other: what it says is void."""

ROLLS_OFF = "duration_dls"
"""The border where double support comes to last no time: the rear foot's force vanishes there and
falls. Where it vanishes and rises, at that of `lambda_4_plus`, the step jumps."""

FALLS, JUMPS = "fall of the rear foot's force at first", "its mean fall in double support"
"""N/s. The first is positive on `ROLLS_OFF`, which ends where it is zero. The second vanishes on
the border of `lambda_4_plus`, and not on `ROLLS_OFF`, which solves the same equations besides."""

FORMAL = (*VOID, *EXACT.values(), FALLS, JUMPS)
"""Quantities of the collocated gait itself, which go on beyond the border."""


def level_of(name: str, rolls: bool) -> str:
    """The quantity that is solved for at a border; `rolls`: of gaits with double support."""
    if name == "lambda_4_plus" and rolls:
        return JUMPS
    return "lambda_4_plus" if name == ROLLS_OFF else EXACT.get(name, name)


def quantities_of(name: str, n_legs: int) -> tuple[str, ...]:
    """The quantities that are told together with the one that vanishes at a border."""
    legs = [f"[{leg}]" for leg in range(3, n_legs + 1)]
    by_step = [n + leg for n, margin in MARGINS.items() for leg in (legs if margin.axis else [""])]
    kinds = BIFURCATIONS, FORMAL, tuple(name for name in by_step if name not in FORMAL)
    return next(kind for kind in kinds if level_of(name, True) in kind)


class GaitAt(NamedTuple):
    """The wheel whose border is followed, and which of the level's quantities is its border."""

    gait: Wheel
    place: Array


class GaitLevel(AbstractLevel):
    """One of `quantities` of collocated gaits over two parameters."""

    problem: Problem = eqx.field(static=True)
    names: tuple[str, str] = eqx.field(static=True)
    quantities: tuple[str, ...] = eqx.field(static=True)  # BIFURCATIONS, FORMAL or a step's
    model: ViscoelasticWheel
    step_options: Options

    def linearise(self, wheel: GaitAt, z: Solution, p: Array) -> LevelLinear:
        gait = wheel.gait
        wanted = tuple(PARAMETER_NAMES.index(name) for name in self.names)
        linearised = linearised_along(self.problem, wanted, TOLD.get(self.quantities))
        given = parameters_of(self.at(gait, p).params), gait.happens, z
        correction, columns, monodromy, *told = linearised(*given)
        first, second = (jax.tree.map(lambda x, i=i: x[i], columns) for i in range(2))
        if told:
            value, slopes = told
            if self.quantities == BIFURCATIONS:
                push = lambda d: jax.jvp(margins_beside_fold, (value,), (d,))
                value, slopes = jax.vmap(push, out_axes=(None, 0))(slopes)
            value, slopes = value + slopes[0], slopes[1:]
        else:
            value, slopes = self._by_steps(gait, z, p, correction, (first, second))
        value, slopes = value[wheel.place], slopes[:, wheel.place]
        return LevelLinear(correction, (first, second), monodromy, value, slopes)

    def _by_steps(
        self, gait: Wheel, z: Solution, p: Array, correction: Solution, columns: tuple
    ) -> tuple[Array, Array]:
        """What steps tell of the corrected gait, and its slopes by both parameters.

        Newton's method needs slopes to few digits: steps beside the trial have them for less than
        derivatives of the step, and on the same machine code as the step itself. Beside a fold
        columns grow beyond bounds and turn parallel, and corrections follow them: steps are taken
        along an orthonormal basis, from where the columns' plane is nearest to the trial.
        """
        ahead = jnp.stack([p[i] * self.section(column) for i, column in enumerate(columns)])
        basis, triangle = jnp.linalg.qr(jnp.concatenate([ahead, jnp.eye(2, dtype=p.dtype)], 1).T)
        mixed = p[:, None] * jnp.linalg.inv(triangle)
        here = basis[:-2].T @ self.section(correction)

        def beside(place: Array) -> Array:
            by = mixed @ (place - here)
            along = lambda x, dx, a, b: x + dx + by[0] * a + by[1] * b
            return self.told(gait, jax.tree.map(along, z, correction, *columns), p + by)

        places = DIFFERENCE * jnp.eye(3, 2, -1, p.dtype)
        told = jax.vmap(beside)(places)
        slopes = (told[1:] - told[0]) / DIFFERENCE
        return told[0] + here @ slopes, triangle.T @ slopes / p[:, None]

    def at(self, gait: Wheel, p: Array) -> Wheel:
        """The wheel with both parameters as they are at p."""
        params = gait.params
        for name, value in zip(self.names, p, strict=True):
            params = self.model.moved(params, name, value)[1]
        return gait._replace(params=params)

    @property
    def gaits(self) -> CycleFollowed:
        """The gaits along the first parameter alone."""
        return CycleFollowed(problem=self.problem, name=self.names[0], more=_named)

    def told(self, gait: Wheel, z: Solution, p: Array) -> Array:
        """Those of the quantities that the step tells, one after another."""
        params = self.at(gait, p).params
        x = self.gaits.read(gait._replace(params=params), z, p[0])[0]
        told = gait_measures(self.model, params, x, self.step_options, 1)
        rows = [(told[name.partition("[")[0]], name.partition("[")[2]) for name in self.quantities]
        return jnp.stack([row[int(leg[:-1]) - 3] if leg else row for row, leg in rows])

    def section(self, z: Solution) -> Section:
        return z.section

    def size(self, z: Solution, correction: Solution) -> Scalar:
        return one_wheel(correction_size)(z, correction)

    def valid(self, wheel: GaitAt, z: Solution, p: Array) -> Array:
        return jnp.all((z.durations > -ROUNDING) | (wheel.gait.happens < 0.5))


@eqx.filter_jit
def where_jumps_begin(level: GaitLevel, gait: Wheel, z: Solution, p: Array) -> tuple[Array, Array]:
    """Both parameters where `ROLLS_OFF` meets the border of `lambda_4_plus`, and how they settled.

    From a gait and parameters near there. The equations of both are singular where double support
    lasts no time; those of the same gait without it are not, and the rear foot's force and its fall
    vanish there at once.
    """
    gait = gait._replace(happens=gait.happens.at[0, 0].set(0.0))
    z = z._replace(durations=z.durations.at[0, 0].set(0.0))
    both = [jnp.asarray(FORMAL.index(name)) for name in ("lambda_4_plus", FALLS)]

    def nearer(at: tuple, _: None) -> tuple[tuple, Array]:
        z, p = at
        force, falls = (level.linearise(GaitAt(gait, place), z, p) for place in both)
        slopes = jnp.stack([force.slopes, falls.slopes])
        by = -jnp.linalg.solve(slopes, jnp.stack([force.value, falls.value]))
        along = lambda x, dx, a, b: x + dx + by[0] * a + by[1] * b
        return (jax.tree.map(along, z, force.correction, *force.columns), p + by), by / p

    (_, p), changes = lax.scan(nearer, (z, p), None, length=ITERATIONS)
    return p, jnp.max(jnp.abs(changes[-1]))


def _formal(problem: Problem, parameters: Array, happens: Array, z: Solution) -> Array:
    s = wheel_of(parameters, problem.n_legs).symbols()
    (passages,) = problem.passages(parameters, z)[1]
    return jnp.stack(list(_named(s, passages, z).values()))


def _named(s: Symbols, passages: Any, z: Solution) -> dict[str, Array]:
    dls, sls1, sls2 = passages
    landing = transitions.land(s, sls2.end.q[0], *sls2.end.v)
    fore, rear = transitions.landing_forces(s, landing)
    lasts, *others = z.durations[0]
    forces = landing.rear.normal, fore.normal, rear.normal
    told = *forces, *others, takeoff_acceleration(s, sls1), *_falls(s, dls, lasts)
    return dict(zip(FORMAL, told, strict=True))


def _falls(s: Symbols, dls: Passage, lasts: Array) -> tuple[Array, Array]:
    phase = phases_of(s, dls.start.held[0], stop_at_lift_off=False)[0]

    def instant(theta: Array, dtheta: Array) -> Instant:
        return Instant(phase, phase.at((theta,), (dtheta,)), None)

    force = lambda *at: phase.end(instant(*at))
    begin, end = (*dls.start.q, *dls.start.v), (*dls.end.q, *dls.end.v)
    rates = begin[1], instant(*begin).acceleration.ddtheta
    at_first, rises = jax.jvp(force, begin, rates)
    mean = (at_first - force(*end)) / jnp.where(lasts == 0.0, 1.0, lasts)
    return -rises, mean


def _monodromy(problem: Problem, parameters: Array, happens: Array, z: Solution) -> Array:
    located = Located(z, happens, *nothing_known(problem, z.section))
    return problem.pass_at(parameters, located).monodromy


ITERATIONS = 8
"""Of Newton's method for one point."""

ROUNDING = 1e-9
"""Of a duration that is zero all along a curve, s."""

DIFFERENCE = 1e-6
"""Of section and parameters, these over their values, for slopes of what only a step tells."""

TOLD = {FORMAL: _formal, BIFURCATIONS: _monodromy}
"""By what a level's quantities are read, where it is not the step."""

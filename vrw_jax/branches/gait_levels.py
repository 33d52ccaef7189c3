"""Test functions of collocated gaits over two parameters, whose zeros are special points.

Trial, tangents, quantities and their derivatives come from one call of machine code. Margins that
need an event-driven step come from steps.
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
"""Quantities at whose zeros the step is discontinuous, so that its measures are not defined."""

ROLLS_OFF = "duration_dls"
"""Special point where the duration of double support reaches zero: the rear foot's force vanishes
there and falls. If it vanishes and rises, at the zero of `lambda_4_plus`, the step jumps."""

FALLS, JUMPS = "fall of the rear foot's force at first", "its mean fall in double support"
"""Names of two rates, N/s. The first is positive on `DLS_VANISHES`, which ends at its zero. The
second vanishes on the curve of `lambda_4_plus`, and not on `DLS_VANISHES`, which solves the same
equations too."""

FORMAL = (*VOID, *EXACT.values(), FALLS, JUMPS)
"""Quantities of the collocated gait itself, which continue beyond the special point."""


def level_of(name: str, rolls: bool) -> str:
    """Return the quantity whose zero is the special point; `has_double_support` refers to the
    gaits."""
    if name == "lambda_4_plus" and rolls:
        return JUMPS
    return "lambda_4_plus" if name == ROLLS_OFF else EXACT.get(name, name)


def quantities_of(name: str, n_legs: int) -> tuple[str, ...]:
    """Return the quantities that are evaluated together with the one that vanishes at a special
    point."""
    legs = [f"[{leg}]" for leg in range(3, n_legs + 1)]
    by_step = [n + leg for n, margin in MARGINS.items() for leg in (legs if margin.axis else [""])]
    kinds = BIFURCATIONS, FORMAL, tuple(name for name in by_step if name not in FORMAL)
    return next(kind for kind in kinds if level_of(name, True) in kind)


class GaitAt(NamedTuple):
    """Wheel on a curve of special points, and the index of the quantity that vanishes on it."""

    gait: Wheel
    place: Array


class GaitLevel(AbstractLevel):
    """One of `quantities` of collocated gaits as a test function over two parameters."""

    problem: Problem = eqx.field(static=True)
    names: tuple[str, str] = eqx.field(static=True)
    quantities: tuple[str, ...] = eqx.field(static=True)  # of one quantity group
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
        """Return the step's quantities of the corrected gait, and their derivatives with respect to
        both parameters.

        Newton's method needs the derivatives to a few digits. Finite differences of steps cost less
        than derivatives of the step, and use the same machine code. Next to a fold the tangents
        grow without bound and become parallel, and so do the corrections. The differences are
        therefore taken along an orthonormal basis, from the point of the tangents' plane that is
        nearest to the trial.
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
        """Return the wheel with both parameters at p."""
        params = gait.params
        for name, value in zip(self.names, p, strict=True):
            params = self.model.moved(params, name, value)[1]
        return gait._replace(params=params)

    @property
    def gaits(self) -> CycleFollowed:
        """Return the continuation problem of the gaits along the first parameter alone."""
        return CycleFollowed(problem=self.problem, name=self.names[0], more=_named)

    def told(self, gait: Wheel, z: Solution, p: Array) -> Array:
        """Return those quantities that come from the step, in order."""
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
    """Return both parameters where `DLS_VANISHES` meets the curve of `lambda_4_plus`, and the last
    relative change.

    The start is a gait and parameters nearby. The equations of both curves are singular where
    double support has zero duration. The equations of the same gait without double support are
    regular, and the rear foot's force and its rate vanish there together.
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
"""Number of Newton iterations for one point."""

ROUNDING = 1e-9
"""Round-off of a duration that is zero along a whole curve, s."""

DIFFERENCE = 1e-6
"""Finite difference of section and relative parameters, for derivatives of quantities of the
step."""

TOLD = {FORMAL: _formal, BIFURCATIONS: _monodromy}
"""Functions for the quantities of a test function that need no event-driven step."""

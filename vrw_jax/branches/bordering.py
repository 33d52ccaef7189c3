"""Borders of gaits as curves in two parameters, through turning points, with what they meet.

A border is where an indicator or a margin is zero, or a multiplier on the unit circle. It is solved
for together with the gait, so that a point of a curve is as exact as the gait is.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.branches.branch import Border
from vrw_jax.branches.continuation import ENDING, INDICATORS, GaitRun, continue_branch
from vrw_jax.branches.followed import CycleFollowed, Wheel, gait_measures
from vrw_jax.branches.run import BRANCH_POINT, AbstractRun, Strand, Table, run_all
from vrw_jax.cycles import (
    LimitCycle,
    Located,
    Problem,
    correction_size,
    nothing_known,
)
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import (
    BIFURCATIONS,
    AbstractLevel,
    ArclengthOptions,
    LevelFollowed,
    LevelLinear,
    LevelPoint,
    Options,
    PathPoint,
    Scalar,
    Section,
    Solution,
    margins_beside_fold,
    multipliers,
    one_wheel,
)
from vrw_jax.results import MARGINS, attrs_of, provenance, require_known
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import PARAMETER_NAMES, WheelParams, parameters_of, transitions, wheel_of
from vrw_jax.wording import instance, range_of

Box = Mapping[str, tuple[float, float]]

BOX: Box = {
    "damping": (1.0, 250.0),
    "stiffness": (200.0, 1200.0),
    "natural_length": (1.001, 1.06),
    "slope": (0.05, 0.5),
}
"""Where borders are followed if nothing else is said; of a wheel with legs of 1 m."""

EXACT = GaitRun.exact
FORMAL = (*INDICATORS, *EXACT.values())
"""Quantities of the collocated gait itself, which go on beyond the border."""

EDGE = "edge of the box"
"""Column that is zero where the second parameter leaves its range."""


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
        over_lanes = functools.partial(_linearised, self.problem, wanted)
        parameters = parameters_of(self.at(gait, p).params)
        correction, columns, monodromy = one_wheel(over_lanes)(parameters, gait.happens, z)
        first, second = (jax.tree.map(lambda x, i=i: x[i], columns) for i in range(2))
        units = jnp.concatenate([jnp.zeros((1, 2), p.dtype), jnp.eye(2, dtype=p.dtype)])
        along = jax.tree.map(lambda *x: jnp.stack(x), correction, first, second)
        if self.quantities == BIFURCATIONS:
            value, slopes = self._of_multipliers(gait, z, p, monodromy, along, units)
        else:
            told = functools.partial(self.told, gait)
            push = lambda dz, dp: jax.jvp(told, (z, p), (dz, dp))
            value, slopes = jax.vmap(push, out_axes=(None, 0))(along, units)
        value, slopes = value[wheel.place], slopes[:, wheel.place]
        return LevelLinear(correction, (first, second), monodromy, value + slopes[0], slopes[1:])

    def at(self, gait: Wheel, p: Array) -> Wheel:
        """The wheel with both parameters as they are at p."""
        params = gait.params
        for name, value in zip(self.names, p, strict=True):
            params = self.model.moved(params, name, value)[1]
        return gait._replace(params=params)

    @property
    def gaits(self) -> CycleFollowed:
        """The gaits along the first parameter alone."""
        return CycleFollowed(problem=self.problem, name=self.names[0])

    def told(self, gait: Wheel, z: Solution, p: Array) -> Array:
        """The quantities at a point, one after another."""
        there = self.at(gait, p)
        x, formal = self.gaits.read(there, z, p[0])
        if self.quantities == FORMAL:
            s = there.params.symbols()
            landing = transitions.land(s, *x)
            fore, rear = transitions.landing_forces(s, landing)
            forces = landing.rear.normal, fore.normal, rear.normal
            return jnp.stack([*forces, *(formal[name] for name in EXACT.values())])
        told = gait_measures(self.model, there.params, x, self.step_options, 1)
        rows = [(told[name.partition("[")[0]], name.partition("[")[2]) for name in self.quantities]
        return jnp.stack([row[int(leg[:-1]) - 3] if leg else row for row, leg in rows])

    def _of_multipliers(
        self, gait: Wheel, z: Solution, p: Array, monodromy: Array, along: Solution, units: Array
    ) -> tuple[Array, Array]:
        """By complex step: see `cycles.derivatives`."""
        step = jnp.finfo(p.dtype).eps ** 2
        at = lambda p: parameters_of(self.at(gait, p).params)
        moves = jax.vmap(lambda dp: jax.jvp(at, (p,), (dp,))[1])(units)
        lanes = lambda x, dx: jnp.moveaxis(x + 1j * step * dx, 0, -1)
        moved = jax.tree.map(lambda x, dx: lanes(x[None], dx), z, along)
        happens = jnp.broadcast_to(gait.happens[..., None], (*gait.happens.shape, 3))
        located = Located(moved, happens, *nothing_known(self.problem, moved.section))
        passed = self.problem.pass_at(lanes(at(p)[None], moves), located)
        slopes = jnp.moveaxis(passed.monodromy.imag / step, -1, 0)
        push = lambda d: jax.jvp(margins_beside_fold, (monodromy,), (d,))
        return jax.vmap(push, out_axes=(None, 0))(slopes)

    def section(self, z: Solution) -> Section:
        return z.section

    def size(self, z: Solution, correction: Solution) -> Scalar:
        return one_wheel(correction_size)(z, correction)

    def valid(self, wheel: GaitAt, z: Solution, p: Array) -> Array:
        return self.gaits.valid(self.at(wheel.gait, p), z, p[0])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _linearised(
    problem: Problem, wanted: tuple[int, ...], parameters: Array, happens: Array, z: Solution
) -> tuple[Solution, Solution, Array]:
    located = Located(z, happens, *nothing_known(problem, z.section))
    passed = problem.pass_at(parameters, located, wanted)
    return passed.correction, passed.columns, passed.monodromy


@eqx.filter_jit
def _formal(level: GaitLevel, wheels: Wheel, z: Solution, p: Array) -> Array:
    return jax.vmap(level.told)(wheels, z, p)


@dataclass(frozen=True)
class BorderRun(AbstractRun):
    """Of borders: read as gaits are, but for the border itself."""

    followed: LevelFollowed
    name: str
    formal: GaitLevel  # of FORMAL
    gaits: GaitRun  # along the first parameter

    ending: ClassVar[tuple[str, ...]] = (*ENDING, EDGE)
    exact: ClassVar[Mapping[str, str]] = EXACT

    def read(self, wheels: GaitAt, points: PathPoint) -> Table:
        at = jax.tree.map(jnp.asarray, points.z)
        (z, share), second = at, self.followed.second(at)
        here = lambda params: getattr(params, self.formal.names[1])
        gaits = wheels.gait._replace(params=eqx.tree_at(here, wheels.gait.params, second))
        table = self.gaits.read(gaits, points._replace(z=z))
        told = _formal(self.formal, gaits, z, jnp.stack([points.p, second], -1))
        formal = dict(zip(FORMAL, np.asarray(told).T, strict=True))
        if self.name in INDICATORS:
            # On the border the step itself goes one way or the other: what it says is void.
            margins = {name for name in table if name.partition("[")[0] in MARGINS}
            table = {name: x for name, x in table.items() if name not in margins}
        shares = {EDGE: np.asarray(jnp.minimum(share, 1.0 - share)), "second": np.asarray(second)}
        return {n: x for n, x in (table | formal | shares).items() if not self.is_own(n)}

    def kept(self, table: Table) -> np.ndarray:
        known = [name for name in self.ending if name in table]
        good = np.all([~(table[name] <= 0.0) for name in known], axis=0)
        return good if self.name in INDICATORS else good & self.gaits.kept(table)

    def is_margin(self, name: str) -> bool:
        return self.gaits.is_margin(name)

    def is_own(self, name: str) -> bool:
        return name in (self.name, EXACT.get(self.name))

    def name_of_loss(self, table: Table, place: int) -> str:
        return self.gaits.name_of_loss(table, place)


@dataclass(frozen=True)
class Meeting:
    """A point of codimension two: a border's curve meets another border there."""

    name: str  # of the other border
    values: tuple[float, float]  # of the two parameters
    ends_curve: bool  # whether gaits end there

    def __str__(self) -> str:
        ends = ", ends the curve" if self.ends_curve else ""
        return f"({self.values[0]:.9g}, {self.values[1]:.9g}): meets {self.name}{ends}"


@dataclass(frozen=True, repr=False)
class BorderCurve:
    """A border in two parameters, its points in order along the dimension `point`.

    - `name`: of the border;
    - `parameters`: names of the two;
    - `dataset`: durations, spectral radius and section state along the curve;
    - `meetings`: where it meets other borders, points of codimension two;
    - `ends`: for either end why it was followed no further; both alike where it is closed.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.border_curve("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> curve.values.shape[1], curve.parameters
        (2, ('damping', 'stiffness'))
    """

    name: str
    parameters: tuple[str, str]
    dataset: xr.Dataset
    meetings: tuple[Meeting, ...]
    ends: tuple[str, str]

    @property
    def values(self) -> np.ndarray:
        """The two parameters at each point, (point, 2)."""
        return np.stack([self.dataset[name].values for name in self.parameters], -1)

    def __str__(self) -> str:
        first, second = self.parameters
        lines = [f"Border {self.name} over {first} and {second}: {len(self.values)} points."]
        for end, text in zip((0, -1), self.ends, strict=True):
            lines.append(f"  at ({self.values[end][0]:.6g}, {self.values[end][1]:.6g}): {text}")
        return "\n".join([*lines, *(f"    {meeting}" for meeting in self.meetings)])

    __repr__ = __str__


def border_curve(
    name: str,
    parameters: tuple[str, str],
    cycle: LimitCycle,
    *,
    bounds: Box | None = None,
    options: ArclengthOptions | None = None,
    step_options: Options | None = None,
) -> BorderCurve:
    """The border `name` as a curve over two parameters, nearest to a gait of one step.

    `name` is that of a `Border`: an indicator, a margin (of a locked leg "locked_stopper_force[5]")
    or "fold", "period_doubling", "neimark_sacker". The border is looked for along the first
    parameter from the gait, then along the second, and followed within `bounds` of the two, by
    default `branches.bordering.BOX`: through turning points, until it closes, leaves them, or the
    gaits end. Each point is exact to 1e-9; `meetings` are where other borders are met: on that of
    an indicator other indicators and bifurcations, on others margins too.

    Args:
        name: of the border.
        parameters: names of the two.
        cycle: the gait near which it is looked for.
        bounds: of the parameters, by name.
        options: `ArclengthOptions` of the curve.
        step_options: of the steps that tell margins.

    Returns:
        A `BorderCurve`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, or a border that is not met on the
            branches, in one sentence.

    Examples:
        >>> cycle = vrw.limit_cycle(vrw.WheelParams(damping=150.0))
        >>> curve = vrw.border_curve("clearance_sls1", ("damping", "stiffness"), cycle)
        >>> [meeting.name for meeting in curve.meetings[-3:-1]]
        ['fold', 'hit_planted_impulse']
    """
    (curve,) = border_curves(
        (name,), parameters, cycle, bounds=bounds, options=options, step_options=step_options
    )
    return curve


def border_curves(
    names: tuple[str, ...] | None,
    parameters: tuple[str, str],
    cycle: LimitCycle,
    *,
    bounds: Box | None = None,
    options: ArclengthOptions | None = None,
    step_options: Options | None = None,
) -> tuple[BorderCurve, ...]:
    """`border_curve` of several; with None of all that the two branches through the gait meet."""
    box = {**BOX, **(bounds or {})}
    first, second = parameters
    for parameter in parameters:
        require_known(parameter, tuple(box), "parameter with bounds")
        range_of(f"bounds[{parameter!r}]", box[parameter])
    instance("cycle", cycle, LimitCycle, "give vrw.limit_cycle(params)")
    if first == second or cycle.period_n != 1:
        raise ValueError("a border's curve needs two different parameters and a gait of one step.")
    params = wheel_of(cycle.parameters, cycle.problem.n_legs)
    found: dict[str, Border] = {}
    for parameter in parameters:
        if names is None or set(names) - set(found):
            at = float(getattr(params, parameter))
            branch = continue_branch(params, parameter, box[parameter], model=cycle.model)
            nearest = sorted(branch.borders, key=lambda border: -abs(border.value - at))
            found = {border.name: border for border in nearest if _can_follow(border.name)} | found
    missing = sorted(set(names or ()) - set(found))
    if missing:
        raise ValueError(
            f"no border {missing[0]!r} on the branches along {first} and {second} within their "
            f"bounds, but {', '.join(sorted(found)) or 'none'}: give a gait nearer to it, or wider "
            "bounds."
        )
    limits = np.array(box[first]), (float(box[second][0]), float(box[second][1]))
    options = ArclengthOptions(max_points=1000) if options is None else options
    step_options = Options.tight() if step_options is None else step_options
    return tuple(
        _curve(name, found[name], parameters, limits, options, step_options, cycle.model)
        for name in (found if names is None else names)
    )


def _can_follow(name: str) -> bool:
    return name in (*BIFURCATIONS, *INDICATORS) or name.partition("[")[0] in MARGINS


def _quantities(name: str) -> tuple[str, ...]:
    """The quantities that are told together with the one that vanishes at a border."""
    several = tuple(n for n, margin in MARGINS.items() if not margin.axis)
    kinds = BIFURCATIONS, FORMAL, several, (name,)
    return next(kind for kind in kinds if name in kind)


def _curve(
    name: str,
    border: Border,
    parameters: tuple[str, str],
    limits: tuple[np.ndarray, tuple[float, float]],
    options: ArclengthOptions,
    step_options: Options,
    model: ViscoelasticWheel,
) -> BorderCurve:
    start, (low, high) = border.cycle, limits[1]
    params = wheel_of(start.parameters, start.problem.n_legs)
    vanishing = EXACT.get(name, name)
    quantities = _quantities(vanishing)
    level = GaitLevel(start.problem, parameters, quantities, model, step_options)
    formal = GaitLevel(start.problem, parameters, FORMAL, model, step_options)
    lead = functools.partial(jax.tree.map, lambda x: jnp.asarray(x)[None])
    wheels = lead(
        GaitAt(Wheel(params, start.located.happens), jnp.asarray(quantities.index(vanishing)))
    )
    p, second = (float(getattr(params, parameter)) for parameter in parameters)
    z = lead(LevelPoint(start.located.solution, jnp.asarray((second - low) / (high - low))))
    gaits = GaitRun(
        level.gaits, options, wheels.gait, limits[0], model, step_options, params.n_legs
    )
    run = BorderRun(
        LevelFollowed(level, limits[1]), options, wheels, limits[0], name, formal, gaits
    )
    (strand,) = run_all(run, z, jnp.asarray([p]), np.array([True]), lambda owner, point: None)
    if strand is None:
        raise ValueError(f"the border {name} at {border.value:.9g} can't be followed from there.")
    return _labelled(name, parameters, limits[1], strand, params, model, step_options)


def _labelled(
    name: str,
    parameters: tuple[str, str],
    seconds: tuple[float, float],
    strand: Strand,
    params: WheelParams,
    model: ViscoelasticWheel,
    step_options: Options,
) -> BorderCurve:
    radius = np.abs(np.asarray(multipliers(jnp.asarray(strand.points.jacobian)))).max(-1)
    table = strand.table | {"spectral_radius": radius}
    rows = ("duration_dls", "duration_sls1", "duration_sls2", "spectral_radius")
    data: dict[str, Any] = {n: ("point", table[n], attrs_of(n)) for n in rows}
    data["mesh_error"] = ("point", table["mesh_error"])
    data["section_state"] = (("point", "component"), table["section_state"])
    values = np.asarray(strand.points.p), table["second"]
    labels = {
        parameter: ("point", value, attrs_of(parameter))
        for parameter, value in zip(parameters, values, strict=True)
    }
    origin = provenance(params, model, step_options)
    title = {"title": f"Border {name} over {' and '.join(parameters)}"}
    low, high = seconds
    told = lambda name: "fold" if name == BRANCH_POINT else name  # the curve need not turn there
    meetings = tuple(
        Meeting(told(met.name), (met.value, low + (high - low) * float(met.point.section[-1])),
                met.ends_branch)
        for met in strand.borders if met.name != EDGE
    )  # fmt: skip
    dataset = xr.Dataset(data, labels, title | origin)
    return BorderCurve(name, parameters, dataset, meetings, strand.ends)

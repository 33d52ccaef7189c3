"""Borders of gaits as curves in two parameters, through turning points, with what they meet.

A border is where an indicator or a margin is zero, or a multiplier on the unit circle. It is solved
for together with the gait, so that a point of a curve is as exact as the gait is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.branches.branch import Border
from vrw_jax.branches.continuation import (
    ENDING,
    GaitRun,
    continue_branches,
)
from vrw_jax.branches.followed import Wheel
from vrw_jax.branches.gait_levels import (
    EXACT,
    FORMAL,
    VOID,
    GaitAt,
    GaitLevel,
    formal_at,
    quantities_of,
)
from vrw_jax.branches.run import BRANCH_POINT, AbstractRun, Strand, Table, run_all
from vrw_jax.cycles import LimitCycle, Problem, on_mesh
from vrw_jax.models import ViscoelasticWheel
from vrw_jax.numerics import (
    BIFURCATIONS,
    ArclengthOptions,
    LevelFollowed,
    LevelPoint,
    Options,
    PathPoint,
    Solution,
)
from vrw_jax.results import MARGINS, attrs_of, provenance, require_known
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import DOMAINS, Outcome, WheelParams, wheel_of
from vrw_jax.wording import instance, names_of, range_of

Box = Mapping[str, tuple[float, float]]

BOX: Box = {
    "damping": (1.0, 250.0),
    "stiffness": (200.0, 1200.0),
    "natural_length": (1.001, 1.06),
    "slope": (0.05, 0.5),
}
"""Where borders are followed if nothing else is said; of a wheel with legs of 1 m."""

EDGE = "edge of the box"
"""Column that is zero where the second parameter leaves its range."""

ROUNDS = 3
"""How often what was met on the way to borders is followed in its turn, for a map of all."""

SIDE_BY_SIDE = 4
"""Curves in a batch, both ways each: one group of lanes of machine code, one shape to compile."""

FINER = 1
"""How often a curve is followed again on a mesh twice as fine, where its gaits ask for one."""

SAME = 2e-3
"""How near to a curve a point lies on it, lengths measured as along the curve."""


@dataclass(frozen=True)
class BorderRun(AbstractRun):
    """Of borders: read as gaits are, but for the border itself."""

    followed: LevelFollowed
    names: tuple[str, ...]  # of the borders, one for each wheel
    formal: GaitLevel  # of FORMAL
    gaits: GaitRun  # along the first parameter

    ending: ClassVar[tuple[str, ...]] = (*ENDING, EDGE)
    exact: ClassVar[Mapping[str, str]] = EXACT

    def read(self, wheels: GaitAt, points: PathPoint) -> Table:
        z, share = points.z
        second = np.asarray(self.followed.second(LevelPoint(z, jnp.asarray(share))))
        here = lambda params: getattr(params, self.formal.names[1])
        gaits = wheels.gait._replace(params=eqx.tree_at(here, wheels.gait.params, second))
        table = self.gaits.read(gaits, points._replace(z=z))
        told = formal_at(self.formal, gaits, z, np.stack([points.p, second], -1))
        formal = dict(zip(FORMAL, np.asarray(told).T, strict=True))
        shares = {EDGE: np.minimum(share, 1.0 - share), "second": second}
        return table | formal | shares

    def known(self, table: Table, owners: np.ndarray) -> Table:
        """What vanishes all along a curve has no zeros on it."""
        names = np.array(self.names)[owners]
        void = np.isin(names, VOID)
        by_step = {name for name in table if name.partition("[")[0] in MARGINS} - set(FORMAL)
        blank = {name: names == name for name in {*self.names} & {*table}}
        blank |= {exact: names == name for name, exact in EXACT.items()}
        blank |= {name: void | blank.get(name, False) for name in by_step}
        table = table | {
            name: np.where(rows if table[name].ndim == 1 else rows[:, None], np.nan, table[name])
            for name, rows in blank.items()
        }
        stepped = np.where(void, Outcome.STEPPED, table["outcome"])
        return table | {"outcome": stepped, "closure": np.where(void, 0.0, table["closure"])}

    def kept(self, table: Table) -> np.ndarray:
        good = np.all([~(table[name] <= 0.0) for name in self.ending], axis=0)
        return good & self.gaits.kept(table)

    def is_margin(self, name: str) -> bool:
        return self.gaits.is_margin(name)

    def is_rough(self, table: Table, ends: tuple[str, ...]) -> bool:
        return self.gaits.is_rough(table, ends)

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


def _plane(parameters: Any, bounds: Any) -> tuple[tuple[str, str], np.ndarray]:
    """The two parameters and their ranges, or one sentence."""
    instance("bounds", bounds, (Mapping, type(None)), "write {'damping': (100.0, 200.0)}")
    box = {**BOX, **(bounds or {})}
    pair = names_of("parameters", parameters)
    for name in box:
        require_known(name, tuple(DOMAINS), "parameter that has bounds")
    for name in pair:
        require_known(name, tuple(box), "parameter with bounds")
    if len(pair) != 2 or len(set(pair)) != 2:
        raise ValueError(
            f"parameters are {pair}, but a border's curve needs two different ones: write "
            "('damping', 'slope')."
        )
    ranges = {name: range_of(f"bounds[{name!r}]", ends) for name, ends in box.items()}
    return (pair[0], pair[1]), np.array([ranges[name] for name in pair], float)


def border_curves(
    names: tuple[str, ...] | None,
    parameters: tuple[str, str],
    cycle: LimitCycle,
    *,
    bounds: Box | None = None,
    options: ArclengthOptions | None = None,
    step_options: Options | None = None,
) -> tuple[BorderCurve, ...]:
    """`border_curve` of several; with None of all that branches through the box and curves meet."""
    parameters, box = _plane(parameters, bounds)
    first, second = parameters
    instance("cycle", cycle, LimitCycle, "give vrw.limit_cycle(params)")
    if cycle.period_n != 1:
        raise ValueError(f"the gait has {cycle.period_n} steps: a border's curve takes one step.")
    options = ArclengthOptions(max_points=1000) if options is None else options
    step_options = Options.tight() if step_options is None else step_options
    instance("options", options, ArclengthOptions, "give vrw.ArclengthOptions()")
    instance("step_options", step_options, Options, "give vrw.Options()")
    map_of = _Map(
        parameters,
        box,
        cycle.model,
        options,
        step_options,
    )
    params = wheel_of(cycle.parameters, cycle.problem.n_legs)
    if names is None:
        traced: list[_Traced] = []
        seeds = map_of.across(params, LINES)
        for _ in range(ROUNDS):
            more = map_of.followed(seeds, traced)
            traced, seeds = [*traced, *more], [seed for one in more for seed in one.met]
        return tuple(one.curve for one in traced)
    found: dict[str, _Seed] = {}
    for axis, parameter in enumerate(parameters):
        if set(names) - set(found):
            seeds = map_of.along(axis, jax.tree.map(lambda x: x[None], params))
            at = float(getattr(params, parameter))
            away = np.argsort([-abs(seed.at[axis] - at) for seed in seeds])
            found = {seeds[i].name: seeds[i] for i in away} | found
    missing = sorted(set(names) - set(found))
    if missing:
        raise ValueError(
            f"no border {missing[0]!r} on the branches along {first} and {second} within their "
            f"bounds, but {', '.join(sorted(found)) or 'none'}: give a gait nearer to it, or wider "
            "bounds."
        )
    told = {one.curve.name: one.curve for one in map_of.followed([found[n] for n in names], ())}
    lost = sorted(set(names) - set(told))
    if lost:
        raise ValueError(
            f"the border {lost[0]} at {found[lost[0]].at[0]:.9g} can't be followed from there."
        )
    return tuple(told[name] for name in names)


LINES = 5
"""Branches along each parameter on which a map of all borders begins."""


class _Seed(NamedTuple):
    """A point of a border from which it is followed."""

    name: str
    at: tuple[float, float]  # the two parameters
    problem: Problem
    gait: Wheel
    z: Solution


class _Traced(NamedTuple):
    """A curve, and what was met on it."""

    curve: BorderCurve
    path: np.ndarray  # the section's numbers and both parameters' shares, (point, number)
    met: tuple[_Seed, ...]


class _Map(NamedTuple):
    """Where borders are followed, and how."""

    parameters: tuple[str, str]
    box: np.ndarray  # (parameter, end)
    model: ViscoelasticWheel
    options: ArclengthOptions
    step_options: Options

    def across(self, params: WheelParams, count: int) -> list[_Seed]:
        """Of the branches through `count` wheels on either middle line of the box."""
        seeds = []
        middle = self.box.mean(1)
        for axis, name in enumerate(self.parameters):
            low, high = self.box[1 - axis]
            at = low + (np.arange(count) + 0.5) / count * (high - low)
            other = self.parameters[1 - axis]
            wheels = [self._moved(params, {name: middle[axis], other: x}) for x in at]
            seeds += self.along(axis, jax.tree.map(lambda *x: jnp.stack(x), params, *wheels))
        return seeds

    def _moved(self, params: WheelParams, values: Mapping[str, float]) -> WheelParams:
        for name, value in values.items():
            params = self.model.moved(params, name, jnp.asarray(value))[1]
        return params

    def along(self, axis: int, params: WheelParams) -> list[_Seed]:
        """Borders on the branches of these wheels along one of the parameters."""
        name, seeds = self.parameters[axis], []
        low, high = self.box[axis]
        for branch in continue_branches(params, name, (low, high), model=self.model):
            for border in branch.borders:
                if _can_follow(border.name):
                    seeds.append(self._seed(border))
        return seeds

    def _seed(self, border: Border) -> _Seed:
        start = border.cycle
        params = wheel_of(start.parameters, start.problem.n_legs)
        first, second = (float(getattr(params, name)) for name in self.parameters)
        gait, z = Wheel(params, start.located.happens), start.located.solution
        return _Seed(border.name, (first, second), start.problem, gait, z)

    def followed(self, seeds: Sequence[_Seed], known: Sequence[_Traced]) -> list[_Traced]:
        """The curves through all that lie on none of the curves known."""
        new: list[_Traced] = []
        fresh = [seed for seed in seeds if not any(self._on(seed, one) for one in known)]
        kinds = {quantities_of(seed.name, seed.problem.n_legs) for seed in fresh}
        for kind in sorted(kinds):
            of_kind = [s for s in fresh if quantities_of(s.name, s.problem.n_legs) == kind]
            while of_kind:
                some: list[_Seed] = []
                for seed in of_kind:  # in one batch each name once: others may lie on its curve
                    if seed.name not in {s.name for s in some} and len(some) < SIDE_BY_SIDE:
                        some.append(seed)
                told = self._batch(kind, some)
                new += told
                of_kind = [
                    seed for seed in of_kind
                    if not any(seed is s for s in some) and not any(self._on(seed, t) for t in told)
                ]  # fmt: skip
        return new

    def _on(self, seed: _Seed, traced: _Traced) -> bool:
        if seed.name != traced.curve.name:
            return False
        here = np.append(seed.z.section, (np.array(seed.at) - self.box[:, 0]) / np.ptp(self.box, 1))
        begin, chord = traced.path[:-1], np.diff(traced.path, axis=0)
        squared = np.maximum(np.sum(chord**2, 1), 1e-300)
        share = np.clip(np.sum((here - begin) * chord, 1) / squared, 0.0, 1.0)
        off = np.linalg.norm(begin + share[:, None] * chord - here, axis=1)
        return bool(np.min(off, initial=np.inf) < SAME)

    def _batch(self, kind: tuple[str, ...], seeds: list[_Seed]) -> list[_Traced]:
        """A curve through each that has one, on a mesh that is fine enough for it."""
        told: list[_Traced] = []
        for refinement in range(1 + FINER):
            finest = refinement == FINER
            strands = self._strands(kind, seeds, finest)
            rough = []
            for seed, (strand, problem) in zip(seeds, strands, strict=True):
                if strand is not None and strand.rough and not finest:
                    options = problem.options.finer()
                    rough.append(self._on_mesh(seed, problem._replace(options=options)))
                elif strand is not None:
                    told.append(self._told(seed._replace(problem=problem), strand))
            if not rough:
                break
            seeds = rough
        return told

    @staticmethod
    def _on_mesh(seed: _Seed, problem: Problem) -> _Seed:
        if seed.problem == problem:
            return seed
        return seed._replace(problem=problem, z=on_mesh(seed.problem, problem, seed.z))

    def _strands(
        self, kind: tuple[str, ...], seeds: list[_Seed], finest: bool
    ) -> list[tuple[Strand | None, Problem]]:
        problem = max((seed.problem for seed in seeds), key=lambda p: p.options.steps)
        seeds = [self._on_mesh(seed, problem) for seed in seeds]
        filled = [*seeds, *seeds[-1:] * (-len(seeds) % SIDE_BY_SIDE)]
        level = GaitLevel(problem, self.parameters, kind, self.model, self.step_options)
        formal = GaitLevel(problem, self.parameters, FORMAL, self.model, self.step_options)
        stack = lambda *trees: jax.tree.map(lambda *x: jnp.stack(x), *trees)
        places = [jnp.asarray(kind.index(EXACT.get(seed.name, seed.name))) for seed in filled]
        wheels = stack(*(GaitAt(s.gait, place) for s, place in zip(filled, places, strict=True)))
        low, high = map(float, self.box[1])
        share = lambda seed: jnp.asarray((seed.at[1] - low) / (high - low))
        z = stack(*(LevelPoint(seed.z, share(seed)) for seed in filled))
        rest = self.model, self.step_options, problem.n_legs
        gaits = GaitRun(level.gaits, self.options, wheels.gait, self.box[0], *rest)
        names = tuple(seed.name for seed in filled)
        run = BorderRun(
            LevelFollowed(level, (low, high)),
            self.options,
            wheels,
            self.box[0],
            names,
            formal,
            gaits,
        )
        p, wanted = jnp.asarray([s.at[0] for s in filled]), np.arange(len(filled)) < len(seeds)
        strands = run_all(run, z, p, wanted, lambda owner, point: lambda: point, finest)
        return [(strand, problem) for strand in strands[: len(seeds)]]

    def _told(self, seed: _Seed, strand: Strand) -> _Traced:
        low, high = self.box[1]
        second = lambda point: float(low + (high - low) * point.z.share)
        name_of = lambda name: "fold" if name == BRANCH_POINT else name  # it need not turn there
        meetings, met = [], []
        for border in strand.borders:
            if border.name == EDGE:
                continue
            beside = border.cycle
            values, name = (border.value, second(beside)), name_of(border.name)
            meetings.append(Meeting(name, values, border.ends_branch))
            if _can_follow(name):
                z = jax.tree.map(jnp.asarray, beside.z.z)
                met.append(_Seed(name, (float(beside.p), values[1]), seed.problem, seed.gait, z))
        z = strand.points.z
        first = (strand.points.p - self.box[0, 0]) / np.ptp(self.box[0])
        path = np.column_stack([z.z.section, first, z.share])
        curve = self._labelled(seed, strand, tuple(meetings))
        return _Traced(curve, path, tuple(met))

    def _labelled(self, seed: _Seed, strand: Strand, meetings: tuple[Meeting, ...]) -> BorderCurve:
        radius = np.abs(np.linalg.eigvals(np.asarray(strand.points.jacobian))).max(-1)
        table = strand.table | {"spectral_radius": radius}
        rows = ("duration_dls", "duration_sls1", "duration_sls2", "spectral_radius")
        data: dict[str, Any] = {n: ("point", table[n], attrs_of(n)) for n in rows}
        data["mesh_error"] = ("point", table["mesh_error"])
        data["section_state"] = (("point", "component"), table["section_state"])
        values = np.asarray(strand.points.p), table["second"]
        labels = {
            parameter: ("point", value, attrs_of(parameter))
            for parameter, value in zip(self.parameters, values, strict=True)
        }
        origin = provenance(seed.gait.params, self.model, self.step_options)
        title = {"title": f"Border {seed.name} over {' and '.join(self.parameters)}"}
        dataset = xr.Dataset(data, labels, title | origin)
        return BorderCurve(seed.name, self.parameters, dataset, meetings, strand.ends)


def _can_follow(name: str) -> bool:
    return name in (*BIFURCATIONS, *VOID) or name.partition("[")[0] in MARGINS

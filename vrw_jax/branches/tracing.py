"""Continuation of special points as curves in two parameters, several side by side, each once.

A special point is solved for together with the gait, so that a point of a curve is as accurate as
the gait. Where a curve meets another special point, a new curve starts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.branches.branch import Border, BorderCurve, Meeting
from vrw_jax.branches.continuation import ENDING, REFINEMENTS, GaitRun, continue_branches
from vrw_jax.branches.followed import Wheel
from vrw_jax.branches.gait_levels import (
    EXACT,
    FALLS,
    FORMAL,
    ROLLS_OFF,
    VOID,
    GaitAt,
    GaitLevel,
    level_of,
    quantities_of,
    where_jumps_begin,
)
from vrw_jax.branches.run import BRANCH_POINT, AbstractRun, Strand, Table, run_all
from vrw_jax.cycles import Problem, on_mesh
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
from vrw_jax.results import MARGINS, attrs_of, provenance
from vrw_jax.runtime import xarray as xr
from vrw_jax.wheel import Outcome, WheelParams, wheel_of

EDGE = "edge of the box"
"""Name of the column that is zero where the second parameter leaves its range."""

OF_CURVES = ArclengthOptions(first_step=5e-4)
"""Default options of curves. The first step is short because some curves are short."""

AT_ONCE = 8
"""Number of curves in a batch, so that one shape is compiled."""

SAME = 2e-3
"""Largest distance of a point on a curve from that curve, with lengths as along the curve."""

BEYOND = 3e-3
"""Distance from a point of codimension two at which the continuation of the other curve starts."""

EXACTLY = 1e-9
"""Newton's last step to a point of codimension two, relative to the values of the parameters."""

BRIEF, LASTS = 1e-4, 0.1
"""Duration of double support that counts as zero despite ill-conditioning, and a first guess of a
nonzero duration, s."""


@dataclass(frozen=True)
class BorderRun(AbstractRun):
    """Continuation of special points, evaluated as gaits are, except for the special point
    itself."""

    followed: LevelFollowed
    second: str  # of the two parameters
    names: tuple[str, ...]  # one for each wheel
    gaits: GaitRun  # along the first parameter

    ending: ClassVar[tuple[str, ...]] = (*ENDING, EDGE, FALLS)
    exact: ClassVar[Mapping[str, str]] = EXACT

    def read(self, wheels: GaitAt, points: PathPoint) -> Table:
        z, share = points.z
        (low, high), share = self.followed.bounds, np.asarray(share)
        second = low + (high - low) * share
        here = lambda params: getattr(params, self.second)
        gaits = wheels.gait._replace(params=eqx.tree_at(here, wheels.gait.params, second))
        table = self.gaits.read(gaits, points._replace(z=z))
        # Without double support the rear foot's force must not be positive.
        rear = np.where(wheels.gait.happens[:, 0, 0] > 0.5, 1.0, -1.0)
        told = {"lambda_4_plus": rear * table["lambda_4_plus"], "second": second}
        return table | told | {EDGE: np.minimum(share, 1.0 - share)}

    def known(self, table: Table, owners: np.ndarray) -> Table:
        """Mask quantities that vanish along the whole curve, which have no isolated zeros on it."""
        names = np.array(self.names)[owners]
        void, rolls_off = np.isin(names, (*VOID, ROLLS_OFF)), names == ROLLS_OFF
        by_step = {name for name in table if name.partition("[")[0] in MARGINS} - set(FORMAL)
        blank = {name: names == name for name in {*self.names} & {*table}}
        blank |= {exact: names == name for name, exact in EXACT.items()}
        blank |= {name: void | blank.get(name, False) for name in by_step}
        rear = blank.get("lambda_4_plus", False) | rolls_off
        blank |= {"lambda_4_plus": rear, FALLS: ~rolls_off}
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


class Seed(NamedTuple):
    """Point on or near a curve of special points, from which it is continued."""

    name: str
    at: tuple[float, float]  # the two parameters
    problem: Problem
    gait: Wheel
    z: Solution


class Traced(NamedTuple):
    """Traced curve, with the special points met on it."""

    curve: BorderCurve
    path: np.ndarray  # section state and both parameters' fractions, (point, coordinate)
    met: tuple[Seed, ...]


class Tracer(NamedTuple):
    """Tracer of curves of special points within two parameter ranges."""

    parameters: tuple[str, str]
    box: np.ndarray  # (parameter, end)
    model: ViscoelasticWheel
    options: ArclengthOptions
    step_options: Options

    def moved(self, params: WheelParams, values: Mapping[str, float]) -> WheelParams:
        for name, value in values.items():
            params = self.model.moved(params, name, jnp.asarray(value))[1]
        return params

    def shares(self, values: np.ndarray) -> np.ndarray:
        """Return both parameters, on the last axis, as fractions of their ranges."""
        return (values - self.box[:, 0]) / np.ptp(self.box, 1)

    def along(self, axis: int, params: WheelParams) -> list[Seed]:
        """Return seeds at special points on the branches of these wheels along one of the
        parameters."""
        name, seeds = self.parameters[axis], []
        low, high = self.box[axis]
        for branch in continue_branches(params, name, (low, high), model=self.model):
            for border in branch.borders:
                if can_follow(border.name):
                    seeds.append(self._seed(border))
        return seeds

    def _seed(self, border: Border) -> Seed:
        start = border.cycle
        params = wheel_of(start.parameters, start.problem.n_legs)
        first, second = (float(getattr(params, name)) for name in self.parameters)
        gait, z = Wheel(params, start.located.happens), start.located.solution
        name = named(border.name, gait, z)
        return Seed(name, (first, second), start.problem, gait, z)

    def followed(self, seeds: Sequence[Seed], known: Sequence[Traced]) -> list[Traced]:
        """Return the curves through all seeds that are on none of the known curves."""
        new: list[Traced] = []
        fresh = [seed for seed in seeds if not any(self._on(seed, one) for one in known)]
        kinds = {quantities_of(seed.name, seed.problem.n_legs) for seed in fresh}
        for kind in sorted(kinds):
            of_kind = [s for s in fresh if quantities_of(s.name, s.problem.n_legs) == kind]
            while of_kind:
                some: list[Seed] = []
                for seed in of_kind:  # each name once: others may be on its curve
                    if seed.name not in {s.name for s in some} and len(some) < AT_ONCE:
                        some.append(seed)
                told: list[Traced] = []
                for one in self._batch(kind, some):  # a curve may be known already
                    if not any(self.lies_on(one, other) for other in (*known, *new, *told)):
                        told.append(one)
                new += told
                of_kind = [
                    seed for seed in of_kind
                    if not any(seed is s for s in some) and not any(self._on(seed, t) for t in told)
                ]  # fmt: skip
        return new

    def _on(self, seed: Seed, traced: Traced) -> bool:
        here = np.append(seed.z.section, self.shares(np.array(seed.at)))
        alike = seed.name == traced.curve.name
        return alike and bool(distance(here[None], traced.path)[0] < SAME)

    @staticmethod
    def lies_on(one: Traced, other: Traced) -> bool:
        alike = one.curve.name == other.curve.name
        return alike and bool(np.max(distance(one.path, other.path)) < SAME)

    def _batch(self, kind: tuple[str, ...], seeds: list[Seed]) -> list[Traced]:
        """Return a curve through each seed that has one, on a sufficiently fine mesh."""
        told: list[Traced] = []
        for refinement in range(1 + REFINEMENTS):
            finest = refinement == REFINEMENTS
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
    def _on_mesh(seed: Seed, problem: Problem) -> Seed:
        if seed.problem == problem:
            return seed
        return seed._replace(problem=problem, z=on_mesh(seed.problem, problem, seed.z))

    def _strands(
        self, kind: tuple[str, ...], seeds: list[Seed], finest: bool
    ) -> list[tuple[Strand | None, Problem]]:
        problem = max((seed.problem for seed in seeds), key=lambda p: p.options.steps)
        seeds = [self._on_mesh(seed, problem) for seed in seeds]
        filled = [*seeds, *seeds[-1:] * (-len(seeds) % AT_ONCE)]
        level = GaitLevel(problem, self.parameters, kind, self.model, self.step_options)
        stack = lambda *trees: jax.tree.map(lambda *x: np.stack(x), *trees)
        levels = [level_of(seed.name, bool(seed.gait.happens[0, 0] > 0.5)) for seed in filled]
        places = [jnp.asarray(kind.index(name)) for name in levels]
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
            self.parameters[1],
            names,
            gaits,
        )
        p, wanted = jnp.asarray([s.at[0] for s in filled]), np.arange(len(filled)) < len(seeds)
        strands = run_all(run, z, p, wanted, lambda owner, point: lambda: point, finest)
        return [(strand, problem) for strand in strands[: len(seeds)]]

    def _told(self, seed: Seed, strand: Strand) -> Traced:
        values = np.stack([strand.points.p, strand.table["second"]], -1)
        path = np.column_stack([strand.points.z.z.section, self.shares(values)])
        meetings, met, ends = [], [], strand.ends
        for border in strand.borders:
            if border.name == EDGE:
                continue
            beside = border.cycle
            at = border.value, float(self.box[1, 0] + np.ptp(self.box[1]) * beside.z.share)
            name = named(border.name, seed.gait, beside.z.z)
            if {name, seed.name} == {"lambda_4_plus", ROLLS_OFF}:
                at = self._where_jumps_begin(seed, beside.z.z, at)
                met.append(self._beyond(name, seed, path, values, strand.points.z.z, at))
                told = f"{border.value:.9g}", f"{at[0]:.9g}"
                ends = ends[0].replace(*told), ends[1].replace(*told)
            elif can_follow(name):
                there = float(beside.p), at[1]
                met.append(Seed(name, there, seed.problem, seed.gait, beside.z.z))
            meetings.append(Meeting(name, at, border.ends_branch))
        curve = self._labelled(seed, strand._replace(ends=ends), tuple(meetings))
        return Traced(curve, path, tuple(met))

    def _where_jumps_begin(self, seed: Seed, z: Solution, at: Any) -> tuple[float, float]:
        level = GaitLevel(seed.problem, self.parameters, FORMAL, self.model, self.step_options)
        exact, settled = where_jumps_begin(level, seed.gait, jax.device_put(z), jnp.asarray(at))
        first, second = exact if settled < EXACTLY else at
        return float(first), float(second)

    def _beyond(
        self, name: str, seed: Seed, path: np.ndarray, values: np.ndarray, z: Solution, at: Any
    ) -> Seed:
        """Return a seed beyond a point where the rear foot's force, zero along the curve, starts to
        rise or fall.

        Both curves cross there and continue in the same direction.
        """
        way = 1 if abs(values[0] - at).max() < abs(values[-1] - at).max() else -1
        path, values, z = path[::way], values[::way], jax.tree.map(lambda x: x[::way], z)
        lengths = np.linalg.norm(path - path[0], axis=1)
        other = int(np.argmax(lengths >= min(BEYOND, lengths[-1])))
        on = lambda x: x[0] + BEYOND / lengths[other] * (x[0] - x[other])
        z, (first, second) = jax.tree.map(lambda x: jnp.asarray(on(x)), z), on(values)
        lasts = 0.0 if name == ROLLS_OFF else LASTS
        z = z._replace(durations=z.durations.at[0, 0].set(lasts))
        return Seed(name, (first, second), seed.problem, seed.gait, z)

    def _labelled(self, seed: Seed, strand: Strand, meetings: tuple[Meeting, ...]) -> BorderCurve:
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


def distance(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return the distances of points from a polyline, both along the first axis."""
    begin, chord = path[:-1], np.diff(path, axis=0)
    squared = np.maximum(np.sum(chord**2, 1), 1e-300)
    there = points[:, None] - begin
    share = np.clip(np.sum(there * chord, 2) / squared, 0.0, 1.0)
    off = np.linalg.norm(there - share[..., None] * chord, axis=2)
    return np.min(off, axis=1, initial=np.inf)


def named(name: str, gait: Wheel, z: Solution) -> str:
    """Return the name of a special point of a curve or branch, given the gait there."""
    if name == BRANCH_POINT:  # a curve of folds may not turn there
        return "fold"
    if name not in ("lambda_4_plus", ROLLS_OFF, FALLS) or gait.happens[0, 0] < 0.5:
        return name
    rolls_off = name != FALLS and z.durations[0, 0] < BRIEF
    return ROLLS_OFF if rolls_off else "lambda_4_plus"


def can_follow(name: str) -> bool:
    """Return whether a special point's quantity is one of `GaitTestFunction`."""
    return name in (*BIFURCATIONS, *VOID, ROLLS_OFF) or name.partition("[")[0] in MARGINS

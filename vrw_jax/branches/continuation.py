"""Branches of gaits along one parameter, stable or not, with all special points on them located.

A special point is a bifurcation, or a border collision, where an indicator or a margin reaches
zero. Each is solved for on the branch itself, with a new solution at every trial, so that it is as
accurate as the gaits.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.branches.branch import Branch
from vrw_jax.branches.followed import Wheel
from vrw_jax.branches.run import IN_SEQUENCE, READ, AbstractRun, Strand, Table, run_all
from vrw_jax.branches.starts import STARTS, Wanted, start_by_walking
from vrw_jax.cycles import (
    AGREEMENT,
    AbstractCycle,
    CycleOptions,
    LimitCycle,
    WalkedCycle,
    finder_of,
    serving,
)
from vrw_jax.models import AbstractWheel, refuse_ladder
from vrw_jax.numerics import (
    ArclengthOptions,
    MapFollowed,
    Options,
    PathPoint,
    multipliers,
    taken,
)
from vrw_jax.results import (
    CYCLE,
    GROUND,
    MARGINS,
    STEP,
    attrs_of,
    locked_legs,
    provenance,
    variables,
)
from vrw_jax.runtime import xarray as xr
from vrw_jax.walks import ModelLike, one_wheel, options_of, rung_of
from vrw_jax.wheel import FRICTION, Outcome, WheelParams
from vrw_jax.wording import (
    function_of,
    instance,
    range_of,
    real,
    reals,
    require_known,
    untraced,
    whole,
)

INDICATORS = ("lambda_I4", "lambda_2_plus", "lambda_4_plus")
ENDING = (*INDICATORS, "duration_dls", "duration_sls1", "duration_sls2")
"""Quantities at whose zeros the order of events changes and the branch ends."""

INSTEAD = "differentiate vrw.limit_cycle"
"""Advice for a caller who differentiates."""

COARSE = Outcome.MESH_TOO_COARSE.name.lower()
"""Name of an end where the mesh is too coarse: the gaits do not repeat in a walk."""

MESH_ERROR, REFINEMENTS = 1e-8, 3
"""Estimate of the mesh's error on a branch above which a finer mesh is used, and largest number of
refinements."""


@dataclass(frozen=True)
class GaitRun(AbstractRun):
    """Continuation of gaits: event-driven steps evaluate them, and they are admissible if these
    repeat."""

    model: AbstractWheel
    step_options: Options
    n_legs: int

    ending: ClassVar[tuple[str, ...]] = ENDING
    exact: ClassVar[Mapping[str, str]] = {"clearance_sls1": "takeoff_acceleration"}
    """Margins that vanish as a cube, with the quantity that vanishes at the same point linearly. A
    foot that takes off less steeply dips less deeply, until it rises immediately. A solver cannot
    resolve the last of these dips, but the linear quantity changes its sign."""

    def read(self, wheels: Wheel, points: PathPoint) -> Table:
        """Return the table, with one column more for each leg of a margin with several legs."""
        followed: Any = self.followed
        told = functools.partial(followed.told, self.model, self.step_options)
        table = self.batched(told, READ, wheels, points)
        for name, margin in MARGINS.items():
            if margin.axis and name in table:
                legs = enumerate(range(3, self.n_legs + 1))
                table |= {f"{name}[{leg}]": table[name][:, i] for i, leg in legs}
        return table

    def kept(self, table: Table) -> np.ndarray:
        return (table["outcome"] == Outcome.STEPPED) & (table["closure"] <= AGREEMENT)

    def is_margin(self, name: str) -> bool:
        return name in INDICATORS or name.partition("[")[0] in MARGINS

    def name_of_loss(self, table: Table, place: int) -> str:
        outcome = Outcome(int(table["outcome"][place]))
        if outcome != Outcome.STEPPED:
            return outcome.name.lower()
        return COARSE if "mesh_error" in table else IN_SEQUENCE

    def is_rough(self, table: Table, ends: tuple[str, ...]) -> bool:
        return COARSE in ends or bool(np.max(table.get("mesh_error", 0.0)) > MESH_ERROR)


def continue_branch(
    params: WheelParams,
    name: str,
    bounds: tuple[float, float],
    *,
    cycle: LimitCycle | WalkedCycle | None = None,
    period_n: int = 1,
    model: ModelLike | None = None,
    options: ArclengthOptions | None = None,
    cycle_options: CycleOptions | None = None,
    step_options: Options | None = None,
) -> Branch:
    """Return the branch of limit cycles through `params` along the parameter `name` within
    `bounds`.

    The continuation starts from the limit cycle at `params` (or from `cycle`, found at the same
    parameters). It goes both ways, through folds, on stable and unstable gaits alike, to the bounds
    or the end of the branch. `Branch.ends` gives the reason. An end may belong to the wheel, if its
    events change their order, or to the mesh (`mesh_too_coarse`). Without `cycle_options` the mesh
    is first refined, up to eight times finer.

    Every special point is located to 1e-9 in the parameter, if the continuation step
    (options.max_ds) does not hide it: two changes of sign within one step cancel. The gaits use the
    cycle options, at least `CycleOptions.with_tight_tolerances()` by default. Each is checked by
    one event-driven step, which also gives indicators and margins.

    For other models the gaits are fixed points of their return map, as accurate as `step_options`.
    With unilateral contact `name` may be "friction" too. The start is then a `ReturnMapCycle` or,
    without one, the end of a walk. A branch continues where the order of events changes, with a
    kink. "auto" uses the model that is selected for the start. A violated margin of the paper's
    model is a special point with the name of the margin, beyond which unilateral contact is
    selected.

    Args:
        params: one wheel; the branch goes through its gait.
        name: of the parameter.
        bounds: range of the parameter.
        cycle: the gait at `params`, if it is known.
        period_n: number of steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `ArclengthOptions` of the branch.
        cycle_options: of the gaits.
        step_options: of the checking steps, and of the gaits of other models.

    Returns:
        A `Branch`; without a gait to start from, its `outcome` is the reason.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> branch = vrw.continue_branch(vrw.WheelParams(), "damping", (190.0, 230.0))
        >>> point = branch.special_points[-1]
        >>> print(point.name, f"{point.value:.6f}", branch.ends[1])
        lambda_4_plus 219.847688 lambda 4 plus at 219.847688 ends it.
    """
    one_wheel(params, "use vrw.continue_branches for a batch")
    if cycle is not None:
        instance("cycle", cycle, AbstractCycle, "give vrw.limit_cycle(params)")
    untraced("vrw.continue_branch", INSTEAD, params, cycle)
    batch, cycle = jax.device_put(taken((params, cycle), None))
    (branch,) = continue_branches(
        batch, name, bounds, cycle=cycle, period_n=period_n, options=options,
        model=rung_of(serving(params, model)),
        cycle_options=cycle_options, step_options=step_options,
    )  # fmt: skip
    return branch


def continue_branches(
    params: WheelParams,
    name: str,
    bounds: tuple[float, float],
    *,
    cycle: LimitCycle | WalkedCycle | None = None,
    period_n: int = 1,
    model: AbstractWheel | None = None,
    options: ArclengthOptions | None = None,
    cycle_options: CycleOptions | None = None,
    step_options: Options | None = None,
) -> tuple[Branch, ...]:
    """Return `continue_branch` of a batch of wheels; every parameter has one leading axis.

    A wheel without a limit cycle to start from has a branch without points, whose outcome is the
    reason.

    Args:
        params: the wheels; every field of shape (wheels,).
        name: of the parameter.
        bounds: range of the parameter.
        cycle: the gaits at `params`, if they are known.
        period_n: number of steps after which the gaits repeat.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: `ArclengthOptions` of the branches.
        cycle_options: of the gaits.
        step_options: as in `continue_branch`.

    Returns:
        One `Branch` for each wheel.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> wheel = vrw.WheelParams(damping=np.array([205.0, 210.0]))
        >>> wheels = jax.tree.map(lambda v: jnp.broadcast_to(v, (2,)), wheel)
        >>> branches = vrw.continue_branches(wheels, "damping", (200.0, 230.0))
        >>> [round(branch.special_points[-1].value, 4) for branch in branches]
        [219.8477, 219.8477]
    """
    untraced("vrw.continue_branch", INSTEAD, params, cycle)
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    model, step_options = rung_of(model), options_of(step_options or Options.tight())
    _check_followed(model, name, whole("period_n", period_n), cycle)
    (low, high), options = range_of("bounds", bounds), _arclength(options)
    finder = finder_of(model, params.n_legs, cycle_options=cycle_options, step_options=step_options)
    finder.options_used.require_reachable(jnp.result_type(*jax.tree.leaves(params)))
    batch = np.broadcast_shapes(*(x.shape for x in jax.tree.leaves(params)))
    if len(batch) != 1:
        raise ValueError(f"the wheels' batch has shape {batch}, but it must have one axis.")
    params = jax.tree.map(lambda x: jnp.broadcast_to(x, batch), params)
    given = jnp.broadcast_to(getattr(model if name == FRICTION else params, name), batch)
    p = jnp.clip(given, low, high)
    if name != FRICTION:
        _, params = model.moved(params, name, p)
    wanted = Wanted(params, model, name, p, period_n, cycle_options, step_options)
    outcomes, strands = _followed(wanted, cycle, options, np.array([low, high]))
    one = lambda owner: jax.tree.map(lambda x: x[owner], params)
    return tuple(
        _branch_of_gaits(strand, one(owner), name, model, step_options, int(outcomes[owner]))
        for owner, strand in enumerate(strands)
    )


def _followed(
    wanted: Wanted, cycle: Any, options: ArclengthOptions, limits: np.ndarray
) -> tuple[np.ndarray, list[Strand | None]]:
    """Return the outcomes of the starts, and the data of the branches from them.

    The mesh is that of the cycle options. Without options it is as fine as the branches need.
    """
    adaptive = wanted.cycle_options is None
    for refinement in range(1 + REFINEMENTS):
        start = STARTS.get(wanted.model.rung, start_by_walking)(wanted, cycle)
        run = GaitRun(
            start.followed, options, start.wheels, limits, wanted.model, wanted.step_options,
            wanted.params.n_legs,
        )  # fmt: skip
        good = start.outcomes == Outcome.STEPPED
        finest = not adaptive or start.finer is None or refinement == REFINEMENTS
        strands = run_all(run, start.z, wanted.p, good, start.make_cycle, finest)
        if finest or not any(strand is not None and strand.rough for strand in strands):
            break
        wanted, cycle = wanted._replace(cycle_options=start.finer), start.cycle
    return start.outcomes, strands


UNTOLD = ("outcome", "solver_steps")
"""Measures of the checking step that a branch omits."""


def _check_followed(model: AbstractWheel, name: str, period_n: int, cycle: Any) -> None:
    refuse_ladder(model, "followed")
    require_known(name, model.parameter_names, "parameter")
    if period_n > 1 and cycle is None:
        raise ValueError(
            f"period_n is {period_n} and there is no cycle, but a gait of several steps is one of "
            "many beside the gait of one step: give cycle=vrw.limit_cycle(..., guess=...)."
        )


def _arclength(options: ArclengthOptions | None) -> ArclengthOptions:
    if options is not None:
        instance("options", options, ArclengthOptions, "give vrw.ArclengthOptions()")
    return ArclengthOptions() if options is None else options


def _branch_of_gaits(
    strand: Strand | None,
    params: WheelParams,
    name: str,
    model: AbstractWheel,
    options: Options,
    outcome: int,
) -> Branch:
    origin = provenance(params, model, options)
    origin.pop(f"parameter_{name}", None)
    attrs = {"title": f"Branch of limit cycles along {name}"} | origin
    if strand is None:
        code = Outcome(outcome)
        code = Outcome.NO_CYCLE_FOUND if code == Outcome.STEPPED else code
        empty = xr.Dataset(coords={name: ("point", np.zeros(0))}, attrs=attrs)
        return Branch(name, empty, (), ("", ""), code)
    asked = (name for name in STEP | MARGINS | GROUND if name not in UNTOLD)
    data = variables({key: strand.table[key] for key in asked if key in strand.table}, "point")
    data["section_state"] = xr.Variable(
        ("point", "component"),
        strand.table["section_state"],
        {"long_name": "section state just before touchdown"},
    )
    data["closure"] = xr.Variable(
        "point",
        strand.table["closure"],
        {"units": "1", "long_name": "miss of the section state after one event-driven period"},
    )
    labels = {
        name: xr.Variable("point", strand.points.p, attrs_of(name)),
        "component": _components(strand.table["section_state"].shape[-1], params.n_legs),
        "leg": locked_legs(params.n_legs),
    }
    dataset = xr.Dataset(data | _stability(np.asarray(strand.points.jacobian)), labels, attrs)
    return Branch(name, dataset, strand.borders, strand.ends, Outcome.STEPPED)


def _components(size: int, n: int) -> list[str]:
    """Return names of a section state's components: the paper's, or
    `unilateral_section.FullState`."""
    if size == 3:
        return ["theta", "dtheta", "dL1"]
    legs = [f"{name}{leg}" for name in ("L", "dL", "code") for leg in range(1, n + 1)]
    return ["theta", "dtheta", "vx", "vz", *legs]


def _stability(jacobians: np.ndarray) -> dict[str, xr.Variable]:
    """Return multipliers and stability measures along the branch."""
    values = np.asarray(multipliers(jnp.asarray(jacobians)))
    radius = np.max(np.abs(values), -1)
    names = {"multiplier_real": values.real, "multiplier_imag": values.imag}
    return {
        **{
            key: xr.Variable(("point", "multiplier"), part, {"units": "1", "long_name": text})
            for (key, part), text in zip(
                names.items(), ("real part of a multiplier", "imaginary part"), strict=True
            )
        },
        "spectral_radius": xr.Variable("point", radius, CYCLE["spectral_radius"].attrs),
        "spectral_margin": xr.Variable("point", 1.0 - radius, CYCLE["spectral_margin"].attrs),
    }


class MapRun(AbstractRun):
    """Continuation of fixed points of any map."""

    def read(self, wheels: Any, points: PathPoint) -> Table:
        return {"x": self.batched(jax.vmap(self.followed.section), READ, points.z)}

    def kept(self, table: Table) -> np.ndarray:
        return np.asarray(np.isfinite(table["x"]).all(-1))


def continue_map(
    function: Callable[[Any, Array, Array], Array],
    x: object,
    p: float,
    bounds: tuple[float, float],
    *,
    constants: Any = (),
    name: str = "parameter",
    options: ArclengthOptions | None = None,
) -> Branch:
    """Return the branch of fixed points of any map x -> `function(constants, x, p)` through (x, p).

    The map must be differentiable in forward mode, and NaN where it is undefined. Its bifurcations
    are located as in `continue_branch`.

    Args:
        function: `function(constants, x, p)`, shape of `x`.
        x: a fixed point, or near one, shape (n,).
        p: the parameter there.
        bounds: range of the parameter.
        constants: any pytree, passed to the function.
        name: of the parameter in the result.
        options: `ArclengthOptions` of the branch.

    Returns:
        A `Branch`.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> logistic = lambda _, x, r: r * x * (1.0 - x)
        >>> branch = vrw.continue_fixed_points(logistic, [0.6], 2.5, (2.0, 3.5))
        >>> [(point.kind, round(point.value, 6)) for point in branch.special_points]
        [('period_doubling', 3.0)]
    """
    function_of("function", function, "of constants, x and p")
    untraced("vrw.continue_map", "use vrw.newton_cycle", x, p, constants)
    low, high = range_of("bounds", bounds)
    if not low <= real("p", p) <= high:
        raise ValueError(
            f"p is {p:g}, but the branch must start within its bounds: give one in [{low:g}, "
            f"{high:g}]."
        )
    options, x = _arclength(options), reals("x", x)
    lead = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, float)[None], tree)
    run = MapRun(MapFollowed(function), options, lead(constants), np.array([low, high]))
    (strand,) = run_all(run, lead(x), lead(p), np.array([True]), lambda owner, point: None)
    if strand is None:
        empty = xr.Dataset(coords={name: ("point", np.zeros(0))})
        return Branch(name, empty, (), ("", ""), Outcome.NO_CYCLE_FOUND)
    dataset = xr.Dataset(
        {"x": (("point", "component"), strand.table["x"])}
        | _stability(np.asarray(strand.points.jacobian)),
        {name: ("point", strand.points.p)},
        {"title": f"Branch of fixed points along {name}"},
    )
    return Branch(name, dataset, strand.borders, strand.ends, Outcome.STEPPED)

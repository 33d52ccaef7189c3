"""Tuning a wheel: maximization of a gait's objective under margins, with exact gradients.

Without margins as constraints, the maximization gains double support by scuffing.
"""

from __future__ import annotations

import dataclasses
import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vrw_jax.cycles import (
    AbstractGaitFinder,
    CycleOptions,
    Gait,
    default_margins,
    finder_of,
    read_along,
    read_along_lanes,
    same_branch,
    serving,
)
from vrw_jax.models import PREMISES
from vrw_jax.numerics import Options
from vrw_jax.results import MARGINS, MEASURES, attrs_of, flags, measure_of, provenance
from vrw_jax.runtime import xarray as xr
from vrw_jax.tuning.climbing import Climb, Kind, Trial, breach, climb, optimality, slack_scales
from vrw_jax.tuning.objective import (
    MOST,
    Evaluated,
    Margins,
    OfCycle,
    Reader,
    Sought,
    Weighted,
    bound_of,
    margins_of,
)
from vrw_jax.tuning.result import Active, Tuned, Walked
from vrw_jax.tuning.starts import Lanes, explore
from vrw_jax.walks import ModelLike, one_wheel, rung_of
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES, Outcome, WheelParams
from vrw_jax.wording import (
    instance,
    names_of,
    positive,
    range_of,
    real,
    require_known,
    shown,
    untraced,
    whole,
)

Objective = str | Mapping[str, float] | Callable[..., Array]


DISPLACED, N_WALKED, N_EXPLORED = 1e-5, 10, 25


def tune(
    params: WheelParams,
    objective: Objective,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    constraints: Margins | None = None,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    cycle_options: CycleOptions | None = None,
    tolerance: float = 1e-6,
    max_evaluations: int = 200,
    n_starts: int = 1,
    seed: int = 0,
) -> Tuned:
    """Return the wheel near `params` whose gait maximizes the objective and satisfies its
    constraints.

    The default constraints are all margins that gaits of this model can keep (`default_margins`);
    {} is none. A constraint counts as satisfied within 1e-6 of its change over the bounds. The
    method is local: it ends at an optimum of the branch of `params`. With `n_starts` above 1 it
    begins with `params` and random wheels within the bounds. They take N_EXPLORATION_STEPS
    first-order steps side by side, and the best is maximized.

    With unilateral contact (`UnilateralWheel`) the objective is a measure of a step or a weighted
    sum of several. A walk from the start finds the first gait. Constraints, none by default, are on
    such measures, for example {"slip": (0.0, 0.05)}. Model "auto" uses the model that is selected
    for the start's gait. If that is the paper's, its margins are the constraints, so that it stays
    valid.

    Args:
        params: the start, one wheel.
        objective: maximized quantity: a measure's name, weights of several, or a function of a
            LimitCycle (and, if it takes two arguments, of the StepResult from it).
        free: names of the free parameters.
        bounds: lower and upper bound of each free parameter.
        constraints: least values of measures by name, or pairs of least and most; names alone mean
            zero.
        model: the model; the paper's, `ViscoelasticWheel()`, by default.
        options: of the steps.
        cycle_options: of the gaits.
        tolerance: on the first-order condition, relative to the objective's gradient.
        max_evaluations: largest number of gaits.
        n_starts: number of starts, the best of which is maximized.
        seed: of the random starts.

    Returns:
        A `TuneResult`, whose `status` is CONVERGED at an optimum.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> bounds = {"damping": (100.0, 215.0)}
        >>> result = vrw.tune(vrw.WheelParams(), "dls_fraction", ["damping"], bounds)
        >>> print(result.status.name, f"{result.value:.3f}", [c.name for c in result.active])
        CONVERGED 0.534 ['damping']
    """
    untraced("vrw.tune", "climb by your own loop over vrw.limit_cycle", params)
    max_evaluations, n_starts = (
        whole("max_evaluations", max_evaluations),
        whole("n_starts", n_starts),
    )
    tolerance, seed = positive("tolerance", tolerance), whole("seed", seed, 0)
    began = time.perf_counter()
    problem = tuning_problem(
        params,
        objective,
        free,
        bounds,
        constraints,
        model=model,
        options=options,
        cycle_options=cycle_options,
    )
    lanes = problem.explore(n_starts, seed) if n_starts > 1 else None
    problem.finder.compile(params)
    start = problem.start() if lanes is None else problem.evaluate(lanes.u[lanes.best], None)
    compiled = time.perf_counter()
    done = climb(problem.evaluate, start, tolerance=tolerance, max_evaluations=max_evaluations)
    return problem.result(done, began, compiled, lanes)


@dataclasses.dataclass(frozen=True)
class TuneProblem:
    """Validated tuning problem: free parameters, objective and constraints."""

    params: WheelParams
    free: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    margins: dict[str, float]
    label: str
    sought: Sought
    finder: AbstractGaitFinder

    @property
    def widths(self) -> np.ndarray:
        return self.upper - self.lower

    @property
    def moved(self) -> list[int]:
        return [PARAMETER_NAMES.index(name) for name in self.free]

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Return one name for each constrained number: margins of the locked legs have six."""
        names: list[str] = []
        for name in self.margins:
            if measure_of(name).axis:
                names += [f"{name}[leg {leg}]" for leg in range(3, self.params.n_legs + 1)]
            else:
                names.append(name)
        return tuple(names)

    @property
    def least(self) -> np.ndarray:
        """Return the margins, one for each of `constraint_names`."""
        return np.array([self.margins[name.partition("[")[0]] for name in self.constraint_names])

    def parameters(self, u: np.ndarray) -> np.ndarray:
        """Return all float parameters for free ones `u` widths above their lower bounds."""
        values = np.array(self.finder.model.values(self.params))
        values[self.moved] = self.lower + u * self.widths
        return values

    def wheel(self, u: np.ndarray) -> WheelParams:
        return self.finder.model.at(jnp.asarray(self.parameters(u)), self.params.n_legs)[1]

    @property
    def start_u(self) -> np.ndarray:
        values = np.array([float(getattr(self.params, name)) for name in self.free])
        return np.clip((values - self.lower) / self.widths, 0.0, 1.0)

    def start(self) -> Trial:
        """Return the trial at the start.

        Raises: ValueError: the start has no gait.
        """
        trial = self.evaluate(self.start_u, None)
        if not trial.found:
            raise ValueError(
                f"the start has no gait to tune ({trial.outcome.name}: {trial.outcome.meaning[:-1]}"
                "): start from a wheel that walks, such as WheelParams()."
            )
        return trial

    def evaluate(self, u: np.ndarray, near: Trial | None) -> Trial:
        """Return the trial at `u`, searched for from a neighbor's gait if one is given."""
        parameters = jnp.asarray(self.parameters(u))
        before = None if near is None else near.told
        guess = self.finder.first_guess(parameters) if before is None else before.gait.cycle.near
        gait = self.finder.find(parameters, guess)
        told = Evaluated(gait, *read_along(self.sought, gait))
        outcome, on_branch = Outcome(int(told.gait.outcome)), True
        if outcome == Outcome.STEPPED and near is not None and before is not None:
            change = self.parameters(u) - self.parameters(near.u)
            on_branch = same_branch(before.gait.on_branch, told.gait.on_branch, change)
        return self.trial(u, told, outcome, on_branch)

    def trial(self, u: np.ndarray, told: Evaluated, outcome: Outcome, on_branch: bool) -> Trial:
        """Return a trial with objective and constraints of a gait."""
        values = np.array(told.values)
        slopes = np.array(told.columns)[self.moved].T * self.widths
        if outcome != Outcome.STEPPED:
            values, slopes = np.full_like(values, np.nan), np.full_like(slopes, np.nan)
        return Trial(
            u, outcome, on_branch, float(values[0]), slopes[0], values[1:] - self.least,
            slopes[1:], told,
        )  # fmt: skip

    def explore(self, n_starts: int, seed: int) -> Lanes:
        """Take first-order steps from many starts side by side: this wheel, and random ones."""
        others = np.random.default_rng(seed).uniform(size=(n_starts - 1, len(self.free)))
        lanes = explore(
            self._batch,
            np.vstack([self.start_u, others]),
            self._change,
            self.moved,
            self.widths,
            self.least,
            N_EXPLORED,
        )
        if not np.isfinite(lanes.objective).any():
            raise ValueError(
                f"none of {n_starts} starts within the bounds has a gait: narrow the bounds around "
                "wheels that walk, such as WheelParams()."
            )
        return lanes

    def _batch(self, u: np.ndarray, near: Evaluated | None) -> Evaluated:
        parameters = jnp.asarray([self.parameters(row) for row in u])
        first = self.finder.first_guesses(parameters)
        guess = first if near is None else near.gait.cycle.near
        gait = self.finder.find_many(parameters, guess)
        return Evaluated(gait, *read_along_lanes(self.sought, gait))

    def _change(self, difference: np.ndarray) -> np.ndarray:
        """Return changes of all parameters from changes of u, row by row."""
        change = np.zeros((difference.shape[0], len(self.finder.model.parameter_names)))
        change[:, self.moved] = difference * self.widths
        return change

    def result(
        self, done: Climb, began: float, compiled: float, lanes: Lanes | None = None
    ) -> Tuned:
        best = done.best
        assert best.told is not None
        gait = best.told.gait
        params = self.wheel(best.u)
        conditions = optimality(best)
        active = [
            Active(name.removeprefix(MOST), bound_of(name, limit), measure_of(name).unit, price)
            for name, limit, price in zip(
                self.constraint_names, self.least, map(float, conditions.prices), strict=True
            )
            if price > 0.0
        ]
        sides = ((self.lower, conditions.low), (self.upper, conditions.high))
        for limits, prices in sides:
            for name, limit, price, width in zip(
                self.free, limits, prices, self.widths, strict=True
            ):
                if price > 0.0:
                    unit, cost = measure_of(name).unit, float(price / width)
                    active.append(Active(name, float(limit), unit, cost))
        climbed = time.perf_counter()
        walked = self._walk(params, gait)
        told = gait.step.measures()
        broken = [name for name in MARGINS if name in told and np.min(told[name]) < 0.0]
        return Tuned(
            params=params,
            ending=done.ending,
            objective=self.label,
            value=best.objective,
            start_value=done.trials[0].objective,
            cycle=gait.cycle,
            step=gait.step,
            active=tuple(active),
            kkt_residual=conditions.residual,
            unkept=tuple(name for name in broken if name not in self.margins),
            walked=walked,
            path=self._path(done),
            evaluations=len(done.trials) + (0 if lanes is None else lanes.gaits),
            shortened=sum(kind == Kind.LOST for kind in done.kinds),
            seconds=climbed - began,
            compile_seconds=compiled - began,
            lanes=lanes,
        )

    def _walk(self, params: WheelParams, gait: Gait) -> Walked:
        cycle = np.array(gait.cycle.section_state)
        # The state is scaled down, not up: no leg may be beyond its stopper.
        x, kept, outcome, walked = cycle * (1.0 - DISPLACED), True, Outcome.STEPPED, 0
        default = default_margins(params)
        for _ in range(N_WALKED):
            one = self.finder.step(params, jnp.asarray(x))
            outcome = Outcome(int(one.outcome))
            if outcome != Outcome.STEPPED:
                break
            walked, x = walked + 1, np.array(one.section_state)
            monitored = {name: np.asarray(value) for name, value in one.measures().items()}
            for name, least in self.margins.items():
                if (measure := name.removeprefix(MOST)) in monitored:
                    value = monitored[measure] if measure == name else -monitored[measure]
                    # The optimum satisfies it within 1e-6 of its change over the bounds, and the
                    # start is displaced: each is some thousandths of a take-off margin.
                    scale = 1e-3 * np.max(np.abs(value)) + 1e-2 * abs(default.get(name, 0.0))
                    kept &= bool(np.all(value >= least - scale - 1e-9))
        distance = float(np.max(np.abs(x - cycle)))
        return Walked(walked, outcome, distance, kept and outcome == Outcome.STEPPED)

    def _path(self, done: Climb) -> xr.Dataset:
        along = "evaluation"
        u = np.array([trial.u for trial in done.trials])
        values = self.lower + u * self.widths
        least = self.least
        constraints = np.array([trial.slack + least for trial in done.trials])
        start = done.trials[0]
        scales = slack_scales(start.slack, start.slopes)
        outcomes = [
            trial.outcome if trial.on_branch else Outcome.NO_CYCLE_FOUND for trial in done.trials
        ]
        data: dict[str, Any] = {
            name: (along, values[:, i], attrs_of(name)) for i, name in enumerate(self.free)
        }
        data |= {
            "objective": (along, [t.objective for t in done.trials], {"long_name": self.label}),
            "constraint_value": ((along, "constraint"), constraints.reshape(len(u), least.size)),
            "margin": ("constraint", least, {"long_name": "least value allowed"}),
            "breach": (
                along,
                np.array([breach(trial.slack, scales) for trial in done.trials]),
                {"long_name": "largest breach of a constraint, in widths of the bounds"},
            ),
            "kind": (along, np.array(done.kinds, int), flags(kind.name for kind in Kind)),
            "outcome": (along, np.array(outcomes, int), attrs_of("outcome")),
            "on_branch": (along, np.array([t.on_branch for t in done.trials])),
        }
        units = [measure_of(name).unit for name in self.constraint_names]
        labels = {
            along: np.arange(len(u)),
            "constraint": list(self.constraint_names),
            "constraint_unit": ("constraint", units),
        }
        attrs = {
            "title": f"Path of tuning {self.label} over {', '.join(self.free)}",
            "free": " ".join(self.free),  # as text: netCDF has no lists of names
            "lower": [float(v) for v in self.lower],
            "upper": [float(v) for v in self.upper],
            "ending": done.ending.name,
        }
        origin = provenance(self.params, self.finder.model, self.finder.step_options)
        return xr.Dataset(data, labels, attrs | origin)


def tuning_problem(
    params: WheelParams,
    objective: Objective,
    free: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    constraints: Margins | None = None,
    *,
    model: ModelLike | None = None,
    options: Options | None = None,
    cycle_options: CycleOptions | None = None,
) -> TuneProblem:
    """Return the validated problem that `tune` solves, for single gaits or another method.

    Raises: TypeError, ValueError: an invalid argument, described in one sentence.
    """
    one_wheel(params, "tune one after the other")
    names, lower, upper = _bounds(params, free, bounds)
    asked = rung_of(model)
    finder = finder_of(
        rung_of(serving(params, asked)),
        params.n_legs,
        cycle_options=cycle_options,
        step_options=options,
    )
    if not finder.model.legs_yield:
        raise TypeError(
            f"model is {model!r}, but what is tuned has compliant legs: give "
            "vrw.ViscoelasticWheel() or vrw.UnilateralWheel()."
        )
    finder.options_used.require_reachable(jnp.result_type(*jax.tree.leaves(params)))
    reader, label = _objective(objective, finder)
    if constraints is None and asked.upper is not asked and finder.from_nothing:
        constraints = tuple(PREMISES)
    margins = margins_of(params, constraints, finder)
    sought = Sought(reader, type(finder).read, tuple(margins))
    if callable(objective):  # checked before compilation
        cycle = jax.eval_shape(finder.cycle, params)
        x = jax.ShapeDtypeStruct((finder.model.section_size(params),), params.damping.dtype)
        step = jax.eval_shape(finder.model.step, params, x, finder.step_options)
        jax.eval_shape(sought, cycle, step)
    return TuneProblem(params, names, lower, upper, margins, label, sought, finder)


def _objective(objective: Objective, finder: AbstractGaitFinder) -> tuple[Reader, str]:
    if not (callable(objective) or isinstance(objective, str | Mapping)):
        raise TypeError(
            f"objective is {shown(objective)}, but it is a measure's name, weights of several or a "
            'function of the cycle: give "dls_fraction", say.'
        )
    if callable(objective):
        if not finder.from_nothing:
            raise TypeError(
                "objective is a function, but with contact it must be a measure's name or "
                f"weights of several: choose from {', '.join(finder.differentiable)}."
            )
        label = getattr(objective, "__name__", "objective")
        takes = inspect.signature(objective).parameters
        return (objective if len(takes) >= 2 else OfCycle(objective)), label
    weights = {objective: 1.0} if isinstance(objective, str) else dict(objective)
    if not weights:
        raise ValueError(
            "objective is an empty mapping, but something must be maximised: "
            'give a measure such as "dls_fraction".'
        )
    for name, weight in weights.items():
        require_known(name, finder.readable, "measure for objective")
        real(f"the weight of {name}", weight)
        if MEASURES[name].axis:
            raise ValueError(
                f"{name} has one value for each locked leg, but an objective is one number: "
                "give a function of the cycle and the step that reduces it."
            )
    label = " + ".join(n if w == 1.0 else f"{w:g} {n}" for n, w in weights.items())
    return Weighted(type(finder).read, tuple(weights.items())), label.replace("+ -", "- ")


def _bounds(
    params: WheelParams, free: Sequence[str], bounds: Mapping[str, tuple[float, float]]
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    names = names_of("free", free)
    instance("bounds", bounds, Mapping, "write {'damping': (100.0, 200.0)}")
    if len(set(names)) < len(names):
        raise ValueError(f"free is {names}, which names one twice: name each once.")
    if not names:
        raise ValueError(
            f"free names no parameter, but at least one must move: choose from "
            f"{', '.join(PARAMETER_NAMES)}."
        )
    for name in (*names, *bounds):
        require_known(name, PARAMETER_NAMES, "parameter of the wheel")
    for name in bounds:
        if name not in names:
            raise ValueError(f"bounds holds {name!r}, but it is not free: add it to free.")
    for name in names:
        if name not in bounds:
            raise ValueError(f"{name} is free but has no bounds: give bounds[{name!r}].")
        low, high = range_of(f"the range of {name}", bounds[name])
        for end in (low, high):
            if not DOMAINS[name].contains(end):
                raise ValueError(
                    f"the bounds of {name} reach {end:g}, but {DOMAINS[name].description} must lie "
                    f"in {DOMAINS[name]}: keep them inside."
                )
        value = float(getattr(params, name))
        if not low <= value <= high:
            raise ValueError(
                f"the start has {name} {value:g}, outside its bounds ({low:g}, {high:g}): "
                "widen the bounds or start inside them."
            )
    ends = np.array([[float(v) for v in bounds[name]] for name in names])
    return names, ends[:, 0], ends[:, 1]

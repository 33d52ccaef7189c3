"""Measures to within a tolerance, from the lowest model whose error can be bounded.

The lower model's gait takes one step with unilateral contact. The defect, propagated to the measure
by the lower model's derivatives, is that model's error to second order. This is a dual-weighted
residual (R. Becker and R. Rannacher, Acta Numerica 10, 2001) with the next model in place of the
finer mesh. If the error is within the tolerance, the lower model's value is returned. Otherwise the
same step is the first of an iteration to the gait with unilateral contact. If the iteration does
not contract, the gait is another one, and a walk leads to it.
"""

import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vrw_jax.answers.climbing import STRAY, Chord, Settled, settled
from vrw_jax.answers.lower import (
    GROUND,
    NONE,
    RIGID,
    Lower,
    contraction,
    no_gaits,
    paper_gaits,
    put,
    rigid_gaits,
)
from vrw_jax.answers.quantities import MADE, measured
from vrw_jax.answers.result import Answer, How
from vrw_jax.answers.top import TIGHT, TIGHTER, Ground
from vrw_jax.answers.walking import led
from vrw_jax.cycles import starts_of
from vrw_jax.gaits import Which, place_in_list
from vrw_jax.numerics import Options, taken
from vrw_jax.wheel import FRICTION, Outcome, WheelParams, friction_of
from vrw_jax.wording import (
    chosen,
    flag,
    instance,
    names_of,
    positive,
    require_known,
    untraced,
)

SAFETY = 4.0
"""Factor from the error estimate of one step to its bound, valid as long as corrections contract by
3/4."""
FINE = 1e-7
"""Tolerance of a measure below which steps use VERY_TIGHT_TOLERANCE."""
EXACT = 3
"""Number of steps after a loose walk, before corrections, because looser steps may end in other
modes."""
STAYING = 60
"""Number of steps of a walk that must stay near a gait if the gait is far from the end of the
previous walk."""
COLD = 2
"""Number of starts, slow ones first, for wheels without a lower gait. Of 232 wheels the first two
starts led 100 to a gait, and the other starts led none of the rest."""
BALL = 2.0
"""Largest distance of the gait with unilateral contact from the lower gait that it continues, in
first corrections. It is chosen because a contraction by a half moves at most so far."""
TRIES = 3
"""Number of steps from a lower gait with its own derivatives, before finite differences replace
them."""


def answer(
    measures: str | Sequence[str],
    params: WheelParams,
    tol: float,
    *,
    friction: Any = 0.7,
    relative: bool = False,
    stoppers: str = "bilateral",
    which: Which | None = None,
) -> Answer:
    """Return measures of the wheel's gait on ground of this friction, each to within `tol`.

    The reference is `UnilateralWheel(friction, stoppers=stoppers)`. Its gait is the one that
    continues the paper's gait, or else the one that a walk from the paper's gait reaches;
    `MeasureResult.explanation` names which. Fields of `params` and `friction` may have one batch
    axis; each element is computed independently.

    This function cannot be used inside `jax.jit`, because it depends on values.

    Args:
        measures: one name or several of speed, period, dls_fraction, step_length, duration_dls,
            duration_single, duration_flight, theta_touchdown, dtheta_touchdown, dL1_touchdown.
        params: the wheel, or a batch of wheels.
        tol: allowed error, in the measure's unit or relative to the value.
        friction: friction coefficient of the ground.
        relative: whether `tol` is relative to the value itself.
        stoppers: of the reference wheel, "bilateral" or "one-sided".
        which: "slowest", "fastest" or an index, slowest first, among the gaits with unilateral
            contact that walks from a stated set of starts reach; replaces the gait above.

    Returns:
        A `MeasureResult`.

    Raises:
        TypeError, ValueError: an invalid argument, described in one sentence.

    Examples:
        >>> wheel = vrw.WheelParams(damping=150.0)
        >>> result = vrw.measure_to_tolerance("speed", wheel, 1e-3, friction=50.0)
        >>> print(f"{result.value:.2f} m/s", result.error <= 1e-3)
        1.02 m/s True
    """
    began = time.perf_counter()
    untraced("vrw.answer", "it on numbers, and give lanes as arrays", params, friction)
    names = names_of("measures", measures)
    for name in names:
        require_known(name, tuple(MADE), "measure that every model has")
    if not names:
        raise ValueError("measures is empty, but at least one is needed: give 'speed', say.")
    tol, relative = positive("tol", tol), flag("relative", relative)
    chosen("stoppers", stoppers, ("bilateral", "one-sided"))
    params, mu, shape = known_lanes(params, friction_of(friction))
    place = None if which is None else place_in_list(which)
    tolerance = TIGHT if tol >= FINE else TIGHTER
    options = Options(rtol=tolerance, atol=tolerance)
    asked = _Asked(names, tol, relative, Ground.of(params, mu, stoppers, options), params)
    if place is None:
        asked.by_rigid()
        asked.by_paper()
        asked.by_walks()
    else:
        asked.by_list(place)
    told = jax.tree.map(lambda x: x.reshape(shape + x.shape[1:]), asked.told)
    del told["speeds"]
    return Answer(
        **told, names=names, single=isinstance(measures, str), cost=time.perf_counter() - began
    )


def known_lanes(
    params: WheelParams, friction: Any
) -> tuple[WheelParams, np.ndarray, tuple[int, ...]]:
    """Return wheels and friction broadcast to one batch axis, and the shape that they were given
    in."""
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    shapes = {np.shape(x) for x in (*jax.tree.leaves(params), friction)}
    shape = max(shapes, key=len)
    if len(shape) > 1 or shapes - {(), shape}:
        given = ", ".join(map(str, sorted(shapes - {()})))
        raise ValueError(
            f"parameters and {FRICTION} have shapes {given}, but lanes have one axis, the same for "
            "all: give one value for all, or one for each lane."
        )
    n = shape[0] if shape else 1
    lanes = lambda x: np.broadcast_to(np.asarray(x, float), (n,))
    return jax.tree.map(lambda x: jnp.asarray(lanes(x)), params), lanes(friction), shape


class _Asked:
    """Request for measures of a batch of wheels, with the results so far."""

    def __init__(
        self,
        names: tuple[str, ...],
        tol: float,
        relative: bool,
        ground: Ground,
        params: WheelParams,
    ) -> None:
        n, m = len(ground.columns.T), len(names)
        self.names, self.tol, self.relative = names, tol, relative
        self.ground, self.params, self.lower = ground, params, no_gaits(n)
        many = lambda fill: np.full((n, m), fill)
        self.told = {
            "values": many(np.nan), "errors": many(np.inf), "model_errors": many(np.nan),
            "numerical_errors": many(np.inf), "rungs": np.full(n, NONE),
            "hows": np.full(n, int(How.NO_GAIT)), "n_steps": np.zeros(n, int),
            "outcomes": np.full(n, int(Outcome.NO_CYCLE_FOUND)), "n_gaits": np.zeros(n, int),
            "speeds": np.full(n, np.nan), "states": ground.embedded(np.arange(n), np.zeros((n, 3))),
        }  # fmt: skip

    def goal(self, values: np.ndarray) -> np.ndarray:
        """Return the absolute tolerance of measures with about these values."""
        return self.tol * (np.abs(values) if self.relative else np.ones_like(values))

    @property
    def open(self) -> np.ndarray:
        """Return the indices of the elements without a result."""
        return np.flatnonzero(self.told["rungs"] == NONE)

    def by_rigid(self) -> None:
        """Try the rigid gait for wheels whose legs are stiff enough."""
        with np.errstate(all="ignore"):
            lanes = np.flatnonzero(SAFETY * contraction(self.params) <= self.tol)
        if not len(lanes):
            return
        put(self.lower, lanes, rigid_gaits(self._wheels(lanes)))
        lanes = lanes[np.isfinite(self.lower.told[lanes]).all(1)]
        self._from_gaits(lanes, corrected=False)

    def by_paper(self) -> None:
        """Try the paper's gaits, and the nearby gaits with unilateral contact if their values are
        not accurate enough."""
        lanes = self.open
        if not len(lanes):
            return
        put(self.lower, lanes, paper_gaits(self._wheels(lanes), self.ground.options))
        self._from_gaits(lanes[self.lower.rung[lanes] != NONE], corrected=True)

    def by_walks(self) -> None:
        """Walk to the gaits with unilateral contact that are far from the paper's gait, or where it
        has none."""
        lanes = self.open
        if not len(lanes):
            return
        has = self.lower.rung[lanes] != NONE
        begin = self.ground.embedded(lanes[has], self.lower.x[lanes[has]])
        self._walk(lanes[has], begin, How.WALKED)
        lanes = lanes[~has]
        if not len(lanes):
            return
        for start in starts_of(self._wheels(lanes))[:COLD]:
            still = self.told["rungs"][lanes] == NONE
            begin = self.ground.embedded(lanes[still], start[still])
            self._walk(lanes[still], begin, How.FROM_START)

    def by_list(self, place: int) -> None:
        """Select the gait of this rank, slowest first, among those that walks from all starts
        reach."""
        lanes, blank, each = self.open, self.told, []
        for start in starts_of(self.params):
            self.told = {name: x.copy() for name, x in blank.items()}
            self._walk(lanes, self.ground.embedded(lanes, start), How.CHOSEN)
            each.append(self.told)
        self.told = blank
        blank["n_steps"][:] = np.sum([told["n_steps"] for told in each], axis=0)
        for lane in lanes:
            gaits = _apart([{name: x[lane] for name, x in told.items()} for told in each])
            blank["n_gaits"][lane] = len(gaits)
            if -len(gaits) <= place < len(gaits):
                for name in blank.keys() - {"n_steps", "n_gaits"}:
                    blank[name][lane] = gaits[place][name]

    def _wheels(self, lanes: np.ndarray) -> WheelParams:
        return jax.device_put(taken(self.params, lanes))

    def _from_gaits(self, lanes: np.ndarray, corrected: bool) -> None:
        """Take one step with unilateral contact from the lower gaits, and more steps if one is not
        enough."""
        if not len(lanes):
            return
        lower = Lower(*(part[lanes] for part in self.lower))
        x = self.ground.embedded(lanes, lower.x, lower.rung == RIGID)
        chord = Chord.of(self.ground, lanes, x, lower)
        every = np.arange(len(lanes))
        first = chord.step(every)
        seen = chord.see(every, first, self.names)
        value = measured(self.names, lower.told)
        with np.errstate(all="ignore"):
            size = np.abs(measured(self.names, first.told) - value) + seen.size
            error = value - seen.values
            plane = self.ground.plane()
            along = np.abs(seen.direct @ chord.moved[:, :, plane])
            own = np.einsum("ijk,ik->ij", along, np.abs(lower.own))
            numerical = own + seen.numerical + seen.brief
            bound = np.abs(error) + (SAFETY - 1.0) * size + numerical
            stands = seen.same & np.all(bound <= self.goal(value), axis=1)
        self.told["n_steps"][lanes] += 1
        self._tell(lanes[stands], lower.rung[stands], How.CHECKED, {
            "values": value[stands], "errors": bound[stands], "model_errors": error[stands],
            "numerical_errors": numerical[stands], "states": x[stands],
        })  # fmt: skip
        rest = np.flatnonzero(~stands & seen.same)
        if not corrected or not len(rest):
            return
        reach = BALL * np.linalg.norm(chord.correction[rest][:, plane], axis=1)
        begun = jax.tree.map(lambda part: part[rest], (first, seen))
        found = settled(chord.some(rest), self.names, self.goal, TRIES, begun)
        near = np.linalg.norm((found.x - x[rest])[:, plane], axis=1) <= reach
        self._take(lanes[rest], found._replace(done=found.done & near), How.CORRECTED)

    def _walk(self, lanes: np.ndarray, x: np.ndarray, how: How) -> None:
        """Walk from the states, and correct the ends of the walks."""
        walk = led(self.ground, lanes, x)
        self.told["n_steps"][lanes] += walk.n_steps
        # A step cannot begin if a wheel has turned more than once in flight.
        walks = np.isin(walk.outcome, (Outcome.STEPPED, Outcome.BAD_INPUT))
        self.told["outcomes"][lanes] = np.where(walks, Outcome.NO_CYCLE_FOUND, walk.outcome)
        lanes, x = lanes[walk.rests], walk.x[walk.rests]
        if not len(lanes):
            return
        step = self.ground.step(lanes, x, EXACT)
        self.told["n_steps"][lanes] += EXACT
        on = step.outcome == Outcome.STEPPED
        lanes, x = lanes[on], step.x[on]
        chord = Chord.of(self.ground, lanes, x, None)
        found = settled(chord, self.names, self.goal, 0)
        found.done[found.done] = chord.some(found.done).attract()
        far = np.flatnonzero(found.done & (chord.away(x) > STRAY))
        found.done[far] = chord.some(far).stay(STAYING)
        found.n_steps[far] += STAYING
        self._take(lanes, found, how)

    def _take(self, lanes: np.ndarray, found: Settled, how: How) -> None:
        """Record gaits with unilateral contact."""
        self.told["n_steps"][lanes] += found.n_steps
        lanes, found = lanes[found.done], Settled(*(part[found.done] for part in found))
        has = (self.lower.rung[lanes] != NONE)[:, None]
        value = measured(self.names, np.where(has, self.lower.told[lanes], np.nan))
        self._tell(lanes, np.full(len(lanes), GROUND), how, {
            "values": found.values, "errors": found.left + found.numerical,
            "model_errors": value - found.values,
            "numerical_errors": found.left + found.numerical, "speeds": found.speed,
            "states": found.x,
        })  # fmt: skip

    def _tell(
        self, lanes: np.ndarray, rung: np.ndarray, how: How, told: dict[str, np.ndarray]
    ) -> None:
        for name, values in told.items():
            self.told[name][lanes] = values
        self.told["rungs"][lanes], self.told["hows"][lanes] = rung, how
        self.told["outcomes"][lanes] = Outcome.STEPPED


def _apart(told: list[dict[str, np.ndarray]]) -> list[dict[str, np.ndarray]]:
    """Return the gaits of one wheel that differ by more than their errors, slowest first."""
    kept: list[dict[str, np.ndarray]] = []
    for one in told:
        apart = (
            np.any(np.abs(one["values"] - other["values"]) > one["errors"] + other["errors"])
            for other in kept
        )
        if one["rungs"] != NONE and all(apart):
            kept.append(one)
    return sorted(kept, key=lambda one: one["speeds"])

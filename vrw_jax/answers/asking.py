"""An answer to within a tolerance, by the lowest rung that can be shown to give it.

The lower rung's gait takes one step on real ground. The defect, carried to the measure by the lower
rung's derivatives, is that rung's error to second order: a dual-weighted residual (R. Becker and
R. Rannacher, Acta Numerica 10, 2001) with the next model in place of the finer mesh. Within the
tolerance the lower rung's value stands; else the same step is the first of an iteration to the gait
on real ground, and what does not contract is another gait: it is walked to.
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
"""What one step says of an error, times this, bounds it: as long as corrections contract to 3/4."""
FINE = 1e-7
"""Tolerance of an answer below which steps are taken at TIGHTER."""
EXACT = 3
"""Steps of a walk after the loose ones, before corrections: looser steps may end in other modes."""
STAYING = 60
"""Steps of a walk that must stay at a gait which lies off where the walk to it ended."""
COLD = 2
"""Starts, slow ones first, of wheels without a lower gait: of 232 the first two led 100 to a gait,
the others none of the rest."""
BALL = 2.0
"""How far, in first corrections, the gait on real ground may lie from the lower one that it
continues: so far a contraction to a half leads at most."""
TRIES = 3
"""Steps from a lower gait with its own derivatives, before differences take their place."""


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
    """Measures of the wheel's gait on ground of this friction, each to within `tol`.

    The truth that is meant is `UnilateralWheel(friction, stoppers=stoppers)`; the gait is the one
    that continues the paper's, or where none does the one that a walk from the paper's reaches, and
    `Answer.why` says which. Fields of `params` and
    `friction` may have one axis, of lanes: each is answered by itself.

    Not for use inside `jax.jit`: it goes by values.

    Args:
        measures: one name or several of speed, period, dls_fraction, step_length, duration_dls,
            duration_single, duration_flight, theta_touchdown, dtheta_touchdown, dL1_touchdown.
        params: the wheel, or lanes of them.
        tol: error allowed, in the measure's unit or by the value.
        friction: of the ground.
        relative: whether `tol` counts by the value itself.
        stoppers: of the wheel that is meant, "bilateral" or "one-sided".
        which: "slowest", "fastest" or a place, slowest first, among the gaits on real ground that
            walks from a stated set of starts lead to, in place of the gait above.

    Returns:
        An `Answer`.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.

    Examples:
        >>> told = vrw.answer("speed", vrw.WheelParams(damping=150.0), 1e-3, friction=50.0)
        >>> print(f"{told.value:.2f} m/s", told.error <= 1e-3)
        1.02 m/s True
    """
    began = time.perf_counter()
    untraced("vrw.answer", "it on numbers, and give lanes as arrays", params, friction)
    names = names_of("measures", measures)
    for name in names:
        require_known(name, tuple(MADE), "measure that every rung tells")
    if not names:
        raise ValueError("measures are none, but an answer needs a question: give 'speed', say.")
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
    """Wheels and friction with one axis of lanes each, and the shape that they were given in."""
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
    """A question in lanes, and what has been answered of it."""

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
        """The tolerance of measures with about these values."""
        return self.tol * (np.abs(values) if self.relative else np.ones_like(values))

    @property
    def open(self) -> np.ndarray:
        """Lanes without an answer."""
        return np.flatnonzero(self.told["rungs"] == NONE)

    def by_rigid(self) -> None:
        """Wheels whose legs yield so little that the rigid gait may do."""
        with np.errstate(all="ignore"):
            lanes = np.flatnonzero(SAFETY * contraction(self.params) <= self.tol)
        if not len(lanes):
            return
        put(self.lower, lanes, rigid_gaits(self._wheels(lanes)))
        lanes = lanes[np.isfinite(self.lower.told[lanes]).all(1)]
        self._from_gaits(lanes, corrected=False)

    def by_paper(self) -> None:
        """The paper's gaits, and where their values don't do, real ground near them."""
        lanes = self.open
        if not len(lanes):
            return
        put(self.lower, lanes, paper_gaits(self._wheels(lanes), self.ground.options))
        self._from_gaits(lanes[self.lower.rung[lanes] != NONE], corrected=True)

    def by_walks(self) -> None:
        """Gaits on real ground that are far from the paper's, or that it has none for."""
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
        """The gait at a place, slowest first, of those that walks from all starts lead to."""
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
        """One step on real ground from the lower gaits, and more where that is not enough."""
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
        """To where walks lead, and from there by corrections."""
        walk = led(self.ground, lanes, x)
        self.told["n_steps"][lanes] += walk.n_steps
        # No step begins where a wheel has turned more than once in flight.
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
        """Gaits on real ground."""
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
    """Of one wheel what differs by more than it may be wrong by, slowest first."""
    kept: list[dict[str, np.ndarray]] = []
    for one in told:
        apart = (
            np.any(np.abs(one["values"] - other["values"]) > one["errors"] + other["errors"])
            for other in kept
        )
        if one["rungs"] != NONE and all(apart):
            kept.append(one)
    return sorted(kept, key=lambda one: one["speeds"])

"""Missed and late events of the lane engine, against isolated roots.

heyoka follows the same phases by Taylor series and isolates every root of each guard's polynomial
(Descartes' rule of signs), so that no crossing inside a step is overlooked, however short. Guards
and their order are those of `vrw_jax.models.viscoelastic`.
"""

import math
from collections.abc import Iterator

import jax
import numpy as np
from rich.progress import track

import vrw_jax as vrw
from experiments.speed import peers
from experiments.speed.peers import hy
from vrw_jax import Outcome
from vrw_jax.lanes import select_tree_rows
from vrw_jax.wheel import Motion, Symbols, dynamics, transitions

Rows = Iterator[dict[str, object]]
START = np.array([0.1, 1.6, -0.1])  # near the gait of Table 1
CHUNK, N_STARTS = 10_000, 250_000
LATE_EVENT_SECONDS = 1e-8  # s: a hundred times the engine's error at its default tolerance
TOLERANCE = 1e-15
LIMIT = 20.0  # s, of a phase, as in vrw.Options
FALLS = (Outcome.FELL_BACK, Outcome.COLLAPSED, Outcome.COLLAPSED, Outcome.LEG_1_LIFTED_OFF)
KINDS = {  # ranges of wheels and starts
    "anywhere": {
        "damping": (20.0, 400.0),
        "stiffness": (50.0, 3000.0),
        "natural_length": (0.95, 1.15),
        "slope": (0.02, 0.5),
        "start": ((-0.4, 0.4), (0.3, 6.0), (-2.0, 1.0)),
    },
    "near gaits": {
        "damping": (20.0, 260.0),
        "stiffness": (400.0, 600.0),
        "natural_length": (1.005, 1.04),
        "slope": (0.25, 0.34),
        "start": ((0.05, 0.15), (1.0, 2.6), (-0.5, 0.1)),
    },
}
"""Half of the cases each."""


def symbols() -> Symbols:
    """Return the paper's symbols as run-time parameters of heyoka, in the order of `peers.pack`."""
    m, a, L0, Ls, k, c, g, sin_phi, cos_phi, Mh = (hy.par[i] for i in range(10))
    return Symbols(
        m=m, a=a, L0=L0, Ls=Ls, k=k, c=c, g=g, sin_phi=sin_phi, cos_phi=cos_phi, Mh=Mh, Mt=Mh + m,
        c0=L0 - a, n=8, sin_alpha=peers.SA, cos_alpha=peers.CA, alpha=peers.ALPHA,
    )  # fmt: skip


class Phase:
    """One phase: its integrator, its guards at the start, and what they mean."""

    def __init__(self, system: list, guards: list, outcomes: tuple[Outcome, ...]) -> None:
        fall = hy.event_direction.negative
        self.flow = hy.taylor_adaptive(
            system,
            [1.0] * len(system),
            tol=TOLERANCE,
            t_events=[hy.t_event(guard, direction=fall) for guard in guards],
        )
        variables = [pair[0] for pair in system]
        self.guards = hy.cfunc(guards, variables)
        self.outcomes = outcomes
        self.limit = LIMIT

    def run(self, y: np.ndarray, parameters: tuple) -> tuple[Outcome, np.ndarray, float]:
        """Outcome, state and duration."""
        parameter_values = np.array(parameters[: self.guards.nparams])
        values = self.guards(y, pars=parameter_values) if len(parameter_values) else self.guards(y)
        if np.any(values < 0.0):
            return self.outcomes[int(np.argmax(values < 0.0))], y, 0.0
        flow = self.flow
        flow.reset_cooldowns()
        flow.time, flow.state[:] = 0.0, y
        flow.pars[:] = parameters[: len(flow.pars)]
        code = int(flow.propagate_until(self.limit)[0])
        if code == int(hy.taylor_outcome.time_limit):
            return Outcome.NO_TOUCHDOWN_IN_TIME, flow.state, self.limit
        if not -len(self.outcomes) <= code < 0:
            return Outcome.SOLVER_FAILED, flow.state, flow.time
        return self.outcomes[-code - 1], flow.state.copy(), flow.time


def phases() -> tuple[Phase, Phase, Phase]:
    """DLS, SLS-I and SLS-II with all guards."""
    P = [hy.par[i] for i in range(10)]
    s = symbols()
    th, L1, L2, w, v1, v2 = hy.make_vars("th", "L1", "L2", "w", "v1", "v2")
    sin, cos = hy.sin(th), hy.cos(th)

    x1, rear_normal, *_ = peers.double_support(sin, cos, w, hy.par[10], P)
    circle = dynamics.compute_double_support_circle(s, hy.par[10], sin, cos)
    m = Motion(sin, cos, circle.L1, circle.L2, w, circle.dL1_dtheta * w, circle.dL2_dtheta * w)
    a = dynamics.Acceleration(
        x1, circle.dL1_dtheta * x1 - circle.L1 * w * w, circle.dL2_dtheta * x1 - circle.L2 * w * w
    )
    rear = dynamics.compute_rear_foot_force(s, m, a)
    height = dynamics.compute_landing_foot_height
    falls = lambda m, fore: [m.dtheta, m.L1 - s.a, m.L2 - s.a, fore.normal]
    dls = Phase(
        [(th, w), (w, x1)],
        [
            rear_normal,
            s.L0 - m.L2,
            height(s, m),
            *falls(m, dynamics.compute_fore_foot_force(s, m, a, rear)),
        ],
        (
            Outcome.STEPPED,
            Outcome.STOPPER_IN_DOUBLE_SUPPORT,
            Outcome.TOUCHDOWN_BEFORE_STOPPER,
            *FALLS,
        ),
    )
    x = peers.single_support_1(sin, cos, L1, L2, w, v1, v2, P)
    m, a = Motion(sin, cos, L1, L2, w, v1, v2), dynamics.Acceleration(*x)
    sls1 = Phase(
        [(th, w), (L1, v1), (L2, v2), (w, x[0]), (v1, x[1]), (v2, x[2])],
        [s.L0 - L2, height(s, m), *falls(m, dynamics.compute_fore_foot_force(s, m, a))],
        (Outcome.STEPPED, Outcome.TOUCHDOWN_BEFORE_STOPPER, *FALLS),
    )
    z = peers.single_support_2(sin, cos, L1, w, v1, P)
    m = Motion(sin, cos, L1, s.L0, w, v1, 0.0 * v1)
    a = dynamics.Acceleration(*z, 0.0 * z[0])
    fore = dynamics.compute_fore_foot_force(s, m, a)
    sls2 = Phase(
        [(th, w), (L1, v1), (w, z[0]), (v1, z[1])],
        [height(s, m), w, L1 - s.a, fore.normal],
        (Outcome.STEPPED, Outcome.FELL_BACK, Outcome.COLLAPSED, Outcome.LEG_1_LIFTED_OFF),
    )
    return dls, sls1, sls2


def step_by_isolated_roots(created: tuple, params: vrw.WheelParams, starts: np.ndarray) -> tuple:
    """Outcome, durations and section state (zeros where it failed) of one step of each lane."""
    dls, sls1, sls2 = created
    packed = peers.pack(params)
    landing = transitions.resolve_landing(params.symbols(), *starts.T)
    stays = np.asarray(landing.is_rear_foot_planted)
    posture = np.stack(
        [landing.theta_after_landing, *landing.motion_after[2:]], 1
    )  # theta, L1, L2 and rates
    outcomes, durations, ends = np.zeros(len(starts), int), *np.zeros((2, len(starts), 3))
    for lane, values in enumerate(packed):
        P = tuple(values)
        y, code = posture[lane], Outcome.STEPPED
        if stays[lane]:
            D = P[2] * peers.SA / (math.cos(y[0]) * peers.CA - math.sin(y[0]) * peers.SA)
            code, result, durations[lane, 0] = dls.run(y[[0, 3]], (*P, D))
            sin, cos = math.sin(result[0]), math.cos(result[0])
            _, _, L1, L2, v1, v2 = peers.n_dls(sin, cos, result[1], D, P)
            y = np.array([result[0], L1, L2, result[1], v1, v2])
        if code == Outcome.STEPPED:
            code, result, durations[lane, 1] = sls1.run(y, P)
            y = result.copy()
        if code == Outcome.STEPPED:
            peers.hit_numba(y, P)
            code, result, durations[lane, 2] = sls2.run(y[:4], P)
        outcomes[lane] = code
        if code == Outcome.STEPPED:
            ends[lane] = result[[0, 2, 3]]
    return outcomes, durations, ends


def draw_wheels(
    box: dict, random: np.random.Generator, count: int = CHUNK
) -> tuple[vrw.WheelParams, np.ndarray]:
    """Draw random wheels and starts."""
    draw = lambda limits: random.uniform(*limits, count)
    fields = {name: draw(limits) for name, limits in box.items() if name != "start"}
    return vrw.WheelParams(**fields), np.stack([draw(limits) for limits in box["start"]], 1)


def compare(cases: int, done: int) -> Rows:
    """Count disagreements chunk by chunk, without the first `done` chunks."""
    created = phases()
    n_chunks = cases // len(KINDS) // CHUNK
    places = [(i, kind, chunk) for chunk in range(n_chunks) for i, kind in enumerate(KINDS)]
    for i, kind, chunk in track(places[done:], "events"):
        params, starts = draw_wheels(KINDS[kind], np.random.default_rng((7, i, chunk)))
        batch_result = vrw.step_batch(params, starts)
        codes, durations, _ = step_by_isolated_roots(created, params, starts)
        mine = np.asarray(batch_result.outcome)
        other = mine != codes
        has_stepped_in_both = ~other & (mine == Outcome.STEPPED)
        gap = np.max(np.abs(np.asarray(batch_result.durations) - durations), 1)
        differing = zip(mine[other], codes[other], strict=True)
        pairs = [f"{Outcome(a).name}/{Outcome(b).name}" for a, b in differing]
        counts = [f"{pair}: {pairs.count(pair)}" for pair in sorted(set(pairs))]
        yield {
            "kind": kind,
            "chunk": chunk,
            "cases": CHUNK,
            "stepped": int(has_stepped_in_both.sum()),
            "other_outcome": int(other.sum()),
            "late": int((has_stepped_in_both & (gap > LATE_EVENT_SECONDS)).sum()),
            "largest_time_difference": f"{np.max(gap[has_stepped_in_both], initial=0.0):.2e}",
            "ours/isolated": "; ".join(counts),
        }


def compare_dips(cases: int, done: int) -> Rows:
    """Compare steps at the defaults with `StepOptions.tight()`, chunk by chunk, by isolated roots.

    If a rate or a height decays to round-off, the outcomes "fell back" and "no touchdown" are
    indistinguishable, and either method may fail. These cases have a separate count.
    """
    created = phases()
    n_chunks = cases // len(KINDS) // N_STARTS
    places = [(i, kind, chunk) for chunk in range(n_chunks) for i, kind in enumerate(KINDS)]
    for i, kind, chunk in track(places[done:], "dips"):
        params, starts = draw_wheels(KINDS[kind], np.random.default_rng((11, i, chunk)), N_STARTS)
        mine, tight = (
            np.asarray(vrw.step_batch(params, starts, options=options).outcome)
            for options in (vrw.StepOptions(), vrw.StepOptions.tight())
        )
        gave_up = (mine == Outcome.SOLVER_FAILED) | (tight == Outcome.SOLVER_FAILED)
        requested = np.flatnonzero((mine != tight) & ~gave_up)
        selected_wheels = select_tree_rows(
            jax.tree.map(lambda x: np.broadcast_to(x, N_STARTS), params), requested
        )
        codes = (
            step_by_isolated_roots(created, selected_wheels, starts[requested])[0]
            if len(requested)
            else mine[requested]
        )
        other = requested[mine[requested] != codes]
        pairs = zip(mine[other], codes[mine[requested] != codes], strict=True)
        yield {
            "kind": kind,
            "chunk": chunk,
            "cases": N_STARTS,
            "stepped": int((mine == Outcome.STEPPED).sum()),
            "gave_up": int(gave_up.sum()),
            "differ": len(requested),
            "other_outcome": len(other),
            "other_by_tight": int((tight[requested] != codes).sum()),
            "ours/isolated": "; ".join(f"{Outcome(a).name}/{Outcome(b).name}" for a, b in pairs),
        }

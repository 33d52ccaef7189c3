"""Limits of the model and corners between outcomes.

What happens where a parameter or a start runs to its limit, whether a leg without its own inertia
(of first order) could stand in for a stiff one, how a gait slows down before it stops, and who is
right next to a border between two outcomes.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import vrw_jax as vrw
from experiments.atlas import events
from experiments.atlas.events import START, Rows
from experiments.shared.timing import measure_cpu_seconds
from experiments.speed import peers
from vrw_jax import Outcome
from vrw_jax.hybrid import GuardsAndMargins, integrate_phase
from vrw_jax.models.phase_sequence import make_element_phase
from vrw_jax.wheel import (
    Motion,
    Symbols,
    compute_landing_foot_height,
    dynamics,
    make_paper_phases,
    transitions,
)

# --- A leg of first order: SLS-I without the airborne leg's own inertia.


def light_wheel(rate: float) -> dict[str, float]:
    """Table 1 at c = 100 N s/m with legs so light that c/m is `rate`, 1/s; its total mass stays."""
    mass = 100.0 / rate
    return {"leg_mass": mass, "damping": 100.0, "hub_mass": 18.0 - 8.0 * mass}


LANES = 256
LEGS = ("full", "first order", "corrected")
TOLERANCE = 1e-8
LIGHT = {  # c/m, 1/s: Table 1 itself, then ever lighter legs at c = 100 N s/m and its total mass
    200.0: {},
    **{rate: light_wheel(rate) for rate in (3e2, 1e3, 3e3, 1e4, 3e4, 1e5)},
}


def first_order_rates(s: Symbols, y: jax.Array, ddL2: jax.Array | float = 0.0) -> jax.Array:
    """(theta', L1', L2', theta'', L1'') of y = (theta, L1, L2, theta', L1') with L2'' given.

    Forces are linear in L2': with L2'' known the three rows of M q'' = f give theta'', L1'', L2'.
    """
    theta, L1, L2, dtheta, dL1 = y
    evaluate_terms = lambda dL2: dynamics.compute_equation_terms(
        s, Motion.from_angle(theta, L1, L2, dtheta, dL1, dL2)
    )
    zero = 0.0 * theta
    M, *rest = evaluate_terms(zero)
    slope = [a - b for a, b in zip(evaluate_terms(zero + 1.0)[1:], rest, strict=True)]
    rows = [[M.M11, M.M12, -slope[0]], [M.M12, M.M22, -slope[1]], [M.M13, M.M23, -slope[2]]]
    rows = [[zero + entry for entry in row] for row in rows]
    column = jnp.stack([M.M13 + zero, M.M23 + zero, M.M33 + zero])
    right = jnp.stack(rest) - column * ddL2
    ddtheta, ddL1, dL2 = jnp.linalg.solve(jnp.array(rows), right)
    return jnp.stack([dtheta, dL1, dL2, ddtheta, ddL1])


def corrected_rates(s: Symbols, y: jax.Array) -> jax.Array:
    """Return rates with L2'' corrected by the change of L2', an order more accurate in m/c."""
    slow = lambda y: first_order_rates(s, y)
    rates = slow(y)
    return first_order_rates(s, y, jax.jvp(slow, (y,), (rates,))[1][2])


def after_the_layer(s: Symbols, state: jax.Array, rates: Callable) -> jax.Array:
    """Return the state after the fast mode of lift-off, to first order in m/c.

    The difference of L2' from its slow value decays at the rate c (M^-1)_33. It changes rates and
    positions along M^-1 e_3, as an impact does.
    """
    M = dynamics.compute_mass_matrix(s, state[1], state[2])
    zero = 0.0 * state[0]
    matrix = [[M.M11, M.M12, M.M13], [M.M12, M.M22, M.M23], [M.M13, M.M23, M.M33]]
    matrix = jnp.array([[zero + entry for entry in row] for row in matrix])
    leg_direction = jnp.linalg.solve(matrix, jnp.array([0.0, 0.0, 1.0]))
    y = state[:5]
    for _ in range(3):  # the slow value is that of the state left behind
        excess = state[5] - rates(y)[2]
        jump = leg_direction * excess / leg_direction[2]
        shifted = state[:3] + jump / (s.c * leg_direction[2])
        y = jnp.concatenate([shifted, state[3:5] - jump[:2]])
    return y


def step_with_leg(
    leg: str, params: vrw.WheelParams, x: jax.Array, options: vrw.StepOptions
) -> tuple:
    """Section state and durations, and solver steps and outcome of SLS-I, of a step."""
    s = params.symbols()
    landing = transitions.resolve_landing(s, *x)
    is_requested = jnp.asarray(True)
    phases = make_paper_phases(s, landing.foot_distance, stop_at_lift_off=True)
    dls, sls1, sls2 = (make_element_phase(phase, records_margins=False) for phase in phases)
    run = lambda phase, y: integrate_phase(
        phase.vector_field, phase.guards, y, is_requested, options
    )
    first = run(dls, jnp.stack([landing.theta_after_landing, landing.motion_after.dtheta]))
    m = dls.motion_unpacker(first.state)
    state = jnp.stack([first.state[0], m.L1, m.L2, m.dtheta, m.dL1, m.dL2])
    if leg == "full":
        second = run(sls1, state)
        motion = sls1.motion_unpacker(second.state)
    else:
        rates = lambda y: (corrected_rates if leg == "corrected" else first_order_rates)(s, y)
        full = lambda y: Motion.from_angle(y[0], y[1], y[2], y[3], y[4], rates(y)[2])
        start = after_the_layer(s, state, rates) if leg == "corrected" else state[:5]

        def guards(y: jax.Array) -> jax.Array:
            return jnp.stack([s.L0 - y[2], compute_landing_foot_height(s, full(y)), y[3]])

        second = integrate_phase(rates, GuardsAndMargins(guards, 3), start, is_requested, options)
        motion = full(second.state)
    hit = transitions.resolve_stopper_collision(s, motion).motion_after
    third = run(sls2, jnp.stack([second.state[0], hit.L1, hit.dtheta, hit.dL1]))
    theta, _, dtheta, dL1 = third.state
    durations = jnp.stack([first.duration, second.duration, third.duration])
    joined_values = jnp.concatenate([jnp.stack([theta, dtheta, dL1]), durations])
    return joined_values, second.solver_steps, second.end_guard_index


def first_order() -> Rows:
    """Error and cost of legs of first order over c/m, Tsit5, against isolated roots."""
    options = vrw.StepOptions(solver="Tsit5", rtol=TOLERANCE, atol=TOLERANCE)
    runs = {}
    for leg in LEGS:
        one = lambda params, x, leg=leg: step_with_leg(leg, params, x, options)
        runs[leg] = jax.jit(jax.vmap(one))
    for rate, wheel in LIGHT.items():
        params = vrw.WheelParams(**wheel)
        params = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (LANES,)), params)
        landing = transitions.resolve_landing(params.symbols(), *START)
        y = np.stack(
            [
                landing.theta_after_landing + 0.0 * landing.motion_after.dtheta,
                landing.motion_after.dtheta,
            ],
            1,
        )[:1]
        reference = peers.Heyoka(1e-15)(y, peers.pack(params)[:1])[0, :6]
        for leg, run in runs.items():
            call = lambda run=run, params=params: jax.block_until_ready(
                run(params, jnp.tile(START, (LANES, 1)))
            )
            result, steps, guard = call()
            yield {
                "c_over_m": f"{rate:.4g}",
                "leg": leg,
                "error": f"{np.max(np.abs(np.asarray(result[0]) - reference)):.2e}",
                "steps_sls1": int(steps[0]),
                "us_per_gait": f"{measure_cpu_seconds(call) / LANES * 1e6:.4g}",
                "ended_on_stopper": bool(guard[0] == 0),
            }


# --- One parameter or start to its limit, all else Table 1's.

at_start = lambda rate: {"start": (START[0], rate, START[2] * rate / START[1])}
SWEEPS: dict[str, tuple[Callable[[float], dict], tuple[float, ...]]] = {
    "c → ∞ [N s/m]": (
        lambda c: {"damping": c},
        (200.0, 300.0, 500.0, 1e3, 1e4, 1e5, 1e6),
    ),
    "k → ∞, preload 10 N [N/m]": (
        lambda k: {"stiffness": k, "natural_length": 1.0 + 10.0 / k},
        (500.0, 1e3, 2e3, 5e3, 1e4, 1e5, 1e6, 1e7, 1e8),
    ),
    "L* − L0 → 0 [m]": (
        lambda stretch: {"natural_length": 1.0 + stretch},
        (2e-2, 1.5e-2, 1.2e-2, 1e-2, 1e-3, 1e-6, 1e-9, 0.0),
    ),
    "L* − L0 → 0 at c = 50 [m]": (
        lambda stretch: {"natural_length": 1.0 + stretch, "damping": 50.0},
        (2e-2, 1e-2, 1e-3, 1e-6, 1e-9, 0.0),
    ),
    "slope → 0 [rad]": (
        lambda slope: {"slope": slope},
        (0.3, 0.2, 0.15, 0.1, 0.05, 0.01, 1e-3, 1e-6, 0.0),
    ),
    "rates → 0, by that of θ [rad/s]": (
        at_start,
        (1.6, 0.5, 0.1, 1e-2, 1e-4, 1e-6, 1e-9, 1e-12),
    ),
    "rates → 0 on level ground [rad/s]": (
        lambda rate: at_start(rate) | {"slope": 0.0},
        (1.6, 0.5, 0.1, 1e-2, 1e-4, 1e-6, 1e-9, 1e-12),
    ),
}


def limits() -> Rows:
    """Outcome and error of one step of `vrw.steps` towards each limit, against isolated roots."""
    created = events.phases()
    for sweep, (given, values) in SWEEPS.items():
        for value in values:
            wheel = {"damping": 200.0} | given(value)
            start = np.array([wheel.pop("start", START)])
            params = vrw.WheelParams(**{key: np.full(1, v) for key, v in wheel.items()})
            (code,), (durations,), _ = events.step_by_isolated_roots(created, params, start)
            batch_result = vrw.step_batch(params, start)
            yield {
                "limit": sweep,
                "value": f"{value:.4g}",
                "outcome": Outcome(int(batch_result.outcome[0])).name,
                "isolated": Outcome(code).name,
                "time_difference_s": f"{np.max(np.abs(batch_result.durations[0] - durations)):.1e}",
                "solver_steps": int(batch_result.solver_steps[0]),
                "solver": batch_result.solver_names[int(batch_result.solver_index[0])],
                "durations": " ".join(f"{d:.3g}" for d in durations),
            }


# --- The gait slows down before it stops: step time to infinity.

SLOW_WALK_PARAMETERS = {"damping": 100.0}
WALKS, STANDING_SLOPE = 0.12, 0.02  # slopes, rad
SETTLING = 12  # steps: neighbours' gaits are near, and multipliers small
MAX_DOUBLE_SUPPORT_SECONDS = 200.0  # s of double support
SLOPE_DISTANCES = np.logspace(-1.5, -11.0, 20)  # slope less the one at which the gait stops, rad


def settle_walk(
    created: tuple, slope: float, start: np.ndarray
) -> tuple[bool, np.ndarray, np.ndarray]:
    """Return whether the wheel walks from a start, and its last section state and durations."""
    params = vrw.WheelParams(
        damping=np.full(1, SLOW_WALK_PARAMETERS["damping"]), slope=np.full(1, slope)
    )
    for _ in range(SETTLING):
        (code,), (durations,), (start,) = events.step_by_isolated_roots(
            created, params, start[None]
        )
        if code != Outcome.STEPPED:
            return False, start, durations
    return True, start, durations


def upright_rate(slope: float, start: np.ndarray) -> float:
    """Rate at which double support leaves its upright equilibrium, 1/s; NaN without one."""
    s = vrw.WheelParams(**SLOW_WALK_PARAMETERS, slope=slope).symbols()
    landing = transitions.resolve_landing(s, *start)
    double_support = make_paper_phases(s, landing.foot_distance, stop_at_lift_off=True)[0]
    field = make_element_phase(double_support, records_margins=False).vector_field
    push = jax.jit(lambda theta: field(jnp.stack([theta, 0.0 * theta]))[1])
    places = float(landing.theta_after_landing) + np.linspace(0.0, 1.0, 2001)
    rises = np.diff(np.sign(np.asarray(jax.vmap(push)(jnp.asarray(places))))) > 0
    if not np.any(rises):
        return np.nan
    turning_angle = places[np.flatnonzero(rises)[0]]
    for _ in range(5):
        turning_angle = turning_angle - push(turning_angle) / jax.grad(push)(turning_angle)
    matrix = np.asarray(jax.jacfwd(field)(jnp.stack([turning_angle, 0.0 * turning_angle])))
    return float(np.max(np.linalg.eigvals(matrix).real))


def slowing() -> Rows:
    """Period of the gait towards the slope at which it stops, and who still finds the gait."""
    created = events.phases()
    created[0].limit = MAX_DOUBLE_SUPPORT_SECONDS
    walks, start, _ = settle_walk(created, WALKS, START * [1.0, 0.6, 0.5])
    assert walks
    low, high, near = STANDING_SLOPE, WALKS, start
    while high - low > 2.0 * np.spacing(high):
        middle = 0.5 * (low + high)
        walks, end, _ = settle_walk(created, middle, near)
        low, high, near = (low, middle, end) if walks else (middle, high, near)
    make_wheel = lambda slope: vrw.WheelParams(**SLOW_WALK_PARAMETERS, slope=slope)
    meshes = {"default": vrw.CycleOptions(), "tight": vrw.CycleOptions.tight()}
    guess = {
        name: vrw.limit_cycle(make_wheel(WALKS), options=mesh) for name, mesh in meshes.items()
    }
    for distance in SLOPE_DISTANCES:
        slope = high + distance
        _, start, durations = settle_walk(created, slope, start)
        row: dict[str, object] = {
            "slope": f"{slope:.12g}",
            "distance": f"{distance:.2e}",
            "period_s": f"{durations.sum():.9g}",
            "dls_fraction": f"{durations[0] / durations.sum():.6g}",
            "upright_rate": f"{upright_rate(slope, start):.9g}",
        }
        for name, options in meshes.items():
            cycle = vrw.limit_cycle(make_wheel(slope), guess=guess[name], options=options)
            solution = bool(cycle.found)
            guess[name] = cycle if solution else guess[name]
            gap = np.max(np.abs(np.asarray(cycle.section_state) - start))
            missed = abs(float(cycle.period) - durations.sum()) / durations.sum()
            row |= {
                f"{name}_found": solution,
                f"{name}_state_error": f"{gap:.1e}" if solution else "nan",
                f"{name}_period_error": f"{missed:.1e}" if solution else "nan",
            }
        step = vrw.step(
            make_wheel(slope),
            start,
            options=vrw.StepOptions(max_phase_time=MAX_DOUBLE_SUPPORT_SECONDS),
        )
        missed = abs(float(np.sum(step.durations)) - durations.sum()) / durations.sum()
        yield row | {"step": Outcome(int(step.outcome)).name, "step_period_error": f"{missed:.1e}"}


# --- Between two outcomes: two guards at once, guards that graze, phases that vanish.

SEGMENTS, HALVINGS = 1000, 55  # of each kind of case
CLOSER = np.logspace(-2.0, -14.0, 7)  # of the segment between two starts


def between() -> Rows:
    """Who is right how near to a border between outcomes: both engines at default options.

    Segments between random wheels and starts of other outcomes are halved by isolated roots until
    the border is known to the last digits; then both sides are asked at some distances.
    """
    created = events.phases()
    names = [name for name in events.KINDS["anywhere"] if name != "start"]

    def asked(points: np.ndarray) -> tuple[vrw.WheelParams, np.ndarray]:
        return vrw.WheelParams(**dict(zip(names, points.T, strict=False))), points[:, len(names) :]

    for kind, box in events.KINDS.items():
        params, starts = events.draw_wheels(box, np.random.default_rng(11))
        points = np.column_stack([*(np.asarray(getattr(params, n)) for n in names), starts])
        points = points[: 2 * SEGMENTS]
        ends = points[::2].copy(), points[1::2].copy()
        codes = tuple(events.step_by_isolated_roots(created, *asked(side))[0] for side in ends)
        differ = codes[0] != codes[1]
        low, high = (side[differ] for side in ends)
        codes_low, codes_high = (code[differ].copy() for code in codes)
        segment = high - low
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            result, *_ = events.step_by_isolated_roots(created, *asked(middle))
            is_same = result == codes_low
            low[is_same], high[~is_same] = middle[is_same], middle[~is_same]
            codes_high[~is_same] = result[~is_same]
        for distance in CLOSER:
            for side, sign in ((low, -1.0), (high, 1.0)):
                displaced_starts = side + sign * distance * segment
                result, durations, _ = events.step_by_isolated_roots(
                    created, *asked(displaced_starts)
                )
                batch_result = vrw.step_batch(*asked(displaced_starts))
                mine = np.asarray(batch_result.outcome)
                other = np.asarray(
                    vrw.step_batch(*asked(displaced_starts), engine="diffrax").outcome
                )
                step_result = (mine == result) & (result == Outcome.STEPPED)
                gap = np.max(np.abs(np.asarray(batch_result.durations) - durations), 1)
                pairs = [
                    tuple(sorted(Outcome(code).name for code in pair))
                    for pair in zip(codes_low, codes_high, strict=True)
                ]
                for pair in sorted(set(pairs)):
                    has_outcome_pair = np.array([one == pair for one in pairs])
                    yield {
                        "kind": kind,
                        "border": " | ".join(pair),
                        "distance": f"{distance:.0e}",
                        "cases": int(has_outcome_pair.sum()),
                        "other_outcome": int((has_outcome_pair & (mine != result)).sum()),
                        "other_by_diffrax": int((has_outcome_pair & (other != result)).sum()),
                        "stepped": int((has_outcome_pair & step_result).sum()),
                        "time_difference_s": f"{np.max(gap[has_outcome_pair & step_result], initial=0.0):.1e}",  # noqa: E501
                    }

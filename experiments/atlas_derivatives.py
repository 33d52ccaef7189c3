"""Where derivatives err, for stability_atlas.py: borders, many steps, meeting multipliers, modes.

The oracle is the formulation of `tests/oracle` at 35 digits with central differences, or, over many
steps and where a step has no double support, steps by isolated roots (atlas_events.py) with
extrapolated central differences.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import atlas_events as events
import engine_peers as peers
import heyoka as hy
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
from work_precision import seconds
from work_precision_truth import VARIED, differences, load, plane_map

import vrw_jax as vrw
from vrw_jax import Outcome, transitions

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from oracle import multiprecision
from oracle.differences import minus_identity, solve_two, spectrum
from oracle.hub_form import HubForm
from oracle.multiprecision import Flow, Number, Vector

Rows = Iterator[dict[str, object]]
START = np.array([0.1, 1.6, -0.1])  # near the gait of Table 1


def oracle() -> HubForm:
    """The formulation in the hub's coordinates, at 35 digits."""
    multiprecision.BITS, multiprecision.DIGITS, mp.mp.prec = 120, 35, 120
    return HubForm()


def exact(params: vrw.WheelParams) -> Vector:
    """All nine parameters and the number of legs."""
    return [mp.mpf(float(getattr(params, n))) for n in multiprecision.NAMES] + [mp.mpf(8)]


# --- Near borders of the paper's sequence.

DISTANCES = np.logspace(-1.0, -9.0, 9)
BORDERS = {  # wheel, and the start's rate on the other side, rad/s
    "double support vanishes": ({"damping": 100.0, "slope": 0.30}, 3.2),
    "λ4⁺ → 0": ({"damping": 150.0, "slope": 0.30}, 2.3),
    "λ2⁺ → 0": ({"damping": 10.0, "slope": 0.30}, 3.2),
    "the wheel stops": ({"damping": 100.0, "slope": 0.10}, 0.05),
}


def start_with(rate: float) -> np.ndarray:
    return np.array([START[0], rate, START[2]])


def border(made: tuple, wheel: dict[str, float], beyond: float) -> float:
    """The last rate from START's towards `beyond` with all three phases, by bisection."""
    params = vrw.WheelParams(**{name: np.full(1, value) for name, value in wheel.items()})
    good, bad = START[1], beyond
    for _ in range(60):
        middle = 0.5 * (good + bad)
        (code,), (durations,), _ = events.isolated(made, params, start_with(middle)[None])
        if code == Outcome.STEPPED and np.all(durations > 0.0):
            good = middle
        else:
            bad = middle
    return good


def borders() -> Rows:
    """Error of first derivatives by a start's rate over its distance to borders."""
    hub, made = oracle(), events.phases()

    def twice(x: jax.Array, params: vrw.WheelParams) -> tuple:
        image = vrw.return_map(params, x)
        return image, image

    derive = jax.jit(jax.jacfwd(twice, has_aux=True))
    for name, (wheel, beyond) in BORDERS.items():
        edge = border(made, wheel, beyond)
        params = vrw.WheelParams(**wheel)
        batch = vrw.WheelParams(**{key: np.full(1, value) for key, value in wheel.items()})
        p = exact(params)
        for distance in DISTANCES:
            start = start_with(edge * (1.0 + distance * np.sign(START[1] - edge)))
            _, (about,), _ = events.isolated(made, batch, start[None])
            size, ends = mp.mpf(distance) * mp.mpf("1e-8"), []
            for sign in (1, -1):
                x = [mp.mpf(float(v)) for v in start]
                x[1] += sign * size
                ends.append(hub.walk(hub.land(x, p)[0], p, about).section_state)
            truth = np.array([float((a - b) / (2 * size)) for a, b in zip(*ends, strict=True)])
            value = np.array([float((a + b) / 2) for a, b in zip(*ends, strict=True)])
            jacobian, image = derive(jnp.asarray(start), params)
            miss = np.max(np.abs(np.asarray(jacobian)[:, 1] - truth))
            yield {
                "border": name,
                "edge": f"{edge:.6g}",
                "distance": f"{distance:.0e}",
                "derivative": f"{np.max(np.abs(truth)):.4g}",
                "derivative_error": f"{miss / max(np.max(np.abs(truth)), 1.0):.1e}",
                "value_error": f"{np.max(np.abs(np.asarray(image) - value)):.1e}",
                "durations": " ".join(f"{d:.2g}" for d in about),
            }


# --- Scuffing: the lowest clearance of the swing foot tends to zero.

SCUFFS_BETWEEN = (80.0, 150.0)  # N s/m
BELOW = np.logspace(-1.0, -5.0, 9)  # of the damping at which it begins


class Dip:
    """Foot 2 in SLS-I from the equations of docs/physics.md, at 35 digits."""

    def __init__(self) -> None:
        P = [hy.par[i] for i in range(10)]
        y = th, L1, L2, w, v1, v2 = hy.make_vars("th", "L1", "L2", "w", "v1", "v2")
        sin, cos = hy.sin(th), hy.cos(th)
        x1, force, *_ = peers.double_support(sin, cos, w, hy.par[10], P)
        self.dls = Flow([th, w], [w, x1], force, 11)
        rates = [w, v1, v2, *peers.single_support_1(sin, cos, L1, L2, w, v1, v2, P)]
        along = lambda g: sum(hy.diff(g, v) * rate for v, rate in zip(y, rates, strict=True))
        height = L1 * cos - L2 * (cos * peers.CA - sin * peers.SA)
        rise = along(height)
        self.swing = Flow(list(y), rates, -1.0 * rise, 11)
        self.told = multiprecision.compiled([height, along(rise), along(along(rise))], list(y))

    def ask(self, state: Vector, P: Vector) -> Vector:
        """Height of foot 2, and its second and third derivatives by time."""
        reals = ([multiprecision.to_real(v) for v in values] for values in (state, P))
        return [multiprecision.to_mpf(v) for v in self.told(*reals)]

    def lift_off(self, y: Vector, p: Vector, about: float) -> tuple[Vector, Vector]:
        """State at the end of double support, and the constants."""
        mH, m, a, L0, Ls, k, c, phi, g, _ = p
        distance = multiprecision.step_length(y, p)
        P = [m, a, L0, Ls, k, c, g, mp.sin(phi), mp.cos(phi), mH + 7 * m, distance]
        (theta, rate), _ = self.dls.until_guard(y, P, about)
        rear = theta + mp.pi / 4
        scale = distance / mp.sin(mp.pi / 4)
        lengths = [scale * mp.cos(rear), scale * mp.cos(theta)]
        speeds = [-scale * mp.sin(rear) * rate, -scale * mp.sin(theta) * rate]
        return [theta, *lengths, rate, *speeds], P

    def lowest(self, y: Vector, p: Vector, about: float) -> tuple[Number, Number]:
        """Height at the first minimum after lift-off, and its time."""
        state, P = self.lift_off(y, p, about)
        _, second, third = self.ask(state, P)
        state, time = self.swing.until_guard(state, P, float(-2 * second / third))
        return self.ask(state, P)[0], time


def scuffing() -> Rows:
    """Error of the clearance in SLS-I and of its derivative by damping, where scuffing begins."""
    hub, dip, made = oracle(), Dip(), events.phases()
    monitored = lambda c: vrw.step(vrw.WheelParams(damping=c), START).monitors.clearance_sls1
    derive = jax.jit(jax.value_and_grad(monitored))

    def at(damping: Number) -> tuple[Vector, Vector, float]:
        p = exact(vrw.WheelParams())
        p[multiprecision.NAMES.index("damping")] = damping
        batch = vrw.WheelParams(damping=np.full(1, float(damping)))
        _, (about,), _ = events.isolated(made, batch, START[None])
        return hub.land([mp.mpf(float(v)) for v in START], p)[0], p, about[0]

    lifts = lambda damping: dip.ask(*dip.lift_off(*at(damping)))[1]
    edge = mp.findroot(lifts, SCUFFS_BETWEEN, solver="anderson", tol=1e-30)
    for distance in BELOW:
        damping = mp.mpf(float(edge * (1 - mp.mpf(distance))))
        h = damping * mp.mpf(distance) * mp.mpf("1e-8")
        (up, _), (down, _) = (dip.lowest(*at(damping + sign * h)) for sign in (1, -1))
        low, time = dip.lowest(*at(damping))
        truth = float((up - down) / (2 * h))
        value, derivative = map(float, derive(jnp.asarray(float(damping))))
        yield {
            "edge": mp.nstr(edge, 12),
            "distance": f"{distance:.1e}",
            "time_s": f"{float(time):.3g}",
            "clearance_m": f"{float(low):.4e}",
            "value_error": f"{abs(value - float(low)):.1e}",
            "derivative": f"{truth:.4e}",
            "derivative_error": f"{abs(derivative - truth):.1e}",
        }


# --- Many steps: do derivatives grow?

MANY = 100
DAMPINGS = (100.0, 200.0, 215.0, 219.8, 220.5, 222.0, 224.0)
SHOWN = (1, 2, 3, 5, 7, 10, 20, 30, 50, 70, 100)


def walked(made: tuple, damping: float, x: np.ndarray, count: int) -> np.ndarray:
    """Section states after each of `count` steps by isolated roots."""
    params = vrw.WheelParams(damping=np.full(1, damping))
    told = []
    for _ in range(count):
        (code,), _, (x,) = events.isolated(made, params, x[None])
        assert code == Outcome.STEPPED
        told.append(x)
    return np.array(told)


def growth() -> Rows:
    """d(state after n steps)/d(damping) by the chain rule, and its error, near and beyond 220."""
    made = events.phases()
    step = jax.jit(jax.jacfwd(vrw.return_map, (0, 1)))
    start = np.asarray(vrw.limit_cycle(vrw.WheelParams(damping=219.0)).section_state)
    for damping in DAMPINGS:
        x = walked(made, damping, start, 300)[-1]  # on the attractor
        params = vrw.WheelParams(damping=damping)
        at, by_damping, by_start, lowest = x, np.zeros(3), np.eye(3), []
        size = 1e-5
        sides = {h: walked(made, damping + h * size, x, MANY) for h in (2, 1, -1, -2)}
        near = (sides[1] - sides[-1]) / (2.0 * size)
        far = (sides[2] - sides[-2]) / (4.0 * size)
        truth = (4.0 * near - far) / 3.0
        for count in range(1, MANY + 1):
            by_params, by_x = step(params, jnp.asarray(at))
            by_x = np.asarray(by_x)
            by_damping = by_x @ by_damping + np.asarray(by_params.damping)
            by_start = by_x @ by_start
            _, rear = transitions.landing_forces(
                params.symbols(), transitions.land(params.symbols(), *at)
            )
            lowest.append(float(rear.normal))
            at = np.asarray(vrw.return_map(params, at))
            if count in SHOWN:
                miss = np.max(np.abs(by_damping - truth[count - 1]))
                yield {
                    "damping": f"{damping:g}",
                    "steps": count,
                    "by_start": f"{np.linalg.norm(by_start, 2):.3e}",
                    "by_damping": f"{np.max(np.abs(by_damping)):.4e}",
                    "error": f"{miss:.1e}",
                    "differences_error": f"{np.max(np.abs(near - far)[count - 1]):.1e}",
                    "lowest_lambda_4": f"{min(lowest):.3g}",
                }


# --- Two multipliers meet.

FIXED = {"damping": 210.0}
MEETS_BETWEEN = (0.26, 0.28)  # slopes, rad
FROM_MEETING = np.logspace(-1.5, -9.0, 16)  # rad of slope
SIZE = mp.mpf("1e-12")


def gait(hub: HubForm, slope: Number, y: Vector, about: list[float]) -> tuple[Vector, list]:
    """(theta+, dtheta+) of the limit cycle at a slope and its monodromy matrix, by Newton."""
    p = exact(vrw.WheelParams(**FIXED))
    p[multiprecision.NAMES.index("slope")] = slope
    around = lambda point: plane_map(hub, point, p, about)
    for _ in range(8):
        image = around(y)
        columns = differences(around, y, [SIZE, SIZE])
        matrix = [[columns[j][i] for j in range(2)] for i in range(2)]
        change = solve_two(minus_identity(matrix), [a - b for a, b in zip(image, y, strict=False)])
        y = [a + b for a, b in zip(y, change, strict=True)]
        about[:] = [float(d) for d in image[2:]]
        if max(map(abs, change)) < mp.mpf("1e-24"):
            return y, matrix
    raise ArithmeticError("Newton's method did not settle")


def discriminant(matrix: list) -> Number:
    """Zero where the multipliers of a 2 x 2 matrix meet, negative where they are complex."""
    (a, b), (c, d) = matrix
    return (a - d) ** 2 + 4 * b * c


def meeting() -> Rows:
    """Error of d(spectral radius)/d(slope) and of the Jury margins' over the distance."""
    hub = oracle()
    of = lambda slope: vrw.limit_cycle(vrw.WheelParams(**FIXED, slope=slope))

    def measures(slope: jax.Array) -> tuple:
        cycle = of(slope)
        told = jnp.concatenate([cycle.spectral_radius[None], cycle.jury_margins])
        return told, told

    derive = jax.jit(jax.jacfwd(measures, has_aux=True))
    cycle = of(MEETS_BETWEEN[1])
    known = [mp.mpf(float(v)) for v in cycle.post_impact]
    about = [float(d) for d in cycle.durations]
    matrix_at = lambda slope: gait(hub, slope, known, list(about))[1]
    low, high = map(mp.mpf, MEETS_BETWEEN)
    at_low, at_high = (discriminant(matrix_at(end)) for end in (low, high))
    assert at_low * at_high < 0
    meets = mp.findroot(
        lambda slope: discriminant(matrix_at(slope)), (low, high), solver="anderson", tol=1e-40
    )
    for side in (1, -1):
        for distance in FROM_MEETING:
            slope = mp.mpf(float(meets + side * mp.mpf(distance)))
            h = mp.mpf(distance) * mp.mpf("1e-6")
            up, here, down = (matrix_at(slope + sign * h) for sign in (1, 0, -1))
            rate = [[(up[i][j] - down[i][j]) / (2 * h) for j in range(2)] for i in range(2)]
            _, radius, derivative = spectrum(here)
            (a, b), (c, d) = here
            d_trace = rate[0][0] + rate[1][1]
            d_det = rate[0][0] * d + a * rate[1][1] - rate[0][1] * c - b * rate[1][0]
            jury = [d_det - d_trace, d_det + d_trace, -d_det]
            derivatives, values = map(np.asarray, derive(jnp.asarray(float(slope))))
            truth = float(derivative(rate))
            yield {
                "meets_at": mp.nstr(meets, 12),
                "distance": f"{side * distance:.3e}",
                "multipliers": "real" if discriminant(here) > 0 else "complex",
                "radius_error": f"{abs(values[0] - float(radius)):.1e}",
                "d_radius": f"{truth:.4g}",
                "d_radius_error": f"{abs(derivatives[0] - truth):.1e}",
                "d_jury_error": f"{max(abs(derivatives[1:] - np.array(jury, float))):.1e}",
            }


# --- Reverse, forward, implicit: the same derivative of a gait's period.

GAITS, UNROLLED = 8, (1, 2, 3, 5, 8, 12, 20, 30)


def modes() -> Rows:
    """Error and cost of d(period)/d(c, k, L*, slope): implicit, and through n steps, both modes.

    A walk starts 1 % off the gait; its last step's duration tends to the period.
    """
    truth = load()
    rows, starts = truth["rows"][:GAITS], truth["start"][:GAITS]
    exactly = truth["d_cycle"][:GAITS, 2:].sum(1) * rows
    size = np.linalg.norm(exactly, axis=1)
    wheel = lambda row: vrw.WheelParams(**dict(zip(VARIED, row, strict=True)))
    model, options = vrw.ViscoelasticWheel(), vrw.Options()

    def through(count: int, x: jax.Array, row: jax.Array) -> jax.Array:
        params = wheel(row)
        for _ in range(count - 1):
            x = model.advance(params, x, options).section_state
        return jnp.sum(model.advance(params, x, options).durations)

    period = lambda row: vrw.limit_cycle(wheel(row)).period

    def told(way: str, count: int, derive: Callable) -> dict[str, object]:
        run = lambda: np.array([derive(row, x) for row, x in zip(rows, starts, strict=True)])
        found = run() * rows  # and compile
        error = np.linalg.norm(found - exactly, axis=1) / size
        return {
            "way": way,
            "steps": count,
            "median_error": f"{np.median(error):.1e}",
            "largest_error": f"{np.max(error):.1e}",
            "ms": f"{seconds(run) / GAITS * 1e3:.4g}",
        }

    for mode, derive in (("forward", jax.jacfwd), ("reverse", jax.jacrev)):
        implicit = jax.jit(derive(period))
        yield told(f"implicit, {mode}", 0, lambda row, x, f=implicit: f(row))
        for count in UNROLLED:
            unrolled = lambda row, x, d=derive, n=count: d(lambda r: through(n, x, r))(
                jnp.asarray(row)
            )
            yield told(f"through the walk, {mode}", count, unrolled)

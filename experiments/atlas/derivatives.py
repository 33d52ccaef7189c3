"""Where derivatives err: borders, many steps, meeting multipliers, modes.

The reference is the formulation of `tests/reference_code` at 35 digits with central differences.
Over many steps, and if a step has no double support, the reference is steps by isolated roots (see
`events`) with extrapolated central differences.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vrw_jax as vrw
from experiments.atlas import events
from experiments.atlas.events import START, Rows
from experiments.shared.timing import measure_cpu_seconds
from experiments.speed import peers
from experiments.speed.peers import hy
from experiments.work_precision.reference_values import VARIED_PARAMETERS, load
from tests.reference_code import multiprecision
from tests.reference_code.hub_form import HubForm
from tests.reference_code.multiprecision import Flow, Number, Vector
from vrw_jax import Outcome
from vrw_jax.base import small_matrices
from vrw_jax.wheel import transitions


def make_reference_model() -> HubForm:
    """Return the formulation in the coordinates of the hub, at 35 digits."""
    multiprecision.BITS, multiprecision.DIGITS, mp.mp.prec = 120, 35, 120
    return HubForm()


def to_exact_parameters(params: vrw.WheelParams) -> Vector:
    """Return all nine parameters and the number of legs as exact numbers."""
    return [mp.mpf(float(getattr(params, n))) for n in multiprecision.NAMES] + [mp.mpf(8)]


# --- Near borders of the paper's sequence.

DISTANCES = np.logspace(-1.0, -9.0, 9)
BORDER_CASES = {  # wheel, and the start's rate on the other side, rad/s
    "double support vanishes": ({"damping": 100.0, "slope": 0.30}, 3.2),
    "λ4⁺ → 0": ({"damping": 150.0, "slope": 0.30}, 2.3),
    "λ2⁺ → 0": ({"damping": 10.0, "slope": 0.30}, 3.2),
    "the wheel stops": ({"damping": 100.0, "slope": 0.10}, 0.05),
}


def start_with(rate: float) -> np.ndarray:
    return np.array([START[0], rate, START[2]])


def border(created: tuple, wheel: dict[str, float], outside_values: float) -> float:
    """Return, by bisection, the last rate from START's towards `outside_values` with all three
    phases.
    """
    params = vrw.WheelParams(**{name: np.full(1, value) for name, value in wheel.items()})
    good, bad = START[1], outside_values
    for _ in range(60):
        middle = 0.5 * (good + bad)
        (code,), (durations,), _ = events.step_by_isolated_roots(
            created, params, start_with(middle)[None]
        )
        if code == Outcome.STEPPED and np.all(durations > 0.0):
            good = middle
        else:
            bad = middle
    return good


def borders() -> Rows:
    """Error of first derivatives by a start's rate over its distance to borders."""
    hub, created = make_reference_model(), events.phases()

    def twice(x: jax.Array, params: vrw.WheelParams) -> tuple:
        image = vrw.return_map(params, x)
        return image, image

    derive = jax.jit(jax.jacfwd(twice, has_aux=True))
    for name, (wheel, outside_values) in BORDER_CASES.items():
        edge = border(created, wheel, outside_values)
        params = vrw.WheelParams(**wheel)
        batch = vrw.WheelParams(**{key: np.full(1, value) for key, value in wheel.items()})
        p = to_exact_parameters(params)
        for distance in DISTANCES:
            start = start_with(edge * (1.0 + distance * np.sign(START[1] - edge)))
            _, (about,), _ = events.step_by_isolated_roots(created, batch, start[None])
            size, ends = mp.mpf(distance) * mp.mpf("1e-8"), []
            for sign in (1, -1):
                x = [mp.mpf(float(v)) for v in start]
                x[1] += sign * size
                ends.append(hub.walk(hub.land(x, p)[0], p, about).section_state)
            reference = np.array([float((a - b) / (2 * size)) for a, b in zip(*ends, strict=True)])
            value = np.array([float((a + b) / 2) for a, b in zip(*ends, strict=True)])
            jacobian, image = derive(jnp.asarray(start), params)
            miss = np.max(np.abs(np.asarray(jacobian)[:, 1] - reference))
            yield {
                "border": name,
                "edge": f"{edge:.6g}",
                "distance": f"{distance:.0e}",
                "derivative": f"{np.max(np.abs(reference)):.4g}",
                "derivative_error": f"{miss / max(np.max(np.abs(reference)), 1.0):.1e}",
                "value_error": f"{np.max(np.abs(np.asarray(image) - value)):.1e}",
                "durations": " ".join(f"{d:.2g}" for d in about),
            }


# --- Scuffing: the lowest clearance of the swing foot tends to zero.

SCUFFS_BETWEEN = (80.0, 150.0)  # N s/m
SCUFFING_DISTANCES = np.logspace(
    -5.0, -4.0 / 3.0, 12
)  # of the damping at which it begins; nearest first


class Dip:
    """Foot 2 in SLS-I from the equations of docs/explanation/physics.md, at 35 digits but for sin
    and cos pi/4.

    Those are doubles, which moves heights by 1e-17 m.
    """

    def __init__(self) -> None:
        P = [hy.par[i] for i in range(10)]
        y = th, L1, L2, w, v1, v2 = hy.make_vars("th", "L1", "L2", "w", "v1", "v2")
        sin, cos = hy.sin(th), hy.cos(th)
        x1, force, *_ = peers.double_support(sin, cos, w, hy.par[10], P)
        self.dls = Flow([th, w], [w, x1], force, 11)
        rates = [w, v1, v2, *peers.single_support_1(sin, cos, L1, L2, w, v1, v2, P)]
        evaluate_along = lambda g: sum(
            hy.diff(g, v) * rate for v, rate in zip(y, rates, strict=True)
        )
        height = L1 * cos - L2 * (cos * peers.CA - sin * peers.SA)
        rise = evaluate_along(height)
        self.swing = Flow(list(y), rates, -1.0 * rise, 10)
        self.height_and_rates = multiprecision.compile_expressions(
            [height, evaluate_along(rise), evaluate_along(evaluate_along(rise))], list(y)
        )

    def evaluate(self, state: Vector, P: Vector) -> Vector:
        """Height of foot 2, and its second and third derivatives by time."""
        reals = ([multiprecision.to_real(v) for v in values] for values in (state, P))
        return [multiprecision.to_mpf(v) for v in self.height_and_rates(*reals)]

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

    def lowest(self, y: Vector, p: Vector, about: tuple[float, float]) -> tuple[Number, Number]:
        """Height at the first minimum after lift-off, and its time; about: of DLS, of it."""
        state, P = self.lift_off(y, p, about[0])
        state, time = self.swing.until_guard(state, P[:10], about[1])
        return self.evaluate(state, P)[0], time

    def first_guess(self, y: Vector, p: Vector, about: float) -> float:
        """Time of the first minimum, from the derivatives at lift-off."""
        _, second, third = self.evaluate(*self.lift_off(y, p, about))
        return float(-2 * second / third)


def scuffing() -> Rows:
    """Error of the clearance in SLS-I and of its derivative by damping, where scuffing begins."""
    hub, dip, created = make_reference_model(), Dip(), events.phases()
    monitored = lambda c: vrw.step(vrw.WheelParams(damping=c), START).margins.clearance_sls1
    derive = jax.jit(jax.value_and_grad(monitored))

    def at(damping: Number) -> tuple[Vector, Vector, float]:
        p = to_exact_parameters(vrw.WheelParams())
        p[multiprecision.NAMES.index("damping")] = damping
        batch = vrw.WheelParams(damping=np.full(1, float(damping)))
        _, (about,), _ = events.step_by_isolated_roots(created, batch, START[None])
        return hub.land([mp.mpf(float(v)) for v in START], p)[0], p, about[0]

    lifts = lambda damping: dip.evaluate(*dip.lift_off(*at(damping)))[1]
    edge = mp.findroot(lifts, SCUFFS_BETWEEN, solver="anderson", tol=1e-30)
    shares = np.array([[0.0, 0.0]])  # time over distance: nearly constant, and extrapolated
    for distance in SCUFFING_DISTANCES:
        damping = mp.mpf(float(edge * (1 - mp.mpf(distance))))
        h = damping * mp.mpf(distance) * mp.mpf("1e-8")
        *given, dls = at(damping)
        if len(shares) == 1:
            near = dip.first_guess(*given, dls)
        else:
            near = distance * np.polynomial.Polynomial.fit(
                *shares[1:][-3:].T, deg=min(len(shares) - 2, 2)
            )(distance)
        low, time = dip.lowest(*given, (dls, near))
        shares = np.append(shares, [[distance, float(time) / distance]], 0)
        ends = [at(damping + sign * h) for sign in (1, -1)]
        up, down = (dip.lowest(y, p, (dls, float(time)))[0] for y, p, dls in ends)
        reference = float((up - down) / (2 * h))
        value, derivative = map(float, derive(jnp.asarray(float(damping))))
        yield {
            "edge": mp.nstr(edge, 12),
            "distance": f"{distance:.1e}",
            "time_s": f"{float(time):.3g}",
            "clearance_m": f"{float(low):.4e}",
            "value_error": f"{abs(value - float(low)):.1e}",
            "derivative": f"{reference:.4e}",
            "derivative_error": f"{abs(derivative - reference):.1e}",
        }


# --- Many steps: do derivatives grow?

N_GROWTH_STEPS = 100
DAMPINGS = (100.0, 200.0, 215.0, 219.8, 220.5, 222.0, 224.0)
SHOWN_STEP_COUNTS = (1, 2, 3, 5, 7, 10, 20, 30, 50, 70, 100)


def walk_by_isolated_roots(created: tuple, damping: float, x: np.ndarray, count: int) -> np.ndarray:
    """Section states after each of `count` steps by isolated roots."""
    params = vrw.WheelParams(damping=np.full(1, damping))
    rows = []
    for _ in range(count):
        (code,), _, (x,) = events.step_by_isolated_roots(created, params, x[None])
        assert code == Outcome.STEPPED
        rows.append(x)
    return np.array(rows)


def growth() -> Rows:
    """d(state after n steps)/d(damping) by the chain rule, and its error, near and beyond 220."""
    created = events.phases()
    step = jax.jit(jax.jacfwd(vrw.return_map, (0, 1)))
    start = np.asarray(vrw.limit_cycle(vrw.WheelParams(damping=219.0)).section_state)
    for damping in DAMPINGS:
        x = walk_by_isolated_roots(created, damping, start, 300)[-1]  # on the attractor
        params = vrw.WheelParams(damping=damping)
        section_state, by_damping, by_start, lowest = x, np.zeros(3), np.eye(3), []
        size = 1e-5
        sides = {
            h: walk_by_isolated_roots(created, damping + h * size, x, N_GROWTH_STEPS)
            for h in (2, 1, -1, -2)
        }
        near = (sides[1] - sides[-1]) / (2.0 * size)
        far = (sides[2] - sides[-2]) / (4.0 * size)
        reference = (4.0 * near - far) / 3.0
        for count in range(1, N_GROWTH_STEPS + 1):
            by_params, by_x = step(params, jnp.asarray(section_state))
            by_x = np.asarray(by_x)
            by_damping = by_x @ by_damping + np.asarray(by_params.damping)
            by_start = by_x @ by_start
            _, rear = transitions.compute_landing_forces(
                params.symbols(), transitions.resolve_landing(params.symbols(), *section_state)
            )
            lowest.append(float(rear.normal))
            section_state = np.asarray(vrw.return_map(params, section_state))
            if count in SHOWN_STEP_COUNTS:
                miss = np.max(np.abs(by_damping - reference[count - 1]))
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

N_RANDOM_GAITS, RANDOM_GAIT_BOX = (
    400,
    {  # random wheels: do their multipliers ever meet?
        "damping": (20.0, 215.0),
        "stiffness": (200.0, 1500.0),
        "natural_length": (1.0, 1.1),
        "slope": (0.08, 0.35),
        "leg_com": (0.1, 0.7),
        "leg_mass": (0.2, 1.5),
    },
)


def measure_multiplier_distances() -> Rows:
    """Measure the distances between multipliers of random gaits."""
    random = np.random.default_rng(3)
    ratios, n_complex = [], 0
    for _ in range(N_RANDOM_GAITS):
        wheel = {name: random.uniform(*limits) for name, limits in RANDOM_GAIT_BOX.items()}
        cycle = vrw.limit_cycle(vrw.WheelParams(**wheel))
        if bool(cycle.found):
            first, second = np.asarray(cycle.multipliers)
            n_complex += int(first.imag != 0.0)
            ratios.append(abs(second) / abs(first))
    yield {
        "wheels": N_RANDOM_GAITS,
        "gaits": len(ratios),
        "complex_pairs": n_complex,
        "largest_ratio": f"{max(ratios):.2f}",
        "median_ratio": f"{np.median(ratios):.2f}",
    }


DOUBLE_MULTIPLIER = mp.mpf("0.3")  # the multiplier in which two meet
FRAME = mp.matrix([["1.1", "0.7"], ["-0.3", "0.9"]])
FROM_MEETING = np.logspace(-1.5, -13.0, 24)


def meeting() -> Rows:
    """Measure errors of derivatives near a double eigenvalue of a matrix, over the distance s.

    The matrix has the eigenvalues DOUBLE +- sqrt(s) and is not diagonal. The reference
    has 35 digits, and the elements of the matrix are 64-bit numbers.
    """
    mp.mp.prec = 120
    turned = lambda rows: FRAME * mp.matrix(rows) * FRAME**-1
    base, change = (
        turned([[DOUBLE_MULTIPLIER, 1], [0, DOUBLE_MULTIPLIER]]),
        turned([[0, 0], [1, 0]]),
    )
    as_array = lambda matrix: jnp.asarray(np.array(matrix.tolist(), float))
    interpolate_matrix = lambda s: as_array(base) + s * as_array(change)
    measures = {
        "radius": lambda s: small_matrices.compute_spectral_radius(interpolate_matrix(s)),
        "jury": lambda s: small_matrices.compute_jury_margins(interpolate_matrix(s)),
    }
    derive = {name: jax.jit(jax.jacfwd(measure)) for name, measure in measures.items()}
    for kind, sign in (("real", 1), ("complex", -1)):
        for distance in FROM_MEETING:
            s = sign * mp.mpf(float(distance))
            radius = (
                DOUBLE_MULTIPLIER + mp.sqrt(s) if sign > 0 else mp.sqrt(DOUBLE_MULTIPLIER**2 - s)
            )
            d_radius = 1 / (2 * mp.sqrt(s)) if sign > 0 else -1 / (2 * radius)
            jury = np.array([-1.0, -1.0, 1.0])  # det = DOUBLE^2 - s, trace = 2 DOUBLE
            found_by_name = {
                name: np.asarray(f(jnp.asarray(float(s)))) for name, f in derive.items()
            }
            value = float(measures["radius"](jnp.asarray(float(s))))
            yield {
                "multipliers": kind,
                "distance": f"{distance:.3e}",
                "radius_error": f"{abs(value - float(radius)):.1e}",
                "d_radius": f"{float(d_radius):.4g}",
                "d_radius_error": f"{abs(found_by_name['radius'] - float(d_radius)):.1e}",
                "d_jury_error": f"{np.max(np.abs(found_by_name['jury'] - jury)):.1e}",
            }


# --- Reverse, forward, implicit: the same derivative of a gait's period.

GAITS, UNROLLED_STEP_COUNTS = 8, (1, 2, 3, 5, 8, 12, 20, 30)


def modes() -> Rows:
    """Error and cost of d(period)/d(c, k, L*, slope): implicit, and through n steps, both modes.

    A walk starts 1 % off the gait; its last step's duration tends to the period.
    """
    reference = load()
    rows, starts = reference["rows"][:GAITS], reference["start"][:GAITS]
    exactly = reference["d_cycle"][:GAITS, 2:].sum(1) * rows
    size = np.linalg.norm(exactly, axis=1)
    wheel = lambda row: vrw.WheelParams(**dict(zip(VARIED_PARAMETERS, row, strict=True)))
    model, options = vrw.ViscoelasticWheel(), vrw.StepOptions()

    def through(count: int, x: jax.Array, row: jax.Array) -> jax.Array:
        params = wheel(row)
        for _ in range(count - 1):
            x = model.advance(params, x, options).section_state
        return jnp.sum(model.advance(params, x, options).durations)

    period = lambda row: vrw.limit_cycle(wheel(row)).period

    def measure_method(method_name: str, count: int, derive: Callable) -> dict[str, object]:
        run = lambda: np.array([derive(row, x) for row, x in zip(rows, starts, strict=True)])
        solution = run() * rows  # and compile
        error = np.linalg.norm(solution - exactly, axis=1) / size
        return {
            "way": method_name,
            "steps": count,
            "median_error": f"{np.median(error):.1e}",
            "largest_error": f"{np.max(error):.1e}",
            "ms": f"{measure_cpu_seconds(run) / GAITS * 1e3:.4g}",
        }

    for mode, derive in (("forward", jax.jacfwd), ("reverse", jax.jacrev)):
        implicit = jax.jit(derive(period))
        yield measure_method(f"implicit, {mode}", 0, lambda row, x, f=implicit: f(row))
        for count in UNROLLED_STEP_COUNTS:
            unrolled = lambda row, x, d=derive, n=count: d(lambda r: through(n, x, r))(
                jnp.asarray(row)
            )
            yield measure_method(f"through the walk, {mode}", count, unrolled)

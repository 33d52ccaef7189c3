"""A linear periodic system whose multipliers are 66 decades apart.

x1' = x2, x2' = -10 cos t x1 - (24 + 10 sin t) x2 conserves x2 + (24 + 10 sin t) x1, so one
multiplier is 1; the trace integrates to -48 pi, so the other is exp(-48 pi) = 3.2e-66. Colaneri's
example, in the documentation of PeriodicMatrices.jl: one product of monodromies has no correct
digit of it.
"""

import math
from collections.abc import Callable, Iterator
from importlib.metadata import version
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

import vrw_jax as vrw
from experiments.atlas.hybrid import JAX, hy
from experiments.atlas.results import Case, Row, compute_error, time_second_call
from vrw_jax.hybrid import product_multipliers, segment_maps

SMALL_MULTIPLIER = math.exp(-48.0 * math.pi)
PERIOD = 2.0 * math.pi
SEGMENTS = 200


def field(y: Any, m: Any) -> tuple:
    x1, x2, t = y
    return x2, -10.0 * m.cos(t) * x1 - (24.0 + 10.0 * m.sin(t)) * x2, 1.0 + 0.0 * t


def columns(z: Any, m: Any) -> tuple:
    """Evaluate the linear equation for two solutions and the clock."""
    (a, b, t), (c, d, _) = field((z[0], z[1], z[4]), m), field((z[2], z[3], z[4]), m)
    return a, b, c, d, t


BEGIN = (1.0, 0.0, 0.0, 1.0, 0.0)


def compute_by_segments(n: int) -> Any:
    """Return the multipliers that this library computes with `n` segments."""
    flow = lambda y: jnp.stack(field(y, JAX))
    cut = segment_maps(flow, jnp.zeros(3), PERIOD, n, vrw.StepOptions.tight(), n_directions=2)
    return product_multipliers(cut.jacobians), np.asarray(cut.jacobians)


def multiply_segments(matrix: np.ndarray) -> np.ndarray:
    values = np.linalg.eigvals(matrix)
    return values[np.argsort(-np.abs(values))]


def with_scipy() -> tuple[np.ndarray, int]:
    result = solve_ivp(
        lambda t, z: columns(z, np), (0.0, PERIOD), BEGIN, method="DOP853", rtol=1e-13, atol=1e-30
    )
    return result.y[:4, -1].reshape(2, 2).T, result.nfev


def with_diffrax() -> tuple[np.ndarray, int]:
    result = _solve_with_diffrax(jnp.array(BEGIN))
    return np.asarray(result.ys[-1][:4]).reshape(2, 2).T, int(result.stats["num_steps"])


@eqx.filter_jit
def _solve_with_diffrax(z: Any) -> Any:
    return diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, z, _: jnp.stack(columns(z, JAX))), diffrax.Dopri8(), 0.0, PERIOD,
        1e-3, z, stepsize_controller=diffrax.PIDController(rtol=1e-13, atol=1e-30),
        max_steps=100_000,
    )  # fmt: skip


def with_heyoka() -> tuple[np.ndarray, int]:
    names = hy.make_vars(*"abcde")
    flow = hy.taylor_adaptive(list(zip(names, columns(names, hy), strict=True)), list(BEGIN))
    steps = flow.propagate_until(PERIOD)[3]
    return flow.state[:4].reshape(2, 2).T, steps


PEERS: tuple[tuple[str, Callable, str, str], ...] = (
    ("diffrax + NumPy", with_diffrax, "Dopri8 1e-13, one matrix", "diffrax"),
    ("SciPy + NumPy", with_scipy, "DOP853 1e-13, one matrix", "scipy"),
    ("heyoka + NumPy", with_heyoka, "Taylor 2.2e-16, one matrix", "heyoka"),
)


def rows() -> Iterator[Row]:
    for name, n in (("ours", SEGMENTS), ("ours, one segment", 1)):
        (result, _), seconds = time_second_call(lambda n=n: compute_by_segments(n))
        for i, reference in enumerate((1.0, SMALL_MULTIPLIER)):
            computed_multiplier, is_known = float(result.values[i].real), bool(result.is_known[i])
            says = "" if is_known else f"not known: uncertainty {result.relative_error[i]:.0e}"
            error = compute_error(computed_multiplier, reference, relative=True)
            yield Row(
                f"multiplier {reference:.1e}", name, computed_multiplier, reference, error, says,
                not is_known, n, seconds, f"Dopri8 1e-13, {n} segments", version("vrw-jax"),
            )  # fmt: skip
    for name, call, options, package in PEERS:
        (matrix, work), seconds = time_second_call(call)
        for computed_multiplier, reference in zip(
            multiply_segments(matrix).real, (1.0, SMALL_MULTIPLIER), strict=True
        ):
            error = compute_error(float(computed_multiplier), reference, relative=True)
            yield Row(
                f"multiplier {reference:.1e}", name, float(computed_multiplier), reference, error,
                "", False, work, seconds, options, version(package),
            )  # fmt: skip


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    counts = (4, 8, 16, 30, 60, 120, 250, 500)
    products = [compute_by_segments(n) for n in counts]
    gap = [max(abs(t.logarithms[1] + 48.0 * math.pi), 1e-16) for t, _ in products]
    axes.loglog(counts, gap, "o-", label="triangular factors")
    axes.loglog(
        counts,
        [t.relative_error[1] for t, _ in products],
        "o--",
        mfc="w",
        label="estimated error",
    )
    naive = [
        abs(multiply_segments(np.linalg.multi_dot(maps[::-1]))[1] / SMALL_MULTIPLIER - 1.0)
        for _, maps in products
    ]
    axes.loglog(counts, naive, "s:", label="product of the matrices")
    axes.set_xlabel("segments")
    axes.set_ylabel("relative error of $\\exp(-48\\pi)$")
    axes.legend()


CASE = Case(
    "Two multipliers 66 decades apart",
    "a product of monodromies has no correct digit of the small one",
    "closed form: 1 and exp(−48π)",
    "Colaneri's example, as in PeriodicMatrices.jl (exponents 0 and −24), derived in the module",
    rows,
    draw,
)

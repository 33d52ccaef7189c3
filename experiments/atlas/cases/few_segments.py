"""A stable orbit that collocation with few segments calls unstable.

r' = r (1 - r^2) s(theta)/2 + ..., theta' = 1 with the orbit r = 1: along it a disturbance grows at
the rate 1 - 2 p(theta), p the Poisson kernel with q = 0.97, a narrow peak whose mean is 1. The
multiplier is exp(2 pi (1 - 2)) = exp(-2 pi). Gauss collocation (four nodes, as AUTO's default)
never lets one segment decay by more than a factor of its choosing: with few segments the peak is
lost.
"""

import math
from collections.abc import Iterator
from importlib.metadata import version

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

import vrw_jax as vrw
from experiments.atlas.hybrid import JAX, hy
from experiments.atlas.results import Case, Row, compute_error, time_second_call
from vrw_jax.gaits import END_WEIGHTS, GAUSS_NODES, INTEGRATION_MATRIX
from vrw_jax.hybrid import product_multipliers, segment_maps

Q = 0.97
REFERENCE = math.exp(-2.0 * math.pi)
PERIOD = 2.0 * math.pi
STEEP = 2.0 * (1.0 + Q) / (1.0 - Q) - 1.0
"""Largest rate of contraction: so much an error of the phase moves the multiplier, relatively."""


def growth(theta, m):
    """Rate at which a disturbance of the radius grows."""
    # 1 - 2 q cos + q^2 would cancel at the peak, and cost 8e-13 of the multiplier.
    half = m.sin(0.5 * (theta - math.pi))
    return 1.0 - 2.0 * (1.0 - Q) * (1.0 + Q) / ((1.0 - Q) * (1.0 - Q) + 4.0 * Q * half * half)


def field(y, m):
    r, theta = y
    return 0.5 * growth(theta, m) * (r * r - 1.0) / r, 1.0 + 0.0 * theta


def compute_collocation_multiplier(n: int) -> float:
    """Return the multiplier by Gauss collocation with four nodes on `n` equal segments."""
    result, h = 1.0, PERIOD / n
    for i in range(n):
        rates = np.array([growth(h * (i + node), np) for node in GAUSS_NODES])
        slopes = np.linalg.solve(
            np.eye(len(GAUSS_NODES)) - h * rates[:, None] * INTEGRATION_MATRIX, rates
        )
        result *= 1.0 + h * END_WEIGHTS @ slopes
    return float(result)


def compute_library_multiplier(n: int) -> tuple[float, bool, float]:
    flow = lambda y: jnp.stack(field(y, JAX))
    cut = segment_maps(
        flow, jnp.array([1.0, 0.0]), PERIOD, n, vrw.StepOptions.tight(), n_directions=1
    )
    result = product_multipliers(cut.jacobians)
    return float(result.values[0].real), bool(result.is_known[0]), float(cut.divergence)


def variational_field(z, m):
    return growth(z[1], m) * z[0], 1.0 + 0.0 * z[1]


def rows() -> Iterator[Row]:
    for n in (1, 100):
        (solution, is_known, _), seconds = time_second_call(
            lambda n=n: compute_library_multiplier(n)
        )
        name = f"ours, {n} segment{'s' * (n > 1)}"
        yield Row(
            "multiplier", name, solution, REFERENCE, compute_error(solution, REFERENCE,
            relative=True), "",
            not is_known, n, seconds, "Dopri8 1e-13", version("vrw-jax"), STEEP,
        )  # fmt: skip
    for n in (10, 40, 400):
        solution, seconds = time_second_call(lambda n=n: compute_collocation_multiplier(n))
        yield Row(
            "multiplier", f"collocation, {n} segments", solution, REFERENCE,
            compute_error(solution, REFERENCE, relative=True), "", False, n, seconds, "4 Gauss "
                "nodes, equal",
            version("vrw-jax"), STEEP,
        )  # fmt: skip
    result, seconds = time_second_call(
        lambda: solve_ivp(
            lambda t, z: variational_field(z, math),
            (0.0, PERIOD),
            (1.0, 0.0),
            "DOP853",
            rtol=1e-13,
            atol=1e-20,
        )
    )
    solution = float(result.y[0, -1])
    yield Row(
        "multiplier", "SciPy", solution, REFERENCE, compute_error(solution, REFERENCE,
        relative=True), "",
        False, result.nfev,
        seconds, "DOP853 1e-13", version("scipy"), STEEP,
    )  # fmt: skip
    solve = eqx.filter_jit(
        lambda z: diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, z, _: jnp.stack(variational_field(z, JAX))),
            diffrax.Dopri8(), 0.0,
            PERIOD, 1e-3, z, stepsize_controller=diffrax.PIDController(rtol=1e-13, atol=1e-20),
        )
    )  # fmt: skip
    solved, seconds = time_second_call(lambda: jax.block_until_ready(solve(jnp.array([1.0, 0.0]))))
    answer, work = float(solved.ys[-1, 0]), int(solved.stats["num_steps"])
    yield Row(
        "multiplier", "diffrax", answer, REFERENCE, compute_error(answer, REFERENCE,
        relative=True), "",
        False, work,
        seconds, "Dopri8 1e-13", version("diffrax"), STEEP,
    )  # fmt: skip
    names = hy.make_vars("u", "theta")
    flow = hy.taylor_adaptive(
        list(zip(names, variational_field(names, hy), strict=True)), [1.0, 0.0]
    )

    def by_taylor() -> tuple[float, int]:
        flow.time, flow.state[:] = 0.0, (1.0, 0.0)
        steps = flow.propagate_until(PERIOD)[3]
        return float(flow.state[0]), int(steps)

    (solution, work), seconds = time_second_call(by_taylor)
    yield Row(
        "multiplier", "heyoka", solution, REFERENCE, compute_error(solution, REFERENCE,
        relative=True),
        "", False, work,
        seconds, "Taylor 2.2e-16", version("heyoka"), STEEP,
    )  # fmt: skip


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    counts = np.unique(np.round(np.geomspace(4, 1000, 60)).astype(int))
    solution = np.abs([compute_collocation_multiplier(int(n)) for n in counts])
    axes.loglog(counts, solution, ".-", label="collocation, equal segments")
    axes.axhline(REFERENCE, color="k", lw=0.8, label="reference, exp(−2π)")
    axes.axhline(1.0, color="0.6", ls=":", label="border of stability")
    mine = [compute_library_multiplier(n)[0] for n in (1, 10, 100)]
    axes.loglog((1, 10, 100), mine, "s", mfc="w", label="ours")
    axes.set_xlabel("segments")
    axes.set_ylabel("|multiplier|")
    axes.legend()


CASE = Case(
    "Wrong multipliers with few segments",
    "collocation loses a narrow contraction",
    "closed form, exp(−2π)",
    "a failure reported in issues of continuation packages; closed form derived here",
    rows,
    draw,
)

"""Painleve's rod: it slides on rough ground, and its contact has no answer, or two.

A uniform rod at the angle a to the ground, turning at the rate w, slides with friction m on its
lower end. The normal force N leaves the end the acceleration A N + b, A = 1 + 3 cos a (cos a - m
sin a) (in units of the mass), b = w^2 sin a - g for a half length of 1. N >= 0 and A N + b >= 0
exclude each other: for A < 0 there are two answers if b > 0, and none if b < 0. A reaches 0 first
at m = 4/3 and tan a = 2.
"""

import json
import math
from collections.abc import Iterator
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve, nnls

from experiments.atlas.others import make_rows
from experiments.atlas.results import Case, Row, compute_error, time_second_call
from vrw_jax.continuation import solve_fixed_point
from vrw_jax.hybrid import LCPStatus, enumerate_lcp_solutions

G, FRICTION = 9.81, 1.6
STATES = {"one answer": (0.4, 0.0, 1), "two answers": (1.1, 5.0, 2), "no answer": (1.1, 0.0, 0)}
STIFF = 1e7
"""Of a penalty ground, N/m for each kg."""


def contact(angle, rate, friction, m=np):
    """Return the coefficients A and b of the contact law."""
    sin, cos = m.sin(angle), m.cos(angle)
    return 1.0 + 3.0 * cos * (cos - friction * sin), rate * rate * sin - G


def penalty(angle: float, rate: float) -> tuple[float, int]:
    """Force after 0.01 s on a stiff ground without the rod's turning, and evaluations."""
    a, b = contact(angle, rate, FRICTION)
    force = lambda z, v: STIFF * max(-z, 0.0) - (2.0 * math.sqrt(STIFF) * v if z < 0.0 else 0.0)
    result = solve_ivp(
        lambda t, y: (y[1], a * force(*y) + b), (0.0, 0.01), (-1e-7, 0.0), "Radau", rtol=1e-8,
        atol=1e-14,
    )  # fmt: skip
    return force(*result.y[:, -1]), result.nfev


def rows() -> Iterator[Row]:
    for name, (angle, rate, count) in STATES.items():
        a, b = contact(angle, rate, FRICTION)
        result, seconds = time_second_call(lambda a=a, b=b: enumerate_lcp_solutions([[a]], [b]))
        solution, code = int(np.sum(result.is_solution)), LCPStatus(int(result.status))
        yield Row(
            name, "ours", solution, count, compute_error(solution, count),
            "" if count == 1 else code.name,
            count != 1, 2, seconds, "all combinations", version("vrw-jax"),
        )  # fmt: skip
        (force, residual), seconds = time_second_call(
            lambda a=a, b=b: nnls(np.array([[a]]), np.array([-b]))
        )
        says = "" if residual < 1e-9 else f"residual {residual:.1e}"
        yield Row(
            name, "SciPy, nnls", 1, count, compute_error(1, count), says, bool(says), 1, seconds,
            f"force {force[0]:.3g}", version("scipy"),
        )  # fmt: skip
        (force, work), seconds = time_second_call(
            lambda angle=angle, rate=rate: penalty(angle, rate)
        )
        yield Row(
            name, "SciPy, penalty ground", 1, count, compute_error(1, count), f"force "
                f"{force:.3g}", False,
            work, seconds, f"Radau 1e-8, stiffness {STIFF:g}", version("scipy"),
        )  # fmt: skip

    rod = json.dumps({name: contact(*state[:2], FRICTION) for name, state in STATES.items()})
    counts = {name: float(count) for name, (_, _, count) in STATES.items()}
    yield from make_rows("siconos", "painleve", counts, "--rod", rod)

    def border(x: jax.Array) -> jax.Array:
        value, slope = jax.value_and_grad(lambda a: contact(a, 0.0, x[1], jnp)[0])(x[0])
        return jnp.stack([value, slope])

    start = jnp.array([1.0, 1.5])
    solution, seconds = time_second_call(lambda: solve_fixed_point(lambda x: x + border(x), start))
    friction = float(solution.x[1])
    yield Row(
        "least friction", "ours", friction, 4.0 / 3.0, compute_error(friction, 4.0 / 3.0),
        "" if solution.converged else "not "
            "converged", not solution.converged, int(solution.n_iterations),
        seconds, "Newton", version("vrw-jax"),
    )  # fmt: skip
    (other, info, _, _), seconds = time_second_call(
        lambda: fsolve(
            lambda x: np.asarray(border(jnp.asarray(x))), np.asarray(start), full_output=True
        )
    )
    yield Row(
        "least "
            "friction", "SciPy", float(other[1]), 4.0 / 3.0, compute_error(float(other[1]),
            4.0 / 3.0), "",
        False, int(info["nfev"]), seconds, "fsolve 1.5e-8", version("scipy"),
    )  # fmt: skip


def draw(figure: Figure, rows: list[dict[str, str]]) -> None:
    axes = figure.subplots()
    angles, rates = np.linspace(0.0, math.pi / 2, 241), np.linspace(0.0, 6.0, 241)
    grid = jnp.stack(jnp.meshgrid(angles, rates), -1).reshape(-1, 2)

    def count(x: jax.Array) -> jax.Array:
        a, b = contact(x[0], x[1], FRICTION, jnp)
        return enumerate_lcp_solutions(a[None, None], b[None]).status

    counts = np.asarray(jax.vmap(count)(grid)).reshape(len(rates), len(angles))
    colours = ListedColormap(["#D55E00", "#E8E8E8", "#56B4E9"])
    image = axes.pcolormesh(
        angles, rates, counts, cmap=colours, vmin=-0.5, vmax=2.5, rasterized=True
    )
    bar = figure.colorbar(image, ticks=[0, 1, 2])
    bar.ax.set_yticklabels(["none", "one", "two"])
    for angle, rate, _ in STATES.values():
        axes.plot(angle, rate, "ko", ms=4)
    axes.set_xlabel("angle to the ground [rad]")
    axes.set_ylabel("angular velocity [rad/s]")


CASE = Case(
    "Rod of Painlevé",
    "the contact problem has no solution, or two",
    "analysis: counts, and the least friction 4/3",
    "Painlevé 1895; Génot and Brogliato, Eur. J. Mech. A 18 (1999); derived in the module",
    rows,
    draw,
)

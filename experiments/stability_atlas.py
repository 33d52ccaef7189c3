"""Where methods fail: stiffness, events, borders of derivatives, long walks, formulations.

    python experiments/stability_atlas.py [--only NAME] [--cases 1000000] [--redraw]

Each map is a function that fills one small table (csv) and one that draws it; a table that exists
is kept, so that a run that was stopped goes on. docs/stability_atlas.md reads them.
"""

import argparse
import csv
import functools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import atlas_charts as charts
import atlas_events as events
import atlas_formulations as formulations
import engine_peers as peers
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import vrw_jax as vrw
from vrw_jax import transitions
from vrw_jax.params import PARAMETER_NAMES
from vrw_jax.runge_kutta import explicit_tableau, real_stability_limit

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from oracle import multiprecision
from oracle.hub_form import HubForm

ORACLE = Path(__file__).parents[1] / "tests" / "oracle"
TARGET = Path(__file__).parents[1] / "docs" / "figures"
Rows = Iterator[dict[str, object]]
START = np.array([0.1, 1.6, -0.1])  # near the gait of Table 1

# --- Stiffness: a leg's mass goes to nothing, total mass and everything else stay.

STIFFNESS = np.logspace(2.0, 6.0, 9)  # c/m or k/m, 1/s or 1/s^2
HEAVIEST = 300.0  # k/m below which eight legs outweigh the wheel
TOLERANCE = 1e-6
LIBRARY = (
    ("lanes", "Tsit5"),
    ("lanes", "Dopri8"),
    ("diffrax", "Kvaerno3"),
    ("diffrax", "Kvaerno5"),
)
IMPLICIT_TOO = ("DOP853", "LSODA", "Radau")


def stiff_wheel(axis: str, value: float) -> dict[str, float]:
    """Table 1 with a lighter leg: c stays and c/m grows, or k stays and k/m grows at c/m = 100."""
    mass = 100.0 / value if axis == "c/m" else 500.0 / value
    damping = 100.0 if axis == "c/m" else 100.0 * mass
    return {"leg_mass": mass, "damping": damping, "hub_mass": 18.0 - 8.0 * mass}


def real_axis_limit(solver: str) -> float:
    """Largest z with |R(-z)| <= 1 of an explicit solver's stability polynomial."""
    tableau = explicit_tableau(solver, vrw.Options())
    assert tableau is not None
    return real_stability_limit(tableau)


def stiffness() -> Rows:
    """Cost, error and outcome of one step by eight methods over c/m and k/m."""
    places = [("c/m", value) for value in STIFFNESS]
    places += [("k/m", value) for value in STIFFNESS if value > HEAVIEST]
    truths = {}
    for axis, value in places:
        wheel = stiff_wheel(axis, value)
        params = vrw.WheelParams(**{name: np.full(1, x) for name, x in wheel.items()})
        landing = transitions.land(params.symbols(), *START)
        y = np.stack([landing.theta + 0.0 * landing.motion.dtheta, landing.motion.dtheta], 1)
        packed = peers.pack(params)
        truths[axis, value] = peers.Heyoka(1e-15)(y, packed)[0, :6]
        loose = functools.partial(peers.scipy_steps, y, packed, TOLERANCE)
        runs = {
            "numba Dopri5": functools.partial(peers.numba_steps, y, packed, TOLERANCE),
            "heyoka": functools.partial(peers.Heyoka(TOLERANCE), y, packed),
            **{f"SciPy {name}": functools.partial(loose, name) for name in IMPLICIT_TOO},
        }
        for name, run in runs.items():
            run()
            begin = time.process_time()
            told = run()[0]
            taken = time.process_time() - begin
            error = float(np.max(np.abs(told[:6] - truths[axis, value])))
            yield row_of(axis, value, name, taken, told[6], error, "STEPPED", told[4])
    for engine, solver in LIBRARY:
        options = vrw.Options(solver=solver, rtol=TOLERANCE, atol=TOLERANCE)
        for axis, value in places:
            params = vrw.WheelParams(**stiff_wheel(axis, value))
            # Both engines fill up their blocks with equal lanes: that is what is timed.
            width = 2048 if engine == "lanes" else 256
            step = functools.partial(vrw.steps, params, START[None], options=options, engine=engine)
            step()
            begin = time.process_time()
            found = step()
            taken = (time.process_time() - begin) / width
            told = np.concatenate([found.section_state[0], found.durations[0]])
            error = float(np.max(np.abs(told - truths[axis, value])))
            outcome = vrw.Outcome(int(found.outcome[0])).name
            count, name = int(found.solver_steps[0]), f"{engine} {solver}"
            yield row_of(axis, value, name, taken, count, error, outcome, told[4])


def row_of(axis, value, method, taken, work, error, outcome, sls1) -> dict[str, object]:
    return {
        "axis": axis,
        "value": f"{value:.4g}",
        "method": method,
        "us_per_gait": f"{taken * 1e6:.4g}",
        "work": f"{work:.0f}",  # evaluations of peers, tried steps of the library
        "error": f"{error:.2e}",
        "outcome": outcome,
        "duration_sls1": f"{sls1:.6g}",
    }


# --- Derivatives near borders.

DISTANCES = np.logspace(-1.0, -9.0, 9)


BORDERS = {  # wheel, and the start's rate on the other side, rad/s
    "double support vanishes": ({"damping": 100.0, "slope": 0.30}, 3.2),
    "λ4⁺ → 0": ({"damping": 150.0, "slope": 0.30}, 2.3),
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
        (code,), (durations,) = events.isolated(made, params, start_with(middle)[None])
        if code == vrw.Outcome.STEPPED and np.all(durations > 0.0):
            good = middle
        else:
            bad = middle
    return good


def borders() -> Rows:
    """Error of first derivatives by a start's rate over its distance to borders."""
    multiprecision.BITS, multiprecision.DIGITS, mp.mp.prec = 120, 35, 120
    hub, made = HubForm(), events.phases()

    def twice(x: jax.Array, params: vrw.WheelParams) -> tuple:
        image = vrw.return_map(params, x)
        return image, image

    derive = jax.jit(jax.jacfwd(twice, has_aux=True))
    for name, (wheel, beyond) in BORDERS.items():
        edge = border(made, wheel, beyond)
        params = vrw.WheelParams(**wheel)
        batch = vrw.WheelParams(**{key: np.full(1, value) for key, value in wheel.items()})
        p = [mp.mpf(float(getattr(params, n))) for n in multiprecision.NAMES] + [mp.mpf(8)]
        for distance in DISTANCES:
            start = start_with(edge * (1.0 + distance * np.sign(START[1] - edge)))
            _, (about,) = events.isolated(made, batch, start[None])
            size, ends = mp.mpf(distance) * mp.mpf("1e-8"), []
            for sign in (1, -1):
                x = [mp.mpf(float(v)) for v in start]
                x[1] += sign * size
                ends.append(hub.walk(hub.land(x, p)[0], p, about).section_state)
            truth = np.array([float((a - b) / (2 * size)) for a, b in zip(*ends, strict=True)])
            exact = np.array([float((a + b) / 2) for a, b in zip(*ends, strict=True)])
            jacobian, value = derive(jnp.asarray(start), params)
            miss = np.max(np.abs(np.asarray(jacobian)[:, 1] - truth))
            yield {
                "border": name,
                "edge": f"{edge:.6g}",
                "distance": f"{distance:.0e}",
                "derivative": f"{np.max(np.abs(truth)):.4g}",
                "derivative_error": f"{miss / max(np.max(np.abs(truth)), 1.0):.1e}",
                "value_error": f"{np.max(np.abs(np.asarray(value) - exact)):.1e}",
                "durations": " ".join(f"{d:.2g}" for d in about),
            }


# --- Long walks.

WALK, BLOCK = 100_000, 1000
WALKED = (1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)


def long_walk() -> Rows:
    """Distance from the cycle over many steps of Table 1's wheel, one wheel, default options."""
    params, model, options = vrw.WheelParams(), vrw.ViscoelasticWheel(), vrw.Options()
    truth = json.loads((ORACLE / "truth.json").read_text())["cases"][0]["cycle"]
    first = np.array([float(value) for value in truth["section_state"]])
    period = float(truth["period"])

    def one(x: jax.Array, _: None) -> tuple:
        found = model.advance(params, x, options)
        return found.section_state, (found.outcome, jnp.sum(found.durations))

    block = jax.jit(lambda x: jax.lax.scan(one, x, None, length=BLOCK))
    x, failed, largest, clock = jnp.asarray(first), 0, 0.0, 0.0
    for count in range(BLOCK, WALK + 1, BLOCK):
        x, (outcome, periods) = block(x)
        failed += int(np.sum(np.asarray(outcome) != vrw.Outcome.STEPPED))
        distance = float(np.max(np.abs(np.asarray(x) - first)))
        largest, clock = max(largest, distance), clock + float(np.sum(periods))
        if count in WALKED:
            yield {
                "steps": count,
                "failed": failed,
                "distance": f"{distance:.2e}",
                "largest_distance": f"{largest:.2e}",
                "clock_error_s": f"{abs(clock - count * period):.2e}",
            }


MAPS: dict[str, Callable[..., Rows]] = {
    "formulations": formulations.penalty,
    "drift": formulations.drift,
    "events": events.compare,
    "borders": borders,
    "long_walk": long_walk,
    "stiffness": stiffness,
}


def table_of(name: str) -> Path:
    return TARGET / f"atlas_{name}.csv"


def fill(name: str, rows: Rows) -> None:
    """Compute a map's table."""
    told = []
    for row in rows:
        told.append(row)
        print(name, *row.values(), flush=True)
    with table_of(name).open("w", newline="") as file:
        writer = csv.DictWriter(file, told[0])
        writer.writeheader()
        writer.writerows(told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=MAPS, help="one map")
    parser.add_argument("--cases", type=int, default=1_000_000, help="of the map of events")
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    TARGET.mkdir(parents=True, exist_ok=True)
    for name, rows in MAPS.items():
        if chosen.redraw or table_of(name).exists() or chosen.only not in (None, name):
            continue
        fill(name, rows(chosen.cases) if name == "events" else rows())
    charts.draw(TARGET, {name: table_of(name) for name in MAPS}, real_axis_limit)


assert set(stiff_wheel("c/m", 1e2)) <= set(PARAMETER_NAMES)
if __name__ == "__main__":
    main()

"""Where methods fail: stiffness, events, borders of derivatives, long walks, formulations.

    python experiments/stability_atlas.py [--only NAME] [--cases 1000000] [--redraw]

Each map is a function that fills one small table (csv) and one that draws it; a table that exists
is kept, so that a run that was stopped goes on. docs/stability_atlas.md reads them.
"""

import argparse
import csv
import functools
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
from vrw_jax.runge_kutta import explicit_tableau

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from oracle import multiprecision
from oracle.hub_form import HubForm

TARGET = Path(__file__).parents[1] / "docs" / "figures"
Rows = Iterator[dict[str, object]]
START = np.array([0.1, 1.6, -0.1])  # near the gait of Table 1

# --- Stiffness: a leg's mass goes to nothing, total mass and everything else stay.

STIFFNESS = np.logspace(2.0, 6.0, 9)  # c/m or k/m, 1/s or 1/s^2
TOLERANCE = 1e-6
IMPLICIT_TOO = ("DOP853", "LSODA", "Radau")


def stiff_wheel(axis: str, value: float) -> dict[str, float]:
    """Table 1 with a lighter leg: c stays and c/m grows, or k stays and k/m grows at c/m = 100."""
    mass = 100.0 / value if axis == "c/m" else 500.0 / value
    damping = 100.0 if axis == "c/m" else 100.0 * mass
    return {"leg_mass": mass, "damping": damping, "hub_mass": 18.0 - 8.0 * mass}


def real_axis_limit(solver: str) -> float:
    """Largest z with |R(-z)| <= 1 of an explicit solver's stability polynomial."""
    tableau = explicit_tableau(solver, vrw.Options())
    n = len(tableau.places)
    weights = tableau.once[-1]
    growth = lambda z: 1.0 - z * weights @ np.linalg.solve(np.eye(n) + z * tableau.once, np.ones(n))
    z = np.linspace(0.01, 12.0, 12_000)
    stable = np.abs([growth(x) for x in z]) <= 1.0 + 1e-12
    return float(z[np.argmin(stable)])


def stiffness() -> Rows:
    """Cost, error and outcome of one step by ten methods over c/m and k/m."""
    library = [("lanes", "Tsit5", 64), ("lanes", "Dopri8", 64)]
    library += [("diffrax", "Kvaerno3", 16), ("diffrax", "Kvaerno5", 16)]
    for axis in ("c/m", "k/m"):
        truths = {}
        for value in STIFFNESS:
            changes = stiff_wheel(axis, value)
            params = vrw.WheelParams(**{name: np.full(1, x) for name, x in changes.items()})
            landing = transitions.land(params.symbols(), *START)
            y = np.stack([landing.theta + 0.0 * landing.motion.dtheta, landing.motion.dtheta], 1)
            packed = peers.pack(params)
            truths[value] = peers.Heyoka(1e-15)(y, packed)[0, :6]
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
                error = float(np.max(np.abs(told[:6] - truths[value])))
                yield row_of(axis, value, name, taken, told[6], error, "STEPPED", told[4])
        for engine, solver, lanes in library:
            options = vrw.Options(solver=solver, rtol=TOLERANCE, atol=TOLERANCE)
            for value in STIFFNESS:
                params = vrw.WheelParams(**stiff_wheel(axis, value))
                states = np.tile(START, (lanes, 1))
                # Both engines fill up their blocks with equal lanes: that is what is timed.
                width = 2048 if engine == "lanes" else 256
                vrw.steps(params, states, options=options, engine=engine)
                begin = time.process_time()
                found = vrw.steps(params, states, options=options, engine=engine)
                taken = (time.process_time() - begin) / width
                told = np.concatenate([found.section_state[0], found.durations[0]])
                error = float(np.max(np.abs(told - truths[value])))
                outcome = vrw.Outcome(int(found.outcome[0])).name
                count = int(found.solver_steps[0])
                yield row_of(
                    axis, value, f"{engine} {solver}", taken, count, error, outcome, told[4]
                )
            jax.clear_caches()


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


def parameters(damping: float) -> list:
    wheel = vrw.WheelParams(damping=damping)
    names = multiprecision.NAMES
    return [mp.mpf(float(getattr(wheel, name))) for name in names] + [mp.mpf(8)]


def outcome_of(damping: float, start: np.ndarray) -> vrw.Outcome:
    found = vrw.steps(vrw.WheelParams(damping=damping), start[None], engine="diffrax")
    return vrw.Outcome(int(found.outcome[0]))


def border(damping: float, start: np.ndarray, beyond: float) -> float:
    """The start's rate at which the step's outcome changes, by bisection between two rates."""
    good, bad = start[1], beyond
    for _ in range(60):
        middle = 0.5 * (good + bad)
        moved = np.array([start[0], middle, start[2]])
        if outcome_of(damping, moved) == vrw.Outcome.STEPPED:
            good = middle
        else:
            bad = middle
    return good


def borders() -> Rows:
    """Error of first derivatives by a start's rate over its distance to two borders."""
    multiprecision.BITS, multiprecision.DIGITS, mp.mp.prec = 120, 35, 120
    hub = HubForm()
    derive = jax.jit(jax.jacfwd(lambda x, p: vrw.return_map(p, x)))
    for name, damping, beyond in (("falls back", 200.0, 0.8), ("stopper too late", 200.0, 2.4)):
        edge = border(damping, START, beyond)
        params = vrw.WheelParams(damping=damping)
        for distance in DISTANCES:
            rate = edge * (1.0 + distance * np.sign(START[1] - edge))
            start = np.array([START[0], rate, START[2]])
            step = vrw.steps(params, start[None], options=vrw.Options.tight(), engine="diffrax")
            if int(step.outcome[0]) != vrw.Outcome.STEPPED:
                continue
            about = np.asarray(step.durations[0])
            ends = []
            size = mp.mpf(distance) * mp.mpf("1e-8")
            for sign in (1, -1):
                x = [mp.mpf(float(v)) for v in start]
                x[1] += sign * size
                p = parameters(damping)
                landed = hub.walk(hub.land(x, p)[0], p, about)
                ends.append(landed.section_state)
            truth = np.array([float((a - b) / (2 * size)) for a, b in zip(*ends, strict=True)])
            found = np.asarray(derive(jnp.asarray(start), params))[:, 1]
            values = np.asarray(vrw.steps(params, start[None], engine="diffrax").section_state[0])
            exact = np.array([float(0.5 * (a + b)) for a, b in zip(*ends, strict=True)])
            yield {
                "border": name,
                "edge": f"{edge:.15g}",
                "distance": f"{distance:.1e}",
                "derivative": f"{np.max(np.abs(truth)):.6g}",
                "derivative_error": f"{np.max(np.abs(found - truth)) / np.max(np.abs(truth)):.2e}",
                "value_error": f"{np.max(np.abs(values - exact)):.2e}",
                "durations": " ".join(f"{d:.3g}" for d in about),
            }


# --- Long walks.

WALK, BLOCK = 100_000, 1000


def long_walk() -> Rows:
    """Distance from the cycle and energy not accounted for, over many steps of Table 1's wheel."""
    params = vrw.WheelParams()
    cycle = vrw.limit_cycle(params, options=vrw.CycleOptions.tight())
    x = cycle.section_state
    s, model, options = params.symbols(), vrw.ViscoelasticWheel(), vrw.Options()

    def one(x: jax.Array, _: None) -> tuple:
        found = model.step(params, x, options)
        energy = found.energy
        lost = energy.landing + energy.stopper + energy.damping
        # Between two touchdowns kinetic and elastic energy change, and the slope gives its part.
        return found.section_state, (found.outcome, lost, found.step_length)

    block = jax.jit(lambda x: jax.lax.scan(one, x, None, length=BLOCK))
    first, lost, gained, spread, failed = np.asarray(x), 0.0, 0.0, 0.0, 0
    weight = float(s.Mt * s.g * s.sin_phi)
    for count in range(BLOCK, WALK + 1, BLOCK):
        x, (outcome, losses, lengths) = block(x)
        failed += int(np.sum(np.asarray(outcome) != 0))
        lost += float(np.sum(losses))
        gained += weight * float(np.sum(lengths))
        spread = max(spread, float(np.max(np.abs(np.asarray(x) - first))))
        if np.log10(count) % 1.0 == 0.0 or count % 20_000 == 0:
            yield {
                "steps": count,
                "failed": failed,
                "distance": f"{float(np.max(np.abs(np.asarray(x) - first))):.2e}",
                "largest_distance": f"{spread:.2e}",
                "energy_gained_J": f"{gained:.10g}",
                "energy_missing": f"{abs(lost - gained) / gained:.2e}",
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

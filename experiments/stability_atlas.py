"""Where methods fail: stiffness, events, borders of derivatives, long walks, formulations.

    python experiments/stability_atlas.py [--only NAME] [--cases 1000000] [--redraw]

Each map is a function that fills one small table (csv) and one that draws it. A table that exists
is kept; that of events goes on where it was stopped. docs/stability_atlas.md reads them.
"""

import argparse
import csv
import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import atlas_charts as charts
import atlas_derivatives as derivatives
import atlas_events as events
import atlas_formulations as formulations
import atlas_limits as limits
import atlas_walks as walks
import engine_peers as peers
import numpy as np
import work_precision  # noqa: F401  sets one core and starts JAX

import vrw_jax as vrw
from vrw_jax import Outcome
from vrw_jax.numerics.tableaus import explicit_tableau, real_stability_limit
from vrw_jax.wheel import transitions
from vrw_jax.wheel.params import PARAMETER_NAMES

TARGET = Path(__file__).parents[1] / "docs" / "figures"
Rows = Iterator[dict[str, object]]
START = np.array([0.1, 1.6, -0.1])  # near the gait of Table 1

# --- Stiffness: a leg's mass goes to nothing, total mass and everything else stay.

STIFFNESS = np.logspace(2.0, 6.0, 9)  # c/m or k/m, 1/s or 1/s^2
HEAVIEST = 300.0  # k/m below which eight legs outweigh the wheel
TOLERANCE = 1e-6
LIBRARY = {  # engine and solver of `vrw.steps`
    "lanes Tsit5": ("lanes", "Tsit5"),
    "lanes Dopri8": ("lanes", "Dopri8"),
    "diffrax Kvaerno3": ("diffrax", "Kvaerno3"),
    "diffrax Kvaerno5": ("diffrax", "Kvaerno5"),
    "automatic": ("auto", vrw.Options().solver),
}
PEERS = ("DOP853", "LSODA", "Radau")  # of SciPy


def stiff_wheel(axis: str, value: float) -> dict[str, float]:
    """Table 1 with a lighter leg: c stays and c/m grows, or k stays and k/m grows at c/m = 100."""
    if axis == "c/m":
        return limits.light_wheel(value)
    mass = 500.0 / value
    return {"leg_mass": mass, "damping": 100.0 * mass, "hub_mass": 18.0 - 8.0 * mass}


def real_axis_limit(solver: str) -> float:
    """Largest z with |R(-z)| <= 1 of an explicit solver's stability polynomial."""
    tableau = explicit_tableau(solver)
    assert tableau is not None
    return real_stability_limit(tableau)


TURNS, SHORT, LONG = 7, 0.1, 3.0
"""Of timing: rounds; seconds for which a method is repeated in each (a process's clock may stand
still for some ms); seconds of a call beyond which one is enough."""


def stiffness() -> Rows:
    """Cost, error and outcome of one step by every method over c/m and k/m."""
    places = [("c/m", value) for value in STIFFNESS]
    places += [("k/m", value) for value in STIFFNESS if value > HEAVIEST]
    for axis, value in places:
        wheel = stiff_wheel(axis, value)
        params = vrw.WheelParams(**{name: np.full(1, x) for name, x in wheel.items()})
        landing = transitions.land(params.symbols(), *START)
        y = np.stack([landing.theta + 0.0 * landing.motion.dtheta, landing.motion.dtheta], 1)
        packed = peers.pack(params)
        truth = peers.Heyoka(1e-15)(y, packed)[0, :6]
        peer = lambda steps, *more, y=y, packed=packed: (
            1,
            functools.partial(steps, y, packed, *more),
            lambda told: (told[0, :6], told[0, 6], Outcome.STEPPED, ""),
        )
        runs = {
            "numba Dopri5": peer(peers.numba_steps, TOLERANCE),
            "heyoka": peer(peers.Heyoka(TOLERANCE)),
            **{f"SciPy {name}": peer(peers.scipy_steps, TOLERANCE, name) for name in PEERS},
            **{name: by_library(wheel, *how) for name, how in LIBRARY.items()},
        }
        compiled = {name: read(run()) for name, (_, run, read) in runs.items()}
        least = dict.fromkeys(runs, np.inf)
        for _ in range(TURNS):  # in turn: a shared machine's clock changes within minutes
            for name, (lanes, run, _) in runs.items():
                if LONG < least[name] * lanes < np.inf:
                    continue
                begin, spent, calls = time.process_time(), 0.0, 0
                while spent < SHORT:
                    run()
                    spent, calls = time.process_time() - begin, calls + 1
                least[name] = min(least[name], spent / calls / lanes)
        for name, (values, work, outcome, solver) in compiled.items():
            good = np.all(np.isfinite(values))
            yield {
                "axis": axis,
                "value": f"{value:.4g}",
                "method": name,
                "solver": solver,  # that `vrw.steps` took
                "us_per_gait": f"{least[name] * 1e6:.4g}",
                "work": f"{work:.0f}",  # evaluations of peers, tried steps of the library
                "error": f"{np.max(np.abs(values - truth)):.2e}",
                "outcome": (outcome if good else Outcome.SOLVER_GAVE_UP).name,
                "duration_sls1": f"{truth[4]:.6g}",
            }


def by_library(wheel: dict[str, float], engine: str, solver: str) -> tuple:
    """Lanes in a call, the call, and what it tells: values, tried steps, outcome, solver."""
    options = vrw.Options(solver=solver, rtol=TOLERANCE, atol=TOLERANCE)
    lanes = 256 if engine == "diffrax" else 2048  # full blocks
    params, starts = vrw.WheelParams(**wheel), np.tile(START, (lanes, 1))
    run = lambda: vrw.steps(params, starts, options=options, engine=engine)

    def read(told: vrw.Steps) -> tuple:
        values = np.concatenate([told.section_state[0], told.durations[0]])
        outcome, solver = Outcome(int(told.outcome[0])), told.solvers[int(told.solver[0])]
        return values, int(told.solver_steps[0]), outcome, solver

    return lanes, run, read


MAPS: dict[str, Callable[..., Rows]] = {
    "formulations": formulations.penalty,
    "drift": formulations.drift,
    "events": events.compare,
    "between": limits.between,
    "limits": limits.limits,
    "first_order": limits.first_order,
    "slowing": limits.slowing,
    "borders": derivatives.borders,
    "scuffing": derivatives.scuffing,
    "growth": derivatives.growth,
    "apart": derivatives.apart,
    "meeting": derivatives.meeting,
    "modes": derivatives.modes,
    "long_walk": walks.long_walk,
    "stiffness": stiffness,
}


def table_of(name: str) -> Path:
    return TARGET / f"atlas_{name}.csv"


def fill(name: str, rows: Rows, append: bool = False) -> None:
    """Compute a map's table, or the rows that it lacks."""
    with table_of(name).open("a" if append else "w", newline="") as file:
        for row in rows:
            writer = csv.DictWriter(file, row)
            if not append:
                writer.writeheader()
                append = True
            writer.writerow(row)
            file.flush()
            print(name, *row.values(), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=MAPS, help="one map")
    parser.add_argument("--cases", type=int, default=1_000_000, help="of the map of events")
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    chosen = parser.parse_args()
    TARGET.mkdir(parents=True, exist_ok=True)
    for name, rows in MAPS.items():
        if chosen.redraw or chosen.only not in (None, name):
            continue
        kept = len(charts.read(table_of(name))) if table_of(name).exists() else 0
        if name == "events":  # goes on, chunk by chunk
            fill(name, rows(chosen.cases, kept), append=kept > 0)
        elif kept == 0:
            fill(name, rows())
    charts.draw(TARGET, {name: table_of(name) for name in MAPS}, real_axis_limit)


assert set(stiff_wheel("c/m", 1e2)) <= set(PARAMETER_NAMES)
if __name__ == "__main__":
    main()

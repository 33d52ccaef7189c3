"""Stiffness: a leg's mass goes to nothing, total mass and everything else stay."""

import functools
import time

import numpy as np

import vrw_jax as vrw
from experiments.atlas.events import START, Rows
from experiments.atlas.limits import light_wheel
from experiments.speed import peers
from vrw_jax import Outcome
from vrw_jax.flow import compute_real_stability_limit, load_explicit_tableau
from vrw_jax.wheel import transitions

STIFFNESS = np.logspace(2.0, 6.0, 9)  # c/m or k/m, 1/s or 1/s^2
HEAVIEST = 300.0  # k/m below which eight legs outweigh the wheel
TOLERANCE = 1e-6
LIBRARY = {  # engine and solver of `vrw.steps`
    "lanes Tsit5": ("lanes", "Tsit5"),
    "lanes Dopri8": ("lanes", "Dopri8"),
    "diffrax Kvaerno3": ("diffrax", "Kvaerno3"),
    "diffrax Kvaerno5": ("diffrax", "Kvaerno5"),
    "automatic": ("auto", "Dopri8"),
}
PEERS = ("DOP853", "LSODA", "Radau")  # of SciPy


def stiff_wheel(axis: str, value: float) -> dict[str, float]:
    """Table 1 with a lighter leg: c stays and c/m grows, or k stays and k/m grows at c/m = 100."""
    if axis == "c/m":
        return light_wheel(value)
    mass = 500.0 / value
    return {"leg_mass": mass, "damping": 100.0 * mass, "hub_mass": 18.0 - 8.0 * mass}


def real_axis_limit(solver: str) -> float:
    """Largest z with |R(-z)| <= 1 of an explicit solver's stability polynomial."""
    tableau = load_explicit_tableau(solver)
    assert tableau is not None
    return compute_real_stability_limit(tableau)


N_TIMING_ROUNDS, MIN_TIMING_SECONDS, MAX_TIMING_SECONDS = 7, 0.1, 3.0
"""Of timing: rounds; seconds for which a method is repeated in each (a process's clock may stand
still for some ms); seconds of a call beyond which one is enough."""


def measure_over_rates() -> Rows:
    """Cost, error and outcome of one step by every method over c/m and k/m."""
    places = [("c/m", value) for value in STIFFNESS]
    places += [("k/m", value) for value in STIFFNESS if value > HEAVIEST]
    for axis, value in places:
        wheel = stiff_wheel(axis, value)
        params = vrw.WheelParams(**{name: np.full(1, x) for name, x in wheel.items()})
        landing = transitions.resolve_landing(params.symbols(), *START)
        y = np.stack(
            [
                landing.theta_after_landing + 0.0 * landing.motion_after.dtheta,
                landing.motion_after.dtheta,
            ],
            1,
        )
        packed = peers.pack(params)
        reference = peers.Heyoka(1e-15)(y, packed)[0, :6]
        peer = lambda steps, *more, y=y, packed=packed: (
            1,
            functools.partial(steps, y, packed, *more),
            lambda row: (row[0, :6], row[0, 6], Outcome.STEPPED, ""),
        )
        runs = {
            "numba Dopri5": peer(peers.numba_steps, TOLERANCE),
            "heyoka": peer(peers.Heyoka(TOLERANCE)),
            **{f"SciPy {name}": peer(peers.scipy_steps, TOLERANCE, name) for name in PEERS},
            **{name: run_library(wheel, *options_used) for name, options_used in LIBRARY.items()},
        }
        compiled = {name: read(run()) for name, (_, run, read) in runs.items()}
        minimum = dict.fromkeys(runs, np.inf)
        for _ in range(N_TIMING_ROUNDS):  # in turn: a shared machine's clock changes within minutes
            for name, (lanes, run, _) in runs.items():
                if MAX_TIMING_SECONDS < minimum[name] * lanes < np.inf:
                    continue
                begin, spent_seconds, calls = time.process_time(), 0.0, 0
                while spent_seconds < MIN_TIMING_SECONDS:
                    run()
                    spent_seconds, calls = time.process_time() - begin, calls + 1
                minimum[name] = min(minimum[name], spent_seconds / calls / lanes)
        for name, (values, work, outcome, solver) in compiled.items():
            good = np.all(np.isfinite(values))
            yield {
                "axis": axis,
                "value": f"{value:.4g}",
                "method": name,
                "solver": solver,  # that `vrw.steps` took
                "us_per_gait": f"{minimum[name] * 1e6:.4g}",
                "work": f"{work:.0f}",  # evaluations of peers, tried steps of the library
                "error": f"{np.max(np.abs(values - reference)):.2e}",
                "outcome": (outcome if good else Outcome.SOLVER_FAILED).name,
                "duration_sls1": f"{reference[4]:.6g}",
            }


def run_library(wheel: dict[str, float], engine: str, solver: str) -> tuple:
    """Return the number of lanes, values, tried steps, outcome and solver of a call of the
    library.
    """
    options = vrw.StepOptions(solver=solver, rtol=TOLERANCE, atol=TOLERANCE)
    lanes = 256 if engine == "diffrax" else 2048  # full blocks
    params, starts = vrw.WheelParams(**wheel), np.tile(START, (lanes, 1))
    run = lambda: vrw.step_batch(params, starts, options=options, engine=engine)

    def read(result: vrw.StepBatchResult) -> tuple:
        values = np.concatenate([result.section_state[0], result.durations[0]])
        outcome, solver = (
            Outcome(int(result.outcome[0])),
            result.solver_names[int(result.solver_index[0])],
        )
        return values, int(result.solver_steps[0]), outcome, solver

    return lanes, run, read

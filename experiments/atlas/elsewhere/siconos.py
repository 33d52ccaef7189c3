"""Siconos' time stepping on the bouncing ball, and its Lemke on the contact of Painlevé's rod.

    python -m experiments.atlas.elsewhere.siconos [--step 1e-5] [--rod '{"name": [1.0, -1.0]}']

With a Python that has Siconos: Debian's python3-siconos and python3; Python's index has none.
A bounce is told at the end of the step whose impulse is not zero. The contact's matrix and free
rate are given by cases/painleve; Lemke's method tells one answer or, by its code, none.
"""

import argparse
import json
import sys
import time


def bounces(step: float) -> tuple[list[float], float, int]:
    """Times of bounces, CPU seconds, and steps."""
    import numpy as np
    from siconos import kernel as sk

    ball = sk.LagrangianLinearTIDS([1.0], [0.0], np.eye(1))
    ball.setFExtPtr(np.array([-9.81]))
    floor = sk.Interaction(sk.NewtonImpactNSL(0.8), sk.LagrangianLinearTIR(np.eye(1)))
    system = sk.NonSmoothDynamicalSystem(0.0, 5.0)
    system.insertDynamicalSystem(ball)
    system.link(floor, ball)
    clock = sk.TimeDiscretisation(0.0, step)
    stepping = sk.TimeStepping(system, clock, sk.MoreauJeanOSI(0.5), sk.LCP())
    pushed, began, n = [], time.process_time(), 0
    while stepping.hasNextEvent():
        stepping.computeOneStep()
        if floor.lambda_(1)[0] > 0.0:
            pushed.append(n)
        stepping.nextStep()
        n += 1
    firsts = [k for i, k in enumerate(pushed) if i == 0 or k > pushed[i - 1] + 1]
    return [(k + 1) * step for k in firsts], time.process_time() - began, n


def forces(rod: dict) -> dict:
    """How many answers Lemke's method gives, 1 or 0, and its own code."""
    import numpy as np
    from siconos import numerics as sn

    told = {}
    for name, (matrix, free) in rod.items():
        problem = sn.LCP(np.array([[matrix]]), np.array([free]))
        force, gap = np.zeros(1), np.zeros(1)
        code = sn.lcp_lexicolemke(problem, force, gap, sn.SolverOptions(sn.SICONOS_LCP_LEMKE))
        told[name] = 1 - int(code != 0), f"code {code}, force {force[0]:.3g}", bool(code)
    return told


def main() -> None:
    spec = sys.modules["__main__"].__spec__
    parser = argparse.ArgumentParser(
        f"python -m {spec.name}" if spec else None, description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--step", type=float, default=1e-5)
    parser.add_argument("--rod", type=json.loads, default={}, help="matrix and free rate by name")
    asked = parser.parse_args()
    times, seconds, work = bounces(asked.step)
    from importlib.metadata import version

    told = [
        {"case": "bouncing_ball", "name": name, "value": value, "work": work, "seconds": seconds,
         "says": f"{len(times)} bounces", "admits": False,
         "options": f"Moreau-Jean, step {asked.step:g}"}
        for name, value in (
            ("time of bounce 20", times[19]), ("time of the last bounce", times[-1])
        )
    ]  # fmt: skip
    told += [
        {"case": "painleve", "name": name, "value": count, "work": 1, "seconds": 0.0,
         "says": says, "admits": admits, "options": "lexicographic Lemke"}
        for name, (count, says, admits) in forces(asked.rod).items()
    ]  # fmt: skip
    print(json.dumps({"answers": told, "version": version("siconos")}))


if __name__ == "__main__":
    main()

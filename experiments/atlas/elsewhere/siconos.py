"""Siconos' time stepping on the bouncing ball and the slider–crank, its Lemke on Painlevé's rod.

    python -m experiments.atlas.elsewhere.siconos [--step 1e-5] [--rod JSON] [--crank JSON]

With a Python that has Siconos: Debian's python3-siconos and python3; Python's index has none.
A bounce is told at the end of the step whose impulse is not zero. The rod's matrix and free rate by
name are given by cases/painleve; Lemke's method tells one answer or, by its code, none. The numbers
of the slider–crank by name are given by its case, its functions are a plugin that `cc` compiles.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def simulate_bounces(step: float) -> tuple[list[float], float, int]:
    """Return the times of bounces, CPU seconds, and the number of steps."""
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
    pushes, seconds = compute_normal_impulses(stepping, [floor])
    firsts = find_contact_onsets([bool(push[0] > 0.0) for push in pushes])
    return [(k + 1) * step for k in firsts], seconds, len(pushes)


def compute_normal_impulses(stepping: Any, contacts: list) -> tuple[list[list[float]], float]:
    """Normal impulses of the contacts in each step, and CPU seconds."""
    result, began = [], time.process_time()
    while stepping.hasNextEvent():
        stepping.computeOneStep()
        result.append([float(contact.lambda_(1)[0]) for contact in contacts])
        stepping.nextStep()
    return result, time.process_time() - began


def find_contact_onsets(pushes: list[bool]) -> list[int]:
    """Return the steps with a contact force that follow a step without one."""
    return [k for k, push in enumerate(pushes) if push and not (k and pushes[k - 1])]


CORNERS = ("upper_behind", "upper_ahead", "lower_behind", "lower_ahead")
PLUGIN = Path(__file__).with_name("slider_crank.c")


def crank(numbers: dict[str, float], step: float) -> tuple[dict[str, float], float, int]:
    """Simulate the slider–crank until both lower corners hit; return CPU seconds and steps too."""
    import numpy as np
    from siconos import kernel as sk

    with tempfile.TemporaryDirectory() as folder:
        plugin = f"{folder}/slider_crank"
        macros = [f"-D{name}={value!r}" for name, value in numbers.items()]
        compiler = ["cc", "-O2", "-shared", "-fPIC", "-o", f"{plugin}.so", str(PLUGIN), *macros]
        subprocess.run([*compiler, "-lm"], check=True)
        rates = np.array([numbers["BEGINS"], numbers["ROD_BEGINS"], 0.0])
        mechanism = sk.LagrangianDS(np.zeros(3), rates, f"{plugin}:mass")
        mechanism.setComputeFGyrFunction(plugin, "turning")
        system = sk.NonSmoothDynamicalSystem(0.0, 0.027)
        system.insertDynamicalSystem(mechanism)
        law = sk.NewtonImpactFrictionNSL(numbers["RESTITUTION"], 0.0, numbers["FRICTION"], 2)
        contacts = []
        for corner in CORNERS:
            names = f"{plugin}:{corner}_gap", f"{plugin}:{corner}_rates"
            contacts.append(sk.Interaction(law, sk.LagrangianScleronomousR(*names)))
            system.link(contacts[-1], mechanism)
        clock, contact_law = sk.TimeDiscretisation(0.0, step), sk.FrictionContact(2)
        contact_law.numericsSolverOptions().dparam[0] = 1e-12
        stepping = sk.TimeStepping(system, clock, sk.MoreauJeanOSI(0.5), contact_law)
        stepping.setNewtonTolerance(1e-10)
        pushes, seconds = compute_normal_impulses(stepping, contacts)
    above = find_contact_onsets([max(push[:2]) > 0.0 for push in pushes])
    last = max(k for k, push in enumerate(pushes) if max(push[:2]) > 0.0)
    below = find_contact_onsets([max(push[2:]) > 0.0 for push in pushes])
    steps = {
        "first impact": above[0], "second impact": above[1], "end of the bounces": above[-1],
        "letting go": last, "touch of the other face": below[0],
    }  # fmt: skip
    result_by_name = {name: (k + 1) * step for name, k in steps.items()}
    result_by_name |= dict(zip(("impulse behind", "impulse ahead"), pushes[above[0]], strict=False))
    return result_by_name, seconds, len(pushes)


def forces(rod: dict) -> dict:
    """Return the number of solutions that Lemke's method finds, its status code, and CPU
    seconds.
    """
    import numpy as np
    from siconos import numerics as sn

    result_by_name = {}
    for name, (matrix, free) in rod.items():
        problem = sn.LCP(np.array([[matrix]]), np.array([free]))
        force, gap, began = np.zeros(1), np.zeros(1), time.process_time()
        code = sn.lcp_lexicolemke(problem, force, gap, sn.SolverOptions(sn.SICONOS_LCP_LEMKE))
        seconds = time.process_time() - began
        result_by_name[name] = (
            1 - int(code != 0),
            f"code {code}, force {force[0]:.3g}",
            bool(code),
            seconds,
        )
    return result_by_name


def main() -> None:
    spec = sys.modules["__main__"].__spec__
    parser = argparse.ArgumentParser(
        f"python -m {spec.name}" if spec else None, description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--step", type=float, default=1e-5)
    parser.add_argument("--rod", type=json.loads, help="matrix and free rate by name")
    parser.add_argument("--crank", type=json.loads, help="numbers by name")
    arguments = parser.parse_args()
    step_by_name = {"admits": False, "options": f"Moreau-Jean, step {arguments.step:g}"}
    if arguments.rod:
        rows = [
            {"case": "painleve", "name": name, "value": count, "work": 1, "seconds": seconds,
             "says": says, "admits": admits, "options": "lexicographic Lemke"}
            for name, (count, says, admits, seconds) in forces(arguments.rod).items()
        ]  # fmt: skip
    elif arguments.crank:
        solution, seconds, work = crank(arguments.crank, arguments.step)
        rows = [
            {"case": "slider_crank", "name": name, "value": value, "work": work, "says": "",
             "seconds": seconds, "admits": False,
             "options": f"{step_by_name['options']}, contacts to 1e-12, Newton to 1e-10"}
            for name, value in solution.items()
        ]  # fmt: skip
    else:
        times, seconds, work = simulate_bounces(arguments.step)
        rows = [
            {"case": "bouncing_ball", "name": name, "value": value, "work": work,
             "seconds": seconds, "says": f"{len(times)} bounces"} | step_by_name
            for name, value in (
                ("time of bounce 20", times[19]), ("time of the last bounce", times[-1])
            )
        ]  # fmt: skip
    from importlib.metadata import version

    print(json.dumps({"answers": rows, "version": version("siconos")}))


if __name__ == "__main__":
    main()

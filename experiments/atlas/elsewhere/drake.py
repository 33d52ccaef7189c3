"""Drake's own rimless wheel and compass gait, walked by Drake's own simulator.

    python -m experiments.atlas.elsewhere.drake [--accuracy 1e-10]

In an environment with `pip install drake`. The wheel has Drake's defaults, the compass gait the
gravity and the slope that belong to Goswami's numbers. A step's end is where the simulator
isolates its witness.
"""

import argparse
import itertools
import json
import math
import sys
import time
from importlib.metadata import version
from typing import Any

STEPS = 40


def ends_of_steps(plant: Any, state: list[float], accuracy: float, **changed: float) -> list:
    """Time and state where each step ends, before its impact; with CPU seconds and records."""
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import EventStatus

    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    for name, value in changed.items():
        getattr(context.get_mutable_numeric_parameter(0), f"set_{name}")(value)
    for i in range(plant.num_input_ports()):
        plant.get_input_port(i).FixValue(context, [0.0])
    context.get_mutable_continuous_state_vector().SetFromVector(state)
    context.SetAccuracy(accuracy)  # of where a witness is isolated
    simulator.get_mutable_integrator().set_target_accuracy(accuracy)
    contacts: list = []

    def record_event(context: Any) -> Any:
        toe = context.get_discrete_state(0).GetAtIndex(0)
        numbers = context.get_continuous_state_vector().CopyToVector()
        contacts.append((toe, context.get_time(), [float(x) for x in numbers]))
        return EventStatus.DidNothing()

    simulator.set_monitor(record_event)
    simulator.Initialize()
    began = time.process_time()
    simulator.AdvanceTo(0.9 * STEPS)
    seconds = time.process_time() - began
    ends = [a[1:] for a, b in itertools.pairwise(contacts) if a[0] != b[0]]
    return [ends, len(contacts), seconds]


def compute_drake_values(accuracy: float) -> list[dict]:
    from pydrake.examples import CompassGait, RimlessWheel, RimlessWheelParams

    wheel = RimlessWheelParams()
    alpha = math.pi / wheel.number_of_spokes()
    retained_share, low = math.cos(2.0 * alpha), wheel.slope() - alpha
    ends, work, seconds = ends_of_steps(RimlessWheel(), [low + 1e-9, 1.7], accuracy)
    squares = [(retained_share * rate) ** 2 for _, (_, rate) in ends]
    far = [square - squares[-1] for square in squares]
    result_by_name = {
        "rate after impact": retained_share * ends[-1][1][1],
        "period": ends[-1][0] - ends[-2][0],
        "multiplier": far[3] / far[2],
    }
    slope = math.radians(3.0)
    start = [-0.2187, 2.0 * slope + 0.2187, 1.0918, 0.3772]
    ends, extra_values, longer = ends_of_steps(
        CompassGait(), start, accuracy, gravity=9.8, slope=slope
    )
    other = {"stance angle": -ends[-1][1][1], "period": ends[-1][0] - ends[-2][0]}
    return [
        {"case": case, "name": name, "value": value, "work": n, "seconds": t}
        for case, solution, n, t in (
            ("rimless_wheel", result_by_name, work, seconds), ("compass_gait", other,
                extra_values, longer)
        )
        for name, value in solution.items()
    ]  # fmt: skip


def main() -> None:
    spec = sys.modules["__main__"].__spec__
    parser = argparse.ArgumentParser(
        f"python -m {spec.name}" if spec else None, description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--accuracy", type=float, default=1e-10)
    accuracy = parser.parse_args().time_tolerance
    result_by_name = {"options": f"its default integrator, accuracy {accuracy:g}"}
    print(
        json.dumps(
            result_by_name
            | {"answers": compute_drake_values(accuracy), "version": version("drake")}
        )
    )


if __name__ == "__main__":
    main()

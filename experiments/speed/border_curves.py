"""Points of border curves that a core follows, reads and searches for meetings in a second.

    python -m experiments.speed.border_curves [--repeats 10]

The curves with which the map over damping and stiffness begins (configs/map_c_k.toml), compiled
before: CPU time of one core, the best of some repetitions, without the branches that meet them and
with.
"""

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import command, started
from experiments.shared.timing import on_one_core, seconds
from vrw_jax.branches.mapping import across
from vrw_jax.branches.tracing import OF_CURVES, Tracer

BOX = {"damping": (4.0, 240.0), "stiffness": (350.0, 700.0)}


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--repeats", type=int, default=10)
    repeats = started(parser).repeats
    first, second = BOX
    box, model = np.array(list(BOX.values())), vrw.ViscoelasticWheel()
    tracer = Tracer((first, second), box, model, OF_CURVES, vrw.Options.tight())
    begin = lambda: across(tracer, vrw.WheelParams())
    seeds = begin()
    curves = [one.curve for one in tracer.followed(seeds, ())]
    n = sum(len(curve.values) for curve in curves)
    print(f"{len(curves)} curves, {n} points, {sum(len(c.meetings) for c in curves)} meetings")
    with on_one_core():
        alone = seconds(lambda: tracer.followed(seeds, ()), repeats, told=min)
        both = alone + seconds(begin, repeats, told=min)
    print(f"{alone:.2f} s, {n / alone:.0f} points a second; with the branches {n / both:.0f}")


if __name__ == "__main__":
    main()

"""Measure the number of points on curves of special points per second and core.

    python -m experiments.speed.curve_benchmark [--repeats 10]

The curves are the first ones of the map over damping and stiffness (configs/map_c_k.toml). The
programs are compiled before. The figure is the least CPU time of some repeats on one core, with and
without the branches that meet the curves.
"""

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.timing import measure_cpu_seconds, use_one_core
from vrw_jax.branches.curve_tracing import CurveTracer
from vrw_jax.branches.special_point_curves import (
    DEFAULT_CURVE_OPTIONS,
    find_seeds_on_parallel_lines,
)

BOX = {"damping": (4.0, 240.0), "stiffness": (350.0, 700.0)}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=10)
    repeats = parse_and_start_jax(parser).repeats
    first, second = BOX
    box, model = np.array(list(BOX.values())), vrw.ViscoelasticWheel()
    tracer = CurveTracer(
        (first, second), box, model, DEFAULT_CURVE_OPTIONS, vrw.StepOptions.tight()
    )
    begin = lambda: find_seeds_on_parallel_lines(tracer, vrw.WheelParams())
    seeds = begin()
    curves = [traced.special_point_curve for traced in tracer.trace_curves(seeds, ())]
    n = sum(len(curve.values) for curve in curves)
    print(f"{len(curves)} curves, {n} points, {sum(len(c.codim2_points) for c in curves)} meetings")
    with use_one_core():
        duration_seconds = measure_cpu_seconds(
            lambda: tracer.trace_curves(seeds, ()), repeats, reduction=min
        )
        total_seconds = duration_seconds + measure_cpu_seconds(begin, repeats, reduction=min)
    print(
        f"{duration_seconds:.2f} s, {n / duration_seconds:.0f} points a second; with the "
        f"branches {n / total_seconds:.0f}"
    )


if __name__ == "__main__":
    main()

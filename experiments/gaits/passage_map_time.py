"""Time a small map of mean numbers of steps, and extrapolate the time of a large map.

    python -m experiments.gaits.passage_map_time

The map has 4 x 4 wheels over damping and slope, with the ranges of `configs/robustness.toml`. The
command writes the processor time per wheel, and the extrapolated time of 32 x 32 wheels, to
`docs/benchmarks/first_passage.md`. One minute on one core.
"""

import time
import tomllib

import numpy as np

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import make_parser, parse_and_start_jax

PAGE = tables.DOCS / "benchmarks" / "first_passage.md"
CONFIG = tables.DOCS.parent / "configs" / "robustness.toml"
N_VALUES = 4
"""Number of values of each parameter in the timed map."""
N_LARGE_MAP_WHEELS = 32 * 32
N_CORES = 2
"""Number of cores for which the time of the large map is extrapolated."""


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    config = tomllib.loads(CONFIG.read_text())
    axes = {
        name: np.linspace(axis["from"], axis["to"], N_VALUES)
        for name, axis in config["grid"].items()
    }
    slope_sd = config["scan"]["slope_sd"]
    measures = ["mean_steps", "mean_steps_error"]
    vrw.scan(vrw.grid(damping=[150.0, 200.0]), measures, slope_sd=slope_sd)  # compiles
    start = time.process_time()
    data = vrw.scan(vrw.grid(**axes), measures, slope_sd=slope_sd)
    seconds = time.process_time() - start
    mean_steps = data.mean_steps.values[np.isfinite(data.mean_steps.values)]
    seconds_per_wheel = seconds / len(mean_steps)
    large_map_minutes = N_LARGE_MAP_WHEELS * seconds_per_wheel / N_CORES / 60.0
    table = tables.format_markdown(
        ["", "value"],
        [
            (f"wheels with a mean, of {N_VALUES**2} in the map", len(mean_steps)),
            ("processor time per wheel, s", f"{seconds_per_wheel:.2f}"),
            (
                f"extrapolated: {N_LARGE_MAP_WHEELS:,} wheels on two busy cores, minutes",
                f"{large_map_minutes:.1f}",
            ),
        ],
    )
    source = tables.describe_run("experiments.gaits.passage_map_time")
    tables.replace_block(PAGE, "time of a map", table, source)
    print(table)


if __name__ == "__main__":
    main()

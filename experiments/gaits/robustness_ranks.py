"""Compare the order of wheels by robustness indices with their order by mean numbers of steps.

    python -m experiments.gaits.robustness_ranks

Random wheels have damping 120 to 215 N s/m and slope 0.28 to 0.32 rad, and Table 1's values
otherwise. For each wheel with a gait, the mean number of steps on random slopes, the gait
sensitivity norms, the spectral radius and the smallest disturbance are computed. The command writes
`robustness_wheels.csv` to `docs/figures/` and the rank correlations to `docs/howto/robustness.md`.
Two minutes on one core.
"""

import numpy as np
from scipy import stats

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import make_parser, parse_and_start_jax
from vrw_jax.studies.first_passage import PassageStatus

PAGE = tables.DOCS / "howto" / "robustness.md"
N_WHEELS = 32
SLOPE_SD = 0.01
"""Standard deviation of the slopes, rad."""
PARAMETER_RANGES = {"damping": (120.0, 215.0), "slope": (0.28, 0.32)}
INDEX_NAMES = {
    "gait_sensitivity_period": "gait sensitivity norm of the period",
    "gait_sensitivity_speed": "gait sensitivity norm of the speed",
    "spectral_radius": "spectral radius of the gait",
    "smallest_disturbance": "smallest disturbance",
    "damping": "damping",
    "slope": "slope",
}
"""Labels in the table, by columns of the csv file."""


def measure_wheel(params: vrw.WheelParams) -> dict[str, float]:
    """Return the mean number of steps of one wheel, its error, and the indices of its gait."""
    passage = vrw.first_passage(params, SLOPE_SD)
    sensitivity = vrw.gait_sensitivity(params, ["period", "speed"])
    return {
        "mean_steps": float(passage.mean_steps),
        "error": float(passage.error),
        "converged": int(passage.status == PassageStatus.CONVERGED),
        "gait_sensitivity_period": float(sensitivity.norm[0]),
        "gait_sensitivity_speed": float(sensitivity.norm[1]),
        "spectral_radius": float(sensitivity.spectral_radius),
        "smallest_disturbance": float(vrw.smallest_disturbance(params).size),
    }


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    random = np.random.default_rng(0)
    rows: list[dict[str, float]] = []
    for _ in range(N_WHEELS):
        values = {name: random.uniform(*ends) for name, ends in PARAMETER_RANGES.items()}
        params = vrw.WheelParams(**values)
        if vrw.limit_cycle(params).found:
            rows.append(values | measure_wheel(params))
            print(rows[-1], flush=True)
    tables.write_named_rows(tables.FIGURES / "robustness_wheels.csv", rows)
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    correlations = [
        (label, f"{stats.spearmanr(columns[name], columns['mean_steps']).statistic:+.2f}")
        for name, label in INDEX_NAMES.items()
    ]
    table = tables.format_markdown(["index", "rank correlation with `mean_steps`"], correlations)
    source = tables.describe_run("experiments.gaits.robustness_ranks")
    tables.replace_block(PAGE, "ranks of wheels", table, source)


if __name__ == "__main__":
    main()

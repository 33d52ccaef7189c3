"""Compare the paper's wheel with wheels with unilateral contact on the same random slopes.

    python -m experiments.gaits.contact_on_same_slopes

The wheel of Table 1 walks over `N_STEPS` lines of random slopes in the paper's model, and with
unilateral contact at three friction coefficients. Each walk begins at the gait of its model. The
command writes `contact_on_same_slopes.csv` to `docs/figures/`, and a table to
`docs/howto/robustness.md`. Two minutes on one core.
"""

from typing import Any

import equinox as eqx
import numpy as np

import vrw_jax as vrw
from experiments.shared import tables
from experiments.shared.command import make_parser, parse_and_start_jax

PAGE = tables.DOCS / "howto" / "robustness.md"
DATA = tables.FIGURES / "contact_on_same_slopes.csv"
SLOPE_SDS = (0.01, 0.015, 0.02)
"""Standard deviations of the slopes, rad."""
N_WALKS, N_STEPS = 256, 50
FRICTION_BY_LABEL = {
    "paper's model": None,
    "infinite friction": np.inf,
    "friction 1.3": 1.3,
    "friction 0.8": 0.8,
}
"""Friction coefficients by their labels in the table; None is the paper's model."""


def count_steps(params: vrw.WheelParams, line_slopes: np.ndarray, model: Any) -> np.ndarray:
    """Return the number of steps of each walk, at most `N_STEPS`, and print how walks end.

    - `line_slopes`: slopes of the lines, rad, shape (walks, `N_STEPS` + 1).
    """
    gait: Any = vrw.limit_cycle(params, model=model)
    walks = vrw.step_batch(
        eqx.tree_at(lambda wheel: wheel.slope, params, line_slopes),
        np.tile(np.asarray(gait.section_state), (len(line_slopes), 1)),
        line_slopes.shape[1] - 1,
        model=model,
    )
    for outcome_code, n_walks in zip(*np.unique(walks.outcome, return_counts=True), strict=True):
        print(n_walks, "walks end with", vrw.Outcome(int(outcome_code)).name, flush=True)
    return np.asarray(walks.n_stepped)


def main() -> None:
    parse_and_start_jax(make_parser(__doc__))
    params, random = vrw.WheelParams(), np.random.default_rng(0)
    rows: list[dict[str, object]] = []
    for slope_sd in SLOPE_SDS:
        line_slopes = float(params.slope) + slope_sd * random.standard_normal(
            (N_WALKS, N_STEPS + 1)
        )
        line_slopes[:, 0] = float(params.slope)
        for label, friction in FRICTION_BY_LABEL.items():
            model = None if friction is None else vrw.UnilateralWheel(friction=friction)
            print(f"slope_sd {slope_sd:g} rad, {label}:")
            n_steps = count_steps(params, line_slopes, model)
            rows.append(
                {
                    "slope_sd": slope_sd,
                    "model": label,
                    "n_walks": N_WALKS,
                    "n_complete_walks": int(np.sum(n_steps == N_STEPS)),
                    "mean_of_steps": float(np.mean(n_steps)),
                }
            )
            tables.write_named_rows(DATA, rows)
    group_by_slope_sd = tables.group_rows(tables.read_table(DATA), "slope_sd")
    lines = [
        [slope_sd, *(f"{100 * int(row['n_complete_walks']) / N_WALKS:.0f} %" for row in group)]
        for slope_sd, group in group_by_slope_sd.items()
    ]
    header = ["standard deviation, rad", *FRICTION_BY_LABEL]
    source = tables.describe_run("experiments.gaits.contact_on_same_slopes")
    tables.replace_block(PAGE, "same slopes", tables.format_markdown(header, lines), source)


if __name__ == "__main__":
    main()

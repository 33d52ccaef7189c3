"""Reproduction of the paper: its figures, and a table of published facts with computed values.

All gaits are limits of walks from one start, without Newton's method for a fixed point.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array

from vrw_jax import plot as plots
from vrw_jax.app.paper_claims import compute_paper_facts, write_facts_files
from vrw_jax.app.paper_evidence import (
    PaperEvidence,
    PaperFact,
    make_formally_continued_model,
    measure_gaits_along_parameter,
    replace_wheel_parameter,
    walk_along_parameter,
    walk_into_gait,
)
from vrw_jax.base.checks import check_path
from vrw_jax.models.stepping import paper_start
from vrw_jax.models.trajectory import simulate
from vrw_jax.wheel.params import WheelParams

ReproductionProgressCallback = Callable[[float, str], None]
"""Function that is called with the completed fraction, 0 to 1, and the name of the current task."""

FIGURE_8_AND_9_DAMPINGS = (50.0, 100.0, 200.0)
"""Damping in Figs 8 and 9 of the paper, N s/m."""


def ignore_progress(completed_fraction: float, task_name: str) -> None:
    """Ignore a report of progress."""


def walk_into_table_1_gait() -> xr.Dataset:
    """Simulate the walk from the paper's start into the gait of Table 1 of the paper."""
    return walk_into_gait(WheelParams(), paper_start())


def find_table_1_section_state() -> Array:
    """Return the section state of the gait of Table 1 of the paper."""
    return jnp.asarray(walk_into_table_1_gait().section_state.values[-1])


def simulate_table_1_gait(n_steps: int = 3) -> xr.Dataset:
    """Return the trajectory of the gait of Table 1 of the paper, for Figs 6 and 7.

    The slope is 0.30 rad.
    """
    return simulate(
        WheelParams(), find_table_1_section_state(), n_steps, model=make_formally_continued_model()
    )


def simulate_gaits_at_dampings(dampings: Sequence[float]) -> list[xr.Dataset]:
    """Return the trajectory of one step of the gait for each value of `dampings`, for Figs 8 and 9.

    The values may be 1 to 219 N s/m. From walk to walk, the damping changes by at most 10 N s/m,
    beginning at that of Table 1 of the paper.
    """
    start_state = find_table_1_section_state()
    table_1_wheel, gait_trajectories = WheelParams(), []
    for damping in dampings:
        start_damping = float(table_1_wheel.damping)
        n_dampings = 1 + math.ceil(abs(damping - start_damping) / 10.0)
        dampings_on_path = np.linspace(start_damping, damping, n_dampings).tolist()
        *_, gait_walk = walk_along_parameter(
            table_1_wheel, "damping", dampings_on_path, start_state
        )
        if not gait_walk.settled:
            raise ValueError(f"No period-1 gait was met at damping {damping:g}: choose 1 to 219.")
        section_state = jnp.asarray(gait_walk.section_state.values[-1])
        gait_trajectories.append(
            simulate(
                replace_wheel_parameter(table_1_wheel, "damping", damping),
                section_state,
                1,
                model=make_formally_continued_model(),
            )
        )
    return gait_trajectories


def collect_paper_evidence(
    on_progress: ReproductionProgressCallback = ignore_progress,
) -> PaperEvidence:
    """Simulate all walks that the facts and figures use."""
    table_1_wheel = WheelParams()
    on_progress(0.0, "walk from the start for Table 1")
    settling_walk = walk_into_table_1_gait()
    fast_start_walk = walk_into_gait(table_1_wheel, jnp.asarray((0.1, 2.0, -0.1)))

    task_name = "gaits along c from 1 to 224"
    on_progress(0.1, task_name)
    report = lambda fraction: on_progress(0.1 + 0.5 * fraction, task_name)
    start = table_1_wheel, "damping"
    table_1_state = find_table_1_section_state()
    damping_branch = xr.concat(
        [
            measure_gaits_along_parameter(*start, range(200, 0, -1), table_1_state, report),
            measure_gaits_along_parameter(*start, range(201, 225), table_1_state),
        ],
        "damping",
        data_vars="minimal",
        combine_attrs="override",
    )

    on_progress(0.65, "gaits at slope 0.10")
    start_state = jnp.asarray(damping_branch.section_state.sel(damping=100.0).values)
    slope_values = [0.01 * i for i in range(30, 9, -1)]
    medium_damping_wheel = replace_wheel_parameter(table_1_wheel, "damping", 100.0)
    gentle_slope_wheel = replace_wheel_parameter(table_1_wheel, "slope", 0.10)
    slope_branch = measure_gaits_along_parameter(
        medium_damping_wheel, "slope", slope_values, start_state
    )
    start_state = jnp.asarray(slope_branch.section_state.sel(slope=0.10, method="nearest").values)
    gentle_slope_branch = measure_gaits_along_parameter(
        gentle_slope_wheel, "damping", range(100, 221, 10), start_state
    )
    low_dampings = [*range(100, 0, -10), 5, 4]
    gentle_slope_low_damping_branch = measure_gaits_along_parameter(
        gentle_slope_wheel, "damping", low_dampings, start_state
    )

    on_progress(0.7, "trajectories")
    return PaperEvidence(
        params=table_1_wheel,
        settling_walk=settling_walk,
        table_1_trajectory=simulate_table_1_gait(),
        gaits_by_damping=simulate_gaits_at_dampings(FIGURE_8_AND_9_DAMPINGS),
        damping_branch=damping_branch,
        slope_branch=slope_branch,
        gentle_slope_branch=gentle_slope_branch,
        gentle_slope_low_damping_branch=gentle_slope_low_damping_branch,
        fast_start_walk=fast_start_walk,
    )


def write_paper_figures(paper_evidence: PaperEvidence, folder: Path) -> None:
    """Write Figs 6 to 10 as SVG and PNG files, and the walk as a GIF file."""
    two_step_trajectory = paper_evidence.table_1_trajectory.isel(
        time=paper_evidence.table_1_trajectory.step.values < 2
    )
    figure_by_name = {
        "fig06_gait": plots.gait_panels(paper_evidence.table_1_trajectory),
        "fig07_sticks": plots.sticks(two_step_trajectory),
        "fig08_scuffing": plots.foot_height(paper_evidence.gaits_by_damping),
        "fig09_rear_force": plots.rear_force(paper_evidence.gaits_by_damping),
        "fig10_indicators": plots.indicators(paper_evidence.damping_branch),
    }
    for figure_name, figure in figure_by_name.items():
        plots.save(figure, folder, figure_name)
    frame_images, frame_duration_ms = plots.walk_frames(paper_evidence.gaits_by_damping[-1])
    plots.save_animation(frame_images, frame_duration_ms, folder / "walk.gif")


def reproduce_paper(
    folder: str | Path, on_progress: ReproductionProgressCallback = ignore_progress
) -> list[PaperFact]:
    """Write all figures and the table of facts into `folder`, and return the facts.

    The table is in `facts.md` and `facts.csv`. The values that Fig. 10 shows are in
    `indicators.csv`.

    - `on_progress`: function that is called with the completed fraction and the name of the current
      task.
    """
    folder = check_path("folder", folder, 'give a folder, such as "results/reproduction"')
    paper_evidence = collect_paper_evidence(on_progress)
    on_progress(0.8, "figures")
    write_paper_figures(paper_evidence, folder)
    on_progress(0.98, "table of facts")
    paper_facts = compute_paper_facts(paper_evidence)
    write_facts_files(paper_facts, folder)
    indicator_table = paper_evidence.damping_branch.drop_dims(["leg", "component"]).to_dataframe()
    indicator_table.to_csv(folder / "indicators.csv", float_format="%.10g")
    on_progress(1.0, "done")
    return paper_facts

"""Reproduction of the paper: its figures, and the table of its facts, published and computed.

All gaits are limits of walks from one start; no equation is solved for a fixed point.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr

from vrw_jax import figures as plots
from vrw_jax.paper import facts
from vrw_jax.paper.facts.base import Evidence, Fact
from vrw_jax.paper.gaits import along, approach, changed, paper_wheel, states_along
from vrw_jax.walks import paper_start, simulate
from vrw_jax.wheel import WheelParams

Progress = Callable[[float, str], None]
"""Function that is called with the completed share, 0 to 1, and the present task."""

DAMPINGS = (50.0, 100.0, 200.0)
"""Damping values of figures 8 and 9, in N s/m."""


def silent(share: float, what: str) -> None:
    """Ignore the progress."""


def settle_at_table_1() -> xr.Dataset:
    """Return the walk from the start for Table 1 into its gait."""
    return approach(WheelParams(), paper_start())


def gait_at_table_1(n_steps: int = 3) -> xr.Dataset:
    """Return the trajectory of the gait of Table 1 at slope 0.30, for figures 6 and 7."""
    state = jnp.asarray(settle_at_table_1().section_state.values[-1])
    return simulate(WheelParams(), state, n_steps, model=paper_wheel())


def gaits_at(dampings: Sequence[float]) -> list[xr.Dataset]:
    """Return one step of the gait at each of `dampings`, 1 to 219 N s/m, for figures 8 and 9.

    Walks lead there from Table 1 with changes of at most 10 N s/m.
    """
    start = jnp.asarray(settle_at_table_1().section_state.values[-1])
    table_1, gaits = WheelParams(), []
    for damping in dampings:
        begin = float(table_1.damping)
        n = 1 + math.ceil(abs(damping - begin) / 10.0)
        path = np.linspace(begin, damping, n).tolist()
        *_, walked = states_along(table_1, "damping", path, start)
        if not walked.settled:
            raise ValueError(f"No period-1 gait was met at damping {damping:g}: choose 1 to 219.")
        state = jnp.asarray(walked.section_state.values[-1])
        gaits.append(simulate(changed(table_1, "damping", damping), state, 1, model=paper_wheel()))
    return gaits


def gaits_along_damping(progress: Callable[[float], None] | None = None) -> xr.Dataset:
    """Return the gaits at every integer c from 1 to 219, and the walks up to 224, for figure 10."""
    params = WheelParams()
    start = jnp.asarray(settle_at_table_1().section_state.values[-1])
    down = along(params, "damping", range(200, 0, -1), start, progress)
    up = along(params, "damping", range(201, 225), start)
    return xr.concat([down, up], "damping", data_vars="minimal", combine_attrs="override")


def collect(progress: Progress = silent) -> Evidence:
    """Compute all walks that the facts and figures use, and return them."""
    table_1 = WheelParams()
    progress(0.0, "walk from the start for Table 1")
    settling = settle_at_table_1()
    too_fast = approach(table_1, jnp.asarray((0.1, 2.0, -0.1)))

    what = "gaits along c from 1 to 224"
    progress(0.1, what)
    branch = gaits_along_damping(lambda share: progress(0.1 + 0.5 * share, what))

    progress(0.65, "gaits at slope 0.10")
    start = jnp.asarray(branch.section_state.sel(damping=100.0).values)
    slopes = [0.01 * i for i in range(30, 9, -1)]
    medium, flat = changed(table_1, "damping", 100.0), changed(table_1, "slope", 0.10)
    gentler = along(medium, "slope", slopes, start)
    start = jnp.asarray(gentler.section_state.sel(slope=0.10, method="nearest").values)
    gentle = along(flat, "damping", range(100, 221, 10), start)
    falling = [*range(100, 0, -10), 5, 4]
    gentle_low = along(flat, "damping", falling, start)

    progress(0.7, "trajectories")
    return Evidence(
        params=table_1,
        settling=settling,
        gait=gait_at_table_1(),
        by_damping=gaits_at(DAMPINGS),
        branch=branch,
        gentler=gentler,
        gentle=gentle,
        gentle_low=gentle_low,
        too_fast=too_fast,
    )


def draw(evidence: Evidence, folder: Path) -> list[Path]:
    """Write figures 6 to 10 as SVG and PNG, and the walk as a GIF, and return the paths."""
    two_steps = evidence.gait.isel(time=evidence.gait.step.values < 2)
    figures = {
        "fig06_gait": plots.gait_panels(evidence.gait),
        "fig07_sticks": plots.sticks(two_steps),
        "fig08_scuffing": plots.foot_height(evidence.by_damping),
        "fig09_rear_force": plots.rear_force(evidence.by_damping),
        "fig10_indicators": plots.indicators(evidence.branch),
    }
    paths = [path for name, figure in figures.items() for path in plots.save(figure, folder, name)]
    frames, milliseconds = plots.walk_frames(evidence.by_damping[-1])
    return [*paths, plots.save_animation(frames, milliseconds, folder / "walk.gif")]


def reproduce(folder: str | Path, progress: Progress = silent) -> list[Fact]:
    """Write all figures and the table of facts into `folder`, and return the facts.

    `facts.md` and `facts.csv` hold the table, and `indicators.csv` the numbers of Figure 10.
    """
    folder = Path(folder)
    evidence = collect(progress)
    progress(0.8, "figures")
    draw(evidence, folder)
    progress(0.98, "table of facts")
    table = facts.all_facts(evidence)
    facts.write(table, folder)
    flat = evidence.branch.drop_dims(["leg", "component"]).to_dataframe()
    flat.to_csv(folder / "indicators.csv", float_format="%.10g")
    progress(1.0, "done")
    return table

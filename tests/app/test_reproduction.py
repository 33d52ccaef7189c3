"""The published facts of the paper hold, each check can fail, and the figures are written."""

import csv
import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr
from PIL import Image
from typer.testing import CliRunner

from vrw_jax import Outcome
from vrw_jax import plot as plots
from vrw_jax.app import commands as cli
from vrw_jax.app import paper_reproduction as reproduce
from vrw_jax.app.paper_evidence import PaperEvidence

FIGURE_NAMES = (
    "fig06_gait",
    "fig07_sticks",
    "fig08_scuffing",
    "fig09_rear_force",
    "fig10_indicators",
)


@pytest.fixture(scope="session")
def evidence() -> PaperEvidence:
    return reproduce.collect_paper_evidence()


@pytest.fixture(scope="session")
def reproduction_result(
    evidence: PaperEvidence, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, bool, list[float]]:
    folder, result = tmp_path_factory.mktemp("reproduced"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduce, "collect_paper_evidence", lambda on_progress: evidence)
        table = reproduce.reproduce_paper(folder, lambda share, what: result.append(share))
    return folder, all(fact.holds for fact in table), result


def test_every_published_fact_holds(evidence: PaperEvidence) -> None:
    failing = [
        f"{f.claim}: found {f.computed}"
        for f in reproduce.compute_paper_facts(evidence)
        if not f.holds
    ]
    assert not failing


def test_every_fact_has_a_source_and_a_reason_for_its_tolerance(evidence: PaperEvidence) -> None:
    for fact in reproduce.compute_paper_facts(evidence):
        assert fact.source
        assert fact.published_value
        assert fact.computed
        assert "{" not in fact.computed  # A value is missing.
        assert fact.tolerance_reason


def test_the_table_covers_every_figure_and_the_misprints(evidence: PaperEvidence) -> None:
    text = reproduce.format_facts_page(reproduce.compute_paper_facts(evidence))
    for word in ("Fig. 6", "Fig. 8", "Fig. 9", "Fig. 10(a)", "Fig. 10(b)", "J43", "eq. (35)",
                 "eqs (16), (17)", "φ = 0.10", "friction", "stopper"):  # fmt: skip
        assert word in text


def test_a_successful_reproduction_writes_every_file(
    reproduction_result: tuple[Path, bool, list[float]],
) -> None:
    folder, holds, result = reproduction_result
    assert holds
    assert result == sorted(result)
    assert result[-1] == 1.0
    expected = {f"{name}.{kind}" for name in FIGURE_NAMES for kind in ("svg", "png")}
    expected |= {"walk.gif", "facts.md", "facts.csv", "indicators.csv"}
    assert {path.name for path in folder.iterdir()} == expected


def test_a_failed_fact_is_printed_and_sets_the_exit_code(
    evidence: PaperEvidence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    branch = evidence.damping_branch.copy(deep=True)
    branch.lambda_4_plus.loc[{"damping": 219.0}] = -0.01
    broken = dataclasses.replace(evidence, damping_branch=branch)
    monkeypatch.setattr(reproduce, "collect_paper_evidence", lambda on_progress: broken)
    monkeypatch.setattr(reproduce, "write_paper_figures", lambda evidence, folder: [])
    monkeypatch.setattr("vrw_jax.app.commands.start_jax", lambda: None)
    result = CliRunner().invoke(cli.app, ["reproduce", "--out", str(tmp_path)])
    assert result.exit_code == cli.ExitCode.CHECK_FAILED
    table = reproduce.compute_paper_facts(broken)
    assert f"{sum(fact.holds for fact in table)} of {len(table)} facts hold" in result.output
    assert "26 with published numbers, 28 with independent code" in " ".join(result.output.split())
    assert "does not" in result.output
    text = (tmp_path / "facts.md").read_text(encoding="utf-8")
    assert "**does not hold**" in text
    assert "Not: λ4⁺ is not positive at c = 220" in text
    with (tmp_path / "facts.csv").open(encoding="utf-8", newline="") as file:
        verdicts = {row["claim"]: row["holds"] for row in csv.DictReader(file)}
    assert verdicts["λ4⁺ is not positive at c = 220"] == "does not hold"
    assert verdicts["λ2⁺ is not positive at c = 4"] == "holds"


def _scale_results(results: xr.Dataset, factor: float) -> xr.Dataset:
    """Return the results with all numbers but the coordinates multiplied by a factor."""
    return results.map(
        lambda v: v * factor if v.dtype.kind == "f" else v, keep_attrs=True
    ).assign_attrs(results.attrs)


def _scale_states(branch: xr.Dataset, factors: tuple[float, float, float]) -> xr.Dataset:
    return branch.assign(section_state=branch.section_state * np.array(factors))


def _corrupt_gait(e: PaperEvidence) -> PaperEvidence:
    return dataclasses.replace(
        e,
        table_1_trajectory=_scale_results(e.table_1_trajectory, -1.3).assign_coords(
            time=1.1 * e.table_1_trajectory.time
        ),
        gaits_by_damping=[_scale_results(g, -1.0) for g in e.gaits_by_damping],
    )


def _corrupt_branch(e: PaperEvidence) -> PaperEvidence:
    flipped = _scale_results(e.damping_branch, -1.1)
    return dataclasses.replace(e, damping_branch=flipped.assign(settled=~flipped.settled))


def _corrupt_walks(e: PaperEvidence) -> PaperEvidence:
    step_by_name = {"outcome": Outcome.STEPPED.name}
    return dataclasses.replace(
        e,
        settling_walk=e.settling_walk.assign_attrs(settled=0),
        fast_start_walk=e.fast_start_walk.assign_attrs(step_by_name),
        slope_branch=_scale_results(e.slope_branch, 1.1),
        gentle_slope_branch=e.gentle_slope_branch.assign(
            settled=xr.ones_like(e.gentle_slope_branch.settled)
        ),
        gentle_slope_low_damping_branch=_scale_results(e.gentle_slope_low_damping_branch, -1.0),
    )


def _corrupt_states(e: PaperEvidence) -> PaperEvidence:
    return dataclasses.replace(e, damping_branch=_scale_states(e.damping_branch, (1.0, -1.0, 0.0)))


def _sink_foot(e: PaperEvidence) -> PaperEvidence:
    sinking = e.table_1_trajectory.assign(
        foot_2_z=-e.table_1_trajectory.foot_2_z,
        total_energy=-e.table_1_trajectory.total_energy,
        lambda_2=e.table_1_trajectory.lambda_2 + 50.0 * np.sin(60.0 * e.table_1_trajectory.time),
        lambda_3=-e.table_1_trajectory.lambda_3 * (e.table_1_trajectory.lambda_4 > 1.0),
        lambda_4=100.0 * e.table_1_trajectory.lambda_4,
        L1=e.table_1_trajectory.L1 + 0.05,
        L2=e.table_1_trajectory.L2 + 0.05,
        phase=2 - e.table_1_trajectory.phase,
    )
    return dataclasses.replace(e, table_1_trajectory=sinking)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that were spoiled on purpose
def test_every_fact_can_fail(evidence: PaperEvidence) -> None:
    spoils: tuple[Callable[[PaperEvidence], PaperEvidence], ...] = (
        _corrupt_gait,
        _corrupt_branch,
        _corrupt_walks,
        _corrupt_states,
        _sink_foot,
    )
    unmoved = {fact.claim for fact in reproduce.compute_paper_facts(evidence)}
    for spoil in spoils:
        unmoved &= {
            fact.claim for fact in reproduce.compute_paper_facts(spoil(evidence)) if fact.holds
        }
    assert not unmoved


def test_figures_are_valid_image_files(
    reproduction_result: tuple[Path, bool, list[float]],
) -> None:
    folder = reproduction_result[0]
    for name in FIGURE_NAMES:
        root = ElementTree.parse(folder / f"{name}.svg").getroot()
        assert root.tag.endswith("svg")
        with Image.open(folder / f"{name}.png") as picture:
            assert min(picture.size) > 300
    with Image.open(folder / "walk.gif") as walk:
        assert walk.n_frames > 20
        assert walk.info["loop"] == 0
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    assert sizes["walk.gif"] < 1_000_000
    assert sum(sizes.values()) < 2_000_000


def test_the_same_results_give_the_same_figure(evidence: PaperEvidence, tmp_path: Path) -> None:
    first, second = (
        plots.save(plots.indicators(evidence.damping_branch), tmp_path / name, "figure")[
            0
        ].read_bytes()
        for name in ("first", "second")
    )
    assert first == second


def test_drawing_leaves_matplotlib_as_it_was(evidence: PaperEvidence, tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    plots.save(plots.rear_force(evidence.gaits_by_damping), tmp_path, "figure")
    assert dict(mpl.rcParams) == before


def test_figure_10_shows_only_gaits_that_the_paper_shows(evidence: PaperEvidence) -> None:
    figure = plots.indicators(evidence.damping_branch, every=1)
    for axes in figure.axes:
        for line in axes.lines:
            values = np.asarray(line.get_xdata())
            assert values.size == 0 or (values.min() >= 5.0 and values.max() <= 219.0)

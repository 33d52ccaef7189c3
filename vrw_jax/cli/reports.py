"""Files that commands write into a folder: labelled data, tables, a summary, figures."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vrw_jax import figures
from vrw_jax.branches import Branch, UnexplainedChange, map_special_points
from vrw_jax.cli.config import Config
from vrw_jax.measures import MEASURES, describe_violation, get_measure
from vrw_jax.printing import format_markdown_table
from vrw_jax.scans import DIFFERENTIABLE_MEASURES, design
from vrw_jax.tuning import TuneResult
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES, Outcome


def write_scan(scan: xr.Dataset, folder: Path) -> list[Path]:
    """Write the figures of a scan into `folder`, and return the paths."""
    figures_by_name = figures.scan_figures(scan)
    return [
        path
        for name, figure in figures_by_name.items()
        for path in figures.save(figure, folder, name)
    ]


def write_tuning(result: TuneResult, folder: Path, draws_figure: bool = True) -> list[Path]:
    """Write everything about a tuned gait into `folder`, and return the paths."""
    texts = {"wheel.toml": _format_wheel_toml(result), "summary.md": format_tuning_summary(result)}
    paths = _write_files(folder, "path.zarr", result.path, texts)
    return paths + (
        figures.save(figures.tuning_figure(result), folder, "tuning") if draws_figure else []
    )


def write_branch(branch: Branch, folder: Path, draws_figure: bool = True) -> list[Path]:
    """Write everything about a branch into `folder`, and return the paths."""
    texts = {
        "borders.csv": _format_special_points_csv(branch),
        "summary.md": format_branch_summary(branch),
    }
    paths = _write_files(folder, "branch.zarr", branch.dataset, texts)
    figure_is_drawn = draws_figure and branch.values.size > 0
    return paths + (
        figures.save(figures.branch_figure(branch), folder, "branch") if figure_is_drawn else []
    )


def require_map(samples: design.AbstractDesign) -> None:
    """Raise unless the design is a grid over two parameters."""
    if len(samples.shape) != 2:
        raise ValueError(
            f"the design sweeps {', '.join(samples.names)}, but a map is a grid over two "
            "parameters: sweep two below [grid]."
        )


def write_map(scan: xr.Dataset, settings: Config, folder: Path) -> list[Path]:
    """Write every curve of special points over the two parameters of a scan; return the paths."""
    parameter_names = tuple(map(str, scan.outcome.dims))
    if not np.any(scan.outcome.values == Outcome.STEPPED):
        raise ValueError("no gait was found on the grid: choose another.")
    model: Any = settings.make_model()
    curves, unexplained_changes = map_special_points(scan, settings.make_wheel(), model)
    rows = [
        [curve.name, *map("{:.12g}".format, point)] for curve in curves for point in curve.values
    ]
    text = "\n".join(",".join(row) for row in [["border", *parameter_names], *rows])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.csv").write_text(text + "\n", encoding="utf-8")
    texts = [*map(str, curves), _format_unexplained_changes(unexplained_changes, scan)]
    (folder / "map.md").write_text("\n\n".join(texts) + "\n", encoding="utf-8")
    measure = next(name for name in scan if name in DIFFERENTIABLE_MEASURES)
    figure_paths = figures.save(figures.map_figure(scan, str(measure), curves), folder, "map")
    return [folder / "map.csv", folder / "map.md", *figure_paths]


def _format_unexplained_changes(changes: Sequence[UnexplainedChange], scan: xr.Dataset) -> str:
    """Return a list of neighboring samples that differ in a sign without a curve between them."""
    lines = [f"Changes between neighbouring samples beside which no curve runs: {len(changes)}"]
    for change in changes:
        parameter_values = [
            float(scan[n][i]) for n, i in zip(scan.outcome.dims, change.sample, strict=True)
        ]
        lines.append(f"    {change.name} at ({parameter_values[0]:.6g}, {parameter_values[1]:.6g})")
    return "\n".join(lines)


def _write_files(
    folder: Path, store: str, data: xr.Dataset, texts: Mapping[str, str]
) -> list[Path]:
    """Write a dataset and texts into `folder`, and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    data.to_zarr(folder / store, mode="w", zarr_format=2)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="")
    return [folder / name for name in (store, *texts)]


def _format_wheel_toml(result: TuneResult) -> str:
    """Return a config of the tuned wheel."""
    lines = [
        f"# Tuned: {result.objective} {result.value:.6g}. Walk it with `vrw gait`.",
        "",
        "[wheel]",
    ]
    for name in PARAMETER_NAMES:
        unit = PARAMETER_DOMAINS[name].unit
        value = float(getattr(result.params, name))
        lines.append(f"{name} = {value!r}" + (f" # {unit}" if unit else ""))
    return "\n".join([*lines, f"n_legs = {result.params.n_legs}", ""])


def format_tuning_summary(result: TuneResult) -> str:
    """Return the summary of a tuning run in Markdown."""
    active_rows = [
        (a.name, get_measure(a.name).format_with_unit(a.limit), f"{a.price:.4g}")
        for a in result.active
    ]
    parameter_rows = [
        (name, f"{float(result.path[name][0]):.6g}", f"{float(getattr(result.params, name)):.6g}",
         MEASURES[name].display_unit)
        for name in result.path.attrs["free"].split()
    ]  # fmt: skip
    return "\n".join([
        f"# Tuned: {result.objective}",
        "",
        *(f"- **{name}**: {text}" for name, text in result.describe().items()),
        "",
        *format_markdown_table(("held by", "limit", "objective gained per unit given up"),
                     active_rows or [("nothing", "", "")]),
        "",
        f"First-order condition met to {result.kkt_residual:.1e} of the objective's gradient.",
        "",
        *format_markdown_table(("parameter", "start", "tuned", "unit"), parameter_rows),
        "",
    ])  # fmt: skip


def _format_special_points_csv(branch: Branch) -> str:
    """Return the table of the special points of a branch as CSV."""
    text = io.StringIO(newline="")
    rows = csv.writer(text)
    rows.writerow([branch.parameter, "kind", "name", "ends_branch", "spectral_radius"])
    for special_point in branch.special_points:
        radius = f"{special_point.point.spectral_radius:.9g}"
        rows.writerow(
            [
                f"{special_point.value:.12g}",
                special_point.kind,
                special_point.name,
                special_point.ends_branch,
                radius,
            ]
        )
    return text.getvalue()


def format_branch_summary(branch: Branch) -> str:
    """Return the summary of a branch in Markdown."""
    first_line, *_ = str(branch).split("\n")
    lines = [f"# Branch along {branch.parameter}", "", first_line, ""]
    if not branch.values.size:
        return "\n".join(lines)
    radius, dls_fraction = branch.dataset.spectral_radius.values, branch.dataset.dls_fraction.values
    rows = []
    for special_point in branch.special_points:
        kind = special_point.kind.replace("_", " ")
        kind += " (ends the branch)" * special_point.ends_branch
        violation = describe_violation(special_point.name)
        rows.append((f"{special_point.value:.9f}", kind, special_point.name, violation))
    return "\n".join([
        *lines,
        *(f"- at {branch.values[i]:.6g}: {branch.ends[i]}" for i in (0, -1)),
        f"- spectral radius {radius.min():.4f} to {radius.max():.4f}, DLS fraction "
        f"{dls_fraction.min():.4f} to {dls_fraction.max():.4f}",
        f"- walked, every gait repeats within {np.max(branch.dataset.closure.values):.1e}",
        "",
        *format_markdown_table((branch.parameter, "kind", "name", "what happens there"), rows),
        "",
    ])  # fmt: skip

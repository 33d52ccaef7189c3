"""Files that commands write into a folder: labeled data, tables, a summary, figures."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from vrw_jax import figures
from vrw_jax.branches import Branch
from vrw_jax.measures import MEASURES, describe_violation, get_measure
from vrw_jax.printing import format_markdown_table
from vrw_jax.scans import DIFFERENTIABLE_MEASURES, SpecialPointMap
from vrw_jax.tuning import TuneResult
from vrw_jax.wheel import PARAMETER_DOMAINS, PARAMETER_NAMES


def write_scan(scan: xr.Dataset, folder: Path) -> list[Path]:
    """Write the figures of a scan into `folder`, and return the paths."""
    figures_by_name = figures.scan_figures(scan)
    return [
        path
        for name, figure in figures_by_name.items()
        for path in figures.save(figure, folder, name)
    ]


def write_tuning(result: TuneResult, folder: Path, draws_figure: bool = True) -> list[Path]:
    """Write data, summary, config and figure of a tuned gait into `folder`, and return the
    paths.
    """
    texts = {"wheel.toml": _format_wheel_toml(result), "summary.md": format_tuning_summary(result)}
    paths = _write_files(folder, "path.zarr", result.path, texts)
    return paths + (
        figures.save(figures.tuning_figure(result), folder, "tuning") if draws_figure else []
    )


def write_branch(branch: Branch, folder: Path, draws_figure: bool = True) -> list[Path]:
    """Write data, table, summary and figure of a branch into `folder`, and return the paths."""
    texts = {
        "borders.csv": _format_special_points_csv(branch),
        "summary.md": format_branch_summary(branch),
    }
    paths = _write_files(folder, "branch.zarr", branch.dataset, texts)
    figure_is_drawn = draws_figure and branch.values.size > 0
    return paths + (
        figures.save(figures.branch_figure(branch), folder, "branch") if figure_is_drawn else []
    )


def write_map(special_points: SpecialPointMap, folder: Path) -> list[Path]:
    """Write text, table and figure of a map of special points into `folder`, and return the
    paths.
    """
    scan, curves, _ = special_points
    parameter_names = tuple(map(str, scan.outcome.dims))
    rows = [
        [curve.name, *map("{:.12g}".format, point)] for curve in curves for point in curve.values
    ]
    text = "\n".join(",".join(row) for row in [["border", *parameter_names], *rows])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.csv").write_text(text + "\n", encoding="utf-8")
    (folder / "map.md").write_text(f"{special_points}\n", encoding="utf-8")
    measure = next(name for name in scan if name in DIFFERENTIABLE_MEASURES)
    figure_paths = figures.save(figures.map_figure(scan, str(measure), curves), folder, "map")
    return [folder / "map.csv", folder / "map.md", *figure_paths]


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
    """Return a config of the tuned wheel as TOML text."""
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
        (
            active_constraint.name,
            get_measure(active_constraint.name).format_with_unit(active_constraint.limit),
            f"{active_constraint.price:.4g}",
        )
        for active_constraint in result.active
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
    quote_text = io.StringIO(newline="")
    rows = csv.writer(quote_text)
    rows.writerow([branch.parameter, "kind", "name", "ends_branch", "spectral_radius"])
    for special_point in branch.special_points:
        spectral_radius = f"{special_point.point.spectral_radius:.9g}"
        rows.writerow(
            [
                f"{special_point.value:.12g}",
                special_point.kind,
                special_point.name,
                special_point.ends_branch,
                spectral_radius,
            ]
        )
    return quote_text.getvalue()


def format_branch_summary(branch: Branch) -> str:
    """Return the summary of a branch in Markdown."""
    first_line, *_ = str(branch).split("\n")
    lines = [f"# Branch along {branch.parameter}", "", first_line, ""]
    if not branch.values.size:
        return "\n".join(lines)
    spectral_radius, dls_fraction = (
        branch.dataset.spectral_radius.values,
        branch.dataset.dls_fraction.values,
    )
    rows = []
    for special_point in branch.special_points:
        kind = special_point.kind.replace("_", " ")
        kind += " (ends the branch)" * special_point.ends_branch
        violation = describe_violation(special_point.name)
        rows.append((f"{special_point.value:.9f}", kind, special_point.name, violation))
    return "\n".join([
        *lines,
        *(f"- at {branch.values[i]:.6g}: {branch.ends[i]}" for i in (0, -1)),
        f"- spectral radius {spectral_radius.min():.4f} to {spectral_radius.max():.4f}, DLS "
        f"fraction {dls_fraction.min():.4f} to {dls_fraction.max():.4f}",
        f"- walked, every gait repeats within {np.max(branch.dataset.closure.values):.1e}",
        "",
        *format_markdown_table((branch.parameter, "kind", "name", "what happens there"), rows),
        "",
    ])  # fmt: skip

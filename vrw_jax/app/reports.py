"""Files that commands write into a folder: labeled data, tables, summaries and figures."""

import csv
import io
import itertools
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vrw_jax import plot
from vrw_jax.app.config import Config, FigureConfig
from vrw_jax.base.printing import format_markdown_table
from vrw_jax.branches.branch import Branch
from vrw_jax.models.measures import MEASURES, describe_violation, get_measure
from vrw_jax.studies.measure_catalog import DIFFERENTIABLE_MEASURES
from vrw_jax.studies.scan_execution import SpecialPointMap
from vrw_jax.studies.tuning import TuneResult
from vrw_jax.wheel.params import PARAMETER_DOMAINS, PARAMETER_NAMES


def write_figures(
    figure_by_name: Mapping[str, Any], folder: Path, figure_config: FigureConfig
) -> list[Path]:
    """Write figures into `folder`, or to the file of the config, and return the paths."""
    formats, figure_file = figure_config.formats, figure_config.file
    if figure_file is not None:
        formats, folder = (figure_file.suffix[1:],), figure_file.parent
        has_one_figure = len(figure_by_name) == 1
        figure_by_name = {
            figure_file.stem if has_one_figure else f"{figure_file.stem}_{figure_name}": figure
            for figure_name, figure in figure_by_name.items()
        }
    return [
        figure_path
        for figure_name, figure in figure_by_name.items()
        for figure_format in formats
        for figure_path in plot.save(figure, folder, f"{figure_name}.{figure_format}")
    ]


def write_tuning_report(
    tune_result: TuneResult, folder: Path, config: Config, draws_figure: bool = True
) -> list[Path]:
    """Write the data, summary, config and figure for a tuned gait into `folder`, and return the
    paths. The written config has the tables `[model]` and `[options]` of `config`, with tuned
    values.
    """
    toml_lines = [
        f"# Tuned: {tune_result.objective} {tune_result.value:.6g}. Walk it with `vrw gait`.",
        "",
        "[wheel]",
    ]
    for parameter_name in PARAMETER_NAMES:
        parameter_unit = PARAMETER_DOMAINS[parameter_name].unit
        parameter_value = float(getattr(tune_result.params, parameter_name))
        unit_comment = f" # {parameter_unit}" if parameter_unit else ""
        toml_lines.append(f"{parameter_name} = {parameter_value!r}{unit_comment}")
    toml_lines += [f"n_legs = {tune_result.params.n_legs}", ""]
    model, settings = tune_result.model, tomllib.loads(config.source_text)
    tables = {name: dict(settings[name]) for name in ("model", "options") if name in settings}
    for name in model.own_parameter_domains:
        value = float(model.get_parameter(tune_result.params, name))
        setting = name.replace("hub.torque", "hub_torque")
        if setting in tables.get("model", ()):
            tables["model"][setting] = value
        else:
            toml_lines += [f"# In the file of the law: {name} = {value!r}", ""]
    for name, table in tables.items():
        toml_lines += [f"[{name}]", *itertools.starmap(_format_setting, table.items()), ""]
    written_paths = _write_dataset_and_texts(
        folder,
        "path.zarr",
        tune_result.path,
        {"wheel.toml": "\n".join(toml_lines), "tuning.md": format_tuning_summary(tune_result)},
    )
    if draws_figure:
        figure = plot.tuning_figure(tune_result, width=config.figures.width)
        written_paths += write_figures({"tuning": figure}, folder, config.figures)
    return written_paths


def _format_setting(name: str, value: Any) -> str:
    """Return a line of TOML. Texts and truth values are written as in JSON."""
    if isinstance(value, str | bool):
        return f"{name} = {json.dumps(value, ensure_ascii=False)}"
    return f"{name} = {value!r}"


def write_branch_report(
    branch: Branch, folder: Path, figure_config: FigureConfig | None
) -> list[Path]:
    """Write the data, table, summary and figure for a branch into `folder`, and return the
    paths. No figure is drawn if `figure_config` is None.
    """
    csv_buffer = io.StringIO(newline="")
    csv_writer = csv.writer(csv_buffer)
    csv_writer.writerow([branch.parameter, "kind", "name", "ends_branch", "spectral_radius"])
    for special_point in branch.special_points:
        csv_writer.writerow(
            [
                f"{special_point.value:.12g}",
                special_point.kind,
                special_point.name,
                special_point.ends_branch,
                f"{special_point.point.spectral_radius:.9g}",
            ]
        )
    written_paths = _write_dataset_and_texts(
        folder,
        "branch.zarr",
        branch.dataset,
        {"borders.csv": csv_buffer.getvalue(), "branch.md": format_branch_summary(branch)},
    )
    if figure_config is not None and branch.values.size:
        figure = plot.branch_figure(branch, width=figure_config.width)
        written_paths += write_figures({"branch": figure}, folder, figure_config)
    return written_paths


def write_special_point_map(
    special_point_map: SpecialPointMap, folder: Path, figure_config: FigureConfig
) -> list[Path]:
    """Write the text, table and figure for a map of special points into `folder`.

    Return the paths.
    """
    scan_dataset, special_point_curves, _ = special_point_map
    csv_lines = [",".join(("border", *map(str, scan_dataset.outcome.dims)))]
    for special_point_curve in special_point_curves:
        csv_lines += [
            f"{special_point_curve.name},{x:.12g},{y:.12g}" for x, y in special_point_curve.values
        ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.csv").write_text("\n".join([*csv_lines, ""]), encoding="utf-8")
    (folder / "map.md").write_text(f"{special_point_map}\n", encoding="utf-8")
    measure_name = next(
        variable_name for variable_name in scan_dataset if variable_name in DIFFERENTIABLE_MEASURES
    )
    figure = plot.map_figure(
        scan_dataset, str(measure_name), special_point_curves, width=figure_config.width
    )
    figure_paths = write_figures({"map": figure}, folder, figure_config)
    return [folder / "map.csv", folder / "map.md", *figure_paths]


def _write_dataset_and_texts(
    folder: Path, store_name: str, dataset: xr.Dataset, text_by_file_name: Mapping[str, str]
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    dataset.to_zarr(folder / store_name, mode="w", zarr_format=2)
    for file_name, file_name_text in text_by_file_name.items():
        (folder / file_name).write_text(file_name_text, encoding="utf-8", newline="")
    return [folder / file_name for file_name in (store_name, *text_by_file_name)]


def format_tuning_summary(tune_result: TuneResult) -> str:
    """Return a Markdown summary of a tuning run."""
    active_constraint_rows = [
        (
            active_constraint.name,
            get_measure(active_constraint.name).format_with_unit(active_constraint.limit),
            active_constraint.describe_price(),
        )
        for active_constraint in tune_result.active
    ]
    parameter_table_rows = [
        (parameter_name, f"{float(tune_result.path[parameter_name][0]):.6g}",
        f"{float(getattr(tune_result.params, parameter_name)):.6g}",
         MEASURES[parameter_name].display_unit)
        for parameter_name in tune_result.path.free_parameter.values
    ]  # fmt: skip
    return "\n".join([
        f"# Tuned: {tune_result.objective}",
        "",
        *(f"- **{summary_label}**: {described_text}" for summary_label,
        described_text in tune_result.describe().items()),
        "",
        *format_markdown_table(("held by", "limit", "objective gained per unit given up"),
                     active_constraint_rows or [("nothing", "", "")]),
        "",
        f"First-order condition met to {tune_result.kkt_residual:.1e} of the objective's gradient.",
        "",
        *format_markdown_table(("parameter", "start", "tuned", "unit"), parameter_table_rows),
        "",
    ])  # fmt: skip


def format_branch_summary(branch: Branch) -> str:
    """Return a Markdown summary of a branch."""
    heading_line, *further_lines = str(branch).split("\n")
    summary_lines = [f"# Branch along {branch.parameter}", "", heading_line, ""]
    if not branch.values.size:
        return "\n".join(summary_lines)
    spectral_radius = branch.dataset.spectral_radius.values
    dls_fraction = branch.dataset.dls_fraction.values
    special_point_rows = []
    for special_point in branch.special_points:
        special_point_kind = special_point.kind.replace("_", " ")
        special_point_kind += " (ends the branch)" * special_point.ends_branch
        violation_text = describe_violation(special_point.name)
        special_point_rows.append(
            (f"{special_point.value:.9f}", special_point_kind, special_point.name, violation_text)
        )
    return "\n".join([
        *summary_lines,
        *(f"- {line.strip()}" for line in further_lines if line.startswith("  at ")),
        f"- spectral radius {spectral_radius.min():.4f} to {spectral_radius.max():.4f}, DLS "
        f"fraction {dls_fraction.min():.4f} to {dls_fraction.max():.4f}",
        f"- walked, every gait repeats within {np.max(branch.dataset.closure.values):.1e}",
        "",
        *format_markdown_table((branch.parameter, "kind", "name", "what happens there"),
        special_point_rows),
        "",
    ])  # fmt: skip

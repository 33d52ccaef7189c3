"""Files that commands write into a folder: labelled data, tables, a summary, figures."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vrw_jax import figures
from vrw_jax.app.config import Config
from vrw_jax.branches import Branch, Change, border_map
from vrw_jax.results import MEASURES, measure_of, what_breaks
from vrw_jax.scans import OF_CYCLE, design
from vrw_jax.tuning import Tuned
from vrw_jax.wheel import DOMAINS, PARAMETER_NAMES, Outcome
from vrw_jax.wording import as_markdown


def write_scan(scan: xr.Dataset, folder: Path) -> list[Path]:
    """Write the figures of a scan into `folder`, and return the paths."""
    drawn = figures.scan_figures(scan)
    return [path for name, figure in drawn.items() for path in figures.save(figure, folder, name)]


def write_tuned(tuned: Tuned, folder: Path, picture: bool = True) -> list[Path]:
    """Write everything about a tuned gait into `folder`, and return the paths."""
    texts = {"wheel.toml": _wheel_toml(tuned), "summary.md": tuned_summary(tuned)}
    paths = _write(folder, "path.zarr", tuned.path, texts)
    return paths + (figures.save(figures.tuning_figure(tuned), folder, "tuning") if picture else [])


def write_branch(branch: Branch, folder: Path, picture: bool = True) -> list[Path]:
    """Write everything about a branch into `folder`, and return the paths."""
    texts = {"borders.csv": _borders_csv(branch), "summary.md": branch_summary(branch)}
    paths = _write(folder, "branch.zarr", branch.dataset, texts)
    drawn = picture and branch.values.size > 0
    return paths + (figures.save(figures.branch_figure(branch), folder, "branch") if drawn else [])


def require_map(samples: design.AbstractDesign) -> None:
    """Raise unless the design is a grid over two parameters."""
    if len(samples.shape) != 2:
        raise ValueError(
            f"the design sweeps {', '.join(samples.names)}, but a map is a grid over two "
            "parameters: sweep two below [grid]."
        )


def write_map(scan: xr.Dataset, settings: Config, folder: Path) -> list[Path]:
    """Write every curve of special points over the two parameters of a scan; return the paths."""
    names = tuple(map(str, scan.outcome.dims))
    if not np.any(scan.outcome.values == Outcome.STEPPED):
        raise ValueError("no gait was found on the grid: choose another.")
    model: Any = settings.wheel_model()
    curves, unexplained = border_map(scan, settings.params(), model)
    rows = [
        [curve.name, *map("{:.12g}".format, point)] for curve in curves for point in curve.values
    ]
    text = "\n".join(",".join(row) for row in [["border", *names], *rows])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "map.csv").write_text(text + "\n", encoding="utf-8")
    told = [*map(str, curves), _unexplained_text(unexplained, scan)]
    (folder / "map.md").write_text("\n\n".join(told) + "\n", encoding="utf-8")
    measure = next(name for name in scan if name in OF_CYCLE)
    drawn = figures.save(figures.map_figure(scan, str(measure), curves), folder, "map")
    return [folder / "map.csv", folder / "map.md", *drawn]


def _unexplained_text(changes: Sequence[Change], scan: xr.Dataset) -> str:
    """Return a list of neighboring samples that differ in a sign without a curve between them."""
    lines = [f"Changes between neighbouring samples beside which no curve runs: {len(changes)}"]
    for change in changes:
        at = [float(scan[n][i]) for n, i in zip(scan.outcome.dims, change.sample, strict=True)]
        lines.append(f"    {change.name} at ({at[0]:.6g}, {at[1]:.6g})")
    return "\n".join(lines)


def _write(folder: Path, store: str, data: xr.Dataset, texts: Mapping[str, str]) -> list[Path]:
    """Write a dataset and texts into `folder`, and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    data.to_zarr(folder / store, mode="w", zarr_format=2)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="")
    return [folder / name for name in (store, *texts)]


def _wheel_toml(tuned: Tuned) -> str:
    """Return a config of the tuned wheel."""
    lines = [
        f"# Tuned: {tuned.objective} {tuned.value:.6g}. Walk it with `vrw gait`.",
        "",
        "[wheel]",
    ]
    for name in PARAMETER_NAMES:
        unit = DOMAINS[name].unit
        value = float(getattr(tuned.params, name))
        lines.append(f"{name} = {value!r}" + (f" # {unit}" if unit else ""))
    return "\n".join([*lines, f"n_legs = {tuned.params.n_legs}", ""])


def tuned_summary(tuned: Tuned) -> str:
    """Return the summary of a tuning run in Markdown."""
    held = [(a.name, measure_of(a.name).text(a.limit), f"{a.price:.4g}") for a in tuned.active]
    moved = [
        (name, f"{float(tuned.path[name][0]):.6g}", f"{float(getattr(tuned.params, name)):.6g}",
         MEASURES[name].plain_unit)
        for name in tuned.path.attrs["free"].split()
    ]  # fmt: skip
    return "\n".join([
        f"# Tuned: {tuned.objective}",
        "",
        *(f"- **{name}**: {text}" for name, text in tuned.lines().items()),
        "",
        *as_markdown(("held by", "limit", "objective gained per unit given up"),
                     held or [("nothing", "", "")]),
        "",
        f"First-order condition met to {tuned.kkt_residual:.1e} of the objective's gradient.",
        "",
        *as_markdown(("parameter", "start", "tuned", "unit"), moved),
        "",
    ])  # fmt: skip


def _borders_csv(branch: Branch) -> str:
    """Return the table of the special points of a branch as CSV."""
    text = io.StringIO(newline="")
    rows = csv.writer(text)
    rows.writerow([branch.parameter, "kind", "name", "ends_branch", "spectral_radius"])
    for b in branch.borders:
        radius = f"{b.point.spectral_radius:.9g}"
        rows.writerow([f"{b.value:.12g}", b.kind, b.name, b.ends_branch, radius])
    return text.getvalue()


def branch_summary(branch: Branch) -> str:
    """Return the summary of a branch in Markdown."""
    head, *_ = str(branch).split("\n")
    lines = [f"# Branch along {branch.parameter}", "", head, ""]
    if not branch.values.size:
        return "\n".join(lines)
    radius, share = branch.dataset.spectral_radius.values, branch.dataset.dls_fraction.values
    borders = [
        (f"{b.value:.9f}", b.kind.replace("_", " ") + (" (ends the branch)" * b.ends_branch),
         b.name, what_breaks(b.name))
        for b in branch.borders
    ]  # fmt: skip
    return "\n".join([
        *lines,
        *(f"- at {branch.values[i]:.6g}: {branch.ends[i]}" for i in (0, -1)),
        f"- spectral radius {radius.min():.4f} to {radius.max():.4f}, DLS fraction "
        f"{share.min():.4f} to {share.max():.4f}",
        f"- walked, every gait repeats within {np.max(branch.dataset.closure.values):.1e}",
        "",
        *as_markdown((branch.parameter, "kind", "name", "what happens there"), borders),
        "",
    ])  # fmt: skip

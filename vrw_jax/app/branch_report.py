"""What a continuation leaves behind: the branch, its borders, a summary, a picture."""

import csv
from pathlib import Path

import numpy as np

from vrw_jax.branches import Branch
from vrw_jax.figures import border_text, branch_figure
from vrw_jax.figures import walk as plots


def write(branch: Branch, folder: Path, picture: bool = True) -> list[Path]:
    """Write everything about a branch into `folder`; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    store, table, text = folder / "branch.zarr", folder / "borders.csv", folder / "summary.md"
    branch.dataset.to_zarr(store, mode="w", zarr_format=2)
    with table.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow([branch.parameter, "kind", "name", "ends_branch", "spectral_radius"])
        for border in branch.borders:
            radius = f"{border.point.spectral_radius:.9g}"
            rows.writerow(
                [f"{border.value:.12g}", border.kind, border.name, border.ends_branch, radius]
            )
    text.write_text(summary(branch), encoding="utf-8")
    drawn = picture and branch.values.size > 0
    pictures = plots.save(branch_figure(branch), folder, "branch") if drawn else []
    return [store, table, text, *pictures]


def summary(branch: Branch) -> str:
    """The branch for a reader, in Markdown."""
    head, *_ = str(branch).split("\n")
    lines = [f"# Branch along {branch.parameter}", "", head, ""]
    if not branch.values.size:
        return "\n".join(lines)
    lines += [f"- at {branch.values[i]:.6g}: {branch.ends[i]}" for i in (0, -1)]
    radius = branch.dataset.spectral_radius.values
    lines += [
        f"- spectral radius {radius.min():.4f} to {radius.max():.4f}, DLS fraction "
        f"{branch.dataset.dls_fraction.values.min():.4f} to "
        f"{branch.dataset.dls_fraction.values.max():.4f}",
        f"- walked, every gait repeats within {np.max(branch.dataset.closure.values):.1e}",
        "",
        f"| {branch.parameter} | kind | name | what happens there |",
        "|---|---|---|---|",
    ]
    for border in branch.borders:
        told = border_text(border).replace("$", "").replace("\\lambda", "λ")
        kind = border.kind.replace("_", " ") + (" (ends the branch)" if border.ends_branch else "")
        lines.append(f"| {border.value:.9f} | {kind} | {border.name} | {told} |")
    return "\n".join([*lines, ""])

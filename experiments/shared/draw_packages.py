"""Draw the graph of the packages from their imports, with the number of imported names.

    python -m experiments.shared.draw_packages [folder]

The command writes `package_graph.svg` and `package_graph.png` to `docs/figures` or the given
folder. It reads the sources and does not run them. It counts every import, also those inside
functions, through `__init__` files and for type checkers.
"""

from itertools import pairwise
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon

from experiments.shared.command import make_parser
from tests.support.package_graph import ImportGraph
from vrw_jax.plot import DARK_GRAY_COLOR, PAGE_FIGURE_WIDTH_INCHES, figure_style, save

ROOT = Path(__file__).parents[2]
STEP, WIDTH, HEIGHT = 1.0, 4.9, 0.74
"""Distance between packages, and the size of a package's box, in rows."""

IMPORTS_COLOR, IMPORTED_COLOR = "#0072B2", "#D55E00"
"""Colors of the lines out of a box and into one."""

TRUNK_OFFSET = 0.62
"""Distance of the lines from the left edge of a box, in rows."""

LINE_WIDTH_FACTOR = 0.5
"""Width of a line, in points, per square root of the number of names."""


def draw_architecture(import_graph: ImportGraph) -> Figure:
    """Return the figure: packages as a stair in import order, each linked to its imports."""
    packages, links = import_graph.packages, import_graph.package_links
    size = len(packages)
    with figure_style():
        figure = Figure(
            figsize=(
                PAGE_FIGURE_WIDTH_INCHES,
                PAGE_FIGURE_WIDTH_INCHES * (size + 0.5) / (size + WIDTH),
            )
        )
        axes = figure.add_subplot(xlim=(-0.2, size + WIDTH - 0.9), ylim=(size - 0.5, -0.8))
        axes.set_aspect("equal")
        axes.axis("off")
        for row, package in enumerate(packages):
            _lines(axes, row, [links[package, other] for other in packages[:row]])
            below = [links[other, package] for other in packages[row + 1 :]]
            _trunk(axes, row, below)
        for row, package in enumerate(packages):
            _box(axes, row, import_graph, package)
            for column, other in enumerate(packages[:row]):
                if count := links[package, other]:
                    _count(axes, column + TRUNK_OFFSET, row, count)
        _legend(axes, import_graph)
    return figure


def _lines(axes: Axes, row: int, counts: list[int]) -> None:
    """Draw the line from a package's box to the left, thinner after each imported package."""
    imported_rows = [column for column, count in enumerate(counts) if count]
    for index, column in enumerate(imported_rows):
        end = (
            imported_rows[index + 1] + TRUNK_OFFSET
            if index + 1 < len(imported_rows)
            else row * STEP
        )
        width = LINE_WIDTH_FACTOR * sum(counts[: column + 1]) ** 0.5
        axes.plot([column + TRUNK_OFFSET, end], [row, row], color=IMPORTS_COLOR, linewidth=width,
                  alpha=0.55, solid_capstyle="butt", zorder=1)  # fmt: skip


def _trunk(axes: Axes, row: int, counts: list[int]) -> None:
    """Draw the arrow up into a package's box, thicker after each importing package."""
    importing_rows = [row + 1 + index for index, count in enumerate(counts) if count]
    x, bottom, head = row + TRUNK_OFFSET, row + HEIGHT / 2, 0.2
    for upper, lower in pairwise([bottom + head, *importing_rows]):
        width = LINE_WIDTH_FACTOR * sum(counts[round(lower) - row - 1 :]) ** 0.5
        axes.plot([x, x], [upper, lower], color=IMPORTED_COLOR, linewidth=width, alpha=0.55,
                  solid_capstyle="butt", zorder=1)  # fmt: skip
    if importing_rows:
        half = 0.1 + 0.012 * sum(counts) ** 0.5
        corners = [(x, bottom), (x - half, bottom + head), (x + half, bottom + head)]
        axes.add_patch(Polygon(corners, color=IMPORTED_COLOR, linewidth=0, zorder=2))


def _box(axes: Axes, row: int, import_graph: ImportGraph, package: str) -> None:
    modules = import_graph.modules_of(package)
    lines = sum(map(import_graph.count_lines, modules))
    corner = (float(row), row - HEIGHT / 2)
    axes.add_patch(
        FancyBboxPatch(corner, WIDTH, HEIGHT, boxstyle="round,pad=0,rounding_size=0.12",
                       facecolor="white", edgecolor=DARK_GRAY_COLOR, linewidth=0.7, zorder=3)
    )  # fmt: skip
    axes.text(row + 0.15, row, package, va="center", weight="bold", fontsize=8.0, zorder=4)
    size = f"{len(modules)} files\n{lines:,} lines"
    axes.text(row + WIDTH - 0.12, row, size, va="center", ha="right", fontsize=6.0,
              color=DARK_GRAY_COLOR, linespacing=1.05, zorder=4)  # fmt: skip


def _count(axes: Axes, x: float, y: float, count: int) -> None:
    axes.scatter([x], [y], s=62, color="white", edgecolor=DARK_GRAY_COLOR, linewidth=0.4, zorder=3)
    axes.text(x, y + 0.02, str(count), ha="center", va="center", fontsize=5.2, zorder=4)


def _legend(axes: Axes, import_graph: ImportGraph) -> None:
    right = len(import_graph.packages) + WIDTH - 1.0
    text = (
        f"{len(import_graph.packages)} packages, {len(import_graph.package_links)} links, "
        "all of them upwards.\n"
        "Blue, from a box to the left: the packages that it imports.\n"
        "Orange, up into a box: the packages that import it.\n"
        "Circles: the number of imported names; line widths grow with it."
    )
    axes.text(right, -0.6, text, ha="right", va="top", fontsize=8.0, linespacing=1.35)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "docs" / "figures")
    folder = parser.parse_args().folder
    for path in save(draw_architecture(ImportGraph(ROOT / "vrw_jax")), folder, "package_graph"):
        print(path)


if __name__ == "__main__":
    main()

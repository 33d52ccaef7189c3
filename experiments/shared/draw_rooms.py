"""The map of the rooms, drawn from the package's imports: who knows whom, and how much of it.

    python -m experiments.shared.draw_rooms [folder]

Writes `rooms.svg` and `rooms.png` to `docs/figures` or the folder given. Nothing of the package is
run for it; every import counts, inside functions, through faces and for type checkers too.
"""

from itertools import pairwise
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Polygon

from experiments.shared.command import make_parser
from tests.support.rooms import PACKAGE_LAYERS, ImportGraph
from vrw_jax.figures import DARK_GRAY, PAGE_WIDTH_INCHES, figure_style, save

ROOT = Path(__file__).parents[2]
STEP, WIDTH, HEIGHT = 1.0, 3.6, 0.74
"""From one room to the next, and the size of a room's box, in rows."""

IMPORTS_COLOR, IMPORTED_COLOR = "#0072B2", "#D55E00"
"""Colours of the lines out of a box and into one."""

TRUNK_OFFSET = 0.62
"""Where the lines of a box begin, from its left edge, rows."""

LINE_WIDTH_FACTOR = 0.5
"""Width of a line, points, per square root of the names that it carries."""


def draw_architecture(import_graph: ImportGraph) -> Figure:
    """Rooms down a stair in the flow's order; each reaches left and up to the rooms it knows."""
    rooms, links = import_graph.packages, import_graph.package_links
    size = len(rooms)
    with figure_style():
        figure = Figure(
            figsize=(PAGE_WIDTH_INCHES, PAGE_WIDTH_INCHES * (size + 0.5) / (size + WIDTH))
        )
        axes = figure.add_subplot(xlim=(-0.2, size + WIDTH - 0.9), ylim=(size - 0.5, -0.8))
        axes.set_aspect("equal")
        axes.axis("off")
        for row, room in enumerate(rooms):
            _lines(axes, row, [links[room, other] for other in rooms[:row]])
            below = [links[other, room] for other in rooms[row + 1 :]]
            _trunk(axes, row, below)
        for row, room in enumerate(rooms):
            _box(axes, row, import_graph, room)
            for column, other in enumerate(rooms[:row]):
                if count := links[room, other]:
                    _count(axes, column + TRUNK_OFFSET, row, count)
        _legend(axes, import_graph)
    return figure


def _lines(axes: Axes, row: int, counts: list[int]) -> None:
    """From a room's box to the left, thinner past each room that it knows."""
    known_rows = [column for column, count in enumerate(counts) if count]
    for index, column in enumerate(known_rows):
        end = known_rows[index + 1] + TRUNK_OFFSET if index + 1 < len(known_rows) else row * STEP
        width = LINE_WIDTH_FACTOR * sum(counts[: column + 1]) ** 0.5
        axes.plot([column + TRUNK_OFFSET, end], [row, row], color=IMPORTS_COLOR, linewidth=width, alpha=0.55,
                  solid_capstyle="butt", zorder=1)  # fmt: skip


def _trunk(axes: Axes, row: int, counts: list[int]) -> None:
    """Upwards into a room's box, thicker by each room that knows it."""
    knowing = [row + 1 + index for index, count in enumerate(counts) if count]
    x, bottom, head = row + TRUNK_OFFSET, row + HEIGHT / 2, 0.2
    for upper, lower in pairwise([bottom + head, *knowing]):
        width = LINE_WIDTH_FACTOR * sum(counts[round(lower) - row - 1 :]) ** 0.5
        axes.plot([x, x], [upper, lower], color=IMPORTED_COLOR, linewidth=width, alpha=0.55,
                  solid_capstyle="butt", zorder=1)  # fmt: skip
    if knowing:
        half = 0.1 + 0.012 * sum(counts) ** 0.5
        corners = [(x, bottom), (x - half, bottom + head), (x + half, bottom + head)]
        axes.add_patch(Polygon(corners, color=IMPORTED_COLOR, linewidth=0, zorder=2))


def _box(axes: Axes, row: int, import_graph: ImportGraph, room: str) -> None:
    modules = import_graph.modules_of(room)
    lines = sum(map(import_graph.count_lines, modules))
    corner = (float(row), row - HEIGHT / 2)
    axes.add_patch(
        FancyBboxPatch(corner, WIDTH, HEIGHT, boxstyle="round,pad=0,rounding_size=0.12",
                       facecolor="white", edgecolor=DARK_GRAY, linewidth=0.7, zorder=3)
    )  # fmt: skip
    axes.text(row + 0.15, row, room, va="center", weight="bold", fontsize=8.0, zorder=4)
    size = f"{len(modules)} files\n{lines:,} lines"
    axes.text(row + WIDTH - 0.12, row, size, va="center", ha="right", fontsize=6.0,
              color=DARK_GRAY, linespacing=1.05, zorder=4)  # fmt: skip


def _count(axes: Axes, x: float, y: float, count: int) -> None:
    axes.scatter([x], [y], s=62, color="white", edgecolor=DARK_GRAY, linewidth=0.4, zorder=3)
    axes.text(x, y + 0.02, str(count), ha="center", va="center", fontsize=5.2, zorder=4)


def _legend(axes: Axes, import_graph: ImportGraph) -> None:
    right = len(import_graph.packages) + WIDTH - 1.0
    text = (
        f"{len(import_graph.packages)} rooms, {len(import_graph.package_links)} arrows, all of them upwards.\n"
        "Blue, from a box to the left: what a room knows.\n"
        "Orange, up into a box: who knows it.\n"
        "Where they meet: how many names are fetched; widths grow with it."
    )
    axes.text(right, -0.6, text, ha="right", va="top", fontsize=8.0, linespacing=1.35)
    for is_alike in (row for row in PACKAGE_LAYERS if len(row) > 1):
        rows = [
            import_graph.packages.index(room) for room in is_alike if room in import_graph.packages
        ]
        x = rows[-1] + WIDTH + 0.2
        top, bottom = rows[0] - HEIGHT / 2, rows[-1] + HEIGHT / 2
        axes.plot([x - 0.1, x, x, x - 0.1], [top, top, bottom, bottom], color=DARK_GRAY,
                  linewidth=0.7)  # fmt: skip
        axes.text(x + 0.15, (top + bottom) / 2, "do not know\neach other", va="center",
                  fontsize=7.0, color=DARK_GRAY)  # fmt: skip


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "docs" / "figures")
    folder = parser.parse_args().folder
    for path in save(draw_architecture(ImportGraph(ROOT / "vrw_jax")), folder, "rooms"):
        print(path)


if __name__ == "__main__":
    main()

"""Run the pages of the gallery of walkers: draw their figures and compare the walkers.

    python -m experiments.gallery.compare [--figures]

Each page in `docs/gallery` defines a `wheel` (or parameters of a walker), a `model` and a `gait` in
its first block, and a `figure` in its last. The command writes `docs/figures/gallery_*.png` and the
table of `docs/gallery.md`: lines of code of the first block, CPU seconds of this block in a process
without compiled code, and steps per CPU second in a batch. `--figures` draws the
figures only.
"""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser
from experiments.shared.tables import DOCS, FIGURES, show_table, write_table
from experiments.shared.timing import start_without_cache

PAGES = (
    "quadratic_dampers",
    "motor",
    "two_legs",
    "simplest_walker",
    "compass_gait",
    "spring_mass_walker",
)
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
N_ELEMENTS = 20_000
"""Elements of the batch, chosen because a batch then takes about a second."""
TABLE = FIGURES / "gallery_walkers.csv"
COLUMNS = ("walker", "lines of code", "first gait, CPU s", "steps per CPU second in a batch")


def list_blocks(page: str) -> list[str]:
    """Return the blocks of Python of a page."""
    return BLOCK.findall((DOCS / "gallery" / f"{page}.md").read_text())


def take_steps(names: dict, n_elements: int) -> np.ndarray:
    """Take one step of each element of a batch, and return the section states."""
    wheel, model, gait = (names[name] for name in ("wheel", "model", "gait"))
    starts = np.tile(np.asarray(gait.section_state), (n_elements, 1))
    if isinstance(model, vrw.HybridSystem):
        return model.step_batch(wheel, starts).section_state
    return vrw.step_batch(wheel, starts, model=model).section_state


def measure_page(page: str) -> list[float]:
    """Return the CPU seconds to the first gait, and the steps per CPU second in a batch."""
    names: dict = {}
    begin = time.process_time()
    exec(list_blocks(page)[0], names)
    first_gait = time.process_time() - begin
    take_steps(names, N_ELEMENTS)
    durations = []
    for _ in range(5):
        begin = time.process_time()
        take_steps(names, N_ELEMENTS)
        durations.append(time.process_time() - begin)
    return [first_gait, N_ELEMENTS / min(durations)]


def draw_page(page: str) -> None:
    """Run a page in the style of the library's figures, and save its figure."""
    names: dict = {}
    with vrw.plot.figure_style():
        for block in list_blocks(page):
            exec(block, names)
        names["figure"].savefig(FIGURES / f"gallery_{page}.png", dpi=110)


def count_lines(code: str) -> int:
    """Return the number of lines that are neither empty nor comments."""
    return sum(bool(line.split("#")[0].strip()) for line in code.splitlines())


def main() -> None:
    """Draw the figures, measure each page in a process of its own, and write the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--figures", action="store_true", help="draw the figures only")
    parser.add_argument("--measure", help="print the measures of one page as JSON")
    parser.add_argument("--page", action="append", help="only this page")
    arguments = parser.parse_args()
    if arguments.measure:
        start_without_cache()
        vrw.start_jax = lambda: None
        print(json.dumps(measure_page(arguments.measure)))
        return
    for page in arguments.page or PAGES:
        draw_page(page)
    if arguments.figures:
        return
    rows = []
    for page in PAGES:
        command = [sys.executable, "-m", "experiments.gallery.compare", "--measure", page]
        run = subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
        )
        first_gait, rate = json.loads(run.stdout.splitlines()[-1])
        title = page.replace("_", " ")
        link = f"[{title}](gallery/{page}.md)"
        rows.append(
            [
                link,
                count_lines(list_blocks(page)[0]),
                f"{first_gait:.1f}",
                f"{float(f'{rate:.2g}'):.0f}",
            ]
        )
    write_table(TABLE, COLUMNS, rows)
    show_table("gallery.md", TABLE, "experiments.gallery.compare")


if __name__ == "__main__":
    main()

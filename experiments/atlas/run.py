"""Where methods fail: stiffness, events, borders of derivatives, long walks, formulations.

    python -m experiments.atlas.run [--only NAME] [--cases 1000000] [--redraw]

Each map is a function that fills one small table (csv) and one that draws it. A table that exists
is kept; those of events and of dips go on where they were stopped. docs/stability_atlas.md reads
them.
"""

import csv
from collections.abc import Callable
from pathlib import Path

from experiments.atlas import (
    charts,
    derivatives,
    events,
    formulations,
    limits,
    stiffness,
    walks,
)
from experiments.atlas.events import Rows
from experiments.shared.command import command
from experiments.shared.tables import FIGURES, read
from experiments.shared.timing import on_one_core, start_cold

MAPS: dict[str, Callable[..., Rows]] = {
    "formulations": formulations.penalty,
    "drift": formulations.drift,
    "events": events.compare,
    "dips": events.dips,
    "between": limits.between,
    "limits": limits.limits,
    "first_order": limits.first_order,
    "slowing": limits.slowing,
    "borders": derivatives.borders,
    "scuffing": derivatives.scuffing,
    "growth": derivatives.growth,
    "apart": derivatives.apart,
    "meeting": derivatives.meeting,
    "modes": derivatives.modes,
    "long_walk": walks.long_walk,
    "stiffness": stiffness.over_rates,
}


GO_ON = {"events": 1, "dips": 20}
"""Maps that are filled chunk by chunk, and how many times the cases asked for they take."""


def table_of(name: str) -> Path:
    return FIGURES / f"atlas_{name}.csv"


def fill(name: str, rows: Rows, append: bool = False) -> None:
    """Compute a map's table, or the rows that it lacks."""
    with table_of(name).open("a" if append else "w", newline="") as file:
        for row in rows:
            writer = csv.DictWriter(file, row)
            if not append:
                writer.writeheader()
                append = True
            writer.writerow(row)
            file.flush()
            print(name, *row.values(), flush=True)


def main() -> None:
    parser = command(__doc__)
    parser.add_argument("--only", choices=MAPS, help="one map")
    parser.add_argument(
        "--cases",
        type=int,
        default=1_000_000,
        help="of the map of events; 20 times as many of dips",
    )
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    chosen = parser.parse_args()
    with on_one_core():
        start_cold()
        for name, rows in MAPS.items():
            if chosen.redraw or chosen.only not in (None, name):
                continue
            kept = len(read(table_of(name))) if table_of(name).exists() else 0
            if name in GO_ON:
                fill(name, rows(GO_ON[name] * chosen.cases, kept), append=kept > 0)
            elif kept == 0:
                fill(name, rows())
    charts.draw({name: table_of(name) for name in MAPS}, stiffness.real_axis_limit)


if __name__ == "__main__":
    main()

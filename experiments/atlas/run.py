"""Compute the tables of the atlas: stiffness, events, derivatives, long walks, formulations.

    python -m experiments.atlas.run [--only NAME] [--cases 1000000] [--redraw]

For each table one function computes a csv file and one draws it. An existing table is kept. The
tables of events and of minima continue from where they stopped. docs/verification/accuracy.md and
docs/benchmarks/stiff_legs.md show the tables.
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
from experiments.shared.command import make_parser
from experiments.shared.tables import FIGURES, read_table
from experiments.shared.timing import start_without_cache, use_one_core

MAPS: dict[str, Callable[..., Rows]] = {
    "formulations": formulations.penalty,
    "drift": formulations.drift,
    "events": events.compare,
    "dips": events.compare_dips,
    "between": limits.between,
    "limits": limits.limits,
    "first_order": limits.first_order,
    "slowing": limits.slowing,
    "borders": derivatives.borders,
    "scuffing": derivatives.scuffing,
    "growth": derivatives.growth,
    "apart": derivatives.measure_multiplier_distances,
    "meeting": derivatives.meeting,
    "modes": derivatives.modes,
    "long_walk": walks.long_walk,
    "stiffness": stiffness.measure_over_rates,
}


GO_ON = {"events": 1, "dips": 20}
"""Maps that are filled chunk by chunk, and how many times the cases asked for they take."""


def select_table(name: str) -> Path:
    return FIGURES / f"atlas_{name}.csv"


def write_table(name: str, rows: Rows, append: bool = False) -> None:
    """Compute a map's table, or the rows that it lacks."""
    with select_table(name).open("a" if append else "w", newline="") as file:
        for row in rows:
            writer = csv.DictWriter(file, row)
            if not append:
                writer.writeheader()
                append = True
            writer.writerow(row)
            file.flush()
            print(name, *row.values(), flush=True)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--only", choices=MAPS, help="one map")
    parser.add_argument(
        "--cases",
        type=int,
        default=1_000_000,
        help="of the map of events; 20 times as many of dips",
    )
    parser.add_argument("--redraw", action="store_true", help="compute nothing")
    chosen = parser.parse_args()
    with use_one_core():
        start_without_cache()
        measured_names = []
        for name, rows in MAPS.items():
            if chosen.redraw or chosen.only not in (None, name):
                continue
            n_stored_rows = (
                len(read_table(select_table(name))) if select_table(name).exists() else 0
            )
            if name in GO_ON:
                write_table(
                    name, rows(GO_ON[name] * chosen.cases, n_stored_rows), append=n_stored_rows > 0
                )
                measured_names.append(name)
            elif n_stored_rows == 0:
                write_table(name, rows())
                measured_names.append(name)
    tables = {name: select_table(name) for name in MAPS}
    charts.draw(tables, stiffness.real_axis_limit, measured_names)


if __name__ == "__main__":
    main()

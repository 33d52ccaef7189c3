"""Show the published facts of the paper and its misprints on a page.

    python -m experiments.paper.facts [results/facts.csv]

`vrw reproduce --out results` writes the facts. The command copies them to
`docs/figures/paper_facts.csv` and fills the blocks of docs/verification/facts.md. Without the
argument it shows the stored facts again.
"""

import shutil
from pathlib import Path

from experiments.shared.command import make_parser
from experiments.shared.tables import (
    DOCS,
    FIGURES,
    describe_run,
    format_markdown,
    read_table,
    replace_block,
)

PAGE = DOCS / "verification" / "facts.md"
TABLE = FIGURES / "paper_facts.csv"
BLOCKS = {"paper facts": False, "paper misprints": True}
"""Blocks of the page, and whether they show the evidence for misprints."""


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("facts", type=Path, nargs="?", help="new facts, from `vrw reproduce`")
    new_facts = parser.parse_args().facts
    if new_facts:
        shutil.copy(new_facts, TABLE)
    published = [row for row in read_table(TABLE) if "independent code" not in row["source"]]
    for block, shows_misprints in BLOCKS.items():
        lines = [
            [row[name] for name in ("claim", "source", "published_value", "computed")]
            for row in published
            if ("Misprints" in row["group"]) == shows_misprints
        ]
        table = format_markdown(("fact", "where", "published", "computed"), lines)
        source = describe_run("experiments.paper.facts") if new_facts else None
        replace_block(PAGE, block, table, source)


if __name__ == "__main__":
    main()

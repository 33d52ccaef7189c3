"""Table of every fact that the paper publishes, with the computed value; each fact can fail."""

import csv
import itertools
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from vrw_jax.paper.facts.base import Evidence, Fact
from vrw_jax.paper.facts.claims import INDICATORS, PREMISES, THREE_DAMPINGS, TYPICAL_GAIT
from vrw_jax.paper.facts.misprints import MISPRINTS
from vrw_jax.wording import as_markdown

INTRODUCTION = (
    "“independent code” is a solver in the paper's own five constrained coordinates: where the "
    "paper prints no number, or only a curve, the number to meet is that code's. A tolerance is "
    "half a unit of the last digit published unless the row gives another reason."
)

GROUPS = (TYPICAL_GAIT, THREE_DAMPINGS, INDICATORS, PREMISES, MISPRINTS)


def all_facts(evidence: Evidence) -> list[Fact]:
    """Return the facts of all groups."""
    return [fact for group in GROUPS for fact in group.facts(evidence)]


def _cell(text: str) -> str:
    """Return text with minus signs in place of hyphens before numbers."""
    return re.sub(r"(?<![\w.])-(?=\d)", "−", text)


def held(table: Sequence[Fact]) -> str:
    """Return a sentence on how many facts hold and where their numbers come from."""
    n, by_code = len(table), sum(fact.by_code for fact in table)
    by_whom = f"{n - by_code} that the paper publishes, {by_code} by independent code"
    return f"{sum(fact.holds for fact in table)} of {n} hold: {by_whom}"


def as_page(table: Sequence[Fact]) -> str:
    """Return the table as a page of Markdown."""
    missing = [fact for fact in table if not fact.holds]
    lines = [
        "# The paper's facts, published against found",
        "",
        f"{held(table)}."
        + ("" if not missing else " Not: " + "; ".join(fact.claim for fact in missing) + "."),
        "",
        INTRODUCTION,
        "",
        "Figure 10 is drawn at slope 0.30 rad: Section 5.2 prints 0.10, where the gaits do not fit "
        "its numbers (last group). With Coulomb friction the rear foot would slip in the landing; "
        "this rung of the model holds it, as the paper does.",
    ]
    for title, group in itertools.groupby(table, lambda fact: fact.group):
        rows = []
        for fact in group:
            verdict = fact.verdict if fact.holds else f"**{fact.verdict}**"
            told = (fact.claim, fact.where, fact.published, fact.found, verdict, fact.reason)
            rows.append([_cell(text) for text in told])
        header = ("fact", "where", "published", "found", "", "tolerance")
        lines += ["", f"## {title}", "", *as_markdown(header, rows)]
    return "\n".join(lines) + "\n"


def write(table: Sequence[Fact], folder: Path) -> list[Path]:
    """Write the table as facts.md and facts.csv, and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "facts.md", folder / "facts.csv"]
    paths[0].write_text(as_page(table), encoding="utf-8")
    with paths[1].open("w", newline="", encoding="utf-8") as file:
        rows = [asdict(fact) | {"holds": fact.verdict} for fact in table]
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return paths

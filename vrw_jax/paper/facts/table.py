"""The whole table: every fact that the paper publishes, beside what is found; each can fail."""

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from vrw_jax.paper.facts.base import Evidence, Fact
from vrw_jax.paper.facts.gait import damping_facts, gait_facts
from vrw_jax.paper.facts.indicators import indicator_facts
from vrw_jax.paper.facts.misprints import misprint_facts
from vrw_jax.paper.facts.premises import premise_facts

INTRODUCTION = (
    "“independent code” is a solver in the paper's own five constrained coordinates: where the "
    "paper prints no number, or only a curve, the number to meet is that code's. A tolerance is "
    "half a unit of the last digit published unless the row gives another reason."
)

GROUPS: tuple[Callable[[Evidence], list[Fact]], ...] = (
    gait_facts,
    damping_facts,
    indicator_facts,
    premise_facts,
    misprint_facts,
)


def facts(evidence: Evidence) -> list[Fact]:
    """The whole table, in the paper's order."""
    return [fact for group in GROUPS for fact in group(evidence)]


def _cell(text: str) -> str:
    """Text that a Markdown table can hold, with minus signs for hyphens before numbers."""
    return re.sub(r"(?<![\w.])-(?=\d)", "−", text).replace("|", "\\|")


def as_markdown(table: Sequence[Fact]) -> str:
    """The table for a reader."""
    missing = [fact for fact in table if not fact.holds]
    lines = [
        "# The paper's facts, published against found",
        "",
        f"{len(table) - len(missing)} of {len(table)} hold."
        + ("" if not missing else " Not: " + "; ".join(fact.claim for fact in missing) + "."),
        "",
        INTRODUCTION,
        "",
        "Figure 10 is drawn at slope 0.30 rad: Section 5.2 prints 0.10, where the gaits do not fit "
        "its numbers (last group). With Coulomb friction the rear foot would slip in the landing; "
        "this rung of the model holds it, as the paper does.",
    ]
    group = ""
    for fact in table:
        if fact.group != group:
            group = fact.group
            lines += [
                "",
                f"## {group}",
                "",
                "| fact | where | published | found | | tolerance |",
                "|---|---|---|---|---|---|",
            ]
        cells = [
            fact.claim,
            fact.where,
            fact.published,
            fact.found,
            fact.verdict if fact.holds else f"**{fact.verdict}**",
            fact.reason,
        ]
        lines.append("| " + " | ".join(_cell(text) for text in cells) + " |")
    return "\n".join(lines) + "\n"


def write(table: Sequence[Fact], folder: Path) -> list[Path]:
    """The table as Markdown and CSV in `folder`; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "facts.md", folder / "facts.csv"]
    paths[0].write_text(as_markdown(table), encoding="utf-8")
    with paths[1].open("w", newline="", encoding="utf-8") as file:
        rows = [asdict(fact) | {"holds": fact.verdict} for fact in table]
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return paths

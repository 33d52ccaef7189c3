"""Table of every fact that the paper publishes, with the computed value. Each fact can fail."""

import csv
import itertools
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from vrw_jax.paper.facts.base import Evidence, Fact
from vrw_jax.paper.facts.claims import (
    ASSUMPTION_CLAIMS,
    DAMPING_CLAIMS,
    INDICATOR_CLAIMS,
    TYPICAL_GAIT_CLAIMS,
)
from vrw_jax.paper.facts.misprints import MISPRINT_CLAIMS
from vrw_jax.printing import format_markdown_table

INTRODUCTION = (
    "The paper is *Modeling and analysis of passive viscoelastic-legged rimless wheel that "
    "generates measurable period of double-limb support*. “Independent code” is a solver in the "
    "paper's five constrained coordinates. It provides the reference if the paper prints no "
    "number, or only a curve. A tolerance is half a unit of the last published digit unless the "
    "table gives another reason."
)

CLAIM_GROUPS = (
    TYPICAL_GAIT_CLAIMS,
    DAMPING_CLAIMS,
    INDICATOR_CLAIMS,
    ASSUMPTION_CLAIMS,
    MISPRINT_CLAIMS,
)


def compute_facts(evidence: Evidence) -> list[Fact]:
    """Return the facts of all groups of claims."""
    return [fact for group in CLAIM_GROUPS for fact in group.make_facts(evidence)]


def summarize_facts(facts: Sequence[Fact]) -> str:
    """Return a sentence with the number of facts that hold and the sources of their numbers."""
    n, n_from_code = len(facts), sum(fact.is_from_reference_code for fact in facts)
    sources_text = f"{n - n_from_code} with published numbers, {n_from_code} with independent code"
    return f"{sum(fact.holds for fact in facts)} of {n} facts hold: {sources_text}"


def format_facts_page(facts: Sequence[Fact]) -> str:
    """Return the table of facts as a page of Markdown."""
    failed_facts = [fact for fact in facts if not fact.holds]
    page_lines = [
        "# The paper's facts",
        "",
        "This page compares every number that the paper publishes with the computed number. "
        "`vrw reproduce --out results` computes this page and the figures.",
        "",
        f"{summarize_facts(facts)}."
        + (
            ""
            if not failed_facts
            else " Not: " + "; ".join(fact.claim for fact in failed_facts) + "."
        ),
        "",
        INTRODUCTION,
        "",
        "Figure 10 uses the slope 0.30 rad. Section 5.2 prints 0.10, but at this slope the gaits "
        "do not agree with the numbers of the figure (last group). With Coulomb friction the rear "
        "foot would slip in the landing. In this model, as in the paper, it does not slip.",
    ]
    for title, group in itertools.groupby(facts, lambda fact: fact.group):
        table_rows = []
        for fact in group:
            verdict = fact.verdict if fact.holds else f"**{fact.verdict}**"
            cells = (
                fact.claim,
                fact.source,
                fact.published_value,
                fact.computed,
                verdict,
                fact.tolerance_reason,
            )
            # Minus signs replace the hyphens before numbers.
            table_rows.append([re.sub(r"(?<![\w.])-(?=\d)", "−", cell_text) for cell_text in cells])
        header = ("fact", "where", "published", "found", "", "tolerance")
        page_lines += ["", f"## {title}", "", *format_markdown_table(header, table_rows)]
    return "\n".join(page_lines) + "\n"


def write_facts(facts: Sequence[Fact], folder: Path) -> list[Path]:
    """Write the table as facts.md and facts.csv, and return the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "facts.md", folder / "facts.csv"]
    paths[0].write_text(format_facts_page(facts), encoding="utf-8")
    with paths[1].open("w", newline="", encoding="utf-8") as csv_file:
        fact_rows = [asdict(fact) | {"holds": fact.verdict} for fact in facts]
        writer = csv.DictWriter(csv_file, fact_rows[0].keys())
        writer.writeheader()
        writer.writerows(fact_rows)
    return paths

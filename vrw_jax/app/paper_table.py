"""Table of the facts that the paper publishes, with computed values and whether they agree."""

import csv
import itertools
import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from vrw_jax.app.paper_claims import (
    ASSUMPTION_CLAIMS,
    DAMPING_CLAIMS,
    INDICATOR_CLAIMS,
    TYPICAL_GAIT_CLAIMS,
)
from vrw_jax.app.paper_fact import PaperEvidence, PaperFact
from vrw_jax.app.paper_printed import MISPRINT_CLAIMS
from vrw_jax.base.printing import format_markdown_table

FACTS_PAGE_INTRODUCTION = (
    "The paper is *Modeling and analysis of passive viscoelastic-legged rimless wheel that "
    "generates measurable period of double-limb support*. “Independent code” is a solver in the "
    "paper's five constrained coordinates. This solver is the reference if the paper prints no "
    "number, or only a curve. A tolerance is half a unit of the last published digit unless the "
    "table gives another reason."
)

PAPER_CLAIM_GROUPS = (
    TYPICAL_GAIT_CLAIMS,
    DAMPING_CLAIMS,
    INDICATOR_CLAIMS,
    ASSUMPTION_CLAIMS,
    MISPRINT_CLAIMS,
)


def compute_paper_facts(paper_evidence: PaperEvidence) -> list[PaperFact]:
    """Return the facts for all groups of claims."""
    return [
        paper_fact
        for claim_group in PAPER_CLAIM_GROUPS
        for paper_fact in claim_group.make_facts(paper_evidence)
    ]


def summarize_paper_facts(paper_facts: Sequence[PaperFact]) -> str:
    """Return a sentence that states how many facts hold, and the sources of their published
    values.
    """
    n_facts = len(paper_facts)
    n_facts_from_reference_code = sum(
        paper_fact.is_from_reference_code for paper_fact in paper_facts
    )
    n_facts_that_hold = sum(paper_fact.holds for paper_fact in paper_facts)
    return (
        f"{n_facts_that_hold} of {n_facts} facts hold: {n_facts - n_facts_from_reference_code} "
        f"with published numbers, {n_facts_from_reference_code} with independent code"
    )


CORRECTED_STATEMENTS = (
    "The paper describes gaits only at dampings at which its model is valid. The section "
    "“Corrections of the paper” of the page `docs/studies/beyond_the_border.md` contains computed "
    "walks at other dampings. From c = 220 N s/m on, the paper's model has cycles of seven to four "
    "steps. With unilateral contact, gaits of one step there have 44 to 50 % double support. At "
    "dampings of 4 N s/m and below, the fore foot does not bounce with unilateral contact and μ = "
    "15. At c = 50 and 100 N s/m, the wheel has a gait of one step although its rear foot scuffs."
)
"""Paragraph about statements of the paper that computed walks correct. A table of the page
`docs/studies/beyond_the_border.md` contains the walks.
"""


def format_facts_page(paper_facts: Sequence[PaperFact]) -> str:
    """Return the table of facts as a Markdown page."""
    failed_facts = [paper_fact for paper_fact in paper_facts if not paper_fact.holds]
    page_lines = [
        "# The paper's facts",
        "",
        "This page compares every number that the paper publishes with the computed number. "
        "`vrw reproduce --out results` writes this page and the figures.",
        "",
        f"{summarize_paper_facts(paper_facts)}."
        + (
            ""
            if not failed_facts
            else " Not: " + "; ".join(paper_fact.claim for paper_fact in failed_facts) + "."
        ),
        "",
        FACTS_PAGE_INTRODUCTION,
        "",
        "Figure 10 uses the slope 0.30 rad. Section 5.2 prints 0.10, but at this slope the gaits "
        "do not agree with the numbers of the figure (last group). With Coulomb friction the rear "
        "foot would slip in the landing. The paper assumes that the foot does not slip, "
        "and so does this model.",
    ]
    for group_title, facts_of_group in itertools.groupby(
        paper_facts, lambda paper_fact: paper_fact.group
    ):
        facts_table_rows = []
        for paper_fact in facts_of_group:
            verdict_text = paper_fact.verdict if paper_fact.holds else f"**{paper_fact.verdict}**"
            table_cell_texts = (
                paper_fact.claim,
                paper_fact.source,
                paper_fact.published_value,
                paper_fact.computed,
                verdict_text,
                paper_fact.tolerance_reason,
            )
            # Minus signs replace the hyphens before numbers.
            facts_table_rows.append(
                [
                    re.sub(r"(?<![\w.])-(?=\d)", "−", table_cell_text)
                    for table_cell_text in table_cell_texts
                ]
            )
        column_headings = ("fact", "where", "published", "found", "", "tolerance")
        page_lines += [
            "",
            f"## {group_title}",
            "",
            *format_markdown_table(column_headings, facts_table_rows),
        ]
    page_lines += ["", "## Corrected statements of the paper", "", CORRECTED_STATEMENTS]
    return "\n".join(page_lines) + "\n"


def write_facts_files(paper_facts: Sequence[PaperFact], folder: Path) -> None:
    """Write the table of facts to facts.md and facts.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "facts.md").write_text(format_facts_page(paper_facts), encoding="utf-8")
    with (folder / "facts.csv").open("w", newline="", encoding="utf-8") as csv_file:
        fact_rows = [
            asdict(paper_fact) | {"holds": paper_fact.verdict} for paper_fact in paper_facts
        ]
        csv_writer = csv.DictWriter(csv_file, fact_rows[0].keys())
        csv_writer.writeheader()
        csv_writer.writerows(fact_rows)

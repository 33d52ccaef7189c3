"""Measures state their names and the meaning of a negative value, and print themselves."""

import pytest

from vrw_jax.base import (
    format_heading_and_rows,
    format_html_table,
    format_markdown_table,
    format_mathtext,
)
from vrw_jax.models import (
    MARGIN_MEASURES,
    SELECTION_MARGIN_NAMES,
    STEP_MEASURES,
    describe_violation,
)
from vrw_jax.models.ladder import describe_selection_reason

INDICATORS = ("lambda_I4", "lambda_2_plus", "lambda_4_plus")


@pytest.mark.parametrize("name", [*MARGIN_MEASURES, *INDICATORS])
def test_a_margin_or_an_indicator_describes_its_violation(name):
    breaks = (MARGIN_MEASURES | STEP_MEASURES)[name].violation_text
    assert breaks
    assert not breaks.endswith(".")
    assert breaks in describe_violation(name)


def test_no_two_margins_describe_the_same_violation():
    assert len({measure.violation_text for measure in MARGIN_MEASURES.values()}) == len(
        MARGIN_MEASURES
    )


def test_other_measures_describe_no_violation():
    assert {name for name, measure in STEP_MEASURES.items() if measure.violation_text} == set(
        INDICATORS
    )
    assert describe_violation("period_doubling") == "period doubling"
    assert describe_violation("locked_stopper_force[5]").endswith(", leg 5")
    assert describe_violation("lambda_4_plus") == "λ4⁺ = 0: rear foot lifts at once"


def test_reasons_of_the_ladder_come_from_the_table():
    for reason, name in enumerate(SELECTION_MARGIN_NAMES, start=1):
        assert MARGIN_MEASURES[name].violation_text in describe_selection_reason(reason)


@pytest.mark.parametrize(
    ("symbol", "tex"),
    [
        ("θ̇⁺", r"\dot{\theta }^+"),
        ("L̇1⁻", r"\dot{L}_1^-"),
        ("ẋ", r"\dot{x}"),
        ("T_DLS/T", r"T_{\mathrm{DLS}}/T"),
        ("μ - |λ_I1|/λ_I2", r"\mu  - |\lambda _{I1}|/\lambda _{I2}"),
        ("min(L0 - L1)", r"\min (L_0 - L_1)"),
        ("L*", "L^*"),
        ("phi", r"\phi "),
        ("∂(v)/∂c", r"\partial (v)/\partial c"),
        ("outcome", r"\mathrm{outcome}"),
    ],
)
def test_a_symbol_becomes_mathtext(symbol, tex):
    assert format_mathtext(symbol) == tex


def test_rows_are_formatted_as_text_markdown_and_html():
    rows = [("a", "1 < 2"), ("b", "|x|")]
    assert format_heading_and_rows("Title", rows) == "Title\n  a: 1 < 2\n  b: |x|"
    assert format_markdown_table(("name", "value"), rows) == [
        "| name | value |", "|---|---|", "| a | 1 < 2 |", r"| b | \|x\| |",
    ]  # fmt: skip
    html = format_html_table("Title", rows, ("name", "value"))
    assert "<caption>Title</caption>" in html
    assert "1 &lt; 2" in html
    assert html.count("<tr>") == 3

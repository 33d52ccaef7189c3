"""Quantities say what they are called, what breaks below zero, and print themselves."""

import pytest

from vrw_jax.models.ladder import PREMISES, told_why
from vrw_jax.results import MARGINS, STEP, what_breaks
from vrw_jax.wording import as_html, as_markdown, as_tex, as_text

INDICATORS = ("lambda_I4", "lambda_2_plus", "lambda_4_plus")


@pytest.mark.parametrize("name", [*MARGINS, *INDICATORS])
def test_a_margin_or_an_indicator_says_what_breaks_below_zero(name):
    breaks = (MARGINS | STEP)[name].breaks
    assert breaks
    assert not breaks.endswith(".")
    assert breaks in what_breaks(name)


def test_no_two_margins_break_alike():
    assert len({measure.breaks for measure in MARGINS.values()}) == len(MARGINS)


def test_what_is_no_margin_breaks_nothing():
    assert {name for name, measure in STEP.items() if measure.breaks} == set(INDICATORS)
    assert what_breaks("period_doubling") == "period doubling"
    assert what_breaks("locked_stopper_force[5]").endswith(", leg 5")
    assert what_breaks("lambda_4_plus") == "λ4⁺ = 0: rear foot lifts at once"


def test_the_ladder_takes_its_reasons_from_the_table():
    for reason, name in enumerate(PREMISES, start=1):
        assert MARGINS[name].breaks in told_why(reason)


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
    assert as_tex(symbol) == tex


def test_rows_are_shown_as_text_as_a_page_and_in_a_notebook():
    rows = [("a", "1 < 2"), ("b", "|x|")]
    assert as_text("Title", rows) == "Title\n  a: 1 < 2\n  b: |x|"
    assert as_markdown(("name", "value"), rows) == [
        "| name | value |", "|---|---|", "| a | 1 < 2 |", r"| b | \|x\| |",
    ]  # fmt: skip
    html = as_html("Title", rows, ("name", "value"))
    assert "<caption>Title</caption>" in html
    assert "1 &lt; 2" in html
    assert html.count("<tr>") == 3

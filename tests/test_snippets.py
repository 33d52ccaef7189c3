"""Every block of Python on every page runs unchanged, and prints the text block below it."""

import re
from pathlib import Path

import pytest

import vrw_jax as vrw
from experiments.gallery.compare import PAGES as PAGES_OF_WALKERS

ROOT = Path(__file__).parent.parent
ELSEWHERE_MARKER = "<!-- runs elsewhere"
"""Marks a block that needs a cluster or an editor; it is compiled only."""
BLOCK = re.compile(
    r"^(?P<note><!-- runs elsewhere[^\n]*\n)?```python\n(?P<code>.*?)^```"
    r"(?:\n\n```text\n(?P<output>.*?)^```)?",
    re.MULTILINE | re.DOTALL,
)
PAGES = [
    page
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if "```python" in page.read_text()
]
SLOW_PAGES = {
    "docs/any_system.md", "docs/choose.md", "docs/own_loops.md", "docs/tuning.md",
    "docs/explanation/ladder.md",
    "docs/explanation/branches.md", "docs/explanation/contact_model.md",
    "docs/explanation/tolerances.md",
    *(f"docs/gallery/{page}.md" for page in PAGES_OF_WALKERS),
    "docs/howto/add_a_measure.md", "docs/howto/basins.md", "docs/howto/cluster.md",
    "docs/howto/export.md", "docs/howto/fit.md", "docs/howto/own_leg.md",
    "docs/howto/numpyro.md", "docs/howto/own_constraint.md", "docs/howto/robustness.md",
    "docs/howto/unilateral_contact.md",
    "docs/studies/beyond_the_border.md", "docs/studies/borders.md",
    "docs/studies/double_support.md", "docs/studies/friction.md",
    "docs/studies/one_peak_or_two.md",
}  # fmt: skip
"""Pages that compile for long, or that a test of their own runs in the quick suite."""


def run_page(page, capsys, tmp_path, monkeypatch):
    """Run a page from top to bottom in an empty folder."""
    monkeypatch.setattr(vrw, "start_jax", lambda: None)  # it has started
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in BLOCK.finditer(page.read_text()):
        line = page.read_text()[: block.start("code")].count("\n")
        code = compile("\n" * line + block["code"], str(page), "exec")
        if block["note"]:
            continue
        capsys.readouterr()
        exec(code, names)
        if block["output"] is not None:
            assert capsys.readouterr().out.split() == block["output"].split()
    return names


def mark_if_slow(page):
    name = str(page.relative_to(ROOT))
    return pytest.param(page, id=name, marks=[pytest.mark.slow] if name in SLOW_PAGES else [])


@pytest.mark.parametrize("page", [*map(mark_if_slow, PAGES)])
def test_the_code_of_a_page_runs_unchanged(page, capsys, tmp_path, monkeypatch):
    for stem, library in (("numpyro", "numpyro"), ("explore", "anywidget")):
        if page.stem == stem:
            pytest.importorskip(library)
    run_page(page, capsys, tmp_path, monkeypatch)


def test_the_printed_output_of_a_page_is_compared(capsys, tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("```python\nprint(1)\n```\n\n```text\n2\n```\n")
    with pytest.raises(AssertionError):
        run_page(page, capsys, tmp_path, monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_of_python_is_found_and_valid(page):
    blocks = list(BLOCK.finditer(page.read_text()))
    assert len(blocks) == page.read_text().count("```python")
    for block in blocks:
        compile(block["code"], str(page), "exec")

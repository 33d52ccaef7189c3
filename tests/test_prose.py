"""Pages keep the rules of their language: length, plain verbs, few numbers in a sentence.

These rules are of CONTRIBUTING.md. proselint adds the rules of style guides, for pages and
docstrings. Each check is tried on a sentence that breaks it.
"""

import ast
import re
from pathlib import Path

import pytest
from proselint import checks
from proselint.config import DEFAULT, Config
from proselint.registry import CheckRegistry
from proselint.tools import LintFile

from experiments.shared.tables import FIGURES, format_markdown, read_table, shorten_number

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MODULES = sorted((ROOT / "vrw_jax").rglob("*.py"))
MAX_PAGE_WORDS = 1500
MAX_NUMBERS = 2
"""Numbers of a sentence beyond which a table is clearer."""
MAX_SHARE_OF_NUMERIC_SENTENCES = 0.05
"""Of all sentences: names, dates of references and formulas have numbers too."""
MAX_SENTENCE_WORDS = 40
"""The rule is 25; a machine counts a list or a formula as one sentence."""
MAX_SHARE_OF_LONG_SENTENCES = 0.05

FORBIDDEN_WORDS = {
    r"tell|tells|told": "report, return, show",
    r"say|says|said": "report, state",
    r"ask|asks|asked": "require, request",
    r"stand|stands|stood": "be, lie, hold",
    r"know|knows|knew": "depend on, contain",
    r"felt|feels": "depend on",
    r"real ground": "unilateral contact",
    r"oracle|truth|truths": "reference",
    r"premise|premises": "margin, assumption",
    r"aimed at|until then|no longer|mended since": "the present only; history is in the changelog",
}
"""Words that prose avoids, with better ones."""

PROSELINT_CONFIG = Config(max_errors=1000, checks={**DEFAULT["checks"], "typography": False})
"""Typography is off, because pages and docstrings are written in ASCII quotes and dots."""

BLOCK = re.compile(r"<!-- (?!end of|runs elsewhere)([^\n]*?) -->(.*?)<!-- end of \1 -->", re.DOTALL)
UNMEASURED_BLOCKS = {"functions and models"}
SOURCE_LINE = re.compile(r"Command: .+; commit: .+; machine: .+; date: .+\.$")


def strip_markup(text):
    """Return the prose of a page: no code, comments, tables or headings; links by their text."""
    text = re.sub(r"```.*?```", " ", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", " ", text, flags=re.DOTALL)
    text = re.sub(r"^\s*[|#].*$", " ", text, flags=re.MULTILINE)
    text = re.sub(r"\$\$?[^$]*\$\$?", " x ", text)
    text = re.sub(r"`[^`]*`", " x ", text)
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)


def split_sentences(prose):
    """Return sentences of more than three words."""
    without_bullets = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n", prose, flags=re.MULTILINE)
    parts = re.split(r"(?<=[.;:!?])\s+|\n\s*\n", without_bullets)
    sentences = [" ".join(part.split()) for part in parts]
    return [sentence for sentence in sentences if len(sentence.split()) > 3]


def count_words(prose):
    return len(re.findall(r"[A-Za-z][\w'’-]*", prose))


def find_forbidden_words(prose):
    return [
        f"{word!r}: write {better}"
        for pattern, better in FORBIDDEN_WORDS.items()
        for word in re.findall(rf"\b(?:{pattern})\b", prose, re.IGNORECASE)
    ]


@pytest.fixture(scope="module", autouse=True)
def registered_checks():
    """Register the checks of proselint once."""
    CheckRegistry().register_many(checks.__register__)


def find_disliked_phrases(prose):
    """Return what proselint finds; repeated placeholders of formulas are no repeated words."""
    lint_file = LintFile("prose", prose)
    phrases = [
        (lint_file.content[slice(*found.check_result.span)], found.check_result.message)
        for found in lint_file.lint(PROSELINT_CONFIG)
    ]
    return [(phrase, message) for phrase, message in phrases if "x" not in phrase.split()]


def read_docstrings(module):
    """Return the docstrings of a module, of its classes and of its functions."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [n for n in ast.walk(ast.parse(module.read_text())) if isinstance(n, documented)]
    return [docstring for node in nodes if (docstring := ast.get_docstring(node))]


def is_numeric(sentence):
    return len(re.findall(r"\d[\d.,]*(?:e-?\d+)?", sentence)) > MAX_NUMBERS


def find_blocks_without_source(page_text):
    """Return names of measured blocks that do not end with command, commit, machine and date."""
    return [
        name
        for name, content in BLOCK.findall(page_text)
        if name not in UNMEASURED_BLOCKS
        and not SOURCE_LINE.match(content.strip().splitlines()[-1] if content.strip() else "")
    ]


def find_blocks_unlike_their_table(page_text):
    """Return names of blocks that show other numbers than the stored table of their name."""
    different_names = []
    for name, content in BLOCK.findall(page_text):
        rows = read_table(FIGURES / f"{name}.csv") if (FIGURES / f"{name}.csv").exists() else []
        lines = [line for line in content.splitlines() if line.startswith("|")]
        header = [cell.strip() for cell in lines[0].strip("|").split(" | ")] if lines else []
        if rows and set(header) <= set(rows[0]):
            cells = [[shorten_number(row[column]) for column in header] for row in rows]
            if format_markdown(header, cells) != "\n".join(lines):
                different_names.append(name)
    return different_names


def name_of(page):
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_is_short_and_uses_plain_verbs(page):
    prose = strip_markup(page.read_text())
    assert count_words(prose) <= MAX_PAGE_WORDS
    assert not find_forbidden_words(prose)
    assert not find_disliked_phrases(prose)


@pytest.mark.parametrize(
    "folder", sorted({module.parent for module in MODULES}), ids=lambda folder: folder.name
)
def test_docstrings_have_no_phrase_that_style_guides_reject(folder):
    for module in folder.glob("*.py"):
        prose = "\n\n".join(strip_markup(docstring) for docstring in read_docstrings(module))
        assert not find_disliked_phrases(prose), module


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_measured_block_shows_stored_numbers_and_names_its_run(page):
    assert not find_blocks_without_source(page.read_text())
    assert not find_blocks_unlike_their_table(page.read_text())


def test_few_sentences_are_long_or_hold_many_numbers():
    sentences = [s for page in PAGES for s in split_sentences(strip_markup(page.read_text()))]
    numeric = [s for s in sentences if is_numeric(s)]
    long = [s for s in sentences if len(s.split()) > MAX_SENTENCE_WORDS]
    assert len(numeric) <= MAX_SHARE_OF_NUMERIC_SENTENCES * len(sentences), numeric
    assert len(long) <= MAX_SHARE_OF_LONG_SENTENCES * len(sentences), long


def test_prose_against_the_rules_is_found():
    assert find_forbidden_words("The step tells its time. It was asked for the truth.")
    assert not find_forbidden_words(strip_markup("`tell` and ```\nsays\n``` report their time."))
    assert [phrase for phrase, _ in find_disliked_phrases("It has has a very unique end.")]
    assert not find_disliked_phrases(strip_markup("The rates are `a`, `b` `c`."))
    assert is_numeric("It takes 1 s, 2 s or 3 s.")
    assert not is_numeric("It takes 1e-3 s or 2.5 s.")
    assert count_words("It takes three seconds.") == 4
    block = "<!-- speeds -->\n\n| a |\n\n{}\n\n<!-- end of speeds -->"
    source = "Command: `x`; commit: `y`; machine: z; date: `2026-01-01`."
    assert find_blocks_without_source(block.format("")) == ["speeds"]
    assert not find_blocks_without_source(block.format(source))
    header = ["damping", "friction", "starts", "left"]
    table = "| " + " | ".join(header) + " |\n|---|---|---|---|\n| 1 | 2 | 3 | 4 |"
    changed_block = f"<!-- bouncing -->\n\n{table}\n\n<!-- end of bouncing -->"
    assert find_blocks_unlike_their_table(changed_block) == ["bouncing"]
    assert split_sentences("One is here now. Two are\nthere now.\n\n- Three are in a list.") == [
        "One is here now.",
        "Two are there now.",
        "Three are in a list.",
    ]

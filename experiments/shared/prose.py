"""Report where pages and docstrings depart from the rules of their language in CONTRIBUTING.md.

    python -m experiments.shared.prose [PATH ...]

Without PATH, the report covers README.md, `docs/` and the docstrings of `vrw_jax/`. Each line names
a file and what a reader should check. The report is no gate, because names, formulas and
quotations give false findings. proselint adds the rules of style guides.
"""

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path

from experiments.shared.command import make_parser, require_extra

ROOT = Path(__file__).parents[2]
MAX_PAGE_WORDS = 1500
MAX_SENTENCE_NUMBERS = 2
"""Numbers of a sentence beyond which a table is clearer."""
MAX_SENTENCE_WORDS = 40
"""The rule is 25; a machine counts a list or a formula as one sentence."""

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


def strip_markup(text: str) -> str:
    """Return the prose of a page: no code, comments, tables or headings; links by their text."""
    text = re.sub(r"```.*?```", " ", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", " ", text, flags=re.DOTALL)
    text = re.sub(r"^\s*[|#].*$", " ", text, flags=re.MULTILINE)
    text = re.sub(r"\$\$?[^$]*\$\$?", " x ", text)
    text = re.sub(r"`[^`]*`", " x ", text)
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)


def split_sentences(prose: str) -> list[str]:
    """Return sentences of more than three words."""
    without_bullets = re.sub(r"^\s*(?:[-*]|\d+\.) ", "\n", prose, flags=re.MULTILINE)
    parts = re.split(r"(?<=[.;:!?])\s+|\n\s*\n", without_bullets)
    sentences = [" ".join(part.split()) for part in parts]
    return [sentence for sentence in sentences if len(sentence.split()) > 3]


def read_docstrings(module: Path) -> str:
    """Return the docstrings of a module, of its classes and of its functions."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [n for n in ast.walk(ast.parse(module.read_text())) if isinstance(n, documented)]
    return "\n\n".join(filter(None, map(ast.get_docstring, nodes)))


def find_disliked_phrases(prose: str) -> Iterator[str]:
    """Yield findings of proselint, except repeated placeholders of formulas."""
    from proselint.config import DEFAULT, Config
    from proselint.tools import LintFile

    # Typography is off, because pages and docstrings are written in ASCII quotes and dots.
    config = Config(max_errors=1000, checks={**DEFAULT["checks"], "typography": False})
    lint_file = LintFile("prose", prose)
    for found in lint_file.lint(config):
        phrase = lint_file.content[slice(*found.check_result.span)]
        if "x" not in phrase.split():
            yield f"{phrase!r}: {found.check_result.message}"


def find_departures(path: Path) -> Iterator[str]:
    """Yield the departures of a page, or of the docstrings of a module, from the rules."""
    is_page = path.suffix == ".md"
    prose = strip_markup(path.read_text() if is_page else read_docstrings(path))
    yield from find_disliked_phrases(prose)
    if not is_page:
        return
    n_words = len(re.findall(r"[A-Za-z][\w'’-]*", prose))
    if n_words > MAX_PAGE_WORDS:
        yield f"{n_words} words, more than {MAX_PAGE_WORDS}"
    for pattern, better in FORBIDDEN_WORDS.items():
        for word in re.findall(rf"\b(?:{pattern})\b", prose, re.IGNORECASE):
            yield f"{word!r}: write {better}"
    for sentence in split_sentences(prose):
        if len(re.findall(r"\d[\d.,]*(?:e-?\d+)?", sentence)) > MAX_SENTENCE_NUMBERS:
            yield f"more than {MAX_SENTENCE_NUMBERS} numbers: {sentence}"
        if len(sentence.split()) > MAX_SENTENCE_WORDS:
            yield f"more than {MAX_SENTENCE_WORDS} words: {sentence}"


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("paths", type=Path, nargs="*", metavar="PATH")
    paths = parser.parse_args().paths or [ROOT / "README.md", ROOT / "docs", ROOT / "vrw_jax"]
    require_extra("proselint")
    from proselint import checks
    from proselint.registry import CheckRegistry

    CheckRegistry().register_many(checks.__register__)
    files = [
        file for path in paths for file in (sorted(path.rglob("*")) if path.is_dir() else [path])
    ]
    n_departures = 0
    for file in files:
        if file.suffix in (".md", ".py"):
            for departure in find_departures(file):
                print(f"{os.path.relpath(file)}: {departure}")
                n_departures += 1
    print(f"{n_departures} departures")


if __name__ == "__main__":
    main()

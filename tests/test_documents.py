"""What documents and comments name exists: files, commands, modules."""

import ast
import json
import re
import subprocess
import sys
import unicodedata
from pathlib import Path

import pytest
from support.package_graph import ImportGraph

from experiments.shared.tables import FIGURES, format_markdown, read_table, shorten_number

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.ipynb")]
)
SOURCES = [
    path
    for folder in ("vrw_jax", "experiments", "tests")
    for path in (ROOT / folder).rglob("*.py")
    if path != Path(__file__)
]
FILE_PATTERN = re.compile(r"\b((?:tests|vrw_jax|experiments|configs)/[\w/]+(?:\.\w+)?)")
SCRIPT_PATTERN = re.compile(r"\b(experiments(?:\.[a-z0-9_]+)+)(?<!\.py)")
IMPORT_GRAPH = ImportGraph(ROOT / "vrw_jax")
PLACE_PATTERN = re.compile(rf"`((?:{'|'.join(IMPORT_GRAPH.packages)})/[a-z_/]+)(?:\.(\w+))?[\w.]*`")
MODULE_PATTERN = re.compile(r"(?:from|import|`)\s*(vrw_jax(?:\.[a-z_]+)+)")


def find_missing_paths(text):
    """Places that a text names and that are not there."""
    modules = {
        name.replace(".", "/")
        for name in SCRIPT_PATTERN.findall(text) + MODULE_PATTERN.findall(text)
    }
    for place in {*FILE_PATTERN.findall(text), *modules}:
        path = ROOT / place
        if not (path.exists() or path.with_suffix(".py").exists()):
            yield place


def find_unknown_names(text):
    """Modules and names in them, `package/module.name`, that do not exist."""
    for module, name in PLACE_PATTERN.findall(text.replace(".py`", "`")):
        dotted = "vrw_jax." + module.replace("/", ".")
        if dotted not in IMPORT_GRAPH.paths:
            yield module
        elif name and name not in iterate_bound_names(IMPORT_GRAPH.trees[dotted]):
            yield f"{module}.{name}"


def iterate_bound_names(tree):
    """Names that a module binds, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_document_names_only_existing_files(path):
    assert not sorted(
        {*find_missing_paths(path.read_text()), *find_unknown_names(path.read_text())}
    )


def test_sources_name_only_existing_files():
    found_by_name = {
        str(path.relative_to(ROOT)): sorted(find_missing_paths(path.read_text()))
        for path in SOURCES
    }
    assert not {path: places for path, places in found_by_name.items() if places}


def test_names_of_missing_files_are_found():
    text = "`tests/test_gone.py`, `python -m experiments.gone`, `from vrw_jax.gone import x`"
    assert len(list(find_missing_paths(text))) == 3
    assert list(find_unknown_names("`wheel/gone`, `wheel/params.gone`")) == [
        "wheel/gone",
        "wheel/params.gone",
    ]
    assert not list(
        find_unknown_names("`wheel/params.WheelParams.symbols`, `wheel`, `wheel/params`")
    )
    assert not list(
        find_missing_paths("`tests/test_documents.py`, `from vrw_jax.wheel import x`, configs/")
    )


def test_the_architecture_page_lists_every_package_in_import_order():
    text = (ROOT / "docs" / "architecture.md").read_text()
    assert tuple(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == IMPORT_GRAPH.packages


LINK_PATTERN = re.compile(r"\]\((?!https?:|mailto:)([^)\s#]*)(?:#([^)\s]+))?\)")


def read_markdown(path):
    """Return the text of a page, or that of a notebook's text cells."""
    if path.suffix == ".md":
        return path.read_text()
    cells = json.loads(path.read_text())["cells"]
    return "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")


PAGES_WITHOUT_CODE = {
    path: re.sub(r"```.*?```|`[^`\n]*`", "", read_markdown(path), flags=re.DOTALL)
    for path in DOCUMENTS
}
"""Text of each page without code, whose brackets are no links."""


def list_anchors(path):
    """Return the anchors of a page's headings, as the site makes them."""
    headings = re.findall(r"^#+ +(.*?) *$", read_markdown(path), re.MULTILINE)
    ascii_headings = [
        unicodedata.normalize("NFKD", heading).encode("ascii", "ignore").decode()
        for heading in headings
    ]
    plain = [re.sub(r"[^\w\s-]", "", heading).strip() for heading in ascii_headings]
    return {re.sub(r"[-\s]+", "-", heading.lower()) for heading in plain}


def find_broken_links(path):
    """Links of a page to files or headings that are not in the checkout."""
    for place, anchor in LINK_PATTERN.findall(PAGES_WITHOUT_CODE[path]):
        target = path.parent / place if place else path
        is_page = target.suffix in (".md", ".ipynb")
        if not target.exists() or (
            anchor and is_page and anchor.lower() not in list_anchors(target)
        ):
            yield f"{place}#{anchor}" if anchor else place


@pytest.mark.parametrize("path", PAGES_WITHOUT_CODE, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_of_a_page_leads_somewhere_in_a_checkout(path):
    assert not list(find_broken_links(path))


def test_a_broken_link_is_found(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("# A b-c\n[x](gone.md) [y](page.md#a-b-c) [z](#gone)")
    monkeypatch.setitem(PAGES_WITHOUT_CODE, page, page.read_text())
    assert list(find_broken_links(page)) == ["gone.md", "#gone"]


def test_a_broken_link_of_the_built_site_is_found(tmp_path):
    from website.links import find_broken_links

    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "index.html").write_text(
        '<h1 id="x">A</h1> <a href="#x">1</a> <a href="../b.html#y z">2</a> <a href="./">3</a>'
        '<a href="gone.html">4</a> <a href="#gone">5</a> <a href="https://example.org">6</a>'
    )
    (tmp_path / "b.html").write_text(
        '<h2 id="y z">B</h2> <img src="gone.png"> <a href="a/#x">1</a>'
    )
    broken = [f"a/index.html: {link}" for link in ("gone.html", "#gone")] + ["b.html: gone.png"]
    assert list(find_broken_links(tmp_path)) == broken


@pytest.mark.slow
def test_every_link_of_the_built_site_leads_somewhere():
    pytest.importorskip("zensical")
    command = [sys.executable, "-m", "website", "--stored"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


BLOCK = re.compile(r"<!-- (?!end of|runs elsewhere)([^\n]*?) -->(.*?)<!-- end of \1 -->", re.DOTALL)
UNMEASURED_BLOCKS = {"functions and models"}
SOURCE_LINE = re.compile(r"Command: .+; commit: .+; machine: .+; date: .+\.$")


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


@pytest.mark.parametrize(
    "page",
    [path for path in DOCUMENTS if path.suffix == ".md"],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_a_measured_block_shows_stored_numbers_and_names_its_run(page):
    assert not find_blocks_without_source(page.read_text())
    assert not find_blocks_unlike_their_table(page.read_text())


def test_a_measured_block_without_source_or_with_other_numbers_is_found():
    block = "<!-- speeds -->\n\n| a |\n\n{}\n\n<!-- end of speeds -->"
    source = "Command: `x`; commit: `y`; machine: z; date: `2026-01-01`."
    assert find_blocks_without_source(block.format("")) == ["speeds"]
    assert not find_blocks_without_source(block.format(source))
    header = ["damping", "friction", "starts", "left"]
    table = "| " + " | ".join(header) + " |\n|---|---|---|---|\n| 1 | 2 | 3 | 4 |"
    changed_block = f"<!-- bouncing -->\n\n{table}\n\n<!-- end of bouncing -->"
    assert find_blocks_unlike_their_table(changed_block) == ["bouncing"]


@pytest.mark.parametrize("name", ["toml", "measures"])
def test_a_generated_page_agrees_with_the_sources(name):
    """If this fails: `python -m website --pages`."""
    from website import reference

    page = ROOT / "docs" / "reference" / f"{name}.md"
    assert page.read_text() == getattr(reference, f"{name}_page")()


def test_the_readme_is_short_and_its_figures_are_measured():
    text = (ROOT / "README.md").read_text()
    assert 500 <= len(re.findall(r"[A-Za-z][\w'’-]*", text)) <= 700
    measured = (ROOT / "docs" / "benchmarks" / "cycles.md").read_text()
    table = text.partition("## Performance")[2].partition("\n\n`")[0]
    times = re.findall(r"\| ([\d.]+) (?:s|ms|µs) \|", table)
    assert len(times) == 4
    for value in times:
        assert f"| {value} |" in measured


def test_every_page_is_in_the_navigation():
    text_read = (ROOT / "zensical.toml").read_text()
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")]
    assert [page for page in pages if f'"{page}"' not in text_read] == []


def test_every_formula_of_the_measures_page_is_recognized():
    pytest.importorskip("latex2mathml", reason="formulas become MathML by it")
    from website.formulas import INLINE
    from website.reference import measures_page

    page = measures_page()
    assert page.count("$") == 2 * len(re.findall(INLINE, page)) > 0


def test_the_sites_of_releases_are_kept_and_the_newest_opens_first(tmp_path):
    from website.releases import add_release

    site, folder = tmp_path / "site", tmp_path / "releases"
    site.mkdir()
    for version in ("0.9.0", "0.10.0", "0.2.0", "0.9.0"):
        (site / "index.html").write_text(version)
        add_release(site, folder, version)
    releases = json.loads((folder / "versions.json").read_text())
    assert [release["version"] for release in releases] == ["0.10.0", "0.9.0", "0.2.0"]
    assert [release["aliases"] for release in releases] == [["latest"], [], []]
    assert "0.10.0/index.html" in (folder / "index.html").read_text()
    assert all((folder / v / "index.html").read_text() == v for v in ("0.2.0", "0.9.0", "0.10.0"))
    with pytest.raises(ValueError, match="the version is main, but a released site needs numbers"):
        add_release(site, folder, "main")

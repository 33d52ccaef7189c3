"""What documents and comments name exists: files, commands, modules."""

import ast
import re
from pathlib import Path

import pytest
from support.rooms import House

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
FILE = re.compile(r"\b((?:tests|vrw_jax|experiments|configs)/[\w/]+(?:\.\w+)?)")
SCRIPT = re.compile(r"\b(experiments(?:\.[a-z0-9_]+)+)(?<!\.py)")
HOUSE = House(ROOT / "vrw_jax")
PLACE = re.compile(rf"`((?:{'|'.join(HOUSE.rooms)})/[a-z_/]+)(?:\.(\w+))?[\w.]*`")
MODULE = re.compile(r"(?:from|import|`)\s*(vrw_jax(?:\.[a-z_]+)+)")


def missing(text):
    """Places that a text names and that are not there."""
    modules = {name.replace(".", "/") for name in SCRIPT.findall(text) + MODULE.findall(text)}
    for place in {*FILE.findall(text), *modules}:
        path = ROOT / place
        if not (path.exists() or path.with_suffix(".py").exists()):
            yield place


def unknown(text):
    """Modules and names in them, `room/module.name`, that are not there."""
    for module, name in PLACE.findall(text.replace(".py`", "`")):
        dotted = "vrw_jax." + module.replace("/", ".")
        if dotted not in HOUSE.paths:
            yield module
        elif name and name not in bound(HOUSE.trees[dotted]):
            yield f"{module}.{name}"


def bound(tree):
    """Names that a module binds, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_document_names_what_is_there(path):
    assert not sorted({*missing(path.read_text()), *unknown(path.read_text())})


def test_sources_name_what_is_there():
    found = {str(path.relative_to(ROOT)): sorted(missing(path.read_text())) for path in SOURCES}
    assert not {path: places for path, places in found.items() if places}


def test_what_is_not_there_is_seen():
    text = "`tests/test_gone.py`, `python -m experiments.gone`, `from vrw_jax.gone import x`"
    assert len(list(missing(text))) == 3
    assert list(unknown("`wheel/gone`, `wheel/params.gone`")) == ["wheel/gone", "wheel/params.gone"]
    assert not list(unknown("`wheel/params.WheelParams.symbols`, `wheel`, `wheel/params`"))
    assert not list(missing("`tests/test_documents.py`, `from vrw_jax.wheel import x`, configs/"))


def test_the_page_of_the_house_tells_every_room_in_the_flow_s_order():
    text = (ROOT / "docs" / "architecture.md").read_text()
    assert tuple(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) == HOUSE.rooms


def test_every_page_is_in_the_navigation():
    told = (ROOT / "zensical.toml").read_text()
    pages = [page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")]
    assert [page for page in pages if f'"{page}"' not in told] == []


def test_every_formula_of_the_measures_page_is_seen_as_one():
    pytest.importorskip("latex2mathml", reason="formulas become MathML by it")
    from website.formulas import INLINE
    from website.reference import measures_page

    page = measures_page()
    assert page.count("$") == 2 * len(re.findall(INLINE, page)) > 0

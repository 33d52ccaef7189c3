"""Builds the site: `python -m website`, or with `--stored` without executing the notebooks."""

import argparse
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from website.notebooks import page_of
from website.reference import measures_page, toml_page

ROOT = Path(__file__).parent.parent
PAGES, SITE = ROOT / "build" / "pages", ROOT / "build" / "site"
MOVED = {"README.md": "start/readme.md", "CHANGELOG.md": "start/changelog.md"}
MOVED |= {"CONTRIBUTING.md": "start/contributing.md", "CODE_OF_CONDUCT.md": "start/conduct.md"}
LINK = re.compile(r"(\]\()(?!https?:|#)([^)#\s]+)")


def prepare(*, execute: bool) -> None:
    """Every page in `build/pages`: those of docs/, of the sources, and the notebooks' own."""
    shutil.rmtree(PAGES, ignore_errors=True)
    shutil.copytree(ROOT / "docs", PAGES, ignore=shutil.ignore_patterns("*.ipynb"))
    for name, page in MOVED.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        (PAGES / page).write_text(LINK.sub(_relinked, text), encoding="utf-8")
    for name, text in (("toml", toml_page()), ("measures", measures_page())):
        (PAGES / "reference" / f"{name}.md").write_text(text, encoding="utf-8")
    (PAGES / "notebooks").mkdir(exist_ok=True)
    for notebook in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        page_of(notebook, PAGES / "notebooks", execute=execute)


def _relinked(found: re.Match[str]) -> str:
    """A link of a page of the root, as its place below start/ sees it."""
    place = found[2]
    if place in MOVED:
        return found[1] + Path(MOVED[place]).name
    return found[1] + "../" + place.removeprefix("docs/")


def configuration() -> Path:
    """`zensical.toml` with the address of the sources, where VRW_SOURCE_URL gives one."""
    text, url = (ROOT / "zensical.toml").read_text(), os.environ.get("VRW_SOURCE_URL")
    if url:
        text = text.replace(
            "[project]", f'[project]\nrepo_url = "{url}"\nedit_uri = "blob/HEAD/docs/"'
        )
        text = text.replace("features = [", 'features = [\n  "content.action.edit",')
    path = ROOT / "build" / "zensical.toml"
    path.write_text(text.replace('"build/', '"').replace('paths = ["."]', f'paths = ["{ROOT}"]'))
    return path


def main() -> int:
    """Prepares and builds; any warning is an error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stored", action="store_true", help="show the notebooks as stored")
    prepare(execute=not parser.parse_args().stored)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    return subprocess.run([*command, "-f", str(configuration())], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())

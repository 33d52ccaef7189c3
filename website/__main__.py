"""Build the site: `python -m website`, or with `--stored` without executing the notebooks.

With `--pages` only write the pages of `docs/reference` that are generated from the sources. With
`--release FOLDER` also copy the site to FOLDER/VERSION, beside the sites of earlier releases.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

from website.links import find_broken_links
from website.notebooks import page_of
from website.reference import measures_page, toml_page
from website.releases import add_release

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = ROOT / "build" / "pages"
SITE = ROOT / "build" / "site"
ROOT_PAGES = {
    "CHANGELOG.md": "developer/changelog.md",
    "CONTRIBUTING.md": "developer/contributing.md",
    "CODE_OF_CONDUCT.md": "developer/conduct.md",
}
"""Places in the site of the pages in the checkout's root."""
GENERATED_PAGES = {"reference/toml.md": toml_page, "reference/measures.md": measures_page}
"""Pages in `docs` that are generated from the sources, so that a checkout shows them too."""
LINK_PATTERN = re.compile(r"(\]\()(?!https?:|#|mailto:)([^)#\s]+)")
"""A link to a file, in two groups: what precedes the path, and the path."""


def write_generated_pages() -> None:
    """Write the pages in `docs` that are generated from the sources, where they have changed."""
    for place, generate_page in GENERATED_PAGES.items():
        page = generate_page()
        if (DOCS / place).read_text(encoding="utf-8") != page:
            (DOCS / place).write_text(page, encoding="utf-8")


def prepare(*, execute: bool) -> None:
    """Write every page into `build/pages`: those of docs/, of the root, and of the notebooks."""
    write_generated_pages()
    shutil.rmtree(PAGES, ignore_errors=True)
    shutil.copytree(DOCS, PAGES, ignore=shutil.ignore_patterns("*.ipynb"))
    for notebook in sorted((DOCS / "notebooks").glob("*.ipynb")):
        (PAGES / "notebooks").mkdir(exist_ok=True)
        page_of(notebook, PAGES / "notebooks", execute=execute)
    for source in [*DOCS.rglob("*.md"), *map(ROOT.joinpath, ROOT_PAGES)]:
        text = source.read_text(encoding="utf-8")
        relink = lambda match, source=source: match[1] + translate_link(source, match[2])
        place_in_pages(source).parent.mkdir(exist_ok=True)
        place_in_pages(source).write_text(LINK_PATTERN.sub(relink, text), encoding="utf-8")


def place_in_pages(source: Path) -> Path:
    """Return where a file of the checkout is in `build/pages`."""
    if source.is_relative_to(DOCS):
        place = PAGES / source.relative_to(DOCS)
        return place.with_suffix(".md") if place.suffix == ".ipynb" else place
    relative = source.relative_to(ROOT).as_posix()
    return PAGES / ROOT_PAGES.get(relative, f"../../{relative}")


def translate_link(source: Path, link: str) -> str:
    """Return a link of a checkout's page as the page in the site needs it."""
    target = Path(os.path.normpath(source.parent / link))
    if not target.is_relative_to(ROOT):
        return link
    return os.path.relpath(place_in_pages(target), place_in_pages(source).parent)


def configuration(*, is_release: bool) -> Path:
    """Write the configuration of the site and return its path.

    The footer of each page states the versions of the libraries that the pages describe. The pages
    of a release offer a choice of releases. If VRW_SOURCE_URL is set, the pages link to the sources
    at this address.
    """
    text, url = (ROOT / "zensical.toml").read_text(), os.environ.get("VRW_SOURCE_URL")
    versions = ", ".join(f"{name} {version(name)}" for name in ("vrw-jax", "jax", "diffrax"))
    text = text.replace("[project]", f'[project]\ncopyright = "Built with {versions}."', 1)
    if url:
        text = text.replace(
            "[project]", f'[project]\nrepo_url = "{url}"\nedit_uri = "blob/HEAD/docs/"'
        )
        text = text.replace("features = [", 'features = [\n  "content.action.edit",')
    if is_release:  # The theme then reads versions.json, whose format is that of mike.
        text += '\n[project.extra.version]\nprovider = "mike"\n'
    path = ROOT / "build" / "zensical.toml"
    path.write_text(text.replace('"build/', '"').replace('paths = ["."]', f'paths = ["{ROOT}"]'))
    return path


def main() -> int:
    """Prepare and build the site; any warning or broken link is an error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stored", action="store_true", help="show the notebooks as stored")
    parser.add_argument("--pages", action="store_true", help="only write the generated pages")
    parser.add_argument("--release", type=Path, metavar="FOLDER", help="add the site to FOLDER")
    arguments = parser.parse_args()
    if arguments.pages:
        write_generated_pages()
        return 0
    prepare(execute=not arguments.stored)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    configuration_path = configuration(is_release=arguments.release is not None)
    status = subprocess.run([*command, "-f", str(configuration_path)], cwd=ROOT, check=False)
    broken_links = list(find_broken_links(SITE))
    for link in broken_links:
        print(f"Broken link on {link}")
    if status.returncode == 0 and not broken_links:
        print(f"The site is in {SITE}. Open {SITE / 'index.html'} in a browser, or serve it, with")
        print(f"its search, by: python -m http.server --directory {SITE.relative_to(ROOT)}")
        if arguments.release is not None:
            project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
            add_release(SITE, arguments.release, project["version"])
            print(f"The release is in {arguments.release / project['version']}.")
    return status.returncode or bool(broken_links)


if __name__ == "__main__":
    sys.exit(main())

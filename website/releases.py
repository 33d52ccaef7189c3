"""Write the site of a release beside the sites of earlier releases."""

import json
import re
import shutil
from pathlib import Path

REDIRECT_PAGE = """<!doctype html>
<meta charset="utf-8">
<meta http-equiv="refresh" content="0; url={version}/index.html">
<title>vrw_jax</title>
<a href="{version}/index.html">vrw_jax {version}</a>
"""


def parse_version(text: str) -> tuple[int, ...] | None:
    """Return the numbers of a version such as 0.2.0, or None for other text."""
    return tuple(map(int, text.split("."))) if re.fullmatch(r"\d+(\.\d+)*", text) else None


def add_release(site: Path, folder: Path, release_version: str) -> None:
    """Copy `site` to the subfolder of `folder` that has the release's version as its name.

    A site of the same version is replaced. `folder/versions.json` lists all releases in the folder,
    newest first; each page reads this file to offer a choice of releases. `folder/index.html` opens
    the newest release.

    Raises:
        ValueError: if the version contains anything other than numbers and dots.
    """
    if parse_version(release_version) is None:
        raise ValueError(
            f"the version is {release_version}, but a released site needs numbers and dots, as in "
            "0.2.0: set the version in pyproject.toml and install the package again."
        )
    shutil.rmtree(folder / release_version, ignore_errors=True)
    shutil.copytree(site, folder / release_version)
    released_versions = sorted(
        (path.name for path in folder.iterdir() if path.is_dir() and parse_version(path.name)),
        key=lambda name: parse_version(name) or (),
        reverse=True,
    )
    newest_version = released_versions[0]
    entries = [
        {"version": name, "title": name, "aliases": ["latest"] if name == newest_version else []}
        for name in released_versions
    ]
    (folder / "versions.json").write_text(json.dumps(entries, indent=2) + "\n")
    (folder / "index.html").write_text(REDIRECT_PAGE.format(version=newest_version))

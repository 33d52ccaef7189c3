"""README.md for the package index, where links into the sources lead nowhere."""

import os
import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[((?:!\[[^\]]*\]\([^)]*\)|[^\]])*)\]\((?!https?:|#)([^)]+)\)")
"""A link, whose label may be an image."""


def for_index(text: str, url: str) -> str:
    """The text with links and images below `url`; without one, links as text and no images."""

    def absolute(found: re.Match[str]) -> str:
        image, label, path = found.groups()
        label = LINK.sub(absolute, label)
        if url:
            kind = "raw" if image else "blob"
            return f"{image}[{label}]({url.rstrip('/')}/{kind}/HEAD/{path})"
        return "" if image else label

    return LINK.sub(absolute, text)


class Readme(MetadataHookInterface):
    """Called by hatchling when the package is built."""

    def update(self, metadata: dict) -> None:
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        url = os.environ.get("VRW_SOURCE_URL") or self.config.get("source-url", "")
        metadata["readme"] = {"content-type": "text/markdown", "text": for_index(text, url)}
        if url:
            metadata["urls"] = {"Source": url}

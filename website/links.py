"""Links between the pages of the built site."""

import html
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote

LINK_PATTERN = re.compile(r'\b(?:href|src)="([^"]+)"')
ANCHOR_PATTERN = re.compile(r'\b(?:id|name)="([^"]+)"')
EXTERNAL_PATTERN = re.compile(r"[a-z]+:|//")
"""Start of a link that leaves the site, such as `https:`, `data:` or `mailto:`."""
UNCHECKED_PAGES = {"404.html", "wheel.html"}
"""Pages whose links are absolute, or made by their scripts."""


def find_broken_links(site: Path) -> Iterator[str]:
    """Yield `page: link` for each link to a file or an anchor that the site does not contain."""
    for page in sorted(site.rglob("*.html")):
        if page.name not in UNCHECKED_PAGES:
            for link in _list_links(page):
                path, _, anchor = link.partition("#")
                target = page.parent / path.partition("?")[0] if path else page
                if target.is_dir():
                    target /= "index.html"
                is_missing = not target.exists()
                if is_missing or (anchor and anchor not in _list_anchors(target.resolve())):
                    yield f"{page.relative_to(site)}: {link}"


def _list_links(page: Path) -> list[str]:
    text = re.sub(r"<script.*?</script>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = [unquote(html.unescape(link)) for link in LINK_PATTERN.findall(text)]
    return [link for link in links if not EXTERNAL_PATTERN.match(link)]


@cache
def _list_anchors(page: Path) -> frozenset[str]:
    if page.suffix != ".html":
        return frozenset()
    anchors = ANCHOR_PATTERN.findall(page.read_text(encoding="utf-8"))
    return frozenset(html.unescape(anchor) for anchor in anchors)

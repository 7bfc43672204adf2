"""Check a built site: its links lead somewhere, and its pages fetch nothing from elsewhere."""

import os
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ADDRESSES = {"href", "poster", "src"}
"""Attributes that hold an address."""


class Page(HTMLParser):
    """A page.

    Attributes:
        anchors: Its anchors; the empty one is its beginning.
        links: Addresses, each with whether a browser fetches it without being asked.
    """

    def __init__(self, path: Path) -> None:
        """Read a page."""
        super().__init__()
        self.anchors, self.links = {""}, set[tuple[str, bool]]()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Add what a tag has."""
        values = {name: value for name, value in attrs if value}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.links |= {(values[name], tag != "a") for name in ADDRESSES & values.keys()}


def problems(site: Path) -> Iterator[str]:
    """Yield links of a site that lead nowhere, and what it fetches from other hosts."""
    pages = {path: Page(path) for path in site.rglob("*.html")}
    for path, page in pages.items():
        name = path.relative_to(site)
        for link, is_fetched in page.links:
            address = urlsplit(link)
            if address.scheme or address.netloc:
                if is_fetched and address.scheme != "data":
                    yield f"{name}: fetches {link}"
                continue
            folder = site if address.path.startswith("/") else path.parent
            target = Path(os.path.normpath(folder / unquote(address.path).lstrip("/")))
            target = target if address.path else path
            if not target.is_file():
                yield f"{name}: {link} does not exist"
            elif target in pages and unquote(address.fragment) not in pages[target].anchors:
                yield f"{name}: {link} is no anchor"
    for path in site.rglob("*.css"):
        text = path.read_text(encoding="utf-8")
        for link in re.findall(r"(?:url\(|@import )['\"]?((?:https?:)?//[^)'\"]*)", text):
            yield f"{path.relative_to(site)}: fetches {link}"

"""Fenced blocks of the documentation: their language, their text, and whether they run."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.helpers import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(
    r"(?:<!-- not run: ([^\n]*?) -->\n)?"
    r"^```(\w*)(?: title=\"([\w.-]+)\")?[^\n]*\n(.*?)^```",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: Name of its page.
        line: Line of the page that it begins in.
        language: What stands after the fence.
        file: Name of the file that a reader saves it as; empty where it is none.
        text: Its lines.
        not_run: Why it is not run, as a comment before it says; empty where it is.
    """

    page: str
    line: int
    language: str
    file: str
    text: str
    not_run: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks_of(page: Path) -> list[Block]:
    """Return the blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(
            page.name, text.count("\n", 0, found.start()) + 1, found[2], found[3] or "", found[4],
            found[1] or "",
        )
        for found in FENCE.finditer(text)
    ]  # fmt: skip


def commands(text: str) -> Iterator[str]:
    """Yield the command lines of a block; quotes may hold several lines."""
    pending = ""
    for line in text.replace("\\\n", " ").splitlines():
        pending = f"{pending} {line.strip()}".strip()
        try:
            shlex.split(pending, comments=True)
        except ValueError:  # a quote is open
            continue
        yield pending
        pending = ""
    assert not pending, pending


BLOCKS = [block for page in PAGES for block in blocks_of(page)]

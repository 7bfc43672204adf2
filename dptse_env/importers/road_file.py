"""The road file of an import, with several numbers on a line."""

import os
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.roads import write_corridor
from dptse_env.utils.files import write_atomically

WIDTH = 100
_NUMBERS = re.compile(r"^(.*)\[\n((?: +[^\s\"'\[\]]+,\n)+) *\]", re.MULTILINE)
_PAIRS = re.compile(r"^(.*)\[\n((?: +\[[^\n\"'\[\]]*\],\n)+) *\]", re.MULTILINE)


def write_road(
    path: str | os.PathLike[str],
    corridor: Corridor,
    environment: Mapping[str, Any] | None = None,
    comment: str = "",
) -> None:
    """Write a road file as `write_corridor` does, with arrays of numbers in few lines."""
    write_corridor(path, corridor, environment, comment)
    text = Path(path).read_text(encoding="utf-8")
    write_atomically(path, _PAIRS.sub(_joined, _NUMBERS.sub(_joined, text)))


def _joined(found: re.Match[str]) -> str:
    """Return an array in one line, or folded."""
    before, body = found.groups()
    entries = [line.strip().removesuffix(",") for line in body.splitlines()]
    if len(line := f"{before}[{', '.join(entries)}]") < WIDTH:
        return line
    whole = (entry.replace(" ", "\0") for entry in entries)
    folded = textwrap.fill(
        ", ".join(whole), WIDTH, initial_indent="    ", subsequent_indent="    ",
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
    return f"{before}[\n{folded},\n]".replace("\0", " ")

"""JSON files, complete or not there, and refusals to write over others."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from dptse_env.utils.files import write_atomically


def refuse_to_replace(paths: Iterable[Path], force: bool) -> None:
    """Refuse to write over what an earlier run left, unless that is wanted.

    Programs that go on where they stopped do not ask.

    Args:
        paths: Files that are going to be written.
        force: Whether they may be replaced.

    Raises:
        FileExistsError: One is there, and it may not be replaced.
    """
    there = [str(path) for path in paths if path.exists()]
    if there and not force:
        raise FileExistsError(
            f"{', '.join(there)} would be replaced: choose another --output, or give --force"
        )


def write_json(path: Path, content: Any) -> None:
    """Write plain values as indented JSON in one piece.

    Raises:
        OSError: The file cannot be written; the old one stays.
        ValueError: A number is not finite.
    """
    write_atomically(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def first_difference(kept: Any, now: Any, path: str = "") -> str | None:
    """Return in words the first value in which two plain contents differ; None if they agree."""
    if isinstance(kept, Mapping) and isinstance(now, Mapping):
        for key in {**now, **kept}:
            below = f"{path}.{key}" if path else str(key)
            found = first_difference(kept.get(key), now.get(key), below)
            if found is not None:
                return found
        return None
    return None if kept == now else f"{path} is {kept!r} there and {now!r} now"

"""JSON files, complete or not there, and what two of them differ in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dptse_env.utils.files import write_atomically


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

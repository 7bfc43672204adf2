"""JSON files, complete or not there, and the plans of folders in which a command goes on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dptse_env.utils.files import require_output, write_atomically
from dptse_env.utils.validation import read_json, require


def write_json(path: Path, content: Any) -> None:
    """Write plain values as indented JSON in one piece.

    Raises:
        OSError: The file cannot be written; the old one stays.
        ValueError: A number is not finite.
    """
    write_atomically(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


PLAN = "plan.json"
"""File of what the results in a folder depend on."""

FORMAT = 5
"""Format of such folders; raise it whenever their content changes its meaning."""


def keep_plan(folder: Path, plan: Mapping[str, Any]) -> None:
    """Keep what results depend on in their folder, which is made if it is missing.

    Args:
        folder: The folder.
        plan: Plain JSON.

    Raises:
        ValueError: As `check_plan`.
        OSError: The folder cannot be written.
    """
    check_plan(folder, plan)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / PLAN, {"format": FORMAT, **plan})


def check_plan(folder: Path, plan: Mapping[str, Any]) -> None:
    """Check that a command can begin in a folder, or go on there.

    Raises:
        ValueError: The folder has the results of another plan, or something else, or cannot be
            written.
    """
    require_output(folder, own=[PLAN])
    path = folder / PLAN
    if not path.exists():
        return
    kept = read_json(path)
    require(isinstance(kept, dict), str(path), "a plan", kept)
    difference = _first_difference(kept, {"format": FORMAT, **plan})
    if difference is not None:
        raise ValueError(
            f"{folder} has the results of another plan: {difference}. Choose another --output, or "
            "remove the folder to start over"
        )


def _first_difference(kept: Any, now: Any, path: str = "") -> str | None:
    """Return in words the first value in which two plain contents differ; None if they agree."""
    if isinstance(kept, Mapping) and isinstance(now, Mapping):
        for key in {**now, **kept}:
            below = f"{path}.{key}" if path else str(key)
            found = _first_difference(kept.get(key), now.get(key), below)
            if found is not None:
                return found
        return None
    return None if kept == now else f"{path} is {kept!r} there and {now!r} now"

"""The result of a fit in the road file: its table ``environment``, with all else as it stands."""

from __future__ import annotations

import copy
import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit

from agents.fitting.road import CHOSEN
from dptse_env.utils.files import write_atomically

TABLE, DWELL, MEASURED = "environment", "average_dwell", "measured"


def copy_of(path: Path) -> Path:
    """Return where the copy of a road file is kept, for a link beside the file."""
    path = Path(os.path.realpath(path))
    return path.with_name(f"{path.stem}.before-fit{path.suffix}")


def write_choice(
    path: Path, keywords: Mapping[str, Any], dwell: float | None, *, of_records: bool
) -> bool:
    """Put keywords into the table of a road file, and keep a copy of the file as it was.

    Comments, order and all other values stay. Of the keywords that a fit decides, those that are
    not given go.

    Args:
        path: The road file.
        keywords: Keywords of an environment.
        dwell: Average dwell [s] of a file that has none; None to leave it as it is.
        of_records: Whether all of this depends on vehicles that files have. Its names then stand
            under ``measured``, which voids the guarantee.

    Returns:
        Whether the file is another one now.

    Raises:
        OSError: It cannot be written; it stays as it was.
        ValueError: The table cannot be changed where it stands; the message has what to add.
    """
    text = path.read_bytes().decode("utf-8")
    expected = tomllib.loads(text)
    measured = list(expected.get(MEASURED, ()))
    if of_records:
        named = [*measured, *([] if dwell is None else [DWELL]), *keywords]
        measured = list(dict.fromkeys(named))
    if measured:
        expected[MEASURED] = measured
    new = _changed(text, keywords, dwell, measured)
    table = {k: v for k, v in expected.get(TABLE, {}).items() if k not in CHOSEN}
    expected[TABLE] = {**table, **keywords}
    if dwell is not None:
        expected[DWELL] = dwell
    if tomllib.loads(new) != expected:
        lines = ", ".join(f"{key} = {value!r}" for key, value in keywords.items())
        raise ValueError(f"{path}: {TABLE} cannot be changed: write it as a table, with {lines}")
    if new == text:
        return False
    write_atomically(copy_of(path), text)
    write_atomically(path, new)
    return True


def _changed(
    text: str, keywords: Mapping[str, Any], dwell: float | None, measured: list[str]
) -> str:
    document = tomlkit.parse(text)
    is_new = MEASURED not in document
    if measured and not is_new and document[MEASURED] != measured:
        document[MEASURED] = measured
    table: Any = document.setdefault(TABLE, tomlkit.table())
    for key in CHOSEN:
        if key not in keywords:
            table.pop(key, None)
    for key, value in keywords.items():
        if table.get(key) != value:
            table[key] = copy.copy(value)
    # Ahead of the first entry is always the top level, which tables end.
    lines = tomlkit.dumps(document).splitlines(keepends=True)
    first = next(k for k, line in enumerate(lines) if line.strip() and line.lstrip()[0] != "#")
    end = "\r\n" if lines[first].endswith("\r\n") else "\n"
    added = [] if dwell is None else [f"{DWELL} = {dwell:g}  # measured by dptse fit [s]{end}"]
    if measured and is_new:
        added.append(f"{MEASURED} = {json.dumps(measured)}  # on the records of this road{end}")
    return "".join([*lines[:first], *added, *lines[first:]])

"""Files that a training leaves on disk: plan, checkpoint and learning curve, each atomically."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from agents.files import first_difference, write_json
from dptse_env.utils.files import require_output, write_atomically
from dptse_env.utils.validation import cut, read_json, require

PLAN, CHECKPOINT, PROGRESS = "plan.json", "checkpoint.pt", "progress.csv"

FORMAT = 5
"""Format of the files; raise it whenever their content changes its meaning."""

Row = dict[str, float]


def keep_plan(folder: Path, plan: Mapping[str, Any]) -> None:
    """Keep the plan of a training in its folder, which is made if it is missing.

    Raises:
        ValueError: As `check_plan`.
        OSError: The folder cannot be written.
    """
    check_plan(folder, plan)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / PLAN, {"format": FORMAT, **plan})


def check_plan(folder: Path, plan: Mapping[str, Any]) -> None:
    """Check that a training can begin in a folder, or go on there.

    Raises:
        ValueError: The folder has the training of another plan, or something else, or cannot be
            written.
    """
    require_output(folder, own=[PLAN])
    path = folder / PLAN
    if not path.exists():
        return
    kept = read_json(path)
    require(isinstance(kept, dict), str(path), "the plan of a training", kept)
    difference = first_difference(kept, {"format": FORMAT, **plan})
    if difference is not None:
        raise ValueError(
            f"{folder} has the training of another plan: {difference}. Choose another --output, "
            "or remove the folder to start over"
        )


def write_progress(folder: Path, rows: Sequence[Row], columns: Sequence[str] = ()) -> None:
    """Write the learning curve; missing values stay empty. Columns are those of rows by default."""
    columns = columns or list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(folder / PROGRESS, text.getvalue())


def read_progress(folder: Path) -> list[Row]:
    """Return the learning curve; rows lack the values that are missing in the file.

    Raises:
        ValueError: It is damaged.
    """
    path = folder / PROGRESS
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [
                {name: json.loads(value) for name, value in row.items() if value}
                for row in csv.DictReader(file, strict=True)
            ]
    except (ValueError, TypeError, csv.Error) as problem:
        message = f"{path} is damaged: {cut(problem)}; remove the folder to start over"
        raise ValueError(message) from problem
    if not rows or any("update" not in row for row in rows):
        raise ValueError(f"{path} is damaged: rows are missing; remove the folder to start over")
    return rows


def write_checkpoint(folder: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint of tensors, numbers and strings."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    write_atomically(folder / CHECKPOINT, buffer.getvalue())


def read_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the checkpoint of a folder; None where no training has begun.

    Raises:
        ValueError: It is damaged, or missing although there is a learning curve.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        if (folder / PROGRESS).exists():
            raise ValueError(
                f"{path} is missing, although {PROGRESS} shows that the training had begun: "
                "restore it, or remove the folder to start over"
            )
        return None
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True)
    except Exception as problem:
        message = f"{path} is damaged: {cut(problem)}; remove the folder to start over"
        raise ValueError(message) from problem
    return content

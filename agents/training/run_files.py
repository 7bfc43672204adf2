"""The folder of a training: its plan, and a checkpoint and a learning curve that agree."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from agents.files import keep_plan
from dptse_env.utils.files import write_atomically
from dptse_env.utils.validation import cut

CHECKPOINT, PROGRESS = "checkpoint.pt", "progress.csv"

Row = dict[str, float]


class TrainingFolder:
    """A training in its folder. A checkpoint has the curve up to it, so that the two agree.

    Attributes:
        folder: The folder.
        checkpoint: What `keep` was given last, by an earlier process; None where there was none.
        rows: The learning curve so far.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any]) -> None:
        """Take a folder, which is made if it is missing.

        Args:
            folder: The folder.
            plan: What the numbers of the training depend on, as plain JSON.

        Raises:
            ValueError: The folder belongs to another plan, or its checkpoint is damaged.
            OSError: The folder cannot be written.
        """
        self.checkpoint = read_checkpoint(folder)  # may refuse it; nothing is written then
        keep_plan(folder, plan)
        self.folder = folder
        self.rows: list[Row] = list(self.checkpoint["rows"]) if self.checkpoint else []

    def append(self, row: Row) -> None:
        """Add a row to the curve."""
        self.rows.append(row)

    def keep(self, **content: Any) -> None:
        """Write a checkpoint of tensors, numbers and strings, and the curve.

        Raises:
            OSError: The disk is full or cannot be written; the last checkpoint stays.
        """
        buffer = io.BytesIO()
        torch.save({"rows": self.rows, **content}, buffer)
        write_atomically(self.folder / CHECKPOINT, buffer.getvalue())
        self.write_curve()

    def write_curve(self) -> None:
        """Write the learning curve; values that a row lacks stay empty."""
        columns = list(dict.fromkeys(name for row in self.rows for name in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_atomically(self.folder / PROGRESS, text.getvalue())


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

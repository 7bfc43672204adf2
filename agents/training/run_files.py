"""What a training leaves on disk: each file is put in place when it is whole."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

CHECKPOINT, PROGRESS = "checkpoint.pt", "progress.csv"

COLUMNS = (
    "update", "steps", "seconds", "error", "validation", "validation_drawn", "learning_rate",
    "kl", "clipped", "entropy", "explained_variance", "value_loss",
)  # fmt: skip
"""Of `PROGRESS`. Errors are minus the mean reward of a second: of the actions trained on, and on
validation traffic with deterministic and with drawn actions."""

Row = dict[str, float]


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that a kill or a full disk leaves the old one or the new one.

    Raises:
        OSError: It cannot be written; what stood there stays.
    """
    aside = path.with_suffix(".tmp")
    try:
        with aside.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_progress(folder: Path, rows: Sequence[Row]) -> None:
    """Write the learning curve; what a row lacks stays empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(folder / PROGRESS, text.getvalue().encode())


def read_progress(folder: Path) -> list[Row]:
    """Return the learning curve as written, shorter rows where values are missing."""
    with (folder / PROGRESS).open(encoding="utf-8", newline="") as file:
        return [
            {name: json.loads(value) for name, value in row.items() if value}
            for row in csv.DictReader(file)
        ]


def write_checkpoint(folder: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint of tensors, numbers and strings."""
    kept = io.BytesIO()
    torch.save(content, kept)
    write_whole(folder / CHECKPOINT, kept.getvalue())


def read_checkpoint(folder: Path) -> dict[str, Any] | None:
    """Return the checkpoint of a folder; None where no training has begun.

    Raises:
        ValueError: It is damaged, or missing although there is a learning curve.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        if (folder / PROGRESS).exists():
            raise ValueError(
                f"{path} is missing, although {PROGRESS} says that the training had begun: put it "
                "back, or remove the folder to start over"
            )
        return None
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True)
    except Exception as problem:
        raise ValueError(f"{path} is damaged: {problem}; remove the folder to start over") from (
            problem
        )
    return content

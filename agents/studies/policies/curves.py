"""Learning curves of the trainings behind policies."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from agents.studies.policies.manifest import Checkpoint

PROGRESS = "progress.csv"
_ERROR = "validation"


@dataclass(frozen=True)
class Curve:
    """The error of a training on its validation traffic.

    Attributes:
        steps: Seconds of traffic simulated so far.
        errors: Normalised RMSE × 1000 with deterministic actions, at each of the steps.
    """

    recipe: str
    training_seed: int
    steps: tuple[float, ...]
    errors: tuple[float, ...]


def read_curves(checkpoints: Iterable[Checkpoint], cell: str) -> list[Curve]:
    """Return the curves of a cell's policies whose training folder has one, each once.

    Raises:
        ValueError: A curve is not as ``scripts/train.py`` writes it.
    """
    curves: dict[Path, Curve] = {}
    for checkpoint in checkpoints:
        path = Path(checkpoint.path).parent / PROGRESS
        if checkpoint.cell == cell and path not in curves and path.is_file():
            curves[path] = _read(path, checkpoint)
    return list(curves.values())


def _read(path: Path, checkpoint: Checkpoint) -> Curve:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row[_ERROR]]
        points = [(float(row["steps"]), 1000.0 * float(row[_ERROR])) for row in rows]
    except (KeyError, ValueError) as problem:
        raise ValueError(f"{path} is no learning curve: {problem!r}") from problem
    if not points:
        raise ValueError(f"{path} is no learning curve: it has no validation")
    steps, errors = zip(*points, strict=True)
    return Curve(checkpoint.recipe, checkpoint.training_seed, steps, errors)

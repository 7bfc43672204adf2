"""Learning curves of the trainings behind policies."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from agents.experiments.tables import write_csv
from agents.studies.policies.manifest import Checkpoint

PROGRESS, CURVES = "progress.csv", "curves.csv"
_ERROR = "validation"


@dataclass(frozen=True)
class Curve:
    """The error of a training on its validation traffic.

    Attributes:
        recipe: Its recipe.
        training_seed: Its seed.
        steps: Seconds of traffic simulated so far.
        errors: Normalised RMSE × 1000 with deterministic actions, at each of the steps.
    """

    recipe: str
    training_seed: int
    steps: tuple[float, ...]
    errors: tuple[float, ...]


def keep_curves(folder: Path, checkpoints: Iterable[Checkpoint], cell: str) -> list[Curve]:
    """Return the learning curves of a cell's policies, and keep them in a folder of results.

    They are read from the folder, or else from the folders of the trainings, as far as these are
    there.

    Raises:
        ValueError: A curve is not as ``scripts/train.py`` writes it.
    """
    path = folder / CURVES
    if not path.exists():
        curves = read_curves(checkpoints, cell)
        if curves:
            rows = [
                (curve.recipe, curve.training_seed, step, error)
                for curve in curves
                for step, error in zip(curve.steps, curve.errors, strict=True)
            ]
            write_csv(path, ("recipe", "training_seed", "steps", "error"), rows)
        return curves
    points: dict[tuple[str, int], list[tuple[float, float]]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            curve = points.setdefault((row["recipe"], int(row["training_seed"])), [])
            curve.append((float(row["steps"]), float(row["error"])))
    return [_curve(*key, curve) for key, curve in points.items()]


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
    points = []
    with path.open(encoding="utf-8", newline="") as file:
        try:
            for row in csv.DictReader(file):
                if row[_ERROR]:
                    points.append((float(row["steps"]), 1000.0 * float(row[_ERROR])))
        except (KeyError, ValueError) as problem:
            raise ValueError(f"{path} is no learning curve: {problem!r}") from problem
    if not points:
        raise ValueError(f"{path} is no learning curve: it has no validation")
    return _curve(checkpoint.recipe, checkpoint.training_seed, points)


def _curve(recipe: str, training_seed: int, points: Sequence[tuple[float, float]]) -> Curve:
    steps, errors = zip(*points, strict=True)
    return Curve(recipe, training_seed, steps, errors)

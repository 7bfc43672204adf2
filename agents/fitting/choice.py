"""Comparisons of a fit on validation traffic, its choices there, and its episodes on test traffic.

Each choice is made with the one before it: the parameters with an EKF and round robin, the
estimator with these parameters, the query policy with this estimator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from agents.fitting.road import PLAYED, Road
from agents.play import Cell
from agents.seeds import CHOICE, EVALUATION, TUNING
from agents.statistics import mean_interval
from agents.study import Place, Study, play_study
from agents.tables import ERROR, values

NAME = "fit"
FILTER, ROUND_ROBIN = "ekf", "round-robin"
"""Estimator and query policy with which parameters are chosen."""

ESTIMATORS_TRIED = (
    "asm", "blend", "ekf", "enkf", "mixture", "random_walk", "recurrent", "ukf",
)  # fmt: skip
"""Estimators among which a fit chooses: all that take less than a millisecond a second."""

POLICIES_TRIED = (
    ROUND_ROBIN, "shift-ahead", "oldest-first", "largest-variance", "stale-variance",
    "largest-deviation", "speed-front", "expected-reduction",
)  # fmt: skip
"""Query policies among which it chooses."""

FEW = 4
"""Seeds of validation traffic below which a choice is by the mean alone."""

PRESENT = "present"
"""Name of what the road file has already."""


@dataclass
class Choice:
    """The options of a fit, and its choices so far.

    Attributes:
        road: The road.
        stages: Folder of the rows.
        sets: Keywords of each set of parameters and settings, by its name.
        refused: What could not be played, and why, a sentence each.
        parameters: The chosen set.
        estimator: The chosen estimator.
        policy: The chosen query policy.
        rows: All rows so far.
    """

    road: Road
    stages: Path
    sets: dict[str, dict[str, Any]]
    refused: list[str] = field(default_factory=list)
    parameters: str = ""
    estimator: str = FILTER
    policy: str = ROUND_ROBIN
    rows: pl.DataFrame = field(default_factory=pl.DataFrame)

    @property
    def home(self) -> str:
        """Shipped set that the environment would have, or the best one that suits the road."""
        inherited = self.road.inherited
        return inherited if inherited in self.sets else next(iter(self.sets))

    def labels(self, traffic: str, **changes: str) -> dict[str, str]:
        """Return the labels of what is chosen, with changes, on validation or test traffic."""
        chosen = {"parameters": self.parameters, "estimator": self.estimator, "policy": self.policy}
        return {"traffic": traffic, **chosen, **changes}

    def cell(self, labels: Mapping[str, str]) -> Cell:
        """Return the cell of some labels."""
        keywords = {
            **self.road.keywords,
            "corridor": str(self.stages / PLAYED),
            "estimator": labels["estimator"],
            **self.sets.get(labels["parameters"], {}),
        }
        noise = {"training": TUNING.start, "validation": CHOICE.start, "test": EVALUATION.start}
        traffic = labels["traffic"]
        return Cell(
            self.road.env,
            labels["policy"],
            keywords,
            labels,
            noise_seed=noise[traffic],
            transferred=True,
            watchers=("honesty",),
            seeds=self.road.seeds[traffic],
        )

    def play(self, wanted: Sequence[Mapping[str, str]], place: Place) -> list[Mapping[str, str]]:
        """Play cells, and return the labels of those that the environment does not refuse."""
        cells = {}
        for labels in wanted:
            cell = self.cell(labels)
            try:
                cell.check()
            except ValueError as problem:
                tried = f"{labels['estimator']} with {labels['parameters']}, {labels['policy']}"
                self.refused.append(f"{tried}: {problem}")
            else:
                cells[cell.id] = cell
        study = Study(NAME, tuple(cells.values()), (), lambda rows, folder: "")
        self.rows = play_study(study, place._replace(folder=self.stages))
        return [cell.labels for cell in cells.values()]

    def best(self, played: Sequence[Mapping[str, str]]) -> Mapping[str, str]:
        """Return the labels of the smallest mean error."""
        return min(played, key=lambda labels: float(values(self.rows, labels, ERROR).mean()))

    def choose(self, options: Sequence[Mapping[str, str]], place: Place) -> None:
        """Play changes of what is chosen on validation traffic, and choose the best one.

        What is chosen stays unless the best one errs less with 95 % confidence, or the traffic has
        too few seeds to tell.

        Raises:
            ValueError: The environment refuses all of them.
        """
        played = self.play([self.labels("validation", **changes) for changes in options], place)
        if not played:
            raise ValueError(f"{self.road.path}: {self.refused[-1]}")
        best, now = self.best(played), self.labels("validation")
        if now not in played or self._is_less(best, now):
            self.parameters, self.estimator, self.policy = (
                best[key] for key in ("parameters", "estimator", "policy")
            )

    def _is_less(self, labels: Mapping[str, str], now: Mapping[str, str]) -> bool:
        less, more = (values(self.rows, each, ERROR) for each in (labels, now))
        if len(less) < FEW:
            return bool(less.mean() < more.mean())
        return bool(mean_interval(less - more).high < 0.0)

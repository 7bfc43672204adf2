"""The report of an evaluation: a table for each estimator, files, and a figure of errors."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.table import Table

from agents.evaluation.episodes import EpisodeScore
from agents.figures import save_errors
from agents.files import write_atomically, write_csv
from agents.statistics import Interval, mean_interval, paired_difference
from agents.terminal import make_table, print_table, print_text

METRICS = ("rmse_density", "rmse_speed", "reward")

EPISODES, SUMMARY = "episodes.csv", "summary.json"
"""Files of all scores, and of the table and its origin."""


@dataclass(frozen=True)
class Row:
    """The scores of one policy with one estimator, summarised.

    Attributes:
        mean: By metric, the mean over episodes with its 95 % interval.
        difference: By metric, the mean paired difference to the reference policy.
        n_diverged: Seconds over all episodes in which the estimator had to start over.
    """

    estimator: str
    policy: str
    mean: dict[str, Interval]
    difference: dict[str, Interval]
    n_diverged: float


class Report:
    """The scores of policies on the same episodes, summarised."""

    def __init__(
        self, scores: Mapping[tuple[str, str], list[EpisodeScore]], reference: str, title: str
    ) -> None:
        """Summarise scores by (estimator, policy), one per episode, in one order for all.

        Raises:
            ValueError: There are fewer than two episodes.
        """
        self.scores, self.reference, self.title = dict(scores), reference, title
        self.estimators = list(dict.fromkeys(estimator for estimator, _ in self.scores))
        self.rows = {key: self._row(*key) for key in self.scores}

    def _row(self, estimator: str, policy: str) -> Row:
        cell, reference = self.scores[estimator, policy], self.scores[estimator, self.reference]

        def values(scores: list[EpisodeScore], metric: str) -> list[float]:
            return [getattr(score, metric) for score in scores]

        means = {name: mean_interval(values(cell, name)) for name in METRICS}
        differences = {
            name: paired_difference(values(cell, name), values(reference, name)) for name in METRICS
        }
        n_diverged = sum(score.n_diverged for score in cell)
        return Row(estimator, policy, means, differences, n_diverged)

    def ranked(self, estimator: str) -> list[str]:
        """Return the policies by mean density error, best first."""
        names = [policy for name, policy in self.rows if name == estimator]
        return sorted(names, key=lambda name: self.rows[estimator, name].mean["rmse_density"].mean)

    def print(self) -> None:
        """Print a table per estimator, best density error first."""
        print_text(f"{self.title}; mean ± half of the 95 % interval")
        for estimator in self.estimators:
            print_table(self._table(estimator))

    def _table(self, estimator: str) -> Table:
        against = f"against\n{self.reference}"
        metrics = {"rmse_density": "density RMSE\n[veh/km]", "rmse_speed": "speed RMSE\n[km/h]"}
        columns = [column for metric in metrics.values() for column in (metric, against)]
        table = make_table(f"estimator {estimator}", "policy", *columns)
        for policy in self.ranked(estimator):
            cells, row = [], self.rows[estimator, policy]
            for metric in metrics:
                mean, difference = row.mean[metric], row.difference[metric]
                cells.append(f"{mean.mean:.2f} ± {mean.half_width:.2f}")
                compared = f"{difference.mean:+.2f} ± {difference.half_width:.2f}"
                cells.append("-" if policy == self.reference else compared)
            table.add_row(policy, *cells)
        return table

    def write(self, folder: Path, arguments: Mapping[str, Any]) -> None:
        """Write all scores to `EPISODES`, the table and its origin to `SUMMARY`."""
        folder.mkdir(parents=True, exist_ok=True)
        columns = [field.name for field in dataclasses.fields(EpisodeScore)]
        write_csv(
            folder / EPISODES,
            ["estimator", "schedule", *columns],
            (
                [*key, *dataclasses.astuple(score)]
                for key, scores in self.scores.items()
                for score in scores
            ),
        )
        packages = ("dptse-env", "gymnasium", "libsumo", "numba", "numpy")
        summary = {
            "title": self.title,
            "reference": self.reference,
            "arguments": {key: str(value) for key, value in arguments.items()},
            "versions": {name: version(name) for name in packages},
            "rows": [dataclasses.asdict(row) for row in self.rows.values()],
        }
        write_atomically(folder / SUMMARY, json.dumps(summary, indent=2) + "\n")

    def draw(self, path: Path) -> None:
        """Save a figure of density and speed errors of all policies."""
        ranked = self.ranked(self.estimators[0])
        series = {
            name: {policy: self.rows[name, policy].mean for policy in ranked}
            for name in self.estimators
        }
        save_errors(path, ranked, series, self.title)

"""Results of the study of policies: statistics over training seeds and traffic seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from agents.evaluation.episodes import EpisodeScore
from agents.experiments import cells
from agents.statistics import (
    Interval,
    bootstrap,
    crossed_t,
    holm,
    percent_below,
    percent_of_way,
)
from agents.studies.policies.curves import Curve
from agents.studies.policies.manifest import CellChoice, Manifest
from agents.studies.policies.plan import PRIMARY, REFERENCE, Entry, Learner, PolicyDesign
from agents.studies.policies.queries import QueryCounts
from dptse_env.utils.arrays import FloatArray

ERROR = "error"
METRICS = {ERROR: ("density-and-speed", "× 1000"), **cells.METRICS}
"""Name and unit of each error."""
ERROR_ORACLE = "oracle-error"


@dataclass(frozen=True)
class Comparison:
    """A learned policy against the best baseline of its cell.

    Attributes:
        baseline: The baseline, chosen on validation traffic.
        below: How far its error lies below the baseline's [%], two-level bootstrap.
        p_value: Of a zero difference, crossed t.
        adjusted: The p-value after Holm over all secondary comparisons.
    """

    learner: Learner
    baseline: str
    below: Interval
    difference: Interval
    p_value: float
    adjusted: float

    @property
    def verdict(self) -> str:
        """The direction of a difference that is significant at 5 % over all comparisons."""
        if self.adjusted >= 0.05:
            return "not significant"
        return "better" if self.difference.mean > 0.0 else "worse"


@dataclass(frozen=True)
class PolicyResults:
    """Scores, queries and learning curves of a design.

    Attributes:
        scores: Score by entry and test seed.
        queries: Queries by entry of the primary cell and test seed.
        curves: Learning curves of the policies of the primary cell.
        n_resamples: Resamples of every bootstrap.
    """

    design: PolicyDesign
    manifest: Manifest
    scores: Mapping[tuple[Entry, int], EpisodeScore]
    queries: Mapping[tuple[Entry, int], QueryCounts]
    curves: Sequence[Curve]
    n_resamples: int = 10_000

    def table(self, entries: Sequence[Entry], metric: str) -> FloatArray:
        """Return the errors of entries on the test seeds, shape (n_entries, n_seeds)."""

        def value(score: EpisodeScore) -> float:
            return -1000.0 * score.reward if metric == ERROR else getattr(score, metric)

        return np.array(
            [
                [value(self.scores[entry, seed]) for seed in self.design.test_seeds]
                for entry in entries
            ]
        )

    def schedule(self, cell: str, name: str, metric: str = ERROR) -> FloatArray:
        """Return the errors of a schedule, shape (1, n_seeds)."""
        kind = "baseline" if name in self.manifest.ladder[cell] else "bound"
        return self.table([Entry(cell, kind, name)], metric)

    def learned(self, learner: Learner, metric: str = ERROR) -> FloatArray:
        """Return the errors of a learned policy, shape (n_training_seeds, n_seeds)."""
        seeds = self.manifest.runs(learner)
        return self.table([learner.entry(seed) for seed in seeds], metric)

    def interval(self, statistic: Callable[..., FloatArray], *tables: FloatArray) -> Interval:
        """Return a statistic with its two-level bootstrap interval."""
        return bootstrap(statistic, *tables, n_resamples=self.n_resamples)

    def below(self, table: FloatArray, reference: FloatArray) -> Interval:
        """Return how far errors lie below those of a reference [%]."""
        return self.interval(percent_below, table, reference)

    def choice(self, cell: str) -> CellChoice:
        """Return the choices of validation traffic in a cell."""
        return self.manifest.choices[cell]

    def best_on_test(self, cell: str) -> str:
        """Return the baseline of least error on test traffic, known in hindsight only."""
        names = self.manifest.ladder[cell]
        return min(names, key=lambda name: float(self.schedule(cell, name).mean()))

    @property
    def primary(self) -> Learner | None:
        """The learned policy of the targets; None if none was frozen."""
        chosen = self.choice(PRIMARY).learners.get(PRIMARY)
        return None if chosen is None else Learner(PRIMARY, chosen[0], PRIMARY, chosen[1])

    def chosen(self, cell: str) -> list[Learner]:
        """Return the learned policies of a cell in the mode that validation traffic chose."""
        found = []
        for learner in self.manifest.learners(self.design.cell(cell)):
            pair = self.manifest.choices[learner.trained_in].learners[learner.trained_in]
            if (learner.policy, learner.mode) == pair:
                found.append(learner)
        return found

    def worst(self, learner: Learner) -> int:
        """Return the place of the training seed of largest error on test traffic."""
        return int(self.learned(learner).mean(axis=1).argmax())

    def progress(self, learner: Learner) -> Interval | None:
        """Return how far a policy is from the best baseline to the error oracle [%]."""
        cell = learner.cell
        if ERROR_ORACLE not in self.manifest.bounds[cell]:
            return None
        start = self.schedule(cell, self.choice(cell).baseline)
        end = self.schedule(cell, ERROR_ORACLE)
        if end.mean() >= start.mean():
            return None
        return self.interval(percent_of_way, self.learned(learner), start, end)

    @cached_property
    def comparisons(self) -> list[Comparison]:
        """Comparisons of all learned policies of the secondary cells with the best baseline."""
        learners = [each for cell in self.design.cells[1:] for each in self.chosen(cell.name)]
        names = [self.choice(learner.cell).baseline for learner in learners]
        found = []
        for learner, name in zip(learners, names, strict=True):
            errors, reference = self.learned(learner), self.schedule(learner.cell, name)
            test = crossed_t(reference - errors)
            found.append(Comparison(learner, name, self.below(errors, reference), *test, 1.0))
        adjusted = holm({str(each.learner): each.p_value for each in found})
        return [replace(each, adjusted=adjusted[str(each.learner)]) for each in found]

    @property
    def references(self) -> tuple[str, str]:
        """The best baseline of the primary cell, and the paper's schedule."""
        return self.choice(PRIMARY).baseline, REFERENCE

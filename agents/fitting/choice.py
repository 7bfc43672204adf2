"""Comparisons of a fit on validation traffic, its choices there, and its episodes on test traffic.

Estimators are compared under round robin, each with inherited and with fitted parameters; then
query policies with the chosen estimator and the estimators under the chosen policy, until neither
changes. So no estimator is proposed that loses to another one under the proposed policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import polars as pl

from agents.fitting.road import PLAYED, Road
from agents.play import Cell
from agents.seeds import CHOICE, EVALUATION, TUNING
from agents.statistics import mean_interval
from agents.study import Place, Study, play_study
from agents.tables import ERROR, Labels, give_or_take, values
from agents.terminal import told
from dptse_env.utils.arrays import FloatArray

NAME = "fit"
FILTER, ROUND_ROBIN = "ekf", "round-robin"
"""Estimator and query policy with which parameters are fitted."""

ESTIMATORS_TRIED = (
    "ekf", "random_walk", "asm", "blend", "ukf", "enkf", "mhe", "recurrent",
)  # fmt: skip
"""Estimators among which a fit chooses, the simplest first."""

POLICIES_TRIED = (
    ROUND_ROBIN, "shift-ahead", "oldest-first", "largest-variance", "stale-variance",
    "largest-deviation", "speed-front", "expected-reduction",
)  # fmt: skip
"""Query policies among which it chooses, the simplest first."""

ROUNDS = 3
"""Most comparisons of query policies; after each come the estimators again."""

NOISE = {"training": TUNING, "validation": CHOICE, "test": EVALUATION}
"""Seeds of the noise by kind of traffic."""

FEW = 4
"""Seeds of validation traffic below which a choice is by the mean alone."""

PRESENT = "present"
"""Name of what the road file has already."""


@dataclass
class Choice:
    """The options of a fit, and its choices so far.

    Attributes:
        road: The road.
        place: Folder of the rows, and what plays them.
        sets: Keywords of each set of parameters and settings, by its name.
        notes: What the reader should know, a sentence each, such as what could not be played.
        parameters: The chosen set.
        estimator: The chosen estimator.
        policy: The chosen query policy.
        compared: Labels of the estimators and of the policies that were compared last, by
            ``"estimator"`` and ``"policy"``.
        rows: All rows so far.
    """

    road: Road
    place: Place
    sets: dict[str, dict[str, Any]]
    notes: list[str] = field(default_factory=list)
    parameters: str = ""
    estimator: str = FILTER
    policy: str = ROUND_ROBIN
    compared: dict[str, list[Labels]] = field(default_factory=dict)
    rows: pl.DataFrame = field(default_factory=pl.DataFrame)

    @property
    def home(self) -> str:
        """Shipped set that the environment would have, or the best one that suits the road."""
        inherited = self.road.inherited
        return inherited if inherited in self.sets else next(iter(self.sets))

    @property
    def tested(self) -> Labels:
        """Labels of what is chosen on test traffic."""
        return self.labels("test")

    @property
    def plain(self) -> Labels:
        """Labels of what it is held against there."""
        return self.labels("test", parameters=self.home, estimator=FILTER, policy=ROUND_ROBIN)

    def labels(self, traffic: str, **changes: Any) -> dict[str, Any]:
        """Return the labels of what is chosen, with changes, on a kind of traffic."""
        config = self.road.config
        return {
            "traffic": traffic,
            "parameters": self.parameters,
            "estimator": self.estimator,
            "policy": self.policy,
            "bandwidth": config.bandwidth,
            "epsilon": config.privacy.epsilon,
            **changes,
        }

    def cell(self, labels: Labels, seeds: Sequence[int] = ()) -> Cell:
        """Return the cell of some labels, on given traffic or all of the kind that they name."""
        keywords = {
            **self.road.keywords,
            "corridor": str(self.place.folder / PLAYED),
            **{key: labels[key] for key in ("estimator", "bandwidth", "epsilon")},
            **self.sets.get(labels["parameters"], {}),
        }
        traffic = labels["traffic"]
        return Cell(
            self.road.env,
            labels["policy"],
            keywords,
            labels,
            noise_seed=NOISE[traffic].start,
            transferred=True,
            watchers=("honesty",),
            seeds=tuple(seeds) or self.road.seeds[traffic],
        )

    def play(self, wanted: Sequence[Labels], seeds: Sequence[int] = ()) -> list[Labels]:
        """Play cells, and return the labels of those that the environment does not refuse.

        Of what it refuses for one reason, the first cell is noted.
        """
        cells = {}
        for labels in wanted:
            cell = self.cell(labels, seeds)
            if (problem := cell.misfit()) is None:
                cells[cell.id] = cell
            elif not any(note.endswith(f": {problem}") for note in self.notes):
                tried = ", ".join(f"{key} {value}" for key, value in [*labels.items()][1:])
                self.notes.append(f"refused is {tried}: {problem}")
        study = Study(NAME, tuple(cells.values()), (), lambda rows, folder: "")
        self.rows = play_study(study, self.place)
        return [cell.labels for cell in cells.values()]

    def errors(self, labels: Labels) -> FloatArray:
        """Return the errors x 1000 of what was played, for each traffic seed."""
        return values(self.rows, labels, ERROR)

    def best(self, played: Sequence[Labels]) -> Labels:
        """Return the labels of the smallest mean error."""
        return min(played, key=lambda labels: float(self.errors(labels).mean()))

    def unbeaten(self, played: Sequence[Labels]) -> list[Labels]:
        """Return the labels of those that err certainly more than none of the others."""
        errors = [self.errors(labels) for labels in played]
        return [
            labels
            for labels, own in zip(played, errors, strict=True)
            if not any(is_less(other, own) for other in errors)
        ]

    def finalists(self, what: str) -> list[Labels]:
        """Return what is chosen and the best of each other, where each has several parameters.

        Args:
            what: ``"estimator"`` or ``"policy"``.
        """
        found: dict[str, list[Labels]] = {}
        for labels in self.compared[what]:
            found.setdefault(labels[what], []).append(labels)
        now = self.labels("validation")
        return [now if now in each else self.best(each) for each in found.values()]

    def settle(self, estimators: Sequence[Labels], policies: Sequence[Labels]) -> None:
        """Choose an estimator, then a query policy and an estimator again until neither changes.

        Args:
            estimators: Changes of estimator and parameters, the simplest first.
            policies: Changes of the query policy, the simplest first.

        Raises:
            ValueError: The environment refuses all estimators or policies.
        """
        self.choose("estimator", estimators)
        for _ in range(ROUNDS):
            before = self.tested
            self.choose("policy", policies)
            self.choose("estimator", estimators)
            if self.tested == before:
                return

    def choose(self, what: str, options: Sequence[Labels]) -> None:
        """Play changes of what is chosen on validation traffic, and choose one that is unbeaten.

        What is chosen stays if it is among them; else it is the first one.

        Args:
            what: ``"estimator"`` or ``"policy"``.
            options: The changes, the simplest first.

        Raises:
            ValueError: The environment refuses all of them.
        """
        told.info("play %d options of the %s on validation traffic", len(options), what)
        played = self.play([self.labels("validation", **changes) for changes in options])
        if not played:
            raise ValueError(f"{self.road.path}: {self.notes[-1]}")
        self.compared[what] = played
        unbeaten, now = self.unbeaten(played), self.labels("validation")
        if now not in unbeaten:
            self.parameters, self.estimator, self.policy = (
                unbeaten[0][key] for key in ("parameters", "estimator", "policy")
            )


def is_less(errors: FloatArray, others: FloatArray) -> bool:
    """Return whether errors on the same traffic are smaller than others with 95 % confidence.

    Of fewer than `FEW` seeds the means alone are compared.
    """
    if len(errors) < FEW:
        return bool(errors.mean() < others.mean())
    return bool(mean_interval(errors - others).high < 0.0)


def interval(errors: FloatArray | None) -> str:
    """Return mean and half of the 95 % interval, of one value that value, and of None a dash."""
    if errors is None:
        return "-"
    return f"{errors.item():.1f}" if len(errors) < 2 else give_or_take(mean_interval(errors))

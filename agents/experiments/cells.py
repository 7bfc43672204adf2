"""Cells, designs and results: the parts that every study is made of."""

from __future__ import annotations

import typing
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from agents.environments import given_keywords, make_config, quietly
from agents.evaluation.episodes import EpisodeScore, check_test_seeds
from agents.statistics import Interval, mean_interval, paired_difference
from dptse_env.config import TEST_SEEDS, EnvConfig, parse_seeds
from dptse_env.schedules import OBSERVATION_SCHEDULES
from dptse_env.utils.arrays import FloatArray

DENSITY, SPEED = "rmse_density", "rmse_speed"
METRICS = {DENSITY: ("density", "veh/km"), SPEED: ("speed", "km/h")}
"""Name and unit of each error of an estimate."""
ERROR = "error"
"""Name of the environment's error x 1000 among the metrics: minus the mean reward."""


class Key(Hashable, Protocol):
    """A frozen dataclass of plain values that is run on every traffic seed."""

    __dataclass_fields__: typing.ClassVar[dict[str, Any]]


class Cell(Key, Protocol):
    """A key that is a configuration of an environment."""

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of ``gym.make`` that make it."""


KeyT = TypeVar("KeyT", bound=Key)
CellT = TypeVar("CellT", bound=Cell)


@dataclass(frozen=True)
class Design(ABC, Generic[CellT]):
    """The cells of a study of one environment, each run on every traffic seed.

    Attributes:
        seeds: Test traffic seeds, first:stop; each is the seed of the noise, too.
        schedule: Query schedule of every episode.
        env: Environment id.
        corridor: Road in place of the environment's: the name of a shipped corridor, a road file
            that ends in .toml, or a JSON object of corridor fields.
    """

    seeds: str = f"{TEST_SEEDS.start}:{TEST_SEEDS.start + 20}"
    schedule: str = "paper"
    env: str = "dptse_env:dptse/PaperHighway-v0"
    corridor: str | None = None

    def check(self) -> None:
        """Check the values that no environment checks.

        Raises:
            ValueError: A value is out of range; the message names it.
        """
        check_test_seeds(self.traffic_seeds)
        # Draws of the random schedule start anew after an interruption.
        known = sorted(OBSERVATION_SCHEDULES.keys() - {"random"})
        if self.schedule not in known:
            raise ValueError(f"schedule must be one of {', '.join(known)}, got {self.schedule!r}")

    @property
    def traffic_seeds(self) -> tuple[int, ...]:
        """The traffic seeds."""
        return parse_seeds(self.seeds)

    def seeds_of(self, cell: CellT) -> tuple[int, ...]:
        """Return the traffic seeds of a cell."""
        return self.traffic_seeds

    def first_seeds(self, n: int) -> str:
        """Return the first n traffic seeds, or all where there are fewer, as first:stop."""
        seeds = self.traffic_seeds[:n]
        return f"{seeds[0]}:{seeds[-1] + 1}"

    @abstractmethod
    def all_cells(self) -> Iterator[CellT]:
        """Yield the cells of every curve and table; cells may repeat."""

    def cells(self) -> list[CellT]:
        """Return every cell once."""
        return list(dict.fromkeys(self.all_cells()))

    @cached_property
    def road(self) -> dict[str, Any]:
        """Keyword of ``gym.make`` that puts the road of ``corridor`` into every environment.

        Raises:
            ValueError: There is no such road.
        """
        return given_keywords("{}", self.corridor)

    def keywords(self, cell: CellT) -> dict[str, Any]:
        """Return the keywords of ``gym.make`` that make a cell on the road of the design."""
        return {**self.road, **cell.keywords}

    @cached_property
    def configs(self) -> list[EnvConfig]:
        """The configurations of all cells, after a check of the design.

        Raises:
            ValueError: A value of the design or of a cell is out of range.
        """
        self.check()
        seeds = {"traffic_seeds": list(self.traffic_seeds)}
        with quietly():
            return [
                make_config(self.env, {**self.keywords(each), **seeds}) for each in self.cells()
            ]


DesignT = TypeVar("DesignT", bound=Design[Any])


class UnmeasuredError(Exception):
    """The cell was not run."""


class Change(NamedTuple):
    """Paired differences of both errors between two cells."""

    density: Interval
    speed: Interval


@dataclass(frozen=True)
class Results(Generic[DesignT, CellT]):
    """Scores by cell, in the order of the traffic seeds of a design.

    Attributes:
        scores: Score by cell and traffic seed.
    """

    design: DesignT
    scores: Mapping[tuple[CellT, int], EpisodeScore]

    def values(self, cell: CellT, metric: str) -> FloatArray:
        """Return a field of the scores, or `ERROR`, for each seed of the cell, shape (n_seeds,).

        Raises:
            UnmeasuredError: The cell was not run.
        """
        seeds = self.design.seeds_of(cell)
        if (cell, seeds[0]) not in self.scores:
            raise UnmeasuredError(cell)
        name = "reward" if metric == ERROR else metric
        values = np.array([getattr(self.scores[cell, seed], name) for seed in seeds])
        return -1000.0 * values if metric == ERROR else values

    def mean(self, cell: CellT, metric: str) -> Interval:
        """Return the mean of a field over the seeds with its interval."""
        return mean_interval(self.values(cell, metric))

    def means(self, cells: Sequence[CellT], metric: str) -> list[Interval]:
        """Return the means of a field for some cells, in their order."""
        return [self.mean(cell, metric) for cell in cells]

    def difference(self, cell: CellT, reference: CellT, metric: str) -> Interval:
        """Return by how much a cell exceeds a reference, paired by traffic and noise."""
        return paired_difference(self.values(cell, metric), self.values(reference, metric))

    def below(self, cell: CellT, reference: CellT, metric: str = ERROR) -> Interval:
        """Return by how much the mean of a cell lies below that of a reference [%], paired.

        The interval is that of the difference over the mean of the reference.
        """
        scale = 100.0 / float(self.values(reference, metric).mean())
        found = mean_interval(self.values(reference, metric) - self.values(cell, metric))
        return Interval(scale * found.mean, scale * found.low, scale * found.high, found.n)

    def change(self, cell: CellT, reference: CellT) -> Change:
        """Return by how much both errors of a cell exceed those of a reference, paired."""
        return Change(*(self.difference(cell, reference, metric) for metric in METRICS))

    def episodes(self, *cells: CellT) -> list[EpisodeScore]:
        """Return the scores of all episodes of some cells, each cell once."""
        seeds = self.design.traffic_seeds
        return [self.scores[cell, seed] for cell in dict.fromkeys(cells) for seed in seeds]

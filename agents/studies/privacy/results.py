"""The scores of a run as intervals over traffic seeds, paired where cells are compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.episodes import EpisodeScore
from agents.evaluation.statistics import Interval, mean_interval, paired_difference
from agents.studies.privacy.account import Account
from agents.studies.privacy.plan import Cell, Design, Protection

DENSITY, SPEED = "rmse_density", "rmse_speed"
METRICS = {DENSITY: ("density", "veh/km"), SPEED: ("speed", "km/h")}
"""Name and unit of each error."""


@dataclass(frozen=True)
class Measured:
    """What was run, and what came of it.

    Attributes:
        design: What was run.
        scores: Score by cell and traffic seed.
        accounts: What noise is worth, by protection and in the order of the design's epsilons.
        trips: Seconds that each vehicle of the traffic can be met, shape (n_vehicles,).
        horizon: Length of an episode [s].
    """

    design: Design
    scores: Mapping[tuple[Cell, int], EpisodeScore]
    accounts: Mapping[Protection, Sequence[Account]]
    trips: NDArray[np.int64]
    horizon: int

    def values(self, cell: Cell, metric: str) -> NDArray[np.float64]:
        """Return a field of `EpisodeScore` for each seed, shape (n_seeds,)."""
        return np.array([getattr(self.scores[cell, seed], metric) for seed in self.design.seeds])

    def mean(self, cell: Cell, metric: str) -> Interval:
        """Return the mean of a field over the seeds with its interval."""
        return mean_interval(self.values(cell, metric))

    def difference(self, cell: Cell, reference: Cell, metric: str) -> Interval:
        """Return by how much a cell exceeds another one, paired by traffic and noise."""
        return paired_difference(self.values(cell, metric), self.values(reference, metric))

    @property
    def meetings(self) -> tuple[int, int]:
        """Steps in which a vehicle is met: as many as the base cap, and all of an episode."""
        return min(self.design.cap, self.horizon), self.horizon

"""Results of the study of ledgers, and the numbers that are computed from several cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.evaluation.contributions import LENGTHS, QUANTILES, TripSums
from agents.experiments.cells import DENSITY, Results
from agents.statistics import Interval, mean_interval
from agents.studies.ledger.cell import CAPPED, PACED, LedgerCell
from agents.studies.ledger.plan import LedgerDesign
from dptse_env.utils.arrays import FloatArray

REFUSED, EXHAUSTED = "percent_refused", "percent_exhausted"


class EqualError(NamedTuple):
    """The epsilon at which one curve has the error of a cell.

    Attributes:
        epsilon: Where the mean paired difference is zero.
        low: Below it the whole interval of the difference is above zero.
        high: Above it the whole interval of the difference is below zero.

    Zero and infinity stand for values below and above all that were run.
    """

    epsilon: float
    low: float
    high: float


@dataclass(frozen=True)
class LedgerResults(Results[LedgerDesign, LedgerCell]):
    """Scores of the cells of a design, and payments of vehicles in the watched ones.

    Attributes:
        trips: Payments by cell and traffic seed.
    """

    trips: Mapping[tuple[LedgerCell, int], TripSums]

    def percent(self, cell: LedgerCell, reference: LedgerCell, metric: str = DENSITY) -> Interval:
        """Return by how much an error exceeds that of a reference [%], paired."""
        ratio = self.values(cell, metric) / self.values(reference, metric)
        return mean_interval(100.0 * (ratio - 1.0))

    def n_lower(self, cell: LedgerCell, reference: LedgerCell, metric: str = DENSITY) -> int:
        """Return on how many traffic seeds an error is lower than that of a reference."""
        return int((self.values(cell, metric) < self.values(reference, metric)).sum())

    def equal_error(self, reference: LedgerCell, delta: float) -> EqualError:
        """Return the epsilon at which ``paced`` has the density error of a reference."""
        cells = self.design.along_epsilon(PACED, delta)
        excess = [self.difference(cell, reference, DENSITY) for cell in cells]
        epsilons = self.design.epsilons
        return EqualError(
            crossing(epsilons, [each.mean for each in excess]),
            crossing(epsilons, [each.low for each in excess]),
            crossing(epsilons, [each.high for each in excess]),
        )

    def schedules_without_gain(self) -> list[str]:
        """Return the schedules under which ``paced`` may err as much as ``capped``."""
        found = []
        for name in self.design.schedules:
            capped, paced, _ = self.design.policy_cells(name)
            if self.difference(paced, capped, DENSITY).high >= 0.0:
                found.append(name)
        return found

    def guarantees_without_gain(self) -> list[tuple[float, float]]:
        """Return the (epsilon, delta) at which ``paced`` may err as much as ``capped``."""
        design, found = self.design, []
        for delta in design.deltas:
            pairs = (design.along_epsilon(each, delta) for each in (CAPPED, PACED))
            for capped, paced in zip(*pairs, strict=True):
                if self.difference(paced, capped, DENSITY).high >= 0.0:
                    found.append((paced.epsilon, delta))
        return found

    def spent_quantiles(self, cell: LedgerCell) -> list[Interval]:
        """Return `QUANTILES` of the part of the budget that was spent, over the seeds."""
        tables = np.array([each.numbers("quantiles") for each in self._trips(cell)])
        return [mean_interval(tables[:, k]) for k in range(len(QUANTILES))]

    def refused_by_place(self, cell: LedgerCell) -> list[Interval]:
        """Return the share of contributions refused on each mainline segment [%]."""
        trips = self._trips(cell)
        met = np.array([each.numbers("met") for each in trips])
        refused = np.array([each.numbers("refused") for each in trips])
        shares = 100.0 * refused / np.maximum(met, 1.0)
        return [mean_interval(shares[:, place]) for place in range(shares.shape[1])]

    def refused_by_length(self, cell: LedgerCell) -> list[Interval | None]:
        """Return the share of contributions refused by length of trip [%]; None for too few."""
        return self._by_length(cell, "refused_of", "met_of", 100.0)

    def spent_by_length(self, cell: LedgerCell) -> list[Interval | None]:
        """Return the mean part of the budget spent [%] by length of trip; None for too few."""
        return self._by_length(cell, "spent", "vehicles", 100.0)

    def _by_length(
        self, cell: LedgerCell, part: str, whole: str, factor: float
    ) -> list[Interval | None]:
        """Return ratios by bin of `LENGTHS` over the seeds that have trips in it."""
        trips = self._trips(cell)
        parts = np.array([each.numbers(part) for each in trips])
        wholes = np.array([each.numbers(whole) for each in trips])
        return [_ratio(factor * parts[:, k], wholes[:, k]) for k in range(len(LENGTHS))]

    def _trips(self, cell: LedgerCell) -> list[TripSums]:
        return [self.trips[cell, seed] for seed in self.design.traffic_seeds]


def crossing(places: Sequence[float], values: Sequence[float]) -> float:
    """Return where falling values cross zero, linear in the logarithm of their places.

    Returns:
        0 if all values are below zero, infinity if none is.
    """
    below = [k for k, value in enumerate(values) if value <= 0.0]
    if not below:
        return float("inf")
    k = below[0]
    if k == 0:
        return 0.0
    share = values[k - 1] / (values[k - 1] - values[k])
    logs = np.log([places[k - 1], places[k]])
    return float(np.exp(logs[0] + share * (logs[1] - logs[0])))


def _ratio(parts: FloatArray, wholes: FloatArray) -> Interval | None:
    """Return the mean ratio over the seeds where there is one; None for fewer than two."""
    there = wholes > 0.0
    if there.sum() < 2:
        return None
    return mean_interval(parts[there] / wholes[there])

"""What the repeats of a row gave, put together."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmarks.throughput.measure import Measured
from benchmarks.throughput.rows import Row


@dataclass
class Result:
    """A row and what its child processes reported.

    Attributes:
        row: The row.
        repeats: One report per child that succeeded.
        problem: Why there is none, or not as many as asked for.
    """

    row: Row
    repeats: list[Measured] = field(default_factory=list)
    problem: str | None = None

    def rates(self, arm: str) -> list[float]:
        """Return the rate of every turn of every repeat."""
        return [r for one in self.repeats if arm in one.arms for r in one.arms[arm].rates]

    def rate(self, arm: str) -> float | None:
        """Return the median rate [1/s]."""
        rates = self.rates(arm)
        return statistics.median(rates) if rates else None

    def spread(self, arm: str) -> float | None:
        """Return half the distance of the 10th to the 90th percentile, as a share of the median."""
        rates = self.rates(arm)
        if not rates:
            return None
        low, high = np.percentile(rates, [10, 90])
        return float((high - low) / 2.0 / statistics.median(rates))

    def share(self, arm: str, whole: str) -> float | None:
        """Return the median over turns of one rate divided by another of the same round."""
        pairs = zip(self.rates(arm), self.rates(whole), strict=False)
        ratios = [one / other for one, other in pairs]
        return statistics.median(ratios) if ratios else None

    @property
    def peak(self) -> float | None:
        """Most memory of any repeat [MiB]."""
        known = [one.peak for one in self.repeats if one.peak is not None]
        return max(known) if known else None

    @property
    def libraries(self) -> float | None:
        """What libraries took of it [MiB]."""
        known = [one.libraries for one in self.repeats if one.libraries is not None]
        return statistics.median(known) if known else None

    def note(self, name: str) -> float | None:
        """Return the median of a further figure."""
        known = [one.notes[name] for one in self.repeats if name in one.notes]
        return statistics.median(known) if known else None


Results = Mapping[str, Result]
"""Results by the name of the row."""


def rate_of(results: Results, row: str, arm: str) -> float | None:
    """Return a median rate, or None where the row was not measured."""
    return results[row].rate(arm) if row in results else None


def ratio(one: float | None, other: float | None) -> float | None:
    """Divide, where both are known."""
    return None if one is None or other is None else one / other


def best(results: Results, prefix: str) -> tuple[str, float] | None:
    """Return the quickest row whose name starts so, and its rate."""
    rates = [
        (name, rate)
        for name, result in results.items()
        if name.startswith(prefix) and (rate := result.rate("environment")) is not None
    ]
    return max(rates, key=lambda pair: pair[1]) if rates else None

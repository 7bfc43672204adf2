"""Results of the rows, the repeats of each put together."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.throughput.measure import Measured
from benchmarks.throughput.rows import Row


@dataclass
class Result:
    """A row and the reports of its child processes. A figure that was not measured is NaN.

    Attributes:
        row: The row.
        repeats: A report for each child that succeeded.
        problem: Reason why there is none, or not as many as requested.
    """

    row: Row
    repeats: list[Measured] = field(default_factory=list)
    problem: str | None = None

    def rates(self, arm: str) -> list[float]:
        """Return the rate of every turn of every repeat."""
        return [rate for each in self.repeats if arm in each.arms for rate in each.arms[arm].rates]

    def rate(self, arm: str) -> float:
        """Return the median rate [1/s]."""
        return _median(self.rates(arm))

    def spread(self, arm: str) -> float:
        """Return half the distance of the 10th to the 90th percentile, as a share of the median."""
        low, high = np.percentile(self.rates(arm) or [math.nan], [10, 90])
        return float((high - low) / 2.0 / self.rate(arm))

    def share(self, arm: str, reference: str) -> float:
        """Return the median over turns of one rate divided by another of the same round."""
        pairs = zip(self.rates(arm), self.rates(reference), strict=False)
        return _median([rate / other for rate, other in pairs])

    @property
    def peak(self) -> float:
        """Largest memory of any repeat [MiB]."""
        return max((each.peak for each in self.repeats if each.peak is not None), default=math.nan)

    @property
    def libraries(self) -> float:
        """Memory of the libraries [MiB]."""
        return _median([each.libraries for each in self.repeats if each.libraries is not None])

    def note(self, name: str) -> float:
        """Return the median of a further figure."""
        return _median([each.notes[name] for each in self.repeats if name in each.notes])


Results = Mapping[str, Result]
"""Results by the name of the row."""


def find(results: Results, name: str) -> Result:
    """Return the result of a row; one without any figure where it was not measured."""
    return results.get(name, Result(Row(name, "")))


def best(results: Results, prefix: str) -> str | None:
    """Return the name of the quickest row whose name starts so; None where none was measured."""
    rates = {name: results[name].rate("environment") for name in results if name.startswith(prefix)}
    measured = {name: rate for name, rate in rates.items() if not math.isnan(rate)}
    return max(measured, key=lambda name: measured[name], default=None)


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else math.nan

"""Results of the study of estimators, and the numbers that are computed from several cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.evaluation.statistics import Interval, mean_interval
from agents.experiments.cells import Results, UnmeasuredError
from agents.studies.estimators.cell import EstimatorCell
from agents.studies.estimators.plan import EstimatorDesign
from dptse_env.utils.arrays import FloatArray

ERROR = "error"
"""Name of the environment's error x 1000 among the metrics: minus the mean reward."""


@dataclass(frozen=True)
class EstimatorResults(Results[EstimatorDesign, EstimatorCell]):
    """Scores by cell, in the order of the traffic seeds of its world."""

    def values(self, cell: EstimatorCell, metric: str) -> FloatArray:
        """Return a field of `EstimatorScore`, or `ERROR`, for each seed, shape (n_seeds,).

        Raises:
            UnmeasuredError: The cell was not run.
        """
        seeds = self.design.seeds_of(cell)
        if (cell, seeds[0]) not in self.scores:
            raise UnmeasuredError(cell)
        name = "reward" if metric == ERROR else metric
        values = np.array([getattr(self.scores[cell, seed], name) for seed in seeds])
        return -1000.0 * values if metric == ERROR else values

    def below(self, cell: EstimatorCell, reference: EstimatorCell, metric: str = ERROR) -> Interval:
        """Return by how much the mean of a cell lies below that of a reference [%], paired.

        The interval is that of the difference over the mean of the reference.
        """
        scale = 100.0 / float(self.values(reference, metric).mean())
        found = mean_interval(self.values(reference, metric) - self.values(cell, metric))
        return Interval(scale * found.mean, scale * found.low, scale * found.high, found.n)

    def regime(self, cell: EstimatorCell, regime: str) -> tuple[float, float, float]:
        """Return the share of segments in a regime [%] and the RMSE of density and speed there."""
        counts = self.values(cell, f"n_{regime}").sum()
        total = sum(self.values(cell, f"n_{each}").sum() for each in ("jam", "front", "free"))
        density, speed = (
            float(np.sqrt(self.values(cell, f"{name}_{regime}").sum() / max(counts, 1.0)))
            for name in ("density", "speed")
        )
        return float(100.0 * counts / total), density, speed

    def worst(self, cells: Sequence[EstimatorCell], metric: str = ERROR) -> EstimatorCell:
        """Return the cell with the largest mean."""
        return max(cells, key=lambda cell: self.mean(cell, metric).mean)

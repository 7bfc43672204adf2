"""Results of the study of estimators, and the numbers that are computed from several cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.experiments.cells import ERROR, Results
from agents.studies.estimators.cell import EstimatorCell
from agents.studies.estimators.plan import EstimatorDesign


@dataclass(frozen=True)
class EstimatorResults(Results[EstimatorDesign, EstimatorCell]):
    """Scores by cell, in the order of the traffic seeds of its world."""

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

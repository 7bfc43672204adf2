"""Results of the study of penetration: gains and losses in per cent, paired."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.experiments.cells import ERROR, Results
from agents.statistics import Interval, mean_interval
from agents.studies.penetration.cell import (
    DETECTORS,
    GUARANTEED,
    QUERIES,
    WHOLE,
    PenetrationCell,
)
from agents.studies.penetration.plan import PenetrationDesign


@dataclass(frozen=True)
class PenetrationResults(Results[PenetrationDesign, PenetrationCell]):
    """Scores by cell."""

    def loss(self, cells: Sequence[PenetrationCell], reference: PenetrationCell) -> Interval:
        """Return by how much the mean error of cells lies above that of a reference [%], paired."""
        base = self.values(reference, ERROR)
        mean = np.mean([self.values(cell, ERROR) for cell in cells], axis=0)
        return mean_interval(100.0 * (mean - base) / base.mean())

    def worth(self, release: str, estimator: str) -> float | None:
        """Return the least share from which on queries beside detectors pay for certain.

        There the error lies below that of detectors alone with the whole budget, and at every
        larger share as well. None where there is no such share.
        """
        least = None
        for share in reversed(self.design.shares):
            gain = self.below(
                self.design.fused(release, estimator, share), self.design.alone(release, estimator)
            )
            if gain.low <= 0.0:
                break
            least = share
        return least

    def alternatives(self, release: str, estimator: str) -> dict[str, PenetrationCell]:
        """Return what both kinds of sensors are compared with at the base share, by name."""
        design = self.design
        found = {
            QUERIES: design.queries(release, estimator, design.base_share),
            DETECTORS: design.alone(release, estimator, DETECTORS),
        }
        if release in GUARANTEED:
            found[WHOLE] = design.alone(release, estimator)
        return found

    def gains(self) -> dict[str, dict[tuple[str, str], Interval]]:
        """Return at the base share the gain of both kinds of sensors over each alternative [%].

        By alternative, then by release model and estimator.
        """
        found: dict[str, dict[tuple[str, str], Interval]] = {}
        for pair in itertools.product(self.design.releases, self.design.estimators):
            for name, other in self.alternatives(*pair).items():
                gain = self.below(self.design.fused(*pair), other)
                found.setdefault(name, {})[pair] = gain
        return found

"""The scores of a run as arrays, and the few numbers that claims are about."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from agents.evaluation.episodes import EpisodeScore
from agents.studies.paper.plan import Cell, Design, Setting
from agents.studies.paper.timing import StepTime

FloatArray = NDArray[np.float64]


class UnmeasuredError(Exception):
    """A claim is about something that was not run."""


class Measured:
    """Scores by cell, in the order of the design's seeds.

    Attributes:
        design: What was run.
        scores: Score by cell and traffic seed.
        times: Time of a step by cell and traffic seed.
    """

    def __init__(
        self,
        design: Design,
        scores: Mapping[tuple[Cell, int], EpisodeScore],
        times: Mapping[tuple[Cell, int], StepTime],
    ) -> None:
        """Keep what was measured."""
        self.design, self.scores, self.times = design, scores, times

    def values(self, cell: Cell, metric: str) -> FloatArray:
        """Return a field of `EpisodeScore` for each seed, shape (n_seeds,).

        Raises:
            UnmeasuredError: The cell was not run.
        """
        if (cell, self.design.seeds[0]) not in self.scores:
            raise UnmeasuredError(cell)
        return np.array([getattr(self.scores[cell, seed], metric) for seed in self.design.seeds])

    def curve(self, field: str, estimator: str, setting: Setting, metric: str) -> FloatArray:
        """Return a metric along a sweep, shape (n_points, n_seeds)."""
        cells = self.design.along(field, estimator, setting)
        return np.array([self.values(cell, metric) for cell in cells])

    def at(
        self, field: str, value: float, estimator: str, setting: Setting, metric: str
    ) -> FloatArray:
        """Return one point of a sweep, shape (n_seeds,)."""
        point = self.design.sweeps[field].values.index(value)
        return self.values(self.design.along(field, estimator, setting)[point], metric)

    def base(self, estimator: str, setting: Setting, metric: str) -> FloatArray:
        """Return a metric at the paper's privacy with the fewest CV segments, shape (n_seeds,)."""
        return self.values(self.design.base(estimator, setting), metric)

    def seconds(self, estimator: str, setting: Setting) -> FloatArray:
        """Return the time of a step for each timed seed [s], shape (n_timed,)."""
        cell = self.design.base(estimator, setting)
        seeds = self.design.seeds[: self.design.n_timed]
        if (cell, seeds[0]) not in self.times:
            raise UnmeasuredError(cell)
        return np.array([self.times[cell, seed].seconds for seed in seeds])


def slopes(places: FloatArray, curve: FloatArray) -> FloatArray:
    """Return the least-squares slope of each column of ``curve`` (n_points, n) over ``places``."""
    centred = places - places.mean()
    slope: FloatArray = centred @ curve / np.sum(centred**2)
    return slope


def roughness(curve: FloatArray) -> FloatArray:
    """Return the mean size of the second differences along a curve (n_points, n), shape (n,).

    A straight line has none, whatever its slope.
    """
    mean: FloatArray = np.abs(np.diff(curve, n=2, axis=0)).mean(axis=0)
    return mean


def correlations(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Pearson's correlation of each column of ``a`` and ``b`` (n_points, n), shape (n,)."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    product: FloatArray = (a * b).sum(axis=0) / np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return product

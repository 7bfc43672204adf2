"""Results of the reproduction as arrays, and the statistics of curves that claims are about."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from agents.experiments.cells import Results, UnmeasuredError
from agents.studies.paper.plan import PaperCell, PaperDesign, Setting
from agents.studies.paper.timing import StepTime
from dptse_env.utils.arrays import FloatArray


@dataclass(frozen=True)
class PaperResults(Results[PaperDesign, PaperCell]):
    """Scores and times of the cells of a design.

    Attributes:
        times: Time of a step by cell and traffic seed.
    """

    times: Mapping[tuple[PaperCell, int], StepTime]

    def curve(self, field: str, estimator: str, setting: Setting, metric: str) -> FloatArray:
        """Return a metric along a sweep, shape (n_points, n_seeds)."""
        cells = self.design.along(field, estimator, setting)
        return np.array([self.values(cell, metric) for cell in cells])

    def at(
        self, field: str, value: float, estimator: str, setting: Setting, metric: str
    ) -> FloatArray:
        """Return one point of a sweep, shape (n_seeds,)."""
        point = self.design.sweeps[field].index(value)
        return self.values(self.design.along(field, estimator, setting)[point], metric)

    def base(self, estimator: str, setting: Setting, metric: str) -> FloatArray:
        """Return a metric at the paper's privacy with the fewest CV segments, shape (n_seeds,)."""
        return self.values(self.design.base(estimator, setting), metric)

    def seconds(self, estimator: str, setting: Setting) -> FloatArray:
        """Return the time of a step for each timed seed [s], shape (n_timed,).

        Raises:
            UnmeasuredError: The estimator was not timed.
        """
        cell = self.design.base(estimator, setting)
        seeds = self.design.traffic_seeds[: self.design.n_timed]
        if (cell, seeds[0]) not in self.times:
            raise UnmeasuredError(cell)
        return np.array([self.times[cell, seed].seconds for seed in seeds])


def slopes(places: FloatArray, curve: FloatArray) -> FloatArray:
    """Return the least-squares slope of each column of ``curve`` (n_points, n) over ``places``."""
    centred = places - places.mean()
    slope: FloatArray = centred @ curve / np.sum(centred**2)
    return slope


def roughness(curve: FloatArray) -> FloatArray:
    """Return the mean absolute second difference along a curve (n_points, n), shape (n,).

    A straight line has none, whatever its slope.
    """
    mean: FloatArray = np.abs(np.diff(curve, n=2, axis=0)).mean(axis=0)
    return mean


def correlations(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Pearson's correlation of each column of ``a`` and ``b`` (n_points, n), shape (n,)."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    product: FloatArray = (a * b).sum(axis=0) / np.sqrt((a**2).sum(axis=0) * (b**2).sum(axis=0))
    return product

"""Releases of densities: counts of vehicles, or deviations of what vehicles report.

A vehicle reports the road x that it has to itself, by its spacing or by the number of its
neighbours (`dptse_env.traffic.ReportRecord`). With the density c that the estimator predicts, which
is public, it contributes ``u = 1 - x c``, clipped to [-D, D], over D. Since x is 1 / k in the mean,
with k the density, the expected sum of u over the connected vehicles of a segment of length l is
``p l (k - c) / D``, with p their share: nothing where the prediction is right, whatever p is.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic import Corridor, DensitySource, Penetration
from dptse_env.utils.arrays import FloatArray
from dptse_env.utils.kernels import kernel_part

DensityReports = Literal["", "mean", "centred"]
"""Form in which a release model releases what vehicles report of the density around them: their
mean, or a sum that is centred on the prediction; empty where it cannot."""

MEAN_SQUARES = {"spacing": 0.25, "neighbours": 0.15}
"""Mean square of a report's deviation at a clip of 1, on the shipped roads."""

LEAST_CENTRE = 5.0
"""Least density that reports are compared with [veh/km]."""


class DeviationTerms(NamedTuple):
    """Terms of the deviation ``slope x + offset`` of a report x, which is clipped to [-1, 1].

    Attributes:
        slope: Of each record column, shape (k, n_places).
        offset: The offset.
    """

    slope: FloatArray
    offset: float


COUNTS = DeviationTerms(np.zeros((1, 1)), 1.0)
"""Terms where vehicles are counted and report nothing."""


class DensityRelease(NamedTuple):
    """The form in which the vehicles of a mechanism tell of the density.

    Attributes:
        source: ``count``, ``spacing`` or ``neighbours``.
        clip: D, the largest relative deviation.
        largest: Largest density that deviations are taken from [veh/km].
    """

    source: DensitySource = "count"
    clip: float = 1.0
    largest: float = math.inf

    @classmethod
    def of(cls, penetration: Penetration, corridor: Corridor) -> DensityRelease:
        """Return that of the connected vehicles of a corridor."""
        return cls(penetration.density_from, penetration.report_clip, corridor.density_scale)

    @property
    def has_reports(self) -> bool:
        """True where vehicles report the density around them in place of being counted."""
        return self.source != "count"

    @property
    def quantity(self) -> str:
        """Name of what is released."""
        return f"deviation of {self.source}" if self.has_reports else "count"

    @property
    def mean_square(self) -> float:
        """Expected square of what a vehicle contributes: 1 for counts."""
        return MEAN_SQUARES[self.source] / self.clip**2 if self.has_reports else 1.0

    @property
    def details(self) -> dict[str, str | float]:
        """Entries of a privacy report; none for counts."""
        return {"density_from": self.source, "report_clip": self.clip} if self.has_reports else {}

    def centres(self, density: FloatArray) -> FloatArray:
        """Return the densities that reports are compared with [veh/km], shape (k, S).

        They are those predicted, within bounds, and the least where none is predicted.
        """
        finite = np.where(np.isfinite(density), density, 0.0)
        centre: FloatArray = np.clip(finite, LEAST_CENTRE, self.largest)
        return centre

    def terms(self, density: FloatArray) -> DeviationTerms:
        """Return the terms of deviations from predicted densities [veh/km], shape (k, S)."""
        return DeviationTerms(-self.centres(density) / self.clip, 1.0 / self.clip)


COUNTED = DensityRelease()
"""Vehicles are counted."""


@kernel_part
def deviation_of(
    report: NDArray[np.float32], slope: FloatArray, offset: float, row: int, k: int, place: int
) -> float:
    """Return what the vehicle of a row adds to the sum of its place: 1 without reports."""
    if report.size == 0:
        return 1.0
    return float(min(max(slope[k, place] * report[row] + offset, -1.0), 1.0))

"""Surroundings of vehicles: the vehicle ahead in the lane, and the vehicles near by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.branches import Road
from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.detailed_record import DetailedRecord
from dptse_env.traffic.record import Record
from dptse_env.utils.arrays import FloatArray, IntArray

NEAREST, FARTHEST = 0.001, 1.0
"""Least and largest distance to the vehicle ahead in its lane that a vehicle reports [km]; vehicles
of a simulation overlap for a moment while they merge."""


@dataclass(frozen=True, eq=False)
class ReportRecord(Record):
    """A record in which each vehicle reports the road that it has to itself.

    Attributes:
        report: (rows,) float32, that road [km]: the reciprocal of the density around the vehicle.
    """

    COLUMNS: ClassVar[Mapping[str, np.dtype[Any]]] = {
        **Record.COLUMNS,
        "report": np.dtype("<f4"),
    }

    report: NDArray[np.float32]

    @classmethod
    def of(cls, record: Record, report: FloatArray) -> ReportRecord:
        """Return a record with reports, shape (rows,)."""
        columns = {name: getattr(record, name) for name in Record.COLUMNS}
        return cls(
            **columns, n_steps=record.n_steps, n_columns=record.n_columns,
            report=report.astype(np.float32),
        )  # fmt: skip

    def traffic(self, lengths: FloatArray, limits: FloatArray) -> FloatArray:
        """See `Record.traffic`; densities are those reported, 0 where no vehicle reports.

        They are the vehicles of a segment over the road that these have to themselves.
        """
        traffic = super().traffic(lengths, limits)
        counts, road = self.counts, self._per_cell(self.report, np.float64)
        traffic[..., 0] = np.where(counts > 0, counts / np.where(counts > 0, road, 1.0), 0.0)
        return traffic


def road_by_spacing(record: DetailedRecord, corridor: Corridor) -> FloatArray:
    """Return the road that each vehicle has to itself [km], shape (rows,).

    That is the distance to the front of the vehicle ahead in its lane, over the number of lanes.
    The mean over all vehicles is the reciprocal of the density (Edie, 1963; for vehicles that
    measure their spacing: Seo et al., 2015). On a ramp only the vehicles of the ramp are ahead.
    """
    branch, position = _places(record, corridor)
    order = np.lexsort((position, record.lane, branch, record.step))
    same = np.ones(max(record.n_rows - 1, 0), dtype=bool)
    for column in (record.lane, branch, record.step):
        same &= np.diff(column[order]) == 0
    ahead = np.full(record.n_rows, FARTHEST)
    ahead[order[:-1][same]] = np.diff(position[order])[same]
    lanes = np.array(corridor.with_boundaries(corridor.segment_lanes))
    road: FloatArray = np.clip(ahead, NEAREST, FARTHEST) / lanes[record.segment]
    return road


def road_by_neighbours(record: DetailedRecord, corridor: Corridor, reach: float) -> FloatArray:
    """Return the road that each vehicle shares with its neighbours, over their number [km].

    The neighbours are the vehicles within a reach [km] ahead and behind on the same branch, itself
    among them; the road is the part of that stretch which is recorded. Where vehicles stand at
    random, the mean is the reciprocal of the density but for a factor of ``1 - exp(-n)``, with n
    the expected number of vehicles on the stretch; the mean of the reciprocals would be one vehicle
    too many. Shape (rows,).
    """
    branch, position = _places(record, corridor)
    ends = _ends(corridor)[branch]
    # Branches of a step one after another on a single axis, so that one search serves all.
    apart = float(np.ptp(ends)) + 2.0 * reach + 1.0 if record.n_rows else 1.0
    place = record.step.astype(np.int64) * (int(branch.max(initial=0)) + 1) + branch
    axis = place * apart + position
    ordered = np.sort(axis)
    within = np.searchsorted(ordered, axis + reach, side="right") - np.searchsorted(
        ordered, axis - reach, side="left"
    )
    stretch = np.minimum(position + reach, ends[:, 1]) - np.maximum(position - reach, ends[:, 0])
    road: FloatArray = np.maximum(stretch, NEAREST) / within
    return road


def _places(record: DetailedRecord, corridor: Corridor) -> tuple[IntArray, FloatArray]:
    """Return the branch of each row, and its position along the branch [km]."""
    branch = Road(corridor).column_starts[0].astype(np.int64)[record.segment]
    return branch, record.position.astype(np.float64)


def _ends(corridor: Corridor) -> FloatArray:
    """Return start and end of the columns of each branch [km], shape (branches, 2)."""
    branch, start = Road(corridor).column_starts
    end = start + np.array(corridor.with_boundaries(corridor.segment_lengths))
    return np.array(
        [[start[branch == b].min(), end[branch == b].max()] for b in range(branch.max() + 1)]
    )

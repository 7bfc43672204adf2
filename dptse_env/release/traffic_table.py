"""True density and mean speed of every segment, by traffic seed and second."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dptse_env.traffic import Corridor, Record, RecordLibrary
from dptse_env.utils.arrays import FloatArray, IntArray


class TrafficTable:
    """The true traffic of a set of traffic seeds, in memory.

    Aggregates are made once per record and kept in one table, so that a batch of episodes reads
    its traffic with a single index. A mean speed is over vehicles; an empty segment has the road's
    speed limit, so that no gap tells that nobody is there.
    """

    def __init__(
        self, corridor: Corridor, traffic_seeds: tuple[int, ...], library: RecordLibrary
    ) -> None:
        """Prepare a table for ``traffic_seeds``; nothing is loaded or recorded yet."""
        self.corridor, self.traffic_seeds, self.library = corridor, traffic_seeds, library
        columns = corridor.n_segments + corridor.n_boundaries
        # np.empty takes address space, not memory, until a record is written into its place.
        self._table = np.empty((len(traffic_seeds), corridor.duration + 1, columns, 2))
        self._loaded = np.zeros(len(traffic_seeds), dtype=bool)

    def load(self, indices: npt.ArrayLike) -> list[tuple[int, Record]]:
        """Read or make the records of some traffic seeds; return those that are new in memory.

        Several that are missing on disk are recorded at once, on all cores.

        Args:
            indices: Into ``traffic_seeds``, one or more.

        Returns:
            The index and the record of each that was not in memory before.
        """
        new = [index for index in np.unique(indices).tolist() if not self._loaded[index]]
        if len(new) > 1:
            self.library.ensure(self.corridor, [self.traffic_seeds[index] for index in new])
        records = []
        for index in new:
            record = self.record(index)
            counts = record.counts
            self._table[index, ..., 0] = counts / self.corridor.segment_length
            mean = record.speed_sums / np.maximum(counts, 1)
            self._table[index, ..., 1] = np.where(counts > 0, mean, self.corridor.speed_limit)
            self._loaded[index] = True
            records.append((index, record))
        return records

    def record(self, index: int) -> Record:
        """Return the record of ``traffic_seeds[index]``, made now if there is none."""
        return self.library.get(self.corridor, self.traffic_seeds[index])

    def aggregates(
        self, indices: IntArray, times: IntArray, n_columns: int | None = None
    ) -> FloatArray:
        """Return (density [veh/km], speed [km/h]) of every segment, shape (k, S, 2).

        Args:
            indices: Of the traffic seeds, shape (k,); loaded before.
            times: Seconds of their records, shape (k,).
            n_columns: Number of columns, if not the S segments.
        """
        rows: FloatArray = self._table[indices, times, : n_columns or self.corridor.n_segments]
        return rows

    def whole(self, index: int) -> FloatArray:
        """Return the same for all segments over a whole record, shape (T + 1, S + R, 2).

        The boundary segments come last, in the order of `dptse_env.traffic.corridor`.
        """
        traffic: FloatArray = self._table[index]
        return traffic

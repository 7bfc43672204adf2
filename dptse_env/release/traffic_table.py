"""True density and mean speed of every segment, by traffic seed and second."""

import numpy as np
import numpy.typing as npt

from dptse_env.traffic import Corridor, Record, RecordLibrary
from dptse_env.utils.arrays import FloatArray, IntArray


class TrafficTable:
    """The true traffic of a set of traffic seeds, in memory.

    Aggregates are computed once per record and stored in one table, so that a batch of episodes
    reads its traffic with a single index. A mean speed is over vehicles; an empty segment has its
    speed limit, so that no gap reveals that it is empty.
    """

    def __init__(
        self, corridor: Corridor, traffic_seeds: tuple[int, ...], library: RecordLibrary
    ) -> None:
        """Prepare a table for ``traffic_seeds``; nothing is loaded or recorded yet."""
        self.corridor, self.traffic_seeds, self.library = corridor, traffic_seeds, library
        columns = corridor.n_segments + corridor.n_boundaries
        # np.empty takes address space, not memory, until a record is written.
        self._table = np.empty((len(traffic_seeds), corridor.duration + 1, columns, 2))
        self._loaded = np.zeros(len(traffic_seeds), dtype=bool)
        self._lengths = np.array(corridor.with_boundaries(corridor.segment_lengths))
        self.limits = np.array(corridor.with_boundaries(corridor.speed_limits))

    def load(self, indices: npt.ArrayLike) -> list[tuple[int, Record]]:
        """Load the records of some traffic seeds; return those that were not in memory before.

        Records that are missing on disk are made, on all cores where there are several. The result
        has the index into ``traffic_seeds`` and the record of each.
        """
        new = [index for index in np.unique(indices).tolist() if not self._loaded[index]]
        if len(new) > 1:
            self.library.ensure(self.corridor, [self.traffic_seeds[index] for index in new])
        records = []
        for index in new:
            record = self.record(index)
            self._table[index] = record.traffic(self._lengths, self.limits)
            self._loaded[index] = True
            records.append((index, record))
        return records

    def record(self, index: int) -> Record:
        """Return the record of ``traffic_seeds[index]``, which is made now if it is missing."""
        return self.library.get(self.corridor, self.traffic_seeds[index])

    def aggregates(
        self, indices: IntArray, times: IntArray, n_columns: int | None = None
    ) -> FloatArray:
        """Return (density [veh/km], speed [km/h]) of every segment, shape (k, S, 2).

        Args:
            indices: Indices of loaded traffic seeds, shape (k,).
            times: Seconds of their records, shape (k,).
            n_columns: Number of columns; None for the S segments.
        """
        rows: FloatArray = self._table[indices, times, : n_columns or self.corridor.n_segments]
        return rows

    def complete(self, index: int) -> FloatArray:
        """Return density and speed of all segments over a complete record, (T + 1, S + R, 2).

        The boundary segments come last, in the order of `dptse_env.traffic.corridor`.
        """
        traffic: FloatArray = self._table[index]
        return traffic

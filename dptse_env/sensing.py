"""From records and query masks to true aggregates: what the vehicles would answer without noise."""

from __future__ import annotations

import numpy as np

from dptse_env.arrays import FloatArray, IntArray
from dptse_env.traffic import Corridor, RecordLibrary


class Sensing:
    """The true density and mean speed of every segment, for a set of traffic seeds.

    Aggregates are made once per record and kept in one table, so that a batch of episodes reads
    its traffic with a single index. A mean speed is over vehicles; an empty segment answers with
    the road's speed limit, so that an answer never tells by its absence that nobody is there.
    """

    def __init__(
        self, corridor: Corridor, traffic_seeds: tuple[int, ...], library: RecordLibrary
    ) -> None:
        """Prepare a table for ``traffic_seeds``; nothing is loaded or recorded yet."""
        self.corridor, self.traffic_seeds, self.library = corridor, traffic_seeds, library
        columns = corridor.n_segments + corridor.n_boundaries
        # np.empty takes address space, not memory, until a record is written into its slot.
        self._table = np.empty((len(traffic_seeds), corridor.duration + 1, columns, 2))
        self._loaded = np.zeros(len(traffic_seeds), dtype=bool)

    def load(self, slot: int) -> bool:
        """Read or make the record of ``traffic_seeds[slot]``; return whether it was new."""
        if self._loaded[slot]:
            return False
        record = self.library.get(self.corridor, self.traffic_seeds[slot])
        counts = record.counts
        self._table[slot, ..., 0] = counts / self.corridor.segment_length
        mean = record.speed_sums / np.maximum(counts, 1)
        self._table[slot, ..., 1] = np.where(counts > 0, mean, self.corridor.speed_limit)
        self._loaded[slot] = True
        return True

    def aggregates(self, slots: IntArray, times: IntArray) -> FloatArray:
        """Return (density [veh/km], speed [km/h]) of every segment, shape (k, S, 2).

        Args:
            slots: Which traffic, shape (k,); loaded before.
            times: Which second of it, shape (k,).
        """
        rows: FloatArray = self._table[slots, times, : self.corridor.n_segments]
        return rows

    def traffic(self, slot: int) -> FloatArray:
        """Return the same for all segments over a whole record, shape (T + 1, S + R, 2).

        The boundary segments come last, in the order of `dptse_env.traffic.corridor`.
        """
        traffic: FloatArray = self._table[slot]
        return traffic

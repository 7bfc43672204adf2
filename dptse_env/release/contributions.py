"""Bounded contributions of vehicles to the releases of queried segments.

A vehicle adds 1 and its speed to the sums of its segment. It counts in the first C steps in which
its segment is queried, and in no later one. Whether it counts depends on its trajectory and on the
queries, which are public, and never on other vehicles: removing a vehicle from a record does not
change the contributions of the others.
"""

import numpy as np
from numpy.typing import NDArray

from dptse_env.release.vehicle_table import VehicleTable, widened
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.kernels import kernel


class Contributions:
    """Contributions of the vehicles of a set of records, in each episode.

    Attributes:
        vehicles: The vehicles by second.
        cap: C, steps in which a vehicle counts; None if it counts in all of them.
        exposures: Shape (n_episodes, n_vehicles), steps in which each vehicle has counted; as wide
            as the largest record loaded.
    """

    def __init__(
        self,
        n_slots: int,
        n_steps: int,
        n_episodes: int,
        largest_speed: float,
        cap: int | None,
        places: IntArray,
    ) -> None:
        """Prepare for up to `n_slots` records; speeds are clipped to `largest_speed` [km/h].

        `places` are the distinct record columns of the columns of a release.
        """
        self.cap = cap
        self._limit = n_steps if cap is None else cap
        self.vehicles = VehicleTable(n_slots, n_steps, largest_speed)
        self._column: IntArray = np.full(int(places.max()) + 1, -1, dtype=np.int64)
        self._column[places] = np.arange(places.size)
        self.exposures: NDArray[np.int32] = np.zeros((n_episodes, 0), dtype=np.int32)

    def load(self, slot: int, record: Record) -> None:
        """Read the vehicles of a record."""
        self.vehicles.load(slot, record)
        self.exposures = widened(self.exposures, record.n_vehicles)

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,): no vehicle has counted yet."""
        self.exposures[episodes] = 0

    def exposures_of(self, episode: int, slot: int) -> NDArray[np.int32]:
        """Return the contributions of each vehicle of a slot's record, shape (n_vehicles,).

        Neither values nor length depend on the records of other episodes.
        """
        return self.exposures[episode, : self.vehicles.n_vehicles[slot]].copy()

    def collect(
        self, episodes: IntArray, slots: IntArray, times: IntArray, observed: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Count the vehicles of a step in the observed record columns, and charge them.

        Args:
            episodes: Shape (k,).
            slots: Slots of their records, shape (k,).
            times: Seconds of the records, shape (k,).
            observed: Shape (k, n_columns).

        Returns:
            The number of vehicles that count, and the sum of their clipped speeds [km/h], both of
            shape (k, n_columns) and zero in columns that are not observed.
        """
        counts, speeds = np.zeros((2, *observed.shape))
        table = self.vehicles
        _collect(
            table.start, table.vehicle, table.segment, table.speed, episodes, slots, times,
            self._column, observed, self._limit, self.exposures, counts, speeds,
        )  # fmt: skip
        return counts, speeds


@kernel
def _collect(
    start: IntArray,
    vehicle: NDArray[np.int32],
    segment: NDArray[np.int16],
    speed: NDArray[np.float32],
    episodes: IntArray,
    slots: IntArray,
    times: IntArray,
    column: IntArray,
    observed: BoolArray,
    limit: int,
    exposures: NDArray[np.int32],
    counts: FloatArray,
    speeds: FloatArray,
) -> None:
    for k in range(episodes.size):
        spent = exposures[episodes[k]]
        for row in range(start[slots[k], times[k]], start[slots[k], times[k] + 1]):
            s, v = segment[row], vehicle[row]
            c = column[s] if s < column.size else -1
            if c >= 0 and observed[k, c] and spent[v] < limit:
                spent[v] += 1
                counts[k, c] += 1.0
                speeds[k, c] += speed[row]

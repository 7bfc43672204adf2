"""Bounded contributions of vehicles to the releases of queried segments.

A vehicle counts in the first C steps in which its segment is queried, and in no later one. Whether
it counts depends on its trajectory and on the queries, which are public, and never on other
vehicles: removing a vehicle from a record does not change the contributions of the others.
"""

from typing import TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dptse_env.traffic import Record
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray

NumberT = TypeVar("NumberT", bound=np.generic)

GROWTH = 1.5  # factor on the size of full tables


class Contributions:
    """Vehicle tables of a set of records, with the contributions of each vehicle in each episode.

    Attributes:
        cap: C, steps in which a vehicle counts; None if it counts in all of them.
        exposures: Shape (n_episodes, n_vehicles), steps in which each vehicle has counted; as wide
            as the largest record loaded.
    """

    def __init__(
        self, n_slots: int, n_steps: int, n_episodes: int, largest_speed: float, cap: int | None
    ) -> None:
        """Prepare for up to `n_slots` records; speeds are clipped to `largest_speed` [km/h]."""
        self.cap, self.largest_speed = cap, largest_speed
        self._limit = n_steps if cap is None else cap
        self._start = np.zeros((n_slots, n_steps + 1), dtype=np.int64)
        self._n_vehicles = np.zeros(n_slots, dtype=np.int64)
        self._rows = 0
        self._vehicle: NDArray[np.int32] = np.empty(0, dtype=np.int32)
        self._segment: NDArray[np.int16] = np.empty(0, dtype=np.int16)
        self._speed: NDArray[np.float32] = np.empty(0, dtype=np.float32)
        self.exposures: NDArray[np.int32] = np.zeros((n_episodes, 0), dtype=np.int32)

    @property
    def tables(self) -> tuple[AnyArray, ...]:
        """Vehicle tables of all records, which no episode changes."""
        return self._start, self._n_vehicles, self._vehicle, self._segment, self._speed

    def load(self, slot: int, record: Record) -> None:
        """Append the vehicle table of a record."""
        end = self._rows + record.n_rows
        if end > len(self._vehicle):
            size = max(end, int(GROWTH * len(self._vehicle)))
            self._vehicle = _grown(self._vehicle, size)
            self._segment = _grown(self._segment, size)
            self._speed = _grown(self._speed, size)
        if record.n_vehicles > self.exposures.shape[1]:
            wider = np.zeros((len(self.exposures), record.n_vehicles), dtype=np.int32)
            wider[:, : self.exposures.shape[1]] = self.exposures
            self.exposures = wider
        self._vehicle[self._rows : end] = record.vehicle
        self._segment[self._rows : end] = record.segment
        self._speed[self._rows : end] = np.clip(record.speed, 0.0, self.largest_speed)
        self._start[slot] = self._rows + record.offsets
        self._n_vehicles[slot] = record.n_vehicles
        self._rows = end

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,): no vehicle has counted yet."""
        self.exposures[episodes] = 0

    def exposures_of(self, episode: int, slot: int) -> NDArray[np.int32]:
        """Return the contributions of each vehicle of a slot's record, shape (n_vehicles,).

        Neither values nor length depend on the records of other episodes.
        """
        return self.exposures[episode, : self._n_vehicles[slot]].copy()

    def collect(
        self, episodes: IntArray, slots: IntArray, times: IntArray, observed: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Count the vehicles of a step in the observed record columns, and charge them.

        Episodes, slots of their records and seconds of these have shape (k,). Returned are the
        number of vehicles that count and the sum of their clipped speeds [km/h], both of shape
        (k, n_columns) and zero in columns that are not observed.
        """
        counts, speeds = np.zeros((2, *observed.shape))
        _collect(
            self._start, self._vehicle, self._segment, self._speed, episodes, slots, times,
            observed, self._limit, self.exposures, counts, speeds,
        )  # fmt: skip
        return counts, speeds


def _grown(column: NDArray[NumberT], size: int) -> NDArray[NumberT]:
    """Return a longer copy of a column; values beyond its end are undefined."""
    longer = np.empty(size, dtype=column.dtype)
    longer[: len(column)] = column
    return longer


@njit(cache=True, error_model="numpy")
def _collect(
    start: IntArray,
    vehicle: NDArray[np.int32],
    segment: NDArray[np.int16],
    speed: NDArray[np.float32],
    episodes: IntArray,
    slots: IntArray,
    times: IntArray,
    observed: BoolArray,
    limit: int,
    exposures: NDArray[np.int32],
    counts: FloatArray,
    speeds: FloatArray,
) -> None:
    n_columns = observed.shape[1]
    for k in range(episodes.size):
        spent = exposures[episodes[k]]
        for row in range(start[slots[k], times[k]], start[slots[k], times[k] + 1]):
            s, v = segment[row], vehicle[row]
            if s < n_columns and observed[k, s] and spent[v] < limit:
                spent[v] += 1
                counts[k, s] += 1.0
                speeds[k, s] += speed[row]

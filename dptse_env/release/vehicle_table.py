"""Vehicles of a set of records by second: who is on which segment, and how fast."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic import Record
from dptse_env.utils.arrays import AnyArray, IntArray

NumberT = TypeVar("NumberT", bound=np.generic)

GROWTH = 1.5  # factor on the size of full tables


class VehicleTable:
    """Vehicles of a set of records, in one table of a row for each vehicle and second.

    Attributes:
        start: First row of each second of each record, shape (n_slots, n_steps + 1).
        n_vehicles: Vehicles of each record, shape (n_slots,).
        vehicle: Index of the row's vehicle in its record.
        segment: Column of the record that it is on.
        speed: Its speed [km/h], clipped to `largest_speed`.
    """

    def __init__(self, n_slots: int, n_steps: int, largest_speed: float) -> None:
        """Prepare for up to `n_slots` records of `n_steps` seconds."""
        self.largest_speed = largest_speed
        self.start: IntArray = np.zeros((n_slots, n_steps + 1), dtype=np.int64)
        self.n_vehicles: IntArray = np.zeros(n_slots, dtype=np.int64)
        self.vehicle: NDArray[np.int32] = np.empty(0, dtype=np.int32)
        self.segment: NDArray[np.int16] = np.empty(0, dtype=np.int16)
        self.speed: NDArray[np.float32] = np.empty(0, dtype=np.float32)
        self._rows = 0

    @property
    def arrays(self) -> tuple[AnyArray, ...]:
        """All arrays, which no episode changes."""
        return self.start, self.n_vehicles, self.vehicle, self.segment, self.speed

    def load(self, slot: int, record: Record) -> None:
        """Append the vehicles of a record."""
        end = self._rows + record.n_rows
        if end > len(self.vehicle):
            size = max(end, int(GROWTH * len(self.vehicle)))
            self.vehicle = _grown(self.vehicle, size)
            self.segment = _grown(self.segment, size)
            self.speed = _grown(self.speed, size)
        self.vehicle[self._rows : end] = record.vehicle
        self.segment[self._rows : end] = record.segment
        self.speed[self._rows : end] = np.clip(record.speed, 0.0, self.largest_speed)
        self.start[slot] = self._rows + record.offsets
        self.n_vehicles[slot] = record.n_vehicles
        self._rows = end


def widened(spent: NDArray[NumberT], n_vehicles: int) -> NDArray[NumberT]:
    """Return a table of episodes by vehicles with room for a record's vehicles, zero so far."""
    if n_vehicles <= spent.shape[1]:
        return spent
    wider = np.zeros((len(spent), n_vehicles), dtype=spent.dtype)
    wider[:, : spent.shape[1]] = spent
    return wider


def _grown(column: NDArray[NumberT], size: int) -> NDArray[NumberT]:
    """Return a longer copy of a column; values beyond its end are undefined."""
    longer = np.empty(size, dtype=column.dtype)
    longer[: len(column)] = column
    return longer

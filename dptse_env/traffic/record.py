"""Records: segment and speed of each vehicle at every second."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.stored_arrays import InvalidRecordError, load_arrays, save_arrays
from dptse_env.utils.arrays import BoolArray
from dptse_env.utils.fields import integer, require

RECORD_FORMAT = "dptse-record"
RECORD_VERSION = 1
"""Version of the format, raised when content or layout change: older records are made again."""


@dataclass(frozen=True, eq=False)
class Record:
    """The vehicle table of one simulated scenario, at most one row per vehicle and step.

    Step k is the state of the road k seconds after the start, so step 0 is the empty road. Within a
    step, a recording lists the vehicles segment by segment.

    Attributes:
        step: (rows,) int32, non-decreasing, in 0..n_steps-1.
        vehicle: (rows,) int32, index of the vehicle in its scenario.
        segment: (rows,) int16, record column: the S segments, then the boundary segments.
        speed: (rows,) float32 [km/h].
        n_steps: number of steps.
        n_columns: number of record columns, S + R.

    Raises:
        ValueError: The columns differ in length, are not ordered by step, leave their range, or
            have a vehicle twice in one step.
    """

    COLUMNS: ClassVar[Mapping[str, np.dtype[Any]]] = {
        "step": np.dtype("<i4"),
        "vehicle": np.dtype("<i4"),
        "segment": np.dtype("<i2"),
        "speed": np.dtype("<f4"),
    }
    """Columns of the vehicle table and how they are stored."""

    step: NDArray[np.int32]
    vehicle: NDArray[np.int32]
    segment: NDArray[np.int16]
    speed: NDArray[np.float32]
    n_steps: int
    n_columns: int

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        object.__setattr__(self, "n_steps", integer("record.n_steps", self.n_steps, 1))
        object.__setattr__(self, "n_columns", integer("record.n_columns", self.n_columns, 1))
        for name, dtype in self.COLUMNS.items():
            column = np.asarray(getattr(self, name), dtype=dtype)
            require(column.ndim == 1, f"record.{name}", "one-dimensional", column.shape)
            allowed = f"as long as record.step ({len(self.step)})"
            require(len(column) == len(self.step), f"record.{name}", allowed, len(column))
            if column.flags.writeable:
                column = column.copy()
                column.flags.writeable = False
            object.__setattr__(self, name, column)
        if len(self.step):
            self._check_rows()

    def _check_rows(self) -> None:
        require(bool(np.all(np.diff(self.step) >= 0)), "record.step", "non-decreasing", self.step)
        for name, bound in (("step", self.n_steps), ("segment", self.n_columns)):
            low, high = int(getattr(self, name).min()), int(getattr(self, name).max())
            require(low >= 0 and high < bound, f"record.{name}", f"in 0..{bound - 1}", (low, high))
        require(int(self.vehicle.min()) >= 0, "record.vehicle", ">= 0", int(self.vehicle.min()))
        valid = bool(np.isfinite(self.speed).all() and self.speed.min() >= 0.0)
        require(valid, "record.speed", "finite and >= 0", self.speed.min())
        # Privacy relies on this: a vehicle is on one segment at a step and counts there once.
        places = np.sort(self.step.astype(np.int64) * self.n_vehicles + self.vehicle)
        twice = np.flatnonzero(places[1:] == places[:-1])
        if len(twice):
            step, vehicle = divmod(int(places[twice[0]]), self.n_vehicles)
            raise ValueError(
                f"record.vehicle must be at most once in a step, got vehicle {vehicle} twice in "
                f"step {step}"
            )

    @property
    def n_rows(self) -> int:
        """Number of rows of the vehicle table."""
        return len(self.step)

    @cached_property
    def n_vehicles(self) -> int:
        """Largest vehicle index plus one: the length of an array with one entry per vehicle."""
        return int(self.vehicle.max()) + 1 if self.n_rows else 0

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """(n_steps, n_columns) number of vehicles on each segment at each step."""
        return self._per_cell(None, np.int64)

    @cached_property
    def speed_sums(self) -> NDArray[np.float64]:
        """(n_steps, n_columns) sum of the vehicles' speeds on each segment at each step [km/h].

        Divided by `counts` it is the mean speed over vehicles. SUMO's mean speed of an edge is not
        used: it counts an empty lane as a vehicle at the limit.
        """
        return self._per_cell(self.speed, np.float64)

    def _per_cell(self, weights: NDArray[np.float32] | None, dtype: type) -> NDArray[Any]:
        cells = self.step.astype(np.int64) * self.n_columns + self.segment
        flat = np.bincount(cells, weights, minlength=self.n_steps * self.n_columns)
        grid: NDArray[Any] = flat.reshape(self.n_steps, self.n_columns).astype(dtype, copy=False)
        grid.flags.writeable = False
        return grid

    @cached_property
    def offsets(self) -> NDArray[np.int64]:
        """(n_steps + 1,) first row of each step; the last entry is the number of rows."""
        offsets = np.searchsorted(self.step, np.arange(self.n_steps + 1)).astype(np.int64)
        offsets.flags.writeable = False
        return offsets

    def rows(self, step: int) -> slice:
        """Return the rows of one step, for use as ``record.vehicle[record.rows(step)]``."""
        integer("step", step, 0, self.n_steps - 1)
        return slice(int(self.offsets[step]), int(self.offsets[step + 1]))

    def without(self, vehicle: int) -> "Record":
        """Return the adjacent record, in the sense of differential privacy, without a vehicle.

        The other vehicles move as before; they are not simulated again.
        """
        return self.where(self.vehicle != vehicle)

    def where(self, keep: BoolArray) -> "Record":
        """Return the record of some rows, given by flags of shape (rows,).

        Vehicles keep their indices.
        """
        columns: dict[str, Any] = {name: getattr(self, name)[keep] for name in self.COLUMNS}
        return replace(self, **columns)

    def in_memory(self) -> "Record":
        """Return the same record, independent of the files it was mapped from."""
        columns: dict[str, Any] = {name: np.array(getattr(self, name)) for name in self.COLUMNS}
        return replace(self, **columns)

    def save(self, path: Path, source: Mapping[str, object]) -> None:
        """Write the record to the directory `path`, completely or not at all.

        An existing record stays: recording is deterministic, so it is the same.

        Args:
            path: directory to create; its parents are created too.
            source: JSON description of the recorded scenario, checked again by `load`.

        Raises:
            OSError: It cannot be written; `path` is then unchanged.
        """
        header = {
            "format": RECORD_FORMAT,
            "version": RECORD_VERSION,
            "n_steps": self.n_steps,
            "n_columns": self.n_columns,
            "source": dict(source),
        }
        save_arrays(path, {name: getattr(self, name) for name in self.COLUMNS}, header)

    @classmethod
    def load(cls, path: Path, source: Mapping[str, object]) -> "Record":
        """Open a stored record; its columns are mapped into memory, read-only.

        Args:
            path: the record's directory.
            source: the expected description, as given to `save`.

        Raises:
            FileNotFoundError: There is no such directory.
            InvalidRecordError: The record is damaged, incomplete, of another format version, or of
                another source.
        """
        wanted = {"format": RECORD_FORMAT, "version": RECORD_VERSION, "source": dict(source)}
        columns, header = load_arrays(path, list(cls.COLUMNS), wanted)
        try:
            fields: dict[str, Any] = {**columns, **header}
            return cls(**{name: value for name, value in fields.items() if name not in wanted})
        except (ValueError, LookupError, TypeError) as error:
            raise InvalidRecordError(f"{path}: {error!r}") from error

    def traffic(
        self, lengths: NDArray[np.float64], limits: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return density [veh/km] and mean speed over vehicles [km/h], (n_steps, n_columns, 2).

        Args:
            lengths: (n_columns,) lengths of the record columns [km].
            limits: (n_columns,) their speed limits [km/h], the speed of an empty one.
        """
        counts = self.counts
        mean = self.speed_sums / np.maximum(counts, 1)
        return np.stack([counts / lengths, np.where(counts > 0, mean, limits)], axis=-1)


def mean_dwell(records: Iterable[Record], n_mainline: int) -> float:
    """Measure T_avg of the paper's eq. (6): the average time of a vehicle on a mainline segment.

    It is the mean number of consecutive steps [s] of a vehicle on a mainline segment, over all
    passages. A passage between two steps is not counted.

    Raises:
        ValueError: No vehicle was ever on the mainline.
    """
    n_rows = n_passages = 0
    for record in records:
        mainline = record.segment < n_mainline
        step, vehicle, segment = (
            column[mainline].astype(np.int64)
            for column in (record.step, record.vehicle, record.segment)
        )
        order = np.lexsort((step, segment, vehicle))
        same_vehicle = np.diff(vehicle[order]) == 0
        same_segment = np.diff(segment[order]) == 0
        next_step = np.diff(step[order]) == 1
        n_rows += len(step)
        n_passages += len(step) - int(np.sum(same_vehicle & same_segment & next_step))
    require(n_passages > 0, "records", "records with a vehicle on the mainline", n_passages)
    return n_rows / n_passages

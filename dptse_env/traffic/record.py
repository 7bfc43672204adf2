"""Records: what is on a road at every second, vehicles or a measured field.

A record is one file in the format of safetensors (`dptse_env.utils.files`).
"""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.corridor import Corridor
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.utils.files import read_tensors, write_tensors
from dptse_env.utils.units import HOUR
from dptse_env.utils.validation import integer, require

RECORD_FORMAT = "dptse-record"
RECORD_VERSION = 2
"""Version of the format, raised when content or layout change: older records are made again."""

MOST_VEHICLES = 2**20
"""Largest number of vehicles of a record, of which sums are exact and ledgers fit into memory."""

LARGEST_RECORD = 2**30
"""Largest size of a stored record [bytes]: 75 million rows."""


class InvalidRecordError(ValueError):
    """A stored record is damaged, incomplete, or not the requested one."""


def _no_rows() -> AnyArray:
    return np.empty(0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Record:
    """Traffic on a road, second by second: a table of vehicles, or a measured field.

    Step k is the state of the road k seconds after the start. A table has at most one row for each
    vehicle and step, and within a step it lists the vehicles segment by segment. A measured
    field has no rows. Columns are the S segments, then the R boundary segments.

    Attributes:
        n_steps: number of steps.
        n_columns: number of record columns, S + R.
        step: (rows,) int32, non-decreasing, in 0..n_steps-1.
        vehicle: (rows,) int32, index of the vehicle in its scenario, in 0..`MOST_VEHICLES` - 1, at
            most once in a step.
        segment: (rows,) int16, record column that the vehicle is on.
        speed: (rows,) float32, at least 0 [km/h].
        field: None for vehicles; or else (n_steps, n_columns, 2) float64, at least 0, the density
            [veh/km] and the mean speed [km/h].

    Raises:
        ValueError: An array has another shape, leaves its range, or is not ordered as stated.
    """

    COLUMNS: ClassVar[Mapping[str, np.dtype[Any]]] = {
        "step": np.dtype("<i4"),
        "vehicle": np.dtype("<i4"),
        "segment": np.dtype("<i2"),
        "speed": np.dtype("<f4"),
    }
    """Columns of the table of vehicles and their types."""

    n_steps: int
    n_columns: int
    step: NDArray[np.int32] = dataclasses.field(default_factory=_no_rows, repr=False)
    vehicle: NDArray[np.int32] = dataclasses.field(default_factory=_no_rows, repr=False)
    segment: NDArray[np.int16] = dataclasses.field(default_factory=_no_rows, repr=False)
    speed: NDArray[np.float32] = dataclasses.field(default_factory=_no_rows, repr=False)
    field: FloatArray | None = dataclasses.field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check the fields and bring them to their declared types."""
        for name in ("n_steps", "n_columns"):
            object.__setattr__(self, name, integer(f"record.{name}", getattr(self, name), 1))
        shape = np.shape(self.step)[:1]
        for name, dtype in self.COLUMNS.items():
            self._keep(name, dtype, shape)
        if self.field is not None:
            require(not self.n_rows, "record.field", "None where there are vehicles", "a field")
            field = self._keep("field", np.dtype("<f8"), (self.n_steps, self.n_columns, 2))
            sound = bool(np.isfinite(field).all() and field.min() >= 0.0)
            require(sound, "record.field", "finite and >= 0", float(field.min()))
        elif self.n_rows:
            self._check_rows()

    def _keep(self, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> AnyArray:
        array = np.asarray(getattr(self, name), dtype=dtype)
        require(array.shape == shape, f"record.{name}", f"of shape {shape}", array.shape)
        if array.flags.writeable:
            array = array.copy()
            array.flags.writeable = False
        object.__setattr__(self, name, array)
        return array

    def _check_rows(self) -> None:
        back = np.flatnonzero(self.step[1:] < self.step[:-1])
        if len(back):
            pair = tuple(self.step[back[0] : back[0] + 2].tolist())
            raise ValueError(f"record.step must be non-decreasing, got {pair}")
        bounds = {"step": self.n_steps, "segment": self.n_columns, "vehicle": MOST_VEHICLES}
        for name, bound in bounds.items():
            low, high = int(getattr(self, name).min()), int(getattr(self, name).max())
            require(low >= 0 and high < bound, f"record.{name}", f"in 0..{bound - 1}", (low, high))
        sound = bool(np.isfinite(self.speed).all() and self.speed.min() >= 0.0)
        require(sound, "record.speed", "finite and >= 0", float(self.speed.min()))
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
    def has_vehicles(self) -> bool:
        """True for a table of vehicles, which may be empty; False for a measured field."""
        return self.field is None

    def vehicles_for(self, user: str) -> "Record":
        """Return this record, which has vehicles; `user` names in the error what needs them.

        Raises:
            ValueError: The record is a measured field.
        """
        if self.has_vehicles:
            return self
        raise ValueError(
            f"{user} needs the vehicles of a record, and this traffic is a measured field of "
            "density and speed: use the release model 'printed' or 'corrected'"
        )

    @property
    def n_rows(self) -> int:
        """Number of rows of the table of vehicles."""
        return len(self.step)

    @cached_property
    def n_vehicles(self) -> int:
        """Largest vehicle index plus one: the length of an array with one entry per vehicle."""
        return int(self.vehicle.max()) + 1 if self.n_rows else 0

    @cached_property
    def counts(self) -> IntArray:
        """(n_steps, n_columns) number of vehicles on each segment at each step."""
        return self._per_cell(None, np.int64)

    @cached_property
    def speed_sums(self) -> FloatArray:
        """(n_steps, n_columns) sum of the vehicles' speeds on each segment at each step [km/h].

        Divided by `counts` it is the mean speed over vehicles. SUMO's mean speed of an edge is not
        used: it counts an empty lane as a vehicle at the limit.
        """
        return self._per_cell(self.speed, np.float64)

    def _per_cell(self, weights: NDArray[np.float32] | None, dtype: type) -> AnyArray:
        cells = self.step.astype(np.int64) * self.n_columns + self.segment
        flat = np.bincount(cells, weights, minlength=self.n_steps * self.n_columns)
        grid: AnyArray = flat.reshape(self.n_steps, self.n_columns).astype(dtype, copy=False)
        grid.flags.writeable = False
        return grid

    @cached_property
    def offsets(self) -> IntArray:
        """(n_steps + 1,) first row of each step; the last entry is the number of rows."""
        offsets = np.searchsorted(self.step, np.arange(self.n_steps + 1)).astype(np.int64)
        offsets.flags.writeable = False
        return offsets

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
        return dataclasses.replace(self, **columns)

    def traffic(self, lengths: FloatArray, limits: FloatArray) -> FloatArray:
        """Return density [veh/km] and mean speed over vehicles [km/h], (n_steps, n_columns, 2).

        Args:
            lengths: (n_columns,) lengths of the record columns [km].
            limits: (n_columns,) their speed limits [km/h], the speed of an empty one.
        """
        if self.field is not None:
            density, mean = self.field[..., 0], self.field[..., 1]
        else:
            density, mean = self.counts / lengths, self.speed_sums / np.maximum(self.counts, 1)
        return np.stack([density, np.where(density > 0.0, mean, limits)], axis=-1)

    @property
    def arrays(self) -> dict[str, AnyArray]:
        """The columns of the table of vehicles by name, or else the field."""
        names = self.COLUMNS if self.has_vehicles else ["field"]
        return {name: getattr(self, name) for name in names}

    @property
    def n_bytes(self) -> int:
        """Size of the arrays [bytes]."""
        return sum(array.nbytes for array in self.arrays.values())

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the content."""
        digest = hashlib.sha256(f"{self.n_steps} {self.n_columns}".encode())
        for name, array in self.arrays.items():
            digest.update(f" {name} ".encode() + np.ascontiguousarray(array).data)
        return digest.hexdigest()

    def save(self, path: Path, source: Mapping[str, object]) -> None:
        """Write the record to the file `path`, completely or not at all.

        Args:
            path: the file; its folders are created, and an existing file or link is replaced.
            source: JSON description of what is recorded, checked again by `load`.

        Raises:
            OSError: It cannot be written; what was at `path` stays.
            ValueError: It has more than `LARGEST_RECORD` bytes.
        """
        card = _card(source, (self.n_steps, self.n_columns))
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():  # whose target, anywhere, is no record to replace
            path.unlink()
        write_tensors(path, self.arrays, card, LARGEST_RECORD)

    @classmethod
    def load(cls, path: Path, source: Mapping[str, object], shape: tuple[int, int]) -> "Record":
        """Read a stored record.

        Args:
            path: the file.
            source: the expected description, as given to `save`.
            shape: the expected numbers of steps and of columns, `Corridor.record_shape`.

        Raises:
            FileNotFoundError: There is no such file.
            InvalidRecordError: It is damaged, of another version of the format, or not the expected
                one; the message starts with the path.
        """
        try:
            card, arrays = read_tensors(path, LARGEST_RECORD)
        except FileNotFoundError:
            raise
        except (OSError, ValueError) as error:
            raise InvalidRecordError(str(error)) from error
        try:
            for key, expected in _card(source, shape).items():
                found = card.get(key)
                if found != expected:
                    raise ValueError(f"{key} is {found!r:.200}, not {expected!r:.200}")
            wanted = {"field": np.dtype("<f8")} if "field" in arrays else dict(cls.COLUMNS)
            types = {name: array.dtype for name, array in arrays.items()}
            require(types == wanted, "arrays", str(wanted), types)
            fields: dict[str, Any] = dict(arrays)
            return cls(n_steps=shape[0], n_columns=shape[1], **fields)
        except ValueError as error:
            raise InvalidRecordError(f"{path}: {error}") from error


def _card(source: Mapping[str, object], shape: tuple[int, int]) -> dict[str, Any]:
    return {
        "format": RECORD_FORMAT,
        "version": RECORD_VERSION,
        "source": dict(source),
        "n_steps": shape[0],
        "n_columns": shape[1],
    }


def average_dwell(corridor: Corridor, records: Iterable[Record]) -> float:
    """Return the average time of a vehicle on a mainline segment [s]: T_avg of the paper's eq. (6).

    Of vehicles it is the mean number of consecutive steps on a segment, over all passages; one
    between two steps is not counted. In fields it is the vehicles' time on the segments over the
    number of passages, their flow.

    Raises:
        ValueError: No vehicle was ever on the mainline.
    """
    present = passages = 0.0
    for record in records:
        more_present, more_passages = _dwell(record, corridor)
        present, passages = present + more_present, passages + more_passages
    brings = f"one that brings vehicles to the mainline of {corridor.name!r}"
    require(passages > 0.0, "corridor.demand", brings, corridor.conditions.demand)
    return present / passages


def _dwell(record: Record, corridor: Corridor) -> tuple[float, float]:
    """Return the time of vehicles on mainline segments [s] in a record, and their passages."""
    n = corridor.geometry.n_mainline
    if record.field is not None:
        vehicles = record.field[:, :n, 0] * corridor.road.lengths[:n]
        passing = record.field[:, :n].prod(axis=-1)
        return float(vehicles.sum()), float(passing.sum()) / HOUR
    mainline = record.segment < n
    step, vehicle, segment = (
        column[mainline].astype(np.int64)
        for column in (record.step, record.vehicle, record.segment)
    )
    order = np.lexsort((step, segment, vehicle))
    same_vehicle = np.diff(vehicle[order]) == 0
    same_segment = np.diff(segment[order]) == 0
    next_step = np.diff(step[order]) == 1
    return len(step), len(step) - int(np.sum(same_vehicle & same_segment & next_step))

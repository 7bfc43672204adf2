"""Records without vehicles: measured density and speed of each segment at every second."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.record import Record
from dptse_env.traffic.stored_arrays import (
    MANIFEST,
    InvalidRecordError,
    load_arrays,
    save_arrays,
)
from dptse_env.utils.fields import require

FIELD_FORMAT = "dptse-field"
FIELD_VERSION = 1

_NAMES = ("density", "speed")


@dataclass(frozen=True, eq=False)
class FieldRecord:
    """Density and mean speed of each record column at every second, as from detectors.

    Step k is the state of the road k seconds after the start.

    Attributes:
        density: (n_steps, n_columns) [veh/km], at least 0; the S segments, then the boundary
            segments.
        speed: (n_steps, n_columns) [km/h], at least 0.

    Raises:
        ValueError: The tables differ in shape, or a number is negative or not finite.
    """

    density: NDArray[np.float64]
    speed: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Check the tables and bring them to their declared type."""
        for name in _NAMES:
            table = np.array(getattr(self, name), dtype=np.float64)
            require(table.ndim == 2, f"field.{name}", "a table (steps, columns)", table.shape)
            sound = bool(table.size and np.isfinite(table).all() and table.min() >= 0.0)
            require(sound, f"field.{name}", "finite and >= 0, of at least one number", table)
            table.flags.writeable = False
            object.__setattr__(self, name, table)
        allowed = f"of the density's shape {self.density.shape}"
        require(self.density.shape == self.speed.shape, "field.speed", allowed, self.speed.shape)

    @property
    def n_steps(self) -> int:
        """Number of steps."""
        return len(self.density)

    @property
    def n_columns(self) -> int:
        """Number of record columns, S + R."""
        return int(self.density.shape[1])

    def traffic(
        self, lengths: NDArray[np.float64], limits: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return density and speed, (n_steps, n_columns, 2); see `Record.traffic`.

        An empty segment has its speed limit.
        """
        speed = np.where(self.density > 0.0, self.speed, limits)
        return np.stack([self.density, speed], axis=-1)

    def save(self, path: Path, source: Mapping[str, object]) -> None:
        """Write the record to the directory `path`, completely or not at all; see `Record.save`."""
        header = {"format": FIELD_FORMAT, "version": FIELD_VERSION, "source": dict(source)}
        save_arrays(path, {name: getattr(self, name) for name in _NAMES}, header)

    @classmethod
    def load(cls, path: Path, source: Mapping[str, object]) -> "FieldRecord":
        """Read a stored record; arguments and errors are those of `Record.load`."""
        wanted = {"format": FIELD_FORMAT, "version": FIELD_VERSION, "source": dict(source)}
        tables, _ = load_arrays(path, _NAMES, wanted)
        try:
            return cls(**tables)
        except ValueError as error:
            raise InvalidRecordError(f"{path}: {error!r}") from error


AnyRecord = Record | FieldRecord
"""A record of either kind."""


def load_record(path: Path, source: Mapping[str, object]) -> AnyRecord:
    """Open a stored record of any kind; arguments and errors are those of `Record.load`."""
    try:
        found = json.loads((path / MANIFEST).read_text(encoding="utf-8")).get("format")
    except (OSError, ValueError, AttributeError, RecursionError):
        found = None  # what is wrong with it is found below
    return (FieldRecord if found == FIELD_FORMAT else Record).load(path, source)


def with_vehicles(record: AnyRecord, user: str) -> Record:
    """Return a record that has vehicles; `user` names in the error what needs them.

    Raises:
        ValueError: The record is a measured field.
    """
    if isinstance(record, FieldRecord):
        raise ValueError(
            f"{user} needs the vehicles of a record, and this traffic is a measured field of "
            "density and speed: use the release model 'paper' or 'corrected'"
        )
    return record

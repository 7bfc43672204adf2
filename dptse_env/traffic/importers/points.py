"""The common form of trajectories: points of vehicles, in chunks."""

from __future__ import annotations

import contextlib
import gzip
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from dptse_env.traffic.importers.source import Source
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

KMH = 3.6
"""Factor from m/s to km/h."""


class TrajectoryError(ValueError):
    """A file of trajectories cannot be imported; the message names file, row and field."""


class Labels(NamedTuple):
    """A column of names: vehicles, lanes, edges.

    Attributes:
        codes: Index into `names` of each row, shape (n,).
        names: The distinct names.
    """

    codes: NDArray[np.int32]
    names: tuple[str, ...]

    def mapped(self, function: Callable[[str], str]) -> Labels:
        """Return labels with other names."""
        return Labels(self.codes, tuple(map(function, self.names)))


@dataclass(frozen=True)
class Points:
    """A chunk of n points of trajectories.

    Attributes:
        row: Row of the file that each point comes from, as a reader of the file counts it, (n,).
        time: Time [s], (n,).
        vehicle: Names of the vehicles.
        x: Position along the road, along an edge, or in the plane [km], (n,).
        y: Lateral position, or the second coordinate in the plane [km], (n,); None if not given.
        speed: Speed [km/h], (n,); None to derive it from positions.
        lane: Names of the lanes, or None.
        edge: Names of the edges of a network that `x` counts from the start of, or None.
        group: Names of separate roads in one file, such as driving directions, or None.
    """

    row: IntArray
    time: FloatArray
    vehicle: Labels
    x: FloatArray
    y: FloatArray | None = None
    speed: FloatArray | None = None
    lane: Labels | None = None
    edge: Labels | None = None
    group: Labels | None = None

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.time)

    def where(self, keep: BoolArray) -> Points:
        """Return the points that a mask keeps."""
        if keep.all():
            return self
        columns: dict[str, object] = {}
        for name, value in vars(self).items():
            if isinstance(value, Labels):
                columns[name] = Labels(value.codes[keep], value.names)
            elif value is not None:
                columns[name] = value[keep]
        return replace(self, **columns)  # type: ignore[arg-type]


class Format(Protocol):
    """A format of files of trajectories."""

    @property
    def units(self) -> Mapping[str, str]:
        """Unit of times, lengths and speeds, by quantity, where a source gives no other."""

    def read(self, path: Path, source: Source) -> Iterator[Points]:
        """Read a file in chunks.

        Raises:
            TrajectoryError: It cannot be read.
        """


def open_error(path: Path) -> TrajectoryError | None:
    """Return the error of a path that is no file with content, or None."""
    if path.is_dir():
        return TrajectoryError(f"{path}: trajectories must be a file, got a directory")
    try:
        empty = path.stat().st_size == 0
    except OSError as problem:
        return TrajectoryError(f"{path}: the file cannot be read: {problem.strerror}")
    return TrajectoryError(f"{path}: the file is empty") if empty else None


@contextlib.contextmanager
def open_bytes(path: Path) -> Iterator[IO[bytes]]:
    """Open a file, uncompressed if it is compressed by gzip."""
    with path.open("rb") as file:
        if path.suffix.lower() == ".gz":
            with gzip.open(file) as plain:
                yield cast(IO[bytes], plain)
        else:
            yield file


def require_numbers(path: Path, row: IntArray, field: str, values: FloatArray) -> None:
    """Refuse a column with an entry that is missing or no finite number.

    Raises:
        TrajectoryError: With the row of the first.
    """
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        raise TrajectoryError(
            f"{path}, row {row[bad[0]]}: {field} must be a finite number, got {values[bad[0]]} "
            f"(and in {len(bad) - 1} more of the rows read with it)"
        )

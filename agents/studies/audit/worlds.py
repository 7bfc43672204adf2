"""Two adjacent worlds: one record of everybody else, and two paths that one vehicle may take."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dptse_env.arrays import BoolArray, FloatArray, IntArray
from dptse_env.traffic import Corridor, Record, RecordLibrary


@dataclass(frozen=True, eq=False)
class Path:
    """Where one vehicle is, at most once a second.

    Attributes:
        step: Seconds, increasing, shape (m,).
        segment: Record columns, shape (m,).
        speed: Speeds [km/h], shape (m,).
    """

    step: IntArray
    segment: IntArray
    speed: FloatArray

    @classmethod
    def of(cls, record: Record, vehicle: int) -> Path:
        """Return the path of a vehicle of a record."""
        rows = record.vehicle == vehicle
        return cls(
            record.step[rows].astype(np.int64),
            record.segment[rows].astype(np.int64),
            record.speed[rows].astype(np.float64),
        )

    @classmethod
    def constant(cls, seconds: IntArray, segment: int, speed: float) -> Path:
        """Return a path that stays on one segment at one speed."""
        return cls(seconds, np.full(len(seconds), segment), np.full(len(seconds), speed))

    @classmethod
    def nowhere(cls) -> Path:
        """Return the path of a vehicle that is not there."""
        return cls.constant(np.empty(0, dtype=np.int64), 0, 0.0)

    def only(self, rows: BoolArray | IntArray) -> Path:
        """Return a part of the path, given by flags of shape (m,) or by indices."""
        return Path(self.step[rows], self.segment[rows], self.speed[rows])


class TwoWorlds(RecordLibrary):
    """A library of two records that differ in one vehicle: world 0 under seed 0, world 1 under 1.

    The other vehicles move in both as they do in ``rest``; nothing is simulated again.

    Attributes:
        rest: Everybody else.
        paths: What the vehicle does in either world.
    """

    def __init__(self, rest: Record, paths: tuple[Path, Path]) -> None:
        """Add the vehicle to the rest."""
        super().__init__()
        self.rest, self.paths = rest, paths
        self._records = tuple(_with(rest, path) for path in paths)

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return the record of a world."""
        return self._records[seed]

    def missing(self, corridor: Corridor, seeds: Iterable[int]) -> list[int]:
        """Return nothing: both worlds are there."""
        return []


def _with(rest: Record, path: Path) -> Record:
    """Return a record with one vehicle more; the new vehicle has the next free index."""
    columns = {
        "step": path.step,
        "vehicle": np.full(len(path.step), rest.n_vehicles),
        "segment": path.segment,
        "speed": path.speed,
    }
    joined = {name: np.concatenate([getattr(rest, name), own]) for name, own in columns.items()}
    order = np.argsort(joined["step"], kind="stable")
    ordered = {name: column[order] for name, column in joined.items()}
    return Record(**ordered, n_steps=rest.n_steps, n_columns=rest.n_columns)

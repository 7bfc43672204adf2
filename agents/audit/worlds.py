"""Adjacent worlds: one record of the other vehicles, and trajectories of added ones."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dptse_env.config import EnvConfig
from dptse_env.traffic import Corridor, Penetration, Record, RecordLibrary
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Segments and speeds of one vehicle, at most one a second.

    Attributes:
        step: Seconds, increasing, shape (m,).
        segment: Record columns, shape (m,).
        speed: Speeds [km/h], shape (m,).
    """

    step: IntArray
    segment: IntArray
    speed: FloatArray

    @classmethod
    def from_record(cls, record: Record, vehicle: int) -> Trajectory:
        """Return the trajectory of a vehicle of a record."""
        rows = record.vehicle == vehicle
        return cls(
            record.step[rows].astype(np.int64),
            record.segment[rows].astype(np.int64),
            record.speed[rows].astype(np.float64),
        )

    @classmethod
    def constant(cls, seconds: IntArray, segment: int, speed: float) -> Trajectory:
        """Return a trajectory that stays on one segment at one speed."""
        return cls(seconds, np.full(len(seconds), segment), np.full(len(seconds), speed))

    @classmethod
    def absent(cls) -> Trajectory:
        """Return the trajectory of a vehicle that is not there."""
        return cls.constant(np.empty(0, dtype=np.int64), 0, 0.0)

    def only(self, rows: BoolArray | IntArray) -> Trajectory:
        """Return a part of the trajectory, given by flags of shape (m,) or by indices."""
        return Trajectory(self.step[rows], self.segment[rows], self.speed[rows])


Pair = tuple[Trajectory, Trajectory]


class Worlds(RecordLibrary):
    """A library of records that differ in vehicles added to one traffic; their seeds count them.

    The other vehicles move in all of them as they do in ``rest``; nothing is simulated again.

    Attributes:
        rest: The other vehicles.
        added: The trajectories that are added in each record.
        pairs: Seeds of the two worlds between which an adversary has to decide by the transcript
            of each record, shape (n, 2).
        description: The difference in words.
    """

    def __init__(
        self, rest: Record, added: Sequence[Sequence[Trajectory]], pairs: npt.ArrayLike,
        description: str = "",
    ) -> None:  # fmt: skip
        """Add the vehicles to the rest."""
        super().__init__()
        self.rest, self.added, self.description = rest, added, description
        self.pairs = np.asarray(pairs, dtype=np.int64)
        self._records = [_add(rest, vehicles) for vehicles in added]

    @classmethod
    def adjacent(cls, rest: Record, pair: Pair, description: str = "") -> Worlds:
        """Return two records that differ in one vehicle: world 0 under seed 0, 1 under seed 1."""
        return cls(rest, [[each] for each in pair], [[0, 1], [0, 1]], description)

    @property
    def pair(self) -> Pair:
        """The vehicle in either of two adjacent worlds."""
        (zero,), (one,) = self.added
        return zero, one

    def __reduce__(self) -> tuple[type[Worlds], tuple[Any, ...]]:
        """Pickle with the records, which no folder has."""
        return type(self), (self.rest, self.added, self.pairs, self.description)

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return the record of a world."""
        return self._records[seed]

    def missing(self, corridor: Corridor, seeds: Iterable[int]) -> list[int]:
        """Return nothing: no world is ever missing."""
        return []


def _add(rest: Record, added: Sequence[Trajectory]) -> Record:
    """Return a record with further vehicles, which have the next free indices."""
    indices = rest.n_vehicles + np.arange(len(added))
    columns: dict[str, list[AnyArray]] = {
        "step": [each.step for each in added],
        "vehicle": [np.repeat(indices, [len(each.step) for each in added])],
        "segment": [each.segment for each in added],
        "speed": [each.speed for each in added],
    }
    joined = {name: np.concatenate([getattr(rest, name), *rows]) for name, rows in columns.items()}
    order = np.argsort(joined["step"], kind="stable")
    ordered = {name: column[order] for name, column in joined.items()}
    return Record(**ordered, n_steps=rest.n_steps, n_columns=rest.n_columns)


@dataclass(frozen=True)
class AuditedPenetration(Penetration):
    """A penetration under which worlds differ in the added vehicles alone, which are connected.

    The worlds have traffic seeds of their own and yet the same vehicles, so that what is drawn for
    them must not depend on the seed.

    Attributes:
        first: Index of the first added vehicle.
    """

    first: int = 0

    def _uniform(self, traffic_seed: int, stream: int, n: int) -> FloatArray:
        """Return the numbers of the one traffic; those of added vehicles lie below every share."""
        uniform = super()._uniform(0, stream, n)
        uniform[self.first :] = 0.0
        return uniform


def audited(config: EnvConfig, worlds: Worlds) -> EnvConfig:
    """Return a configuration with the worlds for traffic, whose added vehicles are connected.

    An adversary may query in every second, which reveals no less.
    """
    config = replace(config, traffic_seeds=tuple(range(len(worlds.pairs))), query_every=1)
    if config.penetration.is_complete:
        return config
    given = {each.name: getattr(config.penetration, each.name) for each in fields(Penetration)}
    penetration = AuditedPenetration(**given, first=worlds.rest.n_vehicles)
    return replace(config, penetration=penetration)

"""Two adjacent worlds: one record of the other vehicles, and two trajectories of one vehicle."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from dptse_env.config import EnvConfig
from dptse_env.traffic import Corridor, Penetration, Record, RecordLibrary
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray


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


class AdjacentWorlds(RecordLibrary):
    """A library of two records that differ in one vehicle: world 0 under seed 0, world 1 under 1.

    The other vehicles move in both as they do in ``rest``; nothing is simulated again.

    Attributes:
        rest: The other vehicles.
        trajectories: The vehicle in either world.
        description: The difference in words.
    """

    def __init__(
        self, rest: Record, trajectories: tuple[Trajectory, Trajectory], description: str = ""
    ) -> None:
        """Add the vehicle to the rest."""
        super().__init__()
        self.rest, self.trajectories, self.description = rest, trajectories, description
        self._records = tuple(_add(rest, each) for each in trajectories)

    def __reduce__(self) -> tuple[type[AdjacentWorlds], tuple[Any, ...]]:
        """Pickle with the records, which no folder has."""
        return type(self), (self.rest, self.trajectories, self.description)

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return the record of a world."""
        return self._records[seed]

    def missing(self, corridor: Corridor, seeds: Iterable[int]) -> list[int]:
        """Return nothing: neither world is ever missing."""
        return []


def _add(rest: Record, added: Trajectory) -> Record:
    """Return a record with another vehicle; the vehicle has the next free index."""
    columns = {
        "step": added.step,
        "vehicle": np.full(len(added.step), rest.n_vehicles),
        "segment": added.segment,
        "speed": added.speed,
    }
    joined = {name: np.concatenate([getattr(rest, name), rows]) for name, rows in columns.items()}
    order = np.argsort(joined["step"], kind="stable")
    ordered = {name: column[order] for name, column in joined.items()}
    return Record(**ordered, n_steps=rest.n_steps, n_columns=rest.n_columns)


@dataclass(frozen=True)
class AuditedPenetration(Penetration):
    """A penetration under which two worlds differ in one vehicle alone, which is connected.

    The worlds have traffic seeds of their own and yet the same vehicles, so that what is drawn for
    them must not depend on the seed.

    Attributes:
        target: Index of the vehicle in which the worlds differ.
    """

    target: int = 0

    def _uniform(self, traffic_seed: int, stream: int, n: int) -> FloatArray:
        """Return the numbers of the one traffic; the target's lies below every share."""
        uniform = super()._uniform(0, stream, n)
        if self.target < n:
            uniform[self.target] = 0.0
        return uniform


def audited(config: EnvConfig, worlds: AdjacentWorlds) -> EnvConfig:
    """Return a configuration under which the vehicle in which two worlds differ is connected."""
    if config.penetration.is_complete:
        return config
    given = {each.name: getattr(config.penetration, each.name) for each in fields(Penetration)}
    target = worlds.rest.n_vehicles
    return replace(config, penetration=AuditedPenetration(**given, target=target))

"""Plans against queries and fixed sensors together: a vehicle that both see."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from agents.studies.audit.distances import replaces
from agents.studies.audit.planning import Pair, Planner, Second
from agents.studies.audit.worlds import AdjacentWorlds, Trajectory
from dptse_env.traffic import Record
from dptse_env.utils.arrays import FloatArray, IntArray


class PairPlanner(Planner):
    """Plans against two mechanisms: a made-up connected vehicle that stands in front of a sensor.

    It is seen in every second by the fixed sensor, and queried as well.
    """

    kinds: ClassVar[tuple[str, ...]] = ("worst-case",)

    def rank(self, record: Record, kind: str) -> IntArray:
        """Return nothing: vehicles are made up."""
        return np.zeros(0, dtype=np.int64)

    def gains(self, rest: Record, vehicle: Trajectory) -> FloatArray:
        """See `Planner.gains`: every second tells alike."""
        return self.queryable(vehicle).astype(np.float64)

    def made_up(self, record: Record, kind: str) -> Mapping[str, Pair]:
        """Return a vehicle that stands at a sensor, and none or one that stands elsewhere."""
        seconds = np.arange(1, self.config.horizon_steps + 1)
        quiet, n = self.quiet_segments(record), self.config.corridor.n_mainline
        sensors = [s for s in self.config.corridor.fixed_sensors if s < n]
        here = sensors[-1] if sensors else quiet[0]
        there = next(s for s in [*sensors, *quiet] if s != here)
        stands = Trajectory.constant(seconds, here, 0.0)
        added = f"an added connected vehicle that stands on segment {here}"
        if not replaces(self.config):
            return {f"{added}, or none in its place": (stands, Trajectory.absent())}
        elsewhere = Trajectory.constant(seconds, there, 0.0)
        return {f"{added}, or on segment {there} instead": (stands, elsewhere)}

    def worthwhile(self, worlds: AdjacentWorlds, world: int) -> tuple[list[Second], int]:
        """See `Planner.worthwhile`: every second on the mainline, for both vehicles by turns."""
        vehicle = worlds.trajectories[world]
        on_mainline = vehicle.segment < self.config.corridor.n_mainline
        return self.by_turns(vehicle, self.queryable(vehicle) & on_mainline, world)

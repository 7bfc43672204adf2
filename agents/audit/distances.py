"""Distances by which a second of a vehicle moves the releases, and the seconds that count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.audit.worlds import Trajectory
from dptse_env.config import EnvConfig
from dptse_env.parts import make_release, make_task
from dptse_env.release import CappedSettings, SpeedRelease
from dptse_env.traffic import Record
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class ReleaseDistances:
    """Squared distances between sums with and without a vehicle, in units of the noise.

    Attributes:
        length: Length of the shortest segment [km], to which the noise belongs.
        largest_speed: Largest speed limit, which flows clip to [km/h].
        limits: Speed limit of each record column [km/h], which an empty segment has.
        stretch: Length of each record column over the shortest one's, by which its noise is less.
        speed_release: Kind of the release of speeds.
        sigma: Noise of density and of speed or flow, (2,).
    """

    length: float
    largest_speed: float
    limits: FloatArray
    stretch: FloatArray
    speed_release: SpeedRelease
    sigma: FloatArray

    @classmethod
    def from_config(cls, config: EnvConfig) -> ReleaseDistances:
        """Return the distances under a configuration, at the noise that it declares."""
        corridor = config.corridor
        speed: SpeedRelease = "flow" if make_task(config).releases_flow else "mean"
        sigma = make_release(config).sigma
        shortest = min(corridor.segment_lengths)
        return cls(
            length=shortest,
            largest_speed=corridor.largest_speed_limit,
            limits=np.array(corridor.with_boundaries(corridor.speed_limits)),
            stretch=np.array(corridor.with_boundaries(corridor.segment_lengths)) / shortest,
            speed_release=speed,
            sigma=sigma,
        )

    def by_second(self, rest: Record, added: Trajectory) -> FloatArray:
        """Return squares for the seconds of a trajectory that is added to a record, shape (m,)."""
        count = rest.counts[added.step, added.segment]
        speed_sum = rest.speed_sums[added.step, added.segment]
        return self._squares(added.segment, count, speed_sum, added.speed)

    def by_row(self, record: Record) -> FloatArray:
        """Return squares for the rows of a record, with and without each, shape (rows,)."""
        speed = record.speed.astype(np.float64)
        count = record.counts[record.step, record.segment] - 1
        others = record.speed_sums[record.step, record.segment] - speed
        return self._squares(record.segment, count, others, speed)

    def where_equal(self, rest: Record, pair: tuple[Trajectory, Trajectory]) -> FloatArray:
        """Return squares between two trajectories on the same segments at the same seconds.

        Args:
            rest: The other vehicles.
            pair: The same seconds on the same segments, m each.

        Returns:
            Shape (m,): the densities agree, and the speeds alone differ.
        """
        step, segment = pair[0].step, pair[0].segment
        first, second = (each.speed for each in pair)
        if self.speed_release == "flow":
            clipped = np.clip(first, 0.0, self.largest_speed)
            change = (clipped - np.clip(second, 0.0, self.largest_speed)) / self.length
        else:
            change = (first - second) / (rest.counts[step, segment] + 1) * self.stretch[segment]
        squares: FloatArray = (change / self.sigma[1]) ** 2
        return squares

    def _squares(
        self, segment: AnyArray, count: IntArray, speed_sum: FloatArray, speed: FloatArray
    ) -> FloatArray:
        if self.speed_release == "flow":
            clipped = np.clip(speed, 0.0, self.largest_speed)
            second = (clipped - 0.5 * self.largest_speed) / self.length
        else:
            # An empty segment has the limit.
            without = np.where(count > 0, speed_sum / np.maximum(count, 1), self.limits[segment])
            second = ((speed_sum + speed) / (count + 1) - without) * self.stretch[segment]
        first = 1.0 / (self.length * self.sigma[0])
        squares: FloatArray = first**2 + (second / self.sigma[1]) ** 2
        return squares


class ContributionPlan(NamedTuple):
    """The seconds in which a vehicle's contributions reveal most.

    Attributes:
        reach: Sum of the squared distances of the seconds that count.
        n_queries: Number of other seconds to query, beside those observed at every step.
        stop: Index before which all chosen queries must lie; later seconds would be counted only
            after contributions that were not chosen.
    """

    reach: float
    n_queries: int
    stop: int


def plan_contributions(gains: FloatArray, always: BoolArray, cap: int) -> ContributionPlan:
    """Return the plan of a vehicle that counts in its first `cap` observed seconds.

    Args:
        gains: Squared distances of its seconds in order, shape (m,).
        always: Flags of seconds that are observed without a query, shape (m,).
        cap: Most seconds that count.
    """
    if cap >= len(gains):
        return ContributionPlan(float(gains.sum()), cap, len(gains))
    fixed = np.flatnonzero(always)
    options = []
    # With the first n such seconds counted, all queries have to come before the next of them.
    for n in range(min(len(fixed), cap) + 1):
        stop = int(fixed[n]) if n < len(fixed) else len(gains)
        free = np.sort(gains[:stop][~always[:stop]])[::-1][: cap - n]
        reach = float(gains[fixed[:n]].sum() + free.sum())
        options.append(ContributionPlan(reach, cap - n, stop))
    return max(options)


def replaces(config: EnvConfig) -> bool:
    """Return whether adjacent records differ in a vehicle replaced by another, or in one more."""
    return getattr(config.privacy, "adjacency", "replace") == "replace"


def protects_seconds(config: EnvConfig) -> bool:
    """Return whether a single second of a trip is protected, not the trip."""
    return getattr(config.privacy, "unit", "trip") == "event"


def contribution_cap(config: EnvConfig) -> int:
    """Return in how many queried steps of an episode a vehicle counts at most."""
    privacy = config.privacy
    cap = privacy.contribution_cap if isinstance(privacy, CappedSettings) else None
    return cap or config.horizon_steps

"""How far one second of one vehicle moves the releases, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from agents.studies.audit.worlds import Path
from dptse_env.arrays import BoolArray, FloatArray, IntArray
from dptse_env.config import EnvConfig
from dptse_env.privacy import SpeedRelease, noise_std
from dptse_env.traffic import Record


@dataclass(frozen=True)
class Ruler:
    """Squared distances between the answers with and without a vehicle, in units of the noise.

    Attributes:
        length: Length of a segment [km].
        largest_speed: The road's limit, that an empty segment answers and flows clip to [km/h].
        speed_release: What is released of the speeds.
        sigma: Noise of density and of speed or flow, (2,).
    """

    length: float
    largest_speed: float
    speed_release: SpeedRelease
    sigma: FloatArray

    @classmethod
    def of(cls, config: EnvConfig) -> Ruler:
        """Return the ruler of a configuration, at the noise that it declares."""
        corridor = config.corridor
        sigma = noise_std(config.privacy, config.sensitivity())
        return cls(corridor.segment_length, corridor.speed_limit, config.privacy.speed, sigma)

    def of_path(self, rest: Record, path: Path) -> FloatArray:
        """Return the distance of every second of a path that is added to a record, shape (m,)."""
        others = rest.counts[path.step, path.segment]
        return self._squares(others, rest.speed_sums[path.step, path.segment], path.speed)

    def of_rows(self, record: Record) -> FloatArray:
        """Return the distance of every row of a record, with and without it, shape (rows,)."""
        speed = record.speed.astype(np.float64)
        others = record.counts[record.step, record.segment] - 1
        return self._squares(others, record.speed_sums[record.step, record.segment] - speed, speed)

    def of_meeting(self, rest: Record, paths: tuple[Path, Path]) -> FloatArray:
        """Return the same where two paths meet, between one being there and the other.

        Args:
            rest: Everybody else.
            paths: The same seconds on the same segments, m each.

        Returns:
            Shape (m,): the densities agree, and the speeds alone tell the two apart.
        """
        step, segment = paths[0].step, paths[0].segment
        one, other = (path.speed for path in paths)
        if self.speed_release == "flow":
            clipped = np.clip(one, 0.0, self.largest_speed)
            second = (clipped - np.clip(other, 0.0, self.largest_speed)) / self.length
        else:
            second = (one - other) / (rest.counts[step, segment] + 1)
        squares: FloatArray = (second / self.sigma[1]) ** 2
        return squares

    def _squares(self, others: IntArray, their_speeds: FloatArray, speed: FloatArray) -> FloatArray:
        if self.speed_release == "flow":
            clipped = np.clip(speed, 0.0, self.largest_speed)
            second = (clipped - 0.5 * self.largest_speed) / self.length
        else:
            # Nobody answers with the limit.
            without = np.where(others > 0, their_speeds / np.maximum(others, 1), self.largest_speed)
            second = (their_speeds + speed) / (others + 1) - without
        first = 1.0 / (self.length * self.sigma[0])
        squares: FloatArray = first**2 + (second / self.sigma[1]) ** 2
        return squares


class Spending(NamedTuple):
    """How to spend a vehicle's contributions.

    Attributes:
        reach: Sum of the squared distances of the seconds that count.
        asked: How many of the other seconds to ask for, beside those observed anyhow.
        stop: Ask before this one of the vehicle's seconds; after it the rest would be spent
            unasked.
    """

    reach: float
    asked: int
    stop: int


def best_spending(gains: FloatArray, unasked: BoolArray, cap: int) -> Spending:
    """Return how a vehicle that counts in its first `cap` observed seconds tells most.

    Args:
        gains: Squared distances of its seconds in order, shape (m,).
        unasked: Which of them are observed whether asked for or not, shape (m,).
        cap: Most seconds that count.
    """
    if cap >= len(gains):
        return Spending(float(gains.sum()), cap, len(gains))
    fixed = np.flatnonzero(unasked)
    options = []
    # With the first n unasked seconds counted, all others have to come before the next of them.
    for n in range(min(len(fixed), cap) + 1):
        stop = int(fixed[n]) if n < len(fixed) else len(gains)
        free = np.sort(gains[:stop][~unasked[:stop]])[::-1][: cap - n]
        options.append(Spending(float(gains[fixed[:n]].sum() + free.sum()), cap - n, stop))
    return max(options)

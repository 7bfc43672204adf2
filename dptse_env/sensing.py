"""From records and query masks to true aggregates: what the vehicles would answer without noise."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from dptse_env.arrays import AnyArray, BoolArray, FloatArray, IntArray
from dptse_env.contributions import Contributions
from dptse_env.privacy import PrivacySettings, SpeedRelease
from dptse_env.traffic import Corridor, Record, RecordLibrary


class Sensing:
    """The true density and mean speed of every segment, for a set of traffic seeds.

    Aggregates are made once per record and kept in one table, so that a batch of episodes reads
    its traffic with a single index. A mean speed is over vehicles; an empty segment answers with
    the road's speed limit, so that an answer never tells by its absence that nobody is there.
    """

    def __init__(
        self, corridor: Corridor, traffic_seeds: tuple[int, ...], library: RecordLibrary
    ) -> None:
        """Prepare a table for ``traffic_seeds``; nothing is loaded or recorded yet."""
        self.corridor, self.traffic_seeds, self.library = corridor, traffic_seeds, library
        columns = corridor.n_segments + corridor.n_boundaries
        # np.empty takes address space, not memory, until a record is written into its slot.
        self._table = np.empty((len(traffic_seeds), corridor.duration + 1, columns, 2))
        self._loaded = np.zeros(len(traffic_seeds), dtype=bool)

    def load(self, slots: npt.ArrayLike) -> list[int]:
        """Read or make the records of one or more slots; return those not yet in memory.

        Several that are missing on disk are recorded at once, on all cores.
        """
        new = [slot for slot in np.unique(slots).tolist() if not self._loaded[slot]]
        if len(new) > 1:
            self.library.ensure(self.corridor, [self.traffic_seeds[slot] for slot in new])
        for slot in new:
            record = self.record(slot)
            counts = record.counts
            self._table[slot, ..., 0] = counts / self.corridor.segment_length
            mean = record.speed_sums / np.maximum(counts, 1)
            self._table[slot, ..., 1] = np.where(counts > 0, mean, self.corridor.speed_limit)
            self._loaded[slot] = True
        return new

    def record(self, slot: int) -> Record:
        """Return the record of ``traffic_seeds[slot]``, made now if there is none."""
        return self.library.get(self.corridor, self.traffic_seeds[slot])

    def aggregates(
        self, slots: IntArray, times: IntArray, n_columns: int | None = None
    ) -> FloatArray:
        """Return (density [veh/km], speed [km/h]) of every segment, shape (k, S, 2).

        Args:
            slots: Which traffic, shape (k,); loaded before.
            times: Which second of it, shape (k,).
            n_columns: How many columns, if not the S segments.
        """
        rows: FloatArray = self._table[slots, times, : n_columns or self.corridor.n_segments]
        return rows

    def traffic(self, slot: int) -> FloatArray:
        """Return the same for all segments over a whole record, shape (T + 1, S + R, 2).

        The boundary segments come last, in the order of `dptse_env.traffic.corridor`.
        """
        traffic: FloatArray = self._table[slot]
        return traffic


class Answers(Protocol):
    """What the observed segments answer, ahead of the mechanism.

    Attributes:
        contributions: Who counted how often; None where vehicles count without bound.
        tables: What depends on traffic alone; a fork of the process shares it.
    """

    contributions: Contributions | None

    @property
    def tables(self) -> tuple[AnyArray, ...]:
        """See above."""

    def load(self, slot: int) -> None:
        """Prepare for the traffic of a slot, which `Sensing` has loaded."""

    def reset(self, episodes: IntArray) -> None:
        """Begin new episodes, shape (k,)."""

    def collect(
        self, episodes: IntArray, slots: IntArray, times: IntArray, observed: BoolArray
    ) -> FloatArray:
        """Return what is to be released, shape (k, n_columns, 2): density [veh/km] and speed.

        Args:
            episodes: Which episodes, shape (k,).
            slots: Which traffic each replays, shape (k,).
            times: Which second of it, shape (k,).
            observed: Which segments were asked, shape (k, n_columns); others answer anything.
        """


class AggregateAnswers:
    """Density and mean speed [km/h] of all vehicles of a segment, as in the paper."""

    def __init__(self, sensing: Sensing, n_columns: int) -> None:
        """Answer for the first `n_columns` record columns."""
        self.contributions: Contributions | None = None
        self._sensing, self._n_columns = sensing, n_columns

    @property
    def tables(self) -> tuple[AnyArray, ...]:
        """Nothing: `Sensing` holds the aggregates."""
        return ()

    def load(self, slot: int) -> None:
        """Nothing to prepare: `Sensing` holds the aggregates."""

    def reset(self, episodes: IntArray) -> None:
        """Nothing is counted."""

    def collect(
        self, episodes: IntArray, slots: IntArray, times: IntArray, observed: BoolArray
    ) -> FloatArray:
        """Return true density and mean speed of all segments."""
        return self._sensing.aggregates(slots, times, self._n_columns)


class BoundedAnswers:
    """Density of the vehicles that count, and their centred flow [veh/h] or mean speed [km/h].

    The centred flow is the sum of v - v_0 over the vehicles that count, per length, with v clipped
    to [0, 2 v_0]: it changes by at most v_0 / l when a vehicle comes or goes.
    """

    def __init__(
        self,
        sensing: Sensing,
        n_columns: int,
        n_episodes: int,
        cap: int | None,
        speed_release: SpeedRelease,
    ) -> None:
        """Answer for the first `n_columns` record columns; a vehicle counts `cap` times."""
        corridor = sensing.corridor
        self._sensing, self._n_columns, self._speed_release = sensing, n_columns, speed_release
        self._length, self._limit = corridor.segment_length, corridor.speed_limit
        seconds = corridor.duration + 1
        self._counted = Contributions(
            len(sensing.traffic_seeds), seconds, n_episodes, corridor.speed_limit, cap
        )
        self.contributions: Contributions | None = self._counted

    @property
    def tables(self) -> tuple[AnyArray, ...]:
        """The vehicle tables of all traffic."""
        return self._counted.tables

    def load(self, slot: int) -> None:
        """Take in the vehicle table of a slot."""
        self._counted.load(slot, self._sensing.record(slot))

    def reset(self, episodes: IntArray) -> None:
        """Let nobody have counted yet."""
        self._counted.reset(episodes)

    def collect(
        self, episodes: IntArray, slots: IntArray, times: IntArray, observed: BoolArray
    ) -> FloatArray:
        """Return density and flow, or mean speed, of the vehicles that count."""
        counts, speeds = self._counted.collect(episodes, slots, times, observed)
        answers = np.empty((*counts.shape, 2))
        np.divide(counts, self._length, out=answers[..., 0])
        if self._speed_release == "flow":
            speeds -= 0.5 * self._limit * counts
            np.divide(speeds, self._length, out=answers[..., 1])
        else:
            empty = counts == 0.0
            answers[..., 1] = np.where(empty, self._limit, speeds / np.where(empty, 1.0, counts))
        return answers


def make_answers(
    privacy: PrivacySettings, sensing: Sensing, n_columns: int, n_episodes: int
) -> Answers:
    """Return what the observed segments answer under a privacy preset."""
    if not privacy.is_bounded:
        return AggregateAnswers(sensing, n_columns)
    cap = privacy.contribution_cap
    return BoundedAnswers(sensing, n_columns, n_episodes, cap, privacy.speed)

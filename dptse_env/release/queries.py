"""Queries: what a policy may ask for, and the channels that answer it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from dptse_env.model import covered
from dptse_env.traffic import Corridor
from dptse_env.utils.arrays import BoolArray, IntArray

BandwidthUnit = Literal["segments", "sums"]
"""Cost of a query in the bandwidth: as much as it has segments, or one."""


MOST_QUERIES = 10_000
"""Largest number of options."""


@dataclass(frozen=True, eq=False)
class Queries:
    """The G queries among which a policy chooses, each of neighbouring mainline segments.

    Queries are in the order of their spans, within these from upstream to downstream. By default
    query s is segment s.

    Attributes:
        first: The first segment of each query, shape (G,).
        span: Number of segments that each covers, shape (G,).
        cost: What each costs of the bandwidth, shape (G,).
        n_mainline: Mainline segments n.
        bandwidth: Largest total cost of the queries of a step.
        separate_sensors: Whether a fixed sensor has a channel of its own where its segment can be
            queried, too, since the two measure different things.
    """

    first: IntArray
    span: IntArray
    cost: IntArray
    n_mainline: int
    bandwidth: int
    separate_sensors: bool = False

    @classmethod
    def make(
        cls,
        n_mainline: int,
        bandwidth: int,
        spans: Sequence[int] = (1,),
        unit: BandwidthUnit = "segments",
        separate_sensors: bool = False,
    ) -> Queries:
        """Return all queries of some spans.

        Args:
            n_mainline: Mainline segments.
            bandwidth: Largest total cost of the queries of a step.
            spans: The keyword ``query_spans``.
            unit: The keyword ``bandwidth_unit``.
            separate_sensors: See the attribute.
        """
        sizes = [n_mainline - span + 1 for span in spans]
        span = np.repeat(np.array(spans, dtype=np.int64), sizes)
        return cls(
            first=np.concatenate([np.arange(size) for size in sizes]),
            span=span,
            cost=span if unit == "segments" else np.ones_like(span),
            n_mainline=n_mainline,
            bandwidth=bandwidth,
            separate_sensors=separate_sensors,
        )

    def __str__(self) -> str:
        """Return the spans in words."""
        return f"query_spans {tuple(dict.fromkeys(self.span.tolist()))}"

    @property
    def n_queries(self) -> int:
        """Number of queries G."""
        return self.first.size

    @cached_property
    def covers(self) -> BoolArray:
        """Mainline segments that each query covers, shape (G, n_mainline)."""
        return covered(self.first, self.span, self.n_mainline)

    @cached_property
    def most_queries(self) -> int:
        """Most distinct queries that the bandwidth pays for in a step."""
        return int(np.count_nonzero(np.cumsum(np.sort(self.cost)) <= self.bandwidth))

    @cached_property
    def costs_differ(self) -> bool:
        """True if some queries cost more than others."""
        return bool((self.cost != self.cost[0]).any())

    @cached_property
    def are_segments(self) -> bool:
        """True if query s is segment s."""
        return bool((self.span == 1).all())

    def covered(self, queried: BoolArray) -> BoolArray:
        """Return the segments (k, n_mainline) that chosen queries (k, G) cover."""
        return queried.copy() if self.are_segments else queried @ self.covers

    def sensor_channels(self, corridor: Corridor) -> tuple[int, ...]:
        """Return the channel of each of the corridor's fixed sensors."""
        others = {s: self.n_queries + k for k, s in enumerate(self.others(corridor))}
        channel = others if self.separate_sensors else self._singles | others
        return tuple(channel[s] for s in corridor.fixed_sensors)

    def channels_of_segments(self, corridor: Corridor) -> IntArray:
        """Return the channel of each segment (S,) by itself; needs queries of span 1."""
        n, S = self.n_mainline, corridor.geometry.n_segments
        on_ramps = range(self.n_queries, self.n_queries + S - n)
        return np.array([*(self._singles[s] for s in range(n)), *on_ramps], dtype=np.int64)

    def others(self, corridor: Corridor) -> list[int]:
        """Return the segments of the road's channels that are no queries: ramps, then sensors.

        The last are mainline segments with a fixed sensor: those that are no query of span 1, or
        all where sensors are separate.
        """
        n = self.n_mainline
        shared = {} if self.separate_sensors else self._singles
        sensors = [s for s in corridor.fixed_sensors if s < n and s not in shared]
        return [*range(n, corridor.geometry.n_segments), *sensors]

    @cached_property
    def _singles(self) -> dict[int, int]:
        """The queries of span 1, by their segment."""
        single = np.flatnonzero(self.span == 1)
        return {int(self.first[query]): int(query) for query in single}


def check_spans(n: int, spans: Sequence[int]) -> None:
    """Refuse spans that are not ascending numbers of the n mainline segments, or too many.

    Raises:
        ValueError: See above; too many are those that leave more than `MOST_QUERIES`.
    """
    if not spans or list(spans) != sorted(set(spans)) or not 1 <= spans[0] <= spans[-1] <= n:
        raise ValueError(
            f"query_spans must be ascending, distinct numbers of segments in 1..{n}, got {spans}"
        )
    n_queries = sum(n - span + 1 for span in spans)
    if n_queries > MOST_QUERIES:
        raise ValueError(
            f"query_spans must leave at most {MOST_QUERIES} queries to choose from, got {n_queries}"
        )

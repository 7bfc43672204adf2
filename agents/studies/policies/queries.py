"""Queries of a policy by segment and time, relative to the incident."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dptse_env.process import QueryProcess
from dptse_env.traffic.incident import Incident
from dptse_env.traffic.scenario import draw_scenario
from dptse_env.utils.arrays import FloatArray, IntArray

PHASES = ("before", "during", "after")
BIN = 20
"""Length of a bin of time [s]."""
NEAR = 2
"""Segments on either side that count as near the incident."""


@dataclass(frozen=True)
class QueryCounts:
    """The queries of one episode. Counts are numbers with spaces between them.

    Attributes:
        traffic_seed: The traffic it replayed.
        incident: Segment of the incident; -1 without one, and then all is ``before``.
        start: Second at which it begins; 0 without one.
        seconds: Seconds before, during and after the incident.
        before: Queries of each segment before the incident.
        during: Queries of each segment during the incident.
        after: Queries of each segment after the incident.
        near: Queries near the incident in each `BIN` of the episode.
    """

    traffic_seed: int
    incident: int
    start: float
    seconds: str
    before: str
    during: str
    after: str
    near: str

    def counts(self, name: str) -> IntArray:
        """Return a field of counts as an array."""
        return np.array(getattr(self, name).split(), dtype=np.int64)


class QueryCounter:
    """Counts the segments that a batch queries; call it after the reset and every second."""

    def __init__(self, process: QueryProcess, traffic_seeds: Sequence[int]) -> None:
        """Look up the first incident of each: truth, for evaluation only.

        Args:
            process: The episodes.
            traffic_seeds: Their traffic, n of them.
        """
        n, n_mainline = process.n_episodes, process.interface.n_mainline
        corridor = process.config.corridor
        self._process, self._seeds = process, tuple(traffic_seeds)
        scenarios = [draw_scenario(corridor, seed) for seed in traffic_seeds]
        incidents = [next(iter(scenario.incidents), None) for scenario in scenarios]
        self._segment = np.array([-1 if each is None else each.segment for each in incidents])
        self._start, self._end = np.array([_span(each) for each in incidents]).T
        distance = np.abs(np.arange(n_mainline) - self._segment[:, None])
        self._near = (distance <= NEAR) & (self._segment >= 0)[:, None]
        self._counts = np.zeros((n, len(PHASES), n_mainline), dtype=np.int64)
        self._seconds = np.zeros((n, len(PHASES)), dtype=np.int64)
        n_bins = -(-process.config.horizon_steps // BIN)
        self._near_counts = np.zeros((n, n_bins), dtype=np.int64)
        self._begun = False

    def __call__(self) -> None:
        """Count the queries of the second that has passed."""
        if not self._begun:  # the call after the reset, before any query
            self._begun = True
            return
        process = self._process
        episodes, time = np.arange(process.n_episodes), process.time
        phase = (time > self._start).astype(np.int64) + (time > self._end)
        queried = process.interface.queries.covered(process.queried)
        self._counts[episodes, phase] += queried
        self._seconds[episodes, phase] += 1
        place = (process.elapsed - 1) // BIN
        self._near_counts[episodes, place] += (queried & self._near).sum(axis=1)

    def results(self) -> list[QueryCounts]:
        """Return the counts, one record for each episode."""
        return [
            QueryCounts(
                seed,
                int(self._segment[k]),
                float(self._start[k]) if self._segment[k] >= 0 else 0.0,
                _text(self._seconds[k]),
                _text(self._counts[k, 0]),
                _text(self._counts[k, 1]),
                _text(self._counts[k, 2]),
                _text(self._near_counts[k]),
            )
            for k, seed in enumerate(self._seeds)
        ]


def _span(incident: Incident | None) -> tuple[float, float]:
    """Return when an incident begins and when its last phase ends [s]."""
    if incident is None:
        return np.inf, np.inf
    return incident.start, incident.phases[-1][1]


def _text(counts: IntArray) -> str:
    return " ".join(map(str, counts.tolist()))


def by_segment(episodes: Sequence[QueryCounts]) -> FloatArray:
    """Return the share of seconds in which each segment is queried, shape (n_mainline,)."""
    counts = sum(each.counts(phase) for each in episodes for phase in PHASES)
    seconds = sum(each.counts("seconds").sum() for each in episodes)
    share: FloatArray = np.asarray(counts) / seconds
    return share


def by_offset(episodes: Sequence[QueryCounts], phase: str) -> tuple[FloatArray, FloatArray]:
    """Return offsets from the incident's segment, and the share of seconds each is queried.

    Only seconds in which a segment has this offset count. Episodes without an incident are left
    out.
    """
    n = len(episodes[0].counts(phase))
    queries, seconds = np.zeros(2 * n - 1), np.zeros(2 * n - 1)
    for each in episodes:
        if each.incident >= 0:
            window = slice(n - 1 - each.incident, 2 * n - 1 - each.incident)
            queries[window] += each.counts(phase)
            seconds[window] += each.counts("seconds")[PHASES.index(phase)]
    seen = seconds > 0
    return np.arange(1 - n, n)[seen].astype(np.float64), queries[seen] / seconds[seen]


def near_since_start(
    episodes: Sequence[QueryCounts], edges: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Return seconds since the incident's start, and the share of queries near it.

    Args:
        episodes: The episodes; those without an incident are left out.
        edges: Edges of intervals of `BIN` seconds from the start on [s]; a bin of an episode counts
            in the interval that holds its middle.
    """
    bounds = np.array(edges, dtype=np.float64)
    near, queries = np.zeros(len(bounds) - 1), np.zeros(len(bounds) - 1)
    for each in episodes:
        if each.incident < 0:
            continue
        n_seconds = int(each.counts("seconds").sum())
        counts = each.counts("near")[: n_seconds // BIN]  # without a bin that is cut off
        middle = BIN * (np.arange(len(counts)) + 0.5) - each.start
        place = np.digitize(middle, bounds) - 1
        inside = (place >= 0) & (place < len(near))
        total = sum(each.counts(phase).sum() for phase in PHASES)
        np.add.at(near, place[inside], counts[inside])
        np.add.at(queries, place[inside], total / n_seconds * BIN)
    seen = queries > 0
    return (bounds[:-1] + BIN / 2)[seen], near[seen] / queries[seen]

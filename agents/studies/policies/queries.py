"""Whom a policy asks: where on the road, and when, seen from the incident."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dptse_env.process import QueryProcess
from dptse_env.traffic.incident import Incident
from dptse_env.traffic.scenario import draw_scenario

PHASES = ("before", "during", "after")
BIN = 20
"""Length of a stretch of time [s]."""
NEAR = 2
"""Segments on either side that count as near the incident."""


@dataclass(frozen=True)
class Asked:
    """The queries of one episode. Counts are numbers with spaces between them.

    Attributes:
        traffic_seed: The traffic it replayed.
        incident: Segment of the incident; -1 where there is none, and then all is ``before``.
        start: Second at which it begins; 0 where there is none.
        seconds: Seconds before, during and after the incident.
        before: Queries of each segment before the incident.
        during: Queries of each segment during the incident.
        after: Queries of each segment after the incident.
        near: Queries near the incident in each stretch of `BIN` seconds of the episode.
    """

    traffic_seed: int
    incident: int
    start: float
    seconds: str
    before: str
    during: str
    after: str
    near: str

    def counts(self, name: str) -> NDArray[np.int64]:
        """Return one of the counts as an array."""
        return np.array(getattr(self, name).split(), dtype=np.int64)


class Watch:
    """Counts the queries of a batch of episodes, called every second."""

    def __init__(self, process: QueryProcess, traffic_seeds: Sequence[int]) -> None:
        """Look up the incidents: truth, for evaluation only.

        Args:
            process: The episodes.
            traffic_seeds: Their traffic, n of them.
        """
        n, n_mainline = process.n_episodes, process.interface.n_mainline
        self._process, self._seeds = process, tuple(traffic_seeds)
        corridor = process.config.corridor
        self._incidents: list[Incident | None] = [
            draw_scenario(corridor, seed).incident for seed in traffic_seeds
        ]
        ends = [_ends(incident) for incident in self._incidents]
        self._start, self._end = (np.array(column) for column in zip(*ends, strict=True))
        place = np.array([-1 if one is None else one.segment for one in self._incidents])
        away = np.abs(np.arange(n_mainline) - place[:, None])
        self._near = (away <= NEAR) & (place >= 0)[:, None]
        self._place = place
        self._counts = np.zeros((n, len(PHASES), n_mainline), dtype=np.int64)
        self._seconds = np.zeros((n, len(PHASES)), dtype=np.int64)
        n_bins = -(-process.config.horizon_steps // BIN)
        self._near_counts = np.zeros((n, n_bins), dtype=np.int64)
        self._begun = False

    def __call__(self) -> None:
        """Count the queries of the second that has passed."""
        if not self._begun:  # the call after the reset: nothing was asked yet
            self._begun = True
            return
        process = self._process
        episodes = np.arange(process.n_episodes)
        time = process.time
        phase = (time > self._start).astype(np.int64) + (time > self._end)
        self._counts[episodes, phase] += process.queried
        self._seconds[episodes, phase] += 1
        stretch = (process.elapsed - 1) // BIN
        self._near_counts[episodes, stretch] += (process.queried & self._near).sum(axis=1)

    def asked(self) -> list[Asked]:
        """Return what was counted, one record for each episode."""
        return [
            Asked(
                seed,
                int(self._place[k]),
                0.0 if self._incidents[k] is None else float(self._start[k]),
                _text(self._seconds[k]),
                *(_text(self._counts[k, phase]) for phase in range(len(PHASES))),
                _text(self._near_counts[k]),
            )
            for k, seed in enumerate(self._seeds)
        ]


def _ends(incident: Incident | None) -> tuple[float, float]:
    """Return when an incident begins and when its last phase ends [s]."""
    if incident is None:
        return np.inf, np.inf
    return incident.start, incident.phases[-1][1]


def _text(counts: NDArray[np.int64]) -> str:
    return " ".join(map(str, counts.tolist()))

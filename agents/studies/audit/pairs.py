"""Replay of many pairs of real trips: how far apart the releases of two vehicles really are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.engines.engine import Engine, run_in_order
from agents.engines.local import THIS_PROCESS
from agents.files import write_json
from agents.studies.audit.distances import protects_seconds, replaces
from agents.studies.audit.releases import AttackedRelease, attacked
from agents.studies.audit.series import PublicSeries, play_series
from agents.studies.audit.strategies import public_plan
from agents.terminal import make_table, print_table
from dptse_env.config import EnvConfig
from dptse_env.parts import make_release, privacy_report
from dptse_env.release import PrivacyReport, ReleaseRequest, TrafficTable
from dptse_env.traffic import Corridor, Record, RecordLibrary
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.utils.validation import require

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles that are reported; the last is the maximum."""


class Trips(RecordLibrary):
    """A library with a record for each trip: under seed v the one vehicle v of a record."""

    def __init__(self, record: Record, vehicles: IntArray) -> None:
        """Take these vehicles of the record, shape (n,)."""
        super().__init__()
        rows = np.flatnonzero(np.isin(record.vehicle, vehicles))
        rows = rows[np.lexsort((record.step[rows], record.vehicle[rows]))]
        bounds = np.searchsorted(record.vehicle[rows], [vehicles, vehicles + 1])
        self._whole = record
        self._rows = [rows[start:stop] for start, stop in bounds.T]

    def get(self, corridor: Corridor, seed: int) -> Record:
        """Return the record of the trip of an index into the vehicles."""
        rows, record = self._rows[seed], self._whole
        return Record(
            record.step[rows], np.zeros(len(rows), dtype=np.int32), record.segment[rows],
            record.speed[rows],
            n_steps=record.n_steps, n_columns=record.n_columns,
        )  # fmt: skip


def replay_pairs(
    config: EnvConfig, record: Record, series: PublicSeries, pairs: IntArray
) -> FloatArray:
    """Return the squared distances of pairs of trips in units of the noise, shape (n,).

    All the other vehicles cancel, so each trip is released by itself. Under the adjacency
    ``add_remove`` the first of each pair is held against none, and for the unit ``event`` the
    second counts that tells most.

    Args:
        config: The configuration.
        record: The traffic.
        series: Queries and public terms of an episode over the record.
        pairs: Vehicles, shape (n, 2).
    """
    vehicles, places = np.unique(pairs, return_inverse=True)
    release = _release_of_trips(config, record, vehicles)
    trips, places = np.arange(len(vehicles)), places.reshape(pairs.shape)
    squares, combine = np.zeros(len(pairs)), np.maximum if protects_seconds(config) else np.add
    for step in range(len(series.observed)):
        observed, terms = series.at(step, len(trips))
        times = np.full(len(trips), step + 1)
        sums = release.sums(ReleaseRequest(trips, trips, times, observed), terms) / terms.sigma
        difference = sums[places[:, 0]]
        if replaces(config):
            difference = difference - sums[places[:, 1]]
        told = np.sum(difference[:, series.observed[step]] ** 2, axis=(1, 2))
        combine(squares, told, out=squares)
    return squares


def _release_of_trips(config: EnvConfig, record: Record, vehicles: IntArray) -> AttackedRelease:
    """Return the release model for a batch of which every episode has one of the vehicles."""
    n, library = len(vehicles), Trips(record, vehicles)
    traffic = TrafficTable(config.corridor, tuple(range(n)), library)
    release = attacked(make_release(config, n, traffic))
    for index in range(n):
        release.model.load(index, library.get(config.corridor, index))
    release.model.reset(np.arange(n), [np.random.default_rng(0)] * n)
    return release


@dataclass(frozen=True)
class PairsFinding:
    """Squared distances of pairs of real trips.

    Attributes:
        title: What was replayed.
        privacy: The privacy report.
        parts: Squared distances over mu^2, shape (n,).
        n_records: Records that they come from.
        policy: Schedule of the queries.
    """

    title: str
    privacy: PrivacyReport
    parts: FloatArray
    n_records: int
    policy: str

    @property
    def quantiles(self) -> dict[str, float]:
        """The `QUANTILES` of the parts, by name."""
        values = np.quantile(self.parts, QUANTILES).tolist()
        return {f"{level:g}": value for level, value in zip(QUANTILES, values, strict=True)}

    def print(self) -> None:
        """Print a table of the quantiles."""
        header = "pairs", *(f"q {level}" for level in self.quantiles)
        title = f"{self.title}: squared distances of pairs of trips over mu^2"
        table = make_table(title, *header, left=0)
        table.add_row(f"{len(self.parts)}", *(f"{value:.4f}" for value in self.quantiles.values()))
        print_table(table)

    def write(self, path: Path, arguments: Mapping[str, Any]) -> None:
        """Write the quantiles to a JSON file."""
        content = {
            "title": self.title,
            "privacy": self.privacy.to_dict(),
            "n_pairs": len(self.parts),
            "n_records": self.n_records,
            "policy": self.policy,
            "quantiles": self.quantiles,
            "arguments": {key: str(value) for key, value in arguments.items()},
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, content)


@dataclass(frozen=True, eq=False)
class PairsTask:
    """Pairs of trips of a record, with everything that a worker needs to replay them.

    Attributes:
        plan: Public queries of the episode.
        seed: Seeds the noise of the episode.
        pairs: Vehicles, shape (n, 2).
    """

    config: EnvConfig
    record: Record
    plan: BoolArray
    seed: int
    pairs: IntArray


def run_pairs(task: PairsTask) -> FloatArray:
    """Return the squared distances of the pairs in units of the noise, shape (n,)."""
    series = play_series(task.config, task.record, task.plan, task.seed)
    return replay_pairs(task.config, task.record, series, task.pairs)


def study_pairs(
    config: EnvConfig,
    records: Sequence[Record],
    n_pairs: int,
    *,
    title: str = "",
    policy: str = "round-robin",
    seed: int = 0,
    engine: Engine = THIS_PROCESS,
    progress: bool = True,
) -> PairsFinding:
    """Replay pairs of trips of records, each under the public numbers of an episode of its own.

    Args:
        config: The configuration.
        records: The traffic.
        n_pairs: Pairs of each record, drawn at random.
        title: What is replayed.
        policy: Name of the public schedule of the episodes.
        seed: Seeds the pairs, and the noise of the episodes.
        engine: Replays the records.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: A record has fewer than two vehicles.
    """
    generator, privacy = np.random.default_rng(seed), privacy_report(config)
    plan, tasks = public_plan(config, policy), []
    for index, record in enumerate(records):
        vehicles = np.unique(record.vehicle).astype(np.int64)
        require(len(vehicles) >= 2, "traffic", "records of 2 vehicles or more", len(vehicles))
        first = generator.integers(len(vehicles), size=n_pairs)
        other = (first + generator.integers(1, len(vehicles), size=n_pairs)) % len(vehicles)
        pairs = vehicles[np.stack([first, other], axis=1)]
        tasks.append(PairsTask(config, record, plan, seed + index, pairs))
    squares = run_in_order(engine, run_pairs, tasks, progress=progress, unit="record")
    parts = np.concatenate(squares) / privacy.mu**2
    return PairsFinding(title, privacy, parts, len(records), policy)

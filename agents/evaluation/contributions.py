"""Payments of vehicles, seen from the true traffic: for evaluation only."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agents.evaluation.episodes import EpisodeScore
from dptse_env.process import QueryProcess
from dptse_env.release import Capped, CappedSettings, PacedSettings, ReleaseModel, TwoMechanisms
from dptse_env.release.paced import Paced
from dptse_env.release.vehicle_table import VehicleTable
from dptse_env.utils.arrays import AnyArray, BoolArray, FloatArray, IntArray

NEARLY_SPENT = 0.95
"""Part of the budget above which a vehicle has run out of it."""
QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
"""Quantiles of what is spent at the end of a trip."""
LENGTHS = (0, 30, 60, 90, 120, 150, 180)
"""Lengths of trips [s] at which their bins begin; the last has no end."""


@dataclass(frozen=True)
class LedgerScore(EpisodeScore):
    """The errors of one episode, and how many contributions its vehicles could not pay for.

    A contribution is counted once for each second in which a query covers a vehicle.

    Attributes:
        n_met: Contributions that queries called for.
        n_refused: Those that a ledger or a cap refused.
        n_vehicles: Vehicles that were on the mainline.
        n_exhausted: Those that had spent more than `NEARLY_SPENT` of their budget at the end.
    """

    n_met: int
    n_refused: int
    n_vehicles: int
    n_exhausted: int

    @property
    def percent_refused(self) -> float:
        """Share of the contributions that were refused [%]."""
        return 100.0 * self.n_refused / max(self.n_met, 1)

    @property
    def percent_exhausted(self) -> float:
        """Share of the vehicles that had run out of their budget [%]."""
        return 100.0 * self.n_exhausted / max(self.n_vehicles, 1)


@dataclass(frozen=True)
class TripSums:
    """Payments of the vehicles of one episode; lists are numbers with spaces between them.

    Attributes:
        traffic_seed: The traffic it replayed.
        quantiles: `QUANTILES` of the part of the budget that vehicles had spent.
        met: Contributions that queries called for, by mainline segment.
        refused: Those that a ledger or a cap refused, by mainline segment.
        vehicles: Vehicles by the seconds that they were on the mainline, in the bins of `LENGTHS`.
        spent: Parts of the budget that they had spent, summed by bin.
        met_of: Contributions that queries called for, by bin.
        refused_of: Those that were refused, by bin.
    """

    traffic_seed: int
    quantiles: str
    met: str
    refused: str
    vehicles: str
    spent: str
    met_of: str
    refused_of: str

    def numbers(self, name: str) -> FloatArray:
        """Return a list as an array."""
        return np.array(getattr(self, name).split(), dtype=np.float64)


class LedgerWatcher:
    """Follows the vehicles of a batch of episodes; call it after the reset and every second.

    Where queries and fixed sensors are two mechanisms, it follows those that answer queries.
    Episodes begin at second 0 of their records. A vehicle that still drives at the end of an
    episode counts with what it has done by then.
    """

    def __init__(self, process: QueryProcess, traffic_seeds: Sequence[int]) -> None:
        """Prepare for the episodes of a process, with n traffic seeds.

        Raises:
            ValueError: The release model keeps no account of single vehicles.
        """
        self._process, self._seeds = process, tuple(traffic_seeds)
        self._release = of_queries(process.release)
        self._table = vehicle_table(self._release)
        self._n_mainline = process.interface.n_mainline
        shape = (len(self._seeds), self._n_mainline)
        self._met, self._refused = np.zeros((2, *shape), dtype=np.int64)
        self._before: AnyArray | None = None

    def __call__(self) -> None:
        """Count the contributions of the second that has passed."""
        release = self._release
        paid, _ = payments(release)
        if self._before is None:  # the call after the reset, before any query
            self._seconds, self._met_of, self._refused_of = np.zeros((3, *paid.shape), dtype=int)
        else:
            covered = covered_places(release, self._process.queried)
            pays = paid > (0.0 if _is_cleared(release) else self._before)
            for k in range(len(paid)):
                self._follow(k, covered[k], pays[k])
        self._before = paid.copy()

    def _follow(self, k: int, covered: BoolArray, pays: BoolArray) -> None:
        """Count the contributions of one episode: covered places, and who has paid."""
        table, n = self._table, self._n_mainline
        slot, time = self._process.traffic_index[k], self._process.time[k]
        rows = slice(table.start[slot, time], table.start[slot, time + 1])
        vehicle, place = table.vehicle[rows], table.segment[rows]
        self._seconds[k, vehicle[place < n]] += 1
        met = np.append(covered, False)[np.minimum(place, len(covered))]
        vehicle, place = vehicle[met], place[met]
        refused = ~pays[vehicle]
        self._met_of[k, vehicle] += 1
        self._refused_of[k, vehicle[refused]] += 1
        self._met[k] += np.bincount(place, minlength=n)[:n]
        self._refused[k] += np.bincount(place[refused], minlength=n)[:n]

    def scores(self, episodes: Sequence[EpisodeScore]) -> list[LedgerScore]:
        """Return the scores of the episodes with the counts of contributions."""
        return [
            LedgerScore(
                **dataclasses.asdict(score),
                n_met=int(self._met_of[k].sum()),
                n_refused=int(self._refused_of[k].sum()),
                n_vehicles=int(on_road.sum()),
                n_exhausted=int((spent[on_road] > NEARLY_SPENT).sum()),
            )
            for k, score, spent, on_road in self._by_episode(episodes)
        ]

    def trips(self, episodes: Sequence[EpisodeScore]) -> list[TripSums]:
        """Return the payments by place and by length of trip, one record for each episode."""
        found = []
        for k, score, spent, on_road in self._by_episode(episodes):
            length = np.digitize(self._seconds[k, on_road], LENGTHS) - 1

            def by_length(values: AnyArray | None, length: IntArray = length) -> str:
                return _text(np.bincount(length, values, minlength=len(LENGTHS)))

            found.append(
                TripSums(
                    score.traffic_seed,
                    _text(np.quantile(spent[on_road], QUANTILES)),
                    _text(self._met[k]),
                    _text(self._refused[k]),
                    by_length(None),
                    by_length(spent[on_road]),
                    by_length(self._met_of[k, on_road]),
                    by_length(self._refused_of[k, on_road]),
                )
            )
        return found

    def _by_episode(
        self, episodes: Sequence[EpisodeScore]
    ) -> list[tuple[int, EpisodeScore, FloatArray, BoolArray]]:
        """Return place, score, spent parts of budgets, and who was on the mainline."""
        paid, budget = payments(self._release)
        return [
            (k, score, paid[k] / budget, self._seconds[k] > 0) for k, score in enumerate(episodes)
        ]


def of_queries(release: ReleaseModel) -> ReleaseModel:
    """Return the release model of the queries, where fixed sensors have one of their own."""
    return release.queries if isinstance(release, TwoMechanisms) else release


def payments(release: ReleaseModel) -> tuple[AnyArray, float]:
    """Return what vehicles have paid, shape (n_episodes, n_vehicles), and the budget of a trip.

    The budget is infinite where a trip has none.

    Raises:
        ValueError: The release model keeps no account of single vehicles.
    """
    settings = release.setup.settings
    if isinstance(release, Paced) and isinstance(settings, PacedSettings):
        budget = release.ledgers.budget if settings.unit == "trip" else math.inf
        return release.ledgers.paid, budget
    if isinstance(release, Capped) and isinstance(settings, CappedSettings):
        return release.contributions.exposures, settings.contribution_cap or math.inf
    raise ValueError(f"privacy.preset must keep account of vehicles, got {release.setup.name!r}")


def vehicle_table(release: ReleaseModel) -> VehicleTable:
    """Return the vehicles of the true traffic that a release model reads.

    Raises:
        ValueError: The release model keeps no account of single vehicles.
    """
    payments(release)
    if isinstance(release, Paced):
        return release.ledgers.vehicles
    assert isinstance(release, Capped)
    return release.contributions.vehicles


def covered_places(release: ReleaseModel, queried: BoolArray) -> BoolArray:
    """Return which record columns the queries and the fixed sensors cover, shape (k, places)."""
    observed = release.setup.observed(queried)
    if not isinstance(release, Paced):
        return observed
    covered: BoolArray = observed @ release.ledgers.covers > 0.0
    return covered


def _is_cleared(release: ReleaseModel) -> bool:
    """Return whether every second has ledgers of its own, which begin at zero."""
    settings = release.setup.settings
    return isinstance(settings, PacedSettings) and settings.unit == "event"


def _text(values: AnyArray) -> str:
    return " ".join(f"{value:.6g}" for value in values.tolist())

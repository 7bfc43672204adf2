"""Watchers that add columns to the rows of episodes: contributions, honesty.

All look at the true traffic, for evaluation only.
"""

from __future__ import annotations

import numpy as np

from dptse_env.evaluation import WARM_UP, Row, WatcherFactory
from dptse_env.process import QueryProcess
from dptse_env.release import Capped, Paced
from dptse_env.release.vehicles import VehicleRows
from dptse_env.utils.arrays import AnyArray, BoolArray

LENGTHS = (0, 30, 60, 90, 120, 150, 180)
"""Lengths of trips [s] at which their bins begin; the last has no end."""


class Contributions:
    """Contributions of the vehicles of a batch of episodes, by place and by length of trip.

    A contribution is counted once for each second in which a query covers a vehicle. Where queries
    and fixed sensors are two groups of channels, it is those to queries. Episodes begin at second 0
    of their records. A vehicle that still drives at the end of an episode counts with what it has
    done by then.

    Columns:

    - ``n_met``: contributions that queries called for;
    - ``n_refused``: those that a ledger or a cap refused;
    - ``met``, ``refused``: both by mainline segment;
    - ``met_of``, ``refused_of``: both by the seconds that the vehicle was on the mainline, in bins
      of `LENGTHS`.

    Raises:
        ValueError: The release model keeps no account of single vehicles.
    """

    def __init__(self, process: QueryProcess) -> None:
        """Prepare for the episodes of a process."""
        task = process.release.task
        if not isinstance(process.release, Paced | Capped):
            raise ValueError(f"privacy.preset must keep account of vehicles, got {task.name!r}")
        self._process, self._ledgers = process, process.release.ledgers
        self._is_cleared = isinstance(process.release, Paced) and task.settings.unit == "event"
        self._covers = task.covers[task.channels.group == 0]
        shape = (process.n_episodes, process.interface.queries.n_mainline)
        self._met, self._refused = np.zeros((2, *shape), dtype=np.int64)
        self._before: AnyArray | None = None

    def __call__(self) -> None:
        """Count the contributions of the second that has passed."""
        paid, process = self._ledgers.paid[:, 0], self._process
        if self._before is None:  # the call after the reset, before any query
            self._seconds, self._met_of, self._refused_of = np.zeros((3, *paid.shape), dtype=int)
        else:
            observed = process.release.task.observed(process.queried)[:, : len(self._covers)]
            covered = observed @ self._covers
            # Ledgers that are cleared every second begin at zero.
            pays = paid > (0.0 if self._is_cleared else self._before)
            rows = process.traffic.vehicles(process.traffic_index, process.time)
            for k in range(len(paid)):
                self._follow(k, rows, covered[k], pays[k])
        self._before = paid.copy()

    def _follow(self, k: int, rows: VehicleRows, covered: BoolArray, pays: BoolArray) -> None:
        """Count the contributions of one episode: covered places, and who has paid."""
        n, second = self._met.shape[1], slice(rows.start[k], rows.stop[k])
        seen = rows.speed[0, second] >= 0.0
        vehicle, place = rows.vehicle[second][seen], rows.cell[second][seen]
        self._seconds[k, vehicle[place < n]] += 1
        met = np.append(covered, False)[np.minimum(place, len(covered))]
        vehicle, place = vehicle[met], place[met]
        refused = ~pays[vehicle]
        self._met_of[k, vehicle] += 1
        self._refused_of[k, vehicle[refused]] += 1
        self._met[k] += np.bincount(place, minlength=n)[:n]
        self._refused[k] += np.bincount(place[refused], minlength=n)[:n]

    def rows(self) -> list[Row]:
        """See `dptse_env.evaluation.Watcher.rows`."""
        return [self._row(k) for k in range(len(self._met))]

    def _row(self, k: int) -> Row:
        on_road = self._seconds[k] > 0
        length = np.digitize(self._seconds[k, on_road], LENGTHS) - 1

        def by_length(counts: AnyArray) -> list[float]:
            return list(map(float, np.bincount(length, counts[k, on_road], len(LENGTHS))))

        return {
            "n_met": int(self._met_of[k].sum()),
            "n_refused": int(self._refused_of[k].sum()),
            "met": self._met[k].tolist(),
            "refused": self._refused[k].tolist(),
            "met_of": by_length(self._met_of),
            "refused_of": by_length(self._refused_of),
        }


class Honesty:
    """Honesty of the estimates of a batch of episodes, after the warm-up.

    Columns:

    - ``chi2_density``, ``chi2_speed``: mean squares of errors over their reported deviations,
      speeds of occupied segments only.
    """

    def __init__(self, process: QueryProcess) -> None:
        """Begin with nothing."""
        self._process, shape = process, (process.n_episodes, 2)
        self._counts, self._squares = np.zeros(shape), np.zeros(shape)

    def __call__(self) -> None:
        """Add the present second, unless it is part of the warm-up."""
        process = self._process
        if process.elapsed[0] <= WARM_UP:
            return
        n, estimate = process.interface.queries.n_mainline, process.estimate
        truth = process.truth(np.arange(process.n_episodes))[:, :n]
        occupied = truth[..., 0] > 0.0
        means = np.stack([estimate.density, estimate.speed], -1)[:, :n]
        spread = np.stack([estimate.density_std, estimate.speed_std], -1)[:, :n]
        counts = np.stack([np.ones_like(occupied), occupied], -1)
        error = np.where(counts, means - truth, 0.0)
        with np.errstate(divide="ignore"):  # an estimator of somebody's own may claim to be exact
            ratio = np.divide(error, spread, out=np.zeros_like(error), where=error != 0.0)
        self._counts += counts.sum(axis=1)
        self._squares += np.sum(ratio**2, axis=1)

    def rows(self) -> list[Row]:
        """See `dptse_env.evaluation.Watcher.rows`."""
        chi2 = self._squares / np.maximum(self._counts, 1.0)
        return [
            dict(zip(("chi2_density", "chi2_speed"), row, strict=True)) for row in chi2.tolist()
        ]


WATCHERS: dict[str, WatcherFactory] = {"contributions": Contributions, "honesty": Honesty}
"""Watchers by the names that cells give."""

"""Honesty of an estimator in an episode: chi-square, coverage, and errors by regime of traffic."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from agents.evaluation.episodes import WARM_UP, EpisodeScore
from dptse_env.process import QueryProcess
from dptse_env.utils.arrays import BoolArray, FloatArray

LEVELS = (50, 90, 95)
"""Nominal coverage of intervals [%]."""
JAM, FRONT, FREE = REGIMES = ("jam", "front", "free")
"""Regimes of a segment in a second: at a front its speed and a neighbour's differ by more than
`JUMP`; elsewhere it is in a jam below `SLOW`, or else in free flow."""
JUMP, SLOW = 30.0, 50.0
"""Speeds [km/h]."""


@dataclass(frozen=True)
class EstimatorScore(EpisodeScore):
    """The errors of an episode, and how honest its deviations were, after the warm-up.

    Attributes:
        chi2_density: Mean square of density errors over their reported deviations.
        chi2_speed: The same for speeds of occupied segments.
        density_50: Densities within the reported interval of 50 % [%].
        n_jam: Number of seconds of segments in a jam.
        density_jam: Sum of their squared density errors [(veh/km)^2].
        speed_jam: Sum of their squared speed errors [(km/h)^2].

    The rest is named likewise.
    """

    chi2_density: float
    chi2_speed: float
    density_50: float
    density_90: float
    density_95: float
    speed_50: float
    speed_90: float
    speed_95: float
    n_jam: float
    density_jam: float
    speed_jam: float
    n_front: float
    density_front: float
    speed_front: float
    n_free: float
    density_free: float
    speed_free: float


class EstimateWatcher:
    """Follows the estimates of a batch of episodes; call it after the reset and every second."""

    def __init__(self, process: QueryProcess) -> None:
        """Begin with nothing."""
        self._process, n = process, process.n_episodes
        self._cells, self._occupied, self._seconds = np.zeros(n), np.zeros(n), 0
        self._chi2 = np.zeros((n, 2))
        self._inside = np.zeros((n, 2, len(LEVELS)))
        self._counts = np.zeros((n, len(REGIMES)))
        self._squares = np.zeros((n, len(REGIMES), 2))
        self._bounds = stats.norm.ppf(0.5 + np.array(LEVELS) / 200.0)

    def __call__(self) -> None:
        """Add the present second, unless it is part of the warm-up."""
        process = self._process
        if process.time[0] <= WARM_UP:
            return
        n, estimate = process.interface.n_mainline, process.estimate
        truth = process.truth(np.arange(process.n_episodes))[:, :n]
        occupied = truth[..., 0] > 0.0
        means = np.stack([estimate.density, estimate.speed], -1)[:, :n]
        spread = np.stack([estimate.density_std, estimate.speed_std], -1)[:, :n]
        counts = np.stack([np.ones_like(occupied), occupied], -1)
        error = np.where(counts, means - truth, 0.0)
        ratio = np.abs(error) / spread
        self._cells += n
        self._occupied += occupied.sum(axis=1)
        self._chi2 += np.sum(ratio**2, axis=1)
        within = (ratio[..., None] <= self._bounds) & counts[..., None]
        self._inside += within.sum(axis=1)
        for k, members in enumerate(regimes(truth[..., 1], occupied)):
            self._counts[:, k] += members.sum(axis=1)
            self._squares[:, k] += np.sum(error**2 * members[..., None], axis=1)

    def scores(self, episodes: Sequence[EpisodeScore]) -> list[EstimatorScore]:
        """Return the scores of the episodes with what was watched."""
        totals = np.stack([self._cells, np.maximum(self._occupied, 1.0)], axis=-1)
        chi2, inside = self._chi2 / totals, 100.0 * self._inside / totals[..., None]
        found = []
        for k, score in enumerate(episodes):
            by_regime = np.column_stack([self._counts[k], self._squares[k]])
            numbers = [*chi2[k], *inside[k].ravel(), *by_regime.ravel()]
            found.append(
                EstimatorScore(*dataclasses.astuple(score), *(float(each) for each in numbers))
            )
        return found


def regimes(speed: FloatArray, occupied: BoolArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return the members of `REGIMES` among occupied segments, shape (n, N) each.

    Args:
        speed: True speeds [km/h], shape (n, N).
        occupied: Flags, shape (n, N).
    """
    jumps = np.abs(np.diff(speed, axis=1)) > JUMP
    jumps &= occupied[:, 1:] & occupied[:, :-1]
    front = np.zeros_like(occupied)
    front[:, 1:] |= jumps
    front[:, :-1] |= jumps
    jam = occupied & ~front & (speed < SLOW)
    return jam, front, occupied & ~front & ~jam

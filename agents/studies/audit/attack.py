"""The attack: play both worlds many times, and score each public transcript."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from agents.studies.audit.strategies import FixedQueries
from agents.studies.audit.worlds import AdjacentWorlds
from dptse_env.config import EnvConfig
from dptse_env.parts import make_parts, make_release
from dptse_env.process import QueryProcess
from dptse_env.release import (
    GaussianMechanism,
    ReleaseRequest,
    TrafficTable,
    require_gaussian,
)
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray

BATCH = 250
"""Default number of runs per world that are played at once."""


@dataclass(frozen=True)
class Runs:
    """Scores and distances of the runs, world by world.

    Attributes:
        scores: Log-likelihood ratio of world 1 of each transcript, (2, n).
        distances: Distance between the worlds' true sums under each run's queries, in units of the
            noise, (2, n). For a constant distance D the scores are N(-+D^2/2, D^2).
    """

    scores: FloatArray
    distances: FloatArray


class RecordingMechanism(GaussianMechanism):
    """Gaussian noise that keeps its last releases: the public transcript, one step at a time.

    Attributes:
        released: The last releases, shape (k, n_columns, 2).
    """

    released: FloatArray

    def release(self, episodes: IntArray, values: FloatArray) -> FloatArray:
        """See `Mechanism.release`."""
        self.released = super().release(episodes, values)
        return self.released


class Adversary:
    """Knows both worlds and the queries, and works out the sums of either world.

    Attributes:
        score: Log-likelihood ratio of world 1 of each run's transcript so far, shape (k,).
        square: Squared distance between the worlds' sums so far, in units of the noise, (k,).
    """

    def __init__(
        self, config: EnvConfig, worlds: AdjacentWorlds, n_runs: int, sigma: FloatArray
    ) -> None:
        """Prepare for n_runs at once, under noise of standard deviation `sigma`, (2,)."""
        traffic = TrafficTable(config.corridor, (0, 1), worlds)
        # Sums of both worlds for every run, whichever world it is in.
        self._release = require_gaussian(make_release(config, 2 * n_runs, traffic), "the audit")
        for world, record in traffic.load([0, 1]):
            self._release.load(world, record)
        self._sigma = sigma

    def reset(self, n_runs: int) -> None:
        """Begin new runs."""
        self._episodes, self._worlds = np.arange(2 * n_runs), np.repeat([0, 1], n_runs)
        nothing = np.random.default_rng(0)
        self._release.reset(self._episodes, [nothing] * len(self._episodes))
        self.score, self.square = np.zeros(n_runs), np.zeros(n_runs)

    def expect(self, time: int, queried: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return midpoint and difference of both worlds' sums, (k, n_columns, 2), and add up.

        Both are in units of the noise; the difference is zero where nothing is observed.
        """
        observed = self._release.setup.observed(queried)
        times = np.full(len(self._episodes), time)
        answers = self._release.true_values(
            ReleaseRequest(self._episodes, self._worlds, times, np.tile(observed, (2, 1)))
        )
        zero, first = np.split(answers / self._sigma, 2)
        difference = np.where(observed[:, :, None], first - zero, 0.0)
        self.square += np.sum(difference**2, axis=(1, 2))
        return 0.5 * (zero + first), difference

    def update(self, time: int, queried: BoolArray, released: FloatArray) -> None:
        """Score one released step: the log-likelihood ratio of Gaussians of either mean."""
        midpoint, difference = self.expect(time, queried)
        self.score += np.sum((released / self._sigma - midpoint) * difference, axis=(1, 2))


def planned_distance(
    config: EnvConfig, worlds: AdjacentWorlds, plan: BoolArray, sigma: FloatArray
) -> float:
    """Return the distance between the worlds under a plan (horizon, n_mainline), in noise units."""
    adversary = Adversary(config, worlds, 1, sigma)
    adversary.reset(1)
    for step, queried in enumerate(plan):
        adversary.expect(step + 1, queried[None])
    return float(np.sqrt(adversary.square[0]))


def attack(
    config: EnvConfig,
    worlds: AdjacentWorlds,
    policy: FixedQueries,
    n_runs: int,
    *,
    noise_factor: float = 1.0,
    seed: int = 0,
    batch: int = BATCH,
    progress: bool = True,
) -> Runs:
    """Play both worlds and score every transcript.

    Each run is an episode of the decision process from the first second of the record. Estimates
    reveal nothing beyond the releases, so the cheapest estimator is used.

    Args:
        config: The configuration under attack.
        worlds: The two worlds.
        policy: Chooses the queries.
        n_runs: Runs per world n.
        noise_factor: Multiplies the noise that the configuration declares.
        seed: Seeds the noise, >= 0.
        batch: Runs per world that are played at once; results do not depend on it.
        progress: Whether to show a progress bar.
    """
    config = dataclasses.replace(
        config, traffic_seeds=(0, 1), random_start=False, action="mask",
        estimator="open_loop", backend="compiled", estimator_settings=None,
    )  # fmt: skip
    size = min(batch, n_runs)
    process = QueryProcess(make_parts(config, 2 * size, worlds))
    release = require_gaussian(process.release, "the audit")
    sigma, columns = noise_factor * release.sigma, release.setup.n_columns
    mechanism = RecordingMechanism(sigma, n_episodes=2 * size, n_segments=columns)
    release.mechanism = mechanism
    adversary = Adversary(config, worlds, 2 * size, sigma)
    parts = []
    with tqdm(
        total=2 * n_runs, desc="attacking", unit="run", mininterval=0.5, disable=not progress
    ) as bar:
        for first in range(0, n_runs, size):
            runs = range(first, min(first + size, n_runs))
            n = 2 * len(runs)
            for world in (0, 1):
                # A run's noise stream does not depend on the batch.
                streams = [np.random.default_rng((seed, world, run)) for run in runs]
                options = {"traffic_seed": world, "start": 0}
                process.reset(world * len(runs) + np.arange(len(runs)), streams, options)
            adversary.reset(n)
            for step in range(config.horizon_steps):
                queries = policy.queries(step, adversary.score)
                process.step(np.arange(n), queries.astype(np.int8))
                adversary.update(step + 1, process.queried[:n], mechanism.released)
            parts.append([adversary.score.reshape(2, -1), np.sqrt(adversary.square).reshape(2, -1)])
            bar.update(n)
    scores, distances = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    return Runs(scores, distances)

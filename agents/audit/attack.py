"""The attack: play both worlds many times, and score each public transcript."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from agents.audit.releases import AttackedRelease, Overheard, Terms, attacked
from agents.audit.strategies import FixedQueries
from agents.audit.worlds import AdjacentWorlds, Trajectory, audited
from agents.executors import THIS_PROCESS, AnyExecutor, run_in_order
from dptse_env.config import EnvConfig
from dptse_env.estimators import Measurement
from dptse_env.parts import make_parts, make_release, make_traffic
from dptse_env.process import QueryProcess
from dptse_env.release import Request
from dptse_env.traffic import Record
from dptse_env.utils.arrays import BoolArray, FloatArray

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


class Adversary:
    """Knows both worlds and all that is public, and works out the sums of either world.

    Attributes:
        score: Log-likelihood ratio of world 1 of each run's transcript so far, shape (k,).
        square: Squared distance between the worlds' sums so far, in units of the noise, (k,).
    """

    def __init__(self, config: EnvConfig, worlds: AdjacentWorlds, n_runs: int) -> None:
        """Prepare for n_runs at once."""
        traffic = make_traffic(config, worlds)
        traffic.load([0, 1])
        # Sums of both worlds for every run, whichever world it is in.
        self._attacked = attacked(make_release(config, 2 * n_runs, traffic))

    def reset(self, n_runs: int) -> None:
        """Begin new runs."""
        self._episodes, self._worlds = np.arange(2 * n_runs), np.repeat([0, 1], n_runs)
        nothing = np.random.default_rng(0)
        self._attacked.model.reset(self._episodes, [nothing] * len(self._episodes))
        self.score, self.square = np.zeros(n_runs), np.zeros(n_runs)

    def expect(self, time: int, observed: BoolArray, terms: Terms) -> tuple[FloatArray, FloatArray]:
        """Return midpoint and difference of both worlds' sums, (k, C, 2), and add up.

        Both are in units of the noise; the difference is zero where nothing is observed.
        """
        times = np.full(len(self._episodes), time)
        request = Request(self._episodes, self._worlds, times, np.tile(observed, (2, 1)))
        both = terms.repeated(2)
        zero, first = np.split(self._attacked.sums(request, both) / both.sigma, 2)
        difference = np.where(observed[:, :, None], first - zero, 0.0)
        self.square += np.sum(difference**2, axis=(1, 2))
        return 0.5 * (zero + first), difference

    def update(self, time: int, released: Measurement, terms: Terms) -> None:
        """Score one released step: the log-likelihood ratio of Gaussians of either mean."""
        midpoint, difference = self.expect(time, released.observed, terms)
        self.score += np.sum((released.values / terms.sigma - midpoint) * difference, axis=(1, 2))


@dataclass(frozen=True)
class Batch:
    """Some runs in both worlds, with everything that a worker needs to play them.

    Attributes:
        runs: Numbers of the runs, which seed their noise.
    """

    config: EnvConfig
    worlds: AdjacentWorlds
    policy: FixedQueries
    runs: range
    noise_factor: float
    seed: int


def attack(
    config: EnvConfig,
    worlds: AdjacentWorlds,
    policy: FixedQueries,
    n_runs: int,
    *,
    noise_factor: float = 1.0,
    seed: int = 0,
    batch: int = BATCH,
    executor: AnyExecutor = THIS_PROCESS,
    progress: bool = True,
) -> Runs:
    """Play both worlds and score every transcript.

    Each run is an episode of the decision process from the first second of the record. Where prices
    follow estimates, the estimator is that of the configuration. Elsewhere estimates reveal nothing
    beyond the releases, and the cheapest estimator is used.

    Args:
        config: The configuration under attack.
        worlds: The two worlds.
        policy: Chooses the queries.
        n_runs: Runs per world n.
        noise_factor: Multiplies the noise that the configuration declares.
        seed: Seeds the noise, >= 0.
        batch: Runs per world that are played at once; results do not depend on it.
        executor: Plays the batches.
        progress: Whether to show a progress bar.
    """
    config = audited(attacked_form(config), worlds)
    batches = [
        Batch(config, worlds, policy, range(n_runs)[first : first + batch], noise_factor, seed)
        for first in range(0, n_runs, batch)
    ]
    played = run_in_order(
        executor,
        play,
        batches,
        size=lambda each: 2 * len(each.runs),
        progress=progress,
        desc="attacking",
        unit="run",
    )
    return Runs(
        np.concatenate([runs.scores for runs in played], axis=1),
        np.concatenate([runs.distances for runs in played], axis=1),
    )


def play(batch: Batch) -> Runs:
    """Play a batch of runs in both worlds."""
    config, n = batch.config, 2 * len(batch.runs)
    process, release, played = _make_process(config, batch.worlds, n)
    played.scale_noise(batch.noise_factor)
    adversary = Adversary(config, batch.worlds, n)
    for world in (0, 1):
        # A run's noise stream does not depend on the batch.
        streams = [np.random.default_rng((batch.seed, world, run)) for run in batch.runs]
        options = {"traffic_seed": world, "start": 0}
        process.reset(world * len(streams) + np.arange(len(streams)), streams, options)
    adversary.reset(n)
    for step in range(config.horizon_steps):
        queries = batch.policy.queries(step, adversary.score)
        process.step(np.arange(n), queries.astype(np.int8))
        adversary.update(step + 1, release.last, played.terms(release.last))
    return Runs(adversary.score.reshape(2, -1), np.sqrt(adversary.square).reshape(2, -1))


def _make_process(
    config: EnvConfig, worlds: AdjacentWorlds, n: int
) -> tuple[QueryProcess, Overheard, AttackedRelease]:
    """Return a process of n episodes in either world, and its release model, overheard."""
    traffic = make_traffic(config, worlds)
    release = Overheard(make_release(config, n, traffic))
    process = QueryProcess(make_parts(config, n, traffic=traffic, release=release))
    return process, release, attacked(release.model)


def public_terms(config: EnvConfig, record: Record, plan: BoolArray, seed: int = 0) -> Terms:
    """Play an episode over a record, and return the terms of its releases, with T rows.

    Args:
        config: The configuration.
        record: The traffic.
        plan: Queries, shape (T, n_mainline).
        seed: Seeds noise and estimator.
    """
    alike = AdjacentWorlds(record, (Trajectory.absent(), Trajectory.absent()))
    process, release, played = _make_process(attacked_form(config), alike, 1)
    one, terms = np.arange(1), []
    process.reset(one, [np.random.default_rng(seed)], {"traffic_seed": 0, "start": 0})
    for queried in plan:
        process.step(one, queried[None].astype(np.int8))
        terms.append(played.terms(release.last))
    return Terms(*(np.concatenate(rows) for rows in zip(*terms, strict=True)))


def attacked_form(config: EnvConfig) -> EnvConfig:
    """Return a configuration with the episodes and the estimator of the attack."""
    config = dataclasses.replace(
        config, traffic_seeds=(0, 1), random_start=False, action="mask", backend="compiled"
    )
    if attacked(make_release(config)).follows_estimates:
        return config
    return dataclasses.replace(config, estimator="open_loop", estimator_settings=None)

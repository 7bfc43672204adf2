"""The attack: play both worlds many times, and score each public transcript."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from agents.audit.worlds import Worlds, audited
from agents.executors import Executor, run_in_order, this_process
from dptse_env.config import EnvConfig
from dptse_env.estimators import Estimate, Measurement
from dptse_env.parts import make_release, make_traffic
from dptse_env.process import QueryProcess
from dptse_env.release import GaussianRelease, ReleaseModel, Request
from dptse_env.release.noise import Noise
from dptse_env.traffic import readings
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


class _Noiseless(Noise):
    """Adds nothing, and rounds nothing."""

    def __init__(self) -> None:
        super().__init__(0, 0)

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        pass

    def added(
        self, episodes: IntArray, values: FloatArray, sigma: FloatArray, unit: FloatArray
    ) -> FloatArray:
        return values / unit[:, None]


class Overheard(ReleaseModel):
    """A release model and an adversary who hears all that it releases.

    He knows both worlds and all that is public. To each second he finds out what either world
    would have released without noise: by the same release model, given the run's own queries and
    predictions. What was released he scores by the likelihood ratio of Gaussians of either mean.
    Loops report the same in both worlds, whose vehicles differ in what they report.

    Attributes:
        model: The release model.
        last: Its last release.
        means: What either world would have released without noise, shape (2, k, C, 2).
        heard: Score and squared distance of each channel of it, shape (2, k, C).
        score: Log-likelihood ratio of world 1 of each run's transcript so far, shape (k,).
        square: Squared distance between the worlds' sums so far, in units of the noise, (k,).
    """

    last: Measurement
    means: FloatArray
    heard: FloatArray

    def __init__(self, config: EnvConfig, worlds: Worlds, n: int, factor: float) -> None:
        """Prepare for n runs, whose noise is multiplied by a factor.

        Raises:
            ValueError: The adversary does not know the distribution of the noise.
        """
        traffic = make_traffic(config, worlds)
        traffic.load(np.arange(len(worlds.pairs)))
        corridor = config.corridor
        if corridor.loops is not None:
            # The guarantee is one given the readings: worlds differ in reports, not in what drives.
            traffic.readings[:] = readings(worlds.rest, corridor.stations, corridor.loops)
        self.model = make_release(config, n, traffic)
        super().__init__(self.model.task, traffic)
        # Every run in both worlds, whichever it is in.
        self._either = make_release(config, 2 * n, traffic)
        self._pairs, self._factor = worlds.pairs, factor
        if factor != 1.0:
            _set_noise(self.model, Noise(n, self.task.n_channels, scale=factor))
        _set_noise(self._either, _Noiseless())
        self.score, self.square = np.zeros(n), np.zeros(n)

    @property
    def sigma(self) -> FloatArray:
        """See `ReleaseModel.sigma`."""
        return self.model.sigma

    def reset(self, episodes: IntArray, generators: Sequence[np.random.Generator]) -> None:
        """See `ReleaseModel.reset`."""
        self.model.reset(episodes, generators)
        self._either.reset(self._in_both(episodes), [*generators, *generators])
        self.score[episodes] = self.square[episodes] = 0.0

    def release(self, request: Request) -> Measurement:
        """See `ReleaseModel.release`."""
        # Asked once: a prediction holds for its second alone.
        request = request._replace(prediction=cache(request.prediction))
        self.last = self.model.release(request)
        stated = self.last.sigma[self.last.observed]
        if not (stated > 0.0).all():
            raise ValueError(
                "the audit needs a release model that states positive deviations of its noise, got "
                f"{stated.min():g} from {self.task.name!r}"
            )
        sigma = self._factor * self.last.sigma
        self.means = self._both(request)
        zero, one = self.means / sigma
        difference = np.where(self.last.observed[:, :, None], one - zero, 0.0)
        told = (self.last.values / sigma - 0.5 * (zero + one)) * difference
        self.heard = np.stack([told.sum(axis=2), np.sum(difference**2, axis=2)])
        score, square = self.heard.sum(axis=2)
        self.score[request.episodes] += score
        self.square[request.episodes] += square
        return self.last

    def _both(self, request: Request) -> FloatArray:
        """Return what either world would release without noise, shape (2, k, C, 2)."""

        def predicted_twice() -> Estimate:
            return Estimate(*(np.concatenate([each, each]) for each in request.prediction()))

        k = len(request.episodes)
        both = Request(
            self._in_both(request.episodes),
            self._pairs[request.traffic].T.ravel(),
            np.tile(request.times, 2),
            np.tile(request.observed, (2, 1)),
            predicted_twice,
        )
        values = self._either.release(both).values
        return values.reshape(2, k, *values.shape[1:])

    def _in_both(self, episodes: IntArray) -> IntArray:
        return np.concatenate([episodes, episodes + len(self.score)])


def _set_noise(release: Any, noise: Noise) -> None:
    if not isinstance(getattr(release, "noise", None), Noise):
        raise ValueError(
            "the audit needs a release model with Gaussian noise, a dptse_env.release.noise.Noise "
            f"as its attribute noise, got {release.task.name!r}"
        )
    release.noise = noise


def make_overheard(
    config: EnvConfig, worlds: Worlds, n: int, factor: float = 1.0
) -> tuple[QueryProcess, Overheard]:
    """Return a process of n episodes of some worlds, and its release model, overheard."""
    config = audited(attacked_form(config), worlds)
    release = Overheard(config, worlds, n, factor)
    return QueryProcess(config, n, traffic=release.traffic, release=release), release


def attack(
    config: EnvConfig,
    worlds: Worlds,
    plan: BoolArray,
    n_runs: int,
    *,
    noise_factor: float = 1.0,
    seed: int = 0,
    batch: int = BATCH,
    executor: Executor = this_process,
    progress: bool = True,
) -> Runs:
    """Play both worlds and score every transcript.

    Each run is an episode of the decision process from the first second of the record.

    Args:
        config: The configuration under attack.
        worlds: The two worlds.
        plan: Options to query by step, shape (horizon, G).
        n_runs: Runs per world n.
        noise_factor: Multiplies the noise that the configuration declares.
        seed: Seeds the noise, >= 0.
        batch: Runs per world that are played at once; results do not depend on it.
        executor: Plays the batches.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: The adversary does not know the distribution of the noise.
    """
    played = run_in_order(
        executor,
        partial(play, config, worlds, plan, noise_factor, seed),
        [range(n_runs)[first : first + batch] for first in range(0, n_runs, batch)],
        size=lambda runs: 2 * len(runs),
        progress=progress,
        desc="attacking",
        unit="run",
    )
    return Runs(
        np.concatenate([runs.scores for runs in played], axis=1),
        np.concatenate([runs.distances for runs in played], axis=1),
    )


def play(
    config: EnvConfig,
    worlds: Worlds,
    plan: BoolArray,
    noise_factor: float,
    seed: int,
    runs: range,
) -> Runs:
    """Play some runs in both worlds; their numbers seed their noise."""
    # A run's noise stream does not depend on the batch.
    streams = [np.random.default_rng((seed, world, run)) for world in (0, 1) for run in runs]
    seeds = np.repeat([0, 1], len(runs))
    *_, release = overheard(config, worlds, seeds, plan, streams, noise_factor)
    return Runs(release.score.reshape(2, -1), np.sqrt(release.square).reshape(2, -1))


def overheard(
    config: EnvConfig,
    worlds: Worlds,
    seeds: IntArray,
    plan: BoolArray,
    streams: Sequence[np.random.Generator],
    factor: float = 1.0,
) -> Iterator[Overheard]:
    """Play an episode of each of k worlds; give the overheard release model after every second.

    Args:
        config: The configuration under attack.
        worlds: The worlds.
        seeds: Those that are played, shape (k,).
        plan: Options to query by step, shape (horizon, G), or (horizon, k, G) where each episode
            has its own.
        streams: Generators that seed the k episodes.
        factor: Multiplies the noise that the configuration declares.

    Raises:
        ValueError: The adversary does not know the distribution of the noise.
    """
    process, release = make_overheard(config, worlds, len(seeds), factor)
    every = np.arange(len(seeds))
    process.reset(every, streams, {"traffic_seed": seeds, "start": 0})
    for queried in plan.reshape(len(plan), -1, plan.shape[-1]).astype(np.int8):
        process.step(every, np.broadcast_to(queried, (every.size, queried.shape[-1])))
        yield release


def attacked_form(config: EnvConfig) -> EnvConfig:
    """Return a configuration with the episodes and the estimator of the attack.

    Where noise is constant, estimates reveal nothing beyond the releases, and the cheapest
    estimator is used. Elsewhere prices and centres follow them, so that it is the configuration's.
    """
    config = dataclasses.replace(config, random_start=False, action="mask", backend="compiled")
    if isinstance(make_release(config), GaussianRelease):
        return dataclasses.replace(config, estimator="open_loop", estimator_settings=None)
    return config

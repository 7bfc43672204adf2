"""The step of the decision process, written in this place alone, for a batch of episodes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from operator import getitem
from typing import Any

import numpy as np

from dptse_env.config import EnvConfig
from dptse_env.estimators import Estimate, Estimator, Measurement, make_estimator
from dptse_env.measurement import (
    BOUNDARIES,
    Fusion,
    LoopReadings,
    Rewind,
    SensorErrors,
    nominal_state,
)
from dptse_env.model import ARZModel
from dptse_env.parts import (
    QueryInterface,
    complete_report,
    make_interface,
    make_model,
    make_release,
    make_traffic,
)
from dptse_env.release import ReleaseModel, Request, Traffic, check_released
from dptse_env.spaces.actions import PendingPicks, check_decision
from dptse_env.spaces.observations import AGE_CAP, PublicState
from dptse_env.spaces.rewards import EstimationError, ScoredSecond, estimation_error
from dptse_env.traffic import RecordLibrary
from dptse_env.utils.arrays import Action, BoolArray, FloatArray, IntArray, Observation
from dptse_env.utils.registry import is_foreign
from dptse_env.utils.threads import EpisodeThreads
from dptse_env.utils.validation import shown
from dptse_env.utils.vector_info import Infos, info_of

TRUTH_INFO = (
    "rmse_density", "rmse_speed", "n_occupied", "traffic_seed", "true_density", "true_speed",
    "time",
)  # fmt: skip
"""Keys of ``info`` that come from the true traffic, or name its record; the others are public."""


@dataclass(frozen=True)
class Outcome:
    """Result of a step or a reset of k episodes.

    Attributes:
        observation: Shape (k, size).
        reward: Mean over the seconds of the step, shape (k,); zero while a sequential decision is
            not complete.
        truncated: Whether the horizon is reached, shape (k,).
    """

    observation: Observation
    reward: FloatArray
    truncated: BoolArray


class QueryProcess:
    """The decision process: traffic evolves by itself, and a policy chooses segments to query.

    Queries never change the traffic, so an episode replays a record of SUMO. Every array has a
    leading axis over the n episodes; the argument ``episodes`` has the indices of the k of them
    that a call concerns.

    Attributes:
        config: The configuration.
        interface: Action encoding, observation and reward.
        traffic: The true traffic.
        release: The release model, which makes all data that leaves the road.
        boundary: The model's inputs at the road's ends and ramps.
        model: The traffic model.
        estimator: The estimator.
        sensor_errors: Errors of the fixed sensors; None where they have none.
        fusion: Turns releases into measurements of all vehicles; None where they are these.
        loops: Readings of loops; None where there are none.
        rewind: Takes the estimator back to where an interval began, with its readings; None where
            there are no loops.
        n_episodes: Size of the batch.
        time: Second of the record that each episode stands at, shape (n,).
        start: Second that it began at, below 0 before its first reset, shape (n,).
        traffic_index: Index into ``config.traffic_seeds`` of each episode's traffic, shape (n,).
        queried: The queries of each episode's last decision, shape (n, G); what watchers see in a
            second are those of the second.
        watchers: Called after every second with the process and the episodes that moved, (k,).
        age: Steps since each mainline segment was last observed, shape (n, n_mainline).
        released: The last releases of the M channels, shape (n, M, 2).
        pending: State of the action encoding between actions.
        estimate: The present estimates, arrays of shape (n, S).
        error: Their error, arrays of shape (n,).
    """

    def __init__(
        self,
        config: EnvConfig,
        n_episodes: int = 1,
        library: RecordLibrary | None = None,
        *,
        interface: QueryInterface | None = None,
        model: ARZModel | None = None,
        traffic: Traffic | None = None,
        release: ReleaseModel | None = None,
        threads: int | None = 1,
    ) -> None:
        """Make the parts that a configuration describes; nothing is recorded before `reset`.

        A part that is given is used as it is, and parts that are made of it follow. Reports
        describe the parts in force.

        Args:
            config: The configuration.
            n_episodes: Size n of the batch.
            library: Source of the records; the user's cache if None.
            interface: Action encoding, observation and reward.
            model: The traffic model.
            traffic: Shared by several processes, records are in memory once.
            release: Made for n episodes and this traffic.
            threads: Threads that the estimators of a large batch may use; None for one per core.

        Raises:
            ValueError: A part of another package is not what is expected.
        """
        self.config, self.n_episodes, n = config, n_episodes, n_episodes
        self.interface = interface or make_interface(config)
        self.traffic = traffic or make_traffic(config, library)
        self.release = release or make_release(config, n, self.traffic)
        self.model, task = model or make_model(config), self.release.task
        boundary = BOUNDARIES[config.privacy.boundary]
        self.boundary = boundary(task, self.traffic, self.model)
        self.estimator: Estimator = make_estimator(
            config.estimator, config.backend, self.model, n, config.settings()
        )
        exact, share = config.sensor_settings.are_exact, config.penetration.published_share
        self.sensor_errors = None if exact else SensorErrors(task, config.sensor_settings)
        is_fused = config.has_separate_sensors
        self.fusion = Fusion(task, config.fusion, share) if is_fused else None
        self._threads = EpisodeThreads(threads if self.estimator.is_compiled else 1)
        self.loops, self.rewind = None, None
        if config.corridor.loops is not None:
            self.loops = LoopReadings(task, self.traffic)
            self.rewind = Rewind(self.loops, self.estimator, task, self._threads)
        self._checks_estimates = is_foreign(self.estimator)
        self._checks_releases = is_foreign(self.release)
        self._checks_decisions = is_foreign(self.interface.actions)
        self._seeds = np.array(self.config.traffic_seeds)
        queries = self.interface.queries
        self.pending = PendingPicks(n, queries.n_queries)
        self.traffic_index = np.zeros(n, dtype=np.int64)
        self.time = np.zeros(n, dtype=np.int64)
        self.start = np.full(n, -self.config.horizon_steps, dtype=np.int64)
        self.queried = np.zeros((n, queries.n_queries), dtype=bool)
        self.n_dropped = np.zeros(n, dtype=np.int64)
        self.age = np.zeros((n, queries.n_mainline), dtype=np.int64)
        self.released = np.zeros((n, self.model.channels.size, 2))
        self.estimate = self.estimator.estimate()
        self.error = EstimationError(np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64))
        self.watchers: list[Callable[[QueryProcess, IntArray], None]] = []
        self._is_fork = False

    def fork(self) -> QueryProcess:
        """Return a copy that can be stepped to look ahead, with the same streams of noise.

        A fork that is stepped like its origin gives the same bits, and the origin is not affected.
        So it reads releases and loops of seconds to come: only oracles, and training on recorded
        traffic, may act on what it finds. It shares traffic and model and cannot be reset. One of a
        single episode takes some 0.6 ms to make, one of 64 some 70 us an episode.

        Raises:
            RuntimeError: The noise is secure: two releases with the same noise have no guarantee.
        """
        if self.config.privacy.noise == "secure":
            raise RuntimeError("a process whose privacy.noise is 'secure' has no forks")
        shared = (
            self.config, self.interface, self.model, self.traffic, self.loops, self._threads,
            self.release.task, self.watchers, *self.boundary.shared,
        )  # fmt: skip
        fork = copy.deepcopy(self, {id(item): item for item in shared})
        fork._is_fork, fork.watchers = True, []
        return fork

    def reset(
        self,
        episodes: IntArray,
        generators: Sequence[np.random.Generator],
        options: Mapping[str, Any] | None = None,
    ) -> Outcome:
        """Begin new episodes.

        Args:
            episodes: Shape (k,).
            generators: One generator per episode; each gives 128 bits, of which the independent
                streams of traffic, noise, estimator and fixed sensors are spawned, whatever the
                configuration.
            options: ``traffic_seed`` fixes the traffic (one of ``config.traffic_seeds``) and
                ``start`` the first second of the record; each one value, or k of them.

        Raises:
            ValueError: An option is unknown or out of range.
            RecordingError: SUMO could not make a record.
            RuntimeError: This is a fork.
        """
        if self._is_fork:
            raise RuntimeError("a fork cannot be reset: reset the process that it was made from")
        fixed = checked_options(options, self.config, len(episodes))
        streams = [list(map(np.random.default_rng, _seed_of(each).spawn(4))) for each in generators]
        for_traffic, for_noise, for_estimator, for_sensors = zip(*streams, strict=True)
        traffic, starts = draw_traffic(fixed, self.config, for_traffic)
        self.traffic.load(traffic)
        self.traffic_index[episodes], self.time[episodes] = traffic, starts
        self.start[episodes] = starts
        self.pending.reset(episodes)
        if self.sensor_errors is not None:
            self.sensor_errors.reset(episodes, for_sensors)
        self.release.reset(episodes, for_noise)
        self.boundary.reset(episodes)
        prior = nominal_state(self.config.corridor, self.model, self.time[episodes])
        self.estimator.reset(episodes, prior, for_estimator)
        if self.rewind is not None:
            self.rewind.begin(episodes, starts)
        self.queried[episodes] = False
        self.n_dropped[episodes] = 0
        self.age[episodes] = AGE_CAP
        self.released[episodes] = 0.0
        estimate = self._estimated(episodes)
        self._score(episodes, estimate)
        reward, observed = np.zeros(len(episodes)), self._observed(episodes, estimate)
        return Outcome(observed, reward, self.over[episodes])

    def step(self, episodes: IntArray, actions: Action) -> Outcome:
        """Carry out one action in each of ``episodes``.

        Args:
            episodes: Shape (k,).
            actions: Their actions, shape (k, *action space).

        Raises:
            ValueError: An action has a wrong shape, dtype or value.
        """
        encoding = self.interface.actions
        decision = encoding.decode(episodes, actions, self.pending)
        if self._checks_decisions:
            check_decision(encoding, decision, len(episodes))
        self.n_dropped[episodes] = decision.n_dropped
        ready, n_ready = decision.complete, np.count_nonzero(decision.complete)
        if n_ready == len(episodes):
            reward = self._query(episodes, decision.queried)
            return Outcome(self.observe(episodes), reward, self.over[episodes])
        reward = np.zeros(len(episodes))
        if n_ready > 0:
            reward[ready] = self._query(episodes[ready], decision.queried[ready])
        return Outcome(self.observe(episodes), reward, self.over[episodes])

    def _query(self, episodes: IntArray, queried: BoolArray) -> FloatArray:
        """Query, and let the other seconds of the step pass; return mean rewards, shape (k,).

        The last step of an episode has the seconds that are left.
        """
        reward = self._second(episodes, queried)
        if self.config.query_every == 1:
            return reward
        estimator, seconds, nobody = self.estimator, np.ones(len(episodes)), np.zeros_like(queried)
        told = estimator.innovations[episodes]
        flags = estimator.diverged, estimator.fallback, *self.release.flags
        raised = [flag[episodes] for flag in flags]
        for _ in range(1, self.config.query_every):
            live = np.flatnonzero(~self.over[episodes])
            if live.size == 0:
                break
            reward[live] += self._second(episodes[live], nobody[live])
            seconds[live] += 1.0
            for own, flag in zip(raised, flags, strict=True):
                np.maximum(own, flag[episodes], out=own)
        # What answers told is shown until the next decision; fixed sensors have told more since.
        answered = self.release.task.observed(queried) & ~self.release.task.observed(nobody)
        answered = answered[:, : told.shape[1], None]
        estimator.innovations[episodes] = np.where(answered, told, estimator.innovations[episodes])
        for own, flag in zip(raised, flags, strict=True):
            flag[episodes] = own
        self.queried[episodes] = queried
        return reward / seconds

    def _second(self, episodes: IntArray, queried: BoolArray) -> FloatArray:
        """Advance and score one second; return the rewards, shape (k,)."""
        self._advance(episodes, queried)
        reward = self._score(episodes, self._estimated(episodes))
        for watcher in self.watchers:
            watcher(self, episodes)
        return reward

    @property
    def elapsed(self) -> IntArray:
        """Seconds since each episode began, shape (n,)."""
        return self.time - self.start

    @property
    def was_reset(self) -> BoolArray:
        """Flags of episodes that were ever begun, shape (n,)."""
        return self.start >= 0

    @property
    def over(self) -> BoolArray:
        """Flags of episodes that are at their end or were never reset, shape (n,)."""
        return self.time - self.start >= self.release.task.horizon

    def _advance(self, episodes: IntArray, queried: BoolArray) -> None:
        """Advance one second: predict, release, update, and store the query."""
        traffic = self.traffic_index[episodes]
        inputs = self.boundary.inputs(episodes, traffic, self.time[episodes])
        self._threads.run(self.estimator.predict, episodes, inputs, getitem)
        own = slice(None) if self.n_episodes == 1 else episodes  # a slice is quicker to write to
        self.time[own] += 1
        observed = self.release.task.observed(queried)
        prediction: Callable[[], Estimate] = partial(self._predicted, episodes)
        if self.fusion is not None:  # reads it, too
            prediction = cache(prediction)
        request = Request(episodes, traffic, self.time[episodes], observed, prediction)
        measured = self.measure(request)
        self.boundary.update(episodes, measured)
        self._threads.run(self.estimator.update, episodes, measured, Measurement.at)
        if self.rewind is not None:
            self.rewind.follow(episodes, traffic, self.time[episodes], inputs, measured)
        self.queried[own] = queried
        rows = slice(self.released.shape[1])
        answered = measured.observed[:, rows, None]
        self.released[own] = np.where(answered, measured.values[:, rows], self.released[own])
        covered = self.release.task.covered(measured.observed)
        self.age[own] = np.where(covered, 0, self.age[own] + 1)

    def measure(self, request: Request) -> Measurement:
        """Release a second, which charges its vehicles; return what the estimator is given."""
        if self.sensor_errors is not None:
            request = self.sensor_errors.answering(request)
        measured = self.release.release(request)
        if self._checks_releases:
            check_released(self.release, measured, request)
        if self.sensor_errors is not None:
            measured = self.sensor_errors.added(request.episodes, measured)
        if self.fusion is not None:
            measured = self.fusion.read(measured, request.prediction())
        return measured

    @property
    def expected_sigma(self) -> FloatArray:
        """Standard deviations of the noise of a query's measurement before an episode, shape (2,).

        Those of the release model, scaled to all vehicles where not every one is connected.
        """
        sigma = self.release.sigma
        return sigma if self.fusion is None else self.fusion.scaled(sigma)

    def _predicted(self, episodes: IntArray) -> Estimate:
        """Return the estimator's output before it reads the release of this second."""
        return self.estimator.estimate().at(episodes)

    def _estimated(self, episodes: IntArray) -> Estimate:
        """Store the estimator's present output; return that of ``episodes``."""
        self.estimate = self.estimator.estimate()
        if self._checks_estimates:
            self.estimator.check_estimate(self.estimate)
        return self.estimate.at(episodes)

    def _score(self, episodes: IntArray, estimate: Estimate) -> FloatArray:
        """Compare estimates of ``episodes`` with the truth; return the rewards, shape (k,)."""
        n, truth = self.interface.queries.n_mainline, self.truth(episodes)
        true_density, true_speed = truth[:, :n, 0], truth[:, :n, 1]
        error = estimation_error(
            true_density, true_speed, estimate.density[:, :n], estimate.speed[:, :n]
        )
        self.error.density[episodes] = error.density
        self.error.speed[episodes] = error.speed
        self.error.n_occupied[episodes] = error.n_occupied
        rewards: FloatArray = self.interface.reward(
            ScoredSecond(
                error, true_density, true_speed, estimate, self.queried.take(episodes, 0),
                self.config.corridor,
            )
        )  # fmt: skip
        return rewards

    def truth(self, episodes: IntArray) -> FloatArray:
        """Return the present true (density [veh/km], speed [km/h]) of ``episodes``, (k, S, 2)."""
        return self.traffic.aggregates(self.traffic_index[episodes], self.time[episodes])

    def observe(self, episodes: IntArray) -> Observation:
        """Return the present observations of ``episodes``, shape (k, size)."""
        return self._observed(episodes, self.estimate.at(episodes))

    def _observed(self, episodes: IntArray, estimate: Estimate) -> Observation:
        public, readings, reading_age = self.release.public(episodes), None, None
        if self.loops is not None:
            times = self.time[episodes]
            readings = self.loops.last(self.traffic_index[episodes], times)
            reading_age = times % self.loops.interval / self.loops.interval
        state = PublicState(
            estimate=estimate,
            released=self.released.take(episodes, 0),
            innovations=self.estimator.innovations.take(episodes, 0),
            age=self.age.take(episodes, 0),
            queried=self.queried.take(episodes, 0),
            picked=self.pending.picked.take(episodes, 0),
            prices=public.get("prices"),
            spent_share=public.get("spent_share"),
            readings=readings,
            reading_age=reading_age,
        )
        return self.interface.observations.encode(state)

    def privacy(self) -> dict[str, Any]:
        """Return the privacy report of the parts in force, as plain JSON."""
        return complete_report(self.config, self.release, self.boundary).to_dict()

    def info(self, episode: int) -> dict[str, Any]:
        """Return the info of one episode, in plain numbers."""
        return info_of(self.infos(np.array([episode])), 0)

    def infos(self, episodes: IntArray) -> Infos:
        """Return the infos of ``episodes``, shape (k,): fresh arrays.

        The keys in `TRUTH_INFO` come from the true traffic, or name its record. They serve training
        and evaluation, as the reward does, and are not covered by the guarantee. The others are
        public.
        """
        mu, epsilon = self.release.spent(episodes, self.elapsed[episodes])
        infos: Infos = {
            "rmse_density": self.error.density[episodes],
            "rmse_speed": self.error.speed[episodes],
            "n_occupied": self.error.n_occupied[episodes].astype(np.float64),
            "traffic_seed": self._seeds[self.traffic_index[episodes]],
            "n_dropped": self.n_dropped[episodes].astype(np.float64),
            "diverged": self.estimator.diverged[episodes].astype(np.float64),
            "fallback": self.estimator.fallback[episodes].astype(np.float64),
            "spent_mu": mu,
            "spent_epsilon": epsilon,
            "queried": self.queried.take(episodes, 0),
            **self.release.public(episodes),
        }
        if self.config.truth_in_info:
            truth = self.truth(episodes)
            infos["true_density"] = truth[:, :, 0].copy()
            infos["true_speed"] = truth[:, :, 1].copy()
            infos["time"] = self.time[episodes].astype(np.float64)
        return infos


def _seed_of(generator: np.random.Generator) -> np.random.SeedSequence:
    """Return a seed of 128 bits from a generator."""
    return np.random.SeedSequence(generator.integers(2**32, size=4, dtype=np.uint32).tolist())


RESET_OPTIONS = ("traffic_seed", "start")


def checked_options(
    options: Mapping[str, Any] | None, config: EnvConfig, n_episodes: int
) -> list[tuple[int | None, int | None]]:
    """Return the traffic seed and first second that ``options`` fix in each of k episodes.

    Each option is one value for all episodes, or one for each; None fixes nothing.

    Raises:
        ValueError: A key is unknown, a value out of range, or there are too many or too few.
    """
    options = options or {}
    for key in options:
        if key not in RESET_OPTIONS:
            raise ValueError(f"options.{key} is unknown; allowed: {', '.join(RESET_OPTIONS)}")
    seeds, starts = (per_episode(key, options.get(key), n_episodes) for key in RESET_OPTIONS)
    known, last = config.traffic_seeds, config.last_start
    for seed in seeds:
        if seed is not None and (type(seed) is not int or seed not in known):
            raise ValueError(
                f"options.traffic_seed must be one of the environment's "
                f"{len(known)} traffic_seeds, got {shown(seed)}"
            )
    for start in starts:
        if start is not None and (type(start) is not int or not 0 <= start <= last):
            raise ValueError(f"options.start must be an integer in 0..{last}, got {shown(start)}")
    return list(zip(seeds, starts, strict=True))


def draw_traffic(
    fixed: Sequence[tuple[int | None, int | None]],
    config: EnvConfig,
    generators: Sequence[np.random.Generator],
) -> tuple[IntArray, IntArray]:
    """Return traffic indices and first seconds of k episodes, drawn where they are not fixed.

    Both are always drawn, so that fixing one does not change the other.
    """
    traffic = np.empty(len(fixed), dtype=np.int64)
    starts = np.empty(len(fixed), dtype=np.int64)
    for k, ((seed, start), generator) in enumerate(zip(fixed, generators, strict=True)):
        index = int(generator.integers(len(config.traffic_seeds)))
        drawn = int(generator.integers(config.last_start + 1))
        traffic[k] = index if seed is None else config.traffic_seeds.index(seed)
        starts[k] = start if start is not None else drawn if config.random_start else 0
    return traffic, starts


def per_episode(name: str, value: Any, n_episodes: int) -> list[Any]:
    """Return the values of option ``name``, one per episode, given one for all or one for each.

    numpy's integers come back as Python's.

    Raises:
        ValueError: There are too many or too few.
    """
    if not isinstance(value, list | tuple | np.ndarray) or np.ndim(value) == 0:
        values = [value] * n_episodes
    elif len(value) != n_episodes:
        raise ValueError(
            f"options.{name} must be one value or {n_episodes}, one per episode, got {len(value)}"
        )
    else:
        values = list(value)
    return [value.item() if isinstance(value, np.integer) else value for value in values]

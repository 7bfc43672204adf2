"""One step of the decision process, for a batch of episodes. The only place where it is written."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dptse_env.arrays import Action, BoolArray, FloatArray, IntArray, Observation
from dptse_env.blocks import Blocks
from dptse_env.boundary import make_boundary
from dptse_env.config import EnvConfig
from dptse_env.estimators import make_estimator
from dptse_env.infos import Rows, as_objects, row_of
from dptse_env.interface import QueryInterface
from dptse_env.observations import AGE_CAP, Knowledge
from dptse_env.options import ResetOptions
from dptse_env.prior import nominal_state
from dptse_env.privacy import GaussianMechanism, Mechanism, noise_std
from dptse_env.rewards import EstimationError, estimation_error
from dptse_env.sensing import Sensing, make_answers
from dptse_env.traffic import RecordLibrary

TRUTH_INFO = ("rmse_density", "rmse_speed", "n_occupied", "truth")
"""Keys of ``info`` that come from the true traffic."""


@dataclass(frozen=True)
class Outcome:
    """What a step or a reset gives back for k episodes.

    Attributes:
        observation: Shape (k, size).
        reward: Shape (k,); zero while a sequential decision is not complete.
        truncated: Whether the horizon is reached, shape (k,).
    """

    observation: Observation
    reward: FloatArray
    truncated: BoolArray


class QueryProcess:
    """The decision process: traffic moves by itself, a policy picks whom to ask.

    Queries never change the traffic, so an episode replays a record of SUMO. Every array has a
    leading axis over the episodes; ``episodes`` names the k of them that a call concerns.

    Attributes:
        config: The configuration.
        interface: Encodings of actions, observations and reward.
        n_episodes: Size of the batch.
        time: Second of the record that each episode stands at, shape (n,).
        slot: Index into ``config.traffic_seeds`` of each episode's traffic, shape (n,).
        queried: The last query of each episode, shape (n, n_mainline).
        boundary: What the estimator is told of the road's surroundings.
        answers: What the observed segments answer before noise is added.
        estimate: The present estimates, arrays of shape (n, S).
        error: Their error, arrays of shape (n,).
    """

    def __init__(
        self,
        config: EnvConfig,
        interface: QueryInterface,
        n_episodes: int,
        library: RecordLibrary | None = None,
        threads: int | None = 1,
    ) -> None:
        """Assemble the rooms; nothing is recorded or loaded before `reset`.

        Args:
            config: The configuration.
            interface: The interface made of the same configuration.
            n_episodes: Size of the batch n.
            library: Where records come from; the user's cache if None.
            threads: Threads that the estimators of a large batch may use; None for one per core.
        """
        corridor = config.corridor
        n, s = n_episodes, corridor.n_segments
        self.config, self.interface, self.n_episodes = config, interface, n
        self.model = config.model()
        self.sensing = Sensing(corridor, config.traffic_seeds, library or RecordLibrary())
        self.accountant = config.accountant()
        self.boundary = make_boundary(config.privacy.boundary, self.sensing, self.model, n)
        columns = s + self.boundary.n_released
        self.answers = make_answers(config.privacy, self.sensing, columns, n)
        self.mechanism: Mechanism = GaussianMechanism(
            noise_std(config.privacy, config.sensitivity()), n_episodes=n, n_segments=columns
        )
        self.estimator = make_estimator(
            config.estimator, config.backend, self.model, n, config.settings()
        )
        self._blocks = Blocks(threads if self.estimator.is_compiled else 1)
        interface.actions.start(n)
        self._observed_always = np.zeros(columns, dtype=bool)
        self._observed_always[[*corridor.fixed_sensors, *range(s, columns)]] = True
        self.slot = np.zeros(n, dtype=np.int64)
        self.time = np.zeros(n, dtype=np.int64)
        self.end = np.zeros(n, dtype=np.int64)
        self.queried = np.zeros((n, corridor.n_mainline), dtype=bool)
        self.n_dropped = np.zeros(n, dtype=np.int64)
        self.age = np.zeros((n, corridor.n_mainline), dtype=np.int64)
        self.released = np.zeros((n, s, 2))
        self.estimate = self.estimator.estimate()
        self.error = EstimationError(np.zeros(n), np.zeros(n), np.zeros(n, dtype=np.int64))
        self._is_fork = False

    def fork(self) -> QueryProcess:
        """Return a process in the same state that goes its own way, streams of noise included.

        For looking ahead: a fork that is stepped like its origin gives the same bits, and the
        origin never notices. It shares traffic and model, begins no episodes, and takes some 40 us
        an episode to make.
        """
        interface = self.interface
        shared = (
            self.config, self.model, self.sensing, self.accountant, self._blocks,
            interface.observations, interface.reward, interface.actions.space,
            *self.boundary.tables, *self.answers.tables,
        )  # fmt: skip
        fork = copy.deepcopy(self, {id(one): one for one in shared})
        fork._is_fork = True
        return fork

    def reset(
        self,
        episodes: IntArray,
        generators: Sequence[np.random.Generator],
        options: Mapping[str, Any] | None = None,
    ) -> Outcome:
        """Begin new episodes.

        Args:
            episodes: Which episodes, shape (k,).
            generators: One generator per episode; each gives a seed for the traffic, the noise and
                the estimator, whatever else is configured.
            options: ``traffic_seed`` fixes the traffic (one of ``config.traffic_seeds``) and
                ``start`` the first second of the record; each one value, or k of them.

        Raises:
            ValueError: An option is unknown or out of range.
            RecordingError: SUMO could not make a record.
            RuntimeError: This is a fork.
        """
        if self._is_fork:
            raise RuntimeError("a fork only goes on: reset the process that it was made of")
        choice = ResetOptions.of(options, self.config, len(episodes))
        streams = [
            [np.random.default_rng(seed) for seed in generator.integers(2**63, size=3)]
            for generator in generators
        ]
        slots, starts = choice.draw([traffic for traffic, _, _ in streams])
        self._load(slots)
        self.slot[episodes], self.time[episodes] = slots, starts
        self.end[episodes] = starts + self.config.horizon_steps
        self.interface.actions.reset(episodes)
        self.mechanism.reset(episodes, [noise for _, noise, _ in streams])
        self.answers.reset(episodes)
        self.boundary.reset(episodes)
        prior = nominal_state(self.config.corridor, self.model, self.time[episodes])
        self.estimator.reset(episodes, prior, [own for _, _, own in streams])
        self.queried[episodes] = False
        self.n_dropped[episodes] = 0
        self.age[episodes] = AGE_CAP
        self.released[episodes] = 0.0
        self._score(episodes, self.truth(episodes))
        return self._outcome(episodes, np.zeros(len(episodes)))

    def step(self, episodes: IntArray, actions: Action) -> Outcome:
        """Carry out one action in each of ``episodes``.

        Args:
            episodes: Which episodes, shape (k,).
            actions: Their actions, shape (k, *action space).

        Raises:
            ValueError: An action has a wrong shape, dtype or value.
        """
        decision = self.interface.actions.decode(episodes, actions)
        ready = decision.complete
        self.n_dropped[episodes] = decision.n_dropped
        reward = np.zeros(len(episodes))
        if ready.any():
            reward[ready] = self._advance(episodes[ready], decision.queried[ready])
        return self._outcome(episodes, reward)

    @property
    def elapsed(self) -> IntArray:
        """Seconds since each episode began, shape (n,)."""
        return self.time - self.end + self.config.horizon_steps

    @property
    def over(self) -> BoolArray:
        """Whether each episode is at its end, or was never begun, shape (n,)."""
        return self.time >= self.end

    def _advance(self, episodes: IntArray, queried: BoolArray) -> FloatArray:
        """Let one second pass: sense, release, estimate, score."""
        observed = np.tile(self._observed_always, (len(episodes), 1))
        observed[:, : queried.shape[1]] |= queried
        slots, n_segments = self.slot[episodes], self.config.corridor.n_segments
        inputs = self.boundary.inputs(episodes, slots, self.time[episodes])
        self.time[episodes] += 1
        answers = self.answers.collect(episodes, slots, self.time[episodes], observed)
        released = self.mechanism.release(episodes, answers)
        self.boundary.take_in(episodes, released[:, n_segments:])
        observed, released = observed[:, :n_segments], released[:, :n_segments]
        self._estimate(episodes, inputs, observed, released)
        self._remember(episodes, queried, observed, released)
        return self._score(episodes, self.truth(episodes))

    def _estimate(
        self, episodes: IntArray, inputs: FloatArray, observed: BoolArray, released: FloatArray
    ) -> None:
        """Let the estimators predict and update, several blocks of episodes at once."""

        def work(rows: slice) -> None:
            block = episodes[rows]
            self.estimator.predict(block, inputs[rows])
            self.estimator.update(block, observed[rows], released[rows], self.mechanism.sigma)

        self._blocks.run(len(episodes), work)

    def _remember(
        self, episodes: IntArray, queried: BoolArray, observed: BoolArray, released: FloatArray
    ) -> None:
        self.queried[episodes] = queried
        self.released[episodes] = np.where(observed[:, :, None], released, self.released[episodes])
        self.age[episodes] = np.where(observed[:, : queried.shape[1]], 0, self.age[episodes] + 1)

    def _score(self, episodes: IntArray, truth: FloatArray) -> FloatArray:
        """Compare the present estimates with the truth (k, S, 2); return the rewards."""
        n = self.interface.n_mainline
        self.estimate = self.estimator.estimate()
        error = estimation_error(
            truth[:, :n, 0],
            truth[:, :n, 1],
            self.estimate.density[episodes, :n],
            self.estimate.speed[episodes, :n],
        )
        self.error.density[episodes] = error.density
        self.error.speed[episodes] = error.speed
        self.error.n_occupied[episodes] = error.n_occupied
        return self.interface.reward.value(error)

    def truth(self, episodes: IntArray) -> FloatArray:
        """Return the present true (density [veh/km], speed [km/h]) of ``episodes``, (k, S, 2)."""
        return self.sensing.aggregates(self.slot[episodes], self.time[episodes])

    def _load(self, slots: IntArray) -> None:
        """Make sure that the traffic of ``slots`` is in memory, in every form that is needed."""
        for slot in self.sensing.load(slots):
            self.answers.load(slot)
            self.boundary.load(slot)

    def _outcome(self, episodes: IntArray, reward: FloatArray) -> Outcome:
        knowledge = Knowledge(
            estimate=self.estimate.at(episodes),
            released=self.released[episodes],
            innovations=self.estimator.innovations[episodes],
            age=self.age[episodes],
            queried=self.queried[episodes],
            picked=self.interface.actions.picked[episodes],
        )
        observation = self.interface.observations.encode(knowledge)
        return Outcome(observation, reward, self.over[episodes])

    def info(self, episode: int) -> dict[str, Any]:
        """Return what is said about one episode beside its observation, in plain numbers."""
        return row_of(self.infos(np.array([episode])), 0)

    def infos(self, episodes: IntArray) -> Rows:
        """Return what is said about ``episodes``, shape (k,): fresh arrays of k rows each.

        The keys in `TRUTH_INFO` come from the true traffic. They are training and evaluation
        signals like the reward, never a release.
        """
        mu, epsilon = self.accountant.spent(self.elapsed[episodes])
        infos: Rows = {
            "rmse_density": self.error.density[episodes],
            "rmse_speed": self.error.speed[episodes],
            "n_occupied": self.error.n_occupied[episodes].astype(np.float64),
            "n_dropped": self.n_dropped[episodes].astype(np.float64),
            "diverged": self.estimator.diverged[episodes].astype(np.float64),
            "fallback": self.estimator.fallback[episodes].astype(np.float64),
            "mu": mu,
            "epsilon": epsilon,
            "queried": self.queried[episodes],
        }
        if self.config.truth_in_info:
            infos["truth"] = self._truth_infos(episodes)
        return infos

    def _truth_infos(self, episodes: IntArray) -> Rows:
        truth, slots = self.truth(episodes), self.slot[episodes]
        infos: Rows = {
            "density": truth[:, :, 0].copy(),
            "speed": truth[:, :, 1].copy(),
            "traffic_seed": np.array(self.config.traffic_seeds)[slots],
            "time": self.time[episodes],
        }
        counted = self.answers.contributions
        if counted is not None:
            exposures = [counted.of_episode(e, s) for e, s in zip(episodes, slots, strict=True)]
            # A vehicle that has counted k times has spent what one of cap k has in all.
            individual = [self.accountant.spent(steps)[1].tolist() for steps in exposures]
            # Lists, since records differ in their number of vehicles and Gymnasium stacks arrays
            # of equal shape only.
            infos["exposures"] = as_objects([steps.tolist() for steps in exposures])
            infos["individual_epsilon"] = as_objects(individual)
        return infos

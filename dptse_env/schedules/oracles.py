"""Oracles: schedules that use the true traffic, as bounds on policies."""

import copy
from abc import abstractmethod
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import ClassVar

import numpy as np

from dptse_env.estimators import Estimator
from dptse_env.process import QueryProcess
from dptse_env.release import MeasuredRows, ReleaseRequest
from dptse_env.schedules.base import ProcessSchedule, require_plain
from dptse_env.spaces.rewards import ScoredSecond, estimation_error
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray, Observation

MOST_SETS = 1_000
"""Largest number of sets that the brute force tries in a step."""


class OracleError(ProcessSchedule):
    """The segments with the largest errors of the present estimate, in the reward's metric.

    The squared error is ``((rho_est - rho) / rho_0)^2 + m ((v_est - v) / v_0)^2`` with the
    reward's scales and m = 1 where there is a vehicle, else 0; for a reward of one term, that
    term alone. A step sorts the segments once.
    """

    name: ClassVar[str] = "oracle-error"
    uses_truth: ClassVar[bool] = True

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        process, n = self.process, self.n_mainline
        corridor, term = process.config.corridor, self.interface.reward.term
        truth, estimate = process.truth(rows)[:, :n], process.estimate.at(rows)
        error = np.zeros((len(rows), n))
        if term != "speed":
            error += ((estimate.density[:, :n] - truth[..., 0]) / corridor.density_scale) ** 2
        if term != "density":
            speed = ((estimate.speed[:, :n] - truth[..., 1]) / corridor.speed_scale) ** 2
            error += np.where(truth[..., 0] > 0.0, speed, 0.0)
        return self.highest(error, step)


@dataclass(frozen=True)
class _NextSecond:
    """Truth, measurements and estimator of the coming second of k episodes."""

    episodes: IntArray
    truth: FloatArray
    answered: BoolArray
    measured: MeasuredRows
    estimator: Estimator


class _Realised(ProcessSchedule):
    """Evaluates updates of the coming second with the true values and the actual noise.

    It works on copies: noise, contributions and estimator of the process are unchanged, so an
    episode has the same noise as under any other policy.
    """

    uses_truth: ClassVar[bool] = True
    without_noise: ClassVar[bool] = False
    """True where releases are tried without their noise, which no policy can know."""

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: Options are not the mainline segments, or the schedule needs to set the
                noise of a release model that does not let it.
        """
        super().__init__(process, seed)
        require_plain(process.interface, self.name)
        if self.without_noise and not process.release.takes_noise:
            raise ValueError(
                f"schedule {self.name!r} needs a release model whose noise can be set, got "
                f"{process.release.setup.name!r}"
            )

    def _choose(self, rows: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        chosen = np.zeros((len(rows), self.n_mainline), dtype=bool)
        chosen[:, : self.bandwidth] = True  # an episode that is over has no coming second
        live = ~self.process.over[rows]
        if live.any():
            chosen[live] = self._best(self._look(rows[live]))
        return chosen

    @abstractmethod
    def _best(self, coming: _NextSecond) -> BoolArray:
        """Return the sets of segments, shape (k, n_mainline)."""

    def _look(self, episodes: IntArray) -> _NextSecond:
        ahead = self.process.fork()
        traffic, times = ahead.traffic_index[episodes], ahead.time[episodes]
        ahead.estimator.predict(episodes, ahead.boundary.inputs(episodes, traffic, times))
        all_columns = np.ones((len(episodes), ahead.release.setup.n_columns), dtype=bool)
        if self.without_noise:
            ahead.release.give_noise(np.zeros((ahead.n_episodes, all_columns.shape[1], 2)))
        request = ReleaseRequest(
            episodes,
            traffic,
            times + 1,
            all_columns,
            lambda: ahead.estimator.estimate().at(episodes),
        )
        answered, measured, _ = ahead.measure(request)
        truth = ahead.traffic.aggregates(traffic, times + 1)
        return _NextSecond(episodes, truth, answered, measured, ahead.estimator)

    def _reward(self, coming: _NextSecond, queried: BoolArray) -> FloatArray:
        """Return the rewards (k,) of querying ``queried`` (k, n_mainline)."""
        process, n, episodes = self.process, self.n_mainline, coming.episodes
        observed = process.release.setup.observed(queried)[:, : process.model.rows.n_rows]
        estimator = _copied(coming.estimator)
        estimator.update(episodes, observed & coming.answered, *coming.measured)
        estimate, truth = estimator.estimate().at(episodes), coming.truth[:, :n]
        density, speed = truth[..., 0], truth[..., 1]
        error = estimation_error(density, speed, estimate.density[:, :n], estimate.speed[:, :n])
        rewards: FloatArray = self.interface.reward(
            ScoredSecond(error, density, speed, estimate, queried, process.config.corridor)
        )
        return rewards


class OracleGain(_Realised):
    """The segments whose query alone would increase the reward most if it had no noise.

    The reward is that of the coming second, with the truth, and each segment is tried by itself. It
    knows what a query is worth but not what its noise will do, as the best policy would. That
    takes n updates of the estimator per step.
    """

    name: ClassVar[str] = "oracle-gain"
    without_noise: ClassVar[bool] = True

    def _best(self, coming: _NextSecond) -> BoolArray:
        every = np.arange(self.n_mainline)
        rewards = [
            self._reward(coming, np.tile(every == segment, (len(coming.episodes), 1)))
            for segment in every
        ]
        order = np.argsort(-np.stack(rewards, axis=1), axis=1, kind="stable")
        return self.mask(order[:, : self.bandwidth])


class OracleGreedy(_Realised):
    """Segments chosen in turn, each the one that increases the realised reward most.

    The reward is that of the coming second after an update by the set so far, with truth and
    noise. B segments are chosen, even where some reduce the reward. That takes about B n updates of
    the estimator per step, 70 times the time of the environment at B = 5, n = 15.
    """

    name: ClassVar[str] = "oracle-greedy"

    def _best(self, coming: _NextSecond) -> BoolArray:
        k = len(coming.episodes)
        queried = np.zeros((k, self.n_mainline), dtype=bool)
        every = np.arange(k)
        for _ in range(self.bandwidth):
            rewards = np.empty((k, self.n_mainline))
            for segment in range(self.n_mainline):
                tried = queried.copy()
                tried[:, segment] = True
                rewards[:, segment] = self._reward(coming, tried)
            rewards[queried] = -np.inf
            queried[every, np.argmax(rewards, axis=1)] = True
        return queried


class OracleBruteForce(_Realised):
    """The set of B segments with the largest realised reward of the coming second.

    It takes n over B updates of the estimator per step: 455 at B = 3, n = 15.
    """

    name: ClassVar[str] = "oracle-brute-force"

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: There are more than `MOST_SETS` sets, or options are not the mainline
                segments.
        """
        super().__init__(process, seed)
        n_sets = comb(self.n_mainline, self.bandwidth)
        if n_sets > MOST_SETS:
            raise ValueError(
                f"schedule {self.name!r} tries at most {MOST_SETS} sets a step, bandwidth "
                f"{self.bandwidth} of {self.n_mainline} segments has {n_sets}; use "
                f"{OracleGreedy.name!r}"
            )

    def _best(self, coming: _NextSecond) -> BoolArray:
        k = len(coming.episodes)
        best, queried = np.full(k, -np.inf), np.zeros((k, self.n_mainline), dtype=bool)
        for chosen in combinations(range(self.n_mainline), self.bandwidth):
            tried = self.mask(np.tile(chosen, (k, 1)))
            reward = self._reward(coming, tried)
            better = reward > best
            best[better], queried[better] = reward[better], tried[better]
        return queried


def _copied(estimator: Estimator) -> Estimator:
    """Return a copy of an estimator with its own state and streams, sharing the model."""
    model = getattr(estimator, "model", None)
    return copy.deepcopy(estimator, {id(model): model})

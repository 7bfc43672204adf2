"""Oracles: schedules that use the true traffic, as bounds on policies."""

import copy
from typing import ClassVar

import numpy as np

from dptse_env.process import QueryProcess
from dptse_env.release import Request
from dptse_env.schedules import ProcessSchedule, require_plain
from dptse_env.spaces.rewards import ScoredSecond, estimation_error
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray, Observation


class OracleError(ProcessSchedule):
    """The segments with the largest errors of the present estimate, in the reward's metric.

    The squared error is ``((rho_est - rho) / rho_0)^2 + m ((v_est - v) / v_0)^2`` with the
    reward's scales and m = 1 where there is a vehicle, else 0; for a reward of one term, that
    term alone. A step sorts the segments once.
    """

    name: ClassVar[str] = "oracle-error"
    uses_truth: ClassVar[bool] = True

    def _choose(self, episodes: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        process, n = self.process, self.n_mainline
        corridor, term = process.config.corridor, self.interface.reward.term
        truth, estimate = process.truth(episodes)[:, :n], process.estimate.at(episodes)
        error = np.zeros((len(episodes), n))
        if term != "speed":
            error += (
                (estimate.density[:, :n] - truth[..., 0]) / corridor.scales.density_scale
            ) ** 2
        if term != "density":
            speed = ((estimate.speed[:, :n] - truth[..., 1]) / corridor.scales.speed_scale) ** 2
            error += np.where(truth[..., 0] > 0.0, speed, 0.0)
        return self.highest(error, step)


class OracleGain(ProcessSchedule):
    """The segments whose query alone would increase the reward most if it had no noise.

    The reward is that of the coming second, with the truth, and each segment is tried by itself. It
    knows what a query is worth but not what its noise will do, as the best policy would. That
    takes n updates of the estimator per step. It works on copies, so that an episode has the same
    noise as under any other policy.
    """

    name: ClassVar[str] = "oracle-gain"
    uses_truth: ClassVar[bool] = True

    def __init__(self, process: QueryProcess, seed: int | None = None) -> None:
        """Bind the schedule.

        Raises:
            ValueError: Queries are not the mainline segments, or the noise of the release model
                cannot be set.
        """
        super().__init__(process, seed)
        require_plain(process.interface, self.name)
        if not process.release.takes_noise:
            raise ValueError(
                f"schedule {self.name!r} needs a release model whose noise can be set, got "
                f"{process.release.task.name!r}"
            )

    def _choose(self, episodes: IntArray, step: IntArray, observation: Observation) -> BoolArray:
        # An episode that is over has no next second.
        value = np.zeros((len(episodes), self.n_mainline))
        live = ~self.process.over[episodes]
        if live.any():
            value[live] = self._rewards(episodes[live])
        return self.first_that_fit(np.argsort(-value, axis=1, kind="stable"))

    def _rewards(self, episodes: IntArray) -> FloatArray:
        """Return the rewards of querying each segment by itself, shape (k, n_mainline)."""
        ahead, n = self.process.fork(), self.n_mainline
        traffic, times = ahead.traffic_index[episodes], ahead.time[episodes]
        inputs = ahead.boundary.inputs(episodes, traffic, times)
        ahead.estimator.predict(episodes, inputs)
        every_column = np.ones((len(episodes), ahead.release.task.n_channels), dtype=bool)
        ahead.release.give_noise(np.zeros((ahead.n_episodes, every_column.shape[1], 2)))
        prediction = ahead.estimator.estimate().at(episodes)
        request = Request(episodes, traffic, times + 1, every_column, lambda: prediction)
        measured = ahead.measure(request)
        truth = ahead.traffic.aggregates(traffic, times + 1)[:, :n]
        density, speed = truth[..., 0], truth[..., 1]
        shared = [ahead.estimator.model, *(ahead.rewind.shared if ahead.rewind else ())]
        rewards = np.empty((len(episodes), n))
        for segment in range(n):
            queried = np.zeros((len(episodes), n), dtype=bool)
            queried[:, segment] = True
            seen = ahead.release.task.observed(queried) & measured.observed
            estimator, rewind = copy.deepcopy(
                (ahead.estimator, ahead.rewind), {id(part): part for part in shared}
            )
            given = measured._replace(observed=seen)
            estimator.update(episodes, given)
            if rewind is not None:
                rewind.follow(episodes, traffic, times + 1, inputs, given)
            estimate = estimator.estimate().at(episodes)
            error = estimation_error(density, speed, estimate.density[:, :n], estimate.speed[:, :n])
            rewards[:, segment] = self.interface.reward(
                ScoredSecond(error, density, speed, estimate, queried, ahead.config.corridor)
            )
        return rewards

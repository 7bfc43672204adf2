"""Regression of the estimate's squared errors: a scorer learns where the estimate is wrong.

The estimator's own variance is a poor predictor of its error: process noise is tuned for the
accuracy of estimates, and a jam that has not been observed yet is in no variance. In training the
true traffic is known, so the error that is expected given an observation can be learned by
regression, with orders of magnitude less data than PPO needs: every segment of every second is a
sample. Querying the segments where it is largest comes close to querying by the true error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from agents.training.settings import Regression
from dptse_env.process import QueryProcess
from dptse_env.sb3 import RoadPolicy, SB3VecEnv
from dptse_env.utils.arrays import FloatArray, Observation
from dptse_env.utils.progress import make_bar

FLOOR = 1e-4
"""Added to squared errors: below an error of a hundredth, differences do not matter."""

RULE = {"density_log_std": 2.8, "speed_log_std": 1.2, "age": 7.2}
"""Weights of the scores in the first round: a policy that has learned nothing queries segments
whose estimate is uncertain or that have not been observed for long."""

VARIANCE = {"density_log_std": 0.5, "speed_log_std": 0.5, "age": 0.1}
"""Initial weights of the fit: logarithms of squared errors near the estimator's own variances."""

LEVEL = -3.0
"""Initial constant of these logarithms."""

DECAY = 0.95
"""Fraction by which the learning rate has fallen at the end."""


def squared_errors(process: QueryProcess) -> Observation:
    """Return the squared error of the estimate in every mainline segment, shape (n, n_mainline).

    Density and speed count together, in units of the corridor's scales. The speed of an empty
    segment does not count.
    """
    corridor, n = process.config.corridor, process.interface.queries.n_mainline
    truth, estimate = process.truth(np.arange(process.n_episodes))[:, :n], process.estimate
    density = (estimate.density[:, :n] - truth[..., 0]) / corridor.scales.density_scale
    speed = (estimate.speed[:, :n] - truth[..., 1]) / corridor.scales.speed_scale
    squared: FloatArray = density**2 + np.where(truth[..., 0] > 0, speed, 0.0) ** 2
    return squared.astype(np.float32)


class Practice:
    """Episodes in which a policy acts, and the samples that they leave.

    Attributes:
        policy: The policy.
        batch_size: Samples in a minibatch.
        seen: Observations so far, each (n, size).
        errors: Squared errors of the same seconds, each (n, n_mainline).
    """

    def __init__(self, policy: RoadPolicy, episodes: SB3VecEnv, batch_size: int) -> None:
        """Begin the episodes."""
        self.policy, self.batch_size = policy, batch_size
        self.seen: list[Tensor] = []
        self.errors: list[Tensor] = []
        self._episodes, self._observation = episodes, episodes.reset()

    def collect(self, settings: Regression) -> None:
        """Act for a round, and keep what is seen and the squared errors."""
        for second in range(settings.seconds):
            if second % settings.interval == 0:
                self.seen.append(torch.from_numpy(self._observation.copy()))
                self.errors.append(torch.from_numpy(squared_errors(self._episodes.env.process)))
            actions, _ = self.policy.predict(self._observation, deterministic=False)
            stepped, *_ = self._episodes.step(actions)
            self._observation = np.asarray(stepped)

    def loss(self, seen: Tensor, errors: Tensor, level: Tensor, sharpness: float) -> Tensor:
        """Return the loss of a random minibatch of samples (k, size) and (k, n)."""
        rows = torch.randint(len(seen), (self.batch_size,))
        logs = self.policy.scores(seen[rows]) / sharpness + level
        return ((errors[rows] + FLOOR) * torch.exp(-logs) + logs).mean()


def regress(practice: Sequence[Practice], settings: Regression) -> None:
    """Let policies act, and fit their common scores in place to the squared errors that follow.

    With the expected squared error exp(z) of a segment, the loss y exp(-z) + z is that of normal
    errors with this variance; it is least where exp(z) is the mean of y. Scores are ``sharpness``
    times z plus a bonus for age, since querying segments that have not been observed for long gains
    more, up to a constant. Each round aggregates data collected by the current policy, as in
    DAgger. Minibatches are of one environment after the other.

    Args:
        practice: Policies that share a scorer, each in an environment of its own.
        settings: Of the regression.
    """
    policy, bonus = practice[0].policy, {"age": settings.age_bonus}
    levels = torch.full((len(practice),), LEVEL, requires_grad=True)
    optimizer = torch.optim.Adam([*policy.scorer.parameters(), levels], lr=settings.rate)
    batches = settings.batches * len(practice)
    _add(policy, RULE, 1.0)
    with make_bar(batches * settings.rounds, desc="regression", unit="batch", leave=False) as bar:
        for index in range(settings.rounds):
            for each in practice:
                each.collect(settings)
            if index:
                _add(policy, bonus, -settings.sharpness)
            else:
                _add(policy, RULE, -1.0)
                _add(policy, VARIANCE, settings.sharpness)
            samples = [(torch.cat(each.seen), torch.cat(each.errors)) for each in practice]
            for batch in range(batches):
                done = (index + batch / batches) / settings.rounds
                optimizer.param_groups[0]["lr"] = settings.rate * (1.0 - DECAY * done)
                k = batch % len(practice)
                loss = practice[k].loss(*samples[k], levels[k], settings.sharpness)
                optimizer.zero_grad()
                torch.autograd.backward(loss)
                torch.nn.utils.clip_grad_norm_(policy.scorer.parameters(), settings.max_grad_norm)
                optimizer.step()
                bar.update()
            _add(policy, bonus, settings.sharpness)
    policy.scorer.zero_grad()


def _add(policy: RoadPolicy, weights: Mapping[str, float], factor: float) -> None:
    """Add multiples of ``weights`` to the weights of the rule."""
    with torch.no_grad():
        for name, weight in weights.items():
            policy.scorer.rule.weight[0, policy.road.index(name)] += factor * weight

"""Policy iteration with measured swaps: scores move in proportion to the gains of swaps.

**Measured.** The gain of a swap is by how much an episode's error falls when a queried segment is
swapped for another. It is measured on paired forks of an episode: they start in the same second
with the same estimator and the same traffic, and make the same queries, except that a segment of
the first query is swapped in one of them. The difference of their errors over the next seconds
therefore comes from that swap alone. The policy does not react to a swap: near an optimum, its
reaction is worth little.

Noise would drown the difference. In the first query it is therefore plus or minus sigma, which
matches the moments of the Gaussian up to the third, and every fork is run with either sign
(antithetic noise), which cancels all that is odd in it; in later seconds the noise is that of the
episode. The standard deviation of a measured gain is a third of that with Gaussian noise of one
sign.

**Learned.** The gain of swapping segment j for segment i is learned as a difference g_i - g_j of a
number per segment, by least squares. Scores move by a small multiple of g, which is a step of
mirror descent on the distribution over sets (its weights exp(score) are multiplied by
exp(step g)); then gains are measured anew, under the new policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from agents.seeds import training_seed
from agents.training.settings import SwapRounds
from dptse_env.evaluation import WARM_UP, Policy
from dptse_env.process import QueryProcess
from dptse_env.sb3 import RoadPolicy
from dptse_env.utils.arrays import Action, AnyArray, FloatArray, IntArray, Observation
from dptse_env.utils.progress import make_bar
from dptse_env.vector_env import SensorQueryVectorEnv

LARGEST_GAIN = 0.6
"""Clips gains [mean one-second errors]: outliers would dominate the least-squares fit."""

PART = 4096
"""Observations scored at a time."""

SEED_STRIDE = 10_000
"""Between the seeds of two rounds; the first begins a stride after those of the regression."""


@dataclass(frozen=True)
class Swaps:
    """Gains of k swaps that were tried in m states.

    Attributes:
        observations: Of the states, shape (m, size).
        error: Mean one-second error, minus the reward, over the seconds after a state, shape (m,).
        state: Index of the state in which each swap was tried, shape (k,).
        added: Query that was made, shape (k,).
        dropped: Query that was made without the swap, shape (k,).
        gain: Decrease of the summed error over these seconds due to the swap, shape (k,).
        spent: Increase of the budgets that vehicles spend in them, shape (k,); zero where they
            have none.
    """

    observations: Observation
    error: FloatArray
    state: IntArray
    added: IntArray
    dropped: IntArray
    gain: FloatArray
    spent: FloatArray


def first_second(horizon: int) -> int:
    """Return the earliest second of an episode of ``horizon`` seconds in which swaps are tried."""
    return min(WARM_UP, horizon // 4)


def try_swaps(
    policy: Policy,
    env: SensorQueryVectorEnv,
    settings: SwapRounds,
    index: int,
    seed: int,
) -> Swaps:
    """Run the episodes of a round, and try swaps in states along the way.

    Args:
        policy: Acts by drawing.
        env: n episodes, actions ``slots``, autoreset disabled.
        settings: Of rounds.
        index: Number of the round, counted from 0.
        seed: Training seed. Draws depend on it and on ``index`` alone, but for those of torch.

    Returns:
        The swaps of every ``settings.seconds``, in states of the same second in all episodes.
    """
    first_episode = training_seed(seed) + SEED_STRIDE * (index + 1)
    generator = np.random.default_rng([seed, index])
    horizon, seconds = env.config.horizon_steps, settings.seconds
    # The states of every round are at other seconds.
    first = first_second(horizon) + int(generator.integers(seconds))
    observation, _ = env.reset(seed=list(range(first_episode, first_episode + env.num_envs)))
    for _ in range(first):
        observation = env.advance(_drawn(policy, observation)).observation
    parts: list[tuple[AnyArray, ...]] = []
    n_states = (horizon - first) // seconds
    with make_bar(n_states, desc="swaps", unit="state", leave=False) as bar:
        for _ in range(n_states):
            before, shown, actions = env.process.fork(), observation, []
            for _ in range(seconds):
                actions.append(_drawn(policy, observation))
                observation = env.advance(actions[-1]).observation
            parts.append(_tried(before, shown, actions, generator, settings.trials, len(parts)))
            bar.update()
    return Swaps(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _drawn(policy: Policy, observation: Observation) -> Action:
    action: Action = policy.predict(observation, deterministic=False)[0]
    return action


def _tried(
    before: QueryProcess,
    shown: Observation,
    actions: Sequence[Action],
    generator: np.random.Generator,
    trials: int,
    n_before: int,
) -> tuple[AnyArray, ...]:
    """Try swaps in the first of ``actions``, in every episode of ``before``.

    Returns columns of `Swaps`; ``n_before`` times as many states came before.
    """
    n, every = len(shown), np.arange(len(shown))
    columns = before.release.task.n_channels
    noise = generator.choice([-1.0, 1.0], size=(n, columns, 2))
    reward, spent = _played(before, actions, noise)
    queried = np.zeros((n, before.interface.queries.n_queries), dtype=bool)
    np.put_along_axis(queried, actions[0], True, axis=1)
    parts = []
    for _ in range(trials):
        added = np.where(queried, -1.0, generator.random(queried.shape)).argmax(axis=1)
        place = generator.integers(actions[0].shape[1], size=n)
        query = actions[0].copy()
        query[every, place] = added
        swapped_reward, swapped_spent = _played(before, [query, *actions[1:]], noise)
        dropped = actions[0][every, place]
        gain, increase = swapped_reward - reward, swapped_spent - spent
        parts.append((n * n_before + every, added, dropped, gain, increase))
    swaps = (np.concatenate(column) for column in zip(*parts, strict=True))
    return shown, -reward / len(actions), *swaps


def _played(
    before: QueryProcess, actions: Sequence[Action], noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the summed reward of each episode and the budgets that its vehicles have spent then.

    Both are means over the noise and its opposite, shape (n,).
    """
    every = np.arange(before.n_episodes)
    reward, spent = np.zeros((2, before.n_episodes))
    for sign in (1.0, -1.0):
        fork = before.fork()
        fork.release.give_noise(sign * noise)
        for action in actions:
            reward += 0.5 * fork.step(every, action).reward
        spent += 0.5 * fork.release.budgets_spent(every)
    return reward, spent


class _Gains:
    """Swaps of an environment as targets of the fit.

    Gains are in units of the policy's mean one-second error, so that settings carry over to other
    environments. The price of the budgets that vehicles spend is subtracted from each: a vehicle
    without budget is missing from the releases for the rest of an episode, long after the seconds
    in which a gain is measured.
    """

    def __init__(
        self, policy: RoadPolicy, swaps: Swaps, settings: SwapRounds, batch_size: int
    ) -> None:
        gains = np.clip(swaps.gain / swaps.error.mean(), -LARGEST_GAIN, LARGEST_GAIN)
        gains -= settings.price * swaps.spent
        self._policy, self._batch_size = policy, batch_size
        self._seen = torch.from_numpy(swaps.observations)
        self._targets = torch.from_numpy(gains.astype(np.float32))
        self._swapped = tuple(map(torch.from_numpy, (swaps.state, swaps.added, swaps.dropped)))
        with torch.no_grad():
            parts = range(0, len(self._seen), PART)
            self._before = torch.cat([policy.scores(self._seen[i : i + PART]) for i in parts])

    def loss(self, step: float) -> Tensor:
        """Return the squared error of a random minibatch of expected gains."""
        rows = torch.randint(len(self._targets), (self._batch_size,))
        state, added, dropped = (each[rows] for each in self._swapped)
        shown, row = torch.unique(state, return_inverse=True)
        moved = self._policy.scores(self._seen[shown]) - self._before[shown]
        expected = (moved[row, added] - moved[row, dropped]) / step
        return torch.square(expected - self._targets[rows]).mean()


def raise_scores(
    policies: Sequence[RoadPolicy],
    swaps: Sequence[Swaps],
    settings: SwapRounds,
    step: float,
) -> None:
    """Raise the scores of policies in place by ``step`` times the expected gain of a query.

    Args:
        policies: Policies that share a scorer, each of an environment of its own.
        swaps: Those tried under each of them.
        settings: Of rounds.
        step: Rise of a score for an expected gain of one mean one-second error.
    """
    scorer = policies[0].scorer
    n = policies[0].road.n_mainline
    gains = [
        _Gains(policy, each, settings, max(settings.batch_size * n // policy.road.n_mainline, 1))
        for policy, each in zip(policies, swaps, strict=True)
    ]
    batches = settings.batches * len(gains)
    optimizer = torch.optim.Adam(scorer.parameters(), lr=settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, batches)
    with make_bar(batches, desc="fit", unit="batch", leave=False) as bar:
        for batch in range(batches):
            loss = gains[batch % len(gains)].loss(step)
            optimizer.zero_grad()
            torch.autograd.backward(loss)
            optimizer.step()
            schedule.step()
            bar.update()
    scorer.zero_grad()

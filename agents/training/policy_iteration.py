"""Policy iteration with measured advantages: scores move in proportion to the gains of swaps.

The gain of swapping segment j for segment i is learned as a difference g_i - g_j of a number per
segment, by least squares. Scores move by a small multiple of g, which is a step of mirror descent
on the distribution over sets (its weights exp(score) are multiplied by exp(step g)); then gains
are measured anew, under the new policy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from agents.seeds import training_seed
from agents.training.recipes import SwapRounds
from agents.training.swaps import Swaps, try_swaps
from dptse_env.sb3 import PlackettLucePolicy
from dptse_env.vector_env import SensorQueryVectorEnv

LARGEST_GAIN = 0.6
"""Clips gains [mean one-second errors]: outliers would dominate the least-squares fit."""

PART = 4096
"""Observations scored at a time."""

SEED_STRIDE = 10_000
"""Between the seeds of two rounds; the first begins a stride after those of the regression."""

REPORT_INTERVAL = 50
"""Minibatches between two reports of progress."""


def collect_swaps(
    policy: PlackettLucePolicy,
    env: SensorQueryVectorEnv,
    settings: SwapRounds,
    index: int,
    seed: int,
    progress: Callable[[str, float], None] = lambda stage, fraction: None,
    *,
    first: int = 0,
) -> Swaps:
    """Return the swaps of a round, tried under ``policy``.

    Args:
        policy: Acts by drawing.
        env: An environment as `try_swaps` takes it.
        settings: Of rounds.
        index: Number of the round, counted from 0.
        seed: Training seed. Draws depend on it and on ``index`` alone, but for those of torch.
        progress: Called with the name of a stage and the fraction of it that is done.
        first: Number in the round of the first episode; draws depend on it, too.

    Raises:
        ValueError: There is nothing to swap, or the horizon is too short (`try_swaps`).
    """
    begin, parts = first_seed(seed, index) + first, []
    for part in try_swaps(
        env,
        policy,
        list(range(begin, begin + env.num_envs)),
        np.random.default_rng([seed, index, first] if first else [seed, index]),
        seconds=settings.seconds,
        trials=settings.trials,
    ):
        parts.append(part)
        progress("swaps", len(parts) * settings.seconds / env.config.horizon_steps)
    return Swaps.from_parts(parts)


def first_seed(seed: int, index: int) -> int:
    """Return the seed of the first episode of a round, counted from 0, with a training seed."""
    return training_seed(seed) + SEED_STRIDE * (index + 1)


class _Gains:
    """Swaps of an environment as targets of the fit.

    Gains are in units of the policy's mean one-second error, so that settings carry over to other
    environments. The price of the budgets that vehicles spend is subtracted from each: a vehicle
    without budget is missing from the releases for the rest of an episode, long after the seconds
    in which a gain is measured.
    """

    def __init__(
        self, policy: PlackettLucePolicy, swaps: Swaps, settings: SwapRounds, batch_size: int
    ) -> None:
        unit = swaps.error.mean()
        gains = np.clip(swaps.gain / unit, -LARGEST_GAIN, LARGEST_GAIN)
        gains -= settings.price * swaps.spent
        self._policy, self._batch_size = policy, batch_size
        self._seen = torch.from_numpy(swaps.observations)
        self._targets = torch.from_numpy(gains.astype(np.float32))
        self._swapped = tuple(map(torch.from_numpy, (swaps.state, swaps.added, swaps.dropped)))
        with torch.no_grad():
            seen = self._seen
            parts = [policy.scores(seen[i : i + PART]) for i in range(0, len(seen), PART)]
            self._before = torch.cat(parts)

    def loss(self, step: float) -> Tensor:
        """Return the squared error of a random minibatch of expected gains."""
        rows = torch.randint(len(self._targets), (self._batch_size,))
        state, added, dropped = (each[rows] for each in self._swapped)
        shown, row = torch.unique(state, return_inverse=True)
        moved = self._policy.scores(self._seen[shown]) - self._before[shown]
        expected = (moved[row, added] - moved[row, dropped]) / step
        return torch.square(expected - self._targets[rows]).mean()


def raise_scores(
    policies: Sequence[PlackettLucePolicy],
    swaps: Sequence[Swaps],
    settings: SwapRounds,
    step: float,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Raise the scores of policies in place by ``step`` times the expected gain of a query.

    Args:
        policies: Policies that share a scorer, each of an environment of its own.
        swaps: Those tried under each of them.
        settings: Of rounds.
        step: Rise of a score for an expected gain of one mean one-second error.
        progress: Called with the fraction of the fit that is done.
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
    for batch in range(batches):
        loss = gains[batch % len(gains)].loss(step)
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.step()
        schedule.step()
        if progress is not None and batch % REPORT_INTERVAL == 0:
            progress(batch / batches)
    scorer.zero_grad()

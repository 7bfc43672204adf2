"""Moves a policy's scores by what swaps gain: policy iteration with measured advantages.

The gain of swapping segment j for segment i is learned as a difference g_i - g_j of one number per
segment, by least squares. Scores move by a small multiple of g, which is a step of mirror descent
on the distribution over sets (its weights exp(score) are multiplied by exp(step g)); then gains
are measured anew, under the policy of then.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from agents.evaluation.episodes import Policy
from agents.experiments.seeds import training_seed
from agents.training.plan import TrainingPlan
from agents.training.recipes import SwapRounds
from agents.training.swaps import Swaps, try_swaps
from dptse_env.sb3 import PlackettLucePolicy
from dptse_env.vector_env import SensorQueryVectorEnv

LARGEST = 0.6
"""Gains are clipped to this many seconds' error: few are larger, and they would rule the fit."""

PART = 4096
"""Observations scored at a time."""

SWAP_STRIDE = 10_000
"""Between the seeds of two rounds; the first begins one stride after those of PPO's episodes."""


def swap_round(
    plan: TrainingPlan,
    turn: int,
    env: SensorQueryVectorEnv,
    policy: PlackettLucePolicy,
    actor: Policy,
    on_share: Callable[[str, float], None],
) -> float:
    """Try swaps under a policy, and improve it by them.

    Args:
        plan: Of the training; its recipe has the settings of rounds.
        turn: Which round, counted from 0. Its draws depend on it and on the plan's seed alone,
            but for those of torch.
        env: Where swaps are tried, as `try_swaps` takes it.
        policy: Changed in place.
        actor: What acts as ``policy`` did before, by plain observations.
        on_share: Told what is being done and the share of it that is done.

    Returns:
        The mean error of a second under the policy before.

    Raises:
        ValueError: There is nothing to swap, or the horizon is too short (`try_swaps`).
    """
    settings, parts = plan.recipe.rounds, []
    first = training_seed(plan.seed) + SWAP_STRIDE * (turn + 1)
    for part in try_swaps(
        env,
        actor,
        list(range(first, first + settings.episodes)),
        np.random.default_rng([plan.seed, turn]),
        seconds=settings.seconds,
        trials=settings.trials,
    ):
        parts.append(part)
        on_share("swaps", len(parts) * settings.seconds / env.config.horizon_steps)
    swaps = Swaps.joined(parts)
    improve(policy, swaps, settings, settings.step_of(turn), partial(on_share, "fit"))
    return float(swaps.error.mean())


def improve(
    policy: PlackettLucePolicy,
    swaps: Swaps,
    settings: SwapRounds,
    step: float,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Move the scores of ``policy`` by ``step`` times the expected gain of asking.

    Gains are in units of the policy's mean error of a second, so that settings carry over to
    other environments. From each the price of the exposures is taken: vehicles that have counted
    as often as the cap allows are missed for the rest of an episode, long after the seconds in
    which twins are followed.

    Args:
        policy: Changed in place.
        swaps: Tried under this policy.
        settings: Price, minibatches and learning rate.
        step: By how much a score rises for an expected gain of a second's error.
        progress: Called with the share that is done, every so often.
    """
    second = swaps.error.mean()
    gains = np.clip(swaps.gain / second, -LARGEST, LARGEST) - settings.price * swaps.exposures
    seen = torch.from_numpy(swaps.observations)
    worth = torch.from_numpy(gains.astype(np.float32))
    state, added, dropped = map(torch.from_numpy, (swaps.state, swaps.added, swaps.dropped))
    with torch.no_grad():
        before = torch.cat([_scores(policy, part) for part in seen.split(PART)])
    optimizer = torch.optim.Adam(policy.scorer.parameters(), lr=settings.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.batches)
    for batch in range(settings.batches):
        rows = torch.randint(len(worth), (settings.batch_size,))
        shown, row = torch.unique(state[rows], return_inverse=True)
        moved = _scores(policy, seen[shown]) - before[shown]
        expected = (moved[row, added[rows]] - moved[row, dropped[rows]]) / step
        loss = torch.square(expected - worth[rows]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if progress is not None and batch % 50 == 0:
            progress(batch / settings.batches)
    policy.scorer.zero_grad()


def _scores(policy: PlackettLucePolicy, seen: Tensor) -> Tensor:
    scores: Tensor = policy.scorer(policy.channels(seen))
    return scores

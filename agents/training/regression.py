"""Teaches a scorer how wrong the estimate is where, before PPO teaches it what asking is worth.

The estimator's own variance says little of its error: process noise is tuned for the estimates,
and a jam that nobody has seen yet is in no variance. In training the truth is known, so the error
that an observation lets one expect can be learned by regression, which takes less than PPO by
orders of magnitude: every segment of every second is a sample. Asking where it is largest comes
close to asking by the true error, and is where PPO starts from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from agents.training.episodes import TrainingEpisodes
from agents.training.recipes import PlackettLuceRecipe
from agents.training.truth import squared_errors
from dptse_env.arrays import Observation
from dptse_env.process import QueryProcess
from dptse_env.sb3 import PlackettLucePolicy

FLOOR = 1e-4
"""Added to squared errors: an error of a hundredth is as good as none."""

VARIANCE = {"density_log_std": 0.5, "speed_log_std": 0.5, "age": 0.1}
"""Where the fit starts: logarithms of squared errors near the estimator's own variances."""

FALL = 0.95
"""Share of its learning rate that a pretraining has lost at its end."""

REPORTED = 50
"""Minibatches between two reports of progress."""

LEVEL = -3.0
"""Where the constant of these logarithms starts."""


def pretrain(
    policy: PlackettLucePolicy,
    episodes: TrainingEpisodes,
    recipe: PlackettLuceRecipe,
    progress: Callable[[float], None] | None = None,
    squared: Callable[[QueryProcess], Observation] = squared_errors,
) -> None:
    """Let ``policy`` act, and fit its scores to the squared errors that follow from it.

    With expected squared error exp(z) of a segment, the loss y exp(-z) + z is that of normal errors
    of this variance; it is least where exp(z) is the mean of y. Scores are ``sharpness`` times z
    and a bonus for age, since what was not asked for long gains more, but for a constant. Each
    round adds what the policy of then meets to what is learned from.

    Args:
        policy: Changed in place.
        episodes: They are begun anew, and left where they are.
        recipe: Rounds, seconds, minibatches and sharpness.
        progress: Called with the share that is done, every so often.
        squared: Returns the squared errors of all episodes, shape (n, n_mainline).
    """
    level = torch.tensor([LEVEL], requires_grad=True)
    optimizer = torch.optim.Adam([*policy.scorer.parameters(), level], lr=recipe.pretraining_rate)
    bonus = {"age": recipe.age_bonus}
    observation = episodes.reset()
    seen: list[Tensor] = []
    errors: list[Tensor] = []
    for turn in range(recipe.pretraining_rounds):
        for second in range(recipe.pretraining_seconds):
            if second % recipe.pretraining_every == 0:
                seen.append(torch.from_numpy(observation[:, : policy.road.size].copy()))
                errors.append(torch.from_numpy(squared(episodes.env.process)))
            actions, _ = policy.predict(observation, deterministic=False)
            observation, *_ = episodes.step(actions)
        if turn:
            _add(policy, bonus, -recipe.sharpness)
        else:
            _add(policy, policy.rule, -1.0)
            _add(policy, VARIANCE, recipe.sharpness)
        samples = torch.cat(seen), torch.cat(errors)
        for batch in range(recipe.pretraining_batches):
            done = (turn + batch / recipe.pretraining_batches) / recipe.pretraining_rounds
            optimizer.param_groups[0]["lr"] = recipe.pretraining_rate * (1.0 - FALL * done)
            _fit(policy, level, optimizer, recipe, *samples)
            if progress is not None and batch % REPORTED == 0:
                progress(done)
        _add(policy, bonus, recipe.sharpness)
    policy.scorer.zero_grad()
    episodes.take_mean_reward()


def _add(policy: PlackettLucePolicy, weights: Mapping[str, float], factor: float) -> None:
    """Add to the weights of the rule's blocks."""
    with torch.no_grad():
        for k, name in enumerate(policy.rule):
            policy.scorer.rule[k] += factor * weights.get(name, 0.0)


def _fit(
    policy: PlackettLucePolicy,
    level: Tensor,
    optimizer: torch.optim.Optimizer,
    recipe: PlackettLuceRecipe,
    seen: Tensor,
    errors: Tensor,
) -> None:
    """Take a step of the optimiser on a random minibatch."""
    rows = torch.randint(len(seen), (recipe.pretraining_batch_size,))
    scores = policy.scorer(policy.channels(seen[rows]))
    logs = scores / recipe.sharpness + level
    loss = ((errors[rows] + FLOOR) * torch.exp(-logs) + logs).mean()
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(policy.scorer.parameters(), recipe.max_grad_norm)
    optimizer.step()

"""PPO in one file, in the style of CleanRL: everything to read and to change is on this page.

pip install -e '.[train]'
python examples/cleanrl_ppo.py
dptse evaluate --env dptse_env:dptse/ShortHighway-v0 \
    --policies examples.slots_policy:SlotsPolicy=results/cleanrl/policy.zip

It needs torch and no learning library. ``gym.make_vec`` makes a batch of episodes that steps as
one. Its autoreset is that of the same step: the step that ends an episode returns the first
observation of the next one, and ``infos["final_obs"]`` has the last one of the old. Episodes end by
truncation alone, so the value of that last observation stands for what would have followed.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Categorical, Independent

from dptse_env.schedules import make_schedule
from examples.held_out import make_held_out, mean_error
from examples.slots_policy import SlotsPolicy


@dataclass(frozen=True)
class Args:
    """Train with PPO."""

    env: str = "dptse_env:dptse/ShortHighway-v0"
    """Environment id."""
    envs: int = 64
    """Episodes at once."""
    steps: int = 300_000
    """Steps to train for, at least."""
    rollout: int = 64
    """Steps of each episode in one iteration."""
    epochs: int = 4
    """Passes over the steps of an iteration."""
    minibatch: int = 512
    """Steps of one update."""
    learning_rate: float = 3e-4
    """Step size of Adam."""
    gamma: float = 0.9
    """Discount of a second: a query matters for some ten seconds."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    clip: float = 0.2
    """Largest change of a probability ratio that still counts."""
    entropy: float = 0.01
    """Weight of the entropy bonus."""
    seed: int = 0
    """Seeds the environments, the actions and the weights."""
    output: Path = Path("results/cleanrl")
    """Folder for policy.zip."""


def perceptron(n_inputs: int, n_outputs: int, scale: float) -> nn.Sequential:
    """Return a network whose last layer starts small, so that all options start equally likely."""
    last = nn.Linear(64, n_outputs)
    nn.init.orthogonal_(last.weight, scale)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(n_inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), last)


def main(args: Args) -> None:  # noqa: PLR0915 (one function, to be read from top to bottom)
    """Train, and compare the policy with its untrained self and a schedule on held-out traffic."""
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    keywords: dict[str, Any] = {"action": "slots", "horizon": 120, "random_start": True}
    held_out = make_held_out(args.env, keywords)
    batch = {"num_envs": args.envs, "autoreset_mode": "SameStep", "threads": 1}
    envs = gym.make_vec(args.env, **batch, **keywords)
    space: Any = envs.single_action_space
    size = envs.single_observation_space.shape[0]
    n_slots, n_options = len(space.nvec), int(space.nvec[0])

    actor = perceptron(size, n_slots * n_options, 0.01)
    critic = perceptron(size, 1, 1.0)
    weights = [*actor.parameters(), *critic.parameters()]
    optimiser = torch.optim.Adam(weights, args.learning_rate, eps=1e-5)
    policy = SlotsPolicy(actor, envs.single_observation_space, space)
    untrained = mean_error(held_out, policy)

    def choices(observations: torch.Tensor) -> Independent:
        logits = actor(observations).unflatten(-1, (n_slots, n_options))
        return Independent(Categorical(logits=logits), 1)

    observations = torch.zeros(args.rollout, args.envs, size)
    actions = torch.zeros(args.rollout, args.envs, n_slots, dtype=torch.long)
    log_probs, rewards, values, next_values, over = torch.zeros(5, args.rollout, args.envs)
    start, steps = time.perf_counter(), 0
    observation = torch.as_tensor(envs.reset(seed=args.seed)[0])
    while steps < args.steps:
        for t in range(args.rollout):
            with torch.no_grad():
                distribution = choices(observation)
                action = distribution.sample()
                log_probs[t] = distribution.log_prob(action)
                values[t] = critic(observation).squeeze(-1)
            observations[t], actions[t] = observation, action
            following, reward, _, truncated, infos = envs.step(action.numpy())
            observation = torch.as_tensor(following)
            last = observation.clone()
            for i in np.flatnonzero(truncated):
                last[i] = torch.as_tensor(infos["final_obs"][i])
            with torch.no_grad():
                next_values[t] = critic(last).squeeze(-1)
            rewards[t], over[t] = torch.as_tensor(reward), torch.as_tensor(truncated)
        steps += args.rollout * args.envs

        errors = rewards + args.gamma * next_values - values
        advantages, running = torch.zeros_like(errors), torch.zeros(args.envs)
        for t in reversed(range(args.rollout)):
            running = errors[t] + args.gamma * args.gae_lambda * (1.0 - over[t]) * running
            advantages[t] = running
        targets = (advantages + values).flatten()
        gains = ((advantages - advantages.mean()) / (advantages.std() + 1e-8)).flatten()
        seen, taken, old = observations.flatten(0, 1), actions.flatten(0, 1), log_probs.flatten()

        for _ in range(args.epochs):
            for rows in torch.randperm(len(gains)).split(args.minibatch):
                distribution = choices(seen[rows])
                ratio = (distribution.log_prob(taken[rows]) - old[rows]).exp()
                clipped = ratio.clamp(1.0 - args.clip, 1.0 + args.clip)
                policy_loss = -torch.min(ratio * gains[rows], clipped * gains[rows]).mean()
                value_loss = (critic(seen[rows]).squeeze(-1) - targets[rows]).square().mean()
                bonus = args.entropy * distribution.entropy().mean()
                optimiser.zero_grad()
                (policy_loss + 0.5 * value_loss - bonus).backward()
                nn.utils.clip_grad_norm_(weights, 0.5)
                optimiser.step()
        rate = steps / (time.perf_counter() - start)
        print(f"{steps} steps, mean reward {rewards.mean():.4f}, {rate:.0f} steps/s")

    policy.save(args.output / "policy.zip")
    trained = mean_error(held_out, policy)
    rule = mean_error(held_out, make_schedule("round-robin", held_out))
    print(f"mean error: untrained {untrained:.1f}, trained {trained:.1f}, round robin {rule:.1f}")
    print(f"the policy is in {args.output}/policy.zip")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

"""PPO in one file, in the style of CleanRL: everything to read and to change is on this page.

pip install -e '.[train]'
python examples/cleanrl_ppo.py --steps 300000

``gym.make_vec`` makes a batch of episodes that steps as one. Its autoreset is that of the same
step: the step that ends an episode returns the first observation of the next one, and
``infos["final_obs"]`` has the last one of the old. Episodes end by truncation alone, so the value
of that last observation stands for what would have followed. The encoding ``slots`` suits PPO:
one categorical choice for each query.
"""

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Categorical, Independent

import dptse_env

ENV = "dptse_env:dptse/ShortHighway-v0"
KEYWORDS = {"estimator": "ekf", "parameters": "published", "action": "slots"}
N_ENVS, ROLLOUT, EPOCHS, MINIBATCH, RATE = 64, 64, 4, 512, 1e-3
GAMMA, LAMBDA, CLIP, ENTROPY = 0.9, 0.95, 0.2, 0.003  # a query matters for some ten seconds
HELD_OUT = range(1000, 1008)


class Agent(nn.Module):
    """An actor and a critic, which scale observations as those of the first rollout were."""

    def __init__(self, size: int, n_slots: int, n_queries: int) -> None:
        """Make both networks; all options start equally likely."""
        super().__init__()
        self.shape, self.mean, self.std = (n_slots, n_queries), torch.zeros(size), torch.ones(size)
        self.trunk = nn.Sequential(nn.Linear(size, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
        self.actor, self.critic = nn.Linear(64, n_slots * n_queries), nn.Linear(64, 1)
        nn.init.zeros_(self.actor.weight)

    def forward(self, observation: torch.Tensor) -> tuple[Independent, torch.Tensor]:
        """Return the distribution of actions and the values of observations (..., size)."""
        inner = self.trunk((observation - self.mean) / self.std)
        logits = self.actor(inner).unflatten(-1, self.shape)
        return Independent(Categorical(logits=logits), 1), self.critic(inner).squeeze(-1)

    @torch.no_grad()
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        """Return actions and no state: what `dptse_env.evaluate` asks a policy for."""
        choices, _ = self(torch.as_tensor(observation))
        return (choices.mode if deterministic else choices.sample()).numpy(), None


def error(policy) -> float:
    """Return the error x 1000 on held-out traffic of a policy, or of a schedule by its name."""
    env = gym.make_vec(ENV, num_envs=len(HELD_OUT), traffic_seeds=list(HELD_OUT), **KEYWORDS)
    return -1000 * np.mean([row["reward"] for row in dptse_env.evaluate(env, policy, HELD_OUT)])


def main(steps: int = 300_000, seed: int = 0) -> None:
    """Train, and compare the policy with its untrained self and a rule on held-out traffic."""
    torch.manual_seed(seed)
    envs = gym.make_vec(
        ENV, num_envs=N_ENVS, autoreset_mode="SameStep", horizon=120, random_start=True, **KEYWORDS
    )
    size, options = envs.single_observation_space.shape[0], envs.single_action_space.nvec
    agent = Agent(size, len(options), int(options[0]))
    optimiser = torch.optim.Adam(agent.parameters(), RATE, eps=1e-5)
    untrained = error(agent)
    seen = torch.zeros(ROLLOUT, N_ENVS, size)
    taken = torch.zeros(ROLLOUT, N_ENVS, len(options), dtype=torch.long)
    old, rewards, values, following, over = torch.zeros(5, ROLLOUT, N_ENVS)
    observation = torch.as_tensor(envs.reset(seed=seed)[0])
    for iteration in range(-(-steps // old.numel())):
        with torch.no_grad():
            for t in range(ROLLOUT):
                choices, values[t] = agent(observation)
                seen[t], taken[t] = observation, choices.sample()
                old[t] = choices.log_prob(taken[t])
                after, reward, _, truncated, infos = envs.step(taken[t].numpy())
                observation = torch.as_tensor(after)
                last = observation.clone()
                for i in np.flatnonzero(truncated):
                    last[i] = torch.as_tensor(infos["final_obs"][i])
                following[t] = agent(last)[1]
                rewards[t], over[t] = torch.as_tensor(reward), torch.as_tensor(truncated)
            gains, running = torch.zeros_like(values), torch.zeros(N_ENVS)
            for t in reversed(range(ROLLOUT)):
                step_gain = rewards[t] + GAMMA * following[t] - values[t]
                running = step_gain + GAMMA * LAMBDA * (1.0 - over[t]) * running
                gains[t] = running
        if iteration == 0:
            agent.mean, agent.std = seen.mean((0, 1)), seen.std((0, 1)) + 1e-3
            continue
        targets, scaled = gains + values, (gains - gains.mean()) / gains.std()
        batch = [each.flatten(0, 1) for each in (seen, taken, old, scaled, targets)]
        for rows in (
            r for _ in range(EPOCHS) for r in torch.randperm(old.numel()).split(MINIBATCH)
        ):
            o, a, before, gain, target = (each[rows] for each in batch)
            choices, value = agent(o)
            ratio = (choices.log_prob(a) - before).exp()
            policy_loss = -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            value_loss, bonus = (value - target).square().mean(), choices.entropy().mean()
            optimiser.zero_grad()
            (policy_loss + 0.5 * value_loss - ENTROPY * bonus).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimiser.step()
        print(f"{(iteration + 1) * old.numel()} steps, mean reward {rewards.mean():.4f}")
    trained, rule = error(agent), error("speed-front")
    print(f"error x 1000: untrained {untrained:.1f}, trained {trained:.1f}, rule {rule:.1f}")


if __name__ == "__main__":
    tyro.cli(main)

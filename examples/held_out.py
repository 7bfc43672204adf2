"""Mean error of a policy on traffic that no example trains on."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

SEEDS = range(1000, 1004)
"""Traffic seeds; those below 1000 serve training."""


def make_held_out(env: str, keywords: Mapping[str, Any]) -> Any:
    """Make a batch with an episode for each of `SEEDS`, which lasts as long as the record."""
    whole = {"horizon": None, "random_start": False, "threads": 1}
    seeds = f"{SEEDS.start}:{SEEDS.stop}"
    return gym.make_vec(
        env, num_envs=len(SEEDS), autoreset_mode="Disabled",
        **{**keywords, **whole, "traffic_seeds": seeds},
    )  # fmt: skip


def mean_error(envs: Any, policy: Any) -> float:
    """Return minus the mean reward of a second x 1000.

    Traffic and noise are the same in every call, so that policies are compared in pairs.

    Args:
        envs: The batch that `make_held_out` makes.
        policy: Anything with ``predict(observation, state, episode_start, deterministic)``, which
            returns actions and the next state: a schedule, or a trained policy.
    """
    observation, _ = envs.reset(seed=0, options={"traffic_seed": list(SEEDS)})
    state, start, over = None, np.ones(len(SEEDS), dtype=bool), np.zeros(len(SEEDS), dtype=bool)
    rewards = []
    while not over.all():
        actions, state = policy.predict(observation, state, start, deterministic=True)
        observation, reward, _, over, _ = envs.step(actions)
        start = np.zeros(len(SEEDS), dtype=bool)
        if reward.any():  # picks one by one are rewarded with the last one of a second
            rewards.append(reward)
    return float(-1000.0 * np.mean(rewards))

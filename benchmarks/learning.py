"""Time of a step of learning: PPO of stable-baselines3 on a core, beside the environment alone.

A step is a second of one episode, in which one or two segments are queried. Learning is a rollout
of all episodes and its updates: four epochs of minibatches of 1,024. Episodes come in groups of
eight replicas, as ``dptse train`` has them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from agents.environments import LONG, PRIVATE, SHORT
from benchmarks.turns import Row, Work, compare, make_batch, repeating, sample, take_turns
from dptse_env.sb3 import ReplicaBaseline, RoadPolicy, SB3VecEnv

ROADS = {
    "short road": SHORT + ' {"estimator": "ekf", "horizon": 120}',
    "the paper's road": PRIVATE + ' {"estimator": "ekf", "horizon": 300}',
    "long road": LONG + ' {"estimator": "ekf", "horizon": 400}',
    "long road, recurrent": LONG + ' {"horizon": 400}',
}
REPLICAS = 8


def measure(*, quick: bool = False) -> list[Row]:
    """Return the rows of all roads; the ratios are to the steps of the same road alone."""
    torch.set_num_threads(1)
    n, n_steps, rounds = (REPLICAS, 8, 2) if quick else (128, 32, 6)
    work, bases = {}, {}
    for road, text in ROADS.items():
        envs = partial(episodes, text, n, "0:2" if quick else "0:32")
        env, alone = envs(), f"{road}, steps"
        actions = np.array(sample(env.action_space, n_steps * n)).reshape(n_steps, n, -1)
        work[alone] = repeating(env, list(actions), n)
        for name, policy in (("perceptron", "MlpPolicy"), ("road policy", RoadPolicy)):
            work[f"{road}, PPO, {name}"] = learning(envs(), policy, n_steps)
            bases[f"{road}, PPO, {name}"] = alone
    return compare(take_turns(work, rounds), bases)


def episodes(text: str, n: int, traffic_seeds: str) -> SB3VecEnv:
    """Return n episodes of an environment that is given as ``'id {json}'``, begun."""
    keywords = {"action": "slots", "random_start": True, "traffic_seeds": traffic_seeds}
    env = SB3VecEnv(make_batch(text, n, autoreset_mode="SameStep", **keywords), REPLICAS)
    env.seed(0)
    env.reset()
    return env


def learning(env: SB3VecEnv, policy: Any, n_steps: int) -> Work:
    """Return work that learns from a rollout; a perceptron's observations are normalised."""
    is_road, size = policy is RoadPolicy, n_steps * env.num_envs
    model = PPO(
        policy,
        VecNormalize(env, norm_obs=not is_road, gamma=0.9),
        n_steps=n_steps,
        batch_size=min(1024, size),
        n_epochs=4,
        gamma=0.9,
        gae_lambda=0.9,
        policy_kwargs=RoadPolicy.kwargs(env) if is_road else None,
        seed=0,
        device="cpu",
    )
    return lambda: model.learn(size, ReplicaBaseline(REPLICAS), reset_num_timesteps=False), size

"""Environments on three seeds of traffic, and runs of a schedule on them."""

import gymnasium as gym
import numpy as np

from dptse_env.schedules import make_schedule
from tests.helpers import SHORT

SEEDS = (0, 1, 2)
EVERY = np.arange(3)
EPISODES = {"traffic_seeds": SEEDS, "horizon": 60, "random_start": True}


def make_batch(**keywords):
    keywords = {**EPISODES, "threads": 1, **keywords}
    return gym.make_vec(SHORT, num_envs=3, autoreset_mode="Disabled", **keywords)


def make_single(**keywords):
    return gym.make(SHORT, **{**EPISODES, **keywords})


def begin(env, start=150, episode=0):
    """Begin one episode per traffic seed, or the scalar environment's of one of them."""
    is_batch = hasattr(env.unwrapped, "num_envs")
    traffic = list(SEEDS) if is_batch else SEEDS[episode]
    return env.reset(seed=5 + episode, options={"traffic_seed": traffic, "start": start})[0]


def play(env, schedule, n_steps, observation=None):
    """Return the queries of some decisions, shape (n_steps, n, n_mainline), and the rewards."""
    if observation is None:
        observation = begin(env)
    if isinstance(schedule, str):
        schedule = make_schedule(schedule, env, seed=3)
    process, state, queries, rewards = env.unwrapped.process, None, [], []
    while len(queries) < n_steps:
        action, state = schedule.predict(observation, state)
        before = process.time[0]
        observation, reward, *_ = env.step(action)
        if process.time[0] > before:
            queries.append(process.queried.copy())
            rewards.append(np.atleast_1d(reward))
    return np.array(queries), np.array(rewards)

"""Environments on cached traffic and runs of a schedule, for the tests of schedules."""

import gymnasium as gym
import numpy as np

from dptse_env.schedules import make_schedule

SHORT = "dptse_env:dptse/ShortHighway-v0"
SEEDS = (0, 1, 2)


def make_batch(**keywords):
    keywords = {"traffic_seeds": SEEDS, "horizon": 60, "random_start": True, **keywords}
    return gym.make_vec(
        SHORT, num_envs=len(SEEDS), autoreset_mode="Disabled", threads=1, **keywords
    )


def make_single(**keywords):
    keywords = {"traffic_seeds": SEEDS, "horizon": 60, "random_start": True, **keywords}
    return gym.make(SHORT, **keywords)


def begin(env, start=150, seed=5):
    """Begin one episode per traffic seed, the scalar environment's with that of ``seed``."""
    if hasattr(env.unwrapped, "num_envs"):
        options = {"traffic_seed": list(SEEDS), "start": start}
    else:
        options = {"traffic_seed": SEEDS[seed - 5], "start": start}
    return env.reset(seed=seed, options=options)[0]


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

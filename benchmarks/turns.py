"""Turns of work that is compared, and what they take.

Rates drift between machines and moments, ratios of turns that follow one another far less: whatever
is compared takes its turns in one process, and a ratio is the geometric mean over the rounds.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from agents.environments import parse_env, quietly
from agents.statistics import mean_interval
from dptse_env.utils.arrays import FloatArray
from dptse_env.vector_env import SensorQueryVectorEnv

Work = tuple[Callable[[], object], int]
"""Does a turn of work; and the number of its steps, over all episodes."""

Row = list[str]
"""Cells under `HEADER`."""

HEADER = ("", "us a step", "ratio", "95 % interval", "to")
"""Work, the median time of a step of an episode, and its ratio to that of other work, by name."""


def take_turns(work: Mapping[str, Work], rounds: int) -> dict[str, FloatArray]:
    """Let each kind of work have its turn, again and again, so that all meet the same weather.

    Args:
        work: What is measured, by name.
        rounds: Rounds that count, 2 or more; one before them compiles and fills caches.

    Returns:
        By name, the time of a step in each round [us], shape (rounds,).
    """
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(1 + rounds):
        for name, (turn, steps) in work.items():
            start = time.perf_counter()
            turn()
            times[name].append(1e6 * (time.perf_counter() - start) / steps)
    return {name: np.array(found[1:]) for name, found in times.items()}


def compare(times: Mapping[str, FloatArray], bases: Mapping[str, str]) -> list[Row]:
    """Return a row under `HEADER` for each kind of work.

    Args:
        times: What `take_turns` returns.
        bases: By name, the work that another one is compared with, where there is one.
    """
    rows = []
    for name, found in times.items():
        row = [name, f"{np.median(found):,.1f}", "", "", bases.get(name, "")]
        if name in bases:
            logs = mean_interval(np.log(found / times[bases[name]]))
            ratio, low, high = np.exp([logs.mean, logs.low, logs.high])
            row[2:4] = [f"{ratio:.3g}", f"{low:.3g} to {high:.3g}"]
        rows.append(row)
    return rows


def make_batch(text: str, n_episodes: int, **more: Any) -> SensorQueryVectorEnv:
    """Make a batch of an environment that is given as ``'id {json}'``."""
    env_id, keywords = parse_env(text)
    with quietly():
        env = gym.make_vec(env_id, num_envs=n_episodes, **{"threads": 1, **more, **keywords})
    assert isinstance(env, SensorQueryVectorEnv)
    env.reset(seed=0)
    return env


def sample(space: gym.Space[Any], n: int) -> list[Any]:
    """Return sampled actions, always the same ones."""
    space.seed(0)
    return [space.sample() for _ in range(n)]


def repeating(
    env: Any, actions: Sequence[Any], n_episodes: int, reset: Callable[[], object] = lambda: None
) -> Work:
    """Return work that takes the same actions in every turn, and resets episodes that are over."""

    def turn() -> None:
        for action in actions:
            *_, is_over, _ = env.step(action)
            if np.all(is_over):
                reset()

    return turn, len(actions) * n_episodes


def stepping(env: SensorQueryVectorEnv, n_steps: int) -> Work:
    """Return work that takes a number of steps in all episodes of a batch."""
    return repeating(env, sample(env.action_space, n_steps), env.num_envs)


def measure(part: str, quick: bool) -> list[Row]:
    """Return the rows of a part; a process of its own can be asked for them."""
    rows: list[Row] = importlib.import_module(f"benchmarks.{part}").measure(quick=quick)
    return rows

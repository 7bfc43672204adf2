"""Run query policies over held-out traffic and pool their errors.

Policies are compared on the same traffic and the same noise: episode i of every policy is reset
with the same seed and the same traffic seed, and the mechanism draws noise for all segments
whatever is asked.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from dptse_env.config import TEST_SEEDS
from dptse_env.rendering import History

WARM_UP = 60
"""Seconds at the start of an episode that do not count: the road fills, the estimator settles."""


class Policy(Protocol):
    """What an evaluation needs of a policy, a schedule or a model of stable-baselines3."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return an action and the policy's next state."""


def check_held_out(seeds: Sequence[int]) -> None:
    """Refuse traffic seeds that a report must not rest on.

    Raises:
        ValueError: There are fewer than two, one stands twice, or one is not in `TEST_SEEDS`.
    """
    if len(set(seeds)) < 2 or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must be 2 or more and distinct, got {seeds}")
    strangers = [seed for seed in seeds if seed not in TEST_SEEDS]
    if strangers:
        raise ValueError(
            f"seeds must be held out, in {TEST_SEEDS[0]}..{TEST_SEEDS[-1]}: those below serve "
            f"training and validation; got {strangers[0]}"
        )


@dataclass(frozen=True)
class EpisodeScore:
    """What one episode says about a policy.

    Attributes:
        traffic_seed: The traffic it replayed.
        rmse_density: Density error, pooled over mainline segments and seconds [veh/km].
        rmse_speed: Speed error, pooled over occupied mainline segments and seconds [km/h].
        reward: Mean reward of a second.
        n_dropped: Requests that could not be served.
        n_diverged: Seconds in which the estimator had to start over.
        n_fallback: Seconds in which the estimator could not solve for its update and kept the
            prediction.
    """

    traffic_seed: int
    rmse_density: float
    rmse_speed: float
    reward: float
    n_dropped: float
    n_diverged: float
    n_fallback: float


def run_episode(
    env: gym.Env[Any, Any],
    policy: Policy,
    *,
    traffic_seed: int,
    seed: int,
    warm_up: int = WARM_UP,
    deterministic: bool = True,
    on_second: Callable[[], None] | None = None,
) -> EpisodeScore:
    """Run one episode and pool its errors.

    Args:
        env: An environment of this package, wrapped or not.
        policy: Who picks the queries.
        traffic_seed: One of the environment's traffic seeds.
        seed: Seeds the noise and the estimator.
        warm_up: Seconds that do not count.
        deterministic: Handed to the policy.
        on_second: Called after the reset and after every second.

    Raises:
        ValueError: The episode is not longer than the warm-up.
    """
    process = env.unwrapped.process  # type: ignore[attr-defined]
    observation, info = env.reset(seed=seed, options={"traffic_seed": traffic_seed})
    if on_second is not None:
        on_second()
    start = process.time[0]
    state: Any = None
    episode_start = np.ones(1, dtype=bool)
    rewards, infos = [], []
    truncated = False
    while not truncated:
        action, state = policy.predict(observation, state, episode_start, deterministic)
        episode_start = np.zeros(1, dtype=bool)
        before = process.time[0]
        observation, reward, _, truncated, info = env.step(action)
        if process.time[0] > before:  # a sequential action may leave the traffic where it is
            rewards.append(float(reward))
            infos.append(info)
            if on_second is not None:
                on_second()
    counted = slice(max(warm_up - int(start), 0), None)
    return _score(traffic_seed, rewards[counted], infos[counted], warm_up)


def _score(
    traffic_seed: int, rewards: list[float], infos: list[dict[str, Any]], warm_up: int
) -> EpisodeScore:
    if not infos:
        raise ValueError(f"the episode must be longer than the warm-up of {warm_up} s")

    def series(key: str) -> Any:
        return np.array([info[key] for info in infos])

    n_occupied = series("n_occupied")
    return EpisodeScore(
        traffic_seed=traffic_seed,
        rmse_density=math.sqrt(np.mean(series("rmse_density") ** 2)),
        rmse_speed=math.sqrt(
            np.sum(n_occupied * series("rmse_speed") ** 2) / max(n_occupied.sum(), 1.0)
        ),
        reward=float(np.mean(rewards)),
        n_dropped=float(series("n_dropped").sum()),
        n_diverged=float(series("diverged").sum()),
        n_fallback=float(series("fallback").sum()),
    )


def watch_episode(
    env: gym.Env[Any, Any], policy: Policy, *, traffic_seed: int, seed: int
) -> tuple[EpisodeScore, History]:
    """Run one episode and keep what a picture needs of it."""
    process = env.unwrapped.process  # type: ignore[attr-defined]
    history: list[History] = []

    def on_second() -> None:
        if history:
            history[0].append(process)
        else:
            history.append(History.begin(process))

    score = run_episode(env, policy, traffic_seed=traffic_seed, seed=seed, on_second=on_second)
    return score, history[0]

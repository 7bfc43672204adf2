"""Run query policies over recorded traffic and pool their errors.

Policies are paired by common random numbers: episode i of every policy is reset with the same seed
and the same traffic seed, and the mechanism draws noise for all segments whichever are queried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from agents.environments import unwrap
from dptse_env.config import TEST_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS
from dptse_env.process import QueryProcess
from dptse_env.rendering import History
from dptse_env.vector_env import SensorQueryVectorEnv

WARM_UP = 60
"""Seconds at the start of an episode that do not count: the road fills, the estimator settles."""


class Policy(Protocol):
    """A query policy: a schedule, or a model of stable-baselines3."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return an action and the policy's next state."""


def check_test_seeds(seeds: Sequence[int], path: str = "seeds") -> None:
    """Refuse traffic seeds that a report must not rest on.

    Raises:
        ValueError: There are fewer than two, two are equal, or one is not in `TEST_SEEDS`.
    """
    if len(set(seeds)) < 2 or len(set(seeds)) < len(seeds):
        raise ValueError(f"{path} must be 2 or more and distinct, got {seeds}")
    outside = [seed for seed in seeds if seed not in TEST_SEEDS]
    if outside:
        raise ValueError(
            f"{path} must be test seeds, in {TEST_SEEDS[0]}..{TEST_SEEDS[-1]}: those below serve "
            f"training and validation; got {outside[0]}"
        )


def require_seeds(path: str, seeds: Sequence[int], allowed: range) -> None:
    """Refuse traffic seeds out of a range, and none at all.

    Raises:
        ValueError: A seed is outside, or there is none.
    """
    outside = [seed for seed in seeds if seed not in allowed]
    if outside or not seeds:
        raise ValueError(
            f"{path} must be traffic seeds in {allowed[0]}..{allowed[-1]}, got "
            f"{outside[0] if outside else 'none'}"
        )


def seed_kind(seeds: Sequence[int]) -> str:
    """Return which range traffic seeds belong to: training, validation, test, or mixed."""
    ranges = {"training": TRAINING_SEEDS, "validation": VALIDATION_SEEDS, "test": TEST_SEEDS}
    kinds = [name for name, members in ranges.items() if set(seeds) <= set(members)]
    return kinds[0] if kinds else "mixed"


@dataclass(frozen=True)
class EpisodeScore:
    """The errors of one episode.

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
        policy: Picks the queries.
        traffic_seed: One of the environment's traffic seeds.
        seed: Seeds the noise and the estimator.
        warm_up: Seconds that do not count.
        deterministic: Handed to the policy.
        on_second: Called after the reset and after every second.

    Raises:
        ValueError: The episode is not longer than the warm-up.
    """
    observation, _ = env.reset(seed=seed, options={"traffic_seed": traffic_seed})

    def step(action: Any) -> tuple[Any, Any]:
        observation, reward, *_ = env.step(action)
        return observation, reward

    process = unwrap(env).process
    seconds = _play(process, policy, observation, step, deterministic, on_second)
    return _pool(seconds, [traffic_seed], warm_up)[0]


def run_episodes(
    env: SensorQueryVectorEnv,
    policy: Policy,
    *,
    traffic_seeds: Sequence[int],
    seeds: Sequence[int],
    warm_up: int = WARM_UP,
    deterministic: bool = True,
    on_second: Callable[[], None] | None = None,
) -> list[EpisodeScore]:
    """Run a batch of episodes at once and pool the errors of each; see `run_episode`.

    The environment is bare and made with ``autoreset_mode="Disabled"`` (`make_vector`). Its n
    episodes are in the order of the n traffic seeds and the n seeds of noise and estimator.
    The scores are those of `run_episode` for each pair of seeds, but for policies that draw at
    random: they draw for the whole batch at once, so other numbers from the same distribution.

    Raises:
        ValueError: Seeds are too many or too few, the environment is made otherwise, or episodes
            are not longer than the warm-up.
    """
    if not len(traffic_seeds) == len(seeds) == env.num_envs:
        raise ValueError(
            f"traffic_seeds and seeds must be {env.num_envs} each, one for each episode, got "
            f"{len(traffic_seeds)} and {len(seeds)}"
        )
    if env.autoreset_mode is not AutoresetMode.DISABLED:
        raise ValueError(
            f"env must be made with autoreset_mode='Disabled', got {env.autoreset_mode.value!r}"
        )
    observation, _ = env.reset(seed=list(seeds), options={"traffic_seed": list(traffic_seeds)})

    def step(actions: Any) -> tuple[Any, Any]:
        transition = env.advance(actions)
        return transition.observation, transition.reward

    seconds = _play(env.process, policy, observation, step, deterministic, on_second)
    return _pool(seconds, traffic_seeds, warm_up)


_SERIES = ("rmse_density", "rmse_speed", "n_occupied", "n_dropped", "diverged", "fallback")
"""Keys of ``info`` that a score is made of."""


def _play(
    process: QueryProcess,
    policy: Policy,
    observation: Any,
    step: Callable[[Any], tuple[Any, Any]],
    deterministic: bool,
    on_second: Callable[[], None] | None,
) -> list[dict[str, Any]]:
    """Play n episodes to their end by a step from actions to observations and rewards.

    Returns:
        `_SERIES`, reward and time of every second, shape (n,) each.
    """
    n = process.n_episodes
    state: Any = None
    episode_start = np.ones(n, dtype=bool)
    seconds: list[dict[str, Any]] = []
    if on_second is not None:
        on_second()
    while not process.over.all():
        action, state = policy.predict(observation, state, episode_start, deterministic)
        episode_start = np.zeros(n, dtype=bool)
        before = process.time.copy()
        observation, reward = step(action)
        # Sequential actions may leave the traffic where it is, in all episodes or in none.
        if (process.time > before).all():
            info = process.infos(np.arange(n))
            series = {key: info[key] for key in _SERIES}
            seconds.append({"reward": np.ravel(reward), "time": process.time.copy(), **series})
            if on_second is not None:
                on_second()
    return seconds


def _pool(
    seconds: Sequence[Mapping[str, Any]], traffic_seeds: Sequence[int], warm_up: int
) -> list[EpisodeScore]:
    """Pool the seconds of each episode that count."""
    tables = {key: np.array([second[key] for second in seconds]) for key in seconds[0]}
    scores = []
    for k, traffic_seed in enumerate(traffic_seeds):
        counts = tables["time"][:, k] > warm_up
        if not counts.any():
            raise ValueError(f"the episode must be longer than the warm-up of {warm_up} s")
        series = {key: table[counts, k] for key, table in tables.items()}
        n_occupied = series["n_occupied"]
        squares = n_occupied * series["rmse_speed"] ** 2
        score = EpisodeScore(
            traffic_seed=traffic_seed,
            rmse_density=math.sqrt(np.mean(series["rmse_density"] ** 2)),
            rmse_speed=math.sqrt(np.sum(squares) / max(n_occupied.sum(), 1.0)),
            reward=float(np.mean(series["reward"])),
            n_dropped=float(series["n_dropped"].sum()),
            n_diverged=float(series["diverged"].sum()),
            n_fallback=float(series["fallback"].sum()),
        )
        scores.append(score)
    return scores


def watch_episode(
    env: gym.Env[Any, Any], policy: Policy, *, traffic_seed: int, seed: int
) -> tuple[EpisodeScore, History]:
    """Run one episode and keep its maps of densities and queries.

    Returns:
        The score, and the history from the reset on; its first entry is the state at the reset.
    """
    process = unwrap(env).process
    history = History.empty(process)
    score = run_episode(
        env,
        policy,
        traffic_seed=traffic_seed,
        seed=seed,
        on_second=lambda: history.append(process),
    )
    return score, history

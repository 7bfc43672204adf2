"""Whole episodes of a query policy, and their errors: `evaluate`.

Policies are paired by common random numbers: a traffic seed gives an episode the same traffic and
the same noise under every policy, since noise is drawn for all segments whichever are queried.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from dptse_env.env import SensorQueryEnv
from dptse_env.process import QueryProcess
from dptse_env.schedules import make_schedule
from dptse_env.utils.arrays import IntArray
from dptse_env.utils.validation import integer, require
from dptse_env.vector_env import SensorQueryVectorEnv

WARM_UP = 60
"""Seconds at the start of an episode that do not count: the road fills, the estimator settles."""

Row = dict[str, Any]
"""Measurements of an episode, by name; see `evaluate`."""


class Policy(Protocol):
    """A query policy: a schedule, a model of stable-baselines3, or what `make_schedule` returns.

    A policy that has an attribute ``deterministic`` says by it whether it is to take its likeliest
    action; others are.
    """

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[Any, Any]:
        """Return an action and the policy's next state."""


class Watcher(Protocol):
    """Follows a batch of episodes, and adds columns to their rows."""

    def __call__(self) -> None:
        """Look at the process: once after the reset, then after every second."""

    def rows(self) -> Sequence[Row]:
        """Return the further columns of each episode, after the last second."""


WatcherFactory = Callable[[QueryProcess], Watcher]
"""Makes a watcher of a batch of episodes, just after their reset."""


def evaluate(
    env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
    policy: Any,
    seeds: Sequence[int],
    noise_seed: int = 0,
    *,
    warm_up: int = WARM_UP,
    deterministic: bool | None = None,
    watchers: Sequence[WatcherFactory] = (),
) -> list[Row]:
    """Play an episode on each traffic seed, and return a row for each.

    The first 60 s of an episode do not count, unless ``warm_up`` says otherwise.

    A scalar environment plays them one after another, a vector environment as many at once as it
    has episodes. Both give the same rows, but for policies that draw at random: these draw for a
    whole batch at once, so other numbers from the same distribution.

    Args:
        env: An environment of this package from ``gym.make`` or ``gym.make_vec``, wrapped or not;
            its ``traffic_seeds`` include the seeds.
        policy: What `dptse_env.schedules.make_schedule` takes: the name of a schedule, a class, an
            object with ``predict``, such as a model of stable-baselines3, or a function of the
            observation. A vector environment gives it a batch of observations, (n, size).
        seeds: Traffic seeds, one or more.
        noise_seed: Noise and estimator are seeded with this plus the traffic seed, and the choices
            of a schedule that draws with this alone.
        warm_up: Seconds at the start of an episode that do not count [s].
        deterministic: Whether the policy is asked for its likeliest action. By default a saved
            one is asked for what its card says, and any other for its likeliest action.
        watchers: Make objects that add columns to the rows.

    Returns:
        A dictionary for each seed, in their order:

        - ``traffic_seed``: the traffic;
        - ``rmse_density``: density error, pooled over mainline segments and seconds [veh/km];
        - ``rmse_speed``: speed error, pooled over occupied mainline segments and seconds [km/h];
        - ``reward``: mean reward of a second, those of a step being alike;
        - ``n_dropped``: requests that could not be served;
        - ``n_diverged``: seconds in which the estimator diverged and was started anew;
        - ``n_fallback``: seconds in which its update had no solution, so that it only predicted;

        and the columns of the watchers.

    Raises:
        ValueError: There is no seed or one that the environment does not have, the schedule is
            unknown, episodes are not longer than the warm-up, or a vector environment resets
            episodes in the step in which they end. Nothing was played then.
        TypeError: The environment is none of this package.
    """
    bare: Any = getattr(env, "unwrapped", env)
    batch: _Single | _Batch
    if isinstance(bare, SensorQueryVectorEnv):
        batch = _Batch(bare)
    elif isinstance(bare, SensorQueryEnv):
        batch = _Single(env, bare)
    else:
        raise TypeError(f"env must be an environment of dptse_env, got {type(bare).__name__}")
    listed = isinstance(seeds, Iterable) and not isinstance(seeds, str)
    require(listed, "seeds", "traffic seeds, such as range(2000, 2008)", seeds)
    seeds, config = [integer("seeds", seed, 0) for seed in seeds], bare.config
    require(len(seeds) > 0, "seeds", "one or more traffic seeds", seeds)
    known = set(config.traffic_seeds)
    unknown = [seed for seed in seeds if seed not in known]
    remedy = f"make it with traffic_seeds={_as_keyword(seeds)}"
    allowed = f"among the environment's traffic_seeds ({remedy})"
    require(not unknown, "seeds", allowed, unknown)
    require(config.horizon_steps > warm_up, "warm_up", "shorter than an episode", warm_up)
    player = make_schedule(policy, bare, noise_seed)
    if deterministic is None:
        deterministic = getattr(player, "deterministic", True)
    rows: list[Row] = []
    for first in range(0, len(seeds), batch.size):
        wanted = list(seeds[first : first + batch.size])
        # The last batch may be short: its last episode is then played by all that are left.
        filled = wanted + wanted[-1:] * (batch.size - len(wanted))
        observation = batch.reset(filled, noise_seed)
        looking = [watcher(batch.process) for watcher in watchers]
        seconds = _play(batch, player, observation, deterministic, looking)
        found = _pool(seconds, filled, warm_up)
        for watcher in looking:
            found = [{**row, **more} for row, more in zip(found, watcher.rows(), strict=True)]
        rows += found[: len(wanted)]
    return rows


def _as_keyword(seeds: Sequence[int]) -> str:
    """Return the keyword ``traffic_seeds`` that has some seeds."""
    first, stop = min(seeds), max(seeds) + 1
    is_range = sorted(seeds) == [*range(first, stop)]
    return repr(f"{first}:{stop}" if is_range else sorted({*seeds}))


def require_in_step(env: SensorQueryVectorEnv) -> None:
    """Check that the episodes of a batch stay in step, with as many actions for a second.

    Raises:
        ValueError: The decisions of a second may take different numbers of actions.
    """
    interface = env.interface
    one_by_one = interface.actions.picks_one_by_one
    if env.num_envs > 1 and one_by_one and interface.queries.costs_differ:
        raise ValueError(
            f"action {env.config.action!r} takes different numbers of actions for a second where "
            f"queries cost different amounts ({env.config.queries}): episodes cannot be played as "
            "a batch; use another encoding, or one episode at a time"
        )


class _Single:
    """One episode at a time, of a scalar environment with all its wrappers."""

    size = 1

    def __init__(self, env: Any, bare: SensorQueryEnv) -> None:
        self._env, self.process = env, bare.process

    def reset(self, seeds: list[int], noise_seed: int) -> Any:
        (seed,) = seeds
        observation, _ = self._env.reset(seed=noise_seed + seed, options={"traffic_seed": seed})
        return observation

    def step(self, action: Any) -> tuple[Any, Any]:
        observation, reward, *_ = self._env.step(action)
        return observation, reward


class _Batch:
    """All episodes of a vector environment at once."""

    def __init__(self, env: SensorQueryVectorEnv) -> None:
        if env.autoreset_mode is AutoresetMode.SAME_STEP:
            raise ValueError(
                "env must be made with another autoreset_mode than 'SameStep', which resets "
                "episodes before their last second is read"
            )
        require_in_step(env)
        self._env, self.process, self.size = env, env.process, env.num_envs

    def reset(self, seeds: list[int], noise_seed: int) -> Any:
        observation, _ = self._env.reset(
            seed=[noise_seed + seed for seed in seeds], options={"traffic_seed": seeds}
        )
        return observation

    def step(self, actions: Any) -> tuple[Any, Any]:
        transition = self._env.advance(actions)
        return transition.observation, transition.reward


_SERIES = ("rmse_density", "rmse_speed", "n_occupied", "n_dropped", "diverged", "fallback")
"""Keys of ``info`` that a row is made of."""


def _play(
    batch: _Single | _Batch,
    policy: Policy,
    observation: Any,
    deterministic: bool,
    watchers: Sequence[Watcher],
) -> list[dict[str, Any]]:
    """Play episodes to their end; return `_SERIES`, reward and time of every second, (n,) each."""
    process, n = batch.process, batch.process.n_episodes
    state: Any = None
    episode_start = np.ones(n, dtype=bool)
    seconds: list[dict[str, Any]] = []

    def watch(process: QueryProcess, _: IntArray) -> None:
        info = process.infos(np.arange(n))
        seconds.append({key: info[key] for key in _SERIES} | {"time": process.elapsed})
        _look(watchers)

    _look(watchers)
    process.watchers.append(watch)
    try:
        while not process.over.all():
            answer = policy.predict(observation, state, episode_start, deterministic)
            is_pair = isinstance(answer, tuple) and len(answer) == 2
            require(is_pair, "policy.predict()", "an action and a state", answer)
            action, state = answer
            episode_start = np.zeros(n, dtype=bool)
            n_before = len(seconds)
            observation, reward = batch.step(action)
            # Sequential actions may leave the traffic where it is, in all episodes or in none.
            for k, second in enumerate(seconds[n_before:]):
                second["reward"] = np.ravel(reward)
                if k > 0:
                    second["n_dropped"] = np.zeros(n)
    finally:
        process.watchers.remove(watch)
    return seconds


def _look(watchers: Sequence[Watcher]) -> None:
    for watcher in watchers:
        watcher()


def _pool(
    seconds: Sequence[Mapping[str, Any]], traffic_seeds: Sequence[int], warm_up: int
) -> list[Row]:
    """Pool the seconds of each episode that count."""
    tables = {key: np.array([second[key] for second in seconds]) for key in seconds[0]}
    rows = []
    for k, traffic_seed in enumerate(traffic_seeds):
        counts = tables["time"][:, k] > warm_up
        series = {key: table[counts, k] for key, table in tables.items()}
        n_occupied = series["n_occupied"]
        squares = n_occupied * series["rmse_speed"] ** 2
        row = {
            "traffic_seed": int(traffic_seed),
            "rmse_density": math.sqrt(np.mean(series["rmse_density"] ** 2)),
            "rmse_speed": math.sqrt(np.sum(squares) / max(n_occupied.sum(), 1.0)),
            "reward": float(np.mean(series["reward"])),
            "n_dropped": float(series["n_dropped"].sum()),
            "n_diverged": float(series["diverged"].sum()),
            "n_fallback": float(series["fallback"].sum()),
        }
        rows.append(row)
    return rows

"""This package's environments at work: alone, vectorised natively, and by Gymnasium's means."""

from __future__ import annotations

import copy
import multiprocessing
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.throughput.measure import Measured, queries, resident, take_turns, together
from benchmarks.throughput.rows import HORIZON
from dptse_env.config import EnvConfig
from dptse_env.estimators import make_estimator
from dptse_env.vector_env import SensorQueryVectorEnv

TURN = 0.2  # [s] that a turn should take
LONGEST_TURN = 64  # steps


def env_id(preset: str) -> str:
    """Return the id that imports the package, too."""
    return f"dptse_env:dptse/{preset}-v0"


def make_batch(preset: str, n: int, threads: int, **more: Any) -> SensorQueryVectorEnv:
    """Make n episodes in one process."""
    env = gym.make_vec(env_id(preset), num_envs=n, threads=threads, **more)
    assert isinstance(env, SensorQueryVectorEnv)
    return env


def libraries(preset: str, **more: Any) -> float | None:
    """Return the memory [MiB] with one episode of one record, libraries and kernels loaded."""
    seeds = more["traffic_seeds"].split(":")[0]
    env = gym.make(env_id(preset), **{**more, "traffic_seeds": seeds})
    env.reset(seed=0)
    env.step(env.action_space.sample())
    return resident()


class Tap:
    """Passes the calls of an estimator on and keeps those that change it.

    Attributes:
        calls: Name and arguments of each call.
    """

    def __init__(self, estimator: Any) -> None:
        """Tap an estimator."""
        self._estimator = estimator
        self.calls: list[tuple[str, tuple[Any, ...]]] = []

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the estimator, a method that changes it with a record of calls."""
        method = getattr(self._estimator, name)
        if name not in ("reset", "predict", "update"):
            return method

        def call(*arguments: Any) -> None:
            # The estimator draws from the generators of a reset.
            kept = copy.deepcopy(arguments) if name == "reset" else arguments
            self.calls.append((name, kept))
            method(*arguments)

        return call


class Kernel:
    """The estimator alone, given exactly what that of an environment was given."""

    def __init__(self, env: SensorQueryVectorEnv) -> None:
        """Make another estimator like that of ``env``, and tap that one."""
        config, self._process = env.config, env.process
        self._estimator: Any = make_estimator(
            config.estimator, config.backend, env.process.model, env.num_envs, config.settings()
        )
        self._tap: Any = Tap(env.process.estimator)
        self._process.estimator = self._tap

    def follow(self) -> int:
        """Repeat the calls since the last time; return the number of steps, over all episodes."""
        done = 0
        for name, arguments in self._tap.calls:
            getattr(self._estimator, name)(*arguments)
            if name == "update":
                self._estimator.estimate()
                done += len(arguments[0])
        self._tap.calls.clear()
        return done

    def check(self) -> None:
        """Stop unless the estimates agree: else the two have not done the same work."""
        estimate, expected = self._estimator.estimate(), self._process.estimate
        np.testing.assert_allclose(estimate.density, expected.density, rtol=1e-9, atol=1e-9)


class Driver:
    """Steps one environment through prepared queries and counts the steps left in its episodes."""

    def __init__(self, env: Any, n_episodes: int, masks: np.ndarray) -> None:
        """Begin the episodes; masks have shape (K, n, n_mainline), or (K, n_mainline) for one."""
        self.env, self.n_episodes, self.masks, self.left = env, n_episodes, masks, 0
        self.taken, self.turn = 0, 1
        self.restart(0)

    def restart(self, seed: int | None = None) -> None:
        """Begin all episodes."""
        self.env.reset(seed=seed)
        self.left = HORIZON

    def renew(self) -> None:
        """Begin all episodes if less than a turn is left of them."""
        if self.left < self.turn:
            self.restart()

    def step(self, n_steps: int) -> int:
        """Take steps in all episodes; return their number, over all episodes."""
        for _ in range(n_steps):
            self.env.step(self.masks[self.taken % len(self.masks)])
            self.taken += 1
        self.left -= n_steps
        return n_steps * self.n_episodes

    def take(self) -> int:
        """Take the steps of a turn; return their number, over all episodes."""
        return self.step(self.turn)

    def settle(self, n_steps: int) -> None:
        """Take first steps, then choose the number of steps of a turn."""
        self.step(n_steps)
        start = time.perf_counter()
        self.step(1)
        elapsed = time.perf_counter() - start
        self.turn = int(np.clip(TURN / elapsed, 1, LONGEST_TURN))

    def measure(self, seconds: float, loaded: float | None) -> Measured:
        """Measure turns, resets left out."""
        arms = take_turns({"environment": self.take}, seconds, self.renew)
        return Measured(arms, resident("VmHWM"), loaded)


def make_driver(env: SensorQueryVectorEnv) -> Driver:
    """Make the driver of a native vector environment."""
    config, n = env.config, env.num_envs
    masks = queries(LONGEST_TURN // 4, n, config.corridor.n_mainline, config.bandwidth)
    return Driver(env, n, masks)


def first_steps(config: EnvConfig) -> int:
    """Return the number of steps after which all cost the same: the MHE's window is full."""
    return config.settings().mhe.horizon + 1 if config.estimator == "mhe" else 2


def scalar(seconds: float, preset: str, **more: Any) -> Measured:
    """Measure one episode at a time, as `gymnasium.make` gives it."""
    loaded = libraries(preset, **more)
    env = gym.make(env_id(preset), **more)
    config = env.unwrapped.config  # type: ignore[attr-defined]
    masks = queries(LONGEST_TURN, 1, config.corridor.n_mainline, config.bandwidth)[:, 0]
    driver = Driver(env, 1, masks)
    driver.settle(first_steps(config))
    return driver.measure(seconds, loaded)


def vector(seconds: float, preset: str, n: int, threads: int, **more: Any) -> Measured:
    """Measure n episodes on one thread, on ``threads``, and the bare estimator on the same."""
    loaded = libraries(preset, **more)
    driver = make_driver(make_batch(preset, n, 1, **more))
    start = time.perf_counter()
    driver.restart(0)
    notes = {"reset_seconds": time.perf_counter() - start}
    kernel = Kernel(driver.env)
    driver.restart(0)
    driver.settle(first_steps(driver.env.config))
    peak = resident("VmHWM")
    kernel.follow()

    work: dict[str, Callable[[], int]] = {"one thread": driver.take}
    drivers = [driver]
    if threads > 1:
        paired = make_driver(make_batch(preset, n, threads, **more))
        paired.step(driver.taken)
        paired.turn = driver.turn
        drivers.append(paired)
        work["threads"] = paired.take
    work["kernel"] = kernel.follow

    def prepare() -> None:
        if driver.left < driver.turn:
            for each in drivers:
                each.restart()
            kernel.follow()

    arms = take_turns(work, seconds, prepare)
    kernel.check()
    return Measured(arms, peak, loaded, notes)


def gymnasium_vector(seconds: float, preset: str, n: int, mode: str, **more: Any) -> Measured:
    """Measure n scalar environments in Gymnasium's ``sync`` or ``async`` vectorisation."""
    loaded = libraries(preset, **more)
    env = gym.make_vec(env_id(preset), num_envs=n, vectorization_mode=mode, **more)
    try:
        masks = queries(LONGEST_TURN, n, env.single_action_space.shape[0], more["bandwidth"])
        driver = Driver(env, n, masks)
        driver.settle(2)
        measured = driver.measure(seconds, loaded)
        workers = multiprocessing.active_children()
        if workers:
            measured.peak = together([worker.pid for worker in workers if worker.pid])
        return measured
    finally:
        env.close()

"""This package's environments at work: alone, vectorised natively, and by Gymnasium's own means."""

from __future__ import annotations

import copy
import multiprocessing
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.throughput.measure import Measured, queries, resident, take_turns, together
from benchmarks.throughput.rows import HORIZON
from dptse_env.estimators import make_estimator
from dptse_env.utils.arrays import BoolArray, FloatArray, IntArray
from dptse_env.vector_env import SensorQueryVectorEnv

TURN = 0.2  # [s] that a turn should take
LONGEST_TURN = 64  # steps


def env_id(preset: str) -> str:
    """Return the id that imports the package, too."""
    return f"dptse_env:dptse/{preset}-v0"


def batch(preset: str, n: int, threads: int, **more: Any) -> SensorQueryVectorEnv:
    """Return n episodes in one process."""
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
    """Passes the calls of an estimator on and keeps what it was given."""

    def __init__(self, own: Any) -> None:
        """Tap ``own``."""
        self._own = own
        self.resets: list[tuple[Any, ...]] = []
        self.steps: list[tuple[Any, ...]] = []

    def __getattr__(self, name: str) -> Any:
        """Show everything else as it is."""
        return getattr(self._own, name)

    def reset(
        self, episodes: IntArray, states: FloatArray, generators: Sequence[np.random.Generator]
    ) -> None:
        """Keep the generators as they are now: the estimator draws from them."""
        self.resets.append((episodes, states, copy.deepcopy(generators)))
        self._own.reset(episodes, states, generators)

    def predict(self, episodes: IntArray, inputs: FloatArray) -> None:
        """Keep and pass on."""
        self.steps.append((episodes, inputs))
        self._own.predict(episodes, inputs)

    def update(
        self, episodes: IntArray, observed: BoolArray, values: FloatArray, sigma: FloatArray
    ) -> None:
        """Keep and pass on."""
        self.steps[-1] += (observed, values, sigma)
        self._own.update(episodes, observed, values, sigma)


class Kernel:
    """The estimator alone, given exactly what that of an environment was given."""

    def __init__(self, env: SensorQueryVectorEnv) -> None:
        """Build another estimator like that of ``env``, and tap that one."""
        config, process = env.config, env.process
        self.own: Any = make_estimator(
            config.estimator, config.backend, process.model, env.num_envs, config.settings()
        )
        self.tap = process.estimator = Tap(process.estimator)  # type: ignore[assignment]
        self._process = process

    def reset(self) -> None:
        """Follow the environment's resets."""
        for arguments in self.tap.resets:
            self.own.reset(*arguments)
        self.tap.resets.clear()

    def follow(self) -> int:
        """Take the steps that the environment took; return how many episodes' steps."""
        done = 0
        for episodes, inputs, observed, values, sigma in self.tap.steps:
            self.own.predict(episodes, inputs)
            self.own.update(episodes, observed, values, sigma)
            self.own.estimate()
            done += len(episodes)
        self.tap.steps.clear()
        return done

    def check(self) -> None:
        """Stop unless the estimates agree: else the two have not done the same work."""
        mine, its = self.own.estimate(), self._process.estimate
        np.testing.assert_allclose(mine.density, its.density, rtol=1e-9, atol=1e-9)


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

    def step(self, n_steps: int) -> int:
        """Take steps in all episodes; return how many that makes."""
        for _ in range(n_steps):
            self.env.step(self.masks[self.taken % len(self.masks)])
            self.taken += 1
        self.left -= n_steps
        return n_steps * self.n_episodes

    def settle(self, n_steps: int) -> None:
        """Take first steps, then choose how many make a turn."""
        self.step(n_steps)
        start = time.perf_counter()
        self.step(1)
        elapsed = time.perf_counter() - start
        self.turn = int(np.clip(TURN / elapsed, 1, LONGEST_TURN))

    def seconds_of_a_reset(self) -> float:
        """Return what beginning all episodes takes [s], their records in memory already."""
        start = time.perf_counter()
        self.restart(0)
        return time.perf_counter() - start


def first_steps(env_config: Any) -> int:
    """Return after how many steps each step costs the same: the MHE's window is full."""
    full = env_config.estimator == "mhe"
    return env_config.settings().mhe.horizon + 1 if full else 2


def scalar(seconds: float, preset: str, **more: Any) -> Measured:
    """Measure one episode at a time, as `gymnasium.make` gives it."""
    loaded = libraries(preset, **more)
    env = gym.make(env_id(preset), **more)
    config = env.unwrapped.config  # type: ignore[attr-defined]
    masks = queries(LONGEST_TURN, 1, config.corridor.n_mainline, config.bandwidth)[:, 0]
    driver = Driver(env, 1, masks)
    driver.settle(first_steps(config))
    return _measured(driver, {"environment": lambda: driver.step(driver.turn)}, seconds, loaded)


def vector(seconds: float, preset: str, n: int, threads: int, **more: Any) -> Measured:
    """Measure n episodes on one thread, on ``threads``, and the bare estimator on the same."""
    loaded = libraries(preset, **more)
    env = batch(preset, n, 1, **more)
    config = env.config
    masks = queries(LONGEST_TURN // 4, n, config.corridor.n_mainline, config.bandwidth)
    driver = Driver(env, n, masks)
    reset = driver.seconds_of_a_reset()
    kernel = Kernel(env)
    driver.restart(0)
    driver.settle(first_steps(config))
    peak = resident("VmHWM")
    kernel.reset()
    kernel.follow()

    work: dict[str, Callable[[], int]] = {"one thread": lambda: driver.step(driver.turn)}
    drivers = [driver]
    if threads > 1:
        twin = Driver(batch(preset, n, threads, **more), n, masks)
        twin.step(driver.taken)
        drivers.append(twin)
        work["threads"] = lambda: twin.step(driver.turn)
    work["kernel"] = kernel.follow

    def prepare() -> None:
        if driver.left < driver.turn:
            for one in drivers:
                one.restart()
            kernel.reset()

    arms = take_turns(work, seconds, prepare)
    kernel.check()
    return Measured(arms, peak, loaded, {"reset_seconds": reset})


def gymnasium_vector(seconds: float, preset: str, n: int, mode: str, **more: Any) -> Measured:
    """Measure n scalar environments in Gymnasium's ``sync`` or ``async`` vectorisation."""
    loaded = libraries(preset, **more)
    env = gym.make_vec(env_id(preset), num_envs=n, vectorization_mode=mode, **more)
    try:
        masks = queries(LONGEST_TURN, n, env.single_action_space.shape[0], more["bandwidth"])
        driver = Driver(env, n, masks)
        driver.settle(2)
        measured = _measured(
            driver, {"environment": lambda: driver.step(driver.turn)}, seconds, loaded
        )
        workers = multiprocessing.active_children()
        if workers:
            measured.peak = together([worker.pid for worker in workers if worker.pid])
        return measured
    finally:
        env.close()


def _measured(
    driver: Driver, work: dict[str, Callable[[], int]], seconds: float, loaded: float | None
) -> Measured:
    def prepare() -> None:
        if driver.left < driver.turn:
            driver.restart()

    arms = take_turns(work, seconds, prepare)
    return Measured(arms, resident("VmHWM"), loaded)

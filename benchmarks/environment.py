"""Time of an environment's step beside SUMO's second, Gymnasium's vectorisation and sumo-rl.

A step is a second of one episode with the EKF; sumo-rl's takes five seconds, so its time of a
second is a fifth of it.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.turns import Line, Work, compare, make_batch, stepping, take_turns
from dptse_env.config import resolve
from dptse_env.parts import make_task
from dptse_env.release.noise import Noise, NoiseSource
from dptse_env.traffic import RecordLibrary, draw_scenario
from dptse_env.traffic.sumo import running
from dptse_env.traffic.sumo import seconds as seconds_of
from dptse_env.utils.threads import n_cores

PAPER, PRIVATE = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/PrivateHighway-v1"


def measure(*, quick: bool = False) -> list[Line]:
    """Return the lines of all environments; the ratios are to the largest batch on one thread."""
    n, steps, rounds = (2, 2, 2) if quick else (1024, 16, 10)
    keywords = {"traffic_seeds": "0:2" if quick else "0:64", "horizon": 600, "random_start": True}
    with tempfile.TemporaryDirectory() as folder:
        work = {"libsumo alone": simulating(), "recording": recording(Path(folder))}
        if importlib.util.find_spec("sumo_rl"):
            work["sumo-rl, one intersection"] = intersection(quick)
        work["one episode"] = alone(8 if quick else 400, keywords)
        for mode in ("sync", "async"):
            work[f"{mode} vectorisation, 8 episodes"] = gymnasium_vector(
                mode, 8, 4 if quick else 100, keywords
            )
        for size in (64, n):
            batch = make_batch(PAPER, size, **keywords)
            work[f"batch of {size:,}"] = stepping(batch, steps * (4 if size < n else 1))
        if n_cores() > 1:
            batch = make_batch(PAPER, n, threads=None, **keywords)
            work[f"batch of {n:,}, {n_cores()} threads"] = stepping(batch, steps)
        work[f"batch of {n:,}, PrivateHighway"] = stepping(
            make_batch(PRIVATE, n, **keywords), steps
        )
        for source in ("seeded", "secure"):
            work[f"{source} noise, batch of {n:,}, PrivateHighway"] = noise(source, n, steps)
        times = take_turns(work, rounds)
    base = f"batch of {n:,}"
    return compare(times, {name: base for name in times if name != base})


def simulating() -> Work:
    """Return work that simulates a scenario, incident and all, and reads nothing."""
    corridor = resolve("paper-highway", {}).corridor
    scenario = draw_scenario(corridor, 0)

    def turn() -> int:
        with running(corridor, scenario) as libsumo:
            for _ in seconds_of(libsumo, corridor, scenario):
                pass
        return corridor.conditions.duration

    return turn


def recording(folder: Path) -> Work:
    """Return work that records the same scenario to disk, in this process."""
    corridor, libraries = resolve("paper-highway", {}).corridor, count()

    def turn() -> int:
        RecordLibrary(folder / str(next(libraries))).get(corridor, 0)
        return corridor.conditions.duration

    return turn


def intersection(quick: bool) -> Work:
    """Return work that plays an episode of sumo-rl's single intersection, on libsumo."""
    import sumo  # noqa: PLC0415  not always there

    # sumo-rl and traci read both when they are imported.
    os.environ.update(SUMO_HOME=sumo.SUMO_HOME, LIBSUMO_AS_TRACI="1")
    import sumo_rl  # noqa: PLC0415

    nets = Path(sumo_rl.__file__).parent / "nets" / "single-intersection"
    duration, per_step = 60 if quick else 600, 5
    env = gym.make(
        "sumo-rl-v0",
        net_file=str(nets / "single-intersection.net.xml"),
        route_file=str(nets / "single-intersection.rou.xml"),
        delta_time=per_step,
        num_seconds=duration,
        sumo_warnings=False,
    )
    env.action_space.seed(0)

    def turn() -> int:
        env.reset(seed=0)
        steps, over = 0, False
        while not over:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
            steps += 1
        env.close()  # one simulation at a time
        return steps * per_step

    return turn


def alone(n_steps: int, keywords: dict[str, Any]) -> Work:
    """Return work that steps one episode, as `gymnasium.make` gives it."""
    env = gym.make(PAPER, **keywords)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(n_steps)]
    return repeating(env.step, env.reset, actions, 1)


def gymnasium_vector(mode: str, n: int, n_steps: int, keywords: dict[str, Any]) -> Work:
    """Return work that steps scalar environments in Gymnasium's ``sync`` or ``async`` mode."""
    env = gym.make_vec(PAPER, num_envs=n, vectorization_mode=mode, **keywords)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(n_steps)]
    return repeating(env.step, lambda: None, actions, n)


def repeating(
    step: Callable[[Any], Any], reset: Callable[[], object], actions: list[Any], n: int
) -> Work:
    """Return work that takes the same actions in every turn, and resets an episode that is over."""

    def turn() -> int:
        for action in actions:
            *_, truncated, _ = step(action)
            if np.all(truncated):
                reset()
        return len(actions) * n

    return turn


def noise(source: NoiseSource, n: int, n_steps: int) -> Work:
    """Return work that draws the noise of a batch's releases, and adds it."""
    task = make_task(resolve("private-highway", {}))
    shape = n, task.n_channels, 2
    episodes, values, sigma = np.arange(n), np.zeros(shape), np.full(shape, 5.0)
    drawn = Noise(n, task.n_channels, source)
    drawn.reset(episodes, [np.random.default_rng(episode) for episode in range(n)])

    def turn() -> int:
        for _ in range(n_steps):
            drawn.added(episodes, values, sigma, task.channels.length)
        return n * n_steps

    return turn

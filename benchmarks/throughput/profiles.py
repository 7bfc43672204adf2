"""Where the time of a step of many episodes goes, function by function."""

from __future__ import annotations

import cProfile
import pstats
from collections import defaultdict
from pathlib import Path
from typing import Any

from benchmarks.throughput.environments import LONGEST_TURN, Driver, batch, first_steps, libraries
from benchmarks.throughput.measure import Measured, queries, resident, take_turns

MOST = 10  # functions that are named


def profile(seconds: float, preset: str, n: int, **more: Any) -> Measured:
    """Measure n episodes on one thread under Python's profiler; a note is a share of own time."""
    loaded = libraries(preset, **more)
    env = batch(preset, n, 1, **more)
    masks = queries(LONGEST_TURN // 4, n, env.config.corridor.n_mainline, env.config.bandwidth)
    driver = Driver(env, n, masks)
    driver.settle(first_steps(env.config))
    profiler = cProfile.Profile()

    def turn() -> int:
        with profiler:
            return driver.step(driver.turn)

    def prepare() -> None:
        if driver.left < driver.turn:
            driver.restart()

    arms = take_turns({"profiled": turn}, seconds, prepare)
    own: dict[str, float] = defaultdict(float)
    # Not get_stats_profile(), which keeps one function of each name.
    for (file, _, name), figures in pstats.Stats(profiler).stats.items():  # type: ignore[attr-defined]
        own[f"{Path(file).stem}.{name}"] += figures[2]
    total = sum(own.values())
    most = sorted(own, key=lambda name: -own[name])[:MOST]
    return Measured(arms, resident("VmHWM"), loaded, {name: own[name] / total for name in most})

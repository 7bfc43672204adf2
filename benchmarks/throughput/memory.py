"""Memory of many episodes over many records, and its growth."""

from __future__ import annotations

import time
from typing import Any

from benchmarks.throughput.environments import libraries, make_batch, make_driver
from benchmarks.throughput.measure import Measured, Samples, resident

SHORT = 10  # [s] of an episode, so that ten thousand of them pass soon


def memory(_seconds: float, preset: str, n: int, n_episodes: int, **more: Any) -> Measured:
    """Measure the resident memory while ``n_episodes`` short episodes pass, n at a time."""
    loaded = libraries(preset, **more)
    env = make_batch(preset, n, 1, **{**more, "horizon": SHORT})
    driver, marks = make_driver(env), []
    start = time.perf_counter()
    while n * len(marks) < n_episodes:
        driver.restart()
        driver.step(SHORT)
        marks.append(resident())
    rate = driver.taken * n / (time.perf_counter() - start)
    records = len(env.config.traffic_seeds)
    notes = {"episodes": float(n * len(marks)), "records": float(records)}
    # All but a few in ten thousand of the records have been drawn by the third batch.
    early, late = marks[min(2, len(marks) - 1)], marks[-1]
    if early is not None and late is not None:
        notes |= {"early": early, "late": late}
    return Measured({"environment": Samples([rate])}, resident("VmHWM"), loaded, notes)

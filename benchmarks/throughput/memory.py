"""Whether many episodes over many records stay small, and stay so."""

from __future__ import annotations

import time
from typing import Any

from benchmarks.throughput.environments import batch, libraries
from benchmarks.throughput.measure import Measured, Samples, queries, resident

SHORT = 10  # [s] of an episode, so that ten thousand of them pass soon


def memory(_seconds: float, preset: str, n: int, n_episodes: int, **more: Any) -> Measured:
    """Measure what stays resident while ``n_episodes`` short episodes pass, n at a time."""
    loaded = libraries(preset, **more)
    env = batch(preset, n, 1, **{**more, "horizon": SHORT})
    masks = queries(SHORT, n, env.config.corridor.n_mainline, env.config.bandwidth)
    env.reset(seed=0)
    ended, taken, marks = 0, 0, []
    start = time.perf_counter()
    while ended < n_episodes:
        *_, truncated, _ = env.step(masks[taken % len(masks)])
        taken += 1
        if truncated.all():
            ended += n
            marks.append(resident())
    rate = taken * n / (time.perf_counter() - start)
    notes = {"episodes": float(ended), "records": float(len(env.config.traffic_seeds))}
    # All but a few in ten thousand of the records have been drawn by the third batch.
    early, late = marks[min(2, len(marks) - 1)], marks[-1]
    if early is not None and late is not None:
        notes |= {"early": early, "late": late}
    return Measured({"environment": Samples([rate])}, resident("VmHWM"), loaded, notes)

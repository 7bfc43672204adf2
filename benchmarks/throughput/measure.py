"""How work is timed: in turns, each turn a sample of its rate; and how memory is read."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass
class Samples:
    """What the turns of one kind of work gave.

    Attributes:
        rates: Units a second, one per turn.
        cores: CPU seconds a second of this process, over all turns; None if not measured.
    """

    rates: list[float]
    cores: float | None = None


@dataclass
class Measured:
    """What one child process reports.

    Attributes:
        arms: Samples by the name of the work.
        peak: Most memory that was resident [MiB]; None where the system does not tell.
        libraries: What was resident once libraries were loaded and one step was taken [MiB].
        notes: Further figures by name.
    """

    arms: dict[str, Samples]
    peak: float | None = None
    libraries: float | None = None
    notes: dict[str, float] = field(default_factory=dict)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Measured:
        """Read what `dataclasses.asdict` wrote."""
        arms = {name: Samples(**samples) for name, samples in plain["arms"].items()}
        return cls(arms, plain["peak"], plain["libraries"], plain["notes"])


def take_turns(
    work: Mapping[str, Callable[[], int]],
    seconds: float,
    prepare: Callable[[], None] = lambda: None,
    least: int = 3,
) -> dict[str, Samples]:
    """Let each kind of work have its turn, again and again, so that all meet the same weather.

    Args:
        work: What to call by name; it returns how many units it did.
        seconds: Time to fill [s]; every kind has ``least`` turns all the same.
        prepare: Called ahead of every round, off the clock.
        least: Turns of each kind at least.
    """
    rates: dict[str, list[float]] = {name: [] for name in work}
    busy, passed = dict.fromkeys(work, 0.0), dict.fromkeys(work, 0.0)
    end, turns = time.perf_counter() + seconds, 0
    while turns < least or time.perf_counter() < end:
        prepare()
        for name, run in work.items():
            cpu, start = time.process_time(), time.perf_counter()
            done = run()
            elapsed = time.perf_counter() - start
            busy[name] += time.process_time() - cpu
            passed[name] += elapsed
            rates[name].append(done / elapsed)
        turns += 1
    return {name: Samples(rates[name], busy[name] / passed[name]) for name in work}


def resident(field_name: str = "VmRSS") -> float | None:
    """Return the memory of this process [MiB] as Linux tells it; ``VmHWM`` is its peak."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    (line,) = [line for line in status.read_text().splitlines() if line.startswith(field_name)]
    return int(line.split()[1]) / 1024


def together(workers: list[int]) -> float | None:
    """Return the memory of this process and what workers have beside it [MiB]."""
    total = resident()
    for pid in workers:
        rollup = Path(f"/proc/{pid}/smaps_rollup")
        if total is None or not rollup.exists():
            return None
        for line in rollup.read_text().splitlines():
            if line.startswith("Private_"):
                total += int(line.split()[1]) / 1024
    return total


def queries(n_steps: int, n_episodes: int, n_segments: int, n_queried: int) -> np.ndarray:
    """Return random masks of ``n_queried`` segments each, shape (K, n, n_segments)."""
    scores = np.random.default_rng(0).random((n_steps, n_episodes, n_segments))
    return (scores.argsort(axis=-1) < n_queried).astype(np.int8)

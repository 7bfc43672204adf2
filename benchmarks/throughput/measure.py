"""Timing of work in turns, each turn a sample of its rate; and the memory of processes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass
class Samples:
    """Samples of the rate of one kind of work.

    Attributes:
        rates: Units a second in each turn.
        cores: CPU seconds a second of this process, over all turns; None if not measured.
    """

    rates: list[float]
    cores: float | None = None


@dataclass
class Measured:
    """The report of one child process.

    Attributes:
        arms: Samples by the name of the work.
        peak: Largest resident memory [MiB]; None where the system does not tell.
        libraries: Resident memory once libraries were loaded and one step was taken [MiB].
        notes: Further figures by name.
    """

    arms: dict[str, Samples]
    peak: float | None = None
    libraries: float | None = None
    notes: dict[str, float] = field(default_factory=dict)

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Measured:
        """Read the output of `dataclasses.asdict`."""
        arms = {name: Samples(**samples) for name, samples in plain["arms"].items()}
        return cls(**{**plain, "arms": arms})


def take_turns(
    work: Mapping[str, Callable[[], int]],
    seconds: float,
    prepare: Callable[[], object] = lambda: None,
    least: int = 3,
) -> dict[str, Samples]:
    """Let each kind of work have its turn, again and again, so that all meet the same weather.

    Args:
        work: Functions to call by name; each returns the number of units that it did.
        seconds: Time to fill [s].
        prepare: Called ahead of every round, off the clock.
        least: Least number of turns of each kind.
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
    """Return the memory of this process [MiB] on Linux; ``VmHWM`` is its peak."""
    return _mebibytes(Path("/proc/self/status"), field_name)


def together(workers: list[int]) -> float | None:
    """Return the memory of this process and the private memory of its workers [MiB]."""
    sizes = [_mebibytes(Path(f"/proc/{pid}/smaps_rollup"), "Private_") for pid in workers]
    known = [size for size in (resident(), *sizes) if size is not None]
    return sum(known) if len(known) == 1 + len(workers) else None


def _mebibytes(path: Path, start: str) -> float | None:
    """Return the sum of some lines of a file of Linux [MiB]; None if there is no such file."""
    if not path.exists():
        return None
    lines = path.read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(start)) / 1024


def queries(n_steps: int, n_episodes: int, n_segments: int, n_queried: int) -> np.ndarray:
    """Return random masks of ``n_queried`` segments each, shape (K, n, n_segments)."""
    scores = np.random.default_rng(0).random((n_steps, n_episodes, n_segments))
    return (scores.argsort(axis=-1) < n_queried).astype(np.int8)

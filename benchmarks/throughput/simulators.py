"""SUMO at work: bare, and while this package records it."""

from __future__ import annotations

import resource
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from benchmarks.throughput.measure import Measured, resident, take_turns
from dptse_env.config import resolve
from dptse_env.traffic import Corridor, RecordLibrary, draw_scenario
from dptse_env.traffic.sumo import running
from dptse_env.traffic.sumo import seconds as seconds_of


def bare(corridor: Corridor, seed: int) -> None:
    """Run the scenario that would be recorded, incident and all, and read nothing."""
    scenario = draw_scenario(corridor, seed)
    with running(corridor, scenario) as libsumo:
        for _ in seconds_of(libsumo, corridor, scenario):
            pass


@contextmanager
def empty_libraries() -> Iterator[Iterator[RecordLibrary]]:
    """Yield any number of libraries without a record, in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        yield (RecordLibrary(Path(folder) / str(k)) for k in count())


def recording(seconds: float, preset: str, traffic_seeds: str) -> Measured:
    """Measure bare libsumo and the same scenarios recorded to disk, in this process."""
    config = resolve(preset, {"traffic_seeds": traffic_seeds})
    corridor, seeds = config.corridor, config.traffic_seeds
    bare(corridor, seeds[0])
    loaded = resident()

    def each(run: Callable[[Corridor, int], object]) -> int:
        for seed in seeds:
            run(corridor, seed)
        return len(seeds) * corridor.duration

    with empty_libraries() as libraries:
        work = {"bare": lambda: each(bare), "recording": lambda: each(next(libraries).get)}
        arms = take_turns(work, seconds)
    return Measured(arms, resident("VmHWM"), loaded)


def processes(seconds: float, preset: str, traffic_seeds: str, workers: int) -> Measured:
    """Measure recording many scenarios in one child process and in several, start included."""
    config = resolve(preset, {"traffic_seeds": traffic_seeds})
    corridor, seeds = config.corridor, config.traffic_seeds
    with empty_libraries() as libraries:

        def record(n: int) -> int:
            next(libraries).ensure(corridor, seeds, workers=n)
            return len(seeds) * corridor.duration

        work = {"one": lambda: record(1), "several": lambda: record(workers)}
        arms = take_turns(work, seconds, least=1)
    # The largest child, in KiB on Linux.
    return Measured(arms, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)

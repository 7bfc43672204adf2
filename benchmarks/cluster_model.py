"""A discrete-event simulation of a job on a cluster, from measured times.

One driver hands out tasks and takes results, one at a time; every worker imports the package before
its first task and then runs one task after another. Nodes share nothing else, so that what is left
out is contention for the network, and for disks other than the driver's.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class JobTimes:
    """Measured times of a job.

    Attributes:
        tasks: Times that a worker took for single tasks [s].
        submit: Time in which the driver hands out a task [s].
        receive: Time in which the driver takes a result and puts it on disk [s].
        start: Time from the start of a worker to its first task [s].
    """

    tasks: Sequence[float]
    submit: float
    receive: float
    start: float


@dataclass(frozen=True)
class Outcome:
    """A simulated job.

    Attributes:
        seconds: From the first task handed out to the last result on disk.
        busy: Part of the workers' time that went into tasks.
        driver: Part of the time in which the driver was busy.
    """

    seconds: float
    busy: float
    driver: float


def simulate(times: JobTimes, n_tasks: int, n_workers: int, seed: int = 0) -> Outcome:
    """Simulate a job.

    Args:
        times: Of its parts; the length of each task is drawn from those that were measured.
        n_tasks: Number of tasks.
        n_workers: Number of workers.
        seed: Seeds the draws.
    """
    generator = np.random.default_rng(seed)
    lengths = generator.choice(np.asarray(times.tasks), size=n_tasks)
    ahead = 2 * n_workers  # as `agents.engines.engine.run_tasks` does
    clock = worked = driven = 0.0
    free = [(times.start, worker) for worker in range(n_workers)]
    heapq.heapify(free)
    ended: list[float] = []
    submitted = received = 0
    while received < n_tasks:
        if submitted < n_tasks and submitted - received < ahead:
            clock += times.submit
            driven += times.submit
            ready, worker = heapq.heappop(free)
            end = max(ready, clock) + lengths[submitted]
            heapq.heappush(free, (end, worker))
            heapq.heappush(ended, end)
            worked += lengths[submitted]
            submitted += 1
            # Results that have come meanwhile are taken before the next task is handed out.
            if not ended or ended[0] > clock:
                continue
        clock = max(clock, heapq.heappop(ended)) + times.receive
        driven += times.receive
        received += 1
    return Outcome(clock, worked / (n_workers * clock), driven / clock)

"""A job of episodes that meets with faults, and a driver that runs it.

python -m tests.agents.engines.jobs ADDRESS FOLDER [FAULT]
"""

import dataclasses
import os
import sys
import time
from pathlib import Path

import numpy as np

from agents.engines.local import THIS_PROCESS
from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.runner import EpisodeTask, Workplace, run_task
from agents.experiments.tasks import run_all
from agents.studies.paper.plan import PaperCell
from dptse_env.config import resolve

SHORT = "dptse_env:dptse/ShortHighway-v0"
CORRIDOR = resolve("short-highway", {}).corridor
SEEDS = (2000, 2001)
CELLS = [
    PaperCell("random_walk", "w99-3lane", "paper", epsilon, 0.05, bandwidth)
    for epsilon in (0.5, 1.0, 2.0, 4.0)
    for bandwidth in (1, 2, 3)
]


BIG = 6 * 2**20
"""Numbers in a big result."""


@dataclasses.dataclass(frozen=True)
class FaultyTask:
    """An episode task, a fault that befalls it, and a folder in which it leaves traces."""

    task: EpisodeTask
    fault: str
    traces: Path

    @property
    def cell(self):
        return self.task.cell

    @property
    def seeds(self):
        return self.task.seeds


def run_faulty(faulty):
    """Run a task; at the first attempt its fault befalls it."""
    first = faulty.traces / f"{faulty.cell.epsilon}-{faulty.cell.bandwidth}"
    is_first = not first.exists()
    first.touch()
    if is_first and faulty.cell.epsilon == 1.0:
        befall(faulty.fault)
    if faulty.fault == "slow":
        time.sleep(1.0)
    leave_trace(faulty.traces)
    return run_task(faulty.task)


def befall(fault):
    if fault == "killed":
        os.kill(os.getpid(), 9)
    if fault == "memory":
        # Grows until it is killed; far less than the machine has.
        grown = []
        for _ in range(400):
            grown.append(np.ones(2**21))  # 16 MiB
            time.sleep(0.02)
        time.sleep(60)
        raise AssertionError("the worker was not killed")


def leave_trace(traces):
    """Note on which node a task ran."""
    import ray

    if ray.is_initialized():
        (traces / f"node-{ray.get_runtime_context().get_node_id()}").touch()


def nodes(traces):
    return {path.name for path in traces.glob("node-*")}


def big(number):
    """Return 48 MiB that tell from which number they are."""
    return np.full(BIG, float(number))


def run_job(engine, folder, fault="none", cells=CELLS):
    """Run the cells that the ledger in a folder lacks; return its bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    place = Workplace(folder, engine)
    place.record(CORRIDOR, SEEDS)
    ledger = Ledger(folder / "episodes.csv", PaperCell, EpisodeScore)
    tasks = [
        FaultyTask(
            EpisodeTask(SHORT, "paper", cell, cell.keywords, SEEDS, place.records), fault, folder
        )
        for cell in cells
        if ledger.lacking(cell, SEEDS)
    ]
    run_all(tasks, ledger, engine, run_faulty, progress=False)
    return ledger.path.read_bytes()


def undisturbed(folder):
    return run_job(THIS_PROCESS, folder)


if __name__ == "__main__":
    from agents.engines.ray_cluster import RayCluster

    run_job(RayCluster(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])

"""Time one and two workers of each engine on recording and on evaluation, and their overheads.

python benchmarks/bench_engines.py --output results/scaling

Pairs of measurements alternate between one and two workers, which have imported the package before
they are timed. From the times of single tasks a simulation tells what many machines would give; its
figures are labelled as such.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import pickle
import resource
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("RAY_AUTH_MODE", "disabled")

import ray
from ray.cluster_utils import Cluster

from agents.engines.engine import Engine, Workers, run_tasks
from agents.engines.local import LocalProcesses
from agents.engines.ray_cluster import RayCluster
from agents.evaluation.ladder import Rung, run_rung
from agents.experiments.provenance import machine
from agents.files import write_json
from agents.policies import find_policy
from benchmarks.cluster_model import JobTimes, simulate
from dptse_env.config import resolve
from dptse_env.traffic import Corridor, RecordLibrary
from dptse_env.traffic.stored_arrays import pack, unpack

ENV = "dptse_env:dptse/PrivateHighway-v1"
CORRIDOR = resolve("private-highway-v1", {}).corridor
SEEDS = tuple(range(2000, 2008))
CORES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1000)


@dataclass(frozen=True)
class Timed:
    """A task that tells how long it took."""

    work: Callable[[Any], Any]
    task: Any


def run_timed(timed: Timed) -> tuple[float, int]:
    """Run a task; return its time [s] and the bytes of its result."""
    start = time.perf_counter()
    result = timed.work(timed.task)
    return time.perf_counter() - start, len(pickle.dumps(result))


def record(task: tuple[Corridor, int]) -> bytes:
    """Make a record in a folder of its own, and return its archive, as another machine would."""
    with tempfile.TemporaryDirectory() as folder:
        library = RecordLibrary(folder)
        library.ensure(task[0], [task[1]], workers=1)
        return pack(library.record_path(*task))


def nothing(number: int) -> int:
    """Do nothing, as a task whose overhead is all that it takes."""
    return number


def recording_tasks(n: int) -> list[Timed]:
    """Return tasks that record."""
    return [Timed(record, (CORRIDOR, 500 + seed)) for seed in range(n)]


def evaluation_tasks(n: int) -> list[Timed]:
    """Return tasks that evaluate a schedule on eight traffic seeds each."""
    keywords = {"traffic_seeds": list(SEEDS), "threads": 1}
    source = find_policy("round-robin")
    return [
        Timed(run_rung, Rung(("ekf", str(k)), source, ENV, keywords, SEEDS, noise_seed=k))
        for k in range(n)
    ]


@dataclass
class Opened:
    """An engine whose workers stay open, so that they have the package imported when timed."""

    engine: Engine
    workers: Workers
    is_parallel: bool = True

    @contextlib.contextmanager
    def open(self) -> Iterator[Workers]:
        """Give the workers that are open."""
        yield self.workers


@contextlib.contextmanager
def local(n: int) -> Iterator[Opened]:
    """Give n processes of this machine."""
    engine = LocalProcesses(n)
    with engine.open() as workers:
        yield Opened(engine, workers)


@contextlib.contextmanager
def on_ray(n: int) -> Iterator[Opened]:
    """Give a node of n processors beside a head without any."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    cluster.add_node(num_cpus=n)
    try:
        engine = RayCluster(cluster.address)
        with engine.open() as workers:
            yield Opened(engine, workers)
    finally:
        ray.shutdown()
        cluster.shutdown()


def measure(opened: Opened, tasks: Sequence[Timed]) -> tuple[float, list[tuple[float, int]]]:
    """Return the time of all tasks [s], and time and bytes of each."""
    start = time.perf_counter()
    results = [result for _, result in run_tasks(opened, run_timed, tasks)]
    return time.perf_counter() - start, results


def overhead(opened: Opened, n: int) -> tuple[float, list[float]]:
    """Return the time of an empty task [s], and the driver's memory [MB] as they go by."""
    memory = []
    start = time.perf_counter()
    for done, _ in enumerate(run_tasks(opened, nothing, range(n)), start=1):
        if done % (n // 5) == 0:
            memory.append(resident())
    return (time.perf_counter() - start) / n, memory


def resident() -> float:
    """Return the memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def pairs(open_engine: Callable[[int], Any], repeats: int, n_tasks: int) -> dict[str, Any]:
    """Time both jobs with one and with two workers by turns."""
    jobs = {"recording": recording_tasks(n_tasks), "evaluation": evaluation_tasks(n_tasks)}
    seconds: dict[str, dict[int, list[float]]] = {name: {1: [], 2: []} for name in jobs}
    single: dict[str, list[float]] = {name: [] for name in jobs}
    size = dict.fromkeys(jobs, 0)
    for _ in range(repeats):
        for n in (1, 2):
            with open_engine(n) as opened:
                for tasks in jobs.values():
                    measure(opened, tasks[: 2 * n])  # imports the package, loads kernels
                for name, tasks in jobs.items():
                    total, results = measure(opened, tasks)
                    seconds[name][n].append(total)
                    if n == 1:
                        single[name] += [each for each, _ in results]
                    size[name] = max(bytes_ for _, bytes_ in results)
    return {
        name: {
            "tasks_a_second": {
                str(n): statistics.median(n_tasks / each for each in seconds[name][n])
                for n in (1, 2)
            },
            "ratios": [one / two for one, two in zip(*seconds[name].values(), strict=True)],
            "task_seconds": single[name],
            "bytes": size[name],
        }
        for name in jobs
    }


def times_of_the_driver(archive: bytes, repeats: int = 50) -> float:
    """Return the time to put a record on disk [s]."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        for k in range(repeats):
            unpack(archive, Path(folder) / str(k))
        return (time.perf_counter() - start) / repeats


def main() -> None:
    """Measure, simulate, and leave a JSON file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--tasks", type=int, default=12)
    parser.add_argument("--empty", type=int, default=10_000)
    parser.add_argument("--output", type=Path, default=Path("results/scaling"))
    args = parser.parse_args()
    RecordLibrary().ensure(CORRIDOR, SEEDS)
    found: dict[str, Any] = {"machine": machine(("dptse-env", "numpy", "ray"))}
    for name, open_engine in (("local", local), ("ray", on_ray)):
        found[name] = pairs(open_engine, args.repeats, args.tasks)
        for job, values in found[name].items():
            print(f"{name} {job}: {statistics.median(values['ratios']):.2f} times", flush=True)
    with on_ray(2) as opened:
        start = time.perf_counter()
        measure(opened, evaluation_tasks(2))
        found["start"] = time.perf_counter() - start
        found["empty_task"], found["driver_memory"] = overhead(opened, args.empty)
    on_disk = times_of_the_driver(record((CORRIDOR, 500)))
    found["record_on_disk"] = on_disk
    jobs = {
        "recording": JobTimes(
            found["ray"]["recording"]["task_seconds"], found["empty_task"], on_disk, found["start"]
        ),
        "evaluation": JobTimes(
            found["ray"]["evaluation"]["task_seconds"], found["empty_task"], 1e-3, found["start"]
        ),
    }
    found["simulated"] = {
        job: {
            str(n): {"speedup": base.seconds / each.seconds, **asdict(each)}
            for n in CORES
            for each in [simulate(times, 100_000, n)]
            for base in [simulate(times, 100_000, 1)]
        }
        for job, times in jobs.items()
    }
    args.output.mkdir(parents=True, exist_ok=True)
    write_json(args.output / "engines.json", json.loads(json.dumps(found)))
    print(f"written to {args.output / 'engines.json'}")


if __name__ == "__main__":
    main()

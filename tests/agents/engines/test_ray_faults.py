"""Faults of a cluster: each job ends with the results of an undisturbed run."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from agents.engines.engine import run_tasks
from dptse_env.traffic import RecordLibrary
from dptse_env.traffic.library import CACHE_VARIABLE
from tests.agents.engines.jobs import BIG, CORRIDOR, SEEDS, big, nodes, run_job, undisturbed

pytestmark = [
    pytest.mark.ray,
    pytest.mark.slow,
    # Ray leaves sockets and files to its own shutdown.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="session")
def expected(tmp_path_factory):
    return undisturbed(tmp_path_factory.mktemp("undisturbed"))


@pytest.fixture
def engine_on(cluster):
    """Return a function that adds nodes with a processor each, and connects to the cluster."""
    from agents.engines.ray_cluster import RayCluster

    def connect(n, **options):
        for _ in range(n):
            cluster.add_node(num_cpus=1, **options)
        return RayCluster(cluster.address)

    return connect


def wait_until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def start_driver(cluster, folder, fault):
    command = [sys.executable, "-m", "tests.agents.engines.jobs", cluster.address, str(folder)]
    return subprocess.Popen([*command, fault], cwd=ROOT)


def test_a_killed_worker(engine_on, tmp_path, expected):
    assert run_job(engine_on(2), tmp_path, "killed") == expected


def while_running(engine, folder, disturb):
    """Run the job in a thread, and disturb it meanwhile; return what it leaves."""
    found = []
    thread = threading.Thread(target=lambda: found.append(run_job(engine, folder, "slow")))
    thread.start()
    disturb()  # here, as Ray starts and ends nodes in the main thread alone
    thread.join()
    return found[0]


def test_a_removed_node(cluster, engine_on, tmp_path, expected):
    engine = engine_on(1)
    leaving = cluster.add_node(num_cpus=1)

    def remove():
        wait_until(lambda: len(nodes(tmp_path)) == 2)
        cluster.remove_node(leaving, allow_graceful=False)

    assert while_running(engine, tmp_path, remove) == expected


def test_a_node_that_joins_late(cluster, engine_on, tmp_path, expected):
    engine = engine_on(1)

    def join():
        wait_until(lambda: nodes(tmp_path))
        cluster.add_node(num_cpus=1)

    assert while_running(engine, tmp_path, join) == expected
    assert len(nodes(tmp_path)) == 2


def test_a_killed_driver_goes_on(cluster, tmp_path, expected):
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    ledger = tmp_path / "episodes.csv"
    driver = start_driver(cluster, tmp_path, "slow")
    wait_until(lambda: ledger.exists() and ledger.read_bytes().count(b"\n") >= 5)
    driver.kill()
    driver.wait()
    done = ledger.read_bytes()
    assert 5 <= done.count(b"\n") < expected.count(b"\n")
    assert start_driver(cluster, tmp_path, "slow").wait() == 0
    assert ledger.read_bytes() == expected


def test_a_task_that_runs_out_of_memory(ray, monkeypatch, tmp_path, expected):
    from ray._common.utils import get_system_memory
    from ray._private.utils import get_used_memory
    from ray.cluster_utils import Cluster

    from agents.engines.ray_cluster import RayCluster

    # A node kills its greediest worker when the machine uses 2 GiB more than now.
    threshold = (get_used_memory() + 2**31) / get_system_memory()
    settings = {"memory_usage_threshold": threshold, "memory_monitor_refresh_ms": 100}
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 2, "_system_config": settings}
    )
    try:
        assert run_job(RayCluster(cluster.address), tmp_path, "memory") == expected
    finally:
        ray.shutdown()
        cluster.shutdown()


def test_an_object_store_that_spills(cluster, tmp_path):
    from agents.engines.ray_cluster import RayCluster

    # The results that wait for the driver are more than their node's store can hold.
    cluster.add_node(
        num_cpus=2, object_store_memory=80 * 2**20, object_spilling_directory=str(tmp_path)
    )
    engine, sums, has_spilled = RayCluster(cluster.address), {}, False
    for number, array in run_tasks(engine, big, range(12)):
        time.sleep(0.2)
        has_spilled |= any(path.is_file() for path in tmp_path.rglob("*"))
        sums[number] = float(array.sum())
    assert sums == {number: float(number * BIG) for number in range(12)}
    assert has_spilled


def test_two_drivers_on_one_library(cluster, tmp_path, monkeypatch, expected):
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "library"))
    drivers = [start_driver(cluster, tmp_path / name, "none") for name in ("one", "other")]
    assert [driver.wait() for driver in drivers] == [0, 0]
    for name in ("one", "other"):
        assert (tmp_path / name / "episodes.csv").read_bytes() == expected
    library = RecordLibrary(tmp_path / "library")
    assert library.missing(CORRIDOR, SEEDS) == []
    folder = library.record_path(CORRIDOR, SEEDS[0]).parent
    assert sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) == [
        f"{seed:08d}" for seed in SEEDS
    ]
    assert np.isfinite(library.get(CORRIDOR, SEEDS[0]).speed).all()
    assert os.environ[CACHE_VARIABLE] == str(library.path)

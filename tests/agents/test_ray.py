"""Ray clusters of several nodes on this machine, and their faults."""

import contextlib
import http.server
import operator
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from agents.executors import ExecutorError, make_executor, run_in_order
from agents.study import Place, run
from dptse_env.traffic.library import CACHE_VARIABLE
from tests.agents.faults import TRACES, rows_of, study
from tests.helpers import ROOT, wait_for

pytestmark = [pytest.mark.ray, pytest.mark.slow]


@pytest.fixture(scope="session")
def ray():
    """Ray, if it is installed; its clusters are of this machine alone and ask for no token."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "disabled")
        patch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
        yield pytest.importorskip("ray")


@pytest.fixture
def cluster(ray):
    """A cluster without nodes but its head, which runs no task; the driver runs there."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    yield made
    with contextlib.suppress(Exception):
        ray.shutdown()
    made.shutdown()


def add_nodes(cluster, traces, n):
    for _ in range(n):
        cluster.add_node(num_cpus=1, env_vars={TRACES: str(traces)})


def raise_type(kind):
    raise kind("as it is")


def read(path):
    return Path(path).read_bytes()


def test_errors_are_those_of_the_task(cluster, tmp_path):
    cluster.add_node(num_cpus=2)
    executor = make_executor("ray", 1, cluster.address)
    assert run_in_order(executor, operator.neg, range(20)) == [-k for k in range(20)]
    with pytest.raises(KeyError, match="as it is"):
        run_in_order(executor, raise_type, [KeyError])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        run_in_order(executor, read, [str(tmp_path / "nowhere")])
    with pytest.raises(ExecutorError, match="a task was lost 4 times"):
        run_in_order(executor, os._exit, [1])
    assert run_in_order(executor, abs, [-1]) == [1]


def test_nodes_make_the_records_that_they_lack(cluster, tmp_path, expected):
    for k in (1, 2):
        cluster.add_node(num_cpus=1, env_vars={CACHE_VARIABLE: str(tmp_path / f"cache-{k}")})
    run(study(), Place(tmp_path, make_executor("ray", 1, cluster.address)))
    assert rows_of(tmp_path).equals(expected)
    for k in (1, 2):
        records = (tmp_path / f"cache-{k}").glob("*/*/0*.safetensors")
        assert sorted(path.stem for path in records) == ["00002000", "00002001"]


def test_a_removed_node(cluster, traces, tmp_path, expected):
    add_nodes(cluster, traces, 1)
    leaving = cluster.add_node(num_cpus=1, env_vars={TRACES: str(traces)})
    executor = make_executor("ray", 1, cluster.address)
    job = threading.Thread(target=run, args=(study(), Place(tmp_path, executor)))
    job.start()
    # Here, as Ray starts and ends nodes in the main thread alone.
    wait_for(lambda: len(list(traces.glob("played-*"))) >= 2)
    cluster.remove_node(leaving, allow_graceful=False)
    job.join()
    assert rows_of(tmp_path).equals(expected)


def test_a_killed_driver_goes_on(cluster, traces, tmp_path, expected):
    add_nodes(cluster, traces, 2)
    command = [sys.executable, "-m", "tests.agents.faults", str(tmp_path), cluster.address]
    driver = subprocess.Popen(command, cwd=ROOT)
    wait_for(lambda: len(list((tmp_path / "rows").glob("*.parquet"))) >= 2)
    driver.kill()
    driver.wait()
    assert not (tmp_path / "rows.parquet").exists()
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0
    assert (traces / "killed").exists()  # a worker too, whose task was run again
    assert rows_of(tmp_path).equals(expected)


def test_an_address_without_a_cluster_is_an_error(ray):
    with http.server.HTTPServer(("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        for address in (f"127.0.0.1:{other.server_port}", "127.0.0.1:9", "127.0.0.1"):
            with pytest.raises(ExecutorError, match=f"no Ray cluster answers at {address}:"):
                make_executor("ray", 1, address)
        other.shutdown()

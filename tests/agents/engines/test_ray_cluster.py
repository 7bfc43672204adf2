import http.server
import operator
import os
import socket
import threading
import time
from pathlib import Path

import pytest

from agents.engines.engine import EngineError, run_tasks
from agents.engines.local import LocalProcesses
from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.experiments.runner import EpisodeTask, Workplace, run_task
from agents.experiments.tasks import run_all
from agents.studies.paper.plan import PaperCell
from dptse_env.config import resolve
from dptse_env.traffic import RecordingError, RecordLibrary
from dptse_env.traffic.library import CACHE_VARIABLE

pytestmark = [
    pytest.mark.ray,
    # Ray leaves sockets and files to its own shutdown.
    pytest.mark.filterwarnings(
        "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
    ),
]

SHORT = "dptse_env:dptse/ShortHighway-v0"
CORRIDOR = resolve("short-highway", {}).corridor
SEEDS = (2000, 2001)
CELLS = [
    PaperCell(estimator, "w99-3lane", "paper", 1.0, 0.05, bandwidth)
    for estimator in ("ekf", "random_walk")
    for bandwidth in (1, 2)
]


@pytest.fixture
def two_nodes(cluster, tmp_path):
    """Two nodes with a processor and a record cache each, and the engine on them."""
    from agents.engines.ray_cluster import RayCluster

    for k in (1, 2):
        cluster.add_node(num_cpus=1, env_vars={CACHE_VARIABLE: str(tmp_path / f"cache-{k}")})
    return RayCluster(cluster.address)


def tasks(records):
    return [EpisodeTask(SHORT, "paper", cell, cell.keywords, SEEDS, records) for cell in CELLS]


def ledger(path):
    return Ledger(path, PaperCell, EpisodeScore)


def records_of(folder):
    return sorted(path.name for path in Path(folder).glob("*/*/0*"))


def raise_type(kind):
    raise kind("as it is")


def read(path):
    return Path(path).read_bytes()


def test_results_are_those_of_one_machine_and_records_travel(two_nodes, tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "home"))
    place = Workplace(tmp_path, two_nodes)
    place.record(CORRIDOR, SEEDS)
    assert records_of(tmp_path / "home") == ["00002000", "00002001"]
    there = ledger(tmp_path / "there.csv")
    run_all(tasks(place.records), there, two_nodes, run_task, progress=False)
    here = ledger(tmp_path / "here.csv")
    run_all(tasks(None), here, LocalProcesses(1), run_task, progress=False)
    assert there.path.read_bytes() == here.path.read_bytes()
    # Both nodes have been at work, each with the records that it was brought.
    for k in (1, 2):
        assert records_of(tmp_path / f"cache-{k}") == ["00002000", "00002001"]
    fresh = RecordLibrary(tmp_path / "again")
    fresh.ensure(CORRIDOR, SEEDS, workers=1)
    for seed in SEEDS:
        pair = [
            {each.name: each.read_bytes() for each in home.record_path(CORRIDOR, seed).iterdir()}
            for home in (fresh, RecordLibrary(tmp_path / "cache-1"))
        ]
        assert pair[0] == pair[1]


def test_errors_are_those_of_the_task(two_nodes, tmp_path):
    assert dict(run_tasks(two_nodes, operator.neg, range(20))) == {k: -k for k in range(20)}
    with pytest.raises(KeyError, match="as it is"):
        list(run_tasks(two_nodes, raise_type, [KeyError]))
    with pytest.raises(FileNotFoundError, match=r"^on node \S+: .*nowhere"):
        list(run_tasks(two_nodes, read, [str(tmp_path / "nowhere")]))
    # A worker that dies every time is given up, and the next tasks run.
    with pytest.raises(EngineError, match="a task was lost 4 times"):
        list(run_tasks(two_nodes, os._exit, [1]))
    assert list(run_tasks(two_nodes, abs, [-1])) == [(-1, 1)]


def test_a_cache_that_a_node_cannot_write_is_an_error_that_names_the_node(cluster, tmp_path):
    from agents.engines.ray_cluster import RayCluster

    (tmp_path / "file").write_text("in the way")
    cluster.add_node(num_cpus=1, env_vars={CACHE_VARIABLE: str(tmp_path / "file")})
    engine = RayCluster(cluster.address)
    home = RecordLibrary(tmp_path / "home")
    place = Workplace(tmp_path, engine)
    with pytest.raises(RecordingError, match=r"on node \S+: the library at .*file"):
        engine.record(RecordLibrary(), CORRIDOR, [0], progress=False)
    with pytest.raises(OSError, match=r"on node \S+: .*file"):
        list(run_tasks(engine, run_task, tasks(place.records)[:1]))
    assert records_of(home.path) == []


def test_nodes_with_another_version_are_refused(cluster, monkeypatch):
    from agents.engines import ray_cluster

    cluster.add_node(num_cpus=1)
    monkeypatch.setattr(ray_cluster, "_digest", lambda: "0123456789ab")
    with pytest.raises(EngineError, match=r"node \S+ has another version .*0123456789ab"):
        ray_cluster.RayCluster(cluster.address)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:{free}", "no cluster answers at .* ray start --head"),
        ("no-such-host.invalid:6379", "no cluster answers at no-such-host.invalid:6379"),
        ("127.0.0.1", "address must be host:port"),
        ("ray://127.0.0.1:10001", "address must be host:port.* Run the program on a node"),
    ],
)
def test_an_address_without_a_cluster_is_an_error_within_30_seconds(ray, address, message):
    from agents.engines.ray_cluster import RayCluster

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = address.format(free=free.getsockname()[1])
    start = time.monotonic()
    with pytest.raises(EngineError, match=message.replace("ray start", ".*ray start")):
        RayCluster(address)
    assert time.monotonic() - start < 30


def test_another_server_at_the_address_is_an_error_within_30_seconds(ray):
    from agents.engines.ray_cluster import RayCluster

    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), http.server.SimpleHTTPRequestHandler
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        start = time.monotonic()
        with pytest.raises(EngineError, match="does not answer as a Ray cluster"):
            RayCluster(f"127.0.0.1:{server.server_port}")
        assert time.monotonic() - start < 30
        server.shutdown()


def test_a_machine_without_a_cluster_says_so(ray, monkeypatch):
    from agents.engines.ray_cluster import RayCluster

    # Another test may run a cluster on this machine now.
    def refuse(**options):
        assert options["address"] == "auto"
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(EngineError, match=r"no cluster on this machine takes .* Could not find"):
        RayCluster("auto")

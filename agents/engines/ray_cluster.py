"""`RayCluster`: the engine of many machines."""

from __future__ import annotations

import contextlib
import logging
import os
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import Any

import agents
import dptse_env
from agents.engines.engine import EngineError, ResultT, Workers, run_shown
from agents.engines.served_library import LocalServer, ServedLibrary
from dptse_env.command_line import TOOLS
from dptse_env.traffic import Corridor, RecordingError, RecordLibrary
from dptse_env.traffic.stored_arrays import pack, unpack
from dptse_env.utils.digests import package_digest
from dptse_env.utils.extras import needed_for

with needed_for("the engine ray, here and on all nodes,"):
    import ray
    from ray.exceptions import RayError, RayTaskError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

RETRIES = 3
"""Further attempts at a task whose worker or node dies. An error of the task itself is final."""

CONNECT_SECONDS = 10.0
"""Longest time for a connection to a cluster [s]."""

HEALTH_SECONDS = 12.0
"""Longest time for a cluster to say that it works [s]."""

PROBE_SECONDS = 20.0
"""Longest time for the answer of a node [s]."""

POLL_SECONDS = 1.0
"""Time between two looks at which nodes there are [s]."""

RecordTask = tuple[RecordLibrary, Corridor, int, str]
"""Library, road and traffic seed of a record, and the node that the library lies on."""


class RayCluster:
    """Runs tasks on a Ray cluster; see `Engine`.

    The program that starts tasks runs on a node of the cluster. Every node has this package, of the
    same version. Records that a task reads come from the library of the program's node, and those
    that a task makes go there. Other files that a task names have to be readable under the same
    path on every node: trained policies, networks, road files with imported records.

    Args:
        address: Address of the cluster, host:port, or "auto" for the one on this machine. If None,
            that of the environment variable ``RAY_ADDRESS``; where there is none, a cluster of this
            machine alone is started, which ends with the program.

    Raises:
        EngineError: There is no cluster at the address, it has other versions, or a node does not
            have this package.
    """

    is_parallel = True

    def __init__(self, address: str | None = None) -> None:
        """Connect, and ask every node for its version of this package."""
        if not ray.is_initialized():
            _connect(address or os.environ.get("RAY_ADDRESS"))
        self._node = ray.get_runtime_context().get_node_id()
        self._digest = _digest()
        self._suitable: set[str] = set()
        self._n_processors, self._looked = 0, 0.0
        self._look()

    @contextlib.contextmanager
    def open(self) -> Iterator[Workers]:
        """See `Engine.open`."""
        workers = _RayWorkers(self)
        try:
            yield workers
        except BaseException:
            workers.cancel()
            raise

    def record(
        self, library: RecordLibrary, corridor: Corridor, seeds: Sequence[int], progress: bool
    ) -> None:
        """See `Engine.record`; records are written here as they come."""
        missing = library.missing(corridor, seeds)
        tasks = [(library, corridor, seed, self._node) for seed in missing]

        def take(task: RecordTask, archive: bytes | None) -> None:
            if archive is not None:
                unpack(archive, library.record_path(corridor, task[2]))

        run_shown(self, _record, tasks, take, progress=progress, desc=corridor.name, unit="record")

    def shared(self, library: RecordLibrary) -> RecordLibrary:
        """See `Engine.shared`."""
        here = NodeAffinitySchedulingStrategy(self._node, soft=False)
        options = {"num_cpus": 0, "scheduling_strategy": here, "max_restarts": -1}
        server = ray.remote(LocalServer).options(**options, max_task_retries=-1)
        path = None if library.is_default else library.path
        return ServedLibrary(path, _RemoteServer(server.remote(library)), library.n_open)

    @property
    def n_nodes(self) -> int:
        """Number of nodes now."""
        self._look()
        return self._n_nodes

    @property
    def n_processors(self) -> int:
        """Number of processors of all nodes now."""
        self._look()
        return self._n_processors

    def _look(self) -> None:
        """Count nodes and processors, and check nodes that are new."""
        if time.monotonic() - self._looked < POLL_SECONDS:
            return
        nodes = _alive()
        new = nodes.keys() - self._suitable
        for name, answer in _probe(sorted(new)).items():
            # A node that has gone meanwhile has no say.
            if answer != self._digest and name in _alive():
                found = (
                    answer if " " in answer else f"has another version of this package, {answer}"
                )
                raise EngineError(
                    f"node {nodes[name]['NodeManagerAddress']} {found}: install that of this "
                    f"program there, dptse-env {dptse_env.__version__} with digest {self._digest}"
                )
        self._suitable |= new
        self._n_nodes = len(nodes)
        self._n_processors = int(sum(node["Resources"].get("CPU", 0) for node in nodes.values()))
        self._looked = time.monotonic()


class _RayWorkers:
    """Runs calls on a cluster."""

    def __init__(self, cluster: RayCluster) -> None:
        self._cluster, self._running = cluster, dict[Future[Any], Any]()
        # Spread, so that all nodes have tasks from the first on.
        self._call = ray.remote(_call).options(max_retries=RETRIES, scheduling_strategy="SPREAD")

    @property
    def capacity(self) -> int:
        """See `Workers.capacity`."""
        return max(2 * self._cluster.n_processors, 2)

    @property
    def place(self) -> str:
        """See `Workers.place`."""
        n = self._cluster.n_nodes
        return f"{n} node{'' if n == 1 else 's'}"

    def submit(self, work: Callable[..., ResultT], /, *arguments: Any) -> Future[ResultT]:
        """See `Workers.submit`."""
        reference = self._call.remote(work, *arguments)
        outcome: Future[ResultT] = Future()
        self._running[outcome] = reference

        def end(inner: Future[ResultT]) -> None:
            self._running.pop(outcome, None)
            problem = inner.exception()
            if problem is None:
                outcome.set_result(inner.result())
            else:
                outcome.set_exception(_explained(problem))

        reference.future().add_done_callback(end)
        return outcome

    def cancel(self) -> None:
        """End what still runs; it is done again at the next start."""
        for reference in list(self._running.values()):
            ray.cancel(reference, force=True)


class _RemoteServer:
    """Asks an actor for records; see `agents.engines.served_library.Server`."""

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def record(self, corridor: Corridor, seed: int) -> bytes | None:
        archive: bytes | None = ray.get(self._actor.record.remote(corridor, seed))
        return archive


def _connect(address: str | None) -> None:
    """Connect to a cluster, or start one on this machine.

    Raises:
        EngineError: There is none at the address, or it has another version of Ray or Python.
    """
    if address is not None and address != "auto":
        _reach(address)
    environment: dict[str, Any] = {"env_vars": {"OMP_NUM_THREADS": "1"}}
    if TOOLS.is_dir():
        environment["worker_process_setup_hook"] = "dptse_env.command_line.add_tools_path"
    try:
        ray.init(
            address=address or "local",
            runtime_env=environment,
            log_to_driver=False,
            include_dashboard=False if address is None else None,
            logging_level=logging.WARNING,
        )
    except (ConnectionError, RuntimeError, ValueError, RayError) as problem:
        there = "on this machine" if address in (None, "auto") else f"at {address}"
        raise EngineError(
            f"no cluster {there} takes this program (Python {platform.python_version()}, Ray "
            f"{ray.__version__}): {problem}"
        ) from problem


def _reach(address: str) -> None:
    """Check that a cluster answers at an address; `ray.init` would try for minutes.

    Raises:
        EngineError: None does, or the address is no host:port.
    """
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdecimal()) or "://" in address:
        raise EngineError(
            f"address must be host:port of a cluster's head node, or auto, got {address!r}. Run "
            "the program on a node of the cluster"
        )
    try:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
    except OSError as problem:
        raise EngineError(
            f"no cluster answers at {address} ({problem}): start one there with 'ray start "
            "--head', or give --address another one"
        ) from problem
    command = [sys.executable, "-m", "ray.scripts.scripts", "health-check", "--address", address]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=HEALTH_SECONDS
        )
    except subprocess.TimeoutExpired as problem:
        raise EngineError(
            f"what listens at {address} does not answer as a Ray cluster: give --address that of a "
            "head node, as 'ray start --head' prints it"
        ) from problem
    if answer.returncode:
        lines = answer.stderr.strip().splitlines() or ["it is not healthy"]
        raise EngineError(f"the cluster at {address} cannot be used: {lines[-1]}")


def _alive() -> dict[str, dict[str, Any]]:
    """Return what Ray knows of the nodes that are alive, by their ids."""
    nodes = ray.nodes()  # type: ignore[no-untyped-call]
    return {node["NodeID"]: node for node in nodes if node["Alive"]}


def _digest() -> str:
    """Return the digest of this package and of the tools on this machine."""
    return package_digest(dptse_env) + package_digest(agents)


def _probe(nodes: Sequence[str]) -> dict[str, str]:
    """Return the digest of this package on nodes, or in words why there is none, by their ids."""

    # Nested, so that it travels as a value: a node may lack the module that it stands in.
    def digest_there() -> str:
        try:
            from agents.engines.ray_cluster import _digest as digest  # noqa: PLC0415
        except ImportError as problem:
            return f"lacks this package ({problem})"
        return digest()

    remote = ray.remote(digest_there)
    asked = {
        node: remote.options(
            num_cpus=0, scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False)
        ).remote()
        for node in nodes
    }
    answers = {}
    for node, reference in asked.items():
        try:
            answers[node] = ray.get(reference, timeout=PROBE_SECONDS)
        except RayError as problem:
            answers[node] = f"does not answer ({type(problem).__name__})"
    return answers


def _call(work: Callable[..., ResultT], *arguments: Any) -> ResultT:
    """Run a task on a worker; an error of a file or of a recording names the node."""
    try:
        return work(*arguments)
    except (OSError, RecordingError) as problem:
        node = ray.util.get_node_ip_address()  # type: ignore[no-untyped-call]
        raise type(problem)(f"on node {node}: {problem}") from problem


def _record(task: RecordTask) -> bytes | None:
    """Make a record in the node's library; return its archive, or None on the node ``home``."""
    library, corridor, seed, home = task
    library.ensure(corridor, [seed], workers=1)
    if ray.get_runtime_context().get_node_id() == home:
        return None
    return pack(library.record_path(corridor, seed))


def _explained(problem: BaseException) -> BaseException:
    """Return the error of a task itself, or else one that says how its worker was lost."""
    if isinstance(problem, RayTaskError) and isinstance(problem.cause, Exception):
        problem.cause.__cause__ = problem  # it has the traceback on the worker
        return problem.cause
    if isinstance(problem, RayError):
        reason = str(problem).strip().splitlines()[0]
        return EngineError(
            f"a task was lost {RETRIES + 1} times ({type(problem).__name__}: {reason}): results "
            "so far are kept, the same command goes on from there"
        )
    return problem

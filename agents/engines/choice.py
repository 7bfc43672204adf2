"""The engine that a command line chooses."""

from __future__ import annotations

from typing import Literal

from agents.engines.engine import Engine
from agents.engines.local import LocalProcesses

EngineName = Literal["local", "ray"]


def make_engine(name: EngineName, workers: int, address: str | None) -> Engine:
    """Make an engine.

    Args:
        name: ``local``, processes of this machine, or ``ray``, a cluster.
        workers: Number of local processes. A cluster has as many as it has processors.
        address: Address of the cluster; see `agents.engines.ray_cluster.RayCluster`.

    Raises:
        EngineError: There is no suitable cluster.
        MissingExtraError: Ray is not installed.
        ValueError: An argument is out of range or of the other engine.
    """
    if name == "local":
        if address is not None:
            raise ValueError(f"address must be given with the engine ray, got {address!r}")
        return LocalProcesses(workers)
    from agents.engines.ray_cluster import RayCluster  # noqa: PLC0415 (Ray is optional)

    return RayCluster(address)

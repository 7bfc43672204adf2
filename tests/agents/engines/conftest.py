import contextlib
import os

import pytest


@pytest.fixture(scope="session")
def ray():
    """Ray, if it is installed; its clusters are of this machine alone and ask for no token."""
    os.environ |= {"RAY_AUTH_MODE": "disabled", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    return pytest.importorskip("ray")


@pytest.fixture
def cluster(ray):
    """A cluster without nodes but its head, which runs no task; the driver runs there."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    yield made
    with contextlib.suppress(Exception):
        ray.shutdown()
    made.shutdown()

import gc
import os

# Before anything imports numpy or torch: their threads would fight over the cores of the tests.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from pathlib import Path

import pytest
from hypothesis import settings

# The first example of a compiled test compiles it: no time limit on a single example. What gates a
# change draws the same examples each time; at a developer's desk they are new ones.
settings.register_profile("compiled", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("compiled")


def pytest_collection_finish():
    """Spare collections of garbage the modules and tests, which live to the end anyway."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def record_cache(tmp_path_factory):
    """Keep every record that the tests make in a folder of their own, child processes too."""
    folder: Path = tmp_path_factory.mktemp("records")
    before = os.environ.get("DPTSE_CACHE")
    os.environ["DPTSE_CACHE"] = str(folder)
    yield folder
    if before is None:
        del os.environ["DPTSE_CACHE"]
    else:
        os.environ["DPTSE_CACHE"] = before

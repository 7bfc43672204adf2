"""The same variables, examples and folders for all tests, whatever the machine has."""

import gc
import os
import pkgutil

import pytest
from hypothesis import HealthCheck, settings

LEFT = ("NUMBA_CACHE_DIR",)  # the place of machine code changes nothing
CLEARED = (
    "COLUMNS", "DPTSE_", "FORCE_COLOR", "JUPYTER_", "LINES", "MKL_", "MPLBACKEND", "NO_COLOR",
    "NUMBA_", "OMP_", "OPENBLAS_", "PYGAME_", "PYTHONWARNINGS", "PYTHON_COLORS", "RAY_", "SDL_",
    "SUMO_", "TQDM_", "TTY_",
)  # fmt: skip
"""Beginnings of variables that this package or a library reads; `test_variables` sets them."""

# Before tests import numba, which reads them once, or torch, whose threads would fight over cores.
for name in [*os.environ]:
    if name.startswith(CLEARED) and name not in LEFT:
        del os.environ[name]
os.environ["OMP_NUM_THREADS"] = "1"

from tests import helpers  # noqa: E402, F401 (an id and a preset of the tests)

# Time limits would depend on the machine, and the first example of a compiled test compiles it.
TIMELESS = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", **TIMELESS, derandomize=True)
settings.register_profile("fresh", **TIMELESS, derandomize=False, print_blob=True)
settings.load_profile("same")


def pytest_collection_finish():
    """Spare collections of garbage the modules and tests, which live to the end anyway."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def record_cache(tmp_path_factory):
    """Keep every record that the tests make in a folder of their own, child processes too."""
    folder = tmp_path_factory.mktemp("records")
    os.environ["DPTSE_CACHE"] = str(folder)
    return folder


@pytest.fixture(autouse=True)
def registries(monkeypatch):
    """Forget at the end of a test which parts it has registered."""
    from dptse_env.registration import REGISTRIES

    for registry in map(pkgutil.resolve_name, REGISTRIES.values()):
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))

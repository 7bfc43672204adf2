import pytest

from dptse_env.estimators.compiled import mhe
from dptse_env.traffic import PAPER_HIGHWAY, RecordLibrary

from .episodes import RELEASES, Episodes, replay

ORDERS = ("in time", "along the road")


@pytest.fixture(scope="session")
def recordings(record_cache) -> dict[str, Episodes]:
    """A simulated rush hour on the paper's highway, 700 steps, by what its sensors release."""
    record = RecordLibrary(record_cache).get(PAPER_HIGHWAY, 3)
    return {release: replay(record, release) for release in RELEASES}


@pytest.fixture(scope="session")
def recorded(recordings) -> Episodes:
    """The one that releases speeds."""
    return recordings["speed"]


@pytest.fixture(params=ORDERS)
def order(request, monkeypatch):
    """Both orders in which the compiled MHE factorises a window, whatever the road's length."""
    monkeypatch.setattr(mhe, "MOST_IN_TIME", 10**9 if request.param == "in time" else 0)


@pytest.fixture
def along_the_road(monkeypatch):
    """Treat short roads as long ones."""
    monkeypatch.setattr(mhe, "MOST_IN_TIME", 0)

import pytest

from dptse_env.traffic import PAPER_HIGHWAY, RecordLibrary

from .episodes import RELEASES, Episodes, replay


@pytest.fixture(scope="session")
def recordings(record_cache) -> dict[str, Episodes]:
    """A simulated rush hour on the paper's highway, 700 steps, by what its sensors release."""
    record = RecordLibrary(record_cache).get(PAPER_HIGHWAY, 3)
    return {release: replay(record, release) for release in RELEASES}


@pytest.fixture(scope="session")
def recorded(recordings) -> Episodes:
    """The one that releases speeds."""
    return recordings["speed"]

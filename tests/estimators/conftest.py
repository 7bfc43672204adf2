import pytest

from dptse_env.traffic import PAPER_HIGHWAY, RecordLibrary

from .episodes import Episodes, replay


@pytest.fixture(scope="session")
def recorded(record_cache) -> Episodes:
    """A simulated rush hour on the paper's highway, one episode of 700 steps."""
    return replay(RecordLibrary(record_cache).get(PAPER_HIGHWAY, 3))

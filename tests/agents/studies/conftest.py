from pathlib import Path

import pytest

RESULTS = Path(__file__).parents[3] / "results"


@pytest.fixture(scope="session")
def results():
    """The folder of recorded studies."""
    if not RESULTS.is_dir():
        pytest.skip("a source archive has no results")
    return RESULTS

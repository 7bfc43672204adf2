import pytest

from dptse_env.traffic import SHORT_HIGHWAY, simulate


@pytest.fixture(scope="session")
def short_record():
    return simulate(SHORT_HIGHWAY, 0)

import pytest

from dptse_env.traffic import PAPER_HIGHWAY, SHORT_HIGHWAY, simulate


@pytest.fixture(scope="session")
def short_record():
    return simulate(SHORT_HIGHWAY, 0)


@pytest.fixture(scope="session")
def paper_records():
    return [simulate(PAPER_HIGHWAY, seed) for seed in range(2)]

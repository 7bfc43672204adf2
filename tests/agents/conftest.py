import pytest

from agents.executors import this_process
from agents.study import Place, run
from tests.agents.faults import TRACES, rows_of, study


@pytest.fixture
def traces(tmp_path, monkeypatch):
    """Let the faults of the study befall, and leave traces in a folder."""
    folder = tmp_path / "traces"
    folder.mkdir()
    monkeypatch.setenv(TRACES, str(folder))
    return folder


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """Rows of the study that no fault befalls."""
    folder = tmp_path_factory.mktemp("undisturbed")
    run(study(), Place(folder, this_process))
    return rows_of(folder)

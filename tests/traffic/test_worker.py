import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dptse_env.traffic import SHORT_HIGHWAY, Record, RecordingError, simulate, simulate_in_child
from dptse_env.traffic.worker import Worker, WorkerDiedError, WorkerPool

SCRIPT = """
from dptse_env.traffic import SHORT_HIGHWAY, simulate_in_child
print(simulate_in_child(SHORT_HIGHWAY, 0).n_rows)
"""


@pytest.fixture
def worker():
    worker = Worker()
    yield worker
    worker.close()


def assert_same(first, second):
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_child_records_what_this_process_records(short_record):
    assert_same(simulate_in_child(SHORT_HIGHWAY, 0), short_record)


def test_a_simulation_of_the_user_survives(short_record, tmp_path):
    """libsumo holds one simulation per process; the user's own must not be replaced."""
    import libsumo

    from dptse_env.traffic.sumo_network import packaged_network

    network = tmp_path / "users.net.xml"
    network.write_text(packaged_network("paper-highway"))
    libsumo.start(["sumo", "-n", str(network), "--no-step-log", "--xml-validation.net", "never"])
    try:
        libsumo.simulationStep()
        with pytest.raises(RecordingError, match="another simulation in this process"):
            simulate(SHORT_HIGHWAY, 0)
        assert_same(simulate_in_child(SHORT_HIGHWAY, 0), short_record)
        assert libsumo.simulation.getTime() == 1.0
        assert "main_14" in libsumo.edge.getIDList()
    finally:
        libsumo.close()


def test_a_script_without_a_main_guard_and_one_from_a_pipe_work(tmp_path, short_record):
    script = tmp_path / "unguarded.py"
    script.write_text(SCRIPT)
    for arguments, text in (([str(script)], ""), (["-"], SCRIPT)):
        result = subprocess.run(
            [sys.executable, *arguments],
            input=text,
            cwd=Path.cwd(),
            env=os.environ | {"PYTHONPATH": str(Path.cwd())},
            capture_output=True,
            text=True,
            check=False,
        )
        assert result.stdout.strip() == str(short_record.n_rows), result.stderr


def test_one_worker_serves_many_tasks_and_survives_a_failing_one(worker, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    worker.record(SHORT_HIGHWAY, 0, tmp_path / "0", {})
    with pytest.raises(RecordingError, match=r"^recording .* seed 1 failed: [^:]*: .*file"):
        worker.record(SHORT_HIGHWAY, 1, blocked / "1", {})
    worker.record(SHORT_HIGHWAY, 2, tmp_path / "2", {})
    assert Record.load(tmp_path / "0", {}).n_rows > 0
    assert Record.load(tmp_path / "2", {}).n_rows > 0
    assert worker.alive


def test_a_killed_worker_is_one_clear_error(worker, tmp_path):
    os.kill(worker.pid, signal.SIGKILL)
    with pytest.raises(WorkerDiedError, match=r"traffic seed 5 failed: .* ended with code -9"):
        worker.record(SHORT_HIGHWAY, 5, tmp_path / "5", {})
    assert not worker.alive


def test_a_pool_replaces_a_dead_worker(tmp_path, monkeypatch):
    with WorkerPool() as pool:
        healthy = Worker.record

        def killed(self, *task):
            os.kill(self.pid, signal.SIGKILL)
            healthy(self, *task)

        monkeypatch.setattr(Worker, "record", killed)
        with pytest.raises(RecordingError, match="code -9"):
            pool.record(SHORT_HIGHWAY, 0, tmp_path / "0", {})
        monkeypatch.setattr(Worker, "record", healthy)
        pool.record(SHORT_HIGHWAY, 0, tmp_path / "0", {})
    assert Record.load(tmp_path / "0", {}).n_rows > 0


def test_half_an_answer_is_the_death_of_the_worker(tmp_path, monkeypatch):
    script = tmp_path / "dies"
    script.write_text("#!/bin/sh\nhead -c 1 > /dev/null\nprintf '{\"fail'\nexit 3\n")
    script.chmod(0o700)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "executable", str(script))
        worker = Worker()
    with pytest.raises(WorkerDiedError, match=r"traffic seed 4 failed: .* ended with code 3"):
        worker.record(SHORT_HIGHWAY, 4, tmp_path / "4", {})
    worker.close()


class WritesToStdout:
    """Unpickles by writing to file descriptor 1, as SUMO's C++ does."""

    def __reduce__(self):
        return os.write, (1, b"noise\n")


def test_what_a_library_prints_in_the_child_is_not_taken_for_an_answer(worker, tmp_path):
    worker.record(SHORT_HIGHWAY, 0, tmp_path / "0", {"noise": WritesToStdout()})
    assert Record.load(tmp_path / "0", {"noise": len("noise\n")}).n_rows > 0


def test_modules_in_the_working_directory_do_not_shadow_those_of_the_child(
    tmp_path, monkeypatch, short_record
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "queue.py").write_text("raise RuntimeError('shadowed')")
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    assert_same(simulate_in_child(SHORT_HIGHWAY, 0), short_record)


def test_closing_twice_is_fine():
    worker = Worker()
    worker.close()
    worker.close()

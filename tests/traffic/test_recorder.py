"""SUMO in child processes: what they record, and workers, parents and libraries that die."""

import dataclasses
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from dptse_env.traffic import (
    SHORT_HIGHWAY,
    Record,
    RecordingError,
    RecordLibrary,
    simulate,
    simulate_in_child,
)
from dptse_env.traffic.worker import Worker, WorkerDiedError

LONG_HIGHWAY = dataclasses.replace(SHORT_HIGHWAY, duration=1500)
"""The short corridor for long enough to be met in the middle of a recording."""

UNGUARDED = """
from dptse_env.traffic import SHORT_HIGHWAY, simulate_in_child
print(simulate_in_child(SHORT_HIGHWAY, 0).n_rows)
"""

ENSURE = """
import signal, sys
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary, worker

start = worker.Worker.__init__

def announced(self):
    start(self)
    print(f"{self.pid}\\n", end="", flush=True)  # one write, since two threads do it

worker.Worker.__init__ = announced
signal.signal(signal.SIGINT, signal.default_int_handler)
RecordLibrary(sys.argv[1]).ensure(SHORT_HIGHWAY, range(int(sys.argv[2])), workers=2)
"""


def everything_in(path):
    # Unlike Path.rglob, os.walk passes over folders that a writer removes meanwhile.
    return sorted(Path(folder) / name for folder, _, names in os.walk(path) for name in names)


def wait_for(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


def assert_same(first, second):
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def kill_the_first_while_it_simulates(monkeypatch):
    """Have the first worker killed as soon as SUMO runs in it; return whom it met."""
    healthy, killed = Worker.record, []

    def record(self, *task):
        def kill():
            folder = Path(self._folder.name)
            wait_for(lambda: any(folder.glob("dptse-sumo-*/scenario.rou.xml")))
            os.kill(self.pid, signal.SIGKILL)

        if not killed:
            killed.append(self.pid)
            threading.Thread(target=kill).start()
        healthy(self, *task)

    monkeypatch.setattr(Worker, "record", record)
    return killed


def start_ensure(path, n_seeds):
    return subprocess.Popen(
        [sys.executable, "-c", ENSURE, str(path), str(n_seeds)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
        start_new_session=True,
    )


def interrupted_ensure(path, interrupt):
    """Start to record, interrupt it in the middle; return its exit code, stderr and children."""
    process = start_ensure(path, 400)
    children = [int(process.stdout.readline()) for _ in range(2)]
    wait_for(lambda: len(everything_in(path)) >= 4)
    interrupt(process.pid)
    _, said = process.communicate(timeout=60)
    return process.returncode, said, children


def runs(pid):
    """Tell whether a process runs; one that only waits for its parent to ask does not."""
    stat = Path(f"/proc/{pid}/stat")
    if sys.platform == "linux":
        return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"
    return subprocess.run(["ps", "-p", str(pid)], check=False, capture_output=True).returncode == 0


def holds_valid_records(path, n_asked):
    records = RecordLibrary(path)
    made = set(range(n_asked)) - set(records.missing(SHORT_HIGHWAY, range(n_asked)))
    assert all(records.get(SHORT_HIGHWAY, seed).n_rows > 0 for seed in made)
    return 0 < len(made) < n_asked


def test_a_record_whose_worker_is_killed_is_made_by_another(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    killed = kill_the_first_while_it_simulates(monkeypatch)
    records = RecordLibrary(tmp_path / "library")
    with caplog.at_level(logging.WARNING, logger="dptse_env"):
        records.ensure(LONG_HIGHWAY, [4, 5], workers=2)
    assert len(killed) == 1
    assert records.missing(LONG_HIGHWAY, [4, 5]) == []
    (warning,) = caplog.messages
    assert "attempt 1 of 3" in warning
    assert "ended with code -9" in warning
    # The dead worker left no temporary files, and children record what this process records.
    assert [entry.name for entry in tmp_path.iterdir()] == ["library"]
    assert len(everything_in(tmp_path)) == 2
    assert_same(records.get(LONG_HIGHWAY, 5), simulate(LONG_HIGHWAY, 5))


@pytest.mark.slow
def test_a_killed_parent_leaves_no_orphans_and_a_valid_library(tmp_path):
    code, _, children = interrupted_ensure(tmp_path, lambda pid: os.kill(pid, signal.SIGKILL))
    assert code == -signal.SIGKILL
    wait_for(lambda: not any(map(runs, children)), seconds=20)
    assert holds_valid_records(tmp_path, 400)


@pytest.mark.slow
@pytest.mark.parametrize("send", [os.kill, os.killpg], ids=["to the parent", "from a terminal"])
def test_ctrl_c_ends_all_processes_and_no_record_is_tried_again(tmp_path, send):
    code, said, children = interrupted_ensure(tmp_path, lambda pid: send(pid, signal.SIGINT))
    assert code == -signal.SIGINT
    assert said.strip().endswith("KeyboardInterrupt")
    assert "attempt" not in said
    assert not any(map(runs, children))
    assert holds_valid_records(tmp_path, 400)


@pytest.mark.slow
def test_processes_recording_the_same_seeds_agree(tmp_path, short_record):
    processes = [start_ensure(tmp_path, 3) for _ in range(2)]
    for process in processes:
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
    assert len(everything_in(tmp_path)) == 3


@pytest.mark.slow
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
        assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
        assert libsumo.simulation.getTime() == 1.0
        assert "main_14" in libsumo.edge.getIDList()
    finally:
        libsumo.close()


@pytest.mark.slow
def test_a_script_without_a_main_guard_and_one_from_a_pipe_work(tmp_path, short_record):
    script = tmp_path / "unguarded.py"
    script.write_text(UNGUARDED)
    for arguments, text in (([str(script)], ""), (["-"], UNGUARDED)):
        result = subprocess.run(
            [sys.executable, *arguments],
            input=text,
            env=os.environ | {"PYTHONPATH": str(Path.cwd())},
            capture_output=True,
            text=True,
            check=False,
        )
        assert result.stdout.strip() == str(short_record.n_rows), result.stderr


@pytest.fixture
def worker():
    worker = Worker()
    yield worker
    worker.close()


class WritesToStdout:
    """Unpickles by writing to file descriptor 1, as SUMO's C++ does."""

    def __reduce__(self):
        return os.write, (1, b"noise\n")


@pytest.mark.slow
def test_one_worker_serves_many_tasks_and_survives_a_failing_and_a_noisy_one(worker, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    worker.record(SHORT_HIGHWAY, 0, tmp_path / "0", {"noise": WritesToStdout()})
    with pytest.raises(RecordingError, match=r"^recording .* seed 1 failed: [^:]*: .*file"):
        worker.record(SHORT_HIGHWAY, 1, blocked / "1", {})
    worker.record(SHORT_HIGHWAY, 2, tmp_path / "2", {})
    assert Record.load(tmp_path / "0", {"noise": len("noise\n")}).n_rows > 0
    assert Record.load(tmp_path / "2", {}).n_rows > 0
    assert worker.alive


@pytest.mark.slow
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


@pytest.mark.slow
def test_modules_in_the_working_directory_do_not_shadow_those_of_the_child(
    tmp_path, monkeypatch, short_record
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "queue.py").write_text("raise RuntimeError('shadowed')")
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    assert_same(simulate_in_child(SHORT_HIGHWAY, 0), short_record)

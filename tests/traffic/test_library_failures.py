"""A library whose workers, writers or parents die, and one that cannot be filled."""

import dataclasses
import errno
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
    NetworkError,
    Record,
    RecordingError,
    RecordLibrary,
    SumoVersionError,
    library,
    sumo,
)
from dptse_env.traffic.worker import Worker

LONG_HIGHWAY = dataclasses.replace(SHORT_HIGHWAY, duration=3000)
"""The short corridor for long enough to be met in the middle of a recording."""

ENSURE = """
import signal, sys
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary, worker

start = worker.Worker.__init__

def announced(self):
    start(self)
    print(f"{self.pid}\\n", end="", flush=True)  # one write, since two threads do it

worker.Worker.__init__ = announced
signal.signal(signal.SIGINT, signal.default_int_handler)
RecordLibrary(sys.argv[1]).ensure(SHORT_HIGHWAY, range(400), workers=2)
"""


def everything_in(path):
    # Unlike Path.rglob, os.walk passes over folders that a writer removes meanwhile.
    return sorted(Path(folder) / name for folder, _, names in os.walk(path) for name in names)


def wait_for(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


def kill_while_it_simulates(monkeypatch, times):
    """Have the first workers killed as soon as SUMO runs in them; return whom it met."""
    healthy, killed = Worker.record, []

    def record(self, *task):
        def kill():
            folder = Path(self._folder.name)
            wait_for(lambda: any(folder.glob("dptse-sumo-*/scenario.rou.xml")))
            os.kill(self.pid, signal.SIGKILL)

        if len(killed) < times:
            killed.append(self.pid)
            threading.Thread(target=kill).start()
        healthy(self, *task)

    monkeypatch.setattr(Worker, "record", record)
    return killed


def interrupted_ensure(path, interrupt):
    """Start to record, interrupt it in the middle; return its exit code, stderr and children."""
    process = subprocess.Popen(
        [sys.executable, "-c", ENSURE, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
        start_new_session=True,
    )
    children = [int(process.stdout.readline()) for _ in range(2)]
    wait_for(lambda: len(everything_in(path)) >= 4 * (len(Record.COLUMNS) + 1))
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


def tiny_record(path, seed):
    """Put a record of one row where the library looks for one."""
    one = np.ones(1)
    columns = SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries
    record = Record(one, one, one, one, SHORT_HIGHWAY.duration + 1, columns)
    source = library._source(SHORT_HIGHWAY, seed)
    record.save(RecordLibrary(path).record_path(SHORT_HIGHWAY, seed), source)


@pytest.mark.parametrize("seeds", [[5], [4, 5, 6]])
def test_a_record_whose_worker_is_killed_is_made_by_another(tmp_path, monkeypatch, caplog, seeds):
    killed = kill_while_it_simulates(monkeypatch, times=1)
    monkeypatch.setattr(library, "simulation_is_loaded", lambda: True)  # children even for one
    records = RecordLibrary(tmp_path)
    with caplog.at_level(logging.WARNING, logger="dptse_env"):
        records.ensure(LONG_HIGHWAY, seeds, workers=2)
    assert len(killed) == 1
    assert records.missing(LONG_HIGHWAY, seeds) == []
    assert records.get(LONG_HIGHWAY, 5).n_steps == LONG_HIGHWAY.duration + 1
    assert len(caplog.records) == 1
    assert any(
        f"attempt 1 of 3: recording short-highway with traffic seed {seed}" in caplog.text
        for seed in seeds
    )
    assert "ended with code -9" in caplog.text
    assert len(everything_in(tmp_path)) == len(seeds) * (len(Record.COLUMNS) + 1)


def test_a_record_whose_worker_is_always_killed_is_given_up(tmp_path, monkeypatch, caplog):
    killed = kill_while_it_simulates(monkeypatch, times=99)
    monkeypatch.setattr(library, "simulation_is_loaded", lambda: True)
    pattern = (
        r"holds 0 of the 1 requested record.*\n?.*traffic seed 5 failed: .*code -9\n\(tried 3 times"
    )
    with pytest.raises(RecordingError, match=pattern):
        RecordLibrary(tmp_path).get(LONG_HIGHWAY, 5)
    assert len(set(killed)) == 3
    assert len(caplog.records) == 2
    assert everything_in(tmp_path) == []


def test_what_sumo_reports_is_not_tried_again(tmp_path, monkeypatch, caplog):
    tasks = []

    def refused(self, corridor, seed, path, source):
        tasks.append(seed)
        raise RecordingError.from_cause(corridor, seed, "no valid route")

    monkeypatch.setattr(Worker, "record", refused)
    with pytest.raises(RecordingError, match="no valid route"):
        RecordLibrary(tmp_path).ensure(SHORT_HIGHWAY, [1, 2], workers=2)
    assert len(tasks) == len(set(tasks))
    assert caplog.text == ""


def test_a_killed_child_leaves_no_temporary_files(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    kill_while_it_simulates(monkeypatch, times=1)
    monkeypatch.setattr(library, "simulation_is_loaded", lambda: True)
    RecordLibrary(tmp_path / "library").ensure(LONG_HIGHWAY, [0])
    assert "attempt 1 of 3" in caplog.text
    assert [entry.name for entry in tmp_path.iterdir()] == ["library"]


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
    assert len(everything_in(tmp_path)) % (len(Record.COLUMNS) + 1) == 0


def test_what_a_dead_writer_left_is_removed_when_it_is_old(tmp_path):
    records = RecordLibrary(tmp_path)
    records.ensure(SHORT_HIGHWAY, [0])
    folder = records.record_path(SHORT_HIGHWAY, 0).parent
    names = [".00000007-1111", ".00000008-2222"]
    for name, age in zip(names, (library.LEFTOVER_AGE + 60, 60), strict=True):
        (folder / name).mkdir()
        (folder / name / "step.npy").write_bytes(b"half")
        then = time.time() - age
        os.utime(folder / name, (then, then))
    then = time.time() - 2 * library.LEFTOVER_AGE
    os.utime(records.record_path(SHORT_HIGHWAY, 0), (then, then))
    records.ensure(SHORT_HIGHWAY, [0])
    assert (folder / names[0]).exists()  # nothing is written, so nothing is swept
    records.ensure(SHORT_HIGHWAY, [1])
    assert sorted(entry.name for entry in folder.iterdir()) == [names[1], "00000000", "00000001"]


def test_missing_names_each_absent_record_once_and_in_order(tmp_path):
    for seed in (0, 3):
        tiny_record(tmp_path, seed)
    records = RecordLibrary(tmp_path)
    assert records.missing(SHORT_HIGHWAY, (5, np.int64(3), 1, 0, 5)) == [5, 1]
    assert records.missing(LONG_HIGHWAY, [0]) == [0]
    with pytest.raises(ValueError, match="traffic seed must be an integer >= 0"):
        records.missing(SHORT_HIGHWAY, [0, -1])


@pytest.mark.parametrize(("seeds", "workers"), [([0], 2), ([0, 1], 1)])
def test_one_record_or_one_worker_needs_no_child(tmp_path, monkeypatch, caplog, seeds, workers):
    monkeypatch.setattr(library, "WorkerPool", None)
    records = RecordLibrary(tmp_path)
    with caplog.at_level(logging.INFO, logger="dptse_env"):
        records.ensure(SHORT_HIGHWAY, seeds, workers)
    assert records.missing(SHORT_HIGHWAY, seeds) == []
    assert f"recording {len(seeds)} traffic seed(s) in this process" in caplog.text
    assert [record.levelname for record in caplog.records] == ["INFO"]


def test_how_many_records_are_made_where_is_logged(tmp_path, caplog):
    tiny_record(tmp_path, 1)
    with caplog.at_level(logging.INFO, logger="dptse_env"):
        RecordLibrary(tmp_path).ensure(SHORT_HIGHWAY, range(3), workers=8)
    assert f"recording 2 traffic seed(s) in 2 child process(es) into {tmp_path}" in caplog.text


@pytest.mark.parametrize("code", [errno.EROFS, errno.EACCES, errno.ENOSPC])
def test_a_library_that_cannot_grow_says_what_it_holds_and_why(tmp_path, monkeypatch, code):
    for seed in (0, 1, 2):
        tiny_record(tmp_path, seed)
    records = RecordLibrary(tmp_path)

    def refuse(*_, **__):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    monkeypatch.setattr(library, "simulate", None)  # it is known before an hour of simulation
    pattern = (
        rf"the library at {tmp_path} holds 3 of the 5 requested record\(s\) of short-highway, and "
        rf"the rest cannot be made: .*traffic seed 3 failed: .*{os.strerror(code)}"
    )
    for workers in (1, 2):
        with pytest.raises(RecordingError, match=pattern):
            records.ensure(SHORT_HIGHWAY, range(5), workers=workers)
    with pytest.raises(
        RecordingError, match=r"holds 0 of the 1 requested record\(s\).*seed 4 failed"
    ):
        records.get(SHORT_HIGHWAY, 4)
    records.ensure(SHORT_HIGHWAY, range(3))
    assert records.get(SHORT_HIGHWAY, 1).n_rows == 1


def test_a_file_in_the_librarys_place_is_named(tmp_path):
    path = tmp_path / "file"
    path.write_text("in the way")
    with pytest.raises(RecordingError, match=rf"library at {path} holds 0 of the 2 .*file"):
        RecordLibrary(path).ensure(SHORT_HIGHWAY, [2, 3])


def test_a_missing_libsumo_is_an_error_of_the_library(tmp_path, monkeypatch):
    tiny_record(tmp_path, 0)

    def missing(name):
        raise sumo.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(sumo.importlib.metadata, "version", missing)
    pattern = rf"library at {tmp_path} can neither find nor make the 2 .*libsumo is not installed"
    with pytest.raises(SumoVersionError, match=pattern):
        RecordLibrary(tmp_path).ensure(SHORT_HIGHWAY, [0, 1])
    with pytest.raises(SumoVersionError, match="neither find nor make the 1"):
        RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0)


def test_a_broken_libsumo_does_not_hide_what_is_there(tmp_path, monkeypatch):
    tiny_record(tmp_path, 0)
    monkeypatch.setitem(sys.modules, "libsumo", None)
    records = RecordLibrary(tmp_path)
    with pytest.raises(SumoVersionError, match=r"holds 1 of the 2 .* cannot be imported"):
        records.ensure(SHORT_HIGHWAY, [0, 1], workers=1)
    assert records.get(SHORT_HIGHWAY, 0).n_rows == 1


def test_a_network_that_cannot_be_compiled_keeps_its_kind_of_error(tmp_path, monkeypatch):
    def fails(_corridor):
        raise NetworkError("netconvert is missing")

    monkeypatch.setattr(sumo, "network_xml", fails)
    with pytest.raises(NetworkError, match=r"holds 0 of the 1 .* netconvert is missing"):
        RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0)

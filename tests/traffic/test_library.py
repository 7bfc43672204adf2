import errno
import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from dptse_env.traffic import (
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    Record,
    RecordingError,
    RecordLibrary,
    library,
    randomised,
)
from dptse_env.traffic.worker import Worker

ENSURE = """
import sys
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary
RecordLibrary(sys.argv[1]).ensure(SHORT_HIGHWAY, range(int(sys.argv[2])), workers=2)
"""


def assert_same(first, second):
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def everything_in(path):
    # Not Path.rglob, which stumbles over folders that a process renames meanwhile.
    return sorted(Path(folder, name) for folder, _, names in os.walk(path) for name in names)


def start_ensure(path, n_seeds):
    return subprocess.Popen(
        [sys.executable, "-c", ENSURE, str(path), str(n_seeds)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(Path.cwd())},
        start_new_session=True,
    )


def forbid_recording(monkeypatch):
    def refuse(*_):
        raise AssertionError("recorded again")

    monkeypatch.setattr(library, "simulate", refuse)
    monkeypatch.setattr(library.WorkerPool, "record", refuse)


def test_a_record_is_made_once_and_then_read(tmp_path, short_record, monkeypatch):
    first = RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0)
    assert_same(first, short_record)
    forbid_recording(monkeypatch)
    assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)


def test_an_open_record_is_the_same_object(tmp_path, monkeypatch):
    records = RecordLibrary(tmp_path)
    record = records.get(SHORT_HIGHWAY, 0)
    monkeypatch.setattr(Record, "load", None)
    assert records.get(SHORT_HIGHWAY, np.int64(0)) is record


def test_only_the_most_recent_records_stay_open(tmp_path):
    records = RecordLibrary(tmp_path, n_open=2)
    first, second = records.get(SHORT_HIGHWAY, 0), records.get(SHORT_HIGHWAY, 1)
    assert records.get(SHORT_HIGHWAY, 0) is first
    records.get(SHORT_HIGHWAY, 2)  # pushes out 1, the least recently used
    assert records.get(SHORT_HIGHWAY, 0) is first
    assert records.get(SHORT_HIGHWAY, 1) is not second


def test_what_shapes_a_record_is_in_its_path(tmp_path, monkeypatch):
    records = RecordLibrary(tmp_path)
    paths = [
        records.record_path(corridor, seed)
        for corridor in (PAPER_HIGHWAY, SHORT_HIGHWAY, randomised(SHORT_HIGHWAY))
        for seed in (0, 1)
    ]
    monkeypatch.setattr(library, "sumo_version", lambda: "1.28.1")
    paths.append(records.record_path(SHORT_HIGHWAY, 0))
    monkeypatch.setattr(library, "RECORD_VERSION", 99)
    paths.append(records.record_path(SHORT_HIGHWAY, 0))
    assert len(set(paths)) == len(paths)


def test_ensure_records_what_is_missing_and_leaves_the_rest(tmp_path, short_record, monkeypatch):
    records = RecordLibrary(tmp_path)
    records.ensure(SHORT_HIGHWAY, [0, 1, 1], workers=2)
    untouched = records.record_path(SHORT_HIGHWAY, 1).stat().st_mtime_ns
    records.ensure(SHORT_HIGHWAY, range(4), workers=3)
    assert records.record_path(SHORT_HIGHWAY, 1).stat().st_mtime_ns == untouched
    forbid_recording(monkeypatch)
    records.ensure(SHORT_HIGHWAY, range(4))
    assert_same(records.get(SHORT_HIGHWAY, 0), short_record)
    assert len(everything_in(tmp_path)) == 4 * (len(Record.COLUMNS) + 1)


def test_ensure_shows_a_progress_bar_on_stderr_only_on_request(tmp_path, capsys):
    records = RecordLibrary(tmp_path)
    records.ensure(SHORT_HIGHWAY, [0])
    assert capsys.readouterr() == ("", "")
    records.ensure(SHORT_HIGHWAY, [1], progress=True)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "short-highway" in captured.err


def test_a_damaged_record_is_made_again_with_a_logged_warning(tmp_path, short_record, caplog):
    path = RecordLibrary(tmp_path).record_path(SHORT_HIGHWAY, 0)
    RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0)
    content = bytearray((path / "speed.npy").read_bytes())
    content[-1] ^= 1
    (path / "speed.npy").write_bytes(content)
    with caplog.at_level(logging.WARNING, logger="dptse_env"):
        assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "the checksum does not match" in caplog.text
    caplog.clear()
    assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
    assert caplog.text == ""
    assert len(everything_in(tmp_path)) == len(Record.COLUMNS) + 1


def test_a_record_of_another_seed_is_not_taken_for_this_one(tmp_path, caplog, short_record):
    records = RecordLibrary(tmp_path)
    records.get(SHORT_HIGHWAY, 1)
    records.record_path(SHORT_HIGHWAY, 1).rename(records.record_path(SHORT_HIGHWAY, 0))
    assert_same(records.get(SHORT_HIGHWAY, 0), short_record)
    assert "source is" in caplog.text


def test_get_leaves_a_simulation_of_the_user_alone(tmp_path, short_record, monkeypatch):
    monkeypatch.setattr(library, "simulation_is_loaded", lambda: True)
    monkeypatch.setattr(library, "simulate", None)
    assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)


def test_a_full_disk_is_one_error_that_names_the_seed(tmp_path, monkeypatch):
    def full(_descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(RecordingError, match=r"seed 3 failed: .*No space left"):
            RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 3)
    assert everything_in(tmp_path) == []
    assert RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 3).n_rows > 0


def test_an_unwritable_library_is_one_error_that_names_the_seed(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RecordingError, match="traffic seed 2 failed"):
        RecordLibrary(tmp_path / "file").ensure(SHORT_HIGHWAY, [2])
    with pytest.raises(RecordingError, match="traffic seed 2 failed"):
        RecordLibrary(tmp_path / "file").get(SHORT_HIGHWAY, 2)


def test_a_killed_worker_leaves_a_valid_library_and_names_its_seed(tmp_path, monkeypatch):
    healthy = Worker.record

    def killed(self, corridor, seed, path, source):
        if seed == 2:
            os.kill(self.pid, signal.SIGKILL)
        healthy(self, corridor, seed, path, source)

    records = RecordLibrary(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(Worker, "record", killed)
        with pytest.raises(RecordingError, match=r"traffic seed 2 failed: .*code -9"):
            records.ensure(SHORT_HIGHWAY, range(4), workers=2)
    records.ensure(SHORT_HIGHWAY, range(4), workers=2)
    for seed in range(4):
        assert records.get(SHORT_HIGHWAY, seed).n_rows > 0


def test_a_killed_process_leaves_a_valid_library(tmp_path, caplog):
    process = start_ensure(tmp_path, 200)
    deadline = time.monotonic() + 30
    while len(everything_in(tmp_path)) < 3 * (len(Record.COLUMNS) + 1):
        assert time.monotonic() < deadline, "nothing was recorded"
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    records = RecordLibrary(tmp_path)
    done = [s for s in range(200) if records.record_path(SHORT_HIGHWAY, s).is_dir()]
    assert 0 < len(done) < 200
    assert all(records.get(SHORT_HIGHWAY, seed).n_rows > 0 for seed in done)
    assert caplog.text == ""


def test_processes_recording_the_same_seeds_agree(tmp_path, short_record):
    processes = [start_ensure(tmp_path, 3) for _ in range(2)]
    for process in processes:
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
    assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
    assert len(everything_in(tmp_path)) == 3 * (len(Record.COLUMNS) + 1)


def test_a_library_pickles_as_its_path(tmp_path):
    records = RecordLibrary(tmp_path, n_open=7)
    records.get(SHORT_HIGHWAY, 0)
    copy = pickle.loads(pickle.dumps(records))
    assert (copy.path, copy.n_open) == (tmp_path, 7)
    assert_same(copy.get(SHORT_HIGHWAY, 0), records.get(SHORT_HIGHWAY, 0))


def test_the_environment_variable_comes_before_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DPTSE_CACHE", str(tmp_path))
    assert RecordLibrary().path == tmp_path
    monkeypatch.delenv("DPTSE_CACHE")
    assert RecordLibrary().path.name == "dptse-env"


@pytest.mark.parametrize("seed", [-1, 1.5, True])
def test_bad_seeds_and_counts_are_refused(tmp_path, seed):
    records = RecordLibrary(tmp_path)
    with pytest.raises(ValueError, match="traffic seed must be an integer >= 0"):
        records.get(SHORT_HIGHWAY, seed)
    with pytest.raises(ValueError, match="traffic seed must be an integer >= 0"):
        records.ensure(SHORT_HIGHWAY, [0, seed])
    with pytest.raises(ValueError, match="workers must be an integer >= 1, got 0"):
        records.ensure(SHORT_HIGHWAY, [0], workers=0)
    with pytest.raises(ValueError, match=r"library\.n_open must be an integer >= 1"):
        RecordLibrary(tmp_path, n_open=0)
    assert everything_in(tmp_path) == []

"""The cache of records: made once, found again, checked, and never left half written."""

import errno
import logging
import os
import pickle
import re

import numpy as np
import pytest

from dptse_env import versions
from dptse_env.traffic import (
    PAPER_HIGHWAY,
    SHORT_HIGHWAY,
    Record,
    RecordingError,
    RecordLibrary,
    SumoVersionError,
    library,
    randomised,
)
from tests.traffic.test_record import assert_same


def everything_in(path):
    return [entry for entry in path.rglob("*") if entry.is_file()]


def forbid_recording(monkeypatch):
    def refuse(*_):
        raise AssertionError("recorded again")

    monkeypatch.setattr(library, "record_seeds", refuse)


def tiny_record(path, seed):
    """Put a record of one row where the library looks for one."""
    one = np.ones(1)
    columns = SHORT_HIGHWAY.geometry.n_cells
    record = Record(
        step=one, vehicle=one, segment=one, speed=one,
        n_steps=SHORT_HIGHWAY.conditions.duration + 1, n_columns=columns,
    )  # fmt: skip
    source = library._source(SHORT_HIGHWAY, seed)
    record.save(RecordLibrary(path).record_path(SHORT_HIGHWAY, seed), source)


def test_a_record_is_made_once_and_then_read(tmp_path, short_record, monkeypatch, caplog):
    with caplog.at_level(logging.INFO, logger="dptse_env"):
        assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
        RecordLibrary(tmp_path).ensure(SHORT_HIGHWAY, [0, 1, 1], workers=8)  # one is missing
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO"]
    assert len(everything_in(tmp_path)) == 2
    forbid_recording(monkeypatch)
    records = RecordLibrary(tmp_path)
    records.ensure(SHORT_HIGHWAY, [0, 1])
    record = records.get(SHORT_HIGHWAY, 0)
    assert_same(record, short_record)
    monkeypatch.setattr(Record, "load", None)  # it is kept
    assert records.get(SHORT_HIGHWAY, np.int64(0)) is record


def test_the_records_read_last_are_kept_in_memory(tmp_path):
    for seed in range(3):
        tiny_record(tmp_path, seed)
    records = RecordLibrary(tmp_path, memory=28)  # two records of a row of 14 bytes
    first, second = records.get(SHORT_HIGHWAY, 0), records.get(SHORT_HIGHWAY, 1)
    assert records.get(SHORT_HIGHWAY, 0) is first
    records.get(SHORT_HIGHWAY, 2)  # pushes out 1, the least recently used
    assert records.get(SHORT_HIGHWAY, 0) is first
    assert records.get(SHORT_HIGHWAY, 1) is not second
    without = RecordLibrary(tmp_path, memory=0)
    assert without.get(SHORT_HIGHWAY, 0) is without.get(SHORT_HIGHWAY, 0)


def test_a_damaged_or_exchanged_record_is_made_again_with_a_logged_warning(
    tmp_path, short_record, caplog
):
    tiny_record(tmp_path, 0)
    tiny_record(tmp_path, 1)
    records = RecordLibrary(tmp_path)
    path = records.record_path(SHORT_HIGHWAY, 0)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with caplog.at_level(logging.WARNING, logger="dptse_env"):
        assert_same(records.get(SHORT_HIGHWAY, 0), short_record)
        assert "another digest" in caplog.text
        records.record_path(SHORT_HIGHWAY, 1).rename(path)
        assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
        assert "source is" in caplog.text
        assert [record.levelname for record in caplog.records] == ["WARNING"] * 2
        assert_same(RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0), short_record)
    assert len(caplog.records) == 2
    assert everything_in(tmp_path) == [path]


def test_a_record_replaces_a_link_and_not_what_it_leads_to(tmp_path):
    records, mine = RecordLibrary(tmp_path / "records"), tmp_path / "mine"
    path = records.record_path(SHORT_HIGHWAY, 0)
    path.parent.mkdir(parents=True)
    mine.write_text("mine")
    for target in (mine, tmp_path / "missing"):
        path.unlink(missing_ok=True)
        path.symlink_to(target)
        RecordLibrary(tmp_path / "records").get(SHORT_HIGHWAY, 0)
        assert not path.is_symlink()
    assert mine.read_text() == "mine"
    assert not (tmp_path / "missing").exists()


def test_what_shapes_a_record_is_in_its_path(tmp_path, monkeypatch):
    records = RecordLibrary(tmp_path)
    paths = [
        records.record_path(corridor, seed)
        for corridor in (PAPER_HIGHWAY, SHORT_HIGHWAY, randomised(SHORT_HIGHWAY))
        for seed in (0, 1)
    ]
    for name, value in (("sumo_version", lambda: "1.28.1"), ("RECORD_VERSION", 99)):
        monkeypatch.setattr(library, name, value)
        paths.append(records.record_path(SHORT_HIGHWAY, 0))
    assert len(set(paths)) == len(paths)


def test_records_by_a_newer_sumo_are_others_and_said_to_be(tmp_path, monkeypatch):
    monkeypatch.setattr(versions, "installed", lambda package: "1.100.2")
    with pytest.warns(UserWarning, match=r"libsumo 1\.100\.2 is newer than .*'libsumo~=1\.\d+\.0'"):
        path = RecordLibrary(tmp_path).record_path(SHORT_HIGHWAY, 0)
    assert path.is_relative_to(tmp_path / f"records-v{library.RECORD_VERSION}-sumo-1.100.2")


def test_a_library_pickles_as_its_path_which_the_environment_may_give(tmp_path, monkeypatch):
    tiny_record(tmp_path, 0)
    records = RecordLibrary(tmp_path, memory=7)
    records.get(SHORT_HIGHWAY, 0)
    copy = pickle.loads(pickle.dumps(records))
    assert (copy.path, copy.memory) == (tmp_path, 7)
    assert_same(copy.get(SHORT_HIGHWAY, 0), records.get(SHORT_HIGHWAY, 0))
    monkeypatch.setenv("DPTSE_CACHE", str(tmp_path))
    assert RecordLibrary().path == tmp_path
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.setenv("DPTSE_CACHE", "~/records")
    assert RecordLibrary().path == tmp_path / "records"
    monkeypatch.delenv("DPTSE_CACHE")
    assert RecordLibrary().path.name == "dptse-env"


def test_bad_seeds_and_counts_are_refused(tmp_path):
    records = RecordLibrary(tmp_path)
    for refused in (
        lambda: records.get(SHORT_HIGHWAY, -1),
        lambda: records.ensure(SHORT_HIGHWAY, [0, True]),
        lambda: records.missing(SHORT_HIGHWAY, [0, 1.5]),
    ):
        with pytest.raises(ValueError, match="traffic seed must be"):
            refused()
    with pytest.raises(ValueError, match="workers must be"):
        records.ensure(SHORT_HIGHWAY, [0], workers=0)
    with pytest.raises(ValueError, match=r"library\.memory must be"):
        RecordLibrary(tmp_path, memory=-1)
    assert everything_in(tmp_path) == []


def test_what_a_dead_writer_left_is_removed_when_it_is_old(tmp_path, monkeypatch):
    now = 1e9
    monkeypatch.setattr("time.time", lambda: now)
    tiny_record(tmp_path, 0)
    records = RecordLibrary(tmp_path)
    folder = records.record_path(SHORT_HIGHWAY, 0).parent
    names = [".00000007-1111", ".00000008-2222"]
    for name, age in zip(names, (library.LEFTOVER_AGE + 1, library.LEFTOVER_AGE), strict=True):
        (folder / name).write_bytes(b"half")
        os.utime(folder / name, (now - age, now - age))
    os.utime(records.record_path(SHORT_HIGHWAY, 0), (0, 0))
    records.ensure(SHORT_HIGHWAY, [0])
    assert (folder / names[0]).exists()  # nothing is written, so nothing is swept
    records.ensure(SHORT_HIGHWAY, [1])
    kept = [names[1], "00000000.safetensors", "00000001.safetensors"]
    assert sorted(entry.name for entry in folder.iterdir()) == kept


def test_a_library_that_cannot_grow_says_what_it_holds_and_why(tmp_path, monkeypatch):
    for seed in (0, 1, 2):
        tiny_record(tmp_path, seed)
    records = RecordLibrary(tmp_path)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    forbid_recording(monkeypatch)  # it is known before an hour of simulation
    held = re.escape(f"{tmp_path} holds 3 of the 5")
    pattern = rf"{held} .* seed 3 failed: records must be .*{os.strerror(errno.EROFS)}"
    for workers in (1, 2):
        with pytest.raises(RecordingError, match=pattern):
            records.ensure(SHORT_HIGHWAY, [*range(5), 4], workers=workers)
    monkeypatch.setenv("DPTSE_CACHE", str(tmp_path))
    with pytest.raises(RecordingError, match=r"holds 0 of the 1 .*seed 4 failed: DPTSE_CACHE must"):
        RecordLibrary().get(SHORT_HIGHWAY, 4)
    records.ensure(SHORT_HIGHWAY, range(3))
    assert records.get(SHORT_HIGHWAY, 1).n_rows == 1
    assert records.missing(SHORT_HIGHWAY, (5, np.int64(2), 3, 0, 5)) == [5, 3]


def test_a_missing_or_broken_libsumo_is_an_error_of_the_library(tmp_path, monkeypatch):
    tiny_record(tmp_path, 0)

    with monkeypatch.context() as patch:
        patch.setattr(versions, "installed", lambda package: None)
        with pytest.raises(SumoVersionError, match=r"neither find nor make the 1 .*libsumo"):
            RecordLibrary(tmp_path).get(SHORT_HIGHWAY, 0)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "libsumo.py").write_text("raise ImportError('no libproj')")
    monkeypatch.syspath_prepend(tmp_path / "broken")
    records = RecordLibrary(tmp_path)
    with pytest.raises(
        SumoVersionError, match=r"holds 1 of the 2 .* cannot be imported .no libproj"
    ):
        records.ensure(SHORT_HIGHWAY, [0, 1], workers=1)
    assert records.get(SHORT_HIGHWAY, 0).n_rows == 1

import errno
import json
import os
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dptse_env.traffic import InvalidRecordError, Record, mean_dwell
from dptse_env.traffic.stored_arrays import _checksum

SOURCE = {"corridor": "abc", "seed": 3, "sumo": "1.28.0"}


def small_record(**changed):
    fields = {
        "step": [0, 0, 1, 1, 1, 3],
        "vehicle": [0, 1, 0, 1, 4, 4],
        "segment": [0, 0, 0, 1, 1, 2],
        "speed": [10.0, 20.0, 30.0, 40.0, 50.0, 60.0],
        "n_steps": 4,
        "n_columns": 3,
    }
    return Record(**fields | changed)


def assert_same(first, second):
    assert (first.n_steps, first.n_columns) == (second.n_steps, second.n_columns)
    for name in Record.COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_counts_and_speed_sums_by_hand():
    record = small_record()
    np.testing.assert_array_equal(record.counts, [[2, 0, 0], [1, 2, 0], [0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(
        record.speed_sums, [[30, 0, 0], [30, 90, 0], [0, 0, 0], [0, 0, 60]]
    )
    assert record.counts is record.counts
    assert record.speed_sums.dtype == np.float64
    assert record.n_vehicles == 5


def once_a_step():
    entry = st.tuples(st.integers(0, 5), st.integers(0, 9), st.integers(0, 3))
    return st.lists(entry, max_size=40, unique_by=lambda one: one[:2])


@given(once_a_step())
def test_rows_and_grids_agree_with_a_loop(entries):
    entries.sort()
    step, vehicle, segment = zip(*entries, strict=True) if entries else ((), (), ())
    speed = np.linspace(0, 100, len(entries))
    record = Record(step, vehicle, segment, speed, n_steps=6, n_columns=4)
    for k in range(6):
        rows = record.rows(k)
        assert list(record.step[rows]) == [k] * sum(s == k for s in step)
        for j in range(4):
            here = (record.step == k) & (record.segment == j)
            assert record.counts[k, j] == here.sum()
            assert record.speed_sums[k, j] == pytest.approx(record.speed[here].sum(), rel=1e-6)


def test_columns_have_the_declared_types_are_contiguous_and_read_only():
    record = small_record()
    for name, dtype in Record.COLUMNS.items():
        column = getattr(record, name)
        assert column.dtype == dtype
        assert column.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 1
    for grid in (record.counts, record.speed_sums, record.offsets):
        assert not grid.flags.writeable


IMPOSSIBLE = [
    ({"step": [0, 0, 1, 1, 1]}, "vehicle must be as long as"),
    ({"step": [0, 1, 0, 1, 1, 3]}, "step must be non-decreasing"),
    ({"n_steps": 3}, "step must be in"),
    ({"n_columns": 2}, "segment must be in"),
    ({"vehicle": [-1, 0, 0, 0, 0, 0]}, "vehicle must be >= 0"),
    ({"speed": [1, 1, 1, np.nan, 1, 1]}, "speed must be finite"),
    ({"speed": [1, 1, 1, -1, 1, 1]}, "speed must be finite and >= 0"),
    ({"n_steps": 0}, "n_steps must be"),
    ({"speed": np.ones((6, 1))}, "speed must be one-dimensional"),
    ({"vehicle": [0, 1, 4, 1, 4, 4]}, "vehicle must be at most once in a step"),
]


def test_impossible_tables_are_refused():
    for fields, message in IMPOSSIBLE:
        with pytest.raises(ValueError, match=rf"^record\.{message}"):
            small_record(**fields)


def test_removing_a_vehicle_removes_exactly_its_rows():
    record = small_record()
    adjacent = record.without(4)
    np.testing.assert_array_equal(
        record.counts - adjacent.counts, [[0] * 3, [0, 1, 0], [0] * 3, [0, 0, 1]]
    )
    assert_same(record.without(99), record)


def test_mean_dwell_by_hand():
    record = Record(
        # Vehicle 0 stays 2 steps on segment 0 and 1 on segment 1, vehicle 1 stays 4 on segment 1,
        # and its later return counts as another passage; segment 2 is not on the mainline.
        step=[0, 1, 1, 2, 2, 3, 4, 5, 7],
        vehicle=[0, 0, 1, 0, 1, 1, 1, 1, 1],
        segment=[0, 0, 1, 1, 1, 1, 1, 2, 1],
        speed=np.ones(9),
        n_steps=8,
        n_columns=3,
    )
    assert mean_dwell([record], n_mainline=2) == pytest.approx((2 + 1 + 4 + 1) / 4)
    assert mean_dwell([record, record], n_mainline=2) == pytest.approx(2.0)
    with pytest.raises(ValueError, match="records with a vehicle on the mainline"):
        mean_dwell([], n_mainline=2)


def test_a_saved_record_comes_back_memory_mapped(tmp_path):
    record = small_record()
    record.save(tmp_path / "a" / "b", SOURCE)
    loaded = Record.load(tmp_path / "a" / "b", SOURCE)
    assert_same(record, loaded)
    assert isinstance(loaded.speed.base, np.memmap) or isinstance(loaded.speed, np.memmap)
    assert isinstance(loaded.in_memory().speed.base, np.memmap) is False
    assert [entry.name for entry in (tmp_path / "a").iterdir()] == ["b"]


def test_many_writers_of_one_record_leave_one_valid_record(tmp_path):
    writers = [
        threading.Thread(target=small_record().save, args=(tmp_path / "record", SOURCE))
        for _ in range(8)
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert_same(Record.load(tmp_path / "record", SOURCE), small_record())
    assert [entry.name for entry in tmp_path.iterdir()] == ["record"]


def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def full(_descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        small_record().save(tmp_path / "record", SOURCE)
    assert list(tmp_path.iterdir()) == []


def flip_a_byte(path):
    content = bytearray((path / "speed.npy").read_bytes())
    content[-1] ^= 1
    (path / "speed.npy").write_bytes(content)


def double_a_vehicle(path):
    """Write a record that no recording makes, with a checksum that is right."""
    vehicle = np.load(path / "vehicle.npy")
    vehicle[:] = 0
    np.save(path / "vehicle.npy", vehicle)
    manifest = json.loads((path / "manifest.json").read_text())
    del manifest["sha256"]
    edit_manifest(path, sha256=_checksum(path, list(Record.COLUMNS), manifest))


def edit_manifest(path, **changes):
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | changes))


DAMAGE = {
    "flipped bit": flip_a_byte,
    "vehicle in two places": double_a_vehicle,
    "truncated column": lambda path: os.truncate(path / "step.npy", 130),
    "empty column": lambda path: os.truncate(path / "step.npy", 0),
    "missing column": lambda path: (path / "vehicle.npy").unlink(),
    "missing manifest": lambda path: (path / "manifest.json").unlink(),
    "manifest that is no JSON": lambda path: (path / "manifest.json").write_text("{"),
    "manifest that is nested without end": lambda path: (path / "manifest.json").write_text(
        "[" * 100_000
    ),
    "manifest that is a list": lambda path: (path / "manifest.json").write_text("[]"),
    "manifest with another number of steps": lambda path: edit_manifest(path, n_steps=5),
    "manifest of another version": lambda path: edit_manifest(path, version=0),
    "manifest of another source": lambda path: edit_manifest(path, source=SOURCE | {"seed": 4}),
}


def test_damaged_and_foreign_records_are_refused(tmp_path):
    for name, damage in DAMAGE.items():
        path = tmp_path / name
        small_record().save(path, SOURCE)
        damage(path)
        with pytest.raises(InvalidRecordError, match=name):
            Record.load(path, SOURCE)


def test_a_record_that_is_not_there_is_not_called_invalid(tmp_path):
    with pytest.raises(FileNotFoundError):
        Record.load(tmp_path / "nothing", SOURCE)

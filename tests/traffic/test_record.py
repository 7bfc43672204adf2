"""Records of vehicles and of fields: what they say of traffic, and how they are kept."""

from functools import partial

import numpy as np
import pytest

from dptse_env.traffic import SHORT_HIGHWAY, InvalidRecordError, Record, average_dwell
from dptse_env.utils.files import read_tensors
from tests.hostile import check_refusals, damaged, edited, odd

SOURCE = {"corridor": "abc", "seed": 3, "sumo": "1.28.0"}
TABLE = {
    "step": [0, 0, 1, 1, 1, 3],
    "vehicle": [0, 1, 0, 1, 4, 4],
    "segment": [0, 0, 0, 1, 1, 2],
    "speed": [10.0, 20.0, 30.0, 40.0, 50.0, 60.0],
    "n_steps": 4,
    "n_columns": 3,
}
FIELD = {
    "field": [[[10.0, 90.0], [0.0, 5.0]], [[20.5, 80.0], [0.5, 70.0]]],
    "n_steps": 2,
    "n_columns": 2,
}


def assert_same(first, second):
    assert (first.n_steps, first.n_columns) == (second.n_steps, second.n_columns)
    assert first.arrays.keys() == second.arrays.keys()
    for name, array in first.arrays.items():
        np.testing.assert_array_equal(array, second.arrays[name])


def test_counts_and_speed_sums_by_hand():
    given = np.array(TABLE["speed"], dtype=np.float32)
    record = Record(**TABLE | {"speed": given})
    given[0] = 99.0
    np.testing.assert_array_equal(record.counts, [[2, 0, 0], [1, 2, 0], [0, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(
        record.speed_sums, [[30, 0, 0], [30, 90, 0], [0, 0, 0], [0, 0, 60]]
    )
    traffic = record.traffic(np.array([0.1, 0.2, 0.1]), np.array([100.0, 80.0, 60.0]))
    np.testing.assert_array_equal(traffic[1], [[10.0, 30.0], [10.0, 45.0], [0.0, 60.0]])
    for name, dtype in Record.COLUMNS.items():
        assert record.arrays[name].dtype == dtype
    for array in (*record.arrays.values(), record.counts, record.offsets, Record(**FIELD).field):
        assert not array.flags.writeable
    assert (record.n_vehicles, record.has_vehicles) == (5, True)


IMPOSSIBLE = [
    (TABLE | {"step": [0, 0, 1, 1, 1]}, r"vehicle must be of shape \(5,\), got \(6,\)"),
    (TABLE | {"step": [0, 1, 0, 1, 1, 3]}, r"step must be non-decreasing, got \(1, 0\)"),
    (TABLE | {"n_steps": 3}, "step must be in"),
    (TABLE | {"n_columns": 2}, "segment must be in"),
    (TABLE | {"vehicle": [-1, 0, 0, 0, 0, 0]}, r"vehicle must be in 0\.\.1048575, got \(-1, 0\)"),
    (TABLE | {"vehicle": [0, 1, 2**20, 0, 1, 2]}, "vehicle must be in"),
    (TABLE | {"speed": [1, 1, 1, np.nan, 1, 1]}, "speed must be finite"),
    (TABLE | {"speed": [1, 1, 1, -1, 1, 1]}, "speed must be finite and >= 0"),
    (TABLE | {"vehicle": [0, 1, 4, 1, 4, 4]}, "vehicle must be at most once in a step"),
    (TABLE | FIELD, "field must be None where there are vehicles"),
    (FIELD | {"n_steps": 3}, r"field must be of shape \(3, 2, 2\)"),
    (FIELD | {"field": np.full((2, 2, 2), np.nan)}, "field must be finite"),
    (FIELD | {"field": np.full((2, 2, 2), -1.0)}, "field must be finite and >= 0"),
]


def test_impossible_records_are_refused():
    for fields, message in IMPOSSIBLE:
        with pytest.raises(ValueError, match=rf"^record\.{message}"):
            Record(**fields)


def test_two_vehicles_at_two_steps_are_not_one_that_is_there_twice():
    record = Record(
        step=[0, 2], vehicle=[1, 0], segment=[0, 0], speed=[9.0, 9.0], n_steps=3, n_columns=1
    )
    assert record.counts[:, 0].tolist() == [1, 0, 1]


def test_removing_a_vehicle_removes_exactly_its_rows():
    record = Record(**TABLE)
    adjacent = record.without(4)
    np.testing.assert_array_equal(
        record.counts - adjacent.counts, [[0] * 3, [0, 1, 0], [0] * 3, [0, 0, 1]]
    )
    assert_same(record.without(99), record)
    digests = [each.digest for each in (record, adjacent, Record(**TABLE | {"n_columns": 4}))]
    assert len(set(digests)) == 3
    assert record.without(99).digest == record.digest


def test_a_field_is_its_own_traffic_with_the_limit_where_the_road_is_empty():
    record = Record(**FIELD)
    traffic = record.traffic(np.array([0.1, 0.2]), np.array([100.0, 60.0]))
    np.testing.assert_array_equal(traffic, [[[10, 90], [0, 60]], [[20.5, 80], [0.5, 70]]])
    with pytest.raises(ValueError, match=r"privacy.preset 'paced' needs the vehicles of a record"):
        record.vehicles_for("privacy.preset 'paced'")


def test_average_dwell_by_hand():
    road = SHORT_HIGHWAY  # six segments of 0.1 km
    record = Record(
        # Vehicle 0 stays 2 steps on segment 0 and 1 on segment 1, vehicle 1 stays 4 on segment 1,
        # and its later return counts as another passage; segment 6 is not on the mainline.
        step=[0, 1, 1, 2, 2, 3, 4, 5, 7],
        vehicle=[0, 0, 1, 0, 1, 1, 1, 1, 1],
        segment=[0, 0, 1, 1, 1, 1, 1, 6, 1],
        speed=np.ones(9),
        n_steps=8,
        n_columns=7,
    )
    assert average_dwell(road, [record, record]) == pytest.approx((2 + 1 + 4 + 1) / 4)
    field = Record(field=np.full((5, 12, 2), [20.0, 36.0]), n_steps=5, n_columns=12)
    assert average_dwell(road, [field]) == pytest.approx(10.0)  # 100 m at 10 m/s
    with pytest.raises(ValueError, match=r"corridor\.demand must be one that brings vehicles"):
        average_dwell(road, [])


@pytest.mark.parametrize("content", [TABLE, FIELD])
def test_a_saved_record_comes_back(content, tmp_path):
    record, path = Record(**content), tmp_path / "a" / "b"
    record.save(path, SOURCE)
    loaded = Record.load(path, SOURCE, (record.n_steps, record.n_columns))
    assert_same(record, loaded)
    assert loaded.digest == record.digest


@pytest.mark.parametrize("content", [TABLE, FIELD])
def test_hostile_files_are_refused_in_one_line_with_their_path(content, tmp_path):
    good = tmp_path / "good"
    Record(**content).save(good, SOURCE)
    load = partial(Record.load, source=SOURCE, shape=(content["n_steps"], content["n_columns"]))
    check_refusals(load, tmp_path / "bad", damaged(good.read_bytes(), flips=400))
    kinds = odd(*read_tensors(good))
    same = "shape: type" if content is FIELD else None  # float64, as it should be
    check_refusals(load, tmp_path / "bad", [each for each in kinds if each[0] != same])


FOREIGN = {
    "n_steps": [("many", "n_steps is 'many', not 4"), (10**12, "n_steps is 10+, not 4")],
    "version": [(0, "version is 0, not 2")],
    "source": [(SOURCE | {"seed": 4}, "source is"), ("x" * 100_000, "source is 'x")],
    "vehicle": [
        (np.zeros(6, dtype=np.int32), "vehicle must be at most once in a step"),
        (np.arange(5, dtype=np.int32), "vehicle must be of shape"),
    ],
    "step": [(np.array(TABLE["step"], dtype=np.float32), "arrays must be")],
    "field": [(np.zeros((4, 3, 2)), "arrays must be")],
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_foreign_record_with_a_true_digest_is_refused(name, tmp_path):
    good, bad = tmp_path / "good", tmp_path / "bad"
    Record(**TABLE).save(good, SOURCE)
    for value, message in FOREIGN[name]:

        def change(card, arrays, value=value):
            (arrays if isinstance(value, np.ndarray) else card)[name] = value

        bad.write_bytes(edited(good, change))
        with pytest.raises(InvalidRecordError, match=rf"bad: (record\.)?{message}") as caught:
            Record.load(bad, SOURCE, (4, 3))
        assert len(str(caught.value)) < 1000
    with pytest.raises(FileNotFoundError):  # not called invalid
        Record.load(tmp_path / "nothing", SOURCE, (4, 3))

"""Records with positions, lanes and classes: on disk, and as SUMO gives them."""

import dataclasses

import numpy as np
import pytest

from dptse_env.traffic import (
    SHORT_HIGHWAY,
    DetailedRecord,
    InvalidRecordError,
    Record,
    simulate,
)
from dptse_env.traffic.branches import Road

DETAILED = dataclasses.replace(SHORT_HIGHWAY, detailed=True)


def small_record(**changed):
    fields = {
        "step": [0, 0, 1],
        "vehicle": [0, 2, 0],
        "segment": [0, 0, 1],
        "speed": [10.0, 20.0, 30.0],
        "n_steps": 2,
        "n_columns": 3,
        "position": [0.02, 0.04, 0.12],
        "lane": [0, 1, 0],
        "vehicle_class": [1, 0, 1],
        "classes": ["car", "truck"],
    }
    return DetailedRecord(**fields | changed)


def assert_same(first, second):
    assert (first.n_steps, first.n_columns) == (second.n_steps, second.n_columns)
    for name in first.COLUMNS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_details_survive_the_disk_and_the_choice_of_rows(tmp_path):
    record = small_record()
    record.save(tmp_path / "record", {"seed": 3})
    loaded = DetailedRecord.load(tmp_path / "record", {"seed": 3})
    assert_same(record, loaded)
    assert loaded.classes == loaded.in_memory().classes == ("car", "truck")
    without = loaded.without(2)
    assert isinstance(without, DetailedRecord)
    np.testing.assert_array_equal(without.position, record.position[[0, 2]])
    np.testing.assert_array_equal(record.class_of_vehicles(), [1, -1, 0])


def test_a_plain_record_is_no_detailed_one_nor_the_other_way_round(tmp_path):
    small_record().save(tmp_path / "detailed", {})
    with pytest.raises(InvalidRecordError, match="detailed"):
        Record.load(tmp_path / "detailed", {})
    Record([0], [0], [0], [1.0], n_steps=1, n_columns=1).save(tmp_path / "plain", {})
    with pytest.raises(InvalidRecordError, match="plain"):
        DetailedRecord.load(tmp_path / "plain", {})


def test_positions_lie_on_the_segments_and_lanes_on_the_road():
    record = simulate(DETAILED, 0)
    start = Road(DETAILED).column_starts[1]
    lengths = np.array(DETAILED.with_boundaries(DETAILED.segment_lengths))
    along = record.position - start[record.segment]
    assert along.min() >= 0.0
    assert np.all(along <= lengths[record.segment] + 1e-6)
    lanes = np.array(DETAILED.with_boundaries(DETAILED.segment_lanes))
    assert record.lane.min() == 0
    # The lane of a ramp goes on beside the mainline until its end: one lane more.
    assert np.all(record.lane <= lanes[record.segment])
    mainline = record.segment < DETAILED.n_mainline
    assert set(record.lane[mainline].tolist()) >= {0, 1}
    assert record.classes == ("car",)

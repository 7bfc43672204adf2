"""Records without vehicles."""

import numpy as np
import pytest

from dptse_env.traffic import InvalidRecordError, Record
from dptse_env.traffic.field_record import FieldRecord, load_record, with_vehicles

SOURCE = {"recorded": True, "seed": 3}
FIELD = FieldRecord(np.array([[10.0, 0.0], [20.5, 3.0]]), np.array([[90.0, 5.0], [80.0, 70.0]]))


def test_a_field_is_its_own_traffic_with_the_limit_where_the_road_is_empty():
    traffic = FIELD.traffic(np.array([0.1, 0.2]), np.array([100.0, 60.0]))
    np.testing.assert_array_equal(traffic[..., 0], FIELD.density)
    np.testing.assert_array_equal(traffic[..., 1], [[90.0, 60.0], [80.0, 70.0]])
    assert (FIELD.n_steps, FIELD.n_columns) == (2, 2)


def test_a_stored_field_is_read_again_as_it_was(tmp_path):
    FIELD.save(tmp_path / "f", SOURCE)
    read = load_record(tmp_path / "f", SOURCE)
    assert isinstance(read, FieldRecord)
    np.testing.assert_array_equal(read.density, FIELD.density)
    np.testing.assert_array_equal(read.speed, FIELD.speed)


def test_a_record_of_vehicles_is_read_as_one(tmp_path):
    record = Record([0, 1], [0, 0], [0, 1], [50.0, 60.0], n_steps=2, n_columns=2)
    record.save(tmp_path / "r", SOURCE)
    assert with_vehicles(load_record(tmp_path / "r", SOURCE), "paced") is not None


def test_what_needs_vehicles_says_so():
    with pytest.raises(ValueError, match=r"privacy.preset 'paced' needs the vehicles of a record"):
        with_vehicles(FIELD, "privacy.preset 'paced'")


@pytest.mark.parametrize(
    ("density", "speed", "message"),
    [
        ([[1.0]], [[1.0, 2.0]], r"field\.speed must be of the density's shape"),
        ([[-1.0]], [[1.0]], r"field\.density must be finite and >= 0"),
        ([[1.0]], [[np.nan]], r"field\.speed must be finite and >= 0"),
    ],
)
def test_impossible_fields_are_refused(density, speed, message):
    with pytest.raises(ValueError, match=message):
        FieldRecord(density, speed)


def test_damage_is_found(tmp_path):
    FIELD.save(tmp_path / "f", SOURCE)
    with pytest.raises(InvalidRecordError, match="source is"):
        load_record(tmp_path / "f", {"seed": 4})
    with (tmp_path / "f" / "speed.npy").open("r+b") as file:
        file.seek(-3, 2)
        file.write(b"x")
    with pytest.raises(InvalidRecordError, match="checksum"):
        load_record(tmp_path / "f", SOURCE)
    with pytest.raises(FileNotFoundError):
        load_record(tmp_path / "none", SOURCE)
    (tmp_path / "f" / "manifest.json").write_text("[" * 100_000)
    with pytest.raises(InvalidRecordError):
        load_record(tmp_path / "f", SOURCE)

"""Files with a card: what is written is read, whole or not at all, and nothing else."""

import os

import numpy as np
import pytest

from dptse_env.utils.files import (
    read_tensors,
    replacing,
    require_arrays,
    write_atomically,
    write_tensors,
)
from tests.hostile import check_hostile

CARD = {"name": "ünïcode", "steps": [1, 2.5, None], "nested": {"b": True}}
ARRAYS = {
    "weights": np.linspace(0.0, 1.0, 300, dtype=np.float32).reshape(20, 15),
    "columns": np.arange(7, dtype=np.int16),
    "empty": np.empty((0, 4)),
    "one": np.array(3.0),
}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "good.safetensors"
    write_tensors(path, ARRAYS, CARD)
    return path


def test_what_is_written_is_read(path):
    card, arrays = read_tensors(path)
    assert {key: value for key, value in card.items() if key != "sha256"} == CARD
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert (arrays[name].dtype, arrays[name].flags.writeable) == (array.dtype, False)


def test_the_same_content_gives_the_same_bytes(path, tmp_path):
    again = tmp_path / "again.safetensors"
    card, arrays = read_tensors(path)
    turned = {name: np.array(arrays[name], order="F") for name in reversed(arrays)}
    write_tensors(again, {**turned, "one": turned["one"].astype(">f8")}, card)
    assert again.read_bytes() == path.read_bytes()


def test_damage_is_refused_soon_and_in_little_memory(path, tmp_path):
    check_hostile(read_tensors, path, tmp_path / "bad.safetensors", shapes=False)


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(ValueError, match="not a regular file"):
            read_tensors(path)
    with pytest.raises(FileNotFoundError):
        read_tensors(tmp_path / "absent")


@pytest.mark.parametrize(
    ("arrays", "card", "reason"),
    [
        ({"a": np.array([1.0, np.nan])}, {}, "a must be finite"),
        ({"a": np.array([True])}, {}, "a must be of integers or floats, got bool"),
        ({"a": np.array([print])}, {}, "dtype"),
        ({"a": np.zeros(2**22)}, {}, "more than 16777216"),
        ({"a": np.zeros(1)}, {"notes": "x" * 2**20}, "its header must have at most 1048576 bytes"),
        ({"a": np.zeros(1)}, {"loss": np.inf}, "not JSON compliant"),
        ({"a": np.zeros(1)}, {"policy": print}, "not JSON serializable"),
    ],
)
def test_nothing_is_written_that_could_not_be_read(arrays, card, reason, path):
    before = path.read_bytes()
    with pytest.raises(ValueError, match=rf"good\.safetensors cannot be written: .*{reason}"):
        write_tensors(path, arrays, card)
    assert path.read_bytes() == before
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("shapes", "reason"),
    [
        ({"a": (2, 3), "b": (1,)}, "lacks the arrays b"),
        ({}, "has the arrays a"),
        ({"a": (3, 2)}, r"a must be float32 of shape \(3, 2\), got float32 of \(2, 3\)"),
    ],
)
def test_other_arrays_are_refused(shapes, reason):
    arrays = {"a": np.zeros((2, 3), dtype=np.float32)}
    require_arrays(arrays, {"a": (2, 3)}, np.float32)
    with pytest.raises(ValueError, match=reason):
        require_arrays(arrays, shapes, np.float32)
    with pytest.raises(ValueError, match="a must be float64"):
        require_arrays(arrays, {"a": (2, 3)}, np.float64)


def test_text_and_bytes_are_written_as_they_are(tmp_path):
    write_atomically(tmp_path / "a", "ε\n")
    write_atomically(tmp_path / "b", b"\x00\xff")
    assert (tmp_path / "a").read_text(encoding="utf-8") == "ε\n"
    assert (tmp_path / "b").read_bytes() == b"\x00\xff"


def test_a_file_is_replaced_when_the_new_one_is_complete_or_not_at_all(tmp_path):
    path = tmp_path / "state.json"
    write_atomically(path, "old")

    def interrupted():
        with replacing(path) as temporary:
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    with path.open() as reader:
        with replacing(path) as temporary:
            temporary.write_text("new")
        assert reader.read() == "old"  # who reads meanwhile reads one of the two
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]

"""Files with a card: what is written is read, whole or not at all, and nothing else."""

import errno
import os
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from dptse_env.utils import validation
from dptse_env.utils.files import (
    read_tensors,
    replacing,
    require_arrays,
    write_atomically,
    write_tensors,
)
from dptse_env.utils.validation import read_toml
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


def test_damage_is_refused(path, tmp_path):
    check_hostile(read_tensors, path, tmp_path / "bad.safetensors", shapes=False)


def test_what_is_too_large_is_refused_unread(path, monkeypatch):
    monkeypatch.setattr(validation, "LARGEST_TOML", 8)
    monkeypatch.setattr(Path, "read_bytes", lambda path: pytest.fail(f"{path} is read"))
    for read in (lambda: read_tensors(path, largest=8), lambda: read_toml(path, "road file")):
        with pytest.raises(ValueError, match=r"good\.safetensors.* at most 8 bytes, got"):
            read()


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


def test_what_is_no_file_and_other_arrays_are_refused(tmp_path):
    devices = [each for each in (Path("/dev/zero"),) if each.exists()]
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        devices.append(tmp_path / "pipe")
    for path in (tmp_path, *devices):
        with pytest.raises(ValueError, match="not a regular file"):
            read_tensors(path)
    with pytest.raises(FileNotFoundError):
        read_tensors(tmp_path / "absent")
    arrays = {"a": np.zeros((2, 3), dtype=np.float32)}
    require_arrays(arrays, {"a": (2, 3)}, np.float32)
    for shapes, dtype, reason in (
        ({"a": (2, 3), "b": (1,)}, np.float32, "lacks the arrays b"),
        ({}, np.float32, "has the arrays a"),
        (
            {"a": (3, 2)},
            np.float32,
            r"a must be float32 of shape \(3, 2\), got .* of \(2, 3\)",
        ),
        ({"a": (2, 3)}, np.float64, "a must be float64"),
    ):
        with pytest.raises(ValueError, match=reason):
            require_arrays(arrays, shapes, dtype)


def test_a_file_is_replaced_when_the_new_one_is_complete_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "state.json"
    write_atomically(path, "old ε\n")
    assert path.read_bytes() == b"old \xce\xb5\n"

    def interrupted():
        with replacing(path) as temporary:
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    def full(_descriptor):
        raise OSError(errno.ENOSPC, "No space left")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left") as raised:
            write_atomically(path, "new")
        assert raised.value.filename == str(path)
    assert path.read_bytes() == b"old \xce\xb5\n"
    writers = [Thread(target=write_atomically, args=(path, b"\x00\xff")) for _ in range(8)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert path.read_bytes() == b"\x00\xff"
    assert list(tmp_path.iterdir()) == [path]


def test_readers_of_a_file_that_is_replaced_are_waited_for_where_they_prevent_it(
    tmp_path, monkeypatch
):
    path, replace, refusals = tmp_path / "state.json", Path.replace, [3]

    def refused(source, target):
        if refusals[0] > 0:
            refusals[0] -= 1
            raise PermissionError("another process reads it")
        return replace(source, target)

    monkeypatch.setattr(Path, "replace", refused)
    monkeypatch.setattr("dptse_env.utils.files.PATIENCE", 0.0)
    with pytest.raises(PermissionError):
        write_atomically(path, "new")
    monkeypatch.setattr("dptse_env.utils.files.PATIENCE", 5.0)
    write_atomically(path, "new")
    assert path.read_bytes() == b"new"

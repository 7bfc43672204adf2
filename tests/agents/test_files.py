import json

import pytest

from agents.files import replacing, write_atomically, write_json


def test_text_and_bytes_are_written_as_they_are(tmp_path):
    write_atomically(tmp_path / "a", "ε\n")
    write_atomically(tmp_path / "b", b"\x00\xff")
    assert (tmp_path / "a").read_text(encoding="utf-8") == "ε\n"
    assert (tmp_path / "b").read_bytes() == b"\x00\xff"
    write_json(tmp_path / "c", {"b": 1, "a": [2.5]}, sort_keys=True)
    assert json.loads((tmp_path / "c").read_text()) == {"a": [2.5], "b": 1}
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b", "c"}


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "state.json"
    write_atomically(path, "old")

    def interrupted():
        with replacing(path) as temporary:
            temporary.write_text("half of the n")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_new_file_appears_when_it_is_complete(tmp_path):
    path = tmp_path / "state.json"
    write_atomically(path, "old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_numbers_that_are_not_finite_are_no_json(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"error": float("nan")})
    assert list(tmp_path.iterdir()) == []

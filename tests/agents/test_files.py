import json

import pytest

from agents.files import write_json


def test_plain_values_are_written_as_indented_json(tmp_path):
    write_json(tmp_path / "c", {"b": 1, "a": [2.5]}, sort_keys=True)
    assert (tmp_path / "c").read_text() == '{\n  "a": [\n    2.5\n  ],\n  "b": 1\n}\n'
    assert json.loads((tmp_path / "c").read_text()) == {"a": [2.5], "b": 1}


def test_numbers_that_are_not_finite_are_no_json(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"error": float("nan")})
    assert list(tmp_path.iterdir()) == []

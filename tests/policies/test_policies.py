"""Policy files read without torch."""

import sys
from pathlib import Path

import numpy as np
import pytest

import dptse_env.policies
from dptse_env.policies import read_policy, shipped_policies
from tests.hostile import check_hostile, edited

SHIPPED = Path(dptse_env.policies.__file__).parent / "short-highway.safetensors"
DIGESTS = {
    "paper-highway-capped": "fe8151e90ada",
    "short-highway": "d89a8c5a48dc",
    "short-highway-capped": "b93572eb2357",
    "short-highway-corrected": "9c8693821d23",
    "short-highway-every-fourth": "0a524c0fa60c",
}
"""The first digits of the digests of card and weights, by which recorded results know a policy."""


def test_card_and_weights_are_read_without_torch(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    file = read_policy("short-highway")
    assert file.card["training"]["seed"] == 0
    assert len(file.weights) == 6
    assert {array.dtype for array in file.weights.values()} == {np.dtype(np.float32)}


def test_the_policies_are_those_of_recorded_results():
    assert {name: read_policy(name).identity[:12] for name in shipped_policies()} == DIGESTS


def test_damage_is_refused(tmp_path):
    check_hostile(read_policy, SHIPPED, tmp_path / "bad.safetensors", shapes=False)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda card: card.pop("fits"), "'fits' of type dict"),
        (lambda card: card["fits"].update(action=3), r"'fits\.action' of type str"),
        (lambda card: card["fits"].pop("privacy"), r"'fits\.privacy' of type dict"),
        (lambda card: card.update(policy=[]), "'policy' of type dict"),
    ],
)
def test_a_card_that_lacks_a_field_is_refused(change, message, tmp_path):
    path = tmp_path / "some.safetensors"
    path.write_bytes(edited(SHIPPED, lambda card, weights: change(card)))
    with pytest.raises(ValueError, match=rf"some.* is not a saved policy: .*{message}"):
        read_policy(path)


def test_a_card_imports_no_code(tmp_path):
    path = tmp_path / "some.safetensors"
    change = {"action": "own:Part"}
    path.write_bytes(edited(SHIPPED, lambda card, weights: card["fits"].update(change)))
    with pytest.raises(ValueError, match=r"fits\.action must be a reg.*got 'own:Part'$"):
        read_policy(path)


def test_files_that_are_not_there_or_of_models(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"'absent': .*come with the package \(paper-"):
        read_policy("absent")
    (tmp_path / "model.zip").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match=r"model\.zip is no saved policy; dptse import policy"):
        read_policy(tmp_path / "model.zip")

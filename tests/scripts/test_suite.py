"""The suite by the command."""

import json

import pytest

from tests.agents.studies.test_suite import SMALL, recorded, small  # noqa: F401 (fixtures)
from tests.helpers import save_untrained
from tests.scripts.commands import refused, run_command

pytestmark = pytest.mark.usefixtures("small")


def test_a_policy_gets_a_card_and_its_scores_beside_another_card(tmp_path):
    words = "--output", tmp_path / "mine", "--workers", "1"
    done = run_command("suite", "random", *words)
    assert done.returncode == 0, done.stderr
    card = json.loads((tmp_path / "mine" / "card.json").read_text())
    assert card["scores"].keys() == SMALL.keys()
    words = "--beside", tmp_path / "mine/card.json", "--output", tmp_path / "other"
    done = run_command("suite", "static", *words, "--workers", "1")
    (line,) = (line for line in done.stdout.splitlines() if line.strip().startswith("mean"))
    assert f"{card['score']['mean']:.2f} ±" in line


def test_cells_that_a_policy_does_not_suit_are_left_out(tmp_path):
    saved = save_untrained(tmp_path / "run" / "best.safetensors", estimator="random_walk")
    done = run_command("suite", saved, "--output", tmp_path / "out", "--workers", "1")
    assert done.returncode == 0, done.stderr
    card = json.loads((tmp_path / "out" / "card.json").read_text())
    assert "1 of 2 cells do not suit" in done.stderr
    assert (card["scores"].keys(), card["score"]) == ({"plain"}, None)
    assert card["policy"]["name"] == "run/best"
    assert len(card["policy"]["identity"]) == 64


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nobody.safetensors",), "nobody.safetensors"),
        (("nobody",), "'nobody'"),
        (("static", "--beside", "nobody.json"), "nobody.json"),
    ],
)
def test_bad_input_is_named_before_anything_is_played(words, message, tmp_path):
    assert message in refused("suite", *words, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()

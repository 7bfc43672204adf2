"""The suite by the command."""

import json

import pytest

from dptse_env.policies import read_policy
from tests.agents.studies.test_suite import SMALL, recorded, small  # noqa: F401 (fixtures)
from tests.helpers import save_untrained
from tests.scripts.commands import refused, run_command

pytestmark = pytest.mark.usefixtures("small")


def test_a_policy_gets_a_card_and_its_scores_beside_another_card(tmp_path):
    words = "--output", tmp_path / "mine", "--workers", "1"
    done = run_command("evaluate", "--suite", "--policies", "random", *words)
    assert done.returncode == 0, done.stderr
    card = json.loads((tmp_path / "mine" / "card.json").read_text())
    assert card["scores"].keys() == SMALL.keys()
    again = run_command("evaluate", "--suite", "--policies", "random", *words, "--json")
    assert json.loads(again.stdout) == card
    words = "--beside", tmp_path / "mine/card.json", "--output", tmp_path / "other"
    done = run_command("evaluate", "--suite", "--policies", "static", *words, "--workers", "1")
    (line,) = (line for line in done.stdout.splitlines() if line.strip().startswith("mean"))
    assert f"{card['score']['mean']:.2f} ±" in line


def test_the_first_policy_that_suits_a_cell_acts_in_it(tmp_path):
    saved = save_untrained(tmp_path / "run" / "best.safetensors", estimator="random_walk")
    words = "--output", tmp_path / "out", "--workers", "1"
    done = run_command("evaluate", "--suite", "--policies", saved, *words)
    assert "run/best does not suit paced: policy" in done.stderr
    card = json.loads((tmp_path / "out" / "card.json").read_text())
    assert (card["scores"].keys(), card["score"]) == ({"plain"}, None)
    done = run_command("evaluate", "--suite", "--policies", saved, "static", *words)
    assert done.returncode == 0, done.stderr
    card = json.loads((tmp_path / "out" / "card.json").read_text())
    assert card["score"] is not None
    acting = {name: each["name"] for name, each in card["policies"].items()}
    assert acting == {"plain": "run/best", "paced": "static"}
    assert card["policies"]["plain"]["identity"] == read_policy(saved).card["sha256"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--policies", "nobody.safetensors"), "nobody.safetensors"),
        (("--policies", "nobody"), "'nobody'"),
        (("--policies", "static", "nobody"), "'nobody' acts in no cell"),
        (("--policies", "static", "--beside", "nobody.json"), "nobody.json"),
        (("none", "--policies", "static"), "suite must be one of"),
        ((), "policies must be given with --suite"),
        (("--test-seeds", "2000"), "--test-seeds must be left out with --suite"),
        (("--estimators", "ekf"), "--estimators must be left out with --suite"),
    ],
)
def test_bad_input_is_named_before_anything_is_played(words, message, tmp_path):
    assert message in refused("evaluate", "--suite", *words, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()

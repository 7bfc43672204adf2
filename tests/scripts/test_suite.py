"""The suite by the command."""

import json
import sys
from pathlib import Path

import pytest

from dptse_env.policies import read_policy
from tests.agents.studies.test_suite import SMALL, recorded, small  # noqa: F401 (fixtures)
from tests.docs.blocks import blocks_of
from tests.helpers import ROOT, SHORT, save_untrained
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


@pytest.fixture
def page(tmp_path, monkeypatch):
    """Save the files of the page on training in an empty folder; return its other Python."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "mynet", raising=False)
    blocks = blocks_of(ROOT / "docs" / "guides" / "train-a-policy.md")
    for block in blocks:
        if block.file:
            Path(block.file).write_text(block.text)
    return [block.text for block in blocks if block.language == "python" and not block.file]


def test_a_torch_module_of_the_page_enters_by_its_class(page):
    words = "--workers", "1", "--policies", "mynet:Net"
    done = run_command("evaluate", "--suite", *words)
    assert done.returncode == 0, done.stderr
    card = json.loads(Path("results/my-suite/mynet-Net/card.json").read_text())
    assert card["scores"].keys() == SMALL.keys()
    env = SHORT + ' {"bandwidth": 1, "estimator": "random_walk", "horizon": 80}'
    short = "--test-seeds", "2000:2002", "--output", "out"
    done = run_command("evaluate", "--env", env, *words, "random", *short)
    assert done.returncode == 0, done.stderr
    assert "mynet:Net" in done.stdout


def test_a_policy_that_the_page_saves_enters(page):
    text = page[0]
    for whole, part in {
        "1_000_000": "64", '"n_steps": 64': '"n_steps": 2', "1024": "64",
        "num_envs=128": "num_envs=32",
        '"bandwidth": 1': '"bandwidth": 2, "estimator": "random_walk"', '"0:64"': '"0:2"',
        "num_envs=8": "num_envs=2", "2000:2008": "2000:2002", "2000, 2008": "2000, 2002",
    }.items():  # fmt: skip
        assert whole in text
        text = text.replace(whole, part)
    exec(compile(text, "page", "exec"), {"__name__": "page"})
    words = "plain", "--policies", "mlp.safetensors", "--workers", "1"
    done = run_command("evaluate", "--suite", *words)
    assert done.returncode == 0, done.stderr
    card = json.loads(Path("results/my-suite/mlp/card.json").read_text())
    assert card["scores"].keys() == {"plain"}


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

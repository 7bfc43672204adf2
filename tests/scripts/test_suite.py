"""The suite by the command."""

import json
import sys
from pathlib import Path

import polars as pl
import pytest

from agents.studies.suite.entries import FRESH_SEEDS, seeds_of
from agents.study import ROWS, read_table, write_table
from dptse_env.policies import read_policy
from tests.agents.studies.test_suite import SMALL, folder, small  # noqa: F401 (fixtures)
from tests.docs.blocks import blocks_of
from tests.helpers import ROOT, SHORT
from tests.scripts.commands import refused, run_command

pytestmark = pytest.mark.usefixtures("small")


def test_an_entry_gets_a_card_and_stands_beside_another_that_is_checked(tmp_path):
    words = "--output", tmp_path / "mine", "--workers", "1"
    done = run_command("evaluate", "--suite", "--policies", "random", *words)
    assert done.returncode == 0, done.stderr
    kept = {path.name: path.read_bytes() for path in (tmp_path / "mine").iterdir()}
    assert kept.keys() == {"card.json", "rows.parquet", "tables.md"}
    again = run_command("evaluate", "--suite", "--policies", "random", *words, "--json")
    told = json.loads(again.stdout)
    assert {path.name: path.read_bytes() for path in (tmp_path / "mine").iterdir()} == kept
    scores = told.pop("below_the_best_rule")
    assert scores.keys() == {*SMALL, "mean"}
    assert told == json.loads(kept["card.json"])
    path = tmp_path / "mine/card.json"
    words = "--policies", "static", "--workers", "1", "--beside", path, "--replay", "1", "--output"
    done = run_command("evaluate", "--suite", *words, tmp_path / "other")
    assert "what was played again is as it says" in done.stderr
    (line,) = (line for line in done.stdout.splitlines() if line.strip().startswith("mean"))
    assert f"{scores['mean']['mean']:.1f} ±" in line
    assert "from second 61 on" in done.stdout
    rows = read_table(tmp_path / "mine" / ROWS)
    write_table(tmp_path / "mine" / ROWS, rows.with_columns(reward=0.9 * pl.col("reward")))
    said = refused("evaluate", "--suite", *words, tmp_path / "third")
    assert "as they are when they are played again" in said
    path.write_text(path.read_text().replace('"random"', '"static"'))
    said = refused("evaluate", "--suite", *words, tmp_path / "third")
    assert "an entry with rows of these numbers" in said
    assert not (tmp_path / "third").exists()


def test_fresh_traffic_is_drawn_at_the_call_and_written_into_the_entry(tmp_path):
    words = "--policies", "random", "--fresh", "2", "--workers", "1", "--output"
    for name in ("a", "b"):
        done = run_command("evaluate", "--suite", "plain", *words, tmp_path / name)
        assert done.returncode == 0, done.stderr
    first, second = (json.loads((tmp_path / name / "card.json").read_text()) for name in "ab")
    assert first["fresh"] != second["fresh"]
    assert {*first["fresh"], *second["fresh"]} <= {*FRESH_SEEDS}
    rows = read_table(tmp_path / "a" / ROWS)
    assert {"random", "round-robin", "shift-ahead"} <= {*rows["policy"]}
    assert {*rows["traffic_seed"]} == {*first["fresh"]}
    said = refused("evaluate", "--suite", "plain", *words, tmp_path / "a")
    assert "output must not exist yet" in said


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
    assert card["policies"].keys() == SMALL.keys()
    assert card["reads"] == "observations"
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
        '"ekf", "parameters": "published"': '"random_walk", "bandwidth": 2',
        '"0:64"': '"0:2"',
        "num_envs=8": "num_envs=2", "2000:2008": "2000:2002", "2000, 2008": "2000, 2002",
    }.items():  # fmt: skip
        assert whole in text
        text = text.replace(whole, part)
    exec(compile(text, "page", "exec"), {"__name__": "page"})
    words = "plain", "--policies", "mlp.safetensors", "--workers", "1"
    done = run_command("evaluate", "--suite", *words)
    assert done.returncode == 0, done.stderr
    card = json.loads(Path("results/my-suite/mlp/card.json").read_text())
    assert card["policies"].keys() == {"plain"}
    assert seeds_of(read_policy("mlp.safetensors").card) == [range(2)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--policies", "nobody.safetensors"), "nobody.safetensors"),
        (("--policies", "nobody.toml"), "nobody.toml"),
        (("--policies", "nobody"), "'nobody'"),
        (("--policies", "static", "static"), "policies must be different"),
        (("--policies", "static", "--beside", "nobody.json"), "nobody.json"),
        (("--policies", "static", "--replay", "2"), "replay must be given with cards beside"),
        (("--policies", "static", "--fresh", "1"), "fresh must be"),
        (("none", "--policies", "static"), "suite must be one of"),
        ((), "policies must be given with --suite"),
        (("--test-seeds", "2000"), "--test-seeds must be left out with --suite"),
        (("--estimators", "ekf"), "--estimators must be left out with --suite"),
    ],
)
def test_bad_input_is_named_before_anything_is_played(words, message, tmp_path):
    assert message in refused("evaluate", "--suite", *words, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()

"""The suite by the command."""

import json
import shlex

import pytest

from agents.studies.suite import entries
from agents.studies.suite.entries import FRESH_SEEDS
from agents.study import ROWS, read_table
from scripts import evaluate
from tests.agents.studies.test_suite import SMALL, folder, small  # noqa: F401 (fixtures)
from tests.helpers import save_untrained
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


@pytest.mark.parametrize("fresh", [[], ["--fresh", "2"]])
def test_an_entry_goes_on_that_was_ended_before_its_first_row(tmp_path, monkeypatch, fresh):
    def interrupt(*_):
        raise KeyboardInterrupt

    policy = save_untrained(tmp_path / "best.safetensors", estimator="random_walk")
    words = ["evaluate", "--suite", "plain", "--workers", "1", "--output", tmp_path / "out"]
    for owner in (entries, evaluate):  # as it copies the policy, and as it plays
        with monkeypatch.context() as patch:
            patch.setattr(owner, "write_atomically" if owner is entries else "play", interrupt)
            done = run_command(*words, *fresh, "--policies", policy)
        assert done.returncode == 130
        assert "the same command goes on" in done.stderr
    card = (tmp_path / "out" / "card.json").read_text()
    others = [["--fresh", "3", "--policies", policy], [*fresh, "--policies", "random"]]
    for other in others if fresh else others[:1]:  # other rows of the suite's traffic can stay
        assert "output must be a folder of this entry" in refused(*words, *other)
    assert run_command(*words, *fresh, "--policies", policy).returncode == 0
    assert (tmp_path / "out" / "card.json").read_text() == card


WRONG = {
    "": "policies must be given with --suite",
    "--policies nobody.safetensors": "nobody.safetensors",
    "--policies nobody.toml": "nobody.toml",
    "--policies nobody": "'nobody'",
    "--policies static static": "policies must be different",
    "--policies static --beside nobody.json": "nobody.json",
    "--policies static --replay 2": "replay must be given with cards beside",
    "--policies static --fresh 1": "fresh must be",
    "none --policies static": "suite must be one of",
    "--test-seeds 2000": "--test-seeds must be left out with --suite",
    "--estimators ekf": "--estimators must be left out with --suite",
}


@pytest.mark.parametrize("words", WRONG)
def test_bad_input_is_named_before_anything_is_played(words, tmp_path):
    given = "evaluate", "--suite", *shlex.split(words), "--output", tmp_path / "out"
    assert WRONG[words] in refused(*given)
    assert not (tmp_path / "out").exists()

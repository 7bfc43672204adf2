"""The suite by the command."""

import json

import pytest

from agents.studies.suite.entries import FRESH_SEEDS
from agents.study import ROWS, read_table
from tests.agents.studies.test_suite import SMALL, folder, small  # noqa: F401 (fixtures)
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

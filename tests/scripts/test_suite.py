"""The suite by the command."""

import pytest

from agents.study import read_rows
from scripts import suite
from tests.agents.studies.test_suite import HERE, KEYWORDS, SMALL, Task
from tests.helpers import SHORT, save_untrained
from tests.scripts.commands import refused, run_command


@pytest.fixture
def small(monkeypatch):
    flows = {**KEYWORDS, "privacy": "paced"}  # has other blocks in the observation
    tasks = (SMALL[0], Task("paced", "a guarantee", SHORT, flows, (2000, 2001)))
    monkeypatch.setattr(suite, "TASKS", tasks)


def test_policies_are_scored_in_the_tasks_that_they_suit(small, tmp_path):
    saved = str(save_untrained(tmp_path / "run" / "best.safetensors", estimator="random_walk"))
    words = "--policies", saved, "round-robin", "--output", tmp_path / "out", "--workers", "1"
    done = run_command("suite", *words)
    assert done.returncode == 0, done.stderr
    assert f"1 of 2 cells do not suit {saved}" in done.stderr
    rows = read_rows("suite", tmp_path / "out")
    played = set(rows.select("policy", "task").iter_rows())
    assert ("run/best", "plain") in played
    assert ("run/best", "paced") not in played
    (line,) = (line for line in done.stdout.splitlines() if line.strip().startswith("paced"))
    assert line.split()[1] == "-"
    assert "±" in line


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        ((), "policies must be one or more"),
        (("paper", "paper"), "policies must be of different names"),
        (("nobody.zip",), "nobody.zip"),
        (("nobody",), "'nobody'"),
        ((f"{HERE}:Nobody",), f"{HERE}:Nobody"),
    ],
)
def test_bad_policies_are_named_before_anything_is_played(policies, message, small, tmp_path):
    assert message in refused("suite", "--policies", *policies, "--output", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_policy_that_fails_is_one_line_and_finished_rows_stay(monkeypatch, tmp_path):
    monkeypatch.setattr(suite, "TASKS", SMALL)
    for _ in range(2):
        words = "--policies", f"{HERE}:Raising", "--output", tmp_path, "--workers", "1"
        done = run_command("suite", *words)
        assert done.returncode == 1
        line = done.stderr.splitlines()[-1]
        assert line.startswith(f"error: '{HERE}:Raising' in task wide")
        assert "ValueError: no third segment" in line
        assert set(read_rows("suite", tmp_path)["task"]) == {"plain"}

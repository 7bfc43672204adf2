import polars as pl
import pytest

from agents.study import read_rows
from scripts import suite
from scripts.cli import run
from scripts.suite import Args, main
from tests.agents.studies.test_suite import HERE, KEYWORDS, SMALL, Task
from tests.helpers import SHORT, save_untrained


@pytest.fixture
def small(monkeypatch):
    flows = {**KEYWORDS, "privacy": "paced"}  # has other blocks in the observation
    tasks = (SMALL[0], Task("paced", "a guarantee", SHORT, flows, (2000, 2001)))
    monkeypatch.setattr(suite, "TASKS", tasks)


def test_policies_are_scored_in_the_tasks_that_they_suit(small, tmp_path, capsys):
    saved = str(save_untrained(tmp_path / "run" / "best.safetensors", estimator="random_walk"))
    main(Args(policies=(saved, "round-robin"), output=tmp_path / "out", workers=1))
    printed = capsys.readouterr()
    assert f"1 of 2 cells do not suit {saved}" in printed.err
    rows = read_rows("suite", tmp_path / "out").filter(pl.col("policy") == "run/best")
    assert set(rows["task"]) == {"plain"}
    (line,) = (line for line in printed.out.splitlines() if line.strip().startswith("paced"))
    assert line.split()[1] == "-"
    assert "±" in line


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        ((), "policies must be one or more"),
        (("paper", "paper"), "policies must be of different names"),
        (("nobody.zip",), "nobody.zip"),
        (("nobody",), "schedule must be one of"),
        ((f"{HERE}:Nobody",), f"{HERE}:Nobody"),
    ],
)
def test_bad_policies_are_named_before_anything_is_played(
    policies, message, small, tmp_path, capsys
):
    words = ["--policies", *policies, "--output", str(tmp_path / "out"), "--workers", "1"]
    with pytest.raises(SystemExit) as ended:
        run(main, Args, None, words=words)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not (tmp_path / "out").exists()


def test_a_policy_that_fails_is_one_line_and_finished_rows_stay(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(suite, "TASKS", SMALL)
    words = ["--policies", f"{HERE}:Raising", "--output", str(tmp_path), "--workers", "1"]
    for _ in range(2):
        with pytest.raises(SystemExit) as ended:
            run(main, Args, None, words=words)
        assert ended.value.code == 1
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith(f"error: '{HERE}:Raising' in task wide")
        assert "ValueError: no third segment" in line
        assert set(read_rows("suite", tmp_path)["task"]) == {"plain"}

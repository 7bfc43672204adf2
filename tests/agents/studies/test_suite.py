import dataclasses

import numpy as np
import polars as pl
import pytest
from scipy import stats

from agents.executors import THIS_PROCESS
from agents.seeds import SUITE
from agents.studies.suite import (
    ONE,
    RECORDED,
    STUDY,
    TASKS,
    ZERO,
    Task,
    beside_recorded,
    entry,
    format_scores,
    make_cell,
    mean_score,
    score,
    score_all,
)
from agents.study import Place, read_rows, run
from agents.tables import UnmeasuredError
from dptse_env.config import TEST_SEEDS
from dptse_env.schedules import Schedule
from tests.helpers import SHORT

HERE = "tests.agents.studies.test_suite"
KEYWORDS = {"estimator": "random_walk", "bandwidth": 2, "horizon": 80}
SMALL = (
    Task("plain", "printed noise", SHORT, KEYWORDS, (2000, 2001)),
    Task("wide", "three queries", SHORT, {**KEYWORDS, "bandwidth": 3}, (2000, 2001)),
)


class Raising(Schedule):
    """The first segments; raises where three may be queried."""

    def select(self, step, observation):
        if self.bandwidth == 3:
            raise ValueError("no third segment")
        return self.first_that_fit(np.tile(np.arange(6), (len(step), 1)))


def rows_of(**errors):
    """Return rows in the task ``t``: a policy's errors x 1000, one for each traffic seed."""
    return pl.DataFrame(
        [
            {"version": "0.2.0", "task": "t", "policy": policy.replace("_", "-"),
             "traffic_seed": seed, "reward": -error / 1000.0}
            for policy, values in errors.items()
            for seed, error in enumerate(values)
        ]
    )  # fmt: skip


REFERENCES = {"paper": (100.0, 110.0, 120.0), "oracle_error": (60.0, 50.0, 70.0)}


def test_a_score_is_the_share_of_the_way_to_the_oracle():
    rows = rows_of(**REFERENCES, mine=(80.0, 90.0, 70.0))
    for policy, expected in ((ZERO, 0.0), (ONE, 1.0)):
        found = score(rows, policy, "t")
        assert (found.mean, found.half_width) == pytest.approx((expected, 0.0), abs=1e-12)
    found = score(rows, "mine", "t")
    assert found.mean == pytest.approx(30.0 / 50.0)
    gained = np.array([20.0, 20.0, 50.0]) - 0.6 * np.array([40.0, 60.0, 50.0])
    half = stats.t.ppf(0.975, 2) * stats.sem(gained) / 50.0
    assert (found.low, found.high) == pytest.approx((0.6 - half, 0.6 + half))
    better = rows_of(**REFERENCES, mine=(40.0, 40.0, 40.0))
    assert score(better, "mine", "t").mean == pytest.approx(70.0 / 50.0)


def test_there_is_no_score_without_a_scale_or_across_versions():
    rows = rows_of(paper=(60.0, 50.0), oracle_error=(100.0, 110.0), mine=(80.0, 90.0))
    other = rows_of(**REFERENCES, mine=(80.0, 90.0, 70.0)).with_columns(
        version=pl.when(pl.col("policy") == "mine").then(pl.lit("0.3.0")).otherwise("version")
    )
    for each in (rows, other):
        with pytest.raises(UnmeasuredError):
            score(each, "mine", "t")


def test_recorded_references_have_zero_and_one_and_a_row_moves_its_score_alone():
    rows = read_rows("suite", RECORDED)
    for each in STUDY.cells:
        assert set(each.seeds) <= set(TEST_SEEDS[200:])
        assert each.noise_seed == SUITE.start
    scores = score_all(rows)
    assert {mean_score(scores[name]) for name in (ZERO, ONE)} == {0.0, 1.0}
    assert mean_score(scores["paced-roads"]) is None
    changed = pl.when(policy="round-robin", task="paper").then(pl.col("reward") * 1.01)
    worse = score_all(rows.with_columns(changed.otherwise("reward").alias("reward")))
    moved = {(policy, task) for policy in scores for task in scores[policy]
             if worse[policy][task] != scores[policy][task]}  # fmt: skip
    assert moved == {("round-robin", "paper")}


def test_a_policy_is_scored_beside_those_that_are_recorded(tmp_path):
    cells = [make_cell(SMALL[0], "mine", f"{HERE}:Raising")]
    study = entry(cells, SMALL)
    # Nobody has recorded these references.
    assert [each.policy for each in study.cells] == [f"{HERE}:Raising", ZERO, ONE]
    run(study, Place(tmp_path, THIS_PROCESS), progress=False)
    rows = beside_recorded(read_rows("suite", tmp_path), study.cells)
    scores = score_all(rows, SMALL)
    assert scores[ZERO]["plain"].mean == 0.0
    shown = " | ".join(format_scores(scores["mine"], SMALL))
    assert f"| `mine` | {shown} |" in (tmp_path / "tables.md").read_text(encoding="utf-8")
    # Rows of another file of the same name are left alone.
    other = dataclasses.replace(cells[0], policy="static")
    assert "mine" not in set(beside_recorded(read_rows("suite", tmp_path), [other])["policy"])
    # Where the references are recorded, the policy alone is played.
    assert entry([make_cell(TASKS[0], "mine", "static")]).cells[1:] == ()

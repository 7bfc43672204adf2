import dataclasses
import json

import numpy as np
import polars as pl
import pytest
from scipy import stats

from agents import tables
from agents.executors import this_process
from agents.play import Cell
from agents.seeds import SUITE
from agents.studies import suite
from agents.studies.suite import (
    CELLS,
    ONE,
    RECORDED,
    ZERO,
    make_card,
    make_cell,
    mean_score,
    read_card,
    recorded_rows,
    report,
    score,
    score_all,
)
from agents.study import ROWS, Place, Study, play_study, read_table
from agents.tables import UnmeasuredError
from dptse_env import versions
from dptse_env.config import TEST_SEEDS
from tests.helpers import SHORT

KEYWORDS = {"estimator": "random_walk", "bandwidth": 2, "horizon": 80}
SMALL = {
    name: Cell(SHORT, keywords={**KEYWORDS, **more}, noise_seed=SUITE.start, transferred=True,
               seeds=(2000, 2001))
    for name, more in (("plain", {}), ("paced", {"privacy": "paced"}))
}  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A folder with the references and a rule in two small cells."""
    folder = tmp_path_factory.mktemp("recorded")
    cells = [dataclasses.replace(each, policy=policy, labels={"name": name, "policy": policy})
             for name, each in SMALL.items() for policy in ("static", ZERO, ONE)]  # fmt: skip
    play_study(Study("suite", tuple(cells), (), report), Place(folder, this_process))
    return folder


@pytest.fixture
def small(monkeypatch, recorded):
    """Make these cells the suite; return their rows."""
    monkeypatch.setattr(suite, "CELLS", SMALL)
    monkeypatch.setattr(suite, "RULES", ("static", ZERO))
    monkeypatch.setattr(suite, "ORACLES", (ONE,))
    monkeypatch.setattr(suite, "RECORDED", recorded)
    return recorded_rows()


def rows_of(name="t", seeds=range(3), **errors):
    """Return rows in a cell: a policy's errors x 1000, one for each traffic seed."""
    return pl.DataFrame(
        [
            {"version": "1+x", "name": name, "policy": policy.replace("_", "-"),
             "traffic_seed": seed, "reward": -error / 1000.0}
            for policy, values in errors.items()
            for seed, error in zip(seeds, values, strict=True)
        ]
    )  # fmt: skip


REFERENCES = {"round_robin": (100.0, 110.0, 120.0), "oracle_gain": (60.0, 50.0, 70.0)}


def test_a_score_is_the_share_of_the_way_to_the_gain_oracle():
    rows = rows_of(**REFERENCES, mine=(80.0, 90.0, 70.0))
    for policy, expected in ((ZERO, 0.0), (ONE, 1.0)):
        found = mean_score([score(rows, policy, "t")])
        assert (found.mean, found.half_width) == pytest.approx((expected, 0.0), abs=1e-12)
    found = mean_score([score(rows, "mine", "t")])
    gained = np.array([20.0, 20.0, 50.0]) - 0.6 * np.array([40.0, 60.0, 50.0])
    half = stats.t.ppf(0.975, 2) * stats.sem(gained) / 50.0
    assert (found.mean, found.low, found.high) == pytest.approx((0.6, 0.6 - half, 0.6 + half))
    worse = rows_of(**REFERENCES, mine=(130.0, 120.0, 110.0))
    assert score(worse, "mine", "t").value == pytest.approx(-0.2)


def test_the_mean_over_cells_knows_that_they_share_traffic():
    mine = {"mine": (80.0, 90.0, 70.0)}
    one = score(rows_of(**REFERENCES, **mine), "mine", "t")
    other = score(rows_of(seeds=range(5, 8), **REFERENCES, **mine), "mine", "t")
    width = mean_score([one]).half_width
    assert mean_score([one, one]).half_width == pytest.approx(width)  # nothing new in it
    assert mean_score([one, other]).half_width == pytest.approx(width / np.sqrt(2.0))


def test_there_is_no_score_without_a_scale_or_across_numbers():
    rows = rows_of(round_robin=(60.0, 50.0), oracle_gain=(100.0, 110.0), mine=(80.0, 90.0),
                   seeds=range(2))  # fmt: skip
    other = rows_of(**REFERENCES, mine=(80.0, 90.0, 70.0)).with_columns(
        version=pl.when(pl.col("policy") == "mine").then(pl.lit("1+y")).otherwise("version")
    )
    for each in (rows, other):
        with pytest.raises(UnmeasuredError):
            score(each, "mine", "t")


def test_a_card_gives_back_its_scores_and_is_refused_where_it_cannot_be_compared(
    small, tmp_path, monkeypatch
):
    path, card = (
        tmp_path / "card.json",
        make_card(small, "static", [make_cell("plain", "static", "static")]),
    )
    assert card["policies"] == {"plain": {"name": "static", "identity": "static"}}
    assert card["scores"].keys() == SMALL.keys()
    assert card["score"]["low"] < card["score"]["mean"] < card["score"]["high"]
    path.write_text(json.dumps(card))
    theirs = read_card(path)
    found = score_all(pl.concat([small, theirs], how="diagonal_relaxed"))
    (policy,) = theirs["policy"].unique()
    assert {name: each.value for name, each in found[policy].items()} == pytest.approx(
        {name: interval["mean"] for name, interval in card["scores"].items()}
    )
    changes = {
        "suite": "query-suite-v2",
        "package": "0.1.0",
        "cells": "0" * 64,
        "errors": {"plain": {"2000": 1.0}},
    }
    for key, value in changes.items():
        path.write_text(json.dumps({**card, key: value}))
        with pytest.raises(ValueError, match=rf"card\.json.*{key}"):
            read_card(path)
    path.write_text(json.dumps({**card, "package": "0.1.0"}))
    monkeypatch.setattr(versions, "equal_digests", lambda: {versions.digest(): "0.1.0"})
    assert read_card(path).equals(theirs)


def test_references_with_other_numbers_are_not_taken(small, monkeypatch):
    assert set(recorded_rows()["policy"]) == {"static", ZERO, ONE}
    monkeypatch.setattr(versions, "digest", lambda: "moved")
    with pytest.raises(ValueError, match=r"\+moved, so nothing can be scored"):
        recorded_rows()


@pytest.mark.skipif(not RECORDED.is_dir(), reason="a source archive has no results")
def test_recorded_rows_leave_room_above_the_best_rule_in_every_cell(monkeypatch):
    played = read_table(RECORDED / ROWS)["version"][-1]
    monkeypatch.setattr(tables, "code_version", lambda: played)  # whatever has moved since
    rows = recorded_rows()
    for name, each in CELLS.items():
        assert set(each.seeds) <= set(TEST_SEEDS[200:])
        assert suite.room(rows, name).mean > 8.0, name

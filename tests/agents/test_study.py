"""A study plays what its rows lack, reports, and loses nothing when it is killed."""

from dataclasses import replace

import polars as pl
import pytest

from agents.executors import make_executor, this_process
from agents.play import Cell, play
from agents.study import Place, Study, read_rows, run, write_report, write_table
from agents.tables import (
    UnmeasuredError,
    below,
    difference,
    grid,
    mean,
    pick,
    values,
)
from dptse_env import versions
from dptse_env.estimators.recurrent import read_weights
from tests.agents.faults import SHORT, rows_of, study
from tests.helpers import save_untrained

KEYWORDS = {"estimator": "random_walk", "horizon": 80}


def report(rows, folder):
    assert (folder / "extra.parquet").exists()

    def entry(bandwidth, _):
        return f"{mean(rows, {'bandwidth': bandwidth}, 'rmse_density').mean:.6f}"

    return grid("B", [1, 2, 9], ["mean"], entry)


def cell(bandwidth):
    keywords = {**KEYWORDS, "bandwidth": bandwidth}
    return Cell(SHORT, "round-robin", keywords, {"bandwidth": bandwidth})


def small(calls=None, **changes):
    def measure(place):
        if calls is not None:
            calls.append(place.folder)
        return pl.DataFrame({"a": [1]})

    measures = {"extra.parquet": measure}
    made = Study("small", (cell(1), cell(2)), (2000, 2001), report, measures=measures)
    return replace(made, **changes)


def test_a_study_plays_what_its_rows_lack_and_reports(tmp_path):
    folder = tmp_path / "a[1]"  # as a pattern it does not match itself
    foreign = folder / "rows" / "thesis.parquet"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("mine")
    calls, place = [], Place(folder, this_process)
    first = small(calls)
    run(first, place)
    rows = read_rows("small", folder).sort("bandwidth", "traffic_seed")
    expected = [row for cell in first.cells for row in play(cell, first.seeds)]
    assert rows.select("bandwidth", "traffic_seed").rows() == [
        (1, 2000), (1, 2001), (2, 2000), (2, 2001),
    ]  # fmt: skip
    assert set(rows["version"]) == {versions.code_version()}
    assert rows["reward"].to_list() == [row["reward"] for row in expected]
    tables = (folder / "tables.md").read_text("utf-8")
    assert f"| 1 | {rows['rmse_density'][:2].mean():.6f} |" in tables
    assert "| 9 | - |" in tables
    assert [*foreign.parent.iterdir()] == [foreign]
    assert calls == [folder]


def test_rows_of_equal_numbers_count_as_played_and_others_do_not(tmp_path, monkeypatch):
    place, first = Place(tmp_path, this_process), small()
    run(first, place)
    rows, own = rows_of(tmp_path), versions.code_version()
    old = rows.with_columns(version=pl.lit("0.1.0"), rmse_density=pl.lit(7.0))
    write_table(tmp_path / "rows.parquet", old)
    with monkeypatch.context() as declared:
        declared.setattr(versions, "equal_digests", lambda: {versions.digest(): "0.1.0"})
        run(replace(first, cells=(*first.cells, cell(3))), place)
        tables = (tmp_path / "tables.md").read_text("utf-8")
    assert read_rows("small", tmp_path)["version"].to_list() == ["0.1.0"] * 4 + [own] * 2
    assert "| 1 | 7.000000 |" in tables
    assert f"by dptse-env 0.1.0 (4 episodes) = {own} (2 episodes). " in tables
    with pytest.warns(UserWarning, match=r"2 cells .* again: .* 0\.1\.0, whose numbers are not"):
        run(first, place)
    assert read_rows("small", tmp_path)["version"].to_list() == ["0.1.0"] * 4 + [own] * 6
    tables = (tmp_path / "tables.md").read_text("utf-8")
    assert f"| 1 | {rows.filter(bandwidth=1)['rmse_density'].mean():.6f} |" in tables
    assert f"by dptse-env 0.1.0 (4 episodes), {own} (6 episodes). " in tables
    # Of rows of equal numbers for the same traffic there is one.
    monkeypatch.setattr(versions, "equal_digests", lambda: {versions.digest(): "0.1.0"})
    assert read_rows("small", tmp_path)["version"].to_list() == [own] * 6


def test_cells_may_follow_from_rows(tmp_path):
    def follow(rows, place):
        best = rows.group_by("bandwidth").agg(pl.col("reward").mean()).sort("reward")
        chosen = int(best["bandwidth"][-1])
        keywords = {**KEYWORDS, "bandwidth": chosen}
        return [Cell(SHORT, "static", keywords, {"bandwidth": 10 + chosen}, seeds=(2005,))]

    run(small(follow=follow), Place(tmp_path, this_process))
    assert rows_of(tmp_path)["bandwidth"].to_list()[-1] == 12
    assert rows_of(tmp_path)["traffic_seed"].to_list()[-1] == 2005


def test_bad_cells_are_refused_before_the_first_is_played(tmp_path):
    good = small().cells[0]
    for bad, message in [
        (replace(good, keywords={**KEYWORDS, "estimator": "nobody"}), "estimator must be one of"),
        (replace(good, policy="nobody"), "schedule must be one of"),
        (replace(good, watchers=("nobody",)), "watchers must be of"),
        (replace(good, keywords={"cargo": 1}), "cargo"),
    ]:
        with pytest.raises(ValueError, match=message):
            run(small(cells=(good, bad)), Place(tmp_path / "new", this_process))
        assert not (tmp_path / "new").exists()
    bad = replace(good, labels={"reward": 1})
    with pytest.raises(ValueError, match=r"labels must differ .* got 'reward'"):
        run(small(cells=(bad,)), Place(tmp_path, this_process))


def test_broken_tables_and_those_of_another_study_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"rows\.parquet is not there"):
        write_report(small(), tmp_path)
    path = tmp_path / "rows.parquet"
    table = pl.DataFrame({"study": ["other"], "version": ["1"], "cell": ["x"], "traffic_seed": [1]})
    for content, message in (
        (table, "rows of the study 'other', not of 'small'"),
        (table.drop("cell"), "must have a column 'cell'"),
    ):
        write_table(path, content)
        with pytest.raises(ValueError, match=message):
            read_rows("small", tmp_path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ValueError, match="is not a table that this program wrote"):
        read_rows("small", tmp_path)


def test_an_id_says_all_that_rows_depend_on(tmp_path):
    first = cell(1)
    changes = [
        {"env": "dptse_env:dptse/PaperHighway-v0"}, {"policy": "shift-ahead"}, {"noise_seed": 1},
        {"keywords": {"bandwidth": 2}}, {"deterministic": False}, {"watchers": ("queries",)},
    ]  # fmt: skip
    ids = {first.id, *(replace(first, **change).id for change in changes)}
    assert len(ids) == len(changes) + 1
    turned = dict(reversed(first.keywords.items()))
    assert replace(first, keywords=turned, labels={}, seeds=(1,)).id == first.id
    # A policy that was trained again is another cell, and so is a road that was edited.
    path, road = tmp_path / "policy.safetensors", tmp_path / "road.toml"
    ids = set()
    for k in range(2):
        save_untrained(path, seed=k)
        road.write_text(f"a = {k}")
        there = {"policy": str(path)}, {"keywords": {"corridor": str(road)}}
        ids |= {replace(first, **change).id for change in there}
    assert len(ids) == 4
    assert not any(str(tmp_path) in each for each in ids if "corridor" in each)
    # Weights of the package by their own name go with their digest.
    keywords = {"estimator_settings": {"recurrent": {"weights": "highway-flows"}}}
    assert read_weights("highway-flows").card["sha256"] in replace(first, keywords=keywords).id


def test_pairs_are_of_equal_numbers(monkeypatch):
    rows = pl.DataFrame(
        {
            "version": ["2+x"] * 4 + ["1+y"] * 3,
            "policy": ["a", "a", "b", "b", "a", "a", "c"],
            "traffic_seed": [1, 2, 1, 2, 1, 2, 1],
            "reward": [-0.1, -0.2, -0.2, -0.4, -0.3, -0.3, -0.5],
        }
    )
    a, b, c = ({"policy": name} for name in "abc")
    x, y = rows[:4], rows[4:]
    assert values(rows, a, "error").tolist() == [300.0, 300.0]  # a was played again
    assert difference(rows, a, b, "error").mean == pytest.approx(-150.0)
    half = below(rows, a, b)
    assert half.mean == pytest.approx(50.0)
    assert half.mean - half.low == pytest.approx(half.high - half.mean)
    with pytest.raises(UnmeasuredError, match="by versions of equal numbers"):
        difference(rows, b, c, "error")
    with pytest.raises(UnmeasuredError):
        difference(pl.concat([x.filter(**b), y]), b, a, "error")
    with pytest.raises(UnmeasuredError):
        pick(rows, {"policy": "d"})
    with pytest.raises(ValueError, match="labels of several cells"):
        pick(x, {})
    monkeypatch.setattr(versions, "equal_digests", lambda: {"x": "x", "y": "x"})
    assert difference(pl.concat([x.filter(**b), y]), b, a, "error").mean == pytest.approx(0.0)


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path, traces, expected):
    run(study(), Place(tmp_path, make_executor("local", 2)))
    assert (traces / "killed").exists()
    assert rows_of(tmp_path).equals(expected)

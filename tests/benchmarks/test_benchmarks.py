"""The benchmarks run and pair the turns of a round; no test depends on speed."""

import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from scipy import stats

from benchmarks import __main__ as benchmarks
from benchmarks import long_roads
from benchmarks.turns import compare, take_turns
from tests.helpers import ROOT


def test_turns_alternate(monkeypatch):
    log = []
    work = {name: (partial(log.append, name), n) for name, n in (("a", 1), ("b", 2))}

    def clock():
        log.append("clock")
        return float(len(log))

    monkeypatch.setattr("time.perf_counter", clock)
    times = take_turns(work, 2)
    assert log == ["clock", "a", "clock", "clock", "b", "clock"] * 3
    assert {name: found.tolist() for name, found in times.items()} == {
        "a": [2e6] * 2, "b": [1e6] * 2,
    }  # fmt: skip


def test_a_ratio_pairs_the_turns_of_a_round_and_is_a_geometric_mean():
    # The machine slows down by ten in the second round.
    times = {"slow": np.exp([0.0, 1.0]) * [1.0, 10.0], "fast": np.array([1.0, 10.0])}
    half = 0.5 * stats.t.ppf(0.975, 1)  # the standard error of the logarithms is 0.5
    low, high = np.exp([0.5 - half, 0.5 + half])
    assert compare(times, {"slow": "fast"}) == [
        ["slow", "14.1", "1.65", f"{low:.3g} to {high:.3g}", "fast"], ["fast", "5.5", "", "", ""],
    ]  # fmt: skip


def test_a_part_that_fails_loses_nothing_of_the_others(tmp_path, monkeypatch, capsys):
    def measure(part, quick):
        return [[f"a step of {part}", "1.0", "", "", ""]] if part != "environment" else {}[part]

    monkeypatch.setattr(benchmarks, "measure", measure)
    monkeypatch.setattr(benchmarks, "ProcessPoolExecutor", lambda *_: ThreadPoolExecutor(1))
    folder = tmp_path / "new"
    with pytest.raises(SystemExit, match=r"environment failed"):
        benchmarks.main(benchmarks.Args(output=folder))
    for said in (capsys.readouterr().out, (folder / "tables.md").read_text(encoding="utf-8")):
        parts = ["estimators", "learning", "long_roads", "stream"]
        assert re.findall(r"a step of (\w+)", said) == parts


def test_all_parts_are_one_json_document(monkeypatch, capsys):
    monkeypatch.setattr(benchmarks, "measure", lambda part, quick: [[part, "1.0", "", "", ""]])
    monkeypatch.setattr(benchmarks, "ProcessPoolExecutor", lambda *_: ThreadPoolExecutor(1))
    benchmarks.main(benchmarks.Args(json=True))
    found = json.loads(capsys.readouterr().out)
    assert [row[0] for row in found] == list(benchmarks.Args.parts)


def test_long_roads_have_settings_of_all_estimators():
    rows = long_roads.measure(quick=True)
    assert [row[-1] for row in rows] == [""] * 6 + [row[0] for row in rows[:6]]


@pytest.mark.slow
def test_all_parts_run_and_write_one_table(tmp_path):
    command = [sys.executable, "-m", "benchmarks", "--quick", "--output", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    written = (tmp_path / "tables.md").read_text(encoding="utf-8")
    for name in ("EKF, filterpy", "MHE, qpsolvers", "libsumo alone", "road policy", "a stream"):
        assert name in done.stdout
        assert name in written

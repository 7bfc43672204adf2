"""The benchmarks run and pair the turns of a round; no test depends on speed."""

import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from benchmarks import __main__ as benchmarks
from benchmarks import long_roads
from benchmarks.turns import Line, compare, take_turns
from tests.helpers import ROOT, SHORT


def run(*words):
    """Run a benchmark in the root of the checkout; return what it prints."""
    command = [sys.executable, "-m", *map(str, words), "--quick"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_turns_alternate_and_set_up_is_off_the_clock(monkeypatch):
    log = []
    work = {"a": lambda: log.append("a") or 1, "b": lambda: log.append("b") or 2}

    def clock():
        log.append("clock")
        return float(len(log))

    monkeypatch.setattr("time.perf_counter", clock)
    times = take_turns(work, 2, lambda: log.append("-"))
    assert log == ["-", "clock", "a", "clock", "clock", "b", "clock"] * 3
    assert {name: found.tolist() for name, found in times.items()} == {
        "a": [2e6] * 2, "b": [1e6] * 2,
    }  # fmt: skip


def test_a_ratio_pairs_the_turns_of_a_round():
    # The machine slows down by ten in the second round: the ratio stays.
    times = {"slow": np.array([2.0, 20.0, 2.2]), "fast": np.array([1.0, 10.0, 1.1])}
    fast, slow = (line for line in compare(times, {"slow": "fast"})[::-1])
    assert fast.ratio is None
    assert (slow.time, slow.base) == (2.2, "fast")
    assert slow.ratio.low == pytest.approx(2.0) == slow.ratio.high


def test_a_part_that_fails_loses_nothing_of_the_others(tmp_path, monkeypatch, capsys):
    def measure(part, quick):
        return [Line(f"a step of {part}", 1.0)] if part != "environment" else {}[part]

    monkeypatch.setattr(benchmarks, "measure", measure)
    monkeypatch.setattr(benchmarks, "ProcessPoolExecutor", lambda *_: ThreadPoolExecutor(1))
    path = tmp_path / "new" / "tables.md"
    with pytest.raises(SystemExit, match=r"environment failed"):
        benchmarks.main(benchmarks.Args(output=path))
    for said in (capsys.readouterr().out, path.read_text(encoding="utf-8")):
        assert re.findall(r"a step of (\w+)", said) == ["estimators", "learning", "long_roads"]


def test_long_roads_have_settings_of_all_estimators():
    lines = long_roads.measure(quick=True)
    assert [line.base for line in lines] == [""] * 6 + [line.what for line in lines[:6]]


@pytest.mark.slow
def test_all_parts_run_and_write_one_table(tmp_path):
    path = tmp_path / "new" / "tables.md"
    printed = run("benchmarks", "--output", path)
    written = path.read_text(encoding="utf-8")
    kinds = "EKF, filterpy", "MHE, qpsolvers", "libsumo alone", "road policy", "EKF, 21 segments"
    for name in kinds:
        assert name in printed
        assert name in written


@pytest.mark.slow
def test_two_environments_are_compared():
    other = f"{SHORT} {json.dumps({'bandwidth': 1})}"
    assert "bandwidth" in run("benchmarks.turns", "--envs", SHORT, other)

"""The benchmarks run and pair the turns of a round; no test depends on speed."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.turns import compare, take_turns
from tests.helpers import SHORT

ROOT = Path(__file__).parents[2]


def run(*words):
    """Run a benchmark in the root of the checkout; return what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words), "--quick"], cwd=ROOT, capture_output=True,
        text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_turns_alternate_and_set_up_is_off_the_clock():
    log = []
    work = {"a": lambda: log.append("a") or 1, "b": lambda: log.append("b") or 2}

    def prepare():
        log.append("-")
        time.sleep(0.05)

    times = take_turns(work, 2, prepare)
    assert log == ["-", "a", "b"] * 3
    assert times["a"].shape == (2,)  # the first round compiles
    assert times["a"].max() < 5e4


def test_a_ratio_pairs_the_turns_of_a_round():
    # The machine slows down by ten in the second round: the ratio stays.
    times = {"slow": np.array([2.0, 20.0, 2.2]), "fast": np.array([1.0, 10.0, 1.1])}
    fast, slow = (line for line in compare(times, {"slow": "fast"})[::-1])
    assert fast.ratio is None
    assert (slow.time, slow.base) == (2.2, "fast")
    assert slow.ratio.low == pytest.approx(2.0) == slow.ratio.high


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

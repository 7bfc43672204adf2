"""Whether the benchmark runs and says something of every row; never how fast anything is."""

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.bench_estimators import AIMS, has_reference
from benchmarks.compile_time import first_step
from benchmarks.replay import recorded
from benchmarks.timing import Row

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def lines():
    """The printed lines by estimator and row: their numbers."""
    done = subprocess.run(
        [sys.executable, "benchmarks/bench_estimators.py", "--quick"],
        cwd=ROOT, check=True, capture_output=True, text=True,
    )  # fmt: skip
    found = {}
    for line in done.stdout.splitlines():
        row = re.match(r"(ekf|ukf|enkf|mhe) +(\S.*?)  +(\S+ .*)$", line)
        if row:
            found[row[1], row[2]] = row[3].split()
    return found


def expected_rows():
    for estimator in AIMS:
        yield estimator, "compiled, one episode"
        yield estimator, "compiled, batch of 2"
        if has_reference(estimator):
            yield estimator, "reference"
        yield estimator, "qpsolvers, piqp" if estimator == "mhe" else "filterpy"


@pytest.mark.slow
@pytest.mark.parametrize("row", list(expected_rows()))
def test_every_row_is_there_and_finite(lines, row):
    numbers = [float(word) for word in lines[row] if word not in ("met", "no")]
    assert len(numbers) >= 3
    assert all(math.isfinite(number) and number > 0.0 for number in numbers)


@pytest.mark.slow
def test_a_first_step_is_timed_in_a_process_of_its_own(tmp_path):
    assert math.isfinite(first_step("open_loop", str(tmp_path)))
    assert list(tmp_path.rglob("*.nbi"))


class Counter(Row):
    """Yields a time that is told beforehand, and remembers which steps it took."""

    def __init__(self, seconds):
        super().__init__("ekf", "told")
        self.told, self.taken = iter(seconds), []

    def begin(self):
        pass

    def run(self, steps):
        for k in steps:
            self.taken.append(k)
            yield k, next(self.told)


def test_a_step_is_the_median_of_its_passes_and_a_row_the_mean_of_its_steps():
    row = Counter([1e-6, 4e-6, 2e-6, 5e-6, 9e-6, 6e-6])
    row.n_episodes = 2
    for _ in range(3):
        row.measure(range(2))
    assert row.taken == [0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(row.microseconds, [1.0, 2.5])
    assert row.mean == pytest.approx(1.75)


def test_a_replay_has_28_outputs_in_every_step_and_follows_the_schedule():
    replay = recorded("w99-3lane", (0,), 2, 11, 20)
    assert replay.n_outputs == 28
    assert (replay.observed.sum(axis=-1) == 14).all()
    assert replay.observed[..., [14, 17, 18]].all()
    changed = (replay.observed[1:, 0] != replay.observed[:-1, 0]).any(axis=-1)
    np.testing.assert_array_equal(np.flatnonzero(changed) + 1, [4, 8, 12, 16])
    assert not np.array_equal(replay.values[:, 0], replay.values[:, 1])
    assert replay.first(1).values.shape == (20, 1, 19, 2)


def test_more_steps_than_a_record_has_are_refused():
    with pytest.raises(ValueError, match=r"steps must be in 1\.\.700, got 701"):
        recorded("w99-3lane", (0,), 1, 11, 701)

"""Rows of the benchmark of the estimators, and their replay; never how fast anything is."""

import math

import numpy as np
import pytest

from benchmarks.bench_estimators import AIMS, Args, measure
from benchmarks.replay import recorded
from benchmarks.steps import step_times


@pytest.mark.slow
def test_every_row_is_there_and_finite():
    times = measure(Args(traffic_seeds="0:1", batch=2, steps=16, block=8, passes=1))
    compiled = ["compiled, one episode", "compiled, batch of 2"]
    assert {name: list(rows) for name, rows in times.items()} == {
        "ekf": [*compiled, "reference", "filterpy"],
        "ukf": [*compiled, "reference", "filterpy"],
        "enkf": [*compiled, "filterpy"],
        "mhe": [*compiled, "reference"],
    }
    assert times.keys() == AIMS.keys()
    assert all(
        math.isfinite(time) and time > 0.0 for rows in times.values() for time in rows.values()
    )


class Counter:
    """Remembers the blocks that it took; a step takes as long as its index says [us]."""

    def __init__(self, clock):
        self.clock, self.taken, self.block = clock, [], range(0)

    def begin(self, block):
        self.block = block

    def take(self):
        self.taken.append(self.block)
        self.clock.now += 1e-6 * sum(2 * (k + len(self.taken)) for k in self.block)
        return 2 * len(self.block)


class Clock:
    """A clock that only rows advance."""

    now = 0.0

    def __call__(self):
        return self.now


def test_the_time_of_a_block_is_the_median_of_its_passes(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("benchmarks.throughput.measure.time.perf_counter", clock)
    row = Counter(clock)
    times = step_times({"row": row}, 5, 2, 3)["row"]
    blocks = [range(2), range(2, 4), range(4, 5)]
    assert row.taken == [range(2), *blocks * 3]
    # The second pass is in the middle: its blocks are taken as numbers 5 to 7.
    np.testing.assert_allclose(times, [0.5 + 5, 2.5 + 6, 4 + 7])


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

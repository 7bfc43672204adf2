"""Benchmarks on long roads: that they run and what they fit; never how fast anything is."""

import numpy as np
import pytest

from benchmarks.bench_scaling import ESTIMATORS, Args, exponent, measure
from benchmarks.long_roads import long_road


def test_a_time_in_proportion_to_a_power_has_that_exponent():
    lengths = (30, 60, 200)
    assert exponent(lengths, 7.0 * np.array(lengths) ** 1.5) == pytest.approx(1.5)
    assert exponent(lengths, np.full(3, 7.0)) == pytest.approx(0.0)


def test_a_long_road_has_ramps_all_along():
    road = long_road(200)
    assert road.n_mainline == 200
    assert max(np.diff(sorted((*road.on_ramps, *road.off_ramps)))) <= 8
    assert len(road.exit_shares) == len(road.off_ramps)


@pytest.mark.slow
def test_every_estimator_is_measured_on_every_road():
    times = measure(Args(lengths=(16, 20), steps=6, block=3, passes=1))
    assert set(times) == set(ESTIMATORS)
    for found in times.values():
        assert found.shape == (2,)
        assert np.isfinite(found).all()
        assert (found > 0.0).all()

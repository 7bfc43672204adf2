import numpy as np
import pytest

from agents.statistics import (
    Interval,
    geometric_mean_interval,
    mean_interval,
    paired_difference,
)


def test_the_interval_is_students():
    interval = mean_interval([1.0, 2.0, 3.0, 4.0])
    # t(0.975, 3) = 3.18245 and the standard error is 0.645497
    assert interval.mean == pytest.approx(2.5)
    assert interval.half_width == pytest.approx(3.18245 * 0.645497, rel=1e-5)
    assert interval.n == 4


def test_the_interval_covers_as_often_as_it_says():
    draws = np.random.default_rng(0).standard_normal((2000, 8))
    covered = [interval.low <= 0 <= interval.high for interval in map(mean_interval, draws)]
    assert 0.93 < np.mean(covered) < 0.97


def test_pairing_removes_what_the_two_share():
    generator = np.random.default_rng(0)
    shared = 100 * generator.standard_normal(20)
    difference = paired_difference(shared + 1.0 + 0.1 * generator.standard_normal(20), shared)
    assert difference.excludes_zero()
    assert difference.mean == pytest.approx(1.0, abs=0.1)


def test_equal_values_have_an_interval_of_no_length():
    assert mean_interval([2.0, 2.0]) == Interval(2.0, 2.0, 2.0, 2)
    assert not paired_difference([1.0, 2.0], [1.0, 2.0]).excludes_zero()


def test_bad_values_are_refused():
    with pytest.raises(ValueError, match="at least 2 values"):
        mean_interval([1.0])
    with pytest.raises(ValueError, match="finite"):
        mean_interval([1.0, float("nan")])
    with pytest.raises(ValueError, match=r"one shape, got \(2,\) and \(3,\)"):
        paired_difference([1, 2], [1, 2, 3])


def test_a_geometric_interval_is_the_same_for_inverse_ratios():
    values = np.array([0.5, 1.0, 4.0, 3.0])
    own, inverse = geometric_mean_interval(values), geometric_mean_interval(1.0 / values)
    assert own.mean == pytest.approx(np.prod(values) ** 0.25)
    assert 0.0 < own.low < own.mean < own.high
    assert (inverse.low, inverse.high) == pytest.approx((1.0 / own.high, 1.0 / own.low))
    assert own.n == 4


@pytest.mark.parametrize("values", [[1.0, 0.0], [1.0, -1.0], [1.0, np.nan]])
def test_a_geometric_mean_needs_positive_values(values):
    with pytest.raises(ValueError, match="must be above zero"):
        geometric_mean_interval(values)

"""Intervals, their simulated coverage, and what has none."""

import numpy as np
import pytest

from agents.statistics import (
    Interval,
    bootstrap,
    interquartile_mean,
    mean_interval,
    percent_below,
)


def test_the_interval_is_students():
    interval = mean_interval([1.0, 2.0, 3.0, 4.0])
    # t(0.975, 3) = 3.18245 and the standard error is 0.645497
    assert interval.mean == pytest.approx(2.5)
    assert interval.half_width == pytest.approx(3.18245 * 0.645497, rel=1e-5)
    assert interval.n == 4
    assert mean_interval([2.0, 2.0]) == Interval(2.0, 2.0, 2.0, 2)


REFUSED = [
    (mean_interval, ([1.0],), "at least 2 values"),
    (mean_interval, ([1.0, float("nan")],), "finite"),
    (bootstrap, (interquartile_mean, np.ones((5, 1))), r"2 or more .*, got \[\(5, 1\)\]"),
    (bootstrap, (interquartile_mean, np.ones((0, 4))), r"got \[\(0, 4\)\]"),
    (bootstrap, (interquartile_mean, np.ones((2, 3, 4))), r"got \[\(2, 3, 4\)\]"),
    (bootstrap, (interquartile_mean, np.array([[1.0, np.nan]])), "every resample"),
    (bootstrap, (percent_below, np.ones((2, 4)), np.ones(5)), r"got \[\(2, 4\), \(1, 5\)\]"),
    (bootstrap, (percent_below, np.ones(3), np.array([-1.0, 0.0, 1.0])), "every resample"),
]


def test_what_has_no_statistic_is_refused():
    for function, given, message in REFUSED:
        with pytest.raises(ValueError, match=message), np.errstate(divide="ignore"):
            function(*given)


def coverage(make_interval, spreads, n_trials=300, n_runs=5, n_traffic=64):
    """The share of intervals that cover 0, for spreads of runs, of traffic and of cells."""
    rng, of_runs, of_traffic, of_cells = np.random.default_rng(1), *spreads
    covered = 0
    for _ in range(n_trials):
        table = of_runs * rng.standard_normal((n_runs, 1))
        table = table + of_traffic * rng.standard_normal((1, n_traffic))
        interval = make_interval(table + of_cells * rng.standard_normal((n_runs, n_traffic)))
        covered += interval.low <= 0.0 <= interval.high
    return covered / n_trials


def two_level(table):
    return bootstrap(interquartile_mean, table, n_resamples=400)


@pytest.mark.slow
def test_the_bootstrap_covers_where_traffic_decides_and_says_where_it_does_not():
    assert 0.92 < coverage(two_level, (1.0, 8.0, 2.0)) < 0.98
    assert 0.84 < coverage(two_level, (1.0, 0.0, 0.5)) < 0.93  # as its docstring admits


def test_the_bootstrap_finds_a_known_effect_that_pairing_reveals():
    generator = np.random.default_rng(3)
    traffic = 50.0 + 10.0 * generator.standard_normal(64)
    reference = traffic + 0.5 * generator.standard_normal(64)
    runs = 0.9 * traffic + 0.3 * generator.standard_normal((5, 1))
    below = bootstrap(percent_below, runs, reference)
    typical = np.sort(runs.mean(axis=1))[1:4].mean()
    assert below.mean == pytest.approx(100 * (1 - typical / reference.mean()))
    assert below.low < 10.0 < below.high
    assert below.half_width < 1.0
    assert below.n == 64
    # Drawn apart, the same numbers would say nothing.
    assert bootstrap(interquartile_mean, runs).half_width > 2.0


def test_rows_of_tables_are_drawn_apart_and_columns_together():
    rows = np.tile(np.arange(5.0)[:, None], (1, 8))
    same = bootstrap(lambda a, b: a.mean((1, 2)) - b.mean((1, 2)), rows, rows)
    assert same.mean == 0.0
    assert same.high > 1.0
    columns = np.tile(np.arange(8.0), (5, 1))
    assert (
        bootstrap(lambda a, b: a.mean((1, 2)) - b.mean((1, 2)), columns, columns).half_width == 0.0
    )


def test_the_bootstrap_is_seeded_and_lies_between_percentiles():
    table, drawn = np.random.default_rng(4).standard_normal((3, 9)), []

    def keep(tables):
        drawn.append(interquartile_mean(tables))
        return drawn[-1]

    found = bootstrap(keep, table)
    percentiles = np.percentile(np.concatenate(drawn[:-1]), [2.5, 97.5])  # the last is the mean
    assert [found.low, found.high] == pytest.approx(percentiles)
    assert bootstrap(interquartile_mean, table, seed=5) == bootstrap(
        interquartile_mean, table, seed=5
    )
    assert bootstrap(interquartile_mean, table, seed=5) != bootstrap(
        interquartile_mean, table, seed=6
    )


def test_the_interquartile_mean_leaves_the_best_and_the_worst_training_out_and_no_traffic():
    table = np.array([[9.0, 0.0], [1.0, 3.0], [2.0, 4.0], [70.0, 90.0], [1.0, 1.0]])
    assert interquartile_mean(table) == pytest.approx((4.5 + 2.0 + 3.0) / 3)
    few = table[[0, 3]]
    np.testing.assert_allclose(interquartile_mean(np.stack([few, few + 1.0])), [42.25, 43.25])

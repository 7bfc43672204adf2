"""Demand and incidents: what is refused, and what is drawn."""

import numpy as np
import pytest

from dptse_env.traffic import Demand, DemandDistribution, Incident, IncidentDistribution


@pytest.mark.parametrize(
    ("mainline", "on_ramps", "message"),
    [
        (((10, 1.0),), (), r"demand\.mainline must be steps .* start at 0"),
        (((0, 1.0), (5, 2.0), (5, 3.0)), (), r"demand\.mainline must be steps .* increase"),
        (((0, -1.0),), (), r"demand\.mainline\[0\]\[1\] must be .*, got -1\.0"),
        (((0, 1.0),), (float("inf"),), r"demand\.on_ramps\[0\] must be .*, got inf"),
    ],
)
def test_bad_demands_are_refused_by_path(mainline, on_ramps, message):
    with pytest.raises(ValueError, match=message):
        Demand(mainline, on_ramps)


def test_a_distribution_scales_every_rate_by_one_factor_within_its_range():
    base = Demand(((0, 1000.0), (100, 2000.0)), (300.0,))
    distribution = DemandDistribution(base, scale=(0.5, 1.5))
    factors = []
    for seed in range(200):
        demand = base.scaled(distribution.draw_scale(np.random.default_rng(seed)))
        factor = demand.on_ramps[0] / 300.0
        assert [rate for _, rate in demand.mainline] == pytest.approx([1e3 * factor, 2e3 * factor])
        assert [time for time, _ in demand.mainline] == [0.0, 100.0]
        factors.append(factor)
    assert 0.5 <= min(factors) < 0.55
    assert 1.45 < max(factors) <= 1.5


@pytest.mark.parametrize("scale", [(0.0, 1.0), (1.2, 0.8)])
def test_a_scale_that_is_no_positive_range_is_refused(scale):
    with pytest.raises(ValueError, match=r"demand\.scale"):
        DemandDistribution(Demand(((0, 1.0),)), scale=scale)


@pytest.mark.parametrize(
    ("segment", "phases", "message"),
    [
        (0, (), r"incident\.phases must be at least one phase"),
        (0, ((5, 5, 1),), r"incident\.phases\[0\] must be after 0\.0 s with start < end"),
        (0, ((0, 9, 1), (8, 12, 1)), r"incident\.phases\[1\] must be after 9\.0 s"),
        (0, ((0, 9, 0),), r"incident\.phases\[0\]\[2\] must be a number in \(0, 1000\], got 0"),
    ],
)
def test_bad_incidents_are_refused_by_path(segment, phases, message):
    with pytest.raises(ValueError, match=message):
        Incident(segment, phases)


def test_drawn_incidents_stay_in_the_declared_ranges_and_fill_them():
    distribution = IncidentDistribution(
        segments=(2, 5),
        start=(0, 100),
        duration=(10, 20),
        speed_limit=(5, 6),
        recovery_duration=(30, 40),
        recovery_speed_limit=(50, 60),
    )
    drawn = [distribution.draw(np.random.default_rng(seed)) for seed in range(300)]
    assert {incident.segment for incident in drawn} == {2, 5}
    ranges = [(0, 100), (10, 20), (5, 6), (30, 40), (50, 60)]
    values = np.array(
        [
            (start, middle - start, limit, end - middle, recovery)
            for (start, middle, limit), (_, end, recovery) in (each.phases for each in drawn)
        ]
    )
    for (low, high), column in zip(ranges, values.T, strict=True):
        margin = 0.05 * (high - low)
        assert low - 1e-9 <= column.min() < low + margin
        assert high - margin < column.max() <= high + 1e-9


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"segments": ()}, r"incident\.segments must be at least one segment"),
        ({"segments": (1,), "duration": (9, 5)}, r"incident\.duration must be a pair"),
        ({"segments": (1,), "speed_limit": (0, 5)}, r"incident\.speed_limit\[0\] must be"),
    ],
)
def test_bad_ranges_are_refused_by_path(fields, message):
    with pytest.raises(ValueError, match=message):
        IncidentDistribution(**fields)

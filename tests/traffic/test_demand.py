"""Demand and incidents: what is refused, and what is drawn."""

import numpy as np
import pytest

from dptse_env.traffic import Demand, DemandDistribution, Incident, IncidentDistribution

STEPS = ((0, 1.0),)
BAD = [
    (lambda: Demand(((10, 1.0),)), r"mainline must be steps .* start at 0"),
    (lambda: Demand(((0, 1.0), (5, 2.0), (5, 3.0))), r"mainline must be steps .* increase"),
    (lambda: Demand(((0, -1.0),)), r"mainline\[0\]\[1\] must be .*, got -1\.0"),
    (lambda: Demand(STEPS, (float("inf"),)), r"on_ramps\[0\] must be .*, got inf"),
    (lambda: Demand(STEPS, (((5.0, 1.0),),)), r"on_ramps\[0\] must be steps \(time, rate\)"),
    (lambda: DemandDistribution(Demand(STEPS), scale=(0.0, 1.0)), r"scale"),
    (lambda: DemandDistribution(Demand(STEPS), scale=(1.2, 0.8)), r"scale"),
    (lambda: Incident(0, ()), r"phases must be at least one phase"),
    (lambda: Incident(0, ((5, 5, 1),)), r"phases\[0\] must be after 0\.0 s with start < end"),
    (lambda: Incident(0, ((0, 9, 1), (8, 12, 1))), r"phases\[1\] must be after 9\.0 s"),
    (lambda: Incident(0, ((0, 9, 0),)), r"phases\[0\]\[2\] must be a number in \(0, 1000\]"),
    (lambda: IncidentDistribution(()), r"segments must be at least one segment"),
    (lambda: IncidentDistribution((1,), duration=(9, 5)), r"duration must be a pair"),
    (lambda: IncidentDistribution((1,), speed_limit=(0, 5)), r"speed_limit\[0\] must be"),
]


def test_what_is_impossible_is_refused_by_path():
    for make, message in BAD:
        with pytest.raises(ValueError, match=rf"^(demand|incident)\.{message}"):
            make()


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


def test_drawn_incidents_stay_in_the_declared_ranges_and_fill_them():
    low, high = np.array([(0, 100), (10, 20), (5, 6), (30, 40), (50, 60)]).T
    names = "start", "duration", "speed_limit", "recovery_duration", "recovery_speed_limit"
    ranges = dict(zip(names, zip(low, high, strict=True), strict=True))
    distribution = IncidentDistribution(segments=(2, 5), **ranges)
    drawn = [distribution.draw(np.random.default_rng(seed)) for seed in range(300)]
    assert {incident.segment for incident in drawn} == {2, 5}
    values = np.array(
        [
            (start, middle - start, limit, end - middle, recovery)
            for (start, middle, limit), (_, end, recovery) in (each.phases for each in drawn)
        ]
    )
    margin = 0.05 * (high - low)
    assert (low - 1e-9 <= values.min(axis=0)).all()
    assert (values.min(axis=0) < low + margin).all()
    assert (high - margin < values.max(axis=0)).all()
    assert (values.max(axis=0) <= high + 1e-9).all()

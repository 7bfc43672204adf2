import numpy as np
import pytest

from dptse_env.traffic import Demand, DemandDistribution


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
        demand = distribution.draw(np.random.default_rng(seed))
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

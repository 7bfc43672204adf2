import numpy as np
import pytest

from dptse_env.traffic import Incident, IncidentDistribution
from dptse_env.traffic.incident import limit_changes


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


def test_limits_return_to_normal_between_phases_only_where_there_is_a_gap():
    touching = Incident(0, ((10, 20, 5), (20, 30, 50)))
    apart = Incident(0, ((10, 20, 5), (25, 30, 50)))
    assert limit_changes([touching], [100.0]) == [(10, 0, 5), (20, 0, 50), (30, 0, 100)]
    assert limit_changes([apart], [100.0]) == [
        (10, 0, 5), (20, 0, 100), (25, 0, 50), (30, 0, 100),
    ]  # fmt: skip


def test_the_lowest_limit_holds_where_incidents_overlap():
    first, second = Incident(1, ((10, 40, 20),)), Incident(1, ((20, 30, 5), (30, 50, 60)))
    elsewhere = Incident(0, ((15, 25, 8),))
    assert limit_changes([first, second, elsewhere], [100.0, 80.0]) == [
        (10, 1, 20), (15, 0, 8), (20, 1, 5), (25, 0, 100), (30, 1, 20), (40, 1, 60), (50, 1, 80),
    ]  # fmt: skip


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

"""The connected vehicles: nested in the share, and the same for every policy."""

import itertools

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.traffic import Penetration
from tests.helpers import record

SHARES = (0.01, 0.1, 0.3, 0.9, 1.0)


def road_of(n_vehicles):
    """A record of one second, in which every vehicle is on segment 0."""
    places = np.zeros((n_vehicles, 1), dtype=int)
    return record(places, 10.0 + np.arange(n_vehicles)[:, None], n_columns=3)


def test_connected_vehicles_at_a_share_are_connected_at_every_larger_one():
    sets = [Penetration(share).connected(7, road_of(5_000)) for share in SHARES]
    for smaller, larger in itertools.pairwise(sets):
        assert not (smaller & ~larger).any()
    assert sets[-1].all()
    for share, connected in zip(SHARES, sets, strict=True):
        assert abs(connected.mean() - share) < 4.0 * np.sqrt(share * (1.0 - share) / 5_000) + 1e-12


def test_a_vehicle_is_connected_by_its_seeds_and_number_alone():
    def connected(seed=0, traffic_seed=7, n=1_000):
        return Penetration(0.5, seed=seed).connected(traffic_seed, road_of(n))

    np.testing.assert_array_equal(connected(n=10), connected()[:10])
    for change in ({"seed": 1}, {"traffic_seed": 8}):
        # Two independent sets share about half of the vehicles' flags.
        assert 0.4 < (connected() == connected(**change)).mean() < 0.6


def test_a_share_of_a_range_is_drawn_for_each_traffic_seed():
    penetration = Penetration((0.1, 0.4))
    shares = np.array([penetration.share_of(seed) for seed in range(200)])
    assert ((shares >= 0.1) & (shares <= 0.4)).all()
    assert abs(shares.mean() - 0.25) < 0.03
    assert len(set(shares.tolist())) == 200
    assert shares[3] == penetration.share_of(3)
    assert penetration.published_share == pytest.approx(0.25)
    connected = [penetration.connected(seed, road_of(4_000)).mean() for seed in range(5)]
    np.testing.assert_allclose(connected, shares[:5], atol=0.03)


def test_the_connected_vehicles_report_and_some_misreport_their_speed():
    whole = road_of(2_000)
    penetration = Penetration(0.5, misreporting=0.25, misreport_factor=2.0)
    speeds = penetration.speeds(7, whole)
    reported = np.flatnonzero(speeds >= 0.0)
    np.testing.assert_array_equal(
        whole.vehicle[reported], np.flatnonzero(penetration.connected(7, whole))
    )
    assert (speeds == -1.0).sum() == whole.n_rows - reported.size
    factor = speeds[reported] / (10.0 + whole.vehicle[reported])
    assert set(np.round(factor, 3).tolist()) == {1.0, 2.0}
    assert abs((factor > 1.5).mean() - 0.25) < 0.06
    half = Penetration(misreporting=0.5, misreport_factor=2.0)
    wrong = [half.speeds(seed, whole) > whole.speed for seed in (7, 8)]
    assert 0.4 < (wrong[0] == wrong[1]).mean() < 0.6


IMPOSSIBLE = [
    (0.0, "share must be"),
    (1.2, "share must be"),
    ([0.4, 0.1], "share must be"),
    ([0.0, 0.1], r"share\[0\] must be"),
    ({"share": 0.1, "class": "car"}, "class is unknown"),
]


def test_shares_are_numbers_pairs_and_mappings_within_their_range():
    for penetration, message in IMPOSSIBLE:
        with pytest.raises(ValueError, match=rf"^penetration\.{message}"):
            resolve("short-plain", {"penetration": penetration})
    for value in (0.1, [0.1, 0.2], {"seed": 3}):
        config = resolve("short-plain", {"penetration": value})
        assert config.has_separate_sensors == (value != {"seed": 3})

import numpy as np
import pytest

from dptse_env.sensing import Sensing
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary


@pytest.fixture(scope="module")
def sensing():
    sensing = Sensing(SHORT_HIGHWAY, (4, 7), RecordLibrary())
    sensing.load(0)
    return sensing


def test_aggregates_are_counts_and_means_over_vehicles(sensing):
    record = sensing.library.get(SHORT_HIGHWAY, 4)
    rows = record.rows(120)
    segments, speeds = record.segment[rows], record.speed[rows].astype(float)
    (answer,) = sensing.aggregates(np.array([0]), np.array([120]))
    occupied = 0
    for segment in range(SHORT_HIGHWAY.n_segments):
        here = speeds[segments == segment]
        assert answer[segment, 0] == pytest.approx(len(here) / 0.1)
        if len(here):
            occupied += 1
            assert answer[segment, 1] == pytest.approx(here.mean())
    assert occupied > 3


def test_an_empty_segment_answers_with_the_speed_limit(sensing):
    traffic = sensing.traffic(0)
    empty = traffic[..., 0] == 0
    assert empty[0].all()  # the road is empty at second 0
    assert 0 < empty[100:].sum() < empty[100:].size
    assert (traffic[..., 1][empty] == SHORT_HIGHWAY.speed_limit).all()


def test_a_slot_is_loaded_once(sensing):
    assert not sensing.load(0)
    fresh = Sensing(SHORT_HIGHWAY, (4,), sensing.library)
    assert fresh.load(0)
    assert not fresh.load(0)


def test_boundary_segments_come_last(sensing):
    traffic = sensing.traffic(0)
    assert traffic.shape == (241, SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries, 2)
    segments = sensing.aggregates(np.zeros(241, dtype=np.int64), np.arange(241))
    np.testing.assert_array_equal(traffic[:, : SHORT_HIGHWAY.n_segments], segments)

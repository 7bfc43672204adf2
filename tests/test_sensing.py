import numpy as np
import pytest

from dptse_env.privacy import PrivacySettings
from dptse_env.sensing import AggregateAnswers, BoundedAnswers, Sensing, make_answers
from dptse_env.traffic import SHORT_HIGHWAY, RecordLibrary

from .worlds import AWAY, Worlds, record


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
    assert sensing.load(0) == []
    fresh = Sensing(SHORT_HIGHWAY, (4,), sensing.library)
    assert fresh.load(np.array([0, 0])) == [0]
    assert fresh.load(0) == []


def test_missing_records_are_made_together(tmp_path, monkeypatch):
    library = RecordLibrary(tmp_path)
    asked = []
    monkeypatch.setattr(library, "ensure", lambda corridor, seeds: asked.append(list(seeds)))
    sensing = Sensing(SHORT_HIGHWAY, (4, 7, 9), RecordLibrary())
    sensing.load(0)
    monkeypatch.setattr(library, "get", sensing.library.get)
    sensing.library = library
    assert sensing.load(np.array([2, 0, 1, 2])) == [1, 2]
    assert asked == [[7, 9]]


def test_boundary_segments_come_last(sensing):
    traffic = sensing.traffic(0)
    assert traffic.shape == (241, SHORT_HIGHWAY.n_segments + SHORT_HIGHWAY.n_boundaries, 2)
    segments = sensing.aggregates(np.zeros(241, dtype=np.int64), np.arange(241))
    np.testing.assert_array_equal(traffic[:, : SHORT_HIGHWAY.n_segments], segments)


# --- answers with bounded contributions -----------------------------------------------------------


def bounded(speed, cap=None):
    places = np.array([[AWAY, 1, 1], [AWAY, 1, 2], [AWAY, AWAY, 5]])
    speeds = np.array([[0, 20, 150], [0, 60, 40], [0, 0, 102]])
    unit = "horizon" if cap is None else "trip"
    settings = PrivacySettings("guaranteed", unit=unit, cap=cap or 64, speed_release=speed)
    return Worlds(record(places, speeds, 12)).answers(settings)


def answered(answers, time, *asked):
    observed = np.zeros((1, 12), dtype=bool)
    observed[0, list(asked)] = True
    one = np.zeros(1, dtype=np.int64)
    return answers.collect(one, one, np.array([time]), observed)[0]


def test_a_flow_is_a_sum_of_centred_and_clipped_speeds():
    answers = bounded("flow")
    np.testing.assert_allclose(answered(answers, 1, 1)[1], [20.0, ((20 - 51) + (60 - 51)) / 0.1])
    now = answered(answers, 2, 1, 2, 3)
    np.testing.assert_allclose(now[1], [10.0, 510.0])  # 150 km/h is clipped to 102
    np.testing.assert_allclose(now[2], [10.0, (40 - 51) / 0.1])
    np.testing.assert_array_equal(now[3], [0.0, 0.0])  # nobody there
    np.testing.assert_array_equal(now[5], [0.0, 0.0])  # not asked


def test_a_mean_is_over_those_that_count():
    answers = bounded("mean", cap=1)
    np.testing.assert_allclose(answered(answers, 1, 1)[1], [20.0, 40.0])
    now = answered(answers, 2, 1, 2, 5)
    np.testing.assert_allclose(now[[1, 2]], [[0.0, 102.0]] * 2)  # both have counted before
    np.testing.assert_allclose(now[5], [10.0, 102.0])


@pytest.mark.parametrize(
    ("privacy", "kind"),
    [
        ({"preset": "paper"}, AggregateAnswers),
        ({"preset": "corrected"}, AggregateAnswers),
        ({"preset": "guaranteed"}, BoundedAnswers),
        ({"preset": "guaranteed", "speed_release": "mean"}, BoundedAnswers),
    ],
)
def test_a_preset_that_bounds_contributions_counts_them(sensing, privacy, kind):
    answers = make_answers(PrivacySettings(**privacy), sensing, 8, 1)
    assert type(answers) is kind
    assert (answers.contributions is None) == (kind is AggregateAnswers)


@pytest.mark.parametrize(("unit", "cap"), [("trip", 64), ("horizon", None), ("event", None)])
def test_the_cap_belongs_to_trips(sensing, unit, cap):
    answers = make_answers(PrivacySettings("guaranteed", unit=unit), sensing, 8, 1)
    assert answers.contributions.cap == cap


def test_without_a_cap_the_answers_are_the_aggregates(sensing):
    """Density of all vehicles, and the flow that follows from it and the mean speed."""
    settings = PrivacySettings("guaranteed", unit="horizon")
    bounded, plain = make_answers(settings, sensing, 8, 1), AggregateAnswers(sensing, 8)
    bounded.load(0)
    one, everyone = np.zeros(1, dtype=np.int64), np.ones((1, 8), dtype=bool)
    occupied = 0
    for t in range(1, 241):
        density, flow = bounded.collect(one, one, np.array([t]), everyone)[0].T
        true_density, mean = plain.collect(one, one, np.array([t]), everyone)[0].T
        np.testing.assert_allclose(density, true_density)
        limit = SHORT_HIGHWAY.speed_limit
        # Some drivers are faster than the limit, and are clipped.
        assert (flow <= true_density * (mean - 0.5 * limit) + 1e-3).all()
        slow = mean < 0.6 * limit
        np.testing.assert_allclose(
            flow[slow], (true_density * (mean - 0.5 * limit))[slow], atol=1e-2, rtol=0.05
        )
        occupied += slow.sum()
    assert occupied > 10

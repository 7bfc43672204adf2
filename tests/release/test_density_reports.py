"""Deviations of reported densities in place of counts: what they add up to, and what they tell.

As in `test_sensitivity`, no policy may tell two worlds apart by more than mu, whatever vehicles
report and whatever is predicted.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.privacy import mu_of
from dptse_env.release import CappedSettings, DensityRelease, PacedSettings
from dptse_env.release.contributions import Contributions
from dptse_env.release.density import COUNTS, LEAST_CENTRE
from dptse_env.release.pacing import PacingSetup, TracerPacing
from dptse_env.traffic import ReportRecord

from .adjacent import adjacent_trips
from .paced_worlds import PLACES, Public, T, predicting, request, square, streams
from .worlds import AWAY, BOTH, Worlds, corridor, record, squared_distance

COLUMNS = 12
LIMIT = corridor(T).speed_limit
SLACK = 1.0 + 1e-9
JAMMED, LONELY = 0.001, 1.0
"""Road that a vehicle has to itself [km]."""


def reporting(one, reports):
    """A record whose vehicles report (V, T + 1) of the traffic around them."""
    return ReportRecord.of(one, np.asarray(reports)[one.vehicle, one.step])


def lone(place, speed, report, present=True):
    """A record of one vehicle that stays, and reports the same; second 0 is empty."""
    places = np.full((1, T + 1), place if present else AWAY)
    places[:, 0] = AWAY
    return reporting(
        record(places, np.full(places.shape, speed), COLUMNS), np.full(places.shape, report)
    )


# --- what is released -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "report", "deviation", "clip"),
    [
        ("spacing", 1 / 50, 0.0, 1.0),  # what is predicted: 50 veh/km
        ("spacing", 1 / 100, 0.5, 1.0),
        ("neighbours", 1 / 100, 0.5, 0.4),
        ("spacing", 1 / 40, -0.25, 2.0),
        ("neighbours", LONELY, -49.0, 2.0),
    ],
)
def test_a_vehicle_adds_its_deviation_from_the_prediction(source, report, deviation, clip):
    release = Worlds(lone(1, 0.0, report)).release(
        CappedSettings(), density=DensityRelease(source, clip)
    )
    release.reset(np.array([0]), streams(0))
    values = release.true_values(request(1, prediction=predicting(50.0)))
    expected = np.clip(deviation / clip, -1.0, 1.0) / corridor(T).segment_length
    np.testing.assert_allclose(values[0, :, 0], np.eye(COLUMNS)[1] * expected, atol=1e-5)


def test_deviations_are_taken_from_densities_within_bounds():
    release = DensityRelease("spacing", 1.0, 300.0)
    predicted = np.array([[-3.0, 40.0, 900.0, np.nan, np.inf]])
    expected = [[LEAST_CENTRE, 40.0, 300.0, LEAST_CENTRE, LEAST_CENTRE]]
    np.testing.assert_array_equal(release.centres(predicted), expected)


def test_boundary_segments_are_compared_with_the_segments_next_to_them():
    road = corridor(T)
    release = Worlds(lone(road.n_segments + 1, 0.0, 1 / 80)).release(
        CappedSettings(), density=DensityRelease("spacing")
    )
    release.reset(np.array([0]), streams(0))
    density = np.full(road.n_segments, 10.0)
    density[road.n_mainline - 1] = 40.0  # the downstream end
    found = release.true_values(request(1, prediction=predicting(density)))[0, :, 0]
    assert found[road.n_segments + 1] * road.segment_length == pytest.approx(0.5, rel=1e-5)


def test_the_cap_counts_steps_whatever_is_reported():
    contributions = Contributions(1, T + 1, 1, LIMIT, 3, np.arange(COLUMNS))
    contributions.load(0, lone(1, 50.0, 1 / 50))
    terms = DensityRelease("spacing").terms(np.full((1, COLUMNS), 50.0))
    every, zero = np.ones((1, COLUMNS), dtype=bool), np.array([0])
    sums = [contributions.collect(zero, zero, np.array([t]), every, terms) for t in range(1, T + 1)]
    assert [counts.sum() for counts, _, _ in sums] == [1.0] * 3 + [0.0] * (T - 3)
    assert all(abs(deviations).max() < 1e-6 for _, deviations, _ in sums)


def test_a_vehicle_that_reports_what_is_predicted_pays_for_its_speed_alone():
    asked = PacedSettings(clip=LIMIT / 2)
    release = Worlds(lone(1, 60.0, 1 / 50), lone(1, 60.0, 1 / 100)).release(
        asked, density=DensityRelease("spacing")
    )
    release.reset(BOTH, streams(0, 1))
    prices, centres = np.full((2, COLUMNS), 1e-3), np.full((2, COLUMNS), 60.0)
    release.collect(
        request(1, prediction=predicting(50.0, 60.0, 2), episodes=BOTH), prices, centres
    )
    paid = [release.ledgers.paid_by(k, k)[0] for k in range(2)]
    assert paid == pytest.approx([0.0, 1e-3 * 0.5**2], abs=1e-9)


# --- the guarantee ----------------------------------------------------------------------------


@st.composite
def adjacent_reports(draw, asked, n_vehicles, n_steps, last_place):
    """Two records that differ in the trip, and in the reports, of vehicle 0."""
    places, speeds, *others = draw(adjacent_trips(asked, n_vehicles, n_steps, last_place, LIMIT))
    report = st.sampled_from([JAMMED, 0.02, LONELY]) | st.floats(JAMMED, LONELY)
    reports = draw(arrays(float, places.shape, elements=report))
    other = reports.copy()
    changed = (others[0][0] != places[0]) | (others[1][0] != speeds[0])
    other[0, changed] = draw(arrays(float, places.shape[1], elements=report))[changed]
    return (
        reporting(record(places, speeds, COLUMNS), reports),
        reporting(record(*others, COLUMNS), other),
    )


SOURCES = st.sampled_from(["spacing", "neighbours"])
UNITS = st.sampled_from(["trip", "horizon", "event"])
DENSITIES = arrays(float, corridor(T).n_segments, elements=st.floats(0.0, 500.0))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_policy_exceeds_mu_under_capped(data):
    asked = CappedSettings(
        unit=data.draw(UNITS),
        cap=data.draw(st.sampled_from([1, 3])),
        adjacency=data.draw(st.sampled_from(["replace", "add_remove"])),
        share=data.draw(st.sampled_from([0.2, 0.8])),
    )
    source = data.draw(SOURCES)
    worlds = Worlds(*data.draw(adjacent_reports(asked, 3, T, 3)))
    density = DensityRelease(source, data.draw(st.sampled_from([0.5, 1.0, 3.0])), 400.0)
    release = worlds.release(asked, density=density)
    masks = data.draw(arrays(bool, (T, COLUMNS)))
    prediction = predicting(data.draw(DENSITIES), 60.0, 2)
    found = squared_distance(release, lambda past: masks[len(past)], T, prediction=prediction)
    assert found <= mu_of(asked.epsilon, asked.delta) ** 2 * SLACK


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_nothing_public_exceeds_mu_under_paced(data):
    asked = PacedSettings(
        adjacency=data.draw(st.sampled_from(["replace", "add_remove"])),
        clip=data.draw(st.sampled_from([5.0, 51.0])),
        ratio=data.draw(st.sampled_from([0.1, 1.0])),
        unit=data.draw(st.sampled_from(["trip", "event"])),
    )
    source, mu = data.draw(SOURCES), mu_of(asked.epsilon, asked.delta)
    worlds = Worlds(*data.draw(adjacent_reports(asked, 3, T, PLACES)))
    density = DensityRelease(source, data.draw(st.sampled_from([0.5, 1.0, 3.0])), 400.0)
    price = st.floats(1e-3, 1.0).map(lambda part: part * mu**2)
    public = Public(
        data.draw(arrays(bool, (T, COLUMNS))),
        data.draw(arrays(float, (T, COLUMNS), elements=price)),
        data.draw(arrays(float, (T, COLUMNS), elements=st.floats(0.0, LIMIT))),
    )
    prediction = predicting(data.draw(DENSITIES), 60.0, 2)
    release = worlds.release(asked, density=density)
    assert square(sums_of(release, public, prediction), public, asked) <= mu**2


def sums_of(release, public, prediction):
    release.reset(BOTH, streams(0, 1))
    for t in range(T):
        asked = request(t + 1, public.observed[t], prediction, BOTH)
        yield release.collect(asked, *(array[[t, t]] for array in public[1:]))


ADJACENT = {
    "opposite on one segment": (lone(1, LIMIT, JAMMED), lone(1, 0.0, LONELY), "replace"),
    "a lone vehicle": (
        lone(1, LIMIT, JAMMED),
        lone(1, LIMIT, JAMMED, present=False),
        "add_remove",
    ),
}


@pytest.mark.parametrize(("first", "second", "adjacency"), ADJACENT.values(), ids=ADJACENT)
def test_the_worst_case_reaches_the_whole_of_mu_under_capped(first, second, adjacency):
    """Two vehicles may be opposite in both quantities, so that counts' sqrt(2) is not enough."""
    asked = CappedSettings(cap=4, adjacency=adjacency)
    release = Worlds(first, second).release(asked, density=DensityRelease("spacing"))
    found = squared_distance(
        release,
        lambda past: np.ones(COLUMNS, dtype=bool),
        T,
        prediction=predicting(300.0, LIMIT / 2, 2),
    )
    # The deviation of the vehicle in a jam is 1 - 300 / 1000.
    assert found / mu_of(asked.epsilon, asked.delta) ** 2 == pytest.approx(
        (1.7**2 / 4 + 1) / 2 if adjacency == "replace" else (0.7**2 + 1) / 2, rel=1e-5
    )


@pytest.mark.parametrize(("first", "second", "adjacency"), ADJACENT.values(), ids=ADJACENT)
def test_the_worst_case_reaches_the_whole_of_mu_under_paced(first, second, adjacency):
    asked = PacedSettings(adjacency=adjacency, clip=LIMIT / 2)
    release = Worlds(first, second).release(asked, density=DensityRelease("spacing"))
    # All of its deviation 1 - 0.001 * 5, and of its speed, in each of T seconds.
    price = release.ledgers.budget / T / 2.0
    public = Public(
        np.ones((T, COLUMNS), dtype=bool),
        np.full((T, COLUMNS), price),
        np.full((T, COLUMNS), LIMIT / 2),
    )
    prediction = predicting(LEAST_CENTRE if adjacency == "add_remove" else 30.0, LIMIT / 2, 2)
    reached = square(sums_of(release, public, prediction), public, asked)
    assert 0.96 < reached / mu_of(asked.epsilon, asked.delta) ** 2 <= 1.0


@pytest.mark.parametrize("asked", [CappedSettings(), PacedSettings()], ids=["capped", "paced"])
def test_the_privacy_report_says_what_is_released(asked):
    worlds = Worlds(lone(1, 0.0, 1.0))
    counted = worlds.release(asked).report()
    reported = worlds.release(asked, density=DensityRelease("spacing", 2.0)).report()
    assert "density_from" not in counted.details
    assert reported.details["density_from"] == "spacing"
    assert reported.details["report_clip"] == 2.0
    assert reported.mu == pytest.approx(counted.mu)
    if asked.preset == "paced":
        assert "deviation of spacing" in reported.guarantee


# --- pacing -----------------------------------------------------------------------------------


def test_prices_rise_where_vehicles_pay_less_and_stay_for_counts():
    def prices(density):
        release = Worlds(lone(1, 60.0, 1 / 50)).release(PacedSettings(), density=density)
        release.reset(np.array([0]), streams(0))
        release.release(request(1, prediction=predicting()))
        assert isinstance(release.pacing, TracerPacing)
        return release.prices[0] / release.budget, release.pacing.setup

    counted, setup = prices(DensityRelease())
    assert setup.mean_square == PacingSetup.__dataclass_fields__["mean_square"].default == 1.0
    reported, _ = prices(DensityRelease("neighbours"))
    assert (reported > 1.5 * counted).all()
    every = dataclasses.replace(setup, mean_square=1.0)
    assert TracerPacing(every)._relative_charge == 1.0
    assert COUNTS.offset == 1.0

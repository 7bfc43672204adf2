"""Release models with Gaussian noise: what they release, what may be claimed, and the bound on it.

Under `Capped` no policy tells two worlds apart by more than mu, given the same past releases. That
holds surely, so it is tested without noise: the true answers of two worlds that differ in one
vehicle are never further apart than mu, in units of the noise, whatever is queried.
"""

import math

import numpy as np
import pytest
from dp_accounting import get_epsilon_gaussian
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dptse_env.config import resolve
from dptse_env.parts import make_release, privacy_report
from dptse_env.privacy import epsilon_of, epsilons_of, mu_of
from dptse_env.release import RELEASE_MODELS, CappedSettings, Group, PrivacySettings
from dptse_env.traffic import Penetration
from tests.helpers import AWAY, UNEVEN, pairwise, record, short_road

from .worlds import (
    BOTH,
    COLUMNS,
    LENGTH,
    LIMIT,
    ONE,
    TWO_GROUPS,
    WHOLE,
    T,
    Worlds,
    adjacent_trips,
    crowd,
    request,
    stays,
    streams,
)

SENSITIVITY_REASONS = ("average_dwell", "adaptive_queries", "speed_sensitivity")


def test_a_unit_bounds_how_often_it_counts_and_boundaries_are_nominal_unless_given():
    trip, event = (CappedSettings(unit=unit) for unit in ("trip", "event"))
    assert [each.contributions(100) for each in (trip, event)] == [64, 1]
    assert [each.contribution_cap for each in (trip, event)] == [64, None]
    assert trip.contributions(10) == 10
    assert (PrivacySettings().boundary, trip.boundary) == ("true", "nominal")
    assert CappedSettings(boundary_inputs="true").boundary == "true"


# --- true values ---------------------------------------------------------------------------------


def true_values(release, time, *queried):
    return release.true_values(request(time, np.isin(np.arange(COLUMNS), queried)))[0]


def test_a_flow_is_a_sum_of_centred_and_clipped_speeds():
    places = np.array([[AWAY, 1, 1], [AWAY, 1, 2], [AWAY, AWAY, 5]])
    speeds = np.array([[0, 20, 150], [0, 60, 40], [0, 0, 102]])
    release = Worlds(record(places, speeds)).started(CappedSettings())
    np.testing.assert_array_equal(true_values(release, 1, 1)[1], [2.0, (20 - 51) + (60 - 51)])
    now = true_values(release, 2, 1, 2, 3)
    np.testing.assert_array_equal(now[1], [1.0, 51.0])  # 150 km/h is clipped to 102
    np.testing.assert_array_equal(now[2], [1.0, 40 - 51])
    np.testing.assert_array_equal(now[[3, 5]], 0.0)  # nobody there, and not queried


@pytest.mark.parametrize(
    "groups", [WHOLE, (Group("queries", 0.5, Penetration(0.3)), Group("sensors", 0.5))]
)
def test_an_empty_segment_or_sensor_has_its_own_speed_limit(groups):
    road = short_road(1).replaced(fixed_sensors=(3, 5, 7), ramp_speed_limit=60.0)
    empty = Worlds(stays(0, 0.0, 1, present=False), road=road)
    release = empty.started(PrivacySettings("printed"), groups=groups)
    every, task = road.road.limits, release.task
    found = release.true_values(request(1, n_columns=task.n_channels))
    np.testing.assert_array_equal(found[0, :, 1], every[task.channels.first])
    assert {60.0, LIMIT} == set(every)


def test_the_cap_belongs_to_trips_and_without_it_values_are_the_aggregates():
    whole, some = crowd(), np.arange(COLUMNS) < 3
    asked = {"cap": 3}, {"cap": T}, {"unit": "event"}
    every = PrivacySettings("corrected"), *(CappedSettings(**each) for each in asked)
    aggregates, trip, whole_trip, event = (Worlds(whole).started(asked) for asked in every)
    for t in range(1, T + 1):
        true, capped, uncapped, seconds = (
            release.true_values(request(t, some))[0, :3]
            for release in (aggregates, trip, whole_trip, event)
        )
        np.testing.assert_allclose(uncapped[:, 0], LENGTH * true[:, 0])
        np.testing.assert_allclose(seconds, uncapped, atol=0.5)  # on a grid of another noise
    assert (capped[:, 0] < uncapped[:, 0]).any()
    seen = (whole.step > 0) & (whole.segment < 3)
    met = np.bincount(whole.vehicle[seen], minlength=whole.n_vehicles)
    np.testing.assert_array_equal(whole_trip.private(ONE, ONE)["exposures"][0], met)
    told, counted = trip.private(ONE, ONE), np.minimum(met, 3)
    np.testing.assert_array_equal(told["exposures"][0], counted)
    assert {type(n) for n in told["exposures"][0]} == {int}
    # A vehicle that has counted k times has spent the budget of a cap of k.
    mu = trip.report().mu
    exact = [epsilon_of(mu * math.sqrt(n / 3), 0.05) if n else 0.0 for n in counted.tolist()]
    assert told["individual_epsilon"][0] == pytest.approx(exact)
    assert len(set(exact)) == 4
    assert trip.budgets_spent(ONE) == pytest.approx([counted.sum() / 3.0])
    assert event.budgets_spent(ONE).tolist() == [0.0]


@pytest.mark.parametrize("preset", ["printed", "corrected", "capped"])
def test_a_vehicle_counts_alike_on_every_segment_in_units_of_the_noise(preset):
    road = UNEVEN.replaced(duration=T)
    n_columns = road.geometry.n_cells
    asked = RELEASE_MODELS[preset].settings_type(preset=preset, epsilon=5.0)
    release = Worlds(crowd(200, last=n_columns, n_columns=n_columns), road=road).started(asked)
    every = request(1, n_columns=n_columns)
    released, true = release.release(every), release.true_values(every)
    lengths = release.task.channels.length
    np.testing.assert_allclose(
        lengths * released.sigma[0, :, 0], min(lengths) * release.sigma[0], rtol=1e-12
    )
    noise = (released.values - true / release.unit[:, None]) / released.sigma
    assert 0.7 < noise.std() < 1.3


# --- no policy exceeds mu ------------------------------------------------------------------------


def squared_distance(release, queries, std=None):
    """Squared distance of two worlds' true values in units of the noise, or of ``std`` (2,).

    Both are asked alike in each second, (seconds, C), as they are given equal past releases.
    """
    std = release.added_std[0] if std is None else std
    release.reset(BOTH, streams(1, 2))
    total = 0.0
    for t, observed in enumerate(queries, 1):
        asked = request(t, observed, episodes=BOTH, n_columns=release.task.n_channels)
        first, second = release.true_values(asked)
        total += float(np.sum((((first - second) / std)[observed]) ** 2))
    return total


WISHES = st.builds(
    CappedSettings,
    epsilon=st.sampled_from([0.5, 5.0]),
    unit=st.sampled_from(["trip", "event"]),
    cap=st.sampled_from([1, 3, 64]),
    adjacency=st.sampled_from(["replace", "add_remove"]),
    share=st.sampled_from([0.1, 0.5, 0.8]),
)


@settings(max_examples=80)
@given(st.data())
def test_no_policy_exceeds_mu(data):
    """Neither one that asks at random nor one that follows the vehicle that differs."""
    asked = data.draw(WISHES)
    places, speeds, other_places, other_speeds = data.draw(adjacent_trips(asked, 4, T, 3))
    groups = data.draw(st.sampled_from([WHOLE, TWO_GROUPS]))
    worlds = Worlds(record(places, speeds), record(other_places, other_speeds))
    release = worlds.release(asked, groups=groups)
    first = release.task.channels.first
    queries = np.random.default_rng(data.draw(st.integers(0, 99))).random((T, first.size)) < 0.5
    if data.draw(st.booleans()):
        trips = np.stack([places[0, 1:], other_places[0, 1:]], axis=1)
        queries |= (trips[:, :, None] == first).any(axis=1)
    mu = release.report().mu
    assert mu <= mu_of(asked.epsilon, asked.delta) * (1.0 + 1e-12)
    assert squared_distance(release, queries) <= mu**2
    # As many steps as were released: the account that a running episode shows.
    spent, _ = release.spent(ONE, np.array([T // 2]))
    assert squared_distance(release, queries[: T // 2]) <= spent[0] ** 2


ALL = np.ones((T, COLUMNS), dtype=bool)


@settings(max_examples=30)
@given(share=st.floats(0.05, 0.95), cap=st.integers(1, T))
@example(share=0.5, cap=4)
def test_the_extremes_of_the_proof_are_met_and_no_more(share, cap):
    asked = CappedSettings(cap=cap, share=share)
    same = Worlds(stays(2, 0.0), stays(2, LIMIT)).release(asked)
    apart = Worlds(stays(1, 0.0), stays(2, LIMIT)).release(asked)
    found = [squared_distance(release, ALL) for release in (same, apart)]
    # a and f of the proof: a vehicle's squared terms in units of the noise.
    density, flow = same.sigma
    a, f = 1.0 / (LENGTH * density) ** 2, (0.5 * LIMIT / (LENGTH * flow)) ** 2
    assert found == pytest.approx([4.0 * f * cap, 2.0 * (a + f) * cap], rel=1e-12)
    # Neither is slack: the larger of the two is the whole budget. So it is in a second episode.
    assert max(found) == pytest.approx(mu_of(asked.epsilon, asked.delta) ** 2, rel=1e-8)
    assert squared_distance(same, ALL) == found[0]


def test_on_segments_of_unequal_length_the_whole_of_mu_is_reached():
    road = UNEVEN.replaced(duration=T)
    n_columns = road.geometry.n_cells
    standing = (np.full((1, T + 1), segment) for segment in (4, 5))  # the longest, the shortest
    worlds = Worlds(*(record(at, 0.0 * at, n_columns) for at in standing), road=road)
    found = squared_distance(worlds.release(CappedSettings(cap=4)), np.ones((T, n_columns), bool))
    assert found == pytest.approx(mu_of(1.0, 0.05) ** 2, rel=1e-8)


def test_the_sensitivity_of_the_paper_is_of_the_shortest_segment_and_exceeded():
    """By a vehicle that stands in view for 300 s, in density alone."""
    steps, shortest = 300, min(UNEVEN.geometry.segment_lengths)
    road, n_columns = UNEVEN.replaced(duration=steps), UNEVEN.geometry.n_cells
    standing = (np.full((1, steps + 1), segment) for segment in (1, 5))
    worlds = Worlds(*(record(at, 0.0 * at, n_columns) for at in standing), road=road)
    release = worlds.release(PrivacySettings("corrected"))
    every = np.ones((steps, n_columns), dtype=bool)
    found = squared_distance(release, every, [release.sigma[0], np.inf])
    n_sensors, dwell = dict(release.sensitivity[0].assumptions).values()
    claimed = release.report().releases[0]
    assert claimed.sensitivity == pytest.approx(math.sqrt(2 * n_sensors * dwell) / shortest)
    assert found > 3.0 * claimed.mu**2


# --- reports -------------------------------------------------------------------------------------


def release_of(preset="printed", epsilon=1.0, delta=0.05, n_sensors=8, dwell=8.0, **keywords):
    """That of the paper's highway, three of whose sensors are fixed."""
    privacy = {"preset": preset, "epsilon": epsilon, "delta": delta, **keywords}
    values = {"privacy": privacy, "corridor": {"average_dwell": dwell}, "bandwidth": n_sensors - 3}
    return make_release(resolve("paper-highway", values))


@pytest.mark.parametrize(
    ("n_sensors", "average_dwell", "epsilon"), [(8, 4.0, 22), (8, 8.0, 30), (14, 8.0, 38)]
)
def test_golden_range_of_the_printed_noise(n_sensors, average_dwell, epsilon):
    """From few sensors and brisk traffic to the most sensors of the paper's figures."""
    found = release_of("printed", n_sensors=n_sensors, dwell=average_dwell).report()
    assert (found.claimed_epsilon, round(found.epsilon)) == (1.0, epsilon)
    assert found.epsilon == pytest.approx(get_epsilon_gaussian(1.0 / found.mu, 0.05), rel=1e-10)


@pytest.mark.parametrize(
    ("preset", "reasons"),
    [
        ("printed", ("literal_variance", *SENSITIVITY_REASONS, "releases_not_composed")),
        ("corrected", SENSITIVITY_REASONS),
    ],
)
def test_the_paper_s_models_list_how_they_fail_in_numbers_that_follow_from_one_another(
    preset, reasons
):
    release = release_of(preset)
    found = release.report()
    assert (found.guarantee, found.void_reasons) == ("none", reasons)
    for quantity, bound in zip(found.releases, release.sensitivity[0].releases, strict=True):
        assert (quantity.quantity, quantity.unit) == (bound.quantity, bound.unit)
        assert quantity.sensitivity == bound.bound
        assert quantity.mu == pytest.approx(quantity.sensitivity / quantity.noise_std, rel=1e-15)
    assert [quantity.noise_std for quantity in found.releases] == release.sigma.tolist()
    assert found.mu == pytest.approx(math.hypot(*(q.mu for q in found.releases)), rel=1e-8)
    assert found.epsilon == epsilon_of(found.mu, 0.05)
    assert found.epsilons == epsilons_of(found.mu)
    assert found.epsilons["1e-4"] == epsilon_of(found.mu, 1e-4) > found.epsilon
    assert found.assumptions == {"n_sensors": 8, "average_dwell_steps": 8.0}
    # The whole episode is charged from the first step.
    mu, epsilon = release.spent(np.arange(4), np.array([0, 1, 350, 700]))
    assert (mu.tolist(), epsilon.tolist()) == ([found.mu] * 4, [found.epsilon] * 4)


def test_composition_is_a_reason_just_where_two_releases_exceed_the_claim():
    for epsilon in (0.1, 1.0, 2.0, 5.0, 10.0):
        for delta in (0.05, 0.001, 1e-6):
            found = release_of("corrected", epsilon, delta).report()
            assert ("releases_not_composed" in found.void_reasons) == (found.epsilon > epsilon)
    # Kappa is so loose that two releases stay below a claim of one, whatever the sensitivities.
    for road in ({}, {"n_sensors": 14, "dwell": 12.0}):
        assert release_of("corrected", **road).report().epsilon == pytest.approx(0.982, abs=5e-4)


def capped(cap=16, horizon=100, **privacy):
    privacy = {"preset": "capped", "epsilon": 5.0, "cap": cap, **privacy}
    return resolve("paper-highway", {"privacy": privacy, "horizon": horizon})


@pytest.mark.parametrize(
    ("unit", "adjacency", "share", "boundary_inputs"),
    pairwise(
        ["trip", "event"], ["replace", "add_remove"], [0.2, 0.7], [None, "private"],
        n=4, rest=False,
    ),
)  # fmt: skip
def test_a_guarantee_is_claimed_for_its_unit_and_charged_until_its_cap(
    unit, adjacency, share, boundary_inputs
):
    config = capped(unit=unit, adjacency=adjacency, share=share, boundary_inputs=boundary_inputs)
    found = privacy_report(config)
    assert found.void_reasons == ()
    claim = "2.119-Gaussian differential privacy (rounded up), which is (5, 0.05)-"
    assert found.guarantee.startswith(claim)
    assert f"{found.protects}, against whoever does not know the seed" in found.guarantee
    cap = {"cap": 16} if unit == "trip" else {}
    assert found.details == {"unit": unit, "adjacency": adjacency, "share": share, **cap}
    assert found.speed_release == "flow"
    assert found.boundary_inputs == (boundary_inputs or "nominal")
    assert found.mu == pytest.approx(mu_of(5.0, 0.05), rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)
    mu, epsilon = make_release(config).spent(np.arange(101), np.arange(101))
    whole = {"trip": 16, "event": 1}[unit]
    parts = np.minimum(np.arange(101), whole) / whole
    np.testing.assert_allclose(mu, found.mu * np.sqrt(parts), rtol=1e-14)
    expected = [epsilon_of(value, 0.05) for value in mu[1:].tolist()]
    np.testing.assert_array_equal(epsilon, [0.0, *expected])


def test_the_report_describes_the_noise_in_force():
    """Noise that is smaller than it should be voids the guarantee instead of hiding behind it."""

    class Weaker(RELEASE_MODELS["capped"]):
        def _noise_std(self, group):
            return tuple(std / 1.41 for std in super()._noise_std(group))

    release = Worlds(stays(0, 0.0)).release(CappedSettings(epsilon=5.0), kind=Weaker)
    found = release.report()
    assert (found.guarantee, found.void_reasons) == ("none", ("releases_not_composed",))
    assert [quantity.noise_std for quantity in found.releases] == release.sigma.tolist()
    assert found.epsilon > 5.0
    assert release.spent(ONE, np.array([100]))[0][0] == pytest.approx(found.mu)

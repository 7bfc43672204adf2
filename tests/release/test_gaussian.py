"""Release models with Gaussian noise: what they release, what may be claimed, and the bound on it.

Under `Capped` no policy tells two worlds apart by more than mu, given the same past releases. That
holds surely, so it is tested without noise: the true answers of two worlds that differ in one
vehicle are never further apart than mu, in units of the noise.
"""

import dataclasses
import math

import numpy as np
import pytest
from dp_accounting import get_epsilon_gaussian
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dptse_env.config import resolve
from dptse_env.parts import make_release, privacy_report
from dptse_env.privacy import epsilon_of, mu_of
from dptse_env.release import RELEASE_MODELS, CappedSettings, Group, PrivacySettings, Request
from dptse_env.release.report import STRICT_DELTA
from dptse_env.traffic import Penetration
from tests.helpers import AWAY, UNEVEN, pairwise, record, short_road

from .worlds import (
    BOTH,
    COLUMNS,
    LENGTH,
    LIMIT,
    ONE,
    Worlds,
    adjacent_trips,
    crowd,
    request,
    stays,
)

T = 10
SLACK = 1.0 + 1e-9
SENSITIVITY_REASONS = ("average_dwell", "adaptive_queries", "speed_sensitivity")


# --- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("epsilon", 0.0, r"epsilon must be a number in \[0\.0001, 10000\], got 0\.0$"),
        ("delta", True, r"delta must be a number in \[1e-12, 0\.5\), got True$"),
        ("cap", 0, r"cap must be an integer in 1\.\.1000000, got 0$"),
        ("share", 0.0, r"share must be a number in \[0\.001, 0\.999\], got 0\.0$"),
        ("unit", np.zeros(2), r"unit must be one of 'trip', 'horizon', 'event', got array"),
        ("adjacency", "add", r"adjacency must be one of .*, got 'add'$"),
    ],
)
def test_bad_settings_are_named_with_their_path(field, value, message):
    with pytest.raises(ValueError, match=rf"^privacy\.{message}"):
        CappedSettings(**{field: value})
    with pytest.raises(ValueError, match=rf"^privacy\.{field}"):
        dataclasses.replace(CappedSettings(), **{field: value})


def test_mean_speeds_of_a_segment_have_no_neighbour_without_its_one_vehicle():
    with pytest.raises(ValueError, match=r"^privacy\.adjacency must be 'replace' where mean"):
        CappedSettings(adjacency="add_remove", speed_release="mean")


@pytest.mark.parametrize(
    ("unit", "contributions", "cap"), [("trip", 64, 64), ("horizon", 100, None), ("event", 1, None)]
)
def test_a_unit_bounds_how_often_it_can_count(unit, contributions, cap):
    asked = CappedSettings(unit=unit)
    assert (asked.contributions(100), asked.contribution_cap) == (contributions, cap)
    assert CappedSettings(unit="trip").contributions(10) == 10


def test_the_boundary_is_the_model_s_default_unless_given():
    assert PrivacySettings().boundary == "true"
    assert PrivacySettings(boundary_inputs="private").boundary == "private"
    assert CappedSettings().boundary == "nominal"
    assert CappedSettings(boundary_inputs="true").boundary == "true"


# --- true values ---------------------------------------------------------------------------------


def bounded(speed, cap=None):
    places = np.array([[AWAY, 1, 1], [AWAY, 1, 2], [AWAY, AWAY, 5]])
    speeds = np.array([[0, 20, 150], [0, 60, 40], [0, 0, 102]])
    unit = "horizon" if cap is None else "trip"
    asked = CappedSettings(unit=unit, cap=cap or 64, speed_release=speed)
    return Worlds(record(places, speeds)).started(asked)


def true_values(release, time, *queried):
    return release.true_values(request(time, np.isin(np.arange(COLUMNS), queried)))[0]


def test_a_flow_is_a_sum_of_centred_and_clipped_speeds():
    release = bounded("flow")
    np.testing.assert_allclose(true_values(release, 1, 1)[1], [20.0, ((20 - 51) + (60 - 51)) / 0.1])
    now = true_values(release, 2, 1, 2, 3)
    np.testing.assert_allclose(now[1], [10.0, 510.0])  # 150 km/h is clipped to 102
    np.testing.assert_allclose(now[2], [10.0, (40 - 51) / 0.1])
    np.testing.assert_array_equal(now[3], [0.0, 0.0])  # nobody there
    np.testing.assert_array_equal(now[5], [0.0, 0.0])  # not queried


def test_a_mean_is_over_those_that_count():
    release = bounded("mean", cap=1)
    np.testing.assert_allclose(true_values(release, 1, 1)[1], [20.0, 40.0])
    now = true_values(release, 2, 1, 2, 5)
    np.testing.assert_allclose(now[[1, 2]], [[0.0, 102.0]] * 2)  # both have counted before
    np.testing.assert_allclose(now[5], [10.0, 102.0])


@pytest.mark.parametrize("preset", ["paper", "capped"])
@pytest.mark.parametrize("groups", [1, 2])
def test_an_empty_segment_or_sensor_has_its_own_speed_limit(preset, groups):
    road = dataclasses.replace(short_road(1), fixed_sensors=(3, 5, 7), ramp_speed_limit=60.0)
    means = {"speed_release": "mean"} if preset == "capped" else {}
    asked = RELEASE_MODELS[preset].settings_type(preset=preset, **means)
    parts = Group("queries", 0.5, Penetration(0.3)), Group("sensors", 0.5)
    given = {"groups": parts} if groups == 2 else {}
    release = Worlds(stays(0, 0.0, 1, present=False), road=road).started(asked, **given)
    task = release.task
    everything = request(1, n_columns=task.n_columns)
    every = np.array(road.with_boundaries(road.speed_limits))
    np.testing.assert_array_equal(release.true_values(everything)[0, :, 1], every[task.first])
    assert {60.0, LIMIT} == set(every)


def test_without_a_cap_the_values_are_the_aggregates_and_the_cap_belongs_to_trips():
    whole, seconds = crowd(), np.arange(1, 9)
    plain, horizon, trip, event = (
        Worlds(whole).started(asked)
        for asked in (
            PrivacySettings("corrected"),
            CappedSettings(unit="horizon"),
            CappedSettings(cap=3),
            CappedSettings(unit="event", cap=3),
        )
    )
    for t in seconds.tolist():
        density, mean = plain.true_values(request(t))[0].T
        np.testing.assert_allclose(density * LENGTH, whole.counts[t])
        for release in (horizon, event):
            np.testing.assert_allclose(release.true_values(request(t))[0, :, 0], density)
        trip.true_values(request(t))
        flow = density * (mean - 0.5 * LIMIT)
        rows = whole.step == t
        clipped = np.bincount(
            whole.segment[rows], np.maximum(whole.speed[rows] - LIMIT, 0.0), COLUMNS
        )
        event_flow = event.true_values(request(t))[0, :, 1]
        np.testing.assert_allclose(event_flow, flow - clipped / LENGTH, atol=1e-3)
    met = np.bincount(whole.vehicle[whole.step > 0], minlength=whole.n_vehicles)
    (counted,) = trip.private(ONE, ONE)["exposures"]
    np.testing.assert_array_equal(counted, np.minimum(met, 3))
    (counted,) = horizon.private(ONE, ONE)["exposures"]
    np.testing.assert_array_equal(counted, met)
    assert trip.budgets_spent(ONE) == pytest.approx([np.minimum(met, 3).sum() / 3.0])
    assert horizon.budgets_spent(ONE).tolist() == [0.0]


def test_a_vehicle_that_has_counted_k_times_has_spent_the_budget_of_a_cap_of_k():
    release = Worlds(crowd(5)).started(CappedSettings(cap=4, epsilon=5.0))
    for t in range(1, 4):
        release.release(request(t, np.arange(COLUMNS) < 6))
    told = release.private(ONE, ONE)
    counted, epsilon = told["exposures"][0], told["individual_epsilon"][0]
    mu = release.report().mu
    exact = [epsilon_of(mu * np.sqrt(n / 4), 0.05) if n else 0.0 for n in counted]
    assert epsilon == pytest.approx(exact)
    assert {type(n) for n in counted} == {int}
    assert len(set(counted)) > 1


@pytest.mark.parametrize("preset", ["paper", "corrected", "capped"])
def test_a_vehicle_counts_alike_on_every_segment_in_units_of_the_noise(preset):
    road = dataclasses.replace(UNEVEN, duration=8)
    n_columns = road.n_segments + road.n_boundaries
    asked = RELEASE_MODELS[preset].settings_type(preset=preset, epsilon=5.0)
    release = Worlds(crowd(200, last=n_columns, n_columns=n_columns), road=road).started(asked)
    every = request(1, n_columns=n_columns)
    released, true = release.release(every), release.true_values(every)
    lengths = release.task.length
    np.testing.assert_allclose(
        lengths * released.sigma[0, :, 0], min(lengths) * release.sigma[0], rtol=1e-12
    )
    noise = (released.values - true) / released.sigma
    assert 0.7 < noise.std() < 1.3


# --- no policy exceeds mu ------------------------------------------------------------------------


def squared_distance(release, policy, n_steps, always=(), std=None):
    """Squared distance of two worlds' true values in units of the noise, over all steps.

    The policy is a function of what world 0 has released so far, and both worlds are queried
    alike: the distance given equal past releases, which is what the proof bounds.
    """
    std = release.sigma if std is None else std
    release.reset(BOTH, [np.random.default_rng(1), np.random.default_rng(2)])
    noise = np.random.default_rng(5).standard_normal((n_steps + 1, 2)) * std
    past, total = [], 0.0
    for t in range(1, n_steps + 1):
        observed = np.array(policy(past), dtype=bool)
        observed[list(always)] = True
        asked = Request(BOTH, BOTH, np.full(2, t), np.stack([observed, observed]))
        values = release.true_values(asked)
        total += float(np.sum(((values[0] - values[1])[observed] / std) ** 2))
        released = np.where(observed[:, None], values[0] + noise[t], 0.0)
        past.append((observed, released))
    return total


@st.composite
def policies(draw, places, other_places):
    """A policy that asks at random, one that chases what was released, or one that knows."""
    kind = draw(st.sampled_from(["random", "hunter", "oracle"]))
    if kind == "random":
        masks = draw(arrays(bool, (T, COLUMNS)))
        return lambda past: masks[len(past)]
    if kind == "hunter":
        bandwidth, ahead = draw(st.integers(1, 3)), draw(st.integers(0, 1))
        return lambda past: hunt(past, bandwidth, ahead)

    def follow(past):
        now = [trip[len(past) + 1] for trip in (places[0], other_places[0])]
        return np.isin(np.arange(COLUMNS), now)

    return follow


def hunt(past, bandwidth, ahead):
    """Ask where the latest releases saw most, or one segment further on."""
    seen = np.zeros(COLUMNS)
    for observed, released in past:
        told = np.abs(released[:, 0]) + np.abs(released[:, 1]) / LIMIT
        seen = np.where(observed, told, 0.9 * seen)
    best = (np.argsort(-seen, kind="stable")[:bandwidth] + ahead) % COLUMNS
    return np.isin(np.arange(COLUMNS), best)


@st.composite
def wishes(draw):
    return CappedSettings(
        epsilon=draw(st.sampled_from([0.5, 5.0])),
        unit=draw(st.sampled_from(["trip", "horizon", "event"])),
        cap=draw(st.sampled_from([1, 3, 64])),
        adjacency=draw(st.sampled_from(["replace", "add_remove"])),
        share=draw(st.sampled_from([0.1, 0.5, 0.8])),
    )


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_no_policy_exceeds_mu(data):
    asked = data.draw(wishes())
    places, speeds, other_places, other_speeds = data.draw(adjacent_trips(asked, 4, T, 3))
    policy = data.draw(policies(places, other_places))
    always = data.draw(st.sampled_from([(), (1,), (0, 2)]))
    release = Worlds(record(places, speeds), record(other_places, other_speeds)).release(asked)
    mu = release.report().mu
    assert mu <= mu_of(asked.epsilon, asked.delta) * SLACK
    assert squared_distance(release, policy, T, always) <= mu**2 * SLACK
    # As many steps as were released: the account that a running episode shows.
    short = T // 2
    spent, _ = release.spent(ONE, np.array([short]))
    assert squared_distance(release, policy, short, always) <= spent[0] ** 2 * SLACK


def lone(place, speed, steps=T, *, present=True):
    return stays(place, speed, steps, present=present)


def ask_all(past):
    return np.ones(COLUMNS, dtype=bool)


def bounds(asked):
    """a and f of the proof: a vehicle's squared terms in units of the noise."""
    density, flow = Worlds(lone(1, 0.0)).release(asked).sigma
    return 1.0 / (LENGTH * density) ** 2, (0.5 * LIMIT / (LENGTH * flow)) ** 2


@settings(deadline=None, max_examples=30)
@given(share=st.floats(0.05, 0.95), cap=st.integers(1, T))
@example(share=0.5, cap=4)
def test_the_extremes_of_the_proof_are_met_and_no_more(share, cap):
    asked = CappedSettings(cap=cap, share=share)
    mu, (a, f) = mu_of(asked.epsilon, asked.delta), bounds(asked)
    same = Worlds(lone(2, 0.0), lone(2, LIMIT)).release(asked)
    apart = Worlds(lone(1, 0.0), lone(2, LIMIT)).release(asked)
    found = [squared_distance(release, ask_all, T) for release in (same, apart)]
    assert found == pytest.approx([4.0 * f * cap, 2.0 * (a + f) * cap], rel=1e-12)
    # Neither is slack: the larger of the two is the whole budget.
    assert max(found) == pytest.approx(mu**2, rel=1e-9)


@pytest.mark.parametrize(("unit", "counted"), [("trip", 3), ("horizon", T), ("event", 1)])
def test_one_vehicle_more_costs_what_its_unit_says(unit, counted):
    asked = CappedSettings(unit=unit, cap=3, adjacency="add_remove", share=0.3)
    a, f = bounds(asked)
    gone = np.full(T + 1, 2)
    gone[4 if unit == "event" else slice(None)] = AWAY
    speeds = np.full((1, T + 1), LIMIT)
    release = Worlds(lone(2, LIMIT), record(gone[None], speeds)).release(asked)
    found = squared_distance(release, ask_all, T)
    assert found == pytest.approx(counted * (a + f), rel=1e-12)
    assert found == pytest.approx(mu_of(asked.epsilon, asked.delta) ** 2, rel=1e-9)


def test_a_second_episode_counts_from_nothing():
    release = Worlds(lone(2, LIMIT), lone(2, 0.0)).release(CappedSettings(cap=3))
    first = squared_distance(release, ask_all, T)
    assert squared_distance(release, ask_all, T) == first > 0.0


def test_the_sensitivity_of_the_paper_is_exceeded():
    """By a vehicle that stands in view for 300 s, in density alone."""
    steps = 300
    worlds = Worlds(lone(1, 10.0, steps), lone(2, 10.0, steps))
    release = worlds.release(PrivacySettings("corrected"))
    density = np.array([release.sigma[0], np.inf])
    found = squared_distance(release, ask_all, steps, std=density)
    claimed = release.report().releases[0]
    # Two queries, two fixed sensors and four boundary segments, each passed once for the average.
    dwell = release.task.corridor.average_dwell
    assert claimed.sensitivity == pytest.approx(10.0 * math.sqrt(2 * 8 * dwell))
    assert found == pytest.approx(claimed.mu**2 * 2 * steps / (2 * 8 * dwell), rel=1e-12)
    assert found > 3.0 * claimed.mu**2


def test_mean_speeds_exceed_mu():
    means, flows = CappedSettings(cap=4, speed_release="mean"), CappedSettings(cap=4)
    worlds = Worlds(lone(2, 0.0), lone(2, LIMIT))
    mu = mu_of(means.epsilon, means.delta)
    assert squared_distance(worlds.release(flows), ask_all, T) <= mu**2 * SLACK
    assert squared_distance(worlds.release(means), ask_all, T) > 100.0 * mu**2


# --- reports -------------------------------------------------------------------------------------


def config(preset="paper", epsilon=1.0, delta=0.05, n_sensors=8, dwell=8.0, **keywords):
    """The paper's highway, three of whose sensors are fixed."""
    privacy = {"preset": preset, "epsilon": epsilon, "delta": delta, **keywords}
    corridor = {"average_dwell": dwell}
    values = {"privacy": privacy, "corridor": corridor, "bandwidth": n_sensors - 3}
    return resolve("paper-highway", values)


def report(*args, **keywords):
    return privacy_report(config(*args, **keywords))


@pytest.mark.parametrize(
    ("n_sensors", "average_dwell", "epsilon"), [(8, 4.0, 22), (8, 8.0, 30), (14, 8.0, 38)]
)
def test_golden_range_of_the_printed_noise(n_sensors, average_dwell, epsilon):
    """From few sensors and brisk traffic to the most sensors of the paper's figures."""
    found = report("paper", n_sensors=n_sensors, dwell=average_dwell)
    assert (found.claimed_epsilon, round(found.epsilon)) == (1.0, epsilon)
    assert found.epsilon == pytest.approx(get_epsilon_gaussian(1.0 / found.mu, 0.05), rel=1e-10)


def test_the_corrected_noise_stays_below_its_claim_at_one_whatever_the_sensitivities():
    assert report("corrected").epsilon == pytest.approx(0.982, abs=5e-4)
    other = report("corrected", n_sensors=14, dwell=12.0).mu
    assert other == pytest.approx(report("corrected").mu, rel=1e-14)


@pytest.mark.parametrize("preset", ["paper", "corrected"])
def test_the_numbers_of_a_report_follow_from_one_another(preset):
    found, release = report(preset), make_release(config(preset))
    for quantity, bound in zip(found.releases, release.sensitivity[0].releases, strict=True):
        assert (quantity.quantity, quantity.unit) == (bound.quantity, bound.unit)
        assert quantity.sensitivity == bound.bound
        assert quantity.mu == pytest.approx(quantity.sensitivity / quantity.noise_std, rel=1e-15)
    assert [quantity.noise_std for quantity in found.releases] == release.sigma.tolist()
    assert found.mu == pytest.approx(math.hypot(*(q.mu for q in found.releases)), rel=1e-14)
    assert found.epsilon == epsilon_of(found.mu, 0.05)
    assert found.epsilon_strict == epsilon_of(found.mu, STRICT_DELTA) > found.epsilon
    assert found.assumptions == {"n_sensors": 8, "average_dwell_steps": 8.0}
    # The whole episode is charged from the first step.
    mu, epsilon = release.spent(np.arange(4), np.array([0, 1, 350, 700]))
    assert (mu.tolist(), epsilon.tolist()) == ([found.mu] * 4, [found.epsilon] * 4)


@pytest.mark.parametrize(
    ("preset", "reasons"),
    [
        ("paper", ("literal_variance", *SENSITIVITY_REASONS, "boundary_inputs",
                   "releases_not_composed")),
        ("corrected", (*SENSITIVITY_REASONS, "boundary_inputs")),
    ],
)  # fmt: skip
def test_the_paper_s_models_list_every_way_in_which_they_fail(preset, reasons):
    found, nominal = report(preset), report(preset, boundary_inputs="nominal")
    assert found.guarantee == nominal.guarantee == "none"
    assert found.void_reasons == reasons
    assert set(reasons) - set(nominal.void_reasons) == {"boundary_inputs"}


@pytest.mark.parametrize("epsilon", [0.1, 1.0, 2.0, 5.0, 10.0])
def test_composition_is_a_reason_just_where_two_releases_exceed_the_claim(epsilon):
    for delta in (0.05, 0.001, 1e-6):
        found = report("corrected", epsilon, delta)
        assert ("releases_not_composed" in found.void_reasons) == (found.epsilon > epsilon)
    assert "releases_not_composed" in report("corrected", epsilon=5.0).void_reasons


def capped(cap=16, horizon=100, **privacy):
    privacy = {"preset": "capped", "epsilon": 5.0, "cap": cap, **privacy}
    return resolve("paper-highway", {"privacy": privacy, "horizon": horizon})


@pytest.mark.parametrize(
    ("unit", "adjacency", "share", "boundary_inputs"),
    pairwise(
        ["trip", "horizon", "event"], ["replace", "add_remove"], [0.2, 0.7], [None, "private"],
        rest=False,
    ),
)  # fmt: skip
def test_a_guarantee_is_claimed_for_its_unit(unit, adjacency, share, boundary_inputs):
    found = privacy_report(
        capped(unit=unit, adjacency=adjacency, share=share, boundary_inputs=boundary_inputs)
    )
    assert found.void_reasons == ()
    assert found.guarantee == (
        f"(5, 0.05)-differential privacy of density and flow together, for {found.protects}"
    )
    cap = {"cap": 16} if unit == "trip" else {}
    assert found.details == {"unit": unit, "adjacency": adjacency, "share": share, **cap}
    assert found.speed_release == "flow"
    assert found.boundary_inputs == (boundary_inputs or "nominal")
    assert found.mu == pytest.approx(mu_of(5.0, 0.05), rel=1e-12)
    assert found.epsilon == pytest.approx(5.0, rel=1e-9)


@pytest.mark.parametrize(
    ("privacy", "reasons"),
    [
        ({"boundary_inputs": "true"}, ("boundary_inputs",)),
        ({"speed_release": "mean", "boundary_inputs": "true"},
         ("speed_sensitivity", "boundary_inputs")),
    ],
)  # fmt: skip
def test_reasons_that_void_a_guarantee_are_listed(privacy, reasons):
    found = privacy_report(capped(**privacy))
    assert (found.guarantee, found.void_reasons) == ("none", reasons)


@pytest.mark.parametrize(("unit", "whole"), [("trip", 16), ("horizon", 100), ("event", 1)])
def test_an_episode_is_charged_step_by_step_until_the_cap(unit, whole):
    release = make_release(capped(unit=unit))
    mu, epsilon = release.spent(np.arange(101), np.arange(101))
    counted = np.minimum(np.arange(101), whole)
    np.testing.assert_allclose(mu, release.report().mu * np.sqrt(counted / whole), rtol=1e-14)
    assert (mu[0], epsilon[0]) == (0.0, 0.0)
    assert epsilon[-1] == pytest.approx(5.0, rel=1e-9)
    expected = [epsilon_of(value, 0.05) for value in mu[1:].tolist()]
    np.testing.assert_array_equal(epsilon[1:], expected)


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
